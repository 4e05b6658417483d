"""Following a line: laws that give the curvature to drive, and the speed that goes with it.
Pure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from petrobot.services.mobile.track_map import Fit

Look = Callable[[float], Fit | None]
"""Gives the line so many metres ahead, body frame; None where it is not known."""

TIGHTEST: Final = 4.0
"""1/m: the most curved way that is driven."""


def capped(value: float, limit: float) -> float:
    """A value brought within +-limit."""
    return max(-limit, min(limit, value))


@dataclass(frozen=True, slots=True)
class PurePursuit:
    """Drive the circle, tangent to the heading, that leads to the point of the line `distance` m
    away (Coulter 1992).

    Needs neither direction nor curvature of the line, so it stands coarse sights; cuts where the
    curvature changes.
    """

    distance: float = 0.34

    def curvature(self, look: Look, speed: float) -> float | None:
        """1/m, None where the line is not known at that distance."""
        x, fit = self.distance, look(self.distance)
        for _ in range(2):
            if fit is None:
                return None
            x = math.sqrt(max(0.04, self.distance**2 - fit.y**2))
            fit = look(x)
        if fit is None:
            return None
        return capped(2.0 * fit.y / (x * x + fit.y * fit.y), TIGHTEST)


@dataclass(frozen=True, slots=True)
class FeedForward:
    """The line's own curvature where the wheels will have answered, plus PD on the error at the
    axle.

    With kappa = kappa_line + p e + d sin(heading error) the error obeys e'' + d e' + p e = 0 along
    the way: critically damped for d = 2 sqrt(p), for which the wheels' lag asks for a little more.
    The way in which it dies out, 1 / sqrt(p) m, does not depend on the speed.
    """

    gain: float = 60.0
    damping: float = 1.1
    lead: float = 0.09
    """s from a set point until the wheels have answered."""
    bent: float = 1.2
    """1/m that a line is believed to be curved at most: the track's arcs have 1 m radius, what
    seems tighter is a kink."""
    steepest: float = 0.5
    """Sine of the angle at which a line far aside is approached at most: the camera must not lose
    it."""

    def curvature(self, look: Look, speed: float) -> float | None:
        """1/m, None where the line is not known at the axle and just ahead of it."""
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


@dataclass(frozen=True, slots=True)
class SpeedProfile:
    """How fast to go: as asked, slower in curves and towards the end of what is known."""

    sideways: float = 0.7
    """m/s^2 at most in a curve."""
    braking: float = 0.8
    """m/s^2 with which the end of the known line is approached."""
    raising: float = 0.8
    """m/s^2 at most when speed is gained."""
    margin: float = 0.02
    """m before the end of the known line at which to stand."""

    def speed(self, asked: float, curvature: float, ahead: float) -> float:
        """m/s for a curvature (1/m) with the line known for `ahead` m."""
        in_curve = math.sqrt(self.sideways / max(abs(curvature), 1e-3))
        at_end = math.sqrt(2.0 * self.braking * max(0.0, ahead - self.margin))
        return min(asked, in_curve, at_end)

    def towards(self, present: float, wanted: float, dt: float) -> float:
        """The next set speed (m/s) on the way from the present one to the wanted one."""
        up, down = self.raising * dt, 1.6 * self.braking * dt
        return min(max(wanted, present - down), present + up)
