"""The JSON Schemas of what dapdata reads and writes: recipe, manifest, shard, report.

Each is made from the models or the table of records. `schemas/*.schema.json` are copies, made by `make schemas`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from dapdata.errors import UsageError, hint
from dapdata.records import RECORDS, Meshes, columns, is_ragged

KINDS = ("recipe", "manifest", "shard", "report")
DIALECT = "https://json-schema.org/draft/2020-12/schema"


def schema(kind: str) -> dict[str, Any]:
    """The JSON Schema of one of `KINDS`.

    Raises:
        UsageError: for any other kind.
    """
    if kind == "recipe":
        from dapdata.recipe import json_schema

        return json_schema()
    if kind == "manifest":
        from pydantic import TypeAdapter

        from dapdata.manifest import LargeManifest, Manifest

        return {"$schema": DIALECT, **TypeAdapter(Manifest | LargeManifest).json_schema()}
    if kind == "report":
        from dapdata.report import json_schema as report_schema

        return report_schema()
    if kind == "shard":
        return shard_schema()
    raise UsageError(f"schema: got '{kind}', expected one of {', '.join(KINDS)}{hint(kind, list(KINDS))}")


def shard_schema() -> dict[str, Any]:
    """The schema of {path of an array: its zarr.json} for all arrays of a shard."""
    arrays: dict[str, Any] = {}
    for column in columns(*RECORDS, Meshes):
        arrays[column.metadata["path"]] = _array_schema(column.metadata)
        if is_ragged(column):
            arrays.setdefault(f"{column.metadata['path'].split('/')[0]}/offsets", _offsets_schema())
    of_meshes = {column.metadata["path"].split("/")[0] for column in columns(Meshes)}
    return {
        "$schema": DIALECT,
        "title": "Shard",
        "description": "The arrays of a shard, a Zarr v3 group: path of each array -> its zarr.json.",
        "type": "object",
        "properties": dict(sorted(arrays.items())),
        "required": sorted(path for path in arrays if path.split("/")[0] not in of_meshes),
        "additionalProperties": False,
    }


def _array_schema(about: Any) -> dict[str, Any]:
    """The schema of one array's zarr.json; the first dimension counts rows, the others are fixed."""
    attributes = {name: {"const": about[name]} for name in ("unit", "frame", "description")}
    if about["names"]:
        attributes["names"] = {"const": list(about["names"])}
    return _zarr_schema(np.dtype(about["dtype"]).name, str(about["dims"][0]), about["dims"][1:], attributes)


def _offsets_schema() -> dict[str, Any]:
    return _zarr_schema("int64", "demo_edge", (), {"unit": {"const": "1"}})


def _zarr_schema(dtype: str, rows: str, fixed: tuple[int, ...], attributes: dict[str, Any]) -> dict[str, Any]:
    shape = [{"type": "integer", "minimum": 0, "description": f"number of rows: {rows}"}, *({"const": size} for size in fixed)]
    return {
        "description": str(attributes.get("description", {}).get("const", "where each demo's rows begin and end")),
        "type": "object",
        "properties": {
            "zarr_format": {"const": 3},
            "node_type": {"const": "array"},
            "data_type": {"const": dtype},
            "shape": {"type": "array", "prefixItems": shape, "minItems": len(shape), "maxItems": len(shape)},
            "dimension_names": {
                "type": "array",
                "prefixItems": [{"const": rows}],
                "minItems": len(shape),
                "maxItems": len(shape),
            },
            "attributes": {"type": "object", "properties": attributes, "required": sorted(attributes)},
        },
        "required": ["zarr_format", "node_type", "data_type", "shape", "dimension_names", "attributes"],
    }
