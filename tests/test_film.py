"""The filmstrip: its rows end on different places, its last scores are the sample, and it is in the report."""

from __future__ import annotations

import base64
import gzip
import json
import re
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")
pytest.importorskip("matplotlib")

from browser import needs_browser, open_page  # noqa: E402
from matplotlib.image import imread  # noqa: E402
from training_samples import TINY  # noqa: E402

from dapdata import loading, page, poses  # noqa: E402
from dapdata.errors import UsageError  # noqa: E402
from daptrain import film as films  # noqa: E402
from daptrain.evaluation import evaluate  # noqa: E402
from daptrain.infer import Predictor  # noqa: E402
from daptrain.loop import train  # noqa: E402


@pytest.fixture(scope="module")
def run(tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(tiny, tmp_path_factory.mktemp("film") / "run", steps=2, device="cpu", config=TINY)


def at(*places: tuple[float, float, float] | None) -> np.ndarray:
    """Poses at these places, NaN for None."""
    return np.stack([np.full((4, 4), np.nan) if place is None else poses.pose(translation=place) for place in places])


def test_rows_are_the_best_candidates_that_are_apart() -> None:
    T = at((0, 0, 0), (0.01, 0, 0), None, (0.3, 0, 0), (0.3, 0.02, 0), (0, 0, 0.2))
    quality = np.array([-2.0, -1.0, -np.inf, -5.0, -4.0, -3.0])
    assert films.places(T, quality, 3) == [1, 5, 4]
    assert films.places(T, quality, 2) == [1, 5]
    assert films.places(T[:3], quality[:3], 3) == [1], "the others are at the same place, or nowhere"
    assert films.places(at(None, None), np.full(2, -np.inf), 3) == []


@pytest.fixture(scope="module")
def film(tiny: Path, run: Path) -> films.Film:
    return films.film(Predictor.load(run, "cpu"), loading.open(tiny, "val")[0])


def test_the_film_shows_the_samples_that_are_placed(tiny: Path, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The last scores are what net 2 was given, the first ones are noise."""
    sample, predictor, given = loading.open(tiny, "val")[0], Predictor.load(run, "cpu"), []
    propose = Predictor.propose

    def record(self, *args):  # type: ignore[no-untyped-def]
        given.extend(propose(self, *args))
        return given

    monkeypatch.setattr(Predictor, "propose", record)
    found = films.film(predictor, sample)
    assert (found.left[0], found.left[-1], len(found.left)) == (100, 0, found.scores.shape[1])
    assert len(found.superpoint) == len(sample["container/points"])
    assert found.superpoint.max() < found.scores.shape[2]
    for scores in found.scores:
        assert np.std(scores[0]) == pytest.approx(1, abs=0.2), "noise"
        assert min(np.abs(scores[-1].clip(-1, 1) - p.score).max() for p in given) < 1e-6, "one of the candidates"


def test_the_strip_has_a_column_for_each_step_and_is_in_colour(film: films.Film) -> None:
    wide, narrow = (imread(BytesIO(films.strip(film, columns))) for columns in (4, 2))
    assert wide.shape[1] > narrow.shape[1] > 2 * films.PANEL[0]
    assert 0.02 < (np.ptp(wide[..., :3], axis=2) > 0.4).mean() < 0.5, "some of it is red, and not all"


def test_the_same_film_comes_out_twice(tiny: Path, run: Path) -> None:
    sample, predictor = loading.open(tiny, "val")[0], Predictor.load(run, "cpu")
    one, same, other = (films.strip(films.film(predictor, sample, seed, rows=1), 2) for seed in (0, 0, 1))
    assert one == same
    assert one != other


def test_samples_without_a_pose_are_shown_as_such_and_called_no_best_ones(film: films.Film) -> None:
    nowhere = replace(film, T_world_object=np.full_like(film.T_world_object, np.nan))
    assert films.strip(nowhere, columns=2).startswith(b"\x89PNG")
    html = films.player(nowhere)
    assert html.count(": no pose<") == len(film.scores)
    assert "None of 24 samples led to a pose" in html
    assert "best-ranked" not in html
    assert "best-ranked" in films.player(replace(film, T_world_object=np.stack([np.eye(4)] * len(film.scores))))


def test_the_player_holds_what_each_pixel_sees_and_every_score(film: films.Film) -> None:
    told = json.loads(re.findall(r'id="film">(.*?)</script>', films.player(film))[0])
    superpoint = np.frombuffer(gzip.decompress(base64.b64decode(told["superpoint"])), "<u2")
    shade = np.frombuffer(gzip.decompress(base64.b64decode(told["shade"])), "u1")
    assert len(superpoint) == len(shade) == told["width"] * told["height"]
    assert 0.05 < (shade > 0).mean() < 0.95
    assert len(np.unique(superpoint[shade > 0])) > 0.3 * told["count"], "many superpoints are seen"
    for packed, scores in zip(told["scores"], film.scores):
        read = np.frombuffer(base64.b64decode(packed), "i1").reshape(scores.shape) / 127
        assert np.allclose(read, scores.clip(-1, 1), atol=0.005)
    assert told["steps"][0] == "noise"
    assert told["steps"][-1] == "sample"


@pytest.mark.slow
@needs_browser
def test_the_slider_goes_from_noise_to_the_placed_object(film: films.Film, tmp_path: Path) -> None:
    html = page.document("film", "", [page.Section("film", films.player(film))])
    script = """
    await until(() => $("#strip canvas"));
    const canvas = $(".cards canvas");
    const seen = () => canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.join();
    const go = step => { $("#step").value = step; $("#step").dispatchEvent(new Event("input")); };
    const told = [], pictures = new Set(), most = Number($("#step").max);
    for (const step of [0, 1, most - 1, most]) {
      go(step);
      told.push($("#steps").textContent);
      pictures.add(seen());
    }
    const placed = $(".film").classList.contains("placed");
    $("#strip canvas").click();
    return { told, pictures: pictures.size, placed, back: $("#steps").textContent, thumbs: $$("#strip canvas").length };
    """
    found = open_page(html, tmp_path, script)
    assert found["told"][0] == found["back"] == "noise"
    assert found["told"][2:] == ["sample", "object placed"]
    assert found["pictures"] == 3, "the sample is still there under the placed object"
    assert found["placed"]
    assert found["thumbs"] == films.COLUMNS * len(film.scores)


def test_only_a_method_that_samples_has_a_film(tiny: Path, run: Path) -> None:
    sample, predictor = loading.open(tiny, "val")[0], Predictor.load(run, "cpu")
    with pytest.raises(UsageError, match="got 'cap', expected dap"):
        films.film(replace(predictor, method="cap"), sample)


def test_write_takes_a_demo_of_the_split(tiny: Path, run: Path, tmp_path: Path) -> None:
    demo = int(loading.open(tiny, "val").index["demo"][0])
    path = films.write(run, tmp_path / "images/diffusion.png", tiny, demo)
    assert path.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(UsageError, match="expected one of the val split"):
        films.write(run, tmp_path / "other.png", tiny, 10_000)


def test_a_report_shows_the_film_of_one_scene(tiny: Path, run: Path, tmp_path: Path) -> None:
    evaluate(run, tiny, trials=1, split="val", k=2, references=False, device="cpu", out=tmp_path, say=lambda line: None)
    html = (tmp_path / "report.html").read_text()
    assert html.count('id="film"') == 1
    assert "<h2>From noise to one place</h2>" in html
