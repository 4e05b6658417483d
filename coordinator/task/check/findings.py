"""Findings of a check: severity, key in the task file, a sentence, a remedy, and values that show
it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from petrobot.coordinator.task import Kind, Place, Subnet, Task
from petrobot.coordinator.task.conditions.language import as_literal
from petrobot.coordinator.task.wording import Severity

NEVER_MARKED = "never-marked"
"""Code of the findings about places that never hold a token."""


class Finding(Struct, frozen=True):
    """One thing that is wrong or worth knowing. `code` is a fixed word for programs; `key` is the
    key in the task file."""

    severity: Severity
    code: str
    key: str
    text: str
    remedy: str = ""
    witness: Mapping[str, Any] | None = None
    """Values that show it."""
    details: tuple[str, ...] = ()
    """The steps that lead to it."""

    def __str__(self) -> str:
        seen = f" (for example {_example(self.witness)})" if self.witness else ""
        remedy = f"; {self.remedy}" if self.remedy else ""
        return f"{self.severity}: {self.key}: {self.text}{seen}{remedy} [{self.code}]"


class CheckReport(Struct, frozen=True):
    """All findings, errors first."""

    findings: tuple[Finding, ...]

    @property
    def ok(self) -> bool:
        """Whether the task may be run: no finding is an error."""
        return not self.errors

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings that forbid running the task."""
        return self.of(Severity.ERROR)

    def of(self, severity: Severity) -> tuple[Finding, ...]:
        """Findings of one severity."""
        return tuple(f for f in self.findings if f.severity is severity)

    def __str__(self) -> str:
        return "\n".join(str(f) for f in self.findings)


def in_file(task: Task, found: Iterable[Finding]) -> tuple[Finding, ...]:
    """Return findings about the flat task as findings about its file: what is true of every use of
    a subnet is reported once, with the keys and names that the subnet has there."""
    flat = {_identity(finding): finding for finding in found}
    times = Counter(one.name for one in subnets_of(task).values())
    inside = {known: _in_subnet(task, finding) for known, finding in flat.items()}
    often = Counter(_identity(finding) for finding in inside.values())
    told = dict[tuple[str, ...], Finding]()
    for known, finding in inside.items():
        _, _, subnet = finding.key.partition(".")
        shared = often[_identity(finding)] == times[subnet.partition(".")[0]]
        one = finding if shared else flat[known]
        told.setdefault(_identity(one), one)
    return tuple(told.values())


def _identity(finding: Finding) -> tuple[str, ...]:
    return finding.severity, finding.code, finding.key, finding.text


def subnets_of(task: Task) -> dict[str, Subnet]:
    """Return the subnet of each use, by what the names in it begin with in the flat task."""
    return dict(_uses(task, "", task.places))


def _uses(task: Task, prefix: str, places: Mapping[str, Place]) -> Iterator[tuple[str, Subnet]]:
    for place in places.values():
        if place.kind is Kind.MACRO and place.subnet:
            inner, subnet = f"{prefix}{place.name}.", task.subnets[place.subnet]
            yield inner, subnet
            yield from _uses(task, inner, subnet.places)


def subnet_of(task: Task, name: str) -> tuple[str, Subnet | None]:
    """Return what an element of the flat task has in front of its name, and the subnet that it is
    in; nothing for one of the task itself."""
    uses = subnets_of(task)
    prefix = max((use for use in uses if name.startswith(use)), key=len, default="")
    return prefix, uses.get(prefix)


def _in_subnet(task: Task, finding: Finding) -> Finding:
    """Return the finding with the names of the subnet that its key is in; the same if in none."""
    table, _, name = finding.key.partition(".")
    prefix, subnet = subnet_of(task, name)
    if subnet is None or table not in ("places", "transitions"):
        return finding
    rest = name.removeprefix(prefix)
    if finding.code == NEVER_MARKED and rest == subnet.entry:
        return finding  # not the subnet lacks an arc, but its macro place

    def local(text: str) -> str:
        text = re.sub(rf"(?<![\w.]){re.escape(prefix)}", "", text)
        text = text.replace("[errors] to = ...", f"error = ... in [subnets.{subnet.name}]")
        return text.replace("[transitions]", f"[subnets.{subnet.name}.transitions]")

    return replace(
        finding,
        key=f"subnets.{subnet.name}.{table}.{rest}",
        text=local(finding.text),
        remedy=local(finding.remedy),
        witness=finding.witness and {local(n): value for n, value in finding.witness.items()},
    )


def _example(witness: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} = {as_literal(value)}" for name, value in sorted(witness.items()))
