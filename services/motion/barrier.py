"""The light barrier in the cup: from an interrupted beam to a ball that is caught."""

from __future__ import annotations

from typing import Final

BALL_SETTLE: Final = 0.06
"""s for which the beam must be interrupted: a ball that only bounces through does not count."""


class Barrier:
    """A ball counts once it has lain there for `BALL_SETTLE`, and is told of once, if one was
    waited for with an empty cup."""

    def __init__(self) -> None:
        self.interrupted = False
        self.present = False
        self._since = 0.0
        self._wanted = False
        self._armed = False

    def arm(self) -> None:
        """The next ball that comes into the empty cup is one to tell of."""
        self._wanted, self._armed = True, False

    def look(self, now: float, interrupted: bool) -> bool:
        """Take the barrier's state; True once a ball that was waited for has come to stay."""
        if not interrupted:
            self.interrupted = self.present = False
            self._armed = self._armed or self._wanted
            self._wanted = False
            return False
        if not self.interrupted:
            self.interrupted, self._since = True, now
        self.present = now - self._since >= BALL_SETTLE - 1e-9
        told = self.present and self._armed
        self._armed = self._armed and not told
        return told
