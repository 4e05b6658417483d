"""A scripted plant: the catching cell's primitive actions under their own names, without physics.

A trial takes 0.5 s of simulated time and a few ms of CPU, so even faults that show once in a
hundred trials can be measured. Each ball has a hidden hardness in 0..1 that its camera and arm
actions share, so the statuses of one trial depend on each other, as in a real throw. Like the real
ones, the arm's actions follow a stream of set points that `track_ball` publishes, and the light
barrier is an external event, which a ball that falls out of the cup may raise as well.

Every run is logged at its beginning and end; the referee judges all programs by this log.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Coroutine, Mapping
from typing import Any, NamedTuple

from petrobot import Context, Result, error, failure, key, success
from petrobot.services.device import Driver, Ports, Setpoint

HANG = 300.0
"""Time after which a hanging run ends by itself (s)."""
SET_POINTS = 0.3
"""How long the arm waits for the first set point (s)."""


class Character(NamedTuple):
    """Properties of an action: shortest and longest duration (s), shares of errors and of hanging
    runs, and the quality of its result (a factor of the chance to catch)."""

    shortest: float
    longest: float
    error: float
    hang: float = 0.0
    good: float = 1.0


ACTIONS: Mapping[str, Character] = {
    "locate_background": Character(0.05, 0.10, 0.03, 0.010, 0.97),
    "locate_mog2": Character(0.06, 0.14, 0.02, 0.010, 0.99),
    "locate_hough": Character(0.10, 0.20, 0.01, 0.010, 0.94),
    "locate_threshold": Character(0.04, 0.08, 0.08, 0.010, 0.90),
    "locate_compensated": Character(0.06, 0.12, 0.03, 0.010, 0.97),
    "predict_least_squares": Character(0.12, 0.20, 0.02, 0.0, 0.97),
    "predict_kalman": Character(0.12, 0.20, 0.03, 0.0, 0.99),
    "predict_constant_velocity": Character(0.10, 0.16, 0.01, 0.0, 0.85),
    "intercept_tilted": Character(0.06, 0.12, 0.03, 0.004, 0.97),
    "intercept_upright": Character(0.05, 0.10, 0.03, 0.004, 0.90),
    "follow_and_wait": Character(0.04, 0.10, 0.02),
    "empty_and_home": Character(0.08, 0.14, 0.02, 0.002),
    "reset_and_home": Character(0.15, 0.30, 0.50),
}


class Entry(NamedTuple):
    """One line of the log. `what` is begin, success, failure, error, cut (cancelled or past its
    deadline) or caught."""

    t: float
    device: str
    action: str
    run: str
    what: str
    ball: int


ENTRIES: list[Entry] = []
"""The log in lock step, where the whole plant is in this process."""


class Device(Driver):
    """Camera or arm. With `log` each entry is synced to that file before the action continues."""

    name: str = key(text="of the device, for the log")
    log: str = key("", "file of the durable log")

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        self.balls = 0
        """Number of balls located so far."""
        self.ball = 0
        """The ball that the arm is catching."""
        self.in_cup = self.will_catch = False
        self.hard = 0.0
        # opened with the driver: in real time senders ask its process for the stream's port
        self.point: Setpoint | None = ports.stream("catch_point") if self.name == "arm" else None

    def note(self, ctx: Context[Device], action: str, what: str) -> None:
        """Add an entry to the log."""
        if not self.log:
            ENTRIES.append(Entry(ctx.now, self.name, action, ctx.run, what, self.ball))
            return
        line = json.dumps([time.time(), self.name, action, ctx.run, what, self.ball]) + "\n"
        file = os.open(self.log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
        try:
            os.write(file, line.encode())
            os.fsync(file)
        finally:
            os.close(file)

    def stop(self, now: float) -> None:
        """Do nothing: nothing moves."""

    def stopped(self) -> bool:
        """Return True: nothing moves."""
        return True


async def _run(
    ctx: Context[Device], action: str, slow: float, faults: float, hard: float = 0.0
) -> str:
    """Spend the action's time. Return the cause of its error, or nothing. Hard balls take longer
    and fail more often."""
    like, draw = ACTIONS[action], ctx.random("run")
    hang, fails, span = draw.random(3)
    if hang < like.hang * min(faults, 1.0):
        await ctx.sleep(HANG)
        return "hung"
    # the factor is 1 in the mean over all balls, and 0.5 for an arm without a ball
    share = like.error * faults * (0.5 + 1.5 * hard * hard)
    seconds = like.shortest + span * (like.longest - like.shortest)
    await ctx.sleep(seconds * slow * (1.0 + 0.5 * hard))
    return "broken" if fails < share else ""


async def _logged(ctx: Context[Device], action: str, run: Coroutine[Any, Any, Result]) -> Result:
    """Run the action between two entries of the log."""
    ctx.device.note(ctx, action, "begin")
    try:
        result = await run
    except BaseException:  # cancelled, or past its deadline
        ctx.device.note(ctx, action, "cut")
        raise
    ctx.device.note(ctx, action, result.status.value)
    return result


async def _locate(ctx: Context[Device], action: str, slow: float, faults: float) -> Result:
    device = ctx.device
    device.balls += 1
    device.ball = device.balls
    cause = await _run(ctx, action, slow, faults)
    if cause:
        return error("no_ball", "no rolling ball was seen in time")
    hard = float(ctx.random("ball").random())
    return success(ball=[device.ball, hard, ACTIONS[action].good])


async def _track(
    ctx: Context[Device], action: str, ball: list[float], slow: float, faults: float
) -> Result:
    number, hard, good = ball
    ctx.publish("catch_point", [number, hard, good * ACTIONS[action].good])
    if await _run(ctx, action, slow, faults, hard):
        return error("ball_lost", "the ball was not seen for too long")
    if hard > 0.97:
        return failure("inaccurate", "the last prediction was more than 15 mm off")
    return success()


async def _move(ctx: Context[Device], action: str, slow: float, faults: float) -> Result:
    device, point = ctx.device, ctx.device.point
    assert point is not None
    if not await ctx.wait(lambda: point.values is not None, SET_POINTS):
        return error("no_setpoint", "no prediction came in time; the arm holds")
    assert point.values is not None
    number, hard, good = point.values
    device.ball, device.in_cup = int(number), False
    chance = good * ACTIONS[action].good * (1.15 - 0.4 * hard * hard)
    draw = ctx.random("catch")
    device.will_catch = draw.random() < chance
    early = draw.random() < 0.1
    device.hard = hard
    cause = await _run(ctx, action, slow, faults, hard)
    if cause:
        return error("drive_fault", "a drive reported a fault")
    if early and device.will_catch:  # the ball comes before the report that the cup is in place
        _catch(ctx, action)
        await ctx.sleep(0.05)
    return success()


def _catch(ctx: Context[Device], action: str) -> None:
    ctx.device.in_cup = True
    ctx.device.note(ctx, action, "caught")
    ctx.device.ports.raise_event("ball_caught")


async def _follow(ctx: Context[Device], action: str, slow: float, faults: float) -> Result:
    device = ctx.device
    if await _run(ctx, action, slow, faults, device.hard):
        return error("drive_fault", "a drive reported a fault")
    if device.will_catch and not device.in_cup:
        _catch(ctx, action)
        await ctx.sleep(0.3)
        return success()
    await ctx.sleep(0.1)
    return failure("missed", "the ball has passed")


async def _home(ctx: Context[Device], action: str, slow: float, faults: float) -> Result:
    device, held = ctx.device, ctx.device.in_cup
    device.in_cup = device.will_catch = False
    if held and ctx.random("fall").random() < 0.2:
        device.ports.raise_event("ball_caught")  # the ball passes the barrier when it falls out
    if await _run(ctx, action, slow, faults):
        return error("drive_fault", "a drive reported a fault")
    return success()


async def _recover(ctx: Context[Device], action: str, slow: float, faults: float) -> Result:
    ctx.device.in_cup = False
    if await _run(ctx, action, slow, faults):
        return error("drive_fault", "a drive does not leave its fault state")
    return success()


async def locate(
    ctx: Context[Device], *, action: str, slow: float = 1.0, faults: float = 1.0
) -> Result:
    """Find the ball: `ball` is its number, its hardness and how well it was located. In all actions
    here, `slow` multiplies times, and `faults` the shares of errors (0: no run hangs either)."""
    return await _logged(ctx, action, _locate(ctx, action, slow, faults))


async def track(
    ctx: Context[Device],
    *,
    action: str,
    ball: list[float],
    slow: float = 1.0,
    faults: float = 1.0,
) -> Result:
    """Publish set points for the arm until the ball leaves the table."""
    ctx.device.ball = int(ball[0])
    return await _logged(ctx, action, _track(ctx, action, ball, slow, faults))


async def move(
    ctx: Context[Device], *, action: str, slow: float = 1.0, faults: float = 1.0
) -> Result:
    """Bring the cup to the point of the stream. A fast ball may be caught before the action
    ends."""
    return await _logged(ctx, action, _move(ctx, action, slow, faults))


async def follow(
    ctx: Context[Device], *, action: str, slow: float = 1.0, faults: float = 1.0
) -> Result:
    """Wait for the ball in the cup."""
    return await _logged(ctx, action, _follow(ctx, action, slow, faults))


async def home(
    ctx: Context[Device], *, action: str, slow: float = 1.0, faults: float = 1.0
) -> Result:
    """Go home and empty the cup."""
    return await _logged(ctx, action, _home(ctx, action, slow, faults))


async def recover(
    ctx: Context[Device], *, action: str, slow: float = 1.0, faults: float = 1.0
) -> Result:
    """Reset the drives and go home."""
    return await _logged(ctx, action, _recover(ctx, action, slow, faults))
