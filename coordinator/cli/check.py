"""Check a task before it runs: branches, conflicts, actions on nodes, and its state space for
deadlock and unboundedness."""

from __future__ import annotations

import argparse
import asyncio
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from msgspec.structs import replace

from petrobot.coordinator.cli import CommandError
from petrobot.coordinator.cli.loading import (
    MISSING_CELL,
    add_json_argument,
    add_services_argument,
    add_task_argument,
    cell_path,
    find_cell,
    load_directory,
    objections,
    task_path,
    told_if_slow,
    write_json,
)
from petrobot.coordinator.operator.faulty_files import FaultyFile
from petrobot.coordinator.operator.task_check import (
    NO_CELL,
    Facts,
    Judgement,
    cell_of,
    judge,
    read_cell,
    read_task,
)
from petrobot.coordinator.task.wording import Severity, listed, wrapped
from petrobot.services.host.toml_text import InputError

if TYPE_CHECKING:
    from petrobot.coordinator.analysis.may_run import MayRun
    from petrobot.coordinator.analysis.net.verdict import PropertyVerdict
    from petrobot.coordinator.analysis.report import Analysis
    from petrobot.coordinator.task import Task
    from petrobot.coordinator.task.check import CheckReport
    from petrobot.services.comm.location_file import Directory

EXAMPLE = "petrobot check catch_ball"
PATIENCE = 2.0
"""Seconds that a node has to answer."""
HANG = 8
"""Columns before the details of a finding."""
UNLESS = "only if repaired"
"""The answer of a verdict that holds if the operator repairs what `final_error` leaves."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    add_task_argument(parser)
    add_services_argument(parser)
    parser.add_argument(
        "--live",
        action="store_true",
        help="ask the nodes too: is each one up, does it offer what it should",
    )
    add_json_argument(parser, "the findings")


def run(options: argparse.Namespace) -> int:
    """Check the task. Return 0 if it may run, 2 if it may not, 3 if only a node that it needs is
    missing."""
    from petrobot.coordinator.task.file.reading import read_text

    path = task_path(options.task)
    text = read_text(path)
    task, services = read_task(text, str(path)), None
    cell: FaultyFile[Directory] = FaultyFile("")
    code: Mapping[str, Facts] = {}
    try:
        services = find_cell(options.services, options.task, task.value)
        if options.live and task.value is not None:
            services = cell_path(services, options.task, task.value)
        if services is not None and services != path:
            cell, code = _read_cell(services)
    except InputError as fault:
        cell.faults.append(str(fault))
    with told_if_slow("searching the states of the task (Ctrl-C: what is known by now)"):
        found = judge(task, text, cell, code, search=True)
    faults, judged = found.faults, found.judged
    if judged is None or task.faults:
        raise _refused(options.json, found)
    if judged.analysis is not None and cell.value is not None and not cell.faults:
        # So that `run` need not search again.
        objections(judged.task, cell_of(cell.value), judged)
    if not services and not faults:
        found = replace(found, report=_noted(found.report))
    missing = _missing(judged.task, services) if options.live and not faults else []
    analysis, ok = judged.analysis, judged.ok and found.report.ok and not faults
    live = {"live": missing} if options.live else {}
    if options.json:
        data = {} if analysis is None else _plain_analysis(analysis)
        about = {"task": judged.task.name, "ok": ok, "findings": found.findings()}
        write_json(options.json, {**about, **data, **live})
    if options.json != "-":
        print("\n".join(_text(options.task, judged, found, missing)))
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


def _read_cell(services: Path) -> tuple[FaultyFile[Directory], Mapping[str, Facts]]:
    """Read a location file and what is known of its code. Raises CommandError if it cannot be
    read."""
    from petrobot.services.comm.location_file import DirectoryError

    try:
        return read_cell(services)
    except (OSError, DirectoryError):
        load_directory(services)  # it words the fault
        raise


def _refused(json: str | None, found: Judgement) -> CommandError:
    """Return the refusal of a task whose net was not searched, and write its JSON."""
    faults, source = found.faults, found.task.source
    for f, line in zip(found.report.findings, found.lines(), strict=True):
        place = f"{source}:{line}: " if line else ""
        faults.append(f"{place}{f.key}: {f.text}" + (f"; {f.remedy}" if f.remedy else ""))
    if json:
        name = Path(source).stem if found.task.value is None else found.task.value.name
        write_json(json, {"task": name, "ok": False, "findings": found.findings()})
    return CommandError(2, "\n".join(faults))


def _because_of(name: str, faults: list[str]) -> str:
    """Return the first line of an answer: which file keeps the task from running."""
    code = re.search(r"\((\S+\.py:\d+)\)", faults[0])  # where a module cannot be imported
    return f"{name}: may not run because of {code[1] if code else faults[0].partition(':')[0]}"


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


def _told(found: Judgement, name: str) -> Iterator[Told]:
    """Yield the findings for people, each with the line of the task file that it is about. Of
    several notes of one kind, yield the first and their number."""
    path, known, report = task_path(name), set[str](), found.report
    shown = path.name if str(path) != name else name  # that of a shipped task is long
    notes = Counter(f.code for f in report.findings if f.severity is Severity.NOTE)
    for finding, line in zip(report.findings, found.lines(), strict=True):
        place = f"{shown}:{line}: " if line else ""
        details = [finding.remedy, *finding.details] if finding.remedy else [*finding.details]
        if finding.severity is Severity.NOTE:
            if finding.code in known:
                continue
            known.add(finding.code)
            if notes[finding.code] > 1:
                others = notes[finding.code] - 1
                details.append(
                    f"and {others} more such note{'s' * (others > 1)}: "
                    f"petrobot check {name} --json -"
                )
        yield Told(finding.severity, f"{place}{finding.key}: {finding.text}", details)


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


def _text(name: str, judged: MayRun, found: Judgement, missing: list[str]) -> Iterator[str]:
    """Yield the answer first, then the verdicts by name, then what was found, errors first."""
    from petrobot.coordinator.analysis.may_run import LATE

    report, faults = found.report, found.faults
    analysis, told = judged.analysis, list(_told(found, name))
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
        others = len(found) - 1
        more = [f"and {others} more such note{'s' * (others > 1)}"] if others else []
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
            details.append(f"`final` cannot be reached any more after: {lost.witness.steps[-1]}")
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
