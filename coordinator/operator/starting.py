"""Makes the mission runs of a station: over the nodes, in lock step, or in lock step from a point
of a recorded run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from petrobot.coordinator.engine import Engine
from petrobot.coordinator.experience.estimates_file import EstimatesError
from petrobot.coordinator.hmi.journals import task_of
from petrobot.coordinator.launch import (
    SCRIPTED,
    Setting,
    Substitutes,
    load_object,
    lockstep_id,
    mission_id,
    with_runs,
)
from petrobot.coordinator.mission.partners import FirstAlternative
from petrobot.coordinator.operator.departure import departed_store, departing, departure
from petrobot.coordinator.operator.mission_run import MissionRun
from petrobot.coordinator.operator.simulated_run import SimulatedRun
from petrobot.coordinator.operator.start_order import StartOrder, read_depart
from petrobot.coordinator.record.journal import JournalError, JournalWriter, read_journal
from petrobot.coordinator.record.recording import JournalStore, ReplayError, clock_reading
from petrobot.coordinator.record.runfolder import JOURNAL, header
from petrobot.coordinator.task import Task
from petrobot.coordinator.taskfile import TaskFileError
from petrobot.services.comm.directory import Directory, DirectoryError, parse

FAULTS = (JournalError, ReplayError, TaskFileError, DirectoryError, EstimatesError, OSError)
"""What a start may break on beside ValueError and KeyError: files that are not what they should
be."""


@dataclass(frozen=True)
class Starting:
    """What every run of one station is made of; `estimates` is where it keeps what is learned."""

    directory: Directory
    runs: Path
    mock: Path | None = None
    estimates: Path = Path("estimates")

    def live(self, task: Task, text: str, order: StartOrder) -> MissionRun:
        """A run in real time, not connected yet; for the station's own loop."""
        return MissionRun(self.directory, task, text, order, self.runs, self.mock)

    def simulated(self, task: Task, text: str, order: StartOrder) -> SimulatedRun:
        """A run in lock step, with the laboratory loaded; for a thread of its own."""
        learn = order.learn
        session = (
            None if learn is None else learn.session(task, self.directory, order.mode, order.seed)
        )
        selector = FirstAlternative() if session is None else session.selector
        setting = Setting(task, order.parameters, order.runs, order.seed, selector)
        given = {
            "services_path": str(self.directory.source.resolve()),
            "seed": setting.seed,
            "runs": with_runs(task, order.runs)[1],
            "parameters": {**task.parameters, **order.parameters},
            "clock": clock_reading(0.0),
            "durable": False,
            "mock": str(self.mock.resolve()) if self.mock else "",
            "cell": "launched",
            "chosen": {},
            **({} if session is None else {"learning": session.beginning()}),
        }
        services = self.directory.source.read_text(encoding="utf-8")
        first = header(lockstep_id(setting), text, services, order.mode, given)
        store = JournalStore(JournalWriter(self.runs / mission_id(task) / JOURNAL, first), 0.0)
        return SimulatedRun(
            self.directory, setting, store, order.pace, session, self._scripted(self.mock)
        )

    def departed(self, data: Mapping[str, Any]) -> tuple[Task, SimulatedRun]:
        """A run in lock step from a point of a recorded one, and its task; for a thread of its
        own."""
        name = str(data["from"].get("run", "")) if isinstance(data["from"], Mapping) else ""
        if name not in {path.parent.name for path in self.runs.glob(f"*/{JOURNAL}")}:
            raise ValueError(f"from.run: there is no run {name!r}")
        journal = read_journal(self.runs / name / JOURNAL)
        task = task_of(journal)
        order = read_depart(task, data)
        directory = parse(journal.header["services"], Path(journal.header["services_path"]))
        engine = Engine(task, {a.name: a.device for a in directory.actions.values() if a.device})
        point = departure(journal, engine, name, order.record, order.going)
        setting = departing(journal, task, engine, point, order.seed, order.parameters)
        store = departed_store(journal, setting, point, self.runs / mission_id(task))
        mock = journal.header.get("mock")
        scripted = self._scripted(Path(mock) if mock else None)
        return task, SimulatedRun(directory, setting, store, order.pace, None, scripted, point)

    def _scripted(self, mock: Path | None) -> Substitutes | None:
        if mock is None:
            return None
        try:
            scripted: Substitutes = load_object(SCRIPTED)(mock)
        except Exception as fault:
            raise ValueError(f"{mock}: {fault}") from fault
        return scripted
