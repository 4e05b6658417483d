"""Fire from a stimulus to a stable marking: maximal steps, breakpoints, start of runs, and the end
of the mission run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from msgspec import Struct

from petrobot.coordinator.engine.compiled import Compiled
from petrobot.coordinator.engine.conflicts import Draw, choose_step
from petrobot.coordinator.engine.draft import Draft
from petrobot.coordinator.engine.firing import (
    DEAD_END,
    Match,
    awaited_place,
    can_still_fire,
    cancel,
    fire,
    forget_flags,
    token_enabled,
    verdict_variables,
    waiting_for,
)
from petrobot.coordinator.engine.instructions import (
    Choose,
    Finished,
    HoldRun,
    Paused,
    ReleaseRun,
    Resumed,
    Subject,
)
from petrobot.coordinator.engine.runs import admit, take_arguments
from petrobot.coordinator.engine.state import ACTIVE, UNSTARTED, Mode, Phase, Run, Suspended, Wait
from petrobot.coordinator.engine.timers import (
    disarm_all,
    hold_timers,
    refresh_timers,
    release_timers,
)
from petrobot.coordinator.task import Counts, End, Status, Value
from petrobot.coordinator.task.conditions import ConditionFault
from petrobot.coordinator.task.wording import Severity

MOVING = frozenset({Mode.RUNNING, Mode.STEPPING})


class Policy(Struct, frozen=True):
    """How the engine treats conflicts, dead ends and endless firings."""

    firing_limit: int | None = None
    """Firings without a stimulus after which the engine pauses, as in `RECORDED` runs; None: after
    `Compiled.firing_limit` of them the mission run ends in ERROR."""
    end_when_dead: bool = True
    """End in ERROR when nothing can ever happen again; otherwise only report it, and leave the rest
    to the operator."""
    report_dead_ends: bool = True
    """Report every state from which neither a firing nor an end can be reached. Journals with
    `semantics` 1 or 2 in their header were recorded without that."""
    first_come: bool = True
    """Decide a conflict that neither priority nor weight decides by first come, first served.
    Journals with `semantics` 3 or less in their header were recorded with the order in the file
    instead."""
    listed_values: bool = True
    """A variable that lists its `values` takes no other. Journals with `semantics` 4 or less in
    their header were recorded without that."""
    keep_ranks: bool = True
    """What goes first in a step because another would bar it takes no token for which a transition
    of higher priority competes. Journals with `semantics` 5 or less in their header were recorded
    without that."""
    ask_undecided: bool = False
    """Ask with `Choose` for each conflict that neither priority nor weight decides. The analysis
    uses this to see whether a verdict depends on the answer."""


RECORDED: Final[Mapping[int, Policy]] = {
    semantics: Policy(
        firing_limit=1000 if semantics < 2 else None,
        report_dead_ends=semantics >= 3,
        first_come=semantics >= 4,
        listed_values=semantics >= 5,
        keep_ranks=False,
    )
    for semantics in range(1, 6)
}
"""The engine's policy in older journals, by the `semantics` of their header."""


def settle(
    draft: Draft, policy: Policy, cause: str, pulse: str = "", step: Suspended | None = None
) -> None:
    """Fire what the stimulus made fireable, or continue a suspended step; then fire until the
    marking is stable, and start runs."""
    if draft.mode in MOVING and draft.suspended is None:
        current = step or Suspended(pulse, cause)
        while True:
            _fire_until_stable(draft, policy, current)
            if draft.mode not in MOVING or draft.suspended is not None or not admit(draft):
                break
            # A run ended instead of starting, because its device is fenced.
            current = Suspended("", "stability")
    elif draft.mode is Mode.PAUSED:
        admit(draft)
    if draft.flags:
        forget_flags(draft)
    # Last: arcs that were satisfied only between two firings of this stimulus arm no timer.
    if draft.retime and draft.mode is not Mode.FINISHED:
        refresh_timers(draft)
    first_come = policy.first_come and not policy.ask_undecided
    if draft.compiled.contested and first_come and draft.suspended is None:
        _note_waits(draft)
    _explain_waiting(draft)
    _end_if_over(draft, policy)


def _note_waits(draft: Draft) -> None:
    """Note since when each transition that may compete for a token lacks nothing else."""
    waits = dict[str, Wait]()
    for name, place in lacking(draft).items():
        new = Wait(place, draft.stimuli)
        old = draft.waits.get(name, new)
        waits[name] = old if old.place == new.place else new
    if waits != draft.waits:
        draft.waits = waits


def lacking(draft: Draft) -> dict[str, str]:
    """Return the transitions that lack only tokens of one place for which they may compete, each
    with that place."""
    places, found = draft.compiled.net.places, dict[str, str]()
    for t, contested in draft.compiled.contested.items():
        x = draft.compiled.transitions[t]
        p = awaited_place(draft, x, contested)
        if p is not None:
            found[x.name] = places[p]
    return found


def pause(draft: Draft, reason: str) -> None:
    """Stop firing and starting, and ask active runs to hold."""
    draft.mode = Mode.PAUSED
    draft.emit(Paused(reason))
    for run in draft.live():
        if run.phase in UNSTARTED:
            draft.put(run, cleared=False)
        elif run.phase is not Phase.HELD:
            draft.emit(HoldRun(run.id))
    hold_timers(draft)


def resume(draft: Draft, mode: Mode) -> None:
    """Continue, without limit or (STEPPING) for one firing."""
    draft.mode = mode
    draft.emit(Resumed(1 if mode is Mode.STEPPING else 0))
    for run in draft.live():
        if run.phase in UNSTARTED and not run.cleared:
            draft.put(run, cleared=True)
    if mode is Mode.RUNNING:
        release(draft)
    draft.touch_all()  # marks are not kept: what changed during the pause was not examined


def release(draft: Draft) -> None:
    """Let held runs and timers continue."""
    for run in draft.live():
        if run.phase in ACTIVE:
            draft.emit(ReleaseRun(run.id))
        if run.phase is Phase.HELD:
            draft.put(run, phase=Phase.RUNNING)
    release_timers(draft)


def abort(draft: Draft, reason: str) -> None:
    """Cancel every run; the mission run ends when all of them have stopped."""
    draft.mode, draft.suspended, draft.ending = (
        Mode.ABORTING,
        None,
        f"aborted: {reason}" if reason else "aborted",
    )
    draft.backlog.clear()
    for run in draft.live():
        cancel(draft, run, Counts.NONE, draft.ending)
    disarm_all(draft)


def _fire_until_stable(draft: Draft, policy: Policy, current: Suspended) -> None:
    while True:
        step = choose_step(
            draft,
            current.pulse,
            current.choices,
            current.only,
            ask=policy.ask_undecided,
            keep_ranks=policy.keep_ranks,
        )
        if isinstance(step, Draw):
            _ask(draft, current, step)
            return
        if not step or _breaks(draft, current, step):
            return
        limit = 1 if draft.mode is Mode.STEPPING else len(step)
        entered = draft.run_order
        written = [_new_values(draft, fireable) for fireable in step[:limit]]
        for fireable in step[:limit]:
            fire(draft, fireable, current.cause)
        if draft.compiled.setting:
            _set_variables(draft, dict(pair for pairs in written for pair in pairs))
            take_arguments(draft, entered)
        if draft.mode is Mode.STEPPING:
            _end_single_step(draft, current, step)
        elif not _stops_after(draft, policy, step):
            current = Suspended("", "stability")
            continue
        return


def _new_values(draft: Draft, fireable: Match) -> list[tuple[str, Value]]:
    """Return what the firing writes, evaluated before any transition of its step fires."""
    return [(name, e.value(draft.variables)) for name, e in fireable.transition.sets]


def _set_variables(draft: Draft, values: Mapping[str, Value]) -> None:
    """Write what the firings of a step set. Two transitions that write one variable never fire in
    the same step."""
    for name, value in values.items():
        draft.write(name, value)
        # Others that write it were kept out of this step, and perhaps none of their places changed.
        draft.dirty.update(draft.compiled.setting[name])


def _ask(draft: Draft, current: Suspended, draw: Draw) -> None:
    key = f"conflict#{draft.stimuli}.{len(current.choices)}"
    draft.suspended = Suspended(
        current.pulse,
        current.cause,
        current.choices,
        key,
        draw.alternatives,
        draw.weights,
        current.passed,
        current.only,
    )
    draft.emit(
        Choose(key, Subject.CONFLICT, ", ".join(draw.alternatives), draw.alternatives, draw.weights)
    )


def _breaks(draft: Draft, current: Suspended, step: list[Match]) -> bool:
    """Pause before a transition with a breakpoint, and keep its step. Return whether it paused."""
    if not draft.breakpoints:
        return False
    names = [m.transition.name for m in step]
    hit = [n for n in names if n in draft.breakpoints and n not in current.passed]
    if not hit:
        return False
    # The whole step has passed: it fires together, so it pauses once, however many are hit.
    draft.suspended = Suspended(
        current.pulse, current.cause, current.choices, passed=tuple(names), only=current.only
    )
    pause(draft, f"breakpoint before {hit[0]}")
    return True


def _end_single_step(draft: Draft, current: Suspended, step: list[Match]) -> None:
    """Pause after one firing; other transitions of the same pulse wait for the next step."""
    left = tuple(m.transition.name for m in step[1:] if m.transition.pulse)
    if left:
        draft.suspended = Suspended(current.pulse, current.cause, passed=current.passed, only=left)
    draft.mode = Mode.PAUSED
    draft.emit(Paused("step"))
    admit(draft)


def _stops_after(draft: Draft, policy: Policy, step: list[Match]) -> bool:
    """Pause after a token entered a place with a breakpoint, and give up on endless firings. Return
    whether the step stops here."""
    places = draft.compiled.net.places
    entered = [
        places[p]
        for m in (step if draft.breakpoints else ())
        for p, _, _ in m.transition.produce
        if places[p] in draft.breakpoints
    ]
    if entered:
        pause(draft, f"breakpoint at {entered[0]}")
        return True
    limit = draft.compiled.firing_limit if policy.firing_limit is None else policy.firing_limit
    if draft.timeless < limit:
        return False
    text = (
        f"{draft.timeless} transitions fired without time passing, last {step[-1].transition.name}"
    )
    draft.report(Severity.ERROR, "timeless", text, step[-1].transition.name)
    if policy.firing_limit is None:
        # If it continued, it would fire for ever again. An operator could only edit the task.
        abort(draft, text)
    else:
        pause(draft, "firings without time")
    return True


def _explain_waiting(draft: Draft) -> None:
    """Report, once, a run that has ended and whose outgoing transitions all have a false
    condition."""
    if draft.mode not in MOVING or draft.suspended is not None:
        return
    for runs in draft.tokens.values():
        for run in runs:
            if run.phase is Phase.DONE and run.id not in draft.told and _nowhere_to_go(draft, run):
                how = f"{run.status}{', ' + run.cause if run.cause else ''}"
                text = (
                    f"{run.id} has finished ({how}) and has nowhere to go: the conditions "
                    "of all its exits are false"
                )
                draft.report_once(Severity.ERROR, "nowhere_to_go", text, run.id)


def _nowhere_to_go(draft: Draft, run: Run) -> bool:
    wanted = End.ERROR if run.status is Status.ERROR else End.NORMAL
    values = draft.variables | verdict_variables(run)
    for x in draft.compiled.transitions:
        if (
            not any(a.name == run.place and (a.end is wanted or a.takes_done) for a in x.actions)
            or x.never
        ):
            continue
        try:
            if x.when is None or x.pulse or x.flags or x.when.holds(values):
                return False
        except ConditionFault:
            continue
    return True


class _Tokens(Mapping[str, int]):
    """A marking by place name, for the condition `final`."""

    def __init__(self, compiled: Compiled, marking: Sequence[int]) -> None:
        self.index, self.marking = compiled.net.place_index, marking

    def __getitem__(self, name: str) -> int:
        return self.marking[self.index[name]]

    def __iter__(self) -> Iterator[str]:
        return iter(self.index)

    def __len__(self) -> int:
        return len(self.marking)


def at_end(compiled: Compiled, marking: Sequence[int]) -> Status | None:
    """Return how a mission run that rests in the marking ends: SUCCESS by `final`, ERROR by
    `final_error`, None if it is at no end."""
    task, tokens = compiled.task, _Tokens(compiled, marking)
    if task.final.holds(tokens):
        return Status.SUCCESS
    if task.final_error is not None and task.final_error.holds(tokens):
        return Status.ERROR
    return None


def _end_if_over(draft: Draft, policy: Policy) -> None:
    if draft.suspended is not None or _stops_to_come(draft):
        return
    if draft.mode is Mode.ABORTING:
        _finish(draft, Status.ERROR, draft.ending)
    elif draft.mode is Mode.CLOSING:
        _finish(draft, draft.closing or Status.ERROR, draft.ending)
    elif draft.mode in MOVING:
        task, live = draft.compiled.task, draft.live()
        if any(not task.places[r.place].listen for r in live):
            return
        end = at_end(draft.compiled, draft.marking)
        if end is Status.SUCCESS:
            _close(draft, live, end, f"final marking reached: {task.final}")
        elif end is Status.ERROR:
            _close(draft, live, end, f"given up: {task.final_error}")
        elif not live:
            _end_if_dead(draft, policy)


def _stops_to_come(draft: Draft) -> bool:
    return any(r.phase is not Phase.STUCK for r in draft.stopping.values())


def _close(draft: Draft, listening: list[Run], status: Status, reason: str) -> None:
    """End the mission run when the runs that only listen have stopped."""
    for run in listening:
        cancel(draft, run, Counts.NONE, "the mission run is finished")
    if _stops_to_come(draft):
        draft.mode, draft.closing, draft.ending = Mode.CLOSING, status, reason
        disarm_all(draft)
    else:
        _finish(draft, status, reason)


def _end_if_dead(draft: Draft, policy: Policy) -> None:
    if draft.timers or any(token_enabled(draft, x) for x in draft.compiled.transitions):
        if policy.report_dead_ends:
            _report_dead_end(draft)
        return
    text = (
        "no transition can ever fire again in "
        f"{draft.compiled.net.describe(draft.snapshot())}, which is not final"
    )
    draft.report_once(Severity.ERROR, "dead", text, "dead")
    if policy.end_when_dead:
        _finish(draft, Status.ERROR, text)


def _report_dead_end(draft: Draft) -> None:
    """Report a state in which no run is active and no external event can make anything fire."""
    if any(not timer.elapsed for timer in draft.timers.values()):
        return
    if any(can_still_fire(draft, x) for x in draft.compiled.transitions):
        return
    text = (
        f"nothing can happen any more in {draft.compiled.net.describe(draft.snapshot())}, which "
        f"is not final: {waiting_for(draft)}"
    )
    draft.report_once(Severity.ERROR, DEAD_END, text, DEAD_END)


def _finish(draft: Draft, status: Status, reason: str) -> None:
    fenced = sorted(draft.stopping)
    if fenced:
        status, reason = Status.ERROR, f"{reason}; {', '.join(fenced)} could not be stopped"
    disarm_all(draft)
    draft.mode, draft.ending = Mode.FINISHED, reason
    draft.emit(Finished(status, reason, dict(draft.variables)))
