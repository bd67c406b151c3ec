"""How far poses are apart modulo the object's symmetry, which goal a prediction is at, and how many goals are found.

Poses are compared by the largest distance that any point of the object's surface is off (d_mssd, the maximum
symmetry-aware surface distance of the BOP challenge): one number in metres, with no weight between metres and degrees
to choose. Definitions in docs/metrics.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import comb, log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata.poses import inverse, transform
from dapdata.records import GOAL_KINDS, PART_KINDS, Mesh, meshes_in

Array = NDArray[Any]

TIGHT = 0.015  # m: a goal with less clearance is tight, as is every stack
HALF_TURNS = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)


# Distances modulo symmetry ---------------------------------------------------------------------------------


def hull_points(kind: Array, size: Array, T_object_part: Array, meshes: Sequence[Mesh | None] = ()) -> Array:
    """Points of an object's surface among which the one that moves most is found, whatever the motion.

    Args:
        kind: (Q,) index into records.PART_KINDS.
        size: (Q, 3) full extents, m.
        T_object_part: (Q, 4, 4).
        meshes: Q, the triangles of the parts that are meshes; may be left out where there are none.

    Returns:
        (X, 3) object frame, m: corners of boxes, 16 points on both rims of cylinders, the corners of the convex hulls of
        meshes, those of the cuboid around anything else (which overstates its distances a little).
    """
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    turn = np.arange(16) * np.pi / 8
    ring = np.stack([np.cos(turn) / 2, np.sin(turn) / 2], axis=1)
    rims = np.concatenate([np.column_stack([ring, np.full(16, end)]) for end in (-0.5, 0.5)])
    points = [np.zeros((0, 3))]
    for k, extents, T, mesh in zip(kind, size, T_object_part, meshes or [None] * len(kind)):
        if mesh is not None:
            from scipy.spatial import ConvexHull

            local = mesh.vertices[ConvexHull(mesh.vertices).vertices]
        else:
            local = (rims if PART_KINDS[int(k)] == "cylinder" else corners) * extents
        points.append(local @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(points)


def object_points(sample: Mapping[str, Array]) -> Array:
    """(X, 3) points around a demo's object, its own frame, m: of its parts, or of its cloud where nobody knows them."""
    if not len(sample["object_parts/kind"]):
        return transform(inverse(sample["pose/T_world_object_start"]), sample["object/points"].astype(float))
    kind, size, T_object_part = (sample[f"object_parts/{name}"] for name in ("kind", "size", "T_object_part"))
    return hull_points(kind, size, T_object_part, meshes_in(sample)[1])


def surface_distance(T_a: Array, T_b: Array, points: Array, symmetry: str, axis: Array) -> Array:
    """How far the most displaced surface point is off between poses, modulo the symmetry (d_mssd).

    Args:
        T_a: (K, 4, 4) poses of the object.
        T_b: (M, 4, 4) poses of the object.
        points: (X, 3) of its surface, object frame, m: see `hull_points`.
        symmetry: "none", "box" or "revolution".
        axis: (3,) unit axis of revolution, object frame.

    Returns:
        (K, M) m. For a revolution the turn about the axis is the one of the smallest rotation.

    Source: maximum symmetry-aware surface distance of the BOP challenge.
    """
    p_a = points @ np.swapaxes(T_a[:, :3, :3], 1, 2) + T_a[:, None, :3, 3]  # (K, X, 3)
    if symmetry == "revolution":
        return _revolved_distance(p_a - T_a[:, None, :3, 3], T_a, T_b, axis)
    turns = HALF_TURNS if symmetry == "box" else HALF_TURNS[:1]
    copies = points[None] * turns[:, None]  # (S, X, 3)
    p_b = np.einsum("mij,sxj->msxi", T_b[:, :3, :3], copies) + T_b[:, None, None, :3, 3]
    off = np.linalg.norm(p_a[:, None, None] - p_b[None], axis=-1)  # (K, M, S, X)
    return np.asarray(off.max(axis=-1).min(axis=-1))


def _revolved_distance(turned: Array, T_a: Array, T_b: Array, axis: Array) -> Array:
    """(K, M) m: each a is turned the shortest way until its axis lies along b's, and shifted onto b.

    Args:
        turned: (K, X, 3) surface points in the orientation of a, about a's origin.
        T_a: (K, 4, 4).
        T_b: (M, 4, 4).
        axis: (3,) unit, object frame.
    """
    axis_a, axis_b = T_a[:, None, :3, :3] @ axis, T_b[None, :, :3, :3] @ axis
    cosine = (axis_a * axis_b).sum(axis=-1)
    axis_b = np.where(cosine < 0, -1, 1)[..., None] * axis_b
    cross, cosine = np.cross(axis_a, axis_b)[:, :, None], np.abs(cosine)[..., None, None]
    once = np.cross(cross, turned[:, None])  # Rodrigues: R v = v + c x v + c x (c x v) / (1 + cos)
    off = once + np.cross(cross, once) / (1 + cosine) + (T_b[None, :, :3, 3] - T_a[:, None, :3, 3])[:, :, None]
    return np.asarray(np.linalg.norm(off, axis=-1).max(axis=-1))


def tolerance(clearance: Array) -> Array:
    """(M,) m, the surface distance within which a prediction is at a goal: min(10 mm, half the clearance + 2 mm)."""
    return np.asarray(np.minimum(0.010, np.maximum(np.asarray(clearance, float), 0) / 2 + 0.002))


def is_tight(clearance: Array, goal_kind: Array) -> Array:
    """(M,) bool: clearance under 15 mm, or standing on top of something."""
    return np.asarray((np.asarray(clearance) < TIGHT) | (np.asarray(goal_kind) == GOAL_KINDS.index("stack")))


# Modes -----------------------------------------------------------------------------------------------------


def uniform_recall(modes: int, draws: int) -> float:
    """Expected share of the modes that a uniform sampler finds: 1 - (1 - 1/modes)^draws."""
    return 1 - (1 - 1 / modes) ** draws


def uniform_all_found(modes: int, draws: int) -> float:
    """Chance that a uniform sampler finds every mode, by counting distinct modes draw by draw."""
    found = np.zeros(modes + 1)
    found[0] = 1
    new = 1 - np.arange(modes + 1) / modes
    for _ in range(draws):
        found = found * (1 - new) + np.concatenate([[0], (found * new)[:-1]])
    return float(found[modes])


def uniform_entropy(modes: int, draws: int) -> float:
    """Expected entropy, over log(modes), of the modes that a uniform sampler's draws fall on."""
    if modes < 2:
        return 1.0
    terms = (
        comb(draws, n) * (1 / modes) ** n * (1 - 1 / modes) ** (draws - n) * -(n / draws) * log(n / draws)
        for n in range(1, draws + 1)
    )
    return float(modes * sum(terms) / log(modes))


def mode_entropy(assigned: Array, modes: int) -> float:
    """Entropy, over log(modes), of the modes that matched predictions fall on; 1 is even, 0 is all on one.

    Args:
        assigned: (K,) index of the matched mode, -1 for none.
        modes: Number of modes of the scene.
    """
    counts = np.bincount(assigned[assigned >= 0], minlength=modes)
    if modes < 2 or counts.sum() == 0:
        return 1.0 if modes < 2 and counts.sum() else 0.0
    share = counts[counts > 0] / counts.sum()
    return float(-(share * np.log(share)).sum() / log(modes))


def assign(distance: Array, tau: Array) -> Array:
    """(K,) the nearest mode of each prediction among those within their tolerance, -1 where there is none.

    Args:
        distance: (K, M) m.
        tau: (M,) m.
    """
    if 0 in distance.shape:
        return np.full(len(distance), -1)
    inside = np.where(distance <= tau, distance, np.inf)
    return np.where(np.isfinite(inside.min(axis=1)), inside.argmin(axis=1), -1)


def legacy_rpdiff(T_a: Array, T_b: Array) -> Array:
    """Which predictions RPDiff's coverage would take to be at which goals; for reference only, see docs/metrics.md.

    Args:
        T_a: (K, 4, 4) predictions.
        T_b: (M, 4, 4) goals.

    Returns:
        (2, K, M) bool, for its recall (closer than 3.5 cm) and for its precision (4 cm). Its "5 degrees" compare
        sin^2(half the angle) with 5 degrees in rad, which is 34.4 degrees; no symmetry is known to it.

    Source: `compute_coverage` of RPDiff's code. Its search for the nearest goal takes any pair within both limits and
    then keeps to such pairs, so that a goal is found if any prediction is within both limits of it, and so here.
    """
    apart = np.linalg.norm(T_a[:, None, :3, 3] - T_b[None, :, :3, 3], axis=-1)
    turned = (3 - np.einsum("kij,mij->km", T_a[:, :3, :3], T_b[:, :3, :3])) / 4  # sin^2 of half the angle
    return np.stack([(apart < limit) & (turned < np.deg2rad(5.0)) for limit in (0.035, 0.04)])


# Affordance ------------------------------------------------------------------------------------------------


def affordance_quality(scores: Array, regions: Array) -> tuple[float, float]:
    """How well one sampled affordance marks one mode: intersection over union with the best mode, and purity.

    Args:
        scores: (S,) affordance of the superpoints, in [-1, 1].
        regions: (M, S) bool, the superpoints near the object at each goal.

    Returns:
        IoU of the superpoints above 0 with the mode that they fit best, and the share of those superpoints that lie
        in any one mode and in the same one. (0, 0) when no superpoint is above 0.
    """
    marked = np.asarray(scores) > 0
    if not marked.any() or len(regions) == 0:
        return 0.0, 0.0
    common = (regions & marked).sum(axis=1)
    union = (regions | marked).sum(axis=1)
    return float((common / union).max()), float(common.max() / marked.sum())
