"""Image sources behind one interface (`ImageSource`), and the wire format of images over TCP.

Wire format, network byte order. Image: b"PIMG", generation u32, sequence u64, age f64 (s since
mid-exposure when sent), height u16, width u16, length u32, then the grey levels row by row. Control
(receiver to camera): b"PCTL", generation u32, rate f64 (images/s, 0: stop). The camera repeats the
generation of the last control, so images of an earlier start are recognised and dropped.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import re
import socket
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from petrobot.services.comm.protocol.security import is_loopback
from petrobot.services.comm.streams.capture import (
    CaptureImages,
    RecordedImages,
    settings_of,
    without_login,
)
from petrobot.services.comm.streams.image import Image, ImageSource

Clock = Callable[[], float]
Pixels = NDArray[np.uint8]


IMAGE_HEADER = struct.Struct("!4sIQdHHI")
CONTROL = struct.Struct("!4sId")
IMAGE_MAGIC, CONTROL_MAGIC = b"PIMG", b"PCTL"
LARGEST_IMAGE = 16 * 1024 * 1024
BUFFER = 4 * 1024 * 1024
CHUNK = 1 << 20
RECEIVERS = 16
"""Most receivers at a time; above it a receiver that wants no images is closed."""
ADMITTED = 4
"""Connections accepted per poll: strangers must not delay the loop that polls."""
RETRY = 0.5
"""Pause between attempts to reach a camera that is away (s)."""
IN_PROGRESS = (errno.EINPROGRESS, errno.EALREADY, errno.EWOULDBLOCK, errno.EAGAIN)


class ImageFormatError(ValueError):
    """Bytes that are not an image or control of this format."""


class WireImage(Struct, frozen=True):
    """An image as it is sent: with its age (s since mid-exposure), never with a time of day."""

    generation: int
    sequence: int
    age: float
    pixels: Pixels


def encode_image(image: WireImage) -> bytes:
    """Return header and grey levels of one image, pixels (height, width) uint8."""
    height, width = image.pixels.shape
    header = IMAGE_HEADER.pack(
        IMAGE_MAGIC, image.generation, image.sequence, image.age, height, width, height * width
    )
    return header + np.ascontiguousarray(image.pixels).tobytes()


class ImageDecoder:
    """Decodes bytes that may be cut anywhere; keeps only the newest complete image."""

    def __init__(self) -> None:
        self._bytes = bytearray()
        self._newest: WireImage | None = None

    def feed(self, data: bytes | memoryview) -> None:
        """Add received bytes. Raises ImageFormatError when they are not images."""
        self._bytes += data
        while len(self._bytes) >= IMAGE_HEADER.size:
            magic, generation, sequence, age, height, width, length = IMAGE_HEADER.unpack_from(
                self._bytes
            )
            if (
                magic != IMAGE_MAGIC
                or length != height * width
                or length > LARGEST_IMAGE
                or not age >= 0.0
            ):
                raise ImageFormatError(
                    "expected the header of an image, got "
                    f"{bytes(self._bytes[: IMAGE_HEADER.size]).hex()}"
                )
            end = IMAGE_HEADER.size + length
            if len(self._bytes) < end:
                return
            pixels = np.frombuffer(bytes(self._bytes[IMAGE_HEADER.size : end]), np.uint8).reshape(
                height, width
            )
            self._newest = WireImage(generation, sequence, age, pixels)
            del self._bytes[:end]

    def take(self) -> WireImage | None:
        """Return the newest complete image, once."""
        newest, self._newest = self._newest, None
        return newest


class StreamImages:
    """Images of a camera in another process, over TCP. Nothing blocks; a camera that is away is
    tried every half second."""

    def __init__(self, host: str, port: int, clock: Clock) -> None:
        self._address = host, port
        self._clock = clock
        self._socket: socket.socket | None = None
        self._decoder = ImageDecoder()
        self._connected = False
        self._retry_at = -float("inf")
        self._generation = 0
        self._rate = 0.0

    def start(self, rate: float) -> None:
        """Request images at about this rate (1/s); images sent before no longer count."""
        self._control(rate)

    def stop(self) -> None:
        """Stop requesting images."""
        self._control(0.0)

    def close(self) -> None:
        """Disconnect from the camera."""
        self._drop(self._clock())

    @property
    def condition(self) -> str:
        """Why no images come; empty while the camera is connected or was not asked for any."""
        host, port = self._address
        away = self._rate > 0.0 and not self._connected
        return f"the camera at {host}:{port} cannot be reached" if away else ""

    def newest(self) -> Image | None:
        """Return the newest image that was not returned yet; all older ones in the socket are
        dropped."""
        self._connect()
        if not self._connected or self._socket is None:
            return None
        try:
            self._drain(self._socket)
        except (OSError, ImageFormatError):
            self._drop(self._clock())
        image = self._decoder.take()
        if image is None or image.generation != self._generation:
            return None
        return Image(image.pixels, self._clock() - image.age, image.sequence)

    def _control(self, rate: float) -> None:
        self._generation += 1
        self._rate = rate
        if self._connected:
            self._say()
        else:
            self._connect()

    def _say(self) -> None:
        if self._socket is None:
            return
        try:
            self._socket.sendall(CONTROL.pack(CONTROL_MAGIC, self._generation, self._rate))
        except OSError:  # if 16 bytes do not fit into the buffer, the camera does not read
            self._drop(self._clock())

    def _connect(self) -> None:
        now = self._clock()
        if self._connected or (self._socket is None and now < self._retry_at):
            return
        if self._socket is None:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        fault = self._socket.connect_ex(self._address)
        if fault in (0, errno.EISCONN):
            self._connected = True
            self._say()
        elif fault not in IN_PROGRESS:
            self._drop(now)

    def _drain(self, source: socket.socket) -> None:
        while True:
            try:
                data = source.recv(CHUNK)
            except BlockingIOError:
                return
            if not data:
                raise ConnectionError("the camera left")
            self._decoder.feed(data)

    def _drop(self, now: float) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket, self._connected, self._decoder = None, False, ImageDecoder()
        self._retry_at = now + RETRY


class _Receiver:
    """One receiver of an ImageServer: what it requested and what must still be written to it."""

    def __init__(self, link: socket.socket) -> None:
        self.link = link
        self.generation = 0
        self.rate = 0.0
        self.asked = bytearray()
        self.rest = memoryview(b"")

    def listen(self) -> None:
        """Read its controls. Raises OSError or ImageFormatError when the connection is of no use
        any more."""
        with contextlib.suppress(BlockingIOError):
            data = self.link.recv(4096)
            if not data:
                raise ConnectionError("the receiver left")
            self.asked += data
        while len(self.asked) >= CONTROL.size:
            magic, generation, rate = CONTROL.unpack_from(self.asked)
            if magic != CONTROL_MAGIC or not 0.0 <= rate <= 10_000.0:
                raise ImageFormatError("expected a control message of a camera")
            self.generation, self.rate = generation, rate
            del self.asked[: CONTROL.size]

    def write(self) -> None:
        """Write as much as the socket accepts."""
        with contextlib.suppress(BlockingIOError):
            while self.rest:
                self.rest = self.rest[self.link.send(self.rest) :]


class ImageServer:
    """Camera's end of the connection, for the simulated camera. Nothing blocks: a slow receiver
    misses images."""

    def __init__(self, host: str, port: int) -> None:
        """Bind; port 0 takes a free one.

        Raises OSError when the address is in use, ValueError for an address that other hosts reach:
        images are neither encrypted nor authenticated.
        """
        if not is_loopback(host):
            raise ValueError(
                f'address "{host}:{port}" leaves this host, and images are not protected: '
                "use 127.0.0.1"
            )
        self._listener = socket.create_server((host, port))
        self._listener.setblocking(False)
        self._receivers: list[_Receiver] = []
        self._sequence = 0

    @property
    def port(self) -> int:
        """Return the port at which it listens."""
        return int(self._listener.getsockname()[1])

    @property
    def rate(self) -> float:
        """Return the highest rate (images/s) that a receiver wants, 0 if none wants images."""
        return max((receiver.rate for receiver in self._receivers), default=0.0)

    def poll(self) -> None:
        """Accept receivers, read controls and continue writing. Call it often."""
        with contextlib.suppress(OSError):  # also: this process has no file for another one
            for _ in range(ADMITTED):
                link, _ = self._listener.accept()
                if len(self._receivers) >= RECEIVERS:
                    self._leave(
                        next(
                            (one for one in self._receivers if one.rate <= 0.0), self._receivers[0]
                        )
                    )
                link.setblocking(False)
                link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)
                self._receivers.append(_Receiver(link))
        for receiver in list(self._receivers):
            try:
                receiver.listen()
                receiver.write()
            except (OSError, ImageFormatError):
                self._leave(receiver)

    def send(self, pixels: Pixels, age: float) -> None:
        """Send an image, `age` s after mid-exposure, to all receivers that want images and have
        received the last one completely."""
        for receiver in list(self._receivers):
            if receiver.rate <= 0.0 or receiver.rest:
                continue
            body = encode_image(WireImage(receiver.generation, self._sequence, age, pixels))
            receiver.rest = memoryview(body)
            try:
                receiver.write()
            except OSError:
                self._leave(receiver)
        self._sequence += 1

    def close(self) -> None:
        """Stop listening and disconnect all receivers."""
        for receiver in list(self._receivers):
            self._leave(receiver)
        self._listener.close()

    def _leave(self, receiver: _Receiver) -> None:
        receiver.link.close()
        self._receivers.remove(receiver)


class MemoryImages:
    """Images of a camera in the same process (lock step): the owner of the camera puts them in."""

    condition = ""

    def __init__(self, control: Callable[[float], None] = lambda rate: None) -> None:
        """`control` is called with the wanted rate (images/s), 0 to stop."""
        self._control = control
        self._newest: Image | None = None
        self._on = False

    def start(self, rate: float) -> None:
        """Request images at about this rate (1/s)."""
        self._on, self._newest = True, None
        self._control(rate)

    def stop(self) -> None:
        """Stop requesting images."""
        self._on, self._newest = False, None
        self._control(0.0)

    def put(self, image: Image) -> None:
        """Put in the newest image; it is dropped when images are not wanted."""
        if self._on:
            self._newest = image

    def newest(self) -> Image | None:
        """Return the newest image that was not returned yet, None if there is none."""
        newest, self._newest = self._newest, None
        return newest

    def close(self) -> None:
        """Release the camera."""
        self.stop()


def open_images(config: Mapping[str, Any], clock: Clock) -> ImageSource:
    """Return the source that a device's config names:

    - `source = "sim"`, with `address = "host:port"`: the simulated camera;
    - `"capture:WHAT"`: a camera (see `CaptureImages`), such as "capture:0",
      "capture:/dev/v4l/by-id/..." or "capture:rtsp://...";
    - `"file:PATH"`: a recording;
    - `"MODULE:CLASS"`: a class of the user's, called with the config and a clock (s), which
      implements `ImageSource`.

    Raises ValueError naming key and remedy.
    """
    source = str(config.get("source", ""))
    kind, _, target = source.partition(":")
    if source == "sim":
        host, _, port = str(config.get("address", "")).rpartition(":")
        if not host or not port.isdigit():
            raise ValueError('source = "sim" needs address = "host:port" of the simulated camera')
        return StreamImages(host, int(port), clock)
    if kind == "capture" and (target.isdigit() or re.search("[/!]", target)):
        return CaptureImages(
            int(target) if target.isdigit() else target, clock, settings_of(config)
        )
    if kind == "file" and target:
        return RecordedImages(target, clock, colour=settings_of(config).colour)
    if kind not in ("capture", "file") and target.isidentifier():
        own = _own_source(kind, target)(config, clock)
        lacks = [name for name in METHODS if not callable(getattr(own, name, None))]
        if not isinstance(getattr(own, "condition", None), str):
            lacks.append("condition (a text, empty if nothing is wrong)")
        if lacks:
            raise ValueError(f"source = {source!r}: its class has no {', '.join(lacks)}")
        return own
    shown = without_login(source)
    raise ValueError(
        f'source = {shown!r}: use "sim", "capture:0", "capture:/dev/v4l/by-id/...", a URL as in '
        '"capture:rtsp://...", "file:PATH", or "MODULE:CLASS" for a class of your own'
    )


METHODS = ("start", "stop", "newest", "close")
"""Methods of an image source."""


def _own_source(module: str, name: str) -> Callable[[Mapping[str, Any], Clock], ImageSource]:
    """Return the user's class. Raises ValueError."""
    try:
        found: Callable[[Mapping[str, Any], Clock], ImageSource] = getattr(
            importlib.import_module(module), name
        )
    except (ImportError, AttributeError) as fault:
        raise ValueError(
            f'source = "{module}:{name}": {fault}; write the module beside services.toml, or '
            "install it"
        ) from fault
    return found
