"""What a method proposes for the demos of a split, as one npz file: all that the judge sees of a method.

Arrays: `demo` (N,) int, `rank` (N,) int (0 is the best of its demo), `T_world_object` (N, 4, 4) float, `score` (N,)
float, and, if some rows have no pose, `status` (N,) text ("ok", or why there is none; such a row's pose is NaN).
Rows may come in any order. A demo that has no row gets none of the success, and stays in every denominator. A judge
that is told K judges the ranks below K; the modes are counted on all.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dapdata import durable
from dapdata.errors import FormatError
from dapdata.npz import read_arrays
from dapdata.records import Placement

Array = NDArray[Any]

REQUIRED = ("demo", "rank", "T_world_object", "score")
ROTATION_ERROR = 1e-3  # largest entry of R^T R - I that still is a rotation, in a file written as float32


@dataclass(frozen=True)
class Predictions:
    """Candidates of all demos, sorted by demo and rank."""

    demo: Array  # (N,) i8
    rank: Array  # (N,) i8, 0 is the best of its demo
    T_world_object: Array  # (N, 4, 4) f8, NaN where status is not "ok"
    score: Array  # (N,) f8
    status: Array  # (N,) str

    def of(self, demo: int) -> Array:
        """(C, 4, 4) poses of one demo that have status "ok", by rank."""
        return np.asarray(self.T_world_object[(self.demo == demo) & (self.status == "ok")])

    def ranks(self, demo: int) -> Array:
        """(C,) i8, the ranks of these poses, rising."""
        return np.asarray(self.rank[(self.demo == demo) & (self.status == "ok")])

    @property
    def sha256(self) -> str:
        """Digest of the decoded arrays."""
        digest = sha256()
        for array in (self.demo, self.rank, self.T_world_object, self.score, np.char.encode(self.status, "utf-8")):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


def collect(placements: Mapping[int, Sequence[Placement]], k: int | None = None) -> Predictions:
    """Predictions from the placements of each demo, ranked by score; among equals the earlier one is better.

    Args:
        placements: By demo, in the order drawn.
        k: The first so many of each demo are ranked, the others come after them as drawn; None: all are ranked.
    """
    rows = [
        (demo, rank, placement)
        for demo, mine in sorted(placements.items())
        for rank, placement in enumerate([*sorted(mine[:k], key=_worse), *(mine[k:] if k is not None else [])])
    ]
    poses = [np.asarray(p.T_world_object, float) if p.status == "ok" else np.full((4, 4), np.nan) for _, _, p in rows]
    return Predictions(
        np.array([demo for demo, _, _ in rows], np.int64),
        np.array([rank for _, rank, _ in rows], np.int64),
        np.array(poses, float).reshape(-1, 4, 4),
        np.array([p.score if np.isfinite(p.score) else -1e9 for _, _, p in rows], float),
        np.array([p.status for _, _, p in rows], str),
    )


def _worse(placement: Placement) -> tuple[bool, float]:
    """Sorts placements best first, those without a pose last."""
    return placement.status != "ok", -placement.score if placement.status == "ok" else 0.0


def write(path: str | Path, predictions: Predictions) -> Path:
    """Writes the file, whole or not at all, and returns its path.

    Raises:
        EnvironmentProblem: if the disk is full.
    """
    path, file = Path(path), io.BytesIO()
    np.savez(
        file,
        demo=predictions.demo,
        rank=predictions.rank,
        T_world_object=predictions.T_world_object,
        score=predictions.score,
        status=predictions.status.astype(str),
    )
    with durable.disk_problems(path.parent, file.tell()):
        durable.replace_file(path, file.getvalue())
    return path


def read(path: str | Path) -> Predictions:
    """The predictions in a file, checked.

    Raises:
        FormatError: not an npz, missing or misshaped arrays, poses that are neither rigid nor flagged, repeated ranks.
    """
    path = Path(path)
    arrays = read_arrays(path, REQUIRED, ("status",))
    demo, rank, T, score = (arrays[name] for name in REQUIRED)
    number = len(demo) if demo.ndim else 0
    shapes = {"demo": (number,), "rank": (number,), "T_world_object": (number, 4, 4), "score": (number,), "status": (number,)}
    for name, array in arrays.items():
        if array.shape != shapes[name]:
            raise FormatError(f"{path}: {name}: got shape {array.shape}, expected {shapes[name]}; one row for each candidate")
    for name, kinds in {"demo": "iu", "rank": "iu", "T_world_object": "f", "score": "fiu", "status": "U"}.items():
        if name in arrays and arrays[name].dtype.kind not in kinds:
            expected = {"U": "text", "iu": "integers"}.get(kinds, "numbers")
            raise FormatError(f"{path}: {name}: got {arrays[name].dtype}, expected {expected}")
    status = arrays.get("status", np.full(number, "ok"))
    _check_rows(path, demo, rank, T, score, status)
    order = np.lexsort((rank, demo))
    return Predictions(
        demo.astype(np.int64)[order],
        rank.astype(np.int64)[order],
        np.where((status == "ok")[:, None, None], T, np.nan).astype(float)[order],
        score.astype(float)[order],
        status[order],
    )


def _check_rows(path: Path, demo: Array, rank: Array, T: Array, score: Array, status: Array) -> None:
    """Raises a FormatError that names the first row whose pose, score or rank cannot be."""
    ok = status == "ok"
    with np.errstate(all="ignore"):
        R = T[:, :3, :3].astype(float)
        rigid = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2), initial=0) < ROTATION_ERROR
        rigid &= (np.linalg.det(np.where(np.isfinite(R), R, 0)) > 0) & (np.abs(T[:, 3] - [0, 0, 0, 1]).max(axis=1) < 1e-6)
        rigid &= (np.abs(T[:, :3, 3]) < 1e3).all(axis=1)
    problems = {
        "T_world_object: not a rigid pose in metres; a candidate without a pose needs a status that says why": ok & ~rigid,
        "score: not finite": ok & ~np.isfinite(score.astype(float)),
        "demo or rank: negative": (demo < 0) | (rank < 0),
    }
    for problem, bad in problems.items():
        if bad.any():
            raise FormatError(f"{path}: row {int(np.argmax(bad))}: {problem}")
    pairs, counts = np.unique(np.stack([demo, rank], axis=1), axis=0, return_counts=True)
    if (counts > 1).any():
        twice, again = pairs[np.argmax(counts > 1)]
        raise FormatError(f"{path}: demo {twice} has rank {again} more than once, expected each rank once; 0 is the best")
