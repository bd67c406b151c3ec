"""Noisy depth images -> normals in image space -> one voxelled cloud in the world frame.

Normals are computed per view, before fusion, where a pixel's neighbours are known for free. On a plane the inverse
depth is linear in the pixel, so a plane fit is a linear fit of 1 / z over a window, in which stereo noise has the same
size everywhere. A window across an edge fits neither side. So a pixel takes the wide window (5 x 5 at 320 x 240) around
it where that fits as well as the image's noise allows, else the best-fitting of the narrow ones (3 x 3) that contain it,
and only a plane that passes close to it; a pixel without one, such as one that flies, is dropped.
A gate on depth differences, the usual way, cannot see a crease and breaks shelves that are seen at a grazing angle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from dapdata.observe.cameras import View
from dapdata.records import Array

FIT_ROWS = 240  # image height at which plane fits stand at every pixel; larger images have them at every 2nd, 3rd, ...
ROUNDING = 1e-12  # 1/m^2, variance of 1 / z below which residuals are rounding errors
MIN_SAMPLES = 6  # pixels that a plane fit needs
MIN_SPREAD = 0.2  # pixel spacings^2, variance of a window's pixels along their thinnest direction: two rows are enough
MIN_AGREEMENT = 0.1  # length of a voxel's mean normal below which its normals cancel and say nothing
MAX_OFF_PLANE = 0.006  # m, perpendicular distance from a pixel to the plane that gives its normal; flying pixels are farther
RESIDUAL_FLOOR = 0.001  # m, rms distance from its plane below which a window is good in any case
TABLE = 1 << 14  # slots for voxels, to begin with
MIDDLE = 1 << 20  # voxels, added so that none has a negative number: half of the 21 bits for each axis
NOISE_MARGIN = 1.5  # a window is good up to this many times the image's median variance, too


@dataclass(frozen=True)
class Fused:
    """A voxelled cloud. N points, ordered by voxel."""

    points: Array  # (N, 3) f4, world, m, mean of the raw points in each voxel
    normals: Array  # (N, 3) f4, unit, world, mean of the raw normals
    view: Array  # (N,) u1, view with most raw points in the voxel


def view_cloud(depth: Array, view: View) -> tuple[Array, Array]:
    """(n, 3) points and (n, 3) unit normals toward the sensor, camera frame, f4, of the pixels that have both."""
    camera = np.array([view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]])
    stride = max(1, round(len(depth) / FIT_ROWS))
    wide, narrow = _no_planes(depth, stride), _no_planes(depth, stride)
    _fit_wide(depth, stride, wide)
    precision = wide[::2, 3, ::2]
    fitted = precision[precision > 0]
    good = NOISE_MARGIN / float(np.median(fitted)) if len(fitted) else 0.0
    size = np.count_nonzero(depth)
    points, normals = np.empty((size, 3), np.float32), np.empty((size, 3), np.float32)
    n = _back_project(depth, wide, narrow, stride, good, camera, points, normals)
    return points[:n], normals[:n]


def _no_planes(depth: Array, stride: int) -> Array:
    """(rows, 4, columns) planes around every stride-th pixel of an image, none of them fitted.

    A plane is the 1 / z at its middle (1/m), its slopes along u and v (1/m/px), and one over the variance of the residuals
    (m^2), which is 0 where nothing was fitted.
    """
    height, width = depth.shape
    planes = np.empty((-(-height // stride), 4, -(-width // stride)), np.float32)
    planes[:, 3] = 0
    return planes


def fuse(points: list[Array], normals: list[Array], T_world_view: Array, voxel: float) -> Fused:
    """One point per occupied voxel of edge `voxel` (m) from the (n, 3) f4 points and normals of V views.

    Args:
        points, normals: One each a view, in its own frame, such as its camera's.
        T_world_view: (V, 4, 4).
        voxel: Edge, m.
    """
    n = sum(len(p) for p in points)
    # Made by numpy: its zeros cost nothing where they are not touched, and there are far fewer voxels than points.
    keys, sums, counts = np.zeros(n, np.int64), np.zeros((n, 6)), np.zeros((n, len(points)), np.int32)
    table, m = np.zeros(TABLE, np.int32), 0
    for view, T in enumerate(T_world_view):
        m, table = _voxel_sums(points[view], normals[view], T, view, voxel, m, table, keys, sums, counts)
    return Fused(*_means(np.argsort(keys[:m]), sums, counts))


@njit(cache=True, error_model="numpy")
def _fit_wide(depth: Array, stride: int, planes: Array) -> None:
    """Fit 1 / z over squares of 4 stride + 1 px around every stride-th pixel; planes are as `_no_planes` makes them.

    The sums over the rows of the windows are kept for as many rows as a window has.
    """
    radius = 2 * stride
    height = 2 * radius + 1
    top, bottom, left, right = _occupied(depth)
    first, last = max((left - radius) // stride, 0), min((right + radius) // stride + 1, planes.shape[2])
    if bottom < 0:
        return
    inverse = np.zeros((stride, planes.shape[2] + 5))
    of_rows, total = np.zeros((height, 6, last - first)), np.zeros((10, last - first))
    summed = top
    for i in range(max((top - radius) // stride, 0), min((bottom + radius) // stride + 1, len(planes))):
        low, high = max(i * stride - radius, top), min(i * stride + radius, bottom)
        while summed <= high:
            _sum_row(depth[summed], stride, first, inverse, of_rows[summed % height])
            summed += 1
        total[:] = 0
        for row in range(low, high + 1):
            _add_row(of_rows[row % height], float(row - i * stride), total)
        middle, slope_u, slope_v, precision = (
            planes[i, 0, first:last],
            planes[i, 1, first:last],
            planes[i, 2, first:last],
            planes[i, 3, first:last],
        )
        for j in range(last - first):  # counted from 0, and without branches: several windows at a time
            n, su, sv, sr, suu = total[0, j], total[1, j], total[2, j], total[3, j], total[4, j]
            suv, svv, sur, svr, srr = total[5, j], total[6, j], total[7, j], total[8, j], total[9, j]
            middle[j], slope_u[j], slope_v[j], precision[j] = _fit(n, su, sv, sr, suu, suv, svv, sur, svr, srr, stride)


@njit(cache=True)
def _occupied(depth: Array) -> tuple[int, int, int, int]:
    """First and last row and column with a depth; rows (H, -1) if there is none."""
    height, width = depth.shape
    top, bottom, left, right = height, -1, width, -1
    for v in range(height):
        for u in range(width):
            if depth[v, u] > 0:
                top, bottom = min(top, v), v
                left, right = min(left, u), max(right, u)
    return top, bottom, left, right


@njit(cache=True, error_model="numpy")
def _sum_row(row: Array, stride: int, first: int, inverse: Array, sums: Array) -> None:
    """Fill sums (6, n) with those of 1, x, r, x^2, x r, r^2 over the pixels u + x of a row, |x| <= 2 stride; r is 1 / z.

    Args:
        row: (W,) depth, m; 0 for none.
        stride: Distance of the windows, px.
        first: u of the first of them, in strides.
        inverse: (stride, ceil(W / stride) + 5) to work in: pixel u is at [u % stride, u // stride + 2], the rest is zero.
        sums: Get one column each window.
    """
    for u in range(len(row)):
        inverse[u % stride, u // stride + 2] = 1.0 / row[u] if row[u] > 0 else 0.0
    sums[:] = 0
    for x in range(-2 * stride, 2 * stride + 1):
        pixels = inverse[x % stride, first + x // stride + 2 :]
        for j in range(sums.shape[1]):
            r = pixels[j]
            n = 1.0 if r > 0 else 0.0
            sums[0, j] += n
            sums[1, j] += x * n
            sums[2, j] += r
            sums[3, j] += x * x * n
            sums[4, j] += x * r
            sums[5, j] += r * r


@njit(cache=True)
def _add_row(sums: Array, y: float, total: Array) -> None:
    """Add to total (10, n), of 1, x, y, r, x^2, x y, y^2, x r, y r, r^2, the sums (6, n) of a row y px from the middle."""
    for j in range(total.shape[1]):
        n, su, sr = sums[0, j], sums[1, j], sums[2, j]
        total[0, j] += n
        total[1, j] += su
        total[2, j] += y * n
        total[3, j] += sr
        total[4, j] += sums[3, j]
        total[5, j] += y * su
        total[6, j] += y * y * n
        total[7, j] += sums[4, j]
        total[8, j] += y * sr
        total[9, j] += sums[5, j]


@njit(cache=True, error_model="numpy")
def _fit_narrow(depth: Array, i: int, j: int, stride: int, planes: Array) -> None:
    """Fill planes[i, :, j] from the square of 2 stride + 1 px around it; one over the variance is -1 where there is no fit."""
    height, width = depth.shape
    n, su, sv, sr, suu, suv, svv, sur, svr, srr = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for row in range(max((i - 1) * stride, 0), min((i + 1) * stride + 1, height)):
        y = float(row - i * stride)
        for column in range(max((j - 1) * stride, 0), min((j + 1) * stride + 1, width)):
            z = depth[row, column]
            if z > 0:
                x, r = float(column - j * stride), 1.0 / z
                n += 1.0
                su += x
                sv += y
                sr += r
                suu += x * x
                suv += x * y
                svv += y * y
                sur += x * r
                svr += y * r
                srr += r * r
    r, b, c, precision = _fit(n, su, sv, sr, suu, suv, svv, sur, svr, srr, stride)
    planes[i, 0, j], planes[i, 1, j], planes[i, 2, j] = r, b, c
    planes[i, 3, j] = precision if precision > 0 else -1.0


@njit(cache=True, error_model="numpy")
def _fit(
    n: float,
    su: float,
    sv: float,
    sr: float,
    suu: float,
    suv: float,
    svv: float,
    sur: float,
    svr: float,
    srr: float,
    stride: int,
) -> tuple[float, float, float, float]:
    """A plane (see `_no_planes`) by least squares from the sums of 1, x, y, r, x x, x y, y y, x r, y r, r r over a window.

    One over the variance is 0 if the pixels are too few or lie along a line.
    """
    suu, suv, svv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
    sur, svr, srr = sur - su * sr / n, svr - sv * sr / n, srr - sr * sr / n
    half, det = (suu + svv) / 2, suu * svv - suv * suv
    thin = half - np.sqrt(max(half * half - det, 0.0))
    is_plane = (n >= MIN_SAMPLES) & (thin >= MIN_SPREAD * stride * stride * n)
    b, c = (svv * sur - suv * svr) / det, (suu * svr - suv * sur) / det
    precision = 1.0 / (max(srr - b * sur - c * svr, 0.0) / (n - 3) + ROUNDING)
    return (sr - b * su - c * sv) / n, b, c, precision if is_plane else 0.0


@njit(cache=True, error_model="numpy")
def _back_project(
    depth: Array,
    wide: Array,
    narrow: Array,
    stride: int,
    good: float,
    camera: Array,
    points: Array,
    normals: Array,
) -> int:
    """Fill the first rows, whose number is returned, of points and normals (n, 3), camera frame, row by row of pixels.

    A pixel has the normal of the wide window around it where that has a variance below `good` (1/m^2): there, on a plane or
    a gently curved surface, averaging over more pixels is right. Elsewhere it has that of the best of the narrow windows that
    contain it, which are fitted as needed.
    """
    height, width = depth.shape
    rows, _, columns = wide.shape
    n = 0
    for v in range(height):
        y = (v + 0.5 - camera[3]) / camera[1]
        i = (v + stride // 2) // stride
        for u in range(width):
            z = float(depth[v, u])
            if z <= 0:
                continue
            x, r = (u + 0.5 - camera[2]) / camera[0], 1 / z
            j = (u + stride // 2) // stride
            planes, best_i, best_j = wide, min(i, rows - 1), min(j, columns - 1)
            is_good = wide[best_i, 3, best_j] * (good + RESIDUAL_FLOOR * RESIDUAL_FLOOR * r * r * r * r) > 1
            if not (is_good and _is_near(wide, best_i, best_j, v, u, stride, r, x, y, camera)):
                planes, best = narrow, 0.0
                for near_i in range(max(i - 1, 0), min(i + 2, rows)):
                    for near_j in range(max(j - 1, 0), min(j + 2, columns)):
                        if narrow[near_i, 3, near_j] == 0:
                            _fit_narrow(depth, near_i, near_j, stride, narrow)
                        precision = narrow[near_i, 3, near_j]
                        if precision > best and _is_near(narrow, near_i, near_j, v, u, stride, r, x, y, camera):
                            best, best_i, best_j = precision, near_i, near_j
                if best == 0:
                    continue
            a, b, c = _plane(planes, best_i, best_j, v, u, stride, x, y, camera)
            scale = -1 / np.sqrt(a * a + b * b + c * c)
            points[n, 0], points[n, 1], points[n, 2] = x * z, y * z, z
            normals[n, 0], normals[n, 1], normals[n, 2] = a * scale, b * scale, c * scale
            n += 1
    return n


@njit(cache=True)
def _plane(
    planes: Array, i: int, j: int, v: int, u: int, stride: int, x: float, y: float, camera: Array
) -> tuple[float, float, float]:
    """n of a fitted plane n . X = 1, camera frame, as the pixel (v, u) with the ray (x, y, 1) sees it.

    Such a plane has the inverse depth n . (x, y, 1), so its slopes are n / f.
    """
    fitted = planes[i, 0, j] + planes[i, 1, j] * (u - j * stride) + planes[i, 2, j] * (v - i * stride)
    a, b = planes[i, 1, j] * camera[0], planes[i, 2, j] * camera[1]
    return a, b, fitted - x * a - y * b


@njit(cache=True)
def _is_near(planes: Array, i: int, j: int, v: int, u: int, stride: int, r: float, x: float, y: float, camera: Array) -> bool:
    """Whether a pixel (see `_plane`), r = 1 / z, is close to a fitted plane, whose distance from the camera is 1 / |n|."""
    a, b, c = _plane(planes, i, j, v, u, stride, x, y, camera)
    off, square = r - (x * a + y * b + c), a * a + b * b + c * c
    return bool((off * off <= MAX_OFF_PLANE * MAX_OFF_PLANE * square * r * r) & (square > 0))


@njit(cache=True)
def _voxel_sums(
    points: Array,
    normals: Array,
    T_world_camera: Array,
    view: int,
    voxel: float,
    m: int,
    table: Array,
    keys: Array,
    sums: Array,
    counts: Array,
) -> tuple[int, Array]:
    """Add one view to the m rows of occupied voxels, and return how many rows there are then, and the table.

    Args:
        points, normals: (n, 3) raw points of the view, camera frame.
        T_world_camera: (4, 4) its pose.
        view: Its number.
        voxel: Edge, m.
        m: Rows that are filled.
        table: A power of two of slots for open addressing, at most half of them taken: one more than the row of the voxel
            hashed there, 0 where there is none.
        keys: Numbers of the voxels, that sort by x, then y, then z.
        sums: (rows, 6) sums of points and normals, world frame.
        counts: (rows, V) number of raw points of each view.
    """
    T, cells = T_world_camera, 1 / voxel
    row, last = 0, np.int64(-1)
    for i in range(len(points)):
        a, b, c = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        key = (
            (np.int64(np.floor(x * cells) + MIDDLE) << 42)
            + (np.int64(np.floor(y * cells) + MIDDLE) << 21)
            + np.int64(np.floor(z * cells) + MIDDLE)
        )
        if key != last:  # neighbouring pixels often share a voxel
            if 2 * m >= len(table):
                table = _larger_table(keys[:m], 4 * len(table))
            slot = _slot(key, keys, table)
            if table[slot] == 0:
                keys[m] = key
                m += 1
                table[slot] = m
            row, last = table[slot] - 1, key
        sums[row, 0] += x
        sums[row, 1] += y
        sums[row, 2] += z
        a, b, c = float(normals[i, 0]), float(normals[i, 1]), float(normals[i, 2])
        for k in range(3):
            sums[row, 3 + k] += T[k, 0] * a + T[k, 1] * b + T[k, 2] * c
        counts[row, view] += 1
    return m, table


@njit(cache=True)
def _slot(key: Any, keys: Array, table: Array) -> int:
    """Where a voxel is in the table, or belongs."""
    slot: int = (key * 0x5851F42D4C957F2D >> 20) & (len(table) - 1)
    while table[slot] > 0 and keys[table[slot] - 1] != key:
        slot = (slot + 1) & (len(table) - 1)
    return slot


@njit(cache=True)
def _larger_table(keys: Array, slots: int) -> Array:
    """A table of these voxels, row by row."""
    table = np.zeros(slots, np.int32)
    for row in range(len(keys)):
        table[_slot(keys[row], keys, table)] = row + 1
    return table


@njit(cache=True)
def _means(order: Array, sums: Array, counts: Array) -> tuple[Array, Array, Array]:
    """Mean points, unit mean normals and busiest views of the voxels in the given order, without those whose normals cancel."""
    points, normals = np.zeros((len(order), 3), np.float32), np.zeros((len(order), 3), np.float32)
    view = np.zeros(len(order), np.uint8)
    n = 0
    for row in order:
        total = counts[row].sum()
        length = np.sqrt(sums[row, 3] ** 2 + sums[row, 4] ** 2 + sums[row, 5] ** 2)
        if length <= MIN_AGREEMENT * total:
            continue
        for k in range(3):
            points[n, k] = sums[row, k] / total
            normals[n, k] = sums[row, 3 + k] / length
        view[n] = counts[row].argmax()
        n += 1
    return points[:n].copy(), normals[:n].copy(), view[:n].copy()
