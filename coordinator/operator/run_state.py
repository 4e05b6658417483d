"""Publish a mission run as changes of the page's state: an observer of the executor, and of
replayed journals."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from petrobot.coordinator.engine import (
    Abort,
    CancelRun,
    Chosen,
    Corrected,
    EventOccurred,
    Finished,
    Fired,
    Hold,
    HoldRun,
    Instruction,
    Marked,
    Mode,
    Paused,
    RaiseEvent,
    ReleaseRun,
    Report,
    Resumed,
    RunHeld,
    RunRecorded,
    StartRun,
    State,
    Stimulus,
)
from petrobot.coordinator.operator.changes import empty_state
from petrobot.coordinator.operator.event_texts import (
    firing_of,
    plain_value,
    reason_of,
    reason_recorded,
    told,
)
from petrobot.coordinator.operator.net_state import picture
from petrobot.coordinator.operator.port import Feed
from petrobot.coordinator.run.recording import mission_time
from petrobot.coordinator.task import End, Executed, Scope, Task
from petrobot.coordinator.task.net import Marking
from petrobot.coordinator.task.wording import Severity
from petrobot.services.comm.protocol.messages import Feedback

_AFTER_HOLD = {Hold.HELD: "held", Hold.CANNOT: "running", Hold.STOPPED: "stopping"}
_LEVEL = {Severity.NOTE: "info", Severity.WARNING: "warning", Severity.ERROR: "error"}


class ChangePublisher:
    """Publishes changes on a feed. `where` gives the node of each action. Implements
    `coordinator.run.interfaces.Observer`.

    Call `settled` with the new state after each stimulus that the engine has handled: it publishes
    what no instruction reports (latched events, variables, breakpoints).
    """

    def __init__(
        self, feed: Feed, task: Task, where: Mapping[str, str] | None = None, origin: float = 0.0
    ) -> None:
        self.feed = feed
        self.task = task
        self.origin = origin
        self._where = where or {}
        self._net = task.net
        self._stimulus: Stimulus | None = None
        # By run, as long as its token is there; a mission of many hours must not fill the memory.
        self._ends: dict[str, dict[str, Any]] = {}
        self._actions: dict[str, str] = {}
        self._why: dict[str, str] = {}
        self._held: dict[str, str] = {}
        self._seen: State | None = None
        self._aborted = False
        self._error_exits = {
            t.name
            for t in task.flat.transitions.values()
            if any(i.end is End.ERROR for i in t.inputs)
        }
        self._tell: Mapping[type, Callable[[float, Any], None]] = {
            Fired: self._fired,
            Marked: self._marked,
            StartRun: self._started,
            CancelRun: lambda t, i: self._state(t, i.run, "stopping"),
            HoldRun: lambda t, i: self._state(t, i.run, "holding"),
            ReleaseRun: lambda t, i: self._state(t, i.run, "running"),
            RunRecorded: self._recorded,
            Corrected: self._corrected,
            Report: self._report,
            Paused: self._paused,
            Resumed: lambda t, i: self.feed.emit("paused", time=t, paused=None),
            Finished: self._finished,
        }

    def begin(self, mission: str, mode: str, *, starts: bool = True, **parts: Any) -> None:
        """Begin a mission run: clients get a snapshot with the task in its initial marking.

        `starts` tells whether another mission run can be started after this one. `parts` are
        further parts of the snapshot that outlive a mission run, such as `controls`, `nodes` and
        `selectors`.
        """
        flat = self.task.flat
        events = {
            name: {
                "scope": e.scope.value,
                "memory": e.memory.value,
                "armed": False,
                "count": 0,
                "last": None,
            }
            for name, e in flat.events.items()
        }
        state = {key: value for key, value in empty_state().items() if key != "sequence"} | {
            "mission": {
                "id": mission,
                "state": "idle",
                "mode": mode,
                "firings": 0,
                "starts": starts,
            },
            "task": picture(self.task),
            "marking": dict(zip(self._net.places, self._net.initial, strict=True)),
            "events": events,
            "variables": {n: plain_value(v) for n, v in flat.initial_variables().items()},
        }
        self.feed.replace(**(state | parts))

    # --- an observer of the executor ----------------------------------------------------------

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Publish a stimulus that the engine receives."""
        time = mission_time(now, self.origin)
        self._stimulus = stimulus
        if isinstance(stimulus, Chosen):
            self._why[stimulus.key] = stimulus.reason
        elif isinstance(stimulus, (EventOccurred, RaiseEvent)):
            if isinstance(stimulus, EventOccurred) and stimulus.is_repeated(
                self._seen.seen if self._seen else {}
            ):
                return
            known = self.feed.state["events"].get(stimulus.event)
            if known is not None:
                event = {**known, "count": known["count"] + 1, "last": round(time, 4)}
                self.feed.emit("event", time=time, name=stimulus.event, event=event)
            if isinstance(stimulus, RaiseEvent):
                self.feed.emit("command", time=time, text=told(stimulus))
        elif isinstance(stimulus, Abort):
            self._aborted = True
        elif isinstance(stimulus, RunHeld):
            self._answered(time, stimulus)

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Publish an instruction or a record of the engine."""
        tell = self._tell.get(type(instruction))
        if tell is not None:
            tell(mission_time(now, self.origin), instruction)

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Publish the progress of a run."""
        self.feed.emit(
            "run_progress",
            time=mission_time(now, self.origin),
            id=run,
            progress=round(notice.fraction, 4),
        )

    def settled(self, now: float, state: State) -> None:
        """Publish what changed after the engine has handled a stimulus."""
        time, seen = mission_time(now, self.origin), self._seen
        if seen is None or seen.flags != state.flags:
            self._flags(time, seen.flags if seen else frozenset(), state.flags)
        if seen is None or seen.variables is not state.variables:
            before = seen.variables if seen else {}
            for name, value in state.variables.items():
                if name not in before or before[name] != value:
                    self.feed.emit("variable", time=time, name=name, value=plain_value(value))
        if seen is None or seen.breakpoints != state.breakpoints:
            self.feed.emit(
                "breakpoints",
                time=time,
                breakpoints=[self._key(n) for n in sorted(state.breakpoints)],
            )
        before_overrides = seen.overrides if seen else {}
        if before_overrides is not state.overrides:
            self._overrides(time, before_overrides, state.overrides)
        if self._why:  # left over: draws of conflicts, and runs that never started
            self._why = {key: why for key, why in self._why.items() if state.run(key) is not None}
        if state.mode in (Mode.RUNNING, Mode.PAUSED) and self.feed.state["mission"]["state"] in (
            "idle",
            "preparing",
        ):
            self.feed.emit("mission", time=time, mission={"state": "running"})
        if state.mode is Mode.ABORTING and self.feed.state["mission"]["state"] == "running":
            self.feed.emit(
                "mission", time=time, mission={"state": "stopping", "reason": state.ending}
            )
        self._seen = state

    # --- in the terms of the protocol ---------------------------------------------------------

    def _fired(self, time: float, fired: Fired) -> None:
        firing = firing_of(fired, self._stimulus, self._ends, self._actions)
        for run in fired.runs:
            self._ends.pop(run, None)
            self._actions.pop(run, None)
        firing |= {
            "number": fired.number,
            "at": round(time, 4),
            "error": fired.transition in self._error_exits,
            "node": self._where.get(firing["action"], ""),
        }
        self.feed.emit("fired", time=time, firing=firing)
        self._marking(time, fired.before, fired.after)
        self.feed.emit("mission", time=time, mission={"firings": fired.number})

    def _marked(self, time: float, marked: Marked) -> None:
        if marked.place:
            self.feed.emit("command", time=time, text=told(self._stimulus))
        self._marking(time, marked.before, marked.after)

    def _marking(self, time: float, before: Marking, after: Marking) -> None:
        places = self._net.places
        changed = {places[i]: n for i, n in enumerate(after) if n != before[i]}
        if changed:
            self.feed.emit("marking", time=time, marking=changed)

    def _started(self, time: float, start: StartRun) -> None:
        self._actions[start.run] = start.action
        run = {
            "id": start.run,
            "place": start.place,
            "primitive_task": start.primitive_task,
            "action": start.action,
            "node": self._where.get(start.action, ""),
            "why": self._why.pop(start.run, "the only alternative"),
            "started": round(time, 4),
            "deadline": start.deadline,
            "progress": None,
            "state": "running",
            "held_since": None,
            "held_for": 0.0,
        }
        self.feed.emit("run_started", time=time, run=run)

    def _state(self, time: float, run: str, state: str) -> None:
        """Publish the state of a run. Its deadline stands still from the answer `held` on, also
        while it is asked again, until it continues or is stopped."""
        known, changed = self.feed.state["runs"].get(run, {}), dict[str, Any](state=state)
        since = known.get("held_since")
        if state == "held" and since is None:
            changed["held_since"] = round(time, 4)
        elif state in ("running", "stopping") and since is not None:
            changed |= {"held_since": None, "held_for": round(known["held_for"] + time - since, 4)}
        self.feed.emit("run_progress", time=time, id=run, **changed)

    def _answered(self, time: float, held: RunHeld) -> None:
        self._state(time, held.run, _AFTER_HOLD[held.answer])
        node = self._where.get(self._actions.get(held.run, ""), "?")
        # Of a node with several runs the worst answer is shown.
        if self._held.get(node) != Hold.CANNOT.value:
            self._held[node] = held.answer.value
        paused = self.feed.state["paused"]
        if paused is not None:
            self.feed.emit("paused", time=time, paused={**paused, "nodes": dict(self._held)})

    def _recorded(self, time: float, record: RunRecorded) -> None:
        reason = reason_recorded(record)
        if not record.cancelled:  # its token is still there
            self._ends[record.run] = reason
        status = record.status.value if record.status is not None else "none"
        self.feed.emit(
            "run_ended",
            time=time,
            id=record.run,
            status=status,
            ended=round(time, 4),
            reason=reason,
            cancelled=record.cancelled,
            deferred=record.deferred,
        )

    def _corrected(self, time: float, corrected: Corrected) -> None:
        reason = reason_of(corrected.status, corrected.cause, corrected.text, Executed.YES)
        self.feed.emit(
            "run_judged",
            time=time,
            id=corrected.run,
            status=corrected.status.value,
            was=corrected.was.value,
            reason=reason,
        )

    def _report(self, time: float, report: Report) -> None:
        if report.severity is not Severity.NOTE:
            self.feed.emit(
                "notice",
                time=time,
                notice={
                    "level": _LEVEL[report.severity],
                    "text": report.text,
                    "at": round(time, 4),
                },
            )

    def _paused(self, time: float, paused: Paused) -> None:
        self._held = {}
        self.feed.emit(
            "paused", time=time, paused={"reason": paused.reason, "at": round(time, 4), "nodes": {}}
        )

    def _finished(self, time: float, finished: Finished) -> None:
        state = "aborted" if self._aborted else finished.status.value
        if self.feed.state["paused"] is not None:
            self.feed.emit("paused", time=time, paused=None)
        if self.feed.state["mission"]["state"] == "stopped":
            return  # The emergency stop holds until it is cleared, whatever the run's result.
        self.feed.emit("mission", time=time, mission={"state": state, "reason": finished.told})

    def _flags(self, time: float, before: frozenset[str], after: frozenset[str]) -> None:
        for name in before ^ after:
            known = self.feed.state["events"].get(name)
            if known is not None and self.task.flat.events[name].scope is Scope.EXTERNAL:
                self.feed.emit(
                    "event", time=time, name=name, event={**known, "armed": name in after}
                )

    def _overrides(self, time: float, before: Mapping[str, str], after: Mapping[str, str]) -> None:
        for name in sorted(
            name for name in {*before, *after} if before.get(name) != after.get(name)
        ):
            selector = {**self.feed.state["selectors"].get(name, {}), "override": after.get(name)}
            self.feed.emit("selector", time=time, name=name, selector=selector)

    def _key(self, name: str) -> str:
        return f"{'places' if name in self._net.place_index else 'transitions'}.{name}"
