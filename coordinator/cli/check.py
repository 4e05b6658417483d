"""Check a task before it runs: its file, its branches and conflicts, and that every action is on some node."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from coordinator.cli.loading import add_services_argument, load_directory, load_task, services_path, write_json

if TYPE_CHECKING:
    from coordinator.check import Report

EXAMPLE = "petrobot check catch_ball"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The command's options."""
    parser.add_argument("task", help="a task file, or the name of a task that comes with petrobot")
    add_services_argument(parser)
    parser.add_argument("--json", metavar="FILE", help="write the findings as JSON (- for standard output)")


def run(options: argparse.Namespace) -> int:
    """Check; 0 when the task may run, 2 when it may not."""
    from coordinator.check import check

    task = load_task(options.task)
    offers: dict[str, str] | None = None
    if options.services is not None or services_path(None).exists():
        directory = load_directory(options.services)
        offers = {action: directory.where(action) for action in directory.actions}
    report = check(task, offers)
    if options.json:
        write_json(options.json, _plain(task.name, report))
    if options.json != "-":
        print(_text(task.name, report))
    return 2 if any(f.severity == "error" for f in report.findings) else 0


def _plain(name: str, report: Report) -> dict[str, Any]:
    fields = ("severity", "key", "text", "remedy")
    findings = [{field: str(getattr(finding, field)) for field in fields} for finding in report.findings]
    return {"task": name, "ok": not any(f["severity"] == "error" for f in findings), "findings": findings}


def _text(name: str, report: Report) -> str:
    lines = [
        f"{f.severity:8}{f.key}: {f.text}" + (f"\n        {f.remedy}" if f.remedy else "") for f in report.findings
    ]
    errors = sum(f.severity == "error" for f in report.findings)
    verdict = f"{name}: may not run, {errors} error{'s' * (errors != 1)}" if errors else f"{name}: may run"
    return "\n".join([*lines, verdict])
