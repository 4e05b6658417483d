"""Actions of a UR arm: enable, moves, digital outputs, a gripper on an output.

Causes of an ERROR: `refused` (the text says why), `protective_stop`, `emergency_stop`,
`safeguard_stop`, `link_lost`, `program_lost`, `power_off`, `stopped` (it stopped at another place)
and `late`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from petrobot import CommandRefused, Context, Remote, Result, error, failure, success


async def enable(ctx: Context[Remote], *, timeout: float = 30.0) -> Result:
    """Power on, release the brakes and start the program; unlocks a protective stop."""
    await ctx.command({"do": "enable"})
    state = ctx.device
    await ctx.wait(lambda: state.state["enabled"] or bool(state.state["fault"]), timeout)
    if state.state["enabled"]:
        return success()
    return error(state.state["fault"] or "late", state.state["reason"])


async def move_joints(
    ctx: Context[Remote], *, q: list[float], speed: float = 1.0, timeout: float = 30.0
) -> Result:
    """Move to six joint angles (rad), all arriving together, at a share of the speed."""
    return await _move(ctx, {"do": "move", "q": q, "speed": speed}, timeout)


async def move_linear(
    ctx: Context[Remote], *, pose: list[float], speed: float = 1.0, timeout: float = 30.0
) -> Result:
    """Move the tool straight to a pose: x, y, z (m) and a rotation vector (rad), base frame."""
    return await _move(ctx, {"do": "linear", "pose": pose, "speed": speed}, timeout)


async def _move(ctx: Context[Remote], command: Mapping[str, Any], timeout: float) -> Result:
    try:
        await ctx.command(command)
    except CommandRefused as fault:
        return error("refused", str(fault))
    device = ctx.device
    ended = await ctx.wait(
        lambda: device.state["in_place"] or device.state["mode"] != "move", timeout
    )
    # the arm follows the last set points with a small delay
    await ctx.wait(lambda: device.state["in_place"] or device.state["mode"] == "off", 1.0)
    state = device.state
    if state["in_place"]:
        return success(q=state["q"], tool=state["tool"])
    if not ended:
        await ctx.command({"do": "rest"})
        return error("late", f"not there after {timeout:g} s")
    return error(state["fault"] or "stopped", state["reason"] or "it rests on its way")


async def set_digital_out(ctx: Context[Remote], *, bit: int, value: bool) -> Result:
    """Set a digital output, and wait until the controller reports it."""
    try:
        await ctx.command({"do": "output", "bit": bit, "value": value})
    except CommandRefused as fault:
        return error("refused", str(fault))
    if not await ctx.wait(lambda: bool(ctx.device.state["outputs"] >> bit & 1) is value, 1.0):
        return error("late", f"the controller does not report output {bit} as {value}")
    return success()


async def gripper(
    ctx: Context[Remote], *, close: bool, bit: int = 0, seconds: float = 0.5, holds: int = -1
) -> Result:
    """Close or open a gripper on a digital output; `holds` is the digital input that shows that it
    holds something (-1: none). FAILURE `empty`: it closed on nothing."""
    done = await set_digital_out(ctx, bit=bit, value=close)
    if done.status != "success":
        return done
    await ctx.sleep(seconds)
    if close and holds >= 0 and not ctx.device.state["inputs"] >> holds & 1:
        return failure("empty", "the gripper closed on nothing")
    return success()
