"""From actions to the task: competing risks against closed forms, series products, preemption as a
cause, and the sorting task."""

from __future__ import annotations

from math import exp, hypot, isnan, sqrt

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace
from scipy.stats import t as student

from petrobot.coordinator.analysis.time.completion import completion
from petrobot.coordinator.analysis.time.gspn import Chain
from petrobot.coordinator.analysis.time.measured import Measured
from petrobot.coordinator.analysis.time.stochastic import stochastic_view
from petrobot.coordinator.analysis.time.task_forecast import forecast
from petrobot.coordinator.launch import with_runs
from petrobot.coordinator.learning.estimate import Observation, Tally, TallyKey
from petrobot.coordinator.learning.learner import LearningSelector
from petrobot.coordinator.learning.learning import Estimates, Learning
from petrobot.coordinator.learning.objective import Question, compare
from petrobot.coordinator.learning.propagation import incidences, measured_from, propagate
from petrobot.coordinator.studies.forecast.registered import exact
from petrobot.coordinator.task import Estimate, Executed, Kind, Output, Place, Status, Task
from petrobot.coordinator.task.conditions import parse
from petrobot.coordinator.task.file import loads
from tests.learning.cell import run, sorting

SERIES = """
schema = 1
[task]
name = "series"
goal = "all done"
runs_place = "runs"
final = "runs == 0 and free == 1"
[places.runs]
kind = "control"
tokens = 1
[places.free]
kind = "resource"
tokens = 1
capacity = 1
[transitions.begin]
in = ["runs", "free"]
out = ["a"]
"""


def series(n: int) -> Task:
    """n primitive tasks a, b, ... one after the other; an error ends the run."""
    names = "abcdef"[:n]
    text = SERIES
    for i, name in enumerate(names):
        following = names[i + 1] if i + 1 < n else "free"
        text += f"""
[primitive_tasks.{name}]
goal = "{name}"
alternatives = ["do_{name}", "try_{name}"]
deadline = 10.0
[places.{name}]
kind = "action"
task = "{name}"
[transitions.{name}_done]
in = ["{name}:normal"]
out = ["{following}"]
[transitions.{name}_failed]
in = ["{name}:error"]
out = ["free"]
"""
    return loads(text, "series")


def tally(good: int, bad: int, error: int, seconds: float) -> Tally:
    """Return a tally of runs of one duration, by status."""
    out = Tally()
    for status, n in ((Status.SUCCESS, good), (Status.FAILURE, bad), (Status.ERROR, error)):
        for _ in range(n):
            out = out.adding(
                Observation(status, seconds, "" if status is Status.SUCCESS else "why")
            )
    return out


Counts = tuple[int, int, int, float]
COUNTS = st.tuples(st.integers(1, 20), st.integers(0, 5), st.integers(0, 5), st.floats(0.1, 5))


@settings(max_examples=15, deadline=None)
@given(st.lists(st.tuples(COUNTS, COUNTS), min_size=1, max_size=3))
def test_a_series_equals_the_conjunctive_product(
    rows: list[tuple[Counts, Counts]],
) -> None:
    """R = R_1 R_2 ..., where each R_i is averaged over its alternatives as often as they ran; costs
    add up to the step that a run reaches."""
    task, estimates = series(len(rows)), Estimates()
    expected_r, reach, expected_c = 1.0, 1.0, 0.0
    for name, (one, other) in zip("abc", rows, strict=False):
        estimates.tallies[TallyKey(name, f"do_{name}")] = tally(*one)
        estimates.tallies[TallyKey(name, f"try_{name}")] = tally(*other)
        share = sum(one[:3]) / (sum(one[:3]) + sum(other[:3]))
        mixed = [(share, *one), (1 - share, *other)]
        expected_r *= sum(w * g / (g + b + e) for w, g, b, e, _ in mixed)
        expected_c += reach * sum(w * c for w, *_, c in mixed)
        reach *= sum(w * (g + b) / (g + b + e) for w, g, b, e, _ in mixed)
    found = propagate(task, estimates)
    assert found.conjunctive == pytest.approx(expected_r, abs=1e-9)
    assert found.product == pytest.approx(expected_r, abs=1e-9)
    assert found.cost.value == pytest.approx(expected_c, rel=1e-9)
    assert found.forecast.mission_time == pytest.approx(expected_c, rel=1e-6)


def test_loops_and_recoveries_are_not_products() -> None:
    """For an action that is repeated until it succeeds, R_conj is that of the first try, but the
    task always completes."""
    text = (
        SERIES
        + """
[primitive_tasks.a]
goal = "a"
alternatives = ["do_a"]
deadline = 10.0
[places.a]
kind = "action"
task = "a"
[transitions.done]
in = ["a:normal"]
out = ["free"]
[transitions.again]
in = ["a:error"]
out = ["a"]
"""
    )
    found = propagate(loads(text, "loop"), Estimates({TallyKey("a", "do_a"): tally(3, 0, 1, 2.0)}))
    assert found.conjunctive == pytest.approx(0.75)
    assert found.complete == pytest.approx(1.0)
    assert found.parts["a"].runs == pytest.approx(4 / 3)
    assert found.cost.value == pytest.approx(2.0 * 4 / 3)
    assert found.forecast.mission_time == pytest.approx(2.0 * 4 / 3, rel=1e-6)


def test_intervals_of_the_task_come_from_those_of_its_actions() -> None:
    """In a series of two, the product changes with each R in proportion to the other; costs have
    the standard error of a mean."""
    rng = np.random.default_rng(5)
    known = []
    for good, bad in ((60, 20), (45, 5)):
        one = Tally()
        for i in range(good + bad):
            status = Status.SUCCESS if i < good else Status.ERROR
            one = one.adding(Observation(status, float(rng.uniform(1.0, 3.0))))
        known.append(one)
    estimates = Estimates({TallyKey(n, f"do_{n}"): t for n, t in zip("ab", known, strict=True)})
    found = propagate(series(2), estimates)
    (r1, r2), ((l1, u1), (l2, u2)) = (
        [t.reliability for t in known],
        [t.interval(0.95) for t in known],
    )
    assert found.reliability.value == pytest.approx(r1 * r2)
    assert found.reliability.lower == pytest.approx(
        r1 * r2 - hypot(r2 * (r1 - l1), r1 * (r2 - l2)), abs=1e-6
    )
    assert found.reliability.upper == pytest.approx(
        r1 * r2 + hypot(r2 * (u1 - r1), r1 * (u2 - r2)), abs=1e-6
    )
    c1, c2 = (t.cost("wall") for t in known)
    assert found.cost.value == pytest.approx(c1.mean + r1 * c2.mean)
    t1, t2 = (float(student.ppf(0.975, n - 1)) for n in (80, 50))
    own = hypot(t1 * c1.deviation / 80**0.5, t2 * r1 * c2.deviation / 50**0.5)
    more = c2.mean * (u1 - r1)  # The second action runs more often if the first is more reliable.
    assert found.cost.upper == pytest.approx(found.cost.value + hypot(own, more), rel=1e-5)
    assert found.rho == pytest.approx(1 / found.cost.value)
    assert found.j.value == pytest.approx(2 - r1 * r2)
    assert found.j.lower < found.j.value < found.j.upper
    cheap = propagate(series(2), estimates, rho=0.0)
    assert cheap.j.value == pytest.approx(1 - r1 * r2)
    assert cheap.j.upper == pytest.approx(1 - cheap.reliability.lower, abs=1e-6)


RECOVERY = """
[primitive_tasks.a]
goal = "a"
alternatives = ["do_a"]
deadline = 10.0
cost = "COST"
[primitive_tasks.mend]
goal = "mend"
alternatives = ["mend"]
deadline = 10.0
cost = "COST"
estimates = { success = { share = 1.0, mean = 3.0 } }
costs = { DECLARED }
[places.a]
kind = "action"
[places.mend]
kind = "action"
[transitions.done]
in = ["a:normal"]
out = ["free"]
[transitions.failed]
in = ["a:error"]
out = ["mend"]
[transitions.mended]
in = ["mend:normal"]
out = ["free"]
"""


@pytest.mark.parametrize("errors", [0, 5])
@pytest.mark.parametrize(
    ("cost", "declared", "of_mend"),
    [("wall", "", 3.0), ("wall", "mend = 7.0", 7.0), ("count", "mend = 7.0", 7.0),
     ("count", "", None)],
)  # fmt: skip
def test_a_recovery_that_never_ran_has_its_declared_cost(
    errors: int, cost: str, declared: str, of_mend: float | None
) -> None:
    """Where the cost is time, its declared duration. Without either, C is unknown if the recovery
    is part of it; else its interval lacks the recovery, and a note names it."""
    text = SERIES + RECOVERY.replace("COST", cost).replace("DECLARED", declared)
    known = Estimates({TallyKey("a", "do_a"): tally(15, 0, errors, 2.0)})
    found = propagate(loads(text, "recovery"), known)
    assert found.uncosted == (() if of_mend is not None else ("mend",))
    share, own = errors / (15 + errors), 2.0 if cost == "wall" else 1.0
    if of_mend is None and errors:
        assert isnan(found.cost.value) and isnan(found.j.value)
        return
    assert found.cost.value == pytest.approx(own + share * (of_mend or 0.0))
    lower, upper = known.of("a")["do_a"][""].interval(0.95)
    most, least = ((1 - r) * (of_mend or 0.0) for r in (lower, upper))
    assert found.cost.upper == pytest.approx(own + most, rel=1e-6)
    assert found.cost.lower == pytest.approx(own + least, rel=1e-6)
    assert found.j.upper == pytest.approx(
        found.j.value + found.rho * (most - share * (of_mend or 0.0)) + 1 - share - lower,
        rel=1e-6,
    )


def test_an_action_that_was_removed_does_not_count() -> None:
    """The file still knows `old_a`: it was slow, failed often, and ran in another scenario."""
    task = series(1)
    known = {TallyKey("a", "do_a"): tally(90, 10, 0, 2.0)}
    removed = {
        TallyKey("a", "old_a"): tally(10, 0, 90, 50.0),
        TallyKey("a", "old_a", "dark"): tally(10, 0, 90, 50.0),
    }
    alone, both = (propagate(task, Estimates(one)) for one in (known, known | removed))
    assert both.parts["a"] == alone.parts["a"]
    assert both.parts["a"].reliability.value == pytest.approx(0.9)
    assert (both.reliability, both.cost, both.rho, both.j) == (
        alone.reliability,
        alone.cost,
        alone.rho,
        alone.j,
    )


def test_the_task_is_judged_in_its_hardest_scenario() -> None:
    """R and C of a primitive task are those of `learned show`: those of the worst scenario, not the
    average over all runs."""
    estimates = Estimates(
        {
            TallyKey("a", "do_a", "calm"): tally(90, 0, 10, 1.0),
            TallyKey("a", "do_a", "windy"): tally(5, 0, 5, 3.0),
        }
    )
    question = Question("wall", rho=0.1)
    found = propagate(series(1), estimates, questions={"a": question})
    shown = compare(estimates.of("a"), question)
    assert found.scenario == "windy" and found.conjunctive == pytest.approx(0.5)
    assert found.parts["a"].reliability.value == shown.of("do_a").reliability == 0.5
    assert found.parts["a"].cost.value == shown.of("do_a").cost == pytest.approx(3.0)
    assert found.parts["a"].j == pytest.approx(shown.of("do_a").j) == pytest.approx(0.8)
    calm = propagate(series(1), estimates, "calm")
    assert calm.conjunctive == pytest.approx(0.9) and calm.cost.value == pytest.approx(1.0)


def test_a_call_that_never_executed_takes_the_error_branch() -> None:
    """It does not lower the action's R, but it lowers the R of the task."""
    known = tally(9, 0, 0, 1.0)
    known = known.adding(Observation(Status.ERROR, 0.0, "unreachable", Executed.NO))
    task = replace(series(1))
    measured = measured_from(task, Estimates({TallyKey("a", "do_a"): known}))
    assert known.reliability == 1.0
    assert measured.runs["a", "do_a"][Status.SUCCESS].share == pytest.approx(0.9)
    assert measured.runs["a", "do_a"][Status.ERROR].share == pytest.approx(0.1)
    assert propagate(task, Estimates({TallyKey("a", "do_a"): known})).conjunctive == pytest.approx(
        0.9
    )


def by_cause(condition: str) -> Task:
    """One primitive task whose goal is an ERROR for which the condition holds."""
    text = f"""
[primitive_tasks.a]
goal = "a"
alternatives = ["do_a"]
deadline = 10.0
[places.a]
kind = "action"
task = "a"
[transitions.a_done]
in = ["a:normal"]
out = ["free"]
[transitions.a_goal]
in = ["a:error"]
out = ["free"]
priority = 1
when = "{condition}"
[transitions.a_failed]
in = ["a:error"]
out = ["free"]
"""
    ahead = SERIES.replace("runs_place =", 'goal_transitions = ["a_goal"]\nruns_place =')
    return loads(ahead + text, "series")


def of_causes(*causes: tuple[int, str, Executed]) -> Tally:
    """Return a tally of 70 successes and of as many errors of each cause."""
    known = tally(70, 0, 0, 1.0)
    for n, cause, executed in causes:
        for _ in range(n):
            known = known.adding(Observation(Status.ERROR, 1.0, cause, executed))
    return known


def test_the_forecast_and_learned_task_use_the_measured_causes() -> None:
    """20 of 100 runs jammed and 10 slipped; drawn at equal shares it would be 15."""
    known = of_causes((20, "jam", Executed.YES), (10, "slip", Executed.YES))
    estimates = Estimates({TallyKey("a", "do_a"): known})
    task = by_cause("a.reason == 'jam'")
    found = exact(task, estimates, "", {"a": {"do_a": 1.0}})
    assert found["R_goal"] == pytest.approx(0.2, rel=1e-4), found
    assert propagate(task, estimates).forecast.goal_reliability == pytest.approx(0.2, rel=1e-4)


@pytest.mark.parametrize("cv", [0.0, 0.45, 1.5])
def test_the_interval_of_p_complete_does_not_depend_on_the_duration(cv: float) -> None:
    """150 of 200 runs succeed, the others end the task; a duration may have two branches."""
    random, known = np.random.default_rng(3), Tally()
    for i in range(200):
        seconds = float(random.gamma(1 / cv**2, 2 * cv**2)) if cv else 2.0
        status = Status.SUCCESS if i < 150 else Status.ERROR
        known = known.adding(Observation(status, seconds, "why" * (i >= 150)))
    task = series(1)
    lost = replace(task.transitions["a_failed"], outputs=(Output("lost"),))
    task = replace(
        task,
        places={**task.places, "lost": Place("lost", Kind.CONTROL)},
        transitions={**task.transitions, "a_failed": lost},
        final_error=parse("lost == 1"),
    )
    found = exact(task, Estimates({TallyKey("a", "do_a"): known}), "", {"a": {"do_a": 1.0}})
    half = 1.96 * sqrt(0.25 / 0.75 / 200)
    assert found["P_complete_interval"] == pytest.approx([0.75 * exp(-half), 0.75 * exp(half)])


def test_executed_unknown_is_kept_by_cause() -> None:
    """All 20 jams are unknown and no slip is. A file that has only their number shares it."""
    known = of_causes((20, "jam", Executed.UNKNOWN), (10, "slip", Executed.YES))
    task = by_cause("a.reason == 'jam' and a.executed == 'unknown'")
    plain = known.to_plain()
    assert Tally.of_plain(plain) == known
    older = Tally.of_plain({k: v for k, v in plain.items() if k != "unknown_ends"})
    for kept, goal in ((known, 0.2), (older, 0.2 * 2 / 3), (known.merged(known), 0.2)):
        found = propagate(task, Estimates({TallyKey("a", "do_a"): kept})).forecast
        assert found.goal_reliability == pytest.approx(goal, rel=1e-4)


# --- competing risks --------------------------------------------------------------------------


def test_incidences_without_censoring_are_relative_frequencies() -> None:
    """They equal shares, means and variances of the sample itself."""
    found = incidences([1.0, 2.0, 2.0, 5.0], ["success", "success", "error", "success"])
    assert found["success"].share == pytest.approx(0.75)
    assert found["success"].mean == pytest.approx(8 / 3)
    assert found["success"].cv == pytest.approx(np.std([1, 2, 5]) / (8 / 3))
    assert found["error"].share == pytest.approx(0.25)
    assert found["error"].mean == pytest.approx(2.0)


def test_incidences_of_a_textbook_example() -> None:
    """Computed by hand: a at 1 (5 at risk), censored at 2, b at 3 (3 at risk), a at 4 (2 at risk),
    censored at 5."""
    found = incidences([1, 2, 3, 4, 5], ["a", None, "b", "a", None])
    a, b = 1 / 5 + (4 / 5) * (2 / 3) * (1 / 2), (4 / 5) * (1 / 3)
    assert found["a"].share == pytest.approx(a / (a + b))
    assert found["b"].share == pytest.approx(b / (a + b))
    assert incidences([], []) == {}


@pytest.mark.parametrize("cut", [0.0, 0.5, 2.0])
def test_incidences_are_unbiased_under_censoring(cut: float) -> None:
    """Two exponential causes (rates 2 and 1) with exponential censoring: shares 2/3 and 1/3, mean
    1/3, all unbiased; counting only the uncensored ends would give a wrong mean."""
    rng = np.random.default_rng(5)
    n = 20_000
    a, b = rng.exponential(1 / 2, n), rng.exponential(1.0, n)
    c = rng.exponential(1 / cut, n) if cut else np.full(n, np.inf)
    times = np.minimum(np.minimum(a, b), c)
    causes = [
        None if t == z else ("a" if t == x else "b") for t, x, z in zip(times, a, c, strict=True)
    ]
    found = incidences(times.tolist(), causes)
    assert found["a"].share == pytest.approx(2 / 3, abs=0.02)
    assert found["a"].mean == pytest.approx(1 / 3, abs=0.03)
    assert found["b"].cv == pytest.approx(1.0, abs=0.1 if cut < 1 else 0.25)
    if cut:
        naive = times[np.array([x is not None for x in causes])].mean()
        assert naive < 0.3


# --- preemption -------------------------------------------------------------------------------


def caught_or_missed(n: int, caught: int) -> Tally:
    """Return a tally of n runs: `caught` are preempted near 0.5 s and count as success, the others
    end as failures at 1.2 s."""
    rng = np.random.default_rng(1)
    out = Tally()
    for i in range(n):
        if i < caught:
            seen = Observation(Status.SUCCESS, 0.5 + 0.05 * rng.random(), preempted_by="jammed")
        else:
            seen = Observation(Status.FAILURE, 1.2, "missed")
        out = out.adding(seen, "x")
    return out


def test_a_preempting_event_is_a_cause_of_end_not_an_independent_race() -> None:
    """The event comes after half a second in 93 of 100 runs, or never. As a cause its share is
    exact; an independent exponential wait with the same mean would give 87 %."""
    task, _ = with_runs(sorting(), 1)
    estimates = Estimates(
        {
            TallyKey("pick", "pick_slow"): tally(1, 0, 0, 0.4),
            TallyKey("place", "place_soft"): caught_or_missed(100, 93),
        }
    )
    measured = measured_from(task, estimates)
    assert measured.preempted["place", "place_soft"]["jammed"].share == pytest.approx(0.93)
    few = forecast(stochastic_view(task, measured)).approximations
    assert any(text.startswith("place.place_soft.by.jammed: ") for text in few)
    found = forecast(stochastic_view(task, measured, stages=30))
    assert found.firings["jammed"] == pytest.approx(0.93, abs=1e-9)
    mean = 0.02 + 0.4 + 0.93 * measured.preempted["place", "place_soft"]["jammed"].mean + 0.07 * 1.2
    assert found.mission_time == pytest.approx(mean, rel=1e-6)
    race = replace(
        measured,
        preempted={},
        waits={"jam": measured.preempted["place", "place_soft"]["jammed"].mean},
    )
    assert forecast(stochastic_view(task, race)).firings["jammed"] < 0.88


def test_causes_leave_no_tokens_behind() -> None:
    """Every final marking is clean: the token of a preemption whose transition did not take the run
    is removed."""
    task, _ = with_runs(sorting(), 2)
    runs = {
        ("pick", "pick_slow"): {Status.SUCCESS: Estimate(1.0, 0.4)},
        ("place", "place_soft"): {},
    }
    choice = {"pick": {"pick_slow": 1.0}, "place": {"place_soft": 1.0}}
    measured = Measured(
        runs, choice, {}, {}, {("place", "place_soft"): {"jammed": Estimate(1.0, 0.5, 0.7)}}
    )
    view = stochastic_view(task, measured)
    found = forecast(view)
    assert found.completion_probability == pytest.approx(1.0)
    assert found.firings["jammed"] == pytest.approx(2.0)
    places, own = view.gspn.net.places, len(task.net.places)
    dirty = found.chain.space.where(
        lambda m: any(
            n and not p.endswith(".server") for p, n in zip(places[own:], m[own:], strict=True)
        )
    )
    assert found.done.goal.any()
    assert not np.any(dirty & found.done.goal)


def test_ends_at_the_deadline_are_known_by_their_cause() -> None:
    """They come at the deadline, later by the wait that was seen; runs that never began are errors,
    too. Nothing measured is taken for a declared estimate, though older files do not know which
    cause came with runs that may not have been executed."""
    out = Tally(unknown=1)
    for seconds, cause, executed in (
        (1.0, "slip", Executed.YES),
        (9.0, "deadline", Executed.YES),
        (9.0, "deadline", Executed.YES),
        (0.0, "unreachable", Executed.NO),
    ):
        seen = Observation(Status.ERROR, seconds, cause, executed, waited=0.5)
        out = out.adding(seen, "x")
    task = series(1)
    known = replace(task.primitive_tasks["a"], deadline=9.0)
    task = replace(task, primitive_tasks={"a": known})
    measured = measured_from(task, Estimates({TallyKey("a", "do_a"): out}))
    assert measured.late == {("a", "do_a"): Estimate(0.5, 9.5, 0.0)}
    assert not measured.expected and measured.mixed == {("a", "do_a")}


def test_places_that_end_runs_at_different_times_are_said_to_be_counted_together() -> None:
    """Runs are counted by primitive task, so each place has the mixture of all."""
    out = Tally().adding(Observation(Status.SUCCESS, 1.0), "x")
    task = series(1)
    (place,) = [p for p in task.places.values() if p.task == "a"]
    other = replace(place, name="other", task="a", timeout=0.5)
    both = replace(task, places={**task.places, "other": other})
    estimates = Estimates({TallyKey("a", "do_a"): out})
    told = [set(measured_from(t, estimates).sources.values()) for t in (task, both)]
    assert told[0] == {"measured in 1 run"}
    deadline = task.primitive_tasks["a"].deadline
    assert told[1] == {
        f"measured in 1 run, together at places that end runs after 0.5 s and {deadline:g} s"
    }


def test_an_aborted_run_is_censored() -> None:
    """Runs that the operator aborted are censored: shares follow from competing risks over the
    sample."""
    rng, out = np.random.default_rng(2), Tally()
    for _ in range(400):
        end, cut = rng.exponential(1.0), rng.exponential(2.0)
        status = Status.SUCCESS if rng.random() < 0.7 else Status.ERROR
        seen = (
            Observation(None, cut, preempted_by="")
            if cut < end
            else Observation(status, end, "why")
        )
        out = out.adding(seen, "x")
    law = measured_from(series(1), Estimates({TallyKey("a", "do_a"): out})).runs["a", "do_a"]
    assert law[Status.SUCCESS].share == pytest.approx(0.7, abs=0.06)
    assert law[Status.SUCCESS].mean == pytest.approx(1.0, abs=0.2)
    assert sum(e.share for e in law.values()) == pytest.approx(1.0)


# --- the whole loop ---------------------------------------------------------------------------


def test_the_forecast_of_a_learned_task_agrees_with_its_runs() -> None:
    """Run the sorting task, estimate, and build the stochastic view: firings and time agree with
    those of the runs."""
    task, n = sorting(), 150
    selector = LearningSelector(Learning(task, "round_robin"), seed=1)
    mission = run(task, selector, runs=n, seed=1)
    one, _ = with_runs(task, 1)
    found = propagate(one, selector.learning.estimates, "regime=A")
    fired = {k.transition: f.fired / n for k, f in selector.learning.estimates.flows.items()}
    for transition, share in fired.items():
        assert found.forecast.firings[transition] == pytest.approx(share, abs=0.02), transition
    assert found.forecast.mission_time == pytest.approx(
        (mission.ended - mission.begun) / n, rel=0.03
    )
    assert found.goal == pytest.approx(fired["placed"], abs=0.02)


def test_uniformly_censored_exponential_has_the_classic_rate() -> None:
    """lambda = ends / exposure, censored runs included (exponential case)."""
    rng, out = np.random.default_rng(3), Tally()
    for _ in range(3000):
        t = rng.exponential(2.0)
        seen = (
            Observation(Status.SUCCESS, t)
            if t < 1
            else Observation(None, 1.0, preempted_by="jammed")
        )
        out = out.adding(seen)
    exposure = sum(moments.total for moments in out.durations.values())
    assert exposure / out.runs == pytest.approx(2.0, rel=0.06)
    assert out.runs / (out.runs + out.censored) == pytest.approx(1 - exp(-0.5), abs=0.03)


def test_without_measured_preemptions_declared_waits_race() -> None:
    """As documented, declared waits race where no run was measured."""
    task, _ = with_runs(sorting(), 1)
    runs = {
        ("pick", "pick_slow"): {Status.SUCCESS: Estimate(1.0, 1.0)},
        ("place", "place_soft"): {Status.SUCCESS: Estimate(1.0, 1.0)},
    }
    choice = {"pick": {"pick_slow": 1.0}, "place": {"place_soft": 1.0}}
    view = stochastic_view(task, Measured(runs, choice, {"jam": 1.0}))
    chain = Chain.of(view.gspn)
    assert not any(".by." in p for p in view.gspn.net.places)
    assert forecast(view).firings["jammed"] == pytest.approx(0.5)
    assert completion(
        chain, chain.space.where(lambda m: view.projected(m) == (0, 1, 0, 0))
    ).probability == pytest.approx(1.0)
