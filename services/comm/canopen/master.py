"""A CANopen master of CiA 402 drives for any machine: configures, starts, enables and supervises
them, cycle by cycle.

Sans-I/O: frames in, frames out, times passed in. How a drive is configured and what is sent to it
in a cycle is defined by its `DriveInterface`. Nodes that are not drives (inputs, sensors) are
`Companion`s. Uses CiA 301 (NMT, heartbeat, SDO, SYNC, EMCY) and CiA 402-2.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import Final, Generic, Protocol, TypeVar

from msgspec import Struct

from petrobot.services.comm.canopen import cia301 as canopen
from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import (
    DataType,
    Mapped,
    NmtCommand,
    NmtState,
    SdoClient,
    Transfer,
)
from petrobot.services.comm.canopen.cia402 import (
    DEVICE_TYPE,
    ENABLING,
    SENT,
    DriveCommand,
    DriveFault,
    DriveState,
    ObjectIndex,
    OperationMode,
    fault_text,
)

MASTER_NODE: Final = 0x7F
"""Node id under which the master sends its own heartbeat."""
HEARTBEAT_MS: Final = 50
"""Period of every node's heartbeat (ms)."""
RETRY: Final = 1.0
"""Pause before a failed configuration is tried again (s)."""
BY_THEMSELVES: Final = 1.2
"""Time after which enabled drives that have lost their master stand still: they notice it by its
heartbeat (0.25 s at most here) and stop quickly (0.8 s at most), then their brakes hold (s)."""
SETTLE: Final = 0.05
"""Time that nodes get after a reset of their communication (s)."""

_U16, _U32, _I8 = (
    DataType.UNSIGNED16,
    DataType.UNSIGNED32,
    DataType.INTEGER8,
)
_FAULT: Final = DriveState.FAULT  # An enumeration's members are slow to look up.
_MOVING: Final = (DriveState.OPERATION_ENABLED, DriveState.QUICK_STOP_ACTIVE)


class MasterPhase(Enum):
    """What the master is doing."""

    CONFIGURING = "configuring"
    """SDO transfers are active, or wait for the next attempt."""
    STARTING = "starting"
    """Nodes were ordered into OPERATIONAL; not all have sent process data yet."""
    RUNNING = "running"
    """All drives answer each SYNC."""


class Trouble(Struct, frozen=True):
    """A fault that needs a reset.

    `cause` is a short code (`drive_fault`, `power`, `bus`), `axis` the drive's number from 0 or
    None, `code` an EMCY error code or 0.
    """

    cause: str
    axis: int | None
    code: int
    text: str


class Supervision(Struct, frozen=True):
    """How strict a master is; depends on its cycle and on what a drive may do on its own
    meanwhile."""

    silent_cycles: int
    """Cycles without its TPDO after which a drive counts as lost."""
    patience: float
    """Time without a heartbeat after which a node counts as lost (s)."""
    old_emergencies: bool = False
    """Whether an EMCY that arrives during a reset is ignored: a fault that persists shows in the
    status anyway."""


class DriveInterface(Protocol):
    """What the master needs of one drive. `Power`, `usual_transfers`, `pdo_transfers` and `unfit`
    help to implement it."""

    node: int
    sdo: SdoClient
    state: DriveState
    limited: bool
    """Whether the drive clips its set points because they exceed its speed."""
    silent: int
    """Cycles since its last TPDO."""
    spoken: bool
    """Whether it has sent one since it was started."""
    error_code: int

    def transfers(self, cycle: float) -> list[Transfer]:
        """Return the configuration for a bus cycle (s), including the objects to read."""

    def wrong(self) -> str:
        """Return why the device at this node is unfit, in words; empty if it is fit. Called after
        the transfers."""

    def take(self, data: bytes) -> bool:
        """Handle its TPDO; return whether its status changed. Raises ValueError for bytes that are
        not its TPDO."""

    def frame(self, target: float, wanted: bool, resetting: bool) -> Frame:
        """Return its RPDO of this cycle."""


Link = TypeVar("Link", bound=DriveInterface)


class Companion(Struct, frozen=True):
    """A node on the bus that is not a drive: id, configuration, and a function for the data of its
    TPDO."""

    node: int
    transfers: Sequence[Transfer]
    take: Callable[[bytes], None]
    needed: bool = True
    """Whether the drives may move only while it answers."""


class Power:
    """Chooses the controlword that leads a drive to the state its master wants (CiA 402-2, figure
    9)."""

    __slots__ = ("_reset_cycles", "_stop_cycles", "_wait", "stopping")

    def __init__(self, reset_cycles: int, stop_cycles: int) -> None:
        """`reset_cycles`: cycles between two fault resets. `stop_cycles`: cycles that a drive gets
        to stop quickly before its power is switched off and its brake holds."""
        self._reset_cycles, self._stop_cycles = reset_cycles, stop_cycles
        self._wait = 0
        self.stopping = 0
        """Cycles since the drive should last be enabled."""

    def word(self, state: DriveState, wanted: bool, resetting: bool) -> int:
        """Return the controlword of this cycle; `resetting`: whether faults may be reset."""
        self.stopping = 0 if wanted else self.stopping + 1
        return self._command(state, wanted, resetting).word

    def _command(self, state: DriveState, wanted: bool, resetting: bool) -> DriveCommand:
        if not wanted:
            brakes = state in _MOVING and self.stopping <= self._stop_cycles
            return DriveCommand.QUICK_STOP if brakes else DriveCommand.DISABLE_VOLTAGE
        if state is DriveState.FAULT:
            # A reset acts on the rising edge of its bit, so the bit is set in one cycle and cleared
            # in the others.
            self._wait = (self._wait + 1) % self._reset_cycles
            return (
                DriveCommand.FAULT_RESET
                if resetting and self._wait == 1
                else DriveCommand.DISABLE_VOLTAGE
            )
        return ENABLING.get(state, DriveCommand.DISABLE_VOLTAGE)


def usual_transfers(cycle: float, mode: OperationMode, patience: float) -> list[Transfer]:
    """Return the transfers that every drive needs: identity, heartbeats both ways (`patience`, s),
    bus cycle (s), mode of operation."""
    beat = MASTER_NODE << 16 | round(patience * 1e3)
    return [
        Transfer(ObjectIndex.DEVICE_TYPE, 0, _U32),
        Transfer(ObjectIndex.SUPPORTED_MODES, 0, _U32),
        Transfer(ObjectIndex.PRODUCER_HEARTBEAT, 0, _U16, HEARTBEAT_MS),
        Transfer(ObjectIndex.CONSUMER_HEARTBEAT, 1, _U32, beat),
        Transfer(ObjectIndex.SYNC_PERIOD, 0, _U32, round(cycle * 1e6)),
        Transfer(ObjectIndex.MODE, 0, _I8, mode),
    ]


def pdo_transfers(node: int, received: Sequence[Mapped]) -> list[Transfer]:
    """Return the transfers for one RPDO of these objects and for the TPDO that every drive sends,
    both synchronous."""
    return [
        *canopen.map_pdo(
            ObjectIndex.RPDO1, ObjectIndex.RPDO1_MAPPING, canopen.RPDO1_BASE + node, 1, received
        ),
        *canopen.map_pdo(
            ObjectIndex.TPDO1, ObjectIndex.TPDO1_MAPPING, canopen.TPDO1_BASE + node, 1, SENT
        ),
    ]


def companion_transfers(node: int, timer_ms: int, objects: Sequence[Mapped]) -> list[Transfer]:
    """Return the transfers for the heartbeat, and for a TPDO of these objects that is sent on
    change and every `timer_ms`."""
    return [
        Transfer(ObjectIndex.PRODUCER_HEARTBEAT, 0, _U16, HEARTBEAT_MS),
        Transfer(ObjectIndex.TPDO1, 5, _U16, timer_ms),
        *canopen.map_pdo(
            ObjectIndex.TPDO1, ObjectIndex.TPDO1_MAPPING, canopen.TPDO1_BASE + node, 255, objects
        ),
    ]


def unfit(node: int, read: Mapping[tuple[int, int], int], mode: OperationMode) -> str:
    """Return why a device with these objects cannot be used as a drive in this mode; empty if it
    can."""
    device, modes = read[ObjectIndex.DEVICE_TYPE, 0], read[ObjectIndex.SUPPORTED_MODES, 0]
    if device != DEVICE_TYPE:
        return (
            f"node {node} is not a servo drive (object 1000h is {device:#010x}): check the node ids"
        )
    if not modes & mode.bit:
        return f"node {node} does not support {mode.name.lower().replace('_', ' ')} mode"
    return ""


class CanopenMaster(Generic[Link]):
    """Master of drives (by name) and of companions."""

    def __init__(
        self,
        drives: Mapping[str, Link],
        companions: Sequence[Companion],
        cycle: float,
        manner: Supervision,
        *,
        enable: bool = False,
        dry_run: bool = False,
    ) -> None:
        """`cycle` in s. With `enable` the drives are enabled as soon as they are configured for the
        first time. In a dry run `enabled` says what would be: no drive is ever enabled."""
        self.cycle = cycle
        self.drives: Sequence[Link] = tuple(drives.values())
        self.names = tuple(drives)
        self.wanted = False
        """Whether the drives should be enabled."""
        self.phase = MasterPhase.CONFIGURING
        self.troubles: list[Trouble] = []
        self.limited = False
        """Whether a drive clips its set points because they exceed its speed."""
        self._manner = manner
        self._dry_run = dry_run
        self._companions = {each.node: each for each in companions}
        self._sdos = {each.node: SdoClient(each.node) for each in companions}
        self._by_tpdo = {canopen.TPDO1_BASE + drive.node: drive for drive in self.drives}
        self._others_by_tpdo = {canopen.TPDO1_BASE + each.node: each for each in companions}
        self._axis = {drive.node: axis for axis, drive in enumerate(self.drives)}
        self._heard = dict.fromkeys([*self._axis, *self._companions], 0.0)
        self._started: set[int] = set()
        """Nodes that were operational since they were started. A boot-up message of another one may
        be older than its start; if it is not, the node is silent from then on."""
        self._now = 0.0
        self._seen = -BY_THEMSELVES
        """When all drives answered last (s)."""
        self._begin_at: float | None = 0.0
        self._settled_at = 0.0
        self._beat_due = 0.0
        self._resetting = False
        self._enable_first = enable
        self._all_enabled = False

    @property
    def enabled(self) -> bool:
        """Return whether all drives follow set points."""
        follow = self.wanted if self._dry_run else self._all_enabled
        return follow and self.phase is MasterPhase.RUNNING

    @property
    def blind(self) -> bool:
        """Return whether drives may still be moving unseen: they were enabled and are silent."""
        silence = self._now - self._seen
        least = (self._manner.silent_cycles + 1) * self.cycle
        return self._all_enabled and least < silence < BY_THEMSELVES

    def alive(self, node: int) -> bool:
        """Return whether a node's heartbeat arrived recently."""
        return self._now - self._heard[node] <= self._manner.patience

    def reset(self, now: float) -> None:
        """Clear troubles, reset faults and enable again; configure again if the bus was the
        trouble."""
        again = self.phase is not MasterPhase.RUNNING or any(
            trouble.cause == "bus" for trouble in self.troubles
        )
        self.troubles.clear()
        self._resetting, self.wanted = True, True
        for drive in self.drives:
            drive.error_code = 0
        if again:
            self.phase, self._begin_at = MasterPhase.CONFIGURING, now

    def give_up(self, why: str, cause: str, code: int) -> None:
        """Stop the drives quickly with the next cycle, because the machine itself has a fault."""
        self._report(Trouble(cause, None, code, why))
        self._enable_first = False

    def bus_lost(self, now: float, why: str) -> None:
        """The bus is gone: disable all drives, and configure them again when it is back."""
        self._report(Trouble("bus", None, 0, why))
        self.phase, self._begin_at = MasterPhase.CONFIGURING, now + RETRY

    # Received frames

    def receive(self, now: float, frame: Frame) -> None:
        """Handle a frame from the bus; frames that cannot be decoded are ignored."""
        drive = self._by_tpdo.get(frame.id)
        if drive is not None:
            try:
                if drive.take(frame.data):
                    self._look_at_drives()
            except ValueError:
                return  # not this TPDO; a drive that sends nothing else counts as silent
        elif frame.id in self._others_by_tpdo:
            self._others_by_tpdo[frame.id].take(frame.data)
        elif frame.id > canopen.HEARTBEAT_BASE:
            self._beat(now, frame)
        elif frame.id > canopen.SDO_REPLY_BASE:
            for client in self._clients():
                client.receive(frame)
        elif canopen.EMCY_BASE < frame.id < canopen.TPDO1_BASE:
            self._emergency(frame)

    def _look_at_drives(self) -> None:
        """A drive's status has changed."""
        self._all_enabled = all(
            drive.state is DriveState.OPERATION_ENABLED for drive in self.drives
        )
        self.limited = any(drive.limited for drive in self.drives)

    def _beat(self, now: float, frame: Frame) -> None:
        node = frame.id - canopen.HEARTBEAT_BASE
        if node not in self._heard or len(frame.data) != 1:
            return
        state = frame.data[0]
        if self.phase is MasterPhase.CONFIGURING:
            self._heard[node] = now
        elif state == NmtState.OPERATIONAL:
            self._heard[node] = now
            self._started.add(node)
        elif state == NmtState.BOOT_UP and node in self._started and self._needed(node):
            self._report(Trouble("bus", self._axis.get(node), 0, f"node {node} has restarted"))

    def _emergency(self, frame: Frame) -> None:
        try:
            message = canopen.parse_emergency(frame)
        except ValueError:
            return
        axis = self._axis.get(message.node)
        if axis is None:
            return
        self.drives[axis].error_code = message.code
        passed_over = self.phase is MasterPhase.CONFIGURING or (
            self._manner.old_emergencies and self._resetting
        )
        # An emergency during configuration or a reset may be old. A fault that persists shows in
        # the statusword.
        if message.code and not passed_over:
            self._fault(axis, message.code)

    # Frames to send

    def advance(self, now: float, targets: Sequence[float]) -> list[Frame]:
        """Return the frames of one cycle: configuration, or set points (one per drive) and SYNC; a
        heartbeat when due."""
        self._now = now
        frames: list[Frame] = []
        if now >= self._beat_due:
            self._beat_due = now + HEARTBEAT_MS / 1e3
            frames.append(canopen.heartbeat(MASTER_NODE, NmtState.OPERATIONAL))
        if self.phase is MasterPhase.CONFIGURING:
            return frames + self._configure(now)
        self._supervise(now)
        wanted, resetting = self.wanted and not self._dry_run, self._resetting
        frames += [
            drive.frame(target, wanted, resetting)
            for drive, target in zip(self.drives, targets, strict=True)
        ]
        frames.append(canopen.SYNC)
        return frames

    def _clients(self) -> list[SdoClient]:
        return [*(drive.sdo for drive in self.drives), *self._sdos.values()]

    def _configure(self, now: float) -> list[Frame]:
        if self._begin_at is not None:
            if now < self._begin_at:
                return []
            self._begin_at, self._settled_at = None, now + SETTLE
            for drive in self.drives:
                drive.sdo.begin(drive.transfers(self.cycle))
            for node, client in self._sdos.items():
                client.begin(self._companions[node].transfers)
            return [canopen.nmt(NmtCommand.RESET_COMMUNICATION)]
        if now < self._settled_at:
            return []
        clients = self._clients()
        if any(client.busy for client in clients):
            return [frame for client in clients for frame in client.advance(now)]
        return self._start(now)

    def _start(self, now: float) -> list[Frame]:
        """All transfers are done: start the nodes, or report what failed and try again later."""
        wrong = [
            client.failure
            for client in self._clients()
            if client.failure and self._needed(client.node)
        ]
        wrong = wrong or [text for text in (drive.wrong() for drive in self.drives) if text]
        if wrong:
            self._report(Trouble("bus", None, 0, "; ".join(wrong)))
            self._begin_at = now + RETRY
            return []
        if self._enable_first:
            self._enable_first, self.wanted = False, True
            # The drives may have gone into a fault when their last master disappeared.
            self._resetting = True
            self.troubles.clear()
        self.phase = MasterPhase.STARTING
        for drive in self.drives:
            drive.silent, drive.spoken = 0, False
        self._heard = dict.fromkeys(self._heard, now)
        self._started.clear()
        return [canopen.nmt(NmtCommand.START)]

    # Supervision

    def _needed(self, node: int) -> bool:
        companion = self._companions.get(node)
        return companion is None or companion.needed

    def _supervise(self, now: float) -> None:
        """Check for silence and lost heartbeats, and for the end of starting and of a reset."""
        lost = self._manner.silent_cycles + 1
        answered = True
        for axis, drive in enumerate(self.drives):
            drive.silent = silent = drive.silent + 1
            if silent == lost:
                self._report(Trouble("bus", axis, 0, f"{self.names[axis]}: the drive is silent"))
            if silent > 1 or not drive.spoken:
                answered = False
            elif drive.state is _FAULT and not self._resetting:
                self._fault(axis, drive.error_code)
        if answered:
            self._seen = now
        patience = self._manner.patience
        if now - min(self._heard.values(), default=now) > patience:
            for node, heard in self._heard.items():
                if now - heard > patience and self._needed(node):
                    self._report(
                        Trouble("bus", self._axis.get(node), 0, f"node {node} is not operational")
                    )
        if self.phase is MasterPhase.STARTING and all(drive.spoken for drive in self.drives):
            self.phase = MasterPhase.RUNNING
        if self._resetting and self.enabled:
            self._resetting = False

    def _fault(self, axis: int, code: int) -> None:
        cause = "power" if code == DriveFault.UNDERVOLTAGE else "drive_fault"
        what = fault_text(code) if code else "drive in fault"
        self._report(Trouble(cause, axis, code, f"{self.names[axis]}: {what}"))

    def _report(self, trouble: Trouble) -> None:
        """Keep a trouble until a reset (each one once), and disable all drives."""
        self.wanted = False
        known = {(each.axis, each.cause, each.code) for each in self.troubles}
        if (trouble.axis, trouble.cause, trouble.code) not in known:
            self.troubles.append(trouble)
