"""Pictures of demos: the panels of one, and contact sheets of several. They know samples, not files.

One demo is a row: the clouds as observed, the superpoints, the affordance, and all goals with those that were
rejected.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import errors, records
from dapdata.draw import (
    POINT_RADIUS,
    Camera,
    Canvas,
    Triangles,
    blank,
    draw_cloud,
    draw_ground,
    draw_solids,
    frame,
    image,
    lit,
    paint,
    splat,
    triangulate,
)
from dapdata.matching import object_points
from dapdata.poses import facing, inverse, rotate, transform

Array = NDArray[Any]
Sample = Mapping[str, Array]

PANEL = 430, 380  # px, of each of the four large pictures of a row
INSET = 150  # px, of the two small pictures of the object
GUTTER, ROW_TITLE, HEADER, FOOTER = 14, 40, 74, 118  # px
BAR = PANEL[0] - 180  # px, length of a bar of colours
DPI = 100
JPEG = 82  # quality of pictures in pages
OBJECT_RADIUS = 0.6 * POINT_RADIUS  # m: the object's cloud is finer than the container's
SIDE, ABOVE = 0.42, 0.36  # the viewer stands this far aside and above, per unit in front of the opening
WOOD, CLUTTER = (0.93, 0.90, 0.85), (0.70, 0.73, 0.79)
VALID, DEMONSTRATED = (0.00, 0.62, 0.45), (0.96, 0.64, 0.00)
DIVERGING = np.array([(0.29, 0.52, 0.73), (0.62, 0.77, 0.88), (0.95, 0.94, 0.88), (0.95, 0.55, 0.35), (0.76, 0.10, 0.13)])
REJECTED = {  # by reason; apart from the colours of valid goals for every common kind of colour blindness
    "penetrates": (0.78, 0.16, 0.22),
    "unsupported": (0.45, 0.25, 0.70),
    "tilted": (0.00, 0.45, 0.80),
    "moved": (0.85, 0.35, 0.60),
    "not_at_rest": (0.30, 0.65, 0.90),
    "outside": (0.35, 0.35, 0.35),
    "shaken_off": (0.55, 0.30, 0.10),
    "unreachable": (0.90, 0.30, 0.05),
}


@dataclass(frozen=True)
class Shown:
    """A demo to be shown, and what its title needs."""

    sample: Sample
    task: str
    split: str


def front_view(sample: Sample, width: int, height: int) -> Camera:
    """The camera in front of the container, a little aside and above, with the container and its goals in the picture."""
    out = facing(sample["pose/T_world_container"], sample["scene/opening"])
    aside = np.array([out[1], -out[0], 0.0])  # to the viewer's left of the opening's direction
    placed = [transform(T_world_object, object_points(sample)) for T_world_object in sample["goals/T_world_object"]]
    return frame(
        np.concatenate([sample["container/points"], *placed]).astype(float), out - SIDE * aside + [0, 0, ABOVE], width, height
    )


def draw_scene(canvas: Canvas, sample: Sample) -> None:
    """Adds the true parts of the container and of the clutter, and the table; the container's cloud if nobody knows them."""
    parts = solids(sample)
    for role, color in zip(records.ROLES, (WOOD, CLUTTER)):
        draw_solids(canvas, parts[role].at(sample["pose/T_world_container"][None]), color)
    if not len(sample["scene/kind"]):
        draw_cloud(canvas, sample["container/points"].astype(float), WOOD, sample["container/normals"].astype(float))
    draw_ground(canvas, sample["pose/T_world_container"][:3, 3], radius=0.6)


def solids(sample: Sample, sections: int = 64) -> dict[str, Triangles]:
    """The true parts of a demo: the object in its own frame, container and clutter in the container's.

    Args:
        sample: One demo's arrays by shard path.
        sections: Sides of a cylinder.
    """
    of_scene, of_object = records.meshes_in(sample)
    kind, size, T_container_part = (sample[f"scene/{name}"] for name in ("kind", "size", "T_container_part"))
    found = {}
    for code, role in enumerate(records.ROLES):
        mine = np.flatnonzero(sample["scene/role"] == code)
        found[role] = triangulate(kind[mine], size[mine], T_container_part[mine], sections, [of_scene[p] for p in mine])
    kind, size, T_object_part = (sample[f"object_parts/{name}"] for name in ("kind", "size", "T_object_part"))
    return found | {"object": triangulate(kind, size, T_object_part, sections, of_object)}


def draw_goals(
    canvas: Canvas, sample: Sample, T_world_object: Array, color: tuple[float, float, float], opacity: float, hidden: float
) -> None:
    """Adds the object's solids at (G, 4, 4) poses; `opacity` and `hidden` as in `draw_solids`.

    Where nobody knows its parts, its cloud as observed before placing stands for them.
    """
    if len(sample["object_parts/kind"]):
        draw_solids(canvas, solids(sample)["object"].at(T_world_object), color, opacity, hidden)
        return
    for T in T_world_object @ inverse(sample["pose/T_world_object_start"]):
        points = transform(T, sample["object/points"].astype(float))
        draw_cloud(canvas, points, color, rotate(T, sample["object/normals"].astype(float)), OBJECT_RADIUS)


def is_demonstrated(sample: Sample) -> Array:
    """(G,) bool: which of the valid goals is the demonstrated one."""
    return np.asarray(np.abs(sample["goals/T_world_object"] - sample["pose/T_world_object_goal"]).max(axis=(1, 2)) < 1e-9)


def superpoint_colors(count: int) -> Array:
    """(count, 3) colours, neighbours in number far apart in hue; the same on every call."""
    from matplotlib.colors import hsv_to_rgb

    turn = np.arange(count) * 0.6180339887
    return np.asarray(hsv_to_rgb(np.stack([turn % 1, 0.40 + 0.35 * (turn * 3.7 % 1), 0.75 + 0.22 * (turn * 2.3 % 1)], axis=1)))


def height_colors(z: Array, top: float) -> Array:
    """(N, 3) colours of heights above the table, m, from 0 to top."""
    from matplotlib import colormaps

    return np.asarray(colormaps["viridis"](0.12 + 0.86 * np.clip(z / top, 0, 1))[:, :3])


def affordance_colors(score: Array) -> Array:
    """(N, 3) colours of scores in [-1, 1]: blue, pale, red."""
    at = (np.clip(score, -1, 1) + 1) / 2 * (len(DIVERGING) - 1)
    return np.stack([np.interp(at, np.arange(len(DIVERGING)), DIVERGING[:, k]) for k in range(3)], axis=-1)


def panels(sample: Sample, top: float, size: tuple[int, int] = PANEL, inset: int = INSET) -> dict[str, Array]:
    """The pictures of one demo by name: cloud, superpoints, affordance, goals, object, object_superpoints.

    Args:
        sample: One demo's arrays by shard path.
        top: Height that gets the last colour, m.
        size: (width, height) of the large pictures, px.
        inset: Width and height of the object's pictures, px.
    """
    points, normals = sample["container/points"].astype(float), sample["container/normals"].astype(float)
    camera = front_view(sample, *size)
    superpoint = sample["container/superpoint"]
    seen = splat(blank(camera).camera, points, normals, POINT_RADIUS)
    coloured = {
        "cloud": lit(height_colors(points[:, 2], top), normals, camera),
        "superpoints": lit(superpoint_colors(superpoint.max() + 1)[superpoint], normals, camera, 0.25),
        "affordance": _affordance(sample, camera),
    }
    pictures = {name: _cloud_picture(sample, camera, seen, colors) for name, colors in coloured.items()}
    return pictures | {"goals": goal_picture(sample, camera)} | _object_pictures(sample, inset)


def preview(sample: Sample, width: int, height: int) -> Array:
    """(height, 2 width, 3) uint8: the affordance on the observed cloud, and beside it all goals in the true scene."""
    camera = front_view(sample, width, height)
    points, normals = sample["container/points"].astype(float), sample["container/normals"].astype(float)
    seen = splat(blank(camera).camera, points, normals, POINT_RADIUS)
    cloud = _cloud_picture(sample, camera, seen, _affordance(sample, camera))
    return np.concatenate([cloud, goal_picture(sample, camera)], axis=1)


def _affordance(sample: Sample, camera: Camera) -> Array:
    """(N, 3) colours of the container's points by the affordance of their superpoints."""
    score = sample["container_superpoints/affordance"][sample["container/superpoint"]]
    return lit(affordance_colors(score), sample["container/normals"].astype(float), camera, 0.2)


def _cloud_picture(sample: Sample, camera: Camera, seen: tuple[Array, Array], colors: Array) -> Array:
    """(height, width, 3) uint8: the container's cloud, as `splat` found it, in (N, 3) colours, on the table."""
    canvas = blank(camera)
    paint(canvas, seen, colors)
    draw_ground(canvas, sample["pose/T_world_container"][:3, 3], radius=0.6)
    return image(canvas)


def file(pixels: Array, kind: str = "png") -> bytes:
    """A picture as the bytes of a PNG or JPEG file; the same bytes for the same picture."""
    from matplotlib import image as files

    buffer = io.BytesIO()
    options = {"metadata": {"Software": "dapdata"}} if kind == "png" else {"pil_kwargs": {"quality": JPEG}}
    files.imsave(buffer, pixels, format=kind, **options)
    return buffer.getvalue()


def goal_picture(sample: Sample, camera: Camera) -> Array:
    """(height, width, 3) uint8: the true scene with every valid goal and every rejected candidate."""
    canvas = blank(camera)
    draw_scene(canvas, sample)
    demonstrated = is_demonstrated(sample)
    draw_goals(canvas, sample, sample["goals/T_world_object"][~demonstrated], VALID, 0.72, 0.22)
    draw_goals(canvas, sample, sample["goals/T_world_object"][demonstrated], DEMONSTRATED, 0.95, 0.5)
    for code, reason in enumerate(records.REJECT_REASONS):
        rejected = sample["rejected_goals/T_world_object"][sample["rejected_goals/reason"] == code]
        draw_goals(canvas, sample, rejected, REJECTED[reason], 0.32, 0.24)
    return image(canvas)


def _object_pictures(sample: Sample, side: int) -> dict[str, Array]:
    """The object's cloud at its start pose, by height within it and by superpoint."""
    points, normals = sample["object/points"].astype(float), sample["object/normals"].astype(float)
    radius = OBJECT_RADIUS
    camera = frame(np.r_[points - radius, points + radius], (1, -0.6, 1.0), side, side)  # from above: below is not seen
    seen = splat(blank(camera).camera, points, normals, radius)
    low, span = points[:, 2].min(), max(float(np.ptp(points[:, 2])), 1e-6)
    superpoint = sample["object/superpoint"]
    pictures = {}
    for name, colors in {
        "object": height_colors(points[:, 2] - low, span),
        "object_superpoints": superpoint_colors(superpoint.max() + 1)[superpoint],
    }.items():
        canvas = blank(camera)
        paint(canvas, seen, lit(colors, normals, camera))
        pictures[name] = image(canvas)
    return pictures


def title(shown: Shown) -> tuple[str, str]:
    """The name of a demo, and its counts, for a row's title."""
    sample = shown.sample
    goals = _listed(sample["goals/kind"], records.GOAL_KINDS)
    rejected = _listed(sample["rejected_goals/reason"], records.REJECT_REASONS)
    points = " + ".join(f"{len(sample[f'{body}/points']):,}" for body in ("container", "object"))
    superpoints = " + ".join(str(len(sample[f"{body}_superpoints/size"])) for body in ("container", "object"))
    return (
        f"{shown.task}  ·  demo {int(sample['meta/demo'])}  ·  {shown.split}",
        f"{points} points  ·  {superpoints} superpoints  ·  goals: {goals}  ·  rejected: {rejected}",
    )


def _listed(codes: Array, names: tuple[str, ...]) -> str:
    """Such as "14 (11 stack, 3 floor)"."""
    counts = Counter(names[code].replace("_", " ") for code in codes)
    return f"{len(codes)}" + (f" ({', '.join(f'{n} {name}' for name, n in counts.most_common())})" if counts else "")


def sheet(shown: Sequence[Shown], heading: str, kind: str = "png") -> bytes:
    """A contact sheet as the bytes of a PNG or, kind "jpeg", a JPEG: one row per demo, columns and legends named."""
    tops = max(float(s.sample["container/points"][:, 2].max()) for s in shown)
    columns = [(INSET, "object"), *((PANEL[0], name) for name in ("cloud", "superpoints", "affordance", "goals"))]
    width = sum(w + GUTTER for w, _ in columns) + GUTTER
    height = HEADER + len(shown) * (ROW_TITLE + PANEL[1]) + FOOTER
    place = Place(width, height)
    place.text(GUTTER, 22, heading, size=17, weight="bold")
    x = GUTTER
    for w, name in columns:
        place.text(x + w / 2, 56, COLUMN_TITLES[name], size=12, ha="center", color="#333")
        x += w + GUTTER
    for row, item in enumerate(shown):
        y = HEADER + row * (ROW_TITLE + PANEL[1])
        name, counts = title(item)
        place.text(GUTTER, y + 20, name, size=12, weight="bold")
        place.text(width - GUTTER, y + 20, counts, size=10.5, color="#555", ha="right")
        place.line(GUTTER, width - GUTTER, y + 3)
        _draw_row(place, panels(item.sample, tops), columns, y + ROW_TITLE)
    _legends(place, shown, tops, height - FOOTER, width)
    return place.file(kind)


COLUMN_TITLES = {
    "object": "object, start pose",
    "cloud": "container as observed",
    "superpoints": "superpoints",
    "affordance": "affordance of the demonstrated goal",
    "goals": "all goals, settled and judged",
}


class Place:
    """A figure on which things are put in pixels from its upper left corner."""

    def __init__(self, width: int, height: int) -> None:
        errors.require("matplotlib", "sim")
        from matplotlib.figure import Figure

        self.width, self.height = width, height
        self.figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")

    def text(self, x: float, y: float, text: str, **style: Any) -> None:
        self.figure.text(x / self.width, 1 - y / self.height, text, va="center", **style)

    def line(self, left: float, right: float, y: float) -> None:
        self.axes(left, y, right - left, 1).set_facecolor("#ddd")

    def axes(self, x: float, y: float, w: float, h: float) -> Any:
        axes = self.figure.add_axes((x / self.width, 1 - (y + h) / self.height, w / self.width, h / self.height))
        axes.set_xticks([])
        axes.set_yticks([])
        axes.spines[:].set_visible(False)
        return axes

    def picture(self, x: float, y: float, pixels: Array) -> None:
        self.axes(x, y, pixels.shape[1], pixels.shape[0]).imshow(pixels, interpolation="none", aspect="auto")

    def bar(self, x: float, y: float, length: int, colors: Array, labels: Sequence[str], name: str) -> None:
        """A bar of colours with a name above it, and words under its left end, middle and right end."""
        self.axes(x, y, length, 12).imshow(colors[None], aspect="auto")
        for share, label, align in zip((0, 0.5, 1), labels, ("left", "center", "right")):
            self.text(x + share * length, y + 24, label, size=9, color="#333", ha=align)
        self.text(x + length / 2, y - 10, name, size=10, color="#333", ha="center")

    def file(self, kind: str = "png") -> bytes:
        """The figure as the bytes of a PNG or JPEG file; the same bytes for the same things on it."""
        buffer = io.BytesIO()
        options = {"metadata": {"Software": "dapdata"}} if kind == "png" else {"pil_kwargs": {"quality": JPEG}}
        self.figure.savefig(buffer, format=kind, **options)
        return buffer.getvalue()


def _draw_row(place: Place, pictures: dict[str, Array], columns: list[tuple[int, str]], y: int) -> None:
    x = GUTTER
    for w, name in columns:
        if name == "object":
            place.picture(x, y + PANEL[1] / 2 - INSET - 6, pictures["object"])
            place.picture(x, y + PANEL[1] / 2 + 6, pictures["object_superpoints"])
        else:
            place.picture(x, y, pictures[name])
        x += w + GUTTER


def _legends(place: Place, shown: Sequence[Shown], top: float, y: int, width: int) -> None:
    """Colour bars below their columns, the colours of goals, and the caption."""
    x = GUTTER + INSET + GUTTER
    ramp = np.linspace(0, 1, 256)
    step = PANEL[0] + GUTTER
    heights = ["0", f"{top / 2:.2f}", f"{top:.2f}"]
    place.bar(x + 90, y + 22, BAR, height_colors(ramp, 1), heights, "height above the table, m")
    place.text(x + step + PANEL[0] / 2, y + 28, "one colour per superpoint", size=10, color="#333", ha="center")
    labels = ["−1  keep away", "0", "place here  +1"]
    place.bar(x + 2 * step + 90, y + 22, BAR, affordance_colors(ramp * 2 - 1), labels, "placement affordance")
    reasons = Counter(int(reason) for item in shown for reason in item.sample["rejected_goals/reason"])
    entries = [(VALID, "valid goal"), (DEMONSTRATED, "demonstrated")]
    entries += [
        (REJECTED[records.REJECT_REASONS[code]], f"rejected: {records.REJECT_REASONS[code].replace('_', ' ')}")
        for code in sorted(reasons)
    ]
    for i, (color, text) in enumerate(entries):
        at = x + 3 * step + 6 + (i % 2) * 200, y + 20 + i // 2 * 20
        place.axes(at[0], at[1] - 6, 13, 12).set_facecolor(color)
        place.text(at[0] + 19, at[1], text, size=9, color="#333")
    caption = (
        "Seen from in front of the opening, slightly above; the grid on the table has a pitch of 10 cm. "
        "Clouds are as the simulated depth cameras saw them, noise included: each disc lies in the plane of its normal. "
        "Goals: the true solids."
    )
    place.text(width / 2, y + FOOTER - 16, caption, size=9.5, color="#555", ha="center")
