"""Images from any cv2.VideoCapture device or video file. OpenCV is imported at the first start, so
nodes without one need none."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from petrobot.services.comm.streams.image import Image

Clock = Callable[[], float]
Pixels = NDArray[np.uint8]


class CaptureImages:
    """Any cv2.VideoCapture device (a number) or video file (a path), opened at the first start.

    A thread grabs a device's images as they come, so the newest is never older than one exposure. A
    file is paced by the clock: image k belongs to the time start + k / rate, and after the last one
    there is none.
    """

    def __init__(self, target: int | str, clock: Clock, latency: float = 0.0) -> None:
        """`latency`: s from mid-exposure until a device's image is here (from its datasheet, or
        measured)."""
        self._target = target
        self._clock = clock
        self._latency = latency
        self._capture: Any = None
        self._lock = threading.Lock()
        self._newest: Image | None = None
        self._sequence = 0
        self._begin = 0.0
        self._rate = 0.0
        self._thread: threading.Thread | None = None
        self._on = threading.Event()

    def start(self, rate: float) -> None:
        """Send images at about this rate. Raises ConnectionError naming the source when it cannot
        be opened."""
        import cv2  # only who uses a capture needs OpenCV's video backends

        self.stop()
        if self._capture is None:
            self._capture = cv2.VideoCapture(self._target)
        if not self._capture.isOpened():
            self._capture = None
            raise ConnectionError(
                f"camera source {self._target!r} cannot be opened: is it plugged in, does "
                "the file exist?"
            )
        self._begin, self._rate, self._sequence, self._newest = self._clock(), rate, 0, None
        if isinstance(self._target, str):
            self._capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
            return
        self._capture.set(cv2.CAP_PROP_FPS, rate)
        self._on.set()
        self._thread = threading.Thread(target=self._grab, name="capture", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Send no more images."""
        self._on.clear()
        if self._thread is not None:
            self._thread.join()
        self._thread, self._rate, self._newest = None, 0.0, None

    def close(self) -> None:
        """Let the device or file go."""
        self.stop()
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def newest(self) -> Image | None:
        """The newest image not taken yet, None if there is none."""
        if isinstance(self._target, str) and self._rate > 0.0:
            self._advance_file()
        with self._lock:
            newest, self._newest = self._newest, None
        return newest

    def _advance_file(self) -> None:
        due = int((self._clock() - self._begin) * self._rate)
        while self._sequence <= due:
            taken, pixels = self._capture.read()
            if not taken:
                return
            self._newest = Image(
                _grey(pixels), self._begin + self._sequence / self._rate, self._sequence
            )
            self._sequence += 1

    def _grab(self) -> None:
        while self._on.is_set():
            taken, pixels = self._capture.read()
            if not taken:
                return  # unplugged: images end, and the reader finds a dead camera
            image = Image(_grey(pixels), self._clock() - self._latency, self._sequence)
            self._sequence += 1
            with self._lock:
                self._newest = image


def _grey(pixels: NDArray[Any]) -> Pixels:
    """Grey levels (height, width) of a BGR or grey picture (ITU-R BT.601 weights)."""
    if pixels.ndim == 2:
        return np.asarray(pixels, np.uint8)
    return np.asarray(np.rint(pixels[..., :3] @ np.array([0.114, 0.587, 0.299])), np.uint8)
