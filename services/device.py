"""The interface of device drivers. A driver controls a camera, an arm or a rover on its node.

A driver is a class derived from `Driver` and named by import path in services.toml (`[devices.NAME]
driver = "module:Class"`); it is made as `Class(config, ports)`. A driver without a `period` is in
the worker process of its device, and actions use it directly as `ctx.device`. A driver with a
`period` is *cyclic*: in real time it has its own process, which steps it at absolute times, so no
action delays it; actions use a `Remote` of it: they `send` commands and read `state`. In lock step
both are in the node's process."""

from __future__ import annotations

import logging
import math
import operator
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from copy import copy
from functools import cached_property
from inspect import getattr_static, iscoroutinefunction, isfunction, signature
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Any,
    Final,
    Protocol,
    Union,
    get_args,
    get_origin,
    runtime_checkable,
)

from petrobot.services.comm.canopen.bus import CanBus
from petrobot.services.comm.location_file.reading import nearest
from petrobot.services.comm.protocol.plain import plain
from petrobot.services.comm.streams.image import ImageSource
from petrobot.services.comm.streams.line import ByteLine

if TYPE_CHECKING:
    import numpy as np

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
        """Seconds since its sender first sent these values, without their transport (inf before the
        first). A repetition does not reset it. Subtract it from values that count from the moment
        of sending, such as a remaining time. Never less than `age`."""

    @property
    def count(self) -> int:
        """Number of set points that have arrived."""


class Ports(Protocol):
    """Everything outside its device that a driver may use."""

    @property
    def now(self) -> float:
        """The cell's clock (s)."""

    def can(self) -> CanBus:
        """The CAN bus of this device."""

    def serial(self, port: str, baud: int) -> ByteLine:
        """Open a serial line (8 data bits, no parity, 1 stop bit); call it again after the line was
        lost. `port` is the device's key of that name: a path, or "pty:PATH" with a simulated
        laboratory. In lock step the line is always the laboratory's. Raises ConnectionError if the
        port does not exist."""

    def tcp(self, host: str, port: int) -> ByteLine:
        """Open a TCP connection to an IP address, or with "unix:PATH" to a simulated laboratory;
        call it again after the connection was lost. The call does not wait for the connection: what
        is sent meanwhile waits, and `receive` raises ConnectionError if it cannot be made. In lock
        step it always leads to the laboratory. Raises ValueError if `host` is not an address."""

    def images(self) -> ImageSource:
        """The image source of this device."""

    def stream(self, name: str) -> Setpoint:
        """The receiving end of a set-point stream."""

    def raise_event(self, name: str, **data: Any) -> None:
        """Raise an external event (numbered and kept until the coordinator has it)."""

    def random(self, purpose: str) -> np.random.Generator:
        """Return the random generator of (seed of the mission run, device, purpose).

        The seed comes with the device's first action of the mission run, or, if no action uses the
        device, when the mission run begins. So ask for the generator where you draw and do not keep
        it; before any mission run the seed is 0. Raises ValueError while the driver is being made.
        """

    def file(self, path: str) -> bytes:
        """Return the content of a file named in services.toml, relative to it."""

    def write_file(self, path: str, content: bytes) -> None:
        """Write such a file as a whole: after a power cut there is the old one or the new one. May
        take longer than a period."""


CAMERA_KEYS = (
    "source",
    "address",
    "latency",
    "fps",
    "width",
    "height",
    "fourcc",
    "exposure",
    "colour",
)
PORT_KEYS = ("interface", "channel", "bitrate", "can", *CAMERA_KEYS)
"""Keys of a device's table that its ports read: its bus and its image source."""
LIMITS = ("speed", "workspace", "dry_run")
"""Keys of a device's table for its first motions: any device may have them if its driver obeys them
(`Driver.obeys`)."""
OBEYED = frozenset((*LIMITS, "pause"))
"""What `Driver.obeys` may name."""
COMMON_KEYS = (*PORT_KEYS, *LIMITS)


class _Required:
    """Default of a required key."""


_BOUNDS: Final[Mapping[str, tuple[str, Callable[[float, float], bool]]]] = {
    "above": ("above", operator.gt),
    "least": ("of at least", operator.ge),
    "most": ("at most", operator.le),
}


class Key:
    """A key of a device's table, declared by `key`."""

    def __init__(
        self, default: Any, text: str, bounds: Mapping[str, float], choices: tuple[str, ...]
    ) -> None:
        self.default = default
        self.text = text
        self.bounds = bounds
        self.choices = choices
        self.name = ""
        self.kind: type = object
        """Type of the value: bool, int, float, str, list or dict; object: any plain data."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name
        said = owner.__annotations__.get(name)
        known = {k.__name__: k for k in (bool, int, float, str, list, dict)}
        if said is not None:
            self.kind = known.get(_type_word(said), object)
        elif self.default is not _Required:
            self.kind = type(self.default)

    def __get__(self, driver: object, owner: type) -> Any:
        """Return the key itself of a class. Raises AttributeError in a driver that has not read its
        keys: a read value hides this."""
        if driver is None:
            return self
        text = f"{self.name}: the key is not read yet; a constructor of your own first calls"
        raise AttributeError(f"{text} super().__init__(config, ports)")

    def with_default(self, default: Any) -> Key:
        """Return the same key with another default."""
        other = copy(self)
        other.default = default
        return other

    def fault(self, config: Mapping[str, Any]) -> str:
        """Return what is wrong with the key's value in a table, or with its default; empty if
        nothing is."""
        default = self.default
        if self.kind is list and isinstance(default, tuple):
            default = [*default]
        if default is not _Required and default is not None and not self._fits(default):
            text = f"expected {self._expected()}, found the default {default!r:.60}"
            return f"{text} of its `key`; correct it or the annotation in the driver"
        if self.name not in config:
            return f"is missing; give {self._expected()}" if default is _Required else ""
        value = config[self.name]
        endless = isinstance(value, float) and not math.isfinite(value)
        fits = self._fits(value) and not endless
        return "" if fits else f"expected {self._expected()}, found {value!r:.60}"

    def read(self, config: Mapping[str, Any]) -> Any:
        """Return the key's value in a table that has no fault."""
        value = config.get(self.name, self.default)
        return float(value) if self.kind is float and value is not None else copy(value)

    def _fits(self, value: Any) -> bool:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        fits = number if self.kind is float else isinstance(value, self.kind)
        if not fits or (self.kind is int and not number):
            return False
        if self.choices:
            return value in self.choices
        return not number or all(_BOUNDS[b][1](value, end) for b, end in self.bounds.items())

    def _expected(self) -> str:
        words = {
            bool: "true or false",
            int: "a whole number",
            float: "a number",
            str: "a text",
            list: "a list",
            dict: "a table",
        }
        limits = " and ".join(f"{_BOUNDS[b][0]} {end:g}" for b, end in self.bounds.items())
        if self.bounds.keys() == {"least", "most"}:
            limits = "from {least:g} to {most:g}".format(**self.bounds)
        wish = " ".join(filter(None, (words.get(self.kind, "a value"), limits)))
        wish = " or ".join(f'"{text}"' for text in self.choices) or wish
        return wish + (f" ({self.text})" if self.text else "")


def _type_word(said: Any) -> str:
    """Return the name of the type in an annotation, which may be a text, without "or None"; empty
    if it names several types."""
    if not isinstance(said, str):
        parts = get_args(said) if get_origin(said) in (Union, UnionType) else (said,)
        said = "|".join(getattr(part, "__name__", "") for part in parts)
    words = {word.strip() for word in re.sub(r"\[.*?\]", "", said).split("|")}
    words -= {"None", NoneType.__name__}
    return words.pop() if len(words) == 1 else ""


def key(
    default: Any = _Required,
    text: str = "",
    *,
    above: float | None = None,
    least: float | None = None,
    most: float | None = None,
    choices: Iterable[str] = (),
) -> Any:
    """Declare a key of a device's table in services.toml as an attribute of its driver.

    `port: str = key(text="serial port")` is required, `speed = key(0.1, "m/s", above=0, most=2)`
    has a default and limits, `side = key("left", choices=("left", "right"))` is one of some texts.
    The type is that of the annotation, else of the default. The driver reads the value as
    `self.port`; a missing, unknown or wrong key is refused by name.
    """
    given = {"above": above, "least": least, "most": most}
    bounds = {name: end for name, end in given.items() if end is not None}
    return Key(default, text, bounds, tuple(choices))


class Workspace:
    """The box in which a device may move: bounds (m) by axis, in the frame that its driver's
    documentation names. An axis without bounds is not limited; a box without bounds is all of
    space."""

    def __init__(self, bounds: Mapping[str, Sequence[float]] | None = None) -> None:
        """Raises ValueError for a table that is not a box."""
        self.bounds = dict(bounds or {}) if isinstance(bounds, Mapping | None) else {"": ()}
        for axis, ends in self.bounds.items():
            fits = axis in ("x", "y", "z") and isinstance(ends, list | tuple) and len(ends) == 2
            if not fits or not all(map(_is_number, ends)) or not ends[0] < ends[1]:
                raise ValueError(
                    "workspace: expected a table such as { x = [-0.5, 0.5], z = [0.1, 0.9] } with "
                    f"the least and the greatest value (m) of x, y or z, found {bounds!r:.80}"
                )

    def outside(self, point: Sequence[float]) -> str:
        """Return a message if a point (x, y, z in m) is outside; empty if it is inside."""
        at = dict(zip("xyz", point, strict=False))
        if all(low <= at[axis] <= high for axis, (low, high) in self.bounds.items()):
            return ""
        box = ", ".join(f"{axis} = [{low:g}, {top:g}]" for axis, (low, top) in self.bounds.items())
        there = ", ".join(f"{axis} = {value:.3f}" for axis, value in at.items())
        return f"the point {there} m lies outside the workspace {box} m"


class Driver:
    """The base class of drivers, for one device. Override the methods that the device needs.

    Nothing here may block. `now` is the cell's clock (s). If a method raises, except `command`
    (which refuses so) and `picture`, the device is stopped, its run ends in ERROR with the
    exception's message, and the traceback is in the node's log. In real time the driver is then
    made again in a new process; in lock step its device cannot be used any more.
    """

    period: float | None = None
    """Seconds between calls of `step`; None for a driver without cyclic work."""
    obeys: Collection[str] = ()
    """Which of `speed`, `workspace` and `dry_run` this driver obeys: a table that asks for another
    one is refused. And "pause", if it obeys `paused`."""
    speed: float = 1.0
    """Share of its normal speed at which the device may move: above 0, at most 1."""
    workspace = Workspace()
    """Where the device may move: refuse commands and set points outside, and stop a motion that
    leaves it."""
    dry_run: bool = False
    """Drives off: obey all commands as usual and report the motion that would result, but enable no
    drive and send no motion."""
    paused: bool = False
    """The operator pauses: let the device stand still until it is False again, then continue."""

    def __init__(self, config: Mapping[str, Any], ports: Ports | None) -> None:
        """Read the keys of the device's table. With ports None, which is for tests, the driver gets
        those of a rehearsal. Raises ValueError with every wrong key."""
        if ports is None:
            from petrobot.services.rehearsal import TestPorts  # here: only a test needs it

            ports = TestPorts()
        self.ports: Ports = ports
        for name, value in read_keys(type(self), config).items():
            setattr(self, name, value)
        self.limit(config)
        self._verify()
        self.setup()

    def setup(self) -> None:
        """Prepare the driver: its keys are read, and `ports` can be used."""

    def _verify(self) -> None:
        """Raise ValueError, "KEY: what is wrong", if the values of its keys make no sense. A check
        calls it for an object that has nothing but these."""

    def limit(self, config: Mapping[str, Any]) -> None:
        """Read `speed`, `workspace` and `dry_run` of the device's table: for a constructor that
        does not call that of `Driver`. Raises ValueError."""
        if faults := faults_of_limits(type(self), config):
            raise ValueError("; ".join(text for _, text in faults))
        if "speed" in config and "speed" not in keys_of(type(self)):
            self.speed = float(config["speed"])
        if "workspace" in config and "workspace" not in keys_of(type(self)):
            self.workspace = Workspace(config["workspace"])
        self.dry_run = config.get("dry_run", False)

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Obey a command of an action (cyclic drivers). Raise ValueError to refuse it: that ends
        the run in ERROR with this message, unless the action reads it in `Remote.refused`. Any
        other exception refuses it, too."""
        raise ValueError(f"this device takes no commands, but was sent {dict(body)}")

    def step(self, now: float) -> None:
        """Do the work of one cycle (cyclic drivers)."""

    def state(self) -> Mapping[str, Any]:
        """Return plain data for actions, operator and report; published each cycle."""
        return {}

    def stop(self, now: float) -> None:
        """Bring the device to a safe standstill. May be called at any time, and repeatedly. A
        device that can move must override this and `stopped`."""

    def stopped(self) -> bool:
        """Return whether the device is known to stand still."""
        return not can_move(type(self))

    def hold(self, now: float) -> str:
        """Pause for the operator: answer "held", "cannot hold" or "stopped". A driver with "pause"
        in `obeys` only looks at `paused`."""
        if "pause" in self.obeys:
            self.paused = True
            return "held"
        return "held" if self.stopped() else "cannot hold"

    def release(self, now: float) -> None:
        """End the operator's pause."""
        if "pause" in self.obeys:
            self.paused = False

    def close(self) -> None:
        """Release the device."""


RESERVED = frozenset(
    ("node", "driver", "obeys", "ports", *(n for n, v in vars(Driver).items() if callable(v)))
)
"""Names that no key of a driver can have: they mean something else in the table, or in `Driver`."""


def keys_of(driver: type) -> dict[str, Key]:
    """Return the keys that a driver's class declares, those of its base classes first. A plain
    value that a derived class gives to the key of a base class is the key's new default."""
    found = dict[str, Key]()
    for base in reversed(driver.__mro__):
        for name, value in vars(base).items():
            if isinstance(value, Key):
                found[name] = value
            elif name in found and not callable(value) and not hasattr(value, "__get__"):
                found[name] = found[name].with_default(value)
    return found


def read_keys(driver: type, config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of the keys that a driver's class declares. Raises ValueError with every
    key that is missing, unknown or of another type."""
    if faults := _faults_of_keys(driver, config):
        raise ValueError("; ".join(f"{name}: {text}" for name, text in faults))
    return {name: declared.read(config) for name, declared in keys_of(driver).items()}


def faults_of_keys(
    driver: type, config: Mapping[str, Any], moves: bool | None = None
) -> list[tuple[str, str]]:
    """Return each wrong key of a device's table, and what is wrong with it, without making the
    driver; for a driver that declares no keys and reads its table itself, only
    `faults_of_limits`."""
    reads_itself = driver.__init__ is not Driver.__init__ and not keys_of(driver)  # type: ignore[misc]
    own = [] if reads_itself else _faults_of_keys(driver, config)
    if not own and issubclass(driver, Driver) and not reads_itself:
        probe = object.__new__(driver)
        vars(probe).update(read_keys(driver, config))
        try:
            probe._verify()
        except ValueError as fault:
            name, _, text = str(fault).partition(": ")
            own.append((name, text))
    return own + faults_of_limits(driver, config, moves)


def faults_of_limits(
    driver: type, config: Mapping[str, Any], moves: bool | None = None
) -> list[tuple[str, str]]:
    """Return what is wrong with `speed`, `workspace` and `dry_run` in a device's table, by key: a
    driver that does not obey a key would ignore it. A key of this name that the driver declares
    belongs to the driver, as does a key of a class that is not derived from `Driver` and has no
    `obeys`. `moves`: whether the device can move, if that is known better than from the class."""
    faults = list[tuple[str, str]]()
    moves = can_move(driver) if moves is None else moves
    foreign = not issubclass(driver, Driver) and not hasattr(driver, "obeys")
    obeys = getattr(driver, "obeys", ())
    if isinstance(obeys, str):
        text = f"{driver.__name__}.obeys: expected a tuple, found {obeys!r:.60}; write"
        faults.append(("driver", f'{text} obeys = ("{obeys.strip():.60}",)'))
        obeys = (obeys,)
    faults += [("driver", text) for text in faults_of_methods(driver)]
    for name in sorted({*obeys} - OBEYED):
        text = f"{driver.__name__}.obeys: expected some of {', '.join(sorted(OBEYED))}"
        faults.append(("driver", f"{text}; found {name!r:.60}"))
    has = _overridden(driver)
    if moves and (absent := {"stop", "stopped"} - has):
        having = f"has {', '.join(sorted(has))}, but" if has else "follows set points, but has"
        text = f"{driver.__name__} {having} no {', '.join(sorted(absent))}"
        text += ": after an emergency stop it could move on, and be reported as stopped; write both"
        faults.append(("driver", f"{text} (if it never moves: `pass` and `return True`)"))
    for name in LIMITS:
        still = name == "dry_run" and not moves  # as in every dry run
        own = name in keys_of(driver) or (foreign and name != "dry_run")
        if name not in config or own or still:
            continue
        if name not in obeys:
            text = f"{name}: {driver.__name__} does not obey it; do without it, or write obeys = "
            faults.append((name, f"{text}{(*obeys, name)} in the driver and obey it there"))
            continue
        value = config[name]
        if name == "dry_run" and not isinstance(value, bool):
            faults.append((name, f"dry_run: expected true or false, found {value!r:.60}"))
        if name == "speed" and not (_is_number(value) and 0.0 < value <= 1.0):
            text = "expected a number above 0 and at most 1, the share of the normal speed"
            faults.append((name, f"speed: {text}, found {value!r:.60}"))
        if name == "workspace":
            try:
                Workspace(value)
            except ValueError as fault:
                faults.append((name, str(fault)))
    return faults


def faults_of_methods(driver: object) -> list[str]:
    """Return what is wrong with the methods of a driver, or of its class: those that its node
    cannot call."""
    kind = driver if isinstance(driver, type) else type(driver)
    faults, absent = list[str](), object()
    for name, usual in sorted(INTERFACE.items()):
        if (method := getattr_static(driver, name, absent)) is absent:
            continue
        takes = ", ".join(given := list(signature(usual).parameters))
        here, write = f"`{name}` of {kind.__name__}", f"write `def {name}({takes})`"
        if isinstance(method, property | cached_property):
            faults.append(f"{here} is a property, expected a method; remove the decorator")
        elif not callable(method) and not hasattr(method, "__get__"):
            text = f"{here} is {method!r:.40}, expected a method"
            faults.append(f"{text}; {write}, and give this value another name")
        elif iscoroutinefunction(method):
            text = f"{here} is `async`: its node does not await it, so it would do nothing"
            faults.append(f"{text}; write `def {name}`")
        elif isfunction(method) and not _fits(method, given):
            own = ", ".join(signature(method, follow_wrapped=False).parameters)
            code = method.__code__
            here += f" ({code.co_filename.rpartition('/')[2]}:{code.co_firstlineno})"
            faults.append(f"{here} takes ({own}), but is called with ({takes}); {write}")
    return faults


def _fits(method: Callable[..., Any], given: Sequence[str]) -> bool:
    try:
        signature(method, follow_wrapped=False).bind(*given)  # a decorator may drop some of them
    except TypeError:
        return False
    return True


def fault_of_period(driver: Driver) -> str:
    """Return what is wrong with a driver's period; empty if nothing is."""
    period = driver.period
    if period is None or (_is_number(period) and period > 0.0):
        return ""
    return f"period: expected seconds above 0 or None, found {period!r:.40}"


def can_move(driver: type) -> bool:
    """Return whether the class is that of a cyclic driver which takes commands or can be stopped:
    any other device, such as a button, does not move."""
    steps = getattr(driver, "step", Driver.step) is not Driver.step
    cyclic = steps or getattr(driver, "period", None) is not None
    return cyclic and not _overridden(driver).isdisjoint(("command", "stop", "quick_stop"))


def _overridden(driver: type) -> set[str]:
    """Return the methods with which a driver moves or stops its device."""
    methods = ("command", "stop", "stopped", "quick_stop")
    return {m for m in methods if getattr(driver, m, None) is not getattr(Driver, m, None)}


def numbers(value: Any, count: int, name: str) -> list[float]:
    """Return a list of `count` finite numbers. Raises ValueError with the name for anything
    else."""
    fits = isinstance(value, list | tuple) and len(value) == count and all(map(_is_number, value))
    if not fits:
        raise ValueError(f"{name}: expected {count} finite numbers, found {value!r:.80}")
    return [float(v) for v in value]


def table(
    value: Any, name: str, needed: Collection[str], other: Collection[str] = ()
) -> dict[str, Any]:
    """Return a table that has the keys `needed`, and of all others only `other`. Raises ValueError
    with the name for anything else."""
    if not isinstance(value, dict):
        raise ValueError(f"{name}: expected a table with {', '.join(needed)}, found {value!r:.60}")
    missing, unknown = {*needed} - {*value}, {*value} - {*needed, *other}
    if missing or unknown:
        wrong = f"is missing {sorted(missing)}" if missing else f"unknown keys {sorted(unknown)}"
        more = f", optional {sorted(other)}" if other else ""
        raise ValueError(f"{name}: {wrong}; expected {sorted(needed)}{more}")
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _faults_of_keys(driver: type, config: Mapping[str, Any]) -> list[tuple[str, str]]:
    own, faults = keys_of(driver), list[tuple[str, str]]()
    for name, declared in own.items():
        if name in RESERVED:
            text = f"{driver.__name__} declares the key {name!r}, which has another meaning here"
            faults.append((name, f"{text}; rename it in the driver, such as own_{name}"))
            continue
        if fault := declared.fault(config):
            faults.append((name, fault))
    for name in config:
        if name in own or name in COMMON_KEYS:
            continue
        text = "unknown key"
        if hasattr(driver, name) and name not in RESERVED:
            default = f"{getattr(driver, name)!r:.40}"
            text = f"{driver.__name__} does not read it; write {name} = key({default}) in the class"
        elif name in driver.__annotations__:
            text = (
                f"{driver.__name__} declares only its type; write {name}: ... = key() in the class"
            )
        else:  # its own keys come before those of all drivers: `speed` is near many names
            hint, common = nearest(name, own), nearest(name, COMMON_KEYS)
            hint = common if "did you mean" in common and "did you mean" not in hint else hint
            text += hint if "did you mean" in hint else f"{hint}; drop it"
        faults.append((name, text))
    return faults


@runtime_checkable
class QuickStopping(Protocol):
    """A driver that can stop harder than its stop routine does."""

    def quick_stop(self, now: float) -> None:
        """Emergency stop (IEC 60204-1, category 0 or 1): stop at once. The device stays stopped: it
        gets no command until the stop is cleared."""


PICTURE = "picture"
"""The operator's command for a device's picture."""


@runtime_checkable
class HasPicture(Protocol):
    """A driver with a picture for the operator, such as a camera image."""

    def picture(self) -> Mapping[str, Any]:
        """Return the newest picture: `mime`, `data` (bytes), `width`, `height` (px), `age` (s),
        `note` and `detections` as in docs/operator-protocol.md; empty when there is none. Called a
        few times per second, only while an operator watches."""


INTERFACE = {
    name: method
    for kind in (Driver, QuickStopping, HasPicture)
    for name, method in vars(kind).items()
    if isfunction(method) and not name.startswith("_") and name != "limit"
}
"""Methods that a node calls, with their parameters."""


def picture_of(driver: Driver | None) -> Mapping[str, Any]:
    """Return the picture of a device, empty if it has none. An exception is only logged: the device
    continues."""
    try:
        picture: Mapping[str, Any] = (
            plain(driver.picture(), "picture") if isinstance(driver, HasPicture) else {}
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
    """A cyclic driver, as its actions use it."""

    def send(self, body: Mapping[str, Any]) -> int:
        """Send a command. Return its number; `handled` reaches it when the driver has accepted or
        refused the command."""

    @property
    def handled(self) -> int:
        """Number of the last command that the driver has accepted or refused."""

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
