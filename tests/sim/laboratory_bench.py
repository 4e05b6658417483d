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
    """The master of a laboratory's bus."""

    @property
    def enabled(self) -> bool:
        """Return whether all drives are in OPERATION ENABLED."""

    @property
    def status(self) -> list[int]:
        """Return the drives' statuswords."""

    def frames(self, now: float) -> list[Frame]:
        """Return the frames of this cycle."""

    def take(self, frames: Sequence[Frame]) -> None:
        """Process the frames of the drives and sensors."""


class LaboratoryBench:
    """The laboratory's envelopes, answers and images by tick. `bus`: the device whose driver the
    master replaces."""

    cycle = 1
    """Number of ticks between two cycles of the master."""
    cut = False
    """Whether the master is silent."""

    def __init__(self, party: Party, lead: BusMaster, bus: str) -> None:
        self._party, self._lead, self._bus = party, lead, bus
        self.tick = 0
        self.images: list[tuple[float, Any]] = []
        """Tick of arrival and body of each."""
        self.answers: list[Outcome] = []
        self._inbox: list[Envelope] = []
        self._calls = 0
        self.post("call", "coordinator", Hello(2, 99, "coordinator", "coordinator", "boot"))

    @property
    def now(self) -> float:
        """Return the time of the next tick (s)."""
        return self.tick * TICK

    def post(self, channel: str, source: str, body: Any) -> None:
        """Send an envelope to the laboratory."""
        self._inbox.append(Envelope("laboratory", source, "laboratory", channel, body))

    def want_images(self, rate: float) -> None:
        """Request images."""
        self.post("control", "camera", images_wanted(rate, 1))

    def call(self, service: str, **arguments: Any) -> Outcome:
        """Call a service and wait for its answer."""
        self._calls += 1
        self.post("call", "coordinator", Call(f"call-{self._calls}", service, arguments))
        before = len(self.answers)
        self.run(lambda: len(self.answers) > before, 0.1)
        return self.answers[-1]

    def step(self) -> None:
        """Run one tick."""
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
        """Step until the condition holds or the time (s) is over; return whether it held."""
        for _ in range(round(at_most / TICK)):
            if until():
                return True
            self.step()
        return until()

    def wait(self, seconds: float) -> None:
        """Step for a time (s)."""
        self.run(lambda: False, seconds)

    def enable(self) -> None:
        """Configure and enable the drives."""
        assert self.run(lambda: self._lead.enabled, 1.0), self._lead.status
