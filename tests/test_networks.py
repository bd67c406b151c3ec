"""Both networks and what they are fed: frames, labels, crops, losses, poses."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("scipy")

from training_samples import RULE, SIZE, TINY, make_sample, moved  # noqa: E402

from dapdata import poses  # noqa: E402
from dapdata.config import TrainConfig  # noqa: E402
from daptrain import affordance, pose, prepare  # noqa: E402
from daptrain.affordance import AffordanceNet  # noqa: E402
from daptrain.layers import UNIT  # noqa: E402
from daptrain.pose import PoseNet  # noqa: E402

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def examples() -> list[prepare.Example]:
    return [prepare.prepare(make_sample(seed, spacing), RULE, TINY) for seed, spacing in ((0, 0.02), (1, 0.025), (2, 0.03))]


def batch_of(examples):
    return affordance.collate([e.inputs for e in examples], np.zeros(len(examples)), np.zeros(len(examples), bool), CPU)


def stirred(net):
    """The network with random numbers where it starts with zeros, so that every path carries something."""
    torch.manual_seed(1)
    with torch.no_grad():
        for value in net.parameters():
            value.add_(0.1 * torch.randn_like(value))
    return net


# What the networks see -------------------------------------------------------------------------------------------


def test_moving_the_world_leaves_what_the_networks_see():
    T = poses.pose(poses.rotation_about((0, 0, 1), 1.1), (0.4, -0.7, 0.2))
    here = prepare.prepare(make_sample(0), RULE, TINY)
    there = prepare.prepare(moved(make_sample(0), T), RULE, TINY)
    np.testing.assert_allclose(there.inputs.superpoints, here.inputs.superpoints, atol=2e-3)
    np.testing.assert_allclose(there.targets.T_front_object, here.targets.T_front_object, atol=5e-3)
    np.testing.assert_array_equal(there.targets.affordance, here.targets.affordance)


def test_the_front_frame_has_x_out_of_the_opening_and_stands_at_the_foot(examples):
    sample = make_sample(0)
    T_container_front = poses.inverse(sample["pose/T_world_container"]) @ examples[0].inputs.T_world_front
    np.testing.assert_allclose(T_container_front[:3, :3], np.eye(3), atol=0.02)
    assert abs(T_container_front[2, 3]) < 0.015


def test_every_goal_has_its_own_affordance_and_the_first_is_the_stored_one(examples):
    for seed, example in enumerate(examples):
        sample = make_sample(seed, (0.02, 0.025, 0.03)[seed])
        targets = example.targets
        assert len(targets.affordance) == len(targets.T_front_object) == 2
        np.testing.assert_array_equal(targets.affordance[0], sample["container_superpoints/affordance"])
        assert ((targets.affordance[0] > 0) & (targets.affordance[1] > 0)).sum() < (targets.affordance[0] > 0).sum()


def test_demonstrated_goals_only_when_asked():
    config = TINY.model_copy(update={"goals": "demonstrated"})
    assert len(prepare.prepare(make_sample(0), RULE, config).targets.affordance) == 1


@pytest.mark.parametrize("kind", ["hard", "soft"])
def test_affordance_of_other_goals_is_the_labels_own_rule(kind):
    from dapdata.labels import affordance as stored_rule

    sample, rule = make_sample(0), prepare.LabelRule(0.03, kind)
    local = poses.transform(poses.inverse(sample["pose/T_world_object_start"]), sample["object/points"].astype(float))
    goal = sample["goals/T_world_object"][1]
    ours = prepare.point_affordance(sample["container/points"], local, goal, rule)
    superpoint = sample["container/superpoint"]
    theirs = stored_rule(sample["container/points"], superpoint, poses.transform(goal, local), 0.03, kind)
    np.testing.assert_allclose(np.bincount(superpoint, ours) / np.bincount(superpoint), theirs, atol=1e-6)


def test_labels_of_net_2_are_the_symmetric_copy_nearest_to_the_reference(examples):
    reference = prepare.reference_rotation(examples)
    for example in examples:
        targets = example.targets
        for T_front_object in targets.T_front_object:
            label = prepare.box_goal(targets, T_front_object, reference)
            turns = [np.diag(d) for d in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])]
            copies = [T_front_object @ poses.pose(np.array(g, float)) @ targets.T_object_box for g in turns]
            angles = [float(poses.angle_between(T[:3, :3], reference)) for T in copies]
            np.testing.assert_allclose(label, copies[int(np.argmin(angles))], atol=1e-9)
            assert np.degrees(min(angles)) < 15  # all goals stand alike, whatever way the object lay


def test_the_label_does_not_depend_on_which_copy_was_demonstrated(examples):
    targets, reference = examples[0].targets, prepare.reference_rotation(examples)
    goal = targets.T_front_object[0]
    half_turn = goal @ poses.pose(np.diag([-1.0, -1.0, 1.0]))
    np.testing.assert_allclose(
        prepare.box_goal(targets, half_turn, reference), prepare.box_goal(targets, goal, reference), atol=1e-9
    )


def test_clean_region_drops_strays_and_names_nothing_when_nothing_is_likely():
    places = np.array([[0, 0, 0], [0.02, 0, 0], [0.04, 0, 0], [1.0, 0, 0]])
    score = np.array([0.8, 0.9, 0.2, 0.95])
    np.testing.assert_array_equal(prepare.clean_region(score, places, 0.1), [True, True, True, False])
    assert prepare.clean_region(np.full(4, -0.95), places, 0.1) is None
    assert prepare.clean_region(np.full(4, np.nan), places, 0.1) is None


def test_a_crop_holds_the_region_and_little_else(examples):
    inputs, score = examples[0].inputs, examples[0].targets.affordance[0]
    region = prepare.one_region(inputs, score, RULE.eps_place)
    assert region is not None
    piece = prepare.crop(inputs, score, region, 0.0, TINY, np.random.default_rng(0))
    assert piece is not None
    assert np.linalg.norm(piece.points, axis=1).max() < np.linalg.norm(SIZE) / 2 + 3 * RULE.eps_place
    goal = examples[0].targets.T_front_object[0][:3, 3]
    assert np.linalg.norm(piece.centre - goal) < 0.06
    assert len(piece.points) <= TINY.crop_points
    assert (piece.score > 0).mean() > 0.3


def test_a_label_made_for_training_is_in_the_frame_of_its_crop(examples):
    """The object's points, carried by T_crop_box, lie where the crop's own container points leave room for them."""
    example, reference = examples[0], prepare.reference_rotation(examples)
    for seed in range(10):
        item = prepare.pose_item(example, reference, RULE, TINY, np.random.default_rng(seed))
        assert item is not None
        piece, T_crop_box = item
        placed = poses.transform(T_crop_box, piece.object_points)
        nearest = np.linalg.norm(placed[:, None] - piece.points[None], axis=-1).min(axis=1)
        assert np.median(nearest) < 0.04
        assert abs(abs(T_crop_box[2, 2]) - 1) < 0.02  # the longest side stands up


# Net 1 ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["dap", "cap"])
@pytest.mark.parametrize("prediction", ["x0", "eps"])
def test_padding_never_leaks_into_net_1(examples, method, prediction):
    net = stirred(AffordanceNet(TINY.model_copy(update={"prediction": prediction}), method)).eval()
    together = batch_of(examples)
    S = together.mask.shape[1]
    assert len({len(e.inputs.superpoints) for e in examples}) > 1
    noisy, t = torch.randn(len(examples), 2, S), torch.tensor([[5, 80]] * len(examples))
    both = net(net.encode(together), noisy, t)
    for b, example in enumerate(examples):
        n = len(example.inputs.superpoints)
        alone = net(net.encode(batch_of([example])), noisy[b : b + 1, :, :n], t[:1])
        torch.testing.assert_close(both[b : b + 1, :, :n], alone, atol=2e-5, rtol=1e-4)


def test_padding_never_leaks_into_the_loss_of_net_1(examples):
    net = stirred(AffordanceNet(TINY)).eval()
    batch = batch_of(examples)
    shape = (len(examples), 2, batch.mask.shape[1])
    clean, noise, t = torch.rand(shape) * 2 - 1, torch.randn(shape), torch.full(shape[:2], 40)
    there = affordance.loss(net, batch, clean, t, noise)
    outside = ~batch.mask[:, None].expand(shape)
    other = affordance.loss(net, batch, clean.masked_fill(outside, 0.77), t, noise.masked_fill(outside, -3.0))
    torch.testing.assert_close(there, other)


def test_smoothed_noise_has_unit_variance_and_ignores_padding():
    points = torch.randn(1, 200, 3)
    mask = torch.ones(1, 200, dtype=torch.bool)
    mask[:, 150:] = False
    weight = affordance.smoothing(points, mask, [0.4, 1.4])
    assert weight.shape == (1, 2, 200, 200)
    assert (weight[..., 150:] == 0).all()
    smoothed = weight[0] @ torch.randn(200, 4000)
    torch.testing.assert_close(smoothed.var(dim=-1)[:, :150].mean(), torch.tensor(1.0), atol=0.05, rtol=0)


def test_a_mirrored_turned_scene_keeps_its_distances(examples):
    inputs = [examples[0].inputs]
    plain = affordance.collate(inputs, np.zeros(1), np.zeros(1, bool), CPU)
    changed = affordance.collate(inputs, np.array([0.7]), np.ones(1, bool), CPU)
    here, there = plain.points[0].double(), changed.points[0].double()
    torch.testing.assert_close(torch.cdist(there, there), torch.cdist(here, here), atol=1e-5, rtol=0)
    torch.testing.assert_close(changed.points[..., 2], plain.points[..., 2])
    assert np.linalg.det(affordance.turned(0.7, True)) == pytest.approx(-1)
    assert np.linalg.det(affordance.turned(0.7, False)) == pytest.approx(1)


def test_the_loss_of_each_prediction_is_its_formula(examples):
    batch = batch_of(examples[:1])
    shape = (1, 1, batch.mask.shape[1])
    clean, noise, t = torch.sign(torch.randn(shape)), torch.randn(shape), torch.tensor([[30]])
    for prediction in ("x0", "eps"):
        net = stirred(AffordanceNet(TINY.model_copy(update={"prediction": prediction}))).eval()
        bar = net.alpha_bar[30].float()
        out = net(net.encode(batch), bar.sqrt() * clean + (1 - bar).sqrt() * noise, t)
        p = out.sigmoid()
        cross_entropy = -torch.where(clean > 0, p.log(), (1 - p).log()).mean()
        by_hand = cross_entropy if prediction == "x0" else ((out - noise) ** 2).mean()
        torch.testing.assert_close(affordance.loss(net, batch, clean, t, noise), by_hand, atol=1e-5, rtol=1e-5)


def test_samples_are_scores_and_follow_from_the_generator(examples):
    net = stirred(AffordanceNet(TINY)).eval()
    batch = batch_of(examples)
    one, same = (affordance.sample(net, batch, 3, 4, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(one, same)
    assert one.shape == (3, 3, batch.mask.shape[1])
    assert np.abs(one).max() <= 1
    assert (affordance.sample(net, batch, 3, 4, np.random.default_rng(6)) != one).any()


def test_cap_needs_no_noise(examples):
    net = stirred(AffordanceNet(TINY, "cap")).eval()
    scores = affordance.sample(net, batch_of(examples), 2, 4, np.random.default_rng(0))
    np.testing.assert_array_equal(scores[:, 0], scores[:, 1])


def test_peaks_come_best_first_and_apart():
    places = np.array([[0, 0, 0], [0.05, 0, 0], [1, 0, 0], [2, 0, 0]], float)
    score = np.array([0.2, 0.4, 0.8, -0.9])
    first, second, third = affordance.peaks(score, places, 3, 0.1)
    assert first.argmax() == 2
    assert second.argmax() == 1
    assert second[0] > 0
    assert third.argmax() == 3
    assert len(affordance.peaks(score, places, 9, 0.1)) == 3


@pytest.mark.parametrize(
    ("p", "positive"),
    [
        ([0.9, 0.6, 0.45, 0.1], [1, 1, 0, 0]),  # above 0.5, as published
        ([0.51, 0.49, 0.3, 0.3], [1, 0, 0, 0]),
        ([0.4, 0.3, 0.19, 0.0], [1, 1, 0, 0]),  # four places share it: above half of the maximum
        ([0.06, 0.04, 0.02, 0.0], [1, 1, 0, 0]),
        ([0.0, 0.0, 0.0, 0.0], [0, 0, 0, 0]),
        ([np.nan, 0.9, 0.9, 0.9], [0, 0, 0, 0]),
    ],
)
def test_what_a_classification_calls_positive(p, positive):
    score = affordance.positives(2 * np.array(p) - 1)
    np.testing.assert_array_equal(score > 0, np.array(positive, bool))
    assert not (np.abs(score) > 1).any()


def test_the_paper_preset_has_no_extension():
    net = AffordanceNet(TrainConfig(preset="paper"))
    assert net.embed_extents is None
    assert net.embed_score.in_features == 1
    assert not net.predicts_logits
    assert PoseNet(TrainConfig(preset="paper")).offset is None


def test_a_written_key_wins_over_the_preset():
    config = TrainConfig(preset="paper", prediction="x0")
    assert (config.prediction, config.goals, config.refine) == ("x0", "demonstrated", [])


# Net 2 ----------------------------------------------------------------------------------------------------------


def crops_of(examples, count: int = 3):
    reference = prepare.reference_rotation(examples)
    items = [prepare.pose_item(e, reference, RULE, TINY, np.random.default_rng(i)) for i, e in enumerate(examples[:count])]
    pieces, goals = zip(*items)
    # Of different lengths, so that there is padding.
    pieces = [
        replace(p, points=p.points[: 40 + 5 * i], normals=p.normals[: 40 + 5 * i], score=p.score[: 40 + 5 * i])
        for i, p in enumerate(pieces)
    ]
    return pieces, np.stack(goals), np.stack([e.inputs.extents for e in examples[:count]])


@pytest.mark.parametrize("residual", [True, False])
def test_padding_never_leaks_into_net_2(examples, residual):
    net = stirred(PoseNet(TINY.model_copy(update={"residual": residual}))).eval()
    pieces, _, extents = crops_of(examples)
    both = net(pose.collate(pieces, extents, CPU))
    for b, piece in enumerate(pieces):
        alone = net(pose.collate([piece], extents[b : b + 1], CPU))
        m, c = len(piece.object_points), len(piece.points)
        torch.testing.assert_close(both.targets[b : b + 1, :m], alone.targets, atol=2e-5, rtol=1e-4)
        torch.testing.assert_close(both.log_confidence[b : b + 1, :m, :c], alone.log_confidence, atol=5e-5, rtol=1e-4)
        assert (both.log_confidence[b, :, c:] == -torch.inf).all()


def test_dual_softmax_is_the_product_of_both_softmaxes():
    logits = torch.randn(2, 5, 7)
    full = torch.ones(2, 5, dtype=torch.bool), torch.ones(2, 7, dtype=torch.bool)
    p = pose.dual_softmax(logits, *full).exp()
    torch.testing.assert_close(p, logits.softmax(dim=1) * logits.softmax(dim=2))
    torch.testing.assert_close((p / logits.softmax(dim=1)).sum(dim=2), torch.ones(2, 5))
    torch.testing.assert_close((p / logits.softmax(dim=2)).sum(dim=1), torch.ones(2, 7))


def test_dual_softmax_with_padding_has_finite_gradients():
    logits = torch.randn(1, 4, 4, requires_grad=True)
    mask = torch.tensor([[True, True, True, False]])
    log_p = pose.dual_softmax(logits, mask, mask)
    torch.testing.assert_close(log_p[:, :3, :3], pose.dual_softmax(logits[:, :3, :3], mask[:, :3], mask[:, :3]))
    log_p[log_p.isfinite()].sum().backward()
    assert logits.grad is not None
    assert logits.grad.isfinite().all()


def test_focal_loss_by_hand():
    p = torch.tensor([[[0.5, 0.1], [0.9, 0.2]]])
    positive = torch.tensor([[[True, False], [True, False]]])
    by_hand = -(0.25 * np.log(0.5) + 0.01 * np.log(0.9)) / 2
    assert float(pose.focal_loss(p.log(), positive)) == pytest.approx(by_hand, rel=1e-6)


def test_focal_loss_without_a_positive_pair_is_zero_and_has_a_gradient():
    logits = torch.randn(1, 3, 3, requires_grad=True)
    mask = torch.ones(1, 3, dtype=torch.bool)
    value = pose.focal_loss(pose.dual_softmax(logits, mask, mask), torch.zeros(1, 3, 3, dtype=torch.bool))
    value.backward()
    assert float(value) == 0
    assert logits.grad is not None
    assert (logits.grad == 0).all()


@pytest.mark.parametrize("scale", [1.0, 1e-12, 1e-300, 1e12])
def test_kabsch_is_exact_whatever_the_scale_of_the_weights(scale):
    rng = np.random.default_rng(0)
    for _ in range(20):
        T = poses.pose(poses.random_rotation(rng), rng.normal(size=3))
        source = rng.normal(size=(9, 3))
        found, status = pose.kabsch(source, poses.transform(T, source), scale * rng.uniform(0.01, 1, 9))
        assert status == "ok"
        np.testing.assert_allclose(found, T, atol=1e-12)


def test_kabsch_leaves_out_points_of_no_weight():
    rng = np.random.default_rng(0)
    T, source = poses.pose(poses.random_rotation(rng), (1, 2, 3)), rng.normal(size=(6, 3))
    target = poses.transform(T, source)
    target[0] += 100
    np.testing.assert_allclose(pose.kabsch(source, target, np.array([0, 1, 1, 1, 1, 1.0]))[0], T, atol=1e-12)


def test_kabsch_never_mirrors():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(8, 3))
    found, status = pose.kabsch(source, source * [1, 1, -1], np.ones(8))
    assert status == "ok"
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1)


def test_kabsch_minimises_the_weighted_square():
    rng = np.random.default_rng(1)
    source, target, weights = rng.normal(size=(8, 3)), rng.normal(size=(8, 3)), rng.uniform(size=8)
    found, _ = pose.kabsch(source, target, weights)

    def cost(T):
        return float(weights @ ((poses.transform(T, source) - target) ** 2).sum(axis=1))

    for _ in range(200):
        nudge = poses.pose(poses.rotation_about(rng.normal(size=3), 0.02 * rng.normal()), 0.02 * rng.normal(size=3))
        assert cost(nudge @ found) >= cost(found) - 1e-12


@pytest.mark.parametrize(
    ("source", "weights", "status"),
    [
        (np.zeros((5, 3)), np.ones(5), "degenerate"),
        (np.outer(np.arange(5.0), [1, 2, 3]), np.ones(5), "degenerate"),
        (np.eye(3), np.zeros(3), "no_weight"),
        (np.eye(3), np.array([1.0, -1, 1]), "no_weight"),
        (np.zeros((0, 3)), np.zeros(0), "no_weight"),
        (np.full((3, 3), np.nan), np.ones(3), "not_finite"),
        (np.eye(3), np.array([1.0, np.inf, 1]), "not_finite"),
    ],
)
def test_kabsch_says_why_there_is_no_pose(source, weights, status):
    T, found = pose.kabsch(source, source + 1, weights)
    assert found == status
    assert np.isnan(T).all()


def test_perfect_targets_solve_to_the_goal(examples):
    pieces, goals, extents = crops_of(examples)
    net = PoseNet(TINY).eval()
    batch = pose.collate(pieces, extents, CPU)
    T = torch.from_numpy(goals).float()
    where = batch.object_points @ T[:, :3, :3].mT + T[:, None, :3, 3] / UNIT
    confidence = net(batch).log_confidence
    net.forward = lambda batch: pose.Matches(confidence, where)
    for goal, solution in zip(goals, pose.solve(net, batch)):
        assert solution.status == "ok"
        np.testing.assert_allclose(solution.T_crop_box, goal, atol=1e-5)
        assert solution.residual < 1e-5
