"""A bad recipe never starts work: exit code 2, nothing written, and a line that says where, what, what instead."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from test_recipe import LEAVES, SCHEMA, full_tree, mutations, place

from dapdata import cli, keys

SCENE = "scene:\n  task: can_cabinet\n"
FIXED = {  # below SCENE, so that the first line is number 3: what is said after "x.yaml:"
    "seed: -1": "3: seed: got -1, expected a whole number, 0 to 4294967295",
    "seed: 1e3": "3: seed: got 1000.0, expected a whole number, 0 to 4294967295",
    "seed: '7'": "3: seed: got '7', expected a whole number, 0 to 4294967295",
    "seed: null": "3: seed: got nothing, expected a whole number, 0 to 4294967295",
    "seed: [1]": "3: seed: got [1], expected a whole number, 0 to 4294967295",
    "sed: 1": "3: sed: unknown key, did you mean 'seed'?",
    "demos: 1.5": "3: demos: got 1.5, expected a whole number, 1 to 10000000",
    "demos: many": "3: demos: got 'many', expected a whole number, 1 to 10000000",
    "demos: 20000000": "3: demos: got 20000000, expected a whole number, 1 to 10000000",
    "demo: 3": "3: demo: unknown key, did you mean 'demos'?",
    "shard_size: 0": "3: shard_size: got 0, expected a whole number, 1 to 100000",
    "shardsize: 5": "3: shardsize: unknown key, did you mean 'shard_size'?",
    "name: My Cabinet": "3: name: got 'My Cabinet', expected text matching ^[a-z0-9][a-z0-9_-]*$",
    "name: ../up": "3: name: got '../up', expected text matching ^[a-z0-9][a-z0-9_-]*$",
    "name: 3": "3: name: got 3, expected text matching ^[a-z0-9][a-z0-9_-]*$",
    "  shelves: [3, 2]": "3: scene.shelves: got [3, 2], expected [lowest, highest]",
    "  width: 0.5": "3: scene.width: got 0.5, expected a list of 2, each 0.001 to 2 m",
    "  width: [0.5]": "3: scene.width",
    "  width: [300, 1]": "3: scene.width[0]: got 300, expected 0.001 to 2 m; did you mean 0.3?",
    "  width: [0.3, .inf]": "3: scene.width[1]: got Infinity, expected 0.001 to 2 m",
    "  wdith: [0.3, 0.5]": "3: scene.wdith: unknown key, did you mean 'width'?",
    "  colour: red": "3: scene.colour: unknown key",
    "placement:\n  mass: 0": "4: placement.mass: got 0, expected a number, above 0 kg and at most 100 kg",
    "placement:\n  mass: heavy": "4: placement.mass: got 'heavy', expected a number, above 0 kg and at most 100 kg",
    "placement:\n  friction: -0.1": "4: placement.friction: got -0.1, expected 0 to 10",
    "placement:\n  max_shift: 20": "4: placement.max_shift: got 20, expected a number, above 0 m and at most 0.5 m; did",
    "placement:\n  max_turn_deg: 181": "4: placement.max_turn_deg: got 181, expected a number, above 0 deg and at most 180 deg",
    "placement:\n  max_speed: .nan": "4: placement.max_speed: got NaN, expected a number, above 0 m/s and at most 1 m/s",
    "placement:\n  settle_seconds: 0": "4: placement.settle_seconds: got 0, expected 0.05 to 10 s",
    "placement: fast": "3: placement: got 'fast', expected a section with mass, friction",
    "placment: {}": "3: placment: unknown key, did you mean 'placement'?",
    "cameras:\n  width: 16": "4: cameras.width: got 16, expected a whole number, 32 to 1920 px",
    "cameras:\n  width: 320.5": "4: cameras.width: got 320.5, expected a whole number, 32 to 1920 px",
    "cameras:\n  vfov_deg: 0.9": "4: cameras.vfov_deg: got 0.9, expected 10 to 120 deg",
    "cameras:\n  container_views: 0": "4: cameras.container_views: got 0, expected a whole number, 1 to 32",
    "cameras:\n  container_distance: 850": "4: cameras.container_distance: got 850, expected 0.2 to 10 m; did you mean 0.85?",
    "cameras:\n  container_voxel: 8": "4: cameras.container_voxel: got 8, expected 0.001 to 0.1 m; did you mean 0.008?",
    "cameras:\n  align: maybe": "4: cameras.align: got 'maybe', expected true or false",
    "cameras:\n  align: 1": "4: cameras.align: got 1, expected true or false",
    "cameras:\n  heigth: 240": "4: cameras.heigth: unknown key, did you mean 'height'?",
    "preset: kinect": "3: preset: unknown key, did you mean 'noise.preset'?",
    "noise:\n  preset: D415": "4: noise.preset: got 'D415', expected one of none, d415, kinect; did you mean 'd415'?",
    "noise:\n  preset: 415": "4: noise.preset: got 415, expected one of none, d415, kinect",
    "noise:\n  camera_translation: 2": "4: noise.camera_translation: got 2, expected 0 to 0.05 m or null",
    "noise: [none]": '3: noise: got ["none"], expected a section with preset, camera_translation, camera_rotation_deg',
    "superpoints:\n  count: 0": "4: superpoints.count: got 0, expected a whole number, 1 to 20000",
    "superpoints:\n  method: silc": "4: superpoints.method: got 'silc', expected one of slic, voxel; did you mean 'slic'?",
    "label:\n  eps_corr: 50": "4: label.eps_corr: got 50, expected 0.001 to 0.2 m; did you mean 0.05?",
    "label:\n  eps_place: 3": "4: label.eps_place: got 3, expected 0.001 to 0.2 m; did you mean 0.03?",
    "label:\n  eps-place: 0.03": "4: label.eps-place: unknown key, did you mean 'eps_place'?",
    "split:\n  val: 0.6": "4: split.val: got 0.6, expected 0 to 0.5",
    "split:\n  tests: 0.1": "4: split.tests: unknown key, did you mean 'test'?",
    "train:\n  minutes: 0": "4: train.minutes: got 0, expected a number, above 0 min and at most 100000 min",
    "train:\n  width: 63": "3: train: heads: got 2, expected a divisor of width (63)",
    "train:\n  refine: [jump]": "4: train.refine[0]: got 'jump', expected one of",
    "train:\n  preset: papr": "4: train.preset: got 'papr', expected one of default, paper; did you mean 'paper'?",
    "eval:\n  k: 0": "4: eval.k: got 0, expected a whole number, 1 to 1024",
    "eval:\n  k: 9\n  draws: 4": "3: eval: draws: got 4, expected at least k (9), or null for as many",
    "eval:\n  protocol: strikt": (
        "4: eval.protocol: got 'strikt', expected one of strict, rpdiff, shown; did you mean 'strict'?"
    ),
    "label: {eps_place: 0.03}\nlabel: {}": "4: label: given twice, first at line 3, expected once; remove one",
    "label:\n\teps_place: 0.03": "4: not YAML",
    "label:\n  eps_place: *eps": "4: anchors and aliases (& and *) are not read, expected each value written out",
}  # fmt: skip


def refused(folder: Path, text: str, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What `dapdata generate` says of a recipe; it must end with 2 and write nothing."""
    (folder / "x.yaml").write_text(text)
    before = sorted(folder.rglob("*"))
    capsys.readouterr()
    assert cli.run_app(["generate", "x.yaml", "--engine", "inline"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "Traceback" not in err
    assert sorted(folder.rglob("*")) == before
    return err.splitlines()


def test_there_are_sixty_fixed_mistakes() -> None:
    assert len(FIXED) >= 60


@pytest.mark.parametrize("text", FIXED)
def test_a_mistake_is_refused_with_where_what_and_what_instead(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = refused(tmp_path, f"{SCENE}{text}\n", capsys)
    assert len(lines) == 1
    assert lines[0].startswith(f"x.yaml:{FIXED[text]}")


def says_it_all(line: str, path: keys.Location, kind: str, value: Any, number: int) -> None:
    """File, line, key; then for an unknown key the nearest names, else the value and what it may be."""
    where = f"x.yaml:{number}: {keys.dotted(path)}"
    assert line.startswith(where), line
    if kind == "unknown":
        assert re.search(r"unknown key, (did you mean '|known: )", line), line
    elif re.match(re.escape(where) + r"(\[\d+\])?: got ", line):
        assert ", expected " in line
        expected = "a section" if kind == "section" else keys.allowed(keys.at(SCHEMA, path), SCHEMA)
        expected = "one of " if path == ("scene", "task") else expected  # the schema is that of one of them
        assert f"got {keys.shown(value)}, expected {expected}" in line or "[" in line, line


def mutated(mutation: tuple[str, keys.Location, Any], folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kind, path, value = mutation
    tree = full_tree()
    place(tree, path)[path[-1]] = value
    text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=10_000)
    lines = refused(folder, text, capsys)
    numbered = text.split("\n")
    told = [line for line in lines if f": {keys.dotted(path)}" in line]
    assert told, lines
    number = int(told[0].split(":")[1])
    assert str(path[-1]) in numbered[number - 1]
    says_it_all(told[0], path, kind, value, number)


FIXTURES = [HealthCheck.function_scoped_fixture]


@settings(max_examples=60, deadline=None, derandomize=True, suppress_health_check=FIXTURES)
@given(mutation=mutations())
def test_one_wrong_thing_in_a_valid_recipe_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    mutation: tuple[str, keys.Location, Any],
) -> None:
    monkeypatch.chdir(tmp_path)
    mutated(mutation, tmp_path, capsys)


@pytest.mark.slow
@settings(max_examples=500, deadline=None, suppress_health_check=FIXTURES)
@given(mutation=mutations())
def test_one_wrong_thing_in_five_hundred_valid_recipes_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    mutation: tuple[str, keys.Location, Any],
) -> None:
    monkeypatch.chdir(tmp_path)
    mutated(mutation, tmp_path, capsys)


def test_every_key_was_there_to_be_spoilt() -> None:
    assert len(LEAVES) > 90
