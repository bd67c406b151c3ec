"""Meshes whose answers are known, and scenes of primitives as scenes of meshes."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import trimesh

from dapdata import meshes, solids
from dapdata.records import Mesh, Meshes, MeshScene, Scene, pack_meshes


def as_mesh(found: trimesh.Trimesh) -> Mesh:
    return Mesh(np.asarray(found.vertices, float), np.asarray(found.faces, np.int64))


def box(size, centre=(0.0, 0.0, 0.0)) -> Mesh:
    return as_mesh(trimesh.creation.box(extents=size, transform=trimesh.transformations.translation_matrix(centre)))


def joined(*parts: Mesh) -> Mesh:
    """One mesh of pieces that share no vertices."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts)])
    return Mesh(np.concatenate([part.vertices for part in parts]), faces)


def cup(radius=0.05, height=0.08, wall=0.005) -> Mesh:
    """A closed mesh that is not convex: a cup that stands at z = 0, open to the top."""
    inner, floor = radius - wall, wall
    profile = [(0, 0), (radius, 0), (radius, height), (inner, height), (inner, floor), (0, floor)]
    return as_mesh(trimesh.creation.revolve(profile, sections=48))


def part_mesh(kind, size, T) -> Mesh:
    return as_mesh(solids.to_trimesh(kind[None], size[None], T[None], sections=64))


def in_meshes(scene: Scene) -> MeshScene:
    """The same scene with every part as a mesh."""
    container = [part_mesh(*part) for part in zip(scene.part_kind, scene.part_size, scene.T_container_part)]
    thing = [part_mesh(*part) for part in zip(scene.object_kind, scene.object_size, scene.T_object_part)]
    return of_meshes(scene, container, thing)


def of_meshes(scene: Scene, container: list[Mesh], thing: list[Mesh]) -> MeshScene:
    """A scene with other parts, which are meshes in the frame of the container and of the object."""
    parts, things = [meshes.centred(mesh) for mesh in container], [meshes.centred(mesh, by_mass=True) for mesh in thing]
    packed = pack_meshes([mesh for *_, mesh in (*parts, *things)])
    kept = {f.name: getattr(scene, f.name) for f in fields(Scene)}
    own = {
        "part_kind": np.full(len(parts), solids.MESH, np.uint8),
        "part_size": np.array([size for size, _, _ in parts]),
        "T_container_part": np.array([T for _, T, _ in parts]),
        "part_role": np.zeros(len(parts), np.uint8),
        "object_kind": np.full(len(things), solids.MESH, np.uint8),
        "object_size": np.array([size for size, _, _ in things]),
        "T_object_part": np.array([T for _, T, _ in things]),
    }
    return MeshScene(**kept | own, **{f.name: getattr(packed, f.name) for f in fields(Meshes)})
