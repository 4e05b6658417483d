"""An image, and the interface of its sources."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from msgspec import Struct

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


class Image(Struct, frozen=True):
    """One exposure: `pixels` (height, width) uint8 grey levels, or (height, width, 3) blue green
    red with the key `colour = true`; `time` of mid-exposure on the receiver's clock (s).

    `sequence` counts from 0.
    """

    pixels: NDArray[np.uint8]
    time: float
    sequence: int


class ImageSource(Protocol):
    """A source of images: the simulated camera, a camera, a recording, or a class of the user's.

    None of its methods waits for an image; `start` may wait until the source is open.
    """

    @property
    def condition(self) -> str:
        """Why no images come, for the operator; empty if nothing is wrong."""

    def start(self, rate: float) -> None:
        """Begin to deliver images at about this rate (1/s)."""

    def stop(self) -> None:
        """Stop delivering images."""

    def newest(self) -> Image | None:
        """Return the newest image that was not returned yet, None if there is none; older ones are
        dropped."""

    def close(self) -> None:
        """Release the source."""
