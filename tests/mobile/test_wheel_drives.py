"""The rover's bus master on the simulated bus: what stops the wheels, what is only reported, and
what a reset mends."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import EMCY_BASE, HEARTBEAT_BASE, TPDO1_BASE, emergency
from petrobot.services.comm.canopen.cia402 import DriveCommand, DriveFault, DriveState
from petrobot.services.comm.canopen.master import MasterPhase, Power
from petrobot.services.mobile.wheel_drives import SILENT_CYCLES, WheelMaster
from tests.mobile.conftest import DrawnFloor, DrawnPose
from tests.mobile.yard import Yard

CYCLE = 0.02
LEFT, RIGHT, SENSOR = 1, 2, 3


class WheelBench:
    """A master on a rover's bus; `passes` decides which frames of the nodes are delivered."""

    def __init__(self, quick_stop: float = 30.0) -> None:
        self.yard = Yard(DrawnFloor("SS"), DrawnPose(0.0, 0.0, 0.0))
        self.master = WheelMaster(LEFT, RIGHT, SENSOR, CYCLE, quick_stop)
        self.passes: Callable[[Frame], bool] = lambda frame: True
        self.now = 0.0

    def run(self, seconds: float, speed: float = 0.0) -> None:
        """Cycles of the bus."""
        bus = self.yard.bus
        for _ in range(round(seconds / CYCLE)):
            self.now += CYCLE
            bus.now = self.now
            for frame in self.master.advance(self.now, (speed, speed)):
                bus.send(frame)
            bus.bus.step(self.now)
            for frame in bus.receive():
                if self.passes(frame):
                    self.master.receive(self.now, frame)

    def enabled(self) -> WheelBench:
        """Configured and enabled."""
        self.run(1.0)
        self.master.reset(self.now)
        self.run(1.0)
        assert self.master.enabled and not self.master.troubles
        return self


def without(node: int, *bases: int) -> Callable[[Frame], bool]:
    """Return a filter that drops a node's frames of these kinds."""
    return lambda frame: frame.id not in {base + node for base in bases}


def test_a_sensor_that_never_answers_does_not_prevent_driving() -> None:
    bench = WheelBench()
    bench.passes = lambda frame: frame.id & 0x7F != SENSOR
    bench.enabled()
    assert not bench.master.sensor_alive
    bench.passes = lambda frame: True
    bench.run(0.2)
    assert bench.master.sensor_alive


def test_a_drive_that_never_answers_is_named_and_tried_again() -> None:
    bench = WheelBench()
    bench.passes = lambda frame: frame.id & 0x7F != RIGHT
    bench.run(2.5)
    assert bench.master.phase is MasterPhase.CONFIGURING
    assert [trouble.cause for trouble in bench.master.troubles] == ["bus"]
    assert "node 2" in bench.master.troubles[0].text
    bench.passes = lambda frame: True
    bench.run(2.0)
    bench.enabled()


@pytest.mark.parametrize(
    ("base", "text"),
    [
        (TPDO1_BASE, "right wheel: the drive is silent"),
        (HEARTBEAT_BASE, "node 2 is not operational"),
    ],
)
def test_silence_of_one_drive_stops_both(base: int, text: str) -> None:
    bench = WheelBench().enabled()
    bench.run(0.5, 3.0)
    bench.passes = without(RIGHT, base)
    bench.run(SILENT_CYCLES * CYCLE + 0.3, 3.0)
    assert [(t.cause, bench.master.wheel(t), t.text) for t in bench.master.troubles] == [
        ("bus", "right wheel", text)
    ]
    bench.run(1.0, 3.0)
    assert not bench.master.wanted and bench.yard.body.standing
    bench.passes = lambda frame: True
    bench.enabled()


def test_an_emergency_is_reported_with_its_wheel_and_its_code() -> None:
    bench = WheelBench().enabled()
    bench.master.receive(bench.now, emergency(LEFT, DriveFault.OVERCURRENT, 0x03))
    (trouble,) = bench.master.troubles
    assert (trouble.cause, trouble.axis, trouble.code) == ("drive_fault", 0, DriveFault.OVERCURRENT)
    assert bench.master.wheel(trouble) == "left wheel"
    bench.master.receive(bench.now, Frame(EMCY_BASE + LEFT, b"\0"))
    bench.master.receive(bench.now, Frame(TPDO1_BASE + LEFT, b"\0"))
    assert len(bench.master.troubles) == 1, "malformed frames belong to no wheel"


def test_a_restarted_drive_is_a_trouble_and_a_restarted_sensor_is_not() -> None:
    bench = WheelBench().enabled()
    bench.run(0.2)
    bench.master.receive(bench.now, Frame(HEARTBEAT_BASE + SENSOR, b"\0"))
    told = [trouble.text for trouble in bench.master.troubles]
    bench.master.receive(bench.now, Frame(HEARTBEAT_BASE + LEFT, b"\0"))
    assert (told, [trouble.text for trouble in bench.master.troubles]) == (
        [],
        ["node 1 has restarted"],
    )


def test_a_drive_that_never_says_that_it_is_operational_stops_both() -> None:
    """Some drives send boot-up messages until they have handled the start."""
    bench = WheelBench().enabled()
    bench.passes = without(LEFT, HEARTBEAT_BASE)
    bench.master.reset(bench.now)
    bench.master.bus_lost(bench.now, "unplugged")
    for _ in range(1000):
        if bench.master.phase is MasterPhase.CONFIGURING:
            bench.run(CYCLE)
    assert bench.master.phase is not MasterPhase.CONFIGURING
    bench.master.troubles.clear()
    for _ in range(5):
        bench.master.receive(bench.now, Frame(HEARTBEAT_BASE + LEFT, b"\0"))
        bench.run(0.05)
    early = [trouble.text for trouble in bench.master.troubles]
    bench.run(0.3)
    assert (early, [trouble.text for trouble in bench.master.troubles]) == (
        [],
        ["node 1 is not operational"],
    )


def test_power_brakes_first_and_resets_a_fault_only_now_and_then() -> None:
    power = Power(reset_cycles=5, stop_cycles=3)
    words = [power.word(DriveState.OPERATION_ENABLED, False, False) for _ in range(5)]
    assert words == [DriveCommand.QUICK_STOP.word] * 3 + [DriveCommand.DISABLE_VOLTAGE.word] * 2
    resets = [
        power.word(DriveState.FAULT, True, True) == DriveCommand.FAULT_RESET.word for _ in range(10)
    ]
    assert resets == [True, False, False, False, False] * 2
    assert power.word(DriveState.FAULT, True, False) == DriveCommand.DISABLE_VOLTAGE.word
