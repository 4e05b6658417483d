"""The forecast of a task: three reliabilities, times, firings, and what is worth improving.

- P_complete: probability that `final` is reached.
- R_goal: probability that a trial meets its goal at least once. For several trials in a mission run
  it is the mean number of met goals for each run token, unless one token can meet several.
- R_conj: probability that the task completes and every run ends with SUCCESS.

P_complete, R_conj and times are those of a whole mission run, with all its run tokens; campaigns
count trials, which have one run token each: `Forecast.one_trial`.

Long-run numbers assume that mission runs follow each other without a pause. By the renewal reward
theorem they are the expected firings (or tokens times time) of one mission run, divided by its mean
length.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from typing import Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from petrobot.coordinator.analysis.limits import OutOfTime
from petrobot.coordinator.analysis.net.graph import Mask, sum_by
from petrobot.coordinator.analysis.net.ordinary import OrdinaryView
from petrobot.coordinator.analysis.net.space import SearchLimits
from petrobot.coordinator.analysis.time.completion import (
    Completion,
    CompletionTime,
    Slope,
    completion,
    completion_time,
    reliability_slopes,
    slopes_of,
    time_slopes,
)
from petrobot.coordinator.analysis.time.gspn import Chain, Gspn, Values
from petrobot.coordinator.analysis.time.linear import SolveOrder, solve
from petrobot.coordinator.analysis.time.markov import visits_before
from petrobot.coordinator.analysis.time.stochastic import STEP, StochasticView, timer_key
from petrobot.coordinator.task import Kind, Status
from petrobot.coordinator.task.net import Marking
from petrobot.coordinator.task.wording import few

SAME = 1e-9
"""Figures that differ by less are the same."""
ROUNDING = 1e-12
"""A derivative that is a smaller share of its figure is the rounding of the solution."""
MATTERS = 0.01
"""Share of the time of a mission run, or of a figure, above which an error of a fit is reported."""
GOALS = "goals per run"
"""Name of the mean number of met goals for each run token among the figures. It is R_goal, unless
one token can meet several goals."""
TIME = "mean time (s)"
"""Name of the mean time to completion among the figures."""


def rough_fits(
    errors: Mapping[str, float], shares: Mapping[str, float]
) -> list[tuple[str, float, float]]:
    """Return (duration, error of its 90 % quantile, share of the time) where the error matters:
    error times share is at least MATTERS. The most important one comes first."""
    found = [(key, error, shares.get(key, 0.0)) for key, error in errors.items()]
    matter = [one for one in found if abs(one[1]) * one[2] >= MATTERS]
    return sorted(matter, key=lambda one: -abs(one[1]) * one[2])


def timer_shares(view: StochasticView, throughput: Mapping[str, float]) -> dict[str, float]:
    """Return the share of the time of each timer, by its name in `fit_errors`, from the firings of
    the task's transitions per second."""
    return {
        timer_key(name): throughput.get(name, 0.0) * t.after
        for name, t in view.task.transitions.items()
        if t.after is not None
    }


def _unrounded(derivative: float, figure: float) -> float:
    return derivative if abs(derivative) > ROUNDING * figure else 0.0


class Worth(Struct, frozen=True):
    """What an improvement of one action of a place would bring (exact derivatives).

    `time_share`: per cent of the mean mission time saved per per cent of its durations; the
    bottleneck has the largest. The sum may exceed 1: fewer
    events come during shorter runs. `completion_gain`, `goal_gain`: change of P_complete and of the
    expected met goals per unit of probability moved from ERROR to SUCCESS (0 if it never ends with
    ERROR).
    """

    place: str
    action: str
    time_share: float
    completion_gain: float
    goal_gain: float


class Forecast(Struct, frozen=True, dict=True):
    """All numbers of one stochastic view. Times in seconds, given that the task completes."""

    view: StochasticView
    chain: Chain
    done: Completion
    transient: Mask
    flow: Values
    """Expected number of times that a mission run takes each edge."""

    @property
    def trials(self) -> int:
        """Run tokens of a mission run; 1 for a task without a runs place."""
        net, place = self.chain.gspn.net, self.view.task.runs_place
        return net.initial[net.place_index[place]] if place else 1

    @cached_property
    def one_trial(self) -> Forecast:
        """The forecast of a mission run with one run token: what a campaign measures, whose figures
        are per trial. As there, its time begins when the token is taken, so without the wait before
        it, and a token that is given back is not taken again. Its long-run numbers do not hold for
        missions of several trials."""
        return trial_forecast(self.view) if self.view.task.runs_place else self

    @property
    def returning(self) -> frozenset[str]:
        """The transitions that give the run token back, which the next trial takes."""
        return _returning(self.view)

    @property
    def later(self) -> tuple[str, ...]:
        """Why the time of one trial is longer here than in a campaign; empty if it is not."""
        flat, own = self.view.task.flat, {self.view.task.runs_place}
        resources = {p.name for p in flat.places.values() if p.kind is Kind.RESOURCE}
        moves = [
            ({a.place for a in t.inputs}, {o.place for o in t.outputs} - resources, t)
            for t in flat.transitions.values()
        ]
        while more := {p for taken, given, _ in moves if taken & own for p in given} - own:
            own |= more
        names = [
            t.name
            for taken, _, t in moves
            if t.events and taken.isdisjoint(own) and taken & (resources | flat.final.names)
        ]
        if not names or not self.view.task.runs_place:
            return ()
        text = "a trial ends here with `final`, in a campaign when its own tokens are back"
        return (f"{text}: {few(names)} may keep what `final` asks for",)

    @property
    def figures(self) -> dict[str, float]:
        """What another model must have, too: P_complete, the goals for each run (if they are
        defined), R_conj and the mean time to completion (s)."""
        return {
            "P_complete": self.completion_probability,
            **({} if self.goals is None else {GOALS: self.goals}),
            "R_conj": self.conjunctive_reliability,
            TIME: self.done.mean,
        }

    @property
    def told(self) -> dict[str, float]:
        """The figures for people: R_goal, where it is defined, and the mean number of goals only
        where that is another figure."""
        goal = self.goal_reliability
        return {
            "P_complete": self.completion_probability,
            **({} if goal is None else {"R_goal": goal}),
            **({} if self.goals is None or goal == self.goals else {GOALS: self.goals}),
            "R_conj": self.conjunctive_reliability,
            TIME: self.done.mean,
        }

    @property
    def completion_probability(self) -> float:
        """P_complete."""
        return self.done.probability

    @cached_property
    def completion_error(self) -> float:
        """Bound of the relative error of P_complete that solving left: residuals of its equation
        and the rounding of its terms, each weighted with the expected visits to its marking.

        With h' the exact solution, h' - h = (I - A)^-1 r, and row 0 of that inverse are the
        expected visits. So the bound holds for probabilities of any size.
        """
        chain, h = self.chain, self.done.h
        if h[0] <= 0.0:
            return 0.0
        inside = (h > 0) & ~self.done.goal
        ahead = np.where(inside[chain.source], chain.probability * h[chain.target], 0.0)
        off = np.abs(sum_by(chain.source, ahead, chain.n) - np.where(inside, h, 0.0))
        # Terms are positive: a row of n terms is rounded by at most n + 1, its coefficients by 2.
        terms = np.bincount(chain.source, minlength=chain.n)
        off += np.finfo(np.float64).eps * (terms + 3) * h
        visits = visits_before(chain, inside)
        return float(np.where(inside, visits * off, 0.0).sum() / h[0])

    @cached_property
    def firings(self) -> dict[str, float]:
        """Expected firings of each transition of the task in one mission run."""
        names = self.chain.gspn.net.transitions
        count = sum_by(self.chain.label, self.flow, len(names))
        out = dict.fromkeys(self.view.task.net.transitions, 0.0)
        for case, name in self.view.origin.items():
            out[name] += float(count[self.chain.gspn.net.transition_index[case]])
        return out

    @cached_property
    def mission_time(self) -> float:
        """Mean length of a mission run (s), whether it completes or not."""
        return float(self._time.sum())

    @cached_property
    def _time(self) -> Values:
        """Expected time spent in each marking in one mission run (s)."""
        visits = visits_before(self.chain, self.transient)
        spent: Values = np.where(
            self.transient, visits * np.where(self.transient, self.chain.sojourn, 0.0), 0.0
        )
        return spent

    def _per_second(self, value: float) -> float:
        """Return a sum over a mission run by its length; 0 for one without a length: it ends as
        soon as it begins, or can never end, so that no part of it comes before the last."""
        return value / self.mission_time if self.mission_time else 0.0

    @cached_property
    def throughput(self) -> dict[str, float]:
        """Firings per second of each transition of the task, mission runs without pauses."""
        return {name: self._per_second(n) for name, n in self.firings.items()}

    @cached_property
    def mean_tokens(self) -> dict[str, float]:
        """Time average of the tokens of each place of the task, mission runs without pauses."""
        space = self.chain.space
        places = enumerate(self.view.task.net.places)
        return {name: self._per_second(float(self._time @ space.tokens(p))) for p, name in places}

    @cached_property
    def occupancy(self) -> dict[str, float]:
        """Share of the time in which each place of the task is marked, mission runs without
        pauses."""
        space = self.chain.space
        places = enumerate(self.view.task.net.places)
        return {
            name: self._per_second(float(self._time @ (space.tokens(p) > 0))) for p, name in places
        }

    @property
    def approximations(self) -> list[str]:
        """What the fit of a distribution may change in the text above, most important first.

        An error of the 90 % quantile matters as far as its duration has a share in the time of a
        mission run; less than MATTERS of it is left out.
        """
        of_action = {(w.place, w.action): w.time_share for w in self.worth}
        gspn, shares = self.view.gspn, dict[str, float]()
        for label, (key, place, action) in self.view.begins.items():
            chosen = gspn.weight[gspn.net.transition_index[label]]
            shares[key] = shares.get(key, 0.0) + chosen * of_action.get((place, action), 0.0)
        shares |= timer_shares(self.view, self.throughput)
        return [
            f"{key}: its 90 % quantile is {100 * error:+.0f} % off, because a duration has few "
            f"phases; it has {100 * share:.0f} % of the time"
            for key, error, share in rough_fits(self.view.fit_errors, shares)
        ]

    @cached_property
    def goal_reliability(self) -> float | None:
        """R_goal; None if the task names no goal transitions or no runs place, or if one of several
        run tokens can meet several goals: then no state says which of them has met one."""
        goals, alone = self.goals, self
        if self.trials != 1:
            alone = trial_forecast(self.view, again=True) if self.returning else self.one_trial
        if goals is None or alone.goals is None:
            return None
        once = alone._meets_goal
        if abs(alone.goals - once) <= SAME:  # solved in two ways, the same figure has other digits
            return goals
        return once if self.trials == 1 else None

    @cached_property
    def goals(self) -> float | None:
        """Mean number of met goals for each run token; None if the task names no goal transitions
        or no runs place."""
        task = self.view.task
        if not task.goal_transitions or not task.runs_place or not self.trials:
            return None
        return sum(self.firings[name] for name in task.goal_transitions) / self.trials

    @property
    def _meets_goal(self) -> float:
        """Probability that a goal is met at least once."""
        goals, origin = self.view.task.goal_transitions, self.view.origin
        meets = np.array([origin.get(n) in goals for n in self.chain.gspn.net.transitions])
        return self._reaches(meets[self.chain.label], ~meets[self.chain.label])

    @cached_property
    def conjunctive_reliability(self) -> float:
        """R_conj: probability of completing while every run ends with SUCCESS."""
        index = self.chain.gspn.net.transition_index
        spoilt = np.isin(self.chain.label, [index[name] for name in self.view.spoils])
        clean = self._reaches(self.done.goal[self.chain.target] & ~spoilt, ~spoilt)
        return 1.0 if self.done.goal[0] else clean

    def _reaches(self, last: Mask, before: Mask) -> float:
        """Return the probability of taking one of the `last` edges, after edges in `before`."""
        open_ = self.transient[self.chain.source]
        inside = open_ & before & self.transient[self.chain.target]
        value, direct = np.where(inside, self.chain.probability, 0.0), open_ & last
        arrive = sum_by(self.chain.source[direct], self.chain.probability[direct], self.chain.n)
        return float(solve(SolveOrder.of(self.chain.graph, self.transient), value, arrive)[0])

    @cached_property
    def worth(self) -> tuple[Worth, ...]:
        """The actions worth improving, the largest share of time first."""
        time, complete, goals = (
            time_slopes(self.done),
            reliability_slopes(self.done),
            self._goal_slopes(),
        )
        actions = dict.fromkeys((place, action) for place, action, _ in self.view.statuses.values())
        by_place: dict[str, list[tuple[str, str]]] = {}
        for key in actions:
            by_place.setdefault(key[0], []).append(key)
        found = []
        for place, keys in by_place.items():
            whole = -sum(time[name].elasticity for name in self._phases(place))
            share = self._use(keys)
            for key in keys:
                time_share = _unrounded(whole * share[key], 1.0)
                gain = _unrounded(self._move(key, complete), self.completion_probability)
                met = _unrounded(self._move(key, goals), self.goals or 1.0)
                found.append(Worth(*key, time_share, gain, met))
        return tuple(sorted(found, key=lambda w: -w.time_share))

    def _phases(self, place: str) -> list[str]:
        """Return the timed transitions that are phases of the runs of a place."""
        gspn = self.chain.gspn
        return [
            name
            for name, rate in zip(gspn.net.transitions, gspn.rate, strict=True)
            if rate is not None
            and name not in self.view.origin
            and name.startswith((f"{place}.by.", *(f"{place}.{s}." for s in Status)))
        ]

    def _use(self, keys: list[tuple[str, str]]) -> dict[tuple[str, str], float]:
        """Return the share of each action in the runs of its place.

        Actions with equal duration distributions share their phases, so the time cannot be measured
        per action and is divided by these shares.
        """
        count = sum_by(self.chain.label, self.flow, len(self.chain.gspn.net.transitions))
        index = self.chain.gspn.net.transition_index
        runs = {key: float(count[index[f"{key[0]}.{key[1]}"]]) for key in keys}
        total = sum(runs.values())
        return {key: n / total if total else 0.0 for key, n in runs.items()}

    def _move(self, key: tuple[str, str], slopes: Mapping[str, Slope]) -> float:
        """Return the derivative for probability moved from ERROR to SUCCESS of one action."""

        def gain(status: Status) -> float | None:
            names = [
                n
                for n, (place, action, s) in self.view.statuses.items()
                if (place, action, s) == (*key, status)
            ]
            weight = sum(slopes[n].value for n in names)
            return (
                sum(slopes[n].derivative * slopes[n].value for n in names) / weight
                if weight
                else None
            )

        better, worse = gain(Status.SUCCESS), gain(Status.ERROR)
        return better - worse if better is not None and worse is not None else 0.0

    def _goal_slopes(self) -> dict[str, Slope]:
        """Return the derivatives of the expected number of met goals, by transition."""
        chain, goals = self.chain, set(self.view.task.goal_transitions)
        names = chain.gspn.net.transitions
        hits = np.array([self.view.origin.get(name) in goals for name in names], bool)[chain.label]
        inside = self.transient[chain.source]
        value = np.where(inside & self.transient[chain.target], chain.probability, 0.0)
        gain = sum_by(chain.source, np.where(inside & hits, chain.probability, 0.0), chain.n)
        g = solve(SolveOrder.of(chain.graph, self.transient), value, gain)
        ahead = np.where(self.transient[chain.target], g[chain.target], 0.0)
        by_edge = self.flow * (hits + ahead - g[chain.source])
        return slopes_of(chain, by_edge, float(g[0]))

    @cached_property
    def recovery_time(self) -> float | None:
        """The longest mean time back to the nominal flow (s), over all markings that can return; 0
        if no marking leaves it, None if none that does can return."""
        ordinary = OrdinaryView(self.view.task)
        nominal = (
            self.chain.space.where(lambda m: ordinary.is_nominal(self.view.projected(m)))
            & ~self.chain.vanishing
        )
        back = completion(self.chain, nominal)
        outside = ~nominal & ~self.chain.vanishing
        able = (back.h > 0) & ~nominal
        if outside.any() and not able[outside].any():
            return None
        return float(np.max(back.y[able] / back.h[able], initial=0.0))

    @cached_property
    def completion_time(self) -> CompletionTime:
        """Return the distribution of the time to completion."""
        return completion_time(self.chain, self.done.goal)

    def quantiles(self, *shares: float) -> dict[str, float]:
        """Return quantiles of the completion time (s) by share; none if no run completes, or if
        the time limit passes before they are known."""
        try:
            shape = self.completion_time if shares and self.completion_probability > 0 else None
        except OutOfTime:
            shape = None
        return {f"{q:g}": shape.quantile(q) for q in shares} if shape else {}

    def to_json(self, quantiles: tuple[float, ...] = (0.5, 0.9, 0.99)) -> dict[str, Any]:
        """Return plain data. Quantiles need a uniformisation; pass none to save its time."""
        return {
            "P_complete": self.completion_probability,
            "P_complete_error": self.completion_error,
            "R_goal": self.goal_reliability,
            "goals_per_run": self.goals,
            "R_conj": self.conjunctive_reliability,
            "mean": self.done.mean,
            "standard_deviation": self.done.variance**0.5,
            "quantiles": self.quantiles(*quantiles),
            "trials": self.trials,
            "one_trial": self.one_trial.told,
            "mission_time": self.mission_time,
            "recovery_time": self.recovery_time,
            "firings": self.firings,
            "worth": [
                {"place": w.place, "action": w.action, "time_share": w.time_share,
                 "completion_gain": w.completion_gain, "goal_gain": w.goal_gain} for w in self.worth
            ],
            "markings": self.chain.n,
            "residual": self.done.residual,
            "assumptions": list(self.view.assumptions),
            "fit_errors": dict(self.view.fit_errors),
            "sources": {source: list(names) for source, names in self.view.numbers.items()},
        }  # fmt: skip


def trial_forecast(
    view: StochasticView, limits: SearchLimits | None = None, *, again: bool = False
) -> Forecast:
    """Return the forecast of one trial: with one run token if the task has a runs place, and all
    times from when that token is taken. `again`: one that is given back is taken again. Raises as
    `forecast`."""
    own = view.task.runs_place
    if not own:
        return forecast(view, limits=limits)
    gspn = (view.gspn if again else _until_back(view)).marked({own: 1})
    alone = forecast(replace(view, gspn=gspn), limits=limits)
    chain = alone.chain
    waiting = chain.space.tokens(view.task.net.place_index[own]) > 0
    waiting &= np.bincount(chain.source, minlength=chain.n) > 0
    chain = replace(chain, vanishing=chain.vanishing | waiting)  # no time passes before
    return replace(alone, chain=chain, done=completion(chain, alone.done.goal))


def _returning(view: StochasticView) -> frozenset[str]:
    """Return the transitions of the task that give the run token back."""
    net, own = view.task.net, view.task.runs_place
    place = net.place_index[own] if own else -1
    changes = zip(net.transitions, net.compiled.changes, strict=True)
    return frozenset(name for name, moved in changes if dict(moved).get(place, 0) > 0)


def _until_back(view: StochasticView) -> Gspn:
    """Return the view's net, in which a run token that is given back is gone: a trial ends then."""
    net, back = view.gspn.net, _returning(view)
    if not back:
        return view.gspn
    own = net.place_index[view.task.runs_place]
    produce = tuple(
        tuple(arc for arc in arcs if arc[0] != own)
        if view.origin.get(name.removesuffix(STEP)) in back
        else arcs
        for name, arcs in zip(net.transitions, net.produce, strict=True)
    )
    return replace(view.gspn, net=replace(net, produce=produce))


def forecast(view: StochasticView, *, limits: SearchLimits | None = None) -> Forecast:
    """Solve a stochastic view.

    Raises ValueError if its space is not complete within the limits (then simulate).
    """
    chain = Chain.of(view.gspn, limits=limits)
    goal, given_up = (
        chain.space.where(partial(_ends, view, status)) & ~chain.vanishing
        for status in (Status.SUCCESS, Status.ERROR)
    )
    kept = ~(goal | given_up)[chain.source]  # a mission run that has ended stays where it is
    chain = Chain(
        chain.gspn,
        chain.space,
        chain.source[kept],
        chain.target[kept],
        chain.label[kept],
        chain.amount[kept],
        chain.vanishing,
    )
    transient = ~chain.graph.bottom[chain.graph.components] & ~goal
    visits = np.where(transient, visits_before(chain, transient), 0.0)
    return Forecast(
        view, chain, completion(chain, goal), transient, visits[chain.source] * chain.probability
    )


def _ends(view: StochasticView, status: Status, marking: Marking) -> bool:
    return view.ended(marking) is status
