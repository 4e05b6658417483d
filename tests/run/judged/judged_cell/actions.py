"""Actions of a cell whose picks are judged later: by an inspection on another node, by the score,
or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from petrobot.services.action import Context, Result, failure, provisional, success


def number(run: str) -> int:
    """Return the number of the pick, counted from 1."""
    return int(run.rpartition("#")[2])


async def pick(ctx: Context, *, side: str) -> Result:
    """Pick a part. Whether it is held well is known only later, so the result contains the run's
    id."""
    await ctx.sleep(0.05)
    return provisional(success(held=ctx.run, side=side))


async def inspect(ctx: Context, *, run: str) -> Result:
    """Inspect a picked part: the first and fourth are crooked (the first gets two verdicts), the
    third and sixth cannot be seen."""
    await ctx.sleep(0.05)
    if number(run) in (1, 4):
        ctx.verdict(run, failure("crooked", "held by a corner"))
    if number(run) in (1, 2, 5):
        ctx.verdict(run, success())
    if number(run) == 5:
        ctx.verdict(run.replace("pick", "inspect"), failure("sure"))  # it was never provisional
    return success()


def score(ctx: Context, *, cycles: Sequence[dict[str, Any]]) -> Result:
    """The third part was found on the floor in the evening."""
    hidden = [one for cycle in cycles for one in cycle.get("provisional", ())]
    fell = {
        one["run"]: {"status": "failure", "cause": "fell"}
        for one in hidden
        if number(one["run"]) == 3
    }
    rows = [{"n": cycle["n"], "held": cycle["status"]} for cycle in cycles]
    return success(parts=rows, hidden=[one["run"] for one in hidden], verdicts=fell)
