"""Toy hands for tests with real processes: quick actions that leave a line for each execution and
notice a second performer."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from petrobot.services.action import Context, Result, success


class Hand:
    """A device without cyclic duty that stands still whenever nobody moves it."""

    period = None

    def __init__(self, config: Mapping[str, Any], ports: object) -> None:
        self.held = False

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Takes none."""

    def step(self, now: float) -> None:
        """No cycle."""

    def state(self) -> Mapping[str, Any]:
        """Whether it is held."""
        return {"held": self.held}

    def stop(self, now: float) -> None:
        """It stands still."""

    def stopped(self) -> bool:
        """Always."""
        return True

    def hold(self, now: float) -> str:
        """It can."""
        self.held = True
        return "held"

    def release(self, now: float) -> None:
        """Go on."""
        self.held = False

    def close(self) -> None:
        """Nothing to let go."""


async def move(ctx: Context, log: str, hand: str, seconds: float = 0.05) -> Result:
    """Move a hand for a while. The log gets `begin`, `end` and, if somebody else moves the hand,
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
    """One line, in one write."""
    file = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
    os.write(file, f"{what} {run}\n".encode())
    os.close(file)


async def nothing(ctx: Context) -> Result:
    """End at once: what is left is what everything around it costs."""
    return success()
