"""The command line from outside: what each command prints, where, and with which exit code."""

from __future__ import annotations

import errno
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import typer.main

from dapdata import cli, clouds, loading, metrics, predictions, tasks

COMMANDS = typer.main.get_command(cli.app).commands  # type: ignore[attr-defined]
NAMES = ", ".join(tasks.names())
GROUPS = {name: command.commands for name, command in COMMANDS.items() if hasattr(command, "commands")}
REPORTING = {name: command for name, command in COMMANDS.items() if name not in {*GROUPS, "init", "schema", "slurm"}} | {
    f"{group} {name}": command for group, members in GROUPS.items() for name, command in members.items()
}
BAD = "scene:\n  task: can_cabinet\nlabel:\n  eps_place: 30\n"
DAPDATA = [sys.executable, "-m", "dapdata"]


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(capsys: pytest.CaptureFixture[str], *arguments: object, code: int = 0) -> str:
    """What a command prints on stdout; its exit code must be `code`. What it says on stderr goes to `said`."""
    capsys.readouterr()
    got = cli.run_app([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    run.said = err  # type: ignore[attr-defined]
    assert got == code, err
    assert "Traceback" not in err
    return out


def said() -> str:
    return str(run.said)  # type: ignore[attr-defined]


def printed(capsys: pytest.CaptureFixture[str], *arguments: object) -> Any:
    """The result of a command as JSON: stdout holds nothing else."""
    return json.loads(run(capsys, *arguments, "--json"))


# Help ------------------------------------------------------------------------------------------------------


def test_without_a_command_the_help_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    run(capsys, code=2)
    assert said().startswith("Usage: dapdata")
    assert said().endswith("Start with: dapdata run recipes/quickstart.yaml\n")


@pytest.mark.parametrize("name", sorted({*COMMANDS, *REPORTING}))
def test_every_command_has_help_with_an_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    text = run(capsys, *name.split(), "--help")
    assert f"Example: dapdata {name}" in text
    for parameter in REPORTING.get(name, COMMANDS.get(name)).params:  # type: ignore[union-attr]
        assert parameter.help, parameter.name


def test_the_commands_are_those_of_the_interface() -> None:
    assert set(COMMANDS) == {
        "init", "generate", "label", "train", "eval", "judge", "predict", "run", "status", "inspect", "verify", "show", "gc",
        "schema", "bench", "compare", "doctor", "import", "export", "slurm",
    }  # fmt: skip


@pytest.mark.parametrize("name", sorted(REPORTING))
def test_every_command_that_reports_does_so_for_machines_too(name: str) -> None:
    assert "--json" in {option for parameter in REPORTING[name].params for option in parameter.opts}


def test_help_takes_less_than_half_a_second_of_the_processor() -> None:
    subprocess.run([*DAPDATA, "--help"], check=True, capture_output=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([*DAPDATA, "--help"], check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 0.5


# Mistakes --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "start"),
    [
        (["generate"], "Missing argument"),
        (["generate", "x.yaml", "--wrokers", "2"], "No such option"),
        (["generate", "x.yaml", "--workers", "0"], "Invalid value for '--workers'"),
        (["generat", "x.yaml"], "No such command 'generat'"),
        (["generate", "none.yaml"], "none.yaml: cannot be read (No such file or directory)"),
        (["init", "cancabinet"], f"task: got 'cancabinet', expected one of {NAMES}"),
        (["status"], "dataset: none was given and none was written from this folder yet"),
        (["eval"], "run: none was given"),
        (["inspect", "."], ".: no manifest.json, expected a dataset's folder"),
        (["label", "nowhere"], "nowhere: no such folder, expected a dataset"),
        (["judge", "no.npz", "--data", "nowhere"], "no.npz"),
        (["show", ".", "--out", "a.gif"], "--out a.gif: expected a .png or .html file"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line_and_exit_code_2(
    arguments: list[str], start: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run(capsys, *arguments, code=2) == ""
    assert said().startswith(start)
    assert said().count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", [["generate"], ["generate", "--dry-run"], ["run"]], ids=" ".join)
def test_a_bad_recipe_starts_no_work(command: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text(BAD)
    assert run(capsys, command[0], "x.yaml", *command[1:], code=2) == ""
    assert said() == "x.yaml:4: label.eps_place: got 30, expected 0.001 to 0.2 m; did you mean 0.03?\n"
    assert [path.name for path in tmp_path.iterdir()] == ["x.yaml"]


def test_a_bad_budget_starts_no_work_either(capsys: pytest.CaptureFixture[str], tiny_recipe: Path, tmp_path: Path) -> None:
    run(capsys, "run", tiny_recipe, "--minutes", "-1", code=2)
    assert said() == "minutes: got -1.0, expected a number above 0\n"
    assert not any(tmp_path.iterdir())


def test_a_missing_extra_is_one_line_that_names_the_command_to_run(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    run(capsys, "train", "nowhere", code=6)
    assert "pip install 'dapdata[train]'" in said()
    assert said().count("\n") == 1


def test_a_missing_simulator_is_told_by_the_command_that_needs_it(tiny_recipe: Path, tmp_path: Path) -> None:
    (tmp_path / "blocked").mkdir()
    (tmp_path / "blocked/pybullet.py").write_text("raise ImportError('not installed')\n")
    done = subprocess.run(
        [*DAPDATA, "generate", tiny_recipe],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": str(tmp_path / "blocked")},
        check=False,
    )
    assert done.returncode == 6, done.stderr
    assert "pip install 'dapdata[sim]'" in done.stderr
    assert "Traceback" not in done.stderr


LIGHT = """
import sys
for name in ("pybullet", "trimesh", "open3d", "numba", "scipy", "matplotlib", "torch", "safetensors"):
    sys.modules[name] = None
import dapdata
from dapdata import cli
assert len(dapdata.open(sys.argv[1], "train")[0]["container/points"]) > 100
assert [cli.run_app([name, sys.argv[1]]) for name in ("inspect", "verify", "status")] == [0, 0, 0]
assert [cli.run_app(["generate", sys.argv[2], *more]) for more in (["--dry-run"], [])] == [0, 6]
try:
    dapdata.generate(sys.argv[2])
except dapdata.MissingExtraError as error:
    assert "pybullet" in str(error), error
"""


def test_a_dataset_is_read_checked_and_planned_without_any_extra(tiny_dataset: Path, tiny_recipe: Path, tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", LIGHT, tiny_dataset, tiny_recipe], check=True, capture_output=True)
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "data/x"), 6, "data/x: no room left"),
        (PermissionError(errno.EACCES, "Permission denied", "data/x"), 6, "data/x: Permission denied"),
        (KeyboardInterrupt(), 130, "goes on where it stopped"),
    ],
    ids=["disk full", "no permission", "ctrl-c"],
)
def test_what_the_machine_refuses_has_a_code_of_its_own(
    error: BaseException, code: int, words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("dapdata.health.status", fail)
    run(capsys, "status", ".", code=code)
    assert words in said()


def test_a_reader_that_stops_listening_is_no_error() -> None:
    done = subprocess.run(
        ["bash", "-o", "pipefail", "-c", f"{sys.executable} -m dapdata schema shard | head -1"],
        capture_output=True,
        check=False,
    )
    assert (done.stdout, done.stderr) == (b"{\n", b"")
    assert done.returncode in (0, 1)  # 1: typer's own answer to a closed pipe


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["ctrl-c", "sigterm"])
def test_stopping_a_command_says_how_to_go_on(number: signal.Signals, tiny_recipe: Path, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [*DAPDATA, "generate", tiny_recipe, "--out", "d"], stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    while process.poll() is None and not (tmp_path / "d/progress.json").exists():
        time.sleep(0.02)
    time.sleep(0.3)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert err.splitlines()[-1].startswith("stopped; the same command, run again, goes on")
    assert "Traceback" not in err


# Recipes ---------------------------------------------------------------------------------------------------


def test_init_lists_tasks_and_writes_a_recipe_that_can_be_planned(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert [line.split()[0] for line in run(capsys, "init").splitlines()] == tasks.names()
    assert run(capsys, "init", "book_shelf", "--to", "recipes/a.yaml") == "recipes/a.yaml\n"
    assert run(capsys, "init", "book_shelf") == (tmp_path / "recipes/a.yaml").read_text()
    run(capsys, "init", "book_shelf", "--to", "recipes/a.yaml", code=2)
    plan = printed(capsys, "generate", "recipes/a.yaml", "--dry-run", "--demos", 7)
    assert plan["demos"] == 7
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("kind", ["recipe", "manifest", "shard", "report"])
def test_schema_prints_a_schema(kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert json.loads(run(capsys, "schema", kind))["$schema"].startswith("https://json-schema.org/")


# Datasets --------------------------------------------------------------------------------------------------


def test_a_dataset_from_recipe_to_pictures_without_naming_it_twice(
    tiny_recipe: Path, tiny_dataset: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert run(capsys, "generate", tiny_recipe) == "data/tiny\n"
    assert re.search(r"generate: 5 of 5 demos, \d+ s", said())
    assert run(capsys, "label") == "data/tiny\n"
    assert "dataset: data/tiny (the last one written from this folder)" in said()
    assert printed(capsys, "inspect")["content_sha256"] == loading.open(tiny_dataset).digest
    assert printed(capsys, "status")["published"]["labelled"]
    assert printed(capsys, "verify")["ok"]
    assert printed(capsys, "gc", "--dry-run")["would_remove"] == []
    assert printed(capsys, "show", "--count", 1)["files"] == ["tiny.png", "tiny.html"]
    assert (tmp_path / "tiny.png").stat().st_size > 10_000


def test_verify_names_the_damage_and_exits_3(tiny_dataset: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    shutil.copytree(tiny_dataset, tmp_path / "d")
    (chunk,) = (tmp_path / "d").glob("shards/*/00000.zarr/container/points/c/0/0")
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 1
    chunk.unlink()  # it is linked to the upstream unit
    chunk.write_bytes(data)
    assert "container/points" in run(capsys, "verify", "d", code=3)


# Judging and training --------------------------------------------------------------------------------------


def write_oracle(dataset: Path, path: Path) -> None:
    scenes = loading.open(dataset, "test")
    predictions.write(path, metrics.oracle([scenes[i] for i in range(len(scenes))], 2))


def test_judge_and_compare_anyones_predictions(tiny_dataset: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    write_oracle(tiny_dataset, tmp_path / "mine.npz")
    report = printed(capsys, "judge", "mine.npz", "--data", tiny_dataset, "--out", "a.json")
    assert report == json.loads((tmp_path / "a.json").read_text())
    run(capsys, "judge", "mine.npz", "--data", tiny_dataset, "--out", "new/folder/a.json")
    assert report["success"] == json.loads((tmp_path / "new/folder/a.json").read_text())["success"]
    assert report["success"]["success_top1"]["value"] == 1
    assert "success_top1      100.0 %" in run(capsys, "judge", "mine.npz", "--data", tiny_dataset)
    assert printed(capsys, "compare", "a.json", "a.json")["difference"] == 0


def test_train_then_predict_on_scans(tiny_dataset: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    pytest.importorskip("torch")
    assert printed(capsys, "train", tiny_dataset, "--run", "r", "--steps", 2)["run"] == "r"
    sample = loading.open(tiny_dataset, "test")[0]
    for name in ("container", "object"):
        clouds.write_ply(tmp_path / f"{name}.ply", sample[f"{name}/points"], sample[f"{name}/normals"])
    scans = ["--container", "container.ply", "--object", "object.ply"]
    found = printed(capsys, "predict", "r", *scans, "-k", 3, "--out", "p.json")
    assert [row["rank"] for row in found["placements"]] == [0, 1, 2]
    assert found == json.loads((tmp_path / "p.json").read_text())
    assert run(capsys, "predict", "r", *scans, "-k", 3).count("\n") == 4


def test_evaluating_takes_overrides_of_what_acts_at_inference(tiny_dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("torch")
    run(capsys, "train", tiny_dataset, "--run", "r", "--steps", 1)
    options = ("--data", tiny_dataset, "--trials", 1, "-k", 1, "--draws", 2, "--split", "train", "--workers", 1)
    found = printed(capsys, "eval", "r", *options, "--fast", "--set", "train.refine=[]", "--out", "o")
    assert (found["method"]["settings"]["refine"], found["method"]["settings"]["sample_steps"]) == ([], 3)
    assert (found["method"]["k"], found["method"]["draws"]) == (1, 2)
    assert not Path("r/report.json").exists()
    assert predictions.read("o/predictions.npz").rank.tolist() == [0, 1]
    again = printed(capsys, "judge", "o/predictions.npz", "--data", tiny_dataset, "--split", "train", "--trials", 1, "-k", 1)
    assert again["success"] == found["success"]
    assert again["modes"] == found["modes"]
    for wrong, says in (
        ("train.width=32", "train.width: is fixed in training"),
        ("train.refine=[jump]", "train.refine[0]: got 'jump'"),
        ("label.eps_place=0.02", "expected a key of the train section"),
    ):
        run(capsys, "eval", "r", *options, "--set", wrong, code=2)
        assert says in said()
        assert said().count("\n") == 1
    run(capsys, "eval", "--data", tiny_dataset, "--fast", "--curve", "2", "--steps", 1, code=2)
    assert said() == "--fast: is of one report; with --curve give --set train.sample_steps=3\n"


def test_training_takes_overrides_of_its_own_section_only(tiny_dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("torch")
    run(capsys, "train", tiny_dataset, "--run", "r", "--set", "label.eps_place=0.02", code=2)
    assert "expected a key of the train section" in said()
