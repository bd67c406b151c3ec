"""`evaluate` on the tiny dataset: files, references, refusals. The baselines, and a trained run of a few steps."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from dapdata import loading, metrics, predictions
from dapdata import rng as rngs
from dapdata.config import TrainConfig
from dapdata.errors import CheckpointError, CorruptionError, UsageError
from dapdata.poses import inverse, tilt
from dapdata.records import Placement
from dapdata.report import Report
from daptrain import baselines
from daptrain.baselines import heuristic
from daptrain.baselines.random import interior
from daptrain.evaluation import evaluate
from daptrain.fit import fit_object


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
        if tag not in ("img", "meta", "link", "input", "br"):
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
        assert np.rad2deg(tilt(one.T_world_object, "revolution", np.array([0.0, 0, 1]))) < 5
        np.testing.assert_array_equal(one.T_world_object, other.T_world_object)


def test_random_stays_in_the_container_and_the_oracle_starts_with_the_demonstration(tiny: Path) -> None:
    sample = loading.open(tiny)[0]
    poses = np.stack([p.T_world_object for p in baselines.load("random")(sample, 50, rngs.stream(0, "x", 0))])
    local = np.linalg.inv(sample["pose/T_world_container"]) @ poses
    low, high = interior(sample)
    assert ((local[:, :3, 3] >= low) & (local[:, :3, 3] <= high)).all()
    oracle = baselines.load("oracle")(sample, 3, rngs.stream(0, "x", 0))
    np.testing.assert_allclose(oracle[0].T_world_object, sample["pose/T_world_object_goal"])


def test_the_box_of_a_container_that_opens_upwards_reaches_half_an_object_higher(tiny: Path) -> None:
    sample = loading.open(tiny)[0]
    low, high = interior(sample)
    upwards = dict(sample) | {"scene/opening": np.array([0.0, 0, 1])}
    np.testing.assert_allclose(interior(upwards)[0], low)
    np.testing.assert_allclose(interior(upwards)[1] - high, [0, 0, sample["object_parts/size"][0, 2] / 2])


def test_the_heuristic_gives_a_status_when_nothing_can_be_fitted(tiny: Path) -> None:
    sample = dict(loading.open(tiny)[0])
    sample["object/points"], sample["object/normals"] = sample["object/points"][:3], sample["object/normals"][:3]
    (only,) = baselines.load("heuristic")(sample, 4, rngs.stream(0, "x", 0))
    assert only.status == "too_few_points"
    assert np.isnan(only.T_world_object).all()


def test_the_heuristic_refines_and_ranks_as_the_recipe_says(tiny: Path) -> None:
    sample = loading.open(tiny)[0]
    fit = fit_object(sample["object/points"], sample["object/normals"])
    drawn = heuristic.propose(sample, fit, 6, rngs.stream(0, "x", 0))
    T_box_object = inverse(fit.T_world_box) @ sample["pose/T_world_object_start"]
    plain = baselines.load("heuristic", TrainConfig(refine=[], ranking=[]))(sample, 6, rngs.stream(0, "x", 0))
    np.testing.assert_allclose([p.T_world_object for p in plain], drawn @ T_box_object, atol=1e-12)
    assert len({p.score for p in plain}) == 1
    counted = baselines.load("heuristic", TrainConfig(refine=[], ranking=["collision"]))(sample, 6, rngs.stream(0, "x", 0))
    assert all(p.score == -round(-p.score) for p in counted), "a number of points"
    usual = baselines.load("heuristic")(sample, 6, rngs.stream(0, "x", 0))
    assert not np.allclose([p.T_world_object for p in usual], drawn @ T_box_object)


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
    assert all(link.startswith(("data:", "#")) for link in links.loads)
    failures = sum(not row.success for row in made.scenes)
    pictures = [link for link in links.loads if link.startswith("data:image/jpeg")]
    assert len(pictures) == 2 * (failures + min(6, len(made.scenes) - failures))
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


@pytest.fixture(scope="module")
def run(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two steps on `tiny`."""
    pytest.importorskip("torch")
    from training_samples import TINY

    from daptrain.loop import train

    return train(tiny, tmp_path_factory.mktemp("runs") / "run", steps=2, device="cpu", config=TINY)


def test_other_draws_change_what_is_known_of_modes_and_nothing_else(tiny: Path, run: Path, tmp_path: Path) -> None:
    """The k candidates, their ranks and their success are those of an evaluation that draws no more than k."""
    few, many = (
        evaluate(
            run, tiny, trials=2, split="train", k=2, draws=draws, device="cpu", out=tmp_path / str(draws), pictures=False,
            say=quiet,
        )
        for draws in (2, 5)
    )  # fmt: skip
    assert (few["method"]["k"], few["method"]["draws"]) == (2, 2)
    assert (many["method"]["k"], many["method"]["draws"]) == (2, 5)
    assert few["success"] == many["success"]
    assert few["geometry"] == many["geometry"]
    assert list(many["modes"]["recall@K"]) == ["1", "2", "4", "5"]
    for count in few["modes"]["recall@K"]:
        assert few["modes"]["recall@K"][count] == many["modes"]["recall@K"][count]
    one, other = (predictions.read(tmp_path / name / "predictions.npz") for name in ("2", "5"))
    judged = other.rank < 2
    np.testing.assert_array_equal(one.T_world_object, other.T_world_object[judged])
    np.testing.assert_array_equal(one.score, other.score[judged])
    for demo in np.unique(other.demo):
        mine = other.demo == demo
        assert other.rank[mine].tolist() == [0, 1, 2, 3, 4]
        assert other.score[mine][0] >= other.score[mine][1]
    assert many["cost"]["infer_s"]["n"] == 2


def test_seconds_a_placement_are_those_of_the_k(tiny: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other draws are made slow; the clock does not see it."""
    import time

    from daptrain.infer import Predictor

    propose = Predictor.propose

    def slow(*arguments, **options):
        if options.get("drawn", 0):
            time.sleep(2)
        return propose(*arguments, **options)

    monkeypatch.setattr(Predictor, "propose", slow)
    cost = evaluate(
        run,
        tiny,
        trials=1,
        split="train",
        k=2,
        draws=3,
        device="cpu",
        references=False,
        out=tmp_path,
        pictures=False,
        say=quiet,
    )["cost"]
    assert cost["infer_s"]["max"] < 1


def test_baselines_draw_for_the_modes_too(tiny: Path, tmp_path: Path) -> None:
    found = evaluate(
        None, tiny, method="oracle", trials=2, split="train", k=1, draws=32, out=tmp_path, pictures=False, say=quiet
    )
    assert found["method"]["n_candidates"] == 2
    assert found["modes"]["all_modes_found@K"]["32"]["value"] == 1
    assert found["modes"]["recall_share@K"]["32"] > 1  # no luck in it
    assert set(found["references"]["random"]["modes"]["recall@K"]) == {"1", "2", "4", "8", "16", "32"}


def test_fewer_draws_than_candidates_are_refused(tiny: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"draws: got 2, expected at least k \(4\)"):
        evaluate(None, tiny, method="random", k=4, draws=2, out=tmp_path / "out", say=quiet)
    assert not (tmp_path / "out").exists()


def test_changes_are_in_the_settings_and_go_beside_the_run(tiny: Path, run: Path) -> None:
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    changes = {"refine": ["gravity"], "ranking": []}
    found = evaluate(
        run, tiny, trials=1, split="train", k=2, changes=changes, references=False, device="cpu", pictures=False, say=quiet
    )
    settings = found["method"]["settings"]
    assert (settings["refine"], settings["ranking"], settings["sample_steps"]) == (["gravity"], [], 5)
    assert {path.name: path.read_bytes() for path in run.iterdir()} == before
    beside = run.with_name("run-refine-gravity-ranking")
    assert json.loads((beside / "report.json").read_text()) == found
    with pytest.raises(UsageError, match=r"train\.width: is fixed in training"):
        evaluate(run, tiny, changes={"width": 32}, device="cpu", say=quiet)
    with pytest.raises(UsageError, match="method 'random' has no settings"):
        evaluate(run, tiny, method="random", changes={"refine": []}, say=quiet)
