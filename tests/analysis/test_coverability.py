"""The Karp-Miller tree against exhaustive search (bounded nets) and its own witnesses (unbounded
nets)."""

from __future__ import annotations

from hypothesis import assume, given, settings

from petrobot.coordinator.analysis.net.coverability import coverability
from petrobot.coordinator.analysis.net.space import SearchLimits, explore
from petrobot.coordinator.task.net import Net
from tests.analysis.generators import kanban, philosophers
from tests.analysis.random_nets import brute_force, nets


def test_a_marking_is_compared_with_its_ancestors_only() -> None:
    """The net on which a comparison with all markings gives a false omega."""
    net = Net.build(
        {"p0": 1, "p1": 0}, {"one": ({"p0": 1}, {"p1": 1}), "two": ({"p0": 1}, {"p1": 2})}
    )
    found = coverability(net)
    assert (found.bounded, found.bounds, found.complete) == (True, (1, 2), True)


@settings(max_examples=100, deadline=None)
@given(nets(priorities=False, places=4, transitions=4))
def test_bounds_equal_those_of_the_reachable_markings(net: Net) -> None:
    found = coverability(net, effort=3000)
    reached = brute_force(net, 150)
    if found.bounded is None:
        return
    if reached is None:
        space = explore(net, limits=SearchLimits(states=2000))
        assert all(b is None or b >= top for b, top in zip(found.bounds, space.bounds, strict=True))
        return
    assert found.bounded and found.complete
    assert found.bounds == tuple(max(m[p] for m in reached[0]) for p in range(len(net.places)))


@settings(max_examples=100, deadline=None)
@given(nets(priorities=False, inhibitors=False, capacities=False, places=4, transitions=4))
def test_a_witness_of_unboundedness_can_be_pumped_for_ever(net: Net) -> None:
    found = coverability(net, effort=3000)
    assume(found.bounded is False)
    assert found.grows and found.pump
    grown = [net.place_index[name] for name in found.grows]
    marking = list(net.replay(found.prefix))[-1]
    pumped = list(net.replay(found.pump * 3, marking))[-1]
    assert all(pumped[p] >= marking[p] for p in range(len(marking)))
    assert all(pumped[p] > marking[p] for p in grown)


def test_inhibitors_are_complemented_if_a_bound_is_known() -> None:
    arcs = {"fill": ({"go": 1}, {"p": 1, "go": 1}), "reset": ({"p": 2}, {})}
    open_ended = Net.build({"go": 1, "p": 0}, arcs, inhibitors={"fill": {"p": 3}})
    found = coverability(open_ended)
    assert found.bounded is None and "inhibited place p" in found.reason
    settled = coverability(open_ended, bounds=[1, 3])
    assert settled.bounded and settled.bounds == (1, 3)


def test_with_priorities_only_bounds_are_certain() -> None:
    arcs = {"make": ({"s": 1}, {"s": 1, "p": 1}), "eat": ({"p": 1}, {})}
    first = Net.build({"s": 1, "p": 0}, arcs, priority={"eat": 1})
    assert explore(first).bounds == (1, 1)
    found = coverability(first)
    assert found.bounded is None and "priorities" in found.reason and found.bounds == (1, None)


def test_the_effort_is_limited_and_reported() -> None:
    found = coverability(kanban(2), effort=50)
    assert found.bounded is None and "50 nodes" in found.reason and not found.complete


def test_what_a_tree_that_was_cut_shows() -> None:
    """The leak was found before the effort ran out; how many tokens `late` may hold was not."""
    switches = range(10)
    places = {"go": 1, "leak": 0, "late": 0}
    places |= {f"off{i}": 1 for i in switches} | {f"on{i}": 0 for i in switches}
    on = {f"on{i}": 1 for i in switches}
    net = Net.build(
        places,
        {
            "drip": ({"go": 1}, {"go": 1, "leak": 1}),
            "last": (on, {**on, "late": 1}),
            **{f"turn{i}": ({f"off{i}": 1}, {f"on{i}": 1}) for i in switches},
        },
    )
    found = coverability(net, effort=100)
    assert (found.bounded, found.complete, found.grows) == (False, False, ("leak",))
    assert found.bounds == (1, None, None, *(1,) * 20) and not found.never


def test_known_nets() -> None:
    assert coverability(philosophers(3)).bounds == (1,) * 15
    leak = Net.build({"p": 1, "q": 0}, {"t": ({"p": 1}, {"p": 1, "q": 1})})
    found = coverability(leak)
    assert (
        found.bounded is False
        and found.bounds == (1, None)
        and found.pump == ("t",)
        and found.grows == ("q",)
    )


def test_the_witness_starts_at_the_nearest_covered_ancestor() -> None:
    """Two ancestors are covered at once: the sequence from the nearer one is the pump."""
    net = Net.build(
        {"p0": 0, "p3": 1},
        {"t0": ({"p3": 1}, {"p0": 3}), "t1": ({}, {}), "t3": ({"p0": 3}, {"p0": 3, "p3": 1})},
    )
    found = coverability(net)
    assert found.bounded is False
    *_, before = net.replay(found.prefix)
    *_, after = net.replay(found.pump * 4, before)
    assert all(after[net.place_index[p]] >= before[net.place_index[p]] + 4 for p in found.grows)
