"""The host of runs in real time: the processes of one device, or one process for actions without a
device, watched by the node.

A device whose driver is not cyclic has one process, with its driver and its actions. A cyclic
device has two: one for its driver and one for its actions. A run that hangs is ended at its
deadline: first the stop routine, then its process is killed. A run whose process died ends in ERROR
with executed = unknown. A process that died is started again, at first at once, then after growing
pauses.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from typing import Any

from msgspec import Struct

from petrobot.services.action import Status
from petrobot.services.comm.protocol.messages import (
    SEED,
    Answer,
    Call,
    Cancel,
    Command,
    Event,
    Executed,
    Feedback,
    Message,
    Outcome,
    Ping,
    Pong,
)
from petrobot.services.device import PICTURE
from petrobot.services.node.child import Child
from petrobot.services.node.inline_host import HOLD, RELEASE, answer_of, stopped_by
from petrobot.services.worker.context import Report
from petrobot.services.worker.device_process import HALT, LINKED
from petrobot.services.worker.pipe import Item, link_pair
from petrobot.services.worker.process import (
    DROPPED,
    FAILED,
    LINK_LOST,
    NO_MEMORY,
    OUT_OF_MEMORY,
    READY,
    STREAM_AT,
    WANTED,
    Setup,
)
from petrobot.services.worker.remote import CLEAR_EMERGENCY, EMERGENCY_STOP
from petrobot.services.worker.runner import GRACE, STOP_LIMIT, Order

_log = logging.getLogger(__name__)

SILENT = 0.1
"""Time without an answer after which a worker counts as blocked, and its device is stopped without
it (s)."""
MARGIN = 0.5
"""Time beyond grace and stop limit after which a worker is killed that answers but does not end a
run (s)."""
PAUSES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Pause before a process that died is started again (s), by how often it died soon after its start
without ending a run."""
STABLE = 10.0
"""Time after which a process counts as started (s): if it dies later, the pauses begin again."""
START_LIMIT = 30.0
"""Time in which a process must become ready (s); after that it is killed and started again."""
NOT_READY = 10.0
"""How long a call waits for a process that could not be started (s). For one that is starting it
waits `START_LIMIT`."""
DRIVER_GONE = 0.25
"""Pause before actions that lost the link to their driver are started again (s): most likely the
driver has died, too."""
PATIENCE = 0.005
"""Duration of a run after which the calls behind it in its process are taken back (s), because it
may take long. Also the longest expected wait of a call that is put behind others."""
HAND_OVER = 0.0001
"""What a worker needs for a run beside the action itself, roughly (s)."""
DONE = {"hold": "held", "release": "released", CLEAR_EMERGENCY: "cleared", PICTURE: PICTURE}
"""Answers to a command for actions without a device while none of them runs; to any other command
the answer is `stopped`."""
DRIVER_DIED = "the process of its device's driver died"
HUNG = 5.0
"""Time without an answer after which a process hangs and is killed (s), beside two periods of its
driver. The code of a run may take longer: that is limited by the run's deadline."""


class HostStage(Enum):
    """Which processes of a host there are, and what they wait for."""

    DOWN = "none runs; the first is started when its pause is over"
    DRIVER_STARTS = "the process with the device's driver was started and is not ready"
    ACTIONS_DOWN = (
        "a cyclic driver is ready, its actions' process is started when its pause is over"
    )
    ACTIONS_START = "the process of the actions was started and is not ready; a cyclic driver is"
    READY = "runs are taken"
    CLOSED = "the node ends; nothing is started any more"


class HostEvent(Enum):
    """What moves a host from one stage to the next."""

    START_DRIVER = "a process for the device's driver was started"
    START_ACTIONS = "a process for actions alone was started"
    DRIVER_READY = "a cyclic driver is ready"
    READY = "the process that runs the actions is ready"
    ACTIONS_ENDED = "the process of a cyclic device's actions has ended"
    ALL_ENDED = "the process with the driver has ended, or the only one"
    CLOSE = "the node ends"


NEXT: Mapping[tuple[HostStage, HostEvent], HostStage] = {
    (HostStage.DOWN, HostEvent.START_DRIVER): HostStage.DRIVER_STARTS,
    (HostStage.DOWN, HostEvent.START_ACTIONS): HostStage.ACTIONS_START,
    (HostStage.DRIVER_STARTS, HostEvent.DRIVER_READY): HostStage.ACTIONS_DOWN,
    (HostStage.DRIVER_STARTS, HostEvent.READY): HostStage.READY,
    (HostStage.DRIVER_STARTS, HostEvent.ALL_ENDED): HostStage.DOWN,
    (HostStage.ACTIONS_DOWN, HostEvent.START_ACTIONS): HostStage.ACTIONS_START,
    (HostStage.ACTIONS_DOWN, HostEvent.ALL_ENDED): HostStage.DOWN,
    (HostStage.ACTIONS_START, HostEvent.READY): HostStage.READY,
    (HostStage.ACTIONS_START, HostEvent.ACTIONS_ENDED): HostStage.ACTIONS_DOWN,
    (HostStage.ACTIONS_START, HostEvent.ALL_ENDED): HostStage.DOWN,
    (HostStage.READY, HostEvent.ACTIONS_ENDED): HostStage.ACTIONS_DOWN,
    (HostStage.READY, HostEvent.ALL_ENDED): HostStage.DOWN,
    **{(stage, HostEvent.CLOSE): HostStage.CLOSED for stage in HostStage},
}
"""All transitions between stages. Anything else (a second READY) is ignored."""

STARTING = (HostStage.DRIVER_STARTS, HostStage.ACTIONS_START)
_TAKES_RUNS = HostStage.READY  # looked up once, see `runner.NEW`


class _HostedCall(Struct):
    """A call that the host has. The node's `Callee` watches its deadline."""

    call: Call
    taken: float
    posted: float | None = None
    """When it was written to the worker's pipe (s); None while it waits for a worker."""
    number: int = 0
    """Number of the call among those that were sent to this worker, from 1."""
    ping: int = 0
    """Number of the ping that was sent with the order to stop."""
    cause: str = ""
    """Cause and text of its stop; empty if it was not stopped."""
    text: str = ""
    stopped_at: float = math.inf
    pong: bool = False
    halted: bool = False
    killed: bool = False


Spawn = Callable[[Setup, Callable[[Child, list[Item]], None], Callable[[Child], None], Any], Child]


class Hosting(Struct, frozen=True):
    """What a node gives to a `WorkerHost` or to a `WorkerPool` of them."""

    setup: Setup
    clock: Callable[[], float]
    """The node's monotonic clock (s)."""
    changed: Callable[[bool], None]
    """Called when a process sent something or ended. The argument is True if only results of runs
    arrived, so that nothing else can have changed."""
    wanted: Callable[[str], None]
    """Called with the name of a stream if an action needs its receiver's address."""
    spawn: Spawn = Child
    """Starts a process; replaced in tests."""


class WorkerHost:
    """Implements `inline_host.Host` with the processes of one device, or with one process of
    actions that need none."""

    def __init__(self, hosting: Hosting) -> None:
        self._setup = hosting.setup
        self._clock = hosting.clock
        self._changed = hosting.changed
        self._wanted = hosting.wanted
        self._spawn = hosting.spawn
        self._stage = HostStage.DOWN
        self._owner: Child | None = None
        """Process of the device's driver; None without a device."""
        self._worker: Child | None = None
        """Process of the actions: the owner itself, unless the driver is cyclic."""
        self.streams: Mapping[str, tuple[str, int]] = {}
        """IP address and TCP port of each stream that is received here."""
        self.failed = ""
        """Why a process could not be started, empty if it could."""
        self._died = ""
        """How the last process ended; empty when the host is ready again."""
        self._runs: dict[str, _HostedCall] = {}
        self._lost: list[Outcome] = []
        """Outcomes that are reported when the device is known to stand still."""
        self._halt_due: float | None = None
        self._halts = 0
        self._pings = 0
        self._beaten = -math.inf
        """When its processes were last pinged (s)."""
        self._unanswered: dict[Child, float] = {}
        """Since when a process has not answered (s)."""
        self._period = 0.0
        """Period of its cyclic driver (s)."""
        self._given = 0
        """How many calls were sent to the worker, without those that were taken back."""
        self._withdrawn: set[str] = set()
        """Calls that were taken back and that the worker has not yet dropped: until then it might
        begin one of them with the permit of another call."""
        self._behind = False
        """Whether calls may wait in its process behind another call."""
        self._progress = -math.inf
        """When its worker last became busy or ended a run (s)."""
        self._pace = HAND_OVER
        """How long a run occupies its worker: moving average (s)."""
        self._commands: dict[str, str] = {}
        """Verb of each command that a process has not answered."""
        self._frozen = False
        """Whether its runs are held by the operator."""
        self._reports: list[Report] = []
        self._deaths = 0
        self.restarts = 0
        """How often a process died and was started again."""
        self.last_death = ""
        """How the last of these died."""
        self._started = -math.inf
        self._restart_at: float | None = None
        self._retiring: Child | None = None
        """A process that was ordered to exit because it ran out of memory."""
        self._emergency = False
        """Whether the device is in emergency stop; its next process is notified at its start."""
        self._seed: Command | None = None
        """The newest seed of a device without actions, for its next process."""

    # --- processes ----------------------------------------------------------------------------

    @property
    def stage(self) -> HostStage:
        """Which processes there are."""
        return self._stage

    @property
    def ready(self) -> bool:
        """Whether a run would start at once: its processes are up, and none of them is about to
        end."""
        return (
            self._stage is _TAKES_RUNS
            and not self.failed
            and not self._withdrawn
            and self._worker is not None
            and not self._worker.closed
            and not (self._owner and self._owner.closed)
        )

    @property
    def condition(self) -> tuple[str, str]:
        """`up` if a run would start at once, otherwise `starting`, `restarting` or `failed`; and
        the reason, empty for the first two."""
        if self.ready:
            return "up", ""
        if self.failed:
            return "failed", self.failed
        if self._died or self._deaths or self._stage is HostStage.READY:
            return "restarting", self._died or "one of its processes is ending"
        return "starting", ""

    @property
    def runs(self) -> tuple[str, ...]:
        """Ids of the runs that have not ended."""
        return (*self._runs, *(end.id for end in self._lost))

    @property
    def busy(self) -> bool:
        """Whether it has a run that has not ended."""
        return bool(self._runs or self._lost)

    def wait_of_next(self, now: float) -> float:
        """Return how long a call would wait here for others, estimated from the last runs (s);
        infinite if it should not be given a call."""
        if not self.ready or (self._runs and now >= self._progress + PATIENCE):
            return math.inf
        return len(self._runs) * self._pace

    def pids(self) -> dict[str, int]:
        """Return the process ids: `actions`, and `driver` if that has a process of its own."""
        found = {}
        if self._worker is not None and self._worker.pid:
            found["actions"] = self._worker.pid
        if self._owner is not None and self._owner is not self._worker and self._owner.pid:
            found["driver"] = self._owner.pid
        return found

    def start(self) -> None:
        """Start the first process, unless there is one."""
        if self._stage is HostStage.DOWN:
            self._start_due()

    def _start_due(self) -> None:
        """Start the process that this stage lacks."""
        self._started, self._restart_at = self._clock(), None
        try:
            if self._setup.device and self._stage is HostStage.DOWN:
                self._owner = self._spawn(self._setup, self._heard, self._ended, None)
                self._move(HostEvent.START_DRIVER)
            else:
                self._start_worker()
                self._move(HostEvent.START_ACTIONS)
        except OSError as fault:
            self.failed = f"its process could not be started: {fault}"
            self._plan_restart()

    def _start_worker(self) -> None:
        link = None
        if self._owner is not None:
            link, far = link_pair()
            self._owner.pass_link(far, LINKED)
        self._worker = self._spawn(self._setup, self._heard, self._ended, link)

    def _move(self, happening: HostEvent) -> bool:
        """Go to the next stage. Return False if there is no such transition."""
        stage = NEXT.get((self._stage, happening))
        if stage is None:
            return False
        self._stage = stage
        return True

    def _heard(self, child: Child, received: list[Item]) -> None:
        """Handle what a process sent. Items of a former process are ignored, and of the progress of
        a run only the newest counts: an action may report it in a loop that never waits."""
        self._unanswered.pop(child, None)
        plain_ends = True
        newest = {item.id: item for item in received if type(item) is Feedback}
        for item in received:
            if type(item) is Feedback and newest[item.id] is not item:
                continue
            if type(item) is Outcome:
                plain_ends &= item.cause != OUT_OF_MEMORY
            elif type(item) is not Pong:
                plain_ends = False
            if child is self._owner or child is self._worker:
                try:
                    if isinstance(item, list):
                        self._take_word(child, item)
                    else:
                        self._take_message(child, item)
                except (ValueError, TypeError, IndexError, KeyError, AttributeError):
                    # The user's code has written into the pipe, or a copy of the process has.
                    child.kill("it wrote data into its pipe that is not a message, and was killed")
        self._changed(plain_ends)

    def _name(self) -> str:
        return self._setup.device or "actions"

    def _take_word(self, child: Child, items: list[Any]) -> None:
        if items[0] == READY:
            self._take_ready(child, items[1])
        elif items[0] == FAILED:
            # It is about to end: new orders wait for the next process.
            self.failed = str(items[1])
        elif items[0] == WANTED:
            self._wanted(items[1])
        elif items[0] == DROPPED:
            self._take_dropped(items[1])
        else:
            raise ValueError(f"unknown word {items[0]!r:.80}")

    def _take_message(self, child: Child, message: Message) -> None:
        if isinstance(message, Outcome):
            self._take_end(message)
        elif isinstance(message, Answer):
            self._answered(message)
        elif isinstance(message, Pong):
            for run in self._runs.values() if child is self._worker else ():
                run.pong = run.pong or (run.cause != "" and message.number >= run.ping)
        elif isinstance(message, Event | Feedback | Call | Cancel):
            self._reports.append(message)
        else:
            raise ValueError(f"a process of a node sends no {type(message).__name__}")

    def _take_ready(self, child: Child, data: Mapping[str, Any]) -> None:
        driver = child is self._owner
        if driver and self._stage is HostStage.DRIVER_STARTS:
            self.streams = {name: (host, port) for name, (host, port) in data["streams"].items()}
            self._period = data["period"] or 0.0
            if self._emergency:
                child.post(Command("", EMERGENCY_STOP))
            elif self._died:
                child.post(Command("", "stop"))  # it may still do what the former driver ordered
            if self._frozen:
                child.post(HOLD)
            if self._seed is not None:
                child.post(self._seed)
        if driver and data["period"]:
            if self._move(HostEvent.DRIVER_READY):
                self._start_due()
        elif self._move(HostEvent.READY):
            self._worker, self._given, self.failed, self._died = child, 0, "", ""
            self._withdrawn.clear()
            _log.info("process %d of %s is ready", child.pid, self._name())
            self._post_waiting(self._clock())

    def _post_waiting(self, now: float) -> None:
        if self._frozen and self._worker is not None and self._worker is not self._owner:
            self._worker.post(HOLD)  # it was held while it was being started
        for run in self._runs.values():
            if run.posted is None:
                self._post_call(now, run)

    def _ended(self, child: Child) -> None:
        """Handle the end of a process, unless it is a former one."""
        self._unanswered.pop(child, None)
        if child is self._owner:
            self._all_ended(child)
        elif child is self._worker:
            if self._owner is None:
                self._all_ended(child)
            else:
                self._actions_ended(child)
        self._changed(False)

    def _actions_ended(self, child: Child) -> None:
        """Handle the end of a cyclic device's actions: stop its driver, and report the lost runs
        when the device stands still."""
        assert self._owner is not None
        self._worker = None
        self._died = f"the process of its actions died: {child.describe()}"
        self._lose_runs(*_cause_of(child), child)
        if self._move(HostEvent.ACTIONS_ENDED):
            self._halts += 1
            self._halt_due = self._clock() + STOP_LIMIT + MARGIN
            self._owner.post(Command(f"{HALT}{self._halts}", HALT))
            self._plan_restart(child)
        else:
            self._tell_lost("")

    def _all_ended(self, child: Child) -> None:
        """Handle the end of the driver's process, or of the only one: nothing of this host runs."""
        why, worker, was_ready = (
            self.failed or child.describe(),
            self._worker,
            self._stage is not HostStage.DRIVER_STARTS,
        )
        driver = child is self._owner and worker is not child and was_ready
        self._owner = self._worker = None
        self.streams = {}
        self._died = f"the process of its {'driver' if driver else 'action'} died: {why}"
        if driver:
            self._lose_runs("device_died", DRIVER_DIED, worker)
            if worker is not None:
                worker.kill()
        else:
            cause, text = _cause_of(child)
            if self.failed:
                text = f"the process of its action died: {why}"
            self._lose_runs(cause, text, child)
        self._answer_commands()
        self._tell_lost(f"driver: {why}" if driver else "")
        if self._move(HostEvent.ALL_ENDED):
            self._plan_restart(child)

    def _plan_restart(self, child: Child | None = None) -> None:
        """Plan the restart of what ended or could not be started. The pause grows with the number
        of recent deaths."""
        now = self._clock()
        if child is not None and child is self._retiring:
            self._retiring = None
        elif (
            child is None or child.last_word != LINK_LOST
        ):  # a process that lost its driver does not count: the driver died
            self._deaths = 0 if now - self._started > STABLE else self._deaths + 1
            if child is not None:
                self.restarts += 1
                self.last_death = self.failed or self._died
        pause = PAUSES[min(self._deaths, len(PAUSES)) - 1] if self._deaths else 0.0
        if child is not None and child.last_word == LINK_LOST:
            pause = max(pause, DRIVER_GONE)
        self._restart_at = now + pause
        why = self.failed or self._died
        _log.warning("%s: %s; starting it again in %g s", self._name(), why, pause)

    # --- runs ---------------------------------------------------------------------------------

    def _take_end(self, end: Outcome) -> None:
        if self._runs.pop(end.id, None) is None:
            return
        self._deaths = 0  # the process works
        self._reports.append(end)
        self._progress = self._clock()
        self._pace += (end.seconds + HAND_OVER - self._pace) / 4
        if end.cause == OUT_OF_MEMORY:
            self.withdraw()
            alone = all(run.posted is None for run in self._runs.values())
            if alone and self._worker is not None:
                # The memory that the run still holds would fail the next run, which may need
                # little.
                self._retiring = self._worker
                self._worker.leave()
        self._release_if_over()

    def _end(self, id_: str, cause: str, text: str) -> None:
        """End a run that was not sent to a process."""
        del self._runs[id_]
        self._reports.append(Outcome(id_, Status.ERROR, {}, cause, text, Executed.NO))
        self._release_if_over()

    def withdraw(self) -> None:
        """Take back the calls that its process has not begun; they wait again."""
        self._behind = False
        if self._worker is None or not (count := self._worker.take_back()):
            return
        self._given -= count
        for id_, run in list(self._runs.items()):
            if run.posted is not None and run.number > self._given:
                self._withdrawn.add(id_)
                self._wait_again(id_, run)

    def _wait_again(self, id_: str, run: _HostedCall) -> None:
        """Let a run wait that its process will not begin, or end it if it was stopped."""
        run.posted = None
        if run.cause:
            text = f"{run.text}; its process had not begun it".lstrip("; ")
            self._end(id_, run.cause, text)

    def _take_dropped(self, ids: Iterable[str]) -> None:
        """Handle runs that its process will not begin: they were taken back, or would have to wait
        there for another run."""
        for id_ in ids:
            if id_ in self._withdrawn:
                self._withdrawn.discard(id_)
            elif (run := self._runs.get(id_)) is not None and run.posted is not None:
                self._progress = -math.inf  # its present run takes long
                self._wait_again(id_, run)
        if self.ready:
            for run in self._runs.values():
                if not run.number:  # it came while the worker could not be given any
                    self._post_call(self._clock(), run)

    def hand_over(self) -> list[Call]:
        """Remove and return the calls that a process here did not begin: another host may take
        them."""
        calls = [run.call for run in self._runs.values() if run.number and run.posted is None]
        for call in calls:
            del self._runs[call.id]
        return calls

    def _lose_runs(self, cause: str, text: str, worker: Child | None) -> None:
        """End the runs that a process had begun when it ended. Those that it had not begun were
        never executed: they wait for the next process, or end if they were stopped."""
        begun = self._given - (worker.take_back() if worker is not None else 0)
        self._withdrawn.clear()
        for id_, run in list(self._runs.items()):
            if run.posted is None:
                continue
            if run.number > begun:
                self._wait_again(id_, run)
                continue
            del self._runs[id_]
            took = self._clock() - run.posted
            if run.killed:
                how = (
                    "it ignored the order to stop"
                    if run.pong
                    else "it blocked its process, which answered nothing"
                )
                its_text = f"{run.text}; {how}; its process was killed".lstrip("; ")
                self._lost.append(
                    Outcome(id_, Status.ERROR, {}, run.cause, its_text, Executed.YES, took)
                )
            else:
                executed = Executed.YES if cause == OUT_OF_MEMORY else Executed.UNKNOWN
                self._lost.append(Outcome(id_, Status.ERROR, {}, cause, text, executed, took))

    def _tell_lost(self, note: str) -> None:
        for end in self._lost:
            text = f"{end.text}; {note}" if note else end.text
            self._reports.append(
                Outcome(end.id, end.status, {}, end.cause, text, end.executed, end.seconds)
            )
        self._lost, self._halt_due = [], None
        self._release_if_over()

    def take(self, now: float, order: Order) -> None:
        """Take an order about a run."""
        if isinstance(order, Call):
            self._runs[order.id] = run = _HostedCall(order, now)
            if self.ready:
                self._post_call(now, run)
        elif isinstance(order, Cancel):
            if order.id in self._runs:
                self._stop(now, self._runs[order.id], order)
        elif self._worker is not None:
            self._worker.post(order)

    def _post_call(self, now: float, run: _HostedCall) -> None:
        assert self._worker is not None
        self._given += 1
        run.posted, run.number = now, self._given
        if len(self._runs) == 1:
            self._progress = now
        else:
            self._behind = not self._setup.device
        self._worker.give(run.call)

    def _stop(self, now: float, run: _HostedCall, cancel: Cancel) -> None:
        if run.cause:
            return
        if not self._setup.device:
            self.withdraw()
        cause, _, text = cancel.reason.partition(": ")
        cause = cause or "cancelled"
        if run.posted is None or self._worker is None:
            self._end(cancel.id, cause, text)
            return
        run.cause, run.text, run.stopped_at = cause, text, now
        self._worker.post(cancel)
        run.ping = self._ping(self._worker)

    def _ping(self, child: Child) -> int:
        self._pings += 1
        child.post(Ping(self._pings))
        return self._pings

    def beat(self, now: float) -> None:
        """Ping its processes, which thereby see that the node runs, and kill those that hang."""
        if now - self._beaten > HUNG / 2:
            # This process itself stood still. What the others sent meanwhile is still unread.
            self._unanswered.clear()
        self._beaten = now
        for child in self.children():
            if not child.unsent:  # otherwise it does not read: more would only pile up
                self._ping(child)
            limit = HUNG + 2 * self._period if child is self._owner else HUNG
            if now - self._unanswered.setdefault(child, now) >= limit and self._must_answer(child):
                self._unanswered[child] = now  # try again later if the kill has no effect
                why = f"it did not answer for {HUNG:g} s, and was killed"
                _log.warning("process %d of %s: %s", child.pid, self._name(), why)
                child.kill(why)

    def _must_answer(self, child: Child) -> bool:
        """Whether a process is ready, and no code of a run may be what keeps it from
        answering."""
        if child is not self._worker:
            return self._stage in (HostStage.ACTIONS_DOWN, HostStage.ACTIONS_START, HostStage.READY)
        if self._stage is not HostStage.READY:
            return False
        begun = self._given - child.not_begun()
        return child.frozen or all(
            run.posted is None or run.number > begun for run in self._runs.values()
        )

    @property
    def news(self) -> bool:
        """Whether it has something to report."""
        return bool(self._reports)

    idle = False
    """Its processes may send something at any time."""

    def advance(self, now: float) -> None:
        """Restart what died, and kill what hangs."""
        if self._restart_at is not None and now >= self._restart_at:
            self._start_due()
        if self._stage in STARTING and now >= self._started + START_LIMIT:
            self._give_start_up(now)
        if self._halt_due is not None and now >= self._halt_due:
            self._tell_lost("the device is not known to stand still")
        if now >= self._patience_ends():
            self.withdraw()
        for id_, run in list(self._runs.items()):
            if run.posted is None and now >= self._wait_limit(run):
                why = self.failed or self._died or "it is being started"
                self._end(id_, "not_ready", f"its process is not ready: {why}")
            elif run.cause:
                self._chase(now, run)

    def _patience_ends(self) -> float:
        """Return when the calls that wait in its process are taken back (s)."""
        return self._progress + PATIENCE if self._behind else math.inf

    def _wait_limit(self, run: _HostedCall) -> float:
        """Return until when a run waits for its process (s)."""
        return run.taken + (NOT_READY if self.failed else START_LIMIT)

    def _give_start_up(self, now: float) -> None:
        child = self._owner if self._stage is HostStage.DRIVER_STARTS else self._worker
        self._started = now  # try again later if the kill has no effect
        if child is not None:
            _log.warning("%s: not ready after %g s: killed", self._name(), START_LIMIT)
            child.kill(f"it was not ready after {START_LIMIT:g} s, and was killed")

    def _chase(self, now: float, run: _HostedCall) -> None:
        """Enforce the end of a stopped run: stop its device without it, then kill its process."""
        since = now - run.stopped_at
        if since >= SILENT and not run.pong and not run.halted:
            run.halted = True
            if self._owner is not None and self._owner is not self._worker:
                self._owner.post(Command(HALT, HALT))
        patience = GRACE + STOP_LIMIT + MARGIN if run.pong else GRACE
        if since >= patience and not run.killed and self._worker is not None:
            run.killed = True
            _log.warning("run %s did not end: its process is killed", run.call.id)
            self._worker.kill()

    def due(self) -> float | None:
        """When `advance` has something to do, or there is something to report, at the latest
        (s)."""
        if self._reports:
            return self._clock()
        soonest = math.inf
        if self._restart_at is not None:
            soonest = self._restart_at
        if self._halt_due is not None:
            soonest = min(soonest, self._halt_due)
        if self._stage in STARTING:
            soonest = min(soonest, self._started + START_LIMIT)
        soonest = min(soonest, self._patience_ends())
        for run in self._runs.values():
            due = self._due_of(run)
            if due < soonest:
                soonest = due
        return soonest if soonest < math.inf else None

    def _due_of(self, run: _HostedCall) -> float:
        if run.posted is None:
            return self._wait_limit(run)
        if not run.cause or run.killed:
            return math.inf
        if run.pong:
            return run.stopped_at + GRACE + STOP_LIMIT + MARGIN
        return run.stopped_at + (GRACE if run.halted else SILENT)

    # --- operator -----------------------------------------------------------------------------

    def command(self, now: float, command: Command) -> None:
        """Carry out an operator's command in the process that has the driver."""
        verb = command.verb
        if verb in (EMERGENCY_STOP, CLEAR_EMERGENCY):
            self._emergency = verb == EMERGENCY_STOP
        elif verb == SEED:
            self._seed = command
        target = self._commanded()
        if target is None:
            self._refuse(command.id, verb)
        else:
            self._commands[command.id] = verb
            target.post(command)  # before anything else: the device must not wait
        if verb in ("stop", EMERGENCY_STOP):
            for run_id, run in list(self._runs.items()):
                self._stop(now, run, Cancel(run_id, stopped_by(verb)))
        elif verb == "release":
            self._forget_holds()
            self._freeze(False)
        elif verb == "hold" and target is None and not self._setup.device:
            self._freeze(True)  # it holds as soon as it is ready, before its runs begin

    def _commanded(self) -> Child | None:
        """Return the process that carries out commands: that of the driver if it is ready,
        otherwise the worker."""
        if self._stage in (HostStage.DOWN, HostStage.DRIVER_STARTS, HostStage.CLOSED):
            return None
        found = self._owner or (self._worker if self._stage is HostStage.READY else None)
        return found if found is not None and not found.closed else None

    def _refuse(self, id_: str, verb: str) -> None:
        """Answer a command that no process can answer."""
        word, why = self.condition
        done = "not ready" if self._setup.device else DONE.get(verb, "stopped")
        answer = word if verb == "status" else done
        self._reports.append(answer_of(id_, answer, {"text": why, **self._about()}))

    def _about(self) -> dict[str, Any]:
        """Return what an answer says about its processes and runs."""
        return {
            "runs": list(self._runs),
            "pids": self.pids(),
            "restarts": self.restarts,
            "last_death": self.last_death,
        }

    def _answer_commands(self) -> None:
        """Answer the commands of a process that has ended."""
        commands, self._commands = self._commands, {}
        for id_, verb in commands.items():
            self._refuse(id_, verb)

    def _freeze(self, frozen: bool) -> None:
        """Hold the runs, or release them."""
        self._frozen = frozen
        if self._worker is not None and self._worker is not self._owner and self._owner is not None:
            self._worker.post(HOLD if frozen else RELEASE)

    def _release_if_over(self) -> None:
        """Release the device when the last held run has ended: the next run must not find it
        held."""
        unread = [id_ for id_, verb in self._commands.items() if verb == "hold"]
        if self._runs or not (self._frozen or unread):
            return
        self._freeze(False)
        if self._owner is not None and self._owner is not self._worker:
            self._owner.post(RELEASE)
        elif unread and self._worker is not None:
            # A process that computes reads a hold only after its run. Then this is behind it.
            self._worker.post(RELEASE)
        self._forget_holds()

    def _forget_holds(self) -> None:
        """The answer to a hold that comes after its release holds nothing any more."""
        self._commands = {i: "" if verb == "hold" else verb for i, verb in self._commands.items()}

    def _answered(self, answer: Answer) -> None:
        """Handle a process's answer to a command."""
        word, data = str(answer.data["answer"]), dict(answer.data)
        if answer.id.startswith(HALT):
            # Not the answer to an earlier order.
            if self._halt_due is not None and answer.id == f"{HALT}{self._halts}":
                self._tell_lost(
                    "" if word == "stopped" else "the device is not known to stand still"
                )
            return
        verb = self._commands.pop(answer.id, "")
        if verb == "hold" and word != "cannot hold":
            self._freeze(True)
        data.update(self._about())
        if verb == "status":
            word, data["text"] = self.condition
            if word == "up" and data.get("fenced"):
                word = "fenced"
                data["text"] = "the device is not known to stand still after an earlier run"
        self._reports.append(answer_of(answer.id, word, {**data, "answer": word}))

    def stream_at(self, stream: str, host: str, port: int, ticket: str) -> None:
        """Tell the actions the address of a stream's receiver."""
        if self._worker is not None:
            self._worker.post([STREAM_AT, stream, host, port, ticket])

    def reports(self) -> list[Report]:
        """Return what happened since the last call, in order."""
        reports, self._reports = self._reports, []
        return reports

    def close(self, now: float) -> None:
        """Let the processes end by themselves."""
        self._move(HostEvent.CLOSE)
        self.withdraw()
        self._restart_at = None
        for child in self.children():
            child.leave()

    def children(self) -> list[Child]:
        """Return its processes."""
        found = [self._owner, self._worker if self._worker is not self._owner else None]
        return [child for child in found if child is not None]


def _cause_of(child: Child) -> tuple[str, str]:
    """Return cause and text for the runs of a process that ended by itself."""
    if child.last_word == LINK_LOST:
        return "device_died", DRIVER_DIED
    if child.last_word == NO_MEMORY:
        return (
            OUT_OF_MEMORY,
            "the memory of its process was used up; see worker_memory_mb in services.toml",
        )
    return "worker_died", f"the process of its action died: {child.describe()}"
