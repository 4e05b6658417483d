"""Map of the track near the rover: points of its centre line in the odometry frame, seen or only
expected.

The camera sees the track only from 0.4 m ahead on. What it saw is kept until the axle has passed
over it, so that the error at the axle itself is known. Where the track is interrupted, the points
of a plan replace what cannot be seen; what follows the map does not distinguish the two.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.services.mobile.odometry import Pose
from petrobot.services.mobile.paths import join, passes
from petrobot.services.mobile.sight import LineEnd, TrackAhead, TrackEnd

Vector = NDArray[np.float64]

CAPACITY = 640
"""Points kept; the oldest are overwritten."""
STEP = 0.015
"""Distance between two places from which sights are taken (m)."""
TURN_STEP = 0.03
"""The same for turning (rad)."""
ALIKE = 5
"""Sights that are taken from one place: the noise of a standing rover is averaged, then nothing new
is learned."""
REACH = 0.22
"""Radius in which points count for the fit at a place, the nearer the more (m)."""
NEEDED = 3
"""Points that a fit needs."""
OTHER = 0.15
"""Distance from the known line beyond which a sight shows something else (m)."""
GATE_ASIDE, GATE_TURN = 0.3, 0.6
"""Greatest distance and angle of a line from a gate (m, rad)."""
STEP_ASIDE = 0.06
"""Distance beside the plan from which a seen line is joined by a new path (m)."""
ENDS = 12
"""Sights of an end that are averaged."""


class Fit(Struct, frozen=True):
    """The line near a place, in the body frame of a pose: y, slope and bend at that distance ahead
    (m, 1, 1/m)."""

    y: float
    slope: float
    bend: float

    @property
    def heading(self) -> float:
        """Direction relative to the pose's (rad)."""
        return math.atan(self.slope)

    @property
    def curvature(self) -> float:
        """1/m, positive to the left."""
        steep = 1.0 + self.slope * self.slope
        return self.bend / (steep * math.sqrt(steep))


class TrackMap:
    """Points with weights. All arguments are in the odometry frame unless a name says otherwise."""

    def __init__(self) -> None:
        self._points = np.zeros((CAPACITY, 3))
        self._count = 0
        self._taken_at: Pose | None = None
        self._alike = 0
        self._planned: Vector = np.empty((0, 3))
        self._ends: deque[tuple[TrackEnd, float, float]] = deque(maxlen=ENDS)
        self.tip: tuple[float, float] | None = None
        """The farthest point known."""
        self.refused = 0
        """Sights in a row that did not fit what was known."""
        self.sights = 0
        """Sights taken since `begin`."""
        self.entry: Pose | None = None
        """The nearest point of the newest sight, and the line's direction from there."""
        self._local: tuple[Pose, tuple[Vector, Vector, Vector, int]] | None = None
        self._gates: tuple[Pose, ...] = ()
        self._looks = True
        self.regained = False
        """Whether the stretch for which `begin` named gates has been found; see `settle`."""

    def begin(self, gates: Sequence[Pose] = (), *, look: bool = True) -> None:
        """Begin a new stretch: keep what lies behind until the axle has passed it, forget the end
        of the last stretch.

        With `gates`, only a line that leads through one of them is accepted until `settle` is
        called: others may be in view, for example while the rover turns on the spot. Without
        `look`, no sight is taken until the next stretch begins.
        """
        self._ends.clear()
        self.sights, self.refused, self.entry = 0, 0, None
        self._gates, self._looks, self.regained = tuple(gates), look, False

    def settle(self) -> None:
        """Accept from now on what continues the stretch: it has been found and lies in front of the
        rover."""
        self._gates, self.regained = (), True

    @property
    def gated(self) -> bool:
        """Whether the stretch is searched through gates."""
        return bool(self._gates)

    @property
    def complete(self) -> bool:
        """Whether nothing needs to be seen any more: the end is known, or no sights are taken at
        all."""
        return not self._looks or bool(self._ends)

    # Input

    def take(self, pose: Pose, ahead: TrackAhead) -> bool:
        """Take a sight from `pose` (where the rover was at exposure). Return False if it was not
        used: nothing new, or something else."""
        if len(ahead.points) < 3 or not self._looks:
            return False
        if not self._admitted(pose, ahead.points) or self._contradicts(pose, ahead.points):
            self.refused += 1
            return False
        self.refused = 0
        if ahead.end is not None:
            self._note_end(pose, ahead.end)
        self._see_instead_of_plan(pose, ahead.points)
        self.tip = pose.floor(*ahead.points[-1])
        self.entry = _entry(pose, ahead.points)
        if self._nothing_new(pose):
            return False
        self._taken_at = pose
        self.sights += 1
        self._local = None
        for x, y in ahead.points:
            self._add(*pose.floor(x, y), 1.0 / (0.3 + x * x))  # Near points are sharper.
        return True

    def plan(self, points: Sequence[Sequence[float]]) -> None:
        """Expect the track at these points (m), near to far, instead of those expected before."""
        self._expect(points)
        self._ends.clear()
        if len(self._planned):
            self.tip = (float(self._planned[-1, 0]), float(self._planned[-1, 1]))

    def _expect(self, points: Sequence[Sequence[float]]) -> None:
        self._planned = np.array([[x, y, 1.0] for x, y in points], dtype=float).reshape(-1, 3)
        self._local = None

    def drop_seen(self) -> None:
        """Forget what was seen, not what is expected."""
        self._count, self._taken_at, self._local = 0, None, None

    def drop_plan(self) -> None:
        """Forget what is expected; keep what was seen."""
        self._planned, self._local = np.empty((0, 3)), None

    def _add(self, x: float, y: float, weight: float) -> None:
        self._points[self._count % CAPACITY] = (x, y, weight)
        self._count += 1

    def _nothing_new(self, pose: Pose) -> bool:
        last = self._taken_at
        if last is None:
            return False
        here = (
            math.hypot(pose.x - last.x, pose.y - last.y) < STEP
            and abs(pose.heading - last.heading) < TURN_STEP
        )
        self._alike = self._alike + 1 if here else 0
        return self._alike >= ALIKE

    def _admitted(self, pose: Pose, points: Sequence[tuple[float, float]]) -> bool:
        """Return whether a line may be the new stretch."""
        if not self._gates:
            return True
        line = [pose.floor(*point) for point in points]
        return any(passes(line, gate, GATE_ASIDE, GATE_TURN) for gate in self._gates)

    def _see_instead_of_plan(self, pose: Pose, points: Sequence[tuple[float, float]]) -> None:
        """Remove the plan where the line is now seen.

        A line well beside the plan replaces all that was known, for a step in the map would look
        like a bend. Since it may begin far ahead, a smooth path from here to its beginning is
        planned instead.
        """
        if not len(self._planned):
            return
        x, y = points[0]
        planned = self.fit(pose, x)
        self._local = None
        if planned is not None and abs(planned.y - y) > STEP_ASIDE and not self.sights:
            self.drop_seen()
            self._expect(join(pose, _entry(pose, points), 0.0))
            return
        cos, sin = math.cos(pose.heading), math.sin(pose.heading)
        ahead = (self._planned[:, 0] - pose.x) * cos + (self._planned[:, 1] - pose.y) * sin
        aside = (self._planned[:, 1] - pose.y) * cos - (self._planned[:, 0] - pose.x) * sin
        self._planned = self._planned[~((ahead > x - 0.06) & (np.abs(aside - y) < 1.0))]

    def _contradicts(self, pose: Pose, points: Sequence[tuple[float, float]]) -> bool:
        off = []
        for x, y in points[:: max(1, len(points) // 4)]:
            fit = self.fit(pose, x, 0.12, planned=False)
            if fit is not None:
                off.append(abs(fit.y - y) * math.cos(fit.heading))
        return len(off) >= 2 and sorted(off)[len(off) // 2] > OTHER

    def _note_end(self, pose: Pose, end: LineEnd) -> None:
        self._ends.append((end.kind, *pose.floor(end.x, end.y)))

    # Output

    @property
    def end(self) -> tuple[TrackEnd, float, float] | None:
        """Kind and position (m) of the end of this stretch, None when none was seen."""
        if not self._ends:
            return None
        kind = self._ends[-1][0]
        same = [(x, y) for k, x, y in self._ends if k is kind]
        # Added one by one: since Python 3.12 `sum` corrects the rounding of floats, and lock step
        # promises the same bits on every Python.
        x, y = same[0]
        for more_x, more_y in same[1:]:
            x, y = x + more_x, y + more_y
        return kind, x / len(same), y / len(same)

    @property
    def end_place(self) -> tuple[float, float] | None:
        """Where the line ends, or how far it is known if no end was seen (m)."""
        end = self.end
        return (end[1], end[2]) if end is not None else self.tip

    def ahead(self, pose: Pose) -> float:
        """Return how far ahead (m) the line is known, up to its end if that was seen; negative when
        that lies behind."""
        place = self.end_place
        if place is None:
            return 0.0
        x, y = pose.body(*place)
        return (
            math.copysign(math.hypot(x, y), x)
            if abs(x) < 0.3
            else (x if x < 0.0 else math.hypot(x, y))
        )

    def fit(
        self, pose: Pose, x: float, reach: float = REACH, *, planned: bool = True
    ) -> Fit | None:
        """Return the line `x` m ahead of a pose, from the points within `reach` of it; None where
        there are too few."""
        near = self._near(pose, x, reach, planned)
        if near is None:
            return None
        d, y, w = near
        spread = float(d.max() - d.min())
        if spread < 0.25 * reach:
            return None
        degree = (
            2 if spread > 0.8 * reach and d.min() < 0.3 * reach and d.max() > -0.3 * reach else 1
        )
        return _weighted(d, y, w, degree)

    def _near(
        self, pose: Pose, x: float, reach: float, planned: bool
    ) -> tuple[Vector, Vector, Vector] | None:
        """Return distances from the place, y and weights of the points that count there."""
        ahead, y, w, seen = self._around(pose)
        if not planned:
            ahead, y, w = ahead[:seen], y[:seen], w[:seen]
        d = ahead - x
        keep = (np.abs(d) < reach).nonzero()[0]
        if keep.size < NEEDED:
            return None
        d, y, w = d.take(keep), y.take(keep), w.take(keep)
        # Biweight kernel: (1 - (d / reach)^2)^2 times the point's own weight.
        part = d * (1.0 / reach)
        part *= part
        np.subtract(1.0, part, out=part)
        part *= part
        part *= w
        return d, y, part

    def _around(self, pose: Pose) -> tuple[Vector, Vector, Vector, int]:
        """Return points near a pose in its body frame, their weights, and how many of them were
        seen; cached, since several fits need them."""
        if self._local is not None and self._local[0] == pose:
            return self._local[1]
        seen = self._points[: min(self._count, CAPACITY)]
        points = np.concatenate((seen, self._planned)) if len(self._planned) else seen
        cos, sin = math.cos(pose.heading), math.sin(pose.heading)
        dx, dy = points[:, 0] - pose.x, points[:, 1] - pose.y
        x, y = dx * cos + dy * sin, dy * cos - dx * sin
        keep = ((np.abs(x - 0.45) < 0.8) & (np.abs(y) < 0.7)).nonzero()[0]
        number = int(keep.searchsorted(len(seen)))
        found = x.take(keep), y.take(keep), points[:, 2].take(keep), number
        self._local = (pose, found)
        return found


def _entry(pose: Pose, points: Sequence[tuple[float, float]]) -> Pose:
    """Return where a line seen from a pose begins, and its direction over the first third of a
    metre."""
    (x0, y0), (x1, y1) = points[0], points[min(len(points) - 1, 6)]
    return Pose(*pose.floor(x0, y0), pose.heading + math.atan2(y1 - y0, x1 - x0))


def _weighted(d: Vector, y: Vector, w: Vector, degree: int) -> Fit | None:
    """Return the weighted least-squares fit about d = 0, by normal equations and Cramer's rule:
    three unknowns at most."""
    wd = w * d
    s0, s1, s2 = float(w.sum()), float(wd.sum()), float(wd @ d)
    t0, t1 = float(w @ y), float(wd @ y)
    if degree == 1:
        determinant = s0 * s2 - s1 * s1
        if determinant <= 1e-12:
            return None
        return Fit((t0 * s2 - t1 * s1) / determinant, (s0 * t1 - s1 * t0) / determinant, 0.0)
    dd = d * d
    s3, s4, t2 = float(wd @ dd), float((w * dd) @ dd), float((w * dd) @ y)
    a = s2 * s4 - s3 * s3
    b = s2 * s3 - s1 * s4
    c = s1 * s3 - s2 * s2
    determinant = s0 * a + s1 * b + s2 * c
    if abs(determinant) < 1e-15:
        return None
    value = (t0 * a + t1 * b + t2 * c) / determinant
    slope = (t0 * b + t1 * (s0 * s4 - s2 * s2) + t2 * (s1 * s2 - s0 * s3)) / determinant
    half_bend = (t0 * c + t1 * (s1 * s2 - s0 * s3) + t2 * (s0 * s2 - s1 * s1)) / determinant
    return Fit(value, slope, 2.0 * half_bend)
