"""Actions and a driver that hang for ever in C with the interpreter's lock held, so that no Python
code runs in their process."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from petrobot.services.action import Context, Result, success

_HOLDING_THE_INTERPRETER = ctypes.PyDLL(None)


def hang() -> None:
    """Never return, and let no other thread run."""
    while True:
        _HOLDING_THE_INTERPRETER.pause()


class Stand:
    """A device that hangs in its cycle once a file is there; without `period` in its configuration
    it has no cycle."""

    def __init__(self, config: Mapping[str, Any], ports: object) -> None:
        self.period = config.get("period")
        self._hangs = Path(str(config["hangs"]))

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Refuse commands."""

    def step(self, now: float) -> None:
        """Hang if the file exists."""
        if self._hangs.exists():
            self._hangs.with_suffix(".hung").touch()
            hang()

    def state(self) -> Mapping[str, Any]:
        """Return nothing."""
        return {}

    def stop(self, now: float) -> None:
        """It stands."""

    def stopped(self) -> bool:
        """It stands."""
        return True

    def hold(self, now: float) -> str:
        """It stands."""
        return "held"

    def release(self, now: float) -> None:
        """It stands."""

    def close(self) -> None:
        """Release nothing."""


async def hang_in_action(ctx: Context, mark: str) -> Result:
    """Report that it hangs, then hang."""
    Path(mark).touch()
    hang()
    return success()


def hang_in_service(ctx: Context, mark: str) -> Result:
    """A service that should be quick, but hangs in its node's event loop."""
    Path(mark).touch()
    hang()
    return success()
