"""Which of the transitions that can fire at once does so first, as the engine decides it."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from petrobot.coordinator.analysis.net.graph import Graph
from petrobot.coordinator.task import End
from petrobot.coordinator.task.compiled_task import CompiledTransition
from petrobot.coordinator.task.wording import few

Edges = set[tuple[int, int]]
_Neighbours = list[set[int]]
"""By transition: others, by their numbers."""


def firing_order(
    moves: Sequence[CompiledTransition],
    reads: Mapping[str, set[str]],
    drawn: Iterable[tuple[str, str]],
) -> tuple[dict[str, int], list[str]]:
    """Return a number for each transition, and what is doubtful: of those that can fire at once,
    the one with the highest number does so first.

    By rank; among equals as in a step of the engine, whose transitions are all judged in one
    marking. So a transition comes after those that it spoils, and after those that compete with,
    spoil or are spoiled by what it enables. What competes for tokens, or spoils each other, keeps
    one number: only a draw decides that. So does a longer ring, whose order in the engine depends
    on which of its transitions can fire: a doubt.

    `reads` has the variables of each condition; of the pairs in `drawn`, a draw decides whatever
    their ranks are.
    """
    rank = _ranks(moves, drawn)
    rivals, spoils, enables = _relations(moves, reads)
    ranks = defaultdict[Any, set[int]](set)
    for i, own in enumerate(rank):
        ranks[own].add(i)
    equal = [ranks[own] for own in rank]
    rivals = [r & e for r, e in zip(rivals, equal, strict=True)]
    disturbs = [set[int](r | s) for r, s in zip(rivals, spoils, strict=True)]
    for i, spoiled in enumerate(spoils):
        for j in spoiled:
            disturbs[j].add(i)
    # (i, j): i comes before j. `soon` matters less, so it yields where the two contradict.
    hard, soon = Edges(), Edges()
    for j in range(len(moves)):
        hard |= {(i, j) for i in (spoils[j] & equal[j]) | rivals[j]}
        first = set[int]().union(*(disturbs[k] for k in enables[j]))
        soon |= {(i, j) for i in first & equal[j]}
    spoiling = {(i, j) for j in range(len(moves)) for i in spoils[j] & equal[j]}
    rings = _groups(len(moves), spoiling)
    lost = {rings[i] for i, j in spoiling if rings[i] == rings[j] and (j, i) not in hard}
    doubts = []
    for number in sorted(lost):
        names = few([x.name for x, n in zip(moves, rings, strict=True) if n == number])
        text = "each keeps the next one from firing, in a ring, so a draw decides who is first"
        doubts.append(f"{names}: {text}")
    ring = _groups(len(moves), hard | soon)
    level = _levels(len(moves), hard | {(i, j) for i, j in soon if ring[i] != ring[j]})
    keys = list(zip(rank, level, strict=True))
    order = sorted(set(keys), reverse=True)
    return {x.name: order.index(key) for x, key in zip(moves, keys, strict=True)}, doubts


def _ranks(moves: Sequence[CompiledTransition], drawn: Iterable[tuple[str, str]]) -> list[Any]:
    """Return the rank of each transition, equal where a draw decides."""
    rank = [x.rank for x in moves]
    index = {x.name: i for i, x in enumerate(moves)}
    pairs = [(index[name], index[rival]) for name, rival in drawn]
    while above := [(i, j) for i, j in pairs if rank[i] < rank[j]]:
        for i, j in above:
            rank[j] = min(rank[i], rank[j])
    return rank


def _relations(
    moves: Sequence[CompiledTransition], reads: Mapping[str, set[str]]
) -> tuple[_Neighbours, _Neighbours, _Neighbours]:
    """Return with which transitions each one competes for a token or a variable, which ones it may
    keep from firing (it spoils them), and which ones it may enable."""
    takers, barred, readers, setters = (defaultdict[Any, set[int]](set) for _ in range(4))
    for i, x in enumerate(moves):
        ends = [(a.place, str(a.end)) for a in x.actions if a.end is not End.GOING]
        for kind in [*ends, *((p, "") for p, _ in x.plain)]:
            takers[kind].add(i)
        for p, _ in x.bars:
            barred[p].add(i)
        for name, value in x.sets:
            setters[name].add(i)
            for read in value.names:
                readers[read].add(i)
        for name in reads.get(x.name, ()):
            readers[name].add(i)
    rivals, spoils, enables = ([set[int]() for _ in moves] for _ in range(3))
    for group in (*takers.values(), *setters.values()):
        for i in group:
            rivals[i] |= group
    for i, x in enumerate(moves):
        for p, n in x.changes:
            (spoils if n > 0 else enables)[i].update(barred[p])
            enables[i] |= takers[p, ""] if n > 0 else set()
        for name, _ in x.sets:
            spoils[i] |= readers[name]
            enables[i] |= readers[name]
    return rivals, spoils, enables


def _groups(n: int, edges: Edges) -> list[int]:
    """Return the number of the strong component of each vertex."""
    pairs = np.array(sorted(edges), np.int32).reshape(-1, 2)
    found: list[int] = Graph(n, pairs[:, 0], pairs[:, 1]).components.tolist()
    return found


def _levels(n: int, edges: Edges) -> list[int]:
    """Return a number for each vertex that grows along the edges, except within a cycle."""
    group, level = _groups(n, edges), [0] * n
    links = {(group[i], group[j]) for i, j in edges if group[i] != group[j]}
    while late := [(i, j) for i, j in links if level[j] <= level[i]]:
        for i, j in late:
            level[j] = level[i] + 1
    return [level[g] for g in group]
