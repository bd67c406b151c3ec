"""Clouds: exact rays against two independent renderers, cameras, normals, fusion."""

from __future__ import annotations

import ctypes
import hashlib
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shelf_scene import BOX, make_demo, observe_with_truth, shelf_demo

from dapdata import rng
from dapdata.observe import CamerasConfig, NoiseConfig, observe
from dapdata.observe.cameras import container_views, intrinsics, look_at, object_views
from dapdata.observe.fuse import fuse, view_cloud
from dapdata.observe.raycast import CYLINDER, ELLIPSOID, cast
from dapdata.poses import inverse, pose, random_rotation
from dapdata.records import PART_KINDS, Cloud, Rejected, to_sample

CLEAN, NOISY = NoiseConfig(preset="none"), NoiseConfig(preset="d415")


def generator(demo: int = 0) -> np.random.Generator:
    return rng.stream(0, "observe", demo)


def seen(demo, cameras=None, noise=NOISY) -> Cloud:
    cloud = observe(demo, cameras or CamerasConfig(), noise, generator())
    assert isinstance(cloud, Cloud)
    return cloud


def tiny_renderer(demo, T_world_camera, width, height, vfov_deg, near=0.1, far=5.0):
    """Depth (0 for none) and part of PyBullet's software renderer."""
    bullet = pytest.importorskip("pybullet")
    client = bullet.connect(bullet.DIRECT)
    bodies = {}
    for p, T in enumerate(demo.T_world_container @ demo.T_container_part):
        size = demo.part_size[p]
        if demo.part_kind[p] == BOX:
            shape = bullet.createVisualShape(bullet.GEOM_BOX, halfExtents=size / 2, physicsClientId=client)
        else:
            shape = bullet.createVisualShape(bullet.GEOM_CYLINDER, radius=size[0] / 2, length=size[2], physicsClientId=client)
        yaw = np.arctan2(T[1, 0], T[0, 0])
        quaternion = [0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]
        body = bullet.createMultiBody(0, -1, shape, T[:3, 3], quaternion, physicsClientId=client)
        bodies[body] = p
    view = (np.diag([1.0, -1, -1, 1]) @ inverse(T_world_camera)).T.ravel()
    projection = bullet.computeProjectionMatrixFOV(vfov_deg, width / height, near, far)
    out = bullet.getCameraImage(width, height, view, projection, renderer=bullet.ER_TINY_RENDERER, physicsClientId=client)
    bullet.disconnect(client)
    buffer, body = np.reshape(out[3], (height, width)).astype(float), np.reshape(out[4], (height, width))
    part = np.vectorize(lambda b: bodies.get(b, -1))(body)
    return np.where(part >= 0, far * near / (far - (far - near) * buffer), 0), part


@pytest.mark.parametrize(("width", "height"), [(320, 240), (640, 480)])
def test_depth_and_parts_agree_with_another_renderer(width, height):
    demo = shelf_demo(2)
    T_world_camera = look_at(demo.T_world_container[:3, 3] + [0, 0, 0.28], 30 + np.degrees(0.3), 18, 1.0)
    depth, part = tiny_renderer(demo, T_world_camera, width, height, 60.0)
    K = intrinsics(width, height, 60.0)
    K[:2, 2] += [0.5, -0.5]  # TinyRenderer samples pixel (u, v) at (u, v + 1), not at (u + 0.5, v + 0.5)
    T_camera_part = inverse(T_world_camera) @ demo.T_world_container @ demo.T_container_part
    image = cast(demo.part_kind, demo.part_size, T_camera_part, K, width, height)
    both = (part >= 0) & (image.part >= 0)
    assert both.mean() > 0.1
    difference = np.abs(depth - image.depth)[both]
    assert np.median(difference) < 1e-5
    assert (difference > 5e-3).mean() < 5e-3
    assert (part == image.part)[(part >= 0) | (image.part >= 0)].mean() > 0.985  # of the pixels on parts
    assert (part == image.part).mean() >= 0.995


def test_ellipsoids_agree_with_a_fine_mesh():
    libusb_package = pytest.importorskip("libusb_package")
    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    o3d = pytest.importorskip("open3d")
    random = np.random.default_rng(5)
    size = random.uniform(0.05, 0.3, (6, 3))
    T = np.stack([pose(random_rotation(random), random.uniform([-0.3, -0.2, 0.8], [0.3, 0.2, 1.4])) for _ in size])
    width, height = 320, 240
    K = intrinsics(width, height, 60.0)
    image = cast(np.full(6, ELLIPSOID), size, T, K, width, height)
    scene = o3d.t.geometry.RaycastingScene()
    for p in range(6):
        mesh = o3d.geometry.TriangleMesh.create_sphere(0.5, 200)
        mesh.vertices = o3d.utility.Vector3dVector((np.asarray(mesh.vertices) * size[p]) @ T[p, :3, :3].T + T[p, :3, 3])
        scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    v, u = np.mgrid[:height, :width] + 0.5
    ray = np.stack([0 * u, 0 * u, 0 * u, (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], 0 * u + 1], axis=-1)
    hit = scene.cast_rays(o3d.core.Tensor(ray.astype(np.float32)))
    depth, part = hit["t_hit"].numpy(), hit["geometry_ids"].numpy().astype(np.int64)
    both = np.isfinite(depth) & (image.part >= 0)
    assert both.sum() > 2000
    assert (np.isfinite(depth) == (image.part >= 0)).mean() > 0.998
    assert (part == image.part)[both].mean() > 0.998
    difference = np.abs(depth - image.depth)[both]
    assert np.median(difference) < 5e-5
    assert (difference > 1e-3).mean() < 5e-3
    cosine = np.einsum(
        "ij,ij->i",
        hit["primitive_normals"].numpy()[both],
        -ray[both][:, 3:] / np.linalg.norm(ray[both][:, 3:], axis=1)[:, None],
    )
    assert np.median(np.abs(np.abs(cosine) - image.facing[both])) < 0.01


def one_part(kind, size, T, width=65, height=65, **limits):
    return cast(np.array([kind]), np.array([size], float), T[None], intrinsics(width, height, 60.0), width, height, **limits)


@pytest.mark.parametrize("name", ["box", "cylinder", "ellipsoid"])
def test_the_middle_pixel_sees_the_nearest_surface(name):
    image = one_part(PART_KINDS.index(name), (0.2, 0.2, 0.3), pose(None, (0, 0, 1.0)))
    assert image.depth[32, 32] == pytest.approx(0.85, abs=1e-6)
    assert image.facing[32, 32] == pytest.approx(1, abs=1e-6)
    assert image.part[32, 32] == 0
    assert image.part[0, 0] == -1
    assert image.depth[0, 0] == image.facing[0, 0] == 0


def test_a_lying_cylinder_shows_its_mantle():
    lying = pose(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), (0, 0, 1.0))  # its z axis along the camera's x
    image = one_part(CYLINDER, (0.2, 0.2, 0.3), lying)
    assert image.depth[32, 32] == pytest.approx(0.9, abs=1e-6)
    assert image.facing[32, 32] == pytest.approx(1, abs=1e-6)


def test_a_floor_that_reaches_behind_the_camera_is_seen_where_it_is():
    image = one_part(BOX, (4, 0.1, 4), pose(None, (0, 0.55, 0)))  # top face 0.5 below the camera
    v = np.arange(65)[:, None] + 0.5 - 32.5
    with np.errstate(divide="ignore"):
        expected = np.where(v > 0, 0.5 * intrinsics(65, 65, 60.0)[1, 1] / v, 0)
    expected = np.where(expected <= 2, expected, 0).repeat(65, axis=1)
    inside = np.abs(np.arange(65) + 0.5 - 32.5) < 30  # the box is 4 m wide
    np.testing.assert_allclose(image.depth[:, inside], expected[:, inside], atol=1e-5)


@pytest.mark.parametrize("T", [pose(None, (0, 0, -1.0)), pose(), pose(None, (5, 0, 1))], ids=["behind", "around", "aside"])
@pytest.mark.parametrize("kind", range(3))
def test_parts_behind_around_or_beside_the_camera_are_not_seen(kind, T):
    assert (one_part(kind, (0.2, 0.2, 0.2), T).part == -1).all()


def test_near_and_far_cut():
    T = pose(None, (0, 0, 1.0))
    assert (one_part(BOX, (0.2, 0.2, 0.2), T, near=0.95).part == -1).all()
    assert (one_part(BOX, (0.2, 0.2, 0.2), T, far=0.85).part == -1).all()


def test_meshes_are_refused():
    with pytest.raises(ValueError, match="mesh"):
        one_part(PART_KINDS.index("mesh"), (1, 1, 1), pose())


def test_container_views_are_spread_about_the_opening_and_look_at_the_container():
    demo = shelf_demo(4)
    still = CamerasConfig(container_views=5, distance_jitter=0, yaw_jitter_deg=0, pitch_jitter_deg=0, focus_jitter=0)
    views = container_views(demo, still, CLEAN, generator())
    yaws = []
    for view in views:
        in_container = inverse(demo.T_world_container) @ view.T_world_camera
        yaws.append(np.degrees(np.arctan2(in_container[1, 3], in_container[0, 3])))
        to_centre = np.array([0, 0, 0.28]) - in_container[:3, 3]
        assert np.linalg.norm(to_centre) == pytest.approx(still.container_distance, abs=1e-9)
        np.testing.assert_allclose(in_container[:3, 2], to_centre / still.container_distance, atol=1e-9)
        assert in_container[2, 1] < 0  # image y points down
        np.testing.assert_allclose(in_container[:3, :3] @ in_container[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(in_container[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(yaws, [-25, -12.5, 0, 12.5, 25], atol=1e-6)


def test_an_opening_that_points_up_has_views_from_the_x_axis():
    demo = replace(shelf_demo(4), opening=np.array([0.0, 0, 1]))
    views = container_views(demo, CamerasConfig(container_views=1, yaw_jitter_deg=0, focus_jitter=0), CLEAN, generator())
    in_container = inverse(demo.T_world_container) @ views[0].T_world_camera
    assert np.arctan2(in_container[1, 3], in_container[0, 3]) == pytest.approx(0, abs=1e-9)


def test_object_views_stand_around_the_object():
    demo = shelf_demo(4)
    views = object_views(demo, CamerasConfig(yaw_jitter_deg=0, focus_jitter=0), CLEAN, generator())
    assert len(views) == 4
    assert (views[0].width, views[0].height) == (160, 120)
    around = np.sum([view.T_world_camera[:2, 2] / np.linalg.norm(view.T_world_camera[:2, 2]) for view in views], axis=0)
    np.testing.assert_allclose(around, 0, atol=1e-9)


def test_the_noise_preset_does_not_move_the_believed_cameras():
    as_believed = CamerasConfig(align=False)
    clouds = [seen(shelf_demo(1), as_believed, NoiseConfig(preset=preset)) for preset in ("none", "d415", "kinect")]
    for cloud in clouds[1:]:
        assert cloud.T_world_camera.tobytes() == clouds[0].T_world_camera.tobytes()
        assert cloud.camera_K.tobytes() == clouds[0].camera_K.tobytes()


def test_the_cameras_pose_error_has_the_stated_size():
    demo, noise = shelf_demo(1), NoiseConfig(preset="none", camera_translation=0.002, camera_rotation_deg=0.3)
    off = [
        inverse(view.T_world_camera) @ view.T_world_camera_true
        for i in range(100)
        for view in container_views(demo, CamerasConfig(), noise, generator(i))
    ]
    shift = np.array([T[:3, 3] for T in off])
    turn = np.degrees([[T[2, 1], T[0, 2], T[1, 0]] for T in off])
    np.testing.assert_allclose(shift.std(axis=0), 0.002, rtol=0.15)
    np.testing.assert_allclose(turn.std(axis=0), 0.3, rtol=0.15)


def off_the_shelf(demo, points):
    """(N,) distance, m, from each point to the surface of the nearest part."""
    local = np.full(len(points), np.inf)
    for kind, size, T in zip(demo.part_kind, demo.part_size, demo.T_world_container @ demo.T_container_part):
        p = np.abs((points - T[:3, 3]) @ T[:3, :3])
        if kind == BOX:
            over = p - size / 2
        else:
            over = np.stack([np.hypot(p[:, 0], p[:, 1]) - size[0] / 2, p[:, 2] - size[2] / 2], axis=1)
        signed = np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(axis=1), 0)
        local = np.minimum(local, np.abs(signed))
    return local


def test_a_clean_cloud_lies_on_the_surfaces_and_a_pose_error_moves_it():
    demo = shelf_demo(1)
    clean = off_the_shelf(demo, seen(demo, CamerasConfig(align=False), CLEAN).container_points)
    assert np.median(clean) < 1e-5
    assert clean.max() < 0.008 * np.sqrt(3)  # a mean over a voxel with two faces lies between them
    moved = seen(demo, noise=NoiseConfig(preset="none", camera_translation=0.01, camera_rotation_deg=0.0))
    assert np.median(off_the_shelf(demo, moved.container_points)) > 0.002


@pytest.mark.parametrize("preset", ["none", "d415", "kinect"])
def test_normals_are_unit_and_point_to_the_sensor(preset):
    demo = shelf_demo(3)
    cloud = seen(demo, noise=NoiseConfig(preset=preset))
    for points, normals, view, first in (
        (cloud.container_points, cloud.container_normals, cloud.container_view, 0),
        (cloud.object_points, cloud.object_normals, cloud.object_view, 3),
    ):
        assert points.dtype == normals.dtype == np.float32
        assert view.dtype == np.uint8
        assert np.isfinite(points).all()
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
        assert len(np.unique(view)) > 1
        toward = cloud.T_world_camera[first + view, :3, 3] - points
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        # A voxel's normal is a mean over several views, so a few may turn away from the busiest one.
        assert (np.einsum("ij,ij->i", normals, toward) > 0).mean() > 0.97


def test_every_normal_of_one_view_points_to_the_sensor():
    demo = shelf_demo(3)
    (view,) = container_views(demo, CamerasConfig(container_views=1), CLEAN, generator())
    T_camera_part = inverse(view.T_world_camera) @ demo.T_world_container @ demo.T_container_part
    image = cast(demo.part_kind, demo.part_size, T_camera_part, view.K, view.width, view.height)
    points, normals = view_cloud(image.depth, view)
    assert len(points) > 0.99 * (image.part >= 0).sum()
    assert (np.einsum("ij,ij->i", normals, points) < 0).all()  # the camera is at the origin
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-6)


def test_normals_are_exact_on_clean_faces_and_good_on_noisy_ones():
    _, normals, truth = observe_with_truth(shelf_demo(1), CamerasConfig(), CLEAN, generator())
    angle = np.degrees(np.arccos(np.clip(np.einsum("ij,ij->i", normals, truth) / np.linalg.norm(truth, axis=1), -1, 1)))
    assert np.median(angle) < 0.05
    assert (angle > 20).mean() < 0.10  # edges, and boards of one pixel
    _, normals, truth = observe_with_truth(shelf_demo(1), CamerasConfig(), NOISY, generator())
    length = np.linalg.norm(truth, axis=1)
    angle = np.degrees(np.arccos(np.clip(np.einsum("ij,ij->i", normals, truth) / np.maximum(length, 1e-9), -1, 1)))
    assert np.median(angle) < 5
    assert (angle > 20).mean() < 0.16


def test_fusing_averages_a_voxel_and_names_its_busiest_view():
    up, side = [0.0, 0, 1], [1.0, 0, 0]
    first = np.array([[0.001, 0.001, 0.001], [0.021, 0.001, 0.001]], np.float32)
    second = np.array([[0.003, 0.001, 0.001], [0.002, 0.004, 0.001], [0.031, 0, 0], [0.031, 0, 0]], np.float32)
    fused = fuse(
        [first, second],
        [np.array([up, side], np.float32), np.array([side, up, up, [0, 0, -1]], np.float32)],
        np.stack([pose()] * 2),
        0.01,
    )
    # Voxels along x: 0 holds three points of which two are of view 1, 2 one of view 0, 3 two whose normals cancel.
    np.testing.assert_allclose(fused.points, [[0.002, 0.002, 0.001], [0.021, 0.001, 0.001]], atol=1e-7)
    np.testing.assert_allclose(fused.normals, [[np.sqrt(0.2), 0, 2 * np.sqrt(0.2)], side], atol=1e-6)
    assert fused.view.tolist() == [1, 0]


def test_fusing_nothing_gives_nothing():
    none = np.zeros((0, 3), np.float32)
    assert fuse([none, none], [none, none], np.stack([pose()] * 2), 0.01).points.shape == (0, 3)


def test_larger_voxels_give_fewer_points_and_more_pixels_more():
    demo = shelf_demo(1)
    usual = len(seen(demo).container_points)
    assert len(seen(demo, CamerasConfig(container_voxel=0.016)).container_points) < 0.5 * usual
    assert len(seen(demo, CamerasConfig(width=640, height=480)).container_points) > usual


def test_one_camera_sees_one_side_of_the_object():
    demo = shelf_demo(1)
    cloud = seen(demo, CamerasConfig(object_views=1), CLEAN)
    assert len(cloud.object_points) < 0.6 * len(seen(demo, noise=CLEAN).object_points)
    toward = cloud.T_world_camera[3, :3, 3] - cloud.object_points
    assert (np.einsum("ij,ij->i", cloud.object_normals, toward) > 0).all()


def test_the_object_hides_its_own_parts_and_the_container_is_not_in_its_cloud():
    parts = [(BOX, (0.2, 0.2, 0.2), (0, 0, 0.1))]
    post_behind_a_wall = [(BOX, (0.02, 0.2, 0.2), (0.1, 0, 0)), (BOX, (0.02, 0.02, 0.1), (-0.1, 0, 0))]
    start = pose(None, (0.0, 0.0, 0.1))  # in the midst of the container
    demo = make_demo(parts, post_behind_a_wall, pose(), start, start)
    cameras = CamerasConfig(object_views=1, object_pitch_deg=0, pitch_jitter_deg=0, min_object_points=1, focus_jitter=0)
    for i in range(40):
        cloud = observe(demo, cameras, CLEAN, generator(i))
        assert isinstance(cloud, Cloud)
        x = cloud.object_points[:, 0]
        assert (np.abs(np.abs(x) - 0.1) < 0.0105).all()
        if cloud.T_world_camera[3, 0, 3] > 0.38:  # the camera looks at the wall, the post is hidden
            assert (x > 0).all()
            break
    else:
        pytest.fail("no view of the wall among forty")


def test_nothing_in_sight_is_a_reject_not_an_error():
    demo = shelf_demo(1)
    cameras = CamerasConfig(far=0.5, near=0.4)
    assert observe(demo, cameras, NOISY, generator()) == Rejected("too_few_container_points")
    assert observe(demo, CamerasConfig(min_object_points=10**6), NOISY, generator()) == Rejected("too_few_object_points")
    assert observe(demo, CamerasConfig(min_container_points=10**6), CLEAN, generator()) == Rejected("too_few_container_points")


def test_an_object_too_small_for_the_pixels_is_a_reject():
    speck = [(BOX, (0.002, 0.002, 0.002), (0, 0, 0))]
    demo = make_demo([(BOX, (0.3, 0.3, 0.3), (0, 0, 0.15))], speck, pose(), pose(None, (0.5, 0, 0)), pose())
    assert observe(demo, CamerasConfig(), NOISY, generator()) == Rejected("too_few_object_points")


DIGEST = """
import hashlib, sys
sys.path.insert(0, {tests!r})
from shelf_scene import shelf_demo
from dapdata import rng
from dapdata.observe import CamerasConfig, NoiseConfig, observe
assert "numba" not in sys.modules, "importing the recipe section must not import numba"
from dapdata.records import to_sample
cloud = observe(shelf_demo(1), CamerasConfig(), NoiseConfig(), rng.stream(0, "observe", 0))
print(hashlib.sha256(b"".join(a.tobytes() for a in to_sample(cloud).values())).hexdigest())
"""


def test_a_fresh_process_makes_the_same_bytes():
    here = hashlib.sha256(b"".join(a.tobytes() for a in to_sample(seen(shelf_demo(1))).values())).hexdigest()
    code = DIGEST.format(tests=str(Path(__file__).parent))
    there = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert there.stdout.strip() == here
    other = observe(shelf_demo(1), CamerasConfig(), NOISY, generator(1))
    assert isinstance(other, Cloud)
    assert len(other.container_points) != len(seen(shelf_demo(1)).container_points)
