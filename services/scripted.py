"""Scripted stand-ins for actions (`--mock FILE`): what each run of an action answers, after how
long, with which events.

schema = 1
[actions.locate_ball]            # one rule for all runs ...
status = "success"
seconds = 0.2
values = { point = [1.0, 0.2, 0.6] }

[[actions.catch_ball]]           # ... or one table for each run, cycled
status = "failure"
cause = "missed"
seconds = [0.5, 0.8]             # drawn uniformly, keyed by seed and run
[[actions.catch_ball]]
status = "success"
events = [{ after = 0.1, name = "contact", data = { force = 2.0 } }]
"""

from __future__ import annotations

from collections.abc import Awaitable, Iterable, Mapping
from pathlib import Path
from typing import Any

from msgspec import Struct, field

from petrobot.services.action import Context, Result, Status, success
from petrobot.services.comm.location_file.reading import nearest
from petrobot.services.host.toml_text import TomlError, read_toml

_KEYS = ("status", "seconds", "values", "cause", "text", "events", "deferred")
_EVENT_KEYS = ("after", "name", "data")


class ScriptError(Exception):
    """A script file is refused; one line for each fault."""


class ScriptedEvent(Struct, frozen=True):
    """An event that a scripted run raises, with the seconds after its beginning."""

    after: float
    name: str
    data: Mapping[str, Any] = field(default_factory=dict)


class ScriptedRun(Struct, frozen=True):
    """What one run does: status, cause and values after a time drawn from `seconds` = (shortest,
    longest)."""

    status: Status = Status.SUCCESS
    seconds: tuple[float, float] = (0.0, 0.0)
    values: Mapping[str, Any] = field(default_factory=dict)
    cause: str = ""
    text: str = ""
    events: tuple[ScriptedEvent, ...] = ()
    deferred: bool = False
    """Its status is provisional."""


class Scripted:
    """A callable action that plays its lines one run after the other, over and over. Takes any
    arguments."""

    def __init__(self, lines: Iterable[ScriptedRun]) -> None:
        self._lines = tuple(lines)
        self._runs = 0

    @property
    def events(self) -> tuple[str, ...]:
        """Names of the events that its runs raise."""
        return tuple(dict.fromkeys(cue.name for line in self._lines for cue in line.events))

    def __call__(self, ctx: Context, **_: Any) -> Awaitable[Result]:
        """Play the next line."""
        line = self._lines[self._runs % len(self._lines)]
        self._runs += 1
        return _play(ctx, line)


def nothing(ctx: Context, **_: Any) -> Result:
    """Do nothing, and succeed: in the place of an action that does not exist yet."""
    return success()


async def _play(ctx: Context, line: ScriptedRun) -> Result:
    begun = ctx.now
    shortest, longest = line.seconds
    seconds = (
        shortest if shortest == longest else float(ctx.random("script").uniform(shortest, longest))
    )
    for cue in sorted(line.events, key=lambda c: c.after):
        if cue.after > seconds:
            break
        await ctx.sleep(begun + cue.after - ctx.now)
        ctx.raise_event(cue.name, **cue.data)
    if begun + seconds > ctx.now:
        await ctx.sleep(begun + seconds - ctx.now)
    return Result(line.status, line.values, line.cause, line.text, line.deferred)


def load(path: str | Path) -> dict[str, Scripted]:
    """Scripted actions by name. Raises ScriptError with every fault of the file, OSError when it
    cannot be read."""
    source = Path(path)
    try:
        data = read_toml(source.read_bytes(), str(source))
    except TomlError as fault:
        raise ScriptError(str(fault)) from fault
    faults = [f"{source}: {f}" for f in _top_faults(data)]
    scripted: dict[str, Scripted] = {}
    for name, rule in data.get("actions", {}).items() if not faults else ():
        try:
            lines = [_line(table) for table in (rule if isinstance(rule, list) else [rule])]
            scripted[name] = Scripted(lines)
        except ValueError as fault:
            faults.append(f"{source}: actions.{name}: {fault}")
    if faults:
        raise ScriptError("\n".join(faults))
    return scripted


def _top_faults(data: Mapping[str, Any]) -> Iterable[str]:
    if data.get("schema") != 1:
        yield "schema: write schema = 1"
    for key in data:
        if key not in ("schema", "actions"):
            yield f"{key}: unknown table{nearest(key, ('schema', 'actions'))}"
    if not isinstance(data.get("actions", {}), dict):
        yield "actions: write [actions.NAME] tables"


def _line(table: Any) -> ScriptedRun:
    if not isinstance(table, dict):
        raise ValueError(f"is {table!r}; write a table with {', '.join(_KEYS)}")
    for key in table:
        if key not in _KEYS:
            raise ValueError(f"unknown key {key!r}{nearest(key, _KEYS)}")
    status = table.get("status", "success")
    if status not in tuple(Status):
        raise ValueError(f'status is {status!r}; write "success", "failure" or "error"')
    values = table.get("values", {})
    if not isinstance(values, dict):
        raise ValueError(f"values is {values!r}; write a table")
    cues = tuple(_cue(cue) for cue in table.get("events", ()))
    cause, text = str(table.get("cause", "")), str(table.get("text", ""))
    deferred = table.get("deferred", False)
    if not isinstance(deferred, bool):
        raise ValueError(f"deferred is {deferred!r}; write true if its status is provisional")
    return ScriptedRun(
        Status(status), _seconds(table.get("seconds", 0.0)), values, cause, text, cues, deferred
    )


def _seconds(value: Any) -> tuple[float, float]:
    pair = value if isinstance(value, list) else [value, value]
    numbers = [v for v in pair if isinstance(v, int | float) and not isinstance(v, bool)]
    if len(pair) != 2 or len(numbers) != 2 or not 0 <= numbers[0] <= numbers[1]:
        raise ValueError(f"seconds is {value!r}; write a number, or [shortest, longest]")
    return float(pair[0]), float(pair[1])


def _cue(table: Any) -> ScriptedEvent:
    if (
        not isinstance(table, dict)
        or set(table) - set(_EVENT_KEYS)
        or not isinstance(table.get("name"), str)
    ):
        raise ValueError(f"event {table!r}; write {{ after = seconds, name = text, data = table }}")
    return ScriptedEvent(_seconds(table.get("after", 0.0))[0], table["name"], table.get("data", {}))
