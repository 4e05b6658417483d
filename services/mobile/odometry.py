"""Odometry: the rover's pose from its wheels, in a frame of its own (the odometry frame), and where
it was a moment ago."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

HISTORY = 50
"""Poses that are remembered: one second of cycles of 20 ms, far longer than an image is old."""


class Pose(NamedTuple):
    """A point of the floor (m) and a heading (rad, counter-clockwise from x)."""

    x: float
    y: float
    heading: float

    def body(self, x: float, y: float) -> tuple[float, float]:
        """Return a point of the odometry frame relative to this pose (m ahead, m to the left)."""
        dx, dy = x - self.x, y - self.y
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return dx * cos + dy * sin, dy * cos - dx * sin

    def floor(self, ahead: float, left: float) -> tuple[float, float]:
        """Return a point given relative to this pose in the odometry frame (m)."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return self.x + ahead * cos - left * sin, self.y + ahead * sin + left * cos


def turned(angle: float) -> float:
    """Return an angle normalised to (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


class Odometry:
    """Integrates the distances of both wheels. `track_width` is the distance between their contact
    points (m)."""

    def __init__(self, track_width: float) -> None:
        self._width = track_width
        self.pose = Pose(0.0, 0.0, 0.0)
        self.way = 0.0
        """Way travelled, however curved (m); turning on the spot adds nothing."""
        self._history: deque[tuple[float, Pose]] = deque(maxlen=HISTORY)

    def add(self, now: float, left: float, right: float) -> None:
        """Add the distances (m) that the wheels have rolled since the last call; exact on circular
        arcs."""
        way, turn = 0.5 * (left + right), (right - left) / self._width
        x, y, heading = self.pose
        # Between two calls both wheels are taken to turn evenly, so the rover moves on an arc:
        # chord = 2 R sin(turn / 2), in the mean direction (the chord of a circle).
        chord = way if abs(turn) < 1e-9 else 2.0 * way / turn * math.sin(0.5 * turn)
        middle = heading + 0.5 * turn
        self.pose = Pose(x + chord * math.cos(middle), y + chord * math.sin(middle), heading + turn)
        self.way += abs(way)
        self._history.append((now, self.pose))

    def at(self, time: float) -> Pose:
        """Return the pose at a time (s) of the last second, interpolated; the oldest known pose for
        earlier times."""
        later: tuple[float, Pose] | None = None
        for then, pose in reversed(self._history):
            if then <= time:
                if later is None:
                    return pose
                part = (time - then) / (later[0] - then)
                return Pose(*(a + part * (b - a) for a, b in zip(pose, later[1], strict=True)))
            later = (then, pose)
        return later[1] if later is not None else self.pose
