"""Points -> superpoints: small groups of neighbouring points with like normals, close to a wanted number.

`slic` (default) is k-means in position, normal and distance from the superpoint's plane, seeded by a grid, with a search
limited to the neighbourhood (Achanta et al., SLIC superpixels, PAMI 2012, carried over to points with normals).
`voxel` stops after the seeds: cubes, split by the main direction of the normals; faster, and less pure.
Either way the grid's cell is adapted until the number of seeds is right, because shelves differ a lot in surface.
Considered and not taken: graph methods (region growing, cut pursuit), whose neighbour search alone costs more than all
of this, and farthest-point sampling, whose groups straddle edges.

The grid starts at the cloud's lower corner and is turned with its walls, so that moving the world by any translation or
turn about z leaves the superpoints as they are, but for rounding.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from dapdata.config import Section, key
from dapdata.records import Cloud, Rejected, Superpoints

if TYPE_CHECKING:
    from dapdata.records import Array


class SuperpointsConfig(Section):
    """How finely the clouds are divided into superpoints."""

    method: Literal["slic", "voxel"] = key("slic", "slic: purer groups of even size; voxel: faster")
    count: int = key(384, "wanted superpoints of the container, met within 10 %; larger: finer", ge=1, le=20_000)
    object_count: int = key(32, "wanted superpoints of the object, met within 10 %", ge=1, le=20_000)
    iterations: int = key(4, "rounds of slic", ge=1, le=50)
    normal_weight: float = key(
        1.5, "what a right angle between normals weighs, in cells of distance; larger: purer, more ragged", ge=0, le=20
    )
    plane_weight: float = key(2.0, "what a cell of distance from the superpoint's plane weighs; larger: flatter", ge=0, le=20)


def cluster(cloud: Cloud, config: SuperpointsConfig) -> Superpoints | Rejected:
    """Both clouds divided into superpoints; rejected if one of the clouds is empty.

    Raises:
        MissingExtraError: numba is not installed.
    """
    from dapdata.errors import require

    require("numba", "sim")
    if len(cloud.container_points) == 0 or len(cloud.object_points) == 0:
        return Rejected("empty_cloud")
    container = partition(cloud.container_points, cloud.container_normals, config.count, config)
    object_ = partition(cloud.object_points, cloud.object_normals, config.object_count, config)
    container_mean = means(cloud.container_points, cloud.container_normals, container)
    object_mean = means(cloud.object_points, cloud.object_normals, object_)
    return Superpoints(
        container_superpoint=container,
        object_superpoint=object_,
        container_superpoint_points=container_mean[0],
        container_superpoint_normals=container_mean[1],
        container_superpoint_size=container_mean[2],
        object_superpoint_points=object_mean[0],
        object_superpoint_normals=object_mean[1],
        object_superpoint_size=object_mean[2],
    )


def partition(points: Array, normals: Array, count: int, config: SuperpointsConfig) -> Array:
    """(N,) i4 superpoint of each point, counted from 0 without holes.

    Args:
        points: (N, 3), m; N >= 1.
        normals: (N, 3), unit.
        count: Wanted number; with N <= count every point is its own superpoint.
        config: Method and weights.
    """
    if len(points) <= count:
        return np.arange(len(points), dtype=np.int32)
    from dapdata.slic import assign, seed_groups

    turn = wall_alignment(normals)
    normals = normals.astype(float) @ turn
    local = (points.astype(float) - points.mean(0, dtype=float)) @ turn
    local -= local.min(0)
    group, cell = seed_groups(local, normals, count)
    rounds = config.iterations if config.method == "slic" else 0
    label = assign(local, normals, group, cell, config.normal_weight, config.plane_weight, rounds)
    return np.unique(label, return_inverse=True)[1].astype(np.int32)


def wall_alignment(normals: Array) -> Array:
    """(3, 3) turn about z whose x and y axes run along most of the horizontal normals (N, 3), modulo a right angle."""
    # Fourfold angles of perpendicular walls agree, so that their mean is the direction of all of them.
    fourfold = np.sum((normals[:, 0].astype(float) + 1j * normals[:, 1]) ** 4)
    c, s = np.cos(np.angle(fourfold) / 4), np.sin(np.angle(fourfold) / 4)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def means(points: Array, normals: Array, superpoint: Array) -> tuple[Array, Array, Array]:
    """(S, 3) f4 mean points, (S, 3) f4 unit mean normals, (S,) i4 sizes of superpoints 0..S-1, all of them occupied.

    Where the normals cancel, the first point's normal stands in for their mean.
    """
    from dapdata.slic import group_means

    num = int(superpoint.max()) + 1
    point, normal, size = group_means(points.astype(float), normals.astype(float), superpoint.astype(np.int64), num, 1)
    cancelled = np.flatnonzero(~normal.any(1))
    if len(cancelled):
        normal[cancelled] = normals[np.unique(superpoint, return_index=True)[1][cancelled]]
    return point.astype(np.float32), normal.astype(np.float32), size.astype(np.int32)
