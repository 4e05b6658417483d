"""Events that can never be heard, and waits that only the outside world can end."""

from __future__ import annotations

from collections.abc import Iterator

from petrobot.coordinator.check.findings import Finding
from petrobot.coordinator.conditions.wording import Severity, listed
from petrobot.coordinator.task import End, Event, Kind, Scope, Task, Transition


def event_faults(task: Task) -> Iterator[Finding]:
    """Internal events whose transition does not hold a run that could raise them."""
    for t in task.transitions.values():
        for name in t.events:
            event = task.events[name]
            if event.scope is Scope.INTERNAL and not _holds_raiser(task, t, event):
                yield _unheard(task, t, event)


def external_waits(task: Task) -> Iterator[Finding]:
    """Places whose tokens only an external event can free, with no `after` beside it."""
    for place in task.places.values():
        takers: dict[End | None, list[Transition]] = {}
        for t in task.transitions.values():
            for arc in t.inputs:
                if arc.place == place.name and arc.end not in (End.PREEMPT, End.GOING):
                    takers.setdefault(arc.end, []).append(t)
        for end, ways in takers.items():
            waits = {e for t in ways for e in t.events if task.events[e].scope is Scope.EXTERNAL}
            if all(_is_external(task, t) for t in ways):
                after = f" after its {end} end" if end else ""
                text = (
                    f"only {listed(waits)} can free its token{after}: if it never comes, "
                    "the task hangs"
                )
                remedy = "put a transition with `after` beside it"
                yield Finding(
                    Severity.WARNING, "external-wait", f"places.{place.name}", text, remedy
                )


def _is_external(task: Task, t: Transition) -> bool:
    return any(task.events[e].scope is Scope.EXTERNAL for e in t.events)


def _holds_raiser(task: Task, t: Transition, event: Event) -> bool:
    return any(a.end is not None and task.places[a.place].task == event.by for a in t.inputs)


def _unheard(task: Task, t: Transition, event: Event) -> Finding:
    key = f"transitions.{t.name}.event"
    started = [o.place for o in t.outputs if task.places[o.place].kind is Kind.ACTION]
    if any(task.places[p].task == event.by for p in started):
        text = (
            f"{event.name} is declared internal to {event.by}, but this transition starts "
            f"{event.by}: it would have to run "
            "before it is started, and the operator could no longer control by tokens how "
            "often it does"
        )
        return Finding(
            Severity.ERROR,
            "internal-impossible",
            key,
            text,
            f'declare {event.name} with scope = "external"',
        )
    text = (
        f"{event.name} is raised by {event.by}, but none of its inputs is an action place "
        "of that primitive task"
    )
    remedy = f"add an input from a place with task = {event.by!r}, or make the event external"
    return Finding(Severity.ERROR, "event-unheard", key, text, remedy)
