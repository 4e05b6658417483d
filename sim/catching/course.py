"""What happens to one throw, and the light barrier that detects the ball."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum

from petrobot.sim.catching.ball import BallState
from petrobot.sim.catching.thrower import Throw


class ThrowOutcome(StrEnum):
    """What happened to a throw."""

    ROLLING = "rolling"
    """Not decided yet."""
    CAUGHT = "caught"
    MISSED = "missed"
    DROPPED = "dropped"
    """It was in the cup and left it while the cup stood upright."""


@dataclass(slots=True)
class ThrowCourse:
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


@dataclass(slots=True)
class LightBarrier:
    """A light barrier with a filter: its output follows the beam after `delay` seconds without a
    change."""

    delay: float
    output: bool = False
    _since: float = field(default=0.0)

    def see(self, now: float, interrupted: bool) -> None:
        """Set the state of the beam at `now` (s); call it at least once per tick."""
        if interrupted == self.output:
            self._since = now
        elif now - self._since >= self.delay:
            self.output = interrupted
            self._since = now
