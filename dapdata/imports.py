"""The table of contents of a dataset that was imported: files take the place of scenes, simulator and cameras.

    files -> Demo -> Cloud -> Superpoints -> Labels -> shard
      |- import -|         as for our own |

An import is a recipe whose scene section names files and the digest of what they hold, which is thereby in the key of
every unit. What follows is all of the ordinary pipeline: demo i is the i-th of the source, one that cannot be used is
rejected by reason, a killed import goes on where it stopped, and splits follow instances.

A format is a section of the recipe (`recipe.IMPORTED`) and a reader (`READERS`).
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from dapdata import health, manifest, pipeline, recipe, remote, store
from dapdata.config import ScansConfig
from dapdata.errors import UsageError
from dapdata.interop import rpdiff_clouds, rpdiff_files, rpdiff_scenes, scan_clouds, scan_files, scan_placement
from dapdata.interop import scans as scan_export
from dapdata.plan import Plan
from dapdata.poses import inverse, symmetric_distance
from dapdata.recipe import Recipe
from dapdata.records import Cloud, Demo, MeshDemo, Rejected, read_record
from dapdata.remote import Place
from dapdata.stages import Draw, Inputs, Sections, Stage


class Reader(NamedTuple):
    """How the demos of a format come in."""

    demonstrate: Callable[[Any, Any, int], MeshDemo | Rejected]  # (scene section, placement section, number of the demo)
    observe: Callable[[Any, Any, MeshDemo], Cloud | Rejected]  # (scene section, cameras section, what demonstrate gave)


READERS = {  # by the scene's `task`
    "rpdiff": Reader(rpdiff_scenes.demonstrate, rpdiff_clouds.observe),
    "scans": Reader(scan_placement.demonstrate, scan_clouds.observe),
}


def _demonstrate(made: Inputs, sections: Sections, draw: Draw) -> MeshDemo | Rejected:
    """A demo as its file tells it, with its goals settled and checked where there is geometry."""
    return READERS[sections["scene"].task].demonstrate(sections["scene"], sections["placement"], draw.demo)


def _observe(made: Inputs, sections: Sections, draw: Draw) -> Cloud | Rejected:
    """The clouds of its file, fused."""
    return READERS[sections["scene"].task].observe(sections["scene"], sections["cameras"], made["demonstrate"])


STAGES = (
    Stage("demonstrate", 1, ("scene", "placement"), (), MeshDemo, _demonstrate, packages=("pybullet", "numpy", "scipy")),
    Stage("observe", 1, ("scene", "cameras"), ("demonstrate",), Cloud, _observe, packages=("numba", "numpy", "scipy")),
    *pipeline.STAGES[2:],
)
parse = recipe.from_resolved
NO_NOISE = {"noise": {"preset": "none"}, "cameras": {"align": False}}  # nothing is added to what the files hold


def rpdiff_recipe(source: Path, meshes: Path | None, demos: int | None, overrides: Sequence[str]) -> Recipe:
    """The recipe that imports demos of RPDiff, all of them or the first so many.

    Raises:
        FormatError: there are no demos, or no meshes where some were promised.
        RecipeError: an override that makes no sense.
    """
    section = rpdiff_files.scene_section(str(source), str(meshes) if meshes else None)
    return import_recipe(source, section, len(rpdiff_files.find(str(source))[0]), demos, overrides)


def scans_recipe(source: Path, demos: int | None, overrides: Sequence[str]) -> Recipe:
    """The recipe that imports scanned demonstrations, all of them or the first so many.

    Raises:
        FormatError: there are none.
        RecipeError: an override that makes no sense.
    """
    section, found = scan_files.scene_section(str(source)), len(scan_files.find(str(source))[0])
    return import_recipe(source, section, found, demos, overrides, {"eval": {"protocol": "shown"}})


def import_recipe(
    source: Path,
    section: Mapping[str, Any],
    found: int,
    demos: int | None,
    overrides: Sequence[str],
    more: Mapping[str, Any] = MappingProxyType({}),
) -> Recipe:
    """A recipe that imports, named after the file or folder.

    Args:
        source: What is imported.
        section: Of the scene: the format as `task`, the source and a digest of what it holds.
        found: Demos in the source.
        demos: At most so many; None: all.
        overrides: As of `--set`.
        more: Other sections.
    """
    name = re.sub(r"[^a-z0-9_-]+", "_", source.resolve().stem.lower()).strip("_-")[:64] or str(section["task"])
    tree = {"name": name, "demos": min(found, demos or found), "scene": dict(section), **NO_NOISE, **more}
    return recipe.from_resolved(tree, overrides, "import")


def run(asked: Recipe, out: Place | None, **options: Any) -> Place | Plan:
    """`pipeline.generate` of a recipe that imports; a source in which no demo can be used leaves no folder behind."""
    place = remote.locate(out or Path("data") / asked.name)
    is_new = isinstance(place, Path) and not place.exists()
    try:
        return pipeline.generate(asked, place, **options)
    except UsageError as error:
        if not (is_new and isinstance(place, Path) and place.exists()):
            raise
        first = health.rejected(place)[:1] if (place / manifest.MANIFEST).exists() else []
        shutil.rmtree(place)
        raise UsageError("; ".join([str(error), *(f"demo {told['demo']}: {told['detail']}" for told in first)])) from error


# Scans -----------------------------------------------------------------------------------------------------

EXAMPLE = {  # small images, so that the example is a few MB
    "name": "example_scans",
    "demos": 3,
    "scene": {"task": "fruit_rack"},
    "cameras": {
        "width": 320,
        "height": 180,
        "vfov_deg": 42.0,
        "container_views": 2,
        "container_yaw_spread_deg": 90.0,
        "container_distance": 0.7,
        "container_pitch_deg": 40.0,
        "object_views": 2,
        "object_distance": 0.5,
        "object_view_scale": 1.0,
    },
}
WRONG_MM, WRONG_DEG = 10.0, 20.0  # a placement that is farther from the truth is another one


def example_scans(out: Path) -> Path:
    """Writes three scanned demonstrations, simulated, that `import scans` takes as they are; the folder.

    Raises:
        UsageError: the folder holds something else.
        MissingExtraError: what simulates is not installed.
    """
    with TemporaryDirectory() as folder:
        dataset = Path(folder) / "example_scans"
        pipeline.generate(recipe.from_resolved(EXAMPLE, (), "example"), dataset, workers=1, engine="inline")
        pipeline.label(dataset, workers=1, engine="inline")
        return scan_export.export(dataset, out)


def agreement(asked: Recipe, out: Place | None) -> Iterator[str]:
    """A line that says how far placements that were told from scans are from their `truth.json`; none where there is none."""
    config = asked.scene
    assert isinstance(config, ScansConfig)
    off = []
    for demo, found in _imported(asked, out):
        path = scan_files.folder_of(config, demo) / scan_export.TRUTH
        if path.is_file():
            truth = json.loads(path.read_bytes())
            T_start, T_shown = (np.array(truth[f"T_world_object_{name}"]) for name in ("start", "goal"))
            T_goal = found.T_world_object_goal @ inverse(found.T_world_object_start) @ T_start
            off.append(symmetric_distance(T_goal, T_shown, truth["symmetry"], np.array(truth["axis"])))
    if off:
        shift, turn = 1000 * np.array(off)[:, 0], np.degrees(off)[:, 1]
        wrong = int(((shift > WRONG_MM) | (turn > WRONG_DEG)).sum())
        yield (
            f"against {scan_export.TRUTH}, {len(off)} demos: "
            f"{np.median(shift):.1f} mm median, {np.quantile(shift, 0.9):.1f} p90; "
            f"{np.median(turn):.1f} deg median, {np.quantile(turn, 0.9):.1f} p90 modulo symmetry; {wrong} off by more than "
            f"{WRONG_MM:.0f} mm or {WRONG_DEG:.0f} deg"
        )


def _imported(asked: Recipe, out: Place | None) -> Iterator[tuple[int, Demo]]:
    """Number and record of each demo that came in; none where nothing was published, or far away."""
    root = remote.locate(out or Path("data") / asked.name)
    if not isinstance(root, Path) or not (root / manifest.MANIFEST).is_file():
        return
    stages = manifest.read(root).stages
    seen = {row["demo"] for unit in stages["observe"].units for row in store.read_record(root / unit.path)["rows"]}
    for unit in stages["demonstrate"].units:
        block = store.read_block(root / unit.path)
        for i, row in enumerate(store.read_record(root / unit.path)["rows"]):
            if row["demo"] in seen:
                yield row["demo"], read_record(MeshDemo, block.sample(i))
