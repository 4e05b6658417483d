"""Whether some node offers every action that the task may choose, and offers it for that primitive
task."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from petrobot.coordinator.check.findings import Finding
from petrobot.coordinator.conditions.wording import Severity, listed, nearest
from petrobot.coordinator.task import Kind, PrimitiveTask, Task


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
                f"{source} says that the action {action!r} translates {said!r}, which "
                "does not name it"
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
