"""The parts of an engine state on which the future depends, and the stimuli that can arrive in a
state.

A state of the execution graph keeps tokens, runs in their order, latched events, armed timers, an
open draw, and for each variable that a condition reads, only its region. It drops ids, counters,
clocks, records, reports and arguments: no firing depends on them (docs/execution-graph.md).
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping
from itertools import permutations, product
from typing import Any

from msgspec import Struct
from msgspec.structs import replace

from petrobot.coordinator.engine import (
    AddTokens,
    Choose,
    Chosen,
    Engine,
    EventOccurred,
    Mode,
    Phase,
    RemoveTokens,
    Run,
    RunEnded,
    RunRaised,
    State,
    Stimulus,
    StopConfirmed,
    Subject,
    TimerFired,
    VariableChanged,
)
from petrobot.coordinator.engine.state import ACTIVE, Wait
from petrobot.coordinator.task import End, Executed, Kind, Scope, Status, Task
from petrobot.coordinator.task.conditions import Compare, Literal, Name, walk
from petrobot.coordinator.task.conditions.language import as_literal, equal, is_number, with_values
from petrobot.coordinator.task.conditions.regions import region_values
from petrobot.coordinator.task.net import Marking
from petrobot.coordinator.task.validation import is_pulse

RUN_FIELDS = ("status", "reason", "executed")
"""What conditions may ask of a run: `PLACE.status` and so on."""
OUTCOMES = 256
"""The most combinations of values and reasons that are tried for one end of a run."""

REASON = "reason "
"""Word before the reason of a run in a path, where some condition reads it."""

Orders = frozenset[tuple[str, str]]
"""Pairs of armed timers, by their transitions: the first elapses before the second."""


class TooManyValues(ValueError):  # noqa: N818 - a limit of the analysis, not a fault of the task
    """A run can end with too many combinations of values to try them all."""


class Cause(Struct, frozen=True):
    """A stimulus that can arrive in a state, and its words in a path."""

    stimulus: Stimulus
    text: str


class Names:
    """The names that conditions of a task read, and so the parts of a state that matter."""

    def __init__(self, engine: Engine, contests: Iterable[tuple[str, ...]] | None = None) -> None:
        """Collect them. `contests`: the transitions of each conflict that may be decided by the
        order of arrival; None: not known. Raises TooManyValues."""
        self.engine = engine
        # any transition may win a conflict, so the order of waiting does not matter
        if engine.policy.ask_undecided:
            contests = ()
        self._contests = None if contests is None else frozenset(contests)
        """Conflicts in which the order of waiting matters; None: it matters between any two
        transitions."""
        compiled = engine.compiled
        self.task = task = compiled.task
        conditions = [x.when for x in compiled.transitions if x.when is not None]
        parameters = dict(task.parameters)
        fixed = [with_values(c, parameters) for c in conditions]
        self._values = region_values(fixed, compiled.domains)
        self._literals, self._together = literals_of(fixed)
        self.asked = {field: set[str]() for field in RUN_FIELDS}
        """By property of a run that a condition reads: the places whose ended runs it
        distinguishes, because an arc that takes them reads it."""
        read = {name for c in fixed for name in c.names}
        self.known = {n for n in read if n not in _run_names(task)}
        """Other names whose value matters."""
        for x in compiled.transitions:
            for name in x.when.names if x.when is not None else ():
                place, _, field = name.rpartition(".")
                arcs = [a for a in x.actions if a.name == place]
                if field in RUN_FIELDS and place:
                    if any(a.end in (End.NORMAL, End.ERROR) or a.takes_done for a in arcs):
                        self.asked[field].add(place)
                    if not any(a.end in (End.NORMAL, End.ERROR) for a in arcs):
                        self.known.add(name)
        self._in_order = sorted(self.known)
        self._status_read = {n.rpartition(".")[0] for n in read if n.endswith(".status")}
        self.free = sorted(self.known & compiled.free)
        self._mixed = {a.name for x in compiled.transitions for a in x.actions if a.takes_done}
        """Places with an arc that takes both ended and active runs, so that their common order
        matters."""
        self._waits = {
            place: {
                e
                for x in compiled.transitions
                for a in x.actions
                if a.name == place
                for e in a.raised
            }
            for place in compiled.action_places
        }
        self._causes: dict[tuple[str, str], list[Cause]] = {}
        """By run and its name in words: its ends."""
        self.ends = {place: self._ends_of(place) for place in compiled.action_places}
        self._counter = self._uncounted()
        """The place of the runs still to do, if a state's future is the same for any number of them
        until a run begins."""
        self.begins = frozenset(
            x.name for x in compiled.transitions if self._counter in dict(x.plain)
        )
        """The transition by which a run begins then."""
        self.assumptions = tuple(
            [f"{name} may take any value at any time" for name in self.free]
            + [
                f"the parameter {n} is {as_literal(v)}"
                for n, v in parameters.items()
                if any(n in c.names for c in conditions)
            ]
        )
        """Assumptions of the verdicts, as clauses."""

    def _uncounted(self) -> int | None:
        compiled = self.engine.compiled
        net, task = compiled.net, compiled.task
        p = net.place_index.get(task.runs_place)
        takers = [dict(x.needs)[p] for x in compiled.transitions if p in dict(x.needs)]
        barred = any(p in dict(x.bars) for x in compiled.transitions)
        ends = [c for c in (task.final, task.final_error) if c is not None]
        literals, together = literals_of(ends)
        asked = literals.get(task.runs_place, [])
        few = takers == [1] and not barred and set(asked) <= {0} and task.runs_place not in together
        return p if few else None

    # --- which states are equal --------------------------------------------------------------

    def key(self, state: State, orders: Orders) -> Hashable:
        """Return what the future of the state depends on."""
        return self.core(state, orders), *self.rest(state)

    def core(self, state: State, orders: Orders) -> Hashable:
        """Return what the future of the state depends on, without `rest`."""
        if state.mode is Mode.FINISHED:
            return (state.mode, state.marking)
        runs, at, waiting = list[Hashable](), dict[str, tuple[str, int]](), list[Run]()
        for place, present in state.tokens.items():
            if not present:
                continue
            if len(present) > 1 and place not in self._mixed:
                present = tuple(
                    sorted(present, key=lambda r: r.ended if r.phase is Phase.DONE else 0)
                )
            ends = sorted([r.ended for r in present if r.phase is Phase.DONE])
            runs.append((place, *[self._run(run, ends) for run in present]))
            for i, run in enumerate(present):
                at[run.id] = (place, i)
                if run.phase is Phase.WAITING:
                    waiting.append(run)
        stopping = sorted([(r.place, r.phase, r.device) for r in state.stopping.values()])
        timers = sorted(
            [
                (name, timer.elapsed, tuple([at[i] for i in timer.runs]))
                for name, timer in state.timers.items()
            ]
        )
        draw = state.suspended
        return (
            state.mode,
            state.closing,
            self._counted(state.marking),
            frozenset(runs),
            tuple(stopping),
            tuple([r.place for r in sorted(waiting, key=lambda r: r.order)]) if waiting else (),
            state.flags and state.flags.intersection(self.engine.compiled.waiting),
            tuple(timers),
            orders,
            None if draw is None else (draw.pulse, draw.choices, draw.alternatives, draw.only),
            tuple([self.region(n, state.variables.get(n, MISSING)) for n in self._in_order]),
        )

    def rest(self, state: State) -> tuple[Hashable, int]:
        """Return the order of waiting, and how many runs are still to do."""
        waits = {} if state.mode is Mode.FINISHED else state.waits
        return self.order_of(waits), self.left(state)

    def left(self, state: State) -> int:
        """Return how many runs are still to do; 0 if `core` says it."""
        return 0 if self._counter is None else state.marking[self._counter]

    def waiting_after(
        self, before: State, lacking: Mapping[str, str], firings: Iterable[str]
    ) -> Hashable:
        """Return the order of waiting in a state after `before` and these firings, in which each
        transition of `lacking` lacks only tokens of that place."""
        waits = dict[str, Wait]()
        for name, place in lacking.items():
            old = before.waits.get(name)
            stays = old is not None and old.place == place and name not in firings
            waits[name] = old if old and stays else Wait(place, before.stimuli + 1)
        return self.order_of(waits)

    def _counted(self, marking: Marking) -> Marking:
        """Return the marking; of the runs still to do only whether there are any."""
        if (p := self._counter) is None or marking[p] < 2:
            return marking
        return (*marking[:p], 1, *marking[p + 1 :])

    def order_of(self, waits: Mapping[str, Wait]) -> Hashable:
        """Return what each waiting transition waits for, and which of two has waited longer if they
        may compete. No other order matters."""
        if not waits or self._contests == frozenset():
            return ()
        if self._contests is None:
            ranks = {s: i for i, s in enumerate(sorted({w.since for w in waits.values()}))}
            return frozenset([(name, w.place, ranks[w.since]) for name, w in waits.items()])
        known, older = set[tuple[str, str]](), set[tuple[str, str]]()
        for group in self._contests:
            present = [name for name in group if name in waits]
            known.update((name, waits[name].place) for name in present)
            older.update(
                (a, b) for a, b in permutations(present, 2) if waits[a].since < waits[b].since
            )
        return frozenset(known), frozenset(older)

    def _run(self, run: Run, ends: list[int]) -> Hashable:
        raised = run.raised & self._waits[run.place] if run.raised else run.raised
        if run.phase is not Phase.DONE:
            phase = "active" if run.phase in ACTIVE else run.phase
            return (phase, run.device if run.phase is not Phase.QUEUED else "", raised)
        status = run.status
        if run.place not in self.asked["status"] and status is Status.FAILURE:
            status = Status.SUCCESS
        told = tuple(
            self.region(f"{run.place}.{field}", value)
            for field, value in (("reason", run.cause), ("executed", str(run.executed)))
            if run.place in self.asked[field]
        )
        order = ends.index(run.ended) if run.place in self._mixed else 0
        return ("done", status, told, raised, order)

    def region(self, name: str, value: Any) -> Hashable:
        """Return the region of a name's value: the results of all comparisons with it."""
        if name in self._together or value is MISSING:
            return (str(type(value).__name__), value if not isinstance(value, list | dict) else "")
        kind = (
            "bool"
            if isinstance(value, bool)
            else "number"
            if is_number(value)
            else type(value).__name__
        )
        told = tuple(
            (equal(value, one), is_number(one) and kind == "number" and value < one)
            for one in self._literals.get(name, ())
        )
        return (kind, value if kind == "bool" else None, told)

    # --- which stimuli can arrive ------------------------------------------------------------

    def stimuli(self, state: State, orders: Orders) -> Iterator[Cause]:
        """Yield every stimulus of the world that can arrive in the state, one of each kind."""
        draw = state.suspended
        if draw is not None and draw.key:
            for name in draw.alternatives:
                yield Cause(Chosen(draw.key, name), f"{name} is drawn")
            return
        if state.mode is not Mode.RUNNING:
            yield from self._stops(state)
            return
        for place in self.engine.compiled.action_places:
            for i, run in enumerate(state.tokens.get(place, ())):
                name = place if i == 0 else f"{place} (run {i + 1})"
                yield from self._of_run(run, name)
        yield from self._stops(state)
        yield from self._events(state)
        late = {later for _, later in orders}
        for name, timer in sorted(state.timers.items()):
            if not timer.elapsed and name not in late:
                after = self.task.transitions[name].after
                yield Cause(TimerFired(timer.key), f"{after:g} s pass")
        for name in self.free:
            now = self.region(name, state.variables.get(name))
            for value in self.different(name):
                if self.region(name, value) != now:
                    yield Cause(VariableChanged(name, value), f"{name} becomes {as_literal(value)}")

    def commands(self, state: State) -> Iterator[Cause]:
        """Yield the operator's moves of one token that the control places allow."""
        if state.mode is not Mode.RUNNING or state.suspended is not None:
            return
        for place, held in zip(self.task.places.values(), state.marking, strict=True):
            if place.kind is Kind.CONTROL:
                room = place.tokens + 1 if place.capacity is None else place.capacity
                if held < room:
                    yield Cause(AddTokens(place.name), f"the operator adds a token to {place.name}")
                if held:
                    text = f"the operator takes a token out of {place.name}"
                    yield Cause(RemoveTokens(place.name), text)

    def _of_run(self, run: Run, name: str) -> Iterator[Cause]:
        if run.phase is Phase.CHOOSING:
            compiled, known = self.engine.compiled, set[str]()
            for action in compiled.primitives[run.place].alternatives:
                device = compiled.devices.get(action, "")
                if device not in known:  # the net does not distinguish actions on the same device
                    known.add(device)
                    yield Cause(Chosen(run.id, action), f"{name} starts")
        elif run.phase in ACTIVE:
            if (run.id, name) not in self._causes:
                self._causes[run.id, name] = [
                    Cause(replace(end, run=run.id), f"{name} ends in {text}")
                    for end, text in self.ends[run.place]
                ]
            yield from self._causes[run.id, name]
            for event in sorted(self._waits[run.place] - run.raised):
                yield Cause(RunRaised(run.id, event), f"{name} raises {event}")

    def _stops(self, state: State) -> Iterator[Cause]:
        seen = set[Hashable]()
        # Equal states yield their stimuli in the same order, so they are not in order of their ids.
        for run in sorted(state.stopping.values(), key=lambda r: (r.place, r.device)):
            if run.phase is Phase.STOPPING and (run.place, run.device) not in seen:
                seen.add((run.place, run.device))
                yield Cause(StopConfirmed(run.id), f"{run.place} has stopped")

    def _events(self, state: State) -> Iterator[Cause]:
        for event in self.task.events.values():
            if event.scope is not Scope.EXTERNAL or event.name not in self.engine.compiled.waiting:
                continue
            kept = event.name in self.engine.compiled.kept
            unset = not is_pulse(event) and event.name not in state.flags
            if (is_pulse(event) or unset) and (kept or self.engine.awaits(state, event.name)):
                yield Cause(EventOccurred(event.name), f"{event.name} comes")

    def _ends_of(self, place: str) -> list[tuple[RunEnded, str]]:
        """Return all ends of a run that some condition distinguishes, each with its words."""
        out = self.task.places[place].out
        read = {result: name for result, name in out.items() if name in self.known}
        statuses = [s for s in Status if s is not Status.FAILURE or place in self._status_read]
        reason = f"{place}.reason"
        named = self._literals.get(reason, ())
        reasons = self.different(reason) if reason in self._values else [""]
        # A reason that no condition names is the usual one, so a path should tell it.
        reasons.sort(key=lambda r: r in named)
        usual = None if reason in self._together else reasons[0]
        kinds = {name: self.task.variables[name].type for name in out.values()}
        asked = f"{place}.executed"
        done = self.different(asked) if asked in self._values else [Executed.YES.value]
        found: list[tuple[RunEnded, str]] = []
        for status in statuses:
            missing = [MISSING] if status is Status.ERROR else []
            choices = [self.different(name) + missing for name in read.values()]
            executed = done if status is Status.ERROR else [Executed.YES.value]
            for cause, was, *values in product(reasons, executed, *choices):
                given = {r: v for r, v in zip(read, values, strict=True) if v is not MISSING}
                told = [f"{read[r]} = {as_literal(v)}" for r, v in given.items()]
                if len(reasons) > 1 and (status is Status.ERROR or cause != usual):
                    told.append(f"{REASON}{cause!r}")
                told += [f"executed = {was}"] if len(executed) > 1 else []
                text = status.value + (f" with {', '.join(told)}" if told else "")
                if status is not Status.ERROR:
                    given |= {r: _SOME[kinds[n].value] for r, n in out.items() if r not in read}
                found.append((RunEnded("", status, cause, "", Executed(was), given), text))
            if len(found) > OUTCOMES:
                names = ", ".join(read.values()) or reason
                raise TooManyValues(f"a run of {place} can end with too many values of {names}")
        return found

    def different(self, name: str) -> list[Any]:
        """Return one value of each region of a name."""
        return list({self.region(name, value): value for value in self._values[name]}.values())

    def undecided(self, instruction: object) -> tuple[str, ...]:
        """Return the transitions of a conflict that neither priority nor weight decides, if the
        instruction asks for one."""
        if isinstance(instruction, Choose) and instruction.subject is Subject.CONFLICT:
            return instruction.alternatives if not any(instruction.weights) else ()
        return ()

    def next_orders(self, before: State, orders: Orders, after: State) -> Orders:
        """Return which timer elapses before which, after a stimulus.

        Of two armed timers, a elapses before b if a was armed earlier and is not longer, or if both
        were armed together and a is shorter.
        """
        old = {n for n, t in after.timers.items() if not t.elapsed and _armed(before, n) == t.key}
        new = {n for n, t in after.timers.items() if not t.elapsed} - old
        kept = {(a, b) for a, b in orders if a in old and b in old}
        if new:
            time = {n: self.task.transitions[n].after or 0.0 for n in old | new}
            kept |= {(a, b) for a in old for b in new if time[a] <= time[b]}
            kept |= {(a, b) for a in new for b in new if time[a] < time[b]}
        return frozenset(kept)


MISSING = type("Missing", (), {"__repr__": lambda _: "nothing"})()
_SOME: Mapping[str, Any] = {"bool": False, "int": 0, "float": 0.0, "str": "", "any": None}
"""Values for variables that no condition reads."""


def cases(task: Task) -> dict[str, frozenset[str]]:
    """Return the transitions of a flat task, each with the copies of it that `tries` makes, one for
    each number of used tries: it can fire if one of them can."""
    found: dict[str, set[str]] = {}
    for t in task.transitions.values():
        found.setdefault(t.copy_of, set()).add(t.name)
    return {name: frozenset(names) for name, names in found.items()}


def _armed(state: State, name: str) -> str:
    timer = state.timers.get(name)
    return "" if timer is None else timer.key


def _run_names(task: Any) -> set[str]:
    places = (p.name for p in task.places.values() if p.kind is Kind.ACTION)
    return {f"{p}.{field}" for p in places for field in RUN_FIELDS}


def literals_of(conditions: list[Any]) -> tuple[dict[str, list[Any]], set[str]]:
    """Return the literals that each name is compared with, and the names that are compared with
    other names."""
    literals: dict[str, list[Any]] = {}
    together = set[str]()
    for node in (n for c in conditions for n in walk(c.tree) if isinstance(n, Compare)):
        for side, other in ((node.left, node.right), (node.right, node.left)):
            if isinstance(side, Name) and isinstance(other, Literal):
                literals.setdefault(side.name, []).append(other.value)
            if isinstance(side, Name) and isinstance(other, Name):
                together.add(side.name)
    return literals, together
