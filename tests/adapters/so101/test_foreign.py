"""The driver on a bus that was written from the vendor's protocol alone, on a pseudo terminal: late
answers, echoes, wrong checksums, a missing servo, overload, another mode."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import cast

import pytest

from petrobot import ByteLine, Context, Ports, Remote, Result, success
from petrobot.services.adapters.so101 import actions
from petrobot.services.adapters.so101.arm import Arm
from petrobot.services.comm.streams.line import SerialPort
from tests.adapters.conftest import PortsClock, rehearsed
from tests.adapters.so101.foreign import Bus, Servo

BEGIN, END = 1.5, 3.5
"""When the trouble begins and ends (s)."""


class TerminalPorts:
    """Ports of a driver whose serial line is a terminal."""

    now = 0.0

    def __init__(self) -> None:
        self.lines: list[ByteLine] = []

    def serial(self, port: str, baud: int) -> ByteLine:
        self.lines.append(SerialPort(port, baud))
        return self.lines[-1]


class TerminalArm(PortsClock, Arm):
    """Its driver."""


@pytest.fixture
def bus() -> Iterator[Bus]:
    made = Bus()
    yield made
    made.close()


def played(bus: Bus, trouble: Callable[[Bus, bool], None]) -> tuple[Result, Result, float]:
    """Move there and back during the trouble; afterwards enable and move again. Return the result
    of the first move that failed (else of the last), of the move afterwards, and the farthest
    distance (steps) that a servo moved between the end of the failed run and the next command."""
    bus.step(0.001)
    arm = TerminalArm({"port": bus.path}, cast(Ports, TerminalPorts()))

    def world(now: float) -> None:
        if abs(now - BEGIN) < 0.002:
            trouble(bus, True)
        elif abs(now - END) < 0.002:
            trouble(bus, False)
        bus.step(now + 0.002)
        time.sleep(0.0003)  # the kernel passes bytes of a terminal on by a thread of its own

    async def story(ctx: Context[Remote]) -> Result:
        first, moved = success(), 0.0
        for angle in (0.3, -0.3) * 6:
            if ctx.now < END and not first.cause:
                first = await actions.move_joints(ctx, joints=[angle, 0, 0, 0, 0], timeout=3.0)
        await ctx.sleep(0.1)
        stood = [servo.at for servo in bus.servos.values()]
        await ctx.wait(lambda: ctx.now > END + 0.2, END)
        moved = max(
            abs(servo.at - at) for servo, at in zip(bus.servos.values(), stood, strict=True)
        )
        await actions.enable(ctx)
        again = await actions.move_joints(ctx, joints=[0.1, 0, 0, 0, 0])
        seen.append((first, again, moved))
        return success()

    seen = list[tuple[Result, Result, float]]()
    rehearsed(story, arm, world)
    return seen[0]


def overload(bus: Bus, on: bool) -> None:
    bus.servos[2].error = 32 * on


def unplugged(bus: Bus, on: bool) -> None:
    bus.missing = {3} if on else set()


def spoilt(bus: Bus, on: bool) -> None:
    bus.spoil = (lambda packet: packet[:-1] + bytes((packet[-1] ^ 0x10,))) if on else bytes


def late(bus: Bus, on: bool) -> None:
    bus.delay = 0.5 * on


def wheel(bus: Bus, on: bool) -> None:
    bus.servos[4].table[33] = on


@pytest.mark.parametrize(
    ("trouble", "cause", "text"),
    [
        (overload, "overload", "shoulder_lift"),
        (unplugged, "missing", "elbow_flex"),
        (spoilt, "missing", "no servo answers"),
        (late, "missing", "no servo answers"),
        (wheel, "mode", "wrist_flex"),
    ],
)
def test_a_run_names_the_trouble_and_the_arm_can_be_used_again(
    bus: Bus, trouble: Callable[[Bus, bool], None], cause: str, text: str
) -> None:
    first, again, moved = played(bus, trouble)
    assert first.cause == cause and text in first.text, first
    assert moved < 40.0  # it stands, but for the end of its braking
    assert again.status == "success", again


@pytest.mark.parametrize("delay", [0.0, 0.03])
def test_echoes_and_a_short_delay_do_not_disturb_it(bus: Bus, delay: float) -> None:
    bus.echoes = True

    def slow(bus: Bus, on: bool) -> None:
        bus.delay = delay * on

    first, again, _ = played(bus, slow)
    assert (first.status, again.status) == ("success", "success"), (first, again)


def test_a_servo_that_is_a_wheel_from_the_start_gets_no_torque(bus: Bus) -> None:
    bus.servos[5].table[33] = 1
    first, _, _ = played(bus, lambda bus, on: None)
    assert first.cause == "mode" and "wrist_roll" in first.text, first
    assert bus.servos[5].at == Servo().at and bus.servos[5].table[40] == 0
