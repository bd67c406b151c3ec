"""Stages that draw random arrays instead of simulating: the machinery's tests need many units, not true ones.

They take the place of `pipeline.STAGES` by name (`table="toy_stages"`). The variables TOY_SLEEP, TOY_CALLS and
TOY_FAULT reach the workers through the environment: seconds a demo takes, a file that a line is added to for each call
of a stage, and a fault such as "kill:7" that happens when that demo is observed; "kill:7:FILE" happens once and leaves that
file. TOY_LABEL_FAULT is a fault that happens when the demo is labelled.
"""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np

from dapdata import recipe
from dapdata.records import Cloud, Demo, Labels, Rejected, Superpoints
from dapdata.stages import Draw, Inputs, Sections, Stage


def toy_recipe(demos: int = 6, shard_size: int = 3, **changes: object) -> recipe.Recipe:
    """A recipe that the toy stages read; changes are sections, such as label={"eps_place": 0.02}."""
    tree = {"name": "toy", "seed": 5, "demos": demos, "shard_size": shard_size, "scene": {"task": "can_cabinet"}}
    return recipe.from_resolved({**tree, **changes})


def poses(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 4, 4) rigid transforms."""
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    T[:, :3, 0] *= np.linalg.det(T[:, :3, :3])[:, None]
    T[:, :3, 3] = rng.normal(size=(count, 3))
    return T


def within(rng: np.random.Generator, count: int, size: np.ndarray, T: np.ndarray) -> np.ndarray:
    """(count, 3) points in some of P boxes (P, 3) at poses (P, 4, 4)."""
    part = rng.integers(0, len(size), count)
    return np.einsum("nij,nj->ni", T[part, :3, :3], (rng.random((count, 3)) - 0.5) * size[part]) + T[part, :3, 3]


def towards(cameras: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 3) unit vectors from points to cameras."""
    way = cameras - points
    return (way / np.linalg.norm(way, axis=1, keepdims=True)).astype(np.float32)


def called(name: str) -> None:
    """Notes the call, and takes the time that the test asked for."""
    if path := os.environ.get("TOY_CALLS"):
        with open(path, "a") as file:
            file.write(name + "\n")
    time.sleep(float(os.environ.get("TOY_SLEEP", "0")))


def misbehave(demo: int, variable: str = "TOY_FAULT") -> None:
    """What TOY_FAULT, or another variable, asks for at this demo."""
    kind, at, *once = os.environ.get(variable, "none:-1").split(":")
    if demo != int(at):
        return
    if once:
        mark = Path(once[0])
        if mark.exists():
            return
        mark.touch()
    if kind == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if kind == "kill_parent":
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(1000)
    if kind == "abort":
        os.abort()
    if kind == "hang":
        time.sleep(1000)
    if kind in ("nan", "raise"):
        raise ValueError("a stage that failed")
    if kind == "leave":
        os._exit(3)


def demonstrate(made: Inputs, sections: Sections, draw: Draw) -> Demo | Rejected:
    called("demonstrate")
    rng = draw("scene")
    if rng.random() < 0.3:
        return Rejected("no_free_slot")
    rng = draw("demonstrate")
    goals, rejected, parts = int(rng.integers(1, 5)), int(rng.integers(0, 3)), int(rng.integers(2, 6))
    part_size, T_parts, T_container, T_goals = rng.random((parts, 3)), poses(rng, parts), poses(rng, 1)[0], poses(rng, goals)
    T_goals[:, :3, 3] = within(rng, goals, part_size, T_container @ T_parts)
    return Demo(
        T_world_container=T_container,
        T_world_object_start=poses(rng, 1)[0],
        T_world_object_goal=T_goals[0],
        goals=T_goals,
        goal_kind=rng.integers(0, 5, goals),
        goal_clearance=rng.random(goals) * sections["placement"].mass,
        goal_approach=np.tile([1.0, 0.0, 0.0], (goals, 1)),
        rejected_goals=poses(rng, rejected),
        rejected_reason=rng.integers(0, 8, rejected),
        symmetry_kind=np.array(2),
        symmetry_axis=np.array([0.0, 0.0, 1.0]),
        part_kind=np.zeros(parts),
        part_size=part_size,
        T_container_part=T_parts,
        part_role=np.zeros(parts),
        opening=np.array([1.0, 0.0, 0.0]),
        max_tilt=np.array(0.2),
        object_kind=np.ones(1),
        object_size=rng.random((1, 3)),
        T_object_part=poses(rng, 1),
        demo=np.array(0),
        seed=np.array(0),
        container_instance=rng.integers(0, 2**60),
        object_instance=rng.integers(0, 2**60),
        attempts=np.array(0),
        task=np.array(0),
    )


def observe(made: Inputs, sections: Sections, draw: Draw) -> Cloud | Rejected:
    called("observe")
    misbehave(int(made["demonstrate"].demo))
    rng = draw("observe")
    if rng.random() < 0.1:
        return Rejected("empty_cloud")
    count, small = int(rng.integers(200, 400)), int(rng.integers(30, 60))
    shift = {"none": 0.0, "d415": 0.01, "kinect": 0.02}[sections["noise"].preset]
    demo: Demo = made["demonstrate"]
    cameras, view, other_view = poses(rng, 7), rng.integers(0, 3, count), rng.integers(0, 4, small)
    points = within(rng, count, demo.part_size, demo.T_world_container @ demo.T_container_part) + shift
    object_points = within(rng, small, demo.object_size, demo.T_world_object_start @ demo.T_object_part) + shift
    return Cloud(
        container_points=points,
        container_normals=towards(cameras[view, :3, 3], points),
        container_view=view,
        object_points=object_points,
        object_normals=towards(cameras[3 + other_view, :3, 3], object_points),
        object_view=other_view,
        camera_K=np.tile(np.eye(3), (7, 1, 1)),
        T_world_camera=cameras,
    )


def cluster(made: Inputs, sections: Sections, draw: Draw) -> Superpoints | Rejected:
    called("cluster")
    cloud: Cloud = made["observe"]
    parts = 12
    container = np.arange(len(cloud.container_points)) % parts
    thing = np.arange(len(cloud.object_points)) % 4
    return Superpoints(
        container_superpoint=container,
        object_superpoint=thing,
        container_superpoint_points=np.stack(
            [cloud.container_points[container == s].mean(0, dtype=float) for s in range(parts)]
        ),
        container_superpoint_normals=cloud.container_normals[:parts],
        container_superpoint_size=np.bincount(container),
        object_superpoint_points=np.stack([cloud.object_points[thing == s].mean(0, dtype=float) for s in range(4)]),
        object_superpoint_normals=cloud.object_normals[:4],
        object_superpoint_size=np.bincount(thing),
    )


def label(made: Inputs, sections: Sections, draw: Draw) -> Labels:
    called("label")
    misbehave(int(made["demonstrate"].demo), "TOY_LABEL_FAULT")
    points = made["cluster"].container_superpoint_points
    apart = np.linalg.norm(points - made["demonstrate"].T_world_object_goal[:3, 3], axis=1)
    return Labels(
        affordance=np.where(apart < 50 * sections["label"].eps_place, 1.0, -1.0),
        corr_object=np.zeros(len(apart)),
        corr_container=np.arange(len(apart)),
        corr_distance=np.modf(1e6 * apart)[0],  # every bit of the points shows
    )


STAGES = (
    Stage("demonstrate", 1, ("scene", "placement"), (), Demo, demonstrate, packages=("numpy",), attempts=50),
    Stage("observe", 1, ("cameras", "noise"), ("demonstrate",), Cloud, observe),
    Stage("cluster", 1, ("superpoints",), ("observe",), Superpoints, cluster),
    Stage("label", 1, ("label",), ("demonstrate", "observe", "cluster"), Labels, label, is_shard=True),
)
parse = recipe.from_resolved
