"""How long `dapdata --help` takes, and that it imports nothing heavy. The bare interpreter is the floor.

Wall seconds here, not CPU: it is what a user waits for.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

from timing import Row, chosen, compare, main

HEAVY = ("torch", "pybullet", "open3d", "trimesh", "numba", "scipy", "matplotlib", "zarr", "pyarrow", "pandas")
LIMIT_MS = 500.0
LIST_MODULES = (
    "import sys, json\n"
    "sys.argv = ['dapdata', '--help']\n"
    "from dapdata.cli import main\n"
    "try:\n    main()\n"
    "except SystemExit:\n    pass\n"
    "print(json.dumps(sorted(sys.modules)))"
)


def start(*arguments: str) -> Callable[[], object]:
    """A function that runs Python with some arguments to its end."""
    return lambda: subprocess.run([sys.executable, *arguments], capture_output=True, check=True)


def wall_ms(contender: Callable[[], object]) -> float:
    begin = time.perf_counter()
    contender()
    return (time.perf_counter() - begin) * 1e3


def imported() -> list[str]:
    """The names of all modules that `dapdata --help` imports."""
    out = subprocess.run([sys.executable, "-c", LIST_MODULES], capture_output=True, check=True, text=True).stdout
    return list(json.loads(out.splitlines()[-1]))


def run(scale: str, against: str | None) -> Iterator[Row]:
    modules = imported()
    heavy = [name for name in HEAVY if name in modules]
    note = f"{len(modules)} modules, of the heavy ones: {', '.join(heavy) or 'none'}; limit {LIMIT_MS:.0f} ms"
    contenders = {"dapdata": start("-m", "dapdata", "--help"), "python": start("-c", "pass")}
    rounds = 3 if scale == "quick" else 15
    yield from compare("startup", "--help", chosen(contenders, against), rounds, wall_ms, "wall ms", {"dapdata": note})


if __name__ == "__main__":
    main(run)
