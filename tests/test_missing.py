"""--allow-missing: a dataset is published without the units that failed, and says so; nothing is, without it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import toy_stages
from conftest import make_toy

import dapdata
from dapdata import engines, health, manifest, pipeline
from dapdata.errors import QuarantineError
from dapdata.plan import Plan

TABLE = "toy_stages"


def generate(root: Path, demos: int = 8, **more: object) -> None:
    pipeline.generate(toy_stages.toy_recipe(demos), root, table=TABLE, **more)  # type: ignore[arg-type]


@pytest.fixture(autouse=True)
def one_try_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "RETRIES", 0)


@pytest.fixture
def fails(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Sets what happens at which demo, such as "abort:4"; "" for nothing."""
    return lambda fault: monkeypatch.setenv("TOY_FAULT", fault or "none:-1")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A labelled dataset whose middle unit, demos 3 to 5, failed in `observe`. Not to be changed."""
    root = tmp_path_factory.mktemp("partial") / "toy"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TOY_FAULT", "abort:4")
        patch.setattr(engines, "RETRIES", 0)
        with pytest.raises(QuarantineError, match="with --allow-missing to do without them") as caught:
            generate(root)
        assert caught.value.exit_code == 4
        assert not (root / "manifest.json").exists(), "nothing partial is published without --allow-missing"
        generate(root, allow_missing=True)
    pipeline.label(root, engine="inline", table=TABLE)
    return root


@pytest.fixture
def partial(built: Path, tmp_path: Path) -> Path:
    """A copy of it that a test may change."""
    return Path(shutil.copytree(built, tmp_path / "toy"))


def test_the_manifest_names_the_missing_demos_and_why(built: Path, toy: Path) -> None:
    found = manifest.read(built)
    assert [entry.model_dump() for entry in found.missing] == [
        {"demo_range": (3, 6), "stage": "observe", "reason": "killed by SIGABRT"}
    ]
    assert [shard.demo_range for shard in found.shards] == [(0, 3), (6, 8)]
    assert [len(found.stages[name].units) for name in ("demonstrate", "observe", "label")] == [3, 2, 2]
    assert "demos 3 to 5, which could not be made | killed by SIGABRT | 3" in (built / "README.md").read_text()
    assert manifest.read(toy).missing == []


def test_verify_loading_and_inspect_cope_with_missing_demos(built: Path, toy: Path) -> None:
    audit = health.verify(built)
    assert audit.ok, audit
    assert any(note.startswith("demos 3 to 5 are missing: observe failed: killed by SIGABRT") for note in audit.notes)
    assert health.inspect(built).to_dict()["missing"] == ["3 to 5: killed by SIGABRT"]
    part, whole = dapdata.open(built), dapdata.open(toy)
    there = [int(demo) for demo in whole.index["demo"] if not 3 <= demo < 6]
    assert part.index["demo"].tolist() == there
    assert len(list(part)) == sum(shard.demos for shard in part.manifest.shards) == len(there)
    digests = dict(zip(whole.index["demo"].tolist(), whole.index["sha256"].tolist()))
    assert part.index["sha256"].tolist() == [digests[demo] for demo in there]


def test_a_plain_command_makes_what_was_missing(partial: Path, toy: Path) -> None:
    plan = pipeline.generate(toy_stages.toy_recipe(8), partial, dry_run=True, table=TABLE)
    assert isinstance(plan, Plan)
    assert [(stage.stage, stage.units - stage.cached) for stage in plan.stages] == [("demonstrate", 0), ("observe", 1)]
    make_toy(partial)
    assert (partial / "manifest.json").read_bytes() == (toy / "manifest.json").read_bytes()
    assert health.verify(partial).ok


def test_what_fails_again_leaves_the_dataset_as_it_was_published(partial: Path, fails: Callable[[str], None]) -> None:
    before = (partial / "manifest.json").read_bytes()
    fails("raise:4")
    with pytest.raises(QuarantineError, match="1 of 1 units failed"):
        generate(partial)
    assert (partial / "manifest.json").read_bytes() == before


def test_a_label_that_fails_costs_no_simulation(
    toy_copy: Path, toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TOY_LABEL_FAULT", "raise:4")
    changes = ["superpoints.count=100"]
    with pytest.raises(QuarantineError, match=r"unit 1 .*ValueError: a stage that failed"):
        pipeline.label(toy_copy, changes, table=TABLE)
    assert manifest.read(toy_copy).content_sha256 == manifest.read(toy).content_sha256
    pipeline.label(toy_copy, changes, allow_missing=True, table=TABLE)
    found = manifest.read(toy_copy)
    assert [(entry.demo_range, entry.stage) for entry in found.missing] == [((3, 6), "label")]
    assert [len(found.stages[name].units) for name in ("demonstrate", "observe", "cluster", "label")] == [3, 3, 3, 2]
    health.gc(toy_copy)
    assert health.verify(toy_copy).ok
    monkeypatch.delenv("TOY_LABEL_FAULT")
    monkeypatch.setenv("TOY_CALLS", str(tmp_path / "calls"))
    pipeline.label(toy_copy, changes, engine="inline", table=TABLE)
    assert set((tmp_path / "calls").read_text().split()) == {"label"}
    assert manifest.read(toy_copy).missing == []


def test_a_dataset_of_nothing_is_not_published(tmp_path: Path, fails: Callable[[str], None]) -> None:
    fails("raise:1")
    with pytest.raises(QuarantineError, match=r"all units failed \(ValueError: a stage that failed\)"):
        generate(tmp_path / "toy", 2, allow_missing=True)
    assert not (tmp_path / "toy/manifest.json").exists()


def test_the_last_of_several_tasks_publishes_what_there_is(tmp_path: Path, fails: Callable[[str], None]) -> None:
    root = tmp_path / "toy"
    fails("raise:4")
    generate(root, units="1/3", allow_missing=True)
    generate(root, units="2/3", allow_missing=True)
    assert not (root / "manifest.json").exists()
    generate(root, units="0/3", allow_missing=True)
    assert [entry.demo_range for entry in manifest.read(root).missing] == [(3, 6)]
    assert health.verify(root).ok


def test_a_reason_of_other_settings_does_not_count(tmp_path: Path, fails: Callable[[str], None]) -> None:
    root = tmp_path / "toy"
    fails("raise:4")
    generate(root, units="1/3", allow_missing=True)
    other = toy_stages.toy_recipe(8, noise={"preset": "none"})
    for part in ("0/3", "2/3"):
        pipeline.generate(other, root, units=part, allow_missing=True, engine="inline", table=TABLE)
    assert not (root / "manifest.json").exists()
