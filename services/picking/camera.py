"""Driver of the camera above the table: takes images and passes them to actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from petrobot.services.action import Context
from petrobot.services.device import Driver, Ports, key
from petrobot.services.picking.model import PickingCell, cell_named, read_cell


class TableCamera(Driver):
    """A device without cyclic work. Besides `cell` its keys in services.toml are those of its image
    source."""

    cell: str = key("", "file of numbers beside services.toml; the shipped one if empty")

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        name = str(self.cell)
        self.known: PickingCell = (
            read_cell(ports.file(name).decode(), name) if name else cell_named()
        )
        cv2.setNumThreads(1)  # one thread: other nodes share the cores
        self._images = ports.images()
        self._on = False
        self._count = 0
        self._newest: NDArray[np.uint8] | None = None

    async def take(self, ctx: Context, count: int, timeout: float) -> list[NDArray[np.uint8]]:
        """Return `count` images exposed from now on, or fewer if the next one does not come within
        `timeout` s. Raises ValueError for images of another size."""
        eye, taken = self.known.eye, list[NDArray[np.uint8]]()
        self._images.start(eye.rate)
        self._on, self._newest = True, None
        try:
            while len(taken) < count and await ctx.wait(self._arrived, timeout):
                image = self._pop()
                if image.shape != (eye.height, eye.width):
                    raise ValueError(
                        f"the camera's images have shape {image.shape}, its numbers say "
                        f"{(eye.height, eye.width)}: change [camera] of the cell's file or the "
                        "camera's settings"
                    )
                taken.append(image)
                self._count += 1
        finally:
            self.stop(ctx.now)
        return taken

    def _arrived(self) -> bool:
        image = self._images.newest()
        if image is not None:
            self._newest = image.pixels
        return self._newest is not None

    def _pop(self) -> NDArray[np.uint8]:
        image, self._newest = self._newest, None
        assert image is not None  # as `_arrived` reported
        return image

    def state(self) -> Mapping[str, Any]:
        """Return plain data for operator and report."""
        return {"source": self._images.condition or "ok", "images": self._count}

    def stop(self, now: float) -> None:
        """Take no more images."""
        if self._on:
            self._images.stop()
        self._on = False

    def stopped(self) -> bool:
        """Return whether no images are taken; a camera never moves."""
        return not self._on

    def hold(self, now: float) -> str:
        """Accept a pause: images may continue, since the arm itself stops."""
        return "held"

    def close(self) -> None:
        """Stop the images and close the source."""
        self.stop(0.0)
        self._images.close()
