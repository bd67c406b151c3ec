"""One file a task: `class Params(SceneConfig)` and `def sample_scene(params, rng) -> Scene | Rejected`.

Nothing is registered: the name of the module is the name of the task.
"""

from __future__ import annotations

import pkgutil
from importlib import import_module
from types import ModuleType


def names() -> list[str]:
    """The names of all tasks, sorted."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def load(task: str) -> ModuleType:
    """The module of a task by its name; the name must be one of `names()`."""
    return import_module(f"{__name__}.{task}")
