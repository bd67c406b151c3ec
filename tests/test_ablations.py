"""The table of ablations on the tiny dataset, with a few steps: its rows differ as they say, it resumes, it refuses."""

from __future__ import annotations

import importlib
import json
import shutil
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

pytest.importorskip("torch")
pytest.importorskip("safetensors")

from training_samples import TINY

from dapdata import loading, manifest
from dapdata.config import AT_INFERENCE, TrainConfig
from dapdata.report import read_report
from daptrain import checkpoint, refine

SCRIPTS = Path(__file__).parents[1] / "benchmarks"
SMALL = [f"--set=train.{key}={json.dumps(value)}" for key, value in TINY.model_dump(exclude_defaults=True).items()]
ROWS = "no_condition,soft_labels,cap_whole,no_refine,k_1"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    sys.path.insert(0, str(SCRIPTS))
    try:
        return importlib.import_module("ablations")
    finally:
        sys.path.remove(str(SCRIPTS))


def arguments(data: Path, out: Path, rows: str = ROWS, **changes: Any) -> list[str]:
    options = {"steps": 1, "split": "train", "trials": 2, "draws": 4, "k": 2, "device": "cpu", "workers": 1} | changes
    given = [f"{'--' if len(name) > 1 else '-'}{name}={value}".replace("-k=", "-k") for name, value in options.items()]
    return [str(data), "--out", str(out), "--rows", rows, *given, *SMALL]


@pytest.fixture(scope="module")
def out(script: ModuleType, tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished table. Not to be changed."""
    folder = tmp_path_factory.mktemp("ablations") / "out"
    assert script.main(arguments(tiny, folder)) == 0
    return folder


def test_every_row_changes_what_it_says_and_nothing_else(script: ModuleType, tiny: Path) -> None:
    """Each row's settings are valid, differ from the base, and act where the row says they do."""
    names = [row.name for row in script.ROWS]
    assert len(set(names)) == len(names)
    table = script.Table(script.parse([str(tiny)]))
    base = table.config(script.BY_NAME["base"]).model_dump()
    for row in script.ROWS[1:]:
        changed = {key for key, value in table.config(row).model_dump().items() if value != base[key]}
        if row.run:
            assert not row.train
            assert not row.label
            assert changed <= set(AT_INFERENCE), row.name
            assert len(row.inference) + (row.k is not None) == 1, row.name
            assert changed or row.k is not None, row.name
        else:
            assert changed or row.label or row.method == "cap", row.name
            assert len(row.train) + len(row.label) + (row.method == "cap") == 1, row.name
    assert {f"no_{step}" for step in refine.STEPS} <= set(names)
    assert {f"rank_no_{criterion}" for criterion in refine.CRITERIA} <= set(names)


def test_a_table_has_a_line_for_each_row_and_reports_on_the_same_scenes(out: Path, script: ModuleType) -> None:
    lines = [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]
    assert [line["name"] for line in lines] == ["base", "no_condition", "soft_labels", "cap_whole", "k_1", "no_refine"]
    reports = {line["name"]: read_report(out / line["report"]) for line in lines}
    assert len({report.split.sha256 for report in reports.values()}) == 1
    assert reports["no_refine"].method.settings["refine"] == []
    assert reports["no_refine"].digests.weights == reports["base"].digests.weights
    assert reports["no_condition"].digests.weights != reports["base"].digests.weights
    assert (reports["base"].method.k, reports["k_1"].method.k) == (2, 1)
    assert (reports["cap_whole"].method.name, reports["cap_whole"].method.settings["cap_crop"]) == ("cap", "whole")
    assert {path.name for path in (out / "runs").iterdir()} == {"base", "no_condition", "soft_labels", "cap"}


def test_other_labels_are_made_beside_the_dataset(out: Path, tiny: Path) -> None:
    before, copy = manifest.read(tiny), manifest.read(out / "data/soft_labels")
    assert (before.recipe["label"]["kind"], copy.recipe["label"]["kind"]) == ("hard", "soft")
    assert copy.content_sha256 != before.content_sha256
    assert len(loading.open(out / "data/soft_labels")) == len(loading.open(tiny))
    assert checkpoint.read_description(out / "runs/soft_labels")["recipe"]["label"]["kind"] == "soft"
    assert {shard.path.split("/")[0] for shard in before.shards} == {"shards"}


def test_the_table_names_what_differs_and_compares_with_the_base(out: Path) -> None:
    text = (out / "table.md").read_text()
    rows = {line.split("|")[1].strip(): line.split("|")[2:-1] for line in text.splitlines() if line.startswith("|")}
    made = ["base", "no_condition", "soft_labels", "cap_whole", "k_1", "no_refine", "*oracle*", "*random*", "*heuristic*"]
    assert [name for name in rows if name not in ("row", "---")] == made
    assert rows["no_condition"][0].strip() == "`train.object_condition=false`"
    assert rows["cap_whole"][0].strip() == "`train.cap_crop=whole --method cap`"
    assert [cell.strip() for cell in rows["base"][-2:]] == ["", ""]
    assert all(0 < float(rows[name][-1]) <= 1 for name in ("no_condition", "no_refine", "k_1"))
    assert "1 steps of training, 2 scenes of train, K = 2, 4 draws" in text


def test_a_better_row_has_a_positive_difference_and_the_p_of_its_pairs(out: Path, script: ModuleType, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(out, tmp_path / "copy"))
    path = copy / "reports/no_refine/report.json"
    report = json.loads(path.read_text())
    report["success"]["success_top1"]["value"] = 1.0
    for scene in report["scenes"]:
        scene["success"] = True
    path.write_text(json.dumps(report))
    lines = [json.loads(line) for line in (copy / "results.jsonl").read_text().splitlines()]
    assert not any(scene.success for scene in read_report(copy / "reports/base/report.json").scenes)
    (row,) = [line for line in script.markdown(lines, "", copy).splitlines() if line.startswith("| no_refine")]
    assert [cell.strip() for cell in row.split("|")[-3:-1]] == ["+100.0", "0.5"]


def test_what_is_there_is_not_made_again(
    out: Path, script: ModuleType, tiny: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def never(self: Any, row: Any) -> None:
        raise AssertionError(row.name)

    monkeypatch.setattr(script.Table, "result", never)
    assert script.main(arguments(tiny, out)) == 0
    assert capsys.readouterr().out.count("\n| ") == 2 + 6 + 3 - 1
    with pytest.raises(AssertionError, match="no_search"):
        script.main(arguments(tiny, out, f"{ROWS},no_search"))


def test_a_line_that_was_cut_short_is_made_again(out: Path, script: ModuleType, tiny: Path, tmp_path: Path) -> None:
    table = script.Table(script.parse(arguments(tiny, tmp_path)))
    lines = (out / "results.jsonl").read_text()
    (tmp_path / "results.jsonl").write_text(lines[:-40])
    assert list(table.done()) == ["base", "no_condition", "soft_labels", "cap_whole", "k_1"]
    assert (tmp_path / "results.jsonl").read_text().endswith("}\n")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"rows": "no_condtion"}, "did you mean 'no_condition'"),
        ({"steps": 2}, "steps 1, now it is 2"),
        ({"trials": 3}, "trials 2"),
    ],
    ids=str,
)
def test_another_table_is_refused(
    out: Path, script: ModuleType, tiny: Path, changes: dict[str, Any], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert script.main(arguments(tiny, out, **changes)) == 2
    said = capsys.readouterr().err
    assert says in said
    assert said.count("\n") == 1


def test_the_paper_row_is_the_preset(script: ModuleType, tiny: Path) -> None:
    table = script.Table(script.parse([str(tiny), "--rows", "paper"]))
    paper = TrainConfig(preset="paper")
    assert table.config(script.BY_NAME["paper"]) == paper
