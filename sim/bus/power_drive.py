"""Power state machine of a CiA 402 drive in any mode of operation: commands, faults, quick stop,
loss of master and SYNC (CiA 402-2, state machine of the power drive system)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, Final, Generic, TypeVar

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import SYNC_ID, AbortCode, NmtState, SdoAbortError
from petrobot.services.comm.canopen.cia402 import (
    DriveCommand,
    DriveFault,
    DriveState,
    ObjectIndex,
    OperationMode,
    StatusBit,
    after,
    command_of,
    from_units,
)
from petrobot.sim.bus.canopen_node import CanopenNode

_REGISTERS: Final = {
    DriveFault.OVERCURRENT: 0x03, DriveFault.UNDERVOLTAGE: 0x05, DriveFault.OVERHEATED: 0x09,
    DriveFault.HEARTBEAT: 0x11, DriveFault.SYNC_LOST: 0x11, DriveFault.CAN_PASSIVE: 0x11,
    DriveFault.BUS_OFF_RECOVERED: 0x11,
}  # fmt: skip
_POWERLESS: Final = (DriveFault.OVERCURRENT, DriveFault.UNDERVOLTAGE, DriveFault.ENCODER)
"""Faults after which a drive cannot brake by its motor: the brake engages at once."""
_CONTROLWORD: Final = (int(ObjectIndex.CONTROLWORD), 0)
POWERED: Final = (
    DriveState.OPERATION_ENABLED,
    DriveState.QUICK_STOP_ACTIVE,
    DriveState.FAULT_REACTION_ACTIVE,
)
"""States in which the motor has torque."""
_DOWN: Final = (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)
_ENABLED: Final = DriveState.OPERATION_ENABLED
_REMOTE, _VOLTAGE, _FOLLOWS = (
    int(StatusBit.REMOTE),
    int(StatusBit.VOLTAGE_ENABLED),
    int(StatusBit.FOLLOWS_COMMAND),
)
RUNNING: Final = _ENABLED.word | _REMOTE | _VOLTAGE | _FOLLOWS
"""Statusword of a drive that follows its set points, without the bits of its mode."""
ENABLE_MASK, ENABLE = DriveCommand.ENABLE_OPERATION.value
"""Bits of a controlword that matter for the command to follow set points, and their value."""


def _calm() -> None:
    """Do nothing: the default of `stir`."""


class PowerDrive(CanopenNode, ABC):
    """One drive without its motor. A subclass names its `mode` and says how the motor begins, ramps
    down and loses its torque."""

    mode: ClassVar[OperationMode]
    """The only mode of operation that it supports."""
    fixed: ClassVar[tuple[ObjectIndex, ...]] = (ObjectIndex.MODE,)
    """Objects that must not be written while the motor has torque."""

    def __init__(
        self, node: int, eds: str, sync_patience: int, stir: Callable[[], None] = _calm
    ) -> None:
        """`sync_patience`: periods of 1006h without SYNC after which an enabled drive stops by
        itself; `stir` is called whenever something happens that may change the motor's torque."""
        super().__init__(node, eds)
        self.stir = stir
        self.state = DriveState.NOT_READY_TO_SWITCH_ON
        self.powered = True
        self.fault = DriveFault.NONE
        self._patient_periods = sync_patience
        self._sync_patience = math.inf
        self._controlword = 0
        self._synced = 0.0

    # What a motor and its mode of operation add.
    @abstractmethod
    def begin(self, resumed: bool) -> None:
        """Enable operation: release the brake and take set points; `resumed`: after a quick
        stop."""

    @abstractmethod
    def ramp_down(self, deceleration: float) -> None:
        """Come to rest at this deceleration (rad/s^2)."""

    @abstractmethod
    def cut_power(self) -> None:
        """Switch the torque off: the brake holds."""

    def flags(self) -> int:
        """Return the bits of the statusword that depend on the mode, while operation is enabled."""
        return 0

    def refresh(self) -> None:
        """Update the objects after they were reset to their defaults, or after the network state
        changed."""

    # Hooks of the CANopen node.
    def on_nmt(self, now: float, before: NmtState) -> None:
        """Restart the state machine after a reset; stop the motion when an enabled drive leaves
        OPERATIONAL (6007h = 2)."""
        if before is NmtState.BOOT_UP:
            if self.state not in _DOWN:
                self._enter(DriveState.SWITCH_ON_DISABLED)
        elif before is NmtState.OPERATIONAL and self.state is DriveState.OPERATION_ENABLED:
            self._quick_stop(DriveState.QUICK_STOP_ACTIVE)
        self._synced = now
        self.refresh()

    def after_receiving(self, now: float) -> None:
        """Obey the controlword."""
        word = self.values[_CONTROLWORD]
        before, self._controlword = self._controlword, word
        if word & ENABLE_MASK == ENABLE and self.state is _ENABLED:
            return  # nothing new
        command = command_of(word)
        if command is DriveCommand.FAULT_RESET and before & 0x80:
            return
        if command is not None:
            self._obey(now, command)

    def on_master_lost(self, now: float) -> None:
        """Stop by itself."""
        self.trip(DriveFault.HEARTBEAT)

    def after_configuring(self) -> None:
        """Store how the drive monitors itself."""
        self._sync_patience = (
            self._patient_periods * self.values[ObjectIndex.SYNC_PERIOD, 0] * 1e-6 or math.inf
        )

    def before_reading(self) -> None:
        """Also update what only an SDO reads."""
        self.before_sending()
        self.values[ObjectIndex.ERROR_CODE, 0] = self.fault
        self.values[ObjectIndex.MODE_DISPLAY, 0] = self.values[ObjectIndex.MODE, 0]

    def check_write(self, index: int, sub: int, value: int) -> None:
        """Refuse any other mode, and any change of configuration while the motor has torque."""
        if index == ObjectIndex.MODE and value not in (OperationMode.NONE, self.mode):
            raise SdoAbortError(AbortCode.VALUE, index, sub)
        if index in self.fixed and self.state in POWERED:
            raise SdoAbortError(AbortCode.STATE, index, sub)

    # Events of a drive.
    def trip(self, fault: DriveFault) -> None:
        """Raise a fault: EMCY, then a ramp to rest (the brake at once if there is no power for a
        ramp), then FAULT."""
        if self.state in _DOWN:
            return
        self.fault = fault
        self.report(fault, _REGISTERS.get(fault, 0x21))
        if (
            self.state not in (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)
            or fault in _POWERLESS
        ):
            self._enter(DriveState.FAULT)
        else:
            self._quick_stop(DriveState.FAULT_REACTION_ACTIVE)

    def ramp_ended(self) -> None:
        """Enter FAULT: the motor has come to rest after a fault."""
        self._enter(DriveState.FAULT)

    def statusword(self) -> int:
        """Return object 6041h."""
        if self.state is _ENABLED and self.powered:
            return RUNNING | self.flags()
        word: int = self.state.word | _REMOTE
        if self.powered:
            word |= _VOLTAGE
        if self.state is _ENABLED:
            word |= _FOLLOWS | self.flags()
        return word

    def late(self, now: float) -> bool:
        """Return whether SYNC is overdue."""
        return now - self._synced > self._sync_patience + 1e-9

    @property
    def waits_until(self) -> float:
        """When the drive misses SYNC (s)."""
        return self._synced + self._sync_patience if self.state is _ENABLED else math.inf

    # The state machine.
    def _obey(self, now: float, command: DriveCommand) -> None:
        state = after(self.state, command)
        if state is self.state:
            return
        if self.state is DriveState.FAULT:
            if not self.powered:
                return  # the cause is still there
            self.fault = DriveFault.NONE
            self.report(DriveFault.NONE, 0)
        if state is DriveState.OPERATION_ENABLED:
            if (
                self.nmt is not NmtState.OPERATIONAL
                or self.values[ObjectIndex.MODE, 0] != self.mode
            ):
                return
            self.begin(self.state is DriveState.QUICK_STOP_ACTIVE)
            self._synced = now
            self.state = state
            self.stir()
        elif state is DriveState.QUICK_STOP_ACTIVE:
            self._quick_stop(state)
        else:
            self._enter(state)

    def _quick_stop(self, state: DriveState) -> None:
        self.ramp_down(from_units(self.values[ObjectIndex.QUICK_STOP_DECELERATION, 0]))
        self.state = state
        self.stir()

    def _enter(self, state: DriveState) -> None:
        """Enter a state without torque: the brake holds."""
        self.cut_power()
        self.state = state
        self.stir()


AnyDrive = TypeVar("AnyDrive", bound=PowerDrive)


class DriveBus(Generic[AnyDrive]):
    """The devices on a bus, except the master: drives, and one other device."""

    def __init__(self, drives: tuple[AnyDrive, ...], other: CanopenNode) -> None:
        self.drives = drives
        self._nodes: tuple[CanopenNode, ...] = (*drives, other)
        self._own = {node.node: node for node in self._nodes}
        self._due = -math.inf
        """When a device has something to do next (s)."""
        for node in self._nodes:
            node.boot(0.0)

    def receive(self, now: float, frame: Frame) -> None:
        """Process one frame of the master."""
        cob_id = frame.id
        target = self._own.get(cob_id & 0x7F)
        if target is not None and (rpdo := target.rpdo).cob_id == cob_id and rpdo.on:
            target.take_rpdo(now, frame.data)
        elif cob_id == SYNC_ID:
            self._sync(now)
        else:
            self._spread(now, frame)

    def _sync(self, now: float) -> None:
        for node in self._nodes:
            node.sync(now)

    def _spread(self, now: float, frame: Frame) -> None:
        """Let all devices process a frame."""
        self._due = -math.inf  # It may set any timer.
        for node in self._nodes:
            node.receive(now, frame)

    def drain(self) -> list[Frame]:
        """Return the frames to the master, oldest first."""
        frames: list[Frame] = []
        for node in self._nodes:
            if node.outbox:
                frames += node.outbox
                node.outbox.clear()
        return frames

    def power(self, closed: bool) -> None:
        """Close or open the power chain (emergency stop). Open: the drives lose power and the
        brakes engage."""
        for drive in self.drives:
            drive.powered = closed
            if not closed:
                drive.trip(DriveFault.UNDERVOLTAGE)

    def trip(self, number: int, fault: DriveFault = DriveFault.OVERCURRENT) -> None:
        """Make a drive (from 0) fail."""
        self.drives[number].trip(fault)
