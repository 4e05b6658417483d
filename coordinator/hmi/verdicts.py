"""What the other rooms say about a task file's text: faults, findings of the check, drawings in other formats."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from coordinator.analysis import pnml_writing
from coordinator.analysis.commands import net_file_of
from coordinator.analysis.netfile import FormatError as NetFormatError
from coordinator.analysis.pnml_reading import parse_pnml
from coordinator.check import check
from coordinator.hmi.netfiles import as_task_file
from coordinator.task import Task
from coordinator.taskfile import TaskFileError, dumps, loads


class FormatError(ValueError):
    """A format is not known, or the text is not in it."""


@dataclass(frozen=True, slots=True)
class Made:
    """A task in another format."""

    text: str
    content_type: str


def findings(text: str, filename: str, where: Mapping[str, str] | None) -> list[dict[str, Any]]:
    """What keeps the task from running or should be looked at: {severity, key, text, remedy}; errors first.

    `where` gives the node of each action that is offered; None leaves offers out.
    """
    try:
        task = loads(text, filename)
    except TaskFileError as error:
        return [_finding("error", fault.key, fault.text, fault.remedy) for fault in error.faults]
    report = check(task, where)
    return [_finding(f.severity.value, f.key, f.text, f.remedy) for f in report.findings]


def _finding(severity: str, key: str, text: str, remedy: str) -> dict[str, Any]:
    return {"severity": severity, "key": key, "text": text, "remedy": remedy}


def load(text: str, filename: str) -> Task:
    """The task in a text. Raises FormatError with all faults."""
    try:
        return loads(text, filename)
    except TaskFileError as error:
        raise FormatError(str(error)) from error


def export(text: str, filename: str, form: str) -> Made:
    """The task in another format. Raises FormatError."""
    task = load(text, filename)
    if form == "toml":
        return Made(dumps(task), "application/toml")
    if form == "pnml":
        return Made(pnml_writing.write_pnml(net_file_of(task)), "application/xml")
    raise FormatError(f"no format {form!r}: toml and pnml are known")


def imported(form: str, text: str) -> str:
    """A net in another format as the text of a task file, to go on drawing. Raises FormatError."""
    if form == "toml":
        return text
    if form != "pnml":
        raise FormatError(f"no format {form!r}: toml and pnml are known")
    try:
        return as_task_file(parse_pnml(text))
    except NetFormatError as error:
        raise FormatError(f"not a place/transition net in PNML: {error}") from error
