"""A mug onto a rack: hung by its handle on one of the pegs, with its opening to one side or the other.

A rack is a pole with pegs that point up and outwards; there are one to three racks. A mug that was put onto a peg slides
down to the pole and swings until it hangs still: that is for the simulator to say, and candidates are where it begins. The
object comes in along the peg. Pegs that are too thick for the handle, or too low for the mug to hang clear of the table, are
no candidates.

Source: RPDiff's racks (`syn_rack_cfg.py`, `syn_rack_gen.py`): the three tiers, radii, lengths, angles and yaws of pegs, feet.
Not as there: racks are not scaled, and poles are as high as its racks are once scaled; pegs begin higher (its mugs may hang
through the table, which takes no part in its simulation); none is steeper than 35 degrees from the pole (a steeper one holds
by its side, which is no support); racks of every tier may have a foot. Its mugs are scanned ones; these are drawn.
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
from dapdata.poses import inverse, pose, rotation_about, transform
from dapdata.records import Rejected, Scene
from dapdata.solids import Part, box, cylinder
from dapdata.tabletop import HOVER, Candidate, TabletopConfig, build_scene

Array = NDArray[Any]

STAVES, SEGMENTS = 8, 7  # flat pieces of a mug's wall and of its handle; with the bottom as many as the simulator takes
MARGIN = 0.005  # m that a mug keeps from its pole, and from the table (and from a foot on it), where it begins
STEP = 0.01  # m further out along the peg, if something is in the way


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
    """A peg in the frame of the row of racks, m. It is welded into its pole: it begins on the pole's axis."""

    root: Array  # (3,)
    way: Array  # (3,) unit, from the root to the tip
    radius: float
    length: float

    @property
    def part(self) -> Part:
        """Its cylinder."""
        up = np.array([0.0, 0.0, 1.0])
        turn = rotation_about(np.cross(up, self.way), float(np.arccos(self.way[2])))
        return cylinder(self.radius, self.length, self.root + self.way * self.length / 2, rotation=turn)


@dataclass(frozen=True)
class Rack:
    """A pole on its foot, if it has one, with pegs; in the frame of the row of racks."""

    foot: tuple[Part, ...]
    pole: Part
    pegs: tuple[Peg, ...]


def sample_scene(params: Params, rng: np.random.Generator) -> Scene | Rejected:
    """Racks and a mug that one of their pegs takes at least; Rejected where none does."""
    mug = _mug(params, rng)
    racks = [_rack(params, T_row_rack, rng) for T_row_rack in _rack_poses(params, rng)]
    parts = [part for rack in racks for part in (*rack.foot, rack.pole, *(peg.part for peg in rack.pegs))]
    things = _mug_parts(mug)
    T_container_row, T_object_mug = _to_footprint(parts), _to_middle(things)
    candidates = [
        _candidate(T_container_row @ T_row_mug @ inverse(T_object_mug), peg, mug)
        for rack in racks
        for peg in rack.pegs
        if _play(mug, peg) >= params.min_clearance
        for T_row_mug in _hanging(mug, things, peg, rack, racks)
    ]
    parts, things = solids.moved(parts, T_container_row), solids.moved(things, T_object_mug)
    return build_scene(params, parts, things, candidates, "none", rng)


def _to_middle(parts: Sequence[Part]) -> Array:
    """(4, 4) motion that brings the centre of the parts' bounding box to the origin."""
    low, high = solids.bounds(*solids.collect(parts)[:3]).transpose(1, 0, 2)
    return pose(None, -(low.min(axis=0) + high.max(axis=0)) / 2)


def _to_footprint(parts: Sequence[Part]) -> Array:
    """The same in plan only."""
    x, y, _ = _to_middle(parts)[:3, 3]
    return pose(None, (x, y, 0.0))


def _candidate(T_container_object: Array, peg: Peg, mug: Mug) -> Candidate:
    x, y, z = T_container_object[:3, 3].tolist()
    return Candidate((x, y, z), "peg", _play(mug, peg), T_container_object[:3, :3], peg.way)


def _play(mug: Mug, peg: Peg) -> float:
    """What a peg leaves of the room in the handle, m."""
    return min(mug.depth, mug.room) - 2 * peg.radius


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


def _rack(params: Params, T_row_rack: Array, rng: np.random.Generator) -> Rack:
    """A rack at a pose in the row."""
    radius, height = rng.uniform(*params.pole_radius), rng.uniform(*params.pole_height)
    foot = _foot(params, rng)
    thickness = foot[0].size[2] if foot else 0.0
    pole = cylinder(radius, height - thickness, (0, 0, (height + thickness) / 2))
    pegs = [_peg(params, height, T_row_rack, rng) for _ in range(int(rng.integers(*params.pegs, endpoint=True)))]
    *foot, pole = solids.moved([*foot, pole], T_row_rack)
    return Rack(tuple(foot), pole, tuple(pegs))


def _foot(params: Params, rng: np.random.Generator) -> list[Part]:
    """A disc or a square plate on the table, or nothing."""
    thickness = rng.uniform(*params.foot_thickness)
    side, radius, is_round = rng.uniform(*params.plate_side), rng.uniform(*params.disc_radius), rng.uniform() < 0.5
    if rng.uniform() >= params.foot_probability:
        return []
    return [
        cylinder(radius, thickness, (0, 0, thickness / 2)) if is_round else box((side, side, thickness), (0, 0, thickness / 2))
    ]


def _peg(params: Params, height: float, T_row_rack: Array, rng: np.random.Generator) -> Peg:
    """A peg of a rack of some height, m."""
    angle, yaw = np.radians(rng.uniform(*params.peg_angle_deg)), np.radians(rng.uniform(*params.peg_yaw_deg))
    way = np.array([np.sin(angle) * np.cos(yaw), np.sin(angle) * np.sin(yaw), np.cos(angle)])
    root = np.array([0, 0, rng.uniform(*params.peg_height) * height])
    radius, length = rng.uniform(*params.peg_radius), rng.uniform(*params.peg_length)
    return Peg(T_row_rack[:3, :3] @ root + T_row_rack[:3, 3], T_row_rack[:3, :3] @ way, radius, length)


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


def _hanging(mug: Mug, things: Sequence[Part], peg: Peg, rack: Rack, racks: Sequence[Rack]) -> Iterator[Array]:
    """(4, 4) T_row_mug where a mug begins to hang: square on the peg, with its opening to one side, then to the other.

    The handle is on top and the mug's axis level. It begins as close to the pole as other pegs and poles let it. There is
    none for a side on which they do not, and none if the mug would hang down to the table.

    Args:
        mug: Its dimensions.
        things: Its parts.
        peg: Where it hangs.
        rack: The rack of the peg.
        racks: All of them.
    """
    sine, cosine = float(np.hypot(*peg.way[:2])), float(peg.way[2])
    level = np.array([*peg.way[:2], 0.0]) / sine
    over = np.array([0.0, 0.0, sine]) - cosine * level  # square to the peg, upwards
    inner = _inner_reach(mug)
    # In the upright plane of the peg the mug is a disc below it, and the handle a plate across it.
    below = mug.radius + inner - peg.radius - HOVER
    beside = rack.pole.size[0] / 2 + MARGIN
    nearest = max(
        (beside + mug.radius - cosine * below) / sine,
        (beside + cosine * (peg.radius + mug.thickness)) / sine + mug.width / 2,
    )
    others = [*(other.pole for other in racks), *(p.part for other in racks for p in other.pegs if p is not peg)]
    for aside in (np.cross(peg.way, over), np.cross(over, peg.way)):
        rotation = np.stack([over, np.cross(aside, over), aside], axis=1)
        for along in np.arange(nearest, peg.length - mug.width / 2, STEP):
            touching = peg.root + along * peg.way
            T_row_mug = pose(rotation, touching - below * over)
            if touching[2] - inner - 2 * mug.radius - mug.height / 4 > MARGIN and _is_free(things, T_row_mug, others):
                yield T_row_mug
                break


def _is_free(things: Sequence[Part], T_row_mug: Array, rods: Sequence[Part]) -> bool:
    """Whether a mug keeps MARGIN from long cylinders, by points on their axes."""
    share = np.linspace(-0.5, 0.5, 40)[:, None] * [0, 0, 1.0]
    axes = np.concatenate([transform(rod.T, share * rod.size[2]) for rod in rods])
    radius = np.repeat([rod.size[0] / 2 for rod in rods], len(share))
    distance = solids.signed_distance(transform(inverse(T_row_mug), axes), *solids.collect(things)[:3])
    return bool((distance - radius).min() > MARGIN / 2)


def _inner_reach(mug: Mug) -> float:
    """Distance (m) from the wall to the inside of the handle's outermost piece; there is one, as their number is odd."""
    return float((mug.depth + mug.thickness / 2) * np.cos(np.pi / SEGMENTS / 2) - mug.thickness / 2)
