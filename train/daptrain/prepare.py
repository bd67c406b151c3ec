"""From observed clouds to what the networks see: canonical frames, crops, targets, batches as numpy arrays.

Two frames replace the world, both fitted to observed points alone, so that inference has them too:
- the *front* frame of the container: z up, x out of its opening, origin at the middle of its footprint, at its foot;
- the *box* frame of the object: of the box or cylinder fitted to it, modulo that shape's symmetry.
Net 1 says which superpoints of the container the placed object touches, net 2 where the box goes in the front frame.

Labels of net 2 are modulo the object's symmetry: of all symmetric copies of a goal the one is learned that turns
the box least against a `reference` rotation, the most central one of the training goals. Any other choice (a random
copy, or the identity as reference, which lies half way between two copies of an upright book) teaches contradictions.

Everything here is a pure function of its arguments; `Inputs` are kept in RAM, about 100 kB a demo.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from dapdata import poses
from dapdata import rng as random
from dapdata.config import TrainConfig
from dapdata.records import SYMMETRIES
from daptrain.fit import ObjectFit, fit_container, fit_object

Array = NDArray[Any]

REGION_FLOOR = 0.1  # a sampled score whose best superpoint has a lower probability names no region
REFERENCES = 64  # training goals among which the most central rotation is sought


@dataclass(frozen=True)
class Inputs:
    """One container and one object as the networks see them: no ground truth in here."""

    T_world_front: Array  # (4, 4) f8
    T_world_box: Array  # (4, 4) f8, the object as observed
    extents: Array  # (3,) f4, m, of the fitted box along its own axes
    superpoints: Array  # (S, 3) f4, front frame, m
    superpoint_normals: Array  # (S, 3) f4, front frame
    superpoint_size: Array  # (S,) f4, number of points
    neighbours: Array  # (S, K) i4, nearest superpoints, itself first
    container_points: Array  # (N, 3) f4, front frame, m
    container_normals: Array  # (N, 3) f4, front frame
    container_superpoint: Array  # (N,) i4
    object_points: Array  # (M, 3) f4, box frame, m
    object_normals: Array  # (M, 3) f4, box frame


@dataclass(frozen=True)
class Targets:
    """What the networks learn of one demo; row 0 is the demonstrated goal, the others are the other valid goals."""

    affordance: Array  # (G, S) f4 in [-1, 1]
    T_front_object: Array  # (G, 4, 4) f8, goals
    T_object_box: Array  # (4, 4) f8
    symmetry_kind: str
    symmetry_axis: Array  # (3,) f8, object frame


@dataclass(frozen=True)
class Example:
    """One demo, ready to train on."""

    inputs: Inputs
    targets: Targets


@dataclass(frozen=True)
class Crop:
    """Container points around a region, and the object, for net 2; a batch of them is padded by `pose.collate`."""

    centre: Array  # (3,) f8, front frame, m: origin of the crop's frame
    points: Array  # (C, 3) f4, crop frame (axes of the front frame), m
    normals: Array  # (C, 3) f4
    score: Array  # (C,) f4 in [-1, 1]
    object_points: Array  # (M, 3) f4, box frame, m
    object_normals: Array  # (M, 3) f4


@dataclass(frozen=True)
class LabelRule:
    """How the dataset labelled affordance, from its recipe: the other goals are labelled the same way."""

    eps_place: float  # m
    kind: str  # "hard" or "soft"


def prepare(sample: dict[str, Array], rule: LabelRule, config: TrainConfig) -> Example:
    """One demo of a dataset (arrays by shard path) as an Example."""
    inputs, _ = prepare_inputs(
        sample["container/points"],
        sample["container/normals"],
        sample["container/superpoint"],
        sample["container_superpoints/points"],
        sample["container_superpoints/normals"],
        sample["object/points"],
        sample["object/normals"],
        config,
        random.stream(int(sample["meta/seed"]), "train/prepare", int(sample["meta/demo"])),
    )
    return Example(inputs, prepare_targets(sample, inputs, rule, config))


def prepare_inputs(
    container_points: Array,
    container_normals: Array,
    superpoint: Array,
    superpoints: Array,
    superpoint_normals: Array,
    object_points: Array,
    object_normals: Array,
    config: TrainConfig,
    rng: np.random.Generator,
) -> tuple[Inputs, ObjectFit]:
    """The clouds in their canonical frames, the container's thinned out to `config.container_points`, and the object's fit.

    Args:
        container_points: (N, 3) world frame, z up, m.
        container_normals: (N, 3).
        superpoint: (N,) superpoint of each point.
        superpoints: (S, 3) mean positions.
        superpoint_normals: (S, 3).
        object_points: (M, 3) world frame, m, as observed before placing.
        object_normals: (M, 3).

    Raises:
        ValueError: a cloud has too few points to fit a frame to.
    """
    container, box = fit_container(container_points, container_normals), fit_object(object_points, object_normals)
    foot = np.array([*(container.low + container.high)[:2] / 2, container.low[2]])
    T_world_front = container.T_world_front @ poses.pose(translation=foot)
    T_front_world, T_box_world = poses.inverse(T_world_front), poses.inverse(box.T_world_box)
    keep = _thin(len(container_points), config.container_points, rng)
    few = _thin(len(object_points), 4 * config.object_points, rng)
    centres = poses.transform(T_front_world, superpoints)
    inputs = Inputs(
        T_world_front=T_world_front,
        T_world_box=box.T_world_box,
        extents=_single(box.size),
        superpoints=_single(centres),
        superpoint_normals=_single(poses.rotate(T_front_world, superpoint_normals)),
        superpoint_size=_single(np.bincount(superpoint, minlength=len(superpoints))),
        neighbours=_nearest(centres, config.neighbours),
        container_points=_single(poses.transform(T_front_world, container_points[keep])),
        container_normals=_single(poses.rotate(T_front_world, container_normals[keep])),
        container_superpoint=superpoint[keep].astype(np.int32),
        object_points=_single(poses.transform(T_box_world, object_points[few])),
        object_normals=_single(poses.rotate(T_box_world, object_normals[few])),
    )
    return inputs, box


def prepare_targets(sample: dict[str, Array], inputs: Inputs, rule: LabelRule, config: TrainConfig) -> Targets:
    """The demonstrated goal with its stored affordance and, with `goals: all`, every other valid goal with its own."""
    T_world_start, T_world_demo = sample["pose/T_world_object_start"], sample["pose/T_world_object_goal"]
    goals, affordance = [T_world_demo], [sample["container_superpoints/affordance"]]
    if config.goals == "all":
        object_points = poses.transform(poses.inverse(T_world_start), sample["object/points"].astype(float))
        points, near = sample["container/points"].astype(float), cKDTree(object_points)
        superpoint = sample["container/superpoint"]
        size = np.bincount(superpoint)
        for T_world_goal in sample["goals/T_world_object"]:
            if np.abs(T_world_goal - T_world_demo).max() > 1e-6:
                score = point_affordance(points, near, T_world_goal, rule)
                goals.append(T_world_goal)
                affordance.append(np.bincount(superpoint, score) / size)
    T_front_world = poses.inverse(inputs.T_world_front)
    return Targets(
        affordance=_single(affordance),
        T_front_object=T_front_world @ np.stack(goals),
        T_object_box=poses.inverse(T_world_start) @ inputs.T_world_box,
        symmetry_kind=SYMMETRIES[int(sample["symmetry/kind"])],
        symmetry_axis=sample["symmetry/axis"],
    )


def point_affordance(container_points: Array, object_points: Array | cKDTree, T_world_object: Array, rule: LabelRule) -> Array:
    """(N,) score in [-1, 1] of container points (N, 3 world) for object points (M, 3 object frame) placed at a pose.

    The same rule as the dataset's labels, computed in the object's frame so that one box test leaves few points. A tree
    of the object's points may be given in their stead, to be made once for many poses.
    """
    tree = object_points if isinstance(object_points, cKDTree) else cKDTree(object_points)
    local = poses.transform(poses.inverse(T_world_object), np.asarray(container_points, float))
    around = np.all((local >= tree.mins - rule.eps_place) & (local <= tree.maxes + rule.eps_place), axis=1)
    distance = tree.query(local[around])[0]
    score = np.full(len(local), -1.0)
    if rule.kind == "hard":
        score[around] = np.where(distance <= rule.eps_place, 1.0, -1.0)
    else:
        score[around] = np.where(distance <= rule.eps_place, 2 * np.exp(-distance / rule.eps_place) - 1, -1.0)
    return score


def reference_rotation(examples: list[Example]) -> Array:
    """(3, 3) the most central of the demonstrated rotations of the box in the front frame, modulo symmetry."""
    some = examples[:REFERENCES]
    rotations = [(e.targets.T_front_object[0] @ e.targets.T_object_box)[:3, :3] for e in some]

    def spread(rotation: Array) -> float:
        return sum(
            float(poses.angle_between(box_goal(e.targets, e.targets.T_front_object[0], rotation)[:3, :3], rotation))
            for e in some
        )

    return np.asarray(rotations[int(np.argmin([spread(R) for R in rotations]))])


def box_goal(targets: Targets, T_front_object: Array, reference: Array) -> Array:
    """(4, 4) T_front_box at a goal: of its symmetric copies the one that is turned least against the reference."""
    T_reference = poses.pose(reference @ targets.T_object_box[:3, :3].T)
    near = poses.nearest_symmetric(T_front_object, T_reference, targets.symmetry_kind, targets.symmetry_axis)
    return np.asarray(near @ targets.T_object_box)


def clean_region(score: Array, superpoints: Array, reach: float) -> Array | None:
    """The superpoints of the one region that a score names: those around its peak.

    A sampled score has stray positives; net 2 would see a crop that spans two modes. The peak is sought in the
    smoothed score, since a region is several superpoints and a stray is one.

    Args:
        score: (S,) in [-1, 1].
        superpoints: (S, 3) m.
        reach: Largest distance from the peak, m.

    Returns:
        (S,) bool with at least one True, or None when no superpoint is likely to belong to any region.
    """
    p = np.clip((score + 1) / 2, 0, 1)
    if not p.max() >= REGION_FLOOR:
        return None
    positive = p >= min(0.5, p.max() / 2)
    places = superpoints[positive]
    closeness = np.exp(-0.5 * (np.linalg.norm(places[:, None] - superpoints[None, positive], axis=-1) / (reach / 2)) ** 2)
    peak = places[np.argmax(closeness @ p[positive])]
    return np.asarray(positive & (np.linalg.norm(superpoints - peak, axis=1) <= reach))


def one_region(inputs: Inputs, score: Array, eps_place: float) -> Array | None:
    """`clean_region` of a score that was labelled with eps_place (m), with the reach of this object."""
    return clean_region(score, inputs.superpoints, region_reach(inputs.extents, eps_place))


def region_reach(extents: Array, eps_place: float) -> float:
    """How far (m) from the middle of its region an object of these extents can touch a superpoint's centre."""
    return float(np.linalg.norm(extents) / 2 + eps_place)


def crop(
    inputs: Inputs, score: Array, region: Array, margin: float, config: TrainConfig, rng: np.random.Generator
) -> Crop | None:
    """Raw container points in the box around a region, or None when none of them lies in the region.

    Args:
        inputs: The clouds.
        score: (S,) in [-1, 1], sampled or a label; the crop is told of it within the region.
        region: (S,) bool, as of `one_region`.
        margin: Added on each side of the region's bounding box, m.
    """
    inside = region[inputs.container_superpoint]
    if not inside.any():
        return None
    low, high = inputs.container_points[inside].min(axis=0), inputs.container_points[inside].max(axis=0)
    in_box = np.all((inputs.container_points >= low - margin) & (inputs.container_points <= high + margin), axis=1)
    chosen = np.flatnonzero(in_box)
    chosen = chosen[_thin(len(chosen), config.crop_points, rng)]
    weight = np.clip(score[region] + 1, 1e-3, None)
    centre = (weight[:, None] * inputs.superpoints[region]).sum(axis=0) / weight.sum()
    few = _thin(len(inputs.object_points), config.object_points, rng)
    cleaned = np.where(region, score, -1.0)
    return Crop(
        centre=centre.astype(float),
        points=inputs.container_points[chosen] - centre,
        normals=inputs.container_normals[chosen],
        score=_single(cleaned[inputs.container_superpoint[chosen]]),
        object_points=inputs.object_points[few],
        object_normals=inputs.object_normals[few],
    )


def worn_region(label: Array, neighbours: Array, rng: np.random.Generator) -> Array:
    """(S,) a label as a sampler might have drawn it: some superpoints lost, some neighbours gained, scores uneven.

    Net 2 is trained on these, since at inference it sees sampled scores.
    """
    p = (label + 1) / 2
    gained = p[neighbours].max(axis=1) * (rng.random(len(p)) < 0.1)
    kept = np.maximum(p, 0.7 * gained) * (rng.random(len(p)) > 0.15)
    worn = np.clip(kept * rng.uniform(0.7, 1.0, len(p)), 0, 1)
    return np.asarray(2 * (worn if worn.max() > 0 else p) - 1)


def jittered(inputs: Inputs, rng: np.random.Generator) -> tuple[Inputs, Array]:
    """Inputs whose box frame is off by about 2 degrees and 2 mm, as a fit may be, and (4, 4) T_box_jittered."""
    axis, angle = rng.normal(size=3), np.deg2rad(rng.normal(0, 2.0))
    T_box_jittered = poses.pose(poses.rotation_about(axis, float(angle)), rng.normal(0, 0.002, 3))
    T = poses.inverse(T_box_jittered)
    moved = replace(
        inputs,
        object_points=_single(poses.transform(T, inputs.object_points)),
        object_normals=_single(poses.rotate(T, inputs.object_normals)),
    )
    return moved, T_box_jittered


def turned_crop(piece: Crop, turn: float) -> Crop:
    """A crop turned about the vertical through its centre (rad)."""
    R = _single(poses.rotation_about((0, 0, 1), turn))
    return replace(piece, points=piece.points @ R.T, normals=piece.normals @ R.T)


def pose_item(
    example: Example, reference: Array, rule: LabelRule, config: TrainConfig, rng: np.random.Generator
) -> tuple[Crop, Array] | None:
    """A crop around one goal of a demo and (4, 4) T_crop_box, with all augmentation; None where no point is near it.

    The box that is cropped has a random size: its margin goes from none to twice `config.crop_margin`.
    """
    inputs, T_box_jittered = jittered(example.inputs, rng)
    goal = int(rng.integers(len(example.targets.affordance)))
    score = example.targets.affordance[goal]
    if not (score > 0).any():
        return None
    score = worn_region(score, inputs.neighbours, rng)
    region = one_region(inputs, score, rule.eps_place)
    if region is None:
        return None
    piece = crop(inputs, score, region, float(rng.uniform(0, 2 * config.crop_margin)), config, rng)
    if piece is None:
        return None
    turn = random_turn(config, rng)
    T_turned_front = poses.pose(poses.rotation_about((0, 0, 1), turn))
    T_crop_turned = poses.pose(translation=-poses.transform(T_turned_front, piece.centre[None])[0])
    T_turned_box = box_goal(example.targets, T_turned_front @ example.targets.T_front_object[goal], reference)
    return turned_crop(piece, turn), T_crop_turned @ T_turned_box @ T_box_jittered


def random_turn(config: TrainConfig, rng: np.random.Generator) -> float:
    """Yaw (rad) by which a container is turned in training."""
    most = np.pi if config.yaw == "any" else np.deg2rad(config.yaw_jitter_deg)
    return float(rng.uniform(-most, most))


def _thin(count: int, most: int, rng: np.random.Generator) -> Array:
    """Sorted indices of at most `most` of `count` things, chosen at random."""
    return np.arange(count) if count <= most else np.sort(rng.choice(count, most, replace=False))


def _nearest(points: Array, k: int) -> Array:
    """(S, min(k, S)) indices of the nearest points."""
    k = min(k, len(points))
    return np.asarray(cKDTree(points).query(points, k)[1], dtype=np.int32).reshape(len(points), k)


def _single(values: Any) -> Array:
    return np.asarray(values, dtype=np.float32)
