"""Clouds of container and object in, 8 ranked placements out: both networks, geometry before and after them, one thread.

The networks were trained on a few demos for some steps, enough to name regions: what is measured is time. `--fast` and the
published number of steps sample net 1 otherwise, and do all the rest alike.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from itertools import cycle
from pathlib import Path

import torch
from timing import Contender, Row, chosen, compare, main

import dapdata
from dapdata import pipeline, recipe, rng
from dapdata.config import FAST
from daptrain import train
from daptrain.infer import Predictor

RECIPES = Path(__file__).parents[1] / "recipes"
TASKS = "can_cabinet", "book_shelf"
STEPS = {"quick": 20, "normal": 200, "long": 400}  # of training
SCENES = {"quick": 4, "normal": 20, "long": 50}
K = 8
PUBLISHED = {"sample_steps": 100}


def run(scale: str, against: str | None) -> Iterator[Row]:
    torch.set_num_threads(1)
    for task in TASKS:
        with tempfile.TemporaryDirectory() as folder:
            changes = ["demos=60", "shard_size=60", "split.val=0", "split.test=0"]
            root = pipeline.generate(recipe.load(RECIPES / f"{task}.yaml", changes), Path(folder) / "dataset")
            pipeline.label(root)
            trained = train(root, Path(folder) / "run", steps=STEPS[scale], device="cpu")
            scenes = [sample for _, sample in zip(range(SCENES[scale]), dapdata.open(root))]
            contenders = {
                "dapdata": placing(Predictor.load(trained, "cpu"), scenes),
                "fast": placing(Predictor.load(trained, "cpu", changes=FAST), scenes),
                "100-steps": placing(Predictor.load(trained, "cpu", changes=PUBLISHED), scenes),
            }
            yield from compare("infer", f"{task}, {K} placements", chosen(contenders, against), len(scenes))


def placing(predictor: Predictor, scenes: list[dapdata.Sample]) -> Contender:
    """A function that places the object of the next scene."""
    following = cycle(scenes)

    def once() -> object:
        sample = next(following)
        clouds = [sample[f"{body}/{part}"] for body in ("container", "object") for part in ("points", "normals")]
        return predictor.predict(*clouds, k=K, rng=rng.stream(0, "benchmark", 0))

    return once


if __name__ == "__main__":
    main(run)
