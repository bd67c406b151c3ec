"""What `verify` finds: any damage to any file, named; and nonsense in files that are as they were written."""

from __future__ import annotations

import json
import os
import re
import shutil
import tarfile
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import toy_stages
import zarr
from conftest import make_toy
from forging import alone, forge_arrays, forge_file, forge_index, forge_manifest, forge_root

import dapdata
from dapdata import cli, durable, health, manifest, pipeline, recipe, reproduce, sense, stages, store
from dapdata.errors import CorruptionError, FormatError, UsageError
from dapdata.records import columns, read_record, to_sample

TABLE = "toy_stages"
FORMATS = Path(__file__).with_name("formats")
OWN = (".lock", "log.jsonl")  # files that say nothing of the data


@pytest.fixture(scope="module")
def one_unit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of random arrays in one unit, no two files of which share their bytes, with a picture. Not to be changed."""
    root = make_toy(tmp_path_factory.mktemp("one_unit") / "toy", 4, 4)
    pipeline.attach(root, {"preview/goals.png": b"a picture"})
    return alone(root)


@pytest.fixture
def toy_in_memory(one_unit: Path, in_memory: Path) -> Path:
    """A copy of `one_unit`."""
    return Path(shutil.copytree(one_unit, in_memory / "toy"))


@pytest.fixture(scope="session")
def golden(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small dataset of true scenes as format 1 was first written. Not to be changed."""
    return unpacked(FORMATS / "1.tar.xz", tmp_path_factory.mktemp("golden"))


@pytest.fixture(scope="module")
def first_demo(golden: Path) -> dict[str, np.ndarray]:
    """The arrays of its first demo. Not to be changed."""
    return dapdata.open(golden)[0]


@pytest.fixture
def golden_sample(first_demo: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same, to be changed."""
    return {path: array.copy() for path, array in first_demo.items()}


@pytest.fixture
def golden_copy(golden: Path, in_memory: Path) -> Path:
    return alone(Path(shutil.copytree(golden, in_memory / "golden")))


def unpacked(archive: Path, folder: Path) -> Path:
    with tarfile.open(archive) as file:
        file.extractall(folder, filter="data")
    (root,) = folder.iterdir()
    return root


# Damage ------------------------------------------------------------------------------------------------------


def kind_of(path: Path, root: Path) -> str:
    """What sort of file it is."""
    name = path.relative_to(root).as_posix()
    if "/c/" in name:
        return "chunk"
    if path.name == "zarr.json":
        return f"{name.split('/')[0]}: zarr.json at depth {name.count('/')}"
    return name


def sure_to_name(path: Path, root: Path) -> list[str]:
    """What a report must say of a damaged file: the unit and the array, or the file."""
    parts = path.relative_to(root).parts
    return ["/".join(parts[:3]), parts[3]] if parts[0] in ("shards", "stages") else [parts[-1]]


def flips(root: Path, count: int, seed: int) -> Counter[str]:
    """Flips a bit of a file and back again, so many times; how often each kind of file was hit. Each must be reported."""
    rng, hits = np.random.default_rng(seed), Counter[str]()
    kinds: dict[str, list[Path]] = {}
    for path in sorted(root.rglob("*")):
        if path.is_file() and path.name not in OWN:
            kinds.setdefault(kind_of(path, root), []).append(path)
    for number in range(count):
        kind = sorted(kinds)[number % len(kinds)]
        path = kinds[kind][int(rng.integers(len(kinds[kind])))]
        good = path.read_bytes()
        at, bit = int(rng.integers(len(good))), int(rng.integers(8))
        path.write_bytes(good[:at] + bytes([good[at] ^ 1 << bit]) + good[at + 1 :])
        report = health.verify(root, quick=True)
        named = sure_to_name(path, root)
        assert any(all(part in problem for part in named) for problem in report.problems), (path, at, bit, report)
        path.write_bytes(good)
        hits[kind] += 1
    assert health.verify(root).ok
    return hits


def test_any_flipped_bit_of_any_kind_of_file_is_found_and_named(toy_in_memory: Path) -> None:
    hits = flips(toy_in_memory, 40, seed=0)
    assert {"manifest.json", "index.parquet", "README.md", "croissant.json", "preview/goals.png", "chunk"} < {*hits}
    assert len(hits) == 12


@pytest.mark.slow
def test_a_thousand_flipped_bits_are_found_and_named(toy_in_memory: Path) -> None:
    assert flips(toy_in_memory, 1000, seed=1).total() == 1000


OPERATIONS = ("delete", "truncate", "empty", "swap", "add", "link", "pipe")


def operate(operation: str, path: Path, other: Path) -> Callable[[], None]:
    """Does something to a file; what undoes it."""
    good, others = path.read_bytes(), other.read_bytes()
    if operation in ("delete", "link", "pipe"):
        path.unlink()
    if operation == "link":
        path.symlink_to(other)
    if operation == "pipe":
        os.mkfifo(path)
    if operation == "truncate":
        path.write_bytes(good[:-1])
    if operation == "empty":
        path.write_bytes(b"")
    if operation == "swap":
        path.write_bytes(others)
        other.write_bytes(good)
    if operation == "add":
        path.with_name("9").write_bytes(good)

    def undo() -> None:
        path.unlink(missing_ok=True)
        path.write_bytes(good)
        other.write_bytes(others)
        path.with_name("9").unlink(missing_ok=True)

    return undo


def operations_on(root: Path, paths: list[str], operations: tuple[str, ...]) -> int:
    """How many operations on the rows of a shard's arrays were found and named, by both depths and by its exit code."""
    shard, done = root / manifest.read(root).shards[0].path, 0
    for number, path in enumerate(paths):
        for operation in operations:
            chunk, other = (
                next(p for p in (shard / name / "c").rglob("*") if p.is_file()) for name in (path, other_than(path))
            )
            if operation == "swap" and chunk.read_bytes() == other.read_bytes():
                continue
            undo = operate(operation, chunk, other)
            report = health.verify(root, quick=True)
            assert any(f"{shard.name}: {path}/c/" in problem for problem in report.problems), (path, operation, report)
            if number < 2:
                assert any(path in problem for problem in health.verify(root).problems)
                assert cli.run_app(["verify", str(root)]) == 3
            undo()
            done += 1
    assert health.verify(root).ok
    return done


def other_than(path: str) -> str:
    return "container/normals" if path == "container/points" else "container/points"


@pytest.mark.parametrize("operation", OPERATIONS)
def test_every_file_operation_on_an_array_is_found_and_named(toy_in_memory: Path, operation: str) -> None:
    assert operations_on(toy_in_memory, ["container/points"], (operation,)) == 1


@pytest.mark.slow
def test_every_file_operation_on_every_array_is_found_and_named(in_memory: Path) -> None:
    root = alone(make_toy(in_memory / "toy", 2, 2))
    shard = root / manifest.read(root).shards[0].path
    full = [path for path in store.stored_paths(store.read_record(shard)) if any((shard / path / "c").rglob("*"))]
    assert operations_on(root, full, OPERATIONS) > 100


def test_the_report_raises_with_exit_code_3_and_every_problem(toy_in_memory: Path) -> None:
    (toy_in_memory / "notes.txt").write_text("x")
    (toy_in_memory / "index.parquet").write_bytes(b"")
    (toy_in_memory / "README.md").unlink()
    shutil.rmtree(toy_in_memory / manifest.read(toy_in_memory).shards[0].path)
    names = ("notes.txt", "index.parquet", "README.md", manifest.read(toy_in_memory).shards[0].path)
    problems = "\n".join(health.verify(toy_in_memory).problems)
    assert all(name in problems for name in names)
    with pytest.raises(CorruptionError, match=r"README.md") as caught:
        health.verify(toy_in_memory).raise_if_damaged()
    assert caught.value.exit_code == 3


def test_plain_zarr_refuses_a_flipped_byte_in_any_chunk(toy_in_memory: Path) -> None:
    refused_by_zarr(toy_in_memory, 20, seed=0)


@pytest.mark.slow
def test_plain_zarr_refuses_two_hundred_flipped_bytes(toy_in_memory: Path) -> None:
    refused_by_zarr(toy_in_memory, 200, seed=1)


def refused_by_zarr(root: Path, count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    chunks = [path for path in sorted(root.rglob("*")) if path.is_file() and kind_of(path, root) == "chunk"]
    for path in rng.choice(np.array(chunks, dtype=object), count):
        unit = root.joinpath(*path.relative_to(root).parts[:3])
        array = "/".join(path.relative_to(unit).parts[:2])
        good = path.read_bytes()
        at = int(rng.integers(len(good)))
        path.write_bytes(good[:at] + bytes([good[at] ^ 1 << int(rng.integers(8))]) + good[at + 1 :])
        with pytest.raises(Exception, match=r"."):
            zarr.open_group(unit, mode="r")[array][...]
        with pytest.raises(CorruptionError, match=array):
            store.read_block(unit)
        path.write_bytes(good)
    assert health.verify(root).ok


# Nonsense with the right hashes ------------------------------------------------------------------------------

Arrays = dict[str, np.ndarray]


def scaled(path: str, factor: float) -> Callable[[Arrays], object]:
    """Metres taken for millimetres, or the other way round."""

    def change(sample: Arrays) -> None:
        if sample[path].shape[-2:] == (4, 4):
            sample[path][..., :3, 3] *= factor
        else:
            sample[path] = sample[path] * np.asarray(factor, sample[path].dtype)

    return change


def to_goal(sample: Arrays) -> None:
    """The object cloud where it will be placed, not where it was seen."""
    T = sample["pose/T_world_object_goal"] @ np.linalg.inv(sample["pose/T_world_object_start"])
    sample["object/points"] = (sample["object/points"] @ T[:3, :3].T + T[:3, 3]).astype(np.float32)


def negated(path: str) -> Callable[[Arrays], object]:
    return lambda sample: sample.update({path: -sample[path]})


def rolled(path: str) -> Callable[[Arrays], object]:
    return lambda sample: sample.update({path: np.roll(sample[path], 1, axis=0)})


def mirrored(path: str) -> Callable[[Arrays], object]:
    return lambda sample: sample[path][..., :3, 0].__imul__(-1)


NONSENSE: dict[str, tuple[Callable[[Arrays], object], str]] = {
    "container in mm": (scaled("container/points", 1000), r"container/points: .* m from the container"),
    "container in km": (scaled("container/points", 0.001), r"container/points: "),
    "object in mm": (scaled("object/points", 1000), r"object/points: .* m from the object"),
    "superpoints in mm": (scaled("container_superpoints/points", 1000), r"container_superpoints/points: .* from the mean"),
    "container pose in mm": (scaled("pose/T_world_container", 1000), r"container/points: "),
    "start pose in mm": (scaled("pose/T_world_object_start", 1000), r"object/points: .* at pose/T_world_object_start"),
    "goals in mm": (scaled("goals/T_world_object", 1000), r"goals/T_world_object: up to .* are they in m"),
    "everything in mm": (scaled("scene/size", 1000), r"scene/size and T_container_part: .* m across"),
    "the demonstrated goal is another": (scaled("pose/T_world_object_goal", 1.01), "not among the 4 goals"),
    "the object is seen at its goal": (to_goal, r"object/points: .* at pose/T_world_object_start"),
    "normals point away": (negated("container/normals"), r"container/normals: 0% face their camera"),
    "normals of other points": (rolled("object/normals"), r"object/normals: \d+% face their camera"),
    "superpoints of other points": (rolled("container/superpoint"), r"container_superpoints/"),
    "sizes of other superpoints": (rolled("container_superpoints/size"), r"container_superpoints/size: not the number"),
    "a camera that is not there": (lambda s: s["container/view"].fill(9), "container/view: camera 9"),
    "a pose that is sheared": (lambda s: s["pose/T_world_container"].__setitem__((0, 1), 0.5), "not rigid"),
    "a mirrored goal": (mirrored("goals/T_world_object"), "not rigid"),
    "a number that is none": (lambda s: s["container/points"].__setitem__((0, 0), np.nan), "not finite"),
    "normals of other length": (scaled("object/normals", 1.1), "object/normals: not unit"),
    "a superpoint that is not there": (lambda s: s["object/superpoint"].__setitem__(0, 500), "expected rows of object_"),
}  # fmt: skip


@pytest.mark.parametrize("name", NONSENSE)
def test_nonsense_in_a_demo_is_found_and_named(name: str, golden_sample: Arrays) -> None:
    change, words = NONSENSE[name]
    change(golden_sample)
    assert recalled([*store.problems(golden_sample), *sense.nonsense(golden_sample)], words)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if name not in ("container in mm", "a mirrored goal") else [])
        for name in NONSENSE
    ],
)
def test_nonsense_in_a_shard_is_found_though_every_hash_is_right(name: str, golden_copy: Path) -> None:
    change, words = NONSENSE[name]
    shard = manifest.read(golden_copy).shards[0].path
    forge_arrays(golden_copy, shard, change)
    problems = health.verify(golden_copy).problems
    assert all(problem.startswith(shard) for problem in problems)
    assert recalled(problems, words)
    assert cli.run_app(["verify", str(golden_copy)]) == 3


def test_a_stranger_can_check_the_manifest_as_the_page_says(golden: Path) -> None:
    page = (Path(__file__).parents[1] / "docs/reliability.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    path, data = golden.parent / "manifest.json", (golden / manifest.MANIFEST).read_bytes()
    code = code.replace("data/quickstart/manifest.json", str(path))
    path.write_bytes(data)
    exec(code, {})
    path.write_bytes(data + b" ")
    with pytest.raises(AssertionError):
        exec(code, {})


def test_what_no_check_of_sense_could_take_is_found_before_these(golden_copy: Path) -> None:
    shard = manifest.read(golden_copy).shards[0].path
    forge_arrays(golden_copy, shard, lambda sample: sample["object/superpoint"].fill(-1))
    assert recalled(health.verify(golden_copy).problems, "object/superpoint: -1 to -1, expected rows of object_superpoints")


def recalled(problems: Sequence[str], words: str) -> bool:
    """Whether one of the problems says this, a regular expression."""
    return any(re.search(words, problem) for problem in problems)


def relabel(root: Path, path: str, **changes: Any) -> None:
    """Other attributes of one array of a shard."""
    shard = manifest.read(root).shards[0].path
    tree = json.loads((root / shard / path / "zarr.json").read_text())
    tree["attributes"] |= changes
    forge_file(root, shard, f"{path}/zarr.json", json.dumps(tree).encode())


def other_upstream(root: Path) -> None:
    """The unit of a stage holds another demo than the shard that was made of it."""
    forge_arrays(root, manifest.read(root).stages["observe"].units[0].path, negated("container/normals"))


def swapped_units(root: Path) -> None:
    """Two units of a stage, each under the other's key."""
    a, b = (root / unit.path for unit in manifest.read(root).stages["observe"].units)
    a.rename(root / "c")
    b.rename(a)
    (root / "c").rename(b)

    def name_them(tree: dict[str, Any]) -> None:
        for unit in tree["stages"]["observe"]["units"]:
            unit["sha256"] = durable.hash_file(root / unit["path"] / "zarr.json")

    forge_manifest(root, name_them)


def same_object(root: Path) -> None:
    """The objects of two splits are one, which is called by two names."""
    index = manifest.read_index(root)
    other = next(i for i, name in enumerate(index["split"]) if name != index["split"][0])
    parts = {path: array for path, array in dapdata.open(root)[other].items() if path.startswith("object_parts/")}
    forge_arrays(root, str(index["shard"][0]), lambda sample: sample.update(parts))


DEEP: dict[str, tuple[Callable[[Path], object], str]] = {
    "an array in mm, as it says": (lambda r: relabel(r, "object/points", unit="mm"), "object/points: unit 'mm', expected 'm'"),
    "codes of other names": (lambda r: relabel(r, "goals/kind", names=["stack", "floor"]), "goals/kind: names"),
    "an array in another frame": (lambda r: relabel(r, "object/points", frame="camera"), "frame 'camera', expected 'world'"),
    "a shard that is not of its unit": (other_upstream, "what stage observe made is not what its own unit holds"),
    "a seed that did not make the keys": (
        lambda r: forge_manifest(r, lambda t: t["recipe"].update(seed=7)),
        "its key or its place",
    ),
    "a spec that did not make the keys": (
        lambda r: forge_manifest(r, lambda t: t["stages"]["label"]["spec"]["sections"]["label"].update(eps_place=0.02)),
        "its key or its place is not what stage label",
    ),
    "a recipe that is not the spec's": (
        lambda r: forge_manifest(r, lambda t: t["recipe"]["noise"].update(preset="none")),
        "stages.observe.spec: noise is not that of the recipe",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DEEP)
def test_what_only_all_of_a_dataset_can_tell_is_found_by_a_deep_look(name: str, toy_in_memory: Path) -> None:
    change, words = DEEP[name]
    change(toy_in_memory)
    assert health.verify(toy_in_memory, quick=True).ok
    assert recalled(health.verify(toy_in_memory, deep=True).problems, words)


CLAIMS: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "content": (lambda t: t.update(content_sha256="0" * 64), "content_sha256"),
    "name": (lambda t: t.update(name="other"), "name other"),
    "task": (lambda t: t.update(task="book_shelf"), "task book_shelf"),
    "demos": (lambda t: t.update(demos=9), "demos 9"),
    "rejects": (lambda t: t["rejects"]["goals"].update(tilted=77), r"rejects\.goals"),
    "splits": (lambda t: t["splits"]["train"]["container_instances"].pop(), r"splits\.train"),
    "range": (lambda t: t["stages"]["observe"]["units"][0].update(demo_range=[0, 2]), "units of stage observe"),
    "key": (lambda t: t["stages"]["observe"]["units"][0].update(key="0" * 64), "zarr.json: key"),
    "fewer units": (lambda t: t["stages"]["cluster"]["units"].pop(), "units of stage cluster"),
    "shards": (lambda t: t["shards"].pop(), "shards are not the units of a stage"),
}


@pytest.mark.parametrize("name", CLAIMS)
def test_a_manifest_that_claims_what_is_not_so_is_found(name: str, golden_copy: Path) -> None:
    change, words = CLAIMS[name]
    forge_manifest(golden_copy, change)
    assert recalled(health.verify(golden_copy, quick=True).problems, words)


def test_a_word_of_the_manifest_that_nothing_else_tells_is_held_to_its_digest(golden_copy: Path) -> None:
    path = golden_copy / manifest.MANIFEST
    tree = json.loads(path.read_text())
    path.write_text(path.read_text().replace(f'"dapdata": "{tree["created_by"]["dapdata"]}"', '"dapdata": "9.9"'))
    (problem,) = health.verify(golden_copy, quick=True).problems
    assert "manifest.json: its bytes are not those that were written" in problem


def test_units_under_each_others_keys_are_found(golden_copy: Path) -> None:
    swapped_units(golden_copy)
    assert recalled(health.verify(golden_copy, quick=True).problems, "zarr.json: key .* expected .* as in the manifest")


def test_a_split_that_leaks_an_instance_is_found(golden_copy: Path) -> None:
    def leak(rows: list[dict[str, Any]]) -> None:
        rows[1]["split"], rows[0]["split"] = "test", "train"
        rows[1]["container_instance"] = rows[0]["container_instance"]

    forge_index(golden_copy, leak)
    assert recalled(health.verify(golden_copy).problems, r"container_instance \d+ is in test and train: 1 leak")


def test_a_split_that_leaks_a_geometry_under_another_name_is_found(golden_copy: Path) -> None:
    same_object(golden_copy)
    (problem,) = health.verify(golden_copy).problems
    assert recalled([problem], r"index.parquet: object geometry [0-9]+ is in \w+ and \w+: 1 leak")


def test_what_the_index_says_of_a_demo_is_what_its_shard_says(golden_copy: Path) -> None:
    forge_index(golden_copy, lambda rows: rows[0].update(goals=99))
    assert recalled(health.verify(golden_copy).problems, "column goals is not what the shards say")


@pytest.mark.parametrize("change", [lambda rows: rows.pop(), lambda rows: rows.append(rows[-1])])
def test_an_index_of_fewer_or_more_demos_than_the_shards_have_is_found(
    golden_copy: Path, change: Callable[[list[dict[str, Any]]], object]
) -> None:
    forge_index(golden_copy, change)
    assert "index.parquet: its rows are not the demos of the shards" in health.verify(golden_copy).problems


def test_an_index_that_names_a_shard_elsewhere_is_not_followed(golden_copy: Path, in_memory: Path) -> None:
    forge_index(golden_copy, lambda rows: rows[0].update(shard="../elsewhere"))
    shutil.copytree(golden_copy / manifest.read(golden_copy).shards[0].path, in_memory / "elsewhere")
    with pytest.raises(CorruptionError, match=r"index\.parquet names '\.\./elsewhere', expected a shard"):
        dapdata.open(golden_copy)[0]
    forge_index(golden_copy, lambda rows: rows[1].update(row=3))
    with pytest.raises(CorruptionError, match="demo 3 of a shard, expected 0 to 2"):
        dapdata.open(golden_copy)[1]


def test_a_copy_of_the_shards_alone_is_whole_and_what_was_not_checked_is_said(golden_copy: Path) -> None:
    shutil.rmtree(golden_copy / "stages")
    for depth in ({"quick": True}, {}, {"deep": True}):
        report = health.verify(golden_copy, **depth)
        assert report.ok, report
        assert recalled(report.notes, "stages/ is not here: its 6 units, rejects and whether .* were not checked")
    forge_arrays(golden_copy, manifest.read(golden_copy).shards[0].path, scaled("container/points", 1000))
    assert recalled(health.verify(golden_copy).problems, r"container/points: .* m from the container")


@pytest.mark.slow
def test_true_scenes_are_no_nonsense(tiny: Path) -> None:
    report = health.verify(tiny, deep=True)
    assert report.ok, report
    assert report.demos == len(dapdata.open(tiny))


def test_offsets_that_do_not_share_out_the_rows_are_found(golden_copy: Path) -> None:
    shard = golden_copy / manifest.read(golden_copy).shards[0].path
    group = zarr.open_group(shard, mode="r+")
    good = group["container/offsets"][:]
    for wrong in (good + 1, good[::-1].copy(), np.where(good == good[-1], good[-1] - 1, good), np.zeros_like(good)):
        group["container/offsets"][...] = wrong
        with pytest.raises(CorruptionError, match="container/"):
            store.read_block(shard)


# Made anew ---------------------------------------------------------------------------------------------------


@pytest.fixture
def scratch_in_memory(in_memory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(in_memory))


@pytest.mark.usefixtures("scratch_in_memory")
def test_units_made_anew_are_the_same(one_unit: Path) -> None:
    assert reproduce.reproduce(one_unit, 99, engine="inline", table=TABLE) == (1, [])
    with pytest.raises(UsageError, match="expected at least 1"):
        reproduce.reproduce(one_unit, 0, engine="inline", table=TABLE)


@pytest.mark.usefixtures("scratch_in_memory")
def test_data_that_the_recipe_does_not_give_are_named_with_what_differs_here(
    toy_in_memory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (unit,) = manifest.read(toy_in_memory).stages["observe"].units
    forge_arrays(toy_in_memory, unit.path, lambda s: s["container/points"].__iadd__(0.001))
    units, problems = reproduce.reproduce(toy_in_memory, 1, engine="inline", table=TABLE)
    assert units == 1
    assert problems[0].startswith(f"{unit.path}: made anew, 1 of {unit.demos} demos are others (")
    reason = "all versions are those that it was made with: another kind of CPU, or other data under the recipe's name"
    assert problems[1:] == [reason]
    newer = (toy_stages.STAGES[0], replace(toy_stages.STAGES[1], version=2), *toy_stages.STAGES[2:])
    monkeypatch.setattr(toy_stages, "STAGES", newer)
    monkeypatch.setattr(stages, "version", lambda package: "9.9")
    _, problems = reproduce.reproduce(toy_in_memory, 1, engine="inline", table=TABLE)
    assert f"made with numpy {np.__version__}, here 9.9, stage observe 1, here 2: install those versions" in problems[-1]


@pytest.mark.slow
def test_true_units_are_made_anew_by_the_command(tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run_app(["verify", str(tiny), "--deep", "--reproduce", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["ok"], found["reproduced"], found["demos"]) == (True, 2, 5)
    assert cli.run_app(["verify", str(tiny), "--deep", "--quick"]) == 2


# Formats -----------------------------------------------------------------------------------------------------

RELEASED = {  # what the datasets of released formats were made from
    "seed": 6, "demos": 5, "shard_size": 3, "scene": {"task": "can_cabinet"},
    "cameras": {
        "width": 96, "height": 72, "container_views": 2, "object_views": 2, "container_voxel": 0.02, "object_voxel": 0.015,
        "min_container_points": 100, "min_object_points": 10,
    },
    "superpoints": {"count": 40, "object_count": 8}, "split": {"val": 0.2, "test": 0.2},
}  # fmt: skip


def write_released() -> None:
    """Makes the dataset of each version, before its release: a manifest is of the second if it would be too large."""
    for version, large in ((manifest.FORMAT, manifest.LARGE), (manifest.LARGE_FORMAT, 0)):
        root = FORMATS / f"format-{version}"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(manifest, "LARGE", large)
            pipeline.generate(recipe.from_resolved({"name": root.name, **RELEASED}), root, engine="inline")
            pipeline.label(root, engine="inline")
        for name in OWN:
            (root / name).unlink()
        with tarfile.open(FORMATS / f"{version}.tar.xz", "w:xz", preset=9) as file:
            file.add(root, root.name, filter=lambda info: info.replace(mtime=0, uid=0, gid=0, uname="", gname="", deep=False))
        shutil.rmtree(root)


def released() -> list[str]:
    """The format versions that there is a dataset of; DAPDATA_GOLDEN=write makes those of this version."""
    if os.environ.get("DAPDATA_GOLDEN") == "write":
        write_released()
    return sorted(path.name.split(".")[0] for path in FORMATS.glob("*.tar.xz"))


@pytest.mark.parametrize("version", released())
def test_a_dataset_of_every_released_format_opens_verifies_and_loads(version: str, tmp_path: Path) -> None:
    archive = FORMATS / f"{version}.tar.xz"
    assert archive.stat().st_size < 200_000
    root = unpacked(archive, tmp_path)
    assert f'"format": {version},' in (root / manifest.MANIFEST).read_text()
    report = health.verify(root, deep=True)
    assert report.ok, report
    data = dapdata.open(root)
    assert len(data) == report.demos == RELEASED["demos"]
    assert {len(dapdata.open(root, split)) for split in ("train", "val", "test")} == {3, 1}
    for sample in data:
        assert sample.keys() == EVERYWHERE


def test_the_current_formats_have_their_datasets() -> None:
    assert {str(manifest.FORMAT), str(manifest.LARGE_FORMAT)} <= {*released()}


@pytest.mark.parametrize(
    ("version", "remedy"), [(3, "update dapdata"), (99, "update dapdata"), (0, "generate it again, or read it")]
)
def test_a_dataset_of_an_unknown_format_is_refused_with_who_made_it_and_what_to_do(
    golden_copy: Path, version: int, remedy: str, capsys: pytest.CaptureFixture[str]
) -> None:
    forge_manifest(
        golden_copy, lambda tree: tree.update(format=version, created_by={"dapdata": "9.9"}, shape_of_things="other")
    )
    with pytest.raises(
        FormatError, match=f"format {version}, made by dapdata 9.9; this dapdata reads formats 1 or 2: {remedy}"
    ):
        dapdata.open(golden_copy)
    for command in ("verify", "inspect", "status", "label"):
        assert cli.run_app([command, str(golden_copy)]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_a_unit_of_an_unknown_format_is_refused(golden_copy: Path) -> None:
    shard = manifest.read(golden_copy).shards[0].path
    forge_root(golden_copy, shard, lambda tree: tree["attributes"]["dapdata"].update(format=2))
    with pytest.raises(CorruptionError, match="format 2, expected 1"):
        dapdata.open(golden_copy)[0]
    assert recalled(health.verify(golden_copy).problems, "format 2, expected 1")


# Nothing wrong is recorded -----------------------------------------------------------------------------------


def poisons(path: str, array: np.ndarray, rng: np.random.Generator) -> tuple[str, np.ndarray]:
    """A value that must not be recorded, put somewhere into an array, and its name."""
    about = store.COLUMNS[path].metadata
    names = ["nan", "inf"] if array.dtype.kind == "f" else []
    names += ["sheared", "mirrored"] if about["dims"][-2:] == (4, 4) else []
    names += ["too long"] if path.split("/")[1] in (*store.DIRECTIONS, "axis") else []
    names += ["no code"] if about["names"] else []
    names += ["out of range", "negative"] if path in store.INDEX_INTO else []
    names += ["too much"] if path.endswith("/affordance") else []
    names += ["below"] if path in store.POSITIVE else []
    name, bad = str(rng.choice(names)), array.astype(float)
    place = tuple(int(rng.integers(n)) for n in bad.shape)
    row = place[: bad.ndim - 2] if bad.shape[-2:] == (4, 4) else place[: bad.ndim - 1]
    if name in ("nan", "inf", "no code", "out of range", "negative", "below", "too much"):
        values = {
            "nan": np.nan,
            "inf": np.inf,
            "no code": 200,
            "out of range": 10**6,
            "negative": -1,
            "below": -1,
            "too much": 1.5,
        }
        bad[place] = values[name]
    elif name == "too long":
        bad[row] *= 1.1
    elif name == "sheared":
        bad[(*row, 0, 1)] += 0.01
    elif name == "mirrored":
        bad[(*row, slice(3), 0)] *= -1
    return name, bad


POISONED = [c.metadata["path"] for c in columns() if c.metadata["dtype"][1] == "f" or c.metadata["names"]]
EVERYWHERE = {c.metadata["path"] for c in columns()}  # meshes are not: see test_meshes.py
POISONED += [path for path in (*store.INDEX_INTO, *store.POSITIVE) if path in EVERYWHERE and path not in POISONED]


def test_a_poisoned_value_is_refused_before_it_is_recorded(toy: Path) -> None:
    samples, rng, done = list(dapdata.open(toy)), np.random.default_rng(0), Counter[str]()
    while done.total() < 200:
        sample = samples[done.total() % len(samples)]
        path = POISONED[done.total() % len(POISONED)]
        if sample[path].size == 0:
            samples = samples[1:] + samples[:1]
            continue
        name, bad = poisons(path, sample[path], rng)
        with np.errstate(invalid="ignore"):
            found = list(
                store.problems({**sample, path: bad.astype(sample[path].dtype) if name != "no code" else bad.astype("u1")})
            )
        assert any(path in problem or "symmetry/axis" in problem for problem in found), (path, name)
        done[name] += 1
    assert {*done} == {
        "nan",
        "inf",
        "sheared",
        "mirrored",
        "too long",
        "no code",
        "out of range",
        "negative",
        "too much",
        "below",
    }


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_stage_that_makes_such_a_value_commits_nothing(
    value: float, in_memory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    observe = toy_stages.STAGES[1]

    def poisoned(*arguments: Any) -> Any:
        cloud = observe.run(*arguments)
        if isinstance(cloud, toy_stages.Cloud):
            cloud.container_points[3, 1] = value
        return cloud

    monkeypatch.setattr(toy_stages, "STAGES", (toy_stages.STAGES[0], replace(observe, run=poisoned), *toy_stages.STAGES[2:]))
    with pytest.raises(ValueError, match=r"stage observe, demo \d+: container/points: 1 values are not finite"):
        make_toy(in_memory / "toy")
    assert not list(in_memory.glob("toy/stages/observe/*"))
    assert not (in_memory / "toy/manifest.json").exists()


@pytest.mark.parametrize(
    ("field", "value"), [("part_kind", 256), ("part_kind", -1), ("container_view", 2.5), ("goal_kind", np.nan)]
)
def test_a_number_that_an_array_of_integers_cannot_hold_is_refused(toy: Path, field: str, value: float) -> None:
    sample = dapdata.open(toy)[0]
    kind = next(record for record in (toy_stages.Demo, toy_stages.Cloud) if field in record.__dataclass_fields__)
    record = read_record(kind, sample)
    with pytest.raises(ValueError, match="cannot hold"):
        to_sample(replace(record, **{field: np.full(len(getattr(record, field)), value)}))


def test_no_check_of_sense_is_silent_because_an_array_is_absent(first_demo: Arrays) -> None:
    assert list(sense.nonsense(first_demo)) == []
    for check in (sense._goals, sense._clouds, sense._normals, sense._superpoints):
        assert list(check(first_demo)) == []
