"""Selectors: one row and batches give the same results; contexts, targets, dead nodes, and what
the operator may change."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace
from numpy.typing import NDArray

from petrobot.coordinator.cli.run import SELECTORS
from petrobot.coordinator.learning.batch import SUMS, Batch, Response, drawn, restricted
from petrobot.coordinator.learning.estimate import Observation, Tally
from petrobot.coordinator.learning.objective import Question
from petrobot.coordinator.learning.selectors import (
    MOST,
    RULES,
    CombinationSelector,
    RuleSelector,
    eligible,
    make,
)
from petrobot.coordinator.task import Executed, Status

ACTIONS = ("a", "b", "c", "d")
NAMES = sorted(RULES)


class Uniform(np.random.Generator):
    """A generator that returns given numbers."""

    def __init__(self, rows: Iterable[np.ndarray]) -> None:
        super().__init__(np.random.PCG64(0))
        self._rows = iter(rows)

    def random(self, *shape: object, **more: object) -> np.ndarray:  # type: ignore[override]
        """Return the next row, as a batch of one."""
        return next(self._rows)[None, :]


def success(seconds: float = 1.0) -> Observation:
    """Return a run that met its specification."""
    return Observation(Status.SUCCESS, seconds)


def failure(seconds: float = 1.0) -> Observation:
    """Return a run that did not meet its specification."""
    return Observation(Status.FAILURE, seconds, "late")


def missing() -> Observation:
    """Return a run that never executed."""
    return Observation(Status.ERROR, 0.0, "unreachable", Executed.NO)


def taught(selector: RuleSelector, context: str = "", good: int = 30) -> RuleSelector:
    """Train a selector: `b` always succeeds, the others never."""
    for _ in range(good):
        for action in ACTIONS:
            selector.chosen(context, action)
            selector.update(context, action, success() if action == "b" else failure())
    return selector


def test_the_command_line_names_every_selector() -> None:
    """--selector offers every selector."""
    assert set(SELECTORS) == set(RULES)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 5), st.booleans())
def test_rows_of_a_batch_are_the_shipped_selector(
    name: str, seed: int, n: int, costly: bool
) -> None:
    """The convergence study simulates exactly what a mission run uses, trial by trial and bit by
    bit."""
    rng = np.random.default_rng(seed)
    rows, trials, actions = 3, 60, ACTIONS[:n] if n < 5 else (*ACTIONS, "e")
    u, v = rng.random((trials, rows, n)), rng.random((trials, rows))
    r, seconds = (
        rng.random(n),
        rng.random((trials, rows)) + 0.1 if costly else np.zeros((trials, rows)),
    )
    rule, offered = RULES[name](), np.ones((rows, n), dtype=bool)
    batch = rule.begin(rows, n)
    alone = [RuleSelector(RULES[name](), actions, Question("wall")) for _ in range(rows)]
    feeds = [Uniform(u[:, i]) for i in range(rows)]
    for t in range(trials):
        chosen = rule.choose(batch, offered, u[t])
        batch.choosing(chosen)
        good = v[t] < r[chosen]
        rule.learn(
            batch, Response(chosen, good.astype(float), seconds[t], np.ones(rows, dtype=bool))
        )
        for i, selector in enumerate(alone):
            action, why = selector.choose("", actions, feeds[i])
            assert action == actions[chosen[i]]
            assert why.startswith(name)
            selector.chosen("", action)
            selector.update(
                "",
                action,
                Observation(Status.SUCCESS if good[i] else Status.ERROR, float(seconds[t, i])),
            )
    for i, selector in enumerate(alone):
        mine = selector.learner("")
        for field in ("p", *SUMS):
            assert np.array_equal(getattr(batch, field)[i], getattr(mine, field)[0]), field


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=10, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from(ACTIONS), st.sampled_from("SFEMC"), st.floats(0.01, 9)),
        max_size=40,
    )
)
def test_probabilities_stay_valid_after_any_sequence_of_results(
    name: str, ends: list[tuple[str, str, float]]
) -> None:
    """p and the choice probabilities stay in [0, 1] and sum to 1; censored runs change nothing."""
    selector = make(name, ACTIONS)
    for action, end, seconds in ends:
        outcome = {
            "S": success(seconds),
            "F": failure(seconds),
            "E": Observation(Status.ERROR, seconds, "lost", Executed.UNKNOWN),
            "M": missing(),
            "C": Observation(None, seconds, preempted_by="gone"),
        }[end]
        before = json.dumps(selector.state()) if end == "C" and selector.learners else ""
        selector.update("", action, outcome)
        if before:
            assert json.dumps(selector.state()) == before
    for offered in (ACTIONS, ("b", "d"), ("c",)):
        shares = selector.probabilities("", offered)
        assert sum(shares.values()) == pytest.approx(1.0)
        assert all(-1e-12 <= share <= 1 + 1e-12 for share in shares.values())
        assert all(shares[a] == 0 for a in ACTIONS if a not in offered)
        assert selector.choose("", offered, np.random.default_rng(1))[0] in offered


@pytest.mark.parametrize("name", NAMES)
def test_choosing_changes_nothing(name: str) -> None:
    """A resumed run does not choose again, yet reaches the same state."""
    selector = taught(make(name, ACTIONS), good=3)
    selector.choose("never seen", ACTIONS, np.random.default_rng(7))
    assert "never seen" not in selector.state()["learners"]
    before = json.dumps(selector.state())
    drawn_first = selector.choose("", ACTIONS, np.random.default_rng(7))
    assert json.dumps(selector.state()) == before
    assert selector.choose("", ACTIONS, np.random.default_rng(7)) == drawn_first


@pytest.mark.parametrize("name", NAMES)
def test_the_state_survives_conversion_to_plain_data(name: str) -> None:
    """A restored selector continues exactly like the original."""
    one = taught(make(name, ACTIONS), "regime=A", 7)
    other = make(name, ACTIONS)
    other.restore(json.loads(json.dumps(one.state())))
    for seed in range(20):
        rng = [np.random.default_rng(seed) for _ in range(2)]
        assert one.choose("regime=A", ACTIONS, rng[0]) == other.choose("regime=A", ACTIONS, rng[1])
        for selector in (one, other):
            selector.update("regime=A", ACTIONS[seed % 4], success() if seed % 3 else failure())
    assert one.state() == other.state()


@pytest.mark.parametrize("name", [n for n in NAMES if n not in ("fixed", "round_robin")])
def test_contexts_are_learned_separately(name: str) -> None:
    """Learning in one context does not affect another; when frozen, each context chooses its own
    best action."""
    selector = taught(make(name, ACTIONS), "regime=A", 60)
    for _ in range(240):
        for action in ACTIONS:
            selector.chosen("regime=B", action)
            selector.update("regime=B", action, success() if action == "d" else failure())
    selector.frozen = True
    rng = np.random.default_rng(0)
    assert selector.choose("regime=A", ACTIONS, rng)[0] == "b"
    assert selector.choose("regime=B", ACTIONS, rng)[0] == "d"
    fresh = selector.probabilities("regime=C")
    assert sum(fresh.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("name", NAMES)
def test_a_frozen_selector_learns_nothing_and_a_reset_one_forgets_all(name: str) -> None:
    """Frozen: the state stays as it is and is marked so. Reset: the state is that of a new one."""
    selector = taught(make(name, ACTIONS), good=20)
    selector.frozen = True
    before = json.dumps(selector.state())
    selector.chosen("", "a")
    selector.update("", "a", success())
    assert json.dumps(selector.state()) == before
    assert "frozen" in selector.choose("", ACTIONS, np.random.default_rng(0))[1]
    selector.frozen = False
    selector.reset()
    assert selector.state() == make(name, ACTIONS).state()


def test_a_choice_gives_its_reason_with_numbers() -> None:
    """The reason has J, R, runs, C, the probability of the draw, and the best action."""
    selector = taught(make("nikolic_fu", ACTIONS), "regime=B", 5)
    action, why = selector.choose("regime=B", ACTIONS, Uniform([np.array([0.0, 0, 0, 0])]))
    assert action == "a"
    assert why == (
        "nikolic_fu: drawn with 0.060; J 2.000, R 0.000 of 5 runs, C 1; lowest J 1.000 b (regime=B)"
    )


def test_an_action_of_a_dead_node_is_avoided() -> None:
    """It never executes, so its R stays 1, yet its J grows with each failed start."""
    selector = make("nikolic_fu_fast", ("dead", "alive"))
    rng = np.random.default_rng(3)
    for _ in range(5):
        for action in ("dead", "alive"):
            selector.chosen("", action)
            selector.update("", action, success(0.5) if action == "dead" else success(1.0))
    assert selector.objective("")["dead"] < selector.objective("")["alive"]
    for _ in range(400):
        action, _ = selector.choose("", ("dead", "alive"), rng)
        selector.chosen("", action)
        selector.update("", action, missing() if action == "dead" else success(1.0))
    assert selector.learned("")["alive"] > 0.95
    assert selector.learner("").successes[0, 0] == 5


def test_first_trials_of_an_unavailable_action_end() -> None:
    """First trials count starts, not results, so a dead node does not prolong them for ever."""
    selector = make("nikolic_fu_fast", ("dead", "alive"))
    for _ in range(5):
        selector.chosen("", "dead")
        selector.update("", "dead", missing())
    assert "first 5" not in selector.choose("", ("dead",), np.random.default_rng(0))[1]


@pytest.mark.parametrize("name", NAMES)
def test_a_selector_does_not_learn_from_a_run_without_a_verdict(name: str) -> None:
    selector = taught(make(name, ACTIONS), good=3)
    before = json.dumps(selector.state())
    selector.update("", "a", replace(success(), judged=False))
    assert json.dumps(selector.state()) == before
    selector.update("", "a", success())
    assert json.dumps(selector.state()) != before


STEPS = st.lists(
    st.tuples(st.sampled_from("usm"), st.sampled_from(ACTIONS), st.integers(1, 60)),
    max_size=25,
)


@settings(max_examples=30, deadline=None)
@given(st.sampled_from(NAMES), STEPS, st.sampled_from([None, 0.5, 0.9]))
def test_shares_stay_within_bounds(
    name: str, steps: list[tuple[str, str, int]], target: float | None
) -> None:
    """Trials, runs that never executed, and restarts: R, A and J stay in their ranges."""
    selector = make(name, ACTIONS, Question("wall", target))
    for what, action, times in steps:
        for _ in range(times):
            outcome = {"u": failure(0.1 * times), "s": success(2.0), "m": missing()}[what]
            selector.update("", action, outcome)
        again = make(name, ACTIONS, Question("wall", target))
        again.restore(json.loads(json.dumps(selector.state())))
        selector = again
        batch = selector.learner("")
        assert np.all((batch.reliability() >= 0) & (batch.reliability() <= 1))
        assert np.all((batch.availability() >= 0) & (batch.availability() <= 1))
        assert np.all(batch.objective() >= 0)
        assert np.all((batch.p >= 0) & (batch.p <= 1))
        assert np.all(batch.successes <= batch.runs)


def test_a_state_with_more_successes_than_runs_is_corrected() -> None:
    """Such states were written before corrections were bounded."""
    selector = taught(make("tracking", ACTIONS), good=3)
    state = selector.state()
    state["learners"][""]["successes"][0] = 1e3
    selector.restore(state)
    assert selector.learner("").reliability().max() == 1.0


def test_only_actions_that_meet_the_target_are_preferred() -> None:
    """A cheap but unreliable action wins without a target and loses with one; as long as no action
    meets the target, J alone decides."""
    trials = [("cheap", [success(0.1)] * 6 + [failure(0.1)] * 4), ("sure", [success(5.0)] * 10)]

    def learned(target: float | None) -> str:
        selector = make("nikolic_fu", ("cheap", "sure"), Question("wall", target))
        for _ in range(20):
            for action, outcomes in trials:
                for outcome in outcomes:
                    selector.chosen("", action)
                    selector.update("", action, outcome)
        return max(selector.learned("").items(), key=lambda item: item[1])[0]

    assert [learned(t) for t in (None, 0.9, 0.999999)] == ["cheap", "sure", "cheap"]


@pytest.mark.parametrize(
    ("met", "before", "now"),
    [(100, False, True), (95, False, False), (95, True, True), (89, True, False)],
)
def test_an_action_is_admitted_with_certainty_and_excluded_late(
    met: int, before: bool, now: bool
) -> None:
    """With target 0.9 and 100 runs, an action is admitted when Wilson's lower bound reaches the
    target (0.96 for 100 successes, 0.89 for 95), and excluded when R itself falls below."""
    batch = Batch.fresh(1, 1, None)
    batch.runs[:], batch.successes[:] = 100.0, met
    assert eligible(batch, 0.9, np.array([[before]])).tolist() == [[now]]


def test_a_selector_takes_its_sums_from_merged_estimates() -> None:
    """Another machine's runs then decide the order of actions; a rule whose sums fade keeps its
    own."""
    tally = Tally()
    for _ in range(50):
        tally = tally.adding(Observation(Status.SUCCESS, 1.0))
    for name, r in (("nikolic_fu", 1.0), ("tracking", 0.0)):
        selector = taught(make(name, ACTIONS), good=5)
        selector.prime("", {"d": tally})
        batch = selector.learner("")
        assert batch.reliability()[0, 3] == r
        assert (batch.runs[0, 3] == 50) == (name == "nikolic_fu")


def test_new_and_vanished_alternatives() -> None:
    """Sums stay with their actions, a new action is unknown and gets an equal share, and the gain
    starts again."""
    old = taught(make("nikolic_fu", ACTIONS), good=25)
    new = make("nikolic_fu", ("d", "b", "new"))
    new.restore(old.state())
    batch = new.learner("")
    assert batch.successes[0].tolist() == [0.0, 25.0, 0.0]
    assert sum(new.learned("").values()) == pytest.approx(1.0)
    assert new.learned("")["new"] == pytest.approx(1 / 3)
    assert new.learned("")["b"] > new.learned("")["d"]
    assert batch.k[0] == 0


@pytest.mark.parametrize(
    "change",
    [
        {"selector": "ucb1"},
        {"learners": {"": {"p": [1.0]}}},
        {"learners": {"": {"p": [0.5, 0.5, 0.5, 0.5]}}},
    ],
)
def test_a_state_that_does_not_fit_is_refused(change: dict[str, object]) -> None:
    """It belongs to another rule, is too short, or holds invalid probabilities."""
    state = taught(make("nikolic_fu", ACTIONS), good=2).state()
    learners = {"": {**state["learners"][""], **change.get("learners", {}).get("", {})}}  # type: ignore[attr-defined]
    with pytest.raises(ValueError):
        make("nikolic_fu", ACTIONS).restore({**state, **change, "learners": learners})


def test_unknown_selectors_and_alternatives_are_refused() -> None:
    """The error lists the known names."""
    with pytest.raises(ValueError, match="nikolic_fu_fast"):
        make("greedy", ACTIONS)
    with pytest.raises(ValueError, match="none of x"):
        make("fixed", ACTIONS).choose("", ("x",), np.random.default_rng(0))


def test_round_robin_alternates_and_fixed_does_not() -> None:
    """Round robin chooses each alternative equally often; fixed always the first one offered."""
    turns, fixed = make("round_robin", ACTIONS), make("fixed", ACTIONS)
    rng, seen = np.random.default_rng(0), []
    for _ in range(8):
        action, _ = turns.choose("", ACTIONS, rng)
        turns.chosen("", action)
        seen.append(action)
        assert fixed.choose("", ("c", "b"), rng)[0] == "b"
    assert seen == [*ACTIONS, *ACTIONS]


@given(st.lists(st.floats(0.01, 1), min_size=2, max_size=6), st.floats(0, 1, exclude_max=True))
def test_draws_invert_the_distribution(weights: list[float], u: float) -> None:
    """A draw returns the action whose cumulative interval holds u."""
    p = np.array([weights]) / np.sum(weights)
    bounds = np.concatenate([[0.0], np.cumsum(p[0])]) / np.cumsum(p[0])[-1]
    action = int(drawn(p, np.array([u]))[0])
    assert bounds[action] <= u < bounds[action + 1] or action == len(weights) - 1


def test_probabilities_are_scaled_to_the_offered_actions() -> None:
    """They are scaled up to sum to 1; if all are 0, shares are equal."""
    p = np.array([[0.5, 0.5, 0.0]])
    assert restricted(p, np.array([[True, False, True]])).tolist() == [[1.0, 0.0, 0.0]]
    assert restricted(p, np.array([[False, False, True]])).tolist() == [[0.0, 0.0, 1.0]]


def test_declared_costs_count_from_the_first_trial() -> None:
    """Of two actions that both succeed, the selector prefers the one declared cheaper. A measured
    cost replaces the declared one, also after the state was saved and restored."""
    question = Question("value:energy", declared=(("a", 4.0), ("b", 1.0)))
    selector = RuleSelector(RULES["nikolic_fu"](), ("a", "b"), question)
    for action in ("a", "b"):
        selector.update("", action, Observation(Status.SUCCESS, 1.0))
    assert selector.learner("").objective()[0].tolist() == [1.0, 0.25]
    selector.update("", "a", Observation(Status.SUCCESS, 1.0, values={"energy": 0.5}))
    again = RuleSelector(RULES["nikolic_fu"](), ("a", "b"), question)
    again.restore(selector.state())
    for one in (selector, again):
        assert one.learner("").mean_cost()[0].tolist() == [0.5, 1.0]


# --- combinations ---

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
    tables = [interactive((5, 3, 2), 0), interactive((5, 3, 2), 2), interactive((4, 4), 0)]
    joint = [together(table, 300) for table in tables]
    assert np.mean(joint) < 0.02 and max(joint) < 0.12
    single = [apart(table, 300) for table in tables]
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
    for seed in range(2):
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
