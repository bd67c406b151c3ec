"""Point clouds with normals in files: ply, pcd, npz, npy. Reading checks sizes before it believes a header.

Normals are needed, unit or not, and point to the sensor: which side of a surface is free cannot be told without.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from dapdata.errors import FormatError
from dapdata.npz import BROKEN, read_array, read_arrays

Array = NDArray[Any]

FIELDS = ("x", "y", "z", "nx", "ny", "nz")
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


def read_cloud(path: str | Path) -> tuple[Array, Array]:
    """(N, 3) f8 points, m, and (N, 3) f8 unit normals of a ply, pcd, npz (`points`, `normals`) or npy (N, 6) file.

    Raises:
        FormatError: no such file, another format, no normals, too few bytes, or numbers that are not finite.
    """
    path = Path(path)
    readers = {".ply": _read_ply, ".pcd": _read_pcd, ".npz": _read_npz, ".npy": _read_npy}
    if path.suffix.lower() not in readers:
        raise FormatError(f"{path}: got '{path.suffix}', expected a point cloud: {', '.join(readers)}")
    try:
        if path.exists() and not path.is_file():  # a pipe would be waited for, a device has no end
            raise FormatError(f"{path}: no plain file, expected a point cloud")
        with path.open("rb") as file:
            rows = readers[path.suffix.lower()](path, file)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error.strerror or error}), expected a point cloud") from error
    if not (np.abs(rows) < LARGEST_NUMBER).all():
        raise FormatError(f"{path}: has NaN, infinite or huge numbers, expected finite metres; remove those points")
    lengths = np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    if len(rows) == 0 or (lengths == 0).any():
        raise FormatError(f"{path}: has {'normals of length 0' if len(rows) else 'no points'}, expected points with normals")
    return rows[:, :3], rows[:, 3:] / lengths


def write_ply(path: str | Path, points: Array, normals: Array) -> Path:
    """Writes (N, 3) points and normals as a binary ply that any viewer opens; returns its path."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    text = "\n".join([*header, *(f"property float {name}" for name in FIELDS), "end_header", ""])
    Path(path).write_bytes(text.encode() + np.concatenate([points, normals], axis=1).astype("<f4").tobytes())
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


def _read_ply(path: Path, file: BinaryIO) -> Array:
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
        return _ascii_rows(path, file, [name for name, _ in columns], count)
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(formats[0])
    if order is None:
        raise FormatError(f"{path}: format {formats[0]!r}, expected ascii, binary_little_endian or binary_big_endian")
    return _binary_rows(path, file, [(name, order + PLY_TYPES[kind]) for name, kind in columns], count)


def _read_pcd(path: Path, file: BinaryIO) -> Array:
    about = {line[0]: line[1:] for line in _header(path, file, b"DATA")}
    missing = {"FIELDS", "SIZE", "TYPE", "POINTS", "DATA"} - about.keys()
    if missing or not all(about[name] for name in ("FIELDS", "POINTS", "DATA")):
        raise FormatError(f"{path}: header without {', '.join(sorted(missing)) or 'values'}, expected a pcd file")
    names, count = [PCD_NAMES.get(name, name) for name in about["FIELDS"]], _number(path, about["POINTS"][0])
    if about["DATA"][0] == "ascii":
        return _ascii_rows(path, file, names, count)
    if about["DATA"][0] != "binary":
        raise FormatError(f"{path}: DATA {about['DATA'][0]!r}, expected ascii or binary; save it uncompressed")
    kinds = [f"{kind.lower()}{size}" for kind, size in zip(about["TYPE"], about["SIZE"])]
    counts = [_number(path, text) for text in about.get("COUNT", ["1"] * len(names))]
    if len(kinds) != len(names) or len(counts) != len(names) or not {*kinds} <= {*PLY_TYPES.values(), "i8", "u8"}:
        raise FormatError(f"{path}: FIELDS, SIZE, TYPE and COUNT do not agree, expected one of each for a field")
    if any(n != 1 for name, n in zip(names, counts) if name in FIELDS) or sum(counts) > MAX_HEADER:
        raise FormatError(f"{path}: COUNT {' '.join(about['COUNT'])[:40]!r}, expected 1 for each of {' '.join(FIELDS)}")
    fields = [(name, f"<{kind}", (n,)) if n > 1 else (name, f"<{kind}") for name, kind, n in zip(names, kinds, counts)]
    return _binary_rows(path, file, fields, count)


def _ascii_rows(path: Path, file: BinaryIO, names: Sequence[str], count: int) -> Array:
    """(N, 6) f8 from lines of numbers."""
    columns, rows = _columns(path, names), []
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
        rows.append(table[:, columns])
    return np.concatenate([np.zeros((0, 6)), *rows])


def _binary_rows(path: Path, file: BinaryIO, fields: Sequence[Any], count: int) -> Array:
    """(N, 6) f8 from packed records."""
    names = [field[0] for field in fields]
    columns = _columns(path, names)
    if len({*names}) != len(names):
        raise FormatError(f"{path}: names a field twice, expected {' '.join(FIELDS)} once")
    dtype = np.dtype(list(fields))
    left = path.stat().st_size - file.tell()
    if left < count * dtype.itemsize:
        raise FormatError(f"{path}: holds {left} bytes, expected {count * dtype.itemsize}; the file is cut off")
    rows = np.zeros((count, 6))
    for start in range(0, count, BLOCK):
        table = np.frombuffer(file.read(min(BLOCK, count - start) * dtype.itemsize), dtype)
        rows[start : start + len(table)] = np.stack([table[names[i]] for i in columns], axis=1)
    return rows


def _columns(path: Path, names: Sequence[str]) -> list[int]:
    """Where x y z nx ny nz are among the named columns."""
    missing = [name for name in FIELDS if name not in names]
    if missing:
        raise FormatError(
            f"{path}: has no {' '.join(missing)}, expected {' '.join(FIELDS)}; estimate normals that point to the sensor first"
        )
    return [list(names).index(name) for name in FIELDS]


def _number(path: Path, text: str) -> int:
    if not text.isascii() or not text.isdigit() or not int(text[:12]) <= MAX_POINTS:
        raise FormatError(f"{path}: count {text[:20]!r}, expected a whole number of at most {MAX_POINTS}; thin the cloud out")
    return int(text)


def _read_npz(path: Path, file: BinaryIO) -> Array:
    arrays = read_arrays(path, ("points", "normals"))
    points, normals = arrays["points"], arrays["normals"]
    if points.shape != normals.shape or points.shape[1:] != (3,) or {points.dtype.kind, normals.dtype.kind} - {*"fiu"}:
        raise FormatError(f"{path}: points {points.shape}, normals {normals.shape}, expected both (N, 3) and numbers")
    return np.concatenate([points, normals], axis=1).astype(np.float64)


def _read_npy(path: Path, file: BinaryIO) -> Array:
    try:
        rows = read_array(file, path.stat().st_size)
    except BROKEN as error:
        raise FormatError(f"{path}: is no npy file of plain numbers ({str(error)[:120]!r}), expected (N, 6)") from error
    if rows.ndim != 2 or rows.shape[1] != 6 or rows.dtype.kind not in "fiu" or len(rows) > MAX_POINTS:
        raise FormatError(f"{path}: shape {rows.shape}, expected (N, 6): x y z and the normal of each point")
    return rows.astype(np.float64)
