"""Instructions: orders of the engine to its surroundings, and records of what it did."""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from enum import StrEnum

from msgspec import Struct, field

from petrobot.coordinator.task import Counts, Executed, Status, Value
from petrobot.coordinator.task.conditions import ConditionError, parse
from petrobot.coordinator.task.net import Marking
from petrobot.coordinator.task.wording import Severity as Severity


class StartRun(Struct, frozen=True):
    """Start an action. Sent once for each run, when its action is chosen and its device is free."""

    run: str
    place: str
    primitive_task: str
    action: str
    arguments: Mapping[str, Value]
    deadline: float
    """Longest duration of the run (s)."""


class CancelRun(Struct, frozen=True):
    """Stop a run. The answer is `StopConfirmed`, `StopFailed` or, if it ended by itself meanwhile,
    `RunEnded`."""

    run: str
    counts: Counts
    reason: str
    within: float
    """Time in which the device must have stopped (s); after that its worker is killed."""


class HoldRun(Struct, frozen=True):
    """The operator pauses: ask the run to hold. The answer is `RunHeld`."""

    run: str


class ReleaseRun(Struct, frozen=True):
    """Let the run continue after a pause."""

    run: str


class Subject(StrEnum):
    """What a choice is about."""

    ACTION = "action"
    CONFLICT = "conflict"


class Choose(Struct, frozen=True):
    """Choose one of the alternatives. The answer is `Chosen` with the same key.

    For an action, `of` is the primitive task, the key is the run's id, and a selector chooses. For
    a conflict, `of` names the transitions, and the answer is drawn by the weights with a generator
    seeded by (seed, key).
    """

    key: str
    subject: Subject
    of: str
    alternatives: tuple[str, ...]
    weights: tuple[float, ...] = ()


class ArmTimer(Struct, frozen=True):
    """Send `TimerFired` with this key after `seconds`."""

    key: str
    transition: str
    seconds: float


class DisarmTimer(Struct, frozen=True):
    """Cancel the timer."""

    key: str


class HoldTimer(Struct, frozen=True):
    """Stop the timer and keep its remaining time."""

    key: str


class ReleaseTimer(Struct, frozen=True):
    """Let the timer continue with its remaining time."""

    key: str


class Fired(Struct, frozen=True):
    """Record: a transition fired. `cause` is the kind of stimulus, or `stability` if an earlier
    firing made it fireable."""

    number: int
    transition: str
    before: Marking
    after: Marking
    cause: str
    runs: tuple[str, ...] = ()
    """The runs whose tokens it took."""


class Marked(Struct, frozen=True):
    """Record: the operator changed the tokens of a control place, or, without `place`, the mission
    run began at another marking."""

    place: str
    before: Marking
    after: Marking


class RunRecorded(Struct, frozen=True):
    """Record for the estimates: how a run ended. Status None means censored: only its duration
    counts."""

    run: str
    place: str
    primitive_task: str
    action: str
    status: Status | None
    cause: str
    text: str
    executed: Executed
    seconds: float
    cancelled: bool = False
    deferred: bool = False

    @property
    def taken_away(self) -> str:
        """For a run whose token was taken away: by what, and as what it counts; else empty. A
        result of its own is named only if that came before it was stopped."""
        if not self.cancelled:
            return ""
        reason, _, late = self.text.partition("; it had ended with ")
        counts = f"counted as {self.status.value}" if self.status else "not counted"
        own = "" if late in ("", "error, cancelled") else f"; its own result came too late: {late}"
        return f"{reason}, {counts}{own}"


class Corrected(Struct, frozen=True):
    """Record for the estimates: a deferred verdict replaces the recorded status of a run."""

    run: str
    place: str
    action: str
    was: Status
    status: Status
    cause: str = ""
    text: str = ""


class Report(Struct, frozen=True):
    """A message for people. `key` is a fixed word for programs, `of` the element concerned.

    A journal's digest covers the text, too: a message in other words makes older journals that have
    it differ when they are replayed.
    """

    severity: Severity
    key: str
    text: str
    of: str = ""


class Paused(Struct, frozen=True):
    """Record: the net is paused, and why."""

    reason: str


class Resumed(Struct, frozen=True):
    """Record: the net continues; `steps` is 1 for a single firing, 0 for no limit."""

    steps: int = 0


class Finished(Struct, frozen=True):
    """Record: the mission run has finished. SUCCESS: `final` was reached. ERROR: `final_error` was
    reached, or it is dead or aborted."""

    status: Status
    reason: str
    variables: Mapping[str, Value] = field(default_factory=dict)

    @property
    def told(self) -> str:
        """The reason for people: it counts the plain places that must be empty, which the task adds
        to `final`, and names only what the file says. (Journals hold a checksum of `reason`.)"""
        if (found := _WITH_EMPTY_PLACES.fullmatch(self.reason)) is None:
            return self.reason
        with suppress(ConditionError):
            written, empty = parse(found["written"]), found["empty"].count(" == 0")
            more = (
                "the other plain place is" if empty == 1 else f"the other {empty} plain places are"
            )
            return f"{found['what']}{written}, and {more} empty{found['rest']}"
        return self.reason


_WITH_EMPTY_PLACES = re.compile(
    r"(?P<what>final marking reached: )\((?P<written>.*)\)"
    r"(?P<empty>( and [\w.]+ == 0)+)(?P<rest>(;.*)?)",
    re.DOTALL,
)


Instruction = (
    StartRun
    | CancelRun
    | HoldRun
    | ReleaseRun
    | Choose
    | ArmTimer
    | DisarmTimer
    | HoldTimer
    | ReleaseTimer
    | Fired
    | Marked
    | RunRecorded
    | Corrected
    | Report
    | Paused
    | Resumed
    | Finished
)
