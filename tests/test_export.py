"""What each format's own library reads is what the shards hold; a folder of that name is whole or not there."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tarfile
from collections.abc import Callable, Iterator
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dapdata import cli, durable, loading, manifest, pictures, pipeline, records, solids
from dapdata.errors import LockedError, UsageError
from dapdata.interop import export, parquet, pointcept, rpdiff, scans, scenes, webdataset
from dapdata.loading import Dataset
from dapdata.poses import pose, random_rotation, rotation_about
from dapdata.records import Array
from dapdata.rng import stream

EXPORTS: dict[str, Callable[..., Path]] = {
    "webdataset": webdataset.export,
    "parquet": parquet.export,
    "pointcept": pointcept.export,
    "scenes": scenes.export,
    "rpdiff": rpdiff.export,
    "scans": scans.export,
}
QUICK: dict[str, dict[str, Any]] = {  # options that make small files quickly
    "webdataset": {"shard_size": 2},
    "parquet": {"shard_size": 2, "previews": False},
    "pointcept": {},
    "scenes": {},
    "rpdiff": {"shard_size": 2},
    "scans": {},
}
SUFFIXES = (".tar", ".parquet", ".npy", ".glb", ".npz", ".ply")
every_format = pytest.mark.parametrize("format", EXPORTS)


@pytest.fixture(scope="module")
def made(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The tiny dataset in every format. Not to be changed."""
    root = tmp_path_factory.mktemp("exports")
    return {name: write(tiny, root / name, **QUICK[name]) for name, write in EXPORTS.items()}


@pytest.fixture(scope="module")
def dataset(tiny: Path) -> Dataset:
    return loading.open(tiny)


def content(folder: Path) -> dict[str, bytes]:
    """Every file by its path."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def in_split(dataset: Dataset, split: str) -> list[int]:
    return np.flatnonzero(dataset.index["split"] == split).tolist()


def same(found: Any, stored: Array) -> bool:
    """Whether an array has the shard's values, shape and type."""
    found = np.asarray(found)
    return found.shape == stored.shape and found.dtype == stored.dtype and np.array_equal(found, stored)


def arrays_of(sample: dict[str, Array]) -> dict[str, Array]:
    """What every full export holds as arrays: all but single numbers."""
    return {path: array for path, array in sample.items() if array.ndim}


def numbers_of(sample: dict[str, Array]) -> dict[str, Any]:
    """What every full export holds as single numbers."""
    return {path: array.item() for path, array in sample.items() if not array.ndim}


# WebDataset ------------------------------------------------------------------------------------------------


def test_webdataset_reads_every_demo_as_it_is_in_the_shards(made: dict[str, Path], dataset: Dataset) -> None:
    wds = pytest.importorskip("webdataset", reason="needs the extra dev")
    for split in ("train", "val", "test"):
        files = sorted(map(str, made["webdataset"].glob(f"{split}-*.tar")))
        numbers = in_split(dataset, split)
        assert len(files) == -(-len(numbers) // 2)
        read = list(wds.WebDataset(files, shardshuffle=False).decode())
        assert [sample["json"]["demo"] for sample in read] == dataset.index["demo"][numbers].tolist()
        for sample, number in zip(read, numbers):
            stored = dataset[number]
            assert all(same(sample[webdataset.member_name(path)], array) for path, array in arrays_of(stored).items())
            assert numbers_of(stored).items() <= sample["json"].items()
            assert len(sample) == len(arrays_of(stored)) + len(["__key__", "__url__", "__local_path__", "json"])
            assert sample["json"]["split"] == split


def test_a_tar_file_tells_nothing_of_when_and_by_whom_it_was_made(made: dict[str, Path]) -> None:
    with tarfile.open(made["webdataset"] / "train-000000.tar") as tar:
        members = tar.getmembers()
    assert {(m.mtime, m.uid, m.gid, m.uname, m.gname, m.mode) for m in members} == {(0, 0, 0, "", "", 0o644)}
    assert all(m.name == m.name.lower() for m in members)


# Parquet ---------------------------------------------------------------------------------------------------


def as_array(value: Any, about: Any) -> Array:
    """A cell as an array, from nested lists alone."""
    shape = about["dims"][1:]
    return (
        np.array(value, about["dtype"]).reshape(-1, *shape) if about["dims"][0] != "demo" else np.array(value, about["dtype"])
    )


def test_parquet_holds_every_demo_as_it_is_in_the_shards(made: dict[str, Path], dataset: Dataset) -> None:
    import pyarrow.parquet as pq

    for split in ("train", "val", "test"):
        numbers = in_split(dataset, split)
        files = sorted((made["parquet"] / "data").glob(f"{split}-*.parquet"))
        assert [path.name for path in files] == [f"{split}-{i:05d}-of-{len(files):05d}.parquet" for i in range(len(files))]
        rows = [row for path in files for row in pq.read_table(path).to_pylist()]
        assert [row["demo"] for row in rows] == dataset.index["demo"][numbers].tolist()
        for row, number in zip(rows, numbers):
            stored = dataset[number]
            for column in records.columns():
                path = column.metadata["path"]
                assert same(as_array(row[path], column.metadata), stored[path]), path
            assert numbers_of(stored).items() <= row.items()


def test_parquet_tells_units_and_frames_and_has_small_groups_with_an_index(made: dict[str, Path]) -> None:
    import pyarrow.parquet as pq

    file = pq.ParquetFile(made["parquet"] / "data/train-00000-of-00002.parquet")
    for column in records.columns():
        about = column.metadata
        told = file.schema_arrow.field(about["path"]).metadata
        assert (told[b"unit"].decode(), told[b"frame"].decode()) == (about["unit"], about["frame"])
        assert json.loads(told[b"names"]) == list(about["names"])
    group = file.metadata.row_group(0)
    columns = [group.column(i) for i in range(group.num_columns)]
    assert group.num_rows <= parquet.ROWS
    assert all(column.has_offset_index for column in columns)
    points = next(column for column in columns if column.path_in_schema.startswith("container/points"))
    assert "BYTE_STREAM_SPLIT" in points.encodings


def test_row_groups_are_cut(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pyarrow.parquet as pq

    monkeypatch.setattr(parquet, "ROWS", 2)
    out = parquet.export(toy, tmp_path / "out", previews=False)
    for path in out.glob("data/*.parquet"):
        about = pq.ParquetFile(path).metadata
        sizes = [about.row_group(i).num_rows for i in range(about.num_row_groups)]
        assert sum(sizes) == about.num_rows
        assert max(sizes) <= 2


def test_lists_are_nested_in_the_order_of_the_axes() -> None:
    import pyarrow as pa

    arrays = [np.arange(24.0).reshape(2, 3, 4), np.arange(12.0).reshape(1, 3, 4)]
    assert parquet._nested(arrays, pa.list_(pa.list_(pa.list_(pa.float64())))).to_pylist() == [a.tolist() for a in arrays]


def test_every_row_has_its_own_picture(tiny: Path, dataset: Dataset, tmp_path: Path) -> None:
    import pyarrow.parquet as pq
    from matplotlib import image

    out = parquet.export(tiny, tmp_path / "out", split="test", demos=1)
    (cell,) = pq.read_table(out / "data")["preview"].to_pylist()
    (number,) = in_split(dataset, "test")
    shown = np.round(image.imread(io.BytesIO(cell["bytes"]), format="png")[..., :3] * 255)
    assert cell["path"] == f"{export.demo_name(int(dataset.index['demo'][number]))}.png"
    assert np.array_equal(shown, pictures.preview(dataset[number], *parquet.PANEL))
    assert shown.shape == (parquet.PANEL[1], 2 * parquet.PANEL[0], 3)


@pytest.mark.slow
def test_datasets_reads_every_demo_as_it_is_in_the_shards(tiny: Path, dataset: Dataset, tmp_path: Path) -> None:
    datasets = pytest.importorskip("datasets", reason="needs the extra interop: `make test-all` installs it")
    out = parquet.export(tiny, tmp_path / "out", shard_size=2)
    read = datasets.load_dataset(str(out), cache_dir=str(tmp_path / "cache"))
    streamed = datasets.load_dataset(str(out), streaming=True, cache_dir=str(tmp_path / "cache"))
    assert set(read) == {"train", "val", "test"}
    for split, demos in read.items():
        assert demos[0]["preview"].size == (2 * parquet.PANEL[0], parquet.PANEL[1])
        doubles = demos.with_format("numpy", dtype=np.float64)
        for row, streams, lists, number in zip(doubles, streamed[split], demos, in_split(dataset, split), strict=True):
            for column in (c.metadata for c in records.columns()):
                stored = dataset[number][column["path"]]
                assert same(np.asarray(row[column["path"]], np.float64), stored.astype(np.float64)), column["path"]
                assert same(as_array(lists[column["path"]], column), stored), column["path"]
                assert same(as_array(streams[column["path"]], column), stored), column["path"]


# Pointcept -------------------------------------------------------------------------------------------------


def read_as_pointcept(root: Path, split: str) -> list[dict[str, Any]]:
    """What DefaultDataset.get_data gives for each scene of a split: the files that it knows, as it converts them."""
    scenes = []
    for folder in sorted((root / split).glob("*")):
        found: dict[str, Any] = {"name": folder.name}
        for name in ("coord", "color", "normal", "strength", "segment", "instance", "pose"):
            if (folder / f"{name}.npy").exists():
                array = np.load(folder / f"{name}.npy", allow_pickle=False)
                found[name] = (
                    array.reshape(-1).astype(np.int32) if name in ("segment", "instance") else array.astype(np.float32)
                )
        scenes.append(found)
    return scenes


def test_pointcept_finds_a_scene_for_every_demo_of_a_split(made: dict[str, Path], dataset: Dataset) -> None:
    for split in ("train", "val", "test"):
        read = read_as_pointcept(made["pointcept"], split)
        assert len(read) == len(in_split(dataset, split))
        for scene, number in zip(read, in_split(dataset, split)):
            stored = dataset[number]
            count = len(stored["container/points"])
            assert scene["name"] == export.demo_name(int(stored["meta/demo"]))
            assert scene.keys() == {"name", "coord", "normal", "segment"}
            for name, path in (("coord", "points"), ("normal", "normals")):
                assert same(scene[name][:count], stored[f"container/{path}"])
                assert same(scene[name][count:], stored[f"object/{path}"])
            assert same(np.unique(scene["segment"][count:]), np.array([2], np.int32))
            place_here = {int(s) for s in np.flatnonzero(stored["container_superpoints/affordance"] > 0)}
            expected = [int(superpoint in place_here) for superpoint in stored["container/superpoint"].tolist()]
            assert scene["segment"][:count].tolist() == expected
            assert 0 < sum(expected) < count


def test_pointcept_labels_lie_beside_the_features(made: dict[str, Path], dataset: Dataset) -> None:
    folder = next((made["pointcept"] / "test").iterdir())
    stored = dataset[in_split(dataset, "test")[0]]
    superpoint, affordance = (np.load(folder / f"{name}.npy", allow_pickle=False) for name in ("superpoint", "affordance"))
    count = len(stored["container/points"])
    assert same(affordance[:count], stored["container_superpoints/affordance"][stored["container/superpoint"]])
    assert np.isnan(affordance[count:]).all()
    assert same(superpoint[:count], stored["container/superpoint"])
    assert superpoint[count:].min() == superpoint[:count].max() + 1
    assert json.loads((made["pointcept"] / "classes.json").read_bytes()) == ["container", "place_here", "object"]


# Scenes ----------------------------------------------------------------------------------------------------


@pytest.fixture
def scene_folders(made: dict[str, Path], dataset: Dataset) -> Iterator[tuple[Path, dict[str, Array]]]:
    """The folder of each exported scene, and the demo's arrays."""
    return (
        (made["scenes"] / str(split) / export.demo_name(int(demo)), dataset[i])
        for i, (split, demo) in enumerate(zip(dataset.index["split"], dataset.index["demo"]))
    )


def frames_of(sample: dict[str, Array]) -> dict[str, Array]:
    """Where each frame must be in the world."""
    T_world_container = sample["pose/T_world_container"]
    clutter = sample["scene/T_container_part"][sample["scene/role"] == 1]
    return {
        "container": T_world_container,
        "object_start": sample["pose/T_world_object_start"],
        **{f"clutter_{i:03d}": T_world_container @ T for i, T in enumerate(clutter)},
        **{f"goal_{i:03d}": T for i, T in enumerate(sample["goals/T_world_object"])},
    }


def world_bounds(sample: dict[str, Array], role: int) -> Array:
    """(2, 3) corners of the parts of a role, world frame."""
    mine = sample["scene/role"] == role
    T_world_part = sample["pose/T_world_container"] @ sample["scene/T_container_part"][mine]
    boxes = solids.bounds(sample["scene/kind"][mine], sample["scene/size"][mine], T_world_part)
    return np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])


def test_trimesh_finds_every_frame_and_solid_of_a_glb(scene_folders: Iterator[tuple[Path, dict[str, Array]]]) -> None:
    import trimesh

    for folder, sample in scene_folders:
        scene = trimesh.load(folder / "scene.glb")
        expected = frames_of(sample)
        assert set(scene.graph.nodes_geometry) == set(expected)
        for name, T in expected.items():
            np.testing.assert_allclose(scene.graph.get(name, solids.Z_UP)[0], T, atol=1e-12, err_msg=name)
        for role, name in enumerate(records.ROLES):
            corners = []
            for node in (node for node in expected if node.startswith(name)):
                T, mesh = scene.graph.get(node, solids.Z_UP)
                corners.append(trimesh.transform_points(scene.geometry[mesh].vertices, T))
            found = np.concatenate(corners)
            np.testing.assert_allclose([found.min(0), found.max(0)], world_bounds(sample, role), atol=2e-4)  # of round sides
        demonstrated = json.loads((folder / "scene.json").read_bytes())["demonstrated_goal"]
        np.testing.assert_array_equal(sample["goals/T_world_object"][demonstrated], sample["pose/T_world_object_goal"])
        colors = {name: scene.geometry[mesh].visual.material.name for name, (_, mesh) in
                  ((node, scene.graph.get(node)) for node in expected if node.startswith("goal_"))}  # fmt: skip
        assert [name for name, color in colors.items() if color == "demonstrated"] == [f"goal_{demonstrated:03d}"]


def test_viewers_of_gltf_see_the_scene_upright(made: dict[str, Path]) -> None:
    """glTF has y up: what is highest in the world has the largest y."""
    import trimesh

    scene = trimesh.load(next(made["scenes"].rglob("scene.glb")))
    (low, high), upright = scene.bounds, trimesh.transform_points(scene.to_geometry().vertices, solids.T_GLTF_WORLD.T)
    np.testing.assert_allclose([low[1], high[1]], [upright[:, 2].min(), upright[:, 2].max()], atol=1e-6)
    assert abs(low[1]) < 0.02  # on the table
    assert 0.15 < high[1] < 2


def test_an_exported_scene_holds_the_object_at_its_goal_in_a_simulator(
    scene_folders: Iterator[tuple[Path, dict[str, Array]]],
) -> None:
    bullet = pytest.importorskip("pybullet")
    client = bullet.connect(bullet.DIRECT)
    try:
        for folder, sample in scene_folders:
            bullet.resetSimulation(physicsClientId=client)
            bullet.setGravity(0, 0, -9.81, physicsClientId=client)
            scene = bullet.loadURDF(str(folder / "scene.urdf"), useFixedBase=True, physicsClientId=client)
            joints = [
                bullet.getJointInfo(scene, i, physicsClientId=client)
                for i in range(bullet.getNumJoints(scene, physicsClientId=client))
            ]
            links = {joint[12].decode(): joint[0] for joint in joints}
            expected = frames_of(sample)
            assert set(links) == set(expected)
            for name, T in expected.items():
                at, turned = bullet.getLinkState(scene, links[name], physicsClientId=client)[4:6]
                np.testing.assert_allclose(at, T[:3, 3], atol=1e-6)
                np.testing.assert_allclose(np.reshape(bullet.getMatrixFromQuaternion(turned), (3, 3)), T[:3, :3], atol=1e-6)
            assert {
                name for name in links if len(bullet.getCollisionShapeData(scene, links[name], physicsClientId=client))
            } == {name for name in links if name.startswith(("container", "clutter"))}
            thing = bullet.loadURDF(str(folder / "object.urdf"), physicsClientId=client)
            assert bullet.getDynamicsInfo(thing, -1, physicsClientId=client)[0] == 0.3
            goal = sample["pose/T_world_object_goal"]
            orientation = bullet.getQuaternionFromEuler(scenes._roll_pitch_yaw(goal[:3, :3]))
            bullet.resetBasePositionAndOrientation(thing, goal[:3, 3], orientation, physicsClientId=client)
            for _ in range(240):
                bullet.stepSimulation(physicsClientId=client)
            at, _ = bullet.getBasePositionAndOrientation(thing, physicsClientId=client)
            assert np.linalg.norm(at - goal[:3, 3]) < 0.005
    finally:
        bullet.disconnect(client)


@pytest.mark.slow
def test_yourdfpy_reads_the_frames_and_solids_of_a_urdf(scene_folders: Iterator[tuple[Path, dict[str, Array]]]) -> None:
    yourdfpy = pytest.importorskip("yourdfpy", reason="needs the extra interop: `make test-all` installs it")
    for folder, sample in scene_folders:
        robot = yourdfpy.URDF.load(str(folder / "scene.urdf"), build_collision_scene_graph=True, load_collision_meshes=True)
        assert robot.validate()
        for name, T in frames_of(sample).items():
            np.testing.assert_allclose(robot.get_transform(name, "world"), T, atol=1e-9)
        both = np.stack([world_bounds(sample, role) for role in range(2)])
        expected = [both[:, 0].min(0), both[:, 1].max(0)]
        np.testing.assert_allclose(robot.collision_scene.bounds, expected, atol=1e-3)


def shapes(kinds: list[int]) -> scenes.Parts:
    """One solid of each kind, apart from each other and turned."""
    T = np.stack([pose(rotation_about((1, 2, 3), 0.4 + i), (0.3 * i, 0, 0)) for i in range(len(kinds))])
    return scenes.Parts(np.array(kinds, np.uint8), np.array([[0.1, 0.1, 0.2]] * len(kinds)), T, [None] * len(kinds))


def test_solids_that_urdf_has_no_word_for_become_meshes(tmp_path: Path) -> None:
    import trimesh

    frame = scenes.Frame("fruit", "", np.eye(4), shapes([0, 1, 2]), "object", collides=True)
    link = scenes._link(frame, tmp_path, mass=1.0)
    assert [path.name for path in tmp_path.iterdir()] == ["object_2.stl"]
    assert [geometry[0].tag for geometry in link.iter("geometry")] == ["box", "box", "cylinder", "cylinder", "mesh", "mesh"]
    mesh = trimesh.load(tmp_path / "object_2.stl")
    np.testing.assert_allclose(mesh.extents, [0.1, 0.1, 0.2], rtol=1e-3)


def test_mass_and_inertia_are_those_of_the_solid() -> None:
    inertial = scenes._inertial(
        scenes.Parts(np.array([0], np.uint8), np.array([[0.1, 0.2, 0.3]]), np.eye(4)[None], [None]), 2.0
    )
    found = {name: float(value) for name, value in inertial.find("inertia").attrib.items()}  # type: ignore[union-attr]
    expected = {"ixx": 2 / 12 * (0.2**2 + 0.3**2), "iyy": 2 / 12 * (0.1**2 + 0.3**2), "izz": 2 / 12 * (0.1**2 + 0.2**2)}
    assert {name: value for name, value in found.items() if value} == pytest.approx(expected)


def test_roll_pitch_and_yaw_make_up_the_rotation() -> None:
    rng = stream(0, "test", 0)
    rotations = [random_rotation(rng) for _ in range(200)]
    rotations += [
        rotation_about((0, 1, 0), sign * np.pi / 2) @ rotation_about((1, 0, 0), turn) for sign in (-1, 1) for turn in (0, 2)
    ]
    for R in rotations:
        roll, pitch, yaw = scenes._roll_pitch_yaw(R)
        again = rotation_about((0, 0, 1), yaw) @ rotation_about((0, 1, 0), pitch) @ rotation_about((1, 0, 0), roll)
        np.testing.assert_allclose(again, R, atol=1e-9)


# The folder ------------------------------------------------------------------------------------------------


@every_format
def test_the_same_dataset_gives_the_same_bytes(format: str, tiny: Path, made: dict[str, Path], tmp_path: Path) -> None:
    again = EXPORTS[format](tiny, tmp_path / "again", **QUICK[format])
    assert content(again) == content(made[format])


@every_format
def test_an_export_names_its_files_and_its_source(format: str, tiny: Path, made: dict[str, Path]) -> None:
    about = json.loads((made[format] / "export.json").read_bytes())
    files = {path: data for path, data in content(made[format]).items() if path != "export.json"}
    assert {path: fact["sha256"] for path, fact in about["files"].items()} == {
        path: sha256(data).hexdigest() for path, data in files.items()
    }
    assert about["dataset"]["content_sha256"] == manifest.read(tiny).content_sha256
    assert about["arrays"]["container/points"]["unit"] == "m"
    assert about["options"] == QUICK[format]
    assert "README.md" in files
    assert f"# {manifest.read(tiny).name}\n" in files["README.md"].decode()


class Crash(BaseException):
    """A power cut: nothing catches it."""


@every_format
def test_a_crash_at_any_rename_leaves_no_export_and_the_next_run_goes_on(
    format: str, tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One export, crashed at the first rename, then at the second, ... until there are no more."""
    options = QUICK[format] | {"demos": 3}
    whole = content(EXPORTS[format](tiny, tmp_path / "whole", **options))
    out, there = tmp_path / "out", {}
    partial = out.with_name("out.partial")
    for last in range(1, 100):
        renames = 0

        def stop(action: str, path: Path, last: int = last) -> None:
            nonlocal renames
            renames += action == "rename"
            if renames == last:
                raise Crash

        monkeypatch.setattr(durable, "observer", stop)
        try:
            EXPORTS[format](tiny, out, **options)
            break
        except Crash:
            pass
        finally:
            monkeypatch.setattr(durable, "observer", None)
        assert not out.exists()
        files = [path for path in partial.rglob("*") if path.suffix in SUFFIXES and durable.STAGING not in path.parts]
        before, there = there, {path: path.stat().st_mtime_ns for path in files}
        assert before.items() <= there.items(), "what was there is not made again"
    assert last >= 4  # a run goes on where the one before it was, so each gets further by more than one
    assert len(there) >= 2
    assert content(out) == whole
    assert not partial.exists()


@every_format
def test_a_finished_export_is_left_alone(format: str, tiny: Path, made: dict[str, Path]) -> None:
    before = {path: path.stat().st_mtime_ns for path in made[format].rglob("*")}
    EXPORTS[format](tiny, made[format], **QUICK[format])
    assert {path: path.stat().st_mtime_ns for path in made[format].rglob("*")} == before


def test_an_unfinished_export_of_something_else_is_replaced(
    toy: Path, tiny: Path, made: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"

    def stop(action: str, path: Path) -> None:
        if action == "rename" and path == out:
            raise Crash

    durable.observer = stop
    try:
        with pytest.raises(Crash):
            webdataset.export(toy, out, shard_size=3)
    finally:
        durable.observer = None
    assert list(out.with_name("out.partial").glob("*.tar"))
    assert content(webdataset.export(tiny, out, shard_size=2)) == content(made["webdataset"])


def test_two_processes_do_not_write_one_export(tiny: Path, tmp_path: Path) -> None:
    with durable.lock(tmp_path / "out.partial"), pytest.raises(LockedError, match=f"process {os.getpid()}"):
        webdataset.export(tiny, tmp_path / "out")


def test_some_demos_are_the_first_ones_and_a_split_is_that_split(tiny: Path, dataset: Dataset, tmp_path: Path) -> None:
    first = export.choose(tiny, demos=3)
    assert sorted(n for numbers in first.splits.values() for n in numbers.tolist()) == [0, 1, 2]
    assert export.choose(tiny, demos=99).count == 5
    only = export.choose(tiny, "test")
    assert [int(only.dataset.index["demo"][n]) for n in only.splits["test"]] == dataset.index["demo"][
        in_split(dataset, "test")
    ].tolist()
    text = (pointcept.export(tiny, tmp_path / "out", split="test") / "README.md").read_text()
    assert "1 of 5 demos" in text
    assert {path.name for path in (tmp_path / "out").iterdir() if path.is_dir()} == {"test", "preview"} - {"preview"}


def test_numbers_below_one_are_refused(tiny: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="demos: got 0, expected at least 1"):
        pointcept.export(tiny, tmp_path / "out", demos=0)
    with pytest.raises(UsageError, match="shard_size: got 0, expected at least 1"):
        webdataset.export(tiny, tmp_path / "out", shard_size=0)


def test_nothing_takes_its_name_before_it_is_on_the_disk(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every file that is in the folder when it is named was fsynced after it was written."""
    synced: dict[tuple[int, int], int] = {}
    missed: list[Path] = []

    def watch(action: str, path: Path) -> None:
        facts = path.stat() if path.exists() else None
        if action == "fsync" and facts:
            synced[facts.st_dev, facts.st_ino] = facts.st_mtime_ns
        if action == "rename" and path == tmp_path / "out":
            files = [file for file in (tmp_path / "out.partial").rglob("*") if file.is_file() and file.name != ".lock"]
            missed.extend(
                file for file in files if synced.get((file.stat().st_dev, file.stat().st_ino)) != file.stat().st_mtime_ns
            )

    monkeypatch.setattr(durable, "observer", watch)
    pointcept.export(tiny, tmp_path / "out")
    assert missed == []
    assert len(synced) > 25


def test_demos_in_no_split_have_files_of_their_own(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = export.choose(tiny)
    chosen.dataset.index["split"][4] = "unused"
    monkeypatch.setattr(loading, "open", lambda root, split: chosen.dataset)
    assert export.choose(tiny).splits["unused"].tolist() == [4]
    out = webdataset.export(tiny, tmp_path / "out")
    assert (out / "unused-000000.tar").is_file()
    assert "`unused` demos share one with two splits" in (out / "README.md").read_text()


def test_a_scene_that_nobody_knows_is_refused_and_nothing_is_left(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Dataset.__getitem__
    monkeypatch.setattr(
        Dataset, "__getitem__", lambda self, number: whole(self, number) | {"object_parts/kind": np.zeros(0, np.uint8)}
    )
    with pytest.raises(UsageError, match=r"demo 0: nobody knows its solids, .* import the data with their meshes"):
        scenes.export(tiny, tmp_path / "out")
    assert not list(tmp_path.iterdir())


# Mistakes, at the command line -----------------------------------------------------------------------------


def said(capsys: pytest.CaptureFixture[str], *arguments: object, code: int) -> str:
    capsys.readouterr()
    assert cli.run_app(["export", *map(str, arguments)]) == code
    out, err = capsys.readouterr()
    *progress, line = err.splitlines()
    assert out == ""
    assert all(other.startswith("export ") for other in progress)
    return line


@every_format
def test_a_mistake_is_one_line_and_leaves_nothing(
    format: str, tiny: Path, made: dict[str, Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    others = tmp_path / "others"
    others.mkdir()
    (others / "thesis.tex").touch()
    shut = {"--out": tmp_path / "out"}
    assert "no such folder" in said(capsys, format, tmp_path / "nowhere", "--out", shut["--out"], code=2)
    assert "'tran' is not one of" in said(capsys, format, tiny, "--out", shut["--out"], "--split", "tran", code=2)
    assert "exists and is no export" in said(capsys, format, tiny, "--out", others, code=2)
    assert "exists and is no export" in said(capsys, format, tiny, "--out", others / "thesis.tex", code=2)
    assert "in the dataset's own folder" in said(capsys, format, tiny, "--out", tiny / "inside", code=2)
    assert "differs in options, split" in said(
        capsys, "webdataset", tiny, "--out", made["webdataset"], "--split", "val", code=2
    )
    assert "differs in demos" in said(capsys, format, tiny, "--out", made[format], "--demos", "2", code=2)
    assert sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*")) == ["others", "others/thesis.tex"]


def test_what_is_not_labelled_or_not_there_is_said(
    toy: Path, toy_copy: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    import toy_stages

    raw = pipeline.generate(toy_stages.toy_recipe(), tmp_path / "raw", engine="inline", table="toy_stages")
    assert "generated but not labelled" in said(capsys, "webdataset", raw, "--out", tmp_path / "out", code=2)
    (tmp_path / "out.partial").mkdir()
    (tmp_path / "out.partial/notes.txt").touch()
    (tmp_path / "other.partial").touch()
    for name in ("out", "other"):
        assert "is no unfinished export" in said(capsys, "webdataset", toy, "--out", tmp_path / name, code=2)
    assert (tmp_path / "out.partial/notes.txt").exists()
    shard = toy_copy / manifest.read(toy_copy).shards[0].path
    (shard / "zarr.json").unlink()
    assert "run `dapdata verify" in said(capsys, "webdataset", toy_copy, "--out", tmp_path / "damaged", code=3)
    assert not (tmp_path / "damaged").exists()


def test_a_finished_export_that_was_changed_is_said(tiny: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = webdataset.export(tiny, tmp_path / "out")
    (out / "val-000000.tar").write_bytes(b"")
    assert "val-000000.tar is not what was exported" in said(capsys, "webdataset", tiny, "--out", out, code=2)


def test_a_full_disk_is_said_and_the_same_command_goes_on(tiny: Path, made: dict[str, Path], tmp_path: Path) -> None:
    code = "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))\n"
    code += "from dapdata import cli; sys.exit(cli.run_app(sys.argv[1:]))"
    command = ["export", "webdataset", str(tiny), "--out", "out", "--shard-size", "2"]
    done = subprocess.run([sys.executable, "-c", code, *command], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 6, done.stderr
    assert "disk full" in done.stderr
    assert done.stdout == ""
    assert not (tmp_path / "out").exists()
    assert content(webdataset.export(tiny, tmp_path / "out", shard_size=2)) == content(made["webdataset"])


def test_the_command_prints_the_folder_or_json(tiny: Path, made: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    command = ["export", "webdataset", str(tiny), "--out", str(made["webdataset"]), "--shard-size", "2"]
    assert cli.run_app(command) == 0
    assert capsys.readouterr().out == f"{made['webdataset']}\n"
    assert cli.run_app([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["out"] == str(made["webdataset"])


LIGHT = """
import sys
for name in ("pybullet", "trimesh", "open3d", "numba", "scipy", "matplotlib", "pebble", "torch", "safetensors"):
    sys.modules[name] = None
from dapdata import cli
codes = [cli.run_app(["export", name, sys.argv[1], "--out", f"{name}{len(more)}", *more]) for name, *more in
         (["webdataset"], ["parquet", "--no-previews"], ["pointcept"], ["parquet"], ["scenes"], ["rpdiff"])]
assert codes == [0, 0, 0, 6, 6, 6], codes
"""


def test_without_extras_all_is_exported_but_pictures_and_solids(tiny: Path, tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", LIGHT, tiny], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("pip install 'dapdata[sim]'") == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["parquet1", "pointcept0", "webdataset0"]
