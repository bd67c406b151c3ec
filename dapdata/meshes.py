"""Containers and objects that come as triangles: read, taken apart, looked at, written. The only door to Open3D.

Nothing of a file is believed: counts in headers are compared with its size before anything is allocated, numbers, indices
and areas are checked before a simulator or a ray caster (which crash or hang on some, and accept others silently) sees
them. Materials, textures and whatever else a file refers to is left alone.

A mesh is taken apart into the pieces that share vertices. Closed convex pieces, of which furniture mostly consists, are
solid to the simulator and exact; what is left of a container is a surface.
"""

from __future__ import annotations

import ctypes
import io
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dapdata.errors import DapdataError, FormatError, require
from dapdata.poses import pose, transform
from dapdata.records import Array, Mesh
from dapdata.solids import Faces

SUFFIXES = (".obj", ".ply", ".stl", ".off")
MAX_BYTES = 50_000_000
MAX_FACES = 200_000  # every demo keeps its meshes
MAX_PIECES = 300  # more are no furniture but the crumbs of a scan: such a mesh stays in one piece
MIN_EXTENT, MAX_EXTENT = 0.001, 10.0  # m
MIN_AREA = 1e-12  # m2: a smaller triangle has no normal to speak of
SAME_VOLUME = 1e-3  # share by which a convex piece's hull may be larger than the piece: rounding in text files
NEARLY_CONVEX = 0.1  # share by which the hull of an object's piece may be larger, and still stand for it
SHARP = np.radians(30)  # between faces: a sharper edge is seen as one


class TooLargeError(FormatError):
    """A mesh of more bytes or faces than are kept in a demo."""


# Reading ---------------------------------------------------------------------------------------------------


def read_mesh(path: Path) -> Mesh:
    """The triangles of an obj, ply, stl or off file.

    Raises:
        TooLargeError: too many bytes or faces.
        FormatError: no such file, another format, a header that does not fit, numbers that are not finite,
            faces of vertices that are not there, no area, or a size that cannot be metres.
        MissingExtraError: trimesh is not installed.
    """
    trimesh = require("trimesh", "sim")
    kind = path.suffix.lower()
    if kind not in SUFFIXES:
        raise FormatError(f"{path}: got '{path.suffix}', expected a mesh: {', '.join(SUFFIXES)}")
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise TooLargeError(f"{path}: {size} bytes, expected {MAX_BYTES} at the most; decimate the mesh")
        data = path.read_bytes()
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error.strerror or error}), expected a mesh") from error
    _check_counts(path, kind, data)
    try:
        # From memory, so that nothing that the file names is looked for beside it.
        found = trimesh.load(io.BytesIO(data), file_type=kind[1:], force="mesh", process=False, skip_materials=True)
        vertices, faces = np.asarray(found.vertices, float), np.asarray(found.faces, np.int64)
    except DapdataError:
        raise
    except Exception as error:  # trimesh's readers raise whatever numpy, struct and str raise on broken text
        raise FormatError(f"{path}: is no {kind[1:]} file with triangles ({type(error).__name__}), expected a mesh") from error
    if len(faces) > MAX_FACES or len(vertices) > 3 * MAX_FACES:
        raise TooLargeError(f"{path}: {len(faces)} faces, expected {MAX_FACES} at the most; decimate the mesh")
    problem = fault(Mesh(vertices, faces))
    if problem:
        raise FormatError(f"{path}: {problem}")
    is_heap = len(vertices) >= 3 * len(faces)  # of single triangles, as of an stl file: they get their common corners
    mesh = _welded([Mesh(vertices, faces)]) if is_heap else _tidy(Mesh(vertices, faces))
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    if not MIN_EXTENT <= extent <= MAX_EXTENT:
        raise FormatError(
            f"{path}: {extent:.4g} m long, expected {MIN_EXTENT} to {MAX_EXTENT} m; scale it: the unit is the metre"
        )
    return mesh


def _check_counts(path: Path, kind: str, data: bytes) -> None:
    """Raises a FormatError if a header promises more vertices or faces than the file has bytes for."""
    header = data[:4096]
    if kind == ".stl":
        text = header.lstrip()[:5].lower() == b"solid" and b"facet" in header
        count, needed = (0, 0) if text else (int.from_bytes(data[80:84], "little"), 50)
        if not text and len(data) < 84:
            raise FormatError(f"{path}: {len(data)} bytes, expected an stl file of at least 84")
        counts = [count]
    elif kind == ".ply":
        lines = [line.split() for line in header.split(b"end_header")[0].splitlines()]
        counts, needed = [_number(line[2]) for line in lines if line[:1] == [b"element"] and len(line) == 3], 1
    elif kind == ".off":
        words = [word for line in header.splitlines() for word in line.split(b"#")[0].split()]
        counts, needed = [_number(word) for word in words[1:3]], 1
    else:
        return
    if sum(counts) * needed > len(data):
        raise FormatError(f"{path}: its header promises {max(counts)} elements in {len(data)} bytes; the file is broken")


def _number(word: bytes) -> int:
    return int(word) if word.isdigit() and len(word) < 19 else 1 << 62


def fault(mesh: Mesh) -> str:
    """What keeps a mesh from being used, as "found, expected"; nothing if it can be."""
    vertices, faces = mesh
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        return "no triangles, expected a mesh"
    if len(faces) > MAX_FACES or len(vertices) > 3 * MAX_FACES:
        return f"{len(faces)} faces, expected {MAX_FACES} at the most; decimate the mesh"
    if faces.min() < 0 or faces.max() >= len(vertices):
        return f"a face of vertex {faces.max()}, expected vertices 0 to {len(vertices) - 1}"
    used = vertices[np.unique(faces)]
    if not (np.isfinite(used).all() and np.abs(used).max() < 1e6):
        return "vertices that are not finite, expected metres"
    if _areas(mesh).max() < MIN_AREA:
        return "faces without area, expected a surface"
    return ""


def _areas(mesh: Mesh) -> Array:
    """(F,) m2."""
    return np.asarray(np.linalg.norm(_doubled_normals(mesh), axis=1) / 2)


def _doubled_normals(mesh: Mesh) -> Array:
    """(F, 3) normals, as long as twice the area of each face."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.asarray(np.cross(b - a, c - a))


def normals(mesh: Mesh) -> Array:
    """(F, 3) unit normals; of faces without area, zero."""
    doubled = _doubled_normals(mesh)
    return np.asarray(doubled / np.maximum(np.linalg.norm(doubled, axis=1, keepdims=True), 1e-30))


def _tidy(mesh: Mesh) -> Mesh:
    """Without vertices that no face has, and without faces that have a corner twice."""
    ordered = np.sort(mesh.faces, axis=1)
    return _only(mesh, (ordered[:, 1:] != ordered[:, :-1]).all(axis=1))


def _welded(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of all, whose vertices at the same place are one."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts)])
    vertices, same = np.unique(np.concatenate([mesh.vertices for mesh in meshes]), axis=0, return_inverse=True)
    return _tidy(Mesh(vertices, same.reshape(-1)[faces]))


def with_area(mesh: Mesh) -> Mesh:
    """Without the faces that have no area: to close a mesh they are needed, but nothing can touch them."""
    return _only(mesh, _areas(mesh) >= MIN_AREA)


def _only(mesh: Mesh, keep: Array) -> Mesh:
    """Some faces (F,) bool, and the vertices that they have."""
    used, faces = np.unique(mesh.faces[keep], return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3))


def to_obj(meshes: Sequence[Mesh]) -> str:
    """The text of an obj file, an object in it for each mesh; numbers that read back are the same."""
    lines, start = [], 1
    for number, mesh in enumerate(meshes):
        lines.append(f"o part_{number}")
        lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.vertices.tolist()]
        lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + start).tolist()]
        start += len(mesh.vertices)
    return "\n".join([*lines, ""])


# Pieces ----------------------------------------------------------------------------------------------------


def volume(mesh: Mesh) -> float:
    """m3 inside a closed mesh; negative if its faces look inwards."""
    return float(_cones(mesh)[0].sum())


def centre_of_mass(mesh: Mesh) -> Array:
    """(3,) of a closed mesh of one density, m."""
    volumes, centres = _cones(mesh)
    return np.asarray(volumes @ centres / volumes.sum())


def _cones(mesh: Mesh) -> tuple[Array, Array]:
    """(F,) volumes, m3, and (F, 3) centres, m, of the tetrahedra from the first vertex to each face."""
    tip = mesh.vertices[0]
    corners = mesh.vertices[mesh.faces] - tip
    volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    return volumes, tip + corners.sum(axis=1) / 4


def is_closed(mesh: Mesh) -> bool:
    """Whether each edge belongs to two faces that run along it in opposite directions."""
    edges = mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    number = len(mesh.vertices)
    there, back = edges @ [number, 1], edges @ [1, number]
    return len(np.unique(there)) == len(there) and bool(np.array_equal(np.sort(there), np.sort(back)))


def is_convex(mesh: Mesh, slack: float = SAME_VOLUME) -> bool:
    """Whether a mesh is closed and its convex hull is no larger than it, but for a share of `slack`."""
    inside = abs(volume(mesh)) if is_closed(mesh) else 0.0
    return inside > 1e-12 and volume(hull(mesh.vertices)) <= (1 + slack) * inside


def hull(points: Array) -> Mesh:
    """The convex hull of (N, 3) points that are not all in a plane, its faces looking outwards."""
    from scipy.spatial import ConvexHull

    found = ConvexHull(points)
    inside, faces = points[found.vertices].mean(axis=0), found.simplices
    inwards = np.einsum("ij,ij->i", _doubled_normals(Mesh(points, faces)), points[faces[:, 0]] - inside) < 0
    faces = np.where(inwards[:, None], faces[:, ::-1], faces)
    return _only(Mesh(points, faces), np.ones(len(faces), bool))


def pieces(mesh: Mesh) -> list[Mesh]:
    """The pieces that share no vertices, closed ones with their faces looking outwards.

    Closed ones come first, in the order of the file. Of the others, vertices at the same place are taken for one: files that
    keep normals, colours or single triangles have them several times. Closed pieces may well touch, and stay apart.
    """
    found = _split(mesh)
    closed = [piece for piece in found if is_closed(piece)]
    others = [piece for piece in found if not is_closed(piece)]
    return [_outward(piece) for piece in (*closed, *(_split(_welded(others)) if others else []))]


def _split(mesh: Mesh) -> list[Mesh]:
    """The pieces that share no vertices, in the order of the file; the mesh itself if there are too many."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces, number = mesh.faces, len(mesh.vertices)
    ends = faces[:, [0, 1]], faces[:, [1, 2]]
    links = np.concatenate(ends)
    count, label = connected_components(coo_matrix((np.ones(len(links)), links.T), (number, number)), directed=False)
    of_face = label[faces[:, 0]]
    return [mesh] if count > MAX_PIECES else [_only(mesh, of_face == piece) for piece in dict.fromkeys(of_face.tolist())]


def _outward(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.faces[:, ::-1]) if is_closed(mesh) and volume(mesh) < 0 else mesh


def convex_pieces(mesh: Mesh) -> list[Mesh] | None:
    """The pieces of an object as convex solids: its own, or the hulls of those that are nearly convex; else None."""
    found = pieces(mesh)
    if not all(is_convex(piece, NEARLY_CONVEX) for piece in found):
        return None
    return [piece if is_convex(piece) else hull(piece.vertices) for piece in found]


def bounds(mesh: Mesh) -> Array:
    """(2, 3) low and high corner of a mesh, m."""
    return np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])


def long_axis(mesh: Mesh, ratio: float = 3.0) -> Array | None:
    """(3,) unit, along a piece that is so many times as long as it is thick, as a peg or a rod; None for others."""
    middle = mesh.vertices - mesh.vertices.mean(axis=0)
    axes = np.linalg.svd(middle, full_matrices=False)[2]
    length, thickness, _ = np.ptp(middle @ axes.T, axis=0)
    return np.asarray(axes[0]) if length >= ratio * thickness else None


def scaled(mesh: Mesh, scale: float) -> Mesh:
    """The mesh, larger about its origin."""
    return Mesh(mesh.vertices * scale, mesh.faces)


def centred(mesh: Mesh, by_mass: bool = False) -> tuple[Array, Array, Mesh]:
    """A mesh as a part: size (3,) and pose (4, 4) as of records.Scene, and its triangles in the part's own frame.

    Args:
        mesh: In the frame of the container or object, m.
        by_mass: Whether the part's origin is the centre of mass, as of what falls; else the centre of the bounding box.
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    origin = centre_of_mass(mesh) if by_mass else (low + high) / 2
    local = np.asarray(mesh.vertices - origin, np.float32).astype(float)  # as it is stored
    size = 2 * np.abs(local).max(axis=0)
    return np.maximum(size, 1e-6), pose(None, origin), Mesh(local, mesh.faces)


def shrunk(mesh: Mesh, depth: float) -> Mesh:
    """A convex mesh with its faces moved inwards by depth (m), or by 9/10 of what its thickness allows."""
    from scipy.spatial import HalfspaceIntersection

    outside, middle = normals(mesh), centre_of_mass(mesh)
    reach = np.einsum("ij,ij->i", outside, mesh.vertices[mesh.faces[:, 0]])
    room = float((reach - outside @ middle).min())
    halves = np.column_stack([outside, min(depth, 0.9 * room) - reach])  # n . x + d <= 0
    planes = np.unique(np.round(halves[_areas(mesh) >= MIN_AREA], 9), axis=0)
    return hull(HalfspaceIntersection(planes, middle).intersections)


def upward_faces(meshes: Sequence[Mesh | None], T: Array, max_slope: float = 0.1) -> Faces:
    """As solids.upward_faces, of the parts that are meshes.

    Args:
        meshes: P, None for parts that are none.
        T: (P, 4, 4) poses of the parts.
        max_slope: Largest angle from level, rad.
    """
    part, frames, area = [], [], []
    for p, mesh in enumerate(meshes):
        if mesh is None:
            continue
        placed = Mesh(transform(T[p], mesh.vertices), mesh.faces)
        doubled = _doubled_normals(placed)
        length = np.linalg.norm(doubled, axis=1)
        up = np.flatnonzero(doubled[:, 2] >= np.cos(max_slope) * np.maximum(length, 2 * MIN_AREA))
        a, b, c = (placed.vertices[placed.faces[up, k]] for k in range(3))
        # The edges of a triangle as the x and y axes of its frame: with a size of 1, a half square fills it.
        corners = np.stack([b - a, c - a, doubled[up] / length[up, None], a], axis=2)
        frames.append(np.concatenate([corners, np.broadcast_to([[[0.0, 0, 0, 1]]], (len(up), 1, 4))], axis=1))
        part.append(np.full(len(up), p))
        area.append(length[up] / 2)
    count = sum(map(len, area))
    return Faces(
        part=np.concatenate([np.zeros(0, np.int64), *part]),
        T=np.concatenate([np.zeros((0, 4, 4)), *frames]),
        size=np.ones((count, 2)),
        is_disc=np.zeros(count, bool),
        area=np.concatenate([np.zeros(0), *area]),
        is_triangle=np.ones(count, bool),
    )


# Looks -----------------------------------------------------------------------------------------------------


def smooth_groups(mesh: Mesh) -> Array:
    """(F,) number of the smooth surface that each face belongs to: neighbours with no sharp edge between them."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    left, right, angle = _neighbours(mesh)
    smooth = angle < SHARP
    links = coo_matrix((np.ones(smooth.sum()), (left[smooth], right[smooth])), (len(mesh.faces), len(mesh.faces)))
    return np.asarray(connected_components(links, directed=False)[1])


def sharp_edges(mesh: Mesh) -> Array:
    """(E, 2, 3) ends of the edges at which a mesh is not smooth, m."""
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    group = np.repeat(smooth_groups(mesh), 3)
    unique, same, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    same = same.reshape(-1)
    low, high = np.full(len(unique), len(group)), np.full(len(unique), -1)
    np.minimum.at(low, same, group)
    np.maximum.at(high, same, group)
    return np.asarray(mesh.vertices[unique[(low != high) | (count == 1)]])


def _neighbours(mesh: Mesh) -> tuple[Array, Array, Array]:
    """Pairs of faces (left, right) that share an edge with nobody else, and the angle between their normals, rad."""
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    ordered, face = edges[order], order // 3
    start = np.flatnonzero(np.r_[True, (ordered[1:] != ordered[:-1]).any(axis=1)])
    pairs = start[np.diff(np.r_[start, len(ordered)]) == 2]
    left, right = face[pairs], face[pairs + 1]
    unit = normals(mesh)
    return left, right, np.arccos(np.clip(np.einsum("ij,ij->i", unit[left], unit[right]), -1, 1))


Hits = tuple[Array, Array, Array]


def first_hits(meshes: Sequence[Mesh], origins: Array, directions: Array) -> Hits:
    """Where rays first meet some meshes.

    Args:
        meshes: In one frame, m.
        origins: (..., 3) m; or one origin (3,) for all.
        directions: (..., 3) of any length but zero.

    Returns:
        (...) distance along the ray in lengths of its direction, inf for a miss; (...) index of the mesh, -1 for a miss;
        (...) row of its faces.

    Raises:
        MissingExtraError: Open3D is not installed.
    """
    o3d = _open3d()
    rays = np.concatenate([np.broadcast_to(origins, directions.shape), directions], axis=-1).astype(np.float32)
    found = _scene(meshes).cast_rays(o3d.core.Tensor(rays), nthreads=1)
    distance, mesh_index, face = (found[name].numpy() for name in ("t_hit", "geometry_ids", "primitive_ids"))
    missed = ~np.isfinite(distance)
    return distance, np.where(missed, -1, mesh_index.astype(np.int64)), np.where(missed, 0, face.astype(np.int64))


def distances(meshes: Sequence[Mesh], points: Array) -> Array:
    """(N,) m, from points (N, 3) to the surface of some meshes."""
    o3d = _open3d()
    found = _scene(meshes).compute_distance(o3d.core.Tensor(points.astype(np.float32)), nthreads=1)
    return np.asarray(found.numpy(), float)


def _scene(meshes: Sequence[Mesh]) -> Any:
    o3d = _open3d()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    for mesh in meshes:
        scene.add_triangles(o3d.core.Tensor(mesh.vertices.astype(np.float32)), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    return scene


def cast(
    meshes: Sequence[Mesh | None], T_camera_part: Array, K: Array, width: int, height: int, near: float, far: float
) -> tuple[Array, Array, Array]:
    """What a perfect depth camera sees of the parts that are meshes; see observe.raycast.cast.

    Returns:
        (H, W) f4 depth, m, 0 where nothing is seen; (H, W) i4 row of the part, -1 where nothing is; (H, W, 3) f4 unit
        normals toward the camera.
    """
    rows = [p for p, mesh in enumerate(meshes) if mesh is not None]
    seen = [Mesh(transform(T_camera_part[p], m.vertices), m.faces) for p in rows if (m := meshes[p]) is not None]
    x, y = (np.arange(width) + 0.5 - K[0, 2]) / K[0, 0], (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1]
    rays = np.stack([*np.meshgrid(x, y), np.ones((height, width))], axis=-1)
    depth, which, face = first_hits(seen, near * rays, rays)
    depth = depth + near
    missed = ~(depth <= far)
    starts = np.cumsum([0, *(len(mesh.faces) for mesh in seen)])
    normal = np.concatenate([normals(mesh) for mesh in seen])[np.where(missed, 0, starts[which] + face)]
    normal *= np.where(np.einsum("hwk,hwk->hw", normal, rays) > 0, -1, 1)[..., None]
    part = np.where(missed, -1, np.array(rows)[which])
    return (
        np.where(missed, 0, depth).astype(np.float32),
        part.astype(np.int32),
        np.where(missed[..., None], 0, normal).astype(np.float32),
    )


@cache
def _open3d() -> Any:
    """Open3D; its wheel needs a libusb that bare machines lack, and a package brings."""
    try:
        library: Callable[[], Path | None] = require("libusb_package", "sim").get_library_path
        ctypes.CDLL(str(library()), mode=ctypes.RTLD_GLOBAL)
    except (DapdataError, OSError):
        pass  # the system's own will do, or Open3D says what it misses
    return require("open3d", "sim")
