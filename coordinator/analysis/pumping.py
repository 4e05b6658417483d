"""Unboundedness by a pump among the markings found: a sequence that ends with more tokens than it
began with, for ever.

Where the Karp-Miller tree may not be used (inhibited places without a bound, priorities) or runs
out of effort, a pump that leaves alone whatever could bar it is proof enough: it adds tokens only
to places that no inhibitor and no capacity of its own transitions looks at and from which none of
higher priority consumes. So it fires again from where it ends, and again.
"""

from __future__ import annotations

import numpy as np

from petrobot.coordinator.analysis.pack import thresholds
from petrobot.coordinator.analysis.space import Space

MARKINGS, LEVELS = 10_000, 400
"""Markings of the space that are compared with their ancestors, and ancestors that each is compared
with, at most."""
CANDIDATES, EACH = 1_000, 25
"""Pairs that are looked at closely, in all and at one distance, at most."""

Pump = tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]
"""(prefix, pump, places that grow)."""


def find_pump(space: Space) -> Pump | None:
    """The first pump from an ancestor to a marking found, along the breadth-first tree; None if
    there is none so far."""
    count = min(MARKINGS, space.expanded, len(space))
    tokens = space.layout.unpack_many(space.words[:count])
    parent = np.zeros(count, dtype=np.int64)
    parent[1:] = space.source[space.parent_edge[1:count]]
    older, left = parent, CANDIDATES
    for _ in range(LEVELS):
        change = tokens - tokens[older]
        hits = np.flatnonzero((change >= 0).all(axis=1) & (change > 0).any(axis=1))
        for last in hits[: min(left, EACH)].tolist():
            left -= 1
            found = _judged(
                space, last, int(older[last]), set(np.flatnonzero(change[last]).tolist())
            )
            if found is not None:
                return found
        if not left or not older.any():
            return None
        older = parent[older]
    return None


def _judged(space: Space, last: int, first: int, grown: set[int]) -> Pump | None:
    """The pump between two markings, unless what grows may bar it: by an inhibitor, a capacity or a
    higher priority."""
    net, before = space.net, space.path(first)
    pump = space.path(last)[len(before) :]
    fired = [net.transition_index[name] for name in pump]
    if any(grown & thresholds(net, t).keys() for t in fired):
        return None
    least = min(net.priority[t] for t in fired)
    above = (t for t in range(len(net.transitions)) if net.priority[t] > least)
    if any(p in grown for t in above for p, _ in net.consume[t]):
        return None
    return tuple(before), tuple(pump), tuple(net.places[p] for p in sorted(grown))
