"""Statistics as plotly figures, in one look: the only door to plotly.

Why plotly draws the pages: one library does the plots and the 3-D view, it is well kept, it ships with its JavaScript and
its licence (MIT) in a package that open3d brings along anyway, and a page with it opens from disk without a network.
Weighed against it: three.js is smaller (0.7 MB against 4.8) but draws no plots, comes from npm alone, so that a copy with
its licence would have to be kept here, and leaves axes, hover texts and pictures to us; matplotlib's figures cannot be
asked anything; drawn by hand (as these pages once were) each figure costs code. The library goes into a page compressed,
2.0 MB, which every browser since 2023 unpacks by itself.

Colours that are written as "var(--name)" are those of the page's stylesheet, light or dark.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from itertools import pairwise
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dapdata.errors import require
from dapdata.report import Interval

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as Figure

Array = NDArray[Any]

BINS = 24  # of a histogram
BAR = "#4787a3"
COLORS = ("var(--mine)", "#4787a3", "#8172b3", "#8c8c8c", "#b5782d", "#55a868")  # of methods; the first is the report's own
DASHED = {"color": "var(--ink)", "width": 1, "dash": "dot"}
AXIS = {
    "gridcolor": "var(--rule)",
    "linecolor": "var(--rule)",
    "zerolinecolor": "var(--rule)",
    "automargin": True,
    "fixedrange": True,  # a finger that scrolls the page must not zoom
    "title": {"standoff": 8},
}
LAYOUT = {
    "font": {"family": "system-ui, Segoe UI, Roboto, DejaVu Sans, sans-serif", "size": 12, "color": "var(--soft)"},
    "paper_bgcolor": "rgba(0,0,0,0)",
    "plot_bgcolor": "rgba(0,0,0,0)",
    "margin": {"l": 6, "r": 12, "t": 12, "b": 6},
    "dragmode": False,
    "bargap": 0.08,
    "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "var(--rule)", "activecolor": "var(--soft)"},
    "hoverlabel": {"bgcolor": "var(--paper)", "bordercolor": "var(--soft)", "font": {"color": "var(--ink)"}},
    "legend": {"orientation": "h", "x": 0, "y": 1.0, "yanchor": "bottom", "itemsizing": "constant"},
}


@cache
def library() -> str:
    """The JavaScript of plotly, gzipped, as base64."""
    require("plotly", "sim")
    from plotly.offline import get_plotlyjs

    return base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode()


def figure(height: int, *traces: Mapping[str, Any], **layout: Any) -> Figure:
    """A figure of some traces in the common look; `height` in px. Unknown properties are refused (ValueError)."""
    require("plotly", "sim")
    from plotly.graph_objects import Figure

    made = Figure(layout={**LAYOUT, "template": None, "height": height, "xaxis": AXIS, "yaxis": AXIS})
    made.add_traces([dict(trace) for trace in traces])
    return made.update_layout(**layout)


def histogram(values: Array, height: int = 150) -> Figure:
    """How often values occur, with their median; whole numbers with a small range get a bar each."""
    if not len(values):
        return bars({})
    low, high = float(values.min()), float(values.max())
    if bool(np.all(values == np.round(values))) and high - low < BINS:
        edges = np.arange(low - 0.5, high + 1)
        ticks = {"dtick": max(1, int(np.ceil((high - low) / 6)))}
        says = [f"{round(edge + 0.5):,}" for edge in edges[:-1]]
    else:
        edges = np.linspace(low, high if high > low else low + 1, BINS + 1)
        ticks = {"nticks": 6}
        says = [f"{a:,.4g} to {b:,.4g}" for a, b in pairwise(edges)]
    counts, _ = np.histogram(values, edges)
    median = float(np.median(values))
    return figure(
        height,
        {
            "type": "bar",
            "x": (edges[:-1] + edges[1:]) / 2,
            "y": counts,
            "width": np.diff(edges) * 0.92,
            "marker": {"color": BAR, "line": {"width": 0}},
            "customdata": says,
            "hovertemplate": "%{customdata}: %{y:,}<extra></extra>",
        },
        yaxis={"showticklabels": False, "showgrid": False},
        xaxis={"range": [edges[0], edges[-1]], **ticks},
        shapes=[{"type": "line", "x0": median, "x1": median, "y0": 0, "y1": 1, "yref": "paper", "line": DASHED}],
        annotations=[
            {
                "x": median,
                "y": 1,
                "yref": "paper",
                "yanchor": "bottom",
                "text": f"median {number(median)}",
                "showarrow": False,
                "font": {"size": 11},
            }
        ],
        margin={"t": 20},
    )


def text(name: str) -> str:
    """A name as plotly's text, which would take tags in it for its own."""
    return escape(name.replace("_", " "), quote=False)


def number(value: float | None) -> str:
    """A value with thousands separated and no more decimals than tell it apart; a dash for None and what is not finite."""
    if value is None or not np.isfinite(value):
        return "–"
    if abs(value) >= 100 or value == round(value):
        return f"{value:,.0f}"
    return f"{value:.3g}" if abs(value) >= 0.001 else "0"


def bars(counts: Mapping[str, int], *more: tuple[str, Mapping[str, int]], name: str = "") -> Figure:
    """Horizontal bars with their counts; several of them at each name when there is `more`, then with a legend."""
    series = [(name, counts), *more]
    names = list(dict.fromkeys(key for _, row in series for key in row))
    if not names:
        nothing = {"text": "none", "x": 0, "y": 1, "xref": "paper", "yref": "paper", "showarrow": False}
        return figure(60, xaxis={"visible": False}, yaxis={"visible": False}, annotations=[nothing])
    most = max(max(row.values(), default=0) for _, row in series)
    return figure(
        34 + (22 if more else 0) + round(24 * len(names) * (1 + 0.6 * len(more))),
        *(
            {
                "type": "bar",
                "orientation": "h",
                "name": text(label),
                "y": [text(key) for key in names],
                "x": [row.get(key, 0) for key in names],
                "text": [f"{row.get(key, 0):,}" for key in names],
                "textposition": "outside",
                "cliponaxis": False,
                "marker": {"color": COLORS[i] if more else BAR, "line": {"width": 0}},
                "hovertemplate": "%{y}: %{x:,}<extra></extra>",
            }
            for i, (label, row) in enumerate(series)
        ),
        xaxis={"visible": False, "range": [0, most * 1.18]},
        yaxis={"type": "category", "autorange": "reversed", "ticklabelstandoff": 6, "showgrid": False},
        bargap=0.3,
        margin={"t": 4, "r": 30},
    )


def rates(series: Mapping[str, Mapping[str, Interval]], height: int | None = None) -> Figure:
    """Rates with their 95 % intervals, in percent: a row a name, in it a dot a series."""
    names = list(next(iter(series.values())))
    spread = 0.18 * (np.arange(len(series)) - (len(series) - 1) / 2)
    rows = np.arange(len(names))
    return figure(
        height or 70 + (16 + 14 * len(series)) * len(names),
        *(
            {
                "type": "scatter",
                "mode": "markers",
                "name": text(method),
                "y": rows + offset,
                "x": [100 * rate.value for rate in found.values()],
                "error_x": {"type": "data", "thickness": 1.6, "width": 4, **_errors(list(found.values()))},
                "marker": {"size": 9, "color": COLORS[i % len(COLORS)]},
                "customdata": [[text(name), says(rate)] for name, rate in found.items()],
                "hovertemplate": "%{customdata[0]}: %{customdata[1]}",
            }
            for i, ((method, found), offset) in enumerate(zip(series.items(), spread))
        ),
        xaxis={"range": [-2, 102], "dtick": 20, "ticksuffix": " %"},
        yaxis={
            "tickvals": rows,
            "ticktext": ["<br>".join(map(text, wrap(name, 22))) for name in names],
            "range": [len(names) - 0.45, -0.55],
            "showgrid": False,
            "zeroline": False,
            "ticklabelstandoff": 6,
        },
        showlegend=len(series) > 1,
    )


def says(rate: Interval) -> str:
    """Such as "97.5 % (96-99), n 500"."""
    low, high = (100 * bound for bound in rate.ci95)
    return f"{100 * rate.value:.1f} % ({low:.0f}-{high:.0f}), n {rate.n:,}"


def _errors(rates: Sequence[Interval]) -> dict[str, Any]:
    return {
        "array": [100 * (rate.ci95[1] - rate.value) for rate in rates],
        "arrayminus": [100 * (rate.value - rate.ci95[0]) for rate in rates],
    }


@dataclass(frozen=True)
class Line:
    """A line of a plot; with rates, its band is their 95 % intervals."""

    name: str
    x: Sequence[float]
    y: Sequence[float] | Sequence[Interval]
    color: str
    dashed: bool = False


def lines(drawn: Sequence[Line], x: str, *, log: bool = False, percent: bool = False, height: int = 300) -> Figure:
    """Lines over x, whose name is given, of rates in percent with bands, or of numbers.

    Args:
        drawn: The lines.
        x: What the axis counts.
        log: Whether x is logarithmic, with a tick at each value.
        percent: Whether numbers are percentages, as rates always are.
        height: px.
    """
    traces: list[dict[str, Any]] = []
    for line in drawn:
        intervals = [value for value in line.y if isinstance(value, Interval)]
        if intervals:
            ends = [100 * rate.ci95[1] for rate in intervals] + [100 * rate.ci95[0] for rate in intervals[::-1]]
            band = {"fill": "toself", "fillcolor": line.color, "opacity": 0.16, "line": {"width": 0}, "hoverinfo": "skip"}
            traces.append({"x": [*line.x, *line.x[::-1]], "y": ends, "showlegend": False, "mode": "lines", **band})
        traces.append(
            {
                "name": text(line.name),
                "x": list(line.x),
                "y": [100 * value.value if isinstance(value, Interval) else value for value in line.y],
                "mode": "lines+markers" if len(line.x) <= 40 else "lines",
                "line": {"color": line.color, "width": 2, "dash": "dot" if line.dashed else "solid"},
                "marker": {"size": 7},
                "customdata": [says(rate) for rate in intervals] or [number(value) for value in line.y],  # type: ignore[arg-type]
                "hovertemplate": f"{x} %{{x:,}}: %{{customdata}}",
            }
        )
    ticks = sorted({value for line in drawn for value in line.x})
    axis = {"type": "log", "tickvals": ticks, "ticktext": [f"{tick:,}" for tick in ticks]} if log else {"nticks": 7}
    percent = percent or any(isinstance(value, Interval) for line in drawn for value in line.y)
    rising = {"rangemode": "tozero", "ticksuffix": " %"} if percent else {}
    made = figure(height, *({"type": "scatter", **trace} for trace in traces), showlegend=len(drawn) > 1)
    return made.update_layout(xaxis={"title": {"text": x}, "zeroline": False, **axis}, yaxis=rising)
