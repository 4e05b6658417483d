"""Check a task before it runs: branches, conflicts, actions on nodes, and its state space for
deadlock and unboundedness."""

from __future__ import annotations

import argparse
import asyncio
import time
from typing import TYPE_CHECKING, Any

from petrobot.coordinator.cli.loading import (
    SHIPPED_CELL,
    add_services_argument,
    cell_path,
    load_directory,
    load_task,
    refuse_misplaced,
    task_path,
    write_json,
)

if TYPE_CHECKING:
    from pathlib import Path

    from petrobot.coordinator.analysis.report import Analysis
    from petrobot.coordinator.task import Task
    from petrobot.coordinator.task.check import Report

EXAMPLE = "petrobot check catch_ball"
NO_CELL = "no-cell"
"""Code of the finding about the location file that was not given."""
PATIENCE = 2.0
"""Seconds that a node has to answer."""
MOST_STATES, LONGEST, MOST_MEMORY = 200_000, 5.0, 500_000_000
"""Markings, seconds and bytes that this quick gate spends on the state space."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
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
    """Check; 0 when the task may run, 2 when it may not, 3 when only a node that it needs is
    missing."""
    task = load_task(options.task)
    services = cell_path(options.services, options.task, task)
    report = _checked(task, services)
    missing = _missing(task, services) if options.live else []
    broken = any(finding.code == "inconsistent" for finding in report.errors)
    analysis = None if broken else _analysed(task)
    ok = report.ok and (analysis is None or not analysis.objections)
    live = {"live": missing} if options.live else {}
    if options.json:
        found = {} if analysis is None else _plain_analysis(analysis)
        findings = _plain(report, options.task)
        write_json(
            options.json, {"task": task.name, "ok": ok, "findings": findings, **found, **live}
        )
    if options.json != "-":
        told = [f"missing {line}" for line in missing] + _told(report, options.task)
        print("\n".join([*told, _text(options.task, analysis, ok and not missing)]))
    return (
        2
        if not ok
        else 130
        if analysis is not None and analysis.interrupted
        else 3
        if missing
        else 0
    )


def _checked(task: Task, services: Path) -> Report:
    """What is to be said of the task, and of the actions that a location file offers it."""
    from petrobot.coordinator.task.check import check

    if services == SHIPPED_CELL and not services.exists():
        said = (
            "there is none here, and none came with petrobot: whether nodes offer the "
            "actions was not checked"
        )
        return _noted(check(task), said)
    directory = load_directory(services)
    refuse_misplaced(directory)
    report = check(
        task,
        {action: entry.node for action, entry in directory.actions.items()},
        translates={action: entry.task for action, entry in directory.actions.items()},
        source=str(services),
    )
    if services == SHIPPED_CELL and any(finding.code == "unoffered" for finding in report.findings):
        return _noted(
            report, f"there is none here, so {services} was used, which comes with petrobot"
        )
    return report


def _noted(report: Report, said: str) -> Report:
    """The findings with a note about the location file that was not given."""
    from petrobot.coordinator.task.check import Finding, Report, Severity

    remedy = "write one of your own, or give --services FILE"
    return Report(
        (*report.findings, Finding(Severity.NOTE, NO_CELL, "services.toml", said, remedy))
    )


def _missing(task: Task, services: Path | None) -> list[str]:
    """What the task needs and the nodes do not give now: a line for each node that is away or
    offers less than it should."""
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


def _analysed(task: Task) -> Analysis:
    from petrobot.coordinator.analysis.net.space import SearchLimits
    from petrobot.coordinator.analysis.report import analyse

    limits = SearchLimits(
        states=MOST_STATES, seconds=LONGEST, memory=MOST_MEMORY, clock=time.monotonic
    )
    return analyse(task, limits=limits)


def _plain_analysis(analysis: Analysis) -> dict[str, Any]:
    data = analysis.to_json(structure=False)
    objections = {name: verdict.to_json() for name, verdict in analysis.objections.items()}
    return {"complete": data["complete"], "objections": objections, "analysis": data}


def _plain(report: Report, name: str) -> list[dict[str, Any]]:
    fields = ("severity", "key", "text", "remedy")
    return [
        {**{field: str(getattr(finding, field)) for field in fields}, "line": line}
        for finding, line in zip(report.findings, _lines(report, name), strict=True)
    ]


def _told(report: Report, name: str) -> list[str]:
    """The findings for people, each with the place in the task file that it is about."""
    path = task_path(name)
    places = [f"{path}:{line}: " if line else "" for line in _lines(report, name)]
    return [
        f"{f.severity:8}{place}{f.key}: {f.text}" + (f"\n        {f.remedy}" if f.remedy else "")
        for f, place in zip(report.findings, places, strict=True)
    ]


def _lines(report: Report, name: str) -> list[int | None]:
    """The line of each finding's key, or of the macro place in which it is; None for what is not
    about the task file."""
    from petrobot.coordinator.task.file.errors import key_lines, line_of

    lines = key_lines(task_path(name).read_text(encoding="utf-8"))
    return [None if f.code == NO_CELL else line_of(f.key, lines) for f in report.findings]


def _text(name: str, analysis: Analysis | None, ok: bool) -> str:
    ended, lines = "", list[str]()
    if analysis is not None:
        verdicts = {True: "yes", False: "NO", None: "unknown"}
        shown = {
            k: v for k, v in analysis.verdicts().items() if k != "safe"
        }  # runs to do are several tokens
        told = [f"{key.replace('_', ' ')} {verdicts[v.holds]}" for key, v in shown.items()]
        lines += [f"{'note':8}final: {note}" for note in analysis.notes]
        lines.append(
            f"{len(analysis.qualitative.space)} markings: {', '.join(told)}{_cut(analysis)}"
        )
        lines += _objections(analysis)
        if analysis.objections:
            lines.append(f"petrobot analyse {name} --pictures FOLDER shows how it comes to that")
        ended = "was not checked to its end (Ctrl-C)" if ok and analysis.interrupted else ""
    return "\n".join([*lines, f"{name}: {ended or ('may run' if ok else 'may not run')}"])


def _cut(analysis: Analysis) -> str:
    """Why the search ended early, and whether `analyse` would go on: not beyond a proof that the
    net has no end."""
    from petrobot.coordinator.analysis.report import ENDLESS

    space = analysis.qualitative.space
    if space.complete:
        return ""
    longer = "" if space.reason == ENDLESS else "; petrobot analyse goes on longer"
    return f"; the search was cut short ({space.reason}{longer})"


def _objections(analysis: Analysis) -> list[str]:
    """What speaks against running it, each with the firings that lead there."""
    lines = []
    for name, verdict in analysis.objections.items():
        lines.append(f"{'error':8}{name.replace('_', ' ')}: {verdict.reason}")
        if verdict.witness is not None:
            lines.append(f"        by: {' '.join(verdict.witness.firings) or '(initial marking)'}")
    return lines
