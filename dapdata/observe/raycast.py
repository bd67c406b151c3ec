"""Depth images of boxes, cylinders and ellipsoids by exact ray casting: no mesh, no scene to build.

Each part is intersected only with the rays inside its screen bounding box, and a depth buffer keeps the nearest
hit. Compared with a software rasteriser or a mesh ray caster this is several times faster at the hundred or so
parts of a furnished shelf, exact, and it knows the part and the surface normal of every pixel.

A pixel's ray goes through its centre: pixel (u, v) sees the direction ((u + 0.5 - cx) / fx, (v + 0.5 - cy) / fy, 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from dapdata.poses import inverse
from dapdata.records import PART_KINDS, Array

BOX, CYLINDER, ELLIPSOID = (PART_KINDS.index(name) for name in ("box", "cylinder", "ellipsoid"))
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


@dataclass(frozen=True)
class Image:
    """What a perfect depth camera sees. H rows, W columns."""

    depth: Array  # (H, W) f4, m along the optical axis; 0 where nothing is seen
    part: Array  # (H, W) i4, index of the part; -1 where nothing is seen
    normal: Array  # (H, W, 3) f4, unit, camera frame, toward the camera; 0 where nothing is seen


def corners(size: Array, T_a_part: Array) -> Array:
    """(P, 8, 3) corners of the parts' bounding boxes in frame a, from full extents (P, 3) and poses (P, 4, 4)."""
    return np.asarray((CORNERS * size[:, None]) @ np.swapaxes(T_a_part[:, :3, :3], 1, 2) + T_a_part[:, None, :3, 3])


def cast(
    kind: Array, size: Array, T_camera_part: Array, K: Array, width: int, height: int, near: float = 0.01, far: float = 10.0
) -> Image:
    """What a camera sees of some parts.

    Args:
        kind: (P,) index into PART_KINDS; meshes are not handled here.
        size: (P, 3) full extents along the part's axes, m. Cylinders are round: size[0] is the diameter.
        T_camera_part: (P, 4, 4) poses in the camera frame (OpenCV axes).
        K: (3, 3) intrinsics without skew, px.
        width, height: Image size, px.
        near, far: Hits outside of this range of depth are not seen, m.

    Raises:
        ValueError: A part is none of box, cylinder, ellipsoid.
    """
    if np.any(kind > ELLIPSOID):
        raise ValueError("cast: got a part that is a mesh, expected boxes, cylinders and ellipsoids")
    depth = np.zeros((height, width), np.float32)
    part = np.full((height, width), -1, np.int32)
    normal = np.zeros((height, width, 3), np.float32)
    f = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    screen = _screen_boxes(corners(size, T_camera_part), f, width, height, near)
    T_part_camera = np.ascontiguousarray(inverse(T_camera_part))
    _cast(kind.astype(np.int64), np.ascontiguousarray(size / 2), T_part_camera, f, near, far, screen, depth, part, normal)
    return Image(depth, part, normal)


def _screen_boxes(corners_camera: Array, f: Array, width: int, height: int, near: float) -> Array:
    """(P, 4) i8 of first and last-but-one column and row that a part can cover; empty where it cannot be seen."""
    z = corners_camera[..., 2]
    crosses = np.any(z < near, axis=1)
    uv = f[2:] + f[:2] * corners_camera[..., :2] / np.where(crosses[:, None], 1.0, z)[..., None]
    limits = np.array([width, height], float)
    low, high = np.floor(uv.min(axis=1) - 0.5), np.ceil(uv.max(axis=1) + 0.5)
    low[crosses], high[crosses] = 0, limits
    high[np.all(z < near, axis=1)] = 0
    box = np.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]], axis=1)
    return np.asarray(np.clip(box, 0, limits.repeat(2)).astype(np.int64))


@njit(cache=True, error_model="numpy")
def _cast(
    kind: Array,
    half: Array,
    T_part_camera: Array,
    f: Array,
    near: float,
    far: float,
    screen: Array,
    depth: Array,
    part: Array,
    normal: Array,
) -> None:
    """Fill depth, part and normal; a hit replaces a farther one."""
    for p in range(len(kind)):
        T = T_part_camera[p]
        o0, o1, o2 = T[0, 3], T[1, 3], T[2, 3]
        h0, h1, h2 = half[p, 0], half[p, 1], half[p, 2]
        for v in range(screen[p, 2], screen[p, 3]):
            y = (v + 0.5 - f[3]) / f[1]
            for u in range(screen[p, 0], screen[p, 1]):
                x = (u + 0.5 - f[2]) / f[0]
                d0 = T[0, 0] * x + T[0, 1] * y + T[0, 2]
                d1 = T[1, 0] * x + T[1, 1] * y + T[1, 2]
                d2 = T[2, 0] * x + T[2, 1] * y + T[2, 2]
                if kind[p] == BOX:
                    t, n0, n1, n2 = _hit_box(o0, o1, o2, d0, d1, d2, h0, h1, h2)
                elif kind[p] == CYLINDER:
                    t, n0, n1, n2 = _hit_cylinder(o0, o1, o2, d0, d1, d2, h0, h2)
                else:
                    t, n0, n1, n2 = _hit_ellipsoid(o0, o1, o2, d0, d1, d2, h0, h1, h2)
                if near <= t <= far and (part[v, u] < 0 or t < depth[v, u]):
                    depth[v, u] = t
                    part[v, u] = p
                    for i in range(3):
                        normal[v, u, i] = T[0, i] * n0 + T[1, i] * n1 + T[2, i] * n2


# The three below: distance t along the ray o + t d (in part coordinates; t is the depth because d has z = 1 in camera
# coordinates) where it enters the solid from outside, and the outward normal there; -1 for a miss or a camera inside.
Hit = tuple[float, float, float, float]


@njit(cache=True, error_model="numpy", inline="always")
def _hit_box(o0: float, o1: float, o2: float, d0: float, d1: float, d2: float, h0: float, h1: float, h2: float) -> Hit:
    """Only faces that look at the camera can be entered, at most three."""
    if abs(o0) > h0 and o0 * d0 < 0:
        s = 1.0 if o0 > 0 else -1.0
        t = (s * h0 - o0) / d0
        if abs(o1 + t * d1) <= h1 and abs(o2 + t * d2) <= h2:
            return t, s, 0.0, 0.0
    if abs(o1) > h1 and o1 * d1 < 0:
        s = 1.0 if o1 > 0 else -1.0
        t = (s * h1 - o1) / d1
        if abs(o0 + t * d0) <= h0 and abs(o2 + t * d2) <= h2:
            return t, 0.0, s, 0.0
    if abs(o2) > h2 and o2 * d2 < 0:
        s = 1.0 if o2 > 0 else -1.0
        t = (s * h2 - o2) / d2
        if abs(o0 + t * d0) <= h0 and abs(o1 + t * d1) <= h1:
            return t, 0.0, 0.0, s
    return -1.0, 0.0, 0.0, 0.0


@njit(cache=True, error_model="numpy", inline="always")
def _hit_cylinder(o0: float, o1: float, o2: float, d0: float, d1: float, d2: float, radius: float, h: float) -> Hit:
    """The mantle is a quadratic in t, a cap is a disc."""
    if abs(o2) > h and o2 * d2 < 0:
        s = 1.0 if o2 > 0 else -1.0
        t = (s * h - o2) / d2
        if (o0 + t * d0) ** 2 + (o1 + t * d1) ** 2 <= radius * radius:
            return t, 0.0, 0.0, s
    a, b, c = d0 * d0 + d1 * d1, o0 * d0 + o1 * d1, o0 * o0 + o1 * o1 - radius * radius
    root = b * b - a * c
    if c > 0 and b < 0 and root > 0:
        t = (-b - np.sqrt(root)) / a
        if abs(o2 + t * d2) <= h:
            return t, (o0 + t * d0) / radius, (o1 + t * d1) / radius, 0.0
    return -1.0, 0.0, 0.0, 0.0


@njit(cache=True, error_model="numpy", inline="always")
def _hit_ellipsoid(o0: float, o1: float, o2: float, d0: float, d1: float, d2: float, h0: float, h1: float, h2: float) -> Hit:
    """A unit sphere after dividing by the half axes; the normal is the gradient of its equation."""
    o0, o1, o2, d0, d1, d2 = o0 / h0, o1 / h1, o2 / h2, d0 / h0, d1 / h1, d2 / h2
    a, b, c = d0 * d0 + d1 * d1 + d2 * d2, o0 * d0 + o1 * d1 + o2 * d2, o0 * o0 + o1 * o1 + o2 * o2 - 1
    root = b * b - a * c
    if c > 0 and b < 0 and root > 0:
        t = (-b - np.sqrt(root)) / a
        n0, n1, n2 = (o0 + t * d0) / h0, (o1 + t * d1) / h1, (o2 + t * d2) / h2
        length = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        return t, n0 / length, n1 / length, n2 / length
    return -1.0, 0.0, 0.0, 0.0
