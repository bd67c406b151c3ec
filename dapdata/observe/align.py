"""Camera poses corrected until the views agree: joint point-to-plane alignment of all views of one cloud.

A calibrated rig knows each camera's pose to some millimetres and tenths of a degree, which at arm's length puts the two
sides of a narrow gap, seen by different cameras, up to a centimetre apart. Where two views see the same surface they say
so themselves. What they cannot tell, an error that all views share above all, stays as it was believed.

Each view gets a small motion of its camera. All of them are found together by Gauss-Newton: a point of one view, projected
into another, should lie on the plane of the point that this one sees there; and a correction is unlikely to be larger than
calibrations are wrong. Projection finds partners in constant time, and is sure to, since poses are nearly right.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
from numba import njit

from dapdata.observe.cameras import View
from dapdata.poses import inverse, pose, rotate, rotation_by, transform
from dapdata.records import Array

IMAGE_ROWS = 240  # partners are sought in images of about this height: of larger ones every 4th, 9th, ... point is taken
SAMPLES = 500  # points of a view that look for partners in another
ROUNDS = 6
CONVERGED = 2e-5  # m or rad: a smaller step ends the iteration
GATES = (0.025, 0.012)  # m, distance of partners in the first two rounds and later
SAME_SIDE = 0.8  # cosine between the normals of partners
HUBER = 0.003  # m: residuals above this count linearly, about the noise of one pixel
RESIDUAL = 0.004  # m, std of a residual: larger than a pixel's noise, since neighbouring ones are wrong together
TRANSLATION, ROTATION = 0.002, np.radians(0.3)  # std of a camera's correction along and about each of its axes


def align(views: list[View], points: list[Array], normals: list[Array]) -> Array:
    """(V, 4, 4) T_world_camera of each view, corrected.

    Args:
        views: V cameras, with the poses that are believed.
        points: (n, 3) of each view, world frame, m, by the believed poses.
        normals: (n, 3) unit.
    """
    T = np.stack([view.T_world_camera for view in views])
    strides = [max(1, round(view.height / IMAGE_ROWS)) for view in views]
    local = [transform(inverse(T[v]), p[:: strides[v] ** 2].astype(float)) for v, p in enumerate(points)]
    facing = [rotate(inverse(T[v]), n[:: strides[v] ** 2].astype(float)) for v, n in enumerate(normals)]
    few = [np.unique(np.linspace(0, len(p) - 1, min(len(p), SAMPLES)).astype(int)) for p in local]
    seekers = [(p[chosen], n[chosen]) for p, n, chosen in zip(local, facing, few)]
    K = [view.K / [[stride], [stride], [1]] for view, stride in zip(views, strides)]
    rows = [_rows(p, K[v], -(-views[v].height // strides[v]), -(-views[v].width // strides[v])) for v, p in enumerate(local)]
    prior = np.tile([TRANSLATION**-2] * 3 + [ROTATION**-2] * 3, len(views))
    moved = np.zeros(6 * len(views))  # sum of the steps: they are small enough to add up
    for iteration in range(ROUNDS):
        H, g = np.diag(prior), -prior * moved
        gate = GATES[min(iteration // 2, 1)]
        for a, b in permutations(range(len(views)), 2):
            _add_pair(*seekers[a], local[b], facing[b], rows[b], K[b], inverse(T[b]) @ T[a], a, b, gate, H, g)
        step = np.linalg.solve(H, g)
        moved += step
        for v in range(len(views)):
            shift, turn = step[6 * v : 6 * v + 3], step[6 * v + 3 : 6 * v + 6]
            T[v] = T[v] @ pose(rotation_by(turn), shift)
        if np.abs(step).max() < CONVERGED:
            break
    return T


def _rows(points: Array, K: Array, height: int, width: int) -> Array:
    """(H, W) i4: one of the points (n, 3), camera frame, that each pixel of a camera (3, 3) sees; -1 for none."""
    rows = np.full((height, width), -1, np.int32)
    if len(points):
        u, v = (np.floor(K[k, k] * points[:, k] / points[:, 2] + K[k, 2]).astype(int) for k in (0, 1))
        u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)  # an outermost pixel may round outwards
        rows[v, u] = np.arange(len(points))
    return rows


@njit(cache=True)
def _add_pair(
    points: Array,
    normals: Array,
    other_points: Array,
    other_normals: Array,
    rows: Array,
    K: Array,
    T_other_own: Array,
    own: int,
    other: int,
    gate: float,
    H: Array,
    g: Array,
) -> None:
    """Add to the normal equations what the points of one view say in another.

    Args:
        points, normals: (s, 3) of the one view, its camera's frame.
        other_points, other_normals: (n, 3) of the other view, its camera's frame.
        rows: (H, W) points of the other view by pixel, -1 for none.
        K: (3, 3) of the other camera, px.
        T_other_own: (4, 4) between the cameras, as corrected so far.
        own, other: Numbers of the two views.
        gate: m, partners that are farther apart are none.
        H: (6 V, 6 V), symmetric; g: (6 V,). A view's unknowns are shift (m) and turn (rad) in its camera's frame.
    """
    height, width = rows.shape
    R, t = T_other_own[:3, :3], T_other_own[:3, 3]
    J = np.zeros(12)
    place = np.zeros(12, np.int64)
    for k in range(6):
        place[k], place[6 + k] = 6 * own + k, 6 * other + k
    p, m = np.zeros(3), np.zeros(3)
    for i in range(len(points)):
        for k in range(3):
            p[k] = R[k, 0] * points[i, 0] + R[k, 1] * points[i, 1] + R[k, 2] * points[i, 2] + t[k]
            m[k] = R[k, 0] * normals[i, 0] + R[k, 1] * normals[i, 1] + R[k, 2] * normals[i, 2]
        if p[2] <= 0:
            continue
        u, v = int(np.floor(K[0, 0] * p[0] / p[2] + K[0, 2])), int(np.floor(K[1, 1] * p[1] / p[2] + K[1, 2]))
        if not (0 <= u < width and 0 <= v < height) or rows[v, u] < 0:
            continue
        j = rows[v, u]
        x, y, z = p[0] - other_points[j, 0], p[1] - other_points[j, 1], p[2] - other_points[j, 2]
        nx, ny, nz = other_normals[j, 0], other_normals[j, 1], other_normals[j, 2]
        if x * x + y * y + z * z > gate * gate or m[0] * nx + m[1] * ny + m[2] * nz < SAME_SIDE:
            continue
        residual = nx * x + ny * y + nz * z
        weight = 1 / (RESIDUAL * RESIDUAL * max(1.0, abs(residual) / HUBER))
        # The point moves with its own camera: by R (shift + turn x point).
        ox, oy, oz = (
            R[0, 0] * nx + R[1, 0] * ny + R[2, 0] * nz,
            R[0, 1] * nx + R[1, 1] * ny + R[2, 1] * nz,
            R[0, 2] * nx + R[1, 2] * ny + R[2, 2] * nz,
        )
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        J[0], J[1], J[2] = ox, oy, oz
        J[3], J[4], J[5] = b * oz - c * oy, c * ox - a * oz, a * oy - b * ox
        # Its partner moves with the other camera.
        a, b, c = p[0], p[1], p[2]
        J[6], J[7], J[8] = -nx, -ny, -nz
        J[9], J[10], J[11] = -(b * nz - c * ny), -(c * nx - a * nz), -(a * ny - b * nx)
        for k in range(12):
            scaled = weight * J[k]
            g[place[k]] -= scaled * residual
            for q in range(12):
                H[place[k], place[q]] += scaled * J[q]
