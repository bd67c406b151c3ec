"""The local engine: whatever happens to a job costs that job and nothing else, and nothing outlives the command."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from bad_jobs import KINDS, MEMORY

from dapdata import engines
from dapdata.engines import child, local
from dapdata.errors import LockedError, MissingExtraError, UsageError

CALL = "bad_jobs:behave"
HERE = str(Path(__file__).parent)


def run(actions: list[str], workers: int = 2, note: Path | None = None) -> tuple[list[int], dict[str, engines.Failure]]:
    """The numbers of the jobs that were answered, and those that were given up by what they did."""
    answers: list[int] = []
    jobs = [
        engines.Job(json.dumps({"do": do, "number": i, "note": str(note)}), 1.0 if do == "hang" else 60.0, MEMORY)
        for i, do in enumerate(actions)
    ]

    def on_done(job: engines.Job, answer: str) -> None:
        told = json.loads(answer)
        assert told["number"] == json.loads(job.text)["number"]
        assert told["threads"] == "1"
        answers.append(told["number"])

    failures = engines.get("local").run(CALL, jobs, workers=workers, on_done=on_done)
    return sorted(answers), {json.loads(failure.job.text)["do"]: failure for failure in failures}


def test_whatever_happens_to_a_job_costs_that_job_alone() -> None:
    answers, failures = run(["fine", *KINDS, "fine"])
    assert answers == [0, len(KINDS) + 1]
    assert {do: KINDS[do] in failure.reason for do, failure in failures.items()} == dict.fromkeys(KINDS, True)
    assert "a word on stderr" in failures["raise"].stderr


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_a_bad_job_of_any_kind_is_given_up_while_the_others_are_done(kind: str, workers: int) -> None:
    answers, failures = run(["fine", "fine", kind, "fine", "fine"], workers)
    assert answers == [0, 1, 3, 4]
    assert [KINDS[kind] in failure.reason for failure in failures.values()] == [True]


@pytest.mark.parametrize("workers", [1, 2])
def test_what_a_job_forks_neither_holds_it_up_nor_outlives_it(workers: int, tmp_path: Path) -> None:
    started = time.monotonic()
    answers, failures = run(["fine", "forking child", "copy of itself", "fine"], workers, tmp_path / "note")
    assert (answers, failures) == ([0, 1, 2, 3], {})
    assert time.monotonic() - started < 60
    assert wait_for(lambda: not alive(int((tmp_path / "note").read_text())))


def test_a_job_is_tried_three_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tries = []
    monkeypatch.setattr(
        local.Child, "begin", lambda self, call, job, memory: (tries.append(job), begin(self, call, job, memory))
    )
    assert list(run(["raise"])[1]) == ["raise"]
    assert len(tries) == 1 + engines.RETRIES == 3


begin = child.Child.begin


def test_workers_are_kept_for_other_jobs_and_replaced_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "MAX_JOBS", 2)
    processes: list[int] = []
    jobs = [engines.Job(json.dumps({"do": "fine", "number": i}), 60.0) for i in range(5)]
    engines.get("local").run(CALL, jobs, workers=1, on_done=lambda _, text: processes.append(json.loads(text)["process"]))
    assert [processes.count(process) for process in dict.fromkeys(processes)] == [2, 2, 1]


def test_an_error_that_is_the_users_is_raised_as_it_is() -> None:
    with pytest.raises(LockedError, match="in use by process 1"):
        run(["user"], workers=1)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("locl", r"engine: got 'locl', expected one of local, inline, ray, ray://HOST:PORT; did you mean 'local'"),
        ("ray://head", r"engine: got 'ray://head', expected the address of a Ray cluster such as ray://head-node:10001"),
    ],
)
def test_an_unknown_engine_is_named(name: str, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        engines.get(name)


@pytest.mark.parametrize("name", ["ray", "ray://head:10001"])
def test_without_ray_its_engine_says_what_to_install(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'dapdata\[ray\]'"):
        engines.get(name)


# Memory ----------------------------------------------------------------------------------------------------


def test_workers_share_most_of_the_memory_that_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    monkeypatch.setattr(child, "_limits_of_cgroups", lambda: iter(()))
    assert child.share(4) == pytest.approx(0.8 * machine / 4)
    monkeypatch.setattr(child, "_limits_of_cgroups", lambda: iter((1e9, 2.0**63)))
    assert child.share(4) == pytest.approx(0.2e9)


def test_a_limit_of_any_control_group_around_counts(tmp_path: Path) -> None:
    (tmp_path / "job/step").mkdir(parents=True)
    (tmp_path / "job/memory.max").write_text("2000000000\n")
    (tmp_path / "job/step/memory.max").write_text("max\n")
    assert list(child._limits_upwards(tmp_path, "/job/step", "memory.max")) == [2e9]


# Ends ------------------------------------------------------------------------------------------------------


def test_a_script_without_a_main_guard_does_not_start_itself_again(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "print('started')\n"
        f"import sys; sys.path.insert(0, {HERE!r})\n"
        "from dapdata import engines\n"
        'jobs = [engines.Job(\'{"do": "fine", "number": 4}\', 60)]\n'
        "print(engines.get('local').run('bad_jobs:behave', jobs, workers=1, on_done=lambda job, text: print(text[:12])))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.splitlines() == ["started", '{"number": 4', "[]"]


COMMAND = f"""
import json, sys
sys.path.insert(0, {HERE!r})
from dapdata import engines
job = engines.Job(json.dumps({{"do": sys.argv[1], "number": 0, "note": sys.argv[2]}}), 1000)
other = engines.Job(json.dumps({{"do": "hang", "number": 1}}), 1000)
engines.get("local").run("bad_jobs:behave", [job, other], workers=1, on_done=print)
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT], ids=lambda number: number.name)
def test_workers_and_what_they_forked_end_with_a_command_that_was_killed(tmp_path: Path, number: signal.Signals) -> None:
    note = tmp_path / "note"
    command = subprocess.Popen([sys.executable, "-c", COMMAND, "forking child", note], stderr=subprocess.DEVNULL)
    wait_for(lambda: note.exists() and note.read_text())
    family = [int(note.read_text()), *children_of(command.pid)]
    assert len(family) == 2
    command.send_signal(number)
    command.wait(30)
    assert wait_for(lambda: not any(alive(process) for process in family))


def children_of(pid: int) -> list[int]:
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            found += [int(folder.name)] if stat_of(int(folder.name))[1] == str(pid) else []
        except OSError:
            continue
    return found


def alive(pid: int) -> bool:
    try:
        return stat_of(pid)[0] not in "ZX"
    except OSError:
        return False


def stat_of(pid: int) -> list[str]:
    """State, parent, and so on."""
    return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()


def wait_for(condition: object, seconds: float = 60.0) -> object:
    """The condition's value once it is true."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        value = condition()  # type: ignore[operator]
        if value:
            return value
        time.sleep(0.05)
    raise AssertionError("it did not happen")
