"""An image, and the interface of its sources."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Image:
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


def explained(text: str, state: Mapping[str, Any]) -> str:
    """Return a message that images are missing, with the reason if the camera's state has one."""
    return text if state["source"] == "ok" else f"{text}: {state['source']}"


class RequestedImages:
    """The images of a source while a driver requests them; only the newest one is kept."""

    def __init__(self, source: ImageSource) -> None:
        self._source = source
        self._newest: Image | None = None
        self.rate = 0.0
        """Images/s requested now, 0 when none."""

    @property
    def condition(self) -> str:
        """Why no images come; "ok" if nothing is wrong."""
        return self._source.condition or "ok"

    def start(self, rate: float) -> None:
        """Forget earlier images and request new ones at `rate` (1/s). Raises ConnectionError if the
        source cannot be opened."""
        self._newest = None
        self._source.start(rate)
        self.rate = rate

    def end(self) -> None:
        """Stop taking images."""
        if self.rate:
            self._source.stop()
        self.rate, self._newest = 0.0, None

    def arrived(self) -> bool:
        """Return whether there is an image that was not taken yet."""
        newest = self._source.newest()
        if newest is not None:
            self._newest = newest
        return self._newest is not None

    def take(self) -> Image | None:
        """Return the newest image, None if it was taken already."""
        image, self._newest = self._newest, None
        return image

    def close(self) -> None:
        """Stop taking images, and release the source."""
        self.end()
        self._source.close()
