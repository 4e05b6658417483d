"""The executor: passes stimuli to the engine and carries out its instructions.

A sans-I/O machine: `take` receives what a caller noticed, `advance` moves it to a time, and its
calls are in its callers. Every stimulus is stored before its effects leave, and what moves hardware
leaves after a sync of the store. `in_background` may do that elsewhere: a disk may need seconds,
and the coordinator must answer its nodes and operators meanwhile.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any, Final

from msgspec import Struct, field

from petrobot.coordinator.engine import Engine, Mode
from petrobot.coordinator.engine.instructions import (
    CancelRun,
    Choose,
    Finished,
    HoldRun,
    Instruction,
    ReleaseRun,
    StartRun,
    Subject,
)
from petrobot.coordinator.engine.stimuli import (
    Abort,
    Chosen,
    EventOccurred,
    RunRaised,
    Stimulus,
    VariableChanged,
    Verdict,
)
from petrobot.coordinator.run.calls import Dispatch
from petrobot.coordinator.run.interfaces import (
    FirstAlternative,
    Forgetful,
    Observer,
    Selector,
    Store,
)
from petrobot.coordinator.run.recording import RecordedStep
from petrobot.coordinator.task import Scope, Status, Task
from petrobot.services.comm.calls.caller import Caller, LateResult, Notice
from petrobot.services.comm.calls.events import (
    STOP_EVENT,
    VERDICT_EVENTS,
    RunVerdict,
    verdict_event,
)
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.protocol.messages import (
    EMERGENCY_STOP,
    LATCHED,
    Accept,
    Answer,
    Event,
    Feedback,
    Outcome,
    Welcome,
    split_boot,
)

MEMORY_EVENTS: Final = "memory:"
SYNC_WITHIN: Final = 0.5
"""Time after which records are synced even if no effect needs that (s), so that nodes may forget
results."""
_Order = StartRun | CancelRun | HoldRun | ReleaseRun
"""Instructions that leave the process."""


class Executor(Struct, dict=True):
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
    """Receives the nodes' answers to the operator's questions."""
    in_background: Callable[[Callable[[], None]], None] | None = None
    """Does what makes the store durable in another thread, then calls `synced`. None: it is done at
    once."""

    def __post_init__(self) -> None:
        """Start with the engine's initial state."""
        self.state = self.engine.initial()
        self.dispatch = Dispatch(self.directory, self.callers, self.mission, self.seed)
        self._queue: deque[Stimulus] = deque()
        self._effects: list[Instruction] = []
        self._when_safe: list[Callable[[float], None]] = []
        """What is done when all that was appended is durable."""
        self._sync_wanted = False
        self._syncing: tuple[list[Instruction], list[Callable[[float], None]]] | None = None
        """Effects, and what else waits for the sync that is under way; None: there is none."""
        self._unsafe_since: float | None = None
        """Since when a record has waited for the begin of a sync (s)."""
        self._external = {
            e.name for e in self.task.flat.events.values() if e.scope is Scope.EXTERNAL
        }

    # --- in -----------------------------------------------------------------------------------

    def subscribe(self, now: float, *, fresh: bool) -> None:
        """Subscribe at every node to the events and variables of the task and to verdicts on its
        runs; `fresh`: the mission run begins now."""
        known = self._external | {MEMORY_EVENTS + name for name in self.task.flat.variables}
        names = sorted(known | {verdict_event(self.mission)})
        for caller in self.callers.values():
            caller.subscribe(now, names, fresh=fresh)

    def replay(self, now: float, step: RecordedStep) -> None:
        """Replay a step that an earlier process recorded at `now`: observers see it, but nothing is
        carried out again."""
        self.state = step.state
        self.dispatch.replay(now, step.stimulus, step.instructions, step.boots)
        for observer in self.observers:
            observer.stimulus(now, step.stimulus)
            for instruction in step.instructions:
                observer.instruction(now, instruction)
            observer.settled(now, step.state)
        self.finished = next(
            (i for i in step.instructions if isinstance(i, Finished)), self.finished
        )

    def adopt(self, now: float) -> None:
        """Continue after the replayed steps: ask nodes for the runs, and give the orders again."""
        orders = self.engine.outstanding(self.state)
        self._queue.extend(self._choose(order) for order in orders if isinstance(order, Choose))
        self._queue.extend(self.dispatch.adopt(now, orders, self.state))
        self._work(now)

    def stimulate(self, now: float, *stimuli: Stimulus) -> None:
        """Handle stimuli, and let their effects leave."""
        self._queue.extend(stimuli)
        self._work(now)

    def take(self, now: float, node: str, notices: Iterable[Notice]) -> None:
        """Handle what a node's caller noticed."""
        for notice in notices:
            if isinstance(notice, Outcome):
                self._ended(now, node, notice)
            elif isinstance(notice, Accept):
                self._queue.extend(self.dispatch.accepted(now, notice.id))
            elif isinstance(notice, Event):
                self._event(now, node, notice)
            elif isinstance(notice, Feedback):
                self._progress(now, notice)
            elif isinstance(notice, Answer):
                self._answered(now, notice)
            elif isinstance(notice, LateResult):
                self._abort_if_latched(now, node, notice.outcome)
                self._queue.extend(self.dispatch.late(now, notice.outcome))
            elif isinstance(notice, Welcome):
                process, stops, _ = split_boot(notice.boot)
                self.dispatch.back(now, node, process, notice.runs)
                if stops != self.callers[node].stops:
                    self._abort(now, node)
        self._work(now)

    def advance(self, now: float) -> None:
        """Handle elapsed timers, start runs that waited for a fence, and sync records that have
        waited for long."""
        # Asked first, because a lock-step cell calls this at each tick.
        if self.dispatch.idle and self._unsafe_since is None:
            return
        due = self.due()
        if due is None or now < due:
            return
        self._queue.extend(self.dispatch.advance(now))
        self._work(now)

    def due(self) -> float | None:
        """Return when `advance` is needed next."""
        due = self.dispatch.due()
        if self._unsafe_since is None or self._syncing is not None:
            return due
        safe_by = self._unsafe_since + SYNC_WITHIN
        return safe_by if due is None else min(due, safe_by)

    def when_safe(self, now: float, then: Callable[[float], None]) -> None:
        """Call `then`, with the time, when all that was appended is durable."""
        self._when_safe.append(then)
        self._sync_wanted = True
        self._work(now)

    def synced(self, now: float) -> None:
        """The sync that `in_background` was given has ended: carry out what waited for it."""
        assert self._syncing is not None
        (effects, then), self._syncing = self._syncing, None
        # What was stopped or held before it began must not move for as long as another sync takes.
        held = {e.run for e in self._effects if isinstance(e, CancelRun | HoldRun)}
        held &= {e.run for e in effects if isinstance(e, StartRun)}
        behind = [e for e in effects if isinstance(e, _Order) and e.run in held]
        self._effects[:0] = behind
        self._carry_out(now, [e for e in effects if e not in behind])
        for call in then:
            call(now)
        self._work(now)

    @property
    def over(self) -> bool:
        """Whether the net has finished, and all that led to it is durable."""
        return self.finished is not None and self._syncing is None and self.store.safe

    # --- one stimulus after the other ---------------------------------------------------------

    def _work(self, now: float) -> None:
        while True:
            while self._queue:
                self._handle(now, self._queue.popleft())
            effects = self._safe_effects(now)
            if not effects:
                return
            self._carry_out(now, effects)

    def _carry_out(self, now: float, effects: Iterable[Instruction]) -> None:
        for instruction in effects:
            stopping = isinstance(instruction, _Order) and instruction.run in self.state.stopping
            if isinstance(instruction, StartRun if stopping else CancelRun):
                continue  # it was stopped before it began, or ended in the same turn
            self._queue.extend(self.dispatch.carry_out(now, instruction))

    def _safe_effects(self, now: float) -> list[Instruction]:
        """Return the effects that may leave: after a sync if an effect moves hardware or ends the
        mission run; other orders when their records survive this process.

        Effects of one turn share one sync, and while it is under way others gather for the next.
        What waits is synced within `SYNC_WITHIN`, and acknowledged then.
        """
        effects, self._effects = self._effects, []
        if self._syncing is None:
            waited = self._unsafe_since is not None and now >= self._unsafe_since + SYNC_WITHIN
            if (
                self.store.safe
                or waited
                or self._sync_wanted
                or self.finished is not None
                or any(self._needs_sync(effect) for effect in effects)
            ):
                return self._sync(now, effects)
        if self._unsafe_since is None and not self.store.safe:
            self._unsafe_since = now
        leaving, self._effects = self._split(effects)
        return leaving

    def _sync(self, now: float, effects: list[Instruction]) -> list[Instruction]:
        """Make all that was appended durable, or begin to. Return the effects that may leave."""
        self._unsafe_since, self._sync_wanted = None, False
        then, self._when_safe = self._when_safe, []
        if not self.store.safe:
            if self.in_background is not None:
                leaving, waiting = self._split(effects)
                self._syncing = waiting, then
                self.in_background(self.store.sync)
                return leaving
            self.store.sync()
        for call in then:
            call(now)
        return effects

    def _needs_sync(self, effect: Instruction) -> bool:
        return isinstance(effect, _Order) and (
            self.store.durable or self.dispatch.moves_hardware(effect)
        )

    def _split(self, effects: Iterable[Instruction]) -> tuple[list[Instruction], list[Instruction]]:
        """Return the effects that may leave without a sync, and those that wait for one: orders to
        a device, any behind another order about the same run, and all while a sync is writing."""
        before = [] if self._syncing is None else self._syncing[0]
        runs = {effect.run for effect in before if isinstance(effect, _Order)}
        leaving, waiting = list[Instruction](), list[Instruction]()
        for effect in effects:
            if isinstance(effect, _Order) and (
                effect.run in runs or self._needs_sync(effect) or not self.store.flush()
            ):
                runs.add(effect.run)
                waiting.append(effect)
            else:
                leaving.append(effect)
        return leaving, waiting

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
            elif self.dispatch.carries_out(instruction):
                self._effects.append(instruction)
        for observer in self.observers:
            observer.settled(now, self.state)

    def _choose(self, choose: Choose) -> Chosen:
        if choose.subject is Subject.ACTION:
            fixed = self.state.overrides.get(choose.of)
            if fixed is not None:
                return Chosen(choose.key, fixed, "chosen by the operator")
            offered = (
                tuple(a for a in choose.alternatives if a in self.directory.actions)
                or choose.alternatives
            )
            return Chosen(
                choose.key,
                *self.selector.choose(choose.of, choose.key, offered, self.state.variables),
            )
        import numpy as np  # here, because most commands import this module and draw nothing

        draw = np.random.default_rng([self.seed, *choose.key.encode()]).random() * sum(
            choose.weights
        )
        bounds = np.cumsum(choose.weights)
        index = min(int(np.searchsorted(bounds, draw, side="right")), len(bounds) - 1)
        return Chosen(choose.key, choose.alternatives[index], f"draw {draw:.4f} of {bounds[-1]:g}")

    # --- what nodes say -----------------------------------------------------------------------

    def _ended(self, now: float, node: str, outcome: Outcome) -> None:
        self._abort_if_latched(now, node, outcome)
        self._when_safe.append(lambda at: self.callers[node].acknowledge(at, outcome.id))
        self._queue.extend(self.dispatch.ended(now, outcome))

    def _abort_if_latched(self, now: float, node: str, outcome: Outcome) -> None:
        """Abort before the end of the run, so that no transition answers it."""
        if outcome.cause == EMERGENCY_STOP and outcome.values.get(LATCHED) is True:
            self._abort(now, node)

    def _abort(self, now: float, node: str) -> None:
        """Abort because of an emergency stop that a node reports. Who gave it also tells the
        coordinator, but it may have been frozen, or cut off, or not have been resumed yet: then
        clearing the stop would let it move the devices on. At once: what the node says next may
        free a device for which a run waits."""
        if self.finished is None and self.state.mode not in (Mode.FRESH, Mode.ABORTING):
            self.stimulate(now, Abort(f"emergency stop, as {node} reports"))

    def _event(self, now: float, node: str, event: Event) -> None:
        if event.number:
            self._when_safe.append(lambda at: self.callers[node].acknowledge_event(at, event))
        if event.name == STOP_EVENT:
            self._abort(now, node)
        elif event.name.startswith(MEMORY_EVENTS):
            name = event.name.removeprefix(MEMORY_EVENTS)
            self._queue.append(VariableChanged(name, event.data.get("value"), event.source))
        elif event.name.startswith(VERDICT_EVENTS):
            with suppress(ValueError):  # a mistake of a foreign node, which cannot be mended here
                self._queue.append(self.verdict(RunVerdict.of_data(event.data)))
        elif event.run:
            run = self.dispatch.run_of(event.run)
            if run is not None:
                self._queue.append(RunRaised(run, event.name, event.number))
        elif event.name in self._external and (
            event.number or self.engine.awaits(self.state, event.name)
        ):
            self._queue.append(EventOccurred(event.name, event.source, event.number))

    def verdict(self, said: RunVerdict) -> Verdict:
        """Return a verdict as a stimulus. One on a run of another mission run gets an id that no
        run here has."""
        return Verdict(
            said.run.removeprefix(f"{self.mission}/"), Status(said.status), said.cause, said.text
        )

    def _progress(self, now: float, notice: Feedback) -> None:
        run = self.dispatch.run_of(notice.id)
        if run is not None:
            for observer in self.observers:
                observer.progress(now, run, notice)

    def _answered(self, now: float, answer: Answer) -> None:
        held = self.dispatch.answered(now, answer)
        self._queue.extend(held)
        if not held and self.on_status is not None and "devices" in answer.data:
            self.on_status(answer.data)
