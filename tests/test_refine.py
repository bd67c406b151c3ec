"""Fits and refinement on clouds that are made here: partial, noisy, with normals 20 degrees off. No simulator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from dapdata.poses import angle_between, inverse, nearest_symmetric, pose, random_rotation, rotation_about, transform
from daptrain.fit import ObjectFit, fit_container, fit_object, fit_opening, fit_yaw
from daptrain.refine import (
    CRITERIA,
    DEPTH_CAP,
    FLOOR,
    ROOM,
    STEPS,
    ObservedScene,
    observed_scene,
    rank,
    rank_collision_count,
    refine,
)

Z = np.array([0.0, 0.0, 1.0])
BOOK = np.array([0.035, 0.17, 0.23])  # m, thickness, depth, height
CAN = np.array([0.05, 0.05, 0.08])
GAP = 0.045  # m between the two boxes on the shelf


def box_cloud(
    size: np.ndarray, count: int, rng: np.random.Generator, centre: object = (0, 0, 0)
) -> tuple[np.ndarray, np.ndarray]:
    """Points and outward normals, even over the surface of a box."""
    area = np.repeat([size[1] * size[2], size[0] * size[2], size[0] * size[1]], 2)
    face = rng.choice(6, count, p=area / area.sum())
    sign = np.where(face % 2, -1.0, 1.0)
    points, normals = (rng.random((count, 3)) - 0.5) * size, np.zeros((count, 3))
    points[np.arange(count), face // 2] = sign * size[face // 2] / 2
    normals[np.arange(count), face // 2] = sign
    return points + np.asarray(centre, float), normals


def can_cloud(size: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points and outward normals, even over the surface of a cylinder."""
    radius, height = size[0] / 2, size[2]
    area = np.array([2 * height, radius, radius])
    face = rng.choice(3, count, p=area / area.sum())
    turn, end = rng.uniform(-np.pi, np.pi, count), np.where(face == 1, 1.0, -1.0)
    r = np.where(face == 0, radius, radius * np.sqrt(rng.random(count)))
    z = np.where(face == 0, height * (rng.random(count) - 0.5), end * height / 2)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    on_side = (face == 0)[:, None]
    return np.column_stack([r[:, None] * ring, z]), np.where(on_side, np.column_stack([ring, 0 * z]), np.outer(end, Z))


def noisy(points: np.ndarray, normals: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """2 mm of noise on each coordinate, normals about 20 degrees off."""
    normals = normals + rng.normal(0, 0.25, normals.shape)
    return points + rng.normal(0, 0.002, points.shape), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def observed(shape: str, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A cloud of an object in any pose, its lower faces unseen, and the pose."""
    rng = np.random.default_rng(seed)
    points, normals = box_cloud(BOOK, 1000, rng) if shape == "box" else can_cloud(CAN, 1000, rng)
    T = pose(random_rotation(rng), rng.normal(size=3))
    points, normals = transform(T, points), normals @ T[:3, :3].T
    seen = normals[:, 2] > -0.35
    return (*noisy(points[seen], normals[seen], rng), T)


def shelf(yaw: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A shelf that opens to its +x, with two boxes and a gap between them; points, normals, T_world_container."""
    rng = np.random.default_rng(seed)
    pieces = [
        box_cloud(np.array([0.2, 0.5, 0.01]), 2500, rng, (0, 0, 0.005)),  # floor
        box_cloud(np.array([0.01, 0.5, 0.3]), 2500, rng, (-0.1, 0, 0.15)),  # back
        box_cloud(np.array([0.2, 0.15, 0.25]), 2500, rng, (0, 0.075 + GAP / 2, 0.135)),
        box_cloud(np.array([0.2, 0.15, 0.25]), 2500, rng, (0, -0.075 - GAP / 2, 0.135)),
    ]
    points, normals = (np.concatenate(part) for part in zip(*pieces))
    # Seen from the front and above; what is inside another piece is not seen.
    boxes = [((-0.1, y - 0.074, 0.012), (0.099, y + 0.074, 0.259)) for y in (0.075 + GAP / 2, -0.075 - GAP / 2)]
    hidden = sum(((points > low) & (points < high)).all(axis=1) for low, high in boxes).astype(bool)
    seen = ~hidden & (normals @ [1.0, 0.0, 0.7] > -0.1) & (points[:, 0] > -0.097)
    T = pose(rotation_about(Z, yaw), (0.4, -0.2, 0.0))
    points, normals = noisy(points[seen], normals[seen], rng)
    return transform(T, points), normals @ T[:3, :3].T, T


def exact_book() -> ObjectFit:
    return ObjectFit("box", np.eye(4), BOOK, 0.0, 0.0, 1.0, 6)


def at_gap(T_world_container: np.ndarray) -> np.ndarray:
    """The pose of a book in the middle of the gap: depth along x, thickness along y."""
    R = rotation_about(Z, np.pi / 2)
    return T_world_container @ pose(R, (0.005, 0.0, 0.01 + BOOK[2] / 2))


# Fits ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "degrees", "millimetres"), [("box", 0.6, 3.0), ("cylinder", 1.5, 1.5)])
def test_a_noisy_partial_cloud_gives_shape_pose_and_size(shape: str, degrees: float, millimetres: float) -> None:
    turned, sized, placed = [], [], []
    for seed in range(12):
        points, normals, T = observed(shape, seed)
        fit = fit_object(points, normals)
        assert fit.shape == shape
        assert fit.misfit < fit.other_misfit
        near = nearest_symmetric(fit.T_world_box, T, "box" if shape == "box" else "revolution", Z)
        turned.append(np.rad2deg(angle_between(near[:3, :3], T[:3, :3])))
        sized.append(np.abs(fit.size - (BOOK if shape == "box" else CAN)).max() * 1000)
        placed.append(np.linalg.norm(near[:3, 3] - T[:3, 3]) * 1000)
    assert max(turned) < degrees
    assert np.median(sized) < millimetres
    assert np.median(placed) < millimetres


def test_a_can_whose_cap_is_hardly_seen_keeps_its_height() -> None:
    rng = np.random.default_rng(0)
    points, normals = can_cloud(CAN, 900, rng)
    top, bottom = normals[:, 2] > 0.7, normals[:, 2] < -0.7
    keep = ~bottom & (~top | (np.cumsum(top) <= 14))  # too few to be a face among the points that the fit starts with
    fit = fit_object(*noisy(points[keep], normals[keep], rng))
    assert fit.shape == "cylinder"
    assert fit.size == pytest.approx(CAN, abs=0.003)


def test_a_dense_cloud_and_a_tenth_of_it_give_the_same_fit() -> None:
    for cloud, size in ((box_cloud, BOOK), (can_cloud, CAN)):
        points, normals = noisy(*cloud(size, 9000, np.random.default_rng(1)), np.random.default_rng(2))
        dense, sparse = fit_object(points, normals), fit_object(points[::10], normals[::10])
        assert dense.shape == sparse.shape
        assert dense.size == pytest.approx(sparse.size, abs=1e-3)


def test_axes_of_a_box_are_sorted_by_extent_and_right_handed() -> None:
    points, normals, _ = observed("box", 3)
    fit = fit_object(points, normals)
    assert np.all(np.diff(fit.size) > 0)
    assert np.linalg.det(fit.T_world_box[:3, :3]) == pytest.approx(1)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 1000), st.sampled_from(["box", "cylinder"]))
def test_a_fit_moves_with_the_cloud(seed: int, shape: str) -> None:
    points, normals, _ = observed(shape, 5)
    rng = np.random.default_rng(seed)
    T = pose(random_rotation(rng), rng.normal(size=3))
    fit, moved = fit_object(points, normals), fit_object(transform(T, points), normals @ T[:3, :3].T)
    assert moved.shape == fit.shape
    assert moved.size == pytest.approx(fit.size, abs=5e-4)
    kind = "box" if shape == "box" else "revolution"
    near = nearest_symmetric(moved.T_world_box, T @ fit.T_world_box, kind, Z)
    assert near == pytest.approx(T @ fit.T_world_box, abs=3e-3)


@pytest.mark.parametrize("yaw", [-2.9, -1.2, -0.4, 0.0, 0.5, 0.9, 2.2])
def test_the_container_s_yaw_and_opening_come_from_its_points(yaw: float) -> None:
    points, normals, T = shelf(yaw)
    off = (fit_yaw(points, normals) - yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4
    assert abs(np.rad2deg(off)) < 0.3
    assert fit_opening(points, normals) @ T[:3, 0] > 0.999
    container = fit_container(points, normals)
    assert container.T_world_front[:3, 0] == pytest.approx(T[:3, 0], abs=0.01)
    assert (container.high - container.low)[1] == pytest.approx(0.48, abs=0.03)


@pytest.mark.parametrize("count", [0, 5])
def test_too_few_points_or_bad_numbers_are_refused(count: int) -> None:
    with pytest.raises(ValueError, match="at least 20"):
        fit_object(np.zeros((count, 3)), np.zeros((count, 3)))
    with pytest.raises(ValueError, match="finite"):
        fit_object(np.full((30, 3), np.nan), np.zeros((30, 3)))
    with pytest.raises(ValueError, match="expected both"):
        fit_yaw(np.zeros((30, 3)), np.zeros((30, 2)))


@pytest.mark.parametrize("kind", ["one point", "line", "plane", "ball"])
def test_degenerate_clouds_give_a_finite_fit(kind: str) -> None:
    rng = np.random.default_rng(0)
    points = (
        rng.normal(size=(60, 3))
        * {"one point": (0, 0, 0), "line": (0.1, 0, 0), "plane": (0.1, 0.1, 0), "ball": (0.05,) * 3}[kind]
    )
    normals = rng.normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    fit = fit_object(points, normals)
    assert np.isfinite(fit.T_world_box).all()
    assert np.isfinite(fit.size).all()
    assert np.isfinite(fit_container(points, normals).T_world_front).all()


# Refinement ------------------------------------------------------------------------------------------------


def test_a_rough_candidate_ends_upright_square_and_in_the_gap() -> None:
    points, normals, T_world_container = shelf(0.7)
    scene, truth = observed_scene(points, normals), at_gap(T_world_container)
    rng = np.random.default_rng(0)
    rough = np.stack(
        [
            truth @ pose(rotation_about(rng.normal(size=3), np.deg2rad(4)), rng.uniform(-1, 1, 3) * [0.006, 0.010, 0.010])
            for _ in range(12)
        ]
    )
    found = inverse(truth) @ refine(rough, scene, exact_book(), ["gravity", "yaw", "settle", "search"])
    assert np.abs(found[:, 2, 2]).min() > 0.9999
    assert np.rad2deg(angle_between(found[:, :3, :3], np.eye(3))).max() < 0.5
    sideways, height = np.abs(found[:, 0, 3]) * 1000, np.abs(found[:, 2, 3]) * 1000
    assert sideways.max() < 5.1  # half the play of the gap is 5 mm
    assert height.max() < 3


def test_each_step_does_its_own_part_and_none_does_nothing() -> None:
    points, normals, T_world_container = shelf(-0.3)
    scene, book = observed_scene(points, normals), exact_book()
    tilted = at_gap(T_world_container) @ pose(rotation_about((1.0, 0.3, 0.5), 0.06), (0.004, 0, 0.008))
    alone = {step: refine(tilted[None], scene, book, [step])[0] for step in STEPS}
    assert refine(tilted[None], scene, book, ())[0] == pytest.approx(tilted)
    assert alone["gravity"][2, 2] == pytest.approx(1)
    assert alone["gravity"][:3, 3] == pytest.approx(tilted[:3, 3])
    assert alone["yaw"][:3, 3] == pytest.approx(tilted[:3, 3])
    assert alone["settle"][:3, :3] == pytest.approx(tilted[:3, :3])
    assert alone["settle"][:2, 3] == pytest.approx(tilted[:2, 3])
    assert alone["search"][2, 3] == pytest.approx(tilted[2, 3])
    with pytest.raises(ValueError, match="jump"):
        refine(tilted[None], scene, book, ["jump"])


def test_refinement_turns_with_the_world_and_keeps_what_is_not_finite() -> None:
    points, normals, T_world_container = shelf(0.2)
    T = pose(rotation_about(Z, 1.0), (0.3, 0.1, 0.0))
    start = at_gap(T_world_container) @ pose(translation=(0.006, 0.0, 0.01))
    both = np.stack([start, np.full((4, 4), np.nan)])
    here = refine(both, observed_scene(points, normals), exact_book())
    there = refine(T @ both, observed_scene(transform(T, points), normals @ T[:3, :3].T), exact_book())
    assert np.isnan(here[1]).all()
    assert there[0] == pytest.approx(T @ here[0], abs=4e-3)


def test_a_can_settles_onto_the_floor_whatever_its_turn() -> None:
    points, normals, T_world_container = shelf(0.4)
    scene, can = observed_scene(points, normals), ObjectFit("cylinder", np.eye(4), np.array([0.03, 0.03, 0.08]), 0, 0, 1, 3)
    start = T_world_container @ pose(rotation_about((1.0, 0, 0), np.pi - 0.1), (0.05, 0.0, 0.07))
    end = refine(start[None], scene, can)[0]
    assert end[2, 2] == pytest.approx(-1)  # the end that was up stays up
    assert end[2, 3] == pytest.approx(0.05, abs=0.003)


def test_an_object_settles_where_it_is_free_and_not_through_what_it_stands_on() -> None:
    """A plinth that holds two fifths of the footprint, 3 cm above a floor of which the rest is seen."""
    rng = np.random.default_rng(3)
    pieces = [
        box_cloud(np.array([0.3, 0.4, 0.01]), 3000, rng, (0, 0, -0.005)),
        box_cloud(np.array([0.01, 0.4, 0.3]), 3000, rng, (-0.15, 0, 0.15)),
        box_cloud(np.array([0.08, 0.04, 0.03]), 300, rng, (0, 0, 0.015)),
    ]
    points, normals = (np.concatenate(part) for part in zip(*pieces))
    seen = (normals @ [1.0, 0.0, 0.7] > -0.1) & (np.abs(points[:, 0]) < 0.147) & (points[:, 2] > -0.003)
    scene = observed_scene(points[seen], normals[seen])
    box = ObjectFit("box", np.eye(4), np.array([0.08, 0.1, 0.12]), 0.0, 0.0, 1.0, 6)
    end = refine(pose(translation=(0, 0, 0.03 + 0.06 - 0.018))[None], scene, box, ["settle"])[0]
    assert end[2, 3] == pytest.approx(0.09, abs=0.002)


def test_the_search_ends_in_the_middle_of_a_gap() -> None:
    points, normals, T_world_container = shelf(0.3)
    truth, book = at_gap(T_world_container), exact_book()
    off = np.stack([truth @ pose(translation=(shift, 0, 0)) for shift in (-0.012, -0.006, 0.006, 0.012)])
    found = inverse(truth) @ refine(off, observed_scene(points, normals), book, ["search"])
    assert np.abs(found[:, 0, 3]).max() < 0.003


def test_candidates_for_one_place_try_it_each_elsewhere_and_the_first_of_a_place_stays() -> None:
    points, normals, T_world_container = shelf(0.4)
    scene, here = observed_scene(points, normals), at_gap(T_world_container)
    there = here @ pose(translation=(0.05, 0, 0))
    candidates = np.stack([here, there, *[here] * 3, np.full((4, 4), np.nan), *[here] * 3])
    moved = (inverse(here) @ refine(candidates, scene, exact_book(), ["spread"]) - inverse(here) @ candidates)[:, :3, 3]
    assert np.linalg.norm(moved[:2], axis=1) == pytest.approx(0)
    assert np.isnan(moved[5]).all()
    tries = moved[[0, 2, 3, 4, 6, 7, 8]]
    assert np.linalg.norm(tries[1:], axis=1) == pytest.approx(0.003)
    assert pdist(tries).min() > 0.0029
    fewer = refine(candidates[:4], scene, exact_book(), ["spread"])
    assert fewer == pytest.approx(refine(candidates, scene, exact_book(), ["spread"])[:4]), "whatever comes after them"


# Ranking ---------------------------------------------------------------------------------------------------


def test_a_good_place_beats_air_a_book_the_roof_and_nothing() -> None:
    points, normals, T_world_container = shelf(0.7)
    scene, good = observed_scene(points, normals), at_gap(T_world_container)
    shifts = {"in a book": (0.05, 0, 0), "in the air": (0, 0, 0.05), "in front": (0, -0.4, 0), "above": (0, 0, 0.4)}
    candidates = np.stack([good, *(good @ pose(translation=shift) for shift in shifts.values()), np.full((4, 4), np.nan)])
    scores = rank(candidates, scene, exact_book())
    assert np.argmax(scores) == 0
    assert scores[-1] == -np.inf
    assert np.isfinite(scores[:-1]).all()


def test_a_free_place_behind_something_is_worse_than_one_that_can_be_reached() -> None:
    points, normals, T_world_container = shelf(0.0)
    fence, outward = box_cloud(np.array([0.01, 0.1, 0.2]), 800, np.random.default_rng(1), (0.14, 0.0, 0.12))
    blocked = observed_scene(
        np.concatenate([points, transform(T_world_container, fence)]),
        np.concatenate([normals, outward @ T_world_container[:3, :3].T]),
    )
    good = at_gap(T_world_container)[None]
    assert rank(good, blocked, exact_book())[0] < rank(good, observed_scene(points, normals), exact_book())[0] - 5


def test_flying_pixels_in_a_gap_are_no_obstacle_and_a_board_is() -> None:
    points, normals, T_world_container = shelf(0.7)
    rng, good = np.random.default_rng(0), at_gap(T_world_container)[None]
    clear = rank(good, observed_scene(points, normals), exact_book(), criteria=["path"])[0]
    scores = {}
    for name, low, high in (
        ("pixels", (-0.09, -0.02, 0.03), (0.09, 0.02, 0.24)),
        ("board", (0.05, -0.02, 0.03), (0.06, 0.02, 0.2)),
    ):
        number = 12 if name == "pixels" else 150
        more = transform(T_world_container, rng.uniform(low, high, (number, 3)))
        scene = observed_scene(np.concatenate([points, more]), np.concatenate([normals, np.tile(Z, (number, 1))]))
        scores[name] = rank(good, scene, exact_book(), criteria=["path"])[0]
    assert scores["pixels"] > clear - 1
    assert scores["board"] < clear - 5


def test_of_two_books_the_one_with_more_room_is_surer() -> None:
    points, normals, T_world_container = shelf(0.7)
    scene, good = observed_scene(points, normals), at_gap(T_world_container)[None]
    scores = [
        rank(good, scene, ObjectFit("box", np.eye(4), np.array([width, *BOOK[1:]]), 0, 0, 1, 6), criteria=["path"])[0]
        for width in (0.033, 0.039, 0.051)
    ]
    assert scores[0] > scores[1] + 1 > scores[2] + 4


def test_what_stands_over_an_edge_is_worse_than_what_stands_on_it() -> None:
    points, normals, T_world_container = shelf(0.0)
    scene, can = observed_scene(points, normals), ObjectFit("cylinder", np.eye(4), np.array([0.03, 0.03, 0.08]), 0, 0, 1, 3)
    ways = np.array([0.04, 0.09, 0.105, 0.125])  # the floor ends at 0.1
    candidates = np.stack([T_world_container @ pose(translation=(x, 0, 0.05)) for x in ways])
    for criterion in ("support", "balance"):
        scores = rank(candidates, scene, can, criteria=[criterion])
        assert np.all(np.diff(scores)[1:] < -0.5), criterion
        assert scores[0] >= scores[1]


def test_depth_is_that_of_the_deepest_points_in_the_swept_volume() -> None:
    """A brute-force twin for a density at which each patch is one point."""
    rng = np.random.default_rng(8)
    points = rng.uniform(-0.15, 0.15, (40, 3))
    flat = fit_container(points, np.tile(Z, (40, 1)))
    scene = ObservedScene(points, np.zeros(40, bool), np.ones(40, bool), 1.0, replace(flat, T_world_front=np.eye(4)))
    box = ObjectFit("box", np.eye(4), np.array([0.03, 0.05, 0.12]), 0.0, 0.0, 1.0, 6)
    centres = rng.uniform(-0.1, 0.1, (30, 3))
    scores = rank(np.stack([pose(translation=c) for c in centres]), scene, box, criteria=["path"])
    for centre, score in zip(centres, scores):
        deepest = -ROOM
        for x, y, z in points - centre:
            if z > -0.06 + FLOOR:
                deepest = max(deepest, min(x + 0.015, 0.025 - abs(y), z + 0.06 - FLOOR, 0.06 - z))
        assert score == pytest.approx(-1000 * min(deepest, DEPTH_CAP))


def test_criteria_can_be_left_out_and_a_large_residual_costs() -> None:
    points, normals, T_world_container = shelf(0.7)
    scene, two = observed_scene(points, normals), np.stack([at_gap(T_world_container)] * 2)
    scores = rank(two, scene, exact_book(), np.array([0.0, 0.03]))
    assert scores[0] - scores[1] == pytest.approx(3)
    assert rank(two, scene, exact_book(), np.array([0.0, 0.03]), set(CRITERIA) - {"residual"})[1] == pytest.approx(scores[0])
    assert rank(two, scene, exact_book(), criteria=()).tolist() == [0, 0]
    with pytest.raises(ValueError, match="beauty"):
        rank(two, scene, exact_book(), criteria=["beauty"])


def test_collision_count_counts_the_points_in_the_oriented_box() -> None:
    rng = np.random.default_rng(2)
    points, T = rng.uniform(-0.2, 0.2, (500, 3)), pose(random_rotation(rng), (0.02, 0.0, 0.01))
    inside = sum(bool((np.abs(inverse(T) @ [*p, 1.0])[:3] <= BOOK / 2).all()) for p in points)
    assert rank_collision_count(T[None], points, exact_book())[0] == -inside
