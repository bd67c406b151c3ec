"""RPDiff's demonstrations as they lie on disk: where they are, what each holds, and what is wrong with it.

`demo_aug_*.npz` one by one, or nine to a chunk; current layout (lists of poses, `placement_object_idx`) and legacy layout
(one pose a body). Nothing is believed: a demo with a fault is rejected by reason, and counted; REASONS has all of them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import durable, meshes, store
from dapdata.config import RpdiffConfig
from dapdata.errors import FormatError, UsageError
from dapdata.interop import object_arrays
from dapdata.poses import inverse, pose, transform
from dapdata.records import Cloud, MeshDemo, Rejected, columns, read_record
from dapdata.simulate import from_pose7

Array = NDArray[Any]
Fields = Mapping[str, Any]  # what a demo's file holds, by key

REASONS = {  # besides those of a goal that does not hold, and those of a cloud that is too small
    "unreadable": "the file is damaged or cut off, or is no npz file",
    "refused": "a pickle in it asks for something else than numbers, text, plain containers and plain arrays; nothing was run",
    "outside": "the file is a link that leads out of the source",
    "too_large": "an array of more than 128 MB, or a cloud of more than 5 million points",
    "missing_keys": "one of the keys that are needed is not there, or does not hold what it should",
    "unsuccessful": "`success` is not true",
    "no_container_points": "nobody saw the container",
    "no_object_points": "nobody saw the object",
    "not_finite": "points, poses or cameras with NaN or infinity",
    "not_metres": "a container that is not 5 cm to 5 m across, or an object that is not 5 mm to 1 m",
    "not_on_table": "a container that is more than 10 cm below or 1 m above the table, see `scene.table_height`",
    "not_rigid": "a rotation that is none, or a mirrored one",
    "clouds_and_poses_differ": "the final cloud is not the first one, moved as the poses say",
    "normals_inwards": "normals that come with the clouds, and look into the object",
    "no_normals": "no normals in the file, and no cameras to estimate them for",
    "mesh_missing": "--meshes has no such mesh, or only a link that leads out of it",
    "mesh_broken": "a mesh or a slot file that is damaged, has no area, numbers that are not finite, or is not in metres",
    "mesh_too_large": "a mesh of more than 200000 faces or 50 MB",
    "mesh_and_cloud_differ": "the cloud is more than 1 cm off the mesh in the median, and at no scale on it",
    "object_not_convex": "the object's mesh is not convex, and has no convex decomposition beside it",
    "bad_arrays": "arrays that dapdata exported and that are not what it writes",
}
NEEDED = ("multi_obj_start_pcd", "multi_obj_start_obj_pose", "multi_obj_final_obj_pose")
USED = (
    *NEEDED,
    "success",
    "multi_obj_names",
    "multi_obj_final_pcd",
    "cam_intrinsics",
    "cam_poses",
    "multi_object_ids",
    "placement_object_idx",
    "multi_obj_mesh_file",
    "multi_obj_mesh_file_dec",
    "normals",
    "dapdata",
)
SLOTS = "open_slot_poses"  # in the names of files that say where a container has room
SLOT_SUFFIXES = (f"_{SLOTS}.txt", f"_{SLOTS}.npz")
CONTAINER_SPAN, OBJECT_SPAN = (0.05, 5.0), (0.005, 1.0)  # m
ON_TABLE = (-0.1, 1.0)  # m: where the lowest points of a container are, above the table; one may hang on a wall
MAX_POINTS = 5_000_000  # of a body's cloud; four cameras of 640x480 have 1.2 million pixels
SAME = 1e-3  # m: a final cloud is the first one, moved, to less than this


class Fault(Exception):  # noqa: N818, it is no error
    """A reason why a demo is rejected, and what was found."""

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(reason)
        self.reason, self.detail = reason, detail


# Where the demos are ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Place:
    """Where a demo is."""

    file: Path
    chunk_key: str | None  # None: the file is the demo
    name: str  # from the source on, for people


@lru_cache(maxsize=2)
def find(source: str) -> tuple[tuple[Place, ...], str]:
    """The demos of a file or of a folder with all below it, in the order of their numbers, and a digest of the source.

    The digest is over names, sizes and checksums of the arrays, which the files' own directories hold, so that 80 GB need
    not be read twice. Reading an array compares it with its checksum.

    Raises:
        FormatError: nothing is there, or nothing that could be a demo of RPDiff.
    """
    root = Path(source)
    if not root.exists():
        raise FormatError(f"{root}: no such file or folder, expected demos of RPDiff (demo_aug_*.npz); check the path")
    files = [root] if root.is_file() else sorted(below(root, (".npz",)), key=natural)
    files = [file for file in files if SLOTS not in file.name]
    places, whole, recognised = list[Place](), sha256(), False
    for file in files:
        name = file.name if root.is_file() else file.relative_to(root).as_posix()
        try:
            members = object_arrays.member_names(file) if root.is_file() or is_inside(file, root) else {}
        except FormatError:
            members = {}
        is_chunk = bool(members) and all(name.isdecimal() for name in members)
        recognised |= is_chunk or NEEDED[0] in members
        keys = sorted(members, key=int) if is_chunk else [None]
        places += [Place(file, key, name if key is None else f"{name}, demo {key}") for key in keys]
        whole.update(durable.canonical([name, file.lstat().st_size, sorted(members.items())]))
    if not recognised:
        what = f"{len(files)} npz files without `{NEEDED[0]}`" if files else "no npz files"
        raise FormatError(f"{root}: {what}, expected demos of RPDiff (demo_aug_*.npz), one by one or in chunks; check the path")
    return tuple(places), whole.hexdigest()


def below(root: Path, suffixes: tuple[str, ...]) -> Iterator[Path]:
    """The files with one of some suffixes in a folder and all below it.

    Raises:
        FormatError: a folder in it is a link: what is behind it would be left out, or read twice.
    """
    for folder, folders, names in os.walk(root):
        for name in folders:
            if Path(folder, name).is_symlink():
                raise FormatError(f"{folder}/{name}: a link to a folder, expected a folder; import what it leads to on its own")
        yield from (Path(folder, name) for name in names if name.lower().endswith(suffixes))


def is_inside(path: Path, root: Path) -> bool:
    """Whether a file is in a folder, and no link that leads out of it."""
    return path.is_file() and path.resolve().is_relative_to(root.resolve())


def natural(path: Path) -> tuple[Any, ...]:
    """Numbers in names count as numbers."""
    return tuple((int(word), "") if word.isdecimal() else (-1, word) for word in re.split(r"(\d+)", path.as_posix()))


@dataclass(frozen=True)
class MeshFolder:
    """The meshes and slot files below a folder, by their names; links that lead out of it are none."""

    files: Mapping[str, tuple[Path, ...]]
    sha256: str

    def path(self, named: str) -> Path | None:
        """The file that a demo names; of several with its name the one whose folders are most like the named ones."""
        words = named.replace("\\", "/").split("/")[::-1]

        def alike(path: Path) -> int:
            same = [a == b for a, b in zip(path.parts[::-1], words)]
            return (*same, False).index(False)

        return max(self.files.get(words[0], ()), key=alike, default=None)


@lru_cache(maxsize=2)
def mesh_folder(folder: str) -> MeshFolder:
    """What is in a folder of meshes.

    Raises:
        FormatError: it is no folder, or has no mesh.
    """
    root = Path(folder)
    if not root.is_dir():
        raise FormatError(f"{root}: no such folder, expected meshes ({', '.join(meshes.SUFFIXES)}); check --meshes")
    found: dict[str, tuple[Path, ...]] = {}
    whole = sha256()
    for path in sorted(below(root, (*meshes.SUFFIXES, *SLOT_SUFFIXES)), key=natural):
        if is_inside(path, root):
            found[path.name] = (*found.get(path.name, ()), path)
            whole.update(durable.canonical([path.relative_to(root).as_posix(), durable.hash_file(path)]))
    if not any(name.lower().endswith(meshes.SUFFIXES) for name in found):
        raise FormatError(f"{root}: has no meshes, expected {', '.join(meshes.SUFFIXES)} files; check --meshes")
    return MeshFolder(found, whole.hexdigest())


def scene_section(source: str, folder: str | None) -> dict[str, Any]:
    """The scene section of a recipe that imports from a source, with the digests of what is there now."""
    section = {"task": "rpdiff", "source": source, "source_sha256": find(source)[1]}
    return section | ({"meshes": folder, "meshes_sha256": mesh_folder(folder).sha256} if folder else {})


def _place(config: RpdiffConfig, demo: int) -> Place:
    """Where demo number `demo` is, in the source that was asked for and no other."""
    places, digest = find(config.source)
    if digest != config.source_sha256 or (config.meshes and mesh_folder(config.meshes).sha256 != config.meshes_sha256):
        raise FormatError(f"{config.source}: has changed since the import began, expected the same files; import it again")
    if demo >= len(places):
        raise UsageError(f"{config.source}: demo {demo} of {len(places)}, expected at most {len(places)} demos; lower --demos")
    return places[demo]


# What a demo holds -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Bodies:
    """Something of the container's and of the object's."""

    parent: Any
    child: Any


@dataclass(frozen=True)
class Raw:
    """A demo as its file tells it, checked; poses and points in the source's world."""

    points: Bodies  # (N, 3) and (M, 3) f8, m, at the start
    normals: Bodies | None  # (N, 3) and (M, 3), unit
    T_world_parents: Array  # (C, 4, 4) containers
    parent: int  # which of them the object is placed into
    T_world_start: Array  # (4, 4) of the object
    T_world_final: Array  # (4, 4) of the object, commanded
    K: Array  # (V, 3, 3) px
    T_world_camera: Array  # (V, 4, 4) OpenCV axes
    names: Bodies  # C and 1 instance names
    mesh_files: Bodies  # C and 1 paths, as on the machine that made them
    convex_file: str  # of the object's convex decomposition
    classes: Bodies  # words for what they are, such as syn_book


def on_table(T_world: Array, config: RpdiffConfig) -> Array:
    """A pose of the source's world in ours, whose z = 0 is the table."""
    return pose(T_world[:3, :3], T_world[:3, 3] - [0, 0, config.table_height])


def own(arrays: Any, kind: Any) -> Any:
    """A record from the arrays of a demo that dapdata exported, which hold more than RPDiff's own.

    Raises:
        Fault: they are not what dapdata writes.
    """
    sample: store.Sample = {}
    for column in columns(MeshDemo, Cloud):
        path, dtype = column.metadata["path"], np.dtype(column.metadata["dtype"])
        array = arrays.get(path) if isinstance(arrays, dict) else None
        if not isinstance(array, np.ndarray) or array.dtype != dtype:
            raise Fault("bad_arrays", path)
        sample[path] = array
    problem = next(store.problems(sample), None)
    if problem:
        raise Fault("bad_arrays", problem)
    return read_record(kind, sample)


def read_fields(config: RpdiffConfig, demo: int) -> Fields:
    """The used keys of demo number `demo` of the source.

    Raises:
        Fault: it cannot be read, or a key is missing.
        FormatError: the source has changed since its digest was taken.
    """
    place = _place(config, demo)
    if not (Path(config.source).is_file() or is_inside(place.file, Path(config.source))):
        raise Fault("outside", "expected a file; import the folder that it leads to")
    try:
        if place.chunk_key is not None:
            found = object_arrays.read(place.file, place.chunk_key)
            if not isinstance(found, dict):
                raise Fault("missing_keys", f"{type(found).__name__}, expected a dict")
            return {key: value for key, value in found.items() if key in USED}
        there = object_arrays.member_names(place.file)
        for key in NEEDED:
            if key not in there:
                raise Fault("missing_keys", f"no {key}")
        return {key: object_arrays.read(place.file, key) for key in USED if key in there}
    except FormatError as error:
        reasons = {object_arrays.RefusedError: "refused", object_arrays.TooLargeError: "too_large"}
        raise Fault(reasons.get(type(error), "unreadable"), str(error)) from error


def rejected(config: RpdiffConfig, demo: int, fault: Fault) -> Rejected:
    """What becomes of demo number `demo` of the source, with its file in the detail."""
    place = _place(config, demo)
    return Rejected(fault.reason, f"{place.name}: {fault.detail or REASONS.get(fault.reason, 'the demonstrated goal')}")


def check(found: Fields, table_height: float) -> Raw:
    """What the fields of a demo tell, checked.

    Args:
        found: By key.
        table_height: z of the table top in the source's world, m.

    Raises:
        Fault: with the first reason against them.
    """
    if "success" in found and not (np.size(found["success"]) == 1 and np.all(np.asarray(found["success"]) == 1)):
        raise Fault("unsuccessful")
    points = _clouds(found, "multi_obj_start_pcd")
    if not len(points.parent) or not len(points.child):
        raise Fault("no_object_points" if len(points.parent) else "no_container_points")
    start, final = (_both(found, key) for key in NEEDED[1:])
    T_world_parents, T_world_start = poses_of(start.parent), poses_of(start.child)
    T_world_final = poses_of(final.child)
    parent = _placed_into(found, T_world_parents, T_world_final[0])
    K, T_world_camera = _cameras(found.get("cam_intrinsics"), found.get("cam_poses"))
    for body, cloud, (least, most) in (("container", points.parent, CONTAINER_SPAN), ("object", points.child, OBJECT_SPAN)):
        span = float(np.max(np.quantile(cloud, 0.99, axis=0) - np.quantile(cloud, 0.01, axis=0)))
        if not least <= span <= most:
            hint = "; in millimetres?" if least <= span / 1000 <= most else ""
            raise Fault("not_metres", f"{body} of {span:.3g} m, expected {least} to {most} m{hint}")
    height = float(np.quantile(points.parent[:, 2], 0.01)) - table_height
    if not ON_TABLE[0] <= height <= ON_TABLE[1]:
        raise Fault("not_on_table", f"the container's lowest points are {height:.2f} m above the table; set scene.table_height")
    if len(T_world_start) != 1 or len(T_world_final) != 1:
        raise Fault("missing_keys", f"{len(T_world_start)} and {len(T_world_final)} poses of the object, expected one each")
    _check_final_cloud(found, points.child, T_world_final[0] @ inverse(T_world_start[0]))
    names, files, convex = (
        _texts(found, key, len(T_world_parents))
        for key in ("multi_object_ids", "multi_obj_mesh_file", "multi_obj_mesh_file_dec")
    )
    return Raw(
        points=points,
        normals=_normals(found, points),
        T_world_parents=T_world_parents,
        parent=parent,
        T_world_start=T_world_start[0],
        T_world_final=T_world_final[0],
        K=K,
        T_world_camera=T_world_camera,
        names=names,
        mesh_files=files,
        convex_file=convex.child[0],
        classes=_classes(found),
    )


def _classes(found: Fields) -> Bodies:
    """What container and object are called; nothing where the file does not tell."""
    if found.get("multi_obj_names") is None:
        return Bodies("", "")
    both = _both(found, "multi_obj_names")
    return Bodies(*(name if isinstance(name, str) else "" for name in (both.parent, both.child)))


def _both(found: Fields, key: str) -> Bodies:
    """The two bodies of a field, which is a dict {parent, child}."""
    value = found.get(key)
    if not isinstance(value, dict) or not {"parent", "child"} <= value.keys():
        raise Fault("missing_keys", f"{key}: no parent and child" if key in found else f"no {key}")
    return Bodies(value["parent"], value["child"])


def _numbers(value: Any) -> Array:
    """Numbers as f8, from an array or from a list, or lists, of numbers."""
    if isinstance(value, list):
        rows = value if value and all(isinstance(row, (list, tuple, np.ndarray)) for row in value) else [value]
        if len(rows) > 1000 or any(len(row) > 16 for row in rows):
            raise Fault("missing_keys", "lists of other than some numbers")
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise Fault("missing_keys", str(error)) from error
    if array.dtype.kind not in "fiu":
        raise Fault("missing_keys", f"{array.dtype}, expected numbers")
    if array.size > 3 * MAX_POINTS:
        raise Fault("too_large", f"{array.shape}, expected {MAX_POINTS} points at the most; thin the clouds out")
    return array.astype(np.float64)


def _clouds(found: Fields, key: str) -> Bodies:
    """(N, 3) and (M, 3) of the two bodies; several containers in a list are one cloud."""
    both, clouds = _both(found, key), []
    for cloud in (both.parent, both.child):
        listed = cloud if isinstance(cloud, list) else [cloud]
        if sum(np.size(part) for part in listed if isinstance(part, np.ndarray)) > 3 * MAX_POINTS:
            raise Fault("too_large", f"{key}: expected {MAX_POINTS} points at the most; thin the clouds out")
        parts = [_numbers(part) for part in listed]
        for part in parts:
            if part.size and (part.ndim != 2 or part.shape[1] != 3):
                raise Fault("missing_keys", f"{key}: an array of shape {part.shape}, expected (N, 3)")
        clouds.append(np.concatenate([np.zeros((0, 3)), *(part.reshape(-1, 3) for part in parts)]))
        if not np.isfinite(clouds[-1]).all():
            raise Fault("not_finite", key)
    return Bodies(*clouds)


def _normals(found: Fields, points: Bodies) -> Bodies | None:
    """(N, 3) and (M, 3) of the two clouds, None where the file has none; those of the object look out of it."""
    if found.get("normals") is None:
        return None
    normals = _clouds(found, "normals")
    for body in ("parent", "child"):
        there, wanted = getattr(normals, body).shape, getattr(points, body).shape
        if there != wanted:
            raise Fault("missing_keys", f"normals: {body} of shape {there}, expected {wanted}")
    if np.einsum("ij,ij->", normals.child, points.child - points.child.mean(axis=0)) < 0:
        raise Fault("normals_inwards", "expected them to look out of the object; turn them")
    return normals


def _placed_into(found: Fields, T_world_parents: Array, T_world_final: Array) -> int:
    """Which of the containers the object is placed into: the one that the file says, or else the nearest."""
    if found.get("placement_object_idx") is not None:
        return _number(_both(found, "placement_object_idx").parent, len(T_world_parents))
    return int(np.linalg.norm(T_world_parents[:, :3, 3] - T_world_final[:3, 3], axis=1).argmin())


def poses_of(value: Any) -> Array:
    """(C, 4, 4) of one pose of seven numbers, or of a list of them."""
    numbers = _numbers(value)
    numbers = numbers[None] if numbers.ndim == 1 else numbers
    if numbers.ndim != 2 or numbers.shape[1] != 7 or not len(numbers):
        raise Fault("missing_keys", f"poses of shape {numbers.shape}, expected seven numbers each")
    if not np.isfinite(numbers).all():
        raise Fault("not_finite", "poses")
    length = np.linalg.norm(numbers[:, 3:], axis=1)
    if np.abs(length - 1).max() > 1e-3:
        raise Fault("not_rigid", f"a quaternion of length {length[np.abs(length - 1).argmax()]:.3g}")
    return np.stack([from_pose7(row) for row in numbers])


def _cameras(intrinsics: Any, poses: Any) -> tuple[Array, Array]:
    """(V, 3, 3) and (V, 4, 4); V is 0 where the file has none."""
    if intrinsics is None or poses is None:
        return np.zeros((0, 3, 3)), np.zeros((0, 4, 4))
    K, T = (np.asarray(x) for x in (intrinsics, poses))
    if K.dtype.kind not in "fiu" or T.dtype.kind not in "fiu" or K.shape[1:] != (3, 3) or T.shape != (len(K), 4, 4):
        raise Fault("missing_keys", f"cameras of shapes {K.shape} and {T.shape}, expected (V, 3, 3) and (V, 4, 4)")
    if not (np.isfinite(K).all() and np.isfinite(T).all()):
        raise Fault("not_finite", "cameras")
    turn = T[:, :3, :3]
    is_rigid = np.abs(turn @ np.swapaxes(turn, 1, 2) - np.eye(3)).max(initial=0) < 1e-3 and (np.linalg.det(turn) > 0).all()
    if not is_rigid or (K[:, [0, 1], [0, 1]] <= 0).any():
        raise Fault("not_rigid", "cam_poses or cam_intrinsics, of which one is mirrored or no rigid motion")
    left, _, right = np.linalg.svd(turn.astype(float))
    return K.astype(float), np.stack([pose(R, t) for R, t in zip(left @ right, T[:, :3, 3])]) if len(T) else T.astype(float)


def _check_final_cloud(found: Fields, first: Array, T_final_start: Array) -> None:
    """Whether the object's final cloud is the first one, moved; it may be missing, or have other points."""
    if found.get("multi_obj_final_pcd") is None:
        return
    final = _clouds(found, "multi_obj_final_pcd").child
    apart = float(np.abs(transform(T_final_start, first) - final).max()) if final.shape == first.shape else 0.0
    if apart > SAME:
        raise Fault("clouds_and_poses_differ", f"by up to {1000 * apart:.0f} mm, expected less than {1000 * SAME:.0f}")


def _number(value: Any, count: int) -> int:
    index = int(value) if isinstance(value, (int, np.integer)) else -1
    if not 0 <= index < count:
        raise Fault("missing_keys", f"placement_object_idx: {value!r}, expected one of {count} containers")
    return index


def _texts(found: Fields, key: str, parents: int) -> Bodies:
    """A text for each of the containers and one for the object, empty where the file has none."""
    both = _both(found, key) if found.get(key) is not None else Bodies([], [])
    texts = []
    for one, count in ((both.parent, parents), (both.child, 1)):
        words = [one] if isinstance(one, str) else one if isinstance(one, list) else []
        words = [str(word) for word in words if isinstance(word, str)]
        texts.append(words if len(words) == count else [""] * count)
    return Bodies(*texts)
