"""The pages of an evaluation, one file each: `report.html`, `curve.html`, and the comparison of two reports.

What they say stands in report.json and curve.json; the pictures and the 3-D view come from the scenes. The look, plots and
tables are those of all pages (`dapdata.page`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dapdata import page, pictures, plots, viewer
from dapdata.draw import blank, draw_cloud, draw_ground, image
from dapdata.metrics import SceneResult
from dapdata.page import Column, Section
from dapdata.pictures import Shown, draw_goals, draw_scene, front_view
from dapdata.plots import Line, number
from dapdata.report import Interval, Quantiles, Report, SceneRow, Summary, compare, read_report

if TYPE_CHECKING:
    from daptrain.curve import Curve, Figures

Array = NDArray[Any]
Sample = Mapping[str, Array]

SUCCESSES_SHOWN = 6
IN_3D = 6, 2  # failures and successes in the 3-D view
PICTURE = 340, 300  # px
GOAL, PREDICTED, ENDED, OTHER = (0.00, 0.62, 0.45), (0.85, 0.37, 0.01), (0.46, 0.44, 0.70), (0.45, 0.50, 0.58)
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
TRAINING = {  # of both networks: what their log calls it, how it is named, in which unit
    "affordance": {
        "loss": ("loss", ""),
        "val_iou": ("denoised and demonstrated region", "IoU"),
        "val_valid": ("samples that are the region of one goal", "share"),
    },
    "pose": {
        "loss": ("loss", ""),
        "off_mm": ("off the goal", "mm"),
        "val_moved_mm": ("off the goal", "mm, median"),
        "val_turned_deg": ("turned from the goal", "°, median"),
    },
}


@dataclass(frozen=True)
class Material:
    """What a report's page shows besides the report; whatever is empty is left out."""

    results: Sequence[SceneResult]  # of the method, one a scene
    samples: Sequence[Sample] = ()  # the same scenes, for pictures and the 3-D view
    film: str = ""  # HTML of `film.player`
    training: Sequence[Mapping[str, Any]] = field(default=())  # entries of metrics.jsonl


def report_page(report: Report, material: Material, say: Callable[[str], None]) -> str:
    """The whole page; `say` gets a line now and then."""
    methods = {report.method.name: _summary(report)}
    methods |= {name: summary for name, summary in report.references.items() if name not in methods}
    title = f"{report.method.name} on {report.task}"
    views = _views(report, material)
    sections = [
        Section("Success", _success(report, methods)),
        Section("Coverage", _coverage(report, methods)),
        Section("From noise to one place", material.film) if material.film else None,
        Section("In 3-D", viewer.widget(views, "plain")) if views else None,
        Section("Scenes", _scenes(report, material, [view["demo"] for view in views])),
        *_pictures(material, say),
        Section("Geometry", page.paragraph("Of the best-ranked candidate.", "soft") + _geometry(methods)),
        Section("Training", _training(material.training)) if material.training else None,
        Section("Cost", _cost(report)),
        Section("What was judged", _digests(report)),
    ]
    return page.document(title, _lead(report), sections)


def _summary(report: Report) -> Summary:
    return Summary(success=report.success, modes=report.modes, geometry=report.geometry, affordance=report.affordance)


def _lead(report: Report) -> str:
    modes, success = report.modes, report.success
    K = str(report.method.draws)
    text = (
        f"{report.split.n_scenes:,} scenes of the {report.split.name} split ({report.split.n_tight_scenes:,} with a tight "
        f"goal), {report.method.k} candidates each, {report.judge.protocol} protocol. Small figures and bars are 95 % "
        "intervals. A scene without a prediction is a failure."
    )
    tiles = {
        "best-ranked candidate succeeds": _tile(success.success_top1),
        "one sample, on average": _tile(success.success_single),
    }
    for name in ("heuristic", "oracle"):
        if name in report.references and name != report.method.name:
            tiles[name] = _tile(report.references[name].success.success_top1)
    tiles[f"goals found by {K} candidates"] = _tile(modes.recall_at_K[K])
    tiles["as even as a uniform sampler"] = (f"{100 * modes.recall_share_at_K[K]:.0f} %", f"recall_share@{K}")
    if report.cost.infer_s is not None and report.cost.infer_s.median is not None:
        tiles["inference a placement"] = (f"{number(report.cost.infer_s.median)} s", report.cost.device or "")
    notes = "".join(page.paragraph(note, "note" if report.judge.sound else "note broken") for note in report.notes)
    return page.paragraph(text, "sub") + notes + page.facts(tiles)


def _tile(rate: Interval) -> tuple[str, str]:
    low, high = (100 * bound for bound in rate.ci95)
    return f"{100 * rate.value:.1f} %", f"{low:.0f} to {high:.0f} %"


# Sections of a report ----------------------------------------------------------------------------------------


def _success(report: Report, methods: Mapping[str, Summary]) -> str:
    failures = plots.bars(report.success.failures, ("all candidates", report.success.failures_all), name="best-ranked")
    figures = [
        _success_plot(methods),
        *_by_clearance(methods),
        page.plot("Failures by reason", "scenes, and candidates of all ranks", failures),
    ]
    return page.grid(figures, large=True) + _success_table(methods)


def _success_plot(methods: Mapping[str, Summary]) -> str:
    rates = {name: {label: getattr(s.success, key) for key, label in SUCCESS_ROWS.items()} for name, s in methods.items()}
    return page.plot("Success", "with 95 % intervals", plots.rates(rates))


def _success_table(methods: Mapping[str, Summary]) -> str:
    cells = [[label, *(_percent(getattr(s.success, name)) for s in methods.values())] for name, label in SUCCESS_ROWS.items()]
    return page.rows(["", *map(escape, methods)], cells)


def _by_clearance(methods: Mapping[str, Summary]) -> list[str]:
    """How tight a place may be; reports of before it was counted have none."""
    found = {name: s.success.success_by_clearance_mm for name, s in methods.items() if s.success.success_by_clearance_mm}
    if not found:
        return []
    named = {name: {_range(key): rate for key, rate in rates.items()} for name, rates in found.items()}
    about = (
        "of the scenes with a goal of such free play, those in which the best-ranked of the candidates that head for one "
        "succeeds there"
    )
    return [page.plot("Success by clearance", about, plots.rates(named))]


def _range(key: str) -> str:
    low, high = key.split("-")
    return f"{low} to {high} mm" if high else f"{low} mm and more"


def _coverage(report: Report, methods: Mapping[str, Summary]) -> str:
    modes = report.modes
    counts = [int(count) for count in modes.recall_at_K]
    text = (
        "How many of the verified goals the candidates find. A prediction is at a goal when no point of the object's surface "
        f"is further off than {number(modes.tau_mm.median)} mm (median of min(10 mm, half the clearance + 2 mm)), modulo its "
        f"symmetry. A scene has {number(modes.modes.median)} goals (median)."
    )
    drawn = [
        _recall_line(name, summary, color)
        for (name, summary), color in zip(methods.items(), plots.COLORS)
        if name != "oracle" or report.method.name == "oracle"  # which lists the goals one by one
    ]
    uniform = Line("uniform sampler", counts, [100 * v for v in modes.uniform_recall_at_K.values()], "var(--soft)", dashed=True)
    share = Line(report.method.name, counts, [100 * v for v in modes.recall_share_at_K.values()], plots.COLORS[0])
    even = Line("uniform sampler", counts, [100.0] * len(counts), "var(--soft)", dashed=True)
    figures = [
        _recall_plot([*drawn, uniform]),
        page.plot(
            "As even as a uniform sampler",
            "recall_share@K: recall over that of a sampler that picks goals evenly",
            plots.lines([share, even], "K", log=True, percent=True),
        ),
    ]
    return page.paragraph(text) + page.grid(figures, large=True) + _coverage_tables(report)


def _recall_line(name: str, summary: Summary, color: str) -> Line:
    recall = summary.modes.recall_at_K
    return Line(name, [int(count) for count in recall], list(recall.values()), color)


def _recall_plot(drawn: Sequence[Line]) -> str:
    return page.plot("Goals found by the first K candidates", "recall@K", plots.lines(drawn, "K", log=True))


def _coverage_tables(report: Report) -> str:
    modes = report.modes
    cells = [
        [
            f"K = {count}",
            _percent(modes.recall_at_K[count]),
            f"{100 * modes.uniform_recall_at_K[count]:.0f} %",
            f"{100 * modes.recall_share_at_K[count]:.0f} %",
            _percent(modes.all_modes_found_at_K[count]),
            f"{100 * modes.uniform_all_modes_found_at_K[count]:.0f} %",
            _percent(modes.precision_at_K[count]),
        ]
        for count in modes.recall_at_K
    ]
    head = ["", "recall", "uniform sampler", "share of it", "all goals found", "uniform sampler", "precision"]
    sweep = [
        [f"within {tau} mm", *(f"{100 * figures[name]:.0f} %" for name in figures)] for tau, figures in modes.sweep_mm.items()
    ]
    names = [name.replace("_modes_", " goals ") for name in next(iter(modes.sweep_mm.values()), {})]
    legacy = modes.legacy_rpdiff
    others = [
        ["entropy over the modes", f"{modes.entropy.value:.2f}<small>uniform sampler {modes.uniform_entropy:.2f}</small>"],
        ["RPDiff's own recall, for reference", _percent(legacy.recall)],
        ["RPDiff's own precision, for reference", _percent(legacy.precision)],
    ]
    if report.affordance is not None:
        others += [
            ["sampled affordance: overlap with the best mode", _number_interval(report.affordance.iou)],
            ["sampled affordance: share in one mode", _number_interval(report.affordance.purity)],
        ]
    tables = [page.rows(["all candidates", *names], sweep), page.rows([], others)]
    return page.rows(head, cells) + page.grid(tables, large=True)


def _geometry(methods: Mapping[str, Summary]) -> str:
    cells = [["free of collision", *(_percent(s.geometry.collision_free) for s in methods.values())]]
    cells += [[label, *(_spread(getattr(s.geometry, name)) for s in methods.values())] for name, label in GEOMETRY_ROWS.items()]
    return page.rows(["", *map(escape, methods)], cells)


def _training(entries: Sequence[Mapping[str, Any]]) -> str:
    figures = []
    for net, keys in TRAINING.items():
        for key, (name, unit) in keys.items():
            points = [(e["step"], e[key]) for e in entries if e.get("net") == net and e.get(key) is not None]
            if points:
                steps, values = zip(*points)
                about = f"{unit}{', ' if unit else ''}{'held out' if key.startswith('val_') else 'while training'}"
                line = Line(name, steps, values, plots.COLORS[0 if net == "affordance" else 1])
                figures.append(page.plot(f"{net}: {name}", about, plots.lines([line], "step", height=180)))
    return page.grid(figures)


def _cost(report: Report) -> str:
    cost = report.cost
    cells = [
        ["preparation, s a placement", _spread(cost.prepare_s)],
        ["inference, s a placement", _spread(cost.infer_s)],
        ["physics, s a placement", _spread(cost.physics_s)],
        ["parameters", "–" if cost.parameters is None else f"{cost.parameters:,}"],
        ["demonstrations used", "–" if cost.demos_used is None else f"{cost.demos_used:,}"],
        ["training, min, both networks added up", number(cost.training_minutes)],
        ["device", escape(cost.device or "–")],
        ["machine", escape(report.hardware)],
    ]
    return page.rows([], cells)


def _digests(report: Report) -> str:
    digests = report.digests
    named = {
        "predictions": digests.predictions,
        "data": digests.data,
        "recipe": digests.recipe,
        "scenes": report.split.sha256,
        **digests.weights,
    }
    cells = [[escape(name), f"<code>{escape(value)}</code>"] for name, value in named.items()]
    cells += [["judge", escape(f"{report.judge.engine}, dapdata {report.judge.dapdata}")], ["seed", str(report.seed)]]
    return page.rows([], cells)


def _percent(interval: Interval) -> str:
    low, high = interval.ci95
    return f"{100 * interval.value:.1f} %<small>{100 * low:.0f}-{100 * high:.0f}, n {interval.n}</small>"


def _number_interval(interval: Interval) -> str:
    low, high = interval.ci95
    return f"{interval.value:.2f}<small>{low:.2f}-{high:.2f}, n {interval.n}</small>"


def _spread(q: Quantiles | None) -> str:
    return "–" if q is None or q.n == 0 else f"{number(q.median)}<small>p90 {number(q.p90)}, max {number(q.max)}</small>"


# Scenes: the table, the 3-D view, the pictures ---------------------------------------------------------------


def _scenes(report: Report, material: Material, in_view: Sequence[int]) -> str:
    top = [r.verdicts[0] if r.verdicts else None for r in material.results]
    goal = [int(r.distance[0].argmin()) if r.verdicts else -1 for r in material.results]

    def figures(name: str, scale: float = 1.0) -> list[float | None]:
        return [None if v is None else scale * float(getattr(v, name)) for v in top]

    rows = report.scenes
    overlap = [None if v is None else 1000 * max(v.penetration, 0.0) for v in top]
    free = [None if g < 0 else 1000 * float(r.clearance[g]) for r, g in zip(material.results, goal)]
    off = [None if g < 0 else 1000 * float(r.distance[0, g]) for r, g in zip(material.results, goal)]
    columns = [
        Column("demo", "demo", [row.demo for row in rows], link="view-", linked=in_view),
        Column("result", "result", [_result(row) for row in rows]),
        Column("succeed", "candidates that succeed", [row.successes for row in rows], f"of {report.method.k}"),
        Column("goals", "goals", [row.modes for row in rows]),
        Column("found", "goals found", [row.modes_found for row in rows], f"by {report.method.draws} candidates"),
        Column("off", "nearest goal, mm off", off, "surface distance of the best-ranked candidate", digits=1),
        Column("clearance", "its free play, mm", free, "clearance of that goal", digits=1),
        Column("overlap", "overlap, mm", overlap, "at the predicted pose", digits=1),
        Column("moved", "moved, mm", figures("moved", 1000), "from the prediction to where it came to rest", digits=1),
        Column("turned", "turned, °", figures("turned", 180 / np.pi), "while settling", digits=1),
        Column("push", "push, N", figures("push"), "largest while moving in", digits=1),
    ]
    note = "The best-ranked candidate of each scene. A click on a head sorts"
    note += "; demos whose number is a link are in the 3-D view." if in_view else "."
    return page.paragraph(note, "soft") + page.sortable(columns, "pushed clearance<10")


def _result(row: SceneRow) -> str:
    return "success" if row.success else row.reason.replace("_", " ")


def _succeeded(result: SceneResult) -> bool:
    return bool(result.verdicts) and result.verdicts[0].success


def _views(report: Report, material: Material) -> list[dict[str, Any]]:
    """Some failures of each reason, and some successes, with the candidates in them."""
    pairs = list(zip(material.results, material.samples))
    by_reason: dict[str, list[tuple[SceneResult, Sample]]] = {}
    for result, sample in pairs:
        reason = result.verdicts[0].reason if result.verdicts else "no prediction"
        by_reason.setdefault("" if _succeeded(result) else reason, []).append((result, sample))
    done = by_reason.pop("", [])
    failed: list[tuple[SceneResult, Sample]] = []
    while by_reason and len(failed) < IN_3D[0]:  # one of each reason after the other, so that each is shown
        for reason in list(by_reason):
            failed.append(by_reason[reason].pop(0))
            if not by_reason[reason]:
                del by_reason[reason]
    return [_view(report, result, sample) for result, sample in [*failed[: IN_3D[0]], *done[: IN_3D[1]]]]


def _view(report: Report, result: SceneResult, sample: Sample) -> dict[str, Any]:
    says = [
        f"rank {rank}: {'success' if v.success else v.reason.replace('_', ' ')}"
        for rank, v in zip(result.rank, result.verdicts)
    ]
    T = result.T_world_object[: len(says)]
    ended = [v.T_world_object_end for v in result.verdicts[:1] if np.isfinite(v.T_world_object_end).all()]
    layers = [
        viewer.poses_layer("prediction", PREDICTED, T[:1], says[:1], opacity=1.0),
        viewer.poses_layer("where it came to rest", ENDED, np.array(ended).reshape(-1, 4, 4), ["came to rest"] * len(ended)),
        viewer.poses_layer("other candidates", OTHER, T[1:], says[1:], on=False, opacity=0.4),
    ]
    shown = Shown(sample, "success" if _succeeded(result) else _state(result), report.split.name)
    view = viewer.view(
        shown,
        *(layer for layer in layers if layer["poses"]),
        note=_caption(result),
        goals={"verified goals": (GOAL, 0.4)},
        most=10_000,
    )
    return view | {"name": f"demo {result.demo}: {_state(result)}"}


def _state(result: SceneResult) -> str:
    if not result.verdicts:
        return "no prediction"
    return "success" if _succeeded(result) else result.verdicts[0].reason.replace("_", " ")


def _caption(result: SceneResult) -> str:
    if not result.verdicts:
        return "no candidate has a pose"
    verdict = result.verdicts[0]
    figures = (
        f"overlap {1000 * max(verdict.penetration, 0.0):.1f} mm, nearest goal {1000 * result.distance[0].min():.0f} mm off"
    )
    push = f", pushed {verdict.push:.0f} N" if verdict.push > 0 else ""
    return f"{figures}{push}; {sum(v.success for v in result.verdicts)} of {len(result.verdicts)} candidates succeed"


def _pictures(material: Material, say: Callable[[str], None]) -> list[Section]:
    """Each failure and some successes, each as the cameras saw it and as it truly is."""
    pairs = list(zip(material.results, material.samples))
    failed = [pair for pair in pairs if not _succeeded(pair[0])]
    done = [pair for pair in pairs if _succeeded(pair[0])][:SUCCESSES_SHOWN]
    colors = {"verified goals": GOAL, "prediction": PREDICTED, "where it came to rest": ENDED}
    key = "".join(f"<span>{page.swatch(color)}{name}</span>" for name, color in colors.items())
    key = f'<p class="key"><span>Left: the observed cloud. Right: the true scene.</span>{key}</p>'
    sections = []
    for heading, chosen in ((f"Failures ({len(failed)})", failed), ("Some successes", done)):
        figures = []
        for i, (result, sample) in enumerate(chosen):
            say(f"pictures: {i + 1} of {len(chosen)} {heading.split(' (')[0].lower()}")
            figures.append(_figure(result, sample))
        sections.append(Section(heading, f'{key}<div class="scenes">{"".join(figures)}</div>' if figures else "<p>None.</p>"))
    return sections if pairs else []


def _figure(result: SceneResult, sample: Sample) -> str:
    names = ("observed cloud", "true scene")
    images = "".join(
        page.picture(pictures.file(pixels, "jpeg"), f"demo {result.demo}: {name}")
        for name, pixels in zip(names, _two_pictures(result, sample))
    )
    caption = f"demo {result.demo}: <b>{escape(_state(result))}</b>, {escape(_caption(result))}"
    return f'<figure id="demo-{result.demo}"><div>{images}</div><figcaption>{caption}</figcaption></figure>'


def _two_pictures(result: SceneResult, sample: Sample) -> tuple[Array, Array]:
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


# Curves and comparisons --------------------------------------------------------------------------------------


def curve_page(curve: Curve) -> str:
    """The page on a curve of sample efficiency."""
    asked = curve.asked
    budget = ", ".join(f"{asked.training[name]:g} {name}" for name in ("minutes", "steps") if asked.training[name] is not None)
    title = f"{asked.training['method']} on {asked.task}: sample efficiency"
    lead = (
        f"For each number of demonstrations networks of their own, trained with the same budget ({budget}) on the first so "
        f"many of the train split, and judged on the same {asked.judging['trials']} scenes of the {asked.judging['split']} "
        f"split: {asked.judging['k']} candidates each, {asked.judging['protocol']} protocol. Small figures and bands are 95 % "
        "intervals; those of scenes, not of training again."
    )
    sizes = [point.demos for point in curve.points]
    colors = dict(zip(SUCCESS_ROWS, plots.COLORS))
    drawn = [
        Line(SUCCESS_ROWS[key], sizes, [getattr(point.success, key) for point in curve.points], colors[key])
        for key in ("success_top1", "success_single", "success_tight")
    ]
    for name, figures in curve.references.items():
        if name == "heuristic" and sizes:
            level = 100 * figures.success.success_top1.value
            drawn.append(Line("heuristic, nothing learned", sizes, [level] * len(sizes), "var(--soft)", dashed=True))
    recall = [Line(f"K = {K}", sizes, [p.recall[K] for p in curve.points], plots.COLORS[i]) for i, K in enumerate(_ends(curve))]
    axis = "demonstrations learned from"
    figures_ = [
        page.plot("Placements that hold in physics", "with 95 % intervals", plots.lines(drawn, axis, log=True, height=380)),
        page.plot("Goals found by the first K candidates", "recall@K", plots.lines(recall, axis, log=True, height=380)),
    ]
    shown: list[tuple[str, Figures]] = [
        (f'<a href="curve/{point.demos}/report.html">{point.demos:,}</a>', point) for point in curve.points
    ]
    shown += [(escape(name), figures) for name, figures in curve.references.items()]
    cells = [
        [name, *(_percent(getattr(f.success, key)) for key in SUCCESS_ROWS), _percent(list(f.recall.values())[-1])]
        for name, f in shown
    ]
    head = ["demonstrations", *SUCCESS_ROWS.values(), "goals found by all candidates"]
    asked_for = page.rows([], [["dataset", escape(asked.data)], ["content_sha256", f"<code>{escape(asked.dataset)}</code>"]])
    sections = [
        Section("Sample efficiency", page.grid(figures_, large=True) if sizes else page.paragraph("No size is done yet.")),
        Section("Figures", page.rows(head, cells)),
        Section("What was asked", asked_for),
    ]
    return page.document(title, page.paragraph(lead, "sub"), sections)


def _ends(curve: Curve) -> list[str]:
    """The first, the judged and the last K, each once."""
    Ks = list(curve.points[0].recall) if curve.points else []
    return [K for K in dict.fromkeys([*Ks[:1], str(curve.asked.judging["k"]), *Ks[-1:]]) if K in Ks]


def comparison_page(path_a: Path, path_b: Path) -> str:
    """The page on two reports on the same scenes.

    Raises:
        UsageError: as `report.compare` does.
    """
    found, a, b = compare(path_a, path_b), read_report(path_a), read_report(path_b)
    reports = {f"a: {a.method.name}": a, f"b: {b.method.name}": b}
    methods = {name: _summary(report) for name, report in reports.items()}
    lead = (
        f"Two reports on the same {found['n']:,} scenes of {a.task}, {a.judge.protocol} protocol, scene by scene. p is "
        "McNemar's exact test on the scenes in which just one of the two succeeds."
    )
    tiles = {f"{name} succeeds": _tile(report.success.success_top1) for name, report in reports.items()}
    tiles["difference"] = f"{100 * found['difference']:+.1f} points", "best-ranked candidate, a - b"
    tiles["p"] = f"{found['p_value']:.2g}", "McNemar, two-sided"
    files = [[name, f"<code>{escape(str(path))}</code>"] for name, path in zip("ab", (path_a, path_b))]
    sections = [
        Section("Success", page.grid(_compared(methods, found), large=True) + _success_table(methods)),
        Section("Scenes", _compared_scenes(a, b)),
        Section("Geometry", page.paragraph("Of the best-ranked candidate.", "soft") + _geometry(methods)),
        Section("What was compared", page.rows([], files)),
    ]
    title = f"{a.method.name} and {b.method.name} on {a.task}"
    return page.document(title, page.paragraph(lead, "sub") + page.facts(tiles), sections)


def _compared(methods: Mapping[str, Summary], found: Mapping[str, Any]) -> Iterator[str]:
    yield _success_plot(methods)
    yield from _by_clearance(methods)
    counts = {"both": found["both"], "only a": found["only_a"], "only b": found["only_b"], "neither": found["neither"]}
    yield page.plot("Scenes", "by who succeeds with its best-ranked candidate", plots.bars(counts))
    (first, a), (second, b) = methods.items()
    failures = plots.bars(a.success.failures, (second, b.success.failures), name=first)
    yield page.plot("Failures by reason", "of the best-ranked candidates", failures)
    yield _recall_plot([_recall_line(name, s, color) for (name, s), color in zip(methods.items(), plots.COLORS)])


def _compared_scenes(a: Report, b: Report) -> str:
    pairs = [(x.success, y.success) for x, y in zip(a.scenes, b.scenes)]
    who = {(True, True): "both", (True, False): "a", (False, True): "b", (False, False): "neither"}
    columns = [
        Column("demo", "demo", [row.demo for row in a.scenes]),
        Column("succeeds", "who succeeds", [who[pair] for pair in pairs]),
        Column("a", "a", [_result(row) for row in a.scenes]),
        Column("b", "b", [_result(row) for row in b.scenes]),
        Column("succeed_a", "candidates of a", [row.successes for row in a.scenes], "that succeed"),
        Column("succeed_b", "candidates of b", [row.successes for row in b.scenes], "that succeed"),
        Column("goals", "goals", [row.modes for row in a.scenes]),
        Column("found_a", "found by a", [row.modes_found for row in a.scenes]),
        Column("found_b", "found by b", [row.modes_found for row in b.scenes]),
    ]
    return page.sortable(columns, "succeeds=a")
