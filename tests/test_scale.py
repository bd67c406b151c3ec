"""Large datasets: their manifest keeps its units in a table, and costs next to nothing to open, plan and check."""

from __future__ import annotations

import importlib
import json
import pickle
import shutil
from pathlib import Path
from types import ModuleType

import jsonschema
import numpy as np
import pytest
from conftest import make_toy
from forging import forge_manifest

import dapdata
from dapdata import audit, health, loading, manifest, pipeline, recipe, store, tables
from dapdata.errors import CorruptionError, FormatError
from dapdata.schemas import schema

TABLE = "toy_stages"
BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture(scope="session")
def made_large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy dataset, made as if it were large. Not to be changed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(manifest, "LARGE", 0)
        return make_toy(tmp_path_factory.mktemp("large") / "large")


@pytest.fixture
def large(made_large: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it that a test may damage, or make anew."""
    monkeypatch.setattr(manifest, "LARGE", 0)
    return Path(shutil.copytree(made_large, tmp_path / "large"))


def tree_of(root: Path) -> dict:
    return json.loads((root / "manifest.json").read_text())


def test_a_large_dataset_holds_what_a_small_one_holds(toy: Path, large: Path) -> None:
    assert (tree_of(toy)["format"], tree_of(large)["format"]) == (1, 2)
    small, found = manifest.read(toy), manifest.read(large)
    assert list(found.shards) == list(small.shards)
    assert found.shards[-1] == small.shards[-1]
    assert list(found.shards[:2]) == list(small.shards[:2])
    assert {name: list(stage.units) for name, stage in found.stages.items()} == {
        name: list(stage.units) for name, stage in small.stages.items()
    }
    assert found.content_sha256 == small.content_sha256
    assert (large / "index.parquet").read_bytes() == (toy / "index.parquet").read_bytes()
    for a, b in zip(dapdata.open(large, "train"), dapdata.open(toy, "train"), strict=True):
        assert all(np.array_equal(a[path], b[path]) for path in a.keys() | b.keys())


def test_a_large_manifest_keeps_its_promises_to_strangers(toy: Path, large: Path) -> None:
    jsonschema.Draft202012Validator(schema("manifest")).validate(tree_of(large))
    short = [{name: shard[name] for name in ("path", "demos", "sha256")} for shard in tree_of(toy)["shards"]]
    assert tree_of(large)["shards"] == short
    assert "units.parquet" in tree_of(large)["files"]


def test_commands_tell_the_same_of_a_large_dataset(toy: Path, large: Path) -> None:
    for command in (health.status, health.inspect):
        told = [command(root).to_dict() for root in (toy, large)]
        assert told[0].keys() == told[1].keys()
        same = told[0].keys() - {"root", "cpu_seconds", "peak_mb"}
        assert {name: told[0][name] for name in same} == {name: told[1][name] for name in same}
    audit = health.verify(large)
    assert audit.ok, audit.problems
    assert audit.demos == health.verify(toy).demos
    assert audit.files == health.verify(toy).files + 1
    assert health.gc(large).to_dict()["removed"] == []


def test_a_large_dataset_is_labelled_again_and_grows_and_shrinks_back(large: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = manifest.read(large).content_sha256
    pipeline.label(large, ["label.eps_place=0.02"], engine="inline", table=TABLE)
    assert health.verify(large).ok
    assert manifest.read(large).content_sha256 != first
    plan = pipeline.label(large, ["label.eps_place=0.03"], engine="inline", table=TABLE, dry_run=True)
    assert "label: nothing to do, all 3 units are there" in str(plan)
    pipeline.label(large, ["label.eps_place=0.03"], engine="inline", table=TABLE)
    assert manifest.read(large).content_sha256 == first
    monkeypatch.setattr(manifest, "LARGE", 100)
    make_toy(large)
    assert tree_of(large)["format"] == 1
    assert not (large / "units.parquet").exists()
    assert health.verify(large).ok


def test_pictures_are_attached_to_a_large_dataset(large: Path) -> None:
    pipeline.attach(large, {"preview/a.png": b"picture"})
    assert "preview/a.png" in manifest.read(large).files
    assert tree_of(large)["format"] == 2
    assert health.verify(large).ok


def test_every_flipped_byte_of_the_tables_is_found_and_named(large: Path) -> None:
    rng = np.random.default_rng(1)
    for name in ("units.parquet", "index.parquet"):
        good = (large / name).read_bytes()
        for at in rng.integers(0, len(good), 8):
            (large / name).write_bytes(good[:at] + bytes([good[at] ^ 4]) + good[at + 1 :])
            problems = health.verify(large, quick=True).problems
            assert any(name in problem for problem in problems), (name, at)
        (large / name).write_bytes(good)
    assert health.verify(large, quick=True).ok


@pytest.mark.parametrize("change", ["missing", "empty", "short", "outside"])
def test_a_table_of_units_that_is_none_is_damage_and_never_a_traceback(large: Path, change: str) -> None:
    path = large / "units.parquet"
    rows = [manifest.unit_row("label", entry) for entry in manifest.read(large).shards]
    if change == "missing":
        path.unlink()
    elif change == "empty":
        path.write_bytes(b"")
    else:
        with tables.writer(path) as made:
            made.add(rows[:-1] if change == "short" else [{**row, "path": "../elsewhere"} for row in rows])
    report = health.verify(large)
    assert any("units.parquet" in problem for problem in report.problems)
    with pytest.raises(CorruptionError, match=r"units\.parquet"):
        list(manifest.read(large).shards)


def test_shards_listed_otherwise_than_in_the_table_are_found(large: Path) -> None:
    forge_manifest(large, lambda tree: tree["shards"][0].update(path="shards/other/00000.zarr"))
    assert "manifest.json: the shards are not the units of a stage" in health.verify(large).problems


# The index -------------------------------------------------------------------------------------------------


def test_columns_are_read_when_they_are_asked_for(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[str] = []
    read = tables.Index._column
    monkeypatch.setattr(tables.Index, "_column", lambda self, name: reads.append(name) or read(self, name))
    data = dapdata.open(toy, "train")
    assert len(data) > 0
    assert reads == ["split"]
    assert data.index["demo"].dtype == np.int64
    assert (data.index["demo"] is data.index["demo"], data.index["task"][0]) == (True, "can_cabinet")
    assert reads == ["split", "demo", "task"]


def test_an_index_of_some_rows_is_the_whole_with_those_rows(toy: Path) -> None:
    index = manifest.read_index(toy)
    odd = np.arange(1, index.rows, 2)
    some = index.only(odd)
    assert {name: some[name].tolist() for name in some} == {name: index[name][odd].tolist() for name in index}
    assert some.only(np.array([1]))["demo"].tolist() == [index["demo"][3]]
    assert list(index.stream(["demo", "split"])) == list(zip(index["demo"].tolist(), index["split"].tolist()))


def test_a_dataset_that_is_sent_to_a_worker_takes_no_columns_along(toy: Path) -> None:
    data = dapdata.open(toy, "train")
    before = len(pickle.dumps(data))
    assert data.index["sha256"].tolist()
    assert len(pickle.dumps(data)) == before
    assert pickle.loads(pickle.dumps(data)).index["sha256"].tolist() == data.index["sha256"].tolist()


def test_an_index_that_was_replaced_is_not_mixed_with_the_old_one(toy_copy: Path) -> None:
    data = dapdata.open(toy_copy)
    rows = [dict(zip(data.index, row)) for row in data.index.stream(list(data.index))]
    with tables.writer(toy_copy / "index.parquet") as made:
        made.add(rows[:-1])
    with pytest.raises(FormatError, match="open the dataset again"):
        data.index["demo"]


def test_a_table_that_unpacks_to_far_more_than_its_bytes_is_refused_before_it_does(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    count = 2_000_000
    bombs = {
        "rows": pa.table({"demo": np.zeros(count, np.int64)}),
        "columns": pa.table({f"column {i}": [i] for i in range(200)}),
        "words": pa.table({"demo": ["a" * 5000, "b"]}),
    }
    for name, bomb in bombs.items():
        pq.write_table(bomb, tmp_path / name, compression="zstd")
        with pytest.raises(CorruptionError, match=f"{name}: cannot be read .*(rows of|words of)"):
            tables.Index(tmp_path / name)["demo"]
    with pytest.raises(CorruptionError, match="2000000 rows of 1 columns"):
        tables.read(tmp_path / "rows", "demo", "0")


def test_a_table_does_not_depend_on_how_its_rows_came(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "GROUP_ROWS", 16)
    rows = [{"demo": i, "shard": f"shards/{i // 5}"} for i in range(53)]
    for name, step in (("a", 1), ("b", 7), ("c", 53)):
        with tables.writer(tmp_path / name) as made:
            for start in range(0, len(rows), step):
                made.add(rows[start : start + step])
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes() == (tmp_path / "c").read_bytes()
    words = np.array([f"word {i % 3}" for i in range(53)], dtype=object)
    tables.insert_words(tmp_path / "a", tmp_path / "d", "word", words, 1)
    expected = [(row["demo"], word, row["shard"]) for row, word in zip(rows, words)]
    assert list(tables.Index(tmp_path / "d").stream(["demo", "word", "shard"])) == expected
    assert tables.Index(tmp_path / "d")["word"].tolist() == words.tolist()


def test_a_shuffled_stream_mixes_shards_whose_codes_are_not_in_row_order(toy: Path) -> None:
    data = dapdata.open(toy)
    mixed = np.argsort(data.index["row"], kind="stable")[::-1]  # the last row of each shard first
    across = loading.Dataset(data.root, None, data.manifest, data.index.only(mixed))
    order = loading.Order(across, True, 0, 0, 1, True)
    blocks = [across.index["shard"][block].tolist() for block in order._blocks]
    assert [set(block) for block in blocks] == [{shard} for shard in dict.fromkeys(data.index["shard"])]
    assert sorted(order.numbers(0).tolist()) == list(range(len(data)))


def test_units_are_found_by_listing_their_folder_once(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listed: list[str] = []
    scandir = store.os.scandir
    monkeypatch.setattr(store.os, "scandir", lambda path: listed.append(Path(path).name) or scandir(path))
    monkeypatch.setattr(store, "is_committed", lambda folder: pytest.fail("a look at every unit"))
    plan = pipeline.label(toy, engine="inline", table=TABLE, dry_run=True)
    assert all(stage.cached == stage.units == 3 for stage in plan.stages)
    assert listed.count("cluster") == 1


def test_a_unit_that_is_gone_is_missed(toy_copy: Path) -> None:
    shutil.rmtree(toy_copy / manifest.read(toy_copy).stages["cluster"].units[1].path)
    plan = pipeline.label(toy_copy, engine="inline", table=TABLE, dry_run=True)
    assert [(stage.stage, stage.cached) for stage in plan.stages] == [("cluster", 2), ("label", 3)]


# What the page on scale is made with -----------------------------------------------------------------------


@pytest.fixture
def scale(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("scale")


def test_a_simulated_cluster_takes_its_units_in_turns(scale: ModuleType) -> None:
    assert scale.simulate(count=10, seconds=3.0, workers=5, start=1.0) == 7.0
    assert scale.simulate(count=11, seconds=3.0, workers=5, start=1.0) == 10.0
    assert scale.simulate(count=2, seconds=3.0, workers=5, start=1.0) == 4.0


def test_a_lost_worker_costs_its_unit_and_a_start(scale: ModuleType) -> None:
    alone = scale.simulate(count=4, seconds=10.0, workers=1, start=2.0, lost_at=17.0, lost=1)
    assert alone == 17.0 + 2.0 + 3 * 10.0  # one unit was done, the second is lost 5 s after it was begun
    assert scale.simulate(count=4, seconds=10.0, workers=1, start=2.0, lost_at=99.0, lost=1) == 42.0
    assert scale.simulate(count=100, seconds=10.0, workers=10, start=0.0, lost_at=55.0, lost=1) == 105.0
    assert scale.simulate(count=8, seconds=10.0, workers=2, start=0.0, lost_at=15.0, lost=1, replaced=False) == 70.0


def test_a_synthetic_dataset_opens_and_plans_like_a_true_one(scale: ModuleType, tmp_path: Path) -> None:
    root, count = tmp_path / "synthetic", 100
    scale.write_synthetic(root, 50_000, 500)
    assert tree_of(root)["format"] == 2
    assert len(manifest.read(root).shards) == count
    assert len(dapdata.open(root)) == 50_000
    assert health.inspect(root).to_dict()["demos_in_shards"] == 50_000
    assert audit.unnamed(root, manifest.read(root)) == []
    plan = pipeline.generate(recipe.from_resolved(manifest.read(root).recipe), root, dry_run=True)
    assert {stage.cached for stage in plan.stages} == {count}
    scale._lose_a_tenth(root, "observe")
    plan = pipeline.generate(recipe.from_resolved(manifest.read(root).recipe), root, dry_run=True)
    assert [(stage.stage, stage.units - stage.cached) for stage in plan.stages] == [
        ("demonstrate", 0),
        ("observe", count // 10),
    ]


def test_publishing_is_measured_on_units_that_it_accepts(scale: ModuleType) -> None:
    found = scale.publish(40, 20)
    assert found["cpu"] > 0
    assert found["peak_mb"] > 50


@pytest.mark.slow
def test_ten_million_demos_open_in_two_seconds_and_a_gigabyte(scale: ModuleType, tmp_path: Path) -> None:
    """CPU seconds: other work on the machine is not at fault."""
    root = tmp_path / "synthetic"
    scale.write_synthetic(root, 10_000_000, 500)
    for what in ("read", "index", "open", "train", "plan"):
        found = scale.measured(what, root)
        assert found["cpu"] < 2, (what, found)
        assert found["peak_mb"] < 1000, (what, found)


@pytest.mark.slow
def test_publishing_needs_no_more_memory_for_more_demos(scale: ModuleType) -> None:
    few, many = (scale.published(demos, 500) for demos in (20_000, 100_000))
    assert many["peak_mb"] - few["peak_mb"] < 150
    assert many["cpu"] / 100_000 < 2e-4
