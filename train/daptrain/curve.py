"""Sample efficiency: how well both networks do when they learn from 10, 20, 40, ... demonstrations.

    from daptrain.curve import curve
    curve("data/can_cabinet", "runs/can_curve", [10, 20, 40, 80], minutes=5)

Each size gets networks of its own, trained on the first so many demos of the train split (so that fewer are a part of
more) with the same budget, and judged on the same scenes. The folder then holds

- `curve.json`: what was asked and, for each size, success with its intervals, recall, and what it cost;
- `curve.png`, `curve.html`: the same to look at;
- `curve/<demos>/`: the run of each size, with its report.

A size that is in `curve.json` is not trained or judged again; one that was interrupted goes on where it stopped.
"""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, cast

from pydantic import ValidationError

from dapdata import durable, loading
from dapdata.config import AT_INFERENCE, EvalConfig, TrainConfig
from dapdata.errors import CheckpointError, FormatError, UsageError
from dapdata.loading import Dataset
from dapdata.metrics import Protocol
from dapdata.report import Cost, Interval, Part, Report, Success
from daptrain.checkpoint import Method, write_whole
from daptrain.evaluation import LEARNED, evaluate
from daptrain.loop import check_budget, train
from daptrain.page import curve_page

Say = Callable[[str], None]

FORMAT = "dapdata.curve/1"
SHOWN = {"success_top1": ("best-ranked candidate", "#d95f02"), "success_single": ("one sample, on average", "#7570b3")}
HEURISTIC = ("heuristic, nothing learned", "#5c6577")
LATER = frozenset(AT_INFERENCE) - {"crop_margin"}  # keys of a train config that do not act in training
ELSEWHERE = {"demos", "minutes", "preset"} | LATER  # keys that `Asked.training` does not repeat


class Figures(Part):
    """What the report on one method says of the scenes."""

    success: Success
    recall: dict[str, Interval]


class Point(Figures):
    """The networks that learned from so many demos."""

    demos: int
    cost: Cost


class Asked(Part):
    """What all points of a curve have in common."""

    task: str
    dataset: str
    data: str
    training: dict[str, Any]
    judging: dict[str, Any]


class Curve(Part):
    """The content of curve.json."""

    format: Literal["dapdata.curve/1"] = "dapdata.curve/1"
    asked: Asked
    references: dict[str, Figures]
    points: list[Point]


def curve(
    data: str | Path,
    out: str | Path,
    sizes: Sequence[int],
    *,
    minutes: float | None = None,
    steps: int | None = None,
    config: TrainConfig | None = None,
    method: str = "dap",
    split: str = "test",
    trials: int | None = None,
    protocol: Protocol | None = None,
    k: int | None = None,
    draws: int | None = None,
    device: str = "auto",
    workers: int = 1,
    say: Say | None = None,
) -> dict[str, Any]:
    """The content of curve.json, after training and judging every size that is not in it yet.

    Args:
        data: Dataset folder.
        out: Folder for the curve; made when missing. It may be a run's.
        sizes: Numbers of demos.
        minutes: Wall-clock budget of both networks, for each size; default: the config's, or none with `steps`.
        steps: Optimiser steps of each network, for each size.
        config: Of the networks; default: the train section of the dataset's recipe. Its `demos` are replaced.
        method: "dap" or "cap".
        split, trials, protocol, k, draws: As of `evaluate`.
        device: Of the networks.
        workers: Processes that judge.
        say: Gets a line now and then; default: stderr.

    Raises:
        UsageError: a size that the train split does not hold, a budget that is none, nothing to judge. Nothing was done yet.
        CheckpointError: the folder holds a curve of other data or of another training.
        CorruptionError: the recorded goals fail before the judge.
    """
    say = say or (lambda line: print(line, file=sys.stderr, flush=True))
    out, dataset = Path(out), loading.open(data, "train")
    config = config or dataset.section("train", TrainConfig)
    if method not in LEARNED:
        raise UsageError(f"method: got '{method}', which learns nothing, expected one of {', '.join(LEARNED)}")
    sizes = check_sizes(sizes, dataset)
    check_budget(minutes, steps)
    minutes = config.minutes if minutes is None and steps is None else minutes
    judging = judging_settings(loading.open(data, split), split, trials, protocol, k, draws)
    now = begun(out, asked(dataset, data, config, method, minutes, steps, judging))
    out.mkdir(parents=True, exist_ok=True)
    write_json(out, now)  # before the work, so that no later call goes on with another budget
    for demos in sizes:
        if any(point.demos == demos for point in now.points):
            continue
        run = out / "curve" / str(demos)
        say(f"curve: {demos} demonstrations, {sizes.index(demos) + 1} of {len(sizes)} sizes")
        mine = config.model_copy(update={"demos": demos})
        train(data, run, minutes=minutes, steps=steps, device=device, config=mine, method=cast(Method, method))
        first = not now.references
        report = Report.model_validate(
            evaluate(
                run, data, method=method, references=first, device=device, workers=workers, pictures=False, say=say, **judging
            )
        )
        point = Point(demos=demos, success=report.success, recall=report.modes.recall_at_K, cost=report.cost)
        references = {
            name: Figures(success=summary.success, recall=summary.modes.recall_at_K)
            for name, summary in report.references.items()
        }
        now = Curve(
            asked=now.asked,
            references=references if first else now.references,
            points=sorted([*now.points, point], key=lambda p: p.demos),
        )
        write(out, now)
    write(out, now)
    return now.model_dump(mode="json")


def check_sizes(sizes: Sequence[int], dataset: Dataset) -> list[int]:
    """The sizes in rising order, each once, if the train split holds them all."""
    held = len(dataset)
    if wrong := [size for size in sizes if not 1 <= size <= held]:
        raise UsageError(
            f"curve: got {', '.join(map(str, wrong))} demos, the train split of {dataset.root} holds {held}; "
            f"expected sizes from 1 to {held}"
        )
    if not sizes:
        raise UsageError("curve: got no sizes, expected numbers of demos such as 10, 20, 40")
    return sorted(set(sizes))


def judging_settings(
    dataset: Dataset, split: str, trials: int | None, protocol: Protocol | None, k: int | None, draws: int | None
) -> dict[str, Any]:
    """How all points are judged: what was given, and the recipe's for the rest; arguments of `evaluate`."""
    if len(dataset) == 0:
        raise UsageError(f"{dataset.root}: split '{split}': got 0 demos, expected at least 1; choose another split")
    given = {"trials": trials, "protocol": protocol, "k": k, "draws": draws}
    usual = dataset.section("eval", EvalConfig).model_dump()
    found = usual | {name: value for name, value in given.items() if value is not None}
    found["trials"] = min(found["trials"], len(dataset))
    found["draws"] = found["draws"] if draws is not None else max(found["draws"] or found["k"], found["k"])
    if found["draws"] < found["k"]:
        raise UsageError(f"draws: got {draws}, expected at least k ({found['k']}): what is judged was drawn; give more")
    return {"split": split, **{name: found[name] for name in given}}


def asked(
    dataset: Dataset,
    data: str | Path,
    config: TrainConfig,
    method: str,
    minutes: float | None,
    steps: int | None,
    judging: Mapping[str, Any],
) -> Asked:
    """What the points of a curve must have in common to stand on one line."""
    keys = config.model_dump(mode="json")
    fixed = {name: value for name, value in keys.items() if name not in ELSEWHERE}
    return Asked(
        task=dataset.task,
        dataset=dataset.digest,
        data=str(data),
        training={"method": method, "minutes": minutes, "steps": steps, **fixed},
        judging={**judging, **{name: keys[name] for name in sorted(LATER)}},
    )


def begun(out: Path, wanted: Asked) -> Curve:
    """The curve that the folder holds, without points that were judged otherwise; an empty one where there is none.

    Raises:
        FormatError: a curve.json of another format.
        UsageError: a folder of something else.
        CheckpointError: a curve of other data or another training.
    """
    path = out / "curve.json"
    if not path.exists():
        if durable.is_occupied(out) and not (out / "config.json").exists():
            raise UsageError(
                f"{out}: is there and is no curve, expected a new folder, a curve's or a run's; give another one with --out"
            )
        return Curve(asked=wanted, references={}, points=[])
    try:
        found = Curve.model_validate(json.loads(path.read_text()))
    except (OSError, ValueError, ValidationError) as error:
        raise FormatError(f"{path}: {str(error).splitlines()[0]}, expected format {FORMAT}; delete it or give --out") from error
    before = {"dataset": found.asked.dataset, **found.asked.training}
    for name, value in {"dataset": wanted.dataset, **wanted.training}.items():
        if before.get(name) != value:
            raise CheckpointError(
                f"{out}: holds a curve with {name} {before.get(name)}, now it is {value}; give another folder with --out, or "
                "delete this one"
            )
    if found.asked.judging != wanted.judging:
        return Curve(asked=wanted, references={}, points=[])
    return found.model_copy(update={"asked": wanted})


# What is written -----------------------------------------------------------------------------------------------


def write(out: Path, now: Curve) -> None:
    """Writes curve.json, curve.png and curve.html, each whole or not at all."""
    write_json(out, now)
    write_whole(out / "curve.png", draw(now))
    write_whole(out / "curve.html", curve_page(now).encode())


def write_json(out: Path, now: Curve) -> None:
    write_whole(out / "curve.json", (json.dumps(now.model_dump(mode="json"), indent=1) + "\n").encode())


def draw(now: Curve) -> bytes:
    """Success over the number of demonstrations with bands of 95 %, as the bytes of a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.6, 4.8), layout="constrained")
    axes = figure.subplots()
    sizes = [point.demos for point in now.points]
    for name, (label, color) in SHOWN.items():
        rates = [getattr(point.success, name) for point in now.points]
        low, high = ([100 * rate.ci95[end] for rate in rates] for end in (0, 1))
        axes.fill_between(sizes, low, high, color=color, alpha=0.16, lw=0)
        axes.vlines(sizes, low, high, color=color, lw=1.2, alpha=0.6)
        axes.plot(sizes, [100 * rate.value for rate in rates], "o-", color=color, ms=5.5, lw=2, label=label)
    if "heuristic" in now.references:
        label, color = HEURISTIC
        rate = now.references["heuristic"].success.success_top1
        axes.axhspan(100 * rate.ci95[0], 100 * rate.ci95[1], color=color, alpha=0.08, lw=0)
        axes.axhline(100 * rate.value, color=color, lw=1.4, ls=(0, (5, 3)), label=label)
    axes.set_xscale("log")
    axes.set_xticks(sizes, [f"{size:,}" for size in sizes])
    axes.minorticks_off()
    axes.set_ylim(0, 102)
    axes.set_yticks(range(0, 101, 20))
    axes.grid(axis="y", color="#e6e9ef", lw=0.8)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("demonstrations learned from")
    axes.set_ylabel("placements that hold in physics, %")
    axes.set_title(f"{now.asked.task}: {budget(now)} of training for each size, {scenes(now)}", loc="left", fontsize=11)
    axes.legend(frameon=False, loc="lower right", fontsize=9.5)
    image = io.BytesIO()
    figure.savefig(image, format="png", dpi=130, metadata={"Software": "dapdata"})
    return image.getvalue()


def budget(now: Curve) -> str:
    """Such as `5 min`."""
    minutes, steps = now.asked.training["minutes"], now.asked.training["steps"]
    return " or ".join([*([f"{minutes:g} min"] if minutes else []), *([f"{steps:,} steps"] if steps else [])])


def scenes(now: Curve) -> str:
    """Such as `100 scenes of val`."""
    return f"{now.asked.judging['trials']} scenes of {now.asked.judging['split']}"


def text(found: Mapping[str, Any]) -> str:
    """The content of curve.json as a table, a line for each size."""
    now = Curve.model_validate(found)
    names = ("top1", "single", "near_goal", "tight")
    lines = [f"{now.asked.task}, {budget(now)} for each size, {scenes(now)}, K = {now.asked.judging['k']}"]
    lines.append("  ".join(["demos    ", *(f"{name:<16}" for name in names), "recall@K"]))
    rows: list[tuple[str, Figures]] = [(str(point.demos), point) for point in now.points]
    for name, figures in [*rows, *((name, now.references[name]) for name in ("heuristic",) if name in now.references)]:
        rates = [getattr(figures.success, f"success_{column}") for column in names]
        cells = [f"{100 * r.value:5.1f} % ({100 * r.ci95[0]:.0f}-{100 * r.ci95[1]:.0f})" for r in rates]
        recall = list(figures.recall.values())[-1]
        lines.append("  ".join([f"{name:<9}", *(f"{cell:<16}" for cell in cells), f"{100 * recall.value:.1f} %"]).rstrip())
    return "\n".join(lines)
