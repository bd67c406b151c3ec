"""The local pool: a worker's death costs its own job and nothing else."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dapdata import engines
from dapdata.errors import LockedError, UsageError

CALL = "test_engines:behave"


def behave(text: str) -> str:
    """What a job asks for; runs in the worker."""
    job = json.loads(text)
    if job["do"] == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if job["do"] == "exit":
        os._exit(7)
    if job["do"] == "hang":
        time.sleep(100)
    if job["do"] == "raise":
        print("a word on stderr", file=sys.stderr)
        raise ValueError("no such luck")
    if job["do"] == "user":
        return json.dumps({"error": ["LockedError", "in use by process 1"]})
    return json.dumps({"number": job["number"], "threads": os.environ["OMP_NUM_THREADS"]})


def run(actions: list[str], workers: int = 2) -> tuple[list[int], list[engines.Failure]]:
    answers: list[int] = []
    jobs = [engines.Job(json.dumps({"do": do, "number": i}), 2.0 if do == "hang" else 60.0) for i, do in enumerate(actions)]

    def on_done(job: engines.Job, answer: str) -> None:
        assert json.loads(answer)["threads"] == "1"
        answers.append(json.loads(answer)["number"])

    failures = engines.get("local").run(CALL, jobs, workers=workers, on_done=on_done)
    return sorted(answers), failures


def test_all_jobs_are_done_and_bad_ones_are_given_up_with_their_reason() -> None:
    answers, failures = run(["fine", "kill", "fine", "exit", "raise", "hang", "fine"])
    assert answers == [0, 2, 6]
    reasons = {json.loads(failure.job.text)["do"]: failure.reason for failure in failures}
    assert reasons["kill"] == "killed by SIGKILL"
    assert reasons["exit"] == "exited with code 7"
    assert reasons["raise"] == "ValueError: no such luck"
    assert reasons["hang"] == "no answer in 2 s"
    assert "a word on stderr" in next(f.stderr for f in failures if f.reason.startswith("ValueError"))


def test_an_error_that_is_the_users_is_raised_as_it_is() -> None:
    with pytest.raises(LockedError, match="in use by process 1"):
        run(["user"], workers=1)


def test_an_unknown_engine_is_named() -> None:
    with pytest.raises(UsageError, match=r"engine: got 'locl'.*did you mean 'local'"):
        engines.get("locl")


def test_a_script_without_a_main_guard_does_not_start_itself_again(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "print('started')\n"
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from dapdata import engines\n"
        'jobs = [engines.Job(\'{"do": "fine", "number": 4}\', 60)]\n'
        "engines.get('local').run('test_engines:behave', jobs, workers=1, on_done=lambda job, text: print(text))\n"
        "print(__file__ == sys.argv[0])\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.splitlines() == ["started", '{"number": 4, "threads": "1"}', "True"]


def test_workers_end_with_a_parent_that_was_killed(tmp_path: Path) -> None:
    script = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "from dapdata import engines\n"
        "print('go', flush=True)\n"
        "engines.get('local').run('test_engines:behave', [engines.Job('{\"do\": \"hang\"}', 60)], workers=1, on_done=print)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    assert parent.stdout.readline() == "go\n"
    children = wait_for(lambda: children_of(parent.pid))
    parent.kill()
    parent.wait()
    parent.stdout.close()
    assert wait_for(lambda: not any(alive(child) for child in children))


def children_of(pid: int) -> list[int]:
    """Worker processes: children that load this package, not the tracker of shared resources."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])
            command = (folder / "cmdline").read_text()
        except OSError:
            continue
        if parent == pid and "spawn_main" in command:
            found.append(int(folder.name))
    return found


def alive(pid: int) -> bool:
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False


def wait_for(condition: object, seconds: float = 30.0) -> object:
    """The condition's value once it is true."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        value = condition()  # type: ignore[operator]
        if value:
            return value
        time.sleep(0.05)
    raise AssertionError("it did not happen")
