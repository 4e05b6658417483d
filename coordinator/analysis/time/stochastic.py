"""The stochastic view of a task: its ordinary net with choices, statuses, durations and events.

The result is a GSPN (docs/analysis.md, section 4). Every place and arc of the ordinary net stays,
so leaving out the added places projects each firing sequence on one of the ordinary net. (A firing
has two steps where the engine may drop a timer or a latched event in between.) An action
place p gets, beside itself, `p.going` (a run is active) and `p.success`, `p.failure`, `p.error` (a
run has finished and waits for an outgoing transition).

A run first chooses its alternative (immediate, weight pi_a), then its status (immediate, q_as),
then takes a phase-type delay that belongs to this status (preselection). Preempting events race
with the delay. What is left of a preempted run is flushed at once; a repeated run draws again.

A place runs at most `Place.most_active` runs at once, as in the engine: where more tokens may come
together, a run takes a token of `p.server`. Where place invariants exclude that, there is none.

Where the cell is known, a token in `device d` is a run that holds the device d, and a run that has
chosen its action waits until it is free. Devices that never have to be waited for are left out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import combinations, combinations_with_replacement, permutations, product
from typing import NamedTuple

from msgspec import Struct, field

from petrobot.coordinator.analysis.net.ordinary import OrdinaryView, contended
from petrobot.coordinator.analysis.net.structure import (
    exclusive_places,
    place_bounds,
    place_semiflows,
)
from petrobot.coordinator.analysis.time.firing_order import firing_order
from petrobot.coordinator.analysis.time.gspn import Gspn
from petrobot.coordinator.analysis.time.measured import (
    DECLARED,
    FIELDS,
    MEASURED,
    Ending,
    Measured,
    NoEstimate,
    Numbers,
    OwnEnd,
    branching_places,
    is_cause,
)
from petrobot.coordinator.analysis.time.phase_type import PhaseType, fit, gamma_quantile
from petrobot.coordinator.task import (
    Counts,
    EarlyEvent,
    End,
    Estimate,
    Event,
    Executed,
    Kind,
    Place,
    Scope,
    Start,
    Status,
    Task,
    Transition,
)
from petrobot.coordinator.task.compiled_task import (
    ActionArc,
    CompiledTransition,
    compile_transitions,
)
from petrobot.coordinator.task.conditions import Compare, Expression, Literal, Name, Not, walk
from petrobot.coordinator.task.conditions.language import Scalar, as_literal, with_values
from petrobot.coordinator.task.conditions.regions import can_hold, region_values
from petrobot.coordinator.task.net import Marking, Net
from petrobot.coordinator.task.validation import condition_domains, is_pulse

FLUSH, TASK, CHOICE = 3_000_000, 1_000_000, 500_000
"""Priorities of flushing, of the task's transitions (above TASK in their order) and of choosing. As
in the engine, runs begin when no transition can fire any more; one whose token is taken before that
never began."""
SERVE, CALL = 1_500_000, 4_000_000
"""Priorities of the transitions that a pulse serves together, and of finding out which these are:
all are found in the marking in which the pulse comes."""
REST = 750_000
"""Priority of what the engine only does when nothing can fire any more, before runs begin."""
GIVING = "to give"
"""Place with a token between the moment at which a firing takes its tokens and the moment at which
it gives them, where the engine may drop a timer or a latched event in between."""
STEP = " gives"
"""What is added to the name of a firing for the moment at which it gives."""
STAGES = 8
"""Default limit of the phases of one duration. Phases of parallel runs multiply the number of
markings, so it is small."""
MANY = 32
"""Phases from which on a deadline has a distribution of its own. With 8, both fit equally well but
the variance would be too large."""

Weights = dict[str, int]


KEPT, LOST = "preempted", "lost"
"""Places `p.preempted` and `p.lost`: a run of p was preempted and counts as nothing or as SUCCESS,
or as FAILURE or ERROR."""


EndKind = tuple[str, ...]
"""What conditions ask of an ended run, beside its status: its cause, and whether it was executed,
as far as they ask."""
Told = dict[str, Scalar]
"""Values of names that a condition reads."""


class _Case(NamedTuple):
    """One way in which a transition of the task may fire: one combination of kinds of the runs that
    it takes, and of values of variables."""

    need: Weights
    """What it takes, the places of variables apart."""
    values: Weights
    """The places of the variables that it reads or writes, before the firing."""
    back: Weights
    """What it gives in the moment in which it takes: runs that stay, marks of preempted runs,
    servers, and the places of the variables after the firing."""
    give: Weights
    """Tokens of its outputs."""
    open_: bool
    """Whether its condition may still be false."""


_Shared = dict[
    tuple[Status, PhaseType, str, tuple[tuple[EndKind, float], ...]], list[tuple[str, float]]
]
"""Where a run enters the phases of a duration, with probabilities: by status, duration, device, and
how probable each kind of end is."""


def timer_key(transition: str) -> str:
    """Return the name of a timer in `StochasticView.fit_errors`."""
    return f"{transition}.after"


def _cut(counts: Counts | None) -> str:
    return LOST if counts in (Counts.FAILURE, Counts.ERROR) else KEPT


Needs = tuple[dict[int, int], dict[int, int]]
"""By place: the tokens that it must have at least, and the number that it must have less than."""


def _both(case: Needs, other: Needs) -> Needs | None:
    """Return what satisfies both; None if nothing does."""
    least, below = dict(case[0]), dict(case[1])
    for p, n in other[0].items():
        least[p] = max(n, least.get(p, 0))
    for p, n in other[1].items():
        below[p] = min(n, below.get(p, n))
    return None if any(least.get(p, 0) >= n for p, n in below.items()) else (least, below)


def _disabled(x: CompiledTransition) -> Iterator[Needs]:
    """Yield when a transition is not enabled, by the first thing that it lacks."""
    case: Needs = ({}, {})
    conditions = [(0, p, w) for p, w in x.needs] + [(1, p, n) for p, n in x.bars]
    for kind, p, n in conditions:
        holds: Needs = ({p: n}, {}) if kind == 0 else ({}, {p: n})
        lacks: Needs = ({}, {p: n}) if kind == 0 else ({p: n}, {})
        if (found := _both(case, lacks)) is not None:
            yield found
        if (after := _both(case, holds)) is None:
            return
        case = after


def _none_enabled(waiting: Sequence[CompiledTransition]) -> Iterator[Needs]:
    """Yield cases, of which no two hold together, in which none of the transitions is enabled."""
    cases: list[Needs] = [({}, {})]
    for x in waiting:
        found = (_both(case, lacks) for case in cases for lacks in _disabled(x))
        cases = [case for case in found if case is not None]
    yield from cases


def _some_enabled(waiting: Sequence[CompiledTransition]) -> Iterator[tuple[Needs, str]]:
    """Yield cases, of which no two hold together, in which some of the transitions is enabled, and
    the first that is."""
    for i, x in enumerate(waiting):
        for case in _none_enabled(waiting[:i]):
            if (found := _both(case, (dict(x.needs), dict(x.bars)))) is not None:
                yield found, x.name


class StochasticView(Struct, frozen=True, dict=True):
    """A task as a GSPN. The first places are those of the ordinary net, in its order."""

    task: Task
    gspn: Gspn
    origin: Mapping[str, str]
    """By transition of the GSPN: the transition of the task that it is a case of. Choices, delays
    and flushes are not in it."""
    statuses: Mapping[str, tuple[str, str, Status]]
    """By immediate transition that chooses a status: (place, action, status)."""
    assumptions: tuple[str, ...]
    """Assumptions where nothing was measured or declared, and approximations."""
    fit_errors: Mapping[str, float]
    """Relative error of the 90 % quantile of each fitted duration, by `place.action.status` or by
    timer."""
    begins: Mapping[str, tuple[str, str, str]] = field(default_factory=dict)
    """By immediate transition that begins a duration of a run: its name in `fit_errors`, place and
    action."""
    sources: Mapping[str, str] = field(default_factory=dict)
    """By transition of the GSPN: where its rate or weight comes from, in words. Transitions whose
    weight is 1 because the net gives them no choice are not in it."""
    spoils: frozenset[str] = frozenset()
    """Transitions of the GSPN by which a run ends that counts as FAILURE or ERROR."""
    doubts: tuple[str, ...] = ()
    """Numbers that do not measure what the view takes them for."""
    comes: Mapping[str, str] = field(default_factory=dict)
    """By timed transition that only lets an event come: the event."""
    chains: Mapping[str, str] = field(default_factory=dict)
    """By place that is a phase: the chain of equal phases that it is in."""

    def projected(self, marking: Marking) -> Marking:
        """Return the marking of the ordinary net that a marking of the GSPN projects to."""
        return marking[: len(self.task.net.places)]

    def ended(self, marking: Marking) -> Status | None:
        """Return how the mission run ends if it rests in a marking of the GSPN, by the rule of the
        engine (docs/semantics.md, section 10): SUCCESS by `final`, ERROR by `final_error`. None
        while a run is active that does not only listen, or if neither holds."""
        if any(marking[p] for p in self._busy):
            return None
        own = self.projected(marking)
        if own not in self._known:
            ends = OrdinaryView(self.task)
            given_up = Status.ERROR if ends.is_final_error(own) else None
            self._known[own] = Status.SUCCESS if ends.is_final(own) else given_up
        return self._known[own]

    @cached_property
    def _known(self) -> dict[Marking, Status | None]:
        return {}

    @cached_property
    def _busy(self) -> tuple[int, ...]:
        """Places of the GSPN that hold the active and queued runs which a mission run waits for."""
        index, places = self.gspn.net.place_index, self.task.places.values()
        return tuple(
            index[f"{p.name}.going"] for p in places if p.kind is Kind.ACTION and not p.listen
        )

    @cached_property
    def numbers(self) -> dict[str, tuple[str, ...]]:
        """By source: the actions (`place.action`), transitions and events whose numbers are its."""
        out: dict[str, dict[str, None]] = {}
        for name, (place, action, _) in self.statuses.items():
            out.setdefault(self.sources[name], {})[f"{place}.{action}"] = None
        for case, name in (*self.origin.items(), *self.comes.items()):
            if case in self.sources:
                out.setdefault(self.sources[case], {})[name] = None
        return {source: tuple(names) for source, names in out.items()}


def stochastic_view(
    task: Task,
    measured: Measured | None = None,
    *,
    stages: int = STAGES,
    timer_stages: int = STAGES,
    devices: Mapping[str, str] | None = None,
) -> StochasticView:
    """Return the GSPN of a task.

    `stages` and `timer_stages` limit the phases of one duration and of one timer. `devices` gives
    the device of each action that has one: one run at a time holds it. Raises NoEstimate, and
    ValueError for what a GSPN cannot express.
    """
    known = measured or Measured()
    return _Derivation(task.flat, known, stages, timer_stages, devices or {}).derive()


class _Parts(Struct):
    """The GSPN as it grows."""

    places: Weights
    arcs: dict[str, tuple[Weights, Weights]] = field(default_factory=dict)
    inhibit: dict[str, Weights] = field(default_factory=dict)
    priority: Weights = field(default_factory=dict)
    rates: dict[str, float] = field(default_factory=dict)
    weights: dict[str, float] = field(default_factory=dict)
    servers: dict[str, int | None] = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)

    def immediate(
        self,
        name: str,
        need: Weights,
        give: Weights,
        weight: float,
        priority: int,
        source: str = "",
    ) -> None:
        """Add a transition that takes no time."""
        self.arcs[name], self.weights[name], self.priority[name] = (need, give), weight, priority
        if source:
            self.sources[name] = source

    def timed(
        self,
        name: str,
        need: Weights,
        give: Weights,
        rate: float,
        source: str,
        servers: int | None = None,
    ) -> None:
        """Add a transition with an exponential time."""
        self.arcs[name], self.rates[name], self.servers[name] = (need, give), rate, servers
        self.sources[name] = source

    def gspn(self, task: Task) -> Gspn:
        """Return the net; the places of the task keep their capacities."""
        capacity = zip(task.net.places, task.net.capacity, strict=True)
        net = Net.build(
            self.places,
            self.arcs,
            inhibitors=self.inhibit,
            capacity={p: c for p, c in capacity if c is not None},
            priority=self.priority,
            counters=task.net.counters,
        )
        return Gspn.of(net, self.rates, weights=self.weights, servers=self.servers)


class _Derivation:
    """Builds the GSPN place by place and transition by transition."""

    def __init__(
        self,
        task: Task,
        measured: Measured,
        stages: int,
        timer_stages: int,
        devices: Mapping[str, str],
    ) -> None:
        self.task, self.measured = task, measured
        self.devices, self.contended = devices, contended(task, devices)
        self.held: dict[str, str] = {}
        """By place in which a run is active: the place of the device that it holds."""
        self.stages, self.timer_stages = stages, timer_stages
        net = task.net
        self.parts = _Parts(dict(zip(net.places, net.initial, strict=True)))
        self.origin: dict[str, str] = {}
        self.spoils: set[str] = set()
        self.statuses: dict[str, tuple[str, str, Status]] = {}
        self.numbers = Numbers(task, measured, apart=stages >= MANY)
        self.assumptions = self.numbers.assumptions
        self.errors: dict[str, float] = {}
        self.begins: dict[str, tuple[str, str, str]] = {}
        self.possible: dict[str, set[Status]] = {}
        self.comes: dict[str, str] = {}
        self.phases: dict[str, list[str]] = {}
        self.chains: dict[str, str] = {}
        self.waiting: set[str] = set()
        """Places in which a run waits for its device."""
        self.raised: dict[str, tuple[str, ...]] = {}
        """By action place: internal events of its runs that some arc waits for."""
        self.doubts: list[str] = []
        self.by: dict[tuple[str, str], str] = {}
        self.compiled = {x.name: x for x in compile_transitions(task)}
        self.ready = {x.name for x in self.compiled.values() if self.numbers.waits_ready(x)}
        """Transitions whose wait for an internal event begins when they have all else."""
        self.domains = condition_domains(task)
        self.conditions = {
            t.name: with_values(t.when, dict(task.parameters))
            for t in task.transitions.values()
            if t.when is not None
        }
        """By transition: its condition, with the values of parameters."""
        self.regions = region_values(self.conditions.values(), self.domains)
        self.kinds: dict[tuple[str, Status], list[EndKind]] = {}
        """By action place and status: the kinds of its ends."""
        self.told: dict[str, Told] = {}
        """By place of ended runs: what a condition reads of them."""
        self.values: dict[str, dict[Scalar, str]] = {}
        """By variable that only transitions set, to known values: the place of each value."""
        self._variables()
        self.droppable = [x for x in self.compiled.values() if x.after is not None]
        """Transitions with a timer, or with a latched event that the engine may drop."""
        self.timers: dict[tuple[str, frozenset[tuple[str, int]]], str] = {}
        """By transition with a timer and what it takes: the first of its cases, whose name the
        places of its timer have."""
        self.flags: set[str] = set()
        """Latched events with a place of their own, `event e`."""
        self.served: dict[str, int] = {}
        """Their priorities."""
        self.called: dict[str, str] = {}
        """By transition that waits for a pulse together with others: the place that says that the
        pulse serves it."""
        self.bounds = dict(zip(task.places, place_bounds(net), strict=True))
        """By place: the most tokens that the place invariants allow; None without a limit."""
        self.queues = frozenset(
            p.name
            for p in task.places.values()
            if p.kind is Kind.ACTION and self._may_hold(p.name, p.most_active + 1)
        )
        """Action places where a token may have to wait for a server."""
        self.switched: set[str] = set()
        """Transitions whose condition is open in some case."""
        self.turns: Weights = {}
        """By transition: of those that can fire at once, the highest fires first."""

    def derive(self) -> StochasticView:
        """Build everything, and return the view."""
        for device in sorted(self.contended):
            self.parts.places[f"device {device}"] = 0
            self.assumptions.append(
                f"{device}: if several runs wait for this device, each is as likely to be "
                "the next (they are served in the order in which they came)"
            )
        for place in self.task.places.values():
            if place.kind is Kind.ACTION:
                self._action_place(place)
        self.switched = {
            t.name
            for t in self.task.transitions.values()
            if not self.compiled[t.name].never and any(case.open_ for case in self._cases(t))
        }
        # An open condition is drawn against its competitors, so its priority, which decides only
        # where it holds, must not decide the draw.
        drawn = [
            (name, rival)
            for name in self.switched
            for rival in self._rivals(self.task.transitions[name])
        ]
        reads = {name: set(condition.names) for name, condition in self.conditions.items()}
        self.turns, rings = firing_order(list(self.compiled.values()), reads, drawn)
        self.doubts += rings
        for event in self.task.events.values():
            if event.scope is Scope.EXTERNAL:
                self._event(event)
        for transition in self.task.transitions.values():
            self._transition(transition)
        return self._view()

    def _view(self) -> StochasticView:
        assumed = tuple(dict.fromkeys(self.assumptions))
        return StochasticView(
            self.task,
            self.parts.gspn(self.task),
            self.origin,
            self.statuses,
            assumed,
            self.errors,
            self.begins,
            self.parts.sources,
            frozenset(self.spoils),
            tuple(self.doubts),
            self.comes,
            self.chains,
        )

    # Action places.

    def _action_place(self, place: Place) -> None:
        name = place.name
        self.parts.places |= {f"{name}.begin": place.tokens, f"{name}.going": place.tokens}
        if name in self.queues:
            self.parts.places[f"{name}.server"] = place.most_active
        self.possible[name], self.phases[name] = set(), []
        shared: _Shared = {}
        alternatives = self.numbers.alternatives(place)
        endings = {
            key: ends
            for status in Status
            for key, ends in self._endings(place, alternatives, status).items()
        }
        if alternatives and all(
            (name, action) in self.measured.preempted for action in alternatives
        ):
            self._causes(place, alternatives)
        self._awaited(place)
        for action, chosen in alternatives.items():
            self._choice(place, action, chosen)
            known = self.numbers.ends(place, action)
            for end, estimate in known.items():
                self._status(place, action, end, estimate, endings[action, end], shared)
            begun, device = f"{name}.{action}", self._device(action)
            if not known:  # no run ever ended by itself: it stays active until it is preempted
                self.phases[name].append(begun)
                if not self.measured.preempted.get((name, action)):
                    self._takes(begun, place, device, [begun])
            elif device:  # it may wait there
                self.phases[name].append(begun)
                self.waiting.add(begun)
        preempted = {
            _cut(a.counts)
            for t in self.task.transitions.values()
            for a in t.inputs
            if a.place == name and a.end is End.PREEMPT
        }
        if preempted and place.most_active > 1:
            raise ValueError(
                f"places.{name}: it has {place.servers} servers and a preempting transition, but a "
                "GSPN does not know which of its runs is the oldest; give the place one server for "
                "the forecast, or measure with mission runs"
            )
        for how in sorted(preempted):
            self._flush(name, how)
        self._raises(name)

    def _awaited(self, place: Place) -> None:
        """Find the internal events that arcs wait for. They are latched to the run: `p.raised e`
        while it is active, then its place says with which it ended."""
        name = place.name
        arcs = [(x.name, a) for x in self.compiled.values() for a in x.actions if a.name == name]
        events = {
            e for t, a in arcs if (name, t) not in self.by and t not in self.ready for e in a.raised
        }
        self.raised[name] = tuple(sorted(events))
        if events and place.most_active > 1:
            raise ValueError(
                f"places.{name}: it has {place.servers} servers and internal events, but a GSPN "
                "does not know which of its runs raised one; give the place one server for the "
                "forecast, or measure with mission runs"
            )
        for status in Status:
            for kind, raised in product(self.kinds[name, status], self._sets(name)):
                label = self._ended(name, status, kind, raised)
                asked = dict(zip(self._asked(place, status), kind, strict=True))
                self.parts.places[label] = 0
                self.told[label] = {f"{name}.status": str(status), **asked}
        self.parts.places |= {f"{name}.raised {e}": 0 for e in self.raised[name]}

    def _sets(self, name: str) -> list[tuple[str, ...]]:
        """Return the sets of internal events that a run of the place may have raised."""
        events = self.raised[name]
        return [s for n in range(len(events) + 1) for s in combinations(events, n)]

    def _ended(self, name: str, status: Status, kind: EndKind, raised: Iterable[str]) -> str:
        """Return the place of runs that have ended with a status and a kind of cause after they
        raised some events."""
        several = len(self.kinds[name, status]) > 1
        return " ".join([f"{name}.{status}", *(kind if several else ()), *raised])

    # Why a run ended.

    def _asked(self, place: Place, status: Status) -> list[str]:
        """Return the names by which conditions ask why a run of a place ended with a status."""
        if self.numbers.by_switches(place):
            return []
        fits = End.ERROR if status is Status.ERROR else End.NORMAL
        read = {
            name
            for x in self.compiled.values()
            for a in x.actions
            if x.name in self.conditions and a.name == place.name
            if a.takes_done or a.end is fits
            for name in self.conditions[x.name].names
        }
        return [f"{place.name}.{f}" for f in FIELDS if f"{place.name}.{f}" in read]

    def _literals(self, name: str) -> set[Scalar] | None:
        """Return what conditions compare a name with; None if other names are among it."""
        found = set[Scalar]()
        for node in (n for c in self.conditions.values() for n in walk(c.tree)):
            if isinstance(node, Compare):
                for side, other in ((node.left, node.right), (node.right, node.left)):
                    if isinstance(side, Name) and side.name == name:
                        if not isinstance(other, Literal):
                            return None
                        found.add(other.value)
        return found

    def _endings(
        self, place: Place, actions: Iterable[str], status: Status
    ) -> dict[tuple[str, OwnEnd], dict[EndKind, float]]:
        """Return how probable each kind of end with a status is, by action and end."""
        asked, reason = self._asked(place, status), f"{place.name}.reason"
        literals = self._literals(reason)
        if literals is None:  # a cause may be any text, so no finite number of kinds is enough
            asked = []
        reasons = [str(r) for r in self.regions.get(reason, [""])]
        other = next((r for r in reasons if r not in (literals or ())), "")
        executed = list(map(str, Executed if status is Status.ERROR else [Executed.YES]))

        def kind(ending: Ending) -> EndKind:
            # of causes that no condition names, one stands for all
            told = (ending[0] if ending[0] in (literals or ()) else other, ending[1])
            both = zip(FIELDS, told, strict=True)
            return tuple(value for field, value in both if f"{place.name}.{field}" in asked)

        found: dict[tuple[str, OwnEnd], dict[EndKind, float]] = {}
        examples = list(product(reasons, executed))
        for action in actions:
            ends = [end for end in self.numbers.ends(place, action) if end.status is status]
            for end in ends or [OwnEnd(status)]:
                found[action, end] = (
                    self.numbers.endings(place, action, end, examples, kind)
                    if asked and ends
                    else {kind((other, str(Executed.YES))): 1.0}
                )
        self.kinds[place.name, status] = list(dict.fromkeys(k for e in found.values() for k in e))
        return found

    # Variables.

    def _variables(self) -> None:
        """Give each value of a variable a place, where only transitions write it and all that they
        write is known: literals, parameters, and other such variables."""
        flat, first = self.task, self.task.initial_variables()
        read = {name for c in self.conditions.values() for name in c.names}
        written: dict[str, list[Expression]] = {}
        for t in flat.transitions.values():
            for name, value in t.sets:
                written.setdefault(name, []).append(with_values(value, dict(flat.parameters)))
        known = set(written) - {v for p in flat.places.values() for v in p.out.values()}
        while more := {n for n in known if any(e.names - known for e in written[n])}:
            known -= more
        values: dict[str, set[Scalar]] = {name: {first[name]} for name in known}
        grown = True
        while grown:
            before = sum(map(len, values.values()))
            for name in known:
                for e in written[name]:
                    values[name] |= values[min(e.names)] if e.names else {e.value({})}
            grown = sum(map(len, values.values())) > before
        # what a condition reads, directly or by way of another variable
        needed = read & known
        while more := {m for n in needed for e in written[n] for m in e.names} - needed:
            needed |= more
        for name in sorted(needed):
            self.values[name] = {
                v: f"{name} = {as_literal(v)}" for v in sorted(values[name], key=repr)
            }
            self.parts.places |= {
                label: int(v == first[name]) for v, label in self.values[name].items()
            }

    def _raises(self, name: str) -> None:
        """Let an active run raise each event once, after an exponential wait; what a preempted run
        has raised is forgotten."""
        active = [p for p in self.phases[name] if p not in self.waiting]
        for event in self.raised[name]:
            asks = (
                x.name
                for x in self.compiled.values()
                if any(a.name == name and event in a.raised for a in x.actions)
            )
            flag, mean = f"{name}.raised {event}", self.numbers.wait(event, next(asks, ""))
            source = self._wait_source(event)
            for phase in active:
                label = f"{name}.raises {event} in {phase}"
                self.parts.timed(label, {phase: 1}, {phase: 1, flag: 1}, 1.0 / mean, source)
                self.comes[label] = event
                self.parts.inhibit[label] = {flag: 1}
            forget = f"{name}.forgets {event}"
            self.parts.immediate(forget, {flag: 1}, {}, 1.0, FLUSH - 1)
            self.parts.inhibit[forget] = dict.fromkeys(active, 1)

    def _device(self, action: str) -> str:
        """Return the place of the device that a run may have to wait for; empty if it need not."""
        device = self.devices.get(action, "")
        return f"device {device}" if device in self.contended else ""

    def _takes(self, name: str, place: Place, device: str, active: Iterable[str]) -> None:
        """Let an immediate transition wait for the device and give it to a run of the place, which
        holds it while its token is in one of `active`."""
        if device:
            need, give = self.parts.arcs[name]
            self.parts.arcs[name] = (need, {**give, device: 1})
            self.held |= dict.fromkeys(active, device)
            if self.task.primitive_task_of(place.name).start is not Start.AT_ONCE:
                self.parts.inhibit[name] = {device: 1}

    def _causes(self, place: Place, actions: Iterable[str]) -> None:
        """Add preemption as a cause by which a run ends: a token in `p.by.t` means that t takes
        it."""
        name = place.name
        for t in self.task.transitions.values():
            if is_cause(self.task, t) and any(
                a.place == name for a in t.inputs if a.end is not None
            ):
                self.by[name, t.name] = f"{name}.by.{t.name}"
                self.parts.places[f"{name}.by.{t.name}"] = 0
                self.phases[name].append(f"{name}.by.{t.name}")
        for action in actions:
            for transition, estimate in self.measured.preempted[name, action].items():
                if estimate.share > 0 and (name, transition) in self.by:
                    self._cause(place, action, transition, estimate)

    def _cause(self, place: Place, action: str, transition: str, estimate: Estimate) -> None:
        """Add the choice of a preemption, and the phases of the time until it happens."""
        name, device = place.name, self._device(action)
        key, end = f"{name}.{action}.by.{transition}", self.by[name, transition]
        duration = self._duration(
            key, estimate.mean, (estimate.cv * estimate.mean) ** 2, self.stages
        )
        for i, branch in enumerate(duration.branches):
            stem = f"{end}.{action}{'abc'[i]}"
            chain = [f"{stem}{k}" for k in range(1, branch.stages + 1)]
            self.parts.places |= dict.fromkeys(chain, 0)
            self.chains |= dict.fromkeys(chain, stem)
            self.phases[name] += chain
            self.begins[f"{key} {i + 1}"] = (key, name, action)
            self.parts.immediate(
                f"{key} {i + 1}",
                {f"{name}.{action}": 1},
                {chain[0]: 1},
                estimate.share * branch.probability,
                CHOICE,
                self._source(name, action),
            )
            self._takes(f"{key} {i + 1}", place, device, chain)
            for phase, following in zip(chain, [*chain[1:], end], strict=True):
                source = self._source(name, action)
                need = {phase: 1} | ({device: 1} if device and following == end else {})
                self.parts.timed(phase, need, {following: 1}, branch.rate, source)

    def _source(self, place: str, action: str) -> str:
        """Return where the numbers of an action in a place come from."""
        primitive = self.task.primitive_task_of(place).name
        for key in ((place, action), (primitive, action)):
            if key in self.measured.runs:
                return self.measured.sources.get(key, MEASURED)
        return DECLARED

    def _choice(self, place: Place, action: str, chosen: float) -> None:
        name = place.name
        need = {f"{name}.begin": 1, **self._server(name)}
        self.parts.places[f"{name}.{action}"] = 0
        primitive = self.task.primitive_task_of(name)
        source = ""
        if len(primitive.alternatives) > 1:
            known = primitive.name in self.measured.choice
            source = "measured shares of the alternatives" if known else "assumed equally likely"
        self.parts.immediate(
            f"{name}.{action}", need, {f"{name}.{action}": 1}, chosen, CHOICE, source
        )

    def _status(
        self,
        place: Place,
        action: str,
        end: OwnEnd,
        estimate: Estimate,
        ends: Mapping[EndKind, float],
        shared: _Shared,
    ) -> None:
        """Add the choice of how a run ends, and the phases of its delay.

        Actions with equal distributions share their phases, which keeps the chain small.
        """
        name, status, key = place.name, end.status, f"{place.name}.{action}.{end}"
        self.possible[name].add(status)
        duration = self._duration(
            key, estimate.mean, (estimate.cv * estimate.mean) ** 2, self.stages
        )
        source, device = self._source(name, action), self._device(action)
        same = (status, duration, device, tuple(sorted(ends.items())))
        if same not in shared:
            shared[same] = self._phases(place, status, duration, len(shared), source, device, ends)
        entries = shared[same]
        for i, (entry, share) in enumerate(entries):
            label = key if len(entries) == 1 else f"{key}.{i + 1}"
            self.statuses[label], self.begins[label] = (name, action, status), (key, name, action)
            self.parts.immediate(
                label, {f"{name}.{action}": 1}, {entry: 1}, estimate.share * share, CHOICE, source
            )
            self._takes(label, place, device, ())

    def _duration(self, key: str, mean: float, variance: float, stages: int) -> PhaseType:
        if not mean > 0:
            raise NoEstimate(
                f"{key}: expected a positive mean duration, got {mean} s, although this status "
                "occurs; declare or measure one"
            )
        duration = fit(mean, variance, stages=stages)
        self.errors[key] = duration.error_at_90(gamma_quantile(mean, variance))
        return duration

    def _phases(
        self,
        place: Place,
        status: Status,
        duration: PhaseType,
        number: int,
        source: str,
        device: str,
        ends: Mapping[EndKind, float],
    ) -> list[tuple[str, float]]:
        """Add chains of phases; return the places where a run enters, with their probabilities.

        Branches of the same rate share one chain: a branch of fewer stages enters it later.
        """
        entries: list[tuple[str, float]] = []
        for j, rate in enumerate(dict.fromkeys(b.rate for b in duration.branches)):
            branches = [b for b in duration.branches if b.rate == rate]
            longest = max(b.stages for b in branches)
            stem = f"{place.name}.{status}.{number}{'abc'[j]}"
            chain = [f"{stem}{i}" for i in range(1, longest + 1)]
            self.parts.places |= dict.fromkeys(chain, 0)
            self.chains |= dict.fromkeys(chain, stem)
            self.phases[place.name] += chain
            self.held |= dict.fromkeys(chain if device else (), device)
            for i in range(1, longest):
                self.parts.timed(
                    f"{stem}{i}", {f"{stem}{i}": 1}, {f"{stem}{i + 1}": 1}, rate, source
                )
            need = {f"{stem}{longest}": 1, f"{place.name}.going": 1}
            need |= {device: 1} if device else {}
            for (kind, part), raised in product(ends.items(), self._sets(place.name)):
                words = kind if len(ends) > 1 else ()
                label = " ".join([f"{stem}{longest}", *words, *raised])
                flags = {e: f"{place.name}.raised {e}" for e in self.raised[place.name]}
                ended = self._ended(place.name, status, kind, raised)
                give = {ended: 1, **self._server(place.name)}
                self.parts.timed(
                    label, need | {flags[e]: 1 for e in raised}, give, rate * part, source
                )
                if status is not Status.SUCCESS:
                    self.spoils.add(label)
                if others := {flags[e]: 1 for e in flags if e not in raised}:
                    self.parts.inhibit[label] = others
            entries += [(f"{stem}{longest - b.stages + 1}", b.probability) for b in branches]
        return entries

    def _may_hold(self, place: str, tokens: int) -> bool:
        """Return whether the place invariants allow this number of tokens in a place."""
        bound = self.bounds[place]
        return bound is None or bound >= tokens

    def _server(self, name: str) -> Weights:
        """Return what a run of a place takes to begin and gives back when it ends."""
        return {f"{name}.server": 1} if name in self.queues else {}

    def _flush(self, name: str, how: str) -> None:
        """Remove what is left of a preempted run at once, and release its server and device. The
        active run began first, so it goes before those that have not begun."""
        taken = f"{name}.{how}"
        self.parts.places[taken] = 0
        for p in self.phases[name]:
            need = {p: 1, taken: 1} | ({self.held[p]: 1} if p in self.held else {})
            label = f"flush {p}" if how == KEPT else f"flush lost {p}"
            self.parts.immediate(label, need, self._server(name), 1.0, FLUSH)
            if how == LOST and p not in self.waiting:
                self.spoils.add(label)
        begin, label = f"{name}.begin", f"flush {name}.{how} begin"
        self.parts.immediate(label, {begin: 1, taken: 1}, {}, 1.0, FLUSH - 1)

    # External events.

    def _event(self, event: Event) -> None:
        """Give an event a place of its own where a wait of its transition after its arcs are
        satisfied would be wrong: where one occurrence concerns several transitions, or where a
        latched event may come before."""
        waiting = [
            x
            for x in self.compiled.values()
            if event.name in (x.pulse, *x.flags)
            and not x.never
            and not any((a.name, x.name) in self.by for a in x.actions)
        ]
        kept = event.early is EarlyEvent.KEEP
        before = not is_pulse(event) and any(
            kept
            or len(x.flags) + bool(x.pulse) > 1
            or any(a.takes_done or a.end in (End.NORMAL, End.ERROR) for a in x.actions)
            for x in waiting
        )
        if not waiting or not (before or self._together(waiting)):
            return
        flag, source = f"event {event.name}", self._wait_source(event.name)
        self.parts.places[flag] = 0
        cases = [(({}, {}), "")] if kept else list(_some_enabled(waiting))
        for i, (case, first) in enumerate(cases):
            rate = 1.0 / self.numbers.wait(event.name, first)
            name = f"{flag} comes" if len(cases) == 1 else f"{flag} comes {i + 1}"
            need, self.parts.inhibit[name] = self._named(case)
            self.parts.inhibit[name][flag] = 1
            self.parts.timed(name, need, {**need, flag: 1}, rate, source, 1)
            self.comes[name] = event.name
        if kept:
            self.assumptions.append(
                f"{event.name}: comes at any time, at a constant rate, whatever the task does"
            )
        if is_pulse(event):
            self._pulse(flag, waiting)
            return
        self.flags.add(event.name)
        if not kept:
            self.droppable += waiting
        barred = any(x.bars for x in waiting)
        for i, case in enumerate([] if kept else list(_none_enabled(waiting))):
            need, inhibit = self._named(case)
            name = f"{flag} dropped {i + 1}"
            if barred:
                self._drop(name, flag, need, inhibit)
                continue
            # What a firing gives cannot end the waiting, so the flag was gone before it gave.
            self.parts.immediate(name, {**need, flag: 1}, need, 1.0, FLUSH - 2)
            self.parts.inhibit[name] = inhibit

    def _drop(self, name: str, what: str, need: Weights, inhibit: Weights) -> None:
        """Take a token of a place as the engine drops a timer or a latched event that may be
        barred for a moment: between taking and giving of a firing, or when nothing can fire any
        more."""
        self.parts.places[GIVING] = 0
        tests: list[tuple[str, Weights, int]]
        tests = [("", {}, REST), (f" {GIVING}", {GIVING: 1}, FLUSH - 2)]
        for when, test, priority in tests:
            self.parts.immediate(
                name + when, {**need, what: 1, **test}, {**need, **test}, 1.0, priority
            )
            self.parts.inhibit[name + when] = inhibit

    def _pulse(self, flag: str, waiting: Sequence[CompiledTransition]) -> None:
        """Let a pulse serve each transition that is fireable when it comes, once."""
        # Weights draw among equals, else the first in the file wins; arrival decides no pulse.
        drawn = all(x.weight is not None for x in waiting)
        turns = {x.name: (self.turns[x.name], 0 if drawn else -x.index) for x in waiting}
        order = sorted(set(turns.values()))
        for x in waiting:
            self.served[x.name] = SERVE + 1 + order.index(turns[x.name])
            called = self.called[x.name] = f"{x.name}.called"
            self.parts.places[called] = 0
            for i, case in enumerate(self._cases(self.task.transitions[x.name])):
                name, test = f"{called} {i + 1}", {**case.need, **case.values, flag: 1}
                self.parts.immediate(name, test, {**test, called: 1}, 1.0, CALL)
                self.parts.inhibit[name] = {**self._named(({}, dict(x.bars)))[1], called: 1}
            self.parts.immediate(f"{called} no more", {called: 1}, {}, 1.0, SERVE)
        self.parts.immediate(f"{flag} over", {flag: 1}, {}, 1.0, CALL - 1)

    def _together(self, waiting: Sequence[CompiledTransition]) -> bool:
        """Return whether several of the transitions may be enabled together."""
        return any(
            not any(tuple(sorted((p, q))) in self.never for p, _ in x.needs for q, _ in y.needs)
            for x, y in combinations(waiting, 2)
        )

    @cached_property
    def never(self) -> set[tuple[int, int]]:
        """Pairs of places that are never marked together."""
        return exclusive_places(self.task.net, place_semiflows(self.task.net))

    def _named(self, case: Needs) -> tuple[Weights, Weights]:
        """Return the least tokens, and the inhibitors, by the names of their places."""
        places = self.task.net.places
        least, below = ({places[p]: n for p, n in part.items() if n} for part in case)
        return least, below

    # Transitions of the task.

    def _transition(self, t: Transition) -> None:
        if self.compiled[t.name].never:
            return
        for arc in self.compiled[t.name].actions:
            if t.after is not None and self._may_hold(arc.name, arc.weight + 1):
                self.doubts.append(
                    f"{t.name}: its time belongs to the first run of {arc.name} that it would "
                    "take, and the numbers do not tell the runs of a place apart"
                )
        cases = self._cases(t)
        for i, case in enumerate(cases):
            name = t.name if len(cases) == 1 else f"{t.name} {i + 1}"
            self.origin[name] = t.name
            bars = self.compiled[t.name].bars
            self.parts.inhibit[name] = self._named(({}, dict(bars)))[1]
            self._fires(t, name, case)

    def _cases(self, t: Transition) -> list[_Case]:
        """Return the ways in which a transition may fire."""
        net, x = self.task.net, self.compiled[t.name]
        plain = {net.places[p]: w for p, w in x.plain}
        give: Weights = {}
        for p, w, is_action in x.produce:
            place = net.places[p]
            give |= dict.fromkeys(
                (place, f"{place}.begin", f"{place}.going")[: 3 if is_action else 1], w
            )
        parameters = dict(self.task.parameters)
        names = set(t.when.names) if t.when is not None else set()
        names |= {n for name, value in t.sets if name in self.values for n in (name, *value.names)}
        kept = sorted(names & set(self.values))
        choices = [self.values[name].items() for name in kept]
        takings = product(*(self._takings(t, arc) for arc in x.actions))
        out = []
        for combination, chosen in product(takings, product(*choices)):
            told = dict(zip(kept, (value for value, _ in chosen), strict=True)) | parameters
            for one, _, _ in combination:
                told |= one
            may_hold, open_ = self._judged(t, told)
            if not may_hold:
                continue
            after = {n: e.value(told) for n, e in t.sets if n in self.values}
            back = Counter(
                {
                    self.values[n][after.get(n, value)]: 1
                    for n, (value, _) in zip(kept, chosen, strict=True)
                }
            )
            need = Counter(plain)
            for _, takes, returned in combination:
                need += takes
                back += returned
            values = {label: 1 for _, label in chosen}
            out.append(_Case(dict(need), values, dict(back), give, open_))
        return out

    def _takings(self, t: Transition, arc: ActionArc) -> list[tuple[Told, Weights, Weights]]:
        """Return how an arc may take its runs: (what all of them tell a condition, taken, given
        back)."""
        p, w, going = arc.name, arc.weight, f"{arc.name}.going"
        if arc.end is End.GOING:
            flags = {f"{p}.raised {e}": w for e in arc.raised}
            return [({}, {p: w, going: w, **flags}, {p: w, going: w})]
        if (p, t.name) in self.by:
            if arc.takes_done:
                self.assumptions.append(
                    f"{t.name}: that it also takes a run of {p} which has ended was not measured; "
                    "it is left out"
                )
            if _cut(arc.counts) == LOST:
                self.spoils.add(t.name)
            return [({}, {p: w, going: w, self.by[p, t.name]: w}, self._server(p))]
        kinds = [
            self._ended(p, s, kind, raised)
            for s in Status
            if s in self.possible[p]
            and (arc.takes_done or arc.end is (End.ERROR if s is Status.ERROR else End.NORMAL))
            for kind in self.kinds[p, s]
            for raised in self._sets(p)
            if set(arc.raised) <= set(raised) or t.name in self.ready
        ]
        kinds += [going] if arc.end is End.PREEMPT else []
        out: list[tuple[Told, Weights, Weights]] = []
        for chosen in combinations_with_replacement(kinds, w):
            taken = Counter(chosen)
            given = {f"{p}.{_cut(arc.counts)}": taken[going]} if taken[going] else {}
            asked = () if t.name in self.ready or not taken[going] else arc.raised
            flags = {f"{p}.raised {e}": taken[going] for e in asked}
            own = [self.told.get(label, {}) for label in chosen]
            told = dict(set(own[0].items()).intersection(*(o.items() for o in own)))
            out.append((told, {p: w, **taken, **flags}, given))
        return out

    def _judged(self, t: Transition, told: Told) -> tuple[bool, bool]:
        """Return whether the condition can be true for these values, and whether it is open: what
        else it reads decides, and may have any value. Then it becomes a random switch."""
        if t.when is None:
            return True, False
        free = t.when.names - set(told)
        false = Expression(f"not ({t.when.text})", Not(t.when.tree))
        return (
            can_hold(t.when, told, free, self.domains),
            bool(free) and can_hold(false, told, free, self.domains),
        )

    def _awaited_event(self, t: Transition) -> str:
        """Return the event for which a transition waits once its arcs are satisfied; empty if there
        is none. (Of several events all but a pulse have places of their own.)"""
        events = (self.task.events[e] for e in t.events if e not in self.flags)
        ready = t.name in self.ready
        return next((e.name for e in events if e.scope is Scope.EXTERNAL or ready), "")

    def _fires(self, t: Transition, name: str, case: _Case) -> None:
        """Add a case: it fires at once, after an exponential wait for its events, or after a
        timer."""
        priority = TASK + self.turns[t.name]
        need, give = case.need | case.values, self._given(t, name, case)
        if any((a.place, t.name) in self.by for a in t.inputs):
            self.parts.immediate(name, need, give, 1.0, priority)
            return
        if t.after is not None:
            if case.open_:
                self.assumptions.append(f"{t.name}: its condition holds when its time is over")
            self._timer(t, name, case, give, priority)
            return
        drawn = case.open_ or bool(self._rivals(t) & self.switched)
        measured = drawn and t.name in self.measured.switches
        share = self._switch(t) if measured or case.open_ else 1.0
        need |= {f"event {e}": 1 for e in t.events if e in self.flags}
        if t.name in self.called:
            self.parts.immediate(
                name, need | {self.called[t.name]: 1}, give, share, self.served[t.name]
            )
        elif event := self._awaited_event(t):
            rate = share / self.numbers.wait(event, t.name)
            self.parts.timed(name, need, give, rate, self._wait_source(event), 1)
        else:
            declared = t.weight is not None and not measured  # how often it fired contains it
            weight = t.weight if t.weight is not None and declared else share
            source = "weight declared in the task file" if declared else ""
            if measured:
                source = "measured frequency of its condition"
            self.parts.immediate(name, need, give, weight, priority, source)

    def _given(self, t: Transition, name: str, case: _Case) -> Weights:
        """Return what a case gives. Where its taking alone may drop a timer or a latched event of
        others, it gives in a second step."""
        if not self._drops(self.compiled[t.name]):
            return Counter(case.back) + Counter(case.give)
        step = f"{name}{STEP}"
        self.parts.places |= {step: 0, GIVING: 0}
        self.parts.immediate(step, {step: 1, GIVING: 1}, case.give, 1.0, FLUSH - 3)
        return {**case.back, step: 1, GIVING: 1}

    def _drops(self, fired: CompiledTransition) -> bool:
        """Return whether the engine may drop what others wait for, a timer or a latched event,
        between taking and giving of the transition."""
        taken = {p for p, _ in fired.plain} | {
            a.place for a in fired.actions if a.end is not End.GOING
        }
        given = {p for p, _, _ in fired.produce}
        both = taken & given
        others = [(x, {p for p, _ in x.needs}) for x in self.droppable if x.index != fired.index]
        # A latched event that waited for one transition does not wait on for the next one.
        handed = (
            {*x.flags} & {*y.flags} and taken & needs and given & more
            for (x, needs), (y, more) in permutations(others, 2)
        )
        return any(x.bars or both & needs for x, needs in others) or any(handed)

    def _switch(self, t: Transition) -> float:
        """Return how often an open condition is true, relative to its competitors."""
        known = self.measured.switches.get(t.name)
        if known is None:
            text = "its condition is assumed to be true as often as those it competes with"
            if self._rivals(t) & set(self.measured.switches):
                text = "its condition was never measured to be true; assumed: once in all runs"
            self.assumptions.append(f"{t.name}: {text}")
        if known is None or not t.events:
            return 1.0 if known is None else known
        # The rate of an event is multiplied by it, so it must be 1 on average.
        rivals = [u.name for u in self.task.transitions.values() if set(u.events) & set(t.events)]
        shares = [self.measured.switches[u] for u in rivals if u in self.measured.switches]
        return known * len(shares) / sum(shares)

    def _rivals(self, t: Transition) -> set[str]:
        """Return the other transitions among which the condition of a transition chooses."""
        mine = branching_places(self.task, t)
        others = (u for u in self.task.transitions.values() if u.name != t.name)
        return {u.name for u in others if mine & branching_places(self.task, u)}

    def _wait_source(self, event: str) -> str:
        if event in self.measured.waits:
            return "measured mean wait"
        declared = self.task.events[event].mean_wait is not None
        return "mean wait declared in the task file" if declared else "assumed not to wait"

    def _timer(self, t: Transition, name: str, case: _Case, give: Weights, priority: int) -> None:
        """Add a fixed delay as Erlang phases, counted by tokens in a place of its own.

        The count is reset as soon as the transition loses a token that it needs, or a place bars
        it: an inhibitor place or a full one. A condition is judged when the time is over.
        """
        assert t.after is not None
        duration = self._duration(timer_key(t.name), t.after, 0.0, self.timer_stages)
        (branch,) = duration.branches
        need = case.need
        stem = self.timers.setdefault((t.name, frozenset(need.items())), name)
        count, tick = f"{stem}.phase", f"{stem}.tick"
        ticks = branch.stages if case.values else branch.stages - 1
        source = f"declared: after {t.after:g} s"
        counted = need | ({count: ticks} if ticks else {})
        if case.values:
            self.parts.immediate(name, counted | case.values, give, 1.0, priority)
        else:
            self.parts.timed(name, counted, give, branch.rate, source, 1)
        if not ticks or stem != name:  # values of variables do not concern the timer
            return
        self.parts.places[count] = 0
        self.parts.timed(tick, need, {**need, count: 1}, branch.rate, source, 1)
        bars = self.compiled[t.name].bars
        barred = self._named(({}, dict(bars)))[1]
        self.parts.inhibit[tick] = barred | {count: ticks}
        for place, n in need.items():
            self.parts.immediate(f"{name}.reset {place}", {count: 1}, {}, 1.0, FLUSH)
            self.parts.inhibit[f"{name}.reset {place}"] = {place: n}
        for place, n in barred.items():
            self._drop(f"{name}.barred {place}", count, {place: n}, {})
