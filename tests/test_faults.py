"""Damage is found and named; what fails costs its own unit; a bad disk loses nothing that was committed."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import make_toy
from toy_stages import toy_recipe

from dapdata import durable, health, manifest, pipeline, tables
from dapdata.errors import CorruptionError, LockedError, QuarantineError

TABLE = "toy_stages"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parent)}


def data_files(root: Path) -> list[Path]:
    """Every file that the manifest answers for, itself included."""
    return sorted(path for path in root.rglob("*") if path.is_file() and path.name not in (".lock", "log.jsonl"))


def unlinked(path: Path) -> Path:
    """The file, no longer sharing its bytes with another unit."""
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(data)
    return path


def test_every_flipped_byte_is_found_and_named(toy_copy: Path) -> None:
    rng = np.random.default_rng(0)
    files = [path for path in data_files(toy_copy) if path.stat().st_size and path.name != "manifest.json"]
    for path in rng.choice(np.array(files, dtype=object), 40, replace=False):
        good = unlinked(path).read_bytes()
        at, bit = int(rng.integers(len(good))), int(rng.integers(8))
        path.write_bytes(good[:at] + bytes([good[at] ^ 1 << bit]) + good[at + 1 :])
        report = health.verify(toy_copy, quick=True)
        name = path.relative_to(toy_copy).as_posix()
        unit = next((p for p in path.parents if p.parent.parent == toy_copy / "shards"), None)
        named = [unit.relative_to(toy_copy).as_posix(), path.relative_to(unit).parts[0]] if unit else [name.split("/")[-1]]
        assert not report.ok
        assert any(all(part in problem for part in named) for problem in report.problems), (name, report.problems)
        path.write_bytes(good)
    assert health.verify(toy_copy).ok


@pytest.mark.parametrize("operation", ["delete", "truncate", "empty", "swap", "add", "link"])
def test_every_file_operation_is_found_and_named(toy_copy: Path, operation: str) -> None:
    shard = toy_copy / manifest.read(toy_copy).shards[1].path
    path = unlinked(next(p for p in (shard / "container/points/c").rglob("*") if p.is_file()))
    other = unlinked(next(p for p in (shard / "container/normals/c").rglob("*") if p.is_file()))
    good = path.read_bytes()
    if operation in ("delete", "link"):
        path.unlink()
    if operation == "link":
        path.symlink_to(other)
    if operation == "truncate":
        path.write_bytes(good[:-1])
    if operation == "empty":
        path.write_bytes(b"")
    if operation == "swap":
        path.write_bytes(other.read_bytes())
        other.write_bytes(good)
    if operation == "add":
        (path.parent / "9").write_bytes(good)
    report = health.verify(toy_copy)
    assert any(shard.name in problem and "container/points" in problem for problem in report.problems)
    with pytest.raises(CorruptionError, match=r"container/points") as caught:
        report.raise_if_damaged()
    assert caught.value.exit_code == 3


def test_damage_at_the_top_is_found(toy_copy: Path) -> None:
    (toy_copy / "notes.txt").write_text("x")
    (toy_copy / "index.parquet").write_bytes(b"")
    (toy_copy / "README.md").unlink()
    problems = "\n".join(health.verify(toy_copy).problems)
    assert all(name in problems for name in ("notes.txt", "index.parquet", "README.md"))


def test_a_missing_unit_is_found(toy_copy: Path) -> None:
    found = manifest.read(toy_copy)
    shutil.rmtree(toy_copy / found.shards[0].path)
    assert any(found.shards[0].path in problem and "missing" in problem for problem in health.verify(toy_copy).problems)


def test_a_split_that_leaks_is_found(toy_copy: Path, tmp_path: Path) -> None:
    found = manifest.read(toy_copy)
    index = manifest.read_index(toy_copy)
    rows = [dict(zip(index, values)) for values in index.stream(list(index))]
    rows[1]["container_instance"], rows[1]["split"] = rows[0]["container_instance"], "test"
    rows[0]["split"] = "train"
    with tables.writer(tmp_path / "index.parquet") as leaking:
        leaking.add(rows)
    manifest.publish(toy_copy, found, {"index.parquet": tmp_path / "index.parquet", "README.md": b""})
    assert any("is in test and train" in problem for problem in health.verify(toy_copy).problems)


@pytest.mark.parametrize("change", ["another digest", "a row less", "a row more"])
def test_an_index_that_tells_of_other_demos_is_found(toy_copy: Path, tmp_path: Path, change: str) -> None:
    index = manifest.read_index(toy_copy)
    rows = [dict(zip(index, values)) for values in index.stream(list(index))]
    if change == "another digest":
        rows[2]["sha256"] = "0" * 64
    rows = rows[:-1] if change == "a row less" else [*rows, *rows[-1:]] if change == "a row more" else rows
    with tables.writer(tmp_path / "index.parquet") as other:
        other.add(rows)
    manifest.publish(toy_copy, manifest.read(toy_copy), {"index.parquet": tmp_path / "index.parquet", "README.md": b""})
    assert "index.parquet: its rows are not the demos of the shards" in health.verify(toy_copy).problems


def test_a_content_digest_that_is_wrong_is_found(toy_copy: Path) -> None:
    tree = json.loads((toy_copy / "manifest.json").read_text())
    (toy_copy / "manifest.json").write_text(json.dumps(tree | {"content_sha256": "0" * 64}))
    assert any("content_sha256" in problem for problem in health.verify(toy_copy).problems)


def test_a_damaged_cached_unit_is_not_built_upon(toy_copy: Path) -> None:
    unit = toy_copy / manifest.read(toy_copy).stages["observe"].units[0].path
    chunk = unlinked(next(p for p in (unit / "container/points/c").rglob("*") if p.is_file()))
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


def test_the_second_command_is_told_who_works(toy_copy: Path) -> None:
    with durable.lock(toy_copy), pytest.raises(LockedError, match=f"process {os.getpid()}"):
        pipeline.generate(toy_recipe(8), toy_copy, engine="inline", table=TABLE)
    assert health.verify(toy_copy).ok


def test_a_full_disk_stops_cleanly_and_resumes(toy: Path, tmp_path: Path) -> None:
    root = tmp_path / "toy"
    code = f"""
import resource, sys
from dapdata import pipeline
from toy_stages import toy_recipe
resource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000))
try:
    pipeline.generate(toy_recipe(8), {str(root)!r}, engine="inline", table="toy_stages")
except Exception as error:
    print(type(error).__name__, error.exit_code, error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=ENVIRONMENT)
    assert done.stdout.startswith("EnvironmentProblem 6")
    assert re.search(r"disk full.*about \d+ MB more are needed", done.stdout)
    assert not (root / "manifest.json").exists()
    make_toy(root)
    assert manifest.read(root).content_sha256 == manifest.read(toy).content_sha256
    assert health.verify(root).ok


def test_limits_of_this_process_are_untouched() -> None:
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] == resource.RLIM_INFINITY
