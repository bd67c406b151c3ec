"""Peak memory of making a dataset, for few and for many demos: it must not grow with their number.

Each run is a process of its own with one worker; the figure is the larger of the peaks of the process and of its
largest child.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage

from timing import Row, main, rows

RECIPE = Path(__file__).parents[1] / "recipes/can_cabinet.yaml"
FEW = 10
MANY = {"quick": 30, "normal": 200, "long": 1000}
LIMITS = "limits: 50 MB apart, 600 MB a worker"


def make(demos: int) -> dict[str, float]:
    """Makes a dataset in this process and returns peak MB of it and of its largest child."""
    from dapdata import pipeline, recipe

    with tempfile.TemporaryDirectory() as folder:
        pipeline.generate(recipe.load(RECIPE, [f"demos={demos}"]), Path(folder) / "dataset")
        pipeline.label(Path(folder) / "dataset")
    return {"process": getrusage(RUSAGE_SELF).ru_maxrss / 1024, "child": getrusage(RUSAGE_CHILDREN).ru_maxrss / 1024}


def peak(demos: int) -> dict[str, float]:
    """The same in a process of its own."""
    done = subprocess.run([sys.executable, __file__, "--make", str(demos)], check=True, stdout=subprocess.PIPE, text=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def run(scale: str, against: str | None) -> Iterator[Row]:
    many = MANY[scale]
    names = f"{many} demos", f"{FEW} demos"
    values: dict[str, list[float]] = {name: [] for name in names}
    notes = {}
    for _ in range(2 if scale == "normal" else 1):
        for name, demos in zip(names, (many, FEW)):
            found = peak(demos)
            values[name].append(max(found.values()))
            notes[name] = f"process {found['process']:.0f}, largest child {found['child']:.0f}"
    apart = max(values[names[0]]) - min(values[names[1]])
    notes[names[0]] += f"; at most {apart:.0f} MB apart; {LIMITS}"
    yield from rows("memory", "can_cabinet, generate + label", values, "peak MB", notes)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--make"]:
        print(json.dumps(make(int(sys.argv[2]))))
    else:
        main(run)
