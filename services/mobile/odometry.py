"""Where the rover is, by its wheels: pose in a frame of its own (the odometry frame), and where it
was a moment ago."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

HISTORY = 50
"""Poses that are remembered: a second of cycles of 20 ms, far more than an image is old."""


class Pose(NamedTuple):
    """A point of the floor (m) and a heading (rad, counter-clockwise from x)."""

    x: float
    y: float
    heading: float

    def body(self, x: float, y: float) -> tuple[float, float]:
        """A point of the odometry frame as seen from this pose (m ahead, m to the left)."""
        dx, dy = x - self.x, y - self.y
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return dx * cos + dy * sin, dy * cos - dx * sin

    def floor(self, ahead: float, left: float) -> tuple[float, float]:
        """A point as seen from this pose in the odometry frame (m)."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        return self.x + ahead * cos - left * sin, self.y + ahead * sin + left * cos


def turned(angle: float) -> float:
    """An angle brought to (-pi, pi]."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


class Odometry:
    """Integrates the ways of both wheels. `track_width` is the distance between their contact
    points (m)."""

    def __init__(self, track_width: float) -> None:
        self._width = track_width
        self.pose = Pose(0.0, 0.0, 0.0)
        self.way = 0.0
        """m travelled, however curved; turning on the spot is none."""
        self._history: deque[tuple[float, Pose]] = deque(maxlen=HISTORY)

    def add(self, now: float, left: float, right: float) -> None:
        """The wheels have rolled so far (m) since the last call; exact on arcs of circles."""
        way, turn = 0.5 * (left + right), (right - left) / self._width
        x, y, heading = self.pose
        chord = way if abs(turn) < 1e-9 else 2.0 * way / turn * math.sin(0.5 * turn)
        middle = heading + 0.5 * turn
        self.pose = Pose(x + chord * math.cos(middle), y + chord * math.sin(middle), heading + turn)
        self.way += abs(way)
        self._history.append((now, self.pose))

    def at(self, time: float) -> Pose:
        """The pose at a time (s) of the last second, interpolated; the oldest one known for earlier
        ones."""
        later: tuple[float, Pose] | None = None
        for then, pose in reversed(self._history):
            if then <= time:
                if later is None:
                    return pose
                part = (time - then) / (later[0] - then)
                return Pose(*(a + part * (b - a) for a, b in zip(pose, later[1], strict=True)))
            later = (then, pose)
        return later[1] if later is not None else self.pose
