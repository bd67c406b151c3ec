"""The table of contents of a dataset that was imported: files take the place of scenes, simulator and cameras.

    files -> Demo -> Cloud -> Superpoints -> Labels -> shard
      |- import -|         as for our own |

An import is a recipe whose scene section names files and the digest of what they hold, which is thereby in the key of
every unit. What follows is all of the ordinary pipeline: demo i is the i-th of the source, one that cannot be used is
rejected by reason, a killed import goes on where it stopped, and splits follow instances.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dapdata import pipeline, recipe
from dapdata.errors import UsageError
from dapdata.interop import rpdiff_clouds, rpdiff_files, rpdiff_scenes
from dapdata.plan import Plan
from dapdata.recipe import Recipe
from dapdata.records import Cloud, MeshDemo, Rejected
from dapdata.stages import Draw, Inputs, Sections, Stage


def _demonstrate(made: Inputs, sections: Sections, draw: Draw) -> MeshDemo | Rejected:
    """A demo as its file tells it, with its goals settled and checked where there are meshes."""
    return rpdiff_scenes.demonstrate(sections["scene"], sections["placement"], draw.demo)


def _observe(made: Inputs, sections: Sections, draw: Draw) -> Cloud | Rejected:
    """The clouds of its file, fused."""
    return rpdiff_clouds.observe(sections["scene"], sections["cameras"], made["demonstrate"])


STAGES = (
    Stage("demonstrate", 1, ("scene", "placement"), (), MeshDemo, _demonstrate, packages=("pybullet", "numpy")),
    Stage("observe", 1, ("scene", "cameras"), ("demonstrate",), Cloud, _observe, packages=("numba", "numpy")),
    *pipeline.STAGES[2:],
)
parse = recipe.from_resolved
NO_NOISE = {"noise": {"preset": "none"}, "cameras": {"align": False}}  # nothing is added to what the files hold


def rpdiff_recipe(source: Path, meshes: Path | None, demos: int | None, overrides: Sequence[str]) -> Recipe:
    """The recipe that imports demos of RPDiff, all of them or the first so many; named after the file or folder.

    Raises:
        FormatError: there are no demos, or no meshes where some were promised.
        RecipeError: an override that makes no sense.
    """
    section = rpdiff_files.scene_section(str(source), str(meshes) if meshes else None)
    found = len(rpdiff_files.find(str(source))[0])
    name = re.sub(r"[^a-z0-9_-]+", "_", source.resolve().stem.lower()).strip("_-")[:64] or "rpdiff"
    tree = {"name": name, "demos": min(found, demos or found), "scene": section, **NO_NOISE}
    return recipe.from_resolved(tree, overrides, "import")


def run(asked: Recipe, out: Path | None, **options: Any) -> Path | Plan:
    """`pipeline.generate` of a recipe that imports; a source in which no demo can be used leaves no folder behind."""
    root = out or Path("data") / asked.name
    is_new = not root.exists()
    try:
        return pipeline.generate(asked, root, **options)
    except UsageError:
        if is_new and root.exists():
            shutil.rmtree(root)
        raise
