"""What a dataset is now: `manifest.json`, and `index.parquet` with one row a demo.

The manifest names everything else with its sha256: each unit by the hash of its root, which in turn names the
unit's files, and each single file by its own; and itself by a digest of its other bytes. It is replaced last. Where a file
with a fixed name (index, card) changes, the old manifest goes first: a crash in between leaves no manifest rather than
one that is wrong, and running the command again brings it back at once, from what `progress.json` says of it.

A manifest is of format 1 and has all in itself as long as it is small. With more than `LARGE` units and instances it is
of format 2: shards are still listed with path, demos and sha256, but all else of units stands in `units.parquet`, which
it names by its sha256, and of the instances of a split only their number is told (the index has them). So a reader
of format 1 reads every dataset that it could hold anyway, and one of ten million demos opens in a second.
"""

from __future__ import annotations

import json
import re
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from graphlib import TopologicalSorter
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal, overload

from pydantic import AfterValidator, BaseModel, Field, ValidationError

from dapdata import durable, tables
from dapdata.config import Section
from dapdata.errors import CorruptionError, FormatError

FORMAT: Literal[1] = 1
LARGE_FORMAT: Literal[2] = 2
LARGE = 100_000  # units and instances: as many take a quarter of a second to open, and 100 MB of memory
MANIFEST = "manifest.json"
INDEX = "index.parquet"
UNITS = "units.parquet"  # of datasets of format 2
CARD = "README.md"
CROISSANT = "croissant.json"
PREVIEWS = "preview"
PROGRESS = "progress.json"  # what a running or interrupted command works on
LOG = "log.jsonl"  # when each unit was made, by whom, how long it took: never read by the data's users
INDEX_NUMBERS = ("demo", "row", "seed", "container_instance", "object_instance")  # columns that reading relies on
INDEX_WORDS = ("split", "shard", "task", "sha256")
MAX_UNITS = 1_000_000  # of a stage: more are no dataset of ours
OWN_DIGEST = re.compile(rb'"manifest_sha256": "([0-9a-f]{64})"')


def _inside(path: str) -> str:
    """A path that stays in the dataset's folder."""
    if "\\" in path or not path.isprintable() or any(part in ("", ".", "..") for part in path.split("/")):
        raise ValueError("expected a relative path inside of the dataset")
    return path


def _spec(spec: dict[str, Any]) -> dict[str, Any]:
    """What a stage's results follow from, with all that unit keys are made from."""
    kinds = {"version": int, "sections": dict, "needs": list, "packages": dict}
    for name, kind in kinds.items():
        if not isinstance(spec.get(name), kind):
            raise ValueError(f"{name}: got {type(spec.get(name)).__name__}, expected {kind.__name__}")
    if not all(isinstance(need, str) for need in spec["needs"]):
        raise ValueError("needs: expected names of stages")
    return spec


def _acyclic(specs: dict[str, Any]) -> dict[str, Any]:
    """Specs, or entries with specs, that need only each other, and not in a circle."""
    needs = {name: getattr(entry, "spec", entry)["needs"] for name, entry in specs.items()}
    unknown = [need for mine in needs.values() for need in mine if need not in needs]
    if unknown:
        raise ValueError(f"needs {unknown[0]!r}, expected one of {', '.join(needs)}")
    TopologicalSorter(needs).prepare()
    return specs


def _recipe(recipe: dict[str, Any]) -> dict[str, Any]:
    """A resolved recipe, as far as reading a dataset needs it."""
    kinds = {"name": str, "seed": int, "demos": int, "shard_size": int, "scene": dict}
    for name, kind in kinds.items():
        if type(recipe.get(name)) is not kind:
            raise ValueError(f"{name}: got {type(recipe.get(name)).__name__}, expected {kind.__name__}")
    if recipe["seed"] < 0 or not recipe["shard_size"] > 0 or not 0 < recipe["demos"] <= MAX_UNITS * recipe["shard_size"]:
        raise ValueError("seed, demos or shard_size: not those of a recipe")
    return recipe


RelativePath = Annotated[str, AfterValidator(_inside)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Spec = Annotated[dict[str, Any], AfterValidator(_spec)]
Resolved = Annotated[dict[str, Any], AfterValidator(_recipe)]


class ShardEntry(Section):
    """A committed unit, as much of it as everybody needs."""

    path: RelativePath = Field(description="folder of the Zarr group, from the dataset's folder")
    demos: int = Field(ge=0, description="demos that are in it")
    sha256: Sha256 = Field(description="of the group's own zarr.json, which names every other file with its sha256")


class UnitEntry(ShardEntry):
    """A committed unit: a shard, or a cached unit of an upstream stage."""

    demo_range: tuple[int, int] = Field(description="first demo, and one past the last, that it was made for")
    key: Sha256 = Field(description="digest of all that decides its content")
    bytes: int = Field(ge=0, description="size of its files")


class StageEntry(Section):
    """How a stage was run, and the units that came of it."""

    spec: Spec = Field(description="version, recipe sections and packages that decide its results")
    units: Sequence[UnitEntry] = Field(description="in demo order; empty if it is to be run again")


class MissingEntry(Section):
    """Demos that are not there because their unit failed, in a dataset that was published all the same."""

    demo_range: tuple[int, int] = Field(description="first demo, and one past the last")
    stage: str = Field(description="that failed; those after it were not run")
    reason: str = Field(description="how its last try ended")


class SplitEntry(Section):
    """A split and the instances in it; no instance is in two splits."""

    demos: int = Field(ge=0)
    container_instances: list[int] | int = Field(description="or in format 2 their number")
    object_instances: list[int] | int = Field(description="or in format 2 their number")


class Rejects(Section):
    """What did not work out, each by reason."""

    attempts: dict[str, int] = Field(description="scenes that were drawn and given up; another was drawn instead")
    demos: dict[str, int] = Field(description="demos that are absent from the shards")
    goals: dict[str, int] = Field(description="candidate goals that did not hold; kept apart in rejected_goals/")


class _Facts(Section):
    name: str
    task: str
    demos: int = Field(ge=0, description="demos asked for; those in the shards are this less rejects.demos and missing")
    content_sha256: Sha256 = Field(description="over the decoded arrays of every demo, in demo order")
    recipe: Resolved = Field(description="resolved: every default filled in")
    recipe_sha256: Sha256 = Field(description="of the resolved recipe as canonical JSON")
    splits: dict[str, SplitEntry] = Field(description="train, val, test; unused: would share an instance with two of them")
    rejects: Rejects
    missing: list[MissingEntry] = Field(
        default=[], description="units that failed; empty unless published with --allow-missing"
    )
    files: dict[RelativePath, Sha256] = Field(description="every other file that belongs to the dataset")
    created_by: dict[str, str] = Field(description="versions of the packages that wrote it")
    manifest_sha256: Sha256 | None = Field(default=None, description="of this file, with 64 zeros in this place")


class Progress(Section):
    """What a running or interrupted command works on: enough to go on where there is no manifest."""

    recipe: Resolved
    specs: Annotated[dict[str, Spec], AfterValidator(_acyclic)] = Field(description="of all stages")
    stages: list[str] = Field(description="that the command runs")
    shard_stage: str
    missing: list[MissingEntry] = Field(default=[], description="units that the stages before these could not make")


class LogLine(BaseModel):
    """What a worker tells of a unit that it made in one stage; whatever else it told is not read."""

    stage: str
    demos: int = Field(ge=0)
    cpu_seconds: float = Field(ge=0, allow_inf_nan=False)
    bytes: int = Field(ge=0)
    peak_mb: int = Field(ge=0)


class Manifest(_Facts):
    """A dataset: what it was made from, and what it consists of. In memory every manifest is one, of either format."""

    format: Literal[1] = Field(description="version of the format")
    shards: Sequence[UnitEntry] = Field(description="in demo order; empty until the dataset is labelled")
    stages: Annotated[dict[str, StageEntry], AfterValidator(_acyclic)] = Field(
        description="every stage that was run; the units of the last are the shards"
    )


class LargeStageEntry(Section):
    """How a stage was run, and how many units came of it."""

    spec: Spec = Field(description="version, recipe sections and packages that decide its results")
    units: int = Field(ge=0, description="rows of units.parquet with this stage; 0 if it is to be run again")


class LargeManifest(_Facts):
    """A dataset whose units stand in units.parquet: stage, path, demos, start, stop, key, sha256, bytes."""

    format: Literal[2] = Field(description="version of the format")
    shards: Sequence[ShardEntry] = Field(description="in demo order; empty until the dataset is labelled")
    shard_stage: str = Field(description="the stage whose units are the shards")
    stages: Annotated[dict[str, LargeStageEntry], AfterValidator(_acyclic)] = Field(description="every stage that was run")


class Units(Sequence[UnitEntry]):
    """The units of one stage in demo order, from `units.parquet`, which is read when the first of them is asked for."""

    def __init__(self, table: Path, stage: str, count: int) -> None:
        self.table, self.stage, self._rows = table, stage, count

    def __len__(self) -> int:
        return self._rows

    @overload
    def __getitem__(self, number: int) -> UnitEntry: ...
    @overload
    def __getitem__(self, number: slice) -> list[UnitEntry]: ...
    def __getitem__(self, number: int | slice) -> UnitEntry | list[UnitEntry]:
        if isinstance(number, slice):
            return [self[i] for i in range(*number.indices(self._rows))]
        path, demos, start, stop, key, digest, size = (column[number] for column in self._columns)
        return UnitEntry.model_construct(  # the columns were checked when they were read
            path=path, demos=demos, demo_range=(start, stop), key=key.hex(), sha256=digest.hex(), bytes=size
        )

    def __iter__(self) -> Iterator[UnitEntry]:
        return (self[i] for i in range(self._rows))

    def total(self, column: str) -> int:
        """The sum of a column, of which nothing is kept."""
        return sum(tables.read(self.table, "stage", self.stage, [column])[column])

    @cached_property
    def _columns(self) -> list[list[Any]]:
        """path, demos, start, stop, key, sha256, bytes."""
        found = tables.read(self.table, "stage", self.stage)
        try:
            columns = [found[name] for name in UNIT_COLUMNS]
            for path in columns[0]:
                _inside(path)
        except (KeyError, ValueError, TypeError) as error:
            raise CorruptionError(f"{self.table}: {error}; expected the units of stage {self.stage}") from error
        if len(columns[0]) != self._rows:
            raise CorruptionError(f"{self.table}: {len(columns[0])} units of stage {self.stage}, expected {self._rows}")
        return columns


UNIT_COLUMNS = ("path", "demos", "start", "stop", "key", "sha256", "bytes")


def total_bytes(units: Sequence[UnitEntry]) -> int:
    """Bytes of all files of some units."""
    return units.total("bytes") if isinstance(units, Units) else sum(unit.bytes for unit in units)


def unit_row(stage: str, entry: UnitEntry) -> dict[str, Any]:
    """A unit as a row of `units.parquet`."""
    digests = {"key": bytes.fromhex(entry.key), "sha256": bytes.fromhex(entry.sha256)}
    start, stop = entry.demo_range
    values = {"path": entry.path, "demos": entry.demos, "start": start, "stop": stop, **digests, "bytes": entry.bytes}
    return {"stage": stage, **values}


def read(root: Path) -> Manifest:
    """The manifest of a dataset.

    Raises:
        FormatError: if there is no dataset, or one of another format.
        CorruptionError: if there is a manifest that isn't one.
    """
    path = root / MANIFEST
    if not root.is_dir():
        raise FormatError(f"{root}: no such folder, expected a dataset; make one with `dapdata generate RECIPE --out {root}`")
    if not path.is_file():
        if (root / PROGRESS).is_file():
            raise FormatError(f"{root}: no {MANIFEST} yet, generation is running or was interrupted; run it again to go on")
        raise FormatError(f"{root}: no {MANIFEST}, expected a dataset's folder; datasets are made with `dapdata generate`")
    try:
        data = durable.read_plain(path)
        _check_digest(data)
        tree = durable.parse_json(data)
        is_small = _format(path, tree) == FORMAT
        found = Manifest.model_validate_json(json.dumps(tree)) if is_small else _from_large(root, tree)
        if durable.digest(found.recipe) != found.recipe_sha256:
            raise ValueError("recipe_sha256 is not that of the recipe")
        return found
    except (ValueError, OSError) as error:  # pydantic's and json's errors are ValueErrors
        if isinstance(error, FormatError):
            raise
        raise CorruptionError(
            f"{path}: {_first_problem(error)}; expected the manifest of format {FORMAT}: run the `dapdata generate` that made "
            "the dataset again, it writes the manifest anew"
        ) from error


def encode(tree: Mapping[str, Any], indent: int | None = 1) -> bytes:
    """The bytes of a manifest, which carries its own digest."""
    data = json.dumps({**tree, "manifest_sha256": "0" * 64}, indent=indent, sort_keys=True).encode() + b"\n"
    return OWN_DIGEST.sub(b'"manifest_sha256": "%s"' % sha256(data).hexdigest().encode(), data)


def _check_digest(data: bytes) -> None:
    """Raises a ValueError if a manifest is not what was written; those of early datasets carry no digest."""
    found = OWN_DIGEST.search(data)
    if found:
        unsigned = data[: found.start(1)] + b"0" * 64 + data[found.end(1) :]
        if sha256(unsigned).hexdigest().encode() != found[1]:
            raise ValueError("its bytes are not those that were written")


def _format(path: Path, tree: Any) -> int:
    """The manifest's format, or a FormatError if it is none of ours."""
    found = tree.get("format") if isinstance(tree, dict) else None
    known = f"{FORMAT} or {LARGE_FORMAT}"
    if type(found) is not int:
        raise FormatError(f"{path}: `format` is {found!r}, expected {known}; this is no manifest of dapdata")
    if found not in (FORMAT, LARGE_FORMAT):
        makers = tree.get("created_by")
        maker = str(makers.get("dapdata", "unknown") if isinstance(makers, dict) else "unknown")[:40]
        remedy = "update dapdata" if found > FORMAT else "generate it again, or read it with that version"
        raise FormatError(f"{path}: format {found}, made by dapdata {maker}; this dapdata reads formats {known}: {remedy}")
    return found


def _from_large(root: Path, tree: dict[str, Any]) -> Manifest:
    """A manifest of format 2; its shards are counted, and looked at only where they are used, in the table."""
    shards = tree.get("shards")
    if not isinstance(shards, list):
        raise ValueError("shards: expected a list")
    large = LargeManifest.model_validate_json(json.dumps({**tree, "shards": []}))
    facts = {name: getattr(large, name) for name in _Facts.model_fields}
    units = {name: Units(root / UNITS, name, entry.units) for name, entry in large.stages.items()}
    stages = {
        name: StageEntry.model_construct(spec=entry.spec, units=units[name] if entry.units else [])
        for name, entry in large.stages.items()
    }
    return Manifest.model_construct(
        **facts, format=FORMAT, shards=Units(root / UNITS, large.shard_stage, len(shards)) if shards else [], stages=stages
    )


def listed_shards(root: Path) -> list[Any]:
    """The shards as the manifest itself lists them, for whoever reads nothing else: path, demos and sha256 of each."""
    listed = json.loads((root / MANIFEST).read_bytes())["shards"]
    return [{name: shard.get(name) for name in ShardEntry.model_fields} for shard in listed]


def _first_problem(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    return str(error)


def read_progress(root: Path) -> Progress | None:
    """What a running or interrupted command works on; None if there is none, or if what it left cannot be read."""
    try:
        return Progress.model_validate_json(json.dumps(durable.read_json(root / PROGRESS)))
    except (OSError, ValueError):
        return None


def publish(root: Path, manifest: Manifest, files: Mapping[str, bytes | Path]) -> None:
    """Makes the manifest the dataset's own, together with the single files whose hashes are added to it.

    Args:
        root: The dataset's folder; the caller holds its lock.
        manifest: What is there now; every unit that it names is committed.
        files: Contents by path, such as the index and the card; or files that are moved there (or are there). With
            `UNITS` among them, the manifest is of format 2 and its units are those.
    """
    hashes = {path: durable.hash_file(new) if isinstance(new, Path) else sha256(new).hexdigest() for path, new in files.items()}
    data = _text(manifest.model_copy(update={"files": dict(sorted(hashes.items()))}), files.get(UNITS))
    changed = [path for path in files if not (root / path).is_file() or durable.hash_file(root / path) != hashes[path]]
    gone = [path for path in single_files(root) if path not in files]
    target = root / MANIFEST
    if target.is_file() and target.read_bytes() == data and not changed and not gone:
        return
    if changed or gone:
        durable.remove_file(target)
    for path in changed:
        new = files[path]
        if isinstance(new, Path):
            durable.move_file(new, root / path)
        else:
            durable.replace_file(root / path, new)
    for path in gone:
        durable.remove_file(root / path)
    durable.replace_file(target, data)


def _text(manifest: Manifest, table: bytes | Path | None) -> bytes:
    """A manifest as it is stored."""
    if not isinstance(table, Path):
        return encode(manifest.model_dump(mode="json"))
    tree = manifest.model_copy(update={"shards": [], "stages": {}}).model_dump(mode="json")
    shards = manifest.shards
    listed = Units(table, shards.stage, len(shards)) if isinstance(shards, Units) else []
    tree |= {
        "format": LARGE_FORMAT,
        "shards": [{name: getattr(entry, name) for name in ShardEntry.model_fields} for entry in listed],
        "shard_stage": shards.stage if isinstance(shards, Units) else "",
        "stages": {name: {"spec": entry.spec, "units": len(entry.units)} for name, entry in manifest.stages.items()},
    }
    return encode(tree, indent=None)


def single_files(root: Path) -> list[str]:
    """The single files that belong to datasets and are there, whether or not a manifest survived that names them."""
    found = [root / INDEX, root / UNITS, root / CARD, root / CROISSANT, *(root / PREVIEWS).glob("*")]
    return [path.relative_to(root).as_posix() for path in found if path.is_file()]


def read_index(root: Path) -> tables.Index:
    """The columns of `index.parquet` as arrays of one length, each read when it is first asked for.

    Raises:
        CorruptionError: if it is missing or no Parquet file, or lacks columns.
    """
    index = tables.Index(root / INDEX)
    there = list(index)  # asking the index whether it has a column would read that
    for name in (*INDEX_NUMBERS, *INDEX_WORDS):
        if name not in there or (name in index.numbers) != (name in INDEX_NUMBERS):
            raise CorruptionError(
                f"{index.path}: column {name} is missing or of another type, expected an index as it was written; "
                f"run `dapdata verify {root}`"
            )
    return index


def read_log(root: Path, last: int | None = None) -> Iterator[dict[str, Any]]:
    """The lines of the log that can be read, one for each unit that was made; only the last so many if asked for."""
    path = root / LOG
    if path.is_symlink() or not path.is_file() or path.stat().st_size > durable.MAX_JSON:
        return
    with path.open(encoding="utf-8", errors="replace") as file:
        for text in file if last is None else deque(file, last):
            with suppress(ValueError):  # half-written, when its writer was killed
                yield LogLine.model_validate_json(text).model_dump()
