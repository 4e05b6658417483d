"""Where the runs of one device (or of none) take place in real time: in processes of their own, watched by the node.

A device without cyclic duty has one process, which owns its driver and runs its actions. A cyclic device has two: its driver's,
and its actions'. A run that hangs is ended at its deadline (stop routine first, then its process is killed), one whose process
died ends ERROR with executed = unknown; a dead process is started again, at once and then with a growing pause.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from services.action import Status
from services.child import Child
from services.comm.messages import Executed
from services.device_process import HALT, LINKED
from services.pipe import link_pair
from services.remote import CLEAR_EMERGENCY, EMERGENCY_STOP
from services.runner import GRACE, STOP_LIMIT
from services.runs import Begin, Ended, Hold, Order, Report, Stop, Told, flat, record
from services.worker import COMMAND, FAILED, PING, PONG, READY, STREAM_AT, WANTED, Setup

SILENT = 0.1
"""Seconds without an answer after which a worker counts as hanging, so that its device is stopped without it."""
MARGIN = 0.5
"""Seconds beyond grace and stop limit after which a worker that answers but does not end a run is killed all the same."""
PAUSES = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Seconds before a dead process is started again, by how often it died soon after its start."""
STABLE = 10.0
"""Seconds after which a process counts as well started."""
NOT_READY = 10.0
"""Seconds that a call waits for a process that is being started."""


@dataclass
class _Watched:
    """A run as the node watches it."""

    begin: Begin
    taken: float
    limit: float
    """Deadline on the node's clock."""
    posted: float | None = None
    """When its worker was told."""
    stop: Stop | None = None
    stopped_at: float = math.inf
    pong: bool = False
    halted: bool = False
    killed: bool = False


Spawn = Callable[[Setup, Callable[[list[Any]], None], Callable[[], None], Any], Child]


class WorkerPlace:
    """Implements `services.place.Place` with processes. `changed` is called when something came from one of them."""

    def __init__(
        self,
        setup: Setup,
        *,
        clock: Callable[[], float],
        changed: Callable[[], None],
        wanted: Callable[[str], None],
        spawn: Spawn = Child,
    ) -> None:
        self._setup = setup
        self._clock = clock
        self._changed = changed
        self._wanted = wanted
        self._spawn = spawn
        self._owner: Child | None = None
        """Process of the device's driver; None without a device."""
        self._worker: Child | None = None
        """Process of the actions: the owner itself, unless the driver is cyclic."""
        self._ready = False
        self._cyclic = False
        self.streams: Mapping[str, int] = {}
        """Port at which each stream is received."""
        self.failed = ""
        """Why the device could not be started, empty if it could."""
        self._runs: dict[str, _Watched] = {}
        self._lost: list[Ended] = []
        """Ends that are told when the device is known to stand still."""
        self._halt_due: float | None = None
        self._halts = 0
        self._pings = 0
        self._holds: set[str] = set()
        """Orders to hold that have not been answered."""
        self._frozen_since: float | None = None
        self._reports: list[Report] = []
        self._deaths = 0
        self._started = -math.inf
        self._restart_at: float | None = None
        self._closing = False
        self._emergency = False
        """Whether the device obeys nobody until that is cleared: its next process, too, is told at once."""

    # --- processes ---------------------------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether its processes are up."""
        return self._ready

    def pids(self) -> dict[str, int]:
        """Process ids: `actions`, and `driver` when that has a process of its own."""
        found = {}
        if self._worker is not None:
            found["actions"] = self._worker.pid
        if self._owner is not None and self._owner is not self._worker:
            found["driver"] = self._owner.pid
        return found

    def start(self) -> None:
        """Start what is not running."""
        self._started, self._restart_at = self._clock(), None
        if self._setup.device and self._owner is None:
            self._owner = self._spawn(self._setup, self._heard_owner, self._owner_ended, None)
        elif self._worker is None and (self._cyclic or not self._setup.device):
            # A driver that is only being started gets its worker when it is ready: two of them would take each other's link.
            self._start_worker()

    def _start_worker(self) -> None:
        link = None
        if self._owner is not None:
            link, far = link_pair()
            self._owner.pass_link(far, LINKED)
        self._worker = self._spawn(self._setup, self._heard_worker, self._worker_ended, link)

    def _heard_owner(self, items: list[Any]) -> None:
        if items[0] == READY and items[1]["period"]:
            self._cyclic, self.streams = True, items[1]["streams"]
            if self._emergency and self._owner is not None:
                self._owner.post([COMMAND, EMERGENCY_STOP, EMERGENCY_STOP])
            self._start_worker()
        elif items[0] == READY:
            self._worker, self.streams = self._owner, items[1]["streams"]
            self._become_ready()
        else:
            self._heard(items)
        self._changed()

    def _heard_worker(self, items: list[Any]) -> None:
        if items[0] == READY:
            self._become_ready()
        else:
            self._heard(items)
        self._changed()

    def _become_ready(self) -> None:
        self._ready, self.failed = True, ""
        for run in self._runs.values():
            if run.posted is None:
                self._post_begin(self._clock(), run)

    def _heard(self, items: list[Any]) -> None:
        if items[0] == FAILED:
            # It is about to end: what is ordered now waits for its successor.
            self.failed, self._ready = items[1], False
        elif items[0] == PONG:
            for run in self._runs.values():
                run.pong = run.pong or run.stop is not None
        elif items[0] == WANTED:
            self._wanted(items[1])
        else:
            report = record(items)
            if isinstance(report, Ended):
                if self._runs.pop(report.id, None) is not None:
                    self._reports.append(report)
                    self._release_if_over()
            elif isinstance(report, Told):
                self._told(report)
            else:
                self._reports.append(report)  # type: ignore[arg-type]  # what is no order is a report

    def _worker_ended(self) -> None:
        assert self._worker is not None
        why, self._worker, self._ready = self._worker.describe(), None, False
        self._lose_runs("worker_died", f"the process of its action died: {why}")
        if self._owner is not None and not self._closing:
            self._halts += 1
            self._halt_due = self._clock() + STOP_LIMIT + MARGIN
            self._owner.post([COMMAND, f"{HALT}{self._halts}", HALT])
        else:
            self._tell_lost("")
        self._plan_restart()

    def _owner_ended(self) -> None:
        assert self._owner is not None
        why = self.failed or self._owner.describe()
        alone = self._owner is self._worker or self._worker is None
        self._owner, self._ready, self._cyclic, self.streams = None, False, False, {}
        if alone:
            self._worker = None
            self._lose_runs("worker_died", f"the process of its action died: {why}")
        elif self._worker is not None:
            self._lose_runs("device_died", f"the process of its device's driver died: {why}")
            self._worker.kill()
        self._tell_lost("")
        self._plan_restart()

    def _plan_restart(self) -> None:
        now = self._clock()
        self._deaths = 0 if now - self._started > STABLE else self._deaths + 1
        if not self._closing:
            self._restart_at = now + PAUSES[min(self._deaths, len(PAUSES)) - 1] if self._deaths else now
        self._changed()

    # --- runs --------------------------------------------------------------------------------------------------------

    def _lose_runs(self, cause: str, text: str) -> None:
        """The process of the runs is gone: each that it had been told of ends, with what is known of it."""
        for id_, run in list(self._runs.items()):
            if run.posted is None:
                continue
            del self._runs[id_]
            took = self._clock() - run.posted
            if run.killed and run.stop is not None:
                its_text = f"{run.stop.text}; it did not let go, its process was killed".lstrip("; ")
                self._lost.append(Ended(id_, Status.ERROR, {}, run.stop.cause, its_text, Executed.YES, took))
            else:
                self._lost.append(Ended(id_, Status.ERROR, {}, cause, text, Executed.UNKNOWN, took))

    def _tell_lost(self, note: str) -> None:
        for end in self._lost:
            text = f"{end.text}; {note}" if note else end.text
            self._reports.append(Ended(end.id, end.status, {}, end.cause, text, end.executed, end.seconds))
        self._lost, self._halt_due = [], None
        self._release_if_over()
        self._changed()

    def take(self, now: float, order: Order) -> None:
        """Take an order about a run."""
        if isinstance(order, Begin):
            limit = math.inf if order.deadline is None else now + order.deadline
            self._runs[order.id] = run = _Watched(order, now, limit)
            if self._ready:
                self._post_begin(now, run)
        elif isinstance(order, Stop):
            if order.id in self._runs:
                self._stop(now, self._runs[order.id], order)
        elif self._worker is not None:
            self._worker.post(flat(order))

    def _post_begin(self, now: float, run: _Watched) -> None:
        assert self._worker is not None
        run.posted = now
        self._worker.post(flat(run.begin))

    def _stop(self, now: float, run: _Watched, stop: Stop) -> None:
        if run.stop is not None:
            return
        if run.posted is None or self._worker is None:
            del self._runs[stop.id]
            self._reports.append(Ended(stop.id, Status.ERROR, {}, stop.cause, stop.text, Executed.NO))
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
            self.start()
        if self._halt_due is not None and now >= self._halt_due:
            self._tell_lost("the device is not known to stand still")
        for id_, run in list(self._runs.items()):
            if run.posted is None and now >= min(run.limit, run.taken + NOT_READY):
                del self._runs[id_]
                text = f"its process is not ready: {self.failed or 'it is being started'}"
                self._reports.append(Ended(id_, Status.ERROR, {}, "not_ready", text, Executed.NO))
            elif run.stop is None and now >= run.limit and self._frozen_since is None:
                self._stop(now, run, Stop(id_, "deadline", f"not over after {run.begin.deadline:g} s"))
            elif run.stop is not None:
                self._chase(now, run)

    def _chase(self, now: float, run: _Watched) -> None:
        """A stopped run that does not end: stop its device without it, then kill its process."""
        since = now - run.stopped_at
        if since >= SILENT and not run.pong and not run.halted:
            run.halted = True
            if self._cyclic and self._owner is not None:
                self._owner.post([COMMAND, HALT, HALT])
        patience = GRACE + STOP_LIMIT + MARGIN if run.pong else GRACE
        if since >= patience and not run.killed and self._worker is not None:
            run.killed = True
            self._worker.kill()

    def due(self) -> float | None:
        """When `advance` has something to do at the latest (s)."""
        times = [self._restart_at, self._halt_due]
        for run in self._runs.values():
            if run.posted is None:
                times.append(min(run.limit, run.taken + NOT_READY))
            elif run.stop is None:
                times.append(run.limit if run.limit < math.inf and self._frozen_since is None else None)
            elif not run.killed:
                waits = [GRACE + STOP_LIMIT + MARGIN] if run.pong else [SILENT] * (not run.halted) + [GRACE]
                times.append(run.stopped_at + min(waits))
        return min((t for t in times if t is not None), default=None)

    # --- operator ----------------------------------------------------------------------------------------------------

    def command(self, now: float, id: str, verb: str) -> None:  # noqa: A002
        """Carry out an operator's command in the process that has the driver."""
        if verb in (EMERGENCY_STOP, CLEAR_EMERGENCY):
            self._emergency = verb == EMERGENCY_STOP
        target = self._owner if self._cyclic else self._worker
        if target is None or not (self._ready or self._cyclic):
            data = {"text": self.failed, "runs": list(self._runs), "pids": self.pids()}
            self._reports.append(Told(id, "not ready", data))
            return
        target.post([COMMAND, id, verb])  # first: the device waits for nobody
        if verb in ("stop", EMERGENCY_STOP):
            cause = "stopped" if verb == "stop" else EMERGENCY_STOP
            for run_id, run in list(self._runs.items()):
                self._stop(now, run, Stop(run_id, cause, "by command"))
        elif verb == "hold":
            self._holds.add(id)
        elif verb == "release":
            self._freeze(False)

    def _freeze(self, frozen: bool) -> None:
        """Hold the runs, or let them go on with their deadlines moved by the pause."""
        now = self._clock()
        if frozen and self._frozen_since is None:
            self._frozen_since = now
        elif not frozen and self._frozen_since is not None:
            for run in self._runs.values():
                run.limit += now - self._frozen_since
            self._frozen_since = None
        if self._cyclic and self._worker is not None:
            self._worker.post(flat(Hold(frozen)))

    def _release_if_over(self) -> None:
        """The last of the held runs has ended, its device was stopped: the next one must not find it held."""
        if self._runs or self._frozen_since is None:
            return
        self._freeze(False)
        if self._cyclic and self._owner is not None:
            self._owner.post([COMMAND, "", "release"])

    def _told(self, told: Told) -> None:
        if told.id.startswith(HALT):
            note = "" if told.answer == "stopped" else "the device is not known to stand still"
            self._tell_lost(note)
            return
        if told.id in self._holds:
            self._holds.discard(told.id)
            if told.answer != "cannot hold":
                self._freeze(True)
        data = {**told.data, "runs": list(self._runs), "pids": self.pids()}
        self._reports.append(Told(told.id, told.answer, data))

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
        self._closing, self._restart_at = True, None
        for child in self.children():
            child.leave()

    def children(self) -> list[Child]:
        """Its processes."""
        found = [self._owner, self._worker if self._worker is not self._owner else None]
        return [child for child in found if child is not None]
