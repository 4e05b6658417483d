"""A rover on its bus in a yard with a track, for the tests of driver and actions: simulated drives,
an ideal camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.lockstep.party import TICK
from petrobot.services.mobile.rover import Rover
from petrobot.services.mobile.sight import LineEnd, TrackAhead, TrackEnd
from petrobot.services.worker.setpoints import SetpointReceiver
from petrobot.sim.track.drives import Echo, ReflectorSensor, RoverBus, look
from petrobot.sim.track.rover import RoverBody as Body
from petrobot.sim.track.truth import read_track_site
from tests.bare_ports import BarePorts
from tests.mobile.conftest import DrawnFloor, DrawnPose

ROVER_FILE = Path(__file__).parents[2] / "services" / "mobile" / "rover.toml"
IMAGE = 0.04
CYCLE = 0.02


class YardBus:
    """The driver's port."""

    def __init__(self, bus: RoverBus) -> None:
        self.bus, self.now, self.cut = bus, 0.0, False

    def send(self, frame: Frame) -> None:
        """To the devices."""
        if self.cut:
            raise ConnectionError("the cable is cut")
        self.bus.receive(self.now, frame)

    def receive(self) -> Sequence[Frame]:
        """From them."""
        if self.cut:
            raise ConnectionError("the cable is cut")
        return self.bus.drain()

    def close(self) -> None:
        """Leave."""


class YardPorts(BarePorts):
    """What the driver may reach."""

    def __init__(self, bus: YardBus) -> None:
        self.now = 0.0
        self._bus = bus
        self.receiver = SetpointReceiver(IMAGE, lambda: self.now)

    def can(self) -> YardBus:
        """The bus."""
        return self._bus

    def stream(self, name: str) -> SetpointReceiver:
        """The stream of sights."""
        assert name == "track_ahead"
        return self.receiver

    def raise_event(self, name: str, **data: Any) -> None:
        """Ignore the event: no task waits for it."""

    def file(self, path: str) -> bytes:
        """The rover's numbers."""
        return ROVER_FILE.read_bytes()


class Yard:
    """A floor with a track, the rover's body, its bus and its driver. `world` is for `rehearse(...,
    world=yard.world)`."""

    def __init__(
        self,
        floor: DrawnFloor,
        begin: DrawnPose,
        *,
        reflectors: Sequence[tuple[float, float]] = (),
        seed: int = 1,
    ) -> None:
        truth = read_track_site(ROVER_FILE).truth("plain")
        self.floor, self.reflectors = floor, reflectors
        random = np.random.default_rng(seed)
        self.body = Body(truth.rover, random)
        start = begin.x, begin.y, begin.heading
        self.body.place(truth.rover, start, random)  # type: ignore[arg-type]
        self._sensor = truth.sensor
        self.bus = YardBus(RoverBus(self.body, ReflectorSensor(self._echoes)))
        self._random = np.random.default_rng(seed + 1)
        self.ports = YardPorts(self.bus)
        self.rover = Rover({}, self.ports)
        self.camera = True
        self.errors: list[float] = []
        """Distances from the centre line (m), one each image."""
        self._line = [floor.at(0.02 * i) for i in range(round(50 * _length(floor)) + 1)]
        self._painted = [_painted(floor, 0.02 * i) for i in range(len(self._line))]
        self._due = 0.0

    def world(self, now: float) -> None:
        """One tick of bus, body and camera."""
        self.ports.now = self.bus.now = now
        self.bus.bus.step(now)
        if now >= self._due - 1e-9:
            self._due = now + IMAGE
            self.errors.append(
                min(math.hypot(p.x - self.body.x, p.y - self.body.y) for p in self._line)
            )
            if self.camera:
                self.ports.receiver.take(self._sight().values())

    def run(self, seconds: float) -> None:
        """Let time pass without any action."""
        for tick in range(round(seconds / TICK)):
            now = self.ports.now + TICK
            self.world(now)
            if tick % round(CYCLE / TICK) == 0:
                self.rover.step(now)

    @property
    def pose(self) -> DrawnPose:
        """Return the rover's true pose."""
        return DrawnPose(self.body.x, self.body.y, self.body.heading)

    def beyond(self, place: DrawnPose) -> tuple[float, float]:
        """How far the rover is ahead and to the left of a pose (m)."""
        cos, sin = math.cos(place.heading), math.sin(place.heading)
        dx, dy = self.body.x - place.x, self.body.y - place.y
        return dx * cos + dy * sin, dy * cos - dx * sin

    def _echoes(self, now: float) -> list[Echo]:
        return look(self._sensor, self.body.pose, self.reflectors, self._random)

    def _sight(self) -> TrackAhead:
        """Return what an ideal camera reports: the nearest connected row of painted points in its
        view, and where it ends."""
        rows: list[tuple[float, float]] = []
        end: LineEnd | None = None
        for place, painted in zip(self._line, self._painted, strict=True):
            dx, dy = place.x - self.body.x, place.y - self.body.y
            cos, sin = math.cos(self.body.heading), math.sin(self.body.heading)
            x, y = dx * cos + dy * sin, dy * cos - dx * sin
            inside = 0.43 < x < 1.5 and abs(y) < 0.3 + 0.2 * x
            if rows and not painted and inside and end is None and x - rows[-1][0] < 0.05:
                end = LineEnd(TrackEnd.INTERRUPTION, x, y)
            if (
                inside
                and painted
                and end is None
                and (not rows or math.hypot(x - rows[-1][0], y - rows[-1][1]) < 0.1)
            ):
                rows.append((x, y))
            if self.floor.bar and inside and place is self._line[-1] and rows:
                end = LineEnd(TrackEnd.T, x, y)
        points = tuple(rows[:: max(1, len(rows) // 11)][:12]) if len(rows) > 8 else ()
        return TrackAhead(0.0, 1.0 if points else 0.0, end if points else None, points)


def _length(floor: DrawnFloor) -> float:
    total = sum(2.0 if letter.upper() == "S" else math.pi / 2 for letter, _ in floor.elements)
    return total - 0.25 if floor.bar else total


def _painted(floor: DrawnFloor, s: float) -> bool:
    for letter, _ in floor.elements:
        s -= 2.0 if letter.upper() == "S" else math.pi / 2
        if s < 0.0:
            return letter.isupper()
    return floor.elements[-1][0].isupper()
