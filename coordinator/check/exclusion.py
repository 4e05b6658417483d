"""Pairs of transitions that invariants keep from being enabled together.

A P-semiflow is a vector y >= 0 of integers with y C = 0: y M is the same in every reachable
marking. If two transitions together need tokens worth more than that, they are never enabled in one
marking. Found by Farkas' elimination; where that grows beyond `ROWS` the answer is only that
nothing is proved. Control places are left out, since the operator may put tokens into them.
"""

from __future__ import annotations

from math import gcd

from petrobot.coordinator.net import Net
from petrobot.coordinator.task import Kind, Task

ROWS = 2000
Flow = dict[int, int]
"""Weights by place index."""


def semiflows(task: Task) -> tuple[Flow, ...]:
    """P-semiflows without control places; empty if there are none or too many to find here."""
    net = task.net
    places = [i for i, p in enumerate(task.places.values()) if p.kind is not Kind.CONTROL]
    rows: list[tuple[Flow, dict[int, int]]] = [({p: 1}, _effects(net, p)) for p in places]
    for t in range(len(net.transitions)):
        rest = [r for r in rows if not r[1].get(t)]
        gain = [r for r in rows if r[1].get(t, 0) > 0]
        loss = [r for r in rows if r[1].get(t, 0) < 0]
        if len(rest) + len(gain) * len(loss) > ROWS:
            return ()
        rows = _minimal(rest + [_combine(a, b, t) for a in gain for b in loss])
    return tuple(flow for flow, _ in rows)


def never_together(net: Net, flows: tuple[Flow, ...], t: int, u: int) -> bool:
    """Whether some semiflow shows that no reachable marking enables both transitions."""
    need = dict(net.consume[t])
    for p, w in net.consume[u]:
        need[p] = max(w, need.get(p, 0))
    return any(
        sum(y * need.get(p, 0) for p, y in flow.items())
        > sum(y * net.initial[p] for p, y in flow.items())
        for flow in flows
    )


def _effects(net: Net, place: int) -> dict[int, int]:
    """Net gain of the place by transition, zeros left out."""
    effects: dict[int, int] = {}
    for t in range(len(net.transitions)):
        gain = dict(net.produce[t]).get(place, 0) - dict(net.consume[t]).get(place, 0)
        if gain:
            effects[t] = gain
    return effects


def _combine(
    a: tuple[Flow, dict[int, int]], b: tuple[Flow, dict[int, int]], t: int
) -> tuple[Flow, dict[int, int]]:
    """The positive combination of a row that gains and one that loses in which t changes
    nothing."""
    x, y = -b[1][t], a[1][t]
    flow = _sum(a[0], x, b[0], y)
    effect = _sum(a[1], x, b[1], y)
    divisor = gcd(*flow.values(), *effect.values())
    return {p: w // divisor for p, w in flow.items()}, {s: w // divisor for s, w in effect.items()}


def _sum(a: dict[int, int], x: int, b: dict[int, int], y: int) -> dict[int, int]:
    total = {k: x * a.get(k, 0) + y * b.get(k, 0) for k in {*a, *b}}
    return {k: v for k, v in total.items() if v}


def _minimal(rows: list[tuple[Flow, dict[int, int]]]) -> list[tuple[Flow, dict[int, int]]]:
    """Rows whose support contains no other row's."""
    kept: list[tuple[Flow, dict[int, int]]] = []
    for row in sorted(rows, key=lambda r: len(r[0])):
        if not any(other[0].keys() <= row[0].keys() for other in kept):
            kept.append(row)
    return kept
