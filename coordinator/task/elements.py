"""What a robotic task is made of: primitive tasks, places, transitions, events, variables and
subnets as immutable records."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import Any

from msgspec import Struct, field

from petrobot.coordinator.task.conditions import Expression

Value = Any
"""Plain data: None, bool, int, float, str, or lists and string-keyed mappings of them."""


class Status(StrEnum):
    """How a run ended (paper, section 4)."""

    __hash__ = str.__hash__  # that of Enum is slow

    SUCCESS = "success"
    FAILURE = "failure"
    ERROR = "error"


class Executed(StrEnum):
    """Whether a run that ended in ERROR touched the world."""

    YES = "yes"
    NO = "no"
    UNKNOWN = "unknown"


class Kind(StrEnum):
    """What a token in a place means."""

    ACTION = "action"
    """A primitive task: a token in it is a run of one of its actions."""
    RESOURCE = "resource"
    """Something that several runs share, such as an arm or a camera."""
    CONTROL = "control"
    """Task flow alone; the operator may put tokens in and take them out."""
    PLAIN = "plain"
    """A token on its way; the file leaves `kind` out. It must be empty at the end, unless `final`
    names it."""
    MACRO = "macro"
    """A part of the net drawn as one place: a subnet of its own, or the places and transitions that
    name it."""


class End(StrEnum):
    """When an arc from an action place may take the token."""

    NORMAL = "normal"
    """The run has ended with SUCCESS or FAILURE."""
    ERROR = "error"
    """The run has ended with ERROR."""
    PREEMPT = "preempt"
    """The run is still active; the firing cancels it."""
    GOING = "going"
    """The run is active and stays so: the arc only tests for the token."""


class Counts(StrEnum):
    """How a preempted run counts in its action's estimates."""

    SUCCESS = "success"
    FAILURE = "failure"
    ERROR = "error"
    NONE = "none"
    """Censored: the run does not count for reliability; it only shows that it lasted at least so
    long."""


class Scope(StrEnum):
    """Who detects an event (paper, section 2)."""

    INTERNAL = "internal"
    """Raised by an active run of a primitive task. It is latched to that run and disappears with
    it."""
    EXTERNAL = "external"
    """A sensor, a timer, another node or the operator."""


class EventMemory(StrEnum):
    """How long an external event is remembered."""

    PULSE = "pulse"
    """It serves the transitions that are enabled when it occurs, then it disappears."""
    LATCHED = "latched"
    """A flag that stays set until a firing consumes it."""


class EarlyEvent(StrEnum):
    """What happens to a latched event that occurs before any transition waits for it."""

    DROP = "drop"
    """It is recorded and dropped, so that nothing fires on an old event."""
    KEEP = "keep"
    """Its flag is set and stays set until a firing consumes it."""


class Start(StrEnum):
    """Whether a run waits until its device is free."""

    WHEN_FREE = "when_free"
    AT_ONCE = "at_once"
    """For actions such as hold, which must start although another run on the device has not stopped
    yet."""


class Estimate(Struct, frozen=True):
    """What the designer expects of runs that end with one status, before runs were measured."""

    share: float
    """Probability of the status."""
    mean: float
    """Mean duration (s)."""
    cv: float = 1.0
    """Standard deviation of the duration over its mean; 1 for the exponential distribution."""


class PrimitiveTask(Struct, frozen=True):
    """A step of the task with its own goal, carried out by one of several actions (paper, section
    2)."""

    name: str
    goal: str
    """What its success means, in one sentence for people."""
    alternatives: tuple[str, ...]
    """Names of actions. If there are several, a selector chooses one at each start."""
    deadline: float
    """Longest run (s). The runtime ends a longer one with ERROR, cause `deadline`."""
    specification: str = ""
    target_reliability: float | None = None
    """R_d (docs/learning.md): the cost is that of the hardest scenario with at least this
    reliability; None: of the hardest one."""
    cost: str = "wall"
    """Measure of the cost of a run: `wall` or `cpu` (s), `count` (the result's value `count`, else
    1), or `value:NAME` (that value of the result)."""
    error_causes: Mapping[str, str] = field(default_factory=dict)
    """Codes of the causes that its actions may return with ERROR, each with a sentence for
    people."""
    start: Start = Start.WHEN_FREE
    stop_within: float = 2.0
    """Time for a cancelled run to stop (s); then its device is stopped and its worker killed."""
    estimates: Mapping[Status, Estimate] = field(default_factory=dict)
    costs: Mapping[str, float] = field(default_factory=dict)
    """What a run of each action costs as far as it is known before any run, in the unit of `cost`;
    used until runs of the action were measured."""


class Reference(Struct, frozen=True):
    """An argument that is read from a variable or parameter: when the run starts, or, for a
    variable that some transition sets, when the token enters the place."""

    variable: str


MOST_TOKENS = 1_000_000_000
"""Most tokens that a task file or the operator may put into a place: a slip of the finger must not
become a number that no journal can store."""


class Place(Struct, frozen=True):
    """A place of the net. `x`, `y` are its drawing position (drawing units; y grows downwards)."""

    name: str
    kind: Kind
    tokens: int = 0
    capacity: int | None = None
    task: str = ""
    """Action place: its primitive task."""
    args: Mapping[str, Value] = field(default_factory=dict)
    """Action place: arguments of the action. Macro place: what the parameters of its subnet stand
    for. Plain values or `Reference`s."""
    out: Mapping[str, str] = field(default_factory=dict)
    """Action place: which value of the result goes to which variable."""
    servers: int | None = None
    """Action place: as the file says it; None: one run at a time, and a second token is a fault."""
    tries: int = 1
    """Action place: largest number of runs for one token, as long as each ends in ERROR."""
    retry_unknown: bool = False
    """Action place: also try again when it is not known whether the failed run was executed."""
    timeout: float | None = None
    """Action place: seconds that a run may take here; shorter than the deadline of its primitive
    task."""
    listen: bool = False
    """Its token may be left at the end: a branch that always waits for an event."""
    holds: tuple[str, ...] = ()
    """Resource places from which a token in this place holds one token each."""
    subnet: str = ""
    """Macro place: the subnet that it stands for; empty if it only groups the elements that name it
    in `macro`."""
    macro: str = ""
    """Macro place within which it is drawn; empty: none. Its meaning is the same with and
    without."""
    expanded_from: str = ""
    """Element of the file that this place was made from (`expansion`); empty if it stands
    there."""
    label: str = ""
    x: float | None = None
    y: float | None = None

    @property
    def most_active(self) -> int:
        """Action place: the most runs that are active at once; further tokens queue."""
        return self.servers or 1


class Input(Struct, frozen=True):
    """An arc from a place to a transition. `end` is set exactly on arcs out of action places (and
    macro places)."""

    place: str
    weight: int = 1
    end: End | None = None
    counts: Counts | None = None
    """Set exactly on `preempt` arcs."""


class Output(Struct, frozen=True):
    """An arc from a transition to a place."""

    place: str
    weight: int = 1


class Inhibitor(Struct, frozen=True):
    """An arc that disables its transition as soon as the place holds `threshold` tokens."""

    place: str
    threshold: int = 1


class Transition(Struct, frozen=True):
    """A transition: its arcs, and what must happen before it fires."""

    name: str
    inputs: tuple[Input, ...] = ()
    outputs: tuple[Output, ...] = ()
    inhibitors: tuple[Inhibitor, ...] = ()
    events: tuple[str, ...] = ()
    """Events that must all have occurred; at most one of them may be a pulse."""
    when: Expression | None = None
    priority: int = 0
    """Decides conflicts only: of transitions in conflict, that with the highest priority fires."""
    weight: float | None = None
    """Decides conflicts of equal priority by a random draw with these weights."""
    after: float | None = None
    """Seconds after which it fires, counted from when its arcs became satisfied."""
    sets: tuple[tuple[str, Expression], ...] = ()
    """Variables that its firing writes, with their new values: a literal, a variable or a
    parameter each. Conditions of the same step still read the old values."""
    error_branch: bool = False
    """Whether it is declared to be part of an error branch. Transitions behind an `error` arc are
    part of one anyway."""
    macro: str = ""  # as of a place
    expanded_from: str = ""  # as of a place
    label: str = ""
    x: float | None = None
    y: float | None = None

    @property
    def copy_of(self) -> str:
        """The transition of which `tries` made this copy, one for each number of used tries (their
        names end in these numbers); its own name if it is none."""
        original, _, number = self.name.rpartition(".")
        return original if self.expanded_from and number[:1].isdigit() else self.name


class Event(Struct, frozen=True):
    """A declared event."""

    name: str
    scope: Scope
    memory: EventMemory = EventMemory.PULSE
    """External events only; an internal one is always latched to its run."""
    early: EarlyEvent = EarlyEvent.DROP
    """Latched external events only."""
    by: str = ""
    """Internal events only: the primitive task that raises it."""
    mean_wait: float | None = None
    """Expected time from when a transition waits for it until it occurs (s), for forecasts before
    any measurement."""
    text: str = ""


class VariableType(StrEnum):
    """What a variable may hold."""

    BOOL = "bool"
    INT = "int"
    FLOAT = "float"
    STR = "str"
    ANY = "any"
    """Any plain data. Conditions may only compare it with none."""

    def admits(self, value: Value) -> bool:
        """Whether the value is of this type. None, for not written yet, is of every type."""
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

    def holds(self, other: VariableType) -> bool:
        """Whether every value of the other type is of this one."""
        return self in (other, VariableType.ANY) or (
            self is VariableType.FLOAT and other is VariableType.INT
        )

    @classmethod
    def of(cls, value: Value) -> VariableType:
        """Return the narrowest type that admits the value."""
        return next(
            t
            for t in (cls.ANY if value is None else cls.BOOL, cls.INT, cls.FLOAT, cls.STR, cls.ANY)
            if t.admits(value)
        )


class Variable(Struct, frozen=True):
    """A global-memory variable that conditions and arguments may read."""

    name: str
    type: VariableType
    initial: Value = None
    values: tuple[str, ...] = ()
    """Possible values of a `str` variable, if they are few. `check` uses them to prove that
    conditions cover all cases."""

    def refused(self, value: Value) -> str:
        """Return in words why the variable cannot have this value; empty if it can."""
        if not self.type.admits(value):
            return f"no {self.type}"
        listed = value is None or not self.values or value in self.values
        return "" if listed else f"none of {', '.join(self.values)}"


class Parameter(StrEnum):
    """What a parameter of a subnet stands for: a place or a variable of the net around it, or a
    value of a type."""

    PLACE = "place"
    VARIABLE = "variable"
    BOOL = "bool"
    INT = "int"
    FLOAT = "float"
    STR = "str"
    ANY = "any"


class Subnet(Struct, frozen=True):
    """A net within the net, used through macro places; its names are prefixed with the macro
    place's."""

    name: str
    places: Mapping[str, Place]
    transitions: Mapping[str, Transition]
    entry: str
    """Place that receives the tokens of arcs to the macro place."""
    normal: str
    """Place from which arcs `macro:normal` take tokens."""
    error: str = ""
    """Place from which arcs `macro:error` take."""
    errors_to: str = ""
    """Place that receives the errors of its action places without an `error` arc; empty: that of
    `error`."""
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    """What a macro place has to give in `args`."""

    @property
    def errors_lead_to(self) -> str:
        """Place that receives those errors; empty if the subnet has no place for them."""
        return self.errors_to or self.error
