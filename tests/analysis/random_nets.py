"""Small random nets with everything the firing rule supports, and oracles for their state spaces
and their chains."""

from __future__ import annotations

from collections import deque

import numpy as np
from hypothesis import strategies as st

from petrobot.coordinator.analysis.time.gspn import Chain, Gspn, Values
from petrobot.coordinator.analysis.time.markov import Generator, poisson_weights
from petrobot.coordinator.task.net import Marking, Net

Weights = dict[str, int]


@st.composite
def nets(
    draw: st.DrawFn,
    *,
    places: int = 5,
    transitions: int = 5,
    inhibitors: bool = True,
    capacities: bool = True,
    priorities: bool = True,
    weights: int = 3,
    tokens: int = 3,
) -> Net:
    """A net of at most the given size; arcs are sparse so that many nets are bounded and do not
    die at once."""
    names = [f"p{i}" for i in range(draw(st.integers(1, places)))]
    labels = [f"t{i}" for i in range(draw(st.integers(1, transitions)))]
    arcs = st.dictionaries(st.sampled_from(names), st.integers(1, weights), max_size=3)
    few = st.dictionaries(st.sampled_from(names), st.integers(1, tokens + 1), max_size=2)
    initial = {p: draw(st.integers(0, tokens)) for p in names}
    return Net.build(
        initial,
        {t: (draw(arcs), draw(arcs)) for t in labels},
        inhibitors={t: draw(few) for t in labels} if inhibitors and draw(st.booleans()) else None,
        capacity={p: draw(st.integers(n, n + 3)) for p, n in initial.items() if draw(st.booleans())}
        if capacities and draw(st.booleans())
        else None,
        priority={t: draw(st.integers(0, 2)) for t in labels}
        if priorities and draw(st.booleans())
        else None,
    )


@st.composite
def state_machines(
    draw: st.DrawFn, *, places: int = 5, transitions: int = 8, tokens: int = 3
) -> Net:
    """A net whose transitions move one token each: always bounded, often with loops, sinks and
    deadlocks."""
    names = [f"p{i}" for i in range(draw(st.integers(2, places)))]
    moves = [
        (draw(st.sampled_from(names)), draw(st.sampled_from(names)))
        for _ in range(draw(st.integers(1, transitions)))
    ]
    initial = dict.fromkeys(names, 0) | {names[0]: draw(st.integers(1, tokens))}
    return Net.build(initial, {f"t{i}": ({a: 1}, {b: 1}) for i, (a, b) in enumerate(moves)})


def firings(net: Net, marking: Marking) -> list[tuple[int, Marking]]:
    """Return the transitions that can fire, and where each leads, from the net's arcs alone: not by
    the compiled tables that the explorers and `Net.enabled` read."""
    found = []
    for t in range(len(net.transitions)):
        after = list(marking)
        for p, w in net.consume[t]:
            after[p] -= w
        lacks = min(after, default=0) < 0 or any(marking[p] >= n for p, n in net.inhibit[t])
        for p, w in net.produce[t]:
            after[p] += w
        full = any(
            most is not None and before < now and now > most
            for before, now, most in zip(marking, after, net.capacity, strict=True)
        )
        if not lacks and not full:
            found.append((t, tuple(after)))
    highest = max((net.priority[t] for t, _ in found), default=0)
    return [(t, after) for t, after in found if net.priority[t] == highest]


def brute_force(net: Net, limit: int) -> tuple[list[Marking], list[tuple[int, int, int]]] | None:
    """Return markings and edges (source, transition, target) in breadth-first order; None above
    `limit` markings."""
    order, number, edges, queue = [net.initial], {net.initial: 0}, [], deque([0])
    while queue:
        i = queue.popleft()
        for t, after in firings(net, order[i]):
            if after not in number:
                if len(order) >= limit:
                    return None
                number[after] = len(order)
                queue.append(len(order))
                order.append(after)
            edges.append((i, t, number[after]))
    return order, edges


@st.composite
def gspns(draw: st.DrawFn, *, tokens: int = 2) -> Gspn:
    """A bounded GSPN whose transitions move one token each; some are immediate, some have
    several servers.

    An immediate transition moves tokens only to places of a higher number, so time always passes.
    """
    places = draw(st.integers(3, 5))
    names = [f"p{i}" for i in range(places)]
    arcs: dict[str, tuple[Weights, Weights]] = {}
    rates: dict[str, float] = {}
    weights: dict[str, float] = {}
    servers: dict[str, int | None] = {}
    for i in range(draw(st.integers(2, 8))):
        a, b = draw(
            st.tuples(st.integers(0, places - 1), st.integers(0, places - 1)).filter(
                lambda ab: ab[0] != ab[1]
            )
        )
        amount = draw(st.floats(0.25, 4.0))
        name = f"t{i}"
        if draw(st.booleans()) and a < b:
            weights[name] = amount
        else:
            rates[name], servers[name] = amount, draw(st.sampled_from([1, 2, None]))
        arcs[name] = ({names[a]: 1}, {names[b]: 1})
    initial = dict.fromkeys(names, 0) | {names[0]: draw(st.integers(1, tokens))}
    return Gspn.of(Net.build(initial, arcs), rates, weights=weights, servers=servers)


def transient(chain: Chain, times: list[float]) -> Values:
    """Return the probabilities of the markings at the given times (s), shape (times, n).

    By uniformisation; vanishing markings have probability 0.
    """
    made = Generator.of(chain)
    jumps = [poisson_weights(made.rate * t) for t in times]
    out = np.zeros((len(times), chain.n))
    p = made.start
    for k in range(max(low + len(w) for low, w in jumps)):
        for i, (low, weight) in enumerate(jumps):
            if low <= k < low + len(weight):
                out[i, made.tangible] += weight[k - low] * p
        p = made.matrix @ p
    return out
