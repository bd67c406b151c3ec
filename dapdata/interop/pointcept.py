"""Pointcept: the folders of .npy files that its DefaultDataset reads, a scene a demo.

A scene is the container's cloud followed by the object's at its start pose, both as observed, in the world frame: `coord`
(m), `normal`, and as `segment` the class of each point (CLASSES). There is no `color`: depth cameras see none, so a model's
`feat_keys` are ("coord", "normal"). Beside them are `superpoint` (counted on from the container's to the object's) and
`affordance` (of the point's superpoint, -1 to 1; NaN on the object), which DefaultDataset leaves alone: they are labels,
and must not become features by mistake.

Source: Pointcept, DefaultDataset: names of files, split folders, ignored label -1.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dapdata import durable
from dapdata.card import Form
from dapdata.interop.export import Export, Piece, Progress, Row, by_demo, choose, readme, run
from dapdata.records import Array
from dapdata.store import Sample

CLASSES = ("container", "place_here", "object")  # place_here: points of superpoints with an affordance above 0


def export(
    dataset: str | Path,
    out: str | Path,
    *,
    split: str | None = None,
    demos: int | None = None,
    progress: Progress | None = None,
) -> Path:
    """Writes the clouds of a labelled dataset as `<split>/demo_000000/coord.npy`, ... and returns the folder.

    Args:
        dataset: The dataset's folder.
        out: The folder to write, see `export.run`.
        split, demos: See `export.choose`.
        progress: Called with demos done and demos in all.
    """
    chosen = choose(dataset, split, demos)
    files = readme(chosen, _form(next(iter(chosen.splits)))) | {"classes.json": durable.canonical(CLASSES)}
    return run(out, Export("pointcept", {}, chosen, by_demo(chosen), _write, files), progress)


def arrays(sample: Sample) -> dict[str, Array]:
    """The files of a scene by name, without `.npy`: N points of the container, then M of the object."""
    superpoint = sample["container/superpoint"]
    affordance = sample["container_superpoints/affordance"][superpoint]
    count = len(sample["container_superpoints/size"])
    others = len(sample["object/points"])
    return {
        "coord": np.concatenate([sample["container/points"], sample["object/points"]]),  # (N + M, 3) f4, m
        "normal": np.concatenate([sample["container/normals"], sample["object/normals"]]),  # (N + M, 3) f4
        "segment": np.concatenate([affordance > 0, np.full(others, CLASSES.index("object"))]).astype(np.int32),  # (N + M,)
        "superpoint": np.concatenate([superpoint, count + sample["object/superpoint"]]),  # (N + M,) i4
        "affordance": np.concatenate([affordance, np.full(others, np.nan, np.float32)]),  # (N + M,) f4
    }


def _write(piece: Piece, folder: Path, rows: Iterator[Row]) -> None:
    folder.mkdir()
    for _, sample in rows:
        for name, array in arrays(sample).items():
            np.save(folder / f"{name}.npy", array, allow_pickle=False)


def _form(split: str) -> Form:
    """The card's words about these files."""
    classes = ", ".join(f"{i} {name}" for i, name in enumerate(CLASSES))
    return Form(
        files=(
            "A folder for each demo, in one for each split, as Pointcept's `DefaultDataset` reads them: `coord.npy` (m, world "
            f"frame; the container's points, then the object's), `normal.npy`, `segment.npy` ({classes}). Beside them, "
            "`superpoint.npy` and `affordance.npy` are labels that it does not read."
        ),
        loader=f"""```python
from pointcept.datasets import DefaultDataset
demo = DefaultDataset(split="{split}", data_root=".").get_data(0)  # coord, normal, segment
```
""",
        has_arrays=False,
    )
