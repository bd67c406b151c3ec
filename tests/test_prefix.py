"""Demo i follows from recipe, seed and i alone, in true physics: however many there are, in whatever order, by whomever."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toy_stages

import dapdata
from dapdata import health, manifest, pipeline, recipe
from dapdata.plan import Plan

SMALL = {  # scenes as drawn, seen coarsely: most of the time goes into physics
    "cameras": {
        "width": 96, "height": 72, "container_views": 2, "object_views": 2, "container_voxel": 0.02, "object_voxel": 0.015,
        "min_container_points": 100, "min_object_points": 10,
    },
    "superpoints": {"count": 40, "object_count": 8},
    "split": {"val": 0.2, "test": 0.2},
}  # fmt: skip
LONGEST = 8  # demos
KILL_ONCE = __name__  # as a table: the true stages, in which TOY_FAULT strikes


def strike(stage: pipeline.Stage) -> pipeline.Stage:
    """The stage, in which the worker may die at a demo."""

    def run(made: Any, sections: Any, draw: Any) -> Any:
        toy_stages.misbehave(int(made["demonstrate"].demo))
        return stage.run(made, sections, draw)

    return replace(stage, run=run)


STAGES = tuple(strike(stage) if stage.name == "observe" else stage for stage in pipeline.STAGES)
parse = pipeline.parse


def asked(task: str, demos: int, shard_size: int, **changes: Any) -> recipe.Recipe:
    return recipe.from_resolved(
        {"name": task, "seed": 4, "demos": demos, "shard_size": shard_size, "scene": {"task": task}, **SMALL, **changes}
    )


def make(
    root: Path, task: str, demos: int, shard_size: int, workers: int, table: str = pipeline.__name__, **changes: Any
) -> Path:
    """A labelled dataset; one worker works in this process."""
    how: dict[str, Any] = {"workers": workers, "engine": "inline" if workers == 1 else "local", "table": table}
    pipeline.generate(asked(task, demos, shard_size, **changes), root, **how)
    pipeline.label(root, **how)
    return root


@pytest.fixture(scope="module")
def longest(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """By task, the dataset that all others should begin as; made when first asked for."""
    folder = tmp_path_factory.mktemp("longest")

    class Made(dict[str, Path]):
        def __missing__(self, task: str) -> Path:
            self[task] = make(folder / task, task, LONGEST, LONGEST, 1)
            return self[task]

    return Made()


def demos_of(root: Path) -> Iterator[tuple[int, str, str]]:
    """Number, digest of all arrays, and split of each demo."""
    index = dapdata.open(root).index
    yield from zip(index["demo"].tolist(), index["sha256"].tolist(), index["split"].tolist())


def is_prefix(short: Path, long: Path) -> bool:
    """Whether a dataset's demos and splits are the other's first, in more than name."""
    mine, others = list(demos_of(short)), list(demos_of(long))
    last = dapdata.open(short)[-1]
    same = all(np.array_equal(array, dapdata.open(long)[len(mine) - 1][path]) for path, array in last.items())
    return mine == others[: len(mine)] and same


COMBINATIONS = [  # task, demos, shard size, workers, what else happens
    ("can_cabinet", 1, 1, 1, "nothing"),
    ("can_cabinet", 3, 2, 2, "nothing"),
    ("can_cabinet", 5, 2, 3, "a worker dies"),
    ("book_shelf", 3, 2, 2, "in reverse"),
    ("can_cabinet", 2, 1, 2, "in reverse"),
    ("can_cabinet", 4, 2, 1, "in reverse"),
    ("can_cabinet", 4, 3, 2, "a worker dies"),
    ("can_cabinet", 6, 5, 1, "nothing"),
    ("can_cabinet", 7, 2, 3, "in reverse"),
    ("can_cabinet", 8, 3, 2, "nothing"),
    ("can_cabinet", 8, 1, 3, "a worker dies"),
    ("can_cabinet", 5, 5, 2, "a worker dies"),
    ("book_shelf", 1, 1, 1, "nothing"),
    ("book_shelf", 2, 1, 2, "a worker dies"),
    ("book_shelf", 4, 2, 1, "in reverse"),
    ("book_shelf", 5, 3, 2, "nothing"),
    ("book_shelf", 6, 2, 3, "a worker dies"),
    ("book_shelf", 7, 4, 2, "in reverse"),
    ("book_shelf", 8, 2, 1, "nothing"),
    ("book_shelf", 8, 5, 3, "in reverse"),
]
FAST = (("can_cabinet", 4, 2, 1, "in reverse"),)  # with workers: test_pipeline.py


@pytest.mark.parametrize(
    ("task", "demos", "shard_size", "workers", "event"),
    [pytest.param(*c, marks=[] if c in FAST else [pytest.mark.slow]) for c in COMBINATIONS],
    ids=lambda value: str(value).replace(" ", "_"),
)
def test_a_dataset_is_the_beginning_of_a_longer_one_whatever_happens(
    longest: dict[str, Path], task: str, demos: int, shard_size: int, workers: int, event: str,
    in_memory: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    table = pipeline.__name__
    if event == "in reverse":
        jobs = pipeline._Command._jobs
        monkeypatch.setattr(pipeline._Command, "_jobs", lambda self, needed: dict(reversed(jobs(self, needed).items())))
    if event == "a worker dies":
        table = KILL_ONCE
        monkeypatch.setenv("TOY_FAULT", f"kill:{demos - 1}:{in_memory / 'died'}")
    root = make(in_memory / task, task, demos, shard_size, workers, table)
    assert (event == "a worker dies") == (in_memory / "died").exists()
    assert is_prefix(root, longest[task])
    assert health.verify(root).ok


def test_a_combination_is_there_for_each_promise() -> None:
    assert len(COMBINATIONS) == len({*COMBINATIONS}) == 20
    assert {*FAST} < {*COMBINATIONS}


# What runs again ---------------------------------------------------------------------------------------------


@pytest.fixture
def grown(in_memory: Path) -> Path:
    return make(in_memory / "grown", "can_cabinet", 3, 3, 1)


def ran(root: Path, since: int) -> Counter[str]:
    """How many demos each stage made, by the log from that line on."""
    counts = Counter[str]()
    for line in (root / manifest.LOG).read_text().splitlines()[since:]:
        counts[json.loads(line)["stage"]] += json.loads(line)["demos"]
    return counts


def lines(root: Path) -> int:
    return len((root / manifest.LOG).read_text().splitlines())


def said(plan: Path | Plan) -> dict[str, tuple[int, tuple[str, ...]]]:
    """What a dry run says of each stage: demos that run, and why."""
    assert isinstance(plan, Plan)
    return {stage.stage: (stage.demos, stage.reasons) for stage in plan.stages}


def test_only_what_changed_runs_again_and_a_dry_run_says_so_beforehand(grown: Path) -> None:
    """More demos, other noise, another label, another seed: with the key that changed, in true physics."""
    before = {demo: (digest, split) for demo, digest, split in demos_of(grown)}
    more = asked("can_cabinet", 5, 3)
    plan = said(pipeline.generate(more, grown, dry_run=True))
    assert plan == {"demonstrate": (2, ("demos 3 -> 5",)), "observe": (2, ("demos 3 -> 5",))}
    since = lines(grown)
    pipeline.generate(more, grown, engine="inline")
    pipeline.label(grown, engine="inline")
    assert ran(grown, since) == {"demonstrate": 2, "observe": 2, "cluster": 2, "label": 2}
    assert {demo: (digest, split) for demo, digest, split in demos_of(grown) if demo < 3} == before

    override = "label.eps_place=0.02"
    plan = said(pipeline.label(grown, [override], dry_run=True))
    assert plan == {"cluster": (0, ()), "label": (5, ("label.eps_place 0.03 -> 0.02",))}
    since = lines(grown)
    pipeline.label(grown, [override], engine="inline")
    assert ran(grown, since) == {"label": 5}

    noisy = asked("can_cabinet", 5, 3, noise={"preset": "kinect"})
    plan = said(pipeline.generate(noisy, grown, dry_run=True))
    assert plan == {"demonstrate": (0, ()), "observe": (5, ("noise.preset d415 -> kinect",))}
    physics = {path: os.stat(path).st_mtime_ns for path in sorted(grown.glob("stages/demonstrate/*/zarr.json"))}
    since = lines(grown)
    pipeline.generate(noisy, grown, engine="inline")
    pipeline.label(grown, engine="inline")
    assert ran(grown, since) == {"observe": 5, "cluster": 5, "label": 5}
    assert {path: os.stat(path).st_mtime_ns for path in sorted(grown.glob("stages/demonstrate/*/zarr.json"))} == physics

    plan = said(pipeline.generate(noisy.model_copy(update={"seed": 5}), grown, dry_run=True))
    assert plan["demonstrate"] == (5, ("seed 4 -> 5",))
    assert health.verify(grown, deep=True).ok
