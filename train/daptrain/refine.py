"""Candidate poses made exact, and put in order, by geometry on the observed cloud; no ground truth, no learning.

A candidate is the pose `T_world_box` of the fitted box or cylinder (`fit.ObjectFit`). A method that predicts a motion
of the observed object multiplies: `T_world_box = T_motion @ fit.T_world_box`.

Three facts carry this file. Objects stand upright and square to the container, so tilt and turn can be snapped. They
come in through the opening, so the volume swept on the way in must be free of points as well as the object's own. They
rest on something, so there must be points under the footprint. All of it happens in the container's front frame: x out
of the opening, z up.

Source: the collision count is DAP's ranking (points inside the object's oriented box). The swept volume and the support
were added because collision count alone likes empty air and blocked places.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata.poses import inverse, rotation_about
from daptrain.fit import ContainerFit, ObjectFit, fit_container

Array = NDArray[Any]

STEPS = ("gravity", "yaw", "settle", "search")  # of refine, in this order; each can be left out
CRITERIA = ("inside", "path", "support", "residual")  # of rank; each can be left out

REACH = 0.016  # m: how far the search may shift a candidate sideways
GRID = 0.002  # m: spacing of the search
MARGIN = 0.001  # m: free space wanted around the object, so that it ends in the middle of a gap
FLOOR = 0.005  # m: points this little above the underside are what it stands on, not in its way
NOISE = 0.002  # m: rank overlooks points that are no deeper than this
DEPTH_CAP = 0.01  # m: a point further inside counts no more than this
SHIFT_COST = np.array([10.0, 6.0])  # of 1 cm of shift along x and y, in points that are 1 cm inside; out is the easy way
SETTLE_DOWN, SETTLE_UP = 0.06, 0.04  # m below and above the underside in which support is looked for
LEVEL = 0.004  # m: points of one support lie within this of its height
FOOTPRINTS = (-0.002, 0.01, 0.025)  # m: the footprint is grown by these, one after the other, until support is found
SUPPORT_POINTS = 3  # fewer points under the footprint are no support


@dataclass(frozen=True)
class ObservedScene:
    """A container's cloud in its own front frame (x out of the opening, z up)."""

    points: Array  # (N, 3) f8, front frame, m
    up: Array  # (N,) bool, the normal points up: a point that can support
    container: ContainerFit


def observed_scene(points: Array, normals: Array) -> ObservedScene:
    """The scene that refine and rank work on.

    Args:
        points: (N, 3) observed points of the container and what stands in it, world frame, m.
        normals: (N, 3) unit, towards the sensor.
    """
    container = fit_container(points, normals)
    R = container.T_world_front[:3, :3]
    return ObservedScene(np.asarray(points, float) @ R, np.asarray(normals, float)[:, 2] > 0.5, container)


def refine(T_world_box: Array, scene: ObservedScene, fit: ObjectFit, steps: Collection[str] = STEPS) -> Array:
    """Candidates after snapping, settling and a small search for free space.

    Args:
        T_world_box: (K, 4, 4) candidate poses of the fitted object.
        scene: From `observed_scene`.
        fit: From `fit.fit_object`.
        steps: Which of STEPS to do: gravity (the upright axis becomes vertical), yaw (a box turns square to the
            container), settle (down or up onto the points under it), search (sideways, out of points that are in it or
            in its way).

    Returns:
        (K, 4, 4) poses; candidates that are not finite come back as they are.

    Raises:
        ValueError: a step that is not in STEPS.
    """
    if unknown := set(steps) - set(STEPS):
        raise ValueError(f"steps: got {sorted(unknown)}, expected some of {STEPS}")
    T = inverse(scene.container.T_world_front) @ np.asarray(T_world_box, float)
    good = np.isfinite(T).all(axis=(1, 2))
    for k in np.flatnonzero(good):
        if "gravity" in steps:
            T[k, :3, :3] = _upright(T[k, :3, :3], fit)
        if "yaw" in steps and fit.shape == "box":
            T[k, :3, :3] = _square(T[k, :3, :3])
        if "settle" in steps:
            T[k, 2, 3] += _settle(T[k], scene, fit)
        if "search" in steps:
            T[k, :2, 3] += _search(T[k], scene, fit)
            if "settle" in steps:  # on another spot it may stand on something else
                T[k, 2, 3] += _settle(T[k], scene, fit)
    out = np.asarray(T_world_box, float).copy()
    out[good] = scene.container.T_world_front @ T[good]
    return out


def rank(
    T_world_box: Array,
    scene: ObservedScene,
    fit: ObjectFit,
    residual: Array | None = None,
    criteria: Collection[str] = CRITERIA,
) -> Array:
    """Scores of candidates, larger is better: inside the container, a free way in, something to stand on.

    Args:
        T_world_box: (K, 4, 4) candidate poses of the fitted object, as `refine` returns them.
        scene: From `observed_scene`.
        fit: From `fit.fit_object`.
        residual: (K,) m, how badly the pose solver's correspondences agree, when there is a solver.
        criteria: Which of CRITERIA count.

    Returns:
        (K,) scores; -inf for candidates that are not finite.
    """
    if unknown := set(criteria) - set(CRITERIA):
        raise ValueError(f"criteria: got {sorted(unknown)}, expected some of {CRITERIA}")
    T = inverse(scene.container.T_world_front) @ np.asarray(T_world_box, float)
    scores = np.full(len(T), -np.inf)
    for k in np.flatnonzero(np.isfinite(T).all(axis=(1, 2))):
        cost = 0.0
        if "inside" in criteria:
            centre = T[k, :3, 3]
            cost += 100.0 * float(((centre < scene.container.low) | (centre > scene.container.high)).any())
        if "path" in criteria:
            path = float(_path_cost(T[k], scene, fit, np.zeros((1, 2)), margin=-NOISE)[0])
            cost += path + 10.0 * (path > 2.0)
        if "support" in criteria:
            missing = SUPPORT_POINTS - min(SUPPORT_POINTS, _support_count(T[k], scene, fit))
            cost += 5.0 * missing / SUPPORT_POINTS
        if "residual" in criteria and residual is not None:
            cost += float(residual[k]) * 100
        scores[k] = -cost
    return scores


def rank_collision_count(T_world_box: Array, points: Array, fit: ObjectFit) -> Array:
    """(K,) scores: minus the number of container points inside the object's oriented box.

    Args:
        T_world_box: (K, 4, 4) candidate poses of the fitted object.
        points: (N, 3) container points, world frame, m.
        fit: From `fit.fit_object`; only the size is used.

    Source: DAP's ranking of candidates.
    """
    points = np.asarray(points, float)
    scores = np.full(len(T_world_box), -np.inf)
    for k, T in enumerate(np.asarray(T_world_box, float)):
        if np.isfinite(T).all():
            local = (points - T[:3, 3]) @ T[:3, :3]
            scores[k] = -float((np.abs(local) <= fit.size / 2).all(axis=1).sum())
    return scores


def half_extents(R: Array, fit: ObjectFit) -> Array:
    """(3,) half sizes of the fitted object along the axes of the frame that R maps to, m."""
    if fit.shape == "box":
        return np.asarray(np.abs(R) @ fit.size / 2)
    axis = R[:, 2]
    return np.asarray(np.abs(axis) * fit.size[2] / 2 + np.sqrt(np.maximum(1 - axis**2, 0)) * fit.size[0] / 2)


def _upright(R: Array, fit: ObjectFit) -> Array:
    """The rotation turned the shortest way until the axis nearest to vertical (a cylinder's own) is vertical."""
    column = 2 if fit.shape == "cylinder" else int(np.argmax(np.abs(R[2])))
    axis = R[:, column]
    up = np.array([0.0, 0.0, 1.0 if axis[2] >= 0 else -1.0])
    turn = np.cross(axis, up)
    sine = np.linalg.norm(turn)
    return R if sine < 1e-12 else rotation_about(turn, float(np.arctan2(sine, axis @ up))) @ R


def _square(R: Array) -> Array:
    """The rotation turned about z until its most level axis lies along x or y."""
    level = R[:, int(np.argmin(np.abs(R[2])))]
    angle = np.arctan2(level[1], level[0])
    return rotation_about((0, 0, 1), float(np.round(angle / (np.pi / 2)) * np.pi / 2 - angle)) @ R


def _settle(T: Array, scene: ObservedScene, fit: ObjectFit) -> float:
    """How far to move (m, up is positive) so that the underside stands on the points under it; 0 without any.

    Of the levels within reach the one with the most points wins, a near one before a far one of the same size. Where
    the footprint itself was not seen, its surroundings tell the level.
    """
    for growth in FOOTPRINTS:
        height = _support_heights(T, scene, fit, growth)
        height = height[(height > -SETTLE_DOWN) & (height < SETTLE_UP)]
        if len(height) >= SUPPORT_POINTS:
            near = (np.abs(height[:, None] - height[None, :]) <= LEVEL).sum(axis=1)
            best = int(np.argmax(near - 100 * np.abs(height)))  # one point is worth 1 cm
            if near[best] >= SUPPORT_POINTS:
                return float(np.median(height[np.abs(height - height[best]) <= LEVEL]))
    return 0.0


def _support_heights(T: Array, scene: ObservedScene, fit: ObjectFit, growth: float) -> Array:
    """Heights above the underside (m) of the upward points under the footprint, grown on each side (m)."""
    half = half_extents(T[:3, :3], fit)
    local = scene.points[scene.up] - T[:3, 3]
    if fit.shape == "cylinder":
        under = np.hypot(local[:, 0], local[:, 1]) < half[0] + growth
    else:
        under = (np.abs(local[:, :2]) < half[:2] + growth).all(axis=1)
    return np.asarray(local[under, 2] + half[2])


def _support_count(T: Array, scene: ObservedScene, fit: ObjectFit) -> int:
    return int((np.abs(_support_heights(T, scene, fit, FOOTPRINTS[0])) <= 2 * LEVEL).sum())


def _search(T: Array, scene: ObservedScene, fit: ObjectFit) -> Array:
    """(2,) shift along x and y of the front frame that frees the object and its way in, m."""
    steps = np.arange(-REACH, REACH + GRID / 2, GRID)
    shifts = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    cost = _path_cost(T, scene, fit, shifts, margin=MARGIN) + 100 * np.linalg.norm(shifts * SHIFT_COST, axis=1)
    return np.asarray(shifts[np.argmin(cost)])


def _path_cost(T: Array, scene: ObservedScene, fit: ObjectFit, shifts: Array, margin: float) -> Array:
    """Points inside the object or the volume it sweeps from the opening, for each shift.

    Args:
        T: (4, 4) pose of the fitted object in the front frame.
        shifts: (S, 2) shifts along x and y, m.
        margin: m by which the object is thought larger on all sides but the underside; negative: smaller.

    Returns:
        (S,) sum over the points of how deep they are, 1 for each that is 1 cm deep or more.
    """
    half = half_extents(T[:3, :3], fit)
    local = scene.points - T[:3, 3]
    reach = np.abs(shifts).max() + margin
    low, high = -half[2] + FLOOR, half[2]
    near = (np.abs(local[:, 1]) < half[1] + reach) & (local[:, 0] > -half[0] - reach)
    near &= (local[:, 2] > low) & (local[:, 2] < high)
    x, y, z = local[near].T
    vertical = np.minimum(z - low, high - z)
    x, y = x[None] - shifts[:, :1], np.abs(y[None] - shifts[:, 1:])
    if fit.shape == "cylinder":
        side = half[0] + margin - np.hypot(np.minimum(x, 0), y)
    else:
        side = np.minimum(half[1] + margin - y, x + half[0] + margin)
    depth = np.clip(np.minimum(side, vertical[None] + margin), 0, DEPTH_CAP)
    return np.asarray(depth.sum(axis=1) / DEPTH_CAP)
