"""A hand-made demonstration: a two-storey shelf with books and cans, and a book or can to place."""

from __future__ import annotations

import numpy as np

from dapdata.poses import pose, rotation_about
from dapdata.records import Demo

BOX, CYLINDER = 0, 1
DEPTH, WIDTH, PITCH, BOARD, WALL = 0.2, 0.6, 0.28, 0.006, 0.005


def shelf_demo(seed: int = 0, thing: str = "book", shift: tuple[float, float, float] = (0, 0, 0)) -> Demo:
    """A shelf that opens along +x with clutter of both kinds; the goal is the empty middle of the lower floor."""
    rng = np.random.default_rng(seed)
    parts = _boards()
    size = np.array([0.18, 0.04, 0.24] if thing == "book" else [0.06, 0.06, 0.09])
    for floor in (BOARD, PITCH + BOARD):
        y = -WIDTH / 2 + 0.03
        while y < -0.09:
            parts.append((BOX, (0.18, 0.04, 0.24), (0, y + 0.02, floor + 0.12)))
            y += 0.04 + rng.uniform(0.004, 0.03)
        y = 0.07
        while y < WIDTH / 2 - 0.07:
            radius, height = rng.uniform(0.02, 0.033), rng.uniform(0.05, 0.1)
            parts.append(
                (CYLINDER, (2 * radius, 2 * radius, height), (rng.uniform(-0.03, 0.05), y + radius, floor + height / 2))
            )
            y += 2 * radius + rng.uniform(0.005, 0.02)
    T_world_container = pose(rotation_about((0, 0, 1), rng.uniform(-np.pi, np.pi)), np.array([0.1, 0.2, 0]) + shift)
    goal = T_world_container @ pose(None, (0.0, 0.0, BOARD + size[2] / 2))
    start = pose(rotation_about((0, 0, 1), rng.uniform(-np.pi, np.pi)), np.array([0.5, -0.4, size[2] / 2]) + shift)
    return make_demo(parts, [(BOX if thing == "book" else CYLINDER, tuple(size), (0, 0, 0))], T_world_container, start, goal)


def make_demo(parts, object_parts, T_world_container, T_world_object_start, T_world_object_goal) -> Demo:
    """A Demo of unturned parts (kind, full extents, centre) with one goal."""
    kind, size, T = _arrays(parts)
    object_kind, object_size, T_object_part = _arrays(object_parts)
    return Demo(
        T_world_container=T_world_container,
        T_world_object_start=T_world_object_start,
        T_world_object_goal=T_world_object_goal,
        goals=T_world_object_goal[None],
        goal_kind=np.zeros(1, np.uint8),
        goal_clearance=np.zeros(1),
        rejected_goals=np.zeros((0, 4, 4)),
        rejected_reason=np.zeros(0, np.uint8),
        symmetry_kind=np.array(0, np.uint8),
        symmetry_axis=np.array([0.0, 0, 1]),
        part_kind=kind,
        part_size=size,
        T_container_part=T,
        part_role=np.zeros(len(kind), np.uint8),
        opening=np.array([1.0, 0, 0]),
        max_tilt=np.array(0.26),
        object_kind=object_kind,
        object_size=object_size,
        T_object_part=T_object_part,
        demo=np.array(0),
        seed=np.array(0),
        container_instance=np.array(0),
        object_instance=np.array(0),
        attempts=np.array(0),
    )


def _boards():
    parts = [(BOX, (DEPTH, WIDTH, BOARD), (0, 0, level * PITCH + BOARD / 2)) for level in range(3)]
    parts += [(BOX, (DEPTH, WALL, 2 * PITCH), (0, side * (WIDTH - WALL) / 2, PITCH)) for side in (-1, 1)]
    return [*parts, (BOX, (BOARD, WIDTH, 2 * PITCH), (-(DEPTH - BOARD) / 2, 0, PITCH))]


def _arrays(parts):
    kind = np.array([part[0] for part in parts], np.uint8)
    size = np.array([part[1] for part in parts], float)
    return kind, size, np.stack([pose(None, part[2]) for part in parts])
