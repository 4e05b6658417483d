"""Actions that send a command to a cyclic driver: the action of most devices, which waits until the
device has obeyed it, and how the shipped robots report a fault of one of their drives."""

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


def drive_fault(state: Mapping[str, Any], part: str) -> Result | None:
    """Return the first fault of a driver with drives as the result of an action. Its `faults` are
    rows of cause, name of the drive, code and text; `part` is what the drive moves."""
    if state["faults"]:
        cause, name, code, text = state["faults"][0]
        return error(cause, text, **{part: name}, code=code)
    return None


async def command_drives(ctx: Context, body: Mapping[str, Any], part: str) -> Result | None:
    """Send a command; return the driver's fault if that is why it is refused."""
    try:
        await ctx.command(body)
    except CommandRefused:
        if fault := drive_fault(ctx.device.state, part):
            return fault
        raise
    return None
