"""The form with which an operator starts a run on the page: its fields with types and defaults,
reading it from plain data, and refusals that name the wrong field.

The page offers the options of `petrobot run`: real time or lock step, number of runs, seed, the
task's own parameters, learning into an estimates file; and, in lock step, a point of a recorded run
to start from.
"""

from __future__ import annotations

import re
import reprlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Item

from petrobot.coordinator.background import RefusedError
from petrobot.coordinator.learning.learner import usual_contexts
from petrobot.coordinator.learning.selectors import CREDITS, DEFAULT, RULES
from petrobot.coordinator.learning.session import LearningSetting
from petrobot.coordinator.operator.prepare import SEED, RecordedPoint, RunRequest
from petrobot.coordinator.operator.session import LOCKSTEP, MODES, REALTIME
from petrobot.coordinator.operator.start_from import AGAIN
from petrobot.coordinator.page.task_store import StoreError, TaskStore
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import loads
from petrobot.services.host.command_line import LARGEST_SEED, MOST_RUNS

LONGEST_TEXT: Final = 10_000
SUFFIX: Final = ".db"
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,63}")
_KINDS: Final = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
_SHORT: Final = reprlib.Repr()
_KNOWN: Final = frozenset(
    {"task", "mode", "runs", "seed", "regime", "parameters", "learn", "pace", "from", "revision"}
)


def read_start(task: Task, data: Mapping[str, Any], estimates: Path) -> RunRequest:
    """Read a client's request; `estimates` is the folder of estimates files. Raises ValueError with
    the field, the fault and the remedy."""
    _refuse_unknown(data)
    mode = data.get("mode") or REALTIME
    if mode not in MODES:
        raise ValueError(f"mode: {_shown(mode)} is not one of {', '.join(MODES)}")
    runs = data.get("runs")
    if runs is not None:
        if not task.runs_place:
            raise ValueError(f"runs: {task.name} does not count runs (it has no runs_place)")
        runs = _whole("runs", runs, 1, MOST_RUNS)
    return RunRequest(
        mode,
        runs,
        SEED if data.get("seed") is None else _whole("seed", data["seed"], 0, LARGEST_SEED),
        read_parameters(task, _with_regime(data)),
        learning=None if data.get("learn") is None else _learn(data["learn"], estimates),
        pace=_pace(data.get("pace")),
    )


def read_start_from(task: Task, data: Mapping[str, Any]) -> RunRequest:
    """Read a start with `from`: {run, record, going}; the default seed is that of the recorded run.
    Raises ValueError."""
    _refuse_unknown(data)
    source = data["from"]
    if not isinstance(source, Mapping) or not isinstance(source.get("run"), str):
        raise ValueError("from: expected {run, record, going}")
    for name in ("runs", "learn"):
        if data.get(name) is not None:
            raise ValueError(f"{name}: a run from a recorded point has those of the recorded run")
    if data.get("mode", LOCKSTEP) != LOCKSTEP:
        raise ValueError(
            "mode: a run from a recorded point must be simulated, as a real cell is not in the "
            "state of a recorded marking"
        )
    going = source.get("going", AGAIN)
    if isinstance(going, Mapping):
        going = {str(place): str(word) for place, word in going.items()}
    elif not isinstance(going, str):
        raise ValueError(f"from.going: {_shown(going)} is neither a word nor words by place")
    seed = None if data.get("seed") is None else _whole("seed", data["seed"], 0, LARGEST_SEED)
    record = _whole("from.record", source.get("record", 0), 0, 2**53)
    return RunRequest(
        LOCKSTEP,
        seed=seed,
        parameters=read_parameters(task, _with_regime(data)),
        pace=_pace(data.get("pace")),
        start=RecordedPoint(source["run"], record, going),
    )


def read_parameters(task: Task, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return a client's parameters in the types of the task. Raises ValueError."""
    made = {}
    for name, value in given.items():
        if name not in task.parameters:
            raise ValueError(
                f"{task.name} has no parameter {_shown(name)}; it has: "
                f"{', '.join(task.parameters) or 'none'}"
            )
        kind = type(task.parameters[name])
        if kind is float and type(value) is int:
            value = float(value)
        if type(value) is not kind or (kind is float and value - value != 0):
            raise ValueError(f"parameter {name}: {_shown(value)} is not {_KINDS[kind]}")
        if kind is str and not _is_text(value):
            raise ValueError(f"parameter {name}: {_shown(value)} is not Unicode text")
        made[name] = value
    return made


def start_form(task: Task, text: str, estimates: Path) -> dict[str, Any]:
    """Return the options for starting this task, with types and defaults; `text` is the task
    file's."""
    place = task.places.get(task.runs_place) if task.runs_place else None
    remarks = _remarks(text)
    return {
        "task": task.name,
        "runs": None if place is None else {"default": place.tokens, "place": place.name},
        "seed": SEED,
        "modes": list(MODES),
        "parameters": [
            {
                "name": name,
                "type": type(value).__name__,
                "default": value,
                "text": remarks.get(name, ""),
            }
            for name, value in task.parameters.items()
        ],
        "learn": {
            "selectors": list(RULES),
            "selector": DEFAULT,
            "credits": list(CREDITS),
            "contexts": list(usual_contexts(task).parts),
            "estimates": sorted(
                p.stem for p in estimates.glob(f"*{SUFFIX}") if _NAME.fullmatch(p.stem)
            ),
        },
    }


def _refuse_unknown(data: Mapping[str, Any]) -> None:
    unknown = sorted(set(data) - _KNOWN)
    if unknown:
        raise ValueError(
            f"start: unknown {', '.join(map(_shown, unknown[:8]))}; known are "
            f"{', '.join(sorted(_KNOWN))}"
        )


def _shown(value: Any) -> str:
    """Return a value for an error message, shortened, however long or deep it is."""
    return _SHORT.repr(value)


def _is_text(value: str) -> bool:
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return len(value) <= LONGEST_TEXT


def _whole(name: str, value: Any, least: int, most: int) -> int:
    if type(value) is not int or not least <= value <= most:
        raise ValueError(f"{name}: {_shown(value)} is not a whole number from {least} to {most}")
    return value


def _pace(value: Any) -> float:
    if value is None:
        return 1.0
    if type(value) not in (int, float) or not 0 <= value <= 1000:
        raise ValueError(
            f"pace: {_shown(value)} is not a number from 0 (as fast as possible) to 1000 times "
            "real time"
        )
    return float(value)


def _with_regime(data: Mapping[str, Any]) -> dict[str, Any]:
    given = data.get("parameters") or {}
    if not isinstance(given, Mapping):
        raise ValueError(f"parameters: {_shown(given)} is not a table of values by name")
    return {str(k): v for k, v in given.items()} | (
        {} if data.get("regime") is None else {"regime": data["regime"]}
    )


def _learn(given: Any, folder: Path) -> LearningSetting:
    if not isinstance(given, Mapping):
        raise ValueError("learn: expected {file, selector, target, credit, contexts, frozen}")
    name, selector = given.get("file"), given.get("selector") or DEFAULT
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise ValueError(
            f"learn.file: {_shown(name)} is not a name of at most 64 letters, digits, _ and -; "
            f"the file is kept in {folder}"
        )
    if selector not in RULES:
        raise ValueError(f"learn.selector: {_shown(selector)} is not one of {', '.join(RULES)}")
    credit = given.get("credit") or CREDITS[0]
    if credit not in CREDITS:
        raise ValueError(f"learn.credit: {_shown(credit)} is not one of {', '.join(CREDITS)}")
    target, contexts, frozen = (
        given.get("target"),
        given.get("contexts"),
        given.get("frozen", False),
    )
    if target is not None and (type(target) not in (int, float) or not 0 < target <= 1):
        raise ValueError(
            f"learn.target: {_shown(target)} is not a reliability above 0 and at most 1"
        )
    if contexts is not None and not (
        isinstance(contexts, list) and all(isinstance(c, str) for c in contexts)
    ):
        raise ValueError("learn.contexts: expected a list of names or conditions")
    if type(frozen) is not bool:
        raise ValueError(f"learn.frozen: {_shown(frozen)} is neither true nor false")
    parts = None if contexts is None else tuple(c for c in contexts if c.strip())
    return LearningSetting(
        folder / f"{name}{SUFFIX}",
        selector,
        None if target is None else float(target),
        parts,
        frozen=frozen,
        credit=credit,
    )


def _remarks(text: str) -> dict[str, str]:
    """Return the comments on the task file's parameters, in which its author explains them."""
    try:
        table = tomlkit.parse(text)["task"]["parameters"]
    except (TOMLKitError, KeyError, TypeError):
        return {}
    items = table.items() if hasattr(table, "items") else ()
    return {
        name: item.trivia.comment.lstrip("# ").strip()
        for name, item in items
        if isinstance(item, Item)
    }


def _form(tasks: str, shipped: str, name: str, estimates: str) -> dict[str, Any]:
    try:
        text = TaskStore(Path(tasks), Path(shipped) if shipped else None).read(name).text
    except StoreError as fault:
        raise RefusedError(fault.status, str(fault)) from fault
    return start_form(loads(text, f"{name}.toml"), text, Path(estimates))


WORKS: Mapping[str, Callable[..., Any]] = {"form": _form}
"""For `coordinator.background.BackgroundProcess`."""
