"""Scans in and out: what is found is what was done, and what cannot be told is rejected with its figure."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import hand_scans
import numpy as np
import pytest
from hand_scans import CUBOID, T_GOAL, T_START, Cloud, clouds, write

from dapdata import cli, health, imports, loading, metrics, pipeline
from dapdata.clouds import MAX_POINTS, write_ply
from dapdata.config import ScansConfig
from dapdata.errors import FormatError, RecipeError, UsageError
from dapdata.interop import scan_clouds, scan_files, scan_placement, scans
from dapdata.observe import CamerasConfig
from dapdata.poses import angle_between, inverse, pose, rotate, rotation_about, symmetric_distance, transform
from dapdata.records import GOAL_KINDS, Array, MeshDemo, Rejected
from dapdata.simulate import PlacementConfig

SPLIT = ("--set", "split.test=0.4", "--set", "split.val=0")
CAMERA = {"T_world_camera": pose(np.diag([1.0, -1, -1]), (0, 0, 1)).tolist()}  # looks down from 1 m


def config_of(source: Path, **more: Any) -> ScansConfig:
    return ScansConfig.model_validate(scan_files.scene_section(str(source)) | more)


def demonstrated(source: Path, **more: Any) -> MeshDemo:
    """The one demonstration of a folder; it must not be rejected."""
    demo = scan_placement.demonstrate(config_of(source, **more), PlacementConfig(), 0)
    assert isinstance(demo, MeshDemo), demo
    return demo


def explained(source: Path, **more: Any) -> str:
    """Why the one demonstration of a folder is rejected: reason and detail, without the folder's name."""
    rejected = scan_placement.demonstrate(config_of(source, **more), PlacementConfig(), 0)
    assert isinstance(rejected, Rejected)
    folder, _, found = rejected.detail.partition(": ")
    assert folder == "a"
    return f"{rejected.reason}: {found}"


def motion(demo: MeshDemo) -> Array:
    return demo.T_world_object_goal @ inverse(demo.T_world_object_start)


# By hand ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moved", [False, True], ids=["container stands", "container moves"])
def test_the_placement_is_found_in_the_container_as_it_stood(moved: bool, tmp_path: Path) -> None:
    T_after = pose(rotation_about((0, 0, 1), 0.3), (0.04, -0.03, 0)) if moved else np.eye(4)
    write(tmp_path / "a", clouds(T_container=(np.eye(4), T_after)))
    demo = demonstrated(tmp_path)
    T = motion(demo) @ T_START
    assert np.linalg.norm((T - T_GOAL)[:3, 3]) < 0.002
    assert angle_between(T[:3, :3], T_GOAL[:3, :3]) < np.radians(0.5)
    assert [GOAL_KINDS[kind] for kind in demo.goal_kind] == ["shown"]
    np.testing.assert_array_equal(demo.goals[0], demo.T_world_object_goal)
    assert demo.T_world_object_goal[2, 2] > 0.7  # z up at the goal
    np.testing.assert_allclose(demo.T_world_container, np.eye(4), atol=0.005)
    middle = inverse(T_START) @ demo.T_world_object_start[:, 3]
    np.testing.assert_allclose(middle[:3], 0, atol=0.02)  # of the block, but for its knob


def test_a_cuboid_turns_least_and_its_goal_is_right_modulo_half_turns(tmp_path: Path) -> None:
    T_turned = T_GOAL @ pose(rotation_about((0, 0, 1), np.pi))
    write(tmp_path / "a", clouds(CUBOID, T_goal=T_turned), {"symmetry": "box"})
    demo = demonstrated(tmp_path)
    shift, turn = symmetric_distance(motion(demo) @ T_START, T_GOAL, "box", np.zeros(3))
    assert shift < 0.003
    assert turn < np.radians(1)
    half_turns = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    turns = [angle_between(T_GOAL[:3, :3] * signs, T_START[:3, :3]) for signs in half_turns]
    np.testing.assert_allclose(angle_between(motion(demo)[:3, :3], np.eye(3)), min(turns), atol=0.03)


def test_the_axis_of_a_revolution_is_found_from_one_side() -> None:
    angle = np.linspace(0, 1.5, 40)  # a quarter of a cylinder around (0.3, 0.1)
    normals = np.repeat(np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), 20, axis=0)
    points = 0.04 * normals + [0.3, 0.1, 0] + np.tile(np.linspace(0, 0.1, 20)[:, None] * [0, 0, 1], (40, 1))
    surface = scan_placement.Surface(points, normals)
    found = scan_placement._onto_axis(points.mean(axis=0), surface, np.array([0, 0, 1.0]))
    np.testing.assert_allclose(found, [0.3, 0.1, 0.05], atol=1e-9)


def same_scan(source: Path, other: Path) -> None:
    """Asserts that two folders hold the same demonstration, to the precision of their files."""
    one, two = (scan_files.read(config_of(path), 0) for path in (source, other))
    for where, cloud in one.clouds.items():
        np.testing.assert_allclose(cloud.points, two.clouds[where].points, atol=1e-6)
        np.testing.assert_allclose(cloud.normals, two.clouds[where].normals, atol=1e-6)
    np.testing.assert_allclose(one.opening, two.opening, atol=1e-9)


def joined(found: dict[str, Cloud], stage: str) -> tuple[Array, Array, Array]:
    """Points, normals and labels of both bodies of a stage."""
    parts = [found[f"{stage}_{body}"] for body in scan_files.BODIES]
    label = np.repeat([1, 2], [len(points) for points, _ in parts])
    return *(np.concatenate(arrays) for arrays in zip(*parts)), label  # type: ignore[return-value]


@pytest.mark.parametrize("layout", ["labels in npz", "labels beside ply", "text pcd"])
def test_every_layout_is_the_same_demonstration(layout: str, tmp_path: Path) -> None:
    found = clouds()
    write(tmp_path / "separate" / "a", found)
    folder = tmp_path / "other" / "a"
    folder.mkdir(parents=True)
    for stage in scan_files.STAGES:
        points, normals, label = joined(found, stage)
        if layout == "labels in npz":
            np.savez(folder / f"{stage}.npz", points=points, normals=normals, label=label)
        elif layout == "labels beside ply":
            write_ply(folder / f"{stage}.ply", points, normals)
            np.save(folder / f"{stage}_labels.npy", label.astype(np.uint8))
        else:
            rows = "\n".join(" ".join(f"{x:.7f}" for x in row) + f" {k}" for *row, k in zip(*points.T, *normals.T, label))
            names = "x y z normal_x normal_y normal_z label"
            head = f"FIELDS {names}\nSIZE 4 4 4 4 4 4 1\nTYPE F F F F F F U\nPOINTS {len(points)}\nDATA ascii\n"
            (folder / f"{stage}.pcd").write_text(head + rows + "\n")
    same_scan(tmp_path / "separate", tmp_path / "other")


def test_millimetres_and_another_axis_up_are_the_same_demonstration_when_told(tmp_path: Path) -> None:
    found = clouds()
    write(tmp_path / "ours" / "a", found, {"opening": [1, 0, 0]})
    tilted = pose(rotation_about((1, 0, 0), -np.pi / 2), (0, 0.5, 0))  # z becomes y; the table lies at 500 mm
    theirs = {name: (1000 * transform(tilted, points), rotate(tilted, normals)) for name, (points, normals) in found.items()}
    about = {"units": "mm", "up": "+y", "table": 500.0, "opening": [1, 0, 0]}
    write(tmp_path / "theirs" / "a", theirs, about)
    ours = config_of(tmp_path / "ours")
    write(tmp_path / "ours" / "a", found, {"opening": [1, 0, 0], "table": 0.0})
    scan_files.find.cache_clear()
    assert ours.source
    same_scan(tmp_path / "ours", tmp_path / "theirs")


def test_what_is_told_for_all_holds_unless_one_tells_otherwise(tmp_path: Path) -> None:
    for name in "ab":
        write(tmp_path / name, clouds())
    (tmp_path / "scan.json").write_text('{"symmetry": "box", "container": "tray"}')
    (tmp_path / "b/scan.json").write_text('{"symmetry": "none", "object": "block"}')
    first, second = (scan_files.read(config_of(tmp_path), demo).about for demo in range(2))
    assert (first.symmetry, first.container, first.object) == ("box", "tray", "")
    assert (second.symmetry, second.container, second.object) == ("none", "tray", "block")


def test_flipped_normals_are_turned_to_the_camera_that_saw_the_point(tmp_path: Path) -> None:
    found = {name: (points, -normals) for name, (points, normals) in clouds().items()}
    above = {name: (points[normals[:, 2] < -0.5], normals[normals[:, 2] < -0.5]) for name, (points, normals) in found.items()}
    folder = tmp_path / "a"
    folder.mkdir()
    for name, (points, normals) in above.items():
        np.savez(folder / f"{name}.npz", points=points, normals=normals, view=np.zeros(len(points), np.uint8))
    (folder / "scan.json").write_text(json.dumps({"cameras": [CAMERA]}))
    config = config_of(tmp_path, check_table=False)
    prepared = scan_clouds.prepare(scan_files.read(config, 0), config)
    for ((_, normals),) in prepared.views.values():
        assert (normals[:, 2] > 0.9).all()


# Faults ----------------------------------------------------------------------------------------------------

Found = dict[str, Cloud]


def _far(found: Found) -> Found:
    points, normals = found["end_object"]
    return found | {"end_object": (transform(pose(None, (0, 0.6, 0)), points), normals)}


def _swapped(found: Found) -> Found:
    return {name.replace("start", "x").replace("end", "start").replace("x", "end"): cloud for name, cloud in found.items()}


def _on_table(found: Found) -> Found:
    points, normals = found["start_container"]
    x, y = (g.ravel() for g in np.meshgrid(np.arange(-0.5, 0.5, 0.01), np.arange(-0.5, 0.5, 0.01)))
    table = np.stack([x, y, 0 * x], axis=1)
    return found | {
        "start_container": (np.concatenate([points[::3], table]), np.concatenate([normals[::3], table * 0 + [0, 0, 1]]))
    }


def _scattered(found: Found) -> Found:
    points, normals = found["start_object"]
    apart = points.copy()
    apart[::3] += 0.2 * np.sin(np.arange(len(points[::3]))[:, None] * [12.9, 78.2, 37.7])
    return found | {"start_object": (apart, normals)}


def _other(name: str, boxes: Any, T: Array) -> Callable[[Found], Found]:
    return lambda found: found | {name: hand_scans.surface(boxes, T, 9)}


def _edited(name: str, change: Callable[[Array, Array], Cloud]) -> Callable[[Found], Found]:
    return lambda found: found | {name: change(*(array.copy() for array in found[name]))}


def _with_nan(points: Array, normals: Array) -> Cloud:
    points[3, 1] = np.nan
    return points, normals


GOOD: Callable[[Found], Found] = dict
FAULTS: dict[str, tuple[str, Callable[[Found], Found], dict[str, Any] | None, str]] = {  # reason, clouds, scan.json, words
    "unknown key": ("bad_scan_json", GOOD, {"unit": "mm"}, "known keys: units, up"),
    "unknown unit": ("bad_scan_json", GOOD, {"units": "cm"}, "units: input should be 'm' or 'mm'"),
    "no axis": ("bad_scan_json", GOOD, {"axis": [0, 0, 0]}, "expected a direction"),
    "no end": (
        "missing_cloud",
        lambda f: {k: v for k, v in f.items() if k != "end_object"},
        None,
        "no end.ply and no end_object",
    ),
    "NaN": ("not_finite", _edited("end_object", _with_nan), None, "1 of .* points are not finite"),
    "mm for m": ("not_metres", lambda f: {k: (1000 * p, n) for k, (p, n) in f.items()}, None, 'set "units": "mm" in scan.json'),
    "m for mm": ("not_metres", GOOD, {"units": "mm"}, 'set "units": "m" in scan.json'),
    "mirrored": (
        "bad_camera",
        GOOD,
        {"cameras": [{"T_world_camera": np.diag([1.0, 1, -1, 1]).tolist()}]},
        r"cameras\.0\.T_world_camera: is mirrored",
    ),
    "3x4": ("bad_camera", GOOD, {"cameras": [{"T_world_camera": np.eye(4)[:3].tolist()}]}, "expected 4 rows of 4"),
    "up is down": ("wrong_up", GOOD, {"up": "-z", "cameras": [CAMERA]}, "below the container with up -z"),
    "table": ("table_in_cloud", _on_table, None, "times the area of the rest"),
    "outliers": ("scattered", _scattered, None, r"start, object: \d\d% of the points are apart"),
    "inwards": ("normals_inwards", lambda f: {k: (p, -n) for k, (p, n) in f.items()}, None, "flip them"),
    "swapped": ("start_and_end_swapped", _swapped, None, "expected the reverse"),
    "beside": ("not_placed", _far, None, r"\d+\.\d cm from the container, expected 3 cm"),
    "other container": (
        "container_does_not_fit",
        _other("end_container", (((0.2, 0.2, 0.2), (0, 0, 0.1)),), np.eye(4)),
        None,
        r"explains 0\.\d\d of it after",
    ),
    "other object": (
        "does_not_fit",
        _other("end_object", (((0.03, 0.03, 0.03), (0, 0, 0)),), T_GOAL),
        None,
        r"explained to 0\.\d\d .*expected 0\.9 and 0\.4",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_rejects_by_reason_and_says_what_was_found(name: str, tmp_path: Path) -> None:
    reason, change, about, words = FAULTS[name]
    write(tmp_path / "a", change(clouds()), about)
    line = explained(tmp_path)
    assert line.startswith(f"{reason}: "), line
    assert re.search(words, line), line
    assert "\n" not in line


def labelled(folder: Path, label: Any, rest: Array | None = None, **more: Any) -> Path:
    """A demonstration in two npz files, with labels made from the true ones, and points of neither."""
    folder.mkdir(parents=True)
    found = clouds()
    for stage in scan_files.STAGES:
        points, normals, true = joined(found, stage)
        if rest is not None:
            points, normals = np.concatenate([points, rest]), np.concatenate([normals, rest * 0 + [0, 0, 1]])
            true = np.concatenate([true, np.zeros(len(rest), int)])
        np.savez(folder / f"{stage}.npz", points=points, normals=normals, **({} if label is None else {"label": label(true)}))
    if more:
        (folder / "scan.json").write_text(json.dumps(more))
    return folder


@pytest.mark.parametrize(
    ("reason", "label", "words"),
    [
        ("empty_mask", lambda true: np.where(true == 2, 0, true), "start, object: no points, expected some with label 2"),
        ("bad_labels", None, "no label of each point and no start_labels.npy"),
    ],
)
def test_masks_that_are_empty_or_not_there_reject(reason: str, label: Any, words: str, tmp_path: Path) -> None:
    labelled(tmp_path / "a", label)
    assert explained(tmp_path).startswith(f"{reason}: {words}")


def test_labels_of_another_length_reject(tmp_path: Path) -> None:
    np.save(labelled(tmp_path / "a", lambda true: true) / "end_labels.npy", np.ones(7, np.uint8))
    assert "end_labels.npy: uint8 (7,), expected" in explained(tmp_path)


def test_a_table_across_another_axis_than_up_rejects_and_one_across_it_is_the_ground(tmp_path: Path) -> None:
    x, y = (g.ravel() for g in np.meshgrid(np.arange(-1, 1, 0.03), np.arange(-1, 1, 0.03)))
    table = np.stack([x, y, 0 * x - 0.2], axis=1)
    labelled(tmp_path / "good" / "a", lambda true: true, table)
    lowest = scan_files.read(config_of(tmp_path / "good"), 0).clouds["start", "container"].points[:, 2].min()
    assert lowest == pytest.approx(0.2, abs=0.003)  # the tray stands 20 cm above this table
    labelled(tmp_path / "bad" / "a", lambda true: true, table, up="+y")
    line = explained(tmp_path / "bad")
    assert line.startswith("wrong_up: "), line
    assert 'set "up": "+z" or "-z"' in line


def test_normals_are_needed_where_there_are_no_cameras(tmp_path: Path) -> None:
    write(tmp_path / "a", clouds(), normals=False)
    assert explained(tmp_path).startswith("no_normals: ")


@pytest.mark.parametrize("damage", ["cut", "words", "keys"])
def test_files_that_are_cut_off_or_of_another_kind_reject(damage: str, tmp_path: Path) -> None:
    path = write(tmp_path / "a", clouds()) / "end_object.ply"
    data = path.read_bytes()
    damaged = {"cut": data[:-100], "words": b"not a cloud", "keys": data.replace(b"float x", b"float q")}[damage]
    path.write_bytes(damaged)
    line = explained(tmp_path)
    assert re.match(r"unreadable: end_object\.ply: (holds \d+ bytes, expected|has no header|has no x, expected)", line), line


def test_a_cloud_of_a_hundred_million_points_is_refused_by_its_header(tmp_path: Path) -> None:
    path = write(tmp_path / "a", clouds()) / "end_object.ply"
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 100000000\n{names}end_header\n".encode()
    with path.open("wb") as file:
        file.write(header)
        file.truncate(len(header) + 24 * 100_000_000)  # takes no room on disk, and would take 2.4 GB in memory
    line = explained(tmp_path)
    assert f"count '100000000', expected a whole number of at most {MAX_POINTS}; thin the cloud out" in line


def test_a_face_that_fits_in_several_places_is_ambiguous(tmp_path: Path) -> None:
    found = clouds(CUBOID)
    for name, T, faces in (("start_object", T_START, [0, 1, 1]), ("end_object", T_GOAL, [0, 1, 0])):
        points, normals = found[name]
        own, facing = transform(inverse(T), points), rotate(inverse(T), normals)
        seen = (facing @ np.diag(faces)).max(axis=1) > 0.9
        if name == "end_object":
            seen &= np.abs(own[:, 2]) < 0.025  # of a face 11 cm high, 5 cm: it may be its upper or its lower end
        found[name] = points[seen], normals[seen]
    write(tmp_path / "a", found)
    line = explained(tmp_path, min_overlap=0.1)
    assert re.match(r"ambiguous: .* as well by \d other motions, up to \d+ mm away, expected one", line), line


def test_every_reason_is_made_by_a_test_and_documented() -> None:
    by_hand = {"ambiguous", "unreadable", "bad_labels", "empty_mask", "no_normals"}  # in the tests above
    assert {reason for reason, *_ in FAULTS.values()} | by_hand == scan_files.REASONS.keys()
    page = (Path(__file__).parents[1] / "docs/import_scans.md").read_text()
    for reason, words in scan_files.REASONS.items():
        assert f"| `{reason}` | {words} |" in page


def test_a_folder_without_scans_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="`dapdata init scans DIR` writes an example"):
        scan_files.find(str(tmp_path))
    with pytest.raises(FormatError, match="no such folder"):
        scan_files.find(str(tmp_path / "gone"))


def test_a_source_that_changed_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "a", clouds())
    config = config_of(tmp_path)
    write(tmp_path / "b", clouds())
    scan_files.find.cache_clear()
    with pytest.raises(FormatError, match="has changed since the import began"):
        scan_files.read(config, 0)


# From the command line -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `dapdata init scans` writes. Not to be changed."""
    out = tmp_path_factory.mktemp("example") / "scans"
    assert cli.run_app(["init", "scans", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def imported(example: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example with one demonstration more, without an end, imported and labelled. Not to be changed."""
    source = Path(shutil.copytree(example, tmp_path_factory.mktemp("source") / "scans"))
    shutil.copytree(source / "demo_000000", source / "demo_000003")
    (source / "demo_000003/end.ply").unlink()
    root = source.parent / "imported"
    assert cli.run_app(["import", "scans", str(source), "--out", str(root), "--engine", "inline", *SPLIT]) == 0
    pipeline.label(root, engine="inline")
    return root


def test_the_example_comes_in_as_it_is_near_the_truth(imported: Path) -> None:
    dataset = loading.open(imported)
    assert dataset.index["demo"].tolist() == [0, 1, 2]
    assert health.inspect(imported).to_dict()["rejects"]["demos"] == {"missing_cloud": 1}
    assert health.verify(imported).ok
    source = Path(dataset.recipe["scene"]["source"])
    for sample in dataset:
        truth = json.loads((source / f"demo_{int(sample['meta/demo']):06d}/{scans.TRUTH}").read_text())
        T_start, T_goal = (np.array(truth[f"T_world_object_{name}"]) for name in ("start", "goal"))
        T = sample["pose/T_world_object_goal"] @ inverse(sample["pose/T_world_object_start"]) @ T_start
        shift, turn = symmetric_distance(T, T_goal, truth["symmetry"], np.array(truth["axis"]))
        assert shift < 0.008
        assert turn < np.radians(20)
        assert (sample["container_superpoints/affordance"] > 0).any()


def test_rejected_demonstrations_and_the_agreement_are_told(imported: Path) -> None:
    source = Path(loading.open(imported).recipe["scene"]["source"])
    asked = imports.scans_recipe(source, None, SPLIT[1::2])
    (left_out,) = health.rejected(imported)
    assert (left_out["demo"], left_out["reason"]) == (3, "missing_cloud")
    assert left_out["detail"] == "demo_000003: no end.ply and no end_container.ply (or pcd, npz), expected one of them"
    (told,) = imports.agreement(asked, imported)
    assert re.fullmatch(
        r"against truth\.json, 3 demos: .* mm median, .* p90; .* deg median, .* 0 off by more than 10 mm or 20 deg", told
    )


def test_an_import_without_a_good_demonstration_leaves_nothing_and_says_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "scans" / "a", _swapped(clouds()))
    out = tmp_path / "out"
    assert cli.run_app(["import", "scans", str(tmp_path / "scans"), "--out", str(out), "--engine", "inline"]) == 2
    told = capsys.readouterr().err
    assert "all 1 demos were rejected (start_and_end_swapped 1)" in told
    assert "demo 0: a: the object is in the container in the start" in told
    assert not out.exists()


def test_placements_are_judged_by_what_was_shown_where_there_is_no_physics(imported: Path) -> None:
    dataset = loading.open(imported, "train")
    samples = list(dataset)
    aside = metrics.oracle(samples, 1)
    aside.T_world_object[0, 0, 3] += 0.03  # one of the scenes is missed by 3 cm
    report, results = metrics.judge_dataset(aside, dataset, "shown", split="train")
    assert [v.reason for result in results["file"] for v in result.verdicts] == ["far_from_shown"] + ["ok"] * (len(samples) - 1)
    assert report.judge.oracle.value == 1
    assert report.judge.engine == "none"
    assert report.geometry.collision_free.n == 0  # nobody knows the shapes
    with pytest.raises(UsageError, match="imported without shapes, there is nothing to simulate; use --protocol shown"):
        metrics.judge_dataset(aside, dataset, "strict", split="train")


def test_an_imported_recipe_asks_for_the_protocol_that_needs_no_physics(example: Path) -> None:
    assert imports.scans_recipe(example, None, ()).eval.protocol == "shown"
    with pytest.raises(RecipeError, match=r"scene\.min_explained"):
        imports.scans_recipe(example, None, ["scene.min_explained=90"])


def test_what_has_no_shapes_cannot_be_scanned(imported: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="has no shapes"):
        scans.export(imported, tmp_path / "out")


def test_init_needs_a_folder_for_scans_and_none_for_a_task(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run_app(["init", "scans"]) == 2
    assert cli.run_app(["init", "can_cabinet", "folder"]) == 2
    assert capsys.readouterr().err.count("\n") == 2


@pytest.mark.slow
def test_fruits_of_simulated_scans_are_placed_within_millimetres(tmp_path: Path) -> None:
    tree = imports.EXAMPLE | {"demos": 10, "seed": 1}
    dataset = pipeline.generate(imports.recipe.from_resolved(tree), tmp_path / "fruit", engine="inline")
    pipeline.label(dataset, engine="inline")
    source = scans.export(str(dataset), tmp_path / "scans")
    asked = imports.scans_recipe(source, None, ())
    first = imports.run(asked, tmp_path / "a", engine="inline")
    again = imports.run(asked, tmp_path / "b", workers=2, engine="local")
    (told,) = imports.agreement(asked, str(first))
    count, median, p90 = map(float, re.findall(r"(\d+) demos: (.*?) mm median, (.*?) p90;", told)[0])
    assert count >= 7
    assert median < 3
    assert p90 < 6
    digests = {health.inspect(str(made)).to_dict()["content_sha256"] for made in (first, again)}
    assert len(digests) == 1


def test_the_voxels_of_the_cameras_section_are_those_of_the_clouds(tmp_path: Path) -> None:
    write(tmp_path / "a", clouds())
    demo = SimpleNamespace(demo=np.array(0))  # all that is asked of it
    counts = []
    for voxel in (0.006, 0.012):
        cloud = scan_clouds.observe(config_of(tmp_path), CamerasConfig(container_voxel=voxel), demo)  # type: ignore[arg-type]
        counts.append(len(cloud.container_points))  # type: ignore[union-attr]
    assert counts[0] > 1.8 * counts[1]
