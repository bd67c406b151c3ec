"""What a command would do, and why: which units of which stages are there, which run, and what made them stale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dapdata import manifest, store
from dapdata.errors import CorruptionError, FormatError
from dapdata.manifest import MissingEntry
from dapdata.stages import Layout, Spec, Stage, Unit, changes

LOG_LINES = 400  # the latest units tell what a demo costs now
Cost = tuple[float, float]  # seconds on one core, and bytes, for one demo in one stage


@dataclass(frozen=True)
class StagePlan:
    """What is to be done in one stage."""

    stage: str
    units: int  # in all
    cached: int  # of them, that are there
    demos: int  # in the units that run
    reasons: tuple[str, ...]  # why they run; empty if none does


@dataclass(frozen=True)
class Plan:
    """What a command would do: the answer to --dry-run."""

    root: str
    demos: int
    stages: tuple[StagePlan, ...]
    gigabytes: float  # that would be written, an estimate
    files: int
    minutes: float  # on one core, an estimate

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return asdict(self)

    def __str__(self) -> str:
        lines = [f"{self.root}: {self.demos} demos"]
        for stage in self.stages:
            if stage.cached == stage.units:
                lines.append(f"  {stage.stage}: nothing to do, all {stage.units} units are there")
            else:
                what = f"{stage.units - stage.cached} of {stage.units} units run ({stage.demos} demos)"
                lines.append(f"  {stage.stage}: {what}: {'; '.join(stage.reasons)}")
        return "\n".join(
            [*lines, f"  about {self.gigabytes:.2f} GB in {self.files} files, {self.minutes:.1f} minutes on one core"]
        )


@dataclass(frozen=True)
class Before:
    """What the folder was made for when a command last worked on it."""

    recipe: dict[str, Any]
    specs: dict[str, Spec]
    missing: tuple[MissingEntry, ...] = ()  # units that failed


def before(root: Path) -> Before | None:
    """From the manifest, or else from what an interrupted command left; None for a new folder."""
    try:
        found = manifest.read(root)
        return Before(found.recipe, {name: entry.spec for name, entry in found.stages.items()})
    except CorruptionError:
        return None  # units speak for themselves, and the manifest is written anew
    except FormatError:
        if (root / manifest.MANIFEST).is_file():
            raise
    left = manifest.read_progress(root)
    return Before(left.recipe, left.specs) if left else None


def missing(layout: Layout, stage: str, units: Sequence[Unit]) -> list[Unit]:
    """The units of a stage that are not there."""
    paths = [layout.path(stage, unit) for unit in units]
    there = store.committed(layout.root, paths)
    return [unit for unit, path in zip(units, paths) if path not in there]


def measured_cost(root: Path, reference: Mapping[str, Cost]) -> dict[str, Cost]:
    """Seconds and bytes a demo in each stage: as last measured on this dataset, or else the reference."""
    lines = list(manifest.read_log(root, LOG_LINES))
    costs = dict(reference)
    for stage in reference:
        mine = [line for line in lines if line["stage"] == stage and line["demos"]]
        if mine:
            demos = sum(line["demos"] for line in mine)
            costs[stage] = (sum(line["cpu_seconds"] for line in mine) / demos, sum(line["bytes"] for line in mine) / demos)
    return costs


def make_plan(
    layout: Layout,
    stages: Sequence[Stage],
    units: Sequence[Unit],
    resolved: Mapping[str, Any],
    previous: Before | None,
    cost: Mapping[str, Cost],
    fresh: bool = False,
) -> Plan:
    """Compares what a recipe asks for with what is on disk.

    Args:
        layout: Where units are and what their keys are.
        stages: Those that the command runs, in order.
        units: Those of the dataset that the command is to look after.
        resolved: The recipe.
        previous: What the folder was made for before.
        cost: Seconds and bytes of one demo in each stage.
        fresh: Whether what is there is deleted first.
    """
    found, seconds, size, files = [], 0.0, 0.0, 0
    rerun: list[str] = []
    for stage in stages:
        todo = list(units) if fresh else missing(layout, stage.name, units)
        demos = sum(unit.stop - unit.start for unit in todo)
        reasons = _reasons(stage, layout.plan[stage.name], todo, resolved, previous, rerun) if todo else ()
        rerun += [stage.name] if todo else []
        found.append(StagePlan(stage.name, len(units), len(units) - len(todo), demos, tuple(reasons)))
        seconds, size = seconds + demos * cost[stage.name][0], size + demos * cost[stage.name][1]
        files += len(todo) * _files_of_a_unit(stage, stages)
    asked = sum(unit.stop - unit.start for unit in units)
    return Plan(str(layout.root), asked, tuple(found), size / 1e9, files, seconds / 60)


def _files_of_a_unit(stage: Stage, stages: Sequence[Stage]) -> int:
    """Two files an array (its description and its rows), one a group."""
    made = [other.makes for other in stages] if stage.is_shard else [stage.makes]
    groups = store.group_columns(*made)
    return 1 + sum(1 + 2 * len(members) + 2 for members in groups.values())


def _reasons(
    stage: Stage,
    spec: Spec,
    todo: Sequence[Unit],
    resolved: Mapping[str, Any],
    previous: Before | None,
    rerun: Sequence[str],
) -> list[str]:
    """Why units of a stage are missing, in the order in which a reader would ask."""
    old = previous.specs.get(stage.name) if previous else None
    if previous is None or old is None:
        return [f"{stage.name} was not run here before"]
    reasons = changes(old, spec)
    if resolved["seed"] != previous.recipe["seed"]:
        reasons.append(f"seed {previous.recipe['seed']} -> {resolved['seed']}")
    if resolved["shard_size"] != previous.recipe["shard_size"]:
        reasons.append(f"shard_size {previous.recipe['shard_size']} -> {resolved['shard_size']}")
    if reasons:
        return reasons
    upstream = [need for need in stage.needs if need in rerun]
    if resolved["demos"] > previous.recipe["demos"]:
        return [f"demos {previous.recipe['demos']} -> {resolved['demos']}"]
    if upstream:
        return [f"{' and '.join(upstream)} {'run' if len(upstream) > 1 else 'runs'} again"]
    return [f"{len(todo)} {'unit is' if len(todo) == 1 else 'units are'} not there yet"]
