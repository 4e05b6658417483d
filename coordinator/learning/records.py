"""The records that a task learns from: choices, ends of runs, corrected verdicts, verdicts of the
task on choices, firings, and ends of trials; as plain data and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

from petrobot.coordinator.learning.estimate import Observation
from petrobot.coordinator.task import Executed, Status


@dataclass(frozen=True, slots=True)
class Choice:
    """An action was chosen for a primitive task."""

    primitive_task: str
    action: str
    context: str


@dataclass(frozen=True, slots=True)
class RunEnd:
    """A run ended."""

    primitive_task: str
    action: str
    context: str
    outcome: Observation


@dataclass(frozen=True, slots=True)
class Correction:
    """A deferred verdict replaces the status of a run that ended before."""

    primitive_task: str
    action: str
    context: str
    was: Observation
    status: Status
    cause: str = ""
    age: int = 0
    """Trials of the primitive task in this context since that run ended. A rule whose sums fade
    corrects less of an old trial."""


@dataclass(frozen=True, slots=True)
class Credit:
    """The task's verdict on an action that was chosen for a token: SUCCESS if the token met the
    task's goal, with the cost of the whole trial."""

    primitive_task: str
    action: str
    context: str
    outcome: Observation
    beside: tuple[tuple[str, str], ...] = ()
    """(primitive task, action) of everything that ran for the token; only in the first of its
    verdicts."""


class WaitEnd(StrEnum):
    """How a wait ended."""

    LATEST = ""
    """With a firing, measured since the tokens came last: timers, several events at once, and all
    waits in tables that are older than the other ends."""
    FIRED = "fired"
    """The event came, and the transition fired."""
    CAME = "came"
    """The event came, and the transition did not fire at once: its flag is set, another transition
    took the token, or its condition was false."""
    CUT = "cut"
    """Without the event: a token was taken elsewhere, or the trial ended."""


class Waited(NamedTuple):
    """One wait of a transition for its event or timer."""

    transition: str
    seconds: float
    end: WaitEnd = WaitEnd.LATEST

    @property
    def fired(self) -> bool:
        """Whether it ended with a firing."""
        return self.end in (WaitEnd.LATEST, WaitEnd.FIRED)


@dataclass(frozen=True, slots=True)
class Passage:
    """A transition fired, or a wait for its event ended without a firing."""

    transition: str
    context: str
    waited: float | None = None
    """Seconds of the wait for its event; None if the firing ended none."""
    end: WaitEnd = WaitEnd.FIRED


@dataclass(frozen=True, slots=True)
class TrialEnd:
    """A trial of the task has ended."""

    context: str
    success: bool
    """It completed, and every run was a SUCCESS."""
    goal: bool
    cost: float | None
    """The sum over its runs; None if one of them reported none."""
    runs: tuple[str, ...]
    """The primitive task of each run."""


Record = Choice | RunEnd | Correction | Credit | Passage | TrialEnd


def to_plain(record: Record) -> dict[str, Any]:
    """Return a record as plain data for journals and tables."""
    if isinstance(record, Passage):
        return {
            "kind": "Passage",
            "transition": record.transition,
            "context": record.context,
            "waited": record.waited,
            **({} if record.end is WaitEnd.FIRED else {"end": record.end.value}),
        }
    if isinstance(record, TrialEnd):
        return {
            "kind": "Trial",
            "context": record.context,
            "success": record.success,
            "goal": record.goal,
            "cost": record.cost,
            "runs": list(record.runs),
        }
    about = {
        "primitive_task": record.primitive_task,
        "action": record.action,
        "context": record.context,
    }
    if isinstance(record, RunEnd):
        return {"kind": "End", **about, "outcome": _observation(record.outcome)}
    if isinstance(record, Credit):
        beside = {"beside": [list(one) for one in record.beside]} if record.beside else {}
        return {"kind": "Credit", **about, "outcome": _observation(record.outcome), **beside}
    if isinstance(record, Correction):
        verdict = {"status": record.status.value, "cause": record.cause, "age": record.age}
        return {"kind": "Correction", **about, "was": _observation(record.was), **verdict}
    return {"kind": "Choice", **about}


def of_plain(data: Mapping[str, Any]) -> Record:
    """Read what `to_plain` returned. Raises ValueError or KeyError."""
    kind = data["kind"]
    if kind == "Passage":
        end = WaitEnd(data.get("end", WaitEnd.FIRED))
        return Passage(str(data["transition"]), str(data["context"]), data["waited"], end)
    if kind == "Trial":
        runs = tuple(map(str, data["runs"]))
        told = bool(data["success"]), bool(data["goal"]), data["cost"]
        return TrialEnd(str(data["context"]), *told, runs)
    about = (str(data["primitive_task"]), str(data["action"]), str(data["context"]))
    if kind == "Choice":
        return Choice(*about)
    if kind == "End":
        return RunEnd(*about, _observed(data["outcome"]))
    if kind == "Credit":
        beside = tuple((str(task), str(action)) for task, action in data.get("beside", ()))
        return Credit(*about, _observed(data["outcome"]), beside)
    if kind == "Correction":
        verdict = (Status(data["status"]), str(data["cause"]), int(data.get("age", 0)))
        return Correction(*about, _observed(data["was"]), *verdict)
    known = "Choice, End, Correction, Credit, Passage or Trial"
    raise ValueError(f"kind: expected {known}, got {kind!r}")


def _observation(seen: Observation) -> dict[str, Any]:
    return {
        "status": None if seen.status is None else seen.status.value,
        "seconds": seen.seconds,
        "cause": seen.cause,
        "executed": seen.executed.value,
        "cpu_seconds": seen.cpu_seconds,
        "values": dict(seen.values),
        "preempted_by": seen.preempted_by,
        "waited": seen.waited,
    }


def _observed(data: Mapping[str, Any]) -> Observation:
    return Observation(
        None if data["status"] is None else Status(data["status"]),
        float(data["seconds"]),
        str(data["cause"]),
        Executed(data["executed"]),
        data["cpu_seconds"],
        {str(name): float(value) for name, value in data["values"].items()},
        data["preempted_by"],
        data["waited"],
    )
