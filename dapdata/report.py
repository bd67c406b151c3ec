"""What report.json holds, as strict models, and the paired comparison of two reports.

Every figure is defined in docs/metrics.md. Rates are {value, n, ci95}; K stands for the number of candidates.
"""

from __future__ import annotations

import json
from math import comb
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dapdata.errors import FormatError, UsageError

FORMAT = "dapdata.report/1"


class Part(BaseModel):
    """Base of the report's parts: unknown keys, NaN and infinity are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, populate_by_name=True)


class Interval(Part):
    """A rate or a mean over scenes with its 95 % interval."""

    value: float
    n: int = Field(ge=0, description="scenes counted; never fewer because a method gave no answer")
    ci95: tuple[float, float]


class Quantiles(Part):
    """The spread of a quantity over the placements that have it."""

    n: int = Field(ge=0)
    median: float | None
    p90: float | None
    max: float | None


class Success(Part):
    """How often the judge was content."""

    success_top1: Interval = Field(description="the best-ranked candidate succeeds")
    success_any_of_K: Interval = Field(description="at least one of the K candidates succeeds")
    success_mean_of_K: Interval = Field(description="share of the K candidates that succeed, Wilson over scenes")
    success_single: Interval = Field(description="the same share as the expected success of one sample, bootstrap over scenes")
    success_precise: Interval = Field(description="top-1 succeeds and ends within 5 mm and 3 degrees of the prediction")
    success_near_goal: Interval = Field(description="top-1 succeeds within 2 cm (surface distance) of a verified goal")
    success_tight: Interval = Field(
        description="scenes that have a tight goal (clearance under 15 mm, or a stack top): the best-ranked of the candidates "
        "that head for one succeeds within 2 cm of it"
    )
    success_top1_tight: Interval = Field(description="the same scenes: top-1, free to choose, succeeds within 2 cm of one")
    success_by_clearance_mm: dict[str, Interval] = Field(
        default_factory=dict,
        description="success_tight for goals of each range of clearance, such as 5-10 mm, over the scenes that have one",
    )
    failures: dict[str, int] = Field(description="top-1 failures by reason, no_prediction among them")
    failures_all: dict[str, int] = Field(description="failures of all K candidates by reason")


class LegacyRpdiff(Part):
    """RPDiff's own coverage, to relate to its numbers and for nothing else: it takes 34.4 degrees for 5 and no symmetry."""

    recall: Interval = Field(description="share of the goals with a candidate within 3.5 cm and 34.4 degrees")
    precision: Interval = Field(description="share of the candidates within 4 cm and 34.4 degrees of a goal")


class Modes(Part):
    """How many of the verified goals the candidates find, by surface distance modulo symmetry; judged or not."""

    tau_mm: Quantiles = Field(description="tolerance of the goals: min(10 mm, half the clearance + 2 mm)")
    modes: Quantiles = Field(description="verified goals in a scene")
    recall_at_K: dict[str, Interval] = Field(alias="recall@K")
    uniform_recall_at_K: dict[str, float] = Field(
        alias="uniform_recall@K", description="the same for a uniform sampler of goals"
    )
    recall_share_at_K: dict[str, float] = Field(
        alias="recall_share@K", description="mean recall over the mean of the uniform sampler's: 1 is as good as even draws"
    )
    all_modes_found_at_K: dict[str, Interval] = Field(alias="all_modes_found@K")
    uniform_all_modes_found_at_K: dict[str, float] = Field(alias="uniform_all_modes_found@K")
    precision_at_K: dict[str, Interval] = Field(
        alias="precision@K", description="share of the first K candidates that are at a goal"
    )
    sweep_mm: dict[str, dict[str, float]] = Field(
        description="recall, all_modes_found and precision of all K candidates at other tolerances"
    )
    entropy: Interval = Field(description="entropy over the modes of the matched candidates, 1 is even")
    uniform_entropy: float
    legacy_rpdiff: LegacyRpdiff


class Geometry(Part):
    """The best-ranked candidate before, and what physics did to it."""

    penetration_mm: Quantiles
    gap_mm: Quantiles
    collision_free: Interval = Field(description="overlap of at most 1 mm at the predicted pose")
    goal_surface_mm: Quantiles = Field(description="surface distance to the nearest verified goal")
    goal_translation_mm: Quantiles
    goal_rotation_deg: Quantiles
    settle_move_mm: Quantiles = Field(description="from the prediction to where it came to rest")
    settle_turn_deg: Quantiles
    push_N: Quantiles = Field(description="largest pushing force while moving in")


class Affordance(Part):
    """How well a sampled affordance marks one mode; only methods that give scores have it."""

    iou: Interval = Field(description="intersection over union with the best mode")
    purity: Interval = Field(description="share of the marked superpoints that lie in one mode")


class Summary(Part):
    """All that is said of one method on the scenes."""

    success: Success
    modes: Modes
    geometry: Geometry
    affordance: Affordance | None = None


class Split(Part):
    """The scenes that were judged."""

    name: str
    sha256: str = Field(description="digest of the demo numbers and the geometry of container and object")
    n_scenes: int = Field(ge=1)
    n_tight_scenes: int = Field(ge=0)


class Method(Part):
    """Who made the predictions, as far as it was told."""

    name: str
    k: int = Field(ge=1, description="candidates that are judged: those of rank 0 to k - 1")
    draws: int = Field(ge=1, description="candidates that the modes are counted on: those that are judged, and others")
    saw_ground_truth: bool
    n_predicted: int = Field(ge=0, description="scenes with at least one pose")
    n_no_prediction: int = Field(ge=0)
    n_candidates: int = Field(ge=0, description="poses that were judged")
    settings: dict[str, Any] = Field(default_factory=dict)


class Digests(Part):
    """What exactly was judged."""

    predictions: str
    data: str
    recipe: str
    weights: dict[str, str] = Field(default_factory=dict)


class Judge(Part):
    """Who judged, by which rules."""

    protocol: Literal["strict", "rpdiff", "shown"]
    engine: str
    dapdata: str
    placement: dict[str, Any]
    oracle: Interval = Field(description="success of the recorded goals under this judge, on these scenes")
    sound: bool = Field(description="the oracle succeeds in at least 98 % of the scenes")


class Cost(Part):
    """What it took; an entry that nobody measured is null."""

    prepare_s: Quantiles | None = None
    infer_s: Quantiles | None = None
    physics_s: Quantiles | None = None
    parameters: int | None = None
    demos_used: int | None = None
    training_minutes: float | None = None
    device: str | None = None


class SceneRow(Part):
    """The result of one scene, which makes a paired comparison possible."""

    demo: int
    success: bool
    reason: str
    successes: int
    candidates: int
    modes: int
    modes_found: int = Field(description="by all candidates, judged or not")


class Report(Part):
    """One method on one split, next to its references on the same scenes."""

    format: Literal["dapdata.report/1"] = "dapdata.report/1"
    task: str
    split: Split
    method: Method
    digests: Digests
    judge: Judge
    seed: int
    hardware: str
    success: Success
    modes: Modes
    geometry: Geometry
    affordance: Affordance | None = None
    references: dict[str, Summary]
    cost: Cost
    notes: list[str] = Field(default_factory=list)
    scenes: list[SceneRow]


def json_schema() -> dict[str, Any]:
    """The JSON Schema of report.json."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Report.model_json_schema(by_alias=True)}


def read_report(path: str | Path) -> Report:
    """The report in a file.

    Raises:
        FormatError: no such file, or not a report of this format.
    """
    path = Path(path)
    try:
        return Report.model_validate(json.loads(path.read_text()))
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise FormatError(f"{path}: {where}: {first['msg']}; expected a report of format {FORMAT}") from error
    except (OSError, ValueError) as error:
        raise FormatError(f"{path}: {str(error).splitlines()[0]}; expected the report.json of `dapdata eval`") from error


def mcnemar(only_a: int, only_b: int) -> float:
    """Two-sided exact p-value that two methods are equally good, from the scenes on which just one succeeds."""
    number = only_a + only_b
    if number == 0:
        return 1.0
    tail = sum(comb(number, i) for i in range(min(only_a, only_b) + 1))
    return min(1.0, float(2 * tail / 2**number))


def compare(a: str | Path, b: str | Path) -> dict[str, Any]:
    """Two reports on the same scenes, scene by scene.

    Returns:
        a and b (method, success_top1), both, only_a, only_b, neither (scenes), difference (a - b), p_value (McNemar).

    Raises:
        UsageError: the reports are of other scenes or other rules, so that no pair can be made.
    """
    first, second = read_report(a), read_report(b)
    for what, got, wanted in (
        ("split.sha256", second.split.sha256, first.split.sha256),
        ("judge.protocol", second.judge.protocol, first.judge.protocol),
        ("scenes", [row.demo for row in second.scenes], [row.demo for row in first.scenes]),
    ):
        if got != wanted:
            shown = (f"{len(got)} scenes", f"the {len(wanted)}") if isinstance(got, list) else (got, wanted)
            raise UsageError(f"{b}: {what}: got {shown[0]}, expected {shown[1]} of {a}; only the same scenes can be paired")
    pairs = [(x.success, y.success) for x, y in zip(first.scenes, second.scenes)]
    only_a, only_b = pairs.count((True, False)), pairs.count((False, True))
    return {
        "a": {"report": str(a), "method": first.method.name, "success_top1": first.success.success_top1.model_dump()},
        "b": {"report": str(b), "method": second.method.name, "success_top1": second.success.success_top1.model_dump()},
        "n": len(pairs),
        "both": pairs.count((True, True)),
        "only_a": only_a,
        "only_b": only_b,
        "neither": pairs.count((False, False)),
        "difference": first.success.success_top1.value - second.success.success_top1.value,
        "p_value": mcnemar(only_a, only_b),
    }
