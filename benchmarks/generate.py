"""CPU seconds from a recipe to labelled shards, per demo, with every goal settled; and where they go.

Each figure is one run of `generate` and `label` into an empty folder by this process alone: scenes, physics, seven
views with noise, normals, superpoints, labels, checks, hashes, writing and fsync. Imports and compilation are
done before. Round r uses seed r for all cases. The stages are timed in the same round on the same demos, in memory.

The named figure is RPDiff's own generator: CPU seconds per saved demo, measured once on another run of a machine of
this kind with its sleeps replaced by stepping; it settles one goal and makes no noise, normals or labels.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
from typing import Any

from timing import Row, main, published, rows

from dapdata import pipeline, recipe, rng
from dapdata.records import Rejected

RECIPES = Path(__file__).parents[1] / "recipes"
TASKS = "can_cabinet", "book_shelf"
SIZES = (320, 240), (640, 480)
RPDIFF_MS = {"can_cabinet": 3200.0, "book_shelf": 6700.0}
LIMIT_MS = {320: 100.0, 640: 220.0}
UNIT = "CPU ms/demo"


def cpu_ms() -> float:
    """CPU time of this process and of the children it has waited for."""
    return sum(usage.ru_utime + usage.ru_stime for usage in map(getrusage, (RUSAGE_SELF, RUSAGE_CHILDREN))) * 1e3


def load(task: str, size: tuple[int, int], demos: int, seed: int) -> recipe.Recipe:
    """The shipped recipe of a task at an image size, all demos in one shard."""
    width, height = size
    changes = {"cameras.width": width, "cameras.height": height, "demos": demos, "shard_size": demos, "seed": seed}
    return recipe.load(RECIPES / f"{task}.yaml", [f"{key}={value}" for key, value in changes.items()])


def whole(task: str, size: tuple[int, int], demos: int, seed: int) -> float:
    """CPU ms per demo of one run from recipe to shards."""
    with tempfile.TemporaryDirectory() as folder:
        start = cpu_ms()
        pipeline.generate(load(task, size, demos, seed), Path(folder) / task)
        pipeline.label(Path(folder) / task)
        return (cpu_ms() - start) / demos


def stages(task: str, size: tuple[int, int], demos: int, seed: int) -> dict[str, float]:
    """CPU ms per demo of each stage alone, rejected attempts included."""
    wanted = load(task, size, demos, seed)
    spent: dict[str, float] = defaultdict(float)
    for demo in range(demos):
        made: dict[str, Any] = {}
        for stage in pipeline.STAGES:
            sections = {name: getattr(wanted, name) for name in stage.sections}
            start = time.process_time()
            for attempt in range(stage.attempts):

                def draw(purpose: str, demo: int = demo, attempt: int = attempt) -> Any:
                    return rng.stream(seed, purpose, demo, attempt)

                made[stage.name] = stage.run(made, sections, draw)
                if not isinstance(made[stage.name], Rejected):
                    break
            spent[stage.name] += (time.process_time() - start) * 1e3 / demos
            if isinstance(made[stage.name], Rejected):
                print(f"{task} demo {demo}: {stage.name} rejected it: {made[stage.name].reason}", file=sys.stderr)
                break
    return spent


def run(scale: str, against: str | None) -> Iterator[Row]:
    demos, rounds = {"quick": (6, 2), "normal": (25, 5), "long": (100, 10)}[scale]
    cases = [(task, size) for size in SIZES for task in TASKS]
    total: dict[Any, list[float]] = defaultdict(list)
    parts: dict[Any, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for case in cases:
        whole(*case, demos=2, seed=0)  # imports, compilation
    for seed in range(1, rounds + 1):
        for case in cases:
            total[case].append(whole(*case, demos=demos, seed=seed))
            for stage, value in stages(*case, demos=demos, seed=seed).items():
                parts[case][stage].append(value)
    for task, (width, height) in cases:
        name, case = f"{task} {width}x{height}", (task, (width, height))
        note = {"dapdata": f"{demos} demos a round; limit {LIMIT_MS[width]:.0f}"}
        (ours,) = rows("generate", name, {"dapdata": total[case]}, UNIT, note)
        yield ours
        yield published(ours, "rpdiff", RPDIFF_MS[task], "its own generator, 640x480, one goal, no noise, normals or labels")
        for stage, values in parts[case].items():
            yield from rows("generate", name, {f"  of which {stage}": values}, UNIT)
        rest = [all_ - sum(values[i] for values in parts[case].values()) for i, all_ in enumerate(total[case])]
        yield from rows("generate", name, {"  of which storage": rest}, UNIT)


if __name__ == "__main__":
    main(run)
