"""A mission for tests and measurements: the real engine and the state for viewers, with scripted
actions instead of nodes."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct, field

from petrobot.coordinator.engine import (
    Abort,
    AddTokens,
    ArmTimer,
    Begin,
    CancelRun,
    Choose,
    Chosen,
    DisarmTimer,
    Engine,
    EventOccurred,
    Finished,
    ForceExit,
    Hold,
    HoldRun,
    Instruction,
    Pause,
    RaiseEvent,
    ReleaseRun,
    RemoveTokens,
    Report,
    Resume,
    RunEnded,
    RunHeld,
    RunStarted,
    SetBreakpoints,
    StartRun,
    Step,
    Stimulus,
    StopConfirmed,
    TimerFired,
)
from petrobot.coordinator.operator.port import FREE, Feed
from petrobot.coordinator.operator.run_state import ChangePublisher
from petrobot.coordinator.run.folder import JOURNAL, header
from petrobot.coordinator.run.journal import JournalWriter
from petrobot.coordinator.run.recording import JournalStore
from petrobot.coordinator.task import Executed, Status, Task
from petrobot.coordinator.task.file import TaskFileError, loads
from petrobot.services.comm.protocol.messages import Feedback

BEAT_S = 0.05


class Part(Struct, frozen=True):
    """Script of one run of an action."""

    seconds: float = 0.2
    status: Status = Status.SUCCESS
    cause: str = ""
    text: str = ""
    executed: Executed = Executed.YES
    values: Mapping[str, Any] = field(default_factory=dict)


class _Playing(Struct):
    start: StartRun
    part: Part
    done: float = 0.0
    held: bool = False


class Controls(Struct):
    """Client that holds the controls, and clients that ask for them."""

    holder: str | None = None
    asking: list[str] = field(default_factory=list)

    def plain(self) -> dict[str, Any]:
        """Return the state as in a snapshot."""
        return {"holder": self.holder, "asking": list(self.asking)}


class Stage:
    """A mission port (coordinator.operator.port.MissionPort) that runs tasks of a folder.

    `script` gives the parts of each action, of which the last one repeats; `where` gives the node
    of each action. Time advances in steps of `BEAT_S`, driven by the loop's clock, so a pause
    really stops every run."""

    def __init__(
        self,
        tasks: Path,
        script: Mapping[str, Sequence[Part]],
        where: Mapping[str, str],
        runs: Path | None = None,
    ) -> None:
        self.tasks = tasks
        self.script = {action: deque(parts) for action, parts in script.items()}
        self.where = dict(where)
        self.runs_folder = runs
        self.feed = Feed()
        self.controls = Controls()
        self.commands: list[tuple[str, str, Mapping[str, Any]]] = []
        self.publisher: ChangePublisher | None = None
        self.clock = 0.0
        self._playing: dict[str, _Playing] = {}
        self._timers: dict[str, float] = {}
        self._overrides: dict[str, str] = {}
        self._missions = 0
        self._store: JournalStore | None = None
        self._writer: JournalWriter | None = None
        self._beating: asyncio.Task[None] | None = None
        self._over = True
        self._notes: list[str] = []
        self.on_beat: list[Callable[[float], None]] = []
        self.kept: set[str] = (
            set()
        )  # Actions whose runs stay active until the test removes them from this set.
        nodes = {
            node: {"state": "up", "round_trip": 0.0004} for node in sorted(set(where.values()))
        }
        self.feed.replace(nodes=nodes)

    # --- the port -----------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """Return the current state."""
        return self.feed.snapshot()

    def subscribe(self, receive: Callable[[dict[str, Any]], None]) -> Callable[[], None]:
        """Call the function with every later change."""
        return self.feed.subscribe(receive)

    async def command(self, who: str, verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Carry out a command."""
        self.commands.append((who, verb, data))
        if verb not in FREE and self.controls.holder != who:
            return {"ok": False, "code": "not_holder", "text": "take the controls first"}
        answer: dict[str, Any] = await getattr(self, f"_{verb}")(who, data)
        return answer

    def offers(self) -> list[dict[str, Any]]:
        """Return the offers of the nodes: one alternative for each primitive task, named like the
        task or `task__alternative`."""
        return [
            {
                "action": a,
                "primitive_task": a.partition("__")[0],
                "node": n,
                "device": "",
                "args": {},
                "up": True,
            }
            for a, n in sorted(self.where.items())
        ]

    async def close(self) -> None:
        """Stop the clock."""
        if self._beating is not None:
            self._beating.cancel()
            await asyncio.gather(self._beating, return_exceptions=True)
        if self._writer is not None:
            self._writer.close()

    # --- commands -----------------------------------------------------------------------------

    async def _take_controls(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        if self.controls.holder not in (None, who):
            return {
                "ok": False,
                "code": "held",
                "text": f"{self.controls.holder} holds the controls",
            }
        self.controls.holder = who
        self.controls.asking = [name for name in self.controls.asking if name != who]
        return self._tell_controls()

    async def _ask_controls(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        if who not in self.controls.asking:
            self.controls.asking.append(who)
        return self._tell_controls()

    async def _release_controls(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        if self.controls.holder == who:
            self.controls.holder = (
                data.get("to") if data.get("to") in self.controls.asking else None
            )
            self.controls.asking = [
                name for name in self.controls.asking if name != self.controls.holder
            ]
        return self._tell_controls()

    def _tell_controls(self) -> dict[str, Any]:
        self.feed.emit("controls", controls=self.controls.plain())
        return {"ok": True}

    async def _start(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        if not self._over:
            return {"ok": False, "code": "running", "text": "a mission run is going on"}
        try:
            name = data.get("task") or (self.publisher.task.name if self.publisher else "")
            text = (self.tasks / f"{name}.toml").read_text()
            self.load(loads(text, f"{name}.toml"), text)
        except (OSError, TaskFileError) as fault:
            return {"ok": False, "code": "task", "text": str(fault)}
        self._over = False
        self._stimulate(Begin())
        self._beating = asyncio.create_task(self._beat())
        return {"ok": True}

    async def _pause(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        return {
            **self._order(Pause("")),
            "nodes": dict((self.feed.state["paused"] or {}).get("nodes", {})),
        }

    async def _resume(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        return self._order(Resume())

    async def _step(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        return self._order(Step())

    async def _abort(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        return self._order(Abort("operator"))

    async def _estop(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        if not self._over:
            self._order(Abort("emergency stop"))
        self.feed.emit(
            "mission",
            time=self.clock,
            mission={"state": "stopped", "reason": f"emergency stop by {who}"},
        )
        return {"ok": True}

    async def _breakpoint(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        name = str(data["element"]).partition(".")[2]
        names = (
            set(self.state.breakpoints) | {name}
            if data["on"]
            else set(self.state.breakpoints) - {name}
        )
        return self._order(SetBreakpoints(tuple(sorted(names))))

    async def _add_tokens(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        return self._order(AddTokens(str(data["place"]), int(data.get("count", 1))))

    async def _remove_tokens(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        return self._order(RemoveTokens(str(data["place"]), int(data.get("count", 1))))

    async def _raise_event(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        return self._order(RaiseEvent(str(data["event"])))

    async def _force_exit(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        return self._order(ForceExit(str(data["transition"])))

    async def _override_selector(self, who: str, data: Mapping[str, Any]) -> dict[str, Any]:
        name, action = str(data["primitive_task"]), data.get("action")
        self._overrides.pop(name, None)
        if action:
            self._overrides[name] = str(action)
        selector = {**self.feed.state["selectors"].get(name, {}), "override": action}
        self.feed.emit("selector", time=self.clock, name=name, selector=selector)
        return {"ok": True}

    # --- the engine ---------------------------------------------------------------------------

    def load(self, task: Task, text: str = "") -> None:
        """Load a task, ready to run."""
        self._missions += 1
        self.clock = 0.0
        self._playing, self._timers = {}, {}
        self.engine = Engine(task)
        self.state = self.engine.initial()
        self.publisher = ChangePublisher(self.feed, task, self.where)
        selectors = {
            name: {
                "alternatives": [
                    {"action": a, "probability": 1 / len(p.alternatives)} for a in p.alternatives
                ]
            }
            for name, p in task.primitive_tasks.items()
        }
        kept = {
            "nodes": self.feed.state["nodes"],
            "controls": self.controls.plain(),
            "selectors": selectors,
        }
        mission = f"{task.name}-{self._missions}"
        self.publisher.begin(mission, "realtime", **kept)
        if self.runs_folder is not None and text:
            path = self.runs_folder / mission / JOURNAL
            self._writer = JournalWriter(path, header(mission, text, "", "realtime", {"seed": 1}))
            self._store = JournalStore(self._writer, 0.0)

    def happen(self, event: str, number: int = 0) -> None:
        """Raise an event from outside."""
        self._stimulate(EventOccurred(event, "stage", number))

    def _order(self, stimulus: Stimulus) -> dict[str, Any]:
        if self.publisher is None or (self._over and not isinstance(stimulus, SetBreakpoints)):
            return {"ok": False, "code": "idle", "text": "no mission run is going on"}
        self._notes = []
        self._stimulate(stimulus)
        refused = [note for note in self._notes if note]
        return {"ok": False, "code": "refused", "text": refused[0]} if refused else {"ok": True}

    def _stimulate(self, *stimuli: Stimulus) -> None:
        assert self.publisher is not None
        queue = deque(stimuli)
        while queue:
            stimulus = queue.popleft()
            self.publisher.stimulus(self.clock, stimulus)
            self.state, instructions = self.engine.handle(self.state, stimulus)
            if self._store is not None:
                self._store.append(self.clock, stimulus, instructions, self.state)
            for instruction in instructions:
                self.publisher.instruction(self.clock, instruction)
                queue.extend(self._carry_out(instruction))
            self.publisher.settled(self.clock, self.state)
        if self._store is not None:
            self._store.writer.sync()

    def _carry_out(self, instruction: Instruction) -> list[Stimulus]:
        match instruction:
            case StartRun(run, action=action):
                assert self.kept <= self.where.keys(), "runs are stored by the name of their action"
                self._playing[run] = _Playing(instruction, self._part(action))
                return [RunStarted(run)]
            case CancelRun(run):
                self._playing.pop(run, None)
                return [StopConfirmed(run)]
            case HoldRun(run):
                if run not in self._playing:
                    return []
                self._playing[run].held = True
                return [RunHeld(run, Hold.HELD)]
            case ReleaseRun(run):
                if run in self._playing:
                    self._playing[run].held = False
            case Choose(key, of=of, alternatives=alternatives):
                chosen = self._overrides.get(of, alternatives[0])
                return [
                    Chosen(
                        key,
                        chosen,
                        "operator" if of in self._overrides else "first of the task file",
                    )
                ]
            case ArmTimer(key, seconds=seconds):
                self._timers[key] = self.clock + seconds
            case DisarmTimer(key):
                self._timers.pop(key, None)
            case Report(text=text, key="refused"):
                self._notes.append(text)
            case Finished():
                self._over = True
        return []

    def _part(self, action: str) -> Part:
        parts = self.script.get(action)
        if not parts:
            return Part()
        return parts.popleft() if len(parts) > 1 else parts[0]

    async def _beat(self) -> None:
        loop = asyncio.get_running_loop()
        last = loop.time()
        beats = asyncio.Event()
        while not self._over:
            beats.clear()
            loop.call_later(BEAT_S, beats.set)
            await beats.wait()
            now = loop.time()
            self.clock += now - last  # in a pause, too: then only runs and their deadlines stand
            last = now
            self.advance(BEAT_S)
            for call in self.on_beat:
                call(self.clock)

    def advance(self, seconds: float) -> None:
        """Advance runs and timers by this time."""
        assert self.publisher is not None
        for run, playing in list(self._playing.items()):
            if playing.held:
                continue
            playing.done += seconds
            fraction = min(1.0, playing.done / playing.part.seconds)
            if playing.start.action in self.kept:
                fraction = min(fraction, 0.9)
            if fraction < 1.0:
                self.publisher.progress(self.clock, run, Feedback(run, fraction, {}))
                continue
            del self._playing[run]
            part = playing.part
            self._stimulate(
                RunEnded(
                    run,
                    part.status,
                    part.cause,
                    part.text,
                    part.executed,
                    part.values,
                    part.seconds,
                )
            )
        for key in [k for k, due in self._timers.items() if due <= self.clock]:
            del self._timers[key]
            self._stimulate(TimerFired(key))
