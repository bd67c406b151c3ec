"""A mug onto a rack: hung by its handle on one of the pegs, with its opening to one side or the other.

A rack is a pole with pegs that point up and outwards; there are one to three racks. A mug that was put onto a peg slides
down to the pole and swings until it hangs still: that is for the simulator to say, and candidates are where it begins. The
object comes in along the peg. Pegs that are too thick for the handle, or too low for the mug to hang clear of the table, are
no candidates.

Source: RPDiff's racks (`syn_rack_cfg.py`, `syn_rack_gen.py`): radii, lengths, angles, yaws, feet and the three tiers. Not as
there: pegs begin higher (its mugs may hang through the table, which takes no part in its simulation), none is steeper than
35 degrees from the pole (a steeper one holds by its side, which is no support), and racks are not scaled.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from dapdata import solids
from dapdata.config import CoordinateRange, DegreesRange, PositiveCountRange, ShareRange, SizeRange, key
from dapdata.poses import inverse, pose, rotation_about
from dapdata.records import Rejected, Scene
from dapdata.solids import Part, box, cylinder
from dapdata.tabletop import HOVER, Candidate, TabletopConfig, build_scene

Array = NDArray[Any]

STAVES, SEGMENTS = 8, 7  # flat pieces of a mug's wall and of its handle; with the bottom as many as the simulator takes
MARGIN = 0.003  # m that a mug keeps from the pole and from the table where it begins


class Params(TabletopConfig):
    """The racks, their pegs, and the mug; ranges are [lowest, highest] of a uniform draw."""

    task: Literal["mug_rack"] = key("mug_rack", "name of the task")
    max_tilt_deg: float = key(
        180.0, "largest angle from upright that counts as placed; mugs hang at any", unit="deg", gt=0, le=180
    )
    racks: PositiveCountRange = key((1, 1), "number of racks, side by side")
    rack_spacing: SizeRange = key((0.22, 0.3), "distance of neighbouring racks", unit="m")
    rack_shift: CoordinateRange = key((-0.04, 0.04), "how far a rack stands before or behind the others", unit="m")
    rack_yaw_deg: DegreesRange = key((0.0, 0.0), "turn of a rack about its pole", unit="deg")
    pole_radius: SizeRange = key((0.0125, 0.02), "radius of a pole", unit="m")
    pole_height: SizeRange = key((0.27, 0.32), "height of a pole", unit="m")
    pegs: PositiveCountRange = key((1, 1), "pegs of a rack")
    peg_radius: SizeRange = key((0.00575, 0.0125), "radius of a peg", unit="m")
    peg_length: SizeRange = key((0.1, 0.15), "length of a peg, from the pole's axis", unit="m")
    peg_angle_deg: DegreesRange = key((40.0, 50.0), "angle of a peg to the pole, upwards", unit="deg")
    peg_yaw_deg: DegreesRange = key((0.0, 0.0), "where a peg points to, from the rack's front", unit="deg")
    peg_height: ShareRange = key((0.6, 0.75), "where a peg begins, as a share of the pole's height")
    foot_probability: float = key(0.5, "chance that a rack has a foot, a disc or a square plate", ge=0, le=1)
    disc_radius: SizeRange = key((0.05, 0.09), "radius of a disc", unit="m")
    plate_side: SizeRange = key((0.07, 0.1), "side of a square plate", unit="m")
    foot_thickness: SizeRange = key((0.002, 0.004), "thickness of either", unit="m")
    mug_radius: SizeRange = key((0.034, 0.042), "outer radius of the mug", unit="m")
    mug_height: SizeRange = key((0.08, 0.1), "height of the mug", unit="m")
    mug_wall: SizeRange = key((0.003, 0.005), "thickness of its wall and bottom", unit="m")
    handle_depth: SizeRange = key((0.03, 0.04), "room in the handle, away from the wall", unit="m")
    handle_height: SizeRange = key((0.05, 0.065), "room in the handle, along the mug's axis", unit="m")
    handle_thickness: SizeRange = key((0.006, 0.009), "thickness of the handle", unit="m")
    handle_width: SizeRange = key((0.009, 0.013), "width of the handle, across both", unit="m")
    min_clearance: float = key(0.008, "a peg counts if it leaves the handle this play", unit="m", ge=0.001, le=0.1)

    @model_validator(mode="after")
    def check_sizes(self) -> Params:
        """Some handle fits some peg, pegs point up, and racks stand apart."""
        room, needed = self.handle_depth[1], 2 * self.peg_radius[0] + self.min_clearance
        if room < needed:
            raise ValueError(f"handle_depth: got up to {room} m, expected {needed:.3g} m or more for the thinnest peg_radius")
        if not 35 <= self.peg_angle_deg[0] <= self.peg_angle_deg[1] <= 85:
            raise ValueError(f"peg_angle_deg: got {list(self.peg_angle_deg)}, expected 35 to 85 deg; others hold no mug")
        if self.racks[1] > 1 and self.rack_spacing[0] < 2 * self.disc_radius[1]:
            raise ValueError(f"rack_spacing: got {self.rack_spacing[0]} m, expected room for two feet of disc_radius")
        return self


@dataclass(frozen=True)
class Mug:
    """One mug's dimensions, m."""

    radius: float  # outer
    height: float
    wall: float
    depth: float  # room in the handle, away from the wall
    room: float  # the same, along the axis
    thickness: float  # of the handle
    width: float  # of the handle


@dataclass(frozen=True)
class Peg:
    """A peg in the frame of its rack (origin at the pole's foot), m."""

    root: Array  # (3,) on the pole's axis
    way: Array  # (3,) unit, from the root to the tip
    radius: float
    length: float


def sample_scene(params: Params, rng: np.random.Generator) -> Scene | Rejected:
    """Racks and a mug that one of their pegs takes at least; Rejected where none does."""
    mug = _mug(params, rng)
    parts: list[Part] = []
    hung: list[tuple[Array, Array, float]] = []  # pose of the mug, way out, clearance
    for T_row_rack in _rack_poses(params, rng):
        pole_radius, rack, pegs = _rack(params, rng)
        parts += solids.moved(rack, T_row_rack)
        for peg in pegs:
            clearance = min(mug.depth, mug.room) - 2 * peg.radius
            if clearance >= params.min_clearance:
                way_out = T_row_rack[:3, :3] @ peg.way
                hung += [(T_row_rack @ T, way_out, clearance) for T in _hanging(mug, peg, pole_radius)]
    things = _mug_parts(mug)
    T_container_row, T_object_mug = _to_footprint(parts), _to_middle(things)
    parts, things = solids.moved(parts, T_container_row), solids.moved(things, T_object_mug)
    candidates = [_candidate(T_container_row @ T @ inverse(T_object_mug), way_out, play) for T, way_out, play in hung]
    return build_scene(params, parts, things, candidates, "none", rng)


def _to_middle(parts: Sequence[Part]) -> Array:
    """(4, 4) motion that brings the centre of the parts' bounding box to the origin."""
    low, high = solids.bounds(*solids.collect(parts)[:3]).transpose(1, 0, 2)
    return pose(None, -(low.min(axis=0) + high.max(axis=0)) / 2)


def _to_footprint(parts: Sequence[Part]) -> Array:
    """The same in plan only."""
    x, y, _ = _to_middle(parts)[:3, 3]
    return pose(None, (x, y, 0.0))


def _candidate(T_container_object: Array, way_out: Array, clearance: float) -> Candidate:
    x, y, z = T_container_object[:3, 3].tolist()
    return Candidate((x, y, z), "peg", clearance, T_container_object[:3, :3], way_out)


def _rack_poses(params: Params, rng: np.random.Generator) -> list[Array]:
    """(4, 4) poses of the racks in a row along y, somewhat out of line."""
    racks = int(rng.integers(*params.racks, endpoint=True))
    across = np.cumsum([0.0, *rng.uniform(*params.rack_spacing, racks - 1)])
    return [
        pose(
            rotation_about((0, 0, 1), np.radians(rng.uniform(*params.rack_yaw_deg))), (rng.uniform(*params.rack_shift), y, 0.0)
        )
        for y in across
    ]


def _rack(params: Params, rng: np.random.Generator) -> tuple[float, list[Part], list[Peg]]:
    """Radius of the pole, parts and pegs of a rack that stands at the origin."""
    radius, height = rng.uniform(*params.pole_radius), rng.uniform(*params.pole_height)
    foot = _foot(params, rng)
    thickness = foot[0].size[2] if foot else 0.0
    pole = cylinder(radius, height - thickness, (0, 0, (height + thickness) / 2))
    pegs = [_peg(params, height, rng) for _ in range(int(rng.integers(*params.pegs, endpoint=True)))]
    return radius, [*foot, pole, *(_peg_part(peg) for peg in pegs)], pegs


def _foot(params: Params, rng: np.random.Generator) -> list[Part]:
    """A disc or a square plate on the table, or nothing."""
    thickness = rng.uniform(*params.foot_thickness)
    side, radius, is_round = rng.uniform(*params.plate_side), rng.uniform(*params.disc_radius), rng.uniform() < 0.5
    if rng.uniform() >= params.foot_probability:
        return []
    return [
        cylinder(radius, thickness, (0, 0, thickness / 2)) if is_round else box((side, side, thickness), (0, 0, thickness / 2))
    ]


def _peg(params: Params, height: float, rng: np.random.Generator) -> Peg:
    angle, yaw = np.radians(rng.uniform(*params.peg_angle_deg)), np.radians(rng.uniform(*params.peg_yaw_deg))
    way = np.array([np.sin(angle) * np.cos(yaw), np.sin(angle) * np.sin(yaw), np.cos(angle)])
    root = np.array([0, 0, rng.uniform(*params.peg_height) * height])
    return Peg(root, way, rng.uniform(*params.peg_radius), rng.uniform(*params.peg_length))


def _peg_part(peg: Peg) -> Part:
    """The peg's cylinder, welded into the pole: it begins on the pole's axis."""
    up = np.array([0.0, 0.0, 1.0])
    turn = rotation_about(np.cross(up, peg.way), float(np.arccos(peg.way[2])))
    return cylinder(peg.radius, peg.length, peg.root + peg.way * peg.length / 2, rotation=turn)


def _mug(params: Params, rng: np.random.Generator) -> Mug:
    return Mug(
        radius=rng.uniform(*params.mug_radius),
        height=rng.uniform(*params.mug_height),
        wall=rng.uniform(*params.mug_wall),
        depth=rng.uniform(*params.handle_depth),
        room=rng.uniform(*params.handle_height),
        thickness=rng.uniform(*params.handle_thickness),
        width=rng.uniform(*params.handle_width),
    )


def _mug_parts(mug: Mug) -> list[Part]:
    """A mug around the origin: z its axis, upwards, and x towards its handle."""
    bottom = cylinder(mug.radius - mug.wall, mug.wall, (0, 0, (mug.wall - mug.height) / 2))
    staves = []
    for k in range(STAVES):
        turn = rotation_about((0, 0, 1), 2 * np.pi * k / STAVES)
        size = (mug.wall, 2 * mug.radius * np.tan(np.pi / STAVES), mug.height)
        staves.append(box(size, turn @ [mug.radius - mug.wall / 2, 0, 0], rotation=turn))
    return [*staves, bottom, *_handle_parts(mug)]


def _handle_parts(mug: Mug) -> Iterator[Part]:
    """Straight pieces along half an ellipse, from the wall out and back."""
    angle = np.linspace(np.pi / 2, -np.pi / 2, SEGMENTS + 1)
    x = mug.radius + (mug.depth + mug.thickness / 2) * np.cos(angle)
    z = (mug.room + mug.thickness) / 2 * np.sin(angle)
    ends = np.stack([x, np.zeros_like(x), z], axis=1)
    for start, end in pairwise(ends):
        along = end - start
        turn = rotation_about((0, 1, 0), float(-np.arctan2(along[2], along[0])))
        length = float(np.linalg.norm(along)) + mug.thickness / 2  # so that pieces meet at their outer edges too
        yield box((length, mug.width, mug.thickness), (start + end) / 2, rotation=turn)


def _hanging(mug: Mug, peg: Peg, pole_radius: float) -> list[Array]:
    """(4, 4) T_rack_mug where a mug begins to hang: square on the peg, close to the pole, opening to either side; or none.

    The peg is under the outermost place of the handle, so that the handle is on top and the mug's axis is level.
    """
    sine, cosine = float(np.hypot(*peg.way[:2])), float(peg.way[2])
    level = np.array([*peg.way[:2], 0.0]) / sine
    over = np.array([0.0, 0.0, sine]) - cosine * level  # square to the peg, upwards
    inner = _inner_reach(mug)
    # In the upright plane of the peg the mug is a disc below it, and the handle a plate across it.
    below = mug.radius + inner - peg.radius - HOVER
    along = max(
        (pole_radius + MARGIN + mug.radius - cosine * below) / sine,
        (pole_radius + MARGIN + cosine * (peg.radius + mug.thickness)) / sine + mug.width / 2,
    )
    touching = peg.root + along * peg.way
    lowest = touching[2] - inner - 2 * mug.radius - mug.height / 4
    if along + mug.width / 2 > peg.length or lowest < MARGIN:
        return []
    centre = touching - below * over
    aside = np.cross(peg.way, over)
    return [pose(np.stack([over, np.cross(z, over), z], axis=1), centre) for z in (aside, -aside)]


def _inner_reach(mug: Mug) -> float:
    """Distance (m) from the wall to the inside of the handle's outermost piece; there is one, as their number is odd."""
    return float((mug.depth + mug.thickness / 2) * np.cos(np.pi / SEGMENTS / 2) - mug.thickness / 2)
