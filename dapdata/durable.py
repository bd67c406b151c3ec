"""Files that survive a power cut: staging, fsync, rename, the lock and the hash.

Everything that is published goes through here, in this order: write in `staging/`, fsync the files, fsync the
folders from the leaves up, rename, fsync the folder that holds the new name. A reader or a crash therefore sees
a committed folder whole or not at all. zarr writes its chunks by rename too, but never fsyncs, and reads a
missing chunk as fill values without a word; hence a whole unit is committed at once and named by its hashes.

A dataset may come from anywhere. Links in it could lead a reader or a writer out of its folder, so there are none:
`is_inside` and `refuse_links` see to that, and `read_json` believes no size before it has looked.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import socket
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import file_digest, sha256
from pathlib import Path
from typing import Any

from dapdata.errors import EnvironmentProblem, FormatError, LockedError

STAGING = "staging"
TEMPORARY = ".*.tmp"  # names that are half-written until they are renamed
LOCK = ".lock"
MAX_JSON = 256_000_000  # bytes: the manifest of ten million demos
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
    """sha256 of a file's bytes; an OSError if it is no plain file: a pipe would be waited for."""
    if not stat.S_ISREG(path.lstat().st_mode):
        raise OSError(errno.EINVAL, "no plain file", str(path))
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
    """Moves a staged folder to its place for good; False if there is something already (then nothing is moved)."""
    for path, _, files in os.walk(folder, topdown=False):
        for file in sorted(files):
            _fsync(Path(path, file))
    for path, _, _ in os.walk(folder, topdown=False):
        _fsync(Path(path))
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
    try:
        temporary.write_bytes(data)
        _fsync(temporary)
    except OSError:  # a full disk: what was written of it must not fill it further
        temporary.unlink(missing_ok=True)
        raise
    _rename(temporary, path)
    _fsync(path.parent)


def is_occupied(folder: Path) -> bool:
    """Whether something is there, other than what a killed command of ours may have left in an empty folder."""
    if not folder.is_dir():
        return folder.exists()
    return any(path.name not in (LOCK, STAGING) and not path.match(TEMPORARY) for path in folder.iterdir())


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
    """Removes what killed processes left in staging and half-written names; only under the lock.

    Staging is renamed before it is deleted: a worker that outlived its command must not commit what is half gone.
    """
    grave = root / f".{STAGING}.tmp"
    shutil.rmtree(grave, ignore_errors=True)
    if (root / STAGING).is_dir():
        _rename(root / STAGING, grave)
    shutil.rmtree(grave, ignore_errors=True)
    for leftover in [*root.glob(TEMPORARY), *root.glob(f"*/{TEMPORARY}")]:
        leftover.unlink()


@contextmanager
def lock(root: Path) -> Iterator[None]:
    """Holds the dataset or run for one writer; readers need no lock. The lock dies with its process.

    Raises:
        LockedError: at once, if another process holds it; the message says which.
        FormatError: if the folder has links, through which a writer would change what is elsewhere.
    """
    make_folder(root)
    refuse_links(root)
    with os.fdopen(os.open(root / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644), "r+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            who = holder(root) or "another process"
            raise LockedError(f"{root}: in use by {who}; wait for it to end, or stop it, and run again") from error
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
        words = (root / LOCK).read_text(errors="replace")[:400]
        return words if Path("/proc", words.split()[1]).exists() else None
    except (OSError, ValueError, IndexError):
        return None


# What others may have put there ------------------------------------------------------------------------------


def is_inside(root: Path, path: Path) -> bool:
    """Whether a path leads, through all links, to something in the folder `root`."""
    return path.resolve().is_relative_to(root.resolve())


def refuse_links(root: Path) -> None:
    """Raises a FormatError if the folder, or a folder in it, has symbolic links: two levels, down to the units."""
    for path in [*root.glob("*"), *root.glob("*/*")]:
        if path.is_symlink():
            raise FormatError(
                f"{path}: a link, expected files and folders of a dataset or run alone; put what it leads to there"
            )


def read_json(path: Path, limit: int = MAX_JSON) -> Any:
    """What a JSON file holds.

    Raises:
        ValueError: not JSON, nested without end, larger than `limit`, or no file of bytes at all.
        OSError: if it cannot be read.
    """
    about = path.lstat()
    if not stat.S_ISREG(about.st_mode):
        raise ValueError("no plain file, expected JSON")
    if about.st_size > limit:
        raise ValueError(f"{about.st_size} bytes, expected at most {limit}")
    try:
        return json.loads(path.read_bytes(), parse_constant=_refuse_constant)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name}, expected numbers that are finite")


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
                f"{error.filename or root}: {error.strerror}, expected a folder that can be written; choose another"
            ) from error
        raise


def existing(path: Path) -> Path:
    """The path, or the nearest folder above it that is there."""
    path = path.absolute()
    return path if path.exists() else existing(path.parent)
