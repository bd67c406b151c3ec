"""The skeleton of all pages: one HTML file each that loads nothing, so that it opens from disk and can be sent to others.

A page is a title, facts, and sections made of the pieces below. How they look is in `page.css`, what they do (plots, tables
that sort, light and dark) in `page.js`; both go into the page. Whatever comes from data is escaped here, or put into the
page as JSON and shown as text.
"""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import plots

Array = NDArray[Any]


@dataclass(frozen=True)
class Section:
    """A part of a page with a heading, which the bar at the top leads to."""

    heading: str
    html: str


def document(title: str, lead: str, sections: Iterable[Section | None]) -> str:
    """The whole page.

    Args:
        title: Text.
        lead: HTML before the first section: what the page is about, and its facts.
        sections: In order; None are left out.
    """
    shown = [(f"s{i}", section) for i, section in enumerate(section for section in sections if section is not None)]
    style = Path(__file__).with_name("page.css").read_text("utf-8")
    links = "".join(f'<a href="#{key}">{escape(section.heading)}</a>' for key, section in shown)
    body = "\n".join(
        f'<section id="{key}"><h2>{escape(section.heading)}</h2>\n{section.html}</section>' for key, section in shown
    )
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{escape(title)}</title>
<style>
{style}</style>
</head>
<body>
<nav>{links}<button type="button" id="theme" title="light or dark" aria-label="light or dark">◐</button></nav>
<main>
<h1>{escape(title)}</h1>
{lead}
{body}
</main>
<script type="text/plain" id="library">{plots.library()}</script>
{script(Path(__file__).with_name("page.js"))}
</body>
</html>
"""


def script(path: Path) -> str:
    """A JavaScript file as a script element. It may wait for the event "plotting" and use what `page.js` defines."""
    return f"<script>\n{path.read_text('utf-8')}</script>"


def data(value: Any, key: str | None = None) -> str:
    """A value as JSON in a script element (with the id `key`) that no text in it can end."""
    name = f' id="{escape(key)}"' if key else ""
    return f'<script type="application/json"{name}>{_unbreakable(json.dumps(value, allow_nan=False))}</script>'


def _unbreakable(text: str) -> str:
    return text.replace("<", "\\u003c")


def pack(values: Array, dtype: str) -> str:
    """The bytes of an array, rounded to a small little-endian type such as "<u2", as base64."""
    rounded = np.round(values) if np.dtype(dtype).kind in "iu" else values
    return base64.b64encode(np.ascontiguousarray(rounded, dtype=dtype).tobytes()).decode()


def squeeze(values: Array, dtype: str) -> str:
    """As `pack`, compressed: for pictures and the like, in which neighbours are equal."""
    rounded = np.ascontiguousarray(np.round(values), dtype=dtype)
    return base64.b64encode(gzip.compress(rounded.tobytes(), mtime=0)).decode()


def paragraph(text: str, kind: str = "") -> str:
    """A paragraph of plain text; kind: "soft", "note" or "note broken"."""
    return f'<p class="{kind}">{escape(text)}</p>'


def facts(values: Mapping[str, str | tuple[str, str]]) -> str:
    """Figures as tiles: {what: figure}, or {what: (figure, small print)}; text."""
    tiles = []
    for name, value in values.items():
        figure, small = value if isinstance(value, tuple) else (value, "")
        print_ = f"<small>{escape(small)}</small>" if small else ""
        tiles.append(f"<div><dt>{escape(name)}</dt><dd>{escape(figure)}{print_}</dd></div>")
    return f'<dl class="facts">{"".join(tiles)}</dl>'


def plot(name: str, about: str, figure: plots.Figure) -> str:
    """A plot with its name and what it shows or in which unit; text."""
    text = _unbreakable(figure.to_json())
    caption = f"<figcaption><b>{escape(name)}</b> {escape(about)}</figcaption>"
    return (
        f'<figure>{caption}<div class="plot" role="img" aria-label="{escape(name)}" style="height: {figure.layout.height}px">'
        f'<script type="application/json">{text}</script></div></figure>'
    )


def grid(parts: Iterable[str], large: bool = False) -> str:
    """Plots side by side, as many as fit."""
    return f'<div class="plots{" large" if large else ""}">{"".join(parts)}</div>'


def rows(head: Sequence[str], cells: Sequence[Sequence[str]]) -> str:
    """A small table of cells that are HTML already; the first column names the row."""
    first = "<tr>" + "".join(f"<th>{cell}</th>" for cell in head) + "</tr>" if any(head) else ""
    lines = ["<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in cells]
    return f'<div class="wide"><table>{first}{"".join(lines)}</table></div>'


@dataclass(frozen=True)
class Column:
    """A column of a table that sorts."""

    name: str  # for the filter: one word
    title: str
    values: Sequence[Any]  # text, numbers, or None
    about: str = ""
    digits: int = 0  # decimals at most
    link: str = ""  # values in `linked` lead to the element whose id is this and the value
    linked: Sequence[Any] = ()


def sortable(columns: Sequence[Column], example: str) -> str:
    """A table that is sorted by a click on a head, and filtered by words and comparisons such as `example`."""
    described = [
        {
            "name": c.name,
            "title": c.title,
            "about": c.about or f"sort; filter with {c.name}",
            "digits": c.digits,
            "link": c.link,
            "linked": list(c.linked),
            "values": [None if isinstance(v, float) and not np.isfinite(v) else v for v in c.values],
        }
        for c in columns
    ]
    names = ", ".join(c.name for c in columns)
    return (
        '<div class="sortable"><div class="search">'
        f'<input type="search" placeholder="filter, such as: {escape(example)}" aria-label="filter" title="{escape(names)}">'
        f'<span class="soft"><output></output> shown</span></div>{data(described)}'
        '<div class="wide"><table></table></div><p><button type="button" class="more">more</button></p></div>'
    )


def picture(jpeg: bytes, about: str, kind: str = "") -> str:
    """An img element with the bytes of a JPEG file; kind: "sheet" for one as wide as the page."""
    source = base64.b64encode(jpeg).decode()
    return f'<img class="{kind}" alt="{escape(about)}" loading="lazy" src="data:image/jpeg;base64,{source}">'


def swatch(color: Sequence[float]) -> str:
    """A small patch of a colour in [0, 1]."""
    return f'<i class="swatch" style="background: {rgb(color)}"></i>'


def rgb(color: Sequence[float]) -> str:
    """A colour in [0, 1] as CSS."""
    return f"rgb({', '.join(str(round(255 * float(c))) for c in color)})"
