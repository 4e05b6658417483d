"""Selectors of one primitive task: a rule, one learner for each context, the target reliability,
and the controls of the user.

A selector chooses one of the alternatives and explains the choice with its numbers. It learns only
from `chosen` and `update`, so its state can be derived again from stored choices and
ends of runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import product
from math import prod
from typing import Any

import numpy as np
from msgspec.structs import replace

from petrobot.coordinator.learning.batch import SUMS, Batch, Mask, Response
from petrobot.coordinator.learning.estimate import COUNT, Observation, Tally
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.learning.records import Credit
from petrobot.coordinator.learning.rules import (
    UCB1,
    DiscretisedPursuit,
    Fixed,
    NikolicFu,
    RewardInaction,
    RoundRobin,
    Rule,
    Thompson,
    Tracking,
)
from petrobot.coordinator.learning.statistics import added
from petrobot.coordinator.task import Executed, Status


def eligible(batch: Batch, target: float, before: Mask, level: float = 0.95) -> Mask:
    """Return the actions that meet the target now, shape (rows, n), given those that did `before`.

    An action enters when Wilson's lower bound of its R reaches the target, and leaves when R itself
    falls below it: in between it keeps its state, so the set does not flicker.
    """
    from scipy.special import ndtri  # here, because it takes 0.15 s: each coordinator pays

    z = float(ndtri(0.5 * (1 + level)))
    n = np.maximum(batch.runs, 1e-9)
    share = batch.successes / n
    half = z * np.sqrt(np.maximum(share * (1 - share), 0.0) / n + z * z / (4 * n * n))
    lower = (share + z * z / (2 * n) - half) / (1 + z * z / n)
    out: Mask = (batch.runs > 0) & np.where(before, share >= target, lower >= target)
    return out


RULES: Mapping[str, Callable[[], Rule]] = {
    "nikolic_fu": NikolicFu,
    "nikolic_fu_fast": lambda: NikolicFu(
        "nikolic_fu_fast", k0=0.0, exponent=0.5, mixing=20.0, even=0.2, focus=1.5
    ),
    "tracking": Tracking,
    "reward_inaction": RewardInaction,
    "discretised_pursuit": DiscretisedPursuit,
    "ucb1": UCB1,
    "thompson": Thompson,
    "fixed": Fixed,
    "round_robin": RoundRobin,
}
"""All selectors by the name that users give."""
DEFAULT = "nikolic_fu_fast"


class RuleSelector:
    """Chooses among the alternatives of one primitive task by a rule, and learns from how runs end:
    one learner for each context, all over the same actions.

    `question` gives cost measure, target reliability and rho. `shape`: if the actions are
    combinations, how many actions each primitive task has. `frozen`: learn nothing and choose the
    learned best.
    """

    def __init__(
        self,
        rule: Rule,
        actions: Iterable[str],
        question: Question | None = None,
        shape: tuple[int, ...] = (),
    ) -> None:
        self.rule, self._shape = rule, shape
        self.name = rule.name
        self.actions = tuple(actions)
        self.question = question or Question()
        self.frozen = False
        self.learners: dict[str, Batch] = {}

    def learner(self, context: str) -> Batch:
        """Return the learner of a context; a new one, which is not stored, if nothing was learned
        there yet."""
        return self.learners[context] if context in self.learners else self._fresh(self.actions)

    def _kept(self, context: str) -> Batch:
        """Return the learner of a context, stored so that it can learn."""
        return self.learners.setdefault(context, self.learner(context))

    def _fresh(self, actions: Sequence[str]) -> Batch:
        batch = self.rule.begin(1, len(actions), self.question.rho)
        batch.own["admitted"] = np.zeros((1, len(actions)))
        batch.shape = self._shape if len(actions) == prod(self._shape) else ()
        if self.question.declared:
            batch.declared = np.array([self.question.declared_cost(a) for a in actions])
        return batch

    # --- choosing -----------------------------------------------------------------------------

    def choose(
        self, context: str, alternatives: Sequence[str], rng: np.random.Generator
    ) -> tuple[str, str]:
        """Choose one of the alternatives and say why. Changes nothing. Raises ValueError if none of
        them is known."""
        batch, offered = self.learner(context), self._offered(alternatives)
        if self.frozen:
            action = int(np.argmax(np.where(offered, self._learned(batch), -1.0)[0]))
            why = "frozen, the best learned"
        else:
            action = int(self.rule.choose(batch, offered, rng.random((1, batch.n)))[0])
            why = self.rule.says(batch, offered, action)
        return self.actions[
            action
        ], f"{self.name}: {why}; {self._figures(batch, action)}{_of(context)}"

    def _learned(self, batch: Batch) -> np.ndarray:
        """Return p; for rules that do not learn, 1 for the lowest J."""
        if isinstance(self.rule, Fixed | RoundRobin):
            return np.eye(batch.n)[batch.best()]
        return batch.p

    def _offered(self, alternatives: Sequence[str]) -> Mask:
        offered = np.array([[name in alternatives for name in self.actions]])
        if not offered.any():
            raise ValueError(
                f"none of {', '.join(alternatives)} is a known action; "
                f"known: {', '.join(self.actions)}"
            )
        return offered

    def _figures(self, batch: Batch, action: int) -> str:
        """Describe J of the chosen action and the lowest J, from the sums."""
        if not batch.k[0]:
            return "nothing known yet"
        j, best = batch.objective()[0], int(batch.best()[0])
        runs = batch.runs[0]
        if not np.isfinite(j[action]):
            return f"no run of it yet; lowest J {j[best]:.3f} {self.actions[best]}"
        r, c = batch.reliability()[0, action], batch.mean_cost()[0, action]
        mine = f"J {j[action]:.3f}, R {r:.3f} of {runs[action]:g} runs, C {c:.3g}"
        return mine if best == action else f"{mine}; lowest J {j[best]:.3f} {self.actions[best]}"

    def probabilities(
        self, context: str, alternatives: Sequence[str] | None = None
    ) -> dict[str, float]:
        """Return the probability of each alternative (None: of all) for the next choice in a
        context."""
        batch = self.learner(context)
        offered = self._offered(self.actions if alternatives is None else alternatives)
        if self.frozen:
            best = int(np.argmax(np.where(offered, self._learned(batch), -1.0)[0]))
            return {name: float(i == best) for i, name in enumerate(self.actions)}
        return dict(
            zip(self.actions, self.rule.probabilities(batch, offered)[0].tolist(), strict=True)
        )

    def learned(self, context: str) -> dict[str, float]:
        """Return the learned probabilities p, without exploration."""
        return dict(
            zip(self.actions, self._learned(self.learner(context))[0].tolist(), strict=True)
        )

    def objective(self, context: str) -> dict[str, float]:
        """Return J of each action from the learner's own sums; inf where it was never tried."""
        return dict(zip(self.actions, self.learner(context).objective()[0].tolist(), strict=True))

    # --- learning -----------------------------------------------------------------------------

    def chosen(self, context: str, action: str) -> None:
        """Count a choice, by this selector or by anyone else."""
        if not self.frozen and action in self.actions:
            self._kept(context).choosing(np.array([self.actions.index(action)]))

    def update(self, context: str, action: str, outcome: Observation) -> None:
        """Learn from a run that ended; one that is censored or not judged teaches nothing."""
        if self.frozen or not self.learns_from(action, outcome):
            return
        batch, missing = self._kept(context), _is_missing(outcome)
        trial = Response(
            np.array([self.actions.index(action)]),
            np.array([float(outcome.status is Status.SUCCESS)]),
            np.array([cost_of(outcome, self.question.measure)]),
            np.array([not missing]),
        )
        self.rule.learn(batch, trial, self._eligible(batch))

    def spread(
        self, context: str, action: str, shares: Mapping[str, float], outcome: Observation
    ) -> None:
        """Let a trial count for several actions by their shares (which sum to 1): change the sums
        so that they are right after `update` has counted it for one of them."""
        batch = self._kept(context)
        one, missing = self.actions.index(action), _is_missing(outcome)
        cost = cost_of(outcome, self.question.measure)
        known = not missing and cost == cost
        gains = {
            "runs": float(not missing),
            "successes": float(outcome.status is Status.SUCCESS and not missing),
            "cost": cost if known else 0.0,
            "squares": cost * cost if known else 0.0,
            "costed": float(known),
            "missing": float(missing),
        }
        weight = np.array([shares[name] for name in self.actions])
        weight[one] -= 1.0
        for name, gain in gains.items():
            getattr(batch, name)[0] += weight * gain

    def learns_from(self, action: str, outcome: Observation) -> bool:
        """Return whether a run is a trial: of one of the actions, judged, and neither censored nor
        cancelled before it began."""
        if action not in self.actions or not outcome.judged:
            return False
        return _is_missing(outcome) or (
            outcome.status is not None and outcome.executed is not Executed.NO
        )

    def _eligible(self, batch: Batch) -> Mask | None:
        """Return the actions that meet the target, judged by what was known before this trial."""
        if self.question.target is None:
            return None
        before = batch.own["admitted"] > 0
        now = eligible(batch, self.question.target, before, self.question.level)
        batch.own["admitted"][:] = now
        return now

    def prime(
        self,
        context: str,
        tallies: Mapping[str, Tally],
        prior: Mapping[str, Tally] | None = None,
        trials: float = 0.0,
    ) -> None:
        """Take the sums from estimates, which may contain runs of other machines; rules that fade
        their sums keep their own. `prior`: estimates of another plant, each of which counts as so
        many `trials` at most; its availability is not used, because it is that of other nodes."""
        batch = self.learner(context)
        if self.frozen or (isinstance(self.rule, Tracking) and (not prior or batch.k[0] > 0)):
            return
        batch = self._kept(context)
        for i, action in enumerate(self.actions):
            tally = tallies.get(action, Tally())
            before = (prior or {}).get(action, Tally())
            missing = sum(tally.not_executed.values())
            batch.runs[0, i] = batch.successes[0, i] = 0.0
            batch.cost[0, i] = batch.costed[0, i] = batch.squares[0, i] = 0.0
            for seen, share in ((tally, 1.0), (before, min(1.0, trials / max(1, before.judged)))):
                cost = seen.cost(self.question.measure)
                batch.runs[0, i] += share * seen.judged
                batch.successes[0, i] += share * seen.successes
                batch.cost[0, i] += share * cost.total
                batch.costed[0, i] += share * cost.n
                batch.squares[0, i] += share * (cost.m2 + cost.n * cost.mean**2)
            batch.missing[0, i] = missing
            batch.tries[0, i] = max(batch.tries[0, i], batch.runs[0, i] + missing)

    # --- by hand ------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget what was learned."""
        self.learners.clear()

    def state(self) -> dict[str, Any]:
        """Return everything that was learned, as plain data."""
        return {
            "selector": self.name,
            "actions": list(self.actions),
            "frozen": self.frozen,
            "cost": self.question.measure,
            "learners": {
                context: batch.to_plain() for context, batch in sorted(self.learners.items())
            },
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Load a `state()`. Actions that are new are unknown at first, those that no longer exist
        are dropped. Raises ValueError if the state is of another selector or does not fit."""
        if state["selector"] != self.name:
            raise ValueError(
                f"expected a state of selector {self.name}, got one of {state['selector']}"
            )
        self.frozen = bool(state["frozen"])
        self.learners.clear()
        for context, data in state["learners"].items():
            if tuple(state["actions"]) == self.actions:
                self._kept(context).take_plain(data)
            else:
                self._take_moved(context, list(state["actions"]), data)

    def _take_moved(self, context: str, actions: list[str], data: Mapping[str, Any]) -> None:
        """Load a state over other actions: sums stay with their actions; a new action gets an equal
        share of p, and the other shares are scaled."""
        batch, old = self._kept(context), self._fresh(actions)
        old.take_plain(data)
        pairs = [(i, actions.index(a)) for i, a in enumerate(self.actions) if a in actions]
        kept = added(old.p[0, j] for _, j in pairs)
        for i, j in pairs:
            for name in SUMS:
                getattr(batch, name)[0, i] = getattr(old, name)[0, j]
            if kept > 0:
                batch.p[0, i] = old.p[0, j] / kept * len(pairs) / batch.n
        batch.p /= batch.p.sum()
        # k stays 0: the gain starts again, so that a new action can still win.


def _is_missing(outcome: Observation) -> bool:
    """Return whether a run never began although nothing cancelled it."""
    return outcome.executed is Executed.NO and outcome.preempted_by is None


def verdicts_of_task(
    runs: Iterable[tuple[str, str, str, Observation]],
    met: bool,
    seconds: float,
    measure: Callable[[str], str],
) -> Iterator[Credit]:
    """Return the task's verdict on each action that ran for a token, once.

    `runs`: primitive task, action, context and end of each run; `met`: whether the goal was met;
    `seconds`: duration of the trial, nan if it never came to its end; `measure`: the cost measure
    of a primitive task. The cost is the trial's: its duration, or the sum of all its runs by the
    measure. A run that its node never began is judged by that, as always; one that was cancelled
    before it began could not matter. The first verdict names the first action of each primitive
    task that ran for the token.
    """
    runs, seen = list(runs), set()
    began = [run for run in runs if run[3].executed is not Executed.NO or _is_missing(run[3])]
    together = tuple({run[0]: run[1] for run in reversed(began)}.items())
    for primitive_task, action, context, outcome in runs:
        missing, key = _is_missing(outcome), (primitive_task, action, context)
        if key in seen or (outcome.executed is Executed.NO and not missing):
            continue
        beside, together = together, ()
        if missing:
            yield Credit(*key, outcome, beside)
            continue
        seen.add(key)
        asked = measure(primitive_task)
        costs = [cost_of(end, asked) for *_, end in runs if end.executed is not Executed.NO]
        known = [cost for cost in costs if cost == cost]  # nan: not measured
        whole = added(known) if known else float("nan")
        status = Status.SUCCESS if met else Status.FAILURE
        yield Credit(
            *key,
            Observation(
                status,
                seconds,
                cpu_seconds=whole if asked == "cpu" and known else None,
                values={} if asked in ("wall", "cpu") else {asked.removeprefix("value:"): whole},
            ),
            beside,
        )


def cost_of(outcome: Observation, measure: str) -> float:
    """Return the cost of a run by a measure; nan if it was not measured."""
    if measure == "wall":
        return outcome.seconds
    if measure == COUNT:
        return float(outcome.values.get(COUNT, 1.0))
    if measure == "cpu":
        return float("nan") if outcome.cpu_seconds is None else outcome.cpu_seconds
    return float(outcome.values.get(measure.removeprefix("value:"), float("nan")))


ACTION, TASK = CREDITS = ("action", "task")
"""What judges a choice: the status of the run itself, or whether the task's goal was met."""


def credited(name: str, credit: str) -> str:
    """Return the name under which the state of a selector is kept: what it learned by one credit is
    nothing that it would have learned by the other. Raises ValueError for an unknown credit."""
    if credit not in CREDITS:
        raise ValueError(f"credit: expected {' or '.join(CREDITS)}, got {credit!r}")
    return name if credit == ACTION else f"{name} by task"


def make(
    name: str, actions: Iterable[str], question: Question | None = None, credit: str = ACTION
) -> RuleSelector:
    """Create a selector by its name. Raises ValueError for an unknown one."""
    if name not in RULES:
        raise ValueError(f"unknown selector {name!r}; choose one of {', '.join(RULES)}")
    made = RuleSelector(RULES[name](), actions, question)
    made.name = credited(name, credit)
    return made


def _of(context: str) -> str:
    return f" ({context})" if context else ""


# --- combinations ---
# Choices judged by the task: one learner over all combinations of actions.
#
# If each primitive task learns by itself, the credit of an action depends on what the others
# choose meanwhile. They then converge to choices that no single change improves, which may be far
# from the best combination (a Nash equilibrium of a common-interest game). So with `--credit task`
# one rule learns which *combination* of actions is best. The choices of one token are drawn one
# after the other, each among the combinations that contain the choices before it, so together they
# follow the rule's probabilities over combinations.

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
    if "trials" in rule.__struct_fields__:
        return replace(rule, trials=TRIALS)
    return rule
