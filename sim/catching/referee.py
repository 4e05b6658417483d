"""Keeps the score: what was thrown, what could have been caught, what was caught, and how far off
the others passed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from msgspec import Struct

from petrobot.sim.catching.oracle import Oracle, OracleVerdict
from petrobot.sim.catching.thrower import ThrowCourse, ThrowOutcome

PLOTS: Final = {
    "catch_map": {
        "kind": "lines",
        "title": "The table from above: from the release to where each ball left",
        "x": "courses.start_y",
        "y": "courses.start_x",
        "x2": "courses.exit_y",
        "y2": "courses.exit_x",
        "x_label": "across the table, y (m)",
        "y_label": "away from the arm, x (m)",
        "colour": "throws.outcome",
    },
    "exits": {
        "kind": "points",
        "title": "Where and how fast each ball left the table",
        "x": "courses.exit_y",
        "y": "courses.exit_speed",
        "x_label": "y at the near edge (m)",
        "y_label": "speed (m/s)",
        "colour": "throws.outcome",
    },
    "misses": {
        "kind": "histogram",
        "title": "How far from the middle of the cup's mouth each ball came",
        "x": "throws.miss_mm",
        "least": 0.0,
        "most": 150.0,
        "x_label": "distance (mm), up to 150",
        "colour": "throws.outcome",
    },
}
"""Pictures that reports draw of these results (docs/campaigns.md)."""
MOST_ROWS: Final = 2_500
"""Most throws of which one answer tells the details; no message carries 2,900."""


class _Entry(Struct, frozen=True):
    course: ThrowCourse
    verdict: OracleVerdict


class CatchReferee:
    """Records each throw from its release on. `began` is the simulated time (s) from which releases
    are counted."""

    def __init__(self, seed: int, regime: str, oracle: Oracle, began: float) -> None:
        self._seed = seed
        self._regime = regime
        self._oracle = oracle
        self._began = began
        self._entries: list[_Entry] = []

    def enter(self, course: ThrowCourse, q: Sequence[float]) -> OracleVerdict:
        """Record a ball that was released with the arm's encoders at `q` (six, rad); its `course`
        is read again for the score."""
        verdict = self._oracle.judge(course.throw, q)
        self._entries.append(_Entry(course, verdict))
        return verdict

    @property
    def last(self) -> OracleVerdict | None:
        """Verdict on the newest throw."""
        return self._entries[-1].verdict if self._entries else None

    def score(self, now: float, cycles: Sequence[Mapping[str, Any]] = ()) -> dict[str, Any]:
        """Return all throws so far as plain data: `throws` (see `_row`), with more detail
        `courses` (see `_course`), and `balls`, counts for each of the caller's cycles. Of more than
        `MOST_ROWS` throws these lists have the newest, and `rows_left_off` counts the others.

        Of all balls `thrown`, those `over` are `caught` or `missed`; of the missed ones, the arm
        did not move for those `never_seen`. `reachable`: an estimate (sim/catching/oracle.py).

        `cycles` are the caller's cycles: `begun_ago`, `ended_ago` (s before `now`), `status` and
        `cause`. A throw takes the status of the cycle in which it was released, None if it was
        released in none.
        """
        newest = self._entries[-MOST_ROWS:]
        rows = [_row(entry) | _status(entry.course, now, cycles) for entry in newest]
        over = [e for e in self._entries if e.course.outcome is not ThrowOutcome.ROLLING]
        reachable = [entry.course for entry in over if entry.verdict.reachable]
        left_off = len(self._entries) - len(newest)
        return {
            "seed": self._seed,
            "regime": self._regime,
            "throws": rows,
            "courses": [
                _course(entry, self._began, status["run"])
                for entry, status in zip(newest, rows, strict=True)
            ],
            **({"rows_left_off": left_off} if left_off else {}),
            "plots": PLOTS,
            "balls": _balls([entry.course for entry in newest], [row["run"] for row in rows]),
            **_counts([entry.course for entry in self._entries]),
            "reachable": len(reachable),
            "reachable_caught": sum(c.outcome is ThrowOutcome.CAUGHT for c in reachable),
        }


def _counts(courses: Sequence[ThrowCourse]) -> dict[str, int]:
    over = [course for course in courses if course.outcome is not ThrowOutcome.ROLLING]
    missed = [course for course in over if course.outcome is not ThrowOutcome.CAUGHT]
    return {
        "thrown": len(courses),
        "over": len(over),
        "caught": len(over) - len(missed),
        "missed": len(missed),
        "never_seen": sum(not course.answered for course in missed),
    }


def _balls(courses: Sequence[ThrowCourse], runs: Sequence[int | None]) -> list[dict[str, Any]]:
    """Return the counts of each of the caller's cycles; `runs`: that of each throw, None: it was
    released in none."""
    thrown: dict[int | None, list[ThrowCourse]] = {}
    for course, run in zip(courses, runs, strict=True):
        thrown.setdefault(run, []).append(course)
    return [{"run": run, "n": run, **_counts(own)} for run, own in thrown.items()]


def _status(course: ThrowCourse, now: float, cycles: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    age = now - course.released_at
    for cycle in cycles:
        if cycle["begun_ago"] >= age >= cycle["ended_ago"]:
            return {
                "status": cycle["status"],
                "cause": cycle.get("cause", ""),
                "run": cycle.get("n"),
            }
    return {"status": None, "cause": "", "run": None}


def _row(entry: _Entry) -> dict[str, Any]:
    """Return one throw: its speed at release (m/s), its outcome, how far from the middle of the
    mouth it came (mm)."""
    course, verdict = entry.course, entry.verdict
    return {
        "n": course.throw.n,
        "speed": course.throw.speed,
        "caught": course.outcome is ThrowOutcome.CAUGHT,
        "outcome": str(course.outcome),
        "miss_mm": _finite(1000.0 * course.miss),
        "reachable": verdict.reachable,
    }


def _course(entry: _Entry, began: float, run: int | None) -> dict[str, Any]:
    """Return the details of one throw in m, m/s and s; durations count from its release, None: it
    did not happen."""
    course, exit_state = entry.course, entry.course.exit_state
    return {
        "n": course.throw.n,
        "run": run,
        "start_x": course.throw.start.position[0],
        "start_y": course.throw.start.position[1],
        "released_after": course.released_at - began,
        "spin_share": course.throw.spin_share,
        "rolling_resistance": course.throw.rolling_resistance,
        "exit_after": _finite(course.exit_time),
        "exit_x": exit_state.position[0] if exit_state else None,
        "exit_y": exit_state.position[1] if exit_state else None,
        "exit_speed": math.hypot(*exit_state.velocity) if exit_state else None,
        "caught_after": _finite(course.caught_at),
        "ended_after": _finite(course.ended_at),
        "margin": _finite(entry.verdict.margin),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
