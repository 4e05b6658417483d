"""Primitive actions of a toy cell: they take their time and succeed. Scripts (`--mock`) let them
fail."""

from __future__ import annotations

from petrobot.services.action import Context, Result, success

TAKES = 0.3
"""Seconds."""


async def move(ctx: Context) -> Result:
    """Take the time that a movement takes."""
    await ctx.sleep(TAKES)
    return success()
