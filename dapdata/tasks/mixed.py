"""A mixture: each demo is one of several tasks, drawn anew.

`scenes` lists them as scene sections of their own, and the same task may be among them more than once, with other keys.
Everything after the scene is shared: cameras, noise, placement, superpoints, labels. `meta/task` in a shard says which of
them a demo is of, as does the column `task` of the index.
"""

from __future__ import annotations

import operator
from dataclasses import replace
from functools import reduce
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, SerializeAsAny

from dapdata import tasks
from dapdata.config import SceneConfig, key
from dapdata.records import Rejected, Scene

OTHERS: dict[str, Any] = {name: tasks.load(name).Params for name in tasks.names() if name != "mixed"}
USUAL = ("book_shelf", "can_cabinet")

if TYPE_CHECKING:
    AnyScene = SceneConfig
else:
    AnyScene = Annotated[reduce(operator.or_, OTHERS.values()), Field(discriminator="task")]


class Params(SceneConfig):
    """The tasks that are mixed, in equal shares."""

    task: Literal["mixed"] = key("mixed", "name of the task")
    scenes: list[SerializeAsAny[AnyScene]] = Field(
        default_factory=lambda: [OTHERS[name](task=name) for name in USUAL],
        description="scene sections, one of which is drawn for each demo, all with the same chance",
        json_schema_extra={"default": [{"task": name} for name in USUAL]},
        min_length=1,
        max_length=32,
    )


def sample_scene(params: Params, rng: np.random.Generator) -> Scene | Rejected:
    """A scene of one of the tasks."""
    index = int(rng.integers(len(params.scenes)))
    chosen = params.scenes[index]
    scene: Scene | Rejected = tasks.load(chosen.task).sample_scene(chosen, rng)
    return scene if isinstance(scene, Rejected) else replace(scene, task=index)
