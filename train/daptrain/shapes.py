"""Boxes and cylinders fitted to an object's points by robust least squares.

Normals only say which face a point belongs to; the points say where the face is. That is the difference between frames
that are degrees off and frames that are tenths of a degree off on noisy clouds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from dapdata.poses import pose

Array = NDArray[Any]

FACE_POINTS = 12  # a face with fewer points is treated as unseen
HUBER = 0.002  # m: residuals above this count linearly, about the noise of one voxel
OUTLIER = 0.012  # m: a point further from its face than this has no say
DEVIATION_WEIGHT = 1e-4  # m: a mean deviation of the normals by one degree counts like this distance
SIDE_COSINE = 0.7  # a normal belongs to a face when it is within 45 degrees of it


@dataclass(frozen=True)
class ObjectFit:
    """A box or a cylinder around an observed object.

    The frame of the fit is modulo the shape's symmetry: a box has its axes sorted by extent (x thinnest, z
    longest), a cylinder has its axis along z and an arbitrary turn about it.
    """

    shape: Literal["box", "cylinder"]
    T_world_box: Array  # (4, 4) f8, origin at the centre of the shape
    size: Array  # (3,) f8, m, full extents along the frame's axes; cylinder: diameter, diameter, height
    residual: float  # m, mean distance of the points to the surface, each capped at 1 cm
    misfit: float  # m, residual plus the mean deviation of the normals, 0.1 mm a degree
    other_misfit: float  # m, the same for the shape that was not chosen: the larger, the surer the choice
    faces: int  # faces with enough points: 6 for a box seen all around, 3 for a cylinder (two caps and the side)


def fit_box(points: Array, normals: Array) -> ObjectFit:
    """The box whose faces fit the points best: plane offsets and a common rotation, by least squares.

    Args:
        points: (M, 3) m.
        normals: (M, 3) unit.
    """
    middle = np.median(points, axis=0)
    local = points - middle
    axes = _snap_axes(_dominant_axes(normals), normals)
    axes, offsets, seen = _align_faces(axes, local, normals)
    low, high = _extents(axes, offsets, seen, local, normals)
    order = np.argsort(high - low)
    axes, low, high = axes[:, order], low[order], high[order]
    if np.linalg.det(axes) < 0:  # an axis reversed swaps the ends of its interval
        axes[:, 0], low[0], high[0] = -axes[:, 0], -high[0], -low[0]
    centre = axes @ ((low + high) / 2)
    size = np.maximum(high - low, 1e-3)
    distance = np.abs(_box_distance((local - centre) @ axes, size))
    return _fit("box", pose(axes, middle + centre), size, distance, np.abs(normals @ axes).max(axis=1), int(seen.sum()))


def fit_cylinder(points: Array, normals: Array) -> ObjectFit:
    """The cylinder whose side and caps fit the points best, by least squares from the best of many axes.

    Args:
        points: (M, 3) m.
        normals: (M, 3) unit.
    """
    middle = np.median(points, axis=0)
    local = points - middle
    fits = [_refine_cylinder(axis, local, normals) for axis in _axis_candidates(normals)]
    best = min(fits, key=lambda fit: fit.misfit)
    return replace(best, T_world_box=pose(best.T_world_box[:3, :3], best.T_world_box[:3, 3] + middle))


def _fit(shape: Literal["box", "cylinder"], T: Array, size: Array, distance: Array, cosine: Array, faces: int) -> ObjectFit:
    """The fit with its figures of merit, from each point's distance (m) and its normal's cosine to the shape's."""
    residual = float(np.minimum(distance, 0.01).mean())
    deviation = float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).mean())
    return ObjectFit(shape, T, size, residual, residual + DEVIATION_WEIGHT * deviation, np.inf, faces)


def _perpendicular(axis: Array) -> Array:
    other = np.eye(3)[np.argmin(np.abs(axis))]
    side = np.cross(axis, other)
    return np.asarray(side / np.linalg.norm(side))


def _dominant_axes(normals: Array) -> Array:
    """(3, 3) rotation whose columns most normals are parallel to, within 15 degrees."""
    normals = normals[:: max(1, len(normals) // 1500)]
    candidates = normals[:: max(1, len(normals) // 200)]
    near = np.abs(candidates @ normals.T) > np.cos(np.deg2rad(15))
    first = candidates[np.argmax(near.sum(axis=1))]
    turns = np.deg2rad(np.arange(0, 90, 3))
    side_x = _perpendicular(first)
    side_y = np.cross(first, side_x)
    around = np.cos(turns)[:, None] * side_x + np.sin(turns)[:, None] * side_y
    square = np.cross(first, around)
    votes = (np.abs(around @ normals.T) > np.cos(np.deg2rad(15))) | (np.abs(square @ normals.T) > np.cos(np.deg2rad(15)))
    second = around[np.argmax(votes.sum(axis=1))]
    return np.stack([first, second, np.cross(first, second)], axis=1)


def _snap_axes(axes: Array, normals: Array) -> Array:
    """The rotation after each normal within 32 degrees of an axis has pulled that axis to itself, 8 times."""
    for _ in range(8):
        cosines = normals @ axes
        nearest = np.argmax(np.abs(cosines), axis=1)
        value = np.take_along_axis(cosines, nearest[:, None], axis=1)[:, 0]
        keep = np.abs(value) > 0.85
        if keep.sum() < 3:
            break
        signed = np.sign(value[keep])[:, None] * np.eye(3)[nearest[keep]]
        U, _, Vt = np.linalg.svd(normals[keep].T @ signed)
        axes = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return axes


def _align_faces(axes: Array, local: Array, normals: Array) -> tuple[Array, Array, Array]:
    """Rotation, face offsets and seen faces after Gauss-Newton on the distances of points to their planes.

    Returns:
        (3, 3) axes; (6,) offsets along +x -x +y -y +z -z, m; (6,) bool.
    """
    offsets, seen = np.zeros(6), np.zeros(6, bool)
    for iteration in range(12):
        face, outward = _assign_faces(axes, normals)
        along = np.einsum("ij,ij->i", outward, local)
        fresh = offsets.copy()
        for f in range(6):
            seen[f] = (mine := face == f).sum() >= FACE_POINTS
            if seen[f] and iteration == 0:
                fresh[f] = np.median(along[mine])
        offsets = fresh
        residual = along - offsets[np.maximum(face, 0)]
        use = (face >= 0) & seen[np.maximum(face, 0)] & (np.abs(residual) < (OUTLIER if iteration > 2 else 3 * OUTLIER))
        if use.sum() < FACE_POINTS:
            break
        weight = 1 / np.maximum(1, np.abs(residual[use]) / HUBER)
        A = np.concatenate([np.cross(outward[use], local[use]), -np.eye(6)[face[use]]], axis=1)
        step = _solve(A, -residual[use], weight)
        axes = _turned(axes, step[:3])
        offsets = offsets + step[3:]
        if np.abs(step).max() < 1e-7:
            break
    return axes, offsets, seen


def _assign_faces(axes: Array, normals: Array) -> tuple[Array, Array]:
    """For each normal its face (+x -x +y -y +z -z, or -1 when between faces) and the face's outward axis."""
    cosines = normals @ axes
    nearest = np.argmax(np.abs(cosines), axis=1)
    value = np.take_along_axis(cosines, nearest[:, None], axis=1)[:, 0]
    face = np.where(np.abs(value) > SIDE_COSINE, 2 * nearest + (value < 0), -1)
    return face, axes.T[nearest] * np.sign(value)[:, None]


def _solve(A: Array, b: Array, weight: Array) -> Array:
    """Weighted least squares, leaning to zero where the data say nothing (an unseen face)."""
    normal_matrix = A.T @ (A * weight[:, None])
    return np.asarray(np.linalg.solve(normal_matrix + 1e-9 * np.eye(A.shape[1]), A.T @ (weight * b)))


def _turned(axes: Array, spin: Array) -> Array:
    """Axes (3, n) after a small rotation vector (rad), orthonormal again when there are three."""
    angle = np.linalg.norm(spin)
    if angle < 1e-12:
        return axes
    unit = spin / angle
    K = np.array([[0, -unit[2], unit[1]], [unit[2], 0, -unit[0]], [-unit[1], unit[0], 0]])
    return np.asarray((np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K) @ axes)


def _extents(axes: Array, offsets: Array, seen: Array, local: Array, normals: Array) -> tuple[Array, Array]:
    """(3,) low and high ends along the axes: plane offsets where seen, else the reach of the faces square to them."""
    high, low = offsets[0::2].copy(), -offsets[1::2]
    cosines = np.abs(normals @ axes)
    for i in np.flatnonzero(~(seen[0::2] & seen[1::2])):
        square = cosines[:, i] < 0.5
        along = (local[square] if square.sum() >= FACE_POINTS else local) @ axes[:, i]
        far_low, far_high = np.quantile(along, [0.02, 0.98])
        # Points spread evenly reach 98 % of the way from a seen face at their 98 % quantile.
        if seen[2 * i]:
            low[i] = high[i] - (high[i] - far_low) / 0.98
        elif seen[2 * i + 1]:
            high[i] = low[i] + (far_high - low[i]) / 0.98
        else:
            low[i], high[i] = far_low - 0.02 * (far_high - far_low), far_high + 0.02 * (far_high - far_low)
    return low, high


def _box_distance(local: Array, size: Array) -> Array:
    """Signed distance (M,) of points to a box centred at the origin, m, negative inside."""
    q = np.abs(local) - size / 2
    return np.asarray(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0))


def _axis_candidates(normals: Array) -> Array:
    """(4, 3) directions that most normals are parallel or square to, each far from the others."""
    number = 400
    height = (np.arange(number) + 0.5) / number
    turn = np.pi * (1 + 5**0.5) * np.arange(number)
    ring = np.sqrt(1 - height**2)
    sphere = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    cosine = np.abs(sphere @ normals[:: max(1, len(normals) // 1500)].T)
    score = ((cosine < np.sin(np.deg2rad(12))) | (cosine > np.cos(np.deg2rad(12)))).sum(axis=1).astype(float)
    chosen = []
    for _ in range(4):
        best = sphere[np.argmax(score)]
        chosen.append(best)
        score[np.abs(sphere @ best) > np.cos(np.deg2rad(25))] = -1
    return np.array(chosen)


@dataclass(frozen=True)
class _Cylinder:
    """A cylinder while it is being fitted, in coordinates about the middle of the points."""

    axis: Array  # (3,) unit
    centre: Array  # (3,) point of the axis, square to it, m
    radius: float  # m
    ends: Array  # (2,) offsets of the caps along +axis and -axis, m; only used where the cap is seen


def _refine_cylinder(axis: Array, local: Array, normals: Array) -> ObjectFit:
    """The cylinder after Gauss-Newton from one axis; points about their middle. Hopeless starts get a large misfit."""
    cylinder = _first_cylinder(axis, local, normals)
    for iteration in range(15):
        limit = OUTLIER if iteration > 3 else 3 * OUTLIER
        step = _cylinder_step(cylinder, local, normals, limit)
        cylinder = _stepped(cylinder, step)
        if np.abs(step).max() < 1e-7:
            break
    axis, centre, radius = cylinder.axis, cylinder.centre, cylinder.radius
    low, high, seen = _reach(cylinder, local, normals)
    along = local @ axis
    radial = local - centre - np.outer(along, axis)
    length = np.maximum(np.linalg.norm(radial, axis=1), 1e-9)
    beyond = np.stack([length - radius, np.abs(along - (low + high) / 2) - (high - low) / 2])
    distance = np.abs(np.linalg.norm(np.maximum(beyond, 0), axis=0) + np.minimum(beyond.max(axis=0), 0))
    cosine = np.maximum(np.abs(normals @ axis), np.abs((normals * radial).sum(axis=1) / length))
    side_x = _perpendicular(axis)
    T = pose(np.stack([side_x, np.cross(axis, side_x), axis], axis=1), centre + axis * (low + high) / 2)
    fit = _fit("cylinder", T, np.array([2 * radius, 2 * radius, high - low]), distance, cosine, int(seen.sum()) + 1)
    hopeless = not (1e-3 < radius < 1 and 1e-3 < high - low < 2)
    return replace(fit, size=np.full(3, 0.01), misfit=1.0) if hopeless else fit


def _cylinder_faces(axis: Array, normals: Array) -> tuple[Array, Array]:
    """Which points (M,) lie on the side, and which (2, M) on the caps along +axis and -axis; a sparse cap has none."""
    cosine = normals @ axis
    caps = np.stack([cosine >= SIDE_COSINE, cosine <= -SIDE_COSINE])
    return np.abs(cosine) < SIDE_COSINE, caps & (caps.sum(axis=1) >= FACE_POINTS)[:, None]


def _first_cylinder(axis: Array, local: Array, normals: Array) -> _Cylinder:
    """Circle through the side points as seen along the axis, caps at the median of theirs."""
    side, caps = _cylinder_faces(axis, normals)
    x = _perpendicular(axis)
    flat = (local[side] if side.sum() >= FACE_POINTS else local) @ np.stack([x, np.cross(axis, x)], axis=1)
    A = np.concatenate([2 * flat, np.ones((len(flat), 1))], axis=1)
    middle_x, middle_y, power = np.linalg.lstsq(A, (flat**2).sum(axis=1), rcond=None)[0]
    radius = float(np.clip(np.sqrt(max(power + middle_x**2 + middle_y**2, 1e-6)), 1e-3, 0.5))
    ends = np.array([np.median(sign * (local[cap] @ axis)) if cap.any() else 0.0 for sign, cap in zip((1, -1), caps)])
    return _Cylinder(axis, middle_x * x + middle_y * np.cross(axis, x), radius, ends)


def _cylinder_step(c: _Cylinder, local: Array, normals: Array, limit: float) -> Array:
    """(9,) Gauss-Newton step: rotation vector (3), shift (3), radius, upper and lower end.

    Args:
        c: Where the cylinder is.
        local: (M, 3) points about their middle, m.
        normals: (M, 3) unit.
        limit: m; points further from their face have no say.
    """
    side, caps = _cylinder_faces(c.axis, normals)
    along = local @ c.axis
    radial = local - c.centre - np.outer(along, c.axis)
    length = np.maximum(np.linalg.norm(radial, axis=1), 1e-9)
    out = radial / length[:, None]
    J = np.zeros((len(local), 9))
    J[:, :3], J[:, 3:6], J[:, 6] = -along[:, None] * np.cross(c.axis, out), -out, -1
    rows, values = [J[side]], [(length - c.radius)[side]]
    for sign, cap, end, column in ((1, caps[0], c.ends[0], 7), (-1, caps[1], c.ends[1], 8)):
        J = np.zeros((int(cap.sum()), 9))
        J[:, :3], J[:, column] = sign * np.cross(c.axis, local[cap]), -1
        rows.append(J)
        values.append(sign * along[cap] - end)
    A, residual = np.concatenate(rows), np.concatenate(values)
    use = np.abs(residual) < limit
    if use.sum() < FACE_POINTS:
        return np.zeros(9)
    A, residual = A[use], residual[use]
    # No spin about the axis and no shift along it: neither changes a cylinder.
    across = np.eye(3) - np.outer(c.axis, c.axis)
    A[:, :3], A[:, 3:6] = A[:, :3] @ across, A[:, 3:6] @ across
    step = _solve(A, -residual, 1 / np.maximum(1, np.abs(residual) / HUBER))
    step[:3], step[3:6] = across @ step[:3], across @ step[3:6]
    return np.asarray(np.clip(step, -0.2, 0.2))


def _stepped(c: _Cylinder, step: Array) -> _Cylinder:
    axis = _turned(c.axis, step[:3])
    axis = axis / np.linalg.norm(axis)
    centre = c.centre + step[3:6]
    return _Cylinder(axis, centre - axis * (centre @ axis), float(c.radius + step[6]), c.ends + step[7:])


def _reach(c: _Cylinder, local: Array, normals: Array) -> tuple[float, float, Array]:
    """Lower and upper end along the axis, m, and which caps are seen (2,): where one is not, the side's reach counts."""
    side, caps = _cylinder_faces(c.axis, normals)
    seen: Array = np.asarray(caps.any(axis=1))
    along = (local[side] if side.sum() >= FACE_POINTS else local) @ c.axis
    far_low, far_high = np.quantile(along, [0.02, 0.98])
    high, low = (c.ends[0] if seen[0] else far_high), (-c.ends[1] if seen[1] else far_low)
    # Points spread evenly along the side reach 98 % of the way from a seen cap at their 98 % quantile.
    spare = (high - low) * (1 / 0.98 - 1)
    return float(low if seen[1] else low - spare), float(high if seen[0] else high + spare), seen
