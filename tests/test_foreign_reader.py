"""A stranger reads a shard with zarr and numpy alone, and finds the labels again from the poses."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

STRANGER = """
import json, sys
import numpy as np, zarr

root = sys.argv[1]
manifest = json.load(open(f"{root}/manifest.json"))
eps_place, eps_corr = (manifest["recipe"]["label"][key] for key in ("eps_place", "eps_corr"))
demos = positives = pairs = 0
for shard in manifest["shards"]:
    g = zarr.open_group(f"{root}/{shard['path']}", mode="r")

    def rows(path, d):
        o = g[path.split("/")[0] + "/offsets"][:]
        return g[path][o[d] : o[d + 1]]

    def nearest(a, b):
        return np.sqrt(((a[:, None].astype(float) - b[None]) ** 2).sum(-1)).min(1)

    for d in range(shard["demos"]):
        start, goal = g["pose/T_world_object_start"][d], g["pose/T_world_object_goal"][d]
        T = goal @ np.linalg.inv(start)
        placed = rows("object/points", d).astype(float) @ T[:3, :3].T + T[:3, 3]
        near = nearest(rows("container/points", d), placed) <= eps_place
        superpoint = rows("container/superpoint", d)
        score = np.bincount(superpoint, np.where(near, 1.0, -1.0)) / np.bincount(superpoint)
        np.testing.assert_allclose(score, rows("container_superpoints/affordance", d), atol=1e-5)
        centres = rows("object_superpoints/points", d).astype(float) @ T[:3, :3].T + T[:3, 3]
        apart = np.linalg.norm(centres[:, None] - rows("container_superpoints/points", d)[None], axis=-1)
        i, j = rows("correspondence/object_superpoint", d), rows("correspondence/container_superpoint", d)
        np.testing.assert_allclose(apart[i, j], rows("correspondence/distance", d), atol=1e-5)
        assert len(i) == (apart <= eps_corr).sum()
        goals = rows("goals/T_world_object", d)
        assert np.abs(goals - goal).max((1, 2)).min() == 0, "the demonstrated goal is among the goals"
        np.testing.assert_allclose(np.linalg.norm(rows("container/normals", d), axis=1), 1, atol=1e-3)
        demos, positives, pairs = demos + 1, positives + int((score > 0).sum()), pairs + len(i)
assert not any(name.startswith("dapdata") for name in sys.modules)
print(demos, positives, pairs)
"""


def test_a_stranger_recomputes_the_labels(tiny: Path) -> None:
    done = subprocess.run([sys.executable, "-c", STRANGER, str(tiny)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    demos, positives, pairs = map(int, done.stdout.split())
    assert demos == 5
    assert positives > 0
    assert pairs > 0
