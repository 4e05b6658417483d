"""The wheel drives in cyclic synchronous velocity mode and the sensor on the bus, as a master sees
them."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterator
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import (
    DataType,
    NmtState as Network,
    heartbeat,
    sdo_write_request,
)
from petrobot.services.comm.canopen.cia402 import (
    DriveFault,
    DriveState,
    ObjectIndex,
    OperationMode,
    StatusBit,
    from_units,
    state_of,
)
from petrobot.sim.track.drives import Echo, ReflectorSensor, RoverBus
from petrobot.sim.track.rover import RoverBody
from petrobot.sim.track.truth import TrackSite
from tests.motion.conftest import canopen_network, live_drives
from tests.waiting import wait_for

canopen: Any = importlib.import_module("canopen")  # it has no annotations worth the name
BaseNode402: Any = importlib.import_module("canopen.profiles.p402").BaseNode402
DRIVE_EDS = str(files("petrobot.services.comm.canopen.eds").joinpath("wheel_drive.eds"))
SENSOR_EDS = str(files("petrobot.services.comm.canopen.eds").joinpath("reflector_sensor.eds"))
U16, U32, I32 = DataType.UNSIGNED16, DataType.UNSIGNED32, DataType.INTEGER32

Bench = Callable[..., Any]


def write(bench: Any, node: int, index: int, value: bytes) -> None:
    """Write an object over SDO and let it be answered."""
    bench.post("can", "rover", (sdo_write_request(node, index, 0, value),))
    bench.wait(0.008)


# Set points


def test_wheels_follow_their_set_points_within_slope_and_lag(rover_bench: Bench) -> None:
    bench = rover_bench(regime="plain")
    bench.enable()
    bench.drive(0.5, 0.0)
    speeds = []
    for _ in range(40):
        bench.wait(0.02)
        speeds.append(bench.lab.rover.wheels[0].speed)
    rises = np.diff([0.0, *speeds]) / 0.02
    assert rises.max() <= 20.0 + 1e-6  # the drives' acceleration
    assert speeds[-1] == pytest.approx(5.0, abs=0.01)
    assert from_units(bench.read(1, ObjectIndex.VELOCITY, I32)) == pytest.approx(5.0, abs=0.02)
    assert not bench.master.status[0] & StatusBit.INTERNAL_LIMIT
    assert bench.master.status[0] & StatusBit.FOLLOWS_COMMAND


def test_positions_are_counted_by_the_encoder(rover_bench: Bench) -> None:
    bench = rover_bench(regime="plain")
    bench.enable()
    before = list(bench.master.positions)
    bench.drive(0.3, 0.4)
    bench.wait(2.0)
    bench.drive(0.0, 0.0)
    bench.wait(1.0)
    unit = 2.0 * math.pi / 20_000
    for side in (0, 1):
        turned = from_units(bench.master.positions[side] - before[side])
        assert turned == pytest.approx(bench.lab.rover.wheels[side].angle, abs=1.1 * unit)
        assert bench.master.positions[side] / 1e6 / unit == pytest.approx(
            round(bench.master.positions[side] / 1e6 / unit), abs=0.01
        )


def test_positions_wrap_at_32_bits(rover_bench: Bench) -> None:
    bench = rover_bench(regime="plain")
    bench.enable()
    wheel = bench.lab.rover.wheels[0]
    wheel.angle = 2147.0
    bench.drive(0.5, 0.0)
    bench.wait(1.0)
    assert wheel.angle > 2148.0
    assert bench.master.positions[0] == pytest.approx(wheel.angle * 1e6 - 2**32, abs=2e5)


def test_a_set_point_beyond_the_battery_is_cut_and_reported(rover_bench: Bench) -> None:
    bench = rover_bench(regime="plain+sag")
    bench.enable()
    bench.drive(1.2, 0.0)
    bench.wait(2.0)
    most = from_units(bench.read(1, ObjectIndex.MAX_SPEED, U32))
    assert most == pytest.approx(bench.lab.rover.top_speed, rel=1e-3)
    assert most < 10.5
    assert bench.lab.rover.wheels[0].speed == pytest.approx(most, rel=0.02)
    assert bench.master.status[0] & StatusBit.INTERNAL_LIMIT
    volts = bench.read(2, ObjectIndex.DC_LINK_VOLTAGE, U32) / 1e3
    assert volts == pytest.approx(bench.lab.rover.voltage, abs=0.05)
    bench.wait(20.0)
    assert bench.read(2, ObjectIndex.DC_LINK_VOLTAGE, U32) / 1e3 < volts - 0.5


# State machine


def test_a_silent_master_stops_the_rover(rover_bench: Bench) -> None:
    bench = rover_bench(regime="plain")
    bench.enable()
    bench.drive(0.5, 0.0)
    bench.wait(1.0)
    bench.cut = True
    before = bench.lab.rover.pose
    bench.wait(1.0)
    assert bench.lab.rover.standing
    way = math.hypot(bench.lab.rover.x - before.x, bench.lab.rover.y - before.y)
    assert 0.04 < way < 0.15  # 0.1 s of patience, then the ramp
    assert (1, DriveFault.SYNC_LOST) in bench.master.emergencies
    assert (2, DriveFault.SYNC_LOST) in bench.master.emergencies
    bench.cut = False
    assert bench.run(lambda: bench.master.enabled, 1.0)  # the bench's master resets faults
    bench.wait(1.0)
    assert bench.lab.rover.speed == pytest.approx(0.5, abs=0.02)


def test_a_lost_heartbeat_stops_a_drive_that_watches_it(rover_bench: Bench) -> None:
    bench = rover_bench(regime="plain")
    bench.enable()
    beat = U32.pack(0x7F << 16 | 100)
    bench.post(
        "can",
        "rover",
        (Frame(0x601, b"\x23\x16\x10\x01" + beat), heartbeat(0x7F, Network.OPERATIONAL)),
    )
    bench.wait(0.3)
    assert (1, DriveFault.HEARTBEAT) in bench.master.emergencies
    assert not any(node == 2 for node, _ in bench.master.emergencies)


def test_taking_the_power_away_lets_the_brakes_fall_in(rover_bench: Bench) -> None:
    bench = rover_bench(regime="plain")
    bench.enable()
    bench.drive(0.5, 0.0)
    bench.wait(1.0)
    bench.master.enable = False
    bench.wait(0.3)
    assert bench.lab.rover.standing
    assert state_of(bench.master.status[0]) is DriveState.SWITCH_ON_DISABLED
    assert all(wheel.braked for wheel in bench.lab.rover.wheels)


def test_leaving_operational_while_enabled_stops_the_motion(rover_bench: Bench) -> None:
    bench = rover_bench(regime="plain")
    bench.enable()
    bench.drive(0.5, 0.0)
    bench.wait(1.0)
    bench.post("can", "rover", (Frame(0x000, b"\x80\x00"),))
    bench.wait(0.6)
    assert bench.lab.rover.standing


@pytest.mark.parametrize(
    ("index", "value", "accepted"),
    [
        (
            ObjectIndex.MODE,
            DataType.INTEGER8.pack(OperationMode.CYCLIC_SYNCHRONOUS_POSITION),
            False,
        ),
        (ObjectIndex.MODE, DataType.INTEGER8.pack(1), False),
        (ObjectIndex.QUICK_STOP_DECELERATION, U32.pack(10_000_000), True),
        (ObjectIndex.MAX_SPEED, U32.pack(1), False),
    ],
)
def test_what_may_be_written(rover_bench: Bench, index: int, value: bytes, accepted: bool) -> None:
    bench = rover_bench(regime="plain")
    bench.cut = True
    before = dict(bench.lab.bus.drives[0].values)
    write(bench, 1, index, value)
    after = bench.lab.bus.drives[0].values[index, 0]
    assert (after != before[index, 0]) is accepted


# The sensor


def test_the_sensor_sends_echoes_every_40_ms(rover_bench: Bench) -> None:
    bench = rover_bench(regime="straight", seed=3)
    bench.wait(0.5)
    bench.master.echoes.clear()
    bench.wait(4.0)
    assert len(bench.master.echoes) == 100


def test_a_tpdo_carries_the_two_nearest_echoes() -> None:
    seen = [Echo(-0.5, 1.234), Echo(1.0, 4.5), Echo(0.1, 5.5)]
    sensor = ReflectorSensor(lambda now: seen)
    sensor.boot(0.0)
    sensor.receive(0.0, sdo_write_request(3, 0x1800, 1, U32.pack(0x183)))
    sensor.receive(0.0, Frame(0x000, b"\x01\x03"))
    sensor.drain()
    sensor.advance(0.04)
    (frame,) = [frame for frame in sensor.drain() if frame.id == 0x183]
    assert np.frombuffer(frame.data, "<i2").tolist() == [-5000, 1234, 10_000, 4500]
    seen.clear()
    sensor.advance(0.08)
    (frame,) = [frame for frame in sensor.drain() if frame.id == 0x183]
    assert frame.data == bytes(8)


# Another master


@pytest.fixture
def rover_bus(track_site: TrackSite) -> RoverBus:
    body = RoverBody(track_site.truth("plain").rover, np.random.default_rng(1))
    return RoverBus(body, ReflectorSensor(lambda now: [Echo(0.25, 2.0)]))


@pytest.fixture
def network(rover_bus: RoverBus) -> Iterator[Any]:
    yield from canopen_network(live_drives(rover_bus, rover_bus.step))


def _configured(network: Any, number: int) -> Any:
    node = BaseNode402(number, DRIVE_EDS)
    network.add_node(node)
    node.sdo.RESPONSE_TIMEOUT = 2.0
    node.nmt.state = "PRE-OPERATIONAL"
    for pdo, variables, cob_id in (
        (node.rpdo[1], (0x6040, 0x60FF), 0x200 + number),
        (node.tpdo[1], (0x6041, 0x606C), 0x180 + number),
    ):
        pdo.clear()
        for variable in variables:
            pdo.add_variable(variable)
        pdo.cob_id, pdo.trans_type, pdo.enabled = cob_id, 1, True
    node.rpdo.save()
    node.tpdo.save()
    node.setup_402_state_machine(read_pdos=False)
    node.sdo[0x6060].raw = 9
    return node


def test_the_canopen_package_masters_our_wheel_drive(rover_bus: RoverBus, network: Any) -> None:
    node = _configured(network, 2)
    assert node.sdo[0x1000].raw == 0x00020192
    assert node.sdo[0x6502].raw == 1 << 8
    assert node.sdo[0x6061].raw == 9
    network.sync.start(0.02)
    node.nmt.state = "OPERATIONAL"
    wait_for(lambda: bool(node.tpdo[1].timestamp), awaited="a TPDO")
    node.rpdo[1][0x60FF].raw = 0
    node.rpdo[1].start(0.02)
    for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"):
        node.state = state
        assert node.state == state
    node.rpdo[1][0x60FF].raw = 3_000_000
    node.rpdo[1].update()
    wait_for(
        lambda: abs(rover_bus.rover.wheels[1].speed - 3.0) < 0.05, awaited="the commanded speed"
    )
    wait_for(
        lambda: abs(node.tpdo[1][0x606C].raw - 3_000_000) < 400_000,
        awaited="the reported speed",
    )
    assert rover_bus.rover.wheels[0].speed == 0.0
    with pytest.raises(canopen.SdoAbortedError) as refused:
        node.sdo[0x6060].raw = 8
    assert refused.value.code in (0x06090030, 0x08000022)
    assert 20_000 < node.sdo[0x6079].raw < 26_000
    rover_bus.trip(1, DriveFault.OVERHEATED)
    wait_for(lambda: bool(node.emcy.log), awaited="an EMCY")
    assert node.emcy.log[0].code == DriveFault.OVERHEATED
    wait_for(lambda: rover_bus.rover.wheels[1].braked, awaited="the brake")


def test_the_canopen_package_reads_our_sensor(rover_bus: RoverBus, network: Any) -> None:
    node = canopen.RemoteNode(3, SENSOR_EDS)
    network.add_node(node)
    node.sdo.RESPONSE_TIMEOUT = 2.0
    node.tpdo.read()
    node.tpdo[1].cob_id, node.tpdo[1].enabled = 0x183, True
    node.tpdo.save()
    node.nmt.state = "OPERATIONAL"
    wait_for(lambda: bool(node.tpdo[1].timestamp), awaited="a TPDO")
    assert [variable.raw for variable in node.tpdo[1]] == [2500, 2000, 0, 0]
