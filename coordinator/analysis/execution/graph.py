"""The execution graph X: the states in which the engine rests, and the stimuli that lead from one
to the next.

The successor of a state under a stimulus is what `Engine.handle` gives; there is no second firing
rule. Two engine states are one state of X if all parts on which the future depends are equal
(`names.py`). States are numbered in breadth-first order, 0 is the state after `Begin`, so the path
to a state is shortest. The first engine state found represents all equal ones; so the engine can
replay each path along the search tree exactly.

A graph that is too large is continued by random plays: they go deep where breadth first stays near
the beginning, so that a dead end far away is found.
"""

from __future__ import annotations

import dataclasses
from bisect import bisect
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence, Set
from functools import cached_property
from itertools import cycle
from math import exp
from typing import NamedTuple

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace
from numpy.typing import NDArray

from petrobot.coordinator.analysis.execution.names import (
    REASON,
    Cause,
    Names,
    Orders,
    TooManyValues as TooManyValues,
    literals_of,
)
from petrobot.coordinator.analysis.limits import overtime
from petrobot.coordinator.analysis.net.graph import Graph, Mask
from petrobot.coordinator.engine import (
    Begin,
    Choose,
    Engine,
    EventOccurred,
    Fired,
    Instruction,
    Mode,
    Report,
    RunEnded,
    RunRaised,
    State,
    Stimulus,
    VariableChanged,
)
from petrobot.coordinator.engine.step import at_end
from petrobot.coordinator.task import Status, Task
from petrobot.coordinator.task.conditions import And, Compare, Literal, Name
from petrobot.coordinator.task.conditions.language import Node

SHOWN = 20
"""The most firings of one stimulus that are written."""
STEPS = 300_000
"""The most stimuli and firings for one graph; they take about twenty seconds."""
MOVES = 3
"""The most commands of the operator on a path of `with_operator`. A token that he adds can be used
up and added again, so without this nearly every search would reach its limit."""
BETWEEN = 1_000
"""Stimuli and firings between two looks at the clock."""
PLAYS = 4
"""Of a graph that is too large, random plays follow a fourth as many stimuli and firings more."""
SHORTEST, LENGTHS = 32, 6
"""The shortest play, and the number of lengths: each is twice the one before."""
RARE, KNOWN = 1e-6, 0.5
"""How likely a play takes an ERROR or what makes `final` impossible, such as a stop button, if it
is careful, as each second one is, and a state that was explored before. These often end a mission,
and then nothing deeper is seen."""
LOOKS = 64
"""So many states that a search for the nearest one looks at cost as much as a stimulus."""
QUICK = 8
"""Before that, quick plays use an eighth as many. They follow one stimulus of each state and keep
no state, so they come far deeper."""
SPREADS, JITTER = (0.0, 0.5, 2.0), 0.1
"""How much the times of stimuli differ in a quick play, and how much each of them from one case to
the next (standard deviations of the logarithm). With equal times, branches come to their resources
together, and each holds one while it waits for the next."""
DOUBLED, CARELESS = 4, 0.25
"""How often the length of a quick play is doubled at most, and the share of those in which runs may
end in ERROR."""
LEVELS, EACH, REPEATS = 64, 8, 20_000
"""How far back an earlier state is compared for growth, how many states are tried at each distance,
and how many stimuli are repeated at most."""
STALE = 16
"""Steps without a new state after which a play continues at the nearest new one."""
QUEUE = 16
"""This many runs of a state count like one more firing. Else a queue that a timer fills for ever
reaches thousands of runs, and each stimulus takes as long."""
TIMELESS, UNSAFE = "timeless", "unsafe"
"""Keys of reports: transitions fire for ever, a place with one server gets a second token."""
TOLD_FIRST, TOLD_LAST = 5, 10
"""Steps of a long path that a text names."""


def in_words(steps: Sequence[object]) -> list[str]:
    """Return the steps of a path as texts; of a long one its beginning and its end."""
    told = [str(step) for step in steps]
    if len(told) > TOLD_FIRST + TOLD_LAST + 1:
        told[TOLD_FIRST:-TOLD_LAST] = [f"({len(told) - TOLD_FIRST - TOLD_LAST} more)"]
    return told


@dataclasses.dataclass(frozen=True, slots=True)
class Step:
    """An edge of a path: a stimulus in words, and the transitions that it fires. Steps with the
    same words are equal: their stimuli differ in the ids of runs alone."""

    text: str
    firings: tuple[str, ...]
    stimulus: Stimulus = dataclasses.field(compare=False)
    """The first one found."""

    @property
    def reason(self) -> str:
        """Return the reason of a run that ended, as text; empty where no condition reads it."""
        end = self.stimulus
        return repr(end.cause) if isinstance(end, RunEnded) and REASON in self.text else ""

    @property
    def fails(self) -> bool:
        """Whether a run ends in ERROR."""
        return isinstance(self.stimulus, RunEnded) and self.stimulus.status is Status.ERROR

    @property
    def blind(self) -> bool:
        """Whether it is neither a good end of a run nor something that comes from outside."""
        outside = (RunEnded, RunRaised, EventOccurred, VariableChanged)
        return self.fails or not isinstance(self.stimulus, outside)

    def __str__(self) -> str:
        firings = self.firings[:SHOWN]
        more = f" ... ({len(self.firings)} firings)" if len(self.firings) > SHOWN else ""
        return f"{self.text} -> {' '.join(firings) or 'nothing'}{more}"


class ExecutionGraph(Struct, frozen=True, dict=True):
    """The states found and their edges. If the search stopped early, only the states in `expanded`
    have their edges, `complete` is False and `reason` says why."""

    engine: Engine
    names: Names
    states: tuple[State, ...]
    orders: tuple[Orders, ...]
    """By state: pairs of its timers of which the first elapses before the second."""
    came: tuple[tuple[int, Stimulus] | None, ...]
    """By state: the state before it on the search tree, and the stimulus that led from there."""
    source: NDArray[np.int32]
    target: NDArray[np.int32]
    label: NDArray[np.int32]
    """By edge: number of its step."""
    steps: tuple[Step, ...]
    first: tuple[str, ...]
    """Transitions that fire at `Begin`, before any stimulus."""
    expanded: Mask
    complete: bool
    reason: str
    livelocks: tuple[int, ...]
    """States after which transitions fire for ever without a stimulus."""
    crowded: dict[str, int]
    """By action place with one server: a state in which it has more tokens."""
    contests: dict[tuple[str, ...], int]
    """By conflict that neither priority nor weight decides: a state in which it occurs."""
    index: Mapping[Hashable, int]
    """Number of each state, by the parts of it on which the future depends."""
    shared: Shared
    by_hand: Mask
    """Which edges are commands of the operator; only `with_operator` adds them."""

    def __len__(self) -> int:
        return len(self.states)

    @cached_property
    def graph(self) -> Graph:
        """The states and edges as a graph."""
        return Graph(len(self.states), self.source, self.target)

    @cached_property
    def growth(self) -> tuple[int, int] | None:
        """Two states of which the second leaves more tokens than the first, on a path that the
        engine has repeated until its tokens exceed all that an arc, a capacity or an end asks for:
        further tokens change nothing, so it can be repeated for ever. None if none was found."""
        parent = np.array([0 if came is None else came[0] for came in self.came])
        tokens = np.array([state.marking for state in self.states])
        left, older, last = REPEATS, parent, np.full(len(parent), -1)
        for _ in range(LEVELS):
            more = tokens - tokens[older]
            hits = (more >= 0).all(axis=1) & (more > 0).any(axis=1) & (older != last)
            for j in np.flatnonzero(hits)[:EACH].tolist():
                left = self._repeat(int(older[j]), j, left)
                if left < 0:
                    return int(older[j]), j
            if not left or not older.any():
                return None
            older, last = parent[older], older
        return None

    def _repeat(self, first: int, last: int, left: int) -> int:
        """Let the engine repeat the path between two states. Return how many stimuli are left for
        other paths; -1 if this one can be repeated for ever."""
        path = self.path(last)[len(self.path(first)) :]
        before, state, orders = self.states[first].marking, self.states[last], self.orders[last]
        more = np.subtract(state.marking, before)
        laps = max(self._most[p] // more[p] for p in np.flatnonzero(more)) + 2
        if laps * len(path) > left:
            return left
        for _ in range(laps):
            before = state.marking
            for step in path:
                for cause in self.names.stimuli(state, orders):
                    if cause.text != step.text:
                        continue
                    left -= 1
                    after, said = self.engine.handle(state, cause.stimulus)
                    if _fired(said) == step.firings:
                        orders = self.names.next_orders(state, orders, after)
                        state = after
                        break
                else:
                    return max(left, 0)
            if (np.subtract(state.marking, before) != more).any():
                return max(left, 0)
        return -1

    @cached_property
    def _most(self) -> list[int]:
        """By place: more tokens than this change nothing that the engine tests. Of a place that an
        end compares with another place, no number is enough."""
        net, task = self.engine.compiled.net, self.engine.compiled.task
        ends = [end for end in (task.final, task.final_error) if end is not None]
        literals, together = literals_of(ends)
        most = [
            max(map(int, literals.get(name, [])), default=0)
            + (REPEATS if name in together else 0)
            + (capacity or 0)
            + task.places[name].most_active
            for name, capacity in zip(net.places, net.capacity, strict=True)
        ]
        for arcs in (*net.consume, *net.produce, *net.inhibit):
            for p, n in arcs:
                most[p] += n
        return most

    @cached_property
    def fires(self) -> Mask:
        """Which edges fire a transition."""
        some = np.array([bool(step.firings) for step in self.steps] or [False])
        mask: Mask = some[self.label]
        return mask

    def firing(self, names: Iterable[str]) -> Mask:
        """Return which edges fire one of the transitions."""
        wanted = frozenset(names)
        some = np.array([bool(wanted.intersection(s.firings)) for s in self.steps] or [False])
        mask: Mask = some[self.label]
        return mask

    @cached_property
    def fails(self) -> Mask:
        """Which edges are a run that ends in ERROR."""
        some = np.array([step.fails for step in self.steps] or [False])
        mask: Mask = some[self.label]
        return mask

    def of_edges(self, some: Mask) -> Graph:
        """Return the graph of all states with some of the edges."""
        return Graph(len(self.states), self.source[some], self.target[some])

    @cached_property
    def retries(self) -> tuple[tuple[str, ...], ...]:
        """Transitions that may be repeated for ever while every run ends in ERROR, by part of the
        graph that only another end of a run, an event or the operator leaves."""
        blind = np.array([step.blind for step in self.steps] or [False])
        kept = np.flatnonzero(blind[self.label] & ~self.by_hand)
        source, target = self.source[kept], self.target[kept]
        part = Graph(len(self), source, target).components
        found: dict[int, set[str]] = {}
        for i in np.flatnonzero(part[source] == part[target]).tolist():
            step = self.steps[self.label[kept[i]]]
            if step.fails and step.firings:
                found.setdefault(int(part[source[i]]), set()).update(step.firings)
        return tuple(dict.fromkeys(tuple(sorted(names)) for names in found.values()))

    @cached_property
    def final(self) -> Mask:
        """States in which the mission run has ended with `final`."""
        return self._ended(Status.SUCCESS)

    @cached_property
    def given_up(self) -> Mask:
        """States in which the mission run has ended with `final_error`."""
        return self._ended(Status.ERROR)

    def _ended(self, status: Status) -> Mask:
        finished = (
            s.mode is Mode.FINISHED
            and (s.closing or at_end(self.engine.compiled, s.marking)) is status
            for s in self.states
        )
        return np.fromiter(finished, np.bool_, len(self.states))

    @cached_property
    def spoiled(self) -> Mask:
        """States with tokens that `final` forbids and that no transition takes."""
        never = spoiling(self.engine.compiled.task)
        there = (any(s.marking[p] for p in never) for s in self.states)
        return np.fromiter(there, np.bool_, len(self))

    @cached_property
    def dead(self) -> Mask:
        """States that are not an end, and from which neither a firing nor an end can be reached
        without the operator."""
        alive = self.final | self.given_up
        alive[self.source[self.fires & ~self.by_hand]] = True
        alive |= ~self.expanded  # its edges were not explored
        return ~self.graph.backward(alive, ~self.by_hand)

    def path(self, state: int) -> list[Step]:
        """Return the path along which the state was found: a shortest one from the beginning, with
        as few commands of the operator as possible, if no random play found it."""
        found = list[Step]()
        while (came := self.came[state]) is not None:
            first = int(self.graph.row[came[0]])
            edge = first + int(np.argmax(self.target[first : self.graph.row[came[0] + 1]] == state))
            found.append(self.steps[self.label[edge]])
            state = came[0]
        return found[::-1]

    def stimuli(self, state: int) -> list[Stimulus]:
        """Return stimuli, `Begin` first, that lead the engine from its initial state to exactly
        `states[state]`."""
        found = list[Stimulus]()
        while (came := self.came[state]) is not None:
            state = came[0]
            found.append(came[1])
        return [Begin(), *reversed(found)]

    def follow(self, state: int, cause: Cause) -> tuple[State, tuple[Instruction, ...], int, int]:
        """Let the engine handle a stimulus in an expanded state. Return the engine's next state
        with its own ids, its instructions, the number of that state in the graph, and the edge; -1
        if nothing changes."""
        before = self.states[state]
        after, said = self.engine.handle(before, cause.stimulus)
        orders = self.names.next_orders(before, self.orders[state], after)
        core = self.shared.number(self.names.core(after, orders), after)
        number = self.index[core, *self.names.rest(after), _reports(said, TIMELESS)]
        step = self._numbers.get(Step(cause.text, _fired(said), cause.stimulus), -1)
        return after, said, number, self._edges.get((state, number, step), -1)

    def had_not_come(self, events: Set[str], state: int, step: Step) -> int | None:
        """Return the number of the state after the stimulus of a step from a state if these events
        had not come before; None if it was not found."""
        before, orders = self.states[state], self.orders[state]
        cause = next(c for c in self.names.stimuli(before, orders) if c.text == step.text)
        before = replace(before, flags=before.flags - events)
        after, said = self.engine.handle(before, cause.stimulus)
        orders = self.names.next_orders(before, orders, after)
        core = self.shared.number(self.names.core(after, orders), after)
        return self.index.get((core, *self.names.rest(after), _reports(said, TIMELESS)))

    @cached_property
    def _numbers(self) -> dict[Step, int]:
        return {step: i for i, step in enumerate(self.steps)}

    @cached_property
    def _edges(self) -> dict[tuple[int, int, int], int]:
        ends = zip(self.source.tolist(), self.target.tolist(), self.label.tolist(), strict=True)
        return {key: e for e, key in enumerate(ends)}

    def firings(self, state: int) -> tuple[str, ...]:
        """Return the transitions that fire on a shortest path to the state."""
        return self.first + tuple(t for step in self.path(state) for t in step.firings)

    def marked(self, state: int) -> dict[str, int]:
        """Return the marked places of a state."""
        places = self.engine.compiled.net.places
        return {p: n for p, n in zip(places, self.states[state].marking, strict=True) if n}


class NextState(NamedTuple):
    """What follows a state by one stimulus."""

    number: int
    """That of the next state, in `Shared`."""
    firings: tuple[str, ...]
    more: int
    """Runs that came to those still to do."""


class Shared:
    """What searches of one task find out for each other. Here states have the same number if they
    differ only in who has waited longer, or in how many runs are still to do, as long as there are
    some (`Names.core`)."""

    def __init__(self) -> None:
        self._numbers: dict[Hashable, int] = {}
        self._examples: list[State] = []
        self._lacking: dict[int, Mapping[str, str]] = {}
        self.after: dict[int, list[NextState | None]] = {}
        """By state and stimulus, in the order of `Names.stimuli`: what follows; None where it may
        depend on what differs."""

    def number(self, core: Hashable, state: State) -> int:
        """Return the number of a state with this core."""
        found = self._numbers.setdefault(core, len(self._examples))
        if found == len(self._examples):
            self._examples.append(state)
        return found

    def lacking(self, number: int, engine: Engine) -> Mapping[str, str]:
        """Return `Engine.lacking` of the states with a number."""
        if number not in self._lacking:
            self._lacking[number] = engine.lacking(self._examples[number])
        return self._lacking[number]


def execute(
    task: Task,
    *,
    limit: int = STEPS,
    engine: Engine | None = None,
    contests: Iterable[tuple[str, ...]] | None = None,
    shared: Shared | None = None,
) -> ExecutionGraph:
    """Explore the execution graph of a task, up to a limit in stimuli and firings.

    `engine`: with its policy `ask_undecided`, any transition may win a conflict that neither
    priority nor weight decides. `contests` are the transitions of each such conflict, if they are
    known; then only their order of waiting distinguishes states. `shared`: what searches of this
    task have found before, also with other numbers of runs. Raises TooManyValues.
    """
    engine = engine or Engine(task)
    return _Search(engine, Names(engine, contests), shared or Shared()).run(limit)


def with_operator(x: ExecutionGraph, *, limit: int = STEPS) -> ExecutionGraph:
    """Continue a complete execution graph with the operator's commands: tokens added to or removed
    from control places, one at a time, within their capacities (without a capacity: up to one more
    than at the beginning).

    The states after one command come first, then those after two, up to `MOVES`, until some are
    dead ends or conflicts. The numbers of the given states stay the same.
    """
    search = _Search(
        x.engine,
        x.names,
        x.shared,
        dict(x.index),
        list(x.states),
        list(x.orders),
        list(x.came),
        list(x.steps),
        {(step.text, step.firings): i for i, step in enumerate(x.steps)},
        list(x.livelocks),
        dict(x.crowded),
        dict(x.contests),
        [list(row) for row in (x.source, x.target, x.label)],
    )
    return search.with_operator(x, limit)


def conjuncts(node: Node) -> Iterator[Node]:
    """Yield the conditions that must all hold."""
    if isinstance(node, And):
        for operand in node.operands:
            yield from conjuncts(operand)
    else:
        yield node


def spoiling(task: Task) -> tuple[int, ...]:
    """Return the places that `final` wants empty and that no transition takes from."""
    net, empty = task.net, set[str]()
    for node in conjuncts(task.final.tree):
        if isinstance(node, Compare) and node.sign == "==" and node.right == Literal(0):
            empty |= {node.left.name} if isinstance(node.left, Name) else set()
    taken = {p for arcs in net.consume for p, _ in arcs}
    return tuple(p for p, name in enumerate(net.places) if name in empty and p not in taken)


class _Search(Struct):
    engine: Engine
    names: Names
    shared: Shared
    index: dict[Hashable, int] = field(default_factory=dict)
    """By number in `shared`, `Names.rest`, and whether it fires for ever."""
    states: list[State] = field(default_factory=list)
    orders: list[Orders] = field(default_factory=list)
    came: list[tuple[int, Stimulus] | None] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    labels: dict[tuple[str, tuple[str, ...]], int] = field(default_factory=dict)
    """By text and firings: number of the step."""
    livelocks: list[int] = field(default_factory=list)
    crowded: dict[str, int] = field(default_factory=dict)
    contests: dict[tuple[str, ...], int] = field(default_factory=dict)
    edges: list[list[int]] = field(default_factory=lambda: [[], [], []])
    """Sources, targets and labels."""
    handled: int = 0
    """Stimuli and firings so far."""
    late: bool = False
    """Whether the time of the whole analysis was used up before a limit was reached."""

    def run(self, limit: int) -> ExecutionGraph:
        """Explore until nothing new is found or the limit is reached."""
        begun = self.engine.initial()
        state, said = self.engine.handle(begun, Begin())
        self._found(begun, frozenset(), state, said, None)
        known = self._explore(0, limit)
        lost = (
            self._quick_plays(limit // QUICK) if known < len(self.states) and not self.late else []
        )
        expanded = self._play(known, limit + limit // PLAYS, lost)
        by_hand = np.zeros(len(self.edges[0]), np.bool_)
        return self._result(_fired(said), expanded, by_hand, limit)

    def with_operator(self, x: ExecutionGraph, limit: int) -> ExecutionGraph:
        """Explore what the operator's commands add."""
        by_hand, begin, end = [False] * len(x.source), 0, len(x)
        found = x
        for _ in range(MOVES):
            if begin == end or self.handled >= limit or self.late:
                break
            for i in range(begin, end):
                if self.handled >= limit:
                    break
                self._follow(i, self.names.commands(self.states[i]), None)
            by_hand += [True] * (len(self.edges[0]) - len(by_hand))
            begin, end = end, self._explore(end, limit)
            by_hand += [False] * (len(self.edges[0]) - len(by_hand))
            found = self._result(x.first, range(end), np.array(by_hand, np.bool_), limit)
            if found.dead[len(x) :].any() or len(found.contests) > len(x.contests):
                break
        return replace(found, complete=found.complete and self.handled < limit and not self.late)

    def _explore(self, i: int, limit: int) -> int:
        """Follow the stimuli of the states from number i on; return the first state that was not
        explored."""
        looked = self.handled
        while i < len(self.states) and self.handled < limit and not self.late:
            self._expand(i)
            i += 1
            if self.handled - looked >= BETWEEN:
                looked, self.late = self.handled, overtime()
        return i

    def _quick_plays(self, effort: int) -> list[str]:
        """Play with one stimulus for each state, until a play comes where no end can follow. Return
        what it did, as texts of stimuli; empty if none was found.

        In a play each stimulus takes a time of its own, and the first one that is due comes.
        """
        random, engine = np.random.Generator(np.random.PCG64(0)), self.engine
        left = effort
        while left > 0 and not overtime():
            spread = SPREADS[random.integers(len(SPREADS))]
            length = SHORTEST << int(random.integers(DOUBLED + 1))
            careful, state, orders = random.random() >= CARELESS, self.states[0], self.orders[0]
            times, due = dict[str, float](), dict[Hashable, float]()
            path, now = list[str](), 0.0
            for _ in range(length):
                waiting = dict[Hashable, float]()
                first: tuple[float, Hashable, Cause] | None = None
                for cause in self.names.stimuli(state, orders):
                    end = cause.stimulus
                    run = end.run if isinstance(end, RunEnded | RunRaised) else ""
                    if careful and isinstance(end, RunEnded) and end.status is Status.ERROR:
                        continue
                    if (at := due.get((run, cause.text))) is None:
                        time = times.setdefault(cause.text, spread * random.standard_normal())
                        at = now + exp(time + JITTER * random.standard_normal())
                    waiting[run, cause.text] = at
                    if first is None or at < first[0]:
                        first = at, (run, cause.text), cause
                if first is None:
                    break
                now, key, cause = first
                del waiting[key]
                due, before = waiting, state
                state, said = engine.handle(state, cause.stimulus)
                orders = self.names.next_orders(before, orders, state)
                path.append(cause.text)
                left -= 1 + len(_fired(said))
                if state.mode is not Mode.RUNNING:
                    break
            dead = state.mode is Mode.FINISHED and at_end(engine.compiled, state.marking) is None
            if dead or not engine.can_end(state):
                return path
        return []

    def _play(self, known: int, limit: int, lost: Sequence[str] = ()) -> Iterable[int]:
        """Play from the first state at random, the same way each time, and follow all stimuli of
        the states that the plays come through. Return the states whose edges are there; before,
        those are the first `known`. The plays begin where `lost` ends, as long as that is new."""
        source, target, label = self.edges
        rows = np.searchsorted(source, range(known + 1)).tolist()
        edges = {i: range(rows[i], rows[i + 1]) for i in range(known)}
        random, careful = np.random.Generator(np.random.PCG64(0)), False
        lengths = cycle(SHORTEST << n for n in range(LENGTHS))
        never = spoiling(self.engine.compiled.task)

        def avoided(e: int) -> bool:
            if not careful:
                return False
            before, after = (self.states[row[e]].marking for row in (source, target))
            return self.steps[label[e]].fails or any(after[p] > before[p] for p in never)

        def follow(i: int) -> None:
            begin = len(target)
            self._expand(i)
            edges[i] = range(begin, len(target))

        first = 0
        for text in lost:
            if first not in edges:
                follow(first)
            found = (target[e] for e in edges[first] if self.steps[label[e]].text == text)
            first = next(found, first)  # what changes nothing has no edge
        while len(edges) < len(self.states) and self.handled < limit and not self.late:
            i, stale, careful = first, 0, not careful
            for _ in range(next(lengths)):
                self.handled += 1
                if i not in edges:
                    follow(i)
                ways = [e for e in edges[i] if target[e] != i]
                if stale >= STALE and all(target[e] in edges or avoided(e) for e in ways):
                    # Else a part that the task never leaves would hardly be explored to its end.
                    if (i := self._nearest(i, edges, avoided)) < 0:
                        first = 0
                        break
                    continue
                if not ways:
                    first = 0
                    break
                shares = list[float]()
                for e in ways:
                    share = (RARE if avoided(e) else 1.0) * (KNOWN if target[e] in edges else 1.0)
                    shares.append(share + (shares[-1] if shares else 0.0))
                way = bisect(shares, random.random() * shares[-1], hi=len(ways) - 1)
                i = target[ways[way]]
                stale = stale + 1 if i in edges else 0
            self.late = overtime()
        return edges

    def _nearest(
        self, i: int, edges: Mapping[int, Iterable[int]], avoided: Callable[[int], bool]
    ) -> int:
        """Return the nearest state after this one that is not explored, without edges that are
        avoided; -1 if there is none: nothing else can be reached."""
        target, seen = self.edges[1], {i: None}
        for n, state in enumerate(todo := [i]):
            self.handled += n % LOOKS == 0
            for e in edges[state]:
                if (j := target[e]) not in edges and not avoided(e):
                    return j
                if j in edges and j not in seen:
                    seen[j] = None
                    todo.append(j)
        return -1

    def _follow(
        self, i: int, causes: Iterable[Cause], known: list[NextState | None] | None
    ) -> None:
        """Follow stimuli from a state. `known` is what followed each of them in states that share
        their number with this one, and is extended; None: the stimuli are not those of the world.
        """
        source, target, label = self.edges
        before = self.states[i]
        for n, cause in enumerate(causes):
            found = known[n] if known is not None and n < len(known) else None
            j = None if found is None else self._known(before, found)
            if found is not None and j is not None:
                firings = found.firings
            else:
                state, said = self.engine.handle(before, cause.stimulus)
                came = (i, cause.stimulus)
                j, core, firings = self._found(before, self.orders[i], state, said, came)
                if known is not None and n == len(known) and self.engine.policy.ask_undecided:
                    known.append(self._next(before, state, said, core, firings))
            runs = sum(map(len, self.states[j].tokens.values()))
            self.handled += 1 + len(firings) + runs // QUEUE
            if i != j or firings:
                number = self.labels.setdefault((cause.text, firings), len(self.steps))
                if number == len(self.steps):
                    self.steps.append(Step(cause.text, firings, cause.stimulus))
                source.append(i)
                target.append(j)
                label.append(number)

    def _next(
        self,
        before: State,
        state: State,
        said: tuple[Instruction, ...],
        core: int,
        firings: tuple[str, ...],
    ) -> NextState | None:
        """Return what follows in all states that share their number with `before`; None if it may
        depend on the rest of them."""
        draws = state.suspended is not None  # in others the order of waiting may decide, unasked
        if state.mode is not Mode.RUNNING or draws or _reports(said, UNSAFE):
            return None
        if self.names.begins.intersection(firings):
            return None
        return NextState(core, firings, self.names.left(state) - self.names.left(before))

    def _known(self, before: State, found: NextState) -> int | None:
        """Return the number of the state that follows, if it was found before."""
        left = self.names.left(before) + found.more
        waiting: Hashable = ()
        if not self.engine.policy.ask_undecided:
            lacking = self.shared.lacking(found.number, self.engine)
            waiting = self.names.waiting_after(before, lacking, found.firings)
        return self.index.get((found.number, waiting, left, False))

    def _result(
        self, first: tuple[str, ...], expanded: Iterable[int], by_hand: Mask, limit: int
    ) -> ExecutionGraph:
        done = np.zeros(len(self.states), np.bool_)
        done[list(expanded)] = True
        complete = bool(done.all())
        source, target, label = (np.array(row, dtype=np.int32) for row in self.edges)
        order = np.argsort(source, kind="stable")
        return ExecutionGraph(
            self.engine,
            self.names,
            tuple(self.states),
            tuple(self.orders),
            tuple(self.came),
            source[order],
            target[order],
            label[order],
            tuple(self.steps),
            first,
            done,
            complete,
            ""
            if complete
            else f"time limit, after {self.handled} stimuli and firings"
            if self.late
            else f"more than {limit} stimuli and firings",
            tuple(self.livelocks),
            self.crowded,
            self.contests,
            self.index,
            self.shared,
            by_hand[order],
        )

    def _expand(self, i: int) -> None:
        """Follow all stimuli of the world from a state."""
        state, orders = self.states[i], self.orders[i]
        number = self.shared.number(self.names.core(state, orders), state)
        causes = () if i in self.livelocks else self.names.stimuli(state, orders)
        self._follow(i, causes, self.shared.after.setdefault(number, []))

    def _found(
        self,
        before: State,
        orders: Orders,
        state: State,
        said: tuple[Instruction, ...],
        came: tuple[int, Stimulus] | None,
    ) -> tuple[int, int, tuple[str, ...]]:
        """Return the number of the state, its number in `shared`, and what fired on the way."""
        after = self.names.next_orders(before, orders, state)
        core = self.shared.number(self.names.core(state, after), state)
        endless = _reports(said, TIMELESS)
        key = (core, *self.names.rest(state), endless)
        number = self.index.setdefault(key, len(self.states))
        if number == len(self.states):
            self.states.append(state)
            self.orders.append(after)
            self.came.append(came)
            if endless:
                self.livelocks.append(number)
        for one in said:
            if isinstance(one, Report) and one.key == UNSAFE:
                self.crowded.setdefault(one.of, number)
            elif isinstance(one, Choose) and (rivals := self.names.undecided(one)):
                self.contests.setdefault(rivals, number)
        return number, core, _fired(said)


def _fired(said: tuple[Instruction, ...]) -> tuple[str, ...]:
    return tuple(i.transition for i in said if isinstance(i, Fired))


def _reports(said: tuple[Instruction, ...], key: str) -> bool:
    return any(isinstance(i, Report) and i.key == key for i in said)
