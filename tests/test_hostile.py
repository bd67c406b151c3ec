"""What comes from anywhere may be anything: it is read, or refused in a line, with little memory; nothing else is touched."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
from collections import Counter
from pathlib import Path
from typing import Any

import hostile
import numpy as np
import pytest
from conftest import make_toy
from forging import alone
from hostile import CLOUDS, DATASETS, PREDICTIONS, RECIPES

from dapdata import durable, health, pipeline, recipe
from dapdata.errors import FormatError

HERE = Path(__file__).parent
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One of each kind as it should be: by kind."""
    folder = tmp_path_factory.mktemp("good")
    (folder / "a.ply").write_bytes(hostile.good_ply())
    (folder / "a.pcd").write_bytes(hostile.good_pcd())
    (folder / "a.npy").write_bytes(hostile.npy(hostile.ROWS))
    (folder / "a.npz").write_bytes(hostile.good_cloud_npz())
    (folder / "b.npz").write_bytes(hostile.npz(compressed=True, points=hostile.ROWS[:, :3], normals=hostile.ROWS[:, 3:]))
    (folder / "p.npz").write_bytes(hostile.npz(**hostile.placements()))
    (folder / "r.yaml").write_text(recipe.starter("can_cabinet"))
    found = {name: folder / name for name in ("a.ply", "a.pcd", "a.npy", "a.npz", "b.npz", "p.npz", "r.yaml")}
    return found | {"dataset": alone(make_toy(folder / "toy", 2, 2))} | trained(folder)


def trained(folder: Path) -> dict[str, Path]:
    """A run, if PyTorch is installed."""
    if "torch" not in sys.modules:
        pytest.importorskip("torch")
    from training_samples import TINY

    from daptrain import loop

    with tarfile.open(HERE / "formats/1.tar.xz") as file:
        file.extractall(folder, filter="data")
    return {"run": loop.train(folder / "format-1", folder / "run", steps=1, device="cpu", config=TINY)}


KINDS = {"a.ply": "cloud", "a.pcd": "cloud", "a.npy": "cloud", "a.npz": "cloud", "b.npz": "cloud", "p.npz": "predictions",
         "r.yaml": "recipe", "dataset": "dataset", "run": "run"}  # fmt: skip


def read_apart(things: list[tuple[str, Path]], good: dict[str, Path], outside: Path) -> dict[str, Any]:
    """What became of a process that read these things."""
    outside.mkdir(exist_ok=True)
    asked = {
        "warm": [[KINDS[name], str(path)] for name, path in good.items()],
        "read": [[kind, str(path)] for kind, path in things],
        "outside": str(outside),
    }
    command = [sys.executable, "-W", "ignore", str(HERE / "hostile.py")]
    done = subprocess.run(
        command, input=json.dumps(asked), capture_output=True, text=True, env=ENVIRONMENT, cwd=outside, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    for (_, path), peak in zip(things, found["peak_mb"]):
        assert peak < 1000, path
    assert not any("sprung" in name for name in os.listdir(outside))
    return found


def cases(folder: Path, good: dict[str, Path], step: int) -> dict[str, tuple[str, Path, int, str]]:
    """Fixed cases, each `step`-th of a kind, made in a folder: kind, where, exit code, and what must be said."""
    made: dict[str, tuple[str, Path, int, str]] = {}
    for name, (change, words) in list(DATASETS.items())[::step]:
        root = folder / "datasets" / str(len(made)) / "toy"
        shutil.copytree(good["dataset"], root)
        change(root)
        made[f"dataset: {name}"] = ("dataset", root, 3, words)
    for name, (file, data, words) in list(CLOUDS.items())[::step]:
        made[f"cloud: {name}"] = ("cloud", put(folder / str(len(made)) / file, data), 2, words)
    for name, (data, words) in list(RECIPES.items())[::step]:
        made[f"recipe: {name}"] = ("recipe", put(folder / str(len(made)) / "r.yaml", data), 2, words)
    for name, (make, words) in list(PREDICTIONS.items())[::step]:
        made[f"predictions: {name}"] = ("predictions", put(folder / str(len(made)) / "p.npz", make()), 2, words)  # type: ignore[call-arg]
    for name, (change, words) in list(RUNS.items())[::step]:
        run = Path(shutil.copytree(good["run"], folder / str(len(made))))
        change(run)
        made[f"run: {name}"] = ("run", run, 2, words)
    return made


def put(path: Path, data: Any) -> Path:
    path.parent.mkdir(parents=True)
    if callable(data):
        data(path)
    else:
        path.write_bytes(data)
    return path


def weights_header(shape: list[int], dtype: str = "F32", end: int = 4) -> bytes:
    about = {"dapdata": json.dumps({"network": "pose", "version": 1, "task": "can_cabinet", "method": "dap"})}
    return hostile.safetensors(
        {"__metadata__": about, "w": {"dtype": dtype, "shape": shape, "data_offsets": [0, end]}}, b"\0" * 4
    )


def config(**changes: Any) -> Any:
    def change(run: Path) -> None:
        path = run / "config.json"
        tree = json.loads(path.read_text())
        for name, value in changes.items():
            section, _, key = name.rpartition("__")
            (tree[section] if section else tree)[key] = value
        path.write_text(json.dumps(tree))

    return change


def state_without(run: Path) -> None:
    from safetensors.torch import load_file

    from daptrain import checkpoint

    path = run / "pose.state.safetensors"
    path.write_bytes(checkpoint.packed(load_file(path), {"network": "pose", "version": 1, "progress": {"step": "many"}}))


RUNS: dict[str, tuple[Any, str]] = {
    "a pickle for weights": (hostile.text_of("pose.safetensors", b"\x80\x04\x95cos\nsystem\n."), "expected safetensors"),
    "a header of 2^63 bytes": (hostile.text_of("pose.safetensors", hostile.safetensors({}, length=2**63)), "safetensors"),
    "10^12 weights": (hostile.text_of("pose.safetensors", weights_header([10**12], end=4 * 10**12)), "expected safetensors"),
    "weights that overlap the end": (hostile.text_of("pose.safetensors", weights_header([99], end=396)), "safetensors"),
    "weights of another network": (hostile.text_of("pose.safetensors", weights_header([1])), "this network's config expects"),
    "weights of another type": (hostile.text_of("pose.safetensors", weights_header([1], "F8_E4M3", 1)), "expected"),
    "a network of any width": (config(train__width=2048, train__layers=64), "this network's config expects"),
    "a config of brackets": (hostile.text_of("config.json", hostile.deep(100_000)), "nested too deeply"),
    "a config without a method": (config(method="pickle"), "method: got 'pickle'"),
    "a config without a recipe": (config(recipe=3), "recipe: got int"),
    "a config of other superpoints": (config(recipe__superpoints={"count": -1}), "config.json"),
    "a pipe for a config": (lambda run: ((run / "config.json").unlink(), os.mkfifo(run / "config.json")), "no plain file"),
    "a state without a step": (state_without, "has no progress"),
}  # fmt: skip


def test_the_fixed_cases_are_enough() -> None:
    assert len(DATASETS) + len(CLOUDS) + len(RECIPES) + len(PREDICTIONS) + len(RUNS) >= 60


def refused(good: dict[str, Path], folder: Path, step: int) -> None:
    """No traceback, no crash, nothing unpickled or run, nothing read outside; and good ones are read without any `exec`."""
    made = cases(folder, good, step)
    found = read_apart([(kind, path) for kind, path, _, _ in made.values()], good, folder / "outside")
    assert all(line == "" for lines in found["again"] for line in lines), found["again"]
    assert found["touched"] == []
    for (name, (kind, path, code, words)), lines in zip(made.items(), found["read"]):
        assert not any(line.startswith("!") for line in lines), (name, lines)
        said = [line for line in lines if line]
        assert said, f"{name}: was read"
        assert any(re.search(words, line) for line in said), (name, said)
        assert kind != "dataset" or any(line.startswith(str(code)) for line in said) or "pipe for a manifest" in name, (
            name,
            said,
        )
        assert kind == "dataset" or said[0].startswith(f"{code} "), (name, said)
        for line in said:
            assert "\n" not in line or "problems, expected none" in line, (name, line)
            assert str(path) in line


def test_hostile_things_are_refused_in_a_line_with_little_memory_and_nothing_else_is_touched(
    good: dict[str, Path], in_memory: Path
) -> None:
    refused(good, in_memory, step=4)


@pytest.mark.slow
def test_all_hostile_things_are_refused_in_a_line_with_little_memory_and_nothing_else_is_touched(
    good: dict[str, Path], in_memory: Path
) -> None:
    refused(good, in_memory, step=1)


# Fuzzed ------------------------------------------------------------------------------------------------------

WORDS = (
    b"1000000000000", b"-1", b"nan", b"1e999", b"\n", b"\x00", b" ", b"9" * 40, b"element vertex 3\n", b"COUNT 3 1 1 1 1 1\n",
    b"property list uchar int x\n", b"{}", b"[", b"&a ", b"*a ", b"!!python/object:os.system ", b": ", b"- ", b"../", b"null",
    b"'descr': '|O'", b"(1000000000000,)", b"true", b'"', b"SIZE 8 8 8 8 8 8\n", b"\xff" * 8,
)  # fmt: skip


def spoilt(data: bytes, rng: np.random.Generator) -> bytes:
    """The bytes with a few things changed, mostly near their beginning."""
    if rng.random() < 0.05:
        return rng.bytes(int(rng.integers(500)))
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 4))):
        place = int(rng.integers(min(len(out), 300 if rng.random() < 0.5 else len(out)) + 1))
        word = WORDS[int(rng.integers(len(WORDS)))]
        action = int(rng.integers(6))
        if action == 0 and out:
            out[min(place, len(out) - 1)] ^= 1 << int(rng.integers(8))
        elif action == 1:
            out[place:place] = word
        elif action == 2:
            out[place : place + len(word)] = word
        elif action == 3:
            del out[place : place + int(rng.integers(1, 40))]
        elif action == 4:
            out = out[:place]
        else:
            out[place:place] = rng.bytes(int(rng.integers(1, 20)))
    return bytes(out)


VALUES: tuple[Any, ...] = (
    None, -1, 0, 10**12, 10**30, -0.5, True, "", "x", "../..", "/etc/passwd", "a\nb\x1b[31m", [], {}, [[]], {"a": {}},
    "A" * 10**5, [1] * 1000, json.loads(hostile.deep(200)),
)  # fmt: skip


def other_tree(tree: Any, rng: np.random.Generator) -> None:
    """Changes one value somewhere in a JSON tree."""
    places: list[tuple[Any, Any]] = []

    def walk(part: Any) -> None:
        items = part.items() if isinstance(part, dict) else enumerate(part) if isinstance(part, list) else ()
        for key, value in items:
            places.append((part, key))
            walk(value)

    walk(tree)
    part, key = places[int(rng.integers(len(places)))]
    value, action = VALUES[int(rng.integers(len(VALUES)))], int(rng.integers(4))
    if action == 0 and isinstance(part, dict):
        del part[key]
    elif action == 1 and isinstance(part, dict):
        part["extra"] = value
    else:
        part[key] = value


def fuzzed(folder: Path, good: dict[str, Path], rng: np.random.Generator) -> tuple[str, Path]:
    """One thing that was good before: noise in a file, or a value in a tree whose hashes are right."""
    name = sorted(good)[int(rng.integers(len(good)))]
    if not good[name].is_dir():
        return KINDS[name], put(folder / name, spoilt(good[name].read_bytes(), rng))
    root = Path(shutil.copytree(good[name], folder / name))
    files = sorted(path for path in root.rglob("*") if path.is_file() and path.name not in (".lock", "log.jsonl"))
    if name == "dataset" and rng.random() < 0.7:
        unit = hostile.shard(root)
        what = int(rng.integers(3))
        if what == 0:
            hostile.forge_manifest(root, lambda tree: other_tree(tree, rng))
        elif what == 1:
            hostile.forge_root(root, unit, lambda tree: other_tree(tree, rng))
        else:
            arrays = sorted(p for p in (root / unit).rglob("zarr.json") if p.parent != root / unit)
            path = arrays[int(rng.integers(len(arrays)))]
            tree = json.loads(path.read_text())
            other_tree(tree, rng)
            hostile.forge_file(root, unit, path.relative_to(root / unit).as_posix(), json.dumps(tree).encode())
    elif name == "run" and rng.random() < 0.5:
        tree = json.loads((root / "config.json").read_text())
        other_tree(tree, rng)
        (root / "config.json").write_text(json.dumps(tree))
    else:
        path = files[int(rng.integers(len(files)))]
        path.write_bytes(spoilt(path.read_bytes(), rng))
    return KINDS[name], root


def fuzz(good: dict[str, Path], folder: Path, count: int, seed: int) -> Counter[str]:
    """How many fuzzed things of each kind were read and refused."""
    things = []
    for number in range(count):
        things.append(fuzzed(folder / str(number), good, np.random.default_rng([seed, number])))
    found = read_apart(things, good, folder / "outside")
    assert found["touched"] == []
    counts = Counter[str]()
    for (kind, path), lines in zip(things, found["read"]):
        for line in lines:
            assert not line.startswith("!"), (path, line)
            assert line == "" or line[:2] in ("2 ", "3 "), (path, line)
            assert "\n" not in line or "problems, expected none" in line or kind == "recipe", (path, line)
        counts[f"{kind} {'refused' if any(lines) else 'read'}"] += 1
    return counts


def test_fuzzed_things_are_read_or_refused_in_a_line(good: dict[str, Path], in_memory: Path) -> None:
    counts = fuzz(good, in_memory, 20, seed=0)
    assert sum(count for name, count in counts.items() if name.endswith("refused")) > 10


@pytest.mark.slow
def test_three_hundred_fuzzed_things_are_read_or_refused_in_a_line(good: dict[str, Path], in_memory: Path) -> None:
    counts = fuzz(good, in_memory, 300, seed=1)
    assert {name.split()[0] for name in counts} == set(KINDS.values())


# Writers -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [".lock", "log.jsonl", "staging", "preview", "stages/observe", "elsewhere"])
def test_a_writer_does_not_follow_links_out_of_a_dataset(good: dict[str, Path], in_memory: Path, name: str) -> None:
    root, outside = Path(shutil.copytree(good["dataset"], in_memory / "toy")), in_memory / "outside"
    outside.mkdir()
    (outside / ".precious.tmp").write_text("all of it")
    path = root / name
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
    path.symlink_to(outside / ".precious.tmp" if name in (".lock", "log.jsonl") else outside)
    for command in (
        lambda: pipeline.label(root, ["label.eps_place=0.02"], engine="inline", table="toy_stages"),
        lambda: pipeline.attach(root, {"preview/x.png": b"x"}),
        lambda: health.gc(root),
    ):
        with pytest.raises(FormatError, match="a link, expected files and folders"):
            command()
    assert [file.name for file in outside.iterdir()] == [".precious.tmp"]
    assert (outside / ".precious.tmp").read_text() == "all of it"


def test_gc_does_not_free_what_a_link_leads_to(good: dict[str, Path], in_memory: Path) -> None:
    root, outside = Path(shutil.copytree(good["dataset"], in_memory / "toy")), in_memory / "outside"
    (outside / "unit").mkdir(parents=True)
    (root / "stages/observe/0123").symlink_to(outside / "unit")
    assert health.gc(root).to_dict()["removed"] == []
    assert (outside / "unit").is_dir()
    assert not durable.is_inside(root, root / "stages/observe/0123")
    assert any("0123: not part of the dataset" in problem for problem in health.verify(root, quick=True).problems)
