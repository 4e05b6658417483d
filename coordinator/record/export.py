"""A journal for other tools: JSON lines (everything) and XES (process mining: one trace, an event
for each firing and run)."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from xml.sax.saxutils import quoteattr

from petrobot.coordinator.engine import Corrected, Fired, RunRecorded, StartRun, to_plain
from petrobot.coordinator.record.journal import Journal
from petrobot.coordinator.record.recording import Step
from petrobot.services.comm.json_text import json_text


def jsonl(journal: Journal, steps: Iterator[Step]) -> Iterator[str]:
    """One line for the header, then one for each stimulus with the instructions that followed."""
    yield json_text({"kind": "header", **journal.header}, ensure_ascii=False)
    for step in steps:
        line = {
            "number": step.number,
            "t": step.time,
            "stimulus": to_plain(step.stimulus),
            "instructions": [to_plain(instruction) for instruction in step.instructions],
            "marking": list(step.state.marking),
        }
        yield json_text(line, ensure_ascii=False)


def xes(journal: Journal, steps: Iterator[Step]) -> Iterator[str]:
    """The run as an XES log (IEEE 1849-2016) with one trace; times count from the date in the
    header."""
    origin = datetime.fromisoformat(
        journal.header.get("date", "1970-01-01T00:00:00+00:00")
    ).astimezone(UTC)
    yield '<?xml version="1.0" encoding="UTF-8"?>'
    yield '<log xes.version="1849-2016" xes.features="" xmlns="http://www.xes-standard.org/">'
    for name, prefix in (
        ("Concept", "concept"),
        ("Time", "time"),
        ("Lifecycle", "lifecycle"),
        ("Organizational", "org"),
    ):
        yield (
            f'  <extension name="{name}" prefix="{prefix}" '
            f'uri="http://www.xes-standard.org/{prefix}.xesext"/>'
        )
    yield (
        '  <trace><string key="concept:name" '
        f"value={quoteattr(str(journal.header.get('mission', '')))}/>"
    )
    for step in steps:
        when = (origin + timedelta(seconds=step.time)).isoformat(timespec="milliseconds")
        for instruction in step.instructions:
            event = _xes_event(instruction)
            if event is not None:
                yield f'    <event>{event}<date key="time:timestamp" value="{when}"/></event>'
    yield "  </trace>"
    yield "</log>"


def _xes_event(instruction: object) -> str | None:
    if isinstance(instruction, Fired):
        return _strings(
            {
                "concept:name": instruction.transition,
                "lifecycle:transition": "complete",
                "kind": "firing",
            }
        )
    if isinstance(instruction, StartRun):
        names = {"concept:name": instruction.place, "lifecycle:transition": "start", "kind": "run"}
        return _strings(
            {**names, "concept:instance": instruction.run, "org:resource": instruction.action}
        )
    if isinstance(instruction, RunRecorded):
        names = {
            "concept:name": instruction.place,
            "lifecycle:transition": "complete",
            "kind": "run",
        }
        status = "none" if instruction.status is None else instruction.status.value
        reason = {"status": status, "cause": instruction.cause}
        return _strings(
            {
                **names,
                "concept:instance": instruction.run,
                "org:resource": instruction.action,
                **reason,
            }
        )
    if isinstance(instruction, Corrected):
        names = {
            "concept:name": f"verdict on {instruction.place}",
            "lifecycle:transition": "complete",
            "kind": "verdict",
        }
        reason = {"status": instruction.status.value, "cause": instruction.cause}
        return _strings(
            {
                **names,
                "concept:instance": instruction.run,
                "org:resource": instruction.action,
                **reason,
            }
        )
    return None


def _strings(values: dict[str, str]) -> str:
    return "".join(
        f"<string key={quoteattr(k)} value={quoteattr(v)}/>" for k, v in values.items() if v
    )
