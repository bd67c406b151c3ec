"""Labels: hand-drawn points, brute-force twins, moves of the world, and no simulator."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from pydantic import ValidationError
from shelf_scene import shelf_demo

from dapdata import rng
from dapdata.cluster import SuperpointsConfig, cluster
from dapdata.labels import LabelConfig, affordance, correspondence, distance_to_object, label, near_object
from dapdata.observe import CamerasConfig, NoiseConfig, observe
from dapdata.poses import inverse, pose, rotation_about, transform
from dapdata.records import Cloud, Superpoints

ORIGIN = np.zeros((1, 3))
ROW = np.array([[0.01, 0, 0], [0.03, 0, 0], [0, 0.031, 0], [0, 0, 0.06]])  # distances 10, 30, 31 and 60 mm


@pytest.fixture(scope="module")
def labelled():
    demo = shelf_demo(2)
    coarse = CamerasConfig(container_voxel=0.016, object_voxel=0.016)
    cloud = observe(demo, coarse, NoiseConfig(), rng.stream(0, "observe", 0))
    assert isinstance(cloud, Cloud)
    superpoints = cluster(cloud, SuperpointsConfig())
    assert isinstance(superpoints, Superpoints)
    return demo, cloud, superpoints


def placed(demo, points):
    return transform(demo.T_world_object_goal @ inverse(demo.T_world_object_start), points.astype(float))


@pytest.mark.parametrize(
    ("eps_place", "near"),
    [
        (0.005, [False, False, False, False]),
        (0.01, [True, False, False, False]),
        (0.03, [True, True, False, False]),  # the boundary counts
        (0.031, [True, True, True, False]),
        (0.1, [True, True, True, True]),
    ],
)
def test_near_is_within_eps_place_the_boundary_included(eps_place, near):
    assert near_object(ROW, ORIGIN, eps_place).tolist() == near
    expected = [(2 * sum(near[:2]) - 2) / 2, (2 * sum(near[2:]) - 2) / 2]
    assert affordance(ROW, np.array([0, 0, 1, 1]), ORIGIN, eps_place).tolist() == expected


def test_soft_scores_fall_from_one_to_2_over_e_minus_1_and_are_minus_one_beyond():
    points = np.array([[0, 0, 0], [0.015, 0, 0], [0.03, 0, 0], [0.0301, 0, 0]])
    score = affordance(points, np.arange(4), ORIGIN, 0.03, "soft")
    np.testing.assert_allclose(score, [1, 2 * np.exp(-0.5) - 1, 2 / np.e - 1, -1], atol=1e-6)


def brute_force(demo, cloud, superpoints, config):
    """Affordance (S,) and correspondence pairs with distances, in plain loops over all pairs."""
    moved = placed(demo, cloud.object_points)
    points = cloud.container_points.astype(float)
    nearest = np.array([np.sqrt(((moved - p) ** 2).sum(axis=1)).min() for p in points])
    if config.kind == "hard":
        score = np.where(nearest <= config.eps_place, 1.0, -1.0)
    else:
        score = np.where(nearest <= config.eps_place, 2 * np.exp(-nearest / config.eps_place) - 1, -1.0)
    num = len(superpoints.container_superpoint_size)
    mean = [score[superpoints.container_superpoint == s].mean() for s in range(num)]
    pairs = []
    for o, q in enumerate(placed(demo, superpoints.object_superpoint_points)):
        for c, p in enumerate(superpoints.container_superpoint_points.astype(float)):
            if (distance := np.sqrt(((p - q) ** 2).sum())) <= config.eps_corr:
                pairs.append((o, c, distance))
    return np.array(mean), np.array(pairs)


@pytest.mark.parametrize("kind", ["hard", "soft"])
@pytest.mark.parametrize("eps_place", [0.02, 0.03, 0.08])
def test_labels_equal_brute_force(labelled, kind, eps_place):
    config = LabelConfig(kind=kind, eps_place=eps_place, eps_corr=0.06)
    labels = label(*labelled, config)
    mean, pairs = brute_force(*labelled, config)
    assert labels.affordance.dtype == labels.corr_distance.dtype == np.float32
    assert labels.corr_object.dtype == labels.corr_container.dtype == np.int32
    np.testing.assert_allclose(labels.affordance, mean, atol=1e-6)
    assert (mean > -1).sum() > 5
    assert np.array_equal(np.stack([labels.corr_object, labels.corr_container], axis=1), pairs[:, :2])
    np.testing.assert_allclose(labels.corr_distance, pairs[:, 2], atol=1e-7)
    assert labels.affordance.min() >= -1
    assert labels.affordance.max() <= 1


def test_distances_equal_brute_force_and_are_infinite_beyond_the_limit():
    random = np.random.default_rng(0)
    points, things = random.uniform(0, 1, (300, 3)), random.uniform(0.3, 0.5, (20, 3))
    full = np.linalg.norm(points[:, None] - things, axis=2).min(axis=1)
    np.testing.assert_allclose(distance_to_object(points, things, 0.2), np.where(full <= 0.2, full, np.inf), atol=1e-12)


def test_pairs_are_sorted_by_object_then_container_the_boundary_included():
    things = np.array([[0.0, 0, 0], [1, 0, 0]])
    places = np.array([[1.05, 0, 0], [0, 0.05, 0], [0, 0, 0], [0, 0.0501, 0], [1, 0, 0]])
    o, c, distance = correspondence(things, places, 0.05)
    # 1.05 - 1 is a little over 0.05 in binary.
    assert list(zip(o.tolist(), c.tolist())) == [(0, 1), (0, 2), (1, 4)]
    np.testing.assert_allclose(distance, [0.05, 0, 0])


@pytest.mark.parametrize("kind", ["hard", "soft"])
def test_moving_the_whole_world_leaves_the_labels(labelled, kind):
    demo, cloud, superpoints = labelled
    T = pose(rotation_about((0.2, -0.5, 1), 1.1), (2.0, -1.0, 0.4))
    wide = replace(cloud, **{k: getattr(cloud, k).astype(float) for k in ("container_points", "object_points")})
    centres = ("container_superpoint_points", "object_superpoint_points")
    wide_superpoints = replace(superpoints, **{k: getattr(superpoints, k).astype(float) for k in centres})
    moved_demo = replace(
        demo,
        **{k: T @ getattr(demo, k) for k in ("T_world_container", "T_world_object_start", "T_world_object_goal", "goals")},
    )
    moved_cloud = replace(wide, **{k: transform(T, getattr(wide, k)) for k in ("container_points", "object_points")})
    moved_superpoints = replace(wide_superpoints, **{k: transform(T, getattr(wide_superpoints, k)) for k in centres})
    config = LabelConfig(kind=kind)
    here, there = label(demo, wide, wide_superpoints, config), label(moved_demo, moved_cloud, moved_superpoints, config)
    np.testing.assert_allclose(there.affordance, here.affordance, atol=1e-6)
    assert np.array_equal(there.corr_object, here.corr_object)
    assert np.array_equal(there.corr_container, here.corr_container)
    np.testing.assert_allclose(there.corr_distance, here.corr_distance, atol=1e-6)


def test_a_larger_eps_place_never_lowers_the_affordance(labelled):
    scores = [label(*labelled, LabelConfig(eps_place=eps)).affordance for eps in (0.005, 0.01, 0.03, 0.1, 0.2)]
    for smaller, larger in pairwise(scores):
        assert (larger >= smaller).all()
    assert scores[-1].sum() > scores[0].sum()


def test_an_object_far_from_all_points_shows_as_minus_one_everywhere(labelled):
    demo, cloud, superpoints = labelled
    away = replace(demo, T_world_object_goal=pose(None, (50.0, 0, 0)) @ demo.T_world_object_goal)
    labels = label(away, cloud, superpoints, LabelConfig())
    assert (labels.affordance == -1).all()
    assert len(labels.corr_object) == len(labels.corr_container) == len(labels.corr_distance) == 0


def test_the_goal_not_the_start_pose_is_labelled(labelled):
    demo, cloud, superpoints = labelled
    labels = label(demo, cloud, superpoints, LabelConfig())
    best = superpoints.container_superpoint_points[labels.affordance > 0.9]
    assert len(best) > 3
    assert np.linalg.norm(best - demo.T_world_object_goal[:3, 3], axis=1).max() < 0.25
    assert np.linalg.norm(best - demo.T_world_object_start[:3, 3], axis=1).min() > 0.25


@pytest.mark.parametrize("bad", [{"eps_place": 30}, {"eps_place": 0}, {"eps_corr": 30}, {"kind": "fuzzy"}, {"epsplace": 0.03}])
def test_values_out_of_range_are_refused(bad):
    with pytest.raises(ValidationError):
        LabelConfig(**bad)


def test_labelling_needs_no_simulator_and_no_kernels():
    code = "import sys, dapdata.labels; print(sorted({'pybullet', 'numba', 'scipy', 'torch'} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
