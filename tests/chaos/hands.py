"""Toy hands for tests with real processes: quick actions that log each execution, and log an
overlap if two move one hand."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from petrobot.services.action import Context, Result, success


class Hand:
    """A device without cyclic work; it stands still unless an action moves it."""

    period = None

    def __init__(self, config: Mapping[str, Any], ports: object) -> None:
        self.held = False

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Refuse commands."""

    def step(self, now: float) -> None:
        """Do nothing: it has no cycle."""

    def state(self) -> Mapping[str, Any]:
        """Return whether it is held."""
        return {"held": self.held}

    def stop(self, now: float) -> None:
        """Do nothing: it stands still."""

    def stopped(self) -> bool:
        """Return True."""
        return True

    def hold(self, now: float) -> str:
        """Hold."""
        self.held = True
        return "held"

    def release(self, now: float) -> None:
        """Continue."""
        self.held = False

    def close(self) -> None:
        """Release nothing."""


async def move(ctx: Context, log: str, hand: str, seconds: float = 0.05) -> Result:
    """Move a hand for a while. The log gets `begin`, `end` and, if another run moves the hand,
    `overlap`."""
    with Path(f"{log}.{hand}").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            note(log, "overlap", ctx.run)
        note(log, "begin", ctx.run)
        await ctx.sleep(seconds)
        note(log, "end", ctx.run)
    return success(moved=hand)


def note(log: str, what: str, run: str) -> None:
    """Append one line to the log, in one write."""
    file = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
    os.write(file, f"{what} {run}\n".encode())
    os.close(file)


async def nothing(ctx: Context) -> Result:
    """End at once; measures the cost of everything around an action."""
    return success()
