"""Waiting in tests: for conditions, never for a guess at how long something takes."""

from __future__ import annotations

import asyncio


async def beat(seconds: float = 0.005) -> None:
    """Let the loop go on for so long: between two looks at a condition, or as a storm draws it."""
    over = asyncio.Event()
    asyncio.get_running_loop().call_later(seconds, over.set)
    await over.wait()
