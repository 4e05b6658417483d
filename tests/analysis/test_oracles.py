"""Three independent tools agree with us on random nets, if installed (`pip install
petrobot[oracle]`)."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, assume, given, settings, strategies as st

from petrobot.coordinator.analysis.formats import written
from petrobot.coordinator.analysis.formats.netfile import NetFile
from petrobot.coordinator.analysis.formats.pnml import write_pnml
from petrobot.coordinator.analysis.net.space import SearchLimits, explore
from petrobot.coordinator.analysis.time.completion import completion
from petrobot.coordinator.analysis.time.gspn import Chain, Gspn
from petrobot.coordinator.analysis.time.markov import long_run
from petrobot.coordinator.task.net import Net
from tests.analysis import oracles
from tests.analysis.generators import KANBAN_RATES, kanban, philosophers
from tests.analysis.random_nets import brute_force, nets, state_machines

MOST = 200
RANDOM = settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))


@pytest.fixture(scope="module")
def snakes() -> None:
    """Skip unless SNAKES is installed."""
    pytest.importorskip("snakes", reason="the extra `oracle` (SNAKES) is not installed")


@pytest.fixture(scope="module")
def pm4py() -> None:
    """Skip unless pm4py is installed."""
    pytest.importorskip("pm4py", reason="the extra `oracle` (pm4py) is not installed")


@pytest.fixture(scope="module")
def storm() -> None:
    """Skip unless Storm is installed."""
    pytest.importorskip("stormpy", reason="the extra `oracle` (stormpy) is not installed")


def ours(net: Net) -> tuple[set[tuple[int, ...]], int]:
    """Return our markings and the number of distinct edges."""
    space = explore(net, limits=SearchLimits(states=10 * MOST))
    assert space.complete
    edges = set(zip(space.source.tolist(), space.label.tolist(), strict=True))
    return {space.marking(i) for i in range(len(space))}, len(edges)


@RANDOM
@given(nets(inhibitors=False, capacities=False, priorities=False))
def test_snakes_reaches_the_same_markings(snakes: None, net: Net) -> None:
    """Weighted arcs: the same markings and edges (SNAKES never fires a transition without
    inputs)."""
    assume(all(net.consume))
    assume(brute_force(net, MOST) is not None)
    assert oracles.snakes_graph(net, 10 * MOST) == ours(net)


@RANDOM
@given(state_machines(), st.data())
def test_snakes_with_inhibitors(snakes: None, net: Net, data: st.DataObject) -> None:
    """Inhibitor arcs with a threshold of one token."""
    arcs = {
        t: (
            {net.places[p]: w for p, w in net.consume[i]},
            {net.places[p]: w for p, w in net.produce[i]},
        )
        for i, t in enumerate(net.transitions)
    }
    free = {t: [p for p in net.places if p not in arcs[t][0]] for t in net.transitions}
    inhibitors = {
        t: {data.draw(st.sampled_from(places)): 1} for t, places in free.items() if places
    }
    barred = Net.build(dict(zip(net.places, net.initial, strict=True)), arcs, inhibitors=inhibitors)
    assert oracles.snakes_graph(barred, 10 * MOST) == ours(barred)


@RANDOM
@given(nets(inhibitors=False, capacities=False, priorities=False))
def test_pm4py_reads_what_we_write_and_reaches_the_same(pm4py: None, net: Net) -> None:
    """Our PNML with its reader and firing rule."""
    assume(brute_force(net, MOST) is not None)
    assert oracles.pm4py_markings(write_pnml(NetFile(net)), net) == ours(net)[0]


@pytest.mark.parametrize("net", [kanban(1), philosophers(5)], ids=["kanban", "philosophers"])
def test_pm4py_on_known_nets(pm4py: None, net: Net) -> None:
    """The generated nets of the benchmark."""
    assert oracles.pm4py_markings(write_pnml(NetFile(net)), net) == ours(net)[0]


def test_storm_reads_what_we_write_and_agrees(storm: None) -> None:
    """Our .drn: the long-run shares of Storm equal ours."""
    gspn = Gspn.of(kanban(1), KANBAN_RATES)
    text = written(NetFile(gspn.net, gspn=gspn), Path("net.drn"))[0]
    for label in ("pkan1", "pm1", "pout4"):
        share = oracles.storm_share(text, label)
        assert long_run(Chain.of(gspn)).occupancy[label] == pytest.approx(share, abs=1e-5)


@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.integers(1, 6), st.lists(st.floats(0.2, 5.0), min_size=2, max_size=5))
def test_storm_agrees_on_times(storm: None, tokens: int, rates: list[float]) -> None:
    """Mean time until all jobs have passed a line of machines, by Storm and by `completion`."""
    names = [f"p{i}" for i in range(len(rates) + 1)]
    arcs = {f"t{i}": ({names[i]: 1}, {names[i + 1]: 1}) for i in range(len(rates))}
    arcs["all"] = ({names[-1]: tokens}, {"done": 1})
    net = Net.build({**dict.fromkeys(names, 0), names[0]: tokens, "done": 0}, arcs)
    gspn = Gspn.of(net, {**{f"t{i}": rate for i, rate in enumerate(rates)}, "all": 3.0})
    chain = Chain.of(gspn)
    text = written(NetFile(net, gspn=gspn), Path("net.drn"))[0]
    done = chain.space.where(lambda m: m[net.place_index["done"]] > 0)
    assert completion(chain, done).mean == pytest.approx(oracles.storm_time(text, "done"), rel=1e-4)


@pytest.mark.parametrize("weights", [{}, {"left": 1.0, "right": 3.0}])
def test_storm_reads_a_chain_that_begins_without_time(
    storm: None, weights: dict[str, float]
) -> None:
    """Its first tangible marking is certain, or drawn by weight."""
    arcs: dict[str, tuple[dict[str, int], dict[str, int]]] = {
        name: ({"go": 1}, {name: 1}) for name in weights or ("left",)
    }
    arcs |= {"l": ({"left": 1}, {"right": 1}), "r": ({"right": 1}, {"done": 1})}
    net = Net.build({"go": 1, "left": 0, "right": 0, "done": 0}, arcs)
    gspn = Gspn.of(net, {"l": 0.5, "r": 2.0}, weights=weights)
    text = written(NetFile(net, gspn=gspn), Path("net.drn"))[0]
    asked = "T=?" if not weights else "Tmax=?"
    expected = 0.5 + 2.0 * (0.25 if weights else 1.0)
    assert oracles.storm_time(text, "done", asked) == pytest.approx(expected, rel=1e-4)
    chain = Chain.of(gspn)
    mean = completion(chain, chain.space.where(lambda m: m[3] > 0)).mean
    assert mean == pytest.approx(expected)
