"""The host of a node's actions that use no device: a pool of worker processes, in which each run
has a process to itself.

So an action that blocks, crashes or uses up its memory ends no other run. Workers are started on
demand, and one more waits for the next run, because a process takes time to start. Workers that are
idle for long exit.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from functools import partial

from msgspec import Struct, field
from msgspec.structs import replace

from petrobot.services.action import Status
from petrobot.services.comm.protocol.messages import (
    Answer,
    Call,
    Cancel,
    Command,
    Executed,
    Outcome,
)
from petrobot.services.device import PICTURE
from petrobot.services.node.child import Child
from petrobot.services.node.inline_host import HOLD, answer_of, stopped_by
from petrobot.services.node.worker_host import DONE, PATIENCE, Hosting, HostStage, WorkerHost
from petrobot.services.worker.context import Report
from petrobot.services.worker.remote import EMERGENCY_STOP
from petrobot.services.worker.runner import Order

KEPT = 2
"""Number of idle workers that always stay."""
BUSY_AFTER = 0.5
"""How long a call waits when all workers are busy and no more may be started (s): most runs end
sooner."""
STARTS = max(KEPT, os.cpu_count() or KEPT)
"""Most workers that start at the same time. More would only slow down each other and the active
runs."""
IDLE_LIMIT = 30.0
"""Time after which any further idle worker exits (s)."""


class _GatheredCommand(Struct):
    """A command that several workers carry out."""

    verb: str
    missing: set[int]
    answers: list[str] = field(default_factory=list)


class WorkerPool:
    """Implements `inline_host.Host` for actions without a device, with one `WorkerHost` for each
    worker.

    `most` is the largest number of workers. A run that finds none of them free within
    `BUSY_AFTER` is refused: `busy`, executed = no.
    """

    def __init__(self, hosting: Hosting, most: int) -> None:
        self._hosting = hosting
        self._most = most
        self._workers: dict[int, WorkerHost] = {}
        """By number from 1. The lowest are used first, so a node with little to do always uses the
        same ones."""
        self._leaving: list[WorkerHost] = []
        self._idle_since: dict[int, float] = {}
        self._touched: set[int] = set()
        """Workers that changed since the last step. The others are left alone until they are due,
        so that a step does not take longer the more workers there are."""
        self._due: dict[int, float] = {}
        self._soonest = math.inf
        self._streams: dict[str, set[int]] = {}
        """By stream: workers that need its receiver's address."""
        self._commands: dict[str, _GatheredCommand] = {}
        self._waiting: dict[str, tuple[float, Call]] = {}
        """Calls that wait for a worker, and until when (s)."""
        self._held = False
        self._queued = False
        """Whether a call was put behind another one since the last call of `due`."""
        self._reports: list[Report] = []
        self.streams: Mapping[str, tuple[str, int]] = {}
        """Actions without a device receive no stream."""

    # --- workers ------------------------------------------------------------------------------

    @property
    def ready(self) -> bool:
        """Whether a worker is up."""
        return any(worker.ready for worker in self._workers.values())

    @property
    def failed(self) -> str:
        """Why a worker could not be started; empty if one is up or none failed."""
        return (
            "" if self.ready else next((w.failed for w in self._workers.values() if w.failed), "")
        )

    @property
    def condition(self) -> tuple[str, str]:
        """`up` if a run would start at once, otherwise `busy`, `starting`, `restarting` or
        `failed`; and the reason."""
        if self._idle() or len(self._workers) < self._most:
            return (
                ("up", "")
                if self.ready
                else next((w.condition for w in self._workers.values()), ("starting", ""))
            )
        return "busy", self._full()

    def _full(self) -> str:
        return f"all {self._most} workers run an action; see `workers` of the node in services.toml"

    def pids(self) -> dict[str, int]:
        """Return the process ids: `actions` of the first worker, `actions 2` of the second, ..."""
        found = {}
        for number, worker in sorted(self._workers.items()):
            for name, process in worker.pids().items():
                found[name if number == 1 else f"{name} {number}"] = process
        return found

    def start(self) -> None:
        """Start the first worker, unless there is one."""
        if not self._workers:
            self._add()

    def _add(self) -> int:
        number = next(n for n in range(1, self._most + 1) if n not in self._workers)
        hosting = replace(
            self._hosting,
            changed=partial(self._touch, number),
            wanted=partial(self._want, number),
        )
        self._workers[number] = WorkerHost(hosting)
        self._workers = dict(sorted(self._workers.items()))
        self._touched.add(number)
        self._workers[number].start()
        return number

    def _touch(self, number: int, plain_ends: bool) -> None:
        self._touched.add(number)
        # A call that waits for a free worker needs a whole step now.
        self._hosting.changed(plain_ends and not self._waiting)

    def _idle(self) -> list[int]:
        """Return the workers without a run: first the ready ones, then those that are starting,
        then those that wait for a restart."""
        idle = [number for number, worker in self._workers.items() if not worker.busy]
        return sorted(idle, key=lambda number: (self._rank(number), number))

    def _rank(self, number: int) -> int:
        worker = self._workers[number]
        return 0 if worker.ready else 1 if worker.stage is HostStage.ACTIONS_START else 2

    def children(self) -> list[Child]:
        """Return its processes, including those that were ordered to exit."""
        return [
            child
            for worker in (*self._workers.values(), *self._leaving)
            for child in worker.children()
        ]

    def beat(self, now: float) -> None:
        """Ping the processes, and kill those that hang."""
        for worker in self._workers.values():
            worker.beat(now)

    # --- runs ---------------------------------------------------------------------------------

    def take(self, now: float, order: Order) -> None:
        """Take an order about a run."""
        if isinstance(order, Call):
            self._begin(now, order)
        elif isinstance(order, Cancel | Outcome):
            # The id of a call that a run makes is that of the run, a slash and a number.
            run = order.id if isinstance(order, Cancel) else order.id.rpartition("/")[0]
            if isinstance(order, Cancel) and run in self._waiting:
                self._stop_waiting(run, *order.reason.partition(": ")[::2])
            for number, worker in self._workers.items():
                if run in worker.runs:
                    self._touched.add(number)
                    worker.take(now, order)

    def _starting(self) -> int:
        """Return how many workers are starting: waiting calls may use them."""
        return sum(w.stage is HostStage.ACTIONS_START for w in self._workers.values())

    def _may_add(self) -> bool:
        return len(self._workers) < self._most and self._starting() < STARTS

    def _stop_waiting(self, id_: str, cause: str, text: str) -> None:
        del self._waiting[id_]
        self._reports.append(Outcome(id_, Status.ERROR, {}, cause, text, Executed.NO))

    def _begin(self, now: float, call: Call) -> None:
        number = self._choose(now)
        if number is None:
            self._waiting.setdefault(call.id, (now + BUSY_AFTER, call))
            self._queued = True
            return
        self._waiting.pop(call.id, None)
        self._touched.add(number)
        if self._held:
            self._workers[number].command(now, HOLD)
        self._workers[number].take(now, call)
        for worker in self._workers.values():
            if not worker.busy:
                return
        if self._may_add():
            self._add()

    @property
    def runs(self) -> list[str]:
        """Ids of the runs that have not ended."""
        return [*self._waiting, *(run for one in self._workers.values() for run in one.runs)]

    def _choose(self, now: float) -> int | None:
        """Return the number of the worker for the next run, which is started if necessary; None at
        the limit.

        While runs are short, a call waits a moment behind others in one of the first workers: a
        process that is awake reads many calls at once, and its caches are warm. As soon as a run
        takes longer, the calls behind it are taken back and given to other workers.
        """
        best, shortest, found = 0, math.inf, 0
        for number, worker in self._workers.items():
            wait = worker.wait_of_next(now)
            if wait < shortest:
                best, shortest = number, wait
            found += wait < math.inf
            if wait == 0.0 or (found >= KEPT and shortest < PATIENCE):
                break
        if shortest < PATIENCE:
            self._queued |= shortest > 0.0
            return best
        idle = self._idle()
        # A worker that waits for a restart is the last choice: that may take long.
        if (not idle or self._rank(idle[0]) == 2) and self._may_add():
            return self._add()
        return idle[0] if idle else None

    @property
    def news(self) -> bool:
        """Whether it needs a step before a process sends anything: a run was refused, or calls wait
        behind others."""
        return bool(self._reports) or self._queued

    idle = False
    """Its processes may send something at any time."""

    def advance(self, now: float) -> None:
        """Do all that is due, and close workers that are not needed any more."""
        if now >= self._soonest:
            self._touched.update(number for number, due in self._due.items() if now >= due)
        for number in tuple(self._touched):
            if number in self._workers:
                self._workers[number].advance(now)
        for number in tuple(self._touched):
            if number in self._workers:
                for call in self._workers[number].hand_over():
                    self._begin(now, call)
        for id_, (until, call) in list(self._waiting.items()):
            self._begin(now, call)
            if id_ in self._waiting and now >= until and not self._starting():
                self._stop_waiting(id_, "busy", self._full())
        if self._leaving:
            self._leaving = [worker for worker in self._leaving if worker.children()]
        if self._idle_since or len(self._workers) > KEPT:
            self._retire(now)

    def _retire(self, now: float) -> None:
        """Close workers that have been idle for long; the `KEPT` lowest idle ones stay."""
        before = self._idle_since
        spare = sorted(number for number, worker in self._workers.items() if not worker.busy)[KEPT:]
        self._idle_since = {number: before.get(number, now) for number in spare}
        self._touched |= before.keys() ^ self._idle_since.keys()  # what is due of these has changed
        for number in [n for n, since in self._idle_since.items() if now >= since + IDLE_LIMIT]:
            leaver = self._workers.pop(number)
            for wanting in self._streams.values():
                wanting.discard(number)
            leaver.close(now)
            self._leaving.append(leaver)
            del self._idle_since[number]
            self._due.pop(number, None)

    def due(self) -> float | None:
        """When `advance` has something to do at the latest (s)."""
        self._queued = False
        if self._touched:
            self._gather_reports()
            for number in self._touched & self._workers.keys():
                self._learn_due(number)
            self._touched.clear()
            self._soonest = min(self._due.values(), default=math.inf)
        if self._reports:
            return self._hosting.clock()
        soonest = self._soonest
        if self._waiting and not self._starting():
            soonest = min(soonest, *(until for until, _ in self._waiting.values()))
        return soonest if soonest < math.inf else None

    def _learn_due(self, number: int) -> None:
        due = self._workers[number].due()
        retires = self._idle_since.get(number, math.inf) + IDLE_LIMIT
        self._due[number] = min(retires, math.inf if due is None else due)

    def reports(self) -> list[Report]:
        """Return what happened since the last call, in order."""
        if self._touched:
            self._gather_reports()
        reports, self._reports = self._reports, []
        return reports

    def _gather_reports(self) -> None:
        for number in sorted(self._touched):
            if number in self._workers:
                for report in self._workers[number].reports():
                    self._take_report(number, report)

    def _take_report(self, number: int, report: Report) -> None:
        if isinstance(report, Answer):
            self._take_answer(number, report)
            return
        if isinstance(report, Outcome) and self._held:
            self._held = bool(self.runs)  # a hold ends with the runs that it held
        self._reports.append(report)

    # --- streams ------------------------------------------------------------------------------

    def _want(self, number: int, stream: str) -> None:
        self._streams.setdefault(stream, set()).add(number)
        self._hosting.wanted(stream)

    def stream_at(self, stream: str, host: str, port: int, ticket: str) -> None:
        """Tell the address of a stream's receiver to the workers that asked: any other would take
        the stream over."""
        for number in self._streams.pop(stream, ()):
            if number in self._workers:
                self._workers[number].stream_at(stream, host, port, ticket)

    # --- operator -----------------------------------------------------------------------------

    def command(self, now: float, command: Command) -> None:
        """Carry out an operator's command in every worker that has a run. `status` is answered
        here, because all workers may be blocked by their actions."""
        verb = command.verb
        if verb in ("hold", "release"):
            self._held = verb == "hold"
        elif verb in ("stop", EMERGENCY_STOP):
            for run in list(self._waiting):
                self._stop_waiting(run, *stopped_by(verb).partition(": ")[::2])
        asked = {number for number, worker in self._workers.items() if worker.busy}
        if verb in ("status", PICTURE) or not asked:
            word, why = self.condition if verb == "status" else (DONE.get(verb, "stopped"), "")
            self._tell(command.id, word, why)
            return
        self._commands[command.id] = _GatheredCommand(verb, asked)
        self._touched |= asked
        for number in sorted(asked):
            self._workers[number].command(now, command)

    def _take_answer(self, number: int, answer: Answer) -> None:
        command = self._commands.get(answer.id)
        if command is None or number not in command.missing:
            return
        command.missing.discard(number)
        command.answers.append(answer.data["answer"])
        if not command.missing:
            del self._commands[answer.id]
            good = DONE.get(command.verb, "stopped")
            self._tell(answer.id, next((word for word in command.answers if word != good), good))

    def _tell(self, id_: str, word: str, why: str = "") -> None:
        data = {
            "text": why,
            "runs": self.runs,
            "pids": self.pids(),
            "state": {},
            "workers": len(self._workers),
        }
        self._reports.append(answer_of(id_, word, data))

    def close(self, now: float) -> None:
        """Let the processes end by themselves."""
        for worker in self._workers.values():
            worker.close(now)
