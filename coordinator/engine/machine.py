"""The engine: a task as a pure state machine, from stimuli to instructions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from msgspec.structs import replace

from petrobot.coordinator.engine import operator, runs
from petrobot.coordinator.engine.compiled import compile_task
from petrobot.coordinator.engine.draft import Draft
from petrobot.coordinator.engine.firing import awaited, can_end, stuck_for
from petrobot.coordinator.engine.instructions import (
    ArmTimer,
    CancelRun,
    Choose,
    HoldRun,
    HoldTimer,
    Instruction,
    Marked,
    StartRun,
    Subject,
)
from petrobot.coordinator.engine.state import ACTIVE, LIVE, Mode, Phase, Run, State, Suspended
from petrobot.coordinator.engine.step import Policy, abort, lacking, settle
from petrobot.coordinator.engine.stimuli import (
    Abort,
    AddTokens,
    Begin,
    Chosen,
    EventOccurred,
    ForceExit,
    Hold,
    Override,
    Pause,
    Point,
    RaiseEvent,
    RemoveTokens,
    Resume,
    RunEnded,
    RunHeld,
    RunRaised,
    RunStarted,
    SetBreakpoints,
    Standing,
    Step,
    Stimulus,
    StopConfirmed,
    StopFailed,
    TimerFired,
    VariableChanged,
    Verdict,
)
from petrobot.coordinator.engine.timers import elapse, hold_timers_of
from petrobot.coordinator.task import Counts, EventMemory, Scope, Task, VariableType
from petrobot.coordinator.task.wording import Severity


def start_at(draft: Draft, point: Point) -> None:
    """Set the tokens, runs, variables and latched events of the point. Names that the task does not
    have are reported.

    An action place gets one token for each of its runs, whatever the marking says, so that the two
    always agree.
    """
    net, before = draft.compiled.net, draft.snapshot()
    known = {place: n for place, n in point.marking.items() if place in net.place_index and n >= 0}
    actions = draft.compiled.action_places
    draft.marking[:] = [0 if place in actions else known.get(place, 0) for place in net.places]
    for place in sorted(set(point.marking) - set(known)):
        draft.report(
            Severity.WARNING,
            "bad_point",
            f"{place!r} is no place that can hold its tokens; left out",
            place,
        )
    for standing in point.standing:
        _stand(draft, standing)
    draft.emit(Marked("", before, draft.snapshot()))
    for name, value in point.variables.items():
        draft.write(name, value)
    draft.flags.update(name for name in point.flags if _is_latched(draft, name))


def _stand(draft: Draft, standing: Standing) -> None:
    index = draft.compiled.action_places.get(standing.place)
    if index is None:
        text = f"{standing.place!r} is no action place; no run stands there"
        draft.report(Severity.WARNING, "bad_point", text, standing.place)
        return
    draft.marking[index] += 1
    draft.enter(standing.place, index)
    if standing.status is None:
        return
    draft.end_order += 1
    run = draft.tokens[standing.place][-1]
    device = draft.compiled.devices.get(standing.action, "")
    over = {
        "status": standing.status,
        "cause": standing.cause,
        "action": standing.action,
        "device": device,
    }
    draft.put(run, phase=Phase.DONE, ended=draft.end_order, **over)


def _is_latched(draft: Draft, name: str) -> bool:
    event = draft.compiled.task.events.get(name)
    return (
        event is not None
        and event.scope is Scope.EXTERNAL
        and event.memory is not EventMemory.PULSE
    )


_AFTER_THE_END = (RunEnded, StopConfirmed, StopFailed, Verdict)
_ALWAYS_HEARD = (Abort, Verdict, SetBreakpoints, Override)
_BEFORE_THE_BEGIN = (Begin, SetBreakpoints, Override)


class Engine:
    """A task compiled for execution. It never changes; all that changes is in the `State`.

    `devices` names the device of each action that uses one. Two runs never use one device at the
    same time, except for actions of a primitive task with `start = "at_once"`.
    """

    def __init__(
        self, task: Task, devices: Mapping[str, str] | None = None, policy: Policy | None = None
    ) -> None:
        """Compile the task. Raises ValueError with every fault of an inconsistent one."""
        self.task = task
        self.policy = policy or Policy()
        if not self.policy.listed_values:
            free = {name: replace(v, values=()) for name, v in task.variables.items()}
            task = replace(task, variables=free)
        self.compiled = compile_task(task, devices or {})
        self._handlers: dict[type, Callable[[Draft, Any], None]] = {
            Begin: self._begin,
            RunStarted: self._run_started,
            RunEnded: self._run_ended,
            RunRaised: self._run_raised,
            EventOccurred: self._event_occurred,
            TimerFired: self._timer_fired,
            VariableChanged: self._variable_changed,
            Chosen: self._chosen,
            StopConfirmed: self._stop_confirmed,
            StopFailed: self._stop_failed,
            Verdict: runs.correct,
            RunHeld: self._run_held,
            Pause: lambda draft, s: operator.pause_net(draft, s.reason),
            Resume: lambda draft, s: operator.go_on(draft, self.policy),
            Step: lambda draft, s: operator.single_step(draft, self.policy),
            SetBreakpoints: operator.set_breakpoints,
            Override: operator.override,
            AddTokens: lambda draft, s: operator.add_tokens(draft, self.policy, s),
            RemoveTokens: lambda draft, s: operator.remove_tokens(draft, self.policy, s),
            RaiseEvent: self._raise_event,
            ForceExit: lambda draft, s: operator.force_exit(draft, self.policy, s),
            Abort: self._abort,
        }

    def initial(self) -> State:
        """Return the state before `Begin`."""
        return State(self.compiled.net.initial, self.compiled.task.initial_variables())

    def handle(self, state: State, stimulus: Stimulus) -> tuple[State, tuple[Instruction, ...]]:
        """Return the next state and what to do. Pure. A stimulus that does not fit the state is
        reported and changes nothing."""
        draft = Draft(self.compiled, state)
        self._take(draft, stimulus)
        while draft.backlog and not _waits_for_draw(draft):
            self._take(draft, draft.backlog.pop(0))
        return draft.freeze(), tuple(draft.instructions)

    def awaits(self, state: State, event: str) -> bool:
        """Return whether an external event would change anything: tokens enable a transition that
        waits for it, or its flag is kept until they do."""
        sets_flag = event in self.compiled.kept and event not in state.flags
        return sets_flag or awaited(Draft(self.compiled, state), event)

    def lacking(self, state: State) -> dict[str, str]:
        """Return the transitions that lack only tokens of one place for which they may compete,
        each with that place."""
        return lacking(Draft(self.compiled, state))

    def only_listens(self, state: State) -> bool:
        """Return whether only an event or the global memory can still change something but in
        listening branches: nothing else is active, stopping or timed."""
        if state.mode is not Mode.RUNNING or state.suspended is not None:
            return False
        places, advancing = self.compiled.task.places, self.compiled.advancing
        return not (
            any(run.phase in LIVE and not places[run.place].listen for run in state.runs())
            or any(run.phase is Phase.STOPPING for run in state.stopping.values())
            or any(x in advancing and not timer.elapsed for x, timer in state.timers.items())
        )

    def can_end(self, state: State) -> bool:
        """Return whether a running task may still end or meet a goal without an operator; False is
        a proof."""
        return state.mode is not Mode.RUNNING or can_end(Draft(self.compiled, state))

    def stuck_for(self, state: State, chances: bool = True) -> str:
        """Return in words what the tokens wait for; without `chances` only what they lack."""
        return stuck_for(Draft(self.compiled, state), chances)

    def outstanding(self, state: State) -> tuple[Instruction, ...]:
        """Return the orders that are still in force, for a coordinator that takes over a state:
        choices, runs, cancels, holds, timers."""
        draft = Draft(self.compiled, state)
        for run in [r for rs in state.tokens.values() for r in rs] + list(state.stopping.values()):
            self._order_again(draft, run)
        for name, timer in state.timers.items():
            if not timer.elapsed:
                after = self.compiled.task.transitions[name].after or 0.0
                draft.emit(ArmTimer(timer.key, name, after))
                if timer.held:
                    draft.emit(HoldTimer(timer.key))
        waiting = state.suspended
        if waiting is not None and waiting.key:
            names = waiting.alternatives
            draft.emit(
                Choose(waiting.key, Subject.CONFLICT, ", ".join(names), names, waiting.weights)
            )
        return tuple(draft.instructions)

    def _order_again(self, draft: Draft, run: Run) -> None:
        primitive = self.compiled.primitives[run.place]
        if run.phase is Phase.CHOOSING:
            draft.emit(Choose(run.id, Subject.ACTION, primitive.name, primitive.alternatives))
        elif run.phase in ACTIVE:
            deadline = primitive.deadline
            draft.emit(
                StartRun(run.id, run.place, primitive.name, run.action, run.arguments, deadline)
            )
            # Also if the node had answered: a run that lost its coordinator may have been released.
            if draft.mode is Mode.PAUSED:
                draft.emit(HoldRun(run.id))
        elif run.phase in (Phase.STOPPING, Phase.STUCK):
            draft.emit(
                CancelRun(run.id, run.counts or Counts.NONE, run.reason, primitive.stop_within)
            )

    def _take(self, draft: Draft, stimulus: Stimulus) -> None:
        kind = type(stimulus)
        if kind is not Chosen:  # an answer takes no time: a loop through choices is endless, too
            draft.timeless = 0
        if draft.mode is Mode.FRESH and kind not in _BEFORE_THE_BEGIN:
            _note(draft, "not_begun", f"{kind.__name__} came before the mission run began")
        elif draft.mode is Mode.FINISHED and not isinstance(stimulus, _AFTER_THE_END):
            _note(draft, "finished", f"{kind.__name__} came after the mission run had ended")
        elif (
            _waits_for_draw(draft)
            and kind is not Chosen
            and not isinstance(stimulus, _ALWAYS_HEARD)
        ):
            draft.backlog.append(stimulus)
        else:
            self._handlers[kind](draft, stimulus)

    def _begin(self, draft: Draft, stimulus: Begin) -> None:
        if draft.mode is not Mode.FRESH:
            _note(draft, "begun", "the mission run has begun already")
            return
        draft.mode = Mode.RUNNING
        task = self.compiled.task
        if stimulus.point is not None:
            start_at(draft, stimulus.point)
        for name, value in stimulus.parameters.items():
            if name not in task.parameters or not VariableType.of(task.parameters[name]).admits(
                value
            ):
                _warn(
                    draft,
                    "bad_parameter",
                    f"{name} = {value!r} is no parameter of {task.name}; ignored",
                    name,
                )
            else:
                draft.write(name, value)
        for name, value in stimulus.variables.items():
            _write(draft, name, value)
        if stimulus.point is None:
            for place, index in self.compiled.action_places.items():
                for _ in range(draft.marking[index]):
                    draft.enter(place, index)
        draft.touch_all()
        settle(draft, self.policy, "Begin")

    def _run_started(self, draft: Draft, stimulus: RunStarted) -> None:
        run = draft.find(stimulus.run)
        if run is not None and run.phase is Phase.STARTING:
            draft.put(run, phase=Phase.RUNNING)

    def _run_ended(self, draft: Draft, stimulus: RunEnded) -> None:
        run = draft.find(stimulus.run)
        if run is None or run.phase not in (*ACTIVE, Phase.STOPPING, Phase.STUCK):
            _note(
                draft,
                "unknown_run",
                f"{stimulus.run} ended ({stimulus.status}), but it was not going on",
                stimulus.run,
            )
        elif run.phase in ACTIVE:
            runs.end_run(draft, run, stimulus)
            settle(draft, self.policy, "RunEnded")
        else:
            runs.end_stopping(draft, run, stimulus)
            settle(draft, self.policy, "StopConfirmed")

    def _run_raised(self, draft: Draft, stimulus: RunRaised) -> None:
        run, event = draft.find(stimulus.run), self.compiled.task.events.get(stimulus.event)
        if run is None or run.phase not in ACTIVE:
            _note(
                draft,
                "unknown_run",
                f"{stimulus.run} raised {stimulus.event}, but it was not going on",
                stimulus.run,
            )
        elif (
            event is None
            or event.scope is not Scope.INTERNAL
            or event.by != self.compiled.primitives[run.place].name
        ):
            text = (
                f"{run.id} raised {stimulus.event!r}, which is no internal event of its "
                "primitive task; ignored"
            )
            _warn(draft, "unknown_event", text, stimulus.event)
        elif not stimulus.is_repeated(run):
            heard = max(run.heard, stimulus.number)
            draft.put(run, raised=run.raised | {stimulus.event}, heard=heard)
            settle(draft, self.policy, "RunRaised")

    def _event_occurred(self, draft: Draft, stimulus: EventOccurred) -> None:
        if stimulus.is_repeated(draft.seen):
            return
        if stimulus.number:
            draft.seen[stimulus.source] = stimulus.number
        self._occur(draft, stimulus.event, "EventOccurred")

    def _raise_event(self, draft: Draft, stimulus: RaiseEvent) -> None:
        self._occur(draft, stimulus.event, "RaiseEvent")

    def _occur(self, draft: Draft, name: str, cause: str) -> None:
        event = self.compiled.task.events.get(name)
        if event is None or event.scope is not Scope.EXTERNAL:
            _warn(
                draft, "unknown_event", f"{name!r} is no external event of the task; ignored", name
            )
        elif event.memory is EventMemory.PULSE:
            draft.dirty.update(self.compiled.waiting.get(name, ()))
            settle(draft, self.policy, cause, pulse=name)
        elif name in self.compiled.kept or awaited(draft, name):
            draft.flags.add(name)
            draft.dirty.update(self.compiled.waiting.get(name, ()))
            settle(draft, self.policy, cause)
        else:
            _note(
                draft,
                "early_event",
                f"{name} came when nothing waited for it; it is forgotten",
                name,
            )

    def _timer_fired(self, draft: Draft, stimulus: TimerFired) -> None:
        if elapse(draft, stimulus.key):
            settle(draft, self.policy, "TimerFired")

    def _variable_changed(self, draft: Draft, stimulus: VariableChanged) -> None:
        if _write(draft, stimulus.name, stimulus.value):
            settle(draft, self.policy, "VariableChanged")

    def _chosen(self, draft: Draft, stimulus: Chosen) -> None:
        waiting = draft.suspended
        if waiting is not None and waiting.key and waiting.key == stimulus.key:
            self._drawn(draft, stimulus, waiting)
            return
        run = draft.find(stimulus.key)
        if run is None or run.phase is not Phase.CHOOSING:
            _note(draft, "no_choice", f"no choice is open on {stimulus.key}", stimulus.key)
        elif stimulus.alternative not in self.compiled.primitives[run.place].alternatives:
            text = (
                f"{stimulus.alternative!r} is no alternative of "
                f"{self.compiled.primitives[run.place].name}"
            )
            _warn(draft, "bad_choice", text, stimulus.key)
        elif _waits_for_draw(draft):
            draft.backlog.append(stimulus)
        else:
            runs.chosen(draft, run, stimulus.alternative)
            settle(draft, self.policy, "Chosen")

    def _drawn(self, draft: Draft, stimulus: Chosen, waiting: Suspended) -> None:
        if stimulus.alternative not in waiting.alternatives:
            text = f"{stimulus.alternative!r} is none of {', '.join(waiting.alternatives)}"
            _warn(draft, "bad_choice", text, stimulus.key)
            return
        draft.suspended = None
        draft.touch_all()  # the marks of the stimulus that led to the draw are not kept
        choices = (*waiting.choices, stimulus.alternative)
        step = Suspended(
            waiting.pulse, waiting.cause, choices, passed=waiting.passed, only=waiting.only
        )
        settle(draft, self.policy, waiting.cause, step=step)

    def _stop_confirmed(self, draft: Draft, stimulus: StopConfirmed) -> None:
        run = draft.stopping.get(stimulus.run)
        if run is None:
            _note(
                draft,
                "unknown_run",
                f"{stimulus.run} is said to have stopped, but was not stopping",
                stimulus.run,
            )
            return
        runs.confirm_stop(draft, run, stimulus)
        settle(draft, self.policy, "StopConfirmed")

    def _stop_failed(self, draft: Draft, stimulus: StopFailed) -> None:
        run = draft.stopping.get(stimulus.run)
        if run is None or run.phase is Phase.STUCK:
            _note(
                draft,
                "unknown_run",
                f"{stimulus.run} is said not to stop, but was not stopping",
                stimulus.run,
            )
            return
        runs.fail_stop(draft, run, stimulus)
        settle(draft, self.policy, "StopFailed")

    def _run_held(self, draft: Draft, stimulus: RunHeld) -> None:
        run = draft.find(stimulus.run)
        if run is None or run.phase not in ACTIVE or draft.mode is not Mode.PAUSED:
            return
        if stimulus.answer is Hold.HELD:
            draft.put(run, phase=Phase.HELD)
            hold_timers_of(draft, run.id)
        else:
            _note(draft, "not_held", f"{run.id} ({run.action}): {stimulus.answer}", run.id)

    def _abort(self, draft: Draft, stimulus: Abort) -> None:
        if draft.mode is not Mode.ABORTING:
            abort(draft, stimulus.reason)
            settle(draft, self.policy, "Abort")


def _waits_for_draw(draft: Draft) -> bool:
    return draft.suspended is not None and bool(draft.suspended.key)


def _write(draft: Draft, name: str, value: Any) -> bool:
    """Write a watched variable. A value that it cannot have is reported, and it is none."""
    variable = draft.compiled.task.variables.get(name)
    if variable is None:
        _note(draft, "unknown_variable", f"{name!r} is no variable of the task; ignored", name)
        return False
    if refused := variable.refused(value):
        _warn(draft, "bad_value", f"{name} = {value!r} is {refused}; it is none now", name)
        value = None
    draft.write(name, value)
    return True


def _note(draft: Draft, key: str, text: str, of: str = "") -> None:
    draft.report(Severity.NOTE, key, text, of)


def _warn(draft: Draft, key: str, text: str, of: str) -> None:
    draft.report(Severity.WARNING, key, text, of)
