"""Check a task in the cell of a location file: its file, its states, and the code that the location
file names. `petrobot check` and the operator's page ask here, so they find the same."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgspec import Struct

from petrobot.coordinator.operator.faulty_files import FaultyFile
from petrobot.coordinator.task.wording import Severity, listed

if TYPE_CHECKING:
    from petrobot.coordinator.analysis.may_run import Cell, MayRun
    from petrobot.coordinator.task import Task
    from petrobot.coordinator.task.check import CheckReport, Finding
    from petrobot.services.comm.location_file import Directory

Facts = Mapping[str, Any]
"""What is known of one import path's code."""
NO_CELL = "no-cell"
"""Code of the finding that no location file was given."""
NO_DRY_RUN = "no-dry-run"
"""Code of the finding that drivers of the location file refuse a dry run."""


class Judgement(Struct, frozen=True):
    """What was found about a task in a cell."""

    task: FaultyFile[Task]
    text: str
    """The text of the task file."""
    cell: FaultyFile[Directory]
    judged: MayRun | None
    """None if the task file could not be read."""
    report: CheckReport
    """The findings on the task and the code, without those that follow from the faults of a
    file."""

    @property
    def faults(self) -> list[str]:
        """The faults of both files, each as "FILE:LINE: KEY: what is wrong; remedy"."""
        return [*self.task.faults, *self.cell.faults]

    def lines(self) -> list[int | None]:
        """Return the line of each finding, as `lines_of` does."""
        return lines_of(self.report, self.text)

    def findings(self) -> list[dict[str, Any]]:
        """Return everything that was found as plain data: severity, key, text, remedy, line."""
        fields = ("severity", "key", "text", "remedy")
        return [_plain_fault(line, self.task.source) for line in self.faults] + [
            {**{field: str(getattr(finding, field)) for field in fields}, "line": line}
            for finding, line in zip(self.report.findings, self.lines(), strict=True)
        ]


def judge(
    task: FaultyFile[Task],
    text: str,
    cell: FaultyFile[Directory],
    code: Mapping[str, Facts],
    *,
    search: bool,
    offers: Cell | None = None,
) -> Judgement:
    """Judge a task that was read, in a cell and with the facts about its code.

    With `search` its states are searched if it has no other error: that takes seconds. Without, the
    findings that only a search can decide are left out. `offers` is what the nodes offer if there
    is no location file.
    """
    from petrobot.coordinator.analysis.may_run import BUDGET, left_to_search, may_run
    from petrobot.coordinator.task.check import CheckReport

    if task.value is None:
        return Judgement(task, text, cell, None, CheckReport(()))
    own = offers if cell.value is None else cell_of(cell.value)
    searched = False
    for budget in (None, BUDGET) if search and not task.faults else (None,):
        judged, searched = may_run(task.value, own, budget), budget is not None
        report = judged.report
        if cell.value is not None:
            report = _with_code(task.value, cell.value, code, judged)
        if not report.ok:
            break
    found = [
        finding
        for finding, line in zip(report.findings, lines_of(report, text), strict=True)
        if cell.is_new(finding.key, finding.text)
        and (not task.faults or _is_independent(finding, line, task))
        and (searched or not left_to_search(finding))
    ]
    return Judgement(task, text, cell, judged, CheckReport(tuple(found)))


def judge_text(
    text: str, source: str, services: str, offers: Mapping[str, Any] | None, *, search: bool
) -> Judgement:
    """Judge the text of a task file, named `source` in messages, for the operator's page.

    `services` is the path of the location file. It is empty if there is none or its code is not to
    be read: then the fields of a `Cell` tell what the nodes `offer` (None: not known).
    """
    from petrobot.coordinator.analysis.may_run import Cell
    from petrobot.services.comm.location_file import DirectoryError

    cell: FaultyFile[Directory] = FaultyFile(services)
    code: Mapping[str, Facts] = {}
    if services:
        try:
            cell, code = read_cell(Path(services))
        except (OSError, DirectoryError) as fault:
            cell.faults.append(str(fault))
    known = None if offers is None else Cell(**offers)
    return judge(read_task(text, source), text, cell, code, search=search, offers=known)


def _is_independent(finding: Finding, line: int | None, task: FaultyFile[Task]) -> bool:
    """Return whether a finding is wrong whatever the faults of the task file hide: an error, or
    about the code."""
    wrong = finding.severity is Severity.ERROR or (
        finding.code == "code" and finding.severity is not Severity.NOTE
    )
    return wrong and (line is None or task.is_new(finding.key, finding.text))


def read_task(text: str, source: str) -> FaultyFile[Task]:
    """Read the text of a task file, and tell all its faults. `source` is its name in messages."""
    from petrobot.coordinator.task.file import TaskFileError, loads

    read: FaultyFile[Task] = FaultyFile(source)
    read.read(text, lambda t, data: loads(t, source, data=data), TaskFileError)
    return read


def read_cell(services: Path) -> tuple[FaultyFile[Directory], dict[str, Facts]]:
    """Read a location file and what is known of the code that it names, and tell all faults of
    both. Raises DirectoryError, OSError if the file cannot be read."""
    from petrobot.services.comm.location_file import DirectoryError, parse, read_text
    from petrobot.services.comm.location_file.code import code_faults, read_code
    from petrobot.services.comm.location_file.host_checks import misplaced

    cell: FaultyFile[Directory] = FaultyFile(str(services))
    text = read_text(services)

    def reader(text: str, data: dict[str, Any] | None) -> Directory:
        directory = parse(text, services, data)
        found = misplaced(directory)
        if mendable := [line for line in found if re.search("did you mean|: write '", line)]:
            raise DirectoryError(tuple(mendable))
        return directory

    cell.read(text, reader, DirectoryError)
    if cell.value is None:
        return cell, {}
    cell.add(misplaced(cell.value))
    code = read_code(cell.value)
    cell.add(code_faults(cell.value, code, text))
    return cell, {path: facts for path, facts in code.items() if "import" not in facts}


def cell_of(directory: Directory) -> Cell:
    """Return what a location file offers to a task."""
    from petrobot.coordinator.analysis.may_run import Cell

    actions = directory.actions.values()
    return Cell(
        {action.name: action.node for action in actions},
        str(directory.source),
        {action.name: action.device for action in actions if action.device},
        {action.name: action.task for action in actions if action.task},
        {timer.name: timer.period for timer in directory.timers.values()},
    )


def _plain_fault(line: str, source: str) -> dict[str, Any]:
    """Return a fault, "FILE:LINE: KEY: text; remedy", as a finding. The key of another file than
    the task begins with that file and line."""
    at = re.match(r"(.+?):(\d+): (?:([^\s:]+): )?", line)
    file, number, key = at.groups("") if at else ("", "", "")
    text, _, remedy = line[at.end() if at else 0 :].partition("; ")
    if file != source:
        key = f"{file}:{number}: {key}" if file else ""
    where = int(number) if file == source else None
    return {"severity": "error", "key": key, "text": text, "remedy": remedy, "line": where}


def _with_code(
    task: Task, directory: Directory, code: Mapping[str, Facts], judged: MayRun
) -> CheckReport:
    """Add findings about the code that the location file names."""
    from petrobot.coordinator.task.check import CheckReport, Finding, Severity, in_file
    from petrobot.coordinator.task.check.code import code_findings, given_findings, occupied
    from petrobot.coordinator.task.check.completeness import EXTERNAL_WAIT, external_waits
    from petrobot.services.comm.location_file import read_text
    from petrobot.services.comm.location_file.code import SLOW
    from petrobot.services.host.toml_text import key_lines, line_of

    actions = directory.actions.values()
    by_action = {
        action.name: {**code[action.run], "device": code.get(_driver(directory, action.device), {})}
        for action in actions
        if action.run in code and "classes" not in code[action.run]  # a class is not an action
    }
    args = {action.name: action.args for action in actions}
    drivers = {device.name: code.get(device.driver, {}) for device in directory.devices.values()}
    raised, complete = _raised(task, directory, code)
    services = _services(directory, code)
    lines = key_lines(read_text(directory.source))

    def where(key: str) -> str:
        return f"{directory.source}:{line_of(key, lines)}: {key}"

    timers = {name: where(f"timers.{name}") for name in directory.timers}
    facts = (by_action, args, services, [*drivers.values()], raised, timers)
    found = list(code_findings(task, *facts))
    found += given_findings(by_action, args, where)
    found += occupied(task, {action.name: action.device for action in actions})
    for stream in directory.streams.values():
        if stream.period > SLOW:
            text = f"{stream.period:g} s between two set points; 0.05 would be 50 ms"
            key = where(f"streams.{stream.name}.period")
            found.append(Finding(Severity.WARNING, "code", key, text))
    if refused := [name for name, facts in drivers.items() if facts.get("dry_run") is False]:
        text = f"--dry-run is refused: the drivers of {listed(refused)} do not obey it"
        remedy = 'obey `self.dry_run` there, and add "dry_run" to `obeys`'
        found.append(Finding(Severity.NOTE, NO_DRY_RUN, str(directory.source), text, remedy))
    errors = [f for f in found if f.severity is Severity.ERROR]
    warnings = [f for f in found if f.severity is not Severity.ERROR]
    known = [f for f in judged.report.findings if f.code != EXTERNAL_WAIT]
    if len(known) < len(judged.report.findings):  # now it is known which events the cell raises
        source = str(directory.source) if complete else None
        progress = None if judged.analysis is None else judged.analysis.progress
        may_stay = frozenset[str]() if progress is None else progress.may_stay
        warnings += external_waits(task.flat, raised, source, may_stay)
    return CheckReport(in_file(task, (*errors, *known, *warnings)))


def _services(directory: Directory, code: Mapping[str, Facts]) -> dict[str, Facts]:
    """Return what is known of the services that are not actions. Those without code of their own
    write nothing into the global memory by themselves."""
    from petrobot.services.comm.location_file import MEMORY, MEMORY_CALLS

    none: Mapping[str, Any] = {"any_put": False, "puts": ()}
    found = {n: code.get(s.run, {}) if s.run else none for n, s in directory.services.items()}
    if found.pop(MEMORY, None) is None:
        return found
    return found | dict.fromkeys(MEMORY_CALLS, none)  # its calls have names of their own


def _raised(task: Task, directory: Directory, code: Mapping[str, Facts]) -> tuple[set[str], bool]:
    """Return the events that the cell raises, and whether it is known to raise no others: not if
    some of its code was not read or raises events by names that it computes, and not of a
    laboratory."""
    raised = {*directory.timers}
    complete = not any(node.sim for node in directory.nodes.values())
    tables = [
        *((action.run, action.args) for action in directory.actions.values()),
        *((service.run, {}) for service in directory.services.values()),
        *((device.driver, device.config) for device in directory.devices.values()),
    ]
    for path, table in tables:
        if not path:  # what comes with petrobot raises nothing
            continue
        facts = code.get(path, {})
        raised |= {*facts.get("events", ())}
        if facts.get("any_event", True):
            named = repr(table)  # names that a driver raises may be given in its device's table
            raised |= {event for event in task.events if repr(event) in named}
            complete = False
    return raised, complete


def _driver(directory: Directory, device: str) -> str:
    """Return the import path of a device's driver; empty if it has none."""
    return directory.devices[device].driver if device else ""


def lines_of(report: CheckReport, text: str) -> list[int | None]:
    """Return the line of each finding's key in the text of a task file, or of the macro place that
    contains it; None if the finding is not about the task file."""
    from petrobot.services.host.toml_text import key_lines, line_of

    lines = key_lines(text)
    elsewhere = [
        f.code in (NO_CELL, NO_DRY_RUN) or (f.code == "code" and ":" in f.key)
        for f in report.findings
    ]
    return [
        None if other else line_of(f.key, lines)
        for f, other in zip(report.findings, elsewhere, strict=True)
    ]
