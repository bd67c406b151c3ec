"""One dataset made by several commands at once: `--units I/N`, the lock that they share, and the script for Slurm."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from conftest import make_toy
from toy_stages import toy_recipe

from dapdata import cli, durable, engines, health, manifest, pipeline
from dapdata.errors import EnvironmentProblem, FormatError, LockedError, UsageError
from dapdata.plan import Plan
from dapdata.stages import stripe
from dapdata.stages import units as units_of

TABLE = "toy_stages"
COMMAND = """
import sys
from dapdata import pipeline
from toy_stages import toy_recipe
verb, root, units = sys.argv[1:]
if verb == "generate":
    pipeline.generate(toy_recipe(8), root, units=units, engine="inline", table="toy_stages")
else:
    pipeline.label(root, units=units, engine="inline", table="toy_stages")
"""


def content(root: Path) -> str:
    return manifest.read(root).content_sha256


def generate(root: Path, part: str | None = None, engine: str = "inline") -> None:
    pipeline.generate(toy_recipe(8), root, units=part, engine=engine, table=TABLE)


def start(verb: str, root: Path, part: str) -> subprocess.Popen[bytes]:
    """One task, in a process of its own."""
    environment = os.environ | {"PYTHONPATH": f"{Path(__file__).parent}:{os.environ.get('PYTHONPATH', '')}"}
    return subprocess.Popen([sys.executable, "-c", COMMAND, verb, str(root), part], env=environment)


# The plan of units -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 3, 7, 20])
def test_stripes_are_disjoint_and_together_all_units(count: int) -> None:
    every = units_of(100, 7)
    parts = [stripe(f"{index}/{count}", every) for index in range(count)]
    assert sorted((unit for part in parts for unit in part), key=lambda unit: unit.index) == every
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("text", ["", "/8", "8", "8/8", "-1/8", "0/0", "a/b", "0/8/2", "0.5/8"])
def test_what_is_no_stripe_is_refused(text: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--units: got '.*', expected I/N with I from 0 to N - 1"):
        generate(tmp_path / "toy", text)
    assert not list(tmp_path.iterdir())


def test_a_dry_run_of_a_stripe_counts_its_own_units(tmp_path: Path) -> None:
    plan = pipeline.generate(toy_recipe(8), tmp_path / "toy", units="2/3", dry_run=True, table=TABLE)
    assert isinstance(plan, Plan)
    assert (plan.demos, plan.stages[0].units, plan.stages[0].demos) == (2, 1, 2)


def test_a_stripe_does_not_delete_what_others_make(toy_copy: Path) -> None:
    with pytest.raises(UsageError, match="--fresh: would delete what other tasks make"):
        pipeline.generate(toy_recipe(8), toy_copy, units="0/2", fresh=True, table=TABLE)
    assert health.verify(toy_copy).ok


# Side by side ----------------------------------------------------------------------------------------------


def test_stripes_one_after_the_other_end_with_the_content_of_one_command(toy: Path, tmp_path: Path) -> None:
    root = tmp_path / "toy"
    for part in ("2/3", "0/3"):
        generate(root, part)
        with pytest.raises(FormatError, match=r"no manifest\.json yet"):
            manifest.read(root)
    assert health.status(root).to_dict()["in_progress"]["done"] == {"demonstrate": 2, "observe": 2}
    generate(root, "1/3")
    assert manifest.read(root).shards == []
    for part in ("1/2", "0/2"):
        pipeline.label(root, units=part, engine="inline", table=TABLE)
    assert (root / "manifest.json").read_bytes() == (toy / "manifest.json").read_bytes()
    assert health.verify(root).ok


def test_tasks_at_the_same_time_and_twice_end_with_the_content_of_one_command(
    toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TOY_SLEEP", "0.05")
    root = tmp_path / "toy"
    for verb, parts in (("generate", ("0/2", "1/2", "1/2")), ("label", ("0/2", "1/2"))):
        tasks = [start(verb, root, part) for part in parts]
        assert [task.wait(120) for task in tasks] == [0] * len(parts)
    assert (root / "manifest.json").read_bytes() == (toy / "manifest.json").read_bytes()
    assert health.verify(root).ok
    assert not health.status(root).to_dict()["working"]


def test_a_plain_command_makes_what_a_lost_task_left_and_publishes(toy: Path, tmp_path: Path) -> None:
    root = tmp_path / "toy"
    generate(root, "0/2")
    make_toy(root)
    assert content(root) == content(toy)


def test_stripes_share_the_lock_and_plain_commands_do_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "PATIENCE", 0.2)
    root = tmp_path / "toy"
    with durable.lock(root, shared=True):
        generate(root, "0/2")
        with pytest.raises(LockedError, match=rf"in use by process {os.getpid()} on .*wait for it to end"):
            generate(root)
    with durable.lock(root), pytest.raises(LockedError, match=rf"in use by process {os.getpid()}"):
        generate(root, "1/2")


def test_whoever_shares_the_lock_last_publishes(toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another task holds the lock when all units are there; it publishes when it ends, although it made none of them."""
    monkeypatch.setattr(pipeline, "PATIENCE", 0.2)
    root = tmp_path / "toy"
    with durable.lock(root, shared=True):
        generate(root, "0/1")
        assert not (root / "manifest.json").exists()
    generate(root, "1/2")
    assert manifest.read(root).stages["observe"].units == manifest.read(toy).stages["observe"].units


def test_a_task_waits_for_one_that_only_looks_whether_all_is_there(tmp_path: Path) -> None:
    root = tmp_path / "toy"
    root.mkdir()
    script = (
        "import pathlib, sys, time; from dapdata import durable\n"
        "with durable.lock(pathlib.Path(sys.argv[1])): print('held', flush=True); time.sleep(1)"
    )
    other = subprocess.Popen([sys.executable, "-c", script, str(root)], stdout=subprocess.PIPE, text=True)
    assert other.stdout is not None
    assert other.stdout.readline() == "held\n"
    generate(root, "0/1")
    assert other.wait(10) == 0
    other.stdout.close()
    assert (root / "manifest.json").exists()


def test_those_who_share_the_lock_leave_what_others_are_writing(tmp_path: Path) -> None:
    with durable.lock(tmp_path, shared=True), durable.staged(tmp_path, "unit") as folder:
        with durable.lock(tmp_path, shared=True):
            assert "and 1 more" in str(durable.holder(tmp_path))
        assert folder.is_dir()
        assert "more" not in str(durable.holder(tmp_path))
    assert durable.holder(tmp_path) is None


def test_who_still_writes_when_staging_is_swept_cannot_commit(tmp_path: Path) -> None:
    """Its command was killed, but the worker, on another machine, has not heard of it yet."""
    with durable.staged(tmp_path, "unit") as folder:
        (folder / "array").write_text("x")
        with durable.lock(tmp_path):
            assert not list(tmp_path.rglob("array"))
        with pytest.raises(FileNotFoundError):
            durable.commit(folder, tmp_path / "unit")
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]


# Other machines --------------------------------------------------------------------------------------------


def test_a_unit_that_is_not_seen_here_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Elsewhere:
        def run(self, call: str, jobs: list[engines.Job], *, workers: int, on_done: engines.OnDone) -> list[engines.Failure]:
            for job in jobs:
                on_done(job, '{"made": []}')
            return []

    monkeypatch.setattr(pipeline, "SEEN_WITHIN", 0.1)
    monkeypatch.setattr(engines, "get", lambda name: Elsewhere())
    with pytest.raises(EnvironmentProblem, match=r"unit 0 was made, but it is not here; .* a file system that they share"):
        generate(tmp_path / "toy")
    assert not (tmp_path / "toy/manifest.json").exists()


def test_a_machine_with_other_versions_makes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = pipeline.specs
    monkeypatch.setattr(
        pipeline, "specs", lambda *given: {name: spec | {"packages": {"numpy": "1.0"}} for name, spec in whole(*given).items()}
    )
    with pytest.raises(EnvironmentProblem, match=r"not what the unit is made for \(numpy 1.0 -> .*expected the same versions"):
        generate(tmp_path / "toy", engine="local")
    assert not (tmp_path / "toy/stages").exists()


def test_a_folder_that_cannot_be_locked_is_an_error_that_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(durable.fcntl, "flock", refuse)
    with pytest.raises(EnvironmentProblem, match=r"cannot be locked \(Function not implemented\), expected a file system with"):
        generate(tmp_path / "toy")


# Slurm -----------------------------------------------------------------------------------------------------

SBATCH = """#!/bin/bash
# Does what Slurm would with each job: notes how it was submitted, then runs it, or the tasks of its array.
number=$(( $(wc -l < "$NOTES") + 1 ))
printf '%s\\n' "$*" >> "$NOTES"
cat > "$NOTES.$number"
last=$(grep -oP -- '--array=0-\\K[0-9]+' <<< "$*" || echo none)
[[ -n "${RUN:-}" ]] && for id in $([[ $last == none ]] && echo none || seq 0 "$last"); do
    SLURM_ARRAY_TASK_ID=$id bash "$NOTES.$number" >&2 || echo "job $number, task $id: $?" >> "$NOTES.failed"
done
echo "$number;cluster"
"""


@pytest.fixture
def sbatch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The notes of a stand-in for Slurm's command."""
    (tmp_path / "bin").mkdir()
    command, notes = tmp_path / "bin/sbatch", tmp_path / "notes"
    command.write_text(SBATCH)
    command.chmod(0o755)
    notes.touch()
    monkeypatch.setenv("PATH", f"{command.parent}:{os.environ['PATH']}")
    monkeypatch.setenv("NOTES", str(notes))
    monkeypatch.chdir(tmp_path)
    return notes


def slurm(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert cli.run_app(["slurm", *map(str, arguments)]) == 0
    return capsys.readouterr().out


def payloads(notes: Path) -> list[list[str]]:
    """The command of each job, as the words that follow `dapdata`."""
    scripts = [Path(f"{notes}.{number}").read_text() for number in range(1, 5)]
    return [shlex.split(text.splitlines()[1])[4:] for text in scripts]


def test_the_slurm_script_submits_arrays_each_followed_by_a_plain_command(
    sbatch: Path, tiny_recipe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = slurm(
        capsys,
        tiny_recipe,
        "--out",
        "my data",
        "--tasks",
        2,
        "--workers",
        3,
        "--partition",
        "cpu",
        "--set",
        "label.eps_place=0.02",
    )
    subprocess.run(["bash", "-n"], input=text, text=True, check=True)
    done = subprocess.run(["bash"], input=text, text=True, check=True, capture_output=True)
    assert done.stdout == "tiny: jobs 1, 2, 3, 4\n"
    submitted = sbatch.read_text().splitlines()
    assert all("--cpus-per-task=3 --mem=7168M --time=04:00:00 --partition=cpu" in line for line in submitted)
    assert ["--array=0-1" in line for line in submitted] == [True, False, True, False]
    assert [line.split("dependency=")[-1].split()[0] for line in submitted[1:]] == ["afterany:1", "afterok:2", "afterany:3"]
    assert (tmp_path / "my data-slurm").is_dir()
    commands = payloads(sbatch)
    assert [command[0] for command in commands] == ["generate", "generate", "label", "label"]
    assert [command[-2:] for command in commands[::2]] == [["--units", "$SLURM_ARRAY_TASK_ID/2"]] * 2
    assert all(str(tmp_path / "my data") in command for command in commands)


def test_each_payload_of_the_slurm_script_is_a_command_that_runs(
    sbatch: Path, tiny_recipe: Path, tiny_dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(tiny_dataset, tmp_path / "tiny")
    text = slurm(capsys, tiny_recipe, "--out", "tiny", "--allow-missing")
    subprocess.run(["bash"], input=text, text=True, check=True, capture_output=True)
    for command in payloads(sbatch):
        words = [word.replace("$SLURM_ARRAY_TASK_ID", "1") for word in command]
        assert cli.run_app([*words, "--dry-run"]) == 0
        assert "nothing to do, all 1 units are there" in capsys.readouterr().out or "--units" not in words


@pytest.mark.slow
def test_the_slurm_script_makes_the_dataset_that_one_command_makes(
    sbatch: Path, tiny_recipe: Path, tiny_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setenv("RUN", "1")
    subprocess.run(["bash"], input=slurm(capsys, tiny_recipe, "--out", "made"), text=True, check=True, capture_output=True)
    assert not Path(f"{sbatch}.failed").exists()
    assert content(tmp_path / "made") == content(tiny_dataset)
    assert (tmp_path / "made/preview").is_dir()
    assert health.verify(tmp_path / "made").ok


def test_an_array_task_without_its_number_says_so(
    sbatch: Path, tiny_recipe: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run_app(["generate", str(tiny_recipe), "--out", "x", "--units", "/8"]) == 2
    assert capsys.readouterr().err.startswith("--units: got '/8', expected I/N")


@pytest.mark.parametrize(("limit", "code"), [("90", 0), ("2-00:00:00", 0), ("1:30:00", 0), ("4h", 2), ("", 2)])
def test_a_time_limit_is_one_that_slurm_reads(limit: str, code: int, tiny_recipe: Path) -> None:
    assert cli.run_app(["slurm", str(tiny_recipe), "--time", limit]) == code


# The page about clusters -----------------------------------------------------------------------------------

PAGE = (Path(__file__).parents[1] / "docs/clusters.md").read_text(encoding="utf-8")


def blocks(language: str) -> str:
    return "\n".join(re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL))


def told() -> list[str]:
    """Each command of dapdata that the page has people run, in its blocks and in its text."""
    whole = "\n".join([blocks("sh"), *re.findall(r"`(dapdata (?:generate|label|slurm) [^`]+)`", PAGE)])
    return re.findall(r"(dapdata (?:generate|label|slurm) [^\n&>]+)", whole)


@pytest.fixture
def beside_shared(tiny_dataset: Path, tiny_recipe: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder with the recipes and the datasets that the page speaks of."""
    for name in ("recipes", "data", "shared"):
        (tmp_path / name).mkdir()
    for name in ("recipes/can_cabinet.yaml", "shared/can_cabinet.yaml"):
        shutil.copy(tiny_recipe, tmp_path / name)
    for name in ("data/can_cabinet", "shared/can_cabinet"):
        (tmp_path / name).symlink_to(tiny_dataset)
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("beside_shared")
def test_the_commands_of_the_page_about_clusters_run_dry(capsys: pytest.CaptureFixture[str]) -> None:
    lines = told()
    assert len(lines) >= 12
    for line in lines:
        words = shlex.split(line.replace("/shared", "shared").replace("RECIPE", "recipes/can_cabinet.yaml"))[1:]
        dry = [] if words[0] == "slurm" else ["--dry-run"]
        assert cli.run_app([*words, *dry]) == 0, line
    assert "sbatch --parsable" in capsys.readouterr().out


@pytest.mark.usefixtures("beside_shared")
def test_the_pod_of_the_page_about_clusters_makes_its_own_units(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = yaml.safe_load(blocks("yaml"))["spec"]
    (container,) = job["template"]["spec"]["containers"]
    mounted = {mount["name"] for mount in container["volumeMounts"]}
    assert mounted == {volume["name"] for volume in job["template"]["spec"]["volumes"]}
    (tmp_path / "bin").mkdir()
    command = tmp_path / "bin/dapdata"
    command.write_text(f'#!/bin/sh\nexec {sys.executable} -m dapdata "$@" --dry-run --json\n')
    command.chmod(0o755)
    text = container["args"][0].replace("/shared", "shared")
    units = []
    for index in ("0", "1", "2"):
        environment = os.environ | {"PATH": f"{command.parent}:{os.environ['PATH']}", "JOB_COMPLETION_INDEX": index}
        done = subprocess.run([*container["command"], text], env=environment, capture_output=True, text=True, check=True)
        units.append(json.loads(done.stdout)["stages"][0]["units"])
    assert units == [1, 1, 0], "two units, of five demos, in the first two of sixteen stripes"
    assert f"/{job['completions']}" in text
