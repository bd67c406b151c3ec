"""Unit keys: what decides a result is in them, and nothing else is."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
import toy_stages

from dapdata import durable, recipe, split, stages
from dapdata.config import SplitConfig


def keys(demos: int = 6, shard_size: int = 3, number: int = 0, **changes: object) -> dict[str, str]:
    resolved = recipe.resolve(toy_stages.toy_recipe(demos, shard_size, **changes))
    unit = stages.units(demos, shard_size)[number]
    return stages.unit_keys(stages.specs(toy_stages.STAGES, resolved), resolved["seed"], unit)


def changed(before: dict[str, str], after: dict[str, str]) -> list[str]:
    return [name for name in before if before[name] != after[name]]


def test_eps_place_changes_label_alone() -> None:
    assert changed(keys(), keys(label={"eps_place": 0.02})) == ["label"]


def test_noise_changes_observe_and_what_follows() -> None:
    assert changed(keys(), keys(noise={"preset": "none"})) == ["observe", "cluster", "label"]


def test_superpoints_change_cluster_and_label() -> None:
    assert changed(keys(), keys(superpoints={"count": 100})) == ["cluster", "label"]


@pytest.mark.parametrize("change", [{"seed": 6}, {"placement": {"mass": 0.4}}])
def test_what_is_upstream_of_all_changes_all(change: dict[str, object]) -> None:
    assert len(changed(keys(), keys(**change))) == 4


@pytest.mark.parametrize("change", [{"demos": 60}, {"name": "other"}, {"train": {"minutes": 5.0}}, {"split": {"val": 0.3}}])
def test_what_decides_no_result_changes_no_key(change: dict[str, object]) -> None:
    assert changed(keys(), keys(**change)) == []


def test_a_version_is_part_of_the_key() -> None:
    resolved, unit = recipe.resolve(toy_stages.toy_recipe()), stages.Unit(0, 0, 3)
    raised = [replace(stage, version=2) if stage.name == "cluster" else stage for stage in toy_stages.STAGES]
    old, new = (stages.unit_keys(stages.specs(table, resolved), 5, unit) for table in (toy_stages.STAGES, raised))
    assert changed(old, new) == ["cluster", "label"]


def test_a_key_is_the_digest_of_all_that_it_follows_from() -> None:
    resolved, unit = recipe.resolve(toy_stages.toy_recipe(60, 20)), stages.Unit(1, 20, 40)
    plan, expected = stages.specs(toy_stages.STAGES, resolved), {}
    for name, spec in plan.items():
        rest = {"format": 1, "stage": name, **{part: spec[part] for part in ("version", "sections", "packages")}}
        upstream = {need: expected[need] for need in spec["needs"]}
        expected[name] = durable.digest({**rest, "seed": 5, "demos": [20, 40], "upstream": upstream})
    assert stages.unit_keys(plan, 5, unit) == expected


def test_units_cover_the_demos_once() -> None:
    found = stages.units(10, 4)
    assert [(unit.start, unit.stop) for unit in found] == [(0, 4), (4, 8), (8, 10)]


def test_a_partial_shard_never_has_the_path_of_a_full_one(tmp_path: Path) -> None:
    plan = stages.specs(toy_stages.STAGES, recipe.resolve(toy_stages.toy_recipe()))
    layout = stages.Layout(tmp_path, plan, 5, 4, "label")
    paths = {layout.path("label", stages.Unit(2, 8, stop)) for stop in (9, 10, 12)}
    assert len(paths) == 3


def test_changes_name_the_key_and_both_values() -> None:
    old, new = (
        stages.specs(toy_stages.STAGES, recipe.resolve(toy_stages.toy_recipe(noise={"preset": preset})))["observe"]
        for preset in ("none", "d415")
    )
    assert stages.changes(old, new) == ["noise.preset none -> d415"]


# Splits ----------------------------------------------------------------------------------------------------

SHARES = SplitConfig(val=0.1, test=0.2)


def assigned(rows: list[tuple[int, int, int]], seed: int) -> dict[int, str]:
    """The split of each demo of (demo, container instance, object instance)."""
    columns = np.array(rows, dtype=np.int64).reshape(-1, 3).T
    return dict(zip(columns[0].tolist(), split.assign(*columns, SHARES, seed).tolist()))


def distinct(demos: int) -> list[tuple[int, int, int]]:
    return [(demo, 1000 + demo, 2000 + demo) for demo in range(demos)]


def test_a_longer_dataset_begins_with_the_splits_of_a_shorter_one() -> None:
    long = assigned(distinct(95), 7)
    for demos in (1, 9, 10, 33):
        assert assigned(distinct(demos), 7) == {demo: long[demo] for demo in range(demos)}


def test_splits_have_their_shares() -> None:
    wanted = list(islice(split.wanted(SHARES, 3), 1000))
    assert [wanted.count(name) for name in split.SPLITS] == [700, 100, 200]
    odd = list(islice(split.wanted(SplitConfig(val=0.03, test=0.05), 3), 1000))
    assert [odd.count(name) for name in split.SPLITS] == [920, 30, 50]


def test_no_instance_is_in_two_splits() -> None:
    shared = [(demo, demo % 23, demo % 17 if demo % 3 else 500 + demo) for demo in range(300)]
    splits = assigned(shared, 1)
    for column in (1, 2):
        owners: dict[int, set[str]] = {}
        for row in shared:
            if splits[row[0]] != split.UNUSED:
                owners.setdefault(row[column], set()).add(splits[row[0]])
        assert all(len(names) == 1 for names in owners.values())


def test_distinct_instances_are_named_once_and_ascending() -> None:
    values = np.array([5, 3, 5, -1, 3, 3], dtype=np.int64)
    assert split.distinct(values).tolist() == [-1, 3, 5]
    assert split.distinct(values[:0]).tolist() == []


def test_a_demo_between_two_splits_is_unused() -> None:
    wishes = list(islice(split.wanted(SHARES, 1), 10))
    train, test = wishes.index("train"), wishes.index("test")
    rows = [*sorted([(train, 1, 11), (test, 2, 22)]), (10, 1, 22)]
    assert assigned(rows, 1)[10] == split.UNUSED


@pytest.mark.parametrize("instances", [3, 40, 10**9])
def test_splits_are_those_of_going_through_the_demos_one_by_one(instances: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(split, "BUFFER", 7)
    random = np.random.default_rng(instances)
    rows = [(demo, *random.integers(0, instances, 2).tolist()) for demo in range(100) if random.random() < 0.9]
    wishes, owners, expected = list(islice(split.wanted(SHARES, 3), 100)), {}, {}
    for demo, container, thing in rows:
        known = {owners[name] for name in (("container", container), ("object", thing)) if name in owners}
        expected[demo] = split.UNUSED if len(known) == 2 else next(iter(known), wishes[demo])
        if len(known) < 2:
            owners["container", container] = owners["object", thing] = expected[demo]
    assert assigned(rows, 3) == expected
