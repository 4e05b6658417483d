"""Stimuli: everything that can happen to the engine. All carry plain data, so that a journal can
hold them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from petrobot.coordinator.task import Executed, Status, Value


@dataclass(frozen=True, slots=True)
class Standing:
    """A token in an action place where a mission run begins: its run begins anew, or is over with a
    status."""

    place: str
    status: Status | None = None
    """How it ended; None: it begins anew."""
    cause: str = ""
    action: str = ""


@dataclass(frozen=True, slots=True)
class Point:
    """Where a mission run begins that does not begin at the task's own beginning."""

    marking: Mapping[str, int] = field(default_factory=dict)
    """Tokens by resource and control place; places that are not named hold none."""
    standing: tuple[Standing, ...] = ()
    """The tokens of action places: those whose runs are over first, in the order in which they
    ended, then by age."""
    variables: Mapping[str, Value] = field(default_factory=dict)
    flags: frozenset[str] = frozenset()
    """Latched external events that have come and wait."""


@dataclass(frozen=True, slots=True)
class Begin:
    """The mission run begins. Given parameters replace the task's defaults; `variables` are what
    global memory holds.

    With a `point` it begins there and not at the task's initial marking.
    """

    parameters: Mapping[str, Value] = field(default_factory=dict)
    variables: Mapping[str, Value] = field(default_factory=dict)
    point: Point | None = None


@dataclass(frozen=True, slots=True)
class RunStarted:
    """The node has accepted the run. Optional: a run may also end without it."""

    run: str


@dataclass(frozen=True, slots=True)
class RunEnded:
    """A run is done. For a run that was cancelled it also says that it has stopped."""

    run: str
    status: Status
    cause: str = ""
    text: str = ""
    executed: Executed = Executed.YES
    values: Mapping[str, Value] = field(default_factory=dict)
    seconds: float = 0.0
    """How long it took on the node's clock."""
    deferred: bool = False
    """The status serves for routing; a `Verdict` may correct it once for the estimates."""
    cpu_seconds: float | None = None
    """Processor time that it took; None: not measured. It moves nothing, the estimates keep it."""


@dataclass(frozen=True, slots=True)
class RunRaised:
    """A run that goes on raised one of its internal events."""

    run: str
    event: str


@dataclass(frozen=True, slots=True)
class EventOccurred:
    """An external event. `number` counts up by source from 1 so that none is taken twice; 0 stands
    outside that order."""

    event: str
    source: str = ""
    number: int = 0


@dataclass(frozen=True, slots=True)
class TimerFired:
    """A timer that the engine armed is over."""

    key: str


@dataclass(frozen=True, slots=True)
class VariableChanged:
    """A watched global-memory variable has a new value."""

    name: str
    value: Value
    source: str = ""


@dataclass(frozen=True, slots=True)
class Chosen:
    """The answer to a `Choose`: one of its alternatives, and why (`draw 0.31`, `selector: lowest
    J`, `operator`)."""

    key: str
    alternative: str
    reason: str = ""


@dataclass(frozen=True, slots=True)
class StopConfirmed:
    """A cancelled run is known to have stopped (or never to have begun: `executed` is then
    `no`)."""

    run: str
    executed: Executed = Executed.YES
    seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class StopFailed:
    """A cancelled run could not be stopped in its time; its device stays fenced until a later
    `StopConfirmed`."""

    run: str
    text: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The deferred verdict on a run: corrects its status once, for the estimates alone."""

    run: str
    status: Status
    cause: str = ""
    text: str = ""


class Hold(StrEnum):
    """A node's answer to `HoldRun`."""

    HELD = "held"
    CANNOT = "cannot_hold"
    STOPPED = "stopped"
    """The run could only be stopped; its end follows."""


@dataclass(frozen=True, slots=True)
class RunHeld:
    """What became of a run that was to hold."""

    run: str
    answer: Hold


@dataclass(frozen=True, slots=True)
class Pause:
    """Operator: nothing fires or starts from now on, and running actions are asked to hold."""

    reason: str = ""


@dataclass(frozen=True, slots=True)
class Resume:
    """Operator: go on."""


@dataclass(frozen=True, slots=True)
class Step:
    """Operator: one firing, now or, if nothing can fire yet, as soon as something can; then paused
    again."""


@dataclass(frozen=True, slots=True)
class SetBreakpoints:
    """Operator: pause before these transitions fire and after tokens enter these places (replaces
    the earlier set)."""

    names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Override:
    """Operator: this alternative of a primitive task is run from now on; empty: the choice is free
    again."""

    primitive_task: str
    action: str = ""


@dataclass(frozen=True, slots=True)
class AddTokens:
    """Operator: put tokens into a control place."""

    place: str
    tokens: int = 1


@dataclass(frozen=True, slots=True)
class RemoveTokens:
    """Operator: take tokens out of a control place."""

    place: str
    tokens: int = 1


@dataclass(frozen=True, slots=True)
class RaiseEvent:
    """Operator: raise an external event by hand."""

    event: str


@dataclass(frozen=True, slots=True)
class ForceExit:
    """Operator: fire a transition out of an action place whatever its run does, its event, time and
    condition.

    A run that still goes on is cancelled and counts none.
    """

    transition: str


@dataclass(frozen=True, slots=True)
class Abort:
    """Operator: cancel every run and end in ERROR once all have stopped."""

    reason: str = ""


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

OPERATOR = (
    Pause,
    Resume,
    Step,
    SetBreakpoints,
    Override,
    AddTokens,
    RemoveTokens,
    RaiseEvent,
    ForceExit,
    Abort,
)
"""The stimuli that only the operator who holds the controls may send."""
