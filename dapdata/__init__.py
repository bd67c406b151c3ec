"""Demonstrations, labels, training and physics evaluation for placing objects into containers.

`generate`, `label` and `open` are the verbs of the command line; importing this package imports nothing heavy.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dapdata.errors import (
        CheckpointError,
        CorruptionError,
        DapdataError,
        EnvironmentProblem,
        FormatError,
        LockedError,
        MissingExtraError,
        QuarantineError,
        RecipeError,
        UsageError,
    )
    from dapdata.loading import open
    from dapdata.pipeline import generate, label

__version__ = "0.1.0"
__all__ = [
    "CheckpointError",
    "CorruptionError",
    "DapdataError",
    "EnvironmentProblem",
    "FormatError",
    "LockedError",
    "MissingExtraError",
    "QuarantineError",
    "RecipeError",
    "UsageError",
    "generate",
    "label",
    "open",
]
_HOMES = {"generate": "pipeline", "label": "pipeline", "open": "loading"}


def __getattr__(name: str) -> Any:
    """Imports a public name when it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module 'dapdata' has no attribute '{name}'")
    return getattr(import_module(f"dapdata.{_HOMES.get(name, 'errors')}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
