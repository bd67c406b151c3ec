"""Sample efficiency on the tiny dataset: nested demos, one judge, nothing done twice, refusals before any work."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("torch")
pytest.importorskip("safetensors")

from test_evaluation import Links
from training_samples import TINY

from dapdata import cli
from dapdata.errors import CheckpointError, FormatError, UsageError
from dapdata.report import read_report
from daptrain import checkpoint
from daptrain import curve as curves
from daptrain.curve import Curve, curve

JUDGING: dict[str, Any] = {"split": "val", "k": 2, "device": "cpu"}


def quiet(line: str) -> None:
    """Says nothing."""


def made(data: Path, out: Path, *sizes: int, **changes: Any) -> dict[str, Any]:
    options = {"steps": 2, "config": TINY, "say": quiet, **JUDGING, **changes}
    return curve(data, out, list(sizes), **options)


@pytest.fixture(scope="module")
def done(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished curve of two sizes. Not to be changed."""
    out = tmp_path_factory.mktemp("curve") / "out"
    made(tiny, out, 3, 1)
    return out


@pytest.fixture
def copy(done: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(done, tmp_path / "copy"))


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any training or judging is an error."""

    def never(*args: Any, **options: Any) -> None:
        raise AssertionError("work was done")

    monkeypatch.setattr(curves, "train", never)
    monkeypatch.setattr(curves, "evaluate", never)


def test_a_curve_leaves_a_run_and_a_report_for_each_size_and_all_of_them_together(done: Path) -> None:
    found = Curve.model_validate_json((done / "curve.json").read_text())
    assert [point.demos for point in found.points] == [1, 3]
    for point in found.points:
        run = done / "curve" / str(point.demos)
        report = read_report(run / "report.json")
        assert point.success == report.success
        assert point.recall == report.modes.recall_at_K
        assert point.cost.demos_used == report.cost.demos_used == point.demos
        assert checkpoint.read_description(run)["train"]["demos"] == point.demos
    assert set(found.references) == {"oracle", "random", "heuristic"}
    assert found.references["oracle"].success.success_top1.value == 1
    assert (done / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_references_are_judged_once_and_scenes_are_the_same(done: Path) -> None:
    first, second = (read_report(done / f"curve/{demos}/report.json") for demos in (1, 3))
    assert first.split == second.split
    assert set(first.references) == {"oracle", "random", "heuristic"}
    assert set(second.references) == {"oracle"}, "which the judge itself needs"


def test_the_page_needs_no_network_and_links_to_the_reports(done: Path) -> None:
    links = Links()
    links.feed((done / "curve.html").read_text())
    assert not links.open
    reports = [link for link in links.loads if not link.startswith(("data:", "#"))]
    assert reports == ["curve/1/report.html", "curve/3/report.html"]
    assert all((done / report).exists() for report in reports)


@pytest.mark.usefixtures("idle")
def test_what_is_done_is_not_done_again(tiny: Path, copy: Path) -> None:
    before = json.loads((copy / "curve.json").read_text())
    assert made(tiny, copy, 1, 3) == before
    assert made(tiny, copy, 3) == before, "a size that was not asked for again stays on the curve"


def test_another_size_is_added_and_the_others_left(tiny: Path, copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trained = []
    train = curves.train
    monkeypatch.setattr(curves, "train", lambda *args, **options: trained.append(args[1].name) or train(*args, **options))
    (copy / "curve.png").unlink()
    found = made(tiny, copy, 1, 2, 3)
    assert trained == ["2"]
    assert [point["demos"] for point in found["points"]] == [1, 2, 3]
    assert set(read_report(copy / "curve/2/report.json").references) == {"oracle"}
    assert (copy / "curve.png").exists()


def test_with_other_scenes_or_candidates_everything_is_judged_again_but_not_trained(
    tiny: Path, copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (copy / "curve/3/pose.state.safetensors").read_bytes()
    found = made(tiny, copy, 1, 3, k=3)
    assert found["asked"]["judging"]["k"] == 3
    assert list(found["points"][0]["recall"]) == ["1", "2", "3"]
    assert found["references"]["heuristic"]["recall"].keys() == found["points"][0]["recall"].keys()
    assert (copy / "curve/3/pose.state.safetensors").read_bytes() == before


def test_a_curve_that_was_stopped_goes_on(tiny: Path, done: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*args: Any, **options: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(curves, "evaluate", stopped)
        with pytest.raises(KeyboardInterrupt):
            made(tiny, tmp_path / "out", 1, 3)
    with pytest.raises(CheckpointError, match="steps 2, now it is 5"):  # not with half of it trained for longer
        made(tiny, tmp_path / "out", 1, 3, steps=5)
    found = made(tiny, tmp_path / "out", 1, 3)
    whole = json.loads((done / "curve.json").read_text())
    assert [point["success"] for point in found["points"]] == [point["success"] for point in whole["points"]]


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize(
    ("sizes", "options", "says"),
    [
        ((2, 4, 9), {}, r"got 4, 9 demos, the train split of .* holds 3; expected sizes from 1 to 3"),
        ((0,), {}, "expected sizes from 1 to 3"),
        ((), {}, "got no sizes"),
        ((1,), {"steps": None, "minutes": 0}, "minutes: got 0"),
        ((1,), {"method": "oracle"}, "learns nothing"),
        ((1,), {"draws": 1}, r"draws: got 1, expected at least k \(2\)"),
        ((1,), {"split": "all"}, "split: got 'all'"),
    ],
    ids=str,
)
def test_what_cannot_be_done_is_refused_before_any_work(
    tiny: Path, tmp_path: Path, sizes: tuple[int, ...], options: dict[str, Any], says: str
) -> None:
    with pytest.raises(UsageError, match=says) as caught:
        made(tiny, tmp_path / "out", *sizes, **options)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"steps": 3}, "steps 2, now it is 3"),
        ({"steps": None, "minutes": 1.0}, "minutes None, now it is 1.0"),
        ({"method": "cap"}, "method dap, now it is cap"),
        ({"config": TINY.model_copy(update={"width": 32})}, "width 16, now it is 32"),
    ],
    ids=str,
)
def test_a_curve_of_another_training_is_refused(tiny: Path, copy: Path, changes: dict[str, Any], says: str) -> None:
    with pytest.raises(CheckpointError, match=says):
        made(tiny, copy, 1, 3, **changes)


@pytest.mark.usefixtures("idle")
def test_a_folder_of_something_else_is_not_written_into(tiny: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("all of it")
    with pytest.raises(UsageError, match="is no curve"):
        made(tiny, tmp_path, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]
    (tmp_path / "curve.json").write_text("{}")
    with pytest.raises(FormatError, match=r"curve\.json: .*expected format"):
        made(tiny, tmp_path, 1)


# The command ---------------------------------------------------------------------------------------------------


def test_the_command_takes_dataset_sizes_and_budget(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    small = [f"--set=train.{key}={json.dumps(value)}" for key, value in TINY.model_dump(exclude_defaults=True).items()]
    options = ["--split", "val", "-k", "2", "--steps", "2", "--device", "cpu", *small]
    assert cli.run_app(["eval", "--data", str(tiny), "--curve", "1,2", *options]) == 0
    out = capsys.readouterr().out
    assert [line.split()[0] for line in out.splitlines()[2:5]] == ["1", "2", "heuristic"]
    assert out.endswith(f"runs/curve-{tiny.name}/curve.html\n")
    run = f"runs/curve-{tiny.name}/curve/2"
    assert (
        cli.run_app(["eval", run, "--curve", "1", "--out", "other", "--json", "--split", "val", "-k", "2", "--steps", "2"]) == 0
    )
    found = json.loads(capsys.readouterr().out)
    assert found["asked"]["training"]["width"] == TINY.width, "the run's own config, on the run's own data"
    assert found["asked"]["data"] == str(tiny)
    assert [point["demos"] for point in found["points"]] == [1]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--curve", "10;20"], "--curve: got '10;20', expected numbers of demos"),
        (["--curve", "1,"], "--curve: got '1,'"),
        (["--curve", "1,99"], "curve: got 99 demos, the train split of"),
        (["--steps", "9"], "--minutes, --steps: nothing is trained without --curve"),
    ],
    ids=str,
)
def test_a_mistake_in_the_command_is_one_line(
    tiny: Path, tmp_path: Path, arguments: list[str], says: str, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.run_app(["eval", "--data", str(tiny), *arguments]) == 2
    said = capsys.readouterr().err
    assert said.startswith(says)
    assert said.count("\n") == 1
    assert not list(tmp_path.iterdir())
