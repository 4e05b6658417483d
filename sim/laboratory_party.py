"""Common part of all simulated laboratories: a party with a bus, a camera and services, driven by
lock step or by real time.

A subclass is a world: it advances by `tick`, receives and sends frames, exposes images, and answers
its services. Nothing here uses wall-clock time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np

from petrobot.services.comm.calls.callee import Callee, Offer, Order
from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.lockstep.channels import (
    can_body,
    image_body,
    read_can,
    read_images_wanted,
    read_tcp,
    tcp_body,
)
from petrobot.services.comm.lockstep.party import TICK, Envelope
from petrobot.services.comm.protocol.messages import Call, Command, Executed, Outcome
from petrobot.sim.catching.camera import Picture, PinholeCamera
from petrobot.sim.catching.truth import Truth
from petrobot.sim.faults import FaultKinds, FaultPlan

# --- camera ---

_ON_TIME = 1e-9
"""How much rounding may change a time (s)."""
_NOISE_FIELD = 0x6361
"""Seed of a camera's noise field: the same whichever run comes first."""
_BUILT: dict[str, PinholeCamera] = {}


class Exposed(NamedTuple):
    """An image on its way out of the camera: it leaves at `ready`; `time` is the middle of its
    exposure (s)."""

    ready: float
    time: float
    sequence: int
    generation: int
    pixels: Picture


class Exposures:
    """The camera's clock. One request for images at a time."""

    def __init__(self) -> None:
        self.rate = 0.0
        self.generation = 0
        self._next = 0.0
        self._sequence = 0
        self._waiting: list[Exposed] = []

    def want(self, now: float, rate: float, generation: int) -> None:
        """Take `rate` images per second from now on (0: none); images exposed for an earlier
        request are not sent."""
        if rate > 0.0 and self.rate <= 0.0:
            self._next = now
        self.rate, self.generation = rate, generation
        self._waiting.clear()

    def due(self, now: float) -> bool:
        """Return whether an exposure has its middle at `now`; its clock advances whether the image
        is used or not."""
        if self.rate <= 0.0 or now < self._next - _ON_TIME:
            return False
        self._next = max(self._next, now - 1.0 / self.rate) + 1.0 / self.rate
        return True

    def put(self, now: float, ready: float, pixels: Picture) -> None:
        """Queue an image exposed at `now` that leaves the camera at `ready` (s); it must not be
        written any more."""
        pixels.flags.writeable = False
        self._waiting.append(Exposed(ready, now, self._sequence, self.generation, pixels))
        self._sequence += 1

    def take(self, until: float) -> list[Exposed]:
        """Return the images that leave up to `until` (s), in order."""
        if not self._waiting:
            return []
        count = 0
        while count < len(self._waiting) and self._waiting[count].ready <= until + _ON_TIME:
            count += 1
        gone, self._waiting = self._waiting[:count], self._waiting[count:]
        return gone


def camera_of(cell: Mapping[str, Any], truth: Truth, rng: np.random.Generator) -> PinholeCamera:
    """Return the camera as it is mounted in `truth`; `rng` chooses its noise until the next call.

    Drawing the static scene takes seconds, so cameras are cached; between two calls nothing of the
    last user stays in them.
    """
    true = truth.camera
    view: dict[str, Any] = {
        "position": true.position.tolist(),
        "rotation": true.rotation.tolist(),
        "focal_px": true.focal_px,
        "principal_px": true.principal_px,
        "distortion": true.distortion,
        "table_top": truth.table.top,
        "near_edge": truth.table.near_edge,
        "light_gradient": truth.light_gradient,
        "vignetting": truth.vignetting,
    }
    factor, hidden = truth.scatter.exposure_factor, truth.scatter.hidden
    if factor != 1.0:
        camera_cell = {**cell["camera"], "exposure": factor * cell["camera"]["exposure"]}
        cell = {**cell, "camera": camera_cell}
    if truth.cup.radius != cell["cup"]["radius"]:
        cell = {**cell, "cup": {**cell["cup"], "radius": truth.cup.radius}}
    if hidden[0] < hidden[1]:
        view["hidden"] = hidden
    key = repr((view, [cell[part] for part in ("camera", "table", "ball", "cup")]))
    if key not in _BUILT:
        _BUILT[key] = PinholeCamera(cell, view, np.random.default_rng(_NOISE_FIELD))
    camera = _BUILT[key]
    camera.reseed(rng)
    return camera


# --- party ---

PREPARE, SCORE, FAULT = SERVICES = ("laboratory_prepare", "laboratory_score", "laboratory_fault")
"""laboratory_prepare(...): begin a new experiment, return nothing; parameters of the task that do
not concern the laboratory are ignored. laboratory_score(...): see each laboratory's referee.
laboratory_fault(kind, after=0, ...): see sim.faults."""


def answer_command(now: float, callee: Callee, order: Order) -> None:
    """Answer an operator's command: a laboratory is running, and has no device that could be held
    or stopped."""
    if isinstance(order, Command):
        callee.answer(now, order.id, True, {"answers": {}, "devices": {}, "emergency": []})


class TcpSession(Protocol):
    """The robot's end of a TCP connection."""

    closed: bool
    """Set by either end."""

    def receive(self, data: bytes) -> None:
        """Take bytes of the driver."""

    def drain(self) -> bytes:
        """Return the bytes for the driver."""


class LaboratoryParty(ABC):
    """The party of a simulated node. `where` returns the party of an endpoint
    (`Directory.party`)."""

    services: ClassVar[Sequence[str]] = SERVICES
    """Services that it answers."""
    between_ticks: ClassVar[str] = PREPARE
    """The service that may take longer than a tick: in real time the world waits for it, not the
    callers."""
    tcp_ports: Sequence[int] = ()
    """Ports at which its robots accept TCP connections."""
    fault_kinds: ClassVar[FaultKinds]
    """The faults that it can inject."""
    faults: FaultPlan
    """Those of the present experiment."""

    def __init__(self, name: str, where: Callable[[str], str], boot: str, directory: str) -> None:
        """`boot`, `directory`: as in services.comm.calls.callee."""
        self.name = name
        self.physics = ""
        """Name and version of what computes its mechanics, for records; empty: there is only one
        way."""
        self.now = 0.0
        """Time of the world (s)."""
        offers = {
            service: Offer(inline=lambda _, call: self.answer(call)) for service in self.services
        }
        self.callee = Callee(name, boot, offers, directory=directory)
        self.exposures = Exposures()
        self._where = cache(where)
        self._camera_at: dict[str, str] = {}
        self._bus_ports: list[str] = []
        self._tcp: dict[tuple[str, int], tuple[int, TcpSession]] = {}
        """By device and port: number of the newest connection, and the connection."""
        self._out: list[Envelope] = []

    # What a world adds

    @abstractmethod
    def tick(self, now: float) -> None:
        """Expose the world as it is at `now`, then advance it to `now` + TICK."""

    # The defaults of these are for a world without such devices or services.
    def take_on_bus(self, now: float, frames: Sequence[Frame]) -> None:  # noqa: B027
        """Process frames of the master."""

    def take_frames(self) -> Sequence[Frame]:
        """Return the frames of the simulated devices since the last call."""
        return ()

    def take_on_serial(self, now: float, device: str, data: bytes) -> bytes:
        """Process what a device's driver sent on its serial line; return the answer."""
        return b""

    def connect(self, device: str, port: int) -> TcpSession:
        """Accept a connection of a device's driver to one of `tcp_ports`."""
        raise ValueError(f"nothing listens at port {port}")

    def prepare(self, arguments: Mapping[str, Any]) -> None:
        """Begin a new experiment. Raises ValueError for bad arguments."""
        raise ValueError("nothing to prepare")

    def make_ready(self, arguments: Mapping[str, Any]) -> None:  # noqa: B027
        """Do in advance, in any thread, what takes long in a preparation with these arguments.
        Raises ValueError."""

    def score(self, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Return the score of the experiment so far."""
        raise ValueError("no score")

    def close(self) -> None:  # noqa: B027
        """Release what the world holds."""

    # The party

    def serve(self, service: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Answer one of `services`. Raises ValueError for bad arguments."""
        if service == SCORE:
            return self.score(arguments)
        if service == FAULT:
            self.faults.add(self.fault_kinds.read(self.now, arguments))
        else:
            self.prepare(arguments)
        return {}

    def receive(self, now: float, envelope: Envelope) -> None:
        """Process frames, requests for images, and calls."""
        if envelope.channel == "can":
            self.receive_frames(now, envelope.source, read_can(envelope.body))
        elif envelope.channel == "serial":
            device = envelope.source
            if answer := self.take_on_serial(now, device, envelope.body):
                party = self._where(device)
                self._out.append(Envelope(party, self.name, device, "serial", answer))
        elif envelope.channel == "tcp":
            self._take_tcp(envelope.source, *read_tcp(envelope.body))
        elif envelope.channel == "control":
            wanted = read_images_wanted(envelope.body)
            if wanted is not None:
                self._camera_at = {envelope.source: self._where(envelope.source)}
                self.exposures.want(now, wanted.rate, wanted.generation)
        elif envelope.channel == "call":
            self.callee.receive(now, self._where(envelope.source), envelope.body)

    def advance(self, now: float) -> None:
        """Run one tick, then send."""
        self.tick(now)
        self._send_frames()
        self._send_images(now)
        self._send_tcp()
        callee = self.callee
        if now >= callee.soonest:
            callee.advance(now)
            callee.due()  # keeps `soonest` up to date
        for order in callee.orders():
            answer_command(now, callee, order)
        for peer, message in callee.messages():
            self._out.append(Envelope(peer, self.name, peer, "call", message))

    def drain(self) -> Sequence[Envelope]:
        """Return what was sent since the last call, in order."""
        out, self._out = self._out, []
        return out

    def receive_frames(self, now: float, port: str, frames: Sequence[Frame]) -> None:
        """Process frames of the endpoint `port`, which receives the bus's frames from now on."""
        if port not in self._bus_ports:
            self._bus_ports.append(port)
        self.take_on_bus(now, frames)

    def answer(self, call: Call) -> Outcome:
        """Answer a call of one of `services`."""
        try:
            values = self.serve(call.service, call.arguments)
        except ValueError as fault:
            return Outcome(call.id, "error", {}, "bad_arguments", str(fault), Executed.NO)
        return Outcome(call.id, "success", values)

    def _take_tcp(self, device: str, port: int, number: int, data: bytes) -> None:
        newest, session = self._tcp.get((device, port), (0, None))
        if number != newest:
            if session is not None:
                session.closed = True
            session = self.connect(device, port)
            self._tcp[device, port] = number, session
        if session is not None and data:
            session.receive(data)

    def _send_tcp(self) -> None:
        for (device, port), (number, session) in self._tcp.items():
            if data := session.drain():
                body = tcp_body(port, number, data)
                self._out.append(Envelope(self._where(device), self.name, device, "tcp", body))

    def _send_frames(self) -> None:
        if not self._bus_ports:
            return
        frames = self.take_frames()
        if frames:
            for port in self._bus_ports:
                self._out.append(
                    Envelope(self._where(port), self.name, port, "can", can_body(frames))
                )

    def _send_images(self, now: float) -> None:
        """Send images a tick early, with the age that they have on arrival: an image arrives one
        tick after it is sent."""
        arrival = now + TICK
        for image in self.exposures.take(arrival):
            body = image_body(image.pixels, arrival - image.time, image.sequence, image.generation)
            for device, party in self._camera_at.items():
                self._out.append(Envelope(party, self.name, device, "image", body))


def whole_number(arguments: Mapping[str, Any], key: str, default: int | None) -> int | None:
    """Return a whole number, 0 or more, from the arguments of a call. Raises ValueError."""
    value = arguments.get(key, default)
    if value is None and default is None:
        return None
    if type(value) is not int or value < 0:
        raise ValueError(
            f"{key}: expected a whole number of 0 or more"
            + (" or none" if default is None else "")
            + f", got {value!r}"
        )
    return value
