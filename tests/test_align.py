"""Views that are aligned agree with each other, keep what they share, and do not move where nothing says they should."""

from __future__ import annotations

import numpy as np
import pytest
from shelf_scene import shelf_demo

from dapdata import rng
from dapdata.observe import CamerasConfig, NoiseConfig, observe
from dapdata.observe.align import align
from dapdata.observe.cameras import View, container_views
from dapdata.observe.fuse import view_cloud
from dapdata.observe.noise import add_noise
from dapdata.observe.raycast import cast
from dapdata.poses import inverse, rotate, transform
from dapdata.records import Cloud

D415 = NoiseConfig(preset="d415")


def seen(demo, noise, i=0) -> tuple[list[View], list[np.ndarray], list[np.ndarray]]:
    """The container's views, and the points and normals of each, camera frame."""
    views = container_views(demo, CamerasConfig(), noise, rng.stream(0, "align", i))
    clouds = []
    for view in views:
        T_camera_part = inverse(view.T_world_camera_true) @ demo.T_world_container @ demo.T_container_part
        image = cast(demo.part_kind, demo.part_size, T_camera_part, view.K, view.width, view.height)
        clouds.append(view_cloud(add_noise(image, view.K, noise.preset, view.noise_seed), view))
    return views, [points for points, _ in clouds], [normals for _, normals in clouds]


def errors(demo, views, T_world_camera) -> np.ndarray:
    """(V, 8, 3) m: how far eight points of the container are from where they are, as each camera sees them."""
    corner = np.array([[x, y, z] for x in (-0.08, 0.08) for y in (-0.25, 0.25) for z in (0.05, 0.5)])
    places = transform(demo.T_world_container, corner)
    true = [view.T_world_camera_true for view in views]
    return np.stack([transform(T @ inverse(T_true), places) - places for T, T_true in zip(T_world_camera, true)])


def test_views_of_a_shelf_agree_ten_times_better_and_keep_the_error_that_they_share() -> None:
    before, after, shared = [], [], []
    for i in range(8):
        demo = shelf_demo(i)
        views, points, normals = seen(demo, D415, i)
        believed = errors(demo, views, [view.T_world_camera for view in views])
        aligned = errors(demo, views, align(views, points, normals))
        before.append(believed - believed.mean(axis=0))
        after.append(aligned - aligned.mean(axis=0))
        shared.append(aligned.mean(axis=0) - believed.mean(axis=0))
    rms_before, rms_after, rms_shift = (float(np.sqrt(np.mean(np.square(e)))) for e in (before, after, shared))
    assert rms_before > 0.0025
    assert rms_after < 0.1 * rms_before
    assert rms_shift < 0.5 * rms_before  # no view is told more than the others: their mean hardly moves


def test_views_whose_poses_are_right_hardly_move() -> None:
    demo = shelf_demo(2)
    views, points, normals = seen(demo, NoiseConfig(preset="none"))
    assert np.abs(errors(demo, views, align(views, points, normals))).max() < 2e-4


def test_what_no_other_view_sees_stays_as_it_was_believed() -> None:
    views, points, normals = seen(shelf_demo(2), D415)
    apart = [p + np.float32([0, 0, 5 * v]) for v, p in enumerate(points)]
    np.testing.assert_allclose(align(views, apart, normals), [view.T_world_camera for view in views], atol=1e-15)
    nothing = np.zeros((0, 3), np.float32)
    np.testing.assert_array_equal(align(views, [nothing] * 3, [nothing] * 3), [view.T_world_camera for view in views])


def test_a_single_wall_says_nothing_of_a_slide_along_it() -> None:
    demo = shelf_demo(2)
    views, points, normals = seen(demo, D415)
    back = demo.T_world_container[:3, 0]
    wall = [rotate(view.T_world_camera, n) @ back > 0.95 for view, n in zip(views, normals)]
    T = align(views, [p[w] for p, w in zip(points, wall)], [n[w] for n, w in zip(normals, wall)])
    moved = np.stack([t[:3, 3] - view.T_world_camera[:3, 3] for t, view in zip(T, views)])
    assert np.abs(moved).max() < 0.01  # within what calibrations are wrong by: no view runs away along the wall


@pytest.mark.parametrize("views", [1, 3])
def test_the_stored_poses_are_those_that_the_cloud_was_fused_with(views: int) -> None:
    demo, cameras = shelf_demo(1), CamerasConfig(container_views=views)
    aligned = observe(demo, cameras, D415, rng.stream(0, "observe", 0))
    believed = observe(demo, cameras.model_copy(update={"align": False}), D415, rng.stream(0, "observe", 0))
    assert isinstance(aligned, Cloud)
    assert isinstance(believed, Cloud)
    assert np.array_equal(aligned.T_world_camera[:views], believed.T_world_camera[:views]) == (views == 1)
    T_aligned_believed = aligned.T_world_camera @ inverse(believed.T_world_camera)
    assert np.abs(T_aligned_believed[:, :3, :3] - np.eye(3)).max() < 0.03
