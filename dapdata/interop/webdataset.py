"""WebDataset: tar files with one sample a demo, to be streamed in order.

A sample is `<key>.json`, what the index tells of the demo and its single numbers, and an `.npy` for each array, named
after its path with dots: `container/points` is `<key>.container.points.npy`. Names are in lower case, because the
webdataset library reads them so whatever they are (`pose.t_world_object_goal.npy`), and other readers don't.

Source: names and grouping as in webdataset 1.0 (a key ends at the first dot).
"""

from __future__ import annotations

import io
import tarfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dapdata import durable
from dapdata.card import Form
from dapdata.interop.export import Chosen, Export, Piece, Progress, Row, choose, cut, demo_name, readme, run
from dapdata.records import Array

SHARD_SIZE = 500  # demos: 70 to 500 MB, as cameras have it; fewer and larger files stream better


def export(
    dataset: str | Path,
    out: str | Path,
    *,
    split: str | None = None,
    demos: int | None = None,
    shard_size: int = SHARD_SIZE,
    progress: Progress | None = None,
) -> Path:
    """Writes a labelled dataset as `<split>-000000.tar`, ... and returns the folder.

    Args:
        dataset: The dataset's folder.
        out: The folder to write, see `export.run`.
        split, demos: See `export.choose`.
        shard_size: Demos in a tar file.
        progress: Called with demos done and demos in all.
    """
    chosen = choose(dataset, split, demos)
    pieces = [
        Piece(f"{name}-{number:06d}.tar", numbers)
        for name, parts in cut(chosen, shard_size)
        for number, numbers in enumerate(parts)
    ]
    plan = Export("webdataset", {"shard_size": shard_size}, chosen, pieces, _write, readme(chosen, _form(chosen, pieces)))
    return run(out, plan, progress)


def member_name(path: str) -> str:
    """The name of an array in a sample, after the key and a dot."""
    return f"{path.replace('/', '.')}.npy".lower()


def _write(piece: Piece, file: Path, rows: Iterator[Row]) -> None:
    with tarfile.open(file, "w", format=tarfile.USTAR_FORMAT) as tar:
        for about, sample in rows:
            key = demo_name(about["demo"])
            numbers = {path: array.item() for path, array in sample.items() if not array.ndim}
            _add(tar, f"{key}.json", durable.canonical(about | numbers))
            for path, array in sample.items():
                if array.ndim:
                    _add(tar, f"{key}.{member_name(path)}", _npy(array))


def _add(tar: tarfile.TarFile, name: str, data: bytes) -> None:
    """Adds a member that tells nothing of when and by whom it was made."""
    about = tarfile.TarInfo(name)
    about.size = len(data)
    tar.addfile(about, io.BytesIO(data))


def _npy(array: Array) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
    return buffer.getvalue()


def _form(chosen: Chosen, pieces: list[Piece]) -> Form:
    """The card's words about these files."""
    first = next(iter(chosen.splits))
    last = sum(piece.path.startswith(f"{first}-") for piece in pieces) - 1
    return Form(
        files=(
            "The tar files hold one sample a demo: a `json` with what is known of it, and an `npy` for each array below, named "
            "after its path with dots and in lower case, such as `container.points.npy`. `export.json` names every file with "
            "its sha256, and every array with its unit and frame."
        ),
        loader=f"""```python
import webdataset as wds
for sample in wds.WebDataset("{first}-{{000000..{last:06d}}}.tar", shardshuffle=False).decode():
    points, affordance = sample["container.points.npy"], sample["container_superpoints.affordance.npy"]
```
""",
        header="viewer: false",  # it guesses types from five samples, and empty arrays have none
    )
