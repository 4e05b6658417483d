"""Primitive actions of the arm: intercept, follow and wait, empty and home, reset and home.

All are coroutines that reach the driver only through `ctx.device`, a `Remote` of
`petrobot.services.motion.arm:Arm`: they send commands and read its state. Error causes:
`drive_fault`, `power`, `bus` (reported by the driver), `unreachable`, `no_setpoint`, `refused`,
`arm_timeout`, `cup_not_empty`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from operator import sub
from typing import Any, Final

from petrobot.services.action import (
    Cancelled,
    Context,
    Result,
    Status,
    error,
    failure,
    provisional,
    success,
)
from petrobot.services.perform import command_drives, drive_fault

RENEW: Final = 0.1
"""Seconds between repeated `follow` commands; the driver holds if it receives none for 0.5 s."""
GRACE: Final = 0.3
"""Seconds for which the run stays active after the catch, so that the external event can preempt it
first."""
CYCLE: Final = 0.004
"""Seconds per cycle of the driver: waiting less makes no sense."""
NOW: Final = 0.1
"""Seconds before the arrival from which a better prediction is not awaited any more."""
IN_FLIGHT: Final = 0.2
"""Seconds before the arrival from which the stream may cease: the ball has left the table, or is
about to."""


async def intercept_upright(
    ctx: Context,
    *,
    depth: float = 0.11,
    timeout: float = 8.0,
    patience: float = 3.0,
    sigma: float = 0.008,
    judged: bool = False,
) -> Result:
    """Bring the upright cup to where the ball will fall into it, about `depth` m below the exit.
    See `_intercept`."""
    return await _intercept(
        ctx, {"strategy": "upright", "preferred": depth}, timeout, patience, sigma, judged
    )


async def intercept_tilted(
    ctx: Context,
    *,
    tilt: float = 0.5236,
    depth: float = 0.055,
    timeout: float = 8.0,
    patience: float = 3.0,
    sigma: float = 0.008,
    judged: bool = False,
) -> Result:
    """Bring the cup, tilted by `tilt` (rad) against the ball, into its path about `depth` m below
    the exit. See `_intercept`."""
    return await _intercept(
        ctx,
        {"strategy": "tilted", "tilt": tilt, "preferred": depth},
        timeout,
        patience,
        sigma,
        judged,
    )


async def follow_and_wait(
    ctx: Context,
    *,
    margin: float = 0.4,
    patience: float = 1.0,
    timeout: float = 10.0,
    moved: str = "",
) -> Result:
    """Keep the cup at the newest prediction and wait for the ball until `margin` s after its
    predicted arrival.

    SUCCESS when the ball lies in the cup, unless the external event `ball_caught` ends the run
    first; FAILURE `missed`. ERROR `no_setpoint` if no prediction arrives within `patience` s or the
    stream ceases long before the ball arrives, and the driver's own errors. `moved` is the run that
    brought the cup there, if it is to be judged: by whether the ball is in the cup.
    """
    following = _Following(ctx, {})
    try:
        result = await following.until(
            lambda state, waited: _await_ball(state, waited, margin, patience), timeout
        )
        if result.cause == "" and ctx.device.state["ball_in_cup"]:
            await ctx.sleep(GRACE)
    finally:
        ctx.device.send({"do": "hold"})  # Also when the run is preempted.
        if moved and ctx.device.state["ball_in_cup"]:
            ctx.verdict(moved, success())
    if moved and result.status is Status.FAILURE:
        ctx.verdict(moved, result)
    return result


async def empty_and_home(
    ctx: Context,
    *,
    speed: float = 1.0,
    dwell: float = 0.25,
    attempts: int = 3,
    timeout: float = 12.0,
    always: bool = False,
) -> Result:
    """Go home; turn the cup over away from the table if something is in it (or `always`); check
    that it is empty.

    The arm goes home first: on the straight path from a catch at the side to the emptying pose, the
    cup would hit the edge of the table. ERROR `cup_not_empty` if the light barrier is still
    interrupted after so many `attempts`.
    """
    until = ctx.now + timeout
    stuck = await _go(ctx, "home", speed, until)
    for attempt in range(attempts):
        if stuck is not None:
            return stuck
        if not ctx.device.state["barrier"] and not (always and attempt == 0):
            return success()
        stuck = await _go(ctx, "empty", speed, until)
        if stuck is None:
            await ctx.wait(lambda: not ctx.device.state["barrier"], dwell)
            await ctx.sleep(dwell)
            stuck = await _go(ctx, "home", speed, until)
    if stuck is not None or not ctx.device.state["barrier"]:
        return stuck or success()
    return error(
        "cup_not_empty",
        f"the light barrier is still interrupted after turning the cup over {attempts} times",
    )


async def reset_and_home(ctx: Context, *, speed: float = 0.3, timeout: float = 15.0) -> Result:
    """Reset faults, enable the drives again, bring the arm home slowly, and empty the cup if a ball
    lies in it.

    A ball left in the cup would leave no room for the next one. ERROR as the driver reports if the
    drives stay in fault.
    """
    until = ctx.now + timeout
    await ctx.command({"do": "reset"})
    if not await ctx.wait(lambda: bool(ctx.device.state["enabled"]), max(0.0, until - ctx.now)):
        return drive_fault(ctx.device.state, "joint") or error(
            "arm_timeout", f"the drives were not enabled within {timeout} s"
        )
    return await empty_and_home(ctx, speed=speed, timeout=max(0.0, until - ctx.now))


async def _intercept(
    ctx: Context,
    how: Mapping[str, Any],
    timeout: float,
    patience: float,
    sigma: float,
    judged: bool,
) -> Result:
    """Follow the catch points of the stream until the cup is in place for one that is good enough.

    SUCCESS: in place, and sigma_y of the prediction is at most `sigma` (m) or the ball is about to
    arrive; FAILURE `late`: the predicted arrival has passed; ERROR: `no_setpoint` (none within
    `patience` s, or the stream has ceased), `unreachable`, or as the driver reports. After SUCCESS
    and FAILURE the arm keeps following, for `follow_and_wait`. If it is to be `judged`, both are
    provisional, and `run` is what `follow_and_wait` judges by whether the ball is caught; `travel`
    (rad), how far the joints have moved, all together, says how much the run wore the arm.
    """
    following = _Following(ctx, how)
    try:
        result = await following.until(
            lambda state, waited: _await_place(state, waited, patience, sigma), timeout
        )
    except Cancelled:
        ctx.device.send({"do": "hold"})
        raise
    if result.status is Status.ERROR:
        ctx.device.send({"do": "hold"})
    if judged:
        values = {**result.values, "run": ctx.run, "travel": following.travel}
        result = replace(result, values=values)
    return provisional(result) if judged and result.status is not Status.ERROR else result


class _Following:
    """Repeat the `follow` command as the driver requires, and judge each new state of the arm."""

    def __init__(self, ctx: Context, how: Mapping[str, Any]) -> None:
        self._ctx = ctx
        self._how = how
        self._renewed = 0.0
        self.travel = 0.0
        """Rad that the joints have moved, all together."""

    async def until(
        self, judge: Callable[[Mapping[str, Any], float], Result | None], timeout: float
    ) -> Result:
        """Follow until `judge(state, seconds)` returns a result, the driver reports a fault, or
        `timeout` s have passed."""
        ctx = self._ctx
        if trouble := await self._renew():
            return trouble
        begun, seen, result = ctx.now, -1, None
        before = ctx.device.state["q"]

        def judged() -> bool:
            nonlocal before, seen, result
            state = ctx.device.state
            if state["cycles"] != seen:
                self.travel += sum(map(abs, map(sub, state["q"], before)))
                before = state["q"]
                seen, result = (
                    state["cycles"],
                    drive_fault(state, "joint") or judge(state, ctx.now - begun),
                )
            return result is not None

        while ctx.now - begun <= timeout:
            if await ctx.wait(judged, min(self._renewed + RENEW, begun + timeout) - ctx.now):
                break
            if trouble := await self._renew():
                return trouble
        return result or error("arm_timeout", f"nothing came of following in {timeout} s")

    async def _renew(self) -> Result | None:
        self._renewed = self._ctx.now
        return await command_drives(self._ctx, {"do": "follow", **self._how}, "joint")


def _await_place(
    state: Mapping[str, Any], waited: float, patience: float, sigma: float
) -> Result | None:
    """Return the result of an interception; None while it is in progress."""
    plan, reason = state["plan"], state["reason"]
    if reason == "unreachable":
        return error("unreachable", "the arm cannot bring the cup to the predicted point")
    if plan is None:
        return (
            error("no_setpoint", f"no catch point in {patience} s") if waited > patience else None
        )
    if state["in_place"] and (plan["sigma_y"] <= sigma or plan["arrival"] < NOW):
        return success(point=_point(state), slack=plan["arrival"])
    if plan["arrival"] < 0.0:
        return failure(
            "late",
            f"the ball was there {-plan['arrival']:.3f} s before the cup",
            point=_point(state),
        )
    return _ceased(state)


def _await_ball(
    state: Mapping[str, Any], waited: float, margin: float, patience: float
) -> Result | None:
    """Return the result of waiting for the ball; None while it is in progress."""
    plan = state["plan"]
    if state["ball_in_cup"]:
        return success(point=_point(state))
    if plan is None:
        return (
            error("no_setpoint", f"no catch point in {patience} s") if waited > patience else None
        )
    if plan["arrival"] < -margin:
        return failure(
            "missed", f"no ball {margin} s after its predicted arrival", point=_point(state)
        )
    return _ceased(state)


def _ceased(state: Mapping[str, Any]) -> Result | None:
    """Return the error of a stream that ended while the ball was still far away."""
    if state["reason"] == "no_setpoint" and state["plan"]["arrival"] > IN_FLIGHT:
        return error(
            "no_setpoint",
            f"catch points have ceased: the newest is {state['setpoint_age']:.3f} s old",
        )
    return None


def _point(state: Mapping[str, Any]) -> list[float]:
    plan = state["plan"]
    return [] if plan is None else [float(value) for value in plan["point"]]


async def _go(ctx: Context, pose: str, speed: float, until: float) -> Result | None:
    """Move to a named pose; return None when it is reached, else the result of the action."""
    move = {"do": "move", "pose": pose, "speed": speed}
    if trouble := await command_drives(ctx, move, "joint"):
        return trouble

    def over() -> bool:
        state = ctx.device.state
        return bool((state["mode"] == "move" and state["in_place"]) or state["faults"])

    await ctx.sleep(CYCLE)
    if not await ctx.wait(over, max(0.0, until - ctx.now)):
        what = ctx.device.state["guard"] or "still in progress"
        return error("arm_timeout", f"pose {pose} not reached in time: {what}")
    return drive_fault(ctx.device.state, "joint")
