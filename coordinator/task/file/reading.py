"""Task files: TOML to task. All faults are found in one pass and raised together."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from enum import StrEnum
from math import isfinite
from pathlib import Path
from typing import Any, TypeVar

from msgspec.structs import replace

from petrobot.coordinator.task import (
    Counts,
    EarlyEvent,
    End,
    Estimate,
    Event,
    EventMemory,
    Inhibitor,
    Input,
    Kind,
    Output,
    Parameter,
    Place,
    PrimitiveTask,
    Reference,
    Scope,
    Start,
    Status,
    Subnet,
    Task,
    Transition,
    Value,
    Variable,
    VariableType,
)
from petrobot.coordinator.task.conditions import ConditionError, Expression, parse
from petrobot.coordinator.task.expansion import written
from petrobot.coordinator.task.validation import faults as task_faults
from petrobot.coordinator.task.wording import Fault, nearest
from petrobot.services.host.toml_text import (
    InputError,
    TomlError,
    key_lines,
    line_of,
    not_utf8,
    read_toml,
)


class TaskFileError(InputError, ValueError):
    """A task file that cannot be used. `faults` are all that is wrong; `lines[i]` is the line of
    fault i (0: unknown)."""

    def __init__(self, source: str, faults: Sequence[Fault], lines: Sequence[int]) -> None:
        super().__init__(source, faults, lines)
        self.source = source
        self.faults = tuple(faults)
        self.lines = tuple(lines)

    def __str__(self) -> str:
        places = (f"{self.source}:{n}" if n else self.source for n in self.lines)
        return "\n".join(f"{at}: {fault}" for at, fault in zip(places, self.faults, strict=True))


# --- arcs ---
# Their short notation: `ball`, `runs*2`, `locate_ball:normal`, `catch_ball:preempt=success`,
# `!blocked*3`.

W = TypeVar("W", bound=StrEnum)
_ARC = re.compile(
    r"(?P<bar>!?)\s*(?P<place>[\w.]+)(?::(?P<end>\w+)(?:=(?P<counts>\w+))?)?(?:\s*\*\s*(?P<weight>\d{1,9}))?\Z"
)


class ArcError(ValueError):
    """The text is not an arc; the message says how one is written."""


def read_input(text: str) -> Input | Inhibitor:
    """An arc of `in`. Raises ArcError."""
    found = _ARC.match(text.strip())
    if not found:
        raise ArcError(
            f"{text!r} is not an arc: write PLACE, PLACE*2, PLACE:normal, PLACE:preempt=success "
            "or !PLACE"
        )
    weight = int(found["weight"] or 1)
    if found["bar"]:
        if found["end"]:
            raise ArcError(
                f"{text!r}: an inhibitor arc looks at tokens alone: write !{found['place']}"
            )
        return Inhibitor(found["place"], weight)
    end = _word(End, found["end"], text)
    counts = _word(Counts, found["counts"], text)
    return Input(found["place"], weight, end, counts)


def read_output(text: str) -> Output:
    """An arc of `out`. Raises ArcError."""
    found = _ARC.match(text.strip())
    if not found or found["bar"] or found["end"]:
        raise ArcError(f"{text!r} is not an arc of `out`: write PLACE or PLACE*2")
    return Output(found["place"], int(found["weight"] or 1))


def write_arc(arc: Input | Inhibitor | Output) -> str:
    """The notation of an arc."""
    if isinstance(arc, Inhibitor):
        return f"!{arc.place}{_times(arc.threshold)}"
    end = ""
    if isinstance(arc, Input) and arc.end is not None:
        end = f":{arc.end}" + (f"={arc.counts}" if arc.counts is not None else "")
    return f"{arc.place}{end}{_times(arc.weight)}"


def _times(weight: int) -> str:
    return "" if weight == 1 else f"*{weight}"


def _word(words: type[W], text: str | None, arc: str) -> W | None:
    if text is None:
        return None
    try:
        return words(text)
    except ValueError:
        what = f"{arc!r}: {text!r} is none of {', '.join(words)}{nearest(text, list(words))}"
        place, _, _ = arc.partition(":")
        if words is End and text in (Status.SUCCESS, Status.FAILURE):
            what += f"; write {place}:normal, and when = \"{place}.status == '{text}'\""
        raise ArcError(what) from None


# --- tables ---

# Reading one TOML table: every key is asked for by name and type, every fault is collected,
# leftovers are refused.

E = TypeVar("E", bound=StrEnum)
_KINDS: Mapping[type, str] = {
    str: "a text",
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    list: "a list",
    dict: "a table",
}


class Table:
    """A table, its key in the file and the list that collects faults. Wrong or missing values read
    as their default."""

    def __init__(
        self, data: Mapping[str, Any], key: str, faults: list[Fault], flat: bool = False
    ) -> None:
        self.data = data
        self.key = key
        self.faults = faults
        self.flat = flat
        self.asked: set[str] = set()

    def fault(self, name: str, text: str, remedy: str = "") -> None:
        """Note a fault of one of the table's keys."""
        self.faults.append(Fault(f"{self.key}.{name}" if self.key else name, text, remedy))

    def text(self, name: str, default: str | None = None) -> str:
        """A text; required without a default."""
        value: str = self._value(name, str, default, "")
        return value

    def number(self, name: str, default: float | None = None) -> float:
        """A finite number; required without a default."""
        value = float(self._value(name, float, default, 1.0))
        if not isfinite(value):
            self.fault(name, f"expected a finite number, got {value}", "give a finite number")
            return 1.0
        return value

    def maybe_number(self, name: str) -> float | None:
        """A finite number, or None if the key is absent."""
        self.asked.add(name)
        return self.number(name) if name in self.data else None

    def integer(self, name: str, default: int) -> int:
        """A whole number."""
        value: int = self._value(name, int, default, default)
        return value

    def maybe_integer(self, name: str) -> int | None:
        """A whole number, or None if the key is absent."""
        self.asked.add(name)
        return self.integer(name, 1) if name in self.data else None

    def flag(self, name: str) -> bool:
        """True or false; false if absent."""
        value: bool = self._value(name, bool, False, False)
        return value

    def word(self, name: str, words: type[E], default: E | None = None) -> E:
        """One of the words of an enumeration; required without a default."""
        first = next(iter(words))
        if default is None and name not in self.data:
            self.asked.add(name)
            self.fault(name, "missing", f"give one of {', '.join(words)}")
            return first
        text = self._value(name, str, default, first)
        try:
            return words(text)
        except ValueError:
            self.fault(
                name,
                f"{text!r} is none of {', '.join(words)}",
                nearest(text, list(words)).strip(" ()") or "write one of these",
            )
            return first

    def texts(self, name: str, single: bool = False) -> tuple[str, ...]:
        """A list of texts (or, if allowed, a single text); empty if absent."""
        if single and isinstance(self.data.get(name), str):
            return (self.text(name),)
        values: list[Any] = self._value(name, list, [], [])
        for value in values:
            if not isinstance(value, str):
                self.fault(name, f"expected a text, got {value!r}", "write each in quotes")
        return tuple(v for v in values if isinstance(v, str))

    def plain(self, name: str) -> dict[str, Any]:
        """A table taken as it is; empty if absent."""
        value: dict[str, Any] = self._value(name, dict, {}, {})
        return dict(value)

    def any(self, name: str) -> Any:
        """Any value, or None if the key is absent."""
        self.asked.add(name)
        return self.data.get(name)

    def table(self, name: str) -> Table:
        """A table in this one; an absent one is empty."""
        key = f"{self.key}.{name}" if self.key else name
        return Table(self.plain(name), key, self.faults, self.flat)

    def tables(self, name: str) -> dict[str, Table]:
        """A table of tables."""
        outer = self.table(name)
        found: dict[str, Table] = {}
        for key, value in outer.data.items():
            if isinstance(value, dict):
                found[key] = Table(value, f"{outer.key}.{key}", self.faults, self.flat)
            else:
                outer.fault(key, f"expected a table, got {value!r}", f"write [{outer.key}.{key}]")
        return found

    def done(self) -> None:
        """Refuse every key that was not asked for."""
        for name in self.data:
            if name not in self.asked:
                near = nearest(name, self.asked).strip(" ()")
                self.fault(
                    name, "unknown key", near or f"known here: {', '.join(sorted(self.asked))}"
                )

    def _value(self, name: str, kind: type, default: Any, fallback: Any) -> Any:
        self.asked.add(name)
        if name not in self.data:
            if default is None:
                self.fault(name, "missing", f"give {_KINDS[kind]}")
                return fallback
            return default
        value = self.data[name]
        fits = isinstance(value, (int, float) if kind is float else kind)
        if fits and (kind is bool or not isinstance(value, bool)):
            return value
        self.fault(name, f"{value!r} is not {_KINDS[kind]}", f"give {_KINDS[kind]}")
        return fallback


SCHEMA = 1
LARGEST = 4 << 20


def load(path: str | Path) -> Task:
    """The task in a file. Raises TaskFileError with every fault."""
    return loads(read_text(Path(path)), str(path))


def read_text(path: Path) -> str:
    """The text of a task file. Raises TaskFileError if it cannot be one."""
    try:
        data = path.read_bytes()
    except OSError as error:
        near = ""
        if isinstance(error, FileNotFoundError):
            near = nearest(path.name, [other.name for other in path.parent.glob("*.toml")])
        remedy = f"check the path and its permissions{near}"
        fault = Fault("file", f"cannot be read: {error.strerror}", remedy)
        raise TaskFileError(str(path), [fault], [0]) from error
    if len(data) > LARGEST:
        raise TaskFileError(
            str(path), [Fault("file", f"{len(data)} bytes", f"a task has at most {LARGEST}")], [0]
        )
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise _faulty(not_utf8(error, str(path))) from error


def _faulty(error: TomlError) -> TaskFileError:
    fault = Fault(error.key, error.found, error.remedy)
    return TaskFileError(error.source, [fault], [error.line or 0])


def loads(
    text: str, source: str = "task", *, flat: bool = False, data: Mapping[str, Any] | None = None
) -> Task:
    """The task in a TOML text; `source` names it in errors. Raises TaskFileError with every
    fault.

    `flat`: the text is a flat task that petrobot wrote (`dumps(task.flat)`): its names may have
    dots, its elements say what they were made from, and it was judged before. `data` is read in
    place of the text's own, which then only gives the lines of faults.
    """
    try:
        data = read_toml(text, source) if data is None else data
    except TomlError as error:
        raise _faulty(error) from error
    if "nodes" in data and "task" not in data:
        remedy = "name the task: petrobot check TASK.toml finds the services.toml beside it"
        raise TaskFileError(
            source, [Fault("file", "this is a location file, not a task", remedy)], [0]
        )
    faults: list[Fault] = []
    task = _task(Table(data, "", faults, flat))
    if not flat:
        faults = faults or list(task_faults(task))
    if faults:
        lines = key_lines(text)
        raise TaskFileError(source, faults, [line_of(f.key, lines) for f in faults])
    return replace(task, is_flat=True) if flat else task


def _task(root: Table) -> Task:
    schema = root.any("schema")
    if schema != SCHEMA or isinstance(schema, bool):
        known = "missing" if schema is None else f"{schema!r} is not known here"
        remedy = f"write schema = {SCHEMA}, the layout that this version reads"
        root.fault("schema", known, remedy)
    head = root.table("task")
    task = Task(
        name=head.text("name"),
        text=head.text("text", ""),
        goal=head.text("goal", ""),
        goal_transitions=head.texts("goal_transitions"),
        final=_condition(head, "final") or parse("false"),
        final_error=_condition(head, "final_error") if "final_error" in head.data else None,
        runs_place=head.text("runs_place", ""),
        prepare=head.text("prepare", ""),
        score=head.text("score", ""),
        pictures=head.text("pictures", ""),
        services=head.text("services", ""),
        parameters=head.plain("parameters"),
        primitive_tasks={
            n: _primitive_task(n, t) for n, t in root.tables("primitive_tasks").items()
        },
        variables={n: _variable(n, t) for n, t in root.tables("variables").items()},
        events={n: _event(n, t) for n, t in root.tables("events").items()},
        places={n: _place(n, t) for n, t in root.tables("places").items()},
        transitions={n: _transition(n, t) for n, t in root.tables("transitions").items()},
        subnets={n: _subnet(n, t) for n, t in root.tables("subnets").items()},
        errors_to=_errors_to(root),
    )
    head.any("final_error")
    head.done()
    root.done()
    return task


def _primitive_task(name: str, t: Table) -> PrimitiveTask:
    alternatives = t.texts("alternatives")
    primitive = PrimitiveTask(
        name=name,
        goal=t.text("goal", ""),
        specification=t.text("specification", ""),
        alternatives=alternatives if "alternatives" in t.data else (name,),
        deadline=t.number("deadline"),
        target_reliability=t.maybe_number("target_reliability"),
        cost=t.text("cost", "wall"),
        error_causes=_texts(t.table("error_causes")),
        start=t.word("start", Start, Start.WHEN_FREE),
        stop_within=t.number("stop_within", 2.0),
        estimates=_estimates(t),
        costs=_costs(t.table("costs")),
    )
    t.done()
    return primitive


def _costs(t: Table) -> dict[str, float]:
    return {action: t.number(action) for action in t.data}


def _texts(t: Table) -> dict[str, str]:
    return {name: t.text(name) for name in t.data}


def _estimates(t: Table) -> dict[Status, Estimate]:
    table = t.table("estimates")
    estimates: dict[Status, Estimate] = {}
    for status in Status:
        table.asked.add(status.value)
        if status.value in table.data:
            e = table.table(status.value)
            estimates[status] = Estimate(e.number("share"), e.number("mean"), e.number("cv", 1.0))
            e.done()
    table.done()
    return estimates


def _variable(name: str, t: Table) -> Variable:
    variable = Variable(name, t.word("type", VariableType), t.any("initial"), t.texts("values"))
    t.done()
    return variable


def _event(name: str, t: Table) -> Event:
    event = Event(
        name=name,
        scope=t.word("scope", Scope, Scope.INTERNAL if "by" in t.data else Scope.EXTERNAL),
        memory=t.word("memory", EventMemory, EventMemory.PULSE),
        early=t.word("early", EarlyEvent, EarlyEvent.DROP),
        by=t.text("by", ""),
        mean_wait=t.maybe_number("mean_wait"),
        text=t.text("text", ""),
    )
    t.done()
    return event


def _errors_to(t: Table) -> str:
    """The key `to` of an `[errors]` table; empty without the table."""
    if "errors" not in t.data:
        t.table("errors")
        return ""
    errors = t.table("errors")
    to = errors.text("to")
    errors.done()
    return to


def _place(name: str, t: Table) -> Place:
    kind = _kind(t)
    place = Place(
        name=name,
        kind=kind,
        tokens=t.integer("tokens", 0),
        capacity=t.maybe_integer("capacity"),
        task=t.text("task", name if kind is Kind.ACTION else ""),
        args={n: _argument(v) for n, v in t.plain("args").items()},
        out=_texts(t.table("out")),
        servers=t.maybe_integer("servers"),
        tries=t.integer("tries", 1),
        retry_unknown=t.flag("retry_unknown"),
        timeout=t.maybe_number("timeout"),
        listen=t.flag("listen"),
        holds=t.texts("holds", single=True),
        subnet=t.text("subnet", ""),
        macro=t.text("macro", ""),
        expanded_from=t.text("expanded_from", "") if t.flat else "",
        label=t.text("label", ""),
        x=t.maybe_number("x"),
        y=t.maybe_number("y"),
    )
    t.done()
    return place


def _kind(t: Table) -> Kind:
    """The kind of a place: plain if the file says nothing."""
    for key, kind in (("task", Kind.ACTION), ("subnet", Kind.MACRO)):
        if key in t.data and "kind" not in t.data:
            t.any("kind")
            t.fault("kind", f"missing beside `{key}`", f'write kind = "{kind}"')
            return kind
    return t.word("kind", Kind, Kind.PLAIN)


def _argument(value: Any) -> Value:
    if isinstance(value, dict) and set(value) == {"var"} and isinstance(value["var"], str):
        return Reference(value["var"])
    return value


def _transition(name: str, t: Table) -> Transition:
    arcs = _inputs(t)
    transition = Transition(
        name=name,
        inputs=tuple(a for a in arcs if isinstance(a, Input)),
        inhibitors=tuple(a for a in arcs if isinstance(a, Inhibitor)),
        outputs=_outputs(t),
        events=t.texts("event", single=True),
        when=_condition(t, "when") if "when" in t.data else None,
        priority=t.integer("priority", 0),
        weight=t.maybe_number("weight"),
        after=t.maybe_number("after"),
        sets=_sets(t.table("set")),
        error_branch=t.flag("error_branch"),
        macro=t.text("macro", ""),
        expanded_from=t.text("expanded_from", "") if t.flat else "",
        label=t.text("label", ""),
        x=t.maybe_number("x"),
        y=t.maybe_number("y"),
    )
    t.any("when")
    t.done()
    return transition


def _sets(t: Table) -> tuple[tuple[str, Expression], ...]:
    """The new values of variables: a text is a condition's literal or name, all else a literal."""
    found: list[tuple[str, Expression]] = []
    for name in t.data:
        value = t.any(name)
        try:
            found.append((name, parse(value if isinstance(value, str) else written(value))))
        except (ConditionError, ValueError) as error:
            t.fault(name, str(error), "write a literal ('text', 3, true) or a name")
    return tuple(found)


def _inputs(t: Table) -> list[Input | Inhibitor]:
    arcs: list[Input | Inhibitor] = []
    for text in t.texts("in"):
        try:
            arcs.append(read_input(text))
        except ArcError as error:
            t.fault("in", str(error))
    return arcs


def _outputs(t: Table) -> tuple[Output, ...]:
    arcs: list[Output] = []
    for text in t.texts("out"):
        try:
            arcs.append(read_output(text))
        except ArcError as error:
            t.fault("out", str(error))
    return tuple(arcs)


def _condition(t: Table, name: str) -> Expression | None:
    text = t.text(name)
    if not text:
        if name in t.data and isinstance(t.data[name], str):
            t.fault(name, "an empty condition", "write one, or drop the key")
        return None
    try:
        return parse(text)
    except ConditionError as error:
        t.fault(name, str(error))
        return None


def _subnet(name: str, t: Table) -> Subnet:
    subnet = Subnet(
        name=name,
        places={n: _place(n, p) for n, p in t.tables("places").items()},
        transitions={n: _transition(n, p) for n, p in t.tables("transitions").items()},
        entry=t.text("entry"),
        normal=t.text("normal"),
        error=t.text("error", ""),
        errors_to=_errors_to(t),
        parameters=_parameters(t.table("parameters")),
    )
    t.done()
    return subnet


def _parameters(t: Table) -> dict[str, Parameter]:
    return {name: t.word(name, Parameter) for name in t.data}
