"""Task files: a task as TOML that people write by hand, and back. The format is described in
docs/task-file.md."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from enum import StrEnum
from typing import Any

from msgspec.structs import fields

from petrobot.coordinator.task import Kind, Place, Reference, Subnet, Task, Transition
from petrobot.coordinator.task.conditions import Expression
from petrobot.coordinator.task.file.reading import (
    SCHEMA,
    TaskFileError as TaskFileError,
    load as load,
    loads as loads,
    write_arc,
)

# --- writing: canonically, so the same task always gives the same text ---

_SHORT = {"\\": "\\\\", '"': '\\"', "\n": "\\n", "\t": "\\t", "\r": "\\r"}


def dumps(task: Task) -> str:
    """The task as TOML text."""
    head = {
        k: getattr(task, k)
        for k in ("name", "text", "goal", "goal_transitions", "final", "final_error")
    }
    head |= {
        k: getattr(task, k) for k in ("runs_place", "prepare", "score", "pictures", "services")
    }
    lines = [f"schema = {SCHEMA}", ""]
    lines += _section("task", head)
    if task.parameters:
        lines += _section("task.parameters", task.parameters, keep=True)
    lines += _errors("", task.errors_to)
    for group in ("primitive_tasks", "variables", "events"):
        for name, record in getattr(task, group).items():
            values = _changed(record)
            # An empty text is the value of a variable: left out, it would be none.
            lines += _section(f"{group}.{_name(name)}", values, keep="initial" in values)
    lines += _net("", task.places, task.transitions)
    for subnet in task.subnets.values():
        lines += _subnet(subnet)
    return "\n".join(lines).rstrip() + "\n"


def _subnet(subnet: Subnet) -> list[str]:
    key = f"subnets.{_name(subnet.name)}"
    ports = {"entry": subnet.entry, "normal": subnet.normal, "error": subnet.error}
    parameters = subnet.parameters and _section(f"{key}.parameters", subnet.parameters)
    return [
        *_section(key, ports),
        *parameters,
        *_errors(f"{key}.", subnet.errors_to),
        *_net(f"{key}.", subnet.places, subnet.transitions),
    ]


def _errors(prefix: str, to: str) -> list[str]:
    return _section(f"{prefix}errors", {"to": to}) if to else []


def _net(
    prefix: str, places: Mapping[str, Place], transitions: Mapping[str, Transition]
) -> list[str]:
    lines: list[str] = []
    for name, place in places.items():
        values = _changed(place)
        if place.kind is Kind.PLAIN:
            del values["kind"]
        lines += _section(f"{prefix}places.{_name(name)}", values)
    for name, transition in transitions.items():
        lines += _section(f"{prefix}transitions.{_name(name)}", _transition(transition))
    return lines


def _transition(t: Transition) -> dict[str, Any]:
    inward = [write_arc(a) for a in t.inputs] + [write_arc(a) for a in t.inhibitors]
    values: dict[str, Any] = {"in": inward}
    values["out"] = [write_arc(a) for a in t.outputs]
    if t.events:
        values["event"] = t.events[0] if len(t.events) == 1 else t.events
    rest = _changed(t)
    for name in ("inputs", "inhibitors", "outputs", "events"):
        rest.pop(name, None)
    if "sets" in rest:
        values["set"] = dict(rest.pop("sets"))
    return values | rest


def _changed(record: Any) -> dict[str, Any]:
    """The fields of a record that are not at their default, without its name."""
    return {
        f.name: int(value) if f.name in ("x", "y") and value == int(value) else value
        for f in fields(record)
        if f.name != "name"
        and (value := getattr(record, f.name)) != f.default
        and value not in ({}, None)
    }


def _section(key: str, values: Mapping[str, Any], keep: bool = False) -> list[str]:
    shown = {k: v for k, v in values.items() if keep or v not in ("", (), None)}
    return [f"[{key}]", *(f"{_name(k)} = {_value(v)}" for k, v in shown.items()), ""]


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Expression):
        return _quoted(value.text)
    if isinstance(value, str | StrEnum):
        return _quoted(str(value))
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, Reference):
        return f"{{ var = {_quoted(value.variable)} }}"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(_pairs(value)) + " }" if value else "{}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(v) for v in value) + "]"
    return "{ " + ", ".join(_pairs({f.name: getattr(value, f.name) for f in fields(value)})) + " }"


def _pairs(values: Mapping[str, Any]) -> Iterator[str]:
    return (f"{_name(str(k))} = {_value(v)}" for k, v in values.items())


def _name(text: str) -> str:
    bare = text.isascii() and text.replace("_", "").replace("-", "").isalnum()
    return text if bare else _quoted(text)


def _quoted(text: str) -> str:
    return (
        '"'
        + "".join(_SHORT.get(c, c if c.isprintable() or c == " " else _escape(c)) for c in text)
        + '"'
    )


def _escape(c: str) -> str:
    return f"\\u{ord(c):04X}" if ord(c) < 0x10000 else f"\\U{ord(c):08X}"
