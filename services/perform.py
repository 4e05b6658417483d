"""The action of most devices: send a command, and wait until the device has obeyed it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from petrobot.services.action import CommandRefused, Context, Result, error, success
from petrobot.services.device import Remote


async def perform(
    ctx: Context[Remote],
    command: Mapping[str, Any],
    done: Callable[[Mapping[str, Any]], bool],
    timeout: float,
) -> Result:
    """Send a command to a cyclic driver, and wait until `done(state)`.

    The driver's state has `faults`: what is wrong, by code; empty if nothing is. Return SUCCESS, or
    ERROR with the code and text of a fault, or ERROR `late` after `timeout` s; the driver is then
    told to stop by the command `{"do": "rest"}`. A refusal without a fault ends the run in ERROR
    `command_refused`.
    """
    device = ctx.device
    try:
        await ctx.command(command)
    except CommandRefused:
        for cause, text in device.state["faults"].items():
            return error(cause, text)
        raise
    await ctx.wait(lambda: bool(device.state["faults"]) or done(device.state), timeout)
    for cause, text in device.state["faults"].items():
        return error(cause, text)
    if done(device.state):
        return success()
    reason = device.state.get("reason", "")
    await ctx.command({"do": "rest"})
    return error("late", f"not done after {timeout:g} s {reason}".rstrip())
