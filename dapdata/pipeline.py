"""The table of contents: the stages in order, and the two commands that run them.

    Recipe -> Scene -> Demo -> Cloud -> Superpoints -> Labels -> shard
            |-- demonstrate --|observe|-- cluster --|-label-|

Each stage is one function of one file, handed the records that it needs, its own recipe sections and a generator.
`generate` runs the first two, `label` the other two; each makes only the units that are not there yet. How a unit is
made and committed is in units.py, what its key holds in stages.py, where it is worked on in engines.py.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from dapdata import durable, engines, manifest, recipe, tasks, units
from dapdata.engines import Failure, Job
from dapdata.errors import EnvironmentProblem, FormatError, QuarantineError, UsageError, require
from dapdata.manifest import Progress
from dapdata.plan import Before, Cost, Plan, before, make_plan, measured_cost, missing
from dapdata.recipe import Recipe
from dapdata.records import Cloud, Demo, Labels, Rejected, Superpoints
from dapdata.stages import Draw, Inputs, Layout, Sections, Spec, Stage, Unit, specs
from dapdata.stages import units as units_of

# The stages ------------------------------------------------------------------------------------------------


def _demonstrate(made: Inputs, sections: Sections, draw: Draw) -> Demo | Rejected:
    """A scene as its task draws it, with every goal settled and checked, and one of them demonstrated."""
    from dapdata.simulate import demonstrate

    scene = tasks.load(sections["scene"].task).sample_scene(sections["scene"], draw("scene"))
    if isinstance(scene, Rejected):
        return scene
    return demonstrate(scene, sections["placement"], draw("demonstrate"))


def _observe(made: Inputs, sections: Sections, draw: Draw) -> Cloud | Rejected:
    """The clouds of container and object as the cameras see them."""
    from dapdata.observe import observe

    return observe(made["demonstrate"], sections["cameras"], sections["noise"], draw("observe"))


def _cluster(made: Inputs, sections: Sections, draw: Draw) -> Superpoints | Rejected:
    """The partition of both clouds."""
    from dapdata.cluster import cluster

    return cluster(made["observe"], sections["superpoints"])


def _label(made: Inputs, sections: Sections, draw: Draw) -> Labels:
    """What the two networks learn."""
    from dapdata.labels import label

    return label(made["demonstrate"], made["observe"], made["cluster"], sections["label"])


STAGES = (
    Stage("demonstrate", 1, ("scene", "placement"), (), Demo, _demonstrate, packages=("pybullet", "numpy"), attempts=50),
    Stage("observe", 2, ("cameras", "noise"), ("demonstrate",), Cloud, _observe, packages=("numba", "numpy")),
    Stage("cluster", 1, ("superpoints",), ("observe",), Superpoints, _cluster, packages=("numba", "numpy")),
    Stage("label", 1, ("label",), ("demonstrate", "observe", "cluster"), Labels, _label, packages=("numpy",), is_shard=True),
)
GENERATE = ("demonstrate", "observe")
LABEL = ("cluster", "label")
parse = recipe.from_resolved  # what a worker makes its recipe with

# The commands ----------------------------------------------------------------------------------------------

OnProgress = Callable[[int, int], None]  # demos done, demos in all


def generate(
    recipe_or_path: Recipe | str | Path,
    out: str | Path | None = None,
    *,
    workers: int = 1,
    engine: str = "local",
    fresh: bool = False,
    dry_run: bool = False,
    progress: OnProgress | None = None,
    table: str = __name__,
) -> Path | Plan:
    """Makes scenes, settled demonstrations and point clouds; goes on where an earlier call stopped.

    Args:
        recipe_or_path: What to make.
        out: The dataset's folder; `data/<recipe name>` by default.
        workers: Processes.
        engine: Where they work, see engines.py.
        fresh: Whether to delete what is there first.
        dry_run: Whether only to say what would run, and why.
        progress: Called with demos done and demos in all whenever a unit is done.
        table: Module with STAGES and parse; tests put toys here.

    Returns:
        The dataset's folder, or the Plan.
    """
    given = recipe_or_path if not isinstance(recipe_or_path, (str, Path)) else recipe.load(recipe_or_path)
    root, stages = Path(out) if out else Path("data") / given.name, import_module(table).STAGES
    resolved = recipe.resolve(given)
    command = _Command(root, table, stages, GENERATE, given, resolved, specs(stages, resolved))
    return command.plan(fresh) if dry_run else command.run(workers, engine, fresh, progress)


def label(
    dataset: str | Path,
    overrides: Sequence[str] = (),
    *,
    workers: int = 1,
    engine: str = "local",
    dry_run: bool = False,
    progress: OnProgress | None = None,
    table: str = __name__,
) -> Path | Plan:
    """Makes superpoints, affordance and correspondence of a generated dataset, and its shards. Never simulates.

    Args:
        dataset: The dataset's folder.
        overrides: Such as "label.eps_place=0.02"; only sections that the stages from `cluster` on read.
        workers: See generate, as the others.

    Raises:
        UsageError: for an override of what earlier stages read.
    """
    root, stages = Path(dataset), import_module(table).STAGES
    found = _generated(root)
    given = import_module(table).parse(found.recipe, overrides, str(root / manifest.MANIFEST))
    resolved = recipe.resolve(given)
    made = {name: found.specs[name] for name in GENERATE}
    _refuse_upstream(found.recipe, resolved, made)
    command = _Command(root, table, stages, LABEL, given, resolved, specs(stages, resolved) | made)
    return command.plan(False) if dry_run else command.run(workers, engine, False, progress)


def attach(dataset: str | Path, pictures: Mapping[str, bytes]) -> None:
    """Adds pictures, by their path such as "preview/goals.png", to a labelled dataset, its manifest and its card."""
    root = Path(dataset)
    with durable.disk_problems(root), durable.lock(root):
        found = manifest.read(root)
        specs = {name: entry.spec for name, entry in found.stages.items()}
        shard_stage = next(stage.name for stage in STAGES if stage.is_shard)
        _note(root, Progress(recipe=found.recipe, specs=specs, stages=list(LABEL), shard_stage=shard_stage))
        units.attach(root, pictures)


def _generated(root: Path) -> Before:
    """What a generated dataset was made for: from its manifest, or from what an interrupted `label` left of that."""
    try:
        found = manifest.read(root)
        made = Before(found.recipe, {name: entry.spec for name, entry in found.stages.items() if entry.units})
    except FormatError:
        left = manifest.read_progress(root)
        if (root / manifest.MANIFEST).exists() or left is None or left.stages != list(LABEL):
            raise
        made = Before(left.recipe, left.specs)
    if not made.specs.keys() >= {*GENERATE}:
        raise FormatError(f"{root}: stages {sorted(made.specs)}, expected {', '.join(GENERATE)}; run `dapdata generate` first")
    return made


def _note(root: Path, progress: Progress) -> None:
    """Writes down what a command works on, for whoever goes on after a crash."""
    durable.replace_file(root / manifest.PROGRESS, json.dumps(progress.model_dump(mode="json")).encode())


def _refuse_upstream(old: Mapping[str, Any], new: Mapping[str, Any], made: Mapping[str, Spec]) -> None:
    """Relabelling doesn't simulate: what earlier stages read cannot be changed here."""
    fixed = ["name", "seed", "demos", "shard_size", *(section for spec in made.values() for section in spec["sections"])]
    for name in fixed:
        if old.get(name) != new.get(name):
            raise UsageError(
                f"--set {name}: `dapdata label` does not simulate or observe again; change it with `dapdata generate`"
            )


@dataclass(frozen=True)
class _Command:
    """Some stages of one dataset, to be planned or run."""

    root: Path
    table: str
    stages: Sequence[Stage]
    wanted: Sequence[str]
    recipe: Recipe
    resolved: dict[str, Any]
    specs: dict[str, Spec]

    @property
    def layout(self) -> Layout:
        return units.layout_of(self.root, self.stages, self.specs, self.resolved)

    @property
    def units(self) -> list[Unit]:
        return units_of(self.resolved["demos"], self.resolved["shard_size"])

    def plan(self, fresh: bool) -> Plan:
        """What would run; writes nothing."""
        _check_folder(self.root)
        mine = [stage for stage in self.stages if stage.name in self.wanted]
        previous: Before | None = None if fresh else before(self.root)
        cost = measured_cost(self.root, REFERENCE_COST)
        return make_plan(self.layout, mine, self.units, self.resolved, previous, cost, fresh)

    def run(self, workers: int, engine: str, fresh: bool, progress: OnProgress | None) -> Path:
        """Makes the missing units and publishes what is there then."""
        check_packages(stage for stage in self.stages if stage.name in self.wanted)
        found, needed = engines.get(engine), int(self.plan(fresh).gigabytes * 1e9)
        _check_space(self.root, needed)
        with durable.disk_problems(self.root, needed), durable.lock(self.root):
            if fresh:
                _clear(self.root)
            jobs = self._jobs(needed)
            shard_stage = self.layout.shard_stage
            _note(
                self.root, Progress(recipe=self.resolved, specs=self.specs, stages=list(self.wanted), shard_stage=shard_stage)
            )
            if jobs:
                shutil.rmtree(self.root / QUARANTINE, ignore_errors=True)
                try:
                    self._work(found, jobs, workers, progress)
                except UsageError:
                    _leave_nothing(self.root)
                    raise
            now = units.publish(self.layout, self.stages, self.resolved, self.recipe.split, self.units)
        if sum(now.rejects.demos.values()) >= now.demos:
            reasons = ", ".join(f"{reason} {count}" for reason, count in now.rejects.demos.items())
            raise UsageError(
                f"{self.root}: all {now.demos} demos were rejected ({reasons}), expected some that are not; "
                "change cameras, noise or superpoints in the recipe"
            )
        return self.root

    def _jobs(self, needed: int) -> dict[str, Unit]:
        """The units of which something is missing, by their job."""
        todo = sorted({unit for name in self.wanted for unit in missing(self.layout, name, self.units)}, key=lambda u: u.index)
        return {self._job(unit, needed): unit for unit in todo}

    def _job(self, unit: Unit, needed: int) -> str:
        place, stages = (unit.index, unit.start, unit.stop), tuple(self.wanted)
        return units.Work(str(self.root), self.table, self.resolved, self.specs, place, stages, needed).to_json()

    def _work(self, engine: engines.Engine, jobs: Mapping[str, Unit], workers: int, progress: OnProgress | None) -> None:
        """Has the jobs done; those that could not be are kept apart with what is needed to replay them."""
        total = self.resolved["demos"]
        done = total - sum(unit.stop - unit.start for unit in jobs.values())

        def on_done(job: Job, text: str) -> None:
            nonlocal done
            done += jobs[job.text].stop - jobs[job.text].start
            with (self.root / manifest.LOG).open("a") as log:
                log.writelines(json.dumps(line) + "\n" for line in json.loads(text)["made"])
            if progress:
                progress(done, total)

        if progress:
            progress(done, total)
        queue = [Job(text, timeout(unit)) for text, unit in jobs.items()]
        failures = engine.run(units.CALL, queue, workers=workers, on_done=on_done)
        if failures:
            raise QuarantineError(self._quarantine(failures, jobs))

    def _quarantine(self, failures: Sequence[Failure], jobs: Mapping[str, Unit]) -> str:
        """Keeps each failed job with its reason; the message that names them."""
        lines = []
        for failure in failures:
            unit = jobs[failure.job.text]
            path = self.root / QUARANTINE / f"{unit.index:05d}.json"
            story = {"work": json.loads(failure.job.text), "reason": failure.reason, "stderr": failure.stderr}
            durable.replace_file(path, json.dumps(story, indent=1).encode())
            lines.append(
                f"unit {unit.index} (demos {unit.start} to {unit.stop - 1}, seed {self.resolved['seed']}): {failure.reason}; "
                f"replay with: {sys.executable} -m dapdata.pipeline {path}"
            )
        return (
            f"{self.root}: {len(failures)} of {len(jobs)} units failed {engines.RETRIES + 1} times, the others are done; "
            f"run the same command to try them again\n" + "\n".join(lines)
        )


# Around the commands ---------------------------------------------------------------------------------------

QUARANTINE = "quarantine"
START_TIMEOUT = 300.0  # s: imports, and numba's first compilation
DEMO_TIMEOUT = 20.0  # s a demo: a hundred times what one takes
REFERENCE_COST: dict[str, Cost] = {  # s and bytes a demo at 320x240, until this dataset's own log knows better
    "demonstrate": (0.05, 10e3),
    "observe": (0.05, 300e3),
    "cluster": (0.03, 40e3),
    "label": (0.01, 20e3),
}


def timeout(unit: Unit) -> float:
    """Seconds after which a unit is given up."""
    return START_TIMEOUT + DEMO_TIMEOUT * (unit.stop - unit.start)


def _check_folder(root: Path) -> None:
    """Refuses to write among somebody's other files."""
    ours = (manifest.MANIFEST, manifest.PROGRESS, manifest.INDEX, ".lock", "stages")
    if root.exists() and not root.is_dir():
        raise FormatError(f"{root}: a file, expected a folder for the dataset; choose another with --out")
    if root.is_dir() and any(root.iterdir()) and not any((root / name).exists() for name in ours):
        raise FormatError(f"{root}: a folder with other files and no dataset; choose an empty or new one with --out")


def check_packages(stages: Iterable[Stage]) -> None:
    """Raises a MissingExtraError before anything is written if a stage needs a package that is not installed."""
    for package in (package for stage in stages for package in stage.packages):
        if find_spec(package) is None:
            require(package, "sim")


def _check_space(root: Path, needed: int) -> None:
    """Stops before work begins if the estimate cannot fit."""
    free = shutil.disk_usage(durable.existing(root)).free
    if needed > free:
        raise EnvironmentProblem(
            f"{root}: about {needed / 1e6:.0f} MB are needed, {free / 1e6:.0f} MB are free; "
            "make room, lower `demos`, or choose another disk with --out"
        )


def _clear(root: Path) -> None:
    """Removes all that a dataset consists of; the manifest first."""
    durable.remove_file(root / manifest.MANIFEST)
    for name in (manifest.PROGRESS, manifest.LOG, *manifest.single_files(root)):
        durable.remove_file(root / name)
    for folder in ("shards", "stages", QUARANTINE):
        if (root / folder).is_dir():
            durable.discard(root, root / folder)


def _leave_nothing(root: Path) -> None:
    """Removes a folder in which no unit was finished: a recipe that admits no demo leaves no trace."""
    if not any(path.name != ".lock" and path.name != manifest.PROGRESS for path in root.iterdir()):
        shutil.rmtree(root)


def replay(path: str) -> None:
    """Runs a quarantined unit in this process, where a debugger sees it."""
    story = json.loads(Path(path).read_bytes())
    print(engines.answer(units.run_unit(json.dumps(story["work"]))))


if __name__ == "__main__":
    replay(sys.argv[1])
