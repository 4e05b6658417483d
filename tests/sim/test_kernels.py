"""Kernels against the physical laws that they implement and, if numba is installed, compiled
against plain code: equal to the bit."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from petrobot.services.host import numba_kernels as compiled
from petrobot.services.host.numba_kernels import COMPILED, SWITCH, packed
from petrobot.sim.catching import arm_motion, site as cup_motion
from petrobot.sim.catching.arm_motion import (
    Matrix,
    Six,
    accelerated,
    held,
    held_packed,
    motor,
    motors,
    moved,
    stepped,
    stepped_packed,
)
from petrobot.sim.catching.puma_model import PumaModel
from petrobot.sim.catching.site import Triple, carried, numbers_of

ZERO: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
TALL: Six = (1e9, 1e9, 1e9, 1e9, 1e9, 1e9)


def sixes(low: float, high: float) -> st.SearchStrategy[Six]:
    return st.tuples(*[st.floats(low, high, allow_subnormal=False)] * 6)


def inverse_of(seed: int) -> Matrix:
    """Return the inverse of a mass matrix: symmetric, positive definite."""
    half = np.random.default_rng(seed).normal(size=(6, 6))
    matrix = np.linalg.inv(half @ half.T + 3.0 * np.eye(6))
    a, b, c, d, e, f = (tuple((0.5 * (matrix + matrix.T))[k].tolist()) for k in range(6))
    return a, b, c, d, e, f


def bits(*values: Any) -> list[bytes]:
    """Return the bytes of every number in nested tuples."""
    flat: list[bytes] = []
    for value in values:
        flat += bits(*value) if isinstance(value, tuple) else [struct.pack("<d", float(value))]
    return flat


@pytest.mark.parametrize(
    ("tau", "speed", "given_torque"),
    [
        (5.0, 0.0, 5.0),
        (50.0, 0.0, 10.0),
        (-50.0, 0.0, -10.0),
        (50.0, 2.0, 10.0),  # at its greatest speed
        (50.0, 2.15, 5.0),  # half the fade of 15 %
        (50.0, 2.4, 0.0),
        (-50.0, 2.4, -10.0),  # The limit does not fade when braking.
        (-50.0, -2.15, -5.0),
        (50.0, -2.15, 10.0),
    ],
)
def test_a_motor_keeps_its_limits(tau: float, speed: float, given_torque: float) -> None:
    assert motor(tau, 10.0, speed, 2.0) == pytest.approx(given_torque, abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(
    qd=sixes(-2.0, 2.0), drive=sixes(-90.0, 90.0), bias=sixes(-40.0, 40.0), seed=st.integers(0, 99)
)
def test_without_friction_newtons_second_law_holds(
    qd: Six, drive: Six, bias: Six, seed: int
) -> None:
    inverse = inverse_of(seed)
    friction, speed = accelerated(0.002, qd, drive, bias, inverse, ZERO, ZERO, ZERO)
    expected = np.array(qd) + 0.002 * np.array(inverse) @ (np.array(drive) - np.array(bias))
    assert friction == ZERO
    assert np.allclose(speed, expected, rtol=1e-12, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(qd=sixes(-2.0, 2.0), hold=sixes(0.0, 30.0), gains=sixes(0.01, 2.0))
def test_dry_friction_brings_uncoupled_joints_to_rest(qd: Six, hold: Six, gains: Six) -> None:
    """Uncoupled joints lose `hold` times their gain in speed per second and then stand still: they
    never reverse."""
    dt, friction, speed = 0.002, ZERO, qd
    inverse: Any = tuple(map(tuple, np.diag(gains).tolist()))
    for step in range(1, 30):
        friction, speed = accelerated(dt, speed, ZERO, ZERO, inverse, ZERO, friction, hold)
        left = np.maximum(np.abs(qd) - step * dt * np.array(hold) * np.array(gains), 0.0)
        assert np.allclose(speed, np.copysign(left, qd), atol=1e-12)
        assert all(abs(f) <= h for f, h in zip(friction, hold, strict=True))


@settings(max_examples=60, deadline=None)
@given(q=sixes(-1.2, 1.2), speed=sixes(-90.0, 90.0))
def test_no_joint_leaves_its_range(q: Six, speed: Six) -> None:
    low, high = (-1.0,) * 6, (1.0,) * 6
    angles, speeds = moved(0.002, q, speed, low, high)
    for before, v, angle, after in zip(q, speed, angles, speeds, strict=True):
        assert -1.0 <= angle <= 1.0
        assert (angle, after) == (
            (before + 0.002 * v, v) if -1.0 <= before + 0.002 * v <= 1.0 else (angle, 0.0)
        )


def test_an_arm_that_friction_holds_stands_still() -> None:
    inverse, slow = inverse_of(1), (1e-5,) * 6
    q, qd, _, still = stepped(
        0.002,
        ZERO,
        slow,
        ZERO,
        ZERO,
        inverse,
        ZERO,
        TALL,
        TALL,
        ZERO,
        (1.0,) * 6,
        (1.0,) * 6,
        (-1.0,) * 6,
        (1.0,) * 6,
    )
    assert still and q == ZERO and qd == ZERO
    assert not held((2.0, *ZERO[1:]), ZERO, (1.0,) * 6)


needs_numba = pytest.mark.skipif(not COMPILED, reason="numba is not installed (the extra `fast`)")


@needs_numba
@settings(max_examples=100, deadline=None)
@given(
    q=sixes(-3.0, 3.0),
    qd=sixes(-6.0, 6.0),
    tau=sixes(-250.0, 250.0),
    bias=sixes(-90.0, 90.0),
    friction=sixes(-8.0, 8.0),
    hold=sixes(0.0, 30.0),
    seed=st.integers(0, 99),
)
def test_a_compiled_step_gives_the_same_bits(
    q: Six, qd: Six, tau: Six, bias: Six, friction: Six, hold: Six, seed: int
) -> None:
    rest = (90.0,) * 6, (2.0,) * 6, (1.5,) * 6, hold, hold, (-2.5,) * 6, (2.5,) * 6
    arguments = 0.002, q, qd, tau, bias, inverse_of(seed), friction, *rest
    as_it_stands = compiled.plain(arm_motion.stepped)
    assert bits(*arm_motion.stepped(*arguments)) == bits(*as_it_stands(*arguments))


@settings(max_examples=100, deadline=None)
@given(
    q=sixes(-3.0, 3.0),
    qd=sixes(-6.0, 6.0),
    tau=sixes(-250.0, 250.0),
    bias=sixes(-90.0, 90.0),
    friction=sixes(-8.0, 8.0),
    hold=sixes(0.0, 30.0),
    seed=st.integers(0, 99),
)
def test_packed_numbers_give_the_same_bits(
    q: Six, qd: Six, tau: Six, bias: Six, friction: Six, hold: Six, seed: int
) -> None:
    limit, greatest, inverse = (90.0,) * 6, (2.0,) * 6, inverse_of(seed)
    rest = (
        limit,
        greatest,
        (1.5, 1.6, 1.7, 1.8, 1.9, 2.0),
        hold,
        (9.0,) * 6,
        (-2.5,) * 6,
        (2.5,) * 6,
    )
    numbers = packed(stepped_packed, [number for group in rest for number in group])
    rows = packed(stepped_packed, [number for row in inverse for number in row])
    plainly = stepped(0.002, q, qd, tau, bias, inverse, friction, *rest)
    assert bits(*stepped_packed(0.002, q, qd, tau, bias, friction, rows, numbers)) == bits(*plainly)
    assert held_packed(tau, qd, bias, numbers) == held(
        motors(tau, limit, qd, greatest), bias, (9.0,) * 6
    )


TRIPLE = st.tuples(*[st.floats(-1.0, 1.0, allow_subnormal=False)] * 3)


@settings(max_examples=100, deadline=None)
@given(
    q=sixes(-3.2, 3.2),
    zero=sixes(-0.01, 0.01),
    axes=st.tuples(TRIPLE, TRIPLE, TRIPLE),
    origin=TRIPLE,
)
def test_the_pose_of_the_load_equals_that_of_the_arms_frames_to_the_bit(
    arm: PumaModel, q: Six, zero: Six, axes: tuple[Triple, Triple, Triple], origin: Triple
) -> None:
    numbers = numbers_of(arm, zero, axes, origin)
    flange = arm.frames([angle + off for angle, off in zip(q, zero, strict=True)])[6]
    turned = [
        tuple(a - b for a, b in zip(flange.point(axis), flange.origin, strict=True))
        for axis in axes
    ]
    assert bits(*carried(q, numbers)) == bits(*turned, flange.point(origin))
    assert bits(*compiled.plain(cup_motion.carried)(q, tuple(numbers))) == bits(
        *turned, flange.point(origin)
    )


def test_numbers_are_packed_only_for_compiled_kernels() -> None:
    assert packed(compiled.plain(stepped_packed), [1, 2.5]) == (1.0, 2.5)
    if COMPILED:
        array: Any = packed(stepped_packed, [1, 2.5])
        assert isinstance(array, np.ndarray) and array.tolist() == [1.0, 2.5]


@pytest.mark.processes
def test_numba_can_be_left_out() -> None:
    """A variable of the environment makes kernels run as plain Python even if numba is
    installed."""
    code = (
        "import sys; import petrobot.sim.catching.arm_motion as m; print(type(m.stepped).__name__, "
        "'numba' in sys.modules)"
    )
    found = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, SWITCH: "0"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert found.stdout.split() == ["function", "False"]
