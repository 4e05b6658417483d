"""Generalized stochastic Petri nets (GSPN) and their Markov chains.

The transitions of a GSPN are timed (exponential delay, rate in 1/s; one, k or unlimited servers) or
immediate (weight and priority; immediate ones always fire before timed ones). Source: M. Ajmone
Marsan, G. Balbo, G. Conte et al., Modelling with Generalized Stochastic Petri Nets, Wiley 1995.

A marking that enables an immediate transition is *vanishing*: no time passes in it. All others are
*tangible*. Textbooks eliminate vanishing markings; here the chain keeps them, with sojourn time 0.
Each edge e carries an amount r_e (rate times busy servers, or weight) and is taken with probability
r_e / sum of the amounts of its marking. So long run, completion times and derivatives need no
elimination, and the flow through immediate transitions is known without extra work.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from petrobot.coordinator.analysis.limits import keep_time
from petrobot.coordinator.analysis.net.coverability import find_pump
from petrobot.coordinator.analysis.net.graph import Graph, Index, Mask, sum_by
from petrobot.coordinator.analysis.net.space import LOOK, SearchLimits, Space, explore
from petrobot.coordinator.task.net import Net
from petrobot.coordinator.task.wording import few

Values = NDArray[np.float64]


class TimelessTrap(ValueError):  # noqa: N818 - names what was found in the net
    """From some marking immediate transitions fire for ever, and time never passes again."""


class Gspn(Struct, frozen=True):
    """A net with a rate or a weight for each transition.

    `rate[t]` (1/s) is None for an immediate transition, which is chosen with a probability
    proportional to `weight[t]` among those enabled with it. `servers[t]` is how many firings of a
    timed transition can be active at once: 1, k, or None for as many as it is enabled. In `net`,
    timed transitions have priority 0 and immediate ones at least 1.
    """

    net: Net
    rate: tuple[float | None, ...]
    weight: tuple[float, ...]
    servers: tuple[int | None, ...]

    def __post_init__(self) -> None:
        """Refuse rates, weights, priorities and servers without a meaning."""
        count = len(self.net.transitions)
        if not len(self.rate) == len(self.weight) == len(self.servers) == count:
            raise ValueError("rates, weights and servers need one entry for each transition")
        for t, name in enumerate(self.net.transitions):
            rate, weight = self.rate[t], self.weight[t]
            if rate is not None and not 0 < rate < float("inf"):
                raise ValueError(f"{name}: expected a positive, finite rate (1/s), got {rate}")
            if rate is None and not 0 < weight < float("inf"):
                raise ValueError(f"{name}: expected a positive, finite weight, got {weight}")
            if (rate is None) != (self.net.priority[t] > 0):
                raise ValueError(
                    f"{name}: timed transitions have priority 0, immediate ones 1 or more"
                )
            servers = self.servers[t]
            if (servers is None and not self.net.consume[t]) or (
                servers is not None and servers < 1
            ):
                raise ValueError(
                    f"{name}: servers are 1 or more, and unlimited only where a token is consumed"
                )

    @classmethod
    def of(
        cls,
        net: Net,
        rates: Mapping[str, float],
        *,
        weights: Mapping[str, float] | None = None,
        servers: Mapping[str, int | None] | None = None,
    ) -> Gspn:
        """Build a GSPN from the rates of the timed transitions; all others become immediate.

        A weight is 1 and a transition has one server unless given. The net's own priorities order
        the immediate transitions; all are raised equally if the lowest is below 1. Raises
        ValueError.
        """
        for given in (rates, weights or {}, servers or {}):
            unknown = [name for name in given if name not in net.transition_index]
            if unknown:
                raise ValueError(f"{unknown[0]!r} is not a transition of the net")
        immediate = [
            own for t, own in zip(net.transitions, net.priority, strict=True) if t not in rates
        ]
        lift = max(0, 1 - min(immediate, default=1))
        priority = tuple(
            0 if t in rates else own + lift
            for t, own in zip(net.transitions, net.priority, strict=True)
        )
        return cls(
            replace(net, priority=priority),
            tuple(float(rates[t]) if t in rates else None for t in net.transitions),
            tuple(float((weights or {}).get(t, 1.0)) for t in net.transitions),
            tuple((servers or {}).get(t, 1) for t in net.transitions),
        )

    def changed(
        self, rates: Mapping[str, float] | None = None, weights: Mapping[str, float] | None = None
    ) -> Gspn:
        """Return the GSPN with some rates (of timed) and weights (of immediate transitions)
        changed.

        Raises ValueError for a rate of an immediate or a weight of a timed transition.
        """
        rate, weight = list(self.rate), list(self.weight)
        for name, value in (rates or {}).items():
            t = self.net.transition_index[name]
            if rate[t] is None:
                raise ValueError(f"{name} is immediate: it has a weight, not a rate")
            rate[t] = float(value)
        for name, value in (weights or {}).items():
            t = self.net.transition_index[name]
            if rate[t] is not None:
                raise ValueError(f"{name} is timed: it has a rate, not a weight")
            weight[t] = float(value)
        return replace(self, rate=tuple(rate), weight=tuple(weight))

    def marked(self, tokens: Mapping[str, int]) -> Gspn:
        """Return the GSPN with other initial tokens in some places."""
        initial = list(self.net.initial)
        for name, n in tokens.items():
            initial[self.net.place_index[name]] = n
        return replace(self, net=replace(self.net, initial=tuple(initial)))

    def busy_servers(self, t: int, tokens: Mapping[int, NDArray[Any]]) -> NDArray[Any]:
        """Return how many servers of a timed transition are busy in markings that enable it.

        `tokens`: by place that the transition needs, its tokens in each of these markings.
        """
        needs, servers = self.net.compiled.needs[t], self.servers[t]
        able: NDArray[Any] = np.ones(1)
        if needs:
            able = np.min([tokens[p] // w for p, w in needs], axis=0)
        return able if servers is None else np.minimum(able, servers)


class Chain(Struct, frozen=True, dict=True):
    """The Markov chain of a GSPN over its reachable markings, vanishing ones included.

    It starts in marking 0. Edges are sorted by source. `amount[e]` is a rate (1/s) if the source is
    tangible, and a weight if it is vanishing. Absorbing markings have no edges.
    """

    gspn: Gspn
    space: Space
    source: NDArray[np.int32]
    target: NDArray[np.int32]
    label: NDArray[np.int64]
    amount: Values
    vanishing: Mask

    @classmethod
    def of(
        cls, gspn: Gspn, *, space: Space | None = None, limits: SearchLimits | None = None
    ) -> Chain:
        """Return the chain of a GSPN; its space is explored unless given.

        Raises ValueError if the space is not complete (then simulate), and TimelessTrap. A space
        of more than LOOK markings that is seen to be infinite is not searched to the limits.
        """
        if space is None:
            most = limits or SearchLimits()
            space = explore(gspn.net, limits=replace(most, states=min(LOOK, most.states or LOOK)))
            if not space.complete and len(space) >= LOOK:
                if (pump := find_pump(space)) is not None:
                    raise ValueError(
                        f"a Markov chain needs all markings, but {few(pump[2])} can grow without "
                        "bound; simulate instead"
                    )
                space = explore(gspn.net, limits=limits)
        if not space.complete:
            raise ValueError(
                f"a Markov chain needs all markings; the search stopped: {space.reason}; "
                "simulate instead"
            )
        keep_time("Markov chain")
        label = space.label.astype(np.int64)
        timed = np.array([r is not None for r in gspn.rate], dtype=np.bool_)
        vanishing = np.zeros(len(space), dtype=np.bool_)
        vanishing[space.source[~timed[label]]] = True
        base = np.array(
            [r if r is not None else w for r, w in zip(gspn.rate, gspn.weight, strict=True)]
        )
        amount = base[label] * _degrees(gspn, space, label)
        chain = cls(gspn, space, space.source, space.target, label, amount, vanishing)
        chain._refuse_traps()
        return chain

    def _refuse_traps(self) -> None:
        """Raise TimelessTrap for a vanishing marking from which no tangible one is reachable."""
        if not self.vanishing.any():
            return
        trapped = self.vanishing & ~self.graph.backward(~self.vanishing)
        if trapped.any():
            first = int(np.argmax(trapped))
            names = sorted({self.gspn.net.transitions[t] for t in self.label[trapped[self.source]]})
            where = self.gspn.net.describe(self.space.marking(first))
            raise TimelessTrap(
                f"from {where} time never passes again: {', '.join(names)} fire for ever without "
                "delay; give one of them a rate"
            )

    @property
    def n(self) -> int:
        """Number of markings."""
        return len(self.space)

    @cached_property
    def graph(self) -> Graph:
        """The edges of the chain as a graph."""
        whole = len(self.source) == self.space.edges  # no edge was cut at an absorbing marking
        return Graph(
            self.n, self.source, self.target, self.space.row if whole else None, rooted=whole
        )

    @cached_property
    def total(self) -> Values:
        """Sum of the amounts of each marking's edges, shape (n,); 0 for absorbing markings."""
        return sum_by(self.source, self.amount, self.n)

    @cached_property
    def probability(self) -> Values:
        """Probability of each edge among those of its source, shape (edges,)."""
        out: Values = self.amount / self.total[self.source]
        return out

    @cached_property
    def sojourn(self) -> Values:
        """Mean sojourn time in each marking (s), shape (n,): 0 in vanishing markings, infinite in
        absorbing ones."""
        out = np.full(self.n, np.inf)
        tangible = self.total > 0
        out[tangible] = 1.0 / self.total[tangible]
        out[self.vanishing] = 0.0
        return out

    @property
    def tangible(self) -> Index:
        """Numbers of the tangible (and absorbing) markings."""
        return np.flatnonzero(~self.vanishing)


def _degrees(gspn: Gspn, space: Space, label: Index) -> Values:
    """Return the number of busy servers for each edge."""
    degree = np.ones(len(label))
    for t, servers in enumerate(gspn.servers):
        if servers == 1 or gspn.rate[t] is None or not gspn.net.consume[t]:
            continue
        edges = np.flatnonzero(label == t)
        at = space.source[edges]
        tokens = {p: space.tokens(p)[at] for p, _ in gspn.net.compiled.needs[t]}
        degree[edges] = gspn.busy_servers(t, tokens)
    return degree
