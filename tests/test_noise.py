"""Depth noise: a pure function of seed and pixel, with the statistics that its docstring states."""

from __future__ import annotations

from math import erf

import numpy as np
import pytest
from shelf_scene import shelf_demo

from dapdata import rng
from dapdata.observe import CamerasConfig, NoiseConfig
from dapdata.observe import noise as depth_noise
from dapdata.observe.cameras import container_views, intrinsics
from dapdata.observe.noise import PRESETS, add_noise, perturb, stereo_shadow
from dapdata.observe.raycast import Image, cast
from dapdata.poses import inverse, pose, rotation_about

K = intrinsics(320, 240, 60.0)
FOCAL_BASELINE = depth_noise.STEREO_FOCAL * depth_noise.STEREO_BASELINE


def wall(distance: float, turn_deg: float = 0.0) -> Image:
    """A large wall across the optical axis at a distance, turned about the image's vertical."""
    turned = pose(rotation_about((0, 1, 0), np.radians(turn_deg)), (0, 0, distance))
    thin = turned @ pose(None, (0, 0, 0.005))
    return cast(np.array([0]), np.array([[20.0, 20.0, 0.01]]), thin[None], K, 320, 240, 0.05, 20.0)


def shelf_image(distance: float = 1.35) -> Image:
    demo = shelf_demo(1)
    view = container_views(demo, CamerasConfig(container_distance=distance), NoiseConfig(), rng.stream(0, "observe", 0))[1]
    T_camera_part = inverse(view.T_world_camera) @ demo.T_world_container @ demo.T_container_part
    return cast(demo.part_kind, demo.part_size, T_camera_part, K, 320, 240)


@pytest.mark.parametrize("preset", ["d415", "kinect"])
def test_noise_does_not_depend_on_the_order_of_the_rows(preset):
    image, kernel = shelf_image(), PRESETS[preset].kernel
    whole = add_noise(image, K, preset, 7)
    shadow = stereo_shadow(image.depth, K[0, 0] * depth_noise.STEREO_BASELINE)
    rows = np.random.default_rng(0).permutation(240)
    parts = np.zeros_like(whole)
    for half in (rows[:100], rows[100:]):
        perturb(image.depth, image.facing, shadow, K[0, 0], kernel, np.uint64(7), half, parts)
    assert parts.tobytes() == whole.tobytes()
    assert add_noise(image, K, preset, 7).tobytes() == whole.tobytes()
    assert add_noise(image, K, preset, 8).tobytes() != whole.tobytes()


def test_the_clean_preset_leaves_the_image_as_it_is():
    image = shelf_image()
    clean = add_noise(image, K, "none", 7)
    assert clean.tobytes() == image.depth.tobytes()
    assert clean is not image.depth
    assert PRESETS["none"].camera_translation == PRESETS["none"].camera_rotation_deg == 0


@pytest.mark.parametrize("preset", ["d415", "kinect"])
def test_nothing_is_reported_where_nothing_is(preset):
    image = shelf_image()
    noisy = add_noise(image, K, preset, 3)
    assert (noisy[image.depth == 0] == 0).all()
    assert np.isfinite(noisy).all()
    assert (noisy >= 0).all()


def test_d415_errors_and_losses_at_working_distance_are_those_stated():
    image = shelf_image(1.35)
    noisy = add_noise(image, K, "d415", 1)
    kept = noisy[image.depth > 0] > 0
    error = np.abs(noisy - image.depth)[noisy > 0]
    assert 0.70 < kept.mean() < 0.95
    assert 0.002 < np.median(error) < 0.005
    assert np.quantile(error, 0.95) < 0.025


@pytest.mark.parametrize("distance", [0.5, 1.0, 2.0])
def test_d415_noise_grows_with_the_square_of_the_distance(distance):
    image = wall(distance)
    noisy = add_noise(image, K, "d415", 2)
    sigma = np.hypot(depth_noise.DISPARITY_NOISE, depth_noise.DISPARITY_STEP / np.sqrt(12))
    assert (noisy - image.depth)[noisy > 0].std() == pytest.approx(distance**2 / FOCAL_BASELINE * sigma, rel=0.03)
    assert (noisy > 0).mean() == pytest.approx(1 - depth_noise.RANDOM_DROP, abs=0.003)


def test_d415_depths_are_whole_steps_of_disparity():
    noisy = add_noise(wall(1.0), K, "d415", 2)
    steps = FOCAL_BASELINE / noisy[noisy > 0].astype(float) / depth_noise.DISPARITY_STEP
    assert np.abs(steps - np.rint(steps)).max() < 1e-3


def test_d415_loses_half_of_the_pixels_at_76_degrees():
    image = wall(1.0, 72.0)
    theta = np.degrees(np.arccos(np.clip(image.facing, 0, 1)))
    noisy = add_noise(image, K, "d415", 5)
    for low, high, share in ((75.5, 76.5, 0.5), (55, 60, 0.01), (84, 86, 0.955)):
        there = (image.depth > 0) & (theta > low) & (theta < high)
        assert there.sum() > 300
        assert (noisy[there] == 0).mean() == pytest.approx(share, abs=0.05)


def test_a_slanted_wall_has_no_edges_but_a_step_has():
    slanted = wall(1.0, 70.0).depth
    assert sum(depth_noise._across_edge(slanted, u, 120) > 0 for u in range(20, 300)) == 0
    step = np.full((9, 9), 1.0, np.float32)
    step[:, 5:] = 1.1
    found = np.array([[depth_noise._across_edge(step, u, v) for u in range(9)] for v in range(9)])
    assert (found[:, 4] == np.float32(1.1)).all()
    assert (found[:, 5] == 1.0).all()
    assert (found[:, [0, 1, 2, 3, 6, 7, 8]] == 0).all()


def test_edge_pixels_are_dropped_or_fly_between_the_surfaces_as_often_as_stated():
    step = wall(1.0)
    step.depth[:, 160:] = 1.1
    dropped, between = [], []
    for seed in range(20):
        noisy = add_noise(step, K, "d415", seed)[:, 160]
        dropped.append((noisy == 0).mean())
        between.append(((noisy > 0) & (np.abs(noisy - 1.1) > 0.02)).mean())
    assert np.mean(dropped) == pytest.approx(0.505, abs=0.03)
    assert np.mean(between) == pytest.approx(0.15 * 0.8, abs=0.03)  # a fifth of the flights are too short to tell


def test_the_stereo_shadow_lies_left_of_the_foreground_with_the_right_width():
    depth = np.full((1, 320), 2.0, np.float32)
    depth[0, 150:200] = 1.0
    hidden = np.flatnonzero(stereo_shadow(depth, 40.0)[0])
    # Disparity 40 in front, 20 behind: the front hides 20 pixels of the wall beside its left edge.
    assert hidden.min() == pytest.approx(130, abs=1)
    assert hidden.max() == 149
    assert len(hidden) == hidden.max() - hidden.min() + 1
    assert not stereo_shadow(np.full((3, 50), 1.5, np.float32), 40.0).any()


@pytest.mark.parametrize("distance", [0.8, 1.6])
def test_kinect_axial_noise_is_the_published_one(distance):
    image = wall(distance)
    noisy = add_noise(image, K, "kinect", 2)[60:180, 80:240]  # a wall across: reading another pixel changes nothing
    sigma = 0.0012 + 0.0019 * (distance - 0.4) ** 2
    assert (noisy - image.depth[60:180, 80:240])[noisy > 0].std() == pytest.approx(sigma, rel=0.03)


def test_kinect_lateral_noise_blurs_edges_by_the_published_width():
    step = wall(1.0)
    step.depth[:, 160:] = 2.0
    wide = intrinsics(640, 480, 60.0)
    noisy = add_noise(step, wide, "kinect", 4)
    crossed = [(noisy[:, 160 + i] < 1.5).mean() for i in range(4)]  # the probability to read left of column 160
    sigma = 0.8 * wide[0, 0] / depth_noise.KINECT_FOCAL  # px, plus a little where the ray is oblique
    expected = [0.5 * (1 - erf((i + 0.5) / sigma / np.sqrt(2))) for i in range(4)]
    np.testing.assert_allclose(crossed, expected, atol=0.06)


def test_the_hash_is_uniform_normal_and_uncorrelated():
    seed = np.uint64(12345)
    keys = [depth_noise._mix(seed, np.uint64(pixel)) for pixel in range(20_000)]
    uniform = np.array([[depth_noise._uniform(np.uint64(key), draw) for draw in range(3)] for key in keys])
    assert 0 < uniform.min() < uniform.max() < 1
    np.testing.assert_allclose(uniform.mean(axis=0), 0.5, atol=0.01)
    np.testing.assert_allclose(uniform.var(axis=0), 1 / 12, atol=0.002)
    neighbours = np.hstack([uniform[:-1], uniform[1:]])
    assert np.abs(np.corrcoef(neighbours.T) - np.eye(6)).max() < 0.03
    normal = np.array([depth_noise._normal(np.uint64(key), 0) for key in keys])
    assert normal.mean() == pytest.approx(0, abs=0.03)
    assert normal.std() == pytest.approx(1, abs=0.02)
    assert (np.abs(normal) > 3).mean() == pytest.approx(0.0027, abs=0.0015)
