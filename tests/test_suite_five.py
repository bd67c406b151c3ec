"""The five frozen test sets of docs/suite_five.md are those that anyone makes from their recipes.

`recipes/suite_five/expected.json` holds the digest of each, and of its first scenes one by one. After a change of results
that is meant: `DAPDATA_SUITE=write pytest tests/test_suite_five.py -m slow`, which makes all 2500 scenes.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

import dapdata
from dapdata import manifest, recipe, store
from dapdata.pipeline import generate, label

RECIPES = Path(__file__).parents[1] / "recipes"
EXPECTED = RECIPES / "suite_five/expected.json"
FIVE = ("book_shelf", "can_cabinet", "mug_rack_easy", "mug_rack_med", "mug_rack_multi_med")
FIRST = 10  # scenes that are compared one by one

each = pytest.mark.parametrize("name", FIVE)


def test_the_suite_is_these_five() -> None:
    assert {path.stem for path in EXPECTED.parent.glob("*.yaml")} == set(FIVE)
    assert set(json.loads(EXPECTED.read_text())) == set(FIVE)


@each
def test_the_suite_draws_its_scenes_as_the_recipe_of_that_name(name: str) -> None:
    usual, frozen = (recipe.resolve(recipe.load(path / f"{name}.yaml")) for path in (RECIPES, EXPECTED.parent))
    own = ("name", "seed", "demos", "shard_size", "split")
    assert {key for key in usual if usual[key] != frozen[key]} <= set(own)
    assert usual["seed"] != frozen["seed"], "or what was trained on would be in it"
    assert (frozen["demos"], frozen["split"]) == (500, {"val": 0.0, "test": 1.0})


@each
@pytest.mark.slow
def test_the_first_scenes_are_the_frozen_ones(name: str, tmp_path: Path) -> None:
    is_written = os.environ.get("DAPDATA_SUITE") == "write"
    demos = [] if is_written else [f"demos={FIRST}"]
    root = label(
        generate(recipe.load(EXPECTED.parent / f"{name}.yaml", demos), tmp_path / name, engine="inline"), engine="inline"
    )
    assert set(manifest.read_index(root)["split"]) == {"test"}
    first = [store.demo_digest(sample) for _, sample in zip(range(FIRST), dapdata.open(root, "test"))]
    known: dict[str, Any] = json.loads(EXPECTED.read_text()) if EXPECTED.exists() else {}
    if is_written:
        known[name] = {"content_sha256": manifest.read(root).content_sha256, "first": first}
        EXPECTED.write_text(json.dumps(known, indent=1) + "\n")
    assert first == known[name]["first"]
