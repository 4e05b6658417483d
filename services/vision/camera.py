"""Driver of the camera over the table: keeps what was learned between runs, and marks for the
operator what was seen."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from petrobot.services.action import Context
from petrobot.services.camera import CameraDriver
from petrobot.services.comm.streams.image import Image
from petrobot.services.device import key
from petrobot.services.host.toml_text import read_toml
from petrobot.services.vision.calibration import DEFAULT, parse_calibration
from petrobot.services.vision.location import Background, BallDetector
from petrobot.services.vision.optics import TableView
from petrobot.services.vision.prediction import Surface

CELL = Path(__file__).parents[1] / "cell.toml"
REMEMBERED = 256
"""Images whose times are remembered, for a tracker that continues where a locator finished."""
SHOWN_RADIUS_PX = 12.0
MOST_SHOWN = 8
"""Most candidates that are drawn over an image."""


class Mark(Struct, frozen=True):
    """What an action saw in an image, for the operator: `pixels` of shape (n, 2), or `table`
    positions in m for what it predicts."""

    label: str
    pixels: Any = ()
    table: Any = ()


class Camera(CameraDriver):
    """A camera that knows where it is mounted, and the table below it."""

    calibration: str = key("", "file beside services.toml; that of the simulated camera if empty")
    cell: str = key("", "file of the cell's data beside services.toml; the shipped one if empty")

    def setup(self) -> None:
        cell = self._cell()
        name = self.calibration
        text = self.ports.file(name).decode() if name else DEFAULT.read_text(encoding="utf-8")
        self.calibrated = parse_calibration(text, name or DEFAULT.name)
        self.view = TableView.of(cell, self.calibrated.optics)
        self.surface = Surface.of(cell)
        self.background = Background()
        self.usual_rate = float(cell["camera"]["rate"])
        self.shape = (self.view.height_px, self.view.width_px)
        self.shaped_by = "[camera] of the cell's file and calibrate again"
        self._detectors: dict[str, BallDetector] = {}
        self._times: deque[tuple[int, float]] = deque(maxlen=REMEMBERED)
        self.marks: tuple[Mark, ...] = ()
        """What was seen in the last image read; actions set it, the operator's picture shows it."""

    # For actions

    async def read(self, ctx: Context, timeout: float) -> Image | None:
        image = await super().read(ctx, timeout)
        if image is not None:
            self.marks = ()
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
        return {**super().state(), "background_images": self.background.images}

    def picture(self) -> Mapping[str, Any]:
        """Return the last image read, with what was seen in it."""
        picture = super().picture()
        shapes = [shape for mark in self.marks for shape in self._shapes(mark)]
        return {**picture, "detections": shapes} if picture else {}

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

    def hold(self, now: float) -> str:
        """Refuse a pause while images are taken: the ball rolls on."""
        return "held" if self.stopped() else "cannot hold"

    def _cell(self) -> dict[str, Any]:
        name = self.cell
        text = self.ports.file(name).decode() if name else CELL.read_text(encoding="utf-8")
        return read_toml(text, name or CELL.name)
