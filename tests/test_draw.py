"""Pictures of points and solids: what is nearer hides what is farther, and nothing is drawn in the wrong place."""

from __future__ import annotations

import numpy as np
import pytest

from dapdata import draw, poses, rng

RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
SHAPES = {"box": 0, "cylinder": 1, "ellipsoid": 2}


def rendered(points: np.ndarray, colors: np.ndarray, camera: draw.Camera, *more: np.ndarray, **options: float) -> draw.Canvas:
    """A new canvas with a point cloud on it."""
    canvas = draw.blank(camera)
    draw.draw_cloud(canvas, points, colors, *more, **options)
    return canvas


def front_camera(width: int = 80, height: int = 60) -> draw.Camera:
    """2 m in front of the origin on +x, 100 px focal length."""
    return draw.Camera(draw.look_at((2, 0, 0), (0, 0, 0)), 100.0, width, height)


def mostly(pixel: np.ndarray, color: tuple[float, float, float]) -> bool:
    return int(pixel.argmax()) == int(np.argmax(color)) and pixel.max() > 2 * np.sort(pixel)[-2]


def test_frame_shows_every_point_and_wastes_no_room() -> None:
    points = rng.stream(0, "test", 0).uniform(-1, 1, (200, 3)) * [0.2, 0.5, 0.3] + [3, -2, 1]
    camera = draw.frame(points, (1, 0.4, 0.3), 320, 240)
    local = (points - camera.T_world_camera[:3, 3]) @ camera.T_world_camera[:3, :3]
    uv = np.abs(local[:, :2] / local[:, 2:] * camera.focal) / [160, 120]
    assert 0.94 < uv.max() <= 1


@pytest.mark.parametrize("shape", SHAPES)
def test_solids_are_where_the_depth_cameras_see_them(shape: str) -> None:
    raycast = pytest.importorskip("dapdata.observe.raycast")
    camera = front_camera()
    T_world_part = poses.pose(poses.random_rotation(rng.stream(0, "test", 1)), (0.1, -0.05, 0.04))
    size = np.array([0.3, 0.3, 0.5])
    found = draw.cast(camera, SHAPES[shape], size, T_world_part)
    assert found is not None
    depth = np.full((60, 80), np.inf)
    depth[found[0]] = found[1]
    K = np.array([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]])
    T_camera_part = (poses.inverse(camera.T_world_camera) @ T_world_part)[None]
    twin = raycast.cast(np.array([SHAPES[shape]]), size[None], T_camera_part, K, 80, 60).depth
    assert np.array_equal(np.isfinite(depth), twin > 0)
    assert np.allclose(depth[twin > 0], twin[twin > 0], atol=1e-5)


def test_the_nearer_point_hides_the_farther() -> None:
    points, colors = np.array([[0.0, 0, 0], [0.5, 0, 0]]), np.array([BLUE, RED])
    for order in ([0, 1], [1, 0]):
        pixels = draw.image(rendered(points[order], colors[order], front_camera(), radius=0.1))
        assert mostly(pixels[30, 40], RED)


def test_a_disc_seen_edge_on_is_a_line() -> None:
    canvas = rendered(np.zeros((1, 3)), np.array([RED]), front_camera(), np.array([[0, 0, 1.0]]), radius=0.2)
    seen = np.isfinite(canvas.depth)
    assert seen.any(axis=1).sum() <= 3
    flat = rendered(np.zeros((1, 3)), np.array([RED]), front_camera(), np.array([[1.0, 0, 0]]), radius=0.2)
    assert np.isfinite(flat.depth).sum() == pytest.approx(np.pi * (0.2 * 200 / 2) ** 2, rel=0.1)


def test_points_behind_the_camera_are_not_drawn() -> None:
    canvas = rendered(np.array([[3.0, 0, 0]]), np.array([RED]), front_camera())
    assert not np.isfinite(canvas.depth).any()


def test_hidden_solids_shine_through_only_when_asked() -> None:
    for hidden, visible in ((0.0, False), (0.5, True)):
        canvas = draw.blank(front_camera())
        wall = np.array([[0.02, 1, 1]]), poses.pose(None, (0.5, 0, 0))[None]
        draw.draw_solids(canvas, np.zeros(1, int), *wall, (1, 1, 1))
        before = draw.image(canvas)
        draw.draw_solids(canvas, np.ones(1, int), np.full((1, 3), 0.2), np.eye(4)[None], RED, 0.8, hidden)
        assert (not np.array_equal(before, draw.image(canvas))) is visible


def test_empty_lists_draw_nothing() -> None:
    canvas = draw.blank(front_camera())
    draw.draw_solids(canvas, np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 4, 4)), RED)
    assert (draw.image(canvas) == 255).all()


def test_a_picture_has_the_size_of_its_camera() -> None:
    assert draw.image(draw.blank(front_camera(81, 33))).shape == (33, 81, 3)
