"""Placements for a user's own scans: two point cloud files and a run in, ranked poses out."""

from __future__ import annotations

from pathlib import Path

from dapdata import rng as random
from dapdata.clouds import read_cloud
from dapdata.errors import UsageError
from dapdata.records import Placement
from daptrain.infer import Predictor


def predict(
    run: str | Path, container: str | Path, object: str | Path, *, k: int = 8, seed: int = 0, device: str = "auto"
) -> list[Placement]:
    """k placements, best first. Each pose is the motion that carries the object from where it was scanned to its place.

    Args:
        run: Folder that `train` wrote.
        container: Scan of the container and what stands in it: ply, pcd, npz or npy; world frame with z up, m.
        object: Scan of the object, in the same frame.
        k: How many candidates are drawn.
        seed: Of the draws.
        device: "auto", "cpu", "cuda", ...

    Raises:
        FormatError: a file that is no cloud with normals.
        UsageError: a cloud that is too small.
        CheckpointError: no run, or one of another version.
    """
    clouds = (*read_cloud(container), *read_cloud(object))
    if k < 1:
        raise UsageError(f"k: got {k}, expected at least 1")
    return Predictor.load(run, device).predict(*clouds, k, random.stream(seed, "predict", 0))
