"""The base class of cameras: actions take images from it, and the operator sees the last one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from petrobot.services.action import Context
from petrobot.services.comm.streams.capture import without_login
from petrobot.services.comm.streams.image import Image
from petrobot.services.device import Driver, Ports, key

FASTEST = 1000.0
"""Largest rate (images/s)."""
QUALITY = 75
"""Quality of the JPEGs for the operator (0 to 100)."""


LATEST = 10.0
"""Seconds after which `take` must have an image exposed since it began."""
AHEAD = 1.0
"""Seconds by which an image may be newer than now: above it, another clock was read."""


class CameraError(ValueError):
    """The camera's table or its images cannot be used; the message says what to change."""


class CameraDriver(Driver):
    """A camera, complete as it is. Besides the keys below its table has those of its image source
    (docs/vision.md#image-sources).

    Images come only while actions want them, and only the newest one is kept.
    """

    source: str = key(text='where images come from, such as "capture:0"')
    rate: float = key(0.0, "images/s; 0: the usual rate of this camera", least=0, most=FASTEST)
    threads: int = key(1, "of OpenCV: other nodes share the cores")

    usual_rate = 25.0
    """Images/s without the key `rate`; a derived class may set this and the next two in `setup`."""
    shape: tuple[int, ...] = ()
    """Shape that the pixels of each image must have: (height, width), or (height, width, 3) with
    `colour`; empty: any."""
    shaped_by = ""
    """Where `shape` comes from, for the message when an image has another one."""

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        """Raises ValueError with every wrong key."""
        import cv2  # not needed by nodes without a camera

        self._source = ports.images()
        self._colour = bool(config.get("colour", False))
        self._newest: Image | None = None
        self._last: Image | None = None
        self._count = 0
        self.requested = 0.0
        """Images/s requested now, 0 when none."""
        super().__init__(config, ports)
        cv2.setNumThreads(self.threads)
        self.rate = self.rate or self.usual_rate
        if not 0.0 < self.rate <= FASTEST:
            text = f"expected images/s above 0 and at most {FASTEST:g}, found {self.rate:g}"
            raise CameraError(f"usual_rate: {text}; set another one, or give the key `rate`")

    # For actions

    async def take(self, ctx: Context[Any], count: int = 1, timeout: float = 1.0) -> list[Image]:
        """Return `count` images exposed from now on, or fewer if none comes for `timeout` s.
        Otherwise as `start` and `read`."""
        taken = list[Image]()
        self.end()
        self.start()
        begun = ctx.now
        try:
            while len(taken) < count and (image := await self.read(ctx, timeout)) is not None:
                if image.time >= begun:
                    taken.append(image)
                elif ctx.now > begun + LATEST:
                    text = f"image {image.sequence} was exposed {ctx.now - image.time:.1f} s ago"
                    raise CameraError(f"camera: {text}; expected at most {LATEST:g} s")
        finally:
            self.end()
        return taken

    def start(self, rate: float = 0.0) -> bool:
        """Request images at `rate` (1/s; 0: that of the table). Return False when they already
        arrive at that rate. Raises ConnectionError when the source cannot be opened."""
        wanted = rate or self.rate
        if wanted == self.requested:
            return False
        self._newest = None
        self._source.start(wanted)
        self.requested = wanted
        return True

    def end(self) -> None:
        """Stop taking images."""
        if self.requested:
            self._source.stop()
        self.requested, self._newest = 0.0, None

    async def read(self, ctx: Context[Any], timeout: float) -> Image | None:
        """Return the newest image that was not read yet, None when none arrives for `timeout` s.
        Raises CameraError for an image of another size, or one that is not as `Image` says."""
        await ctx.wait(self._arrived, timeout)
        image, self._newest = self._newest, None
        if image is None:
            return None
        if fault := self._unusable(image):
            raise CameraError(f"camera: expected {fault}")
        self._count += 1
        self._last = image
        return image

    def missing(self, text: str) -> str:
        """Return a message that images are missing, with the reason if it is known."""
        return f"{text}: {self._source.condition}" if self._source.condition else text

    def _arrived(self) -> bool:
        newest = self._source.newest()
        self._newest = self._newest if newest is None else newest
        return self._newest is not None

    def _unusable(self, image: Any) -> str:
        """Return what was expected of an image, and found; empty for one that can be used. A class
        of the user's may return anything."""
        source = without_login(self.source)
        missing = [name for name in ("pixels", "time", "sequence") if not hasattr(image, name)]
        if missing:
            found = f"{type(image).__name__} without {missing[0]}"
            return f"a petrobot.Image, found {found}: correct it in {source}"
        kind = str(getattr(image.pixels, "dtype", type(image.pixels).__name__))
        if kind != "uint8":
            return f"pixels of type uint8, found {kind}: convert them in {source}"
        shape = image.pixels.shape
        if self.shape and shape != self.shape:
            remedy = f"change {self.shaped_by or 'the driver'}, or the camera's settings"
            return f"images of {_size(self.shape)}, found {_size(shape)}; {remedy}"
        if len(shape) < 2 or shape[2:] != ((3,) if self._colour else ()) or 0 in shape:
            wanted = "width, 3)" if self._colour else "width), as without colour = true"
            return f"pixels of shape (height, {wanted}, found {shape}: correct it in {source}"
        if not isinstance(image.time, int | float) or not math.isfinite(image.time):
            return f"a time in seconds, found {image.time!r:.40}: correct it in {source}"
        if image.time > self.ports.now + AHEAD:
            text = f"a time of the clock that the class is given, at most {self.ports.now:.1f} s"
            return f"{text}, found {image.time:.1f} s: correct it in {source}"
        return ""

    # For the node and the operator

    def state(self) -> Mapping[str, Any]:
        return {
            "rate": self.requested,
            "source": self._source.condition or "ok",
            "images": self._count,
        }

    def picture(self) -> Mapping[str, Any]:
        """Return the last image read as a JPEG; empty before the first."""
        import cv2

        image = self._last
        if image is None:
            return {}
        coded, data = cv2.imencode(".jpg", image.pixels, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        if not coded:
            return {}
        high, wide = image.pixels.shape[:2]
        return {
            "mime": "image/jpeg",
            "data": data.tobytes(),
            "width": wide,
            "height": high,
            "age": self.ports.now - image.time,
            "note": f"image {image.sequence}, {self.requested:g} images/s",
        }

    def stop(self, now: float) -> None:
        self.end()

    def stopped(self) -> bool:
        """Return whether no images are taken; a camera never moves."""
        return self.requested == 0.0

    def hold(self, now: float) -> str:
        """Accept a pause, though images may continue: what moves is held by its own driver."""
        return "held"

    def close(self) -> None:
        self.end()
        self._source.close()


def _size(shape: tuple[int, ...]) -> str:
    """Return the width, the height and the number of colours of an image."""
    return "x".join(str(n) for n in (*shape[1::-1], *shape[2:]))
