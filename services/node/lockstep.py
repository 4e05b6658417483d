"""A node as a party of a lock-step cell: drivers and actions run inline, and everything outside is
reached by envelopes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir
from typing import TYPE_CHECKING, Any

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.location_file import DeviceEntry, Directory, DirectoryError
from petrobot.services.comm.lockstep.cell import CellError
from petrobot.services.comm.lockstep.channels import (
    can_body,
    images_wanted,
    read_can,
    read_image,
    read_set_point,
    read_tcp,
    set_point_body,
    tcp_body,
)
from petrobot.services.comm.lockstep.party import Envelope
from petrobot.services.comm.protocol.messages import (
    Accept,
    Answer,
    Call,
    Event,
    Feedback,
    Hello,
    Message,
    Outcome,
    Pong,
    Refuse,
    Welcome,
)
from petrobot.services.comm.streams.camera import MemoryImages
from petrobot.services.comm.streams.image import ImageSource
from petrobot.services.comm.streams.line import ByteLine
from petrobot.services.node.drivers import make_driver
from petrobot.services.node.inline_host import Host, InlineHost
from petrobot.services.node.node import GENERAL, Node
from petrobot.services.node.ports import DevicePorts
from petrobot.services.node.watchdog import Watchdog
from petrobot.services.scripted import Scripted
from petrobot.services.worker.callables import describe
from petrobot.services.worker.remote import DeviceError
from petrobot.services.worker.runner import Hung
from petrobot.services.worker.setpoints import SetpointReceiver

if TYPE_CHECKING:
    pass

# What a driver may reach in a lock-step cell: bus, images and streams in memory, on the other side
# envelopes.


class MemoryCan:
    """A port on the laboratory's bus. Collects outgoing frames; incoming ones are put in."""

    def __init__(self) -> None:
        self.out: list[Frame] = []
        self.arrived: list[Frame] = []
        self._closed = False

    def send(self, frame: Frame) -> None:
        """Put a frame on the bus. Raises ConnectionError when the port is closed."""
        if self._closed:
            self._check()
        self.out.append(frame)

    def receive(self) -> Sequence[Frame]:
        """Return the frames that arrived since the last call, oldest first."""
        self._check()
        arrived, self.arrived = self.arrived, []
        return arrived

    def close(self) -> None:
        """Leave the bus."""
        self._closed = True

    def _check(self) -> None:
        if self._closed:
            raise ConnectionError("this port has left the bus")


class MemoryLine(ByteLine):
    """A line to the laboratory: bytes out are collected, bytes in are put in."""

    def __init__(self) -> None:
        self.out = b""
        self.arrived = b""

    def send(self, data: bytes) -> None:
        """Send bytes."""
        self.out += data

    def receive(self) -> bytes:
        """The bytes that arrived since the last call."""
        arrived, self.arrived = self.arrived, b""
        return arrived

    def close(self) -> None:
        """Drop what is on its way."""
        self.out = self.arrived = b""


class LockstepPorts(DevicePorts):
    """Implements `services.device.Ports` for one device; `post` sends to the laboratory."""

    def __init__(
        self,
        directory: Directory,
        device: DeviceEntry,
        clock: Callable[[], float],
        post: Callable[[Envelope], None],
    ) -> None:
        super().__init__(directory, device, clock)
        self._post = post
        self._can: MemoryCan | None = None
        self._serial: MemoryLine | None = None
        self._tcp: dict[int, tuple[int, MemoryLine]] = {}
        """By port: number of the newest connection, and the connection."""
        self._images: MemoryImages | None = None
        self._wish = 0
        self._streams: dict[str, SetpointReceiver] = {}
        self._lives_at = ""

    def can(self) -> MemoryCan:
        """The laboratory's CAN bus."""
        if self._can is None:
            self._laboratory()
            self._can = MemoryCan()
        return self._can

    def serial(self, port: str, baud: int) -> MemoryLine:
        """The laboratory's serial line to this device."""
        if self._serial is None:
            self._laboratory()
            self._serial = MemoryLine()
        return self._serial

    def tcp(self, host: str, port: int) -> MemoryLine:
        """Return a new connection to a port of the laboratory's robot."""
        number, _ = self._tcp.get(port, (0, None))
        line = MemoryLine()
        self._tcp[port] = number + 1, line
        self._send("tcp", tcp_body(port, number + 1, b""))
        return line

    def images(self) -> ImageSource:
        """Return the laboratory's camera if the device has `source = "sim"`, otherwise the source
        that it names (a file)."""
        if self._device.config.get("source") != "sim":
            return self._open_images()
        if self._images is None:
            self._laboratory()
            self._images = MemoryImages(self._want_images)
        return self._images

    def stream(self, name: str) -> SetpointReceiver:
        """Return the receiving end of a stream that services.toml directs to this device. Raises
        ValueError for any other."""
        entry = self._stream_entry(name)
        return self._streams.setdefault(name, SetpointReceiver(entry.period, self._clock))

    def receive(self, envelope: Envelope) -> None:
        """Take what the laboratory or a stream sends to this device."""
        if envelope.channel == "can" and self._can is not None:
            self._can.arrived += read_can(envelope.body)
        elif envelope.channel == "serial" and self._serial is not None:
            self._serial.arrived += envelope.body
        elif envelope.channel == "tcp":
            port, number, data = read_tcp(envelope.body)
            newest, line = self._tcp.get(port, (0, None))
            if line is not None and number == newest:
                line.arrived += data
        elif envelope.channel == "image" and self._images is not None:
            image, wish = read_image(envelope.body, self.now)
            if wish == self._wish:
                self._images.put(image)
        elif envelope.channel == "stream":
            point = read_set_point(envelope.body)
            if point.stream in self._streams:
                self._streams[point.stream].take(point.values, point.held)

    def flush(self) -> None:
        """Send the frames and bytes of this tick."""
        if self._serial is not None and self._serial.out:
            self._send("serial", self._serial.out)
            self._serial.out = b""
        for port, (number, line) in self._tcp.items():
            if line.out:
                self._send("tcp", tcp_body(port, number, line.out))
                line.out = b""
        if self._can is not None and self._can.out:
            self._send("can", can_body(self._can.out))
            self._can.out.clear()

    def _want_images(self, rate: float) -> None:
        self._wish += 1
        self._send("control", images_wanted(rate, self._wish))

    def _send(self, channel: str, body: Any) -> None:
        laboratory = self._laboratory()
        self._post(Envelope(laboratory, self._device.name, laboratory, channel, body))

    def _laboratory(self) -> str:
        if not self._lives_at:
            self._lives_at = self._directory.laboratory()
        if not self._lives_at:
            text = f"{self._directory.source}: devices.{self._device.name}: lock step has no line "
            text += "to a real device; run it in real time, or "
            text += 'write sim = "module:function" in one [nodes.NAME] (docs/drivers.md)'
            raise DirectoryError((text,))
        return self._lives_at


Substitutes = Mapping[str, Callable[..., Any]]
_ANSWERS = (Welcome, Refuse, Accept, Feedback, Outcome, Event, Answer, Pong)
"""Messages of a callee."""


class LockstepNode:
    """Implements `services.comm.lockstep.party.Party` for one node of services.toml. Raises
    DirectoryError if a driver refuses its keys.

    Endpoints (action, device, service, timer) send under their own names, whatever their node, and
    a call within one node takes the same way as any other. So moving an action to another node
    changes nothing.
    """

    def __init__(
        self, directory: Directory, name: str, *, substitutes: Substitutes | None = None
    ) -> None:
        self.name = name
        self._directory = directory
        self._substitutes = substitutes
        self._watchdog = Watchdog(name)
        self._now = 0.0
        self._out: list[Envelope] = []
        self._ports: dict[str, LockstepPorts] = {}
        self._heard = True
        """Whether a message arrived since the last tick."""
        self._parties: dict[str, str] = {}
        """By endpoint that was looked up: its party."""
        self._ends: dict[str, tuple[str, str]] = {}
        """By call id: the calling endpoint and the called one."""
        devices = [d for d in directory.devices.values() if d.node == name]
        places: dict[str, Host] = {d.name: self._place(d.name) for d in devices}
        places[GENERAL] = self._place(GENERAL)
        boot = f"{name} in lock step"
        self.node = Node(directory, name, boot=boot, clock=self._clock, places=places, virtual=True)
        for peer in sorted(directory.nodes):
            self.node.caller(peer).open(0.0)

    def _clock(self) -> float:
        return self._now

    def _place(self, device: str) -> Host:
        """A device all of whose actions are scripted gets no driver: it may be a real one."""
        directory, driver, reseed = self._directory, None, None
        own = {
            a.name: a
            for a in directory.actions.values()
            if (a.node, a.device) == (self.name, device)
        }
        substitutes = self._substitutes or {}
        scripted = bool(own) and all(isinstance(substitutes.get(a), Scripted) for a in own)
        if device != GENERAL and not scripted:
            entry = directory.devices[device]
            ports = self._ports[device] = LockstepPorts(
                directory, entry, self._clock, self._out.append
            )
            with chdir("."):  # it may change the folder of this process, which is not its own
                driver = make_driver(directory, entry, ports)
            reseed = ports.draws.reseed
            if device not in directory.without_actions(self.name):
                reseed(0)
        return InlineHost(
            own,
            clock=self._clock,
            driver=driver,
            streams={s.name: s.period for s in directory.streams.values()},
            substitutes=self._substitutes,
            virtual=True,
            reseed=reseed,
            device=device,
        )

    # --- party --------------------------------------------------------------------------------

    def receive(self, now: float, envelope: Envelope) -> None:
        """Take an envelope that is due. Raises CellError if code that is called hangs."""
        self._now = now
        if envelope.channel == "call":
            self._heard = True
            self._guarded(self._receive_message, now, envelope, envelope.body)
        elif envelope.target in self._ports:  # A port only keeps it: no code of users is called.
            self._ports[envelope.target].receive(envelope)

    def advance(self, now: float) -> None:
        """Do all that is due. Raises CellError if code that is called hangs."""
        self._guarded(self._advance, now)

    def _guarded(self, step: Callable[..., None], *arguments: Any) -> None:
        try:
            with self._watchdog:
                step(*arguments)
        except Hung as fault:  # in a driver or a service; an action would have ended its own run
            raise CellError(f"node {self.name}: {describe(fault)}") from fault
        except DeviceError as fault:
            raise CellError(f"node {self.name}: {fault}") from fault

    def _advance(self, now: float) -> None:
        self._now = now
        news = self._advance_node(now)
        for device, ports in self._ports.items():
            ports.flush()
            for name, data in ports.raised():
                self.node.callee.raise_event(now, name, data, source=device, latched=True)
                news = True
        if news:
            self._send_set_points()
            self._send_messages(now)

    def _advance_node(self, now: float) -> bool:
        """Let the node do all that is due. Return whether it may have produced messages. In most
        ticks no message arrived, and calls need not be looked at."""
        node = self.node
        if self._heard or not node.ends_quiet(now):
            self._heard = False
            node.advance(now)
            return True
        news = node.advance_places(now)
        if news:
            node.settle(now)
        return news

    def _send_set_points(self) -> None:
        for action, sent in self.node.sent:
            stream = self._directory.streams[sent.stream]
            body = set_point_body(sent.stream, sent.values, sent.elapsed, stream.period)
            self._out.append(
                Envelope(self._directory.where(sent.stream), action, stream.to, "stream", body)
            )
        self.node.sent.clear()

    def drain(self) -> Sequence[Envelope]:
        """Return what was sent since the last call, in order."""
        if not self._out:
            return ()
        out = self._out[:]
        self._out.clear()
        return out

    def close(self) -> None:
        """Close the devices."""
        self._watchdog.close()
        with chdir("."):
            self.node.close(self._now)

    # --- messages -----------------------------------------------------------------------------

    def _receive_message(self, now: float, envelope: Envelope, message: Message) -> None:
        peer = self._parties.get(envelope.source)
        if peer is None:
            peer = self._parties[envelope.source] = self._directory.party(envelope.source)
        if isinstance(message, _ANSWERS):
            self.node.caller(peer).receive(now, message)
        elif isinstance(message, Hello):
            local = self._directory.same_host(self.name, peer)
            self._post(
                peer, self.name, peer, self.node.callee.link_up(now, peer, message, local=local)
            )
        else:
            if isinstance(message, Call):
                self._ends[message.id] = (envelope.source, message.service)
            self.node.callee.receive(now, peer, message)

    def _send_messages(self, now: float) -> None:
        for peer, message in self.node.callee.messages():
            source, target = self._answering_ends(peer, message)
            self._post(peer, source, target, message)
        for peer, caller in self.node.callers.items():
            for message in caller.messages(now):
                source, target = self._calling_ends(peer, message)
                self._post(peer, source, target, message)

    def _answering_ends(self, peer: str, message: Message) -> tuple[str, str]:
        if isinstance(message, Event):
            return message.source, peer
        if isinstance(message, Outcome) and message.id in self._ends:
            target, source = self._ends.pop(message.id)
            return source, target
        if isinstance(message, Accept | Feedback) and message.id in self._ends:
            target, source = self._ends[message.id]
            return source, target
        return self.name, peer

    def _calling_ends(self, peer: str, message: Message) -> tuple[str, str]:
        if isinstance(message, Call):
            return self.node.action_of(message.parent), message.service
        return self.name, peer

    def _post(self, party: str, source: str, target: str, message: Message) -> None:
        self._out.append(Envelope(party, source, target, "call", message))
