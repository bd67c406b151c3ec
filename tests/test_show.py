"""Contact sheets and the HTML page: they show what the arrays say, from one file, whatever the names are."""

from __future__ import annotations

import base64
import dataclasses
import io
import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from dapdata import manifest, pictures, records, rng, show, viewer
from dapdata.errors import UsageError
from dapdata.poses import pose

BOARD = (0.2, 0.5, 0.01)


def shelf_sample(demo: int = 0) -> dict[str, np.ndarray]:
    """A floor, a back and two cans, with random points on them; three goals, of which the first is demonstrated."""
    draw = rng.stream(0, "test", demo)
    parts = [(0, BOARD, (0, 0, 0.005), 0), (0, (0.01, 0.5, 0.3), (-0.1, 0, 0.15), 0)]
    parts += [(1, (0.06, 0.06, 0.1), (0, y, 0.06), 1) for y in (-0.15, 0.15)]
    floor = np.stack([draw.uniform(-0.1, 0.1, 3000), draw.uniform(-0.25, 0.25, 3000), np.full(3000, 0.01)], axis=1)
    back = np.stack([np.full(3000, -0.095), draw.uniform(-0.25, 0.25, 3000), draw.uniform(0, 0.3, 3000)], axis=1)
    normals = np.repeat([[0, 0, 1.0], [1.0, 0, 0]], 3000, axis=0)
    superpoint = (np.arange(6000) // 3000) * 10 + np.digitize(np.r_[floor[:, 1], back[:, 1]], np.linspace(-0.2, 0.2, 9))
    superpoint = np.unique(superpoint, return_inverse=True)[1]
    count = superpoint.max() + 1
    affordance = np.full(count, -1.0)
    affordance[4] = 1.0
    goals = np.stack([pose(None, (0.5, y, 0.06)) for y in (0.0, 0.08, -0.08)])
    made = {
        "pose/T_world_container": pose(None, (0.5, 0, 0)),
        "pose/T_world_object_goal": goals[0],
        "goals/T_world_object": goals,
        "goals/kind": np.zeros(3),
        "goals/clearance": np.full(3, 0.01),
        "rejected_goals/T_world_object": pose(None, (0.5, 0, 0.3))[None],
        "rejected_goals/reason": np.full(1, records.REJECT_REASONS.index("unsupported")),
        "scene/kind": [part[0] for part in parts],
        "scene/size": [part[1] for part in parts],
        "scene/T_container_part": [pose(None, part[2]) for part in parts],
        "scene/role": [part[3] for part in parts],
        "scene/opening": [1, 0, 0],
        "object_parts/kind": [1],
        "object_parts/size": [[0.055, 0.055, 0.1]],
        "object_parts/T_object_part": np.eye(4)[None],
        "meta/demo": demo,
        "meta/attempts": 1,
        "container/points": np.r_[floor, back] + [0.5, 0, 0],
        "container/normals": normals,
        "container/superpoint": superpoint,
        "object/points": draw.normal((0.8, 0.3, 0.1), 0.03, (500, 3)),
        "object/normals": np.tile([0, 0, 1.0], (500, 1)),
        "object/superpoint": np.arange(500) // 50,
        "container_superpoints/size": np.bincount(superpoint),
        "container_superpoints/affordance": affordance,
        "object_superpoints/size": np.full(10, 50),
    }
    dtypes = {column.metadata["path"]: column.metadata["dtype"] for column in records.columns()}
    return {path: np.asarray(value, dtypes[path]) for path, value in made.items()}


def shown(demo: int = 0) -> pictures.Shown:
    return pictures.Shown(shelf_sample(demo), "shelf", "train")


def about(name: str = "toy") -> manifest.Manifest:
    return manifest.Manifest(
        format=1,
        name=name,
        task="shelf",
        demos=2,
        content_sha256="0" * 64,
        recipe={"name": name},
        recipe_sha256="0" * 64,
        shards=[],
        splits={},
        rejects=manifest.Rejects(attempts={"no_goal": 3}, demos={}, goals={"unsupported": 2}),
        stages={},
        files={},
        created_by={},
    )


@pytest.fixture(scope="module")
def panels() -> dict[str, np.ndarray]:
    return pictures.panels(shelf_sample(), top=0.3)


def pixels_of(picture: np.ndarray, color: tuple[float, float, float]) -> int:
    """How many pixels have about the hue of a colour."""
    c, p = np.array(color), picture / 255.0
    saturated = (p.max(axis=-1) - p.min(axis=-1)) > 0.25

    def hue(rgb: np.ndarray) -> np.ndarray:
        low, high = rgb.min(axis=-1, keepdims=True), rgb.max(axis=-1, keepdims=True)
        return (rgb - low) / np.maximum(high - low, 1e-9)

    return int((saturated & (np.abs(hue(p) - hue(c)).max(axis=-1) < 0.12)).sum())


def test_panels_have_the_wanted_sizes(panels: dict[str, np.ndarray]) -> None:
    width, height = pictures.PANEL
    sizes = {name: picture.shape for name, picture in panels.items()}
    large = dict.fromkeys(("cloud", "superpoints", "affordance", "goals"), (height, width, 3))
    assert sizes == large | dict.fromkeys(("object", "object_superpoints"), (pictures.INSET, pictures.INSET, 3))


def test_affordance_marks_one_place(panels: dict[str, np.ndarray]) -> None:
    share = pixels_of(panels["affordance"], tuple(pictures.DIVERGING[-1])) / pixels_of(
        panels["affordance"], tuple(pictures.DIVERGING[0])
    )
    assert 0.01 < share < 0.2


def test_demonstrated_valid_and_rejected_goals_are_told_apart(panels: dict[str, np.ndarray]) -> None:
    goals = panels["goals"]
    one, two = pixels_of(goals, pictures.DEMONSTRATED), pixels_of(goals, pictures.VALID)
    assert one > 500
    assert two > 1.3 * one
    sample = shelf_sample()
    without = sample | {key: sample[key][:0] for key in ("rejected_goals/T_world_object", "rejected_goals/reason")}
    picture = pictures.goal_picture(without, pictures.front_view(sample, *pictures.PANEL))
    assert not np.array_equal(picture, goals)


def test_a_sheet_is_the_same_bytes_each_time() -> None:
    sheets = [pictures.sheet([shown()], "toy") for _ in range(2)]
    assert sheets[0] == sheets[1]
    assert sheets[0].startswith(b"\x89PNG")


def test_every_reject_reason_has_its_own_color() -> None:
    assert set(pictures.REJECTED) == set(records.REJECT_REASONS)
    inks = np.array([pictures.VALID, pictures.DEMONSTRATED, *pictures.REJECTED.values()])
    apart = np.abs(inks[:, None] - inks[None]).max(axis=-1) + np.eye(len(inks))
    assert apart.min() > 0.1


def test_page_needs_no_network_and_holds_the_points() -> None:
    html = viewer.page(about(), [shown()], [shown(0), shown(1)], b"png")
    assert not re.findall(r"(?:src|href)=\"(?!data:)", html)
    assert "http" not in html.replace("http-equiv", "")
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', html, re.DOTALL)
    assert found is not None
    cloud = json.loads(found[1])["demos"][0]["container"]
    steps = np.frombuffer(base64.b64decode(cloud["points"]), "<u2").reshape(-1, 3)
    points = np.array(cloud["low"]) + steps * np.array(cloud["step"])
    assert np.abs(points - shelf_sample()["container/points"]).max() < 1e-4


def test_names_cannot_break_out_of_the_page() -> None:
    hostile = "</script><script>alert(1)</script>"
    item = dataclasses.replace(shown(), task=hostile)
    html = viewer.page(about(hostile), [item], [item], b"png")
    assert "<script>alert" not in html


def test_histograms_take_one_value_none_and_many() -> None:
    for values in (np.array([3]), np.array([]), np.arange(1000) / 7):
        svg = viewer.histogram("name", "unit", values)
        assert svg.startswith("<figure>")
        assert "nan" not in svg


def test_preview_png_decodes_to_what_was_drawn(panels: dict[str, np.ndarray]) -> None:
    from matplotlib import image

    decoded = image.imread(io.BytesIO(pictures.png(panels["goals"])), format="png")
    assert np.array_equal(np.round(decoded[..., :3] * 255), panels["goals"])


def test_a_dataset_becomes_a_sheet_a_page_and_previews(tiny: Path, tmp_path: Path) -> None:
    png = show.contact_sheet(tiny, tmp_path / "new" / "sheet.png", count=1)
    assert png.read_bytes().startswith(b"\x89PNG")
    html = show.show_html(tiny, tmp_path / "page.html", demos=[2]).read_text(encoding="utf-8")
    assert "demo 2" in html
    assert manifest.read(tiny).content_sha256 in html
    previews = show.preview(tiny)
    assert set(previews) == {"preview/clouds.png", "preview/goals.png"}
    assert all(data.startswith(b"\x89PNG") for data in previews.values())


def test_shown_demos_are_spread_or_those_asked_for(tiny: Path) -> None:
    def numbers(shown: list[pictures.Shown]) -> list[int]:
        return [int(item.sample["meta/demo"]) for item in shown]

    assert numbers(show.choose(tiny, count=3)) == [0, 2, 4]
    assert numbers(show.choose(tiny, count=100)) == [0, 1, 2, 3, 4]
    assert numbers(show.choose(tiny, [3, 1])) == [3, 1]
    assert {item.task for item in show.choose(tiny)} == {"can_cabinet"}


def test_a_demo_that_is_not_there_is_named_and_nothing_is_written(tiny: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="demo 99 is not in it, expected one of 0 to 4"):
        show.contact_sheet(tiny, tmp_path / "folder" / "sheet.png", demos=[99])
    assert not list(tmp_path.iterdir())


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium here")
def test_page_runs_in_a_browser_without_errors(tmp_path: Path) -> None:
    (tmp_path / "page.html").write_text(viewer.page(about(), [shown(0), shown(1)], [shown()], b""), encoding="utf-8")
    flags = (
        "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
        "--disable-component-update --disable-sync --enable-logging=stderr --virtual-time-budget=3000 --dump-dom"
    )
    done = subprocess.run(
        [str(CHROMIUM), *flags.split(), f"--user-data-dir={tmp_path / 'user'}", f"file://{tmp_path / 'page.html'}"],
        capture_output=True,
        text=True,
        timeout=90,
    )
    assert "CONSOLE" not in done.stderr
    assert "demo 0" in re.findall(r'<select id="demo".*?</select>', done.stdout, re.DOTALL)[0]
    assert "superpoints" in re.findall(r'<p class="note" id="counts">(.*?)</p>', done.stdout)[0]
