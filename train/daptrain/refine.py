"""Candidate poses made exact, and put in order, by geometry on the observed cloud; no ground truth, no learning.

A candidate is the pose `T_world_box` of the fitted box or cylinder (`fit.ObjectFit`). A method that predicts a motion
of the observed object multiplies: `T_world_box = T_motion @ fit.T_world_box`.

Three facts carry this file. Objects stand upright and square to the container, so tilt and turn can be snapped. They
come in through the opening, so the volume swept on the way in must be free as well as the object's own. They rest on
something, so there must be points under the footprint, and around its centre. All of it happens in the container's front
frame: x out of the opening, z up.

What is in the way is measured as a depth: how far a patch of observed surface reaches into the volume. A number of points
inside says less, since it grows with the surface that happens to be seen; and flying pixels, which hang in a gap between
its edges, are left out by their few neighbours. A depth is also negative in free space, so that the same figure finds the
middle of a gap and prefers the roomier of two. All costs are in mm of depth.

Considered and left out, since they made no difference on 75 scenes: the share of the volume that no camera saw through
(deep tight gaps are unseen too), the number of frontal cells that are hit, the soft sum of depths beside the depth.

Source: the collision count is DAP's ranking (points inside the object's oriented box). The swept volume and the support
were added because collision count alone likes empty air and blocked places.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dapdata.poses import inverse, pose, rotation_about
from daptrain.fit import ContainerFit, ObjectFit, fit_container

Array = NDArray[Any]

STEPS = ("gravity", "yaw", "settle", "search", "spread")  # of refine, in this order; each can be left out
CRITERIA = ("inside", "path", "support", "balance", "residual")  # of rank; each can be left out

REACH = 0.016  # m: how far the search may shift a candidate sideways
GRIDS = (0.004, 0.002)  # m: spacings of the search, the finer one around the best of the coarser one
FLOOR = 0.005  # m: points this little above the underside are what it stands on, not in its way
PATCHES = (0.00025, 0.0005, 0.001)  # m2: a surface counts by the mean of the depths that so much of it reaches
ROOM = 0.006  # m: more free space than this on all sides is no better, about twice the error of a camera's pose
DEPTH_CAP = 0.01  # m: deeper inside is no worse
SHIFT_COST = 0.2  # of 1 m of shift, in m of depth: well below 1, so that it goes where it is free
NEIGHBOURHOOD = 0.012  # m: radius in which a point's neighbours are counted
ISOLATED = 0.4  # a point with fewer than this share of the median number of neighbours hangs in the air between surfaces
SETTLE_DOWN, SETTLE_UP = 0.06, 0.04  # m below and above the underside in which support is looked for
LEVEL = 0.004  # m: points of one support lie within this of its height
FOOTPRINTS = (-0.002, 0.01, 0.025)  # m: the footprint is grown by these, one after the other, until support is found
LEVEL_COST = 200.0  # of 1 m up or down, in mm of depth
SUPPORT_POINTS = 3  # fewer points under the footprint are no support
LEAST_SUPPORT = 0.02  # share of the footprint: less is not told apart
SUPPORT_COST = 3.0  # of support that is e times smaller, in mm of depth
BALANCED = 0.7  # share of the smaller half extent: support that reaches this far all around is enough
HERE = np.zeros((1, 2))  # m: no shift
PLACE = 0.02  # m: candidates whose centres are nearer than this head for one place
SPREAD = 0.003 * np.array([(0, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0)])  # m, first to last
BALANCE_COST = 6.0  # of a reach that is smaller by that half extent, in mm of depth


@dataclass(frozen=True)
class ObservedScene:
    """A container's cloud in its own front frame (x out of the opening, z up)."""

    points: Array  # (N, 3) f8, front frame, m
    up: Array  # (N,) bool, the normal points up: a point that can support
    solid: Array  # (N,) bool, not a stray between surfaces (a flying pixel): a point that can be in the way
    density: float  # points per m2 of a surface
    container: ContainerFit


def observed_scene(points: Array, normals: Array) -> ObservedScene:
    """The scene that refine and rank work on.

    Args:
        points: (N, 3) observed points of the container and what stands in it, world frame, m.
        normals: (N, 3) unit, towards the sensor.
    """
    container = fit_container(points, normals)
    local = np.asarray(points, float) @ container.T_world_front[:3, :3]
    neighbours = cKDTree(local).query_ball_point(local, NEIGHBOURHOOD, return_length=True)
    usual = float(np.median(neighbours))
    return ObservedScene(
        local,
        np.asarray(normals, float)[:, 2] > 0.5,
        neighbours >= ISOLATED * usual,
        usual / (np.pi * NEIGHBOURHOOD**2),
        container,
    )


def refine(T_world_box: Array, scene: ObservedScene, fit: ObjectFit, steps: Collection[str] = STEPS) -> Array:
    """Candidates after snapping, settling and a small search for free space.

    Args:
        T_world_box: (K, 4, 4) candidate poses of the fitted object.
        scene: From `observed_scene`.
        fit: From `fit.fit_object`.
        steps: Which of STEPS to do: gravity (the upright axis becomes vertical), yaw (a box turns square to the
            container), settle (down or up onto the points under it), search (sideways, out of points that are in it or
            in its way), spread (a candidate for the place of one before it moves 3 mm aside, each in another direction:
            the cameras' error is the same for all of them, so that trying the same spot again would fail again).

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
        near = _nearby(T[k], scene, fit)
        if "gravity" in steps:
            T[k, :3, :3] = _upright(T[k, :3, :3], fit)
        if "yaw" in steps and fit.shape == "box":
            T[k, :3, :3] = _square(T[k, :3, :3])
        if "settle" in steps:
            T[k, 2, 3] += _settle(T[k], near, fit)
        if "search" in steps:
            T[k, :2, 3] += _search(T[k], near, fit)
            if "settle" in steps:  # on another spot it may stand on something else
                T[k, 2, 3] += _settle(T[k], near, fit)
    if "spread" in steps:
        T[:, :3, 3] += _spread(T[:, :3, 3])
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
        cost, near = 0.0, _nearby(T[k], scene, fit)
        if "inside" in criteria:
            centre = T[k, :3, 3]
            cost += 100.0 * float(((centre < scene.container.low) | (centre > scene.container.high)).any())
        if "path" in criteria:
            cost += 1000 * float(_depth(T[k], near, fit, HERE)[0])
        if "support" in criteria:
            cost -= SUPPORT_COST * float(np.log(_supported(T[k], near, fit, HERE)[0]))
        if "balance" in criteria:
            cost += BALANCE_COST * max(BALANCED - _reach(T[k], near, fit), 0.0)
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


def _nearby(T: Array, scene: ObservedScene, fit: ObjectFit) -> ObservedScene:
    """The scene without the points that a candidate cannot meet on its way in, wherever it is turned or shifted."""
    radius = float(np.linalg.norm(fit.size)) / 2 + SETTLE_DOWN + REACH
    local = scene.points - T[:3, 3]
    near = (np.abs(local[:, 1]) < radius) & (np.abs(local[:, 2]) < radius + SETTLE_DOWN) & (local[:, 0] > -radius)
    return replace(scene, points=scene.points[near], up=scene.up[near], solid=scene.solid[near])


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

    Of the levels within reach the one wins that is near, has many points and leaves the object free of what is around
    it. Where the footprint itself was not seen, its surroundings tell the level.
    """
    for growth in FOOTPRINTS:
        height = _support_heights(T, scene, fit, growth)
        height = height[(height > -SETTLE_DOWN) & (height < SETTLE_UP)]
        if len(height) >= SUPPORT_POINTS:
            near = (np.abs(height[:, None] - height[None, :]) <= LEVEL).sum(axis=1)
            levels = _levels(height, near)
            if levels:
                costs = [_level_cost(T, height, count, scene, fit) for height, count in levels]
                return levels[int(np.argmin(costs))][0]
    return 0.0


def _level_cost(T: Array, height: float, count: int, scene: ObservedScene, fit: ObjectFit) -> float:
    """How unlikely (mm of depth) the object is to stand on a support of so many points at this height (m)."""
    raised = pose(T[:3, :3], T[:3, 3] + [0, 0, height])
    return LEVEL_COST * abs(height) + 1000 * float(_depth(raised, scene, fit, HERE)[0]) - SUPPORT_COST * float(np.log(count))


def _levels(height: Array, near: Array) -> list[tuple[float, int]]:
    """Heights (m) of up to 4 supports and their numbers of points, the one with most points first."""
    found: list[tuple[float, int]] = []
    near = near.copy()
    while len(found) < 4 and near.max() >= SUPPORT_POINTS:
        best = int(np.argmax(near))
        mine = np.abs(height - height[best]) <= LEVEL
        found.append((float(np.median(height[mine])), int(near[best])))
        near[np.abs(height - height[best]) <= 2 * LEVEL] = 0
    return found


def _support_heights(T: Array, scene: ObservedScene, fit: ObjectFit, growth: float) -> Array:
    """Heights above the underside (m) of the upward points under the footprint, grown on each side (m)."""
    half = half_extents(T[:3, :3], fit)
    local = scene.points[scene.up] - T[:3, 3]
    return np.asarray(local[_under(local, half, fit, growth), 2] + half[2])


def _under(local: Array, half: Array, fit: ObjectFit, growth: float) -> Array:
    """(N,) which points (N, 3) lie over or under the footprint, grown on each side (m)."""
    if fit.shape == "cylinder":
        return np.asarray(np.hypot(local[:, 0], local[:, 1]) < half[0] + growth)
    return np.asarray((np.abs(local[:, :2]) < half[:2] + growth).all(axis=1))


def _supported(T: Array, scene: ObservedScene, fit: ObjectFit, shifts: Array) -> Array:
    """(S,) share of the footprint that was seen to be supported, for each shift (S, 2) along x and y, m."""
    half, under = _support_points(T, scene, fit, float(np.abs(shifts).max()))
    away = np.abs(under[None] - shifts[:, None])
    within = (np.hypot(away[..., 0], away[..., 1]) < half[0]) if fit.shape == "cylinder" else (away < half[:2]).all(axis=2)
    area = 4 * half[0] * half[1] * (np.pi / 4 if fit.shape == "cylinder" else 1)
    return np.asarray(np.clip(within.sum(axis=1) / (scene.density * area), LEAST_SUPPORT, 1))


def _reach(T: Array, scene: ObservedScene, fit: ObjectFit) -> float:
    """How far support reaches from the centre into the direction where it reaches least; -1 without any.

    As a share of the smaller horizontal half extent; negative where the centre is beside what it stands on.
    """
    half, under = _support_points(T, scene, fit, FOOTPRINTS[0])
    turns = np.arange(16) * np.pi / 8
    reach = (under @ np.stack([np.cos(turns), np.sin(turns)])).max(axis=0).min() if len(under) else -np.inf
    return float(np.clip(reach / half[:2].min(), -1, 1))


def _support_points(T: Array, scene: ObservedScene, fit: ObjectFit, growth: float) -> tuple[Array, Array]:
    """(3,) half extents and (U, 2) upward points at the height of the underside, from the centre of the footprint, m."""
    half = half_extents(T[:3, :3], fit)
    local = scene.points[scene.up] - T[:3, 3]
    return half, local[_under(local, half, fit, growth) & (np.abs(local[:, 2] + half[2]) <= 2 * LEVEL), :2]


def _search(T: Array, scene: ObservedScene, fit: ObjectFit) -> Array:
    """(2,) shift along x and y of the front frame that frees the object and its way in, m."""
    best, reach = np.zeros(2), REACH
    for grid in GRIDS:
        steps = np.arange(-reach, reach + grid / 2, grid)
        shifts = best + np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        cost = 1000 * (_depth(T, scene, fit, shifts) + SHIFT_COST * np.linalg.norm(shifts, axis=1))
        cost -= SUPPORT_COST * np.log(_supported(T, scene, fit, shifts))
        best, reach = shifts[np.argmin(cost)], grid / 2
    return np.asarray(best)


def _spread(centres: Array) -> Array:
    """(K, 3) shifts along x, y and z of the front frame, m, that keep candidates (K, 3) for one place apart."""
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    earlier = np.tril(apart < PLACE, -1).sum(axis=1)
    return np.asarray(SPREAD[earlier % len(SPREAD)])


def _depth(T: Array, scene: ObservedScene, fit: ObjectFit, shifts: Array) -> Array:
    """How deep the observed surfaces are inside the object or the volume it sweeps from the opening, for each shift.

    Args:
        T: (4, 4) pose of the fitted object in the front frame.
        shifts: (S, 2) shifts along x and y, m.

    Returns:
        (S,) m, the depth that a patch of surface reaches, capped; negative: the space that is free all around.
    """
    half = half_extents(T[:3, :3], fit)
    local = scene.points[scene.solid] - T[:3, 3]
    reach = np.abs(shifts).max(axis=0) + ROOM
    low, high = -half[2] + FLOOR, half[2]
    near = (np.abs(local[:, 1]) < half[1] + reach[1]) & (local[:, 0] > -half[0] - reach[0])
    near &= (local[:, 2] > low) & (local[:, 2] < high + ROOM)
    patches = [max(1, round(scene.density * patch)) for patch in PATCHES]
    if near.sum() < max(patches):
        return np.full(len(shifts), -ROOM)
    x, y, z = local[near].T
    x, y = x[None] - shifts[:, :1], np.abs(y[None] - shifts[:, 1:])
    is_round = fit.shape == "cylinder"
    side = half[0] - np.hypot(np.minimum(x, 0), y) if is_round else np.minimum(half[1] - y, x + half[0])
    depth = np.minimum(side, np.minimum(z - low, high - z))
    places = [depth.shape[1] - patch for patch in patches]
    return np.asarray(np.clip(np.partition(depth, places, axis=1)[:, places], -ROOM, DEPTH_CAP).mean(axis=1))
