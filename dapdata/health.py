"""What a dataset's folder holds: how far is it, what is inside, what may go; is it whole, says audit.py."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dapdata import durable, manifest, remote, store
from dapdata.audit import INSTANCES, Audit, freed, unnamed, verify
from dapdata.errors import FormatError
from dapdata.stages import Layout, units

__all__ = ["Audit", "Facts", "gc", "inspect", "status", "verify"]


@dataclass(frozen=True)
class Facts:
    """What a command has to tell, as JSON data and as lines."""

    facts: dict[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return self.facts

    def __str__(self) -> str:
        return "\n".join(_lines(self.facts, ""))


def _lines(facts: Mapping[str, Any], pad: str) -> Iterator[str]:
    for name, value in facts.items():
        if isinstance(value, Mapping) and value:
            yield f"{pad}{name}:"
            yield from _lines(value, f"{pad}  ")
        elif isinstance(value, list):
            yield f"{pad}{name}: {', '.join(map(str, value)) or 'none'}"
        else:
            yield f"{pad}{name}: {'none' if value in (None, {}) else value}"


@remote.on_copy(units=True)
def status(root: str | Path) -> Facts:
    """How far a dataset is: units made of each stage, whether a command is at work, what it cost so far."""
    root = Path(root)
    if not root.is_dir():
        raise FormatError(f"{root}: no such folder, expected a dataset; make one with `dapdata generate RECIPE --out {root}`")
    published: dict[str, Any] | None = None
    if (root / manifest.MANIFEST).is_file():
        found = manifest.read(root)
        published = {
            "name": found.name,
            "demos": found.demos,
            "labelled": bool(found.shards),
            "shards": len(found.shards),
            "content_sha256": found.content_sha256,
            "units": {name: len(stage.units) for name, stage in found.stages.items()},
        }
    elif not (root / manifest.PROGRESS).is_file():
        manifest.read(root)  # raises with the reason why this is no dataset
    cpu_seconds, peak_mb = _spent(root)
    facts = {
        "root": str(root),
        "published": published,
        "working": remote.holder(root),
        "in_progress": _in_progress(root),
        "quarantined": sorted(path.name for path in root.glob("quarantine/*.json")),
        "cpu_seconds": cpu_seconds,
        "peak_mb": peak_mb,
    }
    return Facts(facts)


def _spent(root: Path) -> tuple[dict[str, float], int | None]:
    """CPU seconds of each stage, and the largest memory of a worker, as the log has them."""
    seconds, peak = Counter[str](), None
    for line in manifest.read_log(root):
        seconds[line["stage"]] += line["cpu_seconds"]
        peak = max(peak or 0, line["peak_mb"])
    return {stage: round(total, 3) for stage, total in seconds.items()}, peak


def _in_progress(root: Path) -> dict[str, Any] | None:
    """What the running or interrupted command is at: how many of its units are there."""
    left = manifest.read_progress(root)
    if left is None or not {left.shard_stage, *left.stages} <= left.specs.keys():  # nothing, or no help
        return None
    demos, seed, shard_size = (left.recipe[name] for name in ("demos", "seed", "shard_size"))
    layout, todo = Layout(root, left.specs, seed, shard_size, left.shard_stage), units(demos, shard_size)
    done = {name: len(store.committed(root, [layout.path(name, unit) for unit in todo])) for name in left.stages}
    return {"demos": demos, "units": len(todo), "done": done}


@remote.on_copy(units=True)
def rejected(root: str | Path) -> list[dict[str, Any]]:
    """Which demos were left out, in their order: "demo", "stage", "reason", and "detail" for who looks after it."""
    root = Path(root)
    found = []
    for name, stage in manifest.read(root).stages.items():
        for unit in stage.units:
            found += [{"stage": name, **told} for told in store.read_record(root / unit.path).get("rejected", ())]
    return sorted(found, key=lambda told: int(told["demo"]))


@remote.on_copy(files=remote.TABLES)
def inspect(root: str | Path) -> Facts:
    """What is inside: counts, statistics a demo, rejects by reason, sizes."""
    root = Path(root)
    found = manifest.read(root)
    about: dict[str, Any] = {
        "root": str(root),
        "name": found.name,
        "task": found.task,
        "content_sha256": found.content_sha256,
        "demos": found.demos,
        "demos_in_shards": sum(entry.demos for entry in found.splits.values()),
        "shards": len(found.shards),
        "splits": {name: entry.demos for name, entry in found.splits.items()},
        "rejects": found.rejects.model_dump(),
        "missing": [f"{entry.demo_range[0]} to {entry.demo_range[1] - 1}: {entry.reason}" for entry in found.missing],
        "bytes": {"shards": manifest.total_bytes(found.shards)}
        | {name: manifest.total_bytes(stage.units) for name, stage in found.stages.items()},
        "created_by": found.created_by,
    }
    return Facts(about | ({"per_demo": _statistics(root)} if found.shards else {}))


def _statistics(root: Path) -> dict[str, dict[str, float]]:
    """Mean, least and most of each count."""
    index = manifest.read_index(root)
    places = ("demo", "row", "seed", *INSTANCES)
    counts = ((name, index.read(name)) for name in index.numbers if name not in places)
    return {
        name: {"mean": float(column.mean()), "min": int(column.min()), "max": int(column.max())}
        for name, column in counts
        if len(column)
    }


@remote.on_copy(units=True, leftovers=True)
def gc(root: str | Path, *, dry_run: bool = False) -> Facts:
    """Removes units that the manifest does not name: other recipes, other labellings, what killed processes left.

    Returns:
        {"root", "removed": paths, "bytes": freed}; with `dry_run` what would be.

    Raises:
        LockedError: if a command is at work on the dataset.
    """
    root = Path(root)
    manifest.read(root)  # what is no dataset is refused before it is locked
    with durable.lock(root):
        found = manifest.read(root)
        doomed = unnamed(root, found)
        size = sum(freed(path) for path in doomed)
        for path in () if dry_run else doomed:
            durable.discard(root, path)
    paths = [path.relative_to(root).as_posix() for path in doomed]
    return Facts({"root": str(root), "would_remove" if dry_run else "removed": paths, "bytes": size})
