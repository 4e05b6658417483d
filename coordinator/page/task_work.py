"""Work on task files that may take long for a large net, as functions of plain data: open, save,
check, convert.

The page's server runs all of it in a separate process (`coordinator.background.BackgroundProcess`)
under the names in `WORKS`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tomlkit
from msgspec import Struct

from petrobot.coordinator.analysis.may_run import Cell, assumed, devices_of
from petrobot.coordinator.background import RefusedError
from petrobot.coordinator.operator.task_check import judge_text
from petrobot.coordinator.page.edits import EditError, Rename, parse, plain
from petrobot.coordinator.page.task_store import Conflict, TaskStore, TaskText
from petrobot.coordinator.task import Kind, Task
from petrobot.coordinator.task.file import TaskFileError, dumps, loads

if TYPE_CHECKING:  # few conversions need formats and numpy, and the designer waits for their import
    from petrobot.coordinator.analysis.formats.netfile import NetFile

# Nets of other tools as the text of a task file that can be edited: names, marking, weights,
# inhibitors and positions (pure functions).

_NOT_NAME = re.compile(r"\W+")


def as_task_file(model: NetFile) -> str:
    """Return a net as a task file. Its places are control places, which the user then changes;
    `final` is never true until it is edited."""
    names = usable_names(model)
    document = tomlkit.document()
    document.add("schema", tomlkit.item(1))
    document.add(
        "task", tomlkit.item({"name": _free(model.name or "imported", set()), "final": "false"})
    )
    places, transitions = tomlkit.table(is_super_table=True), tomlkit.table(is_super_table=True)
    net = model.net
    for place, tokens, capacity in zip(net.places, net.initial, net.capacity, strict=True):
        own = {"tokens": tokens} if tokens else {}
        most = {} if capacity is None else {"capacity": capacity}
        places.add(
            names[place],
            tomlkit.item({"kind": Kind.CONTROL.value, **own, **most, **_position(model, place)}),
        )
    for t, name in enumerate(net.transitions):
        takes = [_arc(names[net.places[p]], w) for p, w in net.consume[t]]
        takes += [f"!{_arc(names[net.places[p]], w)}" for p, w in net.inhibit[t]]
        gives = [_arc(names[net.places[p]], w) for p, w in net.produce[t]]
        first = {"priority": net.priority[t]} if net.priority[t] else {}
        fields = {"in": takes, "out": gives, **first, **_position(model, name)}
        transitions.add(names[name], tomlkit.item(fields))
    document.add("places", places)
    document.add("transitions", transitions)
    return tomlkit.dumps(document)


def usable_names(model: NetFile) -> dict[str, str]:
    """Return for each id of the file a valid and distinct name for a task file, made from its
    label."""
    taken: set[str] = set()
    return {
        i: _free(model.labels.get(i) or i, taken)
        for i in (*model.net.places, *model.net.transitions)
    }


def _arc(place: str, weight: int) -> str:
    return f"{place}*{weight}" if weight > 1 else place


def _position(model: NetFile, name: str) -> dict[str, int]:
    where = model.positions.get(name)
    return {} if where is None else {"x": round(where[0]), "y": round(where[1])}


def _free(label: str, taken: set[str]) -> str:
    stem = _NOT_NAME.sub("_", label.strip()).strip("_") or "element"
    if stem[0].isdigit():
        stem = f"n{stem}"
    name, n = stem, 2
    while name in taken:
        name, n = f"{stem}_{n}", n + 1
    taken.add(name)
    return name


Fields = Mapping[str, Any] | None
"""Fields of a `Cell`; None: it is not known which actions are offered."""


class ConvertedTask(Struct, frozen=True):
    """A task in another format."""

    text: str
    content_type: str


def findings(text: str, filename: str, cell: Fields, services: str = "") -> list[dict[str, Any]]:
    """Return errors and warnings of the task: {severity, key, text, remedy, line}; errors first.
    With the path of a location file those about its code, too. Those that only a search of the
    states decides come with the analysis."""
    return judge_text(text, filename, services, cell, search=False).findings()


def load(text: str, filename: str) -> Task:
    """Return the task in a text. Raises RefusedError with all faults."""
    try:
        return loads(text, filename)
    except TaskFileError as error:
        raise RefusedError(400, str(error)) from error


def export(
    text: str, filename: str, form: str, cell: Fields, estimates: str = "", plant: str = ""
) -> ConvertedTask:
    """Return the task in another format; `gspn.svg` draws its stochastic view, with the numbers
    that `newest_measured` finds. Raises RefusedError."""
    task = load(text, filename)
    if form == "toml":
        return ConvertedTask(dumps(task), "application/toml")
    if form == "pnml":
        from petrobot.coordinator.analysis.commands import net_file_of
        from petrobot.coordinator.analysis.formats.pnml import write_pnml

        return ConvertedTask(write_pnml(net_file_of(task)), "application/xml")
    if form == "gspn.svg":
        from petrobot.coordinator.analysis.time.stochastic import stochastic_view
        from petrobot.coordinator.learning.propagation import newest_measured
        from petrobot.coordinator.studies.report.gspn_picture import gspn_svg

        known = None if cell is None else Cell(**cell)
        devices = devices_of(known)
        try:
            measured, source = newest_measured(estimates, task, devices, plant)
            view = stochastic_view(task, measured, devices=devices)
        except ValueError as fault:
            raise RefusedError(400, f"no stochastic view: {fault}") from fault
        legend = "; ".join(filter(None, (source, assumed(known))))
        return ConvertedTask(gspn_svg(view, f"Assumed: {legend}."), "image/svg+xml")
    raise RefusedError(400, f"no format {form!r}: toml, pnml and gspn.svg are known")


def imported(form: str, text: str) -> str:
    """Return a net in another format as the text of a task file. Raises RefusedError."""
    if form == "toml":
        return text
    if form != "pnml":
        raise RefusedError(400, f"no format {form!r}: toml and pnml are known")
    from petrobot.coordinator.analysis.formats.netfile import NetFileError
    from petrobot.coordinator.analysis.formats.pnml import parse_pnml

    try:
        return as_task_file(parse_pnml(text))
    except NetFileError as error:
        raise RefusedError(400, f"not a place/transition net in PNML: {error}") from error


# --- as requests ------------------------------------------------------------------------------


def _store(tasks: str, shipped: str) -> TaskStore:
    return TaskStore(Path(tasks), Path(shipped) if shipped else None)


def _described(task: TaskText, cell: Fields) -> dict[str, Any]:
    """Return a task file for the designer: its document, its text, and the findings of the
    check."""
    try:
        document = plain(parse(task.text))
    except EditError as fault:
        raise RefusedError(422, f"{task.name}.toml: {fault}") from fault
    found = findings(task.text, f"{task.name}.toml", cell)
    about = {"name": task.name, "revision": task.revision, "own": task.own}
    return {**about, "text": task.text, "document": document, "findings": found}


def _open(tasks: str, shipped: str, name: str, cell: Fields) -> dict[str, Any]:
    return _described(_store(tasks, shipped).read(name), cell)


def _save(
    tasks: str,
    shipped: str,
    name: str,
    cell: Fields,
    base: str | None,
    content: dict[str, Any],
    renames: list[Any],
) -> dict[str, Any]:
    """`content` is {document}, or {text} to resolve a conflict. A conflict is refused with both
    versions."""
    store = _store(tasks, shipped)
    try:
        if "text" in content:
            return _described(store.save_text(name, base, content["text"]), cell)
        return _described(store.save(name, base, content["document"], _renames(renames)), cell)
    except Conflict as conflict:
        both = {
            "conflict": str(conflict),
            "yours": conflict.yours,
            "theirs": _described(conflict.theirs, cell),
        }
        raise RefusedError(409, str(conflict), both) from conflict


def _drawn(
    tasks: str, shipped: str, name: str, document: dict[str, Any], renames: list[Any]
) -> dict[str, Any]:
    """Return the text that a drawing would be saved as: {text}."""
    store = _store(tasks, shipped)
    return {"text": store.edited_text(store.current(name), document, _renames(renames))}


def _check(cell: Fields, services: str, name: str, **drawing: Any) -> dict[str, Any]:
    """Return the text that a drawing would be saved as, and the findings of the check."""
    made = _drawn(name=name, **drawing)
    return {"findings": findings(made["text"], f"{name}.toml", cell, services), **made}


def _export(
    tasks: str, shipped: str, name: str, form: str, cell: Fields, estimates: str, plant: str
) -> dict[str, Any]:
    task = _store(tasks, shipped).read(name)
    made = export(task.text, f"{task.name}.toml", form, cell, estimates, plant)
    return {"text": made.text, "content_type": made.content_type}


def _import(form: str, text: str) -> dict[str, Any]:
    try:
        return {"document": plain(parse(imported(form, text)))}
    except EditError as fault:
        raise RefusedError(400, str(fault)) from fault


def _renames(given: list[Any]) -> list[Rename]:
    try:
        return [Rename(tuple(map(str, r["path"])), str(r["old"]), str(r["new"])) for r in given]
    except (TypeError, KeyError):
        raise RefusedError(400, "a rename must be {path, old, new}") from None


WORKS: Mapping[str, Callable[..., Any]] = {
    "opening": _open,
    "saving": _save,
    "drawing": _drawn,
    "check": _check,
    "findings": findings,
    "export": _export,
    "import": _import,
}
