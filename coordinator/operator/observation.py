"""What operators see beside the net: states of nodes and devices, camera images, ages of set
points, learning, and what the trials so far say of the whole task.

Nodes are polled a few times a second, only while a client is watching; their answers are published
on the feed as plain data.
"""

from __future__ import annotations

import asyncio
from base64 import b64encode
from collections.abc import Callable, Mapping
from copy import deepcopy
from math import isfinite
from typing import Any, Protocol

from petrobot.coordinator.engine import Corrected, Instruction, Mode, RunRecorded, State, Stimulus
from petrobot.coordinator.learning.statistics import wilson
from petrobot.coordinator.operator.port import Feed
from petrobot.coordinator.run.interfaces import FirstAlternative
from petrobot.coordinator.run.mission import Mission
from petrobot.coordinator.studies.campaign.block import costs
from petrobot.coordinator.studies.campaign.summary import Summary
from petrobot.coordinator.studies.campaign.table import TrialRow
from petrobot.coordinator.studies.campaign.trials import Trial, TrialLog
from petrobot.coordinator.task import Task
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.protocol.messages import Command, Feedback

POLL = 0.2
"""Time between requests to a node (s); each is sent only after the answer to the one before."""
PATIENCE = 2.0
"""Time after which an unanswered request is repeated (s)."""
CURVE_KEPT = 500
"""Number of trials in a learning curve."""
IN_CURVES = {"probability": "probability", "j": "J"}
"""Figures of the alternatives that have a curve, and their names on it."""


def shown_selectors(
    task: Task, selector: FirstAlternative, fixed: Mapping[str, str]
) -> dict[str, Any]:
    """Return every primitive task's alternatives with their estimates, and the one that the
    operator `fixed`."""
    return {
        name: {
            "alternatives": shown_alternatives(task, selector, name),
            "override": fixed.get(name),
        }
        for name in task.primitive_tasks
    }


def shown_alternatives(task: Task, selector: FirstAlternative, name: str) -> list[dict[str, Any]]:
    """Return the alternatives of one primitive task: {action, probability, reliability, cost, j},
    as far as known."""
    figures = selector.figures(name)
    return [{"action": a, **figures.get(a, {})} for a in task.primitive_tasks[name].alternatives]


VERDICT_WITHIN = 100
"""Trials after which a provisional status counts although its verdict has not come."""
RUNS_KEPT = 10_000
"""Most runs of trials that are not over."""
TASK_REPORT = "the whole task"
"""Name of the report about R, C and J of the task."""


class TrialWatch(TrialLog):
    """Shows R, C and J of the whole task as the trials of this run measured them: the definition of
    `learned task` and of campaigns."""

    def __init__(self, task: Task, directory: Directory, feed: Feed) -> None:
        super().__init__(task, costs(task, directory))
        self._task, self._feed, self._shown = task, feed, 0
        self._counted = Summary(task)
        """The trials that are not kept any more: no run of them can change."""
        self._counted.drawn.add("")  # a run has one seed: nothing is compared
        self._full = False

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Record what the trials need of a stimulus."""
        if not self._full:
            super().stimulus(now, stimulus)

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Record what belongs to a trial, unless it has too many runs."""
        if not self._full:
            super().instruction(now, instruction)

    def settled(self, now: float, state: State) -> None:
        """Show the figures after each trial, or with many trials after each further 2 %. Count a
        trial when it can no longer change: what is kept must not grow with the run, and all trials
        counted again would stop this process for seconds."""
        if self._full:
            return
        over = state.mode is Mode.FINISHED
        done = [trial for trial in self.trials if trial.completed or over]
        for trial in done:
            late = trial.k + VERDICT_WITHIN < self.tokens.begun
            if not over and self._may_leave(trial) and (late or all(r.judged for r in trial.runs)):
                self._counted.add(self._row(trial))
                self.forget(trial)
        done = [trial for trial in done if trial.k in self._trials]
        count = self._counted.whole.runs + len(done)
        if count >= self._shown + max(1, self._shown // 50) or (over and count > 0):
            self._shown = count
            found = deepcopy(self._counted, {id(self._task): self._task}) if done else self._counted
            for trial in done:
                found.add(self._row(trial))
            self._show(task_text(found))
        if len(self._entries) > RUNS_KEPT:
            self._full = True
            self._show(
                f"not counted any more: trials with more than {RUNS_KEPT:,} runs are not over"
            )
            self._trials, self._entries, self._ends = {}, {}, {}

    def _may_leave(self, trial: Trial) -> bool:
        """Return whether nothing that is still to come belongs to a trial."""
        return trial.time is not None and trial.k < self.tokens.begun and self.recorded(trial)

    @staticmethod
    def _row(trial: Trial) -> TrialRow:
        return TrialRow(trial.k, "", 0, trial.k, 0, 0.0, trial)

    def _show(self, text: str) -> None:
        report = {"kind": "text", "title": "The task so far", "text": text}
        self._feed.emit("report", name=TASK_REPORT, report=report)


def task_text(found: Summary) -> str:
    """Return goals, R, C and J of the counted trials, each with its 95 % interval."""
    counts, figures = found.whole, found.task_figures()
    parts = []
    if found.task.goal_transitions:
        low, high = wilson(counts.goals, counts.runs)
        parts.append(f"goal met in {counts.goals} of {counts.runs} ({low:.3f} to {high:.3f})")
    for name, what in (("R_conj", "R (every run a success)"), ("C", "C"), ("J", "J")):
        if figures[name] is not None:
            low, high = figures[f"{name}_interval"]
            parts.append(f"{what} {figures[name]:.3g} ({low:.3g} to {high:.3g})")
    if figures["rho"] is not None:
        parts.append(f"rho {figures['rho']:.3g}")
    return f"{counts.runs} trial{'s' * (counts.runs != 1)}: {', '.join(parts)}"


class Shell(Protocol):
    """Interface to the driver of a mission run, in real time or in lock step."""

    mission: Mission

    def now(self) -> float:
        """Return the mission's clock (s)."""

    def settle(self) -> None:
        """Send new messages and continue."""

    def flush(self, node: str) -> None:
        """Send the messages to a node."""

    def fail(self, fault: Exception) -> None:
        """End the run with this fault; nothing more is sent."""


class Watching:
    """Polls the nodes and observes the executor for one mission run; `watched` tells whether a
    client is watching."""

    def __init__(
        self,
        shell: Shell,
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
        """When each node was sent the requests that it has not answered yet."""
        self._curves: dict[str, list[dict[str, float]]] = {}
        self._mission.executor.on_status = self._told
        self._polling = asyncio.get_running_loop().create_task(self._poll())

    async def close(self) -> None:
        """Stop asking the nodes."""
        self._polling.cancel()
        await asyncio.gather(self._polling, return_exceptions=True)

    # --- requests -----------------------------------------------------------------------------

    def ask(self, node: str, verb: str) -> None:
        """Send a node a command that is not a stimulus: nothing waits for its answer."""
        self._numbers += 1
        now = self._shell.now()
        epoch = self._mission.callers[node].hello.epoch  # A resumed run counts from 1 again.
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
        """Send a request unless an answer is outstanding, so that requests to a busy node do not
        pile up."""
        now = asyncio.get_running_loop().time()
        if now - self._asked.get((node, verb), -PATIENCE) >= PATIENCE:
            self._asked[node, verb] = now
            self.ask(node, verb)

    # --- answers ------------------------------------------------------------------------------

    def _told(self, data: Mapping[str, Any]) -> None:
        """Handle a node's answer about its devices: their states, or camera images."""
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
        """Return the age of the newest set point of the device's stream while it is used."""
        if not isinstance(age, float) or not isfinite(age):
            return
        now = self._shell.now() - self._origin
        for stream in self._directory.streams.values():
            if stream.to == device and age <= 10 * stream.period:
                self._feed.emit(
                    "setpoint", stream=stream.name, samples=[[round(now, 3), round(age, 6)]]
                )

    # --- an observer of the executor: learning ------------------------------------------------

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Show what was learned from a run's result."""
        if isinstance(instruction, RunRecorded):
            self._learned(instruction.primitive_task)
        elif isinstance(instruction, Corrected):
            # This is not another trial, so nothing is added to the curves.
            self._shown(self._mission.executor.task.primitive_task_of(instruction.place).name)

    def _shown(self, name: str) -> list[dict[str, Any]]:
        """Show the current estimates of the alternatives of a primitive task."""
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
        """Add a trial of a primitive task to one of its curves."""
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
        """Do nothing: the publisher reports it."""

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Do nothing: the publisher reports it."""

    def settled(self, now: float, state: State) -> None:
        """Do nothing: the publisher reports it."""
