"""Scanned demonstrations made by hand: a tray, a block with a knob that tells its sides apart, and a motion that is known."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dapdata.clouds import write_ply
from dapdata.poses import pose, rotate, rotation_about, transform
from dapdata.records import Array
from dapdata.rng import stream

STEP = 0.005  # m, of the grids of points
NOISE = 0.0004  # m
TRAY = (
    ((0.26, 0.18, 0.012), (0, 0, 0.006)),
    ((0.012, 0.18, 0.08), (0.13, 0, 0.04)),
    ((0.012, 0.18, 0.08), (-0.13, 0, 0.04)),
    ((0.26, 0.012, 0.05), (0, 0.09, 0.025)),
)
BLOCK = (((0.05, 0.07, 0.11), (0, 0, 0)), ((0.03, 0.025, 0.03), (0.035, 0.01, 0.03)))
CUBOID = BLOCK[:1]
T_START = pose(rotation_about((0, 0, 1), 0.7), (0.05, 0.32, 0.056))
T_GOAL = pose(rotation_about((0, 0, 1), -0.5) @ rotation_about((1, 0, 0), np.pi / 2), (0.02, -0.01, 0.05))
Cloud = tuple[Array, Array]  # (N, 3) points and normals


def surface(boxes: Any, T: Array, seed: int) -> Cloud:
    """Points on the faces of boxes (size, centre), with outward normals, after a motion, with noise."""
    points, normals = [], []
    for size, centre in boxes:
        for k in range(3):
            a, b = (np.arange(STEP / 2, size[j], STEP) - size[j] / 2 for j in range(3) if j != k)
            for side in (-1, 1):
                grid = np.stack([g.ravel() for g in np.meshgrid(a, b)], axis=1)
                face = np.insert(grid, k, side * size[k] / 2, axis=1)
                points.append(face + centre)
                normals.append(np.tile(side * np.eye(3)[k], (len(face), 1)))
    noise = stream(seed, "hand scans", 0).normal(size=(sum(map(len, points)), 3))
    return transform(T, np.concatenate(points)) + NOISE * noise, rotate(T, np.concatenate(normals))


def clouds(
    thing: Any = BLOCK,
    T_start: Array = T_START,
    T_goal: Array = T_GOAL,
    T_container: tuple[Array, Array] = (np.eye(4), np.eye(4)),
) -> dict[str, Cloud]:
    """The four clouds of a demonstration, by name; T_goal is in the container's frame."""
    return {
        "start_container": surface(TRAY, T_container[0], 1),
        "start_object": surface(thing, T_start, 2),
        "end_container": surface(TRAY, T_container[1], 3),
        "end_object": surface(thing, T_container[1] @ T_goal, 4),
    }


def write(folder: Path, found: Mapping[str, Cloud], about: Mapping[str, Any] | None = None, normals: bool = True) -> Path:
    """Writes a demonstration with a ply for each cloud; the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, (points, facing) in found.items():
        write_ply(folder / f"{name}.ply", points, facing if normals else None)
    if about is not None:
        (folder / "scan.json").write_text(json.dumps(about))
    return folder
