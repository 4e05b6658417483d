"""Missions in lock step under each of the three programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from msgspec import Struct, field

from experiments.against_trees import plant
from experiments.against_trees.cell import Make, play
from experiments.against_trees.judge import Report
from petrobot.coordinator.engine.instructions import Fired, Instruction
from petrobot.coordinator.engine.stimuli import Stimulus
from petrobot.coordinator.launch import Setting, lockstep_mission, lockstep_party
from petrobot.coordinator.run.interfaces import FirstAlternative, Observer, Selector
from petrobot.coordinator.run.lockstep import CoordinatorParty
from petrobot.coordinator.task import Status, Task
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.cell import Delays, LockStepCell
from petrobot.services.comm.lockstep.party import TICK

LIMIT = 60.0
"""s of simulated time for a mission, and `LIMIT_BALL` more for each ball; the longest correct ball
takes about 45 s (a run that hangs, and resets)."""
LIMIT_BALL = 10.0


class Mission(Struct):
    """The result of a mission."""

    report: Report
    entries: list[plant.Entry]
    seconds: float
    """Duration in simulated time (s), with the start of the cell."""
    score: Mapping[str, Any] = field(default_factory=dict)
    """Balls caught, as the laboratory counts them."""
    ticks: int = 0
    tick_s: float = 0.0


class _Goals:
    """An observer that counts the goals met."""

    def __init__(self, task: Task) -> None:
        self._goals, self.met = frozenset(task.flat.goal_transitions), 0

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Count a firing."""
        if isinstance(instruction, Fired) and instruction.transition in self._goals:
            self.met += 1

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Nothing to count."""

    def progress(self, now: float, run: str, notice: Any) -> None:
        """Nothing to count."""

    def settled(self, now: float, state: Any) -> None:
        """Nothing to count."""


def net_mission(
    directory: Directory,
    task: Task,
    balls: int,
    seed: int,
    parameters: Mapping[str, Any] | None = None,
    selector: Selector | None = None,
) -> Mission:
    """Run petrobot's own coordinator."""
    plant.ENTRIES.clear()
    setting = Setting(task, parameters or {}, balls, seed, selector or FirstAlternative())
    mission, goals = lockstep_mission(directory, setting), _Goals(task)
    mission.executor.observers.append(goals)
    coordinator = CoordinatorParty(directory, mission)
    parties = [lockstep_party(directory, node) for node in directory.nodes.values()]
    crash = ""
    try:
        cell = LockStepCell([coordinator, *parties], Delays(directory.delays()))
        if not cell.run(lambda: coordinator.over, round((LIMIT + LIMIT_BALL * balls) / TICK)):
            crash = "never ends"
    except Exception as fault:
        crash = f"{type(fault).__name__}: {fault}"
    finally:
        for party in parties:
            close = getattr(party, "close", None)
            if close is not None:
                close()
    ended = mission.executor.finished
    gave_up = ended is not None and ended.status is Status.ERROR
    report = Report(goals.met, gave_up, crash)
    return Mission(report, list(plant.ENTRIES), cell.now, mission.score)


def program_mission(
    directory: Directory,
    make: Make,
    balls: int,
    seed: int,
    parameters: Mapping[str, Any] | None = None,
) -> Mission:
    """Run a tree or a state machine."""
    plant.ENTRIES.clear()
    try:
        limit = LIMIT + LIMIT_BALL * balls
        party, now = play(directory, make, balls=balls, seed=seed, limit=limit, prepare=parameters)
    except Exception as fault:  # of the program itself, or of the cell for a wrong request
        crash = f"{type(fault).__name__}: {fault}"
        return Mission(Report(0, False, crash), list(plant.ENTRIES), 0.0)
    program = party.program
    caught, gave_up = (program.caught, program.gave_up) if program is not None else (0, False)
    report = Report(caught, gave_up, "" if party.over else "never ends")
    score = party.score.outcome.values if party.score and party.score.outcome else {}
    return Mission(report, list(plant.ENTRIES), now, score, party.ticks, party.tick_s)


Run = Callable[[int, int], Mission]
"""A function that runs a mission of so many balls with a seed."""
_: type[Observer] = _Goals
