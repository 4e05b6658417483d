"""Boundedness of nets with infinitely many markings: the Karp-Miller tree, and pumps.

If a new marking covers one of its ancestors, the firings between the two can be repeated for ever,
so every place in which it is larger gets omega ("arbitrarily many tokens"). Only ancestors are
compared: comparing with other branches would call bounded nets unbounded (p0 -> p1 and p0 -> 2 p1
with one token in p0: p1 holds at most 2).

With inhibitors omega would be wrong, because more tokens can disable a transition. So an inhibited
place with a proven bound is replaced by its complement first; without a bound the answer is
"unknown". Capacities are handled in the same way. Priorities only remove behaviour: bounds found
without them are valid, but a place that is unbounded without them may be bounded with them.

Source: R. M. Karp, R. E. Miller, Parallel program schemata, J. Comput. Syst. Sci. 3 (1969).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from operator import ge

import numpy as np
from msgspec import Struct

from petrobot.coordinator.analysis.limits import overtime
from petrobot.coordinator.analysis.net.space import Space
from petrobot.coordinator.analysis.net.structure import place_bounds
from petrobot.coordinator.task.net import Marking, Net

OMEGA = 1 << 62
"""Arbitrarily many tokens, in a marking of the tree: at least as many as any number."""
EFFORT = 20_000
"""The most nodes of the tree."""
TOKENS = 20_000_000
"""The most numbers of tokens in all nodes of the tree, or in all markings that are compared at
once: a net with more than 1,000 places gets fewer of them."""
COMPARISONS = 100
"""The most comparisons with ancestors, per allowed node: limits the time on long chains."""


class Coverability(Struct, frozen=True):
    """How many tokens each place can hold, as far as it is known.

    `bounded` is None if unknown; `reason` says why. `bounds[p]` is exact for a net without
    priorities and a complete tree, and None for a place that is unbounded or unknown. Witness of
    unboundedness: after `prefix`, `pump` can be fired for ever, and each time it leaves more tokens
    in the places `grows`.
    """

    bounded: bool | None
    bounds: tuple[int | None, ...]
    reason: str
    complete: bool
    prefix: tuple[str, ...] = ()
    pump: tuple[str, ...] = ()
    grows: tuple[str, ...] = ()
    never: tuple[str, ...] = ()
    """Transitions that a complete tree never fires: they are dead, with or without priorities."""
    exact: bool = False
    """Whether every transition outside `never` can fire: complete tree and no priorities."""


def coverability(
    net: Net, *, effort: int = EFFORT, bounds: Sequence[int | None] | None = None
) -> Coverability:
    """Return the bounds of all places by the Karp-Miller tree.

    `bounds` are proven bounds of places (by default those of the P-invariants); inhibited places
    need them. If the effort runs out after an unbounded place was found, the net is known to be
    unbounded, and no other bound is known but the proven ones.
    """
    proven = list(bounds) if bounds is not None else place_bounds(net)
    limits = [dict(bars) for bars in net.compiled.bars]
    restricting = [p for below in limits for p in below]
    unproven = sorted({p for p in restricting if proven[p] is None})
    if unproven:
        names = ", ".join(net.places[p] for p in unproven)
        unknown = tuple(b if n not in unproven else None for n, b in enumerate(proven))
        return Coverability(
            None, unknown, f"no bound is known of the inhibited place {names}", False
        )
    plain = _complemented(net, limits, proven)
    effort = min(effort, TOKENS // len(plain.places) + 1) if plain.places else effort
    tree = _Tree(plain, len(net.places))
    complete = tree.grow(effort)
    unbounded, ranked = tree.omega is not None, len(set(net.priority)) > 1
    if not complete and not unbounded:
        reason = f"the coverability tree exceeds {effort} nodes"
        return Coverability(None, tuple(proven), reason, False)
    found = tree.bounds() if complete else tuple(proven)
    prefix, pump, grows = tree.witness(net)
    never = (
        tuple(name for t, name in enumerate(net.transitions) if t not in tree.fired)
        if complete
        else ()
    )
    if unbounded and ranked:
        reason = "unbounded without its priorities; with them it may be bounded"
        return Coverability(None, found, reason, complete, prefix, pump, grows, never)
    reason = (
        f"{', '.join(grows)} can grow without end"
        if unbounded
        else "no marking covers one of its ancestors"
    )
    exact = complete and not ranked
    return Coverability(not unbounded, found, reason, complete, prefix, pump, grows, never, exact)


def _complemented(net: Net, limits: Sequence[dict[int, int]], bounds: Sequence[int | None]) -> Net:
    """Return the net without inhibitors and capacities, expressed by complement places.

    The complement of p holds bound(p) - M(p). "Fewer than k tokens in p" becomes "at least
    bound(p) - k + 1 tokens in its complement".
    """
    places = sorted({p for below in limits for p in below})
    names = [*net.places, *(f"not {net.places[p]}" for p in places)]
    number = {p: len(net.places) + i for i, p in enumerate(places)}
    total = {p: max(bounds[p] or 0, net.initial[p]) for p in places}
    consume, produce = [], []
    for t, below in enumerate(limits):
        need, give = dict(net.consume[t]), dict(net.produce[t])
        for p, change in net.compiled.changes[t]:
            if p in number:
                side = need if change > 0 else give
                side[number[p]] = abs(change)
        for p, k in below.items():
            held = max(need.get(number[p], 0), total[p] - k + 1)
            extra = held - need.get(number[p], 0)
            if extra > 0:
                need[number[p]] = held
                give[number[p]] = give.get(number[p], 0) + extra
        consume.append(tuple(sorted(need.items())))
        produce.append(tuple(sorted(give.items())))
    initial = (*net.initial, *(total[p] - net.initial[p] for p in places))
    count = len(net.transitions)
    return Net(
        tuple(names), net.transitions, tuple(consume), tuple(produce), ((),) * count, initial,
        (None,) * len(names), (0,) * count,
    )  # fmt: skip


class _Node(Struct):
    marking: Marking
    parent: int
    fired: int
    ancestor: int = -1
    """The nearest ancestor that this marking strictly covers, if omega was introduced here."""
    grown: tuple[int, ...] = ()
    """The places in which it is larger."""


class _Tree:
    """The Karp-Miller tree, grown breadth first so that chains of ancestors stay short.

    A marking that was already expanded in another node is not expanded again: it would root the
    same subtree, so no bound is lost. Omega is still introduced only by comparison with ancestors.
    """

    def __init__(self, net: Net, real: int) -> None:
        self.net, self.real = net, real
        self.nodes = [_Node(net.initial, -1, -1)]
        self.omega: int | None = None
        self.fired: set[int] = set()
        self.compared = 0

    def grow(self, effort: int) -> bool:
        """Build the tree; return False if the effort ran out."""
        expanded: set[Marking] = set()
        queue = deque([0])
        while queue:
            if overtime():
                return False
            i = queue.popleft()
            if self.nodes[i].marking in expanded:
                continue
            expanded.add(self.nodes[i].marking)
            for t in range(len(self.net.transitions)):
                after = self._fire(self.nodes[i].marking, t)
                if after is None:
                    continue
                if len(self.nodes) >= effort or self.compared > COMPARISONS * effort:
                    return False
                self.fired.add(t)
                self._add(i, t, after)
                queue.append(len(self.nodes) - 1)
        return True

    def _fire(self, marking: Marking, t: int) -> Marking | None:
        for p, w in self.net.compiled.needs[t]:
            if marking[p] < w:
                return None
        after = list(marking)
        for p, change in self.net.compiled.changes[t]:
            if after[p] != OMEGA:
                after[p] += change
        return tuple(after)

    def _add(self, parent: int, fired: int, after: Marking) -> None:
        node, covered, up = _Node(after, parent, fired), after, parent
        while up >= 0:
            older = self.nodes[up].marking
            self.compared += 1
            if older != covered and all(map(ge, covered, older)):
                wider = tuple(OMEGA if a != b else a for a, b in zip(covered, older, strict=True))
                if wider != covered:
                    if node.ancestor < 0:
                        node.ancestor = up
                        node.grown = tuple(
                            p for p, (a, b) in enumerate(zip(covered, older, strict=True)) if a != b
                        )
                    covered = wider
            up = self.nodes[up].parent
        node.marking = covered
        self.nodes.append(node)
        if node.ancestor >= 0 and self.omega is None:
            self.omega = len(self.nodes) - 1

    def bounds(self) -> tuple[int | None, ...]:
        """Return the most tokens of each original place over the tree; None for omega."""
        out: list[int | None] = []
        for p in range(self.real):
            seen = {node.marking[p] for node in self.nodes}
            out.append(None if OMEGA in seen else max(seen))
        return tuple(out)

    def witness(self, net: Net) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
        """Return (prefix, pump, places that grow) of the first omega; empty for a bounded net."""
        if self.omega is None:
            return (), (), ()
        node = self.nodes[self.omega]
        grows = tuple(net.places[p] for p in node.grown if p < self.real)
        prefix = self._fired(0, node.ancestor)
        return prefix, self._fired(node.ancestor, self.omega), grows

    def _fired(self, first: int, last: int) -> tuple[str, ...]:
        names = []
        while last != first:
            names.append(self.net.transitions[self.nodes[last].fired])
            last = self.nodes[last].parent
        return tuple(reversed(names))


# Pumps among the markings found: firing sequences that can be repeated for ever and leave more
# tokens each time. They prove a net unbounded where the tree cannot be used.

MARKINGS, LEVELS = 10_000, 400
"""The most markings that are compared with their ancestors, and ancestors for each of them."""
CANDIDATES, EACH = 1_000, 25
"""The most pairs that are examined closely, in total and at one distance."""

Pump = tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]
"""(prefix, pump, places that grow)."""


def find_pump(space: Space) -> Pump | None:
    """Return the first pump from an ancestor to a marking found, or None.

    Ancestors are those in the breadth-first tree; level by level, all markings are compared with
    their ancestor at the same distance in one numpy operation.
    """
    most = min(MARKINGS, TOKENS // len(space.net.places) + 1) if space.net.places else MARKINGS
    count = min(most, space.expanded, len(space))
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
    """Return the pump between two markings, or None if the added tokens may disable it.

    More tokens can disable a transition by an inhibitor, a capacity, or by enabling a transition of
    a higher priority.
    """
    net, before = space.net, space.path(first)
    pump = space.path(last)[len(before) :]
    fired = [net.transition_index[name] for name in pump]
    if any(p in grown for t in fired for p, _ in net.compiled.bars[t]):
        return None
    least = min(net.priority[t] for t in fired)
    above = (t for t in range(len(net.transitions)) if net.priority[t] > least)
    if any(p in grown for t in above for p, _ in net.consume[t]):
        return None
    return tuple(before), tuple(pump), tuple(net.places[p] for p in sorted(grown))
