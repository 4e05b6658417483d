"""Where the runs of one device (or runs of none) take place in real time: in processes of their
own, watched by the node.

A device without cyclic duty has one process, which owns its driver and runs its actions. A cyclic
device has two: its driver's, and its actions'. A run that hangs is ended at its deadline (stop
routine first, then its process is killed), one whose process died ends ERROR with executed =
unknown; a dead process is started again, at once and then with a growing pause.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

from petrobot.services.action import Status
from petrobot.services.comm.protocol.messages import Executed
from petrobot.services.device import PICTURE
from petrobot.services.node.child import Child
from petrobot.services.worker.device_process import HALT, LINKED
from petrobot.services.worker.pipe import link_pair
from petrobot.services.worker.process import (
    COMMAND,
    FAILED,
    LINK_LOST,
    NO_MEMORY,
    PING,
    PONG,
    READY,
    STREAM_AT,
    WANTED,
    Setup,
)
from petrobot.services.worker.remote import CLEAR_EMERGENCY, EMERGENCY_STOP
from petrobot.services.worker.runner import GRACE, STOP_LIMIT
from petrobot.services.worker.runs import (
    Begin,
    Ended,
    Hold,
    Order,
    Report,
    Stop,
    Told,
    flat,
    record,
)

_log = logging.getLogger(__name__)

SILENT = 0.1
"""Seconds without an answer after which a worker counts as hanging, so that its device is stopped
without it."""
MARGIN = 0.5
"""Seconds beyond grace and stop limit after which a worker that answers but does not end a run is
killed all the same."""
PAUSES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Seconds before a dead process is started again, by how often it died soon after its start without
ending a run."""
STABLE = 10.0
"""Seconds after which a process counts as well started."""
START_LIMIT = 30.0
"""Seconds that a process has to become ready; then it is killed and started again."""
NOT_READY = 10.0
"""Seconds that a call waits for a process that could not be started; for one that is being started
it waits `START_LIMIT`."""
DRIVER_GONE = 0.25
"""Seconds before actions that have lost the link to their driver are started again: it has most
likely died itself."""
OUT_OF_MEMORY = "out_of_memory"
DONE = {"hold": "held", "release": "released", CLEAR_EMERGENCY: "cleared", PICTURE: PICTURE}
"""What actions without a device answer to a command when no process of theirs has anything to do;
`stopped` to all others."""
DRIVER_DIED = "the process of its device's driver died"


class Stage(Enum):
    """Which processes of a place there are, and what they wait for."""

    DOWN = "none runs; the first is started when its pause is over"
    DRIVER_STARTS = "the process with the device's driver was started and is not ready"
    ACTIONS_DOWN = (
        "a cyclic driver is ready, its actions' process is started when its pause is over"
    )
    ACTIONS_START = "the process of the actions was started and is not ready; a cyclic driver is"
    READY = "runs are taken"
    CLOSED = "the node ends; nothing is started any more"


class Happening(Enum):
    """What moves a place from one stage to the next."""

    START_DRIVER = "a process for the device's driver was started"
    START_ACTIONS = "a process for actions alone was started"
    DRIVER_READY = "a cyclic driver is ready"
    READY = "the process that runs the actions is ready"
    ACTIONS_ENDED = "the process of a cyclic device's actions has ended"
    ALL_ENDED = "the process with the driver has ended, or the only one"
    CLOSE = "the node ends"


NEXT: Mapping[tuple[Stage, Happening], Stage] = {
    (Stage.DOWN, Happening.START_DRIVER): Stage.DRIVER_STARTS,
    (Stage.DOWN, Happening.START_ACTIONS): Stage.ACTIONS_START,
    (Stage.DRIVER_STARTS, Happening.DRIVER_READY): Stage.ACTIONS_DOWN,
    (Stage.DRIVER_STARTS, Happening.READY): Stage.READY,
    (Stage.DRIVER_STARTS, Happening.ALL_ENDED): Stage.DOWN,
    (Stage.ACTIONS_DOWN, Happening.START_ACTIONS): Stage.ACTIONS_START,
    (Stage.ACTIONS_DOWN, Happening.ALL_ENDED): Stage.DOWN,
    (Stage.ACTIONS_START, Happening.READY): Stage.READY,
    (Stage.ACTIONS_START, Happening.ACTIONS_ENDED): Stage.ACTIONS_DOWN,
    (Stage.ACTIONS_START, Happening.ALL_ENDED): Stage.DOWN,
    (Stage.READY, Happening.ACTIONS_ENDED): Stage.ACTIONS_DOWN,
    (Stage.READY, Happening.ALL_ENDED): Stage.DOWN,
    **{(stage, Happening.CLOSE): Stage.CLOSED for stage in Stage},
}
"""Every move. What is not in the table happens only out of turn (a second READY) and moves
nothing."""

STARTING = (Stage.DRIVER_STARTS, Stage.ACTIONS_START)


@dataclass
class _Watched:
    """A run as the node watches it."""

    begin: Begin
    taken: float
    limit: float
    """Deadline on the node's clock."""
    posted: float | None = None
    """When its worker was told."""
    number: int = 0
    """The how-manieth run that this worker was given."""
    stop: Stop | None = None
    stopped_at: float = math.inf
    pong: bool = False
    halted: bool = False
    killed: bool = False


Spawn = Callable[
    [Setup, Callable[[Child, list[list[Any]]], None], Callable[[Child], None], Any], Child
]


@dataclass(frozen=True, slots=True)
class Hosting:
    """What a node gives to a host of runs: a `WorkerPlace`, or a `WorkerPool` of them."""

    setup: Setup
    clock: Callable[[], float]
    """The node's monotonic clock (s)."""
    changed: Callable[[], None]
    """Called when a process has sent something or has ended."""
    wanted: Callable[[str], None]
    """Called with the name of a stream whose receiver's address an action wants."""
    spawn: Spawn = Child
    """Starts a process; tests start none."""


class WorkerPlace:
    """Implements `inline_host.Place` with the processes of one device, or with one process of
    actions that need none."""

    def __init__(self, hosting: Hosting) -> None:
        self._setup = hosting.setup
        self._clock = hosting.clock
        self._changed = hosting.changed
        self._wanted = hosting.wanted
        self._spawn = hosting.spawn
        self._stage = Stage.DOWN
        self._owner: Child | None = None
        """Process of the device's driver; None without a device."""
        self._worker: Child | None = None
        """Process of the actions: the owner itself, unless the driver is cyclic."""
        self.streams: Mapping[str, int] = {}
        """Port at which each stream is received."""
        self.failed = ""
        """Why a process could not be started, empty if it could."""
        self._died = ""
        """How the last process ended; empty once the place is ready again."""
        self._runs: dict[str, _Watched] = {}
        self._lost: list[Ended] = []
        """Ends that are told when the device is known to stand still."""
        self._halt_due: float | None = None
        self._halts = 0
        self._pings = 0
        self._given = 0
        """How many runs the worker was given."""
        self._commands: dict[str, str] = {}
        """Verb of each command that a process has not answered."""
        self._frozen_since: float | None = None
        self._reports: list[Report] = []
        self._deaths = 0
        self._started = -math.inf
        self._restart_at: float | None = None
        self._retiring: Child | None = None
        """A process that was told to leave for lack of memory."""
        self._emergency = False
        """Whether the device obeys nobody until that is cleared: its next process, too, is told at
        once."""

    # --- processes ----------------------------------------------------------------------------

    @property
    def stage(self) -> Stage:
        """Which processes there are."""
        return self._stage

    @property
    def ready(self) -> bool:
        """Whether a run would be taken at once: its processes are up, and none of them is known to
        end."""
        return self._stage is Stage.READY and not self.failed and self._takes_orders()

    def _takes_orders(self) -> bool:
        return (
            self._worker is not None
            and not self._worker.closed
            and not (self._owner and self._owner.closed)
        )

    @property
    def condition(self) -> tuple[str, str]:
        """`up` if a run would be taken, else `starting`, `restarting` or `failed`; and why, empty
        for the first two."""
        if self.ready:
            return "up", ""
        if self.failed:
            return "failed", self.failed
        if self._died or self._deaths or self._stage is Stage.READY:
            return "restarting", self._died or "one of its processes is ending"
        return "starting", ""

    @property
    def busy(self) -> bool:
        """Whether it has taken a run that has not ended."""
        return bool(self._runs or self._lost)

    def pids(self) -> dict[str, int]:
        """Process ids: `actions`, and `driver` when that has a process of its own."""
        found = {}
        if self._worker is not None:
            found["actions"] = self._worker.pid
        if self._owner is not None and self._owner is not self._worker:
            found["driver"] = self._owner.pid
        return found

    def start(self) -> None:
        """Start the first process, unless there is one."""
        if self._stage is Stage.DOWN:
            self._start_due()

    def _start_due(self) -> None:
        """Start the process that is missing in this stage."""
        self._started, self._restart_at = self._clock(), None
        try:
            if self._setup.device and self._stage is Stage.DOWN:
                self._owner = self._spawn(self._setup, self._heard, self._ended, None)
                self._move(Happening.START_DRIVER)
            else:
                self._start_worker()
                self._move(Happening.START_ACTIONS)
        except OSError as fault:
            self.failed = f"its process could not be started: {fault}"
            self._plan_restart()

    def _start_worker(self) -> None:
        link = None
        if self._owner is not None:
            link, far = link_pair()
            self._owner.pass_link(far, LINKED)
        self._worker = self._spawn(self._setup, self._heard, self._ended, link)

    def _move(self, happening: Happening) -> bool:
        """Go to the next stage. False if this comes out of turn, and moves nothing."""
        stage = NEXT.get((self._stage, happening))
        if stage is None:
            return False
        self._stage = stage
        return True

    def _heard(self, child: Child, received: list[list[Any]]) -> None:
        """Take what a process has sent; the last words of a former process do not count."""
        for items in received:
            if child is self._owner or child is self._worker:
                try:
                    self._take_words(child, items)
                except (ValueError, TypeError, IndexError, KeyError, AttributeError):
                    # The user's code has written into the pipe, or a copy of the process has.
                    child.kill("it wrote into its pipe what is no record, and was killed")
        self._changed()

    def _name(self) -> str:
        return self._setup.device or "actions"

    def _take_words(self, child: Child, items: list[Any]) -> None:
        if items[0] == READY:
            self._take_ready(child, items[1])
        elif items[0] == FAILED:
            self.failed = str(
                items[1]
            )  # it is about to end: what is ordered now waits for its successor
        elif items[0] == PONG:
            for run in self._runs.values():
                run.pong = run.pong or run.stop is not None
        elif items[0] == WANTED:
            self._wanted(items[1])
        else:
            report = record(items)
            if isinstance(report, Ended):
                self._take_end(report)
            elif isinstance(report, Told):
                self._told(report)
            else:
                self._reports.append(report)  # type: ignore[arg-type]  # what is no order is a report

    def _take_ready(self, child: Child, data: Mapping[str, Any]) -> None:
        driver = child is self._owner
        if driver and self._stage is Stage.DRIVER_STARTS:
            self.streams = dict(data["streams"])
            if self._emergency:
                child.post([COMMAND, "", EMERGENCY_STOP])
            if self._frozen_since is not None:
                child.post([COMMAND, "", "hold"])
        if driver and data["period"]:
            if self._move(Happening.DRIVER_READY):
                self._start_due()
        elif self._move(Happening.READY):
            self._worker, self._given, self.failed, self._died = child, 0, "", ""
            _log.info("process %d of %s is ready", child.pid, self._name())
            self._post_waiting(self._clock())

    def _post_waiting(self, now: float) -> None:
        if (
            self._frozen_since is not None
            and self._worker is not None
            and self._worker is not self._owner
        ):
            self._worker.post(flat(Hold(True)))  # it was held while it was being started
        for run in self._runs.values():
            if run.posted is None:
                self._post_begin(now, run)

    def _ended(self, child: Child) -> None:
        """A process has ended. That of a former one is no news."""
        if child is self._owner:
            self._all_ended(child)
        elif child is self._worker:
            if self._owner is None:
                self._all_ended(child)
            else:
                self._actions_ended(child)
        self._changed()

    def _actions_ended(self, child: Child) -> None:
        """The actions of a cyclic device: its driver is stopped, and what was lost is told when it
        stands."""
        assert self._owner is not None
        self._worker = None
        self._died = f"the process of its actions died: {child.describe()}"
        self._lose_runs(*_cause_of(child), child.begun)
        if self._move(Happening.ACTIONS_ENDED):
            self._halts += 1
            self._halt_due = self._clock() + STOP_LIMIT + MARGIN
            self._owner.post([COMMAND, f"{HALT}{self._halts}", HALT])
            self._plan_restart(child)
        else:
            self._tell_lost("")

    def _all_ended(self, child: Child) -> None:
        """The process with the driver, or the only one: nothing of this place runs any more."""
        why, worker, was_ready = (
            self.failed or child.describe(),
            self._worker,
            self._stage is not Stage.DRIVER_STARTS,
        )
        driver = child is self._owner and worker is not child and was_ready
        self._owner = self._worker = None
        self.streams = {}
        self._died = f"the process of its {'driver' if driver else 'action'} died: {why}"
        if driver:
            self._lose_runs("device_died", DRIVER_DIED, worker.begun if worker is not None else 0)
            if worker is not None:
                worker.kill()
        else:
            cause, text = _cause_of(child)
            if self.failed:
                text = f"the process of its action died: {why}"
            self._lose_runs(cause, text, child.begun)
        self._answer_commands()
        self._tell_lost(f"driver: {why}" if driver else "")
        if self._move(Happening.ALL_ENDED):
            self._plan_restart(child)

    def _plan_restart(self, child: Child | None = None) -> None:
        """Start again what has ended, or could not be started: the later, the more often that has
        happened of late."""
        now = self._clock()
        if child is not None and child is self._retiring:
            self._retiring = None
        elif (
            child is None or child.code != LINK_LOST
        ):  # one that has lost its driver dies of that one's death
            self._deaths = 0 if now - self._started > STABLE else self._deaths + 1
        pause = PAUSES[min(self._deaths, len(PAUSES)) - 1] if self._deaths else 0.0
        if child is not None and child.code == LINK_LOST:
            pause = max(pause, DRIVER_GONE)
        self._restart_at = now + pause
        why = self.failed or self._died
        _log.warning("%s: %s; starting it again in %g s", self._name(), why, pause)

    # --- runs ---------------------------------------------------------------------------------

    def _take_end(self, end: Ended) -> None:
        if self._runs.pop(end.id, None) is None:
            return
        self._deaths = 0  # the process has done what it is there for
        self._reports.append(end)
        alone = all(run.posted is None for run in self._runs.values())
        if end.cause == OUT_OF_MEMORY and alone and self._worker is not None:
            # What the run has kept would fail the next one, which may need little.
            self._retiring = self._worker
            self._worker.leave()
        self._release_if_over()

    def _end(self, id_: str, cause: str, text: str) -> None:
        """A run that no process was told of ends."""
        del self._runs[id_]
        self._reports.append(Ended(id_, Status.ERROR, {}, cause, text, Executed.NO))
        self._release_if_over()

    def _lose_runs(self, cause: str, text: str, begun: int) -> None:
        """The process of the runs is gone: each that it had begun ends, with what is known of it.
        What it had not begun by then nobody has executed: it waits for the next process, or ends as
        it was stopped."""
        for id_, run in list(self._runs.items()):
            if run.posted is None:
                continue
            if run.number > begun:
                run.posted = None
                if run.stop is not None:
                    self._end(
                        id_,
                        run.stop.cause,
                        f"{run.stop.text}; its process had not begun it".lstrip("; "),
                    )
                continue
            del self._runs[id_]
            took = self._clock() - run.posted
            if run.killed and run.stop is not None:
                how = (
                    "it did not let go"
                    if run.pong
                    else "it blocked its process, which answered nothing"
                )
                its_text = f"{run.stop.text}; {how}; its process was killed".lstrip("; ")
                self._lost.append(
                    Ended(id_, Status.ERROR, {}, run.stop.cause, its_text, Executed.YES, took)
                )
            else:
                executed = Executed.YES if cause == OUT_OF_MEMORY else Executed.UNKNOWN
                self._lost.append(Ended(id_, Status.ERROR, {}, cause, text, executed, took))

    def _tell_lost(self, note: str) -> None:
        for end in self._lost:
            text = f"{end.text}; {note}" if note else end.text
            self._reports.append(
                Ended(end.id, end.status, {}, end.cause, text, end.executed, end.seconds)
            )
        self._lost, self._halt_due = [], None
        self._release_if_over()

    def take(self, now: float, order: Order) -> None:
        """Take an order about a run."""
        if isinstance(order, Begin):
            limit = math.inf if order.deadline is None else now + order.deadline
            self._runs[order.id] = run = _Watched(order, now, limit)
            if self.ready:
                self._post_begin(now, run)
        elif isinstance(order, Stop):
            if order.id in self._runs:
                self._stop(now, self._runs[order.id], order)
        elif self._worker is not None:
            self._worker.post(flat(order))

    def _post_begin(self, now: float, run: _Watched) -> None:
        assert self._worker is not None
        self._given += 1
        run.posted, run.number = now, self._given
        self._worker.post(flat(run.begin))

    def _stop(self, now: float, run: _Watched, stop: Stop) -> None:
        if run.stop is not None:
            return
        if run.posted is None or self._worker is None:
            self._end(stop.id, stop.cause, stop.text)
            return
        run.stop, run.stopped_at = stop, now
        self._pings += 1
        self._worker.post(flat(stop))
        self._worker.post([PING, self._pings])

    idle = False
    """Its processes may say something at any time."""

    def advance(self, now: float) -> None:
        """Start again what died; stop what is over its deadline; kill what hangs."""
        if self._restart_at is not None and now >= self._restart_at:
            self._start_due()
        if self._stage in STARTING and now >= self._started + START_LIMIT:
            self._give_start_up(now)
        if self._halt_due is not None and now >= self._halt_due:
            self._tell_lost("the device is not known to stand still")
        for id_, run in list(self._runs.items()):
            if run.posted is None and now >= self._wait_limit(run):
                why = self.failed or self._died or "it is being started"
                self._end(id_, "not_ready", f"its process is not ready: {why}")
            elif run.stop is None and now >= run.limit and self._frozen_since is None:
                self._stop(
                    now, run, Stop(id_, "deadline", f"not over after {run.begin.deadline:g} s")
                )
            elif run.stop is not None:
                self._chase(now, run)

    def _wait_limit(self, run: _Watched) -> float:
        """Until when a run waits for its process."""
        return min(run.limit, run.taken + (NOT_READY if self.failed else START_LIMIT))

    def _give_start_up(self, now: float) -> None:
        child = self._owner if self._stage is Stage.DRIVER_STARTS else self._worker
        self._started = now  # once more, should even the kill come to nothing
        if child is not None:
            _log.warning("%s: not ready after %g s: killed", self._name(), START_LIMIT)
            child.kill(f"it was not ready after {START_LIMIT:g} s, and was killed")

    def _chase(self, now: float, run: _Watched) -> None:
        """A stopped run that does not end: stop its device without it, then kill its process."""
        since = now - run.stopped_at
        if since >= SILENT and not run.pong and not run.halted:
            run.halted = True
            if self._owner is not None and self._owner is not self._worker:
                self._owner.post([COMMAND, HALT, HALT])
        patience = GRACE + STOP_LIMIT + MARGIN if run.pong else GRACE
        if since >= patience and not run.killed and self._worker is not None:
            run.killed = True
            _log.warning("run %s did not end: its process is killed", run.begin.id)
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
        for run in self._runs.values():
            due = self._due_of(run)
            if due < soonest:
                soonest = due
        return soonest if soonest < math.inf else None

    def _due_of(self, run: _Watched) -> float:
        if run.posted is None:
            return self._wait_limit(run)
        if run.stop is None:
            return run.limit if self._frozen_since is None else math.inf
        if run.killed:
            return math.inf
        if run.pong:
            return run.stopped_at + GRACE + STOP_LIMIT + MARGIN
        return run.stopped_at + (GRACE if run.halted else SILENT)

    # --- operator -----------------------------------------------------------------------------

    def command(self, now: float, id: str, verb: str) -> None:  # noqa: A002
        """Carry out an operator's command in the process that has the driver."""
        if verb in (EMERGENCY_STOP, CLEAR_EMERGENCY):
            self._emergency = verb == EMERGENCY_STOP
        target = self._commanded()
        if target is None:
            self._refuse(id, verb)
        else:
            self._commands[id] = verb
            target.post([COMMAND, id, verb])  # first: the device waits for nobody
        if verb in ("stop", EMERGENCY_STOP):
            cause = "stopped" if verb == "stop" else EMERGENCY_STOP
            for run_id, run in list(self._runs.items()):
                self._stop(now, run, Stop(run_id, cause, "by command"))
        elif verb == "release":
            self._freeze(False)
        elif verb == "hold" and target is None and not self._setup.device:
            self._freeze(True)  # it holds as soon as it is ready, before its runs begin

    def _commanded(self) -> Child | None:
        """The process that carries out commands: the ready driver's, else the worker's."""
        if self._stage in (Stage.DOWN, Stage.DRIVER_STARTS, Stage.CLOSED):
            return None
        found = self._owner or (self._worker if self._stage is Stage.READY else None)
        return found if found is not None and not found.closed else None

    def _refuse(self, id_: str, verb: str) -> None:
        """No process can answer a command."""
        word, why = self.condition
        done = "not ready" if self._setup.device else DONE.get(verb, "stopped")
        answer = word if verb == "status" else done
        self._reports.append(
            Told(id_, answer, {"text": why, "runs": list(self._runs), "pids": self.pids()})
        )

    def _answer_commands(self) -> None:
        """The process that was to answer them has ended."""
        commands, self._commands = self._commands, {}
        for id_, verb in commands.items():
            self._refuse(id_, verb)

    def _freeze(self, frozen: bool) -> None:
        """Hold the runs, or let them go on with their deadlines moved by the pause."""
        now = self._clock()
        if frozen and self._frozen_since is None:
            self._frozen_since = now
        elif not frozen and self._frozen_since is not None:
            for run in self._runs.values():
                run.limit += now - self._frozen_since
            self._frozen_since = None
        if self._worker is not None and self._worker is not self._owner and self._owner is not None:
            self._worker.post(flat(Hold(frozen)))

    def _release_if_over(self) -> None:
        """The last of the held runs has ended, its device was stopped: the next one must not find
        it held."""
        if self._runs or self._frozen_since is None:
            return
        self._freeze(False)
        if self._owner is not None and self._owner is not self._worker:
            self._owner.post([COMMAND, "", "release"])

    def _told(self, told: Told) -> None:
        if told.id.startswith(HALT):
            if (
                self._halt_due is not None and told.id == f"{HALT}{self._halts}"
            ):  # not that of an earlier order
                self._tell_lost(
                    "" if told.answer == "stopped" else "the device is not known to stand still"
                )
            return
        verb = self._commands.pop(told.id, "")
        if verb == "hold" and told.answer != "cannot hold":
            self._freeze(True)
        data, answer = {**told.data, "runs": list(self._runs), "pids": self.pids()}, told.answer
        if verb == "status":
            answer, data["text"] = self.condition
            if answer == "up" and told.data.get("fenced"):
                answer, data["text"] = (
                    "fenced",
                    "the device is not known to stand still after an earlier run",
                )
        self._reports.append(Told(told.id, answer, data))

    def stream_at(self, stream: str, host: str, port: int, ticket: str) -> None:
        """Tell the actions where a stream is received."""
        if self._worker is not None:
            self._worker.post([STREAM_AT, stream, host, port, ticket])

    def reports(self) -> list[Report]:
        """What happened since the last call, in order."""
        reports, self._reports = self._reports, []
        return reports

    def close(self, now: float) -> None:
        """Let the processes end in good order."""
        self._move(Happening.CLOSE)
        self._restart_at = None
        for child in self.children():
            child.leave()

    def children(self) -> list[Child]:
        """Its processes."""
        found = [self._owner, self._worker if self._worker is not self._owner else None]
        return [child for child in found if child is not None]


def _cause_of(child: Child) -> tuple[str, str]:
    """Cause and text of the runs of a process that has ended by itself."""
    if child.code == LINK_LOST:
        return "device_died", DRIVER_DIED
    if child.code == NO_MEMORY:
        return (
            OUT_OF_MEMORY,
            "the memory of its process was used up; see worker_memory_mb in services.toml",
        )
    return "worker_died", f"the process of its action died: {child.describe()}"
