"""Plays trials of a task through its net, many side by side: runs end as their laws draw, the net
says what follows.

A row of the arrays holds one run of an action place, from the queue to the transition that takes
it. A place has as many rows as it ever held tokens at once.

This is the generalised semi-Markov process of docs/forecast.md: when a token enters an action place
an action is chosen, then how and when its run will end is drawn in one draw (competing risks: of
itself with a status, or preempted by an event or a timer); transitions that wait for events or
timers race with their measured waits, or with the rates of their events; everything else fires at
once, also what preempts a run because another one has ended. Runs wait for their devices, tokens
for a server, and transitions for a token that others want, too, as in the engine: first
come, first served.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, TypeAlias

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace
from numpy.typing import NDArray

from petrobot.coordinator.analysis.net.pack import concession
from petrobot.coordinator.analysis.time.measured import branching_places
from petrobot.coordinator.engine.compiled import contested_places
from petrobot.coordinator.studies.forecast.distributions import Drawer, Mask
from petrobot.coordinator.studies.forecast.history import CENSORED, STATUSES, Codes, Seen, Values
from petrobot.coordinator.studies.forecast.net_arrays import ERROR, SUCCESS, Move, Structure
from petrobot.coordinator.task import Counts, EarlyEvent, End, EventMemory, Start, Status, Task
from petrobot.coordinator.task.compiled_task import ActionArc
from petrobot.coordinator.task.conditions import ConditionFault, Expression
from petrobot.coordinator.task.conditions.language import Scalar
from petrobot.coordinator.task.net import Marking

IDLE, QUEUED, GOING, DONE = range(4)
Row: TypeAlias = int | Codes
Columns: TypeAlias = slice | Codes
ALL = slice(None)
_NEVER, _LEAST = np.iinfo(np.int64).max, np.iinfo(np.int64).min
ROUNDING = 1e-9
"""s by which a sum of times may differ from the same time."""
LONGEST = 10_000
"""Firings at one time, or steps, after which a trial counts as one that never ends."""
Choices = Mapping[str, Mapping[str, float]]
"""By primitive task: the probability of each action."""


class Played(Struct, frozen=True):
    """What trials came to. Arrays (columns,); a trial that never ended has not completed."""

    goals: Codes
    completed: Mask
    all_success: Mask
    time: Values
    """s from the taking of the run token to the end; nan for those that did not complete."""
    endless: int = 0
    """Trials that were cut off after `longest` steps."""
    beyond: Mapping[str, int] = field(default_factory=dict)
    """By action place: trials in which a run went on for longer than any run that was seen, before
    anything took it."""
    astray: Mapping[str, int] = field(default_factory=dict)
    """By transition: trials in which its measured preemption came when the marking did not allow
    it."""
    barred: Mapping[str, int] = field(default_factory=dict)
    """By transition: trials that came to a stop where it could have started a run in a place of
    which nothing was measured. It never fires."""
    guessed: Mapping[str, int] = field(default_factory=dict)
    """By transitions: trials in which no training trial tells which one of them fires."""
    ways: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    """By action place: how often each transition took a token out of it."""


class _Runs(Struct):
    """The runs of all columns. Arrays (rows, columns)."""

    phase: NDArray[np.int8]
    status: Codes
    want: Codes
    """Number of the transition that took the measured run; -1 for any."""
    preempted: Mask
    end: Values
    """When it will end; inf if it is not active."""
    action: Codes
    outcome: Codes
    took: Values
    came: Values
    """When it began to wait for its device, or began."""
    beyond: Mask
    """Whether it lasts longer than any that was seen."""
    device: Codes
    """-1 for none."""
    turn: Codes
    """Its number among those that wait for a device; 0 if it does not."""
    entered: Codes
    """Its number among those that came."""
    ended: Codes
    """Its number among those that ended."""

    @classmethod
    def idle(cls, rows: int, n: int) -> _Runs:
        """Return rows without runs."""
        blank: dict[str, Any] = {"phase": np.int8(IDLE), "want": -1, "device": -1, "end": np.inf}
        blank |= {"took": 0.0, "came": 0.0, "preempted": False, "beyond": False}
        return cls(*(np.full((rows, n), blank.get(name, 0)) for name in cls.__struct_fields__))

    def keep(self, kept: Mask) -> None:
        """Continue with some columns."""
        for name in self.__struct_fields__:
            setattr(self, name, getattr(self, name)[:, kept])

    def add_row(self) -> None:
        """Make room for one more run."""
        more = self.idle(1, self.phase.shape[1])
        for name in self.__struct_fields__:
            setattr(self, name, np.concatenate([getattr(self, name), getattr(more, name)]))


class _Variables:
    """Values of the variables that follow from what fired."""

    def __init__(self, first: Mapping[str, Scalar | None], n: int) -> None:
        self.valuations = [first]
        self.valuation = np.zeros(n, np.int64)
        """By column: the index of its valuation."""

    def keep(self, kept: Mask) -> None:
        """Continue with some columns."""
        self.valuation = self.valuation[kept]

    def satisfy(self, condition: Expression) -> Mask:
        """Return where a condition on them is true."""
        codes, where = np.unique(self.valuation, return_inverse=True)
        held = []
        for code in codes.tolist():
            try:
                held.append(condition.holds(self.valuations[code]))
            except ConditionFault:
                held.append(False)
        return np.array(held, np.bool_)[where]

    def write(self, m: Move, columns: Codes) -> None:
        """Set what the transition sets."""
        written = self.valuation[columns]
        for code in np.unique(written).tolist():
            before = self.valuations[code]
            after = {
                **before,
                **{name: v.value(before) for name, v in m.transition.sets if name in before},
            }
            if after not in self.valuations:
                self.valuations.append(after)
            own = columns[written == code]
            self.valuation[own] = self.valuations.index(after)


class _Clocks:
    """When the events and timers come for which transitions wait. Transitions that wait for the
    same event, of which the rate is known, share a clock: the first of them that can fire consumes
    a latched one, and a pulse serves all. The rate is that of the transitions which the event would
    serve if it came now."""

    def __init__(
        self,
        moves: Sequence[Move],
        structure: Structure,
        drawer: Drawer,
        periods: Mapping[str, float],
        n: int,
    ) -> None:
        self._s, self._drawer, self._periods = structure, drawer, periods
        self.moves = [m for m in moves if m.waits and not m.cause]
        shared = [m.memory is not None and not drawer.as_measured(m.name) for m in self.moves]
        clocks: dict[str | int, list[int]] = {}
        for i, m in enumerate(self.moves):
            key = structure.task.transitions[m.name].events[0] if shared[i] else i
            clocks.setdefault(key, []).append(i)
        self.members = list(clocks.values())
        """By clock: the indices of its transitions in `moves`."""
        self.latched = {
            self.moves[i].number: clock
            for clock, members in enumerate(self.members)
            for i in members
            if shared[i] and self._is_latched(self.moves[i])
        }
        """By transition: the clock of its latched event."""
        self.due = np.full((len(self.members), n), np.inf)
        self._waiting = np.zeros((len(self.moves), n), np.bool_)
        """Which of the transitions the event would serve."""
        self._pulses = {event: drawer.chance(n) * s for event, s in periods.items()}
        """By event of a timer: when it comes for the first time. A trial may begin at any time."""

    @staticmethod
    def _is_latched(m: Move) -> bool:
        return m.memory is not None and m.memory[0] is EventMemory.LATCHED

    def keep(self, kept: Mask) -> None:
        """Continue with some columns."""
        self.due, self._waiting = self.due[:, kept], self._waiting[:, kept]
        self._pulses = {event: first[kept] for event, first in self._pulses.items()}

    def drop(self, tokens: Codes, now: Values) -> None:
        """Forget latched events that have come and now wait for none of the transitions for which
        they waited before the last firing."""
        for due, members in zip(self.due, self.members, strict=True):
            come = np.flatnonzero(due <= now)
            if len(members) > 1 and len(come):
                able, mine = np.ones(len(come), np.bool_), np.ix_(np.array(members), come)
                waiting = [self._served(self.moves[i], able, tokens[:, come]) for i in members]
                due[come[~(self._waiting[mine] & waiting).any(axis=0)]] = np.inf
                self._waiting[mine] = waiting

    def wait(self, able: Sequence[Mask], now: Values, tokens: Codes, replicate: Codes) -> Values:
        """Draw when events will come, as soon as they can serve a transition, and forget it when
        they cannot any more. Return when each of the transitions, of which these are `able`, will
        fire, if nothing happens before."""
        fires = np.full((len(self.moves), len(now)), np.inf)
        for due, members in zip(self.due, self.members, strict=True):
            waiting = np.array([self._served(self.moves[i], able[i], tokens) for i in members])
            served = waiting.any(axis=0)
            if len(members) > 1:  # at a rate, so what is left of a wait is like a wait
                others = (waiting != self._waiting[members]).any(axis=0)
                due[others & (due > now)] = np.inf
                self._waiting[members] = waiting
            fresh = np.flatnonzero(served & np.isinf(due))
            moves = [self.moves[i] for i in members]
            for mine in np.unique(waiting[:, fresh], axis=1).T if len(fresh) else ():
                columns = fresh[(mine == waiting[:, fresh].T).all(axis=1)]
                told = [m for m, one in zip(moves, mine, strict=True) if one]
                if not any(self._drawer.measured(m.name) for m in told):
                    told = moves
                due[columns] = now[columns] + self._drawn(told, columns, now, replicate)
            due[~served] = np.inf
            free = np.ones(len(now), np.bool_)  # a latched event serves one of them
            for i in sorted(members, key=lambda i: -self.moves[i].priority):
                first = able[i] & free
                fires[i, first] = np.maximum(due[first], now[first])
                if self._is_latched(self.moves[i]):
                    free &= ~first
        return fires

    def _served(self, move: Move, able: Mask, tokens: Codes) -> Mask:
        """Return where its event serves a transition if it comes now: as in the engine, a latched
        one may come before the runs have ended that the transition takes, and a kept one at any
        time."""
        if move.memory is None or self._drawer.as_measured(move.name):
            return able
        memory, early = move.memory
        if early is EarlyEvent.KEEP:
            return np.ones_like(able)
        if memory is EventMemory.LATCHED:
            return concession(self._s.rule, tokens, move.number)
        return able

    def _drawn(
        self, moves: Sequence[Move], columns: Codes, now: Values, replicate: Codes
    ) -> Values:
        move = moves[0]
        event = next(iter(self._s.task.transitions[move.name].events), "")
        if (
            move.memory is not None
            and event in self._periods
            and not self._drawer.as_measured(move.name)
        ):
            period = self._periods[event]
            wait = (self._pulses[event][columns] - now[columns]) % period
            return np.where(wait > ROUNDING, wait, wait + period)  # one that comes now has served
        drawn = self._drawer.wait([m.name for m in moves], replicate[columns])
        if drawn is not None:
            return drawn
        if move.transition.after is not None:
            return np.full(len(columns), move.transition.after)
        if move.mean_wait is None:
            return np.full(len(columns), 1e12)  # its event was never seen to come
        return -move.mean_wait * np.log1p(-self._drawer.chance(len(columns)))


class _Fork:
    """Alternatives among which variables decide that the trials do not tell: one is drawn as often
    as it fired, and stays until it fires or cannot any more. Priorities and weights are in that."""

    def __init__(self, moves: Sequence[Move], drawer: Drawer, n: int) -> None:
        self.moves, self._drawer = moves, drawer
        self._way = {m.number: i for i, m in enumerate(moves)}
        self._shares = drawer.branches([m.name for m in moves])
        self.chosen, self._last = np.full((2, n), -1)
        self._count = np.zeros(n, np.int64)
        self._open = np.array([m.open_ for m in moves])

    def keep(self, kept: Mask) -> None:
        """Continue with some columns."""
        self.chosen, self._last = self.chosen[kept], self._last[kept]
        self._count = self._count[kept]

    def fired(self, number: int, columns: Codes) -> None:
        """Note that a transition fired, if it is one of the alternatives."""
        if number not in self._way:
            return
        self.chosen[columns], self._last[columns] = -1, self._way[number]
        self._count[columns] += 1

    def choose(self, able: Mask, replicate: Codes) -> Codes:
        """Choose among those that are able (moves, columns) where one of them has a condition that
        is open. Return the columns in which nothing tells which."""
        columns = np.arange(able.shape[1])
        stays = (self.chosen >= 0) & able[np.maximum(self.chosen, 0), columns]
        self.chosen = np.where(stays, self.chosen, -1)
        fresh = np.flatnonzero(~stays & able[self._open].any(axis=0))
        if not len(fresh):
            return fresh
        mine = able[:, fresh].T
        share, found = np.zeros(mine.shape), np.zeros(len(fresh), np.bool_)
        contexts = np.stack([self._last[fresh], self._count[fresh]], axis=1)
        for length in (2, 1, 0):
            for context in np.unique(contexts[~found, :length], axis=0).tolist():
                told = self._shares.get(tuple(context))
                if told is None:
                    continue
                own = np.flatnonzero(~found & (contexts[:, :length] == context).all(axis=1))
                share[own] = told[replicate[fresh[own]]] * mine[own]
                found[own] = share[own].sum(axis=1) > 0.0
        share[~found] = mine[~found]
        bounds = np.cumsum(share, axis=1)
        draw = self._drawer.chance(len(fresh)) * bounds[:, -1]
        self.chosen[fresh] = (bounds <= draw[:, None]).sum(axis=1)
        guessed: Codes = fresh[~found & (mine.sum(axis=1) > 1)]
        return guessed


def _alternatives(task: Task, moves: Sequence[Move]) -> list[list[Move]]:
    """Return the groups of transitions that take tokens from the same places, where the
    condition of one is open."""
    groups = list[tuple[set[Any], list[Move]]]()
    for m in moves:
        places, members = branching_places(task, task.transitions[m.name]), [m]
        for group in [g for g in groups if g[0] & places]:
            groups.remove(group)
            places, members = places | group[0], [*group[1], *members]
        groups.append((places, members))
    return [members for _, members in groups if any(m.open_ and not m.waits for m in members)]


def _soonest(times: Values) -> tuple[Codes, Values]:
    """Return the row with the least time in each column, and that time: never, without a row."""
    columns = np.arange(times.shape[1])
    if not len(times):
        return np.zeros(len(columns), np.int64), np.full(len(columns), np.inf)
    row: Codes = times.argmin(axis=0)
    return row, times[row, columns]


class Play:
    """Active trials; `replicate` (columns,) says whose bootstrap weights each one draws with."""

    def __init__(
        self,
        structure: Structure,
        drawer: Drawer,
        choices: Choices,
        replicate: Codes,
        longest: int = LONGEST,
        devices: Mapping[str, str] | None = None,
        periods: Mapping[str, float] | None = None,
    ) -> None:
        """`longest`: steps (ends of runs and of waits) of a trial at most. `devices`: by action the
        device for which its runs may have to wait. `periods`: by event that of its timer (s).
        Raises ValueError for a choice without probabilities."""
        n, places, task = len(replicate), structure.vocabulary.places, structure.task
        self._s, self._drawer, self._replicate = structure, drawer, replicate
        self._longest = longest
        self._choices = [self._choice(choices, name) for name in places]
        unknown = {p for p, q in structure.codes.items() if not len(self._choices[q][0])}
        self._barred, free = list[Move](), list[Move]()
        for m in structure.moves:
            starts = {p for p, _, is_action in m.transition.produce if is_action}
            (self._barred if starts & unknown else free).append(m)
        self._forks = [_Fork(members, drawer, n) for members in _alternatives(task, free)]
        self._clocks = _Clocks(free, structure, drawer, periods or {}, n)
        latched = self._clocks.latched
        self._quick = [m for m in free if not m.waits or m.number in latched]
        """Transitions that fire without time: those that wait for nothing, and those whose event
        has come before."""
        self._latched = [latched.get(m.number) for m in self._quick]
        """Their clocks."""
        self._certain = [
            m
            for m in self._quick
            if m.ended
            and not m.waits
            and (m.allowed is not None or m.known is not None or m.transition.when is None)
        ]
        """Transitions that take an ended run and surely fire as soon as the marking allows it."""
        contested = contested_places([m.transition for m in structure.moves])
        self._contests = [
            (i, place, weight)
            for i, m in enumerate(self._quick)
            if not m.waits
            for place, weight in m.transition.plain
            if place in contested.get(m.number, ())
        ]
        """Transitions (indices in `_quick`) that compete for tokens; of which place; how many."""
        self._since, self._steps = np.full((len(self._contests), n), _NEVER), 0
        self._variables = _Variables(structure.first_values, n)
        self._tokens = np.repeat(structure.initial[:, None], n, axis=1)
        self._place = np.arange(len(places))
        """By row: the code of its place."""
        self._rows = [[q] for q in range(len(places))]
        """By place: its rows."""
        self._runs = _Runs.idle(len(places), n)
        self._entries = self._ends_so_far = self._turns = 0
        self._seen = Seen.nothing(len(places), n)
        of, names = devices or {}, sorted(set((devices or {}).values()))
        known = [names.index(of[a]) if a in of else -1 for a in structure.vocabulary.actions]
        self._device_of = np.array([-1, *known])
        """By code of an action: its device; -1 for none."""
        self._devices = range(len(names))
        self._servers = [task.places[p].most_active for p in places]
        self._at_once = np.array([task.primitive_task_of(p).start is Start.AT_ONCE for p in places])
        self._awaited = np.array([not task.places[p].listen for p in places], np.bool_)
        self._column = np.arange(n)
        self._now, self._begun = np.zeros(n), np.zeros(n)
        self._taken = np.zeros(n, np.bool_)
        """Whether the run token was taken. A trial takes it once: given back, it ends the trial."""
        self._goals, self._good = np.zeros(n, np.int64), np.ones(n, np.bool_)
        self._ends: dict[Marking, int] = {}
        self._odd: dict[str, dict[str, set[int]]] = {}
        self._ways: dict[str, dict[str, int]] = {}
        self._out = Played(
            np.zeros(n, np.int64), np.zeros(n, np.bool_), np.zeros(n, np.bool_), np.full(n, np.nan)
        )

    def _choice(self, choices: Choices, place: str) -> tuple[Codes, Values]:
        primitive = self._s.task.primitive_task_of(place)
        known = {a: p for a, p in choices.get(primitive.name, {}).items() if p > 0}
        codes = [self._s.vocabulary.actions.index(a) + 1 for a in known]
        bounds = np.cumsum(list(known.values()))
        return np.array(codes, np.int64), bounds / bounds[-1] if len(bounds) else bounds

    def run(self) -> Played:
        """Play all to their ends. Raises KeyError and ValueError for what was never measured."""
        for p, q in self._s.codes.items():
            for _ in range(int(self._s.initial[p])):
                self._enter(q, np.arange(len(self._column)))
        for _ in range(self._longest):
            self._settle()
            self._finish(self._over())
            if not len(self._column):
                break
            for q in range(len(self._rows)):
                self._admit(q, np.arange(len(self._column)))
            self._grant()
            able = [self._enabled(m) for m in self._clocks.moves]
            due = self._clocks.wait(able, self._now, self._tokens, self._replicate)
            self._advance(due)
        odd: dict[str, Any] = {
            kind: {name: len(columns) for name, columns in by_name.items()}
            for kind, by_name in self._odd.items()
        }
        return replace(self._out, endless=len(self._column), ways=self._ways, **odd)

    # --- one step -----------------------------------------------------------------------------

    def _settle(self) -> None:
        """Fire what needs no time until nothing does."""
        pending = np.zeros((len(self._quick), len(self._column)), np.bool_)
        for _ in range(LONGEST):
            self._clocks.drop(self._tokens, self._now)
            able = np.array([self._enabled(m) for m in self._quick])
            for i, clock in enumerate(self._latched):
                if clock is not None:
                    able[i] &= self._clocks.due[clock] <= self._now
            self._choose_ways(able)
            some: Mask = np.asarray(able.any(axis=0))
            if not some.any():
                if self._release():
                    continue
                self._note_waits()
                return
            # What one firing makes fireable comes after what was fireable with it.
            pending = np.where((able & pending).any(axis=0), able & pending, able)
            chosen = np.where(some, self._first(pending), -1)
            for i, move in enumerate(self._quick):
                columns = np.flatnonzero(chosen == i)
                if len(columns):
                    if (clock := self._latched[i]) is not None:
                        self._clocks.due[clock, columns] = np.inf
                    self._fire(move, columns)
                    pending[i, columns] = False
        raise ValueError(
            f"{self._s.task.name}: transitions fire for ever without time going on; run "
            "petrobot check"
        )

    def _choose_ways(self, able: Mask) -> None:
        """Leave only the chosen one of alternatives able. One that waits may be chosen, too: then
        nothing fires before it."""
        quick = {m.number: i for i, m in enumerate(self._quick)}
        for fork in self._forks:
            rows = [quick.get(m.number) for m in fork.moves]
            mine = np.array(
                [
                    self._enabled(m) if i is None or m.waits else able[i]
                    for i, m in zip(rows, fork.moves, strict=True)
                ]
            )
            waiting = np.array([m.waits for m in fork.moves])
            mine[waiting] &= mine[~waiting].any(axis=0)
            guessed = fork.choose(mine, self._replicate)
            self._note_odd("guessed", " or ".join(m.name for m in fork.moves), guessed)
            for k, i in enumerate(rows):
                if i is not None and not fork.moves[k].waits:
                    able[i] &= (fork.chosen == k) | (fork.chosen < 0)

    def _release(self) -> bool:
        """Let ended runs leave by a transition that surely fires in the engine, where their
        measured one is not enabled. The measured one may belong to another marking, such as another
        number of used tries. Return whether any run may leave now."""
        held = (self._runs.want >= 0) & (self._runs.phase == DONE)
        if not held.any():
            return False
        measured, released = self._runs.want, np.zeros_like(held)
        self._runs.want = np.where(held, -1, measured)
        for m in self._certain:
            able = self._enabled(m)
            for arc in m.ended:
                for r in self._runs_of(arc):
                    released[r] |= able & self._fits(m, arc, r)
        self._runs.want = np.where(released, -1, measured)
        return bool((held & released).any())

    def _first(self, able: Mask) -> Codes:
        """Return which of the fireable transitions fires next in each column. As in the engine:
        priority, then a draw by weight, or the one that has waited longest for a token, at a tie
        the first in the file."""
        priority = np.array([m.priority for m in self._quick])[:, None]
        able = able & (priority == np.where(able, priority, _LEAST).max(axis=0))
        since = np.full(able.shape, _NEVER - 1)
        for k, (i, _, _) in enumerate(self._contests):
            since[i] = np.minimum(since[i], self._since[k])
        head: Codes = np.where(able, since, _NEVER).argmin(axis=0)
        drawn = np.array([m.transition.weight is not None for m in self._quick])
        weights = np.array([m.transition.weight or 0.0 for m in self._quick])[:, None]
        bounds = np.cumsum(able * weights, axis=0)
        draw = self._drawer.chance(able.shape[1]) * bounds[-1]
        return np.where(drawn[head], (bounds <= draw).sum(axis=0), head)

    def _note_waits(self) -> None:
        """Note since which step each transition lacks nothing but tokens of one contested place."""
        self._steps += 1
        for k, (i, place, weight) in enumerate(self._contests):
            there = self._tokens[place].copy()
            self._tokens[place] = np.maximum(there, weight)
            lacking = self._enabled(self._quick[i]) & (there < weight)
            self._tokens[place] = there
            known = np.minimum(self._since[k], self._steps)
            self._since[k] = np.where(lacking, known, _NEVER)

    def _enabled(self, m: Move) -> Mask:
        out = concession(self._s.rule, self._tokens, m.number)
        if m.takes_run:
            out &= ~self._taken
        for arc in m.transition.actions:
            fitting = [self._fits(m, arc, r) for r in self._runs_of(arc)]
            out &= sum(fitting[1:], fitting[0].astype(np.int64)) >= arc.weight
        if m.known is not None:
            out &= self._variables.satisfy(m.known)
        if m.allowed is not None:
            runs = product(*(self._runs_of(arc) for arc in m.ended))
            out &= np.any([self._admits(m, m.allowed, those) for those in runs], axis=0)
        return out

    def _runs_of(self, arc: ActionArc) -> list[int]:
        return self._rows[self._s.codes[arc.place]]

    def _fits(self, m: Move, arc: ActionArc, run: Row, columns: Columns = ALL) -> Mask:
        """Return where the arc may take the run."""
        phase = self._runs.phase[run, columns]
        if arc.end is End.GOING or arc.end is End.PREEMPT:
            active: Mask = (phase == QUEUED) | (phase == GOING)
            return active | (phase == DONE) if arc.takes_done else active
        error = self._runs.status[run, columns] == ERROR
        want = self._runs.want[run, columns]
        fits: Mask = (phase == DONE) & (error == (arc.end is End.ERROR))
        fits &= (want < 0) | (want == m.number)
        return fits

    def _admits(self, m: Move, allowed: Mask, runs: Sequence[Row], columns: Columns = ALL) -> Mask:
        """Return where the condition admits these ended runs, one for each arc that takes any."""
        out: Mask = allowed[tuple(np.clip(self._runs.status[r, columns], 0, None) for r in runs)]
        # a run whose measured transition is known shows that the condition held
        out = out | np.any([self._runs.want[r, columns] == m.number for r in runs], axis=0)
        for arc, r in zip(m.ended, runs, strict=True):
            out = out & self._fits(m, arc, r, columns)
        return out

    def _selected(self, m: Move, columns: Codes, cut: int | None) -> list[Codes]:
        """Return the runs that each arc takes: for action arc k an array (weight, columns) of rows.
        As in the engine: the first ones that ended or, of active ones, that came; if a condition
        judges them, the first that it admits. `cut`: the run that the firing preempts."""
        arcs, ranked = m.transition.actions, list[Codes]()
        for arc in arcs:
            rows = np.array(self._runs_of(arc))
            fits = np.array([self._fits(m, arc, r, columns) for r in rows])
            numbers = self._runs.ended if arc in m.ended else self._runs.entered
            order = np.where(fits, numbers[rows][:, columns], _NEVER)
            order[rows == cut] = -1
            ranked.append(rows[order.argsort(axis=0, kind="stable")])
        judged = [k for k, arc in enumerate(arcs) if arc in m.ended]
        if m.allowed is not None and any(len(ranked[k]) > 1 for k in judged):
            left = np.ones(len(columns), np.bool_)
            for first in product(*(range(len(ranked[k]) - arcs[k].weight + 1) for k in judged)):
                begins = list(zip(judged, first, strict=True))
                runs = [ranked[k][i + arcs[k].weight - 1] for k, i in begins]
                now = left & self._admits(m, m.allowed, runs, columns)
                for k, i in begins:
                    weight = arcs[k].weight
                    ranked[k][:weight, now] = ranked[k][i : i + weight, now]
                left &= ~now
        return [rows[: arc.weight] for arc, rows in zip(arcs, ranked, strict=True)]

    def _fire(self, m: Move, columns: Codes, cut: int | None = None) -> None:
        """Fire in these columns. `cut`: the row of the run that preempts itself."""
        selected = self._selected(m, columns, cut)
        for place, change in m.transition.changes:
            self._tokens[place, columns] += change
        taken = list[int]()
        for arc, rows in zip(m.transition.actions, selected, strict=True):
            if arc.end is End.GOING:
                continue
            taken.append(self._s.codes[arc.place])
            if arc.end is End.PREEMPT and not m.cause:
                for row in rows:
                    self._cut(m, arc.counts, row, columns)
            self._runs.phase[rows, columns], self._runs.end[rows, columns] = IDLE, np.inf
            self._runs.device[rows, columns], self._runs.turn[rows, columns] = -1, 0
            ways = self._ways.setdefault(arc.name, {})
            ways[m.name] = ways.get(m.name, 0) + rows.size
        if m.takes_run:
            self._begun[columns], self._taken[columns] = self._now[columns], True
        self._goals[columns] += m.is_goal
        for fork in self._forks:
            fork.fired(m.number, columns)
        if m.transition.sets:
            self._variables.write(m, columns)
        for place, weight, is_action in m.transition.produce:
            if is_action:
                taken.append(self._s.codes[place])
                for _ in range(weight):
                    self._enter(taken[-1], columns)
        for q in dict.fromkeys(taken):
            self._admit(q, columns)

    def _enter(self, q: int, columns: Codes) -> None:
        """Put a run into the queue of its place, in the first row that is free."""
        self._entries += 1
        for r in self._rows[q]:
            free = self._runs.phase[r, columns] == IDLE
            self._queue(r, columns[free])
            columns = columns[~free]
        if len(columns):
            self._rows[q].append(len(self._place))
            self._place = np.append(self._place, q)
            self._runs.add_row()
            self._queue(self._rows[q][-1], columns)

    def _queue(self, run: int, columns: Codes) -> None:
        self._runs.phase[run, columns], self._runs.entered[run, columns] = QUEUED, self._entries

    def _admit(self, q: int, columns: Codes) -> None:
        """Begin runs while a server is free; further tokens wait."""
        rows = self._rows[q]
        while len(columns):
            phase = self._runs.phase[rows][:, columns]
            free = (phase == GOING).sum(axis=0) < self._servers[q]
            columns, phase = columns[free], phase[:, free]
            waiting = np.where(phase == QUEUED, self._runs.entered[rows][:, columns], _NEVER)
            fresh = waiting.min(axis=0) < _NEVER
            columns, first = columns[fresh], waiting[:, fresh].argmin(axis=0)
            for i in np.unique(first):
                self._start(rows[i], columns[first == i])

    def _grant(self) -> None:
        """Let runs begin whose device is free, in the order in which their tokens came."""
        never = np.iinfo(np.int64).max
        for device in self._devices:
            mine, columns = self._runs.device == device, np.arange(len(self._column))
            busy = (mine & (self._runs.turn == 0) & (self._runs.phase == GOING)).any(axis=0)
            turn = np.where(mine & (self._runs.turn > 0), self._runs.turn, never)
            while (turn < never).any():
                q = turn.argmin(axis=0)
                begins = (turn[q, columns] < never) & (self._at_once[self._place[q]] | ~busy)
                own, its = columns[begins], q[begins]
                self._runs.turn[its, own], self._runs.came[its, own] = 0, self._now[own]
                self._runs.end[its, own] = self._now[own] + self._runs.took[its, own]
                busy |= begins
                turn[q, columns] = never

    def _cut(self, m: Move, counts: Counts, rows: Codes, columns: Codes) -> None:
        """End runs that are taken while they are active: they count as the arc says. One that still
        waits for a server or its device never began, so it does not count."""
        active = (self._runs.phase[rows, columns] == GOING) & (self._runs.turn[rows, columns] == 0)
        rows, columns = rows[active], columns[active]
        status = CENSORED if counts is Counts.NONE else STATUSES.index(Status(counts.value))
        lasted = self._now[columns] - self._runs.came[rows, columns]
        code = np.full(len(columns), self._s.vocabulary.outcome(status, m.number))
        self._seen.note(self._place[rows], columns, code, self._runs.action[rows, columns], lasted)
        self._good[columns] &= status <= SUCCESS

    def _note_odd(self, kind: str, name: str, columns: Codes) -> None:
        if len(columns):
            known = self._odd.setdefault(kind, {}).setdefault(name, set())
            known.update(self._column[columns].tolist())

    def _start(self, run: int, columns: Codes) -> None:
        """Choose an action and draw how its run will end."""
        q = int(self._place[run])
        codes, bounds = self._choices[q]
        if not len(codes):
            raise ValueError(
                f"{self._s.vocabulary.places[q]}: the task begins there, but no training run "
                "entered it; train with more trials"
            )
        which = np.searchsorted(bounds, self._drawer.chance(len(columns)), side="right")
        action = codes[np.minimum(which, len(codes) - 1)]
        ends = self._drawer.ends(q, action, self._replicate[columns], self._seen.of(columns))
        self._seen.begun[q, columns] = action
        status, taken = self._s.vocabulary.parts(ends.outcome)
        runs, now = self._runs, self._now[columns]
        runs.phase[run, columns] = GOING
        runs.status[run, columns], runs.want[run, columns] = status, taken
        runs.preempted[run, columns], runs.outcome[run, columns] = ends.preempted, ends.outcome
        runs.came[run, columns], runs.end[run, columns] = now, now + ends.took
        runs.action[run, columns], runs.took[run, columns] = action, ends.took
        runs.beyond[run, columns] = ends.beyond
        device = self._device_of[action]
        runs.device[run, columns], runs.turn[run, columns] = device, 0
        waits = columns[device >= 0]
        if len(waits):
            self._turns += 1
            runs.turn[run, waits], runs.end[run, waits] = self._turns, np.inf

    def _advance(self, due: Values) -> None:
        """On to the next end of a run or of a wait in each column."""
        (run, ends), (i, dues) = _soonest(self._runs.end), _soonest(due)
        soonest = np.minimum(ends, dues)
        moving = np.isfinite(soonest)
        self._now = np.where(moving, soonest, self._now)
        for number in range(len(self._runs.end)):
            self._end_runs(number, np.flatnonzero(moving & (ends <= dues) & (run == number)))
        for clock, members in enumerate(self._clocks.members):
            columns = np.flatnonzero(moving & (dues < ends) & np.isin(i, members))
            self._clocks.due[clock, columns] = np.inf
            now = due[:, columns] <= dues[columns]  # a pulse serves all that it finds waiting
            for number in sorted(members, key=lambda k: -self._clocks.moves[k].priority):
                served, move = columns[now[number]], self._clocks.moves[number]
                if len(members) > 1 and len(served):
                    served = served[self._enabled(move)[served]]  # one before may have barred it
                if len(served):
                    self._fire(move, served)
        self._free(np.flatnonzero(~moving))

    def _end_runs(self, run: int, columns: Codes) -> None:
        if not len(columns):
            return
        q, runs = int(self._place[run]), self._runs
        runs.end[run, columns] = np.inf
        self._ends_so_far += 1
        runs.ended[run, columns] = self._ends_so_far
        self._note_odd("beyond", self._s.vocabulary.places[q], columns[runs.beyond[run, columns]])
        self._seen.note(
            q,
            columns,
            runs.outcome[run, columns],
            runs.action[run, columns],
            runs.took[run, columns],
        )
        self._good[columns] &= runs.status[run, columns] <= SUCCESS  # censored ones spoil nothing
        cut = columns[runs.preempted[run, columns]]
        runs.phase[run, columns] = DONE
        runs.phase[run, cut] = GOING
        for number in np.unique(runs.want[run, cut]):
            own = cut[runs.want[run, cut] == number]
            able = (
                self._enabled(self._s.moves[number])[own]
                if number >= 0
                else np.zeros(len(own), np.bool_)
            )
            if able.any():
                self._fire(self._s.moves[number], own[able], cut=run)
            # what preempts it is not enabled: it ends by itself, with that status
            runs.phase[run, own[~able]] = DONE
            self._note_odd("astray", self._s.moves[number].name, own[~able])

    def _free(self, stuck: Codes) -> None:
        """Nothing will happen in these columns: let the ended runs go any way that their status
        allows, else give up."""
        for run, q in enumerate(self._place):
            lasting = (self._runs.phase[run, stuck] == GOING) & self._runs.beyond[run, stuck]
            self._note_odd("beyond", self._s.vocabulary.places[q], stuck[lasting])
        held = ((self._runs.want[:, stuck] >= 0) & (self._runs.phase[:, stuck] == DONE)).any(axis=0)
        self._runs.want[:, stuck[held]] = -1
        dead = np.zeros(len(self._column), np.bool_)
        dead[stuck[~held]] = True
        for move in self._barred:
            self._note_odd("barred", move.name, np.flatnonzero(dead & self._enabled(move)))
        self._finish(np.where(dead, -1, 0))

    # --- ends ---------------------------------------------------------------------------------

    def _over(self) -> Codes:
        """Return by column whether the trial ended as designed (1), was given up (-1) or is still
        active (0). As in the engine, a trial does not end while a run is active that does not only
        listen."""
        _, first, inverse = np.unique(self._keys(), return_index=True, return_inverse=True)
        verdicts = np.array(
            [self._judge(tuple(self._tokens[:, i].tolist())) for i in first], np.int64
        )
        back = self._taken & (self._tokens == self._s.initial[:, None]).all(axis=0)
        awaited = self._awaited[self._place]
        phase, want = self._runs.phase[awaited], self._runs.want[awaited]
        # an ended one whose measured transition is not enabled goes another way first: `_free`
        busy = ((phase == GOING) | ((phase == DONE) & (want >= 0))).any(axis=0)
        return np.where(busy, 0, np.where(back, 1, verdicts[inverse.ravel()]))

    def _keys(self) -> Codes:
        """One number for each column's marking: its digits in a base above every count of
        tokens."""
        base = int(self._tokens.max(initial=0)) + 1
        if base ** len(self._tokens) >= 2**62:
            return np.unique(self._tokens, axis=1, return_inverse=True)[1].ravel()
        keys: Codes = base ** np.arange(len(self._tokens)) @ self._tokens
        return keys

    def _judge(self, marking: Marking) -> int:
        if marking not in self._ends:
            task = self._s.task
            values = dict(zip(task.net.places, marking, strict=True))
            given_up = task.final_error is not None and task.final_error.holds(values)
            self._ends[marking] = 1 if task.final.holds(values) else -1 if given_up else 0
        return self._ends[marking]

    def _finish(self, verdict: Codes) -> None:
        """Record the columns that have ended, and continue with the others."""
        over = verdict != 0
        if not over.any():
            return
        own, done = self._column[over], verdict[over] > 0
        self._out.goals[own], self._out.completed[own] = self._goals[over], done
        self._out.all_success[own] = self._good[over] & done
        self._out.time[own] = np.where(done, self._now[over] - self._begun[over], np.nan)
        kept = ~over
        self._seen = self._seen.of(kept)
        for fork in self._forks:
            fork.keep(kept)
        self._clocks.keep(kept)
        self._variables.keep(kept)
        self._runs.keep(kept)
        for name in ("_column", "_replicate", "_now", "_begun", "_taken", "_goals", "_good"):
            setattr(self, name, getattr(self, name)[kept])
        for name in ("_tokens", "_since"):
            setattr(self, name, getattr(self, name)[:, kept])
