"""One trial (one run token taken out of the runs place, and everything that followed from it) as
plain data, and the observer that records it.

A *trial* is one run of a task, whatever the task does; a mission run is a whole execution and may
contain several trials. A task without a runs place has one trial per mission run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.engine import State
from petrobot.coordinator.engine.instructions import (
    Corrected,
    Finished,
    Fired,
    Instruction,
    Marked,
    RunRecorded,
    StartRun,
)
from petrobot.coordinator.engine.stimuli import RunEnded, Stimulus
from petrobot.coordinator.learning.records import Waited, WaitEnd
from petrobot.coordinator.learning.trial_tokens import TrialTokens
from petrobot.coordinator.learning.waits import EventWaits
from petrobot.coordinator.task import End, Executed, Status, Task
from petrobot.services.comm.protocol.messages import Feedback

DIGITS = 6
"""Decimals of all times and costs in the table (microseconds)."""

_RANK = {status: n for n, status in enumerate(("", *(status.value for status in Status)))}
"""Severity of each status."""

CostOf = Callable[[RunRecorded, Mapping[str, Any]], float | None]
"""Returns the cost of a recorded run, from its record and the values of its result."""


class RunEntry(Struct):
    """One run of an action within a trial. Times in s."""

    place: str
    action: str
    begun: float
    """When its token entered the place, since the trial began."""
    took: float = 0.0
    """From then until the coordinator knew its end, or until a preempting transition took the
    token; includes all waiting."""
    status: str = ""
    """success, failure or error; empty for a censored run (preempted and counts none, or not
    ended)."""
    cause: str = ""
    text: str = ""
    seconds: float = 0.0
    """Duration on the clock of its node."""
    cost: float | None = None
    executed: str = Executed.YES.value
    taken: str = ""
    """The transition that took its token."""
    cancelled: bool = False
    values: dict[str, float] = field(default_factory=dict)
    """Numbers in its result."""
    waited: float | None = None
    """How much of `took` had passed when it was started: the wait for the run before it, for a
    choice and for its device. None: not known, as in tables that are older than this."""
    judged: bool = True
    """False: its status is provisional, and it has no verdict (not known in older tables)."""

    def to_plain(self) -> list[Any]:
        """Return a list in the order of the fields."""
        return [getattr(self, name) for name in self.__struct_fields__]

    @classmethod
    def from_plain(cls, data: Sequence[Any]) -> RunEntry:
        """Read what `to_plain` returned."""
        return cls(*data)


class Trial(Struct):
    """One trial. Times in s."""

    k: int
    """Number in its mission run, from 1."""
    begun: float
    """Time since the mission run began."""
    time: float | None = None
    """Time until every token was back where it was at the beginning; None if that never
    happened."""
    completed: bool = False
    """True if the task could continue, or finished as designed; False if it was given up in this
    trial. Trials that were cut because another one was given up are not kept."""
    goals: int = 0
    """Number of firings of goal transitions."""
    status: str = Status.SUCCESS.value
    """The worst status of its runs."""
    cause: str = ""
    runs: list[RunEntry] = field(default_factory=list)
    waits: list[Waited] = field(default_factory=list)
    """Waits of transitions for events and timers that ended in this trial, and those for events
    that its end cut."""

    fired: dict[str, int] = field(default_factory=dict)
    """How often each transition fired."""

    @property
    def all_success(self) -> bool:
        """Whether every run ended with SUCCESS, as R_conj counts it."""
        return self.completed and all(run.status in (Status.SUCCESS.value, "") for run in self.runs)

    def to_plain(self) -> dict[str, Any]:
        """Return plain data, which a worker sends to the campaign."""
        plain = {
            name: getattr(self, name)
            for name in self.__struct_fields__
            if name not in ("runs", "waits")
        }
        return plain | {
            "runs": [run.to_plain() for run in self.runs],
            "waits": [list(wait) for wait in self.waits],
        }

    @classmethod
    def from_plain(cls, data: Mapping[str, Any]) -> Trial:
        """Read what `to_plain` returned."""
        runs = [RunEntry.from_plain(run) for run in data["runs"]]
        return cls(**{**data, "runs": runs, "waits": waits_of(data["waits"])})


def waits_of(data: Iterable[Sequence[Any]]) -> list[Waited]:
    """Read the waits of a trial; those of older tables do not say how they ended. Raises
    ValueError."""
    return [Waited(str(name), float(s), *map(WaitEnd, end)) for name, s, *end in data]


class TrialLog:
    """Observer of the executor that records each trial."""

    def __init__(self, task: Task, cost_of: CostOf) -> None:
        flat = task.flat
        self._net, self._cost_of = flat.net, cost_of
        self._goals = frozenset(flat.goal_transitions)
        self.tokens = TrialTokens(task)
        """Which trial each token belongs to."""
        self._timers = {
            t.name: [a.place for a in t.inputs]
            for t in flat.transitions.values()
            if t.after is not None and not any(a.end in (End.PREEMPT, End.GOING) for a in t.inputs)
        }
        self._waits = EventWaits(task)
        self._ended_waits: list[Waited] = []
        """Waits that ended before the first trial began."""
        self._trials: dict[int, Trial] = {}
        """The trials that are kept, by number."""
        self._latest = 0
        """Number of the latest trial; 0: none has begun."""
        self._open: list[Trial] = []
        """Trials that are not completed yet."""
        # By place: when its latest token entered. A transition is enabled from the latest of these
        # times over its input places.
        self._since = dict.fromkeys(self._net.places, 0.0)
        self._entries: dict[str, tuple[Trial, RunEntry]] = {}
        self._active: dict[str, float] = {}
        self._values: dict[str, Mapping[str, Any]] = {}
        self._ends: dict[int, list[RunEntry]] = {}
        """By trial: its runs in the order of their ends."""
        self._given_up: str | None = None
        """Why the mission run ended before all its trials completed, if it did."""
        self._origin: float | None = None

    @property
    def trials(self) -> list[Trial]:
        """The trials that are kept."""
        return list(self._trials.values())

    def forget(self, trial: Trial) -> None:
        """Keep a completed trial no longer."""
        del self._trials[trial.k], self._ends[trial.k]
        self._entries = {
            run: known for run, known in self._entries.items() if known[0] is not trial
        }

    def recorded(self, trial: Trial) -> bool:
        """Return whether every run of a trial is recorded."""
        return len(self._ends.setdefault(trial.k, [])) == len(trial.runs)

    # --- an observer --------------------------------------------------------------------------

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Start the time axis at the first stimulus; remember results until their runs are
        recorded."""
        if self._origin is None:
            self._origin = now
            self._since = dict.fromkeys(self._net.places, now)
            self._begin(now)
        self._waits.stimulus(now, stimulus)
        if isinstance(stimulus, RunEnded):
            self._values[stimulus.run] = stimulus.values

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Record what belongs to a trial."""
        if isinstance(instruction, Fired):
            self._fired(now, instruction)
        elif isinstance(instruction, Marked):
            self.tokens.marked(instruction)
        elif isinstance(instruction, StartRun):
            self._entry(now, instruction)
        elif isinstance(instruction, RunRecorded):
            self._recorded(now, instruction)
        elif isinstance(instruction, Corrected) and instruction.run in self._entries:
            self._corrected(instruction)
        elif isinstance(instruction, Finished):
            self._finished(now, instruction)

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Ignore progress."""

    def settled(self, now: float, state: State) -> None:
        """Record the waits that ended without a firing."""
        self._note_waits(self._waits.settled(now, state))

    # --- what happened ------------------------------------------------------------------------

    def _begin(self, now: float) -> None:
        """Begin a trial if a token has left the runs place."""
        if self.tokens.begun == self._latest:
            return
        for trial in self._open:
            trial.completed |= not self.tokens.on_its_way(trial.k)
        if self._latest:
            self._note_waits(self._waits.cut(now))
        assert self._origin is not None
        self._latest += 1
        trial = self._trials[self._latest] = Trial(self._latest, round(now - self._origin, DIGITS))
        self._open = [*(trial for trial in self._open if not trial.completed), trial]

    def _note_waits(self, ended: list[Waited]) -> None:
        """Note waits in the latest trial, those from before the first one in the first one."""
        self._ended_waits += ended
        if self._latest:
            self._trials[self._latest].waits += self._ended_waits
            self._ended_waits = []

    def _fired(self, now: float, fired: Fired) -> None:
        wait = self._waits.fired(now, fired.transition)  # before a new trial cuts it
        number = self.tokens.fired(fired)
        self._begin(now)
        for run in fired.runs:
            if run in self._entries:
                self._entries[run][1].taken = fired.transition
                if run in self._active:  # preempted
                    self._ended(now, run)
        if not self._latest:
            self._note_waits([] if wait is None else [wait])
            return
        trial = self._trials.get(number) or self._trials[self._latest]
        trial.waits += self._ended_waits + ([] if wait is None else [wait])
        self._ended_waits = []
        trial.goals += fired.transition in self._goals
        trial.fired[fired.transition] = trial.fired.get(fired.transition, 0) + 1
        if fired.transition in self._timers:
            since = max(
                (self._since[place] for place in self._timers[fired.transition]), default=now
            )
            trial.waits.append(Waited(fired.transition, round(now - since, DIGITS)))
        for name, before, after in zip(self._net.places, fired.before, fired.after, strict=True):
            if after > before:
                self._since[name] = now
        for k in self.tokens.back:
            back = self._trials.get(k)
            if back is not None and back.time is None:
                back.completed, back.time = True, self._span(now, back)

    def _span(self, now: float, trial: Trial) -> float:
        assert self._origin is not None
        return round(now - self._origin - trial.begun, DIGITS) + 0.0  # no -0.0

    def _entry(self, now: float, start: StartRun) -> RunEntry:
        trial = self._trials.get(self.tokens.of(start.run))
        came = self._since[start.place]
        begun = self._span(came, trial) if trial else 0.0
        entry = RunEntry(start.place, start.action, begun, waited=round(now - came, DIGITS))
        if trial is not None:
            trial.runs.append(entry)
            self._entries[start.run], self._active[start.run] = (trial, entry), came
        return entry

    def _ended(self, now: float, run: str) -> None:
        came = self._active.pop(run, None)
        if came is not None:
            self._entries[run][1].took = round(now - came, DIGITS)

    def _recorded(self, now: float, record: RunRecorded) -> None:
        known = self._entries.get(record.run)
        if known is None:  # it ended before it was sent to a node
            self._entry(
                now,
                StartRun(record.run, record.place, record.primitive_task, record.action, {}, 0.0),
            )
            known = self._entries.get(record.run)
            if known is None:
                return
        # Otherwise a preemption has taken its token, and the place may hold a later one.
        if record.run in self._active:
            self._since[record.place] = now
        self._ended(now, record.run)
        trial, entry = known
        values = self._values.pop(record.run, {})
        entry.status = record.status.value if record.status is not None else ""
        entry.cause = record.cause if record.status is not Status.SUCCESS else ""
        entry.text, entry.cancelled = record.taken_away or record.text, record.cancelled
        entry.judged = not record.deferred
        entry.executed, entry.seconds = record.executed.value, round(record.seconds, DIGITS)
        entry.values = _numbers(values)
        # Of a preempted run, what comes after the firing that took it is no cost of the task.
        taken = record.cancelled and bool(entry.taken)
        cost = self._cost_of(replace(record, seconds=entry.took) if taken else record, values)
        entry.cost = None if cost is None else round(cost, DIGITS)
        self._ends.setdefault(trial.k, []).append(entry)
        if _RANK[entry.status] > _RANK[trial.status]:
            trial.status, trial.cause = entry.status, entry.cause

    def _corrected(self, corrected: Corrected) -> None:
        """Replace the status of a run by its verdict, and update the status of its trial."""
        trial, entry = self._entries[corrected.run]
        entry.status, entry.text = corrected.status.value, corrected.text or entry.text
        entry.cause = corrected.cause if corrected.status is not Status.SUCCESS else ""
        entry.judged = True
        worst = max(self._ends[trial.k], key=lambda one: _RANK[one.status])
        bad = _RANK[worst.status] > _RANK[Status.SUCCESS.value]
        trial.status, trial.cause = (
            (worst.status, worst.cause) if bad else (Status.SUCCESS.value, "")
        )
        self._give_up(trial)

    def _give_up(self, trial: Trial) -> None:
        if self._given_up is not None and not trial.completed:
            trial.status, trial.cause = Status.ERROR.value, trial.cause or self._given_up

    def _finished(self, now: float, finished: Finished) -> None:
        if not self._latest:
            return
        lost = self.tokens.lost(finished)
        for trial in self.trials:
            met = bool(trial.goals) and trial.k not in lost
            trial.completed |= finished.status is Status.SUCCESS or met
        last = self._trials[self._latest]
        if last.completed and last.time is None:
            last.time = self._span(now, last)
        self._trials = {t.k: t for t in self.trials if t.completed or t.k in lost}
        if finished.status is not Status.SUCCESS:
            self._given_up = finished.reason
            for trial in self.trials:
                self._give_up(trial)


def _numbers(values: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers and truth values of a result."""
    return {
        name: round(float(value), DIGITS)
        for name, value in values.items()
        if isinstance(value, bool | int | float) and abs(float(value)) < 1e300
    }
