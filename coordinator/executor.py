"""The executor: where net and network meet. It carries out the engine's instructions and turns answers into stimuli.

A machine without clock or sockets: `take` what a caller noticed, `advance` to a time, and the calls it makes are in its
callers. Every stimulus is handed to the store before its effects leave, and effects leave after the store's `sync`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from coordinator.engine import Engine, State
from coordinator.engine.instructions import (
    ArmTimer,
    CancelRun,
    Choose,
    DisarmTimer,
    Finished,
    HoldRun,
    HoldTimer,
    Instruction,
    ReleaseRun,
    ReleaseTimer,
    StartRun,
    Subject,
)
from coordinator.engine.stimuli import (
    Chosen,
    EventOccurred,
    Hold,
    Pause,
    RunEnded,
    RunHeld,
    RunRaised,
    RunStarted,
    Stimulus,
    StopConfirmed,
    TimerFired,
    VariableChanged,
)
from coordinator.partners import FirstAlternative, Forgetful, Observer, Selector, Store
from coordinator.task import Executed, Scope, Status, Task
from services.comm.caller import Caller
from services.comm.directory import Directory
from services.comm.messages import Answer, Call, Command, Event, Outcome
from services.comm.notice import Accepted, Answered, Ended, EventArrived, Notice, Progress

MEMORY_EVENTS = "memory:"
STOP_MARGIN = 2.0
"""Seconds that a node's stop routine may take after a run's orphan time (docs/semantics.md, cancel)."""
STILL_FENCED = frozenset({"lost", "no_answer", "not_accepted"})
"""Causes after which a device may still be moving: its node has not said that the run is over."""


_TOUCHES_THE_WORLD = (StartRun, CancelRun, HoldRun, ReleaseRun)
"""Effects that leave this process: what led to them is made safe first."""


@dataclass
class _Timer:
    due: float
    held: float | None = None
    """Seconds left while it is held."""


@dataclass
class _Flight:
    """A run that was handed to a node."""

    start: StartRun
    node: str
    device: str
    begun: float
    waits_for_fence: bool = False


@dataclass
class Executor:
    """Runs one mission. `callers` has one caller for each node of the directory."""

    task: Task
    engine: Engine
    directory: Directory
    callers: Mapping[str, Caller]
    mission: str
    seed: int = 0
    selector: Selector = field(default_factory=FirstAlternative)
    store: Store = field(default_factory=Forgetful)
    observers: list[Observer] = field(default_factory=list)
    finished: Finished | None = None
    on_status: Callable[[Mapping[str, Any]], None] | None = None
    """Gets what nodes answer to the operator's questions."""

    def __post_init__(self) -> None:
        """Start with the engine's initial state."""
        self.state = self.engine.initial()
        self._queue: deque[Stimulus] = deque()
        self._effects: list[Instruction] = []
        self._flights: dict[str, _Flight] = {}
        self._timers: dict[str, _Timer] = {}
        self._fences: dict[str, float] = {}
        self._commands: dict[str, str] = {}
        self._acks: list[Callable[[], None]] = []
        self._command_count = 0
        self._boots: Mapping[str, str] = {}
        self._external = {e.name for e in self.task.flat.events.values() if e.scope is Scope.EXTERNAL}
        self._carry_out: Mapping[type, Callable[[float, Instruction], None]] = {
            StartRun: self._start_run,
            CancelRun: self._cancel_run,
            HoldRun: self._hold_run,
            ReleaseRun: self._release_run,
            ArmTimer: self._arm_timer,
            DisarmTimer: self._disarm_timer,
            HoldTimer: self._hold_timer,
            ReleaseTimer: self._release_timer,
        }

    # --- in --------------------------------------------------------------------------------------------------------

    def subscribe(self, now: float) -> None:
        """Have the events and variables that the task knows sent by every node."""
        names = sorted(self._external | {MEMORY_EVENTS + name for name in self.task.flat.variables})
        for caller in self.callers.values():
            caller.subscribe(now, names)

    def adopt(self, now: float, state: State, boots: Mapping[str, str]) -> None:
        """Go on from a state that another process left: ask nodes for its runs, give its orders again, restart its timers.

        `boots` are the boots that the runs were sent to; a node of another boot answers `executed = unknown`.
        """
        self.state, self._boots = state, boots
        for order in self.engine.outstanding(state):
            if isinstance(order, Choose):
                self._queue.append(self._choose(order))
            elif isinstance(order, StartRun):
                self._rejoin(now, order)
            elif isinstance(order, CancelRun):
                self._cancel_again(now, order)
            elif type(order) in self._carry_out:
                self._carry_out[type(order)](now, order)
        self._work(now)

    def relive(self, now: float, stimulus: Stimulus, instructions: Sequence[Instruction], state: State) -> None:
        """Let observers see a step that was recorded earlier; nothing is carried out."""
        self.state = state
        for observer in self.observers:
            observer.stimulus(now, stimulus)
            for instruction in instructions:
                observer.instruction(now, instruction)
            observer.settled(now, state)
        self.finished = next((i for i in instructions if isinstance(i, Finished)), self.finished)

    def _rejoin(self, now: float, start: StartRun) -> None:
        """Ask for a run under its old id: the node goes on with it or gives its stored result."""
        wish = self.directory.actions[start.action].on_resume if start.action in self.directory.actions else "rejoin"
        self._start_run(now, start)
        if wish == "error":
            self._abandon(now, start)
        elif wish == "ask":
            self._queue.append(Pause(f"{start.action} was going on when the coordinator ended: go on with it?"))

    def _abandon(self, now: float, start: StartRun) -> None:
        flight = self._flights.pop(start.run)
        self.callers[flight.node].cancel(now, self.call_id(start.run), "resumed")
        if flight.device:
            self._fences[flight.device] = now + (self.directory.actions[start.action].orphan_time or 0.0) + STOP_MARGIN
        text = "the coordinator ended while it went on"
        self._queue.append(RunEnded(start.run, Status.ERROR, "resumed", text, Executed.UNKNOWN))

    def _cancel_again(self, now: float, cancel: CancelRun) -> None:
        run = self.state.run(cancel.run)
        if run is not None and run.action in self.directory.actions:
            start = StartRun(run.id, run.place, "", run.action, run.arguments, cancel.within)
            self._start_run(now, start)
        self._cancel_run(now, cancel)

    def stimulate(self, now: float, *stimuli: Stimulus) -> None:
        """Take stimuli in, and let their effects leave."""
        self._queue.extend(stimuli)
        self._work(now)

    def take(self, now: float, node: str, notices: Iterable[Notice]) -> None:
        """Take what a node's caller noticed."""
        for notice in notices:
            if isinstance(notice, Ended):
                self._ended(now, node, notice.outcome)
            elif isinstance(notice, Accepted):
                self._accepted(notice.id)
            elif isinstance(notice, EventArrived):
                self._event(now, node, notice.event)
            elif isinstance(notice, Progress):
                self._progress(now, notice)
            elif isinstance(notice, Answered):
                self._answered(notice.answer)
        self._work(now)

    def advance(self, now: float) -> None:
        """Fire the timers that are over, and start what waited for a fence."""
        if not self._timers and not self._fences:
            return
        for key in [k for k, t in self._timers.items() if t.held is None and t.due <= now]:
            del self._timers[key]
            self._queue.append(TimerFired(key))
        for device in [d for d, until in self._fences.items() if until <= now]:
            del self._fences[device]
            for flight in [f for f in self._flights.values() if f.waits_for_fence and f.device == device]:
                self._call(now, flight)
        self._work(now)

    def due(self) -> float | None:
        """When `advance` has something to do next."""
        times = [t.due for t in self._timers.values() if t.held is None] + list(self._fences.values())
        return min(times, default=None)

    # --- one stimulus after the other ------------------------------------------------------------------------------

    def _work(self, now: float) -> None:
        while self._queue:
            while self._queue:
                self._handle(now, self._queue.popleft())
            if self.finished is not None or any(isinstance(effect, _TOUCHES_THE_WORLD) for effect in self._effects):
                self.store.sync()
            effects, self._effects = self._effects, []
            for instruction in effects:
                self._carry_out[type(instruction)](now, instruction)
            if self.store.safe:
                acks, self._acks = self._acks, []
                for acknowledge in acks:
                    acknowledge()

    def _handle(self, now: float, stimulus: Stimulus) -> None:
        for observer in self.observers:
            observer.stimulus(now, stimulus)
        self.state, instructions = self.engine.handle(self.state, stimulus)
        self.store.append(now, stimulus, instructions, self.state)
        for instruction in instructions:
            for observer in self.observers:
                observer.instruction(now, instruction)
            if isinstance(instruction, Choose):
                self._queue.appendleft(self._choose(instruction))
            elif isinstance(instruction, Finished):
                self.finished = instruction
            elif type(instruction) in self._carry_out:
                self._effects.append(instruction)
        for observer in self.observers:
            observer.settled(now, self.state)

    def _choose(self, choose: Choose) -> Chosen:
        if choose.subject is Subject.ACTION:
            offered = tuple(a for a in choose.alternatives if a in self.directory.actions) or choose.alternatives
            return Chosen(choose.key, *self.selector.choose(choose.of, choose.key, offered, self.state.variables))
        draw = np.random.default_rng([self.seed, *choose.key.encode()]).random() * sum(choose.weights)
        bounds = np.cumsum(choose.weights)
        index = min(int(np.searchsorted(bounds, draw, side="right")), len(bounds) - 1)
        return Chosen(choose.key, choose.alternatives[index], f"draw {draw:.4f} of {bounds[-1]:g}")

    # --- what nodes say --------------------------------------------------------------------------------------------

    def call_id(self, run: str) -> str:
        """The id of a run's call, unique for ever."""
        return f"{self.mission}/{run}"

    def _run_of(self, call: str) -> str | None:
        run = call.removeprefix(self.mission + "/")
        return run if run in self._flights else None

    def _accepted(self, call: str) -> None:
        run = self._run_of(call)
        if run is not None:
            self._queue.append(RunStarted(run))

    def _ended(self, now: float, node: str, outcome: Outcome) -> None:
        self._acks.append(lambda: self.callers[node].acknowledge(now, outcome.id))
        run = self._run_of(outcome.id)
        if run is None:
            return
        flight = self._flights.pop(run)
        if flight.device and outcome.cause in STILL_FENCED and Executed(outcome.executed) is not Executed.NO:
            orphan_time = self.directory.actions[flight.start.action].orphan_time or 0.0
            self._fences[flight.device] = now + orphan_time + STOP_MARGIN
        self._queue.append(_run_ended(run, outcome))

    def _event(self, now: float, node: str, event: Event) -> None:
        if event.number:
            self._acks.append(lambda: self.callers[node].acknowledge_event(now, event))
        if event.name.startswith(MEMORY_EVENTS):
            name = event.name.removeprefix(MEMORY_EVENTS)
            self._queue.append(VariableChanged(name, event.data.get("value"), event.source))
        elif event.run:
            run = self._run_of(event.run)
            if run is not None:
                self._queue.append(RunRaised(run, event.name))
        elif event.name in self._external and (event.number or self.engine.awaits(self.state, event.name)):
            self._queue.append(EventOccurred(event.name, event.source, event.number))

    def _progress(self, now: float, notice: Progress) -> None:
        run = self._run_of(notice.id)
        if run is not None:
            for observer in self.observers:
                observer.progress(now, run, notice)

    def _answered(self, answer: Answer) -> None:
        run = self._commands.pop(answer.id, None)
        if run is None:
            if self.on_status is not None and "devices" in answer.data:
                self.on_status(answer.data)
        elif run in self._flights:
            answers = answer.data.get("answers", {})
            said = str(answers.get(self._flights[run].device, "")).replace(" ", "_")
            known = {Hold.HELD.value: Hold.HELD, Hold.STOPPED.value: Hold.STOPPED}
            self._queue.append(RunHeld(run, known.get(said, Hold.CANNOT) if answer.ok else Hold.CANNOT))

    # --- what the engine orders ------------------------------------------------------------------------------------

    def _start_run(self, now: float, start: Instruction) -> None:
        assert isinstance(start, StartRun)
        entry = self.directory.actions.get(start.action)
        if entry is None:
            text = f"{self.directory.source}: no node offers {start.action}"
            self._queue.append(RunEnded(start.run, Status.ERROR, "not_offered", text, Executed.NO))
            return
        flight = _Flight(start, entry.node, entry.device, now)
        self._flights[start.run] = flight
        if entry.device in self._fences and not entry.at_once:
            flight.waits_for_fence = True
        else:
            self._call(now, flight)

    def _call(self, now: float, flight: _Flight) -> None:
        flight.waits_for_fence = False
        start = flight.start
        arguments = {**self.directory.actions[start.action].args, **start.arguments}
        boot = self._boots.get(flight.node, "")
        call = Call(self.call_id(start.run), start.action, arguments, start.deadline, boot=boot, seed=self.seed)
        self.callers[flight.node].call(now, call)

    def _cancel_run(self, now: float, cancel: Instruction) -> None:
        assert isinstance(cancel, CancelRun)
        flight = self._flights.get(cancel.run)
        if flight is None or flight.waits_for_fence:
            self._flights.pop(cancel.run, None)
            self._queue.append(StopConfirmed(cancel.run, Executed.NO))
        else:
            self.callers[flight.node].cancel(now, self.call_id(cancel.run), cancel.reason)

    def _hold_run(self, now: float, hold: Instruction) -> None:
        assert isinstance(hold, HoldRun)
        self._command(now, hold.run, "hold")

    def _release_run(self, now: float, release: Instruction) -> None:
        assert isinstance(release, ReleaseRun)
        self._command(now, release.run, "release")

    def _command(self, now: float, run: str, verb: str) -> None:
        flight = self._flights.get(run)
        if flight is None:
            return
        self._command_count += 1
        key = f"{self.mission}/{verb}#{self._command_count}"
        if verb == "hold":
            self._commands[key] = run
        self.callers[flight.node].command(now, Command(key, verb, flight.device, {"run": self.call_id(run)}))

    def _arm_timer(self, now: float, arm: Instruction) -> None:
        assert isinstance(arm, ArmTimer)
        self._timers[arm.key] = _Timer(now + arm.seconds)

    def _disarm_timer(self, now: float, disarm: Instruction) -> None:
        assert isinstance(disarm, DisarmTimer)
        self._timers.pop(disarm.key, None)

    def _hold_timer(self, now: float, hold: Instruction) -> None:
        assert isinstance(hold, HoldTimer)
        if timer := self._timers.get(hold.key):
            timer.held = max(0.0, timer.due - now)

    def _release_timer(self, now: float, release: Instruction) -> None:
        assert isinstance(release, ReleaseTimer)
        if (timer := self._timers.get(release.key)) and timer.held is not None:
            timer.due, timer.held = now + timer.held, None


def _run_ended(run: str, outcome: Outcome) -> RunEnded:
    return RunEnded(
        run,
        Status(outcome.status),
        outcome.cause,
        outcome.text,
        Executed(outcome.executed),
        dict(outcome.values),
        outcome.seconds,
        cpu_seconds=outcome.cpu_seconds,
    )
