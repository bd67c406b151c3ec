"""Which demos are for training, which for choosing, which to be looked at once.

A demo's split follows from the seed and its index, so a longer dataset begins with a shorter one's splits. In
each block of `BLOCK` demos a permutation decides who is held out, and the number held out follows the shares by
cumulative rounding, so every dataset is within one demo of them per block.

Two demos that share a container or an object instance are never in different splits: the first one's split wins.
A demo whose container was seen in one split and whose object in another can be in neither, and is `unused`.
(Moving the earlier demos instead would change the splits of a dataset when it grows.)
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from dapdata.config import SplitConfig
from dapdata.records import Array
from dapdata.rng import stream

SPLITS = ("train", "val", "test")
UNUSED = "unused"
BLOCK = 10  # demos: small, so that a handful of demos already has all three
BUFFER = 100_000  # rows


def wanted(config: SplitConfig, seed: int) -> Iterator[str]:
    """The split of demo 0, 1, 2, ... before instances are looked at. Endless."""
    block = 0
    while True:
        start, stop = block * BLOCK, (block + 1) * BLOCK
        tests = _rounded(config.test * stop) - _rounded(config.test * start)
        vals = _rounded(config.val * stop) - _rounded(config.val * start)
        order = stream(seed, "split", block).permutation(BLOCK)
        yield from ("test" if rank < tests else "val" if rank < tests + vals else "train" for rank in order.tolist())
        block += 1


def assign(demos: Array, containers: Array, objects: Array, config: SplitConfig, seed: int) -> Array:
    """The split of each demo.

    Args:
        demos: (D,) indices of the demos that came about, ascending.
        containers: (D,) their container instances.
        objects: (D,) their object instances.
        config: The shares of val and test.
        seed: The recipe's seed.

    Returns:
        (D,) words.
    """
    wishes, wish, wished = wanted(config, seed), "", -1
    (owner_of_container, container), (owner_of_object, thing) = _numbered(containers), _numbered(objects)
    splits = np.full(len(demos), UNUSED, dtype=object)
    for row, (demo, c, o) in enumerate(_rows(demos, container, thing)):
        while wished < demo:
            wish, wished = next(wishes), wished + 1
        one, other = owner_of_container[c], owner_of_object[o]
        if not one or not other or one == other:
            splits[row] = owner_of_container[c] = owner_of_object[o] = one or other or wish
    return splits


def distinct(instances: Array) -> Array:
    """The instances without repetition, ascending; np.unique hashes integers, which takes ten times as long for millions."""
    ordered = np.sort(instances)
    return ordered[np.concatenate([[True], np.diff(ordered) > 0])] if len(ordered) else ordered


def _numbered(instances: Array) -> tuple[list[str], Array]:
    """The owner of each instance, nobody ("") yet; and (D,) which instance is each demo's."""
    known, number = np.unique(instances, return_inverse=True)
    return [""] * len(known), number.astype(np.int32)


def _rows(*columns: Array) -> Iterator[tuple[int, ...]]:
    """The rows of integer columns; ten million Python integers at once would be a gigabyte."""
    for start in range(0, len(columns[0]), BUFFER):
        yield from zip(*(column[start : start + BUFFER].tolist() for column in columns))


def _rounded(value: float) -> int:
    """To the nearest integer, halves up; a millionth is forgiven, so that 0.1 + 0.2 is 0.3."""
    return int(value + 0.5 + 1e-6)
