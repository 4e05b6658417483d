"""Everything that a task has learned: tallies by action and context, waits of transitions, and one
selector for each primitive task.

The state changes only by records (`Choice`, `RunEnd`, `Correction`, `Passage`): the same records in
the same order yield the same state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.coordinator.learning.estimate import (
    Firings,
    FiringsKey,
    Tally,
    TallyKey,
    TrialsKey,
    TrialSums,
)
from petrobot.coordinator.learning.objective import Comparison, Question, compare
from petrobot.coordinator.learning.records import (
    Choice,
    Correction,
    Credit,
    Passage,
    Record,
    RunEnd,
    TrialEnd,
    WaitEnd,
)
from petrobot.coordinator.learning.selectors import (
    ACTION,
    DEFAULT,
    TASK,
    CombinationSelector,
    RuleSelector,
    make,
)
from petrobot.coordinator.learning.statistics import merged
from petrobot.coordinator.task import Task

NOTHING = Tally()


def corrected(tally: Tally, record: Correction) -> Tally:
    """Return the tally after a verdict on one of its runs. Raises KeyError if it holds no such
    run."""
    return tally.correcting(record.was, record.status, record.cause)


class Estimates(Struct):
    """Tallies, firings and sums of trials from one source: the file of a machine, or what one
    session has gained."""

    tallies: dict[TallyKey, Tally] = field(default_factory=dict)
    flows: dict[FiringsKey, Firings] = field(default_factory=dict)
    trials: dict[TrialsKey, TrialSums] = field(default_factory=dict)

    def merged(self, other: Estimates) -> Estimates:
        """Return the estimates of both sets of runs."""
        return Estimates(
            merged(self.tallies, other.tallies),
            merged(self.flows, other.flows),
            merged(self.trials, other.trials),
        )

    def trials_of(self, task: str, context: str | None = None) -> dict[str, TrialSums]:
        """Return the sums of a task's trials by context (only the given context, if any)."""
        known = sorted(self.trials.items())
        return {k.context: t for k, t in known if k.task == task and context in (None, k.context)}

    def tally(self, key: TallyKey) -> Tally:
        """Return what is known of an action in a context; an empty tally if nothing is."""
        return self.tallies.get(key, NOTHING)

    def of(self, primitive_task: str, context: str | None = None) -> dict[str, dict[str, Tally]]:
        """Return the tallies of a primitive task by action, then by context (only the given
        context, if any)."""
        out: dict[str, dict[str, Tally]] = {}
        for key, tally in sorted(self.tallies.items()):
            if key.primitive_task == primitive_task and context in (None, key.context):
                out.setdefault(key.action, {})[key.context] = tally
        return out

    def contexts(self, primitive_task: str) -> tuple[str, ...]:
        """Return the contexts in which actions of a primitive task were observed."""
        return tuple(
            sorted({k.context for k in self.tallies if k.primitive_task == primitive_task})
        )

    def apply(self, record: Record, task: str, salt: str) -> None:
        """Count one record."""
        if isinstance(record, RunEnd):
            key = TallyKey(record.primitive_task, record.action, record.context)
            self.tallies[key] = self.tally(key).adding(record.outcome, salt)
        elif isinstance(record, Correction):
            key = TallyKey(record.primitive_task, record.action, record.context)
            self.tallies[key] = corrected(self.tally(key), record)
        elif isinstance(record, Passage):
            where = FiringsKey(task, record.transition, record.context)
            flow = self.flows.get(where, Firings())
            if record.waited is None or record.end is WaitEnd.FIRED:
                self.flows[where] = flow.adding(record.waited)
            else:
                self.flows[where] = flow.unserved(record.waited, record.end is WaitEnd.CAME)
        elif isinstance(record, TrialEnd):
            of = TrialsKey(task, record.context)
            told = record.success, record.goal, record.cost, record.runs
            self.trials[of] = self.trials.get(of, TrialSums()).adding(*told)


class Learning:
    """The learning state of one task. `known`: estimates from before; `gained`: those of this
    session alone.

    `credit`: what judges a choice for the selectors, the end of its own run ("action") or the
    task's goal ("task"). Estimates count the ends of runs in both cases.
    """

    def __init__(
        self,
        task: Task,
        selector: str = DEFAULT,
        question: Question | None = None,
        known: Estimates | None = None,
        salt: str = "",
        credit: str = ACTION,
    ) -> None:
        self.task, self.salt, self.credit = task, salt, credit
        self.known, self.gained = known or Estimates(), Estimates()
        self.given = question
        self.selectors: dict[str, RuleSelector] = {}
        for p in task.primitive_tasks.values():
            if len(p.alternatives) > 1:
                question_of = self.question(p.name)
                self.selectors[p.name] = make(selector, p.alternatives, question_of, credit)
        self.joint: CombinationSelector | None = None
        """Chooses for all primitive tasks together, where the task judges; the selectors then hold
        what of it concerns each of them."""
        choices = {name: task.primitive_tasks[name].alternatives for name in self.selectors}
        if credit == TASK and CombinationSelector.fits(choices):
            self.joint = CombinationSelector(selector, choices, question or Question(), credit)

    def question(self, primitive_task: str) -> Question:
        """Return measure, target and rho for a primitive task: as given, with the cost measure that
        the task file declares."""
        given, primitive = self.given or Question(), self.task.primitive_tasks[primitive_task]
        declared = tuple(primitive.costs.items())
        return Question(primitive.cost, given.target, given.rho, given.level, declared)

    # --- choosing and learning ----------------------------------------------------------------

    def choose(
        self,
        primitive_task: str,
        context: str,
        alternatives: Sequence[str],
        rng: np.random.Generator,
    ) -> tuple[str, str]:
        """Choose one of the alternatives and say why. Changes nothing."""
        if self.joint is not None:
            return self.joint.choose(primitive_task, context, alternatives, rng)
        return self.selectors[primitive_task].choose(context, alternatives, rng)

    def apply(self, record: Record) -> None:
        """Apply a record to the estimates and the selectors."""
        self.gained.apply(record, self.task.name, self.salt)
        self._select(record)

    def _select(self, record: Record) -> None:
        if isinstance(record, Passage | TrialEnd):
            return
        joint = self.joint
        if joint is not None and isinstance(record, Credit) and record.beside:
            joint.update(record.context, dict(record.beside), record.outcome)
        selector = self.selectors.get(record.primitive_task)
        if selector is None:
            return
        if isinstance(record, Choice):
            selector.chosen(record.context, record.action)
            if joint is not None:
                joint.chosen(record.primitive_task, record.context, record.action)
        elif isinstance(record, Credit) is not (self.credit == TASK):
            return
        else:  # of a run that ended provisionally, a selector learns by its verdict
            selector.update(record.context, record.action, record.outcome)
            if joint is not None and record.context in selector.learners and not selector.frozen:
                p = joint.marginal(record.primitive_task, record.context)
                selector.learners[record.context].p[0] = p / p.sum()

    # --- reading ------------------------------------------------------------------------------

    def best(self, primitive_task: str, context: str) -> str:
        """Return the action that was learned to be best, together with those of the others if the
        task judges."""
        if self.joint is not None:
            return self.joint.best(context)[primitive_task]
        p = self.selectors[primitive_task].learned(context)
        return max(p, key=lambda action: p[action])

    def compared(self, primitive_task: str, context: str) -> Comparison:
        """Compare the alternatives of a primitive task by all their runs in one context."""
        found = {}
        for action in self.task.primitive_tasks[primitive_task].alternatives:
            key = TallyKey(primitive_task, action, context)
            found[action] = {context: self.known.tally(key).merged(self.gained.tally(key))}
        return compare(found, replace(self.question(primitive_task), target=None))

    @property
    def estimates(self) -> Estimates:
        """Everything that is known, including the runs of this session."""
        return self.known.merged(self.gained)

    def asked(self) -> dict[str, Question]:
        """Return by what the actions of each primitive task are judged over scenarios: with the
        given target, otherwise the declared one."""
        found = {}
        for name, primitive in self.task.primitive_tasks.items():
            question = self.question(name)
            declared = primitive.target_reliability if question.target is None else question.target
            found[name] = replace(question, target=declared)
        return found

    def uncosted(self) -> list[tuple[str, str, str]]:
        """Return (primitive task, action, measure) for each action that ran in this session but
        never reported a cost by that measure."""
        found = []
        for name in self.task.primitive_tasks:
            measure = self.question(name).measure
            for action, by_context in self.gained.of(name).items():
                whole = reduce(Tally.merged, by_context.values(), NOTHING)
                if whole.runs and not whole.cost(measure).n:
                    found.append((name, action, measure))
        return found

    # --- state --------------------------------------------------------------------------------

    def prime(self, prior: Estimates | None, trials: float) -> None:
        """Let the selectors take their sums from the known estimates, which may contain runs of
        other machines, and from those of another plant as from so many trials of each action. Not
        those that the task judges: estimates hold no verdicts of the task."""
        if self.credit == TASK:
            return
        other = prior or Estimates()
        for name, selector in self.selectors.items():
            for context in sorted({*self.known.contexts(name), *other.contexts(name)}):
                own, before = (
                    {a: t[context] for a, t in of.of(name, context).items()}
                    for of in (self.known, other)
                )
                selector.prime(context, own, before, trials)

    def state(self) -> dict[str, Any]:
        """Return the state of each selector by primitive task, as plain data."""
        found = {name: selector.state() for name, selector in self.selectors.items()}
        return found if self.joint is None else self.joint.into(found)

    def restore(self, states: Mapping[str, Mapping[str, Any]]) -> None:
        """Load states of the same kind of selector. Raises ValueError naming the primitive task
        whose state does not fit."""
        for name, state in states.items():
            if name not in self.selectors:
                continue
            try:
                self.selectors[name].restore(state)
            except (ValueError, KeyError, TypeError) as fault:
                raise ValueError(f"{name}: {fault}") from fault
        if self.joint is not None:
            try:
                self.joint.restore(states)
            except (ValueError, KeyError, TypeError) as fault:
                raise ValueError(f"{' + '.join(self.joint.tasks)}: {fault}") from fault

    def freeze(self) -> None:
        """Stop learning. A frozen selector chooses the action that it has learned to be best.
        Estimates still count."""
        for selector in self.selectors.values():
            selector.frozen = True
        if self.joint is not None:
            self.joint.selector.frozen = True
