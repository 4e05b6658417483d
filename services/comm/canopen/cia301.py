"""CANopen on classic CAN (CiA 301): identifiers, encoding of frames, and a client of expedited SDO
transfers.

Pure: times are passed in, frames are returned. The subset is NMT, heartbeat, expedited SDO, SYNC,
PDO mapping and EMCY: what drives and a node with digital inputs need. Byte order is little-endian
everywhere (CiA 301, section 7.1.4).
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import Final, NamedTuple

from msgspec import Struct

from petrobot.services.comm.canopen.bus import Frame

# The predefined connection set (CiA 301, section 7.3.3): an identifier is the base of the service
# plus the node id.
NMT_ID: Final = 0x000
SYNC_ID: Final = 0x080
EMCY_BASE: Final = 0x080
TPDO1_BASE: Final = 0x180
RPDO1_BASE: Final = 0x200
SDO_REPLY_BASE: Final = 0x580
SDO_REQUEST_BASE: Final = 0x600
HEARTBEAT_BASE: Final = 0x700
NODES: Final = range(1, 128)
"""Node ids that CiA 301 allows."""


class NmtCommand(IntEnum):
    """Commands of the NMT master (CiA 301, table 31)."""

    START = 0x01
    STOP = 0x02
    ENTER_PREOPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """States as a heartbeat reports them; BOOT_UP is sent once."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PREOPERATIONAL = 0x7F


class DataType(IntEnum):
    """Static data types with their codes in EDS files (CiA 301, table 44)."""

    BOOLEAN = 0x01
    INTEGER8 = 0x02
    INTEGER16 = 0x03
    INTEGER32 = 0x04
    UNSIGNED8 = 0x05
    UNSIGNED16 = 0x06
    UNSIGNED32 = 0x07

    def pack(self, value: int) -> bytes:
        """Return the little-endian bytes; raises ValueError if the value does not fit."""
        try:
            return _STRUCT[self].pack(value)
        except struct.error as reason:
            raise ValueError(f"{value} does not fit {self.name}") from reason

    def unpack(self, data: bytes) -> int:
        """Return the number; raises ValueError unless there are exactly as many bytes as the type
        has."""
        try:
            (value,) = _STRUCT[self].unpack(data)
        except struct.error as reason:
            raise ValueError(
                f"expected {self.size} bytes for {self.name}, got {len(data)}"
            ) from reason
        return int(value)

    @property
    def size(self) -> int:
        """Return the size in bytes."""
        return _STRUCT[self].size


_STRUCT: Final = {
    DataType.BOOLEAN: struct.Struct("<?"),
    DataType.INTEGER8: struct.Struct("<b"),
    DataType.INTEGER16: struct.Struct("<h"),
    DataType.INTEGER32: struct.Struct("<i"),
    DataType.UNSIGNED8: struct.Struct("<B"),
    DataType.UNSIGNED16: struct.Struct("<H"),
    DataType.UNSIGNED32: struct.Struct("<I"),
}


class AbortCode(IntEnum):
    """SDO abort codes (CiA 301, table 22)."""

    TOGGLE = 0x05030000
    TIMEOUT = 0x05040000
    COMMAND = 0x05040001
    ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    PDO_LENGTH = 0x06040042
    INCOMPATIBLE = 0x06040043
    HARDWARE = 0x06060000
    LENGTH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE = 0x06090030
    TOO_HIGH = 0x06090031
    TOO_LOW = 0x06090032
    GENERAL = 0x08000000
    STATE = 0x08000022


class SdoAbortError(Exception):
    """An SDO transfer was refused; `code` is an abort code of CiA 301."""

    def __init__(self, code: int, index: int = 0, sub: int = 0) -> None:
        super().__init__(code, index, sub)
        self.code = code
        self.index = index
        self.sub = sub

    def __str__(self) -> str:
        known = self.code in AbortCode._value2member_map_
        name = AbortCode(self.code).name.lower().replace("_", " ") if known else "unknown"
        return f"SDO abort {self.code:#010x} ({name}) at {self.index:#06x}:{self.sub}"


class Emergency(NamedTuple):
    """An EMCY message: error code, error register (1001h) and five manufacturer-specific bytes."""

    node: int
    code: int
    register: int
    detail: bytes


def nmt(command: NmtCommand, node: int = 0) -> Frame:
    """Return the NMT command to one node, or to all (0)."""
    return Frame(NMT_ID, bytes((command, node)))


SYNC: Final = Frame(SYNC_ID, b"")


def heartbeat(node: int, state: NmtState) -> Frame:
    """Return the heartbeat of a node; with BOOT_UP its boot-up message."""
    return Frame(HEARTBEAT_BASE + node, bytes((state,)))


def emergency(node: int, code: int, register: int, detail: bytes = b"") -> Frame:
    """Return an EMCY message; code 0 says that the error is gone."""
    return Frame(EMCY_BASE + node, struct.pack("<HB", code, register) + detail[:5].ljust(5, b"\0"))


def parse_emergency(frame: Frame) -> Emergency:
    """Decode an EMCY frame; raises ValueError if it is not one."""
    node = frame.id - EMCY_BASE
    if node not in NODES or len(frame.data) != 8:
        raise ValueError(
            f"frame {frame.id:#05x} with {len(frame.data)} bytes is not an emergency message"
        )
    code, register = struct.unpack_from("<HB", frame.data)
    return Emergency(node, code, register, frame.data[3:])


# Command byte (CiA 301, section 7.2.4.3.3): 001 in the top bits (initiate download), then the
# number of unused bytes, e = 1 (expedited), s = 1 (size indicated).
def _expedited(cob_id: int, command: int, index: int, sub: int, data: bytes) -> Frame:
    if not 1 <= len(data) <= 4:
        raise ValueError(f"an expedited transfer carries 1 to 4 bytes, not {len(data)}")
    command |= (4 - len(data)) << 2
    return Frame(cob_id, struct.pack("<BHB", command, index, sub) + data.ljust(4, b"\0"))


def sdo_write_request(node: int, index: int, sub: int, data: bytes) -> Frame:
    """Return the request of an expedited download of 1 to 4 bytes."""
    return _expedited(SDO_REQUEST_BASE + node, 0x23, index, sub, data)


def sdo_read_request(node: int, index: int, sub: int) -> Frame:
    """Return the request of an upload."""
    return Frame(SDO_REQUEST_BASE + node, struct.pack("<BHBI", 0x40, index, sub, 0))


def sdo_write_reply(node: int, index: int, sub: int) -> Frame:
    """Return the server's confirmation of a download."""
    return Frame(SDO_REPLY_BASE + node, struct.pack("<BHBI", 0x60, index, sub, 0))


def sdo_read_reply(node: int, index: int, sub: int, data: bytes) -> Frame:
    """Return the server's answer to an upload, 1 to 4 bytes."""
    return _expedited(SDO_REPLY_BASE + node, 0x43, index, sub, data)


def sdo_abort(cob_id: int, index: int, sub: int, code: int) -> Frame:
    """Return the frame that ends a transfer; `cob_id` is that of the end that aborts."""
    return Frame(cob_id, struct.pack("<BHBI", 0x80, index, sub, code))


class SdoMessage(Struct, frozen=True):
    """A decoded SDO frame; `data` holds the bytes of an expedited transfer, or the abort code."""

    command: int
    index: int
    sub: int
    data: bytes


def parse_sdo(frame: Frame) -> SdoMessage:
    """Decode an SDO frame.

    Raises ValueError if it does not have 8 bytes, SdoAbortError(COMMAND) if it is not an expedited
    transfer.
    """
    if len(frame.data) != 8:
        raise ValueError(f"SDO frame {frame.id:#05x}: expected 8 bytes, got {len(frame.data)}")
    command, index, sub = struct.unpack_from("<BHB", frame.data)
    kind = command & 0xE0
    if command in (0x40, 0x60) or command == 0x80:
        return SdoMessage(command, index, sub, frame.data[4:])
    if kind in (0x20, 0x40) and command & 0x02:
        size = 4 - (command >> 2 & 0x03) if command & 0x01 else 4
        return SdoMessage(kind, index, sub, frame.data[4 : 4 + size])
    raise SdoAbortError(AbortCode.COMMAND, index, sub)


class Mapped(Struct, frozen=True):
    """One object in a PDO."""

    index: int
    sub: int
    type: DataType

    @property
    def entry(self) -> int:
        """Return the object as 1600h and 1A00h hold it: index, sub-index, number of bits."""
        return self.index << 16 | self.sub << 8 | self.type.size * 8


def pdo_struct(mapping: Iterable[Mapped]) -> struct.Struct:
    """Return the layout of a PDO of these objects; raises ValueError beyond 8 bytes."""
    layout = struct.Struct("<" + "".join(_STRUCT[mapped.type].format[1:] for mapped in mapping))
    if layout.size > 8:
        raise ValueError(f"a PDO holds 8 bytes, these objects need {layout.size}")
    return layout


class Transfer(Struct, frozen=True):
    """One SDO transfer: a write of `value`, or a read if it is None."""

    index: int
    sub: int
    type: DataType
    value: int | None = None


PDO_OFF: Final = 1 << 31
"""Bit of a PDO's COB-ID (sub-index 1 of 1400h and 1800h) that switches it off."""


def map_pdo(
    parameters: int, mapping: int, cob_id: int, transmission: int, objects: Sequence[Mapped]
) -> list[Transfer]:
    """Return the writes that map and enable a PDO, in the order that CiA 301, section 7.5.2.36,
    requires.

    First the PDO is switched off, then its mapping is cleared, written and enabled, then the PDO is
    switched on again. `parameters` and `mapping` are the indices of its two records (1400h and
    1600h, or 1800h and 1A00h).
    """
    u8, u32 = DataType.UNSIGNED8, DataType.UNSIGNED32
    return [
        Transfer(parameters, 1, u32, cob_id | PDO_OFF),
        Transfer(parameters, 2, u8, transmission),
        Transfer(mapping, 0, u8, 0),
        *(Transfer(mapping, number, u32, mapped.entry) for number, mapped in enumerate(objects, 1)),
        Transfer(mapping, 0, u8, len(objects)),
        Transfer(parameters, 1, u32, cob_id),
    ]


class SdoClient:
    """Client of one node's SDO server: does transfers one after another, each with a timeout (s).

    `results` holds the values that were read, by (index, sub-index). `failure` says why a transfer
    failed; the remaining ones are then dropped.
    """

    def __init__(self, node: int, timeout: float = 0.5) -> None:
        self.node = node
        self.timeout = timeout
        self.results: dict[tuple[int, int], int] = {}
        self.failure = ""
        self._queue: deque[Transfer] = deque()
        self._due = 0.0
        self._asked = False

    @property
    def busy(self) -> bool:
        """Return whether transfers remain."""
        return bool(self._queue)

    def begin(self, transfers: Iterable[Transfer]) -> None:
        """Drop earlier transfers and begin these."""
        self.results, self.failure, self._asked = {}, "", False
        self._queue = deque(transfers)

    def advance(self, now: float) -> list[Frame]:
        """Return the request that is due, if any."""
        if not self._queue:
            return []
        transfer = self._queue[0]
        if self._asked:
            if now >= self._due:
                self._fail(
                    f"node {self.node}: no answer from {transfer.index:#06x}:{transfer.sub} "
                    f"within {self.timeout} s"
                )
                return [
                    sdo_abort(
                        SDO_REQUEST_BASE + self.node,
                        transfer.index,
                        transfer.sub,
                        AbortCode.TIMEOUT,
                    )
                ]
            return []
        self._asked, self._due = True, now + self.timeout
        if transfer.value is None:
            return [sdo_read_request(self.node, transfer.index, transfer.sub)]
        return [
            sdo_write_request(
                self.node, transfer.index, transfer.sub, transfer.type.pack(transfer.value)
            )
        ]

    def receive(self, frame: Frame) -> None:
        """Handle a frame of the server; answers that were not requested are ignored."""
        if not (self._queue and self._asked) or frame.id != SDO_REPLY_BASE + self.node:
            return
        transfer = self._queue[0]
        try:
            reply = parse_sdo(frame)
            if (reply.index, reply.sub) != (transfer.index, transfer.sub):
                return
            self._settle(transfer, reply)
        except (ValueError, SdoAbortError) as reason:
            self._fail(f"node {self.node}: {reason}")

    def _settle(self, transfer: Transfer, reply: SdoMessage) -> None:
        if reply.command == 0x80:
            raise SdoAbortError(int.from_bytes(reply.data, "little"), reply.index, reply.sub)
        if reply.command != (0x40 if transfer.value is None else 0x60):
            raise SdoAbortError(AbortCode.COMMAND, reply.index, reply.sub)
        if transfer.value is None:
            self.results[transfer.index, transfer.sub] = transfer.type.unpack(reply.data)
        self._queue.popleft()
        self._asked = False

    def _fail(self, why: str) -> None:
        self.failure, self._asked = why, False
        self._queue.clear()
