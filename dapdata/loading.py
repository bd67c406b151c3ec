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
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from dapdata import durable, manifest, remote, rng, store, tables
from dapdata.buckets import is_inside
from dapdata.config import Section
from dapdata.errors import CorruptionError, FormatError, UsageError, hint, nearest, require
from dapdata.manifest import Manifest
from dapdata.records import Array
from dapdata.remote import Place
from dapdata.split import SPLITS
from dapdata.store import COLUMNS, Block, Sample
from dapdata.tables import Index

if TYPE_CHECKING:
    from torch.utils import data

S = TypeVar("S", bound=Section)
BLOCKS_HELD = 4  # shards whose demos a shuffled stream mixes


def open(root: str | Path, split: str | None = None) -> Dataset:
    """A labelled dataset, or one split of it.

    Args:
        root: The dataset's folder, or its URL: s3://, hf://, https:// and whatever else fsspec opens.
        split: "train", "val" or "test"; None for all demos.

    Raises:
        FormatError: if there is no dataset, one of another format, or one that isn't labelled yet.
        UsageError: if there is no such split.
        CorruptionError: if the manifest or the index is not what was written.
    """
    place = remote.locate(root)
    kept = remote.Kept(place)
    with kept.named():
        found, index = _read(kept.root)
    if index is None:
        raise FormatError(f"{place}: generated but not labelled, expected shards; run `dapdata label {place}`")
    known = list(found.splits)
    if split is not None and split not in known:
        raise UsageError(f"split: got '{split}', expected one of {', '.join(SPLITS)}{hint(split, list(SPLITS))}")
    if index.rows != sum(entry.demos for entry in found.splits.values()):
        raise CorruptionError(f"{place}: index.parquet and manifest.json name different demos; run `dapdata verify {place}`")
    mine = index if split is None else index.only(np.flatnonzero(index.read("split") == split))
    return Dataset(place, split, found, mine, kept)


def _read(root: Path) -> tuple[Manifest, Index | None]:
    """Manifest and index that belong together, also while a command puts others in their place: the manifest goes first.

    Without shards there is no index.
    """
    while True:
        before, found = _stamp(root), manifest.read(root)
        try:
            index = manifest.read_index(root) if found.shards else None
        except CorruptionError:
            if _stamp(root) == before:
                raise
            continue
        if _stamp(root) == before:
            return found, index


def _stamp(root: Path) -> tuple[int, int, int] | None:
    path = root / manifest.MANIFEST
    return tables.stamp(path) if path.exists() else None


@dataclass
class Dataset:
    """The demos of a dataset, or of one split of it, in demo order."""

    root: Place  # folder or URL
    split: str | None
    manifest: Manifest = field(repr=False)
    index: Index = field(repr=False)  # columns of index.parquet, for these demos
    _kept: remote.Kept | None = field(default=None, repr=False)  # where the tables lie that columns are read from
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
            raise FormatError(
                f"{self.root}/{manifest.MANIFEST}: recipe.{name}: {' '.join(str(error).split())[:200]}; "
                "read it with the dapdata that made it"
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
        return self.index.rows

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
        if not is_inside(shard):
            raise CorruptionError(f"{self.root}: index.parquet names {shard!r:.80}, expected a shard; run `dapdata verify`")
        paths = _known_paths(paths)
        with remote.unit(self.root, shard, paths) as folder:
            if not store.is_committed(folder) or not durable.is_inside(folder.parents[shard.count("/")], folder):
                raise CorruptionError(
                    f"{folder}: missing, expected a shard that the manifest names; run `dapdata verify {self.root}`"
                )
            return store.read_block(folder, paths)

    def files(self, names: Sequence[str]) -> dict[str, bytes]:
        """The bytes of single files that the manifest names, such as previews, by their path."""
        with remote.working_copy(self.root, files=names) as folder:
            return {name: (folder / name).read_bytes() for name in names}

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
        if not self.shuffle:
            return np.arange(len(self.dataset))
        blocks = self._blocks
        random = rng.stream(self.seed, "stream", epoch)
        order = random.permutation(len(blocks))
        mixed = [
            random.permutation(np.concatenate([blocks[i] for i in order[start : start + BLOCKS_HELD]]))
            for start in range(0, len(order), BLOCKS_HELD)
        ]
        return np.concatenate([np.zeros(0, dtype=np.int64), *mixed])

    @cached_property
    def _blocks(self) -> list[Array]:
        """Indices into the dataset, shard by shard."""
        codes, _ = self.dataset.index.codes("shard")
        order = np.argsort(codes, kind="stable")
        return np.split(order, np.flatnonzero(np.diff(codes[order])) + 1) if len(order) else []

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
        demos = len(self.dataset)
        return demos // self.world_size if self.even else (demos - self.rank - 1) // self.world_size + 1


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
