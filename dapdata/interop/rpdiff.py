"""Out to RPDiff: a labelled dataset as chunks of demonstrations that its own loader reads.

The loader (`dataio_full_chunked.py`) needs the legacy layout, in which a body has one pose, a list of seven numbers: on the
current one, lists of poses, its can augmentation and its full point clouds fail. It finds files by name in `split_info/`,
walks into folders that hold no other folders, and stops in a prompt when a split has no file; hence a chunk holds demos of
one split, and names are unique. World z is put back to RPDiff's table.

What the layout has no room for (every goal, views, the parts and meshes of the scene) goes along under the key "dapdata",
which the loader passes over and `dapdata import rpdiff` takes as it is: imported again, demos and clouds are the same
bytes, and only demos are numbered anew. `normals` has the form in which the authors of DAP keep theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import durable, loading, meshes, solids
from dapdata.errors import UsageError
from dapdata.interop import object_arrays
from dapdata.loading import Dataset
from dapdata.poses import inverse, pose, transform
from dapdata.records import Cloud, Mesh, MeshDemo, columns, meshes_in
from dapdata.simulate import to_pose7
from dapdata.split import SPLITS, UNUSED
from dapdata.store import Sample

Array = NDArray[Any]
Progress = Callable[[int, int], None]  # demos done, demos in all

PER_FILE = 9  # demos in a chunk, as RPDiff's own script makes them
PER_FOLDER = 1000  # chunks
TABLE = pose(None, (0.0, 0.0, 1.0))  # z of RPDiff's table top, m
SPLIT_FILES = {"train": "train_split", "val": "train_val_split", "test": "test_split"}
README = """# {name}: in RPDiff's layout

{demos} demos of `{task}`, exported by dapdata {version} (content {content}).
Train on them with RPDiff's configuration `data_args.chunked: True` and this folder as `dataset_path`.

| path | holds |
|---|---|
| `*/demo_aug_*.npz` | {per_file} demos each, legacy layout: poses [x y z qx qy qz qw], world frame, m, table at z = 1 |
| `split_info/` | which files are for training, for choosing, for testing; files of none share an instance with two splits |
| `meshes/` | container and object of each instance, in the frame of their poses |

Clouds are fused and voxelled, with `normals` toward the sensor; the key `dapdata` holds all that the layout does not.
{empty}{origin}"""


def export(dataset: str | Path, out: str | Path, *, shard_size: int = PER_FILE, progress: Progress | None = None) -> Path:
    """Writes a labelled dataset in RPDiff's layout, and returns the folder: there whole, or not at all.

    Args:
        dataset: The dataset's folder.
        out: The folder to write; new or empty.
        shard_size: Demos in a file.
        progress: Called with demos done and demos in all.

    Raises:
        FormatError: there is no labelled dataset.
        UsageError: the folder holds something.
        EnvironmentProblem: the disk is full.
    """
    found, target = loading.open(dataset), Path(out).absolute()
    if target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise UsageError(f"{out}: exists and is not empty, expected a new or empty folder; choose another with --out")
    with durable.disk_problems(target):
        try:
            with durable.staged(target.parent, target.name) as folder:
                _write(folder, found, shard_size, progress)
                durable.commit(folder, target)
        finally:
            with suppress(OSError):
                (target.parent / durable.STAGING).rmdir()
    return Path(out)


def _write(folder: Path, found: Dataset, shard_size: int, progress: Progress | None) -> None:
    """All files of an export."""
    listed: dict[str, list[str]] = {name: [] for name in (*SPLITS, UNUSED)}
    written: set[str] = set()
    done = chunk = 0
    (folder / "meshes").mkdir()
    for name, names in listed.items():
        mine = np.flatnonzero(found.index["split"] == name)
        for numbers in np.split(mine, range(shard_size, len(mine), shard_size)):
            if not len(numbers):
                continue
            file = folder / str(chunk // PER_FOLDER) / f"demo_aug_{chunk}.npz"
            file.parent.mkdir(exist_ok=True)
            samples = [found[i] for i in numbers.tolist()]
            object_arrays.write(file, {str(i): _layout(sample) for i, sample in enumerate(samples)})
            for sample in samples:
                _write_meshes(folder / "meshes", sample, written)
            names.append(file.name)
            chunk, done = chunk + 1, done + len(numbers)
            if progress:
                progress(done, len(found))
    (folder / "split_info").mkdir()
    for split, title in SPLIT_FILES.items():
        (folder / "split_info" / f"{title}.txt").write_text("".join(f"{name}\n" for name in listed[split]))
    (folder / "README.md").write_text(_readme(found, listed, shard_size))


def _readme(found: Dataset, listed: dict[str, list[str]], shard_size: int) -> str:
    about = found.manifest
    empty = [split for split in SPLITS if not listed[split]]
    source = about.recipe["scene"].get("source")
    return README.format(
        name=about.name,
        demos=len(found),
        task=about.task,
        version=about.created_by["dapdata"],
        content=about.content_sha256,
        per_file=shard_size,
        empty=f"\nThere is no demo for {' and '.join(empty)}: RPDiff's loader stops at a split without files.\n"
        if empty
        else "",
        origin=f"\nThe demos were imported from `{source}`; licence and citation are those of their makers.\n"
        if source
        else "",
    )


# One demo --------------------------------------------------------------------------------------------------


def _layout(sample: Sample) -> dict[str, Any]:
    """The fields of one demo; each is an array, and those that hold anything else object arrays of no dimensions."""
    T_world = {name: TABLE @ sample[f"pose/T_world_{name}"] for name in ("container", "object_start", "object_goal")}
    T_goal_start = T_world["object_goal"] @ inverse(T_world["object_start"])
    points = {body: transform(TABLE, sample[f"{body}/points"].astype(float)) for body in ("container", "object")}
    container, object_ = (to_pose7(T_world[name]) for name in ("container", "object_start"))
    names = _instance_names(sample)
    files = {body: f"meshes/{name}.obj" for body, name in names.items()}
    nothing = {"parent": None, "child": None}
    cameras = len(sample["camera/K"]) // 2  # listed for the container, then for the object
    boxed: dict[str, Any] = {
        "multi_obj_names": {"parent": "container", "child": "object"},
        "multi_obj_start_pcd": {"parent": points["container"], "child": points["object"]},
        "multi_obj_final_pcd": {"parent": points["container"], "child": transform(T_goal_start, points["object"])},
        **dict.fromkeys(("grasp_pose_world", "place_pose_world", "grasp_joints", "place_joints"), nothing),
        **dict.fromkeys(("ee_link", "gripper_type", "pcd_pts", "processed_pcd", "rgb_imgs", "depth_imgs")),
        "multi_object_ids": names,
        "multi_obj_start_obj_pose": {"parent": container, "child": object_},
        "multi_obj_final_obj_pose": {"parent": container, "child": to_pose7(T_world["object_goal"])},
        "multi_obj_mesh_file": files,
        "multi_obj_mesh_file_dec": files,
        "multi_obj_part_pose_dict": dict.fromkeys(("parent_part_world", "child_part_world", "child_part_parent"), np.eye(4)),
        "normals": {"parent": sample["container/normals"].astype(float), "child": sample["object/normals"].astype(float)},
        "dapdata": _everything(sample),
    }
    return {
        "success": np.array(True),
        **{key: object_arrays.Boxed(value) for key, value in boxed.items()},
        "cam_intrinsics": sample["camera/K"][:cameras],
        "cam_poses": TABLE @ sample["camera/T_world_camera"][:cameras],
        "real_sim": np.array("sim"),
    }


def _everything(sample: Sample) -> dict[str, Array]:
    """Demo and cloud as they are; without meshes, their arrays are empty."""
    about = {column.metadata["path"]: column.metadata for column in columns(MeshDemo, Cloud)}
    return {
        path: np.asarray(sample[path], told["dtype"]) if path in sample else np.zeros((0, *told["dims"][1:]), told["dtype"])
        for path, told in about.items()
    }


def _instance_names(sample: Sample) -> dict[str, str]:
    """Names with decimal numbers: the loader leaves out meshes with "dec" in their name, which a hexadecimal one may have."""
    container, object_ = (int(sample[f"meta/{body}_instance"]) for body in ("container", "object"))
    return {"parent": f"container_{container}", "child": f"object_{object_}"}


# Meshes ----------------------------------------------------------------------------------------------------


def _write_meshes(folder: Path, sample: Sample, written: set[str]) -> None:
    """Writes the meshes of a demo's container and object that are not there yet; none of a demo without parts."""
    for name, group, T, found in zip(
        _instance_names(sample).values(),
        ("scene", "object_parts"),
        (sample["scene/T_container_part"], sample["object_parts/T_object_part"]),
        meshes_in(sample),
    ):
        if name not in written and len(T):
            written.add(name)
            placed = list(_placed(sample[f"{group}/kind"], sample[f"{group}/size"], T, found))
            (folder / f"{name}.obj").write_text(meshes.to_obj(placed))


def _placed(kind: Array, size: Array, T: Array, found: Sequence[Mesh | None]) -> Iterator[Mesh]:
    """Each part as a mesh, in the frame of its body."""
    for p, mesh in enumerate(found):
        if mesh is None:
            solid = solids.to_trimesh(kind[p : p + 1], size[p : p + 1], T[p : p + 1])
            yield Mesh(np.asarray(solid.vertices, float), np.asarray(solid.faces))
        else:
            yield Mesh(transform(T[p], mesh.vertices), mesh.faces)
