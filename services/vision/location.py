"""Where the ball is in an image: five detectors over the whole table, which differ in cost and in
what deceives them, and the measurement in a small window that tracks a known ball.

Every detector takes an image (height, width) uint8 and returns candidates (n, 2): the ball's centre
in pixels. Each keeps its own state. Time, cameras, and the question which candidate is the ball
(`locating.py`) are not their concern.
"""

from __future__ import annotations

import math
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from petrobot.services.vision.optics import TableView

Array = NDArray[np.float64]
Pixels = NDArray[np.uint8]
NOTHING: Array = np.empty((0, 2))
_NEIGHBOURS: Pixels = np.ones((3, 3), np.uint8)

HALF = 2
"""Detectors over the whole table first look at images of half the size."""
SMALLEST, LARGEST = 0.45, 1.9
"""Area of a candidate, relative to the area that a ball covers (largest: with the streak of the
fastest ball)."""
ROUNDEST_FILL = 0.55
"""Least share of its bounding box that a candidate fills. A disc fills pi/4, a streaked one more;
scattered pixels and slanting stripes less."""
FASTEST = 3.5
"""Speed of the fastest ball that is looked for (m/s)."""


class BallDetector(Protocol):
    """Finds candidates in one image."""

    def detect(self, pixels: Pixels) -> Array:
        """Return candidate centres (n, 2) px."""


class Background:
    """Mean grey levels of the empty table, learned from images and kept between runs.

    The first `first` images count equally, each later one with weight `rate`: slow changes of light
    are followed, and a passing ball leaves less than a detector's threshold.
    """

    def __init__(self, first: int = 5, rate: float = 0.08) -> None:
        self._first = first
        self._rate = rate
        self._mean: NDArray[np.float32] | None = None
        self.images = 0
        self.picture: Pixels | None = None
        """The model as grey levels (height, width), None before the first image."""

    @property
    def known(self) -> bool:
        """Whether enough images were learned to subtract."""
        return self.images >= self._first

    def learn(self, pixels: Pixels) -> None:
        """Include an image in the mean."""
        self.images += 1
        if self._mean is None or self._mean.shape != pixels.shape:
            self._mean, self.images = pixels.astype(np.float32), 1
        else:
            cv2.accumulateWeighted(pixels, self._mean, max(1.0 / self.images, self._rate))
        self.picture = np.asarray(cv2.convertScaleAbs(self._mean), np.uint8)


def ball_blobs(mask: Pixels, radius: float, streak: float) -> Array:
    """Return the centroids (n, 2) of the regions of a mask (0 or 255) that have a ball's size and
    shape; radius and streak in its px."""
    if cv2.countNonZero(mask) == 0:  # Usually nothing rolls.
        return NOTHING
    count, _, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count <= 1:
        return NOTHING
    area, wide, high = (
        stats[1:, k].astype(float)
        for k in (cv2.CC_STAT_AREA, cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT)
    )
    disc = np.pi * radius * radius
    largest = 2.0 * radius * 1.35 + streak + 2.0
    good = (
        (area > SMALLEST * disc)
        & (area < LARGEST * disc + 2.0 * radius * streak)
        & (np.maximum(wide, high) < largest)
        & (np.minimum(wide, high) > 0.9 * radius)
        & (area > ROUNDEST_FILL * wide * high)
    )
    return np.asarray(centres[1:][good], float)


class _WholeTable:
    """Common part of the detectors over the whole table: the region of the table at half size, and
    the conversion back to pixels."""

    def __init__(self, view: TableView) -> None:
        self.view = view
        rows, columns = view.region
        self._rows, self._columns = rows, columns
        self._corner = np.array([columns.start, rows.start], float)
        self._half_size = ((columns.stop - columns.start) // HALF, (rows.stop - rows.start) // HALF)

    def half(self, pixels: Pixels) -> Pixels:
        """Return the table at half the size, each pixel the mean of four."""
        return np.asarray(
            cv2.resize(
                pixels[self._rows, self._columns], self._half_size, interpolation=cv2.INTER_AREA
            ),
            np.uint8,
        )

    def blobs(self, mask: Pixels) -> Array:
        """Return ball-like regions of a half-size mask as pixels of the image, only those on the
        table."""
        streak = self.view.streak_px(FASTEST) / HALF
        return self.on_table(self.from_half(ball_blobs(mask, self.view.radius_px / HALF, streak)))

    def from_half(self, centres: Array) -> Array:
        """Convert pixels of the half-size region to pixels of the image (pixel centres at whole
        numbers in both)."""
        return np.asarray(centres * HALF + (HALF - 1) / 2.0 + self._corner)

    def on_table(self, pixels: Array) -> Array:
        """Keep the pixels whose position is on the table."""
        return pixels[self.view.on_table(self.view.to_table(pixels))] if len(pixels) else pixels


class BackgroundSubtraction(_WholeTable):
    """Finds what is brighter than the stored picture of the empty table. Cheap and accurate; blind
    when the light has changed by more than its threshold since the picture was learned."""

    THRESHOLD = 24.0
    """Grey levels: 16 sigma of the half-size noise, a fifth of a ball's contrast in full light."""

    def __init__(self, view: TableView, background: Background) -> None:
        super().__init__(view)
        self._background = background
        self._window = BallWindow(view)
        self._halved: Pixels | None = None
        self._half_picture: Pixels = np.empty((0, 0), np.uint8)

    def detect(self, pixels: Pixels) -> Array:
        """Return candidates, refined to parts of a pixel; none before the background is known."""
        picture = self._background.picture
        if picture is None or not self._background.known:
            return NOTHING
        if picture is not self._halved:  # The background makes a new picture each time it learns.
            self._halved, self._half_picture = picture, self.half(picture)
        found = []
        for centre in self.blobs(self._mask(self.half(pixels), self._half_picture)):
            seen = self._window.measure(
                pixels, picture, centre, streak=self.view.streak_px(FASTEST)
            )
            if seen is not None:
                found.append(seen)
        return np.array(found) if found else NOTHING

    def _mask(self, half: Pixels, empty: Pixels) -> Pixels:
        """Return where an image is brighter than the empty table (0 or 255), both at half size."""
        brighter = cv2.subtract(half, empty)
        return np.asarray(
            cv2.threshold(brighter, self.THRESHOLD, 255, cv2.THRESH_BINARY)[1], np.uint8
        )


class CompensatedSubtraction(BackgroundSubtraction):
    """Finds what is brighter than the stored picture in the light of this very image.

    The picture is scaled by the ratio of the medians, that is by how much brighter the whole table
    has become. Works in light that flickers, switches or drifts, as long as the whole table is lit
    alike.
    """

    LEAST_THRESHOLD = 10.0
    """Grey levels: 6 sigma of the half-size noise."""

    def _mask(self, half: Pixels, empty: Pixels) -> Pixels:
        gain = _median(half) / max(_median(empty), 1.0)
        brighter = cv2.subtract(half, cv2.convertScaleAbs(empty, alpha=gain))
        threshold = max(self.THRESHOLD * gain, self.LEAST_THRESHOLD)
        return np.asarray(cv2.threshold(brighter, threshold, 255, cv2.THRESH_BINARY)[1], np.uint8)


class MixtureOfGaussians(_WholeTable):
    """OpenCV's MOG2 (Z. Zivkovic, "Improved adaptive Gaussian mixture model for background
    subtraction", 2004): several grey levels per pixel, each with its own spread, learned
    continuously. Follows changing light; costs most, and needs some images before it knows the
    table."""

    WARM_UP = 6
    """Images that only teach the model."""

    def __init__(self, view: TableView) -> None:
        super().__init__(view)
        self._model: Any = cv2.createBackgroundSubtractorMOG2(
            history=60, varThreshold=30.0, detectShadows=True
        )
        self._images = 0

    def forget(self) -> None:
        """Learn quickly again: there were no images for a while."""
        self._images = 0

    def detect(self, pixels: Pixels) -> Array:
        """Return candidates, accurate to about half a pixel; none during the first images."""
        self._images += 1
        rate = 0.4 if self._images <= 3 else 0.04
        mask = self._model.apply(self.half(pixels), None, rate)
        if self._images < self.WARM_UP:
            return NOTHING
        mask = cv2.threshold(mask, 200, 255, cv2.THRESH_BINARY)[1]  # OpenCV marks shadows with 127.
        return self.blobs(np.asarray(cv2.medianBlur(mask, 3), np.uint8))


class HoughCircles(_WholeTable):
    """Finds circles of the ball's size by OpenCV's gradient Hough transform. Needs neither a
    background nor a certain light; coarse, and every round thing is a candidate."""

    EDGE, VOTES = 60.0, 11.0
    MOST = 12

    def detect(self, pixels: Pixels) -> Array:
        """Return the circles with the most votes."""
        radius = self.view.radius_px
        smooth = cv2.GaussianBlur(pixels[self._rows, self._columns], (5, 5), 1.2)
        circles = cv2.HoughCircles(
            smooth,
            cv2.HOUGH_GRADIENT,
            dp=1.5,
            minDist=3.0 * radius,
            param1=self.EDGE,
            param2=self.VOTES,
            minRadius=int(0.7 * radius),
            maxRadius=int(1.4 * radius) + 1,
        )
        if circles is None:
            return NOTHING
        return self.on_table(
            np.asarray(circles, float).reshape(-1, 3)[: self.MOST, :2] + self._corner
        )


class FixedThreshold(_WholeTable):
    """Finds all that is brighter than one grey level. Cheapest, needs no background; fails where
    the light is uneven or changes."""

    LEVEL = 160.0

    def detect(self, pixels: Pixels) -> Array:
        """Return candidates, accurate to about half a pixel."""
        mask = cv2.threshold(self.half(pixels), self.LEVEL, 255, cv2.THRESH_BINARY)[1]
        return self.blobs(np.asarray(mask, np.uint8))


class BallWindow:
    """Measures a ball whose position is roughly known.

    The change of light since the background was learned is taken from the window itself. A ball
    that is partly hidden by arm or cup, or merged with them, is not measured.
    """

    CONTRAST = 25.0
    """Grey levels by which a ball must be brighter than the background, if nothing else is
    asked."""
    LEAST_COVER, MOST_COVER = 0.72, 1.30
    """Smallest and largest area relative to the expected one."""

    def __init__(self, view: TableView, contrast: float = CONTRAST) -> None:
        """`contrast`: grey levels by which a ball must be brighter than the background."""
        self.view = view
        self._contrast = contrast

    def measure(
        self,
        pixels: Pixels,
        background: Pixels,
        expected: Array,
        streak: float = 0.0,
        spread: float = 4.0,
    ) -> Array | None:
        """Return the centre (2,) px of the ball nearest to `expected` (2,) px, at most `spread` px
        away; `streak`: its longest path during the exposure (px).

        None where no whole ball is in view.
        """
        radius = self.view.radius_px
        reach = int(np.ceil(spread + 1.5 * radius + streak / 2.0 + 3.0))
        box = self._box(expected, reach)
        if box is None:
            return None
        cover = self._cover(pixels[box], background[box])
        if cover is None:
            return None
        mask = (cover > 0.5).view(np.uint8)
        count, labels, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8)
        if count <= 1:
            return None
        middle = expected - (box[1].start, box[0].start)
        disc = np.pi * radius * radius
        best = self._nearest(
            stats[1:, cv2.CC_STAT_AREA],
            np.asarray(centres[1:], float),
            middle,
            disc,
            disc + 2.0 * radius * streak,
            spread,
        )
        if best is None:
            return None
        return self._centroid(cover, labels == best + 1, stats[best + 1], box)

    def _box(self, expected: Array, reach: int) -> tuple[slice, slice] | None:
        u, v = round(float(expected[0])), round(float(expected[1]))
        left, top = max(0, u - reach), max(0, v - reach)
        right, bottom = (
            min(self.view.width_px, u + reach + 1),
            min(self.view.height_px, v + reach + 1),
        )
        if right - left < reach or bottom - top < reach:
            return None
        return slice(top, bottom), slice(left, right)

    def _cover(self, region: Pixels, background: Pixels) -> NDArray[np.float32] | None:
        """Return how much of each pixel the ball covers: 0 background, 1 ball. The ball's own grey
        level is taken where it is brightest."""
        gain = _median(region) / max(_median(background), 1.0)
        empty = background.astype(np.float32) * gain
        brighter = region - empty
        smooth = cv2.blur(brighter, (3, 3))
        peak = float(smooth.max())
        if peak < self._contrast:
            return None
        level = cv2.mean(region, (smooth > 0.6 * peak).view(np.uint8))[0]
        return np.asarray(brighter / np.maximum(level - empty, self._contrast), np.float32)

    def _nearest(
        self,
        area: NDArray[Any],
        centres: Array,
        middle: Array,
        smallest: float,
        largest: float,
        spread: float,
    ) -> int | None:
        """Return the region with the area of a whole ball that is nearest to the expected
        position."""
        (u, v), best, least = middle.tolist(), None, math.inf
        low, high = self.LEAST_COVER * smallest, self.MOST_COVER * largest
        for number, (size, (x, y)) in enumerate(zip(area.tolist(), centres.tolist(), strict=True)):
            away = math.hypot(x - u, y - v)
            if low < size < high and away <= spread and away < least:
                best, least = number, away
        return best

    def _centroid(
        self,
        cover: NDArray[np.float32],
        mine: NDArray[np.bool_],
        stats: NDArray[Any],
        box: tuple[slice, slice],
    ) -> Array | None:
        left, top, wide, high = (int(value) for value in stats[:4])
        if left == 0 or top == 0 or left + wide == cover.shape[1] or top + high == cover.shape[0]:
            return None  # Cut off by the border of the window or the image.
        part = slice(top - 1, top + high + 1), slice(left - 1, left + wide + 1)
        # Pixels of the rim count by the part that is covered, all others fully, even on the ball's
        # shaded side.
        weight = np.minimum(np.maximum((cover[part] - 0.15) / 0.30, 0.0), 1.0)
        weight *= cv2.dilate(mine[part].view(np.uint8), _NEIGHBOURS)
        total = float(weight.sum())
        u = float(weight.sum(axis=0) @ np.arange(left - 1, left + wide + 1)) / total
        v = float(weight.sum(axis=1) @ np.arange(top - 1, top + high + 1)) / total
        return np.array([u + box[1].start, v + box[0].start])


def _median(region: Pixels) -> float:
    """Return the median of every third grey level along both axes."""
    sample = region[::3, ::3].ravel()
    return float(np.partition(sample, sample.size // 2)[sample.size // 2])
