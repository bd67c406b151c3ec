"""Solid primitives (boxes, cylinders, ellipsoids): made, measured, sampled.

A group of P solids is three arrays, as in `records.Scene`: `kind (P,)` (index into `records.PART_KINDS`), `size (P, 3)`
(full extents along the solid's own axes, m) and `T (P, 4, 4)` (its pose in whatever frame the caller works in). A
cylinder's axis is its own z.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dapdata.errors import UsageError, require
from dapdata.poses import pose, transform
from dapdata.records import PART_KINDS, Mesh

Array = NDArray[Any]
Vector = Array | Sequence[float]

BOX, CYLINDER, ELLIPSOID, MESH = range(4)
CONTAINER, CLUTTER = range(2)
UNBOUNDED = 0.1  # m: free play beyond this is stored as this, so that records stay finite


class Part(NamedTuple):
    """One solid on its way into a scene's arrays."""

    kind: int
    size: tuple[float, float, float]  # m
    T: Array  # (4, 4)
    role: int = CONTAINER


def box(size: Vector, centre: Vector, role: int = CONTAINER, rotation: Array | None = None) -> Part:
    """A box of full extents size (3,) around centre (3,), m."""
    return Part(BOX, _triple(size), pose(rotation, np.asarray(centre, float)), role)


def cylinder(radius: float, height: float, centre: Vector, role: int = CONTAINER, rotation: Array | None = None) -> Part:
    """A cylinder around centre (3,), m; its axis is z before the rotation."""
    return Part(CYLINDER, (2 * radius, 2 * radius, height), pose(rotation, np.asarray(centre, float)), role)


def ellipsoid(size: Vector, centre: Vector, role: int = CONTAINER, rotation: Array | None = None) -> Part:
    """An ellipsoid of three diameters size (3,) around centre (3,), m."""
    return Part(ELLIPSOID, _triple(size), pose(rotation, np.asarray(centre, float)), role)


def open_shelf(width: float, depth: float, pitch: float, shelves: int, board: float, wall: float, has_top: bool) -> list[Part]:
    """A cupboard without a door: floors, two side walls, a back wall and maybe a top; it opens along +x.

    Args:
        width: Outer extent along y, m.
        depth: Outer extent along x, m.
        pitch: From the underside of one floor to that of the next, m; the walls end one pitch above the last floor.
        shelves: Number of floors.
        board: Thickness of floors, back wall and top, m.
        wall: Thickness of the side walls, m.
        has_top: Whether a board lies on the walls.

    Returns:
        Boxes that meet without overlap, the floors first, origin at the centre of the footprint, underside at z = 0.
    """
    height = shelves * pitch
    floors = [box((depth - board, width - 2 * wall, board), (board / 2, 0, k * pitch + board / 2)) for k in range(shelves)]
    back = box((board, width - 2 * wall, height), ((board - depth) / 2, 0, height / 2))
    sides = [box((depth, wall, height), (0, side * (width - wall) / 2, height / 2)) for side in (-1, 1)]
    top = [box((depth, width, board), (0, 0, height + board / 2))] if has_top else []
    return [*floors, back, *sides, *top]


def plate_with_holes(x: Array, y: Array, opening: float, margin: tuple[float, float], bottom: float, top: float) -> list[Part]:
    """A level plate with a grid of square holes, as boxes that meet without overlap: bars along y, and short ones between.

    Args:
        x: (R,) places of the holes along x, rising, m.
        y: (C,) the same along y.
        opening: Side of the holes, m; less than any two are apart.
        margin: Plate beyond the outermost holes along x and along y, m.
        bottom: Height of the underside, m.
        top: Height of the upper face, m.
    """
    across, along = _beside_holes(x, opening, margin[0]), _beside_holes(y, opening, margin[1])
    width, height, z = along[-1][1] - along[0][0], top - bottom, (top + bottom) / 2
    middle = (along[-1][1] + along[0][0]) / 2
    bars = [box((high - low, width, height), ((low + high) / 2, middle, z)) for low, high in across]
    return bars + [box((opening, high - low, height), (at, (low + high) / 2, z)) for at in x for low, high in along]


def _beside_holes(places: Array, opening: float, margin: float) -> list[tuple[float, float]]:
    """(low, high) of what is before, between and after openings around some places along a line, m."""
    edges = [places[0] - opening / 2 - margin, *(at + side * opening / 2 for at in places for side in (-1, 1))]
    return list(zip(edges[::2], [*edges[1::2], places[-1] + opening / 2 + margin]))


def moved(parts: Sequence[Part], T: Array) -> list[Part]:
    """The parts of a group after a motion T (4, 4) of all of it."""
    return [part._replace(T=T @ part.T) for part in parts]


def collect(parts: Sequence[Part]) -> tuple[Array, Array, Array, Array]:
    """kind (P,) u1, size (P, 3) f8, T (P, 4, 4) f8 and role (P,) u1 of at least one part."""
    return (
        np.array([part.kind for part in parts], np.uint8),
        np.array([part.size for part in parts], np.float64),
        np.array([part.T for part in parts], np.float64),
        np.array([part.role for part in parts], np.uint8),
    )


def digest(*arrays: Array) -> int:
    """A 63-bit number that names a geometry: equal for arrays that agree to a micrometre."""
    whole = sha256()
    for array in arrays:
        rounded = np.round(np.asarray(array, np.float64) * 1e6).astype("<i8")
        whole.update(np.array(rounded.shape, "<i8").tobytes() + rounded.tobytes())
    return int.from_bytes(whole.digest()[:8], "little") >> 1


# ---------------------------------------------------------------- measures


def bounds(kind: Array, size: Array, T: Array) -> Array:
    """(P, 2, 3) axis-aligned boxes (low corner, high corner) around the solids, the smallest for the three primitives."""
    R, half = T[:, :3, :3], size / 2
    box_half = np.einsum("pij,pj->pi", np.abs(R), half)
    round_half = np.sqrt(np.einsum("pij,pj->pi", R**2, half**2))
    disc_half = np.sqrt(np.einsum("pij,pj->pi", R[:, :, :2] ** 2, half[:, :2] ** 2)) + np.abs(R[:, :, 2]) * half[:, 2:]
    is_box = (kind == BOX) | (kind == MESH)
    extent = np.where(is_box[:, None], box_half, np.where((kind == CYLINDER)[:, None], disc_half, round_half))
    centre = T[:, :3, 3]
    return np.stack([centre - extent, centre + extent], axis=1)


def centre_of_mass(kind: Array, size: Array, T: Array) -> Array:
    """(3,) centre of mass of solids of one density, m; where they overlap counts twice."""
    _refuse_meshes(kind)
    volume = size.prod(axis=1) * np.array([1.0, np.pi / 4, np.pi / 6])[kind]
    return np.asarray(volume @ T[:, :3, 3] / volume.sum())


def signed_distance(points: Array, kind: Array, size: Array, T: Array) -> Array:
    """(N,) distance (m) of points (N, 3) to the nearest of P solids, negative inside.

    Exact outside. Inside, it is the depth in the solid in which the point lies deepest, not in their union. A cylinder
    must be round (equal diameters).
    """
    _refuse_meshes(kind)
    nearest = np.full(len(points), np.inf)
    for k, full, pose_ in zip(kind, size, T):
        local = (points - pose_[:3, 3]) @ pose_[:3, :3]
        nearest = np.minimum(nearest, _DISTANCES[int(k)](local, full / 2))
    return nearest


def _box_distance(local: Array, half: Array) -> Array:
    beyond = np.abs(local) - half
    return np.asarray(np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0))


def _cylinder_distance(local: Array, half: Array) -> Array:
    beyond = np.stack([np.hypot(local[:, 0], local[:, 1]) - half[0], np.abs(local[:, 2]) - half[2]], axis=1)
    return np.asarray(np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0))


def _ellipsoid_distance(local: Array, half: Array) -> Array:
    """By Newton's method on the Lagrange multiplier t of the nearest surface point, half^2 * y / (t + half^2).

    The function whose root is sought falls and is convex right of its last pole, so that Newton's method started where
    it is positive comes down to the root without overshooting.
    """
    y = np.maximum(np.abs(local), 1e-9)  # exactly on an axis the pole cancels; a nanometre beside it does not
    square = half**2
    t = (half * y - square).max(axis=1)
    for _ in range(60):
        ratio = half * y / (t[:, None] + square)
        value, slope = (ratio**2).sum(axis=1) - 1, -2 * (ratio**2 / (t[:, None] + square)).sum(axis=1)
        t = t - value / slope
        if np.abs(value).max(initial=0.0) < 1e-12:
            break
    surface = square * y / (t[:, None] + square)
    return np.asarray(np.linalg.norm(y - surface, axis=1) * np.where(((y / half) ** 2).sum(axis=1) > 1, 1.0, -1.0))


_DISTANCES: dict[int, Callable[[Array, Array], Array]] = {
    BOX: _box_distance,
    CYLINDER: _cylinder_distance,
    ELLIPSOID: _ellipsoid_distance,
}


def free_play(object_part: Part, kind: Array, size: Array, part_bounds: Array, num_directions: int = 18) -> float:
    """Total way (m) that an upright solid can slide to and fro along its tightest horizontal line.

    Only what stands at the solid's height is in the way. Solids are taken as upright and unturned: discs or axis-aligned
    rectangles in plan. Ways longer than UNBOUNDED count as UNBOUNDED.

    Args:
        object_part: The solid, in the frame of the others.
        kind: (P,) kinds of the others.
        size: (P, 3) their extents, m.
        part_bounds: (P, 2, 3) their `bounds`, m.
        num_directions: Lines that are tried, evenly spread over half a turn from x on.
    """
    low, high = bounds(*(x[:1] for x in collect([object_part])[:3]))[0]
    box_low, box_high = part_bounds.transpose(1, 0, 2)
    reach = np.array([UNBOUNDED, UNBOUNDED, -1e-6])
    near = np.all((box_low < high + reach) & (box_high > low - reach), axis=1)
    if not near.any():
        return UNBOUNDED
    flat_half = np.where((kind == BOX)[:, None], (box_high - box_low)[:, :2] / 2, 0.0)[near]
    rounding = np.where(kind == BOX, 0.0, size[:, 0] / 2)[near]
    if object_part.kind == BOX:
        flat_half = flat_half + (high - low)[:2] / 2
    else:
        rounding = rounding + object_part.size[0] / 2
    angle = np.pi * np.arange(num_directions) / num_directions
    line = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    centre = ((box_low + box_high) / 2)[near, :2] - object_part.T[:2, 3]
    ways = [_way_to_rounded_rectangle(sign * line, centre, flat_half, rounding).min(axis=1) for sign in (1, -1)]
    return float(min(np.minimum(ways[0] + ways[1], UNBOUNDED)))


def _way_to_rounded_rectangle(direction: Array, centre: Array, half: Array, rounding: Array) -> Array:
    """(D, P) way from the origin along directions (D, 2) to P rectangles centre +- half (P, 2), grown by rounding (P,)."""
    grow = np.stack([rounding, np.zeros_like(rounding)], axis=1)
    way = np.minimum(
        _way_to_rectangle(direction, centre, half + grow), _way_to_rectangle(direction, centre, half + grow[:, ::-1])
    )
    for corner in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        to_corner = centre + half * corner
        along = direction @ to_corner.T
        under = rounding**2 - ((to_corner**2).sum(axis=1) - along**2)
        enter, leave = along - np.sqrt(np.maximum(under, 0)), along + np.sqrt(np.maximum(under, 0))
        way = np.minimum(way, np.where((under > 0) & (leave > 0), np.maximum(enter, 0), np.inf))
    return way


def _way_to_rectangle(direction: Array, centre: Array, half: Array) -> Array:
    """(D, P) way from the origin along directions (D, 2) to P rectangles, infinite where they are missed."""
    slope = np.where(np.abs(direction) < 1e-12, 1e-12, direction)[:, None, :]
    sides = np.stack([(centre - half) / slope, (centre + half) / slope])
    enter, leave = sides.min(axis=0).max(axis=-1), sides.max(axis=0).min(axis=-1)
    return np.where((enter < leave) & (leave > 0), np.maximum(enter, 0), np.inf)


# ---------------------------------------------------------------- surfaces


@dataclass(frozen=True)
class Faces:
    """F flat faces that look up: the places on which something could stand."""

    part: Array  # (F,) index of the solid
    T: Array  # (F, 4, 4) pose of the face: origin in its centre, z its normal. Triangle: origin a corner, x and y its edges
    size: Array  # (F, 2) full extents along the face's x and y, m; of a triangle 1
    is_disc: Array  # (F,) bool, whether it is a disc instead of a rectangle
    is_triangle: Array  # (F,) bool, whether it is a triangle of a mesh
    area: Array  # (F,) m2


def upward_faces(kind: Array, size: Array, T: Array, max_slope: float = 0.1) -> Faces:
    """The faces of boxes and the caps of cylinders whose normal is within max_slope (rad) of z; covered or not.

    Parts that are meshes have none here, see meshes.upward_faces.
    """
    found: list[tuple[int, Array, Array, bool]] = []
    for p, (k, full, pose_) in enumerate(zip(kind, size, T)):
        for axis in range(3) if k == BOX else (2,) if k == CYLINDER else ():
            sign = 1.0 if pose_[2, axis] >= 0 else -1.0
            if sign * pose_[2, axis] >= np.cos(max_slope):
                across = [(axis + 1) % 3, (axis + 2) % 3]
                x, normal = pose_[:3, across[0]], sign * pose_[:3, axis]
                frame = np.stack([x, np.cross(normal, x), normal], axis=1)
                centre = pose_[:3, 3] + normal * full[axis] / 2
                found.append((p, pose(frame, centre), full[across], bool(k == CYLINDER)))
    extent = np.array([f[2] for f in found]).reshape(-1, 2)
    is_disc = np.array([f[3] for f in found], bool)
    return Faces(
        part=np.array([f[0] for f in found], np.int64),
        T=np.array([f[1] for f in found]).reshape(-1, 4, 4),
        size=extent,
        is_disc=is_disc,
        is_triangle=np.zeros(len(found), bool),
        area=extent.prod(axis=1) * np.where(is_disc, np.pi / 4, 1.0),
    )


def points_on_faces(faces: Faces, count: int, rng: np.random.Generator) -> Array:
    """(count, 3) points, uniform over the area of all faces together, m; there must be a face."""
    face = rng.choice(len(faces.area), size=count, p=faces.area / faces.area.sum())
    half_way = _flat_points(faces.is_disc[face], count, rng) / 2
    in_square = half_way + 0.5  # a point beyond a triangle's third edge is turned back into it
    in_triangle = np.where(in_square.sum(axis=1, keepdims=True) > 1, 1 - in_square, in_square)
    planar = np.where(faces.is_triangle[face, None], in_triangle, half_way) * faces.size[face]
    flat = np.concatenate([planar, np.zeros((count, 1))], axis=1)
    return np.asarray(np.einsum("nij,nj->ni", faces.T[face, :3, :3], flat) + faces.T[face, :3, 3])


def _flat_points(is_disc: Array, count: int, rng: np.random.Generator) -> Array:
    """(count, 2) points, uniform over the square [-1, 1]^2 or, where is_disc, over the unit disc."""
    square = rng.uniform(-1, 1, (count, 2))
    radius, angle = np.sqrt((square[:, 0] + 1) / 2), np.pi * square[:, 1]
    return np.where(is_disc[:, None], np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1), square)


def surface_points(kind: Array, size: Array, T: Array, count: int, rng: np.random.Generator) -> Array:
    """(count, 3) points, uniform over the whole surface of all solids, also where one covers another, m."""
    area = np.array([_area(int(k), full) for k, full in zip(kind, size)])
    share = rng.multinomial(count, area / area.sum())
    return np.concatenate(
        [transform(pose_, _surface_of(int(k), full, n, rng)) for k, full, pose_, n in zip(kind, size, T, share)]
    )


def _area(kind: int, full: Array) -> float:
    x, y, z = full
    if kind == BOX:
        return float(2 * (x * y + y * z + z * x))
    if kind == CYLINDER:
        return float(np.pi * x * (x / 2 + z))
    _refuse_meshes(np.array([kind]))
    power = 1.6075  # Thomsen's formula, within 1.1 %
    products = (np.array([x * y, y * z, z * x]) / 4) ** power
    return float(4 * np.pi * products.mean() ** (1 / power))


def _surface_of(kind: int, full: Array, count: int, rng: np.random.Generator) -> Array:
    """(count, 3) points over one solid in its own frame."""
    if kind == ELLIPSOID:
        return _ellipsoid_surface(full / 2, count, rng)
    if kind == BOX:
        pair = full[[1, 2, 0]] * full[[2, 0, 1]]
        axis = rng.choice(3, size=count, p=pair / pair.sum())
        points = rng.uniform(-0.5, 0.5, (count, 3)) * full
        points[np.arange(count), axis] = rng.choice([-0.5, 0.5], size=count) * full[axis]
        return points
    on_cap = rng.uniform(size=count) < full[0] / (full[0] + 2 * full[2])
    disc = _flat_points(np.ones(count, bool), count, rng) * full[0] / 2
    angle = rng.uniform(-np.pi, np.pi, count)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1) * full[0] / 2
    z = np.where(on_cap, rng.choice([-0.5, 0.5], size=count), rng.uniform(-0.5, 0.5, count)) * full[2]
    return np.concatenate([np.where(on_cap[:, None], disc, rim), z[:, None]], axis=1)


def _ellipsoid_surface(half: Array, count: int, rng: np.random.Generator) -> Array:
    """Points of the unit sphere, kept in proportion to how much its stretching widens the surface there."""
    points = np.zeros((0, 3))
    while len(points) < count:
        unit = rng.normal(size=(2 * count + 8, 3))
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        widening = np.linalg.norm(unit / half, axis=1) * half.min()
        points = np.concatenate([points, (unit * half)[rng.uniform(size=len(unit)) < widening]])
    return points[:count]


def to_trimesh(kind: Array, size: Array, T: Array, sections: int = 64, meshes: Sequence[Mesh | None] = ()) -> Any:
    """One `trimesh.Trimesh` of all parts, not united; cylinders with `sections` sides, ellipsoids as icospheres.

    `meshes` has the triangles of each part that is a mesh, and None for the others; it may be left out if there are none.
    """
    trimesh = require("trimesh", "sim")
    found = []
    for k, full, pose_, triangles in zip(kind, size, T, meshes or [None] * len(kind)):
        if triangles is not None:
            mesh = trimesh.Trimesh(triangles.vertices, triangles.faces, process=False)
        elif k == BOX:
            mesh = trimesh.creation.box(extents=full)
        elif k == CYLINDER:
            mesh = trimesh.creation.cylinder(radius=full[0] / 2, height=full[2], sections=sections)
        else:
            _refuse_meshes(k)
            mesh = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
            mesh.apply_scale(full)
        found.append(mesh.apply_transform(pose_))
    return trimesh.util.concatenate(found)


class Node(NamedTuple):
    """A frame of a GLB file, with a mesh in it or none."""

    name: str  # unique
    parent: str  # a node before it; "" for the world
    T: Array  # (4, 4) T_parent_node, m
    mesh: str = ""  # several nodes may show the same mesh


Color = tuple[float, float, float, float]  # red, green, blue, opacity; each from 0 to 1
Z_UP = "z_up"  # the node of a GLB file that is the world frame
T_GLTF_WORLD = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])  # glTF's y is up, by its definition


def to_glb(nodes: Sequence[Node], meshes: Mapping[str, tuple[Any, Color]]) -> bytes:
    """A scene as a binary glTF file, in metres; its node `Z_UP` is the world frame, the parent of all others.

    Args:
        nodes: In an order in which parents come first.
        meshes: By name, a `trimesh.Trimesh` and its colour.
    """
    trimesh = require("trimesh", "sim")
    scene = trimesh.Scene()
    scene.graph.update(frame_to=Z_UP, matrix=T_GLTF_WORLD)
    for name, (mesh, color) in meshes.items():
        mode = "BLEND" if color[3] < 1 else "OPAQUE"
        material = trimesh.visual.material.PBRMaterial(
            name=name, baseColorFactor=color, metallicFactor=0.0, roughnessFactor=0.8, alphaMode=mode
        )
        mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        mesh.visual = trimesh.visual.TextureVisuals(material=material)
        scene.geometry[name] = mesh
    for node in nodes:
        scene.graph.update(
            frame_from=node.parent or Z_UP, frame_to=node.name, matrix=node.T, **({"geometry": node.mesh} if node.mesh else {})
        )
    data: bytes = scene.export(file_type="glb")
    return data


def _triple(values: Vector) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _refuse_meshes(kind: Array) -> None:
    """Meshes have no size to work with here."""
    if np.any(kind >= MESH):
        raise UsageError(
            f"part kind: got '{PART_KINDS[int(np.max(kind))]}', expected one of {', '.join(PART_KINDS[:MESH])}; "
            "build the scene from primitives"
        )
