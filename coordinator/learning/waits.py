"""How long transitions wait for events, from which the rates of events are estimated.

The rate of an event that comes by itself is how often it came, over the time in which it could have
served the transition (its exposure). The time of a wait that ended without the event, because the
token or a resource was taken elsewhere, counts too. Otherwise an event that comes once a minute
would seem to come every two seconds to a transition that never waits longer than that.
"""

from __future__ import annotations

from collections.abc import Iterator

from petrobot.coordinator.analysis.time.measured import is_cause
from petrobot.coordinator.engine.state import Mode, Phase, State
from petrobot.coordinator.engine.stimuli import EventOccurred, RaiseEvent, Stimulus
from petrobot.coordinator.learning.records import Waited, WaitEnd
from petrobot.coordinator.task import EarlyEvent, End, EventMemory, Scope, Status, Task, Transition

DIGITS = 6
"""Decimals of all waits (microseconds), as in journals."""


def memory_of(task: Task, t: Transition) -> tuple[EventMemory, EarlyEvent] | None:
    """Return how the event is remembered for which the transition waits; None if it does not wait
    for exactly one external event."""
    events = [task.events[name] for name in t.events]
    if len(events) != 1 or events[0].scope is not Scope.EXTERNAL:
        return None
    return events[0].memory, events[0].early


class EventWaits:
    """Measures the waits from the stimuli, firings and states of a mission run.

    Causes of preemption are left out: their event is a way in which the run ends. So are internal
    events of runs that stay active: each comes once in a run, early or late.
    """

    def __init__(self, task: Task) -> None:
        flat = task.flat
        self._net, self._events = flat.net, flat.events
        self._watched = {
            t.name: t
            for t in flat.transitions.values()
            if t.events and not is_cause(flat, t) and not self._raised_by_active(t)
        }
        self._memory = {name: memory_of(flat, t) for name, t in self._watched.items()}
        self._since: dict[str, float] = {}
        """By transition that waits: when its wait began."""
        self._came: dict[str, float] = {}
        """By transition that the present stimulus finds waiting for its event: how long it had."""
        self._seen: dict[str, int] = {}

    def _raised_by_active(self, t: Transition) -> bool:
        external = all(self._events[name].scope is Scope.EXTERNAL for name in t.events)
        return not external and any(a.end is End.GOING for a in t.inputs)

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Note which transitions an event finds waiting."""
        if not isinstance(stimulus, EventOccurred | RaiseEvent):
            return
        if isinstance(stimulus, EventOccurred):
            if stimulus.is_repeated(self._seen):
                return
            self._seen[stimulus.source] = stimulus.number
        for name in [*self._since]:
            if self._memory[name] is not None and stimulus.event in self._watched[name].events:
                self._came[name] = round(now - self._since.pop(name), DIGITS)

    def fired(self, now: float, transition: str) -> Waited | None:
        """Return the wait that this firing ends; None if it ends none."""
        if transition in self._came:
            return Waited(transition, self._came.pop(transition), WaitEnd.FIRED)
        if transition in self._watched and self._memory[transition] is None:
            # what it waited for may all have come before it could fire
            return Waited(transition, round(now - self._since.pop(transition, now), DIGITS))
        return None

    def cut(self, now: float) -> list[Waited]:
        """Return the waits that continue, up to now: the rest of them counts for the next trial."""
        ended = [*self._cut(now, [*self._since])]
        self._since |= {wait.transition: now for wait in ended}
        return ended

    def settled(self, now: float, state: State) -> list[Waited]:
        """Return the waits that ended in this stimulus without a firing, and begin those that the
        state allows."""
        ended = [Waited(name, seconds, WaitEnd.CAME) for name, seconds in self._came.items()]
        self._came.clear()
        waiting = [t.name for t in self._watched.values() if self._waits(state, t)]
        ended += self._cut(now, [name for name in self._since if name not in waiting])
        for name in waiting:
            self._since.setdefault(name, now)
        return ended

    def _cut(self, now: float, names: list[str]) -> Iterator[Waited]:
        for name in names:
            seconds = round(now - self._since.pop(name), DIGITS)
            if seconds > 0:
                yield Waited(name, seconds, WaitEnd.CUT)

    def _waits(self, state: State, t: Transition) -> bool:
        """Return whether the event would serve the transition if it came now: set its flag, or fire
        it if its condition is true."""
        if state.mode not in (Mode.RUNNING, Mode.STEPPING):
            return False
        memory, early = self._memory[t.name] or (None, None)
        if memory is not None and not state.flags.isdisjoint(t.events):
            return False
        if early is EarlyEvent.KEEP:
            return True
        if not self._net.has_concession(state.marking, self._net.transition_index[t.name]):
            return False
        return memory is EventMemory.LATCHED or all(
            sum(
                run.phase is not Phase.DONE
                if a.end in (End.PREEMPT, End.GOING)
                else run.phase is Phase.DONE
                and (run.status is Status.ERROR) == (a.end is End.ERROR)
                for run in state.tokens.get(a.place, ())
            )
            >= a.weight
            for a in t.inputs
            if a.end is not None
        )
