"""Registration: a motion is found from any turn, from partial views, and only as far as the surface tells it."""

from __future__ import annotations

import hand_scans
import numpy as np

from dapdata import registration
from dapdata.poses import angle_between, pose, random_rotation, rotation_about
from dapdata.records import Array
from dapdata.registration import Surface
from dapdata.rng import stream

SPACING = 0.005  # m
BALLS = stream(0, "ball", 0).normal(size=(2, 1500, 3))
BALL, BALL_AFTER = BALLS / np.linalg.norm(BALLS, axis=2, keepdims=True)


def seen(T: Array, seed: int, keep: Array | None = None) -> Surface:
    """The block after a motion; with `keep`, only the faces that do not look away from that direction."""
    points, normals = hand_scans.surface(hand_scans.BLOCK, T, seed)
    facing = np.ones(len(points), bool) if keep is None else normals @ keep > -0.1
    return Surface(points[facing], normals[facing])


def test_a_motion_is_found_from_any_turn() -> None:
    rng = stream(0, "motion", 1)
    T = pose(random_rotation(rng), rng.uniform(-0.5, 0.5, 3))
    best = registration.register(seen(np.eye(4), 1), seen(T, 2), SPACING, registration.turns_all())[0]
    np.testing.assert_allclose(best.T, T, atol=0.01)
    assert np.linalg.norm((best.T - T)[:3, 3]) < 0.001
    assert min(best.explained_before, best.explained_after) > 0.99
    assert best.rms < 2 * hand_scans.NOISE + hand_scans.STEP / 2


def test_a_motion_is_found_though_other_sides_are_seen_after() -> None:
    T = pose(rotation_about((0.2, 0.1, 1), 0.8), (0.1, 0.2, 0.05))
    before, after = seen(np.eye(4), 1, np.array([1.0, 0.3, 0.4])), seen(T, 2, T[:3, :3] @ [-0.05, 1.0, 0.5])
    best = registration.register(before, after, SPACING, registration.turns_all())[0]
    assert np.linalg.norm((best.T - T)[:3, 3]) < 0.003
    assert angle_between(best.T[:3, :3], T[:3, :3]) < np.radians(1.5)
    assert best.explained_after < 0.95


def test_a_ball_is_brought_to_its_place_and_not_turned() -> None:
    before = Surface(0.04 * BALL, BALL)
    T = pose(None, (0.1, -0.2, 0.3))
    after = Surface(0.04 * BALL_AFTER, BALL_AFTER).moved(T)
    found = registration.as_good(registration.register(before, after, SPACING, registration.turns_all()))
    assert len(found) > 3
    assert max(registration.surface_gap(fit.T, T, before.points) for fit in found) < SPACING
    straight = registration.polish(before, after, pose(None, (0.1, -0.2, 0.29)), SPACING)
    assert angle_between(straight.T[:3, :3], np.eye(3)) < np.radians(1)


def test_a_surface_that_went_elsewhere_has_a_gap() -> None:
    points, _ = hand_scans.surface(hand_scans.CUBOID, np.eye(4), 1)
    half, quarter = pose(rotation_about((0, 0, 1), np.pi)), pose(rotation_about((1, 0, 0), np.pi / 2))
    assert registration.surface_gap(np.eye(4), half, points) < 2 * hand_scans.STEP
    assert registration.surface_gap(np.eye(4), quarter, points) > 0.01


def test_clouds_of_different_things_do_not_explain_each_other() -> None:
    best = registration.register(seen(np.eye(4), 1), Surface(0.03 * BALL, BALL), SPACING, registration.turns_all())[0]
    assert min(best.explained_before, best.explained_after) < 0.6
