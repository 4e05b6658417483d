"""J, rho, scenarios above the target, break-even, the Pareto front, and the trade-off between
target reliability and cost in both directions."""

from __future__ import annotations

from math import comb, inf, isnan

import pytest
from hypothesis import given, strategies as st

from petrobot.coordinator.learning.estimate import Observation, Tally
from petrobot.coordinator.learning.objective import (
    Comparison,
    Question,
    admitted,
    break_even,
    compare,
    cost_to_reach,
    objective,
    pareto,
    reliability_for,
)
from petrobot.coordinator.task import Executed, Status


def runs(good: int, bad: int, seconds: float = 1.0, missing: int = 0) -> Tally:
    """Return the tally of some successes and failures of one duration."""
    tally = Tally()
    for _ in range(good):
        tally = tally.adding(Observation(Status.SUCCESS, seconds))
    for _ in range(bad):
        tally = tally.adding(Observation(Status.FAILURE, seconds, "late"))
    for _ in range(missing):
        tally = tally.adding(Observation(Status.ERROR, 0.0, "unreachable", Executed.NO))
    return tally


def judged(question: Question | None = None, **actions: Tally) -> Comparison:
    """Compare actions in one scenario."""
    return compare({name: {"": tally} for name, tally in actions.items()}, question or Question())


def test_the_papers_cost_function() -> None:
    """J = 1 - R + rho C with rho = 1 / max C over the primitive task's own actions."""
    found = judged(slow=runs(9, 1, 4.0), quick=runs(7, 3, 1.0))
    assert found.rho == pytest.approx(0.25)
    assert found.of("slow").j == pytest.approx(1 - 0.9 + 1.0)
    assert found.of("quick").j == pytest.approx(1 - 0.7 + 0.25)
    assert found.best == "quick"


def test_a_declared_rho_lets_reliability_decide() -> None:
    """With a small rho the more reliable action is better."""
    assert judged(Question(rho=0.01), slow=runs(9, 1, 4.0), quick=runs(7, 3, 1.0)).best == "slow"


def test_a_dead_nodes_action_is_not_best() -> None:
    """R = 1 of three runs, but nine in ten starts never execute: A R decides."""
    found = judged(dead=runs(3, 0, 1.0, missing=27), alive=runs(30, 10, 1.0))
    assert found.of("dead").reliability == 1.0
    assert found.of("dead").availability == pytest.approx(0.1)
    assert found.best == "alive"


def test_an_action_without_runs_has_no_j() -> None:
    """It is never the best one, and does not affect the others."""
    found = judged(new=Tally(), old=runs(1, 1))
    assert isnan(found.of("new").j)
    assert found.best == "old"
    assert judged(new=Tally()).best is None


HARD = {"calm": runs(99, 1, 1.0), "windy": runs(90, 10, 2.0), "storm": runs(50, 50, 5.0)}


@pytest.mark.parametrize(
    ("target", "scenario", "cost"),
    [(None, "storm", 5.0), (0.3, "storm", 5.0), (0.8, "windy", 2.0), (0.93, "calm", 1.0)],
)
def test_cost_is_that_of_the_hardest_scenario_above_the_target(
    target: float | None, scenario: str, cost: float
) -> None:
    """The paper's definition: the lowest reliability among those with values lower-bounded by the
    target."""
    figures = compare({"act": HARD}, Question(target=target)).of("act")
    assert (figures.scenario, figures.cost) == (scenario, cost)


def test_no_scenario_above_the_target_makes_inadmissible() -> None:
    """The set is empty: J is infinite, and another action is best with any finite J."""
    found = compare(
        {"weak": {"": runs(50, 50, 0.1)}, "strong": {"": runs(99, 1, 9.0)}}, Question(target=0.9)
    )
    assert not found.of("weak").admissible
    assert found.of("weak").j == inf
    assert found.best == "strong"


def test_a_scenario_is_in_when_the_lower_bound_reaches_the_target() -> None:
    assert admitted({"": runs(46, 4)}, 0.9) == ()  # R .92, Wilson's lower bound .81
    assert admitted({"": runs(980, 20)}, 0.9) == ("",)


def test_the_largest_cost_over_the_set_is_computed_too() -> None:
    """The hardest scenario need not be the most expensive one."""
    figures = compare(
        {"act": {"hard": runs(90, 10, 1.0), "easy": runs(99, 1, 3.0)}}, Question()
    ).of("act")
    assert (figures.scenario, figures.cost, figures.largest_cost) == ("hard", 1.0, 3.0)
    assert figures.scenarios == ("easy", "hard")


@given(
    st.integers(1, 30),
    st.integers(0, 30),
    st.integers(1, 30),
    st.integers(0, 30),
    st.floats(0.1, 9),
    st.floats(0.1, 9),
)
def test_break_even_is_where_j_is_equal(
    g1: int, b1: int, g2: int, b2: int, c1: float, c2: float
) -> None:
    """At the break-even rho both J are equal; below it the more reliable action is better."""
    found = judged(one=runs(g1, b1, c1), other=runs(g2, b2, c2))
    one, other = found.figures
    rho = break_even(one, other)
    if rho is None:
        assert (
            one.cost == other.cost
            or (one.reliability - other.reliability) * (one.cost - other.cost) <= 0
        )
        return
    at = [objective(f.reliability, f.cost, rho) for f in (one, other)]
    assert at[0] == pytest.approx(at[1], abs=1e-6)
    below = [objective(f.reliability, f.cost, rho / 2) for f in (one, other)]
    assert (below[0] < below[1]) == (one.reliability > other.reliability)


@given(
    st.lists(
        st.tuples(st.integers(0, 10), st.integers(1, 10), st.floats(0.1, 9)), min_size=1, max_size=6
    )
)
def test_the_pareto_front_is_not_dominated_and_complete(rows: list[tuple[int, int, float]]) -> None:
    """No action is better than a member in both R and C; every other action is matched or dominated
    by a member."""
    found = compare({f"a{i}": {"": runs(g, b, c)} for i, (g, b, c) in enumerate(rows)}, Question())
    front = pareto(found.figures)
    assert front
    for f in found.figures:
        better = [g for g in front if g.reliability >= f.reliability and g.cost <= f.cost]
        assert better
        if f in front:
            assert all((g.reliability, g.cost) == (f.reliability, f.cost) for g in better)


def test_reliability_for_a_cost_and_cost_for_a_reliability() -> None:
    """The cost of a required reliability, and the reliability that a cost allows."""
    found = judged(one=runs(70, 30, 1.0), four=runs(90, 10, 4.0), nine=runs(97, 3, 9.0))
    reach = {r: cost_to_reach(found.figures, r) for r in (0.5, 0.8, 0.95, 0.99)}
    assert [None if f is None else f.action for f in reach.values()] == [
        "one",
        "four",
        "nine",
        None,
    ]
    bought = {c: reliability_for(found.figures, c) for c in (0.5, 1.0, 5.0, 50.0)}
    assert [None if f is None else f.action for f in bought.values()] == [
        None,
        "one",
        "four",
        "nine",
    ]


def test_more_images_averaged_cost_more_and_are_more_reliable() -> None:
    """The paper's example: the cost is the number of averaged images, a value of the result."""
    tallies = {}
    for images, good in ((1, 60), (4, 88), (16, 99)):
        tally = Tally()
        for i in range(100):
            status = Status.SUCCESS if i < good else Status.FAILURE
            tally = tally.adding(
                Observation(status, 0.02 * images, values={"images": float(images)})
            )
        tallies[f"average_{images}"] = {"": tally}
    found = compare(tallies, Question("value:images"))
    assert [f.cost for f in found.figures] == [1.0, 4.0, 16.0]
    assert found.best == "average_4"
    reach = cost_to_reach(found.figures, 0.95)
    assert reach is not None
    assert reach.action == "average_16"


def shares(good: float, runs_: int, seconds: float = 1.0) -> Tally:
    """Return the tally of `runs_` runs, of which the share `good` succeeded."""
    return runs(round(good * runs_), runs_ - round(good * runs_), seconds)


@pytest.mark.parametrize(
    ("easy", "hard"), [((50, 500), (500, 50)), ((500, 50), (50, 500)), ((200, 200), (200, 200))]
)
def test_unequal_shares_of_easy_and_hard_runs_do_not_reverse_the_order(
    easy: tuple[int, int], hard: tuple[int, int]
) -> None:
    """Simpson's paradox: an action that is better in each scenario is better overall, however often
    each was run in each scenario."""
    found = compare(
        {
            "good": {"easy": shares(0.98, easy[0]), "hard": shares(0.56, hard[0])},
            "bad": {"easy": shares(0.90, easy[1]), "hard": shares(0.40, hard[1])},
        },
        Question(),
    )
    assert [f.reliability for f in found.figures] == [0.56, 0.40]
    assert [f.worst for f in found.figures] == ["hard", "hard"]
    assert [f.j for f in found.figures] == pytest.approx([1.44, 1.60])
    assert found.best == "good"
    assert found.of("good").lower < 0.56 < found.of("good").upper < 0.75


def test_actions_are_compared_in_scenarios_where_all_of_them_were_run() -> None:
    """An action that was never run in the storm gains no advantage from that; the other actions'
    runs there are still known."""
    new = {"calm": shares(0.9, 50)}
    found = compare({"act": HARD, "new": new, "unknown": {}}, Question())
    assert found.scenarios == ("calm",)
    assert (found.of("act").reliability, found.of("act").runs) == (0.99, 300)
    assert found.best == "act"
    apart = compare({"act": HARD, "other": {"fog": shares(0.9, 50)}}, Question())
    assert apart.scenarios == ()
    assert apart.of("act").worst == "storm"
    assert isnan(found.of("unknown").j)


def test_if_no_action_meets_the_target_none_is_excluded() -> None:
    """As in a selector, the lowest J of all wins, and a note says that the target is not met."""
    actions = {"weak": {"": runs(50, 50, 1.0)}, "weaker": {"": runs(20, 80, 1.0)}}
    found = compare(actions, Question(target=0.9))
    assert found.unmet
    assert found.best == "weak"
    assert [f.j for f in found.figures] == pytest.approx(
        [f.j for f in compare(actions, Question()).figures]
    )
    assert not any(f.admissible or f.scenarios for f in found.figures)
    assert not compare({"new": {}}, Question(target=0.9)).unmet


def test_a_cost_that_no_result_reported_is_named() -> None:
    """It counts as 0 in J, which the figures alone do not show."""
    found = judged(Question("value:images"), one=runs(9, 1), new=Tally())
    assert found.uncosted == ("one",)
    assert found.rho == 0.0
    assert judged(one=runs(9, 1)).uncosted == ()


def test_the_availability_of_a_node_covers_all_scenarios() -> None:
    """A is computed over all scenarios, although the failed starts were in one without a single
    run."""
    found = compare({"act": {"calm": runs(9, 1), "storm": runs(0, 0, missing=10)}}, Question())
    assert found.of("act").availability == 0.5
    assert found.scenarios == ("calm",)


def test_declared_costs_count_until_measurements_replace_them() -> None:
    """They set rho and J from the first run on, and are shown next to later measurements."""
    question = Question("value:energy", declared=(("a", 4.0), ("b", 1.0)))
    ran = Tally().adding(Observation(Status.SUCCESS, 1.0))
    found = compare({"a": {"": ran}, "b": {"": ran}, "c": {"": ran}}, question)
    assert found.rho == 0.25 and found.best == "c"
    assert [f.j for f in found.figures] == pytest.approx([1.0, 0.25, 0.0])
    assert found.uncosted == ("c",)
    measured = ran.adding(Observation(Status.SUCCESS, 1.0, values={"energy": 2.0}))
    now = compare({"a": {"": measured}, "b": {"": ran}}, question)
    assert now.of("a").cost == 2.0
    assert now.of("b").cost == 1.0


@pytest.mark.parametrize(("one", "other"), [(2, 2), (2, 5), (3, 3), (4, 4), (6, 7)])
def test_few_runs_do_not_make_one_of_two_equal_actions_clearly_the_best(
    one: int, other: int
) -> None:
    """Every outcome is counted with its probability, whatever R of both is."""

    def chances(n: int, r: float) -> list[float]:
        return [comb(n, k) * r**k * (1 - r) ** (n - k) for k in range(n + 1)]

    clear = [
        (a, b)
        for a in range(one + 1)
        for b in range(other + 1)
        if compare(
            {"one": {"": runs(a, one - a)}, "other": {"": runs(b, other - b)}}, Question()
        ).clear
    ]
    for r in (0.3, 0.5, 0.7, 0.9):
        mine, yours = chances(one, r), chances(other, r)
        assert sum(mine[a] * yours[b] for a, b in clear) < 0.05
