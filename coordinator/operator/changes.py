"""Apply changes to a snapshot, and merge the changes that a client has not received yet (pure
functions).

`page/state.js` has the same rules for browsers. A test applies random changes one by one and
merged, and compares the states."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from typing import Any

Change = Mapping[str, Any]
State = dict[str, Any]

FIRINGS_KEPT = 60
ENDED_KEPT = 200
SAMPLES_KEPT = 300
NOTICES_KEPT = 30
PENDING_LIMIT = 400
"""Most entries that wait for one client; a client that is further behind gets a new snapshot
instead."""


def empty_state() -> State:
    """Return an empty snapshot: no task, no run, controls free."""
    return {
        "sequence": 0,
        "mission": {"id": "", "state": "idle", "mode": "realtime"},
        "time": 0.0,
        "task": None,
        "marking": {},
        "runs": {},
        "ended": [],
        "firings": [],
        "nodes": {},
        "events": {},
        "variables": {},
        "devices": {},
        "images": {},
        "setpoints": {},
        "reports": {},
        "notices": [],
        "breakpoints": [],
        "paused": None,
        "controls": {"holder": None, "asking": []},
        "selectors": {},
        "result": None,
    }


def _append(state: State, key: str, entry: Any, kept: int) -> None:
    entries = state[key]
    entries.append(entry)
    if len(entries) > kept:
        del entries[: len(entries) - kept]


def _ended(state: State, change: Change) -> None:
    run = state["runs"].pop(change["id"], None)
    if run is not None:
        extra = {key: change[key] for key in _OF_AN_END if key in change}
        _append(state, "ended", {**run, **extra}, ENDED_KEPT)


def _judged(state: State, change: Change) -> None:
    said = {key: change[key] for key in ("status", "reason") if key in change} | {"deferred": False}
    state["ended"] = [
        {**run, **said} if run["id"] == change["id"] else run for run in state["ended"]
    ]


def _progress(state: State, change: Change) -> None:
    run = state["runs"].get(change["id"])
    if run is not None:
        state["runs"][change["id"]] = {
            **run,
            **{k: change[k] for k in _OF_A_RUN if k in change},
        }


def _setpoint(state: State, change: Change) -> None:
    known = state["setpoints"].get(change["stream"], {"samples": []})
    samples = [*known["samples"], *change.get("samples", ())][-SAMPLES_KEPT:]
    state["setpoints"][change["stream"]] = {
        **known,
        **change.get("setpoint", {}),
        "samples": samples,
    }


def _entry(state: State, change: Change) -> None:
    kind = change["kind"]
    state[_TABLES[kind]][change["name"]] = change["value" if kind == "variable" else kind]


def _whole(state: State, change: Change) -> None:
    state[change["kind"]] = change[change["kind"]]


_OF_A_RUN = ("progress", "state", "data", "held_since", "held_for")
"""What a `run_progress` may change."""
_OF_AN_END = ("status", "ended", "reason", "deferred")
_TABLES: Mapping[str, str] = {
    "node": "nodes",
    "event": "events",
    "variable": "variables",
    "device": "devices",
    "image": "images",
    "report": "reports",
    "selector": "selectors",
}
"""By kind of a change of one named entry: the table that has it."""
_WHOLE = ("breakpoints", "paused", "controls", "result")
"""Kinds that replace a part of the state, with its name."""


_RULES: dict[str, Callable[[State, Change], None]] = {
    "mission": lambda s, c: s.update(mission={**s["mission"], **c["mission"]}),
    "marking": lambda s, c: s["marking"].update(c["marking"]),
    "fired": lambda s, c: _append(s, "firings", c["firing"], FIRINGS_KEPT),
    "run_started": lambda s, c: s["runs"].update({c["run"]["id"]: c["run"]}),
    "run_progress": _progress,
    "run_ended": _ended,
    "run_judged": _judged,
    "setpoint": _setpoint,
    "notice": lambda s, c: _append(s, "notices", c["notice"], NOTICES_KEPT),
    **dict.fromkeys(_TABLES, _entry),
    **dict.fromkeys(_WHOLE, _whole),
}
KINDS = frozenset(_RULES) | {"reset", "command"}
"""Kinds of change. `reset` means that so much is new (another mission) that clients get a snapshot
instead. `command` changes nothing: who follows the run reads it."""


def apply(state: State, change: Change) -> None:
    """Apply one change to a state. An unknown kind changes only the number, so that old clients
    work with new servers."""
    rule = _RULES.get(str(change["kind"]))
    if rule is not None:
        rule(state, change)
    if "sequence" in change:
        state["sequence"] = change["sequence"]
    if "time" in change:
        state["time"] = max(state["time"], change["time"])


def copy_state(state: State) -> State:
    """Return a copy of a state that later changes to the original do not affect.

    Two levels are copied: the rules above replace deeper values and never modify them. A full copy
    of a task of 300 places would take 20 ms.
    """
    return {
        key: copy(value) if isinstance(value, dict | list) else value
        for key, value in state.items()
    }


class Pending:
    """The merged delta that waits for a client: the newest value where only that counts, and every
    entry that must not be lost.

    Its size is bounded: above `PENDING_LIMIT` entries, or after a `reset`, it is empty and `stale`.
    """

    __slots__ = ("_entries", "_first", "_last", "_time", "stale")

    def __init__(self) -> None:
        self._entries: dict[tuple[str, Any], Change] = {}
        self._first = 0
        self._last = 0
        self._time = 0.0
        self.stale = False

    def __bool__(self) -> bool:
        return self.stale or self._last != 0

    def add(self, change: Change) -> None:
        """Add the next change."""
        self._first = self._first or change["sequence"]
        self._last = change["sequence"]
        self._time = change.get("time", self._time)
        if self.stale:
            return
        kind = change["kind"]
        if kind == "reset" or len(self._entries) >= PENDING_LIMIT:
            self.stale = True
            self._entries = {}
            return
        key = _key(kind, change)
        before = self._entries.get(key)
        self._entries[key] = change if before is None else _merge(before, change)

    def take(self) -> dict[str, Any]:
        """Return the merged delta {type, first, last, time, changes}; nothing is pending
        afterwards."""
        delta = {
            "type": "delta",
            "first": self._first,
            "last": self._last,
            "time": self._time,
            "changes": [_bare(change) for change in self._entries.values()],
        }
        self.clear()
        return delta

    def clear(self) -> None:
        """Forget everything pending, as after a snapshot."""
        self._entries = {}
        self._first = self._last = 0
        self.stale = False


def _key(kind: str, change: Change) -> tuple[str, Any]:
    if kind in _TABLES:
        return kind, change["name"]
    if kind == "run_progress":
        return kind, change["id"]
    if kind == "setpoint":
        return kind, change["stream"]
    if kind in _WHOLE or kind in ("marking", "mission"):
        return kind, None
    return kind, change["sequence"]


def _merge(old: Change, new: Change) -> Change:
    kind = new["kind"]
    if kind in ("marking", "mission"):
        return {**new, kind: {**old[kind], **new[kind]}}
    if kind == "run_progress":
        return {**old, **new}
    if kind == "setpoint":
        samples = [*old.get("samples", ()), *new.get("samples", ())][-SAMPLES_KEPT:]
        return {
            **new,
            "setpoint": {**old.get("setpoint", {}), **new.get("setpoint", {})},
            "samples": samples,
        }
    return new


def _bare(change: Change) -> dict[str, Any]:
    return {key: value for key, value in change.items() if key not in ("sequence", "time")}
