"""How a device driver is written: what owns a camera, an arm or a rover on its node.

A driver is a class named by import path in services.toml (`[devices.NAME] driver =
"module:Class"`), constructed as `Class(config, ports)`. One without a `period` lives in the worker
process of its device, and actions use it directly as `ctx.device`. One with a `period` is *cyclic*:
in real time it lives in a process of its own, paced by absolute deadline, so no user code delays
it; actions see a `Remote` of it: `send` a command, read `state`. In lock step both live inline.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from typing import Any, Protocol, runtime_checkable

from petrobot.services.comm.canopen.bus import CanBus
from petrobot.services.comm.location_file.reading import nearest
from petrobot.services.comm.protocol.plain import plain
from petrobot.services.comm.streams.image import ImageSource

_log = logging.getLogger(__name__)


class Setpoint(Protocol):
    """The receiving end of a set-point stream: the newest value and how old it is."""

    @property
    def values(self) -> tuple[float, ...] | None:
        """The newest set point, None before the first or when it is stale (older than three of its
        periods)."""

    @property
    def age(self) -> float:
        """Seconds since the newest one arrived (inf before the first)."""

    @property
    def held(self) -> float:
        """Seconds since its sender first sent these values (inf before the first), but for their
        way here: a repeat makes them no younger. What a value that means "from now on" must be
        reduced by; never less than `age`."""

    @property
    def count(self) -> int:
        """How many have arrived."""


class Ports(Protocol):
    """What a driver may reach: everything else is out of bounds for it."""

    @property
    def now(self) -> float:
        """The cell's clock (s)."""

    def can(self) -> CanBus:
        """The CAN bus of this device."""

    def images(self) -> ImageSource:
        """The image source of this device."""

    def stream(self, name: str) -> Setpoint:
        """The receiving end of a set-point stream."""

    def raise_event(self, name: str, **data: Any) -> None:
        """Raise an external event (numbered and kept until the coordinator has it)."""

    def file(self, path: str) -> bytes:
        """A file named in services.toml, relative to it."""


PORT_KEYS = ("interface", "channel", "bitrate", "can", "source", "address", "latency")
"""Keys of a device's table that its ports read: what bus and which images it has."""


def refuse_unknown_keys(config: Mapping[str, Any], own: Collection[str]) -> None:
    """Raise ValueError if a device's table has a key that is neither its driver's `own` nor its
    ports': a mistyped one would silently be no setting at all. For a driver's constructor."""
    for key in config:
        if key not in own and key not in PORT_KEYS:
            raise ValueError(f"unknown key {key!r}{nearest(key, [*own, *PORT_KEYS])}")


class Driver(Protocol):
    """One device. Nothing here blocks; `now` is the cell's clock (s).

    A method that raises has broken the driver, but for `command` (which refuses so) and `picture`:
    the device is stopped, its run ends in ERROR with the exception's words, and the traceback goes
    to the node's log. In real time the driver is then made again in a new process; in lock step,
    where nothing could have made it break but its code, its device works no more.
    """

    period: float | None
    """Seconds between calls of `step`; None for a driver without cyclic duty."""

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Take a command from an action (cyclic drivers). A bad one raises ValueError: it is
        refused, and ends its run in ERROR with these words unless the action reads them in
        `Remote.refused`. Any other exception refuses it, too."""

    def step(self, now: float) -> None:
        """One cycle (cyclic drivers)."""

    def state(self) -> Mapping[str, Any]:
        """Plain data for actions, operator and report, published each cycle."""

    def stop(self, now: float) -> None:
        """Stop routine: bring the device to a safe standstill. May be called at any time and
        again."""

    def stopped(self) -> bool:
        """Whether the device is known to stand still."""

    def hold(self, now: float) -> str:
        """Operator's pause: answers "held", "cannot hold" or "stopped"."""

    def release(self, now: float) -> None:
        """End of the operator's pause."""

    def close(self) -> None:
        """Let the device go."""


@runtime_checkable
class QuickStopping(Protocol):
    """A driver that can stop harder than its stop routine does."""

    def quick_stop(self, now: float) -> None:
        """Emergency stop (IEC 60204-1, category 0 or 1): stop at once. It stays stopped: no command
        comes until it is cleared."""


PICTURE = "picture"
"""The operator's command for what a device sees."""


@runtime_checkable
class Watched(Protocol):
    """A driver that can show its operator a picture of what it sees."""

    def picture(self) -> Mapping[str, Any]:
        """The newest one: `mime`, `data` (bytes), `width`, `height` (px), `age` (s), `note` and
        `detections` as in docs/operator-protocol.md; empty when there is none. Asked for a few
        times a second, and only while somebody looks."""


def picture_of(driver: Driver | None) -> Mapping[str, Any]:
    """The picture of a device, empty for one that has none. One that cannot be had goes to the log:
    the device moves on."""
    try:
        picture: Mapping[str, Any] = (
            plain(driver.picture(), "picture") if isinstance(driver, Watched) else {}
        )
    except Exception:
        _log.exception("a driver gives no picture")
        return {}
    return picture


def stop_at_once(driver: Driver, now: float) -> None:
    """Emergency stop of a device: its driver's `quick_stop` if there is one, else its stop
    routine."""
    if isinstance(driver, QuickStopping):
        driver.quick_stop(now)
    else:
        driver.stop(now)


class Remote(Protocol):
    """A cyclic driver as its actions see it."""

    def send(self, body: Mapping[str, Any]) -> int:
        """Send a command; gives its number, which `handled` reaches once the driver has taken
        it."""

    @property
    def handled(self) -> int:
        """Number of the last command that the driver has taken."""

    @property
    def refused(self) -> str:
        """Why the last command was refused; empty if it was not. A refusal that the action does not
        read ends its run in ERROR, cause `command_refused`."""

    @property
    def state(self) -> Mapping[str, Any]:
        """The driver's newest published state."""

    @property
    def age(self) -> float:
        """Seconds since that state was published."""
