"""The ball's world: table, flight, cup and floor, each computed with the coarsest step that is
exact there.

On the flat table and in free flight the ball follows closed forms (sim/catching/ball.py), one
evaluation per tick. Only where it may touch the cup, an edge or anything else from above do the
contacts (sim/catching/physics.py) take over at 1 kHz; a ball that lies still in a standing cup
costs nothing. The light barrier and the closest approach to the cup are also computed here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from enum import StrEnum
from typing import Any

from petrobot.services.comm.lockstep.party import TICK
from petrobot.sim.catching.ball import BallModel, BallState, TableMotion, UnevenMotion, fly
from petrobot.sim.catching.physics import ball_contact, choose
from petrobot.sim.catching.puma_model import Frame3
from petrobot.sim.catching.thrower import LightBarrier, Throw, ThrowCourse, ThrowOutcome
from petrobot.sim.catching.truth import Truth

_HAND_SPEED = 3.0
"""A speed faster than the arm can carry the cup (m/s)."""
_AHEAD = 0.005
"""A little more than a tick (s): surfaces that can meet within it are near."""
_GAIN = 1.0
"""More speed than a falling ball gains until it must be checked again (m/s)."""
_SETTLED = 0.05
"""How long a ball lies still in an almost standing cup until it counts as at rest (s)."""
_CREEP = 0.005
"""Speed up to which a cup almost stands (m/s, tenths of rad/s): an arm that settles."""
_STIRRED, _TILTED = 1e-4, 2e-4
"""How far a cup must move until its ball no longer counts as at rest in it (m, rad)."""
_FLAT_SPEED = 0.02
"""Vertical speed below which a ball on the table has stopped bouncing (m/s)."""


CupPose = Callable[[], Frame3]


class Where(StrEnum):
    """What moves the ball."""

    ABSENT = "absent"
    TABLE = "table"
    FLIGHT = "flight"
    CONTACT = "contact"
    AT_REST = "at rest"
    """Lying still in the cup."""


class BallWorld:
    """One ball at most: where it is and what happened to it. Times `now` are simulated seconds.

    Each tick: `begin`; while `fine` holds, `fine_step` once per 1 ms with the cup's pose at the end
    of that millisecond; then `end`. `begin` and `end` ask for the cup's pose only when the ball may
    be near it: a pose costs more than they do. The same object means the same pose.
    """

    def __init__(self, cell: Mapping[str, Any], truth: Truth, physics: str = "") -> None:
        """`physics`: as for `physics.choose`."""
        settings = truth.settings
        self._truth = truth
        self.model = BallModel.of(cell["ball"], settings["ball"]["friction"])
        self._settings = settings
        self._cup_wall = float(cell["cup"]["wall"])
        self._space = ball_contact(
            choose(physics), self.model, truth.table, truth.cup, self._cup_wall, settings
        )
        self._barrier = LightBarrier(float(settings["cup"]["barrier_delay"]))
        self.where = Where.ABSENT
        self.ball: BallState | None = None
        self.course: ThrowCourse | None = None
        self._cup: Frame3 | None = None
        self._look_at = -math.inf
        self._rest: tuple[Frame3, tuple[float, float, float]] | None = None
        self._height = self._aside = math.inf
        self._last = (0.0, 0.0)
        self._start_at = 0.0
        self._start: BallState | None = None
        self._motion: TableMotion | UnevenMotion | None = None
        self._leaves = (math.inf, 0)
        """Seconds after `_start_at` when the ball rolls over an edge, and 0 if that is the near
        one."""
        self._still_since: float | None = None

    # Queries of the laboratory

    @property
    def barrier(self) -> bool:
        """Output of the light barrier in the cup."""
        return self._barrier.output

    @property
    def fine(self) -> bool:
        """Whether this tick needs fine steps."""
        return self.where is Where.CONTACT

    @property
    def fine_dt(self) -> float:
        """Length of a fine step (s)."""
        return self._space.dt

    def release(self, now: float, throw: Throw) -> ThrowCourse:
        """Put a ball into the world. Raises RuntimeError while another one is there."""
        if self.ball is not None:
            raise RuntimeError("a ball is in play: one at a time")
        self.ball = throw.start
        self.course = ThrowCourse(throw, now)
        self._height = self._aside = math.inf
        self._last = (throw.start.position[0], now)
        self._roll(now, throw.start)
        return self.course

    def take_away(self, now: float) -> None:
        """Take the ball out of play."""
        if self.course is not None and self.course.outcome is ThrowOutcome.ROLLING:
            self.course.outcome = ThrowOutcome.MISSED
        if self.course is not None:
            self.course.ended_at = now - self.course.released_at
        self.where, self.ball, self.course = Where.ABSENT, None, None
        self._barrier.see(now, False)

    # One tick

    def begin(self, now: float, cup: CupPose) -> None:
        """Start a tick at `now`; `cup` returns the cup's frame (origin: mouth centre, z out of the
        mouth)."""
        ball = self.ball
        if ball is None:
            return
        if self.where is Where.AT_REST:
            self._ride(cup())
        elif self.where is Where.CONTACT:
            self._cup = cup()
            if self._gap(ball, self._cup) > self._way_within_tick(ball):
                self._leave_contact(now, ball)
        elif self.where is Where.FLIGHT and self._near_table(ball):
            self._cup = cup()
            self._touch(ball)
        elif now >= self._look_at:
            self._look(now, ball, cup())

    def _look(self, now: float, ball: BallState, cup: Frame3) -> None:
        """Enter the contact space if ball and cup may touch within the tick; else note when to
        check again."""
        self._cup = cup
        spare = self._gap(ball, cup) - self._way_within_tick(ball)
        if spare <= 0.0:
            self._touch(ball)
        else:
            self._look_at = now + spare / (_norm(ball.velocity) + _GAIN + _HAND_SPEED)

    def _ride(self, cup: Frame3) -> None:
        """Carry a ball at rest with its cup until the cup really moves."""
        if self._rest is None or self.ball is None or cup is self._cup:
            return
        (before, local), last = self._rest, self.ball.position
        position = cup.point(local)
        self._cup = cup
        self.ball = BallState(position, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        if _distance(before.origin, cup.origin) > _STIRRED or _distance(before.z, cup.z) > _TILTED:
            x, y, z = ((b - a) / TICK for a, b in zip(last, position, strict=True))
            self._touch(BallState(position, (x, y, z), (0.0, 0.0, 0.0)))

    def fine_step(self, now: float, cup: Frame3) -> None:
        """Run a fine step that ends at `now` with the cup at `cup`."""
        before = self._cup or cup
        self._cup = cup
        if self.where is not Where.CONTACT:
            return
        self.ball = self._space.step(before, cup)
        self._watch(now, self.ball, cup)
        self._settle(now, self.ball, before, cup)
        self._end_of_course(now, self.ball)

    def idle(self, now: float) -> None:
        """Run a tick up to `now` without a ball; the cup need not be known."""
        self._barrier.see(now, False)

    def end(self, now: float, cup: CupPose) -> None:
        """End a tick at `now`: evaluate the closed forms at this time."""
        course = self.course
        if self.ball is None or course is None:
            self.idle(now)
            return
        if self.where is Where.TABLE:
            self._go_on_table(now)
        elif self.where is Where.FLIGHT and self._start is not None:
            self.ball = fly(self._start, now - self._start_at, self.model.gravity)
        if self.where is Where.AT_REST:
            self._barrier.see(now, True)
        elif self.where is not Where.CONTACT:
            if now >= self._look_at or course.exit_state is not None:
                self._watch(now, self.ball, cup())
            else:  # Too far from the cup to matter.
                self._barrier.see(now, False)
                self._height = math.inf
        self._end_of_course(now, self.ball)

    # Changes of regime

    def _roll(self, now: float, start: BallState) -> None:
        resistance = self.course.throw.rolling_resistance if self.course else 0.0
        self._motion = motion = motion_on_table(self.model, start, resistance, self._truth)
        table = self._truth.table
        self._leaves = min(
            (motion.first_crossing(0, table.near_edge), 0),
            (motion.first_crossing(0, table.far_edge), 1),
            (motion.first_crossing(1, table.half_width), 1),
            (motion.first_crossing(1, -table.half_width), 1),
        )
        self._start_at, self._look_at, self.where = now, -math.inf, Where.TABLE

    def _soar(self, now: float, start: BallState) -> None:
        self._start, self._start_at, self._look_at, self.where = start, now, -math.inf, Where.FLIGHT

    def _touch(self, ball: BallState) -> None:
        self._space.put_ball(ball)
        self._still_since = None
        self.where = Where.CONTACT

    def _leave_contact(self, now: float, ball: BallState) -> None:
        """Return to the closed forms, with the cup far away, if the ball rolls flat on the table or
        flies clear of it."""
        height = ball.position[2] - self._truth.table.top - self.model.radius
        if self._over_table(ball) and abs(height) < 1e-3 and abs(ball.velocity[2]) < _FLAT_SPEED:
            x, y, _ = ball.position
            vx, vy, _ = ball.velocity
            self._roll(
                now,
                BallState(
                    (x, y, self._truth.table.top + self.model.radius), (vx, vy, 0.0), ball.spin
                ),
            )
        elif not self._near_table(ball):
            self._soar(now, ball)

    def _go_on_table(self, now: float) -> None:
        """Roll on. Where the centre crosses an edge, the ball flies from there, or tips over the
        edge when it is too slow to fly."""
        motion = self._motion
        if motion is None:
            return
        leaves, edge = self._leaves
        elapsed = now - self._start_at
        if elapsed < leaves:
            self.ball = motion.state(elapsed)
            return
        state = motion.state(leaves)
        if edge == 0 and self.course is not None:
            self.course.exit_time = self._start_at + leaves - self.course.released_at
            self.course.exit_state = state
        if _clears_edge(state, self.model):
            self._soar(self._start_at + leaves, state)
            self.ball = fly(state, elapsed - leaves, self.model.gravity)
        else:
            self.ball = motion.state(elapsed)
            self._touch(self.ball)

    def _settle(self, now: float, ball: BallState, before: Frame3, cup: Frame3) -> None:
        """Put a ball at rest that lies still in an almost standing cup."""
        still = _norm(ball.velocity) < self._settings["ball"]["rest_speed"] and self._inside(
            ball, cup
        )
        if still and before is not cup:
            creep = _CREEP * self.fine_dt
            still = (
                _distance(before.origin, cup.origin) < creep
                and _distance(before.z, cup.z) < 10.0 * creep
            )
        if not still:
            self._still_since = None
        elif self._still_since is None:
            self._still_since = now
        elif now - self._still_since >= _SETTLED:
            self.where = Where.AT_REST
            self._rest = cup, cup.local(ball.position)
            self.ball = BallState(ball.position, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

    # Observations

    def _watch(self, now: float, ball: BallState, cup: Frame3) -> None:
        """Update light barrier, crossing of the mouth's plane and closest approach."""
        course = self.course
        if course is None:
            return
        height, aside = _seen_from(cup, ball)
        interrupted = -self._truth.cup.depth < height < 0.0 and aside < self._truth.cup.radius
        self._barrier.see(now, interrupted)
        self._note_exit(now, ball, course)
        if course.outcome is ThrowOutcome.ROLLING:
            course.approach = min(course.approach, math.hypot(height, aside))
            if math.inf > self._height > 0.0 >= height and course.exit_state is not None:
                share = self._height / (self._height - height)
                course.crossing = min(course.crossing, self._aside + share * (aside - self._aside))
            if self._barrier.output:
                course.outcome = ThrowOutcome.CAUGHT
                course.caught_at = now - course.released_at
        elif course.outcome is ThrowOutcome.CAUGHT and not self._barrier.output and cup.z[2] > 0.5:
            course.outcome = ThrowOutcome.DROPPED
        self._height, self._aside = height, aside

    def _note_exit(self, now: float, ball: BallState, course: ThrowCourse) -> None:
        """Note that the ball went over the near edge while the contact space moved it."""
        x, edge = ball.position[0], self._truth.table.near_edge
        if course.exit_state is None and x < edge:
            (before, at), (vx, _, _) = self._last, ball.velocity
            back = (x - edge) / vx if vx < 0.0 and before >= edge else now - at
            course.exit_time = now - back - course.released_at
            course.exit_state = fly(ball, -back, 0.0)
        self._last = (x, now)

    def _end_of_course(self, now: float, ball: BallState) -> None:
        """End the throw when the ball reaches the floor, lies still outside the cup, or takes too
        long."""
        course, rules = self.course, self._settings["ball"]
        if course is None:
            return
        age = now - course.released_at
        rests = (
            self.where is Where.TABLE and self._motion is not None and _norm(ball.velocity) == 0.0
        )
        lies = rests and now - self._start_at > self._motion_rests() + rules["removed_after"]
        stuck = (
            age > rules["lost_after"]
            and not self._barrier.output
            and self.where is not Where.AT_REST
        )
        if ball.position[2] < self.model.radius or lies or stuck:
            self.take_away(now)

    def _motion_rests(self) -> float:
        return self._motion.rests_after if self._motion is not None else math.inf

    # Geometry

    def _inside(self, ball: BallState, cup: Frame3) -> bool:
        height, aside = _seen_from(cup, ball)
        return -self._truth.cup.depth < height < 0.0 and aside < self._truth.cup.radius

    def _gap(self, ball: BallState, cup: Frame3) -> float:
        """Return the distance between the ball and the cup, here a solid cylinder (m)."""
        height, aside = _seen_from(cup, ball)
        half, wall = self._truth.cup.depth / 2.0, self._cup_wall
        beyond = max(abs(height + half) - half - wall, 0.0)
        return (
            math.hypot(beyond, max(aside - self._truth.cup.radius - wall, 0.0)) - self.model.radius
        )

    def _way_within_tick(self, ball: BallState) -> float:
        return _AHEAD * (_norm(ball.velocity) + _HAND_SPEED)

    def _over_table(self, ball: BallState) -> bool:
        x, y, _ = ball.position
        table = self._truth.table
        return table.near_edge < x < table.far_edge and abs(y) < table.half_width

    def _near_table(self, ball: BallState) -> bool:
        """Return whether the ball may touch the table within a tick. A ball beside it that moves
        away fast enough cannot."""
        table, r = self._truth.table, self.model.radius
        x, y, z = ball.position
        vx, vy, _ = ball.velocity
        gap_x, gap_y = max(table.near_edge - x, x - table.far_edge), abs(y) - table.half_width
        for gap, away in (
            (gap_x, -vx if x < table.near_edge else vx),
            (gap_y, math.copysign(vy, y * vy)),
        ):
            if gap >= 0.0 and away > 0.0 and away * away >= self.model.gravity * r:
                return False
        gap = math.hypot(max(gap_x, 0.0), max(gap_y, 0.0), max(z - table.top, 0.0))
        return gap < r + self._way_within_tick(ball)

    def close(self) -> None:
        """Release what the back end holds."""
        self._space.close()


class SecondBall:
    """A ball that rolls beside the one that counts: the camera sees it; it touches nothing but the
    table, and is gone once it has fallen below the cup."""

    def __init__(self, model: BallModel, throw: Throw, truth: Truth, released_at: float) -> None:
        self._released_at, self._gravity = released_at, model.gravity
        self._motion = motion_on_table(model, throw.start, throw.rolling_resistance, truth)
        table = truth.table
        self._leaves = min(
            self._motion.first_crossing(0, table.near_edge),
            self._motion.first_crossing(1, table.half_width),
            self._motion.first_crossing(1, -table.half_width),
        )

    def seen(
        self, now: float
    ) -> Sequence[tuple[tuple[float, float, float], tuple[float, float, float]]]:
        """Return its centre and velocity at `now` (s), if it is there."""
        t = now - self._released_at
        if not 0.0 <= t < self._leaves + _FALLS:
            return ()
        state = self._motion.state(min(t, self._leaves))
        if t > self._leaves:
            state = fly(state, t - self._leaves, self._gravity)
        return ((state.position, state.velocity),)


_FALLS = 0.25
"""Time in which a ball falls from the table to well below the cup (s)."""


def motion_on_table(
    model: BallModel, start: BallState, rolling_resistance: float, truth: Truth
) -> TableMotion | UnevenMotion:
    """Return a ball's motion on the table as it really is."""
    scatter = truth.scatter
    if scatter.flat:
        return TableMotion(model, start, rolling_resistance)
    (along, across), wave = scatter.table_slope, scatter.wave_slope
    number = 2.0 * math.pi / scatter.wave_length

    def slope(x: float, y: float) -> tuple[float, float]:
        return along + wave * math.sin(number * x), across + wave * math.sin(number * (y + 0.3 * x))

    return UnevenMotion(model, start, rolling_resistance, slope)


def _clears_edge(state: BallState, model: BallModel) -> bool:
    """Return whether a ball that crosses an edge at this speed flies off at once: v^2 >= g r, else
    it tips over the edge (the edge can no longer push when the centripetal force m v^2 / r exceeds
    the weight)."""
    vx, vy, _ = state.velocity
    return vx * vx + vy * vy >= model.gravity * model.radius


def _seen_from(cup: Frame3, ball: BallState) -> tuple[float, float]:
    """Return the height of the ball's centre above the mouth's plane and its distance from the
    cup's axis (m)."""
    (px, py, pz), (ox, oy, oz), (zx, zy, zz) = ball.position, cup.origin, cup.z
    rx, ry, rz = px - ox, py - oy, pz - oz
    height = rx * zx + ry * zy + rz * zz
    return height, math.sqrt(max(0.0, rx * rx + ry * ry + rz * rz - height * height))


def _distance(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
    return math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


def _norm(v: tuple[float, float, float]) -> float:
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
