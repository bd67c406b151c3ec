"""Physics: which candidate goals hold, and what becomes of a predicted placement. The only door to PyBullet.

Everything runs in the container frame (a container is only ever turned about the vertical), with time steps of 1/240 s,
in one simulation a scene that is built from nothing, so that a result does not depend on what was simulated before.
Containers and clutter are fixed, as in RPDiff. Several copies of the object share a simulation without seeing each other.

A part that is a mesh is its convex hull if it is convex (then its distances and overlaps are as exact as a box's), else, of
a container, the surface as it is, which knows no inside.

The judge's motion decides both whether a candidate goal can be reached and whether a prediction can be executed: the
object is held (teleported) in its rotation and moved in against the approach of the place it goes to, which is the
container's opening, or along a peg. A held body pushes with no force in a rigid simulator; its push is stated as depth of
overlap x PUSH_STIFFNESS.

What hangs (on a peg) swings into place: its candidates are let go for HANG_SECONDS first, and are what they come to.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dapdata import meshes, solids
from dapdata.config import Section, key
from dapdata.errors import UsageError, require
from dapdata.poses import inverse, pose, rotation_about, symmetric_distance, tilt, transform
from dapdata.records import (
    GOAL_KINDS,
    PART_KINDS,
    REJECT_REASONS,
    ROLES,
    SYMMETRIES,
    Demo,
    Mesh,
    MeshDemo,
    Meshes,
    Rejected,
    Scene,
    Verdict,
    meshes_of,
)

Array = NDArray[Any]

TIME_STEP = 1 / 240  # s: PyBullet's own and RPDiff's
GRAVITY = 9.81  # m/s2
UP = np.array([0.0, 0.0, 1.0])  # container frame

APPROACH = 0.35  # m: how far out the judge's motion starts, as RPDiff's
APPROACH_STEP = 0.001  # m
LIFT = 0.01  # m: the object comes in this far above its place, or half the free height if that is less
LOWER_STEP = 0.0005  # m
LOWEST = 0.01  # m: it is let go at most this far below its place
MAX_PUSH = 15.0  # N: RPDiff's hand stops at this force
PUSH_STIFFNESS = 7500.0  # N/m: 15 N at 2 mm of overlap, the depth that a prototype of this judge failed at
STRICT_SECONDS = 2.0  # s of physics after the release
TOUCH = 0.001  # m: closer than this is a contact; resting bodies are within 0.02 mm
SUPPORTING = 0.5  # cosine: a contact holds up if its normal is within 60 degrees of up
RIM = 0.002  # m: an object in a container that opens upwards reaches at least so far below its top
GAP_RANGE = 0.05  # m: gaps under an object are looked for this far
MAX_PARTS = 16  # of an object: PyBullet makes no shape of more, and says nothing
HANG_SECONDS = 1.0  # s until a mug that was put onto a peg hangs still; most do after 0.4
HANG_SHIFT = 0.1  # m: one that came further has fallen off
HANG_ROLLING = 0.001  # rolling and spinning friction of what hangs: without it, mugs jitter on a peg at up to 9 mm/s
OPPOSING = 0.75  # cosine: what an object meets more obliquely than this, it slides along
HULL_MARGIN = 0.001  # m: PyBullet rounds hulls of a compound by this, on their outside; it can only be undone for single ones

RPDIFF_SECONDS = 1.0  # s of physics after the release
RPDIFF_ATTEMPTS = 11
RPDIFF_REACHED = 0.02  # m from the target
RPDIFF_BACK_OFF = 0.0075  # m
RPDIFF_JITTERS = ((0.0075, 2.5), (-0.0075, -2.5), (0.0075, -2.5), (-0.0075, 2.5))  # m sideways, degrees; in turn
RPDIFF_MAX_TILT = np.radians(15)

Protocol = Literal["strict", "rpdiff"]


class PlacementConfig(Section):
    """Which candidate goals are kept, and the physics of both demonstrations and judge."""

    mass: float = key(0.3, "mass of the object", unit="kg", gt=0, le=100)
    friction: float = key(0.5, "of object and container each; the simulator multiplies the two", ge=0, le=10)
    max_penetration: float = key(0.001, "deepest overlap of a goal with container and clutter", unit="m", ge=0, le=0.05)
    support_gap: float = key(0.003, "a candidate needs something under it within this", unit="m", gt=0, le=0.05)
    max_shift: float = key(0.02, "a placed object may end this far from where it was put", unit="m", gt=0, le=0.5)
    max_turn_deg: float = key(10.0, "and turned by this, modulo its symmetry", unit="deg", gt=0, le=180)
    max_speed: float = key(0.005, "an object slower than this is at rest", unit="m/s", gt=0, le=1)
    settle_seconds: float = key(0.3, "physics between putting a candidate there and looking at it", unit="s", ge=0.05, le=10)
    shake_acceleration: float = key(0.5, "sideways acceleration when shaken, four ways in turn", unit="m/s2", ge=0, le=20)
    shake_seconds: float = key(0.15, "length of each of the four", unit="s", ge=0, le=10)


def demonstrate(scene: Scene, config: PlacementConfig, rng: np.random.Generator) -> Demo | Rejected:
    """The scene with its candidate goals settled and sorted into goals and rejected ones, and one goal demonstrated.

    Args:
        scene: A container, an object and candidate goals.
        config: When a candidate is kept.
        rng: Chooses the demonstrated goal, uniformly.

    Returns:
        The demo, with `demo`, `seed` and `attempts` 0; or, where no goal was kept, Rejected with the commonest reason.
    """
    if len(scene.T_container_goal) == 0:
        return Rejected("no_free_slot")
    settled, reasons = settle(scene, scene.T_container_goal, config, scene.goal_approach)
    kept = [g for g, reason in enumerate(reasons) if reason == "ok"]
    lost = [g for g, reason in enumerate(reasons) if reason != "ok"]
    codes = [REJECT_REASONS.index(reasons[g]) for g in lost]
    if not kept:
        return Rejected(REJECT_REASONS[int(np.bincount(codes).argmax())])
    return record(scene, settled, kept, lost, codes, kept[int(rng.integers(len(kept)))])


def record(
    scene: Scene, settled: Array, kept: Sequence[int], lost: Sequence[int], codes: Sequence[int], demonstrated: int
) -> Demo:
    """The scene with its candidates sorted into goals and rejected ones, and one of the goals demonstrated.

    Args:
        scene: With G candidates.
        settled: (G, 4, 4) where they came to rest, container frame.
        kept: Which of them are goals.
        lost: Which of them are not.
        codes: Why, each an index into REJECT_REASONS.
        demonstrated: One of `kept`.
    """
    goals = scene.T_world_container @ settled[kept]
    demo = Demo(
        T_world_container=scene.T_world_container,
        T_world_object_start=scene.T_world_object_start,
        T_world_object_goal=scene.T_world_container @ settled[demonstrated],
        goals=goals,
        goal_kind=scene.goal_kind[kept],
        goal_clearance=scene.goal_clearance[kept],
        goal_approach=scene.goal_approach[kept],
        rejected_goals=scene.T_world_container @ scene.T_container_goal[lost],
        rejected_reason=np.array(codes, np.uint8),
        symmetry_kind=np.array(scene.symmetry_kind, np.uint8),
        symmetry_axis=scene.symmetry_axis,
        part_kind=scene.part_kind,
        part_size=scene.part_size,
        T_container_part=scene.T_container_part,
        part_role=scene.part_role,
        opening=scene.opening,
        max_tilt=np.array(scene.max_tilt),
        object_kind=scene.object_kind,
        object_size=scene.object_size,
        T_object_part=scene.T_object_part,
        demo=np.array(0),
        seed=np.array(0),
        container_instance=np.array(scene.container_instance),
        object_instance=np.array(scene.object_instance),
        attempts=np.array(0),
        task=np.array(scene.task),
    )
    if isinstance(scene, Meshes):
        return MeshDemo(**vars(demo), **{field.name: getattr(scene, field.name) for field in fields(Meshes)})
    return demo


def ways_out(scene: Scene | Demo, T_container_object: Array, ways: Array, config: PlacementConfig) -> Array:
    """(G, 3) the first of some ways out against which the judge's motion brings each object in; the first where none does.

    Args:
        scene: What the container, its clutter and the object look like.
        T_container_object: (G, 4, 4) poses at rest.
        ways: (W, 3) or, for each object its own, (G, W, 3) unit, container frame.
        config: Mass and friction.
    """
    world, found = _World(scene, config), np.zeros((len(T_container_object), 3))
    for g, (T, mine) in enumerate(zip(T_container_object, np.broadcast_to(ways, (len(T_container_object), *ways.shape[-2:])))):
        free = (way for way in mine if _approach(world, T, way).T_release is not None)
        found[g] = next(free, mine[0])
    return found


def drop(scene: Scene | Demo, T_container_object: Array, config: PlacementConfig, seconds: float) -> Array:
    """(G, 4, 4) where objects come to that are let go at (G, 4, 4) poses, container frame, after so many seconds."""
    world = _World(scene, config)
    bodies = world.release(T_container_object)
    world.run(seconds)
    return world.states(bodies)[0]


def free_play(scene: Scene | Demo, T_container_object: Array, config: PlacementConfig, num_directions: int = 18) -> Array:
    """(G,) total way (m) that an object can slide to and fro along its tightest horizontal line, for parts of any kind.

    As solids.free_play, but by the nearest points of what stands around it, and for an object at rest, which often leans
    against something: in a corner it can slide along either wall. Exact between flat walls, elsewhere as far as the tangent
    planes let it. Ways longer than solids.UNBOUNDED count as that.
    """
    world = _World(scene, config)
    angle = np.pi * np.arange(num_directions) / num_directions
    line = np.stack([np.cos(angle), np.sin(angle), np.zeros(num_directions)], axis=1)
    plays = []
    for T in T_container_object:
        around = [c for c in world.contacts(T, solids.UNBOUNDED) if abs(c.normal[2]) < SUPPORTING]
        normal = np.array([contact.normal for contact in around]).reshape(-1, 3)
        distance = np.array([max(contact.distance, 0.0) for contact in around])
        ways = []
        for direction in (line, -line):
            closing = -direction @ normal.T  # (L, C)
            way = np.where(closing > OPPOSING, distance / np.maximum(closing, OPPOSING), np.inf)
            ways.append(way.min(axis=1, initial=solids.UNBOUNDED))
        plays.append(min(float((ways[0] + ways[1]).min()), solids.UNBOUNDED))
    return np.array(plays)


def settle(
    scene: Scene | Demo, T_container_object: Array, config: PlacementConfig, approach: Array | None = None
) -> tuple[Array, list[str]]:
    """Where candidate poses come to rest, and "ok" or the first reason against each.

    A candidate must overlap nothing and have something under it; is then let go for `settle_seconds`, after which it must
    be at rest close to where it was put, upright, inside, still without overlap; must stay when the container is shaken;
    and must be within reach of the judge's motion.

    Args:
        scene: What the container, its clutter and the object look like.
        T_container_object: (G, 4, 4) candidate poses.
        config: Limits and durations.
        approach: (G, 3) unit, container frame: against which the judge's motion brings each of them in. Default: that of
            the scene's goal (or candidate) nearest to each, as for predictions.

    Returns:
        (G, 4, 4) poses before shaking (of candidates that were not let go: as given), and G reasons.
    """
    poses = _hung(scene, T_container_object, config) if _hangs(scene) else np.array(T_container_object, np.float64)
    world = _World(scene, config)
    reasons = [_reason_before(world, T, config) for T in poses]
    alive = [g for g, reason in enumerate(reasons) if reason == "ok"]
    bodies = world.release(poses[alive])
    world.run(config.settle_seconds)
    settled, speeds = world.states(bodies)
    for g, T, speed in zip(alive, settled, speeds):
        reasons[g] = _reason_after(world, poses[g], T, speed, config)
    poses[alive] = settled
    shaken, speeds = _shake(world, bodies, config)
    for g, T, speed in zip(alive, shaken, speeds):
        if reasons[g] == "ok" and _reason_after(world, poses[g], T, speed, config) != "ok":
            reasons[g] = "shaken_off"
        way_out = world.way_out(poses[g]) if approach is None else approach[g]
        if reasons[g] == "ok" and _approach(world, poses[g], way_out).T_release is None:
            reasons[g] = "unreachable"
    return poses, reasons


def judge(
    demo: Demo, T_world_object: Array, config: PlacementConfig, protocol: Protocol = "strict", *, exhaustive: bool = False
) -> list[Verdict]:
    """What becomes of each of K predicted placements when it is executed, each on its own.

    Args:
        demo: The scene. Of its goals only the approach is used: a prediction is executed as the goal nearest to it would be.
        T_world_object: (K, 4, 4) predictions. Rows that are not finite are failures with the reason "no_prediction",
            other matrices that are no rigid motion "invalid_pose".
        config: Mass, friction and the limits.
        protocol: "strict", or the published criteria "rpdiff".
        exhaustive: Also look for contacts where bounding boxes already rule them out; the verdicts are the same.

    Returns:
        K verdicts. Reasons of strict: ok, no_prediction, invalid_pose, pushed, outside, moved, turned, tilted,
        not_touching, not_at_rest; of rpdiff: ok, no_prediction, invalid_pose, pushed, not_touching, tilted.
    """
    predictions = np.asarray(T_world_object, np.float64)
    if predictions.ndim != 3 or predictions.shape[1:] != (4, 4):
        raise UsageError(f"T_world_object: got shape {predictions.shape}, expected (K, 4, 4); pass one matrix a candidate")
    if protocol not in ("strict", "rpdiff"):
        raise UsageError(f"protocol: got '{protocol}', expected strict or rpdiff")
    faults = [_fault(T) for T in predictions]
    T_container_world = inverse(np.asarray(demo.T_world_container, np.float64))
    world = _World(demo, config, exhaustive)
    trials = [
        None if fault else _try(world, _closest_rigid(T_container_world @ T), protocol) for T, fault in zip(predictions, faults)
    ]
    released = [trial.held.T_release for trial in trials if trial is not None and trial.held.T_release is not None]
    bodies = world.release(released)
    world.run(STRICT_SECONDS if protocol == "strict" else RPDIFF_SECONDS)
    ends = iter(zip(*world.states(bodies)))
    verdicts = []
    for fault, trial in zip(faults, trials):
        if trial is None:
            verdicts.append(_failure(fault))
        elif trial.held.T_release is None:
            verdicts.append(_failure("pushed", trial))
        else:
            verdicts.append(_verdict(world, trial, *next(ends), config, protocol, demo.T_world_container))
    return verdicts


# ---------------------------------------------------------------- the checks of a candidate goal


def _hangs(scene: Scene | Demo) -> bool:
    """Whether there is a peg among the places."""
    return bool(np.any(scene.goal_kind == GOAL_KINDS.index("peg")))


def _hung(scene: Scene | Demo, T_container_object: Array, config: PlacementConfig) -> Array:
    """(G, 4, 4) what candidates come to that are let go on a peg; those that overlap something or fall off, as given."""
    world, poses = _World(scene, config), np.array(T_container_object, np.float64)
    free = [g for g, T in enumerate(poses) if _depth(world.contacts(T, 0.0)) <= config.max_penetration]
    bodies = world.release(poses[free])
    world.run(HANG_SECONDS)
    for g, T in zip(free, world.states(bodies)[0]):
        if world.difference(T, poses[g])[0] <= HANG_SHIFT:
            poses[g] = T
    return poses


def _reason_before(world: _World, T: Array, config: PlacementConfig) -> str:
    """Whether a candidate overlaps something or has nothing under it."""
    contacts = world.contacts(T, config.support_gap)
    if _depth(contacts) > config.max_penetration:
        return "penetrates"
    return "ok" if world.is_held(T, contacts) else "unsupported"


def _reason_after(world: _World, T_before: Array, T: Array, speed: float, config: PlacementConfig) -> str:
    """Whether an object that was let go is still in its place, at rest, upright, inside, without overlap and held up."""
    shift, turn = world.difference(T, T_before)
    if shift > config.max_shift or turn > np.radians(config.max_turn_deg):
        return "moved"
    if world.tilt(T) > world.max_tilt:
        return "tilted"
    if speed > config.max_speed:
        return "not_at_rest"
    if not world.is_inside(T):
        return "outside"
    contacts = world.contacts(T, config.support_gap)
    if _depth(contacts) > config.max_penetration:
        return "penetrates"
    return "ok" if world.is_held(T, contacts) else "unsupported"


def _shake(world: _World, bodies: Sequence[int], config: PlacementConfig) -> tuple[Array, Array]:
    """Poses and speeds after the container was accelerated to and fro along x and y and came to rest again.

    In the container's frame its acceleration is a sideways pull on what stands in it.
    """
    for way in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        world.pull(config.shake_acceleration * way[0], config.shake_acceleration * way[1])
        world.run(config.shake_seconds)
    world.pull(0, 0)
    world.run(config.settle_seconds / 2)
    return world.states(bodies)


# ---------------------------------------------------------------- the judge's motion


class _Contact(NamedTuple):
    """The closest points of the object and one part."""

    distance: float  # m, negative where they overlap
    normal: Array  # (3,) unit, from the part to the object
    height: float  # m, container frame, of the point on the part


@dataclass(frozen=True)
class _Held:
    """How far a held object came."""

    T_release: Array | None  # (4, 4) container frame, where it is let go; None: stopped on its way
    push: float  # N, the largest on the way


@dataclass(frozen=True)
class _Trial:
    """One prediction on its way through the judge."""

    T: Array  # (4, 4) prediction, container frame
    held: _Held
    penetration: float  # m, at the prediction
    gap: float  # m, at the prediction


def _try(world: _World, T: Array, protocol: Protocol) -> _Trial:
    """A prediction measured, and executed as far as its release."""
    contacts = world.contacts(T, GAP_RANGE)
    below = [contact.distance / contact.normal[2] for contact in contacts if contact.normal[2] > SUPPORTING]
    gap = float(np.clip(min(below, default=GAP_RANGE), 0, GAP_RANGE))
    held = _approach(world, T, world.way_out(T)) if protocol == "strict" else _approach_rpdiff(world, T)
    return _Trial(T, held, _depth(contacts), gap)


def _approach(world: _World, T: Array, way_out: Array) -> _Held:
    """The object moved in against the way out (3,), above its place, and lowered until it touches something below."""
    lift = min(LIFT, world.free_height(T) / 2)
    ways = np.arange(round(APPROACH / APPROACH_STEP), -1, -1) * APPROACH_STEP
    _, push = _travel(world, T, lift * UP + ways[:, None] * way_out)
    if push > MAX_PUSH:
        return _Held(None, push)
    heights = lift - np.arange(int(np.ceil((lift + LOWEST) / LOWER_STEP)) + 1) * LOWER_STEP
    release = heights[-1]
    for step, contacts in world.contacts_along(T, heights[:, None] * UP):
        if any(contact.distance <= 0 and contact.normal[2] > SUPPORTING for contact in contacts):
            release = heights[max(step - 1, 0)]
            break
        push = max(push, _push(contacts))
        if push > MAX_PUSH:
            return _Held(None, push)
    return _Held(_moved(T, release * UP), push)


def _travel(world: _World, T: Array, offsets: Array) -> tuple[int, float]:
    """The last of the offsets (S, 3) of a held object that was reached, and the largest push (N) so far."""
    push = 0.0
    for step, contacts in world.contacts_along(T, offsets):
        push = max(push, _push(contacts))
        if push > MAX_PUSH:
            return step, push
    return len(offsets) - 1, push


def _approach_rpdiff(world: _World, T: Array) -> _Held:
    """The published motions: boxes (books) in up to 11 attempts, round objects (cans) in one, others (mugs) put there.

    Source: RPDiff's `evaluate_rpdiff.py`; its random jitters are a fixed sequence here. Of its attempts, only where the
    last one ends matters: books are let go wherever that is.
    """
    if world.symmetry == "none":
        return _Held(T, 0.0)
    start, push, release, way_out = round(APPROACH / APPROACH_STEP), 0.0, T, world.way_out(T)
    sideways = np.cross(UP, way_out)
    for attempt in range(RPDIFF_ATTEMPTS if world.symmetry == "box" else 1):
        shift, turn = RPDIFF_JITTERS[attempt % len(RPDIFF_JITTERS)] if attempt else (0.0, 0.0)
        turned = pose(rotation_about(UP, np.radians(turn)) @ T[:3, :3], T[:3, 3] + shift * sideways)
        ways = np.arange(start, -1, -1) * APPROACH_STEP
        step, push = _travel(world, turned, ways[:, None] * way_out)
        if world.symmetry == "revolution":
            return _Held(None if push > MAX_PUSH else T, push)
        release = _moved(turned, ways[step] * way_out)
        if np.linalg.norm(release[:3, 3] - T[:3, 3]) <= RPDIFF_REACHED:
            break
        start = min(round((ways[step] + RPDIFF_BACK_OFF) / APPROACH_STEP), round(APPROACH / APPROACH_STEP))
    return _Held(release, push)


def _verdict(
    world: _World, trial: _Trial, T: Array, speed: float, config: PlacementConfig, protocol: Protocol, T_world_container: Array
) -> Verdict:
    """What is said about an object that was let go and ended at T (container frame)."""
    moved, turned = world.difference(T, trial.T)
    contacts = world.contacts(T, TOUCH)
    failed = {"not_touching": not contacts}
    if protocol == "strict":
        failed = {
            "outside": not world.is_inside(T),
            "moved": moved > config.max_shift,
            "turned": turned > np.radians(config.max_turn_deg),
            "tilted": world.tilt(T) > world.max_tilt,
            "not_touching": not (world.is_held(T, contacts) if world.hangs else contacts),
            "not_at_rest": speed > config.max_speed,
        }
    elif world.symmetry == "revolution":
        failed["tilted"] = world.tilt(T) > RPDIFF_MAX_TILT
    reason = next((name for name, has_failed in failed.items() if has_failed), "ok")
    end = T_world_container @ T
    return Verdict(reason == "ok", reason, end, moved, turned, trial.held.push, trial.penetration, trial.gap)


def _failure(reason: str, trial: _Trial | None = None) -> Verdict:
    """The verdict on a prediction that was never let go."""
    push, penetration, gap = (trial.held.push, trial.penetration, trial.gap) if trial else (0.0, np.nan, np.nan)
    return Verdict(False, reason, np.full((4, 4), np.nan), np.nan, np.nan, push, penetration, gap)


def _fault(T: Array) -> str:
    """Why a matrix must not be simulated, or nothing."""
    if not np.all(np.isfinite(T)):
        return "no_prediction"
    R = T[:3, :3]
    is_rigid = (
        np.allclose(R.T @ R, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0 and np.allclose(T[3], [0, 0, 0, 1], atol=1e-6)
    )
    return "" if is_rigid and np.abs(T[:3, 3]).max() < 1e3 else "invalid_pose"


def _closest_rigid(T: Array) -> Array:
    """The rigid motion closest to a matrix that is nearly one (predictions are often float32)."""
    left, _, right = np.linalg.svd(T[:3, :3])
    return pose(left @ right, T[:3, 3])


def _moved(T: Array, offset: Array) -> Array:
    """T moved by offset (3,), m."""
    return pose(T[:3, :3], T[:3, 3] + offset)


def _depth(contacts: Sequence[_Contact]) -> float:
    """Deepest overlap, m; 0 without any."""
    return max((-contact.distance for contact in contacts), default=0.0) if contacts else 0.0


def _push(contacts: Sequence[_Contact]) -> float:
    """Force (N) with which a held object pushes against what it overlaps."""
    return PUSH_STIFFNESS * max(_depth(contacts), 0.0)


# ---------------------------------------------------------------- PyBullet


def _import_quietly() -> Any:
    """PyBullet, which prints when it was built to file descriptor 2 as it is imported."""
    own, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        return require("pybullet", "sim")
    finally:
        os.dup2(own, 2)
        os.close(own)
        os.close(nowhere)


@cache
def _client(process: int) -> tuple[Any, int]:
    """The simulator and the number of this process's own connection to it; a forked child makes its own."""
    bullet = _import_quietly()
    client: int = bullet.connect(bullet.DIRECT)
    if client < 0:
        raise UsageError(f"pybullet: process {process} got no connection, expected one; close others of this process")
    return bullet, client


class _World:
    """A simulation of one scene: fixed parts, a held copy of the object to measure with, and copies that fall."""

    def __init__(self, scene: Scene | Demo, config: PlacementConfig, exhaustive: bool = False) -> None:
        self._opening = np.asarray(scene.opening, np.float64)
        self._places, self._ways_out = _places(scene), np.asarray(scene.goal_approach, np.float64)
        self.hangs, self._opens_up = _hangs(scene), bool(self._opening[2] > SUPPORTING)
        self.max_tilt = float(scene.max_tilt)
        self.symmetry = SYMMETRIES[int(scene.symmetry_kind)]
        self._axis = np.asarray(scene.symmetry_axis, np.float64)
        self._exhaustive = exhaustive
        self._config = config
        self._object = tuple(np.asarray(x) for x in (scene.object_kind, scene.object_size, scene.T_object_part))
        parts = tuple(np.asarray(x) for x in (scene.part_kind, scene.part_size, scene.T_container_part))
        part_meshes, self._object_meshes = meshes_of(scene)
        for name, arrays, found in (("container part", parts, part_meshes), ("object part", self._object, self._object_meshes)):
            _check_parts(name, found, *arrays)
        self._T_object_body = _object_body(self._object, self._object_meshes)
        self._bounds = _bounds(parts, part_meshes)  # (P, 2, 3)
        container = self._bounds[np.asarray(scene.part_role) == ROLES.index("container")]
        self._inside = np.stack([container[:, 0].min(axis=0), container[:, 1].max(axis=0)])
        self._bullet, self._client = _client(os.getpid())
        self._start()
        self._parts = [
            self._body(0.0, T, self._shape(int(kind), size, mesh), mesh is not None)
            for kind, size, T, mesh in zip(*parts, part_meshes)
        ]
        self._probe = self._copy(0.0, np.eye(4))
        self._bullet.setCollisionFilterGroupMask(self._probe, -1, 0, 0, physicsClientId=self._client)

    def _start(self) -> None:
        """An empty world."""
        b, client = self._bullet, self._client
        b.resetSimulation(physicsClientId=client)
        # Islands are never solved together: the solver stops when all it was given has converged, so that otherwise each
        # copy of the object would depend on the others.
        b.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP, deterministicOverlappingPairs=1, minimumSolverIslandSize=0, physicsClientId=client
        )
        # PyBullet tessellates the shape of a body that has no visual of its own, which takes longer than all the rest.
        self._visual = b.createVisualShape(b.GEOM_BOX, halfExtents=[0.01] * 3, physicsClientId=client)
        self.pull(0, 0)

    def _body(self, mass: float, T: Array, shape: int, is_mesh: bool) -> int:
        """A body of a shape at a pose."""
        b = self._bullet
        body: int = b.createMultiBody(
            mass, shape, self._visual, *_to_bullet(T), useMaximalCoordinates=1, physicsClientId=self._client
        )
        if self._config.friction != 0.5:  # PyBullet's default
            b.changeDynamics(body, -1, lateralFriction=self._config.friction, physicsClientId=self._client)
        if is_mesh:  # a single one is then as exact as a box
            b.changeDynamics(body, -1, collisionMargin=0, physicsClientId=self._client)
        if self.hangs:
            rolling = {"rollingFriction": HANG_ROLLING, "spinningFriction": HANG_ROLLING}
            b.changeDynamics(body, -1, **rolling, physicsClientId=self._client)
        return body

    def _copy(self, mass: float, T: Array) -> int:
        """A copy of the object at T."""
        kind, size, T_object_part = self._object
        found = self._object_meshes
        if len(kind) == 1:
            shape = self._shape(int(kind[0]), size[0], found[0])
        else:
            shape = self._compound(kind, size, inverse(self._T_object_body) @ T_object_part, found)
        return self._body(mass, T @ self._T_object_body, shape, found[0] is not None)

    def _shape(self, kind: int, size: Array, mesh: Mesh | None) -> int:
        """The collision shape of one part."""
        b, client = self._bullet, self._client
        if mesh is not None:
            if meshes.is_convex(mesh):
                return int(b.createCollisionShape(b.GEOM_MESH, vertices=mesh.vertices.tolist(), physicsClientId=client))
            mesh = meshes.with_area(mesh)
            return int(
                b.createCollisionShape(
                    b.GEOM_MESH,
                    vertices=mesh.vertices.tolist(),
                    indices=mesh.faces.ravel().tolist(),
                    flags=b.GEOM_FORCE_CONCAVE_TRIMESH,
                    physicsClientId=client,
                )
            )
        if kind == solids.BOX:
            return int(b.createCollisionShape(b.GEOM_BOX, halfExtents=(size / 2).tolist(), physicsClientId=client))
        if kind == solids.CYLINDER:
            return int(b.createCollisionShape(b.GEOM_CYLINDER, radius=size[0] / 2, height=size[2], physicsClientId=client))
        return int(b.createCollisionShape(b.GEOM_MESH, vertices=_ellipsoid_hull(size), physicsClientId=client))

    def _compound(self, kind: Array, size: Array, T: Array, found: Sequence[Mesh | None]) -> int:
        """One collision shape of several parts, all of them meshes or none."""
        b = self._bullet
        hulls = [Mesh(transform(pose_, mesh.vertices), mesh.faces) for pose_, mesh in zip(T, found) if mesh is not None]
        if hulls:
            # PyBullet makes a compound of hulls from a file alone, and remembers files by their name.
            with tempfile.TemporaryDirectory(prefix="dapdata-") as folder:
                path = Path(folder, "hulls.obj")
                path.write_text(meshes.to_obj([meshes.shrunk(mesh, HULL_MARGIN) for mesh in hulls]))
                return int(b.createCollisionShape(b.GEOM_MESH, fileName=str(path), physicsClientId=self._client))
        placed = [_to_bullet(pose_) for pose_ in T]
        return int(
            b.createCollisionShapeArray(
                shapeTypes=[b.GEOM_BOX if k == solids.BOX else b.GEOM_CYLINDER for k in kind],
                halfExtents=(size / 2).tolist(),
                radii=(size[:, 0] / 2).tolist(),
                lengths=size[:, 2].tolist(),
                collisionFramePositions=[position for position, _ in placed],
                collisionFrameOrientations=[quaternion for _, quaternion in placed],
                physicsClientId=self._client,
            )
        )

    # The held object

    def contacts(self, T: Array, reach: float) -> list[_Contact]:
        """Contacts of the held object at T with every part within reach, m."""
        low, high = self._object_bounds(T)
        near = np.all((self._bounds[:, 0] <= high + reach) & (self._bounds[:, 1] >= low - reach), axis=1)
        return self._measure(T, np.flatnonzero(near), reach)

    def contacts_along(self, T: Array, offsets: Array) -> Iterator[tuple[int, list[_Contact]]]:
        """(step, overlaps) of the held object at T moved by each of offsets (S, 3), m, where there can be any.

        The object is only moved, not turned, so that its bounding box is moved with it: steps at which it meets no
        part's bounding box are left out, and the others look at the parts that it meets.
        """
        low, high = self._object_bounds(T)
        part_low, part_high = self._bounds[:, 0], self._bounds[:, 1]
        # Bounding boxes are exact: where they do not meet, solids do not overlap.
        swept = np.all((part_low < high + offsets.max(axis=0)) & (part_high > low + offsets.min(axis=0)), axis=1)
        parts = np.arange(len(swept)) if self._exhaustive else np.flatnonzero(swept)
        lows, highs = (low + offsets)[:, None], (high + offsets)[:, None]
        meet = np.all((part_low[parts] < highs) & (part_high[parts] > lows), axis=2) | self._exhaustive  # (S, P)
        for step in np.flatnonzero(meet.any(axis=1)):
            yield int(step), self._measure(_moved(T, offsets[step]), parts[meet[step]], 0.0)

    def _measure(self, T: Array, parts: Array, reach: float) -> list[_Contact]:
        """Contacts of the held object at T with the given parts."""
        b, client = self._bullet, self._client
        if not len(parts):
            return []
        b.resetBasePositionAndOrientation(self._probe, *_to_bullet(T @ self._T_object_body), physicsClientId=client)
        found = []
        for p in parts:
            for point in b.getClosestPoints(self._probe, self._parts[p], reach, physicsClientId=client):
                found.append(_Contact(point[8], np.array(point[7]), point[6][2]))
        return found

    def way_out(self, T: Array) -> Array:
        """(3,) unit vector out of the place nearest to an object at T, or, without places, out of the opening."""
        if not len(self._places):
            return self._opening
        return np.asarray(self._ways_out[np.linalg.norm(self._places - T[:3, 3], axis=1).argmin()])

    def free_height(self, T: Array) -> float:
        """Height (m) between the object's top and what is above it, by bounding boxes; infinite under open sky.

        Around what hangs there is a handle: contacts tell how far that can be raised.
        """
        if self.hangs:
            return self._free_height_of_hanging(T)
        low, high = self._object_bounds(T)
        over = np.all((self._bounds[:, 0, :2] < high[:2]) & (self._bounds[:, 1, :2] > low[:2]), axis=1)
        over &= self._bounds[:, 0, 2] > (low[2] + high[2]) / 2
        return max(float((self._bounds[over, 0, 2] - high[2]).min(initial=np.inf)), 0.0)

    def _free_height_of_hanging(self, T: Array) -> float:
        """Height (m), up to twice LIFT, until something presses on the object from above."""
        heights = np.arange(round(2 * LIFT / APPROACH_STEP) + 1) * APPROACH_STEP
        for step, contacts in self.contacts_along(T, heights[:, None] * UP):
            if any(contact.distance < 0 and contact.normal[2] < -SUPPORTING for contact in contacts):
                return float(heights[max(step - 1, 0)])
        return 2 * LIFT

    def is_inside(self, T: Array) -> bool:
        """Whether the object's centre is in the container's bounding box; if that opens upwards, the centre of its underside.

        What stands in a hole sticks out of it, but reaches further down than what stands on the rim.
        """
        x, y, z = T[:3, 3]
        point = np.array([x, y, self._object_bounds(T)[0, 2] + RIM if self._opens_up else z])
        return bool(np.all((point >= self._inside[0]) & (point <= self._inside[1])))

    def is_held(self, T: Array, contacts: Sequence[_Contact]) -> bool:
        """Whether one of the contacts holds the object up; what hangs, by touching it from above its centre of mass.

        A mug that stands at the foot of its rack does not hang.
        """
        lowest, furthest = ((T @ self._T_object_body)[2, 3], TOUCH) if self.hangs else (-np.inf, np.inf)
        return any(
            contact.normal[2] > SUPPORTING and contact.height > lowest and contact.distance <= furthest for contact in contacts
        )

    def difference(self, T_a: Array, T_b: Array) -> tuple[float, float]:
        """Distance (m) and angle (rad) between two poses modulo the object's symmetry."""
        return symmetric_distance(T_a, T_b, self.symmetry, self._axis)

    def tilt(self, T: Array) -> float:
        """Angle (rad) of the object from upright, modulo its symmetry."""
        return tilt(T, self.symmetry, self._axis)

    def _object_bounds(self, T: Array) -> Array:
        """(2, 3) low and high corner of the object's bounding box at T."""
        kind, size, T_object_part = self._object
        each = _bounds((kind, size, T @ T_object_part), self._object_meshes)
        return np.stack([each[:, 0].min(axis=0), each[:, 1].max(axis=0)])

    # Copies that fall

    def release(self, T: Sequence[Array] | Array) -> list[int]:
        """Copies of the object, at rest at each of T, that see the parts but not each other."""
        bodies = []
        for each in T:
            body = self._copy(self._config.mass, each)
            # PyBullet puts fixed bodies into group 2.
            self._bullet.setCollisionFilterGroupMask(body, -1, 1, 2, physicsClientId=self._client)
            bodies.append(body)
        return bodies

    def pull(self, x: float, y: float) -> None:
        """Gravity, with a horizontal part, m/s2."""
        self._bullet.setGravity(x, y, -GRAVITY, physicsClientId=self._client)

    def run(self, seconds: float) -> None:
        """Simulates, rounded to whole time steps."""
        for _ in range(round(seconds / TIME_STEP)):
            self._bullet.stepSimulation(physicsClientId=self._client)

    def states(self, bodies: Sequence[int]) -> tuple[Array, Array]:
        """(B, 4, 4) poses of the object, container frame, and (B,) speeds, m/s, of copies."""
        b, client = self._bullet, self._client
        poses = np.zeros((len(bodies), 4, 4))
        for i, body in enumerate(bodies):
            T = _from_bullet(*b.getBasePositionAndOrientation(body, physicsClientId=client))
            poses[i] = T @ inverse(self._T_object_body)
        speeds = [np.linalg.norm(b.getBaseVelocity(body, physicsClientId=client)[0]) for body in bodies]
        return poses, np.array(speeds, np.float64)


def _object_body(parts: tuple[Array, ...], found: Sequence[Mesh | None]) -> Array:
    """(4, 4) the frame of PyBullet's body in the object's: that of its part, or at the centre of mass of several."""
    kind, size, T_object_part = parts
    if len(kind) == 1:
        return np.asarray(T_object_part[0])
    volumes = [meshes.volume(mesh) for mesh in found if mesh is not None]
    if volumes:  # each piece of an object has its origin at its own centre of mass
        return pose(None, np.average(T_object_part[:, :3, 3], axis=0, weights=volumes))
    return pose(None, solids.centre_of_mass(kind, size, T_object_part))


def _bounds(parts: tuple[Array, ...], found: Sequence[Mesh | None]) -> Array:
    """(P, 2, 3) the smallest axis-aligned boxes around parts of any kind."""
    kind, size, T = parts
    around = solids.bounds(kind, size, T)
    for p, mesh in enumerate(found):
        if mesh is not None:
            around[p] = meshes.bounds(Mesh(transform(T[p], mesh.vertices), mesh.faces))
    return around


def _places(scene: Scene | Demo) -> Array:
    """(G, 3) positions of a scene's candidates or a demo's goals, container frame, m."""
    if isinstance(scene, Scene):
        return scene.T_container_goal[:, :3, 3]
    return transform(inverse(scene.T_world_container), scene.goals[:, :3, 3])


def _check_parts(name: str, found: Sequence[Mesh | None], kind: Array, size: Array, T: Array) -> None:
    """PyBullet crashes on some bad numbers and accepts others silently."""
    if not len(kind):
        raise UsageError(f"{name}: got none, expected at least one; if the data were imported, import them with their meshes")
    if np.any(kind >= len(PART_KINDS)):
        raise UsageError(f"{name}: got kind {int(kind.max())}, expected one of {', '.join(PART_KINDS)}; see records.Scene")
    for k, mesh in zip(kind, found):
        if (k == solids.MESH) != (mesh is not None):
            raise UsageError(
                f"{name}: got a {PART_KINDS[int(k)]} {'with' if mesh else 'without'} triangles; see records.Meshes"
            )
        if mesh is not None and (problem := meshes.fault(mesh)):
            raise UsageError(f"{name}: got a mesh with {problem}")
        if mesh is not None and name == "object part" and not meshes.is_convex(mesh):
            raise UsageError(f"{name}: got a mesh that is not convex, expected convex pieces; see meshes.convex_pieces")
    if name == "object part" and len(kind) > 1 and 0 < np.sum(kind == solids.MESH) < len(kind):
        raise UsageError(f"{name}: got meshes among other kinds, expected one or the other; make all of them meshes")
    if name == "object part" and len(kind) > 1 and np.any(kind == solids.ELLIPSOID):
        raise UsageError(f"{name}: got an ellipsoid among {len(kind)} parts, expected boxes and cylinders; use it on its own")
    if name == "object part" and len(kind) > MAX_PARTS and not np.any(kind == solids.MESH):
        raise UsageError(f"{name}: got {len(kind)}, expected {MAX_PARTS} at the most; build the object from fewer")
    if not (np.all(np.isfinite(T)) and np.all(np.isfinite(size)) and np.all(size > 0)):
        raise UsageError(f"{name}: got sizes or poses that are not finite or not positive, expected metres; correct the scene")


@cache
def _unit_sphere_points() -> Array:
    """(256, 3) points spread evenly over the unit sphere (Fibonacci's spiral)."""
    index = np.arange(256) + 0.5
    z, angle = 1 - index / 128, np.pi * (1 + np.sqrt(5)) * index
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


def _ellipsoid_hull(size: Array) -> list[list[float]]:
    """Corners (m) of a convex body that stands for an ellipsoid, within 1 % of its diameters."""
    corners: list[list[float]] = (_unit_sphere_points() * size / 2 * 1.004).tolist()
    return corners


def _to_bullet(T: Array) -> tuple[list[float], list[float]]:
    """Position and quaternion (x, y, z, w) of a pose, by Shepperd's method: the branch with the largest divisor."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = T[:3, :3].tolist()
    x2, y2, z2, w2 = 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz
    largest = max(x2, y2, z2, w2)
    if largest == w2:
        row = (zy - yz, xz - zx, yx - xy, w2)
    elif largest == x2:
        row = (x2, xy + yx, xz + zx, zy - yz)
    elif largest == y2:
        row = (xy + yx, y2, yz + zy, xz - zx)
    else:
        row = (xz + zx, yz + zy, z2, yx - xy)
    length = sum(value * value for value in row) ** 0.5
    position: list[float] = T[:3, 3].tolist()
    return position, [value / length for value in row]


def _from_bullet(position: Sequence[float], quaternion: Sequence[float]) -> Array:
    """The pose of a position and a quaternion (x, y, z, w)."""
    x, y, z, w = np.asarray(quaternion) / np.linalg.norm(quaternion)
    return pose(
        np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        ),
        np.asarray(position, np.float64),
    )


def from_pose7(values: Sequence[float]) -> Array:
    """The pose of x, y, z, m, and a unit quaternion x, y, z, w: the seven numbers of PyBullet and of RPDiff."""
    return _from_bullet(values[:3], values[3:])


def to_pose7(T: Array) -> list[float]:
    """The inverse of `from_pose7`, for (4, 4)."""
    position, rotation = _to_bullet(T)
    return [*position, *rotation]
