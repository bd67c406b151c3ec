"""Training that is killed, cut off or out of disk loses no checkpoint, and ends with the bits of one that was not."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tarfile
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")

from crashing import crashes  # noqa: E402
from test_resume import files_of_at_most  # noqa: E402
from training_samples import TINY  # noqa: E402

from dapdata import durable  # noqa: E402
from dapdata.errors import EnvironmentProblem, LockedError  # noqa: E402
from daptrain import checkpoint, loop  # noqa: E402

HERE = Path(__file__).parent
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE), *sys.path])}
KILLED = """
import os, signal, sys
from training_samples import TINY
from daptrain import loop
dataset, run, steps, net, at = sys.argv[1], sys.argv[2], int(sys.argv[3]), sys.argv[4], int(sys.argv[5])
step = loop.train_step
def killed(network, optimizer, material, config, number, *rest):
    if (network.name, number) == (net, at):
        os.kill(os.getpid(), signal.SIGKILL)
    return step(network, optimizer, material, config, number, *rest)
loop.train_step, loop.CHECKPOINT_SECONDS, loop.LOG_EVERY = killed, 0.0, 5
loop.train(dataset, run, steps=steps, device="cpu", config=TINY, net=sys.argv[6])
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few small true scenes. Not to be changed."""
    folder = tmp_path_factory.mktemp("dataset")
    with tarfile.open(HERE / "formats/1.tar.xz") as file:
        file.extractall(folder, filter="data")
    return folder / "format-1"


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """A state at every fifth step."""
    monkeypatch.setattr(loop, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(loop, "LOG_EVERY", 5)


def train(dataset: Path, run: Path, steps: int, net: str = "both") -> Path:
    return loop.train(dataset, run, steps=steps, device="cpu", config=TINY, net=net)


def weights(run: Path) -> dict[str, bytes]:
    """What training is for, byte by byte."""
    return {path.name: path.read_bytes() for path in sorted(run.glob("*.safetensors")) if ".state." not in path.name}


def losses(run: Path) -> list[tuple[str, int, float]]:
    entries = [entry for entry in loop.read_metrics(run) if "loss" in entry]
    return sorted((entry["net"], entry["step"], entry["loss"]) for entry in entries)


# Kills -------------------------------------------------------------------------------------------------------


def killed(dataset: Path, run: Path, steps: int, net: str, rng: np.random.Generator) -> None:
    """One life of a run, killed at a random step of its network, or of either of both."""
    where, at = str(rng.choice(["affordance", "pose"])) if net == "both" else net, int(rng.integers(1, steps))
    command = [sys.executable, "-c", KILLED, str(dataset), str(run), str(steps), where, str(at), net]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, check=False)
    # A network that was past that step already is done in peace.
    assert done.returncode in (-signal.SIGKILL, 0), done.stderr


def test_a_training_killed_at_a_random_step_ends_with_the_bits_of_one_that_was_not(dataset: Path, tmp_path: Path) -> None:
    whole, run = train(dataset, tmp_path / "whole", 12, "pose"), tmp_path / "killed"
    killed(dataset, run, 12, "pose", np.random.default_rng(0))
    train(dataset, run, 12, "pose")
    assert weights(run) == weights(whole)
    assert losses(run) == losses(whole)


@pytest.mark.slow
def test_trainings_killed_ten_times_end_with_the_bits_of_one_that_was_not(dataset: Path, tmp_path: Path) -> None:
    whole = train(dataset, tmp_path / "whole", 60)
    for series in range(3):
        run, rng = tmp_path / str(series), np.random.default_rng(100 + series)
        for _ in range(4):
            killed(dataset, run, 60, "both", rng)
        train(dataset, run, 60)
        assert weights(run) == weights(whole)
        assert losses(run) == losses(whole)


# Cut off -----------------------------------------------------------------------------------------------------


def cut_off(dataset: Path, folder: Path, first: int, steps: int, net: str, every: bool = False) -> int:
    """How many crashes a training survived that goes on from `first` steps: before calls that change what is left, or all."""
    run, whole, number = folder / "run", folder / "whole", 0
    if first:
        shutil.copytree(train(dataset, run, first, net), whole)
    train(dataset, whole, steps, net)
    for look in crashes(lambda: train(dataset, run, steps, net), run, folder / "looks", every):
        for path in look.folder.glob("*.safetensors"):  # each is whole: the old one or the new
            with checkpoint.opened(path) as (file, _):
                assert all(file.get_tensor(key).isfinite().all() for key in file.keys())  # noqa: SIM118
        train(dataset, look.folder, steps, net)
        assert weights(look.folder) == weights(whole)
        assert losses(look.folder) == losses(whole)
        assert not [path for path in look.folder.rglob("*") if path.match(durable.TEMPORARY)]
        number += 1
    return number


def test_a_training_cut_off_at_any_call_goes_on_from_its_last_checkpoint(
    dataset: Path, in_memory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop, "draw_curves", lambda run: None)  # half a second each
    assert cut_off(dataset, in_memory, 1, 2, "pose") > 5


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 6])
def test_a_training_of_both_networks_cut_off_at_any_call_goes_on(
    dataset: Path, in_memory: Path, monkeypatch: pytest.MonkeyPatch, first: int
) -> None:
    monkeypatch.setattr(loop, "cores", lambda: 1)  # one after the other: calls in one order
    assert cut_off(dataset, in_memory, first, first + 6, "both", every=True) > 40


# A full disk, and two at once --------------------------------------------------------------------------------


def test_a_full_disk_leaves_the_last_checkpoint_and_says_so(dataset: Path, in_memory: Path) -> None:
    run = train(dataset, in_memory / "run", 1, "pose")
    before = {path.name: path.read_bytes() for path in run.glob("*.safetensors")}
    whole = Path(shutil.copytree(run, in_memory / "whole"))
    with files_of_at_most(20_000), pytest.raises(EnvironmentProblem, match=r"disk full.*about \d+ MB more.*again") as caught:
        train(dataset, run, 2, "pose")
    assert caught.value.exit_code == 6
    assert {path.name: path.read_bytes() for path in run.glob("*.safetensors")} == before
    assert not [path for path in run.iterdir() if path.match(durable.TEMPORARY)]
    train(dataset, run, 2, "pose")
    assert weights(run) == weights(train(dataset, whole, 2, "pose"))


def test_a_second_training_of_a_run_is_told_who_works(dataset: Path, tmp_path: Path) -> None:
    with durable.lock(tmp_path / "run"), pytest.raises(LockedError, match=f"process {os.getpid()} on ") as caught:
        train(dataset, tmp_path / "run", 1)
    assert caught.value.exit_code == 5


def test_a_log_that_a_power_cut_damaged_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    good = [json.dumps({"net": "pose", "step": step, "loss": loss}) for step, loss in ((5, 1.0), (10, 0.5))]
    text = "\n".join([good[0], "\x00\x00\x00", "[1]", '{"step": 3}', good[1], '{"net'])
    (tmp_path / "metrics.jsonl").write_bytes(text.encode() + b"\xff")
    assert losses(tmp_path) == [("pose", 5, 1.0), ("pose", 10, 0.5)]
    loop.keep_metrics(tmp_path, "pose", 5)
    assert (tmp_path / "metrics.jsonl").read_text() == good[0] + "\n"


def test_what_a_kill_left_of_an_empty_run_is_no_reason_to_refuse_it(dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/.config.json.123.tmp").write_text("{")
    (tmp_path / "run" / durable.LOCK).touch()
    checkpoint.check_run(tmp_path / "run", {})
    assert durable.is_occupied(dataset)
