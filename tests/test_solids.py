"""Primitives measured in one way agree with what another says."""

from __future__ import annotations

import numpy as np
import pytest

from dapdata import solids
from dapdata.errors import UsageError
from dapdata.poses import pose, random_rotation, transform
from dapdata.solids import UNBOUNDED, box, cylinder, ellipsoid

SHAPES = [box((0.1, 0.04, 0.2), (0, 0, 0)), cylinder(0.03, 0.1, (0, 0, 0)), ellipsoid((0.1, 0.06, 0.04), (0, 0, 0))]


def arrays(*parts):
    return solids.collect(parts)[:3]


def scattered(seed: int = 0):
    """The three shapes at random poses."""
    draw = np.random.default_rng(seed)
    return [part._replace(T=pose(random_rotation(draw), draw.uniform(-0.1, 0.1, 3))) for part in SHAPES]


def around(T, draw, count=4000):
    return transform(T, draw.uniform(-0.2, 0.2, (count, 3)))


@pytest.mark.parametrize("shape", range(3))
def test_surface_points_lie_on_the_surface_and_fill_the_bounding_box(shape):
    part = scattered()[shape]
    points = solids.surface_points(*arrays(part), 20_000, np.random.default_rng(1))
    assert points.shape == (20_000, 3)
    assert np.abs(solids.signed_distance(points, *arrays(part))).max() < 1e-9
    low, high = solids.bounds(*arrays(part))[0]
    assert (points >= low - 1e-12).all()
    assert (points <= high + 1e-12).all()
    assert np.abs(points.min(axis=0) - low).max() < 0.004
    assert np.abs(points.max(axis=0) - high).max() < 0.004


@pytest.mark.parametrize("shape", range(3))
def test_surface_points_are_even(shape):
    """Against a fine mesh: as many points beyond any plane."""
    kind, size, T = arrays(SHAPES[shape])
    points = solids.surface_points(kind, size, T, 40_000, np.random.default_rng(2))
    mesh = solids.to_trimesh(kind, size, T, sections=256)
    triangle = np.random.default_rng(3).choice(len(mesh.area_faces), 40_000, p=mesh.area_faces / mesh.area)
    corner = np.random.default_rng(4).dirichlet([1, 1, 1], 40_000)
    others = np.einsum("nc,ncd->nd", corner, mesh.triangles[triangle])
    for axis in range(3):
        for share in (0.1, 0.25, 0.4, 0.49):
            beyond = [(sample[:, axis] > share * size[0, axis]).mean() for sample in (points, others)]
            assert beyond[0] == pytest.approx(beyond[1], abs=0.015)


@pytest.mark.parametrize("shape", range(3))
def test_signed_distance_is_that_to_the_nearest_surface_point(shape):
    part, draw = scattered(3)[shape], np.random.default_rng(4)
    surface = solids.surface_points(*arrays(part), 60_000, draw)
    points = around(part.T, draw, 300)
    nearest = np.sqrt(((points[:, None] - surface[None, ::3]) ** 2).sum(axis=2).min(axis=1))
    distance = solids.signed_distance(points, *arrays(part))
    assert np.abs(np.abs(distance) - nearest).max() < 0.003
    local = (points - part.T[:3, 3]) @ part.T[:3, :3] / (np.array(part.size) / 2)
    inside = [np.abs(local).max(axis=1) < 1, (np.hypot(local[:, 0], local[:, 1]) < 1) & (np.abs(local[:, 2]) < 1)]
    inside.append((local**2).sum(axis=1) < 1)
    assert np.array_equal(distance < 0, inside[shape])


def test_signed_distance_to_an_ellipsoid_holds_on_its_axes_and_centre():
    kind, size, T = arrays(SHAPES[2])
    points = np.array([[0, 0, 0], [0.08, 0, 0], [0, 0, 0.05], [0, 0.01, 0], [0.05, 0, 0]], float)
    assert np.allclose(solids.signed_distance(points, kind, size, T), [-0.02, 0.03, 0.03, -np.sqrt(0.00032), 0], atol=1e-8)


def test_signed_distance_to_several_is_the_least():
    parts, points = scattered(), np.random.default_rng(0).uniform(-0.2, 0.2, (200, 3))
    each = [solids.signed_distance(points, *arrays(part)) for part in parts]
    assert np.array_equal(solids.signed_distance(points, *arrays(*parts)), np.min(each, axis=0))


def test_the_mesh_has_the_same_bounds_and_volume():
    parts = scattered(7)
    mesh = solids.to_trimesh(*arrays(*parts))
    low, high = (solids.bounds(*arrays(*parts)).reshape(-1, 2, 3)[:, i] for i in range(2))
    assert np.allclose(mesh.bounds, [low.min(axis=0), high.max(axis=0)], atol=3e-4)
    volume = 0.1 * 0.04 * 0.2 + np.pi * 0.03**2 * 0.1 + np.pi / 6 * 0.1 * 0.06 * 0.04
    assert mesh.volume == pytest.approx(volume, rel=0.01)


def test_upward_faces_are_tops_only():
    lying = cylinder(0.03, 0.1, (0.5, 0, 0), rotation=pose()[:3, [2, 0, 1]])
    faces = solids.upward_faces(*arrays(*SHAPES, lying))
    assert faces.part.tolist() == [0, 1]
    assert np.allclose(faces.T[:, :3, 2], [[0, 0, 1]] * 2)
    assert np.allclose(faces.T[:, 2, 3], [0.1, 0.05])
    assert np.allclose(faces.area, [0.1 * 0.04, np.pi * 0.03**2])


def test_points_on_faces_are_on_the_faces_in_proportion_to_area():
    upside_down = box((0.1, 0.1, 0.02), (0.3, 0, 0), rotation=np.diag([1.0, -1, -1]))
    faces = solids.upward_faces(*arrays(*SHAPES[:2], upside_down))
    points = solids.points_on_faces(faces, 20_000, np.random.default_rng(0))
    assert np.abs(solids.signed_distance(points, *arrays(*SHAPES[:2], upside_down))).max() < 0.031
    on_third = np.abs(points[:, 0] - 0.3) <= 0.05
    assert np.allclose(points[on_third, 2], 0.01)
    assert on_third.mean() == pytest.approx(faces.area[2] / faces.area.sum(), abs=0.02)


def test_a_shelf_is_closed_but_for_its_front_and_its_boards_only_touch():
    parts = solids.open_shelf(0.4, 0.2, 0.25, 2, 0.006, 0.004, True)
    kind, size, T = arrays(*parts)
    assert np.allclose(solids.bounds(kind, size, T)[:, 0].min(axis=0), [-0.1, -0.2, 0])
    assert np.allclose(solids.bounds(kind, size, T)[:, 1].max(axis=0), [0.1, 0.2, 0.506])
    for i, part in enumerate(parts):
        others = [other for j, other in enumerate(parts) if j != i]
        low, high = solids.bounds(*arrays(part))[0] + [[1e-4] * 3, [-1e-4] * 3]
        grid = np.random.default_rng(i).uniform(low, high, (2000, 3))
        assert solids.signed_distance(grid, *arrays(*others)).min() > 0
    for direction, is_open in (((1, 0, 0), True), ((-1, 0, 0), False), ((0, 1, 0), False), ((0, -1, 0), False)):
        way = np.array([0, 0, 0.125]) + np.linspace(0, 0.3, 600)[:, None] * direction
        assert (solids.signed_distance(way, kind, size, T).min() > 0) == is_open


def test_a_plate_with_holes_is_solid_but_for_the_holes():
    """Against its definition, point by point; and its boxes meet without overlap, as their volumes add up."""
    x, y, margin = np.array([-0.05, 0.05]), np.array([-0.08, 0.0, 0.08]), (0.01, 0.02)
    parts = solids.plate_with_holes(x, y, 0.06, margin, 0.02, 0.05)
    kind, size, T = arrays(*parts)
    assert np.allclose(solids.bounds(kind, size, T)[:, 0].min(axis=0), [-0.09, -0.13, 0.02])
    assert np.allclose(solids.bounds(kind, size, T)[:, 1].max(axis=0), [0.09, 0.13, 0.05])
    points = np.random.default_rng(0).uniform((-0.089, -0.129, 0.021), (0.089, 0.129, 0.049), (4000, 3))
    in_hole = (np.abs(points[:, None, 0] - x).min(axis=1) < 0.03) & (np.abs(points[:, None, 1] - y).min(axis=1) < 0.03)
    assert np.array_equal(solids.signed_distance(points, kind, size, T) > 0, in_hole)
    assert size.prod(axis=1).sum() == pytest.approx(0.03 * (0.18 * 0.26 - 6 * 0.06**2))


def test_the_centre_of_mass_is_that_of_a_mesh():
    pytest.importorskip("trimesh")
    parts = [part._replace(T=part.T @ pose(None, (0.3 * i, 0, 0))) for i, part in enumerate(scattered(3))]
    mesh = solids.to_trimesh(*arrays(*parts), sections=256)
    assert np.allclose(solids.centre_of_mass(*arrays(*parts)), mesh.center_mass, atol=2e-4)
    raised = solids.moved(parts, pose(None, (0, 0, 1)))
    assert np.allclose(solids.centre_of_mass(*arrays(*raised)) - mesh.center_mass, [0, 0, 1], atol=2e-4)


@pytest.mark.parametrize("thing", [box((0.06, 0.06, 0.1), (0, 0, 0.05)), cylinder(0.03, 0.1, (0, 0, 0.05))])
def test_free_play_between_two_boxes_is_the_gap_that_is_left(thing):
    walls = [box((0.5, 0.02, 0.1), (0, y, 0.05)) for y in (-0.044, 0.047)]
    kind, size, T = arrays(*walls)
    bounds = solids.bounds(kind, size, T)
    assert solids.free_play(thing, kind, size, bounds) == pytest.approx(0.011, abs=1e-9)
    above = thing._replace(T=pose(None, (0, 0, 0.151)))
    assert solids.free_play(above, kind, size, bounds) == UNBOUNDED


def test_free_play_of_a_can_between_cans_is_the_sum_of_the_gaps():
    cans = [cylinder(0.03, 0.1, (0, y, 0.05)) for y in (-0.064, 0.067)]
    kind, size, T = arrays(*cans)
    play = solids.free_play(cylinder(0.03, 0.1, (0, 0, 0.05)), kind, size, solids.bounds(kind, size, T))
    assert play == pytest.approx(0.011, abs=1e-9)


def test_free_play_past_a_corner_agrees_with_moving_there():
    """A brute-force twin: the can is moved in half millimetres until it touches."""
    draw = np.random.default_rng(0)
    for _ in range(10):
        xy = draw.uniform(-0.12, 0.12, (6, 2))
        xy = xy[np.linalg.norm(xy, axis=1) > 0.095]
        blocks = [box((0.05, 0.07, 0.1), (*at, 0)) if draw.uniform() < 0.5 else cylinder(0.03, 0.1, (*at, 0)) for at in xy]
        kind, size, T = arrays(*blocks)
        play = solids.free_play(cylinder(0.03, 0.1, (0, 0, 0)), kind, size, solids.bounds(kind, size, T), 12)
        ways = []
        for angle in np.pi * np.arange(24) / 12:
            steps = np.arange(0, 0.1005, 0.0005)[:, None] * [np.cos(angle), np.sin(angle), 0]
            touching = solids.signed_distance(steps, kind, size, T) <= 0.03
            ways.append(0.0005 * touching.argmax() if touching.any() else UNBOUNDED)
        assert play == pytest.approx(min(min(a + b, UNBOUNDED) for a, b in zip(ways[:12], ways[12:])), abs=0.0011)


def test_digests_are_equal_for_equal_geometry_only():
    kind, size, T = arrays(*scattered())
    assert solids.digest(kind, size, T) == solids.digest(kind, size + 1e-9, T.copy())
    assert solids.digest(kind, size, T) != solids.digest(kind, size + 1e-5, T)
    assert solids.digest(np.zeros((2, 3))) != solids.digest(np.zeros((3, 2)))
    assert 0 <= solids.digest(kind, size, T) < 2**63
    assert solids.digest(np.array([0.25, 1.5])) == 4587705700752441503, "the same in every process and for good"


def test_meshes_are_refused():
    with pytest.raises(UsageError, match="part kind: got 'mesh', expected one of box, cylinder, ellipsoid"):
        solids.signed_distance(np.zeros((1, 3)), np.array([3]), np.ones((1, 3)), np.eye(4)[None])
