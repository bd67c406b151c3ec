"""One unit of work: JSON in, committed folders out. And what a dataset is once its units are there.

`run_unit` is what every worker of every engine does. A stage is handed records, its own recipe sections and its own
generator, nothing else. A demo that a stage rejects is left out of that unit and of those that follow, and counted.
"""

from __future__ import annotations

import json
import resource
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from dapdata import card, durable, manifest, rng, split, store
from dapdata.config import SplitConfig
from dapdata.errors import CorruptionError, DapdataError, UsageError
from dapdata.manifest import Manifest, Rejects, SplitEntry, StageEntry, UnitEntry
from dapdata.records import Demo, Record, Rejected, read_record, to_sample
from dapdata.stages import Layout, Spec, Stage, Unit

CALL = "dapdata.units:run_unit"
COUNTED = {  # column of the index: array whose rows it counts
    "container_points": "container/points",
    "object_points": "object/points",
    "superpoints": "container_superpoints/points",
    "object_superpoints": "object_superpoints/points",
    "goals": "goals/T_world_object",
    "rejected_goals": "rejected_goals/T_world_object",
    "correspondences": "correspondence/distance",
}
Made = dict[int, Record]  # by demo


@dataclass(frozen=True)
class Work:
    """A job: what to make of which demos. As JSON it holds names and numbers only."""

    root: str
    table: str  # module that holds STAGES, in order, and parse(resolved) -> recipe
    recipe: dict[str, Any]
    specs: dict[str, Spec]
    unit: tuple[int, int, int]
    stages: tuple[str, ...]
    needed: int  # bytes that the command was estimated to write, for the message of a full disk

    def to_json(self) -> str:
        """The job as the text that an engine hands over."""
        return json.dumps(vars(self))


def layout_of(root: Path, stages: Sequence[Stage], specs: Mapping[str, Spec], recipe: Mapping[str, Any]) -> Layout:
    """Where the units of this dataset are."""
    shard_stage = next(stage.name for stage in stages if stage.is_shard)
    return Layout(root, specs, recipe["seed"], recipe["shard_size"], shard_stage)


def run_unit(text: str) -> str:
    """Makes what is missing of one unit, stage by stage, each committed on its own.

    Args:
        text: A `Work` as JSON.

    Returns:
        JSON: what was made, with seconds and bytes; or {"error": [class, message]} for an error that is the user's.
    """
    work = Work(**json.loads(text))
    try:
        with durable.disk_problems(Path(work.root), work.needed):
            return json.dumps(_make(work))
    except DapdataError as error:
        return json.dumps({"error": [type(error).__name__, str(error)]})


def _make(work: Work) -> dict[str, Any]:
    table = import_module(work.table)
    stages: dict[str, Stage] = {stage.name: stage for stage in table.STAGES}
    layout = layout_of(Path(work.root), table.STAGES, work.specs, work.recipe)
    recipe, unit = table.parse(work.recipe), Unit(*work.unit)
    made: dict[str, Made] = {}
    told = []
    for stage in (stages[name] for name in work.stages):
        if store.is_committed(layout.folder(stage.name, unit)):
            continue
        start, cpu = time.perf_counter(), time.process_time()
        for need in stage.needs:
            if need not in made:
                made[need] = _load(layout, stages[need], unit)
        made[stage.name], rejects = _run_stage(stage, recipe, made, unit)
        ran, ran_cpu = time.perf_counter(), time.process_time()
        size = _commit(layout, stages, stage, unit, made, rejects)
        told.append(
            {
                "stage": stage.name,
                "unit": list(work.unit),
                "demos": len(made[stage.name]),
                "seconds": round(time.perf_counter() - start, 3),
                "cpu_seconds": round(time.process_time() - cpu, 3),
                "cpu_seconds_to_write": round(time.process_time() - ran_cpu, 3),
                "seconds_to_write": round(time.perf_counter() - ran, 3),
                "bytes": size,
                "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
            }
        )
    return {"made": told}


# Running a stage -------------------------------------------------------------------------------------------


def _run_stage(stage: Stage, recipe: Any, made: Mapping[str, Made], unit: Unit) -> tuple[Made, dict[str, Counter[str]]]:
    """The records of a unit's demos in one stage, and how many attempts and demos were rejected, by reason."""
    sections = {name: getattr(recipe, name) for name in stage.sections}
    rejects: dict[str, Counter[str]] = {"attempts": Counter(), "demos": Counter(), "goals": Counter()}
    records: Made = {}
    for demo in range(unit.start, unit.stop):
        if any(demo not in made[need] for need in stage.needs):
            continue
        inputs = {need: made[need][demo] for need in stage.needs}
        reasons: Counter[str] = Counter()
        for attempt in range(stage.attempts):
            draw = partial(_draw, recipe.seed, demo, attempt)
            result = stage.run(inputs, sections, draw)
            if not isinstance(result, Rejected):
                records[demo] = _finished(result, recipe.seed, demo, attempt)
                break
            reasons[result.reason] += 1
        if stage.attempts == 1:
            rejects["demos"] += reasons
        elif demo not in records:
            raise UsageError(_no_demo(recipe, stage, demo, reasons))
        else:
            rejects["attempts"] += reasons
    return records, rejects


def _draw(seed: int, demo: int, attempt: int, purpose: str) -> Any:
    return rng.stream(seed, purpose, demo, attempt)


def _finished(record: Record, seed: int, demo: int, attempt: int) -> Record:
    """The record as it will be read back, so that a resumed unit goes on with the same numbers; a Demo is told who it is."""
    if isinstance(record, Demo):
        record = replace(record, demo=demo, seed=seed, attempts=attempt + 1)  # type: ignore[arg-type]
    kind: Any = type(record)
    stored: Record = read_record(kind, to_sample(record))
    return stored


def _no_demo(recipe: Any, stage: Stage, demo: int, reasons: Counter[str]) -> str:
    counts = ", ".join(f"{reason} {count}" for reason, count in reasons.most_common())
    return (
        f"{recipe.name}: no demo {demo} after {stage.attempts} attempts ({counts}), expected one that holds; "
        f"widen the ranges of {' or '.join(stage.sections)} in the recipe"
    )


# To and from disk ------------------------------------------------------------------------------------------


def _load(layout: Layout, stage: Stage, unit: Unit) -> Made:
    """The records of a committed unit, after its files were compared with their hashes."""
    folder = layout.folder(stage.name, unit)
    record = store.read_record(folder)
    damage = next(store.damaged_files(folder, record), None)
    if damage or record["key"] != layout.key(stage.name, unit):
        raise CorruptionError(
            f"{folder}: {damage or 'made for another key'}, expected the unit as it was written; "
            "delete that folder and run `dapdata generate` again: it alone is made anew"
        )
    block = store.read_block(folder)
    kind: Any = stage.makes
    return {row["demo"]: read_record(kind, block.sample(i)) for i, row in enumerate(record["rows"])}


def _commit(
    layout: Layout,
    stages: Mapping[str, Stage],
    stage: Stage,
    unit: Unit,
    made: Mapping[str, Made],
    rejects: dict[str, Counter[str]],
) -> int:
    """Checks, writes and commits a unit; the bytes that were written for it."""
    parts = [stages[name] for name in layout.plan if stage.is_shard and name in stage.needs] + [stage]
    demos = sorted(made[stage.name])
    samples = [to_sample(*(made[part.name][demo] for part in parts)) for demo in demos]
    for demo, sample in zip(demos, samples):
        problem = next(store.problems(sample), None)
        if problem:
            raise ValueError(f"stage {stage.name}, demo {demo}: {problem}")
        rejects["goals"] += _rejected_goals(sample) if not stage.is_shard else Counter()
    about = {
        "format": store.FORMAT,
        "stage": stage.name,
        "key": layout.key(stage.name, unit),
        "demo_range": [unit.start, unit.stop],
        "rejects": {what: dict(sorted(counts.items())) for what, counts in rejects.items()},
        "rows": [_row(demo, sample, stage.is_shard) for demo, sample in zip(demos, samples)],
    }
    lenders = list(_lenders(layout, stage, unit, demos)) if stage.is_shard else []
    target = layout.folder(stage.name, unit)
    with durable.staged(layout.root, target.name) as folder:
        record = store.write_unit(folder, [part.makes for part in parts], samples, about, lenders)
        if not durable.commit(folder, target) and store.read_record(target)["rows"] != record["rows"]:
            raise CorruptionError(
                f"{target}: was made twice with different results, expected the same: stage {stage.name} is not "
                "deterministic on this machine; run `dapdata doctor`, then generate with --fresh"
            )
    borrowed = {name for one in lenders for name in one.files}
    return sum(fact["bytes"] for name, fact in record["files"].items() if name not in borrowed)


def _lenders(layout: Layout, stage: Stage, unit: Unit, demos: Sequence[int]) -> Iterator[store.Lender]:
    """Upstream units that hold exactly the same demos: a shard takes their files as they are."""
    for need in stage.needs:
        folder = layout.folder(need, unit)
        record = store.read_record(folder)
        if [row["demo"] for row in record["rows"]] == list(demos):
            yield store.lender(folder, record)


def _rejected_goals(sample: store.Sample) -> Counter[str]:
    path = "rejected_goals/reason"
    names = store.COLUMNS[path].metadata["names"]
    return Counter(names[code] for code in sample.get(path, ()))


def _row(demo: int, sample: store.Sample, is_shard: bool) -> dict[str, Any]:
    """What is told of a demo without opening an array; all of it follows from the arrays."""
    row: dict[str, Any] = {"demo": demo, "sha256": store.demo_digest(sample)}
    return row | describe(sample) if is_shard else row


def describe(sample: store.Sample) -> dict[str, int]:
    """Seed, instances and counts of one demo."""
    meta = {name: int(sample[f"meta/{name}"]) for name in ("seed", "container_instance", "object_instance", "attempts")}
    counts = {name: len(sample[path]) for name, path in COUNTED.items()}
    return meta | counts | {"positives": int((sample["container_superpoints/affordance"] > 0).sum())}


# What the dataset is now -----------------------------------------------------------------------------------


def publish(
    layout: Layout, stages: Sequence[Stage], recipe: Mapping[str, Any], config: SplitConfig, units: Sequence[Unit]
) -> Manifest:
    """Writes manifest, index and card for what is there; the shards are named if all of them are.

    Args:
        layout: Where units are.
        stages: All stages, in order.
        recipe: Resolved.
        config: The recipe's split section.
        units: All units of the dataset.
    """
    whole = [stage for stage in stages if all(store.is_committed(layout.folder(stage.name, unit)) for unit in units)]
    entries: dict[str, list[UnitEntry]] = {}
    records: dict[str, list[dict[str, Any]]] = {}
    for stage in whole:
        pairs = [_entry(layout, stage, unit) for unit in units]
        entries[stage.name], records[stage.name] = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
    shards = entries.get(layout.shard_stage, [])
    rows = list(_index_rows(recipe, shards, records.get(layout.shard_stage, []), config))
    now = Manifest(
        format=manifest.FORMAT,
        name=recipe["name"],
        task=recipe["scene"]["task"],
        demos=recipe["demos"],
        content_sha256=_content(records, layout.shard_stage),
        recipe=dict(recipe),
        recipe_sha256=durable.digest(recipe),
        shards=shards if rows else [],
        splits=_splits(rows),
        rejects=_rejects(records),
        stages=_stage_entries(layout, entries),
        files={},
        created_by=created_by(),
    )
    _write(layout.root, now, rows, _previews(layout.root, now))
    return now


def _write(root: Path, now: Manifest, rows: Sequence[Mapping[str, Any]], previews: Mapping[str, bytes]) -> None:
    """Publishes a manifest with the files that follow from it."""
    index = {manifest.INDEX: manifest.index_bytes(rows)} if rows else {}
    text = card.render(now.model_dump(mode="json"), rows, sorted(previews))
    manifest.publish(root, now, {**index, **previews, manifest.CARD: text.encode()})
    durable.remove_file(root / manifest.PROGRESS)


def attach(root: Path, pictures: Mapping[str, bytes]) -> None:
    """Adds pictures under preview/ to a labelled dataset; the caller holds its lock."""
    now = manifest.read(root)
    index = manifest.read_index(root, now)
    rows = [{name: column[i].item() for name, column in index.items()} for i in range(len(index["demo"]))]
    _write(root, now, rows, _previews(root, now) | dict(pictures))


def _stage_entries(layout: Layout, entries: Mapping[str, list[UnitEntry]]) -> dict[str, StageEntry]:
    """What is there; of stages that are not, how they were last run, so that a plan can say what has changed."""
    try:
        old = manifest.read(layout.root).stages
    except DapdataError:
        old = {}
    found = {}
    for name, spec in layout.plan.items():
        if name in entries:
            found[name] = StageEntry(spec=spec, units=entries[name])
        elif name in old:
            found[name] = StageEntry(spec=old[name].spec, units=[])
    return found


def created_by() -> dict[str, str]:
    """The versions that write datasets here."""
    return {"dapdata": str(import_module("dapdata").__version__)} | store.created_by()


def _entry(layout: Layout, stage: Stage, unit: Unit) -> tuple[UnitEntry, dict[str, Any]]:
    folder = layout.folder(stage.name, unit)
    record = store.read_record(folder)
    entry = UnitEntry(
        path=layout.path(stage.name, unit),
        demos=len(record["rows"]),
        demo_range=(unit.start, unit.stop),
        key=record["key"],
        sha256=durable.hash_file(folder / "zarr.json"),
        bytes=sum(fact["bytes"] for fact in record["files"].values()) + (folder / "zarr.json").stat().st_size,
    )
    return entry, {**record, "files": {}}


def _content(records: Mapping[str, Sequence[Mapping[str, Any]]], shard_stage: str) -> str:
    """Over the shards' demos; before there are shards, over the demos of each stage that is there."""
    used = [shard_stage] if shard_stage in records else list(records)
    return store.content_digest([row["sha256"] for name in used for record in records[name] for row in record["rows"]])


def _index_rows(
    recipe: Mapping[str, Any], shards: Sequence[UnitEntry], records: Sequence[Mapping[str, Any]], config: SplitConfig
) -> Iterator[dict[str, Any]]:
    """The rows of the index, in demo order."""
    instances = ((r["demo"], r["container_instance"], r["object_instance"]) for record in records for r in record["rows"])
    splits = split.assign(recipe["demos"], instances, config, recipe["seed"])
    for shard, record in zip(shards, records):
        for number, row in enumerate(record["rows"]):
            place = {"split": splits[row["demo"]], "shard": shard.path, "row": number, "task": recipe["scene"]["task"]}
            yield {"demo": row["demo"], **place, **{k: v for k, v in row.items() if k != "demo"}}


def _splits(rows: Sequence[Mapping[str, Any]]) -> dict[str, SplitEntry]:
    def entry(name: str) -> SplitEntry:
        mine = [row for row in rows if row["split"] == name]
        return SplitEntry(
            demos=len(mine),
            container_instances=sorted({row["container_instance"] for row in mine}),
            object_instances=sorted({row["object_instance"] for row in mine}),
        )

    unused = [split.UNUSED] if any(row["split"] == split.UNUSED for row in rows) else []
    return {name: entry(name) for name in (*split.SPLITS, *unused)} if rows else {}


def _rejects(records: Mapping[str, Sequence[Mapping[str, Any]]]) -> Rejects:
    total: dict[str, Counter[str]] = {"attempts": Counter(), "demos": Counter(), "goals": Counter()}
    for units in records.values():
        for record in units:
            for what, counts in record["rejects"].items():
                total[what].update(counts)
    return Rejects(**{what: dict(sorted(counts.items())) for what, counts in total.items()})


def _previews(root: Path, now: Manifest) -> dict[str, bytes]:
    """Pictures that were attached to the same content before."""
    try:
        old = manifest.read(root)
    except DapdataError:
        return {}
    if old.content_sha256 != now.content_sha256:
        return {}
    return {
        path: (root / path).read_bytes()
        for path in old.files
        if path.startswith(f"{manifest.PREVIEWS}/") and (root / path).is_file()
    }
