"""The ends net N of a task: its net with ended runs in places of their own (docs/semantics.md, 13).

The ordinary net forgets how a run ended, so there a run that ended with SUCCESS may still leave by
an error arc. In N an action place p becomes

    p.going                          the runs that have not ended
    p.done, p.success, p.failure     the runs that ended so and wait (`p.done` where nothing asks
    p.error                          which of SUCCESS and FAILURE it was); split by what conditions
                                     ask of a run and by the internal events that it raised
    p.occupied, p.stopping           only where an inhibitor arc or a capacity looks at p: all runs
                                     that are there, and those that are still stopping

A transition of the task becomes one case for each kind of run that it may take and for each
assignment of the variables that makes its condition true. The world adds the ends of runs, the
changes of variables and the stops.

Every path of the execution graph is a path of N, and every state at rest is a marking of N; so
bounds and invariants of N hold for the executed task. N has more paths: events and timers may come
whenever the arcs are satisfied, conflicts are free, and there are no priorities and no steps.
Therefore a dead end of N alone says nothing. `tests/analysis/test_ends_net.py` walks random tasks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, combinations, combinations_with_replacement, count, product
from math import comb, prod
from typing import Any

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace
from numpy.typing import NDArray

from petrobot.coordinator.analysis.execution.names import (
    MISSING,
    RUN_FIELDS,
    Names,
    TooManyValues,
    cases,
)
from petrobot.coordinator.analysis.net.coverability import Coverability
from petrobot.coordinator.analysis.net.graph import Graph
from petrobot.coordinator.analysis.net.ordinary import OrdinaryView
from petrobot.coordinator.analysis.net.qualitative import (
    FAIR,
    SAFETY,
    Qualitative,
    boundedness,
    lower,
)
from petrobot.coordinator.analysis.net.space import Space
from petrobot.coordinator.analysis.net.structure import place_bounds
from petrobot.coordinator.analysis.net.verdict import PropertyVerdict, Witness
from petrobot.coordinator.engine import Engine, Run, RunEnded
from petrobot.coordinator.task import End, Kind, Status, Task
from petrobot.coordinator.task.compiled_task import ActionArc, CompiledTransition, endless
from petrobot.coordinator.task.conditions import ConditionFault
from petrobot.coordinator.task.net import Marking, Net

CASES = 5_000
"""The most cases of one transition, or ends of one place."""
ASSIGNMENTS = 1_024
"""The most assignments of its variables that one condition is tried with."""

Weights = Counter[str]
EndKind = tuple[Status, tuple[Any, ...], frozenset[str]]
"""What an ended run is to those that take it: status (SUCCESS for FAILURE where nothing asks), the
regions of what conditions ask of it, and the internal events raised that some arc waits for."""


class TooManyCases(ValueError):  # noqa: N818 - a limit of the analysis, not a fault of the task
    """A transition or an end of a run has more cases than N may have."""


class EndsNet(Struct, frozen=True):
    """N, and what its elements are in the task."""

    task: Task
    """Flat."""
    net: Net
    origin: Mapping[str, str]
    """By transition of N that is a case of a transition of the task: that transition. The others
    are what the world does: ends of runs, stops, changes of variables."""
    parts: tuple[tuple[int, ...], ...]
    """By place of `task.net`: the places of N that hold its tokens."""
    left_out: tuple[str, ...]
    """What N does not keep beside events, timers, steps and order, in words. Each gives N more
    paths, never fewer; but only if there is none does an N without dead ends prove that the
    executed task has none."""
    ended: Mapping[str, Mapping[EndKind, str]] = field(default_factory=dict)
    """By action place: the place of N for each kind of ended run."""
    values: Mapping[str, Mapping[Any, str]] = field(default_factory=dict)
    """By variable that N keeps: the place of N for each region of its values."""

    def projected(self, marking: Marking) -> Marking:
        """Return the marking of `task.net` that a marking of N stands for."""
        return tuple(sum(marking[p] for p in part) for part in self.parts)

    def held(self, space: Space, place: int, at: slice = slice(None)) -> NDArray[np.int64]:
        """Return the tokens of a place of `task.net` in the markings of N, or in some of them.

        All places at once would take many times as much memory as the packed markings.
        """
        words, layout = space.words[at], space.layout
        tokens = np.zeros(len(words), dtype=np.int64)
        for p in self.parts[place]:
            tokens += layout.tokens(words, p)
        return tokens


def ends_net(task: Task) -> EndsNet:
    """Return N. Raises ValueError if the task is not consistent."""
    engine = Engine(task)
    try:
        return _Builder(engine, ()).result()
    except (TooManyValues, TooManyCases) as fault:
        left_out = (f"all conditions, because {fault}",)
    whole = engine.compiled.transitions
    bare = tuple(replace(x, when=None, sets=(), judges_runs=False) for x in whole)
    engine.compiled = replace(engine.compiled, transitions=bare)
    try:
        return _Builder(engine, left_out).result()
    except TooManyCases as fault:
        same = {name: name for name in task.net.transitions}
        parts = tuple((p,) for p in range(len(task.net.places)))
        return EndsNet(task.flat, task.net, same, parts, (f"how runs end, because {fault}",))


def kind_of(names: Names, place: str, run: Run | RunEnded, raised: frozenset[str]) -> EndKind:
    """Return the kind of an ended run of a place, which raised these awaited events."""
    status = run.status or Status.SUCCESS
    if status is Status.FAILURE and place not in names.asked["status"]:
        status = Status.SUCCESS
    told = {"reason": run.cause, "executed": str(run.executed)}
    regions = tuple(
        names.region(f"{place}.{field}", value)
        for field, value in told.items()
        if place in names.asked[field]
    )
    return status, regions, raised


class _Builder:
    """Builds N place by place and transition by transition."""

    def __init__(self, engine: Engine, left_out: tuple[str, ...]) -> None:
        self.engine, self.task = engine, engine.compiled.task
        self.names = Names(engine)
        self.left_out = list(left_out)
        self.places: dict[str, int] = {}
        self.arcs: dict[str, tuple[Weights, Weights]] = {}
        self.inhibit: dict[str, dict[str, int]] = {}
        self.origin: dict[str, str] = {}
        self.parts: list[list[str]] = []
        self.ended: dict[str, dict[EndKind, str]] = {}
        """By action place: the place of N for each kind of ended run."""
        self.verdicts: dict[str, dict[str, Any]] = {}
        """By place of N for ended runs: what a condition that takes one reads of it."""
        self.raised = {
            place: frozenset(
                e
                for x in self.engine.compiled.transitions
                for a in x.actions
                if a.name == place and (a.takes_done or a.end in (End.NORMAL, End.ERROR))
                for e in a.raised
            )
            for place in self.engine.compiled.action_places
        }
        """By action place: internal events that must have been raised before a run's end."""
        self.values: dict[str, dict[Any, tuple[str, Any]]] = {}
        """By variable that N keeps: region -> (place of N, a value of the region)."""
        self.lost: dict[str, list[Any]] = {}
        """By variable that N does not keep, though conditions read it: its possible values."""
        self.watched = frozenset(
            p for x in self.engine.compiled.transitions for p, _ in x.bars
        ).intersection(self.engine.compiled.action_places.values())
        """Action places whose runs an inhibitor arc or a capacity counts."""

    def result(self) -> EndsNet:
        """Return the finished net."""
        for place, p in zip(
            self.task.places.values(), range(len(self.task.net.places)), strict=True
        ):
            if place.name in self.engine.compiled.action_places:
                self._action_place(place.name, p)
            else:
                self.places[place.name] = place.tokens
                self.parts.append([place.name])
        self._variables()
        for name in self.engine.compiled.action_places:
            self._ends(name)
        for x in self.engine.compiled.transitions:
            self._transition(x)
        capacity = {
            p: c
            for p, c in zip(self.task.net.places, self.task.net.capacity, strict=True)
            if c is not None and p in self.places
        }
        net = Net.build(
            self.places,
            self.arcs,
            inhibitors=self.inhibit,
            capacity=capacity,
            counters=self.task.net.counters,
        )
        parts = tuple(tuple(net.place_index[name] for name in part) for part in self.parts)
        left_out = tuple(dict.fromkeys(self.left_out))
        values = {
            name: {region: label for region, (label, _) in regions.items()}
            for name, regions in self.values.items()
        }
        return EndsNet(self.task, net, self.origin, parts, left_out, self.ended, values)

    # Places.

    def _action_place(self, name: str, p: int) -> None:
        tokens = self.task.places[name].tokens
        self.places[f"{name}.going"] = tokens
        kinds: dict[EndKind, str] = {}
        for end, _ in self.names.ends[name]:
            for raised in _subsets(self.raised[name]):
                kind = kind_of(self.names, name, end, raised)
                if kind in kinds:
                    continue
                kinds[kind] = label = self._new(name, kind)
                self.places[label] = 0
                told = {"status": end.status.value, "reason": end.cause}
                told["executed"] = end.executed.value
                self.verdicts[label] = {
                    f"{name}.{field}": told[field]
                    for field in RUN_FIELDS
                    if name in self.names.asked[field]
                }
        if len(kinds) > CASES:
            raise TooManyCases(f"a run of {name} can end in more than {CASES} ways")
        self.ended[name] = kinds
        self.parts.append([f"{name}.going", *kinds.values()])
        if p in self.watched:
            self.places |= {f"{name}.occupied": tokens, f"{name}.stopping": 0}
            self.arcs[f"{name}.stopped"] = (
                Counter({f"{name}.stopping": 1, f"{name}.occupied": 1}),
                Counter(),
            )

    def _new(self, name: str, kind: EndKind) -> str:
        status, _, raised = kind
        word = status.value if name in self.names.asked["status"] else "done"
        label = ".".join([name, "error" if status is Status.ERROR else word, *sorted(raised)])
        return _unused(label, self.places)

    def _variables(self) -> None:
        first = self.task.initial_variables()
        written = {name for x in self.engine.compiled.transitions for name, _ in x.sets}
        for name in sorted(self.names.known):
            values = [first.get(name, MISSING), *self.names.different(name)]
            regions = {self.names.region(name, value): value for value in values}
            if name in written or len(regions) > CASES:
                # A condition of the same step still reads the value from before the step.
                self.lost[name] = list(regions.values())
                self.left_out.append(f"the values of {name}")
                continue
            start = self.names.region(name, values[0])
            self.values[name] = {}
            for region, value in regions.items():
                label = f"{name} = {value!r}"
                self.values[name][region] = (label, value)
                self.places[label] = int(region == start)
        for name in sorted(set(self.names.free) & set(self.values)):
            for (a, _), (b, value) in product(self.values[name].values(), repeat=2):
                if a != b:
                    self.arcs[f"{a} becomes {value!r}"] = (Counter({a: 1}), Counter({b: 1}))

    # What the world does.

    def _ends(self, place: str) -> None:
        out, found = self.task.places[place].out, set[tuple[str, tuple[str, ...]]]()
        going, made = Counter({f"{place}.going": 1}), 0
        for end, _ in self.names.ends[place]:
            given = {out[result]: value for result, value in end.values.items()}
            given |= {f"{place}.status": end.status.value, f"{place}.reason": end.cause}
            given[f"{place}.executed"] = end.executed.value
            kept = {n: v for n, v in given.items() if n in self.values}
            after = tuple(self._value_place(n, v) for n, v in kept.items())
            for raised in _subsets(self.raised[place]):
                kind = kind_of(self.names, place, end, raised)
                label = self.ended[place][kind]
                if (label, after) in found:
                    continue
                found.add((label, after))
                for before in product(*([a for a, _ in self.values[n].values()] for n in kept)):
                    made += 1
                    if made > CASES:
                        raise TooManyCases(f"a run of {place} can end in more than {CASES} ways")
                    arcs = going + Counter(before), Counter([label, *after])
                    word = label.removeprefix(f"{place}.")
                    self.arcs[_unused(f"{place}.ends.{word}", self.arcs)] = arcs

    def _value_place(self, name: str, value: Any) -> str:
        return self.values[name][self.names.region(name, value)][0]

    # Transitions of the task.

    def _transition(self, x: CompiledTransition) -> None:
        below = dict(self.task.net.inhibit[x.index])
        inhibit = {self.task.net.places[p]: k for p, k in below.items() if p not in self.watched}
        inhibit |= {
            f"{self.task.net.places[p]}.occupied": k for p, k in x.bars if p in self.watched
        }
        if x.never or any(k <= 0 for _, k in x.bars):
            return
        need, give = Counter[str](), Counter[str]()
        for p, w in x.plain:
            need[self.task.net.places[p]] += w
        for p, w, is_action in x.produce:
            name = self.task.net.places[p]
            give[f"{name}.going" if is_action else name] += w
            if p in self.watched:
                give[f"{name}.occupied"] += w
        cases = list(self._cases(x, need, give))
        for i, arcs in enumerate(cases):
            name = x.name if len(cases) == 1 else f"{x.name} {i + 1}"
            self.arcs[name := _unused(name, self.arcs)] = arcs
            self.origin[name] = x.name
            self.inhibit[name] = inhibit | self._servers(arcs[1])

    def _cases(
        self, x: CompiledTransition, need: Weights, give: Weights
    ) -> Iterator[tuple[Weights, Weights]]:
        made = 0
        for taking in product(*(self._takings(x, arc) for arc in x.actions)):
            takes = sum((took for took, _, _ in taking), Counter(need))
            gives = sum((gave for _, gave, _ in taking), Counter(give))
            for tests in self._tests(x, [ended for _, _, ended in taking]):
                made += 1
                if made > CASES:
                    raise TooManyCases(f"{x.name} has more than {CASES} cases")
                yield takes + Counter(tests), gives + Counter(tests)

    def _takings(
        self, x: CompiledTransition, arc: ActionArc
    ) -> list[tuple[Weights, Weights, tuple[str, ...]]]:
        """Return how an arc may take its runs: (taken, given back, places of the ended ones)."""
        p, w, going = arc.name, arc.weight, f"{arc.name}.going"
        if arc.end is End.GOING:
            return [(Counter({going: w}), Counter({going: w}), ())]
        watched = arc.place in self.watched
        ended = [
            label
            for (status, _, raised), label in self.ended[p].items()
            if raised.issuperset(arc.raised)
            and (arc.takes_done or arc.end is (End.ERROR if status is Status.ERROR else End.NORMAL))
        ]
        kinds = [(label, "") for label in ended]
        if arc.end is End.PREEMPT:
            kinds.append((going, ""))
            if watched:  # it began, so it is stopping now
                kinds.append((going, f"{p}.stopping"))
        if kinds and comb(len(kinds) + w - 1, w) > CASES:
            raise TooManyCases(f"{x.name} has more than {CASES} cases")
        found = []
        for chosen in combinations_with_replacement(kinds, w):
            if sum(bool(stays) for _, stays in chosen) > self.task.places[p].most_active:
                continue
            took, gave = Counter(label for label, _ in chosen), Counter[str]()
            for _, stays in chosen:
                if stays:
                    gave[stays] += 1
                elif watched:
                    took[f"{p}.occupied"] += 1
            found.append((took, gave, tuple(dict.fromkeys(c for c, _ in chosen if c != going))))
        if x.judges_runs and w > 1:
            self.left_out.append(f"which of the runs of {p} the condition of {x.name} reads")
        return found

    def _servers(self, gives: Weights) -> dict[str, int]:
        """Return what bars a case that stops runs: they hold their servers until they have
        stopped, so no more can be stopping than there are servers."""
        return {
            f"{p}.stopping": self.task.places[p].most_active - gives[f"{p}.stopping"] + 1
            for p in self.engine.compiled.action_places
            if gives[f"{p}.stopping"]
        }

    def _tests(
        self, x: CompiledTransition, ended: list[tuple[str, ...]]
    ) -> Iterator[tuple[str, ...]]:
        """Yield the places of values that a case tests, for each assignment under which the
        condition can hold."""
        if x.when is None:
            yield ()
            return
        # Which of several runs the condition reads is open: the last one, in the order of ends.
        told = [
            {k: v for label in labels for k, v in self.verdicts[label].items()}
            for labels in product(*(some for some in ended if some))
        ]
        read = [n for n in sorted(x.when.names & set(self.values)) if n not in told[0]]
        lost = {n: v for n, v in self.lost.items() if n in x.when.names}
        sizes = [len(self.values[n]) for n in read]
        if prod(sizes) * prod(map(len, lost.values())) > ASSIGNMENTS:
            self.left_out.append(f"the condition of {x.name}")
            yield ()
            return
        fixed = dict(self.task.parameters)
        some = [dict(zip(lost, values, strict=True)) for values in product(*lost.values())]
        tests = []
        for chosen in product(*(self.values[n].values() for n in read)):
            values = fixed | {n: value for n, (_, value) in zip(read, chosen, strict=True)}
            if any(_holds(x, values | more | run) for more in some for run in told):
                tests.append(tuple(label for label, _ in chosen))
        yield from [()] if len(tests) == prod(sizes) and tests else tests


def _holds(x: CompiledTransition, values: Mapping[str, Any]) -> bool:
    known = {name: value for name, value in values.items() if value is not MISSING}
    try:
        return x.when is None or x.when.holds(known)
    except ConditionFault:
        return False


def _unused(name: str, names: Container[str]) -> str:
    """Return the name, with a number if it is used already."""
    numbered = (f"{name} {i}" for i in count(2))
    return name if name not in names else next(n for n in numbered if n not in names)


def _subsets(events: frozenset[str]) -> Iterator[frozenset[str]]:
    names = sorted(events)
    sizes = range(len(names) + 1)
    yield from map(frozenset, chain.from_iterable(combinations(names, n) for n in sizes))


# --- What N says of the task ------------------------------------------------------------------


def judged(
    n: EndsNet, space: Space, *, cover: Coverability | None = None, in_haste: bool = False
) -> Qualitative:
    """Return what N says of the places of the task: bounds, and transitions that never fire.

    Progress stays unknown here, because the execution graph judges it. Parameters as of `examine`.
    """
    if in_haste and cover is None:
        cover = Coverability(None, (None,) * len(space.net.places), space.reason, False)
    proven, bounded, _, _ = boundedness(space, cover)
    seen = tuple(int(np.max(n.held(space, p), initial=0)) for p in range(len(n.parts)))
    bounds: tuple[int | None, ...] = seen
    if not space.complete:
        sums = [[proven[p] for p in part] for part in n.parts]
        own = [None if None in some else sum(b or 0 for b in some) for some in sums]
        bounds = tuple(map(lower, own, place_bounds(n.task.net)))
    if bounded.holds is False and bounded.witness is not None:
        bounded = _grows(n, bounded.witness)
    elif bounded.holds is None and None not in bounds:
        bounded = PropertyVerdict(True, "bounded by invariants and capacities", assumption=SAFETY)
    elif space.complete:
        text = f"no place ever holds more than {max(seen, default=0)} token"
        bounded = replace(bounded, reason=text + "s" * (max(seen, default=0) != 1))
    highest = None if None in bounds else max((b or 0 for b in bounds), default=0)
    reached = space.complete or highest == max(seen, default=0)
    fired = {
        n.origin.get(t) for t, some in zip(n.net.transitions, space.fired, strict=True) if some
    }
    never = space.complete
    unknown = PropertyVerdict(None, f"unknown: {space.reason}", complete=False)
    return Qualitative(
        space,
        bounds,
        highest if reached else None,
        bounded,
        _safe(n, space, seen, bounds),
        unknown,
        (),
        0,
        unknown,
        unknown,
        tuple(0 if never and t not in fired else None for t in n.task.net.transitions),
        unknown,
        None,
    )


def proven(n: EndsNet, space: Space, view: OrdinaryView) -> dict[str, PropertyVerdict]:
    """Return the verdicts of the execution graph that N alone proves, for a task whose graph is
    too large. N has every path of the execution graph, so what never happens in N never happens."""
    if not space.complete:
        return {}
    found = dict[str, PropertyVerdict]()

    def holds(name: str, reason: str) -> None:
        text = f"{reason} (shown on the ends net: {len(space)} markings)"
        found[name] = PropertyVerdict(True, text, assumption=FAIR)

    flat, index = n.task, n.task.net.place_index
    held = partial(n.held, space)
    single = [p for p in flat.places.values() if p.kind is Kind.ACTION and p.servers is None]
    if all(np.max(held(index[p.name])) <= 1 for p in single):
        holds("one_run_each", "no action place is entered while its run is active")
    final = view.where(flat.final, held, len(space))
    resources = [p for p in flat.places.values() if p.kind is Kind.RESOURCE]
    if all((held(index[p.name])[final] == p.tokens).all() for p in resources):
        holds("returned", "every resource has its initial number of tokens at the end")
    if not n.left_out and not endless(flat):
        fires = np.array([name in n.origin for name in n.net.transitions] or [False])
        alive = final | view.where(flat.final_error, held, len(space))
        alive[space.source[fires[space.label]]] = True
        if (
            Graph(len(space), space.source, space.target, space.row, rooted=True)
            .backward(alive)
            .all()
        ):
            holds("deadlock_free", "a transition or an end can be reached from everywhere")
    fired = {
        n.origin.get(t) for t, some in zip(n.net.transitions, space.fired, strict=True) if some
    }
    idle = [name for name, copies in cases(flat).items() if not fired & copies]
    if idle:
        text = f"can never fire: {', '.join(idle)} (shown on the ends net)"
        found["quasi_live"] = PropertyVerdict(False, text)
    return found


def _grows(n: EndsNet, pump: Witness) -> PropertyVerdict:
    """Return that the task is unbounded, in the names of the task."""
    *_, before = n.net.replay(pump.firings)
    *_, after = n.net.replay(pump.loop, before)
    one, other = n.projected(before), n.projected(after)
    grows = [p for p, a, b in zip(n.task.net.places, one, other, strict=True) if b > a]
    again = tuple(n.origin[t] for t in pump.loop if t in n.origin)
    firings = tuple(n.origin[t] for t in pump.firings if t in n.origin)
    text = f"{', '.join(grows)} can grow without bound: {' '.join(again)} can be repeated for ever"
    return PropertyVerdict(False, text, Witness(firings, _marked(n, one), again))


def _safe(
    n: EndsNet, space: Space, seen: Sequence[int], bounds: tuple[int | None, ...]
) -> PropertyVerdict:
    for p, (place, most) in enumerate(zip(n.task.net.places, seen, strict=True)):
        if most > 1:
            tokens = n.held(space, p)
            first = int(np.argmax(tokens > 1))
            firings = tuple(n.origin[t] for t in space.path(first) if t in n.origin)
            shown = Witness(firings, _marked(n, n.projected(space.marking(first))))
            reason = f"{place} can hold {tokens[first]} tokens"
            return PropertyVerdict(False, reason, shown, complete=space.complete)
    if all(b is not None and b <= 1 for b in bounds):
        text = "no place ever holds more than one token"
        return PropertyVerdict(True, text, assumption=SAFETY, complete=space.complete)
    return PropertyVerdict(None, f"unknown: the search stopped early ({space.reason})")


def _marked(n: EndsNet, marking: Marking) -> dict[str, int]:
    return {p: tokens for p, tokens in zip(n.task.net.places, marking, strict=True) if tokens}
