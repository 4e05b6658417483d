"""Properties of a robot task: stability, recoverability from errors (index kappa), controllability.

The paper leaves open how boundedness, properness and liveness map to these (section 7). Notation:
G are the nominal markings (no error branch active), T_c the controllable transitions (starts,
operator), T_u all others (statuses, external events).

- *Stable*: a linear Lyapunov function y.M never grows (structure), and every bottom component
  contains a marking of G (attraction).
- *Recoverable* from an error exit e, judged from every marking just after e. *Possible*: some path
  leads to G. *Almost sure*: every bottom component reachable from there contains a marking of G.
  *kappa(e)*: the largest k such that a strategy over T_c reaches G although up to k further errors
  occur. W_0 are the markings from which G is reached almost surely while no error occurs; W_k the
  same while only markings are visited whose error exits all lead into W_(k-1). *Resumed*: the run
  can still meet its goal before a new run is taken; otherwise the run is *lost*.
- *Controllable*: from every reachable marking a strategy over T_c makes each action start almost
  surely under fair T_u (observable liveness: J. Desel, A.-M. Kilinc, Observable liveness of Petri
  nets, Acta Informatica 52, 2015); and no transition of T_u leaves the legal markings (P. J.
  Ramadge, W. M. Wonham, The control of discrete event systems, Proc. IEEE 77, 1989).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from petrobot.coordinator.analysis.net.graph import Graph, Index, Mask
from petrobot.coordinator.analysis.net.qualitative import FAIRNESS, witness
from petrobot.coordinator.analysis.net.space import Space
from petrobot.coordinator.analysis.net.structure import Lyapunov, lyapunov
from petrobot.coordinator.analysis.net.verdict import PropertyVerdict, Witness
from petrobot.coordinator.task.net import Marking


@dataclass(frozen=True)
class Roles:
    """The roles of transitions and markings, by their names in the net."""

    nominal: Callable[[Marking], bool]
    """Returns whether a marking belongs to G."""
    error_exits: frozenset[str] = frozenset()
    controllable: frozenset[str] = frozenset()
    starts: Mapping[str, frozenset[str]] = field(default_factory=dict)
    """By action place: the transitions that start it."""
    run_starts: frozenset[str] = frozenset()
    """Transitions that take a new run from the runs place."""
    goals: frozenset[str] = frozenset()
    """Transitions that each stand for one met goal."""
    renewals: frozenset[str] = frozenset()
    """Transitions that close the net (refill, repair): they end a mission run and begin the
    next."""


@dataclass(frozen=True, slots=True)
class Recovery:
    """What happens after an error exit, judged over all markings just after it."""

    error_exit: str
    possible: PropertyVerdict
    almost_sure: PropertyVerdict
    kappa: int | None
    """Further errors that the task certainly survives; None: any number; -1: G may not be reached
    even without a further error."""
    resumed: bool | None
    """True: the run can still meet its goal; False: it is lost; None: the task has no runs place or
    no goal transitions."""
    strategy: tuple[str, ...]
    """The fewest firings from the marking just after the error back to the nominal flow."""


@dataclass(frozen=True)
class RobotVerdicts:
    """Stability, recoverability and controllability of one closed net."""

    stable: PropertyVerdict
    lyapunov: Lyapunov | None
    attracted: PropertyVerdict
    recoveries: tuple[Recovery, ...]
    controllable: PropertyVerdict
    unforced: tuple[str, ...]
    """Action places that cannot be forced to start from everywhere."""


def one_run_each(space: Space, places: Sequence[str]) -> PropertyVerdict:
    """Return whether no action place is entered while a run in it is active.

    Each of `places` may hold at most one token (1-safe by design).
    """
    for name in places:
        crowded = np.flatnonzero(space.tokens(space.net.place_index[name]) > 1)
        if len(crowded):
            shown = witness(space, int(crowded[0]))
            reason = (
                f"{name} is entered while its run is still active: it holds "
                f"{shown.marking[name]} tokens, but can run only once at a time"
            )
            return PropertyVerdict(False, reason, shown, complete=space.complete)
    if not space.complete:
        return PropertyVerdict(None, f"the search stopped: {space.reason}", complete=False)
    return PropertyVerdict(True, "no action place is entered while its run is active")


def all_returned(space: Space, final: Mask, resources: Sequence[str]) -> PropertyVerdict:
    """Return whether every resource place holds as many tokens at each final marking as
    initially."""
    for name in resources:
        p = space.net.place_index[name]
        began, other = (
            space.net.initial[p],
            np.flatnonzero(final & (space.tokens(p) != space.net.initial[p])),
        )
        if len(other):
            shown = witness(space, int(other[0]))
            left = shown.marking.get(name, 0)
            word = "loses" if left < began else "gains"
            reason = f"{name} {word} tokens: {began} at the beginning, {left} at the end"
            return PropertyVerdict(False, reason, shown, complete=space.complete)
    if not space.complete:
        return PropertyVerdict(None, f"the search stopped: {space.reason}", complete=False)
    return PropertyVerdict(True, "every resource has its initial number of tokens at the end")


class SpaceWithRoles:
    """A complete space with its roles as masks over markings and edges."""

    def __init__(self, space: Space, roles: Roles) -> None:
        """Compute the masks. Raises ValueError if the space is not complete: a part proves
        nothing."""
        if not space.complete:
            raise ValueError(
                "stability, recoverability and controllability need all reachable markings; the "
                f"search stopped: {space.reason}"
            )
        self.space, self.roles = space, roles
        self.graph = Graph(len(space), space.source, space.target)
        self.nominal: Mask = space.where(roles.nominal)
        self.error = self.fires(roles.error_exits)
        self.free = self.fires(roles.controllable)
        self.renewing = self.fires(roles.renewals)

    def fires(self, names: frozenset[str]) -> Mask:
        """Return which edges fire one of the transitions."""
        chosen = np.array([name in names for name in self.space.net.transitions] or [False])
        return chosen[self.space.label]

    def nested(self) -> list[Mask]:
        """Return W_0, W_1, ... until they no longer shrink. G belongs to all of them.

        W_(k+1) is contained in W_k, so equality of two neighbours ends the sequence; a marking in
        the last set survives any number of errors.
        """
        graph, calm = self.graph, ~self.error
        sets: list[Mask] = []
        allowed: Mask | None = None
        while True:
            # W_k asks for G "while no further error occurs", so the error edges are left out of the
            # graph here. Where an error would leave W_(k-1), the marking is not allowed at all.
            reaching = self._calm(calm).almost_sure(self.nominal, self.free[calm], allowed=allowed)
            if sets and np.array_equal(reaching, sets[-1]):
                return sets
            sets.append(reaching)
            allowed = np.ones(graph.n, dtype=np.bool_)
            risky = self.error & ~reaching[self.space.target]
            allowed[self.space.source[risky]] = False

    def _calm(self, kept: Mask) -> Graph:
        return Graph(self.graph.n, self.space.source[kept], self.space.target[kept])


def judge(space: Space, roles: Roles, open_space: Space | None = None) -> RobotVerdicts:
    """Return stability, recoverability of every error exit, and controllability.

    Progress is judged in `space`, that of the closed net. kappa and the Lyapunov function come from
    `open_space`, that of the net itself (by default the same). Both must be complete.
    """
    flow = SpaceWithRoles(space, roles)
    open_space = open_space or space
    alone = (
        SpaceWithRoles(open_space, replace(roles, renewals=frozenset()))
        if open_space is not space
        else flow
    )
    function = lyapunov(open_space.net)
    attracted = _attracted(flow)
    controllable, unforced = _controllable(flow)
    return RobotVerdicts(
        _stable(open_space, function, attracted),
        function,
        attracted,
        recoveries(flow, alone),
        controllable,
        unforced,
    )


def _stable(space: Space, function: Lyapunov | None, attracted: PropertyVerdict) -> PropertyVerdict:
    if attracted.holds is False:
        return attracted
    if function is not None:
        terms = " + ".join(
            f"{w} {space.net.places[p]}" if w > 1 else space.net.places[p]
            for p, w in function.weights.items()
        )
        how = "stays the same" if function.conserved else "never grows"
        return PropertyVerdict(
            True,
            f"{terms} {how}, and the nominal flow is always reached again",
            assumption=attracted.assumption,
        )
    reason = (
        "bounded from this initial marking (not from every one), and the nominal flow "
        "is always reached again"
    )
    return PropertyVerdict(True, reason, assumption=attracted.assumption)


def _attracted(flow: SpaceWithRoles) -> PropertyVerdict:
    space, components = flow.space, flow.graph.components
    met = np.zeros(len(flow.graph.bottom), dtype=np.bool_)
    met[components[flow.nominal]] = True
    lost = flow.graph.bottom & ~met
    if not lost.any():
        reason = "in the long run the task always passes through the nominal flow again and again"
        return PropertyVerdict(True, reason, assumption=FAIRNESS)
    first = int(np.argmax(lost[components]))
    reason = (
        "the task can leave its nominal flow and never return: "
        f"{space.net.describe(space.marking(first))}"
    )
    return PropertyVerdict(False, reason, witness(space, first))


def recoveries(flow: SpaceWithRoles, alone: SpaceWithRoles | None = None) -> tuple[Recovery, ...]:
    """Return the recovery of every error exit that can occur, in transition order.

    kappa and the strategy come from `alone`, the open net.
    """
    alone = alone or flow
    nested = alone.nested()
    way_back = flow.graph.backward(flow.nominal)
    caught = flow.graph.backward(_outside(flow))
    found = []
    for name in flow.space.net.transitions:
        if name in flow.roles.error_exits:
            edges = np.flatnonzero(flow.fires(frozenset({name})))
            if len(edges):
                found.append(_recovery(flow, alone, name, edges, nested, way_back, caught))
    return tuple(found)


def _outside(flow: SpaceWithRoles) -> Mask:
    """Return the markings of bottom components without a marking of G."""
    components = flow.graph.components
    met = np.zeros(len(flow.graph.bottom), dtype=np.bool_)
    met[components[flow.nominal]] = True
    outside: Mask = (flow.graph.bottom & ~met)[components]
    return outside


def _recovery(
    flow: SpaceWithRoles,
    alone: SpaceWithRoles,
    name: str,
    edges: Index,
    nested: list[Mask],
    way_back: Mask,
    caught: Mask,
) -> Recovery:
    back, sure = (
        f"after {name} the task can always return to",
        f"after {name} the task always returns to",
    )
    kappa, strategy = _kappa(alone, name, nested)
    return Recovery(
        name,
        _every(flow, edges, way_back, f"{back} the nominal flow", "no way back"),
        _every(
            flow,
            edges,
            ~caught,
            f"{sure} the nominal flow with probability 1",
            "may never return",
        ),
        kappa,
        _resumed(flow, np.unique(flow.space.target[edges]).astype(np.int64)),
        strategy,
    )


def _kappa(
    alone: SpaceWithRoles, name: str, nested: list[Mask]
) -> tuple[int | None, tuple[str, ...]]:
    """Return (kappa of an error exit, shortest path back inside the set that kappa guarantees)."""
    edges = np.flatnonzero(alone.fires(frozenset({name})))
    first = edges[alone.nominal[alone.space.source[edges]]]
    after = np.unique(alone.space.target[first if len(first) else edges])
    held = [bool(w[after].all()) for w in nested]
    kappa = None if held[-1] else held.index(False) - 1
    inside = nested[-1 if kappa is None else max(kappa, 0)]
    usable = inside[alone.space.target] & ~alone.error
    path = alone.graph.path(int(after[0]), alone.nominal, usable)
    if path is None:
        path = alone.graph.path(int(after[0]), alone.nominal) or []
    return kappa, tuple(alone.space.net.transitions[alone.space.label[e]] for e in path)


def _every(flow: SpaceWithRoles, edges: Index, good: Mask, yes: str, no: str) -> PropertyVerdict:
    bad = edges[~good[flow.space.target[edges]]]
    if not len(bad):
        return PropertyVerdict(True, yes, assumption=FAIRNESS)
    edge = int(bad[0])
    shown = _through(flow.space, edge)
    after = flow.space.net.describe(flow.space.marking(int(flow.space.target[edge])))
    return PropertyVerdict(False, f"{no} to the nominal flow from {after}", shown)


def _through(space: Space, edge: int) -> Witness:
    """Return a shortest firing sequence that ends with this edge."""
    before = space.path(int(space.source[edge]))
    marked = {
        p: n
        for p, n in zip(space.net.places, space.marking(int(space.target[edge])), strict=True)
        if n
    }
    return Witness((*before, space.net.transitions[int(space.label[edge])]), marked)


def _resumed(flow: SpaceWithRoles, after: Index) -> bool | None:
    """Return whether a goal can be met from every marking after the error, in the same run.

    That is before a new run is taken and before the mission starts again. None if the task has no
    goal transitions or no runs place.
    """
    if not flow.roles.goals or not flow.roles.run_starts:
        return None
    goal = flow.fires(flow.roles.goals)
    same_run = ~flow.fires(flow.roles.run_starts) & ~flow.renewing
    before_goal = np.zeros(flow.graph.n, dtype=np.bool_)
    before_goal[flow.space.source[goal]] = True
    return bool(flow.graph.backward(before_goal, same_run)[after].all())


def _controllable(flow: SpaceWithRoles) -> tuple[PropertyVerdict, tuple[str, ...]]:
    """Return whether every action can be forced to start from every reachable marking."""
    unforced, first = [], None
    nowhere = np.zeros(flow.graph.n, dtype=np.bool_)
    for place, starts in flow.roles.starts.items():
        winning = flow.graph.almost_sure(nowhere, flow.free, hits=flow.fires(starts))
        if not winning.all():
            unforced.append(place)
            first = first if first is not None else (place, int(np.argmin(winning)))
    if first is None:
        reason = (
            "from every reachable marking each action can be made to start by the controllable "
            "transitions (starts and operator)"
        )
        return PropertyVerdict(True, reason, assumption=FAIRNESS), ()
    place, i = first
    reason = (
        f"from {flow.space.net.describe(flow.space.marking(i))} nothing can make {place} "
        "start again"
    )
    return PropertyVerdict(False, reason, witness(flow.space, i), assumption=FAIRNESS), tuple(
        unforced
    )


def legal_exits(space: Space, roles: Roles, legal: Callable[[Marking], bool]) -> PropertyVerdict:
    """Return whether no uncontrollable transition leads from a legal to an illegal marking.

    This is controllability of the legal set in the sense of Ramadge and Wonham.
    """
    flow = SpaceWithRoles(space, roles)
    inside = space.where(legal)
    leaving = np.flatnonzero(inside[space.source] & ~inside[space.target] & ~flow.free)
    if not len(leaving):
        return PropertyVerdict(
            True,
            "only controllable transitions leave the legal markings, and these can be held back",
        )
    edge = int(leaving[0])
    name = space.net.transitions[int(space.label[edge])]
    before = space.net.describe(space.marking(int(space.source[edge])))
    return PropertyVerdict(
        False,
        f"{name} leaves the legal markings from {before} and cannot be held back",
        _through(space, edge),
    )
