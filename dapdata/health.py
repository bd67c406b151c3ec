"""What a dataset's folder holds: is it whole, how far is it, what is inside, what may go.

`verify` never trusts what it reads: files are compared with their hashes before anything is decoded, and whatever is
wrong becomes a line of its report, never a traceback.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import combinations, islice
from pathlib import Path
from typing import Any

import numpy as np

from dapdata import durable, manifest, remote, store
from dapdata.errors import CorruptionError, FormatError
from dapdata.manifest import Manifest, UnitEntry
from dapdata.split import SPLITS, distinct
from dapdata.stages import Layout, units
from dapdata.tables import Index

OWN_FILES = (manifest.MANIFEST, manifest.PROGRESS, manifest.LOG, ".lock")  # of the machinery, not of the data
OWN_FOLDERS = (durable.STAGING, "stages", "shards", "quarantine", manifest.PREVIEWS)
INSTANCES = ("container_instance", "object_instance")


Progress = Callable[[int, int], None]  # units done, units in all


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


@dataclass(frozen=True)
class Audit:
    """What `verify` found."""

    root: str
    problems: tuple[str, ...]  # each names the file, and for shards the array
    notes: tuple[str, ...]  # what is no problem but worth knowing, such as units that no manifest names
    files: int  # that were compared with their hashes
    demos: int  # whose arrays were decoded and compared with their digests
    content_sha256: str

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems

    def raise_if_damaged(self) -> None:
        """Raises a CorruptionError that names every problem, if there is one."""
        if self.problems:
            shown = "\n".join(self.problems)
            raise CorruptionError(
                f"{self.root}: {len(self.problems)} problems, expected none; delete the shards or units named here and run "
                f"generate and label again, they alone are made anew\n{shown}"
            )

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return asdict(self) | {"ok": self.ok}

    def __str__(self) -> str:
        state = "whole" if self.ok else f"{len(self.problems)} problems"
        head = f"{self.root}: {state}; {self.files} files compared with their hashes, {self.demos} demos decoded"
        return "\n".join([head, *(f"  {line}" for line in self.problems), *(f"  note: {line}" for line in self.notes)])


@remote.on_copy(units=True, leftovers=True)
def verify(root: str | Path, *, quick: bool = False, progress: Progress | None = None) -> Audit:
    """Compares a dataset with its manifest, down to each decoded demo.

    Args:
        root: The dataset's folder or URL.
        quick: Compare files with their hashes, and leave the arrays undecoded.
        progress: Called with units done and units in all.

    Raises:
        FormatError: if there is no dataset. Damage is reported, not raised.
    """
    root = Path(root)
    found = manifest.read(root)
    problems = list(_single_files(root, found)) + list(_extra_files(root, found))
    files, claims = len(found.files), _Claims(root, found)
    is_slim = _is_slim(root, found)
    total = len(found.shards) if is_slim else sum(len(stage.units) for stage in found.stages.values())
    try:
        for done, (entry, is_shard) in enumerate(_units(found, is_slim), 1):
            with remote.filled(root / entry.path):
                record, damage = _unit_files(root, entry)
                files += len(record["files"]) if record else 0
                problems += damage
                if is_shard and record and not damage:
                    claims.see(entry.path, record)
                    problems += [] if quick else list(_decoded(root, entry, record))
            if progress:
                progress(done, total)
        notes = list(_notes(root, found))
    except CorruptionError as error:  # the table of units cannot be read
        problems, notes = [*problems, str(error)], []
    if found.shards and not problems:
        problems += list(claims.problems())
    return Audit(str(root), tuple(problems), tuple(notes), files, 0 if quick else claims.demos, found.content_sha256)


def _is_slim(root: Path, found: Manifest) -> bool:
    """Whether this is a copy of the shards alone: all upstream units were left behind, as when only readers are served."""
    return bool(found.shards) and not (root / "stages").exists()


def _units(found: Manifest, is_slim: bool = False) -> Iterator[tuple[UnitEntry, bool]]:
    """Each unit once, shards first, and whether it is one; of a slim copy the shards alone."""
    yield from ((entry, True) for entry in found.shards)
    if is_slim:
        return
    shards = {entry.path for entry in found.shards}  # the units of the last stage are the shards
    for stage in found.stages.values():
        yield from ((entry, False) for entry in stage.units if entry.path not in shards)


def _single_files(root: Path, found: Manifest) -> Iterator[str]:
    for name, expected in found.files.items():
        path = root / name
        if path.is_symlink() or not path.is_file():
            yield f"{name}: missing"
        elif durable.hash_file(path) != expected:
            yield f"{name}: its bytes are not those that were written"


def _extra_files(root: Path, found: Manifest) -> Iterator[str]:
    """Names in the dataset's folder that nobody put there: besides units, which `_unit_files` looks into."""
    for path in sorted(root.iterdir()):
        known = path.name in OWN_FOLDERS if path.is_dir() else path.name in (*OWN_FILES, *found.files)
        if not known and not path.match(durable.TEMPORARY):
            yield f"{path.name}: not part of the dataset"
    for path in sorted((root / manifest.PREVIEWS).glob("*")):
        if path.relative_to(root).as_posix() not in found.files and not path.match(durable.TEMPORARY):
            yield f"{path.relative_to(root)}: not part of the dataset"
    for name, is_folder in [*_listed(root, "shards", 2), *_listed(root, "stages", 2)]:
        if not is_folder:
            yield f"{name}: not part of the dataset"


def _listed(root: Path, name: str, depth: int) -> Iterator[tuple[str, bool]]:
    """What is in a folder, and in its folders so many levels down: each path, and whether it is a folder and no link."""
    with suppress(FileNotFoundError), os.scandir(root / name) as entries:
        for entry in sorted(entries, key=lambda entry: entry.name):
            is_folder = entry.is_dir(follow_symlinks=False)
            yield f"{name}/{entry.name}", is_folder
            if depth > 1 and is_folder:
                yield from _listed(root, f"{name}/{entry.name}", depth - 1)


def _unit_files(root: Path, entry: UnitEntry) -> tuple[dict[str, Any] | None, list[str]]:
    """A unit's record, and what is wrong with its files."""
    folder = root / entry.path
    top = folder / "zarr.json"
    if folder.is_symlink() or not top.is_file():
        return None, [f"{entry.path}: missing"]
    if durable.hash_file(top) != entry.sha256:
        return None, [f"{entry.path}: zarr.json: its bytes are not those that were written"]
    try:
        record = store.read_record(folder)
    except CorruptionError as error:
        return None, [str(error)]
    return record, [f"{entry.path}: {damage}" for damage in store.damaged_files(folder, record)]


def _decoded(root: Path, entry: UnitEntry, record: Mapping[str, Any]) -> Iterator[str]:
    """Compares each demo's decoded arrays with its digest and with what must hold of them."""
    try:
        block = store.read_block(root / entry.path)
    except CorruptionError as error:
        yield str(error)
        return
    for number, row in enumerate(record["rows"]):
        sample = block.sample(number)
        if store.demo_digest(sample) != row["sha256"]:
            yield f"{entry.path}: demo {row['demo']}: its arrays are not those that were written"
        if int(sample["meta/demo"]) != row["demo"] or any(int(sample[f"meta/{name}"]) != row[name] for name in INSTANCES):
            yield f"{entry.path}: demo {row['demo']}: meta/ disagrees with the shard's own record"
        yield from (f"{entry.path}: demo {row['demo']}: {problem}" for problem in store.problems(sample))


class _Claims:
    """What manifest and index say of the shards, compared with each shard as it comes by: content, places, splits."""

    PLACE = ("shard", "row", "demo", *INSTANCES, "sha256")

    def __init__(self, root: Path, found: Manifest) -> None:
        self.root, self.found, self.demos = root, found, 0
        self._content, self._agrees, self._error = store.ContentDigest(), True, ""
        self._stored = self._stream()

    def see(self, path: str, record: Mapping[str, Any]) -> None:
        """Compares a shard's own record with the rows of the index that come next."""
        rows = record["rows"]
        self.demos += len(rows)
        self._content.add(row["sha256"] for row in rows)
        told = [
            (path, number, row["demo"], *(row[name] for name in INSTANCES), row["sha256"]) for number, row in enumerate(rows)
        ]
        self._agrees = self._agrees and list(islice(self._stored, len(told))) == told

    def _stream(self) -> Iterator[tuple[Any, ...]]:
        try:
            yield from manifest.read_index(self.root).stream(self.PLACE)
        except CorruptionError as error:
            self._error = str(error)
        except KeyError as error:
            self._error = f"index.parquet: column {error} is missing"

    def problems(self) -> Iterator[str]:
        """What is claimed and isn't so, once all shards have come by."""
        if self._content.hexdigest() != self.found.content_sha256:
            yield "manifest.json: content_sha256 is not that of the shards"
        if durable.digest(self.found.recipe) != self.found.recipe_sha256:
            yield "manifest.json: recipe_sha256 is not that of the recipe"
        if manifest.listed_shards(self.root) != [
            {name: getattr(entry, name) for name in ("path", "demos", "sha256")} for entry in self.found.shards
        ]:
            yield "manifest.json: shards: not the units of the last stage"
        if next(self._stored, None) is not None or not self._agrees:
            yield self._error or "index.parquet: its rows are not the demos of the shards"
        if self._error:
            return
        index = manifest.read_index(self.root)
        if (np.diff(index.read("demo")) <= 0).any():
            yield "index.parquet: a demo is there twice, or out of order"
        yield from _leaks(index, self.found)


def _leaks(index: Index, found: Manifest) -> Iterator[str]:
    """Instances that two splits share, and splits that the manifest tells otherwise."""
    splits = index.read("split")
    for name in INSTANCES:
        instances = index.read(name)
        mine = {split: distinct(instances[splits == split]) for split in SPLITS}
        for split in found.splits.keys() & mine.keys():
            told = getattr(found.splits[split], f"{name}s")
            if told != (len(mine[split]) if isinstance(told, int) else mine[split].tolist()):
                yield f"manifest.json: splits.{split}.{name}s: not those of the index"
        for a, b in combinations(sorted(mine), 2):
            shared = np.intersect1d(mine[a], mine[b], assume_unique=True)
            if len(shared):
                yield f"index.parquet: {name} {shared[0]} is in {a} and {b}: {len(shared)} instances leak"


def _notes(root: Path, found: Manifest) -> Iterator[str]:
    if _is_slim(root, found):
        yield "stages/ is not here: the shards are complete in themselves, but cannot be labelled again"
    for entry in found.missing:
        first, last = entry.demo_range[0], entry.demo_range[1] - 1
        yield f"demos {first} to {last} are missing: {entry.stage} failed: {entry.reason}; run generate and label to try again"
    unnamed = _unnamed(root, found)
    if unnamed:
        size = sum(_size(path) for path in unnamed)
        yield f"{len(unnamed)} units ({size / 1e6:.1f} MB) are of other recipes or labellings; `dapdata gc` frees them"


# How far, what is inside, what may go ----------------------------------------------------------------------


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
    try:
        left = json.loads((root / manifest.PROGRESS).read_bytes())
        demos, seed, shard_size = (left["recipe"][name] for name in ("demos", "seed", "shard_size"))
        layout, todo = Layout(root, left["specs"], seed, shard_size, left["shard_stage"]), units(demos, shard_size)
        done = {name: len(store.committed(root, [layout.path(name, unit) for unit in todo])) for name in left["stages"]}
    except (OSError, ValueError, KeyError, TypeError):  # nothing is in progress, or what it left is no help
        return None
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
        doomed = _unnamed(root, found)
        size = sum(_size(path) for path in doomed)
        for path in () if dry_run else doomed:
            durable.discard(root, path)
    paths = [path.relative_to(root).as_posix() for path in doomed]
    return Facts({"root": str(root), "would_remove" if dry_run else "removed": paths, "bytes": size})


def _unnamed(root: Path, found: Manifest) -> list[Path]:
    """Folders of units that the manifest does not name."""
    named = {entry.path for entry, _ in _units(found)}
    listed = [*_listed(root, "shards", 2), *_listed(root, "stages", 2)]
    return [root / name for name, is_folder in listed if is_folder and name.count("/") == 2 and name not in named]


def _size(folder: Path) -> int:
    """Bytes that deleting a folder frees: files that others are linked to free nothing."""
    if (stored := remote.size(folder)) is not None:
        return stored
    facts = [path.stat() for path in folder.rglob("*") if path.is_file()]
    return sum(fact.st_size for fact in facts if fact.st_nlink == 1)
