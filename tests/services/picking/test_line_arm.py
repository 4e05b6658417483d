"""The line protocol's driver keeps the rules of drivers, with the laboratory's controller behind
it."""

from __future__ import annotations

from typing import Any, cast

import pytest

from petrobot import Ports, SerialLine, check_driver
from petrobot.services.picking.line_arm import LineArm
from petrobot.sim.picking.controllers import LineController
from tests.sim.picking.bench import site

REST = site("ur5e").numbers["poses"]["rest"]
TURNED = [REST[0] + 0.3, *REST[1:]]


class Bench(SerialLine):
    """Ports of the driver, and its line to a simulated controller whose time passes by `now`."""

    def __init__(self) -> None:
        self.controller = LineController(site("ur5e").numbers)
        self.now, self.arrived, self.plugged = 0.0, b"", True

    def serial(self, port: str, baud: int) -> SerialLine:
        self._check()
        return self

    def send(self, data: bytes) -> None:
        self._check()
        self.arrived += self.controller.receive(self.now, data)

    def receive(self) -> bytes:
        self._check()
        arrived, self.arrived = self.arrived, b""
        return arrived

    def close(self) -> None:
        self.arrived = b""

    def cable(self, plugged: bool) -> None:
        """Pull the cable, or put it back."""
        self.plugged = plugged

    def _check(self) -> None:
        if not self.plugged:
            raise ConnectionError("the cable is pulled")


class BenchArm(LineArm):
    """The driver, whose controller moves between its steps."""

    def step(self, now: float) -> None:
        bench = cast(Bench, self.ports)
        bench.now = now
        bench.controller.advance(now, self.period)
        super().step(now)


def made(bench: Bench) -> BenchArm:
    """The driver of a bench."""
    return BenchArm({"port": "/dev/ttyUSB0"}, cast(Ports, bench))


def test_it_keeps_the_rules_of_drivers() -> None:
    bench = Bench()
    there_and_back = [{"q": TURNED}, {"q": REST}]
    report = check_driver(lambda: made(bench), there_and_back, simulated=True, cable=bench.cable)
    assert report.faults == []


@pytest.mark.parametrize(
    ("body", "text"),
    [
        ({"q": [0.0] * 5}, "expected 6 joint angles"),
        ({"q": [float("nan")] * 6}, "expected 6 joint angles"),
        ({"grip": "wide"}, "grip: expected m"),
        ({"dance": 1}, "unknown command"),
        ({}, "unknown command"),
    ],
)
def test_what_it_cannot_do_is_refused(body: dict[str, Any], text: str) -> None:
    arm = made(Bench())
    for k in range(5):
        arm.step(k * 0.02)
    with pytest.raises(ValueError, match=text):
        arm.command(0.1, body)


def test_noise_on_the_line_is_dropped_and_a_lost_controller_is_a_fault() -> None:
    bench = Bench()
    arm = made(bench)
    assert arm.state()["fault"]
    for k in range(10):
        bench.arrived += b"\xff{not json\n"
        arm.step(k * 0.02)
    assert arm.state()["fault"] == "" and arm.state()["q"] == pytest.approx(REST)
    bench.cable(False)
    for k in range(10, 30):
        arm.step(k * 0.02)
    assert arm.state()["fault"] and not arm.stopped()
