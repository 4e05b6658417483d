"""Verdicts of progress, judged on the execution graph: whether a task can get stuck, can always
reach its end, and recovers from its errors.

Notation: an *end* is a state in which the engine has finished with `final` or `final_error`; a
*dead end* is a state that is not an end and from which neither a firing nor an end can be reached.
G are the nominal states: no place of an error branch is marked. A task ends, so live, proper,
stable and controllable are judged with an edge from each `final` state to the first state. A
`final_error` state keeps its marking: only `mended` adds edges from there too, on the assumption
that the operator repairs what is left.

Recovery from an error exit is judged on the graph as it is, from the firings of the exit in a
nominal state, and G absorbs. *Possible*: G can be reached from every state just after the exit.
*Sure*: no state from which G is lost can be reached. *kappa*: the largest number of further errors
after which G is still reached for certain. The probability of the way back and its mean time come
from the graph as a Markov chain (`chain.py`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from petrobot.coordinator.analysis.execution.causes import (
    awaiting,
    describe,
    explain,
    fate,
    left_over,
    most_tokens,
    obstacle_text,
    settled,
)
from petrobot.coordinator.analysis.execution.chain import ExecutionChain, TooLarge, chain_of
from petrobot.coordinator.analysis.execution.graph import (
    ExecutionGraph,
    Shared,
    Step,
    execute,
    with_operator,
)
from petrobot.coordinator.analysis.execution.names import cases
from petrobot.coordinator.analysis.limits import OUT_OF_MEMORY, OutOfTime, overtime
from petrobot.coordinator.analysis.net.graph import Graph, Mask
from petrobot.coordinator.analysis.net.ordinary import OrdinaryView
from petrobot.coordinator.analysis.net.qualitative import FAIR
from petrobot.coordinator.analysis.net.verdict import PropertyVerdict, Witness
from petrobot.coordinator.analysis.time.measured import Measured, NoEstimate
from petrobot.coordinator.engine import (
    AddTokens,
    Begin,
    Engine,
    EventOccurred,
    Phase,
    Policy,
    RemoveTokens,
    State,
)
from petrobot.coordinator.engine.step import at_end
from petrobot.coordinator.task import Kind, Value
from petrobot.coordinator.task.compiled_task import CompiledTransition
from petrobot.coordinator.task.conditions import ConditionFault
from petrobot.coordinator.task.conditions.language import as_literal
from petrobot.coordinator.task.net import Arcs
from petrobot.coordinator.task.wording import few

MENDED = "the operator repairs what `final_error` leaves and starts the task again"
AGAIN = {
    "live": "from every state every transition can fire again",
    "proper": "the next mission can begin from every state",
    "stable": "the nominal flow is always reached again",
    "controllable": "from every state each action can start again",
}
"""The verdicts from mission to mission, and what they say where they hold."""
NEXT = "the next mission begins"
NAMES = (
    "deadlock_free",
    "quasi_live",
    "live",
    "proper",
    "one_run_each",
    "returned",
    "sound",
    "stable",
    "controllable",
)
"""The verdicts that are judged here."""
GROUPS = 20
"""The most dead ends that are described one by one."""
EXAMINED = 1_000
"""The most dead-end states that are followed to where they stop; the nearest come first."""


class Recovery(Struct, frozen=True):
    """What happens after an error exit, judged over all states just after it."""

    error_exit: str
    possible: PropertyVerdict
    almost_sure: PropertyVerdict
    kappa: int | None
    """Further errors that the task certainly survives; None: any number; -1: G may not be reached
    even without a further error."""
    lost: tuple[int, int] | None
    """The fewest and the most goals that could be met just before the error and not after it; None:
    the task has no goal transitions, or meets its goal again and again."""
    strategy: tuple[str, ...]
    """The fewest firings from a state just after the error back to the nominal flow; empty if there
    is no such path."""
    alone: bool = True
    """Whether it can fire in the nominal flow; False: only while another error is handled."""
    cause: str = ""
    """The cause of the error (`'lost'`) if the verdicts differ between causes; else empty."""

    @property
    def name(self) -> str:
        """The error exit, with the cause where it matters."""
        return f"{self.error_exit} ({self.cause})" if self.cause else self.error_exit

    @property
    def verdicts(self) -> tuple[bool | None, bool | None, int | None]:
        """Possible, sure, and kappa."""
        return self.possible.holds, self.almost_sure.holds, self.kappa


class Odds(Struct, frozen=True):
    """Probability and mean time of the return to the nominal flow, for each error exit."""

    by_exit: Mapping[str, tuple[float, float]]
    """By `Recovery.name`: probability of returning, and mean time (s) given a return (nan if there
    is none). Exits that fire with probability 0 are left out."""
    stages: int
    """The most phases by which a duration is approximated."""
    assumptions: tuple[str, ...] = ()
    missing: str = ""
    """Why there are no numbers; empty if there are."""


class Contest(Struct, frozen=True):
    """A conflict that neither priority nor weight decides: first come, first served."""

    transitions: tuple[str, ...]
    """In the order of the file, which decides a tie."""
    over: tuple[str, ...]
    """The places whose token they compete for."""
    matters: Mapping[str, str]
    """The verdicts that would not hold if another fired, with their reasons."""


class DeadEnd(Struct, frozen=True):
    """Dead ends with the same marked places: how many, and the nearest with its cause."""

    count: int
    verdict: PropertyVerdict
    """That nothing can happen any more there, with the reason and a path."""

    @property
    def witness(self) -> Witness:
        """The path to the nearest."""
        assert self.verdict.witness is not None
        return self.verdict.witness


class Progress(Struct, frozen=True, dict=True):
    """The verdicts on an execution graph. If the graph is not complete, a verdict is either refuted
    by what was found or unknown."""

    x: ExecutionGraph
    view: OrdinaryView
    measured: Measured | None = None
    """Numbers for `odds`; None: those that the task declares."""
    free: Progress | None = None
    """Progress of the execution graph in which any transition may win a conflict that neither
    priority nor weight decides; None if there is no such conflict."""

    @cached_property
    def contests(self) -> tuple[Contest, ...]:
        """The conflicts that neither priority nor weight decides."""
        if self.free is None:
            return ()
        named = {t.name: t for t in self.x.engine.compiled.transitions}
        ours, theirs = self.verdicts(), self.free.verdicts()
        matters = {
            name: theirs[name].reason
            for name in NAMES
            if ours[name].holds and not theirs[name].holds
        }
        order = sorted(self.free.x.contests, key=lambda names: [named[n].index for n in names])
        return tuple(Contest(rivals, self._over(rivals), matters) for rivals in order)

    def _over(self, rivals: Sequence[str]) -> tuple[str, ...]:
        """Return the places and events for which the transitions compete."""
        compiled = self.x.engine.compiled
        wanting = [compiled.transitions[compiled.net.transition_index[name]] for name in rivals]
        shared = set.intersection(*({p for p, _ in t.needs} for t in wanting))
        places = {compiled.net.places[p] for p in shared or {p for p, _ in wanting[0].bars}}
        return tuple(sorted(places | set.intersection(*(set(t.flags) for t in wanting))))

    # --- what the operator's tokens make possible -----------------------------------------------

    def by_hand(self, limit: int) -> list[PropertyVerdict]:
        """Return the dead ends and conflicts that need tokens which the operator moves, from a
        second graph within a limit in stimuli and firings; a verdict that is unknown if the limit
        was reached before one was found. Empty for a task that gets stuck even without the
        operator."""
        own = self.x if self.free is None else self.free.x
        if overtime() or not own.complete or own.dead.any() or own.livelocks:
            return []
        x = with_operator(own, limit=limit)
        found = [
            PropertyVerdict(False, contend(rivals, self._over(rivals)), _witness(x, state))
            for rivals, state in x.contests.items()
            if rivals not in own.contests
        ]
        # One dead end per set of commands and places: the operator controls the control places.
        stuck: dict[tuple[str, ...], int] = {}
        control = {p.name for p in own.names.task.places.values() if p.kind is Kind.CONTROL}
        for i in sorted({settled(x, int(i)) for i in np.flatnonzero(x.dead)[:EXAMINED]}):
            if i >= len(own):
                commands = [
                    s.text for s in x.path(i) if isinstance(s.stimulus, (AddTokens, RemoveTokens))
                ]
                stuck.setdefault((*commands, *(p for p in x.marked(i) if p not in control)), i)
        found += [_stuck(x, i) for i in list(stuck.values())[:GROUPS]]
        if not found and not x.complete:
            text = f"nothing found in {x.expanded.sum()} states; the search was not completed"
            found = [PropertyVerdict(None, text, complete=False)]
        return found

    # --- stuck, or active for ever ----------------------------------------------------------

    @cached_property
    def dead_ends(self) -> tuple[DeadEnd, ...]:
        """Dead ends by marked places, nearest first."""
        groups: dict[tuple[str, ...], list[int]] = {}
        x = self.x
        stuck = {settled(x, int(i)) for i in np.flatnonzero(x.dead)[:EXAMINED]}
        for i in sorted(stuck.difference(x.livelocks)):
            groups.setdefault(tuple(x.marked(i)), []).append(i)
        return tuple(
            DeadEnd(len(members), _stuck(x, members[0]))
            for members in list(groups.values())[:GROUPS]
        )

    @cached_property
    def deadlock_free(self) -> PropertyVerdict:
        """No dead end and no endless firing can be reached."""
        for state in self.x.livelocks:
            names = sorted(set(self.x.firings(state)[-20:]))
            reason = f"{', '.join(names)} can fire for ever without time passing"
            return self._no(reason, state)
        for end in self.dead_ends:
            return end.verdict
        return self._yes("no state is a dead end")

    @cached_property
    def sound(self) -> PropertyVerdict:
        """From everywhere `final` can be reached, or the task can give up without a further error.

        Giving up after an error that is yet to come does not count: that error may belong to a
        branch that has nothing to do with what is stuck, and never comes if all goes well. Nor does
        a stop button that could be pressed all the time.
        """
        x = self.x
        if overtime():
            return self._unknown("")
        final, tired = x.engine.compiled.task.final, x.graph.backward(x.given_up)
        calm = x.of_edges(~x.fails & ~x.firing(self._stops))
        hopeless = f"the task can only give up: it never comes to {final}"
        only_gives_up = x.complete and not x.final.any() and tired.all()
        ends = calm.backward(x.given_up | ~x.expanded)
        lost = np.flatnonzero(~(x.graph.backward(x.final | ~(x.expanded | x.spoiled)) | ends))
        if not len(lost) and only_gives_up:
            return self._no(hopeless, int(np.flatnonzero(x.given_up)[0]))
        if not len(lost):
            return self._yes("an end can be reached from every state")
        first = int(lost[0])
        reason = f"from {left_over(x, first)} no designed end can be reached"
        reason += " without a further error or a stop" * bool(tired[first])
        if x.dead.any() or x.livelocks:  # told by the verdict on deadlocks
            return self._no(reason, first)
        # Without a further error or a stop, a lost state leads to lost states only.
        parts = calm.components
        last = lost[calm.bottom[parts[lost]]]
        inside = parts == parts[last[0]]
        state = min(np.flatnonzero(inside).tolist(), key=lambda i: (_active(x.states[i]), i))
        steps = np.unique(x.label[inside[x.source] & inside[x.target] & ~x.fails]).tolist()
        still = {name for n in steps for name in x.steps[n].firings}
        why = explain(x, state, still | self._stops)
        if why.short:
            first, reason = state, f"stuck with {left_over(x, state)}: {why.short}"
            goes_on = f"meanwhile {few(sorted(still))} can fire for ever"
        else:
            reason = hopeless if only_gives_up else reason
            goes_on = f"the task can continue for ever, but never reaches {final}"
        later = (f"later, with {left_over(x, state)}:",) if state != first else ()
        goes_on = goes_on if still else "nothing else can happen"
        if tired[first]:
            leaves = np.isin(x.source, lost) & ~np.isin(x.target, lost) & ~x.fails
            fired = {name for n in np.unique(x.label[leaves]) for name in x.steps[n].firings}
            ways = sorted(self._stops & fired)
            goes_on += f"; only {few(ways) if ways else 'a further error'} ends it"
        return self._no(reason, first, (*self._awaited(inside), *later, *why.details, goes_on))

    def _awaited(self, states: Mask) -> tuple[str, ...]:
        """Return for which runs the task waits where an end holds in one of these states."""
        x, known = self.x, self.x.engine.compiled
        for i in np.flatnonzero(states)[:EXAMINED].tolist():
            state = x.states[i]
            if at_end(known, state.marking) is not None:
                waits = {r.place for r in state.runs() if r.phase is not Phase.DONE}
                waits = {place for place in waits if not known.task.places[place].listen}
                if waits:
                    text = f"the task would end, but waits for the run in {few(sorted(waits))}"
                    return (f"{text}; if it may be cancelled then, write listen = true there",)
        return ()

    @cached_property
    def _stops(self) -> frozenset[str]:
        """Transitions by which an external event may end a mission that could still reach `final`
        and has met no error, such as a stop button.

        After them `final` cannot be reached, or not before another event comes, such as the one
        that resets the button; or all that they ever bring is `final_error`. In a graph that is not
        complete, only those that are stops whatever its missing edges show.
        """
        x, known = self.x, self.x.engine.compiled
        awaiting = {t.name: {*t.flags, t.pulse} for t in known.transitions if t.flags or t.pulse}
        good, can = x.final | ~(x.expanded | x.spoiled), x.graph.backward(x.final)
        if (
            not x.complete
        ):  # if `final` cannot be reached from the first state, the task is not sound
            can[0] = True
        lost = ~x.graph.backward(good)
        marks, found, free = self._marks(awaiting), set[str](), (self._nominal & can)[x.source]
        for n in np.unique(x.label[free]).tolist():
            found |= marks.intersection(x.steps[n].firings)
        into = free & ~x.fails & lost[x.target]
        for n in np.unique(x.label[into]).tolist():
            cause = x.steps[n].stimulus
            came = cause.event if isinstance(cause, EventOccurred) else None
            found |= {name for name, some in awaiting.items() if came in some}
        found |= self._blamed(into, awaiting, lost)
        # After these the task gives up unless another event comes in time.
        events = x.firing(awaiting)
        quiet = x.of_edges(~x.fails & ~events)
        doomed = quiet.backward(x.given_up) & ~quiet.backward(good)
        able = quiet.backward(x.final) | ~quiet.backward(x.given_up | ~x.expanded)
        into = free & events & ~x.fails & able[x.source] & doomed[x.target]
        maybe = self._blamed(into, awaiting, lost | doomed)
        # Those that `final` needs anyhow are no stops.
        spared = x.of_edges(~x.firing(maybe)).backward(x.final)[x.source]
        return frozenset(found | {t for t in maybe if (into & spared & x.firing([t])).any()})

    def _blamed(self, edges: Mask, awaiting: Mapping[str, set[str]], bad: Mask) -> set[str]:
        """Return the transitions fired on these edges, which lead to bad states, that are to blame:
        had their event not come, the edge would lead to a good one.

        An event that was kept is served in any later step: also in that of a run whose end alone
        leads to `final_error`.
        """
        x, found = self.x, set[str]()
        for n in np.unique(x.label[edges]).tolist():
            cause, sources = x.steps[n].stimulus, x.source[edges & (x.label == n)].tolist()
            came = {cause.event} if isinstance(cause, EventOccurred) else set[str]()
            for name in awaiting.keys() & set(x.steps[n].firings) - found:
                others = (x.had_not_come(awaiting[name], i, x.steps[n]) for i in sources)
                if came & awaiting[name] or any(o is None or not bad[o] for o in others):
                    found.add(name)
        return found

    def _marks(self, awaiting: Iterable[str]) -> set[str]:
        """Return those of the transitions that only fill places which nothing else empties and
        `final` does not name, and that `final_error` looks at."""
        known = self.x.engine.compiled
        ends, places = known.task.final_error, known.net.place_index
        wanted = {places[n] for n in (ends.names if ends else ()) if n in places}
        final = {p for name, p in places.items() if name in known.task.final.names}
        given = {t.name: {p for p, *_ in t.produce} for t in known.transitions}
        taken = {t.name: {p for p, _ in known.net.consume[t.index]} for t in known.transitions}
        marks = {name for name in awaiting if given[name]}
        while True:
            used = final.union(*(taken[name] for name in taken if name not in marks))
            kept = {name for name in marks if not given[name] & used}
            if kept == marks:
                return {name for name in marks if (given[name] | taken[name]) & wanted}
            marks = kept

    @cached_property
    def quasi_live(self) -> PropertyVerdict:
        """Every transition can fire."""
        fired = set(self.x.first).union(*(step.firings for step in self.x.steps))
        compiled = self.x.engine.compiled
        never = {n: c for n, c in cases(compiled.task).items() if not fired & c}
        idle = [t for t in compiled.transitions if t.name in never]
        if not idle:
            return PropertyVerdict(True, "every transition can fire", assumption=self._fair)
        if not self.x.complete:
            return self._unknown(f"not fired so far: {few([t.name for t in idle])}")
        numbers = {compiled.net.transition_index[n] for c in never.values() for n in c}
        roots = [t for t in idle if not self._fed_by(t, numbers, t.needs)]
        # In a ring of transitions that wait for each other, name the one that lacks a token, not
        # one that lacks a run: the ring should begin with that token.
        ring = [t for t in idle if self._fed_by(t, numbers, t.plain)]
        roots = roots or [t for t in ring if self._feeds_itself(t, numbers)] or ring or idle
        told = [f"{t.name} can never fire: {self._never(t, numbers)}" for t in roots]
        if others := [t.name for t in idle if t not in roots]:
            told.append(f"and so neither can {few(others)}")
        return PropertyVerdict(False, "; ".join(told))

    def _fed_by(self, t: CompiledTransition, idle: set[int], needs: Arcs) -> bool:
        """Return whether the transition needs a token that only others in `idle` produce."""
        net = self.x.engine.compiled.net
        for p, w in needs:
            others = self._givers(p) - {t.index}
            if net.initial[p] < w and others and others <= idle:
                return True
        return False

    def _feeds_itself(self, t: CompiledTransition, idle: set[int]) -> bool:
        """Return whether others in `idle` need what it produces, and it needs what they produce."""
        net, fed = self.x.engine.compiled.net, set[int]()
        while more := {
            u
            for u in idle - fed
            for p, w in net.consume[u]
            if net.initial[p] < w and self._givers(p) & (fed | {t.index})
        }:
            fed |= more
        return t.index in fed

    def _givers(self, place: int) -> set[int]:
        net = self.x.engine.compiled.net
        return {t for t, arcs in enumerate(net.produce) if place in dict(arcs)}

    def _never(self, t: CompiledTransition, idle: set[int]) -> str:
        """Return why a transition never fires, in the words of the first thing that it lacks in
        every state."""
        from petrobot.coordinator.engine.draft import Draft
        from petrobot.coordinator.engine.firing import obstacles

        compiled = self.x.engine.compiled
        lacking: list[set[str]] = []
        near: list[set[str]] = []
        ready: list[int] = []
        for i, state in enumerate(self.x.states):
            draft = Draft(compiled, state)
            found = obstacles(draft, t)
            lacking.append({_lack(one.kind, one.text) for one in found})
            if not any(one.kind in ("short", "run") for one in found):
                near.append({_lack(one.kind, obstacle_text(draft, t, one)) for one in found})
            if not found:
                ready.append(i)
        if ready:
            over = (self.x.final | self.x.given_up)[ready].all()
            what = "the mission ends" if over else "others fire"
            return f"whenever its arcs are satisfied, {what} before its event or time comes"
        always, net, empty = set.intersection(*lacking), compiled.net, list[str]()
        for p, w in t.plain:
            givers, most = self._givers(p), most_tokens(net)[p]
            if most and most < w:
                empty.append(f"{w} of {net.places[p]}, which never holds more than {most}")
            elif net.initial[p] < w and givers <= idle:
                names = ", ".join(f"`{net.transitions[u]}`" for u in sorted(givers))
                own = f"only {names} can fill" if givers else "nothing ever fills"
                empty.append(f"{f'{w} of ' * (w > 1)}{net.places[p]}, which {own}")
        if empty:
            return f"it needs {', and '.join(empty)}"
        if false := self._never_true(t):
            return false
        if always:
            text = f"in every state at rest it {', and '.join(sorted(always))}"
            return text + self._first_takers(t, idle, len(always) > 1)
        if first := self._outranking(t):
            verb = "goes" if len(first) == 1 else "go"
            return f"whenever it could, {' and '.join(first)} {verb} first, by priority"
        if near:
            return f"when its tokens are there, it {' or '.join(sorted(set.union(*near)))}"
        needs = ", ".join(net.places[p] for p, _ in t.needs)
        text = f"in no state at rest are the tokens that it needs ({needs}) there together"
        if any(all(state.marking[p] >= w for p, w in t.needs) for state in self.x.states):
            text += ", with each run ended, or still active, as its arc asks"
        return text

    def _outranking(self, t: CompiledTransition) -> list[str]:
        """Return the transitions that ask for no more than this one, and go first."""
        needs, bars = dict(t.needs), dict(t.bars)
        ends = {arc.place: arc.end for arc in t.actions}
        return [
            f"`{u.name}`"
            for u in self.x.engine.compiled.transitions
            if u.rank < t.rank
            if u.after is None and not (u.pulse or u.flags or any(a.raised for a in u.actions))
            if u.when is None or u.when == t.when
            if all(needs.get(p, 0) >= w for p, w in u.needs)
            if all(bars.get(p, most + 1) <= most for p, most in u.bars)
            if all(ends.get(arc.place) is arc.end for arc in u.actions)
        ]

    def _never_true(self, t: CompiledTransition) -> str:
        """Return that its condition is false for all values that its variables ever have; empty if
        it is not, or if that is not known because a run tells or writes some of them."""
        task = self.x.engine.compiled.task
        names = sorted(t.when.names & set(task.variables)) if t.when is not None else []
        told = {name for place in task.places.values() for name in place.out.values()}
        if t.when is None or not names or told.intersection(names):
            return ""
        if t.when.names - set(names) - set(task.parameters):
            return ""
        base, values = dict(self.x.states[0].variables), list[dict[Value, None]]()
        for name in names:
            seen = {task.variables[name].initial: None}
            seen |= dict.fromkeys(state.variables.get(name) for state in self.x.states)
            for u in task.transitions.values():
                for written, e in u.sets:
                    if written == name and e.names:
                        return ""
                    seen |= {e.value({}): None} if written == name else {}
            values.append(seen)
        for chosen in product(*values):
            with suppress(ConditionFault):
                if t.when.holds(base | dict(zip(names, chosen, strict=True))):
                    return ""
        only = (
            f"{name} is only ever {' or '.join(map(as_literal, seen))}"
            for name, seen in zip(names, values, strict=True)
        )
        return f"its condition ({t.when}) is never true: {' and '.join(only)}"

    def _first_takers(self, t: CompiledTransition, idle: set[int], named: bool) -> str:
        """Return which other transitions take the tokens that come into a place, or the runs that
        end there, so that none is left whenever the task rests; empty if there is no such place.
        `named`: name the place."""
        from petrobot.coordinator.engine.draft import Draft
        from petrobot.coordinator.engine.firing import Claims, eligible_runs

        compiled, states = self.x.engine.compiled, self.x.states
        ends = {arc.place: arc for arc in t.actions}
        for p, _ in t.needs:
            arc = ends.get(p)
            if any(
                eligible_runs(Draft(compiled, s), arc, Claims(), heard=False)
                if arc
                else s.marking[p]
                for s in states
            ):
                continue
            takers = [
                f"`{u.name}`"
                for u in compiled.transitions
                if p in dict(u.needs) and u.index not in idle
                if arc is None or arc.end in {a.end for a in u.actions if a.place == p}
            ]
            if takers:
                what = compiled.net.places[p] if named else "it"
                verb = "takes" if len(takers) == 1 else "take"
                return f", because {' and '.join(takers)} {verb} {what} first"
        return ""

    # --- from mission to mission --------------------------------------------------------------

    @cached_property
    def live(self) -> PropertyVerdict:
        """From everywhere every transition can fire again."""
        return self._again("live")

    @cached_property
    def proper(self) -> PropertyVerdict:
        """The first state can be reached again from everywhere."""
        return self._again("proper")

    @cached_property
    def stable(self) -> PropertyVerdict:
        """The nominal flow is always reached again."""
        return self._again("stable")

    @cached_property
    def controllable(self) -> PropertyVerdict:
        """From everywhere each action can be made to start again."""
        return self._again("controllable")

    @cached_property
    def mended(self) -> dict[str, PropertyVerdict]:
        """The verdicts from mission to mission that do not hold, judged again on the assumption
        that the operator repairs what `final_error` leaves and starts the task again."""
        if not self._whole or not self.x.given_up.any():
            return {}
        again = _Again(self.x, self.x.final | self.x.given_up)
        found = {}
        for name, yes in AGAIN.items():
            if getattr(self, name).holds is False:
                bad = self._judged(name, again)
                found[name] = (
                    PropertyVerdict(True, yes, assumption=MENDED)
                    if bad is None
                    else self._no(bad[1], bad[0])
                )
        return found

    def _again(self, name: str) -> PropertyVerdict:
        if not self._whole:
            return self._unknown("")
        found = self._judged(name, self._open)
        if found is not None:
            return self._no(found[1], found[0])
        return PropertyVerdict(True, AGAIN[name], assumption=self._fair)

    @cached_property
    def _open(self) -> _Again:
        return _Again(self.x, self.x.final)

    def _judged(self, name: str, again: _Again) -> tuple[int, str] | None:
        """Return a state in which a verdict fails and why, in words; None if it holds."""
        x = self.x
        if name == "live":
            copies = cases(x.engine.compiled.task)
            return again.without(copies, "fire", "transition fires")
        if name == "controllable":
            return again.without(self.view.starts, "start", "action starts")
        if name == "proper":
            away = ~again.graph.backward([0])
            words = "the next mission can never begin after"
        else:
            met = np.zeros(len(again.graph.bottom), dtype=np.bool_)
            met[again.graph.components[self._nominal]] = True
            away = (again.graph.bottom & ~met)[again.graph.components]
            words = "the task can leave its nominal flow for good: it stays in"
        if not away.any():
            return None
        first = settled(x, int(np.argmax(away)))
        return first, f"{words} {left_over(x, first)}"

    # --- what the ordinary net can only estimate ------------------------------------------------

    @cached_property
    def one_run_each(self) -> PropertyVerdict:
        """No action place is entered while it has a run."""
        for place, state in self.x.crowded.items():
            details = (
                "it can run only once at a time; if that may happen, write `servers = 1`: then the "
                "next one waits",
            )
            return self._no(f"{place} is entered while its run is still there", state, details)
        return self._yes("no action place is entered while its run is there")

    @cached_property
    def returned(self) -> PropertyVerdict:
        """Every resource has its initial number of tokens at the end."""
        net = self.x.engine.compiled.net
        ends = np.flatnonzero(self.x.final)
        for place in self.x.engine.compiled.task.places.values():
            p = net.place_index[place.name]
            for i in ends if place.kind is Kind.RESOURCE else ():
                left = self.x.states[int(i)].marking[p]
                if left != place.tokens:
                    word = "loses" if left < place.tokens else "gains"
                    reason = (
                        f"{place.name} {word} tokens: {place.tokens} at the beginning, {left} at "
                        "the end"
                    )
                    lost = left < place.tokens
                    details = [f"{place.name}: {fate(self.x, int(i), p)}"] if lost else []
                    done = (r.place for r in self.x.states[i].runs() if r.phase is Phase.DONE)
                    for name in dict.fromkeys(done):
                        details.append(f"{name} has ended: {awaiting(self.x, int(i), name)}")
                    details.append(
                        f'if tokens of {place.name} are used up or counted, write kind = "control"'
                    )
                    return self._no(reason, int(i), tuple(details))
        return self._yes("every resource has its initial number of tokens at the end")

    # --- recovery -------------------------------------------------------------------------------

    @cached_property
    def _nominal(self) -> Mask:
        """Return G without the states in which the task gave up or got stuck."""
        good = (self.view.is_nominal(s.marking) and not s.stopping for s in self.x.states)
        nominal = np.fromiter(good, np.bool_, len(self.x))
        mask: Mask = nominal & ~self.x.given_up & ~self.x.dead
        return mask

    @cached_property
    def recoveries(self) -> tuple[Recovery, ...]:
        """Return what happens after each error exit that can fire; empty if the graph is not
        complete, or the time is used up."""
        if not self._whole:
            return ()
        nested = list(self._nested())
        back = self.x.graph.backward(self._nominal)
        lost = ~back
        open_edges = ~self._nominal[self.x.source]
        caught = self.x.graph.backward(lost, open_edges)
        found = []
        for t in self.x.engine.compiled.transitions:
            if t.name in self.view.error_exits:
                edges, alone = self._first_errors(t.name)
                if not len(edges):
                    continue
                whole = self._recovery(t.name, edges, alone, back, caught, nested)
                parts = [
                    replace(self._recovery(t.name, some, alone, back, caught, nested), cause=cause)
                    for cause, some in self._by_cause(edges).items()
                ]
                found += parts if any(p.verdicts != whole.verdicts for p in parts) else [whole]
        return tuple(found)

    def _first_errors(self, name: str, cause: str = "") -> tuple[NDArray[np.int64], bool]:
        """Return the edges that fire an error exit in the nominal flow, and True; if there are
        none, all edges that fire it, and False. `cause`: only edges after this cause of the
        error."""
        edges = np.flatnonzero(self.x.firing([name]))
        first = edges[self._nominal[self.x.source[edges]]]
        found, alone = (first, True) if len(first) else (edges, False)
        return (self._by_cause(found)[cause] if cause else found), alone

    def _by_cause(self, edges: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
        """Return the edges by cause of the error, if conditions distinguish causes."""
        causes = np.array([self.x.steps[n].reason for n in self.x.label[edges]])
        return {str(cause): edges[causes == cause] for cause in np.unique(causes)}

    def _recovery(
        self,
        name: str,
        edges: NDArray[np.int64],
        alone: bool,
        back: Mask,
        caught: Mask,
        nested: list[Mask],
    ) -> Recovery:
        x = self.x
        after = np.unique(x.target[edges])
        held = [bool(w[after].all()) for w in nested]
        kappa = None if held[-1] else held.index(False) - 1
        inside = nested[-1 if kappa is None else max(kappa, 0)]
        start = int(after[np.argmax(back[after])])
        path = x.graph.path(start, self._nominal, inside[x.target] & ~self._errors)
        path = path or x.graph.path(start, self._nominal) or []
        when = "" if alone else ", while another error is being handled,"
        return Recovery(
            name,
            self._every(
                edges,
                back,
                f"after {name}{when} the task can always return",
                "there is no way back",
            ),
            self._every(
                edges,
                ~caught,
                f"after {name}{when} the task always returns",
                "the task may never return",
            ),
            kappa,
            self._lost(edges),
            tuple(t for e in path for t in x.steps[x.label[e]].firings),
            alone,
        )

    def _every(self, edges: NDArray[np.int64], good: Mask, yes: str, no: str) -> PropertyVerdict:
        bad = edges[~good[self.x.target[edges]]]
        if not len(bad):
            return PropertyVerdict(True, f"{yes} to the nominal flow", assumption=self._fair)
        edge = int(bad[0])
        target = int(self.x.target[edge])
        step = self.x.steps[self.x.label[edge]]
        shown = _witness(self.x, int(self.x.source[edge]))
        whole = Witness(
            (*shown.firings, *step.firings), self.x.marked(target), steps=(*shown.steps, str(step))
        )
        reason = f"{no} to the nominal flow from {left_over(self.x, target)}"
        return PropertyVerdict(False, reason, whole, details=self._never_reset(target))

    def _never_reset(self, target: int) -> tuple[str, ...]:
        """Return which places of an error branch are marked from a state on, whatever happens,
        until the task gives up: a counter that nothing resets counts as an error that remains.
        Empty if the task can no longer reach its end: then that is why."""
        x, net = self.x, self.x.engine.compiled.net
        if not x.graph.backward(x.final)[target]:
            return ()
        row, todo, seen = x.graph.row, [target], {target}
        kinds = [self.view.task.flat.places[name].kind for name in net.places]
        kept = {p for p in self.view.error_places if kinds[p] is not Kind.ACTION}
        while todo and kept:
            state = todo.pop()
            kept = {p for p in kept if x.states[state].marking[p]}
            more = {*x.target[row[state] : row[state + 1]].tolist()} - seen
            seen |= more
            todo += [after for after in more if not x.given_up[after]]
        return tuple(
            f"{net.places[p]} counts as an error that remains: an error branch fills it, and "
            "nothing empties it unless the task gives up"
            for p in sorted(kept)
        )

    @cached_property
    def _errors(self) -> Mask:
        return self.x.firing(self.view.error_exits)

    def _nested(self) -> Iterator[Mask]:
        """Yield W_0, W_1, ... until they no longer shrink: the states from which G is reached for
        certain although that many further errors occur."""
        x, calm = self.x, ~self._errors
        quiet = Graph(len(x), x.source[calm], x.target[calm])
        none = np.zeros(int(calm.sum()), dtype=np.bool_)
        allowed: Mask | None = None
        last: Mask | None = None
        while True:
            reaching = quiet.almost_sure(self._nominal, none, allowed=allowed)
            if last is not None and np.array_equal(reaching, last):
                return
            yield reaching
            last = reaching
            allowed = np.ones(len(x), dtype=np.bool_)
            allowed[x.source[self._errors & ~reaching[x.target]]] = False

    def _lost(self, edges: NDArray[np.int64]) -> tuple[int, int] | None:
        """Return the fewest and the most goals that the edges make impossible."""
        if self._goals is None:
            return None
        gain, most = self._goals
        left = gain[edges] + most[self.x.target[edges]]
        lost = most[self.x.source[edges]] - left
        return int(lost.min()), int(lost.max())

    @cached_property
    def _goals(self) -> tuple[NDArray[np.int64], NDArray[np.int64]] | None:
        """Return by edge the goals that it meets, and by state the most goals that can still be met
        (a longest path). None without goals, or if their number has no limit."""
        x, goals = self.x, set(self.view.task.goal_transitions)
        each = [sum(name in goals for name in step.firings) for step in x.steps]
        gain = np.array(each or [0], dtype=np.int64)[x.label]
        if not goals or gain[x.graph.inner].any():
            return None
        most = np.zeros(len(x), dtype=np.int64)
        while True:
            better = most.copy()
            np.maximum.at(better, x.source, gain + most[x.target])
            if np.array_equal(better, most):
                return gain, most
            most = better

    @cached_property
    def odds(self) -> Odds:
        """Return probability and mean time of the return from each error exit, by the measured or
        declared numbers."""
        if not self.recoveries:
            return Odds({}, 0)
        chain = self.chain
        if isinstance(chain, str):
            return Odds({}, 0, (), chain)
        try:
            found = {}
            for r in self.recoveries:
                edges, _ = self._first_errors(r.error_exit, r.cause)
                back = chain.back(edges, self._nominal)
                if back is not None:
                    found[r.name] = (1.0 if r.almost_sure.holds else back[0], back[1])
            return Odds(found, chain.stages, chain.assumptions)
        except (OutOfTime, ArithmeticError) as why:
            return Odds({}, 0, (), str(why))
        except OUT_OF_MEMORY:
            return Odds({}, 0, (), "the memory was used up")

    @cached_property
    def chain(self) -> ExecutionChain | str:
        """The complete execution graph as a Markov chain, or why there is none."""
        try:
            return chain_of(self.x, self.measured)
        except (NoEstimate, TooLarge, OutOfTime, ArithmeticError) as why:
            return str(why)
        except OUT_OF_MEMORY:
            return "the memory was used up"

    # --- words -----------------------------------------------------------------------------------

    def verdicts(self) -> dict[str, PropertyVerdict]:
        """Return all verdicts by name; unknown where the time is used up before one is judged."""
        return {name: self._in_time(name) for name in NAMES}

    def _in_time(self, name: str) -> PropertyVerdict:
        try:
            verdict: PropertyVerdict = getattr(self, name)
        except OutOfTime:
            return self._unknown("")
        return verdict

    def size(self) -> dict[str, Any]:
        """Return the size of the graph as plain data."""
        return {
            "states": len(self.x),
            "edges": len(self.x.source),
            "complete": self.x.complete,
            "reason": self.x.reason,
            "assumptions": list(self.x.names.assumptions),
        }

    def size_text(self) -> str:
        """Return the size of the graph for people."""
        partial = "" if self.x.complete else f" (partial: {self.x.reason})"
        return f"{len(self.x)} states, {len(self.x.source)} edges{partial}"

    @cached_property
    def levels(self) -> tuple[int | None, ...]:
        """Liveness level of each transition, as in `qualitative.py`; None if unknown."""
        names = [t.name for t in self.x.engine.compiled.transitions]
        if not self._whole:
            return (None,) * len(names)
        again = self._open
        always = again.in_every_bottom()
        inner = np.unique(again.label[again.graph.inner]).tolist()
        often = set[str]().union(*(again.steps[n].firings for n in inner))
        once = set(self.x.first).union(*(step.firings for step in self.x.steps))
        return tuple(
            4 if n in always else 3 if n in often else 1 if n in once else 0 for n in names
        )

    @cached_property
    def home_states(self) -> int | None:
        """How many states can be reached again from every state; None if unknown."""
        if not self._whole:
            return None
        graph = self._open.graph
        bottoms = np.flatnonzero(graph.bottom)
        return int((graph.components == bottoms[0]).sum()) if len(bottoms) == 1 else 0

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Return notes on what is not a fault but may surprise: assumptions about variables, and
        places whose tokens at the end depend on the path. Such a token may be left over, lost, or
        counted on purpose; only the author knows."""
        said = [f"assumes that {text}" for text in self.x.names.assumptions]
        x, task, held = self.x, self.x.engine.compiled.task, list[str]()
        ends = [x.states[int(i)].marking for i in np.flatnonzero(x.final)]
        known = {place for places in self.left_behind for place in places}
        if self.returned.holds is False:  # that is an error
            known |= {p.name for p in task.places.values() if p.kind is Kind.RESOURCE}
        for p, place in enumerate(x.engine.compiled.net.places if x.complete else ()):
            numbers = {marking[p] for marking in ends}
            if len(numbers) > 1 and place not in known:
                held.append(f"{place} {min(numbers)} to {max(numbers)}")
        if held:
            said.append(f"tokens at the end depend on the path: {', '.join(held)}")
        return tuple(said)

    @cached_property
    def may_stay(self) -> frozenset[str]:
        """Places whose tokens only external events take, and from which none need be taken: an end
        can be reached without, as where a stop button waits. Empty if the graph is not complete."""
        x, known, found = self.x, self.x.engine.compiled, set[str]()
        calm = ~x.fails & ~x.firing(self._stops)
        for name, p in known.net.place_index.items() if self._whole else ():
            takers = [t for t in known.transitions if p in dict(t.needs)]
            if takers and all(t.flags or t.pulse for t in takers):
                stays = ~x.firing([t.name for t in takers])
                free = x.of_edges(stays).backward(x.final)
                free |= x.of_edges(stays & calm).backward(x.given_up)
                held = (i for i, state in enumerate(x.states) if state.marking[p])
                found |= {name} if all(free[i] for i in held) else set()
        return frozenset(found)

    @cached_property
    def left_behind(self) -> dict[tuple[str, ...], PropertyVerdict]:
        """By action places that do not listen: that runs which have ended are still there at an end
        with `final`, because nothing could take them."""
        x, known, found = self.x, set[str](), dict[tuple[str, ...], PropertyVerdict]()
        for i in np.flatnonzero(x.final).tolist():
            places = dict.fromkeys(
                run.place
                for run in x.states[i].runs()
                if not x.engine.compiled.task.places[run.place].listen
            )
            if not known.issuperset(places):
                known.update(places)
                first, *others = (awaiting(x, i, place) for place in places)
                found[tuple(places)] = self._no(first, i, tuple(others))
        return found

    @cached_property
    def ends_by_error(self) -> PropertyVerdict | None:
        """How `final` is reached, if only after a run has ended in ERROR; else None. A dead end is
        the reason, where there is one, and has a verdict of its own."""
        x = self.x
        regular = x.of_edges(~x.fails & ~x.by_hand)
        if not self._whole or not x.final.any() or regular.backward(x.final)[0]:
            return None
        if self.deadlock_free.holds is False:
            return None
        return self._no(
            "`final` is only reached after a run has ended in ERROR", int(np.argmax(x.final))
        )

    @property
    def _fair(self) -> str:
        return " and ".join((FAIR, *self.x.names.assumptions))

    def _yes(self, reason: str) -> PropertyVerdict:
        if not self.x.complete:
            return self._unknown("no fault found so far")
        return PropertyVerdict(True, reason, assumption=self._fair)

    def _no(self, reason: str, state: int, details: tuple[str, ...] = ()) -> PropertyVerdict:
        return PropertyVerdict(
            False, reason, _witness(self.x, state), complete=self.x.complete, details=details
        )

    @property
    def _whole(self) -> bool:
        """Whether the graph is complete and there is time to judge it."""
        return self.x.complete and not overtime()

    def _unknown(self, more: str) -> PropertyVerdict:
        text = f"unknown: the execution graph was not completed ({self.x.reason})"
        if self.x.complete:
            text = "unknown within the time limit; give more --seconds"
        return PropertyVerdict(None, f"{text}; {more}" if more else text, complete=False)


def progress_of(
    view: OrdinaryView,
    limit: int,
    measured: Measured | None = None,
    devices: Mapping[str, str] | None = None,
    shared: Shared | None = None,
) -> Progress:
    """Return the verdicts on the execution graph of a task, within a limit in stimuli
    and firings. `shared` is for all calls with the same task and other numbers of runs.

    `devices` gives the device of each action that has one: two runs never use it at a time.
    Raises TooManyValues.
    """
    asking, shared = Engine(view.task, devices, Policy(ask_undecided=True)), shared or Shared()
    free = execute(view.task, limit=limit, engine=asking, shared=shared)
    if not free.contests:
        return Progress(free, view, measured)
    contests = free.contests if free.complete else None
    engine = Engine(view.task, devices)
    served = execute(view.task, limit=limit, engine=engine, contests=contests, shared=shared)
    return Progress(served, view, measured, Progress(free, view))


class _Again:
    """The execution graph with an edge from some ends to the first state."""

    def __init__(self, x: ExecutionGraph, ends: Mask) -> None:
        self.x = x
        closing = np.flatnonzero(ends).astype(np.int32)
        source = np.concatenate((x.source, closing))
        order = np.argsort(source, kind="stable")
        target = np.concatenate((x.target, np.zeros(len(closing), dtype=np.int32)))
        label = np.concatenate((x.label, np.full(len(closing), len(x.steps), dtype=np.int32)))
        self.graph = Graph(len(x), source[order], target[order])
        self.label = label[order]
        self.steps = (*x.steps, Step(NEXT, x.first, Begin()))

    def _fired_in(self, component: int) -> set[str]:
        """Return the transitions that fire within a strong component."""
        ours = self.graph.components[self.graph.source]
        labels = np.unique(self.label[ours == component]).tolist()
        return set[str]().union(*(self.steps[n].firings for n in labels))

    def in_every_bottom(self) -> set[str]:
        """Return the transitions that fire again and again in every bottom component."""
        bottoms = map(self._fired_in, np.flatnonzero(self.graph.bottom).tolist())
        return set.intersection(*bottoms) if self.graph.bottom.any() else set()

    def without(
        self, wanted: Mapping[str, frozenset[str]], verb: str, nothing: str
    ) -> tuple[int, str] | None:
        """Return a state from which one of the wanted firings never happens again, and which one,
        in words. `wanted`: names, each with transitions of which one must fire."""
        components = self.graph.components
        _, entered = np.unique(components, return_index=True)
        nearest = np.argsort(entered)
        for component in nearest[self.graph.bottom[nearest]].tolist():
            fired = self._fired_in(component)
            never = [name for name, some in wanted.items() if not fired & some]
            if never:
                first = int(np.argmax(components == component))
                words = f"these never {verb} again: {', '.join(never)}"
                if len(never) == len(wanted):
                    words = f"no {nothing} again"
                return first, f"after {left_over(self.x, first)} {words}"
        return None


def contend(rivals: Sequence[str], over: Sequence[str]) -> str:
    """Say for which tokens transitions compete."""
    word = "both" if len(rivals) == 2 else "all"
    return f"{' and '.join(rivals)} may {word} want the last token of {' and '.join(over)}"


def _active(state: State) -> int:
    """Return how many runs of a state have not ended."""
    return sum(run.phase is not Phase.DONE for run in state.runs())


def _stuck(x: ExecutionGraph, state: int) -> PropertyVerdict:
    """Return that nothing can happen any more in a state, and why."""
    why, marked, left = explain(x, state), describe(x, state), left_over(x, state)
    details = why.details if marked == left else (*why.details, f"marked: {marked}")
    reason = f"stuck with {left}: {why.short}"
    return PropertyVerdict(False, reason, _witness(x, state), complete=x.complete, details=details)


def _witness(x: ExecutionGraph, state: int) -> Witness:
    """Return a shortest path to a state, as firings and as stimuli with their firings."""
    begin = Step("the mission begins", x.first, Begin())
    steps = (str(begin), *map(str, x.path(state)))
    return Witness(x.firings(state), x.marked(state), steps=steps)


def _lack(kind: str, text: str) -> str:
    """Return what a transition lacks, without the number of tokens of the particular state."""
    return text.partition(", which")[0] if kind == "short" else text.partition(", which holds")[0]
