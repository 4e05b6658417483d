"""Completeness: every action place has outgoing arcs for a normal end and for an error, and their
conditions cover all cases."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from math import inf

from msgspec.structs import replace

from petrobot.coordinator.task import (
    EarlyEvent,
    End,
    Event,
    Kind,
    Place,
    PrimitiveTask,
    Scope,
    Status,
    Task,
    Transition,
)
from petrobot.coordinator.task.check.findings import Finding
from petrobot.coordinator.task.conditions import Expression, equivalent, parse
from petrobot.coordinator.task.conditions.regions import Certainty, Domain, covering
from petrobot.coordinator.task.validation import condition_domains
from petrobot.coordinator.task.wording import Severity, listed, nearest

UNCOVERED = "uncovered-exit"
"""Code of the findings that the conditions of a place's exits may all be false."""
EXTERNAL_WAIT = "external-wait"
"""Code of the findings of `external_waits`."""
_EXIT_OF = {Status.SUCCESS: End.NORMAL, Status.FAILURE: End.NORMAL, Status.ERROR: End.ERROR}


def uncovered_exits(task: Task) -> Iterator[Finding]:
    """Missing branches, and statuses that may find every exit's condition false."""
    domains = condition_domains(task)
    for place in task.places.values():
        if place.kind is not Kind.ACTION:
            continue
        for end in (End.NORMAL, End.ERROR):
            if not _written(place, task.exits.get((place.name, end), ())):
                yield _missing(place, end)
        for status in Status:
            ways = task.exits.get((place.name, _EXIT_OF[status]), ())
            if _written(place, ways) and not any(w.when is None or w.events for w in ways):
                yield from _uncovered(place, status, ways, domains)


def _written(place: Place, ways: Iterable[Transition]) -> bool:
    """Return whether there is an outgoing transition other than the retry of `tries`."""
    return any(way.name != f"{place.name}.retry" for way in ways)


def _missing(place: Place, end: End) -> Finding:
    what = "success or failure" if end is End.NORMAL else "error"
    text = f"no outgoing arc `{end}`: the token of a run that ends with {what} would stay for ever"
    remedy = f'add to [transitions] one with in = ["{place.name}:{end}"]'
    if end is End.ERROR:
        remedy += ", or name a place for all errors of this net: [errors] to = ..."
    return Finding(Severity.ERROR, f"no-{end}-exit", f"places.{place.name}", text, remedy)


def _uncovered(
    place: Place, status: Status, ways: Sequence[Transition], domains: dict[str, Domain]
) -> Iterator[Finding]:
    name = f"{place.name}.status"
    known = {**domains, name: replace(domains[name], values=(status.value,))}
    conditions: list[Expression | None] = [w.when for w in ways]
    verdict = covering(conditions, known)
    names = ", ".join(w.name for w in ways)
    key, remedy = (
        f"places.{place.name}",
        "let one exit take what is left (no `when`, lower priority)",
    )
    if verdict.answer is Certainty.REFUTED:
        text = (
            f"after {status} the conditions of its exits {names} may all be false: "
            "finished, nowhere to go"
        )
        # How other runs can have ended when this one ends, only the execution graph shows.
        others = any(_reads_other(w, place, domains) for w in ways)
        severity = Severity.NOTE if others else Severity.ERROR
        yield Finding(severity, UNCOVERED, key, text, remedy, verdict.witness)
    elif verdict.answer is Certainty.UNKNOWN:
        text = (
            f"after {status} it is not known whether the conditions of its exits {names} "
            "cover all cases"
        )
        yield Finding(Severity.WARNING, "coverage-unknown", key, text, remedy)


def _reads_other(way: Transition, place: Place, domains: Mapping[str, Domain]) -> bool:
    """Return whether a condition reads how a run of another place ended."""
    names = () if way.when is None else way.when.names
    owners = {name.rpartition(".")[0] for name in names if name in domains}
    return not owners <= {"", place.name}


# Transitions that can never fire, whatever the rest of the task does.


def impossible(task: Task) -> Iterator[Finding]:
    """Find conditions that no values make true, and timers of runs that end before them."""
    domains, never = condition_domains(task), parse("false")
    for t in task.transitions.values():
        key = f"transitions.{t.name}"
        if t.when is not None and t.when.names and equivalent(t.when, never, domains):
            text, remedy = "no values make it true", "write a condition that can hold"
            yield Finding(Severity.ERROR, "never-true", f"{key}.when", text, remedy)
        for arc in t.inputs if t.after is not None else ():
            limit = task.longest_run(arc.place) if arc.end in (End.PREEMPT, End.GOING) else inf
            if t.after is not None and t.after > limit:
                text = (
                    f"it needs a run of {arc.place} that is active for {t.after:g} s, but these "
                    f"end in ERROR after {limit:g} s (cause `deadline`), or as much later as they "
                    "wait before they start"
                )
                remedy = "write a shorter `after`, or give the runs more time"
                yield Finding(Severity.WARNING, "late-timer", f"{key}.after", text, remedy)


# Events that no transition can receive, and waits that only the outside world can end.


def event_faults(task: Task) -> Iterator[Finding]:
    """Internal events whose transition does not hold a run that could raise them."""
    for t in task.transitions.values():
        for name in t.events:
            event = task.events[name]
            if event.scope is Scope.INTERNAL and not _holds_raiser(task, t, event):
                yield _unheard(task, t, event)


def external_waits(
    task: Task,
    raised: Collection[str] = (),
    source: str | None = None,
    may_stay: Collection[str] = (),
) -> Iterator[Finding]:
    """Places whose tokens only an external event can free, with no `after` beside it: one finding
    for those that the same transitions take. A place that listens may wait for ever.

    `raised`: the events that the cell is known to raise; they are awaited as designed. `source`:
    the location file, if it is known that the cell raises no others. `may_stay`: places whose
    tokens are known not to keep the task from its end.
    """
    takers: dict[tuple[str, End | None], list[str]] = {}
    spared = {*may_stay, *(p.name for p in task.places.values() if p.listen)}
    for t in task.transitions.values():
        for arc in t.inputs:
            if arc.end not in (End.PREEMPT, End.GOING) and arc.place not in spared:
                takers.setdefault((arc.place, arc.end), []).append(t.name)
    joined: dict[tuple[str, ...], list[tuple[str, End | None]]] = {}
    for place in task.places:
        for end in dict.fromkeys(end for name, end in takers if name == place):
            joined.setdefault(tuple(takers[place, end]), []).append((place, end))
    for ways, places in joined.items():
        missing = [_external(task, task.transitions[name]) - {*raised} for name in ways]
        if not all(missing):
            continue
        waits, (first, end) = set[str]().union(*missing), places[0]
        text = f"only {listed(waits)} can free its token{f' after its {end} end' if end else ''}"
        if len(places) > 1:
            names = [f"{place}:{end}" if end else place for place, end in places]
            text = f"only {listed(waits)} can free the tokens of {', '.join(names)}"
        remedy = "put a transition with `after` beside it"
        if source is None:
            early = any(task.events[e].early is EarlyEvent.DROP for e in waits)
            text += f": if it never comes{', or only too early' * early}, the task hangs"
            if early:
                remedy += ', or let it come early (`memory = "latched"`, `early = "keep"`)'
        else:
            text += f", and no driver, action, service or timer of {source} raises it"
            remedy += ", or raise it by hand: petrobot raise EVENT"
        yield Finding(Severity.WARNING, EXTERNAL_WAIT, f"places.{first}", text, remedy)


def _external(task: Task, t: Transition) -> set[str]:
    """Return the external events for which a transition waits."""
    return {e for e in t.events if task.events[e].scope is Scope.EXTERNAL}


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


# Whether some node offers every action that the task may choose, and offers it for that primitive
# task.


def unoffered(task: Task, offers: Mapping[str, str], source: str) -> Iterator[Finding]:
    """Alternatives of used primitive tasks that no node offers. `source`: the location file that
    says what is offered."""
    for primitive, action in _used(task):
        if action not in offers:
            key = f"primitive_tasks.{primitive.name}.alternatives"
            text = f"no node offers the action {action!r}{nearest(action, offers)}"
            remedy = f"add [actions.{action}] to {source}, or drop it here"
            yield Finding(Severity.ERROR, "unoffered", key, text, remedy)


def translating_others(task: Task, translates: Mapping[str, str], source: str) -> Iterator[Finding]:
    """Actions whose location file names a primitive task that does not choose among them: it or the
    task file is mistaken.

    An action that several primitive tasks choose from is one's by name only, so that any of them
    may stand there. `translates`: the primitive task of each action, as `source` says.
    """
    named: dict[str, list[str]] = {}
    for primitive, action in _used(task):
        named.setdefault(action, []).append(primitive.name)
    for action, choosers in named.items():
        said = translates.get(action, choosers[0])
        if said not in choosers:
            key = f"primitive_tasks.{choosers[0]}.alternatives"
            text = (
                f"{source} says that the action {action!r} does the primitive task {said!r}, "
                "which does not name it"
            )
            remedy = (
                f"write task = {' or '.join(map(repr, choosers))} in its "
                f"[actions.{action}], or drop it here"
            )
            known = (
                ""
                if said in task.primitive_tasks
                else f"; the task has {listed(task.primitive_tasks)}"
            )
            yield Finding(Severity.WARNING, "translates-other", key, text + known, remedy)


def _used(task: Task) -> Iterator[tuple[PrimitiveTask, str]]:
    """Primitive tasks that some place runs, with each of their alternatives."""
    used = {p.task for p in task.flat.places.values() if p.kind is Kind.ACTION}
    for primitive in task.primitive_tasks.values():
        for action in primitive.alternatives if primitive.name in used else ():
            yield primitive, action
