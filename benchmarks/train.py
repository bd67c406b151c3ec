"""One step of the optimiser of each network: batches made, loss, gradient and update; as it is, and in ways that may be faster.

All contenders take the same steps on the same demos with weights of their own. `torch.compile` needs a C++ compiler and
compiles before the clock starts; `bfloat16` is torch's autocast.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import torch
from timing import Contender, Row, chosen, compare, main

import dapdata
from dapdata import pipeline, recipe
from dapdata.config import TrainConfig
from daptrain import loop
from daptrain.checkpoint import NetName
from daptrain.prepare import LabelRule

RECIPE = Path(__file__).parents[1] / "recipes/can_cabinet.yaml"
DEMOS = {"quick": 16, "normal": 64, "long": 256}
ROUNDS = {"quick": 3, "normal": 20, "long": 100}
CPU = torch.device("cpu")
RATE = 1e-3


def run(scale: str, against: str | None) -> Iterator[Row]:
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        changes = [f"demos={DEMOS[scale]}", f"shard_size={DEMOS[scale]}", "split.val=0", "split.test=0"]
        root = pipeline.generate(recipe.load(RECIPE, changes), Path(folder) / "dataset")
        pipeline.label(root)
        dataset, config = dapdata.open(root), TrainConfig()
        rule = LabelRule(dataset.recipe["label"]["eps_place"], dataset.recipe["label"]["kind"])
        material = loop.Material(loop.prepared(dataset, len(dataset), rule, config), [], rule, 0, dataset.task)
    sizes: dict[NetName, str] = {
        "affordance": f"{config.scenes_per_step} scenes, {config.levels_per_scene} noise levels each",
        "pose": f"{config.crops_per_step} crops",
    }
    for name, size in sizes.items():
        contenders = {
            "dapdata": steps(name, material, config),
            "bfloat16": steps(name, material, config, is_half=True),
        }
        if shutil.which("c++") or shutil.which("g++"):
            contenders["torch-compile"] = steps(name, material, config, is_compiled=True)
        yield from compare("train", f"a step of {name}: {size}", chosen(contenders, against), ROUNDS[scale])


def steps(
    name: NetName, material: loop.Material, config: TrainConfig, is_compiled: bool = False, is_half: bool = False
) -> Contender:
    """A function that takes the next step of a network of its own."""
    network, step = loop.build(name, config, "dap", material), count()
    optimizer = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=config.weight_decay, fused=True)
    if is_compiled:
        network.compile(dynamic=True)

    def once() -> object:
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=is_half):
            return loop.train_step(network, optimizer, material, config, next(step), RATE, CPU)

    return once


if __name__ == "__main__":
    main(run)
