"""The way from noise to one place, as a picture: what net 1 samples for one scene, and where the object ends up.

A row is a sample: the observed cloud, each superpoint in the colour of its score, at a few of the sampler's steps, and
last the object where that sample puts it. The samples begin with other noise and end on other places: that is what
the diffusion is for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import loading, pictures
from dapdata import rng as rngs
from dapdata.cluster import partition
from dapdata.draw import POINT_RADIUS, Camera, blank, draw_ground, image, lit, paint, splat
from dapdata.errors import UsageError
from dapdata.poses import inverse
from daptrain import affordance
from daptrain.infer import Predictor
from daptrain.page import PREDICTED

Array = NDArray[Any]
Sample = Mapping[str, Array]

ROWS, COLUMNS = 3, 6  # samples, and steps that are shown of each
DRAWN = 24  # samples that the rows are chosen from
APART = 0.07  # m: samples that put the object closer together than this have found the same place
PANEL = 236, 214  # px, at most
NOWHERE = np.empty((0, 4, 4))
PALETTE = np.array([(0.80, 0.84, 0.89), (0.92, 0.92, 0.90), (0.98, 0.85, 0.68), (0.93, 0.48, 0.28), (0.70, 0.05, 0.12)])
GUTTER, LEFT, TOP, FOOTER = 10, 96, 46, 70  # px


def film(predictor: Predictor, sample: Sample, seed: int = 0, rows: int = ROWS, columns: int = COLUMNS) -> bytes:
    """The filmstrip of one demo as the bytes of a PNG.

    Args:
        predictor: Networks of a run that samples (`method: dap`).
        sample: The demo, arrays by shard path.
        seed: Of the noise.
        rows: Samples shown, of those that end on different places: fewer when fewer places were found, and the first
            ones when no sample gave a pose.
        columns: Steps shown of each, noise and end among them.

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
    shown = np.unique(np.linspace(0, len(left) - 1, columns).round().astype(int))
    superpoint = partition(*container, predictor.superpoints.count, predictor.superpoints)
    frames = [[scores[i][k][superpoint] for i in shown] for k in chosen]
    return strip(sample, frames, [left[i] for i in shown], left[0], T_world_object[chosen])


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


def strip(sample: Sample, frames: Sequence[Sequence[Array]], left: Sequence[int], T: int, T_world_object: Array) -> bytes:
    """The rows of pictures with their titles, as the bytes of a PNG.

    Args:
        sample: The demo.
        frames: For each row and column the (N,) score of each container point.
        left: For each column the noising steps that are left.
        T: Noising steps in all.
        T_world_object: (rows, 4, 4) where each row's object ends up.
    """
    points, normals = (sample[f"container/{what}"].astype(float) for what in ("points", "normals"))
    camera = fitting_view(sample, points)
    seen = splat(blank(camera).camera, points, normals, POINT_RADIUS)

    def picture(colors: Array, T_world_object: Array) -> Array:
        canvas = blank(camera)
        paint(canvas, seen, lit(colors, normals, camera, 0.25))
        draw_ground(canvas, sample["pose/T_world_container"][:3, 3], radius=0.6)
        pictures.draw_goals(canvas, sample, T_world_object, PREDICTED, 0.95, 0.35)
        return image(canvas)

    columns = [LEFT + c * (camera.width + GUTTER) for c in range(len(left) + 1)]
    place = pictures.Place(columns[-1] + camera.width + GUTTER, TOP + len(frames) * (camera.height + GUTTER) + FOOTER)
    titles = ["noise" if t == T else "sample" if t == 0 else f"{t} of {T} steps left" for t in left]
    for x, title in zip(columns, [*titles, "object placed"]):
        place.text(x + camera.width / 2, TOP - 20, title, size=12.5, ha="center", color="#333")
    for r, (row, pose) in enumerate(zip(frames, T_world_object)):
        y = TOP + r * (camera.height + GUTTER)
        place.text(LEFT - 14, y + camera.height / 2, f"sample {r + 1}", size=12.5, ha="right", color="#333")
        for x, score in zip(columns, row):
            place.picture(x, y, picture(score_colors(score), NOWHERE))
        there = np.isfinite(pose).all()
        place.picture(columns[-1], y, picture(np.tile(PALETTE[0], (len(points), 1)), pose[None] if there else NOWHERE))
        if not there:
            place.text(columns[-1] + camera.width / 2, y + camera.height / 2, "no pose", size=12.5, ha="center")
    ramp, y = score_colors(np.linspace(-1, 1, 256)), place.height - FOOTER + 26
    place.bar(LEFT, y, camera.width, ramp, ["−1", "0", "place here  +1"], "score of a superpoint")
    caption = (
        "Each row starts from other noise. Net 1 turns it into the region of one place for this object, net 2 finds the pose "
        f"there, on the cloud as the cameras saw it.\nThe rows are the best-ranked of {DRAWN} samples that ended on different "
        "places."
    )
    place.text(columns[1] + GUTTER, y + 6, caption, size=11, color="#555", linespacing=1.5)
    return place.file()


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
    out.write_bytes(film(predictor, dataset[numbers.index(demo)]))
    return out
