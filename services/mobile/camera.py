"""Driver of the camera that looks at the floor ahead: starts and stops images and passes them to
actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2

from petrobot.services.action import Context
from petrobot.services.comm.streams.image import Image, RequestedImages
from petrobot.services.device import Driver, Ports
from petrobot.services.mobile.model import NOMINAL, nominal_rover, read_rover
from petrobot.services.mobile.watching import FloorWatch


class FloorCameraError(ValueError):
    """The camera's configuration or its images cannot be used; the message says what to change."""


class FloorCamera(Driver):
    """A device without cyclic work. Its keys in services.toml, all optional except those of its
    source:

    `rover`: file of numbers beside services.toml (default: the shipped one); `rate`: images/s
    (default: the file's); `threads`: for OpenCV (default 1: other nodes share the cores).
    """

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        name = str(config.get("rover", ""))
        rover = read_rover(ports.file(name).decode(), name) if name else nominal_rover()
        cv2.setNumThreads(int(config.get("threads", 1)))
        self._images = RequestedImages(ports.images())
        self.floor = FloorWatch.of(rover)
        self.usual_rate = float(config.get("rate", rover.camera.rate))
        if not 0.0 < self.usual_rate <= 1000.0:
            raise FloorCameraError(
                "camera: rate: expected images/s above 0 and at most 1000, such as 25, got "
                f"{self.usual_rate}"
            )
        self._count = 0

    # For actions

    @property
    def rate(self) -> float:
        """Images/s requested now, 0 when none."""
        return self._images.rate

    def start(self) -> None:
        """Request images. Raises ConnectionError when the source cannot be opened."""
        if not self.rate:
            self._images.start(self.usual_rate)

    def end(self) -> None:
        """Stop taking images."""
        self._images.end()

    async def read(self, ctx: Context, timeout: float) -> Image | None:
        """Return the newest image that was not read yet, None when none arrives for `timeout` s.
        Raises FloorCameraError for an image of another size."""
        await ctx.wait(self._images.arrived, timeout)
        image = self._images.take()
        if image is None:
            return None
        view = self.floor.view
        if image.pixels.shape != (view.height, view.width):
            high, wide = image.pixels.shape
            raise FloorCameraError(
                f"the camera gives {wide}x{high} images, its numbers say "
                f"{view.width}x{view.height}: "
                f"change [camera] of {NOMINAL} or the camera's settings"
            )
        self._count += 1
        return image

    # For the node

    def state(self) -> Mapping[str, Any]:
        return {
            "rate": self.rate,
            "source": self._images.condition,
            "images": self._count,
        }

    def stop(self, now: float) -> None:
        self.end()

    def stopped(self) -> bool:
        """Return whether no images are taken; a camera never moves."""
        return self.rate == 0.0

    def hold(self, now: float) -> str:
        """Accept a pause: images may continue, since the rover itself stops."""
        return "held"

    def close(self) -> None:
        self._images.close()
