"""Independent check with the `canopen` package: it controls our drives, and our master controls
drives built with it."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable, Iterator
from functools import partial
from importlib.resources import files
from typing import Any

import can
import pytest

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia402 import (
    DriveCommand,
    DriveFault,
    DriveState,
    ObjectIndex,
    command_of,
    from_units,
)
from petrobot.services.comm.canopen.master import MasterPhase
from petrobot.services.motion.drive_master import DriveMaster, DriveSettings
from petrobot.sim.catching.drives import ArmBus, ratings
from tests.motion.conftest import canopen_network, live_drives
from tests.waiting import PATIENCE_S, wait_for

canopen: Any = importlib.import_module("canopen")  # It has hardly any annotations.
BaseNode402: Any = importlib.import_module("canopen.profiles.p402").BaseNode402
EDS = str(files("petrobot.services.comm.canopen.eds").joinpath("joint_drive.eds"))
INPUTS_EDS = str(files("petrobot.services.comm.canopen.eds").joinpath("digital_inputs.eds"))
PATIENCE = 10.0


@pytest.fixture
def drives(make_plant: Callable[[], Any], table: Any) -> ArmBus:
    return ArmBus(make_plant(), ratings(table))


@pytest.fixture
def network(drives: ArmBus) -> Iterator[Any]:
    done = 0.0

    def step(now: float) -> None:
        nonlocal done
        while done < now:
            drives.step(done, 0.001)
            done += 0.001

    yield from canopen_network(live_drives(drives, step))


def _changed(pdo: Any, before: float) -> bool:
    return bool(pdo.timestamp != before)


def test_the_canopen_package_controls_our_drive(drives: ArmBus, network: Any) -> None:
    node = BaseNode402(1, EDS)
    network.add_node(node)
    # On a busy host threads of this process may wait longer for each other than it expects.
    node.sdo.RESPONSE_TIMEOUT = node.TIMEOUT_CHECK_TPDO = PATIENCE_S
    node.TIMEOUT_SWITCH_STATE_FINAL = node.TIMEOUT_SWITCH_STATE_SINGLE = PATIENCE_S
    assert node.sdo[0x1000].raw == 0x00020192
    assert node.sdo[0x6502].raw == 1 << 7
    node.sdo[0x60C2][1].raw = 10
    node.nmt.state = "PRE-OPERATIONAL"
    node.rpdo[1].clear()
    node.rpdo[1].add_variable(0x6040)
    node.rpdo[1].add_variable(0x607A)
    node.rpdo[1].cob_id, node.rpdo[1].trans_type, node.rpdo[1].enabled = 0x201, 1, True
    node.tpdo[1].clear()
    node.tpdo[1].add_variable(0x6041)
    node.tpdo[1].add_variable(0x6064)
    node.tpdo[1].cob_id, node.tpdo[1].trans_type, node.tpdo[1].enabled = 0x181, 1, True
    node.rpdo.save()
    node.tpdo.save()
    node.setup_402_state_machine(read_pdos=False)
    node.sdo[0x6060].raw = 8
    network.sync.start(0.01)
    node.nmt.state = "OPERATIONAL"
    wait_for(lambda: bool(node.tpdo[1].timestamp), awaited="a TPDO")
    target = node.sdo[0x6064].raw
    node.rpdo[1][0x607A].raw = target
    node.rpdo[1].start(0.01)
    for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"):
        node.state = state
        assert node.state == state
    for step in range(40):
        target += 2000
        node.rpdo[1][0x607A].raw = target
        node.rpdo[1].update()
        seen = node.tpdo[1].timestamp
        wait_for(partial(_changed, node.tpdo[1], seen), awaited=f"a TPDO in step {step}")
    wait_for(lambda: bool(abs(node.tpdo[1][0x6064].raw - target) < 2000), awaited="the set point")
    assert drives.plant.q[0] == pytest.approx(from_units(target), abs=2e-3)
    with pytest.raises(canopen.SdoAbortedError) as refused:
        node.sdo[0x6060].raw = 1
    assert refused.value.code in (0x06090030, 0x08000022)
    drives.trip(0, DriveFault.OVERHEATED)
    wait_for(lambda: bool(node.emcy.log), awaited="an EMCY")
    assert node.emcy.log[0].code == DriveFault.OVERHEATED


class ForeignDrive:
    """A drive whose protocol is the `canopen` package's LocalNode; the state machine is written
    here from the standard."""

    WORDS: dict[DriveState, int] = {  # noqa: RUF012
        DriveState.SWITCH_ON_DISABLED: 0x0250,
        DriveState.READY_TO_SWITCH_ON: 0x0231,
        DriveState.SWITCHED_ON: 0x0233,
        DriveState.OPERATION_ENABLED: 0x1237,
    }
    NEXT: dict[tuple[DriveState, DriveCommand | None], DriveState] = {  # noqa: RUF012
        (DriveState.SWITCH_ON_DISABLED, DriveCommand.SHUTDOWN): DriveState.READY_TO_SWITCH_ON,
        (DriveState.READY_TO_SWITCH_ON, DriveCommand.SWITCH_ON): DriveState.SWITCHED_ON,
        (DriveState.SWITCHED_ON, DriveCommand.ENABLE_OPERATION): DriveState.OPERATION_ENABLED,
        (DriveState.OPERATION_ENABLED, DriveCommand.DISABLE_VOLTAGE): DriveState.SWITCH_ON_DISABLED,
    }

    def __init__(self, network: Any, number: int) -> None:
        self.node = network.create_node(number, EDS)
        self.state = DriveState.SWITCH_ON_DISABLED
        self.position = 1000 * number
        self.node.sdo[0x607F].raw = 2_000_000
        network.subscribe(0x200 + number, self._received)
        network.subscribe(0x080, self._sync)
        self.node.nmt.send_command(0)
        self._target = self.position
        self.syncs = 0
        """How many SYNCs it has answered."""

    def _received(self, cob_id: int, data: bytearray, timestamp: float) -> None:
        command = command_of(data[0] | data[1] << 8)
        self.state = self.NEXT.get((self.state, command), self.state)
        self._target = int.from_bytes(data[2:6], "little", signed=True)

    def _sync(self, cob_id: int, data: bytearray, timestamp: float) -> None:
        self._answer()
        self.syncs += 1

    def _answer(self) -> None:
        if self.node.nmt.state != "OPERATIONAL" or self.node.sdo[0x1800][1].raw & 0x80000000:
            return
        if self.state is DriveState.OPERATION_ENABLED:
            self.position = self._target
        sent = (
            self.WORDS[self.state].to_bytes(2, "little")
            + self.position.to_bytes(4, "little", signed=True)
            + bytes(2)
        )
        self.node.network.send_message(self.node.sdo[0x1800][1].raw & 0x7FF, sent)


def test_our_master_runs_drives_of_the_canopen_package() -> None:
    channel = "test_our_master_runs_foreign_drives"
    network = canopen.Network()
    network.connect(interface="virtual", channel=channel)
    bus = can.Bus(interface="virtual", channel=channel)
    drives = [ForeignDrive(network, number) for number in range(1, 7)]
    network.create_node(7, INPUTS_EDS)
    master = DriveMaster([DriveSettings(-3.0, 3.0, 10.0)] * 6, 0.004)
    targets = [0.001 * number for number in range(1, 7)]
    pause = threading.Event()
    try:
        moved, now, syncs = 0, 0.0, 0
        while moved < 50:
            now += 0.004  # Never faster than the wall clock, which the foreign nodes use.
            assert now < PATIENCE, (
                master.phase,
                master.troubles,
                [drive.state for drive in master.drives],
            )
            while (message := bus.recv(timeout=0.0)) is not None:
                master.receive(now, Frame(message.arbitration_id, bytes(message.data)))
            if master.enabled:
                moved += 1
                targets = [target + 0.001 for target in targets]
            elif master.phase is MasterPhase.RUNNING:
                targets = master.positions
            for frame in master.advance(now, targets):
                bus.send(
                    can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False)
                )
                syncs += frame.id == 0x080
            # The foreign nodes live in a thread, which a busy host may let wait for some cycles.
            wait_for(
                partial(lambda sent: all(drive.syncs == sent for drive in drives), syncs),
                awaited="the drives",
            )
            pause.wait(0.004)
        assert not master.troubles
        for drive, target in zip(drives, targets, strict=True):
            assert drive.state is DriveState.OPERATION_ENABLED
            assert from_units(drive.position) == pytest.approx(target, abs=0.0101)
            dictionary = drive.node.sdo
            assert dictionary[0x6060].raw == 8
            assert dictionary[0x1016][1].raw == 0x007F00C8
            assert dictionary[0x1A00][0].raw == 3
            assert dictionary[ObjectIndex.FOLLOWING_ERROR_WINDOW].raw == 100_000
            assert master.drives[0].max_speed == 2.0
            assert drive.node.nmt.state == "OPERATIONAL"
    finally:
        for drive in drives:
            drive.node.nmt.stop_heartbeat()
        network.disconnect()
        bus.shutdown()
