"""Primitive actions of a toy cell: they wait and succeed. Scripts (`--mock`) make them fail."""

from __future__ import annotations

from petrobot.services.action import Context, Result, success

TAKES = 0.3
"""Duration (s)."""


async def move(ctx: Context) -> Result:
    """Wait as long as a movement takes."""
    await ctx.sleep(TAKES)
    return success()
