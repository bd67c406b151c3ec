"""The dataset's card: a README.md that a stranger reads first, with the header that Hugging Face reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from dapdata.records import columns

HEADER = """---
license: {license}
task_categories:
- robotics
tags:
- point-cloud
- object-placement
- superpoints
- affordance
pretty_name: {name}
size_categories:
- {size}
configs:
- config_name: index
  data_files: index.parquet
---
"""
LICENSE = "cc0-1.0"  # synthetic geometry, nobody's work: the data may be used for anything
IMPORTED = "other"  # what others made is theirs
SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))

LOADER = """```python
import json, zarr
root = "."  # this folder
path = json.load(open(f"{root}/manifest.json"))["shards"][0]["path"]
g = zarr.open_group(f"{root}/{path}", mode="r")
o, i = g["container_superpoints/offsets"][:], 0
xyz, score = (g[f"container_superpoints/{k}"][o[i]:o[i+1]] for k in ("points", "affordance"))
```

or, with dapdata installed, `dapdata.open(".", split="train")[0]`, and `.torch()` or `.stream()` of it for training.
"""


def render(manifest: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], previews: Sequence[str]) -> str:
    """The card as Markdown.

    Args:
        manifest: As JSON data.
        rows: Of the index; empty before the dataset is labelled.
        previews: Paths of pictures.
    """
    size = next((text for limit, text in SIZES if len(rows) < limit), "n>1M")
    parts = [
        HEADER.format(license=IMPORTED if _source(manifest) else LICENSE, name=manifest["name"], size=size)
        + f"# {manifest['name']}\n",
        _what(manifest, rows),
        "\n".join(f"![{path}]({path})" for path in previews),
        _splits(manifest),
        _rejects(manifest["rejects"]),
        f"## Read it\n\n{LOADER}" if rows else "No shards yet: run `dapdata label` on this folder.\n",
        _arrays(),
        _how(manifest),
    ]
    return "\n".join(part for part in parts if part)


def _source(manifest: Mapping[str, Any]) -> str | None:
    """Where the demos were imported from; None if they were drawn."""
    source: str | None = manifest["recipe"]["scene"].get("source")
    return source


def _what(manifest: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> str:
    source = _source(manifest)
    by = f"imported by dapdata from `{source}`, where others made them" if source else "made in simulation by dapdata"
    asked = f"Demonstrations of placing an object into a container, task `{manifest['task']}`, {by}"
    if not rows:
        return f"{asked}: {manifest['demos']} demos, not yet labelled.\n"
    names = ("goals", "container_points", "object_points", "superpoints", "positives", "correspondences")
    lines = [f"| {name.replace('_', ' ')} | {_mean(rows, name):.1f} |" for name in names]
    count = f"{len(rows)} demos of {manifest['demos']} asked for, in {len(manifest['shards'])} shards"
    return "\n".join([f"{asked}: {count}.\n", "| a demo has on average | |", "|---|---|", *lines, ""])


def _mean(rows: Sequence[Mapping[str, Any]], name: str) -> float:
    return float(sum(row[name] for row in rows)) / len(rows)


def _splits(manifest: Mapping[str, Any]) -> str:
    if not manifest["splits"]:
        return ""
    lines = [
        f"| {name} | {entry['demos']} | {len(entry['container_instances'])} | {len(entry['object_instances'])} |"
        for name, entry in manifest["splits"].items()
    ]
    proof = (
        "No container instance (digest of the geometry of container and clutter) and no object instance is in two splits; "
        "the instances of each stand in `manifest.json`, and `dapdata verify` fails on any overlap."
    )
    table = ["| split | demos | container instances | object instances |", "|---|---|---|---|"]
    return "\n".join(["## Splits\n", *table, *lines, "", proof, ""])


def _rejects(rejects: Mapping[str, Mapping[str, int]]) -> str:
    words = {
        "attempts": "scenes given up (another was drawn instead)",
        "demos": "demos left out of the shards",
        "goals": "candidate goals that did not hold (kept in `rejected_goals/`)",
    }
    lines = [f"| {words[what]} | {reason} | {count} |" for what, counts in rejects.items() for reason, count in counts.items()]
    return "\n".join(
        ["## What was rejected\n", "| what | reason | count |", "|---|---|---|", *(lines or ["| nothing | | |"]), ""]
    )


def _arrays() -> str:
    """The table of arrays, from the one that shards are written by."""
    lines = [
        "## Arrays\n",
        "Each shard is a Zarr v3 group. Ragged arrays hold the rows of all demos one after another; demo `d` is rows "
        "`offsets[d]` to `offsets[d + 1]` of its group. `T_a_b` maps b-coordinates to a. World frame: right-handed, z up.\n",
        "| array | dtype | rows | unit | frame | what |",
        "|---|---|---|---|---|---|",
    ]
    for column in columns():
        about = column.metadata
        shape = " x ".join(str(dim) for dim in about["dims"])
        codes = f" ({', '.join(f'{i} {name}' for i, name in enumerate(about['names']))})" if about["names"] else ""
        cells = [f"`{about['path']}`", about["dtype"].lstrip("<|"), shape, about["unit"], about["frame"]]
        lines.append(f"| {' | '.join(cells)} | {about['description']}{codes} |")
    return "\n".join([*lines, ""])


def _how(manifest: Mapping[str, Any]) -> str:
    recipe = manifest["recipe"]
    lines = ["## How it was made\n"]
    for name, entry in manifest["stages"].items():
        if not entry["units"]:
            continue
        spec, sections = entry["spec"], ", ".join(sorted(entry["spec"]["sections"]))
        versions = ", ".join(f"{package} {number}" for package, number in sorted(spec["packages"].items()))
        lines.append(f"- `{name}` version {spec['version']} ({versions}), recipe sections {sections}")
    lines += [
        "",
        f"Seed {recipe['seed']}. The whole recipe, every default filled in, is in `manifest.json`; with it and the versions "
        f"above the same bytes come out again. Content digest: `{manifest['content_sha256']}`.",
        "",
        "Licence and citation: those of the demos' makers." if _source(manifest) else f"Licence: {LICENSE}.",
        "",
    ]
    return "\n".join(lines)
