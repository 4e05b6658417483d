"""Deferred verdicts on the wire: a latched event whose name says which mission run it is for, so
that it is delivered once.

A run's id is its call's, `MISSION/PLACE#NUMBER`. Whoever judges it, on whatever node, raises
`verdict:MISSION` with the data {run, status, cause, text}; the coordinator of that mission run asks
for this name, and says when it has the verdict safe.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from petrobot.services.comm.protocol.codec import NAME_LENGTH

VERDICT_EVENTS: Final = "verdict:"
"""What the names of these events begin with."""
STATUSES: Final = ("success", "failure", "error")


@dataclass(frozen=True, slots=True)
class VerdictSaid:
    """What somebody says that a run really came to."""

    run: str
    """The run's id, as its own context gave it."""
    status: str
    cause: str = ""
    text: str = ""

    def to_data(self) -> dict[str, Any]:
        """The event's data."""
        return {"run": self.run, "status": self.status, "cause": self.cause, "text": self.text}

    @classmethod
    def of_data(cls, data: Mapping[str, Any]) -> VerdictSaid:
        """What `to_data` gave; cause and text may be left out. Raises ValueError naming what does
        not fit."""
        run, status, cause, text = (
            data.get("run"),
            data.get("status"),
            data.get("cause", ""),
            data.get("text", ""),
        )
        if not isinstance(run, str) or not run:
            raise ValueError(
                f"verdict: run is {run!r}; give the run's id as its own context gave it (ctx.run)"
            )
        if status not in STATUSES:
            raise ValueError(f"verdict on {run}: status is {status!r}; give {', '.join(STATUSES)}")
        if not isinstance(cause, str) or not isinstance(text, str):
            raise ValueError(
                f"verdict on {run}: cause and text are texts, not {cause!r} and {text!r}"
            )
        return cls(run, str(status), cause, text)


def mission_of(run: str) -> str:
    """The mission run that a run belongs to. Raises ValueError for what is no run's id."""
    mission, _, place = run.rpartition("/") if isinstance(run, str) else ("", "", "")
    if not mission or not place.rpartition("#")[0] or len(run) > NAME_LENGTH:
        raise ValueError(
            f"{run!r} is no run that can be judged; give what its own context gave as ctx.run"
        )
    return mission


def verdict_event(mission: str) -> str:
    """Name of the event by which runs of this mission run are judged."""
    return VERDICT_EVENTS + mission
