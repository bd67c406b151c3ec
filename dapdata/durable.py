"""Files that survive a power cut: staging, fsync, rename, the lock and the hash.

Everything that is published goes through here, in this order: write in `staging/`, fsync the files, fsync the
folders from the leaves up, rename, fsync the folder that holds the new name. A reader or a crash therefore sees
a committed folder whole or not at all. zarr writes its chunks by rename too, but never fsyncs, and reads a
missing chunk as fill values without a word; hence a whole unit is committed at once and named by its hashes.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import file_digest, sha256
from pathlib import Path
from typing import Any

from dapdata.errors import EnvironmentProblem, LockedError

STAGING = "staging"
TEMPORARY = ".*.tmp"  # names that are half-written until they are renamed
FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
NO_PERMISSION = (errno.EACCES, errno.EPERM, errno.EROFS)

observer: Callable[[str, Path], None] | None = None  # tests set it to see, or to stop at, every fsync and rename


def _note(action: str, path: Path) -> None:
    if observer is not None:
        observer(action, path)


def canonical(value: Any) -> bytes:
    """JSON with sorted keys and no spaces: one text for one value, fit for hashing. NaN is refused."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False).encode()


def digest(value: Any) -> str:
    """sha256 of the canonical JSON of a value."""
    return sha256(canonical(value)).hexdigest()


def hash_file(path: Path) -> str:
    """sha256 of a file's bytes."""
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()


def _fsync(path: Path) -> None:
    _note("fsync", path)
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _rename(source: Path, target: Path) -> None:
    _note("rename", target)
    source.rename(target)


def make_folder(path: Path) -> None:
    """Makes a folder and those above it, each name fsynced into the folder that holds it."""
    if not path.is_dir():
        make_folder(path.parent)
        path.mkdir(exist_ok=True)
        _fsync(path.parent)


@contextmanager
def staged(root: Path, name: str) -> Iterator[Path]:
    """A fresh folder in root's staging, removed again on the way out unless `commit` moved it away."""
    make_folder(root / STAGING)
    folder = Path(tempfile.mkdtemp(prefix=f"{name}-", dir=root / STAGING)) / name
    folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder.parent, ignore_errors=True)


def commit(folder: Path, target: Path) -> bool:
    """Moves a staged folder, or file, to its place for good; see `move`."""
    if folder.is_file():
        _fsync(folder)
    for path, _, files in os.walk(folder, topdown=False):
        for file in sorted(files):
            _fsync(Path(path, file))
    for path, _, _ in os.walk(folder, topdown=False):
        _fsync(Path(path))
    return move(folder, target)


def move(folder: Path, target: Path) -> bool:
    """Gives a folder, whose files are fsynced, its name for good; False if there is something already (then it stays)."""
    make_folder(target.parent)
    try:
        _rename(folder, target)
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
            return False
        raise
    _fsync(target.parent)
    return True


def replace_file(path: Path, data: bytes) -> None:
    """Writes a file so that its name holds either the old bytes or the new ones, also after a power cut."""
    make_folder(path.parent)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_bytes(data)
    _fsync(temporary)
    _rename(temporary, path)
    _fsync(path.parent)


def remove_file(path: Path) -> None:
    """Takes a name away for good; a name that isn't there is fine."""
    if path.exists():
        _note("remove", path)
        path.unlink()
        _fsync(path.parent)


def discard(root: Path, path: Path) -> None:
    """Deletes a folder so that a crash leaves it whole or gone: it is renamed into staging first."""
    make_folder(root / STAGING)
    grave = Path(tempfile.mkdtemp(prefix="discarded-", dir=root / STAGING))
    _rename(path, grave / path.name)
    _fsync(path.parent)
    shutil.rmtree(grave)


def sweep(root: Path) -> None:
    """Removes what killed processes left in staging and half-written names; only under the lock."""
    shutil.rmtree(root / STAGING, ignore_errors=True)
    for leftover in [*root.glob(TEMPORARY), *root.glob(f"*/{TEMPORARY}")]:
        leftover.unlink()


@contextmanager
def lock(root: Path) -> Iterator[None]:
    """Holds the dataset for one writer; readers need no lock. The lock dies with its process.

    Raises:
        LockedError: at once, if another process holds it; the message says which.
    """
    make_folder(root)
    with (root / ".lock").open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.seek(0)
            holder = file.read().strip() or "another process"
            raise LockedError(f"{root}: in use by {holder}; wait for it to end, or stop it, and run again") from error
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()} ({' '.join(sys.argv)[:200]})")
        file.flush()
        sweep(root)
        try:
            yield
        finally:
            sweep(root)
            file.truncate(0)


def holder(root: Path) -> str | None:
    """Who works on the dataset now, as it said itself; None if nobody does."""
    try:
        words = (root / ".lock").read_text()
    except OSError:
        return None
    return words if words and Path("/proc", words.split()[1]).exists() else None


@contextmanager
def disk_problems(root: Path, needed: int = 0) -> Iterator[None]:
    """Turns a full disk or a missing permission into an EnvironmentProblem that says what to do.

    Args:
        root: The dataset's folder.
        needed: Estimate of the bytes still to be written, for the message.
    """
    try:
        yield
    except OSError as error:
        if error.errno in FULL_DISK:
            much = f"about {needed / 1e6:.0f} MB more are needed, " if needed else ""
            free = shutil.disk_usage(existing(root)).free / 1e6
            raise EnvironmentProblem(
                f"{root}: disk full ({error.strerror}), {much}{free:.0f} MB are free; nothing committed is lost: "
                "make room and run the same command again"
            ) from error
        if error.errno in NO_PERMISSION:
            raise EnvironmentProblem(
                f"{error.filename or root}: {error.strerror}, expected a folder that can be written; choose another with --out"
            ) from error
        raise


def existing(path: Path) -> Path:
    """The path, or the nearest folder above it that is there."""
    path = path.absolute()
    return path if path.exists() else existing(path.parent)
