"""Static check of a task: fast, without its state space. What the state space holds is for the
analysis."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from petrobot.coordinator.task import Task
from petrobot.coordinator.task.check.completeness import (
    event_faults,
    external_waits,
    translating_others,
    uncovered_exits,
    unoffered,
)
from petrobot.coordinator.task.check.conflicts import conflicts
from petrobot.coordinator.task.check.findings import CheckReport, Finding, in_file
from petrobot.coordinator.task.check.flow import never_marked, odd_ends, timeless_cycles, unused
from petrobot.coordinator.task.validation import faults
from petrobot.coordinator.task.wording import Severity

__all__ = ["CheckReport", "Finding", "Severity", "check", "in_file"]

_CHECKS: tuple[Callable[[Task], Iterator[Finding]], ...] = (
    uncovered_exits,
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
