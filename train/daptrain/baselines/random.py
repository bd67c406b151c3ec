"""Upright anywhere in the container: how far luck gets."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata.poses import inverse, pose, rotation_about, transform
from dapdata.records import ROLES, Placement
from dapdata.solids import bounds

Array = NDArray[Any]


def place(sample: dict[str, Array], k: int, rng: np.random.Generator) -> list[Placement]:
    """Upright poses of any turn with their centres uniform in `interior`, in no order.

    Args:
        sample: One demo's arrays by shard path.
        k: How many.
        rng: Of this demo.
    """
    low, high = interior(sample)
    centres = transform(sample["pose/T_world_container"], rng.uniform(low, high, (k, 3)))
    turns = rng.uniform(-np.pi, np.pi, k)
    return [Placement(pose(rotation_about((0, 0, 1), turn), centre), 0.0, "ok") for turn, centre in zip(turns, centres)]


def interior(sample: dict[str, Array]) -> tuple[Array, Array]:
    """(3,) low and high corner of the box in which an upright object's centre may be, container frame, m.

    That is the box around the container's own parts, or around its cloud where nobody knows them; of one that opens upwards,
    half the object's height higher.
    """
    if not len(sample["scene/kind"]):
        cloud = transform(inverse(sample["pose/T_world_container"]), sample["container/points"].astype(float))
        low, high = cloud.min(axis=0), cloud.max(axis=0)
        if sample["scene/opening"][2] > 0.5:
            high[2] += np.ptp(sample["object/points"][:, 2]) / 2
        return low, high
    own = sample["scene/role"] == ROLES.index("container")
    boxes = bounds(sample["scene/kind"][own], sample["scene/size"][own], sample["scene/T_container_part"][own])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    if sample["scene/opening"][2] > 0.5:
        high[2] += bounds(*(sample[f"object_parts/{name}"] for name in ("kind", "size", "T_object_part")))[:, 1, 2].max()
    return low, high
