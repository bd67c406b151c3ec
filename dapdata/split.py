"""Which demos are for training, which for choosing, which to be looked at once.

A demo's split follows from the seed and its index, so a longer dataset begins with a shorter one's splits. In
each block of `BLOCK` demos a permutation decides who is held out, and the number held out follows the shares by
cumulative rounding, so every dataset is within one demo of them per block.

Two demos that share a container or an object instance are never in different splits: the first one's split wins.
A demo whose container was seen in one split and whose object in another can be in neither, and is `unused`.
(Moving the earlier demos instead would change the splits of a dataset when it grows.)
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice

from dapdata.config import SplitConfig
from dapdata.rng import stream

SPLITS = ("train", "val", "test")
UNUSED = "unused"
BLOCK = 10  # demos: small, so that a handful of demos already has all three


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


def assign(demos: int, instances: Iterable[tuple[int, int, int]], config: SplitConfig, seed: int) -> dict[int, str]:
    """The split of each demo.

    Args:
        demos: Number of demos in the dataset.
        instances: (demo, container instance, object instance) of those that came about, in demo order.
        config: The shares of val and test.
        seed: The recipe's seed.
    """
    wishes = list(islice(wanted(config, seed), demos))
    containers: dict[int, str] = {}
    objects: dict[int, str] = {}
    splits: dict[int, str] = {}
    for demo, container, thing in instances:
        known = {owner for owner in (containers.get(container), objects.get(thing)) if owner is not None}
        if len(known) == 2:
            splits[demo] = UNUSED
            continue
        splits[demo] = known.pop() if known else wishes[demo]
        containers[container] = objects[thing] = splits[demo]
    return splits


def _rounded(value: float) -> int:
    """To the nearest integer, halves up; a millionth is forgiven, so that 0.1 + 0.2 is 0.3."""
    return int(value + 0.5 + 1e-6)
