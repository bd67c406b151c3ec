"""Jobs on a Ray cluster: each is a task of one CPU that starts a child on its node and watches it there.

Ray decides where and when; all that is said of a job comes from the child, as it does locally. A task that Ray itself
loses (its node is gone, somebody killed it) counts as a failed try of its job, and its child ends with it. Ray's own
retries are off: there is one count of tries. The nodes must have the same dapdata installed and see the dataset's
folder under the same path; units.py and pipeline.py check both.
"""

from __future__ import annotations

import logging
import os
import socket
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import astuple
from pathlib import Path
from types import ModuleType
from typing import Any

from dapdata.engines import CLIENT, Failure, Job, OnDone, settle
from dapdata.engines.child import Child, Outcome, attempt, share
from dapdata.errors import EnvironmentProblem, require

POLL = 1.0  # s between two chances for Ctrl-C
LOCAL, RUNNING = "local", "auto"  # what Ray calls a new cluster of this machine, and the one that runs here already
OBJECT_STORE = 100e6  # bytes of a cluster that we start: answers are a few lines
PATIENCE = 10.0  # s in which a cluster answers; Ray itself would try for half a minute, or for ten


class OnRay:
    """Tasks on a cluster: the one at a `ray://` address, or the one of this machine, started if there is none."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._ray = require("ray", "ray")
        if name.startswith(CLIENT):
            require("grpc", "ray")  # which Ray Client needs and Ray does not

    def run(self, call: str, jobs: Sequence[Job], *, workers: int | None, on_done: OnDone) -> list[Failure]:
        """See Engine; without `workers` Ray starts as many tasks as the cluster has room for."""
        queue: deque[int] = deque()
        under_way: dict[Any, int] = {}
        with _connected(self._ray, self._name, workers):
            try:
                return settle(jobs, queue.append, self._outcomes(call, jobs, queue, under_way, workers), on_done)
            except ConnectionError as error:
                raise EnvironmentProblem(
                    f"{self._name}: the cluster is gone ({_lines(error)[0]}), expected it to stay; what it finished is kept: "
                    "start it and run the same command again"
                ) from error
            finally:
                for task in under_way if self._ray.is_initialized() else ():  # else `cancel` would look for a cluster
                    self._ray.cancel(task, force=True)

    def _outcomes(
        self, call: str, jobs: Sequence[Job], queue: deque[int], under_way: dict[Any, int], workers: int | None
    ) -> Iterator[tuple[int, Outcome]]:
        """What came of each job in the queue, as soon as it is known."""
        task = self._ray.remote(num_cpus=1, max_retries=0)(_attempt)
        while queue or under_way:
            while queue and (workers is None or len(under_way) < workers):
                number = queue.popleft()
                try:
                    under_way[task.remote(call, *astuple(jobs[number]))] = number
                except ImportError as error:  # Ray Client, whose head node looks at the function
                    raise self._unfit(error) from error
            done, _ = self._ray.wait(list(under_way), num_returns=1, timeout=POLL)
            for one in done:
                yield under_way.pop(one), self._outcome(one)

    def _outcome(self, task: Any) -> Outcome:
        try:
            return Outcome(*self._ray.get(task))
        except self._ray.exceptions.RayTaskError as error:  # whatever a job does, `_attempt` itself does not fail
            raise self._unfit(error) from error
        except self._ray.exceptions.RayError as error:
            return Outcome(None, f"{type(error).__name__}: {_lines(error)[0]}", str(error))

    def _unfit(self, error: Exception) -> EnvironmentProblem:
        return EnvironmentProblem(
            f"{self._name}: a node cannot work ({_lines(error)[-1]}), expected the same Python and dapdata on each, with the "
            "extra `sim`; install them there"
        )


def _lines(error: BaseException) -> list[str]:
    """What an error says; at least one line."""
    return str(error).strip().splitlines() or [type(error).__name__]


# The cluster -----------------------------------------------------------------------------------------------


@contextmanager
def _connected(ray: ModuleType, name: str, workers: int | None) -> Iterator[None]:
    """Within this, Ray is connected. A connection that the caller had already is used, and left as it is."""
    if ray.is_initialized():
        yield
        return
    address = name if name.startswith(CLIENT) else _running_here()
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    mine = {"num_cpus": workers, "include_dashboard": False, "object_store_memory": OBJECT_STORE} if address == LOCAL else {}
    with _settings_of_ray():
        try:
            if address != LOCAL and address != RUNNING:
                _knock(address)
            ray.init(address, **quiet, **mine)
        except (OSError, RuntimeError, ValueError) as error:
            raise EnvironmentProblem(
                f"{name}: no Ray cluster could be joined or started ({_lines(error)[0]}); expected one of the same Ray and "
                "Python, and its token if it wants one (RAY_AUTH_MODE=token)"
            ) from error
        try:
            yield
        finally:
            ray.shutdown()


@contextmanager
def _settings_of_ray() -> Iterator[None]:
    """Within this, a cluster that is started reports to nobody; after it, what Ray set for its own children is undone."""
    names = ("RAY_USAGE_STATS_ENABLED", "RAY_AUTH_MODE")
    before = {name: os.environ.get(name) for name in names}
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    logging.getLogger("ray").setLevel(logging.ERROR)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value


def _running_here() -> str:
    """The cluster that RAY_ADDRESS names, or the one that `ray start` left a note of if that still runs, or a new one."""
    if named := os.environ.get("RAY_ADDRESS"):
        return named
    note = Path(os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR") or "/tmp") / "ray/ray_current_cluster"
    with suppress(OSError, ValueError):
        _knock(note.read_text().strip())
        return RUNNING
    return LOCAL


def _knock(address: str) -> None:
    """Raises an OSError if nobody listens there."""
    host, _, port = address.removeprefix(CLIENT).rpartition(":")
    socket.create_connection((host.strip("[]"), int(port)), PATIENCE).close()


# In a task -------------------------------------------------------------------------------------------------

_idle: list[Child] = []  # of this worker of Ray, from one task to the next


def _attempt(call: str, text: str, timeout: float, memory: float | None) -> tuple[str | None, str, str]:
    """One try of a job: the fields of its Outcome."""
    child = _idle.pop() if _idle else Child()
    if not child.is_fit:
        child.end()
        child = Child()
    try:
        outcome = attempt(child, call, Job(text, timeout), memory or share(_tasks_on_this_node()))
    except BaseException:
        child.end()
        raise
    _idle.append(child)
    return outcome.answer, outcome.reason, outcome.stderr


def _tasks_on_this_node() -> int:
    """How many tasks of one CPU Ray starts here at the same time."""
    ray = require("ray", "ray")
    here = ray.get_runtime_context().get_node_id()
    return max(1, int(next(node["Resources"].get("CPU", 1) for node in ray.nodes() if node["NodeID"] == here)))
