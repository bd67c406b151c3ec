"""What a stage is, what decides its results, and which of its units are there already.

A unit is a range of demos in one stage. Its key is the sha256 of all that its bytes follow from: the stage's
version, its recipe sections with every default filled in, the seed, the demo range, the keys of the units that it
reads, and the versions of packages that change results. How many demos there are in all, the number of workers,
the engine and the paths are not in it, so a dataset grows and moves without being made anew.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from dapdata import durable, rng
from dapdata.errors import UsageError
from dapdata.records import Record, Rejected

FORMAT = 1  # part of every key: another format makes every unit anew

Inputs = Mapping[str, Any]  # records of the stages that are needed, by the stage's name
Sections = Mapping[str, Any]  # the stage's own recipe sections by name


@dataclass(frozen=True)
class Draw:
    """One attempt at one demo, and its generators."""

    seed: int
    demo: int
    attempt: int = 0

    def __call__(self, purpose: str) -> np.random.Generator:
        """The generator for a purpose such as "scene"."""
        return rng.stream(self.seed, purpose, self.demo, self.attempt)


Run = Callable[[Inputs, Sections, Draw], Record | Rejected]
Spec = dict[str, Any]  # what a stage's results follow from, but for the seed and the demos


@dataclass(frozen=True)
class Stage:
    """One arrow of the spine."""

    name: str
    version: int  # raised by hand when results change
    sections: tuple[str, ...]  # of the recipe: the only ones that `run` is handed
    needs: tuple[str, ...]  # stages whose records it reads
    makes: type[Record]
    run: Run
    packages: tuple[str, ...] = ()  # whose versions change results
    attempts: int = 1  # more: a rejected demo is drawn again, this often in all, then it is an error
    is_shard: bool = False  # its units hold everything upstream too, and are the product


@dataclass(frozen=True)
class Unit:
    """The demos start, ..., stop - 1."""

    index: int
    start: int
    stop: int


def units(demos: int, shard_size: int) -> list[Unit]:
    """The demos of a dataset in units; the last may be smaller."""
    return [Unit(i, first, min(first + shard_size, demos)) for i, first in enumerate(range(0, demos, shard_size))]


def stripe(text: str, units: Sequence[Unit]) -> list[Unit]:
    """Every N-th unit from the I-th on, for a text "I/N": the same ones whoever works on them, and with how many workers.

    Raises:
        UsageError: if the text is no such thing.
    """
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    index, count = map(int, found.groups()) if found else (0, 0)
    if index >= count:
        raise UsageError(
            f"--units: got '{text}', expected I/N with I from 0 to N - 1, such as 0/8 to 7/8; in an array job I is the "
            "number of the task, counted from 0"
        )
    return list(units[index::count])


def specs(stages: Sequence[Stage], resolved: Mapping[str, Any]) -> dict[str, Spec]:
    """What each stage's results follow from under a resolved recipe, with the packages installed here."""
    return {
        stage.name: {
            "version": stage.version,
            "sections": {name: resolved[name] for name in stage.sections},
            "needs": list(stage.needs),
            "packages": {name: _installed(name) for name in stage.packages},
        }
        for stage in stages
    }


def _installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


class Keys:
    """Keys of units: the sha256 of canonical JSON, of which all that units share is written once."""

    def __init__(self, plan: Mapping[str, Spec], seed: int) -> None:
        self._plan = plan
        self._shared = {
            name: durable.canonical(
                {"format": FORMAT, "packages": spec["packages"], "sections": spec["sections"], "seed": seed, "stage": name}
            )[1:-1]
            for name, spec in plan.items()
        }

    def of(self, stage: str, unit: Unit) -> str:
        """The key of a unit in a stage."""
        spec = self._plan[stage]
        upstream = durable.canonical({need: self.of(need, unit) for need in spec["needs"]})
        demos, version = f"[{unit.start},{unit.stop}]".encode(), durable.canonical(spec["version"])
        parts = (b'{"demos":', demos, b",", self._shared[stage], b',"upstream":', upstream, b',"version":', version, b"}")
        return sha256(b"".join(parts)).hexdigest()


def unit_keys(plan: Mapping[str, Spec], seed: int, unit: Unit) -> dict[str, str]:
    """The key of a unit in each stage."""
    keys = Keys(plan, seed)
    return {name: keys.of(name, unit) for name in plan}


@dataclass(frozen=True)
class Layout:
    """Where the units of one labelling of one dataset are, and what their keys are."""

    root: Path
    plan: Mapping[str, Spec]
    seed: int
    shard_size: int
    shard_stage: str

    @cached_property
    def labelling(self) -> str:
        """Short digest of all that decides the shards, but for which demos there are."""
        return durable.digest([FORMAT, dict(self.plan), self.seed, self.shard_size])[:12]

    @cached_property
    def _keys(self) -> Keys:
        return Keys(self.plan, self.seed)

    def key(self, stage: str, unit: Unit) -> str:
        """The key of a unit in a stage."""
        return self._keys.of(stage, unit)

    def path(self, stage: str, unit: Unit) -> str:
        """The folder of a unit, from the dataset's; a shard that isn't full says how many demos it is for."""
        if stage != self.shard_stage:
            return f"stages/{stage}/{self.key(stage, unit)[:20]}"
        count = unit.stop - unit.start
        suffix = "" if count == self.shard_size else f"-{count}"
        return f"shards/{self.labelling}/{unit.index:05d}{suffix}.zarr"

    def folder(self, stage: str, unit: Unit) -> Path:
        """The folder of a unit."""
        return self.root / self.path(stage, unit)


# Why something runs again ----------------------------------------------------------------------------------


def changes(old: Spec, new: Spec) -> list[str]:
    """What differs between two specs of one stage: "noise.preset none -> d415"."""
    before, after = dict(_flat(_without_needs(old))), dict(_flat(_without_needs(new)))
    return [
        f"{name} {_shown(before.get(name))} -> {_shown(after.get(name))}"
        for name in sorted(before | after)
        if before.get(name) != after.get(name)
    ]


def _without_needs(spec: Spec) -> dict[str, Any]:
    return {"version of the stage": spec["version"], **spec["sections"], **spec["packages"]}


def _flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _shown(value: Any) -> str:
    return "(not there)" if value is None else str(value)
