"""The driver with a controller that was written from the vendor's guides alone, over TCP: another
package rate, a connection that is dropped, a refused protocol, changes of the safety status."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, cast

import pytest

from petrobot import ByteLine, CommandRefused, Context, Ports, Remote, Result, success
from petrobot.services.adapters.ur import actions
from petrobot.services.adapters.ur.arm import Arm
from petrobot.services.comm.streams.line import TcpConnection
from tests.adapters.conftest import PortsClock, rehearsed
from tests.adapters.ur.foreign import Controller

HOME = [0.0, -1.57, 1.57, -1.57, -1.57, 0.0]
BEGIN, END = 6.0, 8.0
"""When the trouble begins and ends (s)."""


class TcpPorts:
    """Ports of a driver with real TCP connections."""

    now = 0.0

    def tcp(self, host: str, port: int) -> ByteLine:
        return TcpConnection(host, port)


class TcpArm(PortsClock, Arm):
    """Its driver."""


@pytest.fixture
def controller() -> Iterator[Controller]:
    made = Controller()
    yield made
    made.close()


async def ended(ctx: Context[Remote], angle: float) -> Result:
    try:
        return await actions.move_joints(ctx, joints=[angle, *HOME[1:]], timeout=4.0)
    except CommandRefused as fault:
        return Result(cast(Any, "error"), {}, "command_refused", str(fault))


def played(
    controller: Controller, trouble: Callable[[Controller, bool], None]
) -> tuple[Result, Result, float]:
    """Enable, move there and back during the trouble; afterwards enable and move again. Return the
    result of the first action that failed (else of the last), of the move afterwards, and the
    farthest distance (rad) that a joint moved between the failed run and the next command."""
    rtde, dashboard, program = controller.ports
    keys = {"rtde_port": rtde, "dashboard_port": dashboard, "program_port": program}
    arm = TcpArm({"host": "127.0.0.1", **keys}, cast(Ports, TcpPorts()))
    seen = list[tuple[Result, Result, float]]()

    def world(now: float) -> None:
        if now == 0.0 or abs(now - BEGIN) < 0.002:
            trouble(controller, now > 0.0)
        elif abs(now - END) < 0.002:
            trouble(controller, False)
        controller.step(now + 0.004)
        time.sleep(0.0003)

    async def story(ctx: Context[Remote]) -> Result:
        first = await actions.enable(ctx, timeout=5.0)
        for angle in (0.5, 0.0) * 8:
            if ctx.now < END and not first.cause:
                first = await ended(ctx, angle)
        stood = list(controller.q)
        await ctx.wait(lambda: ctx.now > END + 4.0, END + 4.0)
        moved = max(abs(a - b) for a, b in zip(controller.q, stood, strict=True))
        enabled = await actions.enable(ctx, timeout=10.0)
        again = await ended(ctx, 0.2) if not enabled.cause else enabled
        seen.append((first, again, moved))
        return success()

    rehearsed(story, arm, world)
    return seen[0]


def becomes(safety: int) -> Callable[[Controller, bool], None]:
    def trouble(controller: Controller, on: bool) -> None:
        if on or safety != 3:  # only the dashboard ends a protective stop
            controller.safety = safety if on else 1

    return trouble


def dropped(controller: Controller, on: bool) -> None:
    if on:
        controller.cut()


def gone(controller: Controller, on: bool) -> None:
    controller.deaf = on
    if on:
        controller.cut()


def slow(controller: Controller, on: bool) -> None:
    controller.period = 0.25 if on else 0.008


def stopped(controller: Controller, on: bool) -> None:
    controller.program = controller.program and not on


def without_power(controller: Controller, on: bool) -> None:
    controller.mode = 3 if on else controller.mode


@pytest.mark.parametrize(
    ("trouble", "cause", "text"),
    [
        (becomes(3), "protective_stop", "protective"),
        (becomes(5), "safeguard_stop", "safeguard"),
        (becomes(6), "emergency_stop", "emergency"),
        (becomes(8), "violation", "violation"),
        (becomes(9), "fault", "fault"),
        (dropped, "link_lost", "closed the connection"),
        (gone, "link_lost", "closed the connection"),
        (slow, "link_lost", "no data for 0.15 s"),
        (stopped, "program_lost", "program"),
        (without_power, "power_off", "power"),
    ],
)
def test_a_run_names_the_trouble_and_the_arm_can_be_used_again(
    controller: Controller, trouble: Callable[[Controller, bool], None], cause: str, text: str
) -> None:
    first, again, moved = played(controller, trouble)
    assert first.cause == cause and text in first.text, first
    assert moved < 0.02, moved  # it stands, but for the end of its braking
    assert again.status == "success", again


@pytest.mark.parametrize("period", [0.002, 0.02, 0.1])
def test_another_package_rate_does_not_disturb_it(controller: Controller, period: float) -> None:
    def other(controller: Controller, on: bool) -> None:
        controller.period = period
        controller.say(b"output recipe: another rate")

    first, again, _ = played(controller, other)
    assert (first.status, again.status) == ("success", "success"), (first, again)


def test_a_refused_protocol_is_named_and_the_next_one_is_tried(controller: Controller) -> None:
    def old(controller: Controller, on: bool) -> None:
        controller.version_accepted = controller.now > END - 0.1

    first, again, _ = played(controller, old)
    assert first.cause == "late" and "refuses RTDE protocol 2" in first.text, first
    assert again.status == "success", again
