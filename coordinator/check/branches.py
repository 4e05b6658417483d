"""Every action place has a normal and an error way out, and the exits of each status cover all
cases."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from petrobot.coordinator.check.findings import Finding
from petrobot.coordinator.conditions import Expression
from petrobot.coordinator.conditions.regions import Answer, Domain, covering
from petrobot.coordinator.conditions.wording import Severity
from petrobot.coordinator.task import End, Kind, Place, Status, Task, Transition
from petrobot.coordinator.task.consistency import condition_domains

_EXIT_OF = {Status.SUCCESS: End.NORMAL, Status.FAILURE: End.NORMAL, Status.ERROR: End.ERROR}


def uncovered_exits(task: Task) -> Iterator[Finding]:
    """Missing branches, and statuses that may find every exit's condition false."""
    domains = condition_domains(task)
    for place in task.places.values():
        if place.kind is not Kind.ACTION:
            continue
        for end in (End.NORMAL, End.ERROR):
            if not exits(task, place, end):
                yield _missing(place, end)
        for status in Status:
            ways = exits(task, place, _EXIT_OF[status])
            if ways and not any(w.when is None or w.events for w in ways):
                yield from _uncovered(place, status, ways, domains)


def exits(task: Task, place: Place, end: End) -> list[Transition]:
    """The transitions that take a token of the place at such an end."""
    return [
        t
        for t in task.transitions.values()
        if any(a.place == place.name and a.end is end for a in t.inputs)
    ]


def _missing(place: Place, end: End) -> Finding:
    what = "success or failure" if end is End.NORMAL else "error"
    text = f"no {end} way out: a run that ends with {what} could go nowhere"
    remedy = f'add a transition with in = ["{place.name}:{end}"]'
    return Finding(Severity.ERROR, f"no-{end}-exit", f"places.{place.name}", text, remedy)


def _uncovered(
    place: Place, status: Status, ways: list[Transition], domains: dict[str, Domain]
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
    if verdict.answer is Answer.REFUTED:
        text = (
            f"after {status} the conditions of its exits {names} may all be false: "
            "finished, nowhere to go"
        )
        yield Finding(Severity.ERROR, "uncovered-exit", key, text, remedy, verdict.witness)
    elif verdict.answer is Answer.UNKNOWN:
        text = (
            f"after {status} it is not known whether the conditions of its exits {names} "
            "cover all cases"
        )
        yield Finding(Severity.WARNING, "coverage-unknown", key, text, remedy)
