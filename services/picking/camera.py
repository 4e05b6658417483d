"""Driver of the camera above the table: takes images and passes them to actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from petrobot.services.action import Context
from petrobot.services.comm.streams.image import RequestedImages
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
        self._images = RequestedImages(ports.images())
        self._count = 0

    async def take(self, ctx: Context, count: int, timeout: float) -> list[NDArray[np.uint8]]:
        """Return `count` images exposed from now on, or fewer if the next one does not come within
        `timeout` s. Raises ValueError for images of another size."""
        eye, taken = self.known.eye, list[NDArray[np.uint8]]()
        self._images.start(eye.rate)
        try:
            while len(taken) < count and await ctx.wait(self._images.arrived, timeout):
                newest = self._images.take()
                assert newest is not None  # as `arrived` reported
                image = newest.pixels
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

    def state(self) -> Mapping[str, Any]:
        return {"source": self._images.condition, "images": self._count}

    def stop(self, now: float) -> None:
        self._images.end()

    def stopped(self) -> bool:
        """Return whether no images are taken; a camera never moves."""
        return self._images.rate == 0.0

    def hold(self, now: float) -> str:
        """Accept a pause: images may continue, since the arm itself stops."""
        return "held"

    def close(self) -> None:
        self._images.close()
