"""From shards to samples and batches: `dapdata.open(root, split="train")`, then `[i]`, `.torch()` or `.stream()`.

A sample is {path: array} of one demo, such as {"container/points": (N, 3) float32, "pose/T_world_object_goal": (4, 4)
float64, ...}; `records.read_record` makes a record of it. Shards are decoded whole: zarr takes milliseconds for each
slice whatever its size, so a slice a demo is far slower than the unit at once. The only file that knows torch.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from dapdata import durable, manifest, rng, store
from dapdata.config import Section
from dapdata.errors import CorruptionError, FormatError, UsageError, hint, nearest, require
from dapdata.manifest import Manifest
from dapdata.records import Array
from dapdata.split import SPLITS
from dapdata.store import COLUMNS, Block, Sample

if TYPE_CHECKING:
    from torch.utils import data

S = TypeVar("S", bound=Section)
BLOCKS_HELD = 4  # shards whose demos a shuffled stream mixes


def open(root: str | Path, split: str | None = None) -> Dataset:
    """A labelled dataset, or one split of it.

    Args:
        root: The dataset's folder.
        split: "train", "val" or "test"; None for all demos.

    Raises:
        FormatError: if there is no dataset, one of another format, or one that isn't labelled yet.
        UsageError: if there is no such split.
        CorruptionError: if the manifest or the index is not what was written.
    """
    folder = locate(root)
    found, index = _read(folder)
    known = list(found.splits)
    if split is not None and split not in known:
        raise UsageError(f"split: got '{split}', expected one of {', '.join(SPLITS)}{hint(split, list(SPLITS))}")
    chosen = np.arange(len(index["demo"])) if split is None else np.flatnonzero(index["split"] == split)
    return Dataset(folder, split, found, {name: column[chosen] for name, column in index.items()})


def _read(folder: Path) -> tuple[Manifest, dict[str, Array]]:
    """Manifest and index that belong together, also while a command puts others in their place."""
    found = manifest.read(folder)
    while True:
        if not found.shards:
            raise FormatError(f"{folder}: generated but not labelled, expected shards; run `dapdata label {folder}`")
        try:
            return found, manifest.read_index(folder, found)
        except CorruptionError:
            before, found = found, manifest.read(folder)
            if found == before:
                raise


def locate(root: str | Path) -> Path:
    """Where a dataset is on this machine: the one place that turns what a user names into a path."""
    if "://" in str(root):
        raise FormatError(f"{root}: a URL, expected a folder on this machine; copy the dataset here first")
    return Path(root)


@dataclass
class Dataset:
    """The demos of a dataset, or of one split of it, in demo order."""

    root: Path
    split: str | None
    manifest: Manifest = field(repr=False)
    index: Mapping[str, Array] = field(repr=False)  # columns of index.parquet, for these demos
    _held: dict[str, Block] = field(default_factory=dict, repr=False)

    @property
    def recipe(self) -> dict[str, Any]:
        """The resolved recipe."""
        return self.manifest.recipe

    def section(self, name: str, kind: type[S]) -> S:
        """A section of the recipe; a FormatError if there is none that this version knows."""
        try:
            return kind.model_validate_json(json.dumps(self.recipe.get(name, {})))
        except ValueError as error:
            where = f"{self.root / manifest.MANIFEST}: recipe.{name}"
            raise FormatError(
                f"{where}: {' '.join(str(error).split())[:200]}; read it with the dapdata that made it"
            ) from error

    @property
    def task(self) -> str:
        """The task's name."""
        return self.manifest.task

    @property
    def digest(self) -> str:
        """The `content_sha256` of the whole dataset."""
        return self.manifest.content_sha256

    def __len__(self) -> int:
        return len(self.index["demo"])

    def __getitem__(self, number: int) -> Sample:
        """All arrays of one demo by path; the shard that it is in stays in memory until another is asked for."""
        if not -len(self) <= number < len(self):
            raise IndexError(f"demo {number} of {len(self)}")
        shard = str(self.index["shard"][number])
        if shard not in self._held:
            self._held.clear()
            self._held[shard] = self.block(shard)
        return self._held[shard].sample(int(self.index["row"][number]))

    def __iter__(self) -> Iterator[Sample]:
        return (self[i] for i in range(len(self)))

    def block(self, shard: str, paths: Sequence[str] | None = None) -> Block:
        """A whole shard, decoded; only some of its arrays if `paths` says which.

        Raises:
            CorruptionError: if it isn't what was written.
        """
        folder = self.root / shard
        if not store.is_committed(folder) or not durable.is_inside(self.root, folder):
            raise CorruptionError(
                f"{folder}: missing, expected a shard that the manifest names; run `dapdata verify {self.root}`"
            )
        return store.read_block(folder, _known_paths(paths))

    def torch(self, paths: Sequence[str] | None = None) -> data.Dataset[Any]:
        """A map-style dataset of {path: tensor}, all of it in memory.

        Args:
            paths: The arrays to keep; all by default. Clouds are most of the bytes.
        """
        require("torch", "train")
        kind: Any = _torch_classes()["InMemory"]
        dataset: data.Dataset[Any] = kind(self, paths)
        return dataset

    def stream(
        self,
        shuffle: bool = False,
        seed: int = 0,
        paths: Sequence[str] | None = None,
        rank: int | None = None,
        world_size: int | None = None,
        even: bool = True,
    ) -> data.IterableDataset[Any]:
        """An iterable dataset of {path: tensor} from disk, a few shards in memory at a time.

        Ranks and DataLoader workers get parts that don't overlap and together are everything. Each pass is shuffled
        anew; with worker processes call `set_epoch(n)` before each, because theirs know of no earlier one.
        `state_dict()` and `load_state_dict()` go on in the middle of a pass (with worker processes: use torchdata's
        StatefulDataLoader, which asks every worker).

        Args:
            shuffle: Whether to mix: shards at random, and demos among `BLOCKS_HELD` of them.
            seed: Of the order.
            paths: The arrays to read; all by default.
            rank, world_size: As torch.distributed or the variables RANK and WORLD_SIZE say, by default.
            even: Give every rank the same number; a pass then leaves out up to world_size - 1 demos, others each time.
                False: leave out nothing, and some ranks have one demo more.
        """
        require("torch", "train")
        kind: Any = _torch_classes()["Stream"]
        order = Order(self, shuffle, seed, *_rank(rank, world_size), even)
        stream: data.IterableDataset[Any] = kind(self, order, paths)
        return stream


def _known_paths(paths: Sequence[str] | None) -> Sequence[str] | None:
    for path in paths or ():
        if path not in COLUMNS:
            raise UsageError(f"paths: got '{path}', expected arrays of a shard; {nearest(path, list(COLUMNS))}")
    return paths


def _rank(rank: int | None, world_size: int | None) -> tuple[int, int]:
    """Which of how many processes train together."""
    import torch.distributed as distributed

    if distributed.is_available() and distributed.is_initialized():
        found = distributed.get_rank(), distributed.get_world_size()
    else:
        found = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    return found[0] if rank is None else rank, found[1] if world_size is None else world_size


@dataclass(frozen=True)
class Order:
    """In which order a stream gives the demos of a dataset, and which of them are whose. No state."""

    dataset: Dataset
    shuffle: bool
    seed: int
    rank: int
    world_size: int
    even: bool

    def __post_init__(self) -> None:
        if not 0 <= self.rank < self.world_size:
            raise UsageError(f"rank: got {self.rank}, expected 0 to world_size - 1 = {self.world_size - 1}")

    def numbers(self, epoch: int) -> Array:
        """(D,) indices into the dataset in the order of a pass over it, all ranks together."""
        shards = self.dataset.index["shard"]
        blocks = [np.flatnonzero(shards == shard) for shard in dict.fromkeys(shards.tolist())]
        if not self.shuffle:
            return np.arange(len(shards))
        random = rng.stream(self.seed, "stream", epoch)
        order = random.permutation(len(blocks))
        mixed = [
            random.permutation(np.concatenate([blocks[i] for i in order[start : start + BLOCKS_HELD]]))
            for start in range(0, len(order), BLOCKS_HELD)
        ]
        return np.concatenate([np.zeros(0, dtype=np.int64), *mixed])

    def part(self, epoch: int, worker: int, workers: int) -> Array:
        """(D',) indices of one worker of this rank in a pass: a contiguous piece, so that it reads few shards."""
        numbers = self.numbers(epoch)
        if self.even:
            each = len(numbers) // self.world_size
            mine = numbers[self.rank * each : (self.rank + 1) * each]
        else:
            mine = np.array_split(numbers, self.world_size)[self.rank]
        return np.array_split(mine, workers)[worker]

    def __len__(self) -> int:
        """Demos of this rank in a pass."""
        return len(self.part(0, 0, 1))


def read_in_order(dataset: Dataset, numbers: Array, paths: Sequence[str] | None) -> Iterator[Sample]:
    """The samples with these indices, with at most `BLOCKS_HELD` shards in memory."""
    held: dict[str, Block] = {}
    shards, rows = dataset.index["shard"], dataset.index["row"]
    for number in numbers.tolist():
        shard = str(shards[number])
        if shard not in held:
            if len(held) == BLOCKS_HELD:
                held.pop(next(iter(held)))
            held[shard] = dataset.block(shard, paths)
        yield _only(held[shard].sample(int(rows[number])), paths)


def _only(sample: Sample, paths: Sequence[str] | None) -> Sample:
    return sample if paths is None else {path: sample[path] for path in paths}


# With torch ------------------------------------------------------------------------------------------------

_classes: dict[str, Any] = {}


def __getattr__(name: str) -> Any:
    """The torch classes by name, made when they are asked for: a DataLoader's spawned worker unpickles them so."""
    if name in ("InMemory", "Stream"):
        return _torch_classes()[name]
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")


def _tensors(sample: Sample) -> dict[str, Any]:
    """Tensors that own their memory, with torch's dtypes."""
    import torch

    return {path: torch.from_numpy(np.array(array)) for path, array in sample.items()}


def _torch_classes() -> dict[str, Any]:
    """{"InMemory": class, "Stream": class}: made once, because their bases come from torch."""
    if _classes:
        return _classes
    from torch.utils import data

    class InMemory(data.Dataset[Any]):
        """Demos as {path: tensor}, decoded once and kept."""

        def __init__(self, dataset: Dataset, paths: Sequence[str] | None) -> None:
            numbers = np.arange(len(dataset))
            self.samples = [_tensors(sample) for sample in read_in_order(dataset, numbers, paths)]

        def __len__(self) -> int:
            return len(self.samples)

        def __getitem__(self, number: int) -> dict[str, Any]:
            return self.samples[number]

    class Stream(data.IterableDataset[Any]):
        """Demos as {path: tensor} from disk; knows its pass and its place in it."""

        def __init__(self, dataset: Dataset, order: Order, paths: Sequence[str] | None) -> None:
            self.dataset, self.order, self.paths = dataset, order, paths
            self.epoch, self.position = 0, 0

        def __len__(self) -> int:
            return len(self.order)

        def __iter__(self) -> Iterator[dict[str, Any]]:
            worker = data.get_worker_info()
            number, count = (worker.id, worker.num_workers) if worker else (0, 1)
            part = self.order.part(self.epoch, number, count)
            for sample in read_in_order(self.dataset, part[self.position :], self.paths):
                self.position += 1
                yield _tensors(sample)
            self.epoch, self.position = self.epoch + 1, 0

        def set_epoch(self, epoch: int) -> None:
            """Starts at the beginning of a pass; with worker processes call it before each, as for DistributedSampler."""
            self.epoch, self.position = epoch, 0

        def state_dict(self) -> dict[str, int]:
            """Where it is: enough to go on from there."""
            return {"epoch": self.epoch, "position": self.position, "seed": self.order.seed}

        def load_state_dict(self, state: Mapping[str, int]) -> None:
            """Goes on where `state_dict` was taken; the same dataset, seed and ranks are assumed."""
            if state["seed"] != self.order.seed:
                raise UsageError(f"stream: state of seed {state['seed']}, expected {self.order.seed}; open it with that seed")
            self.epoch, self.position = state["epoch"], state["position"]

    for kind in (InMemory, Stream):
        kind.__qualname__ = kind.__name__
        _classes[kind.__name__] = kind
    return _classes
