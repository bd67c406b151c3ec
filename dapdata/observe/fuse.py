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
NOISE_MARGIN = 1.5  # a window is good up to this many times the image's median variance, too


@dataclass(frozen=True)
class Fused:
    """A voxelled cloud. N points, ordered by voxel."""

    points: Array  # (N, 3) f4, world, m, mean of the raw points in each voxel
    normals: Array  # (N, 3) f4, unit, world, mean of the raw normals
    view: Array  # (N,) u1, view with most raw points in the voxel


def view_cloud(depth: Array, view: View) -> tuple[Array, Array]:
    """(n, 3) points and (n, 3) unit normals toward the sensor, world frame, f4, of the pixels that have both."""
    camera = np.array([view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]])
    stride = max(1, round(len(depth) / FIT_ROWS))
    height, width = depth.shape
    rows, columns = -(-height // stride), -(-width // stride)
    # Made by numpy: its zeros cost nothing where they are not touched.
    wide, narrow, sums = np.zeros((rows, columns, 4)), np.zeros((rows, columns, 4)), np.zeros((height, columns, 6))
    _fit_wide(depth, stride, sums, wide)
    precision = wide[::2, ::2, 3]
    fitted = precision[precision > 0]
    good = NOISE_MARGIN / float(np.median(fitted)) if len(fitted) else 0.0
    size = np.count_nonzero(depth)
    points, normals = np.zeros((size, 3), np.float32), np.zeros((size, 3), np.float32)
    n = _back_project(depth, wide, narrow, stride, good, camera, np.ascontiguousarray(view.T_world_camera), points, normals)
    return points[:n], normals[:n]


def fuse(points: list[Array], normals: list[Array], voxel: float) -> Fused:
    """One point per occupied voxel of edge `voxel` (m) from the (n, 3) f4 points and normals of each view."""
    n = sum(len(p) for p in points)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for p in points:
        _widen(p, voxel, low, high)
    # Made by numpy: its zeros cost nothing where they are not touched, and there are far fewer voxels than points.
    keys, sums, counts = np.zeros(n, np.int64), np.zeros((n, 6)), np.zeros((n, len(points)), np.int32)
    table = np.zeros(2 << n.bit_length(), np.int32)
    m = 0
    for view in range(len(points)):
        m = _voxel_sums(points[view], normals[view], view, voxel, low, high - low + 1, m, table, keys, sums, counts)
    return Fused(*_means(np.argsort(keys[:m]), sums, counts))


@njit(cache=True)
def _fit_wide(depth: Array, stride: int, sums: Array, planes: Array) -> None:
    """Fit 1 / z over squares of 4 stride + 1 px around every stride-th pixel.

    Args:
        depth: (H, W), m; 0 for none.
        stride: Distance of the fits, px.
        sums: (H, ceil(W / stride), 6) zeros, for the sums over the rows of the windows.
        planes: (ceil(H / stride), ceil(W / stride), 4) zeros, get the fitted 1 / z at the middle (1/m), its slopes along
            u and v (1/m/px), and one over the variance of the residuals (m^2); these stay 0 where there is no fit.
    """
    radius = 2 * stride
    top, bottom, left, right = _occupied(depth)
    first, last = max((left - radius) // stride, 0), min((right + radius) // stride + 1, planes.shape[1])
    _row_sums(depth, stride, radius, top, bottom, first, last, sums)
    for i in range(max((top - radius) // stride, 0), min((bottom + radius) // stride + 1, planes.shape[0])):
        for j in range(first, last):
            _fit_from_rows(sums, i, j, stride, radius, top, bottom, planes)


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


@njit(cache=True)
def _row_sums(depth: Array, stride: int, radius: int, top: int, bottom: int, first: int, last: int, sums: Array) -> None:
    """Fill sums with those of 1, x, r, x^2, x r, r^2 over the pixels u + x of a row, |x| <= radius; r is 1 / z."""
    width = depth.shape[1]
    for v in range(top, bottom + 1):
        for j in range(first, last):
            n, su, sr, suu, sur, srr = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            u = j * stride
            for column in range(max(u - radius, 0), min(u + radius + 1, width)):
                z = depth[v, column]
                if z > 0:
                    x, r = float(column - u), 1.0 / z
                    n += 1.0
                    su += x
                    sr += r
                    suu += x * x
                    sur += x * r
                    srr += r * r
            sums[v, j, 0], sums[v, j, 1], sums[v, j, 2] = n, su, sr
            sums[v, j, 3], sums[v, j, 4], sums[v, j, 5] = suu, sur, srr


@njit(cache=True)
def _fit_from_rows(sums: Array, i: int, j: int, stride: int, radius: int, top: int, bottom: int, planes: Array) -> None:
    """Fill planes[i, j] from the row sums around it."""
    n, su, sv, sr, suu, suv, svv, sur, svr, srr = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for row in range(max(i * stride - radius, top), min(i * stride + radius, bottom) + 1):
        y = float(row - i * stride)
        n_row, su_row, sr_row = sums[row, j, 0], sums[row, j, 1], sums[row, j, 2]
        n += n_row
        su += su_row
        sv += y * n_row
        sr += sr_row
        suu += sums[row, j, 3]
        suv += y * su_row
        svv += y * y * n_row
        sur += sums[row, j, 4]
        svr += y * sr_row
        srr += sums[row, j, 5]
    _solve(n, su, sv, sr, suu, suv, svv, sur, svr, srr, stride, i, j, planes)


@njit(cache=True)
def _fit_narrow(depth: Array, i: int, j: int, stride: int, planes: Array) -> None:
    """Fill planes[i, j] from the square of 2 stride + 1 px around it; one over the variance is -1 where there is no fit."""
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
    planes[i, j, 3] = -1.0
    _solve(n, su, sv, sr, suu, suv, svv, sur, svr, srr, stride, i, j, planes)


@njit(cache=True)
def _solve(
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
    i: int,
    j: int,
    planes: Array,
) -> None:
    """Fill planes[i, j] by least squares from the sums of 1, x, y, r, x x, x y, y y, x r, y r, r r over a window's pixels.

    Left alone if the pixels are too few or lie along a line.
    """
    if n < MIN_SAMPLES:
        return
    suu, suv, svv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
    sur, svr, srr = sur - su * sr / n, svr - sv * sr / n, srr - sr * sr / n
    half, det = (suu + svv) / 2, suu * svv - suv * suv
    if half - np.sqrt(max(half * half - det, 0.0)) < MIN_SPREAD * stride * stride * n:
        return
    b, c = (svv * sur - suv * svr) / det, (suu * svr - suv * sur) / det
    planes[i, j, 0] = (sr - b * su - c * sv) / n
    planes[i, j, 1] = b
    planes[i, j, 2] = c
    planes[i, j, 3] = 1.0 / (max(srr - b * sur - c * svr, 0.0) / (n - 3) + ROUNDING)


@njit(cache=True)
def _back_project(
    depth: Array,
    wide: Array,
    narrow: Array,
    stride: int,
    good: float,
    camera: Array,
    T_world_camera: Array,
    points: Array,
    normals: Array,
) -> int:
    """Fill the first rows, whose number is returned, of points and normals (n, 3), world frame, row by row of pixels."""
    height, width = depth.shape
    n = 0
    normal = np.zeros(3)
    T = T_world_camera
    step_x, step_y = 1 / camera[0], 1 / camera[1]
    for v in range(height):
        y = (v + 0.5 - camera[3]) * step_y
        for u in range(width):
            z = float(depth[v, u])
            if z <= 0:
                continue
            x = (u + 0.5 - camera[2]) * step_x
            if not _choose_normal(depth, wide, narrow, v, u, stride, good, 1 / z, x, y, camera, normal):
                continue
            for k in range(3):
                points[n, k] = (T[k, 0] * x + T[k, 1] * y + T[k, 2]) * z + T[k, 3]
                normals[n, k] = T[k, 0] * normal[0] + T[k, 1] * normal[1] + T[k, 2] * normal[2]
            n += 1
    return n


@njit(cache=True)
def _choose_normal(
    depth: Array,
    wide: Array,
    narrow: Array,
    v: int,
    u: int,
    stride: int,
    good: float,
    r: float,
    x: float,
    y: float,
    camera: Array,
    normal: Array,
) -> bool:
    """Fill the unit normal, camera frame, of the best window around pixel (v, u), 1 / z = r; False when none fits.

    That is the wide window around the pixel where its variance is below `good` (1/m^2): there, on a plane or a gently
    curved surface, averaging over more pixels is right. Elsewhere it is the best of the narrow windows that contain the
    pixel, which are fitted as needed.
    """
    i0, j0 = (v + stride // 2) // stride, (u + stride // 2) // stride
    i, j = min(i0, wide.shape[0] - 1), min(j0, wide.shape[1] - 1)
    limit = good + RESIDUAL_FLOOR * RESIDUAL_FLOOR * r * r * r * r
    if wide[i, j, 3] * limit > 1 and _plane_at(wide, i, j, v, u, stride, r, x, y, camera, normal):
        return True
    best = 0.0
    for i in range(max(i0 - 1, 0), min(i0 + 2, narrow.shape[0])):
        for j in range(max(j0 - 1, 0), min(j0 + 2, narrow.shape[1])):
            if narrow[i, j, 3] == 0:
                _fit_narrow(depth, i, j, stride, narrow)
            if narrow[i, j, 3] > best and _plane_at(narrow, i, j, v, u, stride, r, x, y, camera, normal):
                best = narrow[i, j, 3]
    return best > 0


@njit(cache=True)
def _plane_at(
    planes: Array, i: int, j: int, v: int, u: int, stride: int, r: float, x: float, y: float, camera: Array, normal: Array
) -> bool:
    """Fill the unit normal, toward the camera, of a fit, unless pixel (v, u), 1 / z = r, ray (x, y, 1), is off its plane.

    A plane n . X = 1 has the inverse depth n . (x, y, 1), so its slopes are n / f, and its distance from the camera is one
    over the length of n.
    """
    b, c = planes[i, j, 1], planes[i, j, 2]
    fitted = planes[i, j, 0] + b * (u - j * stride) + c * (v - i * stride)
    nx, ny = b * camera[0], c * camera[1]
    nz = fitted - x * nx - y * ny
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    if abs(r - fitted) > MAX_OFF_PLANE * length * r or length == 0:
        return False
    scale = -1 / length
    normal[0], normal[1], normal[2] = nx * scale, ny * scale, nz * scale
    return True


@njit(cache=True)
def _widen(points: Array, voxel: float, low: Array, high: Array) -> None:
    """Widen the range of voxels (3,) .. (3,) to that of the points; numpy's own minimum over short rows is slow."""
    for i in range(len(points)):
        for k in range(3):
            cell = np.floor(points[i, k] / voxel)
            low[k], high[k] = min(low[k], cell), max(high[k], cell)


@njit(cache=True)
def _voxel_sums(
    points: Array,
    normals: Array,
    view: int,
    voxel: float,
    low: Array,
    span: Array,
    m: int,
    table: Array,
    keys: Array,
    sums: Array,
    counts: Array,
) -> int:
    """Add one view to the m rows of occupied voxels, and return how many rows there are then.

    Args:
        points, normals: (n, 3) raw points of the view.
        view: Its number.
        voxel: Edge, m.
        low, span: (3,) first voxel and number of voxels along each axis.
        m: Rows that are filled.
        table: A power of two of slots, at least twice the raw points of all views, for open addressing: one more than
            the row of the voxel hashed there, 0 where there is none.
        keys: Numbers of the voxels, that sort by x, then y, then z.
        sums: (rows, 6) sums of points and normals.
        counts: (rows, V) number of raw points of each view.
    """
    span_y, span_z = int(span[1]), int(span[2])
    row, last = 0, -1
    for i in range(len(points)):
        x, y, z = np.floor(points[i, 0] / voxel), np.floor(points[i, 1] / voxel), np.floor(points[i, 2] / voxel)
        key = (int(x - low[0]) * span_y + int(y - low[1])) * span_z + int(z - low[2])
        if key != last:  # neighbouring pixels often share a voxel
            slot = (key * 0x5851F42D4C957F2D >> 20) & (len(table) - 1)
            while table[slot] > 0 and keys[table[slot] - 1] != key:
                slot = (slot + 1) & (len(table) - 1)
            if table[slot] == 0:
                keys[m] = key
                m += 1
                table[slot] = m
            row, last = table[slot] - 1, key
        for k in range(3):
            sums[row, k] += points[i, k]
            sums[row, 3 + k] += normals[i, k]
        counts[row, view] += 1
    return m


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
