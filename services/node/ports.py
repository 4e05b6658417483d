"""The ports of a driver in real time: a real or simulated bus, a camera, and the receiving ends of
streams."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import inf
from typing import TYPE_CHECKING, Any

from petrobot.services.comm.canopen.bus import CanBus
from petrobot.services.comm.location_file import DeviceEntry, Directory, StreamEntry
from petrobot.services.comm.protocol.messages import Event
from petrobot.services.comm.protocol.plain import plain
from petrobot.services.comm.streams.image import ImageSource
from petrobot.services.comm.streams.line import UNIX, ByteLine, SerialPort, TcpConnection
from petrobot.services.comm.streams.stream import Incoming, StreamReceiver
from petrobot.services.comm.tls.credentials import credentials
from petrobot.services.host.whole_file import write_whole
from petrobot.services.worker.context import Draws, checked
from petrobot.services.worker.remote import EMERGENCY_STOP
from petrobot.services.worker.setpoints import SetpointReceiver

if TYPE_CHECKING:
    import numpy as np

CAN_KEYS = ("interface", "channel", "bitrate")


class DevicePorts:
    """The ports of one device that are the same in real time and in lock step."""

    def __init__(
        self, directory: Directory, device: DeviceEntry, clock: Callable[[], float]
    ) -> None:
        self._directory = directory
        self._device = device
        self._clock = clock
        self._raised: list[tuple[str, Mapping[str, Any]]] = []
        self.draws = Draws(device.name)

    @property
    def now(self) -> float:
        """The cell's clock (s)."""
        return self._clock()

    def raise_event(self, name: str, **data: Any) -> None:
        """Raise an external event."""
        raised = plain(name, "name"), plain(data, "data")
        checked(Event(raised[0], self._device.name, 1, raised[1]))
        self._raised.append(raised)

    def raised(self) -> list[tuple[str, Mapping[str, Any]]]:
        """Return the events raised since the last call, in order."""
        if not self._raised:
            return []
        raised, self._raised = self._raised, []
        return raised

    def random(self, purpose: str) -> np.random.Generator:
        """Return the generator of (seed, device, purpose)."""
        return self.draws.random(purpose)

    def file(self, path: str) -> bytes:
        """Return the content of a file named in services.toml, relative to it."""
        return self._directory.file(path).read_bytes()

    def write_file(self, path: str, content: bytes) -> None:
        """Write a file named in services.toml, relative to it."""
        write_whole(self._directory.source.parent / path, content)

    def _open_images(self) -> ImageSource:
        """Return the image source that the device's key `source` names. The path of a recording is
        relative to services.toml. Raises ValueError if there is no such recording."""
        from petrobot.services.comm.streams.camera import open_images

        config = self._device.config
        kind, _, path = str(config.get("source", "")).partition(":")
        if kind == "file" and path:
            recording = self._directory.file(path)
            if not recording.is_file():
                raise ValueError(
                    f'source = "file:{path}": no file {recording}; write the path of a recording'
                )
            config = {**config, "source": f"file:{recording}"}
        return open_images(config, self._clock)

    def _stream_entry(self, name: str) -> StreamEntry:
        """Return a stream that services.toml directs to this device. Raises ValueError for any
        other."""
        entry = self._directory.streams.get(name)
        if entry is None or entry.to != self._device.name:
            raise ValueError(
                f"no stream {name!r} leads here (write [streams.{name}] to = "
                f"{self._device.name!r} in {self._directory.source.name})"
            )
        return entry


class ProcessPorts(DevicePorts):
    """Implements `services.device.Ports` for the driver of one device in its process."""

    def __init__(
        self,
        directory: Directory,
        device: DeviceEntry,
        clock: Callable[[], float],
        tickets: Mapping[str, str],
        keys: Sequence[bytes] = (),
        cleared: float = inf,
    ) -> None:
        """`cleared`: how long ago an emergency stop of the device was cleared (s)."""
        super().__init__(directory, device, clock)
        self._tickets = tickets
        self._cleared = cleared
        self._key = tuple(keys) or None
        self._can: CanBus | None = None
        self._images: ImageSource | None = None
        self._setpoints: dict[str, SetpointReceiver] = {}
        self._incoming: dict[str, Incoming] = {}
        self._receiver: StreamReceiver | None = None

    def can(self) -> CanBus:
        """The bus that the device's keys `interface`, `channel`, `bitrate` (or its table `can`)
        name, as for python-can."""
        if self._can is None:
            from petrobot.services.comm.canopen.ports import open_can

            config = self._device.config
            self._can = open_can(
                config.get("can") or {key: config[key] for key in CAN_KEYS if key in config}
            )
        return self._can

    def serial(self, port: str, baud: int) -> ByteLine:
        """Open a serial port of this host; "pty:PATH" is one of a simulated laboratory, with its
        path relative to services.toml."""
        if port.startswith("pty:"):
            port = str(self._directory.source.parent / port.removeprefix("pty:"))
        return SerialPort(port, baud)

    def tcp(self, host: str, port: int) -> ByteLine:
        """Open a TCP connection; "unix:PATH" is one to a simulated laboratory, with its path
        relative to services.toml."""
        if host.startswith(UNIX):
            host = f"{UNIX}{self._directory.source.parent / host.removeprefix(UNIX)}"
        return TcpConnection(host, port)

    def images(self) -> ImageSource:
        """Return the image source that the device's key `source` names."""
        if self._images is None:
            self._images = self._open_images()
        return self._images

    def stream(self, name: str) -> SetpointReceiver:
        """Return the receiving end of a stream that services.toml directs to this device. Raises
        ValueError for any other."""
        entry = self._stream_entry(name)
        if name not in self._setpoints:
            self._setpoints[name] = setpoint = SetpointReceiver(entry.period, self._clock)
            if ticket := self._tickets.get(name, ""):  # else there is no node that could send
                self._incoming[name] = Incoming(entry.period, setpoint, ticket)
                self._listen(ticket)
        return self._setpoints[name]

    def _listen(self, ticket: str) -> None:
        if self._receiver is None:
            host = self._directory.nodes[self._device.node].host
            key = credentials(self._directory, self._device.node, self._key).stream_key(ticket)
            self._receiver = StreamReceiver(
                self._device.name,
                self._incoming,
                host=host,
                key=key,
                clock=self._clock,
                cleared=self._cleared,
            )

    def stream_addresses(self) -> dict[str, tuple[str, int]]:
        """Return IP address and TCP port of each stream that leads here. All are open from the
        beginning: a driver may ask for one as late as in its first `step`."""
        for name in self._tickets:
            if self._directory.streams[name].to == self._device.name:
                self.stream(name)
        return (
            {} if self._receiver is None else dict.fromkeys(self._incoming, self._receiver.address)
        )

    def poll(self) -> None:
        """Read the set points that arrived."""
        if self._receiver is not None:
            self._receiver.poll()

    def withhold(self, cause: str) -> None:
        """Let the driver see no set point while its device is stopped for this cause; after an
        emergency stop none of a run from before either. Call this after `poll`."""
        for setpoint in self._setpoints.values():
            setpoint.withdraw()
        if self._receiver is not None and cause == EMERGENCY_STOP:
            self._receiver.bar()

    @property
    def busy(self) -> bool:
        """Whether `poll` must be called often."""
        return self._receiver is not None
