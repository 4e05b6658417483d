"""The simulated person who throws the balls: what each throw is, when it is released, and what
happens to it.

Throw n of a seed is the same whatever happened before it: its generator is keyed by (seed, n).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum
from typing import Any

import numpy as np
from msgspec import Struct

from petrobot.sim.catching.ball import BallModel, BallState
from petrobot.sim.catching.truth import Truth

_STREAM = 0x7468  # Keeps the thrower's draws separate from other draws of the same seed.


class Throw(Struct, frozen=True):
    """One throw: `speed` (m/s) and `start` at release, the point at which it is aimed (`exit_y`,
    m), and the resistance that the ball meets."""

    n: int
    delay: float
    """Time from "ready" to the release (s)."""
    speed: float
    start: BallState
    exit_y: float
    spin_share: float
    """Spin at release as a share of pure rolling."""
    rolling_resistance: float


def draw_throw(seed: int, n: int, cell: Mapping[str, Any], truth: Truth) -> Throw:
    """Return throw `n` (1, 2, ...) of `seed`: from 0.1 m before the far edge towards a point of the
    near edge."""
    rng = np.random.default_rng((seed, n, _STREAM))
    ball, settings = cell["ball"], truth.settings
    delay = float(rng.uniform(*settings["thrower"]["delay"]))
    speed = float(rng.uniform(*truth.speed))
    y, exit_y = (
        float(v) for v in rng.uniform(-ball["exit_half_width"], ball["exit_half_width"], 2)
    )
    share = float(rng.uniform(*settings["ball"]["spin"]))
    spread = settings["ball"]["rolling_resistance_spread"]
    resistance = float(ball["rolling_resistance"] * (1.0 + rng.uniform(-spread, spread)))
    x = truth.table.far_edge - ball["release"]
    way_x, way_y = truth.table.near_edge - x, exit_y - y
    way = math.hypot(way_x, way_y)
    vx, vy = speed * way_x / way, speed * way_y / way
    model = BallModel.of(ball, settings["ball"]["friction"])
    start = BallState(
        (x, y, truth.table.top + model.radius), (vx, vy, 0.0), model.spin_of_rolling(vx, vy, share)
    )
    return Throw(n, delay, speed, start, exit_y, share, resistance)


class Thrower:
    """Releases one throw after the other, each a random delay (by seed) after everything has become
    ready for it."""

    def __init__(
        self, cell: Mapping[str, Any], truth: Truth, seed: int, throws: int | None = None
    ) -> None:
        """`throws` limits their number; None: no limit."""
        self._cell = cell
        self._truth = truth
        self._seed = seed
        self._throws = throws
        self._ready_since: float | None = None
        self._next: Throw | None = self._draw(1)

    def _draw(self, n: int) -> Throw | None:
        if self._throws is not None and n > self._throws:
            return None
        return draw_throw(self._seed, n, self._cell, self._truth)

    def advance(self, now: float, ready: bool) -> Throw | None:
        """Return the throw to release at `now` (s), None if there is none. `ready`: images are
        taken, the last ball is gone, the cup is empty and the arm stands still at home."""
        if not ready or self._next is None:
            self._ready_since = None
            return None
        if self._ready_since is None:
            self._ready_since = now
        if now < self._ready_since + self._next.delay:
            return None
        released = self._next
        self._ready_since = None
        self._next = self._draw(released.n + 1)
        return released


# --- what happens to a throw ---


class ThrowOutcome(StrEnum):
    """What happened to a throw."""

    ROLLING = "rolling"
    """Not decided yet."""
    CAUGHT = "caught"
    MISSED = "missed"
    DROPPED = "dropped"
    """It was in the cup and left it while the cup stood upright."""


class ThrowCourse(Struct):
    """What was seen of one throw so far. Times are seconds after its release, lengths m, base
    frame."""

    throw: Throw
    released_at: float
    outcome: ThrowOutcome = ThrowOutcome.ROLLING
    answered: bool = False
    """Whether the arm moved while it was in play: it was seen."""
    exit_time: float = math.inf
    """When the centre left the near edge; inf if it did not."""
    exit_state: BallState | None = None
    crossing: float = math.inf
    """Least distance from the centre of the cup's mouth at which the ball's centre, once off the
    table, passed the plane of the mouth from outside; inf if it never did."""
    approach: float = math.inf
    """Least distance of the ball's centre from the centre of the mouth."""
    caught_at: float = math.inf
    ended_at: float = math.inf
    """When the ball was taken out of play."""

    @property
    def miss(self) -> float:
        """Distance of the ball from the middle of the mouth (m): in the plane of the mouth where it
        crossed that, else its closest approach."""
        return self.crossing if self.crossing < math.inf else self.approach


class LightBarrier(Struct):
    """A light barrier with a filter: its output follows the beam after `delay` seconds without a
    change."""

    delay: float
    output: bool = False
    _since: float = 0.0

    def see(self, now: float, interrupted: bool) -> None:
        """Set the state of the beam at `now` (s); call it at least once per tick."""
        if interrupted == self.output:
            self._since = now
        elif now - self._since >= self.delay:
            self.output = interrupted
            self._since = now
