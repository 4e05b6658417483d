"""Stimuli: everything that can happen to the engine. All hold plain data, so that a journal can
keep them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import TYPE_CHECKING

from msgspec import Struct, field

from petrobot.coordinator.task import Executed, Status, Value

if TYPE_CHECKING:
    from petrobot.coordinator.engine.state import Run


class Standing(Struct, frozen=True):
    """A token in an action place at the point where a mission run begins."""

    place: str
    status: Status | None = None
    """How its run ended; None: its run starts again."""
    cause: str = ""
    action: str = ""


class Point(Struct, frozen=True):
    """Where a mission run begins, if not at the task's initial marking."""

    marking: Mapping[str, int] = field(default_factory=dict)
    """Tokens by resource and control place; any other place holds none."""
    standing: tuple[Standing, ...] = ()
    """The tokens of action places: first those whose runs have ended, in the order of their ends,
    then the others by age."""
    variables: Mapping[str, Value] = field(default_factory=dict)
    flags: frozenset[str] = frozenset()
    """Latched external events that no firing has consumed."""


class Begin(Struct, frozen=True):
    """The mission run begins, at `point` or at the task's initial marking. `parameters` replace the
    task's defaults; `variables` are the values that the global memory holds."""

    parameters: Mapping[str, Value] = field(default_factory=dict)
    variables: Mapping[str, Value] = field(default_factory=dict)
    point: Point | None = None


class RunStarted(Struct, frozen=True):
    """The node has accepted the run. Optional: a run may also end without it."""

    run: str


class RunEnded(Struct, frozen=True):
    """A run has ended. If it was cancelled, this also means that it has stopped."""

    run: str
    status: Status
    cause: str = ""
    text: str = ""
    executed: Executed = Executed.YES
    values: Mapping[str, Value] = field(default_factory=dict)
    seconds: float = 0.0
    """Duration on the node's clock (s)."""
    deferred: bool = False
    """The status is provisional: the net uses it, but a `Verdict` may correct it once for the
    estimates."""
    cpu_seconds: float | None = None
    """Processor time (s), for the estimates alone; None: not measured."""


class RunRaised(Struct, frozen=True):
    """An active run raised one of its internal events."""

    run: str
    event: str
    number: int = 0
    """Number that its node gave it; 0 without one, as in older journals."""

    def is_repeated(self, run: Run) -> bool:
        """Whether this run raised it before: see `EventOccurred.is_repeated`."""
        return 0 < self.number <= run.heard


class EventOccurred(Struct, frozen=True):
    """An external event. A source numbers its events from 1, so that none is accepted twice; 0 is
    an event without a number."""

    event: str
    source: str = ""
    number: int = 0

    def is_repeated(self, seen: Mapping[str, int]) -> bool:
        """Whether it was accepted before: a source delivers again what a coordinator that died may
        not have received. `seen`: by source, the number of the newest event accepted."""
        return 0 < self.number <= seen.get(self.source, 0)


class TimerFired(Struct, frozen=True):
    """A timer that the engine armed has elapsed."""

    key: str


class VariableChanged(Struct, frozen=True):
    """A watched global-memory variable has a new value."""

    name: str
    value: Value
    source: str = ""


class Chosen(Struct, frozen=True):
    """The answer to a `Choose`: one of its alternatives, and the reason (such as `draw 0.31`,
    `selector: lowest J` or `operator`)."""

    key: str
    alternative: str
    reason: str = ""


class StopConfirmed(Struct, frozen=True):
    """A cancelled run has stopped, or never began (`executed` is then `no`)."""

    run: str
    executed: Executed = Executed.YES
    seconds: float = 0.0


class StopFailed(Struct, frozen=True):
    """A cancelled run could not be stopped in time; its device stays fenced until a later
    `StopConfirmed`."""

    run: str
    text: str = ""


class Verdict(Struct, frozen=True):
    """The deferred verdict on a run: corrects its status once, for the estimates only."""

    run: str
    status: Status
    cause: str = ""
    text: str = ""


class Hold(StrEnum):
    """A node's answer to `HoldRun`."""

    HELD = "held"
    CANNOT = "cannot_hold"
    STOPPED = "stopped"
    """The run could not pause and was stopped; its end follows."""


class RunHeld(Struct, frozen=True):
    """A node's answer to a `HoldRun`."""

    run: str
    answer: Hold


class Pause(Struct, frozen=True):
    """Operator: pause. Nothing fires or starts, and active runs are asked to hold."""

    reason: str = ""


class Resume(Struct, frozen=True):
    """Operator: end the pause."""


class Step(Struct, frozen=True):
    """Operator: let one transition fire, now or as soon as one can, then pause again."""


class SetBreakpoints(Struct, frozen=True):
    """Operator: pause before these transitions fire and after tokens enter these places. Replaces
    the earlier set."""

    names: tuple[str, ...] = ()


class Override(Struct, frozen=True):
    """Operator: always run this alternative of a primitive task; empty: choose freely again."""

    primitive_task: str
    action: str = ""


class AddTokens(Struct, frozen=True):
    """Operator: put tokens into a control place."""

    place: str
    tokens: int = 1


class RemoveTokens(Struct, frozen=True):
    """Operator: take tokens out of a control place."""

    place: str
    tokens: int = 1


class RaiseEvent(Struct, frozen=True):
    """Operator: raise an external event by hand."""

    event: str


class ForceExit(Struct, frozen=True):
    """Operator: fire a transition out of an action place whatever the state of its run, its event,
    its time and its condition. An active run is cancelled and does not count."""

    transition: str


class Abort(Struct, frozen=True):
    """Cancel every run, and end in ERROR when all have stopped: by the operator, by an emergency
    stop, or because nothing could move the task on (`stuck`)."""

    reason: str = ""
    stuck: bool = False


Stimulus = (
    Begin
    | RunStarted
    | RunEnded
    | RunRaised
    | EventOccurred
    | TimerFired
    | VariableChanged
    | Chosen
    | StopConfirmed
    | StopFailed
    | Verdict
    | RunHeld
    | Pause
    | Resume
    | Step
    | SetBreakpoints
    | Override
    | AddTokens
    | RemoveTokens
    | RaiseEvent
    | ForceExit
    | Abort
)
