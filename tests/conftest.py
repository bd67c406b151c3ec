"""Datasets that several tests look at, each built once; whoever changes one takes a copy."""

from __future__ import annotations

import json
import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
import toy_stages

from dapdata import pipeline, recipe

os.environ.setdefault("OMP_NUM_THREADS", "1")
# A suite that was started in the background ignores Ctrl-C, and so would the commands that it starts.
signal.signal(signal.SIGINT, signal.default_int_handler)

TINY = {
    "name": "tiny",
    "seed": 6,  # of five demos: three for training, one for each other split
    "demos": 5,
    "shard_size": 3,
    "scene": {"task": "can_cabinet"},
    "cameras": {"width": 160, "height": 120},
    "split": {"val": 0.2, "test": 0.2},
}


@pytest.fixture
def in_memory(tmp_path: Path) -> Iterator[Path]:
    """A folder in memory, where there is such a thing: where fsyncs are only counted, waiting for a disk proves nothing."""
    memory = Path("/dev/shm")
    if not os.access(memory, os.W_OK):
        yield tmp_path
        return
    with tempfile.TemporaryDirectory(dir=memory) as folder:
        yield Path(folder)


@pytest.fixture(scope="session")
def tiny_recipe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recipe of `tiny_dataset` as a file (JSON is YAML)."""
    path = tmp_path_factory.mktemp("recipes") / "tiny.yaml"
    path.write_text(json.dumps(TINY, indent=1))
    return path


@pytest.fixture(scope="session")
def tiny_dataset(tiny: Path) -> Path:
    """The dataset of `tiny_recipe`, labelled. Not to be changed."""
    return tiny


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small labelled dataset of true scenes, through simulator, cameras, superpoints and labels. Not to be changed."""
    root = tmp_path_factory.mktemp("tiny") / "tiny"
    pipeline.generate(recipe.from_resolved(TINY), root, engine="inline")
    pipeline.label(root, engine="inline")
    return root


@pytest.fixture(scope="session")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A labelled dataset of random arrays: 8 demos asked for, in units of 3. Not to be changed."""
    return make_toy(tmp_path_factory.mktemp("toy") / "toy")


@pytest.fixture
def toy_copy(toy: Path, tmp_path: Path) -> Path:
    """A copy of `toy` that a test may damage."""
    return Path(shutil.copytree(toy, tmp_path / "toy"))


def make_toy(root: Path | str, demos: int = 8, shard_size: int = 3, workers: int = 1, engine: str = "inline") -> Path:
    """Generates and labels with the toy stages."""
    pipeline.generate(toy_stages.toy_recipe(demos, shard_size), root, workers=workers, engine=engine, table="toy_stages")
    pipeline.label(root, workers=workers, engine=engine, table="toy_stages")
    return root
