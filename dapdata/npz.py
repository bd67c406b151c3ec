"""Arrays of npz files from anywhere: sizes are looked at before anything is allocated, and nothing is unpickled."""

from __future__ import annotations

import tokenize
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from dapdata.errors import FormatError

Array = NDArray[Any]

LARGEST = 128_000_000  # bytes of one array: a million poses, five million points
MAX_ITEM = 1024  # bytes of one number or word
BROKEN = (  # what damaged files make zipfile and numpy raise
    zipfile.BadZipFile, zlib.error, ValueError, OSError, EOFError, RuntimeError, SyntaxError, MemoryError, tokenize.TokenError,
)  # fmt: skip


def read_arrays(path: Path, required: Sequence[str], optional: Sequence[str] = ()) -> dict[str, Array]:
    """The named arrays of an npz file, of plain numbers or text.

    Args:
        path: The file.
        required: Arrays that must be there.
        optional: Arrays that are read if they are there.

    Raises:
        FormatError: no such file, no npz, an array that is missing, huge, cut short, or made of Python objects.
    """
    if not path.is_file():
        raise FormatError(f"{path}: no such file, expected an npz with {', '.join(required)}")
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            for name in required:
                if name not in members:
                    raise FormatError(f"{path}: got {sorted(members)[:8]!r}, expected arrays {', '.join(required)}")
            return {n: _array(path, archive, n, members[n]) for n in (*required, *optional) if n in members}
    except BROKEN as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(
            f"{path}: cannot be read as npz ({_one_line(error)}); write it with numpy.savez, without objects"
        ) from error


def _array(path: Path, archive: zipfile.ZipFile, name: str, info: zipfile.ZipInfo) -> Array:
    """One member as an array, refused when it is huge, lies about its size, or holds Python objects."""
    if info.file_size > LARGEST:
        raise FormatError(f"{path}: {name}: got {info.file_size} bytes, expected at most {LARGEST}")
    with archive.open(info) as file:
        try:
            return read_array(file, info.file_size)
        except BROKEN as error:
            raise FormatError(f"{path}: {name}: {_one_line(error)}") from error


def read_array(file: IO[bytes], size: int) -> Array:
    """The array of an npy file that is open.

    Args:
        file: At its beginning.
        size: Bytes that it is said to hold.

    Raises:
        ValueError: if the array is huge, cut short, or made of Python objects; others of BROKEN if it is no npy file.
    """
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"got npy version {version}, expected 1.0 or 2.0")
    shape, fortran, dtype = readers[version](file)
    if dtype.hasobject or dtype.kind not in "iufU" or not 0 < dtype.itemsize <= MAX_ITEM:
        raise ValueError(f"got {dtype}, expected plain numbers or text; nothing is unpickled")
    count = 1
    for length in shape:  # Python integers: a numpy product would overflow on a lying header
        count *= int(length)
    data = file.read(count * dtype.itemsize + 1) if 0 <= count * dtype.itemsize <= LARGEST else b""
    if len(data) != count * dtype.itemsize:
        raise ValueError(f"got {size} bytes, expected {shape} of {dtype}, at most {LARGEST} bytes; the file is cut short")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")


def _one_line(error: Exception) -> str:
    lines = str(error).splitlines()
    text = lines[0][:160] if lines else type(error).__name__
    return text if text.isprintable() else repr(text)
