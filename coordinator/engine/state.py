"""The engine's state: marking, runs, latches, variables, timers. A value: never changed, only
replaced."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from petrobot.coordinator.engine.stimuli import Stimulus
from petrobot.coordinator.task import Counts, Executed, Status, Value
from petrobot.coordinator.task.net import Marking


class Mode(StrEnum):
    """What the engine does with stimuli."""

    FRESH = "fresh"
    """Waits for `Begin`."""
    RUNNING = "running"
    PAUSED = "paused"
    """Takes stimuli in; nothing fires, nothing starts."""
    STEPPING = "stepping"
    """Runs until one transition has fired."""
    ABORTING = "aborting"
    """Waits until every cancelled run has stopped."""
    CLOSING = "closing"
    """`final` or `final_error` holds: waits until the runs that only listened have stopped."""
    FINISHED = "finished"


class Phase(StrEnum):
    """Where a run stands."""

    QUEUED = "queued"
    """Its token waits for a server (or for the operator to go on)."""
    CHOOSING = "choosing"
    """Its action is being chosen."""
    WAITING = "waiting"
    """Its action is known, its device is not free."""
    STARTING = "starting"
    RUNNING = "running"
    HELD = "held"
    DONE = "done"
    STOPPING = "stopping"
    """Cancelled; its token is gone, its device not free yet."""
    STUCK = "stuck"
    """Could not be stopped: its device stays fenced."""


UNSTARTED = frozenset({Phase.QUEUED, Phase.CHOOSING, Phase.WAITING})
ACTIVE = frozenset({Phase.STARTING, Phase.RUNNING, Phase.HELD})
LIVE = UNSTARTED | ACTIVE


@dataclass(frozen=True)
class Run:
    """One execution of an action, from the token that entered its place until it is known to have
    stopped."""

    id: str
    place: str
    order: int
    """Counts up over all runs: first come, first served."""
    phase: Phase = Phase.QUEUED
    cleared: bool = True
    """May start; False while the operator holds the net."""
    action: str = ""
    arguments: Mapping[str, Value] = field(default_factory=dict)
    """What it was started with."""
    device: str = ""
    at_once: bool = False
    status: Status | None = None
    cause: str = ""
    executed: Executed | None = None
    """Whether it touched the world; kept only where a condition reads it."""
    ended: int = 0
    """Counts up over all ends: first done, first taken."""
    raised: frozenset[str] = frozenset()
    """Internal events that it raised and no firing has consumed."""
    counts: Counts | None = None
    """How it counts after its cancellation."""
    reason: str = ""
    """Why it was cancelled."""

    def changed(self, **changes: object) -> Run:
        """A copy with some fields changed. Like `dataclasses.replace`, at a fraction of its time:
        it is the hot path."""
        copy = object.__new__(Run)
        copy.__dict__.update(self.__dict__)
        copy.__dict__.update(changes)
        return copy


@dataclass(frozen=True, slots=True)
class Timer:
    """An armed `after` timer of a transition."""

    key: str
    runs: tuple[str, ...]
    """Runs that the transition would take: with another set the timer starts anew."""
    elapsed: bool = False
    held: bool = False


@dataclass(frozen=True, slots=True)
class Suspended:
    """A step that waits for a draw, a breakpoint or the operator's next step, with the pulse that
    made it fireable."""

    pulse: str
    cause: str
    choices: tuple[str, ...] = ()
    """Transitions drawn so far in this step."""
    key: str = ""
    """The `Choose` that is outstanding; empty if the step waits for the operator."""
    alternatives: tuple[str, ...] = ()
    weights: tuple[float, ...] = ()
    passed: tuple[str, ...] = ()
    """Transitions whose breakpoint has been reported."""
    only: tuple[str, ...] | None = None
    """If not None, the pulse serves only these transitions any more."""


@dataclass(frozen=True, slots=True)
class Wait:
    """A transition that lacks nothing but tokens of one place that others take too."""

    place: str
    since: int
    """Number of the stimulus since which that is so: first come, first served."""


@dataclass(frozen=True, slots=True)
class Deferred:
    """A run whose verdict is still to come."""

    place: str
    action: str
    status: Status
    cause: str = ""


@dataclass(frozen=True, slots=True)
class Early:
    """A verdict that overtook the end of its run."""

    status: Status
    cause: str = ""
    text: str = ""


@dataclass(frozen=True, slots=True)
class State:
    """Everything that the next stimulus can depend on. Its mappings are never changed in place."""

    marking: Marking
    variables: Mapping[str, Value]
    mode: Mode = Mode.FRESH
    stimuli: int = 0
    """How many have been handled."""
    firings: int = 0
    timeless: int = 0
    """Firings since time last passed."""
    tokens: Mapping[str, tuple[Run, ...]] = field(default_factory=dict)
    """By action place: the runs whose tokens are there, in the order in which they came."""
    stopping: Mapping[str, Run] = field(default_factory=dict)
    """Cancelled runs not yet known to have stopped, by id."""
    started: Mapping[str, int] = field(default_factory=dict)
    """By action place: how many runs it has had."""
    run_order: int = 0
    end_order: int = 0
    flags: frozenset[str] = frozenset()
    """Latched external events that have come and wait."""
    seen: Mapping[str, int] = field(default_factory=dict)
    """By source: number of the newest event taken."""
    timers: Mapping[str, Timer] = field(default_factory=dict)
    """By transition."""
    timer_order: int = 0
    waits: Mapping[str, Wait] = field(default_factory=dict)
    """By transition; only of transitions that may compete (`Compiled.contested`)."""
    suspended: Suspended | None = None
    backlog: tuple[Stimulus, ...] = ()
    """Stimuli that came while a draw was outstanding."""
    breakpoints: frozenset[str] = frozenset()
    overrides: Mapping[str, str] = field(default_factory=dict)
    """By primitive task: the alternative that the operator has fixed."""
    deferred: Mapping[str, Deferred] = field(default_factory=dict)
    """Runs that ended provisionally and were not judged yet."""
    early: Mapping[str, Early] = field(default_factory=dict)
    """Verdicts on runs whose ends are still to come."""
    told: frozenset[str] = frozenset()
    """Elements of standing reports that were made already."""
    ending: str = ""
    """Why the mission run was aborted or has finished."""
    closing: Status | None = None
    """How the mission run ends once the runs that only listened have stopped."""

    def runs(self) -> Iterator[Run]:
        """All runs with a token, by place."""
        for runs in self.tokens.values():
            yield from runs

    def run(self, run_id: str) -> Run | None:
        """A run with a token or a stopping one; None if it is unknown or over."""
        place = run_id.rpartition("#")[0]
        for run in self.tokens.get(place, ()):
            if run.id == run_id:
                return run
        return self.stopping.get(run_id)
