"""The firing rule: whether a transition can fire, which runs it takes, and its firing."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import product
from typing import Final, NamedTuple

from petrobot.coordinator.engine.draft import Draft
from petrobot.coordinator.engine.instructions import CancelRun, DisarmTimer, Fired
from petrobot.coordinator.engine.state import ACTIVE, LIVE, Phase, Run
from petrobot.coordinator.task import Counts, End, Kind, Status, Value
from petrobot.coordinator.task.compiled_task import ActionArc, CompiledTransition
from petrobot.coordinator.task.conditions import ConditionFault
from petrobot.coordinator.task.conditions.regions import can_hold
from petrobot.coordinator.task.validation import marking_domains
from petrobot.coordinator.task.wording import Severity

DEAD_END = "dead_end"
"""Key of the report that nothing can happen any more although no final marking is reached."""
MOST_TOLD: Final = 5
"""Most transitions of which a message says what keeps them from firing."""


class Match(NamedTuple):
    """A fireable transition and the runs that it takes, by action arc."""

    transition: CompiledTransition
    runs: tuple[tuple[Run, ...], ...]


class Claims:
    """What the transitions chosen so far for one step take and give."""

    __slots__ = ("change", "flags", "raised", "runs", "sets", "used")

    def __init__(self) -> None:
        self.used: dict[int, int] = {}
        self.runs: set[str] = set()
        self.flags: set[str] = set()
        self.raised: set[tuple[str, str]] = set()
        self.change: dict[int, int] = {}
        self.sets: set[str] = set()

    def copy(self) -> Claims:
        """Return an independent copy."""
        other = Claims()
        other.used, other.change = dict(self.used), dict(self.change)
        other.runs, other.flags, other.raised = set(self.runs), set(self.flags), set(self.raised)
        other.sets = set(self.sets)
        return other

    def add(self, match: Match) -> None:
        """Add what the match takes and gives."""
        x = match.transition
        for p, w in x.plain:
            self.used[p] = self.used.get(p, 0) + w
            self.change[p] = self.change.get(p, 0) - w
        for arc, runs in zip(x.actions, match.runs, strict=True):
            self.raised.update((r.id, e) for r in runs for e in arc.raised)
            if arc.end is not End.GOING:
                self.runs.update(r.id for r in runs)
                self.change[arc.place] = self.change.get(arc.place, 0) - arc.weight
        for p, w, _ in x.produce:
            self.change[p] = self.change.get(p, 0) + w
        self.flags.update(x.flags)
        self.sets.update(name for name, _ in x.sets)


_NOTHING = Claims()  # shared by all calls, so never added to


def match(
    draft: Draft, x: CompiledTransition, pulse: str, claims: Claims = _NOTHING
) -> Match | None:
    """Return how the transition can fire beside what is claimed, with the current pulse; None if it
    cannot."""
    if (x.pulse and x.pulse != pulse) or x.never or not _marking_allows(draft, x, claims):
        return None
    for f in x.flags:
        if f not in draft.flags or f in claims.flags:
            return None
    if claims.sets and any(name in claims.sets for name, _ in x.sets):
        return None
    if x.after is not None and not ((timer := draft.timers.get(x.name)) and timer.elapsed):
        return None
    eligible = _eligible(draft, x, claims)
    if eligible is None:
        return None
    for selection in _selections(x, eligible):
        if x.when is None or _condition_holds(draft, x, selection):
            return Match(x, selection)
    return None


def arcs_satisfied(draft: Draft, x: CompiledTransition) -> tuple[Run, ...] | None:
    """Return the runs that the transition would take if its events occurred now; None if its arcs
    are not satisfied."""
    if not _marking_allows(draft, x, _NOTHING):
        return None
    eligible = _eligible(draft, x, _NOTHING, heard=False)
    if eligible is None:
        return None
    return tuple(
        r for arc, runs in zip(x.actions, eligible, strict=True) for r in runs[: arc.weight]
    )


def awaited_place(draft: Draft, x: CompiledTransition, among: Collection[int]) -> int | None:
    """Return the one place of whose tokens the transition has too few while it has all else; None
    if there is no such place among these."""
    short, marking = -1, draft.marking
    for p, w in x.needs:  # a loop: most transitions lack tokens of several places
        if marking[p] < w:
            if short >= 0 or p not in among:
                return None
            short = p
    if short < 0 or any(draft.occupied(p) >= k for p, k in x.bars):
        return None
    if any(flag not in draft.flags for flag in x.flags):
        return None
    eligible = _eligible(draft, x, _NOTHING)
    if eligible is None:
        return None
    ready = x.when is None or any(
        _condition_holds(draft, x, runs, tell=False) for runs in _selections(x, eligible)
    )
    return short if ready else None


def token_enabled(draft: Draft, x: CompiledTransition) -> bool:
    """Return whether tokens, inhibitors and capacities enable the transition; the state of its
    runs is not considered."""
    return _marking_allows(draft, x, _NOTHING)


def can_still_fire(draft: Draft, x: CompiledTransition) -> bool:
    """Return whether the transition can fire although no run is active and no timer runs: now, or
    when an external event comes or the global memory changes a variable."""
    if x.never or not _marking_allows(draft, x, _NOTHING):
        return False
    eligible = _eligible(draft, x, _NOTHING)
    if eligible is None:
        return False
    return any(_condition_can_hold(draft, x, runs) for runs in _selections(x, eligible))


def waiting_for(draft: Draft) -> str:
    """Return in words which event or variable each transition waits for that can still fire, and
    what keeps each one from firing that could take an ended run, or with no such run any that has
    some of its tokens. Journals hold a checksum of this text."""
    ended = _ended_places(draft)
    marked = {p for p, n in enumerate(draft.marking) if n}
    found = _chances(draft) + [text for _, text in _hindered(draft, ended or marked)]
    return "; ".join(found) or "no transition takes any of its tokens"


def stuck_for(draft: Draft, chances: bool) -> str:
    """Return the same more briefly, for people: also what tokens on their way wait for, and of at
    most `MOST_TOLD` transitions what keeps them from firing. Those that lack nothing but a resource
    come first: another waiting token holds it. Without `chances`, events and variables are left
    out."""
    compiled = draft.compiled
    kinds = [compiled.task.places[place].kind for place in compiled.net.places]
    marked = {p for p, n in enumerate(draft.marking) if n}
    waiting = _ended_places(draft) | {p for p in marked if kinds[p] is Kind.PLAIN}

    def nearness(lacks: list[Obstacle]) -> tuple[bool, int]:
        owned = all(o.place is not None and kinds[o.place] is Kind.RESOURCE for o in lacks)
        return not owned, len(lacks)

    hindered = sorted(_hindered(draft, waiting or marked), key=lambda found: nearness(found[0]))
    told = (_chances(draft) if chances else []) + [text for _, text in hindered[:MOST_TOLD]]
    if len(hindered) > MOST_TOLD:
        told.append(f"and {len(hindered) - MOST_TOLD} more")
    return "; ".join(told) or "no transition lacks anything, but none leads to the end"


def _ended_places(draft: Draft) -> set[int]:
    """Return the places with a run that has ended."""
    runs = (run for runs in draft.tokens.values() for run in runs)
    return {draft.compiled.action_places[r.place] for r in runs if r.phase is Phase.DONE}


def _chances(draft: Draft) -> list[str]:
    return [
        f"{x.name} waits for {in_words(draft, x)}"
        for x in draft.compiled.transitions
        if can_still_fire(draft, x)
    ]


def _hindered(draft: Draft, near: Collection[int]) -> list[tuple[list[Obstacle], str]]:
    """Return what keeps the transitions with an input among these places from firing, also in
    words."""
    return [
        (lacks, f"{x.name} {' and '.join(o.text for o in lacks)}")
        for x in draft.compiled.transitions
        if any(p in near for p, _ in x.needs) and (lacks := obstacles(draft, x))
    ]


def can_end(draft: Draft) -> bool:
    """Return whether `final`, `final_error` or the firing of a goal transition is still possible,
    whatever events, times and values come and however active runs end.

    False is a proof. A place that only transitions can fill which themselves lack a token for ever
    stays empty (a siphon; Murata 1989, section V), and a token that none of the others takes stays.
    True proves nothing: a token counts as there for all transitions at once, and each condition as
    one that may become true."""
    compiled = draft.compiled
    grows, shrinks = set[int](), set[int]()
    left = list(compiled.transitions)
    while found := [x for x in left if _possible(draft, x, grows, shrinks)]:
        left = [x for x in left if not any(x is y for y in found)]
        if any(x.name in compiled.task.goal_transitions for x in found):
            return True
        for x in found:
            grows.update(p for p, change in x.changes if change > 0)
            shrinks.update(p for p, change in x.changes if change < 0)
            grows.update(p for p, _, is_action in x.produce if is_action)  # by a run of its own
    places = compiled.net.places
    held = dict(zip(places, draft.marking, strict=True))
    free, domains = {places[p] for p in grows | shrinks}, marking_domains(compiled.task)
    ends = (compiled.task.final, compiled.task.final_error)
    return any(end is not None and can_hold(end, held, free, domains) for end in ends)


def _possible(
    draft: Draft, x: CompiledTransition, grows: Collection[int], shrinks: Collection[int]
) -> bool:
    """Return whether the transition might fire if these places could gain and lose any number of
    tokens."""
    marking = draft.marking
    if x.never or any(marking[p] < w and p not in grows for p, w in x.needs):
        return False
    if any(marking[p] >= k and p not in shrinks for p, k in x.bars):
        return False
    return all(
        arc.place in grows
        or sum(r.phase in LIVE or _fits(arc, r) for r in draft.tokens.get(arc.name, ()))
        >= arc.weight
        for arc in x.actions
    )


def in_words(draft: Draft, x: CompiledTransition) -> str:
    """Return which events, time or variable a transition that can still fire waits for."""
    events = [event for event in (x.pulse, *x.flags) if event and event not in draft.flags]
    timer = draft.timers.get(x.name)
    if x.after is not None and (timer is None or not timer.elapsed):
        events.append(f"its {x.after:g} s")
    return " and ".join(events) or f"a variable ({x.when})"


class Obstacle(NamedTuple):
    """What keeps a transition from firing, except events and time. `place` is the place that
    holds too few tokens or too many, or no run that the arc may take."""

    place: int | None
    kind: str
    """`short`, `full`, `run` (runs are there, but in another phase or with another end),
    `condition` or `event`."""
    text: str
    """What the transition does not have, to be read after its name."""


def obstacles(draft: Draft, x: CompiledTransition) -> list[Obstacle]:
    """Return what keeps the transition from firing, whatever external event comes; empty if nothing
    does."""
    places, found = draft.compiled.net.places, list[Obstacle]()
    if x.never:
        return [Obstacle(None, "event", "waits for an event that none of its inputs can raise")]
    acted = {arc.place: arc for arc in x.actions}
    for p, w in x.needs:
        if p in acted:
            continue
        if draft.marking[p] < w:
            found.append(Obstacle(p, "short", f"needs {_tokens(places[p], w, draft.marking[p])}"))
    for arc in x.actions:
        runs = eligible_runs(draft, arc, _NOTHING, heard=False)
        if len(runs) < arc.weight:
            kind = "short" if draft.marking[arc.place] < arc.weight else "run"
            found.append(Obstacle(arc.place, kind, f"needs a run of {arc.name} {_ENDED[arc.end]}"))
        elif len(eligible_runs(draft, arc, _NOTHING)) < arc.weight:
            text = f"waits for {', '.join(arc.raised)}, which no run of {arc.name} has raised"
            found.append(Obstacle(arc.place, "event", text))
    for p, k in x.bars:
        if draft.occupied(p) >= k:
            text = (
                f"is barred by {places[p]}{_room(draft, x, p, k)}, which holds {draft.occupied(p)}"
            )
            found.append(Obstacle(p, "full", text))
    if not found and not can_still_fire(draft, x):
        found.append(Obstacle(None, "condition", f"has a false condition ({x.when})"))
    return found


def _room(draft: Draft, x: CompiledTransition, place: int, threshold: int) -> str:
    """Return in words that a capacity bars the transition; empty where an inhibitor arc does."""
    capacity, gain = draft.compiled.net.capacity[place], dict(x.changes).get(place, 0)
    if capacity is None or gain <= 0 or capacity - gain + 1 != threshold:
        return ""
    return f" (capacity {capacity}, and it adds {gain})" if gain > 1 else f" (capacity {capacity})"


_ENDED = {
    End.NORMAL: "that ended in success or failure",
    End.ERROR: "that ended in error",
    End.PREEMPT: "that is active",
    End.GOING: "that is active",
}


def _tokens(place: str, wanted: int, held: int) -> str:
    if wanted == 1:
        return f"{place}, which is empty"
    return f"{wanted} of {place}, which holds {held}"


def _eligible(
    draft: Draft, x: CompiledTransition, claims: Claims, heard: bool = True
) -> list[list[Run]] | None:
    """Return the `eligible_runs` of each arc from an action place; None if an arc has too few."""
    found: list[list[Run]] = []
    for arc in x.actions:
        runs = eligible_runs(draft, arc, claims, heard)
        if len(runs) < arc.weight:
            return None
        found.append(runs)
    return found


def eligible_runs(draft: Draft, arc: ActionArc, claims: Claims, heard: bool = True) -> list[Run]:
    """Return the runs that the arc may take, in the order in which they ended or, for active ones,
    started. With `heard`, only runs that raised the events of the arc."""
    present = draft.tokens.get(arc.name)
    if not present:
        return []
    # Most runs of a crowded place wait in a queue: this leaves them out without a call.
    done, active = Phase.DONE, arc.end is End.PREEMPT or arc.end is End.GOING
    runs = [
        r
        for r in present
        if (active or r.phase is done) and _fits(arc, r) and r.id not in claims.runs
    ]
    if heard and arc.raised:
        runs = [
            r
            for r in runs
            if all(e in r.raised and (r.id, e) not in claims.raised for e in arc.raised)
        ]
    if len(runs) > 1 and arc.end in (End.NORMAL, End.ERROR):
        runs.sort(key=lambda r: r.ended)
    return runs


def fire(draft: Draft, fireable: Match, cause: str) -> None:
    """Fire: move the tokens, ask preempted runs to stop, and create new runs."""
    x, before, at = fireable.transition, draft.snapshot(), len(draft.instructions)
    for p, w in x.plain:
        draft.marking[p] -= w
        draft.touch(p)
    taken = tuple(r.id for r in _take_runs(draft, fireable))
    draft.flags.difference_update(x.flags)
    if x.name in draft.waits:
        draft.waits = {name: wait for name, wait in draft.waits.items() if name != x.name}
    _forget_lost(draft, x)
    places = draft.compiled.net.places
    for p, w, is_action in x.produce:
        draft.marking[p] += w
        draft.touch(p)
        for _ in range(w if is_action else 0):
            draft.enter(places[p], p)
    draft.firings += 1
    draft.timeless += 1
    draft.told.discard(x.name)
    draft.told.discard(DEAD_END)
    # The record comes before the orders that the firing gave, but has the marking after them.
    draft.instructions.insert(
        at, Fired(draft.firings, x.name, before, draft.snapshot(), cause, taken)
    )


def cancel(draft: Draft, run: Run, counts: Counts, reason: str) -> None:
    """Take the run's token away. A run that has started counts as stopping until it confirms that
    it has stopped."""
    draft.leave(run)
    if run.phase not in ACTIVE:
        return
    draft.stopping[run.id] = run
    draft.put(run, phase=Phase.STOPPING, counts=counts, reason=reason)
    within = draft.compiled.primitives[run.place].stop_within
    draft.emit(CancelRun(run.id, counts, reason, within))


def disarm(draft: Draft, name: str) -> None:
    """Cancel the timer of a transition."""
    timer = draft.timers.pop(name, None)
    if timer is not None and not timer.elapsed:
        draft.emit(DisarmTimer(timer.key))


def _take_runs(draft: Draft, fireable: Match) -> Iterator[Run]:
    for arc, runs in zip(fireable.transition.actions, fireable.runs, strict=True):
        # Looked up again: an earlier firing of this step may have consumed an event of the run.
        for run in (draft.find(r.id) or r for r in runs):
            if arc.end is End.GOING:
                draft.put(run, raised=run.raised.difference(arc.raised))
                continue
            draft.marking[arc.place] -= 1
            draft.touch(arc.place)
            cancel(draft, run, arc.counts, f"preempted by {fireable.transition.name}")
            yield run


def _forget_lost(draft: Draft, fired: CompiledTransition) -> None:
    """Forget timers and latched events whose transitions have lost their tokens. Called between
    taking and giving, so that a token which is taken and given back restarts its timer."""
    if draft.timers:
        disarm(draft, fired.name)
        for name in list(draft.timers):
            x = draft.compiled.transitions[draft.compiled.net.transition_index[name]]
            if arcs_satisfied(draft, x) is None:
                disarm(draft, name)
                draft.retime.add(x.index)
        if fired.after is not None:
            draft.retime.add(fired.index)
    forget_flags(draft)


def forget_flags(draft: Draft) -> None:
    """Drop latched events for which no transition waits any more, unless they are declared
    `early = "keep"`."""
    for flag in tuple(draft.flags):
        if flag not in draft.compiled.kept and not awaited(draft, flag):
            draft.flags.discard(flag)


def awaited(draft: Draft, event: str) -> bool:
    """Return whether tokens enable a transition that waits for the event."""
    compiled = draft.compiled.transitions
    return any(token_enabled(draft, compiled[t]) for t in draft.compiled.waiting.get(event, ()))


def _marking_allows(draft: Draft, x: CompiledTransition, claims: Claims) -> bool:
    marking, used = draft.marking, claims.used
    for p, w in x.needs:
        if marking[p] - used.get(p, 0) < w:
            return False
    # A bar counts runs that have not stopped yet, too: they still occupy the place.
    return not x.bars or all(draft.occupied(p) + claims.change.get(p, 0) < k for p, k in x.bars)


def _fits(arc: ActionArc, run: Run) -> bool:
    if run.phase is Phase.DONE:
        if arc.takes_done:
            return True
        return arc.end is (End.ERROR if run.status is Status.ERROR else End.NORMAL)
    return run.phase in LIVE and (arc.end is End.PREEMPT or arc.end is End.GOING)


def _selections(
    x: CompiledTransition, eligible: list[list[Run]]
) -> Iterator[tuple[tuple[Run, ...], ...]]:
    """Yield the runs to try: the first ones or, if the condition depends on the run, every
    window."""
    if not x.judges_runs:
        yield tuple(
            [tuple(runs[: arc.weight]) for arc, runs in zip(x.actions, eligible, strict=True)]
        )
        return
    windows = [
        [tuple(runs[i : i + arc.weight]) for i in range(len(runs) - arc.weight + 1)]
        for arc, runs in zip(x.actions, eligible, strict=True)
    ]
    yield from product(*windows)


def _condition_holds(
    draft: Draft, x: CompiledTransition, runs: tuple[tuple[Run, ...], ...], tell: bool = True
) -> bool:
    values = draft.variables
    if x.judges_runs:
        values = dict(values)
        for run in (r for rs in runs for r in rs if r.phase is Phase.DONE):
            values |= verdict_variables(run)
    try:
        return x.when is None or x.when.holds(values)
    except ConditionFault as fault:
        text = f"the condition of {x.name} has no truth value: {fault}; it counts as false"
        if tell:
            draft.report_once(Severity.WARNING, "condition", text, x.name)
        return False


def _condition_can_hold(
    draft: Draft, x: CompiledTransition, runs: tuple[tuple[Run, ...], ...]
) -> bool:
    if x.when is None:
        return True
    values = dict(draft.variables)
    for run in (r for rs in runs for r in rs if r.phase is Phase.DONE):
        values |= verdict_variables(run)
    return can_hold(x.when, values, draft.compiled.free, draft.compiled.domains)


def verdict_variables(run: Run) -> dict[str, Value]:
    """Return the variables that tell how a run of its place ended."""
    status = None if run.status is None else run.status.value
    verdict: dict[str, Value] = {
        f"{run.place}.status": status,
        f"{run.place}.reason": run.cause,
    }
    if run.executed is not None:
        verdict[f"{run.place}.executed"] = run.executed.value
    return verdict
