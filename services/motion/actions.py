"""The arm's primitive actions: intercept, follow and wait, empty and home, reset and home.

All are coroutines that see the servo only through `ctx.device`, a `Remote` of
`petrobot.services.motion.arm:Arm`: they send commands and read its state. Error causes:
`drive_fault`, `power`, `bus` (as the servo says), `unreachable`, `no_setpoint`, `refused`,
`arm_timeout`, `cup_not_empty`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from petrobot.services.action import Cancelled, Context, Result, Status, error, failure, success

RENEW: Final = 0.1
"""s between repeated `follow` commands: a servo that hears none for 0.5 s holds."""
GRACE: Final = 0.3
"""s that a caught ball leaves the external event to preempt the run before the run ends by
itself."""
CYCLE: Final = 0.004
"""s, the servo's cycle: the least that it makes sense to wait."""
ANSWER: Final = 0.5
"""s within which the servo takes a command."""
NOW: Final = 0.1
"""s before the arrival from which no better prediction is waited for."""
IN_FLIGHT: Final = 0.2
"""s before the arrival from which the stream may cease: the ball has left the table, or is about
to."""


async def intercept_upright(
    ctx: Context,
    *,
    depth: float = 0.11,
    timeout: float = 8.0,
    patience: float = 3.0,
    sigma: float = 0.008,
) -> Result:
    """Bring the cup, held upright, to where the ball will fall into it, about `depth` m below the
    exit. See `_intercept`."""
    return await _intercept(
        ctx, {"strategy": "upright", "preferred": depth}, timeout, patience, sigma
    )


async def intercept_tilted(
    ctx: Context,
    *,
    tilt: float = 0.5236,
    depth: float = 0.055,
    timeout: float = 8.0,
    patience: float = 3.0,
    sigma: float = 0.008,
) -> Result:
    """Bring the cup, tilted by `tilt` (rad) against the ball, to its way about `depth` m below the
    exit. See `_intercept`."""
    return await _intercept(
        ctx, {"strategy": "tilted", "tilt": tilt, "preferred": depth}, timeout, patience, sigma
    )


async def follow_and_wait(
    ctx: Context, *, margin: float = 0.4, patience: float = 1.0, timeout: float = 10.0
) -> Result:
    """Keep the cup on the newest prediction and wait for the ball until `margin` s after its
    predicted arrival.

    SUCCESS when the ball lies in the cup, unless the external event `ball_caught` ends the run
    first; FAILURE `missed`. ERROR `no_setpoint` if no prediction comes within `patience` s or
    predictions cease long before the ball, and as the servo says.
    """
    following = _Following(ctx, {})
    try:
        result = await following.until(
            lambda state, waited: _await_ball(state, waited, margin, patience), timeout
        )
        if result.cause == "" and ctx.device.state["ball_in_cup"]:
            await ctx.sleep(GRACE)
    finally:
        ctx.device.send({"do": "hold"})  # also when the run is preempted
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
    """Go home, turn the cup over away from the table if something is in it (or `always`), and see
    that it is empty.

    Home first: on the straight way from a catch far aside to where the cup is turned over, the cup
    would meet the table's edge. ERROR `cup_not_empty` if the light barrier stays interrupted after
    so many `attempts`.
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
    """Reset faults, enable the drives again and bring the arm home slowly, and empty the cup if
    a ball lies in it: the next one would find no room. ERROR as the servo says if they stay in
    fault."""
    until = ctx.now + timeout
    why = await _command(ctx, {"do": "reset"})
    if why:
        return error("refused", why)
    if not await ctx.wait(lambda: bool(ctx.device.state["enabled"]), max(0.0, until - ctx.now)):
        return _trouble(ctx.device.state) or error(
            "arm_timeout", f"the drives were not enabled within {timeout} s"
        )
    return await empty_and_home(ctx, speed=speed, timeout=max(0.0, until - ctx.now))


async def _intercept(
    ctx: Context, how: Mapping[str, Any], timeout: float, patience: float, sigma: float
) -> Result:
    """Follow the stream's catch points until the cup is in place for one that is good enough.

    SUCCESS: in place, and the prediction's sigma_y is at most `sigma` (m) or the ball is as good as
    there; FAILURE `late`: the ball's predicted arrival went by before; ERROR: `no_setpoint` (none
    within `patience` s, or they have ceased), `unreachable`, or as the servo says. Following goes
    on but after an ERROR, for `follow_and_wait`.
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
    return result


class _Following:
    """Repeats the `follow` command as the servo asks for, and looks at its state whenever there is
    something new."""

    def __init__(self, ctx: Context, how: Mapping[str, Any]) -> None:
        self._ctx = ctx
        self._how = how
        self._renewed = 0.0

    async def until(
        self, judge: Callable[[Mapping[str, Any], float], Result | None], timeout: float
    ) -> Result:
        """Follow until `judge(state, seconds)` gives a result, the servo is in trouble, or
        `timeout` s are over."""
        ctx = self._ctx
        why = await self._renew()
        if why:
            return _trouble(ctx.device.state) or error("refused", why)
        begun, seen, result = ctx.now, -1, None

        def judged() -> bool:
            nonlocal seen, result
            state = ctx.device.state
            if state["cycles"] != seen:
                seen, result = state["cycles"], _trouble(state) or judge(state, ctx.now - begun)
            return result is not None

        while ctx.now - begun <= timeout:
            if await ctx.wait(judged, min(self._renewed + RENEW, begun + timeout) - ctx.now):
                break
            await self._renew()
        return result or error("arm_timeout", f"nothing came of following in {timeout} s")

    async def _renew(self) -> str:
        self._renewed = self._ctx.now
        return await _command(self._ctx, {"do": "follow", **self._how})


def _await_place(
    state: Mapping[str, Any], waited: float, patience: float, sigma: float
) -> Result | None:
    """What an interception has come to; None while it goes on."""
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
    """What waiting for the ball has come to; None while it goes on."""
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
    """The error of a stream that ended while the ball was still far."""
    if state["reason"] == "no_setpoint" and state["plan"]["arrival"] > IN_FLIGHT:
        return error(
            "no_setpoint",
            f"catch points have ceased: the newest is {state['setpoint_age']:.3f} s old",
        )
    return None


def _point(state: Mapping[str, Any]) -> list[float]:
    plan = state["plan"]
    return [] if plan is None else [float(value) for value in plan["point"]]


def _trouble(state: Mapping[str, Any]) -> Result | None:
    """The servo's first fault as an action's end."""
    if state["faults"]:
        cause, joint, code, text = state["faults"][0]
        return error(cause, text, joint=joint, code=code)
    return None


async def _command(ctx: Context, body: Mapping[str, Any]) -> str:
    """Send a command and wait until the servo has taken it; gives why it was refused, empty if it
    was not."""
    number = ctx.device.send(body)
    if not await ctx.wait(lambda: ctx.device.handled >= number, ANSWER):
        return "the servo does not answer"
    return str(ctx.device.refused)


async def _go(ctx: Context, pose: str, speed: float, until: float) -> Result | None:
    """Move to a named pose; None when it is reached, else how the action ends."""
    why = await _command(ctx, {"do": "move", "pose": pose, "speed": speed})
    if why:
        return _trouble(ctx.device.state) or error("refused", why)

    def over() -> bool:
        state = ctx.device.state
        return bool((state["mode"] == "move" and state["in_place"]) or state["faults"])

    await ctx.sleep(CYCLE)
    if not await ctx.wait(over, max(0.0, until - ctx.now)):
        what = ctx.device.state["guard"] or "still under way"
        return error("arm_timeout", f"pose {pose} not reached in time: {what}")
    return _trouble(ctx.device.state)
