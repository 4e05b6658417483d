"""The base class of drivers: its default methods, and the keys of a device's table."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import wraps
from pathlib import Path
from typing import Any, Optional

import pytest

from petrobot.services.comm.location_file import DeviceEntry, DirectoryError, parse
from petrobot.services.device import Driver, faults_of_methods, key, read_keys, table
from petrobot.services.node.drivers import make_driver

CELL = """schema = 1
[nodes.pc]
host = "127.0.0.1"
port = 7300
"""


class Scanner(Driver):
    """A driver without cyclic work: it defines only the methods that it needs."""

    port: str = key(text="serial port")
    rate: float = key(9600, "baud")
    tries: int = key(3)
    loud = key(False)
    codes: list[str] = key([])

    def read(self) -> str:
        """Return the newest code."""
        return f"{self.port}@{self.rate}"


class Hides(Driver):
    """A driver with a value that has the name of a method."""

    def setup(self) -> None:
        self.state: Any = "idle"


class Broken(Driver):
    """A driver whose device is not connected."""

    def __init__(self, config: Mapping[str, Any], ports: Any) -> None:
        super().__init__(config, ports)
        raise FileNotFoundError(2, "No such file or directory", "/dev/ttyUSB7")


def made(driver: str, **config: Any) -> Driver:
    """Return the driver of a device with this table."""
    cell = parse(CELL, Path("services.toml"))
    return make_driver(cell, DeviceEntry("it", "pc", f"{__name__}:{driver}", config), None)  # type: ignore[arg-type]


def test_a_driver_needs_only_the_methods_that_its_device_uses() -> None:
    scanner = made("Scanner", port="/dev/ttyUSB0", rate=19200)
    assert isinstance(scanner, Scanner) and scanner.read() == "/dev/ttyUSB0@19200.0"
    assert (scanner.tries, scanner.loud, scanner.codes) == (3, False, [])
    assert scanner.period is None and scanner.state() == {} and scanner.stopped()
    assert scanner.hold(0.0) == "held"
    for method in (scanner.step, scanner.stop, scanner.release):
        method(0.0)
    scanner.close()
    with pytest.raises(ValueError, match="takes no commands"):
        scanner.command(0.0, {"go": 1})


def test_two_devices_do_not_share_a_default() -> None:
    first, second = (made("Scanner", port=name) for name in "ab")
    assert isinstance(first, Scanner) and isinstance(second, Scanner)
    first.codes.append("x")
    assert second.codes == []


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({}, "port: is missing; give a text (serial port)"),
        ({"port": 3}, "port: expected a text (serial port), found 3"),
        ({"port": "a", "rate": "fast"}, "rate: expected a number (baud), found 'fast'"),
        ({"port": "a", "rate": True}, "rate: expected a number (baud), found True"),
        ({"port": "a", "rate": float("nan")}, "rate: expected a number"),
        ({"port": "a", "tries": 1.5}, "tries: expected a whole number, found 1.5"),
        ({"port": "a", "tries": True}, "tries: expected a whole number, found True"),
        ({"port": "a", "loud": 1}, "loud: expected true or false, found 1"),
        ({"port": "a", "codes": "x"}, "codes: expected a list, found 'x'"),
        ({"port": "a", "rat": 1}, "rat: unknown key; did you mean 'rate'?"),
        ({"rat": 1}, "port: is missing; give a text (serial port); rat: unknown key"),
    ],
)
def test_a_wrong_key_is_refused_by_name(config: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError) as fault:
        read_keys(Scanner, config)
    assert words in str(fault.value)
    with pytest.raises(DirectoryError, match=r"services\.toml: devices\.it: .*correct the keys"):
        made("Scanner", **config)


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"opening": 0.0}, "opening: expected a number above 0 and at most 0.1 (m), found 0.0"),
        ({"opening": -1}, "opening: expected a number above 0 and at most 0.1 (m), found -1"),
        ({"opening": 0.11}, "opening: expected a number above 0 and at most 0.1 (m), found 0.11"),
        ({"opening": "0.05"}, "opening: expected a number above 0 and at most 0.1 (m), found"),
        ({"share": 1.1}, "share: expected a number from 0 to 1, found 1.1"),
        ({"tries": -1}, "tries: expected a whole number of at least 0, found -1"),
        ({"side": "up"}, 'side: expected "left" or "right" (of the belt), found \'up\''),
        ({"side": ["left"]}, 'side: expected "left" or "right" (of the belt), found [\'left\']'),
    ],
)
def test_a_value_outside_the_limits_of_its_key_is_refused(
    config: dict[str, Any], words: str
) -> None:
    class Gripper(Driver):
        opening: float = key(0.1, "m", above=0, most=0.1)
        tries: int = key(0, least=0)
        side: str = key("left", "of the belt", choices=("left", "right"))
        offset: float = key(None, least=0)
        share: float = key(1.0, least=0, most=1)

    read = read_keys(Gripper, {"opening": 0.1, "tries": 0, "side": "right"})
    assert read == {"opening": 0.1, "tries": 0, "side": "right", "offset": None, "share": 1.0}
    with pytest.raises(ValueError, match="^" + re.escape(words)):
        read_keys(Gripper, config)

    class Wider(Gripper):
        opening = 0.2

    with pytest.raises(ValueError, match=r"opening: expected .*, found the default 0.2 of its"):
        read_keys(Wider, {})


def test_a_default_has_the_type_of_its_key() -> None:
    """A tuple stands for a list, None and nan for nothing."""

    class Right(Driver):
        limits: list[float] = key((0.0, 1.0))
        gains = key((1, 2))
        offset: float = key(float("nan"))
        name: str = key(None)
        share: float = key(1)

    class Wrong(Driver):
        tries: int = key("three")

    assert read_keys(Right, {})["limits"] == (0.0, 1.0)
    for config in ({}, {"tries": 3}):
        with pytest.raises(ValueError, match=r"tries: .* found the default 'three' of its `key`"):
            read_keys(Wrong, config)


def test_an_optional_key_has_the_type_of_its_values() -> None:
    class Optionally(Driver):
        port: str | None = key(None)
        rate: list[int] | None = key(None)
        either: list[int] | str = key(None)

    for name, word in (("port", "a text"), ("rate", "a list")):
        with pytest.raises(ValueError, match=f"{name}: expected {word}, found 7"):
            read_keys(Optionally, {name: 7})
    assert read_keys(Optionally, {"either": "x"})["port"] is None
    for said in (int | None, Optional[int], "int | None", int):  # noqa: UP045
        late = key(None)
        holder = type("Holder", (Driver,), {"__annotations__": {"late": said}})
        late.__set_name__(holder, "late")
        assert late.kind is int


def test_a_key_that_was_not_read_says_why() -> None:
    class Forgets(Driver):
        opening: float = key(0.08)

        def __init__(self, config: Mapping[str, Any], ports: Any) -> None:
            self.width = self.opening

    with pytest.raises(AttributeError, match=r"opening: .* first calls super\(\).__init__\(config"):
        Forgets({}, None)


def without_time(method: Any) -> Any:
    @wraps(method)
    def called(self: Any, *_: Any) -> Any:
        return method(self)

    return called


class Odd(Driver):
    """Its methods are as in `Driver`, in other words."""

    @without_time
    def stop(self) -> None:
        self.halted = True

    @staticmethod
    def step(now: float) -> None:
        """Do nothing."""

    def stopped(self) -> bool:
        return True

    def hold(self, *anything: Any) -> str:
        return "held"


def test_methods_that_a_node_cannot_call_are_named() -> None:
    def faults(**changed: Any) -> list[str]:
        return faults_of_methods(type("Claw", (Driver,), changed))

    assert (
        faults_of_methods(Driver)
        == faults_of_methods(Odd)
        == faults_of_methods(Odd({}, None))
        == []
    )
    assert faults(stopped=property(lambda self: True)) == [
        "`stopped` of Claw is a property, expected a method; remove the decorator"
    ]
    assert faults(state="idle") == [
        "`state` of Claw is 'idle', expected a method; write `def state(self)`, and give this "
        "value another name"
    ]
    (wrong,) = faults(stop=lambda self: None)
    assert "`stop` of Claw (test_device.py:" in wrong
    assert wrong.endswith(
        " takes (self), but is called with (self, now); write `def stop(self, now)`"
    )
    made_later = Odd({}, None)
    made_later.state = {}  # type: ignore[method-assign,assignment]
    assert "`state` of Odd is {}, expected a method" in faults_of_methods(made_later)[0]


def test_a_value_that_hides_a_method_is_refused_when_the_driver_is_made() -> None:
    with pytest.raises(
        DirectoryError, match=r"devices\.it\.driver: `state` of Hides is 'idle', exp"
    ):
        made("Hides")


def test_a_value_in_a_derived_class_is_the_new_default_of_a_key() -> None:
    class Fast(Scanner):
        tries = 5

    class Wrong(Scanner):
        tries = "five"  # type: ignore[assignment]

    assert read_keys(Fast, {"port": "a"})["tries"] == 5
    assert read_keys(Fast, {"port": "a", "tries": 1})["tries"] == 1
    with pytest.raises(ValueError, match="tries: expected a whole number, found 'many'"):
        read_keys(Fast, {"port": "a", "tries": "many"})
    with pytest.raises(ValueError, match=r"tries: .* found the default 'five' of its `key`"):
        read_keys(Wrong, {"port": "a"})
    assert read_keys(Scanner, {"port": "a"})["tries"] == 3


def test_keys_of_ports_are_accepted() -> None:
    assert read_keys(Scanner, {"port": "a", "source": "sim", "bitrate": 1})["port"] == "a"


def test_a_missing_device_is_not_reported_as_a_wrong_key() -> None:
    with pytest.raises(DirectoryError, match=r"cannot open its device.*check that it is connected"):
        made("Broken")


@pytest.mark.parametrize(
    ("value", "wrong"),
    [
        ({"a": 1}, ""),
        ({"a": 1, "b": 2}, ""),
        ({"b": 2}, r"key\.x: is missing \['a'\]; expected \['a'\], optional \['b'\]"),
        ({"a": 1, "c": 3}, r"key\.x: unknown keys \['c'\]"),
        (7, r"key\.x: expected a table with a, found 7"),
    ],
)
def test_a_table_has_the_keys_that_it_needs_and_no_unknown_ones(value: Any, wrong: str) -> None:
    if wrong:
        with pytest.raises(ValueError, match=wrong):
            table(value, "key.x", ("a",), ("b",))
    else:
        assert table(value, "key.x", ("a",), ("b",)) is value
