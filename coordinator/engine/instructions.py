"""Instructions: what the engine asks of the world, and what it records of itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from petrobot.coordinator.task import Counts, Executed, Status, Value
from petrobot.coordinator.task.net import Marking
from petrobot.coordinator.task.wording import Severity as Severity


@dataclass(frozen=True, slots=True)
class StartRun:
    """Start an action. Sent once for each run, when its action is chosen and its device free."""

    run: str
    place: str
    primitive_task: str
    action: str
    arguments: Mapping[str, Value]
    deadline: float
    """Seconds that the run may take."""


@dataclass(frozen=True, slots=True)
class CancelRun:
    """Stop a run; to be answered by `StopConfirmed`, `StopFailed` or, when it ended by itself
    meanwhile, `RunEnded`."""

    run: str
    counts: Counts
    reason: str
    within: float
    """Seconds until the device's stop routine and the end of its worker are due."""


@dataclass(frozen=True, slots=True)
class HoldRun:
    """The operator pauses: the run is asked to hold; to be answered by `RunHeld`."""

    run: str


@dataclass(frozen=True, slots=True)
class ReleaseRun:
    """The run goes on after a pause."""

    run: str


class Subject(StrEnum):
    """What a choice is about."""

    ACTION = "action"
    CONFLICT = "conflict"


@dataclass(frozen=True, slots=True)
class Choose:
    """Choose one of the alternatives; to be answered by `Chosen` with the same key.

    For an action, `of` is the primitive task and the key is the run's id: a selector decides. For a
    conflict, `of` are the transitions' names and the answer is drawn by the weights from a
    generator keyed by (seed, key).
    """

    key: str
    subject: Subject
    of: str
    alternatives: tuple[str, ...]
    weights: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class ArmTimer:
    """Send `TimerFired` with this key after so many seconds."""

    key: str
    transition: str
    seconds: float


@dataclass(frozen=True, slots=True)
class DisarmTimer:
    """The timer is not wanted any more."""

    key: str


@dataclass(frozen=True, slots=True)
class HoldTimer:
    """Stop the timer; what is left of it is kept."""

    key: str


@dataclass(frozen=True, slots=True)
class ReleaseTimer:
    """The timer goes on with what is left."""

    key: str


@dataclass(frozen=True, slots=True)
class Fired:
    """Record: a transition fired. `cause` is the kind of stimulus (or `stability`: it needed
    nothing more)."""

    number: int
    transition: str
    before: Marking
    after: Marking
    cause: str
    runs: tuple[str, ...] = ()
    """Runs whose tokens it took."""


@dataclass(frozen=True, slots=True)
class Marked:
    """Record: the operator changed the tokens of a control place, or the mission run began at
    another marking (no `place`)."""

    place: str
    before: Marking
    after: Marking


@dataclass(frozen=True, slots=True)
class RunRecorded:
    """Record for the estimates: how a run that began ended. Status None is a censored run: it only
    lasted so long."""

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
        counts = f"counts as {self.status.value.upper()}" if self.status else "is not counted"
        own = "" if late in ("", "error, cancelled") else f"; its own result came too late: {late}"
        return f"{reason}, which {counts}{own}"


@dataclass(frozen=True, slots=True)
class Corrected:
    """Record for the estimates: a deferred verdict replaces the status of a run that was recorded
    before."""

    run: str
    place: str
    action: str
    was: Status
    status: Status
    cause: str = ""
    text: str = ""


@dataclass(frozen=True, slots=True)
class Report:
    """Something that people should know. `key` is a fixed word for programs, `of` the element that
    it is about."""

    severity: Severity
    key: str
    text: str
    of: str = ""


@dataclass(frozen=True, slots=True)
class Paused:
    """Record: nothing fires from now on, and why."""

    reason: str


@dataclass(frozen=True, slots=True)
class Resumed:
    """Record: the net goes on; `steps` is 1 for a single firing, 0 for no limit."""

    steps: int = 0


@dataclass(frozen=True, slots=True)
class Finished:
    """Record: the mission run is over. SUCCESS: `final` was reached. ERROR: given up, dead, or
    aborted."""

    status: Status
    reason: str
    variables: Mapping[str, Value] = field(default_factory=dict)


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

ORDERS = (
    StartRun,
    CancelRun,
    HoldRun,
    ReleaseRun,
    Choose,
    ArmTimer,
    DisarmTimer,
    HoldTimer,
    ReleaseTimer,
)
"""The instructions that someone has to carry out; all others are records."""
