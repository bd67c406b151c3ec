"""Contact sheets and the HTML page: they show what the arrays say, from one file, whatever the names are."""

from __future__ import annotations

import base64
import dataclasses
import io
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from browser import needs_browser, open_page

from dapdata import loading, manifest, pictures, records, rng, show, viewer
from dapdata.draw import look_at
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
        "object_superpoints/points": np.tile([0.8, 0.3, 0.1], (10, 1)),
        "container_superpoints/points": draw.uniform(0.3, 0.6, (count, 3)),
        "correspondence/object_superpoint": [0, 1, 2],
        "correspondence/container_superpoint": [4, 4, 3],
        "correspondence/distance": [0.01, 0.02, 0.03],
        "pose/T_world_object_start": pose(None, (0.8, 0.3, 0.1)),
        "container/view": np.arange(6000) % 2,
        "object/view": np.zeros(500),
        "camera/K": np.tile([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]], (2, 1, 1)),
        "camera/T_world_camera": np.stack([look_at((1.5, y, 0.5), (0.5, 0, 0.1)) for y in (-0.4, 0.4)]),
    }
    dtypes = {column.metadata["path"]: column.metadata["dtype"] for column in records.columns()}
    return {path: np.asarray(value, dtypes[path]) for path, value in made.items()}


def shown(demo: int = 0) -> pictures.Shown:
    return pictures.Shown(shelf_sample(demo), "shelf", "train")


@pytest.fixture(scope="module")
def sample() -> dict[str, np.ndarray]:
    return shelf_sample()


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


def test_a_view_holds_the_points_and_every_pose(sample: pictures.Sample) -> None:
    view = viewer.view(shown())
    for body in ("container", "object"):
        cloud = view["clouds"][body]
        steps = np.frombuffer(base64.b64decode(cloud["points"]), "<u2").reshape(-1, 3)
        points = np.array(cloud["low"]) + steps * np.array(cloud["step"])
        assert np.abs(points - sample[f"{body}/points"]).max() < 1e-4
        assert {len(base64.b64decode(values)) for values in cloud["values"].values()} == {len(points)}
    score = np.frombuffer(base64.b64decode(view["clouds"]["container"]["values"]["affordance"]), "u1") / 127.5 - 1
    wanted = sample["container_superpoints/affordance"][sample["container/superpoint"]]
    assert np.allclose(score, wanted, atol=0.005)
    layers = {layer["name"]: layer for layer in view["layers"]}
    poses = np.array(layers["demonstrated goal"]["poses"] + layers["other valid goals"]["poses"])
    assert np.allclose(poses.reshape(-1, 3, 4), sample["goals/T_world_object"][:, :3], atol=1e-5)
    assert layers["rejected: unsupported"]["says"] == ["rejected: unsupported"]
    assert not layers["rejected: unsupported"]["on"]
    ends = np.frombuffer(base64.b64decode(layers["correspondences"]["ends"]), "<f4").reshape(-1, 2, 3)
    superpoints = (sample[f"{body}_superpoints/points"] for body in ("object", "container"))
    wanted = [points[sample[f"correspondence/{body}_superpoint"]] for points, body in zip(superpoints, ("object", "container"))]
    assert np.array_equal(ends, np.stack(wanted, axis=1))
    assert np.frombuffer(base64.b64decode(layers["cameras"]["ends"]), "<f4").size == 2 * 8 * 2 * 3


def test_a_view_reaches_around_everything_that_it_can_show(sample: pictures.Sample) -> None:
    view = viewer.view(shown())
    far = sample["camera/T_world_camera"][:, :3, 3]
    assert np.abs(far - view["center"]).max() <= view["reach"]


def test_long_clouds_are_thinned_evenly(sample: pictures.Sample) -> None:
    cloud = viewer.view(shown(), most=100)["clouds"]["container"]
    assert len(base64.b64decode(cloud["values"]["height"])) == 100
    heights = np.frombuffer(base64.b64decode(cloud["values"]["height"]), "u1")
    assert heights.max() > 240, "points of the back, which come last"


class Loads(HTMLParser):
    """Collects what a page would load, and the scripts in it."""

    def __init__(self) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loads += [value or "" for name, value in attrs if name in ("src", "href", "srcset")]


def looked_into(html: str) -> Loads:
    parser = Loads()
    parser.feed(html)
    return parser


def test_the_page_of_a_dataset_is_one_file_that_loads_nothing(tiny: Path) -> None:
    html = show.dataset_page(loading.open(tiny), show.choose(tiny, count=1))
    loads = looked_into(html).loads
    assert len(loads) > 5
    assert all(target.startswith(("data:", "#")) for target in loads)
    assert manifest.read(tiny).content_sha256 in html
    assert len(html) < 4e6, "with one demo; the plotting library is 2.0 MB of it"


HOSTILE = """</script><script>problems.push("ran")</script><img src=x onerror='problems.push("ran")'>"&'"""


@pytest.fixture
def hostile(tiny: Path) -> str:
    """A page of a dataset whose every name is hostile."""
    found = loading.open(tiny)
    about = found.manifest.model_copy(
        update={
            "name": HOSTILE,
            "task": HOSTILE,
            "recipe": {"name": HOSTILE},
            "rejects": manifest.Rejects(attempts={HOSTILE: 2}, demos={HOSTILE: 1}, goals={HOSTILE: 3}),
            "created_by": {HOSTILE: HOSTILE},
        }
    )
    found.index["task"][0] = HOSTILE  # columns are kept once they were read
    found.index["split"][:] = HOSTILE
    shown = [dataclasses.replace(s, task=HOSTILE, split=HOSTILE) for s in show.choose(tiny, count=1)]
    return show.dataset_page(dataclasses.replace(found, manifest=about), shown)


def test_names_cannot_break_out_of_the_page(hostile: str) -> None:
    assert "<script>problems" not in hostile
    assert looked_into(hostile).tags.count("script") == hostile.count("<script")
    assert [load for load in looked_into(hostile).loads if load == "x"] == []


def test_preview_png_decodes_to_what_was_drawn(panels: dict[str, np.ndarray]) -> None:
    from matplotlib import image

    decoded = image.imread(io.BytesIO(pictures.file(panels["goals"])), format="png")
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


DRAWN = """
const colours = async () => {  // how many pixels of the view are about as orange as the demonstrated goal
  const image = new Image(), canvas = document.createElement("canvas");
  image.src = await Plotly.toImage($("#stage"), { format: "png", width: 300, height: 200 });
  await image.decode();
  canvas.width = 300; canvas.height = 200;
  const context = canvas.getContext("2d");
  context.drawImage(image, 0, 0);
  const p = context.getImageData(0, 0, 300, 200).data;
  let orange = 0, any = 0;
  for (let i = 0; i < p.length; i += 4) {
    any += p[i + 3] > 0;
    orange += p[i + 3] > 0 && p[i] > 1.2 * p[i + 1] && p[i + 1] > 2 * p[i + 2];
  }
  return { orange, any };
};
const box = name => $(`#layers input[name="${name}"]`);
const numbers = column => $$(`tbody tr td:nth-child(${column})`).map(cell => Number(cell.textContent));
"""


@needs_browser
def test_the_page_of_a_dataset_draws_sorts_and_filters(tiny: Path, tmp_path: Path) -> None:
    html = show.dataset_page(loading.open(tiny), show.choose(tiny, count=2))
    script = """
    $$("th button")[2].click();
    const falling = numbers(3);
    $$("th button")[2].click();
    const rising = numbers(3);
    $("input[type=search]").value = "train goals>=3";
    $("input[type=search]").dispatchEvent(new Event("input"));
    const left = { goals: numbers(3), splits: $$(".sortable td:nth-child(2)").map(cell => cell.textContent) };
    const buttons = $$(".modebar-btn").map(button => button.dataset.title);
    return { falling, rising, left, demo: $("#demo").selectedOptions[0].text, buttons };
    """
    found = open_page(html, tmp_path, DRAWN + script, "view-4")
    assert "demo 4" in found["demo"], "the address chooses"
    goals = manifest.read_index(tiny)["goals"]
    assert found["rising"] == sorted(goals.tolist()) == found["falling"][::-1]
    train = manifest.read_index(tiny)["split"] == "train"
    assert sorted(found["left"]["goals"]) == sorted(goals[train & (goals >= 3)].tolist())
    assert set(found["left"]["splits"]) == {"train"}
    assert found["buttons"]
    assert not [title for title in found["buttons"] if "hare" in title or "loud" in title], "nothing can be sent anywhere"


@pytest.mark.slow
@needs_browser
def test_a_switch_takes_what_it_names_out_of_the_view(tiny: Path, tmp_path: Path) -> None:
    html = show.dataset_page(loading.open(tiny), show.choose(tiny, count=1))
    script = "const before = await colours(); box('demonstrated goal').click(); return { before, after: await colours() };"
    found = open_page(html, tmp_path, DRAWN + script)
    assert found["before"]["any"] > 5000, "the view is not empty"
    assert found["before"]["orange"] > 100
    assert found["after"]["orange"] < found["before"]["orange"] / 4


@pytest.mark.slow
@needs_browser
def test_who_turned_the_view_and_switches_a_layer_goes_on_from_there(tiny: Path, tmp_path: Path) -> None:
    html = show.dataset_page(loading.open(tiny), show.choose(tiny, count=1))
    script = """
    const eye = () => JSON.stringify($("#stage").layout.scene.camera.eye);
    const rest = async () => { for (let last = ""; last !== eye(); await until(() => false, 10)) last = eye(); return eye(); };
    const canvas = $("#stage canvas"), box = canvas.getBoundingClientRect();
    const mouse = (type, dx, buttons) => canvas.dispatchEvent(new MouseEvent(type,
      { bubbles: true, buttons, clientX: box.x + box.width / 2 + dx, clientY: box.y + 100 }));
    const eyes = [await rest()];
    mouse("mousedown", 0, 1);
    for (let dx = 10; dx <= 60; dx += 10) { mouse("mousemove", dx, 1); await until(() => false, 2); }
    mouse("mouseup", 60, 0);
    eyes.push(await rest());
    $("#nearer").click();
    eyes.push(await rest());
    $$("#layers input")[0].click();
    eyes.push(await rest());
    return eyes;
    """
    front, turned, nearer, switched = open_page(html, tmp_path, script)
    assert front != turned != nearer
    assert switched == nearer


@pytest.mark.slow
@needs_browser
def test_every_layer_and_colour_of_the_view_is_drawn_on_a_phone_too(tiny: Path, tmp_path: Path) -> None:
    html = show.dataset_page(loading.open(tiny), show.choose(tiny, count=1))
    script = """
    const shown = () => $("#stage").data.filter(t => t.visible).map(t => t.name);
    const start = shown();
    $$("#layers input").filter(b => !b.checked).forEach(b => b.click());
    const all = shown(), scales = new Set();
    for (const choice of $$("input[name=colour]")) {
      choice.click();
      scales.add(JSON.stringify($("#stage").data.find(t => t.intensity)?.intensity.slice(0, 6000)));
    }
    const middle = name => {
      const trace = $("#stage").data.find(t => t.name === name);
      return ["x", "y", "z"].map(a => (Math.min(...trace[a]) + Math.max(...trace[a])) / 2);
    };
    const middles = ["container cloud", "demonstrated goal", "object cloud, demonstrated"].map(middle);
    $("#theme").click();
    const eye = () => JSON.stringify($("#stage").layout.scene.camera.eye), eyes = [eye()];
    for (const id of ["above", "nearer", "further", "front"]) {
      $("#" + id).click();
      await until(() => eye() !== eyes.at(-1));
      eyes.push(eye());
    }
    return { start, all, middles, layers: $$("#layers input").map(b => b.name), scales: scales.size,
      eyes: new Set(eyes).size, dark: getComputedStyle(document.body).backgroundColor, wide: document.body.scrollWidth };
    """
    found = open_page(html, tmp_path, script, width=500)
    assert set(found["start"]) < set(found["all"]) == set(found["layers"])
    assert found["scales"] == 5
    sample = loading.open(tiny)[0]
    low, high = (getattr(sample["container/points"], end)(axis=0) for end in ("min", "max"))
    cloud, goal, moved = np.array(found["middles"])
    assert np.allclose(cloud, (low + high) / 2, atol=0.008)
    assert np.allclose(goal, sample["pose/T_world_object_goal"][:3, 3], atol=1e-3)
    assert np.allclose(moved, goal, atol=0.02), "the cloud of the object is moved to where the object stands"
    assert found["eyes"] == 4, "above, nearer, and back to the front"
    assert found["dark"] == "rgb(20, 24, 31)"
    assert found["wide"] <= 500, "nothing makes the page wider than the window"


@pytest.mark.slow
@needs_browser
def test_hostile_names_are_shown_as_text(hostile: str, tmp_path: Path) -> None:
    script = """
    return { title: document.title, head: $("h1").textContent, cell: $("tbody td:nth-child(2)").textContent,
      option: $("#demo").selectedOptions[0].text, bars: $$(".ytick").map(t => t.textContent), images: $$("img").length };
    """
    found = open_page(hostile, tmp_path, script)
    assert found["title"] == found["head"] == found["cell"] == HOSTILE
    assert HOSTILE in found["option"]
    assert found["images"] == 1, "the contact sheet alone"
