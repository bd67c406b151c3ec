"""What each design choice is worth: a table of runs that differ from the base run in one thing each.

    python benchmarks/ablations.py data/can_cabinet --minutes 8
    python benchmarks/ablations.py data/can_cabinet --minutes 8 --rows no_condition,no_refine,rank_collision
    python benchmarks/ablations.py --list

Rows that act in training get networks of their own with the budget of the base; rows that act at inference use the
networks that are there. All are judged on the same scenes, with the same K (but for the rows that change it). Each
result is a line of OUT/results.jsonl as soon as it is there, and what is there is not made again, so that the same
command goes on where it stopped, and adds rows. The table goes to stdout and to OUT/table.md: 95 % intervals over scenes,
and McNemar's exact p of the best-ranked candidates against the base, scene by scene.

Intervals and p say what other scenes would change, not what training again would: one training each. Of thirty rows one
or two have p < 0.05 by chance. A budget of minutes wants an idle machine; --steps repeats on any, to the bit on a CPU.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from dapdata import loading, manifest, pipeline, recipe
from dapdata.config import Criterion, Step, TrainConfig
from dapdata.errors import DapdataError, UsageError, hint
from dapdata.report import compare, read_report

STEPS, CRITERIA = get_args(Step), get_args(Criterion)
BASE = "base"


@dataclass(frozen=True)
class Row:
    """One line of the table: what differs from the base."""

    name: str
    train: tuple[str, ...] = ()  # --set of `dapdata train`: networks of its own
    label: tuple[str, ...] = ()  # --set of `dapdata label`: a labelling of its own too
    method: Literal["dap", "cap"] = "dap"
    inference: tuple[str, ...] = ()  # --set of `dapdata eval`
    k: int | None = None  # candidates that are judged; None: as the base
    run: str = ""  # the row whose networks it uses; "": its own

    @property
    def setting(self) -> str:
        """What differs, as one would type it."""
        words = [*self.label, *self.train, *self.inference]
        words += [f"--method {self.method}"] * (self.method != "dap") + [f"-k {self.k}"] * (self.k is not None)
        return " ".join(words) or "the defaults"


def without(names: Sequence[str], left_out: str) -> str:
    """Such as "[yaw,settle]"."""
    return f"[{','.join(name for name in names if name != left_out)}]"


ROWS = (
    Row(BASE),
    # in training
    Row("no_condition", train=("train.object_condition=false",)),
    Row("no_radii", train=("train.score_radii=[]",)),
    Row("eps", train=("train.prediction=eps",)),
    Row("no_residual", train=("train.residual=false",)),
    Row("demonstrated", train=("train.goals=demonstrated",)),
    Row("no_mirror", train=("train.mirror=false",)),
    Row("any_yaw", train=("train.yaw=any",)),
    Row("paper", train=("train.preset=paper",)),
    Row("superpoints_192", label=("superpoints.count=192",)),
    Row("superpoints_768", label=("superpoints.count=768",)),
    Row("soft_labels", label=("label.kind=soft",)),
    # the same network as a classifier
    Row("cap", method="cap"),
    Row("cap_whole", method="cap", inference=("train.cap_crop=whole",), run="cap"),
    Row("cap_peak", method="cap", inference=("train.cap_crop=peak",), run="cap"),
    # at inference
    *(Row(f"steps_{n}", inference=(f"train.sample_steps={n}",), run=BASE) for n in (5, 10, 100)),
    *(Row(f"k_{n}", k=n, run=BASE) for n in (1, 2, 4, 16, 32)),  # the base has 8
    Row("no_refine", inference=("train.refine=[]",), run=BASE),
    *(Row(f"no_{step}", inference=(f"train.refine={without(STEPS, step)}",), run=BASE) for step in STEPS),
    *(Row(f"rank_no_{name}", inference=(f"train.ranking={without(CRITERIA, name)}",), run=BASE) for name in CRITERIA),
    Row("rank_collision", inference=("train.ranking=[collision]",), run=BASE),
    Row("rank_none", inference=("train.ranking=[]",), run=BASE),
)
BY_NAME = {row.name: row for row in ROWS}


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    options = parse(arguments)
    if options.list:
        print("\n".join(f"{row.name:<18} {'inference' if row.run else 'training':<10} {row.setting}" for row in ROWS))
        return 0
    try:
        print(Table(options).make())
    except DapdataError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    return 0


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The options; --help says what they are."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="dataset folder")
    parser.add_argument("--rows", default=",".join(BY_NAME), help="names with commas between them; default: all; see --list")
    parser.add_argument("--list", action="store_true", help="list the rows and stop")
    parser.add_argument("--minutes", type=float, help="budget of each training; default: the recipe's, or none with --steps")
    parser.add_argument("--steps", type=int, help="optimiser steps of each network, for each training")
    parser.add_argument("--trials", type=int, default=100, help="scenes; default: 100")
    parser.add_argument("--split", default="val", choices=("train", "val", "test"), help="default: val, for choices are made")
    parser.add_argument("-k", type=int, default=8, help="candidates a scene that are judged; default: 8")
    parser.add_argument("--draws", type=int, default=32, help="candidates a scene that modes are counted on; default: 32")
    parser.add_argument("--set", action="append", default=[], metavar="train.KEY=VALUE", help="of the base and all others")
    parser.add_argument("--out", type=Path, help="folder for runs, reports and table; default: runs/ablations-<dataset>")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda, ...")
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)), help="processes that judge and label")
    options = parser.parse_args(arguments)
    if options.data is None and not options.list:
        parser.error("a dataset is needed, such as data/can_cabinet")
    return options


class Table:
    """The rows that are asked for, in one folder."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.data = options, options.data
        self.rows = chosen(options.rows)
        self.about = manifest.read(self.data)
        self.out = options.out or Path("runs") / f"ablations-{self.data.resolve().name}"
        self.results = self.out / "results.jsonl"

    def make(self) -> str:
        """The table, after making every row that is not there yet."""
        self.check()
        done = self.done()
        missing = [row for row in self.rows if row.name not in done]
        for number, row in enumerate(missing, 1):
            print(f"{row.name}: row {number} of {len(missing)}: {row.setting}", file=sys.stderr, flush=True)
            done[row.name] = self.result(row)
            with self.results.open("a") as file:
                file.write(json.dumps(done[row.name]) + "\n")
        text = markdown([done[row.name] for row in self.rows], self.heading(), self.out)
        (self.out / "table.md").write_text(text + "\n", encoding="utf-8")
        return text

    def asked(self) -> dict[str, Any]:
        """What all rows have in common."""
        names = ("minutes", "steps", "trials", "split", "k", "draws", "set")
        return {"dataset": self.about.content_sha256, **{name: getattr(self.options, name) for name in names}}

    def check(self) -> None:
        """Refuses, before any work, a folder of another table and rows that cannot be made."""
        for row in self.rows:
            self.config(row)
        if len(loading.open(self.data, self.options.split)) == 0:
            raise UsageError(f"{self.data}: split '{self.options.split}': got 0 demos, expected at least 1; choose another")
        path = self.out / "asked.json"
        if path.exists():
            before = json.loads(path.read_text())
            for name, value in self.asked().items():
                if before.get(name) != value:
                    raise UsageError(
                        f"{self.out}: holds a table with {name} {before.get(name)}, now it is {value}; give another --out"
                    )
        elif self.out.exists() and any(self.out.iterdir()):
            raise UsageError(f"{self.out}: is there and holds no table, expected a new folder; give another --out")
        self.out.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(self.asked(), indent=1) + "\n")

    def done(self) -> dict[str, dict[str, Any]]:
        """Results by name; a last line that was cut short is left out, and so are rows that are defined otherwise now."""
        lines = self.results.read_text().split("\n")[:-1] if self.results.exists() else []
        if self.results.exists():  # the next line must not go on where this one was cut short
            self.results.write_text("".join(line + "\n" for line in lines))
        found = {line["name"]: line for line in map(json.loads, lines)}
        return {name: line for name, line in found.items() if name in BY_NAME and line["row"] == as_json(BY_NAME[name])}

    def config(self, row: Row) -> TrainConfig:
        """The train section of a row's recipe."""
        sets = [*self.options.set, *BY_NAME[row.run or row.name].train, *row.inference]
        return recipe.from_resolved(self.about.recipe, sets, f"row {row.name}").train

    def result(self, row: Row) -> dict[str, Any]:
        """Trains what the row needs, judges it, and returns its line of results.jsonl."""
        from daptrain import evaluate

        trained = BY_NAME[row.run or row.name]
        data, run = self.trained(trained)
        config = self.config(row).model_dump()
        changes = {key: config[key] for key in (text.split("=")[0].removeprefix("train.") for text in row.inference)}
        k = row.k or self.options.k
        folder = self.out / "reports" / row.name
        report = evaluate(
            run,
            data,
            split=self.options.split,
            trials=self.options.trials,
            method=row.method,
            k=k,
            draws=max(k, self.options.draws),
            changes=changes,
            references=row.name == BASE,
            device=self.options.device,
            workers=self.options.workers,
            out=folder,
            pictures=False,
        )
        made = {"name": row.name, "row": as_json(row), "report": str((folder / "report.json").relative_to(self.out))}
        figures = {"success": report["success"], "cost": report["cost"]}
        return made | {"recall": last(report["modes"]["recall@K"]), "references": references(report), **figures}

    def trained(self, row: Row) -> tuple[Path, Path]:
        """The dataset of a row that trains, labelled as it wants, and its run; goes on where it stopped."""
        from daptrain import train

        data, run = self.data, self.out / "runs" / row.name
        if row.label:
            data = labelled(self.data, self.out / "data" / row.name, row.label, self.options.workers)
        budget = {"minutes": self.options.minutes, "steps": self.options.steps}
        return data, train(data, run, device=self.options.device, config=self.config(row), method=row.method, **budget)

    def heading(self) -> str:
        """The line above the table."""
        asked = self.asked()
        budget = [f"{asked[name]:g} {name}" for name in ("minutes", "steps") if asked[name] is not None]
        return (
            f"{self.about.name}: {' or '.join(budget) or 'the minutes of the recipe'} of training, {asked['trials']} scenes of "
            f"{asked['split']}, K = {asked['k']}, {asked['draws']} draws{''.join(f', {text}' for text in asked['set'])}"
        )


def chosen(names: str) -> list[Row]:
    """The rows with these names in the table's order; the base always, because all others are compared with it."""
    asked = {name.strip() for name in names.split(",") if name.strip()} | {BASE}
    if unknown := sorted(asked - set(BY_NAME)):
        known = list(BY_NAME)
        raise UsageError(f"--rows: got '{unknown[0]}', expected some of {', '.join(known)}{hint(unknown[0], known)}")
    return [row for row in ROWS if row.name in asked]


def as_json(row: Row) -> dict[str, Any]:
    """A row as results.jsonl has it."""
    return dict(json.loads(json.dumps(asdict(row))))


def labelled(data: Path, copy: Path, overrides: Sequence[str], workers: int) -> Path:
    """A dataset of the same demos with other labels, beside the one that is there, whose files it shares where it can."""

    def share(source: str, target: str) -> None:
        # What a dataset appends to or replaces must be its own; the units of its stages never change.
        if Path(source).suffix in (".json", ".jsonl") and Path(source).name != "zarr.json":
            shutil.copy2(source, target)
            return
        try:
            os.link(source, target)
        except OSError:  # another file system
            shutil.copy2(source, target)

    if not (copy / manifest.MANIFEST).exists():
        shutil.rmtree(copy, ignore_errors=True)
        part = copy.with_name(copy.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        shutil.copytree(data, part, copy_function=share, ignore=shutil.ignore_patterns(".lock", "shards", manifest.PROGRESS))
        part.rename(copy)
    pipeline.label(copy, overrides, workers=workers)
    return copy


# The table -----------------------------------------------------------------------------------------------------


def last(rates: Mapping[str, Any]) -> Any:
    """The rate at the largest number of candidates."""
    return list(rates.values())[-1]


def references(report: Mapping[str, Any]) -> dict[str, Any]:
    """Success and recall of the methods that learn nothing."""
    return {
        name: {"success": summary["success"], "recall": last(summary["modes"]["recall@K"])}
        for name, summary in report["references"].items()
    }


def markdown(results: Sequence[Mapping[str, Any]], heading: str, out: Path) -> str:
    """The table of results, the base first, then each with its difference to it; below, what learns nothing."""
    columns = ("top-1", "one sample", "any of K", "near a goal", "tight goal", "recall")
    lines = [heading, "", f"| row | what differs | {' | '.join(columns)} | top-1 against base | p |"]
    lines.append("|---|---|" + "---|" * (len(columns) + 2))
    for line in results:
        row = BY_NAME[line["name"]]
        against = ["", ""]
        if row.name != BASE:
            paired = compare(out / line["report"], out / results[0]["report"])
            against = [f"{100 * paired['difference']:+.1f}", f"{paired['p_value']:.2g}"]
        cells = [row.name, f"`{row.setting}`" if row.name != BASE else "", *figures(line), *against]
        lines.append(f"| {' | '.join(cells)} |")
    for name, figure in results[0]["references"].items():
        lines.append(f"| *{name}* | | {' | '.join(figures(figure))} | | |")
    tight = read_report(out / results[0]["report"]).split.n_tight_scenes
    lines += ["", f"In %, with 95 % intervals over scenes ({tight} of them have a tight goal); p: McNemar's exact test."]
    return "\n".join(lines)


def figures(line: Mapping[str, Any]) -> list[str]:
    """The cells of a row's rates."""
    names = ("top1", "single", "any_of_K", "near_goal", "tight")
    return [percent(rate) for rate in (*(line["success"][f"success_{name}"] for name in names), line["recall"])]


def percent(rate: Mapping[str, Any]) -> str:
    """Such as "95 (90-97)"."""
    low, high = (100 * end for end in rate["ci95"])
    return f"{100 * rate['value']:.0f} ({low:.0f}-{high:.0f})"


if __name__ == "__main__":
    sys.exit(main())
