"""Describe stimuli and ends of runs for the operator (pure functions)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from petrobot.coordinator.engine import (
    Abort,
    AddTokens,
    Begin,
    Choose,
    Chosen,
    Engine,
    EventOccurred,
    Fired,
    ForceExit,
    Override,
    Pause,
    RaiseEvent,
    RemoveTokens,
    Report,
    Resume,
    RunEnded,
    RunHeld,
    RunRaised,
    RunRecorded,
    RunStarted,
    SetBreakpoints,
    Step,
    Stimulus,
    StopConfirmed,
    StopFailed,
    TimerFired,
    VariableChanged,
    Verdict,
)
from petrobot.coordinator.run.recording import RecordedStep
from petrobot.coordinator.task import Executed, Status

LONGEST_TEXT = 400


def place_of(run: str) -> str:
    """Return the place of a run's id (`place#3`)."""
    return run.rpartition("#")[0] or run


def told(stimulus: Stimulus | None, cause: str = "") -> str:
    """Describe what happened. `cause` is that of a firing: `stability` means that it followed from
    another one."""
    if cause == "stability":
        return "followed at once"
    match stimulus:
        case RunEnded(run, status):
            return f"{place_of(run)} ended: {status.value}"
        case RunStarted(run):
            return f"{place_of(run)} has begun"
        case RunHeld(run, answer):
            return f"{place_of(run)}: {answer.value.replace('_', ' ')}"
        case Chosen(key, alternative, reason):
            return (
                f"{alternative} chosen for {place_of(key)}: {reason}"
                if reason
                else f"{alternative} chosen"
            )
        case Verdict(run, status, code, text):
            why = ": ".join(filter(None, (code, text)))
            return f"verdict on {run}: {status.value}{f' ({why})' if why else ''}"
        case EventOccurred(event):
            return f"event {event}"
        case RunRaised(run, event):
            return f"{place_of(run)} raised {event}"
        case RaiseEvent(event):
            return f"event {event}, raised by the operator"
        case TimerFired():
            return "its time has passed"
        case VariableChanged(name):
            return f"{name} changed"
        case AddTokens(place, tokens):
            return f"operator put {tokens} into {place}"
        case RemoveTokens(place, tokens):
            return f"operator took {tokens} out of {place}"
        case ForceExit():
            return "forced by the operator"
        case StopConfirmed(run):
            return f"{place_of(run)} has stopped"
        case StopFailed(run):
            return f"{place_of(run)} could not be stopped"
        case Pause(reason):
            return f"paused{': ' + reason if reason else ''}"
        case Resume():
            return "continued by the operator"
        case Step():
            return "operator's step"
        case SetBreakpoints(names):
            return f"breakpoints: {', '.join(names) or 'none'}"
        case Override(primitive_task, action):
            return (
                f"operator chose {action} for {primitive_task}"
                if action
                else f"{primitive_task} is chosen freely again"
            )
        case Abort(reason):
            return f"aborted: {reason}" if reason else "aborted by the operator"
        case Begin():
            return "the run began"
        case None:
            return cause


def unserved(step: RecordedStep, engine: Engine) -> str:
    """Return why an event fired nothing when it came; empty if it did, if a report says
    why, or if a choice has to be made first."""
    if step.repeated:
        return "delivered again, ignored"
    if not isinstance(step.stimulus, EventOccurred | RaiseEvent) or step.state.suspended:
        return ""
    if any(isinstance(one, Fired | Choose | Report) for one in step.instructions):
        return ""
    event = step.stimulus.event
    if event in step.state.flags:
        return "kept until a transition takes it"
    return "nothing could fire" if engine.awaits(step.state, event) else "nothing waited for it"


def reason_of(status: Status | None, cause: str, text: str, executed: Executed) -> dict[str, Any]:
    """Return why a run ended as it did: {status, code, text, executed}."""
    return {
        "status": status.value if status is not None else "none",
        "code": cause,
        "text": text[:LONGEST_TEXT],
        "executed": executed.value,
    }


def reason_recorded(run: RunRecorded) -> dict[str, Any]:
    """Return `reason_of` a recorded run. The error with which a cancelled run answers is not a
    reason: what counts is why its token was taken away."""
    if run.cancelled:
        return reason_of(run.status, "", run.taken_away, run.executed)
    return reason_of(run.status, run.cause, run.text, run.executed)


def firing_of(
    fired: Fired,
    stimulus: Stimulus | None,
    ends: Mapping[str, dict[str, Any]],
    actions: Mapping[str, str],
) -> dict[str, Any]:
    """Return {transition, cause, reason, run, action} of a firing. Of several runs that it took, it
    is the one that ended worst; `ends` are their reasons and `actions` their actions."""
    run = max(
        fired.runs,
        key=lambda run: _BY_BADNESS.index(ends[run]["status"]) if run in ends else -1,
        default="",
    )
    end = ends.get(run)
    return {
        "transition": fired.transition,
        "cause": told(stimulus, fired.cause),
        "reason": end if end is not None and end["status"] in ("failure", "error") else None,
        "run": run,
        "action": actions.get(run, ""),
    }


_BY_BADNESS = ("none", "success", "failure", "error")


def plain_value(value: Any, depth: int = 4) -> Any:
    """Return a variable's value for display: bytes as their size, long values shortened."""
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, str):
        return value[:LONGEST_TEXT]
    if isinstance(value, Mapping):
        return (
            {str(k): plain_value(v, depth - 1) for k, v in list(value.items())[:32]}
            if depth
            else "…"
        )
    if isinstance(value, (list, tuple)):
        return [plain_value(v, depth - 1) for v in value[:64]] if depth else "…"
    return value
