"""A peer that is not there: which calls wait for it, and what those that do not are told."""

from __future__ import annotations

from typing import Final, NamedTuple

from petrobot.services.comm.calls.active import NEVER, Patience

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
        self._trouble = ""
        """Why there is no link, as far as is known."""
        self._why = ""
        self._again_from = 0.0
        self.until = NEVER
        """Calls wait until then (s); NEVER: they do not wait."""

    def over(self) -> None:
        """The peer is there."""
        self._refusal, self._trouble, self.until = "", "", NEVER

    def wait(self, now: float) -> None:
        """A link is being tried for the first time or again: calls wait for it."""
        self._wait_until(
            now + self._patience.reconnect,
            f"{self._peer} did not come back in {self._patience.reconnect:g} s",
        )

    def fail(self, trouble: str) -> None:
        """An attempt to connect has failed; those that wait go on waiting."""
        self._trouble = trouble

    def give_up(self) -> Away:
        """The peer's process is gone. What all calls are told."""
        self.until = NEVER
        return Away(LOST, f"{self._peer} is gone: nothing listens at its address any more")

    def refuse(self, code: str, text: str) -> Away:
        """The peer refuses us, until it is there. What all calls are told."""
        self._refusal, self.until = f"{self._peer} refuses the connection: {code}: {text}", NEVER
        return Away(REFUSED, self._refusal)

    def new_call(self, now: float) -> Away | None:
        """What a new call is told at once; None: it waits.

        One that follows another too soon waits a little: a task that tries again at once must not
        go round as fast as the machine can.
        """
        if now < self.until < NEVER:
            return None
        text = self._refusal or self._with_trouble(f"{self._peer} is not there")
        away = Away(REFUSED if self._refusal else UNREACHABLE, text)
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
        return Away(
            REFUSED if self._refusal else LOST, self._refusal or self._with_trouble(self._why)
        )

    def _with_trouble(self, text: str) -> str:
        return f"{text} ({self._trouble})" if self._trouble and self._trouble not in text else text

    def _wait_until(self, until: float, why: str) -> None:
        self.until, self._why = until, why
