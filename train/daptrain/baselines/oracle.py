"""The recorded goals: what the judge must accept if judge and demonstrations are sound."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import metrics
from dapdata.records import Placement

Array = NDArray[Any]


def place(sample: dict[str, Array], k: int, rng: np.random.Generator) -> list[Placement]:
    """The demonstrated goal, then the scene's other goals, again and again up to k; nothing is drawn."""
    poses = metrics.oracle([sample], k).of(int(sample["meta/demo"]))
    return [Placement(T, -float(rank), "ok") for rank, T in enumerate(poses)]
