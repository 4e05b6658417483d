"""Verdicts against their definitions by brute force on random nets; witnesses against the net."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

from petrobot.coordinator.analysis.net import graph as graphs
from petrobot.coordinator.analysis.net.deadlocks import hunt_deadlock
from petrobot.coordinator.analysis.net.graph import Graph, _tarjan
from petrobot.coordinator.analysis.net.qualitative import Qualitative, examine
from petrobot.coordinator.analysis.net.space import SearchLimits, explore
from petrobot.coordinator.task.net import Marking, Net
from tests.analysis.generators import fms, kanban, philosophers
from tests.analysis.random_nets import brute_force, nets, state_machines

Reached = tuple[list[Marking], list[tuple[int, int, int]]]


def closure(found: Reached) -> np.ndarray:
    """reach[i, j]: marking j can be reached from marking i in any number of steps, 0 included."""
    n = len(found[0])
    reach = np.eye(n, dtype=bool)
    for i, _, j in found[1]:
        reach[i, j] = True
    for k in range(n):
        reach |= np.outer(reach[:, k], reach[k])
    return reach


def judge(net: Net, found: Reached) -> dict[str, object]:
    """Return every verdict directly from its definition."""
    markings, edges = found
    reach = closure(found)
    n, m = len(markings), len(net.transitions)
    can = np.zeros((n, m), dtype=bool)
    again = np.zeros(m, dtype=bool)
    for i, t, j in edges:
        can[:, t] |= reach[:, i]
        again[t] |= reach[j, i]
    levels = tuple(
        4 if can[:, t].all() else 3 if again[t] else 1 if can[0, t] else 0 for t in range(m)
    )
    busy = {i for i, _, _ in edges}
    return {
        "bounds": tuple(map(max, zip(*markings, strict=True))),
        "dead": n - len(busy),
        "levels": levels,
        "live": all(level == 4 for level in levels),
        "quasi_live": 0 not in levels,
        "reversible": bool(reach[:, 0].all()),
        "home": int(reach.all(axis=0).sum()),
    }


def told(result: Qualitative) -> dict[str, object]:
    return {
        "bounds": result.bounds,
        "dead": result.dead_markings,
        "levels": result.levels,
        "live": result.live.holds,
        "quasi_live": result.quasi_live.holds,
        "reversible": result.reversible.holds,
        "home": result.home_states,
    }


def check_witnesses(net: Net, result: Qualitative) -> None:
    """Check that every witness replays in the net and ends where it says."""
    verdicts = [
        result.bounded,
        result.safe,
        result.deadlock_free,
        result.quasi_live,
        result.live,
        result.reversible,
    ]
    shown = [v.witness for v in verdicts if v.witness] + [d.witness for d in result.deadlocks]
    for one in shown:
        last = list(net.replay(one.firings))[-1]
        assert {p: k for p, k in zip(net.places, last, strict=True) if k} == one.marking
        list(net.replay(one.loop * 2, last))


def verdicts_agree(net: Net) -> None:
    found = brute_force(net, 60)
    assume(found is not None)
    assert found is not None
    result = examine(explore(net))
    assert told(result) == judge(net, found)
    assert (len(result.space), result.space.edges) == (len(found[0]), len(found[1]))
    check_witnesses(net, result)
    assert sum(d.count for d in result.deadlocks) == result.dead_markings


@settings(max_examples=120, deadline=None)
@given(st.one_of(nets(), state_machines()))
def test_verdicts_agree_with_the_definitions(net: Net) -> None:
    verdicts_agree(net)


@pytest.mark.proof
@settings(max_examples=5000, deadline=None)
@given(st.one_of(nets(), state_machines()))
def test_verdicts_on_thousands_of_nets(net: Net) -> None:
    verdicts_agree(net)


@settings(max_examples=80, deadline=None)
@given(nets(places=4, transitions=4), st.integers(5, 40))
def test_a_partial_search_never_contradicts_the_complete_one(net: Net, states: int) -> None:
    space = explore(net, limits=SearchLimits(states=states))
    part, haste = examine(space), examine(space, in_haste=True)
    check_witnesses(net, part)
    check_witnesses(net, haste)
    found = brute_force(net, 120)
    assume(found is not None)
    assert found is not None
    whole = told(examine(explore(net)))
    for one in (part, haste):
        assert one.bounded.holds is not False
        for name in ("live", "quasi_live", "reversible"):
            assert getattr(one, name).holds in (None, whole[name]), name
        assert one.deadlock_free.holds in (None, whole["dead"] == 0)
        assert one.safe.holds in (None, max(whole["bounds"]) <= 1)  # type: ignore[call-overload]
    if haste.space.complete:  # what a look at each marking and edge tells
        assert haste.deadlock_free.holds is not None and haste.quasi_live.holds is not None


@settings(max_examples=120, deadline=None)
@given(nets())
def test_stubborn_sets_find_a_deadlock_exactly_when_there_is_one(net: Net) -> None:
    found = brute_force(net, 150)
    assume(found is not None)
    assert found is not None
    busy = {i for i, _, _ in found[1]}
    dead = {m for i, m in enumerate(found[0]) if i not in busy}
    hunt = hunt_deadlock(net)
    assert hunt.complete and (hunt.firings is not None) == bool(dead)
    if hunt.firings is not None:
        assert list(net.replay(hunt.firings))[-1] in dead


def test_stubborn_sets_need_few_markings() -> None:
    hunt = hunt_deadlock(philosophers(10))
    assert hunt.firings is not None and hunt.states < 3**10 / 50
    assert (
        hunt_deadlock(kanban(3)).firings is None
        and not hunt_deadlock(kanban(3), effort=20).complete
    )


def test_deadlocks_of_the_philosophers_are_grouped_with_their_emptied_siphon() -> None:
    result = examine(explore(philosophers(4)))
    assert result.deadlock_free.holds is False and result.dead_markings == 2
    assert {d.marked for d in result.deadlocks} == {
        tuple(p for p in philosophers(4).places if p.startswith(side))
        for side in ("hasleft", "hasright")
    }
    for d in result.deadlocks:
        assert len(d.witness.firings) == 4 and {"fork0", "fork1", "fork2", "fork3"} <= set(
            d.emptied
        )


def test_kanban_is_live_reversible_and_bounded() -> None:
    result = examine(explore(kanban(2)))
    assert [
        v.holds
        for v in (result.bounded, result.safe, result.live, result.reversible, result.deadlock_free)
    ] == [
        True,
        False,
        True,
        True,
        True,
    ]
    assert result.home_states == 4600 and set(result.levels) == {4}


def test_safe_says_how_many_tokens_its_witness_shows() -> None:
    """Not the most that any marking has: the first marking with two is shown."""
    net = Net(("p", "s"), ("t",), (((1, 1),),), (((0, 2),),), ((),), (0, 2), (None, None), (0,))
    found = examine(explore(net)).safe
    assert found.reason == "p can hold 2 tokens"
    assert found.witness is not None and found.witness.marking == {"p": 2, "s": 1}


def test_an_unbounded_net_has_a_pump_and_unknown_verdicts() -> None:
    net = Net.build(
        {"p": 1, "q": 0}, {"grow": ({"p": 1}, {"p": 1, "q": 1}), "drop": ({"q": 1}, {})}
    )
    result = examine(explore(net, limits=SearchLimits(states=100)))
    assert result.bounded.holds is False and result.bounded.witness is not None
    assert result.bounded.witness.loop == ("grow",) and result.bounds == (1, None)
    assert (
        result.live.holds is None and result.home_states is None and result.quasi_live.holds is True
    )


def test_a_partial_search_of_a_bounded_net_still_proves_it_bounded() -> None:
    result = examine(explore(kanban(3), limits=SearchLimits(states=500)))
    assert result.bounded.holds is True and result.bounds == (3,) * 16
    assert result.live.holds is None and not result.live.complete


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 12),
    st.lists(st.tuples(st.integers(0, 11), st.integers(0, 11)), max_size=30),
    st.data(),
)
def test_graph_primitives(n: int, pairs: list[tuple[int, int]], data: st.DataObject) -> None:
    pairs = sorted((a % n, b % n) for a, b in pairs)
    source, target = (np.array([p[k] for p in pairs], dtype=np.int32) for k in (0, 1))
    graph = Graph(n, source, target)
    goal = data.draw(st.integers(0, n - 1))
    kept = np.array(data.draw(st.lists(st.booleans(), min_size=len(pairs), max_size=len(pairs))))
    found = []
    for wide in (0, graphs.WIDE):  # with numpy, and in plain Python
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(graphs, "WIDE", wide)
            back = graph.backward([goal], kept.astype(bool)).tolist()
            found.append(
                (back, *(graph.path(0, np.arange(n) == goal, e) for e in (None, kept == 1)))
            )
    assert found[0] == found[1]
    reach = np.eye(n, dtype=bool)
    for a, b in pairs:
        reach[a, b] = True
    for k in range(n):
        reach |= np.outer(reach[:, k], reach[k])
    labels = graph.components
    assert np.array_equal(labels[:, None] == labels[None, :], reach & reach.T)
    assert np.array_equal(graph.backward([0]), reach[:, 0])
    path = graph.path(0, np.arange(n) == goal)
    assert (path is not None) == reach[0, goal]
    if path:
        assert source[path[0]] == 0 and target[path[-1]] == goal
        assert all(target[a] == source[b] for a, b in pairwise(path))


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 200), st.integers(0, 600), st.integers(2, 30))
def test_sweeps_find_what_a_search_on_reversed_edges_finds(
    seed: int, n: int, m: int, swept: int
) -> None:
    """It holds also if blocks are small and some vertices have no edge."""
    random = np.random.default_rng(seed)
    source = np.sort(random.integers(0, n, m)).astype(np.int32)
    target = (source + random.integers(-5, 9, m)).clip(0, n - 1).astype(np.int32)
    wanted = Graph(n, source, target).backward([0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(graphs, "SMALL", -1)
        patch.setattr(graphs, "SWEPT", swept)
        assert np.array_equal(Graph(n, source, target).returning, wanted)


@pytest.mark.parametrize("net", [kanban(2), philosophers(5), fms(1)], ids=["kanban", "phil", "fms"])
def test_verdicts_of_large_graphs_are_those_of_small_ones(net: Net) -> None:
    """Large graphs use other algorithms: sweeps, and a single component if it reaches
    everything."""
    usual = examine(explore(net))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(graphs, "SMALL", -1)
        patch.setattr(graphs, "SWEPT", 100)
        other = examine(explore(net))
        assert told(other) == told(usual) and other.levels == usual.levels
        assert other.home_states == usual.home_states


@pytest.mark.parametrize("seed", range(5))
def test_scipy_and_plain_components_agree(seed: int) -> None:
    random = np.random.default_rng(seed)
    n, m = 3000, 20_000
    source = np.sort(random.integers(0, n, m)).astype(np.int32)
    target = np.minimum(n - 1, np.maximum(0, source + random.integers(-2, 40, m))).astype(np.int32)
    graph = Graph(n, source, target)
    ours = _tarjan(n, graph.row.tolist(), target.tolist())
    assert len(np.unique(ours)) > 1
    assert len(np.unique(np.stack([ours, graph.components]), axis=1).T) == len(np.unique(ours))


@pytest.mark.once
def test_a_deadlock_far_outside_a_partial_search_is_found() -> None:
    """300 places and about 1e28 markings: the deadlock is found, with a witness."""
    net = philosophers(60)
    result = examine(explore(net, limits=SearchLimits(states=2000)))
    assert (
        result.deadlock_free.holds is False
        and result.live.holds is False
        and not result.live.complete
    )
    assert (
        result.bounded.holds is True
        and result.safe.holds is True
        and result.reversible.holds is False
    )
    (found,) = result.deadlocks
    *_, last = net.replay(found.witness.firings)
    assert not net.enabled(last) and "fork0" in found.emptied


def test_stubborn_sets_prove_freedom_from_deadlock_of_a_partial_search() -> None:
    result = examine(explore(kanban(4), limits=SearchLimits(states=1000)))
    assert result.deadlock_free.holds is True and "stubborn sets" in result.deadlock_free.reason
