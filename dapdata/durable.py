"""Files that survive a power cut: staging, fsync, rename, the lock and the hash.

Everything that is published goes through here, in this order: write in `staging/`, fsync the files, fsync the
folders from the leaves up, rename, fsync the folder that holds the new name. A reader or a crash therefore sees
a committed folder whole or not at all. zarr writes its chunks by rename too, but never fsyncs, and reads a
missing chunk as fill values without a word; hence a whole unit is committed at once and named by its hashes.

A dataset in an object store is worked on in a copy on this machine (remote.py). What is made durable in the copy is
repeated in the store by the copy's `Mirror`, so there is one order of steps for both.

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
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from hashlib import file_digest, sha256
from pathlib import Path
from typing import IO, Any, Protocol

from dapdata.errors import EnvironmentProblem, FormatError, LockedError

STAGING = "staging"
TEMPORARY = ".*.tmp"  # names that are half-written until they are renamed
LOCK = ".lock"
MAX_JSON = 256_000_000  # bytes: the manifest of ten million demos
FULL_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
NO_PERMISSION = (errno.EACCES, errno.EPERM, errno.EROFS)

observer: Callable[[str, Path], None] | None = None  # tests set it to see, or to stop at, every fsync and rename


class Mirror(Protocol):
    """Repeats elsewhere what is made durable below a folder of this machine."""

    def hold(self, shared: bool, deadline: float) -> AbstractContextManager[None]:
        """Keeps other writers away there, as `lock` does here; brings here what they have done until now."""

    def commit(self, folder: Path) -> bool:
        """A folder was moved to its place here; False if there is another there already, which is then here too."""

    def replace(self, path: Path) -> None:
        """A file has new bytes."""

    def remove(self, path: Path) -> None:
        """A file or a folder is to go."""


mirrors: dict[Path, Mirror] = {}  # by folder; empty unless a dataset in an object store is worked on


def mirror_of(path: Path) -> Mirror | None:
    """The mirror of the working copy that a path is in."""
    return next((mirror for root, mirror in mirrors.items() if path.is_relative_to(root)), None)


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
    """Moves a staged folder to its place for good; False if there is something already (then nothing is changed).

    A single file may be moved too; it replaces one that has its name.
    """
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
    mirror = mirror_of(target)
    return mirror is None or mirror.commit(target)


def replace_file(path: Path, data: bytes) -> None:
    """Writes a file so that its name holds either the old bytes or the new ones, also after a power cut."""
    make_folder(path.parent)
    temporary = path.with_name(f".{path.name}.{_here()}.tmp")
    try:
        temporary.write_bytes(data)
        move_file(temporary, path)
    except OSError:  # a full disk: what was written of it must not fill it further
        temporary.unlink(missing_ok=True)
        raise


def move_file(source: Path, target: Path) -> None:
    """Moves a file to its place for good, in the place of what has that name."""
    make_folder(target.parent)
    _fsync(source)
    _rename(source, target)
    _fsync(target.parent)
    if mirror := mirror_of(target):
        mirror.replace(target)


def _here() -> str:
    """What tells the names that this process makes from those of others that share the folder."""
    return f"{socket.gethostname()}.{os.getpid()}"


def is_occupied(folder: Path) -> bool:
    """Whether something is there, other than what a killed command of ours may have left in an empty folder."""
    if not folder.is_dir():
        return folder.exists()
    return any(path.name not in (LOCK, STAGING) and not path.match(TEMPORARY) for path in folder.iterdir())


def remove_file(path: Path) -> None:
    """Takes a name away for good; a name that isn't there is fine."""
    if mirror := mirror_of(path):
        mirror.remove(path)
    if path.exists():
        _note("remove", path)
        path.unlink()
        _fsync(path.parent)


def discard(root: Path, path: Path) -> None:
    """Deletes a folder so that a crash leaves it whole or gone: it is renamed into staging first."""
    if mirror := mirror_of(path):
        mirror.remove(path)
    make_folder(root / STAGING)
    grave = Path(tempfile.mkdtemp(prefix="discarded-", dir=root / STAGING))
    _rename(path, grave / path.name)
    _fsync(path.parent)
    shutil.rmtree(grave)


def sweep(root: Path) -> None:
    """Removes what killed processes left in staging and half-written names; only under a lock that nobody shares.

    Staging is renamed first: a worker that has not heard yet of its command's end (on another machine it may go on for
    some seconds) then fails, instead of committing a folder that is half swept.
    """
    grave = root / f".{STAGING}.{_here()}.tmp"
    shutil.rmtree(grave, ignore_errors=True)  # of a process that was killed at this, and had the same number
    if (root / STAGING).is_dir():
        _rename(root / STAGING, grave)
    for leftover in [*root.glob(TEMPORARY), *root.glob(f"*/{TEMPORARY}")]:
        if leftover.is_dir():
            shutil.rmtree(leftover, ignore_errors=True)
        else:
            leftover.unlink()


def this_process() -> str:
    """How a holder of a lock is named to others."""
    return f"process {os.getpid()} on {socket.gethostname()} ({' '.join(sys.argv)[:200]})"


@contextmanager
def lock(root: Path, *, shared: bool = False, patience: float = 0.0) -> Iterator[None]:
    """Holds a dataset or run for one writer, or for several that share it; readers need no lock. It dies with its process.

    Those who share it may commit units, which is a rename each and harmless if two make the same one. They neither
    sweep nor publish.

    Args:
        root: The dataset's or run's folder.
        shared: Whether others may hold it at the same time, if they share it too.
        patience: How long to wait for it, s.

    Raises:
        LockedError: if another process holds it; the message says which.
        FormatError: if the folder has links, through which a writer would change what is elsewhere.
    """
    make_folder(root)
    refuse_links([root / LOCK])
    handle = os.open(root / LOCK, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    with os.fdopen(handle, "a+", errors="replace") as file:
        deadline = time.monotonic() + patience
        _flock(root, file, fcntl.LOCK_SH if shared else fcntl.LOCK_EX, deadline)
        refuse_links([*root.glob("*"), *root.glob("*/*")])  # down to the units
        mine = f"{this_process()}\n"
        if not shared:
            file.truncate(0)
            sweep(root)
        file.write(mine)
        file.flush()
        mirror = mirror_of(root)
        try:
            with mirror.hold(shared, deadline) if mirror else nullcontext():
                yield
        finally:
            if not shared:
                sweep(root)
            file.seek(0)
            others = file.read().replace(mine, "", 1) if shared else ""
            file.truncate(0)
            file.write(others)


def _flock(root: Path, file: IO[str], kind: int, deadline: float) -> None:
    while True:
        try:
            fcntl.flock(file, kind | fcntl.LOCK_NB)
            return
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.EACCES):
                raise EnvironmentProblem(
                    f"{root}: cannot be locked ({error.strerror}), expected a file system with flock (Lustre: mounted with "
                    "`flock`); choose another folder with --out"
                ) from error
            if time.monotonic() >= deadline:
                found = holder(root) or "another process"
                raise LockedError(f"{root}: in use by {found}; wait for it to end, or stop it, and run again") from error
        time.sleep(0.1)


def holder(root: Path) -> str | None:
    """Who works on the dataset now, as it said itself; None if nobody does. Those on other machines are believed."""
    try:
        lines = read_plain(root / LOCK).decode(errors="replace").splitlines()
    except (OSError, ValueError):
        return None
    here = f" on {socket.gethostname()} ("
    working = [line for line in lines if here not in line or Path("/proc", line.split()[1]).exists()]
    return f"{working[0]} and {len(working) - 1} more" if len(working) > 1 else next(iter(working), None)


# What others may have put there ------------------------------------------------------------------------------


def is_inside(root: Path, path: Path) -> bool:
    """Whether a path leads, through all links, to something in the folder `root`."""
    return path.resolve().is_relative_to(root.resolve())


def refuse_links(paths: Iterable[Path]) -> None:
    """Raises a FormatError if one of these is something else than a file or a folder; those that aren't there are fine."""
    for path in paths:
        with suppress(FileNotFoundError):
            mode = path.lstat().st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise FormatError(
                    f"{path}: a {'link' if stat.S_ISLNK(mode) else 'pipe or device'}, expected files and folders of a dataset "
                    "or run alone; put what it leads to there"
                )


def read_plain(path: Path, limit: int = MAX_JSON) -> bytes:
    """A file's bytes.

    Raises:
        ValueError: larger than `limit`, or no file of bytes at all: a pipe would be waited for, a link leads elsewhere.
        OSError: if it cannot be read.
    """
    about = path.lstat()
    if not stat.S_ISREG(about.st_mode):
        raise ValueError("no plain file")
    if about.st_size > limit:
        raise ValueError(f"{about.st_size} bytes, expected at most {limit}")
    return path.read_bytes()


def read_json(path: Path, limit: int = MAX_JSON) -> Any:
    """What a JSON file holds; raises as `read_plain`, and a ValueError if it is not JSON or nested without end."""
    return parse_json(read_plain(path, limit))


def parse_json(text: bytes | str) -> Any:
    """What JSON says; a ValueError if it is none, says NaN or is nested without end."""
    try:
        return json.loads(text, parse_constant=_refuse_constant)
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
