"""The simulated drives and inputs as seen from the bus: object dictionary, state machine, watchdogs
in simulated time."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from petrobot.services.comm.canopen import cia301 as canopen
from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import (
    AbortCode,
    DataType,
    NmtCommand,
    NmtState,
    SdoAbortError,
    SdoClient,
    Transfer,
)
from petrobot.services.comm.canopen.cia402 import (
    RECEIVED,
    SENT,
    DriveCommand,
    DriveFault,
    DriveState,
    ObjectIndex,
    from_units,
    state_of,
    to_units,
)
from petrobot.services.motion.drive_master import DriveSettings, JointDriveLink
from petrobot.sim.catching.drives import ArmBus, ratings
from tests.waiting import Limit

TPDO, RPDO = canopen.pdo_struct(SENT), canopen.pdo_struct(RECEIVED)
CYCLE = 0.004


class ArmDriveBench:
    """Six drives on a bench; the test is the master of the first one."""

    def __init__(self, plant: Any, table: Any) -> None:
        self.plant = plant
        self.bus = ArmBus(plant, ratings(table))
        self.now = 0.0
        self.frames: list[Frame] = []
        self.target = plant.q[0]
        self.beats = True
        self.step()

    def step(self, cycles: int = 1) -> None:
        for _ in range(cycles):
            for part in range(4):
                self.bus.step(self.now + 0.001 * part, 0.001)
            self.frames += self.bus.drain()
            self.now += CYCLE

    def send(self, frame: Frame) -> None:
        self.bus.receive(self.now, frame)

    def sdo(self, transfer: Transfer, node: int = 1) -> int | None:
        client = SdoClient(node)
        client.begin([transfer])
        for frame in client.advance(self.now):
            self.send(frame)
        for frame in self.bus.drain():
            client.receive(frame)
            self.frames.append(frame)
        if client.failure:
            raise AssertionError(client.failure)
        return client.results.get((transfer.index, transfer.sub))

    def refused(self, frame: Frame) -> int:
        """Return the abort code of the answer to an SDO request."""
        self.send(frame)
        (answer,) = [reply for reply in self.bus.drain() if reply.id > canopen.SDO_REPLY_BASE]
        assert answer.data[0] == 0x80
        return int.from_bytes(answer.data[4:], "little")

    def configure(self) -> None:
        link = JointDriveLink(1, DriveSettings(-2.7, 2.7, 13.0))
        for transfer in link.transfers(CYCLE):
            self.sdo(transfer)
        self.send(canopen.nmt(NmtCommand.START))

    def cycle(self, word: int, cycles: int = 1) -> None:
        """Run cycles with a controlword, the current target, SYNC and the master's heartbeat."""
        for _ in range(cycles):
            if self.beats:
                self.send(canopen.heartbeat(0x7F, NmtState.OPERATIONAL))
            self.send(Frame(0x201, RPDO.pack(word, to_units(self.target))))
            self.send(canopen.SYNC)
            self.step()

    def enable(self) -> None:
        self.configure()
        for command in (
            DriveCommand.SHUTDOWN,
            DriveCommand.SWITCH_ON,
            DriveCommand.ENABLE_OPERATION,
        ):
            self.cycle(command.word)
        self.cycle(DriveCommand.ENABLE_OPERATION.word)
        assert self.state() is DriveState.OPERATION_ENABLED

    def status(self) -> tuple[int, float, int]:
        word, position, torque = TPDO.unpack(
            [frame for frame in self.frames if frame.id == 0x181][-1].data
        )
        return word, from_units(position), torque

    def state(self) -> DriveState:
        return state_of(self.status()[0])

    def emergencies(self) -> list[int]:
        return [
            canopen.parse_emergency(frame).code for frame in self.frames if 0x81 <= frame.id <= 0xFF
        ]


@pytest.fixture
def bench(make_plant: Callable[[], Any], table: Any) -> ArmDriveBench:
    return ArmDriveBench(make_plant(), table)


def test_boot_up_of_every_node(bench: ArmDriveBench) -> None:
    assert {frame.id for frame in bench.frames if frame.data == b"\x00"} == set(range(0x701, 0x708))


def test_no_process_data_before_the_node_is_started(bench: ArmDriveBench) -> None:
    bench.cycle(DriveCommand.SHUTDOWN.word, 3)
    assert not [frame for frame in bench.frames if frame.id == 0x181]


def test_enabling_passes_the_states_one_by_one(bench: ArmDriveBench) -> None:
    bench.configure()
    seen = []
    for command in (
        DriveCommand.SHUTDOWN,
        DriveCommand.SWITCH_ON,
        DriveCommand.ENABLE_OPERATION,
        DriveCommand.ENABLE_OPERATION,
    ):
        bench.cycle(command.word)
        seen.append(bench.state())
    assert seen == [
        DriveState.READY_TO_SWITCH_ON,
        DriveState.SWITCHED_ON,
        DriveState.OPERATION_ENABLED,
        DriveState.OPERATION_ENABLED,
    ]
    assert not bench.plant.braked[0]
    assert all(bench.plant.braked[1:])
    bench.cycle(DriveCommand.DISABLE_VOLTAGE.word, 2)
    assert bench.state() is DriveState.SWITCH_ON_DISABLED
    assert bench.plant.braked[0]


def test_a_set_point_is_followed_and_held_against_gravity(bench: ArmDriveBench) -> None:
    bench.enable()
    start = bench.target
    for cycle in range(1, 201):
        bench.target = start + 0.3 * (1 - math.cos(math.pi * cycle / 200)) / 2
        bench.cycle(DriveCommand.ENABLE_OPERATION.word)
        assert abs(bench.bus.drives[0].servo.error) < 0.01
    bench.cycle(DriveCommand.ENABLE_OPERATION.word, 100)
    assert bench.status()[1] == pytest.approx(start + 0.3, abs=5e-4)
    assert not bench.emergencies()


@pytest.mark.parametrize(
    ("frame", "code"),
    [
        (canopen.sdo_read_request(1, 0x5FFF, 0), AbortCode.NO_OBJECT),
        (canopen.sdo_read_request(1, 0x1018, 9), AbortCode.NO_SUBINDEX),
        (canopen.sdo_write_request(1, 0x6041, 0, b"\x00\x00"), AbortCode.READ_ONLY),
        (canopen.sdo_write_request(1, 0x1018, 0, b"\x00"), AbortCode.READ_ONLY),
        (canopen.sdo_write_request(1, 0x6040, 0, b"\x00"), AbortCode.TOO_SHORT),
        (canopen.sdo_write_request(1, 0x6040, 0, b"\x00" * 4), AbortCode.TOO_LONG),
        (canopen.sdo_write_request(1, 0x605A, 0, b"\x07\x00"), AbortCode.TOO_HIGH),
        (canopen.sdo_write_request(1, 0x605A, 0, b"\x01\x00"), AbortCode.TOO_LOW),
        (canopen.sdo_write_request(1, 0x6060, 0, b"\x01"), AbortCode.VALUE),
        (
            canopen.sdo_write_request(1, 0x1600, 1, (0x60410010).to_bytes(4, "little")),
            AbortCode.STATE,
        ),
        (
            canopen.sdo_write_request(1, 0x1400, 1, (0x80000080).to_bytes(4, "little")),
            AbortCode.VALUE,
        ),
        (Frame(0x601, bytes.fromhex("21 40 60 00 09 00 00 00")), AbortCode.COMMAND),
        (Frame(0x601, bytes.fromhex("60 40 60 00 00 00 00 00")), AbortCode.COMMAND),
    ],
)
def test_abort_codes(bench: ArmDriveBench, frame: Frame, code: AbortCode) -> None:
    assert bench.refused(frame) == code


@pytest.mark.parametrize(
    ("entry", "code"),
    [
        (0x60410010, AbortCode.NOT_MAPPABLE),  # a drive does not receive its statusword
        (0x60400020, AbortCode.NOT_MAPPABLE),  # wrong length
        (0x10170010, AbortCode.NOT_MAPPABLE),  # no process data
        (0x5FFF0010, AbortCode.NO_OBJECT),
    ],
)
def test_objects_that_cannot_be_mapped_are_refused(
    bench: ArmDriveBench, entry: int, code: AbortCode
) -> None:
    bench.sdo(Transfer(0x1600, 0, DataType.UNSIGNED8, 0))
    assert (
        bench.refused(canopen.sdo_write_request(1, 0x1600, 1, entry.to_bytes(4, "little"))) == code
    )


def test_a_mapping_beyond_eight_bytes_is_refused(bench: ArmDriveBench) -> None:
    bench.sdo(Transfer(0x1A00, 0, DataType.UNSIGNED8, 0))
    for sub in (1, 2, 3):
        bench.sdo(Transfer(0x1A00, sub, DataType.UNSIGNED32, 0x60640020))
    assert bench.refused(canopen.sdo_write_request(1, 0x1A00, 0, b"\x03")) == AbortCode.PDO_LENGTH


def test_an_active_pdo_keeps_its_mapping(bench: ArmDriveBench) -> None:
    bench.configure()
    assert bench.refused(canopen.sdo_write_request(1, 0x1A00, 0, b"\x00")) == AbortCode.STATE


def test_mode_and_limits_cannot_change_while_the_motor_has_torque(bench: ArmDriveBench) -> None:
    bench.enable()
    for index, sub, data in ((0x6060, 0, b"\x00"), (0x607D, 2, bytes(4)), (0x60C2, 1, b"\x08")):
        assert bench.refused(canopen.sdo_write_request(1, index, sub, data)) == AbortCode.STATE


def test_software_limits_cut_the_target(bench: ArmDriveBench) -> None:
    bench.enable()
    start = bench.target
    limit = Limit("the target", steps=1000)
    while bench.target < 3.0 and limit.left():
        bench.target += 0.003
        bench.cycle(DriveCommand.ENABLE_OPERATION.word)
    bench.cycle(DriveCommand.ENABLE_OPERATION.word, 60)
    assert start < 2.6
    assert bench.status()[1] == pytest.approx(2.7, abs=1e-3)


def test_quick_stop_ramps_down_holds_and_can_be_left(bench: ArmDriveBench) -> None:
    bench.enable()
    for _ in range(100):
        bench.target += 0.004
        bench.cycle(DriveCommand.ENABLE_OPERATION.word)
    moving = bench.plant.qd[0]
    bench.cycle(DriveCommand.QUICK_STOP.word)
    assert bench.state() in (DriveState.QUICK_STOP_ACTIVE, DriveState.OPERATION_ENABLED)
    before = bench.plant.q[0]
    bench.cycle(DriveCommand.QUICK_STOP.word, 60)
    assert bench.state() is DriveState.QUICK_STOP_ACTIVE
    assert abs(bench.plant.qd[0]) < 0.01
    assert bench.plant.q[0] - before == pytest.approx(moving**2 / (2 * 13.0), abs=0.02)
    assert not bench.plant.braked[0]
    bench.target = bench.plant.q[0]
    bench.cycle(DriveCommand.ENABLE_OPERATION.word, 2)
    assert bench.state() is DriveState.OPERATION_ENABLED


def test_without_sync_the_drive_stops_by_itself(bench: ArmDriveBench) -> None:
    bench.enable()
    for _ in range(100):
        bench.target += 0.004
        bench.cycle(DriveCommand.ENABLE_OPERATION.word)
    assert bench.plant.qd[0] > 0.5
    silent = bench.now
    limit = Limit("an emergency message of the drive", steps=1000)
    while not bench.emergencies() and limit.left():
        bench.step()
    assert bench.emergencies() == [DriveFault.SYNC_LOST]
    assert 9 * CYCLE <= bench.now - silent <= 11 * CYCLE + 1e-9
    bench.step(60)
    assert bench.plant.braked[0]
    assert bench.plant.qd[0] == 0.0


def test_without_the_masters_heartbeat_the_drive_stops_by_itself(bench: ArmDriveBench) -> None:
    bench.enable()
    bench.beats = False
    silent = bench.now
    limit = Limit("an emergency message of the drive", steps=1000)
    while not bench.emergencies() and limit.left():
        bench.cycle(DriveCommand.ENABLE_OPERATION.word)
    assert bench.emergencies() == [DriveFault.HEARTBEAT]
    assert 0.2 - 2 * CYCLE <= bench.now - silent <= 0.2 + 2 * CYCLE


def test_a_blocked_joint_trips_the_following_error_and_a_reset_clears_it(
    bench: ArmDriveBench,
) -> None:
    bench.enable()
    bench.plant.braked[0] = True
    for _ in range(60):
        bench.target += 0.004
        bench.cycle(DriveCommand.ENABLE_OPERATION.word)
    assert bench.emergencies() == [DriveFault.FOLLOWING_ERROR]
    assert bench.state() is DriveState.FAULT
    assert (
        bench.sdo(Transfer(ObjectIndex.ERROR_CODE, 0, DataType.UNSIGNED16))
        == DriveFault.FOLLOWING_ERROR
    )
    assert bench.sdo(Transfer(ObjectIndex.ERROR_REGISTER, 0, DataType.UNSIGNED8)) == 0x21
    bench.cycle(DriveCommand.FAULT_RESET.word)
    bench.cycle(DriveCommand.DISABLE_VOLTAGE.word)
    assert bench.state() is DriveState.SWITCH_ON_DISABLED
    assert bench.emergencies() == [DriveFault.FOLLOWING_ERROR, DriveFault.NONE]


def test_a_fault_is_reset_on_the_rising_edge_only(bench: ArmDriveBench) -> None:
    bench.configure()
    bench.cycle(DriveCommand.FAULT_RESET.word)
    bench.bus.trip(0, DriveFault.OVERCURRENT)
    bench.cycle(DriveCommand.FAULT_RESET.word, 5)
    assert bench.state() is DriveState.FAULT
    bench.cycle(DriveCommand.DISABLE_VOLTAGE.word)
    bench.cycle(DriveCommand.FAULT_RESET.word, 2)
    assert bench.state() is DriveState.SWITCH_ON_DISABLED


def test_open_power_chain_drops_the_brakes_and_forbids_reset(bench: ArmDriveBench) -> None:
    bench.enable()
    bench.bus.power(False)
    assert bench.plant.braked[0]
    for word in (
        DriveCommand.DISABLE_VOLTAGE.word,
        DriveCommand.FAULT_RESET.word,
        DriveCommand.DISABLE_VOLTAGE.word,
    ):
        bench.cycle(word)
    assert bench.state() is DriveState.FAULT
    assert DriveFault.UNDERVOLTAGE in bench.emergencies()
    bench.bus.power(True)
    for word in (DriveCommand.FAULT_RESET.word, DriveCommand.DISABLE_VOLTAGE.word):
        bench.cycle(word)
    assert bench.state() is DriveState.SWITCH_ON_DISABLED


def test_leaving_operational_while_enabled_stops_the_motion(bench: ArmDriveBench) -> None:
    bench.enable()
    bench.send(canopen.nmt(NmtCommand.ENTER_PREOPERATIONAL, 1))
    assert bench.bus.drives[0].state is DriveState.QUICK_STOP_ACTIVE
    bench.send(canopen.nmt(NmtCommand.STOP, 1))
    bench.frames.clear()
    bench.send(canopen.sdo_read_request(1, 0x1000, 0))
    bench.step()
    assert not [frame for frame in bench.frames if frame.id == 0x581], (
        "a stopped node answers no SDO"
    )


def test_reset_gives_a_boot_up_and_the_defaults_again(bench: ArmDriveBench) -> None:
    bench.enable()
    bench.frames.clear()
    bench.send(canopen.nmt(NmtCommand.RESET_NODE, 1))
    bench.step()
    assert Frame(0x701, b"\x00") in bench.frames
    assert bench.plant.braked[0]
    assert bench.sdo(Transfer(0x1017, 0, DataType.UNSIGNED16)) == 0


def test_slow_drives_report_it_and_limit_targets_that_are_too_fast(bench: ArmDriveBench) -> None:
    bench.enable()
    rated = bench.sdo(Transfer(ObjectIndex.MAX_SPEED, 0, DataType.UNSIGNED32))
    bench.bus.slow_down(0.5)
    assert rated is not None
    assert bench.sdo(Transfer(ObjectIndex.MAX_SPEED, 0, DataType.UNSIGNED32)) == pytest.approx(
        rated / 2, abs=1
    )
    bench.target += 0.0055
    bench.cycle(DriveCommand.ENABLE_OPERATION.word)
    assert bench.status()[0] & 0x0800
    assert bench.plant.factor == 0.5


def test_inputs_are_sent_on_change_and_by_the_timer(bench: ArmDriveBench) -> None:
    cob_id = 0x187
    bench.sdo(Transfer(0x1800, 5, DataType.UNSIGNED16, 100), node=7)
    bench.sdo(Transfer(0x1800, 1, DataType.UNSIGNED32, cob_id), node=7)
    bench.send(canopen.nmt(NmtCommand.START))
    bench.step()
    bench.frames.clear()
    bench.bus.ball(True)
    bench.step()
    assert [frame for frame in bench.frames if frame.id == cob_id] == [Frame(cob_id, b"\x03")]
    bench.step(round(0.2 / CYCLE))
    assert 2 <= len([frame for frame in bench.frames if frame.id == cob_id]) <= 4
    bench.bus.ball(False)
    bench.bus.power(False)
    bench.step()
    assert bench.frames[-1] == Frame(cob_id, b"\x00") or Frame(cob_id, b"\x00") in bench.frames


def test_short_process_data_is_reported_and_not_obeyed(bench: ArmDriveBench) -> None:
    bench.enable()
    bench.send(Frame(0x201, b"\x00\x00"))
    bench.send(canopen.SYNC)
    bench.step()
    assert bench.emergencies() == [0x8210]
    assert bench.bus.drives[0].state is DriveState.OPERATION_ENABLED


def test_abort_errors_name_code_and_object() -> None:
    assert (
        str(SdoAbortError(AbortCode.READ_ONLY, 0x6041, 0))
        == "SDO abort 0x06010002 (read only) at 0x6041:0"
    )
    assert "unknown" in str(SdoAbortError(0x12345678))
