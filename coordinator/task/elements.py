"""What a robotic task is made of: primitive tasks, places, transitions, events, variables and
subnets as immutable records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from petrobot.coordinator.task.conditions import Expression

Value = Any
"""Plain data: None, bool, int, float, str, or lists and string-keyed mappings of them."""


class Status(StrEnum):
    """How a run ended (paper, section 4)."""

    SUCCESS = "success"
    FAILURE = "failure"
    ERROR = "error"


class Executed(StrEnum):
    """Whether a run that ended in ERROR touched the world."""

    YES = "yes"
    NO = "no"
    UNKNOWN = "unknown"


class Kind(StrEnum):
    """What a place stands for."""

    ACTION = "action"
    """A primitive task: a token in it is a run of one of its actions."""
    RESOURCE = "resource"
    """Something that runs share: an arm, a camera."""
    CONTROL = "control"
    """Task flow alone; the operator may put tokens in and take them out."""
    MACRO = "macro"
    """A part of the net drawn as one place: a subnet of its own, or the places and transitions that
    name it."""


class End(StrEnum):
    """When an arc out of an action place may take the token."""

    NORMAL = "normal"
    """The run is done with SUCCESS or FAILURE."""
    ERROR = "error"
    """The run is done with ERROR."""
    PREEMPT = "preempt"
    """The run still goes on; it is cancelled."""
    GOING = "going"
    """The run still goes on and keeps going on: the token is only looked at."""


class Counts(StrEnum):
    """How a preempted run counts in its action's estimates."""

    SUCCESS = "success"
    FAILURE = "failure"
    ERROR = "error"
    NONE = "none"
    """Censored: it says nothing about reliability, only that it had lasted so long."""


class Scope(StrEnum):
    """Who detects an event (paper, section 2)."""

    INTERNAL = "internal"
    """A primitive task raises it while its run goes on; it is latched to that run and gone with
    it."""
    EXTERNAL = "external"
    """A sensor, a timer, another node or the operator."""


class Memory(StrEnum):
    """How long an external event is remembered."""

    PULSE = "pulse"
    """It serves the transitions that are enabled when it comes, then it is gone."""
    LATCHED = "latched"
    """A flag that stays set until a firing consumes it."""


class Early(StrEnum):
    """What becomes of a latched event that comes before any transition waits for it."""

    DROP = "drop"
    """It is recorded and forgotten: nothing stale fires later."""
    KEEP = "keep"
    """Its flag is set and waits."""


class Start(StrEnum):
    """Whether a run waits until its device is free."""

    WHEN_FREE = "when_free"
    AT_ONCE = "at_once"
    """For actions such as hold, which must begin although another run on the device has not stopped
    yet."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """What the designer expects of runs that end with one status, until runs have been measured."""

    share: float
    """Probability of the status."""
    mean: float
    """Mean duration (s)."""
    cv: float = 1.0
    """Standard deviation of the duration over its mean; 1 is an exponential law."""


@dataclass(frozen=True, slots=True)
class PrimitiveTask:
    """A step of the task with a goal of its own, translated into one of several primitive actions
    (paper, section 2)."""

    name: str
    goal: str
    alternatives: tuple[str, ...]
    """Names of actions; with more than one, a selector chooses at each start."""
    deadline: float
    """Seconds that a run may take before the runtime ends it with ERROR, cause `deadline`."""
    specification: str = ""
    target_reliability: float = 0.9
    """R_d of docs: cost is taken in the hardest scenario whose reliability is not below it."""
    cost: str = "wall"
    """`wall` or `cpu` (s), `count` (what the result says in `count`, else 1), or `value:NAME`: a
    number of that name in it."""
    error_causes: Mapping[str, str] = field(default_factory=dict)
    """Cause codes that its actions give with ERROR, with a sentence for people."""
    start: Start = Start.WHEN_FREE
    stop_within: float = 2.0
    """Seconds in which a cancelled run has to stop before its device is stopped and its worker
    killed."""
    estimates: Mapping[Status, Estimate] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Reference:
    """An argument that is read from a variable or parameter when the run starts."""

    variable: str


@dataclass(frozen=True, slots=True)
class Place:
    """A place of the net. `x`, `y` are its drawing position (drawing units; y grows downwards)."""

    name: str
    kind: Kind
    tokens: int = 0
    capacity: int | None = None
    task: str = ""
    """Action place: its primitive task."""
    args: Mapping[str, Value] = field(default_factory=dict)
    """Action place: arguments of the action, plain values or `Reference`s."""
    out: Mapping[str, str] = field(default_factory=dict)
    """Action place: which value of the result goes to which variable."""
    servers: int | None = None
    """Action place: how many runs go on at once, further tokens queue; None: one, and a second
    token is a fault."""
    subnet: str = ""
    """Macro place: the subnet that it stands for; empty for one that only shows those that name it
    in `macro`."""
    macro: str = ""
    """Macro place within which it is drawn; empty: none. Its meaning is the same with and
    without."""
    label: str = ""
    x: float | None = None
    y: float | None = None


@dataclass(frozen=True, slots=True)
class Input:
    """An arc from a place to a transition. `end` is set exactly on arcs out of action places (and
    macro places)."""

    place: str
    weight: int = 1
    end: End | None = None
    counts: Counts | None = None
    """Set exactly on `preempt` arcs."""


@dataclass(frozen=True, slots=True)
class Output:
    """An arc from a transition to a place."""

    place: str
    weight: int = 1


@dataclass(frozen=True, slots=True)
class Inhibitor:
    """An arc that disables its transition as soon as the place holds `threshold` tokens."""

    place: str
    threshold: int = 1


@dataclass(frozen=True, slots=True)
class Transition:
    """A transition: what it takes and gives, and what must happen for it to fire."""

    name: str
    inputs: tuple[Input, ...] = ()
    outputs: tuple[Output, ...] = ()
    inhibitors: tuple[Inhibitor, ...] = ()
    events: tuple[str, ...] = ()
    """All must have occurred; at most one of them a pulse."""
    when: Expression | None = None
    priority: int = 0
    """Settles conflicts only: the highest of a conflict set fires."""
    weight: float | None = None
    """Settles conflicts of equal priority by a draw."""
    after: float | None = None
    """Fires so many seconds after its arcs became satisfied."""
    error_branch: bool = False
    """Said to belong to an error branch; those behind an `error` arc belong there without saying
    so."""
    macro: str = ""  # as of a place
    label: str = ""
    x: float | None = None
    y: float | None = None


@dataclass(frozen=True, slots=True)
class Event:
    """A declared event."""

    name: str
    scope: Scope
    memory: Memory = Memory.PULSE
    """External events only; an internal one is always latched to its run."""
    early: Early = Early.DROP
    """Latched external events only."""
    by: str = ""
    """Internal events only: the primitive task that raises it."""
    mean_wait: float | None = None
    """Expected seconds from the moment something waits for it until it comes, for forecasts before
    any measurement."""
    text: str = ""


class VariableType(StrEnum):
    """What a variable may hold."""

    BOOL = "bool"
    INT = "int"
    FLOAT = "float"
    STR = "str"
    ANY = "any"
    """Any plain data; conditions may compare it with none only."""

    def admits(self, value: Value) -> bool:
        """Whether the value is of this type (none is of every type: not written yet)."""
        if value is None or self is VariableType.ANY:
            return True
        if isinstance(value, bool):
            return self is VariableType.BOOL
        kinds: dict[VariableType, tuple[type, ...]] = {
            VariableType.INT: (int,),
            VariableType.FLOAT: (int, float),
            VariableType.STR: (str,),
        }
        return isinstance(value, kinds.get(self, ()))

    @classmethod
    def of(cls, value: Value) -> VariableType:
        """The narrowest type that admits the value."""
        return next(
            t
            for t in (cls.ANY if value is None else cls.BOOL, cls.INT, cls.FLOAT, cls.STR, cls.ANY)
            if t.admits(value)
        )


@dataclass(frozen=True, slots=True)
class Variable:
    """A global-memory variable that conditions and arguments may read."""

    name: str
    type: VariableType
    initial: Value = None
    values: tuple[str, ...] = ()
    """A `str` variable's possible values, if they are few: then `check` can prove that conditions
    cover all cases."""


@dataclass(frozen=True, slots=True)
class Subnet:
    """A net within the net, used through macro places; its names are prefixed with the macro
    place's."""

    name: str
    places: Mapping[str, Place]
    transitions: Mapping[str, Transition]
    entry: str
    """Place that receives the tokens put into the macro place."""
    normal: str
    """Place from which arcs `macro:normal` take."""
    error: str = ""
    """Place from which arcs `macro:error` take."""
