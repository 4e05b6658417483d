"""The stochastic view of a task: its ordinary net with choices, statuses, durations and events.

The result is a GSPN (docs/analysis.md, section 4). Every place and arc of the ordinary net stays,
so dropping the added places projects each firing sequence on one of the ordinary net. An action
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
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations, combinations_with_replacement, product

from petrobot.coordinator.analysis.net.structure import (
    exclusive_places,
    place_bounds,
    place_semiflows,
)
from petrobot.coordinator.analysis.time.gspn import Gspn
from petrobot.coordinator.analysis.time.phase_type import PhaseType, fit, gamma_quantile
from petrobot.coordinator.task import (
    End,
    Estimate,
    Kind,
    Place,
    Start,
    Status,
    Task,
    Transition,
)
from petrobot.coordinator.task.compiled_task import ActionArc, compile_transitions
from petrobot.coordinator.task.conditions.regions import can_hold
from petrobot.coordinator.task.net import Marking, Net
from petrobot.coordinator.task.validation import condition_domains

FLUSH, CHOICE = 3_000_000, 2_000_000
"""Priorities of flushing and choosing, far above those of the task's transitions, which are TASK
plus their own priority: choices are made before the task fires again."""
TASK = 1_000_000
STAGES = 8
"""Default limit of the phases of one duration. Phases of parallel runs multiply the number of
markings, so it is small."""

Weights = dict[str, int]
DECLARED, MEASURED = "declared in the task file", "measured"
"""Where the numbers of an action come from."""


@dataclass(frozen=True)
class Measured:
    """Numbers measured in runs. Missing ones are replaced by the estimates in the task file.

    - `runs[(place or primitive task, action)]`: share, mean (s) and cv by status.
    - `choice[primitive task][action]`: current probability of each alternative.
    - `waits[event]`: mean time (s) that a transition waits for the event.
    - `switches[transition]`: how often its condition is true, relative to the transitions that
      compete with it.
    - `preempted[(place, action)]`: share, mean (s) and cv of the runs that each transition
      preempted. If all actions of a place have it, the preempting event is one of the causes by
      which a run ends (the shares here and in `runs` sum to 1), not an independent race.
    """

    runs: Mapping[tuple[str, str], Mapping[Status, Estimate]] = field(default_factory=dict)
    choice: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    waits: Mapping[str, float] = field(default_factory=dict)
    switches: Mapping[str, float] = field(default_factory=dict)
    preempted: Mapping[tuple[str, str], Mapping[str, Estimate]] = field(default_factory=dict)
    sources: Mapping[tuple[str, str], str] = field(default_factory=dict)
    """Where the numbers in `runs` and `preempted` come from, in words, by the same keys."""


def is_cause(transition: Transition) -> bool:
    """Return whether a preemption by this transition is a cause of its own by which a run ends.

    It is one if an event or a timer takes exactly one run: then it has its own distribution of the
    time since the run began. A transition that fires as soon as its arcs allow it (another run has
    finished, a token has arrived) only cuts the run short: the net determines when.
    """
    runs = [a for a in transition.inputs if a.end is not None]
    waits = bool(transition.events) or transition.after is not None
    return waits and len(runs) == 1 and runs[0].end is End.PREEMPT


def contended(task: Task, devices: Mapping[str, str]) -> frozenset[str]:
    """Return the devices for which runs may have to wait for each other: the place invariants
    exclude neither that several runs of one place are active, nor that two places are marked
    together. `devices` gives the device of each action that has one."""
    if not devices:
        return frozenset()
    flat, net = task.flat, task.flat.net
    flows = place_semiflows(net)
    users: dict[str, list[int]] = {}
    for place, bound in zip(flat.places.values(), place_bounds(net, flows), strict=True):
        if place.kind is Kind.ACTION:
            used = {devices.get(a, "") for a in task.primitive_task_of(place.name).alternatives}
            most = place.most_active if bound is None else min(bound, place.most_active)
            for device in used - {""}:
                users.setdefault(device, []).extend([net.place_index[place.name]] * most)
    never = exclusive_places(net, flows)
    return frozenset(
        device
        for device, places in users.items()
        if any(pair not in never for pair in combinations(sorted(places), 2))
    )


class NoEstimate(ValueError):  # noqa: N818 - names what is missing
    """A number that the stochastic view needs was neither measured nor declared."""


@dataclass(frozen=True)
class Numbers:
    """What is measured or declared of a task, measured first."""

    task: Task
    measured: Measured
    assumptions: list[str] = field(default_factory=list)
    """What was assumed in the answers so far."""

    def alternatives(self, place: Place) -> dict[str, float]:
        """Return the probability of each alternative of a place."""
        primitive = self.task.primitive_task_of(place.name)
        known = self.measured.choice.get(primitive.name)
        if known is None:
            if len(primitive.alternatives) > 1:
                self.assumptions.append(
                    f"{primitive.name}: its alternatives are equally likely (no selector "
                    "state given)"
                )
            return {action: 1.0 / len(primitive.alternatives) for action in primitive.alternatives}
        return {
            action: known[action] for action in primitive.alternatives if known.get(action, 0.0) > 0
        }

    def estimates(self, place: Place, action: str) -> Mapping[Status, Estimate]:
        """Return share, mean (s) and cv by status. Raises NoEstimate."""
        primitive = self.task.primitive_task_of(place.name)
        for key in ((place.name, action), (primitive.name, action)):
            if key in self.measured.runs:
                return self.measured.runs[key]
        if not primitive.estimates:
            raise NoEstimate(
                f"primitive_tasks.{primitive.name}: the duration of {action} is unknown: it was "
                "neither measured nor declared; "
                f"add [primitive_tasks.{primitive.name}.estimates] or give measurements"
            )
        self.assumptions.append(
            f"{primitive.name}: estimates declared in the task file, not measured"
        )
        return primitive.estimates

    def wait(self, event: str) -> float:
        """Return the mean time (s) until an event comes. Raises NoEstimate."""
        mean = self.measured.waits.get(event, self.task.events[event].mean_wait)
        if mean is None:
            raise NoEstimate(
                f"events.{event}: its mean wait is unknown: neither measured nor declared; add "
                "mean_wait = SECONDS"
            )
        if event not in self.measured.waits:
            self.assumptions.append(f"{event}: mean wait declared in the task file, not measured")
        return mean


@dataclass(frozen=True)
class StochasticView:
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
    sources: Mapping[str, str] = field(default_factory=dict)
    """By transition of the GSPN: where its rate or weight comes from, in words. Transitions whose
    weight is 1 because the net gives them no choice are not in it."""

    def projected(self, marking: Marking) -> Marking:
        """Return the marking of the ordinary net that a marking of the GSPN projects to."""
        return marking[: len(self.task.net.places)]

    @cached_property
    def numbers(self) -> dict[str, tuple[str, ...]]:
        """By source: the actions (`place.action`) and transitions whose numbers come from it."""
        out: dict[str, dict[str, None]] = {}
        for name, (place, action, _) in self.statuses.items():
            out.setdefault(self.sources[name], {})[f"{place}.{action}"] = None
        for case, name in self.origin.items():
            if case in self.sources:
                out.setdefault(self.sources[case], {})[name] = None
        return {source: tuple(names) for source, names in out.items()}

    @cached_property
    def cases(self) -> dict[str, tuple[str, ...]]:
        """By transition of the task: its cases in the GSPN."""
        out: dict[str, list[str]] = {}
        for case, name in self.origin.items():
            out.setdefault(name, []).append(case)
        return {name: tuple(cases) for name, cases in out.items()}


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
    return _Derivation(task.flat, known, stages, timer_stages, devices or {}).result()


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
        self.places: Weights = dict(zip(net.places, net.initial, strict=True))
        self.arcs: dict[str, tuple[Weights, Weights]] = {}
        self.inhibit: dict[str, Weights] = {}
        self.priority: Weights = {}
        self.rates: dict[str, float] = {}
        self.weights: dict[str, float] = {}
        self.servers: dict[str, int | None] = {}
        self.origin: dict[str, str] = {}
        self.statuses: dict[str, tuple[str, str, Status]] = {}
        self.numbers = Numbers(task, measured)
        self.assumptions = self.numbers.assumptions
        self.errors: dict[str, float] = {}
        self.possible: dict[str, set[Status]] = {}
        self.sources: dict[str, str] = {}
        self.phases: dict[str, list[str]] = {}
        self.by: dict[tuple[str, str], str] = {}
        self.compiled = compile_transitions(task)
        self.domains = condition_domains(task)
        self.queues = frozenset(
            p.name
            for p, bound in zip(task.places.values(), place_bounds(net), strict=True)
            if p.kind is Kind.ACTION and (bound is None or bound > p.most_active)
        )
        """Action places where a token may have to wait for a server."""
        for device in sorted(self.contended):
            self.places[f"device {device}"] = 0
            self.assumptions.append(
                f"{device}: if several runs wait for this device, each is as likely to be "
                "the next (they are served in the order in which they came)"
            )
        for place in task.places.values():
            if place.kind is Kind.ACTION:
                self._action_place(place)
        for transition in task.transitions.values():
            self._transition(transition)

    def result(self) -> StochasticView:
        """Return the finished view."""
        capacity = {
            p: c
            for p, c in zip(self.task.net.places, self.task.net.capacity, strict=True)
            if c is not None
        }
        net = Net.build(
            self.places,
            self.arcs,
            inhibitors=self.inhibit,
            capacity=capacity,
            priority=self.priority,
        )
        gspn = Gspn.of(net, self.rates, weights=self.weights, servers=self.servers)
        assumed = tuple(dict.fromkeys(self.assumptions))
        return StochasticView(
            self.task, gspn, self.origin, self.statuses, assumed, self.errors, self.sources
        )

    # Transitions of the GSPN.

    def _immediate(
        self,
        name: str,
        need: Weights,
        give: Weights,
        weight: float,
        priority: int,
        source: str = "",
    ) -> None:
        self.arcs[name], self.weights[name], self.priority[name] = (need, give), weight, priority
        if source:
            self.sources[name] = source

    def _timed(
        self,
        name: str,
        need: Weights,
        give: Weights,
        rate: float,
        source: str,
        servers: int | None = None,
    ) -> None:
        self.arcs[name], self.rates[name], self.servers[name] = (need, give), rate, servers
        self.sources[name] = source

    # Action places.

    def _action_place(self, place: Place) -> None:
        name = place.name
        for suffix in ("begin", "going", *Status):
            self.places[f"{name}.{suffix}"] = 0
        self.places[f"{name}.begin"] = self.places[f"{name}.going"] = place.tokens
        if name in self.queues:
            self.places[f"{name}.server"] = place.most_active
        self.possible[name], self.phases[name] = set(), []
        shared: dict[tuple[Status, PhaseType, str], list[tuple[str, float]]] = {}
        alternatives = self.numbers.alternatives(place)
        if alternatives and all(
            (name, action) in self.measured.preempted for action in alternatives
        ):
            self._causes(place, alternatives)
        for action, chosen in alternatives.items():
            self._choice(place, action, chosen)
            known = {s: e for s, e in self.numbers.estimates(place, action).items() if e.share > 0}
            for status, estimate in known.items():
                self._status(place, action, status, estimate, shared)
            begun, device = f"{name}.{action}", self._device(action)
            if not known:  # no run ever ended by itself: it stays active until it is preempted
                self.phases[name].append(begun)
                if not self.measured.preempted.get((name, action)):
                    self._takes(begun, place, device, [begun])
            elif device:  # it may wait there
                self.phases[name].append(begun)
        preempted = any(
            a.place == name and a.end is End.PREEMPT
            for t in self.task.transitions.values()
            for a in t.inputs
        )
        if preempted and place.most_active > 1:
            raise ValueError(
                f"places.{name}: it has {place.servers} servers and a preempting transition, but a "
                "GSPN does not know which of its runs is the oldest; give the place one server for "
                "the forecast, or measure with mission runs"
            )
        if preempted:
            self._flush(name)

    def _device(self, action: str) -> str:
        """Return the place of the device that a run may have to wait for; empty if it need not."""
        device = self.devices.get(action, "")
        return f"device {device}" if device in self.contended else ""

    def _takes(self, name: str, place: Place, device: str, active: Iterable[str]) -> None:
        """Let an immediate transition wait for the device and give it to a run of the place, which
        holds it while its token is in one of `active`."""
        if device:
            need, give = self.arcs[name]
            self.arcs[name] = (need, {**give, device: 1})
            self.held |= dict.fromkeys(active, device)
            if self.task.primitive_task_of(place.name).start is not Start.AT_ONCE:
                self.inhibit[name] = {device: 1}

    def _causes(self, place: Place, actions: Iterable[str]) -> None:
        """Add preemption as a cause by which a run ends: a token in `p.by.t` means that t takes
        it."""
        name = place.name
        for t in self.task.transitions.values():
            if is_cause(t) and any(a.place == name for a in t.inputs if a.end is not None):
                self.by[name, t.name] = f"{name}.by.{t.name}"
                self.places[f"{name}.by.{t.name}"] = 0
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
            chain = [f"{end}.{action}{'abc'[i]}{k}" for k in range(1, branch.stages + 1)]
            self.places |= dict.fromkeys(chain, 0)
            self.phases[name] += chain
            self._immediate(
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
                self._timed(phase, need, {following: 1}, branch.rate, source)

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
        self.places[f"{name}.{action}"] = 0
        primitive = self.task.primitive_task_of(name)
        source = ""
        if len(primitive.alternatives) > 1:
            known = primitive.name in self.measured.choice
            source = "measured shares of the alternatives" if known else "assumed equally likely"
        self._immediate(f"{name}.{action}", need, {f"{name}.{action}": 1}, chosen, CHOICE, source)

    def _status(
        self,
        place: Place,
        action: str,
        status: Status,
        estimate: Estimate,
        shared: dict[tuple[Status, PhaseType, str], list[tuple[str, float]]],
    ) -> None:
        """Add the choice of a status, and the phases of its delay.

        Actions with equal distributions share their phases, which keeps the chain small.
        """
        name, key = place.name, f"{place.name}.{action}.{status}"
        self.possible[name].add(status)
        duration = self._duration(
            key, estimate.mean, (estimate.cv * estimate.mean) ** 2, self.stages
        )
        source, device = self._source(name, action), self._device(action)
        same = (status, duration, device)
        if same not in shared:
            shared[same] = self._phases(place, status, duration, len(shared), source, device)
        entries = shared[same]
        for i, (entry, share) in enumerate(entries):
            label = key if len(entries) == 1 else f"{key}.{i + 1}"
            self.statuses[label] = (name, action, status)
            self._immediate(
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
            self.places |= dict.fromkeys(chain, 0)
            self.phases[place.name] += chain
            self.held |= dict.fromkeys(chain if device else (), device)
            for i in range(1, longest):
                self._timed(f"{stem}{i}", {f"{stem}{i}": 1}, {f"{stem}{i + 1}": 1}, rate, source)
            need = {f"{stem}{longest}": 1, f"{place.name}.going": 1}
            need |= {device: 1} if device else {}
            give = {f"{place.name}.{status}": 1, **self._server(place.name)}
            self._timed(f"{stem}{longest}", need, give, rate, source)
            entries += [(f"{stem}{longest - b.stages + 1}", b.probability) for b in branches]
        return entries

    def _server(self, name: str) -> Weights:
        """Return what a run of a place takes to begin and gives back when it ends."""
        return {f"{name}.server": 1} if name in self.queues else {}

    def _flush(self, name: str) -> None:
        """Remove what is left of a preempted run at once, and release its server and device. The
        active run began first, so it goes before those that wait for a server."""
        preempted = f"{name}.preempted"
        self.places[preempted] = 0
        for p in self.phases[name]:
            need = {p: 1, preempted: 1} | ({self.held[p]: 1} if p in self.held else {})
            self._immediate(f"flush {p}", need, self._server(name), 1.0, FLUSH)
        if name in self.queues:
            begin = f"{name}.begin"
            self._immediate(f"flush {begin}", {begin: 1, preempted: 1}, {}, 1.0, FLUSH - 1)

    # Transitions of the task.

    def _transition(self, t: Transition) -> None:
        if self.compiled[self.task.net.transition_index[t.name]].never:
            return
        cases = list(self._cases(t))
        for i, (need, give) in enumerate(cases):
            name = t.name if len(cases) == 1 else f"{t.name} {i + 1}"
            self.origin[name] = t.name
            inhibit = {i.place: i.threshold for i in t.inhibitors}
            if inhibit:
                self.inhibit[name] = inhibit
            self._fires(t, name, need, give)

    def _cases(self, t: Transition) -> list[tuple[Weights, Weights]]:
        """Return what a firing takes and gives, for each combination of statuses of its runs."""
        net, index = self.task.net, self.task.net.transition_index[t.name]
        base_need = {net.places[p]: w for p, w in net.consume[index]}
        base_give = {net.places[p]: w for p, w in net.produce[index]}
        for output in t.outputs:
            if self.task.places[output.place].kind is Kind.ACTION:
                for suffix in ("begin", "going"):
                    base_give[f"{output.place}.{suffix}"] = output.weight
        out = []
        actions = self.compiled[index].actions
        for combination in product(*(self._takings(t, arc) for arc in actions)):
            taken = [(place, status) for place, status, _, _ in combination if status is not None]
            if not self._may_hold(t, dict(taken)):
                continue
            need, give = dict(base_need), dict(base_give)
            for _, _, takes, back in combination:
                need |= takes
                for place, n in back.items():
                    give[place] = give.get(place, 0) + n
            out.append((need, give))
        return out

    def _takings(
        self, t: Transition, arc: ActionArc
    ) -> list[tuple[str, Status | None, Weights, Weights]]:
        """Return how an arc may take its runs: (place, common status if any, taken, given back)."""
        p, w, going = arc.name, arc.weight, f"{arc.name}.going"
        if arc.end is End.GOING:
            return [(p, None, {going: w}, {going: w})]
        if (p, t.name) in self.by:
            if arc.takes_done:
                self.assumptions.append(
                    f"{t.name}: that it also takes a run of {p} which has ended was not measured; "
                    "it is left out"
                )
            return [(p, None, {going: w, self.by[p, t.name]: w}, self._server(p))]
        ended = [
            s
            for s in Status
            if s in self.possible[p]
            and (arc.takes_done or arc.end is (End.ERROR if s is Status.ERROR else End.NORMAL))
        ]
        kinds: list[Status | None] = [*ended, *([None] if arc.end is End.PREEMPT else [])]
        out: list[tuple[str, Status | None, Weights, Weights]] = []
        for chosen in combinations_with_replacement(kinds, w):
            taken = Counter(going if s is None else f"{p}.{s}" for s in chosen)
            given = {f"{p}.preempted": taken[going]} if taken[going] else {}
            out.append((p, chosen[0] if len(set(chosen)) == 1 else None, dict(taken), given))
        return out

    def _may_hold(self, t: Transition, status: Mapping[str, Status]) -> bool:
        """Return whether the condition can be true for these statuses.

        What else it reads may have any value: then it becomes a random switch.
        """
        if t.when is None:
            return True
        values = {f"{place}.status": str(s) for place, s in status.items()} | dict(
            self.task.parameters
        )
        return can_hold(t.when, values, t.when.names - set(values), self.domains)

    def _fires(self, t: Transition, name: str, need: Weights, give: Weights) -> None:
        """Add a case: it fires at once, after an exponential wait for its events, or after a
        timer."""
        share = self._switch(t)
        if any((a.place, t.name) in self.by for a in t.inputs):
            self._immediate(name, need, give, 1.0, TASK + t.priority)
        elif t.after is not None:
            self._timer(t, name, need, give)
        elif t.events:
            measured = all(event in self.measured.waits for event in t.events)
            source = "measured mean wait" if measured else "mean wait declared in the task file"
            self._timed(name, need, give, share / self._wait(t), source, 1)
        else:
            weight = share * (t.weight if t.weight is not None else 1.0)
            source = "weight declared in the task file" if t.weight is not None else ""
            if t.name in self.measured.switches:
                source = "measured frequency of its condition"
            self._immediate(name, need, give, weight, TASK + t.priority, source)

    def _switch(self, t: Transition) -> float:
        """Return how often a condition on variables is true, relative to its competitors."""
        if t.when is None or all(n.endswith((".status", ".reason")) for n in t.when.names):
            return 1.0
        known = self.measured.switches.get(t.name)
        if known is None:
            self.assumptions.append(
                f"{t.name}: its condition is assumed to be true as often as those it competes with"
            )
        return 1.0 if known is None else known

    def _wait(self, t: Transition) -> float:
        """Return the mean time (s) until all events of a transition have occurred.

        The mean of the maximum of independent exponentials, by inclusion and exclusion over all
        non-empty subsets: E[max] = sum of (-1)^(size + 1) / (sum of the rates in the subset).
        """
        means = [self.numbers.wait(event) for event in t.events]
        if len(means) > 1:
            self.assumptions.append(
                f"{t.name}: the wait for all its events is approximated by one exponential"
            )
        whole = 0.0
        for chosen in range(1, 1 << len(means)):
            rate = sum(1 / m for i, m in enumerate(means) if chosen >> i & 1)
            whole += (-1) ** (chosen.bit_count() + 1) / rate
        return whole

    def _timer(self, t: Transition, name: str, need: Weights, give: Weights) -> None:
        """Add a fixed delay as Erlang phases, counted by tokens in a place of its own.

        The count is reset as soon as the transition is disabled: an immediate transition empties it
        when a needed token is missing or an inhibitor place is marked.
        """
        assert t.after is not None
        duration = self._duration(f"{t.name}.after", t.after, 0.0, self.timer_stages)
        (branch,) = duration.branches
        count, last = f"{name}.phase", branch.stages - 1
        source = f"declared: after {t.after:g} s"
        self._timed(name, need | ({count: last} if last else {}), give, branch.rate, source, 1)
        if not last:
            return
        self.places[count] = 0
        tick = f"{name}.tick"
        self._timed(tick, dict(need), {**need, count: 1}, branch.rate, source, 1)
        self.inhibit[tick] = {i.place: i.threshold for i in t.inhibitors} | {count: last}
        for place, n in need.items():
            self._immediate(f"{name}.reset {place}", {count: 1}, {}, 1.0, FLUSH)
            self.inhibit[f"{name}.reset {place}"] = {place: n}
        for i in t.inhibitors:
            back = {i.place: i.threshold}
            self._immediate(f"{name}.barred {i.place}", {count: 1, **back}, back, 1.0, FLUSH)
