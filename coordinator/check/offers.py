"""Whether some node offers every action that the task may choose."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from coordinator.check.findings import Finding
from coordinator.conditions.wording import Severity, nearest
from coordinator.task import Kind, Task


def unoffered(task: Task, offers: Mapping[str, str]) -> Iterator[Finding]:
    """Alternatives of used primitive tasks that no node offers."""
    used = {p.task for p in task.flat.places.values() if p.kind is Kind.ACTION}
    for primitive in task.primitive_tasks.values():
        for action in primitive.alternatives if primitive.name in used else ():
            if action not in offers:
                key = f"primitive_tasks.{primitive.name}.alternatives"
                text = f"no node offers the action {action!r}{nearest(action, offers)}"
                remedy = f"add [actions.{action}] to services.toml, or drop it here"
                yield Finding(Severity.ERROR, "unoffered", key, text, remedy)
