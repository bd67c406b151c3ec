"""Boxes, cylinders and directions fitted to observed clouds: what the geometry after the networks stands on.

Frames taken from estimated normals are degrees off on noisy clouds; planes and cylinders fitted to the points are
tenths of a degree off. So normals only say which face a point belongs to, and the points say where the face is.

Every function sees an observed cloud in the world frame (z up) and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata.poses import pose
from daptrain.shapes import ObjectFit, fit_box, fit_cylinder, thinned

__all__ = ["ContainerFit", "ObjectFit", "fit_container", "fit_object", "fit_opening", "fit_yaw"]

Array = NDArray[Any]

OBJECT_POINTS = 1000  # more do not make a fit better: what is left is the error of the cameras' poses, not noise
YAW_POINTS = 1500
# Half width and step (rad) and width of bins (m) of the searches for the yaw, each around the best of the one before.
# All around first: rows of cans have no flat faces, and the mean of their normals is anywhere.
YAW_SWEEPS = ((np.pi / 4, np.pi / 90, 0.012), (0.03, 0.006, 0.006), (0.006, 0.001, 0.004))


@dataclass(frozen=True)
class ContainerFit:
    """Where an observed container faces and how far its points reach."""

    yaw: float  # rad in [-pi/4, pi/4), angle of the vertical faces to the world x axis, modulo a quarter turn
    T_world_front: Array  # (4, 4) f8, world origin, z up, x out of the opening
    low: Array  # (3,) f8, m, 2 % quantile of the points along the axes of the front frame
    high: Array  # (3,) f8, m, 98 % quantile


def fit_object(points: Array, normals: Array) -> ObjectFit:
    """The box or cylinder that an observed object is, whichever lies closer to its points.

    Args:
        points: (M, 3) observed points, any frame, m; M >= 20.
        normals: (M, 3) unit, towards the sensor, as noisy as they come.

    Raises:
        ValueError: fewer than 20 points, or points that are not finite.
    """
    points, normals = _checked(points, normals, 20)
    few = thinned(len(points), OBJECT_POINTS)
    points, normals = points[few], normals[few]
    best, other = sorted((fit_box(points, normals), fit_cylinder(points, normals)), key=lambda fit: fit.misfit)
    return replace(best, other_misfit=other.misfit)


def fit_container(points: Array, normals: Array) -> ContainerFit:
    """Where the container faces and how far its points reach.

    Args:
        points: (N, 3) observed points, world frame, m; N >= 20.
        normals: (N, 3) unit, towards the sensor.
    """
    points, normals = _checked(points, normals, 20)
    opening = fit_opening(points, normals)
    R = np.stack([opening, np.cross([0.0, 0.0, 1.0], opening), [0.0, 0.0, 1.0]], axis=1)
    low, high = np.quantile(points @ R, [0.02, 0.98], axis=0)
    return ContainerFit(_quarter(np.arctan2(opening[1], opening[0])), pose(R), low, high)


def fit_yaw(points: Array, normals: Array) -> float:
    """The angle of the container's vertical faces, modulo a quarter turn.

    The histograms of the points along two horizontal axes are sharpest when the axes stand square on the faces.

    Args:
        points: (N, 3) observed points, world frame, m.
        normals: (N, 3) unit.

    Returns:
        Angle in [-pi/4, pi/4), rad, from the world x axis.
    """
    points, normals = _checked(points, normals, 20)
    level = np.abs(normals[:, 2]) < 0.5
    if level.sum() < 20:  # a container without vertical faces in sight
        level = np.ones(len(points), bool)
    flat = points[level, :2] - points[level, :2].mean(axis=0)
    flat = flat[thinned(len(flat), YAW_POINTS)]
    start = 0.0
    for half_width, step, bin_width in YAW_SWEEPS:
        tries = start + np.arange(-half_width, half_width + step / 2, step)
        start = _parabola_peak(tries, _sharpness(flat, tries, bin_width))
    return _quarter(start)


def fit_opening(points: Array, normals: Array) -> Array:
    """The horizontal unit direction out of the container's opening, square to its faces.

    Every normal points to a sensor and the sensors look in, so the horizontal normals add up to the way out.

    Args:
        points: (N, 3) observed points, world frame, m.
        normals: (N, 3) unit, towards the sensor.

    Returns:
        (3,) unit, z = 0.
    """
    yaw = fit_yaw(points, normals)
    total = np.asarray(normals, float)[:, :2].sum(axis=0)
    quarters = yaw + np.arange(4) * np.pi / 2
    ways = np.stack([np.cos(quarters), np.sin(quarters), np.zeros(4)], axis=1)
    return np.asarray(ways[np.argmax(ways[:, :2] @ total)])


def _checked(points: Array, normals: Array, least: int) -> tuple[Array, Array]:
    points, normals = np.asarray(points, float), np.asarray(normals, float)
    if points.ndim != 2 or points.shape[1:] != (3,) or points.shape != normals.shape:
        raise ValueError(f"cloud: got points {points.shape} and normals {normals.shape}, expected both (N, 3)")
    if len(points) < least or not (np.isfinite(points).all() and np.isfinite(normals).all()):
        raise ValueError(f"cloud: got {len(points)} points, expected at least {least}, all finite; is the object in sight?")
    return points, normals


def _quarter(angle: float) -> float:
    return float((angle + np.pi / 4) % (np.pi / 2) - np.pi / 4)


def _sharpness(flat: Array, turns: Array, bin_width: float) -> Array:
    """Sum of squared counts of two histograms for each turn (T,); a point counts for the two bins around it, in part."""
    ways = np.stack([np.concatenate([np.cos(turns), -np.sin(turns)]), np.concatenate([np.sin(turns), np.cos(turns)])], axis=1)
    place = ways @ flat.T / bin_width
    place -= place.min()
    cell = place.astype(np.int64)
    part = place - cell
    bins = int(cell.max()) + 2
    cell += bins * np.arange(len(ways))[:, None]
    size = bins * len(ways)
    counts = np.bincount(cell.ravel(), 1 - part.ravel(), size) + np.bincount(cell.ravel() + 1, part.ravel(), size)
    return np.asarray((counts**2).reshape(2, len(turns), bins).sum(axis=(0, 2)))


def _parabola_peak(x: Array, y: Array) -> float:
    """The place of the maximum, between the samples where it is inside."""
    i = int(np.argmax(y))
    if i in (0, len(x) - 1):
        return float(x[i])
    bend = y[i - 1] - 2 * y[i] + y[i + 1]
    return float(x[i] + (x[1] - x[0]) * 0.5 * (y[i - 1] - y[i + 1]) / bend) if bend < 0 else float(x[i])
