"""The only maker of random generators.

A generator belongs to (seed, stage, demo, attempt) and to nothing else, so a demo is the same
whatever the number of workers, the order and the retries.
"""

from __future__ import annotations

from hashlib import sha256

import numpy as np


def stream(seed: int, stage: str, demo: int, attempt: int = 0) -> np.random.Generator:
    """The generator of one attempt at one demo in one stage.

    Args:
        seed: The recipe's seed, 0 or more.
        stage: Name of the stage, such as "observe".
        demo: Index of the demo in the dataset.
        attempt: How many attempts of this demo were rejected before.

    Source: numpy's SeedSequence with a sha256 spawn key; Python's own hash is salted per process.
    """
    words = np.frombuffer(sha256(stage.encode()).digest()[:16], dtype="<u4")
    key = (*(int(word) for word in words), demo, attempt)
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))
