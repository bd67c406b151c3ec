"""Benchmarks: rivals are timed in turn, ratios are taken within a round, and every script says what it claims."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import ModuleType

import pytest

from dapdata import bench
from dapdata.errors import EnvironmentProblem, UsageError

SCRIPTS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def timing(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(SCRIPTS))
    return importlib.import_module("timing")


def test_contenders_run_in_turn(timing: ModuleType) -> None:
    order: list[str] = []
    contenders = {name: lambda name=name: order.append(name) for name in "ab"}
    timing.compare("x", "y", contenders, rounds=3)
    assert order == list("ab" * 4)  # once unmeasured, then three rounds


def test_ratios_are_taken_within_a_round(timing: ModuleType) -> None:
    ours, rival = timing.rows("x", "y", {"dapdata": [1.0, 10.0, 100.0], "rival": [2.0, 30.0, 400.0]}, "CPU ms")
    assert ours.ratio is None
    assert (rival.ratio_low, rival.ratio, rival.ratio_high) == (2.0, 3.0, 4.0)
    assert (ours.low, ours.median, ours.high) == (1.0, 10.0, 100.0)


def test_published_figures_are_marked_and_compared(timing: ModuleType) -> None:
    (ours,) = timing.rows("x", "y", {"dapdata": [1.0, 2.0, 4.0]}, "CPU ms")
    row = timing.published(ours, "elsewhere", 8.0, "a note")
    assert (row.rounds, row.ratio, row.ratio_low, row.ratio_high) == (0, 4.0, 2.0, 8.0)
    assert "published" in bench.table([vars(row)])


def test_choosing_a_rival_keeps_ours(timing: ModuleType) -> None:
    contenders = dict.fromkeys(("dapdata", "a", "b"), lambda: None)
    assert list(timing.chosen(contenders, "b")) == ["dapdata", "b"]
    assert list(timing.chosen(contenders, None)) == ["dapdata", "a", "b"]


def test_every_script_is_run_and_every_run_has_a_script() -> None:
    others = {
        "timing",  # what the scripts share
        "ablations",  # measured in success, and takes hours
        "scale",  # needs gigabytes of disk, and prints docs/scale.md's tables
    }
    assert {path.stem for path in SCRIPTS.glob("*.py")} == {*bench.RIVALS, *others}


def test_every_named_rival_occurs_in_its_script() -> None:
    for script, names in bench.RIVALS.items():
        source = (SCRIPTS / f"{script}.py").read_text(encoding="utf-8")
        assert all(name.split(" ")[-1] in source for name in names), script


def test_rows_come_from_a_real_script() -> None:
    pytest.importorskip("numba")
    pytest.importorskip("pybullet")
    rows = list(bench.run(against="tinyrenderer", scale="quick"))
    assert {row["name"] for row in rows} == {"dapdata", "tinyrenderer"}
    assert all(row["low"] <= row["median"] <= row["high"] for row in rows)
    text = bench.table(rows)
    assert len(text.splitlines()) == len(rows) + 1
    assert json.dumps(rows)


def test_an_unknown_rival_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(UsageError, match="did you mean 'tinyrenderer'"):
        list(bench.run(against="tinyrender"))


def test_without_a_source_tree_the_error_says_where_to_get_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bench, "__file__", str(tmp_path / "dapdata" / "bench.py"))
    with pytest.raises(EnvironmentProblem, match="clone the repository"):
        bench.folder()


def test_a_script_that_fails_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(bench, "folder", lambda: tmp_path)
    monkeypatch.setattr(bench, "RIVALS", {"broken": ("rival",)})
    (tmp_path / "broken.py").write_text("raise ValueError('no such camera')", encoding="utf-8")
    with pytest.raises(EnvironmentProblem, match=r"broken\.py.*no such camera"):
        list(bench.run())


def test_the_machine_is_described() -> None:
    about = bench.machine()
    assert {"processor", "cores", "load average", "python", "numpy"} <= set(about)
