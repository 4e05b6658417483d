"""An image, and the interface of its sources."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Image:
    """One exposure: `pixels` (height, width) uint8 grey levels, `time` of mid-exposure on the
    receiver's clock (s).

    `sequence` counts from 0.
    """

    pixels: NDArray[np.uint8]
    time: float
    sequence: int


class ImageSource(Protocol):
    """A source of images: the simulated camera, a cv2.VideoCapture device, or a file."""

    def start(self, rate: float) -> None:
        """Begin to deliver images at about this rate (1/s)."""

    def stop(self) -> None:
        """Deliver no more images."""

    def newest(self) -> Image | None:
        """Return the newest image that was not returned yet, None if there is none; older ones are
        dropped."""

    def close(self) -> None:
        """Release the source."""
