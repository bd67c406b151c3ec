"""One shuffled pass over a dataset's superpoints in padded batches: from memory, from disk by blocks, and two usual ways.

Every contender reads the same five arrays of the same demos as torch tensors, in a random order, and the same
function pads them to batches of 16. Memory is filled beforehand (its cost, once, is a row of its own); files are in the
page cache for all.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import torch
import zarr
from timing import Row, chosen, compare, cpu_ms, main, rows
from torch.nn.utils.rnn import pad_sequence

import dapdata
from dapdata import pipeline, recipe, rng

RECIPE = Path(__file__).parents[1] / "recipes/can_cabinet.yaml"
DEMOS, SHARD = {"quick": 12, "normal": 100, "long": 500}, 25
BATCH = 16
Sample = dict[str, torch.Tensor]
PATHS = [f"container_superpoints/{name}" for name in ("points", "normals", "size", "affordance")] + ["pose/T_world_object_goal"]


def run(scale: str, against: str | None) -> Iterator[Row]:
    demos = DEMOS[scale]
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "dataset"
        changes = [f"demos={demos}", f"shard_size={min(SHARD, demos)}", "split.val=0", "split.test=0"]
        pipeline.generate(recipe.load(RECIPE, changes), root)
        pipeline.label(root)
        yield from _measure(root, demos, against, 3 if scale == "quick" else 15)


def _measure(root: Path, demos: int, against: str | None, rounds: int) -> Iterator[Row]:
    dataset = dapdata.open(root)
    order = rng.stream(0, "benchmark", 0).permutation(demos)
    for i, sample in enumerate(dataset):
        np.savez(root.parent / f"{i}.npz", **{path.replace("/", "."): sample[path] for path in PATHS})
    in_memory, stream = dataset.torch(PATHS), dataset.stream(shuffle=True, paths=PATHS)

    contenders = {
        "dapdata": lambda: batches(in_memory[int(i)] for i in order),
        "block-shuffled": lambda: batches(stream),
        "npz-per-demo": lambda: batches(from_npz(root.parent, order)),
        "zarr-slices": lambda: batches(from_slices(root, order)),
    }
    notes = {
        "dapdata": "in memory",
        "block-shuffled": "dapdata's own stream from disk",
        "zarr-slices": "a slice a demo and array",
    }
    case = f"{demos} demos, {len(PATHS)} arrays, batches of {BATCH}"
    kept = chosen(contenders, against)
    yield from compare("load", case, kept, rounds, lambda call: cpu_ms(call) / demos, "CPU ms/demo", notes)
    once = [cpu_ms(lambda: dataset.torch(PATHS)) / demos for _ in range(rounds)]
    yield from rows("load", case, {"  filling memory, once": once}, "CPU ms/demo")


def batches(samples: Iterable[Sample]) -> int:
    """Pads samples to batches of (B, S, ...) and returns how many tensors there were."""
    rest, made = iter(samples), 0
    while batch := list(islice(rest, BATCH)):
        made += len([pad_sequence([sample[path] for sample in batch], batch_first=True) for path in PATHS])
    return made


def from_npz(folder: Path, order: np.ndarray) -> Iterator[Sample]:
    """The arrays of each demo from a file of its own."""
    for i in order:
        with np.load(folder / f"{i}.npz") as arrays:
            yield {name.replace(".", "/"): torch.from_numpy(arrays[name]) for name in arrays.files}


def from_slices(root: Path, order: np.ndarray) -> Iterator[Sample]:
    """The arrays of each demo sliced out of its shard: what the format allows, but not how to train."""
    shards = json.loads((root / "manifest.json").read_text(encoding="utf-8"))["shards"]
    groups = [zarr.open_group(root / shard["path"], mode="r") for shard in shards]
    arrays = [{path: group[path] for path in PATHS} for group in groups]
    offsets = [group["container_superpoints/offsets"][:] for group in groups]
    for i in order:
        shard, row = divmod(int(i), shards[0]["demos"])
        start, stop = offsets[shard][row : row + 2]
        yield {
            path: torch.from_numpy(np.asarray(array[row] if path.startswith("pose/") else array[start:stop]))
            for path, array in arrays[shard].items()
        }


if __name__ == "__main__":
    main(run)
