"""Is a dataset whole, and does it make sense: `verify`.

It looks at three depths. Quick: every file against its hash, and every claim of the manifest and the units' records
against each other. As it is by default: the shards decoded as well, each demo against its digest and against what must
hold of it (`store.problems`, `sense.nonsense`). Deep: the cached units too, their keys computed anew, what arrays say of
themselves, and what only all demos together can tell, such as a geometry that two splits share.

Nothing that is read is trusted: files are compared with their hashes before anything is decoded, and whatever is wrong
becomes a line of the report, never a traceback.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from dapdata import durable, manifest, sense, split, stages, store
from dapdata.errors import CorruptionError
from dapdata.manifest import Manifest, UnitEntry
from dapdata.records import Array
from dapdata.schemas import shard_schema

OWN_FILES = (manifest.MANIFEST, manifest.PROGRESS, manifest.LOG, durable.LOCK)  # of the machinery, not of the data
OWN_FOLDERS = (durable.STAGING, "stages", "shards", "quarantine", manifest.PREVIEWS)
INSTANCES = ("container_instance", "object_instance")
GEOMETRY = {  # arrays that say what a container with its clutter, or an object, is like
    "container": ("scene/kind", "scene/size", "scene/T_container_part"),
    "object": ("object_parts/kind", "object_parts/size", "object_parts/T_object_part"),
}
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
    """What the units told while they were looked at, one after the other."""

    files: int = 0
    demos: int = 0
    rows: list[tuple[str, int, dict[str, Any]]] = field(default_factory=list)  # shard, row in it, what its record says
    rejects: dict[str, Counter[str]] = field(default_factory=dict)
    digests: dict[str, list[str]] = field(default_factory=dict)  # of the demos, by stage
    arrays: dict[str, list[str]] = field(default_factory=dict)  # paths of those that a stage makes
    upstream: dict[tuple[str, int], str] = field(default_factory=dict)  # digest by stage and demo
    geometry: dict[str, dict[int, str]] = field(default_factory=dict)  # digest by body and demo


def verify(root: str | Path, *, quick: bool = False, deep: bool = False, progress: Progress | None = None) -> Audit:
    """Compares a dataset with its manifest, down to each decoded demo.

    Args:
        root: The dataset's folder.
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
    seen, shard_stage = _Seen(files=len(found.files)), _shard_stage(found)
    problems = [*_single_files(root, found), *_extra_files(root, found), *_lists(found)]
    units = [(name, entry) for name, stage in found.stages.items() for entry in stage.units]
    units.sort(key=lambda unit: unit[0] == shard_stage)  # shards are compared with what came before them
    for done, (stage, entry) in enumerate(units, 1):
        is_shard = stage == shard_stage
        record, damage = _record(root, entry, stage)
        problems += damage
        if record is not None and not damage:
            _note(seen, stage, entry, record, is_shard)
            if deep:
                problems += _described(root, entry, record, is_shard)
            if deep or (is_shard and not quick):
                problems += _decoded(root, entry, record, stage if not is_shard else None, seen)
        if progress:
            progress(done, len(units))
    if not problems:
        problems += [*_claims(root, found, seen), *(_lineage(found) if deep else ()), *_leaks_of_geometry(root, found, seen)]
    return Audit(str(root), tuple(problems), tuple(_notes(root, found)), seen.files, seen.demos, found.content_sha256)


# Files -------------------------------------------------------------------------------------------------------


def _single_files(root: Path, found: Manifest) -> Iterator[str]:
    if manifest.encode(durable.read_json(root / manifest.MANIFEST)) != (root / manifest.MANIFEST).read_bytes():
        yield "manifest.json: its bytes are not those that were written"
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
    for path in sorted([*root.glob("shards/*"), *root.glob("shards/*/*"), *root.glob("stages/*"), *root.glob("stages/*/*")]):
        if not path.is_dir() or path.is_symlink():
            yield f"{path.relative_to(root)}: not part of the dataset"


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


def _note(seen: _Seen, stage: str, entry: UnitEntry, record: Record, is_shard: bool) -> None:
    """Keeps what a unit's record says, for the claims that are about all of them."""
    seen.files += len(record["files"])
    seen.digests.setdefault(stage, []).extend(row["sha256"] for row in record["rows"])
    for what, counts in record.get("rejects", {}).items():
        seen.rejects.setdefault(what, Counter()).update(counts)
    if is_shard:
        seen.rows += [(entry.path, number, row) for number, row in enumerate(record["rows"])]
    else:
        seen.arrays[stage] = store.array_paths(record)


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
    missing = {*shard_schema()["required"]} - {*store.stored_paths(record)} if stage is None else set()
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
            seen.demos += 1
            for body, paths in GEOMETRY.items():
                if len(sample[paths[0]]):
                    seen.geometry.setdefault(body, {})[row["demo"]] = _geometry(sample, paths)
        else:
            seen.upstream[stage, row["demo"]] = row["sha256"]
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
        expected = seen.upstream.get((stage, demo))
        if expected and store.demo_digest({path: sample[path] for path in paths if path in sample}) != expected:
            yield f"what stage {stage} made is not what its own unit holds"


def _geometry(sample: store.Sample, paths: tuple[str, ...]) -> str:
    """A digest of all that says what a body is like."""
    total = sha256()
    for path in (*paths, *sorted(path for path in sample if path.startswith("mesh_"))):
        total.update(sample[path].tobytes())
    return total.hexdigest()


# All units ---------------------------------------------------------------------------------------------------


def _shard_stage(found: Manifest) -> str | None:
    """The stage whose units are the shards, if it was run."""
    return next(
        (name for name, stage in found.stages.items() if stage.units and stage.units[0].path.startswith("shards/")), None
    )


def _lists(found: Manifest) -> Iterator[str]:
    """The units of every stage are those of the recipe's demos, and the shards are the units of one stage."""
    shard_stage = _shard_stage(found)
    if found.shards and (shard_stage is None or found.stages[shard_stage].units != found.shards):
        yield "manifest.json: the shards are not the units of a stage"
    ranges = [(unit.start, unit.stop) for unit in stages.units(found.recipe["demos"], found.recipe["shard_size"])]
    for name, stage in found.stages.items():
        if stage.units and [unit.demo_range for unit in stage.units] != ranges:
            yield f"manifest.json: the units of stage {name} are not those of {found.recipe['demos']} demos"
    for name in ("name", "demos"):
        if getattr(found, name) != found.recipe[name]:
            yield f"manifest.json: {name} {getattr(found, name)}, expected {found.recipe[name]} as in the recipe"
    if found.task != found.recipe["scene"].get("task"):
        yield f"manifest.json: task {found.task}, expected {found.recipe['scene'].get('task')} as in the recipe"


def _claims(root: Path, found: Manifest, seen: _Seen) -> Iterator[str]:
    """Compares what manifest and index say with the units: content, rejects, places, splits that share nothing."""
    order, shard_stage = sorted(seen.digests, key=lambda name: len(_needed(found, name))), _shard_stage(found)
    used = [shard_stage] if shard_stage else order
    if store.content_digest([digest for name in used for digest in seen.digests[name]]) != found.content_sha256:
        yield "manifest.json: content_sha256 is not that of the units"
    for what, counts in found.rejects.model_dump().items():
        if {**seen.rejects.get(what, {})} != counts:
            yield f"manifest.json: rejects.{what} are not those of the units"
    if not found.shards:
        return
    try:
        index = manifest.read_index(root, found)
        yield from _index_problems(index, seen.rows)
        yield from _leaks(index, found)
    except CorruptionError as error:
        yield str(error)


def _needed(found: Manifest, name: str) -> set[str]:
    """A stage with all those before it."""
    return {name}.union(*(_needed(found, need) for need in found.stages[name].spec["needs"]))


def _index_problems(index: Mapping[str, Array], rows: list[tuple[str, int, dict[str, Any]]]) -> Iterator[str]:
    """Compares the index, each column of it, with what the shards say of their demos."""
    if len(set(index["demo"].tolist())) != len(index["demo"]):
        yield "index.parquet: a demo is there twice"
    told = {"shard": [shard for shard, _, _ in rows], "row": [number for _, number, _ in rows]}
    told |= {name: [row.get(name) for _, _, row in rows] for name in index if name in rows[0][2]}
    for name, column in told.items():
        if index[name].tolist() != column:
            yield f"index.parquet: column {name} is not what the shards say"


def _leaks(index: Mapping[str, Array], found: Manifest) -> Iterator[str]:
    """Instances and draws that two splits share, and splits that the manifest tells otherwise."""
    for name in INSTANCES:
        for part in {*found.splits, *index["split"].tolist()}:
            mine, told = index["split"] == part, found.splits.get(part)
            instances = sorted({*index[name][mine].tolist()})
            if told is None or instances != getattr(told, f"{name}s") or int(mine.sum()) != told.demos:
                yield f"manifest.json: splits.{part}: demos or {name}s are not those of the index"
        yield from _shared(name, zip(index[name].tolist(), index["split"].tolist()))
    yield from _shared("seed and demo", zip(zip(index["seed"].tolist(), index["demo"].tolist()), index["split"].tolist()))


def _leaks_of_geometry(root: Path, found: Manifest, seen: _Seen) -> Iterator[str]:
    """Bodies that are the same in two splits, whatever their instances are called."""
    if seen.geometry:
        index = manifest.read_index(root, found)
        splits = dict(zip(index["demo"].tolist(), index["split"].tolist()))
        for body, digests in seen.geometry.items():
            yield from _shared(f"{body} geometry", ((digest[:12], splits[demo]) for demo, digest in digests.items()))


def _shared(what: str, pairs: Iterable[tuple[Any, str]]) -> Iterator[str]:
    """What is in more than one split, of pairs of a thing and its split; demos that are unused may share with any."""
    owners: dict[Any, set[str]] = {}
    for thing, part in pairs:
        if part != split.UNUSED:
            owners.setdefault(thing, set()).add(part)
    shared = {thing: parts for thing, parts in owners.items() if len(parts) > 1}
    for thing, parts in list(shared.items())[:MANY]:
        yield f"index.parquet: {what} {thing} is in {' and '.join(sorted(parts))}: {len(shared)} leak"


def _lineage(found: Manifest) -> Iterator[str]:
    """Computes each unit's key and place anew from what its stage's results follow from."""
    plan = {name: stage.spec for name, stage in found.stages.items()}
    layout = stages.Layout(Path(), plan, found.recipe["seed"], found.recipe["shard_size"], _shard_stage(found) or "")
    for unit in stages.units(found.recipe["demos"], found.recipe["shard_size"]):
        for name, stage in found.stages.items():
            if stage.units:
                entry = stage.units[unit.index]
                if (entry.key, entry.path) != (layout.key(name, unit), layout.path(name, unit)):
                    yield f"{entry.path}: its key or its place is not what stage {name}, recipe, seed and demos give"
    for name, stage in found.stages.items():
        for section, values in stage.spec["sections"].items():
            if stage.units and found.recipe.get(section) != values:
                yield f"manifest.json: stages.{name}.spec: {section} is not that of the recipe"


def unnamed(root: Path, found: Manifest) -> list[Path]:
    """Folders of units that the manifest does not name."""
    named = {root / entry.path for entry in (*found.shards, *(unit for stage in found.stages.values() for unit in stage.units))}
    folders = [*root.glob("shards/*/*"), *root.glob("stages/*/*")]
    return [path for path in sorted(folders) if path.is_dir() and not path.is_symlink() and path not in named]


def freed(folder: Path) -> int:
    """Bytes that deleting a folder frees: files that others are linked to free nothing."""
    facts = [path.lstat() for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    return sum(fact.st_size for fact in facts if fact.st_nlink == 1)


def _notes(root: Path, found: Manifest) -> Iterator[str]:
    folders = unnamed(root, found)
    if folders:
        total = sum(freed(path) for path in folders)
        yield f"{len(folders)} units ({total / 1e6:.1f} MB) are of other recipes or labellings; `dapdata gc` frees them"
