"""The asyncio shell of a node in real time: its server, its clients to other nodes, its processes,
and the clock."""

from __future__ import annotations

import asyncio
import logging
import os
import secrets
import signal
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from msgspec.structs import replace

from petrobot.services.action import Status
from petrobot.services.comm.calls.callee import Order
from petrobot.services.comm.calls.caller import Notice
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.calls.link import Alarm, clock_of
from petrobot.services.comm.calls.server import Server
from petrobot.services.comm.location_file import Directory, DirectoryError, sources
from petrobot.services.comm.location_file.host_checks import claim, listening
from petrobot.services.comm.protocol.messages import Call
from petrobot.services.comm.protocol.security import all_keys, require_key
from petrobot.services.comm.tls.credentials import credentials
from petrobot.services.host.command_line import done_before
from petrobot.services.host.emergency_latch import STATE, latch_of
from petrobot.services.host.parent_death import GOOD_ORDER, outlive, wanted_with_parent
from petrobot.services.node.child import LEAVE_LIMIT, ForkServer
from petrobot.services.node.emergency_stops import BEAT_EVERY
from petrobot.services.node.inline_host import Host
from petrobot.services.node.node import GENERAL, LOOP, Node, stream_service
from petrobot.services.node.worker_host import START_LIMIT, Hosting, WorkerHost
from petrobot.services.node.worker_pool import WorkerPool
from petrobot.services.worker.process import Setup
from petrobot.services.worker.remote import IN_EMERGENCY

_log = logging.getLogger(__name__)

_CALLS = frozenset((Call,))
CLOSE_LIMIT = LEAVE_LIMIT + 3.0
"""Time in which the processes of a closing node must end (s). One that hangs in the kernel does not
end, even when it is killed."""
LOOK = 0.25
"""Time after which a node looks at a run that it gave to a worker, at the latest (s)."""


class NodeShell:
    """A running node. It serves between `start` and `close`. Its loop runs only the protocol and
    quick services."""

    def __init__(
        self, directory: Directory, name: str, text: str, *, mock: str = "", memory: int = 0
    ) -> None:
        """`text` is the text of services.toml for all processes of the node; `memory` limits
        workers (bytes)."""
        self._directory = directory
        self._name = name
        self._loop = asyncio.get_running_loop()
        self._now = clock_of(self._loop)
        self._tickets = _tickets(directory, name)
        self._credentials = credentials(directory, name)
        keys = all_keys(self._credentials.key)
        level = logging.getLogger().getEffectiveLevel()
        self._setup = Setup(
            str(directory.source), text, name, "", mock, memory, self._tickets, keys, level
        )
        self._workers = {device: self._worker_place(device) for device in self._devices()}
        places: dict[str, Host] = {**self._workers}
        self.latch = latch_of(directory.source, name)
        self._disk = ThreadPoolExecutor(1, "disk")
        self.node = Node(
            directory,
            name,
            boot=secrets.token_hex(8),
            clock=self._now,
            places=places,
            connect=self._connect,
            stream_address=self._stream_address,
            latch=self.latch,
            in_order=self._write,
        )
        self.node.scripted = bool(mock)
        self.node.code = {m: digest for m, (_, digest) in sources(directory, name).items()}
        key, tls = self._credentials.key, self._credentials.server()
        self.server = Server(self.node.callee, on_orders=self._obey, key=key, tls=tls)
        self._client_tls = self._credentials.client()
        self._clients: dict[str, Client] = {}
        self._unfound: dict[str, str] = {}
        """Why the receiver of a stream could not be asked for its address, as last logged."""
        self._tasks: set[asyncio.Task[None]] = set()
        self._alarm = Alarm(self._step)
        self._beating: asyncio.TimerHandle | None = None
        self._change = asyncio.Event()
        self._serving = False

    def _devices(self) -> list[str]:
        devices = [d.name for d in self._directory.devices.values() if d.node == self._name]
        general = any(
            a.node == self._name and not a.device for a in self._directory.actions.values()
        )
        return [*devices, GENERAL] if general else devices

    def _worker_place(self, device: str) -> WorkerHost | WorkerPool:

        def wanted(stream: str) -> None:
            self._find_stream(device, stream)

        setup = replace(self._setup, device=device)
        hosting = Hosting(setup, self._now, self._heard, wanted)
        if device == GENERAL:
            return WorkerPool(hosting, self._directory.nodes[self._name].workers)
        return WorkerHost(hosting)

    # --- life ---------------------------------------------------------------------------------

    async def start(self) -> None:
        """Start the devices, then listen. Raises DirectoryError if a device cannot be started or
        the address cannot be used, and KeyNeededError."""
        host, port = self._directory.address(self._name)
        require_key(self._name, host, self._credentials.guarded)
        try:
            for place in self._workers.values():
                place.start()
            self._beat()
            async with asyncio.timeout(START_LIMIT):
                await self._until_ready()
            with listening(self._directory, self._name):
                await self.server.start(host, port)
            self._serving = True
        except TimeoutError:
            late = ", ".join(
                device or "actions" for device, place in self._workers.items() if not place.ready
            )
            await self.close()
            why = "a driver hangs while it is made, or this host is too busy"
            raise DirectoryError((f"{late} not up within {START_LIMIT:g} s: {why}",)) from None
        except BaseException:
            await self.close()
            raise
        self._step()

    def _beat(self) -> None:
        """Send the processes of devices a ping: without it they stop their devices."""
        for place in self._workers.values():
            place.beat(self._now())
        self._beating = self._loop.call_later(BEAT_EVERY, self._beat)

    async def _until_ready(self) -> None:
        while not all(place.ready for place in self._workers.values()):
            failed = next((place.failed for place in self._workers.values() if place.failed), "")
            if failed:
                raise DirectoryError((failed,))
            self._change.clear()
            await self._change.wait()

    async def close(self) -> None:
        """Run the stop routines of all devices, then close all connections."""
        if self._beating is not None:
            self._beating.cancel()
        self._alarm.cancel()
        self.node.close(self._now())
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.gather(*(client.close() for client in self._clients.values()))
        self._serving = False
        await self.server.close()
        children = [child for place in self._workers.values() for child in place.children()]
        ends = [self._loop.create_task(child.wait()) for child in children]
        _, hanging = await asyncio.wait(ends, timeout=CLOSE_LIMIT) if ends else (ends, ())
        if hanging:
            _log.error(
                "%d processes hang in the kernel and are left to their keepers", len(hanging)
            )
        self._alarm.cancel()

    # --- steps --------------------------------------------------------------------------------

    def _obey(self, now: float, orders: list[Order]) -> None:
        self.node.obey(now, orders)
        quiet = _CALLS.issuperset(map(type, orders)) and self.node.places[LOOP].idle
        if quiet and not any(place.news for place in self._workers.values()):
            # Workers have their orders, and their answers cause the next step. Only a worker that
            # stays silent needs a step by itself, some seconds later. Computing that time would
            # cost every run more than a look now and then.
            self._alarm.set(now + LOOK)
        else:
            self._changed()

    def _take_notices(self, now: float, notices: list[Notice]) -> None:
        self.node.take_notices(now, notices)
        self._changed()

    def _changed(self) -> None:
        """Step in the next turn of the loop, once, however many messages arrived."""
        self._change.set()
        self._alarm.set(0.0)

    def _heard(self, plain_ends: bool) -> None:
        """Step after a process has sent something or ended: at once, because another turn of the
        loop costs as much as the step. If only results arrived, only these are passed on."""
        if not plain_ends or not self._serving or not self.node.ends_quiet(now := self._now()):
            self._change.set()
            self._step()
            return
        self.node.take_reports(now)
        self.server.flush(now)
        for client in self._clients.values():
            client.flush(now)
        self._alarm.set(now + LOOK)

    def _step(self) -> None:
        now = self._now()
        self.node.advance(now)
        if self._serving:
            self.server.flush(now)
        for client in self._clients.values():
            client.flush(now)
        self._alarm.set(self.node.due())

    def _write(self, write: Callable[[], str], done: Callable[[str], None]) -> None:
        """Write to disk, in a thread, what an operator's command needs there: one sync may take
        seconds."""

        def ended(future: asyncio.Future[str]) -> None:
            done(future.result())
            self._changed()

        self._loop.run_in_executor(self._disk, write).add_done_callback(ended)

    # --- other nodes --------------------------------------------------------------------------

    def _connect(self, peer: str) -> None:
        host, port = self._directory.address(peer)
        caller, key = self.node.callers[peer], self._credentials.key
        client = Client(
            host, port, caller, on_notices=self._take_notices, key=key, tls=self._client_tls
        )
        self._clients[peer] = client
        client.start()

    def _stream_address(self, stream: str) -> Mapping[str, Any] | None:
        place = self._workers[self._directory.streams[stream].to]
        if stream not in place.streams:
            return None
        host, port = place.streams[stream]
        return {"host": host, "port": port, "ticket": self._tickets[stream]}

    def _find_stream(self, device: str, stream: str) -> None:
        """Ask the receiver's node for the address of a stream that an action sends."""
        task = self._loop.create_task(self._tell_stream(device, stream))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _tell_stream(self, device: str, stream: str) -> None:
        peer = self._directory.where(stream)
        self.node.caller(peer)
        outcome = await self._clients[peer].call(stream_service(stream), deadline=1.0)
        if outcome.status == Status.SUCCESS:
            at = outcome.values
            self._unfound.pop(stream, None)
            self._workers[device].stream_at(stream, at["host"], at["port"], at["ticket"])
        elif outcome.text != self._unfound.get(stream):
            self._unfound[stream] = outcome.text
            _log.warning(
                "stream %s: %s does not tell where it goes: %s %s",
                stream,
                peer,
                outcome.cause,
                outcome.text,
            )


def _tickets(directory: Directory, node: str) -> dict[str, str]:
    """Return the ticket of each stream that a node receives: a secret of the receiving device, a
    dot, and a secret of the stream."""
    streams = [s for s in directory.streams.values() if directory.where(s.name) == node]
    devices = {stream.to: secrets.token_hex(16) for stream in streams}
    return {stream.name: f"{devices[stream.to]}.{secrets.token_hex(16)}" for stream in streams}


def _end_with_launcher(launcher: int, over: asyncio.Event) -> None:
    """Close the node when its launcher is gone; by force if that takes too long, for example
    because a service hangs in the loop."""
    outlive(launcher, GOOD_ORDER)
    try:
        asyncio.get_running_loop().add_reader(os.pidfd_open(launcher), over.set)
    except ProcessLookupError:
        over.set()


async def serve(directory: Directory, name: str, text: str, *, mock: str, memory: int) -> None:
    """Run a node until SIGTERM or SIGINT; prints one line with `ready` when it serves."""
    over = asyncio.Event()
    loop = asyncio.get_running_loop()
    if wanted_with_parent():
        _end_with_launcher(os.getppid(), over)
    # Its children keep it open, too: while the driver's process of a killed node stops its device,
    # the node's successor must not make a second driver.
    claimed = claim(directory, name)
    ForkServer.kept_open = (claimed.fileno(),)
    shell = NodeShell(directory, name, text, mock=mock, memory=memory)
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, over.set)
    if not await done_before(over, shell.start()):
        return
    host, port = shell.server.address
    if not shell.latch.kept:
        folders = " and ".join(str(path.parent) for path in shell.latch.paths)
        _log.warning(
            "node %s: an emergency stop could not be kept in %s; name a folder in $%s",
            name,
            folders,
            STATE,
        )
    if stopped := shell.node.stopped_in_emergency():
        _log.warning("node %s: %s: %s", name, ", ".join(stopped), IN_EMERGENCY)
    print(f"node {name} ready on {host}:{port}, process {os.getpid()}", flush=True)
    await over.wait()
    _log.info("node %s ends", name)
    await shell.close()
