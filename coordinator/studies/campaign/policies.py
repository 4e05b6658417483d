"""Policies that choose the actions in a campaign: for each trial, the probabilities of the actions
of each primitive task.

A policy chooses before a batch and receives all rows of the batch after it, in the order of the
table. So choices depend neither on the number of workers nor on their speed.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from petrobot.coordinator.learning.learning import Learning
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.learning.records import Choice, RunEnd
from petrobot.coordinator.learning.selectors import ACTION, RULES, TASK, verdicts_of_task
from petrobot.coordinator.studies.campaign.block import Weights
from petrobot.coordinator.studies.campaign.observed import context_of, observation, regime_of
from petrobot.coordinator.studies.campaign.plan import (
    Block,
    CampaignError,
    CampaignPlan,
    read_manifest,
)
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.task import Task
from petrobot.services.comm.location_file import FIRST_PHYSICS, Directory, same_physics


class ChoicePolicy(ABC):
    """Chooses before a batch, and may learn after it."""

    learns = False
    """Whether `update` changes later choices."""

    @abstractmethod
    def weights(self, block: Block) -> list[Weights]:
        """Return, for each trial of a block, the probabilities of the actions of each primitive
        task."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Return what the policy knows, as plain data for the result."""

    def update(self, rows: Sequence[TrialRow]) -> None:  # noqa: B027 - most learn nothing
        """Learn from the rows of a whole batch, in the order of the table."""

    def selectors(self) -> dict[str, dict[str, Any]]:
        """Return the states of selectors for the estimates file, by primitive task."""
        return {}


def offered(task: Task, directory: Directory) -> dict[str, tuple[str, ...]]:
    """Return, by primitive task, its alternatives that some node offers; all of them if no node
    offers any."""
    return {
        p.name: tuple(a for a in p.alternatives if a in directory.actions) or p.alternatives
        for p in task.primitive_tasks.values()
    }


class FixedActions(ChoicePolicy):
    """Always the actions that the user chose; the first alternative for every other primitive task.

    `by_regime`: further choices by regime (the result of a learning campaign).
    """

    def __init__(
        self,
        alternatives: Mapping[str, Sequence[str]],
        chosen: Mapping[str, str],
        by_regime: Mapping[str, Mapping[str, str]] | None = None,
    ) -> None:
        self._weights: Weights = {
            t: {chosen.get(t, actions[0]): 1.0} for t, actions in alternatives.items()
        }
        self._by_regime = {
            regime: {**self._weights, **{t: {a: 1.0} for t, a in more.items() if t not in chosen}}
            for regime, more in (by_regime or {}).items()
        }

    def weights(self, block: Block) -> list[Weights]:
        """Return the same choice for every trial of a regime."""
        return [self._by_regime.get(block.regime, self._weights)] * block.count

    def state(self) -> dict[str, Any]:
        """Return the chosen actions."""
        return {task: next(iter(actions)) for task, actions in self._weights.items()}


class AllCombinations(ChoicePolicy):
    """All combinations of alternatives in turn, from trial to trial of a regime. Actions that the
    user fixed do not change."""

    def __init__(
        self, alternatives: Mapping[str, Sequence[str]], chosen: Mapping[str, str]
    ) -> None:
        self._alternatives = {
            t: ([chosen[t]] if t in chosen else list(a)) for t, a in alternatives.items()
        }

    def combination(self, index: int) -> dict[str, str]:
        """Return combination number `index`; after the last combination, it starts again. The first
        primitive task changes with each trial."""
        out = {}
        for task, actions in self._alternatives.items():
            index, which = divmod(index, len(actions))
            out[task] = actions[which]
        return out

    def weights(self, block: Block) -> list[Weights]:
        """Return one combination for each trial."""
        combinations = [self.combination(block.regime_first + k) for k in range(block.count)]
        return [{task: {action: 1.0} for task, action in c.items()} for c in combinations]

    def state(self) -> dict[str, Any]:
        """Return the alternatives."""
        return dict(self._alternatives)


class RandomActions(AllCombinations):
    """Every alternative with the same probability, drawn independently at each choice. Estimates
    and forecasts are best trained on this."""

    def weights(self, block: Block) -> list[Weights]:
        """Return equal probabilities for every trial."""
        even: Weights = {
            task: dict.fromkeys(actions, 1.0 / len(actions))
            for task, actions in self._alternatives.items()
        }
        return [even] * block.count


class LearnedActions(ChoicePolicy):
    """One learner for each primitive task with alternatives and each regime (docs/learning.md).

    There is one choice per trial and primitive task: a run that is repeated within a trial uses the
    same action again.
    """

    learns = True

    def __init__(
        self,
        task: Task,
        selector: str,
        alternatives: Mapping[str, Sequence[str]],
        chosen: Mapping[str, str],
        question: Question,
        credit: str = ACTION,
    ) -> None:
        self._task, self._alternatives, self._chosen = task, alternatives, chosen
        self._learning = Learning(task, selector, question, credit=credit)
        self._before: dict[str, Any] | None = None
        """States of the selectors before the batch that is being handed out."""
        self._fixed: Weights = {
            t: {chosen.get(t, actions[0]): 1.0} for t, actions in alternatives.items()
        }

    def weights(self, block: Block) -> list[Weights]:
        """Choose for each trial. Until the results of the batch are known, each choice already
        counts as a trial for the following choices of the batch."""
        if self._before is None:
            self._before = self._learning.state()
        return [{**self._fixed, **self._choices(block, k)} for k in range(block.count)]

    def _choices(self, block: Block, k: int) -> dict[str, dict[str, float]]:
        out, context = {}, context_of(block.regime)
        for name in self._learning.selectors:
            if name in self._chosen:
                self._learning.apply(Choice(name, self._chosen[name], context))
                continue
            random = np.random.default_rng([block.seed, k, *name.encode()])
            action, _ = self._learning.choose(name, context, self._alternatives[name], random)
            self._learning.apply(Choice(name, action, context))
            out[name] = {action: 1.0}
        return out

    def update(self, rows: Sequence[TrialRow]) -> None:
        """Replace the assumed choices by what was really run, in the order of the table."""
        for selector in self._learning.selectors.values():
            selector.reset()
        self._learning.restore(self._before or {})
        self._before = None
        for row in rows:
            context, ends = context_of(row.regime), []
            for run in row.runs:
                name = self._task.primitive_task_of(run.place).name
                self._learning.apply(Choice(name, run.action, context))
                ends.append((name, run.action, context, observation(self._task, run)))
                self._learning.apply(RunEnd(*ends[-1]))
            if row.trial is not None and self._learning.credit == TASK:
                trial = row.trial
                met = trial.goals > 0 if self._task.goal_transitions else trial.completed
                took = float("nan") if trial.time is None else trial.time
                for verdict in verdicts_of_task(ends, met, took, self._measure):
                    self._learning.apply(verdict)

    def _measure(self, primitive_task: str) -> str:
        return self._learning.question(primitive_task).measure

    def state(self, regimes: Iterable[str] = ()) -> dict[str, Any]:
        """Return, by regime and primitive task: learned probabilities, J from the learner's sums,
        and the best action; of `regimes` also before their first trial."""
        met = {c for s in self._learning.selectors.values() for c in s.learners}
        contexts = sorted(met | set(map(context_of, regimes)))
        return {
            regime_of(c): {n: self._of(n, c) for n in self._learning.selectors} for c in contexts
        }

    def selectors(self) -> dict[str, dict[str, Any]]:
        """Return the states of the learners; `petrobot run --learn` continues from them."""
        return self._learning.state()

    def _of(self, name: str, context: str) -> dict[str, Any]:
        selector = self._learning.selectors[name]
        p = selector.learned(context)
        j = {
            a: (round(v, 6) if np.isfinite(v) else None)
            for a, v in selector.objective(context).items()
        }
        return {
            "best": self._learning.best(name, context),
            "p": {a: round(v, 6) for a, v in p.items()},
            "J": j,
        }


PLAIN: Mapping[str, type[FixedActions] | type[AllCombinations]] = {
    "fixed": FixedActions,
    "round_robin": AllCombinations,
    "random": RandomActions,
}


def learns(selector: str) -> bool:
    """Return whether a selector learns, so that a campaign runs in batches."""
    return selector not in PLAIN


def check_chosen(task: Task, directory: Directory, chosen: Mapping[str, str]) -> None:
    """Raise CampaignError for an unknown primitive task or action, or an action that no node
    offers."""
    for name, action in chosen.items():
        primitive = task.primitive_tasks.get(name)
        if primitive is None or action not in primitive.alternatives:
            known = ", ".join(primitive.alternatives if primitive else task.primitive_tasks)
            raise CampaignError(
                f"--choose {name}={action}: {task.name} does not know it; choose one of {known}"
            )
        if action not in directory.actions:
            raise CampaignError(
                f"--choose {name}={action}: {directory.source} gives {action} to no node"
            )


def policy_of(plan: CampaignPlan, task: Task, directory: Directory) -> ChoicePolicy:
    """Create the policy that a plan names. Raises CampaignError."""
    check_chosen(task, directory, plan.chosen)
    alternatives = offered(task, directory)
    if plan.selector == "fixed":
        by_regime = plan.options.get("by_regime", {})
        for more in by_regime.values():
            check_chosen(task, directory, more)
        return FixedActions(alternatives, plan.chosen, by_regime)
    if plan.selector in PLAIN:
        return PLAIN[plan.selector](alternatives, plan.chosen)
    if plan.selector not in RULES:
        known = ", ".join(dict.fromkeys([*PLAIN, *RULES]))
        raise CampaignError(f"--selector {plan.selector}: unknown; choose one of {known}")
    question = Question(target=plan.options.get("target"), rho=plan.options.get("rho"))
    credit = plan.options.get("credit", ACTION)
    return LearnedActions(task, plan.selector, alternatives, plan.chosen, question, credit)


def learned_choices(
    folder: Path, task: str, *, mock: bool, physics: str
) -> dict[str, dict[str, str]]:
    """Return, by regime, the best action of each primitive task in the result of a learning
    campaign. Raises CampaignError, also if it learned in another task, or with other actions than
    the new runs have: scripted ones (`mock`), or those of a laboratory with another physics."""
    path = folder / "result.json"
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except OSError as fault:
        remedy = (
            "give the folder of a finished campaign, as `petrobot campaign --out FOLDER` leaves it"
        )
        raise CampaignError(
            f"{path}: not the result of a finished campaign: {fault.strerror or fault}; {remedy}"
        ) from fault
    except ValueError as fault:
        raise CampaignError(
            f"{path}: not the result of a finished campaign: not JSON ({fault})"
        ) from fault
    try:
        if result["task"] != task:
            raise CampaignError(f"{folder}: it learned in the task {result['task']}, not in {task}")
        if result["selector"] in PLAIN:
            raise CampaignError(
                f"{folder}: the selector {result['selector']} has learned nothing; give one "
                "that learns"
            )
        found = {
            regime: {t: known["best"] for t, known in tasks.items()}
            for regime, tasks in result["policy"].items()
        }
    except (KeyError, TypeError, AttributeError) as fault:
        raise CampaignError(
            f"{path}: not the result of a campaign: task, selector or policy is missing"
        ) from fault
    plan = read_manifest(folder)
    if bool(plan.mock) is not mock or not same_physics(plan.physics, physics):
        learned, new = (
            "scripted actions (--mock)"
            if scripted
            else f"actions in the physics {physics or FIRST_PHYSICS!r}"
            for scripted, physics in ((bool(plan.mock), plan.physics), (mock, physics))
        )
        raise CampaignError(
            f"{folder}: it learned with {learned}, the new runs have {new}; learn with those, or "
            "name the actions by --choose"
        )
    return found
