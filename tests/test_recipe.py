"""Recipes: what is refused, and how the refusal reads."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import strategies as st

from dapdata import keys, recipe, tasks
from dapdata.config import PAPER
from dapdata.errors import RecipeError, UsageError

NAMES = ", ".join(tasks.names())
SCENE = "scene:\n  task: can_cabinet\n"
SCHEMA = recipe.recipe_class("can_cabinet").model_json_schema()
LEAVES = {path: body for path, body in keys.walk(SCHEMA) if not keys.is_section(body)}
SECTIONS = [path for path, body in keys.walk(SCHEMA) if keys.is_section(body)]


def write(folder: Path, text: str) -> Path:
    path = folder / "x.yaml"
    path.write_text(text)
    return path


def complaint(folder: Path, text: str, *overrides: str) -> list[str]:
    """The lines of the error, with the folder taken out."""
    with pytest.raises(RecipeError) as caught:
        recipe.load(write(folder, text), overrides)
    return str(caught.value).replace(f"{folder}/", "").split("\n")


CASES = {
    "label:\n  eps_place: 30": "x.yaml:4: label.eps_place: got 30, expected 0.001 to 0.2 m; did you mean 0.03?",
    "label:\n  eps_plaec: 0.03": "x.yaml:4: label.eps_plaec: unknown key, did you mean 'eps_place'?",
    "eps_place: 0.03": "x.yaml:3: eps_place: unknown key, did you mean 'label.eps_place'?",
    "label: 3": "x.yaml:3: label: got 3, expected a section with eps_place, eps_corr, kind",
    "label:\n  eps_place: .nan": "x.yaml:4: label.eps_place: got NaN, expected 0.001 to 0.2 m",
    "label:\n  eps_place: '0.03'": "x.yaml:4: label.eps_place: got '0.03', expected 0.001 to 0.2 m",
    "label:\n  eps_place: yes": "x.yaml:4: label.eps_place: got 'yes', expected 0.001 to 0.2 m",
    "label:\n  eps_place: true": "x.yaml:4: label.eps_place: got true, expected 0.001 to 0.2 m",
    "label:\n  eps_place:": "x.yaml:4: label.eps_place: got nothing, expected 0.001 to 0.2 m",
    "label:\n  kind: hrad": "x.yaml:4: label.kind: got 'hrad', expected one of hard, soft; did you mean 'hard'?",
    "seed: 1\nseed: 2": "x.yaml:4: seed: given twice, first at line 3, expected once; remove one",
    "seed: 1.5": "x.yaml:3: seed: got 1.5, expected a whole number, 0 to 4294967295",
    "demos: 0": "x.yaml:3: demos: got 0, expected a whole number, 1 to 10000000",
    "noise:\n  preset: kinekt": (
        "x.yaml:4: noise.preset: got 'kinekt', expected one of none, d415, kinect; did you mean 'kinect'?"
    ),
    "cameras: {width: 100000}": "x.yaml:3: cameras.width: got 100000, expected a whole number, 32 to 1920 px",
    "? [a]\n: 1": "x.yaml:3: ?: the key is no word, expected `name: value`",
    "a: &b 1": "x.yaml:3: anchors and aliases (& and *) are not read, expected each value written out",
    "a: *b": "x.yaml:3: anchors and aliases (& and *) are not read, expected each value written out",
    "a: !!python/object/apply:os.getcwd []": (
        "x.yaml:3: the tag tag:yaml.org,2002:python/object/apply:os.getcwd is not read, expected plain values"
    ),
    "a: " + "[" * 99: "x.yaml:3: nested deeper than 16, expected sections of a recipe",
}


@pytest.mark.parametrize("text", CASES)
def test_each_kind_of_mistake_is_one_line_that_says_where_what_and_what_instead(text: str, tmp_path: Path) -> None:
    assert complaint(tmp_path, SCENE + text) == [CASES[text]]


IN_A_LIST = {
    "- {task: can_cabinet, widht: [0.3, 0.4]}": "scene.scenes[0].widht: unknown key, did you mean 'width'?",
    "- {task: can_cabinet, width: [0.4, 0.3]}": "scene.scenes[0].width: got [0.4, 0.3], expected [lowest, highest]",
    "- {task: book_shelf}\n    - {task: vial_rack, clearance: 3}": (
        "scene.scenes[1].clearance: got 3, expected a list of 2, each 0 to 2 m"
    ),
    "- {task: mixed}": "scene.scenes[0]: got a section, expected a section with `task:` one of ",
    "- {start: any}": "scene.scenes[0]: got a section, expected a section with `task:` one of ",
}


@pytest.mark.parametrize("text", IN_A_LIST)
def test_a_mistake_in_a_list_of_scenes_is_told_where_it_is(text: str, tmp_path: Path) -> None:
    (line,) = complaint(tmp_path, f"scene:\n  task: mixed\n  scenes:\n    {text}\n")
    assert line.startswith(f"x.yaml:{4 + text.count(chr(10))}: {IN_A_LIST[text]}")


def test_shares_of_a_split_may_be_the_whole_and_no_more(tmp_path: Path) -> None:
    whole = recipe.load(write(tmp_path, SCENE + "split: {val: 0.0, test: 1.0}"))
    assert whole.split.test == 1
    (line,) = complaint(tmp_path, SCENE + "split: {val: 0.3, test: 0.8}")
    assert line == "x.yaml:3: split: test: got 0.8 beside val 0.3, expected no more than 1 together; lower one"


@pytest.mark.parametrize(
    ("text", "start"),
    [
        ("", "x.yaml: empty, expected a recipe"),
        ("# only this\n", "x.yaml: no mapping, expected sections"),
        ("- a\n", "x.yaml:1: no mapping, expected sections"),
        ("a: b: c\n", "x.yaml:1: not YAML: mapping values are not allowed here"),
        ("name: x\n", f"x.yaml:1: scene: missing, expected a section with `task:` one of {NAMES}"),
        ("scene: {}\n", f"x.yaml:1: scene.task: missing, expected one of {NAMES}"),
        ("scene:\n  task: can_cabinett\n", f"x.yaml:2: scene.task: got 'can_cabinett', expected one of {NAMES}"),
        ("a: " + "x" * 300_000, "x.yaml: has more than 256000 bytes"),
        ("a: \x00", "x.yaml: not YAML"),
    ],
)
def test_a_file_that_is_no_recipe_is_refused(text: str, start: str, tmp_path: Path) -> None:
    (line,) = complaint(tmp_path, text)
    assert line.startswith(start)


def test_an_unreadable_file_is_refused(tmp_path: Path) -> None:
    for path, why in ((tmp_path, "a folder"), (tmp_path / "none.yaml", "No such file")):
        with pytest.raises(RecipeError, match=why):
            recipe.load(path)
    (tmp_path / "latin.yaml").write_bytes(b"name: caf\xe9\n")
    with pytest.raises(RecipeError, match="not UTF-8"):
        recipe.load(tmp_path / "latin.yaml")


def test_all_mistakes_are_named_at_once_in_the_order_of_the_file(tmp_path: Path) -> None:
    lines = complaint(tmp_path, "seed: -1\n" + SCENE + "  colour: red\nlabel:\n  eps_place: 1\n  kind: x\n")
    assert [line.split(": ")[1] for line in lines] == ["seed", "scene.colour", "label.eps_place", "label.kind"]


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("label.eps_place=30", "label.eps_place: got 30, expected 0.001 to 0.2 m; did you mean 0.03?"),
        ("label={eps_place: 30}", "label.eps_place: got 30, expected 0.001 to 0.2 m; did you mean 0.03?"),
        ("label.eps_place", "expected KEY=VALUE, such as --set label.eps_place=0.02"),
        ("seed.x=3", "seed is no section, expected a key such as label.eps_place"),
        ("scene.task=mug", f"scene.task: got 'mug', expected one of {NAMES}; did you mean 'mug_rack'?"),
    ],
)
def test_an_override_is_checked_like_the_file(override: str, line: str, tmp_path: Path) -> None:
    assert complaint(tmp_path, SCENE + "seed: 1\nlabel: {eps_place: 0.02}\n", override) == [f"--set {override}: {line}"]


def test_overrides_change_what_they_name_and_nothing_else(tmp_path: Path) -> None:
    path = write(tmp_path, SCENE + "label: {eps_corr: 0.04}\n")
    changed = recipe.load(path, ["label.eps_place=0.02", "noise.preset=none", "seed=7"])
    plain = recipe.resolve(recipe.load(path))
    plain["label"]["eps_place"], plain["noise"]["preset"], plain["seed"] = 0.02, "none", 7
    assert recipe.resolve(changed) == plain


def test_numbers_lists_and_empty_sections_read_as_people_write_them(tmp_path: Path) -> None:
    read = recipe.load(write(tmp_path, SCENE + "  width: [0.3, 1]\nlabel:\n  eps_place: 2e-2\nsplit:\ntrain: {minutes: 3}\n"))
    assert read.label.eps_place == 0.02
    assert read.scene.model_dump()["width"] == (0.3, 1.0)
    assert isinstance(read.train.minutes, float)


def test_a_recipe_without_a_name_takes_that_of_its_file(tmp_path: Path) -> None:
    assert recipe.load(write(tmp_path, SCENE)).name == "x"


@pytest.mark.parametrize("task", tasks.names())
def test_a_starter_recipe_loads_again_and_is_all_defaults(task: str, tmp_path: Path) -> None:
    read = recipe.load(write(tmp_path, recipe.starter(task)))
    assert read == recipe.recipe_class(task)(name=task)


def test_a_starter_of_an_unknown_task_names_the_known_ones() -> None:
    with pytest.raises(UsageError, match=rf"expected one of {NAMES}; did you mean 'can_cabinet'\?"):
        recipe.starter("cancabinet")


@pytest.mark.parametrize("task", tasks.names())
def test_a_resolved_recipe_comes_back_equal(task: str) -> None:
    made = recipe.recipe_class(task)(name="a", seed=3)
    assert recipe.from_resolved(recipe.resolve(made)) == made


@pytest.mark.parametrize("task", tasks.names())
def test_every_key_has_a_default_a_sentence_and_a_range(task: str) -> None:
    schema = recipe.recipe_class(task).model_json_schema()
    for path, body in keys.walk(schema):
        assert len(keys.sentence(body)) > 5, path
        assert "default" in body, path
        assert keys.allowed(body, schema) != "a value", path


@pytest.mark.parametrize("path", sorted(Path(__file__).parents[1].glob("recipes/**/*.yaml")), ids=lambda p: p.stem)
def test_every_shipped_recipe_loads(path: Path) -> None:
    assert recipe.load(path).scene.task in tasks.names()


# One mutation of a valid recipe (for test_mistakes.py) -------------------------------------------------------


def full_tree() -> Any:
    return recipe.resolve(recipe.recipe_class("can_cabinet")(name="full"))


def place(tree: Any, path: keys.Location) -> Any:
    for part in path[:-1]:
        tree = tree[part]
    return tree


def wrong_values(body: dict[str, Any]) -> list[Any]:
    """Values that no key with this schema takes."""
    wrong: list[Any] = [math.nan, math.inf, {"a": 1}, "certainly not"]
    if body.get("type") in ("integer", "number"):
        wrong += [body[name] - 1 for name in ("minimum", "exclusiveMinimum") if name in body]
        wrong += [body[name] + 1 for name in ("maximum", "exclusiveMaximum") if name in body]
        wrong += [True, "3", [1]]
    if body.get("type") == "integer":
        wrong += [1.5]
    if body.get("type") == "array":
        wrong += [3, [], ["a", "b"]]
    if "pattern" in body:
        wrong = [wrong[2], "Not A Slug", "", 3]
    return wrong


@st.composite
def mutations(draw: st.DrawFn) -> tuple[str, keys.Location, Any]:
    kind = draw(st.sampled_from(["value", "unknown", "section"]))
    if kind == "unknown":
        section = draw(st.sampled_from([(), *SECTIONS]))
        return kind, (*section, draw(st.from_regex(r"x[a-z]{2,8}_q", fullmatch=True))), 1
    if kind == "section":
        return kind, draw(st.sampled_from(SECTIONS)), draw(st.sampled_from([3, "text", [1]]))
    path = draw(st.sampled_from(sorted(LEAVES)))
    return kind, path, draw(st.sampled_from(wrong_values(LEAVES[path])))


def test_a_preset_asked_of_a_dataset_takes_the_place_of_the_keys_it_sets() -> None:
    """`dapdata train DATASET --set train.preset=paper`: the dataset's recipe has every key written."""
    resolved = recipe.resolve(recipe.from_resolved({"scene": {"task": "can_cabinet"}, "train": {"width": 32}}))
    asked = recipe.from_resolved(resolved, ["train.sample_steps=7", "train.preset=paper"]).train
    assert {name: getattr(asked, name) for name in PAPER} == PAPER | {"sample_steps": 7}
    assert asked.width == 32
    back = recipe.from_resolved(
        recipe.resolve(recipe.from_resolved(resolved, ["train.preset=paper"])), ["train.preset=default"]
    )
    assert recipe.resolve(back) == resolved
    assert recipe.from_resolved(resolved, ["train.mirror=false"]).train.prediction == "x0"
