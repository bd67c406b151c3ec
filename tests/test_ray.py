"""A Ray cluster does what this machine does: the same content, the same words for what fails, one try for a lost worker."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from bad_jobs import KINDS, MEMORY
from conftest import make_toy
from toy_stages import toy_recipe

from dapdata import engines, health, manifest, pipeline
from dapdata.errors import EnvironmentProblem, LockedError

pytest.importorskip("ray")
HERE = str(Path(__file__).parent)
TABLE = "toy_stages"


def content(root: Path) -> str:
    return manifest.read(root).content_sha256


@pytest.fixture
def own_ray(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder of Ray in which nobody else's cluster is found; workers find our modules."""
    with tempfile.TemporaryDirectory(prefix="r", dir="/tmp") as folder:  # Ray's sockets need a short path
        monkeypatch.delenv("RAY_ADDRESS", raising=False)
        monkeypatch.setenv("RAY_TMPDIR", folder)
        monkeypatch.setenv("HOME", folder)  # where Ray keeps the token of the clusters that it starts
        monkeypatch.setenv("PYTHONPATH", f"{HERE}:{os.environ.get('PYTHONPATH', '')}")
        yield Path(folder) / "ray"


@pytest.mark.usefixtures("own_ray")
def test_a_cluster_whose_worker_is_killed_ends_with_the_content_of_a_serial_run(
    toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fault kills the worker of Ray, the parent of the process that works on the unit, in the middle of that unit."""
    note = tmp_path / "killed"
    monkeypatch.setenv("TOY_FAULT", f"kill_parent:4:{note}")
    root = tmp_path / "toy"
    pipeline.generate(toy_recipe(8), root, engine="ray", workers=2, table=TABLE)
    assert note.exists()
    pipeline.label(root, engine="inline", table=TABLE)
    assert content(root) == content(toy)
    assert health.verify(root).ok


@pytest.mark.parametrize("name", ["ray", "ray://127.0.0.1:1", "ray://nowhere.invalid:10001"])
def test_a_cluster_that_cannot_be_reached_is_an_error_that_says_so(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    begin = time.monotonic()
    with pytest.raises(EnvironmentProblem, match=r"no Ray cluster could be joined .*expected one of the same Ray and"):
        engines.get(name).run("bad_jobs:behave", [engines.Job("{}", 1)], workers=1, on_done=print)
    assert time.monotonic() - begin < 30


# One cluster for the rest ----------------------------------------------------------------------------------


def free_ports(count: int) -> list[int]:
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


@pytest.fixture(scope="module")
def cluster() -> Iterator[tuple[str, str]]:
    """A running cluster of three workers, by its own address and by that of Ray Client."""
    port, client = free_ports(2)
    with tempfile.TemporaryDirectory(prefix="r", dir="/tmp") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_TMPDIR", folder)
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_AUTH_MODE", "disabled")  # it listens on loopback alone
        patch.setenv("PYTHONPATH", f"{HERE}:{os.environ.get('PYTHONPATH', '')}")
        options = [f"--port={port}", f"--ray-client-server-port={client}", "--num-cpus=3", "--node-ip-address=127.0.0.1"]
        command = [
            "ray",
            "start",
            "--head",
            "--block",
            "--include-dashboard=false",
            "--object-store-memory=100000000",
            *options,
        ]
        head = subprocess.Popen(
            [sys.executable, "-c", "from ray.scripts.scripts import main; main()", *command[1:]],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        try:
            for address in (port, client):
                wait_for_port(address)
            yield f"127.0.0.1:{port}", f"ray://127.0.0.1:{client}"
        finally:
            os.killpg(head.pid, signal.SIGTERM)
            head.wait(60)


def wait_for_port(port: int, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), 1.0).close()
            return
        except OSError:
            assert time.monotonic() < end, "Ray did not start"
            time.sleep(0.2)


@pytest.fixture(params=["joined", "client"])
def engine(request: pytest.FixtureRequest, cluster: tuple[str, str], monkeypatch: pytest.MonkeyPatch) -> str:
    """The engine's name, once for a cluster that runs here and once for Ray Client."""
    monkeypatch.setenv("RAY_ADDRESS", cluster[0])
    return "ray" if request.param == "joined" else cluster[1]


@pytest.mark.slow
def test_a_running_cluster_ends_with_the_content_of_a_serial_run(
    engine: str, toy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # paths are told to the nodes in full
    done: list[tuple[int, int]] = []
    pipeline.generate(toy_recipe(8), "toy", engine=engine, table=TABLE, workers=None, progress=lambda *n: done.append(n))
    pipeline.label("toy", engine=engine, table=TABLE, workers=2)
    assert content(tmp_path / "toy") == content(toy)
    assert (done[0], done[-1]) == ((0, 8), (8, 8))
    assert health.status("toy").to_dict()["cpu_seconds"].keys() == {"demonstrate", "observe", "cluster", "label"}


@pytest.mark.slow
def test_failures_are_told_as_they_are_locally(engine: str) -> None:
    actions = ["fine", *KINDS, "forking child", "fine"]
    jobs = [
        engines.Job(json.dumps({"do": do, "number": i, "note": os.devnull}), 1.0 if do == "hang" else 60.0, MEMORY)
        for i, do in enumerate(actions)
    ]
    answers: list[dict[str, object]] = []
    failures = engines.get(engine).run(
        "bad_jobs:behave", jobs, workers=None, on_done=lambda _, text: answers.append(json.loads(text))
    )
    assert sorted(answer["number"] for answer in answers) == [0, len(KINDS) + 1, len(KINDS) + 2]  # type: ignore[type-var]
    assert {answer["threads"] for answer in answers} == {"1"}
    reasons = {json.loads(failure.job.text)["do"]: failure.reason for failure in failures}
    assert {do: KINDS[do] in reason for do, reason in reasons.items()} == dict.fromkeys(KINDS, True)
    assert "a word on stderr" in next(f.stderr for f in failures if f.reason.startswith("ValueError"))


@pytest.mark.slow
def test_an_error_that_is_the_users_is_raised_and_stops_the_others(engine: str) -> None:
    jobs = [engines.Job(json.dumps({"do": do, "number": 0}), 1000.0) for do in ("hang", "user")]
    begin = time.monotonic()
    with pytest.raises(LockedError, match="in use by process 1"):
        engines.get(engine).run("bad_jobs:behave", jobs, workers=2, on_done=print)
    assert time.monotonic() - begin < 200


@pytest.mark.slow
def test_a_node_without_dapdata_is_an_error_that_says_so(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import dapdata.engines.on_ray as here

    monkeypatch.setattr(here._attempt, "__module__", "not_installed_there")
    monkeypatch.setitem(sys.modules, "not_installed_there", here)
    with pytest.raises(
        EnvironmentProblem,
        match=r"cannot work \(.*No module named 'not_installed_there'\), expected the same Python and dapdata",
    ):
        engines.get(engine).run("bad_jobs:behave", [engines.Job("{}", 10)], workers=1, on_done=print)


@pytest.mark.slow
def test_ctrl_c_ends_what_runs_on_the_cluster(engine: str, tmp_path: Path) -> None:
    note = tmp_path / "note"
    job = json.dumps({"do": "note and hang", "number": 0, "note": str(note)})
    script = (
        "import sys; from dapdata import engines\n"
        "engines.get(sys.argv[1]).run('bad_jobs:behave', [engines.Job(sys.argv[2], 1000)], workers=1, on_done=print)"
    )
    command = subprocess.Popen([sys.executable, "-c", script, engine, job], stderr=subprocess.PIPE)
    wait_until(lambda: note.exists() and note.read_text())
    command.send_signal(signal.SIGINT)
    _, said = command.communicate(timeout=60)
    assert command.returncode != 0
    assert b"KeyboardInterrupt" in said
    wait_until(lambda: not Path("/proc", note.read_text()).exists())


def wait_until(condition: object, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.1)


@pytest.mark.slow
def test_a_cluster_that_went_away_without_a_word_is_not_waited_for(own_ray: Path, tmp_path: Path) -> None:
    """What `ray start` left behind when the machine was switched off: a note of an address where nobody is."""
    own_ray.mkdir()
    (own_ray / "ray_current_cluster").write_text("127.0.0.1:1")
    assert health.verify(make_toy(tmp_path / "toy", engine="ray")).ok
