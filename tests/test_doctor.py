"""`dapdata doctor` finds what is missing, says what to do about it, and needs neither the extras nor much time."""

from __future__ import annotations

import errno
import json
import os
import stat
import subprocess
import sys
from collections.abc import Iterable
from importlib.metadata import Distribution, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from test_architecture import HEAVY, ROOT

from dapdata import doctor
from dapdata.cli import run_app
from dapdata.errors import UsageError


def checks(found: Iterable[doctor.Check]) -> dict[str, doctor.Check]:
    """What was found, by name."""
    return {one.name: one for one in found}


def refusing(number: int):
    """A function of the system that is refused."""

    def refuse(*arguments: object, **named: object) -> None:
        raise OSError(number, os.strerror(number))

    return refuse


# The light install -----------------------------------------------------------------------------------------


def closure(names: list[str]) -> set[str]:
    """Names of packages and of all that they require."""
    found: set[str] = set()
    while names:
        name = names.pop()
        if name.lower() not in found:
            found.add(name.lower())
            wanted = [Requirement(line) for line in distribution(name).requires or ()]
            names += [r.name for r in wanted if r.marker is None or r.marker.evaluate({"extra": ""})]
    return found


def install(site: Path, names: set[str]) -> None:
    """Links installed packages into a folder that alone is on the path of an interpreter."""
    site.mkdir(exist_ok=True)
    for name in names:
        about = distribution(name)
        for top in {file.parts[0] for file in about.files or () if file.parts[0] not in ("..", "__pycache__")}:
            if not (site / top).exists():
                (site / top).symlink_to(Path(str(about.locate_file(top))).resolve())


@pytest.fixture(scope="module")
def light(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The packages of `pip install .`, without any extra."""
    site = tmp_path_factory.mktemp("light") / "site"
    install(site, closure([r.name for r in doctor.requirements()[""]]))
    return site


def run_light(site: Path, *arguments: str) -> tuple[int, dict]:
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": f"{site}:{ROOT}", "HOME": str(site)}
    command = [sys.executable, "-S", "-m", "dapdata", "doctor", "--json", *arguments]
    done = subprocess.run(command, env=environment, cwd=site.parent, capture_output=True, text=True, check=False)
    return done.returncode, json.loads(done.stdout) if done.stdout else {"stderr": done.stderr}


def test_the_light_install_is_enough_and_says_what_the_extras_would_bring(light: Path) -> None:
    code, found = run_light(light)
    told = {one["name"]: one for one in found["checks"]}
    assert (code, found["ok"]) == (0, True)
    assert told["packages"]["state"] == "ok"
    assert told["extra sim"]["state"] == told["extra train"]["state"] == "note"
    assert told["extra sim"]["remedy"].endswith("pip install 'dapdata[sim]'")


def test_an_extra_that_was_asked_for_must_be_there(light: Path) -> None:
    code, found = run_light(light, "--extra", "train")
    missing = {one["name"] for one in found["checks"] if one["state"] == "problem"}
    assert code == 6
    assert missing == {f"train: {r.name}" for r in doctor.requirements()["train"]}


def test_an_extra_of_which_one_package_is_missing_is_broken(light: Path, tmp_path: Path) -> None:
    pytest.importorskip("open3d")
    site = tmp_path / "site"
    site.mkdir()
    for path in light.iterdir():
        (site / path.name).symlink_to(path.resolve())
    sim = {r.name for r in doctor.requirements()["sim"]}
    install(site, sim - {"pybullet"})
    code, found = run_light(site)
    problems = [one for one in found["checks"] if one["state"] == "problem"]
    assert code == 6
    assert [(one["name"], one["found"]) for one in problems] == [("sim: pybullet", "not installed")]
    assert problems[0]["remedy"] == "run: pip install 'dapdata[sim]'"


def test_nothing_heavy_is_imported() -> None:
    code = "import sys; from dapdata.doctor import examine; examine(); print(*{name.split('.')[0] for name in sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {*HEAVY, "numpy", "pydantic"} & set(done.stdout.split())


# Packages --------------------------------------------------------------------------------------------------


def packaged(folder: Path, tag: str = "py3-none-any", size: int = 4) -> Distribution:
    """An installed package with a native library of four bytes, which should have `size`."""
    about = folder / "thing-1.5.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: thing\nVersion: 1.5\n")
    (about / "WHEEL").write_text(f"Wheel-Version: 1.0\nTag: {tag}\n")
    (about / "RECORD").write_text(f"thing/core.so,sha256=x,{size}\nthing/__init__.py,sha256=y,0\n")
    (folder / "thing").mkdir()
    (folder / "thing/core.so").write_bytes(b"code")
    return Distribution.at(about)


def fault(found: Distribution | None, wanted: str = "thing>=1.2") -> doctor.Check | None:
    return doctor._fault(Requirement(wanted), found, {"py3-none-any"}, "dapdata[sim]")


def test_a_package_as_it_should_be_is_no_fault(tmp_path: Path) -> None:
    assert fault(packaged(tmp_path)) is None


def test_packages_that_are_not_as_they_should_be_are_named_with_what_to_do(tmp_path: Path) -> None:
    absent, old = fault(None), fault(packaged(tmp_path / "old"), "thing>=2")
    foreign = fault(packaged(tmp_path / "foreign", tag="cp27-cp27m-win32"))
    cut = fault(packaged(tmp_path / "cut", size=5))
    assert all(one is not None and one.state == "problem" and one.expected for one in (absent, old, foreign, cut))
    assert absent.remedy == "run: pip install 'dapdata[sim]'"  # type: ignore[union-attr]
    assert (old.found, old.expected) == ("1.5", ">=2")  # type: ignore[union-attr]
    assert "cp27-cp27m-win32" in foreign.found  # type: ignore[union-attr]
    assert cut.found == "thing/core.so: missing or cut"  # type: ignore[union-attr]
    assert cut.remedy == "run: pip install --force-reinstall 'thing>=1.2'"  # type: ignore[union-attr]


def test_an_unknown_extra_is_refused_with_the_known_ones() -> None:
    with pytest.raises(UsageError, match=r"expected one of .*sim.*did you mean 'sim'"):
        doctor.examine(extras=["simm"])


# The machine -----------------------------------------------------------------------------------------------


def test_every_remark_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "FREE_GB", 1e9)
    monkeypatch.setattr(doctor, "FREE_INODES", 10**15)
    monkeypatch.setattr(doctor, "WORKER_MB", 10**9)
    monkeypatch.setattr(doctor, "SHM_MB", 10**9)
    found = doctor.examine(tmp_path)
    assert {one.name for one in found.problems} >= {"disk", "inodes", "memory"}
    assert all(one.remedy and one.expected for one in found.problems)
    assert all(one.remedy for one in found.checks if one.state == "note")
    assert str(found).endswith("marked !!")


def test_a_container_with_little_memory_is_told_how_many_workers_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = {"/sys/fs/cgroup/memory.max": ["1400000000"], "/sys/fs/cgroup/memory.current": ["100000000"]}
    lines = doctor._lines
    monkeypatch.setattr(doctor, "_lines", lambda path: limits.get(path) or lines(path))
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)))
    found = checks(doctor._machine())["memory"]
    assert (found.state, found.remedy) == ("note", "close programs, or use: --workers 2")


def test_cards_are_told_and_a_torch_that_cannot_use_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tool = tmp_path / "nvidia-smi"
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    (tmp_path / "torch").mkdir()
    monkeypatch.setattr(
        doctor, "_distribution", lambda name: packaged(tmp_path / str(os.urandom(4).hex())) if name == "torch" else None
    )
    for line, code, state in (("A card, 16 GB, 600.1", 0, "note"), ("", 9, "note")):
        tool.write_text(f"#!/bin/sh\necho '{line}'\nexit {code}\n")
        tool.chmod(tool.stat().st_mode | stat.S_IXUSR)
        (found,) = doctor._gpu()
        assert found.state == state
        assert ("A card" in found.found and "built for the CPU" in found.found) or "does not answer" in found.found
    monkeypatch.setattr(doctor, "_cuda_of", lambda torch: "12.6")
    tool.write_text("#!/bin/sh\necho 'A card, 16 GB, 600.1'\n")
    (found,) = doctor._gpu()
    assert (found.state, found.found) == ("ok", "A card, 16 GB, 600.1; torch is built for CUDA 12.6")


def test_what_torch_is_built_for_is_read_from_its_text(tmp_path: Path) -> None:
    about = packaged(tmp_path)
    (tmp_path / "torch").mkdir()
    for text, expected in (("cuda: Optional[str] = None\n", None), ("cuda: Optional[str] = '12.6'\nhip = None\n", "12.6")):
        (tmp_path / "torch/version.py").write_text(f"__version__ = '2.9'\n{text}")
        assert doctor._cuda_of(about) == expected


# The disk --------------------------------------------------------------------------------------------------


def test_a_folder_is_tried_and_left_as_it_was(tmp_path: Path) -> None:
    found = checks(doctor._disk(tmp_path / "not" / "yet" / "there"))
    assert {found[name].state for name in ("rename", "fsync", "lock", "hard links", "disk")} == {"ok"}
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("module", "function", "name", "state"),
    [
        ("os", "fsync", "fsync", "problem"),
        ("os", "link", "hard links", "note"),
        ("fcntl", "flock", "lock", "problem"),
        ("pathlib.Path", "rename", "rename", "problem"),
    ],
)
def test_a_file_system_that_refuses_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str, function: str, name: str, state: str
) -> None:
    monkeypatch.setattr(f"{module}.{function}", refusing(errno.ENOTSUP))
    found = checks(doctor._disk(tmp_path))[name]
    assert (found.state, found.found) == (state, os.strerror(errno.ENOTSUP))
    assert found.remedy


def test_a_file_system_that_pretends_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fcntl.flock", lambda file, how: None)
    assert checks(doctor._disk(tmp_path))["lock"].found == "two locks on one file at the same time"
    monkeypatch.setattr(Path, "rename", lambda self, target: self)
    assert checks(doctor._disk(tmp_path))["rename"].state == "problem"


def test_a_folder_that_cannot_be_written_is_a_problem(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_app(["doctor", "--out", "/proc/here"]) == 6
    assert "!!  writing:               /proc: " in capsys.readouterr().out


def test_the_command_ends_well_where_nothing_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = doctor.examine(tmp_path)
    code = run_app(["doctor", "--out", str(tmp_path), "--json"])
    assert code == (0 if found.ok else 6)
    told = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in told["checks"]] == [one.name for one in found.checks]
