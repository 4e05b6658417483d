"""One firing rule: the engine, the explorers, the simulator and the forecast play the same random
tasks and find the same enabled transitions and the same successors.

The judge is `allowed` and `successor` below, written from docs/semantics.md, section 4, and not
from the compiled tables that all of them read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from msgspec.structs import replace

from petrobot.coordinator.analysis.net.explore import (
    ExplorationEngine as Explorer,
    Explored,
    IntegerEngine,
)
from petrobot.coordinator.analysis.net.explore_numpy import NumpyEngine
from petrobot.coordinator.analysis.net.pack import Layout, concession
from petrobot.coordinator.analysis.time.gspn import Gspn
from petrobot.coordinator.analysis.time.simulate import _Replicas
from petrobot.coordinator.engine import (
    ArmTimer,
    Begin,
    Choose,
    Engine,
    Fired,
    Phase,
    Policy,
    State,
)
from petrobot.coordinator.engine.draft import Draft
from petrobot.coordinator.engine.firing import arcs_satisfied, token_enabled
from petrobot.coordinator.studies.forecast.distributions import Drawer
from petrobot.coordinator.studies.forecast.history import STATUSES
from petrobot.coordinator.studies.forecast.net_arrays import Structure
from petrobot.coordinator.studies.forecast.play import DONE, GOING, IDLE, Play
from petrobot.coordinator.task import Task, Value
from petrobot.coordinator.task.conditions import ConditionFault, Expression
from petrobot.coordinator.task.file import dumps, loads
from petrobot.coordinator.task.net import Marking, Net
from tests.analysis.test_execution_graph import whole_tasks
from tests.engine.test_properties import DEVICES, Journal

EXPLORERS: tuple[Callable[[Explored], Explorer], ...] = (IntegerEngine, NumpyEngine)
COMMON = settings(
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)


def allowed(net: Net, marking: Sequence[int], t: int, occupied: Sequence[int]) -> bool:
    """Return whether tokens, inhibitor arcs and capacities allow transition t, by the sentence of
    docs/semantics.md, section 4. `occupied` also counts runs that are still stopping."""
    pre, post = dict(net.consume[t]), dict(net.produce[t])
    below = dict(net.inhibit[t])
    for p, room in enumerate(net.capacity):
        gain = post.get(p, 0) - pre.get(p, 0)
        if marking[p] < pre.get(p, 0) or (p in below and occupied[p] >= below[p]):
            return False
        if room is not None and gain > 0 and occupied[p] + gain > room:
            return False
    return True


def successor(net: Net, marking: Sequence[int], t: int) -> Marking:
    """M - Pre + Post."""
    pre, post = dict(net.consume[t]), dict(net.produce[t])
    return tuple(n - pre.get(p, 0) + post.get(p, 0) for p, n in enumerate(marking))


def enabled(net: Net, marking: Marking) -> list[int]:
    """Return the allowed transitions of the highest priority."""
    able = [t for t in range(len(net.transitions)) if allowed(net, marking, t, marking)]
    return [t for t in able if all(net.priority[t] >= net.priority[u] for u in able)]


def visited(task: Task, data: st.DataObject) -> list[State]:
    """Return the states at rest of the engine under stimuli of the world. Every firing is compared
    with the judge."""
    engine, world = Engine(task, DEVICES, Policy(firing_limit=40)), Journal(task)
    state, said = engine.handle(engine.initial(), Begin({}, {"n": 1}))
    states, marking = [state], engine.initial().marking
    for _ in range(data.draw(st.integers(0, 12))):
        for fired in (i for i in said if isinstance(i, Fired)):
            t = task.net.transition_index[fired.transition]
            assert fired.before == marking and allowed(task.net, marking, t, marking)
            marking = successor(task.net, marking, t)
            assert fired.after == marking
        world.state = state
        world.open |= {i.key: i for i in said if isinstance(i, Choose)}
        world.timers += [i.key for i in said if isinstance(i, ArmTimer)]
        state, said = engine.handle(state, data.draw(st.sampled_from(world.stimuli())))
        states.append(state)
    return states


def engine_agrees(task: Task, states: list[State]) -> None:
    """Compare the engine's token rule, with runs that are still stopping as occupants of their
    place."""
    compiled = Engine(task, DEVICES).compiled
    for state in states:
        draft = Draft(compiled, state)
        occupied = list(state.marking)
        for run in state.stopping.values():
            occupied[task.net.place_index[run.place]] += 1
        for x in compiled.transitions:
            assert token_enabled(draft, x) == allowed(task.net, state.marking, x.index, occupied)


def explorers_agree(net: Net, markings: list[Marking]) -> None:
    """Each explorer's first step from each marking."""
    for marking in markings:
        begun = replace(net, initial=marking)
        expected = [(t, successor(net, marking, t)) for t in enabled(net, marking)]
        for make in EXPLORERS:
            engine = make(Explored.start(begun, Layout.for_net(begun), True))
            for _ in range(64):  # a field that overflows is widened first, one bit or more each
                if engine.expanded or not engine.expand(None):
                    break
            found = engine.explored()
            after = found.layout.unpack_many(found.words).tolist()
            edges = range(int(found.row[0]), int(found.row[1]))
            steps = [(int(found.label[e]), tuple(after[found.target[e]])) for e in edges]
            assert steps == expected, make


def simulator_agrees(net: Net, markings: list[Marking]) -> None:
    """The simulator's columns, on the net with its priorities."""
    gspn = Gspn.of(net, {})
    columns = _Replicas(gspn, len(markings))
    columns.tokens = np.array(markings, dtype=np.int64).T.copy()
    amounts = columns.amounts()[0]
    for i, marking in enumerate(markings):
        possible = enabled(net, marking)
        assert np.flatnonzero(amounts[:, i]).tolist() == possible
        for t in possible:
            moved = np.array(marking) + columns.delta[:, t]
            assert tuple(moved.tolist()) == successor(net, marking, t)


def true_in(condition: Expression | None, values: Mapping[str, Value]) -> bool:
    """Return whether a condition is true; without a truth value it counts as false."""
    assert condition is not None
    try:
        return condition.holds(values)
    except ConditionFault:
        return False


class Frozen(Play):
    """A forecast whose runs are set by the test, and neither drawn nor counted."""

    def _admit(self, q: int, columns: Any) -> None:
        """No run is drawn."""

    def _cut(self, m: Any, counts: Any, rows: Any, columns: Any) -> None:
        """No run is counted."""

    def put(self, states: list[State]) -> None:
        """One column for each state."""
        self._tokens = np.array([s.marking for s in states], dtype=np.int64).T.copy()
        known = self._s.first_values
        self._variables.valuations = [{name: s.variables[name] for name in known} for s in states]
        self._variables.valuation = np.arange(len(states))
        self.names = dict[tuple[int, int], str]()  # of the runs, by row and column
        for q, place in enumerate(self._s.vocabulary.places):
            for i, state in enumerate(states):
                for run in state.tokens.get(place, ()):
                    self._enter(q, np.array([i]))
                    (row,) = (r for r in self._rows[q] if self._runs.entered[r, i] == self._entries)
                    self.names[row, i] = run.id
                    if run.phase is not Phase.QUEUED:
                        self._runs.phase[row, i] = DONE if run.phase is Phase.DONE else GOING
                    if run.status is not None:
                        self._runs.status[row, i] = STATUSES.index(run.status)
                        self._runs.ended[row, i] = run.ended

    def agrees(self, task: Task, states: list[State]) -> None:
        """The transitions whose arcs are satisfied are the engine's, and so are the runs that they
        take and each successor."""
        compiled = Engine(task, DEVICES).compiled
        for move in self._s.moves:
            x, before = compiled.transitions[move.number], self._tokens.copy()
            unjudged = replace(move, allowed=None, known=None)
            able = self._enabled(unjudged)
            unheard = replace(x, actions=tuple(replace(a, raised=()) for a in x.actions), when=None)
            held = None if move.known is None else self._variables.satisfy(move.known)
            for i, state in enumerate(states):
                if held is not None:
                    assert bool(held[i]) == true_in(move.known, state.variables), move.name
                runs = arcs_satisfied(Draft(compiled, state), unheard)
                assert bool(able[i]) == (runs is not None), move.name
                if runs is not None:
                    rows = np.concatenate(
                        [
                            [],
                            *(
                                found[:, 0]
                                for found in self._selected(unjudged, np.array([i]), None)
                            ),
                        ]
                    )
                    assert [self.names[int(r), i] for r in rows] == [run.id for run in runs]
            rows = concession(self._s.rule, before, move.number)
            assert not (able & ~rows).any()
            columns = np.flatnonzero(able)
            phases, taken = self._runs.phase.copy(), self._taken.copy()
            entered = self._runs.entered.copy()  # a run that enters may get the row of one taken
            told = self._variables.valuation.copy()
            self._fire(move, columns)
            self._variables.valuation = told
            for i in columns.tolist():
                expected = successor(task.net, states[i].marking, move.number)
                assert tuple(self._tokens[:, i].tolist()) == expected, move.name
            self._tokens, self._taken = before, taken
            self._runs.phase[: len(phases)], self._runs.phase[len(phases) :] = phases, IDLE
            self._runs.entered[: len(entered)] = entered


def forecast_agrees(task: Task, states: list[State]) -> None:
    """Compare states in which no run is still stopping: a forecast has no others."""
    try:
        structure = Structure.of(task)
    except ValueError:
        return  # a preemption that forecasts refuse
    fit = [s for s in states if not s.stopping]
    if fit:
        unmeasured = cast(
            Drawer, SimpleNamespace(as_measured=lambda name: False, branches=lambda members: {})
        )
        frozen = Frozen(structure, unmeasured, {}, np.zeros(len(fit), np.int64))
        frozen.put(fit)
        frozen.agrees(task, fit)


def all_agree(task: Task, data: st.DataObject) -> None:
    """Play the task in the engine as a file expands it, and give every marking at rest to the
    others."""
    written, task = task, loads(dumps(task))
    assert task == written
    states = visited(task, data)
    engine_agrees(task, states)
    forecast_agrees(task, states)
    markings = list(dict.fromkeys(s.marking for s in states))
    ranked = replace(task.net, priority=tuple(t.priority for t in task.flat.transitions.values()))
    for net in (task.net, ranked):
        explorers_agree(net, markings)
        simulator_agrees(net, markings)


@settings(COMMON, max_examples=60)
@given(whole_tasks(), st.data())
def test_all_players_of_a_task_agree(task: Task, data: st.DataObject) -> None:
    all_agree(task, data)


@pytest.mark.proof
@settings(COMMON, max_examples=5000)
@given(whole_tasks(), st.data())
def test_all_players_of_a_task_agree_at_length(task: Task, data: st.DataObject) -> None:
    all_agree(task, data)
