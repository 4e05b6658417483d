"""Set points of joints that move together, within the limits that a device's table sets."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, Final

from petrobot.services.device import Driver, numbers

PART: Final = 0.02
"""Greatest change of a joint (rad or m) between two checked points of a way."""


class JointMotion:
    """Set points of joints along a way: all start and arrive together, within limits of speed and
    acceleration. Part of a cyclic driver, whose `speed`, `workspace` and `paused` it obeys.

    A command calls `begin`; each period calls `step` and sends `q`. Positions are in rad or m.
    """

    def __init__(
        self,
        driver: Driver,
        limits: Mapping[str, Sequence[float]],
        speed: float,
        acceleration: float,
        point: Callable[[Sequence[float]], Sequence[float]] | None = None,
    ) -> None:
        """`limits`: least and greatest position of each joint by name. `speed` (1/s) and
        `acceleration` (1/s^2): greatest ones of the joint that has the longest way. `point`: where
        the tool (x, y, z in m) is at given positions; without it there is no workspace. Raises
        ValueError."""
        if not (speed > 0.0 and acceleration > 0.0):
            raise ValueError(f"expected a speed and acceleration above 0: {speed}, {acceleration}")
        self.limits = limits
        self.q = [0.0] * len(limits)
        """The set point."""
        self.goal: list[float] | None = None
        """Where the way ends; None after `stop`."""
        self.paused = False
        """Brake on the way, and move on when it is False again, as while the driver is `paused`."""
        self._driver, self._point = driver, point
        self._speed, self._acceleration = speed, acceleration
        self._way: list[list[float]] = []
        self._far: list[float] = []
        """How far each position of the way lies along it."""
        self._at = self._rate = self._most = 0.0
        self._inside = True

    @property
    def moving(self) -> bool:
        """Whether the set point moves."""
        return bool(self._way) and not (self._rests and self._rate == 0.0)

    @property
    def _rests(self) -> bool:
        return self.paused or self._driver.paused

    @property
    def arrived(self) -> bool:
        """Whether the set point is at its goal."""
        return self.goal is not None and not self._way

    def reached(self, measured: Sequence[float], tolerance: float) -> bool:
        """Return whether the joints are at the goal, where they are measured."""
        return self.arrived and largest_change(measured, self.q) <= tolerance

    def begin(self, positions: Sequence[Any], share: Any = 1.0) -> None:
        """Begin to move from the set point through these positions, at this share of the speed.

        Raises ValueError if the last one is not a number within the limits of each joint, if the
        way leaves the workspace, for a wrong share, and while it is moving.
        """
        goal = numbers(positions[-1], len(self.q), "positions")
        for (name, (low, high)), at in zip(self.limits.items(), goal, strict=True):
            if not low <= at <= high:
                raise ValueError(f"{name}: expected {low:.3f} to {high:.3f}, found {at:.3f}")
        if not 0.0 < (part := numbers([share], 1, "speed")[0]) <= 1.0:
            raise ValueError(f"speed: expected a share above 0 and at most 1, found {share!r}")
        if self._rate > 0.0:
            raise ValueError("it is still moving: wait, or stop it first")
        way = [list(self.q), *(list(map(float, each)) for each in positions)]
        self._check(way)
        self._way, self._far = way, [0.0]
        for begin, end in pairwise(way):
            self._far.append(self._far[-1] + largest_change(begin, end))
        self._at, self.goal = 0.0, goal
        self._most = part * self._driver.speed * self._speed

    def _check(self, way: Sequence[Sequence[float]]) -> None:
        """Raise ValueError for a way that leaves the workspace."""
        if self._point is None or not self._driver.workspace.bounds:
            return
        for begin, end in pairwise(way):
            parts = math.ceil(largest_change(begin, end) / PART) or 1
            for part in range(1, parts + 1):
                at = self._point(_between(begin, end, part / parts))
                if outside := self._driver.workspace.outside(at):
                    raise ValueError(outside)

    def watch(self, measured: Sequence[float]) -> str:
        """Begin to stop when the tool leaves the workspace, where the joints are measured; return
        why in words, empty if it did not."""
        if self._point is None or not self._driver.workspace.bounds:
            return ""
        outside = self._driver.workspace.outside(self._point(measured))
        left, self._inside = bool(outside) and self._inside and bool(self._way), not outside
        if left:
            self.stop()
        return outside if left else ""

    def step(self) -> None:
        """Move the set point by one period."""
        if not self._way:
            return
        dt = float(self._driver.period or 0.0)
        left, change = self._far[-1] - self._at, self._acceleration * dt
        # The speed from which `periods` of braking, one change of speed each, end on the goal.
        periods = max(1, math.ceil(math.sqrt(0.25 + 2 * left / (change * dt)) - 0.5))
        braking = left / (periods * dt) + change * (periods - 1) / 2
        wish = 0.0 if self._rests or self.goal is None else min(self._most, braking)
        self._rate += min(change, max(-change, wish - self._rate))
        self._at += self._rate * dt
        if self.goal is None and self._rate <= 0.0:
            self.halt(self.q)
        elif self.goal is not None and self._far[-1] - self._at < 1e-9:
            self.q, self._way, self._rate = list(self.goal), [], 0.0
        else:
            n = next((n for n, far in enumerate(self._far) if far >= self._at), -1)
            span = self._far[n] - self._far[n - 1]
            share = min(1.0, (self._at - self._far[n - 1]) / span) if n and span else 1.0
            self.q = _between(self._way[n - 1], self._way[n], share) if n else list(self._way[0])

    def stop(self) -> None:
        """Brake on the way, and stay there."""
        self.goal = None
        if self._rate <= 0.0:
            self._way = []

    def halt(self, positions: Sequence[float]) -> None:
        """Be at these positions at once, without a way: where the joints are, for example."""
        self.q, self.goal, self._way, self._rate = list(positions), None, [], 0.0


def largest_change(begin: Sequence[float], end: Sequence[float]) -> float:
    """Return the way of the joint that moves most."""
    return max(abs(b - a) for a, b in zip(begin, end, strict=True))


def _between(begin: Sequence[float], end: Sequence[float], share: float) -> list[float]:
    return [a + share * (b - a) for a, b in zip(begin, end, strict=True)]
