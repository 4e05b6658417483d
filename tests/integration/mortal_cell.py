"""The catching task in lock step with a coordinator that is killed (SIGKILL) at given operations on
its journal, and resumed each time.

This is a separate process, so that it forks from one thread: `mortal_cell.py FOLDER SERVICES SEED
RUNS KILLS` with KILLS a JSON list of experiments, each a list of numbers: the first coordinator is
killed after that many operations on the journal (append, flush or sync), the next one after its own
number, and the last one runs to the end. The laboratory and the nodes are in another process, which
is not killed. Prints one JSON line for each experiment.
"""

from __future__ import annotations

import functools
import json
import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from petrobot.coordinator import launch
from petrobot.coordinator.cli.loading import load_task
from petrobot.coordinator.cli.options import recorded
from petrobot.coordinator.engine import Engine, Fired, Instruction, RunRecorded, State, Stimulus
from petrobot.coordinator.launch import (
    Setting,
    lockstep_party,
    make_mission,
    resumed_mission,
    with_runs,
)
from petrobot.coordinator.run.folder import header
from petrobot.coordinator.run.journal import JournalWriter, read_journal
from petrobot.coordinator.run.lockstep import NAME, CoordinatorParty
from petrobot.coordinator.run.mission import Mission
from petrobot.coordinator.run.recording import STAGE, JournalStore
from petrobot.services.comm.location_file import Directory, load, resolve
from petrobot.services.comm.lockstep.cell import Delays
from petrobot.services.comm.lockstep.mesh import Member
from tests.ports import free_ports

CELL = "cell"
TASK = "catch_ball"
SURVIVOR = 10**9
PATIENCE = 120.0
"""Limit of a tick (s): the laboratory prepares an experiment between two of them, on a machine that
may be busy."""


class MortalStore(JournalStore):
    """A store that kills its process at an operation."""

    lives = SURVIVOR
    operations = 0

    @classmethod
    def count(cls) -> None:
        """Count an operation; at the last one the process is killed."""
        cls.operations += 1
        if cls.operations == cls.lives:
            os.kill(os.getpid(), signal.SIGKILL)

    def append(
        self, now: float, stimulus: Stimulus, instructions: Sequence[Instruction], state: State
    ) -> None:
        """Append, and count it."""
        super().append(now, stimulus, instructions, state)
        self.count()

    def record(self, kind: str, data: Mapping[str, Any]) -> None:
        """Write a record, and count it if it is a stage; others are written with a stimulus."""
        super().record(kind, data)
        if kind == STAGE:
            self.count()

    def flush(self) -> bool:
        """Flush, and count it."""
        unsaved, done = self.writer.unsaved, super().flush()
        if unsaved and done:
            self.count()
        return done

    def sync(self) -> None:
        """Write, and count it and its sync."""
        self.flush()
        super().sync()
        self.count()


def counting(directory: Directory, log: Path) -> dict[str, Callable[..., Any]]:
    """Wrap every action so that each execution writes its call id to a file."""

    def wrapped(name: str) -> Callable[..., Any]:
        action = resolve(directory.actions[name].run)

        @functools.wraps(action)
        def counted(ctx: Any, **arguments: Any) -> Any:
            with log.open("a", encoding="utf-8") as file:
                file.write(ctx.run + "\n")
            return action(ctx, **arguments)

        return counted

    return {name: wrapped(name) for name in directory.actions}


class Experiment:
    """One mission run with its kills."""

    def __init__(self, folder: Path, services: Path, seed: int, runs: int) -> None:
        self.folder = folder
        self.directory = load(services)
        self._seed = seed
        self.task, self.runs = with_runs(load_task(TASK), runs)
        folder.mkdir(parents=True)
        self._log = folder / "executed.txt"
        self._log.touch()
        self._addresses = {
            name: ("127.0.0.1", port)
            for name, port in zip((CELL, NAME), free_ports(2), strict=True)
        }
        self._hosts = {**dict.fromkeys(self.directory.nodes, CELL), NAME: NAME}

    def run(self, kills: Sequence[int]) -> dict[str, Any]:
        """Run with all kills; return the outcome."""
        cell = _fork(self._cell)
        for life, lives in enumerate([*kills, SURVIVOR]):
            status = os.waitpid(_fork(functools.partial(self._coordinate, lives, life > 0)), 0)[1]
            killed = os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL
            if not killed:
                break
        if status:
            os.kill(cell, signal.SIGKILL)
        survived = os.waitpid(cell, 0)[1]
        assert status == 0, f"the coordinator's process failed: {status}"
        assert survived == 0, "the cell's process failed"
        return {
            "kills": list(kills),
            "lives": life + 1,
            **json.loads((self.folder / "outcome.json").read_text()),
            **self._book(),
        }

    def _member(self, name: str, parties: Sequence[Any], **more: Any) -> Member:
        delays = Delays(self.directory.delays())
        settings: dict[str, Any] = {
            "hosts": self._hosts,
            "delays": delays,
            "directory": self.directory.hash,
            "patience": PATIENCE,
        }
        return Member(name, parties, self._addresses, **settings, **more)

    def _cell(self) -> None:
        counted = counting(self.directory, self._log)
        parties = [
            lockstep_party(self.directory, node, counted) for node in self.directory.nodes.values()
        ]
        member = self._member(CELL, parties, returning={NAME})
        member.open()
        member.run()

    def _coordinate(self, lives: int, again: bool) -> None:
        MortalStore.lives, MortalStore.operations = lives, 0
        launch.__dict__["JournalStore"] = MortalStore
        mission, begin = self._resumed() if again else (self._new(), None)
        party = CoordinatorParty(self.directory, mission, begin=begin)
        member = self._member(NAME, [party], rejoins=again)
        member.open()
        member.run(lambda: party.over)
        (self.folder / "outcome.json").write_text(json.dumps(self._outcome(mission)))

    def _new(self) -> Mission:
        setting = Setting(self.task, runs=self.runs, seed=self._seed)
        given = {"services_path": str(self.directory.source), "seed": self._seed, "runs": self.runs}
        text = (
            Path(launch.__file__)
            .with_name("tasks")
            .joinpath(f"{TASK}.toml")
            .read_text(encoding="utf-8")
        )
        services = self.directory.source.read_text(encoding="utf-8")
        first = header(
            "m", text, services, "lockstep", {**given, "parameters": dict(self.task.parameters)}
        )
        store = MortalStore(JournalWriter(self.folder / "run.journal", first), 0.0)
        return make_mission(self.directory, setting, "m", "lock step", store)

    def _resumed(self) -> tuple[Mission, Callable[[float], None]]:
        journal = read_journal(self.folder / "run.journal")
        devices = {a.name: a.device for a in self.directory.actions.values() if a.device}
        return resumed_mission(
            self.directory, self.task, Engine(self.task, devices), journal, [], 0.0
        )

    def _outcome(self, mission: Mission) -> dict[str, Any]:
        """Return what a kill must not change, and how many operations there are."""
        finished = mission.executor.finished
        assert finished is not None
        return {
            "operations": MortalStore.operations,
            "same": {
                "status": finished.status.value,
                "marking": list(mission.executor.state.marking),
                "cycles": [cycle.status.value for cycle in mission.tally.cycles],
                "caught": [throw["caught"] for throw in mission.score["throws"]],
                "runs": sorted((r.place, str(r.status)) for r in mission.tally.runs),
            },
        }

    def _book(self) -> dict[str, Any]:
        """Return from journal and nodes how often each call was executed and which are unknown, and
        check that every firing is one of the net."""
        executed = Counter(self._log.read_text(encoding="utf-8").split())
        found = recorded(str(self.folder))
        given = [i for step in found.steps() for i in step.instructions]
        firings = [one for one in given if isinstance(one, Fired)]
        markings = list(
            found.task.flat.net.replay([f.transition for f in firings], firings[0].before)
        )
        assert [tuple(m) for m in markings[1:]] == [f.after for f in firings], (
            "a firing that the ordinary net does not allow"
        )
        records = [one for one in given if isinstance(one, RunRecorded)]
        return {
            "calls": len(executed),
            "twice": sorted(call for call, times in executed.items() if times > 1),
            "unknown": [r.run for r in records if r.executed.value == "unknown"],
            "recorded": len(records),
        }


def _fork(work: Callable[[], None]) -> int:
    """Start a child process that does this work; return its id."""
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        work()
        code = 0
    except BaseException as fault:
        print(f"{work}: {type(fault).__name__}: {fault}", file=sys.stderr, flush=True)
    finally:
        os._exit(code)


def main() -> None:
    """Run all experiments, one after the other."""
    folder, services, seed, runs, kills = sys.argv[1:]
    for number, experiment in enumerate(json.loads(kills)):
        outcome = Experiment(Path(folder) / str(number), Path(services), int(seed), int(runs)).run(
            experiment
        )
        print(json.dumps(outcome), flush=True)


if __name__ == "__main__":
    main()
