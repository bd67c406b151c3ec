"""Meshes from files that nobody vouches for, taken apart, simulated and seen like the solids that they stand for."""

from __future__ import annotations

import builtins
from dataclasses import replace
from pathlib import Path

import mesh_scenes
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from test_simulate import BRICK, CAN, CONFIG, make_scene, standing

from dapdata import draw, meshes, observe, records, rng, simulate, solids, store
from dapdata.errors import FormatError, UsageError
from dapdata.observe.raycast import cast
from dapdata.poses import pose, rotation_about, transform
from dapdata.records import Mesh, MeshDemo, meshes_in, meshes_of, pack_meshes, to_sample
from dapdata.solids import CLUTTER

CUBE = mesh_scenes.box((0.2, 0.1, 0.06), (0.01, 0.02, 0.03))


def file_of(mesh: Mesh, path: Path, kind: str) -> Path:
    target = path / f"mesh.{kind}"
    target.write_bytes(exported(mesh, kind))
    return target


def exported(mesh: Mesh, kind: str) -> bytes:
    data = trimesh.Trimesh(*mesh, process=False).export(file_type=kind)
    return data.encode() if isinstance(data, str) else data


# Reading


@pytest.mark.parametrize("kind", ["obj", "ply", "stl", "stl_ascii", "off"])
def test_every_format_gives_the_same_closed_mesh(kind: str, tmp_path: Path) -> None:
    (tmp_path / f"a.{kind[:3]}").write_bytes(exported(CUBE, kind))
    mesh = meshes.read_mesh(tmp_path / f"a.{kind[:3]}")
    assert meshes.is_closed(mesh)
    assert meshes.volume(mesh) == pytest.approx(0.2 * 0.1 * 0.06)
    assert np.allclose(np.sort(mesh.vertices, axis=0), np.sort(CUBE.vertices, axis=0), atol=1e-6)


TETRAHEDRON = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
PLY = "ply\nformat {form} 1.0\nelement vertex {v}\nproperty float x\nproperty float y\nproperty float z\nelement face {f}\n"
PLY += "property list uchar int vertex_indices\nend_header\n"
HOSTILE = {
    "an stl whose header lies": ("a.stl", bytes(80) + (10**9).to_bytes(4, "little") + bytes(500), "promises 1000000000"),
    "an stl of six bytes": ("a.stl", b"abcdef", "expected an stl file"),
    "a ply with 10^9 faces": ("a.ply", PLY.format(form="binary_little_endian", v=3, f=10**9).encode() + bytes(40), "promises"),
    "a ply with 10^30 vertices": ("a.ply", PLY.format(form="ascii", v=10**30, f=1).encode(), "promises"),
    "an off with 10^9 vertices": ("a.off", b"OFF\n1000000000 1 0\n0 0 0\n", "promises"),
    "vertices that are NaN": ("a.obj", TETRAHEDRON.replace("0.1 0 0", "nan 0 0").encode(), "not finite"),
    "vertices at infinity": ("a.obj", TETRAHEDRON.replace("0.1 0 0", "inf 0 0").encode(), "not finite"),
    "a face of a vertex that is not there": ("a.obj", TETRAHEDRON.encode() + b"f 1 2 99999999\n", "expected"),
    "faces without area": ("a.obj", b"v 0 0 0\nv 0.1 0 0\nv 0.2 0 0\nf 1 2 3\n", "without area"),
    "no faces": ("a.obj", b"v 0 0 0\nv 0.1 0 0\n", "expected"),
    "nothing": ("a.obj", b"", "expected"),
    "random bytes": ("a.ply", np.random.default_rng(0).bytes(5000), "expected"),
    "millimetres": ("a.obj", TETRAHEDRON.replace("0.1", "100").encode(), "the unit is the metre"),
    "a picture": ("a.png", b"\x89PNG", "expected a mesh: .obj, .ply, .stl, .off"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_hostile_file_is_one_clear_error(case: str, tmp_path: Path) -> None:
    name, data, words = HOSTILE[case]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(FormatError, match=words) as error:
        meshes.read_mesh(tmp_path / name)
    assert str(tmp_path / name) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there_or_too_large_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FormatError, match="cannot be read"):
        meshes.read_mesh(tmp_path / "a.obj")
    path = file_of(CUBE, tmp_path, "obj")
    monkeypatch.setattr(meshes, "MAX_BYTES", 100)
    with pytest.raises(FormatError, match="expected 100 at the most"):
        meshes.read_mesh(path)
    monkeypatch.setattr(meshes, "MAX_BYTES", 10_000)
    monkeypatch.setattr(meshes, "MAX_FACES", 11)
    with pytest.raises(FormatError, match="12 faces, expected 11"):
        meshes.read_mesh(path)


def test_what_a_mesh_refers_to_is_not_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "secret.mtl").write_text("newmtl a\n")
    (tmp_path / "a.obj").write_text(f"mtllib secret.mtl\nmtllib {tmp_path}/secret.mtl\nusemtl a\n{TETRAHEDRON}")
    opened, real = [], builtins.open
    monkeypatch.setattr(builtins, "open", lambda file, *rest, **more: opened.append(str(file)) or real(file, *rest, **more))
    assert len(meshes.read_mesh(tmp_path / "a.obj").faces) == 4
    assert not [name for name in opened if "secret" in name]


def test_an_obj_that_is_written_reads_back_to_the_bit(tmp_path: Path) -> None:
    turned = Mesh(transform(pose(rotation_about((1, 2, 3), 0.3)), CUBE.vertices), CUBE.faces)
    (tmp_path / "a.obj").write_text(meshes.to_obj([turned, CUBE]))
    both = meshes.pieces(meshes.read_mesh(tmp_path / "a.obj"))
    for mesh, wanted in zip(both, (turned, CUBE)):
        assert np.array_equal(mesh.vertices, wanted.vertices)
        assert np.array_equal(mesh.faces, wanted.faces)


# Pieces


def test_pieces_are_those_that_share_no_vertices_and_look_outwards() -> None:
    inside_out = Mesh(CUBE.vertices + np.array([0.2, 0, 0]), CUBE.faces[:, ::-1])  # it touches the first one
    found = meshes.pieces(mesh_scenes.joined(CUBE, inside_out, mesh_scenes.cup()))
    assert [len(piece.faces) for piece in found[:2]] == [12, 12]
    assert [meshes.volume(piece) for piece in found[:2]] == pytest.approx([0.0012, 0.0012])
    assert [meshes.is_convex(piece) for piece in found] == [True, True, False]


def test_a_heap_of_crumbs_stays_in_one_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meshes, "MAX_PIECES", 2)
    heap = mesh_scenes.joined(*(mesh_scenes.box((0.01, 0.01, 0.01), (x, 0, 0)) for x in (0, 0.1, 0.2)))
    assert len(meshes.pieces(heap)) == 1


def test_an_open_surface_is_not_convex() -> None:
    assert not meshes.is_convex(Mesh(CUBE.vertices, CUBE.faces[1:]))
    flat = Mesh(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], float), np.array([[0, 1, 2], [0, 2, 1]]))
    assert meshes.is_closed(flat)
    assert not meshes.is_convex(flat)


def test_only_nearly_convex_objects_are_their_hull() -> None:
    dented = Mesh(CUBE.vertices.copy(), CUBE.faces)
    dented.vertices[0] *= 0.99
    (piece,) = meshes.convex_pieces(dented)  # type: ignore[misc]
    assert meshes.is_convex(piece)
    assert meshes.volume(piece) >= meshes.volume(dented)
    assert meshes.convex_pieces(mesh_scenes.cup()) is None
    assert len(meshes.convex_pieces(mesh_scenes.joined(CUBE, CUBE))) == 2  # type: ignore[arg-type]


def test_the_centre_of_mass_is_that_of_the_volume() -> None:
    cone = mesh_scenes.as_mesh(trimesh.creation.cone(0.05, 0.2, sections=64))
    assert np.allclose(meshes.centre_of_mass(cone), [0, 0, 0.05], atol=1e-6)
    assert np.allclose(meshes.centre_of_mass(CUBE), [0.01, 0.02, 0.03])
    size, T, local = meshes.centred(cone, by_mass=True)
    assert np.allclose(transform(T, local.vertices), cone.vertices, atol=1e-7)
    assert (np.abs(local.vertices) <= size / 2 + 1e-9).all()


def test_a_shrunk_box_is_smaller_on_every_side_and_a_thin_one_does_not_vanish() -> None:
    assert np.allclose(np.ptp(meshes.shrunk(CUBE, 0.001).vertices, axis=0), [0.198, 0.098, 0.058])
    thin = meshes.shrunk(mesh_scenes.box((0.1, 0.1, 0.001)), 0.001)
    assert np.ptp(thin.vertices, axis=0)[2] == pytest.approx(0.0001)


def test_upward_faces_of_a_mesh_are_those_of_the_solid() -> None:
    T = np.stack([pose(rotation_about((0, 0, 1), 0.4), (0.3, 0.1, 0.2)), np.eye(4)])
    faces = meshes.upward_faces([mesh_scenes.box((0.2, 0.1, 0.06)), None], T)
    assert faces.area.sum() == pytest.approx(0.02)
    assert set(faces.part.tolist()) == {0}
    points = solids.points_on_faces(faces, 4000, rng.stream(0, "test", 0))
    local = (points - T[0, :3, 3]) @ T[0, :3, :3]
    assert np.allclose(local[:, 2], 0.03)
    assert (np.abs(local[:, :2]) <= [0.1, 0.05]).all()
    assert np.histogram2d(*local[:, :2].T, bins=4)[0].min() > 180, "even: 250 to a cell"


def test_sharp_edges_are_those_of_the_solid_and_no_diagonals() -> None:
    assert len(meshes.sharp_edges(CUBE)) == 12
    assert len(np.unique(meshes.smooth_groups(CUBE))) == 6
    can = mesh_scenes.as_mesh(trimesh.creation.cylinder(0.03, 0.1, sections=32))
    assert len(meshes.sharp_edges(can)) == 64, "the two rims"
    assert len(np.unique(meshes.smooth_groups(can))) == 3


# In records


def test_meshes_travel_in_the_arrays_of_a_demo() -> None:
    packed = pack_meshes([None, CUBE, mesh_scenes.cup()])
    demo = replace(mesh_demo(), **vars(packed))
    demo = replace(demo, part_kind=np.array([0, 3]), object_kind=np.array([3]))
    for container, thing in (meshes_of(demo), meshes_in(to_sample(demo))):
        assert container[0] is None
        for found, wanted in zip((container[1], thing[0]), (CUBE, mesh_scenes.cup())):
            assert found is not None
            assert np.allclose(found.vertices, wanted.vertices, atol=1e-7)
            assert np.array_equal(found.faces, wanted.faces)


def mesh_demo() -> MeshDemo:
    scene = mesh_scenes.in_meshes(make_scene([standing(x=0.1)]))
    demo = simulate.demonstrate(scene, CONFIG, rng.stream(0, "test", 0))
    assert isinstance(demo, MeshDemo)
    return demo


def test_arrays_that_are_no_meshes_are_found_before_they_are_stored() -> None:
    sample = to_sample(mesh_demo())
    assert not list(store.problems(sample))
    wrong = {
        "mesh_faces/vertices": sample["mesh_faces/vertices"] + len(sample["mesh_vertices/points"]),
        "mesh_vertices/part": np.roll(sample["mesh_vertices/part"], 1),
        "scene/kind": np.zeros_like(sample["scene/kind"]),
    }
    for path, array in wrong.items():
        assert list(store.problems(sample | {path: array})), path


# In the simulator

SCENES = {
    "a can": make_scene([standing(), standing(x=0.1, z=-0.004), standing(z=0.05), standing(x=0.4)]),
    "a can between cans": make_scene(
        [standing(), standing(y=0.01)], [solids.cylinder(0.03, 0.1, (0, y, 0.05), CLUTTER) for y in (-0.063, 0.065)]
    ),
    "a brick": make_scene([standing(), standing(y=0.1795), standing(y=0.1815)], things=BRICK, symmetry="box"),
}


@pytest.mark.parametrize("name", SCENES)
def test_meshes_are_simulated_like_the_solids_that_they_stand_for(name: str) -> None:
    scene = SCENES[name]
    same = mesh_scenes.in_meshes(scene)
    poses, reasons = simulate.settle(scene, scene.T_container_goal, CONFIG)
    mesh_poses, mesh_reasons = simulate.settle(same, scene.T_container_goal, CONFIG)
    assert mesh_reasons == reasons
    assert "ok" in reasons
    assert np.abs(mesh_poses - poses)[:, :3, 3].max() < 2e-4
    demos = [simulate.demonstrate(one, CONFIG, rng.stream(0, "test", 0)) for one in (scene, same)]
    predictions = scene.T_world_container @ np.concatenate([scene.T_container_goal, poses])
    for of_solid, of_mesh in zip(*(simulate.judge(demo, predictions, CONFIG) for demo in demos)):  # type: ignore[arg-type]
        assert of_mesh.reason == of_solid.reason
        assert of_mesh.penetration == pytest.approx(of_solid.penetration, abs=2e-4, nan_ok=True)
        assert of_mesh.gap == pytest.approx(of_solid.gap, abs=2e-4, nan_ok=True)


def test_a_container_in_one_piece_that_is_not_convex_holds_what_stands_in_it() -> None:
    scene = make_scene([standing(z=0.005), standing(x=0.017, z=0.005), standing(z=0.02)])
    scene = mesh_scenes.of_meshes(
        scene, [mesh_scenes.cup()], [mesh_scenes.part_mesh(*map(np.array, (1, CAN[0].size, CAN[0].T)))]
    )
    up = np.array([0.0, 0, 1])
    scene = replace(scene, opening=up, goal_approach=np.tile(up, (3, 1)))
    poses, reasons = simulate.settle(scene, scene.T_container_goal, CONFIG)
    assert reasons == ["ok", "penetrates", "unsupported"]
    assert poses[0, 2, 3] == pytest.approx(0.055, abs=1e-4)


def test_an_object_of_several_convex_pieces_rests_on_its_true_underside() -> None:
    table = [mesh_scenes.box((0.1, 0.3, 0.06), (x, 0, 0.03)) for x in (-0.1, 0.1)]
    thing = [mesh_scenes.box((0.26, 0.05, 0.02), (0, 0, 0.03)), mesh_scenes.box((0.04, 0.04, 0.06), (0, 0, -0.01))]
    scene = mesh_scenes.of_meshes(make_scene([pose(None, (0, 0, 0.0405))], symmetry="none"), table, thing)
    settled = simulate.drop(scene, scene.T_container_goal, CONFIG, 1.0)
    assert settled[0, 2, 3] == pytest.approx(0.04, abs=2e-4), "the bar lies on both tables, the stem hangs between"
    assert simulate.free_play(scene, settled, CONFIG) == pytest.approx([0.06], abs=1e-3)


def test_free_play_between_walls_is_that_between_walls() -> None:
    walls = [solids.box((0.1, 0.01, 0.1), (0, side * 0.03, 0.05), CLUTTER) for side in (-1, 1)]
    scene = make_scene([standing()], walls, BRICK, "box")
    leaning = np.stack([standing(), standing(y=0.005)])
    for one in (scene, mesh_scenes.in_meshes(scene)):
        assert simulate.free_play(one, leaning, CONFIG) == pytest.approx([0.01, 0.01], abs=1e-4)
    assert simulate.free_play(make_scene([standing()], walls=[solids.box((1, 1, 0.01), (0, 0, -0.005))]), leaning, CONFIG) == (
        pytest.approx([solids.UNBOUNDED] * 2)
    )


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda d: replace(d, mesh_points=np.full_like(d.mesh_points, np.nan)), "not finite"),
        (lambda d: replace(d, mesh_points=np.zeros_like(d.mesh_points)), "without area"),
        (lambda d: replace(d, part_kind=np.zeros_like(d.part_kind)), "got a box with triangles"),
        (lambda d: replace(d, part_kind=np.full_like(d.part_kind, 9)), "got kind 9"),
        (lambda d: replace(d, object_kind=np.zeros_like(d.object_kind)), "got a box with triangles"),
        (lambda d: replace(d, **vars(pack_meshes([*meshes_of(d)[0], mesh_scenes.cup()]))), "not convex"),
        (lambda d: records.read_record(records.Demo, to_sample(d)), "got a mesh without triangles"),
    ],
)
def test_meshes_that_could_crash_the_simulator_are_refused_first(damage, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        simulate.judge(damage(mesh_demo()), np.eye(4)[None], CONFIG)


# As seen


def test_a_camera_sees_a_mesh_like_the_solid() -> None:
    scene = make_scene([standing()], things=BRICK)
    same = mesh_scenes.in_meshes(scene)
    T_camera_container = pose(np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0.0]]), (0, 0.12, 0.9))
    K = np.array([[200.0, 0, 80], [0, 200, 60], [0, 0, 1]])
    image = cast(scene.part_kind, scene.part_size, T_camera_container @ scene.T_container_part, K, 160, 120)
    depth, part, normal = meshes.cast(meshes_of(same)[0], T_camera_container @ same.T_container_part, K, 160, 120, 0.01, 10.0)
    seen = (image.part >= 0) & (part >= 0)
    assert (seen == (image.part >= 0)).mean() > 0.999
    assert np.abs(depth - image.depth)[seen].max() < 1e-3
    assert np.median(np.abs(depth - image.depth)[seen]) < 1e-6
    assert (part == image.part)[seen].mean() > 0.995
    assert (np.einsum("hwk,hwk->hw", normal, image.normal)[seen] > 0.999).mean() > 0.995


def test_a_scene_of_meshes_is_observed_like_one_of_solids_and_the_two_hide_each_other() -> None:
    cameras, noise = observe.CamerasConfig(width=160, height=120), observe.NoiseConfig(preset="none")
    scene = make_scene([standing(x=0.1)], [solids.cylinder(0.05, 0.2, (-0.1, 0, 0.1), CLUTTER)])
    demos = [simulate.demonstrate(one, CONFIG, rng.stream(0, "test", 0)) for one in (scene, mesh_scenes.in_meshes(scene))]
    of_solids, of_meshes = demos
    assert isinstance(of_meshes, MeshDemo)
    half = np.arange(len(of_meshes.part_kind)) % 2 == 0
    container, thing = meshes_of(of_meshes)
    mixed = replace(
        of_meshes,
        part_kind=np.where(half, of_meshes.part_kind, of_solids.part_kind),  # type: ignore[union-attr]
        **vars(pack_meshes([*(mesh if mine else None for mesh, mine in zip(container, half)), *thing])),
    )
    clouds = [observe.observe(demo, cameras, noise, rng.stream(0, "test", 1)) for demo in (of_solids, of_meshes, mixed)]  # type: ignore[arg-type]
    tree = cKDTree(clouds[0].container_points)  # type: ignore[union-attr]
    for cloud in clouds[1:]:
        assert len(cloud.container_points) == pytest.approx(len(clouds[0].container_points), rel=0.02)  # type: ignore[union-attr]
        assert np.quantile(tree.query(cloud.container_points)[0], 0.98) < 0.002  # type: ignore[union-attr]


def test_a_mesh_is_drawn_like_the_solid() -> None:
    camera = draw.frame(np.array([[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]]), (1, -0.4, 0.5), 120, 90)
    pictures = []
    for kind, triangles in ((0, None), (solids.MESH, mesh_scenes.box((0.2, 0.1, 0.06)))):
        canvas = draw.blank(camera)
        size = np.array([[0.2, 0.1, 0.06]])
        parts = draw.triangulate(np.array([kind]), size, np.eye(4)[None], meshes=[triangles])
        draw.draw_solids(canvas, parts, (0.8, 0.2, 0.2))
        pictures.append(draw.image(canvas).astype(int))
    assert pictures[0].min() < 150
    assert (np.abs(pictures[0] - pictures[1]).max(axis=2) > 8).mean() < 0.005


def test_pieces_are_found_in_files_that_keep_a_vertex_for_each_face_and_closed_ones_that_touch_stay_apart() -> None:
    boxes = [mesh_scenes.box((0.1, 0.1, 0.1)), mesh_scenes.box((0.1, 0.1, 0.1), (0.1, 0, 0))]
    assert [meshes.is_convex(piece) for piece in meshes.pieces(mesh_scenes.joined(*boxes))] == [True, True]
    single = Mesh(boxes[0].vertices[boxes[0].faces].reshape(-1, 3), np.arange(36).reshape(-1, 3))
    (piece,) = meshes.pieces(single)
    assert meshes.is_convex(piece)
    assert meshes.volume(piece) == pytest.approx(1e-3)
    mixed = meshes.pieces(mesh_scenes.joined(single, boxes[1]))
    assert sorted(len(piece.vertices) for piece in mixed) == [8, 8]


def test_a_rod_has_a_long_axis_and_a_brick_has_none() -> None:
    turned = rotation_about((1, 2, 3), 0.7)
    rod = mesh_scenes.box((0.01, 0.012, 0.1))
    axis = meshes.long_axis(Mesh(rod.vertices @ turned.T, rod.faces))
    assert np.abs(axis @ turned[:, 2]) == pytest.approx(1)
    assert meshes.long_axis(mesh_scenes.box((0.05, 0.04, 0.1))) is None
