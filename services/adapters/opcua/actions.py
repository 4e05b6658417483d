"""Primitive actions on an OPC UA server: write, handshake.

Error causes: `link_lost`, `write_failed`, `already_acknowledged`, `not_acknowledged`,
`not_withdrawn`, `command_refused`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from petrobot import Cancelled, Context, Remote, Result, error, success

WRITING = 5.0
"""Limit of a write (s)."""


async def write(ctx: Context[Remote], *, values: Mapping[str, Any]) -> Result:
    """Write nodes by name, and wait until the server has taken the values."""
    await ctx.command({"write": dict(values)})
    device, number = ctx.device, ctx.device.state["asked"]
    await ctx.wait(lambda: device.state["done"] >= number, WRITING)
    if device.state["done"] < number or not device.state["up"]:
        return error("link_lost", f"it is unknown whether {dict(values)} was written")
    fault = device.state["write_fault"]
    return error("write_failed", fault) if fault else success()


async def handshake(
    ctx: Context[Remote],
    *,
    request: str,
    acknowledge: str,
    value: Any = True,
    idle: Any = False,
    expect: Any = True,
    timeout: float = 10.0,
) -> Result:
    """Request something of a machine: write `request` = `value`, wait until `acknowledge` becomes
    `expect`, withdraw the request by writing `idle`, and wait until the acknowledgement ends. Each
    of the two waits takes at most `timeout` s. The request is also withdrawn if nothing
    acknowledges it, and if the run is cancelled."""
    device = ctx.device

    def acknowledged() -> bool:
        return bool(device.state["values"].get(acknowledge) == expect)

    def lost() -> bool:
        return not device.state["up"]

    def known() -> bool:
        state = device.state
        return lost() or acknowledge in state["values"] or acknowledge in state["faults"]

    await ctx.wait(known, timeout)  # a session begins without values
    if not lost() and acknowledge not in device.state["values"]:
        why = device.state["faults"].get(acknowledge, "the server reports no value")
        return error("not_acknowledged", f"{acknowledge}: {why}; nothing was requested")
    if acknowledged():
        return error("already_acknowledged", f"{acknowledge} is {expect!r} before the request")
    try:
        result = await write(ctx, values={request: value})
        if result.cause:
            return result
        await ctx.wait(lambda: acknowledged() or lost(), timeout)
    except Cancelled:
        device.send({"write": {request: idle}})
        raise
    seen = acknowledged()
    if lost():
        return error("link_lost", f"the link was lost while {request} was {value!r}")
    result = await write(ctx, values={request: idle})
    if result.cause:
        return result
    if not seen:
        why = device.state["faults"].get(acknowledge, f"it did not become {expect!r}")
        return error("not_acknowledged", f"{acknowledge}: {why}")

    def withdrawn() -> bool:
        return acknowledge in device.state["values"] and not acknowledged()

    await ctx.wait(lambda: withdrawn() or lost(), timeout)
    if lost():
        return error("link_lost", f"the link was lost while {acknowledge} was {expect!r}")
    if not withdrawn():
        stays = device.state["faults"].get(acknowledge, f"it stays {expect!r}")
        return error("not_withdrawn", f"{acknowledge}: {stays}")
    return success()
