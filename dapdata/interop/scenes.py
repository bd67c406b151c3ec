"""Scenes as solids: GLB to look at, URDF to simulate; a folder a demo.

`scene.glb` and `scene.urdf` hold the same frames: `container`; `clutter_000`, ... that stand in it; `object_start`, the
object as observed; and `goal_000`, ..., one for each row of `goals/T_world_object`. In URDF all of them are fixed to the
link `world`; container and clutter collide, start and goals are only to be seen. The object itself, to be put anywhere,
is `object.urdf`, with the mass of the recipe. `scene.json` says which goal was demonstrated.

Metres, z up. glTF has y up by its own definition, so in GLB everything hangs below one node, `z_up`, that is the world
frame: viewers show the scene upright, and poses relative to that node are those of the shards.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from dapdata import durable, pictures, records, solids
from dapdata.card import Form
from dapdata.errors import UsageError
from dapdata.interop.export import Export, Piece, Progress, Row, by_demo, choose, demo_name, readme, run
from dapdata.meshes import is_convex
from dapdata.poses import pose
from dapdata.records import Array, Mesh
from dapdata.solids import BOX, CYLINDER, Color, Node
from dapdata.store import Sample

COLORS: dict[str, Color] = {  # of the pictures
    "container": (*pictures.WOOD, 1.0),
    "clutter": (*pictures.CLUTTER, 1.0),
    "object": (0.35, 0.55, 0.80, 1.0),
    "goal": (*pictures.VALID, 0.5),
    "demonstrated": (*pictures.DEMONSTRATED, 0.8),
}
SECTIONS = 32  # sides of a cylinder in GLB: half a percent of its radius off


def export(
    dataset: str | Path,
    out: str | Path,
    *,
    split: str | None = None,
    demos: int | None = None,
    progress: Progress | None = None,
) -> Path:
    """Writes the scenes of a labelled dataset as `<split>/demo_000000/scene.glb`, ... and returns the folder.

    Args:
        dataset: The dataset's folder.
        out: The folder to write, see `export.run`.
        split, demos: See `export.choose`.
        progress: Called with demos done and demos in all.

    Raises:
        UsageError: for a scene whose parts nobody knows, as of an import without meshes.
        MissingExtraError: without trimesh.
    """
    chosen = choose(dataset, split, demos)
    placement = chosen.dataset.recipe["placement"]

    def write(piece: Piece, folder: Path, rows: Iterator[Row]) -> None:
        for about, sample in rows:
            _write(folder, about, sample, placement["mass"], placement["friction"])

    pieces = by_demo(chosen)
    return run(out, Export("scenes", {}, chosen, pieces, write, readme(chosen, _form(pieces[0].path))), progress)


def _form(folder: str) -> Form:
    """The card's words about these files."""
    return Form(
        files=(
            "A folder for each demo, in one for each split: `scene.glb` (to look at; everything hangs below the node `z_up`, "
            "the world frame), `scene.urdf` (container and clutter, fixed and solid; the object's start and every goal "
            "as frames to be seen), `object.urdf` (the object, with mass and inertia), `scene.json` (which goal was "
            "demonstrated, and what is known of the demo). Metres, z up."
        ),
        loader=f"""```python
import trimesh
T_world_object = trimesh.load("{folder}/scene.glb").graph.get("goal_000", "z_up")[0]
```
""",
        has_arrays=False,
    )


def _write(folder: Path, about: dict[str, Any], sample: Sample, mass: float, friction: float) -> None:
    """The files of one demo, in a new folder."""
    if not len(sample["object_parts/kind"]):
        raise UsageError(
            f"demo {about['demo']}: nobody knows its solids, expected a scene to write; import the data with their meshes"
        )
    folder.mkdir()
    demonstrated = int(np.flatnonzero(pictures.is_demonstrated(sample))[0])
    frames = list(_frames(sample, demonstrated))
    thing = Frame("object", "", np.eye(4), _object(sample), "object", collides=True)
    (folder / "scene.glb").write_bytes(_glb(frames))
    (folder / "scene.urdf").write_bytes(_scene_urdf(frames, demo_name(about["demo"]), folder))
    (folder / "object.urdf").write_bytes(_robot("object", [_link(thing, folder, mass)]))
    told = about | {
        "demonstrated_goal": demonstrated,
        "goal_kinds": [records.GOAL_KINDS[kind] for kind in sample["goals/kind"]],
        "goal_clearances": sample["goals/clearance"].tolist(),  # m
        "mass": mass,  # kg
        "friction": friction,  # of object and container each
        "max_tilt": sample["scene/max_tilt"].item(),  # rad
        "opening": sample["scene/opening"].tolist(),  # container frame
        "symmetry": records.SYMMETRIES[int(sample["symmetry/kind"])],
        "symmetry_axis": sample["symmetry/axis"].tolist(),  # object frame
    }
    (folder / "scene.json").write_bytes(durable.canonical(told))


# Frames ----------------------------------------------------------------------------------------------------


class Parts(NamedTuple):
    """P parts as in `records.Scene`, their poses in the frame that holds them."""

    kind: Array  # (P,)
    size: Array  # (P, 3), m
    T: Array  # (P, 4, 4)
    meshes: Sequence[Mesh | None]  # P

    def of(self, rows: Array) -> Parts:
        """Some of them."""
        return Parts(self.kind[rows], self.size[rows], self.T[rows], [self.meshes[row] for row in rows])

    def to_trimesh(self, sections: int = 64) -> Any:
        """All of them as one `trimesh.Trimesh`, not united; cylinders with so many sides."""
        return solids.to_trimesh(self.kind, self.size, self.T, sections, self.meshes)


class Frame(NamedTuple):
    """A frame of the scene with what is seen in it."""

    name: str
    parent: str  # "" for the world
    T: Array  # (4, 4) T_parent_frame
    parts: Parts
    look: str  # key of COLORS
    collides: bool = False

    @property
    def mesh(self) -> str:
        """Frames of one name show the same parts in the same colour."""
        return self.name if self.look == "clutter" else self.look


def _frames(sample: Sample, demonstrated: int) -> Iterator[Frame]:
    """The frames of a scene, parents first."""
    of_scene, _ = records.meshes_in(sample)
    parts = Parts(sample["scene/kind"], sample["scene/size"], sample["scene/T_container_part"], of_scene)
    is_clutter = sample["scene/role"] == records.ROLES.index("clutter")
    own = parts.of(np.flatnonzero(~is_clutter))
    yield Frame("container", "", sample["pose/T_world_container"], own, "container", collides=True)
    for i, part in enumerate(np.flatnonzero(is_clutter)):
        centred = parts.of(np.array([part]))._replace(T=np.eye(4)[None])
        yield Frame(f"clutter_{i:03d}", "container", parts.T[part], centred, "clutter", collides=True)
    thing = _object(sample)
    yield Frame("object_start", "", sample["pose/T_world_object_start"], thing, "object")
    for i, T_world_object in enumerate(sample["goals/T_world_object"]):
        yield Frame(f"goal_{i:03d}", "", T_world_object, thing, "demonstrated" if i == demonstrated else "goal")


def _object(sample: Sample) -> Parts:
    _, of_object = records.meshes_in(sample)
    return Parts(sample["object_parts/kind"], sample["object_parts/size"], sample["object_parts/T_object_part"], of_object)


def _glb(frames: Sequence[Frame]) -> bytes:
    seen = {frame.mesh: frame for frame in frames}
    meshes = {name: (frame.parts.to_trimesh(SECTIONS), COLORS[frame.look]) for name, frame in seen.items()}
    return solids.to_glb([Node(frame.name, frame.parent, frame.T, frame.mesh) for frame in frames], meshes)


# URDF ------------------------------------------------------------------------------------------------------


def _scene_urdf(frames: Sequence[Frame], name: str, folder: Path) -> bytes:
    elements = [ElementTree.Element("link", name="world")]
    for frame in frames:
        joint = ElementTree.Element("joint", name=f"{frame.parent or 'world'}_to_{frame.name}", type="fixed")
        ElementTree.SubElement(joint, "parent", link=frame.parent or "world")
        ElementTree.SubElement(joint, "child", link=frame.name)
        _origin(joint, frame.T)
        elements += [_link(frame, folder), joint]
    return _robot(name, elements)


def _robot(name: str, elements: Sequence[ElementTree.Element]) -> bytes:
    """A URDF file of links and joints."""
    robot = ElementTree.Element("robot", name=name)
    used = {material.get("name") for element in elements for material in element.iter("material")}
    for look, color in COLORS.items():
        if look in used:
            ElementTree.SubElement(ElementTree.SubElement(robot, "material", name=look), "color", rgba=_numbers(color))
    robot.extend(elements)
    ElementTree.indent(robot)
    data: bytes = ElementTree.tostring(robot, encoding="utf-8", xml_declaration=True)
    return data + b"\n"


def _link(frame: Frame, folder: Path, mass: float | None = None) -> ElementTree.Element:
    """A link; the meshes of solids that URDF has no word for are written beside it."""
    link = ElementTree.Element("link", name=frame.name)
    if mass is not None:
        link.append(_inertial(frame.parts, mass))
    for i, (kind, size, T, triangles) in enumerate(zip(*frame.parts)):
        mesh = folder / f"{frame.mesh}_{i}.stl"
        if kind not in (BOX, CYLINDER) and not mesh.exists():
            whole = frame.parts.of(np.array([i]))._replace(T=np.eye(4)[None]).to_trimesh()
            mesh.write_bytes(whole.export(file_type="stl"))
        for role in ("visual", "collision") if frame.collides else ("visual",):
            element = ElementTree.SubElement(link, role)
            if role == "collision" and triangles is not None and not is_convex(triangles):
                element.set("concave", "yes")  # PyBullet's own word; others pass over it
            _origin(element, T)
            geometry = ElementTree.SubElement(element, "geometry")
            if kind == BOX:
                ElementTree.SubElement(geometry, "box", size=_numbers(size))
            elif kind == CYLINDER:
                ElementTree.SubElement(geometry, "cylinder", radius=_numbers([size[0] / 2]), length=_numbers([size[2]]))
            else:
                ElementTree.SubElement(geometry, "mesh", filename=mesh.name)
            if role == "visual":
                ElementTree.SubElement(element, "material", name=frame.look)
    return link


def _inertial(parts: Parts, mass: float) -> ElementTree.Element:
    """Mass, centre of mass and inertia of parts of one density; where they overlap it counts twice."""
    mesh = parts.to_trimesh()
    mesh.density = mass / mesh.volume
    inertial = ElementTree.Element("inertial")
    _origin(inertial, pose(None, mesh.center_mass))
    ElementTree.SubElement(inertial, "mass", value=_numbers([mass]))
    I = mesh.moment_inertia  # noqa: E741 (the field's name)
    names = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ElementTree.SubElement(inertial, "inertia", {name: _numbers([I[at]]) for name, at in names.items()})
    return inertial


def _origin(element: ElementTree.Element, T: Array) -> None:
    ElementTree.SubElement(element, "origin", xyz=_numbers(T[:3, 3]), rpy=_numbers(_roll_pitch_yaw(T[:3, :3])))


def _roll_pitch_yaw(R: Array) -> tuple[float, float, float]:
    """The angles (rad) about the fixed axes x, then y, then z that make up a rotation, as URDF wants them."""
    level = np.hypot(R[0, 0], R[1, 0])
    pitch = np.arctan2(-R[2, 0], level)
    if level < 1e-9:  # straight up or down: only the sum of roll and yaw is known
        return 0.0, pitch, np.arctan2(-R[0, 1], R[1, 1])
    return np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])


def _numbers(values: Iterable[float]) -> str:
    """Numbers to a picometre, without a negative zero."""
    return " ".join(f"{float(np.round(value, 12)) + 0.0:.12g}" for value in values)
