"""Made-up demos for the tests of training: a three-slot shelf as clouds on a grid. No simulator, no cameras."""

from __future__ import annotations

import numpy as np

from dapdata.config import TrainConfig
from dapdata.poses import inverse, pose, rotation_about, transform
from daptrain.prepare import LabelRule, point_affordance

RULE = LabelRule(eps_place=0.03, kind="hard")
SIZE = np.array([0.10, 0.05, 0.14])  # m: the object, x deep, y thick, z high
SLOTS = (-0.12, 0.0, 0.12)  # m: y of the middle of each slot
TINY = TrainConfig(
    width=16,
    point_width=12,
    pose_width=12,
    groups=2,
    layers=1,
    point_layers=1,
    neighbours=8,
    cross_neighbours=8,
    crop_points=64,
    object_points=48,
    container_points=1500,
    scenes_per_step=2,
    levels_per_scene=2,
    crops_per_step=2,
    sample_steps=5,
    validate_every=20,
    warmup_steps=5,
)


def make_sample(seed: int = 0, spacing: float = 0.02) -> dict[str, np.ndarray]:
    """A shelf with three slots, one of them filled; the other two are the goals, of which one is demonstrated."""
    rng = np.random.default_rng(seed)
    T_world_container = pose(rotation_about((0, 0, 1), rng.uniform(-np.pi, np.pi)), rng.uniform(-0.3, 0.3, 3) * [1, 1, 0])
    filled = int(rng.integers(3))
    boxes = [
        ((0.12, 0.40, 0.01), (0, 0, 0.005)),  # floor
        ((0.01, 0.40, 0.20), (-0.06, 0, 0.10)),  # back
        *(((0.12, 0.01, 0.20), (0, y, 0.10)) for y in (-0.18, -0.06, 0.06, 0.18)),
        ((0.10, 0.10, 0.15), (0, SLOTS[filled], 0.085)),
    ]
    clouds = [box_surface(np.array(size), spacing, rng, np.array(centre)) for size, centre in boxes]
    points, normals = (np.concatenate(part) for part in zip(*clouds))
    seen = (normals[:, 0] > -0.5) & ~((normals[:, 2] < -0.5) & (points[:, 2] < 0.02))
    points, normals = points[seen], normals[seen]
    superpoint = np.unique(np.floor(np.column_stack((points / 0.05, 2 * normals))), axis=0, return_inverse=True)[1].ravel()
    counts = np.bincount(superpoint)
    centres, means = (
        np.stack([np.bincount(superpoint, x[:, i]) for i in range(3)], 1) / counts[:, None] for x in (points, normals)
    )
    goals = [pose(None, (0.0, y, 0.01 + SIZE[2] / 2)) for i, y in enumerate(SLOTS) if i != filled]
    goals = np.stack([T_world_container @ T for T in goals])
    start = pose(rotation_about(rng.normal(size=3), rng.uniform(0, 3)), (0.6, 0.3, 0.2))
    thing, thing_normals = box_surface(SIZE, spacing / 2, rng)
    demonstrated = int(rng.integers(2))
    world = transform(T_world_container, points)
    score = point_affordance(world, thing, goals[demonstrated], RULE)
    return {
        "container/points": world.astype(np.float32),
        "container/normals": (normals @ T_world_container[:3, :3].T).astype(np.float32),
        "container/superpoint": superpoint.astype(np.int32),
        "container_superpoints/points": transform(T_world_container, centres).astype(np.float32),
        "container_superpoints/normals": (means @ T_world_container[:3, :3].T).astype(np.float32),
        "container_superpoints/affordance": (np.bincount(superpoint, score) / counts).astype(np.float32),
        "object/points": transform(start, thing).astype(np.float32),
        "object/normals": (thing_normals @ start[:3, :3].T).astype(np.float32),
        "pose/T_world_container": T_world_container,
        "pose/T_world_object_start": start,
        "pose/T_world_object_goal": goals[demonstrated],
        "goals/T_world_object": goals,
        "symmetry/kind": np.array(1, np.uint8),
        "symmetry/axis": np.array([0.0, 0.0, 1.0]),
        "meta/seed": np.array(3),
        "meta/demo": np.array(seed),
    }


def box_surface(size: np.ndarray, spacing: float, rng: np.random.Generator, centre: np.ndarray | None = None):
    """(N, 3) points on a jittered grid over the faces of a box and their (N, 3) outward normals."""
    points, normals = [], []
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        steps = [np.linspace(-s / 2, s / 2, max(2, round(s / spacing) + 1)) for s in size[others]]
        grid = np.stack(np.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 2)
        for sign in (-1.0, 1.0):
            face = np.zeros((len(grid), 3))
            face[:, others], face[:, axis] = grid, sign * size[axis] / 2
            points.append(face + rng.normal(0, 5e-4, face.shape))
            normals.append(np.tile(sign * np.eye(3)[axis], (len(grid), 1)))
    return np.concatenate(points) + (0 if centre is None else centre), np.concatenate(normals)


def moved(sample: dict[str, np.ndarray], T: np.ndarray) -> dict[str, np.ndarray]:
    """The same demo with the whole world moved by a pose (about the vertical, if the frames are to follow)."""
    out = dict(sample)
    for key, value in sample.items():
        if key.endswith("points"):
            out[key] = transform(T, value).astype(np.float32)
        elif key.endswith("normals"):
            out[key] = (value @ T[:3, :3].T).astype(np.float32)
        elif "T_world" in key:
            out[key] = T @ value
    return out


def ends_at_goal(sample: dict[str, np.ndarray], T_world_object: np.ndarray, reach: float) -> bool:
    """Whether a pose is within reach (m) of one of the goals."""
    return bool((np.linalg.norm((inverse(sample["goals/T_world_object"]) @ T_world_object)[:, :3, 3], axis=1) < reach).any())
