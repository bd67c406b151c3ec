"""`dapdata eval`: predict on a split, write the predictions to a file, and let the judge see the file alone.

The two halves share nothing but `predictions.npz`: the first sees clouds and no goals, the second sees poses and no
model. References (oracle, heuristic, random) are predicted and judged on the same scenes before the method is.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dapdata import loading, metrics, predictions
from dapdata import rng as rngs
from dapdata.config import IMPORTED, EvalConfig, TrainConfig
from dapdata.console import seldom
from dapdata.errors import FormatError, UsageError
from dapdata.loading import Dataset
from dapdata.matching import affordance_quality
from dapdata.poses import inverse, transform
from dapdata.records import Placement
from dapdata.report import Cost, Quantiles, Report
from daptrain import baselines
from daptrain.page import Material, report_page

if TYPE_CHECKING:
    from daptrain.infer import Predictor, Proposal
    from daptrain.prepare import Inputs

Array = NDArray[Any]
Sample = dict[str, Array]
Say = Callable[[str], None]

LEARNED = ("dap", "cap")
UNREADABLE = "unreadable_cloud"  # status of a scene whose clouds the networks cannot be given


@dataclass
class Proposals:
    """What a method proposed for the scenes, and what that took."""

    placements: dict[int, list[Placement]] = field(default_factory=dict)  # by demo
    prepare_s: list[float] = field(default_factory=list)  # a placement
    infer_s: list[float] = field(default_factory=list)  # a placement
    affordance: dict[int, list[tuple[float, float]]] | None = None  # by demo: IoU and purity of each sample


def evaluate(
    run: str | Path | None = None,
    data: str | Path | None = None,
    *,
    split: str = "test",
    trials: int | None = None,
    protocol: metrics.Protocol | None = None,
    method: str = "dap",
    k: int | None = None,
    draws: int | None = None,
    changes: Mapping[str, Any] | None = None,
    references: bool = True,
    device: str = "auto",
    workers: int = 1,
    out: str | Path | None = None,
    pictures: bool = True,
    say: Say | None = None,
) -> dict[str, Any]:
    """The report on a method, after writing predictions.npz, report.json and report.html.

    Args:
        run: Run folder; needed by dap and cap, unused by the others.
        data: Dataset; default: the one that the run was trained on.
        split: Which demos.
        trials: How many of them; default: the recipe's. The first ones of the split, in order.
        protocol: "strict", "rpdiff" or "shown"; default: the recipe's.
        method: dap, cap, oracle, random or heuristic.
        k: Candidates for each demo that are ranked and judged; default: the recipe's.
        draws: Candidates for each demo that the modes are counted on, at least k: the k, then others, which are refined
            but neither ranked nor judged. Default: the recipe's, and no fewer than k.
        changes: Of the run's train config, for this evaluation alone: other values for keys of config.AT_INFERENCE.
        references: Judge oracle, heuristic and random too. The oracle is always judged.
        device: Of the networks.
        workers: Processes that judge.
        out: Folder for what is written; default: the run, beside it with changes, or runs/<method>-<dataset>.
        pictures: Put pictures of some successes and of each failure into report.html.
        say: Gets a line now and then; default: stderr.

    Raises:
        UsageError: an unknown method, no run where one is needed, a split without demos, fewer draws than k, a change of
            what is fixed in training.
        CheckpointError: a run of another task, or none.
        CorruptionError: the recorded goals fail before this judge; the report is written first.
    """
    say = seldom(say or (lambda line: print(line, file=sys.stderr, flush=True)))
    predictor = _load(run, method, device, changes or {})
    dataset = loading.open(data if data is not None else data_of(run), split)
    config = dataset.section("eval", EvalConfig)
    usual = dataset.section("train", TrainConfig)
    trials, k, protocol = trials or config.trials, k or config.k, protocol or config.protocol
    if draws is not None and draws < k:
        raise UsageError(f"draws: got {draws}, expected at least k ({k}): what is judged was drawn; give more, or a smaller k")
    draws = draws or max(k, config.draws or k)
    if len(dataset) == 0:
        raise UsageError(f"{dataset.root}: split '{split}': got 0 demos, expected at least 1; choose another split")
    if predictor is not None and not {predictor.task, dataset.task} & IMPORTED.keys() and predictor.task != dataset.task:
        raise UsageError(f"{run}: was trained on task {predictor.task}, the data are of task {dataset.task}; give its own data")
    folder = Path(out) if out is not None else _folder(run, method, dataset, changes or {})
    folder.mkdir(parents=True, exist_ok=True)
    say(f"report: {folder / 'report.html'}")
    samples = [dataset[i] for i in range(min(trials, len(dataset)))]
    seed = int(dataset.recipe["seed"])

    def guess(name: str) -> Proposals:
        return _guess(baselines.load(name, usual), name, samples, draws, seed, say)

    has_shapes = all(len(sample["scene/kind"]) for sample in samples)  # the heuristic places on true surfaces
    others = {name: guess(name) for name in baselines.NAMES if has_shapes or name != "heuristic"} if references else {}
    mine = _predict(predictor, samples, k, draws, seed, say) if predictor else guess(method)
    log = _log(run if predictor else None)
    path = predictions.write(folder / "predictions.npz", predictions.collect(mine.placements, k))
    report, results = metrics.judge_dataset(
        predictions.read(path),
        dataset,
        protocol,
        split=split,
        trials=trials,
        k=k,
        method=method,
        saw_ground_truth=predictor is None,
        settings=predictor.config.model_dump(mode="json") if predictor is not None else {},
        weights=_weights(run if predictor else None),
        references={name: predictions.collect(other.placements, k) for name, other in others.items()},
        affordance=mine.affordance,
        cost=_cost(mine, predictor, dataset, log),
        seed=seed,
        workers=workers,
        origin=str(path),
        progress=say,
    )
    material = Material(
        results[method],
        samples if pictures else (),
        _film(predictor, samples, mine, seed, say) if pictures else "",
        log,
    )
    _write(folder, report, report_page(report, material, say))
    metrics.require_sound(report)
    return report.model_dump(mode="json", by_alias=True)


# Predicting ------------------------------------------------------------------------------------------------


def _guess(place: baselines.Method, name: str, samples: Sequence[Sample], draws: int, seed: int, say: Say) -> Proposals:
    """The placements of a baseline, in the order drawn."""
    found = Proposals()
    for i, sample in enumerate(samples):
        demo = int(sample["meta/demo"])
        start = time.perf_counter()
        found.placements[demo] = place(sample, draws, rngs.stream(seed, f"eval/{name}", demo))
        found.infer_s.append((time.perf_counter() - start) / draws)
        say(f"{name}: predicted {i + 1} of {len(samples)} scenes")
    return found


def _predict(predictor: Predictor, samples: Sequence[Sample], k: int, draws: int, seed: int, say: Say) -> Proposals:
    """The placements of the trained networks, in the order drawn, the k before the others.

    A scene that they cannot read gets a status, not an exception.
    """
    found = Proposals(affordance={})
    for i, sample in enumerate(samples):
        demo = int(sample["meta/demo"])
        try:
            _predict_one(predictor, sample, k, draws, rngs.stream(seed, f"eval/{predictor.method}", demo), found)
        except UsageError:
            found.placements[demo] = [Placement(np.full((4, 4), np.nan), -np.inf, UNREADABLE)]
        say(f"{predictor.method}: predicted {i + 1} of {len(samples)} scenes")
    return found


def _predict_one(predictor: Predictor, sample: Sample, k: int, draws: int, rng: np.random.Generator, found: Proposals) -> None:
    """Adds one scene: `Predictor.predict` of k, with a clock and with the sampled scores at hand; then the other draws."""
    from daptrain.infer import check_cloud

    container, object_ = ((sample[f"{body}/points"], sample[f"{body}/normals"]) for body in ("container", "object"))
    check_cloud("container", *container)
    check_cloud("object", *object_)
    start = time.perf_counter()
    inputs, box = predictor.prepare(*container, *object_, rng=rng)
    ready = time.perf_counter()
    proposals = predictor.propose(inputs, k, rng)
    T_world_box, scores = predictor.finish(proposals, *container, box)
    done = time.perf_counter()
    T_box_object = inverse(inputs.T_world_box) @ sample["pose/T_world_object_start"]
    demo = int(sample["meta/demo"])
    found.placements[demo] = _placements(proposals, T_world_box @ T_box_object, scores)
    if draws > k:  # neither ranked nor judged, and so not on the clock
        more = predictor.propose(inputs, draws - k, rng, drawn=k)
        T_world_box, scores = predictor.finish(proposals + more, *container, box)
        found.placements[demo] += _placements(more, T_world_box[k:] @ T_box_object, scores[k:])
    found.prepare_s.append((ready - start) / k)
    found.infer_s.append((done - ready) / k)
    assert found.affordance is not None
    found.affordance[demo] = _affordance_quality(predictor, inputs, sample, proposals)


def _placements(proposals: Sequence[Proposal], T_world_object: Array, scores: Array) -> list[Placement]:
    """The proposals with their poses (K, 4, 4) and scores (K,); where there is no pose, its status says why."""
    return [
        Placement(T, float(score), "ok") if p.status == "ok" else Placement(np.full((4, 4), np.nan), -np.inf, p.status)
        for T, score, p in zip(T_world_object, scores, proposals)
    ]


def _affordance_quality(
    predictor: Predictor, inputs: Inputs, sample: Sample, proposals: Sequence[Proposal]
) -> list[tuple[float, float]]:
    """IoU with the best mode and purity of each sampled score; a look at the goals that only the report takes."""
    from daptrain.prepare import LabelRule, point_affordance

    rule = LabelRule(predictor.eps_place, "hard")
    object_points = transform(inverse(sample["pose/T_world_object_start"]), sample["object/points"].astype(float))
    T_front_goal = inverse(inputs.T_world_front) @ sample["goals/T_world_object"]
    label, number = inputs.container_superpoint, len(inputs.superpoints)
    points = np.maximum(np.bincount(label, minlength=number), 1)
    near = [point_affordance(inputs.container_points, object_points, T, rule) > 0 for T in T_front_goal]
    regions = np.stack([np.bincount(label, one, number) / points > 0.5 for one in near])
    return [affordance_quality(proposal.score, regions) for proposal in proposals]


def _load(run: str | Path | None, method: str, device: str, changes: Mapping[str, Any]) -> Predictor | None:
    """The networks of the run, or None for a method that has none."""
    if method in baselines.NAMES:
        if changes:
            raise UsageError(f"changes: got {', '.join(changes)}, expected none: method '{method}' has no settings")
        return None
    if method not in LEARNED:
        raise UsageError(f"method: got '{method}', expected one of {', '.join((*LEARNED, *baselines.NAMES))}")
    if run is None:
        raise UsageError(f"method: '{method}' needs a run, got none; train one first: dapdata train DATASET --method {method}")
    from daptrain.infer import Predictor

    predictor = Predictor.load(run, device, changes=changes)
    if predictor.method != method:
        raise UsageError(f"{run}: was trained as '{predictor.method}', asked for '{method}'; give --method {predictor.method}")
    return predictor


def data_of(run: str | Path | None) -> str | Path:
    """The dataset that a run was trained on."""
    if run is None:
        raise UsageError("data: got no dataset and no run; give one with --data")
    try:
        description = json.loads((Path(run) / "config.json").read_text())
        named = description.get("data") or Path("data") / description["recipe"]["name"]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise FormatError(
            f"{run}/config.json: does not say on which data the run was trained; give them with --data"
        ) from error
    if "://" not in str(named) and not Path(named).is_dir():
        raise UsageError(f"{run}: its dataset {named} is not there; say where it is with --data")
    return str(named)


def _folder(run: str | Path | None, method: str, dataset: Dataset, changes: Mapping[str, Any]) -> Path:
    """Where a report goes if nobody says: with changes not into the run, whose own report it is not."""
    if not changes:
        return Path(run or Path("runs") / f"{method}-{Path(dataset.root).resolve().name}")
    assert run is not None, "what has no run has nothing to change"
    words = [word for name, value in changes.items() for word in (name, *(value if isinstance(value, list) else [value]))]
    beside = Path(run).resolve()
    return beside.with_name("-".join([beside.name, *map(str, words)]))


# About the method ------------------------------------------------------------------------------------------


def _weights(run: str | Path | None) -> dict[str, str]:
    if run is None:
        return {}
    files = [Path(run) / f"{net}.safetensors" for net in ("affordance", "pose")]
    return {path.name: sha256(path.read_bytes()).hexdigest() for path in files}


def _cost(found: Proposals, predictor: Predictor | None, dataset: Dataset, log: Sequence[Mapping[str, Any]]) -> Cost:
    prepare = _seconds(found.prepare_s) if found.prepare_s else None
    infer = _seconds(found.infer_s)
    if predictor is None:
        return Cost(prepare_s=prepare, infer_s=infer)
    parameters = sum(p.numel() for network in (predictor.affordance, predictor.pose) for p in network.parameters())
    return Cost(
        prepare_s=prepare,
        infer_s=infer,
        parameters=parameters,
        demos_used=predictor.config.demos or len(loading.open(dataset.root, "train")),
        training_minutes=_training_minutes(log),
        device=str(predictor.device),
    )


def _seconds(values: Sequence[float]) -> Quantiles:
    return metrics.quantiles(np.array(values))


def _log(run: str | Path | None) -> list[dict[str, Any]]:
    """What the run's training wrote down, step by step; empty for no run and for a log that is none."""
    if run is None:
        return []
    from daptrain.loop import read_metrics

    try:
        return read_metrics(Path(run))
    except ValueError:
        return []


def _training_minutes(log: Sequence[Mapping[str, Any]]) -> float | None:
    """Minutes that the networks of a run took, added up; None when nobody wrote them down."""
    spent: dict[str, float] = {}
    for entry in log:
        if "seconds" in entry:
            spent[str(entry.get("net"))] = max(spent.get(str(entry.get("net")), 0.0), float(entry["seconds"]))
    return sum(spent.values()) / 60 if spent else None


# Writing ---------------------------------------------------------------------------------------------------


def _write(folder: Path, report: Report, html: str) -> None:
    """Writes report.json and report.html, each whole or not at all."""
    text = json.dumps(report.model_dump(mode="json", by_alias=True), indent=1)
    for name, content in {"report.json": text, "report.html": html}.items():
        staged = folder / f".{name}.part"
        staged.write_text(content, encoding="utf-8")
        staged.replace(folder / name)


def _film(predictor: Predictor | None, samples: Sequence[Sample], found: Proposals, seed: int, say: Say) -> str:
    """HTML on how one scene's samples come about: the first scene with several goals; empty if there is nothing to show."""
    if predictor is None or predictor.method != "dap":
        return ""
    from daptrain.film import ROWS, film, player

    readable = [s for s in samples if found.placements[int(s["meta/demo"])][0].status != UNREADABLE]
    several = [s for s in readable if len(s["goals/T_world_object"]) >= ROWS]
    say("pictures: from noise to one place")
    return player(film(predictor, (several or readable)[0], seed)) if readable else ""
