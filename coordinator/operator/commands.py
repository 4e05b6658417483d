"""The operator's side of a live mission run: the state that clients see, and their commands as
stimuli.

Implements `coordinator.operator.port.MissionPort` for one mission run. A command that concerns the
net is a journaled stimulus. The emergency stop waits for nothing and is sent directly to the nodes.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from typing import Any

from petrobot.coordinator.engine import (
    Abort,
    AddTokens,
    CancelRun,
    ForceExit,
    HoldRun,
    Instruction,
    Mode,
    Override,
    Pause,
    RaiseEvent,
    ReleaseRun,
    RemoveTokens,
    Report,
    Resume,
    RunHeld,
    RunRecorded,
    SetBreakpoints,
    State,
    Step,
    Stimulus,
)
from petrobot.coordinator.operator.emergency_stop import CLEAR, STOP, order_all
from petrobot.coordinator.operator.observation import Shell, TrialWatch, Watching, shown_selectors
from petrobot.coordinator.operator.port import Answer, Controls, Feed, Followed, refusal
from petrobot.coordinator.operator.run_state import ChangePublisher
from petrobot.coordinator.run.interfaces import FirstAlternative
from petrobot.coordinator.run.journal import JournalError
from petrobot.coordinator.run.mission import Stage
from petrobot.coordinator.run.recording import JournalStore, digest, mission_time
from petrobot.coordinator.task import Scope, Task
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.protocol.messages import Feedback

_log = logging.getLogger(__package__)

ANSWERS = 1.5
"""Time for nodes to answer a pause (s)."""
JOURNALED = 6.0
"""Time for the disk to confirm a command (s). With `ANSWERS` it is less than a caller waits."""
_BEFORE = (Stage.CONNECTING, Stage.PREPARING)
_MAY_COME_EARLY = (SetBreakpoints, Override)
"""Commands that only configure the run and move nothing."""


class Shown:
    """What operators see of a run's net and trials. It observes the executor; of a resumed run it
    has seen the recorded steps, too."""

    def __init__(self, feed: Feed, task: Task, directory: Directory, origin: float) -> None:
        """`origin` is the time at which the mission's clock was 0 (s)."""
        where = {name: entry.node for name, entry in directory.actions.items()}
        self.publisher = ChangePublisher(feed, task, where, origin)
        self.trials = TrialWatch(task, directory, feed)


class Operation(Followed):
    """One mission run as its operators see it; `name` is shown in the snapshot."""

    def __init__(
        self,
        shell: Shell,
        selector: FirstAlternative,
        feed: Feed | None = None,
        controls: Controls | None = None,
        *,
        starts: bool = False,
        mode: str = "realtime",
        shown: Shown | None = None,
    ) -> None:
        """`feed` and `controls` belong to a page that outlives this run; `starts` tells whether the
        page can start another one. `shown` is what is known of a resumed run."""
        self.shell = shell
        self.mission = shell.mission
        self.executor = shell.mission.executor
        self.feed = shown.publisher.feed if shown is not None else feed or Feed()
        self.controls = controls or Controls(self.feed)
        self._refusals: list[str] = []
        self._closed = False
        self._unanswered: set[asyncio.Future[Answer]] = set()
        """Answers that wait until their commands are journaled."""
        self._holding: dict[str, str] = {}
        """Runs that have not answered yet whether they hold, each with its node."""
        self._all_held = asyncio.Event()
        self._stopping: asyncio.Task[None] | None = None
        self._live = mode == "realtime"
        store, task, directory = self.executor.store, self.executor.task, self.executor.directory
        # Times on the page are those of the journal, if there is one.
        origin = store.origin if isinstance(store, JournalStore) else shell.now()
        selectors = shown_selectors(task, selector, self.executor.state.overrides)
        if shown is None:
            shown = Shown(self.feed, task, directory, origin)
            shown.publisher.begin(
                self.executor.mission,
                mode,
                starts=starts,
                controls=self.controls.plain(),
                selectors=selectors,
                nodes=dict(self.feed.state["nodes"]),
            )
            self.feed.emit("mission", mission={"state": "preparing"})
            self.executor.observers.append(shown.publisher)
            self.executor.observers.append(shown.trials)
        else:
            for name, about in selectors.items():
                self.feed.emit("selector", name=name, selector=about)
        self.publisher = shown.publisher
        self.watching = Watching(shell, self.feed, selector, origin, lambda: self.feed.watched)
        self.executor.observers.extend([self, self.watching])
        self.feed.clock = self._time

    async def close(self) -> None:
        """Stop asking the nodes."""
        self.feed.clock = None
        self._closed = True
        for answer in tuple(self._unanswered):
            if not answer.done():
                answer.set_result(
                    refusal("journal", "the run ended before this was in its journal")
                )
        if self._stopping is not None:
            await asyncio.gather(self._stopping, return_exceptions=True)
        await self.watching.close()

    def _time(self) -> float:
        """Return the mission's clock (s); before and after the run it stands still."""
        active = self.mission.stage is Stage.RUNNING
        return self.shell.now() - self.publisher.origin if active else self.feed.state["time"]

    # --- an observer of the executor ----------------------------------------------------------

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Note refusals of the engine, for the answer to the command, and runs asked to hold."""
        if isinstance(instruction, Report) and instruction.key == "refused":
            self._refusals.append(instruction.text)
        elif isinstance(instruction, HoldRun):
            self._holding[instruction.run] = self._node_of(instruction.run)
        elif isinstance(instruction, ReleaseRun | CancelRun | RunRecorded):
            self._holding.pop(instruction.run, None)

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Note the answer of a run that was asked to hold."""
        if isinstance(stimulus, RunHeld):
            self._holding.pop(stimulus.run, None)

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Ignore progress."""

    def settled(self, now: float, state: State) -> None:
        """Answer a pause once every run has answered."""
        if self._holding:
            self._all_held.clear()
        else:
            self._all_held.set()

    def _node_of(self, run: str) -> str:
        action = next(r.action for r in self.executor.state.runs() if r.id == run)
        return self.executor.directory.where(action)

    # --- the port -----------------------------------------------------------------------------

    async def command(self, who: str, verb: str, data: Mapping[str, Any]) -> Answer:
        """Carry out a command; return its answer after it is journaled."""
        answer = self.controls.fault(who, verb) or self.controls.carry_out(who, verb, data)
        if answer is not None:
            return answer
        carry_out: Callable[[str, Mapping[str, Any]], Awaitable[Answer]] | None = getattr(
            self, f"_do_{verb}", None
        )
        if carry_out is None:
            return refusal("unknown", f"no command {verb!r} for an active mission run")
        try:
            answer = await carry_out(who, data)
        except (KeyError, TypeError, ValueError) as fault:
            answer = refusal("bad_data", f"{verb}: {fault}")
        if not answer["ok"]:
            _log.info("refused %s of %s: %s", verb, who, answer["text"])
        return answer

    # --- commands that are stimuli ------------------------------------------------------------

    async def _do_pause(self, who: str, data: Mapping[str, Any]) -> Answer:
        paused = self.executor.state.mode is Mode.PAUSED  # then only ask again who holds
        order = self._order(Pause(f"by {who}")) if not paused else self._when_safe({"ok": True})
        answer = await order
        if answer["ok"]:
            with suppress(TimeoutError):
                async with asyncio.timeout(ANSWERS):
                    await self._all_held.wait()
            self._complete_pause()
        return {**answer, "nodes": dict((self.feed.state["paused"] or {}).get("nodes", {}))}

    def _complete_pause(self) -> None:
        """Report the state of every node with devices: `lost` if it did not answer, `idle` if it
        had nothing to hold."""
        paused = self.feed.state["paused"]
        if paused is None:
            return
        directory, late = self.executor.directory, set(self._holding.values())
        owners = {device.node for device in directory.devices.values() if device.driver}
        nodes = {node: "idle" for node in directory.nodes if node in owners} | paused["nodes"]
        nodes |= dict.fromkeys((*late, *(n for n in self.mission.lost if n in nodes)), "lost")
        if nodes != paused["nodes"]:
            self.feed.emit("paused", paused={**paused, "nodes": nodes})

    async def _do_resume(self, who: str, data: Mapping[str, Any]) -> Answer:
        return await self._order(Resume())

    async def _do_step(self, who: str, data: Mapping[str, Any]) -> Answer:
        return await self._order(Step())

    async def _do_abort(self, who: str, data: Mapping[str, Any]) -> Answer:
        return await self.abort(f"by {who}")

    def abort(self, reason: str) -> asyncio.Future[Answer]:
        """Abort the run, regardless of the controls."""
        return self._order(Abort(reason))

    async def _do_breakpoint(self, who: str, data: Mapping[str, Any]) -> Answer:
        name = str(data["element"]).partition(".")[2]
        names = set(self.executor.state.breakpoints)
        (names.add if data.get("on", True) else names.discard)(name)
        return await self._order(SetBreakpoints(tuple(sorted(names))))

    async def _do_add_tokens(self, who: str, data: Mapping[str, Any]) -> Answer:
        return await self._order(AddTokens(str(data["place"]), int(data.get("count", 1))))

    async def _do_remove_tokens(self, who: str, data: Mapping[str, Any]) -> Answer:
        return await self._order(RemoveTokens(str(data["place"]), int(data.get("count", 1))))

    async def _do_raise_event(self, who: str, data: Mapping[str, Any]) -> Answer:
        name = str(data["event"])
        event = self.executor.task.flat.events.get(name)
        if event is None or event.scope is not Scope.EXTERNAL:
            return refusal("refused", f"{name} is not an external event of the task")
        return await self._order(RaiseEvent(name))

    async def _do_force_exit(self, who: str, data: Mapping[str, Any]) -> Answer:
        return await self._order(ForceExit(str(data["transition"])))

    async def _do_override_selector(self, who: str, data: Mapping[str, Any]) -> Answer:
        task, action = str(data["primitive_task"]), data.get("action")
        primitive = self.executor.task.primitive_tasks[task]
        if action is not None and action not in primitive.alternatives:
            return refusal(
                "refused",
                f"{action} is not an alternative of {task}: {', '.join(primitive.alternatives)}",
            )
        return await self._order(Override(task, action or ""))

    async def _do_remark(self, who: str, data: Mapping[str, Any]) -> Answer:
        store, now = self.executor.store, self.shell.now()
        if self.mission.stage is Stage.OVER or self._closed:
            return refusal("idle", "the mission run has finished")
        if not isinstance(store, JournalStore):
            return refusal(
                "no_journal", "this run keeps no journal; start it with --journal FOLDER"
            )
        try:
            remark = store.remark(now, who, data["text"])
            journaled = self._when_safe({"ok": True})
        except JournalError as fault:
            self.shell.fail(fault)
            return refusal("journal", str(fault))
        answer = await journaled
        if answer["ok"]:
            time = round(mission_time(now, self.publisher.origin), 4)
            notice = {"level": "info", "text": remark.told, "at": time}
            self.feed.emit("notice", time=time, notice=notice)
        return answer

    def _order(self, stimulus: Stimulus) -> asyncio.Future[Answer]:
        """Give a stimulus to the engine; its answer comes when it is journaled."""
        refused = self._refused(stimulus)
        if refused is None:
            self._refusals.clear()
            try:
                self.executor.stimulate(self.shell.now(), stimulus)
                said = refusal("refused", self._refusals[0]) if self._refusals else {"ok": True}
                return self._when_safe(said)
            except JournalError as fault:
                self.shell.fail(fault)
                refused = refusal("journal", str(fault))
        answer = asyncio.get_running_loop().create_future()
        answer.set_result(refused)
        return answer

    def _when_safe(self, said: Answer) -> asyncio.Future[Answer]:
        """Return an answer that is given when all until now is journaled, or a disk that does not
        answer is the reason that it is not."""
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[Answer] = loop.create_future()

        def give(given: Answer) -> None:
            if not answer.done():
                answer.set_result(given)

        late = refusal(
            "journal",
            f"the disk of the journal has not answered for {JOURNALED:g} s: this is carried out "
            "when it does, and not before; an emergency stop waits for no disk",
        )
        patience = loop.call_later(JOURNALED, give, late)
        self._unanswered.add(answer)
        answer.add_done_callback(self._unanswered.discard)
        answer.add_done_callback(lambda _: patience.cancel())
        self.executor.when_safe(self.shell.now(), lambda _: give(said))
        self.shell.settle()
        return answer

    def _refused(self, stimulus: Stimulus) -> Answer | None:
        early = self.mission.stage in _BEFORE and isinstance(stimulus, _MAY_COME_EARLY)
        if self._closed:
            return refusal("idle", "the mission run has ended")
        if self.mission.stage is not Stage.RUNNING and not early:
            return refusal("idle", f"the mission run is {self.mission.stage.value}")
        try:
            digest([stimulus])
        except (OverflowError, UnicodeEncodeError) as fault:
            remedy = "a smaller number" if isinstance(fault, OverflowError) else "Unicode text"
            return refusal("bad_data", f"no journal can store this: {fault}; give {remedy}")
        return None

    # --- directly to the nodes ----------------------------------------------------------------

    async def _do_estop(self, who: str, data: Mapping[str, Any]) -> Answer:
        for node in self.mission.callers:
            self.watching.ask(node, STOP)
        journaled = self._order(Abort(f"emergency stop by {who}"))
        self.feed.emit(
            "mission", mission={"state": "stopped", "reason": f"emergency stop by {who}"}
        )
        if self._live and (self._stopping is None or self._stopping.done()):
            self._stopping = asyncio.get_running_loop().create_task(self._stop_again())
        # The stop has left: a slow disk must not make it look as if it had not.
        answer = journaled.result() if journaled.done() else {"ok": True}
        return answer if answer["ok"] or answer["code"] != "idle" else {"ok": True}

    async def _stop_again(self) -> None:
        """Repeat the stop over separate connections: a node that is not connected or frozen is
        stopped over its bus, and the stop is latched."""
        directory = self.executor.directory
        for told in await order_all(directory):
            if not told.done:
                why = told.why or ", ".join(f"{d} {told.devices[d]}" for d in told.open)
                why = why or told.note
                why = f"{told.node}: {why or 'no answer'}"
                text = "; ".join(filter(None, (why, told.bus, told.latch)))
                self.feed.emit(
                    "notice", notice={"level": "error", "text": text, "at": self.feed.state["time"]}
                )

    async def _do_clear_estop(self, who: str, data: Mapping[str, Any]) -> Answer:
        """Let devices accept orders again; this alone moves nothing. Refused with the reason if a
        node still has them stopped."""
        if not self._live:
            for node in self.mission.callers:
                self.watching.ask(node, CLEAR)
            return {"ok": True}
        directory = self.executor.directory
        told = await order_all(directory, CLEAR)
        still = [f"{one.node}: {one.why or 'no answer'}" for one in told if not one.answered]
        return refusal("unreachable", "; ".join(still)) if still else {"ok": True}
