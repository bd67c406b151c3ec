"""A script that submits a recipe to Slurm: two array jobs whose tasks make units, and after each a plain command.

The plain commands make what lost tasks left, and publish. They are not refused: each waits for its whole array. A task
may be lost, requeued or run twice; it never matters which (see pipeline.py).
"""

from __future__ import annotations

import math
import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dapdata import remote
from dapdata.errors import UsageError
from dapdata.recipe import Recipe
from dapdata.remote import Place
from dapdata.stages import units

MOST_TASKS = 100  # by default; many clusters refuse arrays of more than 1000
COMMAND_MEMORY = 1.0  # GB, for the command beside its workers
TIME = re.compile(r"(\d+-)?\d+(:\d+){0,2}")  # minutes, hours:minutes:seconds, days-hours, ... as sbatch reads them

SCRIPT = """\
#!/bin/bash
# {name}: {demos} demos in {units} units, by {tasks} tasks with {workers} {processes} each. Submit it with `bash FILE`.
# `squeue --me` shows the jobs, `dapdata status {folder}` how far they are; what they print is in {folder}-slurm/.
set -euo pipefail
mkdir -p {logs}

submit() {{  # one job, whose script is on stdin; prints its number
    local answer
    answer=$(sbatch --parsable {limits} --output={output} "$@")
    echo "${{answer%%;*}}"
}}

made=$(submit --job-name={name}-generate --array=0-{last} <<'END'
#!/bin/bash
exec {generate} --units "$SLURM_ARRAY_TASK_ID/{tasks}"
END
)
generated=$(submit --job-name={name}-generate-rest --dependency=afterany:"$made" <<'END'
#!/bin/bash
exec {generate}
END
)
labelled=$(submit --job-name={name}-label --array=0-{last} --dependency=afterok:"$generated" --kill-on-invalid-dep=yes <<'END'
#!/bin/bash
exec {label} --units "$SLURM_ARRAY_TASK_ID/{tasks}"
END
)
published=$(submit --job-name={name}-label-rest --dependency=afterany:"$labelled" --kill-on-invalid-dep=yes <<'END'
#!/bin/bash
exec {label}
END
)
echo "{name}: jobs $made, $generated, $labelled, $published"
"""


@dataclass(frozen=True)
class Limits:
    """What each task is to have."""

    tasks: int | None  # at most, in an array; None: MOST_TASKS; never more than there are units
    workers: int
    memory: float  # GB, of each worker
    time: str
    partition: str | None
    account: str | None

    def options(self) -> list[str]:
        """As sbatch is told."""
        where = [f"--{name}={value}" for name in ("partition", "account") if (value := getattr(self, name))]
        memory = math.ceil(1024 * (self.workers * self.memory + COMMAND_MEMORY))
        return ["--nodes=1", "--ntasks=1", f"--cpus-per-task={self.workers}", f"--mem={memory}M", f"--time={self.time}", *where]


def script(recipe: Recipe, path: Path, out: Place | None, overrides: Sequence[str], limits: Limits, allow_missing: bool) -> str:
    """A Bash script that submits what makes a dataset; its paths are absolute, its Python is this one.

    Args:
        recipe: As it is asked for; only its name and its number of units are looked at.
        path: The recipe's file, which the tasks read.
        out: The dataset's folder, or its URL; `data/<recipe name>` by default. What tasks say lies beside the folder, or
            in this one.
        overrides: Such as "label.eps_place=0.02", for the tasks.
        limits: What each task is to have.
        allow_missing: Whether the dataset may be published without units that fail.

    Raises:
        UsageError: if the time limit is none that sbatch reads.
    """
    if not TIME.fullmatch(limits.time):
        raise UsageError(f"--time: got '{limits.time}', expected minutes, HH:MM:SS or D-HH:MM:SS, such as 04:00:00")
    place = remote.locate(out or Path("data") / recipe.name)
    folder = place.absolute() if isinstance(place, Path) else place
    logs = f"{folder if isinstance(folder, Path) else Path(recipe.name).absolute()}-slurm"
    count = len(units(recipe.demos, recipe.shard_size))
    tasks = min(count, limits.tasks or MOST_TASKS)
    dapdata, more = [sys.executable, "-m", "dapdata"], ["--workers", str(limits.workers), "--memory", f"{limits.memory:g}"]
    more += ["--allow-missing"] if allow_missing else []
    changes = [word for change in overrides for word in ("--set", change)]
    return SCRIPT.format(
        name=recipe.name,
        demos=recipe.demos,
        units=count,
        tasks=tasks,
        workers=limits.workers,
        processes="process" if limits.workers == 1 else "processes",
        folder=folder,
        logs=shlex.quote(logs),
        output=shlex.quote(logs.replace("%", "%%") + "/%x-%j.out"),
        limits=shlex.join(limits.options()),
        last=tasks - 1,
        generate=shlex.join([*dapdata, "generate", str(path.absolute()), "--out", str(folder), *changes, *more]),
        label=shlex.join([*dapdata, "label", str(folder), *more]),
    )
