"""The ball's world with a cup that the test moves: catches, misses, edges, the light barrier."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial

import pytest
from msgspec.structs import replace

from petrobot.services.comm.lockstep.party import TICK
from petrobot.sim.catching.ball import BallState, TableMotion, fly
from petrobot.sim.catching.puma_model import Frame3
from petrobot.sim.catching.site import Site
from petrobot.sim.catching.thrower import Throw, ThrowCourse, ThrowOutcome, draw_throw
from petrobot.sim.catching.world import BallWorld, Where

AWAY = Frame3((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (-0.5, 0.0, 0.3))


def leaned(angle: float, origin: tuple[float, float, float]) -> Frame3:
    """Return a cup whose mouth is tilted by `angle` (rad) towards the table."""
    c, s = math.cos(angle), math.sin(angle)
    return Frame3((c, 0.0, -s), (0.0, 1.0, 0.0), (s, 0.0, c), origin)


class WorldByHand:
    """A world stepped by hand."""

    def __init__(self, site: Site, regime: str, physics: str) -> None:
        self.site, self.truth, self.physics = site, site.truth(regime), physics
        self.world = BallWorld(site.cell, self.truth, physics)
        self.tick = 0

    @property
    def now(self) -> float:
        return self.tick * TICK

    def throw(self, n: int, **changes: object) -> ThrowCourse:
        thrown = draw_throw(5, n, self.site.cell, self.truth)
        return self.world.release(self.now, replace(thrown, **changes))

    def where_it_will_be(self, throw: Throw, fall: float) -> tuple[float, BallState]:
        """Return the time after release (s) and the ball's state when it is this far (m) below the
        table."""
        motion = TableMotion(self.world.model, throw.start, throw.rolling_resistance)
        leaves = motion.first_crossing(0, self.truth.table.near_edge)
        took = math.sqrt(2.0 * fall / 9.81)
        return leaves + took, fly(motion.state(leaves), took, 9.81)

    def step(self, cup: Frame3) -> None:
        world = self.world
        world.begin(self.now, lambda: cup)
        for k in range(1, 5):
            if world.fine:
                world.fine_step(self.now + 0.001 * k, cup)
        self.tick += 1
        world.end(self.now, lambda: cup)

    def run(self, cup: Frame3, until: Callable[[], bool], at_most: float = 12.0) -> None:
        for _ in range(round(at_most / TICK)):
            if until():
                return
            self.step(cup)
        assert until()

    def hold_under(self, course: ThrowCourse, aside: float = 0.0, lean: float = 0.5) -> Frame3:
        """Return the cup where the ball arrives, offset by `aside` (m) along y and tilted by a
        fraction of the ball's slope."""
        _, state = self.where_it_will_be(course.throw, 0.10)
        (x, y, z), (vx, _, vz) = state.position, state.velocity
        return leaned(lean * math.atan2(-vx, -vz), (x, y + aside, z))


def _left(course: ThrowCourse) -> bool:
    return course.exit_state is not None


def _free(world: BallWorld) -> bool:
    return not world.barrier


@pytest.fixture
def hand(site: Site, physics: str) -> Iterator[Callable[[str], WorldByHand]]:
    hands: list[WorldByHand] = []

    def make(regime: str) -> WorldByHand:
        hands.append(WorldByHand(site, regime, physics))
        return hands[-1]

    yield make
    for one in hands:
        one.world.close()


@pytest.mark.parametrize("regime", "ABC")
def test_a_cup_in_the_right_place_catches_every_ball(
    hand: Callable[[str], WorldByHand], regime: str
) -> None:
    here = hand(regime)
    for n in range(1, 13):
        course = here.throw(n)
        cup = here.hold_under(course)
        due = here.now + here.where_it_will_be(course.throw, 0.10)[0]
        here.run(cup, lambda: here.world.where is Where.AT_REST)
        assert course.outcome is ThrowOutcome.CAUGHT and course.miss < 0.002
        assert course.released_at + course.caught_at == pytest.approx(due + 0.1, abs=0.05)
        assert here.world.barrier
        here.world.take_away(here.now)
        here.run(AWAY, lambda: not here.world.barrier)


@pytest.mark.parametrize("aside", [0.07, -0.12])
def test_a_miss_is_measured_in_the_plane_of_the_mouth(
    hand: Callable[[str], WorldByHand], aside: float
) -> None:
    here = hand("A")
    course = here.throw(3)
    cup = here.hold_under(course, aside)
    here.run(cup, lambda: here.world.course is None)
    assert course.outcome is ThrowOutcome.MISSED and course.miss == pytest.approx(
        abs(aside), abs=0.002
    )
    assert course.ended_at < 12.0 and here.world.ball is None


def test_the_exit_is_recorded_exactly_also_with_the_cup_at_the_edge(
    hand: Callable[[str], WorldByHand],
) -> None:
    here = hand("C")
    for n, fall in ((1, 0.10), (2, 0.005)):
        course = here.throw(n)
        motion = TableMotion(here.world.model, course.throw.start, course.throw.rolling_resistance)
        leaves = motion.first_crossing(0, here.truth.table.near_edge)
        _, state = here.where_it_will_be(course.throw, fall)
        here.run(leaned(0.9, state.position), partial(_left, course))
        assert course.exit_time == pytest.approx(leaves, abs=1e-4)
        assert course.exit_state is not None
        assert course.exit_state.position[1] == pytest.approx(course.throw.exit_y, abs=1e-4)
        here.run(AWAY, lambda: here.world.course is None)


@pytest.mark.parametrize(("restitution", "least", "most"), [(0.3, 1.0, 1.0), (0.8, 0.0, 0.4)])
def test_restitution_decides_whether_fast_balls_stay_in(
    hand: Callable[[str], WorldByHand], restitution: float, least: float, most: float
) -> None:
    here = hand("C")
    here.world.close()
    here.world = BallWorld(
        here.site.cell,
        replace(here.truth, cup=replace(here.truth.cup, restitution=restitution)),
        here.physics,
    )
    outcomes = []
    for n in range(1, 16):
        course = here.throw(n)
        cup = here.hold_under(course)
        here.run(cup, lambda: here.world.course is None or here.world.where is Where.AT_REST)
        outcomes.append(course.outcome)
        if here.world.course is not None:
            here.world.take_away(here.now)
        here.run(AWAY, lambda: not here.world.barrier)
    assert least <= outcomes.count(ThrowOutcome.CAUGHT) / len(outcomes) <= most


def test_a_ball_that_is_jerked_out_of_the_cup_counts_as_dropped(
    hand: Callable[[str], WorldByHand],
) -> None:
    here = hand("A")
    course = here.throw(2)
    cup = here.hold_under(course, lean=0.0)
    here.run(cup, lambda: here.world.where is Where.AT_REST)
    assert math.isfinite(course.caught_at)
    x, y, z = cup.origin
    for k in range(1, 16):  # up at 2.5 m/s, then sideways from under the ball
        here.step(cup._replace(origin=(x, y, z + 0.010 * k)))
    here.run(cup._replace(origin=(x, y + 0.3, z)), lambda: here.world.course is None)
    assert course.outcome is ThrowOutcome.DROPPED


def test_a_ball_emptied_onto_the_floor_still_counts_as_caught(
    hand: Callable[[str], WorldByHand],
) -> None:
    here = hand("A")
    course = here.throw(2)
    cup = here.hold_under(course)
    here.run(cup, lambda: here.world.where is Where.AT_REST)
    for k in range(1, 101):  # turned over within 0.4 s
        here.step(leaned(math.pi * k / 100, cup.origin))
    here.run(leaned(math.pi, cup.origin), lambda: here.world.course is None, 2.0)
    here.run(leaned(math.pi, cup.origin), lambda: not here.world.barrier, 1.0)
    assert course.outcome is ThrowOutcome.CAUGHT


def test_the_barrier_waits_its_delay(hand: Callable[[str], WorldByHand]) -> None:
    here = hand("B")
    course = here.throw(1)
    cup = here.hold_under(course)
    came = here.now + here.where_it_will_be(course.throw, 0.10)[0]
    here.run(cup, lambda: here.world.barrier)
    assert 0.098 < here.now - came < 0.125


def test_a_slow_ball_tips_over_the_edge_and_falls_near_it(
    hand: Callable[[str], WorldByHand],
) -> None:
    here = hand("A")
    slow = BallState(
        (0.8, 0.0, here.truth.table.top + 0.02),
        (-0.25, 0.0, 0.0),
        here.world.model.spin_of_rolling(-0.25, 0.0),
    )
    course = here.throw(1, start=slow, rolling_resistance=0.006)
    lowest: list[tuple[float, float, float]] = []

    def gone() -> bool:
        if here.world.ball is not None:
            lowest.append(here.world.ball.position)
        return here.world.course is None

    here.run(AWAY, gone)
    assert course.exit_state is not None and course.outcome is ThrowOutcome.MISSED
    assert here.truth.table.near_edge - 0.25 < lowest[-1][0] < here.truth.table.near_edge - 0.02


@pytest.mark.parametrize(("velocity", "exits"), [((-0.1, 0.0), False), ((-0.4, 0.9), False)])
def test_a_ball_that_stops_or_leaves_sideways_is_missed_and_removed(
    hand: Callable[[str], WorldByHand], velocity: tuple[float, float], exits: bool
) -> None:
    here = hand("A")
    spin = here.world.model.spin_of_rolling(*velocity)
    start = BallState((1.5, 0.0, here.truth.table.top + 0.02), (*velocity, 0.0), spin)
    course = here.throw(1, start=start, rolling_resistance=0.006)
    here.run(AWAY, lambda: here.world.course is None)
    assert course.outcome is ThrowOutcome.MISSED and (course.exit_state is not None) is exits


def test_one_ball_at_a_time(hand: Callable[[str], WorldByHand]) -> None:
    here = hand("A")
    here.throw(1)
    with pytest.raises(RuntimeError, match="one at a time"):
        here.throw(2)


def test_two_worlds_evolve_equally_to_the_bit(hand: Callable[[str], WorldByHand]) -> None:
    traces = []
    for _ in range(2):
        here, trace = hand("B"), []
        for n in (1, 2, 3):
            course = here.throw(n)
            cup = here.hold_under(course, 0.03)
            for _ in range(700):
                here.step(cup)
                trace.append(here.world.ball)
            if here.world.course is not None:
                here.world.take_away(here.now)
            here.run(AWAY, partial(_free, here.world))
        traces.append(trace)
    assert traces[0] == traces[1]
