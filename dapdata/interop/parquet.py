"""Parquet: one row a demo, for the Hugging Face viewer, `datasets`, pandas, DuckDB.

Columns are those of the index, a picture, then every array under its own path: `container/points` is a list of lists of
three floats. The schema tells `datasets` which column is a picture and which lists have what shape, so that it gives
numpy arrays of the shard's own shape, 18 times faster than as plain lists; each field also carries unit, frame,
description. Other readers see nested lists.

Row groups are small and have page indexes: the viewer refuses to scan more than 300 MB for a page of rows. Floats are
split by byte (BYTE_STREAM_SPLIT), which leaves 57 % of the bytes of clouds and is read by all Parquet readers of 2024
and later.

Source: names of extension types and metadata as datasets 5.2 writes them; names of files as its `push_to_hub` does.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from dapdata import pictures
from dapdata.card import Form
from dapdata.errors import require
from dapdata.interop.export import PLACES, Chosen, Export, Piece, Progress, Row, choose, cut, demo_name, described, readme, run
from dapdata.records import Array

SHARD_SIZE = 1000  # demos in a file
ROWS = 32  # in a row group: 4 to 30 MB
PREVIEW = "preview"
PANEL = 192, 168  # px, of each half of a preview


def export(
    dataset: str | Path,
    out: str | Path,
    *,
    split: str | None = None,
    demos: int | None = None,
    shard_size: int = SHARD_SIZE,
    previews: bool = True,
    progress: Progress | None = None,
) -> Path:
    """Writes a labelled dataset as `data/<split>-00000-of-00001.parquet`, ... and returns the folder.

    Args:
        dataset: The dataset's folder.
        out: The folder to write, see `export.run`.
        split, demos: See `export.choose`.
        shard_size: Demos in a file.
        previews: Whether each row has a picture; drawing them takes most of the time.
        progress: Called with demos done and demos in all.
    """
    if previews:
        require("matplotlib", "sim")
    chosen = choose(dataset, split, demos)
    pieces = [
        Piece(f"data/{name}-{number:05d}-of-{len(parts):05d}.parquet", numbers)
        for name, parts in cut(chosen, shard_size)
        for number, numbers in enumerate(parts)
    ]
    table = schema(chosen, previews)

    def write(piece: Piece, file: Path, rows: Iterator[Row]) -> None:
        _write(file, rows, table)

    options = {"shard_size": shard_size, "previews": previews}
    return run(out, Export("parquet", options, chosen, pieces, write, readme(chosen, _form(chosen))), progress)


def _form(chosen: Chosen) -> Form:
    """The card's words about these files."""
    splits = "\n".join(f"  - split: {name}\n    path: data/{name}-*.parquet" for name in chosen.splits)
    return Form(
        files=(
            "`data/` holds one row per demo: what is known of it; `preview` (left: the affordance on the observed cloud, red "
            "where to place; right: the true scene with all goals, the demonstrated one orange, rejected ones faint); and "
            "a column for each array below, rows of points and poses as nested lists. `export.json` names every file with its "
            "sha256."
        ),
        loader=f"""```python
from datasets import load_dataset
demos = load_dataset("parquet", data_files="data/{next(iter(chosen.splits))}-*.parquet", split="train").with_format("numpy")
points, goals = demos[0]["container/points"], demos[0]["goals/T_world_object"]
```
""",
        header=f"configs:\n- config_name: default\n  data_files:\n{splits}",
    )


# The schema ------------------------------------------------------------------------------------------------


def schema(chosen: Chosen, previews: bool) -> Any:
    """The `pyarrow.Schema` of the files, with what `datasets` wants to know of columns that are more than lists."""
    import pyarrow as pa

    index = chosen.dataset.index
    first, *others = [
        pa.field(name, pa.int64() if column.dtype.kind == "i" else pa.string())
        for name, column in index.items()
        if name not in PLACES
    ]
    picture = [pa.field(PREVIEW, pa.struct({"bytes": pa.binary(), "path": pa.string()}))] if previews else []
    features: dict[str, Any] = {PREVIEW: {"_type": "Image"}} if previews else {}
    fields = [first, *picture, *others]
    for path, about in described(chosen.dataset).items():
        kind = pa.from_numpy_dtype(about["dtype"])
        told = {name: about[name] for name in ("unit", "frame", "description")} | {"names": json.dumps(about["names"])}
        shape = [None if isinstance(size, str) else size for size in about["dims"] if size != "demo"]
        for _ in shape:
            kind = pa.list_(kind)
        if len(shape) > 1:
            value = np.dtype(about["dtype"]).name
            features[path] = {"shape": shape, "dtype": value, "_type": f"Array{len(shape)}D"}
            told["ARROW:extension:name"] = f"datasets.features.features.Array{len(shape)}DExtensionType"
            told["ARROW:extension:metadata"] = json.dumps([shape, value])
        fields.append(pa.field(path, kind, metadata=told))
    return pa.schema(fields, metadata={"huggingface": json.dumps({"info": {"features": features}})})


# The files -------------------------------------------------------------------------------------------------


def _write(file: Path, rows: Iterator[Row], table: Any) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    with pq.ParquetWriter(
        file, table, compression="zstd", write_page_index=True, use_dictionary=False, use_byte_stream_split=_floats(table)
    ) as writer:
        while group := list(islice(rows, ROWS)):
            writer.write_table(pa.Table.from_arrays([_column(field, group) for field in table], schema=table))


def _floats(table: Any) -> list[str]:
    """The columns of floats as Parquet names them."""
    import pyarrow as pa

    names = []
    for field in table:
        name, kind = field.name, field.type
        while pa.types.is_list(kind):
            name, kind = f"{name}.list.element", kind.value_type
        names += [name] if pa.types.is_floating(kind) else []
    return names


def _column(field: Any, group: Sequence[Row]) -> Any:
    """One column of a row group as a `pyarrow.Array`."""
    import pyarrow as pa

    if field.name == PREVIEW:
        shown = [{"bytes": _preview(sample), "path": f"{demo_name(about['demo'])}.png"} for about, sample in group]
        return pa.array(shown, field.type)
    if field.name in group[0][0]:
        return pa.array([about[field.name] for about, _ in group], field.type)
    return _nested([sample[field.name] for _, sample in group], field.type)


def _nested(arrays: Sequence[Array], kind: Any) -> Any:
    """Arrays that differ at most in their first dimension, as one `pyarrow.Array` of nested lists of this type."""
    import pyarrow as pa

    values = pa.array(np.concatenate([array.reshape(-1) for array in arrays]))
    for size in reversed(arrays[0].shape[1:]):
        values = pa.ListArray.from_arrays(np.arange(0, len(values) + 1, size, dtype=np.int32), values)
    if pa.types.is_list(kind):
        offsets = np.cumsum([0, *(len(array) for array in arrays)]).astype(np.int32)
        values = pa.ListArray.from_arrays(offsets, values)
    return values


def _preview(sample: Any) -> bytes:
    return pictures.file(pictures.preview(sample, *PANEL))
