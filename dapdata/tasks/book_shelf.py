"""A book into a bookshelf: upright, into one of the gaps between books that are wide enough.

All books on the shelf are alike; the one to place is a little smaller, so that a missing book leaves a gap with a few
millimetres of play. With `filling: random` each book is there by chance, as in RPDiff; with `filling: full` the floors are
full but for a few missing books and for narrow gaps, which tempt but are too small.

Source: RPDiff's bookshelf generator (`syn_bookshelf_cfg.py`, `bookshelf_dev.py`), whose ranges are kept; each free slot is
listed once (RPDiff lists some twice and the inside of wide gaps never). The object's scale is that of its evaluation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from dapdata import solids
from dapdata.config import CountRange, FactorRange, LengthRange, PositiveCountRange, ShareRange, SizeRange, key
from dapdata.records import Rejected, Scene
from dapdata.solids import CLUTTER, Part, box
from dapdata.tabletop import HOVER, Candidate, TabletopConfig, build_scene, expect_few, expect_room

Array = NDArray[Any]

EDGE = 0.001  # m that books keep from the back wall
WIDEST_NARROW_GAP = 0.85  # thicknesses of the object


class Params(TabletopConfig):
    """The shelf, its books, and the book to place; ranges are [lowest, highest] of a uniform draw."""

    task: Literal["book_shelf"] = key("book_shelf", "name of the task")
    width: SizeRange = key((0.45, 0.75), "outer width of the shelf", unit="m")
    depth: SizeRange = key((0.195, 0.21), "outer depth of the shelf", unit="m")
    board: SizeRange = key((0.004, 0.007), "thickness of floors, back and top", unit="m")
    wall: SizeRange = key((0.0025, 0.007), "thickness of the side walls", unit="m")
    shelves: PositiveCountRange = key((1, 2), "number of floors, one above the other")
    shelf_height: float = key(1.15, "distance of floors, in heights of a book", ge=1.03, le=3)
    top_probability: float = key(0.7, "chance of a board on top", ge=0, le=1)
    book_depth: SizeRange = key((0.175, 0.195), "a book's extent from spine to fore edge", unit="m")
    book_height: SizeRange = key((0.23, 0.26), "a book's height", unit="m")
    book_thickness: SizeRange = key((0.03, 0.05), "a book's thickness", unit="m")
    book_gap: LengthRange = key((0.001, 0.005), "gap between neighbouring books, one draw a scene", unit="m")
    filling: Literal["full", "random"] = key("full", "floors are full but for opened slots, or books are there by chance")
    occupancy: ShareRange = key((0.4, 0.8), "random: chance that a slot holds a book, one draw a scene")
    open_slots: CountRange = key((3, 5), "full: missing books in a scene")
    narrow_gaps: CountRange = key((2, 4), "full: gaps on a floor that are too narrow for the object")
    object_scale: FactorRange = key((0.9, 0.9), "size of the book to place, in sizes of the others")
    min_clearance: float = key(0.002, "a gap counts if it leaves the object this free play sideways", unit="m", ge=0, le=0.1)

    @model_validator(mode="after")
    def check_sizes(self) -> Params:
        """The smallest shelf has room for the thickest book, and the largest one a number of books that can be handled."""
        thickest = self.book_thickness[1] + 2 * self.book_gap[1]
        expect_room(self.width[0] - 2 * self.wall[1], thickest, "width", "its walls and a book of book_thickness")
        expect_room(self.depth[0] - self.board[1], self.book_depth[1] / 2, "depth", "its back and half a book of book_depth")
        height = self.shelf_height * self.book_height[0] - self.board[1]
        expect_room(height, self.book_height[0], "shelf_height", "a board and a book of book_height")
        expect_few(self.width[1] / self.book_thickness[0] * self.shelves[1], "book_thickness")
        return self


@dataclass(frozen=True)
class Shelf:
    """One scene's dimensions, m."""

    width: float  # inner
    depth: float  # outer
    board: float
    pitch: float
    book: tuple[float, float, float]  # depth, thickness, height
    gap: float  # between neighbouring books
    object: tuple[float, float, float]  # depth, thickness, height

    @property
    def slot(self) -> float:
        """Width (m) that a book and its gap take."""
        return self.book[1] + self.gap

    @property
    def book_x(self) -> float:
        """x (m) of the books' centres: mid-depth, or against the back wall where they would touch it."""
        return max(self.board / 2, -self.depth / 2 + self.board + EDGE + self.book[0] / 2)


def sample_scene(params: Params, rng: np.random.Generator) -> Scene | Rejected:
    """A shelf, its books and a book that fits one of its gaps at least; Rejected where no gap takes it."""
    book = (rng.uniform(*params.book_depth), rng.uniform(*params.book_thickness), rng.uniform(*params.book_height))
    scale, wall, width = rng.uniform(*params.object_scale), rng.uniform(*params.wall), rng.uniform(*params.width)
    shelf = Shelf(
        width=width - 2 * wall,
        depth=rng.uniform(*params.depth),
        board=rng.uniform(*params.board),
        pitch=params.shelf_height * book[2],
        book=book,
        gap=rng.uniform(*params.book_gap),
        object=(book[0] * scale, book[1] * scale, book[2] * scale),
    )
    floors, has_top = int(rng.integers(*params.shelves, endpoint=True)), bool(rng.uniform() < params.top_probability)
    boards = solids.open_shelf(width, shelf.depth, shelf.pitch, floors, shelf.board, wall, has_top)
    rows = _full_rows(params, shelf, floors, rng) if params.filling == "full" else _random_rows(params, shelf, floors, rng)
    books = [_book(shelf, y, floor) for floor, row in enumerate(rows) for y in row]
    kind, size, T, _ = solids.collect([*boards, *books])
    around = (kind, size, solids.bounds(kind, size, T))
    candidates = [
        candidate
        for floor, row in enumerate(rows)
        for y in _free_slots(shelf, row, params.min_clearance)
        if (candidate := _candidate(params, shelf, y, floor, around)) is not None
    ]
    return build_scene(params, [*boards, *books], [box(shelf.object, (0, 0, 0))], candidates, "box", rng)


def _random_rows(params: Params, shelf: Shelf, floors: int, rng: np.random.Generator) -> list[list[float]]:
    """y (m) of the books on each floor: each slot holds one by chance; slots start at a random side."""
    occupancy = rng.uniform(*params.occupancy)
    rows = []
    for _ in range(floors):
        slots = -shelf.width / 2 + shelf.gap + shelf.book[1] / 2 + shelf.slot * np.arange(_slots_of(shelf))
        side = rng.choice([-1.0, 1.0])
        rows.append(sorted(float(side * y) for y in slots if rng.uniform() < occupancy))
    return rows


def _slots_of(shelf: Shelf) -> int:
    """How many books stand side by side on a floor, with a gap before each and after the last."""
    return max(int((shelf.width - shelf.gap) / shelf.slot), 0)


def _full_rows(params: Params, shelf: Shelf, floors: int, rng: np.random.Generator) -> list[list[float]]:
    """y (m) of the books on each floor: full, with narrow gaps, and with some books taken out of the whole scene.

    The books that go are packed on both sides and no neighbours, as long as there are such, so that the slots are narrow.
    """
    wanted = int(rng.integers(*params.open_slots, endpoint=True))
    rows = [_row_with_narrow_gaps(params, shelf, rng) for _ in range(floors)]
    places = [(floor, i) for floor, row in enumerate(rows) for i in range(len(row))]
    order = [places[int(p)] for p in rng.permutation(len(places))]
    order.sort(key=lambda place: _room_beside(shelf, rows[place[0]], place[1]) > 2 * shelf.gap + 1e-9)
    taken: list[tuple[int, int]] = []
    for apart in (True, False):
        for floor, i in order:
            is_beside = (floor, i - 1) in taken or (floor, i + 1) in taken
            if len(taken) < wanted and (floor, i) not in taken and not (apart and is_beside):
                taken.append((floor, i))
    return [[y for i, y in enumerate(row) if (floor, i) not in taken] for floor, row in enumerate(rows)]


def _room_beside(shelf: Shelf, row: Sequence[float], i: int) -> float:
    """Gaps (m) on both sides of a book of a floor, together."""
    left = row[i - 1] + shelf.book[1] / 2 if i else -shelf.width / 2
    right = row[i + 1] - shelf.book[1] / 2 if i + 1 < len(row) else shelf.width / 2
    return right - left - shelf.book[1]


def _row_with_narrow_gaps(params: Params, shelf: Shelf, rng: np.random.Generator) -> list[float]:
    """y (m) of books that fill a floor, the width that is left being shared out as narrow gaps at random places."""
    books, narrow = _slots_of(shelf), int(rng.integers(*params.narrow_gaps, endpoint=True))
    left = shelf.width - shelf.gap - books * shelf.slot
    widest = WIDEST_NARROW_GAP * shelf.object[1] - shelf.gap
    # A book less makes real gaps of what is left, if there are enough places to keep each of them narrow.
    while books > 1 and narrow and (left + shelf.slot) / narrow <= 0.7 * widest:
        books, left = books - 1, left + shelf.slot
    before = np.zeros(books + 1)
    while left > widest * max(narrow, 1):
        narrow += 1
    if narrow:
        weights = rng.uniform(0.7, 1.3, narrow)
        widths = np.minimum(left * weights / weights.sum(), widest)
        places = rng.choice(books + 1, size=min(narrow, books + 1), replace=False)
        before[places] = widths[: len(places)]
    starts = -shelf.width / 2 + shelf.gap + np.cumsum(before)[:books] + shelf.slot * np.arange(books)
    return [float(y) for y in starts + shelf.book[1] / 2]


def _free_slots(shelf: Shelf, row: Sequence[float], min_clearance: float) -> list[float]:
    """y (m) of every place between the books of a floor that takes the object, each once, evenly spread in wide gaps."""
    edges = [-shelf.width / 2, *(y + side * shelf.book[1] / 2 for y in row for side in (-1, 1)), shelf.width / 2]
    found: list[float] = []
    for low, high in zip(edges[::2], edges[1::2]):
        if high - low >= shelf.object[1] + min_clearance:
            count = max(int((high - low - shelf.gap) / shelf.slot + 1e-9), 1)
            found += [low + (high - low) * (i + 0.5) / count for i in range(count)]
    return found


def _book(shelf: Shelf, y: float, floor: int) -> Part:
    """A book of the clutter, upright, at y (m) on a floor."""
    return box(shelf.book, (shelf.book_x, y, floor * shelf.pitch + shelf.board + shelf.book[2] / 2), CLUTTER)


def _candidate(params: Params, shelf: Shelf, y: float, floor: int, around: tuple[Array, Array, Array]) -> Candidate | None:
    """The place at y (m) on a floor if the object has enough play there, among parts (kind, size, bounds)."""
    position = (shelf.book_x, y, floor * shelf.pitch + shelf.board + shelf.object[2] / 2 + HOVER)
    clearance = solids.free_play(box(shelf.object, position), *around)
    return Candidate(position, "gap", clearance) if clearance >= params.min_clearance else None
