"""An image and where images come from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Image:
    """One exposure: `pixels` (height, width) uint8 grey levels, mid-exposure `time` on the
    receiver's clock (s).

    `sequence` counts from 0.
    """

    pixels: NDArray[np.uint8]
    time: float
    sequence: int


class ImageSource(Protocol):
    """A camera: simulated, a cv2.VideoCapture device, or a file."""

    def start(self, rate: float) -> None:
        """Send images at about this rate (1/s)."""

    def stop(self) -> None:
        """Send no more images."""

    def newest(self) -> Image | None:
        """The newest image not taken yet, None if there is none; older ones are dropped."""

    def close(self) -> None:
        """Let the camera go."""
