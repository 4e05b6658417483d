"""The learning selector of a mission run: it turns what the executor records into records of
learning, and chooses actions by them.

It has two roles for the executor: as its `Selector` it chooses actions, as an `Observer` it sees
everything that happens. Its state changes only by what it observes, never by a request for a
choice, and times are rounded to the microsecond, as journals store them. A resumed run replays the
recorded steps and so reaches the same state as a run that was never interrupted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from math import nan
from typing import Any

import numpy as np
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
from petrobot.coordinator.engine.state import Phase
from petrobot.coordinator.engine.stimuli import Abort, Begin, Chosen, RunEnded, Stimulus
from petrobot.coordinator.learning.estimate import COUNT, Observation
from petrobot.coordinator.learning.learning import Learning
from petrobot.coordinator.learning.records import (
    Choice,
    Correction,
    Passage,
    Record,
    RunEnd,
    TrialEnd,
)
from petrobot.coordinator.learning.selectors import TASK, cost_of, verdicts_of_task
from petrobot.coordinator.learning.statistics import added
from petrobot.coordinator.learning.trial_tokens import NOBODY, TrialTokens
from petrobot.coordinator.learning.waits import EventWaits
from petrobot.coordinator.run.interfaces import FirstAlternative
from petrobot.coordinator.task import Executed, Status, Task
from petrobot.coordinator.task.conditions import (
    ConditionError,
    ConditionFault,
    Expression,
    parse as parse_condition,
)
from petrobot.services.comm.protocol.messages import Feedback

LARGEST = 1e150
"""Numbers of results from this magnitude on are not used as costs: the sum of their squares would
overflow."""


class ContextError(ValueError):
    """The task cannot distinguish this context."""


class Contexts(Struct, frozen=True, dict=True):
    """What distinguishes contexts: names of parameters and variables, and conditions on them.
    Raises ContextError for one that cannot be read."""

    parts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Parse the conditions."""
        try:
            _ = self.conditions
        except ConditionError as fault:
            raise ContextError(f"context: {fault}") from fault

    @cached_property
    def conditions(self) -> tuple[Expression, ...]:
        """The parsed parts."""
        return tuple(parse_condition(part) for part in self.parts)

    def check(self, task: Task) -> None:
        """Raise ContextError if a name is neither a parameter nor a variable of the task."""
        known = {*task.parameters, *task.flat.variables}
        for condition in self.conditions:
            for name in sorted(condition.names - known):
                raise ContextError(
                    f"context {condition.text!r}: {task.name} has no parameter or variable "
                    f"{name!r}; "
                    f"it has: {', '.join(sorted(known)) or 'none'}"
                )

    def of(self, values: Mapping[str, Any]) -> str:
        """Return the current context as text, for example `regime=B` or `light < 0.3=true`; several
        parts are joined by a comma."""
        return ", ".join(f"{c.text}={_judged(c, values)}" for c in self.conditions)


def usual_contexts(task: Task) -> Contexts:
    """Return the default: the regime if the task has a parameter of that name, otherwise a single
    context."""
    return Contexts(("regime",) if "regime" in task.parameters else ())


def _judged(condition: Expression, values: Mapping[str, Any]) -> str:
    if condition.names == {condition.text}:
        value = values.get(condition.text)
        return str(value).lower() if isinstance(value, bool) or value is None else str(value)
    try:
        return "true" if condition.holds(values) else "false"
    except ConditionFault:
        return "unknown"


class _ActiveRun(Struct):
    """A run whose token is in its place."""

    entered: float
    context: str | None = None
    taken_by: str | None = None
    taken_at: float = 0.0
    ended: RunEnded | None = None


class _Trial(Struct):
    """A token on its way, from the runs place until every token is back."""

    number: int
    begun: float
    goals: int = 0
    met: bool | None = None
    """The verdict; None while there is none."""
    back: bool = False
    """Every token is back."""
    completed: bool = False
    """The task could take the next token; the trial is counted when no preempted run of it is still
    being stopped."""
    seconds: float = 0.0
    context: str = ""
    """The context in which it began."""
    runs: list[tuple[str, str, str, Observation]] = field(default_factory=list)
    """Primitive task, action, context and end of each run that served it."""


class LearningSelector(FirstAlternative):
    """Implements `Selector` and `Observer` with a `Learning`.

    `chosen`: actions that the user fixed; their runs are learned from, too. `live`: apply each
    record at once; False for a frozen run, which learns nothing. `generation`: number of mission
    runs that were learned from before, so that a second run with the same seed draws other actions.
    `declared`: in lock step, the compute time (s) of each action as services.toml declares it, so
    that measured CPU time never influences a choice there.
    """

    def __init__(
        self,
        learning: Learning,
        contexts: Contexts | None = None,
        chosen: Mapping[str, str] | None = None,
        *,
        seed: int = 0,
        generation: int = 0,
        live: bool = True,
        declared: Mapping[str, float] | None = None,
    ) -> None:
        super().__init__(chosen)
        self.learning = learning
        self.contexts = usual_contexts(learning.task) if contexts is None else contexts
        self.contexts.check(learning.task)
        self.records: list[Record] = []
        """All records of this run, in order."""
        self._seed, self._generation, self._live = seed, generation, live
        self._declared = declared
        self._values: Mapping[str, Any] = {}
        self._active: dict[str, _ActiveRun] = {}
        self._deferred: dict[str, RunEnd] = {}
        """Runs whose verdict may still arrive."""
        self._waits = EventWaits(learning.task)
        self._goals = frozenset(learning.task.flat.goal_transitions)
        self._tokens = TrialTokens(learning.task)
        self._open: dict[int, _Trial] = {}
        """The trials that are not recorded yet, by number: a late run may still belong to them."""
        self._latest = NOBODY
        self._served: dict[str, _Trial] = {}
        """The trial of each active run."""
        self._aborted = False

    @property
    def context(self) -> str:
        """The current context."""
        return self.contexts.of(self._values)

    # --- selector -----------------------------------------------------------------------------

    def choose(
        self,
        task: str,
        run: str,
        alternatives: tuple[str, ...],
        variables: Mapping[str, Any] | None = None,
    ) -> tuple[str, str]:
        """Choose as the user fixed it, otherwise as the selector says. (A choice of the operator is
        in the engine's state; the executor applies it.)"""
        if task in self._chosen or task not in self.learning.selectors:
            return super().choose(task, run, alternatives, variables)
        context = self.contexts.of(self._values if variables is None else variables)
        rng = np.random.default_rng([self._seed, self._generation, 1, *run.encode()])
        return self.learning.choose(task, context, alternatives, rng)

    def figures(self, task: str) -> Mapping[str, Mapping[str, float]]:
        """Return the probability of each alternative in the current context, and of those with
        runs there R, C and J by the definition of `learned show`, with the intervals of R and J;
        `best` marks the lowest J if it is not so by chance."""
        selector, context = self.learning.selectors.get(task), self.context
        if selector is None:
            return {}
        shares = selector.probabilities(context)
        judged = self.learning.compared(task, context)
        shown: dict[str, dict[str, float]] = {}
        for f in judged.figures:
            shown[f.action] = {"probability": shares[f.action]}
            if f.runs > 0:
                shown[f.action] |= {"reliability": f.reliability, "cost": f.cost, "j": f.j}
                shown[f.action] |= {"reliability_low": f.lower, "reliability_high": f.upper}
                shown[f.action] |= {"j_low": f.j_lower, "j_high": f.j_upper}
                shown[f.action]["best"] = f.action == judged.best and judged.clear
        return shown

    # --- observer -----------------------------------------------------------------------------

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Remember the context of a choice, and what a run's result contains beside its status."""
        self._begin(now)
        self._waits.stimulus(now, stimulus)
        if isinstance(stimulus, Begin):  # its own firings have a context, too
            point = {} if stimulus.point is None else stimulus.point.variables
            self._values = {
                **self.learning.task.initial_variables(),
                **point,
                **stimulus.parameters,
                **stimulus.variables,
            }
        elif isinstance(stimulus, Chosen):
            self._choice(now, stimulus)
        elif isinstance(stimulus, RunEnded):
            self._run(now, stimulus.run).ended = stimulus
        elif isinstance(stimulus, Abort):
            self._aborted = not stimulus.stuck

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Turn the executor's records into records of learning."""
        if isinstance(instruction, Fired):
            self._fired(now, instruction)
        elif isinstance(instruction, StartRun):
            self._run(now, instruction.run)
            if self._open:
                self._served[instruction.run] = self._open[self._tokens.of(instruction.run)]
        elif isinstance(instruction, Marked):
            self._tokens.marked(instruction)
        elif isinstance(instruction, RunRecorded):
            self._ended(now, instruction)
        elif isinstance(instruction, Finished):
            self._finished(now, instruction)
        elif isinstance(instruction, Corrected):
            self._corrected(instruction)

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Ignore progress: nothing is learned from it."""

    def settled(self, now: float, state: State) -> None:
        """Remember the variables and the active runs, and record waits that ended."""
        self._values = state.variables
        for run in state.runs():
            # The stochastic view has the queue for a server itself.
            if run.phase in (Phase.QUEUED, Phase.DONE):
                continue
            active = self._run(now, run.id)
            if active.context is None and run.action:
                active.context = self.contexts.of(state.variables)
        for wait in self._waits.settled(now, state):
            self._note(Passage(wait.transition, self.context, wait.seconds, wait.end))

    # --- records ------------------------------------------------------------------------------

    def _run(self, now: float, run: str) -> _ActiveRun:
        return self._active.setdefault(run, _ActiveRun(now))

    def _note(self, record: Record) -> None:
        self.records.append(record)
        if self._live:
            self.learning.apply(record)

    def _choice(self, now: float, chosen: Chosen) -> None:
        place = self.learning.task.flat.places.get(chosen.key.rpartition("#")[0])
        if place is None or not place.task:
            return
        active = self._run(now, chosen.key)
        active.context = self.context
        self._note(Choice(place.task, chosen.alternative, active.context))

    def _fired(self, now: float, fired: Fired) -> None:
        for run in fired.runs:
            if run in self._active:
                self._active[run].taken_by, self._active[run].taken_at = fired.transition, now
        self._pass(now, fired)
        wait = self._waits.fired(now, fired.transition)
        self._note(Passage(fired.transition, self.context, None if wait is None else wait.seconds))

    def _ended(self, now: float, record: RunRecorded) -> None:
        active = self._active.pop(record.run, _ActiveRun(now))
        context = self.context if active.context is None else active.context
        # A preempted run lasted until the transition took its token; its node may report the
        # cancelled run later. One that was lost with its node lasted until that was noticed. Any
        # other run lasted as long as its node says.
        preempted = (active.taken_by or "") if record.cancelled else None
        lost = record.executed is Executed.UNKNOWN and not record.seconds
        until = active.taken_at if preempted else now
        seconds = (
            max(0.0, record.seconds)
            if preempted is None and not lost
            else round(max(0.0, until - active.entered), 6)
        )
        result = active.ended
        outcome = Observation(
            record.status,
            seconds,
            record.cause,
            record.executed,
            self._cpu(record, result),
            _numbers(result.values) if result is not None and preempted is None else {},
            preempted,
            round(max(0.0, now - active.entered - seconds), 6) if preempted is None else None,
            not record.deferred,
        )
        end = RunEnd(record.primitive_task, record.action, context, outcome)
        if record.deferred:
            self._deferred[record.run] = end
        self._note(end)
        latest = self._open.get(self._tokens.begun)
        trial = self._served.pop(record.run, latest)
        if trial is not None:
            known = [run[:3] for run in trial.runs]
            trial.runs.append((end.primitive_task, end.action, context, outcome))
            if trial.met is not None and trial.runs[-1][:3] not in known:
                # Its node was slow to say that it ended.
                self._credit(trial, trial.runs[-1:], late=True)
            if trial.completed:
                self._count_if_stopped(trial)

    # --- the task's verdict on choices --------------------------------------------------------

    def _begin(self, now: float) -> None:
        """Begin a trial if a token has left the runs place, and record those that it ends."""
        number = self._tokens.begun
        if number == self._latest:
            return
        self._latest = number
        for trial in [*self._open.values()]:
            over = not self._tokens.on_its_way(trial.number)
            if trial.met is None and (trial.goals or over):
                self._judge(now, trial, trial.goals > 0 or not self._goals)
            if over:
                # The task could take the next token, so this one is completed.
                trial.completed = True
                self._count_if_stopped(trial)
        self._open[number] = _Trial(number, now, context=self.context)

    def _pass(self, now: float, fired: Fired) -> None:
        """Follow the tokens from the runs place until all of a trial are back, and count goals."""
        number = self._tokens.fired(fired)
        self._begin(now)
        if number not in self._open:
            return
        self._open[number].goals += fired.transition in self._goals
        for back in self._tokens.back:
            trial = self._open.get(back)
            if trial is not None and trial.met is None:
                trial.back = True
                self._judge(now, trial, trial.goals > 0 or not self._goals)

    def _finished(self, now: float, finished: Finished) -> None:
        """Judge the last tokens if the task came to its end, also by `final_error`, or if the goal
        was met before the end. The result of an aborted run is unknown, so it is
        censored; trials that were cut by the loss of another one are not recorded."""
        success, lost = finished.status is Status.SUCCESS, self._tokens.lost(finished)
        for trial in [*self._open.values()]:
            gave_up = trial.number in lost and not self._aborted
            if trial.met is None and (success or trial.goals):
                self._judge(now, trial, trial.goals > 0 or not self._goals)
            elif trial.met is None and gave_up:
                self._judge(nan, trial, False)
            if success or trial.completed or trial.back or trial.goals or gave_up:
                met = trial.back or (bool(trial.goals) and trial.number not in lost)
                self._count(trial, success or trial.completed or met)

    def _count_if_stopped(self, trial: _Trial) -> None:
        """Record a completed trial, unless a run of it that was preempted is still being stopped:
        its cost and its status count, too."""
        stopping = (r for r, served in self._served.items() if served is trial)
        if trial.number in self._open and not any(self._active[r].taken_by for r in stopping):
            self._count(trial, True)

    def _count(self, trial: _Trial, completed: bool) -> None:
        """Record what a trial of the task came to, as campaigns count it."""
        del self._open[trial.number]
        ends = [end for *_, end in trial.runs]
        success = completed and all(end.status in (Status.SUCCESS, None) for end in ends)
        costs = [cost_of(e, self.learning.question(name).measure) for name, _, _, e in trial.runs]
        cost = added(costs)
        runs = tuple(name for name, *_ in trial.runs)
        told = trial.context, success, trial.goals > 0, None if cost != cost else cost
        self._note(TrialEnd(*told, runs))

    def _judge(self, now: float, trial: _Trial, met: bool) -> None:
        """Give the verdict on a trial that ended at `now` (s; nan: it never came to its end)."""
        trial.met, trial.seconds = met, round(max(now - trial.begun, 0.0), 6)
        self._credit(trial, trial.runs)

    def _credit(
        self, trial: _Trial, runs: Sequence[tuple[str, str, str, Observation]], late: bool = False
    ) -> None:
        """Record the verdict on the actions of these runs, if the task is to judge them."""
        if self.learning.credit != TASK:
            return
        measure = {p: self.learning.question(p).measure for p in self.learning.task.primitive_tasks}
        if self._declared is not None:  # in lock step no measured time may influence a choice
            runs = [
                (p, action, c, end if measure[p] == "cpu" else replace(end, cpu_seconds=None))
                for p, action, c, end in runs
            ]
        for verdict in verdicts_of_task(runs, bool(trial.met), trial.seconds, measure.__getitem__):
            self._note(replace(verdict, beside=()) if late else verdict)

    def _cpu(self, record: RunRecorded, result: RunEnded | None) -> float | None:
        """Return the measured CPU seconds; the declared ones in lock step where they are the cost,
        because such a run must be reproducible."""
        if (
            self._declared is not None
            and self.learning.question(record.primitive_task).measure == "cpu"
        ):
            used = {} if result is None else _numbers(result.values)
            return self._declared.get(record.action, 0.0) * used.get(COUNT, 1.0)
        return None if result is None else result.cpu_seconds

    def _replace(self, was: Observation, status: Status) -> None:
        """Let a run of the trial that is not counted yet have the status of its verdict."""
        for trial in self._open.values():
            for i, run in enumerate(trial.runs):
                if run[3] is was:
                    trial.runs[i] = (*run[:3], replace(was, status=status))

    def _corrected(self, corrected: Corrected) -> None:
        end = self._deferred.pop(corrected.run, None)
        if end is not None:
            self._replace(end.outcome, corrected.status)
            what = (end.primitive_task, end.action, end.context, end.outcome)
            self._note(Correction(*what, corrected.status, corrected.cause))


def _numbers(values: Mapping[str, Any]) -> dict[str, float]:
    """Return the numbers of a result that can be costs. A number that is not finite would spoil
    every sum."""
    return {
        name: float(value)
        for name, value in sorted(values.items())
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST
    }
