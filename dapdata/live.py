"""Demos in the rerun viewer, or in a file that it opens: the only door to rerun.

The timeline "demo" steps through the demos. The SDK is an extra of its own (`viz`, 170 MB), and its files are not meant to
last: they are read by the version that wrote them and the next one.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import records
from dapdata.draw import POINT_RADIUS, Triangles
from dapdata.errors import EnvironmentProblem, require
from dapdata.pictures import (
    CLUTTER,
    DEMONSTRATED,
    REJECTED,
    VALID,
    WOOD,
    Shown,
    affordance_colors,
    height_colors,
    is_demonstrated,
    solids,
    superpoint_colors,
    title,
)

Array = NDArray[Any]

PATIENCE = 10.0  # s until a viewer must have answered


def stream(shown: Sequence[Shown], name: str, out: Path | None = None) -> None:
    """Shows demos in a viewer that is started for them, or writes them to an .rrd file.

    Args:
        shown: The demos.
        name: Of the recording.
        out: The file; None for a viewer.

    Raises:
        MissingExtraError: rerun is not installed.
        EnvironmentProblem: no viewer could be started.
    """
    rr = require("rerun", "viz")
    recording = rr.RecordingStream(f"dapdata: {name}")
    try:
        if out is not None:
            out.parent.mkdir(parents=True, exist_ok=True)
            recording.save(out)
        else:
            # The viewer is a command beside this Python, which is on the path only where the environment is active.
            os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
            recording.spawn()
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for item in shown:
            recording.set_time("demo", sequence=int(item.sample["meta/demo"]))
            recording.log("world", rr.Clear(recursive=True))
            recording.log("about", rr.TextDocument("\n\n".join(title(item))))
            for path, entity in entities(rr, item):
                recording.log(f"world/{path}", *entity)
        recording.flush(timeout_sec=PATIENCE)
    except RuntimeError as error:
        raise EnvironmentProblem(
            f"rerun: no viewer could be started ({str(error).splitlines()[0]}), expected one on this machine's screen; without "
            "a screen write a file, `dapdata show --rerun --out demos.rrd`, and open it elsewhere with `rerun demos.rrd`"
        ) from error


def entities(rr: Any, shown: Shown) -> Iterator[tuple[str, tuple[Any, ...]]]:
    """What rerun shows of one demo: its path below the world, and rerun's components. World frame, m."""
    sample = shown.sample
    yield from _clouds(rr, shown)
    parts, T_world_container = solids(sample), sample["pose/T_world_container"][None]
    for role, color in zip(records.ROLES, (WOOD, CLUTTER)):
        yield f"parts/{role}", (_mesh(rr, parts[role].at(T_world_container), color),)
    demonstrated = is_demonstrated(sample)
    goals = sample["goals/T_world_object"]
    poses = {"goals/demonstrated": (goals[demonstrated], DEMONSTRATED), "goals/others": (goals[~demonstrated], VALID)}
    for code, reason in enumerate(records.REJECT_REASONS):
        rejected = sample["rejected_goals/T_world_object"][sample["rejected_goals/reason"] == code]
        poses[f"rejected_goals/{reason}"] = rejected, REJECTED[reason]
    for path, (T, color) in poses.items():
        if len(T):
            yield path, (_mesh(rr, parts["object"].at(T), color),)
    pairs = [
        sample[f"{body}_superpoints/points"][sample[f"correspondence/{body}_superpoint"]] for body in ("object", "container")
    ]
    yield "correspondences", (rr.LineStrips3D(np.stack(pairs, axis=1), radii=0.0005),)
    for i, (K, T) in enumerate(zip(sample["camera/K"], sample["camera/T_world_camera"])):
        pinhole = rr.Pinhole(image_from_camera=K, resolution=2 * K[:2, 2], image_plane_distance=0.1)
        yield f"cameras/{i}", (rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), pinhole)


def _clouds(rr: Any, shown: Shown) -> Iterator[tuple[str, tuple[Any, ...]]]:
    sample = shown.sample
    top = float(sample["container/points"][:, 2].max())
    for body in ("container", "object"):
        points, superpoint = sample[f"{body}/points"], sample[f"{body}/superpoint"]
        colors = {
            "cloud": height_colors(points[:, 2], top),
            "superpoints": superpoint_colors(superpoint.max() + 1)[superpoint],
        }
        if body == "container":
            colors["affordance"] = affordance_colors(sample["container_superpoints/affordance"][superpoint])
        for name, color in colors.items():
            yield f"{body}/{name}", (rr.Points3D(points, colors=color, radii=POINT_RADIUS / 2),)


def _mesh(rr: Any, solid: Triangles, color: Sequence[float]) -> Any:
    return rr.Mesh3D(vertex_positions=solid.vertices, triangle_indices=solid.faces, albedo_factor=color)
