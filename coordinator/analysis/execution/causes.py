"""Explain a dead end of the execution graph: which place lacks a token, which firing took it last,
and which path should have returned it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from petrobot.coordinator.analysis.execution.graph import ExecutionGraph, conjuncts
from petrobot.coordinator.analysis.execution.names import cases
from petrobot.coordinator.analysis.net.structure import place_bounds
from petrobot.coordinator.engine import Phase, State
from petrobot.coordinator.engine.draft import Draft
from petrobot.coordinator.engine.firing import Obstacle, in_words, obstacles
from petrobot.coordinator.task import Kind
from petrobot.coordinator.task.compiled_task import CompiledTransition
from petrobot.coordinator.task.conditions import Compare, Expression, Literal, Name
from petrobot.coordinator.task.conditions.language import as_literal
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
        if own := [one for one in found if one.kind != "run"]:
            lacks.append((t, own, len(found)))
    if not lacks and ended:
        names = ", ".join(sorted(ended))
        return Explanation(f"no transition takes what ended in {names} that way", ())
    if not lacks and still:
        return Explanation("", (f"the end asks for {missed}", *gone))
    if not lacks:
        text = f"no transition takes what is left, and the end asks for {missed}"
        return Explanation(text, gone)
    # What waits for another of them comes last; first, what lacks least.
    follows = _followers(net, draft, firings, lacks)
    lacks.sort(key=lambda one: (one[0].index in follows, one[2], _rank(net, one[0], one[1])))
    told = [_lacking(draft, t, own) for t, own, _ in lacks]
    more = [f"and {len(told) - MOST} more"] if len(told) > MOST else []
    known = {t.index for t, _, _ in lacks}
    fates = [
        fate
        for t, own, _ in lacks[:MOST]
        for one in own
        for fate in _fates(x, draft, firings, t, one, known)
    ]
    fates += [
        line
        for t, own, _ in lacks[:MOST]
        if any(one.kind == "condition" for one in own)
        for line in _values(draft, t, firings)
    ]
    # A place that the end wants empty is not to be filled: what else the end asks for comes first.
    spare = not ended and all(any(one.place in spent for one in own) for _, own, _ in lacks)
    first = f"the end asks for {missed}, and {told[0]}" if spare else told[0]
    return Explanation(first, (*told[1:MOST], *more, *dict.fromkeys(fates)))


def _followers(net: Net, draft: Draft, firings: tuple[str, ...], lacks: Sequence[Lack]) -> set[int]:
    """Return which of these transitions only wait for another one: it would move the tokens that
    they lack, or those that bar them. Of two that wait for each other, neither follows."""
    takes = {t.index: {p for p, _ in t.needs if draft.marking[p]} for t, _, _ in lacks}
    waits = {
        t.index: {
            u
            for one in own
            if one.place is not None
            for u, places in takes.items()
            if u != t.index and not places.isdisjoint(_movers(net, draft, firings, one))
        }
        for t, own, _ in lacks
    }
    reach = {t: _reached(waits, t) for t in waits}
    return {t for t, others in reach.items() if any(t not in reach[u] for u in others)}


def _movers(net: Net, draft: Draft, firings: tuple[str, ...], one: Obstacle) -> set[int]:
    """Return the marked places whose tokens must move before this obstacle goes away."""
    place = one.place or 0
    if one.kind != "short":
        return {place}
    if net.initial[place]:
        return set(_held(net, draft, firings, place))
    return {p for p in _leading(net, place) if draft.marking[p]}


def _reached(edges: Mapping[int, set[int]], start: int) -> set[int]:
    reached, todo = set[int](), [start]
    while todo:
        new = edges[todo.pop()] - reached
        reached |= new
        todo += new
    return reached


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
                return _lacking(draft, t, found)
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


def _lacking(draft: Draft, t: CompiledTransition, found: Sequence[Obstacle]) -> str:
    return f"{t.name} {', and '.join(obstacle_text(draft, t, one) for one in found)}"


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
    tokens went that it asks for, or came from that it does not want."""
    task, index = x.engine.compiled.task, x.engine.compiled.net.place_index
    held = {name: draft.marking[p] for name, p in index.items()}
    missed, spent, left, gone = list[str](), set[int](), set[int](), list[str]()
    for node in conjuncts(task.final.tree):
        if not (isinstance(node, Compare) and isinstance(node.left, Name)):
            missed += [str(task.final)] * (not Expression("", node).holds(held))
            continue
        name = node.left.name
        if not Expression("", node).holds(held):
            wanted = node.right.value if isinstance(node.right, Literal) else node.right
            missed.append(f"{name} {node.sign} {wanted} (it holds {held[name]})")
            if isinstance(wanted, int) and held[name] < wanted:
                gone.append(f"{name}: {_fate(task.net, draft, firings, index[name])}")
            if isinstance(wanted, int) and held[name] > wanted:
                gone += [f"{name}: {came}" for came in _came(task.net, firings, index[name])]
            if held[name] and Expression("", node).holds({**held, name: 0}):
                left.add(index[name])
        elif not held[name]:
            spent.add(index[name])
    busy = sorted({r.place for r in draft.live() if not task.places[r.place].listen})
    if not missed and busy:
        names = " or ".join(busy)
        missed.append(f"no active run of {names} (only places with `listen` may have one)")
    whole = str(task.final)
    ends = [whole if whole in missed else " and ".join(missed)]
    ends += [str(task.final_error)] if task.final_error is not None else []
    return ", or for ".join(ends), spent, left, tuple(gone)


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
    x: ExecutionGraph,
    draft: Draft,
    firings: tuple[str, ...],
    t: CompiledTransition,
    one: Obstacle,
    known: set[int],
) -> Iterator[str]:
    """Yield where the tokens went that a transition lacks, or why no other transition makes room
    for it. `known`: transitions whose lack is already explained."""
    net = x.engine.compiled.net
    if one.place is None or one.kind not in ("short", "full"):
        return
    name = net.places[one.place]
    if one.kind == "short":
        most = None if x.by_hand.any() else most_tokens(net)[one.place]
        if most and most < dict(t.needs)[one.place]:
            yield f"{name}: it never holds more than {most}"
            return
        left = _left_behind(net, draft, firings, t, one.place)
        yield f"{name}: {left or _fate(net, draft, firings, one.place)}"
        yield from _stopped(x, draft, () if left else _held(net, draft, firings, one.place), known)
        return
    takers = [
        t for t, changes in enumerate(net.compiled.changes) if dict(changes).get(one.place, 0) < 0
    ]
    if not takers:
        yield f"{name}: no transition takes any out of it"
    for u in () if known.intersection(takers) else takers:
        taker = x.engine.compiled.transitions[u]
        lacks = [lack for lack in obstacles(draft, taker) if lack.kind != "run"]
        if lacks:
            words = ", and ".join(obstacle_text(draft, taker, lack) for lack in lacks)
            yield f"{name}: `{taker.name}` would take some out of it, but it {words}"
        for lack in lacks:
            if lack.kind == "short":
                yield from _fates(x, draft, firings, taker, lack, known)


def _stopped(
    x: ExecutionGraph, draft: Draft, places: Sequence[int], known: set[int]
) -> Iterator[str]:
    """Yield why nothing takes the tokens of these places on, where that is not explained yet."""
    for p in places:
        takers = [t for t in x.engine.compiled.transitions if p in dict(t.needs)]
        for t in () if any(t.index in known for t in takers) else takers:
            if lacks := [lack for lack in obstacles(draft, t) if lack.kind != "run"]:
                yield f"{draft.compiled.net.places[p]}: {_lacking(draft, t, lacks)}"


@lru_cache(maxsize=64)
def most_tokens(net: Net) -> Sequence[int | None]:
    """Return an upper bound of the tokens of each place; None if unknown."""
    return place_bounds(net)


def _left_behind(
    net: Net, draft: Draft, firings: tuple[str, ...], t: CompiledTransition, place: int
) -> str:
    """Return which firing took the last token of a step and left behind what `t` takes with it;
    empty if none did, if the step can still be reached, and for a place that has tokens at the
    beginning."""
    if net.initial[place]:
        return ""
    with_it = {p for p, _ in t.needs if draft.marking[p] and not net.initial[p]} - {place}
    if any(draft.marking[p] for p in _leading(net, place) - with_it):
        return ""
    for f in (net.transition_index[name] for name in reversed(firings)):
        if any(p == place for p, _ in net.consume[f]):
            left = [net.places[p] for p in sorted(with_it)]
            return (
                f"taken by `{net.transitions[f]}`, which left {' and '.join(left)}" if left else ""
            )
        with_it -= {p for p, c in net.compiled.changes[f] if c > 0}
    return ""


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


def _held(net: Net, draft: Draft, firings: tuple[str, ...], place: int) -> list[int]:
    """Return the marked places whose tokens stand for tokens of the place that are taken; empty if
    one was lost."""
    if not _since(net, firings, place) or _loser(net, draft, firings, place) is not None:
        return []
    stands = _stands_for(net, place, _ends(draft), _holders(draft, place))
    return [p for p, n in enumerate(draft.marking) if n and p != place and stands.get(p)]


def _loser(net: Net, draft: Draft, firings: tuple[str, ...], place: int) -> int | None:
    """Return the last firing that lost a token of the place; None if all are still somewhere."""
    stands = _stands_for(net, place, _ends(draft), _holders(draft, place))
    if sum(n * draft.marking[p] for p, n in stands.items()) > net.initial[place] - 0.5:
        return None
    for t in (net.transition_index[name] for name in reversed(firings)):
        if sum(stands.get(p, 0.0) * c for p, c in net.compiled.changes[t]) < -0.5:
            return t
    return None


@lru_cache(maxsize=64)
def _stands_for(
    net: Net, place: int, ends: frozenset[int], holders: frozenset[int]
) -> Mapping[int, float]:
    """Return for how many tokens of the place a token of each other place stands.

    The net as it was meant returns what it takes: weights y >= 0 exist that every firing keeps. So
    the y that the fewest transitions of the real net change (least sum of |y C|, a linear program)
    show the transition that is wrong. What takes or gives tokens of the place itself is believed
    first; what gives nothing at all, last. No place is weighed that nothing takes from, except
    those in `ends`, and none that has tokens at the beginning, such as another resource: a
    token that arrives there was returned. In `holders` it is held, as `holds` says.
    """
    from scipy.optimize import linprog
    from scipy.sparse import csr_array

    changes = net.compiled.changes
    moved = {p for arcs in net.consume for p, _ in arcs if not net.initial[p]}
    places = [place, *sorted((moved | ends | holders) - {place})]
    column = {p: i for i, p in enumerate(places)}
    n, m = len(places), len(changes)
    cost, entries = np.full(n + 2 * m, 1e-4), list[tuple[int, int, float]]()
    for t, own in enumerate(changes):
        entries += [(t, column[p], float(c)) for p, c in own if p in column]
        entries += [(t, n + 2 * t, 1.0), (t, n + 2 * t + 1, -1.0)]
        doubt = 100.0 if dict(own).get(place) else 1.0 if net.produce[t] else 0.9
        # A gain explains no lack.
        cost[n + 2 * t : n + 2 * t + 2] = doubt, 1.5 * doubt
    rows, columns, values = zip(*entries, strict=True)
    equal = csr_array((values, (rows, columns)), shape=(m, n + 2 * m))
    bounds = [(1.0, 1.0) if p == place or p in holders else (0.0, None) for p in places]
    bounds += [(0.0, None)] * (2 * m)
    found = linprog(cost, A_eq=equal, b_eq=np.zeros(m), bounds=bounds, method="highs")
    weights = found.x if found.status == 0 else np.zeros(n)
    return {p: float(weights[i]) for p, i in column.items()}


def _holders(draft: Draft, place: int) -> frozenset[int]:
    """Return the places whose tokens hold the resource in this place by declaration."""
    net, held = draft.compiled.net, draft.compiled.task.held
    return frozenset(
        p
        for name, names in held.items()
        if net.places[place] in names and not net.initial[p := net.place_index[name]]
    )


def _ends(draft: Draft) -> frozenset[int]:
    """Return the places at which tokens stay for good and may keep others: where the task gives up
    as designed, and plain places that nothing takes from, which `final` wants empty."""
    task, net = draft.compiled.task, draft.compiled.net
    names = task.final_error.names if task.final_error is not None else frozenset[str]()
    taken = {p for arcs in net.consume for p, _ in arcs}
    empty = {
        node.left.name
        for node in conjuncts(task.final.tree)
        if isinstance(node, Compare)
        and isinstance(node.left, Name)
        and not Expression("", node).holds(dict.fromkeys(net.places, 1))
    }
    names |= {
        name
        for p, name in enumerate(net.places)
        if p not in taken and name in empty and task.places[name].kind is Kind.PLAIN
    }
    return frozenset(p for p, name in enumerate(net.places) if name in names and not net.initial[p])


def _leading(net: Net, place: int) -> set[int]:
    """Return the places, without tokens at the beginning, from which arcs lead to what fills the
    place."""
    reached = set[int]()
    wanted = {place}
    while wanted:
        fill = [
            t
            for t, own in enumerate(net.compiled.changes)
            if any(p in wanted and c > 0 for p, c in own)
        ]
        fed = {p for t in fill for p, _ in net.consume[t] if not net.initial[p] and p != place}
        wanted = fed - reached
        reached |= wanted
    return reached


def _fate(net: Net, draft: Draft, firings: tuple[str, ...], place: int) -> str:
    """Return which firing took the place's tokens last, and where they went."""
    givers = [
        t for t, changes in enumerate(net.compiled.changes) if dict(changes).get(place, 0) > 0
    ]
    back = ", ".join(f"`{net.transitions[t]}`" for t in givers)
    since, held = _since(net, firings, place), _held(net, draft, firings, place)
    if givers and not (since and (net.initial[place] or held)):
        order = [net.transition_index[name] for name in firings]
        elsewhere = _elsewhere(net, order, givers)
        taken = f"taken by `{net.transitions[since[0]]}`; " if since and not elsewhere else ""
        return f"{taken}only {back} can fill it{elsewhere}"
    if not since:
        return "nothing ever fills it"
    taker = f"taken by `{net.transitions[since[0]]}`"
    if not givers:
        return f"{taker}, and no transition returns it"
    loser = _loser(net, draft, firings, place)
    if loser is not None:
        # Several tokens of a control place are a stock, which may be used up; one may be a flag.
        counts = draft.compiled.task.places[net.places[place]].kind is Kind.CONTROL
        near = _feeding(net, givers).intersection(p for p, _ in net.consume[loser])
        if counts and (net.initial[place] > 1 or not near):
            return f"{taker}; only {back} can fill it"
        if any(p == place for p, _ in net.consume[loser]):
            return f"{taker}, and nothing that follows it returns it"
        return f"{taker}, never returned by `{net.transitions[loser]}`"
    kept = [
        net.places[p]
        for p in held
        if draft.compiled.task.places[net.places[p]].kind is Kind.PLAIN
        and not any(p == q for arcs in net.consume for q, _ in arcs)
    ]
    never = f", and no transition takes {' and '.join(kept)}"
    where = (
        f"still held with {' and '.join(net.places[p] for p in held)}{never * bool(kept)}"
        if held
        else f"to be returned by {back}"
    )
    return f"{taker}, {where}"


def _came(net: Net, firings: tuple[str, ...], place: int) -> Iterator[str]:
    """Yield which firings filled a place, and for one with tokens at the beginning, how many were
    taken and returned."""
    took, gave = Counter[str](), Counter[str]()
    for name in firings:
        change = dict(net.compiled.changes[net.transition_index[name]]).get(place, 0)
        (gave if change > 0 else took)[name] += abs(change)
    taken_out = any(dict(changes).get(place, 0) < 0 for changes in net.compiled.changes)
    if not +gave:
        if not taken_out:
            yield "from the beginning, and no transition takes it"
        return
    if net.initial[place]:
        taken, back = (
            " and ".join(f"{n} by `{name}`" for name, n in (+some).items()) for some in (took, gave)
        )
        yield f"taken: {taken or 'none'}; returned: {back}"
        return
    by = " and ".join(f"`{name}`" for name in +gave)
    yield f"filled by {by}{', and no transition takes it' * (not taken_out)}"


def _feeding(net: Net, wanted: Collection[int]) -> set[int]:
    """Return the places, without tokens at the beginning, from which arcs lead to transitions."""
    reached, todo = set[int](), set(wanted)
    while new := {p for t in todo for p, _ in net.consume[t] if not net.initial[p]} - reached:
        reached |= new
        todo = {t for t, arcs in enumerate(net.produce) if any(p in new for p, _ in arcs)}
    return reached


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
