"""A coordinator that dies at any record of its journal: the resumed run ends like the undisturbed
one, and nothing runs twice."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from petrobot.coordinator.engine import Engine, Instruction, Override, State, Stimulus
from petrobot.coordinator.launch import (
    Setting,
    lockstep_party,
    make_mission,
    resumed_mission,
    with_runs,
)
from petrobot.coordinator.run.folder import JOURNAL
from petrobot.coordinator.run.journal import JournalWriter, read_journal
from petrobot.coordinator.run.lockstep import CoordinatorParty
from petrobot.coordinator.run.mission import Mission
from petrobot.coordinator.run.recording import JournalStore, ReplayError, origin_of, replay
from petrobot.coordinator.task import Status, Task
from petrobot.services.action import Status as ActionStatus
from petrobot.services.comm.lockstep.cell import LockStepCell
from petrobot.services.scripted import ScriptedRun
from tests.ports import free_ports
from tests.run.scripted_cell import directory_for, scripts

LINES = {
    "locate_ball": [ScriptedRun(seconds=(0.2, 0.2), values={"ball": [1.0, 0.1]})],
    "move_to_point": [
        ScriptedRun(seconds=(0.3, 0.3)),
        ScriptedRun(ActionStatus.ERROR, (0.1, 0.1), cause="unreachable", text="y = 0.9 m"),
        ScriptedRun(seconds=(0.3, 0.3)),
        ScriptedRun(seconds=(0.3, 0.3)),
    ],
    "catch_ball": [
        ScriptedRun(ActionStatus.FAILURE, (0.2, 0.2), cause="missed"),
        ScriptedRun(seconds=(0.2, 0.2)),
    ],
}


RUNS = 4


class CrashError(Exception):
    """The coordinator has died."""


class MortalStore(JournalStore):
    """Dies after so many operations (appends and syncs), as after kill -9: what was not synced is
    lost."""

    def __init__(self, writer: JournalWriter, lives: int) -> None:
        super().__init__(writer, 0.0)
        self._lives = lives
        self.operations = 0

    def _count(self) -> None:
        self.operations += 1
        if self.operations == self._lives:
            os.close(self.writer._file)
            raise CrashError

    def append(
        self, now: float, stimulus: Stimulus, instructions: Sequence[Instruction], state: State
    ) -> None:
        self._count()
        super().append(now, stimulus, instructions, state)

    def flush(self) -> bool:
        self._count()
        done = super().flush()
        self._count()
        return done

    def sync(self) -> None:
        self.flush()
        super().sync()
        self._count()


class Laboratory:
    """A scripted cell whose nodes outlive their coordinator, and count how often each run was
    executed."""

    def __init__(self, task: Task, folder: Path) -> None:
        self.task, self.folder = task, folder
        self.directory = directory_for(task, every=True)
        self.executed: Counter[str] = Counter()
        counted = {name: self._counting(action) for name, action in scripts(task, LINES).items()}
        self.node = lockstep_party(self.directory, self.directory.nodes["node"], counted)
        self.cell: LockStepCell | None = None
        self.disk: Callable[[float], None] = lambda now: None
        """Called at each tick."""

    def _counting(self, action: Callable[..., Any]) -> Callable[..., Any]:
        def counting(ctx: Any, **arguments: Any) -> Any:
            self.executed[ctx.run] += 1
            return action(ctx, **arguments)

        return counting

    def begin(self, lives: int, *first: Stimulus) -> tuple[Mission, MortalStore]:
        """Run until the end or the crash; `first`: the operator's commands before the beginning."""
        header = {
            "mission": "m",
            "mode": "lockstep",
            "seed": 1,
            "runs": RUNS,
            "parameters": dict(self.task.parameters),
        }
        store = MortalStore(JournalWriter(self.folder / "run.journal", header), lives)
        mission = make_mission(self.directory, Setting(self.task, runs=RUNS), "m", "boot-1", store)
        mission.executor.stimulate(0.0, *first)
        self.go(mission)
        return mission, store

    def resume(self) -> Mission:
        """Continue from the journal as a new process, with the same nodes."""
        task, runs = with_runs(self.task, RUNS)
        assert runs == RUNS
        assert self.cell is not None
        journal = read_journal(self.folder / "run.journal")
        mission, go_on = resumed_mission(
            self.directory, task, Engine(task), journal, [], self.cell.now
        )
        self.go(mission, go_on)
        return mission

    def go(self, mission: Mission, begin: Callable[[float], None] | None = None) -> None:
        """Run the cell with this coordinator until the run ends. Raises CrashError when it dies."""
        party = CoordinatorParty(self.directory, mission, begin=begin)
        if self.cell is None:
            self.cell = LockStepCell([party, self.node])
        else:
            self.cell.replace(party)
        cell = self.cell

        def over() -> bool:
            self.disk(cell.now)
            return party.over

        assert cell.run(over, 100_000)


def outcome(mission: Mission) -> Mapping[str, Any]:
    """Return everything that must not depend on a crash."""
    finished = mission.executor.finished
    assert finished is not None
    return {
        "status": finished.status,
        "marking": mission.executor.state.marking,
        "runs": sorted((r.run, r.status, r.cause) for r in mission.tally.runs),
        "cycles": [(c.number, c.status, c.worst[1]) for c in mission.tally.cycles],
        "firings": mission.tally.firings,
    }


def undisturbed(task: Task, folder: Path) -> tuple[Mapping[str, Any], int]:
    """Return the outcome without a crash, and the number of operations at which one can happen."""
    laboratory = Laboratory(task, folder / "undisturbed")
    mission, store = laboratory.begin(0)
    assert set(laboratory.executed.values()) == {1}
    return outcome(mission), store.operations


def die_and_resume(task: Task, folder: Path, lives: int, expected: Mapping[str, Any]) -> None:
    """Crash at an operation of the journal, resume, and compare with the undisturbed run."""
    laboratory = Laboratory(task, folder / str(lives))
    with pytest.raises(CrashError):
        laboratory.begin(lives)
    assert outcome(laboratory.resume()) == expected, f"crash at operation {lives}"
    assert set(laboratory.executed.values()) == {1}, (
        f"crash at operation {lives}: {laboratory.executed}"
    )


def test_dying_anywhere_changes_nothing(catch_ball: Task, tmp_path: Path) -> None:
    """Crashes at twenty operations drawn at random; the proof crashes at all."""
    expected, operations = undisturbed(catch_ball, tmp_path)
    assert expected["status"] is Status.SUCCESS
    assert operations > 60
    for lives in sorted(
        np.random.default_rng(1).choice(np.arange(1, operations), 20, replace=False)
    ):
        die_and_resume(catch_ball, tmp_path, int(lives), expected)


@pytest.mark.proof
def test_dying_at_every_operation_changes_nothing(catch_ball: Task, tmp_path: Path) -> None:
    """Every append, flush and sync of the journal in turn."""
    expected, operations = undisturbed(catch_ball, tmp_path)
    for lives in range(1, operations):
        die_and_resume(catch_ball, tmp_path, lives, expected)


def test_an_override_survives_a_crash_of_the_coordinator(catch_ball: Task, tmp_path: Path) -> None:
    """An override is a stimulus like any other: before and after the crash the operator's
    alternative runs, and a replay agrees."""
    chosen = {"locate_ball": "locate_hough", "track_ball": "predict_kalman"}
    laboratory = Laboratory(catch_ball, tmp_path)
    with pytest.raises(CrashError):
        laboratory.begin(60, *(Override(task, action) for task, action in chosen.items()))
    before = Counter(laboratory.executed)
    mission = laboratory.resume()
    assert mission.executor.state.overrides == chosen
    ran = {
        record.place: record.action
        for record in mission.tally.runs
        if f"m/{record.run}" not in before
    }
    assert {task: ran[task] for task in chosen} == chosen, "runs that only the second process chose"
    steps = list(
        replay(read_journal(tmp_path / "run.journal"), Engine(with_runs(catch_ball, RUNS)[0]))
    )
    assert steps[-1].state == mission.executor.state


def test_replay_computes_every_marking_again(catch_ball: Task, tmp_path: Path) -> None:
    """Every marking is computed from the journal alone; a changed task is noticed at the first
    difference."""
    laboratory = Laboratory(catch_ball, tmp_path)
    mission, _ = laboratory.begin(0)
    task, _ = with_runs(catch_ball, RUNS)
    journal = read_journal(tmp_path / "run.journal")
    steps = list(replay(journal, Engine(task)))
    assert steps[-1].state == mission.executor.state
    other, _ = with_runs(catch_ball, RUNS - 1)
    with pytest.raises(ReplayError, match=r"record \d+ \(Begin\)"):
        list(replay(journal, Engine(other)))


@pytest.mark.parametrize(
    ("same_boot", "wall", "reads"),
    [
        (True, 60.0, 160.0),
        (True, -86_400.0, 160.0),
        (False, 60.0, 60.0),
        (False, -86_400.0, 7.0),
        (False, 2.0, 7.0),
    ],
    ids=["same boot", "clock set back", "another boot", "a lost clock", "a clock that is behind"],
)
def test_the_journals_clock_never_runs_backwards(
    monkeypatch: pytest.MonkeyPatch, same_boot: bool, wall: float, reads: float
) -> None:
    """Whatever the host's time of day was set to before the run is resumed; 7 s is the time of the
    last record."""
    monkeypatch.setattr("petrobot.coordinator.run.recording._host_boot", lambda: "now")
    monkeypatch.setattr(time, "time", lambda: 5_000.0 + wall)
    clock = {"monotonic": 40.0, "host_boot": "now" if same_boot else "before", "unix": 5_000.0}
    now = 200.0
    assert now - origin_of({"mode": "realtime", "clock": clock}, now, 7.0) == reads


JUMPS = """\
import random
import time

_real = time.time
time.time = lambda: _real() + random.choice((-86400.0, -7200.0, 0.0, 7200.0, 86400.0))
"""


@pytest.mark.processes
def test_a_run_does_not_notice_that_the_time_of_day_jumps(tmp_path: Path) -> None:
    """By hours, at every reading, in the coordinator and in all processes of its node."""
    (tmp_path / "sitecustomize.py").write_text(JUMPS)
    program = [sys.executable, "-m", "petrobot.coordinator"]
    subprocess.run([*program, "new", "robot", "carrier"], cwd=tmp_path, check=True)
    folder, port = tmp_path / "carrier", free_ports(1)[0]
    cell = folder / "services.toml"
    cell.write_text(cell.read_text().replace("port = 7501", f"port = {port}"))
    run = [*program, "run", "carrier.toml", "--up", "--no-page", "--json", "out.json"]
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{folder}"}
    ended = subprocess.run(run, cwd=folder, env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    result = json.loads((folder / "out.json").read_text())
    assert result["status"] == "success" and 3.0 < result["sim_s"] < 600.0
    journal = read_journal(next((folder / "runs").glob(f"*/{JOURNAL}")))
    times = [r.data["t"] for r in journal.records if "t" in r.data]
    assert len(times) > 10 and times == sorted(times)
