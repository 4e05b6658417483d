"""Generalized stochastic Petri nets and the Markov chain behind them.

A GSPN is a net whose transitions are timed (exponential, rate 1/s, one, k or unlimited servers) or
immediate (weight, and the net's priorities; every immediate one ranks above every timed one).
Source: M. Ajmone Marsan, G. Balbo, G. Conte et al., Modelling with Generalized Stochastic Petri
Nets, Wiley 1995.

The chain is kept in its extended form, vanishing markings included with sojourn time 0: each edge e
of marking i carries an amount r_e (rate times servers at work, or weight) and is taken with
probability r_e / sum of the marking's amounts. So steady states, completion times and derivatives
need no elimination, and flows through immediate transitions come for free.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from petrobot.coordinator.analysis.net.graph import Graph, Index, Mask, sum_by
from petrobot.coordinator.analysis.net.space import SearchLimits, Space, explore
from petrobot.coordinator.task.net import Marking, Net

Values = NDArray[np.float64]


class TimelessTrap(ValueError):  # noqa: N818 - names what was found in the net
    """Immediate transitions fire for ever and time never passes."""


@dataclass(frozen=True)
class Gspn:
    """A net with a rate or a weight for each transition.

    `rate[t]` (1/s) is None for an immediate transition, whose `weight[t]` counts among those
    enabled with it. `servers[t]` is how many firings of a timed transition go on at once: 1, k, or
    None for as many as are enabled. Timed transitions have priority 0 and immediate ones at least 1
    in `net`.
    """

    net: Net
    rate: tuple[float | None, ...]
    weight: tuple[float, ...]
    servers: tuple[int | None, ...]

    def __post_init__(self) -> None:
        """Refuse rates, weights and priorities that mean nothing."""
        count = len(self.net.transitions)
        if not len(self.rate) == len(self.weight) == len(self.servers) == count:
            raise ValueError("rates, weights and servers need one entry for each transition")
        for t, name in enumerate(self.net.transitions):
            rate, weight = self.rate[t], self.weight[t]
            if rate is not None and not 0 < rate < float("inf"):
                raise ValueError(f"{name} has the rate {rate}; a rate is positive and finite (1/s)")
            if rate is None and not 0 < weight < float("inf"):
                raise ValueError(f"{name} has the weight {weight}; a weight is positive and finite")
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
        """Name the timed transitions with their rates; all others are immediate (weight 1, and
        above the timed ones).

        The net's own priorities order the immediate transitions; they are raised together if the
        lowest is below 1.
        """
        for given in (rates, weights or {}, servers or {}):
            unknown = [name for name in given if name not in net.transition_index]
            if unknown:
                raise ValueError(f"{unknown[0]!r} is no transition of the net")
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
        """What if: the same GSPN with some rates (of timed) and weights (of immediate transitions)
        replaced."""
        rate, weight = list(self.rate), list(self.weight)
        for name, value in (rates or {}).items():
            t = self.net.transition_index[name]
            if rate[t] is None:
                raise ValueError(f"{name} is immediate; it has a weight, no rate")
            rate[t] = float(value)
        for name, value in (weights or {}).items():
            t = self.net.transition_index[name]
            if rate[t] is not None:
                raise ValueError(f"{name} is timed; it has a rate, no weight")
            weight[t] = float(value)
        return replace(self, rate=tuple(rate), weight=tuple(weight))

    def marked(self, tokens: Mapping[str, int]) -> Gspn:
        """What if: the same GSPN with other initial tokens in some places."""
        initial = list(self.net.initial)
        for name, n in tokens.items():
            initial[self.net.place_index[name]] = n
        return replace(self, net=replace(self.net, initial=tuple(initial)))

    def degree(self, marking: Marking, t: int) -> int:
        """How many servers of an enabled timed transition are at work in a marking."""
        servers = self.servers[t]
        if servers == 1 or not self.net.consume[t]:
            return 1
        able = min(marking[p] // w for p, w in self.net.consume[t])
        return able if servers is None else min(able, servers)


@dataclass(frozen=True)
class Chain:
    """The extended Markov chain of a GSPN over its reachable markings (vanishing ones included),
    from marking 0.

    Edges are sorted by source. `amount[e]` is a rate (1/s) where the source is tangible and a
    weight where it vanishes. Absorbing markings have no edges.
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
        cls,
        gspn: Gspn,
        *,
        space: Space | None = None,
        limits: SearchLimits | None = None,
        absorbing: Callable[[Marking], bool] | None = None,
    ) -> Chain:
        """The chain behind a GSPN; its space is explored unless given.

        Raises ValueError if the space is not complete (simulate instead) and TimelessTrap.
        """
        space = space or explore(gspn.net, limits=limits)
        if not space.complete:
            raise ValueError(
                f"a Markov chain needs all markings; the search stopped: {space.reason}; "
                "simulate instead"
            )
        label = space.label.astype(np.int64)
        timed = np.array([r is not None for r in gspn.rate], dtype=np.bool_)
        vanishing = np.zeros(len(space), dtype=np.bool_)
        vanishing[space.source[~timed[label]]] = True
        kept = np.ones(len(label), dtype=np.bool_)
        if absorbing is not None:
            ends = space.where(absorbing)
            kept = ~ends[space.source]
            vanishing &= ~ends
        base = np.array(
            [r if r is not None else w for r, w in zip(gspn.rate, gspn.weight, strict=True)]
        )
        amount = base[label] * _degrees(gspn, space, label)
        chain = cls(
            gspn,
            space,
            space.source[kept],
            space.target[kept],
            label[kept],
            amount[kept],
            vanishing,
        )
        chain._refuse_traps()
        return chain

    def _refuse_traps(self) -> None:
        if not self.vanishing.any():
            return
        trapped = self.vanishing & ~self.graph.backward(~self.vanishing)
        if trapped.any():
            first = int(np.argmax(trapped))
            names = sorted({self.gspn.net.transitions[t] for t in self.label[trapped[self.source]]})
            where = self.gspn.net.describe(self.space.marking(first))
            raise TimelessTrap(
                f"time never passes again from {where}: {', '.join(names)} fire for ever; "
                "give one a rate"
            )

    @property
    def n(self) -> int:
        """Number of markings."""
        return len(self.space)

    @cached_property
    def graph(self) -> Graph:
        """The chain's edges as a graph."""
        return Graph(self.n, self.source, self.target)

    @cached_property
    def total(self) -> Values:
        """Sum of the amounts of each marking's edges, shape (n,); 0 for absorbing markings."""
        return sum_by(self.source, self.amount, self.n)

    @cached_property
    def probability(self) -> Values:
        """Probability that each edge is the one taken from its source, shape (edges,)."""
        out: Values = self.amount / self.total[self.source]
        return out

    @cached_property
    def sojourn(self) -> Values:
        """Mean time in each marking (s): 0 where it vanishes, infinite where it absorbs, shape
        (n,)."""
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
    """Servers at work on each edge."""
    degree = np.ones(len(label))
    for t, servers in enumerate(gspn.servers):
        if servers == 1 or gspn.rate[t] is None or not gspn.net.consume[t]:
            continue
        edges = np.flatnonzero(label == t)
        at = space.source[edges]
        able = np.min([space.tokens(p)[at] // w for p, w in gspn.net.consume[t]], axis=0)
        degree[edges] = able if servers is None else np.minimum(able, servers)
    return degree
