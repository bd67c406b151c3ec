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

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import meshes, solids
from dapdata.card import Form
from dapdata.interop import object_arrays
from dapdata.interop.export import Chosen, Export, Piece, Progress, Row, choose, cut, readme, run
from dapdata.poses import inverse, pose, transform
from dapdata.records import Cloud, Mesh, MeshDemo, meshes_in, pack_meshes, read_demo, read_record, to_sample
from dapdata.simulate import to_pose7
from dapdata.split import SPLITS
from dapdata.store import Sample

Array = NDArray[Any]

PER_FILE = 9  # demos in a chunk, as RPDiff's own script makes them
PER_FOLDER = 1000  # chunks
MESHES = "meshes"  # folder
TABLE = pose(None, (0.0, 0.0, 1.0))  # z of RPDiff's table top, m
SPLIT_FILES = {"train": "train_split", "val": "train_val_split", "test": "test_split"}


def export(
    dataset: str | Path,
    out: str | Path,
    *,
    split: str | None = None,
    demos: int | None = None,
    shard_size: int = PER_FILE,
    progress: Progress | None = None,
) -> Path:
    """Writes a labelled dataset as `0/demo_aug_0.npz`, ..., with split lists and meshes, and returns the folder.

    Args:
        dataset: The dataset's folder.
        out: The folder to write, see `export.run`.
        split, demos: See `export.choose`.
        shard_size: Demos in a chunk.
        progress: See `export.run`.
    """
    chosen = choose(dataset, split, demos)
    chunks: list[Piece] = []
    listed: dict[str, list[str]] = {}
    for name, parts in cut(chosen, shard_size):
        mine = [Piece(_chunk(len(chunks) + i), numbers) for i, numbers in enumerate(parts)]
        listed[name] = [Path(piece.path).name for piece in mine]
        chunks += mine
    lists = {
        f"split_info/{title}.txt": "".join(f"{name}\n" for name in listed.get(split, [])).encode()
        for split, title in SPLIT_FILES.items()
    }
    files = lists | readme(chosen, _form(listed))
    pieces = [*chunks, Piece(MESHES, _one_of_each(chosen))]
    return run(out, Export("rpdiff", {"shard_size": shard_size}, chosen, pieces, _write, files), progress)


def _chunk(number: int) -> str:
    """Names are unique: the loader finds chunks by their name alone."""
    return f"{number // PER_FOLDER}/demo_aug_{number}.npz"


def _one_of_each(chosen: Chosen) -> Array:
    """Demos that have, together, every container and every object of the chosen ones."""
    numbers, index = np.sort(np.concatenate([*chosen.splits.values()])), chosen.dataset.index
    firsts = [np.unique(index[f"{body}_instance"][numbers], return_index=True)[1] for body in ("container", "object")]
    return np.asarray(numbers[np.unique(np.concatenate(firsts))])


def _write(piece: Piece, target: Path, rows: Iterator[Row]) -> None:
    if piece.path == MESHES:
        target.mkdir()
        for _, sample in rows:
            _write_meshes(target, sample)
    else:
        object_arrays.write(target, {str(i): _layout(sample) for i, (_, sample) in enumerate(rows)})


def _form(listed: Mapping[str, Sequence[str]]) -> Form:
    """The card's words about these files."""
    empty = [name for name in SPLITS if not listed.get(name)]
    stops = f" There is no demo for {' and '.join(empty)}: the loader stops at a split without files." if empty else ""
    return Form(
        files=(
            "RPDiff's legacy layout, which its own loader reads (`data_args.chunked: True`, this folder as `dataset_path`): "
            "`0/demo_aug_*.npz`, ... hold some demos each, whose poses are [x y z qx qy qz qw] in the world, whose table is at "
            "z = 1; `split_info/` lists the files of each split, none of which holds demos of two; `meshes/` has container "
            "and object of each instance, in the frame of their poses. Clouds are fused and voxelled, with `normals` toward "
            f"the sensor. The key `dapdata` of each demo holds all that the layout has no room for.{stops}"
        ),
        loader="""```python
import numpy as np
demo = np.load("0/demo_aug_0.npz", allow_pickle=True)["0"].item()  # runs what the file says: only of those whom you trust
points, goal = demo["multi_obj_start_pcd"].item()["child"], demo["multi_obj_final_obj_pose"].item()["child"]
```
""",
        has_arrays=False,
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
    demo = read_demo(sample)
    if not isinstance(demo, MeshDemo):
        demo = MeshDemo(**vars(demo), **vars(pack_meshes(())))
    return to_sample(demo, read_record(Cloud, sample))


def _instance_names(sample: Sample) -> dict[str, str]:
    """Names with decimal numbers: the loader leaves out meshes with "dec" in their name, which a hexadecimal one may have."""
    container, object_ = (int(sample[f"meta/{body}_instance"]) for body in ("container", "object"))
    return {"parent": f"container_{container}", "child": f"object_{object_}"}


# Meshes ----------------------------------------------------------------------------------------------------


def _write_meshes(folder: Path, sample: Sample) -> None:
    """Writes the meshes of a demo's container and object; none of a demo without parts."""
    for name, group, T, found in zip(
        _instance_names(sample).values(),
        ("scene", "object_parts"),
        (sample["scene/T_container_part"], sample["object_parts/T_object_part"]),
        meshes_in(sample),
    ):
        if len(T):
            placed = list(_placed(sample[f"{group}/kind"], sample[f"{group}/size"], T, found))
            (folder / f"{name}.obj").write_text(meshes.to_obj(placed))


def _placed(kind: Array, size: Array, T: Array, found: Sequence[Mesh | None]) -> Iterator[Mesh]:
    """Each part as a mesh, in the frame of its body."""
    for p in range(len(kind)):
        whole = solids.to_trimesh(kind[p : p + 1], size[p : p + 1], T[p : p + 1], meshes=found[p : p + 1])
        yield Mesh(np.asarray(whole.vertices, float), np.asarray(whole.faces))
