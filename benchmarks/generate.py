"""CPU seconds from a recipe to labelled shards, per demo, with every goal settled; and where they go.

One figure is one run of `generate` and `label` in this process into an empty folder, for one shard: scenes, physics,
seven views with noise, normals, superpoints, labels, checks, hashes, writing and fsync. Imports and compilation are
done before. Round r uses seed r for all cases; where the time goes is what the dataset's own log says.

The named figure is RPDiff's own generator: CPU seconds per saved demo, measured once on another machine of this
kind with its sleeps replaced by stepping, at 640x480; it settles one goal and makes no noise, normals or labels.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from timing import Row, main, published, rows

from dapdata import pipeline, recipe

RECIPES = Path(__file__).parents[1] / "recipes"
TASKS = "can_cabinet", "book_shelf"
SIZES = (320, 240), (640, 480)
RPDIFF_MS = {"can_cabinet": 3200.0, "book_shelf": 6700.0}
LIMIT_MS = {320: 35.0, 640: 90.0}
UNIT = "CPU ms/demo"
Case = tuple[str, tuple[int, int]]


def make(case: Case, demos: int, seed: int) -> dict[str, float]:
    """CPU ms per demo of a dataset of one shard: in all, and where they went."""
    task, (width, height) = case
    changes = {"cameras.width": width, "cameras.height": height, "demos": demos, "shard_size": demos, "seed": seed}
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / task
        start = time.process_time()
        wanted = recipe.load(RECIPES / f"{task}.yaml", [f"{key}={value}" for key, value in changes.items()])
        pipeline.generate(wanted, root, engine="inline")
        pipeline.label(root, engine="inline")
        spent = {"dapdata": (time.process_time() - start) * 1e3 / demos}
        log = [json.loads(line) for line in (root / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    for entry in log:
        spent[entry["stage"]] = (entry["cpu_seconds"] - entry["cpu_seconds_to_write"]) * 1e3 / demos
    spent["writing"] = sum(entry["cpu_seconds_to_write"] for entry in log) * 1e3 / demos
    return spent | {"reading, manifest": 2 * spent["dapdata"] - sum(spent.values())}


def run(scale: str, against: str | None) -> Iterator[Row]:
    demos, rounds = {"quick": (10, 2), "normal": (50, 4), "long": (50, 12)}[scale]
    cases = [(task, size) for size in SIZES for task in TASKS]
    spent: dict[Case, dict[str, list[float]]] = {case: defaultdict(list) for case in cases}
    for case in cases:
        make(case, demos=2, seed=0)
    for seed in range(1, rounds + 1):
        for case in cases:
            for name, value in make(case, demos, seed).items():
                spent[case][name].append(value)
    for case, values in spent.items():
        task, (width, height) = case
        name = f"{task} {width}x{height}"
        note = {"dapdata": f"{demos} demos a round; limit {LIMIT_MS[width]:.0f}"}
        (ours,) = rows("generate", name, {"dapdata": values.pop("dapdata")}, UNIT, note)
        yield ours
        if (width, height) == (640, 480) and against in (None, "rpdiff"):
            yield published(ours, "rpdiff", RPDIFF_MS[task], "its own generator: one goal, no noise, normals or labels")
        for part, measured in values.items():
            yield from rows("generate", name, {f"  of which {part}": measured}, UNIT)


if __name__ == "__main__":
    main(run)
