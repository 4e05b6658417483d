"""Actions of a UR arm: enable, moves, digital outputs, a gripper on an output.

Causes of an ERROR: `command_refused` (the text says why), `protective_stop`, `emergency_stop`,
`safeguard_stop`, `link_lost`, `program_lost`, `power_off`, `stopped` (it stopped at another place)
and `late`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from petrobot import Context, Remote, Result, error, failure, perform, success


async def enable(ctx: Context[Remote], *, timeout: float = 30.0) -> Result:
    """Power on, release the brakes and start the program; unlocks a protective stop."""
    return await perform(ctx, {"do": "enable"}, lambda state: state["ready"], timeout)


async def move_joints(
    ctx: Context[Remote], *, joints: list[float], speed: float = 1.0, timeout: float = 30.0
) -> Result:
    """Move to six joint angles (rad), all arriving together, at a share of the speed."""
    return await _move(ctx, {"do": "move", "joints": joints, "speed": speed}, timeout)


async def move_linear(
    ctx: Context[Remote], *, pose: list[float], speed: float = 1.0, timeout: float = 30.0
) -> Result:
    """Move the tool straight to a pose: x, y, z (m) and a rotation vector (rad), base frame."""
    return await _move(ctx, {"do": "linear", "pose": pose, "speed": speed}, timeout)


async def _move(ctx: Context[Remote], command: Mapping[str, Any], timeout: float) -> Result:
    ended = await perform(ctx, command, lambda state: state["mode"] != "move", timeout)
    state = ctx.device.state
    if ended.cause or state["at_goal"]:
        return ended if ended.cause else success(q=state["q"], tool=state["tool"])
    return error("stopped", state["reason"] or "it rests on its way")


async def set_digital_out(ctx: Context[Remote], *, bit: int, value: bool) -> Result:
    """Set a digital output, and wait until the controller reports it."""
    await ctx.command({"do": "output", "bit": bit, "value": value})
    if not await ctx.wait(lambda: bool(ctx.device.state["outputs"] >> bit & 1) is value, 1.0):
        return error("late", f"the controller does not report output {bit} as {value}")
    return success()


async def gripper(
    ctx: Context[Remote], *, close: bool, bit: int = 0, seconds: float = 0.5, holds: int = -1
) -> Result:
    """Close or open a gripper on a digital output; `holds` is the digital input that shows that it
    holds something (-1: none). FAILURE `empty`: it closed on nothing."""
    done = await set_digital_out(ctx, bit=bit, value=close)
    if done.cause:
        return done
    await ctx.sleep(seconds)
    if close and holds >= 0 and not ctx.device.state["inputs"] >> holds & 1:
        return failure("empty", "the gripper closed on nothing")
    return success()
