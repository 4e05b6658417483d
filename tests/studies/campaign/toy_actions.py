"""Actions and services of the toy cell. Their random numbers depend on seed and run, and a hard
part is hard for all of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from petrobot.services.action import Context, Result, error, failure, success

HARD = {"easy": 0.1, "rough": 0.5}


async def look(ctx: Context, *, regime: str, seconds: float, share: float) -> Result:
    """Look for a part; a hard one takes twice as long and is missed more often."""
    draw = ctx.random("look")
    hard = bool(draw.random() < HARD[regime])
    await ctx.sleep(seconds * (2.0 if hard else 1.0) * float(draw.uniform(0.8, 1.2)))
    chance = draw.random()
    if chance > share:
        return error("unseen") if chance > 0.5 + share / 2 else failure("blurred", hard=hard)
    return (
        failure("blurred", hard=hard)
        if hard and draw.random() < 0.6
        else success(hard=hard, latency=seconds / 4)
    )


async def grip(ctx: Context, *, hard: bool, force: float, share: float) -> Result:
    """Grip; a hard part is lost half of the time, and sometimes the arm jams."""
    draw = ctx.random("grip")
    await ctx.sleep(float(draw.uniform(0.3, 0.5)))
    if draw.random() < 0.02:
        return error("jammed", force=force)
    met = draw.random() < (0.5 if hard else share)
    return success(force=force) if met else failure("lost", force=force)


async def mend(ctx: Context) -> Result:
    """Repair the arm; one time in four this fails."""
    await ctx.sleep(1.0)
    return success() if ctx.random("mend").random() > 0.25 else error("worn")


def prepare(ctx: Context, *, regime: str, seed: int, runs: int) -> Result:
    """Refuse a regime that does not exist."""
    return (
        success()
        if regime in HARD
        else error("bad_arguments", f"no regime {regime!r}; there are easy and rough")
    )


def score(ctx: Context, *, cycles: Sequence[dict[str, Any]]) -> Result:
    """Return a row for each part, and a picture."""
    rows = [
        {"n": c["n"], "x": 0.1 * c["n"], "y": c["ended_ago"], "gripped": c["status"] != "error"}
        for c in cycles
    ]
    plots = {
        "parts": {
            "title": "Where parts lay",
            "x": "parts.x",
            "y": "parts.y",
            "colour": "parts.gripped",
        }
    }
    return success(parts=rows, plots=plots, total=len(rows))
