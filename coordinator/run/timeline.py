"""An observer that records the time of each run and firing, for reports and pictures."""

from __future__ import annotations

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.engine import State
from petrobot.coordinator.engine.instructions import (
    Corrected,
    Fired,
    Instruction,
    Report,
    RunRecorded,
    StartRun,
)
from petrobot.coordinator.engine.stimuli import Stimulus
from petrobot.coordinator.task import Status
from petrobot.services.comm.protocol.messages import Feedback


class Bar(Struct, frozen=True):
    """A run on the time axis (s since the timeline's origin)."""

    run: str
    place: str
    action: str
    begun: float
    ended: float | None = None
    status: Status | None = None
    """None while it is active, and for a preempted run that does not count."""
    cause: str = ""
    text: str = ""


class Firing(Struct, frozen=True):
    """A transition that fired at a time (s since the timeline's origin)."""

    time: float
    number: int
    transition: str
    cause: str


class Timeline(Struct):
    """All runs and firings of a mission run, in order."""

    bars: dict[str, Bar] = field(default_factory=dict)
    firings: list[Firing] = field(default_factory=list)
    reports: list[tuple[float, Report]] = field(default_factory=list)
    origin: float | None = None
    """When its time axis begins: as that of the journal, else at the first stimulus."""

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Keep starts, ends and firings."""
        time = self._since(now)
        if isinstance(instruction, StartRun):
            self.bars[instruction.run] = Bar(
                instruction.run, instruction.place, instruction.action, time
            )
        elif isinstance(instruction, RunRecorded):
            bar = self.bars.get(
                instruction.run, Bar(instruction.run, instruction.place, instruction.action, time)
            )
            self.bars[instruction.run] = replace(
                bar,
                ended=time,
                status=instruction.status,
                cause="" if instruction.cancelled else instruction.cause,
                text=instruction.taken_away or instruction.text,
            )
        elif isinstance(instruction, Corrected) and instruction.run in self.bars:
            judged = (instruction.status, instruction.cause, instruction.text)
            bar = self.bars[instruction.run]
            self.bars[instruction.run] = replace(
                bar, status=judged[0], cause=judged[1], text=judged[2] or bar.text
            )
        elif isinstance(instruction, Fired):
            self.firings.append(
                Firing(
                    time,
                    instruction.number,
                    instruction.transition,
                    instruction.cause,
                )
            )
        elif isinstance(instruction, Report):
            self.reports.append((time, instruction))

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """The first stimulus begins the time axis, unless it has begun."""
        self._since(now)

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Progress is not kept."""

    def settled(self, now: float, state: State) -> None:
        """States are not kept."""

    def _since(self, now: float) -> float:
        if self.origin is None:
            self.origin = now
        return now - self.origin
