"""The chessboard track: elements from square to square, centre line by arc length, nearest point,
colour of the floor.

Squares of 2 m, black and white in turn; a track of 50 mm in the opposite colour of each square.
Every element crosses one square from the middle of an edge to the middle of another: a straight of
2 m or a quarter circle of 1 m radius (section 6 and figure 2 of the paper).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from functools import cached_property
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike, NDArray

# --- elements ---

Array = NDArray[np.float64]
Square = tuple[int, int]
"""Column and row: the square reaches from 2 i to 2 i + 2 m in x and from 2 j to 2 j + 2 m in y."""

SQUARE: Final = 2.0
"""Side of a square (m)."""
RADIUS: Final = 1.0
"""Radius of an arc's centre line (m)."""
HALF_WIDTH: Final = 0.025
"""Half the track's width (m)."""
BAR_LENGTH, BAR_WIDTH = 0.50, 0.05
"""Length and width of the T's crossbar (m)."""
BAR_MARGIN: Final = 0.25
"""m between the crossbar and the end of its square: without paint of one colour all around, it
would not be a T."""
_DIRECTIONS: Final = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Unit vectors of the headings 0, 90, 180, 270 degrees."""


class ElementKind(StrEnum):
    """Kind of an element, in the direction of travel."""

    STRAIGHT = "S"
    LEFT = "L"
    RIGHT = "R"

    @property
    def length(self) -> float:
        """Length of the centre line, m."""
        return SQUARE if self is ElementKind.STRAIGHT else 0.5 * math.pi * RADIUS

    @property
    def turn(self) -> int:
        """Quarter turns to the left from its entrance to its exit."""
        return {ElementKind.STRAIGHT: 0, ElementKind.LEFT: 1, ElementKind.RIGHT: -1}[self]


class FloorPose(NamedTuple):
    """A point of the floor (m) and a heading (rad, counter-clockwise from x)."""

    x: float
    y: float
    heading: float


class Element(Struct, frozen=True):
    """One element. `heading` counts quarter turns from x; `start` is the arc length at its entrance
    (m)."""

    kind: ElementKind
    square: Square
    heading: int
    start: float
    painted: bool = True

    @property
    def end(self) -> float:
        """Arc length at its exit (m)."""
        return self.start + self.kind.length

    @property
    def entrance(self) -> tuple[float, float]:
        """Where it is entered (m)."""
        dx, dy = _DIRECTIONS[self.heading]
        return (self.square[0] + 0.5 * (1 - dx)) * SQUARE, (
            self.square[1] + 0.5 * (1 - dy)
        ) * SQUARE

    def at(self, way: float) -> FloorPose:
        """Return the pose `way` metres after the entrance; the line continues straight before the
        entrance and after the exit."""
        turn, inside = self.kind.turn, min(max(way, 0.0), self.kind.length)
        if turn:
            angle = inside / RADIUS
            u, w = RADIUS * math.sin(angle), turn * RADIUS * (1.0 - math.cos(angle))
        else:
            angle, u, w = 0.0, inside, 0.0
        beyond = way - inside
        u, w = u + beyond * math.cos(angle), w + beyond * turn * math.sin(angle)
        (x, y), (dx, dy) = self.entrance, _DIRECTIONS[self.heading]
        return FloorPose(
            x + u * dx - w * dy, y + u * dy + w * dx, self.heading * 0.5 * math.pi + turn * angle
        )

    def nearest(self, x: float, y: float) -> tuple[float, float, float]:
        """Return for a point: distance after the entrance (m, within the element), offset to the
        left (m) and distance (m)."""
        (x0, y0), (dx, dy) = self.entrance, _DIRECTIONS[self.heading]
        u, w = (x - x0) * dx + (y - y0) * dy, (y - y0) * dx - (x - x0) * dy
        if self.kind is ElementKind.STRAIGHT:
            way = min(max(u, 0.0), SQUARE)
            return way, w, math.hypot(u - way, w)
        turn = self.kind.turn
        angle = min(max(math.atan2(u, RADIUS - turn * w), 0.0), 0.5 * math.pi)
        aside = math.hypot(
            u - RADIUS * math.sin(angle), turn * w - RADIUS * (1.0 - math.cos(angle))
        )
        return angle * RADIUS, turn * (RADIUS - math.hypot(u, RADIUS - turn * w)), aside

    def depth(self, x: Array, y: Array) -> Array:
        """Return how far (m) points (...,) of its square lie within the track if it is painted;
        negative outside."""
        (x0, y0), (dx, dy) = self.entrance, _DIRECTIONS[self.heading]
        u, w = (x - x0) * dx + (y - y0) * dy, (y - y0) * dx - (x - x0) * dy
        aside = (
            w
            if self.kind is ElementKind.STRAIGHT
            else np.hypot(u, RADIUS - self.kind.turn * w) - RADIUS
        )
        inside: Array = HALF_WIDTH - np.abs(aside)
        return inside

    def tee_depth(self, x: Array, y: Array) -> Array:
        """Return the same where a straight element ends in a T: a crossbar before its exit, and
        nothing beyond that."""
        (x0, y0), (dx, dy) = self.entrance, _DIRECTIONS[self.heading]
        u, w = (x - x0) * dx + (y - y0) * dy, np.abs((y - y0) * dx - (x - x0) * dy)
        before_end = SQUARE - BAR_MARGIN - u
        stem = np.minimum(HALF_WIDTH - w, before_end)
        bar = np.minimum(0.5 * BAR_LENGTH - w, np.minimum(before_end, BAR_WIDTH - before_end))
        inside: Array = np.maximum(stem, bar)
        return inside

    @property
    def next_square(self) -> Square:
        """The square beyond its exit."""
        return beyond_edge(self.square, self.next_heading)

    @property
    def next_heading(self) -> int:
        """Heading at its exit, in quarter turns."""
        return (self.heading + self.kind.turn) % 4


def beyond_edge(square: Square, heading: int) -> Square:
    """Return the square next to `square` in direction `heading` (quarter turns)."""
    dx, dy = _DIRECTIONS[heading]
    return square[0] + dx, square[1] + dy


# --- the track ---

BOARD: Final = 8
"""Squares along each side of the board."""
_CLOSE: Final = 0.3
"""m off a square's own element up to which no other element can be nearer: others are at least 1 m
away, or join it at its ends."""


class TrackError(ValueError):
    """An impossible track; the message says why and what to ask for instead."""


class Near(NamedTuple):
    """The point of the centre line nearest to another point: its arc length (m), the other point's
    offset from it (m, positive to the left of the track's direction), its distance (m) and the
    element's index."""

    s: float
    offset: float
    distance: float
    element: int


class Gap(NamedTuple):
    """An interruption: arc lengths where the track ends and where it resumes (m), and the reflector
    above the latter (m)."""

    start: float
    end: float
    x: float
    y: float


def _on_board(square: Square) -> bool:
    return 0 <= square[0] < BOARD and 0 <= square[1] < BOARD


def white(square: Square) -> bool:
    """Return whether a square is white."""
    return (square[0] + square[1]) % 2 == 0


class Track:
    """A valid track. Its board reaches from (0, 0) to (16, 16) m; the chessboard continues around
    it, without a track."""

    def __init__(self, elements: Sequence[Element]) -> None:
        """Raises TrackError for elements that do not form a valid track."""
        self.elements = tuple(elements)
        self.length = self.elements[-1].end - BAR_MARGIN if elements else 0.0
        """Arc length of the crossbar's far side (m)."""
        self._of_square = {element.square: number for number, element in enumerate(self.elements)}
        self._check()

    @classmethod
    def of(cls, square: Square, heading: int, kinds: str, unpainted: Sequence[int] = ()) -> Track:
        """Return the track that begins in `square` with `heading` (quarter turns from x) and has
        these elements ("S", "L", "R").

        `unpainted` are the indices of the elements that interruptions replace. Raises TrackError.
        """
        elements: list[Element] = []
        start = 0.0
        for number, letter in enumerate(kinds):
            try:
                kind = ElementKind(letter)
            except ValueError as fault:
                raise TrackError(
                    f"element {letter!r}: there are S (straight), L (left) and R (right)"
                ) from fault
            element = Element(kind, square, heading, start, number not in unpainted)
            elements.append(element)
            square, heading, start = element.next_square, element.next_heading, element.end
        return cls(elements)

    @classmethod
    def by_seed(
        cls,
        seed: int,
        elements: int = 14,
        interruptions: int = 2,
        kinds: str = "mixed",
        arcs: float = 0.5,
    ) -> Track:
        """Return a random track with so many elements, of which interruptions replace straights,
        arcs or either (`kinds`: "straight", "arcs", "mixed").

        `arcs` is the share of arcs where there is a choice. Raises TrackError for an impossible
        request.
        """
        _check_wish(elements, interruptions, kinds, arcs)
        rng = np.random.default_rng((seed, _DRAWS))
        for _ in range(_ATTEMPTS):
            square = int(rng.integers(BOARD)), int(rng.integers(BOARD))
            heading = int(rng.integers(4))
            letters = _walk(rng, square, heading, elements, arcs)
            unpainted = None if letters is None else _interrupt(rng, letters, interruptions, kinds)
            if letters is not None and unpainted is not None:
                return cls.of(square, heading, letters, unpainted)
        raise TrackError(
            f"no track of {elements} elements with {interruptions} interruptions was found: "
            "ask for fewer of these or more of those"
        )

    @classmethod
    def contest(cls) -> Track:
        """Return the fixed competition-like track: 24 elements, of which two arcs and a straight
        are interrupted."""
        return cls.of(*CONTEST)

    @classmethod
    def read(cls, plain: Mapping[str, Any]) -> Track:
        """Return the track that `plain` described. Raises TrackError, KeyError."""
        i, j = plain["square"]
        return cls.of(
            (int(i), int(j)),
            int(plain["heading"]),
            str(plain["elements"]),
            tuple(plain["unpainted"]),
        )

    def plain(self) -> dict[str, Any]:
        """Return plain data from which `read` makes the track again."""
        first = self.elements[0]
        return {
            "square": list(first.square),
            "heading": first.heading,
            "elements": "".join(element.kind for element in self.elements),
            "unpainted": [
                number for number, element in enumerate(self.elements) if not element.painted
            ],
        }

    def _check(self) -> None:
        kinds = "".join(element.kind for element in self.elements)
        if not kinds.startswith("S") or not kinds.endswith("S"):
            raise TrackError(f"track {kinds!r}: it must begin and end with a straight element")
        if not all(_on_board(element.square) for element in self.elements):
            raise TrackError(f"track {kinds!r}: it leaves the board of {BOARD} by {BOARD} squares")
        if len(self._of_square) != len(self.elements):
            raise TrackError(f"track {kinds!r}: it uses a square twice")
        beyond = self.elements[-1].next_square
        if beyond in self._of_square or not _on_board(beyond):
            raise TrackError(f"track {kinds!r}: the square after its end is not free")
        unpainted = [number for number, element in enumerate(self.elements) if not element.painted]
        apart = all(b - a > _PAINTED_BETWEEN for a, b in pairwise(unpainted))
        if not apart or any(
            not _PAINTED_AT_ENDS <= n < len(kinds) - _PAINTED_AT_ENDS for n in unpainted
        ):
            raise TrackError(
                f"track {kinds!r}: interruptions {unpainted} must leave two painted elements "
                "at each end and between them"
            )

    # Centre line

    @cached_property
    def gaps(self) -> tuple[Gap, ...]:
        """Its interruptions, in order."""
        return tuple(
            Gap(element.start, element.end, *element.at(element.kind.length)[:2])
            for element in self.elements
            if not element.painted
        )

    @property
    def start(self) -> FloorPose:
        """Entrance of the first element."""
        return self.elements[0].at(0.0)

    @property
    def end(self) -> FloorPose:
        """The T: the far side of its crossbar."""
        return self.at(self.length)

    @cached_property
    def _starts(self) -> list[float]:
        return [element.start for element in self.elements]

    def element_at(self, s: float) -> int:
        """Return the index of the element at arc length s (m); the first or the last one outside
        the track."""
        number = int(np.searchsorted(self._starts, s, side="right")) - 1
        return min(max(number, 0), len(self.elements) - 1)

    def at(self, s: float) -> FloorPose:
        """Return the pose of the centre line at arc length s (m); outside the track it continues
        straight."""
        element = self.elements[self.element_at(s)]
        return element.at(s - element.start)

    def nearest(self, x: float, y: float) -> Near:
        """Return the point of the centre line nearest to (x, y); gaps count as if they were
        painted."""
        square = math.floor(x / SQUARE), math.floor(y / SQUARE)
        own = self._of_square.get(square)
        if own is not None:
            found = self._near(own, x, y)
            if found.distance < _CLOSE:
                return found
        return min(
            (self._near(number, x, y) for number in range(len(self.elements))),
            key=lambda near: near.distance,
        )

    def _near(self, number: int, x: float, y: float) -> Near:
        element = self.elements[number]
        way, offset, distance = element.nearest(x, y)
        return Near(element.start + way, offset, distance, number)

    # Floor

    def floor(self, x: ArrayLike, y: ArrayLike) -> NDArray[np.uint8]:
        """Return the colour of the floor at points (...,), m: 0 black, 1 white."""
        x, y = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        i, j = np.floor(x / SQUARE).astype(int), np.floor(y / SQUARE).astype(int)
        marked = np.zeros(x.shape, bool)
        for number, element in enumerate(self.elements):
            inside = (i == element.square[0]) & (j == element.square[1])
            if element.painted and inside.any():
                last = number == len(self.elements) - 1
                depth = element.tee_depth(x, y) if last else element.depth(x, y)
                marked |= inside & (depth >= 0.0)
        return np.asarray(((i + j) % 2 == 0) ^ marked, np.uint8)


# Random tracks: a depth-first walk over the board.

_DRAWS: Final = 0x747261
"""Keeps the draws of tracks separate from other draws of the same seed."""
_ATTEMPTS: Final = 400
_PAINTED_BETWEEN: Final = 2
_PAINTED_AT_ENDS: Final = 2
_BACKTRACKS: Final = 400
LEAST, MOST = 5, 40
"""Fewest and most elements of a random track."""
CONTEST: Final = ((7, 3), 2, "SSLRRSSRSLLRLSSSLSSRLSSS", (7, 12, 21))
"""First square, heading, elements and interruptions of the competition-like track."""
KINDS: Final[Mapping[str, str]] = {"straight": "S", "arcs": "LR", "mixed": "SLR"}
"""Elements that interruptions may replace, by name."""


def _check_wish(elements: int, interruptions: int, kinds: str, arcs: float) -> None:
    if not LEAST <= elements <= MOST:
        raise TrackError(f"{elements} elements: ask for {LEAST} to {MOST}")
    if interruptions < 0:
        raise TrackError(f"{interruptions} interruptions: ask for 0 or more")
    if kinds not in KINDS:
        raise TrackError(f"interruptions of kind {kinds!r}: there are {', '.join(KINDS)}")
    if not 0.0 <= arcs <= 1.0:
        raise TrackError(f"a share of arcs of {arcs}: ask for 0 to 1")


def _orders(rng: np.random.Generator, arcs: float) -> list[ElementKind]:
    """Return the three kinds in the order in which they are tried."""
    turns = (
        [ElementKind.LEFT, ElementKind.RIGHT]
        if rng.random() < 0.5
        else [ElementKind.RIGHT, ElementKind.LEFT]
    )
    return [*turns, ElementKind.STRAIGHT] if rng.random() < arcs else [ElementKind.STRAIGHT, *turns]


def _walk(
    rng: np.random.Generator, square: Square, heading: int, elements: int, arcs: float
) -> str | None:
    """Return a path of so many elements over the board that uses no square twice and has a free
    square after its end; depth first. None if there is none, or the search takes too long."""
    first = Element(ElementKind.STRAIGHT, square, heading, 0.0)
    way, used = [first], {square}
    tries: list[Iterator[ElementKind]] = [iter(())]
    for _ in range(_BACKTRACKS):
        if len(way) == elements:
            return "".join(element.kind for element in way)
        last = way[-1]
        if len(tries) == len(way):
            tries.append(
                iter(_orders(rng, arcs) if len(way) < elements - 1 else [ElementKind.STRAIGHT])
            )
        added = _step(last, tries[-1], used)
        if added is not None:
            way.append(added)
            used.add(added.square)
        elif len(way) == 1:
            return None
        else:
            tries.pop()
            used.discard(way.pop().square)
    return None


def _step(last: Element, kinds: Iterator[ElementKind], used: set[Square]) -> Element | None:
    """Return the next element after `last`, of the first kind that leads to a free square; None
    when no kind is left."""
    square, heading = last.next_square, last.next_heading
    if not _on_board(square) or square in used:
        return None
    for kind in kinds:
        element = Element(kind, square, heading, last.end)
        if _on_board(element.next_square) and element.next_square not in used:
            return element
    return None


def _interrupt(
    rng: np.random.Generator, letters: str, interruptions: int, kinds: str
) -> tuple[int, ...] | None:
    """Return the indices of elements to replace, far enough from each other and from both ends;
    None when there are too few."""
    chosen: list[int] = []
    inner = range(_PAINTED_AT_ENDS, len(letters) - _PAINTED_AT_ENDS)
    for number in rng.permutation([n for n in inner if letters[n] in KINDS[kinds]]).tolist():
        if len(chosen) < interruptions and all(
            abs(number - other) > _PAINTED_BETWEEN for other in chosen
        ):
            chosen.append(number)
    return tuple(sorted(chosen)) if len(chosen) == interruptions else None
