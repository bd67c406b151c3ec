"""The command line: one function a command, each of which imports what it needs when it runs.

Results go to stdout and nothing else does; progress and logs go to stderr. `run_app` is the one place that turns an
error into a line and an exit code (the codes stand in errors.py).
"""

from __future__ import annotations

import errno
import json
import logging
import os
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal

import typer

from dapdata.console import (
    comparison_text,
    last,
    made_text,
    placements_text,
    printable,
    progress,
    remember,
    report_text,
    say,
    seldom,
    show,
)
from dapdata.errors import DapdataError, UsageError, require

CLICK_ERROR: type[Exception] = typer.BadParameter.__mro__[2]  # ClickException, of all bad arguments; not exported
TOLD = 10  # rejected demos of an import that are told one by one
STOPPED, INTERRUPTED = "stopped; the same command, run again, goes on where it stopped", 130

Net = Literal["both", "affordance", "pose"]
Protocol = Literal["strict", "rpdiff", "shown"]
Split = Literal["train", "val", "test"]


def _option(*names: str, help: str, default: str = "", **more: Any) -> Any:
    """An option whose default is said in words, because it is found out when the command runs."""
    words = f"{help}; default: {default}." if default else f"{help}."
    return typer.Option(*names, help=words, show_default=False, **more)


LastDataset = Annotated[str | None, typer.Argument(help="Dataset folder or URL; default: the last one written from here.")]
LastRun = Annotated[Path | None, typer.Argument(help="Run folder; default: the last one written from here.")]
RecipeFile = Annotated[Path, typer.Argument(help="Recipe, such as recipes/quickstart.yaml.")]
Out = Annotated[
    str | None, _option("--out", help="Dataset folder, or s3://bucket/folder", default="data/<recipe name>", metavar="DIR")
]
RunFolder = Annotated[Path | None, _option("--run", help="Run folder", default="runs/<dataset name>", metavar="DIR")]
Demos = Annotated[int | None, _option("--demos", help="Number of demos", default="the recipe's", min=1, metavar="N")]
Overrides = Annotated[list[str] | None, _option("--set", help="Override of a recipe key; may be repeated", metavar="KEY=VALUE")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Only say what would be done, and why.")]
Fresh = Annotated[bool, typer.Option("--fresh", help="Delete what is there first, instead of going on.")]
Workers = Annotated[
    int | None,
    _option("--workers", help="Processes that work at the same time", default="one for each core", min=1, metavar="W"),
]
Engine = Annotated[
    str,
    typer.Option(
        "--engine",
        help="Where they work: local; ray, or ray://HOST:PORT, on a Ray cluster; inline: in this process, one after the other.",
    ),
]
Memory = Annotated[
    float | None,
    _option(
        "--memory",
        help="Memory that each of them may take; a unit that takes more has failed",
        default="an equal part of 80 % of what there is",
        min=0.1,
        metavar="GB",
    ),
]
Units = Annotated[
    str | None,
    _option(
        "--units",
        help="Make every N-th unit, from the I-th on (from 0); other tasks make the others at the same time",
        default="all units",
        metavar="I/N",
    ),
]
AllowMissing = Annotated[
    bool, typer.Option("--allow-missing", help="Publish the others when units have failed; the manifest names what is missing.")
]
Device = Annotated[str, typer.Option("--device", help="auto, cpu, cuda or cuda:N.")]
Minutes = Annotated[
    float | None, _option("--minutes", help="Wall-clock budget of training", default="the recipe's", metavar="M")
]
InSplit = Annotated[Split, typer.Option("--split", help="Which demos.")]
Trials = Annotated[int | None, _option("--trials", help="Demos of the split that are judged", default="the recipe's", min=1)]
Rules = Annotated[Protocol | None, _option("--protocol", help="Rules of the judge", default="the recipe's")]
K = Annotated[int | None, _option("-k", "--k", help="Candidates for each demo that are judged", default="the recipe's", min=1)]
JsonFile = Annotated[Path | None, _option("--out", help="File for the result as JSON", metavar="FILE.json")]

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    help="Make demonstrations of placing objects into containers; label them, train on them, judge placements in physics.",
    epilog="Start with: dapdata run recipes/quickstart.yaml",
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


def main() -> None:
    """Entry point of the `dapdata` command."""
    sys.exit(run_app(sys.argv[1:]))


def run_app(arguments: Sequence[str]) -> int:
    """Runs one command and returns its exit code; an error becomes one line on stderr."""
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(message)s")
    signal.signal(signal.SIGTERM, _terminate)
    try:
        code = app(args=list(arguments), prog_name="dapdata", standalone_mode=False)
        sys.stdout.flush()
        return _fail(STOPPED, code) if code == INTERRUPTED else code if isinstance(code, int) else 0
    except DapdataError as error:
        return _fail(str(error), error.exit_code)
    except CLICK_ERROR as error:
        message = error.format_message().rstrip(".")  # type: ignore[attr-defined]
        if not arguments:  # the message is the help
            return _fail(message, 2)
        command = "" if message.startswith("No such command") else f"{' '.join(arguments[:1])} "
        return _fail(f"{message}; see `dapdata {command}--help`", 2)
    except (KeyboardInterrupt, typer.Abort):
        return _fail(STOPPED, INTERRUPTED)
    except BrokenPipeError:  # whoever reads our output (head, less) has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        return _fail(_refusal(error), 6)


def _fail(message: str, code: int) -> int:
    print(printable(message), file=sys.stderr)
    return code


def _terminate(number: int, frame: FrameType | None) -> None:
    """SIGTERM ends a command the way Ctrl-C does."""
    raise KeyboardInterrupt


def _refusal(error: OSError) -> str:
    """One line for what the operating system refused."""
    place = error.filename or "disk"
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return f"{place}: no room left ({error.strerror}), expected more; free some, then run the same command again"
    return f"{place}: {error.strerror or error}; check the path and its permissions"


# Recipes ---------------------------------------------------------------------------------------------------


@app.command(epilog="Example: dapdata init can_cabinet --to recipes/mine.yaml")
def init(
    task: Annotated[
        str | None, typer.Argument(help="Name of a task, or `scans`; without it, the tasks are listed.", show_default=False)
    ] = None,
    folder: Annotated[
        Path | None, typer.Argument(help="With `scans`: folder for example scans.", metavar="[DIR]", show_default=False)
    ] = None,
    to: Annotated[Path | None, _option("--to", help="File to write", default="stdout", metavar="FILE")] = None,
) -> None:
    """Write a commented starter recipe, or example scans, or list the tasks."""
    from dapdata import tasks
    from dapdata.recipe import starter, summary

    if task == "scans":
        if folder is None or to is not None:
            raise UsageError("init scans: no folder was named, expected one to write; run: dapdata init scans DIR")
        from dapdata.imports import example_scans

        print(example_scans(folder))
        return
    if folder is not None:
        raise UsageError(f"init {task}: got a folder ({folder}), expected none; write the recipe to a file with --to FILE")
    if task is None:
        if to is not None:
            raise UsageError(f"--to {to}: no task was named, expected one of {', '.join(tasks.names())}")
        width = max(len(name) for name in tasks.names())
        print("\n".join(f"{name:<{width}}  {summary(name)}" for name in tasks.names()))
        return
    text = starter(task)
    if to is None:
        print(text, end="")
        return
    if to.exists():
        raise UsageError(f"--to {to}: exists already, expected a new file; delete it or choose another name")
    to.parent.mkdir(parents=True, exist_ok=True)
    to.write_text(text, encoding="utf-8")
    print(to)


@app.command(epilog="Example: dapdata schema recipe > recipe.schema.json")
def schema(
    kind: Annotated[Literal["recipe", "manifest", "shard", "report"], typer.Argument(help="What is described.")],
) -> None:
    """Print the JSON Schema of a recipe, manifest, shard or report."""
    from dapdata.schemas import schema as make_schema

    print(json.dumps(make_schema(kind), indent=2))


# Datasets --------------------------------------------------------------------------------------------------


@app.command(epilog="Example: dapdata generate recipes/can_cabinet.yaml --workers 2 --set noise.preset=kinect")
def generate(
    recipe: RecipeFile,
    out: Out = None,
    demos: Demos = None,
    workers: Workers = None,
    engine: Engine = "local",
    memory: Memory = None,
    units: Units = None,
    allow_missing: AllowMissing = False,
    overrides: Overrides = None,
    dry_run: DryRun = False,
    fresh: Fresh = False,
    as_json: Json = False,
) -> None:
    """Draw scenes, settle demonstrations, observe point clouds. Goes on where it stopped."""
    from dapdata import pipeline

    asked = _recipe(recipe, overrides, demos)
    with progress("generate", "demo") as advance:
        made = pipeline.generate(
            asked,
            out,
            workers=workers,
            engine=engine,
            memory=memory,
            units=units,
            allow_missing=allow_missing,
            fresh=fresh,
            dry_run=dry_run,
            progress=None if dry_run else advance,
        )
    _show_made(made, as_json, units)


@app.command(epilog="Example: dapdata label data/can_cabinet --set label.eps_place=0.02")
def label(
    dataset: LastDataset = None,
    workers: Workers = None,
    engine: Engine = "local",
    memory: Memory = None,
    units: Units = None,
    allow_missing: AllowMissing = False,
    overrides: Overrides = None,
    dry_run: DryRun = False,
    as_json: Json = False,
) -> None:
    """Make superpoints, affordance and correspondence, and the shards. Never simulates again."""
    from dapdata import pipeline

    folder = last("dataset", dataset)
    with progress("label", "demo") as advance:
        made = pipeline.label(
            folder,
            overrides or (),
            workers=workers,
            engine=engine,
            memory=memory,
            units=units,
            allow_missing=allow_missing,
            dry_run=dry_run,
            progress=None if dry_run else advance,
        )
    if not dry_run and units is None:  # pictures need the dataset's lock, which tasks share
        _draw_previews(made)
    _show_made(made, as_json, units)


@app.command(epilog="Example: dapdata slurm recipes/can_cabinet.yaml --tasks 20 > can_cabinet.sh; bash can_cabinet.sh")
def slurm(
    recipe: RecipeFile,
    out: Out = None,
    demos: Demos = None,
    tasks: Annotated[
        int | None,
        _option("--tasks", help="Most tasks of an array job", default="100, or one for each unit", min=1, metavar="N"),
    ] = None,
    workers: Annotated[int, typer.Option("--workers", help="Cores and processes of each task.", min=1, metavar="W")] = 1,
    memory: Annotated[float, typer.Option("--memory", help="Memory of each process.", min=0.5, metavar="GB")] = 2.0,
    time: Annotated[str, typer.Option("--time", help="Time limit of each task.", metavar="HH:MM:SS")] = "04:00:00",
    partition: Annotated[str | None, _option("--partition", help="Partition", default="the cluster's", metavar="P")] = None,
    account: Annotated[str | None, _option("--account", help="Account", default="yours", metavar="A")] = None,
    overrides: Overrides = None,
    allow_missing: AllowMissing = False,
) -> None:
    """Print a script that submits generate and label to Slurm as array jobs. Nothing is submitted by this command."""
    from dapdata.slurm import Limits, script

    asked = _recipe(recipe, overrides, demos)
    changes = [*(overrides or ()), *([f"demos={demos}"] if demos is not None else [])]
    limits = Limits(tasks, workers, memory, time, partition, account)
    print(script(asked, recipe, out, changes, limits, allow_missing), end="")


@app.command(epilog="Example: dapdata status data/can_cabinet --json")
def status(dataset: LastDataset = None, as_json: Json = False) -> None:
    """Say how far a dataset is. Units done in each stage, whether a command is at work, what it cost."""
    from dapdata import health

    found = health.status(last("dataset", dataset))
    show(found.to_dict(), as_json, str(found))


@app.command(epilog="Example: dapdata inspect data/can_cabinet --json")
def inspect(dataset: LastDataset = None, as_json: Json = False) -> None:
    """Say what is inside. Counts, statistics, splits, rejects by reason."""
    from dapdata import health

    found = health.inspect(last("dataset", dataset))
    show(found.to_dict(), as_json, str(found))


@app.command(epilog="Example: dapdata verify data/can_cabinet --deep --reproduce 2")
def verify(
    dataset: LastDataset = None,
    quick: Annotated[bool, typer.Option("--quick", help="Only compare files with their hashes.")] = False,
    deep: Annotated[bool, typer.Option("--deep", help="Decode cached units too, compare everything with everything.")] = False,
    reproduce: Annotated[
        int | None, _option("--reproduce", help="Also make so many units anew from the recipe, and compare", min=1, metavar="K")
    ] = None,
    workers: Workers = None,
    as_json: Json = False,
) -> int:
    """Say whether it is whole. Each file by its hash, each demo by its content and its sense, splits that share nothing."""
    from dapdata import health
    from dapdata.reproduce import reproduce as make_anew

    if quick and deep:
        raise UsageError("--quick, --deep: one looks at files alone, the other at everything; give one of them")
    folder = last("dataset", dataset)
    with progress("verify", "unit") as advance:
        found = health.verify(folder, quick=quick, deep=deep, progress=advance)
    if reproduce is not None and found.ok:
        with progress("reproduce", "unit") as advance:
            found = found.with_reproduced(*make_anew(folder, reproduce, workers=_count(workers), progress=advance))
    show(found.to_dict(), as_json, str(found))
    return 0 if found.ok else 3


@app.command(epilog="Example: dapdata gc data/can_cabinet --dry-run")
def gc(dataset: LastDataset = None, dry_run: DryRun = False, as_json: Json = False) -> None:
    """Free what no manifest names. Units of earlier settings, what killed processes left."""
    from dapdata import health

    found = health.gc(last("dataset", dataset), dry_run=dry_run)
    show(found.to_dict(), as_json, str(found))


@app.command("show", epilog="Example: dapdata show data/can_cabinet --out cabinet.html")
def show_dataset(
    dataset: LastDataset = None,
    out: Annotated[
        Path | None,
        _option("--out", help="A .png or .html file, with --rerun an .rrd file", default="both, named after the dataset"),
    ] = None,
    demo: Annotated[list[int] | None, _option("--demo", help="Number of a demo to show; may be repeated", min=0)] = None,
    count: Annotated[int, typer.Option("--count", min=1, max=64, help="How many demos, if none is named.")] = 4,
    rerun: Annotated[bool, typer.Option("--rerun", help="Stream to the rerun viewer, or with --out to an .rrd file.")] = False,
    as_json: Json = False,
) -> None:
    """Draw a contact sheet (PNG) and a page with a 3-D view (HTML)."""
    from dapdata.show import contact_sheet, show_html, show_rerun

    folder = last("dataset", dataset)
    if rerun:
        if out is not None and out.suffix != ".rrd":
            raise UsageError(f"--out {out}: expected an .rrd file with --rerun, or no --out for the viewer")
        shown = show_rerun(folder, out, demo, count)
        show({"files": [str(shown)] if shown else []}, as_json, str(shown or "shown in the rerun viewer"))
        return
    targets = [out] if out is not None else [Path(f"{_name(folder)}{suffix}") for suffix in (".png", ".html")]
    if any(target.suffix not in (".png", ".html") for target in targets):
        raise UsageError(f"--out {out}: expected a .png or .html file")
    draw = {".png": contact_sheet, ".html": show_html}
    written = [str(draw[target.suffix](folder, target, demo, count)) for target in targets]
    show({"files": written}, as_json, "\n".join(written))


# Training and judging --------------------------------------------------------------------------------------


@app.command(epilog="Example: dapdata train data/can_cabinet --minutes 10 --set train.preset=paper")
def train(
    dataset: LastDataset = None,
    run: RunFolder = None,
    net: Annotated[Net, typer.Option("--net", help="Which of the two networks.")] = "both",
    method: Annotated[Literal["dap", "cap"], typer.Option("--method", help="cap: classification, no diffusion.")] = "dap",
    minutes: Minutes = None,
    steps: Annotated[int | None, _option("--steps", help="Optimiser steps of each network", min=1, metavar="N")] = None,
    device: Device = "auto",
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Train on the train split. Goes on where it stopped; keeps the best (held-out) and the last weights."""
    from dapdata import loading, manifest, recipe
    from daptrain import train as train_networks

    folder = last("dataset", dataset)
    _train_keys(overrides)
    resolved = loading.open(folder).recipe
    config = recipe.from_resolved(resolved, overrides or (), f"{folder}/{manifest.MANIFEST}").train
    target = run or Path("runs") / _name(folder)
    train_networks(folder, target, net=net, minutes=minutes, steps=steps, device=device, config=config, method=method)
    remember(dataset=folder, run=target)
    show({"run": str(target), "dataset": str(folder)}, as_json, str(target))


@app.command("eval", epilog="Example: dapdata eval runs/can_cabinet --trials 50 -k 8")
def evaluate(
    run: LastRun = None,
    data: Annotated[
        str | None, _option("--data", help="Dataset folder or URL", default="the run's own", metavar="DATASET")
    ] = None,
    split: InSplit = "test",
    trials: Trials = None,
    protocol: Rules = None,
    method: Annotated[
        str | None, _option("--method", help="dap, cap; or oracle, random, heuristic, without a run", default="the run's")
    ] = None,
    k: K = None,
    draws: Annotated[
        int | None,
        _option("--draws", help="Candidates for each demo that modes are counted on", default="the recipe's, or k", min=1),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        _option("--set", help="Override of a train key that acts at inference (--curve: of any)", metavar="KEY=VALUE"),
    ] = None,
    fast: Annotated[
        bool, typer.Option("--fast", help="Few steps of sampling (train.sample_steps=3): quicker, a little less accurate.")
    ] = False,
    curve: Annotated[
        str | None,
        _option("--curve", help="Train anew on so many demos each, such as 10,20,40, and judge them all", metavar="N,N,..."),
    ] = None,
    minutes: Annotated[
        float | None, _option("--minutes", help="With --curve: budget of each size", default="the recipe's", metavar="M")
    ] = None,
    steps: Annotated[
        int | None, _option("--steps", help="With --curve: optimiser steps of each network", min=1, metavar="N")
    ] = None,
    device: Device = "auto",
    workers: Workers = None,
    out: Annotated[
        Path | None,
        _option(
            "--out", help="Folder to write", default="the run; with --set or --curve another, which is said", metavar="DIR"
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Predict on a split, then judge in physics. Writes predictions.npz, report.json, report.html, pictures of failures."""
    from dapdata.config import FAST
    from daptrain import evaluate as evaluate_run
    from daptrain.checkpoint import read_description

    judging: dict[str, Any] = {"split": split, "trials": trials, "protocol": protocol, "k": k, "draws": draws, "device": device}
    if curve is not None:
        if fast:
            raise UsageError("--fast: is of one report; with --curve give --set train.sample_steps=3")
        asked = judging | {"minutes": minutes, "steps": steps, "workers": _count(workers)}
        _evaluate_curve(curve, run, data, out, overrides, method, as_json, asked)
        return
    if minutes is not None or steps is not None:
        raise UsageError("--minutes, --steps: nothing is trained without --curve; train with: dapdata train")
    if method in (None, "dap", "cap"):
        run = Path(last("run", run))
        method = method or str(read_description(run)["method"])
    elif run is not None:  # a report of another method must not replace the run's own
        out = out or run.parent / f"{method}-{run.name}"
    elif data is None:
        data = last("dataset", None)
    changes = (FAST if fast else {}) | _train_keys(overrides)
    report = evaluate_run(run, data, method=method, changes=changes, workers=_count(workers), out=out, **judging)
    if run is not None:
        remember(run=run)
    show(report, as_json, report_text(report))


@app.command(epilog="Example: dapdata judge mine.npz --data data/can_cabinet --out mine.json")
def judge(
    predictions: Annotated[Path, typer.Argument(help="npz with demo, rank, T_world_object and score.")],
    data: Annotated[str, _option("--data", help="Dataset folder or URL", metavar="DATASET")],
    split: InSplit = "test",
    trials: Annotated[int | None, _option("--trials", help="Demos of the split that are judged", default="all", min=1)] = None,
    protocol: Annotated[Protocol, typer.Option("--protocol", help="Rules of the judge.")] = "strict",
    k: Annotated[
        int | None, _option("-k", "--k", help="Candidates for each demo that are judged, by rank", default="all", min=1)
    ] = None,
    out: JsonFile = None,
    workers: Workers = None,
    as_json: Json = False,
) -> None:
    """Judge anyone's placements, from a file. It sees no model; the method saw no goals."""
    from dapdata.metrics import judge_file

    if out is not None:  # before the work, so that it is not lost
        out.parent.mkdir(parents=True, exist_ok=True)
    report = judge_file(
        predictions, data, protocol, split=split, trials=trials, k=k, workers=_count(workers), progress=seldom(say)
    )
    if out is not None:
        out.write_text(json.dumps(report, indent=1), encoding="utf-8")
    _show_report(report, as_json)


@app.command(epilog="Example: dapdata compare runs/dap/report.json runs/cap/report.json")
def compare(
    a: Annotated[Path, typer.Argument(help="report.json of one method.")],
    b: Annotated[Path, typer.Argument(help="report.json of another, on the same scenes.")],
    out: Annotated[Path | None, _option("--out", help="Page to write, an .html file", metavar="FILE")] = None,
    as_json: Json = False,
) -> None:
    """Compare two reports scene by scene. With McNemar's paired test."""
    from dapdata.report import compare as compare_reports

    if out is not None and out.suffix != ".html":
        raise UsageError(f"--out {out}: expected an .html file")
    found = compare_reports(a, b)
    if out is not None:
        from daptrain.page import comparison_page

        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(comparison_page(a, b), encoding="utf-8")
    show(found, as_json, comparison_text(found))


@app.command(epilog="Example: dapdata predict runs/quickstart --container container.ply --object object.ply -k 8")
def predict(
    run: Annotated[Path, typer.Argument(help="Run folder.")],
    container: Annotated[Path, _option("--container", help="Scan with normals (ply, pcd, npz, npy); world frame, z up, m")],
    thing: Annotated[Path, _option("--object", help="Scan of the object, in the same frame")],
    k: Annotated[int, typer.Option("-k", "--k", min=1, help="Candidates.")] = 8,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the random draws.")] = 0,
    device: Device = "auto",
    out: JsonFile = None,
    as_json: Json = False,
) -> None:
    """Rank placements for your own scans. Each is the motion that carries the scanned object to its place."""
    from daptrain import predict as predict_placements

    placements = predict_placements(run, container, thing, k=k, seed=seed, device=device)
    rows = [
        {
            "rank": rank,
            "status": placement.status,
            "score": placement.score if placement.status == "ok" else None,
            "T_world_object": placement.T_world_object.tolist() if placement.status == "ok" else None,
        }
        for rank, placement in enumerate(placements)
    ]
    found = {"run": str(run), "container": str(container), "object": str(thing), "placements": rows}
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(found, indent=1), encoding="utf-8")
    show(found, as_json, placements_text(rows))


@app.command(epilog="Example: dapdata run recipes/quickstart.yaml")
def run(
    recipe: RecipeFile,
    out: Out = None,
    run_folder: RunFolder = None,
    demos: Demos = None,
    minutes: Minutes = None,
    trials: Trials = None,
    k: K = None,
    workers: Workers = None,
    engine: Engine = "local",
    memory: Memory = None,
    allow_missing: AllowMissing = False,
    device: Device = "auto",
    overrides: Overrides = None,
    fresh: Fresh = False,
    as_json: Json = False,
) -> None:
    """Generate, label, train and eval. Then say how well it went and where everything is."""
    from dapdata import pipeline

    _need("sim", "pybullet", "numba", "matplotlib")
    _need("train", "torch")
    from daptrain import evaluate as evaluate_run
    from daptrain import train as train_networks
    from daptrain.loop import check_budget

    check_budget(minutes, None)
    asked = _recipe(recipe, overrides, demos)
    means: dict[str, Any] = {"workers": workers, "engine": engine, "memory": memory, "allow_missing": allow_missing}
    with progress("generate", "demo") as advance:
        dataset = str(pipeline.generate(asked, out, fresh=fresh, progress=advance, **means))
    with progress("label", "demo") as advance:
        pipeline.label(dataset, progress=advance, **means)
    _draw_previews(dataset)
    remember(dataset=dataset)
    target = run_folder or Path("runs") / _name(dataset)
    if fresh and (target / "config.json").is_file():
        shutil.rmtree(target)
    train_networks(dataset, target, minutes=minutes, device=device, config=asked.train)
    remember(run=target)
    report = evaluate_run(target, dataset, trials=trials, k=k, device=device, workers=_count(workers))
    files = {"dataset": dataset, "run": target, "report": target / "report.html"} | _leave_behind(dataset, target)
    left = {name: str(path) for name, path in files.items()}
    show({**left, "result": report}, as_json, made_text(report, left))


# Other formats ---------------------------------------------------------------------------------------------

imports = typer.Typer(no_args_is_help=True, rich_markup_mode=None, epilog="Example: dapdata import rpdiff DEMOS --meshes DIR")
app.add_typer(imports, name="import", help="Make a dataset of demos in the format of other tools.")
exports = typer.Typer(no_args_is_help=True, rich_markup_mode=None, epilog="Example: dapdata export parquet DATASET --out DIR")
app.add_typer(exports, name="export", help="Write a dataset in the format of other tools.")

Target = Annotated[Path, _option("--out", help="Folder to write; must be new or empty", metavar="DIR")]
OneSplit = Annotated[Split | None, _option("--split", help="Only this split", default="all, each in files of its own")]
AtMost = Annotated[int | None, _option("--demos", help="Only so many demos, the first ones", default="all", min=1, metavar="N")]
InFile = Annotated[int | None, _option("--shard-size", help="Demos in a file", default="the format's", min=1, metavar="N")]


@imports.command("rpdiff", epilog="Example: dapdata import rpdiff book_chunked --meshes descriptions/objects --out data/books")
def import_rpdiff(
    source: Annotated[Path, typer.Argument(help="demo_aug_*.npz, single or in chunks: a file, or a folder with all below it.")],
    out: Out = None,
    meshes: Annotated[
        Path | None,
        _option(
            "--meshes", help="Folder with the meshes and slot files", default="none: goals stay as commanded", metavar="DIR"
        ),
    ] = None,
    demos: Demos = None,
    workers: Workers = None,
    engine: Engine = "local",
    memory: Memory = None,
    allow_missing: AllowMissing = False,
    overrides: Overrides = None,
    dry_run: DryRun = False,
    fresh: Fresh = False,
    as_json: Json = False,
) -> None:
    """Demos of RPDiff, or in its layout (AnyPlace). Goals are settled and checked again. Goes on where it stopped."""
    from dapdata.imports import rpdiff_recipe

    asked = rpdiff_recipe(source, meshes, demos, overrides or ())
    means = {"workers": workers, "engine": engine, "memory": memory, "allow_missing": allow_missing, "fresh": fresh}
    _import(asked, out, dry_run, as_json, **means)


@imports.command("scans", epilog="Example: dapdata import scans scans --out data/scans")
def import_scans(
    source: Annotated[
        Path, typer.Argument(help="Folder with a folder of scans for each demonstration; see `dapdata init scans`.")
    ],
    out: Out = None,
    demos: Demos = None,
    workers: Workers = None,
    engine: Engine = "local",
    memory: Memory = None,
    allow_missing: AllowMissing = False,
    overrides: Overrides = None,
    dry_run: DryRun = False,
    fresh: Fresh = False,
    as_json: Json = False,
) -> None:
    """Your own scans, before and after. Where the object went is told by registration, or the demo is rejected."""
    from dapdata.imports import agreement, scans_recipe

    asked = scans_recipe(source, demos, overrides or ())
    means = {"workers": workers, "engine": engine, "memory": memory, "allow_missing": allow_missing, "fresh": fresh}
    _import(asked, out, dry_run, as_json, **means)
    if not dry_run:
        for line in agreement(asked, out):
            say(line)


def _import(asked: Any, out: str | None, dry_run: bool, as_json: bool, **means: Any) -> None:
    """Runs a recipe that imports, and says how many demos came in."""
    from dapdata import health
    from dapdata.imports import run

    with progress("import", "demo") as advance:
        made = run(asked, out, dry_run=dry_run, progress=None if dry_run else advance, **means)
    if not isinstance(made, str | Path):
        show(made.to_dict(), as_json, str(made))
        return
    rejected = health.rejected(made)
    for told in rejected[:TOLD]:
        say(f"rejected demo {told['demo']}, {told['reason']}: {told['detail']}")
    if len(rejected) > TOLD:
        say(f"rejected {len(rejected) - TOLD} more; --json tells all")
    counts = "".join(f", {count} {reason}" for reason, count in Counter(told["reason"] for told in rejected).items())
    say(f"imported {asked.demos - len(rejected)} of {asked.demos} demos{counts}; next: dapdata label {made}")
    remember(dataset=made)
    show({"dataset": str(made), "demos": asked.demos, "rejected": rejected}, as_json, str(made))


@exports.command("webdataset", epilog="Example: dapdata export webdataset data/can_cabinet --out tars --shard-size 200")
def export_webdataset(
    out: Target,
    dataset: LastDataset = None,
    split: OneSplit = None,
    demos: AtMost = None,
    shard_size: InFile = None,
    as_json: Json = False,
) -> None:
    """Tar files of npy and json, to be streamed. One sample a demo; 500 in a file."""
    _export("webdataset", dataset, out, as_json, split=split, demos=demos, shard_size=shard_size)


@exports.command("parquet", epilog="Example: dapdata export parquet data/can_cabinet --out hub --no-previews")
def export_parquet(
    out: Target,
    dataset: LastDataset = None,
    split: OneSplit = None,
    demos: AtMost = None,
    shard_size: InFile = None,
    previews: Annotated[bool, typer.Option("--previews/--no-previews", help="Draw a picture of each demo.")] = True,
    as_json: Json = False,
) -> None:
    """Parquet files for the Hugging Face viewer, datasets, pandas. One row a demo; 1000 in a file."""
    _export("parquet", dataset, out, as_json, split=split, demos=demos, shard_size=shard_size, previews=previews)


@exports.command("pointcept", epilog="Example: dapdata export pointcept data/can_cabinet --out pointcept/data/can_cabinet")
def export_pointcept(
    out: Target,
    dataset: LastDataset = None,
    split: OneSplit = None,
    demos: AtMost = None,
    as_json: Json = False,
) -> None:
    """Folders of npy for Pointcept's DefaultDataset. Where to place, as segmentation of the clouds."""
    _export("pointcept", dataset, out, as_json, split=split, demos=demos)


@exports.command("scenes", epilog="Example: dapdata export scenes data/can_cabinet --out scenes --split test --demos 20")
def export_scenes(
    out: Target,
    dataset: LastDataset = None,
    split: OneSplit = None,
    demos: AtMost = None,
    as_json: Json = False,
) -> None:
    """GLB and URDF of the true scenes. Container and clutter, the object, every goal as a frame."""
    _export("scenes", dataset, out, as_json, split=split, demos=demos)


@exports.command("scans", epilog="Example: dapdata export scans data/fruit_rack --out scans")
def export_scans(
    out: Target,
    dataset: LastDataset = None,
    split: OneSplit = None,
    demos: AtMost = None,
    as_json: Json = False,
) -> None:
    """Simulated scans before and after, for `dapdata import scans`. With noise, partial views, and the truth beside them."""
    _export("scans", dataset, out, as_json, split=split, demos=demos)


@exports.command("rpdiff", epilog="Example: dapdata export rpdiff data/can_cabinet --out rpdiff/can_cabinet_chunked")
def export_rpdiff(
    out: Target,
    dataset: LastDataset = None,
    split: OneSplit = None,
    demos: AtMost = None,
    shard_size: InFile = None,
    as_json: Json = False,
) -> None:
    """Chunks that RPDiff's own loader reads. With split lists and meshes; 9 demos in a file."""
    _export("rpdiff", dataset, out, as_json, split=split, demos=demos, shard_size=shard_size)


def _export(kind: str, dataset: str | None, out: Path, as_json: bool, **options: Any) -> None:
    """Runs one export; options that were not given are the format's own."""
    from importlib import import_module

    folder, write = last("dataset", dataset), import_module(f"dapdata.interop.{kind}").export
    given = {name: value for name, value in options.items() if value is not None}
    with progress(f"export {kind}", "demo") as advance:
        made = write(folder, out, **given, progress=advance)
    show({"out": str(made), "format": kind, "dataset": str(folder), **options}, as_json, str(made))


# Around ----------------------------------------------------------------------------------------------------


@app.command(epilog="Example: dapdata doctor --out /data/mine --extra sim")
def doctor(
    out: Annotated[Path, typer.Option("--out", help="Where datasets are to be written.", metavar="DIR")] = Path("data"),
    extra: Annotated[list[str] | None, _option("--extra", help="An extra that must be there; may be repeated")] = None,
    as_json: Json = False,
) -> int:
    """Say what is installed, what the machine offers, and what to do about what is missing."""
    from dapdata.doctor import examine

    found = examine(out, extra or ())
    show(found.to_dict(), as_json, str(found))
    return 0 if found.ok else 6


@app.command(epilog="Example: dapdata bench --scale quick")
def bench(
    against: Annotated[str | None, _option("--against", help="Only benchmarks that know this rival")] = None,
    scale: Annotated[Literal["quick", "normal", "long"], typer.Option("--scale", help="How many repetitions.")] = "normal",
    as_json: Json = False,
) -> None:
    """Measure speed, memory and start-up. On this machine, next to named rivals."""
    from dapdata import bench as benchmarks

    about, rows = benchmarks.machine(), []
    for row in benchmarks.run(against, scale):
        say(benchmarks.table([row]).split("\n")[1])
        rows.append(row)
    text = "\n".join([*(f"{name}: {value}" for name, value in about.items()), "", benchmarks.table(rows)])
    show({"machine": about, "rows": rows}, as_json, text)


# What several commands do ----------------------------------------------------------------------------------


def _need(extra: str, *packages: str) -> None:
    """Raises a MissingExtraError before anything is written if a package is not installed; imports none of them."""
    for package in packages:
        if find_spec(package) is None:
            require(package, extra)


def _recipe(path: Path, overrides: list[str] | None, demos: int | None) -> Any:
    """The recipe that a command line asks for."""
    from dapdata.recipe import load

    return load(path, [*(overrides or ()), *([f"demos={demos}"] if demos is not None else [])])


def _train_keys(overrides: list[str] | None) -> dict[str, Any]:
    """Keys of the train section that `--set` gives, with their values as written; any other section is refused."""
    from dapdata.strict_yaml import Source

    source = Source("--set")
    for override in overrides or ():
        if not override.startswith("train."):
            raise UsageError(f"--set {override}: expected a key of the train section, such as train.sample_steps=10")
        source.override(override)
    return dict(source.tree.get("train", {}))


def _evaluate_curve(
    sizes: str,
    run: Path | None,
    data: str | None,
    out: Path | None,
    overrides: list[str] | None,
    method: str | None,
    as_json: bool,
    asked: dict[str, Any],
) -> None:
    """`dapdata eval --curve`; `asked` are further arguments of `daptrain.curve.curve`."""
    from dapdata import loading, manifest, recipe
    from daptrain.checkpoint import read_description
    from daptrain.curve import curve, text
    from daptrain.evaluation import data_of

    numbers = sizes.replace(" ", "").split(",")
    if not all(number.isdecimal() for number in numbers):
        raise UsageError(f"--curve: got '{sizes}', expected numbers of demos with commas between them, such as 10,20,40")
    description = {} if run is None else read_description(run)
    folder = data or (last("dataset", None) if run is None else str(data_of(run)))
    _train_keys(overrides)
    resolved = loading.open(folder).recipe | ({"train": description["train"]} if description else {})
    config = recipe.from_resolved(resolved, overrides or (), str(run or f"{folder}/{manifest.MANIFEST}")).train
    method = method or str(description.get("method", "dap"))
    target = out or run or Path("runs") / f"curve-{_name(folder)}"
    found = curve(folder, target, [int(number) for number in numbers], config=config, method=method, **asked)
    remember(dataset=folder)
    show(found, as_json, f"{text(found)}\n\n{target / 'curve.html'}")


def _count(workers: int | None) -> int:
    """How many processes: as many as asked for, or one for each core that this process may use."""
    return workers or len(os.sched_getaffinity(0))


def _draw_previews(dataset: Any) -> None:
    """Adds the pictures of the dataset's card, unless they are there already."""
    from dapdata import loading, manifest, pipeline
    from dapdata.show import preview

    if not any(path.startswith(f"{manifest.PREVIEWS}/") for path in loading.open(dataset).manifest.files):
        pipeline.attach(dataset, preview(dataset))


def _show_made(made: Any, as_json: bool, units: str | None) -> None:
    """Shows the dataset's folder or URL, or the plan."""
    if isinstance(made, str | Path):
        if units is None:
            remember(dataset=made)
        show({"dataset": str(made)}, as_json, str(made))
    else:
        show(made.to_dict(), as_json, str(made))


def _name(dataset: str) -> str:
    """The last part of a dataset's folder or URL."""
    return Path(dataset).resolve().name


def _show_report(report: dict[str, Any], as_json: bool) -> None:
    """Shows a report, then raises a CorruptionError if its judge is broken."""
    from dapdata.metrics import require_sound
    from dapdata.report import Report

    show(report, as_json, report_text(report))
    require_sound(Report.model_validate_json(json.dumps(report)))


def _leave_behind(dataset: str, run: Path) -> dict[str, Path]:
    """Pictures of the dataset, and the clouds of one held-out demo as scans to try `dapdata predict` on."""
    from dapdata.clouds import write_ply
    from dapdata.loading import open as open_dataset
    from dapdata.show import contact_sheet, show_html

    sample = next(iter(open_dataset(dataset, "test")), None) or open_dataset(dataset)[0]
    scans = {name: run / f"{name}.ply" for name in ("container", "object")}
    for name, path in scans.items():
        write_ply(path, sample[f"{name}/points"], sample[f"{name}/normals"])
    pictures = {"pictures": contact_sheet(dataset, run / "dataset.png"), "viewer": show_html(dataset, run / "dataset.html")}
    return {**pictures, **{f"{name} scan": path for name, path in scans.items()}}
