"""What holds and what does not: hand-made scenes whose answer is known, and the judge's promises."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import fields, replace

import numpy as np
import pytest

from dapdata import rng, simulate, solids, tasks
from dapdata.errors import UsageError
from dapdata.poses import angle_between, inverse, pose, random_rotation, rotation_about, symmetric_distance
from dapdata.records import GOAL_KINDS, REJECT_REASONS, SYMMETRIES, Demo, Rejected, Scene
from dapdata.simulate import PlacementConfig, demonstrate, judge, settle
from dapdata.solids import CLUTTER, Part, box, cylinder, ellipsoid

CONFIG = PlacementConfig()
FLOOR = box((0.4, 0.4, 0.01), (0, 0, -0.005))
WALLS = [FLOOR, box((0.01, 0.4, 0.3), (-0.205, 0, 0.15)), *(box((0.4, 0.01, 0.3), (0, side * 0.205, 0.15)) for side in (-1, 1))]
CAN = [cylinder(0.03, 0.1, (0, 0, 0))]
BRICK = [box((0.06, 0.04, 0.1), (0, 0, 0))]
UPRIGHT = np.eye(3)


def make_scene(goals, parts=(), things=CAN, symmetry="revolution", walls=WALLS, **changes) -> Scene:
    """A bay of 0.4 m with a floor at z = 0, open to +x, with more parts, an object and candidate poses."""
    kind, size, T, role = solids.collect([*walls, *parts])
    object_kind, object_size, T_object_part, _ = solids.collect(things)
    scene = Scene(
        part_kind=kind,
        part_size=size,
        T_container_part=T,
        part_role=role,
        object_kind=object_kind,
        object_size=object_size,
        T_object_part=T_object_part,
        T_container_goal=np.array(goals, float).reshape(-1, 4, 4),
        goal_kind=np.zeros(len(goals), np.uint8),
        goal_clearance=np.zeros(len(goals)),
        goal_approach=np.tile([1.0, 0, 0], (len(goals), 1)),
        opening=np.array([1.0, 0, 0]),
        max_tilt=np.radians(15),
        symmetry_kind=SYMMETRIES.index(symmetry),
        symmetry_axis=np.array([0.0, 0, 1]),
        T_world_container=pose(rotation_about((0, 0, 1), 0.7), (0.6, -0.1, 0)),
        T_world_object_start=pose(None, (0.3, 0.4, 0.05)),
        container_instance=1,
        object_instance=2,
    )
    return replace(scene, **changes)


def standing(x=0.0, y=0.0, z=0.0, height=0.1):
    return pose(UPRIGHT, (x, y, z + height / 2 + 0.0005))


def reason_of(scene: Scene, config: PlacementConfig = CONFIG) -> str:
    """The verdict on the scene's only candidate, by both ways of asking."""
    _, (reason,) = settle(scene, scene.T_container_goal, config)
    out = demonstrate(scene, config, rng.stream(0, "test", 0))
    assert (out == Rejected(reason)) if reason != "ok" else isinstance(out, Demo)
    return reason


def shelf_demo(task: str = "can_cabinet", seed: int = 0) -> Demo:
    module = tasks.load(task)
    draw = rng.stream(seed, "scene", 0)
    demo = demonstrate(module.sample_scene(module.Params(), draw), CONFIG, draw)
    assert isinstance(demo, Demo)
    return demo


# Candidates: each bad one fails for its own reason


def test_a_can_standing_free_on_the_floor_is_a_goal():
    assert reason_of(make_scene([standing()])) == "ok"


def test_a_can_on_top_of_another_is_a_goal():
    assert reason_of(make_scene([standing(z=0.08)], [cylinder(0.03, 0.08, (0, 0, 0.04), CLUTTER)])) == "ok"


def test_an_ellipsoid_settles_in_a_bowl_of_four_bars():
    bars = [box((0.01, 0.2, 0.02), (x, 0, 0.01)) for x in (-0.02, 0.02)]
    bars += [box((0.2, 0.01, 0.02), (0, y, 0.01)) for y in (-0.02, 0.02)]
    fruit = [ellipsoid((0.08, 0.08, 0.08), (0, 0, 0))]
    height = 0.02 + np.sqrt(0.04**2 - 0.015**2)
    scene = make_scene([pose(UPRIGHT, (0, 0, height + 0.0005))], bars, fruit, "revolution")
    assert reason_of(scene) == "ok"


def test_a_candidate_that_hangs_in_the_air_is_unsupported():
    assert reason_of(make_scene([standing(z=0.05)])) == "unsupported"


def test_a_candidate_that_hangs_beside_a_wall_is_unsupported():
    assert reason_of(make_scene([standing(y=0.1695, z=0.1)])) == "unsupported"


@pytest.mark.parametrize("overlap", [0.002, 0.02])
def test_a_candidate_that_overlaps_clutter_penetrates(overlap):
    scene = make_scene([standing()], [cylinder(0.03, 0.1, (-0.06 + overlap, 0, 0.05), CLUTTER)])
    assert reason_of(scene) == "penetrates"


def test_a_candidate_that_sinks_into_the_floor_penetrates():
    assert reason_of(make_scene([standing(z=-0.003)])) == "penetrates"


def test_a_candidate_over_an_edge_falls():
    assert reason_of(make_scene([standing(x=0.21)])) == "moved"


def test_a_candidate_that_leans_falls():
    leaning = pose(rotation_about((0, 1, 0), np.radians(25)), (0, 0, 0.05 * np.cos(0.4363) + 0.03 * np.sin(0.4363) + 0.0005))
    assert reason_of(make_scene([leaning])) == "moved"


def test_a_candidate_that_lies_flat_is_tilted():
    lying = pose(rotation_about((1, 0, 0), np.pi / 2), (0, 0, 0.0205))
    assert reason_of(make_scene([lying], things=BRICK, symmetry="box")) == "tilted"


def test_an_object_that_may_not_be_turned_over_is_tilted_upside_down():
    over = pose(rotation_about((1, 0, 0), np.pi), (0, 0, 0.0505))
    assert reason_of(make_scene([over], things=BRICK, symmetry="none")) == "tilted"
    assert reason_of(make_scene([over], things=BRICK, symmetry="box")) == "ok"


def test_a_candidate_that_glides_is_not_at_rest():
    slope = np.radians(1.5)
    ramp = box((0.3, 0.3, 0.01), (0, 0, 0.02), rotation=rotation_about((0, 1, 0), slope))
    on_ramp = pose(rotation_about((0, 1, 0), slope), (0, 0, 0.02) + np.array([np.sin(slope), 0, np.cos(slope)]) * 0.0552)
    scene = make_scene([on_ramp], [ramp], things=BRICK, symmetry="box")
    assert reason_of(scene, PlacementConfig(friction=0.0)) == "not_at_rest"
    assert reason_of(scene) == "ok"


def test_a_candidate_on_the_roof_is_outside():
    roof = box((0.4, 0.42, 0.01), (0, 0, 0.305))
    assert reason_of(make_scene([standing(z=0.31)], [roof])) == "outside"


def test_a_card_on_its_edge_stands_but_is_shaken_off():
    card = [box((0.1, 0.002, 0.2), (0, 0, 0))]
    scene = make_scene([standing(height=0.2)], things=card, symmetry="box")
    assert reason_of(scene) == "shaken_off"
    assert reason_of(scene, PlacementConfig(shake_acceleration=0.0)) == "ok"


def test_a_candidate_behind_a_post_is_unreachable():
    post = cylinder(0.01, 0.3, (0.1, 0, 0.15), CLUTTER)
    assert reason_of(make_scene([standing()], [post])) == "unreachable"
    assert reason_of(make_scene([standing(y=0.045)], [post])) == "ok"


def test_a_low_sill_is_lifted_over_but_a_high_one_is_not():
    low, high = (box((0.01, 0.4, h), (0.1, 0, h / 2), CLUTTER) for h in (0.008, 0.015))
    assert reason_of(make_scene([standing()], [low])) == "ok"
    assert reason_of(make_scene([standing()], [high])) == "unreachable"


def test_rejected_candidates_are_kept_apart_with_their_reasons():
    post = cylinder(0.01, 0.3, (0.15, 0.1, 0.15), CLUTTER)
    scene = make_scene([standing(y=-0.1), standing(z=0.1), standing(y=0.1), standing(x=0.21)], [post])
    demo = demonstrate(scene, CONFIG, rng.stream(0, "test", 0))
    assert isinstance(demo, Demo)
    assert [REJECT_REASONS[code] for code in demo.rejected_reason] == ["unsupported", "unreachable", "moved"]
    assert np.allclose(demo.rejected_goals, scene.T_world_container @ scene.T_container_goal[1:])
    assert len(demo.goals) == 1
    assert np.array_equal(demo.T_world_object_goal, demo.goals[0])
    assert np.allclose(demo.goals[0][2, 3], 0.05, atol=1e-4), "settled poses are recorded, not proposed ones"


def test_a_scene_without_candidates_is_rejected():
    assert demonstrate(make_scene([]), CONFIG, rng.stream(0, "test", 0)) == Rejected("no_free_slot")


def test_every_goal_is_demonstrated_by_some_seed():
    scene = make_scene([standing(y=y) for y in (-0.1, 0.0, 0.1)])
    chosen = set()
    for i in range(30):
        demo = demonstrate(scene, CONFIG, rng.stream(0, "test", i))
        assert isinstance(demo, Demo)
        chosen.add(round(float((inverse(demo.T_world_container) @ demo.T_world_object_goal)[1, 3]), 1))
    assert chosen == {-0.1, 0.0, 0.1}


def test_an_object_of_several_solids_settles_and_is_judged():
    mug = [cylinder(0.03, 0.1, (0, 0, 0)), box((0.03, 0.01, 0.06), (0.045, 0, 0))]
    turned = [Part(part.kind, part.size, pose(None, (0.01, 0, 0)) @ part.T) for part in mug]
    scene = make_scene([standing()], things=turned, symmetry="none")
    settled, reasons = settle(scene, scene.T_container_goal, CONFIG)
    assert reasons == ["ok"]
    assert np.allclose(settled[0], standing(z=-0.0005), atol=1e-3)
    demo = demonstrate(scene, CONFIG, rng.stream(0, "test", 0))
    assert isinstance(demo, Demo)
    assert judge(demo, demo.goals, CONFIG)[0].success


def test_an_object_of_several_solids_weighs_where_its_solids_are():
    """A block with a light arm: the middle of its bounding box hangs over the edge, its centre of mass does not."""
    things = [box((0.06, 0.06, 0.1), (-0.1, 0, 0)), box((0.2, 0.005, 0.005), (0.03, 0, 0))]
    plinth = [box((0.06, 0.06, 0.05), (-0.1, 0, 0.025), CLUTTER)]
    assert reason_of(make_scene([standing(z=0.05)], plinth, things, "none")) == "ok"
    assert reason_of(make_scene([standing(x=0.055, z=0.05)], plinth, things, "none")) == "moved"


def test_an_object_of_more_solids_than_the_simulator_takes_is_refused():
    many = [box((0.06, 0.04, 0.005), (0, 0, 0.005 * i - 0.0475)) for i in range(20)]
    scene = make_scene([standing()], things=many, symmetry="none")
    with pytest.raises(UsageError, match="got 20, expected 16 at the most"):
        settle(scene, scene.T_container_goal, CONFIG)
    sixteen = make_scene([standing(height=0.08)], things=many[2:18], symmetry="none")
    assert reason_of(sixteen) == "ok"


def test_an_object_is_brought_in_against_the_approach_of_its_place():
    """A pit of four walls is reached from above only, a can behind it from the front only where the pit is not."""
    pit = [box((0.01, 0.1, 0.12), (x, 0, 0.06)) for x in (-0.045, 0.045)]
    pit += [box((0.08, 0.01, 0.12), (0, y, 0.06)) for y in (-0.045, 0.045)]
    scene = make_scene([standing(), standing(y=0.15)], pit)
    assert settle(scene, scene.T_container_goal, CONFIG)[1] == ["unreachable", "ok"]
    assert settle(scene, scene.T_container_goal, CONFIG, np.array([[0.0, 0, 1], [0, 0, 1]]))[1] == ["ok", "ok"]
    demo = demonstrate(replace(scene, goal_approach=np.array([[0.0, 0, 1], [1, 0, 0]])), CONFIG, rng.stream(0, "test", 0))
    assert isinstance(demo, Demo)
    assert np.array_equal(demo.goal_approach, [[0, 0, 1], [1, 0, 0]])
    assert [verdict.reason for verdict in judge(demo, demo.goals, CONFIG)] == ["ok", "ok"]
    nowhere = replace(scene, T_container_goal=np.zeros((0, 4, 4)), goal_approach=np.zeros((0, 3)))
    assert settle(nowhere, scene.T_container_goal, CONFIG)[1] == ["unreachable", "ok"], "against the opening"
    swapped = replace(demo, goal_approach=demo.goal_approach[::-1])
    assert [verdict.reason for verdict in judge(swapped, demo.goals, CONFIG)] == ["pushed", "ok"]


def ring_on_a_peg(turn_deg: float, kind: str = "peg", aside: float = 0.0, radius: float = 0.005) -> Scene:
    """A square ring (its hole is 4 cm wide) around a level peg, turned about it; the way out is along the peg."""
    ring = [box((0.01, 0.06, 0.01), (0, 0, side * 0.025)) for side in (-1, 1)]
    ring += [box((0.01, 0.01, 0.04), (0, side * 0.025, 0)) for side in (-1, 1)]
    peg = cylinder(radius, 0.3, (0, 0, 0.15), rotation=rotation_about((0, 1, 0), np.pi / 2))
    turn = rotation_about((1, 0, 0), np.radians(turn_deg))
    T = pose(turn, np.array([0, aside, 0.1505 + radius]) - turn @ [0, 0, 0.02])  # its upper bar on the peg
    scene = make_scene([T], [peg], ring, "none", max_tilt=np.pi)
    return replace(scene, goal_kind=np.array([GOAL_KINDS.index(kind)], np.uint8))


def test_what_hangs_swings_into_place_before_it_is_a_goal():
    swung = ring_on_a_peg(20)
    settled, reasons = settle(swung, swung.T_container_goal, CONFIG)
    assert reasons == ["ok"]
    assert np.degrees(angle_between(settled[0, :3, :3], np.eye(3))) < 3
    assert settled[0, 2, 3] == pytest.approx(0.15 + 0.005 - 0.02, abs=0.002)
    assert reason_of(ring_on_a_peg(20, "floor")) != "ok"


def test_what_falls_off_a_peg_is_no_goal():
    assert reason_of(ring_on_a_peg(0, aside=0.05)) == "unsupported", "it fell to the floor: the candidate is judged as proposed"


def test_what_stands_at_the_foot_of_its_peg_does_not_hang():
    scene = ring_on_a_peg(0)
    demo = demonstrate(scene, CONFIG, rng.stream(0, "test", 0))
    assert isinstance(demo, Demo)
    lying = pose(rotation_about((0, 1, 0), np.pi / 2), (0.1, 0.1, 0.0055))
    on_the_floor = replace(demo, goal_approach=np.array([[0.0, 0, 1]]))
    assert verdict_on(on_the_floor, lying).reason == "not_touching"
    assert verdict_on(replace(on_the_floor, goal_kind=np.zeros(1, np.uint8)), lying).success


def test_a_ring_is_lifted_no_higher_than_its_peg_lets_it():
    demo = demonstrate(ring_on_a_peg(0), CONFIG, rng.stream(0, "test", 0))
    assert isinstance(demo, Demo)
    assert judge(demo, demo.goals, CONFIG)[0].success
    thick = demonstrate(ring_on_a_peg(0, radius=0.017), CONFIG, rng.stream(0, "test", 0))
    assert isinstance(thick, Demo), "6 mm of play: lifted by 10 mm, it would push against the peg from below"
    across = replace(demo, goal_approach=np.array([[0.0, 1, 0]]))
    assert judge(across, demo.goals, CONFIG)[0].reason == "pushed", "through the peg"


def test_inside_of_what_opens_upwards_is_below_its_rim():
    """A block that sticks out of a well is inside, one across the rim is not."""
    well = [box((0.1, 0.02, 0.06), (0, side * 0.04, 0.03)) for side in (-1, 1)]
    well += [box((0.02, 0.06, 0.06), (side * 0.04, 0, 0.03)) for side in (-1, 1)]
    low = [box((0.2, 0.2, 0.01), (0, 0, -0.005))]
    goals = [standing(height=0.1), standing(z=0.06, height=0.1)]
    thing = [box((0.05, 0.05, 0.1), (0, 0, 0))]
    scene = make_scene(goals[:1], well, thing, "box", low, opening=np.array([0.0, 0, 1]), goal_approach=np.array([[0.0, 0, 1]]))
    assert reason_of(scene) == "ok"
    wide = make_scene(goals[1:], well, [box((0.08, 0.08, 0.1), (0, 0, 0))], "box", low, opening=np.array([0.0, 0, 1]))
    assert reason_of(wide) == "outside"


def test_a_single_solid_off_the_objects_origin_is_placed_where_it_is():
    shifted = [Part(part.kind, part.size, pose(rotation_about((0, 0, 1), 0.3), (0.02, 0, -0.01))) for part in BRICK]
    scene = make_scene([standing(z=0.01)], things=shifted, symmetry="none")
    settled, reasons = settle(scene, scene.T_container_goal, CONFIG)
    assert reasons == ["ok"]
    assert np.allclose(settled[0], standing(z=0.0095), atol=2e-4)


# The judge


def can_demo(parts=()) -> Demo:
    demo = demonstrate(make_scene([standing()], parts), CONFIG, rng.stream(0, "test", 0))
    assert isinstance(demo, Demo)
    return demo


def verdict_on(demo: Demo, T_container_object, protocol="strict"):
    return judge(demo, demo.T_world_container @ np.asarray(T_container_object)[None], CONFIG, protocol)[0]


def turned(axis, degrees, z=0.1):
    return pose(rotation_about(axis, np.radians(degrees)), (0, 0, z))


@pytest.mark.parametrize(
    ("T", "reason"),
    [
        (standing(), "ok"),
        (standing(z=0.012), "ok"),  # let go 10 mm below the prediction, it falls 2 mm
        (standing(z=0.025), "moved"),
        (standing(x=0.21), "outside"),
        (standing(y=0.2), "pushed"),
        (standing(y=0.1), "ok"),
        (standing(z=-0.02), "pushed"),
        (standing(z=-0.001), "ok"),
        (turned((1, 0, 0), 180, 0.05), "ok"),
        (turned((0, 0, 1), 77, 0.05), "ok"),
        (turned((1, 0, 0), 14, 0.056), "turned"),
    ],
)
def test_the_judge_names_what_is_wrong(T, reason):
    verdict = verdict_on(can_demo(), T)
    assert (verdict.reason, verdict.success) == (reason, reason == "ok")


def test_a_prediction_that_lies_flat_is_tilted():
    scene = make_scene([standing()], things=BRICK, symmetry="box")
    demo = demonstrate(scene, CONFIG, rng.stream(0, "test", 0))
    assert isinstance(demo, Demo)
    assert verdict_on(demo, turned((1, 0, 0), 90, 0.0205)).reason == "tilted"


def test_a_place_behind_a_post_is_pushed_for():
    verdict = verdict_on(can_demo(), standing(y=0.1))
    assert verdict.push == 0
    post = cylinder(0.01, 0.3, (0.1, 0.1, 0.15), CLUTTER)
    verdict = verdict_on(can_demo([post]), standing(y=0.1))
    assert verdict.reason == "pushed"
    assert verdict.push > simulate.MAX_PUSH
    assert np.isnan(verdict.T_world_object_end).all()


def test_grazing_a_post_by_a_millimetre_is_allowed_and_by_three_is_not():
    post = cylinder(0.01, 0.3, (0.1, 0, 0.15), CLUTTER)
    demo = demonstrate(make_scene([standing(y=-0.1)], [post]), CONFIG, rng.stream(0, "test", 0))
    assert isinstance(demo, Demo)
    grazing = verdict_on(demo, standing(y=0.039))
    assert grazing.success
    assert grazing.push == pytest.approx(7.5, abs=0.5)
    assert verdict_on(demo, standing(y=0.037)).reason == "pushed"


def test_a_shake_or_a_gliding_floor_does_not_count_as_at_rest():
    slope = np.radians(0.4)
    ramp = box((0.36, 0.36, 0.01), (0, 0, 0.02), rotation=rotation_about((0, 1, 0), slope))
    scene = make_scene([standing(y=0.0, z=0.026)], [ramp], things=BRICK, symmetry="box")
    still = demonstrate(scene, CONFIG, rng.stream(0, "test", 0))
    assert isinstance(still, Demo)
    gliding = judge(still, still.goals, PlacementConfig(friction=0.0, max_shift=0.5))[0]
    assert gliding.reason == "not_at_rest"


def test_penetration_and_gap_are_measured_at_the_prediction():
    demo = can_demo()
    assert verdict_on(demo, standing(z=0.0075)).gap == pytest.approx(0.008, abs=1e-4)
    sunk = verdict_on(demo, standing(z=-0.0045))
    assert sunk.penetration == pytest.approx(0.004, abs=1e-4)
    assert sunk.gap == 0


def test_bad_matrices_never_reach_the_simulator():
    demo = can_demo()
    good = demo.goals[0]
    bad = np.stack([np.full((4, 4), np.nan), np.full((4, 4), np.inf), np.diag([2.0, 1, 1, 1]), np.diag([-1.0, 1, 1, 1]), good])
    far = good.copy()
    far[0, 3] = 1e12
    reasons = [verdict.reason for verdict in judge(demo, np.concatenate([bad, far[None]]), CONFIG)]
    assert reasons == ["no_prediction", "no_prediction", "invalid_pose", "invalid_pose", "ok", "invalid_pose"]
    assert judge(demo, np.zeros((0, 4, 4)), CONFIG) == []
    with pytest.raises(UsageError, match=r"expected \(K, 4, 4\)"):
        judge(demo, good, CONFIG)
    with pytest.raises(UsageError, match="expected strict or rpdiff"):
        judge(demo, good[None], CONFIG, "lenient")  # type: ignore[arg-type]


def test_a_prediction_in_single_precision_is_as_good():
    demo = shelf_demo()
    assert all(verdict.success for verdict in judge(demo, demo.goals.astype(np.float32), CONFIG))


@pytest.mark.parametrize("change", [{"part_size": -1.0}, {"T_container_part": np.nan}, {"object_size": 0.0}])
def test_scenes_with_bad_numbers_are_refused(change):
    scene = make_scene([standing()])
    ((name, value),) = change.items()
    bad = getattr(scene, name).copy()
    bad[0] = value
    with pytest.raises(UsageError, match=r"object part|container part"):
        settle(replace(scene, **{name: bad}), scene.T_container_goal, CONFIG)


def wrong_poses(demo: Demo, count: int) -> np.ndarray:
    """Goals shifted by up to 3 cm and turned by up to 10 degrees: right, grazing, and blocked ones."""
    draw = np.random.default_rng(5)
    out = []
    for i in range(count):
        goal = demo.goals[i % len(demo.goals)]
        shift = pose(rotation_about(draw.normal(size=3), np.radians(draw.uniform(0, 10))), draw.uniform(-0.03, 0.03, 3))
        out.append(goal @ shift if i % 3 else goal @ pose(None, draw.uniform(-0.004, 0.004, 3)))
    return np.stack(out)


def assert_same_verdict(a, b, tolerance=0.0):
    assert (a.success, a.reason) == (b.success, b.reason)
    for field in fields(a):
        if field.name not in ("success", "reason"):
            assert np.allclose(getattr(a, field.name), getattr(b, field.name), rtol=0, atol=tolerance, equal_nan=True), (
                field.name
            )


@pytest.mark.parametrize("task", ["can_cabinet", "book_shelf"])
def test_skipping_steps_that_cannot_touch_changes_no_verdict(task):
    module = tasks.load(task)
    small = {"can_cabinet": {"width": (0.3, 0.3), "shelves": (1, 1), "shelf_cans": (2, 2)}, "book_shelf": {"shelves": (1, 1)}}
    draw = rng.stream(3, "scene", 0)
    demo = demonstrate(module.sample_scene(module.Params(**small[task]), draw), CONFIG, draw)
    assert isinstance(demo, Demo)
    poses = wrong_poses(demo, 9)
    for protocol in ("strict", "rpdiff"):
        fast, slow = (judge(demo, poses, CONFIG, protocol, exhaustive=e) for e in (False, True))
        for a, b in zip(fast, slow):
            # Overlaps of less than a hundredth of a millimetre are the simulator's rounding.
            assert_same_verdict(a, b, tolerance=1e-5 * simulate.PUSH_STIFFNESS)
    assert len({verdict.reason for verdict in fast}) > 1


def test_verdicts_do_not_depend_on_the_other_candidates():
    demo = shelf_demo()
    poses = wrong_poses(demo, 12)
    together = judge(demo, poses, CONFIG)
    alone = [judge(demo, T[None], CONFIG)[0] for T in poses]
    backwards = judge(demo, poses[::-1], CONFIG)[::-1]
    for a, b, c in zip(together, alone, backwards):
        assert_same_verdict(a, b)
        assert_same_verdict(a, c)


def test_verdicts_do_not_depend_on_where_the_container_stands():
    demo = shelf_demo("book_shelf")
    poses = wrong_poses(demo, 12)
    T = pose(rotation_about((0, 0, 1), 2.1), (1.0, -3.0, 0.4))
    moved = replace(demo, T_world_container=T @ demo.T_world_container)
    for a, b in zip(judge(demo, poses, CONFIG), judge(moved, T @ poses, CONFIG)):
        assert_same_verdict(a, replace(b, T_world_object_end=inverse(T) @ b.T_world_object_end), tolerance=1e-4)


def test_a_demonstration_is_the_same_whatever_was_simulated_before():
    module = tasks.load("can_cabinet")
    scenes = [module.sample_scene(module.Params(), rng.stream(0, "scene", i)) for i in range(3)]
    first = [demonstrate(scene, CONFIG, rng.stream(0, "x", i)) for i, scene in enumerate(scenes)]
    judge(first[0], first[0].goals, CONFIG)
    again = [demonstrate(scenes[i], CONFIG, rng.stream(0, "x", i)) for i in (2, 1, 0)][::-1]
    for a, b in zip(first, again):
        for field in fields(Demo):
            assert np.asarray(getattr(a, field.name)).tobytes() == np.asarray(getattr(b, field.name)).tobytes()


def test_a_goal_does_not_depend_on_the_other_candidates():
    module = tasks.load("can_cabinet")
    scene = module.sample_scene(module.Params(), rng.stream(0, "scene", 1))
    together, reasons = settle(scene, scene.T_container_goal, CONFIG)
    for g, T in enumerate(scene.T_container_goal):
        alone, reason = settle(scene, T[None], CONFIG)
        assert reason == [reasons[g]]
        assert np.array_equal(alone[0], together[g])


def test_quaternions_are_poses_again():
    draw = np.random.default_rng(0)
    half_turns = [np.diag(signs) for signs in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])]
    for R in [*half_turns, *(random_rotation(draw) for _ in range(200))]:
        T = pose(R, draw.normal(size=3))
        position, quaternion = simulate._to_bullet(T)
        assert np.linalg.norm(quaternion) == pytest.approx(1, abs=1e-12)
        assert np.allclose(simulate._from_bullet(position, quaternion), T, atol=1e-12)


# RPDiff's protocol


def test_rpdiff_asks_a_can_for_contact_and_uprightness_only():
    demo = can_demo()
    assert verdict_on(demo, standing(z=0.03), "rpdiff").success, "it may fall, as long as it ends upright and in contact"
    assert verdict_on(demo, turned((1, 0, 0), 90, 0.031), "rpdiff").reason == "tilted"
    assert verdict_on(demo, standing(x=0.3), "rpdiff").reason == "not_touching"
    assert verdict_on(demo, standing(y=0.2), "rpdiff").reason == "pushed"


def test_rpdiff_gives_a_book_more_attempts():
    books = [box((0.17, 0.04, 0.24), (0, y, 0.12), CLUTTER) for y in (-0.03, 0.062)]
    things = [box((0.16, 0.04, 0.22), (0, 0, 0))]
    goal = standing(y=0.016, height=0.22)
    demo = demonstrate(make_scene([goal], books, things, "box"), CONFIG, rng.stream(0, "test", 0))
    assert isinstance(demo, Demo)
    beside = standing(y=0.0255, height=0.22)  # into the neighbour by 3.5 mm, unless the hand shifts it
    assert verdict_on(demo, beside).reason == "pushed"
    shifted = verdict_on(demo, beside, "rpdiff")
    assert shifted.success
    assert shifted.moved < simulate.RPDIFF_REACHED + 0.005


def test_an_object_without_symmetry_is_put_there_under_rpdiff():
    post = cylinder(0.01, 0.3, (0.1, 0, 0.15), CLUTTER)
    scene = make_scene([standing(y=0.1)], [post], things=BRICK, symmetry="none")
    demo = demonstrate(scene, CONFIG, rng.stream(0, "test", 0))
    assert isinstance(demo, Demo)
    assert verdict_on(demo, standing(), "rpdiff").success
    assert verdict_on(demo, standing()).reason == "pushed"


# The oracle


@pytest.mark.parametrize("task", ["can_cabinet", "book_shelf"])
def test_recorded_goals_pass_the_strict_judge(task):
    module = tasks.load(task)
    verdicts = []
    for i in range(12):
        draw = rng.stream(7, "scene", i)
        scene = module.sample_scene(module.Params(), draw)
        demo = demonstrate(scene, CONFIG, draw) if isinstance(scene, Scene) else scene
        if isinstance(demo, Demo):
            verdicts += judge(demo, demo.goals, CONFIG)
            kind, axis = SYMMETRIES[int(demo.symmetry_kind)], demo.symmetry_axis
            for verdict, goal in zip(verdicts[-len(demo.goals) :], demo.goals):
                assert symmetric_distance(verdict.T_world_object_end, goal, kind, axis)[0] < 1e-3
    assert len(verdicts) > 30
    assert all(verdict.success for verdict in verdicts)


def test_the_simulator_says_nothing_when_it_is_loaded() -> None:
    code = "from dapdata.simulate import _client; _client(0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")
