"""Pictures of point clouds and solids in plain numpy (and of meshes, whose rays Open3D casts): no GPU, no window.

Points become small discs that lie in their tangent plane, solids are met by one ray a pixel, and both
share one depth buffer. Everything is drawn at twice the wanted size and averaged down; a shade by depth
differences ("eye-dome lighting") makes shapes readable where colours carry data.

    camera = frame(points, direction=(1, -0.3, 0.5), width=640, height=480)
    canvas = blank(camera)
    draw_cloud(canvas, points, colors, normals)
    draw_solids(canvas, kind, size, T_world_part, colors)
    pixels = image(canvas)  # (480, 640, 3) uint8

Matplotlib's own 3-D scatter was tried first: it sorts whole artists instead of pixels, so clouds and
solids hide each other wrongly, and 30 000 points take seconds.

Source: C. Boucheny, "Interactive scientific visualization of large datasets" (2009), for eye-dome lighting.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dapdata import meshes
from dapdata.records import Mesh

Array = NDArray[Any]

OVERSAMPLE = 2  # pixels drawn per pixel shown, each way
FIELD_OF_VIEW = np.radians(20)  # of the longer side: long enough a lens that boxes look square
MARGIN = 1.04  # free border around what `frame` must show
POINT_RADIUS = 0.0072  # m: a little less than the pitch of the fused clouds, so that surfaces close
DEPTH_SHADE = 25.0  # strength of the shade by depth differences, per relative depth step
LIGHT = np.array([-0.45, -0.65, -0.61])  # camera frame, unit, toward the light: over the viewer's left shoulder
BACKGROUND = (1.0, 1.0, 1.0)
FACES = 1 << 20  # more than a part has


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: OpenCV axes (x right, y down, z ahead), principal point in the middle."""

    T_world_camera: Array  # (4, 4), m
    focal: float  # px
    width: int  # px
    height: int  # px


@dataclass
class Canvas:
    """A picture in the making: colour and depth of each drawn pixel."""

    camera: Camera  # at the drawn (oversampled) size
    color: Array  # (H, W, 3) in [0, 1]
    depth: Array  # (H, W) along the optical axis, m; inf where nothing is


def look_at(eye: ArrayLike, target: ArrayLike) -> Array:
    """(4, 4) T_world_camera of a camera at `eye` that looks at `target` with world z up; not straight down."""
    eye = np.asarray(eye, float)
    ahead = np.asarray(target, float) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    T[:3, 3] = eye
    return T


def frame(points: Array, direction: ArrayLike, width: int, height: int) -> Camera:
    """The camera on a given side of some points, as near as it can be with all of them in the picture.

    Args:
        points: (N, 3) world, m; N >= 1.
        direction: (3,) world, from the points to the camera; any length.
        width: px.
        height: px.
    """
    target = (points.min(axis=0) + points.max(axis=0)) / 2
    toward = np.asarray(direction, float)
    toward = toward / np.linalg.norm(toward)
    R = look_at(target + toward, target)[:3, :3]
    focal = max(width, height) / (2 * np.tan(FIELD_OF_VIEW / 2))
    slope = np.array([width, height]) / (2 * focal * MARGIN)
    distance = 0.1
    for _ in range(4):  # centre what is seen, then come as near as it allows; settles in a few rounds
        local = (points - target) @ R
        distance = float((np.abs(local[:, :2]) / slope - local[:, 2:]).max())
        seen = local[:, :2] / (local[:, 2:] + distance)
        target = target + R[:, :2] @ ((seen.min(axis=0) + seen.max(axis=0)) / 2 * distance)
    return Camera(look_at(target + toward * distance, target), focal, width, height)


def blank(camera: Camera) -> Canvas:
    """An empty canvas for a camera of the size that `image` will have."""
    big = replace(camera, focal=camera.focal * OVERSAMPLE, width=camera.width * OVERSAMPLE, height=camera.height * OVERSAMPLE)
    shape = big.height, big.width
    return Canvas(big, np.tile(np.array(BACKGROUND, np.float32), (*shape, 1)), np.full(shape, np.inf, np.float32))


def draw_cloud(
    canvas: Canvas,
    points: Array,
    colors: ArrayLike,
    normals: Array | None = None,
    radius: float = POINT_RADIUS,
    light: float = 0.35,
) -> None:
    """Adds a point cloud to a canvas.

    Args:
        canvas: Changed in place.
        points: (N, 3) world, m.
        colors: (N, 3) in [0, 1], or (3,) for all.
        normals: (N, 3) unit, world; None: every disc faces the camera and is not shaded.
        radius: Of a disc, m; larger: fewer holes, blurrier edges.
        light: Share of the brightness that depends on the normal; 0 keeps colours as given.
    """
    paint(canvas, splat(canvas.camera, points, normals, radius), lit(colors, normals, canvas.camera, light))


def lit(colors: ArrayLike, normals: Array | None, camera: Camera, light: float = 0.35) -> Array:
    """(N, 3) colours of points as the light falls on them; unchanged without normals. `light` as in `draw_cloud`."""
    colors = np.asarray(colors, np.float32)
    if normals is None:
        return colors
    facing = np.clip(normals @ to_light(camera), -0.3, 1)
    return np.asarray(colors * (1 - light * (1 - facing))[:, None], np.float32)


def to_light(camera: Camera) -> Array:
    """(3,) unit vector toward the light, world; it goes with the camera, so that no view is in the dark."""
    return np.asarray(camera.T_world_camera[:3, :3] @ LIGHT)


def paint(canvas: Canvas, seen: tuple[Array, Array], colors: Array) -> None:
    """Adds what `splat` found, in (N, 3) or (3,) colours; one splat serves many colourings of a cloud."""
    index, depth = seen
    near = depth < canvas.depth
    canvas.color[near] = colors if colors.ndim == 1 else colors[index[near]]
    canvas.depth[near] = depth[near]


def splat(camera: Camera, points: Array, normals: Array | None, radius: float) -> tuple[Array, Array]:
    """Which point each pixel sees, (H, W) int, -1 for none, and at what depth, (H, W) m, inf for none."""
    T = camera.T_world_camera
    centre = ((points - T[:3, 3]) @ T[:3, :3]).astype(np.float32)
    ahead = np.flatnonzero(centre[:, 2] > 0.02)
    centre = centre[ahead]
    normal = -centre if normals is None else (normals[ahead] @ T[:3, :3]).astype(np.float32)
    none = np.iinfo(np.uint64).max
    key = np.full(camera.height * camera.width, none, np.uint64)
    name = ahead.astype(np.uint64)
    x, y, z = centre.T
    across, down, along = normal.T
    u = np.floor(x / z * camera.focal + camera.width / 2).astype(np.int32)
    v = np.floor(y / z * camera.focal + camera.height / 2).astype(np.int32)
    level = (normal * centre).sum(axis=1)
    reach = int(np.ceil(radius * camera.focal / z.min())) if len(centre) else 0
    for du, dv in [(i, j) for i in range(-reach, reach + 1) for j in range(-reach, reach + 1) if np.hypot(i, j) < reach + 1]:
        pu, pv = u + du, v + dv
        ray_x = (pu.astype(np.float32) + np.float32(0.5 - camera.width / 2)) / np.float32(camera.focal)
        ray_y = (pv.astype(np.float32) + np.float32(0.5 - camera.height / 2)) / np.float32(camera.focal)
        slope = across * ray_x + down * ray_y + along
        at = level / np.where(np.abs(slope) < 1e-6, np.float32(1e-6), slope)
        near = (ray_x * at - x) ** 2 + (ray_y * at - y) ** 2 + (at - z) ** 2 < radius**2
        if abs(du) + abs(dv) <= 1:  # a disc seen edge-on still fills a pixel or two
            at, near = np.where(near, at, z), np.ones_like(near)
        hit = np.flatnonzero(near & (pu >= 0) & (pu < camera.width) & (pv >= 0) & (pv < camera.height) & (at > 0))
        depth_bits = at[hit].astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)
        np.minimum.at(key, pv[hit] * camera.width + pu[hit], depth_bits | name[hit])
    nearest = key.reshape(camera.height, camera.width)
    empty = nearest == none
    depth = np.where(empty, np.inf, (nearest >> np.uint64(32)).astype(np.uint32).view(np.float32)).astype(np.float32)
    return np.where(empty, -1, (nearest & np.uint64(0xFFFFFFFF)).astype(np.int64)), depth


def draw_ground(canvas: Canvas, center: ArrayLike, radius: float, pitch: float = 0.1) -> None:
    """Adds the table (z = 0) as a pale disc with a square grid of `pitch` metres that fades outwards."""
    camera, T = canvas.camera, canvas.camera.T_world_camera
    origin, ray = T[:3, 3], rays(camera, 0, camera.width, 0, camera.height) @ T[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        z = -origin[2] / ray[..., 2]
        at = origin[:2] + z[..., None] * ray[..., :2]
        away = at - np.asarray(center)[:2]
        fade = np.clip(1 - (away[..., 0] ** 2 + away[..., 1] ** 2) / radius**2, 0, 1)
        off = np.abs(at / pitch - np.round(at / pitch)) * pitch
        line = np.minimum(off[..., 0], off[..., 1]) < 0.75 * z / camera.focal
    show = (z > 0) & (z < canvas.depth) & (fade > 0)
    ink = (np.where(line, 0.16, 0.035) * fade)[show]
    canvas.color[show] *= (1 - ink)[:, None].astype(np.float32)


def rays(camera: Camera, left: int, right: int, top: int, bottom: int) -> Array:
    """(rows, columns, 3) directions through pixel centres, camera frame, with z = 1."""
    x = (np.arange(left, right) + 0.5 - camera.width / 2) / camera.focal
    y = (np.arange(top, bottom) + 0.5 - camera.height / 2) / camera.focal
    return np.stack([*np.meshgrid(x, y), np.ones((bottom - top, right - left))], axis=-1)


def draw_solids(
    canvas: Canvas,
    kind: Array,
    size: Array,
    T_world_part: Array,
    colors: ArrayLike,
    opacity: float = 1.0,
    hidden: float = 0.0,
    edge: float = 0.55,
    triangles: Sequence[Mesh | None] = (),
) -> None:
    """Adds boxes, cylinders, ellipsoids and meshes to a canvas.

    The solids of one call hide each other; against what is on the canvas already they are blended.

    Args:
        canvas: Changed in place.
        kind: (P,) index into records.PART_KINDS.
        size: (P, 3) full extents, m.
        T_world_part: (P, 4, 4).
        colors: (P, 3) in [0, 1], or (3,) for all.
        opacity: Of faces in front of what is there; at 1 they hide it.
        hidden: Opacity of faces behind what is there: above 0 they shine through.
        edge: Opacity, on top of that, of the lines where faces meet and where a solid ends.
        triangles: P, those of the parts that are meshes; may be left out where there are none.
    """
    colors = np.broadcast_to(np.asarray(colors, float), (len(kind), 3))
    depth = np.full_like(canvas.depth, np.inf)
    face = np.full(canvas.depth.shape, -1)
    color = np.zeros_like(canvas.color)
    light = to_light(canvas.camera)
    for part in range(len(kind)):
        mesh = triangles[part] if len(triangles) else None
        hit = cast(canvas.camera, int(kind[part]), np.asarray(size[part], float), T_world_part[part], mesh)
        if hit is None:
            continue
        window, z, side, normal = hit
        near = z < depth[window]
        depth[window][near] = z[near]
        face[window][near] = part * FACES + side[near]
        bright = 0.74 + 0.30 * (normal[near] @ (T_world_part[part, :3, :3].T @ light))
        color[window][near] = np.clip(colors[part] * bright[:, None], 0, 1)
    _blend(canvas, color, depth, _outline(face), opacity, hidden, edge)


def _outline(face: Array) -> Array:
    """(H, W) bool: pixels of a solid next to a pixel of another face, solid or of none."""
    line = np.zeros(face.shape, bool)
    across, down = face[:, 1:] != face[:, :-1], face[1:] != face[:-1]
    line[:, 1:] |= across
    line[:, :-1] |= across
    line[1:] |= down
    line[:-1] |= down
    return line & (face >= 0)


def _blend(canvas: Canvas, color: Array, depth: Array, line: Array, opacity: float, hidden: float, edge: float) -> None:
    """Lays a layer with its own depth over (and, shining through, under) what is on the canvas."""
    there = np.isfinite(depth)
    front = there & (depth <= canvas.depth)
    alpha = np.where(front, opacity, hidden) * there
    color = np.where(line[..., None], color * (1 - edge), color)
    alpha = np.where(line & (alpha > 0), np.minimum(1, alpha + edge * np.where(front, 1, 0.5)), alpha)[..., None]
    canvas.color[:] = canvas.color * (1 - alpha) + color * alpha
    solid = front & (opacity >= 0.5)
    canvas.depth[solid] = depth[solid]


def cast(
    camera: Camera, kind: int, size: Array, T_world_part: Array, mesh: Mesh | None = None
) -> tuple[Any, Array, Array, Array] | None:
    """Where the camera's rays first meet one part.

    Returns:
        The window of the picture that can see it (a pair of slices), and in that window depth (m, inf for a
        miss), the number of the face and the normal in the part's frame; None if it is out of sight.
    """
    T = camera.T_world_camera
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * size / 2
    seen = (corners @ T_world_part[:3, :3].T + T_world_part[:3, 3] - T[:3, 3]) @ T[:3, :3]
    if seen[:, 2].min() < 0.02:
        return None
    uv = seen[:, :2] / seen[:, 2:] * camera.focal + [camera.width / 2, camera.height / 2]
    left, top = np.clip(np.floor(uv.min(axis=0)).astype(int), 0, [camera.width, camera.height])
    right, bottom = np.clip(np.ceil(uv.max(axis=0)).astype(int), 0, [camera.width, camera.height])
    if left >= right or top >= bottom:
        return None
    R = T[:3, :3].T @ T_world_part[:3, :3]  # part to camera; row vectors times it go the other way
    origin = (T[:3, 3] - T_world_part[:3, 3]) @ T_world_part[:3, :3]
    ray = rays(camera, left, right, top, bottom) @ R
    with np.errstate(divide="ignore", invalid="ignore"):
        if mesh is None:
            z, side, normal = (_meet_box, _meet_cylinder, _meet_ellipsoid)[kind](origin, ray, size / 2)
        else:
            z, side, normal = _meet_mesh(origin, ray, mesh)
    return (slice(top, bottom), slice(left, right)), z, side, normal


def _slabs(origin: Array, ray: Array, half: Array) -> tuple[Array, Array]:
    """Entry and exit along the ray for each axis' slab, both (..., axes)."""
    ray = np.where(np.abs(ray) < 1e-12, 1e-12, ray)
    a, b = (-half - origin) / ray, (half - origin) / ray
    return np.minimum(a, b), np.maximum(a, b)


def _meet_box(origin: Array, ray: Array, half: Array) -> tuple[Array, Array, Array]:
    enter, leave = _slabs(origin, ray, half)
    z, out = enter[..., 0], leave[..., 0]
    axis = np.zeros(z.shape, int)
    for k in (1, 2):  # several times faster than reducing over an axis of three
        axis = np.where(enter[..., k] > z, k, axis)
        z, out = np.maximum(z, enter[..., k]), np.minimum(out, leave[..., k])
    z = np.where((z < out) & (z > 0), z, np.inf)
    positive = np.choose(axis, [ray[..., k] < 0 for k in range(3)])
    side = axis * 2 + positive
    return z, side, np.repeat(np.eye(3), 2, axis=0)[side] * np.where(positive, 1, -1)[..., None]


def _meet_cylinder(origin: Array, ray: Array, half: Array) -> tuple[Array, Array, Array]:
    o, d = origin[:2] / half[:2], ray[..., :2] / half[:2]
    a, b, c = (d * d).sum(-1), (d * o).sum(-1), (o * o).sum() - 1
    root = np.sqrt(b * b - a * c)
    enter, leave = _slabs(origin[2:], ray[..., 2:], half[2:])
    side_in, side_out = (-b - root) / a, (-b + root) / a
    z = np.maximum(side_in, enter[..., 0])
    z = np.where((z < np.minimum(side_out, leave[..., 0])) & (z > 0), z, np.inf)
    cap = enter[..., 0] > side_in
    at = (origin[:2] + np.where(np.isfinite(z), z, 0)[..., None] * ray[..., :2]) / half[:2]
    round_normal = np.concatenate([at, np.zeros_like(at[..., :1])], axis=-1)
    normal = np.where(cap[..., None], -np.sign(ray[..., 2:]) * np.array([0, 0, 1.0]), round_normal)
    return z, cap.astype(int), normal


def _meet_ellipsoid(origin: Array, ray: Array, half: Array) -> tuple[Array, Array, Array]:
    o, d = origin / half, ray / half
    a, b, c = (d * d).sum(-1), (d * o).sum(-1), (o * o).sum() - 1
    z = (-b - np.sqrt(b * b - a * c)) / a
    z = np.where(z > 0, z, np.inf)
    normal = (o + np.where(np.isfinite(z), z, 0)[..., None] * d) / half
    return z, np.zeros(z.shape, int), normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _meet_mesh(origin: Array, ray: Array, mesh: Mesh) -> tuple[Array, Array, Array]:
    z, _, face = meshes.first_hits([mesh], origin, ray)
    normal = meshes.normals(mesh)[face]
    away = np.einsum("hwk,hwk->hw", normal, ray) > 0
    return z, meshes.smooth_groups(mesh)[face], np.where(away[..., None], -normal, normal)


def image(canvas: Canvas) -> Array:
    """(height, width, 3) uint8: the finished picture, shaded by depth and averaged down."""
    shaded = canvas.color * _depth_shade(canvas.depth)[..., None]
    steps = range(OVERSAMPLE)
    small = sum(shaded[i::OVERSAMPLE, j::OVERSAMPLE] for i in steps for j in steps) / OVERSAMPLE**2
    return np.asarray(np.round(np.clip(small, 0, 1) * 255), np.uint8)


def _depth_shade(depth: Array) -> Array:
    """(H, W) in (0, 1]: darker the further a pixel lies behind its neighbours (at two distances)."""
    finite = np.isfinite(depth)
    log = np.log(np.where(finite, depth, 1e3)).astype(np.float32)
    behind = np.zeros_like(log)
    for step in (1, 3):
        for axis in (0, 1):
            for sign in (step, -step):
                behind += np.clip(log - np.roll(log, sign, axis), 0, 0.03)
    return np.where(finite, np.exp(-DEPTH_SHADE / 8 * behind), 1)
