"""The filmstrip: its rows end on different places, its last scores are the sample, and it is in the report."""

from __future__ import annotations

import re
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("safetensors")
pytest.importorskip("matplotlib")

from matplotlib.image import imread  # noqa: E402
from training_samples import TINY  # noqa: E402

from dapdata import loading, poses  # noqa: E402
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


def test_the_film_shows_the_samples_that_are_placed(tiny: Path, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is drawn in the last column of scores is what net 2 was given."""
    sample, predictor = loading.open(tiny, "val")[0], Predictor.load(run, "cpu")
    given, drawn = [], []
    propose, strip = Predictor.propose, films.strip

    def record(self, *args):  # type: ignore[no-untyped-def]
        given.extend(propose(self, *args))
        return given

    def look(sample, frames, left, T, T_world_object):  # type: ignore[no-untyped-def]
        drawn.append((frames, left, T))
        return strip(sample, frames, left, T, T_world_object)

    monkeypatch.setattr(Predictor, "propose", record)
    monkeypatch.setattr(films, "strip", look)
    film = films.film(predictor, sample, columns=4)
    ((frames, left, T),) = drawn
    assert (left[0], left[-1], T) == (100, 0, 100)
    assert len(left) == 4
    for row in frames:
        assert len(row[0]) == len(sample["container/points"])
        assert np.std(row[0]) == pytest.approx(1, abs=0.2), "noise"
        ends = {float(np.abs(np.unique(row[-1].clip(-1, 1))[:, None] - np.unique(p.score)).min(axis=1).max()) for p in given}
        assert min(ends) < 1e-6, "one of the candidates"
    pixels = imread(BytesIO(film))
    assert pixels.shape[1] > 4 * films.PANEL[0]
    assert 0.02 < (np.ptp(pixels[..., :3], axis=2) > 0.4).mean() < 0.5, "some of it is red, and not all"


def test_the_same_film_comes_out_twice(tiny: Path, run: Path) -> None:
    sample, predictor = loading.open(tiny, "val")[0], Predictor.load(run, "cpu")
    one, same, other = (films.film(predictor, sample, seed, rows=1, columns=2) for seed in (0, 0, 1))
    assert one == same
    assert one != other


def test_samples_without_a_pose_are_shown_as_such(tiny: Path, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sample, predictor = loading.open(tiny, "val")[0], Predictor.load(run, "cpu")
    propose = Predictor.propose
    monkeypatch.setattr(
        Predictor,
        "propose",
        lambda *args: [replace(p, T_world_box=np.full((4, 4), np.nan), status="no_region") for p in propose(*args)],
    )
    assert films.film(predictor, sample, columns=2).startswith(b"\x89PNG")


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
    page = (tmp_path / "report.html").read_text()
    assert len(re.findall('<h2>From noise to one place</h2><img [^>]*src="data:image/png;base64,', page)) == 1
