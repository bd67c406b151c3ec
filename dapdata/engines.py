"""Where units are worked on. An engine calls one function with one JSON text a job and reports each answer.

An engine is `run(call, jobs, *, workers, on_done) -> list[Failure]`, nothing more; one for a cluster does the same.
`local` uses pebble, because a worker's death there costs its own job and nothing else (the standard library's pool
loses all that are under way). Also a single worker is a process of its own: a simulator that crashes must not take
the command along. `inline` works in this process, for debugging and for tests.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

from dapdata import errors
from dapdata.errors import DapdataError, UsageError, hint, require

RETRIES = 2  # after which a job is given up
RESTARTS = 3  # of a pool that broke without a job being to blame
MAX_TASKS = 50  # jobs after which a worker is replaced, in case something leaks
TAIL = 2000  # characters of a dead worker's stderr that are kept
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class Job:
    """One call: `text` is handed over as it is; `timeout` in seconds counts from when it starts."""

    text: str
    timeout: float


@dataclass(frozen=True)
class Failure:
    """A job that was given up."""

    job: Job
    reason: str  # "killed by SIGSEGV", "no answer in 600 s", "ValueError: ..."
    stderr: str


OnDone = Callable[[Job, str], None]


class Engine(Protocol):
    """Runs jobs somewhere."""

    def run(self, call: str, jobs: Sequence[Job], *, workers: int, on_done: OnDone) -> list[Failure]:
        """Calls a function for each job; returns those that were given up after retries.

        Args:
            call: "module:function"; the function takes and returns a JSON text. An answer {"error": [class,
                message]} is raised here as that DapdataError, and the other jobs are stopped.
            jobs: In any order; they don't depend on each other.
            workers: Number of processes.
            on_done: Called in the caller's thread with each job and its answer.
        """


def get(name: str) -> Engine:
    """The engine of that name.

    Raises:
        UsageError: if there is none; the message names those that there are.
    """
    known: dict[str, type[Engine]] = {"local": Local, "inline": Inline}
    if name not in known:
        raise UsageError(f"engine: got '{name}', expected one of {', '.join(known)}{hint(name, list(known))}")
    return known[name]()


def answer(text: str) -> str:
    """The answer as it is, or the DapdataError that it carries."""
    error = json.loads(text).get("error")
    if error:
        known = getattr(errors, error[0], None)
        kind = known if isinstance(known, type) and issubclass(known, DapdataError) else DapdataError
        raise kind(error[1])
    return text


def function(call: str) -> Callable[[str], str]:
    """The function that "module:function" names."""
    module, name = call.split(":")
    found: Callable[[str], str] = getattr(import_module(module), name)
    return found


class Inline:
    """In this process, one after the other; what goes wrong is raised as it is."""

    def run(self, call: str, jobs: Sequence[Job], *, workers: int, on_done: OnDone) -> list[Failure]:
        """See Engine; `workers` is not used, and there are no retries."""
        for job in jobs:
            on_done(job, answer(function(call)(job.text)))
        return []


class Local:
    """A pool of processes on this machine."""

    def __init__(self) -> None:
        require("pebble", "sim")

    def run(self, call: str, jobs: Sequence[Job], *, workers: int, on_done: OnDone) -> list[Failure]:
        """See Engine."""
        tries = dict.fromkeys(range(len(jobs)), 0)
        failures: list[Failure] = []
        with _children_settings(), tempfile.TemporaryDirectory(prefix="dapdata-") as logs:
            for _ in range(RESTARTS + 1):
                if not tries:
                    break
                _run_pool(call, jobs, tries, failures, min(workers, len(tries)), Path(logs), on_done)
        failures += [Failure(jobs[i], "workers cannot be started", "") for i in tries]
        return failures


def _run_pool(
    call: str,
    jobs: Sequence[Job],
    tries: dict[int, int],
    failures: list[Failure],
    workers: int,
    logs: Path,
    on_done: OnDone,
) -> None:
    """Works until no job is left in `tries` or the pool breaks; takes from `tries` what is done or given up."""
    pebble, spawn = require("pebble", "sim"), multiprocessing.get_context("spawn")
    pool = pebble.ProcessPool(
        max_workers=workers, max_tasks=MAX_TASKS, initializer=_start, initargs=(os.getpid(),), context=spawn
    )

    def submit(index: int) -> None:
        arguments = [call, jobs[index].text, str(logs / str(index))]
        waiting[pool.schedule(_work, args=arguments, timeout=jobs[index].timeout)] = index

    waiting: dict[Any, int] = {}
    try:
        for index in tries:
            submit(index)
        while waiting:
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                index, error = waiting.pop(future), future.exception()
                if error is None:
                    tries.pop(index)
                    on_done(jobs[index], answer(future.result()))
                elif type(error).__name__ == "BrokenProcessPool":
                    return
                elif tries[index] < RETRIES:
                    tries[index] += 1
                    submit(index)
                else:
                    tries.pop(index)
                    failures.append(Failure(jobs[index], _reason(error, jobs[index]), _tail(logs / str(index))))
    finally:
        pool.stop()
        pool.join()


def _reason(error: BaseException, job: Job) -> str:
    if isinstance(error, TimeoutError):
        return f"no answer in {job.timeout:.0f} s"
    code = getattr(error, "exitcode", None)
    if code is None:
        return f"{type(error).__name__}: {error}"
    if code < 0:
        with suppress(ValueError):
            return f"killed by {signal.Signals(-code).name}"
    return f"exited with code {code}"


def _tail(log: Path) -> str:
    return log.read_text(errors="replace")[-TAIL:].strip() if log.exists() else ""


# In the worker ---------------------------------------------------------------------------------------------


def _start(parent: int) -> None:
    """Makes the worker end with its parent, however that ended."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=watch, daemon=True).start()


def _work(call: str, text: str, log: str) -> str:
    """One job, with all that it or a library prints going to its log: stdout is for the command's result alone."""
    sys.stdout.flush()
    with open(log, "ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    return function(call)(text)


@contextmanager
def _children_settings() -> Iterator[None]:
    """One thread a worker, and children that don't run the caller's script again.

    A spawned child imports its parent's __main__, so that a plain script without `if __name__ == "__main__"` would
    start itself over and over. Ours need nothing from it.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    main = sys.modules["__main__"]
    hidden: dict[str, Any] = {name: main.__dict__[name] for name in ("__file__", "__spec__") if name in main.__dict__}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    main.__dict__.pop("__file__", None)
    main.__spec__ = None
    try:
        yield
    finally:
        main.__dict__.update(hidden)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name)
            else:
                os.environ[name] = value
