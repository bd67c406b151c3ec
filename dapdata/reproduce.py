"""Does the recipe still give the data? Some units are made anew in a scratch folder and compared with those that are there.

Bit-identity holds for one set of package versions and one family of CPUs. Where a demo comes out otherwise, what differs
between here and where the dataset was made is said with it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from dapdata import engines, manifest, pipeline, recipe, remote, rng, stages, store, units
from dapdata.engines import Job
from dapdata.errors import UsageError
from dapdata.manifest import Manifest
from dapdata.stages import Layout, Stage, Unit

Progress = Callable[[int, int], None]  # units done, units in all


@remote.on_copy(units=True)
def reproduce(
    root: str | Path,
    count: int,
    *,
    workers: int | None = 1,
    engine: str = "local",
    memory: float | None = None,
    progress: Progress | None = None,
    table: str | None = None,
) -> tuple[int, list[str]]:
    """How many units were made anew, and what of them came out otherwise, each as "unit: found, expected".

    Args:
        root: The dataset's folder or URL; its files are taken to be whole.
        count: Units, chosen at random but always the same; all, if there are no more.
        workers: Processes; None for as many as there are cores.
        engine: Where they work, see engines/.
        memory: What each of them may take, GB; by default an equal part of most of what there is.
        progress: Called with units done and units in all.
        table: As in `pipeline.generate`.

    Raises:
        UsageError: if the recipe is none for this version.
        MissingExtraError: if a package is missing.
    """
    root = Path(root)
    found = manifest.read(root)
    given = recipe.from_resolved(found.recipe)
    table = table or given.scene.stages
    known = import_module(table).STAGES
    wanted: list[Stage] = [stage for stage in known if stage.name in found.stages and found.stages[stage.name].units]
    pipeline.check_packages(wanted)
    if count < 1:
        raise UsageError(f"reproduce: got {count}, expected at least 1 unit")
    missing = {entry.demo_range for entry in found.missing}
    all_units = stages.units(found.recipe["demos"], found.recipe["shard_size"])
    every = [unit for unit in all_units if (unit.start, unit.stop) not in missing]
    order = rng.stream(found.recipe["seed"], "verify", 0).permutation(len(every))
    chosen = [every[i] for i in sorted(order[:count].tolist())]
    resolved, names = recipe.resolve(given), tuple(stage.name for stage in wanted)
    specs = stages.specs(known, resolved)
    problems: list[str] = []
    with tempfile.TemporaryDirectory(prefix="dapdata-") as scratch:
        place = {unit: (unit.index, unit.start, unit.stop) for unit in chosen}
        jobs = {units.Work(scratch, table, resolved, specs, place[unit], names, 0).to_json(): unit for unit in chosen}
        done: list[Unit] = []

        def on_done(job: Job, answer: str) -> None:
            done.append(jobs[job.text])
            if progress:
                progress(len(done), len(chosen))

        limit = None if memory is None else memory * 1e9
        queue = [Job(text, pipeline.timeout(unit), limit) for text, unit in jobs.items()]
        failures = engines.get(engine).run(units.CALL, queue, workers=workers, on_done=on_done)
        for failure in failures:
            problems.append(f"unit {jobs[failure.job.text].index}: could not be made anew: {failure.reason}")
        made = units.layout_of(Path(scratch), known, specs, resolved)
        for unit in sorted(done, key=lambda unit: unit.index):
            problems += _compare(root, found, made, names, unit)
    return len(chosen), [*problems, *(_reasons(found, known) if problems else ())]


def _compare(root: Path, found: Manifest, made: Layout, names: tuple[str, ...], unit: Unit) -> Iterator[str]:
    """What the first stage that came out otherwise made of a unit; those after it follow from it."""
    for name in names:
        path = next(entry.path for entry in found.stages[name].units if entry.demo_range == (unit.start, unit.stop))
        if not store.is_committed(root / path):  # of a copy without stages/, only shards are compared
            continue
        there, here = _demos(root / path), _demos(made.folder(name, unit))
        if there != here:
            other = sorted(demo for demo in there | here if there.get(demo) != here.get(demo))
            shown = ", ".join(map(str, other[:5])) + (", ..." if len(other) > 5 else "")
            yield f"{path}: made anew, {len(other)} of {len(there | here)} demos are others ({shown}), expected the same"
            return


def _demos(folder: Path) -> dict[int, str]:
    """The digest of each demo of a unit."""
    return {row["demo"]: row["sha256"] for row in store.read_record(folder)["rows"]}


def _reasons(found: Manifest, known: tuple[Stage, ...]) -> Iterator[str]:
    """What is not here as it was where the dataset was made."""
    here = stages.specs(known, {section: None for stage in known for section in stage.sections})
    differ: dict[str, tuple[Any, Any]] = {}
    for name, entry in found.stages.items():
        if name in here and entry.units:
            there, now = ({f"stage {name}": spec["version"], **spec["packages"]} for spec in (entry.spec, here[name]))
            differ |= _differing(there, now)
    differ |= _differing(found.created_by, units.created_by())
    if differ:
        told = ", ".join(f"{name} {there}, here {now}" for name, (there, now) in sorted(differ.items()))
        yield f"made with {told}: install those versions to make the same again"
    else:
        yield "all versions are those that it was made with: another kind of CPU, or other data under the recipe's name"


def _differing(there: Mapping[str, Any], here: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """By name, what is not the same there and here."""
    return {name: (value, here.get(name)) for name, value in there.items() if here.get(name) != value}
