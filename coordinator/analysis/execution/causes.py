"""Explain a dead end of the execution graph: which place lacks a token, which firing took it last,
and which path should have returned it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from petrobot.coordinator.analysis.execution.graph import ExecutionGraph
from petrobot.coordinator.analysis.execution.names import cases
from petrobot.coordinator.engine import Phase, State
from petrobot.coordinator.engine.draft import Draft
from petrobot.coordinator.engine.firing import Obstacle, in_words, obstacles
from petrobot.coordinator.task import Kind
from petrobot.coordinator.task.compiled_task import CompiledTransition
from petrobot.coordinator.task.conditions import And, Compare, Expression, Literal, Name
from petrobot.coordinator.task.conditions.language import Node, as_literal
from petrobot.coordinator.task.net import EMPTY, Net

MOST = 4
"""The most waiting transitions that are explained one by one."""


def settled(x: ExecutionGraph, state: int) -> int:
    """Return the state in which a dead end stops: the nearest one without outgoing edges."""
    out = np.bincount(x.source[~x.by_hand], minlength=len(x)) == 0
    edges = x.graph.path(state, out, ~x.by_hand)
    return int(x.target[edges[-1]]) if edges else state


Lack = tuple[CompiledTransition, list[Obstacle], int]
"""A transition, what it lacks there, and how much it lacks with the ends that came otherwise."""


class Explanation(NamedTuple):
    """Why nothing can happen any more."""

    short: str
    """The most important cause."""
    details: tuple[str, ...]
    """Other causes, and where the missing tokens went, a line each."""


def describe(x: ExecutionGraph, state: int) -> str:
    """Return the marked places of a state, with how the runs in them ended."""
    return _told(x, x.states[state], lambda _: True) or "no token"


def left_over(x: ExecutionGraph, state: int) -> str:
    """Return the marked places of a state without those that do not matter for what is stuck there:
    free resources, and where runs have ended, all other tokens."""
    at, task = x.states[state], x.engine.compiled.task
    ended = any(run.phase is Phase.DONE for run in at.runs())

    def matters(place: str) -> bool:
        own = task.places[place]
        if own.kind is Kind.ACTION:
            return True
        free = own.tokens == at.marking[task.net.place_index[place]]
        return not ended and not (own.kind is Kind.RESOURCE and free)

    return _told(x, at, matters) or ("free resources alone" if any(at.marking) else "no token")


def _told(x: ExecutionGraph, at: State, matters: Callable[[str], bool]) -> str:
    net, told, shown = x.engine.compiled.net, dict[str, str](), []
    for place, tokens, initial in zip(net.places, at.marking, net.initial, strict=True):
        hidden = not matters(place)
        shown.append((initial if place in net.counters else 0) if hidden else tokens)
        ended = [_ended(at, place, i) for i in range(tokens)] if place in at.tokens else []
        if any(ended) and not hidden:
            told[place] = f"{place} ({', '.join(one or 'active' for one in ended)})"
    stopping = (f"{run.place} (stopping)" for run in at.stopping.values())
    words = (net.describe(tuple(shown), told), *stopping)
    return " ".join(word for word in words if word != EMPTY)


def _ended(at: State, place: str, i: int) -> str:
    runs = at.tokens[place]
    run = runs[i] if i < len(runs) else None
    return f"ended in {run.status}" if run is not None and run.phase is Phase.DONE else ""


def explain(x: ExecutionGraph, state: int, still: Collection[str] = ()) -> Explanation:
    """Return why nothing can happen any more in a settled state, or nothing but firings of `still`,
    for ever; `short` is empty if no other token is stuck."""
    draft = Draft(x.engine.compiled, x.states[state])
    firings, transitions = x.firings(state), x.engine.compiled.transitions
    stays, net = list(draft.marking), x.engine.compiled.net
    for t in transitions:
        for p, _ in (*net.consume[t.index], *net.produce[t.index]) if t.name in still else ():
            stays[p] = 0
    done = {r.place for r in x.states[state].runs() if r.phase is Phase.DONE}
    ended = {place for place in done if stays[net.place_index[place]]}
    waiting = [t for t in transitions if t.name not in still and _near(t, ended, stays)]
    missed, spent, left, gone = _asked(x, draft, firings)
    if not ended:
        left |= {p for p, n in enumerate(draft.marking) if n and not net.initial[p]}
        used = _used_up(net, draft.marking, spent)
        waiting = [t for t in waiting if not _at_rest(draft, t)]
        waiting = [t for t in waiting if left.intersection(p for p, _ in t.needs)] or [
            t for t in waiting if used.isdisjoint(_short(obstacles(draft, t)))
        ]
    lacks = list[Lack]()
    for t in _by_copy(draft, waiting):
        found = obstacles(draft, t)
        own = [one for one in found if one.kind != "run"]
        if own or not ended:
            lacks.append((t, own, len(found)))
    if not lacks and ended:
        names = ", ".join(sorted(ended))
        return Explanation(f"no transition takes what ended in {names} that way", ())
    if not lacks and still:
        return Explanation("", (f"the end asks for {missed}", *gone))
    if not lacks:
        text = f"no transition takes what is left, and the end asks for {missed}"
        return Explanation(text, gone)
    # What waits for a token that another of them could move comes last; first, what lacks least.
    takes = {t.index: {p for p, _ in t.needs} for t, _, _ in lacks}
    follows = {
        t.index
        for t, own, _ in lacks
        for p in _short(own)
        for held in [_held(net, draft, _since(net, firings, p))]
        if any(not places.isdisjoint(held) for u, places in takes.items() if u != t.index)
    }
    lacks.sort(key=lambda one: (one[0].index in follows, one[2], _rank(net, one[0], one[1])))
    told = [
        f"{t.name} {' and '.join(obstacle_text(draft, t, one) for one in own)}"
        for t, own, _ in lacks
    ]
    more = [f"and {len(told) - MOST} more"] if len(told) > MOST else []
    known = {t.index for t, _, _ in lacks}
    fates = [
        fate
        for _, own, _ in lacks[:MOST]
        for one in own
        for fate in _fates(x, draft, firings, one, known)
    ]
    fates += [
        line
        for t, own, _ in lacks[:MOST]
        if any(one.kind == "condition" for one in own)
        for line in _values(draft, t, firings)
    ]
    # A place that the end wants empty is not to be filled: what else the end asks for comes first.
    spare = not ended and any(one.place in spent for one in lacks[0][1])
    first = f"the end asks for {missed}, and {told[0]}" if spare else told[0]
    return Explanation(first, (*told[1:MOST], *more, *dict.fromkeys(fates)))


def fate(x: ExecutionGraph, state: int, place: int) -> str:
    """Return which firing took the place's tokens last on the way to a state, and where they
    went."""
    draft = Draft(x.engine.compiled, x.states[state])
    return _fate(x.engine.compiled.net, draft, x.firings(state), place)


def awaiting(x: ExecutionGraph, state: int, place: str) -> str:
    """Return what keeps a run of a place that has ended there, although events and times may still
    come."""
    draft = Draft(x.engine.compiled, x.states[state])
    for t in x.engine.compiled.transitions:
        if any(arc.name == place for arc in t.actions):
            found = obstacles(draft, t)
            if not found:
                return f"{t.name} waits for {in_words(draft, t)}"
            if not any(
                one.kind == "run" and draft.compiled.net.places[one.place or 0] == place
                for one in found
            ):
                return f"{t.name} {' and '.join(obstacle_text(draft, t, one) for one in found)}"
    return f"no transition takes a run of {place} that ended that way"


def _short(found: Sequence[Obstacle]) -> set[int]:
    """Return the places that hold too few tokens."""
    return {one.place for one in found if one.kind == "short" and one.place is not None}


def _by_copy(draft: Draft, waiting: Sequence[CompiledTransition]) -> Iterator[CompiledTransition]:
    """Yield of the copies that `tries` makes of a transition the one that lacks least: the others
    are for another number of used tries."""
    lacking = {t.name: (len(obstacles(draft, t)), t.index) for t in waiting}
    kept = {
        min(copies & lacking.keys(), key=lacking.__getitem__)
        for copies in cases(draft.compiled.task).values()
        if copies & lacking.keys()
    }
    return (t for t in waiting if t.name in kept)


def _used_up(net: Net, marking: Sequence[int], spent: set[int]) -> set[int]:
    """Return the places that `final` wants empty and that are (`spent`), and the empty places that
    only tokens from there could fill."""
    used = set(spent)
    while more := {
        p
        for taken, given in zip(net.consume, net.produce, strict=True)
        for p, _ in given
        if p not in used and not marking[p] + net.initial[p] and used & {q for q, _ in taken}
    }:
        used |= more
    while filled := {
        p
        for taken, given in zip(net.consume, net.produce, strict=True)
        for p, _ in given
        if p in used - spent and used.isdisjoint(q for q, _ in taken)
    }:
        used -= filled
    return used


def _rank(net: Net, t: CompiledTransition, found: Sequence[Obstacle]) -> int:
    """Return how far from the cause a transition is that lacks this: a full place or a condition
    says more than an inhibitor arc or an empty place, which often only follow from it."""
    if any(one.kind == "full" for one in found):
        inhibitors = {p for p, _ in net.inhibit[t.index]}
        return 2 if all(one.place in inhibitors for one in found if one.kind == "full") else 0
    return 3 if any(one.kind == "short" for one in found) else 1


def obstacle_text(draft: Draft, t: CompiledTransition, one: Obstacle) -> str:
    """Return what a transition lacks; of a false condition also the variables without a value."""
    if one.kind != "condition" or t.when is None:
        return one.text
    variables = draft.compiled.task.variables
    unset = [n for n in sorted(t.when.names & set(variables)) if draft.variables.get(n) is None]
    return f"{one.text}: {' and '.join(unset)} ha{_has(unset)} no value" if unset else one.text


def _values(draft: Draft, t: CompiledTransition, firings: Sequence[str]) -> Iterator[str]:
    """Yield who wrote the variables of a false condition, for those that only firings write."""
    task = draft.compiled.task
    told = {name for place in task.places.values() for name in place.out.values()}
    for name in sorted((t.when.names if t.when else frozenset()) & set(task.variables) - told):
        setters = [u.name for u in task.transitions.values() if name in dict(u.sets)]
        last = next((f for f in reversed(firings) if f in setters), None)
        others = [f"`{u}`" for u in setters if u != last]
        only = f"only {', '.join(others)} set{'s' * (len(others) == 1)} it"
        value = as_literal(draft.variables.get(name))
        if last is not None:
            also = f"otherwise {only}" if others else "nothing else sets it"
            yield f"{name}: `{last}` set it to {value}; {also}"
        elif others:
            yield f"{name}: {value} from the beginning; {only}"


def _has(names: Sequence[str]) -> str:
    return "s" if len(names) == 1 else "ve"


def _asked(
    x: ExecutionGraph, draft: Draft, firings: tuple[str, ...]
) -> tuple[str, set[int], set[int], tuple[str, ...]]:
    """Return what of the designed ends does not hold, in words, the places that `final` wants
    to be empty and that are, the places with tokens that it does not want there, and where the
    tokens went that it asks for."""
    task, index = x.engine.compiled.task, x.engine.compiled.net.place_index
    held = {name: draft.marking[p] for name, p in index.items()}
    missed, spent, left, gone = list[str](), set[int](), set[int](), list[str]()
    for node in _conjuncts(task.final.tree):
        if not (isinstance(node, Compare) and isinstance(node.left, Name)):
            missed += [str(task.final)] * (not Expression("", node).holds(held))
            continue
        name = node.left.name
        if not Expression("", node).holds(held):
            wanted = node.right.value if isinstance(node.right, Literal) else node.right
            missed.append(f"{name} {node.sign} {wanted} (it holds {held[name]})")
            if isinstance(wanted, int) and held[name] < wanted:
                gone.append(f"{name}: {_fate(task.net, draft, firings, index[name])}")
            if held[name] and Expression("", node).holds({**held, name: 0}):
                left.add(index[name])
        elif not held[name]:
            spent.add(index[name])
    busy = sorted({r.place for r in draft.live() if not task.places[r.place].listen})
    if not missed and busy:
        names = " or ".join(busy)
        missed.append(f"no active run of {names} (only places with `listen` may have one)")
    ends = [" and ".join(dict.fromkeys(missed))]
    ends += [str(task.final_error)] if task.final_error is not None else []
    return ", or for ".join(ends), spent, left, tuple(gone)


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
    """Whether all tokens that the transition could take now may be left at the end: free resources,
    and what only listens."""
    net, places = draft.compiled.net, tuple(draft.compiled.task.places.values())
    there = [p for p, _ in t.needs if draft.marking[p]]
    return all(
        places[p].listen or (places[p].kind is Kind.RESOURCE and draft.marking[p] == net.initial[p])
        for p in there
    )


def _fates(
    x: ExecutionGraph, draft: Draft, firings: tuple[str, ...], one: Obstacle, known: set[int]
) -> Iterator[str]:
    """Yield where the tokens went that a transition lacks, or why no other transition makes room
    for it. `known`: transitions whose lack is already explained."""
    net = x.engine.compiled.net
    if one.place is None or one.kind not in ("short", "full"):
        return
    name = net.places[one.place]
    if one.kind == "short":
        yield f"{name}: {_fate(net, draft, firings, one.place)}"
        return
    takers = [
        t for t, changes in enumerate(net.compiled.changes) if dict(changes).get(one.place, 0) < 0
    ]
    if not takers:
        yield f"{name}: no transition takes any out of it"
    for t in () if known.intersection(takers) else takers:
        taker = x.engine.compiled.transitions[t]
        lacks = [lack for lack in obstacles(draft, taker) if lack.kind != "run"]
        words = " and ".join(obstacle_text(draft, taker, lack) for lack in lacks)
        if lacks:
            yield f"{name}: `{taker.name}` would take some out of it, but it {words}"
        for lack in lacks:
            if lack.kind == "short":
                yield from _fates(x, draft, firings, lack, known)


def _since(net: Net, firings: tuple[str, ...], place: int) -> list[int]:
    """Return the firings from the last one on that took tokens of the place which have not come
    back; empty if there is none."""
    order = [net.transition_index[name] for name in firings]
    change = [dict(net.compiled.changes[t]).get(place, 0) for t in order]
    gained = 0
    for i in reversed(range(len(order))):
        gained += change[i]
        if change[i] < 0 and gained < 0:
            return order[i:]
    return []


def _held(net: Net, draft: Draft, since: list[int]) -> list[int]:
    """Return the marked places at which the tokens are that the first firing took."""
    return [p for p in sorted(_carried(net, since)[-1][1]) if draft.marking[p]] if since else []


def _fate(net: Net, draft: Draft, firings: tuple[str, ...], place: int) -> str:
    """Return which firing took the place's tokens last, and where they went."""
    givers = [
        t for t, changes in enumerate(net.compiled.changes) if dict(changes).get(place, 0) > 0
    ]
    back = ", ".join(f"`{net.transitions[t]}`" for t in givers)
    since = _since(net, firings, place)
    if not since and givers:
        order = [net.transition_index[name] for name in firings]
        return f"only {back} can fill it{_elsewhere(net, order, givers)}"
    if not since:
        return "nothing ever fills it"
    taker = f"taken by `{net.transitions[since[0]]}`"
    if not givers:
        return f"{taker}, and no transition returns it"
    steps = _carried(net, since)
    held = [net.places[p] for p in _held(net, draft, since)]
    for i, (mover, carried) in enumerate(steps):
        # firings before this one could still lead to a giver, and later ones cannot help
        if not _leads(net, carried, set(givers), place):
            if i:
                return f"{taker}, never returned by `{net.transitions[mover]}`"
            return f"{taker}, and nothing that follows it returns it"
    where = f"still held with {' and '.join(held)}" if held else f"to be returned by {back}"
    return f"{taker}, {where}"


def _elsewhere(net: Net, order: list[int], givers: list[int]) -> str:
    """Return the last firing that took a token on its way to one of the givers of a place; empty
    if none did."""
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


def _carried(net: Net, order: list[int]) -> list[tuple[int, set[int]]]:
    """Follow the tokens that the first firing produced through the later firings. Return the first
    firing and those that moved some of them, each with the places where they are after it. Places
    that have tokens at the beginning, such as other resources, are not followed: a token that
    arrives there was returned."""
    given = [{p for p, _ in arcs if not net.initial[p]} for arcs in net.produce]
    steps = [(order[0], given[order[0]])]
    for t in order[1:]:
        carried = steps[-1][1]
        taken = {p for p, _ in net.consume[t]} & carried
        if taken and taken != given[t] & taken:
            steps.append((t, (carried - taken) | given[t]))
    return steps


def _leads(net: Net, places: set[int], givers: set[int], filled: int) -> bool:
    """Return whether arcs lead from one of the places to a transition that fills the place, without
    that place itself and, as in `_carried`, those that have tokens at the beginning."""
    reached = set(places)
    while True:
        fed = {t for t, arcs in enumerate(net.consume) if reached & {p for p, _ in arcs}}
        if fed & givers:
            return True
        more = {p for t in fed for p, _ in net.produce[t] if p != filled and not net.initial[p]}
        if more <= reached:
            return False
        reached |= more
