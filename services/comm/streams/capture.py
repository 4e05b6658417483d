"""Images through OpenCV: cameras of this host, network streams, and recordings.

OpenCV is imported when a source is first opened, so nodes without one do not need it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.services.comm.streams.image import Image

_log = logging.getLogger(__name__)

Clock = Callable[[], float]

SILENCE_MS = 3000
"""Milliseconds after which opening or reading a network stream fails."""
FIRST_WAIT, LONGEST_WAIT = 0.5, 8.0
"""Seconds until a source that was lost is opened again: twice as long after each failure."""
OPEN_LIMIT = 10.0
"""Seconds for which `start` waits for the first image."""


class CaptureSettings(Struct, frozen=True):
    """Settings of a camera. Zero, empty or None: the camera keeps its own setting."""

    fps: float = 0.0
    """Images/s that it takes; 0: the rate of the first `start`."""
    width: int = 0
    height: int = 0
    fourcc: str = ""
    """Pixel format, four characters such as "MJPG"."""
    exposure: float | None = None
    """Exposure in the unit of its driver (V4L2: 100 us); if given, the camera does not set it
    automatically."""
    colour: bool = False
    """Images of shape (height, width, 3), blue green red, instead of grey levels."""
    latency: float = 0.0
    """Time from mid-exposure until an image is available (s), from the datasheet or measured."""


class CaptureImages:
    """A camera, as `cv2.VideoCapture` opens it: a number, a device file, a URL or a GStreamer
    pipeline (with "!").

    One thread owns it. It takes every image as it comes, wanted or not, so the newest one is never
    an old one from a buffer. When the camera is lost it is opened again, with growing pauses;
    `condition` says so. Device files are resolved at each opening, since a camera that is plugged
    in again may get another number: /dev/v4l/by-id/... stays the same.
    """

    def __init__(
        self, target: int | str, clock: Clock, settings: CaptureSettings | None = None
    ) -> None:
        self._target = target
        self._name = f"camera {without_login(target)!r}"
        self._clock = clock
        self._settings = settings or CaptureSettings()
        self._lock = threading.Lock()
        self._newest: Image | None = None
        self._sequence = 0
        self._rate = 0.0
        self._began = 0.0
        self._fault = ""
        self._came = 0.0
        """When the last image came, or the camera was started."""
        self._tried = threading.Event()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def condition(self) -> str:
        """Why no images come; empty while they come or none was asked for."""
        silent = self._clock() - self._came
        if not self._fault and self._rate and silent > max(SILENCE_MS / 1000, 2.0 / self._rate):
            return f"{self._name} has given no image for {silent:.0f} s"
        return self._fault

    def start(self, rate: float) -> None:
        """Deliver the images from now on; return when the camera has given one. Raises
        ConnectionError with the source and the reason while it gives none."""
        with self._lock:
            self._newest, self._sequence, self._rate = None, 0, rate
            self._began = self._came = self._clock()
        if self._thread is None:
            self._tried.clear()
            self._ended = threading.Event()  # the old one ends a thread that still waits in OpenCV
            self._thread = threading.Thread(target=self._run, name="capture", daemon=True)
            self._thread.start()
        if not self._tried.wait(OPEN_LIMIT):
            raise ConnectionError(f"{self._name}: no image within {OPEN_LIMIT:g} s")
        if self._fault:
            raise ConnectionError(self._fault)

    def stop(self) -> None:
        """Stop delivering images. The camera stays open for the next start."""
        with self._lock:
            self._newest, self._rate = None, 0.0

    def close(self) -> None:
        """Release the camera; a thread that is still waiting for an image does so afterwards."""
        self.stop()
        self._ended.set()
        if self._thread is not None:
            self._thread.join(SILENCE_MS / 1000)
        self._thread, self._fault = None, ""

    def newest(self) -> Image | None:
        """Return the newest image that was not returned yet, None if there is none."""
        with self._lock:
            newest, self._newest = self._newest, None
        return newest

    def _run(self) -> None:
        wait, ended = FIRST_WAIT, self._ended
        while not ended.is_set():
            try:
                with _opened(self._target, self._settings, self._rate) as capture:
                    fault = f"{self._name} was lost"
                    if capture is None:
                        fault = self._closed()
                    elif self._take(capture, ended):
                        wait = FIRST_WAIT
            except Exception as raised:  # of OpenCV: an image that it cannot convert, and others
                text = " ".join(str(raised).split())
                fault = f"{self._name}: no usable image, try another fourcc: {text:.300}"
            if ended.is_set():
                return
            self._fault = fault
            _log.warning("%s; it is opened again in %g s", self._fault, wait)
            self._tried.set()
            ended.wait(wait)
            wait = min(2.0 * wait, LONGEST_WAIT)

    def _closed(self) -> str:
        text = f"{self._name} cannot be opened: "
        if not isinstance(self._target, int) and "://" in self._target:
            text += (
                "is it plugged in, is the address right? "
                "Does it want a login, as in http://USER:PASSWORD@HOST/?"
            )
        elif not _is_pipeline(self._target):
            return text + _obstacle(self._target)
        else:
            text += "is it plugged in, is the pipeline right?"
        name = "GStreamer" if _is_pipeline(self._target) else "FFmpeg"
        return text if _has(name) else f"{text} This OpenCV was built without {name}"

    def _take(self, capture: Any, ended: threading.Event) -> int:
        """Take images until the camera is lost or closed; return how many came."""
        count, settings = 0, self._settings
        while not ended.is_set() and capture.grab():
            grabbed = self._clock()
            if self._rate:
                taken, pixels = capture.retrieve()
                if not taken:
                    break
                pixels = _wanted(pixels, settings.colour)
                if not count and "://" not in str(self._target):  # a stream's sender decides
                    self._compare(pixels.shape)
                with self._lock:
                    if self._rate and grabbed >= self._began:
                        time = grabbed - self._settings.latency
                        self._newest = Image(pixels, time, self._sequence)
                        self._sequence += 1
            count += 1
            self._fault, self._came = "", grabbed
            self._tried.set()
        return count

    def _compare(self, shape: tuple[int, ...]) -> None:
        """Warn if the camera gives another size than it was asked for: OpenCV does not."""
        high, wide = shape[:2]
        asked = self._settings.width or wide, self._settings.height or high
        if asked != (wide, high):
            text = "%s was asked for images of %dx%d and gives %dx%d"
            _log.warning(text, self._name, *asked, wide, high)


class RecordedImages:
    """A video file, paced by the clock: image k belongs to the time start + k / rate, and after the
    last one there is none."""

    def __init__(self, path: str, clock: Clock, *, colour: bool = False) -> None:
        self._path = path
        self._clock = clock
        self._colour = colour
        self._capture: Any = None
        self._sequence = 0
        self._begin = 0.0
        self._rate = 0.0
        self._over = False

    @property
    def condition(self) -> str:
        """Whether it is over; empty before."""
        return f"recording {self._path!r} is over" if self._over else ""

    def start(self, rate: float) -> None:
        """Deliver the images from the first one on, at this rate (1/s). Raises ConnectionError when
        the file cannot be opened."""
        import cv2  # see the module's docstring

        if self._capture is None:
            capture = cv2.VideoCapture(self._path)
            if not capture.isOpened():
                raise ConnectionError(f"recording {self._path!r} cannot be opened as a video")
            self._capture = capture
        self._capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
        self._begin, self._rate, self._sequence = self._clock(), rate, 0
        self._over = False

    def stop(self) -> None:
        """Stop delivering images."""
        self._rate = 0.0

    def close(self) -> None:
        """Release the file."""
        self.stop()
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def newest(self) -> Image | None:
        """Return the newest image that is due and was not returned yet, None if there is none."""
        newest = None
        while self._rate and self._sequence <= int((self._clock() - self._begin) * self._rate):
            taken, pixels = self._capture.read()
            if not taken:
                self._over = True
                break
            pixels = pixels if self._colour else grey(pixels)
            newest = Image(pixels, self._begin + self._sequence / self._rate, self._sequence)
            self._sequence += 1
        return newest


def grey(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the grey levels (height, width) of a blue-green-red or grey picture (weights of ITU-R
    BT.601)."""
    if pixels.ndim == 2:
        return pixels
    import cv2  # see the module's docstring

    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), np.uint8)


def _wanted(pixels: NDArray[Any], colour: bool) -> NDArray[np.uint8]:
    """Return an image of a camera as its table wants it. Raises ValueError if it is not one."""
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    if pixels.dtype != np.uint8:
        raise ValueError(f"expected 8 bits for each grey level or colour, found {pixels.dtype}")
    if colour and (pixels.ndim != 3 or pixels.shape[2] != 3):
        raise ValueError(f"expected colours, found {pixels.shape}; or remove colour = true")
    return pixels if colour else grey(pixels)


@contextlib.contextmanager
def _opened(target: int | str, settings: CaptureSettings, rate: float) -> Iterator[Any]:
    """Open a camera and set it up; None if it cannot be opened."""
    import cv2  # see the module's docstring

    if isinstance(target, int):
        capture = cv2.VideoCapture(target)
    elif "://" in target:
        limits = (cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, cv2.CAP_PROP_READ_TIMEOUT_MSEC)
        given = [value for limit in limits for value in (limit, SILENCE_MS)]
        capture = cv2.VideoCapture(target, cv2.CAP_FFMPEG, given)
    elif _is_pipeline(target):
        capture = cv2.VideoCapture(target, cv2.CAP_GSTREAMER)
    else:
        capture = cv2.VideoCapture(os.path.realpath(target), cv2.CAP_V4L2)
    try:
        if not capture.isOpened():
            yield None
            return
        for name, value in _properties(settings, rate):
            # Network streams accept none of them, which is normal: their sender decides.
            if not capture.set(getattr(cv2, name), value) and "://" not in str(target):
                shown = without_login(target)
                _log.warning("camera %r does not accept %s = %g", shown, name, value)
        yield capture
    finally:
        capture.release()


def _properties(settings: CaptureSettings, rate: float) -> Iterator[tuple[str, float]]:
    """Yield OpenCV's properties to set, in the order that V4L2 needs: format, size, rate."""
    if settings.fourcc:
        a, b, c, d = map(ord, settings.fourcc)
        yield "CAP_PROP_FOURCC", a | b << 8 | c << 16 | d << 24
    if settings.width:
        yield "CAP_PROP_FRAME_WIDTH", settings.width
    if settings.height:
        yield "CAP_PROP_FRAME_HEIGHT", settings.height
    if fps := settings.fps or rate:
        yield "CAP_PROP_FPS", fps
    if settings.exposure is not None:
        yield "CAP_PROP_AUTO_EXPOSURE", 1.0  # V4L2's number for manual
        yield "CAP_PROP_EXPOSURE", settings.exposure


def without_login(target: Any) -> Any:
    """Return it as the operator's page and the log may show it."""
    if not isinstance(target, str):
        return target
    shown = re.sub(r"(?<=://)[^/\s]*@", "", target)
    return re.sub(r"\b(user|password|passwd|\w*-pw|\w*-id)=\S+", r"\1=...", shown)


def _is_pipeline(target: int | str) -> bool:
    return isinstance(target, str) and "!" in target and "://" not in target.split("!")[0]


def _has(name: str) -> bool:
    """Whether OpenCV was built with GStreamer or FFmpeg."""
    import cv2  # see the module's docstring

    return bool(cv2.videoio_registry.hasBackend(getattr(cv2, f"CAP_{name.upper()}")))


def _obstacle(target: int | str) -> str:
    """Return why a camera of this host may not open."""
    path = Path(f"/dev/video{target}" if isinstance(target, int) else target)
    if not path.exists():
        return f"is it plugged in, is the address right? There is no {path}"
    if path.is_file():
        return f'it is a file; of a recording write "file:{path}"'
    if not os.access(path, os.R_OK | os.W_OK):
        return f"this user may not open {path}; put it into the group video"
    return "does another program or device use it?"


def settings_of(config: Mapping[str, Any]) -> CaptureSettings:
    """Return what a device's table says of its camera. Raises ValueError naming key and remedy."""
    return CaptureSettings(
        fps=_number(config, "fps", 0.0, 1000.0),
        width=int(_number(config, "width", 0, 1 << 14)),
        height=int(_number(config, "height", 0, 1 << 14)),
        fourcc=_fourcc(config.get("fourcc", "")),
        exposure=_number(config, "exposure", -100.0, 1e6) if "exposure" in config else None,
        colour=_flag(config.get("colour", False)),
        latency=_number(config, "latency", 0.0, 10.0),
    )


def _number(config: Mapping[str, Any], key: str, least: float, most: float) -> float:
    value = config.get(key, 0)
    whole = isinstance(least, int)
    if (
        isinstance(value, bool)
        or not isinstance(value, int if whole else int | float)
        or not least <= value <= most
    ):
        kind = "a whole number" if whole else "a number"
        raise ValueError(f"{key}: expected {kind} from {least:g} to {most:g}, got {value!r}")
    return float(value)


def _fourcc(value: Any) -> str:
    if not isinstance(value, str) or (value and (len(value) != 4 or not value.isascii())):
        raise ValueError(f'fourcc: expected four characters such as "MJPG", got {value!r}')
    return value


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"colour: expected true or false, got {value!r}")
    return value
