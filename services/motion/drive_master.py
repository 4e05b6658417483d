"""The CANopen master of the arm's bus: configures, starts, enables and watches six drives and the digital inputs.

A machine: frames in, frames out, times passed in. It knows neither trajectories nor actions: each cycle it is given six
targets (rad) and says what the drives say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

from services.comm import canopen
from services.comm.canbus import Frame
from services.comm.canopen import NmtCommand, NmtState, SdoClient, Transfer, Type
from services.comm.cia402 import Fault, Object, State, fault_text
from services.motion.drive_link import HEARTBEAT_MS, HEARTBEAT_PATIENCE_MS, MASTER_NODE, DriveLink, DriveSettings

HEARTBEAT_PATIENCE: Final = HEARTBEAT_PATIENCE_MS / 1e3
SILENT_CYCLES: Final = 10
"""Cycles without a drive's TPDO after which it counts as lost."""
RETRY: Final = 1.0
"""Seconds before a failed configuration is tried again."""
SETTLE: Final = 0.05
"""Seconds that nodes are given after a reset of their communication."""
INPUT_TIMER_MS: Final = 100

_U8, _U16 = Type.UNSIGNED8, Type.UNSIGNED16


class Phase(Enum):
    """What the master is doing."""

    CONFIGURING = "configuring"
    """SDO transfers are under way, or are waiting to be tried again."""
    STARTING = "starting"
    """Nodes are ordered into OPERATIONAL; not all have sent process data yet."""
    RUNNING = "running"
    """All drives answer each SYNC."""


@dataclass(frozen=True, slots=True)
class Trouble:
    """Something that needs a reset. `cause` is a short code, `joint` 0 to 5 or None, `code` an EMCY error code or 0."""

    cause: str
    joint: int | None
    code: int
    text: str


class DriveMaster:
    """Master of nodes 1 to 6 (drives, base to flange) and `inputs` (digital inputs)."""

    def __init__(self, settings: Sequence[DriveSettings], cycle: float, inputs: int = 7, enable: bool = True) -> None:
        """`cycle` in seconds; with `enable` the drives are enabled as soon as they are there for the first time."""
        self.cycle = cycle
        self.drives = [DriveLink(number, each) for number, each in enumerate(settings, 1)]
        self.inputs_node = inputs
        self.inputs: int | None = None
        self.wanted = False
        """Whether the drives are to be enabled."""
        self.phase = Phase.CONFIGURING
        self.troubles: list[Trouble] = []
        self._input_sdo = SdoClient(inputs)
        self._by_tpdo = {canopen.TPDO1_BASE + drive.node: drive for drive in self.drives}
        self._heard = dict.fromkeys([*(drive.node for drive in self.drives), inputs], 0.0)
        self._begin_at: float | None = 0.0
        self._settled_at = 0.0
        self._beat_due = 0.0
        self._resetting = False
        self._enable_first = enable
        self._all_enabled = False
        self.limited = False
        """Whether a drive cuts its set points because they are faster than it goes."""

    @property
    def enabled(self) -> bool:
        """Whether all drives follow set points."""
        return self._all_enabled and self.phase is Phase.RUNNING

    @property
    def positions(self) -> list[float]:
        """Joint angles as the drives last said (rad)."""
        return [drive.position for drive in self.drives]

    @property
    def speeds(self) -> tuple[float, ...]:
        """Greatest speeds as the drives last said (rad/s)."""
        return tuple([drive.max_speed for drive in self.drives])

    def reset(self, now: float) -> None:
        """Forget troubles, reset faults and enable again; configure again if the bus was the trouble."""
        again = self.phase is not Phase.RUNNING or any(trouble.cause == "bus" for trouble in self.troubles)
        self.troubles.clear()
        self._resetting, self.wanted = True, True
        for drive in self.drives:
            drive.error_code = 0
        if again:
            self.phase, self._begin_at = Phase.CONFIGURING, now

    def give_up(self, why: str, cause: str = "drive_fault", code: int = Fault.FOLLOWING_ERROR) -> None:
        """The servo itself stops the drives quickly, with the next cycle: they do not follow, or in an emergency."""
        self._report(Trouble(cause, None, code, why))
        self._enable_first = False

    def bus_lost(self, now: float, why: str) -> None:
        """The bus itself is gone: nothing is enabled any more; configure again when it is back."""
        self._report(Trouble("bus", None, 0, why))
        self.phase, self._begin_at = Phase.CONFIGURING, now + RETRY

    def receive(self, now: float, frame: Frame) -> None:
        """A frame off the bus; what cannot be understood is ignored."""
        drive = self._by_tpdo.get(frame.id)
        if drive is not None:
            try:
                if drive.take(frame.data):
                    self._look_at_drives()
            except ValueError:
                return  # not ours: silence will show
        elif frame.id == canopen.TPDO1_BASE + self.inputs_node:
            if frame.data:
                self.inputs = frame.data[0]
        elif frame.id > canopen.HEARTBEAT_BASE:
            self._beat(now, frame)
        elif frame.id > canopen.SDO_REPLY_BASE:
            for client in (*(each.sdo for each in self.drives), self._input_sdo):
                client.receive(frame)
        elif canopen.EMCY_BASE < frame.id < canopen.TPDO1_BASE:
            self._emergency(frame)

    def _look_at_drives(self) -> None:
        """A drive's status has changed."""
        self._all_enabled = all(drive.state is State.OPERATION_ENABLED for drive in self.drives)
        self.limited = any(drive.limited for drive in self.drives)

    def advance(self, now: float, targets: Sequence[float]) -> list[Frame]:
        """Frames of one cycle: configuration, or set points (rad) and SYNC; heartbeat when due."""
        frames: list[Frame] = []
        if now >= self._beat_due:
            self._beat_due = now + HEARTBEAT_MS / 1e3
            frames.append(canopen.heartbeat(MASTER_NODE, NmtState.OPERATIONAL))
        if self.phase is Phase.CONFIGURING:
            frames += self._configure(now)
        else:
            self._supervise(now)
            frames += [
                drive.frame(target, self.wanted, self._resetting)
                for drive, target in zip(self.drives, targets, strict=True)
            ]
            frames.append(canopen.SYNC)
            hurry = self.limited
            for drive in self.drives:
                asked = drive.ask_speed(now, hurry)
                if asked:
                    frames += asked
        return frames

    def _configure(self, now: float) -> list[Frame]:
        clients = [*(drive.sdo for drive in self.drives), self._input_sdo]
        if self._begin_at is not None:
            if now < self._begin_at:
                return []
            self._begin_at, self._settled_at = None, now + SETTLE
            for drive in self.drives:
                drive.sdo.begin(drive.transfers(self.cycle))
            self._input_sdo.begin(self._input_transfers())
            return [canopen.nmt(NmtCommand.RESET_COMMUNICATION)]
        if now < self._settled_at:
            return []
        if any(client.busy for client in clients):
            return [frame for client in clients for frame in client.advance(now)]
        return self._start(now, clients)

    def _start(self, now: float, clients: Sequence[SdoClient]) -> list[Frame]:
        """All transfers are over: start the nodes, or say what failed and try again later."""
        wrong = [client.failure for client in clients if client.failure]
        wrong = wrong or [text for text in (drive.wrong() for drive in self.drives) if text]
        if wrong:
            self._report(Trouble("bus", None, 0, "; ".join(wrong)))
            self._begin_at = now + RETRY
            return []
        if self._enable_first:
            self._enable_first, self.wanted = False, True
            self._resetting = True  # the drives may have gone into a fault when their last master went away
            self.troubles.clear()
        self.phase = Phase.STARTING
        for drive in self.drives:
            drive.silent, drive.spoken = 0, False
        self._heard = dict.fromkeys(self._heard, now)
        return [canopen.nmt(NmtCommand.START)]

    def _input_transfers(self) -> list[Transfer]:
        parameters, mapping = Object.TPDO1, Object.TPDO1_MAPPING
        objects = [canopen.Mapped(0x6000, 1, _U8)]
        return [
            Transfer(Object.PRODUCER_HEARTBEAT, 0, _U16, HEARTBEAT_MS),
            Transfer(parameters, 5, _U16, INPUT_TIMER_MS),
            *canopen.map_pdo(parameters, mapping, canopen.TPDO1_BASE + self.inputs_node, 255, objects),
        ]

    def _supervise(self, now: float) -> None:
        """Silence, lost heartbeats, and the end of starting and of a reset."""
        for drive in self.drives:
            drive.silent += 1
            if drive.silent == SILENT_CYCLES + 1:
                self._report(Trouble("bus", drive.node - 1, 0, f"drive {drive.node} is silent"))
            if drive.state is State.FAULT and not self._resetting and drive.spoken and drive.silent <= 1:
                self._fault(drive, drive.error_code)
        for node, heard in self._heard.items():
            if now - heard > HEARTBEAT_PATIENCE:
                self._report(Trouble("bus", None, 0, f"node {node} sends no heartbeat"))
        if self.phase is Phase.STARTING and all(drive.spoken for drive in self.drives):
            self.phase = Phase.RUNNING
        if self._resetting and self.enabled:
            self._resetting = False

    def _beat(self, now: float, frame: Frame) -> None:
        node = frame.id - canopen.HEARTBEAT_BASE
        if node not in self._heard or len(frame.data) != 1:
            return
        self._heard[node] = now
        if frame.data[0] == NmtState.BOOT_UP and self.phase is not Phase.CONFIGURING:
            self._report(
                Trouble("bus", node - 1 if node <= len(self.drives) else None, 0, f"node {node} has restarted")
            )

    def _emergency(self, frame: Frame) -> None:
        try:
            message = canopen.parse_emergency(frame)
        except ValueError:
            return
        if 1 <= message.node <= len(self.drives):
            drive = self.drives[message.node - 1]
            drive.error_code = message.code
            if (
                message.code and self.phase is not Phase.CONFIGURING
            ):  # before, it may be old; a fault that stays will show
                self._fault(drive, message.code)

    def _fault(self, drive: DriveLink, code: int) -> None:
        cause = "power" if code == Fault.UNDERVOLTAGE else "drive_fault"
        text = f"joint {drive.node}: {fault_text(code)}" if code else f"joint {drive.node}: drive in fault"
        self._report(Trouble(cause, drive.node - 1, code, text))

    def _report(self, trouble: Trouble) -> None:
        """Keep it until a reset (the same one once), and let no drive move on."""
        self.wanted = False
        if not any(
            (each.joint, each.cause, each.code) == (trouble.joint, trouble.cause, trouble.code)
            for each in self.troubles
        ):
            self.troubles.append(trouble)
