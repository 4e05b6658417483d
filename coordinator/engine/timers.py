"""`after` timers: armed while the same runs satisfy the arcs of their transition."""

from __future__ import annotations

from msgspec.structs import replace

from petrobot.coordinator.engine.draft import Draft
from petrobot.coordinator.engine.firing import arcs_satisfied, disarm
from petrobot.coordinator.engine.instructions import ArmTimer, HoldTimer, ReleaseTimer
from petrobot.coordinator.engine.state import ACTIVE, Mode, Timer
from petrobot.coordinator.task.compiled_task import CompiledTransition


def refresh_timers(draft: Draft) -> None:
    """Arm and disarm timers after the changes of this stimulus."""
    for t in sorted(draft.retime):
        x = draft.compiled.transitions[t]
        taken = arcs_satisfied(draft, x)
        runs = None if taken is None else tuple(r.id for r in taken)
        timer = draft.timers.get(x.name)
        if timer is not None and timer.runs != runs:
            disarm(draft, x.name)
            timer = None
        if timer is None and runs is not None:
            _arm(draft, x, runs)
    draft.retime.clear()


def disarm_all(draft: Draft) -> None:
    """Disarm all timers: the mission run has finished."""
    for name in list(draft.timers):
        disarm(draft, name)


def hold_timers(draft: Draft) -> None:
    """Stop the timers during a pause, except those of runs that have not yet answered whether they
    hold."""
    for name, timer in list(draft.timers.items()):
        if not timer.held and not timer.elapsed and not _concerns_active(draft, timer):
            draft.timers[name] = replace(timer, held=True)
            draft.emit(HoldTimer(timer.key))


def release_timers(draft: Draft) -> None:
    """Let the timers continue after a pause."""
    for name, timer in list(draft.timers.items()):
        if timer.held:
            draft.timers[name] = replace(timer, held=False)
            draft.emit(ReleaseTimer(timer.key))


def elapse(draft: Draft, key: str) -> bool:
    """Mark a timer as elapsed. Return False if it was disarmed before."""
    for name, timer in draft.timers.items():
        if timer.key == key:
            draft.timers[name] = replace(timer, elapsed=True, held=False)
            draft.dirty.add(draft.compiled.net.transition_index[name])
            return True
    return False


def hold_timers_of(draft: Draft, run_id: str) -> None:
    """Stop the timers of a run that is held."""
    for name, timer in list(draft.timers.items()):
        if run_id in timer.runs and not timer.held and not timer.elapsed:
            draft.timers[name] = replace(timer, held=True)
            draft.emit(HoldTimer(timer.key))


def _arm(draft: Draft, x: CompiledTransition, runs: tuple[str, ...]) -> None:
    draft.timer_order += 1
    timer = Timer(f"{x.name}#{draft.timer_order}", runs)
    draft.timers[x.name] = timer
    draft.emit(ArmTimer(timer.key, x.name, x.after or 0.0))
    if draft.mode is Mode.PAUSED and not _concerns_active(draft, timer):
        draft.timers[x.name] = replace(timer, held=True)
        draft.emit(HoldTimer(timer.key))


def _concerns_active(draft: Draft, timer: Timer) -> bool:
    return any((run := draft.find(i)) is not None and run.phase in ACTIVE for i in timer.runs)
