"""What a driver may reach in a lock-step cell: bus, images and streams in memory, on the other side
envelopes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from petrobot.services.comm.camera import MemoryImages, open_images
from petrobot.services.comm.canbus import Frame
from petrobot.services.comm.channels import (
    can_body,
    images_wanted,
    read_can,
    read_image,
    read_set_point,
)
from petrobot.services.comm.directory import DeviceEntry, Directory
from petrobot.services.comm.image import ImageSource
from petrobot.services.comm.messages import Event
from petrobot.services.comm.party import Envelope
from petrobot.services.comm.plain import plain
from petrobot.services.context import checked
from petrobot.services.setpoints import SetpointReceiver


class MemoryCan:
    """A port on the laboratory's bus: frames out are collected, frames in are put in."""

    def __init__(self) -> None:
        self.out: list[Frame] = []
        self.arrived: list[Frame] = []
        self._closed = False

    def send(self, frame: Frame) -> None:
        """Put a frame on the bus. Raises ConnectionError when the port is closed."""
        if self._closed:
            self._check()
        self.out.append(frame)

    def receive(self) -> Sequence[Frame]:
        """All frames that arrived since the last call, oldest first."""
        self._check()
        arrived, self.arrived = self.arrived, []
        return arrived

    def close(self) -> None:
        """Leave the bus."""
        self._closed = True

    def _check(self) -> None:
        if self._closed:
            raise ConnectionError("this port has left the bus")


class LockstepPorts:
    """Implements `services.device.Ports` for one device; `post` takes what goes out to the
    laboratory."""

    def __init__(
        self,
        directory: Directory,
        device: DeviceEntry,
        clock: Callable[[], float],
        post: Callable[[Envelope], None],
    ) -> None:
        self._directory = directory
        self._device = device
        self._clock = clock
        self._post = post
        self._can: MemoryCan | None = None
        self._images: MemoryImages | None = None
        self._wish = 0
        self._streams: dict[str, SetpointReceiver] = {}
        self._raised: list[tuple[str, Mapping[str, Any]]] = []
        self._lives_at = ""

    @property
    def now(self) -> float:
        """The cell's clock (s)."""
        return self._clock()

    def can(self) -> MemoryCan:
        """The laboratory's CAN bus."""
        if self._can is None:
            self._laboratory()
            self._can = MemoryCan()
        return self._can

    def images(self) -> ImageSource:
        """The laboratory's camera when the device says `source = "sim"`, else what it names (a
        file)."""
        if self._device.config.get("source") != "sim":
            return open_images(self._device.config, self._clock)
        if self._images is None:
            self._laboratory()
            self._images = MemoryImages(self._want_images)
        return self._images

    def stream(self, name: str) -> SetpointReceiver:
        """The receiving end of a stream that services.toml leads to this device. Raises ValueError
        for any other."""
        entry = self._directory.streams.get(name)
        if entry is None or entry.to != self._device.name:
            raise ValueError(
                f"no stream {name!r} leads here; write [streams.{name}] to = {self._device.name!r}"
            )
        return self._streams.setdefault(name, SetpointReceiver(entry.period, self._clock))

    def raise_event(self, name: str, **data: Any) -> None:
        """Raise an external event."""
        raised = plain(name, "name"), plain(data, "data")
        checked(Event(raised[0], self._device.name, 1, raised[1]))
        self._raised.append(raised)

    def file(self, path: str) -> bytes:
        """A file named in services.toml, relative to it."""
        return self._directory.file(path).read_bytes()

    def receive(self, envelope: Envelope) -> None:
        """Take what the laboratory or a stream sends to this device."""
        if envelope.channel == "can" and self._can is not None:
            self._can.arrived += read_can(envelope.body)
        elif envelope.channel == "image" and self._images is not None:
            image, wish = read_image(envelope.body, self.now)
            if wish == self._wish:
                self._images.put(image)
        elif envelope.channel == "stream":
            point = read_set_point(envelope.body)
            if point.stream in self._streams:
                self._streams[point.stream].take(point.values, point.held)

    def flush(self) -> None:
        """Send the frames of this tick."""
        if self._can is not None and self._can.out:
            self._send("can", can_body(self._can.out))
            self._can.out.clear()

    def raised(self) -> list[tuple[str, Mapping[str, Any]]]:
        """Events raised since the last call, in order."""
        if not self._raised:
            return []
        raised, self._raised = self._raised, []
        return raised

    def _want_images(self, rate: float) -> None:
        self._wish += 1
        self._send("control", images_wanted(rate, self._wish))

    def _send(self, channel: str, body: Any) -> None:
        laboratory = self._laboratory()
        self._post(Envelope(laboratory, self._device.name, laboratory, channel, body))

    def _laboratory(self) -> str:
        if not self._lives_at:
            self._lives_at = self._directory.laboratory()
        if not self._lives_at:
            raise ValueError(
                'lock step needs a simulated node; write sim = "module:function" in one '
                "[nodes.NAME]"
            )
        return self._lives_at
