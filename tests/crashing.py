"""What a crash leaves behind, before any fsync, rename or removal that `durable` makes.

A run is made once, and before its calls the disk is looked at in two ways: as a killed process leaves it, all that was
written being there; and as a power cut may leave it at worst, names being those of the last fsync of their folder, and
bytes those of the last fsync of their file. Each look is a folder of its own that can be gone on with.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from dapdata import durable

IN_PLACE = (".lock", "log.jsonl", "metrics.jsonl")  # changed where they are; all other files are written once, then moved


class Crash(BaseException):
    """A power cut: nothing catches it."""


@dataclass(frozen=True)
class Look:
    """What a crash before one call leaves."""

    number: int  # of the call, from 0
    kind: str  # "killed" or "cut"
    folder: Path


@contextmanager
def watching(see: Callable[[str, Path], None]) -> Iterator[None]:
    """Calls `see` before each fsync, rename and removal."""
    durable.observer = see
    try:
        yield
    finally:
        durable.observer = None


@contextmanager
def crash_at(number: int) -> Iterator[None]:
    """Raises Crash instead of the call of that number, counted from 1."""
    done = 0

    def stop(action: str, path: Path) -> None:
        nonlocal done
        done += 1
        if done == number:
            raise Crash

    with watching(stop):
        yield


def crashes(run: Callable[[], object], root: Path, scratch: Path, every: bool = False) -> list[Look]:
    """What crashes leave of `root` in the course of a run.

    Args:
        run: Writes into root.
        root: May hold something already, all of which is on the disk for sure.
        scratch: An empty folder on the same disk.
        every: Before every call. Or else only before those after which something else is left, but for what is staged:
            that is swept away first.
    """
    looks: list[Look] = []
    platter, seen, calls = _Platter(scratch / "vault"), {"killed": b"", "cut": b""}, 0
    if root.exists():
        for path in [*root.rglob("*"), root]:
            platter.fsync(path)

    def see(action: str, path: Path) -> None:
        nonlocal calls
        if every or durable.STAGING not in path.relative_to(root.parent).parts or action != "fsync":
            for kind, look in (("killed", _copy), ("cut", platter.restore)):
                folder = look(root, scratch / f"{kind}-{calls}")
                now = _state(folder)
                if not every and now == seen[kind]:
                    shutil.rmtree(folder)
                else:
                    seen[kind] = now
                    looks.append(Look(calls, kind, folder))
        calls += 1
        if action == "fsync":
            platter.fsync(path)

    with watching(see):
        run()
    platter.close()
    return looks


def _state(root: Path) -> bytes:
    """Every name and inode that a command goes by, but for what it sweeps away first."""
    found = [
        f"{path.relative_to(root)} {'' if path.is_dir() else path.stat().st_ino}\n"
        for path in sorted(root.rglob("*"))
        if path.relative_to(root).parts[0] not in (durable.STAGING, *IN_PLACE) and not path.match(durable.TEMPORARY)
    ]
    return "".join(found).encode()


def _copy(source: Path, target: Path) -> Path:
    """A copy that shares the bytes of files that are never changed in place."""
    target.mkdir()
    if source.exists():
        shutil.copytree(source, target, copy_function=_link, dirs_exist_ok=True)
    return target


def _link(source: str, target: str) -> None:
    (shutil.copyfile if Path(source).name in IN_PLACE else os.link)(source, target)


class _Platter:
    """What is on the disk for sure, by inode."""

    def __init__(self, vault: Path) -> None:
        self.vault = vault
        self.vault.mkdir(parents=True)
        self.names: dict[int, dict[str, tuple[int, bool]]] = {}  # of a folder: inode, and whether that is a folder too
        self.bytes: dict[int, Path] = {}  # of a file: another name for it
        self.held: list[int] = []  # folders that are kept open, so that no inode is used twice

    def fsync(self, path: Path) -> None:
        inode = path.stat().st_ino
        if path.is_dir():
            if inode not in self.names:
                self.held.append(os.open(path, os.O_RDONLY))
            self.names[inode] = {entry.name: (entry.inode(), entry.is_dir()) for entry in os.scandir(path)}
        elif inode not in self.bytes:
            self.bytes[inode] = self.vault / str(inode)
            _link(str(path), str(self.bytes[inode]))

    def restore(self, root: Path, target: Path) -> Path:
        target.mkdir()
        if root.exists():
            self._fill(root.stat().st_ino, target)
        return target

    def _fill(self, folder: int, target: Path) -> None:
        for name, (inode, is_folder) in self.names.get(folder, {}).items():
            if is_folder:
                (target / name).mkdir()
                self._fill(inode, target / name)
            elif inode in self.bytes:
                _link(str(self.bytes[inode]), str(target / name))
            else:
                (target / name).touch()  # the name is there, the bytes are not

    def close(self) -> None:
        for handle in self.held:
            os.close(handle)
