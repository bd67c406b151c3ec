"""One HTML file about a dataset: facts, a 3-D view, a contact sheet, statistics. Nothing is loaded from a network.

The page itself is `viewer.html`; this file fills it. Points travel as 16-bit steps within their box (steps of a
few hundredths of a millimetre), normals and scores as 8-bit numbers: about 20 bytes a point.
"""

from __future__ import annotations

import base64
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import meshes, records
from dapdata.draw import to_light
from dapdata.manifest import Manifest
from dapdata.pictures import (
    DEMONSTRATED,
    DIVERGING,
    REJECTED,
    VALID,
    Shown,
    front_view,
    height_colors,
    is_demonstrated,
    superpoint_colors,
    title,
)

Array = NDArray[Any]

MAX_POINTS = 40_000  # per demo in the view; more are thinned out evenly
BARS = 24  # of a histogram
BAR_COLOR = "#3d7f9b"
INKS = {"valid": VALID, "demonstrated": DEMONSTRATED, **REJECTED}


def page(manifest: Manifest, shown: Sequence[Shown], others: Sequence[Shown], sheet: bytes) -> str:
    """The HTML of a dataset's page.

    Args:
        manifest: The dataset's.
        shown: Demos for the 3-D view.
        others: Demos for the statistics.
        sheet: A contact sheet, PNG.
    """
    template = Template(Path(__file__).with_name("viewer.html").read_text(encoding="utf-8"))
    splits = Counter(s.split for s in others)
    facts = {"demos": manifest.demos - sum(manifest.rejects.demos.values())} | _medians(others)
    return template.substitute(
        title=escape(manifest.name),
        subtitle=escape(f"task {manifest.task}: placement demonstrations made with dapdata; metres, world frame, z up"),
        facts="".join(f"<div><dt>{escape(key)}</dt><dd>{value:,}</dd></div>" for key, value in facts.items()),
        sheet=base64.b64encode(sheet).decode(),
        sheet_alt=escape(f"contact sheet of {manifest.name}: one row per demo"),
        statistics_note=escape(
            f"Over {len(others)} demos, spread evenly ({', '.join(f'{n} {s}' for s, n in splits.items())}); "
            "rejects over the whole dataset."
        ),
        plots=plots([s.sample for s in others], manifest),
        digest=manifest.content_sha256,
        recipe=escape(json.dumps(manifest.recipe, indent=1)),
        data=json.dumps(view_data(shown)).replace("<", "\\u003c"),
    )


def _medians(shown: Sequence[Shown]) -> dict[str, int]:
    def median(path: str) -> int:
        return int(np.median([len(s.sample[path]) for s in shown]))

    return {
        "valid goals, median": median("goals/kind"),
        "container points, median": median("container/points"),
        "object points, median": median("object/points"),
        "superpoints, median": median("container_superpoints/size"),
    }


def view_data(shown: Sequence[Shown]) -> dict[str, Any]:
    """What the 3-D view needs, ready for JSON; colours from 0 to 255."""
    return {
        "demos": [_demo_data(s) for s in shown],
        "height": _rgb(height_colors(np.linspace(0, 1, 9), 1)),
        "affordance": _rgb(DIVERGING),
        "palette": _rgb(superpoint_colors(512)),
        "ink": {name: f"rgb({','.join(map(str, _rgb(np.array(c))))})" for name, c in INKS.items()},
    }


def _rgb(colors: Array) -> Any:
    return np.round(np.asarray(colors) * 255).astype(int).tolist()


def _demo_data(shown: Shown) -> dict[str, Any]:
    sample = shown.sample
    points = sample["container/points"]
    low, high = points.min(axis=0), points.max(axis=0)
    out = sample["pose/T_world_container"][:3, :3] @ sample["scene/opening"]
    name, counts = title(shown)
    T_world_container = sample["pose/T_world_container"]
    of_container, of_object = records.meshes_in(sample)
    return {
        "name": name,
        "counts": counts,
        "top": float(high[2]),
        "center": ((low + high) / 2).tolist(),
        "extent": float(np.linalg.norm(high - low)),
        "light": to_light(front_view(sample, 64, 48)).tolist(),
        "yaw": float(np.arctan2(out[1], out[0])) + 0.4,
        "container": _cloud_data(sample, "container"),
        "object": _cloud_data(sample, "object"),
        "T_world_container": T_world_container.ravel().tolist(),
        "parts": _parts(sample["scene/kind"], sample["scene/size"], sample["scene/T_container_part"], of_container),
        "object_parts": _parts(
            sample["object_parts/kind"], sample["object_parts/size"], sample["object_parts/T_object_part"], of_object
        ),
        "goals": [
            {"T": T.ravel().tolist(), "demonstrated": bool(d)}
            for T, d in zip(sample["goals/T_world_object"], is_demonstrated(sample))
        ],
        "rejected": [
            {"T": T.ravel().tolist(), "reason": records.REJECT_REASONS[reason]}
            for T, reason in zip(sample["rejected_goals/T_world_object"], sample["rejected_goals/reason"])
        ],
    }


def _parts(kind: Array, size: Array, T: Array, found: Sequence[records.Mesh | None]) -> list[dict[str, Any]]:
    """The parts; with a mesh its sharp edges, in tenths of a millimetre."""
    parts: list[dict[str, Any]] = [
        {"kind": int(k), "size": s.tolist(), "T": t.ravel().tolist()} for k, s, t in zip(kind, size, T)
    ]
    for part, mesh in zip(parts, found):
        if mesh is not None:
            part["edges"] = np.round(meshes.sharp_edges(mesh) * 1e4).astype(int).reshape(-1, 6).tolist()
    return parts


def _cloud_data(sample: Mapping[str, Array], body: str) -> dict[str, Any]:
    points = sample[f"{body}/points"].astype(float)
    keep = np.unique(np.linspace(0, len(points) - 1, min(len(points), MAX_POINTS)).astype(int))
    low = points.min(axis=0)
    step = np.maximum(np.ptp(points, axis=0), 1e-6) / 65535
    data = {
        "low": low.tolist(),
        "step": step.tolist(),
        "points": _pack((points[keep] - low) / step, "<u2"),
        "normals": _pack(sample[f"{body}/normals"][keep] * 127, "i1"),
        "superpoint": _pack(sample[f"{body}/superpoint"][keep], "<u2"),
    }
    if body == "container":
        data["affordance"] = _pack(sample["container_superpoints/affordance"] * 127, "i1")
    return data


def _pack(values: Array, dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(np.round(values), dtype=dtype).tobytes()).decode()


def plots(samples: Sequence[Mapping[str, Array]], manifest: Manifest) -> str:
    """Figures (SVG in HTML) of what some demos of a dataset, and its manifest, hold."""

    def lengths(path: str) -> Array:
        return np.array([len(sample[path]) for sample in samples])

    def counted(path: str, names: tuple[str, ...]) -> dict[str, int]:
        codes = Counter(int(code) for sample in samples for code in np.atleast_1d(sample[path]))
        return {names[code]: n for code, n in codes.most_common()}

    near = np.array([float((sample["container_superpoints/affordance"] > 0).mean()) for sample in samples])
    clearance = np.concatenate([sample["goals/clearance"] for sample in samples]) * 1000
    figures = [
        histogram("Valid goals", "per demo", lengths("goals/kind")),
        histogram("Container points", "per demo", lengths("container/points")),
        histogram("Object points", "per demo", lengths("object/points")),
        histogram("Container superpoints", "per demo", lengths("container_superpoints/size")),
        histogram("Parts", "of container and clutter, per demo", lengths("scene/kind")),
        histogram("Free play at the goal", "mm, tightest horizontal direction", clearance),
        histogram("Superpoints with affordance above 0", "%, per demo", near * 100),
        histogram("Scenes drawn", "per accepted demo", np.array([int(sample["meta/attempts"]) for sample in samples])),
        bars("What goals rest on", "valid goals", counted("goals/kind", records.GOAL_KINDS)),
        bars("Rejected candidate goals", "by reason", manifest.rejects.goals),
        bars("Rejected scenes", "by reason; another was drawn", manifest.rejects.attempts),
        bars("Missing demos", "by reason", manifest.rejects.demos),
    ]
    return "".join(figures)


def histogram(name: str, unit: str, values: Array) -> str:
    """A histogram as an SVG figure; whole numbers with a small range get a bar each."""
    if not len(values):
        return bars(name, unit, {})
    low, high = float(values.min()), float(values.max())
    whole = bool(np.all(values == np.round(values)))
    if whole and high - low < BARS:
        edges = np.arange(low - 0.5, high + 1)
    else:
        edges = np.linspace(low, high if high > low else low + 1, BARS + 1)
    counts, _ = np.histogram(values, edges)
    width, height, tall = 280, 118, counts.max()
    step = (width - 8) / len(counts)
    shapes = "".join(
        f'<rect x="{4 + i * step:.1f}" y="{98 - 86 * n / tall:.1f}" width="{max(step - 1.5, 0.5):.1f}" rx="1" '
        f'height="{86 * n / tall:.1f}" fill="{BAR_COLOR}"><title>{edges[i]:.4g} to {edges[i + 1]:.4g}: {n}</title></rect>'
        for i, n in enumerate(counts)
        if n
    )
    ends = zip((4, width / 2, width - 4), ("start", "middle", "end"), (low, float(np.median(values)), high))
    labels = "".join(
        f'<text x="{x}" y="113" text-anchor="{anchor}">{"median " if anchor == "middle" else ""}{_number(value)}</text>'
        for x, anchor, value in ends
    )
    return _figure(name, unit, width, height, f'<path d="M4 98.5H{width - 4}" stroke="#c9ced6"/>{shapes}{labels}')


def _number(value: float) -> str:
    """A value with thousands separated and no more decimals than tell it apart."""
    return f"{value:,.0f}" if abs(value) >= 100 or value == round(value) else f"{value:.3g}"


def bars(name: str, unit: str, counts: Mapping[str, int]) -> str:
    """Horizontal bars with their counts as an SVG figure."""
    if not counts:
        return _figure(name, unit, 280, 40, '<text x="4" y="20">none</text>')
    longest = max(counts.values())
    rows = [
        f'<text x="4" y="{14 + 20 * i}">{escape(key.replace("_", " "))}</text>'
        f'<rect x="120" y="{5 + 20 * i}" width="{max(115 * n / longest, 1):.1f}" height="12" rx="1" fill="{BAR_COLOR}"/>'
        f'<text x="{124 + 115 * n / longest:.1f}" y="{15 + 20 * i}">{n:,}</text>'
        for i, (key, n) in enumerate(counts.items())
    ]
    return _figure(name, unit, 280, 20 * len(counts) + 8, "".join(rows))


def _figure(name: str, unit: str, width: int, height: int, shapes: str) -> str:
    return (
        f"<figure><figcaption>{escape(name)} <span>{escape(unit)}</span></figcaption>"
        f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="{escape(name)}">{shapes}</svg></figure>'
    )
