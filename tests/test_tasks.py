"""Every task and every recipe, found, not listed: what any of them must keep."""

from __future__ import annotations

from collections import Counter
from dataclasses import fields, replace
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

import dapdata
from dapdata import health, pipeline, recipe, rng, solids, tasks
from dapdata.poses import inverse, pose, symmetric_distance
from dapdata.records import GOAL_KINDS, REJECT_REASONS, ROLES, SYMMETRIES, Demo, Rejected, Scene
from dapdata.simulate import HANG_SHIFT, PlacementConfig, demonstrate, judge, settle
from dapdata.tabletop import TabletopConfig

TASKS = tasks.names()
ON_A_TABLE = [task for task in TASKS if issubclass(tasks.load(task).Params, TabletopConfig)]
RECIPES = sorted((Path(__file__).parent.parent / "recipes").rglob("*.yaml"))
SCENES = 8
ATTEMPTS = 10
CONFIG = PlacementConfig()

each_task = pytest.mark.parametrize("task", TASKS)
each_task_on_a_table = pytest.mark.parametrize("task", ON_A_TABLE)


def draw_scene(task: str, i: int) -> Scene | None:
    """The first scene that a task draws from the streams of demo i."""
    module = tasks.load(task)
    drawn = (module.sample_scene(module.Params(), rng.stream(11, "scene", i, attempt)) for attempt in range(ATTEMPTS))
    return next((scene for scene in drawn if isinstance(scene, Scene)), None)


@cache
def scenes(task: str) -> tuple[Scene, ...]:
    return tuple(scene for i in range(SCENES) if (scene := draw_scene(task, i)) is not None)


@cache
def demos(task: str) -> tuple[Demo, ...]:
    out = [demonstrate(scene, CONFIG, rng.stream(11, "choice", i)) for i, scene in enumerate(scenes(task))]
    return tuple(demo for demo in out if isinstance(demo, Demo))


def bytes_of(record: Scene | Demo) -> bytes:
    return b"".join(np.asarray(getattr(record, field.name)).tobytes() for field in fields(record))


def as_parts(kind, size, T, where) -> tuple:
    return kind[where], size[where], T[where]


# Every task


@each_task
def test_the_same_seed_gives_the_same_bytes(task):
    for i, scene in enumerate(scenes(task)[:3]):
        again = draw_scene(task, i)
        assert again is not None
        assert bytes_of(again) == bytes_of(scene)
    assert len({bytes_of(scene) for scene in scenes(task)}) == len(scenes(task))


@each_task
def test_scenes_are_what_the_record_says(task):
    assert len(scenes(task)) == SCENES
    for scene in scenes(task):
        parts, goals = len(scene.part_kind), len(scene.T_container_goal)
        assert scene.part_size.shape == (parts, 3)
        assert scene.T_container_part.shape == (parts, 4, 4)
        assert scene.T_container_goal.shape == (goals, 4, 4)
        assert len(scene.goal_kind) == len(scene.goal_clearance) == goals > 0
        assert np.allclose(np.linalg.norm(scene.goal_approach, axis=1), np.ones(goals))
        for T in (*scene.T_container_part, *scene.T_container_goal, scene.T_world_container, scene.T_world_object_start):
            assert np.allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-9)
        assert (scene.part_size > 0).all()
        assert np.isfinite(scene.goal_clearance).all()
        assert np.linalg.norm(scene.opening) == pytest.approx(1)
        assert np.linalg.norm(scene.symmetry_axis) == pytest.approx(1)
        assert np.allclose(scene.T_world_container[:3, 2], [0, 0, 1]), "containers are only turned about the vertical"
        container = scene.part_role == ROLES.index("container")
        low, high = solids.bounds(*as_parts(scene.part_kind, scene.part_size, scene.T_container_part, container)).transpose(
            1, 0, 2
        )
        assert np.allclose((low.min(axis=0) + high.max(axis=0))[:2], 0, atol=1e-9), "origin: centre of the footprint"
        assert low[:, 2].min() == pytest.approx(0, abs=1e-9)
        extent = solids.bounds(scene.object_kind, scene.object_size, scene.T_object_part)
        assert np.allclose(extent[:, 0].min(axis=0), -extent[:, 1].max(axis=0)), "origin: centre of the bounding box"


@each_task
def test_instances_are_digests_of_geometry_alone(task):
    assert len({scene.container_instance for scene in scenes(task)}) == len(scenes(task))
    for scene in scenes(task):
        assert scene.container_instance == solids.digest(scene.part_kind, scene.part_size, scene.T_container_part)
        assert scene.object_instance == solids.digest(scene.object_kind, scene.object_size, scene.T_object_part)


@each_task
def test_bodies_overlap_nowhere(task):
    """Points on the surface of a part of the clutter lie in no other part, and none of these in it, by more than 0.1 mm.

    The container is one body, and its own parts may be welded into each other.
    """
    for scene in scenes(task)[:4]:
        draw, count, role = np.random.default_rng(0), len(scene.part_kind), scene.part_role
        low, high = solids.bounds(scene.part_kind, scene.part_size, scene.T_container_part).transpose(1, 0, 2)
        for p in range(count):
            one = as_parts(scene.part_kind, scene.part_size, scene.T_container_part, [p])
            bodies = [q for q in range(count) if q != p and (role[p] or role[q])]
            near = [q for q in bodies if (low[q] < high[p]).all() and (high[q] > low[p]).all()]
            if near:
                points = solids.surface_points(*one, 400, draw)
                others = as_parts(scene.part_kind, scene.part_size, scene.T_container_part, near)
                assert solids.signed_distance(points, *others).min() > -1e-4


@each_task
def test_the_object_starts_beside_the_container_and_above_the_table(task):
    for scene in scenes(task):
        points = solids.surface_points(scene.object_kind, scene.object_size, scene.T_object_part, 500, np.random.default_rng(0))
        world = points @ scene.T_world_object_start[:3, :3].T + scene.T_world_object_start[:3, 3]
        T_container_world = inverse(scene.T_world_container)
        inside = world @ T_container_world[:3, :3].T + T_container_world[:3, 3]
        parts = (scene.part_kind, scene.part_size, scene.T_container_part)
        assert solids.signed_distance(inside, *parts).min() > 0.015
        assert world[:, 2].min() > -1e-9


@each_task
def test_candidates_differ(task):
    for scene in scenes(task):
        kind = SYMMETRIES[scene.symmetry_kind]
        for a, b in combinations(scene.T_container_goal, 2):
            shift, turn = symmetric_distance(a, b, kind, scene.symmetry_axis)
            assert shift > 0.01 or turn > 0.5


@each_task
def test_goals_settle_where_they_were_proposed(task):
    """A task proposes places that hold; some may be barred or shaky. On a peg they hold in another pose."""
    assert len(demos(task)) >= SCENES - 2
    hangs = any(GOAL_KINDS[kind] == "peg" for demo in demos(task) for kind in demo.goal_kind)
    lost = Counter(REJECT_REASONS[code] for demo in demos(task) for code in demo.rejected_reason)
    assert set(lost) <= {"unreachable", "shaken_off"}
    most_shift, most_turn = (HANG_SHIFT, np.pi / 3) if hangs else (0.002, 0.01)
    by_start = {scene.T_world_object_start.tobytes(): scene for scene in scenes(task)}
    for demo in demos(task):
        scene = by_start[demo.T_world_object_start.tobytes()]
        proposed = scene.T_world_container @ scene.T_container_goal
        for goal in demo.goals:
            shifts = [symmetric_distance(T, goal, SYMMETRIES[int(demo.symmetry_kind)], demo.symmetry_axis) for T in proposed]
            assert any(shift < most_shift and turn < most_turn for shift, turn in shifts)
        assert len(demo.goals) + len(demo.rejected_goals) == len(proposed)


@each_task
def test_the_demonstrated_goal_is_among_the_goals(task):
    for demo in demos(task):
        assert any(np.array_equal(demo.T_world_object_goal, goal) for goal in demo.goals)


@each_task
def test_the_oracle_passes_the_judge(task):
    for demo in demos(task)[:4]:
        assert all(verdict.success for verdict in judge(demo, demo.goals, CONFIG))
        assert judge(demo, demo.T_world_object_goal[None], CONFIG, "rpdiff")[0].reason in ("ok", "pushed")


@each_task_on_a_table
def test_a_start_in_any_rotation_hangs_over_the_table(task):
    module = tasks.load(task)
    up = []
    for i in range(SCENES):
        scene = module.sample_scene(module.Params(start="any"), rng.stream(11, "scene", i))
        if isinstance(scene, Scene):
            up.append(scene.T_world_object_start[2, 2])
            assert scene.T_world_object_start[2, 3] == pytest.approx(0.2)
    assert min(up) < 0.5 < max(np.abs(up))


@each_task
def test_every_key_says_what_it_is(task):
    for name, field in tasks.load(task).Params.model_fields.items():
        assert field.description, name
        assert not field.is_required(), name


@each_task_on_a_table
def test_ranges_are_checked(task):
    params = tasks.load(task).Params
    assert params(yaw_deg=[10.0, 20.0]).yaw_deg == (10.0, 20.0)
    for wrong in ({"yaw_deg": [20.0, 10.0]}, {"yaw_deg": [0.0, np.nan]}, {"yaw_deg": [0.0]}, {"yaw_deg": 3.0}, {"yaw": 1}):
        with pytest.raises(ValidationError):
            params(**wrong)


# Every recipe


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: str(path.relative_to(path.parents[1])))
def test_recipes_give_demonstrations(path):
    read = recipe.load(path)
    module, made = tasks.load(read.scene.task), 0
    for i in range(3):
        draw = rng.stream(read.seed, "scene", i)
        scene = module.sample_scene(read.scene, draw)
        demo = demonstrate(scene, read.placement, draw) if isinstance(scene, Scene) else scene
        made += isinstance(demo, Demo)
    assert made >= 2
    assert path.read_text().startswith("# yaml-language-server: $schema=")


# What is particular to single tasks


@pytest.mark.parametrize("task", ["can_cabinet", "book_shelf"])
def test_containers_that_hold_nothing_are_refused(task):
    with pytest.raises(ValidationError, match=r"expected .* m or more"):
        tasks.load(task).Params(width=(0.01, 0.02))


WRONG = {  # each task's smallest container that holds nothing, or a value that makes no sense
    "dish_rack": ({"rail_height": (0.005, 0.01)}, {"clearance": (0.0, 0.01)}, {"plate_radius": (0.05, 0.06)}),
    "fruit_rack": ({"height": (0.01, 0.02)}, {"hole": (0.2, 0.5)}, {"occupied": (0, 4)}, {"flatness": (0.3, 0.9)}),
    "mug_rack": (
        {"handle_depth": (0.01, 0.012)},
        {"peg_angle_deg": (20.0, 50.0)},
        {"racks": (1, 3), "rack_spacing": (0.1, 0.2)},
    ),
    "vial_rack": ({"pitch": (0.02, 0.03)}, {"clearance": (0.0, 0.001)}, {"height": (0.01, 0.02)}),
}


@pytest.mark.parametrize(("task", "wrong"), [(task, wrong) for task, several in WRONG.items() for wrong in several])
def test_racks_that_hold_nothing_are_refused(task, wrong):
    with pytest.raises(ValidationError, match=r"(got .* expected|expected .* or more)"):
        tasks.load(task).Params(**wrong)


def test_a_vial_has_its_clearance_on_each_side_and_every_free_hole_is_a_goal():
    params = tasks.load("vial_rack").Params(clearance=(0.003, 0.003), occupancy=(0.0, 0.5))
    for i in range(4):
        scene = tasks.load("vial_rack").sample_scene(params, rng.stream(11, "vials", i))
        assert len(scene.T_container_goal) + (scene.part_role == ROLES.index("clutter")).sum() == 14
        parts = (scene.part_kind, scene.part_size, scene.T_container_part)
        around = (scene.part_kind, scene.part_size, solids.bounds(*parts))
        for T, clearance in zip(scene.T_container_goal, scene.goal_clearance):
            vial = solids.cylinder(scene.object_size[0, 0] / 2, scene.object_size[0, 2], T[:3, 3])
            assert solids.free_play(vial, *around) == pytest.approx(clearance) == pytest.approx(0.006)


def test_vials_of_the_least_clearance_go_in():
    module = tasks.load("vial_rack")
    scene = module.sample_scene(module.Params(clearance=(0.001, 0.001)), rng.stream(11, "vials", 0))
    demo = demonstrate(scene, CONFIG, rng.stream(11, "choice", 0))
    assert isinstance(demo, Demo)
    assert len(demo.rejected_goals) == 0
    aside = demo.goals @ pose(None, (0.004, 0, 0))
    assert {verdict.reason for verdict in judge(demo, aside, CONFIG)} == {"pushed"}


def test_plates_lean_in_gaps_that_take_them_and_narrow_gaps_are_no_goals():
    for scene in scenes("dish_rack"):
        thickness, prongs = scene.object_size[0, 2], scene.part_size[:, 2] > 0.05
        prongs &= (scene.part_kind == solids.CYLINDER) & (scene.part_role == ROLES.index("container"))
        places, radius = np.unique(scene.T_container_part[prongs, 1, 3].round(6)), scene.part_size[prongs][0, 0] / 2
        gaps = np.diff(places) - 2 * radius
        wide = (places[:-1] + places[1:])[gaps > thickness] / 2
        plates = scene.T_container_part[scene.part_role == ROLES.index("clutter"), 1, 3]
        goals = scene.T_container_goal[:, 1, 3]
        assert np.allclose(np.sort([*plates, *goals]), wide, atol=1e-5)
    assert any((np.diff(np.sort(scene.T_container_goal[:, 1, 3])) > 0.03).any() for scene in scenes("dish_rack"))


def test_mugs_hang_by_their_handle_to_either_side_of_each_peg():
    for demo in demos("mug_rack"):
        assert len(demo.goals) == 2
        T = inverse(demo.T_world_container) @ demo.goals
        assert (T[:, 2, 0] > 0.7).all(), "the handle is on top"
        assert T[0, :3, 2] @ T[1, :3, 2] < 0, "and the opening to the one side, or to the other"
        handle = demo.T_object_part[:, 0, 3].argmax()
        for pose_ in T:
            peg = demo.T_container_part[demo.part_kind == solids.CYLINDER][-1]
            x, y, z = (inverse(peg) @ pose_ @ demo.T_object_part[handle])[:3, 3]
            assert np.hypot(x, y) < 0.03, "its outermost piece lies on the peg"
            assert abs(z) < 0.08


def test_mugs_begin_clear_of_other_pegs():
    params = tasks.load("mug_rack").Params(pegs=(2, 2), peg_angle_deg=(35.0, 70.0), peg_yaw_deg=(-40.0, 40.0))
    drawn = [tasks.load("mug_rack").sample_scene(params, rng.stream(11, "pegs", i)) for i in range(6)]
    reasons = [settle(scene, scene.T_container_goal, CONFIG)[1] for scene in drawn if isinstance(scene, Scene)]
    counts = Counter(reason for several in reasons for reason in several)
    assert counts["penetrates"] == 0
    assert counts["ok"] >= 10


def test_a_mug_that_stands_at_the_foot_of_its_rack_is_no_success():
    params = tasks.load("mug_rack").Params(foot_probability=1.0, plate_side=(0.2, 0.2), disc_radius=(0.1, 0.1))
    scene = tasks.load("mug_rack").sample_scene(params, rng.stream(11, "foot", 0))
    demo = demonstrate(scene, CONFIG, rng.stream(11, "choice", 0))
    assert isinstance(demo, Demo)
    foot = solids.bounds(demo.part_kind[:1], demo.part_size[:1], demo.T_container_part[:1])[0]
    mug = solids.bounds(demo.object_kind, demo.object_size, demo.T_object_part)
    z = foot[1, 2] - mug[:, 0, 2].min() + 0.0005
    standing = pose(None, (foot[0, 0] - mug[:, 0, 0].min() + 0.005, foot[0, 1] - mug[:, 0, 1].min() + 0.005, z))
    upwards = replace(demo, goal_approach=np.tile([0.0, 0, 1], (len(demo.goals), 1)))
    assert judge(upwards, demo.T_world_container @ standing[None], CONFIG)[0].reason == "not_touching"


def test_a_mixture_draws_each_of_its_scenes_with_its_own_keys():
    module = tasks.load("mixed")
    params = recipe.from_resolved(
        {"scene": {"task": "mixed", "scenes": [{"task": "can_cabinet", "shelves": [1, 1]}, {"task": "vial_rack"}]}}
    ).scene
    drawn = [module.sample_scene(params, rng.stream(11, "mixed", i)) for i in range(12)]
    kinds = {scene.task: GOAL_KINDS[scene.goal_kind[0]] for scene in drawn}
    assert set(kinds) == {0, 1}
    assert kinds[1] == "hole"
    for i, scene in enumerate(drawn):
        draw = rng.stream(11, "mixed", i)
        draw.integers(2)
        alone = tasks.load(params.scenes[scene.task].task).sample_scene(params.scenes[scene.task], draw)
        assert bytes_of(replace(alone, task=scene.task)) == bytes_of(scene)


def test_a_dataset_of_a_mixture_says_of_which_task_each_demo_is(tmp_path):
    small = [
        "demos=10",
        "shard_size=5",
        "cameras.width=120",
        "cameras.height=90",
        "superpoints.count=64",
        "split.val=0.2",
        "split.test=0.2",
    ]
    read = recipe.load(next(path for path in RECIPES if path.stem == "mixed"), small)
    root = pipeline.label(pipeline.generate(read, tmp_path / "mixed", engine="inline"), engine="inline")
    dataset = dapdata.open(root)
    named = [read.scene.scenes[int(sample["meta/task"])].task for sample in dataset]
    assert named == dataset.index["task"].tolist()
    assert set(named) == {"book_shelf", "can_cabinet"}
    assert [GOAL_KINDS[sample["goals/kind"][0]] == "gap" for sample in dataset] == [name == "book_shelf" for name in named]
    assert len(set(dataset.index["split"])) == 3
    assert health.verify(root).ok


def sizes_of(scene: Scene, role: str) -> np.ndarray:
    return scene.part_size[scene.part_role == ROLES.index(role)]


def test_shipped_scenes_are_dense_and_offer_a_choice():
    for task in ("can_cabinet", "book_shelf"):
        counts = [len(demo.goals) for demo in demos(task)]
        assert 3 <= np.mean(counts) <= 6
        clearance = np.concatenate([demo.goal_clearance for demo in demos(task)])
        assert np.median(clearance) < 0.025


def test_cans_come_on_stacks_and_on_the_floor_and_never_too_high():
    kinds = Counter(GOAL_KINDS[kind] for scene in scenes("can_cabinet") for kind in scene.goal_kind)
    assert set(kinds) == {"stack", "floor"}
    assert kinds["stack"] > kinds["floor"]


def test_a_book_is_its_neighbours_book_a_tenth_smaller_and_higher_than_deep():
    for scene in scenes("book_shelf"):
        assert np.allclose(scene.object_size[0], 0.9 * sizes_of(scene, "clutter")[0])
        assert scene.object_size[0, 2] - scene.object_size[0, 0] >= 0.025


def test_bookshelves_tempt_with_gaps_that_are_too_narrow():
    narrow = 0
    for scene in scenes("book_shelf"):
        T = scene.T_container_part[scene.part_role == ROLES.index("clutter")]
        thickness = sizes_of(scene, "clutter")[0, 1]
        for floor in np.unique(T[:, 2, 3].round(6)):
            y = np.sort(T[np.isclose(T[:, 2, 3], floor), 1, 3])
            gap = np.diff(y) - thickness
            narrow += int(((gap > 0.008) & (gap < scene.object_size[0, 1])).sum())
    assert narrow >= 2 * len(scenes("book_shelf"))


def test_every_gap_that_takes_the_book_is_a_candidate():
    """A brute-force twin: the book is moved along each floor, and wherever it is free a candidate is at hand."""
    for scene in scenes("book_shelf")[:4]:
        parts = (scene.part_kind, scene.part_size, scene.T_container_part)
        goals, half = scene.T_container_goal, scene.object_size[0] / 2
        side = sizes_of(scene, "container")[0, 1] / 2 - half[1]  # a floor reaches from wall to wall
        grid = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3) * half
        for z in np.unique(goals[:, 2, 3].round(9)):
            on_floor = goals[np.isclose(goals[:, 2, 3], z), 1, 3]
            for y in np.arange(-side, side, 0.001):
                if solids.signed_distance(grid + np.array([goals[0, 0, 3], y, z]), *parts).min() > -1e-6:
                    assert np.abs(on_floor - y).min() < 0.04


def test_published_clutter_is_within_reach_of_named_keys():
    read = recipe.load(next(path for path in RECIPES if path.parts[-2:] == ("rpdiff", "can_cabinet.yaml")))
    module = tasks.load("can_cabinet")
    for i in range(5):
        scene = module.sample_scene(read.scene, rng.stream(0, "scene", i))
        assert isinstance(scene, Scene)
        cans = sizes_of(scene, "clutter")
        assert cans[:, 0].min() >= 0.02 * 2 * 0.75
        assert cans[:, 0].max() <= 0.0325 * 2
        T = scene.T_container_part[scene.part_role == ROLES.index("clutter")]
        lowest = T[np.isclose(T[:, 2, 3] - cans[:, 2] / 2, (T[:, 2, 3] - cans[:, 2] / 2).min())]
        assert np.diff(np.sort(lowest[:, 1, 3])).min() > 0.04, "one row"


def test_a_task_says_when_there_is_no_slot():
    module = tasks.load("can_cabinet")
    params = module.Params(open_columns=[0, 0], open_stacks=[0, 0], hidden_stacks=[0, 0], object_scale=[1.0, 1.0])
    assert module.sample_scene(params, rng.stream(0, "scene", 0)) == Rejected("no_free_slot")


def test_a_task_says_when_there_is_no_room_for_the_start():
    module = tasks.load("book_shelf")
    params = module.Params(radius=[0.0, 0.0], start_x=[0.3, 0.3], start_y=[0.0, 0.0])
    assert module.sample_scene(params, rng.stream(0, "scene", 0)) == Rejected("no_room_for_start")


def test_the_container_faces_the_middle_of_the_table():
    for scene in scenes("book_shelf"):
        facing = scene.T_world_container[:3, :3] @ scene.opening
        to_centre = np.array([0.3, 0, 0]) - scene.T_world_container[:3, 3]
        assert facing @ to_centre == pytest.approx(np.linalg.norm(to_centre))
        assert 0.45 <= np.linalg.norm(to_centre) <= 0.55
        assert np.allclose(scene.T_world_container, pose(scene.T_world_container[:3, :3], scene.T_world_container[:3, 3]))
