"""Upright on a true horizontal surface, then refined and ranked like any method: what geometry does without learning.

The surfaces are the true ones and the object is fitted to its cloud. Random choice replaces the networks; refinement
and ranking are the very functions that the method uses.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import meshes
from dapdata.poses import inverse, pose, rotation_about
from dapdata.records import Placement, meshes_in
from dapdata.solids import Faces, points_on_faces, upward_faces
from daptrain.baselines.random import interior
from daptrain.fit import ObjectFit, fit_object
from daptrain.refine import CRITERIA, STEPS, observed_scene, rank, rank_collision_count, refine

Array = NDArray[Any]

ABOVE = 0.002  # m between the surface and the object's underside
TRIES = 20  # draws for each wanted pose: some surfaces, such as the roof, are not inside


def place(
    sample: dict[str, Array],
    k: int,
    rng: np.random.Generator,
    steps: Collection[str] = STEPS,
    criteria: Collection[str] = CRITERIA,
) -> list[Placement]:
    """Random poses on the container's and the clutter's true surfaces, refined and ranked on the observed cloud.

    Args:
        sample: One demo's arrays by shard path.
        k: How many.
        rng: Of this demo.
        steps: Of `refine`.
        criteria: Of `rank`, or "collision" alone.

    Returns:
        k placements, or a single one with a status when the object cannot be fitted or nothing is inside.
    """
    try:
        fit = fit_object(sample["object/points"], sample["object/normals"])
        scene = observed_scene(sample["container/points"], sample["container/normals"])
    except ValueError:  # too few points to fit anything to
        return [Placement(np.full((4, 4), np.nan), -np.inf, "too_few_points")]
    proposals = propose(sample, fit, k, rng)
    if len(proposals) == 0:
        return [Placement(np.full((4, 4), np.nan), -np.inf, "no_surface")]
    T_world_box = refine(proposals, scene, fit, steps)
    T_world_object = T_world_box @ inverse(fit.T_world_box) @ sample["pose/T_world_object_start"]
    if "collision" in criteria:
        scores = rank_collision_count(T_world_box, sample["container/points"], fit)
    else:
        scores = rank(T_world_box, scene, fit, criteria=criteria)
    return [Placement(T, float(score), "ok") for T, score in zip(T_world_object, scores)]


def surfaces(sample: dict[str, Array]) -> Faces:
    """The true horizontal faces of container and clutter, of solids and of meshes, container frame."""
    T_container_part = sample["scene/T_container_part"]
    flat = upward_faces(sample["scene/kind"], sample["scene/size"], T_container_part)
    rough = meshes.upward_faces(meshes_in(sample)[0], T_container_part)
    return Faces(**{name: np.concatenate([getattr(flat, name), getattr(rough, name)]) for name in vars(flat)})


def propose(sample: dict[str, Array], fit: ObjectFit, k: int, rng: np.random.Generator) -> Array:
    """(K, 4, 4) upright poses of the fitted object, square to the container, on its true surfaces; K is k or 0."""
    faces = surfaces(sample)
    if len(faces.area) == 0:
        return np.zeros((0, 4, 4))
    centres = points_on_faces(faces, TRIES * k, rng) + np.array([0, 0, fit.size[2] / 2 + ABOVE])
    low, high = interior(sample)
    centres = centres[((centres > low) & (centres < high)).all(axis=1)]
    turns = rng.integers(4, size=k) * np.pi / 2
    if len(centres) < k:
        return np.zeros((0, 4, 4))
    T_container_box = np.stack([pose(rotation_about((0, 0, 1), turn), centre) for turn, centre in zip(turns, centres)])
    return np.asarray(sample["pose/T_world_container"] @ T_container_box)
