"""One unit of work: JSON in, committed folders out. And what a dataset is once its units are there.

`run_unit` is what every worker of every engine does. A stage is handed records, its own recipe sections and its own
generator, nothing else. A demo that a stage rejects is left out of that unit and of those that follow, and counted.
"""

from __future__ import annotations

import json
import resource
import socket
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from dapdata import card, croissant, durable, manifest, remote, split, store
from dapdata.config import SplitConfig
from dapdata.errors import CorruptionError, DapdataError, EnvironmentProblem, UsageError
from dapdata.manifest import Manifest, MissingEntry, Rejects, SplitEntry, StageEntry, UnitEntry
from dapdata.records import Demo, Record, Rejected, read_record, to_sample
from dapdata.stages import Draw, Layout, Spec, Stage, Unit, changes, specs
from dapdata.tables import Index, insert_words, writer

CALL = "dapdata.units:run_unit"
ROWS = "rows.parquet"  # the index before the splits are known, while it is made
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

    root: str  # the dataset's folder or URL
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
        with remote.working_copy(work.root, files=()) as root, durable.disk_problems(remote.scratch_of(root), work.needed):
            return json.dumps(_make(work, root))
    except DapdataError as error:
        return json.dumps({"error": [type(error).__name__, str(error)]})


def _make(work: Work, root: Path) -> dict[str, Any]:
    table = import_module(work.table)
    stages: dict[str, Stage] = {stage.name: stage for stage in table.STAGES}
    layout = layout_of(root, table.STAGES, work.specs, work.recipe)
    _check_versions(work, specs(table.STAGES, work.recipe))
    recipe, unit = table.parse(work.recipe), Unit(*work.unit)
    remote.pull(root, [layout.path(name, unit) for name in layout.plan])
    made: dict[str, Made] = {}
    told = []
    for stage in (stages[name] for name in work.stages):
        if store.is_committed(layout.folder(stage.name, unit)):
            continue
        start, cpu = time.perf_counter(), time.process_time()
        for need in stage.needs:
            if need not in made:
                made[need] = _load(layout, stages[need], unit)
        made[stage.name], rejects, rejected = _run_stage(stage, recipe, made, unit)
        ran, ran_cpu = time.perf_counter(), time.process_time()
        size = _commit(layout, stages, stage, unit, made, rejects, rejected)
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


def _check_versions(work: Work, here: Mapping[str, Spec]) -> None:
    """Refuses to make what is keyed by other versions than those that are installed where the unit is made."""
    differences = [line for stage in work.stages for line in changes(work.specs[stage], here[stage])]
    if differences:
        raise EnvironmentProblem(
            f"{socket.gethostname()}: not what the unit is made for ({'; '.join(sorted(set(differences)))}), expected the same "
            "versions on every machine that works; install them there"
        )


# Running a stage -------------------------------------------------------------------------------------------


def _run_stage(
    stage: Stage, recipe: Any, made: Mapping[str, Made], unit: Unit
) -> tuple[Made, dict[str, Counter[str]], list[dict[str, Any]]]:
    """The records of a unit's demos in one stage; how many attempts and demos were rejected, by reason; and which demos."""
    sections = {name: getattr(recipe, name) for name in stage.sections}
    rejects: dict[str, Counter[str]] = {"attempts": Counter(), "demos": Counter(), "goals": Counter()}
    records: Made = {}
    rejected: list[dict[str, Any]] = []
    for demo in range(unit.start, unit.stop):
        if any(demo not in made[need] for need in stage.needs):
            continue
        inputs = {need: made[need][demo] for need in stage.needs}
        reasons: Counter[str] = Counter()
        last = Rejected("")
        for attempt in range(stage.attempts):
            result = stage.run(inputs, sections, Draw(recipe.seed, demo, attempt))
            if not isinstance(result, Rejected):
                records[demo] = _finished(result, recipe.seed, demo, attempt)
                break
            last = result
            reasons[result.reason] += 1
        if stage.attempts == 1:
            rejects["demos"] += reasons
            rejected += [{"demo": demo, "reason": last.reason, "detail": last.detail}] if reasons else []
        elif demo not in records:
            raise UsageError(_no_demo(recipe, stage, demo, reasons))
        else:
            rejects["attempts"] += reasons
    return records, rejects, rejected


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
    remote.fill(folder)
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
    rejected: Sequence[dict[str, Any]],
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
        **({"rejected": list(rejected)} if rejected else {}),
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
    meta = {name: int(sample[f"meta/{name}"]) for name in ("seed", "container_instance", "object_instance", "attempts", "task")}
    counts = {name: len(sample[path]) for name, path in COUNTED.items()}
    return meta | counts | {"positives": int((sample["container_superpoints/affordance"] > 0).sum())}


# What the dataset is now -----------------------------------------------------------------------------------


def publish(
    layout: Layout,
    stages: Sequence[Stage],
    recipe: Mapping[str, Any],
    config: SplitConfig,
    units: Sequence[Unit],
    missing: Sequence[MissingEntry] = (),
) -> Manifest:
    """Writes manifest, index and card for what is there; a stage is named if all of its units are, but for the missing.

    Args:
        layout: Where units are.
        stages: All stages, in order.
        recipe: Resolved.
        config: The recipe's split section.
        units: All units of the dataset.
        missing: Those that failed, and that the dataset is to do without.

    Returns:
        The manifest as it is read again.
    """
    there = {stage.name: _there(layout, stage.name, units) for stage in stages}
    spared = {entry.demo_range for entry in missing}
    absent = {name: {(unit.start, unit.stop) for unit in {*units} - {*found}} for name, found in there.items()}
    whole = [stage for stage in stages if there[stage.name] and absent[stage.name] <= spared]
    with durable.staged(layout.root, "tables") as folder:
        content, rejects = _gather(layout, whole, recipe, there, folder)
        index = _index(folder, config, recipe["seed"])
        large = len(whole) * len(units) + 2 * (index.rows if index else 0) > manifest.LARGE
        entries: dict[str, Sequence[UnitEntry]] = {
            stage.name: manifest.Units(folder / manifest.UNITS, stage.name, len(there[stage.name])) for stage in whole
        }
        if not large:
            entries = {name: list(found) for name, found in entries.items()}
        facts = Manifest(
            format=manifest.FORMAT,
            name=recipe["name"],
            task=recipe["scene"]["task"],
            demos=recipe["demos"],
            content_sha256=content,
            recipe=dict(recipe),
            recipe_sha256=durable.digest(recipe),
            shards=[],
            splits=_splits(index, large) if index else {},
            rejects=rejects,
            missing=list(missing),
            stages={},
            files={},
            created_by=created_by(),
        )
        shards = entries.get(layout.shard_stage, []) if index else []
        now = facts.model_copy(update={"shards": shards, "stages": _stage_entries(layout, entries)})
        tables = {manifest.UNITS: folder / manifest.UNITS} if large else {}
        tables |= {manifest.INDEX: index.path} if index else {}
        _write(layout.root, now, tables, _previews(layout.root, now))
    return manifest.read(layout.root)


def _there(layout: Layout, stage: str, units: Sequence[Unit]) -> list[Unit]:
    """Those of the units that are there in a stage."""
    paths = [layout.path(stage, unit) for unit in units]
    found = store.committed(layout.root, paths)
    return [unit for unit, path in zip(units, paths) if path in found]


def _gather(
    layout: Layout, whole: Sequence[Stage], recipe: Mapping[str, Any], there: Mapping[str, Sequence[Unit]], folder: Path
) -> tuple[str, Rejects]:
    """Writes the tables of what the units say of themselves; their content digest, and all rejects.

    The digest is over the shards' demos; before there are shards, over the demos of each stage that is there.
    """
    shard_is_there = any(stage.is_shard for stage in whole)
    content, rejects = store.ContentDigest(), {what: Counter[str]() for what in Rejects.model_fields}
    with writer(folder / manifest.UNITS) as entries, writer(folder / ROWS) as rows:
        for stage in whole:
            for unit in there[stage.name]:
                entry, record = _entry(layout, stage, unit)
                entries.add([manifest.unit_row(stage.name, entry)])
                for what, counts in record["rejects"].items():
                    rejects[what].update(counts)
                if stage.is_shard or not shard_is_there:
                    content.add(row["sha256"] for row in record["rows"])
                if stage.is_shard:
                    rows.add([index_row(recipe, entry.path, number, row) for number, row in enumerate(record["rows"])])
            entries.end_group()
    return content.hexdigest(), Rejects(**{what: dict(sorted(counts.items())) for what, counts in rejects.items()})


def index_row(recipe: Mapping[str, Any], shard: str, number: int, row: Mapping[str, Any]) -> dict[str, Any]:
    """A row of the index, but for the split."""
    names = [scene["task"] for scene in recipe["scene"].get("scenes", [recipe["scene"]])]
    place = {"shard": shard, "row": number, "task": names[row["task"]]}
    return {"demo": row["demo"], **place, **{k: v for k, v in row.items() if k not in ("demo", "task")}}


def _index(folder: Path, config: SplitConfig, seed: int) -> Index | None:
    """The index of the rows that were gathered, with the split of each; None if there are none."""
    if not (folder / ROWS).is_file():
        return None
    rows = Index(folder / ROWS)
    splits = split.assign(rows["demo"], rows["container_instance"], rows["object_instance"], config, seed)
    insert_words(folder / ROWS, folder / manifest.INDEX, "split", splits, 1)
    return Index(folder / manifest.INDEX)


def _splits(index: Index, large: bool) -> dict[str, SplitEntry]:
    """The splits with their instances, or with how many they are."""

    def entry(name: str) -> SplitEntry:
        mine = index["split"] == name
        containers, objects = (split.distinct(index[f"{what}_instance"][mine]) for what in ("container", "object"))
        return SplitEntry(
            demos=int(mine.sum()),
            container_instances=len(containers) if large else containers.tolist(),
            object_instances=len(objects) if large else objects.tolist(),
        )

    unused = [split.UNUSED] if (index["split"] == split.UNUSED).any() else []
    return {name: entry(name) for name in (*split.SPLITS, *unused)}


def _write(root: Path, now: Manifest, tables: Mapping[str, Path], previews: Mapping[str, bytes]) -> None:
    """Publishes a manifest with its tables and the files that follow from them."""
    index = Index(tables[manifest.INDEX]) if manifest.INDEX in tables else None
    facts = now.model_copy(update={"shards": [], "stages": {}}).model_dump(mode="json")
    stages = {name: entry.spec for name, entry in now.stages.items() if entry.units}
    demos = index.rows if index else 0
    about = {manifest.CARD: card.render(facts, stages, demos, index or {}, sorted(previews)).encode()}
    if index:
        folders = sorted({shard.path.rpartition("/")[0] for shard in now.shards})
        about[manifest.CROISSANT] = croissant.render(facts, folders, index)
    manifest.publish(root, now, {**tables, **previews, **about})
    durable.remove_file(root / manifest.PROGRESS)


def attach(root: Path, pictures: Mapping[str, bytes]) -> None:
    """Adds pictures under preview/ to a labelled dataset; the caller holds its lock."""
    now = manifest.read(root)
    tables = {name: root / name for name in (manifest.INDEX, manifest.UNITS) if name in now.files}
    _write(root, now, tables, _previews(root, now) | dict(pictures))


def _stage_entries(layout: Layout, entries: Mapping[str, Sequence[UnitEntry]]) -> dict[str, StageEntry]:
    """What is there; of stages that are not, how they were last run, so that a plan can say what has changed."""
    try:
        old = manifest.read(layout.root).stages
    except DapdataError:
        old = {}
    found = {}
    for name, spec in layout.plan.items():
        if name in entries:
            found[name] = StageEntry.model_construct(spec=spec, units=entries[name])
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
    return entry, record


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
