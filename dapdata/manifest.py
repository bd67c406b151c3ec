"""What a dataset is now: `manifest.json`, and `index.parquet` with one row a demo.

The manifest names everything else with its sha256: each unit by the hash of its root, which in turn names the
unit's files, and each single file by its own. It is replaced last. Where a file with a fixed name (index, card)
changes, the old manifest goes first: a crash in between leaves no manifest rather than one that is wrong, and
running the command again brings it back at once.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, Field, ValidationError

from dapdata import durable
from dapdata.config import Section
from dapdata.errors import CorruptionError, FormatError
from dapdata.records import Array

FORMAT = 1
MANIFEST = "manifest.json"
INDEX = "index.parquet"
CARD = "README.md"
CROISSANT = "croissant.json"
PREVIEWS = "preview"
PROGRESS = "progress.json"  # what a running or interrupted command works on
LOG = "log.jsonl"  # when each unit was made, by whom, how long it took: never read by the data's users


def _inside(path: str) -> str:
    """A path that stays in the dataset's folder."""
    parts = PurePosixPath(path).parts
    if not parts or path.startswith("/") or "\\" in path or "\0" in path or any(part in ("..", ".") for part in parts):
        raise ValueError("expected a relative path inside of the dataset")
    return path


RelativePath = Annotated[str, AfterValidator(_inside)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


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

    spec: dict[str, Any] = Field(description="version, recipe sections and packages that decide its results")
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
    recipe: dict[str, Any] = Field(description="resolved: every default filled in")
    recipe_sha256: Sha256 = Field(description="of the resolved recipe as canonical JSON")
    shards: list[UnitEntry] = Field(description="in demo order; empty until the dataset is labelled")
    splits: dict[str, SplitEntry] = Field(description="train, val, test; unused: would share an instance with two of them")
    rejects: Rejects
    stages: dict[str, StageEntry] = Field(description="every stage that was run; the units of the last are the shards")
    files: dict[RelativePath, Sha256] = Field(description="every other file that belongs to the dataset")
    created_by: dict[str, str] = Field(description="versions of the packages that wrote it")


def units(found: Manifest) -> Iterator[UnitEntry]:
    """Every unit that a manifest names; the shards come twice, as units of their stage too."""
    yield from found.shards
    for stage in found.stages.values():
        yield from stage.units


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
        tree = json.loads(path.read_bytes())
        _check_format(path, tree)
        return Manifest.model_validate_json(json.dumps(tree))
    except (ValueError, RecursionError) as error:  # pydantic's and json's errors are ValueErrors
        if isinstance(error, FormatError):
            raise
        raise CorruptionError(f"{path}: {_first_problem(error)}; expected the manifest of format {FORMAT}") from error


def _check_format(path: Path, tree: Any) -> None:
    found = tree.get("format") if isinstance(tree, dict) else None
    if type(found) is not int:
        raise FormatError(f"{path}: `format` is {found!r}, expected {FORMAT}; this is no manifest of dapdata")
    if found != FORMAT:
        maker = tree.get("created_by", {}).get("dapdata", "unknown") if isinstance(tree.get("created_by"), dict) else "unknown"
        remedy = "update dapdata" if found > FORMAT else "generate it again, or read it with that version"
        raise FormatError(f"{path}: format {found}, made by dapdata {maker}; this dapdata reads format {FORMAT}: {remedy}")


def _first_problem(error: Exception) -> str:
    if isinstance(error, ValidationError):
        first = error.errors()[0]
        return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    return str(error)


def publish(root: Path, manifest: Manifest, files: Mapping[str, bytes]) -> None:
    """Makes the manifest the dataset's own, together with the single files whose hashes are added to it.

    Args:
        root: The dataset's folder; the caller holds its lock.
        manifest: What is there now; every unit that it names is committed.
        files: Contents by path, such as the index and the card.
    """
    hashes = {path: sha256(data).hexdigest() for path, data in files.items()}
    manifest = manifest.model_copy(update={"files": dict(sorted(hashes.items()))})
    data = json.dumps(manifest.model_dump(mode="json"), indent=1, sort_keys=True).encode() + b"\n"
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
    found = [root / INDEX, root / CARD, root / CROISSANT, *(root / PREVIEWS).glob("*")]
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


def read_index(root: Path) -> dict[str, Array]:
    """The columns of `index.parquet` as arrays of one length.

    Raises:
        CorruptionError: if it is missing or no Parquet file.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        table = pq.read_table(root / INDEX)
    except (OSError, pa.ArrowException) as error:
        raise CorruptionError(f"{root / INDEX}: cannot be read ({error}); run `dapdata verify {root}`") from error
    return {name: np.asarray(table.column(name).to_pylist()) for name in table.column_names}
