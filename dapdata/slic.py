"""The kernels of `cluster`: seeds on a grid whose cell is adapted to a wanted count, and local k-means."""

from __future__ import annotations

import numpy as np
from numba import njit

from dapdata.records import Array

MIN_SEED_POINTS = 4  # a group with fewer points is a sliver of a cell at an edge, unless nearly all groups are that small
MAX_STEPS = 16  # cell sizes that are tried
CLOSE_ENOUGH = 1.02  # stop when there are at most this many times the wanted seeds; the rest is left out
ROUND_POINTS = 20  # points a seed that rounds of k-means before the last use; they take fewer of larger clouds
MAX_CELLS = 128  # along each axis of the search grid, so that stray points cost no memory


def seed_groups(points: Array, normals: Array, count: int) -> tuple[Array, float]:
    """Groups of points that share a cell of a grid and the main direction of their normals (one of six).

    The cell is fitted (a guess from the last one, bisection where that leaves the bracket) until it gives `count` groups
    of some size or slightly more; the smallest groups are then left out until `count` are left.

    Args:
        points: (N, 3) f8, m, with the lower corner of the cloud at the origin; N > count.
        normals: (N, 3) f8, unit.
        count: Wanted number of groups.

    Returns:
        (N,) i8 group of each point, -1 for points without, and the cell's edge, m.
    """
    direction = np.argmax(np.abs(normals), axis=1)
    direction = 2 * direction + (np.take_along_axis(normals, direction[:, None], 1)[:, 0] < 0)
    min_points = min(MIN_SEED_POINTS, max(1, len(points) // (4 * count)))
    small, large = 0.0, 2 * float(points.max()) + 1e-6
    cell = large / (2 * np.sqrt(count))
    for _ in range(MAX_STEPS):
        size = _group(points, direction, cell)[1]
        groups = int((size >= min_points).sum())
        # In very small cells nearly all groups are slivers, so few count.
        too_small = groups >= count or len(points) < 1.5 * min_points * len(size)
        small, large = (cell, large) if too_small else (small, cell)
        if count <= groups <= CLOSE_ENOUGH * count:
            break
        # Surfaces: the number of cells goes with one over the square of their edge.
        guess = cell * np.sqrt((max(groups, len(size) if too_small else 0) + 1) / (CLOSE_ENOUGH * count))
        cell = guess if small < guess < large else (small + large) / 2
    small = small or large
    group, size = _group(points, direction, small)
    keep = np.sort(np.argsort(-size, kind="stable")[:count])
    new = np.full(len(size), -1)
    new[keep] = np.arange(len(keep))
    return new[group], small


@njit(cache=True)
def _group(points: Array, direction: Array, cell: float) -> tuple[Array, Array]:
    """(N,) group of each point by cell and direction, numbered as they come, and (G,) sizes."""
    n = len(points)
    slots = 4
    while slots < 2 * n:
        slots *= 2
    keys, owner = np.zeros(slots, np.int64), np.full(slots, -1, np.int64)
    group, size = np.zeros(n, np.int64), np.zeros(n, np.int64)
    num = 0
    for i in range(n):
        x, y, z = int(points[i, 0] / cell), int(points[i, 1] / cell), int(points[i, 2] / cell)
        key = (((x << 18) + y << 18) + z << 3) + direction[i]
        slot = (key * 0x5851F42D4C957F2D >> 20) & (slots - 1)
        while owner[slot] >= 0 and keys[slot] != key:
            slot = (slot + 1) & (slots - 1)
        if owner[slot] < 0:
            keys[slot], owner[slot] = key, num
            num += 1
        group[i] = owner[slot]
        size[owner[slot]] += 1
    return group, size[:num].copy()


@njit(cache=True)
def assign(
    points: Array, normals: Array, group: Array, cell: float, normal_weight: float, plane_weight: float, rounds: int
) -> Array:
    """(N,) i8 seed of each point after some rounds of k-means that starts with the given groups.

    With p, n of a point, q, m of a seed: distance^2 = |p - q|^2 / cell^2 + normal_weight^2 (1 - n.m)
    + plane_weight^2 (m.(p - q))^2 / cell^2. Without rounds only the points without a group are assigned. In large clouds
    all rounds but the last go over every 2nd, 3rd, ... point only.

    Args:
        points: (N, 3) f8, m, with the lower corner of the cloud at the origin.
        normals: (N, 3) f8, unit.
        group: (N,) i8, -1 for none.
        cell: Distance of the seeds, m: only seeds of the neighbouring cells are looked at, if they have any.
        normal_weight, plane_weight, rounds: See above.
    """
    label = group.copy()
    num = group.max() + 1
    weights = (1 / (cell * cell), normal_weight * normal_weight, plane_weight * plane_weight / (cell * cell))
    span = max(points[:, 0].max(), points[:, 1].max(), points[:, 2].max())
    edge = max(cell, span / (MAX_CELLS - 1))
    step = 1
    for k in range(max(rounds, 1)):
        seed_points, seed_normals, _ = group_means(points, normals, label, num, step)
        step = 1 if k >= rounds - 1 else max(1, len(points) // (ROUND_POINTS * num))
        seeds = np.hstack((seed_points, seed_normals))
        head, following = _seed_grid(seed_points, edge, int(span / edge) + 1)
        for i in range(0, len(points), step):
            if rounds > 0 or label[i] < 0:
                label[i] = _nearest(points[i], normals[i], label[i], seeds, head, following, edge, weights)
    return label


@njit(cache=True)
def group_means(points: Array, normals: Array, label: Array, num: int, step: int) -> tuple[Array, Array, Array]:
    """(K, 3) mean points (NaN for an empty group), (K, 3) unit mean normals (0 where they cancel) and (K,) i8 sizes of groups.

    Args:
        points, normals: (N, 3) f8.
        label: (N,) group of each point, -1 for none.
        num: K.
        step: Only every step-th point counts.
    """
    mean, normal, size = np.zeros((num, 3)), np.zeros((num, 3)), np.zeros(num, np.int64)
    for i in range(0, len(points), step):
        s = label[i]
        if s >= 0:
            size[s] += 1
            for k in range(3):
                mean[s, k] += points[i, k]
                normal[s, k] += normals[i, k]
    for s in range(num):
        length = np.sqrt(normal[s, 0] ** 2 + normal[s, 1] ** 2 + normal[s, 2] ** 2)
        for k in range(3):
            mean[s, k] = mean[s, k] / size[s] if size[s] > 0 else np.nan
            normal[s, k] = normal[s, k] / length if length > 1e-6 * size[s] else 0.0
    return mean, normal, size


@njit(cache=True)
def _seed_grid(seed_points: Array, edge: float, cells: int) -> tuple[Array, Array]:
    """Linked lists of the seeds in each cell: (cells, cells, cells) first seed and (K,) seed that follows; -1 ends."""
    head = np.full((cells, cells, cells), -1, np.int32)
    following = np.full(len(seed_points), -1, np.int32)
    for s in range(len(seed_points) - 1, -1, -1):
        if seed_points[s, 0] >= 0:  # not NaN
            x, y, z = int(seed_points[s, 0] / edge), int(seed_points[s, 1] / edge), int(seed_points[s, 2] / edge)
            following[s] = head[x, y, z]
            head[x, y, z] = s
    return head, following


@njit(cache=True, error_model="numpy")
def _nearest(
    point: Array,
    normal: Array,
    guess: int,
    seeds: Array,
    head: Array,
    following: Array,
    edge: float,
    weights: tuple[float, float, float],
) -> int:
    """The nearest seed of a point: the guess (unless -1) or one in the 27 cells around; among all if there is none."""
    x, y, z = point[0], point[1], point[2]
    own = (x, y, z, normal[0], normal[1], normal[2])
    cells = head.shape[0]
    cx, cy, cz = int(x / edge), int(y / edge), int(z / edge)
    nearest = guess
    best = _distance(own, seeds[guess], weights) if guess >= 0 else np.inf
    if not best < np.inf:
        best, nearest = np.inf, -1
    for dx in (0, -1, 1):
        far_x = _outside(x, cx, dx, edge) * weights[0]
        if not 0 <= cx + dx < cells or far_x >= best:
            continue
        for dy in (0, -1, 1):
            far_xy = far_x + _outside(y, cy, dy, edge) * weights[0]
            if not 0 <= cy + dy < cells or far_xy >= best:
                continue
            for dz in (0, -1, 1):
                if not 0 <= cz + dz < cells or far_xy + _outside(z, cz, dz, edge) * weights[0] >= best:
                    continue
                s = head[cx + dx, cy + dy, cz + dz]
                while s >= 0:
                    d = _distance(own, seeds[s], weights)
                    if d < best or (d == best and s < nearest):
                        best, nearest = d, s
                    s = following[s]
    if nearest < 0:
        for s in range(len(seeds)):
            d = _distance(own, seeds[s], weights)
            if d < best:
                best, nearest = d, s
    return nearest


@njit(cache=True, inline="always")
def _outside(p: float, c: int, step: int, edge: float) -> float:
    """Squared distance along one axis from p, in cell c, to the neighbouring cell c + step."""
    if step < 0:
        return (p - c * edge) ** 2
    return ((c + 1) * edge - p) ** 2 if step > 0 else 0.0


@njit(cache=True)
def _distance(own: tuple[float, float, float, float, float, float], seed: Array, weights: tuple[float, float, float]) -> float:
    """Squared distance, in cells, of a point and a seed (6,), each with its normal; NaN for an empty seed."""
    d0, d1, d2 = own[0] - seed[0], own[1] - seed[1], own[2] - seed[2]
    m0, m1, m2 = seed[3], seed[4], seed[5]
    off = m0 * d0 + m1 * d1 + m2 * d2
    turned = 1.0 - (own[3] * m0 + own[4] * m1 + own[5] * m2)
    return float((d0 * d0 + d1 * d1 + d2 * d2) * weights[0] + turned * weights[1] + off * off * weights[2])
