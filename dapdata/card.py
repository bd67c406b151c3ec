"""The dataset's card: a README.md that a stranger reads first, with the header that Hugging Face reads.

It holds nothing that does not follow from the manifest and the index, so the same dataset has the same card. Exports
carry the same card with what is particular to their files, a `Form`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import Field, dataclass
from typing import Any

import numpy as np

from dapdata.records import RECORDS, Array, Meshes, columns, is_ragged
from dapdata.split import SPLITS, UNUSED, distinct

LICENSE = "cc0-1.0"  # synthetic geometry, nobody's work: the data may be used for anything
LICENSE_URL = "https://creativecommons.org/publicdomain/zero/1.0/"
TAGS = ("dapdata", "point-cloud", "object-placement", "superpoints", "affordance")
SIZES = ((1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"))
COUNTS = ("goals", "container_points", "object_points", "superpoints", "positives", "correspondences")


@dataclass(frozen=True)
class Form:
    """What a card says of the files beside it; the rest is the same for shards and for exports."""

    files: str  # Markdown: what is where
    loader: str  # Markdown: how to read it
    header: str = ""  # YAML: which files the hub's viewer shows
    has_arrays: bool = True  # whether the files hold the shards' arrays


SHARDS = Form(
    files=(
        "Each shard, named by `manifest.json`, is a Zarr v3 group. Ragged arrays hold the rows of all demos one after another; "
        "demo `d` is rows `offsets[d]` to `offsets[d + 1]` of its group. `index.parquet` has one row per demo."
    ),
    loader="""With zarr and numpy alone:

```python
import json, zarr
path = json.load(open("manifest.json"))["shards"][0]["path"]
g = zarr.open_group(path, mode="r")
o, i = g["container_superpoints/offsets"][:], 0
xyz, score = (g[f"container_superpoints/{k}"][o[i]:o[i+1]] for k in ("points", "affordance"))
```

or, with dapdata installed, `dapdata.open(".", split="train")[0]`, and `.torch()` or `.stream()` of it for training.
""",
    header="configs:\n- config_name: index\n  data_files: index.parquet",
)

FRAMES = """## Units and frames

- Metres, radians, kilograms, seconds. Poses are 4x4 matrices, float64; clouds are float32.
- `T_a_b` maps b-coordinates to a: `p_a = T_a_b @ p_b`.
- World: right-handed, z up, z = 0 on the table top. Clouds are in the world frame, as observed.
- Container: z up, origin at the centre of its footprint, on the underside. Object: origin at the centre of its bounding
  box, z up at a goal. Cameras: OpenCV axes (x right, y down, z ahead).
"""

LIMITS = """## Limits

- {}
- Containers and what stands in them do not move; there is one object, and no gripper or arm.
- The labels belong to the demonstrated goal, which is one of several; the others are in `goals/`.
"""

DAP = """@article{chang2024dap,
  title   = {{DAP}: Diffusion-based Affordance Prediction for Multi-modality Storage},
  author  = {Chang, Haonan and Boyalakuntla, Kowndinya and Liu, Yuhan and Zhang, Xinyu and Schramm, Liam and
             Boularias, Abdeslam},
  journal = {arXiv preprint arXiv:2409.00499},
  year    = {2024}
}"""


@dataclass(frozen=True)
class Origin:
    """What is told of how the demos came about."""

    made: str  # after "Demonstrations of placing an object into a container"
    holds: str  # what each of them has, besides its labels
    does: Mapping[str, str]  # what a stage did; stages of other names are listed without a word
    limits: str
    needs: str  # what it takes to make them again, besides the recipe
    license: str  # as the hub calls it
    license_url: str  # "" where nobody here knows it
    licence: str  # a sentence
    tags: tuple[str, ...]
    collection: tuple[str, str, str]  # Croissant's: how, of what type, what may be personal in it


DRAWN = Origin(
    made="made in simulation",
    holds="noisy point clouds of container and object, superpoints, every goal that holds in physics",
    does={
        "demonstrate": (
            "draws a scene, settles the object at every candidate goal, shakes the container and moves the object in"
        ),
        "observe": "looks at container and object with noisy depth cameras and fuses what they see",
    },
    limits=(
        "Everything is synthetic: scenes are drawn from the ranges of a recipe and consist of ideal solids without texture,\n"
        "  and depth noise is modelled, not recorded. How far a method trained on it carries over to real scans is not shown\n"
        "  by the data itself."
    ),
    needs="",
    license=LICENSE,
    license_url=LICENSE_URL,
    licence=f"[{LICENSE}]({LICENSE_URL}): use it for anything.",
    tags=("synthetic",),
    collection=(
        "Drawn from a recipe, settled in a physics simulator, observed by simulated depth cameras.",
        "Software Collection",
        "None: nothing in it was recorded.",
    ),
)


def origin(manifest: Mapping[str, Any]) -> Origin:
    """What is told of how the demos of a dataset came about: drawn, or imported from the source that its recipe names."""
    source = manifest["recipe"]["scene"].get("source")
    if source is None:
        return DRAWN
    return Origin(
        made=f"imported from `{source}`, where others made them,",
        holds="point clouds of container and object, superpoints, the goals that are known",
        does={
            "demonstrate": "reads poses, and settles and checks goals again where there is geometry",
            "observe": "reads the clouds and fuses them; nothing is added",
        },
        limits="What was recorded or simulated, and how, is for the makers of the source to say; nothing is known of it here.",
        needs=" and the source",
        license="other",
        license_url="",
        licence="That of the source; cite its makers.",
        tags=("imported",),
        collection=(
            "Imported from files that others made.",
            "Others",
            "Nothing is known here of what was recorded.",
        ),
    )


def stored(manifest: Mapping[str, Any]) -> Iterator[Field[Any]]:
    """The arrays of a dataset's shards: all that every dataset has, and the triangles of one that may have meshes."""
    return columns(*RECORDS, Meshes) if "meshes" in manifest["recipe"]["scene"] else columns()


def render(
    manifest: Mapping[str, Any],
    stages: Mapping[str, Mapping[str, Any]],
    demos: int,
    index: Mapping[str, Array],
    previews: Sequence[str],
    form: Form = SHARDS,
) -> str:
    """The card as Markdown.

    Args:
        manifest: As JSON data; its shards and stages are not looked at.
        stages: The spec of each stage whose units are there.
        demos: How many are in the shards; 0 before the dataset is labelled.
        index: Its columns, of the demos that are beside the card; empty before the dataset is labelled.
        previews: Paths of pictures.
        form: What is particular to the files.
    """
    parts = [
        _header(manifest, index, form),
        f"# {manifest['name']}\n\n{summary(manifest, demos, _here(index))}\n",
        "".join(f"![{_alt(path)}]({path})\n" for path in previews),
        *([f"## Read it\n\n{form.loader}", _averages(index), _splits(index)] if index else [UNLABELLED]),
        _rejects(manifest["rejects"], manifest["missing"]),
        FRAMES,
        f"## Files\n\n{form.files}\n",
        *([f"## Arrays\n\n{_table(ARRAYS_HEAD, _arrays(manifest))}"] if form.has_arrays else []),
        _how(manifest, stages),
        LIMITS.format(origin(manifest).limits),
        f"## Licence\n\n{origin(manifest).licence}\n",
        f"## Citation\n\n```bibtex\n{citation(manifest)}\n```\n\nThe labels are those of\n\n```bibtex\n{DAP}\n```\n",
    ]
    return "\n".join(part for part in parts if part)


UNLABELLED = "No shards yet: run `dapdata label` on this folder.\n"


def summary(manifest: Mapping[str, Any], demos: int, here: int) -> str:
    """What the dataset is, in a sentence or two.

    Args:
        manifest: As JSON data.
        demos: How many are in the shards.
        here: How many of them are beside the text; 0 before the dataset is labelled.
    """
    about = origin(manifest)
    what = (
        f"Demonstrations of placing an object into a container, task `{manifest['task']}`, {about.made} by dapdata "
        f"{manifest['created_by']['dapdata']}"
    )
    if not here:
        return f"{what}: {manifest['demos']} demos, not yet labelled."
    return (
        f"{what}: {here if here == demos else f'{here} of {demos}'} demos, each with {about.holds}, "
        "and the affordance and correspondence labels of the "
        "demonstrated one."
    )


def _here(index: Mapping[str, Array]) -> int:
    return len(index["demo"]) if index else 0


def citation(manifest: Mapping[str, Any]) -> str:
    """A BibTeX entry for the dataset; who publishes it adds author and year."""
    digest = manifest["content_sha256"]
    return "\n".join(
        [
            f"@misc{{{manifest['name']}_{digest[:8]},",
            f"  title = {{{manifest['name']}: demonstrations of the task {manifest['task']}}},",
            f"  note  = {{Made with dapdata {manifest['created_by']['dapdata']}; content sha256 {digest}}}",
            "}",
        ]
    )


def _header(manifest: Mapping[str, Any], index: Mapping[str, Array], form: Form) -> str:
    here = _here(index)
    size = next((text for limit, text in SIZES if here < limit), "n>1M")
    about = origin(manifest)
    lines = [f"license: {about.license}", "task_categories:", "- robotics", "tags:"]
    lines += [f"- {tag}" for tag in (*TAGS, *about.tags)]
    lines += [f"pretty_name: {manifest['name']}", "size_categories:", f"- {size}"]
    lines += [form.header] if index and form.header else []
    return "\n".join(["---", *lines, "---"])


def _alt(path: str) -> str:
    """What a picture shows, for those who cannot see it."""
    known = {
        "preview/clouds.png": "A demo's container as observed, and its superpoints",
        "preview/goals.png": "The same demo's affordance (red: place here), and all goals that hold (orange: demonstrated)",
    }
    return known.get(path, path)


def _table(head: Sequence[str], lines: Iterable[Sequence[object]]) -> str:
    """A Markdown table."""
    rows = [head, ["---"] * len(head), *lines]
    return "".join(f"| {' | '.join(map(str, row))} |\n" for row in rows)


def _averages(index: Mapping[str, Array]) -> str:
    means = [(name.replace("_", " "), f"{index[name].mean():.1f}") for name in COUNTS]
    return "## What a demo holds\n\n" + _table(["on average", ""], means)


def _splits(index: Mapping[str, Array]) -> str:
    """Demos and instances of each split, and how many instances it shares with another: none, or it would be no split."""
    owners = index["split"]
    names = [name for name in (*SPLITS, UNUSED) if name in owners]
    instances = [
        {name: distinct(index[kind][owners == name]) for name in names} for kind in ("container_instance", "object_instance")
    ]

    def shared(own: str, found: Mapping[str, Array]) -> int:
        others = [found[name] for name in names if name not in (own, UNUSED)]
        return len(np.intersect1d(found[own], distinct(np.concatenate([np.zeros(0, np.int64), *others])), assume_unique=True))

    lines = []
    for name in names:
        overlap = ["-" if name == UNUSED else shared(name, found) for found in instances]
        lines.append((name, int((owners == name).sum()), *(len(found[name]) for found in instances), *overlap))
    head = ["split", "demos", "containers", "objects", "containers shared with another split", "objects shared"]
    proof = (
        "An instance is a digest of the geometry: of the container with what stands in it, and of the object. The dataset's "
        "`index.parquet` has those of each demo, and `dapdata verify` fails if two splits share one."
    )
    spare = " `unused` demos share one with two splits, and so belong to neither." if UNUSED in names else ""
    return f"## Splits\n\n{_table(head, lines)}\n{proof}{spare}\n"


def _rejects(rejects: Mapping[str, Mapping[str, int]], missing: Sequence[Mapping[str, Any]]) -> str:
    words = {
        "attempts": "scenes given up (another was drawn instead)",
        "demos": "demos left out",
        "goals": "candidate goals that did not hold (kept in `rejected_goals/`)",
    }
    lines = [(words[what], reason, count) for what, counts in rejects.items() for reason, count in counts.items()]
    for entry in missing:
        start, stop = entry["demo_range"]
        lines.append((f"demos {start} to {stop - 1}, which could not be made", entry["reason"].replace("|", "/"), stop - start))
    return "## What was rejected\n\n" + (_table(["what", "reason", "count"], lines) if lines else "Nothing.\n")


ARRAYS_HEAD = ("array", "dtype", "shape", "unit", "frame", "what")


def _arrays(manifest: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """The lines of the table of arrays, from the one that shards are written by."""
    for column in stored(manifest):
        about = column.metadata
        dims = about["dims"] if is_ragged(column) else about["dims"][1:]
        codes = f" ({', '.join(f'{i} {name}' for i, name in enumerate(about['names']))})" if about["names"] else ""
        shape = " x ".join(map(str, dims)) or "-"
        yield (
            f"`{about['path']}`",
            about["dtype"].lstrip("<|"),
            shape,
            about["unit"],
            about["frame"],
            about["description"] + codes,
        )


DOES = {  # as Origin.does, wherever the demos are from
    "cluster": "partitions the clouds into superpoints",
    "label": "computes affordance and correspondence of the demonstrated goal",
}


def _how(manifest: Mapping[str, Any], stages: Mapping[str, Mapping[str, Any]]) -> str:
    recipe, lines, words = manifest["recipe"], [], {**DOES, **origin(manifest).does}
    for name, spec in stages.items():
        does = f" {words[name]}" if name in words else ""
        versions = ", ".join(f"{package} {number}" for package, number in sorted(spec["packages"].items()))
        lines.append(f"- `{name}`{does} (version {spec['version']}; {versions}; recipe: {', '.join(sorted(spec['sections']))})")
    made = "\n".join(lines)
    return f"""## How it was made

{made}

Seed {recipe["seed"]}. The recipe below, saved as a file and given to `dapdata generate` and then `dapdata label`, makes the
same arrays again with the versions above{origin(manifest).needs}; their digest is `{manifest["content_sha256"]}`.

<details><summary>The recipe, every default filled in</summary>

```json
{json.dumps(recipe, indent=1)}
```

</details>
"""
