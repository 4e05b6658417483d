"""Choices judged by the task: one learner over all combinations of actions.

If each primitive task learns by itself, the credit of an action depends on what the others choose
meanwhile. They then converge to choices that no single change improves, which may be far from the
best combination (a Nash equilibrium of a common-interest game). So with `--credit task` one rule
learns which *combination* of actions is best. The choices of one token are drawn one after the
other, each among the combinations that contain the choices before it, so together they follow the
rule's probabilities over combinations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from itertools import product
from math import prod
from typing import Any

import numpy as np

from petrobot.coordinator.learning.estimate import Observation
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.learning.rules import Rule, Tracking
from petrobot.coordinator.learning.selectors import RULES, RuleSelector, credited

MOST = 256
"""Largest number of combinations for one learner; if there are more, each primitive task learns by
itself."""
TRIALS = 2
"""First trials of each combination, for rules that try everything a few times first. Single actions
get more first trials: there are many combinations, and the additive prior estimates the untried
ones."""


TOGETHER = "together"
"""Key of this learner's state in the state of the first primitive task's selector."""


class CombinationSelector:
    """Chooses the actions of several primitive tasks together.

    `alternatives`: the actions of each primitive task, in the order of the task file. `rho` of the
    question is 0 unless given: a trial that misses the goal ends earlier, so its shorter time would
    count in its favour.
    """

    def __init__(
        self, name: str, alternatives: Mapping[str, Sequence[str]], question: Question, credit: str
    ) -> None:
        self.tasks = tuple(alternatives)
        self.combinations = tuple(product(*alternatives.values()))
        shape = tuple(len(actions) for actions in alternatives.values())
        rho = 0.0 if question.rho is None else question.rho
        made = RuleSelector(
            _shorter(RULES[name]()),
            ("+".join(one) for one in self.combinations),
            replace(question, measure="wall", rho=rho),
            shape,
        )
        made.name = credited(name, credit)
        self.selector = made
        self._open: dict[str, dict[str, str]] = {}
        """By context: the choices made so far for the present token."""

    @staticmethod
    def fits(alternatives: Mapping[str, Sequence[str]]) -> bool:
        """Return whether there are several choices, and at most MOST combinations of them."""
        return len(alternatives) > 1 and prod(map(len, alternatives.values())) <= MOST

    def choose(
        self, task: str, context: str, alternatives: Sequence[str], rng: np.random.Generator
    ) -> tuple[str, str]:
        """Choose the action of one primitive task and say why. Changes nothing. Raises ValueError
        if none of the alternatives is known."""
        before = {t: a for t, a in self._open.get(context, {}).items() if t != task}
        if task in self._open.get(context, {}):
            before = {}  # a second choice of the same primitive task: the next token
        at = self.tasks.index(task)
        offered = self._with(before, at, alternatives) or self._with({}, at, alternatives)
        chosen, why = self.selector.choose(context, [self._name(i) for i in offered], rng)
        return self.combinations[self.selector.actions.index(chosen)][at], f"{why}: {chosen}"

    def _with(
        self, chosen: Mapping[str, str], at: int = 0, among: Sequence[str] | None = None
    ) -> list[int]:
        """Return the combinations that contain these choices, and one of the actions `among` of
        this primitive task."""
        fixed = [(self.tasks.index(t), a) for t, a in chosen.items()]
        return [
            i
            for i, one in enumerate(self.combinations)
            if all(one[j] == a for j, a in fixed) and (among is None or one[at] in among)
        ]

    def _name(self, index: int) -> str:
        return self.selector.actions[index]

    def chosen(self, task: str, context: str, action: str) -> None:
        """Record a choice. A second one of the same primitive task belongs to the next token."""
        known = self._open.setdefault(context, {})
        if task in known:
            known.clear()
        known[task] = action
        if len(known) == len(self.tasks):
            for i in self._with(known):
                self.selector.chosen(context, self._name(i))

    def update(self, context: str, actions: Mapping[str, str], outcome: Observation) -> None:
        """Learn from the verdict on a token, with the actions that ran for it.

        If it ended before an action of every primitive task was chosen, the trial counts for all
        combinations that contain these actions, each with the probability with which it would have
        been chosen.
        """
        self._open.pop(context, None)
        known = self._with({t: a for t, a in actions.items() if t in self.tasks})
        names = [self._name(i) for i in known]
        if not known or self.selector.frozen or not self.selector.learns_from(names[0], outcome):
            return
        if len(known) == 1:
            self.selector.update(context, names[0], outcome)
            return
        shares = self.selector.probabilities(context, names)
        most = max(names, key=lambda name: shares[name])
        self.selector.chosen(context, most)
        self.selector.spread(context, most, shares, outcome)
        self.selector.update(context, most, outcome)

    def marginal(self, task: str, context: str) -> np.ndarray:
        """Return the learned probability of each action of a primitive task."""
        p, at = self.selector.learned(context), self.tasks.index(task)
        out: dict[str, float] = {}
        for one, share in zip(self.combinations, p.values(), strict=True):
            out[one[at]] = out.get(one[at], 0.0) + share
        return np.array(list(out.values()))

    def best(self, context: str) -> dict[str, str]:
        """Return the actions of the combination that was learned to be best."""
        p = list(self.selector.learned(context).values())
        return dict(zip(self.tasks, self.combinations[p.index(max(p))], strict=True))

    def reset(self) -> None:
        """Forget everything."""
        self._open.clear()
        self.selector.reset()

    def into(self, states: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        """Add this learner's state to those of the primitive tasks' selectors: the first has it."""
        first = self.tasks[0]
        return {**states, first: {**states[first], TOGETHER: self.selector.state()}}

    def restore(self, states: Mapping[str, Mapping[str, Any]]) -> None:
        """Load what `into` added. Nothing is known if one of the primitive tasks was reset. Raises
        ValueError if it does not fit."""
        self.reset()
        first = states.get(self.tasks[0], {})
        if TOGETHER in first and all(name in states for name in self.tasks):
            self.selector.restore(first[TOGETHER])
            self.selector.frozen = bool(first["frozen"])


def _shorter(rule: Rule) -> Rule:
    """Return the rule with fewer first trials. After a change of the world, `Tracking` needs none,
    as it tries the neighbours of what was best, and moves faster, as it has fewer trials of each
    combination."""
    if isinstance(rule, Tracking):
        return replace(rule, trials=0, gain_floor=0.1)
    if any(f.name == "trials" for f in fields(rule)):  # type: ignore[arg-type]
        return replace(rule, trials=TRIALS)  # type: ignore[type-var]
    return rule
