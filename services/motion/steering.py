"""Steering: from a goal to commanded positions, within the limits, past the collision guard, and
around obstacles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from petrobot.services.motion.limits import CollisionGuard
from petrobot.services.motion.model import Vector
from petrobot.services.motion.trajectory import Six, Trajectory, synchronised

CREEP: Final = 0.1
"""Share of the greatest speeds at which the arm leaves a pose that it should not be in."""
CLOSER: Final = 0.4
"""Share of the guard's margins that is kept on a detour."""
LOOK: Final = 3
"""Cycles on a detour between two checks of the straight path."""

Retreat = Callable[[Sequence[float]], tuple[float, ...] | None]
"""Function that returns the pose with the same cup orientation but further from the table; None if
that pose is not clear."""


class Steering:
    """Moves a trajectory to goals. Angles in rad, speeds in rad/s.

    `move` goes straight in joint space, all joints arriving together; `chase` goes as fast as each
    joint can. Both take a detour over another pose where the straight path is not clear.
    """

    def __init__(
        self,
        guard: CollisionGuard,
        retreat: Retreat,
        home: Sequence[float],
        period: float,
        acceleration: Vector,
    ) -> None:
        """`acceleration` (rad/s^2, (6,)) are the greatest of the joints; `limit` sets the
        speeds."""
        self._guard = guard
        self._close_guard = guard.closer(CLOSER)
        self._last_guard = guard.barely()
        self._retreat = retreat
        self._home = tuple(home)
        self._acceleration = acceleration
        self._speed = np.ones_like(acceleration)
        self.trajectory = Trajectory(home, period, self._speed.tolist(), acceleration.tolist())
        self.goal: tuple[float, ...] | None = None
        self.refused = ""
        """Why the last step was refused; empty if it was not."""
        self._via: tuple[float, ...] | None = None
        self._given_up = 0
        self._creeps = False
        self._together = False
        self._share = 1.0
        self._cycles = 0

    def limit(self, speed: Sequence[float]) -> None:
        """Set the greatest joint speeds from now on."""
        self._speed = np.array(speed)
        self._choose_limits()

    def move(self, goal: Sequence[float], share: float = 1.0) -> None:
        """Go to a joint pose at a share of the greatest speeds. Raises ValueError if the pose is
        not clear."""
        why = self._guard.violation(goal)
        if why:
            raise ValueError(f"pose refused: {why}")
        self._share, self._together, self._via, self.goal = share, True, None, tuple(goal)
        self._choose_limits()

    def chase(self, goal: Sequence[float]) -> None:
        """Go to a joint pose as fast as possible; may be called in any cycle with another pose."""
        if tuple(goal) == self.goal and not self._together:
            return
        self._share, self._together, self.goal = 1.0, False, tuple(goal)
        self._go_by(None if self._guard.path_clear(self._rest(), goal) else self._way_round(goal))

    def rest(self) -> None:
        """Brake at the limits and stay there."""
        self.goal, self._via = None, None

    def reset(self, q: Sequence[float]) -> None:
        """Stand still at `q`: the drives were off, or are."""
        self.rest()
        self.trajectory.reset(q)

    def cycle(self, braking: bool = False) -> None:
        """Compute the next commanded position; with `braking` come to a standstill but keep the
        goal."""
        self._cycles += 1
        trajectory = self.trajectory
        if braking or self.goal is None:
            if not trajectory.still:
                trajectory.accept(*trajectory.braking())
            return
        if self._via is not None and self._cycles % LOOK == 0:
            self._look_again(self.goal)
        trajectory.aim(self.goal if self._via is None else self._via)
        if self._via is None and trajectory.arrived(0.0):
            return
        self.refused = self._guarded()
        if self.refused and self._via is None:
            self._go_by(self._way_round(self.goal))

    def _guarded(self) -> str:
        """Step past the guard whose margins the present braking path satisfies.

        On a detour that is the closer guard. An arm that was switched on where neither guard is
        satisfied leaves that pose creeping, and touches nothing; only where it touches already,
        every motion away is allowed.
        """
        trajectory = self.trajectory
        if self._via is None and not self._creeps and self._guard.stops_clear(trajectory):
            return self._guard.advance(trajectory)
        if self._close_guard.stops_clear(trajectory):
            if self._creeps:
                self._creeps = False
                self._choose_limits()
            return self._close_guard.advance(trajectory)
        self._creeps = True
        trajectory.limit((CREEP * self._speed).tolist(), self._acceleration.tolist())
        if self._last_guard.stops_clear(trajectory):
            return self._last_guard.advance(trajectory)
        trajectory.accept(*trajectory.proposed())
        return ""

    def _look_again(self, goal: Sequence[float]) -> None:
        """Leave the detour if the straight path is clear; try another detour where this one has
        ended or was refused."""
        if self._guard.path_clear(self._rest(), goal):
            self._given_up = 0
            self._go_by(None)
        elif self.trajectory.still:
            self._given_up += 1
            self._go_by(self._way_round(goal))

    @property
    def arrived(self) -> bool:
        """Whether the commanded motion rests on its goal."""
        trajectory = self.trajectory
        return (
            self.goal is not None
            and trajectory.still
            and tuple(trajectory.target or ()) == self.goal
            and trajectory.arrived()
        )

    def _rest(self) -> Six:
        return self.trajectory.resting(self.trajectory.q, self.trajectory.qd)

    def _go_by(self, via: tuple[float, ...] | None) -> None:
        self._via = via
        self._choose_limits()

    def _choose_limits(self) -> None:
        """Choose speeds and accelerations for the present goal.

        On a move or a detour all joints finish together, so that the path is straight. A joint that
        is moving already keeps its full acceleration, so that it can turn around in time.
        """
        speed, acceleration = (
            self._speed * self._share,
            self._acceleration * (self._share if self._together else 1.0),
        )
        end = self._via or self.goal
        if end is not None and (self._together or self._via is not None):
            speed, gentle = synchronised(np.subtract(end, self._rest()), speed, acceleration)
            acceleration = gentle if self.trajectory.still else acceleration
        self.trajectory.limit(speed.tolist(), acceleration.tolist())

    def _way_round(self, goal: Sequence[float]) -> tuple[float, ...]:
        """Return where to go first when the straight path is not clear: in front of the goal, back
        from the table, or home.

        Poses that were given up before come last.
        """
        rest = self._rest()
        ways = [
            way for way in (self._retreat(goal), self._retreat(rest), self._home) if way is not None
        ]
        turn = self._given_up % len(ways)
        ways = ways[turn:] + ways[:turn]
        return next((way for way in ways if self._close_guard.path_clear(rest, way)), ways[0])
