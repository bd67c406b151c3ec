"""Where units are worked on. An engine calls one function with one JSON text a job and reports each answer.

An engine is `run(call, jobs, *, workers, on_done) -> list[Failure]`, nothing more. `local` and `ray` do a job alike, in a
child process that child.py starts and watches, on this machine or in a task on a node of the cluster: so a job that
dies, hangs, or eats memory costs itself alone and is given up with the same words everywhere. Also a single worker is a
process of its own: a simulator that crashes must not take the command along. `inline` works in this process, for
debugging and for tests.

Why no pool of somebody else's: the standard library's loses all that is under way when one worker dies. pebble's does
not, but it shares one pipe among its workers, so it takes a worker that leaves with exit code 0 for one that is still at
work (three time limits lost), waits for processes that a job forked, and does not say which process does which job, so
nobody can watch its memory.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Protocol

from dapdata import errors
from dapdata.errors import DapdataError, UsageError, hint

if TYPE_CHECKING:
    from dapdata.engines.child import Outcome

RETRIES = 2  # after which a job is given up
CLIENT = "ray://"  # of an address that Ray Client reaches


@dataclass(frozen=True)
class Job:
    """One call: `text` is handed over as it is."""

    text: str
    timeout: float  # s, from when it starts
    memory: float | None = None  # bytes that its process may take; None: an equal part of most of what there is


@dataclass(frozen=True)
class Failure:
    """A job that was given up."""

    job: Job
    reason: str  # "killed by SIGSEGV", "no answer in 600 s", "ValueError: ..."
    stderr: str  # the end of what it printed


OnDone = Callable[[Job, str], None]


class Engine(Protocol):
    """Runs jobs somewhere."""

    def run(self, call: str, jobs: Sequence[Job], *, workers: int | None, on_done: OnDone) -> list[Failure]:
        """Calls a function for each job; returns those that were given up after `RETRIES` retries.

        Args:
            call: "module:function"; the function takes and returns a JSON text. An answer {"error": [class,
                message]} is raised here as that DapdataError, and the other jobs are stopped.
            jobs: In any order; they don't depend on each other.
            workers: How many jobs are done at the same time; None for as many as there are cores.
            on_done: Called in the caller's thread with each job and its answer.
        """


def get(name: str) -> Engine:
    """The engine of that name.

    Raises:
        UsageError: if there is none; the message names those that there are.
        MissingExtraError: if what it needs is not installed.
    """
    if name == "inline":
        return Inline()
    if name == "local":
        from dapdata.engines.local import Local

        return Local()
    if name == "ray" or re.fullmatch(rf"{CLIENT}[^/\s]+:\d+", name):
        from dapdata.engines.on_ray import OnRay

        return OnRay(name)
    if name.startswith(CLIENT):
        raise UsageError(f"engine: got '{name}', expected the address of a Ray cluster such as {CLIENT}head-node:10001")
    known = ["local", "inline", "ray"]
    raise UsageError(f"engine: got '{name}', expected one of {', '.join(known)}, {CLIENT}HOST:PORT{hint(name, known)}")


def function(call: str) -> Callable[[str], str]:
    """The function that "module:function" names."""
    module, name = call.split(":")
    found: Callable[[str], str] = getattr(import_module(module), name)
    return found


def answer(text: str) -> str:
    """The answer as it is, or the DapdataError that it carries."""
    error = json.loads(text).get("error")
    if error:
        known = getattr(errors, error[0], None)
        kind = known if isinstance(known, type) and issubclass(known, DapdataError) else DapdataError
        raise kind(error[1])
    return text


def settle(
    jobs: Sequence[Job], submit: Callable[[int], object], outcomes: Iterator[tuple[int, Outcome]], on_done: OnDone
) -> list[Failure]:
    """Has each job done, tries again those that fail, and returns those that failed too often.

    Args:
        jobs: What is to be done.
        submit: Puts a job, by its number, where `outcomes` takes them from.
        outcomes: What came of each try; ends when nothing is left. It goes on after what was submitted meanwhile.
        on_done: See Engine.run.
    """
    failures, retries = [], Counter[int]()
    for number in range(len(jobs)):
        submit(number)
    for number, outcome in outcomes:
        if outcome.answer is not None:
            on_done(jobs[number], answer(outcome.answer))
        elif retries[number] < RETRIES:
            retries[number] += 1
            submit(number)
        else:
            failures.append(Failure(jobs[number], outcome.reason, outcome.stderr))
    return failures


class Inline:
    """In this process, one after the other; what goes wrong is raised as it is."""

    def run(self, call: str, jobs: Sequence[Job], *, workers: int | None, on_done: OnDone) -> list[Failure]:
        """See Engine; `workers` is not used, and there are no retries."""
        for job in jobs:
            on_done(job, answer(function(call)(job.text)))
        return []
