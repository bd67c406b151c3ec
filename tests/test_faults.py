"""What fails costs its own unit, and what is damaged is not built upon."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from conftest import make_toy
from forging import alone
from toy_stages import toy_recipe

from dapdata import health, manifest, pipeline
from dapdata.errors import CorruptionError, QuarantineError

TABLE = "toy_stages"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}


def test_a_damaged_cached_unit_is_not_built_upon(toy_copy: Path) -> None:
    unit = toy_copy / manifest.read(toy_copy).stages["observe"].units[0].path
    chunk = next(p for p in (alone(unit) / "container/points/c").rglob("*") if p.is_file())
    chunk.write_bytes(chunk.read_bytes()[:-1])
    with pytest.raises(CorruptionError, match=r"container/points.*made anew"):
        pipeline.label(toy_copy, ["superpoints.count=100"], engine="inline", table=TABLE)
    shutil.rmtree(unit)
    make_toy(toy_copy)
    assert health.verify(toy_copy).ok


def test_a_unit_that_dies_is_quarantined_and_the_others_finish(
    toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "toy"
    monkeypatch.setenv("TOY_FAULT", "abort:4")
    with pytest.raises(
        QuarantineError, match=r"1 of 3 units.*\n.*unit 1 \(demos 3 to 5, seed 5\): killed by SIGABRT"
    ) as caught:
        pipeline.generate(toy_recipe(8), root, workers=2, table=TABLE)
    assert caught.value.exit_code == 4
    assert not (root / "manifest.json").exists()
    assert len(list((root / "stages/observe").iterdir())) == 2
    assert health.status(root).to_dict()["quarantined"] == ["00001.json"]
    command = str(caught.value).split("replay with: ")[1].split()
    assert command[1:3] == ["-m", "dapdata.pipeline"]
    monkeypatch.setenv("TOY_FAULT", "none:-1")
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=ENVIRONMENT | {"TOY_FAULT": "none:-1"})
    assert '"stage": "observe"' in done.stdout
    make_toy(root)
    assert manifest.read(root).content_sha256 == manifest.read(toy).content_sha256
    assert health.status(root).to_dict()["quarantined"] == []


def test_a_unit_that_dies_once_is_tried_again(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TOY_FAULT", f"kill:4:{tmp_path / 'died'}")
    root = make_toy(tmp_path / "toy", engine="local")
    assert (tmp_path / "died").exists()
    assert manifest.read(root).content_sha256 == manifest.read(toy).content_sha256
