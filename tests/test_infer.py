"""From two raw clouds to ranked placements: no ground truth in, no failed candidate passed off as a pose."""

import json
from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("numba")
pytest.importorskip("safetensors")

from training_samples import RULE, TINY, ends_at_goal, make_sample  # noqa: E402

from dapdata import poses  # noqa: E402
from dapdata.config import PAPER, TrainConfig  # noqa: E402
from dapdata.errors import CheckpointError, UsageError  # noqa: E402
from daptrain import checkpoint, infer, loop, pose  # noqa: E402
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


@pytest.mark.parametrize("changes", [{"refine": False, "ranking": "collision"}, {}])
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


def test_cap_draws_its_candidates_from_the_peaks_of_one_map(tmp_path):
    predictor = Predictor.load(write_run(tmp_path / "run", "cap"), "cpu")
    inputs = predictor.prepare(*clouds(make_sample(1)), np.random.default_rng(0))
    regions = predictor.regions(inputs, 4, np.random.default_rng(0))
    tops = [inputs.superpoints[r.argmax()] for r in regions if r.max() > 0]
    assert len(regions) == 4
    assert all(np.linalg.norm(a - b) > 0.05 for i, a in enumerate(tops) for b in tops[:i])


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
