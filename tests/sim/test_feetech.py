"""The simulated Feetech bus: its motion, its protection, and the vendor's SDK as its master."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from petrobot.sim.bus import feetech
from petrobot.sim.bus.feetech import FeetechBus, Servo, so101
from petrobot.sim.bus.lines import PtyLine

STEP = 0.004


def run(servo: Servo, seconds: float) -> None:
    for _ in range(round(seconds / STEP)):
        servo.advance(STEP)


def word(value: int) -> bytes:
    return value.to_bytes(2, "little")


def moving(goal: int, speed: int = 0, acceleration: int = 0) -> Servo:
    """A servo with torque, on its way from 2048."""
    servo = Servo(1)
    servo.write(feetech.TORQUE, bytes((1, acceleration)) + word(goal) + word(0) + word(speed))
    return servo


def test_it_reaches_its_goal_and_says_so() -> None:
    servo = moving(3000, 1000, 50)
    run(servo, 0.5)
    assert servo.read(feetech.MOVING, 1) == b"\1"
    assert 950 < servo.speed < 1010  # at its goal speed
    run(servo, 1.5)
    assert servo.read(feetech.MOVING, 1) == b"\0"
    reported = int.from_bytes(servo.read(feetech.POSITION, 2), "little")
    assert abs(reported - 3000) <= 4  # friction keeps it from the last steps


def test_a_blocked_gripper_pushes_and_then_protects_itself() -> None:
    servo = moving(1000)
    servo.low = 1800.0
    run(servo, 1.5)
    assert servo.position == 1800.0 and servo.duty == -1.0 and not servo.fault
    assert servo.torque == pytest.approx(-feetech.STALL_TORQUE)
    load = int.from_bytes(servo.read(feetech.LOAD, 2), "little")
    assert load == 1 << 10 | 1000  # the sign of the load is bit 10
    run(servo, 2.5)
    assert servo.fault == feetech.OVERLOAD and servo.duty == -0.2
    servo.write(feetech.GOAL, word(2500))  # away from what blocks it
    run(servo, 1.0)
    assert not servo.fault and abs(servo.position - 2500) <= 4


@pytest.mark.parametrize(("load", "sags"), [(-0.3, True), (0.3, True), (0.0, False)])
def test_a_load_bends_it_and_torque_off_lets_it_fall(load: float, sags: bool) -> None:
    servo = moving(2048)
    servo.external = load
    run(servo, 1.0)
    assert (abs(servo.position - 2048) > 20) == sags and abs(servo.position - 2048) < 60
    servo.write(feetech.TORQUE, b"\0")
    run(servo, 1.0)
    assert (abs(servo.position - 2048) > 500) == sags


def test_heat_ends_its_torque() -> None:
    servo = moving(2048)
    servo.heat = 80.0
    run(servo, 0.1)
    assert servo.fault & feetech.HEAT_BAD and servo.read(feetech.TORQUE, 1) == b"\0"


def test_the_offset_moves_what_it_reports() -> None:
    servo = Servo(1, position=2500.0)
    servo.write(feetech.TORQUE, bytes((feetech.CENTRE,)))
    assert servo.read(feetech.POSITION, 2) == word(2048) and servo.position == 2500.0
    servo.write(feetech.TORQUE, b"\1")
    run(servo, 0.5)
    assert abs(servo.position - 2500.0) < 1.0  # the goal moved with it


class Peer:
    """The vendor's SDK on a simulated SO-101 behind a pseudo terminal."""

    def __init__(self, path: Path) -> None:
        sdk = pytest.importorskip("scservo_sdk")
        self.sdk: Any = sdk
        self.bus = so101()
        self.line = PtyLine(path, self.bus.receive)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()
        self.port = sdk.PortHandler(str(path))
        self.packets = sdk.PacketHandler(0)
        assert self.port.openPort() and self.port.setBaudRate(1_000_000)

    def _serve(self) -> None:
        while not self._over.is_set():
            self.line.poll(0.01)

    def close(self) -> None:
        self.port.closePort()
        self._over.set()
        self._thread.join()
        self.line.close()


@pytest.fixture
def peer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Peer]:
    sdk = pytest.importorskip("scservo_sdk")
    # It waits 34 ms for an answer; on a busy host the simulated bus may need longer to be woken.
    monkeypatch.setattr(sdk.port_handler, "LATENCY_TIMER", 1000)
    peer = Peer(tmp_path / "so101")
    yield peer
    peer.close()


def test_the_vendors_sdk_reads_and_writes(peer: Peer) -> None:
    packets, port = peer.packets, peer.port
    assert packets.ping(port, 6) == (777, 0, 0)
    assert packets.write1ByteTxRx(port, 6, feetech.ACCELERATION, 30) == (0, 0)
    assert packets.read1ByteTxRx(port, 6, feetech.ACCELERATION) == (30, 0, 0)
    assert packets.write2ByteTxRx(port, 6, feetech.POSITION, 5) == (0, 0)  # cannot be written
    assert packets.read2ByteTxRx(port, 6, feetech.POSITION) == (2048, 0, 0)
    peer.bus.servos[6].fault = feetech.OVERLOAD
    assert packets.ping(port, 6) == (777, 0, peer.sdk.ERRBIT_OVERLOAD)
    assert packets.ping(port, 7)[1] == peer.sdk.COMM_RX_TIMEOUT


def test_the_vendors_sdk_moves_all_servos_at_once(peer: Peer) -> None:
    write = peer.sdk.GroupSyncWrite(peer.port, peer.packets, feetech.GOAL, 2)
    read = peer.sdk.GroupSyncRead(peer.port, peer.packets, feetech.POSITION, 2)
    for number, servo in peer.bus.servos.items():
        servo.write(feetech.TORQUE, b"\1")
        assert write.addParam(number, word(2000 + 10 * number)) and read.addParam(number)
    assert write.txPacket() == 0
    assert read.txRxPacket() == 0  # the write has been handled before the read is answered
    peer.bus.advance(0.0)
    for servo in peer.bus.servos.values():
        run(servo, 1.0)
    assert read.txRxPacket() == 0
    for number in peer.bus.servos:
        assert abs(read.getData(number, feetech.POSITION, 2) - 2000 - 10 * number) <= 4


@pytest.mark.parametrize(
    ("spoilt", "answers"),
    [
        (b"\xff\xff\x01\x02\x01\xfb", 1),  # a ping
        (b"\x00\xff\xff\xff\x01\x02\x01\xfb", 1),  # after noise
        (b"\xff\xff\x01\x02\x01\xfa", 0),  # wrong checksum
        (b"\xff\xff\x09\x02\x01\xf3", 0),  # another servo
        (b"\xff\xff\x01\x02\x01\xfa\xff\xff\x01\x02\x01\xfb", 1),
    ],
)
def test_noise_is_not_answered(spoilt: bytes, answers: int) -> None:
    bus = so101()
    out = b"".join(bus.receive(bytes((byte,))) for byte in spoilt)
    assert out == b"\xff\xff\x01\x02\x00\xfc" * answers


@pytest.mark.parametrize(("chained", "heard"), [(False, [1, 3]), (True, [1])])
def test_a_missing_servo_in_a_sync_read(chained: bool, heard: list[int]) -> None:
    bus = FeetechBus((Servo(n) for n in (1, 2, 3)), chained=chained)
    bus.servos[2].connected = False
    ask = bytes((0xFE, 7, 0x82, 56, 2, 1, 2, 3))
    out = bus.receive(b"\xff\xff" + ask + bytes((~sum(ask) & 0xFF,)))
    assert [out[at + 2] for at in range(0, len(out), 8)] == heard
