"""Pages of evaluations and what pages are made of: they say what the report says, load nothing, and take hostile names."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("pybullet")

from browser import needs_browser, open_page

from dapdata import cli, loading, metrics, page, plots
from dapdata import predictions as files
from dapdata.poses import pose
from dapdata.records import Placement
from dapdata.report import Interval, Report
from daptrain import page as pages
from daptrain.curve import Asked, Curve, Figures, Point
from daptrain.page import Material

HOSTILE = """</script><script>problems.push("ran")</script><img src=x onerror='problems.push("ran")'>"&'"""
LOG = [
    {
        "net": net,
        "step": step,
        "loss": 1 / step,
        "val_moved_mm": float("inf"),
        "seconds": 1.0,
        **({"val_iou": 0.5} if step == 40 else {}),
    }
    for net in ("affordance", "pose")
    for step in (20, 40)
]


@pytest.fixture(scope="module")
def judged(tiny: Path) -> tuple[Report, Material]:
    """Three scenes: the best candidate of the first succeeds, that of the second hangs in the air, the third has none."""
    dataset = loading.open(tiny, "train")
    samples = [dataset[i] for i in range(3)]
    goals = [sample["pose/T_world_object_goal"] for sample in samples]
    above = pose(translation=(0, 0, 0.3))
    poses = [[goals[0], above @ goals[0]], [above @ goals[1], goals[1]], []]
    placements = {
        int(sample["meta/demo"]): [Placement(T, -float(rank), "ok") for rank, T in enumerate(found)]
        for sample, found in zip(samples, poses)
    }
    report, results = metrics.judge_dataset(files.collect(placements), dataset, split="train", trials=3, k=2, method="mine")
    return report, Material(results["mine"], samples, training=LOG)


@pytest.fixture(scope="module")
def html(judged: tuple[Report, Material]) -> str:
    return pages.report_page(*judged, say=lambda line: None)


def hostile(report: Report) -> Report:
    """The report with hostile names wherever names come from outside."""
    scene = report.scenes[1].model_copy(update={"reason": HOSTILE})
    return report.model_copy(
        update={
            "task": HOSTILE,
            "hardware": HOSTILE,
            "notes": [HOSTILE],
            "method": report.method.model_copy(update={"name": HOSTILE}),
            "success": report.success.model_copy(update={"failures": {HOSTILE: 2}, "failures_all": {HOSTILE: 3}}),
            "references": {f"{HOSTILE}2": report.references["oracle"]},
            "digests": report.digests.model_copy(update={"weights": {HOSTILE: HOSTILE}}),
            "split": report.split.model_copy(update={"name": HOSTILE}),
            "scenes": [report.scenes[0], scene, report.scenes[2]],
        }
    )


def columns_of(html: str) -> dict[str, list[Any]]:
    """The values of each column of a page's table."""
    (found,) = re.findall(r'class="sortable".*?<script type="application/json">(.*?)</script>', html, re.DOTALL)
    return {column["name"]: column["values"] for column in json.loads(found)}


def test_the_table_of_scenes_says_what_the_report_says(judged: tuple[Report, Material], html: str) -> None:
    report, material = judged
    columns = columns_of(html)
    assert columns["demo"] == [row.demo for row in report.scenes]
    assert columns["result"][0] == "success"
    assert columns["result"][2] == "no prediction"
    assert columns["succeed"] == [row.successes for row in report.scenes] == [1, 1, 0]
    assert columns["off"][0] == pytest.approx(0, abs=1e-6)
    assert columns["off"][1] > 200, "mm, in the air"
    assert columns["off"][2] is columns["clearance"][2] is columns["push"][2] is None
    goal = material.samples[0]["goals/clearance"][material.results[0].distance[0].argmin()]
    assert columns["clearance"][0] == pytest.approx(1000 * goal)


def test_failures_of_each_reason_come_first_in_3d_with_their_candidates(html: str) -> None:
    views = json.loads(re.findall(r'id="views">(.*?)</script>', html, re.DOTALL)[0])["views"]
    states = [view["name"].split(": ")[1] for view in views]
    assert states[-1] == "success"
    assert "no prediction" in states
    assert len(set(states)) == 3
    layers = {state: {layer["name"]: layer for layer in view["layers"]} for state, view in zip(states, views)}
    assert "prediction" not in layers["no prediction"]
    assert layers["success"]["prediction"]["says"] == ["rank 0: success"]
    assert layers["success"]["other candidates"]["says"][0].startswith("rank 1: ")
    assert "verified goals" in layers["success"]
    assert "demonstrated goal" not in layers["success"]


def test_without_scenes_log_and_film_their_sections_are_left_out(judged: tuple[Report, Material]) -> None:
    report, material = judged
    bare = pages.report_page(report, Material(material.results), say=lambda line: None)
    for heading in ("In 3-D", "Training", "From noise to one place", "Some successes"):
        assert f"<h2>{heading}</h2>" not in bare
    assert columns_of(bare)["result"][0] == "success"


def test_a_report_of_before_clearances_were_counted_has_a_page(judged: tuple[Report, Material]) -> None:
    report, material = judged
    old = report.model_dump(mode="json", by_alias=True)
    for summary in (old, *old["references"].values()):
        del summary["success"]["success_by_clearance_mm"]
    assert "Success by clearance" not in pages.report_page(Report.model_validate(old), Material(material.results), print)


def test_hostile_names_stay_text_in_a_report(judged: tuple[Report, Material]) -> None:
    report, material = judged
    html = pages.report_page(hostile(report), material, say=lambda line: None)
    assert "<script>problems" not in html
    assert "<img src=x" not in html.replace("\\u003c", "(")


def test_two_reports_become_a_page(judged: tuple[Report, Material], tmp_path: Path) -> None:
    report, _ = judged
    other = report.model_copy(update={"scenes": [row.model_copy(update={"success": False}) for row in report.scenes]})
    for name, one in (("a", report), ("b", other)):
        (tmp_path / f"{name}.json").write_text(one.model_dump_json(by_alias=True))
    command = ["compare", str(tmp_path / "a.json"), str(tmp_path / "b.json"), "--out"]
    assert cli.run_app([*command, str(tmp_path / "new/both.html")]) == 0
    html = (tmp_path / "new/both.html").read_text()
    assert columns_of(html)["succeeds"] == ["a", "neither", "neither"]
    assert "mine and mine" in html
    assert cli.run_app([*command, str(tmp_path / "both.png")]) == 2


def curve() -> Curve:
    """Two sizes whose figures are made up."""
    rate = Interval(value=0.5, n=10, ci95=(0.24, 0.76))
    names = [name for name in metrics.Success.model_fields if name.startswith("success_") and not name.endswith("_mm")]
    success = metrics.Success(**dict.fromkeys(names, rate), failures={}, failures_all={})
    figures = Figures(success=success, recall={"1": rate, "8": rate})
    points = [Point(demos=n, success=success, recall=figures.recall, cost=metrics.Cost()) for n in (10, 40)]
    judging = {"split": "test", "trials": 10, "protocol": "strict", "k": 8, "draws": 8}
    training = {"method": "dap", "minutes": None, "steps": 600}
    asked = Asked(task=HOSTILE, dataset="0" * 64, data=HOSTILE, training=training, judging=judging)
    return Curve(asked=asked, references={"heuristic": figures}, points=points)


def test_a_curve_that_has_no_size_yet_has_a_page() -> None:
    now = curve().model_copy(update={"points": [], "references": {}})
    assert "No size is done yet." in pages.curve_page(now)


# What pages are made of --------------------------------------------------------------------------------------


def test_histograms_take_one_value_none_and_many() -> None:
    for values in (np.array([3]), np.arange(1000) / 7, np.array([2.5, 2.5])):
        counted = plots.histogram(values).data[0]
        assert sum(counted.y) == len(values)
        assert len(counted.x) == len(counted.customdata)
    assert plots.histogram(np.array([])).layout.annotations[0].text == "none"
    assert list(plots.histogram(np.array([1, 1, 4])).data[0].customdata) == ["1", "2", "3", "4"]


def test_unknown_properties_of_a_plot_are_refused() -> None:
    with pytest.raises(ValueError, match="hight"):
        plots.figure(100, {"type": "bar", "hight": 3})


def test_rates_and_lines_show_their_intervals() -> None:
    rate = Interval(value=0.5, n=10, ci95=(0.24, 0.76))
    drawn = plots.rates({"mine": {"top": rate}}).data[0]
    assert drawn.x[0] == 50
    assert drawn.error_x.array[0] == pytest.approx(26)
    assert drawn.error_x.arrayminus[0] == pytest.approx(26)
    band, line = plots.lines([plots.Line("mine", [1, 2], [rate, rate], "red")], "K", log=True).data
    assert list(band.y) == [76, 76, 24, 24]
    assert list(line.y) == [50, 50]
    assert line.customdata[0] == "50.0 % (24-76), n 10"


def test_nothing_can_end_the_script_that_holds_data_and_no_number_is_lost() -> None:
    text = page.data({"a": HOSTILE, "b": 1.5}, "x")
    assert text.count("</script>") == 1
    assert json.loads(re.findall(r">(.*)</script>", text)[0]) == {"a": HOSTILE, "b": 1.5}
    table = page.sortable([page.Column("a", "A", [1.5, float("nan"), None, HOSTILE])], "a>1")
    assert columns_of(table) == {"a": [1.5, None, None, HOSTILE]}


@pytest.mark.slow
@needs_browser
def test_a_report_is_drawn_and_its_table_leads_to_the_view(html: str, tmp_path: Path) -> None:
    script = """
    const link = $$(".sortable td a").at(-1);
    link.click();
    await until(() => $("#demo").selectedOptions[0].value === link.textContent);
    const shown = $("#demo").selectedOptions[0].text;
    $("input[type=search]").value = "off>100";
    $("input[type=search]").dispatchEvent(new Event("input"));
    return { link: link.textContent, shown, far: $$(".sortable tbody tr").length, plots: $$(".plot").length,
      prediction: $("#stage").data.filter(t => t.visible).map(t => t.name) };
    """
    found = open_page(html, tmp_path, script)
    assert found["shown"].startswith(f"demo {found['link']}: ")
    assert found["far"] == 1
    assert found["plots"] >= 8
    assert "verified goals" in found["prediction"]


@pytest.mark.slow
@needs_browser
def test_hostile_names_are_drawn_as_text(judged: tuple[Report, Material], tmp_path: Path) -> None:
    report, material = judged
    html = pages.report_page(hostile(report), material, say=lambda line: None)
    script = """
    return { title: document.title, note: $(".note").textContent, cell: $$(".sortable td:nth-child(2)")[1].textContent,
      plotted: [$$("text.legendtext"), $$(".ytick text")].map(all => all.some(t => t.textContent.includes("<script>"))) };
    """
    found = open_page(html, tmp_path, script)
    assert found["title"] == f"{HOSTILE} on {HOSTILE}"
    assert found["note"] == HOSTILE
    assert found["cell"] == HOSTILE.replace("_", " ")
    assert found["plotted"] == [True, True]


@pytest.mark.slow
@needs_browser
def test_curves_are_drawn(tmp_path: Path) -> None:
    script = "return { title: $('h1').textContent, bands: $$('.plot path.js-fill').length, rows: $$('tr').length };"
    found = open_page(pages.curve_page(curve()), tmp_path, script)
    assert found["title"].startswith(f"dap on {HOSTILE}")
    assert found["bands"] == 5, "three figures of success, two of recall"
    assert found["rows"] == 1 + 3 + 2
