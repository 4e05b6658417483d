"""A permanent coordinator: one page for any number of mission runs, idle until the operator starts
one.

Implements `coordinator.operator.port.MissionPort`. The feed and the controls outlive each run,
which a `RunSession` leads. While no run is active, the station itself handles the states of the
nodes, breakpoints and choices for the next run, and the emergency stop."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from petrobot.coordinator.background import BackgroundProcess
from petrobot.coordinator.learning.estimates_file import EstimatesError
from petrobot.coordinator.operator.emergency_stop import CLEAR, STOP, order_all
from petrobot.coordinator.operator.net_state import picture
from petrobot.coordinator.operator.observation import shown_selectors
from petrobot.coordinator.operator.port import Answer, Controls, Feed, Followed, refusal
from petrobot.coordinator.operator.prepare import RunRequest, prepare, prepare_from
from petrobot.coordinator.operator.run_address import RunAddress
from petrobot.coordinator.operator.run_state import ChangePublisher
from petrobot.coordinator.operator.session import LOCKSTEP, RunSession, import_for_runs
from petrobot.coordinator.operator.start_form import read_start, read_start_from
from petrobot.coordinator.operator.start_from import read_recorded
from petrobot.coordinator.page.task_store import StoreError, TaskStore, TaskText
from petrobot.coordinator.run.folder import JOURNAL
from petrobot.coordinator.run.interfaces import FirstAlternative
from petrobot.coordinator.run.journal import JournalError
from petrobot.coordinator.run.mission import UNSCORED, MissionError
from petrobot.coordinator.run.node_status import ask_all
from petrobot.coordinator.run.realtime import UnreachableError, on_disk
from petrobot.coordinator.run.recording import ReplayError
from petrobot.coordinator.task import Task
from petrobot.coordinator.task.file import TaskFileError, loads
from petrobot.services.comm.location_file import Directory, DirectoryError
from petrobot.services.host.emergency_latch import uptime

_log = logging.getLogger(__package__)

FAULTS = (JournalError, ReplayError, TaskFileError, DirectoryError, EstimatesError, OSError)
"""Exceptions of a start, beside ValueError and KeyError, that mean faulty files."""
LOOK, PATIENCE = 2.0, 1.5
"""Time between requests to idle nodes, and for their answers (s)."""
LAST_WORDS = 10.0
"""Time for a run to end when the station closes (s)."""
FAULTS_TOLD = 3
TICK, STOOD_STILL = 0.1, 0.5
"""Time between two ticks, and the delay of one from which this process counts as frozen (s)."""
ARREARS = 2.0
"""Time after that in which commands are read that may have been given meanwhile (s)."""
OVER = frozenset({"success", "failure", "error", "aborted", "stopped"})
"""States of a mission run that has ended."""


class Station(Followed):
    """The coordinator of one cell; `runs` is the folder of journals, `address` gives the address
    that each run writes to its folder."""

    def __init__(
        self,
        directory: Directory,
        tasks: TaskStore,
        runs: Path,
        mock: Path | None = None,
        estimates: Path = Path("estimates"),
    ) -> None:
        import_for_runs()
        self.directory = directory
        self.feed = Feed()
        self.controls = Controls(self.feed)
        self.address: Callable[[str], RunAddress] | None = None
        self._tasks = tasks
        self._runs, self._mock, self._estimates = runs, mock, estimates
        self._loaded = self._revision = ""
        self._stops: set[str] = set()
        self._choices: dict[str, str] = {}
        self._nodes: Mapping[str, Any] = {}
        self._run: RunSession | None = None
        self._apart = BackgroundProcess()
        self._starting = False
        self._stopped = ""
        """Why nothing may start: the emergency stop that is not cleared; empty without one."""
        self._going: asyncio.Task[None] | None = None
        self._looking = asyncio.get_running_loop().create_task(self._look())
        self._ticked = uptime()
        self._frozen = (0.0, 0.0)
        """From when to when this process was frozen the last time (`uptime`)."""
        self._tick()
        self.feed.replace(
            mission={"id": "", "state": "idle", "mode": "realtime", "starts": True, "file": ""}
        )

    async def close(self) -> None:
        """Abort the active run and close."""
        self._looking.cancel()
        self._ticking.cancel()
        await asyncio.gather(self._looking, self._apart.close(), return_exceptions=True)
        going, run = self._going, self._run
        if going is None or run is None or run.operation is None:
            return
        run.operation.abort("petrobot is ending")
        _, late = await asyncio.wait({going}, timeout=LAST_WORDS)
        for task in late:
            task.cancel()
        await asyncio.gather(going, return_exceptions=True)

    # --- the port -----------------------------------------------------------------------------

    async def command(self, who: str, verb: str, data: Mapping[str, Any]) -> Answer:
        """Carry out a command; pass those about the active run to the run."""
        answer = self.controls.fault(who, verb) or self.controls.carry_out(who, verb, data)
        if answer is not None:
            return answer
        if verb == "estop":
            self._stopped = f"emergency stop by {who}"
        answer = await self._pass_on(who, verb, data)
        if verb == "clear_estop" and answer["ok"]:
            self._stopped = ""
        return answer

    async def _pass_on(self, who: str, verb: str, data: Mapping[str, Any]) -> Answer:
        """Carry out a command about the station or the next run, or let the active run do it."""
        if verb in ("start", "load"):
            return await self._guarded(
                self._start if verb == "start" else self._load, verb, who, data
            )
        if self._run is not None and self._run.operation is not None:
            simulated = self._run.mode == LOCKSTEP
            answer = await self._run.operation.command(who, verb, data)
            if verb == "estop" and simulated:
                return await self._estop(who, data)  # The operator means the real devices, too.
            return answer
        idle: dict[str, Callable[[str, Mapping[str, Any]], Awaitable[Answer]]] = {
            "breakpoint": self._breakpoint,
            "override_selector": self._override,
            "estop": self._estop,
            "clear_estop": self._clear_estop,
        }
        if verb not in idle:
            return refusal("idle", "No mission is running. Choose a task and start it.")
        return await self._guarded(idle[verb], verb, who, data)

    async def _guarded(
        self,
        carry_out: Callable[[str, Mapping[str, Any]], Awaitable[Answer]],
        verb: str,
        who: str,
        data: Mapping[str, Any],
    ) -> Answer:
        try:
            answer = await carry_out(who, data)
        except (KeyError, TypeError, ValueError, *FAULTS) as fault:
            answer = refusal("bad_data", f"{verb}: {fault}")
        if not answer["ok"]:
            _log.info("refused %s of %s: %s", verb, who, answer["text"])
        return answer

    def offers(self) -> Sequence[Mapping[str, Any]]:
        """Return every action that services.toml assigns to a node, and whether the node is up and
        offers it."""
        return offered(
            self.directory,
            lambda action, node: action in self._nodes.get(node, {}).get("offers", ()),
        )

    async def form(self, name: str) -> Mapping[str, Any]:
        """Return the options for starting a task. Raises RefusedError."""
        given = {**self._tasks.folders, "name": name, "estimates": str(self._estimates)}
        said: dict[str, Any] = json.loads(await self._apart.do("form", given))
        return said

    # --- a task, and a run of it --------------------------------------------------------------

    async def _load(self, who: str, data: Mapping[str, Any]) -> Answer:
        """Show a task in its initial marking, so that breakpoints can be set before it is
        started."""
        if (busy := self._busy()) is not None:
            return busy
        try:
            text = self._tasks.read(str(data["task"]))
            task = await asyncio.to_thread(_prepared, text)
        except (StoreError, TaskFileError) as fault:
            return refusal("task", str(fault))
        if (busy := self._busy()) is not None:  # A run was started meanwhile.
            return busy
        self._show(text, task)
        return {"ok": True}

    def _show(self, text: TaskText, task: Task) -> None:
        if text.name != self._loaded:
            self._forget(text.name)
        self._revision = text.revision
        self._publisher(task).begin("", "realtime", **self._kept(task))
        self._tell_file()
        if self._stopped:
            self._tell_stopped()

    def _tell_file(self) -> None:
        self.feed.emit("mission", mission={"file": self._loaded, "revision": self._revision})

    def _tick(self) -> None:
        self._notice_frozen()
        self._ticking = asyncio.get_running_loop().call_later(TICK, self._tick)

    def _notice_frozen(self) -> None:
        before, self._ticked = self._ticked, uptime()
        if self._ticked - before > TICK + STOOD_STILL:
            self._frozen = (before, self._ticked)

    def _ordered(self) -> float:
        """Return when a command that has just been read was given (`uptime`): if this process was
        frozen until now, perhaps already when that began."""
        self._notice_frozen()
        since, until = self._frozen
        return since if self._ticked - until < ARREARS else self._ticked

    async def _start(self, who: str, data: Mapping[str, Any]) -> Answer:
        ordered = self._ordered()
        if self._going is not None and self.feed.state["mission"]["state"] in OVER:
            # It is only closing its connections.
            await asyncio.wait({self._going}, timeout=LAST_WORDS)
        if (busy := self._busy()) is not None:
            return busy
        if self._stopped:
            return refusal("stopped", "the emergency stop is active; clear it first")
        self._starting = True  # No other start may come in between.
        before = {key: self.feed.state["mission"].get(key, "") for key in ("state", "reason")}
        self.feed.emit("mission", mission={"state": "preparing", "reason": ""})
        try:
            return await self._started(data, ordered)
        finally:
            self._starting = False
            if self._run is None and self.feed.state["mission"]["state"] == "preparing":
                self.feed.emit("mission", mission=before)  # It was refused.

    def _busy(self) -> Answer | None:
        if not self._starting and self._run is None:
            return None
        mission = self.feed.state["mission"]
        return refusal(
            "running",
            f"{mission['id'] or 'a mission run'} is active; abort it, or wait for its end",
        )

    async def _started(self, data: Mapping[str, Any], ordered: float) -> Answer:
        if data.get("from") is not None:
            return await self._started_from(data)
        name = str(data.get("task") or self._loaded)
        if not name:
            return refusal("task", "choose a task first")
        try:
            text = self._tasks.read(name)
            task = await asyncio.to_thread(_prepared, text)
        except (StoreError, TaskFileError) as fault:
            return refusal("faults", str(fault))
        seen = data.get("revision") or ("" if data.get("task") else self._revision)
        if seen not in ("", text.revision):
            self._show(text, task)
            return refusal(
                "changed",
                f"{name} was changed by another program after it was shown; the new version is "
                "shown now: start it again",
            )
        if (faulty := await self._faults(text)) is not None:
            return faulty
        if name != self._loaded:
            self._forget(name)
        self._revision = text.revision
        request = replace(self._own(read_start(task, data, self._estimates)), ordered=ordered)
        run = await asyncio.to_thread(prepare, request, task, text.text, self.directory)
        try:
            await run.connect()
        except UnreachableError as fault:
            await run.abandon()
            return {**refusal("unreachable", str(fault)), "nodes": list(fault.nodes)}
        except MissionError as fault:
            await run.abandon()
            return refusal("in_use" if fault.bad_input else "stopped", str(fault))
        return await self._follow(run)

    async def _started_from(self, data: Mapping[str, Any]) -> Answer:
        """Start a simulated run from a point of a recorded one."""
        run = await asyncio.to_thread(self._prepared_from, data)
        task = run.mission.executor.task.name
        # Its file may have been deleted or renamed.
        name = task if task in self._tasks.names() else ""
        if name != self._loaded:
            self._forget(name)
        return await self._follow(run)

    def _prepared_from(self, data: Mapping[str, Any]) -> RunSession:
        name = str(data["from"].get("run", "")) if isinstance(data["from"], Mapping) else ""
        if name not in {path.parent.name for path in self._runs.glob(f"*/{JOURNAL}")}:
            raise ValueError(f"from.run: there is no run {name!r}")
        found = read_recorded(self._runs / name / JOURNAL)
        return prepare_from(self._own(read_start_from(found.task, data), mock=False), found)

    def _own(self, request: RunRequest, *, mock: bool = True) -> RunRequest:
        """Return a request with the settings of all runs of this station."""
        return replace(request, folder=self._runs, mock=self._mock if mock else None)

    async def _faults(self, text: TaskText) -> Answer | None:
        """Return why a task may not run: the findings of the check."""
        offers = {action: entry.node for action, entry in self.directory.actions.items()}
        given = {"text": text.text, "filename": f"{text.name}.toml", "cell": {"offers": offers}}
        found = json.loads(await self._apart.do("findings", given))
        faults = [finding for finding in found if finding["severity"] == "error"]
        if not faults:
            return None
        told = "; ".join(f"{f['key']}: {f['text']}" for f in faults[:FAULTS_TOLD])
        more = f"; and {len(faults) - FAULTS_TOLD} more" if len(faults) > FAULTS_TOLD else ""
        return {**refusal("faults", f"{text.name} may not run: {told}{more}"), "findings": faults}

    async def _follow(self, run: RunSession) -> Answer:
        """Let operators see and control a run, and lead it to its end."""
        if self._stopped:  # given while it was being prepared
            await run.abandon()
            return refusal("stopped", "an emergency stop was given meanwhile; clear it first")
        run.operate(self.feed, self.controls, starts=True, stops=self._stops, choices=self._choices)
        run.address = self.address(run.identity) if self.address is not None else None
        self._tell_file()
        self._run = run
        self._going = asyncio.get_running_loop().create_task(self._to_its_end(run))
        return {"ok": True, "run": run.identity}

    async def _to_its_end(self, run: RunSession) -> None:
        try:
            try:
                await run.lead()
            except MissionError as fault:
                self._tell_error(str(fault), str(fault))
            if unscored := run.mission.remarks.get(UNSCORED):
                self._notice_error(f"no score: {unscored}")
            await on_disk(run.keep_result)
            self.feed.emit("result", result=run.result())
        except Exception as fault:  # An exception in a run must not end the station.
            reason = f"{type(fault).__name__}: {fault}"
            _log.exception("run %s broke", run.identity)
            self._tell_error(reason, f"the mission run failed: {reason}")
        finally:
            self._run = self._going = None

    def _tell_error(self, reason: str, text: str) -> None:
        self.feed.emit("mission", mission={"state": "error", "reason": reason})
        self._notice_error(text)

    def _notice_error(self, text: str) -> None:
        notice = {"level": "error", "text": text, "at": self.feed.state["time"]}
        self.feed.emit("notice", notice=notice)

    def _publisher(self, task: Task) -> ChangePublisher:
        return ChangePublisher(
            self.feed, task, {a: entry.node for a, entry in self.directory.actions.items()}
        )

    def _kept(self, task: Task) -> dict[str, Any]:
        """Return the parts of the snapshot that outlive a mission run."""
        nodes = dict(self.feed.state["nodes"])
        selectors = shown_selectors(task, FirstAlternative(), {})
        return {"nodes": nodes, "controls": self.controls.plain(), "selectors": selectors}

    # --- commands while idle ------------------------------------------------------------------

    def _forget(self, name: str) -> None:
        self._loaded, self._revision = name, ""
        self._stops, self._choices = set(), {}

    async def _breakpoint(self, who: str, data: Mapping[str, Any]) -> Answer:
        """Set breakpoints for the next run."""
        table, _, name = str(data["element"]).partition(".")
        drawn = (self.feed.state["task"] or {}).get(table, ())
        if name not in {element["name"] for element in drawn}:
            return refusal("refused", f"no {data['element']} in the task")
        (self._stops.add if data.get("on", True) else self._stops.discard)(name)
        places = {place["name"] for place in self.feed.state["task"]["places"]}
        named = [
            f"{'places' if stop in places else 'transitions'}.{stop}"
            for stop in sorted(self._stops)
        ]
        self.feed.emit("breakpoints", breakpoints=named)
        return {"ok": True}

    async def _override(self, who: str, data: Mapping[str, Any]) -> Answer:
        """Set choices for the next run."""
        name, action = str(data["primitive_task"]), data.get("action")
        known = self.feed.state["selectors"].get(name)
        if known is None or (
            action is not None and action not in {a["action"] for a in known["alternatives"]}
        ):
            return refusal("refused", f"{action or name} is not an alternative of {name}")
        self._choices.pop(name, None)
        if action is not None:
            self._choices[name] = str(action)
        self.feed.emit("selector", name=name, selector={**known, "override": action})
        return {"ok": True}

    async def _estop(self, who: str, data: Mapping[str, Any]) -> Answer:
        self._tell_stopped()
        return await self._order(STOP)

    def _tell_stopped(self) -> None:
        self.feed.emit("mission", mission={"state": "stopped", "reason": self._stopped})

    async def _clear_estop(self, who: str, data: Mapping[str, Any]) -> Answer:
        """Let devices accept orders again; this alone moves nothing. As long as a node has not
        answered, the cell counts as stopped: its devices still are, and it can be cleared again."""
        answer = await self._order(CLEAR)
        if answer["ok"] and self.feed.state["mission"]["state"] == "stopped":
            self.feed.emit("mission", mission={"state": "idle", "reason": ""})
        return answer

    async def _order(self, verb: str) -> Answer:
        """Send an order directly to the nodes that own devices; report missing answers."""
        told = await order_all(self.directory, verb)
        missing = [
            f"{one.node}: {one.bus or one.why or 'no answer'}" for one in told if not one.answered
        ]
        missing += [f"{one.node}: {one.note}" for one in told if one.note]
        said = [f"{device} {answer}" for one in told for device, answer in one.devices.items()]
        if not all(one.done for one in told):
            return refusal("unreachable", "; ".join([*missing, *said]))
        return {"ok": True, "text": ", ".join(said)}

    # --- states of the nodes ------------------------------------------------------------------

    async def _look(self) -> None:
        """Poll the nodes while no run is active, the first time at once."""
        while True:
            if self._run is None and (self.feed.watched or not self._nodes):
                await self.look()
            await asyncio.sleep(LOOK)

    async def look(self) -> None:
        """Ask every node whether it is up, what it offers, and whether an emergency stop holds its
        devices: one from before this coordinator, or from a terminal."""
        was_stopped = self._stopped
        self._nodes = await ask_all(self.directory, PATIENCE)
        if self._run is not None:
            return  # The active run reports them itself.
        held = [
            device
            for answer in self._nodes.values()
            for device in answer.get("status", {}).get("emergency", ())
        ]
        # If it was cleared meanwhile, the answers may be older than that.
        if held and not was_stopped and not self._stopped:
            self._stopped = f"an emergency stop holds {', '.join(held)}"
            self._tell_stopped()
        for name, answer in self._nodes.items():
            state = (
                {"state": "up", "text": ""}
                if answer["up"]
                else {"state": "lost", "text": answer.get("why") or ""}
            )
            if self.feed.state["nodes"].get(name) != state:
                self.feed.emit("node", name=name, node=state)
                if answer["up"]:
                    _log.info("node %s is up at %s", name, answer["address"])
                else:
                    why = f" ({state['text']})" if state["text"] else ""
                    _log.warning("waiting for node %s at %s%s", name, answer["address"], why)


def _prepared(text: TaskText) -> Task:
    """Return a task with the data derived from it once, which takes long for a large net. Raises
    TaskFileError."""
    task = loads(text.text, f"{text.name}.toml")
    picture(task)
    return task


def offered(directory: Directory, up: Callable[[str, str], bool]) -> list[dict[str, Any]]:
    """Return what the designer may choose from: every action of services.toml; `up(action, node)`
    tells whether it is available now."""
    return [
        {
            "action": name,
            "primitive_task": entry.task or entry.name,
            "node": entry.node,
            "device": entry.device,
            "args": dict(entry.args),
            "up": up(name, entry.node),
        }
        for name, entry in directory.actions.items()
    ]
