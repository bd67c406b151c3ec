"""The way from noise to one place: what net 1 samples for one scene, and where the object ends up.

A row is a sample: the observed cloud, each superpoint in the colour of its score, at the sampler's steps, and last the
object where that sample puts it. The samples begin with other noise and end on other places: that is what the diffusion is
for. `strip` draws some steps as a picture, `player` all of them for a page: there the scene travels once, as the superpoint
that each pixel sees, and `film.js` colours it by the scores of a step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import loading, page, pictures
from dapdata import rng as rngs
from dapdata.cluster import partition
from dapdata.draw import POINT_RADIUS, Camera, blank, depth_shade, draw_ground, image, lit, paint, splat
from dapdata.errors import UsageError
from dapdata.poses import inverse
from daptrain import affordance
from daptrain.infer import Predictor
from daptrain.page import PREDICTED

Array = NDArray[Any]
Sample = Mapping[str, Array]

ROWS, COLUMNS = 3, 6  # samples, and steps that a strip shows of each
DRAWN = 24  # samples that the rows are chosen from
APART = 0.07  # m: samples that put the object closer together than this have found the same place
PANEL = 236, 214  # px, at most
NOWHERE = np.empty((0, 4, 4))
PALETTE = np.array([(0.80, 0.84, 0.89), (0.92, 0.92, 0.90), (0.98, 0.85, 0.68), (0.93, 0.48, 0.28), (0.70, 0.05, 0.12)])
GUTTER, LEFT, TOP, FOOTER = 10, 96, 46, 70  # px
WORDS = (
    "Each sample starts from other noise. Net 1 turns it into the region of one place for this object, net 2 finds the pose "
    "there, on the cloud as the cameras saw it."
)


@dataclass(frozen=True)
class Film:
    """How some samples of one scene come about. R samples, F steps, S superpoints."""

    sample: Sample
    superpoint: Array  # (N,) superpoint of each container point
    left: Sequence[int]  # (F,) noising steps that are left, from all to 0
    scores: Array  # (R, F, S), about normal at first, the sampled affordance at last
    T_world_object: Array  # (R, 4, 4) where each sample puts the object, NaN for nowhere

    @property
    def has_pose(self) -> Array:
        """(R,) bool."""
        return np.asarray(np.isfinite(self.T_world_object).all(axis=(1, 2)))

    @property
    def choice(self) -> str:
        """Which samples these are."""
        if self.has_pose.any():
            return f"Shown are the best-ranked of {DRAWN} samples that ended on different places."
        return f"None of {DRAWN} samples led to a pose; shown are the first ones."


def film(predictor: Predictor, sample: Sample, seed: int = 0, rows: int = ROWS) -> Film:
    """How samples of one demo come about.

    Args:
        predictor: Networks of a run that samples (`method: dap`).
        sample: The demo, arrays by shard path.
        seed: Of the noise.
        rows: Samples, of those that end on different places: fewer when fewer places were found, and the first ones when
            no sample gave a pose.

    Raises:
        UsageError: a run that does not sample.
    """
    if predictor.method != "dap":
        raise UsageError(f"method: got '{predictor.method}', expected dap; only its affordance comes from noise")
    container, object_ = ((sample[f"{body}/points"], sample[f"{body}/normals"]) for body in ("container", "object"))
    demo = int(sample["meta/demo"])
    inputs, box = predictor.prepare(*container, *object_, rng=rngs.stream(seed, "film/prepare", demo))
    batch = affordance.collate([inputs], np.zeros(1), np.zeros(1, bool), predictor.device)
    # The same draws twice: once to watch, once to go on to a pose.
    steps = predictor.config.sample_steps
    way = affordance.walk(predictor.affordance, batch, DRAWN, steps, rngs.stream(seed, "film", demo))
    left, scores = zip(*((t, np.asarray(s[0].cpu())) for t, s in way))  # scores: of each step (DRAWN, S)
    proposals = predictor.propose(inputs, DRAWN, rngs.stream(seed, "film", demo))
    T_world_box, quality = predictor.finish(proposals, *container, box)
    T_world_object = T_world_box @ inverse(inputs.T_world_box) @ sample["pose/T_world_object_start"]
    chosen = places(T_world_object, quality, rows) or list(range(rows))
    superpoint = partition(*container, predictor.superpoints.count, predictor.superpoints)
    return Film(sample, superpoint, left, np.stack(scores, axis=1)[chosen], T_world_object[chosen])


def places(T_world_object: Array, quality: Array, most: int) -> list[int]:
    """Which of the candidates end on different places: the best one, then the next best far from all before.

    Args:
        T_world_object: (K, 4, 4), NaN where there is no pose.
        quality: (K,) scores, larger is better.
        most: No more than this many.
    """
    chosen: list[int] = []
    for k in np.argsort(-quality, kind="stable"):
        where = T_world_object[k, :3, 3]
        others = T_world_object[chosen, :3, 3]
        if np.isfinite(where).all() and (np.linalg.norm(others - where, axis=1) > APART).all() and len(chosen) < most:
            chosen.append(int(k))
    return chosen


@dataclass(frozen=True)
class _Scene:
    """The container's cloud from the front, seen once and coloured often."""

    film: Film
    camera: Camera
    seen: tuple[Array, Array]  # which point each drawn pixel sees, and how far away it is

    def picture(self, score: Array | None, T_world_object: Array = NOWHERE) -> Array:
        """The cloud in the colours of the superpoints' scores (None: all pale), with objects at (G, 4, 4) poses."""
        sample = self.film.sample
        points = len(self.film.superpoint)
        colors = np.tile(PALETTE[0], (points, 1)) if score is None else score_colors(score[self.film.superpoint])
        canvas = blank(self.camera)
        paint(canvas, self.seen, lit(colors, sample["container/normals"].astype(float), self.camera, 0.25))
        draw_ground(canvas, sample["pose/T_world_container"][:3, 3], radius=0.6)
        pictures.draw_goals(canvas, sample, T_world_object, PREDICTED, 0.95, 0.35)
        return image(canvas)

    def placed(self, row: int) -> Array:
        """The scene with the object where a sample puts it, if it puts it anywhere."""
        return self.picture(None, self.film.T_world_object[row : row + 1] if self.film.has_pose[row] else NOWHERE)


def _scene(film: Film) -> _Scene:
    points, normals = (film.sample[f"container/{what}"].astype(float) for what in ("points", "normals"))
    camera = fitting_view(film.sample, points)
    return _Scene(film, camera, splat(blank(camera).camera, points, normals, POINT_RADIUS))


def step_title(left: int, most: int) -> str:
    """Such as "37 of 100 steps left"."""
    return "noise" if left == most else "sample" if left == 0 else f"{left} of {most} steps left"


def strip(film: Film, columns: int = COLUMNS) -> bytes:
    """Some steps of each row, noise and end among them, and the placed object, as the bytes of a PNG."""
    scene = _scene(film)
    camera = scene.camera
    shown = np.unique(np.linspace(0, len(film.left) - 1, columns).round().astype(int))
    x = [LEFT + c * (camera.width + GUTTER) for c in range(len(shown) + 1)]
    place = pictures.Place(x[-1] + camera.width + GUTTER, TOP + len(film.scores) * (camera.height + GUTTER) + FOOTER)
    for at, title in zip(x, [*(step_title(film.left[i], film.left[0]) for i in shown), "object placed"]):
        place.text(at + camera.width / 2, TOP - 20, title, size=12.5, ha="center", color="#333")
    for row, scores in enumerate(film.scores):
        y = TOP + row * (camera.height + GUTTER)
        place.text(LEFT - 14, y + camera.height / 2, f"sample {row + 1}", size=12.5, ha="right", color="#333")
        for at, i in zip(x, shown):
            place.picture(at, y, scene.picture(scores[i]))
        place.picture(x[-1], y, scene.placed(row))
        if not film.has_pose[row]:
            place.text(x[-1] + camera.width / 2, y + camera.height / 2, "no pose", size=12.5, ha="center")
    ramp, y = score_colors(np.linspace(-1, 1, 256)), place.height - FOOTER + 26
    place.bar(LEFT, y, camera.width, ramp, ["−1", "0", "place here  +1"], "score of a superpoint")
    place.text(x[1] + GUTTER, y + 6, f"{WORDS}\n{film.choice}", size=11, color="#555", linespacing=1.5)
    return place.file()


def player(film: Film, columns: int = COLUMNS) -> str:
    """The film as HTML, with a slider over all steps."""
    scene = _scene(film)
    index, depth = scene.seen
    white = lit(np.ones((len(film.superpoint), 3)), film.sample["container/normals"].astype(float), scene.camera, 0.25)[:, 0]
    shade = np.where(index < 0, 0, white[index] * depth_shade(depth))
    most = film.left[0]
    told = {
        "width": index.shape[1],
        "height": index.shape[0],
        "superpoint": page.squeeze(np.where(index < 0, 0, film.superpoint[index]), "<u2"),
        "shade": page.squeeze(shade * 255, "u1"),  # 0 where nothing is
        "scores": [page.pack(np.clip(scores, -1, 1) * 127, "i1") for scores in film.scores],
        "count": film.scores.shape[2],
        "steps": [step_title(t, most) for t in film.left],
        "strip": np.unique(np.linspace(0, len(film.left) - 1, columns).round().astype(int)).tolist(),
        "scale": np.round(PALETTE * 255).astype(int).tolist(),
    }
    cards = "".join(
        f"<figure><canvas></canvas>{page.picture(pictures.file(scene.placed(row), 'jpeg'), f'sample {row + 1}: object placed')}"
        f"<figcaption>sample {row + 1}{'' if pose else ': no pose'}</figcaption></figure>"
        for row, pose in enumerate(film.has_pose)
    )
    ends = "".join(f"<span>{end}</span>" for end in ("−1", "score of a superpoint", "place here +1"))
    ramp = ", ".join(page.rgb(color) for color in PALETTE)
    demo = int(film.sample["meta/demo"])
    return f"""<p>{escape(WORDS)} {escape(film.choice)} The scene is demo {demo}.</p>
<div class="film"><div class="search"><button type="button" id="play">play</button>
<input type="range" id="step" min="0" max="{len(film.left)}" value="{len(film.left) - 1}" aria-label="step">
<output id="steps"></output></div>
<div class="cards">{cards}</div>
<div class="strip" id="strip"></div>
<div class="legend"><div class="scale" style="background: linear-gradient(90deg, {ramp})"></div>
<div class="ends">{ends}</div></div>
{page.data(told, "film")}</div>
{page.script(Path(__file__).with_name("film.js"))}"""


def fitting_view(sample: Sample, points: Array) -> Camera:
    """The camera in front of the container, of a picture no taller than the (N, 3) points need."""
    camera = pictures.front_view(sample, *PANEL)
    local = (points - camera.T_world_camera[:3, 3]) @ camera.T_world_camera[:3, :3]
    needed = int(np.ptp(camera.focal * local[:, 1] / local[:, 2])) + 16
    return pictures.front_view(sample, PANEL[0], min(PANEL[1], needed))


def score_colors(score: Array) -> Array:
    """(N, 3) colours of scores; what is beyond -1 and 1, as noise is, looks like -1 and 1."""
    at = (np.clip(score, -1, 1) + 1) / 2 * (len(PALETTE) - 1)
    return np.stack([np.interp(at, np.arange(len(PALETTE)), PALETTE[:, k]) for k in range(3)], axis=-1)


def write(run: str | Path, out: str | Path, data: str | Path, demo: int, split: str = "val", device: str = "auto") -> Path:
    """Writes the filmstrip of one demo of a split as a PNG and returns its path."""
    predictor, dataset = Predictor.load(run, device), loading.open(data, split)
    numbers = dataset.index["demo"].tolist()
    if demo not in numbers:
        raise UsageError(f"demo: got {demo}, expected one of the {split} split of {data}, such as {numbers[:5]}")
    out = Path(out)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(strip(film(predictor, dataset[numbers.index(demo)])))
    return out
