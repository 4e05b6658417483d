"""What operators see beside the net: how nodes and devices are, what cameras see, how old set
points are, what is learned.

Nodes are asked only while somebody looks, a few times a second; what they answer goes to the feed
as plain data.
"""

from __future__ import annotations

import asyncio
from base64 import b64encode
from collections.abc import Callable, Mapping
from math import isfinite
from typing import Any, Protocol

from petrobot.coordinator.engine import Corrected, Instruction, RunRecorded, State, Stimulus
from petrobot.coordinator.operator.feed import Feed
from petrobot.coordinator.run.interfaces import FirstAlternative
from petrobot.coordinator.run.mission import Mission
from petrobot.coordinator.task import Task
from petrobot.services.comm.protocol.messages import Command, Feedback

POLL = 0.2
"""Seconds between questions to a node, each asked only when the one before is answered."""
PATIENCE = 2.0
"""Seconds after which a question that was not answered is asked again."""
CURVE_KEPT = 500
"""Trials that a learning curve shows."""
IN_CURVES = {"probability": "probability", "j": "J"}
"""Figures of the alternatives that have a curve, and how they are called on it."""


def shown_selectors(task: Task, selector: FirstAlternative) -> dict[str, Any]:
    """Every primitive task's alternatives with what is known of them."""
    return {
        name: {"alternatives": shown_alternatives(task, selector, name), "override": None}
        for name in task.primitive_tasks
    }


def shown_alternatives(task: Task, selector: FirstAlternative, name: str) -> list[dict[str, Any]]:
    """The alternatives of one primitive task: {action, probability, reliability, cost, j}, as far
    as known."""
    figures = selector.figures(name)
    return [{"action": a, **figures.get(a, {})} for a in task.primitive_tasks[name].alternatives]


class WatchedShell(Protocol):
    """What drives a mission run: its clock, and the way to the nodes."""

    mission: Mission

    def now(self) -> float:
        """The mission's clock (s)."""

    def flush(self, node: str) -> None:
        """Send what was said to a node."""


class Watching:
    """Asks the nodes and observes the executor for one mission run; `watched` says whether anybody
    looks."""

    def __init__(
        self,
        shell: WatchedShell,
        feed: Feed,
        selector: FirstAlternative,
        origin: float,
        watched: Callable[[], bool],
    ) -> None:
        """`origin` is the shell's time at which the mission's clock was 0 (s)."""
        self._shell = shell
        self._mission = shell.mission
        self._directory = shell.mission.executor.directory
        self._feed = feed
        self._selector = selector
        self._origin = origin
        self._watched = watched
        self._numbers = 0
        self._asked: dict[tuple[str, str], float] = {}
        """When each node was asked what it has not answered yet."""
        self._curves: dict[str, list[dict[str, float]]] = {}
        self._mission.executor.on_status = self._told
        self._polling = asyncio.get_running_loop().create_task(self._poll())

    async def close(self) -> None:
        """Ask the nodes no more."""
        self._polling.cancel()
        await asyncio.gather(self._polling, return_exceptions=True)

    # --- questions ----------------------------------------------------------------------------

    def ask(self, node: str, verb: str) -> None:
        """Send a node an operator's command that is no stimulus: nothing waits for its answer."""
        self._numbers += 1
        now = self._shell.now()
        epoch = self._mission.callers[node].hello.epoch  # a resumed run counts from 1 again
        id_ = f"{self._mission.executor.mission}/{epoch}/operator/{verb}#{self._numbers}"
        self._mission.callers[node].command(now, Command(id_, verb))
        self._shell.flush(node)

    async def _poll(self) -> None:
        owners = {device.node for device in self._directory.devices.values() if device.driver}
        while True:
            for node, caller in self._mission.callers.items():
                self._health(node, caller.up)
                if self._watched() and caller.up:
                    self._question(node, "status")
                    if node in owners:
                        self._question(node, "picture")
            await asyncio.sleep(POLL)

    def _health(self, node: str, up: bool) -> None:
        state = "up" if up else "lost" if node in self._mission.lost else "connecting"
        entry = {"state": state, "text": self._mission.lost.get(node, "")}
        if self._feed.state["nodes"].get(node) != entry:
            self._feed.emit("node", name=node, node=entry)

    def _question(self, node: str, verb: str) -> None:
        """Ask unless an answer is still to come: a node that is busy is not asked ever more."""
        now = asyncio.get_running_loop().time()
        if now - self._asked.get((node, verb), -PATIENCE) >= PATIENCE:
            self._asked[node, verb] = now
            self.ask(node, verb)

    # --- answers ------------------------------------------------------------------------------

    def _told(self, data: Mapping[str, Any]) -> None:
        """A node's answer about its devices: their states, or the pictures of those that see."""
        answers, devices = dict(data.get("answers", {})), dict(data.get("devices", {}))
        for name, about in devices.items():
            entry = self._directory.devices.get(name)
            verb = "picture" if answers.get(name) == "picture" else "status"
            if entry is None or not isinstance(about, Mapping):
                continue
            self._asked.pop((entry.node, verb), None)
            if verb == "picture":
                self._picture(name, about)
            else:
                self._device(name, dict(about.get("state", {})))

    def _picture(self, name: str, picture: Mapping[str, Any]) -> None:
        if isinstance(picture.get("data"), bytes):
            self._feed.emit(
                "image",
                name=name,
                image={**picture, "data": b64encode(picture["data"]).decode("ascii")},
            )

    def _device(self, name: str, state: Mapping[str, Any]) -> None:
        if not state:
            return
        values = {k: v for k, v in state.items() if isinstance(v, bool | int | float | str)}
        device: dict[str, Any] = {"state": str(state.get("mode", "up")), "values": values}
        if isinstance(state.get("q"), list | tuple):
            device["joints"] = [float(angle) for angle in state["q"]]
        self._feed.emit("device", name=name, device=device)
        self._setpoint(name, state.get("setpoint_age"))

    def _setpoint(self, device: str, age: object) -> None:
        """How old the newest set point of the device's stream is, while one is followed."""
        if not isinstance(age, float) or not isfinite(age):
            return
        now = self._shell.now() - self._origin
        for stream in self._directory.streams.values():
            if stream.to == device and age <= 10 * stream.period:
                self._feed.emit(
                    "setpoint", stream=stream.name, samples=[[round(now, 3), round(age, 6)]]
                )

    # --- an observer of the executor: what is learned -----------------------------------------

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Show what was learned of a run's end."""
        if isinstance(instruction, RunRecorded):
            self._learned(instruction.primitive_task)
        elif isinstance(instruction, Corrected):  # no trial more, so nothing is added to the curves
            self._shown(self._mission.executor.task.primitive_task_of(instruction.place).name)

    def _shown(self, name: str) -> list[dict[str, Any]]:
        """Show what is known of the alternatives of a primitive task now."""
        if not self._selector.figures(name):
            return []
        shown = shown_alternatives(self._mission.executor.task, self._selector, name)
        known = self._feed.state["selectors"].get(name, {})
        self._feed.emit("selector", name=name, selector={**known, "alternatives": shown})
        return shown

    def _learned(self, name: str) -> None:
        shown = self._shown(name)
        if len(shown) > 1:
            for figure, word in IN_CURVES.items():
                self._curve(
                    name, figure, word, {a["action"]: a[figure] for a in shown if figure in a}
                )

    def _curve(self, name: str, figure: str, word: str, values: dict[str, float]) -> None:
        """One more trial of a primitive task on one of its curves."""
        key = name if word == "probability" else f"{name}: {word}"
        rows = [*self._curves.get(key, []), values]
        trial = (
            len(rows)
            if len(rows) <= CURVE_KEPT
            else self._feed.state["reports"][key]["columns"][0][-1] + 1
        )
        rows = rows[-CURVE_KEPT:]
        self._curves[key] = rows
        series = sorted({action for row in rows for action in row})
        trials = list(range(trial - len(rows) + 1, trial + 1))
        columns = [trials, *([row.get(action) for row in rows] for action in series)]
        title = f"{name}: {word} of each alternative"
        report = {
            "kind": "curve",
            "title": title,
            "x": "trial",
            "y": word,
            "series": series,
            "columns": columns,
        }
        self._feed.emit("report", name=key, report=report)

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Nothing to show that the narrator does not tell."""

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Nothing to show that the narrator does not tell."""

    def settled(self, now: float, state: State) -> None:
        """Nothing to show that the narrator does not tell."""
