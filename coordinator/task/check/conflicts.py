"""Conflicts found on the structure: which pairs of transitions can compete for a token, and what
decides between them.

Two transitions compete when one stimulus, or what had come before it, can make both fireable for
the same token. So what can come *last* before each can fire is compared: a pulse can only come
last; a latched event that is dropped when nothing waits comes after the tokens; a timer runs only
once the arcs are satisfied. If nothing can come last for both, they never become fireable together
and arrival order decides.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import combinations
from math import gcd

from petrobot.coordinator.task import EarlyEvent, End, Input, Kind, Scope, Task, Transition
from petrobot.coordinator.task.check.findings import Finding
from petrobot.coordinator.task.conditions.regions import Certainty, Domain, exclusive
from petrobot.coordinator.task.net import Net
from petrobot.coordinator.task.validation import condition_domains, is_pulse
from petrobot.coordinator.task.wording import Severity

# Pairs of transitions that invariants keep from being enabled together.

ROWS = 2000
Flow = dict[int, int]
"""Weights by place index."""


def semiflows(task: Task) -> tuple[Flow, ...]:
    """Return weights of places, without control places, whose weighted sum of tokens never grows;
    empty if there are none, or too many to compute here.

    They are P-semiflows, in which a control place may stand that no transition empties: what the
    operator adds to it comes nowhere else, so without it the sum can only fall.
    """
    net = task.net
    control = {i for i, p in enumerate(task.places.values()) if p.kind is Kind.CONTROL}
    taken = {p for changes in net.compiled.changes for p, change in changes if change < 0}
    places = [i for i in range(len(net.places)) if i not in control & taken]
    rows: list[tuple[Flow, dict[int, int]]] = [({p: 1}, _effects(net, p)) for p in places]
    for t in range(len(net.transitions)):
        rest = [r for r in rows if not r[1].get(t)]
        gain = [r for r in rows if r[1].get(t, 0) > 0]
        loss = [r for r in rows if r[1].get(t, 0) < 0]
        if len(rest) + len(gain) * len(loss) > ROWS:
            return ()
        rows = _minimal(rest + [_combine(a, b, t) for a in gain for b in loss])
    return tuple({p: w for p, w in flow.items() if p not in control} for flow, _ in rows)


def never_together(net: Net, flows: tuple[Flow, ...], t: int, u: int) -> bool:
    """Whether some semiflow shows that no reachable marking enables both transitions."""
    need = dict(net.compiled.needs[t])
    for p, w in net.compiled.needs[u]:
        need[p] = max(w, need.get(p, 0))
    return any(
        sum(y * need.get(p, 0) for p, y in flow.items())
        > sum(y * net.initial[p] for p, y in flow.items())
        for flow in flows
    )


def _effects(net: Net, place: int) -> dict[int, int]:
    """Net gain of the place by transition, zeros left out."""
    return {
        t: change
        for t, changes in enumerate(net.compiled.changes)
        for p, change in changes
        if p == place
    }


def _combine(
    a: tuple[Flow, dict[int, int]], b: tuple[Flow, dict[int, int]], t: int
) -> tuple[Flow, dict[int, int]]:
    """Return the positive combination of a row that gains by t and one that loses by t, in which
    t cancels out."""
    x, y = -b[1][t], a[1][t]
    flow = _sum(a[0], x, b[0], y)
    effect = _sum(a[1], x, b[1], y)
    divisor = gcd(*flow.values(), *effect.values())
    return {p: w // divisor for p, w in flow.items()}, {s: w // divisor for s, w in effect.items()}


def _sum(a: dict[int, int], x: int, b: dict[int, int], y: int) -> dict[int, int]:
    total = {k: x * a.get(k, 0) + y * b.get(k, 0) for k in {*a, *b}}
    return {k: v for k, v in total.items() if v}


def _minimal(rows: list[tuple[Flow, dict[int, int]]]) -> list[tuple[Flow, dict[int, int]]]:
    """Return the rows whose support contains the support of no other row."""
    kept: list[tuple[Flow, dict[int, int]]] = []
    # A support that lies in another one has its least place there: few are left to compare.
    by_least: dict[int, list[Flow]] = {}
    for row in sorted(rows, key=lambda r: len(r[0])):
        flow = row[0]
        if not any(o.keys() <= flow.keys() for p in flow for o in by_least.get(p, ())):
            kept.append(row)
            by_least.setdefault(min(flow), []).append(flow)
    return kept


MARKING = ("marking", "")
_LIVE_ENDS = (End.PREEMPT, End.GOING)
Trigger = tuple[str, str]


def conflicts(task: Task) -> Iterator[Finding]:
    """Find conflicts that the arcs suggest: those that the task does not decide (warnings), and
    those that the order of arrival decides (notes). The execution graph shows whether any of them
    can occur."""
    domains, flows, net = condition_domains(task), semiflows(task), task.net
    for t, u in _near(task):
        shared = sorted(_shared(task, t, u))
        if not shared or excluded(task, t, u) or excluded(task, u, t):
            continue
        if not never_together(
            net, flows, net.transition_index[t.name], net.transition_index[u.name]
        ):
            yield from _judge(task, t, u, shared, domains)


def _near(task: Task) -> Iterator[tuple[Transition, Transition]]:
    """Yield the pairs that can share something (`_shared`), in order: in a large task few do."""
    transitions, groups = list(task.transitions.values()), dict[str, list[int]]()
    for i, t in enumerate(transitions):
        bars = {"inhibitors"} if t.inhibitors else set[str]()
        for key in {a.place for a in t.inputs} | {*t.events} | _room(task, t) | bars:
            groups.setdefault(key, []).append(i)
    for i, k in sorted({pair for group in groups.values() for pair in combinations(group, 2)}):
        yield transitions[i], transitions[k]


def _judge(
    task: Task, t: Transition, u: Transition, shared: list[str], domains: dict[str, Domain]
) -> Iterator[Finding]:
    verdict = exclusive([t.when, u.when], domains)
    if verdict.answer is Certainty.PROVED:
        return
    key, over = f"transitions.{t.name}", " and ".join(shared)
    if _elapse_together(t, u):
        text = (
            f"{t.name} and {u.name} wait for the same {t.after:g} s: {t.name}, the first in the "
            f"file, always takes {over}; priority and weight do not count"
        )
        yield Finding(Severity.WARNING, "equal-timers", key, text, "give them different times")
        return
    if not last_triggers(task, t) & last_triggers(task, u):
        text = (
            f"{t.name} and {u.name} compete for {over}: whichever becomes fireable first takes it"
        )
        yield Finding(Severity.NOTE, "arrival-order", key, text)
        return
    if (
        t.priority != u.priority
        or (t.weight is not None and u.weight is not None)
        or _preempts(t) != _preempts(u)
    ):
        return
    unsure = (
        " (it is not known whether their conditions exclude each other)"
        if verdict.answer is Certainty.UNKNOWN
        else ""
    )
    text = (
        f"{t.name} and {u.name} may both want the last token of {over}, and the task does not say "
        f"which one gets it{unsure}{idle_weights((t, u))}"
    )
    remedy = "give one a higher `priority`, each a `weight`, or exclusive conditions"
    yield Finding(Severity.WARNING, "unsettled-conflict", key, text, remedy, verdict.witness)


def idle_weights(rivals: Iterable[Transition]) -> str:
    """Return that the weights of some rivals do not count, as the others have none; else empty."""
    by_weight: dict[bool, list[str]] = {True: [], False: []}
    for t in rivals:
        by_weight[t.weight is not None].append(t.name)
    if not all(by_weight.values()):
        return ""
    some, none = (" and ".join(by_weight[has]) for has in (True, False))
    return f" (the weight of {some} does not count: {none} has none)"


def _elapse_together(t: Transition, u: Transition) -> bool:
    """Whether two timers begin together and take the same time. The first in the file then fires
    before the other one has elapsed."""
    bare = not (t.events or u.events or t.when or u.when or t.inhibitors or u.inhibitors)
    return bare and t.after is not None and t.after == u.after and t.inputs == u.inputs


def _shared(task: Task, t: Transition, u: Transition) -> set[str]:
    """Return what both take: tokens of a place, latched events, raised events, room."""
    shared = {
        a.place
        for a in t.inputs
        for b in u.inputs
        if a.place == b.place and _same_token(t, a, u, b)
    }
    shared -= lent(task, t, u)
    common = [task.events[e] for e in t.events if e in u.events]
    events = {f"the event {e.name}" for e in common if not is_pulse(e)}
    return shared | events | _mutual_bars(t, u) | (_room(task, t) & _room(task, u))


def lent(task: Task, t: Transition, u: Transition) -> set[str]:
    """Return the places to which both give back what they take, so that the second fires just after
    the first; none if the first could keep it from that in another way."""
    for one, other in ((t, u), (u, t)):
        waits = [task.events[e] for e in other.events]
        if any(is_pulse(e) or _holds_until_fired(task, e.name) for e in waits):
            return set()  # the event is lost between the two firings
        if {o.place for o in one.outputs} & {i.place for i in other.inhibitors}:
            return set()
        if other.when is not None and other.when.names & {name for name, _ in one.sets}:
            return set()
    return _given_back(t) & _given_back(u)


def _given_back(t: Transition) -> set[str]:
    given = {o.place: o.weight for o in t.outputs}
    return {a.place for a in t.inputs if a.end is None and a.weight <= given.get(a.place, 0)}


def _room(task: Task, t: Transition) -> set[str]:
    """Return the places of limited capacity that the transition fills."""
    net = task.net
    return {
        f"room in {net.places[p]}"
        for p, change in net.compiled.changes[net.transition_index[t.name]]
        if change > 0 and net.capacity[p] is not None
    }


def _same_token(t: Transition, a: Input, u: Transition, b: Input) -> bool:
    """Whether the two arcs from one place can ask for the same token."""
    if End.GOING in (a.end, b.end):
        return False
    if a.end == b.end:
        return True
    return (a.end is End.PREEMPT and t.priority > u.priority) or (
        b.end is End.PREEMPT and u.priority > t.priority
    )


def _mutual_bars(t: Transition, u: Transition) -> set[str]:
    """Return the inhibitor arcs by which each transition bars the other."""
    one = {i.place for i in u.inhibitors} & {o.place for o in t.outputs}
    other = {i.place for i in t.inhibitors} & {o.place for o in u.outputs}
    return {f"the way past {p}" for p in one | other} if one and other else set()


def excluded(task: Task, t: Transition, u: Transition) -> bool:
    """Whether tokens alone exclude that both are fireable: they need one run in two states, or an
    inhibitor arc separates them."""
    limits = {i.place: i.threshold for i in t.inhibitors}
    if any(b.weight >= limits[b.place] for b in u.inputs if b.place in limits):
        return True
    for a in t.inputs:
        for b in u.inputs:
            single = (
                a.place == b.place and a.end is not None and task.places[a.place].servers is None
            )
            if single and _state(a) != _state(b) and not _same_token(t, a, u, b):
                return True
    return False


def _state(arc: Input) -> str:
    """Return the state of the run that the arc requires."""
    return "live" if arc.end in _LIVE_ENDS else str(arc.end)


def _preempts(t: Transition) -> bool:
    """Whether the engine ranks it as a preemption: the end of a run has precedence over its
    preemption, unless a weight is declared."""
    return t.weight is None and any(a.end is End.PREEMPT for a in t.inputs)


def last_triggers(task: Task, t: Transition) -> set[Trigger]:
    """Return what can be the last condition to become true before the transition can fire."""
    pulses = {("event", e) for e in t.events if is_pulse(task.events[e])}
    if pulses:
        return pulses
    variables = {("variable", n) for n in t.when.names} if t.when is not None else set()
    if t.after is not None:
        return {("timer", t.name)} | variables
    ends = {("end", a.place) for a in t.inputs if a.end in (End.NORMAL, End.ERROR)}
    events = {("event", e) for e in t.events}
    if any(_holds_until_fired(task, e) for e in t.events):
        return events | ends | variables
    if (
        events
        and all(task.events[e].scope is Scope.INTERNAL for e in t.events)
        and len(t.inputs) == 1
    ):
        return events | ends | variables
    others = {MARKING} if len(t.inputs) > len(ends) or t.inhibitors or not t.inputs else set()
    return events | ends | variables | others


def _holds_until_fired(task: Task, event: str) -> bool:
    """Whether the event's flag can be set only when a transition that waits for it has all its
    tokens."""
    e = task.events[event]
    return e.scope is Scope.EXTERNAL and not is_pulse(e) and e.early is EarlyEvent.DROP
