"""Arrays read straight from their files are those that zarr reads, and no damaged byte goes unseen."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from numcodecs.zstd import Zstd

from dapdata import chunks, store


def write(folder: Path, array: np.ndarray, chunk: int) -> Path:
    """An array as `store` writes it, with chunks of so many rows."""
    path = "container/points" if array.ndim == 2 else "container/offsets"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "MAX_CHUNK_ROWS", chunk)
        store._write_array(folder, path, array)
    return folder / path


def content(folder: Path) -> dict[str, bytes]:
    """All files by their path."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def read(folder: Path) -> np.ndarray:
    about = chunks.layout((folder / "zarr.json").read_bytes())
    return chunks.decode(about, (folder / about.name).read_bytes())


@settings(max_examples=30, deadline=None)
@given(
    st.integers(1, 40),
    st.integers(1, 50),
    st.sampled_from(["<f4", "<f8", "<i4", "<i8", "|u1", "<u2"]),
    st.booleans(),
)
def test_what_is_read_is_what_zarr_reads(
    tmp_path_factory: pytest.TempPathFactory, rows: int, chunk: int, dtype: str, is_wide: bool
) -> None:
    shape = (rows, 3) if is_wide else (rows,)
    array = np.random.default_rng(rows).integers(0, 200, shape).astype(dtype)
    folder = write(tmp_path_factory.mktemp("unit"), array, chunk)
    found = read(folder)
    assert found.dtype.str == dtype
    np.testing.assert_array_equal(found, array)
    np.testing.assert_array_equal(found, zarr.open_array(folder, mode="r")[...])


@pytest.mark.parametrize("rows", [0, 1, 7, 20])
@pytest.mark.parametrize("dtype", ["<f4", "<i8", "|u1"])
def test_what_is_written_is_what_zarr_writes_byte_for_byte(tmp_path: Path, rows: int, dtype: str) -> None:
    from zarr.codecs import Crc32cCodec, ZstdCodec

    array = np.random.default_rng(rows).integers(0, 9, (rows, 3)).astype(dtype)
    folder = write(tmp_path / "ours", array, 7)
    chunk = min(max(rows, 1), 7)
    theirs = zarr.open_group(tmp_path / "theirs", mode="w", zarr_format=3).create_array(
        "points",
        shape=array.shape,
        dtype=array.dtype,
        chunks=(chunk, 3),
        shards=(-(-max(rows, 1) // chunk) * chunk, 3),
        compressors=[ZstdCodec(level=store.ZSTD_LEVEL), Crc32cCodec()],
        fill_value={"f": np.nan, "i": -1, "u": 255}[array.dtype.kind],
        dimension_names=["container_point", "xyz"],
        attributes={"unit": "m", "frame": "world", "description": "observed points"},
        config={"write_empty_chunks": True},
    )
    if rows:
        theirs[...] = array
    assert content(folder) == content(tmp_path / "theirs/points")


@pytest.mark.parametrize("attributes", [{}, {"dapdata": {"n": 1, "rows": [], "names": {"a": "\u00e4", "b": [0.1, None]}}}])
def test_groups_are_described_as_zarr_does(tmp_path: Path, attributes: dict[str, object]) -> None:
    zarr.open_group(tmp_path, mode="w", zarr_format=3, attributes=attributes)
    assert (tmp_path / "zarr.json").read_bytes() == chunks.describe_group(attributes)


def test_no_bit_can_flip_unseen(tmp_path: Path) -> None:
    array = np.arange(60, dtype="<f4").reshape(20, 3)
    folder = write(tmp_path, array, 7)
    about = chunks.layout((folder / "zarr.json").read_bytes())
    data = (folder / about.name).read_bytes()
    for place in range(len(data)):
        flipped = bytearray(data)
        flipped[place] ^= 1 << place % 8
        with pytest.raises(ValueError, match=r"checksum|chunk \d"):
            chunks.decode(about, bytes(flipped))
    for length in range(0, len(data), 3):
        with pytest.raises(ValueError, match=r"checksum|chunk"):
            chunks.decode(about, data[:length])


def test_chunks_of_another_size_are_refused_though_their_checksums_hold(tmp_path: Path) -> None:
    from google_crc32c import value

    def summed(data: bytes) -> bytes:
        return data + value(data).to_bytes(4, "little")

    about = chunks.Layout((8,), np.dtype("<f4"), 8, 1)
    for count in (0, 7, 9, 1 << 20):
        frame = summed(bytes(Zstd(1).encode(np.zeros(count, "<f4"))))
        index = summed(np.array([0, len(frame)], "<u8").tobytes())
        with pytest.raises(ValueError, match=f"chunk 0: {4 * count} bytes, expected 32"):
            chunks.decode(about, frame + index)
    for start, length in ((0, 1 << 62), (1 << 63, 8), (40, 8), (0, 0)):
        index = summed(np.array([start, length], "<u8").tobytes())
        with pytest.raises(ValueError, match="chunk 0: bytes"):
            chunks.decode(about, bytes(16) + index)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda about: about["codecs"][0]["configuration"]["codecs"].pop(1), "codecs sharding_indexed bytes crc32c bytes"),
        (lambda about: about["codecs"][0]["configuration"].update(index_location="start"), "crc32c start, expected"),
        (
            lambda about: about["codecs"][0]["configuration"]["codecs"][0].update(configuration={"endian": "big"}),
            "big-endian",
        ),
        (lambda about: about["chunk_key_encoding"].update(name="v2"), "chunks named as"),
        (lambda about: about.update(shape=[21, 3]), "expected the whole of"),
        (lambda about: about.update(shape=[-1, 3]), "expected numbers of rows"),
        (lambda about: about["codecs"][0]["configuration"].update(chunk_shape=[7, 2]), "expected whole rows"),
        (lambda about: about["codecs"][0]["configuration"].update(chunk_shape=[0, 3]), "expected whole rows"),
    ],
)
def test_only_what_is_written_is_read(tmp_path: Path, change: object, words: str) -> None:
    folder = write(tmp_path, np.zeros((20, 3), "<f4"), 20)
    about = json.loads((folder / "zarr.json").read_text())
    change(about)  # type: ignore[operator]
    with pytest.raises(ValueError, match=words):
        chunks.layout(json.dumps(about).encode())
