"""Bytes of a demo on disk, and what other codecs would make of the same arrays: size, CPU ms to encode, CPU ms to decode.

All columns of one shard go through zarr's codec pipeline in memory, a chunk an array, with the checksum that is always
last. The named figures are what RPDiff's own generator writes for a demo, without labels.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from timing import Row, main, published, rows
from zarr.codecs import BloscCodec, Crc32cCodec, GzipCodec, ZstdCodec

from dapdata import manifest, pipeline, recipe, store

RECIPES = Path(__file__).parents[1] / "recipes"
DEMOS = {"quick": 5, "normal": 25, "long": 50}
RPDIFF_KB = {"can_cabinet": 7000.0, "book_shelf": 13500.0}
CODECS: dict[str, list[Any]] = {
    "dapdata": [ZstdCodec(level=store.ZSTD_LEVEL)],
    "zstd-5": [ZstdCodec(level=5)],
    "zstd-19": [ZstdCodec(level=19)],
    "blosc-zstd": [BloscCodec(cname="zstd", clevel=3, shuffle="bitshuffle")],
    "blosc-lz4": [BloscCodec(cname="lz4", clevel=5, shuffle="shuffle")],
    "gzip": [GzipCodec(level=5)],
    "uncompressed": [],
}


def arrays_of(task: str, demos: int) -> tuple[list[np.ndarray], float]:
    """All columns of a shard, and the kB a demo that its files have, metadata included."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / task
        pipeline.generate(
            recipe.load(RECIPES / f"{task}.yaml", [f"demos={demos}", f"shard_size={demos}"]), root, engine="inline"
        )
        pipeline.label(root, engine="inline")
        shard = root / manifest.read(root).shards[0].path
        size = sum(path.stat().st_size for path in shard.rglob("*") if path.is_file())
        return [array for array in store.read_block(shard).arrays.values() if array.size], size / 1e3 / demos


def encode(arrays: list[np.ndarray], codecs: list[Any], demos: int) -> tuple[float, float, float]:
    """kB a demo, and CPU ms a demo to encode and to decode."""
    memory: dict[str, Any] = {}
    group = zarr.group(zarr.storage.MemoryStore(memory))
    start = time.process_time()
    made = [
        group.create_array(f"a{i}", data=array, chunks=array.shape, compressors=[*codecs, Crc32cCodec()])
        for i, array in enumerate(arrays)
    ]
    encoded = time.process_time()
    for array in made:
        array[...]
    decoded = time.process_time()
    size = sum(len(value) for name, value in memory.items() if not name.endswith("zarr.json"))
    return size / 1e3 / demos, (encoded - start) * 1e3 / demos, (decoded - encoded) * 1e3 / demos


def run(scale: str, against: str | None) -> Iterator[Row]:
    demos, rounds = DEMOS[scale], 2 if scale == "quick" else 5
    kept = {name: codecs for name, codecs in CODECS.items() if name == "dapdata" or against in (None, name)}
    for task, rpdiff in RPDIFF_KB.items():
        arrays, on_disk = arrays_of(task, demos)
        measured = {name: [encode(arrays, codecs, demos) for _ in range(rounds)] for name, codecs in kept.items()}
        for k, (what, unit) in enumerate((("size", "kB/demo"), ("encoding", "CPU ms/demo"), ("decoding", "CPU ms/demo"))):
            values = {name: [found[k] for found in each] for name, each in measured.items()}
            table = rows("size", f"{task}, {what}", values, unit, {"dapdata": f"zstd-{store.ZSTD_LEVEL}"})
            yield from table
        (ours,) = rows("size", f"{task}, a shard's files", {"dapdata": [on_disk]}, "kB/demo", {"dapdata": "with metadata"})
        yield ours
        if against in (None, "rpdiff-files"):
            yield published(ours, "rpdiff-files", rpdiff, "npz of its own generator")


if __name__ == "__main__":
    main(run)
