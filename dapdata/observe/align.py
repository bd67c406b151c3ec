"""Camera poses corrected until the views agree: joint point-to-plane alignment of all views of one cloud.

A calibrated rig knows each camera's pose to some millimetres and tenths of a degree, which at arm's length puts the two
sides of a narrow gap, seen by different cameras, up to a centimetre apart. Where two views see the same surface they say
so themselves. What they cannot tell, an error that all views share above all, stays as it was believed.

Each view gets a small motion. All of them are found together by Gauss-Newton: a point of one view, projected into another,
should lie on the plane of the point that this one sees there; and a correction is unlikely to be larger than calibrations
are wrong. Projection finds partners in constant time, and is sure to, since poses are nearly right. Motions are expressed in
the world frame, where the two views of a pair move their points apart by the difference of their motions: six numbers say
what a pair of points wants of twelve unknowns.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dapdata.observe.cameras import View
from dapdata.poses import pose, rotation_by, skew
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
        views: V cameras of one image size, with the poses that are believed.
        points: (n, 3) f4 of each view, its camera's frame, m.
        normals: (n, 3) f4 unit, the same.
    """
    T = np.stack([view.T_world_camera for view in views])
    stride = max(1, round(views[0].height / IMAGE_ROWS))
    local, facing = [p[:: stride**2] for p in points], [n[:: stride**2] for n in normals]
    start = np.cumsum([0, *map(len, local)])
    K = np.stack([view.K for view in views]) / [[stride], [stride], [1]]
    rows = np.full((len(views), -(-views[0].height // stride), -(-views[0].width // stride)), -1, np.int32)
    for v, p in enumerate(local):
        _enter(p, start[v], K[v], rows[v])
    few = [np.unique(np.linspace(0, len(p) - 1, min(len(p), SAMPLES)).astype(int)) for p in local]
    seekers, seeker_start = np.concatenate(few) + np.repeat(start[:-1], [*map(len, few)]), np.cumsum([0, *map(len, few)])
    clouds = (np.concatenate(local), np.concatenate(facing), seekers, seeker_start, rows, K)
    prior, moved = _prior(T), np.zeros(6 * len(views))  # moved: sum of the steps, small enough to add up
    for iteration in range(ROUNDS):
        H, g = prior.copy(), -prior @ moved
        _add_pairs(T, *clouds, GATES[min(iteration // 2, 1)], H, g)
        step = np.linalg.solve(H, g)
        moved += step
        for v, (shift, turn) in enumerate(step.reshape(-1, 2, 3)):
            T[v] = pose(rotation_by(turn), shift) @ T[v]
        if np.abs(step).max() < CONVERGED:
            break
    return T


def _prior(T_world_camera: Array) -> Array:
    """(6 V, 6 V) inverse covariance of the motions (shift, turn) in the world frame, which all are zero on average."""
    out = np.zeros((len(T_world_camera), 6, len(T_world_camera), 6))
    for v, T in enumerate(T_world_camera):
        own = np.eye(6)  # of the camera: it is shifted by a turn about the world's origin, too
        own[:3, 3:] = -skew(*T[:3, 3])
        out[v, :, v] = own.T @ np.diag([TRANSLATION**-2] * 3 + [ROTATION**-2] * 3) @ own
    return out.reshape(6 * len(T_world_camera), -1)


@njit(cache=True, error_model="numpy")
def _enter(points: Array, first: int, K: Array, rows: Array) -> None:
    """Write into rows (H, W) which of the points (n, 3), camera frame, counted from `first`, each pixel of a camera sees."""
    for i in range(len(points)):
        u = int(np.floor(K[0, 0] * points[i, 0] / points[i, 2] + K[0, 2]))
        v = int(np.floor(K[1, 1] * points[i, 1] / points[i, 2] + K[1, 2]))
        # An outermost pixel may round outwards.
        rows[min(max(v, 0), rows.shape[0] - 1), min(max(u, 0), rows.shape[1] - 1)] = first + i


@njit(cache=True, error_model="numpy")
def _add_pairs(
    T_world_camera: Array,
    points: Array,
    normals: Array,
    seekers: Array,
    seeker_start: Array,
    rows: Array,
    K: Array,
    gate: float,
    H: Array,
    g: Array,
) -> None:
    """Add to the normal equations H step = g what the points of each view a say in each other view b.

    Args:
        T_world_camera: (V, 4, 4), as corrected so far.
        points, normals: (N, 3) of all views, each in its camera's frame.
        seekers, seeker_start: Rows of points that look for partners; those of view v are seeker_start[v] to [v + 1].
        rows: (V, H, W) point that a pixel of each view sees, -1 for none.
        K: (V, 3, 3) px.
        gate: m, partners that are farther apart are none.
        H: (6 V, 6 V), symmetric; g: (6 V,). A view's unknowns are shift (m) and turn (rad) in the world frame.
    """
    J, sums = np.zeros(7), np.zeros((6, 7))
    for a in range(len(rows)):
        few = seekers[seeker_start[a] : seeker_start[a + 1]]
        for b in range(len(rows)):
            if a == b:
                continue
            sums[:] = 0
            _sum_pair(T_world_camera[a], T_world_camera[b], points, normals, few, rows[b], K[b], gate, J, sums)
            for i in range(6):
                g[6 * a + i] -= sums[i, 6]
                g[6 * b + i] += sums[i, 6]
                for k in range(6):
                    H[6 * a + i, 6 * a + k] += sums[i, k]
                    H[6 * b + i, 6 * b + k] += sums[i, k]
                    H[6 * a + i, 6 * b + k] -= sums[i, k]
                    H[6 * b + i, 6 * a + k] -= sums[i, k]


@njit(cache=True, error_model="numpy")
def _sum_pair(
    A: Array, B: Array, points: Array, normals: Array, seekers: Array, rows: Array, K: Array, gate: float, J: Array, sums: Array
) -> None:
    """Add to sums (6, 7) the products of each residual's derivatives J by a's motion with each other and with it.

    A and B are the poses of the two views, J is (7,) to work in, the others are as in `_add_pairs`.
    """
    height, width = rows.shape
    for i in seekers:
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        px = A[0, 0] * x + A[0, 1] * y + A[0, 2] * z + A[0, 3]
        py = A[1, 0] * x + A[1, 1] * y + A[1, 2] * z + A[1, 3]
        pz = A[2, 0] * x + A[2, 1] * y + A[2, 2] * z + A[2, 3]
        x, y, z = px - B[0, 3], py - B[1, 3], pz - B[2, 3]
        x, y, z = (
            B[0, 0] * x + B[1, 0] * y + B[2, 0] * z,
            B[0, 1] * x + B[1, 1] * y + B[2, 1] * z,
            B[0, 2] * x + B[1, 2] * y + B[2, 2] * z,
        )
        if z <= 0:
            continue
        u, v = int(np.floor(K[0, 0] * x / z + K[0, 2])), int(np.floor(K[1, 1] * y / z + K[1, 2]))
        if not (0 <= u < width and 0 <= v < height) or rows[v, u] < 0:
            continue
        j = rows[v, u]
        x, y, z = x - points[j, 0], y - points[j, 1], z - points[j, 2]
        if x * x + y * y + z * z > gate * gate:
            continue
        nx, ny, nz = float(normals[j, 0]), float(normals[j, 1]), float(normals[j, 2])
        residual = nx * x + ny * y + nz * z
        nx, ny, nz = (
            B[0, 0] * nx + B[0, 1] * ny + B[0, 2] * nz,
            B[1, 0] * nx + B[1, 1] * ny + B[1, 2] * nz,
            B[2, 0] * nx + B[2, 1] * ny + B[2, 2] * nz,
        )
        x, y, z = float(normals[i, 0]), float(normals[i, 1]), float(normals[i, 2])
        mx = A[0, 0] * x + A[0, 1] * y + A[0, 2] * z
        my = A[1, 0] * x + A[1, 1] * y + A[1, 2] * z
        mz = A[2, 0] * x + A[2, 1] * y + A[2, 2] * z
        if mx * nx + my * ny + mz * nz < SAME_SIDE:
            continue
        weight = 1 / (RESIDUAL * RESIDUAL * max(1.0, abs(residual) / HUBER))
        # The point moves by shift + turn x point, its partner by as much of the other motion.
        J[0], J[1], J[2] = nx, ny, nz
        J[3], J[4], J[5] = py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx
        J[6] = residual
        for k in range(6):
            scaled = weight * J[k]
            for q in range(7):
                sums[k, q] += scaled * J[q]
