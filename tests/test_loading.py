"""Opening a dataset: samples, tensors, streams that share nothing and miss nothing, and one line for what is wrong."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from forging import forge_manifest
from toy_stages import toy_recipe

import dapdata
from dapdata import loading, manifest, pipeline, store, tables
from dapdata.errors import CorruptionError, FormatError, UsageError
from dapdata.records import LATER, Cloud, Demo, Labels, Superpoints, read_record, to_sample

pytest.importorskip("torch")
import torch
from torch.utils.data import DataLoader

CLOUD = ("container/points", "meta/demo")


def demos_of(samples: object) -> list[int]:
    return [int(sample["meta/demo"]) for sample in samples]  # type: ignore[attr-defined]


def test_samples_are_the_records_that_were_made(toy: Path) -> None:
    data = dapdata.open(toy)
    for sample in data:
        records = [read_record(kind, sample) for kind in (Demo, Cloud, Superpoints, Labels)]
        again = to_sample(*records)
        assert again.keys() == sample.keys()
        assert all(np.array_equal(again[path], sample[path]) for path in sample)
    assert demos_of(data) == sorted(demos_of(data))
    assert data[-1]["meta/demo"] == data[len(data) - 1]["meta/demo"]
    with pytest.raises(IndexError):
        data[len(data)]


def test_what_early_datasets_do_not_hold_is_filled_in(tiny: Path) -> None:
    for sample in dapdata.open(tiny):
        early = {path: array for path, array in sample.items() if path not in LATER}
        assert len(early) == len(sample) - 2
        again = to_sample(read_record(Demo, early))
        assert all(np.array_equal(again[path], sample[path]) for path in again)
    with pytest.raises(KeyError, match="scene/opening"):
        read_record(Demo, {path: array for path, array in early.items() if path != "scene/opening"})


def test_splits_are_a_partition(toy: Path) -> None:
    parts = [demos_of(dapdata.open(toy, split)) for split in ("train", "val", "test")]
    assert sorted(demo for part in parts for demo in part) == demos_of(dapdata.open(toy))


def test_a_dataset_knows_where_it_comes_from(toy: Path) -> None:
    data = dapdata.open(str(toy), split="train")
    assert (data.root, data.split, data.task) == (toy, "train", "can_cabinet")
    assert data.recipe["seed"] == 5
    assert data.digest == json.loads((toy / "manifest.json").read_text())["content_sha256"]


def test_a_dataset_is_shown_in_one_line(toy: Path) -> None:
    assert repr(loading.open(toy, "train")) == f"Dataset(root={toy!r}, split='train')"


def test_torch_gives_the_same_arrays(toy: Path) -> None:
    data = dapdata.open(toy)
    tensors = data.torch()
    assert len(tensors) == len(data)
    for i, sample in enumerate(data):
        assert tensors[i].keys() == sample.keys()
        assert all(np.array_equal(tensors[i][path].numpy(), array) for path, array in sample.items())
    assert dapdata.open(toy).torch(paths=CLOUD)[0].keys() == set(CLOUD)


@pytest.mark.parametrize("shuffle", [False, True])
@pytest.mark.parametrize(("world_size", "workers"), [(1, 0), (2, 2), (3, 0)])
def test_ranks_and_workers_share_nothing_and_miss_nothing(toy: Path, shuffle: bool, world_size: int, workers: int) -> None:
    data = dapdata.open(toy)
    seen = []
    for rank in range(world_size):
        stream = data.stream(shuffle, seed=4, paths=CLOUD, rank=rank, world_size=world_size, even=False)
        loader = DataLoader(stream, batch_size=None, num_workers=workers)
        seen += demos_of(loader)
    assert sorted(seen) == demos_of(data)


def test_even_streams_have_one_length_on_all_ranks(toy: Path) -> None:
    data = dapdata.open(toy)
    streams = [data.stream(True, paths=CLOUD, rank=rank, world_size=3) for rank in range(3)]
    seen = [demos_of(stream) for stream in streams]
    assert {len(part) for part in seen} == {len(data) // 3} == {len(stream) for stream in streams}
    assert len({demo for part in seen for demo in part}) == 3 * (len(data) // 3)


def test_each_pass_is_shuffled_anew_and_repeats_with_the_seed(toy: Path) -> None:
    data = dapdata.open(toy)
    stream, twin = data.stream(True, seed=1, paths=CLOUD), data.stream(True, seed=1, paths=CLOUD)
    first, second = demos_of(stream), demos_of(stream)
    assert [first, second] == [demos_of(twin), demos_of(twin)]
    assert first != second
    assert sorted(first) == sorted(second) == demos_of(data)
    assert demos_of(data.stream(paths=CLOUD)) == demos_of(data)


def test_a_stream_goes_on_in_the_middle_of_a_pass(toy: Path) -> None:
    data = dapdata.open(toy)
    stream = data.stream(True, seed=2, paths=CLOUD)
    whole = demos_of(stream) + demos_of(stream)
    half = data.stream(True, seed=2, paths=CLOUD)
    iterator = iter(half)
    before = [int(next(iterator)["meta/demo"]) for _ in range(3)]
    state = json.loads(json.dumps(half.state_dict()))
    resumed = data.stream(True, seed=2, paths=CLOUD)
    resumed.load_state_dict(state)
    assert before + demos_of(resumed) + demos_of(resumed) == whole
    with pytest.raises(UsageError, match="seed"):
        data.stream(True, seed=3).load_state_dict(state)


def test_torch_tensors_can_be_written_to(toy: Path) -> None:
    tensors = dapdata.open(toy).torch(paths=CLOUD)
    tensors[0]["container/points"] += 1.0
    assert isinstance(tensors[0]["container/points"], torch.Tensor)


# What is wrong is said in one line -------------------------------------------------------------------------


def refused(root: object, kind: type[Exception], split: str | None = None) -> str:
    with pytest.raises(kind) as caught:
        dapdata.open(root, split)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_folders_that_are_no_dataset_are_refused(tmp_path: Path) -> None:
    assert "no such folder" in refused(tmp_path / "nowhere", FormatError)
    assert "no manifest.json" in refused(tmp_path, FormatError)


def test_a_dataset_that_is_labelled_anew_while_it_is_opened_is_the_new_one(
    toy_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Never the old manifest with the new index."""
    read, todo = manifest.read_index, ["label.eps_place=0.02"]

    def late(root: Path) -> tables.Index:
        if todo:
            pipeline.label(root, [todo.pop()], engine="inline", table="toy_stages")
        return read(root)

    before = dapdata.open(toy_copy).digest
    monkeypatch.setattr(manifest, "read_index", late)
    data = dapdata.open(toy_copy)
    assert data.digest == manifest.read(toy_copy).content_sha256 != before
    assert {*data.index["shard"]} == {shard.path for shard in data.manifest.shards}


def test_other_formats_say_who_made_them_and_what_to_do(toy_copy: Path) -> None:
    forge_manifest(toy_copy, lambda tree: tree.update(format=9))
    assert "update dapdata" in refused(toy_copy, FormatError)
    forge_manifest(toy_copy, lambda tree: tree.update(format=0))
    assert f"made by dapdata {dapdata.__version__}" in refused(toy_copy, FormatError)
    forge_manifest(toy_copy, lambda tree: tree.update(format="one"))
    assert "no manifest of dapdata" in refused(toy_copy, FormatError)


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"format": 1}', "[" * 100_000])
def test_a_manifest_that_is_none_is_refused(toy_copy: Path, text: str) -> None:
    (toy_copy / "manifest.json").write_text(text)
    assert "manifest.json" in refused(toy_copy, (CorruptionError, FormatError))  # type: ignore[arg-type]


@pytest.mark.parametrize("path", ["../secret", "/etc/passwd", "a/../../b", ""])
def test_paths_that_leave_the_dataset_are_refused(toy_copy: Path, path: str) -> None:
    forge_manifest(toy_copy, lambda tree: tree["shards"][0].update(path=path))
    assert "shards.0.path" in refused(toy_copy, CorruptionError)


def test_unlabelled_datasets_and_unknown_splits_are_refused(toy: Path, tmp_path: Path) -> None:
    root = pipeline.generate(toy_recipe(2, 2), tmp_path / "bare", engine="inline", table="toy_stages")
    assert "dapdata label" in refused(root, FormatError)
    assert "did you mean 'train'" in refused(toy, UsageError, "trian")
    with pytest.raises(UsageError, match=r"did you mean 'container/points'"):
        dapdata.open(toy).torch(paths=["container/point"])


def test_a_missing_shard_is_named(toy_copy: Path) -> None:
    data = dapdata.open(toy_copy)
    shard = toy_copy / str(data.index["shard"][0])
    (shard / "zarr.json").unlink()
    with pytest.raises(CorruptionError, match=r"00000\.zarr.*dapdata verify"):
        data[0]


def test_reading_needs_neither_torch_nor_a_simulator(toy: Path) -> None:
    heavy = ("torch", "pybullet", "numba")
    code = f"import sys, dapdata; dapdata.open({str(toy)!r})[0]; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_blocks_are_read_whole_and_few_at_a_time(toy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[str] = []
    whole = store.read_block
    monkeypatch.setattr(store, "read_block", lambda folder, paths=None: reads.append(folder.name) or whole(folder, paths))
    data = dapdata.open(toy)
    list(loading.read_in_order(data, np.arange(len(data)), CLOUD))
    assert len(reads) == len(data.manifest.shards)
