"""Arrays of a unit straight from and to their files: zarr's layout (version 3, sharded, zstd, crc32c), without its machinery.

zarr takes 4 ms to read one of our arrays and as much to write it, nearly all of it to hand small pieces of work to its event
loop; this takes 0.3 and 0.9 ms. What is written is what zarr writes, byte for byte.
Only what `store` writes is read: anything else, and any damage, is a ValueError. Nothing of a file is believed before it was
compared with what the file is large enough to hold.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

CODECS = ("bytes", "zstd", "crc32c")  # of a chunk
INDEX_CODECS = ("bytes", "crc32c")  # of the index of chunks, at the end of the file
NAMES = {"name": "default", "configuration": {"separator": "/"}}  # of files
CHECKSUM = 4  # bytes of a crc32c
ENTRY = 16  # bytes of the index for a chunk: where it begins, and its length
KINDS = {f"{kind}{8 * width}": f"<{kind[0]}{width}" for kind in ("int", "uint", "float") for width in (1, 2, 4, 8)}


@dataclass(frozen=True)
class Layout:
    """How the one file of an array is laid out."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunk_rows: int
    chunks: int

    @property
    def nbytes(self) -> int:
        """Bytes of all chunks, decoded; the last one may be filled up."""
        return self.chunks * self.chunk_rows * prod(self.shape[1:]) * self.dtype.itemsize

    @property
    def name(self) -> str:
        """The file, from the folder of the array."""
        return "/".join(["c", *"0" * len(self.shape)])


def layout(description: bytes) -> Layout:
    """What the zarr.json of an array says.

    Raises:
        ValueError: it says something that `store` does not write; or KeyError, TypeError, IndexError: it is no such file.
    """
    about = json.loads(description)
    shape, file = tuple(about["shape"]), tuple(about["chunk_grid"]["configuration"]["chunk_shape"])
    (sharding,) = about["codecs"]
    inner = sharding["configuration"]
    chunk = tuple(inner["chunk_shape"])
    found = [sharding["name"], *_names(inner["codecs"]), *_names(inner["index_codecs"]), inner.get("index_location", "end")]
    expected = ["sharding_indexed", *CODECS, *INDEX_CODECS, "end"]
    if found != expected:
        raise ValueError(f"codecs {' '.join(map(str, found))}, expected {' '.join(expected)}")
    if about["chunk_key_encoding"] != NAMES:
        raise ValueError(f"chunks named as {about['chunk_key_encoding']}, expected {NAMES}")
    if not shape or not all(type(n) is int and 0 <= n < 1 << 48 for n in (*shape, *file, *chunk)):
        raise ValueError(f"shape {shape}, chunks of {chunk}, expected numbers of rows")
    if chunk[1:] != shape[1:] or file[1:] != shape[1:] or not 0 < chunk[0] <= file[0] or file[0] % chunk[0]:
        raise ValueError(f"chunks of {chunk} in files of {file}, expected whole rows of {shape}")
    if file[0] < shape[0]:
        raise ValueError(f"files of {file}, expected the whole of {shape} in one")
    return Layout(shape, np.dtype(KINDS[about["data_type"]]), chunk[0], file[0] // chunk[0])


def _names(codecs: Any) -> list[str]:
    """Names of codecs; one that is not for little-endian bytes says so."""
    swapped = [codec for codec in codecs if codec.get("configuration", {}).get("endian", "little") != "little"]
    return [codec["name"] for codec in codecs] + ["big-endian"] * len(swapped)


def decode(about: Layout, data: bytes) -> Array:
    """The array that is in its file.

    Raises:
        ValueError: bytes that are not those that were written.
    """
    from numcodecs.zstd import Zstd

    tail = len(data) - about.chunks * ENTRY - CHECKSUM
    if tail < 0:
        raise ValueError(f"{len(data)} bytes, expected an index of {about.chunks} chunks")
    index = np.frombuffer(_checked(data[tail:], "the index of chunks"), "<u8").reshape(-1, 2)
    array = np.empty((about.chunks * about.chunk_rows, *about.shape[1:]), about.dtype)
    for i, (start, length) in enumerate(index.tolist()):
        if start + length > tail or length <= CHECKSUM:
            raise ValueError(f"chunk {i}: bytes {start} to {start + length} of {tail}")
        frame = _checked(data[start : start + length], f"chunk {i}")
        rows = array[i * about.chunk_rows : (i + 1) * about.chunk_rows]
        if (size := _size(frame)) != rows.nbytes:
            raise ValueError(f"chunk {i}: {size} bytes, expected {rows.nbytes}")
        Zstd().decode(frame, out=rows)
    return array[: about.shape[0]]


def describe(about: Layout, fill: Any, level: int, attributes: Mapping[str, Any], dimension_names: Sequence[str]) -> bytes:
    """The zarr.json of an array.

    Args:
        about: Its layout.
        fill: What the last chunk is filled up with.
        level: Of zstd.
        attributes: Of the array.
        dimension_names: One for each dimension.
    """
    fixed = list(about.shape[1:])
    little = {"name": "bytes", "configuration": {"endian": "little"}}
    inner = {
        "chunk_shape": [about.chunk_rows, *fixed],
        "codecs": [
            little if about.dtype.itemsize > 1 else {"name": "bytes"},
            {"name": "zstd", "configuration": {"level": level, "checksum": False}},
            {"name": "crc32c"},
        ],
        "index_codecs": [little, {"name": "crc32c"}],
        "index_location": "end",
    }
    grid = {"chunk_shape": [about.chunks * about.chunk_rows, *fixed]}
    return dumped(
        {
            "shape": list(about.shape),
            "data_type": about.dtype.name,
            "chunk_grid": {"name": "regular", "configuration": grid},
            "chunk_key_encoding": NAMES,
            "fill_value": "NaN" if fill != fill else fill,
            "codecs": [{"name": "sharding_indexed", "configuration": inner}],
            "attributes": dict(attributes),
            "dimension_names": list(dimension_names),
            "zarr_format": 3,
            "node_type": "array",
            "storage_transformers": [],
        }
    )


def describe_group(attributes: Mapping[str, Any]) -> bytes:
    """The zarr.json of a group."""
    return dumped({"attributes": dict(attributes), "zarr_format": 3, "node_type": "group"})


def dumped(description: Mapping[str, Any]) -> bytes:
    """As zarr writes JSON."""
    return json.dumps(description, indent=2, allow_nan=False).encode()


def encode(about: Layout, array: Array, fill: float, level: int) -> bytes:
    """The file of an array that has rows.

    Args:
        about: Its layout.
        array: Of about.shape and about.dtype.
        fill: What the last chunk is filled up with.
        level: Of zstd.
    """
    from numcodecs.zstd import Zstd

    rows = np.full((about.chunks * about.chunk_rows, *about.shape[1:]), fill, about.dtype)
    rows[: len(array)] = array
    parts = [_summed(bytes(Zstd(level).encode(chunk))) for chunk in np.split(rows, about.chunks)]
    lengths = np.array([len(part) for part in parts])
    index = np.stack([np.cumsum(lengths) - lengths, lengths], axis=1)
    return b"".join([*parts, _summed(index.astype("<u8").tobytes())])


def _summed(data: bytes) -> bytes:
    """The bytes and their checksum."""
    from google_crc32c import value

    return data + int(value(data)).to_bytes(CHECKSUM, "little")


def _checked(data: bytes, what: str) -> bytes:
    """The bytes before their checksum."""
    from google_crc32c import value

    body = data[:-CHECKSUM]
    if value(body) != int.from_bytes(data[-CHECKSUM:], "little"):
        raise ValueError(f"{what}: its checksum is not that of its bytes")
    return body


def _size(frame: bytes) -> int:
    """How many bytes a zstd frame says it holds (RFC 8878, 3.1.1.1); -1 if it does not say."""
    if len(frame) < 6 or frame[:4] != b"\x28\xb5\x2f\xfd":
        raise ValueError("no zstd frame")
    flags = frame[4]
    is_single = flags >> 5 & 1
    width = (is_single, 2, 4, 8)[flags >> 6]
    start = 6 - is_single + (0, 1, 2, 4)[flags & 3]
    return int.from_bytes(frame[start : start + width], "little") + (256 if width == 2 else 0) if width else -1
