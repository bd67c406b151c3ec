"""Strict recipe sections: the base class of all, and the sections whose stage lives outside of `dapdata`'s spine.

A section is a frozen pydantic model in which unknown keys are errors and every key has a default, a unit, a
range and a sentence. Each stage's section stands above the stage that uses it; `recipe.py` puts them together.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field


class Section(BaseModel):
    """Base of every recipe section: unknown keys, NaN and infinity are refused, values cannot be changed later."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True, strict=True)


class SceneConfig(Section):
    """Base of a task's parameters: `class Params(SceneConfig)` with `task: Literal["<module name>"]`."""

    task: str = Field(description="name of a task, see `dapdata init`")


def key(default: Any, description: str, *, unit: str = "", **limits: Any) -> Any:
    """A recipe key: its default, its sentence, its unit, and limits such as ge, le, gt, lt, min_length."""
    extra: Any = {"unit": unit} if unit else None
    return Field(default=default, description=f"{description}{f' [{unit}]' if unit else ''}", json_schema_extra=extra, **limits)


class SplitConfig(Section):
    """How demos are shared out; by container and object instance, so that no instance is in two splits."""

    val: float = key(0.1, "share of the demos on which choices are made", ge=0, le=0.5)
    test: float = key(0.1, "share of the demos that are looked at once", ge=0, le=0.5)


Preset = Literal["default", "paper"]


class TrainConfig(Section):
    """The two networks and how they are trained."""

    preset: Preset = key("default", "`paper`: eps prediction, no refinement, ranking by collision count, as published")
    minutes: float = key(30.0, "wall-clock budget of both networks together", unit="min", gt=0, le=100_000)


class EvalConfig(Section):
    """How predictions are made and judged."""

    trials: int = key(100, "demos of the split that are judged", ge=1)
    k: int = key(8, "candidates per demo", ge=1, le=1024)
    protocol: Literal["strict", "rpdiff"] = key("strict", "rules of the judge, see docs/metrics.md")
