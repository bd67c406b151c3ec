"""Pictures of a dataset: a contact sheet (PNG), the previews of its card, and one HTML page with a 3-D view.

What is drawn is decided in `pictures` (panels, sheets), `viewer` (the 3-D view) and `plots`; how pages look in `page`. Those
know samples only; this file chooses them from a dataset and writes the results.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import errors, loading, page, plots, records, viewer
from dapdata.loading import Dataset
from dapdata.page import Column, Section
from dapdata.pictures import Shown, file, panels, sheet
from dapdata.remote import Place

Array = NDArray[Any]

TABLE_DEMOS = 20_000  # the table lists at most this many, spread evenly
STATISTICS = (
    "goals/kind",
    "goals/clearance",
    "scene/kind",
    "container_superpoints/size",
    "container_superpoints/affordance",
    "container/superpoint",
)


def choose(dataset: Place, demos: Sequence[int] | None = None, count: int = 4) -> list[Shown]:
    """Some demos of a dataset: those asked for by their number, or `count` of them spread over it evenly.

    Raises:
        UsageError: a demo that the dataset does not have, or a dataset without demos.
    """
    found = loading.open(dataset)
    numbers = {int(demo): i for i, demo in enumerate(found.index["demo"])}
    if not numbers:
        raise errors.UsageError(f"{dataset}: holds no demo, expected at least 1 to show; see `dapdata inspect {dataset}`")
    if demos is None:
        wanted = _spread(len(found), count).tolist()
    else:
        missing = [demo for demo in demos if demo not in numbers]
        if missing:
            raise errors.UsageError(
                f"{dataset}: demo {missing[0]} is not in it, expected one of {min(numbers)} to {max(numbers)}; "
                f"see `dapdata inspect {dataset}`"
            )
        wanted = [numbers[demo] for demo in demos]
    return [Shown(found[i], str(found.index["task"][i]), str(found.index["split"][i])) for i in wanted]


def _spread(number: int, most: int) -> Array:
    """At most so many of `number` rows, spread evenly."""
    return np.unique(np.linspace(0, number - 1, min(most, number)).astype(int))


def contact_sheet(dataset: Place, out: Path | None = None, demos: Sequence[int] | None = None, count: int = 4) -> Path:
    """Writes a contact sheet of a dataset and returns its path (default: `<dataset's name>.png` here).

    Args:
        dataset: A dataset's folder or URL.
        out: The PNG to write.
        demos: Numbers of the demos to show; default: `count` of them, spread evenly over the splits.
        count: How many, when `demos` is not given.
    """
    about = loading.open(dataset).manifest
    return _write(out or Path(f"{about.name}.png"), sheet(choose(dataset, demos, count), about.name))


def preview(dataset: Place) -> dict[str, bytes]:
    """The two small pictures (PNG) of a dataset's card by their path in the dataset, made from its first demo."""
    sample = choose(dataset, count=1)[0].sample
    pictures = panels(sample, float(sample["container/points"][:, 2].max()))
    wanted = {"clouds": ("cloud", "superpoints"), "goals": ("affordance", "goals")}
    return {
        f"preview/{name}.png": file(np.concatenate([pictures[part] for part in parts], axis=1))
        for name, parts in wanted.items()
    }


def show_html(dataset: Place, out: Path | None = None, demos: Sequence[int] | None = None, count: int = 4) -> Path:
    """Writes one self-contained HTML page about a dataset and returns its path (default: `<dataset's name>.html` here).

    Arguments as in `contact_sheet`. The page loads nothing from a network.
    """
    found = loading.open(dataset)
    shown = choose(dataset, demos, count)
    return _write(out or Path(f"{found.manifest.name}.html"), dataset_page(found, shown).encode())


def show_rerun(dataset: Place, out: Path | None = None, demos: Sequence[int] | None = None, count: int = 4) -> Path | None:
    """Shows demos of a dataset in the rerun viewer, or writes them to `out`, an .rrd file, and returns its path.

    Arguments as in `contact_sheet`; raises as `live.stream` does.
    """
    from dapdata import live

    live.stream(choose(dataset, demos, count), loading.open(dataset).manifest.name, out)
    return out


def _write(out: Path, content: bytes) -> Path:
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(content)
    return out


# The page of a dataset ---------------------------------------------------------------------------------------


def dataset_page(found: Dataset, shown: Sequence[Shown]) -> str:
    """The HTML of a dataset's page, with `shown` in its 3-D view and its contact sheet."""
    about, statistics = found.manifest, _statistics(found)
    views = [viewer.view(s) for s in shown]
    lead = page.paragraph(f"Placement demonstrations of task {about.task}. Metres, world frame, z up.", "sub")
    return page.document(
        about.name,
        lead + page.facts(_facts(found, statistics)),
        [
            Section("In 3-D", viewer.widget(views)),
            Section("Statistics", page.grid(_plots(found, statistics))),
            Section("Demos", _table(found, statistics, [view["demo"] for view in views])),
            Section("Contact sheet", page.picture(sheet(shown, about.name, "jpeg"), "a row a demo", "sheet")),
            Section("Where it comes from", _origin(found)),
        ],
    )


def _statistics(found: Dataset) -> dict[str, Array]:
    """What index.parquet does not tell: of each demo the number of parts, the share of superpoints near the demonstrated
    goal, the least and largest free play; of each goal its kind and free play; in the demos' order."""
    parts, near, least, most, kinds, clearance = ([] for _ in range(6))
    for shard in dict.fromkeys(found.index["shard"].tolist()):
        block = found.block(shard, STATISTICS)
        for row in found.index["row"][found.index["shard"] == shard]:
            sample = block.sample(int(row))
            parts.append(len(sample["scene/kind"]))
            near.append(float((sample["container_superpoints/affordance"] > 0).mean()))
            free = sample["goals/clearance"] * 1000
            least.append(free.min())
            most.append(free.max())
            kinds.append(sample["goals/kind"])
            clearance.append(free)
    return {
        "parts": np.array(parts),
        "near": np.array(near),
        "least": np.array(least),
        "most": np.array(most),
        "kinds": np.concatenate([np.zeros(0, int), *kinds]),
        "clearance": np.concatenate([np.zeros(0), *clearance]),
    }


def _facts(found: Dataset, statistics: Mapping[str, Array]) -> dict[str, str | tuple[str, str]]:
    about, index = found.manifest, found.index
    missing = sum(about.rejects.demos.values())
    splits = Counter(index["split"].tolist())

    def median(name: str) -> str:
        return f"{np.median(index[name]):,.0f}"

    return {
        "demos": (f"{len(found):,}", f"{missing:,} of {about.demos:,} are missing" if missing else "as many as asked for"),
        "demos to train on": (f"{splits['train']:,}", f"{splits['val']:,} val, {splits['test']:,} test"),
        "valid goals, median": (median("goals"), f"{len(statistics['kinds']):,} in all"),
        "container points, median": median("container_points"),
        "object points, median": median("object_points"),
        "superpoints, median": (median("superpoints"), f"{median('object_superpoints')} of the object"),
        "shards": (f"{len(about.shards):,}", f"{sum(shard.bytes for shard in about.shards) / 1e6:,.0f} MB"),
    }


def _plots(found: Dataset, statistics: Mapping[str, Array]) -> Iterator[str]:
    about, index = found.manifest, found.index
    splits = Counter(index["split"].tolist())
    yield page.plot("Demos", "by split", plots.bars({name: splits[name] for name in splits}))
    kinds = Counter(records.GOAL_KINDS[kind] for kind in statistics["kinds"].tolist())
    yield page.plot("What valid goals rest on", "goals", plots.bars(dict(kinds.most_common())))
    rejects = about.rejects
    for name, unit, counts in (
        ("Rejected candidate goals", "by reason", rejects.goals),
        ("Rejected scenes", "by reason; another was drawn", rejects.attempts),
        ("Missing demos", "by reason", rejects.demos),
    ):
        yield page.plot(name, unit, plots.bars(dict(Counter(counts).most_common())))
    for name, unit, values in (
        ("Valid goals", "per demo", index["goals"]),
        ("Rejected candidate goals", "per demo", index["rejected_goals"]),
        ("Free play at valid goals", "mm, tightest horizontal direction", statistics["clearance"]),
        ("Superpoints with affordance above 0", "%, per demo", statistics["near"] * 100),
        ("Correspondences", "per demo", index["correspondences"]),
        ("Container points", "per demo", index["container_points"]),
        ("Object points", "per demo", index["object_points"]),
        ("Parts", "of container and clutter, per demo", statistics["parts"]),
        ("Scenes drawn", "per accepted demo", index["attempts"]),
    ):
        yield page.plot(name, unit, plots.histogram(values))


def _table(found: Dataset, statistics: Mapping[str, Array], in_view: Sequence[int]) -> str:
    rows = _spread(len(found), TABLE_DEMOS)
    values = {
        name: column[rows].tolist() for name, column in {**found.index, **statistics}.items() if len(column) == len(found)
    }
    instances = {name: [f"{value:016x}"[:8] for value in values[f"{name}_instance"]] for name in ("container", "object")}
    columns = [
        Column("demo", "demo", values["demo"], link="view-", linked=in_view),
        Column("split", "split", values["split"]),
        Column("goals", "goals", values["goals"]),
        Column("rejected", "rejected", values["rejected_goals"], "candidate goals that did not hold"),
        Column("tightest", "tightest goal, mm", values["least"], "free play at the tightest valid goal", digits=1),
        Column("roomiest", "roomiest, mm", values["most"], "free play at the roomiest valid goal", digits=1),
        Column("points", "points", values["container_points"], "of the container"),
        Column("object_points", "object points", values["object_points"]),
        Column("superpoints", "superpoints", values["superpoints"], "of the container"),
        Column("positives", "near the goal", values["positives"], "superpoints with affordance above 0"),
        Column("corr", "correspondences", values["correspondences"]),
        Column("parts", "parts", values["parts"], "of container and clutter"),
        Column("attempts", "scenes drawn", values["attempts"]),
        Column("container", "container", instances["container"], "start of the instance's digest"),
        Column("object", "object", instances["object"], "start of the instance's digest"),
    ]
    if len(set(values["task"])) > 1:
        columns.insert(1, Column("task", "task", values["task"]))
    shown = "" if len(rows) == len(found) else f" {len(rows):,} of {len(found):,} demos, spread evenly."
    note = f"A click on a head sorts; demos whose number is a link are in the 3-D view above.{shown}"
    return page.paragraph(note, "soft") + page.sortable(columns, "test goals>3 tightest<10")


def _origin(found: Dataset) -> str:
    about = found.manifest
    made = ", ".join(f"{name} {version}" for name, version in about.created_by.items()) or "unknown"
    recipe = json.dumps(about.recipe, indent=1)
    return (
        page.rows(["", ""], [["content_sha256", f"<code>{escape(about.content_sha256)}</code>"], ["made by", escape(made)]])
        + f"<details><summary>Recipe, resolved</summary><pre>{escape(recipe)}</pre></details>"
    )
