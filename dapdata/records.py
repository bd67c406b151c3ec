"""The arrays that flow from stage to stage: names, shapes, units, frames.

This is the one table of the format: `store` writes shards by it, `schemas/shard.schema.json` is made
from it, and each stage returns one of these records. A field's first dimension says how it is stored:

- "demo": one row per demo, no leading axis in the record (`pose/T_world_container` is (4, 4) here and
  (D, 4, 4) in a shard);
- anything else is ragged: the rows of all demos one after another in a shard, and
  `<group>/offsets (D+1,)` tells where each demo starts.

Codes (small integers) carry their names in `names`. World frame: right-handed, z up, metres. The object
frame has its origin at the centre of the object's bounding box and its z axis up at a goal (of a mug,
which hangs at its goals: up when it stands).

Triangles of parts that are meshes are arrays of the demo like all others (`Meshes`), in imported datasets and in no
other. Files beside the shards, named by their content, were the alternative: one copy of each mesh
instead of one a demo. But those of a demo of RPDiff take 3 to 43 kB next to 150 to 600 kB of clouds, and in the shard
whoever has the demo has the meshes: readers, workers, exports and checks need to know nothing more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

PART_KINDS = ("box", "cylinder", "ellipsoid", "mesh")
ROLES = ("container", "clutter")
SYMMETRIES = ("none", "box", "revolution")
GOAL_KINDS = (
    "floor",
    "stack",
    "gap",
    "peg",
    "hole",
    "settled",  # imported: settled here, and what it rests on is not told
    "commanded",  # imported: a pose as it was commanded; without meshes, nothing was settled
    "shown",  # imported: where a scan saw it placed; there are no shapes to settle
)
REJECT_REASONS = (
    "penetrates",  # overlaps the container or clutter by more than placement.max_penetration
    "unsupported",  # nothing under it
    "tilted",  # further from upright than the task allows, after settling
    "moved",  # settled too far from the candidate pose
    "not_at_rest",  # still moving when settling ended
    "outside",  # centre not inside the container
    "shaken_off",  # did not stay when the container was shaken
    "unreachable",  # the judge's own motion cannot bring it there
)


def array(
    path: str, dtype: str, dims: tuple[str | int, ...], unit: str, frame: str, description: str, names: tuple[str, ...] = ()
) -> Any:
    """A record field that is stored as the array `path` of a shard."""
    return field(
        metadata={
            "path": path,
            "dtype": dtype,
            "dims": dims,
            "unit": unit,
            "frame": frame,
            "description": description,
            "names": names,
        }
    )


@dataclass(frozen=True)
class Rejected:
    """Why a demo (or an attempt at one) came to nothing: data to be counted, not an error."""

    reason: str
    detail: str = field(default="", compare=False)  # for who looks after it, such as the file or the figure


@dataclass(frozen=True)
class Scene:
    """A container with clutter, an object, and every candidate goal: what a task returns. Not stored as such.

    P parts, Q object parts, G candidate goals. Sizes are full extents along the part's own axes: box
    (x, y, z), cylinder (diameter, diameter, height along z), ellipsoid (three diameters), mesh (a box around it whose
    centre is the part's origin).
    """

    part_kind: Array  # (P,) u1, index into PART_KINDS
    part_size: Array  # (P, 3) f8, m
    T_container_part: Array  # (P, 4, 4) f8
    part_role: Array  # (P,) u1, index into ROLES
    object_kind: Array  # (Q,) u1
    object_size: Array  # (Q, 3) f8, m
    T_object_part: Array  # (Q, 4, 4) f8
    T_container_goal: Array  # (G, 4, 4) f8, candidate poses of the object; each free slot once
    goal_kind: Array  # (G,) u1, index into GOAL_KINDS
    goal_clearance: Array  # (G,) f8, m, total free play along the tightest horizontal direction
    goal_approach: Array  # (G, 3) f8, unit, container frame: out of the place; the object comes in against it
    opening: Array  # (3,) f8, unit, container frame: out of the container
    max_tilt: float  # rad, largest angle from upright that still counts as placed
    symmetry_kind: int  # index into SYMMETRIES
    symmetry_axis: Array  # (3,) f8, unit, object frame
    T_world_container: Array  # (4, 4) f8
    T_world_object_start: Array  # (4, 4) f8
    container_instance: int  # i8, digest of the container's and clutter's geometry
    object_instance: int  # i8, digest of the object's geometry
    task: int = 0  # of a mixture: which of its tasks


@dataclass(frozen=True)
class Demo:
    """A scene whose goals were settled and checked, with one of them demonstrated: what `demonstrate` returns."""

    T_world_container: Array = array("pose/T_world_container", "<f8", ("demo", 4, 4), "m", "world", "pose of the container")
    T_world_object_start: Array = array(
        "pose/T_world_object_start", "<f8", ("demo", 4, 4), "m", "world", "pose of the object as observed, before placing"
    )
    T_world_object_goal: Array = array(
        "pose/T_world_object_goal", "<f8", ("demo", 4, 4), "m", "world", "demonstrated goal: one valid goal, chosen uniformly"
    )
    goals: Array = array("goals/T_world_object", "<f8", ("goal", 4, 4), "m", "world", "every valid goal, as settled")
    goal_kind: Array = array("goals/kind", "|u1", ("goal",), "1", "-", "what the goal rests on", GOAL_KINDS)
    goal_clearance: Array = array(
        "goals/clearance", "<f8", ("goal",), "m", "-", "total free play along the tightest horizontal direction"
    )
    goal_approach: Array = array(
        "goals/approach", "<f8", ("goal", 3), "1", "container", "unit vector out of the place: the object comes in against it"
    )
    rejected_goals: Array = array(
        "rejected_goals/T_world_object", "<f8", ("rejected_goal", 4, 4), "m", "world", "candidates that failed, as proposed"
    )
    rejected_reason: Array = array(
        "rejected_goals/reason", "|u1", ("rejected_goal",), "1", "-", "why it failed", REJECT_REASONS
    )
    symmetry_kind: Array = array("symmetry/kind", "|u1", ("demo",), "1", "-", "symmetry group of the object", SYMMETRIES)
    symmetry_axis: Array = array("symmetry/axis", "<f8", ("demo", 3), "1", "object", "axis of revolution")
    part_kind: Array = array("scene/kind", "|u1", ("part",), "1", "-", "shape of each part", PART_KINDS)
    part_size: Array = array(
        "scene/size",
        "<f8",
        ("part", 3),
        "m",
        "part",
        "full extents: box x y z, cylinder diameter diameter height, ellipsoid, mesh: of a box",
    )
    T_container_part: Array = array("scene/T_container_part", "<f8", ("part", 4, 4), "m", "container", "pose of each part")
    part_role: Array = array("scene/role", "|u1", ("part",), "1", "-", "container, or clutter that stands in it", ROLES)
    opening: Array = array("scene/opening", "<f8", ("demo", 3), "1", "container", "unit vector out of the container's opening")
    max_tilt: Array = array("scene/max_tilt", "<f8", ("demo",), "rad", "-", "largest tilt that counts as placed")
    object_kind: Array = array("object_parts/kind", "|u1", ("object_part",), "1", "-", "shape of each part", PART_KINDS)
    object_size: Array = array("object_parts/size", "<f8", ("object_part", 3), "m", "part", "full extents, as scene/size")
    T_object_part: Array = array("object_parts/T_object_part", "<f8", ("object_part", 4, 4), "m", "object", "pose of each part")
    demo: Array = array("meta/demo", "<i8", ("demo",), "1", "-", "index of the demo in the dataset")
    seed: Array = array("meta/seed", "<i8", ("demo",), "1", "-", "the recipe's seed")
    container_instance: Array = array("meta/container_instance", "<i8", ("demo",), "1", "-", "digest of container and clutter")
    object_instance: Array = array("meta/object_instance", "<i8", ("demo",), "1", "-", "digest of the object's geometry")
    attempts: Array = array("meta/attempts", "<i8", ("demo",), "1", "-", "scenes drawn until this one was accepted")
    task: Array = array("meta/task", "|u1", ("demo",), "1", "-", "of a mixture: place in the recipe's scene.scenes")


@dataclass(frozen=True, kw_only=True)
class Meshes:
    """Triangles of the parts whose kind is mesh. Only datasets that were imported have these arrays."""

    mesh_points: Array = array("mesh_vertices/points", "<f4", ("mesh_vertex", 3), "m", "part", "corners of triangles")
    mesh_part: Array = array(
        "mesh_vertices/part", "<i4", ("mesh_vertex",), "1", "-", "its part: rows of scene/, then those of object_parts/"
    )
    mesh_faces: Array = array(
        "mesh_faces/vertices", "<i4", ("mesh_face", 3), "1", "-", "rows of mesh_vertices/, anticlockwise seen from outside"
    )


@dataclass(frozen=True)
class MeshScene(Scene, Meshes):
    """A scene with parts that are meshes."""


@dataclass(frozen=True)
class MeshDemo(Demo, Meshes):
    """A demo with parts that are meshes."""


@dataclass(frozen=True)
class Cloud:
    """Fused, voxelled clouds as the cameras saw them: what `observe` returns."""

    container_points: Array = array("container/points", "<f4", ("container_point", 3), "m", "world", "observed points")
    container_normals: Array = array("container/normals", "<f4", ("container_point", 3), "1", "world", "unit, toward sensor")
    container_view: Array = array("container/view", "|u1", ("container_point",), "1", "-", "camera that saw most of the voxel")
    object_points: Array = array("object/points", "<f4", ("object_point", 3), "m", "world", "observed points at the start pose")
    object_normals: Array = array("object/normals", "<f4", ("object_point", 3), "1", "world", "unit, toward sensor")
    object_view: Array = array("object/view", "|u1", ("object_point",), "1", "-", "camera that saw most of the voxel")
    camera_K: Array = array("camera/K", "<f8", ("camera", 3, 3), "px", "-", "intrinsics; container cameras first")
    T_world_camera: Array = array(
        "camera/T_world_camera",
        "<f8",
        ("camera", 4, 4),
        "m",
        "world",
        "pose the cloud was fused with: believed, then aligned to the other views; OpenCV axes: x right, y down, z ahead",
    )


@dataclass(frozen=True)
class Superpoints:
    """The partition of both clouds: what `cluster` returns. Superpoint s of a demo is row s of its block."""

    container_superpoint: Array = array(
        "container/superpoint", "<i4", ("container_point",), "1", "-", "superpoint of each point, counted from 0 in each demo"
    )
    object_superpoint: Array = array(
        "object/superpoint", "<i4", ("object_point",), "1", "-", "superpoint of each point, counted from 0 in each demo"
    )
    container_superpoint_points: Array = array(
        "container_superpoints/points", "<f4", ("container_superpoint", 3), "m", "world", "mean of the points"
    )
    container_superpoint_normals: Array = array(
        "container_superpoints/normals", "<f4", ("container_superpoint", 3), "1", "world", "unit, mean of the normals"
    )
    container_superpoint_size: Array = array(
        "container_superpoints/size", "<i4", ("container_superpoint",), "1", "-", "number of points"
    )
    object_superpoint_points: Array = array(
        "object_superpoints/points", "<f4", ("object_superpoint", 3), "m", "world", "mean of the points, start pose"
    )
    object_superpoint_normals: Array = array(
        "object_superpoints/normals", "<f4", ("object_superpoint", 3), "1", "world", "unit, mean of the normals"
    )
    object_superpoint_size: Array = array(
        "object_superpoints/size", "<i4", ("object_superpoint",), "1", "-", "number of points"
    )


@dataclass(frozen=True)
class Labels:
    """What the two networks learn: what `label` returns."""

    affordance: Array = array(
        "container_superpoints/affordance", "<f4", ("container_superpoint",), "1", "-", "in [-1, 1]: 1 near the placed object"
    )
    corr_object: Array = array(
        "correspondence/object_superpoint", "<i4", ("correspondence",), "1", "-", "superpoint of the object"
    )
    corr_container: Array = array(
        "correspondence/container_superpoint", "<i4", ("correspondence",), "1", "-", "superpoint of the container"
    )
    corr_distance: Array = array(
        "correspondence/distance", "<f4", ("correspondence",), "m", "-", "distance of the two with the object at the goal"
    )


R = TypeVar("R", "Demo", "Cloud", "Superpoints", "Labels")
Record = Demo | Cloud | Superpoints | Labels
RECORDS: tuple[type[Record], ...] = (Demo, Cloud, Superpoints, Labels)


def columns(*records: type[Record] | type[Meshes]) -> Iterator[Field[Any]]:
    """The fields of the given record classes (default: all that every dataset has), that is, the arrays of a shard."""
    for record in records or RECORDS:
        yield from fields(record)


def is_ragged(column: Field[Any]) -> bool:
    """Whether the array has a number of rows that differs from demo to demo."""
    return bool(column.metadata["dims"][0] != "demo")


# What the first datasets of format 1 do not hold, by path, from what they do: their objects all come in through the opening.
LATER: dict[str, Callable[[Mapping[str, Array]], Array]] = {
    "goals/approach": lambda sample: np.tile(sample["scene/opening"], (len(sample["goals/kind"]), 1)),
    "meta/task": lambda sample: np.zeros((), np.uint8),
}


def read_record(record: type[R], sample: Mapping[str, Array]) -> R:
    """A record from one demo's arrays by path (as `dapdata.open(...)[i]` gives them)."""
    return record(**{c.name: _stored_or_later(sample, c.metadata["path"]) for c in fields(record)})


def _stored_or_later(sample: Mapping[str, Array], path: str) -> Array:
    return LATER[path](sample) if path not in sample and path in LATER else sample[path]


def read_demo(sample: Mapping[str, Array]) -> Demo:
    """The Demo of one demo's arrays by path, a MeshDemo if it has meshes."""
    return read_record(MeshDemo if "mesh_vertices/points" in sample else Demo, sample)


def to_sample(*records: Record) -> dict[str, Array]:
    """One demo's arrays by path, in the stored dtype; the inverse of `read_record`.

    Raises:
        ValueError: if a number is no integer, or too large, for an array of integers.
    """
    return {
        c.metadata["path"]: _stored(c.metadata["path"], getattr(record, c.name), np.dtype(c.metadata["dtype"]))
        for record in records
        for c in fields(record)
    }


def _stored(path: str, value: Any, dtype: np.dtype[Any]) -> Array:
    with np.errstate(invalid="ignore", over="ignore"):  # what overflows is found below, or by `store.problems`
        array = np.asarray(value, dtype=dtype)
    if dtype.kind in "iu" and not np.array_equal(array, value):
        raise ValueError(f"{path}: numbers that {dtype.name} cannot hold")
    return array


class Mesh(NamedTuple):
    """A part that is a mesh."""

    vertices: Array  # (V, 3) f8, m, part frame
    faces: Array  # (F, 3) i8, rows of vertices, anticlockwise seen from outside


def pack_meshes(meshes: Sequence[Mesh | None]) -> Meshes:
    """The arrays of the meshes of a scene: one for each row of scene/, then of object_parts/; None for other kinds."""
    own = [(part, mesh) for part, mesh in enumerate(meshes) if mesh is not None]
    starts = np.cumsum([0, *(len(mesh.vertices) for _, mesh in own)])
    return Meshes(
        mesh_points=np.concatenate([np.zeros((0, 3)), *(mesh.vertices for _, mesh in own)]).astype("<f4"),
        mesh_part=np.repeat([part for part, _ in own], [len(mesh.vertices) for _, mesh in own]).astype("<i4"),
        mesh_faces=np.concatenate([np.zeros((0, 3)), *(mesh.faces + start for (_, mesh), start in zip(own, starts))]).astype(
            "<i4"
        ),
    )


def meshes_of(record: Scene | Demo) -> tuple[list[Mesh | None], list[Mesh | None]]:
    """The mesh of each part of the container and of each part of the object; None for those of other kinds."""
    return _unpack_meshes(len(record.part_kind), len(record.object_kind), record if isinstance(record, Meshes) else None)


def meshes_in(sample: Mapping[str, Array]) -> tuple[list[Mesh | None], list[Mesh | None]]:
    """The same from one demo's arrays by path."""
    arrays = {c.name: sample[c.metadata["path"]] for c in fields(Meshes) if c.metadata["path"] in sample}
    return _unpack_meshes(len(sample["scene/kind"]), len(sample["object_parts/kind"]), Meshes(**arrays) if arrays else None)


def _unpack_meshes(P: int, Q: int, meshes: Meshes | None) -> tuple[list[Mesh | None], list[Mesh | None]]:
    """The inverse of `pack_meshes`, for P parts of the container and Q of the object."""
    found: list[Mesh | None] = [None] * (P + Q)
    if meshes is None:
        return found[:P], found[P:]
    for part in np.unique(meshes.mesh_part):
        own = meshes.mesh_part == part
        faces = meshes.mesh_faces[own[meshes.mesh_faces[:, 0]]]
        found[int(part)] = Mesh(meshes.mesh_points[own].astype(float), (np.cumsum(own) - 1)[faces])
    return found[:P], found[P:]


@dataclass(frozen=True)
class Placement:
    """One candidate that a method proposes for a demo; a failed one has a status other than "ok" and NaN poses."""

    T_world_object: Array  # (4, 4) f8
    score: float  # larger is better; only the order within a demo matters
    status: str  # "ok", or why there is no pose


@dataclass(frozen=True)
class Verdict:
    """What the judge saw when it executed one placement."""

    success: bool
    reason: str  # "ok", or the first criterion that failed
    T_world_object_end: Array  # (4, 4) f8, where the object came to rest; NaN if it was never released
    moved: float  # m, from the prediction to the end, modulo symmetry
    turned: float  # rad, the same
    push: float  # N, largest pushing force while moving in
    penetration: float  # m, overlap with container and clutter at the predicted pose
    gap: float  # m, free height under the object at the predicted pose (0 where it touches or overlaps)
