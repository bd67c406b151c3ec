"""Datasets that are wrong in one thing while every hash in them is right: what checksums cannot find."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from dapdata import durable, manifest, store, tables
from dapdata.units import describe

Change = Callable[[dict[str, Any]], object]


def alone(root: Path) -> Path:
    """The dataset, none of whose files shares its bytes with another."""
    for path in root.rglob("*"):
        if path.is_file() and path.stat().st_nlink > 1:
            own = path.with_name(f"{path.name}.own")
            shutil.copyfile(path, own)
            own.replace(path)
    return root


def forge_manifest(root: Path, change: Change) -> None:
    """Changes the tree of the manifest, and its digest with it."""
    path = root / manifest.MANIFEST
    tree = json.loads(path.read_text())
    change(tree)
    tree.pop("manifest_sha256", None)
    if isinstance(tree.get("recipe"), dict):
        tree["recipe_sha256"] = durable.digest(tree["recipe"])
    path.write_bytes(manifest.encode(tree))


def forge_root(root: Path, unit: str, change: Change) -> None:
    """Changes the zarr.json of a unit's root, and its hash in the manifest."""
    path = root / unit / "zarr.json"
    tree = json.loads(path.read_text())
    change(tree)
    path.write_text(json.dumps(tree))

    def name_it(found: dict[str, Any]) -> None:
        for entry in [*found["shards"], *(entry for stage in found["stages"].values() for entry in stage["units"])]:
            if entry["path"] == unit:
                entry["sha256"] = durable.hash_file(path)
                entry["bytes"] = sum(file.stat().st_size for file in (root / unit).rglob("*") if file.is_file())

    forge_manifest(root, name_it)


def forge_file(root: Path, unit: str, name: str, data: bytes) -> None:
    """Puts other bytes into a file of a unit."""
    path = root / unit / name
    path.unlink()
    path.write_bytes(data)

    def note(tree: dict[str, Any]) -> None:
        fact = {"sha256": durable.hash_file(path), "bytes": len(data)}
        tree["attributes"]["dapdata"]["files"][name] = fact

    forge_root(root, unit, note)


def forge_index(root: Path, change: Callable[[list[dict[str, Any]]], object]) -> None:
    """Changes the rows of the index."""
    index = manifest.read_index(root)
    rows = [dict(zip(index, values)) for values in index.stream(list(index))]
    change(rows)
    with tables.writer(root / manifest.INDEX) as made:
        made.add(rows)
    forge_manifest(root, lambda tree: tree["files"].update({manifest.INDEX: durable.hash_file(root / manifest.INDEX)}))


def forge_arrays(root: Path, unit: str, change: Callable[[dict[str, np.ndarray]], object]) -> None:
    """Changes the arrays of a shard's or unit's first demo (same shapes), and all digests with them."""
    import zarr

    alone(root / unit)
    record, block = store.read_record(root / unit), store.read_block(root / unit)
    sample = {path: array.copy() for path, array in block.sample(0).items()}
    change(sample)
    group = zarr.open_group(root / unit, mode="r+")
    for path, array in sample.items():
        rows = block._rows(path, 0)
        if not np.array_equal(array, block.sample(0)[path]):
            whole = block.arrays[path].copy()
            whole[rows] = array
            group[path][...] = whole
            for name in record["files"]:
                if name.startswith(f"{path}/"):
                    file = root / unit / name
                    record["files"][name] = {"sha256": durable.hash_file(file), "bytes": file.stat().st_size}
    row = record["rows"][0]
    row |= {"sha256": store.demo_digest(sample)} | (describe(sample) if "seed" in row else {})
    forge_root(root, unit, lambda tree: tree["attributes"]["dapdata"].update(record))
    found = manifest.read(root)
    shards = [store.read_record(root / shard.path) for shard in found.shards]
    content = store.ContentDigest()
    content.add(row["sha256"] for shard in shards for row in shard["rows"])
    forge_manifest(root, lambda tree: tree.update(content_sha256=content.hexdigest()))
    if unit in [shard.path for shard in found.shards]:
        told = {name: value for name, value in row.items() if name not in ("demo", "task")}
        forge_index(root, lambda rows: next(r for r in rows if r["demo"] == row["demo"]).update(told))
