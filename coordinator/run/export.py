"""Exports a journal to other tools: JSON lines (everything), XES (process mining: one trace, with
an event for each firing and run) and MCAP (Foxglove)."""

from __future__ import annotations

import importlib
import io
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final
from xml.sax.saxutils import quoteattr

from petrobot.coordinator.engine import (
    Corrected,
    Fired,
    Instruction,
    Report,
    RunRecorded,
    StartRun,
    to_plain,
)
from petrobot.coordinator.run.journal import Journal
from petrobot.coordinator.run.recording import RecordedStep, Remark, TakeOver, with_asides
from petrobot.coordinator.task.net import Net
from petrobot.services.host.json_text import json_text, without_controls
from petrobot.services.host.toml_text import InputError
from petrobot.services.host.whole_file import write_whole


def jsonl(journal: Journal, steps: Iterator[RecordedStep]) -> Iterator[str]:
    """One line for the header, then one for each stimulus with the instructions that followed, for
    a remark, or for a resume by another coordinator."""
    yield json_text({"kind": "header", **journal.header}, ensure_ascii=False)
    for step in with_asides(journal, steps):
        line: dict[str, Any] = {"number": step.number, "t": step.time}
        if isinstance(step, Remark):
            remark = {"author": step.author, "text": step.text}
            yield json_text({**line, "remark": remark}, ensure_ascii=False)
            continue
        if isinstance(step, TakeOver):
            yield json_text({**line, "epoch": step.epoch}, ensure_ascii=False)
            continue
        line |= {
            "stimulus": to_plain(step.stimulus),
            "instructions": [to_plain(instruction) for instruction in step.instructions],
            "marking": list(step.state.marking),
        }
        if step.repeated:
            line["repeated"] = True
        yield json_text(line, ensure_ascii=False)


def xes(journal: Journal, steps: Iterator[RecordedStep]) -> Iterator[str]:
    """Return the run as an XES log (IEEE 1849-2016) with one trace; times count from the date in
    the header."""
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
    elif isinstance(instruction, Corrected):
        names = {
            "concept:name": f"verdict on {instruction.place}",
            "lifecycle:transition": "complete",
            "kind": "verdict",
        }
    else:
        return None
    status = "none" if instruction.status is None else instruction.status.value
    return _strings(
        {
            **names,
            "concept:instance": instruction.run,
            "org:resource": instruction.action,
            "status": status,
            "cause": instruction.cause,
        }
    )


def _strings(values: dict[str, str]) -> str:
    return "".join(
        f"<string key={quoteattr(k)} value={quoteattr(without_controls(v))}/>"
        for k, v in values.items()
        if v
    )


# The MCAP file (mcap.dev) needs the package `mcap`.

_TEXT: Final = {"type": "string"}
_NUMBER: Final = {"type": "number"}
CHANNELS: Final[Mapping[str, Mapping[str, Any]]] = {
    "marking": {
        "tokens": {"type": "object", "additionalProperties": {"type": "integer"}},
        "stimulus": _TEXT,
    },
    "firing": {"transition": _TEXT, "cause": _TEXT, "number": _NUMBER},
    "run": {
        "run": _TEXT,
        "place": _TEXT,
        "action": _TEXT,
        "phase": {"type": "string", "enum": ["started", "ended", "judged"]},
        "status": _TEXT,
        "cause": _TEXT,
        "text": _TEXT,
        "executed": _TEXT,
        "seconds": _NUMBER,
    },
    "report": {"severity": _TEXT, "key": _TEXT, "text": _TEXT, "of": _TEXT},
}
"""Topic `/petrobot/NAME`: properties of its messages."""


class McapMissingError(InputError):
    """The package `mcap` is not installed; the text says how to get it."""


def write_mcap(path: Path, journal: Journal, net: Net, steps: Iterable[RecordedStep]) -> int:
    """Write the file; gives the number of messages. Raises McapMissingError, OSError."""
    try:
        writing = importlib.import_module("mcap.writer")
    except ImportError:
        raise McapMissingError(
            "MCAP files need the package mcap: pip install 'petrobot[mcap]'"
        ) from None
    count = 0
    with io.BytesIO() as file:
        writer = writing.Writer(file)
        writer.start(profile="petrobot", library="petrobot")
        writer.add_metadata(
            "petrobot", {k: str(journal.header[k]) for k in ("mission", "mode", "date", "seed")}
        )
        channels = {name: _channel(writer, name) for name in CHANNELS}
        for count, (name, time, message) in enumerate(messages(journal, net, steps), 1):
            data = json_text(message, ensure_ascii=False).encode()
            writer.add_message(
                channels[name], log_time=time, publish_time=time, sequence=count, data=data
            )
        writer.finish()
        write_whole(path, file.getvalue())
    return count


def messages(
    journal: Journal, net: Net, steps: Iterable[RecordedStep]
) -> Iterator[tuple[str, int, dict[str, Any]]]:
    """Yield channel, time (ns since 1970) and body of each message, in order."""
    origin = round(datetime.fromisoformat(journal.header["date"]).timestamp() * 1e9)
    for step in steps:
        time = origin + round(step.time * 1e9)
        for instruction in step.instructions:
            told = _told(instruction)
            if told is not None:
                yield told[0], time, told[1]
        tokens = dict(zip(net.places, step.state.marking, strict=True))
        yield "marking", time, {"tokens": tokens, "stimulus": type(step.stimulus).__name__}


def _told(one: Instruction) -> tuple[str, dict[str, Any]] | None:
    if isinstance(one, Fired):
        return "firing", {"transition": one.transition, "cause": one.cause, "number": one.number}
    if isinstance(one, StartRun):
        return "run", {"run": one.run, "place": one.place, "action": one.action, "phase": "started"}
    if isinstance(one, RunRecorded):
        status = "none" if one.status is None else one.status.value
        how = {
            "status": status,
            "cause": one.cause,
            "text": one.text,
            "executed": one.executed.value,
        }
        which = {"run": one.run, "place": one.place, "action": one.action, "phase": "ended"}
        return "run", {**which, **how, "seconds": one.seconds}
    if isinstance(one, Corrected):
        which = {"run": one.run, "place": one.place, "action": one.action, "phase": "judged"}
        return "run", {**which, "status": one.status.value, "cause": one.cause, "text": one.text}
    if isinstance(one, Report):
        return "report", {
            "severity": one.severity.value,
            "key": one.key,
            "text": one.text,
            "of": one.of,
        }
    return None


def _channel(writer: Any, name: str) -> int:
    schema = {"type": "object", "title": f"petrobot.{name}", "properties": CHANNELS[name]}
    schema_id = writer.register_schema(f"petrobot.{name}", "jsonschema", json_text(schema).encode())
    return int(writer.register_channel(f"/petrobot/{name}", "json", schema_id))
