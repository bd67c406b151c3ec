"""Pictures of point clouds and solids in plain numpy: no GPU, no window, no plotting library.

Points become small discs that lie in their tangent plane, solids are triangles (`triangulate`), and both
share one depth buffer. Everything is drawn at twice the wanted size and averaged down; a shade by depth
differences ("eye-dome lighting") makes shapes readable where colours carry data.

    camera = frame(points, direction=(1, -0.3, 0.5), width=640, height=480)
    canvas = blank(camera)
    draw_cloud(canvas, points, colors, normals)
    draw_solids(canvas, triangulate(kind, size, T_world_part), colors)
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

from dapdata.records import Mesh
from dapdata.solids import to_trimesh

Array = NDArray[Any]

OVERSAMPLE = 2  # pixels drawn per pixel shown, each way
FIELD_OF_VIEW = np.radians(20)  # of the longer side: long enough a lens that boxes look square
MARGIN = 1.04  # free border around what `frame` must show
POINT_RADIUS = 0.0072  # m: a little less than the pitch of the fused clouds, so that surfaces close
DEPTH_SHADE = 25.0  # strength of the shade by depth differences, per relative depth step
LIGHT = np.array([-0.45, -0.65, -0.61])  # camera frame, unit, toward the light: over the viewer's left shoulder
BACKGROUND = (1.0, 1.0, 1.0)
CREASE = np.radians(30)  # faces of one solid that meet at more than this have a line between them


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
    found: list[tuple[Array, Array, Array]] = [(np.zeros(0, int), np.zeros(0, np.float32), np.zeros(0, int))]
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
        found.append((pv[hit] * camera.width + pu[hit], at[hit], ahead[hit]))
    pixel, depth, name = (np.concatenate(column) for column in zip(*found))
    return _nearest(pixel, depth, name, (camera.height, camera.width))


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


@dataclass(frozen=True)
class Triangles:
    """Solids as triangles."""

    vertices: Array  # (V, 3), m
    faces: Array  # (F, 3) vertices, counterclockwise seen from outside
    part: Array  # (F,) which solid each is of

    def at(self, T: Array) -> Triangles:
        """The same solids at each of (G, 4, 4) poses: part p at pose g becomes part g * P + p."""
        vertices = self.vertices @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
        step = np.arange(len(T))[:, None]
        parts = int(self.part.max(initial=-1)) + 1
        faces = self.faces + step[..., None] * len(self.vertices)
        return Triangles(vertices.reshape(-1, 3), faces.reshape(-1, 3), (self.part + step * parts).ravel())


def triangulate(kind: Array, size: Array, T: Array, sections: int = 64, meshes: Sequence[Mesh | None] = ()) -> Triangles:
    """The triangles of P parts: the one place where pictures and 3-D views learn what a part looks like.

    Args:
        kind: (P,) index into records.PART_KINDS.
        size: (P, 3) full extents, m.
        T: (P, 4, 4) in the frame that the triangles shall be in.
        sections: Sides of a cylinder.
        meshes: P, the triangles of the parts that are meshes; may be left out where there are none.
    """
    one = (slice(p, p + 1) for p in range(len(kind)))
    solids = [to_trimesh(kind[p], size[p], T[p], sections, meshes[p]) for p in one]
    first = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    return Triangles(
        np.concatenate([np.zeros((0, 3)), *(solid.vertices for solid in solids)]),
        np.concatenate([np.zeros((0, 3), int), *(solid.faces + start for solid, start in zip(solids, first))]),
        np.repeat(np.arange(len(solids)), [len(solid.faces) for solid in solids]),
    )


def draw_solids(
    canvas: Canvas,
    solids: Triangles,
    colors: ArrayLike,
    opacity: float = 1.0,
    hidden: float = 0.0,
    edge: float = 0.55,
) -> None:
    """Adds solids to a canvas. Those of one call hide each other; against what is there already they are blended.

    Args:
        canvas: Changed in place.
        solids: World frame.
        colors: (P, 3) in [0, 1], one a part, or (3,) for all.
        opacity: Of faces in front of what is there; at 1 they hide it.
        hidden: Opacity of faces behind what is there: above 0 they shine through.
        edge: Opacity, on top of that, of the lines where faces meet and where a solid ends.
    """
    if not len(solids.faces):
        return
    corners = solids.vertices[solids.faces]
    seen, depth = cast(canvas.camera, corners)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    color = np.broadcast_to(np.asarray(colors, float), (int(solids.part.max(initial=0)) + 1, 3))[solids.part]
    shaded = np.clip(color * (0.74 + 0.30 * normals @ to_light(canvas.camera))[:, None], 0, 1)
    line = _outline(seen, solids.part, normals)
    layer = np.zeros_like(canvas.color)
    layer[seen >= 0] = shaded[seen[seen >= 0]]
    _blend(canvas, layer, depth, line, opacity, hidden, edge)


def cast(camera: Camera, corners: Array) -> tuple[Array, Array]:
    """Which of (F, 3, 3) triangles each pixel sees, (H, W) int, -1 for none, and at what depth, (H, W) m, inf for none.

    Triangles that reach behind the camera are left out.
    """
    T = camera.T_world_camera
    local = (corners - T[:3, 3]) @ T[:3, :3]
    ahead = np.flatnonzero(local[..., 2].min(axis=1, initial=np.inf) > 0.02)
    local = local[ahead]
    uv = local[..., :2] / local[..., 2:] * camera.focal + [camera.width / 2, camera.height / 2]
    triangle, row = _spread(uv[..., 1].min(axis=1), uv[..., 1].max(axis=1), camera.height)
    # Where the middle of a row of pixels crosses the three sides: all pixels in between are inside.
    left, right = np.full(len(row), np.inf), np.full(len(row), -np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        (ua, va), (ub, vb) = uv[triangle, a].T, uv[triangle, b].T
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (row + 0.5 - va) / (vb - va)
        u, crossed = ua + share * (ub - ua), (share >= 0) & (share <= 1)
        left = np.where(crossed, np.minimum(left, u), left)
        right = np.where(crossed, np.maximum(right, u), right)
    span, column = _spread(left, right, camera.width)
    triangle, row = triangle[span], row[span]
    normal = np.cross(local[:, 1] - local[:, 0], local[:, 2] - local[:, 0])
    level = (normal * local[:, 0]).sum(axis=1)
    ray_x, ray_y = (column + (0.5 - camera.width / 2)) / camera.focal, (row + (0.5 - camera.height / 2)) / camera.focal
    across, down, along, level, near, far = np.c_[normal, level, local[..., 2].min(axis=1), local[..., 2].max(axis=1)].T
    with np.errstate(divide="ignore", invalid="ignore"):
        z = level[triangle] / (across[triangle] * ray_x + down[triangle] * ray_y + along[triangle])
    # Seen edge-on, a triangle covers pixels whose rays miss it: it is nowhere else than between its corners.
    z = np.clip(z, near[triangle], far[triangle])
    return _nearest(row * camera.width + column, z, ahead[triangle], (camera.height, camera.width))


def _spread(low: Array, high: Array, size: int) -> tuple[Array, Array]:
    """Every pixel whose middle lies in one of N intervals: the number of the interval, and that of the pixel."""
    first = np.ceil(np.clip(low, 0, size) - 0.5).astype(np.int32)
    past = np.floor(np.clip(high, 0, size) - 0.5).astype(np.int32) + 1
    count = np.maximum(past - first, 0)
    interval = np.repeat(np.arange(len(count)), count)
    return interval, np.arange(len(interval)) - (np.cumsum(count) - count - first)[interval]


def _nearest(pixel: Array, depth: Array, name: Array, shape: tuple[int, int]) -> tuple[Array, Array]:
    """Of (N,) things at pixels the nearest each: its name, (H, W) int, -1 for none, and its depth, (H, W) m, inf for none."""
    none = np.iinfo(np.uint64).max
    key = np.full(shape[0] * shape[1], none, np.uint64)
    depth_bits = depth.astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)
    np.minimum.at(key, pixel, depth_bits | name.astype(np.uint64))
    nearest = key.reshape(shape)
    empty = nearest == none
    found = np.where(empty, np.inf, (nearest >> np.uint64(32)).astype(np.uint32).view(np.float32)).astype(np.float32)
    return np.where(empty, -1, (nearest & np.uint64(0xFFFFFFFF)).astype(np.int64)), found


def _outline(seen: Array, part: Array, normals: Array) -> Array:
    """(H, W) bool: pixels of a solid next to one of another solid, of none, or where the surface has an edge."""
    line = np.zeros(seen.shape, bool)
    before, after = slice(None, -1), slice(1, None)
    for one, other in (((..., before), (..., after)), ((before,), (after,))):
        a, b = seen[one], seen[other]
        border = a != b
        a, b = a[border], b[border]
        smooth = (a >= 0) & (b >= 0) & (part[a] == part[b]) & ((normals[a] * normals[b]).sum(axis=1) > np.cos(CREASE))
        border[border] = ~smooth
        line[one] |= border
        line[other] |= border
    return line & (seen >= 0)


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


def image(canvas: Canvas) -> Array:
    """(height, width, 3) uint8: the finished picture, shaded by depth and averaged down."""
    shaded = canvas.color * depth_shade(canvas.depth)[..., None]
    steps = range(OVERSAMPLE)
    small = sum(shaded[i::OVERSAMPLE, j::OVERSAMPLE] for i in steps for j in steps) / OVERSAMPLE**2
    return np.asarray(np.round(np.clip(small, 0, 1) * 255), np.uint8)


def depth_shade(depth: Array) -> Array:
    """(H, W) in (0, 1]: darker the further a pixel lies behind its neighbours (at two distances)."""
    finite = np.isfinite(depth)
    log = np.log(np.where(finite, depth, 1e3)).astype(np.float32)
    behind = np.zeros_like(log)
    for step in (1, 3):
        for axis in (0, 1):
            for sign in (step, -step):
                behind += np.clip(log - np.roll(log, sign, axis), 0, 0.03)
    return np.where(finite, np.exp(-DEPTH_SHADE / 8 * behind), 1)
