"""One depth and segmentation image of a shelf of 100 parts: our ray caster against TinyRenderer, Open3D and Embree.

Rivals get their scene built beforehand and return less: TinyRenderer no incidence and a raw depth buffer, Open3D
and Embree a distance along the ray. Ours packs the scene and returns metres, part ids and incidence in each call. Pixels where
depths differ by more than 5 mm are counted (at silhouettes), so that all are seen to draw the same picture.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from importlib.util import find_spec

import numpy as np
from timing import Row, chosen, compare, main

from dapdata import rng
from dapdata.observe.cameras import intrinsics, look_at
from dapdata.observe.raycast import cast
from dapdata.poses import inverse, pose

SIZES = (320, 240), (640, 480)
FOV_DEG = 60.0
NEAR, FAR = 0.1, 5.0
# TinyRenderer samples a pixel at (u, v + 1), not at its centre (u + 0.5, v + 0.5): the principal point that makes up for it.
SAMPLE_SHIFT = {"tinyrenderer": np.array([[0, 0, 0.5], [0, 0, -0.5], [0, 0, 0]])}


def shelf(parts: int = 100) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Kind (P,), size (P, 3), pose (P, 4, 4) of a shelf of six boards filled with boxes and cylinders."""
    draw = rng.stream(0, "benchmark", 0)
    width, depth, board = 1.0, 0.3, 0.01
    found = [(0, (depth, width, board), (0, 0, z)) for z in (0.005, 0.255, 0.505, 0.755)]
    found += [(0, (depth, board, 0.76), (0, side * width / 2, 0.38)) for side in (-1, 1)]
    slots = [(y, z) for z in (0.01, 0.26, 0.51) for y in np.linspace(-0.46, 0.46, -(-(parts - 6) // 3))]
    for y, z in slots[: parts - 6]:
        x, height, kind = draw.uniform(-0.08, 0.08), draw.uniform(0.08, 0.2), int(draw.integers(2))
        found.append((kind, (0.026, 0.026, height) if kind else (0.18, 0.024, height), (x, y, z + height / 2)))
    kind, size, at = (np.array(column, float) for column in zip(*found))
    return kind.astype(np.uint8), size, np.stack([pose(None, a) for a in at])


def tiny_renderer(kind: np.ndarray, size: np.ndarray, T: np.ndarray, T_world_camera: np.ndarray, width: int, height: int):
    """A function that renders with PyBullet's CPU renderer without shadows, and one that gives its depth in metres."""
    import pybullet as p

    client = p.connect(p.DIRECT)
    for k, s, t in zip(kind, size, T):
        if k:
            shape = p.createVisualShape(p.GEOM_CYLINDER, radius=s[0] / 2, length=s[2], physicsClientId=client)
        else:
            shape = p.createVisualShape(p.GEOM_BOX, halfExtents=s / 2, physicsClientId=client)
        p.createMultiBody(baseVisualShapeIndex=shape, basePosition=t[:3, 3], physicsClientId=client)
    eye, R = T_world_camera[:3, 3], T_world_camera[:3, :3]
    view = p.computeViewMatrix(eye, eye + R[:, 2], -R[:, 1])
    projection = p.computeProjectionMatrixFOV(FOV_DEG, width / height, NEAR, FAR)

    def render():
        return p.getCameraImage(width, height, view, projection, shadow=0, renderer=p.ER_TINY_RENDERER, physicsClientId=client)

    def depth() -> np.ndarray:
        buffer, body = (np.reshape(field, (height, width)) for field in render()[3:])
        return np.where(body >= 0, FAR * NEAR / (FAR - (FAR - NEAR) * buffer), 0)

    return render, depth


def open3d_caster(kind: np.ndarray, size: np.ndarray, T: np.ndarray, T_world_camera: np.ndarray, width: int, height: int):
    """A function that casts all rays of a view at tessellated parts with Open3D, and one that gives depth in metres."""
    import ctypes

    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)  # open3d's wheel needs it, unnamed
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for k, s, t in zip(kind, size, T):
        mesh = (
            o3d.t.geometry.TriangleMesh.create_cylinder(s[0] / 2, s[2], 32, 1)
            if k
            else o3d.t.geometry.TriangleMesh.create_box(*s).translate(-s / 2)
        )
        scene.add_triangles(mesh.transform(t))
    rays = o3d.t.geometry.RaycastingScene.create_rays_pinhole(
        intrinsics(width, height, FOV_DEG), inverse(T_world_camera), width, height
    )

    def render():
        return scene.cast_rays(rays)

    def depth() -> np.ndarray:  # these rays have z = 1 in the camera frame: the hit's parameter is the depth
        hit = render()["t_hit"].numpy()
        return np.where(np.isfinite(hit), hit, 0)

    return render, depth


def embree_caster(kind: np.ndarray, size: np.ndarray, T: np.ndarray, T_world_camera: np.ndarray, width: int, height: int):
    """A function that casts all rays of a view at tessellated parts with Embree, and one that gives depth in metres."""
    import trimesh
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    for k, s, t in zip(kind, size, T):
        mesh = trimesh.creation.cylinder(s[0] / 2, s[2], 32) if k else trimesh.creation.box(s)
        TriangleMesh(scene, mesh.apply_transform(t).triangles.astype(np.float32))
    K, (v, u) = intrinsics(width, height, FOV_DEG), np.mgrid[:height, :width] + 0.5
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1).reshape(-1, 3)
    way = (rays @ T_world_camera[:3, :3].T).astype(np.float32)
    start = np.tile(T_world_camera[:3, 3], (len(rays), 1)).astype(np.float32)

    def render():
        return scene.run(start, way, output=1)

    def depth() -> np.ndarray:
        hit = render()
        return np.where(hit["geomID"] >= 0, hit["tfar"], 0).reshape(height, width)

    return render, depth


def is_there(name: str, against: str | None) -> bool:
    """Whether a rival can be run. Embree is left out where it is not installed (`pip install embreex`), unless asked for."""
    if name == "embree" and against is None and find_spec("embreex") is None:
        print("embree: embreex is not installed, left out", file=sys.stderr)
        return False
    return True


RIVALS = {"tinyrenderer": tiny_renderer, "open3d": open3d_caster, "embree": embree_caster}


def run(scale: str, against: str | None) -> Iterator[Row]:
    kind, size, T = shelf()
    T_world_camera = look_at(np.array([0, 0, 0.38]), 20.0, 15.0, 1.2)
    T_camera_part = inverse(T_world_camera) @ T
    for width, height in SIZES:
        K = intrinsics(width, height, FOV_DEG)

        def ours(K=K, width=width, height=height):
            return cast(kind, size, inverse(T_world_camera) @ T, K, width, height, NEAR, FAR)

        contenders, notes = {"dapdata": ours}, {}
        for name, make in RIVALS.items():
            if against in (None, name) and is_there(name, against):
                contenders[name], their_depth = make(kind, size, T, T_world_camera, width, height)
                shift = SAMPLE_SHIFT.get(name, np.zeros((3, 3)))
                depth = cast(kind, size, T_camera_part, K + shift, width, height, NEAR, FAR).depth
                notes[name] = f"{(np.abs(their_depth() - depth) > 0.005).mean():.2%} of pixels differ by over 5 mm"
        case = f"{width}x{height}, {len(kind)} parts"
        yield from compare("render", case, chosen(contenders, against), 5 if scale == "quick" else 25, notes=notes)


if __name__ == "__main__":
    main(run)
