"""A run from the queue to its end: servers, choice of action, device fences, results, verdicts."""

from __future__ import annotations

from msgspec.structs import replace

from petrobot.coordinator.engine.draft import Draft
from petrobot.coordinator.engine.firing import verdict_variables
from petrobot.coordinator.engine.instructions import (
    Choose,
    Corrected,
    RunRecorded,
    StartRun,
    Subject,
)
from petrobot.coordinator.engine.state import ACTIVE, UNSTARTED, Deferred, Early, Phase, Run
from petrobot.coordinator.engine.stimuli import RunEnded, StopConfirmed, StopFailed, Verdict
from petrobot.coordinator.task import Counts, Executed, Reference, Start, Status, Value
from petrobot.coordinator.task.wording import Severity


def admit(draft: Draft) -> bool:
    """Advance waiting runs as far as possible, the oldest first. Return whether one of them ended
    in ERROR at once."""
    waiting = [r for runs in draft.tokens.values() for r in runs if r.phase in UNSTARTED]
    if not waiting:
        return False
    ended = False
    full = set[str]()  # places whose servers are all taken: each is counted once, not for each run
    for run in sorted(waiting, key=lambda r: r.order) if len(waiting) > 1 else waiting:
        if not run.cleared or (run.place in full and run.phase is Phase.QUEUED):
            continue
        failed = False
        if run.phase is Phase.WAITING:
            failed = _start(draft, run)
        elif run.phase is Phase.QUEUED and not _has_server(draft, run.place):
            full.add(run.place)
        elif run.phase is Phase.QUEUED:
            alternatives = draft.compiled.primitives[run.place].alternatives
            if len(alternatives) == 1:
                failed = _start(draft, _translated(draft, run, alternatives[0]))
            else:
                _choose(draft, run, alternatives)
        if failed:
            ended = True
            full.discard(run.place)
    return ended


def chosen(draft: Draft, run: Run, action: str) -> None:
    """Note the action that was chosen for a run, which now waits for its device."""
    draft.replace_run(_translated(draft, run, action))


def _translated(draft: Draft, run: Run, action: str) -> Run:
    """Return the run with its action, waiting for its device."""
    at_once = draft.compiled.primitives[run.place].start is Start.AT_ONCE
    device = draft.compiled.devices.get(action, "")
    return run.changed(phase=Phase.WAITING, action=action, device=device, at_once=at_once)


def end_run(draft: Draft, run: Run, end: RunEnded) -> None:
    """End an active run. Its results and its status are written before any transition fires."""
    draft.end_order += 1
    done = draft.put(
        run,
        phase=Phase.DONE,
        status=end.status,
        cause=end.cause,
        executed=end.executed if run.place in draft.compiled.executed else None,
        ended=draft.end_order,
        arguments={},
    )
    _write_results(draft, run, end)
    for name, value in verdict_variables(done).items():
        draft.write(name, value)
    if end.deferred:
        draft.deferred = {
            **draft.deferred,
            run.id: Deferred(run.place, run.action, end.status, end.cause),
        }
    _record(draft, run, end.status, end, cancelled=False)
    early = _take_early(draft, run)
    if early is not None:
        correct(draft, Verdict(run.id, early.status, early.cause, early.text))


def end_stopping(draft: Draft, run: Run, end: RunEnded) -> None:
    """Take a result that arrived after the cancel: the run has stopped. The result is recorded, but
    writes no variable and moves no token."""
    _forget(draft, run)
    text = f"{run.reason}; it had ended with {end.status}" + (f", {end.cause}" if end.cause else "")
    _record(draft, run, _counted(run, end.executed), replace(end, text=text), cancelled=True)


def confirm_stop(draft: Draft, run: Run, stop: StopConfirmed) -> None:
    """Note that a cancelled run has stopped: its device is free."""
    _forget(draft, run)
    end = RunEnded(
        run.id, Status.ERROR, "cancelled", run.reason, stop.executed, seconds=stop.seconds
    )
    _record(draft, run, _counted(run, stop.executed), end, cancelled=True)


def _counted(run: Run, executed: Executed) -> Status | None:
    """Return the status with which a cancelled run counts; None if it does not count."""
    counts = run.counts or Counts.NONE
    return None if counts is Counts.NONE or executed is Executed.NO else Status(counts.value)


def fail_stop(draft: Draft, run: Run, stop: StopFailed) -> None:
    """Note that a cancelled run could not be stopped: its device stays fenced, and runs that wait
    for it end in ERROR."""
    draft.put(run, phase=Phase.STUCK)
    text = f"{run.id} could not be stopped{': ' + stop.text if stop.text else ''}"
    draft.report(
        Severity.ERROR,
        "stuck_run",
        f"{text}; its device {run.device or '(none)'} stays fenced",
        run.id,
    )


def correct(draft: Draft, verdict: Verdict) -> None:
    """Take a deferred verdict, once, for the estimates only. It may come from another node and
    arrive before the run's end."""
    known = draft.deferred.get(verdict.run)
    if known is not None:
        draft.deferred = {run: open_ for run, open_ in draft.deferred.items() if run != verdict.run}
        cause = verdict.cause or (known.cause if verdict.status is known.status else "")
        was = (known.place, known.action, known.status)
        draft.emit(Corrected(verdict.run, *was, verdict.status, cause, verdict.text))
        return
    run = draft.find(verdict.run)
    if run is not None and run.phase in ACTIVE and run.id not in draft.early:
        draft.early = {**draft.early, run.id: Early(verdict.status, verdict.cause, verdict.text)}
    else:
        _no_verdict_due(draft, verdict.run)


def _no_verdict_due(draft: Draft, run: str) -> None:
    draft.report(Severity.NOTE, "no_verdict_due", f"no verdict is due on {run}", run)


def _forget(draft: Draft, run: Run) -> None:
    del draft.stopping[run.id]
    draft.touch(draft.compiled.action_places[run.place])
    if _take_early(draft, run) is not None:
        _no_verdict_due(draft, run.id)


def _take_early(draft: Draft, run: Run) -> Early | None:
    """Remove and return the verdict that arrived before the run's end."""
    early = draft.early.get(run.id)
    if early is not None:
        draft.early = {known: one for known, one in draft.early.items() if known != run.id}
    return early


def _record(draft: Draft, run: Run, status: Status | None, end: RunEnded, cancelled: bool) -> None:
    primitive = draft.compiled.primitives[run.place].name
    draft.emit(
        RunRecorded(
            run.id,
            run.place,
            primitive,
            run.action,
            status,
            end.cause,
            end.text,
            end.executed,
            end.seconds,
            cancelled,
            end.deferred and not cancelled,
        )
    )


def _write_results(draft: Draft, run: Run, end: RunEnded) -> None:
    task = draft.compiled.task
    for name, variable in task.places[run.place].out.items():
        if name not in end.values and end.status is Status.ERROR:
            continue
        value = end.values.get(name)
        refused = task.variables[variable].refused(value)
        if refused or name not in end.values:
            was = f"gave {value!r}, which is {refused}" if name in end.values else "gave nothing"
            text = f"{run.id} ({run.action}) {was} for {name!r}; variable {variable} is none now"
            draft.report(Severity.WARNING, "bad_value", text, run.id)
            value = None
        draft.write(variable, value)


def _has_server(draft: Draft, place: str) -> bool:
    served = sum(
        r.phase in ACTIVE or r.phase in (Phase.CHOOSING, Phase.WAITING) for r in draft.tokens[place]
    )
    served += sum(r.place == place and r.phase is Phase.STOPPING for r in draft.stopping.values())
    return served < draft.compiled.task.places[place].most_active


def _choose(draft: Draft, run: Run, alternatives: tuple[str, ...]) -> None:
    draft.put(run, phase=Phase.CHOOSING)
    draft.emit(
        Choose(run.id, Subject.ACTION, draft.compiled.primitives[run.place].name, alternatives)
    )


def _start(draft: Draft, run: Run) -> bool:
    """Start the run if its device is free. Return whether it ended instead, since the device stays
    fenced."""
    holders = [] if run.at_once or not run.device else _holders(draft, run)
    if holders:
        draft.replace_run(run)
    if any(h.phase is Phase.STUCK for h in holders):
        cause = f"{run.device} is fenced: {holders[0].id} could not be stopped"
        end_run(draft, run, RunEnded(run.id, Status.ERROR, "device_fenced", cause, Executed.NO))
        return True
    if holders:
        return False
    arguments = {
        name: run.arguments[name] if name in run.arguments else _argument(draft, value)
        for name, value in draft.compiled.task.places[run.place].args.items()
    }
    draft.put(run, phase=Phase.STARTING, arguments=arguments)
    primitive = draft.compiled.primitives[run.place]
    draft.emit(
        StartRun(run.id, run.place, primitive.name, run.action, arguments, primitive.deadline)
    )
    return False


def _holders(draft: Draft, run: Run) -> list[Run]:
    """Return the other runs that use the run's device."""
    active = [r for runs in draft.tokens.values() for r in runs if r.phase in ACTIVE]
    return [
        r for r in (*active, *draft.stopping.values()) if r.device == run.device and r.id != run.id
    ]


def take_arguments(draft: Draft, since: int) -> None:
    """Read the arguments that transitions set for the runs whose tokens entered after run number
    `since`: each token keeps the values with which it came."""
    for place, runs in draft.tokens.items():
        for run in runs:
            if run.order > since:
                taken = {
                    name: _argument(draft, value)
                    for name, value in draft.compiled.task.places[place].args.items()
                    if isinstance(value, Reference) and value.variable in draft.compiled.setting
                }
                if taken:
                    draft.put(run, arguments=taken)


def _argument(draft: Draft, value: Value) -> Value:
    return draft.variables.get(value.variable) if isinstance(value, Reference) else value
