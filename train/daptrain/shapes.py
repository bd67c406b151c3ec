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
CONVERGED = 1e-5  # m or rad: a smaller step ends the iteration
ROUGH_POINTS = 300  # points that show which axis, before all of them show where it is
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
    """The cylinder whose side and caps fit the points best, by least squares from the best of a few axes.

    Args:
        points: (M, 3) m.
        normals: (M, 3) unit.
    """
    middle = np.median(points, axis=0)
    local = points - middle
    few = thinned(len(points), ROUGH_POINTS)
    starts = [_refine_cylinder(_first_cylinder(axis, local[few], normals[few]), local[few], normals[few], 4)
              for axis in _axis_candidates(normals)]  # fmt: skip
    best = min(starts, key=lambda start: _measured_cylinder(start, local[few], normals[few]).misfit)
    # Begun anew from its axis: a cap that is too sparse among a few points may be seen among all.
    best = _refine_cylinder(_first_cylinder(best.axis, local, normals), local, normals, 12)
    fit = _measured_cylinder(best, local, normals)
    return replace(fit, T_world_box=pose(translation=middle) @ fit.T_world_box)


def thinned(count: int, most: int) -> slice:
    """Every n-th of `count` things, with n such that about `most` or fewer are left."""
    return slice(None, None, max(1, -(-count // most)))


def _fit(shape: Literal["box", "cylinder"], T: Array, size: Array, distance: Array, cosine: Array, faces: int) -> ObjectFit:
    """The fit with its figures of merit, from each point's distance (m) and its normal's cosine to the shape's."""
    residual = float(np.minimum(distance, 0.01).mean())
    deviation = float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).mean())
    return ObjectFit(shape, T, size, residual, residual + DEVIATION_WEIGHT * deviation, np.inf, faces)


def _frame(axis: Array) -> Array:
    """(3, 3) right-handed rotation whose third column is the unit axis.

    Source: Duff et al., Building an Orthonormal Basis, Revisited (2017).
    """
    x, y, z = axis.tolist()
    sign = -1.0 if z < 0 else 1.0
    a = -1 / (sign + z)
    b = x * y * a
    return np.array([[1 + sign * x * x * a, b, x], [sign * b, sign + y * y * a, y], [-sign * x, -y, z]])


def _cross(a: Array, b: Array) -> Array:
    """Row by row, an order of magnitude faster than np.cross on a thousand rows."""
    return np.asarray(a[:, [1, 2, 0]] * b[:, [2, 0, 1]] - a[:, [2, 0, 1]] * b[:, [1, 2, 0]])


def _dominant_axes(normals: Array) -> Array:
    """(3, 3) rotation whose columns most normals are parallel to, within 15 degrees."""
    normals = normals[thinned(len(normals), ROUGH_POINTS)]
    candidates = normals[thinned(len(normals), 100)]
    least = np.cos(np.deg2rad(15))
    first = candidates[np.argmax((np.abs(candidates @ normals.T) > least).sum(axis=1))]
    side_x, side_y = _frame(first)[:, :2].T
    turns = np.deg2rad(np.arange(0, 180, 3))[:, None]
    near = np.abs((np.cos(turns) * side_x + np.sin(turns) * side_y) @ normals.T) > least
    best = turns[np.argmax((near[:30] | near[30:]).sum(axis=1))]
    second = np.cos(best) * side_x + np.sin(best) * side_y
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
        A = np.concatenate([_cross(outward[use], local[use]), -np.eye(6)[face[use]]], axis=1)
        step = _solve(A, -residual[use], weight)
        axes = _turned(axes, step[:3])
        offsets = offsets + step[3:]
        if np.abs(step).max() < CONVERGED:
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
    cosine = np.abs(sphere @ normals[thinned(len(normals), ROUGH_POINTS)].T)
    score = ((cosine < np.sin(np.deg2rad(12))) | (cosine > np.cos(np.deg2rad(12)))).sum(axis=1)
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


def _faces(axis: Array, normals: Array) -> Array:
    """(M,) face of each point of a cylinder: 0 the side, 1 and 2 the caps along +axis and -axis, -1 a sparse cap."""
    cosine = normals @ axis
    face = np.where(cosine >= SIDE_COSINE, 1, np.where(cosine <= -SIDE_COSINE, 2, 0))
    return np.where((face > 0) & (np.bincount(face, minlength=3) < FACE_POINTS)[face], -1, face)


def _first_cylinder(axis: Array, local: Array, normals: Array) -> _Cylinder:
    """Circle through the side points as seen along the axis, caps at the median of theirs."""
    face, frame = _faces(axis, normals), _frame(axis)
    side = face == 0
    flat = (local[side] if side.sum() >= FACE_POINTS else local) @ frame[:, :2]
    A = np.concatenate([2 * flat, np.ones((len(flat), 1))], axis=1)
    middle_x, middle_y, power = np.linalg.lstsq(A, (flat**2).sum(axis=1), rcond=None)[0]
    radius = float(np.clip(np.sqrt(max(power + middle_x**2 + middle_y**2, 1e-6)), 1e-3, 0.5))
    caps = [sign * (local[face == cap] @ axis) for cap, sign in ((1, 1), (2, -1))]
    ends = np.array([np.median(along) if len(along) else 0.0 for along in caps])
    return _Cylinder(axis, frame[:, :2] @ [middle_x, middle_y], radius, ends)


def _refine_cylinder(c: _Cylinder, local: Array, normals: Array, iterations: int) -> _Cylinder:
    """The cylinder after Gauss-Newton on the distances of points to their faces; points about their middle."""
    for iteration in range(iterations):
        step = _cylinder_step(c, local, normals, OUTLIER if iteration > 3 else 3 * OUTLIER)
        frame = _frame(c.axis)
        axis = frame @ [step[0], step[1], 1.0]
        axis /= np.linalg.norm(axis)
        centre = c.centre + frame[:, :2] @ step[2:4]
        c = _Cylinder(axis, centre - axis * (centre @ axis), float(c.radius + step[4]), c.ends + step[5:])
        if np.abs(step).max() < CONVERGED:
            break
    return c


def _cylinder_step(c: _Cylinder, local: Array, normals: Array, limit: float) -> Array:
    """(7,) Gauss-Newton step: axis and centre along x and y of `_frame(axis)`, radius, upper and lower end.

    Args:
        c: Where the cylinder is.
        local: (M, 3) points about their middle, m.
        normals: (M, 3) unit.
        limit: m; points further from their face have no say.
    """
    face, frame = _faces(c.axis, normals), _frame(c.axis)
    x, y, along = (local @ frame).T
    out_x, out_y = x - c.centre @ frame[:, 0], y - c.centre @ frame[:, 1]
    length = np.maximum(np.hypot(out_x, out_y), 1e-9)
    side, sign = face == 0, np.where(face == 2, -1.0, 1.0)
    residual = np.where(side, length - c.radius, sign * along - c.ends[(face == 2).astype(int)])
    use = (np.abs(residual) < limit) & (face >= 0)
    if use.sum() < FACE_POINTS:
        return np.zeros(7)
    out_x, out_y = np.where(side, out_x / length, 0.0), np.where(side, out_y / length, 0.0)
    tilt_x, tilt_y = np.where(side, -along * out_x, sign * x), np.where(side, -along * out_y, sign * y)
    A = np.stack([tilt_x, tilt_y, -out_x, -out_y, -1.0 * side, -1.0 * (face == 1), -1.0 * (face == 2)], axis=1)
    weight = use / np.maximum(1, np.abs(residual) / HUBER)
    return np.asarray(np.clip(_solve(A, -residual, weight), -0.2, 0.2))


def _measured_cylinder(c: _Cylinder, local: Array, normals: Array) -> ObjectFit:
    """The cylinder with its figures of merit, about the middle of the points. A hopeless one gets a large misfit."""
    face, frame = _faces(c.axis, normals), _frame(c.axis)
    x, y, along = (local @ frame).T
    low, high = _reach(c, face, along)
    if not (1e-3 < c.radius < 1 and 1e-3 < high - low < 2):
        return ObjectFit("cylinder", np.eye(4), np.full(3, 0.01), 0.01, 1.0, np.inf, 0)
    radial = np.stack([x, y], axis=1) - c.centre @ frame[:, :2]
    length = np.maximum(np.hypot(*radial.T), 1e-9)
    beyond = np.stack([length - c.radius, np.abs(along - (low + high) / 2) - (high - low) / 2])
    distance = np.abs(np.hypot(*np.maximum(beyond, 0)) + np.minimum(beyond.max(axis=0), 0))
    turned = normals @ frame
    cosine = np.maximum(np.abs(turned[:, 2]), np.abs((turned[:, :2] * radial).sum(axis=1) / length))
    T = pose(frame, c.centre + c.axis * (low + high) / 2)
    seen = int((face == 1).any()) + int((face == 2).any())
    return _fit("cylinder", T, np.array([2 * c.radius, 2 * c.radius, high - low]), distance, cosine, seen + 1)


def _reach(c: _Cylinder, face: Array, along: Array) -> tuple[float, float]:
    """Lower and upper end along the axis, m: where a cap is not seen, the side's reach counts."""
    side = face == 0
    far_low, far_high = np.quantile(along[side] if side.sum() >= FACE_POINTS else along, [0.02, 0.98])
    above, below = (face == 1).any(), (face == 2).any()
    high, low = (c.ends[0] if above else far_high), (-c.ends[1] if below else far_low)
    # Points spread evenly along the side reach 98 % of the way from a seen cap at their 98 % quantile.
    spare = (high - low) * (1 / 0.98 - 1)
    return float(low if below else low - spare), float(high if above else high + spare)
