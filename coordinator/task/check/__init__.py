"""Static check of a task: fast, without its state space. What the state space holds is for the
analysis."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from petrobot.coordinator.task import Kind, Reference, Task
from petrobot.coordinator.task.check.completeness import (
    event_faults,
    external_waits,
    impossible,
    translating_others,
    uncovered_exits,
    unoffered,
)
from petrobot.coordinator.task.check.conflicts import conflicts
from petrobot.coordinator.task.check.findings import (
    NEVER_MARKED,
    CheckReport as CheckReport,
    Finding as Finding,
    in_file as in_file,
)
from petrobot.coordinator.task.compiled_task import endless
from petrobot.coordinator.task.validation import faults
from petrobot.coordinator.task.wording import Severity as Severity, few, listed

# --- checks of the flow of tokens ---
# They need no state space: cycles without time, places that are never marked, ends at the
# beginning, unused declarations.


def timeless_cycles(task: Task) -> Iterator[Finding]:
    """Find transitions that could fire for ever without time passing."""
    loose = endless(task)
    if loose & _reached(task, _ever_marked(task))[1]:
        text = f"{listed(loose)} can fire again and again without time passing"
        remedy = "let one of them wait for a run, an event or a time"
        yield Finding(Severity.ERROR, "timeless-cycle", f"transitions.{min(loose)}", text, remedy)


def never_marked(task: Task) -> Iterator[Finding]:
    """Find places that no firing can mark, and name with each what else it keeps empty and which
    transitions can never fire. The search over-approximates: it never removes a token."""
    fed = {o.place for t in task.transitions.values() for o in t.outputs}
    for place in task.places.values():
        if place.kind is Kind.CONTROL and not place.tokens and place.name not in fed:
            yield _never_marked(Severity.NOTE, place.name, ", unless the operator adds one")
    marked, able = _reached(task, _ever_marked(task))
    # A place that nothing feeds is a cause, and else a resource: in a circle of empty places, its
    # tokens are what was forgotten.
    order = sorted(
        (p for p in task.places.values() if not p.expanded_from),
        key=lambda p: (p.name in fed, p.kind is not Kind.RESOURCE),
    )
    for place in order:
        if place.name in marked:
            continue
        now_marked, now_able = _reached(task, marked | {place.name})
        empty = [p.name for p in order if p.name in now_marked - marked - {place.name}]
        idle = [t.name for t in task.transitions.values()
                if t.name in now_able - able and not t.expanded_from]  # fmt: skip
        marked, able = now_marked, now_able
        text = f"; so {few(sorted(idle))} can never fire" if idle else ""
        stay = "stay" if len(empty) > 1 else "stays"
        text += f", and {few(sorted(empty))} {stay} empty" if empty else ""
        yield _never_marked(Severity.WARNING, place.name, text)


def _never_marked(severity: Severity, place: str, more: str) -> Finding:
    text, remedy = f"it never holds a token{more}", "give it tokens or an arc from a transition"
    return Finding(severity, NEVER_MARKED, f"places.{place}", text, remedy)


def _ever_marked(task: Task) -> set[str]:
    """Return the places that have tokens at the beginning or may get some from the operator."""
    return {p.name for p in task.places.values() if p.tokens or p.kind is Kind.CONTROL}


def _reached(task: Task, marked: set[str]) -> tuple[set[str], set[str]]:
    """Return the places that may get a token if these have some, and the transitions that may
    fire."""
    marked, able = set(marked), set[str]()
    while True:
        new = {
            t.name
            for t in task.transitions.values()
            if t.name not in able and all(a.place in marked for a in t.inputs)
        }
        if not new:
            return marked, able
        able |= new
        marked |= {o.place for name in new for o in task.transitions[name].outputs}


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
            key, text = f"events.{event.name}", "no transition waits for it"
            remedy = "drop it, or name it in a transition"
            yield Finding(Severity.NOTE, "unused", key, text, remedy)
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
    for name in [p for p in task.parameters if p in ("seed", "runs")]:
        text = f"`prepare` and `score` receive what --{name} gives by this name, not this value"
        yield Finding(
            Severity.WARNING, "overridden", f"task.parameters.{name}", text, "drop it, or rename it"
        )
    written = {v for p in places for v in p.out.values()}
    written |= {name for t in task.transitions.values() for name, _ in t.sets}
    conditions = {n for t in task.transitions.values() if t.when is not None for n in t.when.names}
    for variable in task.variables.values():
        name = variable.name
        if name in written or variable.initial is not None:
            continue
        given = [f"places.{p.name}.args" for p in places
                 if Reference(name) in p.args.values()]  # fmt: skip
        given += [f"transitions.{t.name}.set" for t in task.transitions.values()
                  if any(name in value.names for _, value in t.sets)]  # fmt: skip
        if name in conditions or given:
            readers, effect = "conditions", "they are false"
            if given:
                readers, effect = few(given), f"{name} is none there"
                readers += " and conditions" * (name in conditions)
            read = "read" if name in conditions or len(given) > 1 else "reads"
            text = (
                f"{readers} {read} it, but no run writes it and it has no initial value: {effect} "
                "until global memory writes it"
            )
            remedy = "give `initial`, or let a place write it with `out`"
            yield Finding(Severity.WARNING, "never-written", f"variables.{name}", text, remedy)


# --- all checks ---

_CHECKS: tuple[Callable[[Task], Iterator[Finding]], ...] = (
    uncovered_exits,
    impossible,
    event_faults,
    conflicts,
    timeless_cycles,
    external_waits,
    never_marked,
    odd_ends,
    unused,
)
_ORDER = (Severity.ERROR, Severity.WARNING, Severity.NOTE)


def check(
    task: Task,
    offers: Mapping[str, str] | None = None,
    *,
    translates: Mapping[str, str] | None = None,
    source: str = "services.toml",
) -> CheckReport:
    """Check what can be found without exploring the states of the task.

    `offers`: the node of each action that is offered; `translates`: the primitive task of each
    according to its location file; `source`: the name of that file.
    """
    broken = faults(task)
    if broken:
        return CheckReport(
            tuple(Finding(Severity.ERROR, "inconsistent", f.key, f.text, f.remedy) for f in broken)
        )
    found = [finding for part in _CHECKS for finding in part(task.flat)]
    if offers is not None:
        found += unoffered(task, offers, source)
    if translates is not None:
        found += translating_others(task, translates, source)
    return CheckReport(in_file(task, sorted(found, key=lambda f: _ORDER.index(f.severity))))
