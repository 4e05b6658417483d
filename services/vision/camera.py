"""Driver of a camera over the table: starts and stops images, passes them to actions, and keeps
what was learned between runs."""

from __future__ import annotations

import tomllib
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from petrobot.services.action import Context
from petrobot.services.comm.streams.image import Image, RequestedImages
from petrobot.services.device import Driver, Ports, refuse_unknown_keys
from petrobot.services.vision.calibration_file import DEFAULT, parse_calibration
from petrobot.services.vision.location import Background, BallDetector
from petrobot.services.vision.prediction import Surface
from petrobot.services.vision.table import TableView

KEYS = ("calibration", "cell", "rate", "threads")
"""The driver's own keys in services.toml."""
CELL = Path(__file__).parents[1] / "cell.toml"
REMEMBERED = 256
"""Images whose times are remembered, for a tracker that continues where a locator finished."""

QUALITY = 75
"""Quality of the JPEGs for the operator (0 to 100)."""
SHOWN_RADIUS_PX = 12.0
MOST_SHOWN = 8
"""Most candidates that are drawn over an image."""


class CameraError(ValueError):
    """The camera's configuration or its images cannot be used; the message says what to change."""


@dataclass(frozen=True, slots=True)
class Mark:
    """What an action saw in an image, for the operator: `pixels` of shape (n, 2), or `table`
    positions in m for what it predicts."""

    label: str
    pixels: Any = ()
    table: Any = ()


class Camera(Driver):
    """A device without cyclic work. Its keys in services.toml, all optional except those of its
    source:

    `calibration`: file beside services.toml (default: that of the simulated camera); `cell`: the
    cell's data (default: the shipped one); `rate`: images/s (default: the cell's); `threads`: for
    OpenCV (default 1: other nodes share the cores).
    """

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        refuse_unknown_keys(config, KEYS)
        self._ports = ports
        self._images = RequestedImages(ports.images())
        cv2.setNumThreads(int(config.get("threads", 1)))
        cell = _cell(config, ports)
        name = str(config.get("calibration", ""))
        text = ports.file(name).decode() if name else DEFAULT.read_text(encoding="utf-8")
        self.calibration = parse_calibration(text, name or DEFAULT.name)
        self.view = TableView.of(cell, self.calibration.optics)
        self.surface = Surface.of(cell)
        self.background = Background()
        self.usual_rate = _rate(config.get("rate", cell["camera"]["rate"]))
        self._detectors: dict[str, BallDetector] = {}
        self._times: deque[tuple[int, float]] = deque(maxlen=REMEMBERED)
        self._shown: Image | None = None
        self.marks: tuple[Mark, ...] = ()
        """What was seen in the last image read; actions set it, the operator's picture shows it."""
        self._count = 0

    # For actions

    @property
    def rate(self) -> float:
        """Images/s requested now, 0 when none."""
        return self._images.rate

    def start(self, rate: float = 0.0) -> bool:
        """Request images at `rate` (1/s; 0: the usual rate). Return False when they already arrive
        at that rate.

        Raises ConnectionError when the source cannot be opened.
        """
        wanted = rate or self.usual_rate
        if wanted == self.rate:
            return False
        self._images.start(wanted)
        return True

    def end(self) -> None:
        """Stop taking images."""
        self._images.end()

    async def read(self, ctx: Context, timeout: float) -> Image | None:
        """Return the newest image that was not read yet, None when none arrives for `timeout` s.
        Raises CameraError for an image of another size."""
        await ctx.wait(self._images.arrived, timeout)
        image = self._images.take()
        if image is None:
            return None
        if image.pixels.shape != (self.view.height_px, self.view.width_px):
            high, wide = image.pixels.shape
            raise CameraError(
                f"camera: expected images of {self.view.width_px}x{self.view.height_px} as in the "
                f"cell's file, got {wide}x{high}; change [camera] there and calibrate again"
            )
        self._count += 1
        self._shown, self.marks = image, ()
        self._times.append((image.sequence, image.time))
        return image

    def time_of(self, sequence: int) -> float | None:
        """Return the mid-exposure time (s) of a recently read image, None when it is not
        remembered."""
        return next((time for number, time in reversed(self._times) if number == sequence), None)

    def detector(self, name: str, make: Callable[[], BallDetector]) -> BallDetector:
        """Return the detector of this name with all that it has learned; make it at first use."""
        if name not in self._detectors:
            self._detectors[name] = make()
        return self._detectors[name]

    # For the node

    def state(self) -> Mapping[str, Any]:
        return {
            "rate": self.rate,
            "source": self._images.condition,
            "images": self._count,
            "background_images": self.background.images,
        }

    def picture(self) -> Mapping[str, Any]:
        """Return the last image read, with what was seen in it, as a JPEG; empty before the
        first."""
        image = self._shown
        if image is None:
            return {}
        coded, data = cv2.imencode(".jpg", image.pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        if not coded:
            return {}
        high, wide = image.pixels.shape
        return {
            "mime": "image/jpeg",
            "data": data.tobytes(),
            "width": wide,
            "height": high,
            "age": self._ports.now - image.time,
            "note": f"image {image.sequence}, {self.rate:g} images/s",
            "detections": [shape for mark in self.marks for shape in self._shapes(mark)],
        }

    def _shapes(self, mark: Mark) -> list[dict[str, Any]]:
        """Return a mark in the format of the page: circles where something was found, one path
        along what was predicted."""
        found = [(float(x), float(y)) for x, y in mark.pixels]
        shapes: list[dict[str, Any]] = [
            {
                "kind": "circle",
                "role": "found",
                "label": mark.label,
                "x": x,
                "y": y,
                "r": SHOWN_RADIUS_PX,
            }
            for x, y in found[:MOST_SHOWN]
        ]
        ahead = [
            [float(v) for v in self.view.to_pixels(np.asarray(point, dtype=float))]
            for point in mark.table
        ]
        if ahead:
            shapes.append({"kind": "path", "role": "predicted", "points": ahead})
            last = {
                "kind": "point",
                "role": "predicted",
                "label": mark.label,
                "x": ahead[-1][0],
                "y": ahead[-1][1],
            }
            shapes.append(last)
        return shapes

    def stop(self, now: float) -> None:
        self.end()

    def stopped(self) -> bool:
        """Return whether no images are taken; a camera never moves."""
        return self.rate == 0.0

    def close(self) -> None:
        self._images.close()


def _rate(value: Any) -> float:
    """Return the images/s of the configuration. Raises CameraError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value <= 1000.0:
        raise CameraError(
            f"camera: rate: expected images/s above 0 and at most 1000, such as 50, got {value!r}"
        )
    return float(value)


def _cell(config: Mapping[str, Any], ports: Ports) -> dict[str, Any]:
    name = str(config.get("cell", ""))
    text = ports.file(name).decode() if name else CELL.read_text(encoding="utf-8")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as fault:
        raise CameraError(f"{name or CELL.name}: not valid TOML ({fault}); correct it") from fault
