"""A vial into a rack: from above into one of the holes that are free, down to the bottom.

The rack is a plate with a grid of holes, some of which hold vials already. Holes are square, as between crossed bars, and a
vial has `clearance` of play all around in them: 7, 3 and 1 mm are the steps of difficulty.

Source: AnyPlace's vial plate (plate, pitch, opening and vial measured on its published test pair, whose clearance is 7 mm);
its holes are round.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from dapdata import solids
from dapdata.config import LengthRange, PositiveCountRange, ShareRange, SizeRange, key
from dapdata.records import Rejected, Scene
from dapdata.solids import CLUTTER, box, cylinder
from dapdata.tabletop import ABOVE, HOVER, Candidate, TabletopConfig, build_scene, expect_few, expect_room

Array = NDArray[Any]

THINNEST_BAR = 0.003  # m between two holes


class Params(TabletopConfig):
    """The rack, the vials in it, and the vial to place; ranges are [lowest, highest] of a uniform draw."""

    task: Literal["vial_rack"] = key("vial_rack", "name of the task")
    columns: PositiveCountRange = key((7, 7), "holes side by side")
    rows: PositiveCountRange = key((2, 2), "holes one behind the other")
    pitch: SizeRange = key((0.042, 0.046), "distance of neighbouring holes", unit="m")
    margin: SizeRange = key((0.01, 0.023), "plate beyond the outermost holes", unit="m")
    height: SizeRange = key((0.04, 0.05), "height of the plate", unit="m")
    bottom: SizeRange = key((0.004, 0.008), "thickness of the bottom under the holes", unit="m")
    vial_radius: SizeRange = key((0.0085, 0.0105), "radius of the vials, all alike", unit="m")
    vial_height: SizeRange = key((0.1, 0.13), "height of the vials", unit="m")
    clearance: LengthRange = key((0.007, 0.007), "play of a vial in its hole on each side", unit="m")
    occupancy: ShareRange = key((0.4, 0.8), "share of the holes that hold a vial, one draw a scene")

    @model_validator(mode="after")
    def check_sizes(self) -> Params:
        """There is some plate between the widest holes, holes have some play, and the rack is one that can be handled."""
        widest = 2 * (self.vial_radius[1] + self.clearance[1]) + THINNEST_BAR
        expect_room(self.pitch[0], widest, "pitch", "a vial of vial_radius, its clearance and the bar between holes")
        expect_room(self.height[0], self.bottom[1] + 0.01, "height", "the bottom and holes of 0.01 m")
        if self.clearance[0] < 0.0005:
            raise ValueError(f"clearance: got {self.clearance[0]} m, expected 0.0005 or more; the simulator is no finer")
        expect_few(2 * self.columns[1] * self.rows[1], "columns and rows")
        return self


def sample_scene(params: Params, rng: np.random.Generator) -> Scene | Rejected:
    """A rack, vials in some of its holes and one more vial, with every free hole as a candidate goal."""
    columns, rows = (int(rng.integers(*many, endpoint=True)) for many in (params.columns, params.rows))
    pitch_x, pitch_y = rng.uniform(*params.pitch, 2)
    radius, vial_height = rng.uniform(*params.vial_radius), rng.uniform(*params.vial_height)
    clearance, bottom = rng.uniform(*params.clearance), rng.uniform(*params.bottom)
    x, y = _centred(rows, pitch_x), _centred(columns, pitch_y)
    margin, opening = (rng.uniform(*params.margin), rng.uniform(*params.margin)), 2 * (radius + clearance)
    size = (float(np.ptp(x)) + opening + 2 * margin[0], float(np.ptp(y)) + opening + 2 * margin[1], bottom)
    holes = solids.plate_with_holes(x, y, opening, margin, bottom, rng.uniform(*params.height))
    places = [(float(at_x), float(at_y)) for at_x in x for at_y in y]
    is_taken = rng.uniform(size=len(places)) < rng.uniform(*params.occupancy)
    z = bottom + vial_height / 2
    vials = [cylinder(radius, vial_height, (*place, z), CLUTTER) for place, taken in zip(places, is_taken) if taken]
    free = [Candidate((*place, z + HOVER), "hole", 2 * clearance) for place, taken in zip(places, is_taken) if not taken]
    vial = cylinder(radius, vial_height, (0, 0, 0))
    parts = [box(size, (0, 0, bottom / 2)), *holes, *vials]
    return build_scene(params, parts, [vial], free, "revolution", rng, opening=ABOVE)


def _centred(count: int, pitch: float) -> Array:
    """(count,) places at a pitch around 0, rising."""
    return (np.arange(count) - (count - 1) / 2) * pitch
