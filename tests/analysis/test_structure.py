"""Invariants, bounds, siphons and traps against definitions, brute force and known nets."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from hypothesis import assume, given, settings

from petrobot.coordinator.analysis.limits import until
from petrobot.coordinator.analysis.net import structure
from petrobot.coordinator.analysis.net.deadlocks import (
    controlled_siphons,
    empty_siphon,
    largest_trap,
    minimal_siphons,
    minimal_traps,
)
from petrobot.coordinator.analysis.net.space import explore
from petrobot.coordinator.analysis.net.structure import (
    Lyapunov,
    Vector,
    conflict_sets,
    exclusive_places,
    incidence,
    is_strictly_conservative,
    lyapunov,
    place_bounds,
    place_semiflows,
    transition_semiflows,
)
from petrobot.coordinator.task.net import Marking, Net
from tests.analysis.generators import kanban, philosophers
from tests.analysis.random_nets import brute_force, nets, state_machines


def dense(vector: Vector, size: int) -> np.ndarray:
    out = np.zeros(size, dtype=np.int64)
    for i, n in vector.items():
        out[i] = n
    return out


def linear_bound(net: Net, place: int) -> int | None:
    """Return an upper bound of the tokens of a place by the state equation, or None if it has none.

    A linear program: maximise M(p) over all M = M0 + C x >= 0 with x >= 0. The true maximum may be
    smaller, never larger. Capacities are constraints; inhibitors and priorities are left out.
    """
    from scipy.optimize import linprog

    C = incidence(net).astype(float)
    start = np.array(net.initial, dtype=float)
    limited = [p for p, limit in enumerate(net.capacity) if limit is not None]
    room = [max(net.capacity[p] or 0, net.initial[p]) - net.initial[p] for p in limited]
    A, b = np.vstack([-C, C[limited]]), np.concatenate([start, np.array(room, dtype=float)])
    found = linprog(-C[place], A_ub=A, b_ub=b, method="highs")
    # 1e-6: the solver's optimum may be a rounding error below a whole number.
    return int(np.floor(start[place] - found.fun + 1e-6)) if found.status == 0 else None


def weighted(function: Lyapunov, marking: Marking) -> int:
    assert function.weights is not None
    return sum(w * marking[p] for p, w in function.weights.items())


@settings(max_examples=40, deadline=None)
@given(nets())
def test_semiflows_annul_the_incidence_matrix_and_are_minimal(net: Net) -> None:
    C = incidence(net)
    for flows, rows in ((place_semiflows(net), C), (transition_semiflows(net), C.T)):
        assert flows.complete
        supports = [frozenset(y) for y in flows.vectors]
        assert not any(a < b for a in supports for b in supports) and len(set(supports)) == len(
            supports
        )
        for y in flows.vectors:
            assert min(y.values()) > 0 and not (dense(y, len(rows)) @ rows).any()


@settings(max_examples=40, deadline=None)
@given(nets(weights=2, places=5, transitions=5))
def test_every_minimal_support_is_found(net: Net) -> None:
    """A support is minimal when its rows have a one-dimensional kernel with a positive vector
    (brute force over supports)."""
    C = incidence(net)
    expected: set[frozenset[int]] = set()
    for size in range(1, len(net.places) + 1):
        for support in combinations(range(len(net.places)), size):
            if any(known <= set(support) for known in expected):
                continue
            rows = C[list(support)].astype(float)
            _, s, vt = np.linalg.svd(np.vstack([rows.T, np.zeros((1, size))]))
            kernel = vt[np.concatenate([s, np.zeros(size - len(s))]) < 1e-9]
            if len(kernel) == 1 and (np.all(kernel > 1e-9) or np.all(kernel < -1e-9)):
                expected.add(frozenset(support))
    assert {frozenset(y) for y in place_semiflows(net).vectors} == expected


@settings(max_examples=40, deadline=None)
@given(nets())
def test_bounds_are_never_below_reachable_tokens(net: Net) -> None:
    found = brute_force(net, 200)
    assume(found is not None and found)
    reached = np.array(found[0] if found else []).max(axis=0)
    for p, bound in enumerate(place_bounds(net)):
        assert bound is None or bound >= reached[p]
        linear = linear_bound(net, p)
        assert linear is None or linear >= reached[p]
        assert linear is not None or bound is None or net.capacity[p] is not None


@pytest.mark.parametrize("enumerated", [structure.SMALL_EFFORT, 0])
def test_a_sum_that_never_grows_bounds_what_no_invariant_bounds(
    enumerated: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`parts` is only taken from, and of what is dropped nothing is counted."""
    monkeypatch.setattr(structure, "SMALL_EFFORT", enumerated)
    net = Net.build(
        {"parts": 500, "arm": 1, "grasp": 0, "trays": 0},
        {
            "next": ({"parts": 2, "arm": 1}, {"grasp": 1}),
            "grasped": ({"grasp": 1}, {"arm": 1, "trays": 3}),
            "dropped": ({"grasp": 1}, {"arm": 1}),
        },
    )
    assert None not in (bounds := place_bounds(net))
    exact = [500, 1, 1, 750]
    assert all(bound is not None and bound >= n for bound, n in zip(bounds, exact, strict=True))
    assert not enumerated or bounds == exact
    endless = Net.build({"a": 1, "b": 0}, {"t": ({"a": 1}, {"a": 1, "b": 1})})
    assert place_bounds(endless) == [1, None]


@settings(max_examples=40, deadline=None)
@given(nets(inhibitors=False, capacities=False, priorities=False))
def test_a_lyapunov_function_never_grows_and_proves_boundedness(net: Net) -> None:
    function = lyapunov(net)
    assume(function.weights is not None and net.places)
    assert function.weights is not None and function.bounded
    assert (
        set(function.weights) == set(range(len(net.places))) and min(function.weights.values()) > 0
    )
    space = explore(net)
    assert space.complete
    value = np.array([weighted(function, space.marking(i)) for i in range(len(space))])
    drift = value[space.target] - value[space.source]
    assert (drift <= 0).all()


@settings(max_examples=60, deadline=None)
@given(nets(inhibitors=False, capacities=False, priorities=False))
def test_enumeration_and_linear_programs_agree_on_a_lyapunov_function(net: Net) -> None:
    listed = lyapunov(net)
    assert listed.bounded is not None and listed.conservative is not None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(structure, "SMALL_EFFORT", -1)
        patch.setattr(structure, "place_semiflows", lambda _: structure.Semiflows((), False))
        programmed = lyapunov(net)
    assert (programmed.bounded, programmed.conservative) == (listed.bounded, listed.conservative)
    assert (programmed.weights is None) == (listed.weights is None)


def test_a_leaking_token_has_no_lyapunov_function() -> None:
    leak = Net.build({"p": 1, "q": 0}, {"t": ({"p": 1}, {"p": 1, "q": 1})})
    assert lyapunov(leak) == structure.Lyapunov(None, False, False)
    assert linear_bound(leak, 1) is None and linear_bound(leak, 0) == 1


def test_what_was_not_decided_in_time_is_unknown() -> None:
    net = philosophers(4)
    assert lyapunov(net).conservative is True
    with until(0.0, lambda: 1.0):
        assert lyapunov(net) == structure.Lyapunov(None, None, None)


def test_kanban_is_conservative() -> None:
    net = kanban(3)
    flows = place_semiflows(net)
    assert flows.complete and len(flows.vectors) == 6 and flows.covers(16)
    assert place_bounds(net, flows) == [3] * 16
    function = lyapunov(net)
    assert function.bounded and function.conservative and weighted(function, net.initial) == 18
    assert not is_strictly_conservative(philosophers(3)) and is_strictly_conservative(net)
    assert {frozenset(x.values()) for x in transition_semiflows(net).vectors} == {frozenset({1})}


def test_an_enumeration_that_gave_up_is_marked_incomplete() -> None:
    flows = place_semiflows(philosophers(12), effort=10)
    assert not flows.complete
    assert not minimal_siphons(philosophers(12), effort=20).complete


def siphons_by_definition(net: Net) -> set[frozenset[int]]:
    """Return all minimal non-empty siphons by trying every subset."""
    minimal: set[frozenset[int]] = set()
    for size in range(1, len(net.places) + 1):
        for some in map(frozenset, combinations(range(len(net.places)), size)):
            if any(known <= some for known in minimal):
                continue
            feeds = [t for t, arcs in enumerate(net.produce) if any(p in some for p, _ in arcs)]
            if all(any(p in some for p, _ in net.consume[t]) for t in feeds):
                minimal.add(some)
    return minimal


def turned_round(net: Net) -> Net:
    none = tuple(() for _ in net.transitions)
    return Net(
        net.places,
        net.transitions,
        net.produce,
        net.consume,
        none,
        net.initial,
        net.capacity,
        net.priority,
    )


@settings(max_examples=60, deadline=None)
@given(nets(places=7, transitions=6))
def test_siphons_and_traps_are_exactly_the_minimal_ones(net: Net) -> None:
    siphons, traps = minimal_siphons(net), minimal_traps(net)
    assert siphons.complete and set(siphons.sets) == siphons_by_definition(net)
    assert traps.complete and set(traps.sets) == siphons_by_definition(turned_round(net))
    for trap in traps.sets:
        assert largest_trap(net, trap) == trap


@settings(max_examples=40, deadline=None)
@given(nets(weights=1, inhibitors=False, capacities=False, priorities=False))
def test_commoners_condition_rules_out_dead_markings(net: Net) -> None:
    if controlled_siphons(net):
        found = brute_force(net, 200)
        assume(found is not None)
        assert found is not None
        assert {i for i, _, _ in found[1]} == set(range(len(found[0])))


@settings(max_examples=40, deadline=None)
@given(state_machines())
def test_an_empty_siphon_stays_empty(net: Net) -> None:
    space = explore(net)
    for i, j in zip(space.source.tolist(), space.target.tolist(), strict=True):
        lost = empty_siphon(net, space.marking(i))
        assert not any(space.marking(j)[p] for p in lost)


def test_philosophers_have_the_known_siphons() -> None:
    found = minimal_siphons(philosophers(10))
    assert found.complete and len(found.sets) == 101
    assert controlled_siphons(philosophers(4)) is False


@pytest.mark.parametrize("n", [2, 3])
def test_conflicts_and_exclusion(n: int) -> None:
    net = philosophers(n)
    assert len(conflict_sets(net)) == 1
    pairs = exclusive_places(net, place_semiflows(net))
    named = {(net.places[p], net.places[q]) for p, q in pairs}
    assert all(
        tuple(sorted(pair, key=net.places.index)) in named
        for pair in [("think0", "eat0"), ("eat0", "fork0")]
    )
    space = explore(net)
    for p, q in pairs:
        assert not ((space.tokens(p) > 0) & (space.tokens(q) > 0)).any()
