"""Killed at random times, the same command ends with the same content; stopped by a full disk or a lock, it says so."""

from __future__ import annotations

import json
import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import make_toy
from crashing import Crash, watching
from toy_stages import toy_recipe

from dapdata import cli, durable, health, manifest, pipeline
from dapdata.errors import EnvironmentProblem, FormatError, LockedError

HERE = Path(__file__).parent
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])}
COMMAND = """
import signal, sys
from dapdata import cli, pipeline
from toy_stages import toy_recipe
signal.signal(signal.SIGTERM, cli._terminate)
root, workers = sys.argv[1], int(sys.argv[2])
pipeline.generate(toy_recipe(8), root, workers=workers, table="toy_stages")
pipeline.label(root, workers=workers, table="toy_stages")
"""
SIGNALS = {"kill": signal.SIGKILL, "terminate": signal.SIGTERM, "ctrl-c": signal.SIGINT}


def whole_or_unpublished(root: Path) -> bool:
    try:
        return health.verify(root).ok
    except FormatError:
        return not (root / manifest.MANIFEST).exists()


# Kills -------------------------------------------------------------------------------------------------------


def one_life(command: list[str], root: Path, number: signal.Signals, seconds: float) -> bool:
    """Whether a command was killed: its whole process group, so many seconds after it began to work on the dataset."""
    environment = ENVIRONMENT | {"TOY_SLEEP": "0.05"}
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, env=environment, start_new_session=True, stdout=pipe, stderr=pipe)
    while process.poll() is None and not (root / durable.LOCK).exists():
        time.sleep(0.01)
    time.sleep(seconds)
    was_alive = process.poll() is None
    if was_alive:
        os.killpg(process.pid, number)
    process.communicate(timeout=60)
    assert number == signal.SIGKILL or left_over(root) == []
    return was_alive


def left_over(root: Path) -> list[bytes]:
    """Command lines of processes that still work on the dataset."""
    lines = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            lines.append(path.read_bytes())
        except OSError:  # it has just ended
            continue
    return [line for line in lines if str(root).encode() in line]


def killed_toys(root: Path, whole: Path, rng: np.random.Generator, workers: int, signals: list[signal.Signals]) -> int:
    """How many of several lives of a toy dataset were ended by a signal; at last it is made and compared."""
    kills = 0
    for number in signals:
        command = [sys.executable, "-c", COMMAND, str(root), str(workers)]
        kills += one_life(command, root, number, float(rng.uniform(0.0, 2.5)))
        assert whole_or_unpublished(root)
    make_toy(root)
    assert health.verify(root).ok
    assert manifest.read(root).content_sha256 == manifest.read(whole).content_sha256
    assert (root / manifest.INDEX).read_bytes() == (whole / manifest.INDEX).read_bytes()
    return kills


def test_a_killed_run_ends_with_the_content_of_one_that_was_not(toy: Path, tmp_path: Path) -> None:
    killed_toys(tmp_path / "toy", toy, np.random.default_rng(2), 2, [SIGNALS["kill"], SIGNALS["ctrl-c"]])


@pytest.mark.slow
def test_forty_killed_runs_end_with_the_content_of_those_that_were_not(toy: Path, tmp_path: Path) -> None:
    kills, series = 0, 0
    while kills < 40:
        rng = np.random.default_rng(series)
        signals = [list(SIGNALS.values())[int(i)] for i in rng.integers(0, len(SIGNALS), 4)]
        kills += killed_toys(tmp_path / str(series), toy, rng, 1 + series % 3, signals)
        series += 1
        assert series < 20, "hardly anything was killed"


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_true_commands_that_are_killed_end_with_the_content_of_those_that_are_not(
    tiny: Path, tiny_recipe: Path, tmp_path: Path, workers: int
) -> None:
    root, rng, kills = tmp_path / "tiny", np.random.default_rng(workers), 0
    generate = ["generate", str(tiny_recipe), "--out", str(root), "--workers", str(workers)]
    for command in (generate, generate, generate, ["label", str(root), "--workers", str(workers)]):
        life = [sys.executable, "-m", "dapdata", *command]
        kills += one_life(life, root, SIGNALS["kill"], float(rng.uniform(0.0, 4.0)))
        assert whole_or_unpublished(root)
    assert kills > 0
    assert [cli.run_app(command) for command in (generate, ["label", str(root)])] == [0, 0]
    assert manifest.read(root).content_sha256 == manifest.read(tiny).content_sha256


def test_a_stage_sees_the_same_numbers_from_memory_and_from_disk(in_memory: Path) -> None:
    """The toy observes in float64, and float32 is stored: label must not depend on whether cluster ran just before."""
    roots = [make_toy(in_memory / name, 2, 2) for name in ("at_once", "resumed")]
    unit = manifest.read(roots[1]).stages["label"].units[0]
    durable.discard(roots[1], roots[1] / unit.path)
    pipeline.label(roots[1], engine="inline", table="toy_stages")
    assert health.verify(roots[1]).ok
    assert manifest.read(roots[1]).content_sha256 == manifest.read(roots[0]).content_sha256


def test_an_interrupted_command_says_how_far_it_came_and_what_is_left(
    toy: Path, in_memory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, renames = in_memory / "toy", 0

    def stop(action: str, path: Path) -> None:
        nonlocal renames
        renames += action == "rename"
        if renames == 3:  # the progress file, the first unit of demonstrate, and now the first of observe
            raise Crash

    with watching(stop), pytest.raises(Crash):
        pipeline.generate(toy_recipe(8), root, engine="inline", table="toy_stages")
    assert [len(list((root / "stages").glob(f"{stage}/*"))) for stage in ("demonstrate", "observe")] == [1, 0]
    with pytest.raises(FormatError, match="run it again to go on"):
        manifest.read(root)
    with pytest.raises(FormatError, match="run it again to go on"):
        pipeline.label(root, engine="inline", table="toy_stages")
    assert health.status(root).to_dict()["in_progress"]["units"] == 3
    plan = pipeline.generate(toy_recipe(8), root, dry_run=True, table="toy_stages")
    assert "demonstrate: 2 of 3 units run (5 demos): 2 units are not there yet" in str(plan)
    calls = in_memory / "calls"
    monkeypatch.setenv("TOY_CALLS", str(calls))
    make_toy(root)
    assert calls.read_text().split().count("observe") == 8
    assert manifest.read(root).content_sha256 == manifest.read(toy).content_sha256


def test_what_a_kill_left_of_an_empty_dataset_is_no_reason_to_refuse_it_and_a_run_is_one(in_memory: Path) -> None:
    root = in_memory / "toy"
    (root / manifest.PREVIEWS).mkdir(parents=True)  # `generate --fresh` was about to remove the last of all
    (root / durable.LOCK).touch()
    (root / ".progress.json.here.123.tmp").write_text("{")
    make_toy(root, 2, 2)
    assert health.verify(root).ok
    (in_memory / "run").mkdir()
    for name in (durable.LOCK, "config.json"):
        (in_memory / "run" / name).touch()
    with pytest.raises(FormatError, match="a folder with other files and no dataset"):
        make_toy(in_memory / "run", 2, 2)


def test_a_command_that_only_publishes_can_be_interrupted_at_that(in_memory: Path) -> None:
    """All units are there, from the labelling before the last: what is left of the manifest is what the command worked on."""
    root, gone = make_toy(in_memory / "toy", 2, 2), False
    content = manifest.read(root).content_sha256

    def stop(action: str, path: Path) -> None:
        nonlocal gone
        if gone:
            raise Crash
        gone = (action, path.name) == ("remove", manifest.MANIFEST)

    pipeline.label(root, ["label.eps_place=0.02"], engine="inline", table="toy_stages")
    with watching(stop), pytest.raises(Crash):
        pipeline.label(root, ["label.eps_place=0.03"], engine="inline", table="toy_stages")
    assert not (root / manifest.MANIFEST).exists()
    pipeline.label(root, engine="inline", table="toy_stages")
    assert manifest.read(root).content_sha256 == content


def test_staging_is_swept_where_a_process_of_this_number_was_killed_at_that(in_memory: Path) -> None:
    """In containers every process has the same number."""
    for name in (f".{durable.STAGING}.{durable._here()}.tmp", durable.STAGING):
        (in_memory / name / "unit").mkdir(parents=True)
    durable.sweep(in_memory)
    assert not list(in_memory.iterdir())


# A full disk -------------------------------------------------------------------------------------------------


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """No file can grow beyond so many bytes: the system then says what it says of a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def stopped_by_a_full_disk(root: Path, whole: Path, size: int) -> None:
    with files_of_at_most(size), pytest.raises(EnvironmentProblem, match=r"disk full.*about \d+ MB more are needed") as caught:
        make_toy(root)
    assert caught.value.exit_code == 6
    assert "\n" not in str(caught.value)
    assert whole_or_unpublished(root)
    make_toy(root)
    assert health.verify(root).ok
    assert manifest.read(root).content_sha256 == manifest.read(whole).content_sha256


def test_a_full_disk_stops_cleanly_and_resumes(toy: Path, in_memory: Path) -> None:
    stopped_by_a_full_disk(in_memory / "toy", toy, 6000)


def test_too_small_a_disk_stops_before_anything_is_written(in_memory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline.shutil, "disk_usage", lambda path: SimpleNamespace(free=1_000_000))
    with pytest.raises(EnvironmentProblem, match=r"about \d+ MB are needed, 1 MB are free; make room"):
        make_toy(in_memory / "toy", 800)
    assert not (in_memory / "toy").exists()


@pytest.mark.slow
@pytest.mark.parametrize("size", np.geomspace(10, 20_000, 12).astype(int).tolist())
def test_a_disk_that_is_full_for_files_of_any_size_stops_cleanly_and_resumes(toy: Path, in_memory: Path, size: int) -> None:
    stopped_by_a_full_disk(in_memory / "toy", toy, size)


FULL = """
import json, subprocess, sys
from pathlib import Path
from conftest import make_toy
from dapdata import health, manifest, pipeline
from dapdata.errors import EnvironmentProblem
from test_resume import whole_or_unpublished
pipeline._check_space = lambda *_: None  # somebody else fills the disk, after it was looked at
disk, needed, told = Path(sys.argv[1]), int(sys.argv[2]), []
for share in range(1, 13):
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={needed * share // 13 // 4096 * 4096}", "tmpfs", disk], check=True)
    try:
        make_toy(disk / "toy")
        told.append("not full")
    except EnvironmentProblem as error:
        told.append(str(error))
    assert whole_or_unpublished(disk / "toy")
    subprocess.run(["mount", "-o", f"remount,size={4 * needed}", disk], check=True)
    make_toy(disk / "toy")
    assert health.verify(disk / "toy").ok
    told[-1] = [told[-1], manifest.read(disk / "toy").content_sha256]
    subprocess.run(["umount", disk], check=True)
print(json.dumps(told))
"""
UNSHARE = ["unshare", "--user", "--map-root-user", "--mount"]


@pytest.mark.slow
def test_a_disk_that_is_full_at_any_time_stops_cleanly_and_resumes(toy: Path, tmp_path: Path) -> None:
    probe = subprocess.run([*UNSHARE, "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, check=False)
    if probe.returncode:
        pytest.skip("no small disk can be made here: user namespaces are not allowed")
    files = {path.stat().st_ino: path for path in toy.rglob("*") if path.is_file()}
    needed = sum(-(-path.stat().st_size // 4096) * 4096 for path in files.values())
    command = [*UNSHARE, sys.executable, "-c", FULL, str(tmp_path), str(needed)]
    done = subprocess.run(command, capture_output=True, text=True, env=ENVIRONMENT, check=False)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert len(told) == 12
    for message, content in told:
        assert re.search(r"disk full.*about \d+ MB more are needed.*nothing committed is lost", message)
        assert content == manifest.read(toy).content_sha256


# The lock ----------------------------------------------------------------------------------------------------

HOLD = """
import pathlib, sys, time
from dapdata import durable
with durable.lock(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def locked_out(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A second command while a first works, and a third after that was killed."""
    first = subprocess.Popen([sys.executable, "-c", HOLD, str(root)], stdout=subprocess.PIPE, text=True)
    assert first.stdout is not None
    assert first.stdout.readline() == "held\n"
    start = time.monotonic()
    assert cli.run_app(["gc", str(root)]) == 5
    assert time.monotonic() - start < 10
    assert f"{root}: in use by process {first.pid} on " in capsys.readouterr().err
    with pytest.raises(LockedError, match=f"process {first.pid} on "):
        make_toy(root)
    assert f"process {first.pid} on " in str(health.status(root).to_dict()["working"])
    first.kill()
    first.communicate()
    assert health.status(root).to_dict()["working"] is None
    assert cli.run_app(["gc", str(root)]) == 0
    assert health.verify(root, quick=True).ok


def test_the_second_command_is_told_at_once_who_works_and_a_lock_dies_with_its_holder(
    toy_copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    locked_out(toy_copy, capsys)


@pytest.mark.slow
def test_twenty_second_commands_are_told_at_once_who_works(toy_copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(20):
        locked_out(toy_copy, capsys)
