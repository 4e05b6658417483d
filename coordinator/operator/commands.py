"""The operator's side of a live mission run: what clients see, and their commands turned into
stimuli.

Implements `coordinator.operator.port.MissionPort` over a mission run in real time. Every command is
a journaled stimulus; who holds the controls is settled here. The emergency stop waits for nobody:
it goes straight to the nodes.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from typing import Any, Protocol

from petrobot.coordinator.engine import (
    Abort,
    AddTokens,
    CancelRun,
    ForceExit,
    HoldRun,
    Instruction,
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
from petrobot.coordinator.operator.controls import Answer, Controls, refusal
from petrobot.coordinator.operator.emergency_stop import CLEAR, STOP, order_all
from petrobot.coordinator.operator.feed import Feed
from petrobot.coordinator.operator.observation import Watching, shown_selectors
from petrobot.coordinator.operator.run_state import Narrator
from petrobot.coordinator.run.interfaces import FirstAlternative
from petrobot.coordinator.run.journal import JournalError
from petrobot.coordinator.run.mission import Mission, Stage
from petrobot.coordinator.run.realtime import credentials_of
from petrobot.services.comm.protocol.messages import Feedback

_log = logging.getLogger(__package__)

ANSWERS = 1.5
"""Seconds that nodes have to answer a pause."""
REFUSED = frozenset({"refused"})
_BEFORE = (Stage.CONNECTING, Stage.PREPARING)
_MAY_COME_EARLY = (SetBreakpoints, Override)
"""What only says how the run shall go, and moves nothing."""


class Shell(Protocol):
    """What drives a mission run, in real time or in lock step."""

    mission: Mission

    def now(self) -> float:
        """The mission's clock (s)."""

    def settle(self) -> None:
        """Something was said: send it, and go on in time."""

    def flush(self, node: str) -> None:
        """Send what was said to a node."""

    def fail(self, fault: Exception) -> None:
        """The run cannot go on: it ends with this fault, and nothing more leaves."""


class Operation:
    """One mission run as its operators see it; `name` shows in the snapshot."""

    def __init__(
        self,
        shell: Shell,
        selector: FirstAlternative,
        feed: Feed | None = None,
        controls: Controls | None = None,
        *,
        starts: bool = False,
        mode: str = "realtime",
    ) -> None:
        """`feed` and `controls` are those of a page that outlives this run; `starts` says that it
        can begin another."""
        self.shell = shell
        self.mission = shell.mission
        self.executor = shell.mission.executor
        self.feed = feed or Feed()
        self.controls = controls or Controls(self.feed)
        self._refusals: list[str] = []
        self._holding: dict[str, str] = {}
        """Runs that were asked to hold and have not answered, each with its node."""
        self._all_held = asyncio.Event()
        self._stopping: asyncio.Task[None] | None = None
        self._live = mode == "realtime"
        began = shell.now()
        where = {name: entry.node for name, entry in self.executor.directory.actions.items()}
        self.narrator = Narrator(self.feed, self.executor.task, where, began)
        self.narrator.begin(
            self.executor.mission,
            mode,
            starts=starts,
            controls=self.controls.plain(),
            selectors=shown_selectors(self.executor.task, selector),
            nodes=dict(self.feed.state["nodes"]),
        )
        if self.executor.state.stimuli:
            self.narrator.adopt(began, self.executor.state)
        self.executor.observers.extend([self.narrator, self])
        self.watching = Watching(shell, self.feed, selector, began, lambda: self.feed.watched)
        self.executor.observers.append(self.watching)

    async def close(self) -> None:
        """Ask the nodes no more."""
        if self._stopping is not None:
            await asyncio.gather(self._stopping, return_exceptions=True)
        await self.watching.close()

    # --- an observer of the executor ----------------------------------------------------------

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Keep what the engine refuses, for the answer to the command; and which runs are asked to
        hold."""
        if isinstance(instruction, Report) and instruction.key in REFUSED:
            self._refusals.append(instruction.text)
        elif isinstance(instruction, HoldRun):
            self._holding[instruction.run] = self._node_of(instruction.run)
        elif isinstance(instruction, ReleaseRun | CancelRun | RunRecorded):
            self._holding.pop(instruction.run, None)

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Note that a run has answered whether it holds."""
        if isinstance(stimulus, RunHeld):
            self._holding.pop(stimulus.run, None)

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Nothing to keep."""

    def settled(self, now: float, state: State) -> None:
        """Let a pause answer once every run has."""
        if self._holding:
            self._all_held.clear()
        else:
            self._all_held.set()

    def _node_of(self, run: str) -> str:
        action = next(r.action for r in self.executor.state.runs() if r.id == run)
        return self.executor.directory.where(action)

    # --- the port -----------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """The state now."""
        return self.feed.snapshot()

    def subscribe(self, receive: Callable[[dict[str, Any]], None]) -> Callable[[], None]:
        """Give every later change to `receive`."""
        return self.feed.subscribe(receive)

    async def command(self, who: str, verb: str, data: Mapping[str, Any]) -> Answer:
        """Carry out a command; answers after it is journaled."""
        answer = self.controls.fault(who, verb) or self.controls.carry_out(who, verb, data)
        if answer is not None:
            return answer
        carry_out: Callable[[str, Mapping[str, Any]], Awaitable[Answer]] | None = getattr(
            self, f"_do_{verb}", None
        )
        if carry_out is None:
            return refusal("unknown", f"no command {verb!r} for a mission run that goes on")
        try:
            answer = await carry_out(who, data)
        except (KeyError, TypeError, ValueError) as fault:
            answer = refusal("bad_data", f"{verb}: {fault}")
        if not answer["ok"]:
            _log.info("refused %s of %s: %s", verb, who, answer["text"])
        return answer

    # --- commands that are stimuli ------------------------------------------------------------

    async def _do_pause(self, who: str, data: Mapping[str, Any]) -> Answer:
        answer = self._order(Pause(f"by {who}"))
        if answer["ok"]:
            with suppress(TimeoutError):
                async with asyncio.timeout(ANSWERS):
                    await self._all_held.wait()
            self._complete_pause()
        return {**answer, "nodes": dict((self.feed.state["paused"] or {}).get("nodes", {}))}

    def _complete_pause(self) -> None:
        """Say of every node with devices how it is: `lost` if it did not answer, `idle` if it had
        nothing to hold."""
        paused = self.feed.state["paused"]
        if paused is None:
            return
        directory, late = self.executor.directory, set(self._holding.values())
        owners = {device.node for device in directory.devices.values() if device.driver}
        nodes = {
            node: "lost" if node in self.mission.lost else "idle"
            for node in directory.nodes
            if node in owners
        }
        nodes |= paused["nodes"] | dict.fromkeys(late, "lost")
        if nodes != paused["nodes"]:
            self.feed.emit("paused", paused={**paused, "nodes": nodes})

    async def _do_resume(self, who: str, data: Mapping[str, Any]) -> Answer:
        return self._order(Resume())

    async def _do_step(self, who: str, data: Mapping[str, Any]) -> Answer:
        return self._order(Step())

    async def _do_abort(self, who: str, data: Mapping[str, Any]) -> Answer:
        return self.abort(f"by {who}")

    def abort(self, reason: str) -> Answer:
        """Give the run up, whoever holds the controls."""
        return self._order(Abort(reason))

    async def _do_breakpoint(self, who: str, data: Mapping[str, Any]) -> Answer:
        name = str(data["element"]).partition(".")[2]
        names = set(self.executor.state.breakpoints)
        (names.add if data.get("on", True) else names.discard)(name)
        return self._order(SetBreakpoints(tuple(sorted(names))))

    async def _do_add_tokens(self, who: str, data: Mapping[str, Any]) -> Answer:
        return self._order(AddTokens(str(data["place"]), int(data.get("count", 1))))

    async def _do_remove_tokens(self, who: str, data: Mapping[str, Any]) -> Answer:
        return self._order(RemoveTokens(str(data["place"]), int(data.get("count", 1))))

    async def _do_raise_event(self, who: str, data: Mapping[str, Any]) -> Answer:
        return self._order(RaiseEvent(str(data["event"])))

    async def _do_force_exit(self, who: str, data: Mapping[str, Any]) -> Answer:
        return self._order(ForceExit(str(data["transition"])))

    async def _do_override_selector(self, who: str, data: Mapping[str, Any]) -> Answer:
        task, action = str(data["primitive_task"]), data.get("action")
        primitive = self.executor.task.primitive_tasks[task]
        if action is not None and action not in primitive.alternatives:
            return refusal(
                "refused",
                f"{action} is no alternative of {task}: {', '.join(primitive.alternatives)}",
            )
        return self._order(Override(task, action or ""))

    def _order(self, stimulus: Stimulus) -> Answer:
        early = self.mission.stage in _BEFORE and isinstance(stimulus, _MAY_COME_EARLY)
        if self.mission.stage is not Stage.RUNNING and not early:
            return refusal("idle", f"the mission run is {self.mission.stage.value}")
        self._refusals.clear()
        try:
            self.executor.stimulate(self.shell.now(), stimulus)
            self.executor.store.sync()
        except JournalError as fault:
            self.shell.fail(fault)
            return refusal("journal", str(fault))
        self.shell.settle()
        return refusal("refused", self._refusals[0]) if self._refusals else {"ok": True}

    # --- straight to the nodes ----------------------------------------------------------------

    async def _do_estop(self, who: str, data: Mapping[str, Any]) -> Answer:
        for node in self.mission.callers:
            self.watching.ask(node, STOP)
        answer = self._order(Abort(f"emergency stop by {who}"))
        self.feed.emit(
            "mission", mission={"state": "stopped", "reason": f"emergency stop by {who}"}
        )
        if self._live and (self._stopping is None or self._stopping.done()):
            self._stopping = asyncio.get_running_loop().create_task(self._stop_again())
        return answer if answer["ok"] or answer["code"] != "idle" else {"ok": True}

    async def _stop_again(self) -> None:
        """The same past this process's own connections: a node that is away or frozen is stopped by
        its bus and latched."""
        directory = self.executor.directory
        for told in await order_all(directory, credentials_of(directory)):
            if not told.answered:
                text = "; ".join(
                    filter(None, (f"{told.node}: {told.why or 'no answer'}", told.bus, told.latch))
                )
                self.feed.emit(
                    "notice", notice={"level": "error", "text": text, "at": self.feed.state["time"]}
                )

    async def _do_clear_estop(self, who: str, data: Mapping[str, Any]) -> Answer:
        """Devices take orders again; nothing moves by that alone. Refused with the reason when a
        node still has them stopped."""
        if not self._live:
            for node in self.mission.callers:
                self.watching.ask(node, CLEAR)
            return {"ok": True}
        directory = self.executor.directory
        told = await order_all(directory, credentials_of(directory), CLEAR)
        still = [f"{one.node}: {one.why or 'no answer'}" for one in told if not one.answered]
        return refusal("unreachable", "; ".join(still)) if still else {"ok": True}
