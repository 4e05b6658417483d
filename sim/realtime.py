"""The laboratory on the wall clock: bus, camera and calls over sockets; the world is paced by
absolute deadlines.

A thread paces the world: it waits in the bus's sockets until the next deadline and answers frames
as they arrive. At each deadline it advances the world, so the world is never ahead of the clock. An
asyncio loop in the main thread serves calls; both hold one lock while they touch the laboratory.

Catch-up: a late tick is followed at once by the next ones until the world has caught up. A world
more than `SLIP` behind (a stopped process, an overloaded machine) does not chase the clock: its
time slips, and `slipped` adds up by how much.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import queue
import secrets
import select
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from functools import partial
from pathlib import Path
from typing import Final

from petrobot.services.comm.calls.callee import Callee, Offer, Order
from petrobot.services.comm.calls.server import Server
from petrobot.services.comm.canopen.byte_stream import CanHub
from petrobot.services.comm.location_file import Directory, resolve
from petrobot.services.comm.location_file.host_checks import claim, listening
from petrobot.services.comm.lockstep.party import TICK
from petrobot.services.comm.protocol.messages import Call, Outcome
from petrobot.services.comm.streams.camera import ImageServer
from petrobot.services.comm.streams.line import UNIX, unix_socket
from petrobot.services.comm.tls.credentials import credentials
from petrobot.sim.bus.lines import PtyLine, TcpServer
from petrobot.sim.catching.truth import LaboratoryError
from petrobot.sim.laboratory_party import LaboratoryParty, answer_command

_log = logging.getLogger(__package__)

SLIP: Final = 0.1
"""Lag behind the clock from which the world's time slips (s)."""


LOOK = 0.001
"""Time between two looks at the serial lines, where there is a bus as well (s)."""
PRIORITY = 5
"""Priority of the pacemaker's thread under SCHED_FIFO; below that of the driver processes."""


class Pacemaker:
    """Advances a laboratory with the clock and transports frames and images. `run` until `stop`, in
    a thread of its own."""

    def __init__(
        self,
        laboratory: LaboratoryParty,
        hub: CanHub | None,
        images: ImageServer | None,
        serial: Mapping[str, Path] | None = None,
        tcp: Mapping[str, Path] | None = None,
    ) -> None:
        """`hub`: the bus, `images`: the camera's end of the wire; None where the cell has none.
        `serial`, `tcp`: by device, where its serial line and its Unix sockets are to be. Raises
        OSError, ValueError."""
        self.lock = threading.Lock()
        self.slipped = 0.0
        """How far the world has permanently fallen behind the clock (s)."""
        self._laboratory = laboratory
        self._hub = hub
        self._port = hub.port() if hub else None
        self._images = images
        self._server = TcpServer()
        for device, path in (tcp or {}).items():
            for port in laboratory.tcp_ports:
                accept = partial(laboratory.connect, device, port)
                self._server.listen(Path(unix_socket(str(path), port)), accept)
        self._lines: list[PtyLine | TcpServer] = [
            PtyLine(path, partial(self._answer_serial, device))
            for device, path in (serial or {}).items()
        ]
        self._lines += [self._server] * bool(tcp)
        self._generation = 0
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Outcome], Future[Outcome]]] = (
            queue.SimpleQueue()
        )
        self._stopped = threading.Event()
        self._begin = 0.0

    def stop(self) -> None:
        """End `run`."""
        self._stopped.set()

    def run(self) -> None:
        """Run until stopped, with real-time priority where that is permitted: drives and world must
        not wait for other processes."""
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        self._begin = time.monotonic() - self._laboratory.now
        while not self._stopped.is_set():
            late = time.monotonic() - self._begin - self._laboratory.now - TICK
            if late > SLIP:
                self._begin += late
                self.slipped += late
                _log.warning("the world stood still for %.2f s: this host is too busy", late)
            self._wait(self._begin + self._laboratory.now + TICK)
            with self.lock:
                self._laboratory.tick(self._laboratory.now)
                self._send_frames()
                self._server.flush()
            self._serve_camera()
            self._do_jobs()

    def submit(self, job: Callable[[], Outcome]) -> Future[Outcome]:
        """Run a job between two ticks, in the pacemaker's own thread: in another thread it could
        make the world wait."""
        done: Future[Outcome] = Future()
        self._jobs.put((job, done))
        return done

    def _do_jobs(self) -> None:
        while not self._jobs.empty():
            job, done = self._jobs.get_nowait()
            try:
                with self.lock:
                    done.set_result(job())
            except Exception as fault:
                done.set_exception(fault)

    def _wait(self, deadline: float) -> None:
        """Wait until the deadline, answering what comes from the bus and the lines."""
        while True:
            left = max(0.0, deadline - time.monotonic())
            if self._hub is not None and self._port is not None:
                self._hub.poll(min(left, LOOK) if self._lines else left)
                if frames := self._port.receive():
                    with self.lock:
                        self._laboratory.receive_frames(self._laboratory.now, "bus", frames)
                        self._send_frames()
            elif not self._lines:
                self._stopped.wait(left)
            if self._lines and select.select(self._lines, [], [], 0.0 if self._hub else left)[0]:
                with self.lock:
                    for line in self._lines:
                        line.poll()
            if left == 0.0:
                return

    def _answer_serial(self, device: str, data: bytes) -> bytes:
        return self._laboratory.take_on_serial(self._laboratory.now, device, data)

    def close(self) -> None:
        """Close the lines, after `run` has ended."""
        for line in (*self._lines, self._server):
            line.close()

    def _send_frames(self) -> None:
        if self._port is not None:
            for frame in self._laboratory.take_frames():
                self._port.send(frame)

    def _serve_camera(self) -> None:
        if self._images is None:
            return
        self._images.poll()
        exposures = self._laboratory.exposures
        with self.lock:
            if self._images.rate != exposures.rate:
                self._generation += 1
                exposures.want(self._laboratory.now, self._images.rate, self._generation)
            gone = exposures.take(self._laboratory.now)
        for image in gone:
            self._images.send(image.pixels, time.monotonic() - self._begin - image.time)


class LaboratoryShell:
    """A running laboratory of one simulated node of services.toml. It serves between `start` and
    `close`."""

    def __init__(self, directory: Directory, name: str) -> None:
        """Raises LaboratoryError, ImportError for a `sim` that does not exist, ValueError for an
        impossible address."""
        self._directory = directory
        self._name = name
        self.laboratory = _made(directory, name)
        channel, address = bus_channel(directory), camera_address(directory)
        with _had(f"{directory.source}: the simulated bus's channel {channel}"):
            self._hub = CanHub(channel) if channel else None
        with _had(
            f"{directory.source}: the simulated camera's address "
            f"{':'.join(map(str, address or ()))}"
        ):
            self._images = ImageServer(*address) if address else None
        with _had(f"{directory.source}: a simulated line"):
            lines = serial_lines(directory), tcp_hosts(directory)
            self.pacemaker = Pacemaker(self.laboratory, self._hub, self._images, *lines)
        offers = {
            service: Offer(
                inline=None if service == self.laboratory.between_ticks else self._answer
            )
            for service in self.laboratory.services
        }
        callee = Callee(name, secrets.token_hex(8), offers, directory=directory.hash)
        proves = credentials(directory, name)
        self.server = Server(callee, on_orders=self._obey, key=proves.key, tls=proves.server())
        self._preparing: set[asyncio.Task[None]] = set()
        self._thread = threading.Thread(target=self._pace, name="pacemaker", daemon=True)
        self._loop: asyncio.AbstractEventLoop | None = None
        self.over = asyncio.Event()
        """Set when a fault has ended the pacemaker; `close` raises that fault."""
        self._fault: BaseException | None = None

    async def start(self) -> None:
        """Do all preparations that take long, start the world's clock, then listen. Raises
        DirectoryError, KeyNeededError."""
        if self._images is not None:
            self.laboratory.make_ready({})
        gc.collect()
        # These objects stay, so the garbage collector need not scan them during a tick.
        gc.freeze()
        self._loop = asyncio.get_running_loop()
        self._thread.start()
        _log.info("%s: the world's clock runs", self._name)
        try:
            with listening(self._directory, self._name):
                await self.server.start(*self._directory.address(self._name))
        except BaseException:
            await self.close()
            raise

    async def close(self) -> None:
        """Shut down in order. Raises what ended the pacemaker."""
        self.pacemaker.stop()
        await asyncio.to_thread(self._thread.join)
        await asyncio.gather(*self._preparing)
        await self.server.close("the laboratory stops")
        if self._hub is not None:
            self._hub.close()
        if self._images is not None:
            self._images.close()
        self.pacemaker.close()
        self.laboratory.close()
        if self._fault is not None:
            raise self._fault

    def _pace(self) -> None:
        try:
            self.pacemaker.run()
        except BaseException as fault:
            _log.exception("%s: the world's clock stopped", self._name)
            self._fault = fault
            if self._loop is not None:
                self._loop.call_soon_threadsafe(self.over.set)

    def _answer(self, now: float, call: Call) -> Outcome:
        with self.pacemaker.lock:
            outcome = self.laboratory.answer(call)
        if outcome.status != "success":
            _log.info("call %s of %s refused: %s", call.id, call.service, _words(outcome))
        return outcome

    def _obey(self, now: float, orders: list[Order]) -> None:
        """Start preparations, the only calls that are runs; they cannot be stopped, only
        awaited."""
        for order in orders:
            answer_command(now, self.server.callee, order)
            if isinstance(order, Call):
                task = asyncio.get_running_loop().create_task(self._prepare(order))
                self._preparing.add(task)
                task.add_done_callback(self._preparing.discard)

    async def _prepare(self, call: Call) -> None:
        """Do first, outside the loop and outside a tick, what takes long: the static scene of a
        camera in another pose takes seconds to draw."""
        with contextlib.suppress(ValueError):  # The answer says what is wrong with the arguments.
            await asyncio.to_thread(self.laboratory.make_ready, call.arguments)
        outcome = await asyncio.wrap_future(
            self.pacemaker.submit(lambda: self.laboratory.answer(call))
        )
        _log.info("call %s of %s ended: %s", call.id, call.service, _words(outcome))
        self.server.callee.finish(self.server.now(), outcome)
        self.server.flush()


def _words(outcome: Outcome) -> str:
    return f"{outcome.status} {outcome.cause} {outcome.text}".rstrip()


def _made(directory: Directory, name: str) -> LaboratoryParty:
    """Return the laboratory that the node's `sim` makes. Raises LaboratoryError if it is not a
    `LaboratoryParty`."""
    made = resolve(directory.nodes[name].sim)(directory, name)
    if not isinstance(made, LaboratoryParty):
        raise LaboratoryError(
            f"{directory.source}: [nodes.{name}] sim makes a {type(made).__name__}; in real "
            "time it must be a "
            "petrobot.sim.laboratory_party.LaboratoryParty"
        )
    return made


@contextlib.contextmanager
def _had(what: str) -> Iterator[None]:
    """Raise LaboratoryError instead of OSError, with a message for the operator."""
    try:
        yield
    except OSError as fault:
        why = os.strerror(fault.errno) if fault.errno else str(fault)
        raise LaboratoryError(
            f"{what}: {why}; end the process that listens there, or write another port"
        ) from fault


def bus_channel(directory: Directory) -> str:
    """Return the channel of the simulated bus: that of the device that uses `petrobot_stream`;
    empty without one."""
    channels = set()
    for device in directory.devices.values():
        can = device.config.get("can") or device.config
        if can.get("interface") == "petrobot_stream":
            channels.add(str(can.get("channel", "")))
    if len(channels) > 1:
        raise LaboratoryError(
            f"{directory.source}: buses {', '.join(sorted(channels))}: the laboratory has "
            "one; use one"
        )
    return channels.pop() if channels else ""


def serial_lines(directory: Directory) -> dict[str, Path]:
    """Return where the laboratory's serial lines are to be, by device: those with `port =
    "pty:PATH"`, relative to services.toml."""
    ports = {d.name: str(d.config.get("port", "")) for d in directory.devices.values()}
    return {
        name: directory.source.parent / port.removeprefix("pty:")
        for name, port in ports.items()
        if port.startswith("pty:")
    }


def tcp_hosts(directory: Directory) -> dict[str, Path]:
    """Return where the Unix sockets of the laboratory's robots are to be, by device: those with
    `host = "unix:PATH"`, relative to services.toml."""
    hosts = {d.name: str(d.config.get("host", "")) for d in directory.devices.values()}
    return {
        name: directory.source.parent / host.removeprefix(UNIX)
        for name, host in hosts.items()
        if host.startswith(UNIX)
    }


def camera_address(directory: Directory) -> tuple[str, int] | None:
    """Return where the simulated camera listens: the `address` of the device with `source = "sim"`;
    None without one."""
    addresses = {
        str(d.config.get("address", ""))
        for d in directory.devices.values()
        if d.config.get("source") == "sim"
    }
    if not addresses:
        return None
    if len(addresses) > 1:
        raise LaboratoryError(
            f"{directory.source}: cameras at {', '.join(sorted(addresses))}: the laboratory has one"
        )
    host, _, port = addresses.pop().rpartition(":")
    if not host or not port.isdigit():
        raise LaboratoryError(
            f'{directory.source}: a device with source = "sim" needs address = "host:port"'
        )
    return host, int(port)


async def serve(directory: Directory, name: str) -> None:
    """Run the laboratory until SIGTERM or SIGINT; print one line with `ready` when it serves."""
    # A second laboratory should be reported at its node's address, not at that of its bus.
    claimed = claim(directory, name)
    shell = LaboratoryShell(directory, name)
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, shell.over.set)
    await shell.start()
    host, port = shell.server.address
    print(f"node {name} ready on {host}:{port}, process {os.getpid()}", flush=True)
    await shell.over.wait()
    _log.info("node %s ends", name)
    await shell.close()
    claimed.close()
