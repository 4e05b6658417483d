"""Checks of the flow of tokens that need no state space: cycles without time, places that are never
marked, ends at the beginning, unused declarations."""

from __future__ import annotations

from collections.abc import Iterator

from petrobot.coordinator.task import Kind, Scope, Task
from petrobot.coordinator.task.check.findings import Finding
from petrobot.coordinator.task.instant_firings import endless
from petrobot.coordinator.task.wording import Severity, listed


def timeless_cycles(task: Task) -> Iterator[Finding]:
    """Find transitions that could fire for ever without time passing."""
    loose = endless(task)
    if loose:
        text = f"{listed(loose)} can fire again and again without time passing"
        remedy = "let one of them wait for a run, an event or a time"
        yield Finding(Severity.ERROR, "timeless-cycle", f"transitions.{min(loose)}", text, remedy)


def never_marked(task: Task) -> Iterator[Finding]:
    """Find places that no firing can mark and transitions that can never fire. The search
    over-approximates: it never removes a token."""
    marked = {p.name for p in task.places.values() if p.tokens or p.kind is Kind.CONTROL}
    able: set[str] = set()
    while True:
        new = {
            t.name
            for t in task.transitions.values()
            if t.name not in able and all(a.place in marked for a in t.inputs)
        }
        if not new:
            break
        able |= new
        marked |= {o.place for name in new for o in task.transitions[name].outputs}
    fed = {o.place for t in task.transitions.values() for o in t.outputs}
    for place in task.places.values():
        if place.name not in marked or (
            place.kind is Kind.CONTROL and not place.tokens and place.name not in fed
        ):
            hand = ", unless the operator adds one" if place.kind is Kind.CONTROL else ""
            text = f"it never holds a token{hand}"
            severity = Severity.NOTE if place.kind is Kind.CONTROL else Severity.WARNING
            yield Finding(
                severity,
                "never-marked",
                f"places.{place.name}",
                text,
                "give it tokens or an arc from a transition",
            )
    for name in task.transitions:
        if name not in able:
            yield Finding(
                Severity.WARNING,
                "never-fires",
                f"transitions.{name}",
                "one of its inputs is never marked",
            )


def odd_ends(task: Task) -> Iterator[Finding]:
    """Find ends that the initial marking already satisfies."""
    tokens = {p.name: p.tokens for p in task.places.values()}
    for key, predicate in (("task.final", task.final), ("task.final_error", task.final_error)):
        if (
            predicate is not None
            and predicate.holds(tokens)
            and not any(p.tokens for p in task.places.values() if p.kind is Kind.ACTION)
        ):
            text = "the initial marking satisfies it: the task ends as soon as it begins"
            yield Finding(
                Severity.WARNING,
                "final-at-start",
                key,
                text,
                "give tokens to the place that holds the runs",
            )


def unused(task: Task) -> Iterator[Finding]:
    """Find declarations that nothing refers to."""
    events = {e for t in task.transitions.values() for e in t.events}
    places = [p for p in task.places.values() if p.kind is Kind.ACTION]
    for event in task.events.values():
        if event.name not in events:
            how = (
                "raised, but no transition uses it"
                if event.scope is Scope.INTERNAL
                else "no transition waits for it"
            )
            yield Finding(
                Severity.NOTE,
                "unused",
                f"events.{event.name}",
                how,
                "drop it, or name it in a transition",
            )
    for primitive in task.primitive_tasks:
        if primitive not in {p.task for p in places}:
            key = f"primitive_tasks.{primitive}"
            yield Finding(
                Severity.NOTE,
                "unused",
                key,
                "no action place runs it",
                "drop it, or give it a place",
            )
    written = {v for p in places for v in p.out.values()}
    written |= {name for t in task.transitions.values() for name, _ in t.sets}
    read = {n for t in task.transitions.values() if t.when is not None for n in t.when.names}
    for variable in task.variables.values():
        if variable.name in read and variable.name not in written and variable.initial is None:
            text = (
                "conditions read it, but no run writes it and it has no initial value: they are "
                "false until global memory writes it"
            )
            remedy = "give `initial`, or let a place write it with `out`"
            yield Finding(
                Severity.WARNING, "never-written", f"variables.{variable.name}", text, remedy
            )
