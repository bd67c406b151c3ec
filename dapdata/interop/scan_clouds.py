"""From the files of a scanned demonstration to clouds of ours: thinned, with normals, without flyers, views aligned, fused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dapdata.clouds import Points, thin
from dapdata.config import ScansConfig
from dapdata.interop.normals import by_camera, estimated_normals
from dapdata.interop.rpdiff_files import Fault
from dapdata.interop.scan_files import Scan, read, rejected
from dapdata.observe import CamerasConfig
from dapdata.poses import inverse, rotate, transform
from dapdata.records import Cloud, Demo, Rejected

if TYPE_CHECKING:
    from dapdata.observe.fuse import Fused

Array = NDArray[Any]
Where = tuple[str, str]  # stage and body
View = tuple[Array, Array]  # (n, 3) points and (n, 3) unit normals, f8, world

THIN = 0.0015  # m, edge of the cubes to which each view is thinned before anything else
NEIGHBOURS = 30  # points to whose plane a normal is square: more than of clean clouds, as pixels of one view are noisy
WIDE = np.array([[600.0, 0, 1e5], [0, 600, 1e5], [0, 0, 1]])  # px: a camera whose intrinsics nobody told sees all before it
CELL = {"container": 0.02, "object": 0.01}  # m: parts of a body are no farther apart than a cell
CRUMB = {"container": 0.02, "object": 0.1}  # share of the points below which a part is not of the body
FLYERS = 6  # points in a cell and those around it: fewer are flying pixels
INWARDS = -0.1  # mean cosine
MOST_OUTLIERS = 0.2  # share


@dataclass(frozen=True)
class Prepared:
    """The clouds of a demonstration by stage and body, a view for each camera; one view where there are no cameras."""

    views: Mapping[Where, list[View]]
    K: Array  # (V, 3, 3) px
    T_world_camera: Array  # (V, 4, 4), aligned

    def fused(self, stage: str, body: str, voxel: float) -> Fused:
        """A cloud with one point a voxel, as `observe.fuse`."""
        from dapdata.observe.fuse import fuse

        views = self.views[stage, body]
        here = np.broadcast_to(np.eye(4), (len(views), 4, 4))
        return fuse([p.astype(np.float32) for p, _ in views], [n.astype(np.float32) for _, n in views], here, voxel)


def observe(config: ScansConfig, cameras: CamerasConfig, demo: Demo) -> Cloud | Rejected:
    """The clouds before, fused as our own; of the cameras section only voxels and least numbers are used."""
    number = int(demo.demo)
    try:
        prepared = prepare(read(config, number), config)
        container = prepared.fused("start", "container", cameras.container_voxel)
        object_ = prepared.fused("start", "object", cameras.object_voxel)
        for body, points, least in (
            ("container", container.points, cameras.min_container_points),
            ("object", object_.points, cameras.min_object_points),
        ):
            if len(points) < least:
                raise Fault(f"too_few_{body}_points", f"{len(points)} when fused, expected {least}")
    except Fault as fault:
        return rejected(config, number, fault)
    known = ~np.isnan(prepared.K).any(axis=(1, 2)).any()  # a shard holds no camera without intrinsics
    K, T = (prepared.K, prepared.T_world_camera) if known else (np.zeros((0, 3, 3)), np.zeros((0, 4, 4)))
    return Cloud(
        container_points=container.points,
        container_normals=container.normals,
        container_view=container.view,
        object_points=object_.points,
        object_normals=object_.normals,
        object_view=object_.view,
        camera_K=np.concatenate([K, K]),
        T_world_camera=np.concatenate([T, T]),
    )


def prepare(scan: Scan, config: ScansConfig) -> Prepared:
    """The clouds of a scan, ready to be fused.

    Raises:
        Fault: no normals can be told, or a cloud lies about.
    """
    views = {where: _clean(where, _views(where, cloud, scan)) for where, cloud in scan.clouds.items()}
    T_world_camera = scan.T_world_camera
    told = all(cloud.view is not None for cloud in scan.clouds.values())
    if config.align and told and len(scan.K) > 1 and not np.isnan(scan.K).any():
        T_world_camera = _aligned(views, scan)
        for where, found in views.items():
            steps = zip(found, T_world_camera @ inverse(scan.T_world_camera))
            views[where] = [(transform(T, points), rotate(T, normals)) for (points, normals), T in steps]
    return Prepared(views, scan.K, T_world_camera)


def _views(where: Where, cloud: Points, scan: Scan) -> list[View]:
    """The points that each camera saw, thinned, with unit normals toward it."""
    stage, body = where
    count = len(scan.T_world_camera)
    if cloud.normals is None and not count:
        raise Fault("no_normals", f"{stage}, {body}: no normals and no cameras, expected either; add cameras to scan.json")
    rows = [np.arange(len(cloud.points))] if cloud.view is None or not count else [cloud.view == v for v in range(count)]
    thinned = [_thinned(cloud.points[own], None if cloud.normals is None else cloud.normals[own]) for own in rows]
    if not count:
        points, normals = thinned[0]
        if body == "object" and _outwards(points, normals) < INWARDS:
            raise Fault("normals_inwards", f"{stage}, {body}: most normals look inwards, expected outwards; flip them")
        return thinned
    if cloud.view is not None:
        return [(points, _toward(points, normals, T[:3, 3])) for (points, normals), T in zip(thinned, scan.T_world_camera)]
    points, normals = thinned[0]
    K = np.where(np.isnan(scan.K), WIDE, scan.K)
    owner, normals = by_camera(points, normals, K, scan.T_world_camera)
    return [(points[owner == v], normals[owner == v]) for v in range(count)]


def _outwards(points: Array, normals: Array) -> float:
    """Mean cosine between normals and the way from the middle: 1 of a ball, near 0 of a single face, negative if flipped."""
    way = points - points.mean(axis=0)
    return float((np.einsum("ij,ij->i", normals, way) / np.maximum(np.linalg.norm(way, axis=1), 1e-9)).mean())


def _thinned(points: Array, normals: Array | None) -> View:
    """A point for each small cube, with its mean or estimated unit normal; none where there are too few for that."""
    if len(points) < 3:
        return np.zeros((0, 3)), np.zeros((0, 3))
    if normals is None:
        (points,) = thin(THIN, points)
        return (points, estimated_normals(points, NEIGHBOURS)) if len(points) >= 3 else (points[:0], points[:0])
    points, normals = thin(THIN, points, normals)
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-6
    return points[good], normals[good] / length[good, None]


def _toward(points: Array, normals: Array, eye: Array) -> Array:
    """Normals turned to where they were seen from."""
    away = np.einsum("ij,ij->i", normals, eye - points) < 0
    return np.where(away[:, None], -normals, normals)


def _clean(where: Where, views: list[View]) -> list[View]:
    """The views without flying pixels and crumbs.

    Raises:
        Fault: that is more than a fifth of the points.
    """
    stage, body = where
    points = np.concatenate([points for points, _ in views])
    if not len(points):
        raise Fault("empty_mask", f"{stage}, {body}: fewer than 3 points in each view, expected a cloud")
    keep = _is_body(points, CELL[body], CRUMB[body])
    lost = 1 - float(keep.mean())
    if lost > MOST_OUTLIERS:
        raise Fault(
            "scattered",
            f"{stage}, {body}: {lost:.0%} of the points are apart from the rest, expected {MOST_OUTLIERS:.0%} at the most; "
            "look at the mask",
        )
    parts = np.split(keep, np.cumsum([len(points) for points, _ in views])[:-1])
    return [(points[own], normals[own]) for (points, normals), own in zip(views, parts)]


def _is_body(points: Array, edge: float, crumb: float) -> Array:
    """(N,) bool: points with others in and around their cell, in parts (connected cells) with a share of `crumb` at least."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    cells, cell, count = np.unique(np.floor(points / edge), axis=0, return_inverse=True, return_counts=True)
    cell = cell.reshape(-1)
    a, b = cKDTree(cells).query_pairs(1.8, output_type="ndarray").reshape(-1, 2).T
    around = count + np.bincount(a, count[b], len(cells)) + np.bincount(b, count[a], len(cells))
    dense = around >= FLYERS
    both = dense[a] & dense[b]
    links = coo_matrix((np.ones(int(both.sum())), (a[both], b[both])), (len(cells), len(cells)))
    part = connected_components(links, directed=False)[1]
    size = np.bincount(part, count)
    return np.asarray((dense & (size[part] >= crumb * len(points)))[cell])


def _aligned(views: Mapping[Where, list[View]], scan: Scan) -> Array:
    """(V, 4, 4) T_world_camera, corrected until views agree; the cameras stand still, so all that they saw is used."""
    from dapdata.observe.align import align
    from dapdata.observe.cameras import View as Camera

    cameras = [
        Camera(int(np.ceil(2 * K[0, 2])), int(np.ceil(2 * K[1, 2])), K, T, T, 0) for K, T in zip(scan.K, scan.T_world_camera)
    ]
    table = (
        _views(("start", "table"), scan.rest, scan) if scan.rest.view is not None else [(np.zeros((0, 3)),) * 2] * len(cameras)
    )
    of_camera = [[*(found[v] for found in views.values()), table[v]] for v in range(len(cameras))]
    T_camera_world = inverse(scan.T_world_camera)
    points, normals = (
        [move(T, np.concatenate([view[k] for view in own])).astype(np.float32) for T, own in zip(T_camera_world, of_camera)]
        for k, move in enumerate((transform, rotate))
    )
    return align(cameras, points, normals)
