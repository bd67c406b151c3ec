"""What a method is measured against: `oracle`, `random`, `heuristic`, none of which learns anything.

Each is a function `place(sample, k, rng) -> list[Placement]` in a module of its name. Unlike a method they see the
ground truth of the sample (the true container, and the oracle the goals), and their reports say so.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from dapdata.config import TrainConfig
from dapdata.records import Placement

Array = NDArray[Any]
Method = Callable[[dict[str, Array], int, np.random.Generator], list[Placement]]

NAMES = ("oracle", "random", "heuristic")


def load(name: str, config: TrainConfig | None = None) -> Method:
    """The baseline of that name, one of NAMES; the heuristic refines and ranks as the (default: usual) config says."""
    place, config = import_module(f"{__name__}.{name}").place, config or TrainConfig()
    return cast(Method, partial(place, steps=config.refine, criteria=config.ranking) if name == "heuristic" else place)
