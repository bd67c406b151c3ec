"""SE(3) keeps its axioms, and symmetries are groups."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dapdata.poses import (
    angle_between,
    facing,
    inverse,
    nearest_symmetric,
    pose,
    random_rotation,
    rotate,
    rotation_about,
    rotation_by,
    symmetric_distance,
    tilt,
    transform,
)
from dapdata.records import SYMMETRIES

Z = np.array([0.0, 0, 1])
HALF_TURNS = [np.diag(signs) for signs in ([1.0, 1, 1], [1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])]
seeds = st.integers(0, 2**32 - 1)
angles = st.floats(-np.pi, np.pi)
close = {"rtol": 0, "atol": 1e-9}


def random_pose(seed: int) -> np.ndarray:
    draw = np.random.default_rng(seed)
    return pose(random_rotation(draw), draw.normal(size=3))


def elements(kind: str, angle: float) -> list[np.ndarray]:
    """Some of a symmetry's group, as rotations of the object frame."""
    if kind == "none":
        return [np.eye(3)]
    if kind == "box":
        return HALF_TURNS
    return [rotation_about(Z, angle), rotation_about((np.cos(angle), np.sin(angle), 0), np.pi)]


@given(seeds, seeds, seeds)
def test_poses_are_a_group(a, b, c):
    A, B, C = random_pose(a), random_pose(b), random_pose(c)
    assert np.allclose((A @ B) @ C, A @ (B @ C), **close)
    assert np.allclose(A @ inverse(A), np.eye(4), **close)
    assert np.allclose(inverse(A) @ A, np.eye(4), **close)
    assert np.allclose(inverse(A @ B), inverse(B) @ inverse(A), **close)
    assert np.allclose(inverse(np.stack([A, B])), np.stack([inverse(A), inverse(B)]), **close)


@given(seeds, seeds)
def test_chains_read_with_touching_names(a, b):
    T_world_container, T_container_object = random_pose(a), random_pose(b)
    points_object = np.random.default_rng(a).normal(size=(5, 3))
    via = transform(T_world_container, transform(T_container_object, points_object))
    assert np.allclose(transform(T_world_container @ T_container_object, points_object), via, **close)
    assert np.allclose(rotate(T_world_container, points_object), via * 0 + points_object @ T_world_container[:3, :3].T, **close)


@given(seeds)
def test_rotations_are_rigid_and_right_handed(seed):
    R = random_rotation(np.random.default_rng(seed))
    assert np.allclose(R @ R.T, np.eye(3), **close)
    assert np.linalg.det(R) == pytest.approx(1, abs=1e-9)


def test_random_rotations_are_uniform():
    draw = np.random.default_rng(0)
    R = np.stack([random_rotation(draw) for _ in range(4000)])
    assert np.abs(R.mean(axis=0)).max() < 0.03
    angle = angle_between(R, np.eye(3)[None])
    # The angle's density over SO(3) is (1 - cos) / pi, whose mean is pi / 2 + 2 / pi.
    assert angle.mean() == pytest.approx(np.pi / 2 + 2 / np.pi, abs=0.03)


@given(seeds, angles)
def test_rotation_about_turns_by_its_angle_and_keeps_its_axis(seed, angle):
    axis = np.random.default_rng(seed).normal(size=3)
    R = rotation_about(axis, angle)
    assert np.allclose(R @ axis, axis, **close)
    assert angle_between(R, np.eye(3)) == pytest.approx(abs(angle), abs=1e-7)
    assert np.allclose(R @ rotation_about(axis, -angle), np.eye(3), **close)


@given(seeds, seeds, angles, st.sampled_from(SYMMETRIES))
def test_symmetric_copies_are_the_same_pose(a, b, angle, kind):
    A, B = random_pose(a), random_pose(b)
    for g in elements(kind, angle):
        shift, turn = symmetric_distance(A @ pose(g), A, kind, Z)
        assert shift == pytest.approx(0, abs=1e-12)
        assert turn == pytest.approx(0, abs=1e-6)
        assert np.allclose(symmetric_distance(A @ pose(g), B, kind, Z), symmetric_distance(A, B, kind, Z), rtol=0, atol=1e-6), (
            "choice of the copy does not matter"
        )
    assert np.allclose(symmetric_distance(A, B, kind, Z), symmetric_distance(B, A, kind, Z), rtol=0, atol=1e-6)


@given(seeds, seeds, st.sampled_from(SYMMETRIES))
def test_the_nearest_copy_is_a_copy_and_none_is_nearer(a, b, kind):
    A, B = random_pose(a), random_pose(b)
    near = nearest_symmetric(A, B, kind, Z)
    g = A[:3, :3].T @ near[:3, :3]
    assert np.array_equal(near[:3, 3], A[:3, 3])
    if kind == "revolution":
        assert abs(g[2, 2]) == pytest.approx(1, abs=1e-9), "the axis is kept, either way round"
    else:
        assert any(np.allclose(g, element, **close) for element in elements(kind, 0.0))
    best = angle_between(near[:3, :3], B[:3, :3])
    for angle in np.linspace(-np.pi, np.pi, 25):
        for element in elements(kind, angle):
            assert best <= angle_between(A[:3, :3] @ element, B[:3, :3]) + 1e-7


@given(seeds, seeds, seeds, st.sampled_from(SYMMETRIES))
@settings(max_examples=50)
def test_a_common_motion_of_both_poses_changes_no_distance(a, b, c, kind):
    A, B, C = random_pose(a), random_pose(b), random_pose(c)
    assert np.allclose(symmetric_distance(C @ A, C @ B, kind, Z), symmetric_distance(A, B, kind, Z), rtol=0, atol=1e-6)


def test_half_turns_are_closed():
    for a in HALF_TURNS:
        for b in HALF_TURNS:
            assert any(np.array_equal(a @ b, c) for c in HALF_TURNS)


@given(angles)
def test_tilt_is_the_angle_from_upright_and_folds_where_the_symmetry_flips(angle):
    T = pose(rotation_about((1, 0, 0), angle))
    assert tilt(T, "none", Z) == pytest.approx(abs(angle), abs=1e-6)
    assert tilt(T, "box", Z) == pytest.approx(min(abs(angle), np.pi - abs(angle)), abs=1e-6)
    assert tilt(T, "revolution", Z) == pytest.approx(min(abs(angle), np.pi - abs(angle)), abs=1e-6)


@given(angles, angles)
def test_tilt_forgives_a_roll_about_the_axis_of_revolution(roll, lean):
    """Of a plate on its rim: the smallest over many turns about its axis, here y."""
    Y = np.array([0.0, 1, 0])
    T = pose(rotation_about((1, 0, 0), lean) @ rotation_about(Y, roll))
    turned = [tilt(T @ pose(rotation_about(Y, turn)), "none", Y) for turn in np.linspace(-np.pi, np.pi, 721)]
    assert tilt(T, "revolution", Y) == pytest.approx(min(turned), abs=0.006)


def test_an_opening_that_points_up_faces_along_x():
    T = pose(rotation_about((0, 0, 1), 0.3))
    assert np.allclose(facing(T, np.array([0.0, 0, 1])), T[:3, 0])
    assert np.allclose(facing(T, np.array([0.0, 0.6, 0.8])), T[:3, 1])


def test_an_unknown_symmetry_is_named():
    with pytest.raises(ValueError, match="none, box or revolution"):
        nearest_symmetric(np.eye(4), np.eye(4), "screw", Z)


@given(seeds, st.floats(1e-9, 3.0))
def test_a_rotation_vector_and_its_opposite_cancel_and_its_length_is_the_angle(seed, angle):
    direction = np.random.default_rng(seed).normal(size=3)
    turn = angle * direction / np.linalg.norm(direction)
    assert np.allclose(rotation_by(turn) @ rotation_by(-turn), np.eye(3), **close)
    assert np.isclose(angle_between(rotation_by(turn), np.eye(3)), angle, **close)
    assert np.allclose(rotation_by(turn) @ turn, turn, **close)


def test_a_rotation_vector_of_no_length_turns_nothing():
    assert np.array_equal(rotation_by(np.zeros(3)), np.eye(3))
