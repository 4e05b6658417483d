"""Fixtures: the rover's laboratory on the bench with a small CANopen master, written for these
tests, and a driver that knows the true state."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import (
    SYNC,
    DataType,
    NmtCommand,
    map_pdo,
    nmt,
    pdo_struct,
    sdo_read_request,
    sdo_write_request,
)
from petrobot.services.comm.canopen.cia402 import (
    SENT,
    VELOCITY_RECEIVED,
    ObjectIndex,
    OperationMode,
    to_units,
)
from petrobot.services.comm.lockstep.channels import can_body
from petrobot.services.comm.lockstep.party import TICK
from petrobot.sim.track.laboratory import TrackLaboratory
from petrobot.sim.track.truth import TrackSite, read_track_site
from tests.sim.laboratory_bench import LaboratoryBench

REPOSITORY = Path(__file__).parents[3]
ROVER_FILE = REPOSITORY / "services" / "mobile" / "rover.toml"
PARTIES = {"rover": "drive", "camera": "vision"}
SYNC_TICKS = 5
RADIUS, WIDTH = 0.10, 0.40
_RPDO, _TPDO = pdo_struct(VELOCITY_RECEIVED), pdo_struct(SENT)


@pytest.fixture(scope="session")
def track_site() -> TrackSite:
    """The shipped site."""
    return read_track_site(ROVER_FILE)


class RoverMaster:
    """Configures both drives and the sensor over SDO, enables the drives, and sends speed set
    points (rad/s, left and right)."""

    def __init__(self) -> None:
        self.wanted = [0.0, 0.0]
        self.enable = True
        self.status = [0, 0]
        self.positions = [0, 0]
        self.echoes: list[list[tuple[float, float]]] = []
        self.emergencies: list[tuple[int, int]] = []
        self.replies: dict[tuple[int, int], bytes] = {}
        self._setup = self._setup_frames()
        self._word = 0

    @staticmethod
    def _setup_frames() -> list[list[Frame]]:
        groups = [[nmt(NmtCommand.ENTER_PREOPERATIONAL)]]
        for node in (1, 2):
            transfers = map_pdo(
                ObjectIndex.RPDO1, ObjectIndex.RPDO1_MAPPING, 0x200 + node, 1, VELOCITY_RECEIVED
            )
            transfers += map_pdo(
                ObjectIndex.TPDO1, ObjectIndex.TPDO1_MAPPING, 0x180 + node, 1, SENT
            )
            writes = [(t.index, t.sub, t.type.pack(t.value or 0)) for t in transfers]
            writes.append((ObjectIndex.SYNC_PERIOD, 0, DataType.UNSIGNED32.pack(20_000)))
            writes.append(
                (
                    ObjectIndex.MODE,
                    0,
                    DataType.INTEGER8.pack(OperationMode.CYCLIC_SYNCHRONOUS_VELOCITY),
                )
            )
            groups.append([sdo_write_request(node, *write) for write in writes])
        groups.append([sdo_write_request(3, 0x1800, 1, DataType.UNSIGNED32.pack(0x183))])
        return [*groups, [nmt(NmtCommand.START)]]

    def frames(self, now: float = 0.0) -> list[Frame]:
        """Frames of a cycle: set points and SYNC."""
        if self._setup:
            return self._setup.pop(0)
        if not self.enable:
            self._word = 0x00
        elif any(word & 0x08 for word in self.status):
            self._word = (
                0x00 if self._word == 0x80 else 0x80
            )  # A rising edge of the bit resets a fault.
        else:
            self._word = {0x00: 0x06, 0x80: 0x06, 0x06: 0x07}.get(self._word, 0x0F)
        frames = [
            Frame(0x201 + side, _RPDO.pack(self._word, to_units(self.wanted[side])))
            for side in (0, 1)
        ]
        return [*frames, SYNC]

    def take(self, frames: Sequence[Frame]) -> None:
        """Frames of drives and sensor."""
        for frame in frames:
            if frame.id in (0x181, 0x182):
                side = frame.id - 0x181
                self.status[side], self.positions[side], _ = _TPDO.unpack(frame.data)
            elif frame.id == 0x183:
                a, b, c, d = struct.unpack("<hHhH", frame.data)
                self.echoes.append([(x * 1e-4, r * 1e-3) for x, r in ((a, b), (c, d)) if r])
            elif 0x81 <= frame.id <= 0x83:
                self.emergencies.append((frame.id - 0x80, int.from_bytes(frame.data[:2], "little")))
            elif 0x581 <= frame.id <= 0x583 and frame.data[0] & 0xE0 == 0x40:
                self.replies[frame.id - 0x580, int.from_bytes(frame.data[1:3], "little")] = (
                    frame.data[4:]
                )

    @property
    def enabled(self) -> bool:
        """Return whether both drives are in OPERATION ENABLED."""
        return all(word & 0x6F == 0x27 for word in self.status)


class RoverBench(LaboratoryBench):
    """The rover's laboratory, its master, and a driver that knows the true state."""

    cycle = SYNC_TICKS

    def __init__(self, site: TrackSite, **options: Any) -> None:
        self.lab = TrackLaboratory(
            "laboratory", site, lambda name: PARTIES.get(name, name), **options
        )
        self.master = RoverMaster()
        super().__init__(self.lab, self.master, "rover")

    def read(self, node: int, index: int, kind: DataType) -> int:
        """Read an object of a node over SDO."""
        self.master.replies.pop((node, index), None)
        self.post("can", "rover", can_body([sdo_read_request(node, index, 0)]))
        assert self.run(lambda: (node, index) in self.master.replies, 0.1)
        return kind.unpack(self.master.replies[node, index][: kind.size])

    def drive(self, speed: float, turn: float) -> None:
        """Set the speeds (m/s, rad/s), using the nominal parameters."""
        self.master.wanted = [
            (speed - 0.5 * WIDTH * turn) / RADIUS,
            (speed + 0.5 * WIDTH * turn) / RADIUS,
        ]

    def pursue(self, speed: float, end: float, ahead: float = 0.35) -> None:
        """Pursue the point of the true centre line `ahead` metres ahead, and stop beyond arc length
        `end` (m)."""
        x, y, heading = self.lab.rover.pose
        near = self.lab.track.nearest(x, y)
        there = self.lab.track.at(near.s + ahead)
        dx, dy = there.x - x, there.y - y
        aside = dy * math.cos(heading) - dx * math.sin(heading)
        speed = speed if near.s < end else 0.0
        self.drive(speed, 2.0 * speed * aside / (dx * dx + dy * dy))

    def follow(
        self, speed: float = 0.5, end: float | None = None, at_most: float = 200.0
    ) -> dict[str, Any]:
        """Drive along the true centre line to the T, or to `end`, and stop; return the score."""
        goal = self.lab.track.length if end is None else end
        for _ in range(round(at_most / (SYNC_TICKS * TICK))):
            self.pursue(speed, goal - 0.02)
            self.wait(SYNC_TICKS * TICK)
            if self.master.wanted == [0.0, 0.0] and self.lab.rover.standing:
                break
        self.wait(0.6)
        return self.lab.referee.score(self.now)


@pytest.fixture
def rover_bench(track_site: TrackSite) -> Callable[..., RoverBench]:
    """Return a function that makes benches; options as for TrackLaboratory."""
    return lambda **options: RoverBench(track_site, **options)


@pytest.fixture
def rover_master() -> Callable[[], RoverMaster]:
    """Return a function that makes masters for the rover's bus."""
    return RoverMaster
