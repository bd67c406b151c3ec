"""How well placements do: the judge's verdicts on a predictions file, their statistics, and the report.

Definitions stand in docs/metrics.md. One rule holds everywhere: a scene without a prediction counts as a failure, so
that denominators never depend on what a method chose to answer.
"""

from __future__ import annotations

import json
import platform
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from itertools import pairwise
from math import sqrt
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from dapdata import __version__
from dapdata import rng as rngs
from dapdata.errors import CorruptionError, UsageError
from dapdata.matching import (
    assign,
    is_tight,
    legacy_rpdiff,
    mode_entropy,
    object_points,
    surface_distance,
    tolerance,
    uniform_all_found,
    uniform_entropy,
    uniform_recall,
)
from dapdata.poses import symmetric_distance
from dapdata.predictions import Predictions, collect, read
from dapdata.records import SYMMETRIES, Demo, Placement, Verdict, read_demo
from dapdata.report import (
    Affordance,
    Cost,
    Digests,
    Geometry,
    Interval,
    Judge,
    LegacyRpdiff,
    Method,
    Modes,
    Quantiles,
    Report,
    SceneRow,
    Split,
    Success,
    Summary,
    compare,
)

if TYPE_CHECKING:
    from dapdata.loading import Dataset
    from dapdata.simulate import PlacementConfig

__all__ = ["Report", "compare", "judge_dataset", "judge_file", "require_sound", "wilson"]

Array = NDArray[Any]
Sample = Mapping[str, Array]
Protocol = Literal["strict", "rpdiff", "shown"]

NEAR_GOAL = 0.02  # m, largest surface distance to a verified goal
PRECISE_MOVE, PRECISE_TURN = 0.005, np.deg2rad(3.0)  # from the prediction to where it came to rest
FREE = 0.001  # m: less overlap than this is free of collision
COUNTS = (1, 2, 4, 8, 16, 32)  # K at which modes are counted
SWEEP = (2, 5, 10, 20, 35)  # mm
CLEARANCES = (0, 5, 10, 15, 30, np.inf)  # mm: success is counted for goals between two of them, the lower included
NO_PREDICTION = "no_prediction"
FAR = "far_from_shown"  # protocol shown: more than NEAR_GOAL from each recorded goal
SOUND = 0.98  # an oracle below this means a broken judge or broken demonstrations


# Statistics ------------------------------------------------------------------------------------------------


def wilson(successes: float, number: int) -> tuple[float, float]:
    """95 % interval of a rate by Wilson's score; (0, 1) when nothing was counted."""
    if number == 0:
        return 0.0, 1.0
    z, p = 1.959963984540054, successes / number
    centre, spread = p + z * z / (2 * number), z * sqrt(max(p * (1 - p) / number + z * z / (4 * number**2), 0.0))
    scale = 1 + z * z / number
    low, high = (centre - spread) / scale, (centre + spread) / scale
    return 0.0 if successes == 0 else max(0.0, low), 1.0 if successes == number else min(1.0, high)  # the ends exactly


def bootstrap(values: Array, draws: int = 2000) -> tuple[float, float]:
    """95 % interval of the mean of (N,) values, one a scene, by resampling scenes; always the same draws."""
    if len(values) == 0:
        return 0.0, 0.0
    rng = rngs.stream(0, "bootstrap", len(values))
    weight = rng.multinomial(len(values), np.full(len(values), 1 / len(values)), size=draws) / len(values)
    low, high = np.quantile(weight @ values, [0.025, 0.975])
    return float(low), float(high)


def rate(flags: Array) -> Interval:
    """The share of (N,) claims that hold, with Wilson's interval; claims between 0 and 1 count in part."""
    flags = np.asarray(flags, float)
    value = float(flags.mean()) if len(flags) else 0.0
    return Interval(value=value, n=len(flags), ci95=wilson(float(flags.sum()), len(flags)))


def mean(values: Array) -> Interval:
    """The mean of (N,) values, one a scene, with a bootstrap interval."""
    values = np.asarray(values, float)
    return Interval(value=float(values.mean()) if len(values) else 0.0, n=len(values), ci95=bootstrap(values))


def quantiles(values: Array) -> Quantiles:
    """Median, 90 % quantile and maximum of the finite ones of (N,) values."""
    values = np.asarray(values, float)
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return Quantiles(n=0, median=None, p90=None, max=None)
    median, p90, top = np.quantile(values, [0.5, 0.9, 1.0])
    return Quantiles(n=len(values), median=float(median), p90=float(p90), max=float(top))


# Judging ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SceneResult:
    """What one scene's C candidates came to, by rank; the first K of them were judged. There may be none."""

    demo: int
    T_world_object: Array  # (C, 4, 4)
    verdicts: list[Verdict]  # K
    distance: Array  # (C, M) m, surface distance to each verified goal
    nearest: Array  # (C, 2) m and rad, translation and rotation to the goal of least surface distance
    tau: Array  # (M,) m
    tight: Array  # (M,) bool
    seconds: float  # of physics, all K
    rank: Array  # (C,) rising, with gaps where a candidate has no pose
    legacy: Array  # (2, C, M) bool, from `legacy_rpdiff`
    clearance: Array  # (M,) m


def judge_scene(
    demo: Demo, points: Array, T_world_object: Array, rank: Array, k: int, placement: PlacementConfig, protocol: Protocol
) -> SceneResult:
    """The judge's verdicts on the k best candidates of one scene, and the distances of all to its goals.

    Args:
        demo: The scene.
        points: (X, 3) of the object's surface, its own frame, m; see matching.object_points.
        T_world_object: (C, 4, 4) candidates by rank; C may be 0.
        rank: (C,) rising; those below k are judged.
        k: Candidates that are judged.
        placement: The judge's parameters, from the dataset's recipe.
        protocol: "strict" or "rpdiff", in physics; or "shown", near a recorded goal.

    Raises:
        UsageError: physics is asked for where nobody knows the shapes.
    """
    symmetry, axis = SYMMETRIES[int(demo.symmetry_kind)], np.asarray(demo.symmetry_axis, float)
    distance = surface_distance(T_world_object, demo.goals, points, symmetry, axis)
    goal = demo.goals[distance.argmin(axis=1)]
    nearest = [symmetric_distance(T, T_goal, symmetry, axis) for T, T_goal in zip(T_world_object, goal)]
    start, judged = time.perf_counter(), rank < k
    if protocol == "shown":
        rows = zip(goal[judged], distance[judged].min(axis=1, initial=np.inf), np.array(nearest).reshape(-1, 2)[judged])
        verdicts = [_as_shown(T, float(off), *map(float, near)) for T, off, near in rows]
    else:
        verdicts = _in_physics(demo, T_world_object[judged], placement, protocol)
    seconds = time.perf_counter() - start
    return SceneResult(
        int(demo.demo),
        T_world_object,
        verdicts,
        distance,
        np.array(nearest, float).reshape(-1, 2),
        tolerance(demo.goal_clearance),
        is_tight(demo.goal_clearance, demo.goal_kind),
        seconds,
        rank,
        legacy_rpdiff(T_world_object, demo.goals),
        demo.goal_clearance,
    )


def _in_physics(
    demo: Demo, T_world_object: Array, placement: PlacementConfig, protocol: Literal["strict", "rpdiff"]
) -> list[Verdict]:
    from dapdata import simulate

    if not len(demo.part_kind) or not len(demo.object_kind):
        raise UsageError(
            f"protocol: got '{protocol}', expected shown: demo {int(demo.demo)} was imported without shapes, there is nothing "
            "to simulate; use --protocol shown, or --data with simulated scenes"
        )
    return list(simulate.judge(demo, T_world_object, placement, protocol)) if len(T_world_object) else []


def _as_shown(T_goal: Array, off: float, shift: float, turn: float) -> Verdict:
    """The verdict without physics: near the recorded goal (4, 4), which stands for where it comes to rest, or not."""
    is_near = off <= NEAR_GOAL
    return Verdict(is_near, "ok" if is_near else FAR, T_goal, shift, turn, push=np.nan, penetration=np.nan, gap=np.nan)


def judge_all(
    predictions: Predictions,
    samples: Sequence[Sample],
    placement: PlacementConfig,
    protocol: Protocol,
    *,
    k: int,
    workers: int = 1,
    progress: Callable[[str], None] | None = None,
) -> list[SceneResult]:
    """Results of every scene, in the scenes' order, whatever the number of workers; the k best candidates are judged.

    Args:
        predictions: Candidates; those of other demos are left alone.
        samples: One demo each, arrays by shard path.
        placement: The judge's parameters.
        protocol: "strict", "rpdiff" or "shown".
        k: Candidates that are judged: those whose rank is less.
        workers: Processes.
        progress: Called once a scene.
    """
    jobs = []
    for sample in samples:
        demo, number = read_demo(sample), int(sample["meta/demo"])
        jobs.append((demo, object_points(sample), predictions.of(number), predictions.ranks(number), k, placement, protocol))
    results = []
    for result in _run(jobs, workers):
        results.append(result)
        if progress:
            progress(f"judged {len(results)} of {len(jobs)} scenes")
    return results


def _run(
    jobs: Sequence[tuple[Demo, Array, Array, Array, int, PlacementConfig, Protocol]], workers: int
) -> Iterator[SceneResult]:
    if workers <= 1 or len(jobs) < 2:
        yield from (judge_scene(*job) for job in jobs)
        return
    # Spawned, not forked: a simulator's connection must not be inherited.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        yield from pool.map(judge_scene, *zip(*jobs), chunksize=max(1, min(8, len(jobs) // (2 * workers))))


def oracle(samples: Sequence[Sample], k: int) -> Predictions:
    """The recorded goals as predictions: the demonstrated one first, then the others, again and again up to k."""
    placements = {}
    for sample in samples:
        demonstrated, goals = sample["pose/T_world_object_goal"], sample["goals/T_world_object"]
        others = [goal for goal in goals if not np.array_equal(goal, demonstrated)]
        ordered = [demonstrated, *others]
        placements[int(sample["meta/demo"])] = [Placement(ordered[i % len(ordered)], float(-i), "ok") for i in range(k)]
    return collect(placements)


# Reporting -------------------------------------------------------------------------------------------------


def summarise(results: Sequence[SceneResult], k: int, draws: int) -> Summary:
    """All figures of one method.

    Args:
        results: One a scene; scenes without candidates included.
        k: Candidates that were to be judged; those that are missing count as failures.
        draws: Candidates that the modes are counted on, at least k; those that are missing find nothing.
    """
    return Summary(success=_success(results, k), modes=_modes(results, draws), geometry=_geometry(results))


def _success(results: Sequence[SceneResult], k: int) -> Success:
    top = [r.verdicts[0] if r.verdicts else None for r in results]
    top_ok = np.array([v is not None and v.success for v in top], bool)
    shares = np.array([sum(v.success for v in r.verdicts) / k for r in results], float)
    precise = [v is not None and v.moved <= PRECISE_MOVE and v.turned <= PRECISE_TURN for v in top]
    near = [bool(r.verdicts) and bool((r.distance[0] <= NEAR_GOAL).any()) for r in results]
    at_tight = [bool(r.verdicts) and bool((r.distance[0][r.tight] <= NEAR_GOAL).any()) for r in results]
    has_tight = np.array([r.tight.any() for r in results], bool)
    missing = Counter({NO_PREDICTION: sum(k - len(r.verdicts) for r in results)})
    return Success(
        success_top1=rate(top_ok),
        success_any_of_K=rate(shares > 0),
        success_mean_of_K=rate(shares),
        success_single=mean(shares),
        success_precise=rate(top_ok & np.array(precise, bool)),
        success_near_goal=rate(top_ok & np.array(near, bool)),
        success_top1_tight=rate((top_ok & np.array(at_tight, bool))[has_tight]),
        success_tight=rate(np.array([_asked(r, r.tight) for r in results], bool)[has_tight]),
        success_by_clearance_mm=_by_clearance(results),
        failures=_sorted(Counter(v.reason if v else NO_PREDICTION for v in top if v is None or not v.success)),
        failures_all=_sorted(Counter(v.reason for r in results for v in r.verdicts if not v.success) + missing),
    )


def _asked(result: SceneResult, wanted: Array) -> bool:
    """Whether the best-ranked of the candidates that head for one of some (M,) goals succeeds there; False where none does."""
    heads_there = wanted[result.distance[: len(result.verdicts)].argmin(axis=1)] if result.verdicts else np.zeros(0)
    if not heads_there.any():
        return False
    i = int(np.argmax(heads_there))
    return result.verdicts[i].success and bool((result.distance[i][wanted] <= NEAR_GOAL).any())


def _by_clearance(results: Sequence[SceneResult]) -> dict[str, Interval]:
    """`_asked` for the goals of each range of clearance, over the scenes that have one; ranges without a scene are left out."""
    found = {}
    for low, high in pairwise(CLEARANCES):
        wanted = [(low <= 1000 * r.clearance) & (1000 * r.clearance < high) for r in results]
        asked = np.array([_asked(r, goals) for r, goals in zip(results, wanted) if goals.any()], bool)
        if len(asked):
            found[f"{low}-{high}" if high < np.inf else f"{low}-"] = rate(asked)
    return found


def _sorted(counts: Counter[str]) -> dict[str, int]:
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))


def _modes(results: Sequence[SceneResult], draws: int) -> Modes:
    number = np.array([len(r.tau) for r in results])
    counts = [c for c in COUNTS if c < draws] + [draws]
    found = {c: [_found(r, r.tau, c) for r in results] for c in counts}
    recall = {str(c): mean(np.array([f for f, _ in found[c]]) / number) for c in counts}
    uniform = {str(c): float(np.mean([uniform_recall(m, c) for m in number])) for c in counts}
    sweep = {}
    for tau in SWEEP:
        swept = np.array([_found(r, np.full(len(r.tau), tau / 1000), draws) for r in results])
        sweep[str(tau)] = {
            "recall": float((swept[:, 0] / number).mean()),
            "all_modes_found": float((swept[:, 0] == number).mean()),
            "precision": float(swept[:, 1].mean() / draws),
        }
    drawn = [r.rank < draws for r in results]
    entropies = [mode_entropy(assign(r.distance[d], r.tau), len(r.tau)) for r, d in zip(results, drawn)]
    return Modes(
        tau_mm=quantiles(np.concatenate([r.tau for r in results]) * 1000),
        modes=quantiles(number),
        recall_at_K=recall,
        uniform_recall_at_K=uniform,
        recall_share_at_K={c: recall[c].value / uniform[c] for c in recall},
        all_modes_found_at_K={str(c): rate(np.array([f for f, _ in found[c]]) == number) for c in counts},
        uniform_all_modes_found_at_K={str(c): float(np.mean([uniform_all_found(m, c) for m in number])) for c in counts},
        precision_at_K={str(c): mean(np.array([p for _, p in found[c]]) / c) for c in counts},
        sweep_mm=sweep,
        entropy=mean(np.array(entropies)),
        uniform_entropy=float(np.mean([uniform_entropy(m, draws) for m in number])),
        legacy_rpdiff=LegacyRpdiff(
            recall=mean(np.array([r.legacy[0, d].any(axis=0).mean() for r, d in zip(results, drawn)])),
            precision=mean(np.array([r.legacy[1, d].any(axis=1).sum() / draws for r, d in zip(results, drawn)])),
        ),
    )


def _found(result: SceneResult, tau: Array, count: int) -> tuple[int, int]:
    """How many modes the candidates of rank below count find, and how many of these candidates are at a mode."""
    inside = result.distance[result.rank < count] <= tau
    return int(inside.any(axis=0).sum()), int(inside.any(axis=1).sum())


def _geometry(results: Sequence[SceneResult]) -> Geometry:
    with_top = [r for r in results if r.verdicts]
    top = [r.verdicts[0] for r in with_top]
    return Geometry(
        penetration_mm=quantiles(np.array([max(v.penetration, 0.0) for v in top if np.isfinite(v.penetration)]) * 1000),
        gap_mm=quantiles(np.array([v.gap for v in top]) * 1000),
        collision_free=rate(
            np.array([bool(r.verdicts) and r.verdicts[0].penetration <= FREE for r in results if _has_physics(r)])
        ),
        goal_surface_mm=quantiles(np.array([r.distance[0].min() for r in with_top]) * 1000),
        goal_translation_mm=quantiles(np.array([r.nearest[0, 0] for r in with_top]) * 1000),
        goal_rotation_deg=quantiles(np.rad2deg([r.nearest[0, 1] for r in with_top])),
        settle_move_mm=quantiles(np.array([v.moved for v in top]) * 1000),
        settle_turn_deg=quantiles(np.rad2deg([v.turned for v in top])),
        push_N=quantiles(np.array([v.push for v in top])),
    )


def _has_physics(result: SceneResult) -> bool:
    """Whether overlaps were measured, or would have been, had there been a candidate."""
    return not result.verdicts or not np.isnan(result.verdicts[0].penetration)


def judge_file(
    predictions: str | Path,
    dataset: str | Path | Dataset,
    protocol: Protocol = "strict",
    *,
    split: str = "test",
    **options: Any,
) -> dict[str, Any]:
    """The report on a predictions file; see `judge_dataset`.

    Args:
        predictions: An npz as `predictions` describes it.
        dataset: Folder or URL of the dataset, or the opened split.
        protocol: "strict", "rpdiff" or "shown".
        split: Which scenes; ignored when the dataset is an opened split.
        options: Passed on to `judge_dataset`.

    Raises:
        FormatError: the file is not what it should be.
        UsageError: it holds demos that are not in the split.
    """
    from dapdata import loading

    proposed = read(predictions)
    opened = loading.open(dataset, split) if isinstance(dataset, (str, Path)) else dataset
    report, _ = judge_dataset(proposed, opened, protocol, split=split, origin=str(predictions), **options)
    return report.model_dump(mode="json", by_alias=True)


def judge_dataset(
    predictions: Predictions,
    dataset: Dataset,
    protocol: Protocol = "strict",
    *,
    split: str = "test",
    trials: int | None = None,
    k: int | None = None,
    method: str = "file",
    saw_ground_truth: bool = False,
    settings: Mapping[str, Any] | None = None,
    weights: Mapping[str, str] | None = None,
    references: Mapping[str, Predictions] | None = None,
    affordance: Mapping[int, Sequence[tuple[float, float]]] | None = None,
    cost: Cost | None = None,
    seed: int = 0,
    workers: int = 1,
    origin: str = "predictions",
    progress: Callable[[str], None] | None = None,
) -> tuple[Report, dict[str, list[SceneResult]]]:
    """The report on predictions and what it was made from: the oracle first, then the references, then the method.

    Candidates of rank below k are judged in physics. The modes are counted on all, judged or not.

    Args:
        predictions: Candidates for scenes of the split; judged scenes without any are failures.
        dataset: The opened split.
        protocol: "strict", "rpdiff" or "shown".
        split: Name of the split.
        trials: Judge the first so many scenes of the split; all when None.
        k: Candidates of a scene that are judged; the largest rank + 1, and so all, when None.
        method: Name of the method.
        saw_ground_truth: Whether the method saw more than the clouds.
        settings: Of the method, for the record.
        weights: sha256 of the method's files by name.
        references: Predictions of other methods on the same scenes; "oracle" is added when it is not among them.
        affordance: For each demo the (IoU, purity) of its samples.
        cost: What the method took; physics is added here.
        seed: Of the method's random draws.
        workers: Processes that judge.
        origin: Where the predictions came from, for messages.
        progress: Called with a line now and then.

    Raises:
        UsageError: predictions for demos that are not in the split, or a split without scenes.
    """
    from dapdata import recipe as recipes

    number = len(dataset) if trials is None else min(trials, len(dataset))
    if number == 0:
        raise UsageError(f"{dataset.root}: split '{split}': got 0 demos, expected at least 1; choose another split")
    samples = [dataset[i] for i in range(number)]
    _check_demos(predictions, dataset, split, origin)
    largest = int(predictions.rank.max(initial=0)) + 1
    k = k or largest
    draws = max(k, largest)
    placement = recipes.from_resolved(dataset.recipe).placement
    sources = {"oracle": oracle(samples, draws), **(references or {})}
    results: dict[str, list[SceneResult]] = {}
    for name, source in {**sources, method: predictions}.items():
        if name in sources and name == method:
            source = predictions
        say = (lambda line, name=name: progress(f"{name}: {line}")) if progress else None
        results[name] = judge_all(source, samples, placement, protocol, k=k, workers=workers, progress=say)
    references_out = {name: summarise(results[name], k, draws) for name in sources}
    mine = summarise(results[method], k, draws)
    if affordance is not None:
        mine = mine.model_copy(update={"affordance": _affordance(affordance, samples)})
    oracle_rate = references_out["oracle"].success.success_top1
    report = Report(
        task=str(dataset.task),
        split=_split(split, results[method], samples),
        method=_method(method, k, draws, saw_ground_truth, results[method], settings),
        digests=Digests(
            predictions=predictions.sha256,
            data=str(dataset.digest),
            recipe=sha256(json.dumps(dataset.recipe, sort_keys=True).encode()).hexdigest(),
            weights=dict(weights or {}),
        ),
        judge=Judge(
            protocol=protocol,
            engine="none" if protocol == "shown" else _engine(),
            dapdata=__version__,
            placement=placement.model_dump(mode="json"),
            oracle=oracle_rate,
            sound=oracle_rate.value >= SOUND,
        ),
        seed=seed,
        hardware=f"{platform.machine()} {_processor()}",
        success=mine.success,
        modes=mine.modes,
        geometry=mine.geometry,
        affordance=mine.affordance,
        references=references_out,
        cost=_cost(cost, results[method]),
        notes=_notes(oracle_rate, results[method], k),
        scenes=[_row(r, len(r.tau), draws) for r in results[method]],
    )
    return report, results


def require_sound(report: Report) -> None:
    """Raises a CorruptionError when the oracle failed too often: the judge or the demonstrations are broken."""
    if not report.judge.sound:
        got = report.judge.oracle
        raise CorruptionError(
            f"judge: the recorded goals succeed in {got.value:.1%} of {got.n} scenes, expected at least {SOUND:.0%}; the judge "
            "or the demonstrations are broken, and no other figure of this report can be trusted: make the dataset anew"
        )


def _check_demos(predictions: Predictions, dataset: Dataset, split: str, origin: str) -> None:
    known = set(dataset.index["demo"].tolist())
    if unknown := sorted(set(predictions.demo.tolist()) - known):
        raise UsageError(
            f"{origin}: demo: got {unknown[:5]}{' ...' if len(unknown) > 5 else ''}, expected demos of the {len(known)} "
            f"scenes of split '{split}'; predict for that split"
        )


def _split(name: str, results: Sequence[SceneResult], samples: Sequence[Sample]) -> Split:
    keys = ("meta/demo", "meta/container_instance", "meta/object_instance", "pose/T_world_container")
    digest = sha256()
    for sample in samples:
        for path in keys:
            digest.update(np.ascontiguousarray(sample[path]).tobytes())
    return Split(
        name=name,
        sha256=digest.hexdigest(),
        n_scenes=len(samples),
        n_tight_scenes=sum(bool(r.tight.any()) for r in results),
    )


def _method(
    name: str, k: int, draws: int, saw: bool, results: Sequence[SceneResult], settings: Mapping[str, Any] | None
) -> Method:
    predicted = sum(bool(r.verdicts) for r in results)
    return Method(
        name=name,
        k=k,
        draws=draws,
        saw_ground_truth=saw,
        n_predicted=predicted,
        n_no_prediction=len(results) - predicted,
        n_candidates=sum(len(r.verdicts) for r in results),
        settings=dict(settings or {}),
    )


def _affordance(quality: Mapping[int, Sequence[tuple[float, float]]], samples: Sequence[Sample]) -> Affordance:
    pairs = [np.mean(quality.get(int(s["meta/demo"])) or [(0.0, 0.0)], axis=0) for s in samples]
    return Affordance(iou=mean(np.array([p[0] for p in pairs])), purity=mean(np.array([p[1] for p in pairs])))


def _cost(cost: Cost | None, results: Sequence[SceneResult]) -> Cost:
    seconds = quantiles(np.array([r.seconds / len(r.verdicts) for r in results if r.verdicts]))
    return (cost or Cost()).model_copy(update={"physics_s": seconds})


def _row(result: SceneResult, modes: int, draws: int) -> SceneRow:
    top = result.verdicts[0] if result.verdicts else None
    return SceneRow(
        demo=result.demo,
        success=bool(top and top.success),
        reason=top.reason if top else NO_PREDICTION,
        successes=sum(v.success for v in result.verdicts),
        candidates=len(result.verdicts),
        modes=modes,
        modes_found=_found(result, result.tau, draws)[0],
    )


def _notes(oracle_rate: Interval, results: Sequence[SceneResult], k: int) -> list[str]:
    notes = []
    if oracle_rate.value < SOUND:
        notes.append(
            f"the oracle succeeds in only {oracle_rate.value:.1%} of the scenes, under {SOUND:.0%}: the judge or the "
            "demonstrations are broken, and no figure here can be trusted"
        )
    if missing := sum(not r.verdicts for r in results):
        notes.append(f"{missing} of {len(results)} scenes have no prediction; each counts as a failure")
    if short := sum(0 < len(r.verdicts) < k for r in results):
        notes.append(f"{short} of {len(results)} scenes have fewer than {k} candidates; the missing ones count as failures")
    return notes


def _engine() -> str:
    from importlib.metadata import version

    return f"pybullet {version('pybullet')}"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.processor())
