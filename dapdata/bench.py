"""Speed, memory and start-up of dapdata on this machine, next to named rivals: runs the scripts of `benchmarks/`.

The scripts live in the source tree, not in the installed package; each prints rows as JSON, one a line.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from dapdata import __version__
from dapdata.errors import EnvironmentProblem, UsageError, nearest

RIVALS = {  # script: whom it compares with
    "startup": ("python",),
    "render": ("tinyrenderer", "open3d"),
    "generate": ("rpdiff",),
    "load": ("block-shuffled", "npz-per-demo", "zarr-slices"),
    "memory": ("10 demos",),
    "train": ("bfloat16", "torch-compile"),
    "infer": ("fast", "100-steps"),
}
PACKAGES = ("numpy", "numba", "pybullet", "open3d", "zarr", "torch")
Row = dict[str, Any]


def folder() -> Path:
    """The folder of the scripts.

    Raises:
        EnvironmentProblem: dapdata was installed without its source tree.
    """
    found = Path(__file__).resolve().parents[1] / "benchmarks"
    if not (found / "timing.py").is_file():
        raise EnvironmentProblem(
            f"{found}: not there, expected the benchmarks of the source tree; they are not part of the installed package: "
            "clone the repository and run `make bench` in it"
        )
    return found


def run(against: str | None = None, scale: str = "normal") -> Iterator[Row]:
    """The rows of all benchmarks, or of those that know a rival, as they are measured.

    Args:
        against: Name of a rival, one of RIVALS' values; None: all.
        scale: "quick" (a minute or two), "normal", or "long" (whole counts).

    Raises:
        UsageError: a rival that no benchmark knows.
        EnvironmentProblem: no source tree, or a script that failed.
    """
    known = [name for names in RIVALS.values() for name in names]
    if against is not None and against not in known:
        raise UsageError(f"--against {against}: unknown rival; {nearest(against, known)}")
    scripts = folder()
    for script, names in RIVALS.items():
        if against is None or against in names:
            yield from _rows(scripts / f"{script}.py", against, scale)


def _rows(script: Path, against: str | None, scale: str) -> Iterator[Row]:
    options = ([] if scale == "normal" else [f"--{scale}"]) + (["--against", against] if against else [])
    inherited = os.environ.get("PYTHONPATH", "")
    path = os.pathsep.join(part for part in (str(script.parents[1]), inherited) if part)
    environment = os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, str(script), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as child:
        out, log = child.communicate()
    yield from (json.loads(line) for line in out.splitlines() if line.startswith("{"))
    if child.returncode:
        last = (log.strip().splitlines() or ["no message"])[-1]
        raise EnvironmentProblem(
            f"{script}: ended with code {child.returncode} ({last}), expected rows of figures; "
            f"see `PYTHONPATH={script.parents[1]} {sys.executable} {script}`"
        )


def machine() -> dict[str, str]:
    """What the figures were measured on: processor, cores, load, versions."""
    about = {"processor": _processor(), "cores": str(os.cpu_count()), "python": platform.python_version()}
    about["dapdata"] = __version__
    about["load average"] = ", ".join(f"{load:.1f}" for load in os.getloadavg())
    for package in PACKAGES:
        try:
            about[package] = version(package)
        except PackageNotFoundError:
            about[package] = "not installed"
    return about


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


HEADER = ("benchmark", "case", "name", "median", "min .. max", "unit", "n", "ratio to dapdata", "note")


def table(rows: list[Row]) -> str:
    """Rows as aligned text."""
    lines = [HEADER] + [_cells(row) for row in rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(HEADER))]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths)).rstrip() for line in lines)


def _cells(row: Row) -> tuple[str, ...]:
    measured = row["rounds"] > 0
    spread = f"{_number(row['low'])} .. {_number(row['high'])}" if measured else "published"
    ratio = ""
    if row["ratio"] is not None:
        ratio = f"{row['ratio']:.2f}x ({row['ratio_low']:.2f} .. {row['ratio_high']:.2f})"
    count = str(row["rounds"]) if measured else "-"
    return row["benchmark"], row["case"], row["name"], _number(row["median"]), spread, row["unit"], count, ratio, row["note"]


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"
