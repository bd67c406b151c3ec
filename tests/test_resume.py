"""Killed at any instant, the same command ends with the same content; what is published is always whole."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import make_toy
from toy_stages import toy_recipe

from dapdata import durable, health, manifest, pipeline
from dapdata.errors import FormatError

HERE = Path(__file__).parent
COMMAND = """
import sys
from dapdata import pipeline
from toy_stages import toy_recipe
root, workers = sys.argv[1], int(sys.argv[2])
pipeline.generate(toy_recipe(8), root, workers=workers, table="toy_stages")
pipeline.label(root, workers=workers, table="toy_stages")
"""


def start(root: Path, workers: int) -> subprocess.Popen[bytes]:
    """The two commands in a process group of their own."""
    environment = os.environ | {"PYTHONPATH": str(HERE), "TOY_SLEEP": "0.05"}
    return subprocess.Popen(
        [sys.executable, "-c", COMMAND, str(root), str(workers)],
        env=environment,
        start_new_session=True,
        stderr=subprocess.PIPE,
    )


def whole_or_unpublished(root: Path) -> bool:
    try:
        return health.verify(root).ok
    except FormatError:
        return True


@pytest.mark.parametrize(("workers", "number"), [(1, signal.SIGKILL), (2, signal.SIGTERM)])
def test_killed_runs_end_with_the_content_of_one_that_was_not(toy: Path, tmp_path: Path, workers: int, number: int) -> None:
    root, rng = tmp_path / "toy", np.random.default_rng(workers)
    for _ in range(2):
        process = start(root, workers)
        time.sleep(float(rng.uniform(1.5, 4.0)))
        os.killpg(process.pid, number)
        process.communicate()
        assert whole_or_unpublished(root)
    make_toy(root, workers=1, engine="inline")
    assert manifest.read(root).content_sha256 == manifest.read(toy).content_sha256
    assert (root / "index.parquet").read_bytes() == (toy / "index.parquet").read_bytes()
    assert health.verify(root).ok


def test_a_stage_sees_the_same_numbers_from_memory_and_from_disk(tmp_path: Path) -> None:
    """The toy observes in float64, and float32 is stored: label must not depend on whether cluster ran just before."""
    roots = [make_toy(tmp_path / name, 2, 2) for name in ("at_once", "resumed")]
    unit = manifest.read(roots[1]).stages["label"].units[0]
    durable.discard(roots[1], roots[1] / unit.path)
    pipeline.label(roots[1], engine="inline", table="toy_stages")
    assert health.verify(roots[1]).ok
    assert manifest.read(roots[1]).content_sha256 == manifest.read(roots[0]).content_sha256


def test_ctrl_c_stops_the_workers_too(tmp_path: Path) -> None:
    process = start(tmp_path / "toy", 2)
    time.sleep(3.0)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=30)
    assert process.returncode != 0
    assert b"KeyboardInterrupt" in stderr
    left = [p for p in Path("/proc").glob("[0-9]*/cmdline") if str(tmp_path).encode() in p.read_bytes()]
    assert left == []


class Crash(BaseException):
    """A power cut: nothing catches it."""


def test_a_crash_while_publishing_leaves_a_whole_dataset_or_none(
    toy: Path, toy_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Previews are added: manifest, card and picture all change, and the crash comes at each of their steps in turn."""
    crashes = 0
    for last in range(1, 100):
        done = 0

        def stop(action: str, path: Path, last: int = last) -> None:
            nonlocal done
            done += 1
            if done == last:
                raise Crash

        monkeypatch.setattr(durable, "observer", stop)
        try:
            pipeline.attach(toy_copy, {"preview/goals.png": bytes([last])})
        except Crash:
            crashes += 1
        else:
            break
        finally:
            monkeypatch.setattr(durable, "observer", None)
        assert whole_or_unpublished(toy_copy)
        make_toy(toy_copy)
        assert health.verify(toy_copy, quick=True).ok
        assert manifest.read(toy_copy).content_sha256 == manifest.read(toy).content_sha256
    assert crashes > 6


def test_a_crash_in_the_middle_of_generating_goes_on_at_the_next_stage(
    toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, renames = tmp_path / "toy", 0

    def stop(action: str, path: Path) -> None:
        nonlocal renames
        renames += action == "rename"
        if renames == 3:  # the progress file, the first unit of demonstrate, and now the first of observe
            raise Crash

    monkeypatch.setattr(durable, "observer", stop)
    with pytest.raises(Crash):
        pipeline.generate(toy_recipe(8), root, engine="inline", table="toy_stages")
    monkeypatch.setattr(durable, "observer", None)
    assert [len(list((root / "stages").glob(f"{stage}/*"))) for stage in ("demonstrate", "observe")] == [1, 0]
    with pytest.raises(FormatError, match="run it again to go on"):
        manifest.read(root)
    assert health.status(root).to_dict()["in_progress"]["units"] == 3
    plan = pipeline.generate(toy_recipe(8), root, dry_run=True, table="toy_stages")
    assert "demonstrate: 2 of 3 units run (5 demos): 2 units are not there yet" in str(plan)
    calls = tmp_path / "calls"
    monkeypatch.setenv("TOY_CALLS", str(calls))
    make_toy(root)
    assert calls.read_text().split().count("observe") == 8
    assert manifest.read(root).content_sha256 == manifest.read(toy).content_sha256
