"""The answer to one question about a net: holds or not, reason, witness, assumption."""

from __future__ import annotations

from typing import Any

from msgspec import Struct, field


class Witness(Struct, frozen=True):
    """A firing sequence from the initial marking that demonstrates a verdict.

    `Net.replay(firings)` repeats it. `marking` holds the marked places after `firings`. `loop`, if
    not empty, can be fired again and again after `firings`: a pump that adds tokens each time, or a
    cycle that the net never leaves.
    """

    firings: tuple[str, ...]
    marking: dict[str, int] = field(default_factory=dict)
    loop: tuple[str, ...] = ()
    steps: tuple[str, ...] = ()
    """Executed tasks only: each stimulus in words, with the firings that it causes."""

    def to_json(self) -> dict[str, Any]:
        """Return plain data."""
        out: dict[str, Any] = {"firings": list(self.firings), "marking": dict(self.marking)}
        out |= {"loop": list(self.loop)} if self.loop else {}
        return out | ({"steps": list(self.steps)} if self.steps else {})


class PropertyVerdict(Struct, frozen=True):
    """Whether a property holds (True, False, or None for unknown), and the reason as a sentence.

    `details` explain the reason, a line each: what else is missing, and where its tokens went.
    `assumption` is the condition under which the verdict on the ordinary net also holds for the
    executed task (empty: it holds as it is). `complete` says whether all reachable markings were
    examined; a False verdict with a witness is valid without that.
    """

    holds: bool | None
    reason: str
    witness: Witness | None = None
    assumption: str = ""
    complete: bool = True
    details: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "holds": self.holds,
            "reason": self.reason,
            "details": list(self.details),
            "witness": self.witness.to_json() if self.witness else None,
            "assumption": self.assumption,
            "complete": self.complete,
        }
