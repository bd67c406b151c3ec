"""The numbers of a report: against known values, brute force and properties; and the predictions file."""

from __future__ import annotations

import io
import json
import zipfile
from contextlib import suppress
from dataclasses import replace
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dapdata import loading, matching, metrics, predictions, report
from dapdata.errors import CorruptionError, FormatError, UsageError
from dapdata.poses import pose, random_rotation, rotation_about
from dapdata.predictions import Predictions
from dapdata.records import PART_KINDS, Placement, Verdict

BOX = np.array([[0.18, 0.04, 0.24]])
CAN = np.array([[0.06, 0.06, 0.10]])
Z = np.array([0.0, 0.0, 1.0])
seeds = st.integers(0, 2**32 - 1)


def points_of(kind: str) -> np.ndarray:
    code, size = (PART_KINDS.index("cylinder"), CAN) if kind == "revolution" else (PART_KINDS.index("box"), BOX)
    return matching.hull_points(np.array([code]), size, np.eye(4)[None])


def some_poses(seed: int, count: int, spread: float = 0.05) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([pose(random_rotation(rng), rng.normal(size=3) * spread) for _ in range(count)])


# Statistics ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("successes", "number", "low", "high"),
    [
        (94, 100, 0.8752, 0.9722),
        (98, 100, 0.9300, 0.9945),
        (0, 10, 0.0, 0.2775),
        (10, 10, 0.7225, 1.0),
        (5, 10, 0.2366, 0.7634),
    ],
)
def test_wilson_gives_the_published_intervals(successes: int, number: int, low: float, high: float) -> None:
    assert metrics.wilson(successes, number) == pytest.approx((low, high), abs=1e-4)


@given(st.integers(1, 500), st.data())
def test_wilson_holds_its_rate_and_stays_in_range(number: int, data: st.DataObject) -> None:
    successes = data.draw(st.integers(0, number))
    low, high = metrics.wilson(successes, number)
    assert -1e-12 <= low <= successes / number + 1e-12
    assert successes / number - 1e-12 <= high <= 1 + 1e-12


def test_wilson_reaches_the_ends_exactly() -> None:
    assert all(metrics.wilson(0, number)[0] == 0 and metrics.wilson(number, number)[1] == 1 for number in range(1, 200))


def test_bootstrap_is_repeatable_and_about_as_wide_as_the_standard_error() -> None:
    values = np.random.default_rng(0).random(400)
    low, high = metrics.bootstrap(values)
    assert (low, high) == metrics.bootstrap(values)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)


@pytest.mark.parametrize(("only_a", "only_b", "p"), [(0, 0, 1.0), (5, 5, 1.0), (10, 0, 2 / 2**10), (8, 2, 2 * 56 / 2**10)])
def test_mcnemar_is_the_exact_two_sided_sign_test(only_a: int, only_b: int, p: float) -> None:
    assert report.mcnemar(only_a, only_b) == pytest.approx(p)
    assert report.mcnemar(only_b, only_a) == pytest.approx(p)


# Distances -------------------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(seeds, st.sampled_from(["none", "box", "revolution"]))
def test_surface_distance_does_not_change_when_the_world_moves_or_the_roles_are_swapped(seed: int, kind: str) -> None:
    a, b, points = some_poses(seed, 3), some_poses(seed + 1, 2), points_of(kind)
    T = some_poses(seed + 2, 1, 1.0)[0]
    d = matching.surface_distance(a, b, points, kind, Z)
    assert matching.surface_distance(T @ a, T @ b, points, kind, Z) == pytest.approx(d, abs=1e-9)
    assert (
        pytest.approx(d, rel=0.2 if kind == "revolution" else 1e-9, abs=1e-9)
        == matching.surface_distance(b, a, points, kind, Z).T
    )


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(-3, 3))
def test_surface_distance_is_zero_between_symmetric_copies(seed: int, turn: float) -> None:
    T = some_poses(seed, 1)
    flip = pose(rotation_about((1, 0, 0), np.pi))
    spun = T @ pose(rotation_about(Z, turn)) @ flip
    assert matching.surface_distance(T, spun, points_of("revolution"), "revolution", Z) == pytest.approx(0, abs=1e-7)
    assert matching.surface_distance(T, T @ flip, points_of("box"), "box", Z) == pytest.approx(0, abs=1e-9)
    assert matching.surface_distance(T, T @ flip, points_of("box"), "none", Z)[0, 0] > 0.1


@settings(max_examples=40, deadline=None)
@given(seeds)
def test_surface_distance_of_a_can_is_about_the_least_over_all_turns_and_flips(seed: int) -> None:
    rng = np.random.default_rng(seed)
    b = some_poses(seed, 1)
    a = b @ pose(rotation_about(rng.normal(size=3), rng.uniform(0, 0.6)), rng.normal(size=3) * 0.02)
    points = points_of("revolution")
    copies = np.stack(
        [
            b[0] @ pose(rotation_about(Z, turn)) @ flip
            for turn in np.deg2rad(np.arange(0, 360, 2))
            for flip in (np.eye(4), pose(rotation_about((1, 0, 0), np.pi)))
        ]
    )
    least = matching.surface_distance(a, copies, points, "none", Z).min()
    found = matching.surface_distance(a, b, points, "revolution", Z)[0, 0]
    assert least - 1e-3 <= found <= 1.15 * least + 1e-4  # the turn of the smallest rotation is nearly the best one


def test_surface_distance_of_a_shift_is_the_shift_and_of_a_turn_is_the_corner_s_way() -> None:
    shifted = np.stack([pose(translation=(0.003, 0.004, 0.0))])
    turned = np.stack([pose(rotation_about(Z, 0.1))])
    corner = np.hypot(0.09, 0.02) * 2 * np.sin(0.05)
    for kind, wanted in (("box", corner), ("revolution", 0.0)):
        assert matching.surface_distance(shifted, np.eye(4)[None], points_of(kind), kind, Z) == pytest.approx(0.005)
        assert matching.surface_distance(turned, np.eye(4)[None], points_of(kind), kind, Z) == pytest.approx(wanted, abs=1e-9)


def test_tolerance_and_tightness_follow_the_clearance() -> None:
    clearance = np.array([0.0, 0.004, 0.016, 0.5])
    assert matching.tolerance(clearance) == pytest.approx([0.002, 0.004, 0.010, 0.010])
    assert matching.is_tight(clearance, np.array([0, 0, 0, 1])).tolist() == [True, True, False, True]


# Modes -----------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 5), st.integers(1, 6))
def test_uniform_sampler_agrees_with_counting_every_outcome(modes: int, draws: int) -> None:
    outcomes = np.stack(np.meshgrid(*[np.arange(modes)] * draws, indexing="ij"), axis=-1).reshape(-1, draws)
    found = np.array([len(set(row.tolist())) for row in outcomes])
    entropy = np.mean([matching.mode_entropy(row, modes) for row in outcomes])
    assert matching.uniform_recall(modes, draws) == pytest.approx(found.mean() / modes)
    assert matching.uniform_all_found(modes, draws) == pytest.approx((found == modes).mean())
    assert matching.uniform_entropy(modes, draws) == pytest.approx(entropy)


def test_a_prediction_goes_to_the_nearest_mode_within_its_tolerance() -> None:
    distance = np.array([[0.003, 0.002], [0.009, 0.02], [0.02, 0.006]])
    assert matching.assign(distance, np.array([0.010, 0.005])).tolist() == [1, 0, -1]
    assert matching.assign(np.zeros((0, 2)), np.zeros(2)).tolist() == []


def test_entropy_is_one_when_even_and_zero_when_all_is_on_one_mode() -> None:
    assert matching.mode_entropy(np.array([0, 1, 2, 3]), 4) == pytest.approx(1)
    assert matching.mode_entropy(np.array([2, 2, -1]), 4) == 0
    assert matching.mode_entropy(np.array([-1, -1]), 4) == 0


def test_affordance_that_marks_one_mode_is_pure_and_that_spans_two_is_not() -> None:
    regions = np.array([[1, 1, 0, 0, 0], [0, 0, 1, 1, 0]], bool)
    assert matching.affordance_quality(np.array([1, 1, -1, -1, -1]), regions) == (1.0, 1.0)
    assert matching.affordance_quality(np.array([1, 1, 1, 1, -1]), regions) == (0.5, 0.5)
    assert matching.affordance_quality(-np.ones(5), regions) == (0.0, 0.0)


# Summaries -------------------------------------------------------------------------------------------------


def result(
    demo: int, successes: list[bool], distance: list[list[float]], tight: bool = True, rank: list[int] | None = None
) -> metrics.SceneResult:
    """A scene by hand: verdicts of the first candidates, distances (m) of all, whose ranks are given or have no gap."""
    verdicts = [Verdict(ok, "ok" if ok else "pushed", np.eye(4), 0.001, 0.01, 0.0, 0.0005, 0.0) for ok in successes]
    modes, number = len(distance[0]) if distance else 2, len(distance)
    apart = np.array(distance, float).reshape(number, modes)
    return metrics.SceneResult(
        demo,
        np.tile(np.eye(4), (number, 1, 1)),
        verdicts,
        apart,
        np.full((number, 2), 0.01),
        np.full(modes, 0.01),
        np.full(modes, tight),
        0.1,
        np.arange(number) if rank is None else np.array(rank),
        np.stack([apart < 0.035, apart < 0.04]),
        np.full(modes, 0.012),
    )


def test_a_scene_without_prediction_is_a_failure_in_every_rate() -> None:
    results = [result(0, [True, False], [[0.001, 0.1], [0.1, 0.001]]), result(1, [], [])]
    summary = metrics.summarise(results, 2, 2)
    for name in ("success_top1", "success_any_of_K", "success_precise", "success_near_goal", "success_tight"):
        assert getattr(summary.success, name).value == 0.5
        assert getattr(summary.success, name).n == 2
    assert summary.success.success_mean_of_K.value == summary.success.success_single.value == 0.25
    assert summary.success.failures == {"no_prediction": 1}
    assert summary.success.failures_all == {"no_prediction": 2, "pushed": 1}
    assert summary.modes.recall_at_K["1"].value == 0.25
    assert summary.modes.recall_at_K["2"].value == 0.5
    assert summary.modes.all_modes_found_at_K["2"].value == 0.5
    assert summary.modes.precision_at_K["2"].value == 0.5
    assert summary.modes.recall_share_at_K == {"1": 0.25 / 0.5, "2": 0.5 / 0.75}
    assert summary.modes.legacy_rpdiff.recall.value == summary.modes.legacy_rpdiff.precision.value == 0.5
    assert summary.geometry.collision_free.value == 0.5


def test_success_far_from_every_goal_is_not_near_a_goal() -> None:
    summary = metrics.summarise([result(0, [True], [[0.03, 0.1]])], 1, 1)
    assert summary.success.success_top1.value == 1
    assert summary.success.success_near_goal.value == summary.success.success_tight.value == 0
    assert summary.modes.sweep_mm["20"]["recall"] == 0
    assert summary.modes.sweep_mm["35"]["recall"] == 0.5


def test_success_at_tight_goals_is_of_the_best_candidate_that_heads_for_one() -> None:
    """Goal 0 is roomy, goal 1 is tight. Ranked first is the roomy one; what counts is how the first at the tight one does."""

    def figures(successes: list[bool], distance: list[list[float]]) -> tuple[float, float]:
        scene = replace(result(0, successes, distance), tight=np.array([False, True]))
        success = metrics.summarise([scene], len(successes), len(successes)).success
        return success.success_tight.value, success.success_top1_tight.value

    roomy, tight, beside = [0.001, 0.1], [0.1, 0.001], [0.1, 0.03]
    assert figures([True, True], [roomy, tight]) == (1, 0)
    assert figures([True, True], [tight, roomy]) == (1, 1)
    assert figures([True, False, True], [roomy, tight, tight]) == (0, 0)  # the second at the tight goal comes too late
    assert figures([True, True], [roomy, beside]) == (0, 0)  # heads for it and does not get there
    assert figures([True, True], [roomy, roomy]) == (0, 0)  # no candidate heads for it


def test_success_by_clearance_asks_for_the_goals_of_each_range_in_the_scenes_that_have_one() -> None:
    """Two goals, of 4 and 20 mm free play; the second scene has roomy ones alone, the third no prediction."""
    tight, roomy = [0.001, 0.1], [0.1, 0.001]
    scenes = [
        replace(result(0, [False, True], [tight, roomy]), clearance=np.array([0.004, 0.02])),
        replace(result(1, [True], [roomy]), clearance=np.array([0.02, 0.03])),
        replace(result(2, [], []), clearance=np.array([0.004, 0.02])),
    ]
    found = metrics.summarise(scenes, 2, 2).success.success_by_clearance_mm
    assert {name: (rate.value, rate.n) for name, rate in found.items()} == {"0-5": (0, 2), "15-30": (1 / 3, 3), "30-": (1, 1)}


def test_success_is_of_the_judged_and_modes_are_of_all_that_were_drawn() -> None:
    """Four candidates, of which two are judged: the first mode is found by the first, the others by those not judged."""
    far = 0.1
    distance = [[0.001, far, far], [far, far, far], [far, 0.001, far], [far, far, 0.001]]
    summary = metrics.summarise([result(0, [False, True], distance)], 2, 4)
    assert summary.success.success_top1.value == 0
    assert summary.success.success_any_of_K.value == 1
    assert summary.success.success_mean_of_K.value == 0.5
    assert {k: v.value for k, v in summary.modes.recall_at_K.items()} == pytest.approx({"1": 1 / 3, "2": 1 / 3, "4": 1})
    assert summary.modes.precision_at_K["4"].value == 0.75
    assert summary.modes.all_modes_found_at_K["4"].value == 1
    assert summary.modes.entropy.value == pytest.approx(1)
    assert summary.modes.uniform_recall_at_K["4"] == pytest.approx(matching.uniform_recall(3, 4))
    assert summary.modes.recall_share_at_K["4"] == pytest.approx(1 / matching.uniform_recall(3, 4))
    assert summary.modes.sweep_mm["10"] == {"recall": 1, "all_modes_found": 1, "precision": 0.75}


def test_a_candidate_without_a_pose_keeps_its_place_in_the_order() -> None:
    """Rank 0 and rank 3 found a mode each; ranks 1 and 2 have no pose and find nothing."""
    summary = metrics.summarise([result(0, [True], [[0.001, 0.1], [0.1, 0.001]], rank=[0, 3])], 2, 4)
    assert {k: v.value for k, v in summary.modes.recall_at_K.items()} == {"1": 0.5, "2": 0.5, "4": 1}
    assert {k: v.value for k, v in summary.modes.precision_at_K.items()} == {"1": 1, "2": 0.5, "4": 0.5}
    assert summary.success.failures_all == {"no_prediction": 1}


def test_recall_share_is_of_means_and_not_the_mean_of_shares() -> None:
    one, three = result(0, [True], [[0.001]]), result(1, [True], [[0.1, 0.1, 0.1]])
    modes = metrics.summarise([one, three], 1, 1).modes
    assert modes.recall_share_at_K["1"] == pytest.approx(((1 + 0) / 2) / ((1 + 1 / 3) / 2))


# RPDiff's coverage -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shift", "degrees", "recall", "precision"),
    [
        (0.0, 0.0, True, True),
        (0.0, 34.0, True, True),  # "5 degrees"
        (0.0, 34.7, False, False),
        (0.0, -34.0, True, True),
        (0.034, 20.0, True, True),
        (0.036, 0.0, False, True),
        (0.039, 34.0, False, True),
        (0.041, 0.0, False, False),
    ],
)
def test_legacy_rpdiff_takes_34_degrees_for_5(shift: float, degrees: float, recall: bool, precision: bool) -> None:
    goal = some_poses(3, 1)
    axis = random_rotation(np.random.default_rng(4))[:, 0]
    predicted = pose(translation=shift * axis) @ goal @ pose(rotation_about(axis, np.deg2rad(degrees)))
    assert matching.legacy_rpdiff(predicted, goal).ravel().tolist() == [recall, precision]


def test_legacy_rpdiff_misses_a_symmetric_copy_that_is_at_the_goal() -> None:
    goal = some_poses(5, 1)
    for kind, turn in (("box", pose(rotation_about((1, 0, 0), np.pi))), ("revolution", pose(rotation_about(Z, 1.5)))):
        copy = goal @ turn
        assert not matching.legacy_rpdiff(copy, goal).any()
        assert matching.surface_distance(copy, goal, points_of(kind), kind, Z)[0, 0] < 1e-7


def test_legacy_rpdiff_counts_goals_and_predictions() -> None:
    """Two predictions at the first of three goals and none at the others, where one of them is turned by 90 degrees."""
    goals = np.stack([pose(translation=(x, 0, 0)) for x in (0.0, 0.2, 0.4)])
    predicted = np.stack([goals[0], pose(translation=(0.03, 0, 0)), goals[1] @ pose(rotation_about(Z, np.pi / 2))])
    recall, precision = matching.legacy_rpdiff(predicted, goals)
    assert recall.any(axis=0).tolist() == [True, False, False]
    assert precision.any(axis=1).tolist() == [True, True, False]
    assert matching.legacy_rpdiff(np.zeros((0, 4, 4)), goals).shape == (2, 0, 3)


# The predictions file --------------------------------------------------------------------------------------


def some_predictions() -> Predictions:
    placements = {
        4: [Placement(T, score, "ok") for T, score in zip(some_poses(0, 3), (0.1, 0.9, 0.5))],
        2: [Placement(np.full((4, 4), np.nan), -np.inf, "no_region")],
    }
    return predictions.collect(placements)


def test_predictions_come_back_as_written_ranked_by_score(tmp_path: Path) -> None:
    made = some_predictions()
    back = predictions.read(predictions.write(tmp_path / "p.npz", made))
    assert back.demo.tolist() == [2, 4, 4, 4]
    assert back.rank.tolist() == [0, 0, 1, 2]
    assert back.score[1:].tolist() == [0.9, 0.5, 0.1]
    assert back.of(4) == pytest.approx(some_poses(0, 3)[[1, 2, 0]])
    assert back.of(2).shape == back.of(99).shape == (0, 4, 4)
    assert back.sha256 == made.sha256


def test_the_first_k_are_ranked_and_the_others_stay_as_drawn() -> None:
    T = some_poses(0, 5)
    drawn = [Placement(T, score, "ok") for T, score in zip(T, (0.1, 0.9, 0.2, 0.5, 0.8))]
    drawn[0] = Placement(np.full((4, 4), np.nan), -np.inf, "no_region")
    made = predictions.collect({7: drawn}, k=3)
    assert made.rank.tolist() == [0, 1, 2, 3, 4]
    assert made.score.tolist() == [0.9, 0.2, -1e9, 0.5, 0.8]
    assert made.status.tolist() == ["ok", "ok", "no_region", "ok", "ok"]
    assert made.of(7) == pytest.approx(T[[1, 2, 3, 4]])
    assert made.ranks(7).tolist() == [0, 1, 3, 4]
    assert predictions.collect({7: drawn}).score.tolist() == [0.9, 0.8, 0.5, 0.2, -1e9]


def hostile(name: str) -> dict[str, Any]:
    good = some_predictions()
    T = good.T_world_object
    base = {"demo": good.demo, "rank": good.rank, "T_world_object": T, "score": good.score, "status": good.status}
    stretched = np.where(np.isfinite(T), T * np.array([2.0, 1, 1, 1]), T)
    mirrored = T * np.array([[-1.0], [1], [1], [1]])
    changes: dict[str, dict[str, Any]] = {
        "shape": {"T_world_object": T[:, :3]},
        "short": {"score": good.score[:-1]},
        "nan unflagged": {"status": np.full(4, "ok")},
        "stretched": {"T_world_object": stretched},
        "mirrored": {"T_world_object": mirrored},
        "far away": {"T_world_object": T + np.pad(np.full((3, 1), 1e9), ((0, 1), (3, 0)))},
        "score": {"score": np.full(4, np.nan)},
        "negative": {"demo": -good.demo - 1},
        "float demo": {"demo": good.demo.astype(float)},
        "twice": {"rank": np.zeros(4, int)},
        "pickle": {"status": np.array([{}] * 4, object)},
        "text": {"score": np.array(["a"] * 4)},
        "scalar": {"demo": np.int64(3)},
    }
    return base | changes[name]


HOSTILE = ["shape", "short", "nan unflagged", "stretched", "mirrored", "far away", "score", "negative", "float demo"]
HOSTILE += ["twice", "pickle", "text", "scalar"]


@pytest.mark.parametrize("name", HOSTILE)
def test_a_wrong_predictions_file_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    path = tmp_path / "p.npz"
    np.savez(path, **hostile(name))
    with pytest.raises(FormatError, match=r"p\.npz") as caught:
        predictions.read(path)
    assert "\n" not in str(caught.value)


def test_a_file_that_lies_about_its_size_allocates_nothing(tmp_path: Path) -> None:
    path = tmp_path / "p.npz"
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 4, 4)})
    with zipfile.ZipFile(path, "w") as archive:
        for name in predictions.REQUIRED:
            archive.writestr(f"{name}.npy", header.getvalue())
    with pytest.raises(FormatError, match="cut short"):
        predictions.read(path)


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200), st.integers(0, 2000))
def test_random_bytes_never_get_past_the_reader_as_a_traceback(
    tmp_path_factory: pytest.TempPathFactory, junk: bytes, at: int
) -> None:
    path = predictions.write(tmp_path_factory.mktemp("junk") / "p.npz", some_predictions())
    content = path.read_bytes()
    at %= len(content)
    path.write_bytes(content[:at] + junk + content[at + len(junk) :])
    with suppress(FormatError):
        predictions.read(path)


# The judge on a dataset ------------------------------------------------------------------------------------


def test_the_recorded_goals_pass_and_a_hole_in_the_predictions_is_counted(tiny: Path, tmp_path: Path) -> None:
    dataset = loading.open(tiny)
    samples = [dataset[i] for i in range(2)]
    demos = [int(sample["meta/demo"]) for sample in samples]
    goals = metrics.oracle(samples, 3)
    path = predictions.write(tmp_path / "p.npz", predictions.collect({demos[0]: [Placement(goals.of(demos[0])[0], 1.0, "ok")]}))
    found = metrics.judge_file(path, dataset, trials=2, split="train", k=3)
    assert found["judge"]["oracle"]["value"] == found["references"]["oracle"]["success"]["success_mean_of_K"]["value"] == 1
    assert found["success"]["success_top1"] == {"value": 0.5, "n": 2, "ci95": list(metrics.wilson(1, 2))}
    assert found["success"]["failures"] == {"no_prediction": 1}
    assert found["method"]["n_no_prediction"] == 1
    assert [row["reason"] for row in found["scenes"]] == ["ok", "no_prediction"]
    assert any("no prediction" in note for note in found["notes"])


def test_the_report_fits_its_schema_and_compares_with_itself(tiny: Path, tmp_path: Path) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    dataset = loading.open(tiny)
    samples = [dataset[i] for i in range(2)]
    path = predictions.write(tmp_path / "p.npz", metrics.oracle(samples, 2))
    found = metrics.judge_file(path, dataset, trials=2)
    jsonschema.Draft202012Validator(report.json_schema()).validate(found)
    assert "recall@K" in found["modes"]
    a, b = tmp_path / "a.json", tmp_path / "b.json"
    a.write_text(json.dumps(found))
    fewer = metrics.judge_file(path, dataset, trials=2)
    fewer["scenes"][0] |= {"success": False, "reason": "pushed"}
    b.write_text(json.dumps(fewer))
    compared = metrics.compare(a, b)
    assert (compared["both"], compared["only_a"], compared["only_b"], compared["p_value"]) == (1, 1, 0, 1.0)
    other = found | {"split": found["split"] | {"sha256": "0" * 64}}
    b.write_text(json.dumps(other))
    with pytest.raises(UsageError, match="same scenes"):
        metrics.compare(a, b)
    b.write_text("{}")
    with pytest.raises(FormatError, match=r"b\.json"):
        metrics.compare(a, b)


def test_predictions_for_unknown_demos_are_refused(tiny: Path, tmp_path: Path) -> None:
    path = predictions.write(tmp_path / "p.npz", predictions.collect({10**6: [Placement(np.eye(4), 0.0, "ok")]}))
    with pytest.raises(UsageError, match="1000000"):
        metrics.judge_file(path, loading.open(tiny), trials=2)


def test_predictions_for_a_whole_split_are_judged_on_its_first_scenes_too(tiny: Path, tmp_path: Path) -> None:
    opened = loading.open(tiny)
    path = predictions.write(tmp_path / "p.npz", metrics.oracle([opened[i] for i in range(len(opened))], 1))
    report = metrics.judge_file(path, opened, trials=2)
    assert report["split"]["n_scenes"] == report["method"]["n_candidates"] == 2


def test_ranks_from_k_on_count_for_the_modes_alone(tiny: Path, tmp_path: Path) -> None:
    """Rank 0 is far off, rank 1 has no pose, the goals follow: with k = 2 they are found, and nothing succeeds."""
    dataset = loading.open(tiny)
    sample = dataset[0]
    demo, goals = int(sample["meta/demo"]), sample["goals/T_world_object"]
    away = Placement(pose(translation=(9.0, 9.0, 9.0)), 2.0, "ok")
    none = Placement(np.full((4, 4), np.nan), -np.inf, "no_region")
    drawn = [away, none, *(Placement(T, 1.0, "ok") for T in goals)]
    path = predictions.write(tmp_path / "p.npz", predictions.collect({demo: drawn}, k=2))
    few, all_ = (metrics.judge_file(path, dataset, trials=1, split="train", k=k) for k in (2, None))
    draws = 2 + len(goals)
    assert (few["method"]["k"], few["method"]["draws"], few["method"]["n_candidates"]) == (2, draws, 1)
    assert few["success"]["success_any_of_K"]["value"] == 0
    assert few["success"]["failures_all"]["no_prediction"] == 1
    assert few["modes"]["recall@K"]["2"]["value"] == 0
    assert few["modes"]["recall@K"][str(draws)]["value"] == 1
    assert few["scenes"][0]["modes_found"] == len(goals)
    assert few["references"]["oracle"]["modes"]["recall@K"][str(draws)]["value"] == 1
    assert all_["method"]["k"] == all_["method"]["draws"] == draws
    assert all_["success"]["success_any_of_K"]["value"] == 1
    assert all_["modes"] == few["modes"]


def test_two_processes_judge_as_one(tiny: Path) -> None:
    dataset = loading.open(tiny)
    samples = [dataset[i] for i in range(3)]
    goals = metrics.oracle(samples, 2)
    shifted = replace(goals, T_world_object=goals.T_world_object + np.pad([[0.01], [0.0], [0.0]], ((0, 1), (3, 0))))
    from dapdata.simulate import PlacementConfig

    one, two = (metrics.judge_all(shifted, samples, PlacementConfig(), "strict", k=2, workers=w) for w in (1, 2))
    for a, b in zip(one, two):
        assert [v.reason for v in a.verdicts] == [v.reason for v in b.verdicts]
        assert [v.moved for v in a.verdicts] == pytest.approx([v.moved for v in b.verdicts], abs=0, nan_ok=True)


def test_a_judge_that_fails_its_oracle_says_so(tiny: Path) -> None:
    dataset = loading.open(tiny)
    samples = [dataset[i] for i in range(2)]
    demo = int(samples[0]["meta/demo"])
    away = Placement(pose(translation=(9.0, 9.0, 9.0)), 0.0, "ok")
    broken = {"oracle": predictions.collect({demo: [away]})}
    made, _ = metrics.judge_dataset(metrics.oracle(samples, 1), dataset, trials=2, references=broken)
    assert not made.judge.sound
    assert "broken" in made.notes[0]
    with pytest.raises(CorruptionError, match="98%"):
        metrics.require_sound(made)


def test_every_failure_a_report_can_name_is_in_the_docs() -> None:
    text = (Path(__file__).parents[1] / "docs/metrics.md").read_text()
    for model in (report.Success, report.Modes, report.LegacyRpdiff, report.Geometry, report.Affordance, report.Cost):
        for name, field in model.model_fields.items():
            assert f"`{field.alias or name}`" in text, name


def test_binomials_are_not_rounded() -> None:
    assert report.mcnemar(600, 400) == pytest.approx(2 * sum(comb(1000, i) for i in range(401)) / 2**1000, rel=1e-9)
