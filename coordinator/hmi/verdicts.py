"""What the other rooms say about a task file's text: faults, findings of the check, drawings in other formats."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


class FormatError(ValueError):
    """A format is not known, or the text is not in it."""


@dataclass(frozen=True, slots=True)
class Made:
    """A task in another format."""

    text: str
    content_type: str


def findings(text: str, filename: str, where: Mapping[str, str] | None) -> list[dict[str, Any]]:
    """What keeps the task from running or should be looked at: {severity, key, text, remedy}."""
    return []


def export(text: str, filename: str, form: str) -> Made:
    """The task in another format. Raises FormatError."""
    raise FormatError(f"no format {form!r}")


def imported(form: str, text: str) -> str:
    """A net in another format as the text of a task file. Raises FormatError."""
    raise FormatError(f"no format {form!r}")
