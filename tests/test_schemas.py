"""The JSON Schemas describe what is written, and refuse what is not; the files in schemas/ are what the models say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from dapdata import recipe, tasks
from dapdata.errors import UsageError
from dapdata.schemas import KINDS, schema

ROOT = Path(__file__).parents[1]


def array_documents(shard: Path) -> dict[str, Any]:
    """The zarr.json of each array of a shard by the array's path."""
    return {str(path.parent.relative_to(shard)): json.loads(path.read_text()) for path in shard.glob("*/*/zarr.json")}


def check(kind: str, value: Any) -> None:
    jsonschema.Draft202012Validator(schema(kind)).validate(value)


@pytest.mark.parametrize("kind", KINDS)
def test_a_schema_is_one_and_its_file_is_fresh(kind: str) -> None:
    made = schema(kind)
    jsonschema.Draft202012Validator.check_schema(made)
    assert json.loads((ROOT / f"schemas/{kind}.schema.json").read_text()) == made, "run `make schemas`"


def test_an_unknown_schema_is_refused_with_the_known_ones() -> None:
    with pytest.raises(UsageError, match="expected one of recipe, manifest, shard, report; did you mean 'recipe'"):
        schema("recipes")


@pytest.mark.parametrize("task", tasks.names())
def test_resolved_recipes_are_valid(task: str) -> None:
    check("recipe", recipe.resolve(recipe.recipe_class(task)(name="a")))
    check("recipe", {"scene": {"task": task}})


@pytest.mark.parametrize(
    "wrong",
    [
        {},
        {"scene": {"task": "can_cabinet"}, "labels": {}},
        {"scene": {"task": "can_cabinet"}, "label": {"eps_place": 30}},
        {"scene": {"task": "can_cabinet", "book_gap": [0, 1]}},
        {"scene": {"task": "can_cabinet"}, "seed": "1"},
    ],
    ids=["nothing", "unknown section", "out of range", "key of another task", "text for a number"],
)
def test_wrong_recipes_are_invalid(wrong: dict[str, Any]) -> None:
    with pytest.raises(jsonschema.ValidationError):
        check("recipe", wrong)


def test_a_written_dataset_is_valid(tiny_dataset: Path) -> None:
    manifest = json.loads((tiny_dataset / "manifest.json").read_text())
    check("manifest", manifest)
    check("recipe", manifest["recipe"])
    for shard in manifest["shards"]:
        root = tiny_dataset / shard["path"]
        check("shard", array_documents(root))


def test_a_shard_with_another_array_or_dtype_is_invalid(tiny_dataset: Path) -> None:
    root = tiny_dataset / json.loads((tiny_dataset / "manifest.json").read_text())["shards"][0]["path"]
    arrays = array_documents(root)
    points = arrays["container/points"]
    for wrong in (
        arrays | {"container/colour": points},
        {path: about for path, about in arrays.items() if path != "goals/offsets"},
        arrays | {"container/points": points | {"data_type": "float64"}},
        arrays | {"container/points": points | {"attributes": points["attributes"] | {"unit": "mm"}}},
    ):
        with pytest.raises(jsonschema.ValidationError):
            check("shard", wrong)


def test_a_report_is_valid(tiny_dataset: Path, tmp_path: Path) -> None:
    from dapdata import loading, metrics, predictions

    scenes = loading.open(tiny_dataset, "test")
    samples = [scenes[i] for i in range(len(scenes))]
    predictions.write(tmp_path / "oracle.npz", metrics.oracle(samples, 2))
    report = metrics.judge_file(tmp_path / "oracle.npz", tiny_dataset)
    check("report", json.loads(json.dumps(report)))
    assert np.isclose(report["success"]["success_top1"]["value"], 1)
