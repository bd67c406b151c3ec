"""report.html: one file, no network. Tables, charts as inline SVG, pictures of some successes and of each failure."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dapdata.draw import blank, draw_cloud, draw_ground, image
from dapdata.errors import require
from dapdata.metrics import SceneResult
from dapdata.pictures import draw_goals, draw_scene, front_view
from dapdata.report import Interval, Quantiles, Report, Summary

if TYPE_CHECKING:
    from daptrain.curve import Curve, Figures

Array = NDArray[Any]

SUCCESSES_SHOWN = 6
PICTURE = 340, 300  # px
GOAL, PREDICTED, ENDED = (0.00, 0.62, 0.45), (0.85, 0.37, 0.01), (0.46, 0.44, 0.70)
SUCCESS_ROWS = {
    "success_top1": "best-ranked candidate",
    "success_any_of_K": "any of the K",
    "success_single": "one sample, on average",
    "success_precise": "best, ends within 5 mm and 3°",
    "success_near_goal": "best, within 2 cm of a verified goal",
    "success_tight": "best of those that head for a tight goal",
}
GEOMETRY_ROWS = {
    "penetration_mm": "overlap at the predicted pose, mm",
    "gap_mm": "free height under it, mm",
    "goal_surface_mm": "to the nearest goal, surface distance, mm",
    "goal_translation_mm": "to the nearest goal, translation, mm",
    "goal_rotation_deg": "to the nearest goal, rotation, °",
    "settle_move_mm": "moved while settling, mm",
    "settle_turn_deg": "turned while settling, °",
    "push_N": "largest push while moving in, N",
}
STYLE = """
:root { color-scheme: light; --ink: #1d2433; --soft: #5c6577; --line: #dfe3ea; --pale: #f5f7fa;
        --mine: #d95f02; --other: #8fa3bf; --good: #009e73; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1240px; padding: 28px 24px 60px; background: #fff; color: var(--ink);
       font: 15px/1.5 system-ui, "Segoe UI", Helvetica, Arial, sans-serif; }
h1 { font-size: 26px; margin: 0 0 2px; } h2 { font-size: 18px; margin: 36px 0 10px; }
p, figcaption { color: var(--soft); margin: 4px 0 12px; max-width: 80ch; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 5px 14px 5px 0; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } th { color: var(--soft); font-weight: 600; }
td small { color: var(--soft); margin-left: 6px; }
.wide { overflow-x: auto; } .charts { display: flex; flex-wrap: wrap; gap: 36px; }
.note { background: #fff6e5; border-left: 4px solid #e69f00; padding: 8px 14px; margin: 10px 0; color: var(--ink); }
.broken { background: #fdecea; border-left-color: #c62828; }
.scenes { display: grid; grid-template-columns: repeat(auto-fill, minmax(340px, 1fr)); gap: 18px; }
figure { margin: 0; border: 1px solid var(--line); border-radius: 8px; padding: 10px; background: var(--pale); }
figure div { display: flex; gap: 6px; } figure img { width: calc(50% - 3px); border-radius: 4px; background: #fff; }
 figcaption { margin: 6px 2px 0; font-size: 13px; }
.key span { display: inline-block; width: 12px; height: 12px; border-radius: 3px; margin: 0 5px 0 14px; vertical-align: -1px; }
svg .title { font-weight: 600; }
svg text { font-size: 12px; fill: var(--ink); }
"""


def page(
    report: Report,
    results: Sequence[SceneResult],
    samples: Sequence[Mapping[str, Array]],
    film: bytes | None,
    say: Callable[[str], None],
) -> str:
    """The whole page.

    Args:
        report: What it shows.
        results: Of the method, one a scene.
        samples: The same scenes, for the pictures; none are made when it is empty.
        film: The PNG of `film.film`, if there is one.
        say: Gets a line now and then.
    """
    methods = {report.method.name: Summary(success=report.success, modes=report.modes, geometry=report.geometry)}
    methods |= {name: summary for name, summary in report.references.items() if name not in methods}
    pictured = _pictures(results, samples, say) if samples else ""
    title = f"{report.method.name} on {report.task}"
    parts = [
        f"<h1>{escape(title)}</h1>",
        f"<p>{report.split.n_scenes} scenes of the {escape(report.split.name)} split ({report.split.n_tight_scenes} with "
        f"a tight goal), {report.method.k} candidates each, {report.judge.protocol} protocol. Small figures are 95 % "
        "intervals. A scene without a prediction is a failure.</p>",
        _notes(report),
        "<h2>Success</h2>",
        '<div class="charts">',
        _bars({name: summary.success.success_top1 for name, summary in methods.items()}),
        _failures(report.success.failures),
        "</div>",
        _success_table(methods),
        "<h2>Modes</h2>",
        "<p>How many of the verified goals the candidates find. A prediction is at a goal when no point of the object's "
        f"surface is further off than {_number(report.modes.tau_mm.median)} mm (median of min(10 mm, half the clearance + 2 "
        f"mm)), modulo its symmetry. A scene has {_number(report.modes.modes.median)} goals (median).</p>",
        '<div class="charts">',
        _lines(methods, report),
        _modes_table(report),
        "</div>",
        "<h2>Geometry of the best-ranked candidate</h2>",
        _geometry_table(methods),
        "<h2>Cost</h2>",
        _cost_table(report),
        "" if film is None else _film(film),
        pictured,
        "<h2>What was judged</h2>",
        _digests(report),
    ]
    return _document(title, parts)


def curve_page(curve: Curve, picture: bytes) -> str:
    """The page on a curve of sample efficiency.

    Args:
        curve: What it shows.
        picture: The bytes of a PNG.
    """
    asked = curve.asked
    budget = ", ".join(f"{asked.training[name]:g} {name}" for name in ("minutes", "steps") if asked.training[name] is not None)
    title = f"{asked.training['method']} on {asked.task}: sample efficiency"
    shown: list[tuple[str, Figures]] = [
        (f'<a href="curve/{point.demos}/report.html">{point.demos:,}</a>', point) for point in curve.points
    ]
    shown += [(escape(name), figures) for name, figures in curve.references.items()]
    rows = [
        [
            name,
            *(_percent(getattr(figures.success, key)) for key in SUCCESS_ROWS),
            *([_percent(list(figures.recall.values())[-1])]),
        ]
        for name, figures in shown
    ]
    parts = [
        f"<h1>{escape(title)}</h1>",
        f"<p>For each number of demonstrations networks of their own, trained with the same budget ({budget}) on the first so "
        f"many of the train split, and judged on the same {asked.judging['trials']} scenes of the "
        f"{escape(asked.judging['split'])} split: {asked.judging['k']} candidates each, {asked.judging['protocol']} protocol. "
        "Small figures and bands are 95 % intervals; those of scenes, not of training again.</p>",
        f'<img alt="success over demonstrations" style="max-width:100%" src="{_embedded(picture, "png")}">',
        _table(["demonstrations", *SUCCESS_ROWS.values(), "goals found by all candidates"], rows),
        f"<h2>What was asked</h2><p>Dataset {escape(asked.data)}, <code>{escape(asked.dataset)}</code></p>",
    ]
    return _document(title, parts)


def _document(title: str, parts: Sequence[str]) -> str:
    """A page of its own that loads nothing."""
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{escape(title)}</title>'
    body = "\n".join(parts)
    return f'<!doctype html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n'


def _notes(report: Report) -> str:
    kind = "note" if report.judge.sound else "note broken"
    return "".join(f'<p class="{kind}">{escape(note)}</p>' for note in report.notes)


# Tables ----------------------------------------------------------------------------------------------------


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of cells that are HTML already; the first column names the row."""
    lines = ["<tr>" + "".join(f"<th>{cell}</th>" for cell in head) + "</tr>"]
    lines += ["<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows]
    return '<div class="wide"><table>' + "\n".join(lines) + "</table></div>"


def _percent(interval: Interval) -> str:
    low, high = interval.ci95
    return f"{100 * interval.value:.1f} %<small>{100 * low:.0f}-{100 * high:.0f}, n {interval.n}</small>"


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return "0" if abs(value) < 1e-3 else f"{value:.2g}" if abs(value) < 10 else f"{value:,.0f}"


def _spread(q: Quantiles | None) -> str:
    return "-" if q is None or q.n == 0 else f"{_number(q.median)}<small>p90 {_number(q.p90)}, max {_number(q.max)}</small>"


def _success_table(methods: Mapping[str, Summary]) -> str:
    rows = [
        [label, *(_percent(getattr(summary.success, name)) for summary in methods.values())]
        for name, label in SUCCESS_ROWS.items()
    ]
    return _table(["", *map(escape, methods)], rows)


def _modes_table(report: Report) -> str:
    modes = report.modes
    rows = [
        [
            f"K = {count}",
            _percent(modes.recall_at_K[count]),
            f"{100 * modes.uniform_recall_at_K[count]:.0f} %",
            _percent(modes.all_modes_found_at_K[count]),
            f"{100 * modes.uniform_all_modes_found_at_K[count]:.0f} %",
            _percent(modes.precision_at_K[count]),
        ]
        for count in modes.recall_at_K
    ]
    sweep = [
        [f"within {tau} mm", *(f"{100 * figures[name]:.0f} %" for name in figures)] for tau, figures in modes.sweep_mm.items()
    ]
    names = [name.replace("_", " ") for name in next(iter(modes.sweep_mm.values()), {})]
    entropy = f"<p>Entropy over the modes: {modes.entropy.value:.2f}; a uniform sampler has {modes.uniform_entropy:.2f}.</p>"
    first = _table(["", "recall", "uniform sampler", "all goals found", "uniform sampler", "precision"], rows)
    return f"<div>{first}{entropy}{_table(['all candidates', *names], sweep)}</div>"


def _geometry_table(methods: Mapping[str, Summary]) -> str:
    rows = [["free of collision", *(_percent(s.geometry.collision_free) for s in methods.values())]]
    rows += [[label, *(_spread(getattr(s.geometry, name)) for s in methods.values())] for name, label in GEOMETRY_ROWS.items()]
    return _table(["", *map(escape, methods)], rows)


def _cost_table(report: Report) -> str:
    cost = report.cost
    rows = [
        ["preparation, s a placement", _spread(cost.prepare_s)],
        ["inference, s a placement", _spread(cost.infer_s)],
        ["physics, s a placement", _spread(cost.physics_s)],
        ["parameters", "-" if cost.parameters is None else f"{cost.parameters:,}"],
        ["demonstrations used", "-" if cost.demos_used is None else f"{cost.demos_used:,}"],
        ["training, min, both networks added up", _number(cost.training_minutes)],
        ["device", escape(cost.device or "-")],
        ["machine", escape(report.hardware)],
    ]
    return _table(["", ""], rows)


def _digests(report: Report) -> str:
    digests = report.digests
    named = {
        "predictions": digests.predictions,
        "data": digests.data,
        "recipe": digests.recipe,
        "scenes": report.split.sha256,
        **digests.weights,
    }
    rows = [[escape(name), f"<code>{escape(value)}</code>"] for name, value in named.items()]
    rows += [["judge", escape(f"{report.judge.engine}, dapdata {report.judge.dapdata}")], ["seed", str(report.seed)]]
    return _table(["", ""], rows)


# Charts ----------------------------------------------------------------------------------------------------


def _bars(rates: Mapping[str, Interval]) -> str:
    """Success of the best-ranked candidate, a bar a method with its interval."""
    rows, left, length, pitch = [], 90, 330, 30
    for i, (name, interval) in enumerate(rates.items()):
        y = 34 + i * pitch
        low, high = (left + length * bound for bound in interval.ci95)
        color = "var(--mine)" if i == 0 else "var(--other)"
        rows.append(
            f'<text x="{left - 8}" y="{y + 13}" text-anchor="end">{escape(name)}</text>'
            f'<rect x="{left}" y="{y}" width="{length * interval.value:.1f}" height="18" rx="2" fill="{color}"/>'
            f'<path d="M{low:.1f} {y + 9}H{high:.1f}M{low:.1f} {y + 5}v8M{high:.1f} {y + 5}v8" '
            'stroke="var(--ink)" fill="none"/>'
            f'<text x="{left + length + 8}" y="{y + 13}">{100 * interval.value:.0f} %</text>'
        )
    height = 34 + len(rates) * pitch + 6
    ruler = f'<path d="M{left} 28V{height - 6}M{left + length} 28V{height - 6}" stroke="var(--line)"/>'
    title = '<text x="0" y="14" class="title">best-ranked candidate succeeds</text>'
    return f'<svg width="480" height="{height}" role="img">{title}{ruler}{"".join(rows)}</svg>'


def _failures(counts: Mapping[str, int]) -> str:
    """Why the best-ranked candidates failed."""
    title = '<text x="0" y="14" class="title">failures by reason</text>'
    if not counts:
        return f'<svg width="300" height="60" role="img">{title}<text x="0" y="44">none</text></svg>'
    most, rows = max(counts.values()), []
    for i, (reason, count) in enumerate(counts.items()):
        y, width = 34 + i * 26, 180 * count / most
        rows.append(
            f'<text x="122" y="{y + 13}" text-anchor="end">{escape(reason.replace("_", " "))}</text>'
            f'<rect x="130" y="{y}" width="{width:.1f}" height="16" rx="2" fill="var(--other)"/>'
            f'<text x="{136 + width:.1f}" y="{y + 13}">{count}</text>'
        )
    return f'<svg width="380" height="{40 + 26 * len(counts)}" role="img">{title}{"".join(rows)}</svg>'


def _lines(methods: Mapping[str, Summary], report: Report) -> str:
    """Recall of the goals against the number of candidates, next to a uniform sampler's."""
    counts = [int(count) for count in report.modes.recall_at_K]
    left, top, width, height = 40, 30, 300, 190
    span = max(np.log2(counts[-1]), 1.0)

    def path(values: Sequence[float], style: str) -> str:
        places = [(left + width * np.log2(c) / span, top + height * (1 - v)) for c, v in zip(counts, values)]
        dots = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{style}"/>' for x, y in places)
        line = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in places)
        return f'<path d="{line}" stroke="{style}" stroke-width="2" fill="none"/>{dots}'

    drawn = [path(list(report.modes.uniform_recall_at_K.values()), "var(--line)")]
    drawn += [
        path([interval.value for interval in summary.modes.recall_at_K.values()], "var(--mine)" if i == 0 else "var(--other)")
        for i, (name, summary) in reversed(list(enumerate(methods.items())))
        if name != "oracle"
    ]
    ticks = "".join(
        f'<text x="{left + width * np.log2(c) / span:.1f}" y="{top + height + 18}" text-anchor="middle">{c}</text>'
        for c in counts
    )
    ruler = "".join(
        f'<path d="M{left} {top + height * (1 - v):.1f}h{width}" stroke="var(--pale)"/>'
        f'<text x="{left - 6}" y="{top + height * (1 - v) + 4:.1f}" text-anchor="end">{100 * v:.0f}</text>'
        for v in (0, 0.5, 1)
    )
    names = "this method, in grey the others, palest a uniform sampler of goals"
    title = '<text x="0" y="14" class="title">goals found by the first K candidates, %</text>'
    title += f'<text x="0" y="{top + height + 38}">{names}</text>'
    return f'<svg width="400" height="{top + height + 46}" role="img">{title}{ruler}{ticks}{"".join(drawn)}</svg>'


# Pictures --------------------------------------------------------------------------------------------------


def _pictures(results: Sequence[SceneResult], samples: Sequence[Mapping[str, Array]], say: Callable[[str], None]) -> str:
    """Each failure and some successes, each as the cameras saw it and as it truly is."""
    require("matplotlib", "train")
    pairs = list(zip(results, samples))
    failed = [pair for pair in pairs if not (pair[0].verdicts and pair[0].verdicts[0].success)]
    done = [pair for pair in pairs if pair[0].verdicts and pair[0].verdicts[0].success][:SUCCESSES_SHOWN]
    parts = [_legend()]
    for heading, chosen in ((f"Failures ({len(failed)})", failed), ("Some successes", done)):
        figures = []
        for i, (result, sample) in enumerate(chosen):
            say(f"pictures: {i + 1} of {len(chosen)} {heading.split(' (')[0].lower()}")
            figures.append(_figure(result, sample))
        parts.append(f"<h2>{heading}</h2>" + (f'<div class="scenes">{"".join(figures)}</div>' if figures else "<p>None.</p>"))
    return "\n".join(parts)


def _film(picture: bytes) -> str:
    alt = "scores of the superpoints from noise to one place, three samples of one scene"
    return f'<h2>From noise to one place</h2><img alt="{alt}" style="max-width:100%" src="{_embedded(picture, "png")}">'


def _legend() -> str:
    colors = {"verified goals": GOAL, "prediction": PREDICTED, "where it came to rest": ENDED}
    spans = "".join(
        f'<span style="background:rgb({",".join(str(round(255 * c)) for c in rgb)})"></span>{name}'
        for name, rgb in colors.items()
    )
    return f'<h2>Pictures</h2><p class="key">Left: the observed cloud. Right: the true scene.{spans}</p>'


def _figure(result: SceneResult, sample: Mapping[str, Array]) -> str:
    verdict = result.verdicts[0] if result.verdicts else None
    if verdict is None:
        caption = f"demo {result.demo}: no prediction"
    else:
        state = "success" if verdict.success else verdict.reason.replace("_", " ")
        figures = (
            f"overlap {1000 * max(verdict.penetration, 0.0):.1f} mm, nearest goal {1000 * result.distance[0].min():.0f} mm off"
        )
        push = f", pushed {verdict.push:.0f} N" if verdict.push > 0 else ""
        succeeded = f"{sum(v.success for v in result.verdicts)} of {len(result.verdicts)} candidates succeed"
        caption = f"demo {result.demo}: <b>{escape(state)}</b>, {figures}{push}; {succeeded}"
    images = "".join(f'<img alt="" src="{_inline(pixels)}">' for pixels in _views(result, sample))
    return f"<figure><div>{images}</div><figcaption>{caption}</figcaption></figure>"


def _views(result: SceneResult, sample: Mapping[str, Array]) -> tuple[Array, Array]:
    """The observed cloud with the prediction, and the true scene with goals, prediction and end."""
    camera = front_view(sample, *PICTURE)
    predicted, goals = result.T_world_object[: min(1, len(result.verdicts))], sample["goals/T_world_object"]
    ended = [v.T_world_object_end for v in result.verdicts[:1] if np.isfinite(v.T_world_object_end).all()]
    seen, true = blank(camera), blank(camera)
    points = sample["container/points"].astype(float)
    draw_cloud(seen, points, np.tile([0.62, 0.67, 0.75], (len(points), 1)), sample["container/normals"].astype(float))
    draw_ground(seen, sample["pose/T_world_container"][:3, 3], radius=0.6)
    draw_scene(true, sample)
    draw_goals(true, sample, goals, GOAL, 0.35, 0.12)
    draw_goals(true, sample, np.array(ended).reshape(-1, 4, 4), ENDED, 0.8, 0.3)
    for canvas in (seen, true):
        draw_goals(canvas, sample, predicted, PREDICTED, 0.75, 0.3)
    return image(seen), image(true)


def _inline(pixels: Array) -> str:
    """A picture as a data URL."""
    from matplotlib.image import imsave

    buffer = io.BytesIO()
    imsave(buffer, pixels, format="jpeg", pil_kwargs={"quality": 82})
    return _embedded(buffer.getvalue(), "jpeg")


def _embedded(content: bytes, kind: str) -> str:
    """The bytes of a PNG or JPEG file as a data URL."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
