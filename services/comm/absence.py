"""A peer that is not there: which calls wait for it, and what those that do not are told."""

from __future__ import annotations

from typing import Final, NamedTuple

from services.comm.under_way import NEVER, Patience

LOST: Final = "lost"
UNREACHABLE: Final = "unreachable"
REFUSED: Final = "refused"


class Away(NamedTuple):
    """Why a call ends."""

    cause: str
    text: str


class Absence:
    """Of one peer, while there is no link to it."""

    def __init__(self, peer: str, patience: Patience) -> None:
        self._peer = peer
        self._patience = patience
        self._refusal = ""
        self._why = ""
        self._again_from = 0.0
        self.until = NEVER
        """Calls wait until then (s); NEVER: they do not wait."""

    def over(self) -> None:
        """The peer is there."""
        self._refusal, self.until = "", NEVER

    def wait(self, now: float) -> None:
        """A link is being tried for the first time or again: calls wait for it."""
        self._wait_until(
            now + self._patience.reconnect, f"{self._peer} did not come back in {self._patience.reconnect:g} s"
        )

    def refuse(self, code: str, text: str) -> Away:
        """The peer refuses us, until it is there. What all calls are told."""
        self._refusal, self.until = f"{self._peer} refuses the connection: {code}: {text}", NEVER
        return Away(REFUSED, self._refusal)

    def new_call(self, now: float) -> Away | None:
        """What a new call is told at once; None: it waits.

        One that follows another too soon waits a little: a task that tries again at once must not go round as fast as the
        machine can.
        """
        if now < self.until < NEVER:
            return None
        away = Away(REFUSED if self._refusal else UNREACHABLE, self._refusal or f"{self._peer} is not there")
        if now < self._again_from:
            self._wait_until(self._again_from, away.text)
            return None
        self._again_from = now + self._patience.again
        return away

    def advance(self, now: float) -> Away | None:
        """What those that have waited are told now, if anything."""
        if now < self.until:
            return None
        self.until = NEVER
        return Away(REFUSED if self._refusal else LOST, self._why)

    def _wait_until(self, until: float, why: str) -> None:
        self.until, self._why = until, why
