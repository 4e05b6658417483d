"""Locating: reads images until a detector's candidates are confirmed as a ball that rolls toward
the near edge.

Candidates are a rolling ball if, image after image, they lie on one straight line at one plausible
speed. Stickers, glare and the arm also produce candidates, but they do not roll towards the near
edge.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.services.action import (
    Cancelled,
    Context,
    Result,
    error,
    failure,
    provisional,
    success,
)
from petrobot.services.camera import CameraError
from petrobot.services.comm.streams.image import Image
from petrobot.services.vision.camera import Camera, Mark
from petrobot.services.vision.location import BallDetector, MixtureOfGaussians
from petrobot.services.vision.specification import Specification

# --- Confirmation --------------------------------------------------------------------------------

Array = NDArray[np.float64]


class BallTrack(Struct, frozen=True):
    """A ball that was seen to roll.

    `times` (n,) s, `places` (n, 2) m, and the `residual` (m, rms) of the places about the straight
    line of constant speed through them.
    """

    times: Array
    places: Array
    residual: float


class Confirmation:
    """Joins candidates of successive images to tracks, and confirms a track that has `count` of
    them."""

    MOST = 40
    """Most tracks kept; the oldest go first."""
    MISSED = 3
    """Images in a row in which a track may find no candidate."""
    SLOWEST, FASTEST = 0.25, 3.5
    """Slowest and fastest ball (m/s)."""
    TOWARDS = -0.15
    """Greatest x velocity (m/s): negative, towards the near edge."""
    GATE = 0.015
    """Greatest distance of a candidate from where the track expects it (m)."""
    SPREAD = 0.008
    """Largest rms residual of a confirmed track (m)."""
    SHORTEST = 0.03
    """Shortest way that a confirmed track must cover (m)."""

    def __init__(self, count: int) -> None:
        """`count` consistent detections, at least 3, confirm a ball."""
        self._count = max(3, count)
        self._tracks: list[list[tuple[float, float, float]]] = []
        self._missed: list[int] = []

    def add(self, time: float, places: Sequence[Sequence[float]] | Array) -> BallTrack | None:
        """Take the candidates (n, 2) m of the image at `time` (s, rising); return a track as soon
        as one is confirmed."""
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
        """Return the candidate that continues a track best, None if none does."""
        best, least = None, np.inf
        for candidate in free:
            away = self._misfit(track, candidate)
            if away < least:
                best, least = candidate, away
        return best

    def _misfit(
        self, track: list[tuple[float, float, float]], candidate: tuple[float, float, float]
    ) -> float:
        """Return how badly a candidate continues a track (m); inf when it does not."""
        t, x, y = track[-1]
        step = candidate[0] - t
        vx, vy = (candidate[1] - x) / step, (candidate[2] - y) / step
        speed = float(np.hypot(vx, vy))
        if not self.SLOWEST <= speed <= self.FASTEST or vx > self.TOWARDS:
            return float("inf")
        if len(track) == 1:
            return speed * step
        fit = _line(np.array(track[-6:]))
        expected = fit[0] + fit[1] * candidate[0]
        away = float(np.hypot(candidate[1] - expected[0], candidate[2] - expected[1]))
        return away if away <= self.GATE else float("inf")

    def _confirmed(self, track: list[tuple[float, float, float]]) -> BallTrack | None:
        if len(track) < self._count or self._missed[self._tracks.index(track)]:
            return None
        rows = np.array(track)
        offset, velocity = _line(rows)
        residual = float(
            np.sqrt(np.mean(np.sum((rows[:, 1:] - offset - rows[:, :1] * velocity) ** 2, axis=1)))
        )
        way = float(np.hypot(*(rows[-1, 1:] - rows[0, 1:])))
        if residual > self.SPREAD or way < self.SHORTEST:
            return None
        return BallTrack(rows[:, 0], rows[:, 1:], residual)


def _line(rows: Array) -> tuple[Array, Array]:
    """Return position at time 0 (2,) and velocity (2,) of the least-squares line of constant speed
    through rows t, x, y."""
    middle = rows.mean(axis=0)
    off = rows - middle
    velocity = off[:, 0] @ off[:, 1:] / max(float(off[:, 0] @ off[:, 0]), 1e-12)
    return middle[1:] - velocity * middle[0], velocity


# --- Searching -----------------------------------------------------------------------------------

LEARN_EVERY = 10
"""The stored background learns from every tenth image."""


class LocateSpecification(Specification, frozen=True):
    """When a ball counts as located, and how accurately (s, m)."""

    timeout: float = 5.0
    """Time after which it is an error that no ball was found (s)."""
    confirmations: float = 4.0
    """Consistent detections that confirm a ball."""
    rate: float = 0.0
    """Images/s; 0: the camera's usual rate."""
    image_timeout: float = 0.8
    """Time without an image after which the camera counts as dead (s)."""
    within: float = 0.0
    """m that the last place may be beside the ball's path, which the tracker measures: it gives
    the verdict. 0: the scatter of the places (`max_residual`) judges at once."""
    max_residual: float = 0.0015
    """m, rms of the places about a straight line of constant speed; above it FAILURE
    `inaccurate`."""
    min_ahead: float = 1.0
    """m that the ball must still be before the near edge; below it FAILURE `late`."""


async def locate(
    ctx: Context,
    name: str,
    make: Callable[[Camera], BallDetector],
    sigma: float,
    specification: LocateSpecification,
) -> Result:
    """Locate with the detector that `make` makes; the camera keeps it under `name`. `sigma` is its
    accuracy (m).

    The images continue after SUCCESS and FAILURE, for the tracker; they end with ERROR.
    """
    camera: Camera = ctx.device
    search = _Search(ctx, camera, camera.detector(name, lambda: make(camera)), specification)
    try:
        result = await search.run(sigma)
    except (CameraError, ConnectionError) as fault:
        result = error("bad_image" if isinstance(fault, CameraError) else "no_image", str(fault))
    except Cancelled:
        camera.end()
        raise
    if result.cause in ("no_ball", "no_image", "bad_image"):
        camera.end()
    if specification.within > 0.0 and "images" in result.values:
        # what the run used, for its cost
        result = replace(result, values={**result.values, "count": result.values["images"]})
    return result


class _Search:
    """One run of a locator."""

    def __init__(
        self,
        ctx: Context,
        camera: Camera,
        detector: BallDetector,
        specification: LocateSpecification,
    ) -> None:
        self._ctx = ctx
        self._camera = camera
        self._detector = detector
        self._specification = specification
        self._confirmation = Confirmation(int(specification.confirmations))
        self._images = 0

    async def run(self, sigma: float) -> Result:
        """Read images until a ball is confirmed, or the time is up."""
        asked = self._specification
        if self._camera.start(asked.rate) and isinstance(self._detector, MixtureOfGaussians):
            self._detector.forget()
        over = self._ctx.now + asked.timeout
        silent = self._ctx.now
        while self._ctx.now < over:
            image = await self._camera.read(
                self._ctx, min(over, silent + asked.image_timeout) - self._ctx.now
            )
            if image is None and self._ctx.now >= silent + asked.image_timeout:
                text = self._camera.missing(f"no image for {asked.image_timeout} s")
                return error("no_image", text, images=self._images)
            if image is None:
                continue
            silent = self._ctx.now
            track = self._look(image)
            if track is not None:
                return self._judge(track, image, sigma)
        return error("no_ball", f"no rolling ball in {self._images} images", images=self._images)

    def _look(self, image: Image) -> BallTrack | None:
        self._images += 1
        background = self._camera.background
        candidates = self._detector.detect(image.pixels)
        places = self._camera.view.to_table(candidates) if len(candidates) else candidates
        self._camera.marks = (Mark("candidate", pixels=candidates),)
        if not background.known or self._images % LEARN_EVERY == 0:
            background.learn(image.pixels)
        return self._confirmation.add(image.time, places)

    def _judge(self, track: BallTrack, image: Image, sigma: float) -> Result:
        """Return the confirmed ball as plain data; SUCCESS when it meets the specification."""
        asked = self._specification
        ahead = float(track.places[-1, 0]) - self._camera.view.near_edge
        ball: dict[str, Any] = {
            "sequence": image.sequence,
            "age": self._ctx.now - image.time,
            "sigma": sigma,
            "places": [
                [float(t - image.time), float(x), float(y)]
                for t, (x, y) in zip(track.times, track.places, strict=True)
            ],
        }
        values = {"ball": ball, "images": self._images, "residual": track.residual, "ahead": ahead}
        if ahead < asked.min_ahead:
            return failure(
                "late",
                f"confirmed {ahead:.2f} m before the near edge, not {asked.min_ahead} m",
                **values,
            )
        if asked.within > 0.0:
            ball |= {"run": self._ctx.run, "within": asked.within}  # the tracker judges
            return provisional(success(**values))
        if track.residual > asked.max_residual:
            text = (
                f"places scatter by {track.residual * 1e3:.1f} mm, not "
                f"{asked.max_residual * 1e3:.1f} mm"
            )
            return failure("inaccurate", text, **values)
        return success(**values)
