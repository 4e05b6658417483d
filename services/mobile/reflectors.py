"""Retroreflectors around the rover: echoes of the sensor, gathered to spots in the odometry frame.

An echo may be missing or false. A reflector stands still while the rover moves: echoes that
repeatedly agree on a spot are one reflector, and an echo that stays alone is not one.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Final

from msgspec import Struct

from petrobot.services.mobile.model import Sensor
from petrobot.services.mobile.odometry import Pose

ECHOES: Final = struct.Struct("<hHhH")
"""TPDO1 of the sensor: bearing (0.1 mrad, left positive) and slant range (mm, 0: no echo),
twice."""
NEAR: Final = 0.25
"""Distance within which echoes belong to one reflector (m)."""
BELIEVED: Final = 4
"""Echoes that make a reflector."""
LONELY: Final = 1.5
"""Seconds after which a spot with fewer echoes is forgotten."""
REMEMBERED: Final = 20.0
"""Seconds after which a believed reflector is forgotten: odometry drifts, so an old position is
wrong."""
MOST: Final = 24
"""Most spots that are kept."""


class EchoSpot(Struct):
    """A spot that echoes came from: mean of the latest ones (m, odometry frame), their number, and
    when the last came (s)."""

    x: float
    y: float
    count: int
    last: float


def parse_echoes(data: bytes) -> list[tuple[float, float]]:
    """Return bearings (rad) and slant ranges (m) in the sensor's frame from the data of its TPDO.
    Raises ValueError for data of another length."""
    if len(data) != ECHOES.size:
        raise ValueError(
            f"TPDO of the reflector sensor: expected {ECHOES.size} bytes, got {len(data)}"
        )
    b1, r1, b2, r2 = ECHOES.unpack(data)
    return [(b / 1e4, r / 1e3) for b, r in ((b1, r1), (b2, r2)) if r]


class ReflectorMap:
    """Where the reflectors around one rover are."""

    def __init__(self, sensor: Sensor, reflector_height: float) -> None:
        self._forward = sensor.forward
        self._above = reflector_height - sensor.height
        self._places: list[EchoSpot] = []
        self.echoes = 0

    def take(self, now: float, pose: Pose, echoes: Sequence[tuple[float, float]]) -> None:
        """Take echoes (bearing rad, slant range m) received at a pose."""
        for bearing, slant in echoes:
            if slant <= abs(self._above):
                continue
            self.echoes += 1
            # The reflector's height is known, so the slant range gives the horizontal distance.
            level = math.sqrt(slant * slant - self._above * self._above)
            x, y = pose.floor(self._forward + level * math.cos(bearing), level * math.sin(bearing))
            self._note(now, x, y)
        patience = {True: REMEMBERED, False: LONELY}
        self._places = [p for p in self._places if now - p.last < patience[p.count >= BELIEVED]][
            -MOST:
        ]

    def believed(self, now: float) -> list[tuple[float, float, int, float]]:
        """Return the reflectors: x, y (m, odometry frame), number of echoes, and how long ago the
        last one came (s)."""
        return [(p.x, p.y, p.count, now - p.last) for p in self._places if p.count >= BELIEVED]

    def _note(self, now: float, x: float, y: float) -> None:
        near = min(self._places, key=lambda p: math.hypot(p.x - x, p.y - y), default=None)
        if near is None or math.hypot(near.x - x, near.y - y) > NEAR:
            self._places.append(EchoSpot(x, y, 1, now))
            return
        near.count, near.last = near.count + 1, now
        part = 1.0 / min(near.count, 12)
        near.x += part * (x - near.x)
        near.y += part * (y - near.y)
