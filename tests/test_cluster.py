"""Superpoints: the wanted number, purity against the true normals, determinism, moves of the world, odd clouds."""

from __future__ import annotations

import numpy as np
import pytest
from shelf_scene import observe_with_truth, purity, shelf_demo

from dapdata import rng
from dapdata.cluster import SuperpointsConfig, cluster, means, partition, wall_alignment
from dapdata.observe import CamerasConfig, NoiseConfig, observe
from dapdata.poses import pose, rotate, rotation_about, transform
from dapdata.records import Cloud, Rejected, Superpoints
from dapdata.slic import assign, group_means, seed_groups

SLIC, VOXEL = SuperpointsConfig(), SuperpointsConfig(method="voxel")


@pytest.fixture(scope="module")
def cloud() -> Cloud:
    seen = observe(shelf_demo(1), CamerasConfig(), NoiseConfig(), rng.stream(0, "observe", 0))
    assert isinstance(seen, Cloud)
    return seen


def same_partition(a, b) -> float:
    """Share of the points whose group in `a` is mostly theirs in `b`."""
    pairs, size = np.unique(np.stack([a, b]), axis=1, return_counts=True)
    best = np.zeros(a.max() + 1)
    np.maximum.at(best, pairs[0], size)
    return float(best.sum() / len(a))


def random_cloud(n: int, seed: int = 0):
    random = np.random.default_rng(seed)
    normals = random.normal(size=(n, 3))
    return random.uniform(0, 0.3, (n, 3)), normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("config", [SLIC, VOXEL], ids=["slic", "voxel"])
@pytest.mark.parametrize("count", [40, 384, 1000])
def test_the_wanted_number_is_met_within_a_tenth(cloud, config, count):
    superpoints = cluster(cloud, config.model_copy(update={"count": count, "object_count": count // 12}))
    assert isinstance(superpoints, Superpoints)
    assert len(superpoints.container_superpoint_size) == pytest.approx(count, rel=0.1)
    assert len(superpoints.object_superpoint_size) == pytest.approx(count // 12, rel=0.1, abs=0.5)


@pytest.mark.parametrize("thing", ["book", "can"])
@pytest.mark.parametrize("seed", range(3))
def test_the_default_number_is_met_in_other_scenes(seed, thing):
    seen = observe(shelf_demo(seed, thing), CamerasConfig(), NoiseConfig(), rng.stream(0, "observe", seed))
    assert isinstance(seen, Cloud)
    superpoints = cluster(seen, SLIC)
    assert isinstance(superpoints, Superpoints)
    assert len(superpoints.container_superpoint_size) == pytest.approx(384, rel=0.1)
    assert len(superpoints.object_superpoint_size) == pytest.approx(32, rel=0.1)


@pytest.mark.parametrize("config", [SLIC, VOXEL], ids=["slic", "voxel"])
def test_every_point_has_a_superpoint_and_every_superpoint_is_the_mean_of_its_points(cloud, config):
    superpoints = cluster(cloud, config)
    assert isinstance(superpoints, Superpoints)
    for label, points, normals, centre, normal, size in (
        (
            superpoints.container_superpoint,
            cloud.container_points,
            cloud.container_normals,
            superpoints.container_superpoint_points,
            superpoints.container_superpoint_normals,
            superpoints.container_superpoint_size,
        ),
        (
            superpoints.object_superpoint,
            cloud.object_points,
            cloud.object_normals,
            superpoints.object_superpoint_points,
            superpoints.object_superpoint_normals,
            superpoints.object_superpoint_size,
        ),
    ):
        assert label.shape == (len(points),)
        assert label.dtype == size.dtype == np.int32
        assert centre.dtype == normal.dtype == np.float32
        assert np.array_equal(np.unique(label), np.arange(len(size)))
        for s in range(len(size)):
            mine = label == s
            assert mine.sum() == size[s]
            np.testing.assert_allclose(centre[s], points[mine].mean(axis=0, dtype=float), atol=1e-6)
            mean = normals[mine].mean(axis=0, dtype=float)
            if np.linalg.norm(mean) > 0.01:
                np.testing.assert_allclose(normal[s], mean / np.linalg.norm(mean), atol=1e-4)
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)


def test_superpoints_keep_to_one_face():
    """The floor of purity; a mixture of position alone reaches a coherence of about 0.68 on such shelves."""
    coherence, bad, clean, clean_bad = [], [], [], []
    for seed in range(3):
        points, normals, truth = observe_with_truth(
            shelf_demo(seed), CamerasConfig(), NoiseConfig(), rng.stream(0, "observe", seed)
        )
        noisy = purity(partition(points, normals, 384, SLIC), truth)
        length = np.maximum(np.linalg.norm(truth, axis=1, keepdims=True), 1e-9)
        exact = purity(partition(points, truth / length, 384, SLIC), truth)
        coherence, bad = [*coherence, noisy[0]], [*bad, noisy[1]]
        clean, clean_bad = [*clean, exact[0]], [*clean_bad, exact[1]]
    assert np.mean(coherence) > 0.91
    assert np.mean(bad) < 0.075
    assert np.mean(clean) > 0.95  # with the true normals: what the clustering itself loses
    assert np.mean(clean_bad) < 0.015


def test_the_same_cloud_gives_the_same_superpoints(cloud):
    first, second = cluster(cloud, SLIC), cluster(cloud, SLIC)
    assert isinstance(first, Superpoints)
    assert isinstance(second, Superpoints)
    assert first.container_superpoint.tobytes() == second.container_superpoint.tobytes()
    assert first.container_superpoint_points.tobytes() == second.container_superpoint_points.tobytes()


@pytest.mark.parametrize("config", [SLIC, VOXEL], ids=["slic", "voxel"])
@pytest.mark.parametrize("yaw", [0.0, 0.4, 2.0])
def test_moving_the_world_moves_the_superpoints_along(cloud, config, yaw):
    points, normals = cloud.container_points.astype(float), cloud.container_normals.astype(float)
    T = pose(rotation_about((0, 0, 1), yaw), (3.0, -2.0, 0.7))
    here = partition(points, normals, 384, config)
    there = partition(transform(T, points), rotate(T, normals), 384, config)
    # A turn shifts the grid's corner against the cloud only by quarter turns.
    assert same_partition(here, there) > (0.99 if yaw == 0 else 0.5)
    assert there.max() == pytest.approx(here.max(), rel=0.1)


def test_walls_are_found_at_any_yaw():
    walls = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    for yaw in (-0.7, 0.1, 0.5):
        R = rotation_about((0, 0, 1), yaw)
        np.testing.assert_allclose(np.abs(walls @ R.T @ wall_alignment(walls @ R.T)).max(axis=1), 1, atol=1e-9)


def test_assignment_equals_brute_force():
    points, normals = random_cloud(400)
    group, cell = seed_groups(points, normals, 30)
    assert group.max() == 29
    label = assign(points, normals, group, cell, 1.5, 2.0, 1)
    seed_points, seed_normals, _ = group_means(points, normals, group, 30, 1)
    offset = points[:, None] - seed_points
    distance = (
        (offset**2).sum(axis=2) / cell**2
        + 1.5**2 * (1 - normals @ seed_normals.T)
        + 2.0**2 * np.einsum("ijk,jk->ij", offset, seed_normals) ** 2 / cell**2
    )
    apart = np.abs((points / cell).astype(int)[:, None] - (seed_points / cell).astype(int)).max(axis=2)
    distance[(apart > 1) & (group[:, None] != np.arange(30))] = np.inf
    assert np.array_equal(label, distance.argmin(axis=1))


def test_few_points_are_their_own_superpoints():
    points, normals = random_cloud(20)
    assert np.array_equal(partition(points, normals, 20, SLIC), np.arange(20))
    assert np.array_equal(partition(points, normals, 384, SLIC), np.arange(20))
    assert len(np.unique(partition(points, normals, 19, SLIC))) in (18, 19)
    assert np.array_equal(partition(points[:1], normals[:1], 1, SLIC), [0])


@pytest.mark.parametrize("config", [SLIC, VOXEL], ids=["slic", "voxel"])
def test_odd_clouds_get_superpoints_too(config):
    points, normals = random_cloud(500)
    up = np.tile([0.0, 0, 1], (500, 1))
    one_place = partition(np.ones((500, 3)), up, 30, config)
    assert (one_place == 0).all()
    flat = partition(points * [1, 1, 0], up, 30, config)
    assert len(np.unique(flat)) == pytest.approx(30, rel=0.1)
    line = partition(points * [1, 0, 0], up, 30, config)
    assert len(np.unique(line)) == pytest.approx(30, rel=0.1)
    far = np.concatenate([points, [[1000.0, 0, 0]]])
    stray = partition(far, np.concatenate([normals, up[:1]]), 30, config)
    assert len(np.unique(stray)) == pytest.approx(30, rel=0.1)
    opposite = means(np.zeros((2, 3)), np.array([[0.0, 0, 1], [0, 0, -1]]), np.zeros(2, np.int32))
    assert opposite[1].tolist() == [[0, 0, 1]]


def test_an_empty_cloud_is_a_reject():
    none = np.zeros((0, 3), np.float32)
    view = np.zeros(0, np.uint8)
    empty = Cloud(none, none, view, none, none, view, np.zeros((0, 3, 3)), np.zeros((0, 4, 4)))
    assert cluster(empty, SLIC) == Rejected("empty_cloud")
