"""The table of contents: the stages in order, and the two commands that run them.

    Recipe -> Scene -> Demo -> Cloud -> Superpoints -> Labels -> shard
            |-- demonstrate --|observe|-- cluster --|-label-|

Each stage is one function of one file, handed the records that it needs, its own recipe sections and a generator.
`generate` runs the first two, `label` the other two; each makes only the units that are not there yet. How a unit is
made and committed is in units.py, what its key holds in stages.py, where it is worked on in engines/.

Several machines can share the work without a cluster: `--units I/N` makes every N-th unit. Which units there are follows
from the recipe alone, so any launcher will do that can count. A plain command holds the dataset's lock for itself; those
with `--units` share it. So they run beside each other, in any order, also twice (a unit is committed by one rename, and
the second finds it there), but not beside a plain command: that one is refused while they work, and they while it does.
Who finds all units there when its own are done takes the lock for itself and publishes; if it cannot have it, because
another still works on units that exist by now, that other will. A plain command afterwards makes what is missing.
"""

from __future__ import annotations

import json
import logging
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from dapdata import durable, engines, manifest, recipe, remote, store, tasks, units
from dapdata.engines import Failure, Job
from dapdata.errors import EnvironmentProblem, FormatError, LockedError, QuarantineError, UsageError, require
from dapdata.manifest import MissingEntry, Progress
from dapdata.plan import Before, Cost, Plan, before, make_plan, measured_cost, missing
from dapdata.recipe import Recipe
from dapdata.records import Cloud, Demo, Labels, Rejected, Superpoints
from dapdata.remote import Place
from dapdata.stages import Draw, Inputs, Layout, Sections, Spec, Stage, Unit, specs, stripe
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
    Stage("demonstrate", 3, ("scene", "placement"), (), Demo, _demonstrate, packages=("pybullet", "numpy"), attempts=50),
    Stage("observe", 3, ("cameras", "noise"), ("demonstrate",), Cloud, _observe, packages=("numba", "numpy")),
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
    out: Place | None = None,
    *,
    workers: int | None = 1,
    engine: str = "local",
    memory: float | None = None,
    units: str | None = None,
    allow_missing: bool = False,
    fresh: bool = False,
    dry_run: bool = False,
    progress: OnProgress | None = None,
    table: str | None = None,
) -> Place | Plan:
    """Makes scenes, settled demonstrations and point clouds; goes on where an earlier call stopped.

    Args:
        recipe_or_path: What to make.
        out: The dataset's folder, or the URL of one in a bucket; `data/<recipe name>` by default.
        workers: Processes; None for as many as there are cores.
        engine: Where they work, see engines/.
        memory: What each of them may take, GB; by default an equal part of most of what there is.
        units: "I/N" for every N-th unit from the I-th on; the manifest is written when all are there.
        allow_missing: Whether to publish the others when units have failed; the manifest then names the missing demos.
        fresh: Whether to delete what is there first.
        dry_run: Whether only to say what would run, and why.
        progress: Called with demos done and demos in all whenever a unit is done.
        table: Module with STAGES and parse; default: the one for such scenes. Tests put toys here.

    Returns:
        The dataset's folder or URL, or the Plan.

    Raises:
        QuarantineError: if units have failed too often, and `allow_missing` was not asked for; the others are done.
    """
    if fresh and units is not None:
        raise UsageError(
            "--fresh: would delete what other tasks make, expected none with --units; delete the folder before them"
        )
    given = recipe_or_path if not isinstance(recipe_or_path, (str, Path)) else recipe.load(recipe_or_path)
    table = table or given.scene.stages
    place, stages = remote.locate(out or Path("data") / given.name), import_module(table).STAGES
    resolved = recipe.resolve(given)
    with remote.working_copy(place, units=True) as root:
        command = _Command(place, root, table, stages, GENERATE, given, resolved, specs(stages, resolved), units)
        means = _Means(workers, engine, memory, allow_missing, progress, fresh)
        return command.plan(fresh) if dry_run else command.run(means)


def label(
    dataset: Place,
    overrides: Sequence[str] = (),
    *,
    workers: int | None = 1,
    engine: str = "local",
    memory: float | None = None,
    units: str | None = None,
    allow_missing: bool = False,
    dry_run: bool = False,
    progress: OnProgress | None = None,
    table: str | None = None,
) -> Place | Plan:
    """Makes superpoints, affordance and correspondence of a generated dataset, and its shards. Never simulates.

    Args:
        dataset: The dataset's folder or URL.
        overrides: Such as "label.eps_place=0.02"; only sections that the stages from `cluster` on read.
        workers: See generate, as the others.

    Raises:
        UsageError: for an override of what earlier stages read.
    """
    place = remote.locate(dataset)
    with remote.working_copy(place, units=True) as root:
        found = _generated(root)
        given = recipe.from_resolved(found.recipe, overrides, str(root / manifest.MANIFEST))
        table = table or given.scene.stages
        stages, resolved = import_module(table).STAGES, recipe.resolve(given)
        made = {name: found.specs[name] for name in GENERATE}
        _refuse_upstream(found.recipe, resolved, made)
        lost = tuple(entry for entry in found.missing if entry.stage in GENERATE)
        command = _Command(place, root, table, stages, LABEL, given, resolved, specs(stages, resolved) | made, units, lost)
        return command.plan(False) if dry_run else command.run(_Means(workers, engine, memory, allow_missing, progress))


@remote.on_copy()
def attach(dataset: str | Path, pictures: Mapping[str, bytes]) -> None:
    """Adds pictures, by their path such as "preview/goals.png", to a labelled dataset, its manifest and its card."""
    root = Path(dataset)
    with durable.disk_problems(remote.scratch_of(root)), durable.lock(root):
        found = manifest.read(root)
        specs, stages = {name: entry.spec for name, entry in found.stages.items()}, list(LABEL)
        last = next(stage.name for stage in STAGES if stage.is_shard)
        left = Progress(recipe=found.recipe, specs=specs, stages=stages, shard_stage=last, missing=found.missing)
        _note(root, left)
        units.attach(root, pictures)


def _generated(root: Path) -> Before:
    """What a generated dataset was made for: from its manifest, or from what an interrupted `label` left of that."""
    try:
        found = manifest.read(root)
        specs = {name: entry.spec for name, entry in found.stages.items() if entry.units}
        made = Before(found.recipe, specs, tuple(found.missing))
    except FormatError:
        left = manifest.read_progress(root)
        if (root / manifest.MANIFEST).exists() or left is None or left.stages != list(LABEL):
            raise
        made = Before(left.recipe, left.specs, tuple(left.missing))
    if not made.specs.keys() >= {*GENERATE}:
        raise FormatError(f"{root}: stages {sorted(made.specs)}, expected {', '.join(GENERATE)}; run `dapdata generate` first")
    return made


def _note(root: Path, progress: Progress) -> None:
    """Writes down what a command works on, for whoever goes on after a crash."""
    data, path = json.dumps(progress.model_dump(mode="json")).encode(), root / manifest.PROGRESS
    if not path.is_file() or path.read_bytes() != data:
        durable.replace_file(path, data)


def _refuse_upstream(old: Mapping[str, Any], new: Mapping[str, Any], made: Mapping[str, Spec]) -> None:
    """Relabelling doesn't simulate: what earlier stages read cannot be changed here."""
    fixed = ["name", "seed", "demos", "shard_size", *(section for spec in made.values() for section in spec["sections"])]
    for name in fixed:
        if old.get(name) != new.get(name):
            raise UsageError(
                f"--set {name}: `dapdata label` does not simulate or observe again; change it with `dapdata generate`"
            )


@dataclass(frozen=True)
class _Means:
    """How a command is carried out: nothing that results depend on. See generate."""

    workers: int | None
    engine: str
    memory: float | None
    allow_missing: bool
    progress: OnProgress | None
    fresh: bool = False


@dataclass(frozen=True)
class _Command:
    """Some stages of one dataset, to be planned or run."""

    place: Place  # as the user names it
    root: Path  # the same, or its working copy
    table: str
    stages: Sequence[Stage]
    wanted: Sequence[str]
    recipe: Recipe
    resolved: dict[str, Any]
    specs: dict[str, Spec]
    stripe: str | None
    lost: tuple[MissingEntry, ...] = ()  # units that the stages before these could not make

    @cached_property
    def layout(self) -> Layout:
        return units.layout_of(self.root, self.stages, self.specs, self.resolved)

    @cached_property
    def units(self) -> list[Unit]:
        """All that these stages can make."""
        lost = {entry.demo_range for entry in self.lost}
        return [unit for unit in self._all_units if (unit.start, unit.stop) not in lost]

    @property
    def mine(self) -> list[Unit]:
        """Those that this command makes."""
        chosen = {*(self._all_units if self.stripe is None else stripe(self.stripe, self._all_units))}
        return [unit for unit in self.units if unit in chosen]

    @property
    def _all_units(self) -> list[Unit]:
        return units_of(self.resolved["demos"], self.resolved["shard_size"])

    def plan(self, fresh: bool) -> Plan:
        """What would run; writes nothing."""
        _check_folder(self.root)
        mine = [stage for stage in self.stages if stage.name in self.wanted]
        previous: Before | None = None if fresh else before(self.root)
        cost = measured_cost(self.root, REFERENCE_COST)
        plan = make_plan(self.layout, mine, self.mine, self.resolved, previous, cost, fresh)
        return replace(plan, root=str(self.place))

    def run(self, means: _Means) -> Place:
        """Makes the missing units; publishes what is there then, or leaves that to whoever makes the others."""
        check_packages(stage for stage in self.stages if stage.name in self.wanted)
        engine, needed = engines.get(means.engine), int(self.plan(means.fresh).gigabytes * 1e9)
        _check_space(self.root, needed)
        with durable.disk_problems(remote.scratch_of(self.root), needed):
            if self.stripe is None:
                with durable.lock(self.root):
                    if means.fresh:
                        _clear(self.root)
                    self._make(engine, means, needed)
                    self._publish(means)
            else:
                with durable.lock(self.root, shared=True, patience=PATIENCE):
                    self._make(engine, means, needed)
                    is_last = self._missing(means) is not None
                with suppress(LockedError):
                    if is_last:
                        with durable.lock(self.root, patience=PATIENCE):
                            self._publish(means)
        return self.place

    def _make(self, engine: engines.Engine, means: _Means, needed: int) -> None:
        """Makes the units of which something is missing."""
        jobs = self._jobs(needed)
        if not jobs:
            return
        self._note()
        if self.stripe is None and (self.root / QUARANTINE).is_dir():
            durable.discard(self.root, self.root / QUARANTINE)
        for unit in jobs.values():
            durable.remove_file(self._story(unit))
        try:
            self._work(engine, jobs, means)
        except UsageError:
            if self.stripe is None:
                _leave_nothing(self.root)
            raise

    def _note(self) -> None:
        """Writes down what this command works on."""
        stages, last, lost = list(self.wanted), self.layout.shard_stage, list(self.lost)
        _note(self.root, Progress(recipe=self.resolved, specs=self.specs, stages=stages, shard_stage=last, missing=lost))

    def _jobs(self, needed: int) -> dict[str, Unit]:
        """The units of which something is missing, by their job."""
        todo = sorted({unit for name in self.wanted for unit in missing(self.layout, name, self.mine)}, key=lambda u: u.index)
        return {self._job(unit, needed): unit for unit in todo}

    def _job(self, unit: Unit, needed: int) -> str:
        place, stages = (unit.index, unit.start, unit.stop), tuple(self.wanted)
        root = str(self.place.absolute() if isinstance(self.place, Path) else self.place)
        return units.Work(root, self.table, self.resolved, self.specs, place, stages, needed).to_json()

    def _work(self, engine: engines.Engine, jobs: Mapping[str, Unit], means: _Means) -> None:
        """Has the jobs done; those that could not be are kept apart with what is needed to replay them."""
        total = sum(unit.stop - unit.start for unit in self.mine)
        left = dict(jobs)

        def advance() -> None:
            if means.progress:
                means.progress(total - sum(unit.stop - unit.start for unit in left.values()), total)

        def on_done(job: Job, text: str) -> None:
            del left[job.text]
            with (self.root / manifest.LOG).open("a") as log:
                log.write("".join(json.dumps(line) + "\n" for line in json.loads(text)["made"]))
            advance()

        advance()
        memory = None if means.memory is None else means.memory * 1e9
        queue = [Job(text, timeout(unit), memory) for text, unit in jobs.items()]
        failures = engine.run(units.CALL, queue, workers=means.workers, on_done=on_done)
        self._wait_for(unit for text, unit in jobs.items() if text not in left)
        if failures:
            message = self._set_aside(failures, jobs)
            if not means.allow_missing:
                raise QuarantineError(message)
            logging.getLogger(__name__).warning(message)

    def _wait_for(self, made: Iterable[Unit]) -> None:
        """Waits until units are seen here that were made elsewhere: network file systems may take a while to tell."""
        deadline = time.monotonic() + SEEN_WITHIN
        remote.refresh(self.root)
        for unit in made:
            while self._stage_to_make(unit):
                if time.monotonic() > deadline:
                    raise EnvironmentProblem(
                        f"{self.root}: unit {unit.index} was made, but it is not here; expected every machine that works to "
                        "see this folder under this path: choose one on a file system that they share with --out"
                    )
                time.sleep(0.5)

    def _stage_to_make(self, unit: Unit) -> str | None:
        """The first stage of this command in which a unit is not there; None if it is there in all."""
        layout = self.layout
        return next((name for name in self.wanted if not store.is_committed(layout.folder(name, unit))), None)

    def _set_aside(self, failures: Sequence[Failure], jobs: Mapping[str, Unit]) -> str:
        """Keeps each failed job with its reason; the message that names them."""
        lines = []
        for failure in failures:
            unit = jobs[failure.job.text]
            path = self._story(unit)
            replay = shlex.join([sys.executable, "-m", "dapdata.pipeline", str(path)])
            stage = self._stage_to_make(unit) or self.wanted[-1]
            story = {
                "stage": stage,
                "key": self.layout.key(stage, unit),
                "unit": unit.index,
                "demo_range": [unit.start, unit.stop],
                "seed": self.resolved["seed"],
                "reason": failure.reason,
                "stderr": failure.stderr,
                "replay": replay,
                "work": json.loads(failure.job.text),
            }
            durable.replace_file(path, json.dumps(story, indent=1).encode())
            lines.append(
                f"unit {unit.index} (demos {unit.start} to {unit.stop - 1}, seed {self.resolved['seed']}): {failure.reason}; "
                f"replay with: {replay}"
            )
        return (
            f"{self.root}: {len(failures)} of {len(jobs)} units failed {engines.RETRIES + 1} times, the others are done; "
            f"run the same command to try them again, or with --allow-missing to do without them\n" + "\n".join(lines)
        )

    def _story(self, unit: Unit) -> Path:
        """Where it is kept why a unit failed."""
        return self.root / QUARANTINE / f"{unit.index:05d}.json"

    def _missing(self, means: _Means) -> list[MissingEntry] | None:
        """What the dataset is published without; None while units are not there that it should not be without."""
        found = list(self.lost)
        remote.refresh(self.root)
        for unit in self.units:
            stage = self._stage_to_make(unit)
            if stage is not None:
                entry = self._given_up(unit, stage) if means.allow_missing else None
                if entry is None:
                    return None
                found.append(entry)
        return sorted(found, key=lambda entry: entry.demo_range)

    def _given_up(self, unit: Unit, stage: str) -> MissingEntry | None:
        """Why a unit failed in a stage, if it was set aside as it is to be made now."""
        try:
            story = json.loads(self._story(unit).read_bytes())
            if story["key"] == self.layout.key(stage, unit):
                return MissingEntry(demo_range=(unit.start, unit.stop), stage=stage, reason=story["reason"])
        except (OSError, ValueError, KeyError, TypeError):  # none was, or what is there is no such story
            pass
        return None

    def _publish(self, means: _Means) -> None:
        """Writes the manifest, unless units are not there yet."""
        without = self._missing(means)
        if without is None:
            return
        self._note()  # of what is published, should that be interrupted
        if len(without) == len(self._all_units):
            raise QuarantineError(f"{self.root}: all units failed ({without[0].reason}), expected some that did not")
        now = units.publish(self.layout, self.stages, self.resolved, self.recipe.split, self._all_units, without)
        tried = now.demos - sum(stop - start for start, stop in (entry.demo_range for entry in without))
        if sum(now.rejects.demos.values()) >= tried:
            reasons = ", ".join(f"{reason} {count}" for reason, count in now.rejects.demos.items())
            raise UsageError(
                f"{self.root}: all {tried} demos were rejected ({reasons}), expected some that are not; "
                f"{self.recipe.scene.remedy}"
            )


# Around the commands ---------------------------------------------------------------------------------------

QUARANTINE = "quarantine"
FOLDERS = ("shards", "stages", QUARANTINE, manifest.PREVIEWS)  # of a dataset
START_TIMEOUT = 300.0  # s: imports, and numba's first compilation
DEMO_TIMEOUT = 20.0  # s a demo: a hundred times what one takes
PATIENCE = 60.0  # s to wait for a lock that is held for moments: by who looks whether all units are there, or publishes
SEEN_WITHIN = 90.0  # s after which a unit made elsewhere is seen here: NFS keeps what it knows of a folder for up to 60 s
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
    ours = (manifest.MANIFEST, manifest.PROGRESS, manifest.LOG, manifest.INDEX, *FOLDERS)
    if root.exists() and not root.is_dir():
        raise FormatError(f"{root}: a file, expected a folder for the dataset; choose another with --out")
    if durable.is_occupied(root) and not any((root / name).exists() for name in ours):
        raise FormatError(f"{root}: a folder with other files and no dataset; choose an empty or new one with --out")


def check_packages(stages: Iterable[Stage]) -> None:
    """Raises a MissingExtraError before anything is written if a stage needs a package that is not installed."""
    for package in (package for stage in stages for package in stage.packages):
        if find_spec(package) is None:
            require(package, "sim")


def _check_space(root: Path, needed: int) -> None:
    """Stops before work begins if the estimate cannot fit."""
    if durable.mirror_of(root):
        return  # of a dataset in a store, no more than a unit a worker is on this machine
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
    for folder in FOLDERS:
        if (root / folder).is_dir():
            durable.discard(root, root / folder)


def _leave_nothing(root: Path) -> None:
    """Removes a folder in which no unit was finished: a recipe that admits no demo leaves no trace."""
    if not any(path.name != durable.LOCK and path.name != manifest.PROGRESS for path in root.iterdir()):
        durable.remove_file(root / manifest.PROGRESS)
        shutil.rmtree(root)


def replay(path: str) -> None:
    """Runs a quarantined unit in this process, where a debugger sees it."""
    folder, _, name = path.rpartition("/")
    with remote.working_copy(folder, files=(name,)) as copy:
        work = json.loads((copy / name).read_bytes())["work"]
    with remote.working_copy(work["root"], files=()) as root, durable.lock(root, shared=True):
        print(engines.answer(units.run_unit(json.dumps(work))))


if __name__ == "__main__":
    replay(sys.argv[1])
