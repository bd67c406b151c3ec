"""A hand-made demonstration: a two-storey shelf with books and cans, and a book or can to place."""

from __future__ import annotations

import numpy as np

from dapdata.poses import pose, rotation_about
from dapdata.records import Demo

BOX, CYLINDER = 0, 1
DEPTH, WIDTH, PITCH, BOARD, WALL = 0.2, 0.6, 0.28, 0.006, 0.005


def shelf_demo(seed: int = 0, thing: str = "book", shift: tuple[float, float, float] = (0, 0, 0)) -> Demo:
    """A shelf that opens along +x with clutter of both kinds; the goal is the empty middle of the lower floor."""
    rng = np.random.default_rng(seed)
    parts = _boards()
    size = np.array([0.18, 0.04, 0.24] if thing == "book" else [0.06, 0.06, 0.09])
    for floor in (BOARD, PITCH + BOARD):
        y = -WIDTH / 2 + 0.03
        while y < -0.09:
            parts.append((BOX, (0.18, 0.04, 0.24), (0, y + 0.02, floor + 0.12)))
            y += 0.04 + rng.uniform(0.004, 0.03)
        y = 0.07
        while y < WIDTH / 2 - 0.07:
            radius, height = rng.uniform(0.02, 0.033), rng.uniform(0.05, 0.1)
            parts.append(
                (CYLINDER, (2 * radius, 2 * radius, height), (rng.uniform(-0.03, 0.05), y + radius, floor + height / 2))
            )
            y += 2 * radius + rng.uniform(0.005, 0.02)
    T_world_container = pose(rotation_about((0, 0, 1), rng.uniform(-np.pi, np.pi)), np.array([0.1, 0.2, 0]) + shift)
    goal = T_world_container @ pose(None, (0.0, 0.0, BOARD + size[2] / 2))
    start = pose(rotation_about((0, 0, 1), rng.uniform(-np.pi, np.pi)), np.array([0.5, -0.4, size[2] / 2]) + shift)
    return make_demo(parts, [(BOX if thing == "book" else CYLINDER, tuple(size), (0, 0, 0))], T_world_container, start, goal)


def make_demo(parts, object_parts, T_world_container, T_world_object_start, T_world_object_goal) -> Demo:
    """A Demo of unturned parts (kind, full extents, centre) with one goal."""
    kind, size, T = _arrays(parts)
    object_kind, object_size, T_object_part = _arrays(object_parts)
    return Demo(
        T_world_container=T_world_container,
        T_world_object_start=T_world_object_start,
        T_world_object_goal=T_world_object_goal,
        goals=T_world_object_goal[None],
        goal_kind=np.zeros(1, np.uint8),
        goal_clearance=np.zeros(1),
        goal_approach=np.array([[1.0, 0, 0]]),
        rejected_goals=np.zeros((0, 4, 4)),
        rejected_reason=np.zeros(0, np.uint8),
        symmetry_kind=np.array(0, np.uint8),
        symmetry_axis=np.array([0.0, 0, 1]),
        part_kind=kind,
        part_size=size,
        T_container_part=T,
        part_role=np.zeros(len(kind), np.uint8),
        opening=np.array([1.0, 0, 0]),
        max_tilt=np.array(0.26),
        object_kind=object_kind,
        object_size=object_size,
        T_object_part=T_object_part,
        demo=np.array(0),
        seed=np.array(0),
        container_instance=np.array(0),
        object_instance=np.array(0),
        attempts=np.array(0),
        task=np.array(0),
    )


def _boards():
    """Boards between the walls and in front of the back: nothing overlaps, so that every surface belongs to one part."""
    inner = WIDTH - 2 * WALL
    floors = (BOARD / 2, PITCH + BOARD / 2, 2 * PITCH - BOARD / 2)
    parts = [(BOX, (DEPTH - BOARD, inner, BOARD), (BOARD / 2, 0, floor)) for floor in floors]
    parts += [(BOX, (DEPTH, WALL, 2 * PITCH), (0, side * (WIDTH - WALL) / 2, PITCH)) for side in (-1, 1)]
    return [*parts, (BOX, (BOARD, inner, 2 * PITCH), (-(DEPTH - BOARD) / 2, 0, PITCH))]


def _arrays(parts):
    kind = np.array([part[0] for part in parts], np.uint8)
    size = np.array([part[1] for part in parts], float)
    return kind, size, np.stack([pose(None, part[2]) for part in parts])


def observe_with_truth(demo: Demo, cameras, noise, rng):
    """Points, estimated normals and mean true normals (N, 3) of the container, voxelled as `observe` does it."""
    from dapdata.observe.cameras import container_views
    from dapdata.observe.fuse import fuse, view_cloud
    from dapdata.observe.noise import add_noise
    from dapdata.observe.raycast import cast
    from dapdata.poses import inverse, rotate, transform

    points, normals, truth, views = [], [], [], container_views(demo, cameras, noise, rng)
    for view in views:
        T_camera_part = inverse(view.T_world_camera_true) @ demo.T_world_container @ demo.T_container_part
        image = cast(demo.part_kind, demo.part_size, T_camera_part, view.K, view.width, view.height)
        p, n = view_cloud(add_noise(image, view.K, noise.preset, view.noise_seed), view)
        u, v = np.floor((p @ view.K.T)[:, :2] / p[:, 2:]).astype(int).T
        points, normals = [*points, p], [*normals, n]
        truth.append(true_normals(demo, image, T_camera_part, view.K)[v, u] @ view.T_world_camera_true[:3, :3].T)
    T = np.stack([view.T_world_camera for view in views])
    fused = fuse(points, normals, T, cameras.container_voxel)
    points, normals = [transform(t, p) for t, p in zip(T, points)], [rotate(t, n) for t, n in zip(T, normals)]
    cell = np.floor(np.concatenate(points) * (1 / cameras.container_voxel))
    _, voxel, size = np.unique(cell, axis=0, return_inverse=True, return_counts=True)

    def mean(a):
        return np.stack([np.bincount(voxel.ravel(), column) for column in a.T], axis=1) / size[:, None]

    agree = np.linalg.norm(mean(np.concatenate(normals)), axis=1) > 0.1
    return fused.points, fused.normals, mean(np.concatenate(truth))[agree]


def true_normals(demo: Demo, image, T_camera_part, K):
    """(H, W, 3) outward normals, camera frame, of boxes and upright cylinders where an image sees them; zeros elsewhere."""
    v, u = np.mgrid[: len(image.depth), : image.depth.shape[1]] + 0.5
    seen = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1) * image.depth[..., None]
    out = np.zeros_like(seen)
    for p, (kind, half, T) in enumerate(zip(demo.part_kind, demo.part_size / 2, T_camera_part)):
        local = (seen[image.part == p] - T[:3, 3]) @ T[:3, :3]
        faces = np.eye(3)[np.abs(np.abs(local) - half).argmin(axis=1)] * np.sign(local)
        if kind != BOX:
            round_ = local * [1, 1, 0] / np.maximum(np.linalg.norm(local[:, :2], axis=1, keepdims=True), 1e-12)
            on_mantle = half[0] - np.linalg.norm(local[:, :2], axis=1) < half[2] - np.abs(local[:, 2])
            faces = np.where(on_mantle[:, None], round_, [0, 0, 1] * np.sign(local))
        out[image.part == p] = faces @ T[:3, :3].T
    return out


def purity(superpoint, true_normals):
    """Coherence (length of the mean true normal, 1 is pure) and share of points over 45 degrees off that mean."""
    size = np.bincount(superpoint)
    mean = np.stack([np.bincount(superpoint, column) for column in true_normals.T], axis=1) / size[:, None]
    length = np.linalg.norm(mean, axis=1)
    own = np.linalg.norm(true_normals, axis=1)
    cosine = np.einsum("ij,ij->i", true_normals, mean[superpoint]) / np.maximum(own * length[superpoint], 1e-12)
    return float((length * size).sum() / size.sum()), float((cosine < np.cos(np.pi / 4)).mean())
