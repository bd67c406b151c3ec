"""A plate into a dish rack: from above, upright between two pairs of prongs, where there is room and no plate yet.

A rack is a tray with two rails on which plates stand on their rims, and pairs of prongs on the rails between which they
lean. Some of the gaps between prongs are too narrow for the plates. Plates are flat discs, all alike, so either face may be
in front.

Source: the paper's motivating example, a plate into a dishwasher; sizes after the dish rack of NVIDIA's scene_synthesizer
(wires of 5 mm, gaps of 50 mm), with gaps that leave a plate some millimetres of play.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from dapdata.config import LengthRange, PositiveCountRange, ShareRange, SizeRange, key
from dapdata.poses import rotation_about
from dapdata.records import Rejected, Scene
from dapdata.solids import CLUTTER, Part, box, cylinder
from dapdata.tabletop import ABOVE, HOVER, Candidate, TabletopConfig, build_scene, expect_room

Array = NDArray[Any]

TRAY, RAIL = 0.004, 0.008  # m: thickness of the tray, width of a rail
END = 0.02  # m of tray beyond the outermost prongs
ON_EDGE = rotation_about((1, 0, 0), np.pi / 2)  # a disc whose axis is y


class Params(TabletopConfig):
    """The rack, the plates in it, and the plate to place; ranges are [lowest, highest] of a uniform draw."""

    task: Literal["dish_rack"] = key("dish_rack", "name of the task")
    gaps: PositiveCountRange = key((9, 13), "gaps between pairs of prongs, one behind the other")
    rail_distance: SizeRange = key((0.09, 0.12), "distance of the rails on which the plates stand", unit="m")
    rail_height: SizeRange = key((0.024, 0.034), "height of the rails over the tray", unit="m")
    prong_radius: SizeRange = key((0.002, 0.0035), "radius of a prong", unit="m")
    prong_height: SizeRange = key((0.06, 0.1), "height of a prong over its rail", unit="m")
    plate_radius: SizeRange = key((0.09, 0.12), "radius of the plates", unit="m")
    plate_thickness: SizeRange = key((0.014, 0.022), "thickness of the plates", unit="m")
    clearance: LengthRange = key((0.004, 0.012), "play of a plate in a gap, one draw a gap", unit="m")
    narrow: ShareRange = key((0.1, 0.3), "share of the gaps that are too narrow, one draw a scene")
    narrow_width: ShareRange = key((0.6, 0.9), "width of those, in thicknesses of a plate")
    occupancy: ShareRange = key((0.2, 0.5), "share of the other gaps that hold a plate, one draw a scene")

    @model_validator(mode="after")
    def check_sizes(self) -> Params:
        """Plates hang free between the rails, and have some play."""
        half = (self.rail_distance[1] - RAIL) / 2
        expect_room(self.plate_radius[0], 1.2 * half, "plate_radius", "resting on two rails of rail_distance")
        sag = self.plate_radius[0] - np.sqrt(self.plate_radius[0] ** 2 - half**2)
        expect_room(self.rail_height[0], sag + 0.002, "rail_height", "a plate between the rails")
        if self.clearance[0] < 0.002:
            raise ValueError(f"clearance: got {self.clearance[0]} m, expected 0.002 or more, or no plate goes in")
        return self


@dataclass(frozen=True)
class Rack:
    """One scene's dimensions, m."""

    rail_distance: float
    rail_height: float
    prong_radius: float
    prong_height: float
    plate_radius: float
    plate_thickness: float

    @property
    def seat(self) -> float:
        """Height (m) of the centre of a plate that stands on the inner edges of the rails."""
        half = (self.rail_distance - RAIL) / 2
        return float(TRAY + self.rail_height + np.sqrt(self.plate_radius**2 - half**2))


def sample_scene(params: Params, rng: np.random.Generator) -> Scene | Rejected:
    """A rack, plates in some of its gaps and one more plate, with every free gap that is wide enough as a candidate."""
    drawn = (params.rail_distance, params.rail_height, params.prong_radius, params.prong_height)
    rack = Rack(*(rng.uniform(*ends) for ends in (*drawn, params.plate_radius, params.plate_thickness)))
    count = int(rng.integers(*params.gaps, endpoint=True))
    is_narrow = rng.uniform(size=count) < rng.uniform(*params.narrow)
    clearance = rng.uniform(*params.clearance, count)
    widths = np.where(
        is_narrow, rack.plate_thickness * rng.uniform(*params.narrow_width, count), rack.plate_thickness + clearance
    )
    is_taken = ~is_narrow & (rng.uniform(size=count) < rng.uniform(*params.occupancy))
    # Prongs at the ends and between the gaps.
    prongs = np.cumsum([0.0, *(widths + 2 * rack.prong_radius)])
    prongs -= prongs[-1] / 2
    middles = (prongs[:-1] + prongs[1:]) / 2
    plates = [_plate(rack, (0, float(y), rack.seat), CLUTTER) for y in middles[is_taken]]
    free = [
        Candidate((0.0, float(y), rack.seat + HOVER), "gap", float(play))
        for y, play in zip(middles[~is_narrow & ~is_taken], clearance[~is_narrow & ~is_taken])
    ]
    parts = [*_rack_parts(rack, prongs), *plates]
    return build_scene(params, parts, [_plate(rack, (0, 0, 0))], free, "revolution", rng, opening=ABOVE, axis=(0.0, 1.0, 0.0))


def _plate(rack: Rack, centre: tuple[float, float, float], role: int = 0) -> Part:
    """A plate on its rim around a centre, m, that faces along y."""
    return cylinder(rack.plate_radius, rack.plate_thickness, centre, role, ON_EDGE)


def _rack_parts(rack: Rack, prongs: Array) -> list[Part]:
    """A tray, two rails along y, and a prong on each rail at each of the places prongs (P,) along y, m."""
    length = float(prongs[-1] - prongs[0]) + 2 * END
    tray = box((rack.rail_distance + 2 * RAIL, length, TRAY), (0, 0, TRAY / 2))
    top = TRAY + rack.rail_height
    rails, pins = [], []
    for x in (-rack.rail_distance / 2, rack.rail_distance / 2):
        rails.append(box((RAIL, length, rack.rail_height), (x, 0, TRAY + rack.rail_height / 2)))
        centres = [(x, float(y), top + rack.prong_height / 2) for y in prongs]
        pins += [cylinder(rack.prong_radius, rack.prong_height, centre) for centre in centres]
    return [tray, *rails, *pins]
