"""How commands speak: results on stdout, progress and remarks on stderr, and what was last written from a folder."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from dapdata.errors import UsageError

LAST = Path(".dapdata/last.json")  # the dataset and the run that were last written from this folder
EVERY = 5.0  # s between lines where there is no terminal
REFERENCES = ("oracle", "heuristic", "random")


def say(text: str) -> None:
    """A line for the person who watches."""
    print(text, file=sys.stderr, flush=True)


def seldom(speak: Callable[[str], None]) -> Callable[[str], None]:
    """The same, but with at most a line every few seconds."""
    last = -EVERY

    def now_and_then(line: str) -> None:
        nonlocal last
        if time.monotonic() - last >= EVERY:
            last = time.monotonic()
            speak(line)

    return now_and_then


def show(result: Mapping[str, Any], as_json: bool, text: str) -> None:
    """The result of a command, on stdout."""
    print(json.dumps(result, indent=1, default=str) if as_json else printable(text), flush=True)


def printable(text: str) -> str:
    """The text without what would steer a terminal: names of files and words in them may hold anything."""
    return "".join(letter if letter.isprintable() or letter in "\n\t" else "?" for letter in text)


@contextmanager
def progress(name: str, unit: str) -> Iterator[Callable[[int, int], None]]:
    """A function to call with (done, in all): a bar on a terminal, else a line every few seconds."""
    if not sys.stderr.isatty():
        yield _Lines(name, unit)
        return
    from tqdm import tqdm

    with tqdm(desc=name, unit=unit, leave=False, dynamic_ncols=True) as bar:

        def advance(done: int, total: int) -> None:
            if bar.total is None:  # what was there already is no measure of speed
                bar.reset(total=total)
                bar.initial = bar.n = done
            bar.update(done - bar.n)

        yield advance


class _Lines:
    """Progress where nobody sees a bar move."""

    def __init__(self, name: str, unit: str) -> None:
        self.name, self.unit = name, unit
        self.start, self.first, self.said = time.monotonic(), -1, -EVERY

    def __call__(self, done: int, total: int) -> None:
        now = time.monotonic() - self.start
        if self.first < 0:
            self.first = done
        if now - self.said < EVERY and done < total:
            return
        self.said = now
        fresh = done - self.first
        left = f", {now / fresh * (total - done):.0f} s left" if fresh > 0 and done < total else ""
        say(f"{self.name}: {done} of {total} {self.unit}s, {now:.0f} s{left}")


# What was last written from this folder --------------------------------------------------------------------


def remember(**folders: Path | str) -> None:
    """Notes datasets and runs by kind, so that the next command needs no argument."""
    try:
        LAST.parent.mkdir(exist_ok=True)
        staged = LAST.with_suffix(".part")
        staged.write_text(json.dumps(_recall() | {kind: str(folder) for kind, folder in folders.items()}))
        staged.replace(LAST)
    except OSError as error:
        say(f"{LAST}: not written ({error.strerror}); the next command needs its dataset or run as an argument")


def last(kind: Literal["dataset", "run"], given: Path | str | None) -> str:
    """The folder (of a dataset also the URL) that was given; or else the one last written from here, which is then said.

    Raises:
        UsageError: if there is neither.
    """
    if given is not None:
        return str(given)
    folder = _recall().get(kind)
    if folder is None:
        make = "dapdata generate RECIPE" if kind == "dataset" else "dapdata train"
        raise UsageError(f"{kind}: none was given and none was written from this folder yet; name one, or run: {make}")
    say(f"{kind}: {folder} (the last one written from this folder)")
    return folder


def _recall() -> dict[str, str]:
    """What was noted, as far as that can be read."""
    try:
        noted = json.loads(LAST.read_text())
    except (OSError, ValueError):
        return {}
    return {str(kind): str(folder) for kind, folder in noted.items()} if isinstance(noted, dict) else {}


# Results as text -------------------------------------------------------------------------------------------


def rate(interval: Mapping[str, Any]) -> str:
    """`71.0 % (95 %: 61.5 to 79.0, n = 100)`."""
    low, high = interval["ci95"]
    return f"{100 * interval['value']:.1f} % (95 %: {100 * low:.1f} to {100 * high:.1f}, n = {interval['n']})"


def report_text(report: Mapping[str, Any]) -> str:
    """A report in a dozen lines: the method's success next to the references'."""
    success = report["success"]
    judged = f"{report['split']['name']} split, {report['judge']['protocol']} protocol, K = {report['method']['k']}"
    head = f"{report['task']}, {judged}"
    lines = [head, f"  {report['method']['name']}:"]
    for name in ("top1", "any_of_K", "single", "precise", "near_goal", "tight"):
        lines.append(f"    success_{name:<9} {rate(success[f'success_{name}'])}")
    failures = ", ".join(f"{reason} {count}" for reason, count in success["failures"].items())
    lines.append(f"    failures          {failures or 'none'}")
    for name in (name for name in REFERENCES if name in report["references"]):
        lines.append(f"  {name + ':':<20} {rate(report['references'][name]['success']['success_top1'])}")
    return "\n".join([*lines, *(f"  note: {note}" for note in report["notes"])])


def comparison_text(found: Mapping[str, Any]) -> str:
    """Two methods on the same scenes."""
    lines = [f"{found[side]['method']:<12} {rate(found[side]['success_top1'])}  {found[side]['report']}" for side in ("a", "b")]
    names = ("both", "only_a", "only_b", "neither")
    counts = ", ".join(f"{name.replace('_', ' ')} {found[name]}" for name in names)
    difference = f"difference {100 * found['difference']:+.1f} points, McNemar p = {found['p_value']:.3g}"
    return "\n".join([*lines, f"scenes: {counts}", difference])


def placements_text(placements: Sequence[Mapping[str, Any]]) -> str:
    """Ranked placements, a line each: score and where the object's scan is moved to."""
    lines = ["rank  score     status     x        y        z (m, translation of T_world_object)"]
    for row in placements:
        pose = row["T_world_object"]
        where = "  ".join(f"{line[3]:+.4f}" for line in pose[:3]) if pose else "-"
        score = "-" if row["score"] is None else f"{row['score']:.3f}"
        lines.append(f"{row['rank']:<5} {score:<9} {row['status']:<10} {where}")
    return "\n".join(lines)


def made_text(report: Mapping[str, Any], made: Mapping[str, str]) -> str:
    """What `dapdata run` made: how well it went, where everything is, and what to try next."""
    width = max(map(len, made)) + 2
    where = [f"{name + ':':<{width}}{path}" for name, path in made.items()]
    scans = f"--container {made['container scan']} --object {made['object scan']}"
    return "\n".join([report_text(report), "", *where, "", f"try next: dapdata predict {made['run']} {scans}"])
