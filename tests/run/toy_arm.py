"""A toy task on one device for tests of the coordinator: `work`, which a bell may preempt, then
`tidy` with the same arm."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from petrobot.coordinator.engine import (
    Begin,
    Engine,
    Fired,
    Instruction,
    Report,
    RunRecorded,
    State,
    Stimulus,
)
from petrobot.coordinator.run.executor import Executor
from petrobot.coordinator.run.interfaces import Forgetful, Store
from petrobot.coordinator.run.recording import RecordedStep
from petrobot.coordinator.task.file import loads
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.location_file import Directory, parse
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.messages import Event, Feedback, Message

TASK = """
schema = 1
[task]
name = "toy"
final = "done == 1"
final_error = "broken == 1"
[primitive_tasks]
work = { goal = "a part is moved", alternatives = ["do_work"], deadline = 5.0, stop_within = 1.0 }
tidy = { goal = "all is as before", alternatives = ["do_tidy"], deadline = 3.0 }
[events.bell]
scope = "external"
memory = "latched"
[places]
begin = { kind = "control", tokens = 1 }
work = { kind = "action" }
tidy = { kind = "action" }
done = { kind = "control" }
broken = { kind = "control" }
[transitions]
go = { in = ["begin"], out = ["work"] }
rung = { in = ["work:preempt=success"], out = ["tidy"], event = "bell" }
worked = { in = ["work:normal"], out = ["tidy"] }
failed = { in = ["work:error"], out = ["tidy"] }
tidied = { in = ["tidy:normal"], out = ["done"] }
not_tidied = { in = ["tidy:error"], out = ["broken"] }
"""
SERVICES = """
schema = 1
[nodes.motion]
host = "127.0.0.1"
port = 7999
[devices.arm]
node = "motion"
driver = "toy:Arm"
[actions.do_work]
run = "toy:work"
task = "work"
device = "arm"
orphan_time = 1.0
on_resume = "ON_RESUME"
[actions.do_tidy]
run = "toy:tidy"
task = "tidy"
device = "arm"
"""
WORK, TIDY = "m/work#1", "m/tidy#1"


def directory(on_resume: str = "rejoin", device: str = 'device = "arm"') -> Directory:
    """Return the directory of the toy task; `device` replaces the line that assigns both actions to
    the arm."""
    return parse(
        SERVICES.replace("ON_RESUME", on_resume).replace('device = "arm"', device),
        Path("services.toml"),
    )


class Bench:
    """An executor with one caller. The test plays the node: it reads what was sent and writes the
    answers."""

    def __init__(
        self,
        *,
        on_resume: str = "rejoin",
        epoch: int = 1,
        store: Store | None = None,
        device: str = 'device = "arm"',
    ) -> None:
        self.caller = Caller("motion", m.Hello(2, 2, "coordinator", "m", f"c{epoch}", epoch))
        places = directory(on_resume, device)
        task = loads(TASK, "toy")
        engine = Engine(task, {a.name: a.device for a in places.actions.values() if a.device})
        self.executor = Executor(
            task, engine, places, {"motion": self.caller}, "m", store=store or Forgetful()
        )
        self.executor.observers.append(self)
        self.fired: list[str] = []
        self.records: list[RunRecorded] = []
        self.reports: list[str] = []
        self.steps: list[RecordedStep] = []
        self._stimulus: tuple[Stimulus, list[Instruction]] | None = None
        self.boot = ""
        self.now = 0.0
        self._out: list[Message] = []

    # --- an observer: records what happened ---------------------------------------------------

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        self._stimulus = stimulus, []

    def instruction(self, now: float, instruction: Instruction) -> None:
        assert self._stimulus is not None
        self._stimulus[1].append(instruction)
        if isinstance(instruction, Fired):
            self.fired.append(instruction.transition)
        elif isinstance(instruction, RunRecorded):
            self.records.append(instruction)
        elif isinstance(instruction, Report):
            self.reports.append(instruction.key)

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Ignore progress."""

    def settled(self, now: float, state: State) -> None:
        assert self._stimulus is not None
        stimulus, instructions = self._stimulus
        boots = {"motion": self.boot}
        self.steps.append(
            RecordedStep(len(self.steps) + 1, now, stimulus, tuple(instructions), state, boots)
        )

    # --- the node -----------------------------------------------------------------------------

    def link(self, now: float, boot: str = "n1", runs: Sequence[str] = ()) -> None:
        """Let the node accept the connection."""
        self.boot = boot
        self.caller.link_up(now, m.Welcome(2, "motion", boot, (), tuple(runs)))
        self.go(now)

    def say(self, now: float, *messages: Message) -> None:
        """Send a message from the node."""
        for message in messages:
            self.caller.receive(now, message)
            self.go(now)

    def go(self, now: float) -> None:
        """Let time pass until `now`, and advance at each moment in between that is due."""
        while True:
            dues = [d for d in (self.caller.due(), self.executor.due()) if d is not None]
            self.now = max(self.now, min([*dues, now]))
            self.caller.advance(self.now)
            self.executor.take(self.now, "motion", self.caller.notices())
            self.executor.advance(self.now)
            self._out += self.caller.messages(self.now)
            if self.now >= now:
                return

    def sent(self, *kinds: type) -> list[Message]:
        """Return the messages of these kinds (default: all) sent since the last call."""
        out, self._out = [*self._out, *self.caller.messages(self.now)], []
        return [message for message in out if not kinds or isinstance(message, kinds)]

    def calls(self) -> list[str]:
        """Return the ids of the calls made since the last call of this method."""
        return [call.id for call in self.sent(m.Call) if isinstance(call, m.Call)]

    def begin(self) -> Bench:
        """Start `work` at 0 s, accepted by the node."""
        self.link(0.0)
        self.executor.stimulate(0.0, Begin())
        assert self.calls() == [WORK]
        self.say(0.0, m.Accept(WORK))
        return self

    def ring(self, now: float, number: int = 1) -> None:
        """Ring the bell, which preempts `work`."""
        self.say(now, Event("bell", "desk", number))

    def resumed(
        self, now: float, *, on_resume: str = "rejoin", boot: str = "n1", runs: Sequence[str] = ()
    ) -> Bench:
        """Resume in another process from what this one has recorded; `runs`: those that the node
        still knows."""
        bench = Bench(on_resume=on_resume, epoch=2)
        for step in self.steps:
            bench.executor.replay(step.time, step)
        bench.records.clear()
        bench.fired.clear()
        bench.now = now
        bench.link(now, boot, runs)
        bench.sent()
        bench.executor.adopt(now)
        return bench
