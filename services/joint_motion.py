"""Set points of one axis, or of joints that move together, within the limits that a device's table
sets."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import pairwise
from typing import Any, Final

from petrobot.services.device import Driver, Ports, key, numbers, table

PART: Final = 0.02
"""Greatest change of a joint (rad or m) between two checked points of a way."""


class Axis(Driver):
    """A driver of one axis, which is simulated: it moves to a station or a position (m) within its
    limits of speed and acceleration, and obeys pauses and the keys `speed` and `workspace`.

    Derive a class from it, and override what the device does in addition. One with a motor writes
    `at` to it after `super().step(now)`; if it does not write in a dry run, add that to `obeys`.
    """

    period = 0.01
    obeys: Collection[str] = ("speed", "workspace", "pause")
    along = "x"
    """Direction of the axis in the workspace: x, y or z."""
    at: float = 0.0
    """Where it is (m); first at 0, or at the end next to it."""
    velocity: float = 0.0
    """How fast it moves (m/s)."""
    goal: float | None = None
    """Where it moves to (m); None after `stop`."""
    allowed: float = math.inf
    """No faster than this at present (m/s). `step` may set it, also to 0."""
    top_speed: float = key(0.5, "m/s", above=0)
    acceleration: float = key(4.0, "m/s^2", above=0)
    stations: dict[str, float] = key({}, "positions by name, m")
    ends: list[float] = key([], "least and greatest position, m; if empty, those of the stations")
    _share = 1.0

    def __init__(self, config: Mapping[str, Any], ports: Ports | None) -> None:
        super().__init__(config, ports)
        self._verify()  # `setup` may have set `at`

    def _verify(self) -> None:
        for name, at in self.stations.items():
            numbers([at], 1, f"stations.{name}")
        if not self.ends and not self.stations:
            raise ValueError("ends: is missing; give [least, greatest] position in m, or stations")
        low, high = self._ends()
        if low > high:
            raise ValueError(f"ends: expected [least, greatest] position, found {self.ends}")
        if beyond := [name for name, at in self.stations.items() if not low <= at <= high]:
            raise ValueError(f"stations: {', '.join(beyond)} lies beyond the ends {self.ends} m")
        if self.along not in ("x", "y", "z"):
            raise ValueError(f"along: expected x, y or z in the driver, found {self.along!r}")
        self.at = min(high, max(low, self.at))

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """`{"to": station or m}`, with `"speed"` if it shall be a share of the top speed."""
        self.move(**table(dict(body), "command", ("to",), ("speed",)))

    def move(self, to: str | float, speed: float = 1.0) -> None:
        """Begin to move to a station or a position (m). Raises ValueError if it is unknown, beyond
        an end, or outside the workspace."""
        if isinstance(to, str) and to not in self.stations:
            known = ", ".join(self.stations) or "its stations: it has none; give m"
            raise ValueError(f"to: {to!r} is none of {known}")
        goal = numbers([self.stations[to] if isinstance(to, str) else to], 1, "to")[0]
        low, high = self._ends()
        if not low <= goal <= high:
            raise ValueError(f"to: expected {low:g} to {high:g} m, found {goal:g}")
        if outside := self.workspace.outside([goal if a == self.along else 0.0 for a in "xyz"]):
            raise ValueError(f"to: {outside}")
        self.goal, self._share = goal, _share_of(speed)

    def _ends(self) -> list[float]:
        stations = self.stations.values()
        return numbers(self.ends or [min(stations), max(stations)], 2, "ends")

    def step(self, now: float) -> None:
        """Move by one period."""
        dt = float(self.period)
        change, wish = self.acceleration * dt, 0.0
        if self.goal is not None and not self.paused:
            most = self.speed * min(self.top_speed * self._share, max(0.0, self.allowed))
            left = self.goal - self.at
            wish = math.copysign(min(most, _braking(abs(left), change, dt)), left)
        self.velocity += min(change, max(-change, wish - self.velocity))
        self.at += self.velocity * dt
        there = self.goal is not None and abs(self.goal - self.at) < 1e-9
        if self.goal is not None and there and abs(self.velocity) <= change + 1e-9:
            self.at = self.goal  # the velocity is 0 from the next period on

    def state(self) -> Mapping[str, Any]:
        """Where it is (m), how fast (m/s), and whether it has arrived at the goal."""
        arrived = self.at == self.goal and self.velocity == 0.0
        return {"at": self.at, "velocity": self.velocity, "arrived": arrived}

    def stop(self, now: float) -> None:
        """Brake, and stay there."""
        self.goal = None

    def stopped(self) -> bool:
        """Whether it stands still, and is not about to move."""
        return self.velocity == 0.0 and (self.paused or self.goal in (None, self.at))


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
        part = _share_of(share)
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
        rests = self._rests or self.goal is None
        wish = 0.0 if rests else min(self._most, _braking(left, change, dt))
        self._rate += min(change, max(-change, wish - self._rate))
        self._at += self._rate * dt
        if self.goal is None and self._rate <= 0.0:
            self.halt(self.q)
        elif self.goal is not None and self._far[-1] - self._at < 1e-9:
            self.q, self._at = list(self.goal), self._far[-1]
            self._way = self._way if self._rate else []  # its rate is 0 from the next period on
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


def _share_of(speed: Any) -> float:
    share = numbers([speed], 1, "speed")[0]
    if not 0.0 < share <= 1.0:
        raise ValueError(f"speed: expected a share above 0 and at most 1, found {speed!r}")
    return share


def _braking(left: float, change: float, dt: float) -> float:
    """Return the speed from which braking, by one `change` of speed each period, ends on the
    goal, `left` m or rad ahead."""
    periods = max(1, math.ceil(math.sqrt(0.25 + 2 * left / (change * dt)) - 0.5))
    return left / (periods * dt) + change * (periods - 1) / 2


def largest_change(begin: Sequence[float], end: Sequence[float]) -> float:
    """Return the way of the joint that moves most."""
    return max(abs(b - a) for a, b in zip(begin, end, strict=True))


def _between(begin: Sequence[float], end: Sequence[float], share: float) -> list[float]:
    return [a + share * (b - a) for a, b in zip(begin, end, strict=True)]
