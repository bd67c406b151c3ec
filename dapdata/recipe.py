"""A dataset as one YAML file: all sections together, read strictly, with errors that can be acted upon.

Each error is one line: `recipes/x.yaml:17: label.eps_place: got 30, expected 0.001 to 0.2 m; did you mean 0.03?`
The scene section is that of the task it names, so there is one Recipe class a task, made when it is asked for.
"""

from __future__ import annotations

import json
import operator
import re
from collections.abc import Iterator, Sequence
from functools import cache, reduce
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, Field, SerializeAsAny, ValidationError, create_model

from dapdata import keys, tasks
from dapdata.cluster import SuperpointsConfig
from dapdata.config import IMPORTED, PAPER, EvalConfig, SceneConfig, Section, SplitConfig, TrainConfig, key
from dapdata.errors import UsageError, hint
from dapdata.labels import LabelConfig
from dapdata.observe import CamerasConfig, NoiseConfig
from dapdata.simulate import PlacementConfig
from dapdata.strict_yaml import Location, Source

NAME_PATTERN = r"^[a-z0-9][a-z0-9_-]*$"


class Recipe(Section):
    """A dataset: what is drawn, how it is seen and labelled, and how its networks are trained and judged."""

    name: str = key("dataset", "names the dataset's folder, data/<name>", pattern=NAME_PATTERN, max_length=64)
    seed: int = key(0, "every random draw follows from it", ge=0, le=2**32 - 1)
    demos: int = key(100, "number of demonstrations; more of them leave the first ones as they are", ge=1, le=10_000_000)
    shard_size: int = key(50, "demos in a shard, the unit of work, of resuming and of storage", ge=1, le=100_000)
    scene: SerializeAsAny[SceneConfig] = Field(description="container, clutter and object, as the task draws them")
    placement: PlacementConfig = Field(default=PlacementConfig(), description="which goals hold, by simulation")
    cameras: CamerasConfig = Field(default=CamerasConfig(), description="where the scene is seen from")
    noise: NoiseConfig = Field(default=NoiseConfig(), description="what the sensor adds to the true depth")
    superpoints: SuperpointsConfig = Field(default=SuperpointsConfig(), description="how clouds are partitioned")
    label: LabelConfig = Field(default=LabelConfig(), description="what the networks learn")
    split: SplitConfig = Field(default=SplitConfig(), description="how demos are shared out")
    train: TrainConfig = Field(default=TrainConfig(), description="the two networks")
    eval: EvalConfig = Field(default=EvalConfig(), description="how predictions are made and judged")


def load(path: str | Path, overrides: Sequence[str] = ()) -> Recipe:
    """The recipe in a YAML file, with `a.b=value` overrides applied; a recipe without a name takes the file's.

    Raises:
        RecipeError: with one line for each thing that is wrong. Nothing is written in any case.
    """
    source = Source(str(path))
    source.read(Path(path))
    source.tree.setdefault("name", re.sub(r"[^a-z0-9_-]+", "_", Path(path).stem.lower()).strip("_-") or "dataset")
    return _validate(source, overrides)


def resolve(recipe: Recipe) -> dict[str, Any]:
    """The recipe as plain JSON data with every default filled in: what the manifest keeps and the unit keys hash."""
    return recipe.model_dump(mode="json")


def from_resolved(resolved: dict[str, Any], overrides: Sequence[str] = (), origin: str = "manifest.json") -> Recipe:
    """The recipe that `resolve` was given, with `a.b=value` overrides applied; errors point to `origin`.

    A resolved recipe has every key written, so that a `train.preset` among the overrides would change nothing: it takes
    the place of the keys that it sets. Other overrides win over it.
    """
    tree = json.loads(json.dumps(resolved))
    if any(override.partition("=")[0] == "train.preset" for override in overrides) and isinstance(tree.get("train"), dict):
        tree["train"] = {name: value for name, value in tree["train"].items() if name not in PAPER}
    return _validate(Source(origin, tree), overrides)


@cache
def recipe_class(task: str) -> type[Recipe]:
    """The Recipe whose scene section is that of the task; the task must be one of `tasks.names()` or `IMPORTED`."""
    params: Any = IMPORTED[task] if task in IMPORTED else tasks.load(task).Params
    scene = Field(default=params(), description=Recipe.model_fields["scene"].description)
    return create_model("Recipe", __base__=Recipe, __doc__=Recipe.__doc__, scene=(params, scene))


def json_schema() -> dict[str, Any]:
    """The JSON Schema of a recipe of any task."""
    union = reduce(operator.or_, [*(tasks.load(task).Params for task in tasks.names()), *IMPORTED.values()])
    scene = Field(discriminator="task", description=Recipe.model_fields["scene"].description)
    model = create_model("Recipe", __base__=Recipe, __doc__=Recipe.__doc__, scene=(Annotated[union, scene], ...))
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **model.model_json_schema()}


# Validating ------------------------------------------------------------------------------------------------


def _validate(source: Source, overrides: Sequence[str]) -> Recipe:
    """The Recipe of the source's tree, or a RecipeError that names every problem."""
    for override in overrides:
        source.override(override)
    model = recipe_class(_task(source))
    schema = _schema(model)
    tree = _open_empty_sections(source.tree, schema, ())
    try:
        return model.model_validate_json(json.dumps(tree))  # JSON: a list is a tuple, an int is a float, nothing else bends
    except ValidationError as error:
        for item in error.errors(include_url=False):
            _explain(source, tree, schema, item)
    source.stop_if_wrong()
    raise AssertionError("a ValidationError without errors")


@cache
def _schema(model: type[Recipe]) -> dict[str, Any]:
    """The JSON Schema of a recipe class, made once: every unit of work validates its recipe. Not to be changed."""
    return model.model_json_schema()


def _task(source: Source) -> str:
    """The value of scene.task, which decides what the scene section may hold."""
    scene, known = source.tree.get("scene"), tasks.names()
    expected = f"expected one of {', '.join(known)}"
    if not isinstance(scene, dict):
        got = f"got {keys.shown(scene)}" if "scene" in source.tree else "missing"
        source.blame(("scene",), f"{got}, expected a section with `task:` {expected.removeprefix('expected ')}")
    elif "task" not in scene:
        source.blame(("scene", "task"), f"missing, {expected}")
    elif not isinstance(scene["task"], str) or scene["task"] not in (*known, *IMPORTED):
        hint = keys.meant(scene["task"], {"enum": known})
        source.blame(("scene", "task"), f"got {keys.shown(scene['task'])}, {expected}{hint}")
    source.stop_if_wrong()
    return str(source.tree["scene"]["task"])


def _open_empty_sections(value: Any, schema: dict[str, Any], path: Location) -> Any:
    """The tree with {} for sections that hold nothing (`label:` and no more): YAML reads those as null."""
    if value is None and keys.is_section(keys.at(schema, path)):
        return {}
    if not isinstance(value, dict):
        return value
    return {name: _open_empty_sections(item, schema, (*path, name)) for name, item in value.items()}


def _explain(source: Source, tree: Any, schema: dict[str, Any], error: Any) -> None:
    """Notes one of pydantic's errors as a problem in our words."""
    path, typed, found = _written_path(tree, error["loc"])
    here = keys.at(schema, typed)
    if error["type"] == "extra_forbidden":
        source.blame(path, f"unknown key, {keys.known_name(typed, schema)}")
    elif error["type"] == "missing":
        path = error["loc"]
        source.blame(path, f"missing, expected {keys.allowed(keys.at(schema, path), schema)}")
    elif error["type"] == "value_error":
        source.blame(path, str(error["ctx"]["error"]))
    else:
        source.blame(path, f"got {keys.shown(found)}, expected {keys.allowed(here, schema)}{keys.meant(found, here)}")


def _written_path(tree: Any, loc: Location) -> tuple[Location, Location, Any]:
    """The part of pydantic's location that was written down, the same with the tasks of scenes in a list, and the value there.

    Pydantic adds the names of union members.
    """
    path: Location = ()
    typed: Location = ()
    for part in loc:
        if isinstance(tree, dict) and part not in tree and tree.get("task") == part:
            typed = (*typed, part)
            continue
        try:
            tree = tree[part]
        except (KeyError, IndexError, TypeError):
            break
        path, typed = (*path, part), (*typed, part)
    return path, typed, tree


# Writing ---------------------------------------------------------------------------------------------------


def starter(task: str) -> str:
    """A commented recipe for a task, every key at its default; it loads again as it is.

    Raises:
        UsageError: for a task that does not exist.
    """
    if task not in tasks.names():
        raise UsageError(f"task: got '{task}', expected one of {', '.join(tasks.names())}{hint(task, tasks.names())}")
    model = recipe_class(task)
    header = [
        f"# {summary(task)}",
        "# Every key is at its default: leave out what you do not change. Metres, radians, kilograms, seconds.",
    ]
    return "\n".join([*header, *_commented(model.model_validate({"name": task}), model.model_json_schema(), ())]) + "\n"


def summary(task: str) -> str:
    """The first line of a task's docstring."""
    return str(tasks.load(task).__doc__ or task).strip().split("\n")[0]


def _commented(section: BaseModel, schema: dict[str, Any], path: Location) -> Iterator[str]:
    """The YAML lines of a section, each key with its sentence and what it may hold."""
    pad = "  " * len(path)
    for name in type(section).model_fields:
        value, here = getattr(section, name), keys.at(schema, (*path, name))
        if isinstance(value, BaseModel):
            yield from ([""] if not path else [])
            yield f"{pad}{name}:  # {keys.sentence(here)}"
            yield from _commented(value, schema, (*path, name))
        else:
            yield f"{pad}{name}: {_yaml(value)}  # {keys.sentence(here)} ({keys.allowed(here, schema)})"


def _yaml(value: Any) -> str:
    """A value in YAML: JSON, but words without quotes; of scenes in a list, what was written of them."""
    if isinstance(value, str) and re.fullmatch(r"[a-z]\w+", value):
        return value
    return json.dumps(value, default=lambda scene: scene.model_dump(mode="json", exclude_unset=True))
