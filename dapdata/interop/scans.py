"""Scans of a dataset's scenes, as the cameras of a real table would make them: what `dapdata import scans` reads.

Every camera of a demo stands where it stood, and sees the whole table twice: with the object at its start, and at the
demonstrated goal. So views are partial, the object hides the container and the container the object. Depth noise is drawn
for each image, and each camera's pose is believed with one error, the same before and after, both as the recipe's noise
section says. Masks are perfect but for flying pixels.

`truth.json` has what the importer must find out. It doesn't read it; `imports.agreement` compares.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dapdata import durable, records, rng
from dapdata.card import Form
from dapdata.clouds import write_ply
from dapdata.errors import UsageError
from dapdata.interop.export import Chosen, Export, Piece, Progress, Row, choose, demo_name, readme, run
from dapdata.interop.scan_files import ABOUT, LABELS, STAGES
from dapdata.observe import CamerasConfig, NoiseConfig, image_of
from dapdata.poses import inverse, transform
from dapdata.records import PART_KINDS, Array, meshes_in
from dapdata.store import Sample

TRUTH = "truth.json"
TABLE = np.array([4.0, 4.0, 0.02])  # m, a board whose upper face is z = 0
TABLE_STEP = 10  # every so many-th point of the table is kept: enough to tell what is level
LAYOUT = """A folder a demonstration. Metres, z up; for what else is possible see docs/import_scans.md of dapdata.

| file | holds |
|---|---|
| `start.ply`, `end.ply` | the scan before and after: x y z, `label` (1 container, 2 object, 0 neither), `view` (camera) |
| `scan.json` | which container and object, the object's symmetry, the poses and intrinsics of the cameras |
| `truth.json` | the poses that were simulated: to compare with, not read by the import |
"""


def export(
    dataset: str | Path,
    out: str | Path,
    *,
    split: str | None = None,
    demos: int | None = None,
    progress: Progress | None = None,
) -> Path:
    """Writes scans of a labelled dataset's scenes as `demo_000000/start.ply`, `end.ply`, ... and returns the folder.

    Args:
        dataset: The dataset's folder.
        out: The folder to write, see `export.run`.
        split, demos: See `export.choose`.
        progress: See `export.run`.

    Raises:
        UsageError: for demos without shapes, which cannot be scanned.
        MissingExtraError: without numba.
    """
    chosen = choose(dataset, split, demos)
    recipe = chosen.dataset.recipe
    cameras, noise = CamerasConfig.model_validate(recipe["cameras"]), NoiseConfig.model_validate(recipe["noise"])

    def write(piece: Piece, folder: Path, rows: Iterator[Row]) -> None:
        for about, sample in rows:
            _write(folder, about, sample, cameras, noise)

    return run(out, Export("scans", {}, chosen, _pieces(chosen), write, readme(chosen, _form())), progress)


def _pieces(chosen: Chosen) -> list[Piece]:
    """A folder for each demo, in the order of the dataset."""
    demo = chosen.dataset.index["demo"]
    numbers = np.sort(np.concatenate([*chosen.splits.values()])).tolist()
    return [Piece(demo_name(int(demo[number])), np.array([number])) for number in numbers]


def _form() -> Form:
    return Form(
        files=LAYOUT,
        loader="""```python
import trimesh
scan = trimesh.load("demo_000000/start.ply")  # scan.vertices; labels in scan.metadata
```
""",
        has_arrays=False,
    )


def _write(folder: Path, facts: dict[str, Any], sample: Sample, cameras: CamerasConfig, noise: NoiseConfig) -> None:
    """The files of one demo, in a new folder."""
    if not len(sample["scene/kind"]) or not len(sample["object_parts/kind"]):
        raise UsageError(f"demo {facts['demo']}: has no shapes, expected solids or meshes to scan; it was imported without")
    folder.mkdir()
    T_believed = _believed(sample, noise)
    for stage, name in zip(STAGES, ("start", "goal")):
        points, label, view = look(sample, stage, sample[f"pose/T_world_object_{name}"], T_believed, cameras, noise)
        write_ply(folder / f"{stage}.ply", points, label=label, view=view)
    (folder / ABOUT).write_bytes(durable.canonical(_about(facts, sample, T_believed)))
    truth = {
        name: sample[f"pose/{name}"].tolist() for name in ("T_world_container", "T_world_object_start", "T_world_object_goal")
    }
    symmetry = {"symmetry": records.SYMMETRIES[int(sample["symmetry/kind"])], "axis": sample["symmetry/axis"].tolist()}
    (folder / TRUTH).write_bytes(durable.canonical(truth | symmetry))


def _about(facts: dict[str, Any], sample: Sample, T_believed: Array) -> dict[str, Any]:
    """What a user would know of the scan."""
    axis = sample["pose/T_world_object_start"][:3, :3] @ sample["symmetry/axis"]
    opening = sample["pose/T_world_container"][:3, :3] @ sample["scene/opening"]
    return {
        **{body: f"{body} {facts[f'{body}_instance']:x}" for body in LABELS},
        "symmetry": records.SYMMETRIES[int(sample["symmetry/kind"])],
        "axis": axis.tolist(),
        "opening": opening.tolist(),
        "cameras": [{"T_world_camera": T.tolist(), "K": K.tolist()} for T, K in zip(T_believed, sample["camera/K"])],
    }


def _believed(sample: Sample, noise: NoiseConfig) -> Array:
    """(V, 4, 4) where the cameras are believed to stand; they stand where the demo says."""
    from dapdata.observe.cameras import pose_error

    draw = rng.stream(int(sample["meta/seed"]), "scan/cameras", int(sample["meta/demo"]))
    return np.stack([T @ inverse(pose_error(noise, draw.normal(size=6))) for T in sample["camera/T_world_camera"]])


def look(
    sample: Sample, stage: str, T_world_object: Array, T_believed: Array, cameras: CamerasConfig, noise: NoiseConfig
) -> tuple[Array, Array, Array]:
    """What all cameras of a demo see of it, by their believed poses: (N, 3) points, world, m, (N,) labels, (N,) views.

    Args:
        sample: The demo.
        stage: "start" or "end", for the noise.
        T_world_object: (4, 4) where the object is.
        T_believed: (V, 4, 4) poses of the cameras by which points are placed.
        cameras: How near and far they see.
        noise: What they add.
    """
    from dapdata.observe.cameras import View
    from dapdata.observe.noise import add_noise

    kinds = (sample["scene/kind"], sample["object_parts/kind"], [PART_KINDS.index("box")])
    poses = (
        sample["pose/T_world_container"] @ sample["scene/T_container_part"],
        T_world_object @ sample["object_parts/T_object_part"],
        [np.eye(4)],
    )
    kind, size = np.concatenate(kinds), np.concatenate([sample["scene/size"], sample["object_parts/size"], TABLE[None]])
    T_world_part = np.concatenate(poses)
    T_world_part[-1, 2, 3] = -TABLE[2] / 2
    container, object_ = meshes_in(sample)
    label_of = np.repeat([*LABELS.values(), 0], [len(part) for part in kinds]).astype(np.uint8)
    draw = rng.stream(int(sample["meta/seed"]), f"scan/{stage}", int(sample["meta/demo"]))
    seen = []
    for v, (K, T) in enumerate(zip(sample["camera/K"], sample["camera/T_world_camera"])):
        view = View(round(2 * K[0, 2]), round(2 * K[1, 2]), K, T_believed[v], T, int(draw.integers(2**63)))
        image = image_of(view, kind, size, [*container, *object_, None], inverse(T) @ T_world_part, cameras)
        depth = add_noise(image, K, noise.preset, view.noise_seed)
        row, column = np.nonzero(depth > 0)
        label, z = label_of[image.part[row, column]], depth[row, column].astype(float)
        kept = (label > 0) | (np.arange(len(z)) % TABLE_STEP == 0)
        rays = np.stack([(column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1], np.ones(len(z))], axis=1)
        points = transform(T_believed[v], rays * z[:, None])
        seen.append((points[kept], label[kept], np.full(int(kept.sum()), v, np.uint8)))
    points, label, which = (np.concatenate(parts) for parts in zip(*seen))
    return points, label, which
