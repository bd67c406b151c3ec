"""Point cloud files: what is read is what was written, and what is broken is refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dapdata.clouds import read_cloud, read_points, thin, write_ply
from dapdata.errors import FormatError
from dapdata.records import Array

POINTS = np.array([[0.1, 0.2, 0.3], [-1.0, 2.0, 0.5], [0.0, 0.0, 1.0]])
NORMALS = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.6, 0.8, 0.0]])
ROWS = np.concatenate([POINTS, NORMALS], axis=1)
PCD = "VERSION .7\nFIELDS x y z normal_x normal_y normal_z\nSIZE 4 4 4 4 4 4\nTYPE F F F F F F\nCOUNT 1 1 1 1 1 1\n"
PCD += "WIDTH 3\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA "


def ply(kind: str, body: bytes, count: int = 3) -> bytes:
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    return f"ply\nformat {kind} 1.0\ncomment made by hand\nelement vertex {count}\n{names}end_header\n".encode() + body


def text(rows: Array) -> bytes:
    return "\n".join(" ".join(map(str, row)) for row in rows).encode()


WAYS = {
    "ascii.ply": ply("ascii", text(ROWS)),
    "little.ply": ply("binary_little_endian", ROWS.astype("<f4").tobytes()),
    "big.ply": ply("binary_big_endian", ROWS.astype(">f4").tobytes()),
    "ascii.pcd": f"{PCD}ascii\n".encode() + text(ROWS),
    "binary.pcd": f"{PCD}binary\n".encode() + ROWS.astype("<f4").tobytes(),
}


@pytest.mark.parametrize("name", WAYS)
def test_every_layout_of_a_cloud_reads_the_same(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(WAYS[name])
    points, normals = read_cloud(tmp_path / name)
    np.testing.assert_allclose(points, POINTS, atol=1e-7)
    np.testing.assert_allclose(normals, NORMALS, atol=1e-7)


def test_numpy_files_and_our_own_ply_read_back(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", ROWS)
    np.savez(tmp_path / "a.npz", points=POINTS, normals=2 * NORMALS)
    write_ply(tmp_path / "a.ply", POINTS, NORMALS)
    for name in ("a.npy", "a.npz", "a.ply"):
        points, normals = read_cloud(tmp_path / name)
        np.testing.assert_allclose(points, POINTS, atol=1e-7)
        np.testing.assert_allclose(normals, NORMALS, atol=1e-7)


BROKEN = {
    "a.obj": (b"", "expected a point cloud: .ply, .pcd, .npz, .npy"),
    "empty.ply": (b"", "has no header"),
    "cut.ply": (WAYS["little.ply"][:-5], "the file is cut off"),
    "cut2.ply": (ply("ascii", text(ROWS), 4), "the file is cut off"),
    "lies.ply": (ply("ascii", text(ROWS), 10**15), "expected a whole number of at most"),
    "mesh.ply": (b"ply\nformat ascii 1.0\nelement face 1\nend_header\n", "first element is 'vertex'"),
    "bare.ply": (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "has no y z nx ny nz"),
    "words.ply": (ply("ascii", b"a b c d e f\n" * 3), "words among its numbers"),
    "nan.ply": (ply("ascii", text(ROWS * np.nan)), "has NaN, infinite"),
    "none.ply": (ply("ascii", b"", 0), "has no points"),
    "flat.ply": (ply("ascii", text(ROWS * [1, 1, 1, 0, 0, 0])), "normals of length 0"),
    "packed.pcd": (f"{PCD}binary_compressed\n".encode(), "save it uncompressed"),
    "short.pcd": (b"FIELDS x y z\nDATA ascii\n1 2 3\n", "header without POINTS, SIZE, TYPE"),
    "no.npz": (b"PK junk", "cannot be read as npz"),
    "no.npy": (b"\x93NUMPY junk", "is no npy file"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_cloud_is_refused_with_a_reason(name: str, tmp_path: Path) -> None:
    content, reason = BROKEN[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FormatError, match=reason) as caught:
        read_cloud(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_a_pickled_array_is_never_loaded(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(FormatError, match="plain numbers"):
        read_cloud(tmp_path / "a.npy")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"gone\.ply: cannot be read"):
        read_cloud(tmp_path / "gone.ply")


def test_labels_and_views_are_read_where_there_are_any_and_normals_may_be_missing(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", POINTS, label=np.array([0, 1, 2]), view=np.array([3, 3, 0]))
    np.savez(tmp_path / "a.npz", points=POINTS, label=np.array([0, 1, 2]), view=np.array([3, 3, 0]))
    for name in ("a.ply", "a.npz"):
        found = read_points(tmp_path / name)
        np.testing.assert_allclose(found.points, POINTS, atol=1e-7)
        assert found.normals is None
        assert found.label is not None
        assert found.view is not None
        assert (found.label.tolist(), found.view.tolist()) == ([0, 1, 2], [3, 3, 0])
    with pytest.raises(FormatError, match=r"a\.ply: has no nx ny nz, expected x y z nx ny nz"):
        read_cloud(tmp_path / "a.ply")


def test_pixels_without_depth_are_left_out(tmp_path: Path) -> None:
    rows = ROWS.copy()
    rows[1] = np.nan
    (tmp_path / "a.pcd").write_bytes(f"{PCD}binary\n".encode() + rows.astype("<f4").tobytes())
    found = read_points(tmp_path / "a.pcd")
    np.testing.assert_allclose(found.points, POINTS[[0, 2]], atol=1e-7)
    assert found.normals is not None
    assert len(found.normals) == 2


def test_labels_that_are_not_whole_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", points=POINTS, label=np.array([0, 0.5, 1]))
    with pytest.raises(FormatError, match="label: has numbers that are not whole"):
        read_points(tmp_path / "a.npz")


@pytest.mark.parametrize("far", [0.0, 1e7])
def test_thinning_takes_the_mean_of_each_cube_however_far_points_are_apart(far: float) -> None:
    points = np.array([[0.1, 0.1, 0.1], [far, far, far + 0.95], [0.3, 0.1, 0.5]])
    mean, values = thin(1.0, points, np.array([[1.0], [2.0], [3.0]]))
    expected = {(0.2, 0.1, 0.3): 2.0} if far else {tuple(points.mean(axis=0).round(9)): 2.0}
    found = dict(zip(map(tuple, mean.round(9)), values[:, 0].tolist()))
    assert found.items() >= expected.items()
    assert len(found) == (2 if far else 1)
