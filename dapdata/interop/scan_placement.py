"""From scans before and after to a demonstration: where the object was placed, or why that cannot be told.

The container's motion on the table is told first, then the object's in the world; together they say where the object went in
the container as it stood before. Whatever explains too little, or is not the only explanation, is rejected with its figure.

A scan tells no shapes: a demo has no parts, one goal, and no physics. Its object frame has its origin in the middle of what was
seen (of a revolution, on the axis).
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from hashlib import sha256
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import registration, solids
from dapdata.config import ScansConfig
from dapdata.interop.rpdiff_files import Fault
from dapdata.interop.scan_clouds import Prepared, prepare
from dapdata.interop.scan_files import STAGES, Scan, read, rejected
from dapdata.poses import angle_between, inverse, nearest_symmetric, pose, rotation_about, transform, upright_turn
from dapdata.records import GOAL_KINDS, SYMMETRIES, MeshDemo, Meshes, Rejected, pack_meshes
from dapdata.registration import Fit, Surface
from dapdata.simulate import PlacementConfig

Array = NDArray[Any]

CONTAINER_SPACING = 0.006  # m
SPACINGS, LEAST_SPACING = 30, 0.003  # of the object's points: so many in its length, but no closer than that, m
LEAST_POINTS = 60  # of an object before and after: fewer tell no turn
STILL = 0.004  # m: a container whose points moved less stood still; what is seen of that is the cameras' noise
NEAR = 0.03  # m: an object beside the container that is no farther from it, as on a hook, was placed; contact itself is hidden
MARGIN = 0.01  # m: around the container's bounding box


@dataclass(frozen=True)
class Placed:
    """What registration told. Motions are from before to after."""

    container: Fit
    object: Fit
    surface: Surface  # of the object, before: all that was seen of it in either scan
    T_before_after: Array  # (4, 4) the container's motion undone


def demonstrate(config: ScansConfig, placement: PlacementConfig, demo: int) -> MeshDemo | Rejected:
    """Demonstration number `demo` of the source, with the one goal that was shown."""
    try:
        scan = read(config, demo)
        prepared = prepare(scan, config)
        return _demo(scan, prepared, place(scan, prepared, config))
    except Fault as fault:
        return rejected(config, demo, fault)


def place(scan: Scan, prepared: Prepared, config: ScansConfig) -> Placed:
    """How container and object moved.

    Raises:
        Fault: that cannot be told.
    """
    before, after = (_surface(prepared, stage, "container", CONTAINER_SPACING) for stage in STAGES)
    points = np.concatenate([points for points, _ in prepared.views["start", "object"]])
    extent = float(np.ptp(np.quantile(points, [0.02, 0.98], axis=0), axis=0).max())
    spacing = max(LEAST_SPACING, extent / SPACINGS)
    start, end = (_surface(prepared, stage, "object", spacing) for stage in STAGES)
    for stage, surface in zip(STAGES, (start, end)):
        if len(surface.points) < LEAST_POINTS:
            raise Fault("does_not_fit", f"{stage}, object: {len(surface.points)} points, expected {LEAST_POINTS} or more")
    _check_order((before, after), (start, end))
    container = _container_motion(before, after, config)
    fit, surface = _object_motion(start, end, spacing, config)
    return Placed(container, fit, surface, inverse(container.T))


def _object_motion(before: Surface, after: Surface, spacing: float, config: ScansConfig) -> tuple[Fit, Surface]:
    """How the object moved in the world, and all that was seen of it, as it stood before.

    Of motions that bring its surface to the same place, as of a ball, it is the one that turns least.
    """
    found = registration.register(before, after, spacing, registration.turns_all())
    best = found[0]
    told = f"the object before explains {best.explained_after:.2f} of it after, and is explained to {best.explained_before:.2f}"
    if best.explained_after < config.min_explained or best.explained_before < config.min_overlap:
        raise Fault(
            "does_not_fit",
            f"{told} (rms {best.rms * 1000:.1f} mm), expected {config.min_explained} and {config.min_overlap} or more; "
            "scan it from more sides",
        )
    surface = before.with_points_of(after.moved(inverse(best.T)))
    rivals = registration.as_good(found)
    gaps = np.array([registration.surface_gap(fit.T, best.T, surface.points) for fit in rivals])
    elsewhere = gaps > registration.EXPLAINED * spacing
    if elsewhere.any():
        raise Fault(
            "ambiguous",
            f"{told}, and as well by {elsewhere.sum()} other motions, up to {gaps.max() * 1000:.0f} mm away, expected one; "
            "scan it from more sides",
        )
    return min(rivals, key=lambda fit: float(angle_between(fit.T[:3, :3], np.eye(3)))), surface


def _surface(prepared: Prepared, stage: str, body: str, spacing: float) -> Surface:
    fused = prepared.fused(stage, body, spacing)
    return Surface(fused.points.astype(float), fused.normals.astype(float))


def _check_order(containers: tuple[Surface, Surface], objects: tuple[Surface, Surface]) -> None:
    """Whether the object came to the container; each before and after."""
    gaps = [float(container.tree.query(thing.points)[0].min()) for container, thing in zip(containers, objects)]
    inside = [_is_over(container.points, thing.points) for container, thing in zip(containers, objects)]
    if inside[0] and not inside[1]:
        raise Fault(
            "start_and_end_swapped",
            f"the object is in the container in the start and {gaps[1] * 100:.0f} cm from it in the end, expected the reverse",
        )
    if gaps[1] > NEAR and not inside[1]:
        raise Fault(
            "not_placed",
            f"in the end the object is {gaps[1] * 100:.1f} cm from the container, expected {NEAR * 100:.0f} cm at the most",
        )


def _is_over(container: Array, thing: Array) -> bool:
    """Whether the middle of a cloud is inside the other's bounding box, in plan."""
    middle = (thing.min(axis=0) + thing.max(axis=0))[:2] / 2
    low, high = container.min(axis=0)[:2] - MARGIN, container.max(axis=0)[:2] + MARGIN
    return bool(((middle > low) & (middle < high)).all())


def _container_motion(before: Surface, after: Surface, config: ScansConfig) -> Fit:
    """How the container moved on the table: not at all, if what is seen of it could be noise."""
    fit = registration.polish(before, after, np.eye(4), CONTAINER_SPACING)
    if fit.explained_after < config.min_container:
        fit = registration.register(before, after, CONTAINER_SPACING, registration.turns_upright())[0]
    if fit.explained_after < config.min_container:
        raise Fault(
            "container_does_not_fit",
            f"the container before explains {fit.explained_after:.2f} of it after (rms {fit.rms * 1000:.1f} mm), expected "
            f"{config.min_container} or more",
        )
    moved = np.linalg.norm(transform(fit.T, before.points) - before.points, axis=1).max()
    return Fit(np.eye(4), *list(vars(fit).values())[1:]) if moved < STILL else fit


# The demonstration -----------------------------------------------------------------------------------------


def _demo(scan: Scan, prepared: Prepared, placed: Placed) -> MeshDemo:
    """The demo of a placement that was told."""
    T_world_container = _container_pose(scan, prepared)
    T_start, T_goal, axis = _object_poses(scan, placed)
    opening = T_world_container[:3, :3].T @ scan.opening
    no_meshes, no_kinds, no_sizes, no_poses = pack_meshes([]), np.zeros(0, np.uint8), np.zeros((0, 3)), np.zeros((0, 4, 4))
    return MeshDemo(
        **{field.name: getattr(no_meshes, field.name) for field in fields(Meshes)},
        T_world_container=T_world_container,
        T_world_object_start=T_start,
        T_world_object_goal=T_goal,
        goals=T_goal[None],
        goal_kind=np.array([GOAL_KINDS.index("shown")], np.uint8),
        goal_clearance=np.array([solids.UNBOUNDED]),
        goal_approach=opening[None],
        rejected_goals=no_poses,
        rejected_reason=no_kinds,
        symmetry_kind=np.array(SYMMETRIES.index(scan.about.symmetry), np.uint8),
        symmetry_axis=axis,
        part_kind=no_kinds,
        part_size=no_sizes,
        T_container_part=no_poses,
        part_role=no_kinds,
        opening=opening,
        max_tilt=np.array(np.pi),
        object_kind=no_kinds,
        object_size=no_sizes,
        T_object_part=no_poses,
        demo=np.array(0),
        seed=np.array(0),
        container_instance=np.array(_instance(scan, "container")),
        object_instance=np.array(_instance(scan, "object")),
        attempts=np.array(1),
        task=np.array(0, np.uint8),
    )


def _instance(scan: Scan, body: str) -> int:
    """What tells one container or object from another: its name; without a name, each demonstration has its own."""
    name = getattr(scan.about, body) or f"{body} of {scan.folder.name}"
    return int.from_bytes(sha256(name.encode()).digest()[:8], "little") >> 1


def _container_pose(scan: Scan, prepared: Prepared) -> Array:
    """(4, 4) origin at the middle of the footprint on the table, z up, x along the opening if that is not vertical."""
    x = scan.opening[:2]
    yaw = float(np.arctan2(x[1], x[0])) if np.linalg.norm(x) > 0.1 else 0.0
    R = rotation_about((0, 0, 1), yaw)
    local = np.concatenate([points for points, _ in prepared.views["start", "container"]]) @ R
    middle = (local.min(axis=0) + local.max(axis=0)) / 2
    return pose(R, R @ [middle[0], middle[1], 0])


def _object_poses(scan: Scan, placed: Placed) -> tuple[Array, Array, Array]:
    """T_world_object before and after, (4, 4), and the axis of a revolution in the object's frame (3,).

    Of symmetric copies of the goal it is the one that turns least.
    """
    surface, kind = placed.surface, scan.about.symmetry
    R = rotation_about((0, 0, 1), _yaw_of_box(surface.points)) if kind == "box" else np.eye(3)
    local = surface.points @ R
    middle = R @ ((local.min(axis=0) + local.max(axis=0)) / 2)
    if kind == "revolution":
        middle = _onto_axis(middle, surface, scan.axis)
    T_start = pose(R, middle)
    T_goal = placed.T_before_after @ placed.object.T @ T_start
    axis = R.T @ scan.axis
    T_goal = nearest_symmetric(T_goal, pose(R, T_goal[:3, 3]), kind, axis)
    turn = upright_turn(T_goal[:3, :3])
    return T_start @ pose(turn), T_goal @ pose(turn), turn.T @ axis


def _yaw_of_box(points: Array) -> float:
    """rad, of the smallest rectangle around (N, 3) points in plan."""
    from scipy.spatial import ConvexHull

    hull = points[ConvexHull(points[:, :2]).vertices, :2]
    edges = np.diff(np.concatenate([hull, hull[:1]]), axis=0)
    yaws = np.arctan2(edges[:, 1], edges[:, 0]) % (np.pi / 2)
    areas = [np.prod(np.ptp(hull @ rotation_about((0, 0, 1), yaw)[:2, :2], axis=0)) for yaw in yaws]
    return float(yaws[int(np.argmin(areas))])


def _onto_axis(point: Array, surface: Surface, axis: Array) -> Array:
    """The point moved square to an axis until that is the axis of revolution of a surface: all normals meet it."""
    across = np.cross(axis, surface.normals)
    beside = across @ np.linalg.svd(axis[None])[2][1:].T  # (N, 2) in two directions square to the axis
    offset = np.einsum("ij,ij->i", surface.points - point, across)
    step = np.linalg.lstsq(beside, offset, rcond=None)[0]
    return np.asarray(point + step @ np.linalg.svd(axis[None])[2][1:])
