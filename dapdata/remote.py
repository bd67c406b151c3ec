"""Datasets in object stores: worked on in a copy on this machine, whose every durable step is repeated in the store.

A working copy is a temporary folder laid out like the dataset: its single files, and of each unit the root zarr.json
alone, which is enough to know what is there. A unit's arrays come when they are needed and go with the copy. The copy's
`durable.Mirror` repeats each step in the store in the same order:

- a unit: its files first, its root last and only if there is none (If-None-Match), so that a root means a whole unit;
- the manifest: only if it is still the one that this command found (If-Match). Where files with fixed names are to
  change, a note takes its place first, on the same condition: of two publishers, one fails there, before it has
  changed anything;
- what is removed: a unit's root first.

A store has no lock that dies with its holder. Where `durable.lock` locks a folder, a command here takes a lease: an
object that names its holder and its end, made and renewed by conditional writes. It spares double work and keeps `gc`
from units that a running command is about to name. What is published is safe without it: that rests on the conditional
writes alone, and on nobody's clock.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import fields, is_dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

from dapdata import durable, manifest, store
from dapdata.buckets import Conflict, Folder, is_inside, is_url
from dapdata.errors import CorruptionError, DapdataError, EnvironmentProblem, LockedError, UsageError
from dapdata.manifest import MANIFEST

LEASE = ".lease"
LEASE_SECONDS = 60.0  # after which a lease that was not renewed may be taken over
NOTE = b'{"unpublished": '  # a manifest that begins so is none: a command is publishing, or was killed while it did
SCRATCH = "dapdata-copy-"
ALIVE = "alive"  # file in a scratch folder that its process holds locked
SETTLED = 60.0  # s: a scratch folder this old has its lock, if its process lives
UNIT_ROOT = "zarr.json"
TABLES = (MANIFEST, manifest.INDEX)
SINGLE = (*TABLES, manifest.UNITS, manifest.CARD, manifest.CROISSANT, manifest.PROGRESS, manifest.LOG)
WITH_FILES = (manifest.PREVIEWS, "quarantine")
WITH_UNITS = ("stages", "shards")  # and a folder between them and each unit
LOOKS = 5  # at a dataset that is published anew while it is read
PAUSE = 0.5  # s between them

Place = str | Path  # a folder of this machine, or the URL of one in a store
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def locate(place: Place) -> Place:
    """What a user names as a dataset: a URL as text, a folder of this machine as a Path.

    Raises:
        UsageError: for a URL that was made a Path of, which loses a slash.
    """
    if is_url(place):
        return str(place).rstrip("/")
    path = Path(str(place).removeprefix("file://"))
    if path.parts and path.parts[0].endswith(":") and isinstance(place, Path):
        raise UsageError(f"{place}: a URL as a Path, expected it as text, such as 's3://bucket/folder'")
    return path


@contextmanager
def working_copy(
    place: Place, *, files: Sequence[str] | None = None, units: bool = False, leftovers: bool = False
) -> Iterator[Path]:
    """The dataset as a folder of this machine: the folder itself, or a working copy of one in a store.

    Args:
        place: The dataset's folder or URL.
        files: Single files to bring; all by default.
        units: Whether to bring the records of its units.
        leftovers: Whether to bring the names of units that were not uploaded to their end.

    Raises:
        EnvironmentProblem: if the store cannot be reached, or refuses.
    """
    if not is_url(place):
        yield Path(locate(place))
        return
    folder = Folder(str(place))
    with ExitStack() as stack:
        root = stack.enter_context(_scratch())
        stack.enter_context(_named(root, folder.url))
        copy = Copy(folder, root, leftovers)
        copy.pull_files(files)
        if units:
            copy.pull_units()
        durable.mirrors[root] = copy
        try:
            yield root
        finally:
            del durable.mirrors[root]


def on_copy(
    *, files: Sequence[str] | None = None, units: bool = False, leftovers: bool = False
) -> Callable[[Callable[Concatenate[Path, Arguments], Result]], Callable[Concatenate[Place, Arguments], Result]]:
    """Decorates a function of a dataset's folder so that it takes a URL as well; arguments as for `working_copy`."""

    def decorate(call: Callable[Concatenate[Path, Arguments], Result]) -> Callable[Concatenate[Place, Arguments], Result]:
        @wraps(call)
        def on_any(root: Place, /, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
            with working_copy(root, files=files, units=units, leftovers=leftovers) as path:
                result = call(path, *args, **kwargs)
                return _renamed(result, str(path), str(root).rstrip("/")) if is_url(root) else result

        return on_any

    return decorate


def pull(root: Path, units: Iterable[str]) -> None:
    """Brings the records of some units into a working copy, as far as they are there."""
    if copy := _copy(root):
        copy.pull_records(units)


def refresh(root: Path) -> None:
    """Brings the records of units that others have committed meanwhile into a working copy."""
    if copy := _copy(root):
        copy.pull_units()


def fill(folder: Path) -> None:
    """Brings the arrays of a unit into a working copy."""
    if copy := _copy(folder):
        copy.fill(folder)


@contextmanager
def filled(folder: Path) -> Iterator[None]:
    """A unit of a working copy with every file that the store has below its name, for a while."""
    copy = _copy(folder)
    if copy:
        copy.fill(folder, listed=True)
    yield
    if copy:
        shutil.rmtree(folder, ignore_errors=True)


def size(folder: Path) -> int | None:
    """Bytes that the store holds below a folder of a working copy; None if it isn't one."""
    copy = _copy(folder)
    return sum(copy.folder.sizes(copy.name(folder)).values()) if copy else None


def holder(root: Path) -> str | None:
    """Who works on the dataset now, as it said itself; None if nobody does."""
    copy = _copy(root)
    return next((who for who, _ in _holders(copy.folder)), None) if copy else durable.holder(root)


def scratch_of(root: Path) -> Path:
    """Where the disk space of a dataset is used: its folder, or that of its working copy."""
    return Path(tempfile.gettempdir()) if _copy(root) else root


@contextmanager
def unit(place: Place, path: str, arrays: Sequence[str] | None = None) -> Iterator[Path]:
    """The folder of a unit on this machine, with the files of some arrays (all by default) and of what they need."""
    if not is_url(place):
        yield Path(place) / path
        return
    folder = Folder(str(place))
    with _scratch() as root, _named(root, folder.url):
        folder.download([f"{path}/{UNIT_ROOT}"], root)
        if store.is_committed(root / path):
            names = store.files_of(store.read_record(root / path), arrays)
            folder.download((f"{path}/{name}" for name in names), root)
        yield root / path


class Kept:
    """Manifest and tables of a dataset, on this machine for as long as this object lives: columns are read from them."""

    def __init__(self, place: Place) -> None:
        self.url = str(place)
        stack = ExitStack()
        self.root = stack.enter_context(working_copy(place, files=TABLES))
        self._end = weakref.finalize(self, stack.close)

    @contextmanager
    def named(self) -> Iterator[None]:
        """Errors speak of the dataset by its own name."""
        with _named(self.root, self.url):
            yield

    def __getstate__(self) -> dict[str, Any]:
        """Worker processes look where their parent keeps them."""
        return {"url": self.url, "root": self.root}


# The copy --------------------------------------------------------------------------------------------------


class Copy:
    """A working copy and where it came from; the Mirror of what is made durable in it."""

    def __init__(self, folder: Folder, root: Path, leftovers: bool) -> None:
        self.folder, self.root, self.leftovers = folder, root, leftovers
        self.lease: Lease | None = None
        self.tag: str | None = None  # of the manifest as the holder of the lease knows it

    def name(self, path: Path) -> str:
        """The name in the store."""
        return path.relative_to(self.root).as_posix()

    # What is here

    def pull_files(self, names: Sequence[str] | None) -> None:
        """Brings single files, all of one publication; where a name is nothing of ours, only the name."""
        for look in range(LOOKS):
            self._pull_manifest(names is None or MANIFEST in names)
            wanted = {*(self._single_files() if names is None else names)} - {MANIFEST}
            wanted |= {manifest.UNITS} & self._manifest().get("files", {}).keys()  # where its units are listed
            self.folder.download(sorted(wanted), self.root)
            if not self._is_torn():
                break
            time.sleep(PAUSE if look + 1 < LOOKS else 0)

    def _pull_manifest(self, wanted: bool) -> None:
        (self.root / MANIFEST).unlink(missing_ok=True)
        if not wanted:
            return
        data: bytes | None
        if self.lease is None:
            data = self.folder.read(MANIFEST)
        else:
            data, self.tag = self.folder.read_tagged(MANIFEST) or (None, None)
        if data is not None and not data.startswith(NOTE):
            (self.root / MANIFEST).write_bytes(data)
        else:
            self.folder.download([manifest.PROGRESS], self.root)  # tells why there is none

    def _single_files(self) -> list[str]:
        """Names of the single files that are there."""
        if not self.folder.has_listing:
            return [manifest.INDEX, manifest.CARD, *self._manifest().get("files", {})]
        names = []
        for name, is_folder in self.folder.children().items():
            if is_folder:
                _place(self.root, name, is_folder)
            elif name in SINGLE:
                names.append(name)
            elif not name.startswith(LEASE):
                _place(self.root, name, is_folder)
        for name in WITH_FILES:
            if (self.root / name).is_dir():
                names += [f"{name}/{child}" for child in self.folder.children(name)]
        return names

    def _is_torn(self) -> bool:
        """Whether a file is not the one that the manifest names: then both are read again, before that is called damage."""
        named = self._manifest().get("files", {})
        paths = [(self.root / str(name), digest) for name, digest in named.items() if is_inside(str(name))]
        return any(path.is_file() and durable.hash_file(path) != digest for path, digest in paths)

    def _manifest(self) -> dict[str, Any]:
        """The manifest as far as it can be read; who needs it whole uses manifest.read."""
        try:
            found = json.loads((self.root / MANIFEST).read_bytes())
            return found if isinstance(found, dict) and isinstance(found.get("files", {}), dict) else {}
        except (OSError, ValueError, RecursionError):
            return {}

    def pull_units(self) -> None:
        """Brings the records of all units that are not here yet, and takes away those that are gone."""
        if not self.folder.has_listing:
            found = manifest.read(self.root)
            self.pull_records([entry.path for stage in found.stages.values() for entry in stage.units])
            return
        there: set[str] = set()
        for top in WITH_UNITS:
            for group, is_group in self.folder.children(top).items():
                _place(self.root / top, group, is_group)
                children = self.folder.children(f"{top}/{group}") if is_group and is_inside(group) else {}
                for child, is_folder in children.items():
                    if self.leftovers or not is_folder:
                        _place(self.root / top / group, child, is_folder)
                there |= {f"{top}/{group}/{child}" for child, is_folder in children.items() if is_folder}
            for here in self.root.glob(f"{top}/*/*"):
                if here.is_dir() and self.name(here) not in there:
                    shutil.rmtree(here)
        self.pull_records(sorted(there))

    def pull_records(self, units: Iterable[str]) -> None:
        """Brings the records of these units, as far as they are there and not here yet."""
        roots = [f"{unit}/{UNIT_ROOT}" for unit in units]
        self.folder.download([name for name in roots if not (self.root / name).exists()], self.root)

    def fill(self, folder: Path, listed: bool = False) -> None:
        """Brings the files of a unit: those that its record names, or every one that the store lists."""
        unit = self.name(folder)
        self.pull_records([unit])
        names = {f"{unit}/{name}" for name in self._recorded(folder)}
        if listed and self.folder.has_listing:
            names = set(self.folder.sizes(unit))
            for name in names:
                if not is_inside(name):
                    _place(folder, name.removeprefix(f"{unit}/"), is_folder=False)
        self.folder.download(sorted(name for name in names if not (self.root / name).exists()), self.root)

    def _recorded(self, folder: Path) -> list[str]:
        try:
            return store.files_of(store.read_record(folder))
        except CorruptionError:  # said by whoever looks into it
            return []

    # What is made durable here is repeated there: see durable.Mirror

    @contextmanager
    def hold(self, shared: bool, deadline: float) -> Iterator[None]:
        """Takes the lease, and brings what others have made and published until now.

        Raises:
            LockedError: if another command holds it.
        """
        self.lease = Lease(self.folder, shared)
        with self.lease.held(deadline):
            self.pull_files(None)
            self.pull_units()
            log = self.root / manifest.LOG
            before = log.read_bytes() if log.exists() else b""
            try:
                yield
            finally:
                if log.exists() and log.read_bytes() != before:
                    with suppress(EnvironmentProblem):  # it tells only how long things took; of tasks, those of the last
                        self.folder.write(manifest.LOG, log.read_bytes())

    def commit(self, folder: Path) -> bool:
        """Uploads a unit, its root last; False if there is one already, which then takes the place of this."""
        name = self.name(folder)
        top = f"{name}/{UNIT_ROOT}"
        if self.folder.read(top) is None:
            paths = (self.name(path) for path in sorted(folder.rglob("*")) if path.is_file())
            self.folder.upload(self.root, [path for path in paths if path != top])
            with suppress(Conflict):
                self.folder.write_if(top, (folder / UNIT_ROOT).read_bytes(), None)
                return True
        shutil.rmtree(folder)
        self.fill(folder)
        return False

    def replace(self, path: Path) -> None:
        """Uploads a file; the manifest on the condition that nobody else did."""
        if self.name(path) == MANIFEST:
            self._write_manifest(path.read_bytes())
        else:
            self.folder.upload(self.root, [self.name(path)])

    def remove(self, path: Path) -> None:
        """Removes an object, or all of a folder; a note takes the manifest's place, on the same condition."""
        name = self.name(path)
        if name == MANIFEST:
            self._write_manifest(NOTE + json.dumps(durable.this_process()).encode() + b', "at": %d}' % time.time_ns())
        elif path.is_dir():
            names = set(self.folder.sizes(name))
            roots = {each for each in names if each.count("/") == 3 and each.endswith(f"/{UNIT_ROOT}")}
            self.folder.remove(roots)
            self.folder.remove(names - roots)
        elif path.exists():
            self.folder.remove([name])

    def _write_manifest(self, data: bytes) -> None:
        if self.lease:
            self.lease.renew()
        try:
            self.tag = self.folder.write_if(MANIFEST, data, self.tag)
        except Conflict as error:
            raise LockedError(
                f"{self.folder.url}: {MANIFEST} was written by another command meanwhile, expected it as this one found it; "
                "nothing of the other's was changed: run the same command again"
            ) from error


def _place(folder: Path, name: str, is_folder: bool) -> None:
    """Leaves the name of something in the store in the copy; one that would lead out of it, written otherwise."""
    path = folder / (name if is_inside(name) else name.replace(".", "%2E").replace("/", "%2F"))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.mkdir(exist_ok=True) if is_folder else path.touch()


def _copy(path: Path) -> Copy | None:
    found = durable.mirror_of(path)
    return found if isinstance(found, Copy) else None


@contextmanager
def _scratch() -> Iterator[Path]:
    """A temporary folder, removed on the way out; those of processes that were killed are removed on the way in."""
    for left in Path(tempfile.gettempdir()).glob(f"{SCRATCH}*"):
        with suppress(OSError), (left / ALIVE).open() as file:
            if time.time() - os.fstat(file.fileno()).st_mtime > SETTLED:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(left, ignore_errors=True)
    top, process = Path(tempfile.mkdtemp(prefix=SCRATCH)), os.getpid()
    try:
        with (top / ALIVE).open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            (top / "copy").mkdir()
            yield top / "copy"
    finally:
        if process == os.getpid():  # and not a fork of it, such as a DataLoader's worker
            shutil.rmtree(top, ignore_errors=True)


@contextmanager
def _named(root: Path, url: str) -> Iterator[None]:
    """Errors speak of the dataset by its URL, not by the folder that holds its copy for now."""
    try:
        yield
    except DapdataError as error:
        if str(root) not in str(error):
            raise
        raise type(error)(str(error).replace(str(root), url)) from error


def _renamed(value: Any, old: str, new: str) -> Any:
    """A result in which the dataset has its own name."""
    if isinstance(value, str):
        return value.replace(old, new)
    if isinstance(value, dict):
        return {key: _renamed(item, old, new) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(_renamed(item, old, new) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{field.name: _renamed(getattr(value, field.name), old, new) for field in fields(value)})
    return value


# The lease -------------------------------------------------------------------------------------------------


class Lease:
    """The right to write to a dataset: an object with its holder and its end.

    One command has it for itself, under a name that there is once; or several share it, each under a name of its own.
    Both kinds first write theirs and then look for the other: so it may be that neither gets it, but never that both do.
    """

    def __init__(self, folder: Folder, shared: bool) -> None:
        self.folder, self.shared, self.tag, self.lost = folder, shared, "", False
        self.name = f"{LEASE}-{durable.digest([_machine(), os.getpid(), time.time_ns()])[:16]}" if shared else LEASE
        self._turn, self._over = threading.Lock(), threading.Event()

    @contextmanager
    def held(self, deadline: float) -> Iterator[None]:
        """Holds it, renewed now and then; waits for it until a time of the monotonic clock."""
        while True:
            try:
                self.take()
                break
            except LockedError:
                if time.monotonic() >= deadline:
                    raise
            time.sleep(PAUSE)
        threading.Thread(target=self.keep, daemon=True).start()
        try:
            yield
        finally:
            self.give_back()

    def take(self) -> None:
        """Makes the object, or takes it over from a holder that is gone.

        Raises:
            LockedError: if there is a holder; the message says which.
            EnvironmentProblem: if the store takes no notice of conditions.
        """
        self.folder.require_writable()
        found = self.folder.read_tagged(self.name)
        _refuse(self.folder, [_alive(found[0])] if found else [])
        try:
            self.tag = self.folder.write_if(self.name, self._claim(), found[1] if found else None)
        except Conflict as error:
            raise LockedError(f"{self.folder.url}: another command began this moment; wait for it to end") from error
        try:
            self._check_conditions()
            _refuse(self.folder, _holders(self.folder, alone=self.shared, sharing=not self.shared))
        except DapdataError:
            self._drop()
            raise

    def _check_conditions(self) -> None:
        """Raises an EnvironmentProblem if the store writes although its condition is not met."""
        for tag in (None, '"0"'):
            with suppress(Conflict):
                self.folder.write_if(self.name, self._claim(), tag)
                raise EnvironmentProblem(
                    f"{self.folder.url}: the store writes whatever the conditions (If-None-Match, If-Match), expected one that "
                    "heeds them; generate into a folder and copy it, manifest.json last"
                )

    def _claim(self) -> bytes:
        """What the object holds; never the same twice."""
        now = time.time()
        about = {"holder": durable.this_process(), "pid": os.getpid(), "machine": _machine(), "until": now + LEASE_SECONDS}
        return json.dumps({**about, "at": time.time_ns()}).encode()

    def renew(self) -> None:
        """Makes it last longer.

        Raises:
            LockedError: if it was taken over.
        """
        with self._turn:
            try:
                self.tag = "" if self.lost else self.folder.write_if(self.name, self._claim(), self.tag)
            except Conflict:
                self.lost = True
        if self.lost:
            raise LockedError(
                f"{self.folder.url}: another command took over, because this one stood still for more than {LEASE_SECONDS:.0f} "
                "s; nothing of the other's was changed: run the same command again when it has ended"
            )

    def keep(self) -> None:
        """Renews it now and then until it is given back; an outage is no loss as long as nobody takes over."""
        while not self._over.wait(LEASE_SECONDS / 4):
            with suppress(LockedError, EnvironmentProblem):
                self.renew()

    def give_back(self) -> None:
        """Removes the object, unless it is another's by now."""
        self._over.set()
        if not self.lost:
            self._drop()

    def _drop(self) -> None:
        with suppress(EnvironmentProblem):  # it ends by itself
            self.folder.remove([self.name])


def _refuse(folder: Folder, holders: Iterable[tuple[str, float] | None]) -> None:
    """Raises a LockedError if there is a holder."""
    for who, left in filter(None, holders):
        raise LockedError(
            f"{folder.url}: in use by {who}; wait for it to end, or stop it, and run again "
            f"(if it died on another machine, its lease ends in {left:.0f} s)"
        )


def _holders(folder: Folder, alone: bool = True, sharing: bool = True) -> Iterator[tuple[str, float]]:
    """Who holds the lease of a dataset alone, and who shares it, with the seconds until it ends."""
    names = [LEASE] if alone else []
    names += [name for name in folder.children() if name.startswith(f"{LEASE}-")] if sharing else []
    yield from filter(None, (_alive(folder.read(name)) for name in names))


def _alive(data: bytes | None) -> tuple[str, float] | None:
    """Who holds a lease, and for how many seconds yet; None if nobody does any more."""
    try:
        found = json.loads(data or b"{}")
        who, left = str(found["holder"]), float(found["until"]) - time.time()
        gone = found["machine"] == _machine() and not Path("/proc", str(int(found["pid"]))).exists()
    except (ValueError, KeyError, TypeError):
        return None
    return None if gone or left < 0 else (who, left)


def _machine() -> str:
    """What tells this machine, since it was started, and this container from others: where a process number means one."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return f"{boot} {os.stat('/proc/self/ns/pid').st_ino}"
