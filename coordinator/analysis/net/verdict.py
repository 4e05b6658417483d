"""What every answer of the analysis carries: verdict, reason, witness, assumption, and whether the
search was complete."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class Witness:
    """A firing sequence from the initial marking that shows the verdict; `Net.replay(firings)`
    repeats it.

    `loop` may be fired again and again after `firings` (a pump, or a cycle that is never left);
    `marking` is the marked places after `firings`.
    """

    firings: tuple[str, ...]
    marking: dict[str, int] = field(default_factory=dict)
    loop: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        out: dict[str, Any] = {"firings": list(self.firings), "marking": dict(self.marking)}
        return out | ({"loop": list(self.loop)} if self.loop else {})


@dataclass(frozen=True, slots=True)
class PropertyVerdict:
    """`holds` is True, False or None (unknown); `reason` says why in words for people.

    `assumption` is what it takes for the verdict on the ordinary net to hold for the executed task
    (empty: nothing more); `complete` whether all reachable markings stand behind it (a False
    verdict with a witness needs no complete search).
    """

    holds: bool | None
    reason: str
    witness: Witness | None = None
    assumption: str = ""
    complete: bool = True

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "holds": self.holds,
            "reason": self.reason,
            "witness": self.witness.to_json() if self.witness else None,
            "assumption": self.assumption,
            "complete": self.complete,
        }
