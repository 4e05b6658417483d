"""Following a line: control laws that return the curvature to drive, and the speed that fits it.
Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final

from msgspec import Struct

from petrobot.services.mobile.track_map import Fit

Look = Callable[[float], Fit | None]
"""Function that returns the line this many metres ahead, body frame; None where unknown."""

TIGHTEST: Final = 4.0
"""1/m: the greatest curvature that is driven."""


def capped(value: float, limit: float) -> float:
    """Return a value limited to +-limit."""
    return max(-limit, min(limit, value))


class PurePursuit(Struct, frozen=True):
    """Drive the circle, tangent to the heading, that leads to the point of the line `distance` m
    away (R. C. Coulter, "Implementation of the pure pursuit path tracking algorithm", 1992).

    Needs neither direction nor curvature of the line, so it tolerates coarse sights; it cuts
    corners where the curvature changes.
    """

    distance: float = 0.34

    def curvature(self, look: Look, speed: float) -> float | None:
        """Return the curvature in 1/m, None where the line is not known at that distance."""
        x, fit = self.distance, look(self.distance)
        for _ in range(2):
            if fit is None:
                return None
            x = math.sqrt(max(0.04, self.distance**2 - fit.y**2))
            fit = look(x)
        if fit is None:
            return None
        return capped(2.0 * fit.y / (x * x + fit.y * fit.y), TIGHTEST)


class FeedForward(Struct, frozen=True):
    """The line's own curvature where the wheels will have responded, plus PD on the error at the
    axle.

    With kappa = kappa_line + p e + d sin(heading error) the error obeys e'' + d e' + p e = 0 along
    the path: critically damped for d = 2 sqrt(p), and the lag of the wheels needs a little more.
    The distance over which the error decays, 1 / sqrt(p) m, does not depend on the speed.
    """

    gain: float = 60.0
    damping: float = 1.1
    lead: float = 0.09
    """Time from a set point until the wheels have responded (s)."""
    bent: float = 1.2
    """1/m, greatest curvature of the line that is believed: the track's arcs have 1 m radius, what
    seems tighter is a kink."""
    steepest: float = 0.5
    """Greatest sine of the angle at which a line far to the side is approached: the camera must not
    lose it."""

    def curvature(self, look: Look, speed: float) -> float | None:
        """Return the curvature in 1/m, None where the line is not known at the axle and just ahead
        of it."""
        here, soon = look(0.0), look(self.lead * speed)
        if here is None or soon is None:
            return None
        damping = 2.0 * self.damping * math.sqrt(self.gain)
        towards = capped(self.gain / damping * here.y * math.cos(here.heading), self.steepest)
        bent = capped(soon.curvature, self.bent)
        return capped(bent + damping * (towards + math.sin(here.heading)), TIGHTEST)


LAWS: Final[Mapping[str, PurePursuit | FeedForward]] = {
    "feed_forward": FeedForward(),
    "pursuit": PurePursuit(),
}


class SpeedProfile(Struct, frozen=True):
    """How fast to drive: as asked, slower in curves and towards the end of what is known."""

    sideways: float = 0.7
    """m/s^2, greatest lateral acceleration in a curve."""
    braking: float = 0.8
    """m/s^2 with which the end of the known line is approached."""
    raising: float = 0.8
    """m/s^2, greatest acceleration."""
    margin: float = 0.02
    """Where to stand before the end of the known line (m)."""

    def speed(self, asked: float, curvature: float, ahead: float) -> float:
        """Return the speed (m/s) for a curvature (1/m) with the line known for `ahead` m."""
        # v^2 * curvature = lateral acceleration; v^2 = 2 * deceleration * distance.
        in_curve = math.sqrt(self.sideways / max(abs(curvature), 1e-3))
        at_end = math.sqrt(2.0 * self.braking * max(0.0, ahead - self.margin))
        return min(asked, in_curve, at_end)

    def towards(self, present: float, wanted: float, dt: float) -> float:
        """Return the next set speed (m/s) between the present and the wanted one."""
        up, down = self.raising * dt, 1.6 * self.braking * dt
        return min(max(wanted, present - down), present + up)

    def distance(self, speed: float) -> float:
        """Return how far (m) the rover drives on from `speed` (m/s) until `towards` has it
        stand."""
        return speed * speed / (3.2 * self.braking)
