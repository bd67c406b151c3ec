"""What is installed, what the machine offers, and what to do about what is missing. Imports nothing heavy.

Packages are judged by their metadata: version against what dapdata asks for, the wheel's tags against this
interpreter and C library, native libraries by their size. A file system is judged by trying, in a folder that is
removed again, what a dataset relies on. An extra that is absent is a choice and only noted; one of which most is there,
or that was asked for, has to be whole.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from dapdata.durable import existing
from dapdata.errors import UsageError, nearest

if TYPE_CHECKING:
    from packaging.requirements import Requirement

State = Literal["ok", "note", "problem"]
MARKS = {"ok": "ok", "note": "--", "problem": "!!"}
INTERNAL = ("all", "dev", "docs", "interop")  # extras that no command needs by themselves
GIVES = {
    "sim": "generate, label, run, eval, judge, show",
    "train": "train, eval, predict, run; .torch() and .stream() of a dataset",
    "viz": "show --rerun",
    "ray": "--engine ray",
    "s3": "datasets in object stores",
}
WORKER_MB = 600  # of a worker with the largest shards that are advised, see docs/scale.md
FREE_GB = 2.0  # the quickstart writes a quarter of it
FREE_INODES = 100_000
SHM_MB = 256  # PyTorch's worker processes hand over tensors there; containers often give them 64 MB


@dataclass(frozen=True)
class Check:
    """One thing that was looked at."""

    name: str
    state: State
    found: str
    expected: str = ""
    remedy: str = ""  # what to do, a command where there is one

    def __str__(self) -> str:
        wanted = f", expected {self.expected}" if self.expected and self.state != "ok" else ""
        remedy = f"; {self.remedy}" if self.remedy else ""
        return f"{MARKS[self.state]}  {self.name + ':':<22} {self.found}{wanted}{remedy}"


@dataclass(frozen=True)
class Diagnosis:
    """All that was looked at."""

    checks: tuple[Check, ...]

    @property
    def ok(self) -> bool:
        """Whether nothing that is needed is missing."""
        return not self.problems

    @property
    def problems(self) -> tuple[Check, ...]:
        """What keeps commands from running."""
        return tuple(check for check in self.checks if check.state == "problem")

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return {"ok": self.ok, "checks": [asdict(check) for check in self.checks]}

    def __str__(self) -> str:
        count = len(self.problems)
        summary = "nothing that is needed is missing" if self.ok else f"{count} problem{'s' if count > 1 else ''}, marked !!"
        return "\n".join([*map(str, self.checks), "", summary])


def examine(out: str | Path = "data", extras: Sequence[str] = ()) -> Diagnosis:
    """Looks at the interpreter, the packages, the processor, the memory, and the disk under the output folder.

    Args:
        out: Where datasets are to be written; it need not be there.
        extras: Those that must be installed, such as "sim".

    Raises:
        UsageError: for an extra that dapdata does not have.
    """
    wanted = requirements()
    known = [extra for extra in wanted if extra and extra not in INTERNAL]
    for extra in extras:
        if extra not in known:
            raise UsageError(f"--extra {extra}: unknown extra, expected one of {', '.join(known)}; {nearest(extra, known)}")
    parts = (_interpreter(), _packages(wanted, known, extras), _machine(), _gpu(), _disk(Path(out)))
    return Diagnosis(tuple(check for part in parts for check in part))


# Interpreter and packages ----------------------------------------------------------------------------------


def requirements() -> dict[str, list[Requirement]]:
    """What dapdata asks for, by extra; "" holds what every install has."""
    from packaging.requirements import Requirement

    source = Path(__file__).resolve().parents[1] / "pyproject.toml"
    if source.is_file():  # the source tree knows better than what was installed from it once
        import tomllib

        project = tomllib.loads(source.read_text(encoding="utf-8"))["project"]
        lines = {"": project["dependencies"], **project["optional-dependencies"]}
        return {extra: [Requirement(line) for line in some] for extra, some in lines.items()}
    about = distribution("dapdata")
    found = [Requirement(line) for line in about.requires or ()]
    by_extra: dict[str, list[Requirement]] = {"": [r for r in found if "extra ==" not in str(r.marker or "")]}
    for extra in about.metadata.get_all("Provides-Extra") or ():
        mine = [r for r in found if r.marker and f'extra == "{extra}"' in str(r.marker)]
        by_extra[extra] = mine
    return by_extra


def _interpreter() -> Iterator[Check]:
    version, libc = platform.python_version(), " ".join(platform.libc_ver()).strip() or "unknown C library"
    found = f"{version} ({sys.executable}), {platform.system()} {platform.machine()}, {libc}"
    if sys.platform != "linux":
        yield Check("Python", "problem", found, "Linux", "use Linux, a container or WSL")
    elif sys.version_info >= (3, 12):
        remedy = "install Python 3.11 to generate or judge; reading and training work here"
        yield Check("Python", "note", found, "3.11 for the simulator: PyBullet has no wheels for later ones", remedy)
    else:
        yield Check("Python", "ok", found)


def _packages(wanted: Mapping[str, Sequence[Requirement]], known: Sequence[str], asked: Sequence[str]) -> Iterator[Check]:
    """A line for what every install has and one for each extra; or one for each of its packages that is not as it should be."""
    from packaging.tags import sys_tags

    supported = {str(tag) for tag in sys_tags()}
    for extra in ("", *known):
        name, install = (f"extra {extra}", f"dapdata[{extra}]") if extra else ("packages", "dapdata")
        mine = [r for r in wanted[extra] if r.marker is None or r.marker.evaluate({"extra": extra})]
        others = {r.name for other, some in wanted.items() if other not in (extra, *INTERNAL) for r in some}
        there = {r.name: _distribution(r.name) for r in mine}
        own = [r.name for r in mine if r.name not in others]
        chosen = not extra or extra in asked or 2 * sum(there[name] is not None for name in own) > len(own)
        gives = f" (for {GIVES[extra]})" if extra in GIVES else ""
        if not chosen:
            yield Check(name, "note", f"not installed{gives}", remedy=f"if you need it, run: pip install '{install}'")
            continue
        faults = [fault for r in mine if (fault := _fault(r, there[r.name], supported, install))]
        if not faults:
            yield Check(name, "ok", ", ".join(f"{name} {about.version}" for name, about in there.items() if about))
        yield from (replace(fault, name=f"{extra}: {fault.name}" if extra else fault.name) for fault in faults)


def _distribution(name: str) -> Distribution | None:
    try:
        return distribution(name)
    except PackageNotFoundError:
        return None


def _fault(wanted: Requirement, found: Distribution | None, supported: set[str], install: str) -> Check | None:
    """What is wrong with an installed package, if anything is."""
    if found is None:
        return Check(wanted.name, "problem", "not installed", str(wanted.specifier), f"run: pip install '{install}'")
    again = f"run: pip install --force-reinstall '{wanted.name}{wanted.specifier}'"
    if not wanted.specifier.contains(found.version, prereleases=True):
        return Check(wanted.name, "problem", found.version, str(wanted.specifier), f"run: pip install -U '{install}'")
    tags = [line[5:] for line in (found.read_text("WHEEL") or "").splitlines() if line.startswith("Tag: ")]
    if tags and not any(tag in supported for tag in tags):
        libc = " ".join(platform.libc_ver())
        expected = f"a wheel for Python {platform.python_version()}, {platform.machine()}, {libc}"
        return Check(wanted.name, "problem", f"a wheel for {tags[0]}", expected, again)
    damaged = next(_damaged_libraries(found), None)
    return Check(wanted.name, "problem", f"{damaged}: missing or cut", "as installed", again) if damaged else None


def _damaged_libraries(found: Distribution) -> Iterator[str]:
    """Native libraries of a package that are gone, or not as large as they were."""
    for file in found.files or ():
        if ".so" in file.name and file.size is not None:
            path = Path(str(file.locate()))
            if not path.is_file() or path.stat().st_size != file.size:
                yield str(file)


# The machine -----------------------------------------------------------------------------------------------


def _machine() -> Iterator[Check]:
    cores = len(os.sched_getaffinity(0))
    quota = _words("/sys/fs/cgroup/cpu.max")[:2]
    limit = (
        f", limited to {int(quota[0]) / int(quota[1]):.1f} by the container" if len(quota) == 2 and quota[0] != "max" else ""
    )
    info = dict(line.split(":", 1) for line in _lines("/proc/cpuinfo") if ":" in line)
    values = {name.strip(): value.strip() for name, value in info.items()}
    flags = values.get("flags", "").split()
    simd = ", ".join(flag for flag in ("sse4_2", "avx2", "fma", "avx512f") if flag in flags) or "unknown"
    yield Check("processor", "ok", f"{values.get('model name', platform.machine())}, {cores} cores{limit}, SIMD {simd}")

    free = {line.split(":")[0]: int(line.split()[1]) / 1024 for line in _lines("/proc/meminfo") if line.endswith("kB")}
    available = free.get("MemAvailable", 0.0)
    most = _words("/sys/fs/cgroup/memory.max")
    if most and most[0] != "max":
        used = int((_words("/sys/fs/cgroup/memory.current") or ["0"])[0])
        available = min(available, (int(most[0]) - used) / 2**20)
    enough = int(available // WORKER_MB)
    found = f"{available / 1024:.1f} GB available, enough for {enough} workers"
    remedy = f"close programs, or use: --workers {max(enough, 1)}"
    state: State = "ok" if enough >= cores else "note" if enough >= 1 else "problem"
    yield Check("memory", state, found, f"{WORKER_MB} MB a worker, {cores} by default", "" if state == "ok" else remedy)

    if Path("/dev/shm").is_dir():
        size = shutil.disk_usage("/dev/shm").free / 2**20
        low = size < SHM_MB
        remedy = "give the container more (docker run --shm-size=1g), or use num_workers=0" if low else ""
        yield Check("/dev/shm", "note" if low else "ok", f"{size:.0f} MB free", f"{SHM_MB} MB for PyTorch's workers", remedy)
    if _distribution("open3d"):
        yield _libusb()


def _libusb() -> Check:
    """open3d's wheel asks for libusb-1.0, which bare machines lack; the package libusb-package brings it along."""
    if _distribution("libusb-package"):
        return Check("libusb for open3d", "ok", "from libusb-package")
    with suppress(OSError):
        ctypes.CDLL("libusb-1.0.so.0")
        return Check("libusb for open3d", "ok", "from the system")
    return Check("libusb for open3d", "problem", "none", "libusb-1.0.so.0", "run: pip install libusb-package")


def _gpu() -> Iterator[Check]:
    torch = _distribution("torch")
    built = _cuda_of(torch) if torch else None
    build = "" if torch is None else f"; torch is built for {f'CUDA {built}' if built else 'the CPU'}"
    tool = shutil.which("nvidia-smi")
    if tool is None:
        yield Check("GPU", "ok", f"none that nvidia-smi knows (none is needed){build}")
        return
    query = [tool, "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(query, capture_output=True, text=True, timeout=2, check=False)
        cards, failed = done.stdout.strip().splitlines(), done.returncode != 0
    except (OSError, subprocess.TimeoutExpired):
        cards, failed = [], True
    if failed or not cards:
        yield Check(
            "GPU", "note", f"nvidia-smi does not answer{build}", "a list of cards", "mend the driver, or use: --device cpu"
        )
    elif torch is not None and built is None:
        remedy = "install PyTorch with CUDA to train on it"
        yield Check("GPU", "note", f"{'; '.join(cards)}{build}", "a torch that uses it", remedy)
    else:
        yield Check("GPU", "ok", f"{'; '.join(cards)}{build}")


def _cuda_of(torch: Distribution) -> str | None:
    """The CUDA version that torch was built for, from its text: importing it takes seconds."""
    path = Path(str(torch.locate_file("torch/version.py")))
    lines = _lines(str(path))
    values = (line.split("=", 1)[1].strip().strip("'\"") for line in lines if line.startswith("cuda") and "=" in line)
    return next((value for value in values if value != "None"), None)


# The disk --------------------------------------------------------------------------------------------------


def _disk(out: Path) -> Iterator[Check]:
    """The file system under a folder: room, and whether it does what datasets rely on."""
    place = existing(out)
    about, kind = os.statvfs(place), _file_system(place)
    free = about.f_bavail * about.f_frsize / 1e9
    low = free < FREE_GB
    remedy = "make room, or choose another disk with --out" if low else ""
    where = f"{place} ({kind})"
    yield Check("disk", "problem" if low else "ok", f"{where}, {free:.1f} GB free", f"{FREE_GB:.0f} GB", remedy)
    if about.f_files:  # some file systems count none
        few = about.f_favail < FREE_INODES
        remedy = "delete small files, use larger shards (shard_size), or choose another disk with --out" if few else ""
        yield Check("inodes", "problem" if few else "ok", f"{about.f_favail} free", f"{FREE_INODES}", remedy)
    try:
        with tempfile.TemporaryDirectory(prefix=".dapdata-doctor-", dir=place) as folder:
            yield from _tries(Path(folder))
    except OSError as error:
        remedy = "mend its permissions, or choose another folder with --out"
        yield Check("writing", "problem", f"{place}: {error.strerror}", "a folder that can be written", remedy)


def _file_system(place: Path) -> str:
    """ "ext4", "nfs4", "overlay": of the mount that holds a path."""
    found, longest = "unknown file system", -1
    for line in _lines("/proc/self/mountinfo"):
        left, _, right = line.partition(" - ")
        mount = Path(left.split()[4].replace("\\040", " "))
        if place.resolve().is_relative_to(mount) and len(str(mount)) >= longest:
            found, longest = right.split()[0], len(str(mount))
    return found


def _tries(folder: Path) -> Iterator[Check]:
    """What is tried in a folder of its own: each promise of durable.py that the file system has to keep."""
    elsewhere = "choose a local disk with --out, and copy the dataset when it is done"
    tries: tuple[tuple[str, Callable[[Path], str], State, str, str], ...] = (
        ("rename", _try_rename, "problem", "that a folder is moved at once, and never onto another", elsewhere),
        ("fsync", _try_fsync, "problem", "that files and folders can be synced", elsewhere),
        ("lock", _try_lock, "problem", "that a second lock on a file is refused", elsewhere),
        ("hard links", _try_link, "note", "links, so that shards share files with cached stages", "nothing: files are copied"),
    )
    for name, attempt, otherwise, expected, remedy in tries:
        try:
            yield Check(name, "ok", attempt(folder), expected)
        except OSError as error:
            yield Check(name, otherwise, error.strerror or str(error), expected, remedy)


def _try_rename(folder: Path) -> str:
    for name in ("a", "b"):
        (folder / name).mkdir()
        (folder / name / "file").write_text(name)
    (folder / "a").rename(folder / "c")
    try:
        (folder / "b").rename(folder / "c")
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST) and (folder / "c/file").read_text() == "a":
            return "works"
        raise
    raise OSError(errno.EINVAL, "a folder was moved onto another that is not empty")


def _try_fsync(folder: Path) -> str:
    path, start = folder / "synced", time.perf_counter()
    path.write_bytes(bytes(4096))
    for target in (path, folder):
        handle = os.open(target, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    return f"works, {1e3 * (time.perf_counter() - start):.1f} ms for a file and its folder"


def _try_lock(folder: Path) -> str:
    with (folder / "lock").open("w") as first, (folder / "lock").open("w") as second:
        fcntl.flock(first, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with suppress(BlockingIOError):
            fcntl.flock(second, fcntl.LOCK_EX | fcntl.LOCK_NB)
            raise OSError(errno.ENOLCK, "two locks on one file at the same time")
    return "works"


def _try_link(folder: Path) -> str:
    (folder / "one").write_text("x")
    os.link(folder / "one", folder / "two")
    if (folder / "two").stat().st_nlink != 2:
        raise OSError(errno.EMLINK, "a link that is a copy")
    return "work"


def _lines(path: str) -> list[str]:
    """The lines of a file of the system; none where there is no such file."""
    try:
        return Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []


def _words(path: str) -> list[str]:
    return " ".join(_lines(path)).split()
