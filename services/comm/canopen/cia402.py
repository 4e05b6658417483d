"""CiA 402 servo drives: state machine, words, objects, units and error codes, shared by master and
simulated drives.

Pure tables and functions (CiA 402-2 and 402-3). Positions are in micro-radians at the joint (the
drives' position factor), speeds in micro-radians per second, so an INTEGER32 holds 2,147 rad.
"""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import Final

from petrobot.services.comm.canopen.cia301 import DataType, Mapped

UNITS: Final = 1e6
"""Position units per radian, and speed units per radian per second."""


def to_units(radians: float) -> int:
    """Convert radians (or rad/s) to the drives' units."""
    return round(radians * UNITS)


def from_units(units: int) -> float:
    """Convert the drives' units to radians (or rad/s)."""
    return units / UNITS


class DriveState(Enum):
    """States of the power drive system; the value is (mask, pattern) of the statusword's low byte
    (CiA 402-2, table 31)."""

    def __init__(self, mask: int, word: int) -> None:
        self.word = word
        """The bits of the statusword that show this state."""

    NOT_READY_TO_SWITCH_ON = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)


class StatusBit(IntEnum):
    """Statusword bits outside the state pattern. 12 and 13 as in cyclic synchronous position mode;
    12 also as in velocity mode."""

    VOLTAGE_ENABLED = 1 << 4
    WARNING = 1 << 7
    REMOTE = 1 << 9
    TARGET_REACHED = 1 << 10
    INTERNAL_LIMIT = 1 << 11
    FOLLOWS_COMMAND = 1 << 12
    FOLLOWING_ERROR = 1 << 13


class DriveCommand(Enum):
    """Commands; the value is (mask, pattern) of the controlword (CiA 402-2, table 29). FAULT_RESET
    acts on its rising edge."""

    SHUTDOWN = (0x87, 0x06)
    SWITCH_ON = (0x8F, 0x07)
    ENABLE_OPERATION = (0x8F, 0x0F)
    DISABLE_VOLTAGE = (0x82, 0x00)
    QUICK_STOP = (0x86, 0x02)
    FAULT_RESET = (0x80, 0x80)

    def __init__(self, mask: int, word: int) -> None:
        self.word = word
        """A controlword that gives this command."""


class OperationMode(IntEnum):
    """Modes of operation (6060h)."""

    NONE = 0
    CYCLIC_SYNCHRONOUS_POSITION = 8
    CYCLIC_SYNCHRONOUS_VELOCITY = 9

    @property
    def bit(self) -> int:
        """Return its bit in object 6502h, supported drive modes (modes 1 and up)."""
        return 1 << (self.value - 1)


DEVICE_TYPE: Final = 0x0002_0192
"""Object 1000h of a servo drive (profile 402)."""


class DriveFault(IntEnum):
    """Error codes of EMCY and 603Fh (CiA 301 table 26, CiA 402-2 annex)."""

    NONE = 0x0000
    OVERCURRENT = 0x2310
    UNDERVOLTAGE = 0x3220
    OVERHEATED = 0x4310
    ENCODER = 0x7305
    CAN_PASSIVE = 0x8120
    HEARTBEAT = 0x8130
    BUS_OFF_RECOVERED = 0x8140
    SYNC_LOST = 0x8700
    FOLLOWING_ERROR = 0x8611


FAULT_TEXT: Final = {
    DriveFault.NONE: "no error",
    DriveFault.OVERCURRENT: "over-current at the motor",
    DriveFault.UNDERVOLTAGE: "no power at the drive: the arm-power chain is open",
    DriveFault.OVERHEATED: "drive too hot",
    DriveFault.ENCODER: "encoder fault",
    DriveFault.CAN_PASSIVE: "too many bus errors",
    DriveFault.HEARTBEAT: "the master's heartbeat was lost",
    DriveFault.BUS_OFF_RECOVERED: "the bus was off",
    DriveFault.SYNC_LOST: "SYNC was lost",
    DriveFault.FOLLOWING_ERROR: "following error too large",
}


def fault_text(code: int) -> str:
    """Return an error code in words."""
    return (
        FAULT_TEXT[DriveFault(code)]
        if code in DriveFault._value2member_map_
        else f"error code {code:#06x}"
    )


class ObjectIndex(IntEnum):
    """Indices of the objects in use."""

    DEVICE_TYPE = 0x1000
    ERROR_REGISTER = 0x1001
    SYNC_PERIOD = 0x1006
    CONSUMER_HEARTBEAT = 0x1016
    PRODUCER_HEARTBEAT = 0x1017
    IDENTITY = 0x1018
    RPDO1 = 0x1400
    RPDO1_MAPPING = 0x1600
    TPDO1 = 0x1800
    TPDO1_MAPPING = 0x1A00
    ERROR_CODE = 0x603F
    CONTROLWORD = 0x6040
    STATUSWORD = 0x6041
    QUICK_STOP_OPTION = 0x605A
    MODE = 0x6060
    MODE_DISPLAY = 0x6061
    POSITION = 0x6064
    FOLLOWING_ERROR_WINDOW = 0x6065
    FOLLOWING_ERROR_TIMEOUT = 0x6066
    VELOCITY = 0x606C
    TORQUE = 0x6077
    DC_LINK_VOLTAGE = 0x6079
    TARGET_POSITION = 0x607A
    SOFTWARE_LIMITS = 0x607D
    MAX_SPEED = 0x607F
    QUICK_STOP_DECELERATION = 0x6085
    INTERPOLATION_PERIOD = 0x60C2
    FOLLOWING_ERROR = 0x60F4
    TARGET_VELOCITY = 0x60FF
    SUPPORTED_MODES = 0x6502


RECEIVED: Final = (
    Mapped(ObjectIndex.CONTROLWORD, 0, DataType.UNSIGNED16),
    Mapped(ObjectIndex.TARGET_POSITION, 0, DataType.INTEGER32),
)
"""Objects of the RPDO that the master sends each drive in each cycle, in cyclic synchronous
position mode."""

VELOCITY_RECEIVED: Final = (
    Mapped(ObjectIndex.CONTROLWORD, 0, DataType.UNSIGNED16),
    Mapped(ObjectIndex.TARGET_VELOCITY, 0, DataType.INTEGER32),
)
"""The same in cyclic synchronous velocity mode."""

SENT: Final = (
    Mapped(ObjectIndex.STATUSWORD, 0, DataType.UNSIGNED16),
    Mapped(ObjectIndex.POSITION, 0, DataType.INTEGER32),
    Mapped(ObjectIndex.TORQUE, 0, DataType.INTEGER16),
)
"""Objects of the TPDO that each drive sends after SYNC, in either mode."""


def _state(statusword: int) -> DriveState | None:
    for state in DriveState:
        mask, pattern = state.value
        if statusword & mask == pattern:
            return state
    return None


# No two patterns overlap, so the order of the commands does not matter.
def _command(controlword: int) -> DriveCommand | None:
    for command in DriveCommand:
        mask, pattern = command.value
        if controlword & mask == pattern:
            return command
    return None


# Both words are decoded every cycle, so the answer is looked up by the low byte.
_STATES: Final = tuple(_state(low) for low in range(256))
_COMMANDS: Final = tuple(_command(low) for low in range(256))


def state_of(statusword: int) -> DriveState:
    """Return the state that a statusword shows; raises ValueError for a pattern that is not a
    state."""
    state = _STATES[statusword & 0xFF]
    if state is None:
        raise ValueError(f"statusword {statusword:#06x} is not a state of CiA 402")
    return state


def command_of(controlword: int) -> DriveCommand | None:
    """Return the command that a controlword gives. For FAULT_RESET only the bit is checked; the
    drive itself detects the edge."""
    return _COMMANDS[controlword & 0xFF]


TRANSITIONS: Final = {
    (DriveState.SWITCH_ON_DISABLED, DriveCommand.SHUTDOWN): DriveState.READY_TO_SWITCH_ON,  # 2
    (DriveState.READY_TO_SWITCH_ON, DriveCommand.SWITCH_ON): DriveState.SWITCHED_ON,  # 3
    (
        DriveState.READY_TO_SWITCH_ON,
        DriveCommand.ENABLE_OPERATION,
    ): DriveState.SWITCHED_ON,  # 3, then 4 of itself
    (DriveState.SWITCHED_ON, DriveCommand.ENABLE_OPERATION): DriveState.OPERATION_ENABLED,  # 4
    (
        DriveState.OPERATION_ENABLED,
        DriveCommand.SWITCH_ON,
    ): DriveState.SWITCHED_ON,  # 5, "disable operation"
    (DriveState.SWITCHED_ON, DriveCommand.SHUTDOWN): DriveState.READY_TO_SWITCH_ON,  # 6
    (
        DriveState.READY_TO_SWITCH_ON,
        DriveCommand.DISABLE_VOLTAGE,
    ): DriveState.SWITCH_ON_DISABLED,  # 7
    (DriveState.READY_TO_SWITCH_ON, DriveCommand.QUICK_STOP): DriveState.SWITCH_ON_DISABLED,  # 7
    (DriveState.OPERATION_ENABLED, DriveCommand.SHUTDOWN): DriveState.READY_TO_SWITCH_ON,  # 8
    (
        DriveState.OPERATION_ENABLED,
        DriveCommand.DISABLE_VOLTAGE,
    ): DriveState.SWITCH_ON_DISABLED,  # 9
    (DriveState.SWITCHED_ON, DriveCommand.DISABLE_VOLTAGE): DriveState.SWITCH_ON_DISABLED,  # 10
    (DriveState.SWITCHED_ON, DriveCommand.QUICK_STOP): DriveState.SWITCH_ON_DISABLED,  # 10
    (DriveState.OPERATION_ENABLED, DriveCommand.QUICK_STOP): DriveState.QUICK_STOP_ACTIVE,  # 11
    (
        DriveState.QUICK_STOP_ACTIVE,
        DriveCommand.DISABLE_VOLTAGE,
    ): DriveState.SWITCH_ON_DISABLED,  # 12
    (DriveState.FAULT, DriveCommand.FAULT_RESET): DriveState.SWITCH_ON_DISABLED,  # 15
    (
        DriveState.QUICK_STOP_ACTIVE,
        DriveCommand.ENABLE_OPERATION,
    ): DriveState.OPERATION_ENABLED,  # 16, options 5 to 8 of 605Ah
}
"""Transitions caused by commands, with their numbers in CiA 402-2, figure 9; any other command
changes nothing.

0, 1 (power on), 13 (fault) and 14 (end of the fault reaction) happen without a command.
"""

ENABLING: Final = {
    DriveState.SWITCH_ON_DISABLED: DriveCommand.SHUTDOWN,
    DriveState.READY_TO_SWITCH_ON: DriveCommand.SWITCH_ON,
    DriveState.SWITCHED_ON: DriveCommand.ENABLE_OPERATION,
    DriveState.OPERATION_ENABLED: DriveCommand.ENABLE_OPERATION,
    DriveState.QUICK_STOP_ACTIVE: DriveCommand.DISABLE_VOLTAGE,
    DriveState.FAULT: DriveCommand.FAULT_RESET,
}
"""The command that leads from a state towards OPERATION_ENABLED. FAULT_RESET must follow a word
without its bit."""


def after(state: DriveState, command: DriveCommand) -> DriveState:
    """Return the state after a command."""
    return TRANSITIONS.get((state, command), state)
