"""Cut off before any of its fsyncs, renames and removals, a command run again ends as one that was not.

Both by a kill and by a power cut, for every command that writes datasets, on toy stages: see crashing.py.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from crashing import Look, crashes, watching
from toy_stages import toy_recipe

from dapdata import durable, health, manifest, pipeline
from dapdata.errors import FormatError

Command = Callable[[Path], object]


def label(root: Path, *overrides: str) -> None:
    pipeline.label(root, overrides, engine="inline", table="toy_stages")


def generate(root: Path, demos: int, shard_size: int = 1, fresh: bool = False) -> None:
    pipeline.generate(toy_recipe(demos, shard_size), root, engine="inline", fresh=fresh, table="toy_stages")


def draw(root: Path) -> None:
    """What `dapdata label` does after labelling."""
    if not (root / manifest.MANIFEST).exists():
        label(root)
    pipeline.attach(root, {"preview/goals.png": b"a picture"})


COMMANDS: dict[str, Command] = {  # one after the other, on the same dataset
    "generate": lambda root: generate(root, 2),
    "label": label,
    "draw pictures": draw,
    "label otherwise": lambda root: label(root, "label.eps_place=0.02"),
    "label as before": lambda root: label(root, "label.eps_place=0.03"),
    "generate more": lambda root: generate(root, 3),
    "label more": label,
    "gc": health.gc,
    "generate afresh": lambda root: generate(root, 2, fresh=True),
}
SMALL: dict[str, Command] = {"generate": lambda root: generate(root, 2, 2), "label": label, "draw pictures": draw}


def whole_or_unpublished(root: Path) -> bool:
    try:
        return health.verify(root, quick=True).ok
    except FormatError:
        return not (root / manifest.MANIFEST).exists()


def run_again(look: Look, command: Command, content: str) -> None:
    """The same command, on what a crash left."""
    root = look.folder
    assert whole_or_unpublished(root), look
    command(root)
    report = health.verify(root, quick=True)
    assert report.ok, (look, report)
    assert manifest.read(root).content_sha256 == content
    left = [path.name for path in root.rglob("*") if path.match(durable.TEMPORARY) or path.name == durable.STAGING]
    assert left == []
    assert not (root / manifest.PROGRESS).exists()


def survived(commands: dict[str, Command], scratch: Path, every: bool = False, step: int = 1) -> Counter[str]:
    """How many crashes of each kind the commands survived; of all that were to be survived, each `step`-th."""
    root, counts = scratch / "toy", Counter[str]()
    for name, command in commands.items():
        looks = crashes(lambda command=command: command(root), root, scratch / name, every)
        content = manifest.read(root).content_sha256
        for look in looks[::step]:
            run_again(look, command, content)
            shutil.rmtree(look.folder)
            counts[look.kind] += 1
    return counts


def test_after_a_crash_the_same_command_ends_well(in_memory: Path) -> None:
    """Before calls after which something else is on the disk: a third of them."""
    counts = survived(SMALL, in_memory, step=3)
    assert min(counts["killed"], counts["cut"]) > 7


@pytest.mark.slow
def test_after_a_crash_of_any_command_anywhere_the_same_command_ends_well(in_memory: Path) -> None:
    assert survived(COMMANDS, in_memory).total() > 180


@pytest.mark.slow
def test_after_a_crash_at_every_call_number_the_same_command_ends_well(in_memory: Path) -> None:
    assert survived(SMALL, in_memory, every=True).total() > 1000


def test_every_commit_is_fsynced_from_the_files_up_before_its_name_changes_and_its_folder_after(in_memory: Path) -> None:
    """Files, then folders, then the rename, then the folder that holds the new name; for all that is published."""
    root, calls, commits = in_memory / "toy", list[tuple[str, Path]](), 0

    def see(action: str, path: Path) -> None:
        nonlocal commits
        if calls and calls[-1][0] == "rename" and durable.STAGING not in calls[-1][1].name:
            assert (action, path) == ("fsync", calls[-1][1].parent)
        if action == "rename" and durable.STAGING not in path.name:
            check_fsynced(root, path, [seen for what, seen in calls if what == "fsync"])
            commits += 1
        calls.append((action, path))

    with watching(see):
        for command in SMALL.values():
            command(root)
    # Units; progress and manifest; index; card, each time another; its Croissant description; picture.
    assert commits == 4 + 3 * 2 + 1 + 3 + 1 + 1


def check_fsynced(root: Path, target: Path, fsynced: list[Path]) -> None:
    """Asserts that what is about to be named `target` is on the disk, the files before the folders."""
    hidden = [path for path in target.parent.glob(f".{target.name}.*") if path.match(durable.TEMPORARY)]
    (source,) = hidden or (root / durable.STAGING).rglob(target.name)
    inside = [source, *source.rglob("*")] if source.is_dir() else [source]
    last = {path: len(fsynced) - 1 - fsynced[::-1].index(path) for path in inside}  # ValueError: never
    for path in inside:
        assert path == source or last[path] < last[path.parent], path
