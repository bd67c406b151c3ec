"""Depth cameras around the container and the object -> fused, voxelled clouds in the world frame.

`CamerasConfig` says where the cameras stand and how finely they see, `NoiseConfig` how badly and how wrong we are about where
they stand. What the views themselves tell about that is put right before they are fused (`align.py`). Segmentation is perfect:
container cameras see container and clutter, object cameras see the object alone, at its start pose.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from dapdata.config import Section, key
from dapdata.records import PART_KINDS, Cloud, Demo, Rejected, meshes_of

if TYPE_CHECKING:
    from dapdata.observe.cameras import View
    from dapdata.observe.fuse import Fused
    from dapdata.observe.raycast import Image
    from dapdata.records import Array, Mesh


class CamerasConfig(Section):
    """Depth cameras: image size, where they stand, and how finely their clouds are fused."""

    width: int = key(320, "image width", unit="px", ge=32, le=1920)
    height: int = key(240, "image height", unit="px", ge=24, le=1440)
    vfov_deg: float = key(60.0, "vertical field of view; larger: coarser, more fits in", unit="deg", ge=10, le=120)
    near: float = key(0.1, "surfaces closer than this are not seen", unit="m", ge=0.001, le=1)
    far: float = key(5.0, "surfaces farther than this are not seen", unit="m", ge=0.5, le=100)
    container_views: int = key(3, "cameras that look at the container", ge=1, le=32)
    container_distance: float = key(0.85, "from a container camera to the container's centre", unit="m", ge=0.2, le=10)
    container_yaw_spread_deg: float = key(
        25.0, "container cameras are spread evenly over +- this, about the opening direction", unit="deg", ge=0, le=180
    )
    container_pitch_deg: float = key(22.0, "how far a container camera looks down", unit="deg", ge=-30, le=85)
    object_views: int = key(4, "cameras that look at the object, evenly spread around it", ge=1, le=32)
    object_distance: float = key(0.42, "from an object camera to the object's centre", unit="m", ge=0.1, le=10)
    object_pitch_deg: float = key(35.0, "how far an object camera looks down", unit="deg", ge=-30, le=85)
    object_view_scale: float = key(0.5, "image size of an object camera relative to width x height", gt=0, le=1)
    distance_jitter: float = key(0.05, "distances vary by up to +- this", unit="m", ge=0, le=0.5)
    yaw_jitter_deg: float = key(3.0, "yaws vary by up to +- this", unit="deg", ge=0, le=180)
    pitch_jitter_deg: float = key(12.0, "pitches vary by up to +- this", unit="deg", ge=0, le=45)
    focus_jitter: float = key(0.02, "what a camera looks at varies by up to +- this along each axis", unit="m", ge=0, le=0.2)
    align: bool = key(
        True, "views are aligned to each other where they overlap, before they are fused; off: as their poses are believed"
    )
    container_voxel: float = key(
        0.008, "edge of the voxels that fuse the container's points; larger: fewer points", unit="m", ge=0.001, le=0.1
    )
    object_voxel: float = key(
        0.004, "edge of the voxels that fuse the object's points; larger: fewer points", unit="m", ge=0.0005, le=0.1
    )
    min_container_points: int = key(500, "a container cloud with fewer points is rejected", ge=1, le=1_000_000)
    min_object_points: int = key(50, "an object cloud with fewer points is rejected", ge=1, le=1_000_000)


class NoiseConfig(Section):
    """Depth noise and the error of the cameras' believed poses."""

    preset: Literal["none", "d415", "kinect"] = key("d415", "depth camera that is imitated, see dapdata/observe/noise.py")
    camera_translation: float | None = key(
        None, "std of each camera's position error along each axis; null: the preset's", unit="m", ge=0, le=0.05
    )
    camera_rotation_deg: float | None = key(
        None, "std of each camera's rotation error about each axis; null: the preset's", unit="deg", ge=0, le=5
    )


def observe(demo: Demo, cameras: CamerasConfig, noise: NoiseConfig, rng: np.random.Generator) -> Cloud | Rejected:
    """The clouds of container and object as the cameras saw them, or why they were too small.

    The views, and how much luck each has, are drawn the same way whatever the noise preset.

    Raises:
        MissingExtraError: numba is not installed.
    """
    from dapdata.errors import require

    require("numba", "sim")
    from dapdata.observe.cameras import container_views, object_views

    to_container = container_views(demo, cameras, noise, rng)
    to_object = object_views(demo, cameras, noise, rng)
    part_meshes, object_meshes = meshes_of(demo)
    T_world_part = demo.T_world_container @ demo.T_container_part
    container, of_container = _look(
        to_container, demo.part_kind, demo.part_size, part_meshes, T_world_part, cameras, noise, cameras.container_voxel
    )
    if len(container.points) < cameras.min_container_points:
        return Rejected("too_few_container_points")
    T_world_part = demo.T_world_object_start @ demo.T_object_part
    object_, of_object = _look(
        to_object, demo.object_kind, demo.object_size, object_meshes, T_world_part, cameras, noise, cameras.object_voxel
    )
    if len(object_.points) < cameras.min_object_points:
        return Rejected("too_few_object_points")
    return Cloud(
        container_points=container.points,
        container_normals=container.normals,
        container_view=container.view,
        object_points=object_.points,
        object_normals=object_.normals,
        object_view=object_.view,
        camera_K=np.stack([view.K for view in to_container + to_object]),
        T_world_camera=np.concatenate([of_container, of_object]),
    )


def _look(
    views: list[View],
    kind: Array,
    size: Array,
    meshes: list[Mesh | None],
    T_world_part: Array,
    cameras: CamerasConfig,
    noise: NoiseConfig,
    voxel: float,
) -> tuple[Fused, Array]:
    """The fused cloud of some parts, (P,) (P, 3) P (P, 4, 4), through V views, and (V, 4, 4) the poses it was fused with."""
    from dapdata.observe.align import align
    from dapdata.observe.fuse import fuse, view_cloud
    from dapdata.observe.noise import add_noise
    from dapdata.poses import inverse

    clouds = []
    for view in views:
        T_camera_part = inverse(view.T_world_camera_true) @ T_world_part
        image = image_of(view, kind, size, meshes, T_camera_part, cameras)
        clouds.append(view_cloud(add_noise(image, view.K, noise.preset, view.noise_seed), view))
    points, normals = [points for points, _ in clouds], [normals for _, normals in clouds]
    T_world_camera = np.stack([view.T_world_camera for view in views])
    if cameras.align and len(views) > 1:
        T_world_camera = align(views, points, normals)
    return fuse(points, normals, T_world_camera, voxel), T_world_camera


def image_of(
    view: View, kind: Array, size: Array, meshes: list[Mesh | None], T_camera_part: Array, cameras: CamerasConfig
) -> Image:
    """What the view sees of parts of any kind."""
    from dapdata.meshes import cast as cast_meshes
    from dapdata.observe.raycast import Image, cast

    frame = (view.K, view.width, view.height, cameras.near, cameras.far)
    solid = np.flatnonzero(kind != PART_KINDS.index("mesh"))
    image = cast(kind[solid], size[solid], T_camera_part[solid], *frame)
    if len(solid) == len(kind):
        return image
    depth, part, facing = cast_meshes(meshes, T_camera_part, *frame)
    solid_first = (image.part >= 0) & ((part < 0) | (image.depth <= depth))
    of_solid = solid[image.part] if len(solid) else image.part
    return Image(
        np.where(solid_first, image.depth, depth),
        np.where(solid_first, of_solid, part).astype(np.int32),
        np.where(solid_first, image.facing, facing),
    )
