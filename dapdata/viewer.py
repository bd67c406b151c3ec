"""The 3-D view of demos in a page: clouds, goals, correspondences, true parts, cameras, each to be switched on and off.

What is in a view is decided here, as layers of three kinds; `viewer.js` makes plotly's traces of them. Clouds travel as
16-bit steps within their box (of a few hundredths of a millimetre), normals and colours as 8-bit numbers: 14 bytes a point,
19 in base64. A point becomes a small hexagon that lies in its tangent plane, so that surfaces close and catch light.
Solids travel once and are repeated by the page at each of their poses.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import page, records
from dapdata.draw import POINT_RADIUS, Triangles, to_light
from dapdata.pictures import (
    CLUTTER,
    DEMONSTRATED,
    DIVERGING,
    REJECTED,
    VALID,
    WOOD,
    Sample,
    Shown,
    front_view,
    height_colors,
    is_demonstrated,
    solids,
    superpoint_colors,
    title,
)
from dapdata.poses import inverse, transform

Array = NDArray[Any]
Layer = dict[str, Any]

MAX_POINTS = 40_000  # of a cloud
FRUSTUM = 0.06  # m, length of a camera as drawn
STEPS = 256  # of a scale of colours
SECTIONS = 32  # sides of a cylinder
GOALS = {"demonstrated goal": (DEMONSTRATED, 0.7), "other valid goals": (VALID, 0.6)}
PLAIN = np.array([(0.38, 0.41, 0.46), (0.86, 0.88, 0.91)])  # in the dark and in the light
CAMERA = (0.45, 0.45, 0.75)
CORRESPONDENCE = (0.55, 0.35, 0.75)


def widget(views: Sequence[Mapping[str, Any]], colour: str = "height") -> str:
    """The HTML of a 3-D view with a choice of demos, each from `view`; `colour` is that of the points at first."""
    options = "".join(f'<option value="{v["demo"]}">{escape(v["name"])}</option>' for v in views)
    return f"""<div class="view">
<div class="stage"><div id="stage"></div><div class="buttons">
<button type="button" id="front">front</button><button type="button" id="above">above</button>
<button type="button" id="nearer" aria-label="nearer">+</button>
<button type="button" id="further" aria-label="further">−</button>
</div></div>
<form onsubmit="return false">
<fieldset><legend>Demo</legend><select id="demo" aria-label="demo">{options}</select><p class="soft" id="about"></p></fieldset>
<fieldset id="colours"><legend>Colour of the points</legend></fieldset>
<fieldset id="layers"><legend>Shown</legend></fieldset>
</form></div>
{page.data({"views": views, "colours": list(_colours()), "colour": colour}, "views")}
{page.script(Path(__file__).with_name("viewer.js"))}"""


def _colours() -> Iterator[dict[str, Any]]:
    """The ways to colour points: name, title, scale from 0 to 1 and the words at its ends."""

    def described(name: str, title: str, colors: Array, ends: tuple[str, str]) -> dict[str, Any]:
        at = np.linspace(0, 1, len(colors)).round(4).tolist()
        return {"name": name, "title": title, "scale": [[x, page.rgb(c)] for x, c in zip(at, colors)], "ends": ends}

    yield described("height", "height (raw cloud)", height_colors(np.linspace(0, 1, 9), 1), ("0 m", ""))
    yield described("superpoint", "superpoint", superpoint_colors(STEPS), ("a colour each", ""))
    yield described("affordance", "affordance", DIVERGING, ("−1 keep away", "place here +1"))
    yield described("plain", "plain", PLAIN, ("turned away", "to the light"))
    yield described("camera", "camera that saw it", superpoint_colors(STEPS)[:12], ("a colour each", ""))


def view(
    shown: Shown,
    *more: Layer,
    note: str = "",
    goals: Mapping[str, tuple[Sequence[float], float]] = GOALS,
    most: int = MAX_POINTS,
) -> dict[str, Any]:
    """One demo for `widget`, ready for JSON.

    Args:
        shown: The demo.
        more: Further layers, such as `poses_layer(...)`.
        note: Text about the demo; default: its counts.
        goals: Name, colour and opacity of the demonstrated goal and of the other ones; of all, if it is one.
        most: Points of a cloud that are kept; of more, so many are kept that are spread evenly.
    """
    sample = shown.sample
    _, counts = title(shown)
    points = sample["container/points"].astype(float)
    low, high = points.min(axis=0), points.max(axis=0)
    front = front_view(sample, 64, 48)
    return {
        "demo": int(sample["meta/demo"]),
        "name": f"demo {int(sample['meta/demo'])} · {shown.split} · {shown.task}",
        "note": note or counts,
        "top": f"{max(high[2], 1e-3):.2f} m",
        "center": ((low + high) / 2).tolist(),
        "extent": float(np.linalg.norm(high - low)),
        "reach": float(np.abs(_everywhere(sample) - (low + high) / 2).max()) + 0.1,
        "eye": (-front.T_world_camera[:3, 2]).tolist(),
        "clouds": {body: _cloud(sample, body, float(high[2]), most, to_light(front)) for body in ("container", "object")},
        "solids": {name: _solid(triangles) for name, triangles in solids(sample, SECTIONS).items()},
        "layers": [*more, *layers(sample, goals)],
    }


def layers(sample: Sample, goals: Mapping[str, tuple[Sequence[float], float]] = GOALS) -> Iterator[Layer]:
    """What a demo has to show: its clouds, goals, rejected candidates, correspondences, true parts and cameras."""
    T_object_start = inverse(sample["pose/T_world_object_start"])
    yield {"kind": "cloud", "name": "container cloud", "cloud": "container", "on": True}
    yield {"kind": "cloud", "name": "object cloud, start pose", "cloud": "object", "on": True}
    moved = (sample["pose/T_world_object_goal"] @ T_object_start).ravel().tolist()
    is_known = len(sample["object_parts/kind"]) > 0  # else its cloud stands for its solids
    yield {"kind": "cloud", "name": "object cloud, demonstrated", "cloud": "object", "on": not is_known, "T": moved}
    if is_known:
        yield from _goals(sample, goals)
    yield _correspondences(sample)
    for role, color in zip(records.ROLES, (WOOD, CLUTTER)):
        if (sample["scene/role"] == records.ROLES.index(role)).any():
            T = sample["pose/T_world_container"][None]
            yield poses_layer(f"true parts: {role}", color, T, [role], on=False, opacity=1.0, solid=role)
    yield _cameras(sample)


def _goals(sample: Sample, goals: Mapping[str, tuple[Sequence[float], float]]) -> Iterator[Layer]:
    """The object at its valid goals, and at each rejected candidate."""
    demonstrated = is_demonstrated(sample) if len(goals) == 2 else np.ones(len(sample["goals/kind"]), bool)
    kinds = [records.GOAL_KINDS[kind] for kind in sample["goals/kind"]]
    says = [f"goal {g}: {k}, {1000 * c:.0f} mm free play" for g, (k, c) in enumerate(zip(kinds, sample["goals/clearance"]))]
    for (name, (color, opacity)), mine in zip(goals.items(), (demonstrated, ~demonstrated)):
        if mine.any():
            T = sample["goals/T_world_object"][mine]
            yield poses_layer(name, color, T, [says[g] for g in np.flatnonzero(mine)], opacity=opacity)
    for code, reason in enumerate(records.REJECT_REASONS):
        T = sample["rejected_goals/T_world_object"][sample["rejected_goals/reason"] == code]
        if len(T):
            words = f"rejected: {reason.replace('_', ' ')}"
            yield poses_layer(words, REJECTED[reason], T, [words] * len(T), on=False, opacity=0.35)


def poses_layer(
    name: str,
    color: Sequence[float],
    T_world_object: Array,
    says: Sequence[str],
    *,
    on: bool = True,
    opacity: float = 0.6,
    solid: str = "object",
) -> Layer:
    """A layer that shows a solid at (G, 4, 4) poses, with a text for each."""
    T = np.round(T_world_object[:, :3], 5).reshape(-1, 12).tolist()
    return {
        "kind": "solid",
        "name": name,
        "color": page.rgb(color),
        "poses": T,
        "says": list(says),
        "on": on,
        "opacity": opacity,
        "solid": solid,
    }


def lines_layer(name: str, color: Sequence[float], ends: Array, says: Sequence[str]) -> Layer:
    """A layer of (L, 2, 3) lines in the world, m, with a text for each."""
    return {
        "kind": "lines",
        "name": name,
        "color": page.rgb(color),
        "ends": page.pack(ends, "<f4"),
        "says": list(says),
        "on": False,
    }


def _correspondences(sample: Sample) -> Layer:
    """Lines between superpoints, the object's at its start pose."""
    a, b = sample["correspondence/object_superpoint"], sample["correspondence/container_superpoint"]
    ends = np.stack([sample["object_superpoints/points"][a], sample["container_superpoints/points"][b]], axis=1)
    says = [
        f"superpoints {i} and {j}: {1000 * d:.0f} mm apart at the goal"
        for i, j, d in zip(a, b, sample["correspondence/distance"])
    ]
    return lines_layer("correspondences", CORRESPONDENCE, ends, says)


def _cameras(sample: Sample) -> Layer:
    """Each camera as a small pyramid: its centre and the corners of its picture."""
    ends, says = [], []
    for i, (K, T) in enumerate(zip(sample["camera/K"], sample["camera/T_world_camera"])):
        half = K[:2, 2] / np.diag(K)[:2]
        corners = transform(T, FRUSTUM * np.c_[half * [[-1, -1], [1, -1], [1, 1], [-1, 1]], np.ones(4)])
        centre = np.repeat(T[None, :3, 3], 4, axis=0)
        ends += [np.stack([centre, corners], axis=1), np.stack([corners, np.roll(corners, 1, axis=0)], axis=1)]
        says += [f"camera {i}"] * 8
    return lines_layer("cameras", CAMERA, np.concatenate([np.zeros((0, 2, 3)), *ends]), says)


def _everywhere(sample: Sample) -> Array:
    """(N, 3) points that span all that a view may show."""
    poses = [sample["goals/T_world_object"], sample["rejected_goals/T_world_object"], sample["camera/T_world_camera"]]
    return np.concatenate([sample["container/points"], sample["object/points"], *(T[:, :3, 3] for T in poses)]).astype(float)


def _cloud(sample: Sample, body: str, top: float, most: int, light: Array) -> dict[str, Any]:
    """A cloud as it travels; colours of heights up to `top`, m, and of what faces (3,) `light`."""
    points = sample[f"{body}/points"].astype(float)
    keep = np.unique(np.linspace(0, len(points) - 1, min(len(points), most)).astype(int))
    low = points.min(axis=0)
    step = np.maximum(np.ptp(points, axis=0), 1e-6) / 65535
    superpoint = sample[f"{body}/superpoint"][keep]
    values = {
        "height": np.clip(points[keep, 2] / max(top, 1e-3), 0, 1) * (STEPS - 1),
        "plain": np.clip(sample[f"{body}/normals"][keep] @ light, 0, 1) * (STEPS - 1),  # plotly's light is from above alone
        "superpoint": superpoint % STEPS,
        "camera": sample[f"{body}/view"][keep] % 12 * (STEPS - 1) / 11,
    }
    if body == "container":
        values["affordance"] = (sample["container_superpoints/affordance"][superpoint] + 1) / 2 * (STEPS - 1)
    return {
        "low": low.tolist(),
        "step": step.tolist(),
        "points": page.pack((points[keep] - low) / step, "<u2"),
        "normals": page.pack(sample[f"{body}/normals"][keep] * 127, "i1"),
        "values": {name: page.pack(value, "u1") for name, value in values.items()},
        "radius": POINT_RADIUS * (1.0 if body == "container" else 0.6),  # the object's cloud is finer
    }


def _solid(triangles: Triangles) -> dict[str, str]:
    small = len(triangles.vertices) <= 65536
    return {"vertices": page.pack(triangles.vertices, "<f4"), "faces": page.pack(triangles.faces, "<u2" if small else "<u4")}
