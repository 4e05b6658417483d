"""Choices that the task judges together: random tables of rewards in which the best action of one
primitive task depends on those of the others."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from petrobot.coordinator.learning.combinations import MOST, CombinationSelector
from petrobot.coordinator.learning.estimate import Observation
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.learning.selectors import RuleSelector, make
from petrobot.coordinator.task import Executed, Status

pytestmark = pytest.mark.once

Table = NDArray[np.float64]
"""Probability of the goal of each combination."""


def interactive(shape: tuple[int, ...], seed: int) -> Table:
    """Logits with an effect of each action and a stronger one of each combination."""
    rng = np.random.default_rng([seed, *shape])
    z: Table = rng.normal(-0.5, 1.5, shape)
    for axis, n in enumerate(shape):
        z = z + rng.normal(0.0, 0.5, [n if i == axis else 1 for i in range(len(shape))])
    return 1.0 / (1.0 + np.exp(-z))


def names(shape: tuple[int, ...]) -> dict[str, list[str]]:
    return {f"t{i}": [f"a{i}{j}" for j in range(n)] for i, n in enumerate(shape)}


def ended(met: bool) -> Observation:
    """A trial that meets the goal takes longer than one that misses it."""
    return Observation(Status.SUCCESS if met else Status.FAILURE, 5.0 if met else 3.0)


def together(table: Table, trials: int, rule: str = "nikolic_fu_fast") -> float:
    """Learn over combinations; return by how much the learned one is below the best."""
    rng, tasks = np.random.default_rng(1), names(table.shape)
    selector = CombinationSelector(rule, tasks, Question(), "task")
    for _ in range(trials):
        actions: dict[str, str] = {}
        for task, alternatives in tasks.items():
            actions[task], _ = selector.choose(task, "", alternatives, rng)
            selector.chosen(task, "", actions[task])
        selector.update("", actions, ended(rng.random() < table[place(tasks, actions)]))
    return float(table.max() - table[place(tasks, selector.best(""))])


def apart(table: Table, trials: int) -> float:
    """Let each primitive task learn by itself from the same rewards."""
    rng, tasks = np.random.default_rng(1), names(table.shape)
    question = Question(rho=0.0)
    alone = {t: make("nikolic_fu_fast", a, question) for t, a in tasks.items()}
    for _ in range(trials):
        actions = {t: s.choose("", tasks[t], rng)[0] for t, s in alone.items()}
        end = ended(rng.random() < table[place(tasks, actions)])
        for task, action in actions.items():
            alone[task].chosen("", action)
            alone[task].update("", action, end)
    return float(table.max() - table[place(tasks, {t: likeliest(s) for t, s in alone.items()})])


def likeliest(selector: RuleSelector) -> str:
    p = selector.learned("")
    return max(p, key=lambda action: p[action])


def place(tasks: Mapping[str, list[str]], actions: Mapping[str, str]) -> tuple[int, ...]:
    return tuple(tasks[t].index(actions[t]) for t in tasks)


def test_the_best_combination_is_found_where_actions_depend_on_each_other() -> None:
    """On held-out tables: within two points of the best on average, where learners of their own
    end several points below."""
    tables = [interactive(shape, seed) for shape in ((5, 3, 2), (4, 4)) for seed in range(3)]
    joint = [together(table, 600) for table in tables]
    assert np.mean(joint) < 0.02 and max(joint) < 0.12
    single = [apart(table, 600) for table in tables]
    assert np.mean(single) > np.mean(joint) + 0.015


@pytest.mark.parametrize("rule", ["nikolic_fu", "ucb1", "tracking", "thompson"])
def test_any_rule_learns_over_combinations(rule: str) -> None:
    """A combination that works only together, beside one that is tolerable in any company."""
    table = np.full((3, 3), 0.05)
    table[0], table[:, 0], table[2, 2] = 0.3, 0.3, 0.9
    assert together(table, 300, rule) == 0.0


def regret(rule: str, tables: list[Table], each: int, seed: int) -> float:
    """Return how many goals fewer than with the best combination are met while the tables take
    turns, each for so many trials."""
    rng, tasks, lost = np.random.default_rng(seed), names(tables[0].shape), 0.0
    selector = CombinationSelector(rule, tasks, Question(), "task")
    for table in tables:
        for _ in range(each):
            actions: dict[str, str] = {}
            for task, alternatives in tasks.items():
                actions[task], _ = selector.choose(task, "", alternatives, rng)
                selector.chosen(task, "", actions[task])
            chance = table[place(tasks, actions)]
            lost += table.max() - chance
            selector.update("", actions, ended(rng.random() < chance))
    return lost


def test_tracking_follows_changes_of_the_world() -> None:
    """One action gets worse, then another. A rule that tries everything anew would lose most of
    the trials of each phase: there are thirty combinations and a hundred trials."""
    lost: dict[str, list[float]] = {"tracking": [], "nikolic_fu_fast": []}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        shares = [rng.uniform(0.75, 1.0, n) for n in (5, 3, 2)]
        tables = []
        for worse in (None, 0, 2):
            now = [one.copy() for one in shares]
            if worse is not None:
                now[worse][now[worse].argmax()] *= 0.4
            tables.append(np.einsum("i,j,k->ijk", *now))
        for rule, found in lost.items():
            found.append(regret(rule, tables, 100, seed))
    assert np.mean(lost["tracking"]) < 0.8 * np.mean(lost["nikolic_fu_fast"]), lost
    assert np.mean(lost["tracking"]) < 55.0, lost


def test_choices_follow_the_probabilities_over_combinations() -> None:
    """Though they are drawn one after the other; of what is not offered nothing is chosen."""
    tasks = names((2, 3))
    selector = CombinationSelector("reward_inaction", tasks, Question(), "task")
    p = np.array([0.4, 0.0, 0.1, 0.05, 0.25, 0.2])
    selector.selector.learners[""] = selector.selector.learner("")
    selector.selector.learners[""].p[0] = p
    rng, counts = np.random.default_rng(4), np.zeros(6)
    for _ in range(3000):
        actions = {}
        for task in tasks:
            actions[task] = selector.choose(task, "", tasks[task], rng)[0]
            selector.chosen(task, "", actions[task])
        counts[list(product(*tasks.values())).index(tuple(actions.values()))] += 1
    assert np.abs(counts / 3000 - p).max() < 0.03
    assert selector.marginal("t0", "") == pytest.approx([0.5, 0.5])
    assert selector.marginal("t1", "") == pytest.approx([0.45, 0.25, 0.3])
    for _ in range(20):
        assert selector.choose("t0", "", ["a01"], rng)[0] == "a01"


def test_a_token_that_ends_early_counts_for_what_could_have_followed() -> None:
    """By the probability of each; together it is one trial. One that never began lowers A alone."""
    tasks = names((2, 2))
    selector = CombinationSelector("reward_inaction", tasks, Question(), "task")
    selector.selector.learners[""] = selector.selector.learner("")
    selector.selector.learners[""].p[0] = [0.6, 0.2, 0.1, 0.1]
    selector.update("", {"t0": "a00"}, ended(True))
    batch = selector.selector.learners[""]
    assert batch.runs[0] == pytest.approx([0.75, 0.25, 0.0, 0.0])
    assert batch.successes[0] == pytest.approx([0.75, 0.25, 0.0, 0.0])
    assert batch.cost[0] == pytest.approx([3.75, 1.25, 0.0, 0.0]) and batch.k[0] == 1
    never = Observation(Status.ERROR, 0.0, "unreachable", Executed.NO)
    selector.update("", {"t0": "a01", "t1": "a10"}, never)
    assert batch.missing[0] == pytest.approx([0, 0, 1, 0]) and batch.runs[0].sum() == pytest.approx(
        1.0
    )


def test_more_combinations_than_a_learner_can_tell_apart() -> None:
    assert CombinationSelector.fits(names((4, 4, 4, 4))) and MOST == 4**4
    assert not CombinationSelector.fits(names((5, 4, 4, 4)))
    assert not CombinationSelector.fits(names((7,)))
