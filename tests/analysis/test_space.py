"""The three engines against the firing rule of the net, and against each other under every
limit."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

from petrobot.coordinator.analysis.net.explore import ExplorationEngine, Explored, IntegerEngine
from petrobot.coordinator.analysis.net.explore_numpy import NumpyEngine
from petrobot.coordinator.analysis.net.pack import Layout, TooManyTokens
from petrobot.coordinator.analysis.net.space import EngineName, SearchLimits, Space, explore
from petrobot.coordinator.analysis.net.structure import (
    implied_places,
    place_bounds,
    place_semiflows,
)
from petrobot.coordinator.task.net import Net
from tests.analysis.generators import fms, kanban, philosophers
from tests.analysis.random_nets import brute_force, nets
from tests.effort import memory
from tests.waiting import Limit

ENGINES: dict[str, Callable[[Explored], ExplorationEngine]] = {
    "integers": IntegerEngine,
    "numpy": NumpyEngine,
}


def run(
    kind: str, net: Net, *, least: int = 1, cap: int | None = None, keep: bool = True
) -> Explored:
    """Search completely with one engine, by default from the narrowest layout."""
    flows = place_semiflows(net)
    layout = Layout.for_net(net, least=least, implied=implied_places(flows, place_bounds(net)))
    engine = ENGINES[kind](Explored.start(net, layout, keep))
    limit = Limit("the end of the search")
    while (engine.expand(cap) and (cap is None or engine.states < cap)) and limit.left():
        pass
    return engine.explored()


def listed(found: Explored) -> tuple[list[tuple[int, ...]], list[tuple[int, int, int]]]:
    """Return markings and edges in the form of `brute_force`."""
    markings = [tuple(m) for m in found.layout.unpack_many(found.words).tolist()]
    source = np.repeat(np.arange(len(found.row) - 1), np.diff(found.row)).tolist()
    return markings, list(zip(source, found.label.tolist(), found.target.tolist(), strict=True))


def engines_agree(net: Net) -> None:
    expected = brute_force(net, 300)
    assume(expected is not None)
    for kind in ENGINES:
        assert listed(run(kind, net)) == expected, kind


def test_a_large_net_needs_memory_in_proportion() -> None:
    """Each transition kept a set of all those that it does not touch: 570 MB for 2,000 of them."""

    def held(count: int) -> int:
        net = philosophers(count)
        return memory(
            lambda: IntegerEngine(Explored.start(net, Layout.for_net(net, least=1), True))
        )

    assert held(200) < 3 * held(100)


@settings(max_examples=150, deadline=None)
@given(nets())
def test_every_engine_finds_exactly_what_the_firing_rule_gives(net: Net) -> None:
    engines_agree(net)


@settings(max_examples=60, deadline=None)
@given(nets())
def test_words_that_follow_from_others_need_not_be_compared(net: Net) -> None:
    """One place in a word, those of the invariants last."""
    expected = brute_force(net, 100)
    assume(expected is not None)
    for kind in ENGINES:
        assert listed(run(kind, net, least=40)) == expected, kind


@pytest.mark.parametrize("kind", sorted(ENGINES))
def test_a_field_overflows_in_a_word_that_follows_from_others(kind: str) -> None:
    """A bit is too narrow for `q`, whose tokens are what `p` leaves of two."""
    net = Net.build(
        {"p": 2} | {f"kept{i}": 1 for i in range(31)} | {"q": 0},
        {"there": ({"p": 1}, {"q": 1}), "back": ({"q": 1}, {"p": 1})},
    )
    first = [int(place == "q") for place in net.places]
    narrow = Layout.for_net(net, least=1, implied=implied_places(place_semiflows(net), first))
    assert narrow.telling == narrow.word[-1] == 1
    engine = ENGINES[kind](Explored.start(net, narrow, True))
    limit = Limit("the end of the search")
    while engine.expand(None) and limit.left():
        pass
    assert listed(engine.explored()) == brute_force(net, 4)


@pytest.mark.proof
@settings(max_examples=5000, deadline=None)
@given(nets(places=6, transitions=7))
def test_every_engine_on_thousands_of_nets(net: Net) -> None:
    engines_agree(net)


@settings(max_examples=60, deadline=None)
@given(nets(), st.integers(1, 60))
def test_engines_stop_at_the_same_marking_under_a_cap(net: Net, cap: int) -> None:
    one, *others = [run(kind, net, cap=cap) for kind in ENGINES]
    for other in others:
        assert listed(other) == listed(one)
    if len(one.row) - 1 < len(one.words):
        assert len(one.words) >= cap


@settings(max_examples=60, deadline=None)
@given(
    nets(priorities=False),
    st.integers(1, 40),
    st.sampled_from(sorted(ENGINES)),
    st.sampled_from(sorted(ENGINES)),
)
def test_one_engine_continues_where_another_stopped(
    net: Net, cap: int, first: str, second: str
) -> None:
    expected = brute_force(net, 200)
    assume(expected is not None)
    engine = ENGINES[second](run(first, net, cap=cap))
    limit = Limit("the end of the search")
    while engine.expand(None) and limit.left():
        pass
    assert listed(engine.explored()) == expected


def test_auto_changes_to_numpy_and_agrees_with_integers() -> None:
    auto, plain = explore(philosophers(9)), explore(philosophers(9), engine="integers")
    assert (auto.engine, plain.engine) == ("numpy", "integers")
    assert len(auto) == len(plain) == 3**9
    assert np.array_equal(auto.target, plain.target) and np.array_equal(auto.label, plain.label)
    assert list(auto.markings(1000))[3][1].tolist() == list(plain.markings(1000))[3][1].tolist()


def test_a_narrow_graph_stays_with_integers() -> None:
    """numpy would need a pass of its own for each of 15,000 layers of one marking."""
    net = Net.build({"parts": 15_000, "done": 0}, {"next": ({"parts": 1}, {"done": 1})})
    space = explore(net)
    assert space.complete and len(space) == 15_001 and space.engine == "integers"


@pytest.mark.parametrize(
    ("n", "states", "edges"), [(1, 160, 616), (2, 4600, 28120), (3, 58400, 446400)]
)
def test_kanban_has_the_published_number_of_markings(n: int, states: int, edges: int) -> None:
    space = explore(kanban(n))
    assert (len(space), space.edges, space.complete) == (states, edges, True)


@pytest.mark.parametrize("kind", sorted(ENGINES))
def test_fields_grow_with_the_tokens(kind: str) -> None:
    net = Net.build(
        {"p": 1, "q": 0},
        {"double": ({"p": 1}, {"p": 2}), "move": ({"p": 300}, {"q": 1})},
        capacity={"p": 999, "q": 5},
    )
    found = run(kind, net)
    assert found.layout.tokens(found.words, 0).max() == 999
    assert found.layout.tokens(found.words, 1).max() == 5


@pytest.mark.parametrize("engine", ["integers", "numpy"])
def test_more_tokens_than_a_word_can_count_end_the_search(engine: EngineName) -> None:
    """What was found before is kept as a partial space; an initial marking above 63 bits is
    refused."""
    huge = Net.build({"p": 1}, {"grow": ({"p": 1}, {"p": (1 << 62) + 1})})
    part = explore(huge, engine=engine)
    assert not part.complete and "unbounded" in part.reason
    assert part.tokens(0).tolist() == [1, (1 << 62) + 1]
    with pytest.raises(TooManyTokens, match="at most 63"):
        explore(Net.build({"p": 1 << 64}, {}), engine=engine)


def unbounded() -> Net:
    return Net.build(
        {"p": 1, "q": 0}, {"grow": ({"p": 1}, {"p": 1, "q": 1}), "drop": ({"q": 1}, {})}
    )


@pytest.mark.parametrize("engine", ["auto", "integers", "numpy"])
def test_a_limit_of_states_gives_a_marked_partial_space(engine: EngineName) -> None:
    space = explore(unbounded(), engine=engine, limits=SearchLimits(states=50))
    assert not space.complete and "50 states" in space.reason
    assert len(space) >= 50 > space.expanded - 1
    assert space.row[space.expanded] == space.row[-1] == len(space.target)
    assert space.dead.size == 0


def ticking() -> Iterator[float]:
    now = 0.0
    while True:
        now += 1.0
        yield now


def test_time_and_memory_limits() -> None:
    clock = ticking().__next__
    space = explore(unbounded(), limits=SearchLimits(seconds=3.0, clock=clock))
    assert not space.complete and "3 s" in space.reason
    space = explore(kanban(3), engine="numpy", limits=SearchLimits(memory=1_000_000))
    assert not space.complete and "memory" in space.reason
    with pytest.raises(ValueError, match="clock"):
        SearchLimits(seconds=1.0)


@pytest.mark.parametrize("engine", ["integers", "numpy"])
def test_ctrl_c_leaves_a_consistent_part(engine: EngineName) -> None:
    calls = 0

    def progress(found: int, expanded: int) -> None:
        nonlocal calls
        calls += 1
        if calls == 2:
            raise KeyboardInterrupt

    space = explore(
        unbounded() if engine == "integers" else kanban(3),
        engine=engine,
        limits=SearchLimits(progress=progress),
    )
    assert not space.complete and space.reason == "interrupted"
    whole = explore(space.net, engine=engine, limits=SearchLimits(states=len(space) + 2000))
    assert np.array_equal(whole.target[: len(space.target)], space.target)


def test_paths_are_shortest_and_replayable() -> None:
    space = explore(philosophers(4))
    net = space.net
    depth = [0] * len(space)
    for i in range(1, len(space)):
        path = space.path(i)
        assert list(net.replay(path))[-1] == space.marking(i)
        depth[i] = len(path)
    assert depth == sorted(depth)
    for i, j in zip(space.source.tolist(), space.target.tolist(), strict=True):
        assert depth[j] <= depth[i] + 1


def test_every_marking_has_one_number() -> None:
    space = explore(kanban(1))
    assert len({space.marking(i) for i in range(len(space))}) == len(space)
    assert space.bounds == (1,) * 16 and space.most_tokens == max(
        sum(space.marking(i)) for i in range(len(space))
    )


def test_without_edges_the_counts_are_kept() -> None:
    kept, bare = explore(philosophers(5)), explore(philosophers(5), edges=False)
    assert bare.edges == kept.edges and not bare.target.size
    assert bare.dead.tolist() == kept.dead.tolist() != []


def test_layout_round_trips_and_fields_stay_apart() -> None:
    layout = Layout.of_widths([1, 30, 30, 5, 63, 2])
    marking = (1, 2**30 - 1, 0, 31, 2**63 - 1, 3)
    assert layout.words == 4
    assert layout.unpack(layout.pack(marking)) == marking
    words = layout.split_many([layout.pack(marking), layout.pack((0,) * 6)])
    assert layout.unpack_many(words).tolist() == [list(marking), [0] * 6]
    assert layout.join_many(words) == [layout.pack(marking), 0]
    assert layout.pack(marking) & layout.guards == 0


def test_progress_is_reported() -> None:
    told: list[tuple[int, int]] = []
    space: Space = explore(
        kanban(2), limits=SearchLimits(progress=lambda found, done: told.append((found, done)))
    )
    assert told == sorted(told) and told[-1][0] <= len(space)


def test_fms_has_the_published_number_of_markings() -> None:
    """3,444 markings for two parts, as published by the Model Checking Contest."""
    assert (len(explore(fms(2))), explore(fms(2)).edges) == (3444, 16698)
