"""From a demo of RPDiff to clouds of ours: put back into depth images, given normals, fused.

A point of RPDiff lies on a pixel of its camera, to 1e-4 px, so that the depth images that it was projected from come back
as they were, and normals, views and voxels are made as for our own data. RPDiff projects pixel (u, v) through its corner
though it was rendered through its centre; moved to the centre, its containers are 0.1 mm off their meshes in the median
instead of 0.7 mm (measured on seven demos of its own generator).

Points that are on no pixel (of another generator, or thinned out) keep the normals that come with them, or get those of
the planes through their nearest points, turned to the camera that sees them most squarely.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata.config import RpdiffConfig
from dapdata.interop.normals import by_camera, estimated_normals, project
from dapdata.interop.rpdiff_files import Bodies, Fault, Raw, check, on_table, own, read_fields, rejected
from dapdata.observe import CamerasConfig
from dapdata.records import Cloud, Demo, Rejected

Array = NDArray[Any]

ON_PIXEL = 1e-3  # px: points of a depth image are projected back onto its pixels to less than this
HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # px, added to intrinsics
MAX_IMAGE = 4096  # px


def observe(config: RpdiffConfig, cameras: CamerasConfig, demo: Demo) -> Cloud | Rejected:
    """The clouds of a demo of the source, fused as our own; of the cameras only voxels and least numbers are used."""
    number = int(demo.demo)
    try:
        found = read_fields(config, number)
        if "dapdata" in found:
            cloud_as_exported: Cloud = own(found["dapdata"], Cloud)
            return cloud_as_exported
        raw = check(found, config.table_height)
        normals = raw.normals or Bodies(None, None)
        container = _fused(raw.points.parent, normals.parent, raw, config, cameras.container_voxel)
        object_ = _fused(raw.points.child, normals.child, raw, config, cameras.object_voxel)
        for points, least, body in (
            (container[0], cameras.min_container_points, "container"),
            (object_[0], cameras.min_object_points, "object"),
        ):
            if len(points) < least:
                raise Fault(f"too_few_{body}_points", f"{len(points)} when fused, expected {least}")
    except Fault as fault:
        return rejected(config, number, fault)
    T_world_camera = np.array([on_table(T, config) for T in raw.T_world_camera]).reshape(-1, 4, 4)
    return Cloud(
        **{f"container_{name}": array for name, array in zip(("points", "normals", "view"), container)},
        **{f"object_{name}": array for name, array in zip(("points", "normals", "view"), object_)},
        camera_K=np.concatenate([raw.K, raw.K]),
        T_world_camera=np.concatenate([T_world_camera, T_world_camera]),
    )


def at_pixel_centres(points: Array, raw: Raw, config: RpdiffConfig) -> Array:
    """(N, 3) the points of one body's cloud where `observe` has them before fusing, in the source's world."""
    views = _depth_views(points, raw, config)
    return points if views is None else np.concatenate([found for found, _ in views])


def _fused(points: Array, normals: Array | None, raw: Raw, config: RpdiffConfig, voxel: float) -> tuple[Array, Array, Array]:
    """Points (n, 3), normals (n, 3) and views (n,) of one body's cloud, voxelled."""
    from dapdata.observe.fuse import fuse

    views = _depth_views(points, raw, config)
    if views is None:
        views = _by_camera(points, normals, raw)
    down = np.array([0, 0, config.table_height])
    fused = fuse([(p - down).astype(np.float32) for p, _ in views], [n.astype(np.float32) for _, n in views], voxel)
    return fused.points, fused.normals, fused.view


def _depth_views(points: Array, raw: Raw, config: RpdiffConfig) -> list[tuple[Array, Array]] | None:
    """Points and normals of each camera's depth image, or None if points are on no pixel.

    A point may lie on pixels of several cameras by chance: it belongs to the one that it is closest to.
    """
    from dapdata.observe.cameras import View
    from dapdata.observe.fuse import view_cloud

    if not len(raw.K):
        return None
    seen = [project(points, K, T) for K, T in zip(raw.K, raw.T_world_camera)]
    for corner in (0.0, 0.5):
        off = np.stack([np.abs(uv - corner - np.round(uv - corner)).max(axis=1) for uv, _ in seen])
        valid = np.stack([(z > 0) & ((uv > -0.5) & (uv < MAX_IMAGE)).all(axis=1) for uv, z in seen])
        off = np.where(valid, off, np.inf)
        if off.min(axis=0).max() <= ON_PIXEL:
            break
    else:
        return None
    owner, views = off.argmin(axis=0), []
    for v, (K, T, (uv, z)) in enumerate(zip(raw.K, raw.T_world_camera, seen)):
        pixel = np.round(uv[owner == v] - corner).astype(int)
        width, height = (int(max(2 * K[k, 2], *pixel[:, k] + 1, 1)) for k in range(2))
        depth = np.full((height, width), np.inf, np.float32)
        np.minimum.at(depth, (pixel[:, 1], pixel[:, 0]), z[owner == v].astype(np.float32))
        # Our pixels are seen through their centres: with the camera as it is, points from corners move there.
        moved = K + HALF_PIXEL if corner == 0 and not config.half_pixel else K
        views.append(view_cloud(np.where(np.isfinite(depth), depth, 0), View(width, height, moved, T, T, 0)))
    return views


def _by_camera(points: Array, normals: Array | None, raw: Raw) -> list[tuple[Array, Array]]:
    """Points and normals toward the sensor by the camera that sees them most squarely; all in one where there are none."""
    if normals is not None:
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        if not (length > 0).all():
            raise Fault("not_finite", "normals of no length")
        normals = normals / length
    if not len(raw.K):
        if normals is None:
            raise Fault("no_normals")
        return [(points, normals)]
    if normals is None:
        if len(points) < 3:
            raise Fault("no_normals")
        normals = estimated_normals(points)
    owner, toward = by_camera(points, normals, raw.K, raw.T_world_camera)
    return [(points[owner == v], toward[owner == v]) for v in range(len(raw.K))]
