"""Findings of a check: severity, key in the task file, a sentence, a remedy, and values that show
it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from petrobot.coordinator.task.wording import Severity


@dataclass(frozen=True, slots=True)
class Finding:
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


@dataclass(frozen=True, slots=True)
class CheckReport:
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


def _example(witness: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} = {value!r}" for name, value in sorted(witness.items()))
