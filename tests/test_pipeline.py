"""Generate and label: the same content whatever the workers and the shards, and nothing made twice."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import toy_stages
from conftest import TINY, make_toy
from toy_stages import toy_recipe

import dapdata
from dapdata import durable, health, manifest, pipeline, recipe
from dapdata.errors import FormatError, RecipeError, UsageError
from dapdata.plan import Plan

TABLE = "toy_stages"


def content(root: Path) -> str:
    return manifest.read(root).content_sha256


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file with a line for each call of a stage from here on."""
    path = tmp_path / "calls"
    path.touch()
    monkeypatch.setenv("TOY_CALLS", str(path))
    return path


def test_content_is_the_same_for_two_workers_and_for_other_shards(toy: Path, tmp_path: Path) -> None:
    assert content(make_toy(tmp_path / "workers", workers=2, engine="local")) == content(toy)
    assert content(make_toy(tmp_path / "shards", shard_size=5)) == content(toy)


def test_content_and_bytes_are_the_same_in_any_order(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = pipeline._Command._jobs
    monkeypatch.setattr(pipeline._Command, "_jobs", lambda self, needed: dict(reversed(whole(self, needed).items())))
    other = make_toy(tmp_path / "toy")
    assert (other / "manifest.json").read_bytes() == (toy / "manifest.json").read_bytes()
    assert (other / "index.parquet").read_bytes() == (toy / "index.parquet").read_bytes()


def test_a_longer_dataset_begins_with_the_shorter_and_makes_only_what_is_missing(
    toy: Path, toy_copy: Path, calls: Path
) -> None:
    plan = pipeline.generate(toy_recipe(10), toy_copy, dry_run=True, table=TABLE)
    assert isinstance(plan, Plan)
    assert [(s.stage, s.units, s.cached, s.reasons) for s in plan.stages] == [
        ("demonstrate", 4, 2, ("demos 8 -> 10",)),
        ("observe", 4, 2, ("demos 8 -> 10",)),
    ]
    make_toy(toy_copy, 10)
    assert Counter(calls.read_text().split())["observe"] == 4  # the last unit, 6..8, is another now, and 9 is new
    short, long = dapdata.open(toy), dapdata.open(toy_copy)
    for i in range(len(short)):
        assert all(np.array_equal(long[i][path], array) for path, array in short[i].items())
        assert long.index["split"][i] == short.index["split"][i]


def test_eps_place_remakes_only_what_reads_it(toy: Path, toy_copy: Path, calls: Path) -> None:
    plan = pipeline.label(toy_copy, ["label.eps_place=0.02"], dry_run=True, table=TABLE)
    assert isinstance(plan, Plan)
    assert [(s.stage, s.cached, s.reasons) for s in plan.stages] == [
        ("cluster", 3, ()),
        ("label", 0, ("label.eps_place 0.03 -> 0.02",)),
    ]
    assert calls.read_text() == ""
    pipeline.label(toy_copy, ["label.eps_place=0.02"], engine="inline", table=TABLE)
    assert set(calls.read_text().split()) == {"label"}
    assert content(toy_copy) != content(toy)
    assert manifest.read(toy_copy).recipe["label"]["eps_place"] == 0.02
    pipeline.label(toy_copy, ["label.eps_place=0.03"], engine="inline", table=TABLE)  # the first labelling is still there
    assert content(toy_copy) == content(toy)
    freed = health.gc(toy_copy).to_dict()
    assert freed["bytes"] > 0
    assert all(path.startswith("shards/") for path in freed["removed"])
    assert health.verify(toy_copy).ok


def test_noise_remakes_observe_and_no_physics(toy_copy: Path, calls: Path) -> None:
    changed = toy_recipe(8, noise={"preset": "none"})
    plan = pipeline.generate(changed, toy_copy, dry_run=True, table=TABLE)
    assert isinstance(plan, Plan)
    assert [s.reasons for s in plan.stages] == [(), ("noise.preset d415 -> none",)]
    pipeline.generate(changed, toy_copy, engine="inline", table=TABLE)
    assert set(calls.read_text().split()) == {"observe"}
    with pytest.raises(FormatError, match="not labelled"):
        dapdata.open(toy_copy)
    plan = pipeline.label(toy_copy, dry_run=True, table=TABLE)
    assert isinstance(plan, Plan)
    assert plan.stages[1].reasons == ("cluster runs again",)


def test_nothing_to_do_changes_nothing(toy_copy: Path, calls: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in toy_copy.rglob("*") if path.is_file() and path.name != ".lock"}
    make_toy(toy_copy)
    assert calls.read_text() == ""
    assert {path: path.stat().st_mtime_ns for path in toy_copy.rglob("*") if path.is_file() and path.name != ".lock"} == before


def test_fresh_makes_all_again(toy: Path, toy_copy: Path, calls: Path) -> None:
    pipeline.generate(toy_recipe(8), toy_copy, engine="inline", fresh=True, table=TABLE)
    assert Counter(calls.read_text().split())["observe"] == 8
    assert not list((toy_copy / "shards").glob("*/*"))
    pipeline.label(toy_copy, engine="inline", table=TABLE)
    assert content(toy_copy) == content(toy)


def test_rejects_are_counted_by_reason_and_absent_from_the_shards(toy: Path) -> None:
    found = manifest.read(toy)
    assert found.rejects.attempts.keys() == {"no_free_slot"}
    absent = sum(found.rejects.demos.values())
    assert absent > 0
    assert found.rejects.demos.keys() == {"empty_cloud"}
    data = dapdata.open(toy)
    assert len(data) == found.demos - absent
    assert sum(found.rejects.attempts.values()) >= sum(int(sample["meta/attempts"]) - 1 for sample in data)
    assert sum(found.rejects.goals.values()) >= int(data.index["rejected_goals"].sum()) > 0


def test_the_manifest_names_every_file_with_its_hash(toy: Path) -> None:
    report = health.verify(toy)
    assert report.ok, report
    count = sum(1 for path in toy.rglob("*") if path.is_file() and path.name not in (".lock", "log.jsonl", "manifest.json"))
    roots = len({unit.path for stage in manifest.read(toy).stages.values() for unit in stage.units})
    assert report.files + roots == count


def test_shards_take_upstream_files_as_they_are(toy: Path) -> None:
    shards = [toy / shard.path for shard in manifest.read(toy).shards]
    assert any((shard / "pose/T_world_container/zarr.json").stat().st_nlink > 1 for shard in shards)


def test_a_demo_that_never_comes_about_is_an_error_that_names_the_rejects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    never = replace(toy_stages.STAGES[0], run=lambda *_: toy_stages.Rejected("no_free_slot"))
    monkeypatch.setattr(toy_stages, "STAGES", (never, *toy_stages.STAGES[1:]))
    with pytest.raises(UsageError, match=r"toy: no demo 0 after 50 attempts \(no_free_slot 50\).*widen"):
        pipeline.generate(toy_recipe(), tmp_path / "toy", engine="inline", table=TABLE)
    assert not (tmp_path / "toy").exists(), "a recipe that admits no demo leaves no trace"


def test_a_dataset_whose_demos_are_all_rejected_is_an_error_that_names_the_rejects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blind = replace(toy_stages.STAGES[1], run=lambda *_: toy_stages.Rejected("too_few_object_points"))
    monkeypatch.setattr(toy_stages, "STAGES", (toy_stages.STAGES[0], blind, *toy_stages.STAGES[2:]))
    with pytest.raises(UsageError, match=r"all 6 demos were rejected \(too_few_object_points 6\).*change cameras"):
        pipeline.generate(toy_recipe(), tmp_path / "toy", engine="inline", table=TABLE)
    with pytest.raises(UsageError, match="all 6 demos were rejected"):
        pipeline.label(tmp_path / "toy", engine="inline", table=TABLE)
    assert health.verify(tmp_path / "toy").ok
    assert manifest.read(tmp_path / "toy").shards == []


def test_labelling_refuses_what_it_cannot_change(toy: Path) -> None:
    with pytest.raises(UsageError, match=r"noise.*dapdata generate"):
        pipeline.label(toy, ["noise.preset=none"], table=TABLE)
    with pytest.raises(UsageError, match=r"demos.*dapdata generate"):
        pipeline.label(toy, ["demos=9"], table=TABLE)
    with pytest.raises(RecipeError, match="eps_place"):
        pipeline.label(toy, ["label.eps_place=30"], table=TABLE)


def test_somebodys_folder_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(FormatError, match="no dataset"):
        pipeline.generate(toy_recipe(), tmp_path, engine="inline", table=TABLE)
    with pytest.raises(FormatError, match="a file"):
        pipeline.generate(toy_recipe(), tmp_path / "thesis.tex", engine="inline", table=TABLE)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_dry_run_writes_nothing(tmp_path: Path) -> None:
    plan = pipeline.generate(toy_recipe(), tmp_path / "toy", dry_run=True, table=TABLE)
    assert "demonstrate: 2 of 2 units run (6 demos): demonstrate was not run here before" in str(plan)
    assert not list(tmp_path.iterdir())


def test_previews_join_the_manifest_and_the_card(toy_copy: Path, toy: Path) -> None:
    pipeline.attach(toy_copy, {"preview/goals.png": b"a picture"})
    assert "preview/goals.png" in manifest.read(toy_copy).files
    assert "](preview/goals.png)" in (toy_copy / "README.md").read_text()
    assert health.verify(toy_copy).ok
    make_toy(toy_copy)
    assert "preview/goals.png" in manifest.read(toy_copy).files
    assert content(toy_copy) == content(toy)


def test_true_demos_depend_on_recipe_seed_and_index_alone(tiny: Path, tmp_path: Path) -> None:
    fewer = recipe.from_resolved({**TINY, "demos": 2, "shard_size": 1, "name": "other"})
    root = pipeline.generate(fewer, tmp_path / "tiny", workers=2)
    assert isinstance(root, Path)
    pipeline.label(root)
    part, whole = dapdata.open(root), dapdata.open(tiny)
    assert part.index["sha256"].tolist() == whole.index["sha256"][:2].tolist()
    assert part.index["split"].tolist() == whole.index["split"][:2].tolist()


def test_status_and_inspect_tell_what_is_there(toy: Path) -> None:
    status, inside = health.status(toy).to_dict(), health.inspect(toy).to_dict()
    assert json.loads(json.dumps([status, inside]))
    assert status["published"]["units"] == {"demonstrate": 3, "observe": 3, "cluster": 3, "label": 3}
    assert inside["demos_in_shards"] == sum(inside["splits"].values())
    assert inside["per_demo"]["superpoints"]["mean"] == 12.0


def test_status_counts_the_units_that_are_there_and_not_those_of_other_settings(
    toy_copy: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("TOY_FAULT", "nan:4")
    changed = toy_stages.toy_recipe(8, 3, noise={"preset": "kinect"})
    with pytest.raises(Exception, match="a stage that failed"):
        pipeline.generate(changed, toy_copy, engine="inline", table="toy_stages")
    (toy_copy / "log.jsonl").unlink()  # whoever is killed writes no log
    assert health.status(toy_copy).to_dict()["in_progress"]["done"] == {"demonstrate": 3, "observe": 1}
    (toy_copy / "progress.json").write_text("{")
    assert health.status(toy_copy).to_dict()["in_progress"] is None


def test_status_says_who_works(toy_copy: Path) -> None:
    assert health.status(toy_copy).to_dict()["working"] is None
    with durable.lock(toy_copy):
        assert f"process {os.getpid()}" in health.status(toy_copy).to_dict()["working"]


@pytest.mark.slow
def test_memory_is_flat_in_the_number_of_demos(tmp_path: Path) -> None:
    """In a process of its own: workers begin with the memory of the one that forks them, whatever it imported before."""
    make = "import sys, pathlib, conftest; conftest.make_toy(pathlib.Path(sys.argv[1]), int(sys.argv[2]), 10, engine='local')"
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    peaks = []
    for demos in (10, 300):
        root = tmp_path / str(demos)
        command = [sys.executable, "-c", make, root, str(demos)]
        subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": path})
        peaks.append(health.status(root).to_dict()["peak_mb"])
    assert peaks[1] - peaks[0] < 50
    assert max(peaks) < 600


def test_no_bytes_are_lost_when_a_dataset_is_copied(toy: Path, tmp_path: Path) -> None:
    assert health.verify(shutil.copytree(toy, tmp_path / "elsewhere")).ok
