"""What ten million demos cost: measured where that can be, counted and simulated where not. Prints the tables of docs/scale.md.

Made and timed for real are: a few hundred demos with one worker and with two; the manifest, index, folders and log of a
dataset of the whole size, all but the arrays; and the publishing of some thousand units. The cluster is a simulation
of workers that take units from one queue, each as long as a unit was measured to take.

    PYTHONPATH=. python benchmarks/scale.py                      # all tables: half an hour and 5 GB of disk
    PYTHONPATH=. python benchmarks/scale.py --demos 100000 --small   # the same in minutes
"""

from __future__ import annotations

import argparse
import heapq
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from dapdata import audit, durable, health, loading, manifest, pipeline, recipe, rng, stages, store, tables, units

RECIPE = Path(__file__).parents[1] / "recipes/can_cabinet.yaml"
CUT = 1000  # demos whose rows are made at once
OPENING = ("read", "index", "open", "train", "order", "status", "inspect", "plan", "verify")
WORKERS = (16, 256, 2048)
LOST = 0.1  # of the workers


# A dataset without its arrays ------------------------------------------------------------------------------


def write_synthetic(root: Path, demos: int, shard_size: int) -> None:
    """A dataset of that size as far as manifest, index, folders and log go: its units are empty folders."""
    resolved = recipe.resolve(recipe.load(RECIPE, [f"demos={demos}", f"shard_size={shard_size}"]))
    specs = stages.specs(pipeline.STAGES, resolved)
    layout, todo = units.layout_of(root, pipeline.STAGES, specs, resolved), stages.units(demos, shard_size)
    root.mkdir(parents=True)
    with tempfile.TemporaryDirectory(dir=root.parent) as folder, (root / manifest.LOG).open("w") as log:
        table, index = Path(folder) / manifest.UNITS, Path(folder) / manifest.INDEX
        with tables.writer(table) as made:
            for name in layout.plan:
                for unit in todo:
                    made.add([manifest.unit_row(name, _entry(layout, name, unit))])
                    (root / layout.path(name, unit)).mkdir(parents=True)
                    log.write(json.dumps(_log_line(name, unit)) + "\n")
                made.end_group()
        with tables.writer(index) as made:
            for start in range(0, len(todo), max(1, CUT // shard_size)):
                made.add_table(_index_rows(layout, todo[start : start + max(1, CUT // shard_size)]))
        entries = {name: manifest.Units(table, name, len(todo)) for name in layout.plan}
        about = manifest.Manifest(
            format=manifest.FORMAT,
            name=resolved["name"],
            task="can_cabinet",
            demos=demos,
            content_sha256="0" * 64,
            recipe=resolved,
            recipe_sha256=durable.digest(resolved),
            shards=[],
            splits=units._splits(tables.Index(index), True),
            rejects=manifest.Rejects(attempts={}, demos={}, goals={}),
            stages={},
            files={},
            created_by={},
        )
        named = {name: manifest.StageEntry.model_construct(spec=specs[name], units=found) for name, found in entries.items()}
        whole = about.model_copy(update={"shards": entries[layout.shard_stage], "stages": named})
        manifest.publish(root, whole, {manifest.UNITS: table, manifest.INDEX: index, manifest.CARD: b"synthetic\n"})


def _entry(layout: stages.Layout, stage: str, unit: stages.Unit) -> manifest.UnitEntry:
    key = layout.key(stage, unit)
    return manifest.UnitEntry.model_construct(
        path=layout.path(stage, unit),
        demos=unit.stop - unit.start,
        demo_range=(unit.start, unit.stop),
        key=key,
        sha256=durable.digest([key]),
        bytes=10_000_000 + unit.index,
    )


def _log_line(stage: str, unit: stages.Unit) -> dict[str, Any]:
    """As long as a true one."""
    demos = unit.stop - unit.start
    times = {"seconds": 1.234, "cpu_seconds": 1.234, "cpu_seconds_to_write": 0.123, "seconds_to_write": 0.234}
    place = {"stage": stage, "unit": [unit.index, unit.start, unit.stop], "demos": demos}
    return {**place, **times, "bytes": 10_000_000, "peak_mb": 300}


def _index_rows(layout: stages.Layout, some: Sequence[stages.Unit]) -> pa.Table:
    """Rows of the index for the demos of some units, with columns as hard to compress as true ones."""
    start, stop = some[0].start, some[-1].stop
    random, count = rng.stream(0, "benchmark", start), stop - start
    digests = random.bytes(32 * count).hex()
    words = {
        "split": random.choice(["train", "val", "test"], count, p=[0.8, 0.1, 0.1]).tolist(),
        "shard": [layout.path(layout.shard_stage, unit) for unit in some for _ in range(unit.stop - unit.start)],
        "task": ["can_cabinet"] * count,
        "sha256": [digests[at : at + 64] for at in range(0, len(digests), 64)],
    }
    numbers = {
        "demo": np.arange(start, stop),
        "row": np.concatenate([np.arange(unit.stop - unit.start) for unit in some]),
        "seed": np.zeros(count, np.int64),
        **{name: random.integers(0, 2**62, count) for name in health.INSTANCES},
        "attempts": random.integers(1, 4, count),
        **{name: random.integers(100, 9000, count) for name in (*units.COUNTED, "positives")},
    }
    order = ["demo", "split", "shard", "row", "task", "sha256", *list(numbers)[2:]]
    return pa.table({name: (words | numbers)[name] for name in order})


def measure(what: str, root: Path) -> dict[str, float]:
    """Wall and CPU seconds and peak MB of one thing that is done with a dataset, in this process."""
    wall, cpu = time.perf_counter(), time.process_time()
    if what == "read":
        manifest.read(root)
    elif what == "index":
        manifest.read_index(root)["split"]
    elif what == "open":
        loading.open(root)
    elif what == "train":
        loading.open(root, "train")
    elif what == "order":
        loading.Order(loading.open(root, "train"), True, 0, 0, 1, True).part(0, 0, 8)
    elif what == "status":
        health.status(root)
    elif what == "inspect":
        health.inspect(root)
    elif what == "plan":
        pipeline.generate(recipe.from_resolved(manifest.read(root).recipe), root, dry_run=True)
    elif what == "verify":
        audit._record = lambda root, entry, stage: (None, [])  # the units themselves are not there
        health.verify(root, quick=True)
    return {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu, "peak_mb": _peak_mb()}


def _peak_mb() -> float:
    """The largest memory of this process (getrusage would count what its parent had when it was started)."""
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def measured(what: str, root: Path) -> dict[str, float]:
    """The same in a process of its own, so that it remembers nothing."""
    command = [sys.executable, __file__, "--measure", what, str(root)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def opening_table(root: Path, demos: int, shard_size: int) -> Iterator[str]:
    """What it costs to look at a dataset of that size."""
    words = {
        "read": "`manifest.read`",
        "index": "one column of the index",
        "open": "`dapdata.open(root)`",
        "train": '`dapdata.open(root, split="train")`',
        "order": "the same, and the shuffled order of the first pass",
        "status": "`dapdata status`",
        "inspect": "`dapdata inspect`",
        "plan": "`dapdata generate --dry-run`, with a tenth of a stage's units gone",
        "verify": "`dapdata verify --quick`, but for the units' own files",
    }
    files = [root / name for name in (manifest.MANIFEST, manifest.UNITS, manifest.INDEX, manifest.LOG)]
    yield f"{demos} demos in {-(-demos // shard_size)} shards of {shard_size}; " + ", ".join(
        f"`{path.name}` {path.stat().st_size / 1e6:.1f} MB" for path in files if path.exists()
    )
    yield from ("", "| what | wall s | CPU s | peak MB |", "|---|---|---|---|")
    for what in OPENING:
        if what == "plan":
            _lose_a_tenth(root, "observe")
        found = measured(what, root)
        yield f"| {words[what]} | {found['wall']:.2f} | {found['cpu']:.2f} | {found['peak_mb']:.0f} |"


def _lose_a_tenth(root: Path, stage: str) -> None:
    for path in sorted((root / "stages" / stage).iterdir())[::10]:
        path.rmdir()


# Publishing ------------------------------------------------------------------------------------------------


def write_records(root: Path, demos: int, shard_size: int) -> tuple[Any, ...]:
    """Units that consist of their own record alone, which is all that publishing reads; the arguments of `publish`."""
    asked = recipe.load(RECIPE, [f"demos={demos}", f"shard_size={shard_size}"])
    resolved = recipe.resolve(asked)
    layout = units.layout_of(root, pipeline.STAGES, stages.specs(pipeline.STAGES, resolved), resolved)
    todo = stages.units(demos, shard_size)
    for stage in pipeline.STAGES:
        made = [other.makes for other in pipeline.STAGES] if stage.is_shard else [stage.makes]
        arrays = [f"{name}/{column.name}" for name, columns in store.group_columns(*made).items() for column in columns]
        for unit in todo:
            folder = layout.folder(stage.name, unit)
            folder.mkdir(parents=True)
            record = _record(layout, stage, unit, arrays)
            document = {"attributes": {"dapdata": record}, "zarr_format": 3, "node_type": "group"}
            (folder / "zarr.json").write_text(json.dumps(document))
    return layout, pipeline.STAGES, resolved, asked.split, todo


def _record(layout: stages.Layout, stage: stages.Stage, unit: stages.Unit, arrays: Iterable[str]) -> dict[str, Any]:
    random = rng.stream(0, f"benchmark {stage.name}", unit.start)
    fact = {"sha256": "0" * 64, "bytes": 123_456}
    rows = []
    for demo in range(unit.start, unit.stop):
        row: dict[str, Any] = {"demo": demo, "sha256": random.bytes(32).hex()}
        if stage.is_shard:
            row |= {"seed": 0, **{name: int(random.integers(2**62)) for name in health.INSTANCES}, "attempts": 1, "task": 0}
            row |= {name: int(random.integers(9000)) for name in (*units.COUNTED, "positives")}
        rows.append(row)
    return {
        "format": store.FORMAT,
        "stage": stage.name,
        "key": layout.key(stage.name, unit),
        "demo_range": [unit.start, unit.stop],
        "rejects": {what: {} for what in ("attempts", "demos", "goals")},
        "rows": rows,
        "files": {f"{array}/{name}": fact for array in arrays for name in ("zarr.json", "c/0")},
    }


def publish(demos: int, shard_size: int) -> dict[str, float]:
    """Wall and CPU seconds and peak MB of publishing so many demos, in this process."""
    with tempfile.TemporaryDirectory() as folder:
        arguments = write_records(Path(folder) / "dataset", demos, shard_size)
        wall, cpu = time.perf_counter(), time.process_time()
        units.publish(*arguments)
        return {"wall": time.perf_counter() - wall, "cpu": time.process_time() - cpu, "peak_mb": _peak_mb()}


def published(demos: int, shard_size: int) -> dict[str, float]:
    """The same in a process of its own."""
    command = [sys.executable, __file__, "--publish", str(demos), "--shard-size", str(shard_size)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def publishing_table(sizes: Sequence[int], shard_size: int, demos: int) -> Iterator[str]:
    """What it costs to make manifest, index and card of units that are there."""
    yield from ("", f"| demos, in shards of {shard_size} | wall s | CPU s | CPU ms a demo | peak MB |", "|---|---|---|---|---|")
    each = 0.0
    for size in sizes:
        found = published(size, shard_size)
        each = found["cpu"] / size
        yield f"| {size} | {found['wall']:.1f} | {found['cpu']:.1f} | {1e3 * each:.3f} | {found['peak_mb']:.0f} |"
    yield from ("", f"At the last rate, {demos} demos take {each * demos / 60:.0f} CPU minutes to publish.")


# What a demo costs -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cost:
    """What some demos cost."""

    demos: int
    workers: int
    wall: float  # s
    cpu: float  # s, of all processes
    shard_bytes: float
    cache_bytes: float  # of the upstream stages, but for what the shards are linked to
    files: int  # in a shard


def make(demos: int, shard_size: int, workers: int) -> Cost:
    """Generates and labels for real, with so many workers."""
    with tempfile.TemporaryDirectory() as folder:
        root, before = Path(folder) / "dataset", _cpu()
        wall = time.perf_counter()
        pipeline.generate(recipe.load(RECIPE, [f"demos={demos}", f"shard_size={shard_size}"]), root, workers=workers)
        pipeline.label(root, workers=workers)
        wall, cpu = time.perf_counter() - wall, _cpu() - before
        shards = manifest.read(root).shards
        both = [path.stat() for path in (root / "stages").rglob("*") if path.is_file()]
        files = sum(path.is_file() for path in (root / shards[0].path).rglob("*"))
        alone = sum(fact.st_size for fact in both if fact.st_nlink == 1)
        return Cost(demos, workers, wall, cpu, sum(s.bytes for s in shards), alone, files)


def start_up() -> float:
    """CPU seconds of a process that imports what a worker needs, makes one demo with it, and ends."""
    before = _cpu()
    subprocess.run([sys.executable, __file__, "--one"], check=True, stdout=subprocess.DEVNULL)
    return _cpu() - before


def _cpu() -> float:
    kinds = (resource.getrusage(kind) for kind in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(used.ru_utime + used.ru_stime for used in kinds)


def cost_table(found: Sequence[Cost]) -> Iterator[str]:
    """What a demo and a GB cost with one worker and with more."""
    yield "| workers | demos | wall s | CPU s | CPU s a demo | CPU s a unit of 50 | CPU s a GB of shards |"
    yield "|---|---|---|---|---|---|---|"
    for cost in found:
        each = cost.cpu / cost.demos
        rates = f"{each:.3f} | {50 * each:.1f} | {cost.cpu / cost.shard_bytes * 1e9:.0f}"
        yield f"| {cost.workers} | {cost.demos} | {cost.wall:.1f} | {cost.cpu:.1f} | {rates} |"
    one = found[0]
    yield ""
    shard, cache = (part / one.demos / 1e3 for part in (one.shard_bytes, one.cache_bytes))
    yield f"A demo is {shard:.0f} kB in its shard and {cache:.0f} kB more in the cached stages; a shard has {one.files} files."


# The cluster -----------------------------------------------------------------------------------------------


def simulate(
    count: int, seconds: float, workers: int, start: float, lost_at: float = float("inf"), lost: int = 0, replaced: bool = True
) -> float:
    """Seconds until the last of some units is made by workers that take them from one queue.

    Args:
        count: Units.
        seconds: That one takes.
        workers: How many there are.
        start: Seconds from a worker's start to its first unit.
        lost_at: When some of them die, with the unit that each is at: it goes back to the queue.
        lost: How many.
        replaced: Whether others take their place at once; they have to start first.
    """
    free = [(start, number) for number in range(workers)]  # when each worker is free, and who it is
    waiting, end, dying = count, 0.0, set(range(lost))
    while waiting:
        now, number = heapq.heappop(free)
        if number in dying and now + seconds > lost_at:
            dying.discard(number)
            if replaced:
                heapq.heappush(free, (max(lost_at, now) + start, number))
            continue
        waiting -= 1
        end = max(end, now + seconds)
        heapq.heappush(free, (now + seconds, number))
    return end


def cluster_table(demos: int, shard_size: int, cost: Cost, start: float, plan_seconds: float) -> Iterator[str]:
    """Files, bytes, tasks and hours of a dataset of that size, and what losing a tenth of the workers costs."""
    count, seconds = -(-demos // shard_size), cost.cpu / cost.demos * shard_size
    kept, cached = (part / cost.demos * demos / 1e12 for part in (cost.shard_bytes, cost.cache_bytes))
    hours = cost.cpu / cost.demos * demos / 3600
    yield f"{demos} demos in {count} shards of {shard_size}: {count * cost.files / 1e6:.1f} million files,"
    yield f"{kept:.2f} TB of shards, {cached:.3f} TB more while the stages are kept; {hours:.0f} CPU hours; a unit takes"
    yield f"{seconds:.0f} s, a worker starts in {start:.1f} s, a stopped command plans again in {plan_seconds:.1f} s;"
    yield f"{count} Ray tasks for `generate` and as many for `label`, one a unit."
    yield from (
        "",
        "| workers | units a worker | minutes | a tenth of the workers is lost half-way, and replaced | not replaced |",
    )
    yield "|---|---|---|---|---|"
    for workers in WORKERS:
        whole, lost = simulate(count, seconds, workers, start), int(LOST * workers)
        hurt = [simulate(count, seconds, workers, start, whole / 2, lost, replaced) for replaced in (True, False)]
        yield f"| {workers} | {count / workers:.0f} | {whole / 60:.1f} | {hurt[0] / 60:.1f} | {hurt[1] / 60:.1f} |"


# ------------------------------------------------------------------------------------------------------------


def machine() -> Mapping[str, Any]:
    """What the figures were measured on."""
    from dapdata import bench

    return bench.machine()


def report(demos: int, shard_sizes: Sequence[int], few: int, publish_sizes: Sequence[int]) -> Iterator[str]:
    """The tables of docs/scale.md."""
    yield ", ".join(f"{name} {value}" for name, value in machine().items())
    costs, start = [make(few, 50, workers) for workers in (1, 2)], start_up()
    yield from ("", "## cost", "", *cost_table(costs))
    for shard_size in shard_sizes:
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder) / "dataset"
            write_synthetic(root, demos, shard_size)
            yield from ("", "## opening", "", *opening_table(root, demos, shard_size))
            seconds = measured("plan", root)["wall"]
        yield from ("", "## cluster", "", *cluster_table(demos, shard_size, costs[0], start, seconds))
    yield from ("", "## publishing", *publishing_table(publish_sizes, shard_sizes[0], demos))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--demos", type=int, default=10_000_000)
    parser.add_argument("--shard-size", type=int, nargs="+", default=[500, 50])
    parser.add_argument("--small", action="store_true", help="few true demos and few published units")
    parser.add_argument("--measure", nargs=2, metavar=("WHAT", "ROOT"), help=argparse.SUPPRESS)
    parser.add_argument("--publish", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measure(options.measure[0], Path(options.measure[1]))))
    elif options.one:
        with tempfile.TemporaryDirectory() as folder:
            root = pipeline.generate(recipe.load(RECIPE, ["demos=1"]), Path(folder) / "one", engine="inline")
            pipeline.label(str(root), engine="inline")
    elif options.publish:
        print(json.dumps(publish(options.publish, options.shard_size[0])))
    else:
        os.environ["OMP_NUM_THREADS"] = "1"
        few, sizes = (50, (10_000, 20_000)) if options.small else (300, (200_000, 800_000))
        for line in report(options.demos, options.shard_size, few, sizes):
            print(line, flush=True)


if __name__ == "__main__":
    main()
