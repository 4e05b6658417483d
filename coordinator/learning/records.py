"""The records that a task learns from: choices, ends of runs, corrected verdicts, verdicts of the
task on choices, firings, and ends of trials."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

from msgspec import Struct
from msgspec.structs import replace

from petrobot.coordinator.learning.estimate import Observation
from petrobot.coordinator.task import Status


class Choice(Struct, frozen=True):
    """An action was chosen for a primitive task."""

    primitive_task: str
    action: str
    context: str


class RunEnd(Struct, frozen=True):
    """A run ended."""

    primitive_task: str
    action: str
    context: str
    outcome: Observation


class Correction(Struct, frozen=True):
    """A deferred verdict on a run that ended provisionally before."""

    primitive_task: str
    action: str
    context: str
    was: Observation
    status: Status
    cause: str = ""

    @property
    def outcome(self) -> Observation:
        """The run as it was judged."""
        return replace(self.was, status=self.status, cause=self.cause, judged=True)


class Credit(Struct, frozen=True):
    """The task's verdict on an action that was chosen for a token: SUCCESS if the token met the
    task's goal, with the cost of the whole trial."""

    primitive_task: str
    action: str
    context: str
    outcome: Observation
    beside: tuple[tuple[str, str], ...] = ()
    """(primitive task, action) of everything that ran for the token; only in the first of its
    verdicts."""


class WaitEnd(StrEnum):
    """How a wait ended."""

    LATEST = ""
    """With a firing, measured since the tokens came last: timers, several events at once, and all
    waits in tables that are older than the other ends."""
    FIRED = "fired"
    """The event came, and the transition fired."""
    CAME = "came"
    """The event came, and the transition did not fire at once: its flag is set, another transition
    took the token, or its condition was false."""
    CUT = "cut"
    """Without the event: a token was taken elsewhere, or the trial ended."""


class Waited(NamedTuple):
    """One wait of a transition for its event or timer."""

    transition: str
    seconds: float
    end: WaitEnd = WaitEnd.LATEST

    @property
    def fired(self) -> bool:
        """Whether it ended with a firing."""
        return self.end in (WaitEnd.LATEST, WaitEnd.FIRED)


class Passage(Struct, frozen=True):
    """A transition fired, or a wait for its event ended without a firing."""

    transition: str
    context: str
    waited: float | None = None
    """Seconds of the wait for its event; None if the firing ended none."""
    end: WaitEnd = WaitEnd.FIRED


class TrialEnd(Struct, frozen=True):
    """A trial of the task has ended."""

    context: str
    success: bool
    """It completed, and every run was a SUCCESS."""
    goal: bool
    cost: float | None
    """The sum over its runs; None if one of them reported none."""
    runs: tuple[str, ...]
    """The primitive task of each run."""


Record = Choice | RunEnd | Correction | Credit | Passage | TrialEnd
