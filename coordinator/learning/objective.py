"""The cost function J = 1 - A R + rho C of primitive actions, and questions about it (paper,
section 3).

Over several scenarios an action is judged by its worst case. R is its reliability in the scenario
that is hardest for it, never the share over all its runs: actions that were run in unequal shares
of easy and hard scenarios would be put in the wrong order (E. H. Simpson, J. Royal Statistical
Society B 13 (1951) 238). C is its mean cost in the hardest scenario whose reliability is not below
the target R_d; the lower confidence bound decides which scenarios these are. rho is 1 / max C over
the actions of the one primitive task, or declared. All J of a comparison are computed from sums
with one rho; J values made with different rho are never averaged. Intervals of J hold for that rho.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from math import inf, isfinite, isnan, nan, sqrt
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from petrobot.coordinator.learning.estimate import Tally, TrialSums
from petrobot.coordinator.learning.statistics import (
    joined,
    lowest_share,
    mean_interval,
    objective_interval,
    runs_needed,
    wilson,
)

SURER = 1.2
"""Factor of the interval of a difference, for two J that are to be told apart. The intervals of R
are approximate: with 2 to 60 runs each, and without this factor, one of two equal actions has the
lower J "for sure" in up to 12.5 % of cases (2 of 2 beside 0 of 2), with it in at most 3.1 %."""


class Question(Struct, frozen=True):
    """What is asked: cost measure, target reliability R_d, rho (None: 1 / max C) and confidence
    level."""

    measure: str = "wall"
    target: float | None = None
    rho: float | None = None
    level: float = 0.95
    declared: tuple[tuple[str, float], ...] = ()
    """Costs that the task file declares, by action, in the unit of its own measure: C of an action
    without a measured cost."""

    def declared_cost(self, action: str) -> float:
        """Return the declared cost of an action; nan if there is none."""
        return dict(self.declared).get(action, nan)


class Figures(Struct, frozen=True):
    """Figures of one action in one comparison. Costs are in the unit of the measure."""

    action: str
    runs: int
    """Number of judged runs in all scenarios."""
    reliability: float
    """R in the scenario that is hardest for the action; nan without any run."""
    lower: float
    upper: float
    """Bounds of the confidence interval of that R. Over several scenarios it is simultaneous: it
    covers the lowest of all R, whichever that is."""
    worst: str | None
    """The scenario that is hardest for the action; None without any run."""
    availability: float
    """A over all scenarios: whether a node is available does not depend on the scenario."""
    cost: float
    """C; nan if nothing is known, inf if no scenario meets the target although some other action
    meets it."""
    scenario: str | None
    """The hardest scenario that still meets the target (s*); None if none does."""
    scenarios: tuple[str, ...]
    """All scenarios that meet the target."""
    largest_cost: float
    """The largest mean cost over the scenarios that meet the target."""
    j: float
    """J with the common rho of the comparison; inf for an inadmissible action, nan if nothing is
    known."""
    j_lower: float = nan
    j_upper: float = nan
    """Bounds of the confidence interval of J for that rho, from the joint spread of success and
    cost over the same runs; nan where a single run gives no spread of the cost."""
    cost_lower: float = nan
    cost_upper: float = nan
    """Bounds of the confidence interval of C."""
    correlation: float = 0.0
    """Of success and cost within a run."""
    available: tuple[float, float] = (1.0, 1.0)
    """Bounds of the confidence interval of A."""
    needed: int | None = None
    """Number of runs in the hardest scenario with which its R, if it stays so, surely reaches the
    target; None if R is not above the target, or if there is none."""

    @property
    def effective(self) -> float:
        """A R: the probability that a started run succeeds."""
        return self.availability * self.reliability

    @property
    def admissible(self) -> bool:
        """Whether some scenario meets the target."""
        return self.scenario is not None


class Comparison(Struct, frozen=True):
    """The alternatives of one primitive task compared with each other, in the given order."""

    rho: float
    figures: tuple[Figures, ...]
    scenarios: tuple[str, ...]
    """The scenarios in which every action with runs was run; the comparison is over these. If it is
    empty, each action was judged over its own scenarios, and the order means little."""
    unmet: bool
    """True if no action meets the target in any scenario; J was then computed without the
    target."""

    @property
    def uncosted(self) -> tuple[str, ...]:
        """Actions with runs of which none reported a cost: J takes their cost as 0."""
        return tuple(f.action for f in self.figures if f.runs and isnan(f.cost))

    @property
    def best(self) -> str | None:
        """The action with the lowest J, among the admissible ones if there are any; None while
        nothing is known."""
        known = [f for f in self.figures if not isnan(f.j) and f.j < inf]
        return min(known, key=lambda f: f.j).action if known else None

    @property
    def level_with_best(self) -> tuple[str, ...]:
        """The other actions whose J may equal the lowest one: the interval of the
        difference contains 0, or is not known. The runs of two actions are taken as independent."""
        if self.best is None:
            return ()
        best = self.of(self.best)
        return tuple(
            f.action
            for f in self.figures
            if f.action != best.action
            and f.j < inf
            and not f.j - best.j > SURER * joined(f.j - f.j_lower, best.j_upper - best.j)
        )

    @property
    def clear(self) -> bool:
        """Whether the lowest J is lower than every other, and not by chance."""
        known = sum(not isnan(f.j) for f in self.figures)
        return known > 1 and not self.level_with_best

    def of(self, action: str) -> Figures:
        """Return the figures of one action. Raises KeyError."""
        for figures in self.figures:
            if figures.action == action:
                return figures
        raise KeyError(action)


def cost_weight(costs: Iterable[float]) -> float:
    """Return the paper's typical rho: 1 / max C over the actions with a known cost; 0 if none is
    above 0."""
    largest = max((c for c in costs if not isnan(c) and c < inf), default=0.0)
    return 1.0 / largest if largest > 0 else 0.0


def common_weight(questions: Iterable[Question]) -> float | None:
    """Return the rho of a whole task: that of all these questions; None if they have none, or not
    the same one."""
    given = {question.rho for question in questions}
    return given.pop() if len(given) == 1 else None


def objective(reliability: float, cost: float, rho: float, availability: float = 1.0) -> float:
    """Return J = 1 - A R + rho C."""
    return 1.0 - availability * reliability + rho * cost


# --- scenarios --------------------------------------------------------------------------------


def admitted(
    by_scenario: Mapping[str, Tally], target: float | None, level: float = 0.95
) -> tuple[str, ...]:
    """Return the scenarios in which the lower confidence bound of an action's R reaches the target;
    without a target, all scenarios with runs."""
    return tuple(
        scenario
        for scenario, tally in sorted(by_scenario.items())
        if tally.judged and (target is None or tally.interval(level)[0] >= target)
    )


def hardest(by_scenario: Mapping[str, Tally], inside: Sequence[str]) -> str | None:
    """Return the scenario with the lowest reliability among those given; None if there is none."""
    return min(inside, key=lambda s: (by_scenario[s].reliability, s), default=None)


def compare(actions: Mapping[str, Mapping[str, Tally]], question: Question) -> Comparison:
    """Compare the alternatives of a primitive task. `actions`: the tallies of each action by
    scenario.

    All actions are judged over the scenarios in which all of them were run: R in the worst of
    these, C in the hardest admitted one. While no action meets the target in any scenario, none is
    ruled out.
    """
    common = shared(actions)
    over = {
        a: {s: t for s, t in by.items() if not common or s in common} for a, by in actions.items()
    }
    inside = {a: admitted(by, question.target, question.level) for a, by in over.items()}
    unmet = not any(inside.values())
    rows = []
    for action, by_scenario in over.items():
        whole = reduce(Tally.merged, actions[action].values(), Tally())
        rows.append(_row(action, whole, by_scenario, inside[action], question, unmet))
    rho = cost_weight(f.cost for f in rows) if question.rho is None else question.rho
    known = any(f.runs for f in rows)
    return Comparison(rho, tuple(_judged(f, rho) for f in rows), common, unmet and known)


def shared(actions: Mapping[str, Mapping[str, Tally]]) -> tuple[str, ...]:
    """Return the sorted scenarios in which every action that has runs was run."""
    run = [{s for s, t in by.items() if t.judged} for by in actions.values()]
    return tuple(sorted(set.intersection(*known))) if (known := [s for s in run if s]) else ()


def _row(
    action: str,
    whole: Tally,
    by_scenario: Mapping[str, Tally],
    inside: tuple[str, ...],
    question: Question,
    unmet: bool,
) -> Figures:
    """Return the figures of one action; J is filled in later, when the common rho is known."""
    known = {s: t for s, t in by_scenario.items() if t.judged}
    worst = hardest(known, tuple(known))
    there = known[worst] if worst is not None else Tally()
    among = tuple(known) if unmet else inside
    scenario = hardest(known, among)
    declared = question.declared_cost(action)
    costs = {s: _mean_cost(known[s], question.measure, declared) for s in among}
    cost = costs[scenario] if scenario is not None else (inf if known else declared)
    largest = max((c for c in costs.values() if not isnan(c)), default=cost)
    level, counts = question.level, [(t.successes, t.judged) for t in known.values()]
    # The scenario of C is a choice among several as well, so its interval is as strict.
    strict = 1.0 - (1.0 - level) / max(1, len(known))
    spent = known[scenario].cost(question.measure) if scenario is not None else None
    started = whole.runs + whole.censored + sum(whole.not_executed.values())
    executed = whole.runs + whole.censored
    return Figures(
        action,
        whole.judged,
        there.reliability,
        *(lowest_share(counts, level) if counts else (0.0, 1.0)),
        worst,
        whole.availability,
        cost,
        scenario if inside else None,
        inside,
        largest,
        nan,
        nan,
        nan,
        *(mean_interval(spent, strict) if spent is not None and spent.n else (cost, cost)),
        # success and cost of different scenarios are independent
        there.cost_correlation(question.measure) if scenario == worst else 0.0,
        wilson(executed, started, level) if executed < started else (1.0, 1.0),
        None
        if question.target is None or not known
        else runs_needed(there.reliability, question.target, level),
    )


def _mean_cost(tally: Tally, measure: str, declared: float) -> float:
    moments = tally.cost(measure)
    return moments.mean if moments.n else declared


def _judged(figures: Figures, rho: float) -> Figures:
    if isnan(figures.reliability):
        return figures
    cost = 0.0 if isnan(figures.cost) else figures.cost
    if cost == inf:
        return replace(figures, j=inf)
    f = figures
    low, high = (
        joined(f.availability * of_r, f.reliability * of_a)
        for of_r, of_a in (
            (f.reliability - f.lower, f.availability - f.available[0]),
            (f.upper - f.reliability, f.available[1] - f.availability),
        )
    )
    effective = (f.effective, f.effective - low, f.effective + high)
    bounds = objective_interval(effective, (f.cost, f.cost_lower, f.cost_upper), rho, f.correlation)
    j = objective(f.reliability, cost, rho, f.availability)
    return replace(f, j=j, j_lower=bounds[0], j_upper=bounds[1])


# --- questions --------------------------------------------------------------------------------


def break_even(one: Figures, other: Figures) -> float | None:
    """Return the rho above 0 at which two actions have the same J; None if there is none. Below it
    the more reliable action is better.

    `one` beats `other` iff A R_one - A R_other > rho (C_one - C_other).
    """
    gain, price = one.effective - other.effective, one.cost - other.cost
    if price == 0 or isnan(price) or isnan(gain) or price in (inf, -inf):
        return None
    rho = gain / price
    return rho if rho > 0 else None


def pareto(figures: Iterable[Figures]) -> tuple[Figures, ...]:
    """Return the actions that no other action beats in both reliability and cost, cheapest
    first."""
    known = sorted(
        (f for f in figures if not isnan(f.effective) and f.cost < inf),
        key=lambda f: (f.cost, -f.effective, f.action),
    )
    front: list[Figures] = []
    for f in known:
        if not front or f.effective > front[-1].effective:
            front.append(f)
    return tuple(front)


def cost_to_reach(figures: Iterable[Figures], target: float) -> Figures | None:
    """Return the cheapest action whose reliability reaches the target; None if none does."""
    enough = [f for f in figures if f.effective >= target and f.cost < inf]
    return min(enough, key=lambda f: (f.cost, -f.effective, f.action), default=None)


def reliability_for(figures: Iterable[Figures], budget: float) -> Figures | None:
    """Return the most reliable action whose cost is within the budget; None if none is."""
    payable = [f for f in figures if f.cost <= budget and not isnan(f.effective)]
    return max(payable, key=lambda f: (f.effective, -f.cost), default=None)


# --- the whole task ---


class TaskFigures(Struct, frozen=True):
    """R, C and J of a whole task as its trials measured them. A number is followed by the bounds of
    its interval. C, rho and J are None if they are not known."""

    context: str
    """The one in which R is lowest."""
    trials: int
    """Trials there."""
    reliability: tuple[float, float, float]
    """R_conj: the trial completed and every run was a SUCCESS."""
    cost: tuple[float, float, float] | None = None
    """Expected cost of a trial, the sum over its runs."""
    rho: float | None = None
    j: tuple[float, float, float] | None = None

    def to_plain(self) -> dict[str, Any]:
        """Return plain data for the results of commands."""
        names = {"R_conj": self.reliability, "C": self.cost, "J": self.j}
        found: dict[str, Any] = {"context": self.context, "trials": self.trials}
        for name, number in names.items():
            found[name] = None if number is None else round(number[0], 6)
            found[f"{name}_interval"] = number and [round(x, 6) for x in number[1:]]
        return found | {"rho": None if self.rho is None else round(self.rho, 9)}


def task_figures(
    trials: Mapping[str, TrialSums],
    measures: Mapping[str, str],
    compared: Mapping[str, Comparison],
    rho: float | None,
) -> TaskFigures | None:
    """Return R_conj, C and J of a whole task, as its trials measured them by context; None without
    trials.

    The definition is that of `learned task`, which composes them from the actions' estimates: over
    several contexts the task is judged in the one in which its R_conj is lowest, C is the expected
    cost of a trial there, and rho is the given one, else 1 / C with the alternatives that cost
    most. (Composed, C of an action is that of the hardest context that meets its target, if it has
    one; trials cannot be taken apart so.) C and J are None if the primitive tasks measure different
    costs, or if not all trials reported theirs; J also if no cost is known of a primitive task
    (after `learned reset`, for example). `measures` and `compared`: by primitive task, its
    cost measure and the comparison of its actions.
    """
    begun = {context: sums for context, sums in trials.items() if sums.n}
    if not begun:
        return None
    context = min(begun, key=lambda name: (begun[name].success / begun[name].n, name))
    hardest = begun[context]
    n, r, cost = hardest.n, hardest.success / hardest.n, hardest.cost
    bounds = lowest_share([(one.success, one.n) for one in begun.values()])
    found = TaskFigures(context, n, (r, *bounds))
    if len({measures[name] for name in hardest.runs}) != 1 or cost.n < n or n < 2:
        return found
    largest = sum(
        k / n * max((f.cost for f in compared[name].figures if isfinite(f.cost)), default=nan)
        for name, k in hardest.runs.items()
    )
    # the cost in the context that happens to be the hardest of m: at level 1 - 0.05 / m
    c = (cost.mean, *mean_interval(cost, 1.0 - 0.05 / len(begun)))
    if rho is None and isnan(largest):
        return replace(found, cost=c)
    weight = rho if rho is not None else 1.0 / largest if largest > 0 else 0.0
    # correlation of success and cost within a trial: they come from the same trials
    spread = sqrt(r * (1.0 - r) * cost.m2 / n)
    joint = r * (hardest.good_cost.mean - cost.mean) / spread if spread > 0 else 0.0
    below, above = objective_interval((r, *bounds), c, weight, joint)
    return replace(found, cost=c, rho=weight, j=(objective(r, cost.mean, weight), below, above))
