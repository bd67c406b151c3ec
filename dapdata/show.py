"""Pictures of a dataset: a contact sheet (PNG), the previews of its card, and one HTML file with a 3-D view.

What is drawn is decided in `pictures` (panels, sheets) and `viewer` (HTML), how in `draw` (points and solids in
numpy). Those three know samples only; this file chooses them from a dataset and writes the results.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dapdata import errors, loading
from dapdata.pictures import Shown, panels, png, sheet
from dapdata.remote import Place
from dapdata.viewer import page

STATISTICS_DEMOS = 300  # statistics in the HTML are taken over at most this many demos, spread evenly


def choose(dataset: Place, demos: Sequence[int] | None = None, count: int = 4) -> list[Shown]:
    """Some demos of a dataset: those asked for by their number, or `count` of them spread over it evenly.

    Raises:
        UsageError: a demo that the dataset does not have.
    """
    found = loading.open(dataset)
    numbers = {int(demo): i for i, demo in enumerate(found.index["demo"])}
    if demos is None:
        wanted = np.unique(np.linspace(0, len(found) - 1, min(count, len(found))).astype(int)).tolist()
    else:
        missing = [demo for demo in demos if demo not in numbers]
        if missing:
            raise errors.UsageError(
                f"{dataset}: demo {missing[0]} is not in it, expected one of {min(numbers)} to {max(numbers)}; "
                f"see `dapdata inspect {dataset}`"
            )
        wanted = [numbers[demo] for demo in demos]
    return [Shown(found[i], str(found.index["task"][i]), str(found.index["split"][i])) for i in wanted]


def contact_sheet(dataset: Place, out: Path | None = None, demos: Sequence[int] | None = None, count: int = 4) -> Path:
    """Writes a contact sheet of a dataset and returns its path (default: `<dataset's name>.png` here).

    Args:
        dataset: A dataset's folder or URL.
        out: The PNG to write.
        demos: Numbers of the demos to show; default: `count` of them, spread evenly over the splits.
        count: How many, when `demos` is not given.
    """
    about = loading.open(dataset).manifest
    out = out or Path(f"{about.name}.png")
    picture = sheet(choose(dataset, demos, count), about.name)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(picture)
    return out


def preview(dataset: Place) -> dict[str, bytes]:
    """The two small pictures (PNG) of a dataset's card by their path in the dataset, made from its first demo."""
    sample = choose(dataset, count=1)[0].sample
    pictures = panels(sample, float(sample["container/points"][:, 2].max()))
    wanted = {"clouds": ("cloud", "superpoints"), "goals": ("affordance", "goals")}
    return {
        f"preview/{name}.png": png(np.concatenate([pictures[part] for part in parts], axis=1)) for name, parts in wanted.items()
    }


def show_html(dataset: Place, out: Path | None = None, demos: Sequence[int] | None = None, count: int = 4) -> Path:
    """Writes one self-contained HTML page about a dataset and returns its path (default: `<dataset's name>.html` here).

    Arguments as in `contact_sheet`. The page loads nothing from a network.
    """
    about = loading.open(dataset).manifest
    out = out or Path(f"{about.name}.html")
    shown, others = choose(dataset, demos, count), choose(dataset, count=STATISTICS_DEMOS)
    text = page(about, shown, others, sheet(shown, about.name))
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text, encoding="utf-8")
    return out
