"""Which candidates are a rolling ball: those that, image after image, lie on one straight line at
one fitting speed.

Stickers, glare and the arm also make candidates; they do not roll towards the near edge. Pure:
times (s) and places come in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Track:
    """A ball that was seen to roll: `times` (n,) s, `places` (n, 2) m, `velocity` (2,) m/s and the
    `residual` (m, rms) of the places about the straight line of even speed through them."""

    times: Array
    places: Array
    velocity: Array
    residual: float


@dataclass(frozen=True, slots=True)
class Rolling:
    """What counts as a ball that rolls towards the near edge (m, s)."""

    slowest: float = 0.25
    fastest: float = 3.5
    towards: float = -0.15
    """m/s, x velocity at most: towards the near edge."""
    gate: float = 0.015
    """How far a candidate may lie from where the track expects it."""
    spread: float = 0.008
    """Largest rms residual of a confirmed track."""
    shortest: float = 0.03
    """Way that a confirmed track covers at least."""


class Confirmation:
    """Joins candidates of successive images to tracks, and confirms one that has `count` of
    them."""

    MOST = 40
    MISSED = 3

    def __init__(self, count: int, rolling: Rolling | None = None) -> None:
        """`count` >= 3 consistent detections confirm a ball."""
        self._count = max(3, count)
        self._rolling = rolling or Rolling()
        self._tracks: list[list[tuple[float, float, float]]] = []
        self._missed: list[int] = []

    def add(self, time: float, places: Sequence[Sequence[float]] | Array) -> Track | None:
        """Take the candidates (n, 2) m of the image of `time` (s, rising); a track as soon as one
        is confirmed."""
        free = [(time, float(x), float(y)) for x, y in places]
        kept, missed = [], []
        for track, misses in zip(self._tracks, self._missed, strict=True):
            nearest = self._extension(track, free)
            if nearest is not None:
                kept.append([*track, nearest])
                missed.append(0)
            elif misses < self.MISSED:
                kept.append(track)
                missed.append(misses + 1)
        used = {track[-1] for track in kept if track[-1][0] == time and len(track) > 2}
        fresh = [[candidate] for candidate in free if candidate not in used]
        self._tracks = (kept + fresh)[-self.MOST :]
        self._missed = (missed + [0] * len(fresh))[-self.MOST :]
        confirmed = [
            found for track in self._tracks if (found := self._confirmed(track)) is not None
        ]
        return min(confirmed, key=lambda found: found.residual) if confirmed else None

    def _extension(
        self, track: list[tuple[float, float, float]], free: list[tuple[float, float, float]]
    ) -> tuple[float, float, float] | None:
        """The candidate that goes on with a track best, None if none does."""
        best, least = None, np.inf
        for candidate in free:
            away = self._misfit(track, candidate)
            if away < least:
                best, least = candidate, away
        return best

    def _misfit(
        self, track: list[tuple[float, float, float]], candidate: tuple[float, float, float]
    ) -> float:
        """How badly a candidate goes on with a track (m); inf when not at all."""
        t, x, y = track[-1]
        step = candidate[0] - t
        vx, vy = (candidate[1] - x) / step, (candidate[2] - y) / step
        speed = float(np.hypot(vx, vy))
        if (
            not self._rolling.slowest <= speed <= self._rolling.fastest
            or vx > self._rolling.towards
        ):
            return float("inf")
        if len(track) == 1:
            return speed * step
        fit = _line(np.array(track[-6:]))
        expected = fit[0] + fit[1] * candidate[0]
        away = float(np.hypot(candidate[1] - expected[0], candidate[2] - expected[1]))
        return away if away <= self._rolling.gate else float("inf")

    def _confirmed(self, track: list[tuple[float, float, float]]) -> Track | None:
        if len(track) < self._count or self._missed[self._tracks.index(track)]:
            return None
        rows = np.array(track)
        offset, velocity = _line(rows)
        residual = float(
            np.sqrt(np.mean(np.sum((rows[:, 1:] - offset - rows[:, :1] * velocity) ** 2, axis=1)))
        )
        way = float(np.hypot(*(rows[-1, 1:] - rows[0, 1:])))
        if residual > self._rolling.spread or way < self._rolling.shortest:
            return None
        return Track(rows[:, 0], rows[:, 1:], velocity, residual)


def _line(rows: Array) -> tuple[Array, Array]:
    """Place at time 0 (2,) and velocity (2,) of the straight line of even speed through rows t, x,
    y."""
    middle = rows.mean(axis=0)
    off = rows - middle
    velocity = off[:, 0] @ off[:, 1:] / max(float(off[:, 0] @ off[:, 0]), 1e-12)
    return middle[1:] - velocity * middle[0], velocity
