"""Journals of mission runs as the page's history: every record with its marking and a
description."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from petrobot.coordinator.background import RefusedError
from petrobot.coordinator.engine import Engine, Fired, Phase, Report, RunRecorded, StartRun
from petrobot.coordinator.operator.event_texts import firing_of, reason_recorded, told, unserved
from petrobot.coordinator.operator.net_state import picture
from petrobot.coordinator.run.folder import JOURNAL, RESULT
from petrobot.coordinator.run.journal import Journal, JournalError, read_journal
from petrobot.coordinator.run.recording import (
    RecordedStep,
    Remark,
    ReplayError,
    TakeOver,
    replay,
    with_asides,
)
from petrobot.coordinator.task import End, Task
from petrobot.coordinator.task.file import TaskFileError, loads
from petrobot.services.comm.location_file import Directory

RECORDS_AT_MOST = 20_000
RUNS_AT_MOST = 300


def _runs(folder: str) -> list[dict[str, Any]]:
    """Return every run, newest first: {id, task, state, started (ISO 8601 text), seconds}."""
    paths = sorted(Path(folder).glob(f"*/{JOURNAL}"), key=lambda p: p.stat().st_mtime, reverse=True)
    return [_listed(path) for path in paths[:RUNS_AT_MOST]]


def _run(folder: str, run: str) -> dict[str, Any]:
    """Return one run, replayed from its journal: {id, task (as in a snapshot), initial (marking),
    records}."""
    if run not in {path.parent.name for path in Path(folder).glob(f"*/{JOURNAL}")}:
        raise RefusedError(404, "no such run")
    return opened(Path(folder) / run / JOURNAL, run)


def _listed(path: Path) -> dict[str, Any]:
    """Return the entry of a run in the list; its journal is read only when it is opened."""
    entry: dict[str, Any] = {
        "id": path.parent.name,
        "task": "",
        "state": "running",
        "started": "",
        "seconds": None,
    }
    try:
        result = json.loads((path.parent / RESULT).read_text(encoding="utf-8"))
        seconds = result.get("sim_s", result.get("wall_s"))
        entry |= {
            "task": result.get("task", ""),
            "state": result.get("status", ""),
            "seconds": seconds,
        }
    except (OSError, ValueError):
        entry["state"] = "running or interrupted"
    entry["modified"] = path.stat().st_mtime
    return entry


def opened(path: Path, run: str) -> dict[str, Any]:
    """Return a journal as the page's history. If it cannot be replayed, `fault` has the reason, and
    the records hold what could be."""
    try:
        journal = read_journal(path)
        task = task_of(journal)
    except (JournalError, TaskFileError, KeyError) as fault:
        return {"id": run, "fault": f"{fault}", "task": None, "initial": {}, "records": []}
    header = journal.header
    devices, plant = _cell(header)
    engine = Engine(task, header.get("devices") or devices)
    teller = _StepDescriber(engine)
    records: list[dict[str, Any]] = []
    fault_text = (
        f"a torn tail of {journal.torn_bytes} bytes was dropped" if journal.torn_bytes else ""
    )
    try:
        for step in with_asides(journal, replay(journal, engine)):
            records.append(
                teller.record(step) if isinstance(step, RecordedStep) else teller.aside(step)
            )
            if len(records) >= RECORDS_AT_MOST:
                fault_text = f"only the first {RECORDS_AT_MOST} records are shown"
                break
    except (JournalError, ReplayError) as fault:
        fault_text = str(fault)
    return {
        "id": run,
        "fault": fault_text,
        "mode": header.get("mode", ""),
        "plant": plant,
        "seed": header.get("seed"),
        "started": header.get("date", ""),
        "from": _source(header),
        "task": picture(task),
        "initial": dict(zip(task.net.places, task.net.initial, strict=True)),
        "records": records,
    }


def _source(header: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the recorded run, and its point, from which this one started."""
    source = header.get("from")
    return (
        {key: source[key] for key in ("run", "record", "going") if key in source}
        if source
        else None
    )


def task_of(journal: Journal) -> Task:
    """Return the task of a journal with its number of runs.

    Its flat net is the recorded one, so that a later petrobot that expands short forms in another
    way still replays the same run. Journals without one are expanded now. Raises TaskFileError,
    KeyError.
    """
    from petrobot.coordinator.launch import with_runs

    task = loads(journal.header["task"], f"{journal.path} (task)")
    if (expanded := journal.header.get("expanded")) is not None:
        flat = loads(expanded, f"{journal.path} (expanded task)", flat=True)
        # Older journals have no empty initial values there.
        variables = {**flat.variables, **task.variables}
        task = replace(task, expansion=replace(flat, variables=variables))
    runs = journal.header.get("runs")
    return with_runs(task, runs)[0] if runs is not None else task


def _cell(header: Mapping[str, Any]) -> tuple[dict[str, str], str]:
    """Return the device of each action, and the plant in which the run took place."""
    from petrobot.coordinator.run.folder import still_there
    from petrobot.services.comm.location_file import parse

    text = header.get("services")
    if not text:
        return {}, ""
    directory = parse(text, still_there(Path(header.get("services_path", "services.toml"))))
    devices = {a.name: a.device for a in directory.actions.values() if a.device}
    return devices, plant_of(header, directory)


def plant_of(header: Mapping[str, Any], directory: Directory) -> str:
    """Return where a recorded run took place."""
    scripted, lockstep = bool(header.get("mock")), header.get("mode") == "lockstep"
    return directory.plant(scripted=scripted, lockstep=lockstep)


class _StepDescriber:
    """Converts steps to records; keeps the action of each run, for the reasons of firings."""

    def __init__(self, engine: Engine) -> None:
        self._engine, task = engine, engine.task
        self._places = task.net.places
        self._marking = task.net.initial
        self._going: list[str] = []
        self._actions: dict[str, str] = {}
        self._ends: dict[str, dict[str, Any]] = {}
        self._errors = {
            t.name
            for t in task.flat.transitions.values()
            if any(i.end is End.ERROR for i in t.inputs)
        }

    def record(self, step: RecordedStep) -> dict[str, Any]:
        """Return {number, t, text, firings, marking (changed places), notes, error, going (places
        with active runs)}."""
        firings, notes, text = [], [], told(step.stimulus)
        if why := unserved(step, self._engine):
            text = f"{text}: {why}"
        for instruction in step.instructions:
            if isinstance(instruction, StartRun):
                self._actions[instruction.run] = instruction.action
                notes.append(f"{instruction.action} starts in {instruction.place}")
            elif isinstance(instruction, RunRecorded):
                self._ends[instruction.run] = reason_recorded(instruction)
                if instruction.deferred:
                    text += " (provisional)"
                elif instruction.cancelled:
                    text = f"{instruction.place} has stopped: {instruction.taken_away}"
            elif isinstance(instruction, Report) and instruction.severity.value != "note":
                notes.append(instruction.text)
            elif isinstance(instruction, Fired):
                firing = firing_of(instruction, step.stimulus, self._ends, self._actions)
                firings.append({**firing, "error": instruction.transition in self._errors})
        after = step.state.marking
        changed = {self._places[i]: n for i, n in enumerate(after) if n != self._marking[i]}
        self._marking = after
        self._going = sorted(
            {run.place for run in step.state.runs() if run.phase is not Phase.DONE}
        )
        return {
            "number": step.number,
            "t": round(step.time, 4),
            "text": text,
            "firings": firings,
            "marking": changed,
            "notes": notes,
            "error": any(f["error"] for f in firings),
            "going": self._going,
        }

    def aside(self, aside: Remark | TakeOver) -> dict[str, Any]:
        """Return what changes nothing as a record."""
        return {
            "number": aside.number,
            "t": round(aside.time, 4),
            "text": aside.told,
            "firings": [],
            "marking": {},
            "notes": [],
            "error": False,
            "going": self._going,
        }


WORKS: Mapping[str, Callable[..., Any]] = {"runs": _runs, "run": _run}
"""For `coordinator.background.BackgroundProcess`."""
