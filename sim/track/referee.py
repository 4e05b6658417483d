"""Keeps the score of a run on the track: distance from the centre line, interruptions recovered,
where and when it stopped.

The rules (docs/decisions/mobile-contract.md) apply to the body's origin. It is *on* the track until
it is more than `LEFT` off; over an interruption it is in a *gap* until it is within `REGAINED` of
the centre line behind it; *lost* after it has left the track, until it is back on a painted element
no farther back than it was; and at the *end* once it has reached the T.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import Any, Final

from msgspec import Struct, field

from petrobot.sim.track.course import BOARD, SQUARE, FloorPose, Gap, Near, Track

LEFT: Final = 0.30
"""Distance from the centre line at which the track counts as left (m)."""
REGAINED: Final = 0.10
"""Distance from the centre line within which the track counts as regained (m)."""
IN_TIME: Final = 1.0
"""Distance behind an interruption within which the track must be regained (m)."""
BEFORE_END, BEYOND_END, ASIDE_END = 0.10, 0.30, 0.30
"""Where the rover must stop: before, beyond and beside the T's far side (m)."""
STANDING: Final = 0.01
"""Speed below which the rover counts as standing (m/s)."""
STANDING_FOR: Final = 0.5
"""How long it must be that slow to count as standing (s)."""
DEPARTED: Final = 0.01
"""Distance from where it was put down at which the clock starts (m)."""
OFF_BOARD: Final = 1.0
"""Distance beyond the board's edge at which a person stops the rover (m)."""
ROW_PERIOD: Final = 0.2
"""Time between two rows of the path, at first (s)."""
MOST_ROWS: Final = 5_000
"""Most rows of the path: the score of a rover that stands for hours fits into a message, too."""
_BEHIND, _AHEAD = 0.6, 1.2
"""m along the track by which the nearest point may have moved since the last look; more means
another part of the track."""


class RunPhase(StrEnum):
    """State of a run."""

    ON = "on"
    GAP = "gap"
    LOST = "lost"
    END = "end"


class _Crossing(Struct):
    """What happened at one interruption. `aside` is the greatest distance from the line that is
    missing there (m)."""

    gap: Gap
    kind: str
    reflector: bool
    entered: float | None = None
    ended: float | None = None
    recovered: bool = False
    aside: float = 0.0


class TrackReferee(Struct):
    """Watches one run. Call `watch` often; `score` returns plain data at any time."""

    track: Track
    seed: int
    regime: str
    began: float
    reflectors: Sequence[bool] = ()
    """Whether the reflector of each interruption is present; all are if this is empty."""
    phase: RunPhase = RunPhase.ON
    s: float = 0.0
    """Arc length reached (m)."""
    penalties: list[dict[str, Any]] = field(default_factory=list)
    departed: float | None = None
    """When the rover first moved (s)."""
    stopped: float | None = None
    """When it stopped at the T (s)."""
    finished: bool = False
    _path: list[tuple[float, float, float, float]] = field(default_factory=list)
    _period: float = ROW_PERIOD
    _way: float = 0.0
    _off: float = 0.0
    _squares: float = 0.0
    _most: float = 0.0
    _removed: bool = False
    _first: FloorPose | None = None
    _last: FloorPose | None = None
    _still_since: float | None = None
    _crossings: list[_Crossing] = field(default_factory=list)

    def __post_init__(self) -> None:
        kinds = [element.kind for element in self.track.elements if not element.painted]
        hang = self.reflectors or [True] * len(kinds)
        self._crossings = [
            _Crossing(gap, kind.name.lower(), there)
            for gap, kind, there in zip(self.track.gaps, kinds, hang, strict=True)
        ]

    def watch(self, now: float, pose: FloorPose, speed: float) -> bool:
        """Process the body's pose and speed (m/s) at a moment (s). Return whether the rover has
        just left the board, where a person presses its emergency stop."""
        self._record(now - self.began, pose)
        if self.stopped is not None or self._removed:
            return False
        if self._first is None:
            self._first = pose
        last, self._last = self._last, pose
        step = 0.0 if last is None else math.hypot(pose.x - last.x, pose.y - last.y)
        if self.departed is None:
            if math.hypot(pose.x - self._first.x, pose.y - self._first.y) < DEPARTED:
                return False
            self.departed = now
        self._way += step
        if step > 0.0 and self.phase is not RunPhase.END:
            self._locate(now, pose, step)
        if self.phase is RunPhase.END:
            self._await_stop(now, pose, speed)
        if not all(-OFF_BOARD <= at <= BOARD * SQUARE + OFF_BOARD for at in (pose.x, pose.y)):
            self._removed = True
            self._penalize(now, "left_board", pose)
        return self._removed

    def _locate(self, now: float, pose: FloorPose, step: float) -> None:
        near = self.track.nearest(pose.x, pose.y)
        if self.phase is RunPhase.ON:
            self._follow(now, pose, near, step)
        elif self.phase is RunPhase.GAP:
            self._cross(now, pose, near)
        elif self._painted(near) and near.distance <= REGAINED and near.s >= self.s - _BEHIND:
            self._go_on(now, pose, near)
        if self.phase is RunPhase.ON and self.s >= self.track.length - BEFORE_END:
            self.phase, self.finished = RunPhase.END, True

    def _follow(self, now: float, pose: FloorPose, near: Near, step: float) -> None:
        if near.distance > LEFT or not -_BEHIND <= near.s - self.s <= _AHEAD:
            self.phase = RunPhase.LOST
            self._penalize(now, "track_left", pose)
            return
        self.s = max(self.s, near.s)
        if self._painted(near):
            self._off += step
            self._squares += step * near.distance * near.distance
            self._most = max(self._most, near.distance)
            return
        self.phase = RunPhase.GAP
        for crossing in self._crossings:
            if crossing.gap.start <= near.s <= crossing.gap.end and crossing.entered is None:
                crossing.entered = now

    def _cross(self, now: float, pose: FloorPose, near: Near) -> None:
        open_gaps = [
            each for each in self._crossings if each.entered is not None and each.ended is None
        ]
        for crossing in open_gaps:
            crossing.aside = max(crossing.aside, near.distance)
        if self._painted(near) and near.distance <= REGAINED and near.s >= self.s:
            self._go_on(now, pose, near)

    def _go_on(self, now: float, pose: FloorPose, near: Near) -> None:
        """Continue on the regained track: every interruption before it is recovered or missed."""
        for crossing in self._crossings:
            if crossing.ended is None and crossing.gap.end <= near.s + 1e-9:
                crossing.ended = now
                crossing.recovered = (
                    crossing.entered is not None and near.s <= crossing.gap.end + IN_TIME
                )
                if not crossing.recovered:
                    self._penalize(now, "interruption_missed", pose, crossing.gap.end)
        self.phase, self.s = RunPhase.ON, max(self.s, near.s)

    def _painted(self, near: Near) -> bool:
        return self.track.elements[near.element].painted

    def _await_stop(self, now: float, pose: FloorPose, speed: float) -> None:
        end = self.track.end
        c, s = math.cos(end.heading), math.sin(end.heading)
        ahead = (pose.x - end.x) * c + (pose.y - end.y) * s
        aside = (pose.y - end.y) * c - (pose.x - end.x) * s
        if abs(speed) >= STANDING:
            self._still_since = None
        elif self._still_since is None:
            self._still_since = now
        beyond = ahead > BEYOND_END or abs(aside) > ASIDE_END
        if beyond and not any(each["kind"] == "not_stopped" for each in self.penalties):
            self._penalize(now, "not_stopped", pose, self.track.length)
        still = self._still_since is not None and now - self._still_since >= STANDING_FOR - 1e-9
        if still and not beyond and ahead >= -BEFORE_END:
            self.stopped = self._still_since

    def _penalize(self, now: float, kind: str, pose: FloorPose, s: float | None = None) -> None:
        begun = self.began if self.departed is None else self.departed
        row = {"s": self.s if s is None else s, "x": pose.x, "y": pose.y, "after": now - begun}
        self.penalties.append(
            {"kind": kind, **{key: round(value, 3) for key, value in row.items()}}
        )

    # The score

    def score(self, now: float) -> dict[str, Any]:
        """Return the result of the run as plain data (docs/decisions/mobile-contract.md); keys
        without a unit are counts or flags."""
        begun = now if self.departed is None else self.departed
        overrun = any(each["kind"] == "not_stopped" for each in self.penalties)
        stopped_at_t = self.stopped is not None and not overrun
        duration = (now if self.stopped is None else self.stopped) - begun
        penalties = self._all_penalties(now, stopped_at_t, overrun)
        return {
            "seed": self.seed,
            "regime": self.regime,
            "finished": self.finished,
            "stopped_at_T": stopped_at_t,
            "time_s": round(duration, 3),
            "penalties": penalties,
            "penalty_count": len(penalties),
            "rms_mm": round(1000.0 * math.sqrt(self._squares / self._off), 3)
            if self._off
            else None,
            "max_mm": round(1000.0 * self._most, 3) if self._off else None,
            "interruptions": len(self._crossings),
            "recovered": sum(crossing.recovered for crossing in self._crossings),
            "crossings": [self._crossing(crossing, begun) for crossing in self._crossings],
            "reached_m": round(self.s, 3),
            "length_m": round(self.track.length, 3),
            "way_m": round(self._way, 3),
            "mean_speed": round(self._way / duration, 4) if duration > 0.0 else 0.0,
            "track": self.track.plain(),
            "path": [
                [round(t, 3), round(x, 3), round(y, 3), round(heading, 3)]
                for t, x, y, heading in self._path
            ],
        }

    def _record(self, time: float, pose: FloorPose) -> None:
        """Add a row to the path. Once it has `MOST_ROWS` every second one is dropped, and rows are
        added half as often."""
        if self._path and time < self._path[-1][0] + self._period - 1e-9:
            return
        if len(self._path) == MOST_ROWS:
            self._path, self._period = self._path[::2], 2.0 * self._period
        self._path.append((time, *pose))

    def _all_penalties(self, now: float, stopped_at_t: bool, overrun: bool) -> list[dict[str, Any]]:
        """Return the penalties so far, plus those that a run that ends now has earned."""
        given, last = list(self.penalties), self._last or self.track.start
        for crossing in self._crossings:
            if crossing.entered is not None and crossing.ended is None:
                self._penalize(now, "interruption_missed", last, crossing.gap.end)
        if self.finished and not stopped_at_t and not overrun:
            self._penalize(now, "not_stopped", last, self.track.length)
        found, self.penalties = self.penalties, given
        return found

    @staticmethod
    def _crossing(crossing: _Crossing, begun: float) -> dict[str, Any]:
        entered, ended = crossing.entered, crossing.ended
        return {
            "kind": crossing.kind,
            "s": round(crossing.gap.start, 3),
            "reflector": crossing.reflector,
            "recovered": crossing.recovered,
            "entered_after": None if entered is None else round(entered - begun, 3),
            "took_s": None if entered is None or ended is None else round(ended - entered, 3),
            "aside_m": round(crossing.aside, 3),
        }
