"""A laboratory on the bench: stepped tick by tick with the master of its bus and a caller;
envelopes take one tick each way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.lockstep.channels import can_body, images_wanted, read_can
from petrobot.services.comm.lockstep.party import TICK, Envelope, Party
from petrobot.services.comm.protocol.messages import Call, Hello, Outcome


class BusMaster(Protocol):
    """Whoever leads the drives of a laboratory's bus."""

    @property
    def enabled(self) -> bool:
        """Whether all drives are in OPERATION ENABLED."""

    @property
    def status(self) -> list[int]:
        """Their statuswords."""

    def frames(self, now: float) -> list[Frame]:
        """Frames of this cycle."""

    def take(self, frames: Sequence[Frame]) -> None:
        """Frames of the drives and sensors."""


class LaboratoryBench:
    """The laboratory's envelopes, its answers and images by the tick. `bus`: the device that the
    master speaks for."""

    cycle = 1
    """Ticks between two cycles of the master."""
    cut = False
    """Whether the master is silent."""

    def __init__(self, party: Party, lead: BusMaster, bus: str) -> None:
        self._party, self._lead, self._bus = party, lead, bus
        self.tick = 0
        self.images: list[tuple[float, Any]] = []
        """When each came, and its body."""
        self.answers: list[Outcome] = []
        self._inbox: list[Envelope] = []
        self._calls = 0
        self.post("call", "coordinator", Hello(2, 99, "coordinator", "coordinator", "boot"))

    @property
    def now(self) -> float:
        """Time of the next tick (s)."""
        return self.tick * TICK

    def post(self, channel: str, source: str, body: Any) -> None:
        """Send an envelope to the laboratory."""
        self._inbox.append(Envelope("laboratory", source, "laboratory", channel, body))

    def want_images(self, rate: float) -> None:
        """Ask for images."""
        self.post("control", "camera", images_wanted(rate, 1))

    def call(self, service: str, **arguments: Any) -> Outcome:
        """Call a service and wait for its answer."""
        self._calls += 1
        self.post("call", "coordinator", Call(f"call-{self._calls}", service, arguments))
        before = len(self.answers)
        self.run(lambda: len(self.answers) > before, 0.1)
        return self.answers[-1]

    def step(self) -> None:
        """One tick."""
        now = self.now
        if self.tick % self.cycle == 0 and not self.cut:
            self.post("can", self._bus, can_body(self._lead.frames(now)))
        inbox, self._inbox = self._inbox, []
        for envelope in inbox:
            self._party.receive(now, envelope)
        self._party.advance(now)
        self.tick += 1
        for envelope in self._party.drain():
            if envelope.channel == "can":
                self._lead.take(read_can(envelope.body))
            elif envelope.channel == "image":
                self.images.append((self.now, envelope.body))
            elif isinstance(envelope.body, Outcome):
                self.answers.append(envelope.body)

    def run(self, until: Callable[[], bool], at_most: float) -> bool:
        """Step until it holds, at most so many seconds; says whether it held."""
        for _ in range(round(at_most / TICK)):
            if until():
                return True
            self.step()
        return until()

    def wait(self, seconds: float) -> None:
        """Step for so many seconds."""
        self.run(lambda: False, seconds)

    def enable(self) -> None:
        """Set up and enable the drives."""
        assert self.run(lambda: self._lead.enabled, 1.0), self._lead.status
