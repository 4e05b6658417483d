"""The coordinator on the wall clock: one client for each node, timers on the asyncio loop."""

from __future__ import annotations

import asyncio
import itertools
import logging
import math
import os
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from shlex import quote
from typing import Final, TypeVar

from msgspec import Struct, field

from petrobot.coordinator.run.journal import JournalError
from petrobot.coordinator.run.mission import Mission, MissionError, Stage
from petrobot.services.comm.calls.caller import Notice, PeerLost
from petrobot.services.comm.calls.client import KEY_CODES, Client
from petrobot.services.comm.calls.link import in_thread
from petrobot.services.comm.calls.peers import LEASED, OVERTAKEN
from petrobot.services.comm.location_file import MOCK, Directory, sources
from petrobot.services.comm.protocol.messages import (
    COORDINATOR,
    LEASE,
    Answer,
    Command,
    Welcome,
    split_boot,
)
from petrobot.services.comm.tls.credentials import Credentials, credentials
from petrobot.services.host.emergency_latch import uptime
from petrobot.services.host.toml_text import InputError

_log = logging.getLogger(__name__)

PERIOD: Final = 0.05
"""Time between two checks (s)."""
LATE: Final = 0.02
"""Delay from which a check counts as late (s): a period of a set-point stream at 50 Hz."""
SHARE: Final = 0.01
"""At this share of late checks the host counts as too busy for a run in real time."""
WORST: Final = 3 * LATE
"""Single delay (s) from which it counts as too busy: a set point of such a stream is stale then."""
STOOD_STILL: Final = 2.0
"""Single delay (s) that no busy host explains."""


def _suspended() -> float:
    """How long this computer has been suspended since it was started (s)."""
    return uptime() - time.monotonic()


class Punctuality(Struct):
    """Measures how punctual the coordinator's event loop is: counts checks that should happen every
    `PERIOD` seconds."""

    looks: int = 0
    late: int = 0
    worst: float = 0.0
    """The longest delay (s)."""
    suspended: float = field(default_factory=_suspended)
    """How long the computer had been suspended before (s): the loop's clock stands still then."""

    def look(self, due: float, now: float) -> float:
        """Note that the due check happens now, and return when the next one is due (s)."""
        self.looks += 1
        self.late += now - due > LATE
        self.worst = max(self.worst, now - due)
        return now + PERIOD

    def remark(self) -> str:
        """Return a remark for the result; empty if the host was awake and not too busy."""
        if (asleep := _suspended() - self.suspended) >= STOOD_STILL:
            return (
                f"suspended for {asleep:.0f} s in this run: its clocks and timers stood still, its "
                "devices did not; what failed may be due to that"
            )
        if self.worst < WORST and self.late <= SHARE * self.looks:
            return ""
        return (
            f"too busy for real time: the coordinator woke up more than {1e3 * LATE:g} ms "
            f"late {self.late} of {self.looks} times, "
            f"by {1e3 * self.worst:.0f} ms at most; what failed may be due to that"
            + " (its process was stopped, or the computer stood still)"
            * (self.worst >= STOOD_STILL)
        )


SLOW_DISK: Final = 0.3
"""If a sync takes so long (s), the result says that the disk is slow."""
DISK_PATIENCE: Final = 60.0
"""If a sync takes so long (s), the run ends: the disk does not answer."""
LINGER = 1.0
"""Longest wait for anything at the end of a run (s)."""
ASK_AGAIN: Final = 0.2
"""Seconds after which a device that another run has is asked for again."""
LEAVE: Final = 2.5
"""How long to wait for a lost node, so that it can be sent BYE (s): a little longer than it keeps
the leases of a coordinator that left without BYE (`services.comm.calls.callee.Retention.lease`)."""

TRANSIT: Final = 0.1
"""Longest time that a WELCOME needs on a busy host (s): an order right after the clearing of an
emergency stop must not count as older. No operator gives and clears a stop in this time."""


T = TypeVar("T")


def on_disk(work: Callable[[], T]) -> asyncio.Future[T]:
    """Do what writes to the disk in a thread: a sync may take seconds, in which the nodes and the
    operators must be answered. The future raises what `work` raises, and JournalError after
    `DISK_PATIENCE`."""
    done = in_thread(work)
    text = (
        f"the disk of the journal has not answered for {DISK_PATIENCE:g} s; nothing was sent on "
        "the strength of its last records; `petrobot resume` continues when it answers again"
    )

    def give_up() -> None:
        if not done.done():
            done.set_exception(JournalError(text))

    patience = asyncio.get_running_loop().call_later(DISK_PATIENCE, give_up)
    done.add_done_callback(lambda _: patience.cancel())
    return done


class UnreachableError(InputError):
    """Nodes cannot be reached; `nodes` names them."""

    exit_code = 3

    def __init__(self, nodes: Sequence[str], text: str) -> None:
        super().__init__(nodes, text)
        self.nodes = tuple(nodes)
        self.text = text

    def __str__(self) -> str:
        return self.text


class RealtimeMission:
    """Drives a mission run with asyncio: passes on what clients notice, sends its calls, and wakes
    it by timers."""

    def __init__(
        self,
        mission: Mission,
        directory: Directory,
        proves: Credentials | None = None,
        ordered: float = math.inf,
    ) -> None:
        """Needs no event loop before `connect`: writing the journal's header may take seconds, so
        that a run is made in another thread.

        `ordered`: when the operator ordered the run (`uptime`); infinity: after everything.
        """
        self.mission = mission
        self._directory = directory
        self._ordered = ordered
        self._leased: list[str] = []
        """Devices that this run has, in the order in which it took them."""
        self._answers: dict[str, asyncio.Future[Answer]] = {}
        """Answers to come to this run's own commands, by the command's id."""
        self._asked = itertools.count()
        """Numbers of these commands."""
        self._missed: list[str] | None = []
        """Nodes that cleared an emergency stop after that; None once all nodes are connected: from
        then on the callers count the stops."""
        self._over = asyncio.Event()
        self._closed = False
        self._fault: BaseException | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._lost_at: dict[str, float] = {}
        self._punctuality = Punctuality()
        self._looking: asyncio.TimerHandle | None = None
        self._syncing: asyncio.Future[None] | None = None
        self._slowest_sync = 0.0
        """Longest time that a sync took (s)."""
        mission.executor.in_background = self._sync
        self._key, self._tls = (proves.key, proves.client()) if proves is not None else (None, None)
        self.clients: Mapping[str, Client] = {}

    @property
    def _loop(self) -> asyncio.AbstractEventLoop:
        return asyncio.get_running_loop()

    async def connect(self, timeout: float = 5.0) -> None:
        """Connect to every node. Raises UnreachableError with those that cannot be reached, and
        MissionError if an emergency stop was given and cleared after the run was ordered."""
        self.clients = {
            name: Client(
                node.host,
                node.port,
                self.mission.callers[name],
                on_notices=self._hear(name),
                key=self._key,
                tls=self._tls,
            )
            for name, node in self._directory.nodes.items()
        }
        for client in self.clients.values():
            client.start()
        reached = await asyncio.gather(
            *(client.connected(timeout) for client in self.clients.values())
        )
        missing = [name for name, up in zip(self.clients, reached, strict=True) if not up]
        if missing:
            raise UnreachableError(missing, "; ".join(self._unreached(missing)))
        missed, self._missed = self._missed, None
        if missed:
            raise MissionError(
                f"{', '.join(missed)}: an emergency stop was cleared after this was ordered, so "
                "nothing was started; if the cell is safe, order it again"
            )

    async def lease(self, devices: Collection[str]) -> None:
        """Take the devices for this run. Of two runs that start at once one gets them all, because
        both take them in the order of services.toml. A run whose coordinator was killed keeps its
        devices for a while, so they are asked for as long. Raises MissionError if another run has
        one or an emergency stop holds it, and UnreachableError if a node does not answer."""
        until = self.now() + LEAVE
        for device in (d for d in self._directory.devices if d in devices):
            answer = await self._take_device(device)
            while answer.data.get("cause") == LEASED and self.now() < until:
                await asyncio.sleep(ASK_AGAIN)
                answer = await self._take_device(device)
            if answer.ok:
                self._leased.append(device)
                continue
            if "text" not in answer.data:
                node = self._directory.where(device)
                raise UnreachableError([node], f"{node} was connected and does not answer")
            if answer.data["cause"] != LEASED:
                raise MissionError(answer.data["text"], bad_input=True)
            raise MissionError(
                f"in use: {answer.data['text']}; wait until that run has ended, or end it with "
                "`petrobot abort` (after `petrobot resume`, if its coordinator was killed)",
                bad_input=True,
            )

    def _take_device(self, device: str) -> asyncio.Future[Answer]:
        return self._ask(self._directory.where(device), LEASE, device)

    def _ask(self, node: str, verb: str, target: str = "") -> asyncio.Future[Answer]:
        client = self.clients[node]
        hello = client.caller.hello
        id_ = f"{hello.name}/{hello.epoch}/{verb}/{next(self._asked)}"
        answer = self._answers[id_] = self._loop.create_future()
        client.caller.command(self.now(), Command(id_, verb, target))
        client.flush()
        return answer

    async def refuse_others(self, plant: str) -> None:
        """Raise MissionError if a node of a scripted run is not scripted, or one of another run is:
        the records would name the wrong plant, and a real node would move the robot."""
        nodes = (node.name for node in self._directory.nodes.values() if not node.sim)
        asked = {node: self._ask(node, "status") for node in nodes}
        if asked:
            await asyncio.wait(asked.values(), timeout=LEAVE)
        for node, answer in asked.items():
            told = answer.result().data.get("scripted") if answer.done() else None
            if told is not None and told is not (plant == MOCK):
                how = "with" if told else "without"
                raise MissionError(
                    f"node {node} was started {how} a script (--mock), and this run counts as "
                    f"{plant}: give --mock to both, or to none",
                    bad_input=True,
                )

    def _compare_code(self, node: str, answer: asyncio.Future[Answer]) -> None:
        """Say which modules a node was started with that differ from those here. A node imports
        them once, and two folders may hold the same services.toml."""
        here = sources(self._directory, node)
        found = {} if answer.cancelled() else answer.result().data.get("code", {})
        for module, (path, digest) in here.items():
            if module in found and found[module] != digest:
                _log.warning(
                    "node %s was started with another %s than %s is now: it runs that other code; "
                    "restart it, from this folder, to run this one",
                    *(node, module, path),
                )

    def _look_if_overtaken(self, answer: asyncio.Future[Answer]) -> None:
        """End the run if it has lost a device: its next action would not know where it stands."""
        if not answer.cancelled() and answer.result().data.get("cause") == OVERTAKEN:
            text = answer.result().data["text"]
            self.fail(MissionError(f"{text}; look at the robot, then resume or start again"))

    def _unreached(self, missing: Sequence[str]) -> Iterator[str]:
        """Return why nodes cannot be reached and what to do. Nodes that run and refuse us do not
        have to be started."""
        source = quote(os.path.normpath(self.mission.executor.directory.source))
        refusing = [name for name in missing if self.clients[name].answered]
        if away := [name for name in missing if name not in refusing]:
            # Beside nodes that run, `up` would find their ports in use.
            some = len(away) < len(self.clients)
            commands = [f"node {name}" for name in away] if some else ["up"]
            launch = ", ".join(f"`petrobot {command} --services {source}`" for command in commands)
            yield f"no answer from {', '.join(map(self._tried, away))}; launch with {launch}"
        if refusing:
            keys = any(
                code in self.clients[name].trouble for name in refusing for code in KEY_CODES
            )
            remedy = (
                f"; give both sides the same key file: that which keys.file of {source} names"
                if keys
                else ""
            )
            yield f"not let in by {', '.join(map(self._tried, refusing))}{remedy}"

    def _tried(self, node: str) -> str:
        client = self.clients[node]
        return f"{node} at {client.host}:{client.port}" + (
            f" ({client.trouble})" if client.trouble else ""
        )

    async def run(self, begin: Callable[[float], None] | None = None) -> None:
        """Run the mission to its end. `begin(now)` starts it, or continues a recorded run. Raises
        MissionError, and JournalError if the journal cannot be written."""
        if self._fault is None:  # an emergency stop may have come before
            (begin or self.mission.start)(self._loop.time())
            self.settle()
        self._look_again(self._loop.time() + PERIOD)
        await self._over.wait()
        stood = self.mission.executor.store.stood
        remark = self._punctuality.remark()
        if remark and self._punctuality.worst > stood + WORST:  # else the disk is to blame
            self.mission.remarks["host"] = remark
        if max(self._slowest_sync, stood) >= SLOW_DISK:
            self.mission.remarks["disk"] = (
                f"orders to devices waited up to {max(self._slowest_sync, stood):.1f} s for the "
                "disk of the journal"
                + f", and the coordinator itself stood still for {stood:.1f} s"
                * (stood >= SLOW_DISK)
                + "; what failed may be due to that (--journal FOLDER: on a faster disk)"
            )
        if self._fault is not None:
            raise self._fault

    async def close(self) -> None:
        """Take leave of the nodes: send each the missing acknowledgements and BYE, which frees its
        devices for the next run at once. A node that was just lost is waited for as long as it
        keeps them for this run."""
        self._closed = True
        for timer in (self._timer, self._looking):
            if timer is not None:
                timer.cancel()
        if self._syncing is not None:
            await asyncio.wait({self._syncing}, timeout=LEAVE)
        await asyncio.gather(*(self._leave(name, client) for name, client in self.clients.items()))

    async def _leave(self, name: str, client: Client) -> None:
        if (lost := self._lost_at.get(name)) is not None:
            await client.connected(max(0.0, lost + LEAVE - self._loop.time()))
        client.flush(self._loop.time() + LINGER)  # acknowledgements that wait for others go now
        await client.close()

    def now(self) -> float:
        """The mission's clock (s)."""
        return self._loop.time()

    def flush(self, node: str) -> None:
        """Send what is waiting for a node."""
        self.clients[node].flush(self.now())

    def fail(self, fault: BaseException) -> None:
        """End with this fault; nothing more leaves."""
        self._fault = self._fault or fault
        self._over.set()

    def settle(self) -> None:
        """Send what is waiting, and set the timer for what is due next. Call this after each use of
        the mission."""
        if self._closed:
            return
        for client in self.clients.values():
            client.flush()
        if self.mission.stage is Stage.OVER:
            self._over.set()
            return
        due = self.mission.due()
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None if due is None else self._loop.call_at(due, self._wake)

    def _sync(self, work: Callable[[], None]) -> None:
        self._syncing = on_disk(work)
        self._syncing.add_done_callback(partial(self._synced, self.now()))

    def _synced(self, began: float, done: asyncio.Future[None]) -> None:
        self._slowest_sync = max(self._slowest_sync, self.now() - began)
        if (fault := done.exception()) is not None:
            self.fail(fault)
        elif not self._closed and self._fault is None:
            self._guarded(self.mission.synced)

    def _look_again(self, due: float) -> None:
        """Measure how late the loop is: if it is late, so are the other processes of this host."""

        def look() -> None:
            self._look_again(self._punctuality.look(due, self._loop.time()))

        self._looking = self._loop.call_at(due, look)

    def _wake(self) -> None:
        self._guarded(lambda now: self.mission.advance(now))

    def _hear(self, node: str) -> Callable[[float, list[Notice]], None]:
        def hear(_: float, notices: list[Notice]) -> None:
            for notice in notices:
                if isinstance(notice, PeerLost):
                    self._lost_at[node] = self._loop.time()
                elif isinstance(notice, Welcome):
                    self._lost_at.pop(node, None)
                    # Durations, not clocks: that of this process counts also while it is frozen.
                    since = split_boot(notice.boot)[2]
                    if self._missed is not None and uptime() - self._ordered > since + TRANSIT:
                        self._missed.append(node)
                    if not self._closed:
                        status = self._ask(node, "status")
                        status.add_done_callback(partial(self._compare_code, node))
                    # A restarted node does not know of the devices that the run has. It must not
                    # ask for those that it only waits for: they come in the order of the file.
                    for device in self._leased:
                        if self._directory.where(device) == node:
                            self._take_device(device).add_done_callback(self._look_if_overtaken)
                elif isinstance(notice, Answer) and notice.id in self._answers:
                    asked = self._answers.pop(notice.id)
                    if not asked.done():  # Ctrl-C may have ended the wait for it
                        asked.set_result(notice)
            if not self._closed:
                self._guarded(lambda now: self.mission.take(now, node, notices))

        return hear

    def _guarded(self, step: Callable[[float], None]) -> None:
        try:
            step(self._loop.time())
        except Exception as fault:  # also one of petrobot: without this step the run would hang
            # What is not stored has not left: the nodes end its runs as orphans, and `resume`
            # continues from what is stored.
            self.fail(fault)
            return
        self._loop.call_soon(self.settle)


def credentials_of(directory: Directory) -> Credentials:
    """Return the coordinator's keys or certificates, as services.toml says. Raises
    KeyFileError."""
    return credentials(directory, COORDINATOR)
