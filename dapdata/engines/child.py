"""One job in a process of its own, watched from outside: what every engine does with a job, on whatever machine.

A child does one job after another, told to it through a socket that nobody else holds, so that whatever happens to it
(a signal, a hang, a closed socket) is known to be this job's doing. It has a time and a memory that it may take; both
are looked at from outside, because code that hangs or eats may never let Python run again.

Memory is what the kernel says of the process (resident and swapped), some ten times a second. Limits that the kernel
enforces are worse: RLIMIT_AS counts what is merely reserved (three times the true use with numba and PyBullet loaded),
and under RLIMIT_DATA a library that does not look at what malloc returns ends with a segmentation fault, which is no
reason that a user understands. For what grows faster than that, or in a process that the job forked, the child offers
itself to the kernel as the first to be killed when the machine runs out.

A child is the head of a process group, and ends with its parent, however that ended. A guard that it forks ends what
is left of the group after it: processes that the job itself forked. They escape only by leaving the group on purpose.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path

from dapdata.engines import Job, function

TICK = 0.1  # s between two looks at a child
GRACE = 5.0  # s in which a killed process is gone, unless the kernel itself hangs
MAX_JOBS = 50  # after which a child is replaced, in case something leaks
TAIL = 2000  # bytes of what a failed job printed that are kept
SHARE = 0.8  # of the machine's memory that all children together may take
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from dapdata.engines.child import serve; serve(int(sys.argv[2]), int(sys.argv[3]))"
)
MUTE = os.EX_IOERR  # exit code of a child that cannot send its answer
PR_SET_PDEATHSIG = 1  # of <linux/prctl.h>


@dataclass(frozen=True)
class Outcome:
    """What came of one try of a job: its answer, or a reason and the end of what it printed."""

    answer: str | None
    reason: str = ""
    stderr: str = ""


class Child:
    """A process that does one job at a time. After a job that failed it has ended."""

    def __init__(self) -> None:
        self.connection, its = Pipe()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 (open for as long as the child)
        command = [sys.executable, "-u", "-c", START, json.dumps(sys.path), str(its.fileno()), str(os.getpid())]
        self._process = subprocess.Popen(
            command,
            env=os.environ | ONE_THREAD,
            stdin=subprocess.DEVNULL,
            stdout=self._log,
            stderr=self._log,
            pass_fds=[its.fileno()],
            process_group=0,
        )
        its.close()
        self._jobs = 0

    def begin(self, call: str, job: Job, memory: float) -> None:
        """Hands a job over. `memory` is what the process may take, bytes."""
        self._job, self._memory, self._deadline = job, memory, time.monotonic() + job.timeout
        self._jobs += 1
        self._log.seek(0)  # the child writes at the same place: it is the same open file
        self._log.truncate()
        with suppress(OSError):  # a child that is gone: `outcome` says so
            self.connection.send_bytes(json.dumps([call, job.text]).encode())

    def outcome(self) -> Outcome | None:
        """What came of the job; None while it is under way."""
        answer, reason = self._look()
        if answer is not None:
            return Outcome(answer)
        if not reason:
            return None
        size = os.fstat(self._log.fileno()).st_size
        printed = os.pread(self._log.fileno(), TAIL, max(0, size - TAIL)).decode(errors="replace")
        self.end()
        return Outcome(None, reason, printed.strip())

    def _look(self) -> tuple[str | None, str]:
        """The answer, or why there will be none; neither while there is hope."""
        if self.connection.poll():
            try:
                told = json.loads(self.connection.recv_bytes())
            except (OSError, EOFError, ValueError):
                return None, self._death()
            return told.get("answer"), told.get("raised", "")
        if self._process.poll() is not None:  # looked at too: a process that the job forked may hold the socket open
            return None, self._death()
        if time.monotonic() > self._deadline:
            return None, f"no answer in {self._job.timeout:.0f} s"
        used = memory_of(self._process.pid)
        if used > self._memory:
            return None, f"took {used / 1e9:.1f} GB of memory, expected at most {self._memory / 1e9:.1f} GB for each worker"
        return None, ""

    def _death(self) -> str:
        """How the process ended, once its socket is closed."""
        try:
            code = self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            code = MUTE
        if code == MUTE:
            return "closed the socket that its answer was to come through"
        if code >= 0:
            return f"exited with code {code}"
        with suppress(ValueError):
            by = " (by hand, or by the kernel when memory ran out)" if -code == signal.SIGKILL else ""
            return f"killed by {signal.Signals(-code).name}{by}"
        return f"killed by signal {-code}"

    @property
    def is_fit(self) -> bool:
        """Whether it may be given another job."""
        return self._jobs < MAX_JOBS and not self.connection.closed and self._process.poll() is None

    def end(self) -> None:
        """Ends the process and whatever it forked. Once is enough, and more does no harm."""
        if self.connection.closed:
            return
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE)
        self.connection.close()
        self._log.close()


def attempt(child: Child, call: str, job: Job, memory: float) -> Outcome:
    """Does one job and waits for it."""
    child.begin(call, job, memory)
    while (outcome := child.outcome()) is None:
        wait([child.connection], TICK)
    return outcome


# Memory ----------------------------------------------------------------------------------------------------


def memory_of(pid: int) -> float:
    """Bytes that a process has in memory and in swap; 0 if it is gone."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0.0
    kilobytes = (line.split()[1] for line in status.splitlines() if line.startswith(("VmRSS:", "VmSwap:")))
    return 1024.0 * sum(map(int, kilobytes))


def share(workers: int) -> float:
    """Bytes that each of so many workers may take: an equal part of most of what there is here."""
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return SHARE * min([float(machine), *_limits_of_cgroups()]) / workers


def _limits_of_cgroups() -> Iterator[float]:
    """What containers and schedulers allow: the limits of this process's control groups and of those around them."""
    with suppress(OSError):
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers == "":
                yield from _limits_upwards(Path("/sys/fs/cgroup"), path, "memory.max")
            elif "memory" in controllers.split(","):
                yield from _limits_upwards(Path("/sys/fs/cgroup/memory"), path, "memory.limit_in_bytes")


def _limits_upwards(root: Path, path: str, name: str) -> Iterator[float]:
    for folder in (root / path.strip("/"), *(root / path.strip("/")).parents):
        if folder.is_relative_to(root):
            with suppress(OSError, ValueError):  # not there, or "max"
                yield float((folder / name).read_text())


# In the child ----------------------------------------------------------------------------------------------


def serve(socket: int, parent: int) -> None:
    """Does jobs until the parent closes the socket. What a job prints goes to a log: stdout is the command's."""
    _end_with(parent)
    connection, me = Connection(socket), os.getpid()
    while True:
        try:
            call, text = json.loads(connection.recv_bytes())
        except EOFError:
            return
        try:
            told = {"answer": function(call)(text)}
        except BaseException as error:  # whatever a job raises is its failure and not this process's
            traceback.print_exc()
            told = {"raised": " ".join(f"{type(error).__name__}: {error}".split())[:TAIL]}
        if os.getpid() != me:
            os._exit(0)  # a copy that the job forked and let run on
        try:
            connection.send_bytes(json.dumps(told).encode())
        except OSError:
            os._exit(MUTE)


def _end_with(parent: int) -> None:
    """Ties this process to its parent, and what it forks to itself; offers it to a kernel that needs memory."""
    prctl, me = ctypes.CDLL(None).prctl, os.getpid()
    prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)  # it ended before we could say so
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    if os.fork():
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
        return
    os.setpgid(0, 0)  # the guard: in a group of its own, and holding nothing open
    os.closerange(0, os.sysconf("SC_OPEN_MAX"))
    prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() == me:
        signal.sigwait({signal.SIGTERM})
    with suppress(ProcessLookupError):
        os.killpg(me, signal.SIGKILL)
    os._exit(0)
