"""Which motion carries one cloud onto another: of a thing that was moved, seen in part before and in part after.

Sixty turns, the rotations of an icosahedron, each brought to the other cloud's middle and refined on a few hundred points;
the best of them refined on all. A refinement pairs nearest points both ways, only where normals agree, and moves the cloud
along the mean normal of each pair (Rusinkiewicz, "A Symmetric Objective Function for ICP", 2019). Both clouds then say how
much of them the other one explains, and what else would fit as well.

Considered and not taken: Open3D's FPFH features with RANSAC or fast global registration, four seeds each, followed by the
same refinement. On ten demonstrations each of fruits, cans, plates and mugs, scanned in simulation, 9, 10, 10 and 3
came out within 10 mm and 15 degrees here, 8, 10, 10 and 2 with RANSAC, 7, 6, 10 and 2 with fast global registration.
Nothing is drawn here, and Open3D is not needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from dapdata.poses import angle_between, inverse, pose, rotate, rotation_about, rotation_by, transform
from dapdata.records import Array

FEW = 200  # points of each cloud on which all turns are tried
KEPT = 8  # turns that are refined on all points
APART, APART_TURN = 0.01, 0.3  # m and rad: less, and two refined turns are one
ROUNDS, CONVERGED = 15, 1e-5  # steps of a refinement at the most; m or rad, a smaller one ends it
SAME_SIDE = 0.5  # cosine between the normals of a pair
HUBER = 0.002  # m: residuals above this count linearly
STIFFNESS = 1e-6  # of a prior toward no step: what nothing determines, as the turn of a ball, stays
EXPLAINED = 2.0  # spacings: a point is explained by the other cloud if that is this near, and faces the same way
CUT = 3.0  # spacings: whatever is farther off counts as this far
START_WEIGHT = 0.5  # of the first cloud in the misfit: what it shows may be hidden in the second, seldom the reverse
AS_GOOD, AS_GOOD_BY = 1.15, 1e-4  # factor, and m: misfits that are no more than this above the best one are as good
SAME_SURFACE = 0.8  # share of the points by which surfaces are compared


@dataclass(frozen=True)
class Surface:
    """A cloud of even spacing. N points."""

    points: Array  # (N, 3) f8, m
    normals: Array  # (N, 3) f8, unit

    @cached_property
    def tree(self) -> Any:
        """For nearest points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points)

    def moved(self, T: Array) -> Surface:
        """The cloud after a motion."""
        return Surface(transform(T, self.points), rotate(T, self.normals))

    def with_points_of(self, other: Surface) -> Surface:
        """Both clouds together."""
        return Surface(np.concatenate([self.points, other.points]), np.concatenate([self.normals, other.normals]))

    def thinned(self, count: int) -> Surface:
        """Every so many-th point, no more than `count` of them."""
        step = -(-len(self.points) // count)
        return Surface(self.points[::step], self.normals[::step])


@dataclass(frozen=True)
class Fit:
    """A motion that a cloud may have made, and how well it explains what was seen."""

    T: Array  # (4, 4) f8: from where the cloud was to where it went, both in the world frame
    misfit: float  # m, mean distance of the clouds, cut; smaller is better
    explained_before: float  # share of the first cloud that the second explains
    explained_after: float  # share of the second that the first explains: what is missing came from nowhere
    rms: float  # m, of the distances of explained points


def turns_all() -> Array:
    """(60, 3, 3) rotations of an icosahedron: none is farther than 45 degrees from one of them."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.create_group("I").as_matrix())


def turns_upright(count: int = 24) -> Array:
    """(count, 3, 3) turns about the vertical; the first is none."""
    return np.stack([rotation_about((0, 0, 1), 2 * np.pi * i / count) for i in range(count)])


def register(before: Surface, after: Surface, spacing: float, turns: Array) -> list[Fit]:
    """The motions that fit, best first; at most `KEPT`, at least one.

    Args:
        before, after: The thing where it was and where it went, m; each seen from the same or from other sides.
        spacing: Of the points of both, m.
        turns: (R, 3, 3) rotations to begin with.
    """
    few, few_after = before.thinned(FEW), after.thinned(FEW)
    middle, middle_after = _middle(before.points), _middle(after.points)
    reach = float(np.ptp(before.points, axis=0).max())
    tried = []
    for R in turns:
        T = pose(R, middle_after - R @ middle)
        for gate in (0.4 * reach, 0.15 * reach):
            T = refine(few, few_after, T, gate, ROUNDS // 2)
        tried.append(_fit(few, few_after, T, spacing))
    kept: list[Fit] = []
    for fit in sorted(tried, key=lambda fit: fit.misfit):
        if len(kept) < KEPT and all(_differ(fit.T, other.T, middle) for other in kept):
            kept.append(fit)
    return sorted((polish(before, after, fit.T, spacing) for fit in kept), key=lambda fit: fit.misfit)


def polish(before: Surface, after: Surface, T: Array, spacing: float) -> Fit:
    """The motion near T that fits best."""
    for gate in (2 * EXPLAINED * spacing, EXPLAINED * spacing):
        T = refine(before, after, T, gate, ROUNDS)
    return _fit(before, after, T, spacing)


def refine(before: Surface, after: Surface, T: Array, gate: float, rounds: int) -> Array:
    """(4, 4) motion near T by symmetric point-to-plane ICP with pairs that are no farther apart than the gate, m."""
    middle = after.points.mean(axis=0)
    for _ in range(rounds):
        moved = before.moved(T)
        own, other = _pairs(moved, before, after, T, gate)
        if len(own) < 6:
            return T
        normal = moved.normals[own] + after.normals[other]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        residual = np.einsum("ij,ij->i", moved.points[own] - after.points[other], normal)
        J = np.concatenate([normal, np.cross(moved.points[own] - middle, normal)], axis=1)
        weighted = J / np.maximum(1, np.abs(residual) / HUBER)[:, None]
        lever = float((moved.points[own] - middle).std()) ** 2  # m^2: turns are held as much as shifts are
        H = weighted.T @ J + STIFFNESS * len(own) * np.diag([1, 1, 1, lever, lever, lever])
        step = -np.linalg.solve(H, weighted.T @ residual)
        T = pose(rotation_by(step[3:]), middle + step[:3]) @ pose(None, -middle) @ T
        if np.abs(step).max() < CONVERGED:
            break
    return T


def as_good(fits: Sequence[Fit]) -> list[Fit]:
    """Those of some fits, best first, that explain what was seen as well as the best one does, it among them."""
    return [fit for fit in fits if fit.misfit <= AS_GOOD * fits[0].misfit + AS_GOOD_BY]


def surface_gap(T_a: Array, T_b: Array, points: Array) -> float:
    """How far a surface after one motion is from the same surface after another, m: nothing, if it is symmetric.

    Args:
        T_a, T_b: (4, 4) motions.
        points: (N, 3) of the surface, m.
    """
    from scipy.spatial import cKDTree

    a, b = transform(T_a, points), transform(T_b, points)
    there, back = cKDTree(a).query(b)[0], cKDTree(b).query(a)[0]
    return float(max(np.quantile(there, SAME_SURFACE), np.quantile(back, SAME_SURFACE)))


def _middle(points: Array) -> Array:
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)


def _differ(T_a: Array, T_b: Array, middle: Array) -> bool:
    shift = np.linalg.norm(transform(T_a, middle[None]) - transform(T_b, middle[None]))
    return bool(shift > APART or angle_between(T_a[:3, :3], T_b[:3, :3]) > APART_TURN)


def _pairs(moved: Surface, before: Surface, after: Surface, T: Array, gate: float) -> tuple[Array, Array]:
    """Rows of the first and of the second cloud that are each other's partners: the nearest one, from either side."""
    distance, there = after.tree.query(moved.points, distance_upper_bound=gate)
    own = np.flatnonzero(np.isfinite(distance))
    distance, back = before.tree.query(transform(inverse(T), after.points), distance_upper_bound=gate)
    other = np.flatnonzero(np.isfinite(distance))
    own, other = np.concatenate([own, back[other]]), np.concatenate([there[own], other])
    facing = np.einsum("ij,ij->i", moved.normals[own], after.normals[other]) > SAME_SIDE
    return own[facing], other[facing]


def _fit(before: Surface, after: Surface, T: Array, spacing: float) -> Fit:
    off_before, off_after = _off(before, after, T, spacing), _off(after, before, inverse(T), spacing)
    near = [off[off < EXPLAINED * spacing] for off in (off_before, off_after)]
    close = np.concatenate(near)
    return Fit(
        T=T,
        misfit=float(START_WEIGHT * off_before.mean() + off_after.mean()),
        explained_before=len(near[0]) / len(off_before),
        explained_after=len(near[1]) / len(off_after),
        rms=float(np.sqrt(np.mean(close**2))) if len(close) else float("inf"),
    )


def _off(own: Surface, other: Surface, T_other_own: Array, spacing: float) -> Array:
    """(N,) m from each point to the other cloud, cut; what faces another way is not near."""
    moved = own.moved(T_other_own)
    distance, row = other.tree.query(moved.points)
    facing = np.einsum("ij,ij->i", moved.normals, other.normals[row]) > SAME_SIDE
    return np.where(facing, np.minimum(distance, CUT * spacing), CUT * spacing)
