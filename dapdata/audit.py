"""Is a dataset whole, and does it make sense: `verify`.

It looks at three depths. Quick: every file against its hash, and every claim of the manifest and the units' records
against each other. As it is by default: the shards decoded as well, each demo against its digest and against what must
hold of it (`store.problems`, `sense.nonsense`). Deep: the cached units too, their keys computed anew, what arrays say of
themselves, and what only all demos together can tell, such as a geometry that two splits share.

Nothing that is read is trusted: files are compared with their hashes before anything is decoded, and whatever is wrong
becomes a line of the report, never a traceback.
"""

from __future__ import annotations

import os
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256
from heapq import merge
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from dapdata import durable, manifest, remote, sense, split, stages, store
from dapdata.errors import CorruptionError
from dapdata.manifest import Manifest, UnitEntry
from dapdata.records import LATER, Array, Mesh, meshes_in
from dapdata.schemas import shard_schema
from dapdata.stages import Unit
from dapdata.tables import Index
from dapdata.units import index_row

OWN_FILES = (manifest.MANIFEST, manifest.PROGRESS, manifest.LOG, durable.LOCK)  # of the machinery, not of the data
OWN_FOLDERS = (durable.STAGING, "stages", "shards", "quarantine", manifest.PREVIEWS)
INSTANCES = ("container_instance", "object_instance")
GEOMETRY = {  # arrays that say what a container with its clutter, or an object, is like, besides meshes
    "container": ("scene/kind", "scene/size", "scene/T_container_part"),
    "object": ("object_parts/kind", "object_parts/size", "object_parts/T_object_part"),
}
PARTS = (*split.SPLITS, split.UNUSED)
MANY = 3  # leaks of one kind that are named; of the others only the number is told

Progress = Callable[[int, int], None]  # units done, units in all
Record = Mapping[str, Any]  # a unit's own


@dataclass(frozen=True)
class Audit:
    """What `verify` found."""

    root: str
    problems: tuple[str, ...]  # each names the file, and for shards the array
    notes: tuple[str, ...]  # what is no problem but worth knowing, such as units that no manifest names
    files: int  # that were compared with their hashes
    demos: int  # of the shards, whose arrays were decoded and compared with their digests
    content_sha256: str
    reproduced: int = 0  # units that were made anew and compared

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

    def with_reproduced(self, units: int, problems: Iterable[str]) -> Audit:
        """The same, and what was found by making some units anew."""
        return replace(self, reproduced=units, problems=(*self.problems, *problems))

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return asdict(self) | {"ok": self.ok}

    def __str__(self) -> str:
        state = "whole" if self.ok else f"{len(self.problems)} problems"
        again = f", {self.reproduced} units made anew" if self.reproduced else ""
        head = f"{self.root}: {state}; {self.files} files compared with their hashes, {self.demos} demos decoded{again}"
        return "\n".join([head, *(f"  {line}" for line in self.problems), *(f"  note: {line}" for line in self.notes)])


@dataclass
class _Seen:
    """What the units told while they came by in demo order; of ten million demos no more than a few numbers each."""

    files: int = 0
    demos: int = 0
    content: store.ContentDigest = field(default_factory=store.ContentDigest)
    rejects: dict[str, Counter[str]] = field(default_factory=dict)
    arrays: dict[str, list[str]] = field(default_factory=dict)  # paths of those that a stage makes
    upstream: dict[str, dict[int, str]] = field(default_factory=dict)  # of each stage's latest unit: digest by demo
    parts: array[int] = field(default_factory=lambda: array("B"))  # of each demo of the shards, where it is in PARTS
    geometry: dict[str, tuple[array[int], array[int]]] = field(  # of each body that was seen: digest, and split
        default_factory=lambda: {body: (array("Q"), array("B")) for body in GEOMETRY}
    )


@remote.on_copy(units=True, leftovers=True)
def verify(root: str | Path, *, quick: bool = False, deep: bool = False, progress: Progress | None = None) -> Audit:
    """Compares a dataset with its manifest, down to each decoded demo.

    Of a copy without stages/, which readers have no use for, the shards are looked at; a note says what was not.

    Args:
        root: The dataset's folder or URL.
        quick: Compare files with their hashes, and leave the arrays undecoded.
        deep: Decode cached units too, and compare everything with everything.
        progress: Called with units done and units in all.

    Raises:
        FormatError: if there is no dataset, or one of another format. Damage is reported, not raised.
    """
    root = Path(root)
    try:
        found = manifest.read(root)
    except CorruptionError as error:
        return Audit(str(root), (str(error),), (), 1, 0, "")
    slim, seen, index, notes = _is_slim(root, found), _Seen(files=len(found.files)), _IndexRows(root, found), list[str]()
    problems = [*_single_files(root, found), *_extra_files(root, found)]
    try:
        problems += _lists(root, found)
        total = len(found.shards) if slim else sum(len(stage.units) for stage in found.stages.values())
        for done, (stage, entry) in enumerate(_units(found, slim), 1):
            with remote.filled(root / entry.path):
                problems += _one_unit(root, found, stage, entry, seen, index, quick, deep)
            if progress:
                progress(done, total)
        if not problems:
            problems += [*_claims(found, seen, slim), *(index.problems(seen) if found.shards else ())]
            problems += _lineage(found, slim) if deep else ()
        notes += _notes(root, found)
    except CorruptionError as error:  # the table of units cannot be read
        problems.append(str(error))
    return Audit(str(root), tuple(problems), tuple(notes), seen.files, seen.demos, found.content_sha256)


def _is_slim(root: Path, found: Manifest) -> bool:
    """Whether this is a copy of the shards alone: all upstream units were left behind, as when only readers are served."""
    return bool(found.shards) and not (root / "stages").exists()


def _units(found: Manifest, slim: bool = False) -> Iterator[tuple[str, UnitEntry]]:
    """Each unit once with its stage: in demo order, a shard after what it was made of; before there are shards, by stage."""
    shard_stage, order = _shard_stage(found), sorted(found.stages, key=lambda name: len(_needed(found, name)))
    if slim:
        order = [name for name in order if name == shard_stage]
    placed = [[(name, entry) for entry in found.stages[name].units] for name in order]
    if shard_stage:
        yield from merge(*placed, key=lambda unit: (unit[1].demo_range[0], order.index(unit[0])))
    else:
        yield from chain(*placed)


# Files -------------------------------------------------------------------------------------------------------


def _single_files(root: Path, found: Manifest) -> Iterator[str]:
    for name, expected in found.files.items():
        path = root / name
        if path.is_symlink() or not path.is_file() or not durable.is_inside(root, path):
            yield f"{name}: missing"
        elif durable.hash_file(path) != expected:
            yield f"{name}: its bytes are not those that were written"


def _extra_files(root: Path, found: Manifest) -> Iterator[str]:
    """Names in the dataset's folder that nobody put there: besides units, which `_record` looks into."""
    for path in sorted(root.iterdir()):
        known = path.name in OWN_FOLDERS if path.is_dir() else path.name in (*OWN_FILES, *found.files)
        if path.is_symlink() or not (known or path.match(durable.TEMPORARY)):
            yield f"{path.name}: not part of the dataset"
    for path in sorted((root / manifest.PREVIEWS).glob("*")):
        if path.relative_to(root).as_posix() not in found.files and not path.match(durable.TEMPORARY):
            yield f"{path.relative_to(root)}: not part of the dataset"
    for name, is_folder in [*_listed(root, "shards", 2), *_listed(root, "stages", 2)]:
        if not is_folder:
            yield f"{name}: not part of the dataset"


def _listed(root: Path, name: str, depth: int) -> Iterator[tuple[str, bool]]:
    """What is in a folder, and in its folders so many levels down: each path, and whether it is a folder and no link."""
    with suppress(FileNotFoundError, NotADirectoryError), os.scandir(root / name) as entries:
        for entry in sorted(entries, key=lambda entry: entry.name):
            is_folder = entry.is_dir(follow_symlinks=False)
            yield f"{name}/{entry.name}", is_folder
            if depth > 1 and is_folder:
                yield from _listed(root, f"{name}/{entry.name}", depth - 1)


# One unit ----------------------------------------------------------------------------------------------------


def _record(root: Path, entry: UnitEntry, stage: str) -> tuple[Record | None, list[str]]:
    """A unit's record, and what is wrong with its files and with what it says."""
    folder = root / entry.path
    top = folder / "zarr.json"
    if top.is_symlink() or not top.is_file() or not durable.is_inside(root, top):
        return None, [f"{entry.path}: missing"]
    if durable.hash_file(top) != entry.sha256:
        return None, [f"{entry.path}: zarr.json: its bytes are not those that were written"]
    try:
        record = store.read_record(folder)
    except CorruptionError as error:
        return None, [str(error)]
    damage = [*store.damaged_files(folder, record), *_told(entry, record, stage)]
    return record, [f"{entry.path}: {line}" for line in damage]


def _told(entry: UnitEntry, record: Record, stage: str) -> Iterator[str]:
    """What the manifest says of a unit, and what the unit's own record says."""
    named = {"stage": stage, "key": entry.key, "demo_range": list(entry.demo_range)}
    for name, expected in named.items():
        if record.get(name) != expected:
            yield f"zarr.json: {name} {record.get(name)}, expected {expected} as in the manifest"
    demos, (start, stop) = [row["demo"] for row in record["rows"]], entry.demo_range
    rising = all(a < b for a, b in zip([start - 1, *demos], [*demos, stop]))
    if not rising or len(demos) != entry.demos:
        yield f"zarr.json: {len(demos)} demos, expected {entry.demos} of {start} to {stop - 1}, in order"


def _one_unit(
    root: Path, found: Manifest, stage: str, entry: UnitEntry, seen: _Seen, index: _IndexRows, quick: bool, deep: bool
) -> Iterator[str]:
    """What is wrong with one unit; what it says of itself is kept for the claims that are about all."""
    record, damage = _record(root, entry, stage)
    yield from damage
    if record is None or damage:
        return
    shard_stage = _shard_stage(found)
    is_shard = stage == shard_stage
    seen.files += len(record["files"])
    if is_shard or shard_stage is None:
        seen.content.add(row["sha256"] for row in record["rows"])
    for what, reasons in record.get("rejects", {}).items():
        seen.rejects.setdefault(what, Counter()).update(reasons)
    if is_shard:
        index.see(entry.path, record, seen)
    else:
        seen.arrays[stage], seen.upstream[stage] = store.array_paths(record), {}
    if deep:
        yield from _described(root, entry, record, is_shard)
    if deep or (is_shard and not quick):
        yield from _decoded(root, entry, record, None if is_shard else stage, seen)


def _described(root: Path, entry: UnitEntry, record: Record, is_shard: bool) -> Iterator[str]:
    """Compares what arrays say of themselves with what they are by the format; nothing else may be among them."""
    known = set(shard_schema()["properties"])
    there = {name.removesuffix("/zarr.json") for name in record["files"] if name.count("/") == 2}
    yield from (f"{entry.path}: {path}: not an array of the format" for path in sorted(there - known))
    try:
        yield from (f"{entry.path}: {problem}" for problem in store.misdescribed(root / entry.path))
    except CorruptionError as error:
        yield str(error)


def _decoded(root: Path, entry: UnitEntry, record: Record, stage: str | None, seen: _Seen) -> Iterator[str]:
    """Compares each demo's arrays with its digest and with what must hold of them; `stage` is None for a shard."""
    missing = {*shard_schema()["required"]} - {*LATER} - {*store.stored_paths(record)} if stage is None else set()
    if missing:
        yield f"{entry.path}: {min(missing)}: missing, and {len(missing) - 1} other arrays"
        return
    try:
        block = store.read_block(root / entry.path)
    except CorruptionError as error:
        yield str(error)
        return
    for number, row in enumerate(record["rows"]):
        sample = block.sample(number)
        found = [*_as_written(sample, row), *store.problems(sample)]
        if stage is None:
            found += [*_as_told(sample, row), *sense.nonsense(sample), *_as_upstream(sample, row["demo"], seen)]
            for (body, paths), meshes in zip(GEOMETRY.items(), meshes_in(sample)):
                if len(sample[paths[0]]) and seen.demos < len(seen.parts):
                    digests, parts = seen.geometry[body]
                    digests.append(_geometry(sample, paths, meshes))
                    parts.append(seen.parts[seen.demos])
            seen.demos += 1
        else:
            seen.upstream[stage][row["demo"]] = row["sha256"]
        yield from (f"{entry.path}: demo {row['demo']}: {problem}" for problem in found)


def _as_written(sample: store.Sample, row: Record) -> Iterator[str]:
    if store.demo_digest(sample) != row["sha256"]:
        yield "its arrays are not those that were written"


def _as_told(sample: store.Sample, row: Record) -> Iterator[str]:
    if any(int(sample[f"meta/{name}"]) != row.get(name) for name in ("demo", "seed", *INSTANCES)):
        yield "meta/ disagrees with the shard's own record"


def _as_upstream(sample: store.Sample, demo: int, seen: _Seen) -> Iterator[str]:
    """Compares the part of a shard that another stage made with that stage's unit, if that was decoded."""
    for stage, paths in seen.arrays.items():
        expected = seen.upstream[stage].get(demo)
        if expected and store.demo_digest({path: sample[path] for path in paths if path in sample}) != expected:
            yield f"what stage {stage} made is not what its own unit holds"


def _geometry(sample: store.Sample, paths: tuple[str, ...], meshes: Iterable[Mesh | None]) -> int:
    """A digest, 64 bits of it, of all that says what a body is like."""
    total = sha256()
    for what in (*(sample[path] for path in paths), *chain(*filter(None, meshes))):
        total.update(what.tobytes())
    return int.from_bytes(total.digest()[:8])


# All units ---------------------------------------------------------------------------------------------------


def _shard_stage(found: Manifest) -> str | None:
    """The stage whose units are the shards, if it was run."""
    return next(
        (name for name, stage in found.stages.items() if stage.units and stage.units[0].path.startswith("shards/")), None
    )


def _lists(root: Path, found: Manifest) -> Iterator[str]:
    """The units of every stage are those of the recipe's demos but for what is missing; shards are the units of one stage."""
    shard_stage = _shard_stage(found)
    made = found.stages[shard_stage].units if shard_stage else []
    made = made if any(entry.demos for entry in made) else []  # units without a demo, each rejected, are no shards
    if list(found.shards) != list(made) or manifest.listed_shards(root) != [_named(entry) for entry in made]:
        yield "manifest.json: the shards are not the units of a stage"
    ranges = [(unit.start, unit.stop) for unit in stages.units(found.recipe["demos"], found.recipe["shard_size"])]
    spared = {entry.demo_range for entry in found.missing}
    for name, stage in found.stages.items():
        mine = [unit.demo_range for unit in stage.units]
        there = {*mine} if name != shard_stage else set()
        if mine and mine != [span for span in ranges if span in there or span not in spared]:
            yield f"manifest.json: the units of stage {name} are not those of {found.recipe['demos']} demos"
    if not spared <= {*ranges}:
        yield "manifest.json: what is missing are not units"
    for name in ("name", "demos"):
        if getattr(found, name) != found.recipe[name]:
            yield f"manifest.json: {name} {getattr(found, name)}, expected {found.recipe[name]} as in the recipe"
    if found.task != found.recipe["scene"].get("task"):
        yield f"manifest.json: task {found.task}, expected {found.recipe['scene'].get('task')} as in the recipe"


def _named(entry: UnitEntry) -> dict[str, Any]:
    """A shard as every manifest lists it."""
    return {name: getattr(entry, name) for name in manifest.ShardEntry.model_fields}


def _claims(found: Manifest, seen: _Seen, slim: bool) -> Iterator[str]:
    """Compares what the manifest says with the units: content and rejects."""
    if seen.content.hexdigest() != found.content_sha256:
        yield "manifest.json: content_sha256 is not that of the units"
    for what, counts in found.rejects.model_dump().items():
        if not slim and {**seen.rejects.get(what, {})} != counts:
            yield f"manifest.json: rejects.{what} are not those of the units"


def _needed(found: Manifest, name: str) -> set[str]:
    """A stage with all those before it."""
    return {name}.union(*(_needed(found, need) for need in found.stages[name].spec["needs"]))


class _IndexRows:
    """The rows of the index, compared with what each shard says of its demos as it comes by."""

    def __init__(self, root: Path, found: Manifest) -> None:
        self.root, self.found = root, found
        self._stored, self._wrong, self._error, self._ended = self._stream(), set[str](), "", False

    def _stream(self) -> Iterator[dict[str, Any]]:
        try:
            index = manifest.read_index(self.root)
            names = list(index)
            for values in index.stream(names):
                yield dict(zip(names, values))
        except CorruptionError as error:
            self._error = str(error)

    def see(self, path: str, record: Record, seen: _Seen) -> None:
        """Compares the record of the shard that comes next, and notes which split its demos are in."""
        for number, row in enumerate(record["rows"]):
            stored = next(self._stored, None)
            if stored is None:
                self._ended = True
                return
            try:
                told = index_row(self.found.recipe, path, number, row)
            except (KeyError, IndexError, TypeError):  # the record does not say all that it should
                told = {}
            part = stored.pop("split")
            seen.parts.append(PARTS.index(part) if part in PARTS else len(PARTS))
            self._wrong |= {name for name in told.keys() | stored.keys() if told.get(name) != stored.get(name)}

    def problems(self, seen: _Seen) -> Iterator[str]:
        """What is claimed and isn't so, once all shards have come by."""
        is_more = next(self._stored, None) is not None
        if self._error or self._ended or is_more:
            yield self._error or "index.parquet: its rows are not the demos of the shards"
            return
        yield from (f"index.parquet: column {name} is not what the shards say" for name in sorted(self._wrong))
        index = manifest.read_index(self.root)
        if (np.diff(index.read("demo")) <= 0).any():
            yield "index.parquet: a demo is there twice, or out of order"
        if len(PARTS) in seen.parts:
            yield f"index.parquet: a split is none of {', '.join(PARTS)}"
            return
        parts = np.array(seen.parts)
        yield from _splits(index, self.found, parts)
        for name in INSTANCES:
            yield from _shared(name, index.read(name), parts)
        for body, (digests, owners) in seen.geometry.items():
            yield from _shared(f"{body} geometry", np.array(digests), np.array(owners))


def _splits(index: Index, found: Manifest, parts: Array) -> Iterator[str]:
    """Splits that the manifest tells otherwise; `parts` (D,) are places in PARTS."""
    for place, part in enumerate(PARTS):
        mine, told = parts == place, found.splits.get(part)
        if told is None and not mine.any():
            continue
        for name in INSTANCES:
            instances = split.distinct(index.read(name)[mine])
            claimed = getattr(told, f"{name}s", None)
            if told is None or told.demos != mine.sum() or claimed not in (len(instances), instances.tolist()):
                yield f"manifest.json: splits.{part}: demos or {name}s are not those of the index"
    yield from (f"manifest.json: splits.{part}: no such split" for part in found.splits.keys() - {*PARTS})


def _shared(what: str, things: Array, parts: Array) -> Iterator[str]:
    """Which of some things (N,) are in more than one split (N,), as places in PARTS; what is unused may share with any."""
    used = parts != PARTS.index(split.UNUSED)
    names, number = np.unique(things[used], return_inverse=True)
    pairs = np.unique(number * len(PARTS) + parts[used])
    things_of, parts_of = np.divmod(pairs, len(PARTS))
    leaks = np.flatnonzero(np.bincount(things_of, minlength=len(names)) > 1)
    for leak in leaks[:MANY]:
        owners = " and ".join(sorted(PARTS[part] for part in parts_of[things_of == leak]))
        yield f"index.parquet: {what} {names[leak]} is in {owners}: {len(leaks)} leak"


def _lineage(found: Manifest, slim: bool) -> Iterator[str]:
    """Computes each unit's key and place anew from what its stage's results follow from."""
    plan, size = {name: stage.spec for name, stage in found.stages.items()}, found.recipe["shard_size"]
    layout = stages.Layout(Path(), plan, found.recipe["seed"], size, _shard_stage(found) or "")
    for name, entry in _units(found, slim):
        unit = Unit(entry.demo_range[0] // size, *entry.demo_range)
        if (entry.key, entry.path) != (layout.key(name, unit), layout.path(name, unit)):
            yield f"{entry.path}: its key or its place is not what stage {name}, recipe, seed and demos give"
    for name, stage in found.stages.items():
        for section, values in stage.spec["sections"].items():
            if stage.units and found.recipe.get(section) != values:
                yield f"manifest.json: stages.{name}.spec: {section} is not that of the recipe"


def unnamed(root: Path, found: Manifest) -> list[Path]:
    """Folders of units that the manifest does not name."""
    named = {entry.path for entry in found.shards} | {entry.path for _, entry in _units(found)}
    listed = [*_listed(root, "shards", 2), *_listed(root, "stages", 2)]
    return [root / name for name, is_folder in listed if is_folder and name.count("/") == 2 and name not in named]


def freed(folder: Path) -> int:
    """Bytes that deleting a folder frees: files that others are linked to free nothing."""
    if (stored := remote.size(folder)) is not None:
        return stored
    facts = [path.lstat() for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    return sum(fact.st_size for fact in facts if fact.st_nlink == 1)


def _notes(root: Path, found: Manifest) -> Iterator[str]:
    if _is_slim(root, found):
        count = sum(len(stage.units) for stage in found.stages.values()) - len(found.shards)
        yield (
            f"stages/ is not here: its {count} units, rejects and whether the shards follow from them were not checked; "
            "the shards are complete in themselves, but cannot be labelled again"
        )
    for entry in found.missing:
        first, last = entry.demo_range[0], entry.demo_range[1] - 1
        yield f"demos {first} to {last} are missing: {entry.stage} failed: {entry.reason}; run generate and label to try again"
    folders = unnamed(root, found)
    if folders:
        total = sum(freed(path) for path in folders)
        yield f"{len(folders)} units ({total / 1e6:.1f} MB) are of other recipes or labellings; `dapdata gc` frees them"
