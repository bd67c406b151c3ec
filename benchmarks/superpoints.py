"""Superpoints of 10 000 observed points: groups, mean points and mean normals; ours by k-means against a mere grid.

The cloud is one noisy 640x480 view of the shelf of `render.py`, fused, of which every n-th point is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from render import FAR, FOV_DEG, NEAR, shelf
from timing import Row, chosen, compare, main

from dapdata.cluster import SuperpointsConfig, means, partition
from dapdata.observe.cameras import View, intrinsics, look_at
from dapdata.observe.fuse import fuse, view_cloud
from dapdata.observe.noise import add_noise
from dapdata.observe.raycast import cast
from dapdata.poses import inverse

POINTS = 10_000
WIDTH, HEIGHT = 640, 480
VOXEL = 0.004  # m: more points than are needed


def cloud() -> tuple[np.ndarray, np.ndarray]:
    """(10 000, 3) points and normals, f4, world frame."""
    kind, size, T = shelf()
    K, T_world_camera = intrinsics(WIDTH, HEIGHT, FOV_DEG), look_at(np.array([0, 0, 0.38]), 20.0, 15.0, 1.0)
    image = cast(kind, size, inverse(T_world_camera) @ T, K, WIDTH, HEIGHT, NEAR, FAR)
    view = View(WIDTH, HEIGHT, K, T_world_camera, T_world_camera, 1)
    points, normals = view_cloud(add_noise(image, K, "d415", 1), view)
    fused = fuse([points], [normals], T_world_camera[None], VOXEL)
    few = np.linspace(0, len(fused.points) - 1, POINTS).astype(int)
    return fused.points[few], fused.normals[few]


def run(scale: str, against: str | None) -> Iterator[Row]:
    points, normals = cloud()

    def superpoints(config: SuperpointsConfig) -> Callable[[], object]:
        return lambda: means(points, normals, partition(points, normals, config.count, config))

    contenders = {"dapdata": superpoints(SuperpointsConfig()), "voxel": superpoints(SuperpointsConfig(method="voxel"))}
    notes = {"dapdata": "limit 10", "voxel": "dapdata's own, without k-means: less pure"}
    case = f"{POINTS} points, {SuperpointsConfig().count} superpoints"
    yield from compare("superpoints", case, chosen(contenders, against), 5 if scale == "quick" else 25, notes=notes)


if __name__ == "__main__":
    main(run)
