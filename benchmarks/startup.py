"""How long `dapdata --help` takes, and that it imports nothing heavy; and how long until `generate` has made one demo.

The bare interpreter is the floor of the first. The second is timed with compiled kernels, and once as in an environment in
which they never ran, so that numba compiles them. Wall seconds here, not CPU: it is what a user waits for.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from timing import Row, chosen, compare, main, rows

HEAVY = ("torch", "pybullet", "open3d", "trimesh", "numba", "scipy", "matplotlib", "zarr", "pyarrow", "pandas")
LIMIT_MS, FIRST_DEMO_LIMIT_MS = 300.0, 3000.0
RECIPE = Path(__file__).parents[1] / "recipes/can_cabinet.yaml"
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


def first_demo(**environment: str) -> None:
    """Runs `dapdata generate` for one demo, into a folder that is removed again."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "dapdata", "generate", str(RECIPE), "--demos", "1", "--out", f"{folder}/dataset"]
        subprocess.run(command, capture_output=True, check=True, env=os.environ | environment)


def imported() -> list[str]:
    """The names of all modules that `dapdata --help` imports."""
    out = subprocess.run([sys.executable, "-c", LIST_MODULES], capture_output=True, check=True, text=True).stdout
    return list(json.loads(out.splitlines()[-1]))


def run(scale: str, against: str | None) -> Iterator[Row]:
    modules = imported()
    heavy = [name for name in HEAVY if name in modules]
    note = f"{len(modules)} modules, of the heavy ones: {', '.join(heavy) or 'none'}; limit {LIMIT_MS:.0f} ms"
    contenders = {"dapdata": start("-m", "dapdata", "--help"), "python": start("-c", "pass")}
    count = 3 if scale == "quick" else 15
    yield from compare("startup", "--help", chosen(contenders, against), count, wall_ms, "wall ms", {"dapdata": note})
    limit = {"dapdata": f"kernels compiled before; limit {FIRST_DEMO_LIMIT_MS:.0f} ms"}
    yield from compare("startup", "first demo", {"dapdata": first_demo}, min(count, 5), wall_ms, "wall ms", limit)
    with tempfile.TemporaryDirectory() as cache:
        anew = wall_ms(lambda: first_demo(NUMBA_CACHE_DIR=cache))
    once = {"dapdata": "numba compiles the kernels, once an environment"}
    yield from rows("startup", "first demo, kernels anew", {"dapdata": [anew]}, "wall ms", once)


if __name__ == "__main__":
    main(run)
