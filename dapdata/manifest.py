"""What a dataset is now: `manifest.json`, and `index.parquet` with one row a demo.

The manifest names everything else with its sha256: each unit by the hash of its root, which in turn names the
unit's files, and each single file by its own; and itself by a digest of the rest. It is replaced last. Where a file
with a fixed name (index, card) changes, the old manifest goes first: a crash in between leaves no manifest rather than
one that is wrong, and running the command again brings it back at once, from what `progress.json` says of it.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from graphlib import TopologicalSorter
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, Field, ValidationError

from dapdata import durable
from dapdata.config import Section
from dapdata.errors import CorruptionError, FormatError
from dapdata.records import Array

FORMAT = 1
MANIFEST = "manifest.json"
INDEX = "index.parquet"
CARD = "README.md"
PREVIEWS = "preview"
PROGRESS = "progress.json"  # what a running or interrupted command works on
LOG = "log.jsonl"  # when each unit was made, by whom, how long it took: never read by the data's users
INDEX_COLUMNS = {  # of the index that reading relies on, with numpy's kinds
    "demo": "i", "split": "U", "shard": "U", "row": "i", "task": "U", "container_instance": "i", "object_instance": "i",
    "sha256": "U", "seed": "i",
}  # fmt: skip
MAX_UNITS = 1_000_000  # of a stage: more are no dataset of ours
ROW_BYTES = 32  # that a row of the index takes at least: the demo's own digest
MAX_COLUMNS, MAX_WORD, MAX_INFLATION = 100, 200, 100  # of the index: more is no index of ours but a bomb


def _inside(path: str) -> str:
    """A path that stays in the dataset's folder."""
    parts = PurePosixPath(path).parts
    if (
        not parts
        or path.startswith("/")
        or "\\" in path
        or not path.isprintable()
        or any(part in ("..", ".") for part in parts)
    ):
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


class UnitEntry(Section):
    """A committed unit: a shard, or a cached unit of an upstream stage."""

    path: RelativePath = Field(description="folder of the Zarr group, from the dataset's folder")
    demos: int = Field(ge=0, description="demos that are in it")
    demo_range: tuple[int, int] = Field(description="first demo, and one past the last, that it was made for")
    key: Sha256 = Field(description="digest of all that decides its content")
    sha256: Sha256 = Field(description="of the group's own zarr.json, which names every other file with its sha256")
    bytes: int = Field(ge=0, description="size of its files")


class StageEntry(Section):
    """How a stage was run, and the units that came of it."""

    spec: Spec = Field(description="version, recipe sections and packages that decide its results")
    units: list[UnitEntry] = Field(description="in demo order; empty if it is to be run again")


class SplitEntry(Section):
    """A split and the instances in it; no instance is in two splits."""

    demos: int = Field(ge=0)
    container_instances: list[int]
    object_instances: list[int]


class Rejects(Section):
    """What did not work out, each by reason."""

    attempts: dict[str, int] = Field(description="scenes that were drawn and given up; another was drawn instead")
    demos: dict[str, int] = Field(description="demos that are absent from the shards")
    goals: dict[str, int] = Field(description="candidate goals that did not hold; kept apart in rejected_goals/")


class Manifest(Section):
    """A dataset: what it was made from, and what it consists of."""

    format: int = Field(ge=1, description="version of the format")
    name: str
    task: str
    demos: int = Field(ge=0, description="demos asked for; those in the shards are this less rejects.demos")
    content_sha256: Sha256 = Field(description="over the decoded arrays of every demo, in demo order")
    recipe: Resolved = Field(description="resolved: every default filled in")
    recipe_sha256: Sha256 = Field(description="of the resolved recipe as canonical JSON")
    shards: list[UnitEntry] = Field(description="in demo order; empty until the dataset is labelled")
    splits: dict[str, SplitEntry] = Field(description="train, val, test; unused: would share an instance with two of them")
    rejects: Rejects
    stages: Annotated[dict[str, StageEntry], AfterValidator(_acyclic)] = Field(
        description="every stage that was run; the units of the last are the shards"
    )
    files: dict[RelativePath, Sha256] = Field(description="every other file that belongs to the dataset")
    created_by: dict[str, str] = Field(description="versions of the packages that wrote it")
    manifest_sha256: Sha256 | None = Field(default=None, description="of the rest of this file as canonical JSON")


class Progress(Section):
    """What a running or interrupted command works on: enough to go on where there is no manifest."""

    recipe: Resolved
    specs: Annotated[dict[str, Spec], AfterValidator(_acyclic)] = Field(description="of all stages")
    stages: list[str] = Field(description="that the command runs")
    shard_stage: str


class LogLine(BaseModel):
    """What a worker tells of a unit that it made in one stage; whatever else it told is not read."""

    stage: str
    demos: int = Field(ge=0)
    cpu_seconds: float = Field(ge=0, allow_inf_nan=False)
    bytes: int = Field(ge=0)
    peak_mb: int = Field(ge=0)


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
        tree = durable.read_json(path)
        _check_digest(tree)
        _check_format(path, tree)
        found = Manifest.model_validate_json(json.dumps(tree))
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


def encode(tree: Mapping[str, Any]) -> bytes:
    """The bytes of a manifest."""
    return json.dumps(tree, indent=1, sort_keys=True).encode() + b"\n"


def _check_digest(tree: Any) -> None:
    """Raises a ValueError if a manifest is not what was written; those of early datasets carry no digest."""
    if isinstance(tree, dict) and "manifest_sha256" in tree and tree["manifest_sha256"] != _own_digest(tree):
        raise ValueError("its bytes are not those that were written")


def _own_digest(tree: Mapping[str, Any]) -> str:
    return durable.digest({name: value for name, value in tree.items() if name != "manifest_sha256"})


def _check_format(path: Path, tree: Any) -> None:
    found = tree.get("format") if isinstance(tree, dict) else None
    if type(found) is not int:
        raise FormatError(f"{path}: `format` is {found!r}, expected {FORMAT}; this is no manifest of dapdata")
    if found != FORMAT:
        makers = tree.get("created_by")
        maker = str(makers.get("dapdata", "unknown") if isinstance(makers, dict) else "unknown")[:40]
        remedy = "update dapdata" if found > FORMAT else "generate it again, or read it with that version"
        raise FormatError(f"{path}: format {found}, made by dapdata {maker}; this dapdata reads format {FORMAT}: {remedy}")


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


def read_log(root: Path) -> list[dict[str, Any]]:
    """The lines of the log, oldest first; those that a kill or anything else cut short are left out."""
    path = root / LOG
    if path.is_symlink() or not path.is_file() or path.stat().st_size > durable.MAX_JSON:
        return []
    lines = []
    for text in path.read_text(errors="replace").splitlines():
        with suppress(ValueError):
            lines.append(LogLine.model_validate_json(text).model_dump())
    return lines


def publish(root: Path, manifest: Manifest, files: Mapping[str, bytes]) -> None:
    """Makes the manifest the dataset's own, together with the single files whose hashes are added to it.

    Args:
        root: The dataset's folder; the caller holds its lock.
        manifest: What is there now; every unit that it names is committed.
        files: Contents by path, such as the index and the card.
    """
    hashes = {path: sha256(data).hexdigest() for path, data in files.items()}
    manifest = manifest.model_copy(update={"files": dict(sorted(hashes.items()))})
    tree = manifest.model_dump(mode="json")
    data = encode(tree | {"manifest_sha256": _own_digest(tree)})
    changed = {path: files[path] for path in files if not _holds(root / path, files[path])}
    gone = [path for path in single_files(root) if path not in files]
    if _holds(root / MANIFEST, data) and not changed and not gone:
        return
    if changed or gone:
        durable.remove_file(root / MANIFEST)
    for path, content in changed.items():
        durable.replace_file(root / path, content)
    for path in gone:
        durable.remove_file(root / path)
    durable.replace_file(root / MANIFEST, data)


def _holds(path: Path, data: bytes) -> bool:
    return path.is_file() and path.read_bytes() == data


def single_files(root: Path) -> list[str]:
    """The single files that belong to datasets and are there, whether or not a manifest survived that names them."""
    found = [root / INDEX, root / CARD, *(root / PREVIEWS).glob("*")]
    return [path.relative_to(root).as_posix() for path in found if path.is_file()]


# The index -------------------------------------------------------------------------------------------------


def index_bytes(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """A Parquet file with one row a demo; integers are int64, words are strings."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    sink = io.BytesIO()
    table = pa.Table.from_pylist([dict(row) for row in rows])
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue()


def read_index(root: Path, found: Manifest) -> dict[str, Array]:
    """The columns of `index.parquet` as arrays of one length: a row for each demo of the shards.

    Raises:
        CorruptionError: if it is missing, or not what the manifest names, or names what is not there.
    """
    import pyarrow as pa

    try:
        path = root / INDEX
        if path.is_symlink() or durable.hash_file(path) != found.files.get(INDEX):
            raise ValueError("its bytes are not those that were written")
        columns = _columns(path, sum(shard.demos for shard in found.shards))
        _check_places(columns, {shard.path: shard.demos for shard in found.shards})
        return columns
    except (OSError, ValueError, pa.ArrowException) as error:
        raise CorruptionError(f"{root / INDEX}: cannot be read ({error}); run `dapdata verify {root}`") from error


def _columns(path: Path, expected: int) -> dict[str, Array]:
    """A Parquet file's columns; sizes that its bytes cannot hold are refused before anything is decoded."""
    import pyarrow.parquet as pq

    names = pq.read_schema(path).names
    with pq.ParquetFile(path, read_dictionary=names) as file:  # words once each, however often a bomb repeats them
        about, size = file.metadata, path.stat().st_size
        groups = [about.row_group(i) for i in range(about.num_row_groups)]
        if about.num_rows != expected or expected * ROW_BYTES > size or len(names) > MAX_COLUMNS:
            raise ValueError(f"{about.num_rows} rows of {len(names)} columns in {size} bytes, expected {expected} rows")
        if sum(group.total_byte_size for group in groups) > MAX_INFLATION * size:
            raise ValueError(f"unpacks to more than {MAX_INFLATION} times its {size} bytes")
        table = file.read()
    for name in names:
        longest = max((len(word) for word in _words(table.column(name))), default=0)
        if longest > MAX_WORD:
            raise ValueError(f"column {name}: a word of {longest} characters, expected at most {MAX_WORD}")
    return {name: np.asarray(table.column(name).to_pylist()) for name in names}


def _words(column: Any) -> Iterator[str]:
    """The different words of an Arrow column of text."""
    import pyarrow as pa

    for chunk in column.chunks if pa.types.is_dictionary(column.type) else ():
        yield from (str(word) for word in chunk.dictionary.to_pylist())


def _check_places(columns: Mapping[str, Array], shards: Mapping[str, int]) -> None:
    """Raises a ValueError unless each row says which demo it is and names a row of a shard that is there."""
    for name, kinds in INDEX_COLUMNS.items():
        if name not in columns or (len(columns[name]) and columns[name].dtype.kind not in kinds):
            raise ValueError(f"column {name}: missing, or of another type")
    for shard, row in zip(columns["shard"].tolist(), columns["row"].tolist()):
        if not 0 <= row < shards.get(shard, 0):
            raise ValueError(f"row {row} of {shard[:80]}: not there")
