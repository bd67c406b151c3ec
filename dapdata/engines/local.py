"""Jobs on this machine: a few children that each do one job after another."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterator, Sequence
from multiprocessing.connection import wait

from dapdata.engines import Failure, Job, OnDone, settle
from dapdata.engines.child import TICK, Child, Outcome, share


class Local:
    """Children of this process, one thread each."""

    def run(self, call: str, jobs: Sequence[Job], *, workers: int | None, on_done: OnDone) -> list[Failure]:
        """See Engine."""
        queue: deque[int] = deque()
        children: list[Child] = []
        try:
            count = workers or len(os.sched_getaffinity(0))
            return settle(jobs, queue.append, _outcomes(call, jobs, queue, children, count), on_done)
        finally:
            for child in children:
                child.end()


def _outcomes(
    call: str, jobs: Sequence[Job], queue: deque[int], children: list[Child], workers: int
) -> Iterator[tuple[int, Outcome]]:
    """What came of each job in the queue, as soon as it is known. Children that it starts are kept in `children`."""
    at_work: dict[Child, int] = {}
    memory = share(workers)
    while queue or at_work:
        while queue and len(at_work) < workers:
            number = queue.popleft()
            child = next((child for child in children if child not in at_work), None)
            if child is None:
                child = Child()
                children.append(child)
            child.begin(call, jobs[number], jobs[number].memory or memory)
            at_work[child] = number
        wait([child.connection for child in at_work], TICK)
        for child, number in list(at_work.items()):
            outcome = child.outcome()
            if outcome is not None:
                del at_work[child]
                if not child.is_fit:
                    child.end()
                    children.remove(child)
                yield number, outcome
