"""Normals of clouds that come without any, and which camera saw each point where nobody says so."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata.poses import inverse, transform

Array = NDArray[Any]

CELLS = 3.0  # spacings of the points: edge of the cells of depth images by which cameras are found for points on no pixel
BEHIND = 0.005  # m: what is this far behind the front of its cell is seen a third as well
NEIGHBOURS = 16  # points to whose plane a normal is square


def estimated_normals(points: Array, neighbours: int = NEIGHBOURS) -> Array:
    """(N, 3) unit normals of the planes through the nearest points, looking either way; of (N, 3) points, at least 3."""
    from scipy.spatial import cKDTree

    near = cKDTree(points).query(points, min(neighbours, len(points)))[1]
    around = points[near] - points[near].mean(axis=1, keepdims=True)
    return np.asarray(np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0])


def by_camera(points: Array, normals: Array, K: Array, T_world_camera: Array) -> tuple[Array, Array]:
    """(N,) the camera that sees each point most squarely, and (N, 3) the normals turned to it.

    Args:
        points, normals: (N, 3), normals unit and looking either way.
        K: (V, 3, 3) px, V >= 1.
        T_world_camera: (V, 4, 4), in the frame of the points.
    """
    cell = CELLS * _spacing(points)
    seen = np.stack([_facing(points, normals, *camera, cell) for camera in zip(K, T_world_camera)])
    owner = np.abs(seen).argmax(axis=0)
    return owner, np.where(seen[owner, np.arange(len(points))] < 0, -1.0, 1.0)[:, None] * normals


def project(points: Array, K: Array, T_world_camera: Array) -> tuple[Array, Array]:
    """(N, 2) px and (N,) depth, m, of points in a camera."""
    local = transform(inverse(T_world_camera), points)
    z = np.where(np.abs(local[:, 2]) < 1e-9, 1e-9, local[:, 2])
    return local[:, :2] / z[:, None] * K[[0, 1], [0, 1]] + K[:2, 2], local[:, 2]


def _spacing(points: Array) -> float:
    """m, from one point to the next, in the median."""
    from scipy.spatial import cKDTree

    return float(np.median(cKDTree(points).query(points[:: max(1, len(points) // 1000)], 2)[0][:, 1])) or 1e-3


def _facing(points: Array, normals: Array, K: Array, T_world_camera: Array, edge: float) -> Array:
    """(N,) cosine between normals and the way to a camera, less for points that something is in front of.

    Args:
        points, normals: (N, 3).
        K, T_world_camera: (3, 3) and (4, 4) of the camera.
        edge: Of the cells in which the front is sought, m, at the middle of the points.
    """
    uv, z = project(points, K, T_world_camera)
    pixels = max(edge * K[0, 0] / max(float(np.median(z)), 1e-3), 1e-3)
    cell = np.unique(np.floor(uv / pixels).astype(np.int64), axis=0, return_inverse=True)[1].reshape(-1)
    front = np.full(cell.max() + 1, np.inf)
    np.minimum.at(front, cell, np.where(z > 0, z, np.inf))
    way = T_world_camera[:3, 3] - points
    cosine = np.einsum("ij,ij->i", normals, way) / np.linalg.norm(way, axis=1)
    in_view = (z > 0) & ((uv > 0) & (uv < 2 * K[:2, 2])).all(axis=1)
    behind = np.where(in_view, z - np.minimum(front[cell], 1e3), np.inf)
    return np.asarray(cosine * np.maximum(np.exp(-behind / BEHIND), 1e-6))
