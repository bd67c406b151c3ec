"""The two networks of DAP, trained on dapdata's shards and judged in physics: `train`, `evaluate`, `predict`.

Importing this package imports nothing heavy; PyTorch comes with the first of its names that is used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from dapdata.errors import require

if TYPE_CHECKING:
    from daptrain.evaluation import evaluate
    from daptrain.loop import train
    from daptrain.scans import predict

__all__ = ["evaluate", "predict", "train"]
_HOMES = {"evaluate": "evaluation", "predict": "scans", "train": "loop"}


def __getattr__(name: str) -> Any:
    """Imports a public name when it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module 'daptrain' has no attribute '{name}'")
    require("torch", "train")
    return getattr(import_module(f"daptrain.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
