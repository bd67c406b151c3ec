"""Whether one demo's arrays make sense together: what no checksum and no type can tell.

Each array may be finite, rigid, in range, and the demo nonsense all the same: a cloud in millimetres, normals in a camera's
frame, an object cloud at the goal instead of the start, a goal in another room. The limits are wide: of the clouds that
the three noise presets make, 99 % of the points lie within 10 mm of their parts' box, and 99 % of the normals face their
camera.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from dapdata.poses import inverse, transform
from dapdata.records import Array

SHARE = 0.9  # of the points or normals that must be right
NEAR = 0.1  # m: a point farther from its parts' box is not of them
SMALLEST = 0.1  # a cloud's extent relative to its parts': the least that a camera sees of them
WIDEST = 10.0  # m, of a cloud whose parts are not known: no furniture is wider
MEAN_ERROR = 1e-3  # m, between a superpoint and the mean of its points
BODIES = {  # pose, group and array of the parts that the cloud was seen of
    "container": ("pose/T_world_container", "scene", "T_container_part"),
    "object": ("pose/T_world_object_start", "object_parts", "T_object_part"),
}

Sample = Mapping[str, Array]


def nonsense(sample: Sample) -> Iterator[str]:
    """What cannot be true of a demo, each as "path: found, expected"; arrays that are not there are not asked for."""
    for check in (_goals, _clouds, _normals, _superpoints):
        try:
            yield from check(sample)
        except KeyError:  # a stage before the arrays that it compares; a shard has all of them
            continue


def _goals(sample: Sample) -> Iterator[str]:
    """The demonstrated goal is one of the goals, and these are where the container is."""
    demonstrated, goals = sample["pose/T_world_object_goal"], sample["goals/T_world_object"]
    if not (goals == demonstrated).all(axis=(1, 2)).any():
        yield f"pose/T_world_object_goal: not among the {len(goals)} goals of goals/T_world_object"
    container, thing = _box(sample, "container"), _box(sample, "object")
    if container is not None and thing is not None and len(goals):
        limit = NEAR + _extent(thing)
        far = _distance(goals[:, :3, 3], sample["pose/T_world_container"], container).max()
        if far > limit:
            yield f"goals/T_world_object: up to {far:.3g} m from the container, expected at most {limit:.3g} m; are they in m?"


def _clouds(sample: Sample) -> Iterator[str]:
    """Both clouds lie on their parts, and are as large as these."""
    for body, (pose, group, placed) in BODIES.items():
        points, box = sample[f"{body}/points"].astype(float), _box(sample, body)
        if not len(points):
            continue
        extent = float(np.linalg.norm(np.ptp(points, axis=0)))
        if box is None:
            if extent > WIDEST:
                yield f"{body}/points: {extent:.3g} m across, expected at most {WIDEST:g} m; are they in mm?"
            continue
        distance, whole = _distance(points, sample[pose], box), _extent(box)
        if whole > WIDEST:
            yield f"{group}/size and {placed}: {whole:.3g} m across, expected at most {WIDEST:g} m; are they in mm?"
        if (distance <= NEAR).mean() < SHARE:
            yield (
                f"{body}/points: {np.median(distance):.3g} m from the {body} (median), expected at most {NEAR:g} m; "
                f"are they in m, in the world frame, and the {body} at {pose}?"
            )
        elif len(points) > 1 and extent < SMALLEST * whole:
            yield f"{body}/points: {extent:.3g} m across, expected about {whole:.3g} m as the {body} is; are they in m?"


def _normals(sample: Sample) -> Iterator[str]:
    """Normals face the camera that saw most of their voxel. The container's cameras come first; how many is not told."""
    cameras, first = sample["camera/T_world_camera"][:, :3, 3], 0
    for body in BODIES:
        view = sample[f"{body}/view"].astype(int)
        seen = int(view.max(initial=-1)) + 1
        if first + seen > len(cameras):
            yield f"{body}/view: camera {seen - 1}, expected one of the {len(cameras) - first} that look at the {body}"
            return
        if len(view):
            towards = [cameras[start + view] - sample[f"{body}/points"] for start in _starts(body, first, len(cameras) - seen)]
            share = max((np.einsum("ni,ni->n", way, sample[f"{body}/normals"]) > 0).mean() for way in towards)
            if share < SHARE:
                yield f"{body}/normals: {share:.0%} face their camera, expected over {SHARE:.0%}; are they in the world frame?"
        first = seen


def _starts(body: str, first: int, last: int) -> range:
    """Where the cameras of a body may begin: those of the object somewhere after the container's."""
    return range(1) if body == "container" else range(first, last + 1)


def _superpoints(sample: Sample) -> Iterator[str]:
    """Superpoints have the sizes that their points give them, at least one each, and lie at their mean."""
    for body in BODIES:
        owner, size = sample[f"{body}/superpoint"], sample[f"{body}_superpoints/size"]
        counts = np.bincount(owner, minlength=len(size)) if len(owner) else np.zeros(len(size), int)
        if not np.array_equal(counts, size) or (len(size) and size.min() < 1):
            yield f"{body}_superpoints/size: not the number of points that {body}/superpoint gives each"
            continue
        points = sample[f"{body}/points"].astype(float)
        means = np.stack([np.bincount(owner, axis, len(size)) for axis in points.T], axis=1) / size[:, None]
        error = np.abs(means - sample[f"{body}_superpoints/points"]).max(initial=0)
        if error > MEAN_ERROR:
            yield f"{body}_superpoints/points: up to {error:.3g} m from the mean of their points; are they in m, in the world?"


def _box(sample: Sample, body: str) -> Array | None:
    """(2, 3) low and high corner of a box around a body's parts, in its own frame; None if it has no parts."""
    _, group, placed = BODIES[body]
    T, half = sample[f"{group}/{placed}"], sample[f"{group}/size"] / 2
    if not len(half):
        return None
    reach = np.einsum("pij,pj->pi", np.abs(T[:, :3, :3]), half)
    return np.stack([(T[:, :3, 3] - reach).min(0), (T[:, :3, 3] + reach).max(0)])


def _extent(box: Array) -> float:
    """Diagonal of a box, m."""
    return float(np.linalg.norm(box[1] - box[0]))


def _distance(points: Array, T_world_body: Array, box: Array) -> Array:
    """(N,) distance, m, of points (N, 3) in the world frame from a box in a body's frame; 0 inside."""
    local = transform(inverse(T_world_body), points)
    return np.asarray(np.linalg.norm(np.maximum(0, np.maximum(box[0] - local, local - box[1])), axis=1))
