"""Units on disk: the only door to zarr, in whose layout `chunks` writes and reads them, byte for byte as it does, but faster.

A unit is one Zarr v3 group that holds some demos: the columns of `records` as concatenated rows, an `offsets`
array for each ragged group, and in the root's attributes under `dapdata` the unit's own record: key, demos,
rejects, and the sha256 of every other file. The manifest names the hash of the root's `zarr.json`, which thereby
covers the unit. (A `unit.json` beside it would make zarr warn every stranger who lists the group.)

Codecs: sharding, zstd, and crc32c last, so that plain zarr refuses a flipped chunk too. One file an array.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import Field, dataclass, field
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from stat import S_ISDIR, S_ISREG
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ValidationError
from pydantic import Field as Key

from dapdata import chunks, durable
from dapdata.errors import CorruptionError
from dapdata.records import PART_KINDS, RECORDS, SYMMETRIES, Array, Meshes, Record, columns, is_ragged

FORMAT = 1
MAX_CHUNK_ROWS = 32768  # fewer rows in a chunk make reading and writing slower, more make nothing faster
ZSTD_LEVEL = 1  # observed coordinates are noise: level 3 is no smaller
MAX_RATIO = 100  # decoded to stored bytes of a unit: more is no data of ours but a bomb
SMALL = 1 << 28  # bytes: units up to this are decoded whatever their ratio
TOLERANCE = 1e-3  # of stored float32 normals
RIGID_TOLERANCE = 1e-6  # of float64 poses
DIRECTIONS = ("normals", "opening", "approach")  # arrays of unit vectors; so is symmetry/axis, where it matters
POSITIVE = {  # arrays in which nothing is below this
    "scene/size": 0, "object_parts/size": 0, "scene/max_tilt": 0, "goals/clearance": 0, "correspondence/distance": 0,
    "container_superpoints/size": 1, "object_superpoints/size": 1, "meta/demo": 0, "meta/seed": 0,
}  # fmt: skip

REVOLUTION = SYMMETRIES.index("revolution")

Sample = dict[str, Array]  # one demo's arrays by path, without offsets
RecordType = type[Record]

INDEX_INTO = {  # codes that count rows of another group of the same demo
    "container/superpoint": "container_superpoints",
    "object/superpoint": "object_superpoints",
    "correspondence/container_superpoint": "container_superpoints",
    "correspondence/object_superpoint": "object_superpoints",
    "mesh_faces/vertices": "mesh_vertices",
}


@dataclass(frozen=True)
class Block:
    """Some demos of a unit, decoded: columns of concatenated rows, and where each demo's rows begin."""

    arrays: Mapping[str, Array]  # by path, offsets included
    demos: int

    def sample(self, row: int) -> Sample:
        """The arrays of one demo by path: views, not copies.

        Raises:
            CorruptionError: if there is no such demo.
        """
        if not 0 <= row < self.demos:
            raise CorruptionError(f"demo {row} of a shard, expected 0 to {self.demos - 1}; run `dapdata verify`")
        return {
            path: np.asarray(array[self._rows(path, row)])
            for path, array in self.arrays.items()
            if not path.endswith("/offsets")
        }

    def _rows(self, path: str, row: int) -> Any:
        if not is_ragged(COLUMNS[path]):
            return row
        offsets = self.arrays[offsets_path(path)]
        return slice(int(offsets[row]), int(offsets[row + 1]))


COLUMNS: dict[str, Field[Any]] = {column.metadata["path"]: column for column in columns(*RECORDS, Meshes)}


def offsets_path(path: str) -> str:
    """Where the offsets of a ragged column are: one array for each group."""
    return f"{path.split('/')[0]}/offsets"


def group_columns(*records: RecordType) -> dict[str, list[Field[Any]]]:
    """The columns of some record classes by group: {"container": [points, normals, ...], ...}."""
    groups: dict[str, list[Field[Any]]] = {}
    for column in columns(*records):
        groups.setdefault(column.metadata["path"].split("/")[0], []).append(column)
    return groups


# Digests and checks ----------------------------------------------------------------------------------------


def demo_digest(sample: Sample) -> str:
    """sha256 over one demo's decoded arrays: path, dtype, shape and little-endian bytes, in the order of their paths."""
    total = sha256()
    for path in sorted(sample):
        array = np.ascontiguousarray(sample[path], dtype=COLUMNS[path].metadata["dtype"])
        total.update(f"{path} {array.dtype.str} {list(array.shape)}\n".encode())
        total.update(array.data)
    return total.hexdigest()


class ContentDigest:
    """sha256 over the demos' digests in demo order: the same whatever the workers, the shards and the codecs."""

    def __init__(self) -> None:
        self._total, self._edge = sha256(), ""

    def add(self, digests: Iterable[str]) -> None:
        """Takes the digests of the demos that come next."""
        for digest in digests:
            self._total.update(f"{self._edge}{digest}".encode())
            self._edge = "\n"

    def hexdigest(self) -> str:
        """The digest of all so far."""
        return self._total.hexdigest()


def problems(sample: Sample) -> Iterator[str]:
    """What is wrong with one demo's arrays, each as "path: found, expected"; nothing if it may be stored."""
    rows: dict[str, int] = {}
    for path, array in sample.items():
        about = COLUMNS[path].metadata
        fixed = about["dims"][1:]
        ragged = is_ragged(COLUMNS[path])
        if array.shape[1 if ragged else 0 :] != fixed or array.ndim != len(fixed) + ragged:
            yield f"{path}: shape {array.shape}, expected {about['dims'][0 if ragged else 1 :]}"
            return
        if ragged:
            group = path.split("/")[0]
            if rows.setdefault(group, len(array)) != len(array):
                yield f"{path}: {len(array)} rows, expected {rows[group]} as in the rest of {group}"
        yield from _value_problems(path, array, about)
    if "symmetry/kind" in sample and int(sample["symmetry/kind"]) == REVOLUTION and not is_unit(sample["symmetry/axis"]):
        yield "symmetry/axis: not a unit vector, and the object is one of revolution"
    for path, target in INDEX_INTO.items():
        if path in sample and target in rows and sample[path].size:
            low, high = int(sample[path].min()), int(sample[path].max())
            if low < 0 or high >= rows[target]:
                yield f"{path}: {low} to {high}, expected rows of {target}, 0 to {rows[target] - 1}"
                return
    if "mesh_vertices/part" in sample:
        yield from _mesh_problems(sample)


def _mesh_problems(sample: Sample) -> Iterator[str]:
    """Whether exactly the parts whose kind is mesh have vertices, and each face is of one part."""
    part, kind = sample["mesh_vertices/part"], np.concatenate([sample["scene/kind"], sample["object_parts/kind"]])
    meshes = np.flatnonzero(kind == PART_KINDS.index("mesh"))
    if not np.array_equal(np.unique(part), meshes):
        yield f"mesh_vertices/part: of parts {np.unique(part).tolist()}, expected of those that are meshes, {meshes.tolist()}"
    elif (np.ptp(part[sample["mesh_faces/vertices"]], axis=1) > 0).any():
        yield "mesh_faces/vertices: a face with vertices of several parts, expected of one"


def _value_problems(path: str, array: Array, about: Mapping[str, Any]) -> Iterator[str]:
    name = path.split("/")[1]
    if array.size == 0:
        return
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        yield f"{path}: {int((~np.isfinite(array)).sum())} values are not finite"
    elif name in DIRECTIONS and not is_unit(array):
        yield f"{path}: not unit vectors"
    elif about["dims"][-2:] == (4, 4) and not is_rigid(array):
        yield f"{path}: not rigid transforms"
    elif about["names"] and int(array.max()) >= len(about["names"]):
        yield f"{path}: code {int(array.max())}, expected below {len(about['names'])}"
    elif name == "affordance" and np.abs(array).max() > 1:
        yield f"{path}: {float(array.min())} to {float(array.max())}, expected -1 to 1"
    elif array.min() < POSITIVE.get(path, -np.inf):
        yield f"{path}: {array.min()}, expected at least {POSITIVE[path]}"


def is_unit(vectors: Array) -> bool:
    """Whether all of (..., 3) have length 1, but for the rounding of float32."""
    return bool(np.abs(np.einsum("...i,...i->...", vectors, vectors) - 1).max() <= 2 * TOLERANCE)


def is_rigid(transforms: Array) -> bool:
    """Whether all of (..., 4, 4) are rotations with translations: orthogonal, right-handed, last row 0 0 0 1."""
    rotation = transforms[..., :3, :3]
    square = rotation @ np.swapaxes(rotation, -1, -2)
    return bool(
        np.abs(square - np.eye(3)).max() <= RIGID_TOLERANCE
        and (np.linalg.det(rotation) > 0).all()
        and (transforms[..., 3, :] == (0, 0, 0, 1)).all()
    )


# Writing ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lender:
    """A committed unit with the same demos: its files are linked instead of being encoded and stored twice."""

    folder: Path
    files: Mapping[str, Mapping[str, Any]]
    paths: frozenset[str] = field(default_factory=frozenset)  # arrays that it holds, offsets included


def write_unit(
    folder: Path,
    records: Sequence[RecordType],
    samples: Sequence[Sample],
    about: Mapping[str, Any],
    lenders: Sequence[Lender] = (),
) -> dict[str, Any]:
    """Writes a unit into an empty folder; `durable.commit` then moves it to its place.

    Args:
        folder: Where; must be staged.
        records: Record classes whose columns are written.
        samples: One a demo, in demo order; may be empty.
        about: The unit's record; `files` is added here.
        lenders: Committed units that hold some of the columns for exactly these demos.

    Returns:
        The unit's record as stored.
    """
    files: dict[str, dict[str, Any]] = {}
    for name, members in group_columns(*records).items():
        (folder / name).mkdir()
        (folder / name / "zarr.json").write_bytes(chunks.describe_group({}))
        for path, array in _columns_of_group(name, members, samples):
            lender = next((lender for lender in lenders if path in lender.paths), None)
            if lender:
                files |= _borrow(folder, path, lender)
            else:
                _write_array(folder, path, array() if callable(array) else array)
    files |= {path: fact for path, fact in _hash_all(folder).items() if path not in files}
    record = {**about, "files": dict(sorted(files.items()))}
    (folder / "zarr.json").write_bytes(chunks.describe_group({"dapdata": record}))
    return record


def _columns_of_group(name: str, members: list[Field[Any]], samples: Sequence[Sample]) -> Iterator[tuple[str, Any]]:
    """(path, array or function that makes it) of a group; a function, so that one column is in memory at a time."""
    ragged = next((column for column in members if is_ragged(column)), None)
    if ragged is not None:
        lengths = [len(sample[ragged.metadata["path"]]) for sample in samples]
        yield f"{name}/offsets", np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int64)
    for column in members:
        yield column.metadata["path"], lambda column=column: _concatenated(column, samples)


def _concatenated(column: Field[Any], samples: Sequence[Sample]) -> Array:
    about = column.metadata
    parts = [sample[about["path"]] for sample in samples]
    if not parts:
        return np.zeros((0, *about["dims"][1:]), dtype=about["dtype"])
    return np.concatenate(parts) if is_ragged(column) else np.stack(parts)


def _write_array(folder: Path, path: str, array: Array) -> None:
    """An array of the unit in this folder, as zarr would write it."""
    about, rows = _about(path), max(len(array), 1)
    fill = {"f": np.nan, "i": -1, "u": np.iinfo(np.uint8).max}[array.dtype.kind]
    chunk = min(rows, MAX_CHUNK_ROWS)
    layout = chunks.Layout(array.shape, array.dtype, chunk, -(-rows // chunk))
    file = folder / path / layout.name
    (file.parent if len(array) else folder / path).mkdir(parents=True)
    described = chunks.describe(layout, fill, ZSTD_LEVEL, _attributes(about), _dimension_names(about))
    (folder / path / "zarr.json").write_bytes(described)
    if len(array):
        file.write_bytes(chunks.encode(layout, array, fill, ZSTD_LEVEL))


def _about(path: str) -> Mapping[str, Any]:
    """What the table of records says of an array; offsets are alike in all groups."""
    if path in COLUMNS:
        return COLUMNS[path].metadata
    description = "rows offsets[d] to offsets[d + 1] of this group are demo d's"
    return {"dtype": "<i8", "dims": ("demo_edge",), "unit": "1", "frame": "-", "description": description, "names": ()}


def _attributes(about: Mapping[str, Any]) -> dict[str, Any]:
    codes = {"names": list(about["names"])} if about["names"] else {}
    return {key: about[key] for key in ("unit", "frame", "description")} | codes


def _dimension_names(about: Mapping[str, Any]) -> list[str]:
    """Rows; then (3,) is "xyz", and matrices have a row and a column."""
    fixed = about["dims"][1:]
    return [about["dims"][0], *(["xyz"] if len(fixed) == 1 else ["row", "column"][: len(fixed)])]


def _borrow(folder: Path, path: str, lender: Lender) -> dict[str, dict[str, Any]]:
    """Links an array's files from a committed unit (copies them where the file system has no links); their facts."""
    facts = {name: dict(fact) for name, fact in lender.files.items() if name.startswith(f"{path}/")}
    for name in facts:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(lender.folder / name, folder / name)
        except OSError:
            (folder / name).write_bytes((lender.folder / name).read_bytes())
    return facts


def _hash_all(folder: Path) -> dict[str, dict[str, Any]]:
    """{path: {sha256, bytes}} of every file below, but for the root's own zarr.json."""
    facts = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and name != "zarr.json":
            facts[name] = {"sha256": durable.hash_file(path), "bytes": path.stat().st_size}
    return facts


def lender(folder: Path, record: Mapping[str, Any]) -> Lender:
    """A committed unit as a lender of all arrays that it holds."""
    return Lender(folder, record["files"], frozenset(stored_paths(record)))


# Reading ---------------------------------------------------------------------------------------------------


def is_committed(folder: Path) -> bool:
    """Whether there is a whole unit: committing is a rename, so its root is there or nothing is."""
    return (folder / "zarr.json").is_file()


def committed(root: Path, paths: Iterable[str]) -> set[str]:
    """Which of these units are there. The folders that hold units are listed, once each: no file is looked at.

    Args:
        root: The dataset's folder.
        paths: Folders of units, from there.
    """
    wanted = set(paths)
    found: set[str] = set()
    for parent in {path.rpartition("/")[0] for path in wanted}:
        with suppress(FileNotFoundError), os.scandir(root / parent) as entries:
            found.update(f"{parent}/{entry.name}" for entry in entries if entry.is_dir())
    return wanted & found


def _relative(name: str) -> str:
    """The name of a file that is inside of the unit."""
    if ".." in name.split("/") or name.startswith("/") or not name.isprintable():
        raise ValueError("a file outside of the unit")
    return name


class _File(BaseModel):
    sha256: str
    bytes: int = Key(ge=0)


class _Row(BaseModel):
    demo: int = Key(ge=0)
    sha256: str


class UnitRecord(BaseModel):
    """The unit's own record, as far as reading relies on it; rows of shards hold what `units.describe` says too."""

    format: int = FORMAT
    key: str
    rows: list[_Row]
    rejects: dict[str, dict[str, int]] = {}
    files: dict[Annotated[str, AfterValidator(_relative)], _File]


def read_record(folder: Path) -> dict[str, Any]:
    """The unit's own record: key, demos, rejects, files.

    Raises:
        CorruptionError: if the root is missing, is no JSON, or holds no such record.
    """
    try:
        record: dict[str, Any] = durable.read_json(folder / "zarr.json")["attributes"]["dapdata"]
        if (found := UnitRecord.model_validate(record, strict=True).format) != FORMAT:
            raise ValueError(f"format {found}, expected {FORMAT}")
        return record
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = _first(error) if isinstance(error, ValidationError) else str(error)
        raise CorruptionError(f"{folder}/zarr.json: cannot be read as a unit ({reason}); run `dapdata verify`") from error


def _first(error: ValidationError) -> str:
    """The first of pydantic's complaints in a line."""
    found = error.errors()[0]
    return f"{'.'.join(map(str, found['loc']))}: {found['msg']}"


def damaged_files(folder: Path, record: Mapping[str, Any]) -> Iterator[str]:
    """What differs between a unit's files and its record, each as "path: what"; nothing if it is whole.

    The root's zarr.json is not covered: whoever names the unit knows its hash.
    """
    present = {
        path.relative_to(folder).as_posix(): path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink()
    }
    present.pop("zarr.json", None)
    for name, fact in record["files"].items():
        path = present.pop(name, None)
        if path is None or path.is_symlink() or not path.is_file():
            yield f"{name}: missing"
        elif path.stat().st_size != fact["bytes"]:
            yield f"{name}: {path.stat().st_size} bytes, expected {fact['bytes']}"
        elif durable.hash_file(path) != fact["sha256"]:
            yield f"{name}: its bytes are not those that were written"
    yield from (f"{name}: not part of the unit" for name in sorted(present))


def read_block(folder: Path, paths: Sequence[str] | None = None) -> Block:
    """Decodes columns of a unit, all of them by default; the offsets of ragged ones come along.

    Raises:
        CorruptionError: if an array is missing or a chunk fails its checksum.
    """
    arrays: dict[str, Array] = {}
    record, path = read_record(folder), "files"
    try:
        wanted = stored_paths(record) if paths is None else _with_offsets(paths)
        names = {*files_of(record, paths)}
        layouts = _layouts(folder, wanted, names, _check_files(folder, names))
        for path, layout in layouts.items():
            data = (folder / path / layout.name).read_bytes() if layout.shape[0] else None
            arrays[path] = np.empty(layout.shape, layout.dtype) if data is None else chunks.decode(layout, data)
        for path in wanted:
            _check_rows(path, arrays, len(record["rows"]))
    except Exception as error:  # there is no end to what codecs raise at bytes that are not theirs
        raise CorruptionError(
            f"{folder}: {path}: cannot be decoded ({_one_line(error)}), expected what was written; run `dapdata verify`"
        ) from error
    return Block(arrays, len(record["rows"]))


def files_of(record: Mapping[str, Any], paths: Sequence[str] | None = None) -> list[str]:
    """The files of a unit that `read_block` looks at besides the root: those of some arrays and their offsets, or all."""
    wanted = "" if paths is None else tuple(f"{path}/" for path in _with_offsets(paths))
    return [name for name in record["files"] if name.startswith(wanted)]


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def stored_paths(record: Mapping[str, Any]) -> list[str]:
    """Paths of the arrays of a unit that this version knows, offsets included."""
    names = [name.removesuffix("/zarr.json") for name in record["files"] if name.count("/") == 2]
    return [name for name in names if name in COLUMNS or name.endswith("/offsets")]


def _check_files(folder: Path, names: Set[str]) -> int:
    """The size of a unit's files, bytes; raises unless all are there, and the folders between lead nowhere else."""
    for parent in {name.rsplit("/", up)[0] for name in names for up in range(1, name.count("/") + 1)}:
        if not S_ISDIR(_stat(folder, parent).st_mode):
            raise ValueError(f"{parent}: expected a folder")
    total = 0
    for name in names:
        about = _stat(folder, name)
        if not S_ISREG(about.st_mode):
            raise ValueError(f"{name}: expected a plain file")
        total += about.st_size
    return total


def _stat(folder: Path, name: str) -> os.stat_result:
    try:
        return (folder / name).lstat()
    except FileNotFoundError:
        raise FileNotFoundError(f"{name}: missing") from None


def _layouts(folder: Path, paths: Sequence[str], names: Set[str], stored: int) -> dict[str, chunks.Layout]:
    """How arrays are laid out; raises if they are others than they should be, or larger than their files explain."""
    limit, total, found = max(SMALL, MAX_RATIO * stored), 0, {}
    for path in paths:
        try:
            array = chunks.layout((folder / path / "zarr.json").read_bytes())
        except Exception as error:  # whatever json says, and what is not where it should be in it
            raise ValueError(f"{path}: {_one_line(error)}") from error
        about = _about(path)
        fixed = about["dims"][1:]
        if array.dtype.str != about["dtype"] or array.shape[1:] != fixed:
            raise ValueError(f"{path}: {array.dtype} {array.shape}, expected {about['dtype']} {(about['dims'][0], *fixed)}")
        if array.shape[0] and f"{path}/{array.name}" not in names:
            raise FileNotFoundError(f"{path}: its rows are missing")
        total += array.nbytes
        if total > limit:
            raise ValueError(f"{path}: {total} bytes in {stored} bytes of files")
        found[path] = array
    return found


def _check_rows(path: str, arrays: Mapping[str, Array], demos: int) -> None:
    """Raises a ValueError unless an array has a row for each demo, or as many as the offsets of its group share out."""
    array = arrays[path]
    if path.endswith("/offsets"):
        if len(array) != demos + 1 or array[0] != 0 or (array[1:] < array[:-1]).any():
            raise ValueError(f"offsets are not {demos + 1} numbers that rise from 0")
    else:
        expected = int(arrays[offsets_path(path)][-1]) if is_ragged(COLUMNS[path]) else demos
        if len(array) != expected:
            raise ValueError(f"{len(array)} rows, expected {expected}")


def misdescribed(folder: Path) -> Iterator[str]:
    """What the arrays of a unit say of themselves and should not, each as "path: found, expected".

    Descriptions are worded anew now and then, and lists of codes' names grow: neither is wrong in an older dataset.

    Raises:
        CorruptionError: if there is no unit, or none that zarr can open.
    """
    import zarr

    record = read_record(folder)
    try:
        group = zarr.open_group(folder, mode="r")
        found: dict[str, Any] = {path: group[path].metadata.to_dict() for path in stored_paths(record)}
    except Exception as error:  # as in read_block
        raise CorruptionError(f"{folder}: cannot be opened ({_one_line(error)}); run `dapdata verify`") from error
    for path, about in found.items():
        codecs = [codec["name"] for codec in about["codecs"][0].get("configuration", {}).get("codecs", ())]
        told = {**about["attributes"], "dimension_names": list(about.get("dimension_names") or ()), "codecs": codecs}
        expected = {**_attributes(_about(path)), "dimension_names": _dimension_names(_about(path)), "codecs": [*chunks.CODECS]}
        for name in sorted((told | expected).keys() - {"description"}):
            if not _says(told.get(name), expected.get(name), grows=name == "names"):
                yield f"{path}: {name} {told.get(name)!r}, expected {expected.get(name)!r}"


def _says(told: Any, expected: Any, grows: bool) -> bool:
    """Whether an array is described as expected; where a list `grows`, its end may not have been there yet."""
    return bool(told == expected or (grows and isinstance(told, list) and told and told == (expected or [])[: len(told)]))


def array_paths(record: Mapping[str, Any]) -> list[str]:
    """Paths of the arrays of a unit that this version knows, but for offsets."""
    return [path for path in stored_paths(record) if path in COLUMNS]


def _with_offsets(paths: Sequence[str]) -> list[str]:
    offsets = {offsets_path(path) for path in paths if is_ragged(COLUMNS[path])}
    return [*sorted(offsets), *paths]


def created_by() -> dict[str, str]:
    """The versions that wrote the bytes: what a bug report needs."""
    return {name: version(name) for name in ("numpy", "zarr")}
