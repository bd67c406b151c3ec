"""From two raw clouds to ranked placements: no ground truth in, no failed candidate passed off as a pose."""

import json
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("numba")
pytest.importorskip("safetensors")

from training_samples import RULE, SLOTS, TINY, ends_at_goal, make_sample  # noqa: E402

from dapdata import poses  # noqa: E402
from dapdata.config import AT_INFERENCE, PAPER, Criterion, Step, TrainConfig  # noqa: E402
from dapdata.errors import CheckpointError, UsageError  # noqa: E402
from daptrain import checkpoint, infer, loop, pose, refine  # noqa: E402
from daptrain.infer import Predictor  # noqa: E402
from daptrain.layers import UNIT  # noqa: E402
from daptrain.prepare import box_goal, prepare, reference_rotation  # noqa: E402


def write_run(run, method="dap", **changes):
    config = TINY.model_copy(update=changes)
    material = loop.Material([prepare(make_sample(0), RULE, config)], [], RULE, 7, "shelf")
    recipe = {"label": {"eps_place": RULE.eps_place, "kind": "hard"}, "superpoints": {"count": 150}}
    checkpoint.start_run(run, checkpoint.describe("data/shelf", "shelf", "digest", recipe, config, method, "cpu"))
    for name in ("affordance", "pose"):
        checkpoint.save_weights(run / f"{name}.safetensors", loop.build(name, config, method, material), "shelf")
    return run


@pytest.fixture(scope="module")
def predictor(tmp_path_factory) -> Predictor:
    return Predictor.load(write_run(tmp_path_factory.mktemp("run")), "cpu")


@pytest.fixture
def knowing(monkeypatch):
    """Networks that know where each of sample 0's goals is: what can still go wrong is everything around them."""
    example = prepare(make_sample(0), RULE, TINY)
    reference = reference_rotation([example])
    centres = []

    def sample(net, batch, count, steps, rng):
        places = batch.points[0].numpy() * UNIT
        goals = [example.targets.T_front_object[i % 2][:3, 3] for i in range(count)]
        return np.stack([np.where(np.linalg.norm(places - g, axis=1) < 0.08, 1.0, -1.0) for g in goals])[None]

    def remember(*args, crop=infer.crop):
        piece = crop(*args)
        centres.append(piece.centre)
        return piece

    def solve(net, batch):
        boxes = [box_goal(example.targets, T, reference) for T in example.targets.T_front_object]
        poses_of = [poses.pose(translation=-centre) @ boxes[i % 2] for i, centre in enumerate(centres)]
        return [pose.Solution(T, 0.001, "ok") for T in poses_of]

    monkeypatch.setattr(infer.affordance, "sample", sample)
    monkeypatch.setattr(infer, "crop", remember)
    monkeypatch.setattr(infer.pose, "solve", solve)


def clouds(sample):
    return tuple(sample[key] for key in ("container/points", "container/normals", "object/points", "object/normals"))


@pytest.mark.parametrize("changes", [{"refine": [], "ranking": ["collision"]}, {"refine": ["search"], "ranking": []}, {}])
def test_networks_that_know_the_goals_give_placements_at_the_goals(predictor, knowing, changes):
    predictor = replace(predictor, config=predictor.config.model_copy(update=changes))
    sample = make_sample(0)
    start = sample["pose/T_world_object_start"]
    placements = predictor.predict(*clouds(sample), 4, np.random.default_rng(0), T_world_object=start)
    assert [p.status for p in placements] == ["ok"] * 4
    assert all(ends_at_goal(sample, p.T_world_object, 0.012) for p in placements)
    scores = [p.score for p in placements]
    assert scores == sorted(scores, reverse=True)


def test_without_a_pose_of_the_object_a_placement_is_the_motion_of_its_points(predictor, knowing):
    sample = make_sample(0)
    placement = predictor.predict(*clouds(sample), 1, np.random.default_rng(0))[0]
    carried = poses.transform(placement.T_world_object, sample["object/points"])
    middle = poses.pose(translation=(carried.min(axis=0) + carried.max(axis=0)) / 2)
    assert ends_at_goal(sample, middle, 0.02)


def test_a_prediction_follows_from_the_clouds_and_the_generator(predictor):
    one, same = (predictor.predict(*clouds(make_sample(1)), 3, np.random.default_rng(4)) for _ in range(2))
    for a, b in zip(one, same):
        np.testing.assert_array_equal(a.T_world_object, b.T_world_object)
        assert (a.score, a.status) == (b.score, b.status)


def test_untrained_networks_give_k_candidates_each_with_a_status(predictor):
    placements = predictor.predict(*clouds(make_sample(1)), 5, np.random.default_rng(0))
    assert len(placements) == 5
    for p in placements:
        assert (p.status == "ok") == bool(np.isfinite(p.T_world_object).all())


def test_a_region_that_is_not_there_is_a_status_and_no_pose(predictor, monkeypatch):
    monkeypatch.setattr(
        infer.affordance, "sample", lambda net, batch, count, *_: np.full((1, count, batch.mask.shape[1]), -1.0)
    )
    placements = predictor.predict(*clouds(make_sample(1)), 3, np.random.default_rng(0))
    assert [p.status for p in placements] == ["no_region"] * 3
    assert all(np.isnan(p.T_world_object).all() for p in placements)


def test_a_failed_solve_is_a_status_and_comes_last(predictor, monkeypatch):
    solve = pose.solve

    def half(net, batch):
        return [replace(s, T_crop_box=np.full((4, 4), np.nan), status="degenerate") if i % 2 == 0 else s
                for i, s in enumerate(solve(net, batch))]  # fmt: skip

    def somewhere(net, batch, count, steps, rng):
        return np.repeat(np.where(np.arange(batch.mask.shape[1]) < 8, 1.0, -1.0)[None, None], count, axis=1)

    monkeypatch.setattr(infer.affordance, "sample", somewhere)
    monkeypatch.setattr(infer.pose, "solve", half)
    placements = predictor.predict(*clouds(make_sample(1)), 4, np.random.default_rng(0))
    assert [p.status for p in placements] == ["ok", "ok", "degenerate", "degenerate"]


# Refinement and ranking, step by step ---------------------------------------------------------------------------


def with_config(predictor, **changes):
    return replace(predictor, config=infer.changed(predictor.config, changes))


def test_the_config_names_the_steps_and_criteria_of_refine():
    assert get_args(Step) == refine.STEPS
    assert get_args(Criterion) == refine.CRITERIA
    assert tuple(TrainConfig().refine) == refine.STEPS
    assert tuple(TrainConfig().ranking) == refine.CRITERIA


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"ranking": ["path", "collision"]}, "collision to stand alone"),
        ({"ranking": ["path", "path"]}, "at most once"),
        ({"refine": ["yaw", "yaw"]}, "at most once"),
        ({"refine": ["jump"]}, "'gravity'"),
        ({"refine": True}, "list"),
    ],
)
def test_steps_and_criteria_that_make_no_sense_are_refused(change, says):
    with pytest.raises(ValueError, match=says):
        TrainConfig(**change)


@pytest.fixture(scope="module")
def tilted(predictor):
    """Proposals beside a goal and turned a little: every step and every criterion has something to say on them."""
    sample = make_sample(0)
    inputs, box = predictor.prepare(*clouds(sample), np.random.default_rng(0))
    T_box_object = poses.inverse(inputs.T_world_box) @ sample["pose/T_world_object_start"]
    off = [poses.pose(poses.rotation_about((1, 2, 3), 0.1 * i), (0.004 * i, 0.006, 0.01 - 0.02 * i)) for i in range(3)]
    T = np.stack([sample["goals/T_world_object"][0] @ T @ poses.inverse(T_box_object) for T in off])
    return [infer.Proposal(np.ones(3), pose, 0.01 * i, "ok") for i, pose in enumerate(T)], clouds(sample)[:2], box


@pytest.mark.parametrize("steps", [[], ["gravity"], ["yaw"], ["settle"], ["search"], ["search", "gravity"], list(refine.STEPS)])
def test_just_the_steps_that_are_named_are_done(predictor, tilted, steps):
    proposals, container, box = tilted
    found, _ = with_config(predictor, refine=steps).finish(proposals, *container, box)
    T = np.stack([p.T_world_box for p in proposals])
    np.testing.assert_allclose(found, refine.refine(T, refine.observed_scene(*container), box, steps), atol=1e-12)
    assert (np.abs(found - T).max() < 1e-9) == (steps == [])


@pytest.mark.parametrize("ranking", [list(refine.CRITERIA), ["collision"], []])
def test_candidates_are_raised_by_the_hover_and_ranked_where_they_are_then(predictor, tilted, ranking):
    proposals, container, box = tilted
    found, _ = with_config(predictor, ranking=ranking).finish(proposals, *container, box)
    raised, scores = with_config(predictor, ranking=ranking, hover=0.02).finish(proposals, *container, box)
    up = np.eye(4)
    up[2, 3] = 0.02
    np.testing.assert_allclose(raised, up @ found, atol=1e-12)
    if len(ranking) > 1:
        residual = np.array([p.residual for p in proposals])
        np.testing.assert_allclose(scores, refine.rank(raised, refine.observed_scene(*container), box, residual, ranking))


@pytest.mark.parametrize("criteria", [["path"], ["path", "balance"], ["residual"], list(refine.CRITERIA)])
def test_just_the_criteria_that_are_named_count(predictor, tilted, criteria):
    proposals, container, box = tilted
    T, scores = with_config(predictor, refine=[], ranking=criteria).finish(proposals, *container, box)
    residual = np.array([p.residual for p in proposals])
    np.testing.assert_allclose(scores, refine.rank(T, refine.observed_scene(*container), box, residual, criteria))
    assert len(set(scores)) > 1


def test_the_collision_count_ranks_with_refinement_and_without(predictor, tilted):
    proposals, container, box = tilted
    for steps in ([], ["gravity"]):
        T, scores = with_config(predictor, refine=steps, ranking=["collision"]).finish(proposals, *container, box)
        np.testing.assert_array_equal(scores, refine.rank_collision_count(T, container[0], box))
    assert scores.min() < 0


def test_no_criteria_leave_candidates_as_drawn_and_failures_last(predictor, tilted):
    proposals, container, box = tilted
    failed = replace(proposals[1], T_world_box=np.full((4, 4), np.nan), status="no_region")
    _, scores = with_config(predictor, ranking=[]).finish([proposals[0], failed, proposals[2]], *container, box)
    assert scores[0] == scores[2] == 0
    assert scores[1] == -np.inf


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"width": 128}, r"train\.width: is fixed in training, expected one of sample_steps, .*train again"),
        ({"preset": "paper"}, r"train\.preset: is fixed in training"),
        ({"refin": []}, r"train\.refin: is no key, .*did you mean 'refine'"),
        ({"refine": ["jump"]}, r"train\.refine\[0\]: got 'jump', expected 'gravity'"),
        ({"sample_steps": 0}, r"train\.sample_steps: got 0, expected greater"),
        ({"ranking": ["collision", "path"]}, r"train\.ranking: got \[collision, path\], expected collision to stand alone"),
    ],
)
def test_what_is_fixed_in_training_cannot_be_changed_afterwards(tmp_path, changes, says):
    with pytest.raises(UsageError, match=says) as caught:
        Predictor.load(write_run(tmp_path / "run"), "cpu", changes=changes)
    assert "\n" not in str(caught.value)


def test_a_change_holds_for_the_predictor_and_not_for_the_run(tmp_path):
    run = write_run(tmp_path / "run")
    changes = {"sample_steps": 2, "crop_margin": 0.01, "cap_crop": "peak", "refine": [], "hover": 0.01, "ranking": ["path"]}
    assert set(changes) == set(AT_INFERENCE)
    config = Predictor.load(run, "cpu", changes=changes).config
    assert {name: getattr(config, name) for name in changes} == changes
    assert Predictor.load(run, "cpu").config == TINY


# CAP, from maps drawn by hand -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cap(tmp_path_factory):
    return Predictor.load(write_run(tmp_path_factory.mktemp("cap"), "cap"), "cpu")


def cap_regions(cap, monkeypatch, p, k, drawn=0, **changes):
    """The regions (S,) that are cropped with a map drawn by hand, the status of each candidate, and the slots (3, S).

    Args:
        p: Of the map in the middle of each slot's floor; it falls to 0.83 of that within 5 cm, and is 0.01 beyond.
    """
    sample, regions = make_sample(1), []
    inputs, _ = cap.prepare(*clouds(sample), np.random.default_rng(0))
    inputs = replace(inputs, extents=np.full(3, 0.07, np.float32))  # narrower than a slot
    T_front_container = poses.inverse(inputs.T_world_front) @ sample["pose/T_world_container"]
    slots = poses.transform(T_front_container, np.array([[0, y, 0.02] for y in SLOTS]))
    middles = np.linalg.norm(inputs.superpoints[:, None] - slots, axis=-1).argmin(axis=0)
    away = np.linalg.norm(inputs.superpoints[:, None] - inputs.superpoints[middles], axis=-1)
    near = away < 0.05
    assert (near.sum(axis=0) > 2).all()
    drawn_map = np.where(near, p * (1 - away / 0.3), 0.01).max(axis=1)

    def crop(inputs, score, region, *rest, crop=infer.crop):
        regions.append(region)
        return crop(inputs, score, region, *rest)

    monkeypatch.setattr(infer, "crop", crop)
    monkeypatch.setattr(infer.affordance, "sample", lambda *_: 2 * drawn_map[None, None] - 1)
    proposals = with_config(cap, **changes).propose(inputs, k, np.random.default_rng(0), drawn)
    return regions, [proposal.status for proposal in proposals], near.T


@pytest.mark.parametrize("p", [(0.9, 0.7, 0.4), (0.36, 0.28, 0.12)])
def test_cap_whole_crops_all_that_is_positive_for_every_candidate(cap, monkeypatch, p):
    """Above 0.5, or where three slots share it above half of its maximum; never around one peak."""
    regions, statuses, slots = cap_regions(cap, monkeypatch, p, 3, cap_crop="whole")
    assert len(regions) == 3
    assert "no_region" not in statuses
    for region in regions:
        np.testing.assert_array_equal(region, slots[0] | slots[1])


def test_cap_peak_crops_the_region_of_the_best_peak_for_every_candidate(cap, monkeypatch):
    regions, _, slots = cap_regions(cap, monkeypatch, (0.3, 0.9, 0.4), 3, cap_crop="peak")
    assert len(regions) == 3
    for region in regions:
        np.testing.assert_array_equal(region, slots[1])


def test_cap_peaks_crops_a_peak_of_its_own_for_each_candidate_best_first(cap, monkeypatch):
    regions, _, slots = cap_regions(cap, monkeypatch, (0.3, 0.9, 0.5), 3)
    assert [int(np.argmax((slots & region).sum(axis=1))) for region in regions] == [1, 2, 0]
    later, _, _ = cap_regions(cap, monkeypatch, (0.3, 0.9, 0.5), 2, drawn=1)
    for region, wanted in zip(later, regions[1:]):  # those that come after the first
        np.testing.assert_array_equal(region, wanted)


@pytest.mark.parametrize("cap_crop", ["whole", "peak"])
def test_one_region_for_all_leaves_only_the_thinning_to_differ(cap, monkeypatch, cap_crop):
    pieces = []

    def crop(*arguments, crop=infer.crop):
        pieces.append(crop(*arguments))
        return pieces[-1]

    few = replace(cap, config=cap.config.model_copy(update={"crop_points": 16}))
    with monkeypatch.context() as patched:
        patched.setattr(infer, "crop", crop)
        cap_regions(few, patched, (0.3, 0.9, 0.5), 2, cap_crop=cap_crop)
    one, other = pieces
    np.testing.assert_array_equal(one.centre, other.centre)
    assert len(one.points) == len(other.points) == 16
    assert (one.points != other.points).any()


def test_a_map_without_anything_positive_names_no_region(cap, monkeypatch):
    monkeypatch.setattr(infer.affordance, "positives", lambda score: np.full_like(score, -1.0))
    assert cap_regions(cap, monkeypatch, (0.3, 0.9, 0.5), 2, cap_crop="whole")[1] == ["no_region"] * 2


def test_cap_draws_its_candidates_from_the_peaks_of_one_map(cap):
    inputs, _ = cap.prepare(*clouds(make_sample(1)), np.random.default_rng(0))
    regions = cap.regions(inputs, 4, np.random.default_rng(0))
    tops = [inputs.superpoints[r.argmax()] for r in regions if r.max() > 0]
    assert len(regions) == 4
    assert all(np.linalg.norm(a - b) > 0.05 for i, a in enumerate(tops) for b in tops[:i])


# Runs and clouds ------------------------------------------------------------------------------------------------


def test_the_preset_of_the_paper_predicts_too(tmp_path):
    paper = {key: getattr(TrainConfig(preset="paper"), key) for key in PAPER} | {"sample_steps": 3}
    predictor = Predictor.load(write_run(tmp_path / "run", **paper), "cpu")
    assert len(predictor.predict(*clouds(make_sample(1)), 2, np.random.default_rng(0))) == 2


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda c: (c[0][:5], c[1][:5], *c[2:]), "container cloud: got 5 points"),
        (lambda c: (*c[:2], c[2][:0], c[3][:0]), "object cloud: got 0 points"),
        (lambda c: (c[0], c[1][:-1], *c[2:]), "expected both"),
        (lambda c: (c[0] * np.nan, *c[1:]), "NaN"),
        (lambda c: (1000 * c[0], *c[1:]), "container cloud: is .* m across, expected at most 10 m"),
        (lambda c: (*c[:2], 1000 * c[2], c[3]), "object cloud: is .* millimetres"),
    ],
)
def test_clouds_that_are_none_are_refused(predictor, change, says):
    with pytest.raises(UsageError, match=says) as caught:
        predictor.predict(*change(clouds(make_sample(0))), 1, np.random.default_rng(0))
    assert "\n" not in str(caught.value)


def test_a_run_of_another_task_is_refused_naming_both(tmp_path):
    with pytest.raises(CheckpointError, match=r"task shelf, the data are of task tray"):
        Predictor.load(write_run(tmp_path / "run"), "cpu", task="tray")


def test_a_config_with_unknown_keys_is_refused(tmp_path):
    run = write_run(tmp_path / "run")
    description = json.loads((run / "config.json").read_text())
    description["train"]["temperature"] = 3
    (run / "config.json").write_text(json.dumps(description))
    with pytest.raises(CheckpointError, match=r"config\.json"):
        Predictor.load(run, "cpu")


def test_predicting_leaves_the_clouds_as_they_are(predictor):
    before = clouds(make_sample(1))
    after = tuple(x.copy() for x in before)
    predictor.predict(*after, 2, np.random.default_rng(0))
    for a, b in zip(before, after):
        np.testing.assert_array_equal(a, b)
