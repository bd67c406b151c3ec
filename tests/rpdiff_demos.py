"""Demonstrations in RPDiff's layout, tiny and made here: a shelf with books, a table of cans, as its generator stores them.

Images are seen through the centres of pixels and projected back through their corners, as RPDiff does.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import mesh_scenes
import numpy as np

from dapdata import meshes
from dapdata.observe.cameras import look_at
from dapdata.observe.raycast import cast
from dapdata.poses import inverse, pose, rotation_about, transform
from dapdata.records import Mesh
from dapdata.simulate import to_pose7
from dapdata.solids import Part, box, collect, cylinder, to_trimesh

TABLE = 1.0  # m
FLOOR = 0.006  # m, top of the shelf's floor
BOOK = np.array([0.18, 0.24, 0.04])  # m: depth, height, thickness, along x, y, z of its mesh
CAN = (0.025, 0.08)  # m: radius, height
SLOTS = (-0.1, 0.0, 0.2)  # m: where along y the shelf has room
FULL = (-0.2, -0.05, 0.05, 0.1, 0.15)  # m: where books stand
CAN_SLOTS = ((0.0, -0.1, FLOOR + 0.07), (0.0, 0.1, FLOOR))  # m: on the can, and on the floor
UP = rotation_about((1, 0, 0), np.pi / 2)  # of a book that stands
ABOVE = np.array([0.01, 0, 0.01])  # m: RPDiff puts things down from here
T_WORLD_CONTAINER = pose(rotation_about((0, 0, 1), 2.8), (0.7, 0.1, TABLE))
K = np.array([[110.0, 0, 80], [0, 110, 60], [0, 0, 1]])


def shelf(number: int = 0) -> list[Part]:
    """A shelf with books; the walls of each number are of another height."""
    height = 0.27 + number / 500
    return [
        box((0.2, 0.5, FLOOR), (0, 0, FLOOR / 2)),
        box((0.004, 0.5, height), (-0.102, 0, height / 2)),
        *(box((0.2, 0.004, height), (0, y, height / 2)) for y in (-0.252, 0.252)),
        *(box((0.18, 0.04, 0.24), (-0.005, y, FLOOR + 0.12)) for y in FULL),
    ]


def cabinet(number: int = 0) -> list[Part]:
    """A floor and a wall with a can."""
    height = 0.2 + number / 500
    wall = box((0.004, 0.4, height), (-0.102, 0, height / 2))
    return [box((0.2, 0.4, FLOOR), (0, 0, FLOOR / 2)), wall, cylinder(0.03, 0.07, (0.0, -0.1, FLOOR + 0.035))]


def book(number: int = 0) -> list[Part]:
    return [box(BOOK + np.array([number / 500, 0, 0]), (0, 0, 0))]


def can(number: int = 0) -> list[Part]:
    return [cylinder(CAN[0] + number / 5000, CAN[1], (0, 0, 0))]


def book_demo(slot: int = 1, number: int = 0) -> dict[str, Any]:
    """A book for one of the free slots, as the current layout has it."""
    place = np.array([0, SLOTS[slot], FLOOR + BOOK[1] / 2]) + ABOVE
    start = pose(rotation_about((1, 2, 3), 0.8), (0.3, -0.2, TABLE + 0.2))
    return made("syn_book", "syn_bookshelf", shelf(number), book(number), start, pose(UP, place), number)


def can_demo(slot: int = 0, number: int = 0) -> dict[str, Any]:
    """A can for one of the free places."""
    place = np.add(CAN_SLOTS[slot], [0, 0, CAN[1] / 2 + 0.011])
    start = pose(rotation_about((0, 0, 1), 0.5), (0.3, -0.2, TABLE + CAN[1] / 2))
    return made("syn_can", "syn_can_cabinet", cabinet(number), can(number), start, pose(None, place), number)


def made(
    child: str, parent: str, container: list[Part], thing: list[Part], T_start: np.ndarray, T_goal: np.ndarray, number: int
) -> dict[str, Any]:
    """The fields of a demo; T_goal in the frame of the container, as commanded."""
    T_final = T_WORLD_CONTAINER @ T_goal
    focus = T_WORLD_CONTAINER[:3, 3] + [0, 0, 0.12]
    yaw = np.degrees(2.8)
    views = [
        (focus, yaw - 25, 10, 0.8),
        (focus, yaw + 25, 10, 0.8),
        (T_start[:3, 3], 120, 35, 0.5),
        (T_start[:3, 3], -40, 35, 0.5),
    ]
    cameras = np.stack([look_at(*view) for view in views])
    clouds = [seen(container, T_WORLD_CONTAINER, cameras), seen(thing, T_start, cameras)]
    moved = transform(T_final @ inverse(T_start), clouds[1])
    start, final, at = to_pose7(T_start), to_pose7(T_final), to_pose7(T_WORLD_CONTAINER)
    paths = [f"/rpdiff/descriptions/objects/{folder}_obj/{folder}_{number}.obj" for folder in (parent, child)]
    nothing = {"parent": None, "child": None}
    return {
        "success": True,
        "multi_obj_names": {"parent": parent, "child": child},
        "multi_obj_start_pcd": {"parent": clouds[0], "child": clouds[1]},
        "multi_obj_final_pcd": {"parent": clouds[0].copy(), "child": moved},
        "grasp_pose_world": nothing,
        "pcd_pts": None,
        "cam_intrinsics": np.tile(K, (len(cameras), 1, 1)),
        "cam_poses": cameras,
        "multi_object_ids": {"parent": [f"{parent}_{number}"], "child": [f"{child}_{number}"]},
        "placement_object_idx": {"parent": 0, "child": 0},
        "real_sim": "sim",
        "multi_obj_start_obj_pose": {"parent": [at], "child": [start]},
        "multi_obj_final_obj_pose": {"parent": [at], "child": [final]},
        "multi_obj_mesh_file": {"parent": paths[:1], "child": paths[1:]},
        "multi_obj_mesh_file_dec": {"parent": paths[:1], "child": [paths[1].replace(".obj", "_dec.obj")]},
        "multi_obj_part_pose_dict": dict.fromkeys(("parent_part_world", "child_part_world", "child_part_parent"), np.eye(4)),
    }


def seen(parts: list[Part], T_world: np.ndarray, cameras: np.ndarray) -> np.ndarray:
    """(N, 3) the points of all cameras, one camera after the other."""
    kind, size, T, _ = collect(parts)
    clouds = []
    for T_world_camera in cameras:
        depth = cast(kind, size, inverse(T_world_camera) @ T_world @ T, K, 160, 120).depth.astype(float)
        v, u = np.nonzero(depth)
        z = depth[v, u]
        clouds.append(transform(T_world_camera, np.stack([(u - 80) / 110 * z, (v - 60) / 110 * z, z], axis=1)))
    return np.concatenate(clouds)


def legacy(demo: dict[str, Any]) -> dict[str, Any]:
    """The same in the legacy layout: texts and poses instead of lists of them."""
    old = {key: value for key, value in demo.items() if key != "placement_object_idx"}
    for key in old:
        if key.endswith(("_pose", "_ids", "_file", "_dec")) and key != "grasp_pose_world":
            old[key] = {body: value[0] for body, value in old[key].items()}
    return old


def changed(demo: dict[str, Any], **fields: Any) -> dict[str, Any]:
    """A copy with other fields; None takes one away."""
    other = copy.deepcopy({**demo, **fields})
    return {key: value for key, value in other.items() if key not in fields or fields[key] is not None}


def save(path: Path, demo: dict[str, Any]) -> Path:
    """One demo, as RPDiff's generator writes it: whatever is no array becomes an array of an object."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **demo)
    return path


def save_chunk(path: Path, demos: list[dict[str, Any]]) -> Path:
    """Several demos in a file, each a dict of arrays, as its merging script writes them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **{str(i): {key: np.array(value) for key, value in demo.items()} for i, demo in enumerate(demos)})
    return path


def save_meshes(folder: Path, numbers: tuple[int, ...] = (0,)) -> Path:
    """The meshes and slot files of the demos with these numbers, in folders as RPDiff's."""
    for number in numbers:
        write(folder, f"syn_bookshelf_obj/syn_bookshelf_{number}.obj", as_meshes(shelf(number)))
        write(folder, f"syn_can_cabinet_obj/syn_can_cabinet_{number}.obj", as_meshes(cabinet(number)))
        write(folder, f"syn_book_obj/syn_book_{number}.obj", as_meshes([box(0.99 * BOOK, (0, 0, 0))]))
        write(folder, f"syn_book_obj/syn_book_{number}_dec.obj", as_meshes(book(number)))
        write(folder, f"syn_can_obj/syn_can_{number}.obj", as_meshes(can(number)))
        slots = [to_pose7(pose(UP, (0, y, FLOOR + BOOK[1] / 2))) for y in (*SLOTS, SLOTS[0], FULL[0])]
        path = folder / f"syn_bookshelf_obj/open_slot_poses/syn_bookshelf_{number}_open_slot_poses.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savetxt(path, slots)
        surfaces = [{"pose": pose(None, at), "dims": {"r": 0.03, "h": 0.07}} for at in CAN_SLOTS]
        path = folder / f"syn_can_cabinet_obj/open_slot_poses/syn_can_cabinet_{number}_open_slot_poses.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, avail_top_poses=np.array(surfaces, dtype=object))
    return folder


def as_meshes(parts: list[Part]) -> list[Mesh]:
    kind, size, T, _ = collect(parts)
    return [mesh_scenes.as_mesh(to_trimesh(kind[p : p + 1], size[p : p + 1], T[p : p + 1], 32)) for p in range(len(parts))]


def write(folder: Path, name: str, parts: list[Mesh]) -> None:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(meshes.to_obj(parts))
