"""`evaluate` on the tiny dataset: files, references, refusals. The baselines, and a trained run of a few steps."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from dapdata import loading, metrics, predictions
from dapdata import rng as rngs
from dapdata.errors import CheckpointError, CorruptionError, UsageError
from dapdata.poses import tilt
from dapdata.records import Placement
from dapdata.report import Report
from daptrain import baselines
from daptrain.baselines.random import interior
from daptrain.evaluation import evaluate


def quiet(line: str) -> None:
    """Says nothing."""


class Links(HTMLParser):
    """Collects what a page would load."""

    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [value or "" for name, value in attrs if name in ("src", "href")]
        if tag not in ("img", "meta", "path", "rect", "circle"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag in self.open:
            assert self.open.pop() == tag


@pytest.mark.parametrize("name", baselines.NAMES)
def test_baselines_give_k_finite_upright_poses_and_repeat_themselves(tiny: Path, name: str) -> None:
    sample = loading.open(tiny)[0]
    place = baselines.load(name)
    first, again = (place(sample, 5, rngs.stream(1, name, 0)) for _ in range(2))
    assert [p.status for p in first] == ["ok"] * 5
    for one, other in zip(first, again):
        assert np.isfinite(one.T_world_object).all()
        assert np.rad2deg(tilt(one.T_world_object, "revolution")) < 5
        np.testing.assert_array_equal(one.T_world_object, other.T_world_object)


def test_random_stays_in_the_container_and_the_oracle_starts_with_the_demonstration(tiny: Path) -> None:
    sample = loading.open(tiny)[0]
    poses = np.stack([p.T_world_object for p in baselines.load("random")(sample, 50, rngs.stream(0, "x", 0))])
    local = np.linalg.inv(sample["pose/T_world_container"]) @ poses
    low, high = interior(sample)
    assert ((local[:, :3, 3] >= low) & (local[:, :3, 3] <= high)).all()
    oracle = baselines.load("oracle")(sample, 3, rngs.stream(0, "x", 0))
    np.testing.assert_allclose(oracle[0].T_world_object, sample["pose/T_world_object_goal"])


def test_the_heuristic_gives_a_status_when_nothing_can_be_fitted(tiny: Path) -> None:
    sample = dict(loading.open(tiny)[0])
    sample["object/points"], sample["object/normals"] = sample["object/points"][:3], sample["object/normals"][:3]
    (only,) = baselines.load("heuristic")(sample, 4, rngs.stream(0, "x", 0))
    assert only.status == "too_few_points"
    assert np.isnan(only.T_world_object).all()


def test_eval_leaves_predictions_a_report_and_a_page_that_needs_no_network(tiny: Path, tmp_path: Path) -> None:
    found = evaluate(None, tiny, method="heuristic", trials=3, split="train", k=3, out=tmp_path / "out", say=quiet)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"predictions.npz", "report.json", "report.html"}
    assert json.loads((tmp_path / "out/report.json").read_text()) == found
    made = Report.model_validate(found)
    assert set(made.references) == set(baselines.NAMES)
    assert made.judge.oracle.value == 1
    assert made.method.saw_ground_truth
    assert made.success == made.references["heuristic"].success
    read = predictions.read(tmp_path / "out/predictions.npz")
    assert read.sha256 == made.digests.predictions
    again = metrics.judge_file(tmp_path / "out/predictions.npz", tiny, split="train", trials=3)
    assert again["success"] == found["success"]
    page = (tmp_path / "out/report.html").read_text()
    links = Links()
    links.feed(page)
    assert all(link.startswith("data:image/") for link in links.loads)
    failures = sum(not row.success for row in made.scenes)
    assert len(links.loads) == 2 * (failures + min(6, len(made.scenes) - failures))
    assert not links.open


def test_the_same_evaluation_gives_the_same_report(tiny: Path, tmp_path: Path) -> None:
    a, b = (
        evaluate(None, tiny, method="random", trials=2, split="train", k=2, out=tmp_path / x, pictures=False, say=quiet)
        for x in "ab"
    )
    for report in (a, b):
        report.pop("cost")
    assert a == b


def test_wrong_calls_are_refused_before_anything_is_written(tiny: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(UsageError, match="expected one of"):
        evaluate(None, tiny, method="magic", out=out, say=quiet)
    with pytest.raises(UsageError, match="needs a run"):
        evaluate(None, tiny, method="dap", out=out, say=quiet)
    with pytest.raises(UsageError, match="--data"):
        evaluate(None, None, method="random", out=out, say=quiet)
    with pytest.raises(CheckpointError, match=r"config\.json"):
        evaluate(tmp_path, tiny, method="dap", out=out, say=quiet)
    assert not out.exists()


def test_a_broken_judge_is_reported_and_then_raised(tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    away = np.eye(4)
    away[:3, 3] = 9
    monkeypatch.setattr(metrics, "oracle", lambda samples, k: predictions.collect(
        {int(s["meta/demo"]): [Placement(away, 0.0, "ok")] * k for s in samples}
    ))  # fmt: skip
    with pytest.raises(CorruptionError, match="broken"):
        evaluate(None, tiny, method="random", trials=2, split="train", k=2, out=tmp_path, pictures=False, say=quiet)
    assert not json.loads((tmp_path / "report.json").read_text())["judge"]["sound"]


def test_a_run_of_a_few_steps_is_evaluated_with_affordance_and_cost(tiny: Path, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from training_samples import TINY

    from daptrain.loop import train

    run = train(tiny, tmp_path / "run", steps=2, device="cpu", config=TINY)
    found = Report.model_validate(evaluate(run, tiny, trials=2, split="train", k=2, device="cpu", pictures=False, say=quiet))
    assert found.method.name == "dap"
    assert not found.method.saw_ground_truth
    assert found.affordance is not None
    assert found.cost.parameters
    assert found.cost.demos_used
    assert set(found.digests.weights) == {"affordance.safetensors", "pose.safetensors"}
    assert (run / "report.json").exists()
    with pytest.raises(UsageError, match="--method dap"):
        evaluate(run, tiny, method="cap", say=quiet)
