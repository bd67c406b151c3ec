"""Where the container and the object stand on the table: RPDiff's table, shared by the tasks.

The container stands on an arc around a point of the table and faces it; the object starts beside it. World z = 0 is the
table top.

Source: RPDiff's scene generation (`object_scene_procgen_demos.py`), with its table lowered from z = 1 to 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dapdata import solids
from dapdata.config import CoordinateRange, DegreesRange, LengthRange, SceneConfig, key
from dapdata.poses import pose, random_rotation, rotation_about
from dapdata.records import GOAL_KINDS, SYMMETRIES, Rejected, Scene
from dapdata.solids import Part, Vector

Array = NDArray[Any]

ARC_CENTRE = np.array([0.3, 0.0, 0.0])  # m: the point that containers face
START_TRIES = 100  # draws of a start pose before the scene is given up
START_MARGIN = 0.02  # m between the container's footprint and the object's bounding sphere
MAX_PARTS = 2000  # in a scene; hundreds already take seconds a demo
HOVER = 0.0005  # m: candidates are this far above what they stand on, and settle onto it
FRONT, ABOVE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)  # container frame: where containers open


class TabletopConfig(SceneConfig):
    """What all table-top tasks share."""

    yaw_deg: DegreesRange = key((-90.0, 90.0), "where on the arc the container stands; it faces the arc's centre", unit="deg")
    radius: LengthRange = key((0.45, 0.55), "radius of the arc", unit="m")
    start: Literal["upright", "any"] = key("upright", "object's start: upright on the table, or any rotation, held above it")
    start_x: CoordinateRange = key((0.2, 0.65), "start position along world x", unit="m")
    start_y: CoordinateRange = key((-0.6, 0.6), "start position along world y", unit="m")
    start_height: float = key(0.2, "height above the table of a start in any rotation", unit="m", ge=0.05, le=2)
    max_tilt_deg: float = key(15.0, "largest angle from upright that counts as placed", unit="deg", gt=0, le=180)


def expect_room(room: float, needed: float, name: str, what: str) -> None:
    """ValueError if the smallest container that can be drawn has less room (m) along `name` than is needed (m)."""
    if room < needed:
        raise ValueError(f"{name}: got {room:.3g} m of room at the least, expected {needed:.3g} m or more for {what}")


def expect_few(parts: float, names: str) -> None:
    """ValueError if the largest scene that can be drawn has more parts than can be handled."""
    if parts > MAX_PARTS:
        raise ValueError(f"{names}: got room for {parts:.0f} parts at the most, expected up to {MAX_PARTS}; draw larger ones")


@dataclass(frozen=True)
class Candidate:
    """A place in the container where the object might stand."""

    position: tuple[float, float, float]  # m, container frame, of the object's centre
    kind: str  # one of records.GOAL_KINDS
    clearance: float  # m, total free play along the tightest horizontal direction
    rotation: Array | None = None  # (3, 3) of the object's axes; None: they are the container's
    approach: Vector | None = None  # (3,) unit vector out of the place, container frame; None: the container's opening


def build_scene(
    params: TabletopConfig,
    parts: Sequence[Part],
    object_parts: Sequence[Part],
    candidates: Sequence[Candidate],
    symmetry: str,
    rng: np.random.Generator,
    *,
    opening: Vector = FRONT,
    axis: Vector = (0.0, 0.0, 1.0),
) -> Scene | Rejected:
    """The scene with container and object put on the table; the container's +x looks at the middle of it.

    Args:
        params: The task's parameters.
        parts: Container and clutter, container frame.
        object_parts: The object, in its own frame: origin at its bounding box's centre, z up at a goal (of what
            hangs: when it stands).
        candidates: Every place where the object might stand; none makes the scene Rejected("no_free_slot").
        symmetry: One of records.SYMMETRIES.
        rng: Draws the poses.
        opening: (3,) unit vector out of the container, container frame.
        axis: (3,) axis of a revolution, object frame.
    """
    if not candidates:
        return Rejected("no_free_slot")
    kind, size, T, role = solids.collect(parts)
    object_kind, object_size, T_object_part, _ = solids.collect(object_parts)
    T_world_container = _container_pose(params, rng)
    footprint = solids.bounds(kind, size, T)[role == solids.CONTAINER][:, :, :2]
    extent = solids.bounds(object_kind, object_size, T_object_part)
    half = np.maximum(-extent[:, 0].min(axis=0), extent[:, 1].max(axis=0))
    start = _start_pose(params, half, T_world_container, footprint, rng)
    if start is None:
        return Rejected("no_room_for_start")
    return Scene(
        part_kind=kind,
        part_size=size,
        T_container_part=T,
        part_role=role,
        object_kind=object_kind,
        object_size=object_size,
        T_object_part=T_object_part,
        T_container_goal=np.stack([pose(candidate.rotation, candidate.position) for candidate in candidates]),
        goal_kind=np.array([GOAL_KINDS.index(candidate.kind) for candidate in candidates], np.uint8),
        goal_clearance=np.array([candidate.clearance for candidate in candidates]),
        goal_approach=np.array([opening if c.approach is None else c.approach for c in candidates], np.float64),
        opening=np.array(opening, np.float64),
        max_tilt=float(np.radians(params.max_tilt_deg)),
        symmetry_kind=SYMMETRIES.index(symmetry),
        symmetry_axis=np.array(axis, np.float64),
        T_world_container=T_world_container,
        T_world_object_start=start,
        container_instance=solids.digest(kind, size, T),
        object_instance=solids.digest(object_kind, object_size, T_object_part),
    )


def _container_pose(params: TabletopConfig, rng: np.random.Generator) -> Array:
    """T_world_container on the arc, turned so that its +x looks at the arc's centre."""
    angle, radius = np.radians(rng.uniform(*params.yaw_deg)), rng.uniform(*params.radius)
    position = ARC_CENTRE + radius * np.array([np.cos(angle), np.sin(angle), 0])
    return pose(rotation_about((0, 0, 1), angle + np.pi), position)


def _start_pose(
    params: TabletopConfig, half: Array, T_world_container: Array, footprint: Array, rng: np.random.Generator
) -> Array | None:
    """T_world_object_start beside the container, or None if no draw was.

    Args:
        params: Ranges of the position.
        half: (3,) half extents of the object, m.
        T_world_container: (4, 4) pose of the container.
        footprint: (P, 2, 2) low and high corner in plan of the container's parts, container frame, m.
        rng: Draws the pose.
    """
    low, high = footprint[:, 0].min(axis=0), footprint[:, 1].max(axis=0)
    is_upright = params.start == "upright"
    reach = float(np.linalg.norm(half[:2] if is_upright else half)) + START_MARGIN
    for _ in range(START_TRIES):
        position = np.array(
            [rng.uniform(*params.start_x), rng.uniform(*params.start_y), half[2] if is_upright else params.start_height]
        )
        in_plan = ((position - T_world_container[:3, 3]) @ T_world_container[:3, :3])[:2]
        if np.linalg.norm(in_plan - np.clip(in_plan, low, high)) >= reach:
            rotation = rotation_about((0, 0, 1), rng.uniform(-np.pi, np.pi)) if is_upright else random_rotation(rng)
            return pose(rotation, position)
    return None
