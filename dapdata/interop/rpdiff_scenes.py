"""From a demo of RPDiff to a scene of ours, with its goals.

With the meshes, container and object are solid again. The object's mesh is the convex decomposition (`_dec.obj`), because
that is what RPDiff simulates and renders: clouds of objects are 0.1 to 0.3 mm off it in the median, and 0.4 to 0.8 mm off
the mesh itself (measured on six demos of its own generator). A commanded pose is let go, as RPDiff does before it checks a
placement, and what it comes to is the demonstrated goal, if that stands up to what our own goals must. So are the free
slots of the container, where a file names them. Without meshes there is one goal, of the kind "commanded".

Considered and not taken: primitives fitted to the pieces of a mesh (a convex hull is as exact to the simulator), and
fitting the scale of books and cans (it is not stored, within 0.5 %); only meshes off which the cloud is are fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import meshes, solids, store
from dapdata.config import RpdiffConfig
from dapdata.errors import FormatError
from dapdata.interop import object_arrays
from dapdata.interop.rpdiff_clouds import at_pixel_centres
from dapdata.interop.rpdiff_files import (
    SLOT_SUFFIXES,
    Fault,
    Raw,
    check,
    mesh_folder,
    on_table,
    own,
    poses_of,
    read_fields,
    rejected,
)
from dapdata.poses import inverse, pose, rotation_about, symmetric_distance, transform, upright_turn
from dapdata.records import (
    GOAL_KINDS,
    REJECT_REASONS,
    SYMMETRIES,
    Mesh,
    MeshDemo,
    Meshes,
    MeshScene,
    Rejected,
    meshes_of,
    pack_meshes,
)
from dapdata.simulate import HANG_SHIFT, PlacementConfig, drop, free_play, record, settle, ways_out

Array = NDArray[Any]

SCALES, OFF_SCALED = (0.05, 20.0), 0.005  # of meshes that are tried, and m that nine points of ten are off at most
MAX_SLOTS, MAX_SLOT_BYTES = 200, 1_000_000  # of a container; RPDiff's have 22 and a few kB at most
OFF_MESH, CHECKED_POINTS = 0.01, 500  # m; RPDiff's clouds are 0.1 to 0.8 mm off in the median
ABOVE = 0.01  # m: a slot's pose is let go from this far above, as in RPDiff
MAX_DROP = 0.04  # m: a pose that came further when it was let go did not hold; RPDiff's come 6 to 19 mm
SAME_GOAL = 0.015  # m and
SAME_TURN = np.radians(10)  # rad: closer poses are one goal; slots are at least a can's or a book's width apart
MAX_TILT_DEG = 15.0  # RPDiff's own limit, of cans
FULL = 0.95  # share of the cuboid or cylinder around it that an object of that symmetry fills at least
BOX_NAMES, ROUND_NAMES, PEG_NAMES = ("book", "box"), ("can",), ("rack", "hook", "hanger")  # words of classes
UP = np.array([0.0, 0.0, 1.0])


def demonstrate(config: RpdiffConfig, placement: PlacementConfig, demo: int) -> MeshDemo | Rejected:
    """Demo number `demo` of the source: its scene, and its goals as settled here, or one as it was commanded."""
    try:
        found = read_fields(config, demo)
        if "dapdata" in found:
            demo_as_exported: MeshDemo = own(found["dapdata"], MeshDemo)
            return demo_as_exported
        raw = check(found, config.table_height)
        return _settled(raw, config, placement) if config.meshes else _commanded(raw, config)
    except Fault as fault:
        return rejected(config, demo, fault)


def _commanded(raw: Raw, config: RpdiffConfig) -> MeshDemo:
    """The demo without parts, and with the one goal that the file tells."""
    T_theirs_object = _upright_frame(raw, np.zeros(3))
    scene = _scene(raw, config, T_theirs_object, [], [], _named_symmetry(raw, config, T_theirs_object))
    scene = replace(
        scene,
        container_instance=_named_instance(raw.names.parent[raw.parent]),
        object_instance=_named_instance(raw.names.child[0]),
    )
    goal = inverse(scene.T_world_container) @ on_table(raw.T_world_final, config) @ T_theirs_object
    made = record(_with_candidates(scene, goal[None], "commanded"), goal[None], [0], [], [], 0)
    assert isinstance(made, MeshDemo)
    return made


def _settled(raw: Raw, config: RpdiffConfig, placement: PlacementConfig) -> MeshDemo:
    """The demo with container and object as meshes, and with every goal that holds: the demonstrated one, and free slots."""
    parents, object_ = _meshes(raw, config)
    instances = solids.digest(*parents[raw.parent]), solids.digest(*(array for mesh in object_ for array in mesh))
    scale, parents = _at_scale(parents, raw.T_world_parents, raw.points.parent, raw, config)
    _, object_ = _at_scale(object_, np.tile(raw.T_world_start, (len(object_), 1, 1)), raw.points.child, raw, config)
    corners = np.concatenate([mesh.vertices for mesh in object_])
    low, high = corners.min(axis=0), corners.max(axis=0)
    T_theirs_object = _upright_frame(raw, (low + high) / 2)
    symmetry = _symmetry(object_, raw, config, T_theirs_object)
    scene = _scene(raw, config, T_theirs_object, parents, object_, symmetry)
    scene = replace(scene, container_instance=instances[0], object_instance=instances[1])
    T_container_world = inverse(scene.T_world_container)
    commanded = T_container_world @ on_table(raw.T_world_final, config) @ T_theirs_object
    T_container_parent = T_container_world @ on_table(raw.T_world_parents[raw.parent], config)
    height = float(abs(T_theirs_object[:3, 2]) @ (high - low))
    slots = [T_container_parent @ pose(T[:3, :3], scale * T[:3, 3]) for T in _slots(raw, config, T_theirs_object, height)]
    hangs = config.hanging == "yes" or (config.hanging == "auto" and _is_called(raw.classes.parent, PEG_NAMES))
    return _with_goals(scene, _distinct([commanded, *slots], 1e-4, 1e-3, scene), hangs, config, placement)


def _with_goals(scene: MeshScene, proposed: Array, hangs: bool, config: RpdiffConfig, placement: PlacementConfig) -> MeshDemo:
    """The demo of proposed poses (G, 4, 4), container frame, let go and checked.

    Raises:
        Fault: the first does not hold.
    """
    scene = _with_candidates(scene, proposed, "peg" if hangs else "settled")
    dropped = drop(scene, proposed, placement, config.drop_seconds)
    symmetry = SYMMETRIES[scene.symmetry_kind], scene.symmetry_axis
    came = [symmetric_distance(T, T_from, *symmetry) for T, T_from in zip(dropped, proposed)]
    most = (HANG_SHIFT, np.pi) if hangs else (MAX_DROP, np.radians(placement.max_turn_deg))
    stayed = [g for g, (shift, turn) in enumerate(came) if shift <= most[0] and turn <= most[1]]
    if 0 not in stayed:
        shift, turn = came[0]
        raise Fault("moved", f"the demonstrated goal, by {1000 * shift:.0f} mm and {np.degrees(turn):.0f} degrees when let go")
    chosen = _distinct(dropped[stayed], SAME_GOAL, SAME_TURN, scene)
    ways = ways_out(scene, chosen, _ways(scene, chosen, hangs), placement)
    if config.opening == "auto" and np.array_equal(ways[0], UP) and not hangs:
        scene = replace(scene, opening=UP)
    settled, reasons = settle(scene, chosen, placement, ways)
    if reasons[0] != "ok":
        raise Fault(reasons[0], "the demonstrated goal, as it came to rest")
    lost = [g for g in range(len(proposed)) if g not in stayed]
    everything = np.concatenate([chosen, proposed[lost]])
    reasons += ["moved"] * len(lost)
    scene = replace(
        _with_candidates(scene, everything, "peg" if hangs else "settled"),
        goal_clearance=np.concatenate([free_play(scene, settled, placement), _open(len(lost))]),
        goal_approach=np.concatenate([ways, np.tile(scene.opening, (len(lost), 1))]),
    )
    kept = [g for g, reason in enumerate(reasons) if reason == "ok"]
    codes = {g: REJECT_REASONS.index(reason) for g, reason in enumerate(reasons) if reason != "ok"}
    made = record(scene, np.concatenate([settled, proposed[lost]]), kept, list(codes), list(codes.values()), 0)
    assert isinstance(made, MeshDemo)
    return made


def _with_candidates(scene: MeshScene, poses: Array, kind: str) -> MeshScene:
    """The scene with candidates (G, 4, 4), container frame, of one kind, that come in through the opening."""
    count = len(poses)
    approach = np.tile(scene.opening, (count, 1))
    return replace(
        scene, T_container_goal=poses, goal_kind=_kinds(count, kind), goal_clearance=_open(count), goal_approach=approach
    )


def _ways(scene: MeshScene, poses: Array, hangs: bool) -> Array:
    """(G, W, 3) ways out that are tried in turn: of what hangs first along rods, the nearest first, then opening and up."""
    general = np.stack([scene.opening, UP])
    rods = [_rod(mesh, T) for mesh, T in zip(meshes_of(scene)[0], scene.T_container_part) if mesh is not None and hangs]
    found = []
    for T in poses:
        near = sorted((rod for rod in rods if rod is not None), key=lambda rod: float(np.linalg.norm(rod[1] - T[:3, 3])))
        found.append([*(way for way, _ in near), *(-way for way, _ in near), *general])
    return np.array(found)


def _rod(mesh: Mesh, T_container_part: Array) -> tuple[Array, Array] | None:
    """The way along a piece of the container that is a rod, upwards, and its upper end, container frame; None of others."""
    axis = meshes.long_axis(mesh)
    if axis is None:
        return None
    way = T_container_part[:3, :3] @ axis
    way = way if way[2] >= 0 else -way
    placed = transform(T_container_part, mesh.vertices)
    return way, placed[np.argmax(placed @ way)]


def _at_scale(found: Sequence[Mesh], T_world: Array, cloud: Array, raw: Raw, config: RpdiffConfig) -> tuple[float, list[Mesh]]:
    """The scale at which a cloud (N, 3) lies on meshes that are placed at (M, 4, 4) poses, and the meshes at that scale.

    It is 1 where that will do. RPDiff's racks and mugs are drawn at 0.25 to 0.35 of their meshes and do not say so.

    Raises:
        Fault: there is none: a mesh of the same name may be another one.
    """
    from scipy.optimize import minimize_scalar

    def off(scale: float) -> Array:
        few = cloud[:: max(1, len(cloud) // CHECKED_POINTS)]
        return meshes.distances([_moved(meshes.scaled(mesh, scale), T) for mesh, T in zip(found, T_world)], few)

    def mean(scale: float) -> float:
        return float(off(scale).mean())

    as_is = float(np.median(off(1.0)))
    if as_is <= OFF_MESH:
        return 1.0, list(found)
    cloud = at_pixel_centres(cloud, raw, config)
    coarse = np.geomspace(*SCALES, 100)
    nearest = int(np.argmin([mean(scale) for scale in coarse]))
    bounds = coarse[max(nearest - 1, 0)], coarse[min(nearest + 1, len(coarse) - 1)]
    fitted = minimize_scalar(mean, bounds=bounds, method="bounded", options={"xatol": 1e-4 * bounds[0]})
    if np.quantile(off(fitted.x), 0.9) > OFF_SCALED:
        raise Fault(
            "mesh_and_cloud_differ", f"by {1000 * as_is:.0f} mm in the median, and at every scale; expected the same body"
        )
    return float(fitted.x), [meshes.scaled(mesh, float(fitted.x)) for mesh in found]


def _scene(
    raw: Raw,
    config: RpdiffConfig,
    T_theirs_object: Array,
    parents: Sequence[Mesh],
    object_: Sequence[Mesh],
    symmetry: tuple[str, Array],
) -> MeshScene:
    """The scene without candidates and instances; meshes of containers and pieces of the object in their files' frames."""
    T_world_container = _level(on_table(raw.T_world_parents[raw.parent], config))
    T_container_parents = inverse(T_world_container) @ np.array([on_table(T, config) for T in raw.T_world_parents])
    placed = [_moved(piece, T) for mesh, T in zip(parents, T_container_parents) for piece in meshes.pieces(mesh)]
    parts = [meshes.centred(piece) for piece in placed]
    object_parts = [meshes.centred(_moved(piece, inverse(T_theirs_object)), by_mass=True) for piece in object_]
    sign, name = "+x" if config.opening == "auto" else config.opening
    opening = np.eye(3)["xyz".index(name)] * (1 if sign == "+" else -1)
    kind, axis = symmetry
    tilt = config.max_tilt_deg if config.max_tilt_deg is not None else MAX_TILT_DEG if kind != "none" else 180.0
    packed = pack_meshes([mesh for _, _, mesh in (*parts, *object_parts)])
    return MeshScene(
        **{field.name: getattr(packed, field.name) for field in fields(Meshes)},
        part_kind=np.full(len(parts), solids.MESH, np.uint8),
        part_size=np.array([size for size, _, _ in parts]).reshape(-1, 3),
        T_container_part=np.array([T for _, T, _ in parts]).reshape(-1, 4, 4),
        part_role=np.full(len(parts), solids.CONTAINER, np.uint8),
        object_kind=np.full(len(object_parts), solids.MESH, np.uint8),
        object_size=np.array([size for size, _, _ in object_parts]).reshape(-1, 3),
        T_object_part=np.array([T for _, T, _ in object_parts]).reshape(-1, 4, 4),
        T_container_goal=np.zeros((0, 4, 4)),
        goal_kind=_kinds(0, "settled"),
        goal_clearance=_open(0),
        goal_approach=np.zeros((0, 3)),
        opening=opening,
        max_tilt=float(np.radians(tilt)),
        symmetry_kind=SYMMETRIES.index(kind),
        symmetry_axis=axis,
        T_world_container=T_world_container,
        T_world_object_start=on_table(raw.T_world_start, config) @ T_theirs_object,
        container_instance=0,
        object_instance=0,
    )


def _moved(mesh: Mesh, T: Array) -> Mesh:
    return Mesh(transform(T, mesh.vertices), mesh.faces)


def _named_instance(name: str) -> int:
    """What tells one container or object from another where nobody knows its geometry: the name that it goes by."""
    return int.from_bytes(sha256(name.encode()).digest()[:8], "little") >> 1


def _kinds(count: int, name: str) -> Array:
    return np.full(count, GOAL_KINDS.index(name), np.uint8)


def _open(count: int) -> Array:
    return np.full(count, solids.UNBOUNDED)


def _level(T_world: Array) -> Array:
    """The pose that is turned about the vertical alone, by as much as the x axis (where that is vertical, the y axis) is."""
    x = T_world[:2, 0] if np.hypot(*T_world[:2, 0]) > 1e-6 else np.array([T_world[1, 1], -T_world[0, 1]])
    return pose(rotation_about((0, 0, 1), float(np.arctan2(x[1], x[0]))), T_world[:3, 3])


def _upright_frame(raw: Raw, middle: Array) -> Array:
    """(4, 4) T_theirs_object: our object frame, whose origin is the middle of the mesh and whose z axis is up at the goal."""
    return pose(upright_turn(raw.T_world_final[:3, :3]), middle)


def _is_called(name: str, words: Sequence[str]) -> bool:
    return bool({*name.lower().split("_")} & {*words})


def _named_symmetry(raw: Raw, config: RpdiffConfig, T_theirs_object: Array) -> tuple[str, Array]:
    """The symmetry as asked for, or as the object's class suggests; and the axis of a revolution, z in its file."""
    by_name = "box" if _is_called(raw.classes.child, BOX_NAMES) else "none"
    by_name = "revolution" if _is_called(raw.classes.child, ROUND_NAMES) else by_name
    return by_name if config.symmetry == "auto" else config.symmetry, np.abs(T_theirs_object[2, :3])


def _symmetry(object_: Sequence[Mesh], raw: Raw, config: RpdiffConfig, T_theirs_object: Array) -> tuple[str, Array]:
    """The symmetry as asked for, or that of the solid that fills what is around the object; and the axis of a revolution."""
    if config.symmetry != "auto":
        return _named_symmetry(raw, config, T_theirs_object)
    corners = np.concatenate([mesh.vertices for mesh in object_])
    extent, volume = np.ptp(corners, axis=0), sum(meshes.volume(mesh) for mesh in object_)
    if volume >= FULL * extent.prod():
        return "box", np.abs(T_theirs_object[2, :3])
    for k in range(3):
        a, b = np.delete(extent, k)
        if abs(a - b) <= (1 - FULL) * max(a, b) and FULL <= volume / (np.pi / 4 * a * b * extent[k]) <= 1 / FULL:
            return "revolution", np.abs(T_theirs_object[k, :3])
    return "none", np.array([0.0, 0.0, 1.0])


def _distinct(poses: Sequence[Array] | Array, distance: float, angle: float, scene: MeshScene) -> Array:
    """Poses (G, 4, 4) without those that are, modulo symmetry, the same as an earlier one."""
    kind, found = SYMMETRIES[scene.symmetry_kind], list[Array]()
    for T in poses:
        apart = [symmetric_distance(T, other, kind, scene.symmetry_axis) for other in found]
        if not any(shift < distance and turn < angle for shift, turn in apart):
            found.append(T)
    return np.array(found)


# Meshes and slots ------------------------------------------------------------------------------------------


def _meshes(raw: Raw, config: RpdiffConfig) -> tuple[list[Mesh], list[Mesh]]:
    """The meshes of the containers, and the convex pieces of the object, each in its file's frame."""
    assert config.meshes is not None
    folder = mesh_folder(config.meshes)
    parents = [_read_mesh(folder.path(named), named) for named in raw.mesh_files.parent]
    named = raw.convex_file if raw.convex_file and folder.path(raw.convex_file) else raw.mesh_files.child[0]
    object_ = meshes.convex_pieces(_read_mesh(folder.path(named), named))
    if object_ is None:
        raise Fault("object_not_convex", named)
    return parents, object_


@lru_cache(maxsize=64)
def _read_mesh(path: Path | None, named: str) -> Mesh:
    if path is None:
        raise Fault("mesh_missing", named or "the file names none")
    try:
        return meshes.read_mesh(path)
    except FormatError as error:
        raise Fault("mesh_too_large" if isinstance(error, meshes.TooLargeError) else "mesh_broken", str(error)) from error


def _slots(raw: Raw, config: RpdiffConfig, T_theirs_object: Array, height: float) -> list[Array]:
    """Poses of the object a little above the free places of its container, in that one's frame; none without a slot file.

    Books have a pose of the book for each slot, cans that of the surface and the dimensions of the can that fits.
    """
    assert config.meshes is not None
    name = Path(raw.mesh_files.parent[raw.parent]).stem or raw.names.parent[raw.parent]
    folder = mesh_folder(config.meshes)
    for suffix, reader in zip(SLOT_SUFFIXES, (_pose_slots, _surface_slots)):
        path = folder.path(name + suffix)
        if path is not None:
            try:
                if path.stat().st_size > MAX_SLOT_BYTES:
                    raise ValueError("a slot file of that size")
                return reader(path, T_theirs_object, height)
            except (Fault, FormatError, OSError, ValueError, KeyError, TypeError) as error:
                raise Fault("mesh_broken", f"{path.name}: {error}") from error
    return []


def _pose_slots(path: Path, T_theirs_object: Array, height: float) -> list[Array]:
    rows = np.loadtxt(path, ndmin=2, max_rows=MAX_SLOTS) if path.read_text().strip() else np.zeros((0, 7))
    T = [pose(None, (0, 0, ABOVE)) @ each for each in poses_of(rows)] if len(rows) else []
    return [each @ T_theirs_object for each in T]


def _surface_slots(path: Path, T_theirs_object: Array, height: float) -> list[Array]:
    surfaces = object_arrays.read(path, "avail_top_poses")[:MAX_SLOTS]
    frames = [np.asarray(surface["pose"], float) for surface in surfaces]
    if not all(T.shape == (4, 4) and store.is_rigid(T) for T in frames):
        raise ValueError("a slot without a rigid pose")
    return [T @ pose(None, (0, 0, height / 2 + ABOVE)) for T in frames]
