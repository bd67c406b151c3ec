"""The table of contents of a dataset that was imported: files take the place of scenes, simulator and cameras.

    files -> Demo -> Cloud -> Superpoints -> Labels -> shard
      |- import -|         as for our own |

An import is a recipe whose scene section names files and the digest of what they hold, which is thereby in the key of
every unit. What follows is all of the ordinary pipeline: demo i is the i-th of the source, one that cannot be used is
rejected by reason, a killed import goes on where it stopped, and splits follow instances.

A format is a section of the recipe (`recipe.IMPORTED`) and a reader (`READERS`).
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from dapdata import health, manifest, pipeline, recipe, remote
from dapdata.errors import UsageError
from dapdata.interop import rpdiff_clouds, rpdiff_files, rpdiff_scenes
from dapdata.plan import Plan
from dapdata.recipe import Recipe
from dapdata.records import Cloud, MeshDemo, Rejected
from dapdata.remote import Place
from dapdata.stages import Draw, Inputs, Sections, Stage


class Reader(NamedTuple):
    """How the demos of a format come in."""

    demonstrate: Callable[[Any, Any, int], MeshDemo | Rejected]  # (scene section, placement section, number of the demo)
    observe: Callable[[Any, Any, MeshDemo], Cloud | Rejected]  # (scene section, cameras section, what demonstrate gave)


READERS = {"rpdiff": Reader(rpdiff_scenes.demonstrate, rpdiff_clouds.observe)}  # by the scene's `task`


def _demonstrate(made: Inputs, sections: Sections, draw: Draw) -> MeshDemo | Rejected:
    """A demo as its file tells it, with its goals settled and checked where there is geometry."""
    return READERS[sections["scene"].task].demonstrate(sections["scene"], sections["placement"], draw.demo)


def _observe(made: Inputs, sections: Sections, draw: Draw) -> Cloud | Rejected:
    """The clouds of its file, fused."""
    return READERS[sections["scene"].task].observe(sections["scene"], sections["cameras"], made["demonstrate"])


STAGES = (
    Stage("demonstrate", 1, ("scene", "placement"), (), MeshDemo, _demonstrate, packages=("pybullet", "numpy")),
    Stage("observe", 1, ("scene", "cameras"), ("demonstrate",), Cloud, _observe, packages=("numba", "numpy")),
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


def import_recipe(source: Path, section: Mapping[str, Any], found: int, demos: int | None, overrides: Sequence[str]) -> Recipe:
    """A recipe that imports, named after the file or folder.

    Args:
        source: What is imported.
        section: Of the scene: the format as `task`, the source and a digest of what it holds.
        found: Demos in the source.
        demos: At most so many; None: all.
        overrides: As of `--set`.
    """
    name = re.sub(r"[^a-z0-9_-]+", "_", source.resolve().stem.lower()).strip("_-")[:64] or str(section["task"])
    tree = {"name": name, "demos": min(found, demos or found), "scene": dict(section), **NO_NOISE}
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
