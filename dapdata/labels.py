"""What the two networks learn, from geometry alone: poses, clouds and superpoints; no simulator, so relabelling is cheap.

The object's cloud, as observed at the start pose, is moved to the demonstrated goal. Affordance says how much of a
container superpoint is near it, correspondence which superpoints of the two touch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from dapdata.config import Section, key
from dapdata.poses import inverse, transform
from dapdata.records import Cloud, Demo, Labels, Superpoints

if TYPE_CHECKING:
    from dapdata.records import Array

Kind = Literal["hard", "soft"]


class LabelConfig(Section):
    """How near the placed object counts as near."""

    eps_place: float = key(
        0.03,
        "container points within this distance of the placed object afford it; larger: bigger region",
        unit="m",
        ge=0.001,
        le=0.2,
    )
    eps_corr: float = key(
        0.05,
        "superpoints of object and container within this distance correspond; larger: more pairs",
        unit="m",
        ge=0.001,
        le=0.2,
    )
    kind: Kind = key("hard", "hard: 1 within eps_place, else -1; soft: falling from 1 to -0.26 within eps_place, else -1")


def label(demo: Demo, cloud: Cloud, superpoints: Superpoints, config: LabelConfig) -> Labels:
    """Affordance and correspondence of one demo. A goal that no observed point is near gives an affordance of -1 everywhere."""
    T_goal_start = demo.T_world_object_goal @ inverse(demo.T_world_object_start)
    placed_points = transform(T_goal_start, cloud.object_points.astype(float))
    placed_superpoints = transform(T_goal_start, superpoints.object_superpoint_points.astype(float))
    object_index, container_index, distance = correspondence(
        placed_superpoints, superpoints.container_superpoint_points, config.eps_corr
    )
    return Labels(
        affordance=affordance(
            cloud.container_points, superpoints.container_superpoint, placed_points, config.eps_place, config.kind
        ),
        corr_object=object_index,
        corr_container=container_index,
        corr_distance=distance,
    )


def near_object(container_points: Array, object_points: Array, eps_place: float) -> Array:
    """Which container points lie within eps_place of the placed object.

    Args:
        container_points: (N, 3) float, world frame, m.
        object_points: (M, 3) float at the goal pose, world frame, m; M >= 1.
        eps_place: Largest distance that counts, m. Inclusive.

    Returns:
        (N,) bool.

    Source: DAP, placement affordance (text above its label equation, which as printed labels the object's points);
    the boundary is inclusive as in the authors' code.
    """
    return distance_to_object(container_points, object_points, eps_place) <= eps_place


def distance_to_object(container_points: Array, object_points: Array, limit: float) -> Array:
    """(N,) f8 distance, m, from each container point (N, 3) to the nearest object point (M, 3); inf beyond the limit."""
    from scipy.spatial import cKDTree

    distance = np.full(len(container_points), np.inf)
    low, high = object_points.min(0) - 1.001 * limit, object_points.max(0) + 1.001 * limit
    around = np.flatnonzero(((container_points >= low) & (container_points <= high)).all(1))
    tree = cKDTree(object_points, balanced_tree=False, compact_nodes=False)  # built in half the time, asked only once
    distance[around] = tree.query(container_points[around], distance_upper_bound=1.001 * limit)[0]  # leaves out the bound
    return np.where(distance <= limit, distance, np.inf)


def affordance(
    container_points: Array, superpoint: Array, object_points: Array, eps_place: float, kind: Kind = "hard"
) -> Array:
    """(S,) f4 affordance of the container's superpoints: the mean over their points.

    Hard: 1 for a point within eps_place of the placed object, -1 for any other. Soft: 2 exp(-d / eps_place) - 1 at a
    distance d within eps_place, that is from 1 to -0.26, and -1 beyond.

    Args:
        container_points: (N, 3) float, world frame, m.
        superpoint: (N,) int, superpoint of each point, 0..S-1, all occupied.
        object_points: (M, 3) float at the goal pose, world frame, m; M >= 1.
        eps_place: Largest distance that counts, m. Inclusive.
        kind: "hard" or "soft".
    """
    if kind == "hard":
        score = np.where(near_object(container_points, object_points, eps_place), 1.0, -1.0)
    else:
        score = 2 * np.exp(-distance_to_object(container_points, object_points, eps_place) / eps_place) - 1
    return (np.bincount(superpoint, score) / np.bincount(superpoint)).astype(np.float32)


def correspondence(object_superpoints: Array, container_superpoints: Array, eps_corr: float) -> tuple[Array, Array, Array]:
    """Pairs of superpoints that lie within eps_corr of each other once the object is placed.

    Args:
        object_superpoints: (A, 3) float, centres at the goal pose, world frame, m.
        container_superpoints: (S, 3) float, centres, world frame, m.
        eps_corr: Largest distance that counts, m. Inclusive.

    Returns:
        Object index (C,) i4, container index (C,) i4, distance (C,) f4, sorted by object, then container.
    """
    apart = np.linalg.norm(object_superpoints[:, None] - container_superpoints[None], axis=2)
    object_index, container_index = np.nonzero(apart <= eps_corr)
    distance = apart[object_index, container_index]
    return object_index.astype(np.int32), container_index.astype(np.int32), distance.astype(np.float32)
