"""Where the cameras stand, and how wrong we are about it.

A view has two poses: `T_world_camera` is the believed one, which `align.py` corrects where views overlap before it is stored;
`T_world_camera_true` is where the rays start. Camera axes are OpenCV's: x right, y down, z ahead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dapdata.observe import CamerasConfig, NoiseConfig
from dapdata.observe.noise import PRESETS
from dapdata.observe.raycast import corners
from dapdata.poses import facing, pose, rotation_by, transform
from dapdata.records import Array, Demo


@dataclass(frozen=True)
class View:
    """One camera."""

    width: int
    height: int
    K: Array  # (3, 3) f8, px
    T_world_camera: Array  # (4, 4) f8, believed
    T_world_camera_true: Array  # (4, 4) f8
    noise_seed: int  # of the depth noise


def container_views(demo: Demo, cameras: CamerasConfig, noise: NoiseConfig, rng: np.random.Generator) -> list[View]:
    """Views spread evenly over +- container_yaw_spread_deg about the opening direction, onto the container's centre.

    An opening that points straight up has no yaw; the container's x axis stands in for it.

    Source: RPDiff's simulated cameras (+- 25 degrees, 1 m away), extended to any number of views.
    """
    box = corners(demo.part_size, demo.T_container_part).reshape(-1, 3)
    focus = transform(demo.T_world_container, (box.min(0) + box.max(0))[None] / 2)[0]
    out = facing(demo.T_world_container, demo.opening)
    spread = cameras.container_yaw_spread_deg if cameras.container_views > 1 else 0.0
    yaws = np.degrees(np.arctan2(out[1], out[0])) + np.linspace(-spread, spread, cameras.container_views)
    return [
        _view(focus, yaw, cameras.container_pitch_deg, cameras.container_distance, 1.0, cameras, noise, rng) for yaw in yaws
    ]


def object_views(demo: Demo, cameras: CamerasConfig, noise: NoiseConfig, rng: np.random.Generator) -> list[View]:
    """Views evenly around the object at its start pose, the first at a random yaw."""
    focus = demo.T_world_object_start[:3, 3]
    yaws = rng.uniform(0, 360) + np.arange(cameras.object_views) * 360 / cameras.object_views
    scale = cameras.object_view_scale
    return [_view(focus, yaw, cameras.object_pitch_deg, cameras.object_distance, scale, cameras, noise, rng) for yaw in yaws]


def intrinsics(width: int, height: int, vfov_deg: float) -> Array:
    """(3, 3) intrinsics, px, with square pixels and the optical axis through the image's centre."""
    f = height / 2 / np.tan(np.radians(vfov_deg) / 2)
    return np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]])


def look_at(focus: Array, yaw_deg: float, pitch_deg: float, distance: float) -> Array:
    """(4, 4) pose of an upright camera that stands `distance` from focus (m, world) at a yaw and looks down by a pitch."""
    yaw, pitch = np.radians(yaw_deg), np.radians(pitch_deg)
    back = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([-np.sin(yaw), np.cos(yaw), 0])
    return pose(np.stack([right, np.cross(-back, right), -back], axis=1), focus + distance * back)


def _view(
    focus: Array,
    yaw_deg: float,
    pitch_deg: float,
    distance: float,
    scale: float,
    cameras: CamerasConfig,
    noise: NoiseConfig,
    rng: np.random.Generator,
) -> View:
    """One view; always makes the same draws, so that the noise settings do not move the cameras."""
    jitter, error, noise_seed = rng.uniform(-1, 1, 6), rng.normal(size=6), int(rng.integers(2**63))
    believed = look_at(
        focus + cameras.focus_jitter * jitter[3:],
        yaw_deg + cameras.yaw_jitter_deg * jitter[0],
        pitch_deg + cameras.pitch_jitter_deg * jitter[1],
        distance + cameras.distance_jitter * jitter[2],
    )
    width, height = round(cameras.width * scale), round(cameras.height * scale)
    K = intrinsics(width, height, cameras.vfov_deg)
    return View(width, height, K, believed, believed @ pose_error(noise, error), noise_seed)


def pose_error(noise: NoiseConfig, normal: Array) -> Array:
    """(4, 4) T_believed_true from six standard normals: translation along, then rotation about the camera's axes."""
    preset = PRESETS[noise.preset]
    translation = preset.camera_translation if noise.camera_translation is None else noise.camera_translation
    rotation_deg = preset.camera_rotation_deg if noise.camera_rotation_deg is None else noise.camera_rotation_deg
    return pose(rotation_by(np.radians(rotation_deg) * normal[3:]), translation * normal[:3])
