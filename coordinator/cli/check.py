"""Check a task before it runs: branches, conflicts, actions on nodes, and its state space for
deadlock and unboundedness."""

from __future__ import annotations

import argparse
import asyncio
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.faulty_files import FaultyFile
from petrobot.coordinator.cli.loading import (
    MISSING_CELL,
    add_services_argument,
    cell_of,
    cell_path,
    find_cell,
    load_directory,
    objections,
    task_path,
    told_if_slow,
    write_json,
)
from petrobot.coordinator.task.wording import Severity, listed, wrapped

if TYPE_CHECKING:
    from pathlib import Path

    from petrobot.coordinator.analysis.may_run import MayRun
    from petrobot.coordinator.analysis.net.verdict import PropertyVerdict
    from petrobot.coordinator.analysis.report import Analysis
    from petrobot.coordinator.task import Task
    from petrobot.coordinator.task.check import CheckReport
    from petrobot.services.comm.location_file import Directory

Facts = Mapping[str, Any]
"""What is known of one import path's code."""
EXAMPLE = "petrobot check catch_ball"
NO_CELL = "no-cell"
"""Code of the finding that no location file was given."""
NO_DRY_RUN = "no-dry-run"
"""Code of the finding that drivers of the location file refuse a dry run."""
PATIENCE = 2.0
"""Seconds that a node has to answer."""
HANG = 8
"""Columns before the details of a finding."""
UNLESS = "only if repaired"
"""The answer of a verdict that holds if the operator repairs what `final_error` leaves."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("task", help="a task file, or the name of a task that comes with petrobot")
    add_services_argument(parser)
    parser.add_argument(
        "--live",
        action="store_true",
        help="ask the nodes too: is each one up, does it offer what it should",
    )
    parser.add_argument(
        "--json", metavar="FILE", help="write the findings as JSON (- for standard output)"
    )


def run(options: argparse.Namespace) -> int:
    """Check the task. Return 0 if it may run, 2 if it may not, 3 if only a node that it needs is
    missing."""
    from petrobot.coordinator.task.check import CheckReport

    read, services = _read_task(options.task), None
    cell: FaultyFile[Directory] = FaultyFile("")
    code: Mapping[str, Facts] = {}
    try:
        services = find_cell(options.services, options.task, read.value)
        if options.live and read.value is not None:
            services = cell_path(services, options.task, read.value)
        if services is not None and services != task_path(options.task):
            cell, code = _read_cell(services)
    except CommandError as fault:
        cell.faults.append(str(fault))
    faults = [*read.faults, *cell.faults]
    if read.value is None:
        raise _refused(options.json, task_path(options.task).stem, read, cell.faults)
    task = read.value
    with told_if_slow("searching the states of the task (Ctrl-C: what is known by now)"):
        judged, report = _checked(task, cell, code, search=not read.faults)
    if not services and not faults:
        report = _noted(report)
    if read.faults:
        others = [*cell.faults, *_independent(options.task, report, read, cell)]
        raise _refused(options.json, task.name, read, others)
    report = CheckReport(tuple(f for f in report.findings if cell.is_new(f.key, f.text)))
    missing = _missing(task, services) if options.live and not faults else []
    analysis, ok = judged.analysis, judged.ok and report.ok and not faults
    live = {"live": missing} if options.live else {}
    if options.json:
        data = {} if analysis is None else _plain_analysis(analysis)
        findings = [_plain_fault(line, read.source) for line in faults]
        findings += _plain(report, options.task)
        write_json(
            options.json, {"task": task.name, "ok": ok, "findings": findings, **data, **live}
        )
    if options.json != "-":
        print("\n".join(_text(options.task, judged, report, missing, faults)))
    if faults:
        raise CommandError(2, "\n".join(faults))
    return (
        2
        if not ok
        else 130
        if analysis is not None and analysis.interrupted
        else 3
        if missing
        else 0
    )


def _refused(json: str | None, task: str, read: FaultyFile[Task], more: list[str]) -> CommandError:
    """Return the refusal of a task whose net was not searched, and write its JSON. `more`: what
    else is wrong."""
    faults = [*read.faults, *more]
    if json:
        findings = [_plain_fault(line, read.source) for line in faults]
        write_json(json, {"task": task, "ok": False, "findings": findings})
    return CommandError(2, "\n".join(faults))


def _because_of(name: str, faults: list[str]) -> str:
    """Return the first line of an answer: which file keeps the task from running."""
    code = re.search(r"\((\S+\.py:\d+)\)", faults[0])  # where a module cannot be imported
    return f"{name}: may not run because of {code[1] if code else faults[0].partition(':')[0]}"


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


def _read_task(name: str) -> FaultyFile[Task]:
    """Read the task, and tell all faults of its file."""
    from petrobot.coordinator.task.file import TaskFileError, loads
    from petrobot.coordinator.task.file.reading import read_text

    path = task_path(name)
    read: FaultyFile[Task] = FaultyFile(str(path))
    try:
        text = read_text(path)
    except TaskFileError as fault:
        raise CommandError(2, str(fault)) from fault
    read.read(text, lambda t, data: loads(t, str(path), data=data), TaskFileError)
    return read


def _read_cell(
    services: Path,
) -> tuple[FaultyFile[Directory], dict[str, Facts]]:
    """Read a location file and what is known of the code that it names, and tell all faults of
    both."""
    from petrobot.services.comm.location_file import DirectoryError, parse, read_text
    from petrobot.services.comm.location_file.code import code_faults, read_code
    from petrobot.services.comm.location_file.host_checks import misplaced

    cell: FaultyFile[Directory] = FaultyFile(str(services))
    try:
        text = read_text(services)
    except (OSError, DirectoryError):
        load_directory(services)  # it words the fault
        raise

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


def _checked(
    task: Task, cell: FaultyFile[Directory], code: Mapping[str, Facts], *, search: bool
) -> tuple[MayRun, CheckReport]:
    """Return the judgement of the task in a cell, and its findings with those about the code. Its
    states are searched where it has no other error: that takes seconds."""
    from petrobot.coordinator.analysis.may_run import BUDGET, may_run

    own = None if cell.value is None else cell_of(cell.value)
    for budget in (None, BUDGET) if search else (None,):
        judged = may_run(task, own, budget)
        report = judged.report
        if cell.value is not None:
            report = _with_code(task, cell.value, code, judged)
        if not report.ok:
            break
    if judged.analysis is not None and own is not None and not cell.faults:
        objections(task, own, judged)  # so that `run` need not search again
    return judged, report


def _independent(
    name: str, report: CheckReport, task: FaultyFile[Task], cell: FaultyFile[Directory]
) -> Iterator[str]:
    """Yield what was found in a faulty task and does not follow from its faults: errors, and what
    concerns the code; each as a line."""
    for f, line in zip(report.findings, _lines(report, name), strict=True):
        wrong = f.severity is Severity.ERROR or (
            f.code == "code" and f.severity is not Severity.NOTE
        )
        new = (line is None or task.is_new(f.key, f.text)) and cell.is_new(f.key, f.text)
        if wrong and new:
            place = f"{task.source}:{line}: " if line else ""
            yield f"{place}{f.key}: {f.text}" + (f"; {f.remedy}" if f.remedy else "")


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
        if action.run in code
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
    return found | (dict.fromkeys(MEMORY_CALLS, none) if MEMORY in found else {})


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


def _noted(report: CheckReport) -> CheckReport:
    """Add the finding that no location file was given."""
    from petrobot.coordinator.task.check import CheckReport, Finding, Severity

    said = f"{MISSING_CELL}: whether nodes offer the actions was not checked"
    remedy = "write one of your own, or give --services FILE"
    return CheckReport(
        (*report.findings, Finding(Severity.NOTE, NO_CELL, "services.toml", said, remedy))
    )


def _missing(task: Task, services: Path | None) -> list[str]:
    """Return one line for each node that the task needs and that does not answer, or offers less
    than services.toml says."""
    from petrobot.coordinator.run.node_status import ask_all

    directory = load_directory(services)
    used = {
        a
        for p in task.flat.places.values()
        if p.task
        for a in task.primitive_task_of(p.name).alternatives
    }
    wanted: dict[str, set[str]] = {}
    for action in used & set(directory.actions):
        wanted.setdefault(directory.where(action), set()).add(action)
    told = asyncio.run(ask_all(directory, PATIENCE))
    lines = []
    for node, actions in sorted(wanted.items()):
        lacks = sorted(actions - set(told[node].get("offers", ())))
        if not told[node]["up"]:
            why = told[node].get("why") or "launch it with `petrobot up`"
            lines.append(f"{node} at {told[node]['address']} is away ({why}): {', '.join(lacks)}")
        elif lacks:
            lines.append(
                f"{node} at {told[node]['address']} does not offer {', '.join(lacks)}: is "
                "its services.toml the same?"
            )
    return lines


def _plain_analysis(analysis: Analysis) -> dict[str, Any]:
    data = analysis.to_json(structure=False)
    objections = {name: verdict.to_json() for name, verdict in analysis.objections.items()}
    return {"complete": data["complete"], "objections": objections, "analysis": data}


def _plain(report: CheckReport, name: str) -> list[dict[str, Any]]:
    fields = ("severity", "key", "text", "remedy")
    return [
        {**{field: str(getattr(finding, field)) for field in fields}, "line": line}
        for finding, line in zip(report.findings, _lines(report, name), strict=True)
    ]


def _told(report: CheckReport, name: str) -> Iterator[Told]:
    """Yield the findings for people, each with the line of the task file that it is about. Of
    several notes of one kind, yield the first and their number."""
    path, known = task_path(name), set[str]()
    shown = path.name if str(path) != name else name  # that of a shipped task is long
    notes = Counter(f.code for f in report.findings if f.severity is Severity.NOTE)
    for finding, line in zip(report.findings, _lines(report, name), strict=True):
        place = f"{shown}:{line}: " if line else ""
        details = [finding.remedy, *finding.details] if finding.remedy else [*finding.details]
        if finding.severity is Severity.NOTE:
            if finding.code in known:
                continue
            known.add(finding.code)
            if notes[finding.code] > 1:
                others = notes[finding.code] - 1
                details.append(f"and {others} more such notes: petrobot check {name} --json -")
        yield Told(finding.severity, f"{place}{finding.key}: {finding.text}", details)


def _lines(report: CheckReport, name: str) -> list[int | None]:
    """Return the line of each finding's key, or of the macro place that contains it; None if the
    finding is not about the task file."""
    from petrobot.services.host.toml_text import key_lines, line_of

    lines = key_lines(task_path(name).read_text(encoding="utf-8"))
    elsewhere = [
        f.code in (NO_CELL, NO_DRY_RUN) or (f.code == "code" and ":" in f.key)
        for f in report.findings
    ]
    return [
        None if other else line_of(f.key, lines)
        for f, other in zip(report.findings, elsewhere, strict=True)
    ]


class Told(NamedTuple):
    """A finding for people: what was found, and details, each on a line of its own."""

    severity: Severity
    text: str
    details: Sequence[str] = ()

    def __str__(self) -> str:
        lines = [wrapped(f"{self.severity:{HANG}}{self.text}", HANG + 2)]
        for line in self.details:
            indent = HANG + len(line) - len(line.lstrip())
            lines.append(wrapped(f"{'':{HANG}}{line}", indent + 2))
        return "\n".join(lines)


def _text(
    name: str, judged: MayRun, report: CheckReport, missing: list[str], faults: list[str]
) -> Iterator[str]:
    """Yield the answer first, then the verdicts by name, then what was found, errors first.
    `faults`: what else is wrong in its files."""
    from petrobot.coordinator.analysis.may_run import LATE

    analysis, told = judged.analysis, list(_told(report, name))
    if faults:
        yield _because_of(name, faults)
    elif missing or not (judged.ok and report.ok):
        held = analysis is None or not analysis.objections
        why = next((f.key for f in report.errors), "a missing node")
        yield wrapped(f"{name}: may not run{f' because of {why}' if held else ''}", 2)
    elif analysis is not None and analysis.interrupted:
        yield f"{name}: was not checked to its end (Ctrl-C)"
    else:
        verdicts = {} if analysis is None else analysis.verdicts()
        open_ = [one for key, one in verdicts.items() if key != "safe" and one.holds is None]
        proved = [one for key, one in verdicts.items() if key != "safe" and one.holds is not None]
        part = "not everything" if proved else "nothing"
        late = dict.fromkeys(f.key for f in report.findings if f.code == LATE)
        but = [f"{part} was proved"] if open_ else []
        but += [f"runs take longer than {listed([*late])} on average"] if late else []
        yield wrapped(f"{name}: may run{f', but {listed(but)}' if but else ''}", 2)
    if faults:  # of the rest, only what is wrong whatever they are
        told = [one for one in told if one.severity is not Severity.NOTE]
    if analysis is not None and (analysis.objections or not faults):
        yield from _summary(analysis)
        told += _reasons(analysis)
        told += _notes(name, analysis)
    if missing or told:
        yield ""
    yield from (wrapped(f"missing {line}", HANG) for line in missing)
    order = (Severity.ERROR, Severity.WARNING, Severity.NOTE)
    yield from map(str, sorted(told, key=lambda one: order.index(one.severity)))
    if analysis is not None and analysis.objections:
        yield f"petrobot analyse {name} --pictures FOLDER draws how it comes to that"


def _summary(analysis: Analysis) -> list[str]:
    """Return the names of the verdicts by their answers, and how much was searched."""
    mended = _mendable(analysis)
    by_word: dict[str, list[str]] = {word: [] for word in ("yes", "NO", UNLESS, "unknown")}
    for key, verdict in analysis.verdicts().items():
        # A place of a task may have several tokens, so "safe" says nothing about it.
        if key != "safe":
            word = UNLESS if key in mended else _word(verdict)
            by_word[word].append(key.replace("_", " "))
    rows = [(word, ", ".join(names)) for word, names in by_word.items() if names]
    rows = [(w, f"{t} (after `final_error`)" if w == UNLESS else t) for w, t in rows]
    rows.append(("searched", f"{_size(analysis)}{_cut(analysis)}"))
    wide = max(len(word) for word, _ in rows) + 2
    return [wrapped(f"  {word:{wide}}{text}", wide + 2) for word, text in rows]


def _notes(name: str, analysis: Analysis) -> Iterator[Told]:
    for note in analysis.notes:
        yield Told(Severity.NOTE, note)
    if found := [verdict for verdict in analysis.by_hand if verdict.holds is False]:
        more = [f"and {len(found) - 1} more such notes"] if len(found) > 1 else []
        more.append(f"the way there: petrobot analyse {name}")
        yield Told(Severity.NOTE, f"only if the operator moves tokens: {found[0].reason}", more)


def _word(verdict: PropertyVerdict) -> str:
    return {True: "yes", False: "NO", None: "unknown"}[verdict.holds]


def _mendable(analysis: Analysis) -> list[str]:
    """The verdicts that do not hold only because the task may give up."""
    mended = analysis.progress.mended if analysis.progress else {}
    return [name for name, verdict in mended.items() if verdict.holds]


def _size(analysis: Analysis) -> str:
    markings = f"{len(analysis.qualitative.space)} markings"
    if analysis.progress is None:
        return markings
    return f"{len(analysis.progress.x)} states, {markings}"


def _cut(analysis: Analysis) -> str:
    """Return why a search ended early, and whether `analyse` would continue it: not beyond a proof
    that the net is unbounded."""
    from petrobot.coordinator.analysis.report import ENDLESS

    space, x = analysis.qualitative.space, analysis.progress and analysis.progress.x
    reason = space.reason if not space.complete else x.reason if x and not x.complete else ""
    if not reason:
        return ""
    longer = "" if space.reason == ENDLESS else "; petrobot analyse continues longer"
    return f"; the search was cut short ({reason}{longer})"


def _reasons(analysis: Analysis) -> Iterator[Told]:
    """Yield the reason of each verdict that does not hold, with details and the stimuli and firings
    that lead there, and what is not known."""
    from petrobot.coordinator.analysis.execution.progress import AGAIN
    from petrobot.coordinator.analysis.report import path_lines

    against, known = analysis.objections, list[object]()
    mendable = _mendable(analysis)
    refused = {
        n: v
        for n, v in analysis.verdicts().items()
        if v.holds is False and n != "safe" and n not in mendable
    }
    stuck, lost = list[str](), refused.get("sound")
    if "deadlock_free" in against:  # then these fail too, for the same reason
        stuck = [name for name in ("sound", *AGAIN) if refused.pop(name, None)]
    for name in sorted(refused, key=lambda name: name not in against):
        verdict = refused[name]
        details = list(verdict.details)
        if name == "deadlock_free" and lost is not None and lost.witness is not None:
            details.append(f"no end can be reached any more after: {lost.witness.steps[-1]}")
        if name in against and verdict.witness not in known:
            known.append(verdict.witness)
            details += path_lines(verdict.witness, "")
        if name == "deadlock_free" and stuck:
            details.append(f"so it is not {', '.join(stuck)}")
        severity = Severity.ERROR if name in against else Severity.WARNING
        yield Told(severity, f"{name.replace('_', ' ')}: {verdict.reason}", details)
    unknown = dict[str, list[str]]()
    for name, verdict in analysis.verdicts().items():
        if verdict.holds is None:
            unknown.setdefault(verdict.reason, []).append(name.replace("_", " "))
    for why, names in unknown.items():
        yield Told(Severity.WARNING, f"{', '.join(names)}: {why}")
    faulty = any(one.objections for one in analysis.fewer.values())
    for text in analysis.with_fewer:
        yield Told(Severity.WARNING if faulty else Severity.NOTE, text)
