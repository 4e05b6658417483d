"""The simulation loop that numba compiles: one replica, only the transitions that a firing touches.

Without numba the same code runs in Python: same results, but slow (services/host/numba_kernels.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from petrobot.coordinator.analysis.time.gspn import Gspn
from petrobot.services.host.numba_kernels import kernel

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
UNLIMITED = 1 << 60
"""Number that stands for unlimited servers."""


class Tables(NamedTuple):
    """A GSPN as flat arrays: the entries of transition t are those with first[t] <= k < first[t +
    1]."""

    need_first: Ints
    need_place: Ints
    need_weight: Ints
    bar_first: Ints
    bar_place: Ints
    bar_threshold: Ints
    move_first: Ints
    move_place: Ints
    move_change: Ints
    touch_first: Ints
    touch: Ints
    """Transitions to test again after a firing of t. One further row lists all transitions, for
    the initial marking."""
    base: Floats
    """Rate of a timed, weight of an immediate transition."""
    servers: Ints
    """Servers of a timed transition or UNLIMITED; 1 for immediate transitions and those that
    consume nothing."""
    priority: Ints

    @classmethod
    def of(cls, gspn: Gspn) -> Tables:
        """Return the tables of a GSPN."""
        rule = gspn.net.compiled
        deps = [[(u, 0) for u in touched] for touched in rule.dependents()] + [
            [(u, 0) for u in range(len(rule.needs))]
        ]
        timed = [r is not None for r in gspn.rate]
        servers = [
            (UNLIMITED if k is None else k) if on else 1
            for k, on in zip(gspn.servers, timed, strict=True)
        ]
        return cls(
            *_ragged(rule.needs),
            *_ragged(rule.bars),
            *_ragged(rule.changes),
            *_ragged(deps)[:2],
            np.array([w if r is None else r for r, w in zip(gspn.rate, gspn.weight, strict=True)]),
            np.array(servers, dtype=np.int64),
            np.array(rule.priority, dtype=np.int64),
        )


def _ragged(rows: Sequence[Sequence[tuple[int, int]]]) -> tuple[Ints, Ints, Ints]:
    flat = [pair for row in rows for pair in row]
    first = np.cumsum([0, *map(len, rows)], dtype=np.int64)
    return (
        first,
        np.array([a for a, _ in flat], dtype=np.int64),
        np.array([b for _, b in flat], dtype=np.int64),
    )


@kernel
def settle(area: Floats, tokens: Ints, since: Floats, now: float) -> None:
    """Add the token seconds of every place since its tokens last changed."""
    for p in range(len(tokens)):
        if now > since[p]:
            area[p] += tokens[p] * (now - since[p])


@kernel
def play(
    initial: Ints,
    tables: Any,
    random: Any,
    horizon: float,
    warmup: float,
    budget: int,
    fires: Floats,
    area: Floats,
) -> tuple[int, float]:
    """Play one replica until the horizon (s) or its budget of firings.

    Return (firings, time observed from warmup on in s). `fires` and `area` (token seconds) receive
    what happened from warmup on. One loop without helpers, because a compiled call would count the
    references of its arrays every time.
    """
    need_first, need_place, need_weight, bar_first, bar_place, bar_threshold = tables[:6]
    move_first, move_place, move_change, touch_first, touch = tables[6:11]
    base, servers, priority = tables[11:]
    tokens, since = initial.copy(), np.full(len(initial), warmup)
    count = len(priority)
    amount, now, fired, t = np.zeros(count), 0.0, 0, count
    while True:
        for at in range(touch_first[t], touch_first[t + 1]):
            u = touch[at]
            able, degree = True, servers[u]
            for k in range(need_first[u], need_first[u + 1]):
                have, weight = tokens[need_place[k]], need_weight[k]
                if have < weight:
                    able = False
                    break
                degree = min(degree, have // weight) if degree > 1 else degree
            for k in range(bar_first[u], bar_first[u + 1]):
                if tokens[bar_place[k]] >= bar_threshold[k]:
                    able = False
            amount[u] = base[u] * degree if able else 0.0
        top, total = np.int64(-1), 0.0
        for u in range(count):
            if amount[u] > 0.0 and priority[u] >= top:
                total = amount[u] + (total if priority[u] == top else 0.0)
                top = priority[u]
        stay = random.standard_exponential() / total if top == 0 else 0.0
        now = horizon if top < 0 else min(horizon, now + stay)
        if now >= horizon or fired >= budget:
            break
        left = random.random() * total
        for u in range(count):
            if amount[u] > 0.0 and priority[u] == top:
                t = u
                left -= amount[u]
                if left < 0.0:
                    break
        for k in range(move_first[t], move_first[t + 1]):
            p = move_place[k]
            if now > since[p]:
                area[p] += tokens[p] * (now - since[p])
                since[p] = now
            tokens[p] += move_change[k]
        fires[t] += now >= warmup
        fired += 1
    settle(area, tokens, since, now)
    return fired, max(0.0, now - warmup)
