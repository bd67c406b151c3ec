"""Rigid poses as 4x4 matrices, and the symmetries of objects.

`T_a_b` maps b-coordinates to a: `p_a = T_a_b @ p_b`. Everything is float64, metres and radians.

Symmetry kinds (`records.SYMMETRIES`), each a group acting on the object frame from the right:
- none: the identity alone;
- box: the identity and the three half turns about the object's axes;
- revolution: every turn about the axis, and the half turns that reverse it (a plain cylinder or ellipsoid).
"""

from __future__ import annotations

from itertools import permutations, product
from math import cos, hypot, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def pose(rotation: Array | None = None, translation: Array | tuple[float, float, float] = (0, 0, 0)) -> Array:
    """(4, 4) pose of a (3, 3) rotation (default: none) and a (3,) translation, m."""
    T = np.zeros((4, 4))
    T[:3, :3] = np.eye(3) if rotation is None else rotation
    T[:3, 3] = translation
    T[3, 3] = 1
    return T


def inverse(T: Array) -> Array:
    """The inverse of rigid poses, (..., 4, 4)."""
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = R_t
    out[..., :3, 3] = -(R_t @ T[..., :3, 3, None])[..., 0]
    out[..., 3, 3] = 1
    return out


def transform(T_a_b: Array, points_b: Array) -> Array:
    """(N, 3) points in frame a from (N, 3) points in frame b."""
    return np.asarray(points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3])


def rotate(T_a_b: Array, vectors_b: Array) -> Array:
    """(N, 3) directions in frame a from (N, 3) directions in frame b."""
    return np.asarray(vectors_b @ T_a_b[:3, :3].T)


def skew(x: float, y: float, z: float) -> Array:
    """(3, 3) matrix that makes the cross product of (x, y, z) with a vector."""
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def rotation_about(axis: Array | tuple[float, float, float], angle: float) -> Array:
    """(3, 3) rotation by angle (rad) about an axis of any length but zero (Rodrigues)."""
    K = skew(*np.asarray(axis, float) / np.linalg.norm(axis))
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


def rotation_by(turn: Array) -> Array:
    """(3, 3) rotation by a rotation vector (3,): about its direction, by its length in rad; zero turns nothing."""
    x, y, z = (float(value) for value in turn)
    angle = hypot(x, y, z)
    s, c = (sin(angle) / angle, (1 - cos(angle)) / angle**2) if angle > 0 else (1.0, 0.5)
    return np.array(
        [
            [1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y],
            [c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x],
            [c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)],
        ]
    )


def random_rotation(rng: np.random.Generator) -> Array:
    """(3, 3) rotation, uniform over SO(3) (a normalised Gaussian quaternion)."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def angle_between(rotation_a: Array, rotation_b: Array) -> Array:
    """Smallest angle, rad in [0, pi], that turns one (..., 3, 3) rotation into the other."""
    # The chordal distance is accurate near zero, where arccos of the trace is not.
    chord = np.linalg.norm(np.asarray(rotation_a) - np.asarray(rotation_b), axis=(-2, -1))
    return np.asarray(2 * np.arcsin(np.clip(chord / (2 * np.sqrt(2)), 0, 1)))


def nearest_symmetric(T_a_object: Array, T_a_reference: Array, kind: str, axis: Array) -> Array:
    """The symmetric copy of a pose whose rotation is closest to a reference pose.

    Args:
        T_a_object: (4, 4) pose to choose a copy of.
        T_a_reference: (4, 4) pose to come close to.
        kind: "none", "box" or "revolution".
        axis: (3,) unit axis of revolution in the object frame; ignored for other kinds.

    Returns:
        (4, 4) pose T_a_object @ g with g in the symmetry group.
    """
    R, R_ref = T_a_object[:3, :3], T_a_reference[:3, :3]
    if kind == "none":
        return T_a_object.copy()
    if kind == "box":
        signs = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
        best = signs[np.argmax(signs @ np.einsum("ij,ij->j", R, R_ref))]
        return pose(R * best, T_a_object[:3, 3])
    if kind != "revolution":
        raise ValueError(f"symmetry kind: got '{kind}', expected none, box or revolution")
    axis_a, axis_ref = R @ axis, R_ref @ axis
    if axis_a @ axis_ref < 0:
        axis_a = -axis_a
    # Turn the reference by the smallest rotation that brings its axis onto ours.
    (a, b, c), (x, y, z), cosine = axis_ref.tolist(), axis_a.tolist(), axis_ref @ axis_a
    K = skew(b * z - c * y, c * x - a * z, a * y - b * x)
    return pose((np.eye(3) + K + K @ K / (1 + cosine)) @ R_ref, T_a_object[:3, 3])


def symmetric_distance(T_a: Array, T_b: Array, kind: str, axis: Array) -> tuple[float, float]:
    """Distance (m) of the origins and smallest angle (rad) of two poses modulo the symmetry."""
    near = nearest_symmetric(T_a, T_b, kind, axis)
    return float(np.linalg.norm(near[:3, 3] - T_b[:3, 3])), float(angle_between(near[:3, :3], T_b[:3, :3]))


def tilt(T_world_object: Array, kind: str, axis: Array) -> float:
    """Smallest angle (rad) between the object's z axis and up, modulo the symmetry.

    A cylinder that stands may stand on either end; a plate on its rim (revolution about y) may be rolled.

    Args:
        T_world_object: (4, 4) pose in a frame whose z is up.
        kind: "none", "box" or "revolution".
        axis: (3,) unit axis of revolution in the object frame; ignored for other kinds.
    """
    angle = float(np.arccos(np.clip(T_world_object[2, 2], -1, 1)))
    if kind == "none":
        return angle
    if kind == "box":
        return min(angle, np.pi - angle)
    # Turned about the axis, z runs over a cone around it; reversed, over the opposite cone.
    cone, lean = (float(np.arccos(np.clip(cosine, -1, 1))) for cosine in (axis[2], T_world_object[2, :3] @ axis))
    return min(abs(lean - cone), abs(lean - (np.pi - cone)))


def facing(T_world_container: Array, opening: Array) -> Array:
    """(3,) horizontal unit vector, world frame, that a container faces: of an opening that points up, its x axis.

    Args:
        T_world_container: (4, 4); containers are only ever turned about the vertical.
        opening: (3,) unit vector out of the opening, container frame.
    """
    level = np.array([opening[0], opening[1], 0.0]) if np.hypot(*opening[:2]) > 1e-6 else np.array([1.0, 0, 0])
    return np.asarray(T_world_container[:3, :3] @ (level / np.linalg.norm(level)))


def upright_turn(rotation: Array) -> Array:
    """(3, 3) right-angle turn after which the z axis of a rotation (3, 3) is closest to up: rotation @ turn.

    Of four such the one closest to none.
    """
    signed = [np.eye(3)[:, order] * signs for order in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)]
    turns = [turn for turn in signed if np.linalg.det(turn) > 0]
    up = [round(float((rotation @ turn)[2, 2]), 6) for turn in turns]
    return turns[max(range(len(turns)), key=lambda i: (up[i], np.trace(turns[i]), -i))]
