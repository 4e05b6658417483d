"""The execution graph as a Markov chain: how probable each edge is, and how long it takes.

A state of the chain is a state of the execution graph with a clock for each active run and each
armed timer. A run draws its action and its status when it starts, and then takes the phase-type
duration of that status; a timer takes an Erlang duration; an awaited event and an internal event
come after an exponential wait. Choices, draws and stops take no time. The numbers, those of the
causes by which runs end among them, are those of the stochastic view (`time.measured`). What a
run writes is not measured: values that lead to different firings are equally likely, unless the
frequency of a condition was measured.

`played` plays missions on the same states with clocks that are not divided into phases: a timer
takes exactly its time, and a declared duration of cv 0 always the same. So it shows what the few
phases of the chain, and of the stochastic view, do to a figure.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterator, Sequence
from functools import cached_property
from itertools import product
from math import inf, sqrt
from typing import TypeVar

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from petrobot.coordinator.analysis.execution.graph import ExecutionGraph
from petrobot.coordinator.analysis.execution.names import Cause
from petrobot.coordinator.analysis.limits import keep_time
from petrobot.coordinator.analysis.net.graph import Graph, Mask, sum_by
from petrobot.coordinator.analysis.time.gspn import Values
from petrobot.coordinator.analysis.time.linear import SolveOrder, solve, stationary
from petrobot.coordinator.analysis.time.measured import (
    FIELDS,
    Ending,
    Measured,
    NoEstimate,
    Numbers,
    OwnEnd,
    is_cause,
)
from petrobot.coordinator.analysis.time.phase_type import PhaseType, fit
from petrobot.coordinator.analysis.time.task_forecast import GOALS, TIME
from petrobot.coordinator.engine import (
    CancelRun,
    Chosen,
    EventOccurred,
    Mode,
    Run,
    RunEnded,
    RunRaised,
    RunRecorded,
    State,
    StopConfirmed,
    TimerFired,
    VariableChanged,
)
from petrobot.coordinator.engine.state import ACTIVE
from petrobot.coordinator.task import Counts, Kind, Place, Status

T = TypeVar("T")
SIZE = 20_000
"""The most states of a chain; they take about a second."""
STAGES = 8
"""The most phases of a duration; fewer where the chain would have more than SIZE states."""
BAD = (Status.FAILURE, Status.ERROR)
FIXED = 1e-9
"""Seconds for a timer of 0 s."""
UNDIVIDED = 1_000_000
"""Number of phases that marks a duration as fixed: it is not divided into phases."""
MISSIONS, MOVES, ENOUGH = 2_000, 60_000, 100
"""The most missions that are played, the most changes of a state in all of them, which take about a
second, and the fewest missions that tell something."""

Clock = tuple[str, int, float]
"""What ends (a status, followed by the action where actions of a place end by different causes;
`by.` and a preempting transition; or a timer), the phases that are left, and the rate (1/s) of
each."""
Draw = list[tuple[float, Clock]]
"""Clocks with their probabilities."""
NEVER: Clock = ("never", 1, 0.0)


class TooLarge(ValueError):  # noqa: N818 - a limit of the analysis
    """The chain has more than SIZE states, even with one phase for each duration, or missions have
    too many changes of a state."""


class _Outcome(Struct, frozen=True):
    """One outcome of a stimulus: the next state, the number of the edge (-1 if it has none), for
    each clock of the next state the clock of the present state that continues as it (-1: a new
    clock), the probability of this outcome, and whether a run is recorded that did not end with
    SUCCESS."""

    state: int
    edge: int
    kept: tuple[int, ...]
    share: float = 1.0
    spoils: bool = False


class _Plan(Struct, frozen=True):
    """What can happen in a state of the execution graph."""

    slots: tuple[tuple[str, str], ...]
    """What has a clock: ("run", id) or ("timer", transition)."""
    at_once: tuple[_Outcome, ...]
    """Outcomes that take no time. If there are any, they come before all others."""
    ends: dict[tuple[int, str], list[_Outcome]]
    """Outcomes by slot and by how its clock ends."""
    events: list[tuple[float, _Outcome]]
    """Outcomes that come after an exponential wait, each with its rate (1/s)."""


class ExecutionChain(Struct, frozen=True, dict=True):
    """The Markov chain: edges with their probabilities, and mean times (s) by state."""

    x: ExecutionGraph
    graph: Graph
    at: NDArray[np.int32]
    """By state of the chain: its state of the execution graph."""
    edge: NDArray[np.int32]
    """By edge of the chain: its edge of the execution graph; -1 for a phase."""
    probability: Values
    spoils: Mask
    """By edge of the chain: whether a run ends with FAILURE or ERROR."""
    sojourn: Values
    stages: int
    """The most phases of a duration."""
    assumptions: tuple[str, ...]

    @cached_property
    def figures(self) -> dict[str, float]:
        """P_complete, goals per run (if the task names goals and a runs place), R_conj and the mean
        time to completion (s; nan if it never completes), as `time.task_forecast` defines them."""
        x, task = self.x, self.x.engine.compiled.task
        h, y = self._reach(x.final)
        found = {"P_complete": float(h[0])}
        if task.goal_transitions and task.runs_place:
            goals = [sum(f in task.goal_transitions for f in s.firings) for s in x.steps]
            met = np.append(np.array([*goals, 0])[x.label], 0)[self.edge]  # edge -1: none
            first = sum(f in task.goal_transitions for f in x.first)
            runs = task.net.initial[task.net.place_index[task.runs_place]]
            found |= {GOALS: (first + float(self.taken @ met)) / runs} if runs else {}
        found["R_conj"] = float(self._arrival(x.final, ~self.spoils)[3][0])
        return found | {TIME: float(y[0] / h[0]) if h[0] else float("nan")}

    @property
    def taken(self) -> Values:
        """How often a mission run takes each edge, before it repeats a part for ever."""
        return self._weights[0]

    @cached_property
    def _weights(self) -> tuple[Values, Values]:
        """By edge: how often it is taken in one mission run, and how often in the long run of a
        task that never ends."""
        graph, n = self.graph, self.graph.n
        component, bottom = graph.components, graph.bottom
        once = ~bottom[component]
        order = np.argsort(graph.target, kind="stable")
        source, target = graph.source[order], graph.target[order]
        value = np.where(once[source] & once[target], self.probability[order], 0.0)
        begin = np.zeros(n)
        begin[0] = 1.0
        turned = Graph(n, target, source)
        visits = np.where(once, solve(SolveOrder.of(turned, once), value, begin), 0.0)
        into = visits[graph.source] * self.probability
        share = sum_by(component[graph.target], into * ~once[graph.target], len(bottom))
        share[component[0]] += float(not once[0])
        often = np.zeros(n)
        for c in np.flatnonzero(bottom & (np.bincount(component) > 1)).tolist():
            inside = np.flatnonzero(component == c)
            number = np.full(n, -1)
            number[inside] = np.arange(len(inside))
            ours = component[graph.source] == c
            rows, columns = number[graph.source[ours]], number[graph.target[ours]]
            often[inside] = share[c] * stationary(
                len(inside), rows, columns, self.probability[ours]
            )
        return into, often[graph.source] * self.probability

    def back(self, exits: NDArray[np.int64], goal: Mask) -> tuple[float, float] | None:
        """Return the probability that a state of `goal` is reached after one of the edges of the
        execution graph is taken, and the mean time (s) until then, given that it is (nan if it
        never is). None if the edges have the probability 0.

        The edges count as often as a mission run takes them.
        """
        taken = np.isin(self.edge, exits)
        if not taken.any():
            return None
        once, often = self._weights
        weight = (often if often[taken].any() else once)[taken]
        h, y = self._reach(goal)
        to = self.graph.target[taken]
        whole = float(weight.sum())
        if not whole:  # the probability of reaching it is below floating-point precision
            weight, whole = np.ones(len(to)), float(len(to))
        p, time = float(weight @ h[to]) / whole, float(weight @ y[to]) / whole
        return min(p, 1.0), time / p if p else float("nan")

    def _reach(self, goal: Mask) -> tuple[Values, Values]:
        """Return the probability of reaching the goal, and E[time; reached] (s), by state of the
        chain: the first-step equations of `time.completion`."""
        if self._known and np.array_equal(self._known[0][0], goal):
            return self._known[0][1:]
        inside, plan, value, h = self._arrival(goal, np.ones(len(self.edge), np.bool_))
        y = solve(plan, value, np.where(inside, self.sojourn * h, 0.0))
        self._known[:] = [(goal, h, y)]
        return h, y

    def _arrival(self, goal: Mask, allowed: Mask) -> tuple[Mask, SolveOrder, Values, Values]:
        """Return the states from which the goal can be reached, the order and the matrix of their
        equations, and the probability of reaching the goal by allowed edges only."""
        graph, there = self.graph, goal[self.at]
        inside = graph.backward(there) & ~there
        plan, open_ = SolveOrder.of(graph, inside), inside[graph.source] & allowed
        value = np.where(open_ & inside[graph.target], self.probability, 0.0)
        direct = np.where(open_ & there[graph.target], self.probability, 0.0)
        h = solve(plan, value, sum_by(graph.source, direct, graph.n))
        h[there] = 1.0
        return inside, plan, value, h

    @cached_property
    def _known(self) -> list[tuple[Mask, Values, Values]]:
        return []


def chain_of(
    x: ExecutionGraph, measured: Measured | None = None, *, size: int = SIZE
) -> ExecutionChain:
    """Return the chain of a complete execution graph.

    Raises NoEstimate for what has neither a measured nor a declared number, and TooLarge.
    """
    builder = _Builder(x, measured or Measured(), size)
    coarse = builder.result(1)
    # With k phases a state with n clocks becomes at most k to the power of n.
    clocks = np.array([len(clocks) for _, clocks in builder.states])
    stages = next((k for k in range(STAGES, 1, -1) if float((1.0 * k**clocks).sum()) <= size), 1)
    return builder.result(stages) if stages > 1 else coarse


class MissionFigures(Struct, frozen=True):
    """What missions gave that were played with undivided clocks."""

    missions: int
    figures: dict[str, tuple[float, float]]
    """Those of `ExecutionChain.figures`, each with its standard error."""
    times: Sequence[float]
    """How long those took that reached `final` (s)."""


def played(x: ExecutionGraph, measured: Measured | None = None, *, seed: int = 1) -> MissionFigures:
    """Play missions on a complete execution graph.

    Raises NoEstimate for what has neither a measured nor a declared number, and TooLarge if so
    few as ENOUGH missions have more than MOVES changes.
    """
    return _Builder(x, measured or Measured(), 0).played(np.random.default_rng(seed))


class _Builder:
    """Finds the states of the chain, breadth first from the first one."""

    def __init__(self, x: ExecutionGraph, measured: Measured, size: int) -> None:
        self.x, self.measured, self.size = x, measured, size
        self.task = x.engine.compiled.task
        self.numbers = Numbers(self.task, measured, apart=not size)  # 0: with undivided clocks
        self.refuse_unknown()
        self.plans: dict[int, _Plan] = {}
        self.causes = {
            (a.place, t.name)
            for t in self.task.transitions.values()
            for a in t.inputs
            if a.end is not None and is_cause(self.task, t) and self._covered(a.place)
        }
        """Preemptions that are measured as a cause by which a run ends."""

    def refuse_unknown(self) -> None:
        """Raise NoEstimate that names every place without an estimate."""
        lacking = []
        for place in self.task.places.values():
            if place.kind is Kind.ACTION:
                try:
                    for action in self.numbers.alternatives(place):
                        self.numbers.estimates(place, action)
                except NoEstimate:
                    lacking.append(f"`{place.name}`")
        if lacking:
            raise NoEstimate(f"no estimate for {', '.join(lacking)}")

    def result(self, stages: int) -> ExecutionChain:
        """Return the chain with `stages` phases in a duration. Raises NoEstimate and TooLarge."""
        self.stages = stages
        self.draws: dict[tuple[str, str], Draw] = {}
        self.number: dict[tuple[int, tuple[Clock, ...]], int] = {}
        self.states: list[tuple[int, tuple[Clock, ...]]] = []
        self.edges: list[tuple[int, int, int, float, bool]] = []
        self.sojourn: list[float] = []
        self.index(0, ())
        if self.plan(0).slots:  # the chain begins in one state, without clocks, and draws them
            for p, clocks in self.drawn(0, (), ()):
                self.edges.append((0, self.index(0, clocks), -1, p, False))
            self.sojourn.append(0.0)
        i = len(self.sojourn)
        while i < len(self.states):
            if not i % 1000:
                keep_time("recovery")
            self.sojourn.append(self.leave(i))
            i += 1
        source, target, edge, probability, spoils = (
            zip(*self.edges, strict=True) if self.edges else ((),) * 5
        )
        return ExecutionChain(
            self.x,
            Graph(len(self.states), np.array(source, np.int32), np.array(target, np.int32)),
            np.array([state for state, _ in self.states], np.int32),
            np.array(edge, np.int32),
            np.array(probability, np.float64),
            np.array(spoils, np.bool_),
            np.array(self.sojourn, np.float64),
            stages,
            tuple(dict.fromkeys(self.numbers.assumptions)),
        )

    def index(self, state: int, clocks: tuple[Clock, ...]) -> int:
        """Return the number of a state of the chain."""
        found = self.number.setdefault((state, clocks), len(self.states))
        if found == len(self.states):
            if found >= self.size:
                raise TooLarge(f"its Markov chain has more than {self.size} states")
            self.states.append((state, clocks))
        return found

    def leave(self, i: int) -> float:
        """Add the edges that leave a state of the chain; return its mean time (s)."""
        state, clocks = self.states[i]
        plan = self.plan(state)
        if plan.at_once:
            self.add(i, clocks, [(1.0, list(plan.at_once))], 1.0)
            return 0.0
        phases: list[tuple[float, int]] = []
        ends: list[tuple[float, list[_Outcome]]] = [(r, [o]) for r, o in plan.events]
        for k, (what, left, rate) in enumerate(clocks):
            if left > 1:
                later = (*clocks[:k], (what, left - 1, rate), *clocks[k + 1 :])
                phases.append((rate, self.index(state, later)))
            elif rate and (outcomes := plan.ends.get((k, what))):
                # where no condition reads the status, a FAILURE takes the edge of a SUCCESS
                bad = what.partition(" ")[0] in BAD
                ends.append((rate, [replace(o, spoils=o.spoils or bad) for o in outcomes]))
        total = sum(rate for rate, _ in phases) + sum(rate for rate, _ in ends)
        if not total:
            return 0.0
        self.edges += [(i, j, -1, rate / total, False) for rate, j in phases]
        self.add(i, clocks, ends, total)
        return 1.0 / total

    def add(
        self,
        i: int,
        clocks: tuple[Clock, ...],
        ends: list[tuple[float, list[_Outcome]]],
        total: float,
    ) -> None:
        """Add the edges of a clock that ends, each with the draws of the clocks that start then."""
        for rate, outcomes in ends:
            for one in outcomes:
                for p, after in self.drawn(one.state, one.kept, clocks):
                    j = self.index(one.state, after)
                    self.edges.append((i, j, one.edge, p * one.share * rate / total, one.spoils))

    def drawn(
        self, state: int, kept: tuple[int, ...], clocks: tuple[Clock, ...]
    ) -> Iterator[tuple[float, tuple[Clock, ...]]]:
        """Yield the clocks with which a state can begin, with their probabilities."""
        choices: list[Draw] = []
        for k, slot in enumerate(self.plan(state).slots):
            if k < len(kept) and kept[k] >= 0:
                choices.append([(1.0, clocks[kept[k]])])
            else:
                choices.append(self.first(self.x.states[state], slot))
        for combination in product(*choices):
            p = 1.0
            for share, _ in combination:
                p *= share
            yield p, tuple(clock for _, clock in combination)

    # --- missions with undivided clocks ----------------------------------------------------------

    def played(self, random: np.random.Generator) -> MissionFigures:
        """Play missions until there are enough of them, or they have had enough changes."""
        self.stages, self.draws, task = UNDIVIDED, {}, self.task
        ended, moves = list[tuple[bool, float, int, bool]](), 0
        while len(ended) < MISSIONS and moves < MOVES:
            keep_time("missions with exact times")
            done, more = self.mission(random, MOVES - moves)
            moves += more
            ended += [done] if done is not None else []
        if len(ended) < ENOUGH:
            raise TooLarge(f"{ENOUGH} missions have more than {MOVES} changes of a state")
        samples = {"P_complete": [float(final) for final, *_ in ended]}
        if task.goal_transitions and task.runs_place:
            runs = task.net.initial[task.net.place_index[task.runs_place]]
            samples |= {GOALS: [met / runs for _, _, met, _ in ended]} if runs else {}
        samples["R_conj"] = [float(final and not spoilt) for final, _, _, spoilt in ended]
        samples[TIME] = [time for final, time, *_ in ended if final]
        means = {name: _mean(some) for name, some in samples.items()}
        return MissionFigures(len(ended), means, samples[TIME])

    def mission(
        self, random: np.random.Generator, most: int
    ) -> tuple[tuple[bool, float, int, bool] | None, int]:
        """Play one mission; return (whether it reached `final`, its time (s), the goals that it
        met, whether some run did not end with SUCCESS) and its changes. None if it has more than
        `most`."""
        x, goals = self.x, self.task.goal_transitions
        i, now, spoilt, met = 0, 0.0, False, sum(f in goals for f in self.x.first)
        clocks = [self.lasts(0, slot, random) for slot in self.plan(0).slots]
        for moves in range(most):
            after, what, outcomes = self.first_of(self.plan(i), clocks, random)
            # In a bottom component the mission has ended, or repeats a part for ever.
            if not outcomes or x.graph.bottom[x.graph.components[i]]:
                return (bool(x.final[i]), now, met, spoilt), moves
            one = _drawn(outcomes, [o.share for o in outcomes], random)
            spoilt |= one.spoils or what.partition(" ")[0] in BAD
            now += after
            met += sum(f in goals for f in self.fired(one))
            i, left = one.state, [(ends, time - after) for ends, time in clocks]
            clocks = [
                left[one.kept[k]]
                if k < len(one.kept) and one.kept[k] >= 0
                else self.lasts(i, slot, random)
                for k, slot in enumerate(self.plan(i).slots)
            ]
        return None, most

    def first_of(
        self, plan: _Plan, clocks: list[tuple[str, float]], random: np.random.Generator
    ) -> tuple[float, str, Sequence[_Outcome]]:
        """Return what comes first: after how long (s), what its clock says, and its outcomes; none
        if nothing can come. Of clocks that end together the first one does."""
        if plan.at_once:
            return 0.0, "", plan.at_once
        after, said, outcomes = inf, "", list[_Outcome]()
        for k, (what, left) in enumerate(clocks):
            if left < after and (found := plan.ends.get((k, what))):
                after, said, outcomes = left, what, found
        for rate, one in plan.events:
            if (wait := random.exponential(1 / rate)) < after:
                after, said, outcomes = wait, "", [one]
        return max(after, 0.0), said, outcomes

    def lasts(
        self, state: int, slot: tuple[str, str], random: np.random.Generator
    ) -> tuple[str, float]:
        """Return how a run or a timer that starts will end, and after how long (s)."""
        draw = self.first(self.x.states[state], slot)
        what, stages, rate = _drawn([c for _, c in draw], [p for p, _ in draw], random)
        if not rate:
            return what, inf
        return what, stages / rate if stages == UNDIVIDED else float(random.gamma(stages, 1 / rate))

    # --- the numbers ---------------------------------------------------------------------------

    def first(self, state: State, slot: tuple[str, str]) -> Draw:
        """Return the clocks with which a run or a timer can start."""
        kind, name = slot
        if kind == "timer":
            after = max(self.task.transitions[name].after or 0.0, FIXED)
            return self.known((name, ""), [(1.0, name, fit(after, 0.0, stages=self.stages))])
        run = state.run(name)
        assert run is not None
        key = (f"run {run.place}", run.device)
        return self.draws[key] if key in self.draws else self.known(key, self.durations(run))

    def known(self, key: tuple[str, str], laws: list[tuple[float, str, PhaseType]]) -> Draw:
        """Return the clocks of a mixture of durations, remembered by a key."""
        if key not in self.draws:
            mixed: dict[Clock, float] = {}
            for share, what, duration in laws:
                for b in duration.branches:
                    clock = (what, b.stages, b.rate)
                    mixed[clock] = mixed.get(clock, 0.0) + share * b.probability
            total = sum(mixed.values())
            self.draws[key] = (
                [(p / total, clock) for clock, p in mixed.items()] if total else [(1.0, NEVER)]
            )
        return self.draws[key]

    def durations(self, run: Run) -> list[tuple[float, str, PhaseType]]:
        """Return how a run can end, each with its probability and its duration."""
        place = self.task.places[run.place]
        devices = self.x.engine.compiled.devices
        found = []
        for action, chosen in self.numbers.alternatives(place).items():
            if devices.get(action, "") != run.device:
                continue
            own = self.numbers.ends(place, action).items()
            ends = {self.what(place, end, action): e for end, e in own}
            if self._covered(place.name):
                caused = self.measured.preempted[place.name, action]
                ends |= {f"by.{name}": e for name, e in caused.items()}
            for what, e in ends.items():
                if e.share > 0 and not e.mean > 0:
                    raise NoEstimate(f"no mean duration of `{place.name}` that ends in {what}")
                if e.share > 0:
                    duration = fit(e.mean, (e.cv * e.mean) ** 2, stages=self.stages)
                    found.append((chosen * e.share, what, duration))
        return found

    def what(self, place: Place, end: OwnEnd, action: str) -> str:
        """Return what a clock of a run says: how it ends, and its action if that tells why."""
        actions = self._actions(place.name)
        causes = [self.numbers.causes(place, a).get(end.status, {}) for a in actions]
        return str(end) if all(c == causes[0] for c in causes) else f"{end} {action}"

    def _actions(self, place: str) -> list[str]:
        return list(self.numbers.alternatives(self.task.places[place]))

    def _covered(self, place: str) -> bool:
        actions = self._actions(place)
        return bool(actions) and all((place, a) in self.measured.preempted for a in actions)

    def rate(self, event: str, transition: str) -> float:
        """Return the rate (1/s) at which an event comes for which this transition waits."""
        try:
            return 1.0 / self.numbers.wait(event, transition)
        except NoEstimate as unknown:
            raise NoEstimate(f"no mean_wait of the event `{event}`") from unknown

    # --- what can happen in a state of the execution graph ---------------------------------------

    def plan(self, i: int) -> _Plan:
        """Return what can happen in a state."""
        if i not in self.plans:
            self.plans[i] = self._plan(i)
        return self.plans[i]

    def slots(self, state: State) -> tuple[tuple[str, str], ...]:
        """Return what has a clock in a state, in an order that does not depend on ids. Timers are
        in the order of the file: that in which those that were armed together elapse."""
        if state.mode is Mode.FINISHED:
            return ()
        drawn = {name for _, name in self.causes}
        runs = [
            ("run", run.id)
            for place in self.x.engine.compiled.action_places
            for run in state.tokens.get(place, ())
            if run.phase in ACTIVE
        ]
        armed = [n for n, t in state.timers.items() if not t.elapsed and n not in drawn]
        index = self.x.engine.compiled.net.transition_index
        timers = [("timer", name) for name in sorted(armed, key=index.__getitem__)]
        return (*runs, *timers)

    def _plan(self, i: int) -> _Plan:
        x, state = self.x, self.x.states[i]
        slots = self.slots(state)
        number = {slot: k for k, slot in enumerate(slots)}
        ended = not x.expanded[i] or i in x.livelocks
        stimuli = () if ended else x.names.stimuli(state, x.orders[i])
        made = [(cause, self.outcome(i, cause, number)) for cause in stimuli]
        if first := self.at_once(state, made):
            return _Plan(slots, first, {}, [])
        ends: dict[tuple[int, str], list[_Outcome]] = {}
        events: list[tuple[float, _Outcome]] = []
        own: dict[tuple[str, Status], list[tuple[RunEnded, _Outcome]]] = {}
        for cause, outcome in made:
            stimulus = cause.stimulus
            if isinstance(stimulus, RunEnded):
                own.setdefault((stimulus.run, stimulus.status), []).append((stimulus, outcome))
            elif isinstance(stimulus, TimerFired):
                name = stimulus.key.rpartition("#")[0]
                for k in self.slots_of_cause(state, name, number):
                    ends[k, f"by.{name}"] = [outcome]
                if ("timer", name) in number:
                    ends[number["timer", name], name] = [outcome]
            elif isinstance(stimulus, EventOccurred):
                self.event(state, stimulus.event, outcome, number, ends, events)
            elif isinstance(stimulus, RunRaised):
                run = state.run(stimulus.run)
                assert run is not None
                waiting = [
                    t.name
                    for t in x.engine.compiled.transitions
                    for a in t.actions
                    if a.name == run.place and stimulus.event in a.raised
                    if not self.numbers.waits_ready(t)
                    or self.task.net.has_concession(state.marking, t.index)
                ]
                for name in waiting:
                    if (run.place, name) in self.causes:
                        ends[number["run", run.id], f"by.{name}"] = [outcome]
                others = [name for name in waiting if (run.place, name) not in self.causes]
                if others and outcome.edge >= 0:
                    events.append((self.rate(stimulus.event, others[0]), outcome))
            elif isinstance(stimulus, VariableChanged):
                raise NoEstimate(f"no rate at which the variable `{stimulus.name}` changes")
        for (name, status), given in list(own.items()):
            if status is Status.SUCCESS:
                # where no condition reads the status, the graph merges failure with success
                own.setdefault((name, Status.FAILURE), given)
        for (name, status), given in own.items():
            run = state.run(name)
            assert run is not None
            place = self.task.places[run.place]
            for action in self._actions(place.name):
                for end in self.numbers.ends(place, action):
                    key = number["run", name], self.what(place, end, action)
                    if end.status is status and key not in ends:
                        ends[key] = self.shares(place, action, end, given)
        return _Plan(slots, (), ends, events)

    def event(
        self,
        state: State,
        event: str,
        outcome: _Outcome,
        number: dict[tuple[str, str], int],
        ends: dict[tuple[int, str], list[_Outcome]],
        events: list[tuple[float, _Outcome]],
    ) -> None:
        """Add an external event: as the cause that its run has drawn for its end, or after a
        wait."""
        compiled = self.x.engine.compiled
        kept, others = event in compiled.kept, list[str]()
        for t in compiled.waiting[event]:
            name = compiled.transitions[t].name
            drawn = self.slots_of_cause(state, name, number)
            for k in drawn:
                ends[k, f"by.{name}"] = [outcome]
            enabled = kept or self.task.net.has_concession(state.marking, t)
            others += [name] if enabled and not drawn else []
        if others and outcome.edge >= 0:
            events.append((self.rate(event, "" if kept else others[0]), outcome))

    def slots_of_cause(
        self, state: State, transition: str, number: dict[tuple[str, str], int]
    ) -> list[int]:
        """Return the runs that draw whether this transition will preempt them."""
        return [
            number["run", run.id]
            for run in state.runs()
            if run.phase in ACTIVE and (run.place, transition) in self.causes
        ]

    def at_once(self, state: State, made: list[tuple[Cause, _Outcome]]) -> tuple[_Outcome, ...]:
        """Return the outcomes that take no time: of a draw by weight, else of a choice of action,
        else of a stop."""
        draw = state.suspended
        if draw is not None and draw.key:
            total = sum(draw.weights) or 1.0
            return tuple(
                replace(outcome, share=weight / total)
                for (_, outcome), weight in zip(made, draw.weights, strict=True)
                if weight
            )
        chosen: dict[str, list[tuple[float, _Outcome]]] = {}
        for cause, outcome in made:
            if isinstance(cause.stimulus, Chosen):
                run = state.run(cause.stimulus.key)
                assert run is not None
                share = self.share(run.place, cause.stimulus.alternative)
                chosen.setdefault(run.id, []).append((share, outcome))
        for options in chosen.values():
            total = sum(share for share, _ in options)
            return tuple(replace(o, share=share / total) for share, o in options if share)
        for cause, outcome in made:
            if isinstance(cause.stimulus, StopConfirmed):
                return (outcome,)
        return ()

    def share(self, place: str, action: str) -> float:
        """Return how probable it is that a run takes an action with the same device."""
        devices = self.x.engine.compiled.devices
        shares = self.numbers.alternatives(self.task.places[place])
        mine = devices.get(action, "")
        return sum(p for other, p in shares.items() if devices.get(other, "") == mine)

    def shares(
        self, place: Place, action: str, end: OwnEnd, given: list[tuple[RunEnded, _Outcome]]
    ) -> list[_Outcome]:
        """Return the outcomes of a run that ends in one way, with their shares.

        Each cause has its own; results that are left have shares by the measured frequencies of the
        conditions, else equal ones.
        """
        if len({self.leads_to(o) for _, o in given}) == 1:
            return [given[0][1]]
        if self.numbers.by_switches(place):
            return self.drawn_results(place, [o for _, o in given])

        def kind(ending: Ending) -> tuple[Hashable, ...]:
            names = (f"{place.name}.{field}" for field in FIELDS)
            return tuple(map(self.x.names.region, names, ending))

        by_kind: dict[tuple[Hashable, ...], list[_Outcome]] = {}
        examples = [(one.cause, str(one.executed)) for one, _ in given]
        for ending, (_, outcome) in zip(examples, given, strict=True):
            by_kind.setdefault(kind(ending), []).append(outcome)
        found: list[_Outcome] = []
        for some, part in self.numbers.endings(place, action, end, examples, kind).items():
            drawn = self.drawn_results(place, by_kind[some])
            found += [replace(o, share=o.share * part) for o in drawn]
        return found

    def leads_to(self, outcome: _Outcome) -> Hashable:
        """Return what distinguishes an outcome from others of the same run."""
        return outcome.state, outcome.edge < 0 or self.fired(outcome)

    def drawn_results(self, place: Place, outcomes: list[_Outcome]) -> list[_Outcome]:
        """Return the outcomes with shares by the measured frequencies of the conditions, else
        equal ones."""
        different = {self.leads_to(o): o for o in outcomes}
        if len(different) == 1:
            return [outcomes[0]]
        # Results with the same firings share one frequency: a lamp that is red, or unknown, stops.
        alike = Counter(map(self.fired, different.values()))
        weights = []
        for one in different.values():
            weight = 1.0 / alike[self.fired(one)]
            for name in self.fired(one):
                weight *= self.measured.switches.get(name, 1.0)
            weights.append(weight)
        if not any(n in self.measured.switches for o in outcomes for n in self.fired(o)):
            self.numbers.assumptions.append(
                f"{place.name}: what its runs write was not measured; results that lead to "
                "different firings are equally likely"
            )
        total = sum(weights)
        return [
            replace(o, share=w / total)
            for o, w in zip(different.values(), weights, strict=True)
            if w
        ]

    def fired(self, outcome: _Outcome) -> tuple[str, ...]:
        """Return the firings of an outcome."""
        return () if outcome.edge < 0 else self.x.steps[self.x.label[outcome.edge]].firings

    def outcome(self, i: int, cause: Cause, number: dict[tuple[str, str], int]) -> _Outcome:
        """Let the engine handle the stimulus, and find its edge and the clocks that continue."""
        before = self.x.states[i]
        state, said, j, edge = self.x.follow(i, cause)
        kept = tuple(
            number.get((kind, name), -1)
            if kind == "run" or before.timers.get(name) == state.timers[name]
            else -1
            for kind, name in self.slots(state)
        )
        # A cancelled run is recorded when it has stopped; by then the graph has dropped how it
        # counts.
        spoils = any(
            r.status in BAD
            if isinstance(r, RunRecorded) and not isinstance(cause.stimulus, StopConfirmed)
            else isinstance(r, CancelRun) and r.counts in (Counts.FAILURE, Counts.ERROR)
            for r in said
        )
        return _Outcome(j, edge, kept, spoils=spoils)


def _drawn(items: Sequence[T], shares: Sequence[float], random: np.random.Generator) -> T:
    """Draw one item by shares, which need not sum to 1."""
    left = random.random() * sum(shares)
    for item, share in zip(items, shares, strict=True):
        left -= share
        if left < 0.0:
            return item
    return items[-1]


def _mean(sample: list[float]) -> tuple[float, float]:
    """Return the mean of a sample, and its standard error; nan for an empty one."""
    n = len(sample)
    if not n:
        return float("nan"), 0.0
    mean = sum(sample) / n
    return mean, sqrt(sum((value - mean) ** 2 for value in sample) / n / n)
