"""A can into a cabinet of stacked cans: onto a stack that has room, or onto the floor where a column is missing.

A shelf's cans stand in rows (front to back) of columns (side by side); a column is a stack of cans. With
`filling: random` columns are RPDiff's: one row, gaps between its columns, stacks of random height. With `filling: full`
the shelf is packed to its depth, width and height, and slots are opened on purpose, so that a place for the can is hard
to guess.

Source: RPDiff's can cabinet generator (`syn_can_cabinet_cfg.py`, `can_cabinet_dev.py`), whose ranges are kept. Its
object is rescaled to a slot, as in its evaluation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from dapdata import solids
from dapdata.config import CountRange, FactorRange, LengthRange, PositiveCountRange, ShareRange, SizeRange, key
from dapdata.records import Rejected, Scene
from dapdata.solids import CLUTTER, Part, cylinder
from dapdata.tabletop import HOVER, Candidate, TabletopConfig, build_scene, expect_few, expect_room

Array = NDArray[Any]

ONE_CAN_MORE = 0.35  # chance that a full stack has smaller cans than it must, and one more of them
EDGE = 0.001  # m that cans keep from the back wall and the front edge


class Params(TabletopConfig):
    """The cabinet, its cans, and the can to place; ranges are [lowest, highest] of a uniform draw."""

    task: Literal["can_cabinet"] = key("can_cabinet", "name of the task")
    width: SizeRange = key((0.3, 0.5), "outer width of the cabinet", unit="m")
    depth: SizeRange = key((0.143, 0.17), "outer depth of the cabinet", unit="m")
    board: SizeRange = key((0.004, 0.007), "thickness of floors, back and top", unit="m")
    wall: SizeRange = key((0.0025, 0.007), "thickness of the side walls", unit="m")
    shelves: PositiveCountRange = key((1, 2), "number of floors, one above the other")
    top_probability: float = key(0.7, "chance of a board on top", ge=0, le=1)
    shelf_cans: PositiveCountRange = key((2, 3), "height of a shelf in cans; random stacks are no higher")
    can_pitch: float = key(0.09375, "height of a shelf for each of its cans", unit="m", ge=0.03, le=0.5)
    can_radius: SizeRange = key((0.026, 0.0325), "radius of a column's lowest can", unit="m")
    can_height: SizeRange = key((0.05, 0.1), "height of a column's lowest can", unit="m")
    same_radius: bool = key(True, "one radius for a shelf, shrunk so that its columns fill the width; else one for a column")
    rows: int = key(0, "rows from front to back; 0: as many as fit", ge=0, le=20)
    row_shift: FactorRange = key((0.0, 0.2), "a single row's distance from mid-depth, either way, as a share of the depth")
    row_is_straight: bool = key(False, "a single row has one draw of row_shift, not one for each column")
    column_pad: float = key(1.0, "half the room of a column in its row, in its radii; above 1 leaves gaps", ge=1, le=3)
    column_gap: LengthRange = key((0.001, 0.005), "gap between neighbouring columns on top of that", unit="m")
    missing_column: float = key(
        0.0, "chance that a column is missing from its row, which leaves a slot on the floor", ge=0, le=1
    )
    filling: Literal["full", "random"] = key("full", "stacks reach the ceiling, or grow by chance")
    more_cans: float = key(0.75, "random: chance of one can more while the stack has room", ge=0, le=1)
    ceiling_gap: LengthRange = key((0.006, 0.018), "full: height left above a stack", unit="m")
    open_columns: CountRange = key((0, 2), "full: columns taken out of front rows, which leaves slots on the floor")
    open_stacks: CountRange = key((3, 6), "full: stacks of front rows that lose their top can, which leaves slots on stacks")
    hidden_stacks: CountRange = key((0, 2), "full: the same in rows behind, where the way in is barred")
    scaled_probability: float = key(0.3, "chance that a can on another is smaller than the lowest one", ge=0, le=1)
    scaled_height: ShareRange = key((0.5, 0.95), "its height, as a share (random stacks)")
    scaled_radius: ShareRange = key((0.75, 0.95), "its radius, as a share")
    object_scale: FactorRange = key((0.9, 1.0), "size of the can to place, as a share of one that fills a random slot")
    min_clearance: float = key(0.002, "a slot counts if it leaves the object this free play sideways", unit="m", ge=0, le=0.1)
    min_headroom: float = key(0.002, "and this height", unit="m", ge=0.001, le=0.1)

    @model_validator(mode="after")
    def check_sizes(self) -> Params:
        """The smallest cabinet has room for the largest can, and the largest one a number of cans that can be handled."""
        widest = 2 * self.column_pad * self.can_radius[1] + self.column_gap[1]
        expect_room(self.width[0] - 2 * self.wall[1], widest, "width", "its walls and a column of can_radius")
        expect_room(
            self.depth[0] - self.board[1] - 2 * EDGE, 2 * self.can_radius[1], "depth", "its back and a can of can_radius"
        )
        height = self.can_pitch * self.shelf_cans[0] - self.board[1] - self.ceiling_gap[1]
        expect_room(height, self.can_height[0], "can_pitch", "the boards, ceiling_gap and a can of can_height")
        across, high = 2 * self.can_radius[0], self.can_pitch * self.shelf_cans[1] / self.can_height[0]
        expect_few(
            self.width[1] / across * self.depth[1] / across * max(high, 1) * self.shelves[1], "can_radius and can_height"
        )
        return self


@dataclass(frozen=True)
class Shelf:
    """One floor of the cabinet and the room above it, m."""

    width: float  # inner
    depth: float  # outer
    back: float  # thickness of the back wall
    floor: float  # height of the upper face
    ceiling: float  # height of the board above, or of the walls' ends
    is_covered: bool  # whether there is a board above


@dataclass(frozen=True)
class Column:
    """A stack of cans, or the place where one could be."""

    x: float  # m, container frame
    y: float
    shelf: Shelf
    cans: tuple[tuple[float, float], ...]  # (radius, height) from bottom to top, m; none: an open column
    removed: tuple[float, float]  # (radius, height) of the can that would fit on top
    is_front: bool  # whether it stands in its shelf's front row

    @property
    def top(self) -> float:
        """Height (m) of the face on which one more can would stand."""
        return self.shelf.floor + sum(height for _, height in self.cans)


def sample_scene(params: Params, rng: np.random.Generator) -> Scene | Rejected:
    """A cabinet, its cans and a can that fits one of its slots at least; Rejected where no slot takes it."""
    cans_high, shelves = int(rng.integers(*params.shelf_cans, endpoint=True)), int(rng.integers(*params.shelves, endpoint=True))
    width, depth = rng.uniform(*params.width), rng.uniform(*params.depth)
    board, wall, pitch = rng.uniform(*params.board), rng.uniform(*params.wall), params.can_pitch * cans_high
    has_top = bool(rng.uniform() < params.top_probability)
    boards = solids.open_shelf(width, depth, pitch, shelves, board, wall, has_top)
    columns: list[Column] = []
    for k in range(shelves):
        shelf = Shelf(width - 2 * wall, depth, board, k * pitch + board, (k + 1) * pitch, has_top or k < shelves - 1)
        columns += _fill_shelf(params, shelf, cans_high, rng)
    if params.filling == "full":
        columns = _open_slots(params, columns, rng)
    parts = [*boards, *(can for column in columns for can in _cans(column))]
    size, candidates = _fitting_object(params, parts, columns, rng)
    return build_scene(params, parts, [cylinder(*size, (0, 0, 0))], candidates, "revolution", rng)


def _fill_shelf(params: Params, shelf: Shelf, cans_high: int, rng: np.random.Generator) -> list[Column]:
    """The columns of one shelf, in rows from front to back."""
    radius = rng.uniform(*params.can_radius)
    if params.same_radius:
        across = np.ceil(shelf.width / (2 * params.column_pad * radius + max(params.column_gap)))
        radius = (shelf.width / across - max(params.column_gap)) / (2 * params.column_pad)
    largest = radius if params.same_radius else params.can_radius[1]
    columns: list[Column] = []
    rows = _row_positions(params, shelf, largest, rng)
    if params.rows == 1 and params.row_is_straight:
        rows = [_single_row_shift(params, shelf, largest, rng)]
    for row, row_x in enumerate(rows):
        for y, r in _column_positions(params, shelf.width, radius, rng):
            x = _single_row_shift(params, shelf, r, rng) if params.rows == 1 and not params.row_is_straight else row_x
            stack = _stack(params, r, shelf.ceiling - shelf.floor, cans_high, rng)
            missing = rng.uniform() < params.missing_column
            cans, spare = ((), stack[0]) if missing else (stack, stack[-1])
            columns.append(Column(x, y, shelf, cans, spare, row == 0))
    return columns


def _row_positions(params: Params, shelf: Shelf, radius: float, rng: np.random.Generator) -> list[float]:
    """x (m) of each row of discs, from the front edge to the back wall; what is left of the depth is behind the last."""
    x, last = shelf.depth / 2 - EDGE - radius, -shelf.depth / 2 + shelf.back + EDGE + radius
    rows: list[float] = []
    while (not rows or x >= last) and len(rows) < (params.rows or np.inf):
        rows.append(x)
        x -= 2 * radius + rng.uniform(*params.column_gap)
    return rows


def _single_row_shift(params: Params, shelf: Shelf, radius: float, rng: np.random.Generator) -> float:
    """x (m) of one column of a single row, which need not be straight."""
    shift = float(rng.choice([-1.0, 1.0]) * rng.uniform(*params.row_shift) * shelf.depth)
    return float(np.clip(shift, -shelf.depth / 2 + shelf.back + EDGE + radius, shelf.depth / 2 - EDGE - radius))


def _column_positions(params: Params, width: float, radius: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """(y, radius) of the columns of a row, m, from one wall until the other is reached."""
    found, edge = [], -width / 2
    while True:
        r = radius if params.same_radius else float(rng.uniform(*params.can_radius))
        gap = rng.uniform(*params.column_gap)
        if edge + gap + 2 * params.column_pad * r > width / 2:
            break
        found.append((edge + gap + params.column_pad * r, r))
        edge = found[-1][0] + params.column_pad * r
    side = rng.choice([-1.0, 1.0])
    return [(float(side * y), r) for y, r in found]


def _stack(
    params: Params, radius: float, height: float, cans_high: int, rng: np.random.Generator
) -> tuple[tuple[float, float], ...]:
    """(radius, height) of each can of a column from bottom to top, m, on a shelf of the given height, m."""
    heights = (
        _full_heights(params, height, rng) if params.filling == "full" else _random_heights(params, height, cans_high, rng)
    )
    radii = [radius]
    for _ in heights[1:]:
        is_smaller = rng.uniform() < params.scaled_probability
        radii.append(radius * rng.uniform(*params.scaled_radius) if is_smaller else radius)
    return tuple(zip(radii, heights))


def _full_heights(params: Params, height: float, rng: np.random.Generator) -> list[float]:
    """Heights of cans that reach the ceiling but for a small gap: as few as can be, or one more; at most a fifth apart."""
    room = height - rng.uniform(*params.ceiling_gap)
    fewest = max(int(np.ceil(room / params.can_height[1])), 1)
    most = max(int(room / params.can_height[0]), fewest)
    weights = rng.uniform(0.9, 1.1, min(fewest + int(rng.uniform() < ONE_CAN_MORE), most))
    return [float(h) for h in room * weights / weights.sum()]


def _random_heights(params: Params, height: float, cans_high: int, rng: np.random.Generator) -> list[float]:
    """Heights of a lowest can and, by chance, of others on it."""
    heights = [float(rng.uniform(*params.can_height))]
    for _ in range(cans_high - 1):
        is_smaller = rng.uniform() < params.scaled_probability
        more = heights[0] * (rng.uniform(*params.scaled_height) if is_smaller else 1.0)
        if rng.uniform() >= params.more_cans or sum(heights) + more > height - params.min_headroom:
            break
        heights.append(float(more))
    return heights


def _open_slots(params: Params, columns: Sequence[Column], rng: np.random.Generator) -> list[Column]:
    """The columns with some of the front row, and a few behind, opened; no two of the opened ones were chosen twice."""
    order = rng.permutation(len(columns))
    front, behind = [int(i) for i in order if columns[i].is_front], [int(i) for i in order if not columns[i].is_front]
    whole = int(rng.integers(*params.open_columns, endpoint=True))
    tops = int(rng.integers(*params.open_stacks, endpoint=True))
    hidden = int(rng.integers(*params.hidden_stacks, endpoint=True))
    out = list(columns)
    for i in front[:whole]:
        out[i] = replace(out[i], cans=(), removed=out[i].cans[0])
    for i in [*front[whole : whole + tops], *behind[:hidden]]:
        if len(out[i].cans) > 1:
            out[i] = replace(out[i], cans=out[i].cans[:-1], removed=out[i].cans[-1])
    return out


def _cans(column: Column) -> list[Part]:
    """The column's cans as clutter."""
    parts, z = [], column.shelf.floor
    for radius, height in column.cans:
        parts.append(cylinder(radius, height, (column.x, column.y, z + height / 2), CLUTTER))
        z += height
    return parts


def _fitting_object(
    params: Params, parts: Sequence[Part], columns: Sequence[Column], rng: np.random.Generator
) -> tuple[tuple[float, float], list[Candidate]]:
    """(radius, height) of a can that was scaled to a random slot, m, and every slot that it fits.

    Slots are tried in random order until the can scaled to one fits it; the last try is returned if none does.
    """
    kind, full, T, _ = solids.collect(parts)
    around = (kind, full, solids.bounds(kind, full, T))
    size, candidates = (params.can_radius[0], params.can_height[0]), []
    for i in rng.permutation(len(columns)):
        scale, slot = rng.uniform(*params.object_scale), columns[i]
        size = (slot.removed[0] * scale, slot.removed[1] * scale)
        if _candidate(params, size, slot, around) is not None:
            found = [_candidate(params, size, column, around) for column in columns]
            candidates = [candidate for candidate in found if candidate is not None]
            break
    return size, candidates


def _candidate(
    params: Params, size: tuple[float, float], column: Column, around: tuple[Array, Array, Array]
) -> Candidate | None:
    """The place on top of a column if a can of (radius, height), m, fits there, among parts (kind, size, bounds)."""
    radius, height = size
    # Under open sky only its centre must be inside.
    needed = height + params.min_headroom if column.shelf.is_covered else height / 2 + HOVER
    if column.top + needed > column.shelf.ceiling:
        return None
    position = (column.x, column.y, column.top + height / 2 + HOVER)
    clearance = solids.free_play(cylinder(radius, height, position), *around)
    return Candidate(position, "stack" if column.cans else "floor", clearance) if clearance >= params.min_clearance else None
