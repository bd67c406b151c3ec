"""Timing rivals in turn, A B C A B C, in CPU seconds, and what every benchmark prints.

Wall clock means little on a shared machine; CPU seconds of the process (all its threads) and the ratio of
rivals timed right after one another do. A ratio is taken within each round; its median and spread are given.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Row:
    """One contender in one case. Ratios are this one's figure over the first contender's; more than 1 is slower or larger."""

    benchmark: str
    case: str
    name: str
    unit: str
    low: float
    median: float
    high: float
    rounds: int
    ratio: float | None = None
    ratio_low: float | None = None
    ratio_high: float | None = None
    note: str = ""


Contender = Callable[[], object]


def cpu_ms(contender: Contender) -> float:
    """CPU milliseconds of this process for one call."""
    start = time.process_time()
    contender()
    return (time.process_time() - start) * 1e3


def compare(
    benchmark: str,
    case: str,
    contenders: Mapping[str, Contender],
    rounds: int,
    measure: Callable[[Contender], float] = cpu_ms,
    unit: str = "CPU ms",
    notes: Mapping[str, str] | None = None,
) -> list[Row]:
    """Rows for contenders called in turn; the first one is ours. Each is called once before, unmeasured."""
    for contender in contenders.values():
        contender()
    values: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, contender in contenders.items():
            values[name].append(measure(contender))
    return rows(benchmark, case, values, unit, notes)


def rows(
    benchmark: str, case: str, values: Mapping[str, list[float]], unit: str, notes: Mapping[str, str] | None = None
) -> list[Row]:
    """Rows from values measured elsewhere, value i of each contender in the same round; the first contender is ours."""
    ours = next(iter(values.values()))
    found = []
    for name, measured in values.items():
        ratios = [b / a for a, b in zip(ours, measured) if a > 0]
        ratio = (statistics.median(ratios), min(ratios), max(ratios)) if measured is not ours and ratios else (None,) * 3
        spread = min(measured), statistics.median(measured), max(measured)
        found.append(Row(benchmark, case, name, unit, *spread, len(measured), *ratio, note=(notes or {}).get(name, "")))
    return found


def published(ours: Row, name: str, value: float, note: str) -> Row:
    """A row for a figure that was measured elsewhere, next to ours."""
    ratios = value / ours.median, value / ours.high, value / ours.low
    return Row(ours.benchmark, ours.case, name, ours.unit, value, value, value, 0, *ratios, note=note)


def chosen(contenders: Mapping[str, Contender], against: str | None) -> dict[str, Contender]:
    """Ours, and the named rival; all without a name."""
    ours = next(iter(contenders))
    return {name: run for name, run in contenders.items() if against is None or name in (ours, against)}


def main(run: Callable[[str, str | None], Iterable[Row]]) -> None:
    """The command line of a benchmark: prints its rows as JSON, one a line."""
    parser = argparse.ArgumentParser(description=sys.modules["__main__"].__doc__)
    parser.add_argument("--quick", action="store_true", help="few rounds: seconds, not minutes")
    parser.add_argument("--long", action="store_true", help="the whole counts: minutes")
    parser.add_argument("--against", help="compare with this rival only")
    options = parser.parse_args()
    scale = "quick" if options.quick else "long" if options.long else "normal"
    for row in run(scale, options.against):
        print(json.dumps(asdict(row)), flush=True)
