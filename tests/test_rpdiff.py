"""RPDiff's demos come in as they were, whatever their layout; what is wrong with one is told; and they go out again."""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import tarfile
import time
import zipfile
from base64 import b64decode
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rpdiff_demos
from rpdiff_demos import book_demo, can_demo, changed, legacy, save, save_chunk
from scipy.spatial import cKDTree

from dapdata import cli, health, imports, loading, manifest, pictures, pipeline, poses, records, simulate, solids, tasks, viewer
from dapdata.config import RpdiffConfig
from dapdata.errors import FormatError, UsageError
from dapdata.interop import object_arrays, rpdiff, rpdiff_clouds, rpdiff_files, rpdiff_scenes, scenes, webdataset
from dapdata.observe import CamerasConfig
from dapdata.records import Cloud, MeshDemo, Rejected, to_sample
from dapdata.rng import stream
from dapdata.simulate import PlacementConfig

PLACEMENT, CAMERAS = PlacementConfig(), CamerasConfig()


@pytest.fixture(scope="module")
def book() -> dict[str, Any]:
    return book_demo()


@pytest.fixture(scope="module")
def mesh_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rpdiff_demos.save_meshes(tmp_path_factory.mktemp("meshes"), (0, 1, 2))


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six demos: three single ones of the current and the legacy layout, and a chunk of three, one of them unusable."""
    folder = tmp_path_factory.mktemp("source") / "demos"
    save(folder / "demo_aug_2.npz", book_demo(0, 0))
    save(folder / "demo_aug_10.npz", legacy(book_demo(1, 1)))
    save(folder / "demo_aug_9.npz", book_demo(2, 2))
    nobody = changed(can_demo(), multi_obj_start_pcd={"parent": np.ones((9, 3)), "child": np.zeros((0, 3))})
    save_chunk(folder / "more/demo_aug_0.npz", [can_demo(0, 0), nobody, can_demo(1, 2)])
    return folder


@pytest.fixture(scope="module")
def imported(source: Path, mesh_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset of `source` with its meshes, labelled while the source is away. Not to be changed."""
    root = tmp_path_factory.mktemp("imported") / "demos"
    asked = imports.rpdiff_recipe(source, mesh_folder, None, ["split.val=0.3", "split.test=0.3", "seed=4"])
    imports.run(asked, root, engine="inline")
    away = source.rename(source.with_name("away"))
    rpdiff_files.find.cache_clear()
    pipeline.label(root, engine="inline")
    away.rename(source)
    return root


@pytest.fixture(scope="module")
def samples(imported: Path) -> dict[int, dict[str, np.ndarray]]:
    """Its demos by their number."""
    return {int(sample["meta/demo"]): sample for sample in loading.open(imported)}


def config(file: Path, folder: Path | None = None, **more: Any) -> RpdiffConfig:
    return RpdiffConfig(**rpdiff_files.scene_section(str(file), str(folder) if folder else None), **more)


def both(file: Path, folder: Path | None = None, demo: int = 0, **more: Any) -> tuple[Any, Any]:
    """Demo and cloud of a file, either of them perhaps Rejected."""
    asked = config(file, folder, **more)
    made = rpdiff_scenes.demonstrate(asked, PLACEMENT, demo)
    if isinstance(made, Rejected):
        return made, None
    return made, rpdiff_clouds.observe(
        asked, CAMERAS, records.read_record(MeshDemo, {**to_sample(made), "meta/demo": np.array(demo)})
    )


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    capsys.readouterr()
    code = cli.run_app([str(argument) for argument in arguments])
    return code, *capsys.readouterr()


# What comes in


def test_every_layout_gives_the_same_demo_and_cloud(book: dict[str, Any], tmp_path: Path) -> None:
    single = both(save(tmp_path / "a.npz", book))
    others = [both(save(tmp_path / "b.npz", legacy(book))), both(save_chunk(tmp_path / "c.npz", [can_demo(), book]), demo=1)]
    arrays = {**changed(book, cam_poses=book["cam_poses"].astype(np.float32).astype(float))}
    for body in ("parent", "child"):
        arrays["multi_obj_start_obj_pose"][body] = np.array(book["multi_obj_start_obj_pose"][body])
    assert isinstance(single[0], MeshDemo)
    assert isinstance(single[1], Cloud)
    for demo, cloud in [*others, (both(save(tmp_path / "d.npz", arrays))[0], single[1])]:
        for record, wanted in ((demo, single[0]), (cloud, single[1])):
            for field in fields(wanted):
                assert np.array_equal(getattr(record, field.name), getattr(wanted, field.name)), field.name


def test_poses_are_those_of_the_file_with_the_table_at_zero_and_the_object_upright_at_its_goal(
    book: dict[str, Any], tmp_path: Path
) -> None:
    demo, _ = both(save(tmp_path / "a.npz", book))
    T_world_container = poses.pose(rpdiff_demos.T_WORLD_CONTAINER[:3, :3], rpdiff_demos.T_WORLD_CONTAINER[:3, 3] - [0, 0, 1])
    assert np.allclose(demo.T_world_container, T_world_container, atol=1e-12)
    T_container_goal = poses.inverse(T_world_container) @ demo.T_world_object_goal
    assert np.allclose(T_container_goal[:3, 3], [0.01, 0, 0.136], atol=1e-12)
    assert T_container_goal[2, 2] == pytest.approx(1)
    assert demo.max_tilt == pytest.approx(np.radians(15))
    assert [records.GOAL_KINDS[k] for k in demo.goal_kind] == ["commanded"]
    assert records.SYMMETRIES[int(demo.symmetry_kind)] == "box"
    start, final = (simulate.from_pose7(book[f"multi_obj_{when}_obj_pose"]["child"][0]) for when in ("start", "final"))
    moved = demo.T_world_object_goal @ poses.inverse(demo.T_world_object_start)
    lowered = poses.pose(None, (0, 0, -1))
    assert np.allclose(moved, lowered @ final @ poses.inverse(start) @ poses.inverse(lowered), atol=1e-12)


def test_a_can_is_round_about_its_axis_and_a_class_of_neither_name_has_no_symmetry(tmp_path: Path) -> None:
    demo, _ = both(save(tmp_path / "a.npz", can_demo()))
    assert records.SYMMETRIES[int(demo.symmetry_kind)] == "revolution"
    assert np.allclose(demo.symmetry_axis, [0, 0, 1])
    vial = changed(can_demo(), multi_obj_names={"parent": "rack", "child": "vial"})
    demo, _ = both(save(tmp_path / "b.npz", vial))
    assert records.SYMMETRIES[int(demo.symmetry_kind)] == "none"
    assert demo.max_tilt == pytest.approx(np.pi)
    demo, _ = both(tmp_path / "b.npz", symmetry="revolution")
    assert records.SYMMETRIES[int(demo.symmetry_kind)] == "revolution"


def distance_to_book(cloud: Cloud, demo: MeshDemo) -> np.ndarray:
    """(M,) m, of the object's points to the surface of the true book."""
    local = poses.transform(poses.inverse(demo.T_world_object_start), cloud.object_points.astype(float))
    half = np.sort(rpdiff_demos.BOOK / 2)
    axes = np.argsort(np.abs(local).max(axis=0))
    beyond = np.abs(local[:, axes]) - half
    return np.abs(np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0))


def test_clouds_are_moved_by_the_half_pixel_that_the_projection_left_out_unless_asked_not_to(
    book: dict[str, Any], tmp_path: Path
) -> None:
    path = save(tmp_path / "a.npz", book)
    exact, (demo, stored) = both(path), both(path, half_pixel=False)
    assert np.median(distance_to_book(exact[1], demo)) < 2e-4
    assert np.median(distance_to_book(stored, demo)) > 5e-4
    points = book["multi_obj_start_pcd"]["child"] - [0, 0, 1]
    fine = rpdiff_clouds.observe(config(path, half_pixel=False), CAMERAS.model_copy(update={"object_voxel": 0.0005}), demo)
    assert isinstance(fine, Cloud)
    assert np.quantile(cKDTree(points).query(fine.object_points)[0], 0.9) < 1e-5


def test_normals_are_those_of_the_faces_and_look_at_the_camera(book: dict[str, Any], tmp_path: Path) -> None:
    demo, cloud = both(save(tmp_path / "a.npz", book))
    local = poses.rotate(poses.inverse(demo.T_world_object_start), cloud.object_normals.astype(float))
    assert np.quantile(np.abs(local).max(axis=1), 0.1) > 0.99
    outward = np.einsum("ij,ij->i", cloud.object_normals, cloud.object_points - demo.T_world_object_start[:3, 3])
    assert (outward > 0).mean() > 0.99
    cameras = len(book["cam_poses"])
    assert len(cloud.camera_K) == 2 * cameras
    assert np.allclose(cloud.T_world_camera[:cameras, 2, 3], book["cam_poses"][:, 2, 3] - 1)
    assert set(cloud.object_view.tolist()) <= set(range(cameras))


@pytest.mark.parametrize("has_normals", [False, True])
def test_points_that_are_on_no_pixel_get_normals_of_their_own(has_normals: bool, book: dict[str, Any], tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    clouds = {body: points + noise.normal(0, 2e-4, points.shape) for body, points in book["multi_obj_start_pcd"].items()}
    demo = changed(book, multi_obj_start_pcd=clouds, multi_obj_final_pcd=None)
    if has_normals:
        exact = both(save(tmp_path / "exact.npz", book))[1]
        found = {}
        for body, name in (("parent", "container"), ("child", "object")):
            near = cKDTree(getattr(exact, f"{name}_points") + np.array([0, 0, 1])).query(clouds[body])[1]
            found[body] = getattr(exact, f"{name}_normals")[near]
        demo = changed(demo, normals=found, cam_poses=None, cam_intrinsics=None)
    made, cloud = both(save(tmp_path / "a.npz", demo))
    local = poses.rotate(poses.inverse(made.T_world_object_start), cloud.object_normals.astype(float))
    assert np.median(np.abs(local).max(axis=1)) > 0.99
    outward = np.einsum("ij,ij->i", cloud.object_normals, cloud.object_points - made.T_world_object_start[:3, 3])
    assert (outward > 0).mean() > 0.95
    assert len(cloud.camera_K) == (0 if has_normals else 8)


def test_demos_come_in_the_order_of_their_numbers_and_the_digest_is_that_of_what_they_hold(
    source: Path, tmp_path: Path
) -> None:
    places, digest = rpdiff_files.find(str(source))
    names = [(place.file.name, place.chunk_key) for place in places]
    singles = [(f"demo_aug_{i}.npz", None) for i in (2, 9, 10)]
    assert names == singles + [("demo_aug_0.npz", key) for key in "012"]
    moved = Path(shutil.copytree(source, tmp_path / "elsewhere"))
    assert rpdiff_files.find(str(moved))[1] == digest
    save(moved / "demo_aug_2.npz", book_demo(1, 0))
    rpdiff_files.find.cache_clear()
    assert rpdiff_files.find(str(moved))[1] != digest


def test_a_source_that_changes_under_way_is_refused(book: dict[str, Any], tmp_path: Path) -> None:
    asked = config(save(tmp_path / "a.npz", book))
    save(tmp_path / "a.npz", can_demo())
    rpdiff_files.find.cache_clear()
    with pytest.raises(FormatError, match="has changed since the import began"):
        rpdiff_scenes.demonstrate(asked, PLACEMENT, 0)


# With meshes


def container_goals(sample: dict[str, np.ndarray]) -> np.ndarray:
    return poses.inverse(sample["pose/T_world_container"]) @ sample["goals/T_world_object"]


Samples = dict[int, dict[str, np.ndarray]]


def test_goals_are_the_demonstrated_one_as_it_settles_and_the_free_slots(samples: Samples) -> None:
    assert sorted(samples) == [0, 1, 2, 3, 5]
    for demo, slot in ((0, 0), (1, 2), (2, 1)):
        goals = container_goals(samples[demo])
        demonstrated = poses.inverse(samples[demo]["pose/T_world_container"]) @ samples[demo]["pose/T_world_object_goal"]
        assert demonstrated[:3, 3] == pytest.approx([0.01, rpdiff_demos.SLOTS[slot], 0.126], abs=5e-4)
        assert sorted(goals[:, 1, 3]) == pytest.approx(sorted(rpdiff_demos.SLOTS), abs=5e-4)
        (rejected,) = samples[demo]["rejected_goals/reason"].tolist()
        assert records.REJECT_REASONS[rejected] in ("penetrates", "moved"), "the slot in which a book stands"
    for demo in (3, 5):
        wanted = np.add(rpdiff_demos.CAN_SLOTS, [0, 0, rpdiff_demos.CAN[1] / 2])
        goals = container_goals(samples[demo])
        assert goals[np.argsort(goals[:, 1, 3]), :3, 3] == pytest.approx(wanted[np.argsort(wanted[:, 1])], abs=2e-3)


def test_what_an_object_is_follows_from_the_mesh_that_was_simulated(samples: Samples) -> None:
    kinds = [records.SYMMETRIES[int(sample["symmetry/kind"])] for sample in samples.values()]
    assert kinds == ["box"] * 3 + ["revolution"] * 2
    assert np.allclose(np.sort(samples[0]["object_parts/size"][0]), np.sort(rpdiff_demos.BOOK), atol=1e-6), "_dec.obj"
    parts = [len(sample["scene/kind"]) for sample in samples.values()]
    assert parts == [9, 9, 9, 3, 3], "the pieces of the containers' meshes"
    assert {records.GOAL_KINDS[k] for sample in samples.values() for k in sample["goals/kind"]} == {"settled"}
    assert samples[0]["goals/clearance"] == pytest.approx([0.07, 0.02, 0.04], abs=1e-3), "what is left beside a book of 4 cm"


def test_the_judge_accepts_every_imported_goal_and_refuses_a_book_in_a_book(samples: Samples) -> None:
    for sample in samples.values():
        demo = records.read_demo(sample)
        aside = poses.rotate(demo.T_world_container, np.array([[0, 0.03, 0]]))[0]
        tightest = demo.goals[demo.goal_clearance.argmin()]
        into_a_neighbour = poses.pose(tightest[:3, :3], tightest[:3, 3] + aside)[None]
        verdicts = simulate.judge(demo, np.concatenate([demo.goals, into_a_neighbour]), PLACEMENT)
        assert all(verdict.success for verdict in verdicts[:-1])
        if records.SYMMETRIES[int(demo.symmetry_kind)] == "box":
            assert verdicts[-1].reason == "pushed"


def test_an_imported_dataset_is_whole_and_says_what_was_rejected_and_where_it_comes_from(imported: Path, source: Path) -> None:
    assert health.verify(imported).ok
    found = manifest.read(imported)
    assert found.rejects.demos == {"no_object_points": 1}
    scene = found.recipe["scene"]
    assert scene["task"] == "rpdiff"
    assert scene["source"] == str(source)
    assert scene["source_sha256"] == rpdiff_files.find(str(source))[1]
    assert found.recipe["noise"]["preset"] == "none"
    card = (imported / "README.md").read_text()
    assert str(source) in card
    assert "license: other" in card
    assert "cc0" not in card


def test_instances_are_those_of_the_meshes_and_no_split_shares_one(imported: Path) -> None:
    index = loading.open(imported).index
    assert len(set(index["container_instance"].tolist())) == 5
    assert len(set(index["object_instance"].tolist())) == 5
    for name in ("container_instance", "object_instance"):
        owners = {(i, s) for i, s in zip(index[name].tolist(), index["split"].tolist()) if s != "unused"}
        assert len({i for i, _ in owners}) == len(owners)


def test_without_meshes_instances_are_names_and_the_judge_says_what_is_missing(book: dict[str, Any], tmp_path: Path) -> None:
    demos = [both(save(tmp_path / f"{i}.npz", book_demo(i, i % 2)))[0] for i in range(3)]
    assert demos[0].container_instance == demos[2].container_instance != demos[1].container_instance
    with pytest.raises(UsageError, match="import them with their meshes"):
        simulate.judge(demos[0], demos[0].goals, PLACEMENT)


def test_a_dataset_without_meshes_is_labelled_and_verified_and_its_goals_are_drawn_as_clouds(
    book: dict[str, Any], tmp_path: Path
) -> None:
    save(tmp_path / "in/demo_aug_0.npz", book)
    root = tmp_path / "out"
    imports.run(imports.rpdiff_recipe(tmp_path / "in", None, None, ()), root, engine="inline")
    pipeline.label(root, engine="inline")
    assert health.verify(root).ok
    (sample,) = loading.open(root)
    assert (sample["container_superpoints/affordance"] > 0).any()
    with_goal = pictures.goal_picture(sample, pictures.front_view(sample, 100, 80)).astype(int)
    nowhere = {**sample, "goals/T_world_object": np.zeros((0, 4, 4))}
    without = pictures.goal_picture(nowhere, pictures.front_view(sample, 100, 80)).astype(int)
    assert (np.abs(with_goal - without).max(axis=2) > 20).sum() > 50
    assert (np.abs(without - 255).max(axis=2) > 20).mean() > 0.2
    seen = viewer.view(pictures.Shown(sample, "rpdiff", "train"))
    shown = {layer["name"]: layer["on"] for layer in seen["layers"]}
    assert shown["object cloud, demonstrated"]
    assert not any("goal" in name or "true parts" in name for name in shown)


def test_meshes_are_drawn_and_their_triangles_are_in_the_3d_view(samples: Samples) -> None:
    picture = pictures.goal_picture(samples[0], pictures.front_view(samples[0], 100, 80))
    assert (np.abs(picture.astype(int) - 255).max(axis=2) > 20).mean() > 0.2
    seen = viewer.view(pictures.Shown(samples[0], "rpdiff", "train"))
    faces = {name: len(np.frombuffer(b64decode(solid["faces"]), "<u2")) for name, solid in seen["solids"].items()}
    assert faces == {"container": 9 * 12 * 3, "clutter": 0, "object": 12 * 3}
    assert "true parts: container" in {layer["name"] for layer in seen["layers"]}


def test_of_several_containers_the_one_that_is_meant_counts(book: dict[str, Any], mesh_folder: Path, tmp_path: Path) -> None:
    beside = poses.pose(None, (0.8, 0.6, 0)) @ rpdiff_demos.T_WORLD_CONTAINER
    two = changed(
        book,
        multi_object_ids={"parent": ["syn_bookshelf_1", "syn_bookshelf_0"], "child": ["syn_book_0"]},
        placement_object_idx={"parent": 1, "child": 0},
    )
    files = book["multi_obj_mesh_file"]
    two["multi_obj_mesh_file"] = {"parent": files["parent"] * 2, "child": files["child"]}
    for key in ("multi_obj_start_obj_pose", "multi_obj_final_obj_pose"):
        two[key]["parent"] = [simulate.to_pose7(beside), *two[key]["parent"]]
    one, of_two = both(save(tmp_path / "a.npz", book), mesh_folder)[0], both(save(tmp_path / "b.npz", two), mesh_folder)[0]
    assert np.allclose(of_two.T_world_container, one.T_world_container)
    assert np.allclose(of_two.goals, one.goals, atol=1e-4)
    assert len(of_two.part_kind) == 2 * len(one.part_kind)
    assert of_two.container_instance == one.container_instance


def test_a_container_whose_own_frame_lies_on_its_side_is_imported_upright(
    book: dict[str, Any], mesh_folder: Path, tmp_path: Path
) -> None:
    """Its mesh and its pose are turned against each other, so that in the world nothing changes."""
    turn = poses.pose(poses.rotation_about((1, 0, 0), np.pi / 2))
    folder = Path(shutil.copytree(mesh_folder, tmp_path / "meshes"))
    parts = [
        records.Mesh(poses.transform(poses.inverse(turn), m.vertices), m.faces)
        for m in rpdiff_demos.as_meshes(rpdiff_demos.shelf())
    ]
    rpdiff_demos.write(folder, "syn_bookshelf_obj/syn_bookshelf_0.obj", parts)
    (folder / "syn_bookshelf_obj/open_slot_poses/syn_bookshelf_0_open_slot_poses.txt").unlink()
    lying = changed(book)
    for key in ("multi_obj_start_obj_pose", "multi_obj_final_obj_pose"):
        lying[key]["parent"] = [simulate.to_pose7(rpdiff_demos.T_WORLD_CONTAINER @ turn)]
    upright, _ = both(save(tmp_path / "a.npz", book), mesh_folder)
    turned, _ = both(save(tmp_path / "b.npz", lying), folder)
    assert np.allclose(turned.T_world_container, upright.T_world_container, atol=1e-9)
    assert np.allclose(turned.T_world_object_goal, upright.T_world_object_goal, atol=1e-4)


def test_of_meshes_with_one_name_the_one_in_the_named_folder_is_taken(tmp_path: Path) -> None:
    for folder in ("a/books_obj", "b/cans_obj"):
        rpdiff_demos.write(tmp_path, f"{folder}/thing_1.obj", rpdiff_demos.as_meshes(rpdiff_demos.book()))
    found = rpdiff_files.mesh_folder(str(tmp_path))
    assert found.path("/rpdiff/descriptions/objects/cans_obj/thing_1.obj") == tmp_path / "b/cans_obj/thing_1.obj"
    assert found.path("C:\\rpdiff\\books_obj\\thing_1.obj") == tmp_path / "a/books_obj/thing_1.obj"
    assert found.path("../../etc/passwd") is None


# What is wrong with a demo


def scaled(demo: dict[str, Any], factor: float) -> dict[str, Any]:
    clouds = {body: factor * points for body, points in demo["multi_obj_start_pcd"].items()}
    return changed(demo, multi_obj_start_pcd=clouds, multi_obj_final_pcd=None)


def with_clouds(demo: dict[str, Any], **clouds: Any) -> dict[str, Any]:
    return changed(demo, multi_obj_start_pcd={**demo["multi_obj_start_pcd"], **clouds}, multi_obj_final_pcd=None)


def with_pose(demo: dict[str, Any], pose7: list[Any]) -> dict[str, Any]:
    return changed(demo, multi_obj_start_obj_pose={**demo["multi_obj_start_obj_pose"], "child": [pose7]})


def inwards(demo: dict[str, Any]) -> dict[str, Any]:
    points = demo["multi_obj_start_pcd"]
    toward = {body: cloud.mean(axis=0) - cloud for body, cloud in points.items()}
    return changed(demo, normals=toward, cam_poses=None, cam_intrinsics=None)


def lifted(demo: dict[str, Any], height: float) -> dict[str, Any]:
    """All of it, higher."""
    up = np.array([0, 0, height])
    clouds = {
        key: {body: points + up for body, points in demo[key].items()} for key in ("multi_obj_start_pcd", "multi_obj_final_pcd")
    }
    bodies = {
        key: {body: [[*pose[:2], pose[2] + height, *pose[3:]] for pose in poses] for body, poses in demo[key].items()}
        for key in ("multi_obj_start_obj_pose", "multi_obj_final_obj_pose")
    }
    return changed(demo, **clouds, **bodies, cam_poses=demo["cam_poses"] + np.pad(up[:, None], ((0, 1), (3, 0))))


MIRROR = np.diag([1.0, 1, -1, 1])
FAULTS: dict[str, list[Any]] = {
    "missing_keys": [
        lambda d: changed(d, multi_obj_final_obj_pose=None),
        lambda d: changed(d, multi_obj_start_pcd={"parent": d["multi_obj_start_pcd"]["parent"]}),
        lambda d: with_clouds(d, child=np.zeros((50, 2))),
        lambda d: with_clouds(d, child=np.full((50, 3), "a")),
        lambda d: with_pose(d, [0.0] * 6),
        lambda d: with_pose(d, [{}] * 7),
        lambda d: changed(d, placement_object_idx={"parent": 5, "child": 0}),
        lambda d: changed(d, cam_poses=d["cam_poses"][:2]),
        lambda d: changed(d, normals={"parent": np.ones((3, 3)), "child": np.ones((3, 3))}),
    ],
    "unsuccessful": [lambda d: changed(d, success=False), lambda d: {**d, "success": None}],
    "no_container_points": [lambda d: with_clouds(d, parent=np.zeros((0, 3)))],
    "no_object_points": [lambda d: with_clouds(d, child=np.zeros((0, 3))), lambda d: with_clouds(d, child=[])],
    "not_finite": [
        lambda d: with_clouds(d, child=np.full((50, 3), np.nan)),
        lambda d: with_pose(d, [np.inf, 0, 0, 0, 0, 0, 1.0]),
        lambda d: changed(d, cam_poses=np.full((4, 4, 4), np.nan)),
    ],
    "not_metres": [lambda d: scaled(d, 1000), lambda d: scaled(d, 0.001)],
    "not_on_table": [lambda d: lifted(d, -1.0), lambda d: lifted(d, 1.2)],
    "too_large": [
        lambda d: with_clouds(d, child=np.zeros((5_000_001, 3), np.uint8)),
        lambda d: with_clouds(d, child=[np.zeros((100_000, 3), np.uint8)] * 51),
    ],
    "not_rigid": [
        lambda d: with_pose(d, [0.3, 0, 1, 0, 0, 0, 0.0]),
        lambda d: with_pose(d, [0.3, 0, 1, 0, 0, 0, 2.0]),
        lambda d: changed(d, cam_poses=d["cam_poses"] @ MIRROR),
    ],
    "clouds_and_poses_differ": [
        lambda d: changed(d, multi_obj_final_pcd={**d["multi_obj_final_pcd"], "child": d["multi_obj_start_pcd"]["child"]})
    ],
    "normals_inwards": [inwards, lambda d: {**inwards(d), "cam_poses": d["cam_poses"], "cam_intrinsics": d["cam_intrinsics"]}],
    "no_normals": [lambda d: changed(d, cam_poses=None, cam_intrinsics=None)],
    "bad_arrays": [
        lambda d: changed(d, dapdata={"goals/T_world_object": np.zeros((1, 4, 4))}),
        lambda d: changed(d, dapdata=[1]),
    ],
}


@pytest.mark.parametrize("reason", FAULTS)
def test_a_demo_with_a_fault_is_rejected_for_its_reason(reason: str, book: dict[str, Any], tmp_path: Path) -> None:
    for number, damage in enumerate(FAULTS[reason]):
        demo = damage(book)
        for path in (save(tmp_path / f"{number}.npz", demo), save_chunk(tmp_path / f"chunk{number}.npz", [demo])):
            if path.name.startswith("chunk") or rpdiff_files.NEEDED[0] in demo:
                assert Rejected(reason) in both(path), number


def test_a_chunk_that_is_cut_off_or_damaged_costs_what_cannot_be_read(book: dict[str, Any], tmp_path: Path) -> None:
    path = save_chunk(tmp_path / "in/demo_aug_0.npz", [book, book])
    save(tmp_path / "in/demo_aug_1.npz", book)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert both(tmp_path / "in")[0] == Rejected("unreadable")
    path.write_bytes(whole[:1000] + bytes([whole[1000] ^ 1]) + whole[1001:])
    rpdiff_files.find.cache_clear()
    assert both(tmp_path / "in")[0] == Rejected("unreadable")
    assert isinstance(both(tmp_path / "in", demo=1)[0], MeshDemo)


def test_a_cloud_that_would_fill_the_memory_is_not_read(book: dict[str, Any], tmp_path: Path) -> None:
    path = save(tmp_path / "a.npz", book)
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**8, 3)}
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open("normals.npy", "w", force_zip64=True) as file,
    ):
        np.lib.format.write_array_header_1_0(file, header)
        for _ in range(150):
            file.write(bytes(1 << 20))
    assert both(path)[0] == Rejected("too_large")


def broken_meshes(folder: Path, reason: str) -> None:
    shelf, dec = folder / "syn_bookshelf_obj/syn_bookshelf_0.obj", folder / "syn_book_obj/syn_book_0_dec.obj"
    if reason == "mesh_missing":
        shelf.unlink()
    if reason == "mesh_broken":
        shelf.write_text("v 0 0 nan\nf 1 1 1\n")
    if reason == "mesh_and_cloud_differ":
        shifted = [
            records.Mesh(mesh.vertices + np.array([0, 0, 0.03]), mesh.faces)
            for mesh in rpdiff_demos.as_meshes(rpdiff_demos.book())
        ]
        dec.write_text(rpdiff_demos.meshes.to_obj(shifted))
    if reason == "object_not_convex":
        dec.write_text(rpdiff_demos.meshes.to_obj([rpdiff_demos.mesh_scenes.cup()]))
    if reason == "mesh_too_large":
        shelf.write_text("v 0 0 0\nv 0 0 1\nv 0 1 0\n" + "f 1 2 3\n" * 200_001)
    if reason == "slots":
        (folder / "syn_bookshelf_obj/open_slot_poses/syn_bookshelf_0_open_slot_poses.txt").write_text("1 2 3\n")


BROKEN_MESHES = ("mesh_missing", "mesh_broken", "mesh_too_large", "mesh_and_cloud_differ", "object_not_convex")


@pytest.mark.parametrize("case", [*BROKEN_MESHES, "slots"])
def test_a_mesh_that_is_of_no_use_rejects_the_demo(case: str, book: dict[str, Any], mesh_folder: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(mesh_folder, tmp_path / "meshes"))
    broken_meshes(folder, case)
    assert both(save(tmp_path / "a.npz", book), folder)[0] == Rejected("mesh_broken" if case == "slots" else case)


def test_a_demonstration_that_does_not_hold_is_rejected_for_what_became_of_it(mesh_folder: Path, tmp_path: Path) -> None:
    for place, reason in (((0.01, 0.0, 0.236), "moved"), ((0.16, 0.0, 0.126), "moved"), ((0.01, 0.075, 0.126), "penetrates")):
        start = poses.pose(None, (0.3, -0.2, 1.2))
        demo = rpdiff_demos.made(
            "syn_book", "syn_bookshelf", rpdiff_demos.shelf(), rpdiff_demos.book(), start, poses.pose(rpdiff_demos.UP, place), 0
        )
        assert both(save(tmp_path / f"{place}.npz", demo), mesh_folder)[0] == Rejected(reason)


def test_every_reason_is_tested_and_documented() -> None:
    assert {*FAULTS, *BROKEN_MESHES, "unreadable", "refused", "outside"} == rpdiff_files.REASONS.keys()
    page = (Path(__file__).parents[1] / "docs/import_rpdiff.md").read_text()
    for reason, words in rpdiff_files.REASONS.items():
        assert f"| `{reason}` | {words} |" in page


# Pickles are read as data, or not at all


class Calls:
    """Unpickles into a call."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


def mark(path: Path) -> Any:
    return Calls(os.system, f"touch {path}")


def object_npz(path: Path, payload: bytes) -> Path:
    """An npz file with an object array `a` whose pickle is `payload`."""
    header = b"\x93NUMPY\x01\x00v\x00{'descr': '|O', 'fortran_order': False, 'shape': (), }"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", header + b" " * (127 - len(header)) + b"\n" + payload)
    return path


def boxed(value: Any) -> np.ndarray:
    array = np.empty((), object)
    array[()] = value
    return array


def numpy_pickle(name: str, arguments: bytes, state: bytes = b"") -> bytes:
    return b"\x80\x03cnumpy.core.multiarray\n" + name.encode() + b"\n" + arguments + b"R" + state + b"."


NDARRAY = b"(cnumpy\nndarray\n(K\x00tC\x01bt"
F8 = b"cnumpy\ndtype\n(X\x02\x00\x00\x00f8\x89\x88tR(K\x03X\x01\x00\x00\x00<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
PICKLES = {
    "os.system": lambda path: pickle.dumps(mark(path)),
    "os.system in an array": lambda path: pickle.dumps(boxed(mark(path))),
    "os.system deep in a dict": lambda path: pickle.dumps(boxed({"parent": [{"a": (1, mark(path))}], "child": 2})),
    "os.system as a key": lambda path: pickle.dumps({mark(path): 1}),
    "builtins.eval": lambda path: pickle.dumps(Calls(eval, f"open({str(path)!r}, 'w')")),
    "builtins.eval by its old name": lambda path: b"c__builtin__\neval\n(V1\ntR.",
    "builtins.getattr": lambda path: pickle.dumps(Calls(getattr, "a", "upper")),
    "a method of numpy": lambda path: b"\x80\x03cnumpy\nload\n(X\x01\x00\x00\x00atR.",
    "numpy's own exec": lambda path: b"\x80\x03cnumpy.testing._private.utils\nrunstring\n(V1\n}tR.",
    "_reconstruct of another class": lambda path: numpy_pickle("_reconstruct", b"(cos\nsystem\n(K\x00tC\x01bt"),
    "_reconstruct of a shape": lambda path: numpy_pickle("_reconstruct", b"(cnumpy\nndarray\n(J\xff\xff\xff\x7ftC\x01bt"),
    "an array of more than its bytes": lambda path: numpy_pickle(
        "_reconstruct", NDARRAY, b"(K\x01(J\xff\xff\xff\x7ft" + F8 + b"\x89C\x08abcdefghtb"
    ),
    "an array of negative length": lambda path: numpy_pickle(
        "_reconstruct", NDARRAY, b"(K\x01(J\xff\xff\xff\xfft" + F8 + b"\x89C\x00tb"
    ),
    "an array without a dtype": lambda path: numpy_pickle("_reconstruct", NDARRAY, b"(K\x01(K\x01tN\x89C\x08abcdefghtb"),
    "an array of records": lambda path: pickle.dumps(boxed(np.zeros(2, [("a", "f8")]))),
    "an array of objects of too many": lambda path: pickle.dumps(np.array([1, None], object)).replace(
        b"K\x02\x85", b"K\x09\x85"
    ),
    "a state for a dict": lambda path: b"\x80\x03}}b.",
    "a class": lambda path: pickle.dumps(Path("a")),
    "INST": lambda path: b"(S'touch'\nios\nsystem\n.",
    "OBJ": lambda path: b"(cos\nsystem\nS'touch'\no.",
    "NEWOBJ": lambda path: b"\x80\x02cos\nsystem\n)\x81.",
    "a persistent id": lambda path: b"Pa\n.",
    "an extension": lambda path: b"\x80\x02\x82\x01.",
    "a bomb of lists": lambda path: b"\x80\x03" + b"]" * 3_000_000 + b".",
    "a length that lies": lambda path: b"\x80\x04\x8e" + (1 << 60).to_bytes(8, "little") + b"abc.",
    "a list and a half": lambda path: b"\x80\x03]].",
    "a memo of nothing": lambda path: b"\x80\x03h\x05.",
    "an empty stack": lambda path: b"\x80\x03tR.",
    "nothing": lambda path: b"",
    "half a pickle": lambda path: pickle.dumps(boxed({"a": np.ones(100)}))[:-50],
}


@pytest.mark.parametrize("case", PICKLES)
def test_a_pickle_that_is_more_than_data_is_refused_and_nothing_of_it_runs(case: str, tmp_path: Path) -> None:
    path = object_npz(tmp_path / "a.npz", PICKLES[case](tmp_path / "ran"))
    start = time.process_time()
    with pytest.raises(FormatError, match="expected an npz file of plain arrays"):
        object_arrays.read(path, "a")
    assert not (tmp_path / "ran").exists()
    assert time.process_time() - start < 2


def test_reading_imports_and_calls_nothing(book: dict[str, Any], tmp_path: Path) -> None:
    """An audit hook sees what unpickling does; it cannot be taken away again, hence a process of its own."""
    good, bad = save(tmp_path / "a.npz", book), object_npz(tmp_path / "b.npz", pickle.dumps(boxed(mark(tmp_path / "ran"))))
    script = f"""
import sys
from pathlib import Path
from dapdata.interop import object_arrays
seen, good = [], Path({str(good)!r})
object_arrays.read(good, "multi_obj_names")  # numpy and zipfile import modules of their own when they are first used
sys.addaudithook(lambda event, arguments: seen.append(event))
for name in object_arrays.member_names(good):
    object_arrays.read(good, name)
try:
    object_arrays.read(Path({str(bad)!r}), "a")
except ValueError:
    pass
print(*{{event for event in seen if event.startswith(("pickle", "import", "os.", "exec", "subprocess", "socket"))}})
"""
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert told.stdout.split() == []
    assert not (tmp_path / "ran").exists()


def same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return type(a) is type(b) and len(a) == len(b) and all(map(same, a, b))
    return type(a) is type(b) and a == b


VALUES = {
    "numbers": {"a": 1, "b": -70_000, "c": 2.5, "d": True, "e": None, "f": "text ü", "g": b"bytes", "h": (1, 2, 3, (4,), ())},
    "arrays": {str(dtype): np.arange(6).reshape(2, 3).astype(dtype) for dtype in ("f8", "f4", "i8", "u1", "?", "<U4")},
    "lists": [[1.0, 2.0], [], [None, {"a": [np.zeros((0, 3))]}]],
    "shared": [np.ones(3)] * 3,
    "transposed": {"a": np.arange(6.0).reshape(2, 3).T, "b": np.array(3.5), "c": np.array("sim")},
}


@pytest.mark.parametrize("case", VALUES)
def test_plain_data_reads_back_whoever_wrote_it(case: str, tmp_path: Path) -> None:
    value = VALUES[case]
    np.savez(tmp_path / "theirs.npz", a=boxed(value))
    object_arrays.write(tmp_path / "ours.npz", {"a": value})
    again = tmp_path / "again.npz"
    object_arrays.write(again, {"a": value})
    assert again.read_bytes() == (tmp_path / "ours.npz").read_bytes()
    for file in ("theirs.npz", "ours.npz"):
        assert same(object_arrays.read(tmp_path / file, "a"), value)
    with np.load(tmp_path / "ours.npz", allow_pickle=True) as loaded:
        assert same(loaded["a"].item(), value)


def test_what_is_written_names_numpy_as_every_version_of_it_is_called(tmp_path: Path) -> None:
    object_arrays.write(tmp_path / "a.npz", {"a": {"b": np.ones(3)}})
    data = zipfile.ZipFile(tmp_path / "a.npz").read("a.npy")
    assert b"numpy.core.multiarray" in data
    assert b"_core" not in data


def test_data_that_contain_themselves_are_a_fault_like_any_other(book: dict[str, Any], tmp_path: Path) -> None:
    endless: list[Any] = []
    endless.append(endless)
    for key in ("multi_obj_start_pcd", "multi_obj_start_obj_pose", "multi_object_ids"):
        demo = changed(book, **{key: {**book[key], "child": endless}})
        assert both(save(tmp_path / f"{key}.npz", demo))[0] == Rejected("missing_keys") or key == "multi_object_ids"


def test_random_damage_is_an_error_that_is_known_or_harmless() -> None:
    draw = np.random.default_rng(0)
    whole = pickle.dumps(boxed({"parent": np.arange(30.0).reshape(10, 3), "child": [1, "a", None, (2.0, True)]}), protocol=4)
    for _ in range(2000):
        data = bytearray(whole)
        for at in draw.integers(0, len(data), draw.integers(1, 6)):
            data[at] = draw.integers(256)
        with suppress(*object_arrays.BROKEN):
            object_arrays.unpickle(bytes(data))


# Links, several containers, and what is told of those that were left out


def test_links_that_lead_out_are_rejected_and_links_to_folders_refused(book: dict[str, Any], tmp_path: Path) -> None:
    save(tmp_path / "in/demo_aug_0.npz", book)
    save(tmp_path / "elsewhere/demo_aug_1.npz", book)
    (tmp_path / "in/demo_aug_1.npz").symlink_to(tmp_path / "elsewhere/demo_aug_1.npz")
    (tmp_path / "in/demo_aug_2.npz").symlink_to("demo_aug_0.npz")
    (tmp_path / "in/demo_aug_3.npz").symlink_to("nowhere.npz")
    made = [both(tmp_path / "in", demo=demo)[0] for demo in range(4)]
    assert isinstance(made[0], MeshDemo)
    assert isinstance(made[2], MeshDemo), "a link within the source is a file of it"
    assert made[1] == made[3] == Rejected("outside")
    (tmp_path / "whole").symlink_to(tmp_path / "in")
    assert len(rpdiff_files.find(str(tmp_path / "whole"))[0]) == 4, "the source itself may be a link"
    (tmp_path / "in/more").symlink_to(tmp_path / "elsewhere")
    rpdiff_files.find.cache_clear()
    with pytest.raises(FormatError, match="in/more: a link to a folder, expected a folder; import what it leads to on its own"):
        rpdiff_files.find(str(tmp_path / "in"))


def test_a_mesh_behind_a_link_that_leads_out_is_not_read(book: dict[str, Any], mesh_folder: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(mesh_folder, tmp_path / "meshes"))
    shelf = folder / "syn_bookshelf_obj/syn_bookshelf_0.obj"
    shutil.move(shelf, tmp_path / "shelf.obj")
    shelf.symlink_to(tmp_path / "shelf.obj")
    assert both(save(tmp_path / "a.npz", book), folder)[0] == Rejected("mesh_missing")


def test_without_an_index_the_container_is_the_one_nearest_to_the_goal(book: dict[str, Any], tmp_path: Path) -> None:
    (own,) = book["multi_obj_start_obj_pose"]["parent"]
    far = [own[0], own[1] + 1.5, *own[2:]]
    for index, parents in ((1, [far, own]), (0, [own, far])):
        bodies = {key: {**book[key], "parent": parents} for key in ("multi_obj_start_obj_pose", "multi_obj_final_obj_pose")}
        names = {key: {**book[key], "parent": ["a", "b"]} for key in ("multi_object_ids", "multi_obj_mesh_file")}
        several = changed(book, **bodies, **names, placement_object_idx=None)
        demo, _ = both(save(tmp_path / f"{index}.npz", several))
        assert np.allclose(demo.T_world_container[:2, 3], own[:2])


def test_each_demo_that_is_left_out_is_told_with_its_file_and_what_was_found(
    book: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    save(tmp_path / "in/demo_aug_0.npz", scaled(book, 1000))
    save_chunk(tmp_path / "in/demo_aug_1.npz", [book, {**book, "multi_obj_names": mark(tmp_path / "ran")}])
    save(tmp_path / "in/demo_aug_2.npz", changed(book, multi_obj_final_obj_pose=None))
    asked = ["import", "rpdiff", "in", "--out", "out", "--engine", "inline"]
    code, out, err = run(capsys, *asked)
    assert (code, out) == (0, "out\n")
    *_, first, second, third, counts = err.splitlines()
    assert first.startswith("rejected demo 0, not_metres: demo_aug_0.npz: container of ")
    assert first.endswith("expected 0.05 to 5.0 m; in millimetres?")
    assert second.startswith("rejected demo 2, refused: demo_aug_1.npz, demo 1: ")
    assert "posix.system; it is refused, nothing was run" in second
    assert third == "rejected demo 3, missing_keys: demo_aug_2.npz: no multi_obj_final_obj_pose"
    assert counts == "imported 1 of 4 demos, 1 not_metres, 1 refused, 1 missing_keys; next: dapdata label out"
    assert not (tmp_path / "ran").exists()
    told = json.loads(run(capsys, *asked, "--json")[1])
    assert [(one["demo"], one["reason"], one["stage"]) for one in told["rejected"]] == [
        (0, "not_metres", "demonstrate"),
        (2, "refused", "demonstrate"),
        (3, "missing_keys", "demonstrate"),
    ]
    assert health.rejected("out") == told["rejected"]


# Pegs and holes, and meshes of another size


def hung() -> tuple[dict[str, Any], list[rpdiff_demos.Part], list[rpdiff_demos.Part]]:
    """A mug on a rack: the demo, and the parts of both."""
    task = tasks.load("mug_rack")
    for seed in range(20):
        scene = task.sample_scene(task.Params(), stream(seed, "scene", 0))
        demo = scene if isinstance(scene, Rejected) else simulate.demonstrate(scene, PLACEMENT, stream(seed, "goal", 0))
        if not isinstance(demo, Rejected):
            break
    solid = [solids.Part(int(k), tuple(s), T) for k, s, T in zip(demo.part_kind, demo.part_size, demo.T_container_part)]
    mug = [solids.Part(int(k), tuple(s), T) for k, s, T in zip(demo.object_kind, demo.object_size, demo.T_object_part)]
    T_goal = poses.inverse(demo.T_world_container) @ demo.T_world_object_goal
    start = poses.pose(poses.rotation_about((1, 2, 3), 0.8), (0.3, -0.2, 1.2))
    return rpdiff_demos.made("mug", "syn_rack_easy", solid, mug, start, T_goal, 0), solid, mug


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 0.3])
def test_a_mug_hangs_on_its_peg_whatever_the_scale_of_the_meshes(scale: float, tmp_path: Path) -> None:
    demo, rack, mug = hung()
    for name, parts in (("syn_rack_easy_obj/syn_rack_easy_0.obj", rack), ("mug_obj/mug_0_dec.obj", mug)):
        larger = [rpdiff_demos.meshes.scaled(mesh, 1 / scale) for mesh in rpdiff_demos.as_meshes(parts)]
        rpdiff_demos.write(tmp_path / "meshes", name, larger)
    made, _ = both(save(tmp_path / "a.npz", demo), tmp_path / "meshes")
    assert isinstance(made, MeshDemo), made
    assert [records.GOAL_KINDS[k] for k in made.goal_kind] == ["peg"]
    peg = max(rack, key=lambda part: part.T[0, 3]).T[:3, 2]
    assert abs(made.goal_approach[0] @ peg) > 0.999, "along the peg"
    assert made.goal_approach[0, 2] > 0
    sizes = np.sort(made.object_size, axis=1), np.sort([part.size for part in mug], axis=1)
    assert sizes[0].max() == pytest.approx(sizes[1].max(), rel=0.01)
    assert all(verdict.success for verdict in simulate.judge(made, made.goals, PLACEMENT))


def test_what_goes_into_a_hole_comes_in_from_above(tmp_path: Path) -> None:
    plate = solids.plate_with_holes(np.array([0.0, 0.08]), np.array([0.0]), 0.034, (0.03, 0.04), 0.03, 0.05)
    base = [solids.box((0.174, 0.114, 0.005), (0.04, 0, 0.0025)), *plate]
    vial = [solids.cylinder(0.0095, 0.12, (0, 0, 0))]
    start = poses.pose(None, (0.3, -0.2, 1.06))
    demo = rpdiff_demos.made("vial", "plate", base, vial, start, poses.pose(None, (0, 0, 0.075)), 0)
    for name, parts in (("plate_obj/plate_0.obj", base), ("vial_obj/vial_0_dec.obj", vial)):
        rpdiff_demos.write(tmp_path / "meshes", name, rpdiff_demos.as_meshes(parts))
    made, _ = both(save(tmp_path / "a.npz", demo), tmp_path / "meshes", symmetry="revolution")
    assert isinstance(made, MeshDemo), made
    assert made.goal_approach.tolist() == [[0, 0, 1]]
    assert made.opening.tolist() == [0, 0, 1]
    assert all(verdict.success for verdict in simulate.judge(made, made.goals, PLACEMENT))
    asked = both(tmp_path / "a.npz", tmp_path / "meshes", symmetry="revolution", opening="+x")[0]
    assert asked == Rejected("outside"), "its middle is above the plate: from the front it is beside the container"


# Commands


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda folder: None, "no such file or folder"),
        (lambda folder: folder.mkdir(), "no npz files, expected demos of RPDiff"),
        (lambda folder: np.savez(folder.with_suffix(".npz"), points=np.ones(3)), "no such file"),
        (
            lambda folder: (folder.mkdir(), np.savez(folder / "a.npz", points=np.ones(3))),
            "1 npz files without `multi_obj_start_pcd`",
        ),
        (lambda folder: (folder.mkdir(), (folder / "a.npz").write_bytes(b"PK\x03\x04" + bytes(99))), "1 npz files without"),
    ],
    ids=["nothing", "an empty folder", "another path", "another npz", "a broken file"],
)
def test_a_source_with_nothing_of_use_is_one_line_and_leaves_nothing(
    make: Any, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make(tmp_path / "in")
    code, out, err = run(capsys, "import", "rpdiff", tmp_path / "in", "--out", tmp_path / "out")
    assert (code, out) == (2, "")
    assert words in err
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_source_in_which_no_demo_can_be_used_names_the_reasons_and_leaves_nothing(
    book: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save(tmp_path / "in/a.npz", changed(book, success=False))
    save(tmp_path / "in/b.npz", scaled(book, 1000))
    code, out, err = run(capsys, "import", "rpdiff", tmp_path / "in", "--out", tmp_path / "out", "--engine", "inline")
    assert (code, out) == (2, "")
    last = err.strip().split("\n")[-1]
    assert "all 2 demos were rejected (not_metres 1, unsuccessful 1)" in last
    assert "docs/import_rpdiff.md" in last
    assert not (tmp_path / "out").exists()


def test_a_folder_of_meshes_without_meshes_is_refused_before_anything_is_written(
    book: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save(tmp_path / "in/a.npz", book)
    (tmp_path / "meshes").mkdir()
    for folder, words in ((tmp_path / "meshes", "has no meshes"), (tmp_path / "none", "no such folder")):
        code, _, err = run(capsys, "import", "rpdiff", tmp_path / "in", "--meshes", folder, "--out", tmp_path / "out")
        assert code == 2
        assert words in err
    assert not (tmp_path / "out").exists()


def test_an_import_goes_on_where_it_stopped_and_its_dry_run_says_so(
    source: Path, imported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    asked = ["import", "rpdiff", source, "--out", "out", "--engine", "inline", "--set", "shard_size=1"]
    assert run(capsys, *asked, "--demos", 2)[0] == 0
    units = {path: path.stat().st_mtime_ns for path in (tmp_path / "out/stages").glob("*/*/zarr.json")}
    assert len(units) == 4
    code, out, _ = run(capsys, *asked, "--demos", 3, "--dry-run")
    assert (code, "1 of 3 units run (1 demos)" in out) == (0, True)
    code, out, err = run(capsys, *asked, "--demos", 3)
    assert (code, out) == (0, "out\n")
    assert "imported 3 of 3 demos; next: dapdata label out" in err
    assert {path: path.stat().st_mtime_ns for path in units} == units
    assert run(capsys, "import", "rpdiff", source, "--demos", 1, "--dry-run")[1].startswith("data/demos: 1 demos")


@pytest.mark.slow
def test_an_import_that_is_killed_ends_as_one_that_was_not(source: Path, tmp_path: Path) -> None:
    def command(out: str) -> list[str]:
        asked = ["import", "rpdiff", str(source), "--out", str(tmp_path / out), "--workers", "1", "--set", "shard_size=1"]
        return [sys.executable, "-m", "dapdata", *asked]

    subprocess.run(command("whole"), check=True, capture_output=True)
    for delay in (3.0, 4.0, 5.0):
        process = subprocess.Popen(
            command("killed"), start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        time.sleep(delay)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    subprocess.run(command("killed"), check=True, capture_output=True)
    whole, killed = (manifest.read(tmp_path / name) for name in ("whole", "killed"))
    assert killed.content_sha256 == whole.content_sha256
    assert killed.rejects == whole.rejects


# Out again


@pytest.fixture(scope="module")
def exported(imported: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rpdiff.export(imported, tmp_path_factory.mktemp("out") / "chunked", shard_size=2)


def chunks(folder: Path) -> dict[str, Path]:
    """What RPDiff's loader finds: npz files in folders without folders, by their name."""
    return {
        name: Path(root, name)
        for root, folders, files in os.walk(folder)
        if not folders
        for name in files
        if name.endswith(".npz")
    }


def test_an_export_has_what_the_loader_of_rpdiff_reads(imported: Path, exported: Path) -> None:
    """The accesses of its `dataio_full_chunked.py`, in their order."""
    splits = {
        split: np.loadtxt(exported / "split_info" / f"{title}.txt", dtype=str, ndmin=1).tolist()
        for split, title in rpdiff.SPLIT_FILES.items()
    }
    found, data = chunks(exported), loading.open(imported)
    assert len(found) == len({*found})
    assert sorted(name for names in splits.values() for name in names) == sorted(found)
    demos = 0
    for split, names in splits.items():
        expected = [sample for sample, owner in zip(data, data.index["split"]) if owner == split]
        read = [np.load(found[name], allow_pickle=True) for name in names]
        loaded = [chunk[key].item() for chunk in read for key in chunk.files]
        assert len(loaded) == len(expected)
        for demo, sample in zip(loaded, expected):
            demos += 1
            assert demo["success"].item() is True
            parent, child = (demo["multi_obj_final_pcd"].item()[body] for body in ("parent", "child"))
            assert parent.dtype == child.dtype == np.float64
            assert np.allclose(parent[:, 2], sample["container/points"][:, 2] + 1.0)
            final = demo["multi_obj_final_obj_pose"].item()["child"]
            start = demo["multi_obj_start_obj_pose"].item()["child"]
            assert len(final[:3]) == 3
            assert len(final[3:]) == 4
            moved = simulate.from_pose7(final) @ poses.inverse(simulate.from_pose7(start))
            assert np.abs(poses.transform(moved, demo["multi_obj_start_pcd"].item()["child"]) - child).max() < 1e-9
            assert demo["multi_obj_mesh_file"].item()["child"].split("/")[-1].endswith(".obj")
            assert "dec" not in demo["multi_obj_mesh_file"].item()["child"]
            assert (exported / demo["multi_obj_mesh_file"].item()["parent"]).is_file()
            assert demo["multi_obj_part_pose_dict"].item()["parent_part_world"][:-1, -1].shape == (3,)
            assert demo["multi_obj_names"].item()["parent"] == "container"
    assert demos == (data.index["split"] != "unused").sum()


def test_no_file_of_an_export_holds_demos_of_two_splits(imported: Path, exported: Path) -> None:
    data = loading.open(imported)
    total = sum(len(object_arrays.member_names(path)) for path in chunks(exported).values())
    assert total == len(data)
    lists = [(exported / "split_info" / f"{title}.txt").read_text().split() for title in rpdiff.SPLIT_FILES.values()]
    names = [name for members in lists for name in members]
    assert len(names) == len(set(names))


def test_import_export_import_gives_the_same_demos(imported: Path, exported: Path, tmp_path: Path) -> None:
    asked = imports.rpdiff_recipe(exported, None, None, ["seed=4"])
    imports.run(asked, tmp_path / "again", engine="inline")
    pipeline.label(tmp_path / "again", engine="inline")
    data = loading.open(imported)
    order = [i for split in ("train", "val", "test", "unused") for i in np.flatnonzero(data.index["split"] == split)]
    again = list(loading.open(tmp_path / "again"))
    assert len(again) == len(order)
    for sample, number in zip(again, order):
        first = data[number]
        assert sample.keys() == first.keys()
        assert [path for path in sample if not np.array_equal(sample[path], first[path]) and path != "meta/demo"] == []


def test_the_layout_alone_gives_the_same_demo_to_rounding(imported: Path, exported: Path, tmp_path: Path) -> None:
    """Others take our exports without our key: poses, clouds and meshes are enough."""
    (path, *_) = sorted(chunks(exported).values())
    demo = {key: value for key, value in object_arrays.read(path, "0").items() if key != "dapdata"}
    made, cloud = both(save_chunk(tmp_path / "a.npz", [demo]), exported / "meshes", symmetry="box")
    data = loading.open(imported)
    first = data[int(np.flatnonzero(data.index["split"] == "train")[0])]
    assert np.allclose(made.T_world_container, first["pose/T_world_container"], atol=1e-9)
    apart, turned = poses.symmetric_distance(made.T_world_object_goal, first["pose/T_world_object_goal"], "box", np.zeros(3))
    assert apart < 2e-4
    assert turned < 1e-3
    assert len(cloud.container_points) == pytest.approx(len(first["container/points"]), rel=0.02)


def test_a_dataset_that_was_drawn_goes_out_and_comes_in_with_what_the_judge_needs(tiny: Path, tmp_path: Path) -> None:
    rpdiff.export(tiny, tmp_path / "out")
    demo, cloud = both(tmp_path / "out")
    assert isinstance(cloud, Cloud)
    assert all(verdict.success for verdict in simulate.judge(demo, demo.goals, PLACEMENT))
    meshes = sorted((tmp_path / "out/meshes").iterdir())
    assert len(meshes) == 2 * len(loading.open(tiny))
    container = rpdiff_demos.meshes.read_mesh(meshes[0])
    assert len(rpdiff_demos.meshes.pieces(container)) > 5


def test_an_export_is_the_same_bytes_again_and_is_there_whole_or_not_at_all(
    imported: Path, exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    code, out, _ = run(capsys, "export", "rpdiff", imported, "--out", tmp_path / "out", "--shard-size", 2)
    assert (code, out) == (0, f"{tmp_path / 'out'}\n")
    files = {path.relative_to(exported): path.read_bytes() for path in exported.rglob("*") if path.is_file()}
    assert {
        path.relative_to(tmp_path / "out"): path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()
    } == files
    code, _, err = run(capsys, "export", "rpdiff", imported, "--out", tmp_path / "out")
    assert code == 2
    assert "holds an export that differs in options" in err
    monkeypatch.setattr(rpdiff, "_write_meshes", lambda *arguments: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        rpdiff.export(imported, tmp_path / "other", shard_size=2)
    assert not (tmp_path / "other").exists()
    monkeypatch.undo()
    monkeypatch.setattr(rpdiff, "_layout", lambda *arguments: 1 / 0)  # chunks are there already
    rpdiff.export(imported, tmp_path / "other", shard_size=2)
    assert (tmp_path / "other/export.json").read_bytes() == (exported / "export.json").read_bytes()


def test_exporting_what_is_no_labelled_dataset_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, err = run(capsys, "export", "rpdiff", tmp_path / "none", "--out", tmp_path / "out")
    assert code == 2
    assert "no such folder" in err
    assert not (tmp_path / "out").exists()


# What every dataset can do


def test_every_export_holds_the_meshes_or_says_why_not(imported: Path, samples: Samples, tmp_path: Path) -> None:
    """The arrays go along, and scenes are the solids that the judge sees."""
    import pybullet
    import trimesh

    webdataset.export(imported, tmp_path / "tars", shard_size=9)
    with tarfile.open(next((tmp_path / "tars").glob("train-*.tar"))) as tar:
        names = [name for name in tar.getnames() if name.endswith("mesh_faces.vertices.npy")]
        faces = np.load(io.BytesIO(tar.extractfile(names[0]).read()))  # type: ignore[union-attr]
    assert np.array_equal(faces, samples[int(names[0][5:11])]["mesh_faces/vertices"])
    scenes.export(imported, tmp_path / "scenes")
    for folder in (tmp_path / "scenes").glob("*/demo_*"):
        sample = samples[int(folder.name[5:])]
        found = trimesh.load(folder / "scene.glb")
        T_world_part = sample["pose/T_world_container"] @ sample["scene/T_container_part"]
        placed = [poses.transform(T, mesh.vertices) for T, mesh in zip(T_world_part, records.meshes_in(sample)[0]) if mesh]
        name = found.graph["container"][1]
        T_z_up_container = found.graph.get("container", "z_up")[0]
        vertices = poses.transform(T_z_up_container, np.asarray(found.geometry[name].vertices))
        assert np.allclose(np.sort(vertices, axis=0), np.sort(np.concatenate(placed), axis=0), atol=1e-6)
        client = pybullet.connect(pybullet.DIRECT)
        body = pybullet.loadURDF(str(folder / "object.urdf"), physicsClientId=client)
        low, high = pybullet.getAABB(body, physicsClientId=client)
        pybullet.disconnect(client)
        extent = np.ptp(np.concatenate([mesh.vertices for mesh in records.meshes_in(sample)[1] if mesh]), axis=0)
        assert np.array(high) - low == pytest.approx(extent, abs=0.006)


def test_an_open_container_keeps_its_inside_in_a_urdf(tmp_path: Path) -> None:
    import pybullet

    cup = rpdiff_demos.mesh_scenes.cup()
    size, T, mesh = rpdiff_demos.meshes.centred(cup)
    parts = scenes.Parts(np.array([solids.MESH]), size[None], T[None], [mesh])
    link = scenes._link(scenes.Frame("container", "", np.eye(4), parts, "container", collides=True), tmp_path)
    (tmp_path / "a.urdf").write_bytes(scenes._robot("a", [link]))
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.loadURDF(str(tmp_path / "a.urdf"), useFixedBase=True, physicsClientId=client)
    (hit,) = pybullet.rayTest([0, 0, 0.5], [0, 0, -0.1], physicsClientId=client)
    pybullet.disconnect(client)
    assert hit[3][2] == pytest.approx(0.005, abs=1e-3), "the floor of the cup, not a lid"


def test_a_card_of_imported_demos_names_their_source_and_claims_no_licence(imported: Path, source: Path) -> None:
    text = (imported / manifest.CARD).read_text()
    about = json.loads((imported / manifest.CROISSANT).read_bytes())
    assert text.startswith("---\nlicense: other\n")
    assert "\n- imported\n" in text
    assert f"imported from `{source}`, where others made them, by dapdata" in text
    assert "synthetic" not in text
    assert "draws a scene" not in text
    assert "| `mesh_faces/vertices` | i4 |" in text
    assert "license" not in about
    assert "imported" in about["keywords"]
    assert {record["arrays/path"] for record in about["recordSet"][1]["data"]} >= {"mesh_faces/vertices", "goals/kind"}


@pytest.mark.slow
def test_the_description_of_imported_demos_is_valid_croissant(imported: Path) -> None:
    mlc = pytest.importorskip("mlcroissant", reason="needs the extra dev")
    assert mlc.Dataset(jsonld=str(imported / manifest.CROISSANT)).metadata.name == "demos"
