"""Stimuli of the operator: tokens in control places, forced exits, pause, step, breakpoints."""

from __future__ import annotations

from msgspec.structs import replace

from petrobot.coordinator.engine.draft import Draft
from petrobot.coordinator.engine.firing import Match, arcs_satisfied, fire
from petrobot.coordinator.engine.instructions import Marked
from petrobot.coordinator.engine.state import LIVE, Mode, Phase, Run
from petrobot.coordinator.engine.step import MOVING, Policy, pause, release, resume, settle
from petrobot.coordinator.engine.stimuli import (
    AddTokens,
    ForceExit,
    Override,
    RemoveTokens,
    SetBreakpoints,
)
from petrobot.coordinator.task import Counts, End, Kind
from petrobot.coordinator.task.elements import MOST_TOKENS
from petrobot.coordinator.task.wording import Severity, nearest


def add_tokens(draft: Draft, policy: Policy, command: AddTokens) -> None:
    """Put tokens into a control place, if its capacity allows all of them."""
    p = _control_place(draft, command.place, command.tokens)
    if p is None:
        return
    capacity = draft.compiled.net.capacity[p]
    if capacity is None:
        capacity = MOST_TOKENS
    if draft.marking[p] + command.tokens > capacity:
        refuse(
            draft,
            f"{command.place} holds {draft.marking[p]} tokens and at most {capacity}",
            command.place,
        )
        return
    _mark(draft, p, command.tokens)
    settle(draft, policy, "AddTokens")


def remove_tokens(draft: Draft, policy: Policy, command: RemoveTokens) -> None:
    """Take tokens out of a control place, if it has enough."""
    p = _control_place(draft, command.place, command.tokens)
    if p is None:
        return
    if draft.marking[p] < command.tokens:
        refuse(draft, f"{command.place} holds only {draft.marking[p]} tokens", command.place)
        return
    _mark(draft, p, -command.tokens)
    settle(draft, policy, "RemoveTokens")


def set_breakpoints(draft: Draft, command: SetBreakpoints) -> None:
    """Replace the breakpoints; unknown names are refused and the others set."""
    known = {*draft.compiled.net.places, *draft.compiled.net.transitions}
    for name in command.names:
        if name not in known:
            refuse(draft, f"{name!r} is no place and no transition{nearest(name, known)}", name)
    draft.breakpoints = frozenset(command.names) & known


def override(draft: Draft, command: Override) -> None:
    """Fix the alternative of a primitive task, or free the choice. It takes precedence over the
    selector."""
    name, action = command.primitive_task, command.action
    primitives = draft.compiled.task.primitive_tasks
    if name not in primitives:
        refuse(draft, f"{name!r} is no primitive task{nearest(name, primitives)}", name)
    elif action and action not in primitives[name].alternatives:
        refuse(
            draft,
            f"{action!r} is no alternative of "
            f"{name}{nearest(action, primitives[name].alternatives)}",
            name,
        )
    else:
        kept = {task: chosen for task, chosen in draft.overrides.items() if task != name}
        draft.overrides = {**kept, name: action} if action else kept


def pause_net(draft: Draft, reason: str) -> None:
    """Pause, unless there is nothing to pause."""
    if draft.mode in MOVING:
        pause(draft, reason or "operator")
    else:
        refuse(draft, f"nothing to pause: the mission run is {draft.mode}", "")


def go_on(draft: Draft, policy: Policy) -> None:
    """Resume."""
    if draft.mode not in (Mode.PAUSED, Mode.STEPPING):
        refuse(draft, f"nothing to continue: the mission run is {draft.mode}", "")
        return
    step, draft.suspended = draft.suspended, None
    resume(draft, Mode.RUNNING)
    settle(draft, policy, "Resume", step=step)


def single_step(draft: Draft, policy: Policy) -> None:
    """Let one transition fire. If none can fire now, held runs continue until one can."""
    if draft.mode not in (Mode.PAUSED, Mode.RUNNING, Mode.STEPPING):
        refuse(draft, f"no step: the mission run is {draft.mode}", "")
        return
    step, draft.suspended = draft.suspended, None
    resume(draft, Mode.STEPPING)
    settle(draft, policy, "Step", step=step)
    if draft.mode is Mode.STEPPING:
        release(draft)


def force_exit(draft: Draft, policy: Policy, command: ForceExit) -> None:
    """Fire a transition whatever the state of its runs, its events, time and condition. Active runs
    do not count."""
    index = draft.compiled.net.transition_index.get(command.transition)
    if index is None:
        known = draft.compiled.net.transitions
        refuse(
            draft,
            f"{command.transition!r} is no transition{nearest(command.transition, known)}",
            command.transition,
        )
        return
    x = draft.compiled.transitions[index]
    if draft.mode not in (*MOVING, Mode.PAUSED):
        refuse(draft, f"{x.name} cannot be forced now: the mission run is {draft.mode}", x.name)
        return
    for t in (index, *draft.compiled.copies.get(x.name, ())):
        found = _forced(draft, t)
        if found is not None:
            _fire_forced(draft, found)
            settle(draft, policy, "stability")
            return
    why = (
        "it leaves no action place"
        if not x.actions
        else "a token that it needs is missing, or a place is full"
    )
    refuse(draft, f"{x.name} cannot be forced: {why}", x.name)


def _forced(draft: Draft, index: int) -> Match | None:
    """Return the runs that a forced firing takes; None if tokens do not allow it."""
    x = draft.compiled.transitions[index]
    runs = tuple(tuple(_forced_runs(draft, a.name, a.end)[: a.weight]) for a in x.actions)
    enough = all(len(taken) == a.weight for taken, a in zip(runs, x.actions, strict=True))
    return Match(x, runs) if x.actions and enough and _others_allow(draft, index) else None


def refuse(draft: Draft, text: str, of: str) -> None:
    """Report a command that cannot be carried out; it changes nothing."""
    draft.report(Severity.WARNING, "refused", text, of)


def _control_place(draft: Draft, name: str, tokens: int) -> int | None:
    place = draft.compiled.task.places.get(name)
    if place is None or place.kind is not Kind.CONTROL:
        controls = [p.name for p in draft.compiled.task.places.values() if p.kind is Kind.CONTROL]
        refuse(draft, f"{name!r} is no control place{nearest(name, controls)}", name)
    elif tokens < 1:
        refuse(draft, f"{tokens} tokens are none", name)
    elif draft.mode in (Mode.FRESH, Mode.ABORTING, Mode.CLOSING, Mode.FINISHED):
        refuse(draft, f"no tokens move: the mission run is {draft.mode}", name)
    else:
        return draft.compiled.net.place_index[name]
    return None


def _mark(draft: Draft, place: int, tokens: int) -> None:
    before = draft.snapshot()
    draft.marking[place] += tokens
    draft.touch(place)
    draft.emit(Marked(draft.compiled.net.places[place], before, draft.snapshot()))


def _forced_runs(draft: Draft, place: str, end: End) -> list[Run]:
    """Return the runs whose tokens a forced firing takes: ended ones first, then by age."""
    runs = draft.tokens.get(place, ())
    if end is End.GOING:
        return [r for r in runs if r.phase in LIVE]
    return sorted(runs, key=lambda r: (r.phase is not Phase.DONE, r.ended, r.order))


def _others_allow(draft: Draft, index: int) -> bool:
    """Return whether plain inputs, inhibitors and capacities allow the forced firing."""
    x = draft.compiled.transitions[index]
    return arcs_satisfied(draft, replace(x, actions=(), needs=x.plain)) is not None


def _fire_forced(draft: Draft, forced: Match) -> None:
    x = forced.transition
    actions = tuple(replace(a, counts=Counts.NONE, raised=()) for a in x.actions)
    fire(draft, Match(replace(x, actions=actions, flags=()), forced.runs), "ForceExit")
