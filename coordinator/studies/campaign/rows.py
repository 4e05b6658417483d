"""Rows of a campaign's table: their columns, and a trial as a row and back. The columns depend on
the task and its score."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from petrobot.coordinator.studies.campaign.plan import Block
from petrobot.coordinator.studies.campaign.trials import RunEntry, Trial, waits_of
from petrobot.coordinator.task import Kind, Task
from petrobot.services.host.json_text import json_text

GENERAL = (
    "n",
    "regime",
    "seed",
    "k",
    "block",
    "begun",
    "status",
    "cause",
    "completed",
    "goals",
    "time",
    "at",
    "mission_s",
)
"""`n`: number in the campaign; `k`: number in the mission run with `seed`; `time`: duration of the
trial (s); `at`: its begin (s since the mission began)."""
BY_PLACE = ("status", "cause", "seconds", "cost")
"""Columns of the trial's first run in each place; the column `runs` holds all runs."""
LAST = ("more", "runs", "waits", "fired")
"""JSON columns: results of the task's own that the first block did not have; RunEntry.to_plain of
each run; Trial.waits; Trial.fired."""


@dataclass
class TrialRow:
    """A trial of a campaign. `trial` is None if the mission run was given up before the trial
    began."""

    n: int
    regime: str
    seed: int
    k: int
    block: int
    mission_s: float
    trial: Trial | None
    score: dict[str, Any] = field(default_factory=dict)
    """The task's own results, as `table.column`."""

    @property
    def runs(self) -> Sequence[RunEntry]:
        """Runs of the trial; none if it did not begin."""
        return self.trial.runs if self.trial is not None else ()


def rows_of(block: Block, result: Mapping[str, Any]) -> list[TrialRow]:
    """Return the rows of a block's result."""
    trials = {t["k"]: Trial.from_plain(t) for t in result["trials"]}
    return [
        TrialRow(
            block.first + k,
            block.regime,
            block.seed,
            k,
            block.index,
            result["mission_s"],
            trials.get(k),
            dict(result["score"][k - 1]),
        )
        for k in range(1, block.count + 1)
    ]


def columns(task: Task, rows: Sequence[TrialRow]) -> list[str]:
    """Return the columns of a table: general ones, those of the task file, and those of the task's
    score in these first rows."""
    chosen = [f"chosen.{name}" for name in task.primitive_tasks]
    places = [
        f"{p.name}.{part}"
        for p in task.flat.places.values()
        if p.kind is Kind.ACTION
        for part in BY_PLACE
    ]
    own = list(dict.fromkeys(key for row in rows for key in row.score))
    return [*GENERAL, *chosen, *places, *own, *LAST]


def cells(task: Task, row: TrialRow, names: Sequence[str]) -> list[str]:
    """Return a row as texts, in the order of the columns."""
    found = {**_general(row), **_runs(task, row), **row.score}
    more = {k: v for k, v in row.score.items() if k not in names}
    found["more"] = _json(more) if more else ""
    return [_text(found.get(name)) for name in names]


def _general(row: TrialRow) -> dict[str, Any]:
    base = {name: getattr(row, name) for name in ("n", "regime", "seed", "k", "block", "mission_s")}
    trial = row.trial
    if trial is None:
        return {**base, "begun": False}
    return {
        **base,
        **{n: getattr(trial, n) for n in ("status", "cause", "completed", "goals", "time")},
        "begun": True,
        "at": trial.begun,
        "waits": _json([list(w) for w in trial.waits]),
        "fired": _json(trial.fired),
        "runs": _json([run.to_plain() for run in trial.runs]),
    }


def _runs(task: Task, row: TrialRow) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for run in row.runs:
        primitive = task.primitive_task_of(run.place).name
        found.setdefault(f"chosen.{primitive}", run.action)
        if f"{run.place}.status" not in found:
            found |= {f"{run.place}.{part}": getattr(run, part) for part in BY_PLACE}
    return found


def _json(data: Any) -> str:
    return json_text(data, separators=(",", ":"), ensure_ascii=False)


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(round(value, 9))
    if isinstance(value, str):
        # a bare carriage return would end a line of the CSV file
        return value.replace("\r\n", "\n").replace("\r", "\n")
    return str(value) if isinstance(value, int) else _json(value)


def read_row(record: Mapping[str, str]) -> TrialRow:
    """Read a row from its texts. Raises KeyError or ValueError if the record is not a row."""
    trial = None
    if record["begun"] == "true":
        trial = Trial(
            int(record["k"]),
            float(record["at"]),
            _number(record["time"]),
            record["completed"] == "true",
            int(record["goals"]),
            record["status"],
            record["cause"],
            [RunEntry.from_plain(run) for run in json.loads(record["runs"])],
            waits_of(json.loads(record["waits"])),
            json.loads(record["fired"]),
        )
    own = {key: value_of(text) for key, text in record.items() if _is_own(key) and text != ""}
    own |= json.loads(record["more"]) if record.get("more") else {}
    return TrialRow(
        int(record["n"]),
        record["regime"],
        int(record["seed"]),
        int(record["k"]),
        int(record["block"]),
        float(record["mission_s"]),
        trial,
        own,
    )


def _is_own(key: str) -> bool:
    """Return whether a column may belong to the score; columns of places are read from `runs`."""
    return "." in key and not key.startswith("chosen.") and key.rpartition(".")[2] not in BY_PLACE


def _number(text: str) -> float | None:
    return float(text) if text else None


def value_of(text: str) -> Any:
    """Return the value of a cell's text, as far as a text shows it."""
    if text in ("true", "false"):
        return text == "true"
    try:
        return json.loads(text)
    except ValueError:
        return text
