"""One shuffled pass over a training split's superpoints: from memory, from disk by blocks, and two usual ways.

Every contender hands out the same five arrays of the same demos as torch tensors, in a random order. Memory is
filled beforehand (its cost, once, is a row of its own); files are in the page cache for all.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
import zarr
from timing import Row, chosen, compare, cpu_ms, main, rows

import dapdata
from dapdata import pipeline, recipe, rng

RECIPE = Path(__file__).parents[1] / "recipes/can_cabinet.yaml"
DEMOS, SHARD = {"quick": 12, "normal": 100, "long": 500}, 25
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

    def from_memory() -> object:
        return [in_memory[int(i)] for i in order]

    def from_npz() -> object:
        found = []
        for i in order:
            with np.load(root.parent / f"{i}.npz") as arrays:
                found.append({name: torch.from_numpy(arrays[name]) for name in arrays.files})
        return found

    contenders = {
        "dapdata": from_memory,
        "block-shuffled": lambda: list(stream),
        "npz-per-demo": from_npz,
        "zarr-slices": lambda: _from_slices(root, order),
    }
    notes = {
        "dapdata": "in memory",
        "block-shuffled": "dapdata's own stream from disk",
        "zarr-slices": "a slice a demo and array",
    }
    case = f"{demos} demos, {len(PATHS)} arrays"
    kept = chosen(contenders, against)
    yield from compare("load", case, kept, rounds, lambda call: cpu_ms(call) / demos, "CPU ms/demo", notes)
    once = [cpu_ms(lambda: dataset.torch(PATHS)) / demos for _ in range(rounds)]
    yield from rows("load", case, {"  filling memory, once": once}, "CPU ms/demo")


def _from_slices(root: Path, order: np.ndarray) -> object:
    """The arrays of each demo sliced out of its shard: what the format allows, but not how to train."""
    shards = json.loads((root / "manifest.json").read_text(encoding="utf-8"))["shards"]
    groups = [zarr.open_group(root / shard["path"], mode="r") for shard in shards]
    arrays = [{path: group[path] for path in PATHS} for group in groups]
    offsets = [group["container_superpoints/offsets"][:] for group in groups]
    size = shards[0]["demos"]
    found = []
    for i in order:
        shard, row = divmod(int(i), size)
        start, stop = offsets[shard][row : row + 2]
        found.append(
            {
                path: torch.from_numpy(np.asarray(array[row] if path.startswith("pose/") else array[start:stop]))
                for path, array in arrays[shard].items()
            }
        )
    return found


if __name__ == "__main__":
    main(run)
