"""A fruit into a rack of four slots: from above, into one that is free.

A slot is a square hole in a plate on legs, in which a fruit sits as an egg in its cup. Slots stand in a square or in a row,
and some hold fruits already. Fruits are flattened spheres, each of its own size; how one lies is of no account. A slot
leaves no play, yet takes what is let go anywhere above its hole: its clearance is the hole's width.

Source: the paper's real-world task, "one of the four rack slots". Its racks and fruits are not published as sizes; these are
those of apples, in a rack under 8 cm as in the authors' preparation of its recordings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from dapdata import solids
from dapdata.config import CountRange, LengthRange, ShareRange, SizeRange, key
from dapdata.records import Rejected, Scene
from dapdata.solids import CLUTTER, Part, box, ellipsoid
from dapdata.tabletop import ABOVE, HOVER, Candidate, TabletopConfig, build_scene, expect_room

Array = NDArray[Any]

LAYOUTS = ((2, 2), (1, 4))  # rows and columns of the four slots


class Params(TabletopConfig):
    """The rack, the fruits in it, and the fruit to place; ranges are [lowest, highest] of a uniform draw."""

    task: Literal["fruit_rack"] = key("fruit_rack", "name of the task")
    max_tilt_deg: float = key(
        180.0, "largest angle from upright that counts as placed; a fruit lies anyhow", unit="deg", gt=0, le=180
    )
    row_probability: float = key(0.5, "chance that the four slots stand in a row, else in a square", ge=0, le=1)
    fruit_radius: SizeRange = key((0.03, 0.042), "radius of a fruit across its axis", unit="m")
    flatness: ShareRange = key((0.8, 0.95), "its height, as a share of its width")
    hole: ShareRange = key((0.55, 0.75), "side of the holes, as a share of the narrowest fruit's width")
    gap: LengthRange = key((0.004, 0.012), "gap between neighbouring fruits of the widest kind", unit="m")
    height: SizeRange = key((0.035, 0.06), "height of the rack", unit="m")
    thickness: SizeRange = key((0.006, 0.012), "thickness of the plate with the holes", unit="m")
    leg: SizeRange = key((0.008, 0.014), "side of a leg", unit="m")
    occupied: CountRange = key((0, 2), "slots that hold a fruit")

    @model_validator(mode="after")
    def check_sizes(self) -> Params:
        """Fruits rest in holes, off the table, one slot is free, and legs fit beside the holes."""
        if not 0.3 <= self.hole[0] <= self.hole[1] <= 0.9:
            raise ValueError(f"hole: got {list(self.hole)}, expected 0.3 to 0.9; fruits fall through or roll off others")
        if self.flatness[0] < 0.5:
            raise ValueError(f"flatness: got {self.flatness[0]}, expected 0.5 or more; flatter ones are no fruits")
        sag = self.fruit_radius[1] * self.flatness[1] * (1 - np.sqrt(1 - self.hole[1] ** 2))
        expect_room(self.height[0], sag + 0.005, "height", "a fruit that reaches through its hole")
        if self.occupied[1] > 3:
            raise ValueError(f"occupied: got {self.occupied[1]}, expected up to 3 of the four slots; one must be free")
        return self


@dataclass(frozen=True)
class Fruit:
    """Half axes of a flattened sphere, m."""

    radius: float  # across
    half_height: float

    def above(self, half_hole: float) -> float:
        """Height (m) of its centre above the plate when it sits in a hole of so many m to each side."""
        return float(self.half_height * np.sqrt(1 - (half_hole / self.radius) ** 2))

    def part(self, centre: tuple[float, float, float], role: int = 0) -> Part:
        """The fruit upright around a centre, m."""
        return ellipsoid((2 * self.radius, 2 * self.radius, 2 * self.half_height), centre, role)


def sample_scene(params: Params, rng: np.random.Generator) -> Scene | Rejected:
    """A rack, some fruits in it and one more, with every free slot as a candidate goal."""
    rows, columns = LAYOUTS[int(rng.uniform() < params.row_probability)]
    radii = rng.uniform(*params.fruit_radius, 4)
    fruits = [Fruit(float(radius), float(radius * rng.uniform(*params.flatness))) for radius in radii]
    half_hole = float(radii.min() * rng.uniform(*params.hole))
    pitch = 2 * float(radii.max()) + rng.uniform(*params.gap)
    top, leg = rng.uniform(*params.height), rng.uniform(*params.leg)
    x, y = ((np.arange(count) - (count - 1) / 2) * pitch for count in (rows, columns))
    rack = _plate_on_legs(x, y, 2 * half_hole, pitch / 2 - half_hole, top, rng.uniform(*params.thickness), leg)
    slots = [(float(at_x), float(at_y)) for at_x in x for at_y in y]
    taken, order = int(rng.integers(*params.occupied, endpoint=True)), rng.permutation(4)
    standing = [fruits[i].part((*slots[i], top + fruits[i].above(half_hole)), CLUTTER) for i in order[:taken]]
    fruit = fruits[order[taken]]
    z = top + fruit.above(half_hole) + HOVER
    free = [Candidate((*slots[i], z), "hole", 2 * half_hole) for i in sorted(order[taken:])]
    return build_scene(params, [*rack, *standing], [fruit.part((0, 0, 0))], free, "revolution", rng, opening=ABOVE)


def _plate_on_legs(x: Array, y: Array, hole: float, margin: float, top: float, thickness: float, leg: float) -> list[Part]:
    """A plate with square holes on four legs.

    Args:
        x: (R,) places of the holes along x, rising, m.
        y: (C,) the same along y.
        hole: Side of the holes, m.
        margin: Plate beyond the outermost holes, m.
        top: Height of its upper face, m.
        thickness: Of the plate, m.
        leg: Side of a leg, m.
    """
    below = top - thickness
    far_x, far_y = (at[-1] + hole / 2 + margin - leg / 2 for at in (x, y))
    corners = [(side_x * far_x, side_y * far_y, below / 2) for side_x in (-1, 1) for side_y in (-1, 1)]
    legs = [box((leg, leg, below), corner) for corner in corners]
    return [*solids.plate_with_holes(x, y, hole, (margin, margin), below, top), *legs]
