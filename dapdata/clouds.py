"""Point clouds in files: ply, pcd, npz, npy. Reading checks sizes before it believes a header.

`read_cloud` needs normals, unit or not, that point to the sensor: which side of a surface is free cannot be told without.
`read_points` takes what there is: normals, a label and the view of each point may be missing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dapdata.errors import FormatError
from dapdata.npz import BROKEN, read_array, read_arrays

Array = NDArray[Any]

FIELDS = ("x", "y", "z", "nx", "ny", "nz")
LABEL, VIEW = "label", "view"  # fields of whole numbers that a point may have
KNOWN = (*FIELDS, LABEL, VIEW)
ARRAYS = {"points": FIELDS[:3], "normals": FIELDS[3:], LABEL: (LABEL,), VIEW: (VIEW,)}  # of npz files, and their columns
PCD_NAMES = {"normal_x": "nx", "normal_y": "ny", "normal_z": "nz"}
MAX_HEADER = 65_536  # bytes
MAX_POINTS = 5_000_000  # of which two copies take half a gigabyte
MAX_WORD = 64  # letters of a number
LARGEST_NUMBER = 1e9  # m: squares of larger ones could overflow
BLOCK = 100_000  # points that are read at a time
PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip


Columns = Mapping[str, Array]  # (N,) numbers by field


@dataclass(frozen=True)
class Points:
    """A cloud as its file tells it. N points."""

    points: Array  # (N, 3) f8
    normals: Array | None  # (N, 3) f8, of any length
    label: Array | None  # (N,) i8
    view: Array | None  # (N,) i8, which camera saw it


def read_cloud(path: str | Path) -> tuple[Array, Array]:
    """(N, 3) f8 points, m, and (N, 3) f8 unit normals of a ply, pcd, npz (`points`, `normals`) or npy (N, 6) file.

    Raises:
        FormatError: no such file, another format, no normals, too few bytes, or numbers that are not finite.
    """
    path = Path(path)
    columns = _read(path)
    missing = [name for name in FIELDS if name not in columns]
    if missing:
        raise FormatError(
            f"{path}: has no {' '.join(missing)}, expected {' '.join(FIELDS)}; estimate normals that point to the sensor first"
        )
    rows = np.stack([columns[name] for name in FIELDS], axis=1).astype(np.float64)
    if not (np.abs(rows) < LARGEST_NUMBER).all():
        raise FormatError(f"{path}: has NaN, infinite or huge numbers, expected finite metres; remove those points")
    lengths = np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    if len(rows) == 0 or (lengths == 0).any():
        raise FormatError(f"{path}: has {'normals of length 0' if len(rows) else 'no points'}, expected points with normals")
    return rows[:, :3], rows[:, 3:] / lengths


def read_points(path: str | Path) -> Points:
    """The points of a ply, pcd, npz (`points`, and maybe `normals`, `label`, `view`) or npy (N, 3 or 6) file.

    Rows whose x, y and z are all NaN are pixels without depth, as PCL writes them, and are left out.

    Raises:
        FormatError: no such file, another format, no x y z, too few bytes, labels that are no whole numbers.
    """
    path = Path(path)
    columns = _read(path)
    missing = [name for name in FIELDS[:3] if name not in columns]
    if missing:
        raise FormatError(f"{path}: has no {' '.join(missing)}, expected x y z of each point")
    points = np.stack([columns[name] for name in FIELDS[:3]], axis=1).astype(np.float64)
    there = ~np.isnan(points).all(axis=1)
    normals = np.stack([columns[name] for name in FIELDS[3:]], axis=1) if {*FIELDS[3:]} <= columns.keys() else None
    return Points(
        points[there],
        None if normals is None else normals[there].astype(np.float64),
        *(_whole(path, name, columns[name][there]) if name in columns else None for name in (LABEL, VIEW)),
    )


def thin(edge: float, points: Array, *more: Array) -> tuple[Array, ...]:
    """The mean in each occupied cube of some edge, m, of points (N, 3) and of what else there is of them (N, K)."""
    cell = np.floor(points / edge)
    cell -= cell.min(axis=0)
    span = cell.max(axis=0) + 1
    # One number a cube is sorted five times as fast as three, as long as all such numbers are exact.
    key = (cell[:, 0] * span[1] + cell[:, 1]) * span[2] + cell[:, 2] if np.prod(span) < 2**53 else cell
    _, which, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)
    return tuple(
        np.stack([np.bincount(which, column) for column in array.T], axis=1) / count[:, None] for array in (points, *more)
    )


def _whole(path: Path, name: str, column: Array) -> Array:
    """Whole numbers as i8."""
    if not (np.isfinite(column).all() and (column == np.round(column)).all()):
        raise FormatError(f"{path}: {name}: has numbers that are not whole, expected whole ones")
    return column.astype(np.int64)


def _read(path: Path) -> Columns:
    """The known columns of a file."""
    readers = {".ply": _read_ply, ".pcd": _read_pcd, ".npz": _read_npz, ".npy": _read_npy}
    if path.suffix.lower() not in readers:
        raise FormatError(f"{path}: got '{path.suffix}', expected a point cloud: {', '.join(readers)}")
    try:
        if path.exists() and not path.is_file():  # a pipe would be waited for, a device has no end
            raise FormatError(f"{path}: no plain file, expected a point cloud")
        with path.open("rb") as file:
            return readers[path.suffix.lower()](path, file)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error.strerror or error}), expected a point cloud") from error


def write_ply(path: str | Path, points: Array, normals: Array | None = None, **more: Array) -> Path:
    """Writes (N, 3) points, with normals if there are, as a binary ply that any viewer opens; returns its path.

    `more` are columns of small whole numbers (N,), such as `label`.
    """
    floats = points if normals is None else np.concatenate([points, normals], axis=1)
    fields = [(name, "<f4") for name in FIELDS[: floats.shape[1]]] + [(name, "u1") for name in more]
    rows = np.zeros(len(points), fields)
    for name, column in zip(FIELDS, floats.T):
        rows[name] = column
    for name, column in more.items():
        rows[name] = column
    properties = [f"property {'uchar' if kind == 'u1' else 'float'} {name}" for name, kind in fields]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *properties, "end_header", ""]
    Path(path).write_bytes("\n".join(header).encode() + rows.tobytes())
    return Path(path)


def _header(path: Path, file: BinaryIO, end: bytes) -> list[list[str]]:
    """The words of each line of a header, up to the line that starts with `end`; the file is left at what comes after."""
    start = file.read(MAX_HEADER)
    at = start.find(b"\n" + end)
    stop = start.find(b"\n", at + 1)
    if at < 0 or stop < 0:
        raise FormatError(f"{path}: has no header that ends with '{end.decode()}', expected a {path.suffix} file")
    file.seek(stop + 1)
    return [line.split() for line in start[:stop].decode("ascii", errors="replace").splitlines() if line.split()]


def _read_ply(path: Path, file: BinaryIO) -> Columns:
    lines = _header(path, file, b"end_header")
    formats = [line[1] for line in lines if line[0] == "format" and len(line) > 1]
    elements = [i for i, line in enumerate(lines) if line[0] == "element"]
    if lines[0] != ["ply"] or not formats or not elements or lines[elements[0]][1:2] != ["vertex"]:
        raise FormatError(f"{path}: is no ply whose first element is 'vertex'; save it as a point cloud")
    count = _number(path, lines[elements[0]][-1])
    properties = lines[elements[0] + 1 : elements[1] if len(elements) > 1 else None]
    columns = [(line[2], line[1]) for line in properties if line[0] == "property" and len(line) == 3 and line[1] in PLY_TYPES]
    if len(columns) != sum(line[0] == "property" for line in properties):
        raise FormatError(f"{path}: has vertex properties of unknown type, expected {', '.join(PLY_TYPES)}")
    if formats[0] == "ascii":
        return _ascii_columns(path, file, [name for name, _ in columns], count)
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(formats[0])
    if order is None:
        raise FormatError(f"{path}: format {formats[0]!r}, expected ascii, binary_little_endian or binary_big_endian")
    return _binary_columns(path, file, [(name, order + PLY_TYPES[kind]) for name, kind in columns], count)


def _read_pcd(path: Path, file: BinaryIO) -> Columns:
    about = {line[0]: line[1:] for line in _header(path, file, b"DATA")}
    missing = {"FIELDS", "SIZE", "TYPE", "POINTS", "DATA"} - about.keys()
    if missing or not all(about[name] for name in ("FIELDS", "POINTS", "DATA")):
        raise FormatError(f"{path}: header without {', '.join(sorted(missing)) or 'values'}, expected a pcd file")
    names, count = [PCD_NAMES.get(name, name) for name in about["FIELDS"]], _number(path, about["POINTS"][0])
    if about["DATA"][0] == "ascii":
        return _ascii_columns(path, file, names, count)
    if about["DATA"][0] != "binary":
        raise FormatError(f"{path}: DATA {about['DATA'][0]!r}, expected ascii or binary; save it uncompressed")
    kinds = [f"{kind.lower()}{size}" for kind, size in zip(about["TYPE"], about["SIZE"])]
    counts = [_number(path, text) for text in about.get("COUNT", ["1"] * len(names))]
    if len(kinds) != len(names) or len(counts) != len(names) or not {*kinds} <= {*PLY_TYPES.values(), "i8", "u8"}:
        raise FormatError(f"{path}: FIELDS, SIZE, TYPE and COUNT do not agree, expected one of each for a field")
    if any(n != 1 for name, n in zip(names, counts) if name in KNOWN) or sum(counts) > MAX_HEADER:
        raise FormatError(f"{path}: COUNT {' '.join(about['COUNT'])[:40]!r}, expected 1 for each of {' '.join(FIELDS)}")
    fields = [(name, f"<{kind}", (n,)) if n > 1 else (name, f"<{kind}") for name, kind, n in zip(names, kinds, counts)]
    return _binary_columns(path, file, fields, count)


def _ascii_columns(path: Path, file: BinaryIO, names: Sequence[str], count: int) -> Columns:
    """The known columns, f8, of lines of numbers."""
    known = [name for name in KNOWN if name in names]
    rows = [np.zeros((0, len(known)))]
    for start in range(0, count, BLOCK):
        words = b"".join(islice(file, min(BLOCK, count - start))).split()
        expected = min(BLOCK, count - start) * len(names)
        if len(words) < expected:
            raise FormatError(
                f"{path}: holds {len(words)} numbers, expected {expected} from point {start} on; the file is cut off"
            )
        if max(map(len, words)) > MAX_WORD:
            raise FormatError(f"{path}: holds a word of more than {MAX_WORD} letters, expected numbers")
        try:
            table = np.array(words[:expected]).astype(np.float64).reshape(-1, len(names))
        except ValueError as error:
            raise FormatError(f"{path}: holds words among its numbers ({error}), expected points") from error
        rows.append(table[:, [names.index(name) for name in known]])
    return dict(zip(known, np.concatenate(rows).T))


def _binary_columns(path: Path, file: BinaryIO, fields: Sequence[Any], count: int) -> Columns:
    """The known columns, f8, of packed records."""
    names = [field[0] for field in fields]
    known = [name for name in KNOWN if name in names]
    if len({*names}) != len(names):
        raise FormatError(f"{path}: names a field twice, expected {' '.join(FIELDS)} once")
    dtype = np.dtype(list(fields))
    left = path.stat().st_size - file.tell()
    if left < count * dtype.itemsize:
        raise FormatError(f"{path}: holds {left} bytes, expected {count * dtype.itemsize}; the file is cut off")
    rows = np.zeros((count, len(known)))
    for start in range(0, count, BLOCK):
        table = np.frombuffer(file.read(min(BLOCK, count - start) * dtype.itemsize), dtype)
        rows[start : start + len(table)] = np.stack([table[name] for name in known], axis=1)
    return dict(zip(known, rows.T))


def _number(path: Path, text: str) -> int:
    if not text.isascii() or not text.isdigit() or not int(text[:12]) <= MAX_POINTS:
        raise FormatError(f"{path}: count {text[:20]!r}, expected a whole number of at most {MAX_POINTS}; thin the cloud out")
    return int(text)


def _read_npz(path: Path, file: BinaryIO) -> Columns:
    found = read_arrays(path, ("points",), [name for name in ARRAYS if name != "points"])
    columns: dict[str, Array] = {}
    for name, array in found.items():
        shape = (len(found["points"]) if found["points"].ndim else 0, *([3] if len(ARRAYS[name]) == 3 else []))
        if array.shape != shape or array.dtype.kind not in "fiu":
            raise FormatError(f"{path}: {name}: {array.dtype} {array.shape}, expected numbers {shape}, a row for each point")
        columns |= zip(ARRAYS[name], array.reshape(len(array), -1).T)
    return columns


def _read_npy(path: Path, file: BinaryIO) -> Columns:
    try:
        rows = read_array(file, path.stat().st_size)
    except BROKEN as error:
        raise FormatError(f"{path}: is no npy file of plain numbers ({str(error)[:120]!r}), expected (N, 6)") from error
    if rows.ndim != 2 or rows.shape[1] not in (3, 6) or rows.dtype.kind not in "fiu" or len(rows) > MAX_POINTS:
        raise FormatError(f"{path}: shape {rows.shape}, expected (N, 6): x y z and the normal of each point")
    return dict(zip(FIELDS, rows.T))
