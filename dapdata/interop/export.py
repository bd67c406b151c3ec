"""What all exports have in common: which demos, how the folder comes about, what is told of it.

An export is a folder that is there whole or not at all. It grows beside its place, in `<out>.partial`, piece by piece (a
file, or the folder of one demo); each piece is staged, fsynced and renamed, and the whole takes its name last. So the
same command, run again, goes on where it stopped, and what carries the name `<out>` is complete. Writing straight into
`<out>` would be simpler, but three of ten tar files look just like a dataset of three.

`export.json` says what the export was made of and how, and names its files with their sha256. There are no times of day
and no host names in it or in any other file: the same dataset and options give the same bytes.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dapdata import __version__, card, durable, loading, manifest
from dapdata.errors import FormatError, MissingExtraError, UsageError
from dapdata.loading import Dataset
from dapdata.records import Array
from dapdata.split import SPLITS, UNUSED
from dapdata.store import COLUMNS, Sample

ABOUT = "export.json"
PLACES = ("shard", "row")  # columns of the index that mean nothing outside of the dataset's folder

Progress = Callable[[int, int], None]  # demos done, demos in all
Row = tuple[dict[str, Any], Sample]  # what the index tells of a demo, and its arrays by path


@dataclass(frozen=True)
class Chosen:
    """The demos that are exported."""

    dataset: Dataset
    splits: Mapping[str, Array]  # by split, (D,) numbers of its demos in the dataset, in demo order; none is empty
    asked: Mapping[str, Any]  # how they were chosen, for export.json

    @property
    def count(self) -> int:
        """How many there are."""
        return sum(len(numbers) for numbers in self.splits.values())


@dataclass(frozen=True)
class Piece:
    """What is committed at once: a file, or the folder of a demo."""

    path: str  # from the export's folder
    numbers: Array  # (D,) of its demos in the dataset


@dataclass(frozen=True)
class Export:
    """A format's plan: what is written besides the demos themselves, and how."""

    format: str
    options: Mapping[str, Any]
    chosen: Chosen
    pieces: Sequence[Piece]
    write: Callable[[Piece, Path, Iterator[Row]], None]  # (piece, where, facts and arrays)
    files: Mapping[str, bytes]  # by path, such as README.md


def choose(root: str | Path, split: str | None = None, demos: int | None = None) -> Chosen:
    """The first demos of a dataset, or of one split of it.

    Args:
        root: The dataset's folder.
        split: "train", "val" or "test"; None for all demos, those that are in no split ("unused") among them.
        demos: At most so many.

    Raises:
        FormatError: if there is no labelled dataset.
        UsageError: if there is no such split, or nothing in it, or `demos` is less than 1.
    """
    _at_least_one("demos", demos)
    dataset = loading.open(root, split)
    owners = dataset.index["split"][:demos]
    if not len(owners):
        raise UsageError(f"{root}: no demos in split '{split}', expected some; `dapdata inspect {root}` counts them")
    order = [name for name in (*SPLITS, UNUSED) if name in owners]
    return Chosen(dataset, {name: np.flatnonzero(owners == name) for name in order}, {"split": split, "demos": demos})


def _at_least_one(name: str, value: int | None) -> None:
    if value is not None and value < 1:
        raise UsageError(f"{name}: got {value}, expected at least 1")


def cut(chosen: Chosen, size: int) -> Iterator[tuple[str, list[Array]]]:
    """Each split with its demos in parts of `size`, the last one smaller."""
    _at_least_one("shard_size", size)
    for name, numbers in chosen.splits.items():
        yield name, np.split(numbers, range(size, len(numbers), size))


def by_demo(chosen: Chosen) -> list[Piece]:
    """A folder for each demo, in a folder for each split."""
    demo = chosen.dataset.index["demo"]
    return [
        Piece(f"{name}/{demo_name(int(demo[number]))}", np.array([number]))
        for name, numbers in chosen.splits.items()
        for number in numbers.tolist()
    ]


def demo_name(demo: int) -> str:
    """How a demo is called in every format: by its index in the dataset."""
    return f"demo_{demo:06d}"


def facts(dataset: Dataset, number: int) -> dict[str, Any]:
    """What the index tells of a demo: its number, split, task, instances, counts and digest."""
    values = {name: column[number] for name, column in dataset.index.items() if name not in PLACES}
    return {name: int(value) if isinstance(value, np.integer) else value for name, value in values.items()}


def readme(chosen: Chosen, form: card.Form) -> dict[str, bytes]:
    """The dataset's card with what is particular to a format, and its pictures, by path."""
    dataset, found = chosen.dataset, chosen.dataset.manifest
    numbers = np.concatenate([*chosen.splits.values()])
    pictures = dataset.files([path for path in found.files if path.startswith(f"{manifest.PREVIEWS}/")])
    text = card.render(
        found.model_copy(update={"shards": [], "stages": {}}).model_dump(mode="json"),
        {name: entry.spec for name, entry in found.stages.items() if entry.units},
        sum(shard.demos for shard in found.shards),
        {name: column[numbers] for name, column in dataset.index.items()},
        sorted(pictures),
        form,
    )
    return {manifest.CARD: text.encode(), **pictures}


def described(dataset: Dataset) -> dict[str, Mapping[str, Any]]:
    """What is known of each array of a dataset by its path: dtype, dims, unit, frame, description, names of codes."""
    sample = dataset[0]
    return {path: column.metadata for path, column in COLUMNS.items() if path in sample}


# The folder ------------------------------------------------------------------------------------------------


def run(out: str | Path, export: Export, progress: Progress | None = None) -> Path:
    """Writes an export, or what is missing of it; nothing if it is there already.

    Args:
        out: The folder; new, empty, or this same export.
        export: What to write.
        progress: Called with demos done and demos in all; a demo of two pieces counts twice.

    Returns:
        The folder.

    Raises:
        UsageError: if the folder holds anything else.
        LockedError: if another process writes it.
        EnvironmentProblem: if the disk is full; what is written stays, and running it again goes on.
    """
    target = Path(os.path.abspath(out))
    about = _about(export)
    partial = target.with_name(f"{target.name}.partial")
    _refuse_inside(out, target, export.chosen.dataset.root)
    with durable.disk_problems(target):
        if _is_there(out, target, about):
            return Path(out)
        _refuse_foreign(partial)
        with durable.lock(partial):
            _start(partial, about)
            try:
                _write_pieces(partial, export, progress)
            except (UsageError, MissingExtraError):  # nothing that running it again could mend
                shutil.rmtree(partial)
                raise
            for path, data in export.files.items():
                durable.replace_file(partial / path, data)
            _finish(partial, target, about)
    return Path(out)


def _about(export: Export) -> dict[str, Any]:
    """What an export is made of, as JSON gives it back: the same for the same bytes."""
    found = export.chosen.dataset.manifest
    about = {
        "format": export.format,
        "options": dict(export.options),
        **export.chosen.asked,
        "dataset": {
            "name": found.name,
            "task": found.task,
            "content_sha256": found.content_sha256,
            "recipe_sha256": found.recipe_sha256,
        },
        "arrays": {path: dict(told) for path, told in described(export.chosen.dataset).items()},
        "created_by": {"dapdata": __version__},
    }
    return dict(json.loads(json.dumps(about)))


def _refuse_inside(out: str | Path, target: Path, root: str | Path) -> None:
    if target.resolve().is_relative_to(Path(root).resolve()):
        raise UsageError(f"{out}: in the dataset's own folder, expected a place outside of {root}; choose another with --out")


def _is_there(out: str | Path, target: Path, about: Mapping[str, Any]) -> bool:
    """Whether the folder is this export; False if it is new or empty."""
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return False
    found = _read_about(target)
    if found is None:
        raise UsageError(f"{out}: exists and is no export, expected a new or empty folder; choose another with --out")
    files = found.pop("files", {})
    other = sorted(name for name in {*found, *about} if found.get(name) != about.get(name))
    if other:
        raise UsageError(
            f"{out}: holds an export that differs in {', '.join(other)}, expected a new or empty folder; delete it, or choose "
            "another with --out"
        )
    changed = [path for path, fact in files.items() if not _has_size(target / path, fact["bytes"])]
    if changed:
        raise UsageError(
            f"{out}: {changed[0]} is not what was exported, expected it as written; delete the folder, then export"
        )
    return True


def _read_about(folder: Path) -> dict[str, Any] | None:
    try:
        found = json.loads((folder / ABOUT).read_bytes())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _has_size(path: Path, size: int) -> bool:
    return path.is_file() and path.stat().st_size == size


def _refuse_foreign(partial: Path) -> None:
    """Refuses to clear what somebody else may have put under the name of an unfinished export."""
    known = (".lock", durable.STAGING)
    others = partial.exists() and not partial.is_dir()
    if partial.is_dir() and _read_about(partial) is None:
        others = any(path.name not in known and not path.match(durable.TEMPORARY) for path in partial.iterdir())
    if others:
        raise UsageError(f"{partial}: exists and is no unfinished export, expected that name to be free; move it away")


def _start(partial: Path, about: Mapping[str, Any]) -> None:
    """Makes the unfinished folder one of this export; what there is of another one goes."""
    found = _read_about(partial)
    if found is not None and {**found, "files": {}} != {**about, "files": {}}:
        durable.remove_file(partial / ABOUT)
        for path in partial.iterdir():
            if path.name != ".lock":
                shutil.rmtree(path) if path.is_dir() else path.unlink()
    durable.replace_file(partial / ABOUT, durable.canonical(about))


def _write_pieces(partial: Path, export: Export, progress: Progress | None) -> None:
    dataset, total, done = export.chosen.dataset, sum(len(piece.numbers) for piece in export.pieces), 0

    def read(numbers: Array) -> Iterator[Row]:
        for i, number in enumerate(numbers.tolist(), 1):
            yield facts(dataset, number), dataset[number]
            if progress:
                progress(done + i, total)

    for piece in export.pieces:
        target = partial / piece.path
        if not target.exists():
            with durable.staged(partial, target.name) as folder:
                export.write(piece, folder / target.name, read(piece.numbers))
                durable.commit(folder / target.name, target)
        done += len(piece.numbers)


def _finish(partial: Path, target: Path, about: Mapping[str, Any]) -> None:
    """Names all files in export.json and gives the folder its name."""
    durable.sweep(partial)
    paths = sorted(path for path in partial.rglob("*") if path.is_file() and path.name not in (".lock", ABOUT))
    files = {
        path.relative_to(partial).as_posix(): {"sha256": durable.hash_file(path), "bytes": path.stat().st_size}
        for path in paths
    }
    text = json.dumps({**about, "files": files}, indent=1, sort_keys=True) + "\n"
    durable.replace_file(partial / ABOUT, text.encode())
    if not durable.move(partial, target):  # every piece was fsynced when it was committed
        raise FormatError(f"{target}: was made by somebody else meanwhile, expected to be free; choose another with --out")
    (target / ".lock").unlink()
