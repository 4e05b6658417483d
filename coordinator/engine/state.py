"""The engine's state: marking, runs, latched events, variables, timers. It is immutable: each
stimulus gives a new one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from enum import StrEnum

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.engine.stimuli import Stimulus
from petrobot.coordinator.task import Counts, Executed, Status, Value
from petrobot.coordinator.task.net import Marking


class Mode(StrEnum):
    """How the engine treats stimuli."""

    __hash__ = str.__hash__  # that of Enum is slow, and the engine looks members up all the time

    FRESH = "fresh"
    """Waits for `Begin`."""
    RUNNING = "running"
    PAUSED = "paused"
    """Stimuli are handled, but nothing fires and nothing starts."""
    STEPPING = "stepping"
    """Runs until one transition has fired."""
    ABORTING = "aborting"
    """Waits until every cancelled run has stopped."""
    CLOSING = "closing"
    """`final` or `final_error` holds: waits until the runs that only listened have stopped."""
    FINISHED = "finished"


class Phase(StrEnum):
    """Stage of a run."""

    __hash__ = str.__hash__

    QUEUED = "queued"
    """Its token waits for a server, or for the operator to resume."""
    CHOOSING = "choosing"
    """Its action is being chosen."""
    WAITING = "waiting"
    """Its action is known; its device is not free yet."""
    STARTING = "starting"
    RUNNING = "running"
    HELD = "held"
    DONE = "done"
    STOPPING = "stopping"
    """Cancelled: its token is gone, but its device is not free yet."""
    STUCK = "stuck"
    """Could not be stopped, so its device stays fenced."""


UNSTARTED = frozenset({Phase.QUEUED, Phase.CHOOSING, Phase.WAITING})
ACTIVE = frozenset({Phase.STARTING, Phase.RUNNING, Phase.HELD})
LIVE = UNSTARTED | ACTIVE


class Run(Struct, frozen=True):
    """One execution of an action, from the token that entered its place until it is known to have
    stopped."""

    id: str
    place: str
    order: int
    """Number of this run among all runs; the lowest is served first."""
    phase: Phase = Phase.QUEUED
    cleared: bool = True
    """Whether it may start; False while the net is paused."""
    action: str = ""
    arguments: Mapping[str, Value] = field(default_factory=dict)
    """The arguments with which it was started."""
    device: str = ""
    at_once: bool = False
    status: Status | None = None
    cause: str = ""
    executed: Executed | None = None
    """Whether it acted on the world; kept only where a condition reads it."""
    ended: int = 0
    """Number of its end among all ends; the lowest is taken first."""
    raised: frozenset[str] = frozenset()
    """Internal events that it raised and that no firing has consumed."""
    heard: int = 0
    """Number of the newest of its events that was accepted."""
    counts: Counts | None = None
    """How it counts after its cancellation."""
    reason: str = ""
    """Why it was cancelled."""

    def changed(self, **changes: object) -> Run:
        """Return a copy with some fields changed."""
        return replace(self, **changes)


class Timer(Struct, frozen=True):
    """An armed `after` timer of a transition."""

    key: str
    runs: tuple[str, ...]
    """Runs that the transition would take; if they change, the timer restarts."""
    elapsed: bool = False
    held: bool = False


class Suspended(Struct, frozen=True):
    """A step that waits for a draw, for a breakpoint or for the operator's next step."""

    pulse: str
    """The event without memory that made it fireable; empty if there was none."""
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
    """If not None, the pulse can fire only these transitions."""


class Wait(Struct, frozen=True):
    """A transition that lacks only tokens of one place from which others take tokens, too."""

    place: str
    since: int
    """Number of the stimulus at which this began; the earliest is served first."""


class Deferred(Struct, frozen=True):
    """A run that ended provisionally and has no verdict yet."""

    place: str
    action: str
    status: Status
    cause: str = ""


class Early(Struct, frozen=True):
    """A verdict that arrived before the end of its run."""

    status: Status
    cause: str = ""
    text: str = ""


class State(Struct, frozen=True):
    """All that the effect of the next stimulus depends on. Its mappings are never changed in
    place."""

    marking: Marking
    variables: Mapping[str, Value]
    mode: Mode = Mode.FRESH
    stimuli: int = 0
    """Number of stimuli handled so far."""
    firings: int = 0
    timeless: int = 0
    """Firings since time last passed."""
    tokens: Mapping[str, tuple[Run, ...]] = field(default_factory=dict)
    """By action place: the runs whose tokens are there, in order of arrival."""
    stopping: Mapping[str, Run] = field(default_factory=dict)
    """Cancelled runs not yet known to have stopped, by id."""
    started: Mapping[str, int] = field(default_factory=dict)
    """By action place: number of runs so far."""
    run_order: int = 0
    end_order: int = 0
    flags: frozenset[str] = frozenset()
    """Latched external events that no firing has consumed."""
    seen: Mapping[str, int] = field(default_factory=dict)
    """By source: number of the newest event that was accepted."""
    timers: Mapping[str, Timer] = field(default_factory=dict)
    """By transition."""
    timer_order: int = 0
    waits: Mapping[str, Wait] = field(default_factory=dict)
    """By transition; only those that may compete for a token (`Compiled.contested`)."""
    suspended: Suspended | None = None
    backlog: tuple[Stimulus, ...] = ()
    """Stimuli that arrived while a draw was outstanding."""
    breakpoints: frozenset[str] = frozenset()
    overrides: Mapping[str, str] = field(default_factory=dict)
    """By primitive task: the alternative that the operator has fixed."""
    deferred: Mapping[str, Deferred] = field(default_factory=dict)
    """By id: runs that ended provisionally and have no verdict yet."""
    early: Mapping[str, Early] = field(default_factory=dict)
    """By id: verdicts on runs that are still active."""
    told: frozenset[str] = frozenset()
    """Elements that have been reported and have not changed since."""
    ending: str = ""
    """Why the mission run was aborted or has finished."""
    closing: Status | None = None
    """How the mission run ends once the runs that only listened have stopped."""

    def runs(self) -> Iterator[Run]:
        """Yield the runs that have a token, by place."""
        for runs in self.tokens.values():
            yield from runs

    def run(self, run_id: str) -> Run | None:
        """Return a run that has a token or is stopping; None if it is unknown or finished."""
        place = run_id.rpartition("#")[0]
        for run in self.tokens.get(place, ()):
            if run.id == run_id:
                return run
        return self.stopping.get(run_id)
