"""Explain a dead end of the execution graph: which place lacks a token, which firing took it last,
and which path should have returned it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from petrobot.coordinator.analysis.execution.graph import ExecutionGraph
from petrobot.coordinator.engine import Phase, State
from petrobot.coordinator.engine.draft import Draft
from petrobot.coordinator.engine.firing import Obstacle, obstacles
from petrobot.coordinator.task import Kind
from petrobot.coordinator.task.compiled_task import CompiledTransition
from petrobot.coordinator.task.conditions import And, Compare, Expression, Literal, Name
from petrobot.coordinator.task.conditions.language import Node
from petrobot.coordinator.task.net import Net

MOST = 4
"""The most waiting transitions that are explained one by one."""


def settled(x: ExecutionGraph, state: int) -> int:
    """Return the state in which a dead end stops: the nearest one without outgoing edges."""
    out = np.bincount(x.source[~x.by_hand], minlength=len(x)) == 0
    edges = x.graph.path(state, out, ~x.by_hand)
    return int(x.target[edges[-1]]) if edges else state


def describe(x: ExecutionGraph, state: int) -> str:
    """Return the marked places of a state, with how the runs in them ended."""
    at, net = x.states[state], x.engine.compiled.net
    told = {}
    for place, tokens in zip(net.places, at.marking, strict=True):
        ended = [_ended(at, place, i) for i in range(tokens)] if place in at.tokens else []
        if any(ended):
            told[place] = f"{place} ({', '.join(one or 'active' for one in ended)})"
    stopping = (f"{run.place} (stopping)" for run in at.stopping.values())
    return " ".join((net.describe(at.marking, told), *stopping))


def _ended(at: State, place: str, i: int) -> str:
    runs = at.tokens[place]
    run = runs[i] if i < len(runs) else None
    return f"ended in {run.status}" if run is not None and run.phase is Phase.DONE else ""


def explain(x: ExecutionGraph, state: int) -> str:
    """Return why nothing can happen any more in a settled state."""
    draft = Draft(x.engine.compiled, x.states[state])
    ended = {r.place for r in x.states[state].runs() if r.phase is Phase.DONE}
    firings = x.firings(state)
    waiting = [t for t in x.engine.compiled.transitions if _near(t, ended, draft.marking)]
    told = list[tuple[tuple[int, bool], str]]()
    missed, spent, left = _asked(x, draft, firings)
    for t in waiting if ended else [t for t in waiting if not _at_rest(draft, t)] or waiting:
        found = obstacles(draft, t)
        surplus = left.intersection(p for p, _ in t.needs)
        short = {one.place for one in found if one.kind == "short"}
        if not ended and not surplus and short & spent:
            continue  # the end wants that place empty, and so it is
        if ended and all(_other_end(draft, one) for one in found):
            continue
        parts = [_cause(x, draft, firings, one) for one in found if not _other_end(draft, one)]
        nearness = len(found), not any(one.kind == "full" for one in found)
        told.append((nearness, f"{t.name} {' and '.join(parts)}"))
    more = f"; and {len(told) - MOST} more" if len(told) > MOST else ""
    if told:
        told.sort(key=lambda one: one[0])  # the transition that lacks least comes first
        return "; ".join(text for _, text in told[:MOST]) + more
    if ended:
        return f"no transition takes what ended in {', '.join(sorted(ended))} that way"
    return f"no transition takes what is left, and the end asks for {missed}"


def _asked(
    x: ExecutionGraph, draft: Draft, firings: tuple[str, ...]
) -> tuple[str, set[int], set[int]]:
    """Return what of the designed ends does not hold, in words, the places that `final` wants
    to be empty and that are, and the places with tokens that it does not want there."""
    task, index = x.engine.compiled.task, x.engine.compiled.net.place_index
    held = {name: draft.marking[p] for name, p in index.items()}
    missed, spent, left = list[str](), set[int](), set[int]()
    for node in _conjuncts(task.final.tree):
        if not (isinstance(node, Compare) and isinstance(node.left, Name)):
            missed += [str(task.final)] * (not Expression("", node).holds(held))
            continue
        name = node.left.name
        if not Expression("", node).holds(held):
            wanted = node.right.value if isinstance(node.right, Literal) else node.right
            why = "" if held[name] else f": {_fate(task.net, draft, firings, index[name])}"
            missed.append(f"{name} {node.sign} {wanted} (it holds {held[name]}{why})")
            if held[name] and Expression("", node).holds({**held, name: 0}):
                left.add(index[name])
        elif not held[name]:
            spent.add(index[name])
    ends = [" and ".join(dict.fromkeys(missed))]
    ends += [str(task.final_error)] if task.final_error is not None else []
    return ", or for ".join(ends), spent, left


def _conjuncts(node: Node) -> Iterator[Node]:
    if isinstance(node, And):
        for operand in node.operands:
            yield from _conjuncts(operand)
    else:
        yield node


def _near(t: CompiledTransition, ended: set[str], marking: Sequence[int]) -> bool:
    if ended:
        return any(arc.name in ended for arc in t.actions)
    return any(marking[p] for p, _ in t.needs)


def _at_rest(draft: Draft, t: CompiledTransition) -> bool:
    """Whether all tokens that the transition could take now are free resources."""
    net, places = draft.compiled.net, tuple(draft.compiled.task.places.values())
    there = [p for p, _ in t.needs if draft.marking[p]]
    return all(
        places[p].kind is Kind.RESOURCE and draft.marking[p] == net.initial[p] for p in there
    )


def _other_end(draft: Draft, one: Obstacle) -> bool:
    """Return whether the transition is blocked only because the run there ended with another
    status."""
    if one.kind != "run" or one.place is None:
        return False
    return bool(draft.tokens.get(draft.compiled.net.places[one.place]))


def _cause(x: ExecutionGraph, draft: Draft, firings: tuple[str, ...], one: Obstacle) -> str:
    net = x.engine.compiled.net
    if one.kind == "full" and one.place is not None:
        changes = (change for some in net.compiled.changes for change in some)
        emptied = any(p == one.place and gain < 0 for p, gain in changes)
        return one.text if emptied else f"{one.text}, and no transition takes any out of it"
    if one.kind != "short" or one.place is None:
        return one.text
    return f"{one.text}: {_fate(net, draft, firings, one.place)}"


def _fate(net: Net, draft: Draft, firings: tuple[str, ...], place: int) -> str:
    """Return which firing took the place's tokens last, and where they went."""
    change = [dict(changes).get(place, 0) for changes in net.compiled.changes]
    givers = [t for t, gain in enumerate(change) if gain > 0]
    order = [net.transition_index[name] for name in firings]
    last = max((i for i, t in enumerate(order) if change[t] < 0), default=None)
    back = ", ".join(f"`{net.transitions[t]}`" for t in givers)
    if last is None and givers:
        return f"only {back} can fill it{_elsewhere(net, order, givers)}"
    if last is None:
        return "nothing ever fills it"
    taker = f"taken by `{net.transitions[order[last]]}`"
    if not givers:
        return f"{taker}, and no transition returns it"
    movers, carried = _carried(net, order[last:])
    held = [net.places[p] for p in sorted(carried) if draft.marking[p]]
    names = ", ".join(f"`{net.transitions[t]}`" for t in dict.fromkeys(movers))
    if not _leads(net, carried, set(givers)):
        if movers:
            return f"{taker}, never returned by {names}"
        return f"{taker}, and nothing that follows it returns it"
    where = f"still held with {' and '.join(held)}" if held else f"to be returned by {back}"
    return f"{taker}, not returned by {names}; {where}" if movers else f"{taker}, {where}"


def _elsewhere(net: Net, order: list[int], givers: list[int]) -> str:
    """Return which firing took last what would have led to one of the givers of a place; empty if
    none did."""
    wanted, seen = set(givers), set[int]()
    while wanted:
        needed = {p for t in wanted for p, _ in net.consume[t] if not net.initial[p]} - seen
        for t in reversed(order):
            taken = [p for p, _ in net.consume[t] if p in needed]
            if taken and t not in wanted:
                return f", but `{net.transitions[t]}` took {net.places[taken[0]]}"
        seen |= needed
        wanted = {t for t, arcs in enumerate(net.produce) if any(p in needed for p, _ in arcs)}
    return ""


def _carried(net: Net, order: list[int]) -> tuple[list[int], set[int]]:
    """Follow the tokens that the first firing produced through the later firings. Return the
    firings that moved some of them, and the places that they reached. Places that have tokens at
    the beginning, such as other resources, are not followed: a token that arrives there was
    returned."""
    given = [{p for p, _ in arcs if not net.initial[p]} for arcs in net.produce]
    movers, carried = list[int](), given[order[0]]
    for t in order[1:]:
        taken = {p for p, _ in net.consume[t]} & carried
        if taken and taken != given[t] & taken:
            movers.append(t)
            carried = (carried - taken) | given[t]
    return movers, carried


def _leads(net: Net, places: set[int], givers: set[int]) -> bool:
    """Return whether arcs lead from one of the places to a transition that fills the place."""
    reached = set(places)
    while True:
        fed = {t for t, arcs in enumerate(net.consume) if reached & {p for p, _ in arcs}}
        if fed & givers:
            return True
        more = {p for t in fed for p, _ in net.produce[t]}
        if more <= reached:
            return False
        reached |= more
