"""Effects of fingers on parts: hold, push, turn, let slip, drop. All follow from physics; only
where a part falls is random."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings, strategies as st

from petrobot.sim.picking.parts import Part, contact, rectangle
from tests.sim.picking.bench import ABOVE, DOWN, FINGERS, Crane, cube, puck

NEAR = st.floats(-0.012, 0.012)


@pytest.mark.parametrize(
    ("part", "held"),
    [
        (cube(), True),
        (puck(), True),
        (cube(y=0.004), True),
        (puck(y=0.004), True),
        (cube(y=0.03), False),  # beside the fingers
        (puck(y=0.018, diameter=0.03), False),  # only its edge: squeezed out sideways
        (cube(turn=0.2), True),  # turned straight by closing
    ],
    ids=["cube", "puck", "aside", "puck aside", "beside", "edge", "turned"],
)
def test_a_part_is_held_if_it_lies_between_the_fingers(part: Part, held: bool) -> None:
    assert Crane(part).pick() is held


def test_fingers_that_do_not_close_far_enough_hold_nothing() -> None:
    assert not Crane(cube()).pick(closing=0.021)
    assert Crane(cube()).pick(closing=0.018)


def test_fingers_over_a_part_that_is_too_low_hold_nothing() -> None:
    part = cube()
    part.height = 0.005
    assert not Crane(part).pick()


def test_a_part_held_at_its_corners_is_held_weakly() -> None:
    firm, weak = Crane(cube()), Crane(cube(turn=math.pi / 4))
    assert firm.pick() and weak.pick()
    assert firm.world.held is not None and weak.world.held is not None
    assert firm.world.held.firmness == 1.0
    assert weak.world.held.firmness < 0.2
    assert weak.world.gap == pytest.approx(0.02 * math.sqrt(2.0), abs=1e-3)


@settings(max_examples=30, deadline=None)
@given(force=st.floats(0.2, 6.0), mass=st.floats(0.02, 0.3), friction=st.floats(0.05, 0.8))
def test_slow_lifting_succeeds_exactly_if_friction_carries_the_weight(
    force: float, mass: float, friction: float
) -> None:
    crane = Crane(cube(mass=mass, friction=friction))
    crane.force = force
    share = 2.0 * friction * force / (mass * 9.81)
    held = crane.pick()
    if share > 1.2:
        assert held
    if share < 0.95:
        assert not held and crane.world.parts[0].z == 0.0


def test_a_part_slips_when_it_is_moved_too_fast() -> None:
    force = 0.02 * 9.81 / (2.0 * 0.4) * 1.3
    slow, fast = Crane(cube()), Crane(cube())
    for crane, seconds in ((slow, 1.0), (fast, 0.15)):
        crane.force = force
        assert crane.pick()
        crane.go(0.15, 0.0, ABOVE, seconds)
    assert slow.world.held is not None and slow.world.counts["slips"] == 0
    assert fast.world.held is None and fast.world.counts["slips"] == 1


def test_a_part_that_is_let_go_low_stands_where_it_was_held() -> None:
    crane = Crane(cube())
    assert crane.pick()
    crane.go(0.1, 0.05, ABOVE)
    crane.go(0.1, 0.05, DOWN)
    crane.set_gap(0.06)
    part = crane.world.parts[0]
    assert math.hypot(part.x - 0.1, part.y - 0.05) < 1e-3 and part.z == 0.0
    assert crane.world.counts["drops"] == 0


def test_a_part_that_is_dropped_comes_to_lie_elsewhere() -> None:
    crane = Crane(cube())
    assert crane.pick()
    crane.set_gap(0.06)
    part = crane.world.parts[0]
    assert part.z == 0.0 and 0.002 < math.hypot(part.x, part.y) < 0.02
    assert crane.world.counts["drops"] == 1


def test_a_part_that_leaves_the_table_is_lost() -> None:
    crane = Crane(cube())
    assert crane.pick()
    crane.go(0.3, 0.0, ABOVE)
    crane.set_gap(0.06)
    assert crane.world.parts[0].lost


def test_a_neighbour_in_the_way_is_pushed_aside() -> None:
    beside = puck(x=FINGERS.opening / 2 + FINGERS.thickness + 0.006)
    crane = Crane(cube(), beside)
    assert crane.pick()
    assert beside.x > FINGERS.opening / 2 + FINGERS.thickness + 0.012 - 1e-6


@given(x=NEAR, y=NEAR, turn=st.floats(-3.0, 3.0))
def test_a_push_ends_the_contact_and_moves_the_point_as_far_as_it_was_deep(
    x: float, y: float, turn: float
) -> None:
    part = cube(x, y, turn)
    body = rectangle(0.0, 0.0, 0.0, 0.01, 0.01)
    found = contact(body, part.outline())
    if found is None:
        return
    before = [found.point[0] - part.x, found.point[1] - part.y]
    turned = part.turn
    part.push(found.normal, found.depth, found.point)
    c, s = math.cos(part.turn - turned), math.sin(part.turn - turned)
    after = part.x + c * before[0] - s * before[1], part.y + s * before[0] + c * before[1]
    moved = sum((a - b) * n for a, b, n in zip(after, found.point, found.normal, strict=True))
    assert moved == pytest.approx(found.depth, abs=0.25 * found.depth + 1e-6)


@settings(max_examples=8, deadline=None)
@given(x=st.floats(-0.03, 0.03), y=st.floats(-0.03, 0.03), turn=st.floats(-3.0, 3.0))
def test_parts_never_end_up_inside_fingers_or_each_other(x: float, y: float, turn: float) -> None:
    first, second = cube(x, y, turn), puck(x + 0.03, y)
    crane = Crane(first, second)
    crane.pick()
    found = contact(first.outline(), second.outline())
    assert found is None or found.depth < 5e-4 or crane.world.held is not None
    assert 0.0 <= first.z <= ABOVE and not first.lost


def test_the_same_seed_gives_the_same_fall() -> None:
    falls = []
    for _ in range(2):
        crane = Crane(puck())
        crane.pick()
        crane.set_gap(0.06)
        falls.append((crane.world.parts[0].x, crane.world.parts[0].y))
    assert falls[0] == falls[1]
