"""What a dataset's folder holds: is it whole, how far is it, what is inside, what may go.

`verify` never trusts what it reads: files are compared with their hashes before anything is decoded, and whatever is
wrong becomes a line of its report, never a traceback.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dapdata import durable, manifest, remote, store
from dapdata.errors import CorruptionError, FormatError
from dapdata.manifest import Manifest, UnitEntry
from dapdata.records import Array
from dapdata.split import SPLITS
from dapdata.stages import Layout, units

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


@remote.on_copy(units=True)
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
    files, digests, rows = len(found.files), [], []
    shard_paths = {entry.path for entry in found.shards}
    is_slim = _is_slim(root, found)
    entries = {entry.path: entry for entry in (found.shards if is_slim else manifest.units(found))}
    for done, entry in enumerate(entries.values(), 1):
        with remote.filled(root / entry.path):
            record, damage = _unit_files(root, entry)
            files += len(record["files"]) if record else 0
            problems += damage
            if entry.path in shard_paths and record and not damage:
                rows += [(entry.path, number, row) for number, row in enumerate(record["rows"])]
                digests += [row["sha256"] for row in record["rows"]]
                problems += [] if quick else list(_decoded(root, entry, record))
        if progress:
            progress(done, len(entries))
    if found.shards and not problems:
        problems += list(_claims(root, found, rows, digests))
    demos = 0 if quick else len(rows)
    return Audit(str(root), tuple(problems), tuple(_notes(root, found)), files, demos, found.content_sha256)


def _is_slim(root: Path, found: Manifest) -> bool:
    """Whether this is a copy of the shards alone: all upstream units were left behind, as when only readers are served."""
    return bool(found.shards) and not (root / "stages").exists()


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
    for path in sorted([*root.glob("shards/*"), *root.glob("shards/*/*"), *root.glob("stages/*"), *root.glob("stages/*/*")]):
        if not path.is_dir() or path.is_symlink():
            yield f"{path.relative_to(root)}: not part of the dataset"


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


def _claims(root: Path, found: Manifest, rows: list[tuple[str, int, dict[str, Any]]], digests: list[str]) -> Iterator[str]:
    """Compares what manifest and index say with the shards: content, places, splits that share nothing."""
    if store.content_digest(digests) != found.content_sha256:
        yield "manifest.json: content_sha256 is not that of the shards"
    if durable.digest(found.recipe) != found.recipe_sha256:
        yield "manifest.json: recipe_sha256 is not that of the recipe"
    try:
        index = manifest.read_index(root)
        yield from _index_problems(index, rows)
        yield from _leaks(index, found)
    except CorruptionError as error:
        yield str(error)
    except KeyError as error:
        yield f"index.parquet: column {error} is missing"


def _index_problems(index: Mapping[str, Array], rows: list[tuple[str, int, dict[str, Any]]]) -> Iterator[str]:
    expected = [(shard, number, row["demo"], *(row[name] for name in INSTANCES), row["sha256"]) for shard, number, row in rows]
    stored = zip(index["shard"], index["row"], index["demo"], *(index[name] for name in INSTANCES), index["sha256"])
    if [tuple(str(value) for value in row) for row in stored] != [tuple(str(value) for value in row) for row in expected]:
        yield "index.parquet: its rows are not the demos of the shards"
    if len(set(index["demo"].tolist())) != len(index["demo"]):
        yield "index.parquet: a demo is there twice"


def _leaks(index: Mapping[str, Array], found: Manifest) -> Iterator[str]:
    """Instances that two splits share, and splits that the manifest tells otherwise."""
    for name in INSTANCES:
        owners: dict[int, set[str]] = {}
        for split in SPLITS:
            mine = sorted(set(index[name][index["split"] == split].tolist()))
            if split in found.splits and mine != getattr(found.splits[split], f"{name}s"):
                yield f"manifest.json: splits.{split}.{name}s: not those of the index"
            for instance in mine:
                owners.setdefault(instance, set()).add(split)
        shared = {instance: splits for instance, splits in owners.items() if len(splits) > 1}
        for instance, splits in sorted(shared.items())[:3]:
            yield f"index.parquet: {name} {instance} is in {' and '.join(sorted(splits))}: {len(shared)} instances leak"


def _notes(root: Path, found: Manifest) -> Iterator[str]:
    if _is_slim(root, found):
        yield "stages/ is not here: the shards are complete in themselves, but cannot be labelled again"
    count, size = len(_unnamed(root, found)), sum(_size(path) for path in _unnamed(root, found))
    if count:
        yield f"{count} units ({size / 1e6:.1f} MB) are of other recipes or labellings; `dapdata gc` frees them"


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
    log = _log(root)
    facts = {
        "root": str(root),
        "published": published,
        "working": remote.holder(root),
        "in_progress": _in_progress(root),
        "quarantined": sorted(path.name for path in root.glob("quarantine/*.json")),
        "cpu_seconds": _cpu_seconds(log),
        "peak_mb": max((line["peak_mb"] for line in log), default=None),
    }
    return Facts(facts)


def _log(root: Path) -> list[dict[str, Any]]:
    """The lines of the log that can be read; the last may be half-written."""
    lines = []
    path = root / manifest.LOG
    for text in path.read_text().splitlines() if path.is_file() else ():
        try:
            lines.append(dict(json.loads(text)))
        except ValueError:
            continue
    return lines


def _cpu_seconds(log: list[dict[str, Any]]) -> dict[str, float]:
    total: dict[str, float] = {}
    for line in log:
        total[line["stage"]] = round(total.get(line["stage"], 0.0) + line["cpu_seconds"], 3)
    return total


def _in_progress(root: Path) -> dict[str, Any] | None:
    """What the running or interrupted command is at: how many of its units are there."""
    try:
        left = json.loads((root / manifest.PROGRESS).read_bytes())
        demos, seed, shard_size = (left["recipe"][name] for name in ("demos", "seed", "shard_size"))
        layout, todo = Layout(root, left["specs"], seed, shard_size, left["shard_stage"]), units(demos, shard_size)
        done = {name: sum(store.is_committed(layout.folder(name, unit)) for unit in todo) for name in left["stages"]}
    except (OSError, ValueError, KeyError, TypeError):  # nothing is in progress, or what it left is no help
        return None
    return {"demos": demos, "units": len(todo), "done": done}


@remote.on_copy(files=(manifest.MANIFEST, manifest.INDEX))
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
        "demos_in_shards": sum(shard.demos for shard in found.shards),
        "shards": len(found.shards),
        "splits": {name: entry.demos for name, entry in found.splits.items()},
        "rejects": found.rejects.model_dump(),
        "bytes": {"shards": sum(s.bytes for s in found.shards)}
        | {name: sum(unit.bytes for unit in stage.units) for name, stage in found.stages.items()},
        "created_by": found.created_by,
    }
    return Facts(about | ({"per_demo": _statistics(manifest.read_index(root))} if found.shards else {}))


def _statistics(index: Mapping[str, Array]) -> dict[str, dict[str, float]]:
    """Mean, least and most of each count."""
    places = ("demo", "row", "seed", *INSTANCES)
    counts = {name: column for name, column in index.items() if column.dtype.kind == "i" and name not in places}
    return {
        name: {"mean": float(column.mean()), "min": int(column.min()), "max": int(column.max())}
        for name, column in counts.items()
        if len(column)
    }


@remote.on_copy(units=True)
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
    named = {root / entry.path for entry in manifest.units(found)}
    return [
        path for path in sorted([*root.glob("shards/*/*"), *root.glob("stages/*/*")]) if path.is_dir() and path not in named
    ]


def _size(folder: Path) -> int:
    """Bytes that deleting a folder frees: files that others are linked to free nothing."""
    if (stored := remote.size(folder)) is not None:
        return stored
    facts = [path.stat() for path in folder.rglob("*") if path.is_file()]
    return sum(fact.st_size for fact in facts if fact.st_nlink == 1)
