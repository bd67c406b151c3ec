"""When a stage's results move, its version must move too, or old units would be taken for new ones.

`golden.json` holds, for each stage, its version and the rows, mean and spread of every array of the tiny dataset. After a
change of results that is meant: raise the stage's version in pipeline.py, then run
`DAPDATA_GOLDEN=write pytest tests/test_golden.py`.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dapdata
from dapdata.pipeline import STAGES
from dapdata.records import columns

GOLDEN = Path(__file__).with_name("golden.json")
TOLERANCE = 1e-3  # relative to an array's spread: far above what another CPU's rounding does, far below another formula


def summary(arrays: list[np.ndarray]) -> list[float]:
    """Rows, mean and spread of one array over all demos."""
    values = np.concatenate([np.asarray(array, dtype=float).ravel() for array in arrays])
    return [len(values), float(values.mean()), float(values.std())] if len(values) else [0, 0.0, 0.0]


def summaries(root: Path) -> dict[str, Any]:
    samples = list(dapdata.open(root))
    found: dict[str, Any] = {}
    for stage in STAGES:
        paths = [c.metadata["path"] for c in columns(stage.makes) if not c.metadata["path"].endswith("_instance")]
        found[stage.name] = {
            "version": stage.version,
            "arrays": {path: summary([sample[path] for sample in samples]) for path in paths},
        }
    return found


def test_results_move_only_with_their_stages_version(tiny: Path) -> None:
    now = summaries(tiny)
    if os.environ.get("DAPDATA_GOLDEN") == "write":
        GOLDEN.write_text(json.dumps(now, indent=1) + "\n")
    if not GOLDEN.exists():
        pytest.fail("tests/golden.json is missing: run DAPDATA_GOLDEN=write pytest tests/test_golden.py")
    golden = json.loads(GOLDEN.read_text())
    for name, stage in now.items():
        then = golden[name]
        moved = [path for path, value in stage["arrays"].items() if not same(value, then["arrays"].get(path))]
        remedy = "see the top of this file"
        assert stage["version"] == then["version"], f"stage {name}: version {then['version']} -> {stage['version']}; {remedy}"
        assert not moved, f"stage {name}: {moved} moved and its version did not; {remedy}"


def same(now: list[float], then: list[float] | None) -> bool:
    return then is not None and now[0] == then[0] and abs(np.subtract(now, then)[1:]).max() <= TOLERANCE * max(then[2], 1e-3)
