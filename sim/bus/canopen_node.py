"""A CANopen device (CiA 301), sans-I/O: object dictionary from an EDS file, SDO server, NMT,
heartbeats, one PDO in each direction."""

from __future__ import annotations

import configparser
import math
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from operator import itemgetter
from typing import Final

from msgspec import Struct

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import (
    HEARTBEAT_BASE,
    NMT_ID,
    PDO_OFF,
    SDO_REPLY_BASE,
    SDO_REQUEST_BASE,
    SYNC_ID,
    TPDO1_BASE,
    AbortCode,
    DataType,
    Mapped,
    NmtCommand,
    NmtState,
    SdoAbortError,
    SdoMessage,
    emergency,
    heartbeat,
    parse_sdo,
    pdo_struct,
    sdo_abort,
    sdo_read_reply,
    sdo_write_reply,
)

Key = tuple[int, int]
"""Index and sub-index of an object."""

RPDO, RPDO_MAPPING, TPDO, TPDO_MAPPING = 0x1400, 0x1600, 0x1800, 0x1A00
_PREDEFINED: Final = range(0x080, 0x100)
_SYNCHRONOUS: Final = range(241)


class Entry(Struct, frozen=True):
    """One object of the dictionary."""

    type: DataType
    access: str
    low: int
    high: int
    mappable: bool

    @property
    def writable(self) -> bool:
        """Whether an SDO client may write it."""
        return self.access.startswith(("rw", "wo"))


@cache
def _objects(eds: str) -> tuple[Mapping[Key, Entry], Mapping[Key, str]]:
    """Return objects and their default values from an EDS text; parsed once for all devices of this
    kind."""
    parser = configparser.ConfigParser(interpolation=None)
    parser.read_string(eds)
    entries: dict[Key, Entry] = {}
    defaults: dict[Key, str] = {}
    for name in parser.sections():
        index, _, sub = name.lower().partition("sub")
        if parser.has_option(name, "DataType") and len(index) == 4:
            key, section = (int(index, 16), int(sub or "0", 16)), parser[name]
            entries[key], defaults[key] = _entry(section), section.get("DefaultValue", "0")
    return entries, defaults


def _entry(section: configparser.SectionProxy) -> Entry:
    kind = DataType(int(section["DataType"], 0))
    bits = kind.size * 8
    signed = kind in (DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32)
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    return Entry(
        kind,
        section["AccessType"],
        int(section.get("LowLimit", str(low)), 0),
        int(section.get("HighLimit", str(high)), 0),
        section.get("PDOMapping", "0") == "1",
    )


class Dictionary:
    """Object dictionary of an EDS text: values by (index, sub-index), read and written as an SDO
    server does."""

    def __init__(self, eds: str, node: int) -> None:
        self.entries, defaults = _objects(eds)
        self.values: dict[Key, int] = {
            key: int(text.removeprefix("$NODEID+"), 0)
            + (node if text.startswith("$NODEID+") else 0)
            for key, text in defaults.items()
        }
        self._defaults = dict(self.values)
        self._records = {index for index, sub in self.entries if sub}

    def reset(self) -> None:
        """Set all values as at power-on."""
        self.values.update(self._defaults)

    def entry(self, index: int, sub: int) -> Entry:
        """Return the object. Raises SdoAbortError if there is none."""
        found = self.entries.get((index, sub))
        if found is None:
            known = index in self._records or (index, 0) in self.entries
            raise SdoAbortError(AbortCode.NO_SUBINDEX if known else AbortCode.NO_OBJECT, index, sub)
        return found

    def read(self, index: int, sub: int) -> bytes:
        """Return the bytes of an object's value."""
        entry = self.entry(index, sub)
        if entry.access.startswith("wo"):
            raise SdoAbortError(AbortCode.WRITE_ONLY, index, sub)
        return entry.type.pack(self.values[index, sub])

    def checked(self, index: int, sub: int, data: bytes) -> int:
        """Return the value that a write of these bytes sets. Raises SdoAbortError if it must not be
        written."""
        entry = self.entry(index, sub)
        if not entry.writable:
            raise SdoAbortError(AbortCode.READ_ONLY, index, sub)
        if len(data) != entry.type.size:
            raise SdoAbortError(
                AbortCode.TOO_LONG if len(data) > entry.type.size else AbortCode.TOO_SHORT,
                index,
                sub,
            )
        value = entry.type.unpack(data)
        if not entry.low <= value <= entry.high:
            raise SdoAbortError(
                AbortCode.TOO_HIGH if value > entry.high else AbortCode.TOO_LOW, index, sub
            )
        return value


class Pdo:
    """A PDO's COB-ID, transmission type and layout, kept consistent with its two records of the
    dictionary."""

    def __init__(self, dictionary: Dictionary, parameters: int, mapping: int) -> None:
        self._values = dictionary.values
        self._dictionary = dictionary
        self.parameters, self.mapping = parameters, mapping
        self.exists = (parameters, 1) in dictionary.entries
        self.keys: tuple[Key, ...] = ()
        self.refresh()

    def refresh(self) -> None:
        """Read the records of the dictionary again."""
        if not self.exists:
            self.on, self.cob_id, self.synchronous = False, -1, False
            return
        cob_id = self._values[self.parameters, 1]
        self.on, self.cob_id = not cob_id & PDO_OFF, cob_id & 0x7FF
        self.synchronous = self._values[self.parameters, 2] in _SYNCHRONOUS
        objects = [
            self.mapped(self._values[self.mapping, n])
            for n in range(1, self._values[self.mapping, 0] + 1)
        ]
        self.layout = pdo_struct(objects)
        self.keys = tuple((mapped.index, mapped.sub) for mapped in objects)
        self._mapped = itemgetter(*self.keys) if len(self.keys) > 1 else None

    def pack(self) -> bytes:
        """Return the values of the mapped objects as they are sent."""
        values = self._values
        many = self._mapped
        return self.layout.pack(
            *([values[key] for key in self.keys] if many is None else many(values))
        )

    def mapped(self, entry: int) -> Mapped:
        """Decode a mapping entry. Raises SdoAbortError if the object cannot be mapped."""
        index, sub, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        found = self._dictionary.entry(index, sub)
        if not found.mappable or found.type.size * 8 != bits:
            raise SdoAbortError(AbortCode.NOT_MAPPABLE, self.mapping)
        if self.parameters == RPDO and not found.writable:
            raise SdoAbortError(AbortCode.NOT_MAPPABLE, self.mapping)
        return Mapped(index, sub, found.type)

    def check(self, index: int, sub: int, value: int) -> None:
        """Raise SdoAbortError if one of the PDO's records must not get this value now (CiA 301,
        7.5.2.35 and 36)."""
        if index == self.mapping and (self.on or (sub and self._values[index, 0])):
            raise SdoAbortError(AbortCode.STATE, index, sub)
        if index == self.mapping and sub == 0 and value:
            objects = [self.mapped(self._values[index, number]) for number in range(1, value + 1)]
            if sum(mapped.type.size for mapped in objects) > 8:
                raise SdoAbortError(AbortCode.PDO_LENGTH, index, sub)
        if index == self.mapping and sub and value:
            self.mapped(value)
        if (
            index == self.parameters
            and sub == 1
            and self.on
            and not value & PDO_OFF
            and value & 0x7FF != self.cob_id
        ):
            raise SdoAbortError(AbortCode.VALUE, index, sub)


class CanopenNode:
    """One device on the bus. Subclasses override `before_sending`, `after_receiving` and the other
    hooks.

    Times are seconds on the caller's clock; `drain` returns the frames to send.
    """

    def __init__(self, node: int, eds: str) -> None:
        self.node = node
        self.dictionary = Dictionary(
            (files("petrobot.services.comm.canopen.eds") / eds).read_text(encoding="utf-8"), node
        )
        self.values = self.dictionary.values
        self.rpdo = Pdo(self.dictionary, RPDO, RPDO_MAPPING)
        self.tpdo = Pdo(self.dictionary, TPDO, TPDO_MAPPING)
        self.nmt = NmtState.BOOT_UP
        self.outbox: list[Frame] = []
        self._latched: bytes | None = None
        self._applied: bytes | None = None
        self._tpdo_frame: Frame | None = None
        self._beat_due = 0.0
        self._master_due: float | None = None

    # What a device adds.
    def before_sending(self) -> None:
        """Update the objects that a TPDO may contain; call `changed` if one of them has changed."""

    def before_reading(self) -> None:
        """Update all objects that change by themselves."""
        self.before_sending()

    def after_configuring(self) -> None:
        """Use what an SDO write has changed."""

    def after_receiving(self, now: float) -> None:
        """Act on the objects that an RPDO or an SDO write has just set."""

    def on_sync(self, now: float) -> None:
        """Act on SYNC, after a synchronous RPDO was applied and before the TPDO is built."""

    def on_master_lost(self, now: float) -> None:
        """Act on a missing heartbeat (1016h)."""

    def on_nmt(self, now: float, before: NmtState) -> None:
        """Act on a change of the NMT state; after power-on or a reset it was BOOT_UP before."""

    def check_write(self, index: int, sub: int, value: int) -> None:
        """Raise SdoAbortError if the device's state forbids this write."""

    # The machine.
    def boot(self, now: float) -> None:
        """Power on or reset: defaults, boot-up message, pre-operational."""
        self.dictionary.reset()
        self.rpdo.refresh()
        self.tpdo.refresh()
        self.after_configuring()
        self._latched, self._master_due, self._beat_due = None, None, now
        self._applied = None
        self.changed()
        self.outbox.append(heartbeat(self.node, NmtState.BOOT_UP))
        self.nmt = NmtState.PREOPERATIONAL
        self.on_nmt(now, NmtState.BOOT_UP)

    def receive(self, now: float, frame: Frame) -> None:
        """Process a frame from the bus."""
        cob_id = frame.id
        if cob_id == self.rpdo.cob_id and self.rpdo.on:
            self.take_rpdo(now, frame.data)
        elif cob_id == SYNC_ID:
            self.sync(now)
        elif cob_id == SDO_REQUEST_BASE + self.node:
            self._serve(now, frame)
        elif cob_id == NMT_ID and len(frame.data) == 2 and frame.data[1] in (0, self.node):
            self._order(now, frame.data[0])
        elif (
            cob_id > HEARTBEAT_BASE
            and cob_id - HEARTBEAT_BASE == self.values[0x1016, 1] >> 16 & 0x7F
        ):
            self._master_due = now + (self.values[0x1016, 1] & 0xFFFF) / 1e3

    def advance(self, now: float) -> None:
        """Send the heartbeat that is due, and watch that of the master."""
        period = self.values[0x1017, 0]
        if period and now >= self._beat_due and self.nmt is not NmtState.BOOT_UP:
            self.outbox.append(heartbeat(self.node, self.nmt))
            self._beat_due = now + period / 1e3
        if self._master_due is not None and now > self._master_due:
            self._master_due = None
            self.on_master_lost(now)

    def due(self) -> float:
        """Return when `advance` has something to do next, as far as is known now (s)."""
        beat = self._beat_due if self.values[0x1017, 0] else math.inf
        return beat if self._master_due is None else min(beat, self._master_due)

    def drain(self) -> Sequence[Frame]:
        """Return the frames to send, oldest first."""
        frames, self.outbox = self.outbox, []
        return frames

    def report(self, code: int, register: int) -> None:
        """Send EMCY (not while stopped)."""
        self.values[0x1001, 0] = register
        if self.nmt in (NmtState.OPERATIONAL, NmtState.PREOPERATIONAL):
            self.outbox.append(emergency(self.node, code, register))

    def send_tpdo(self) -> None:
        """Send the TPDO now, if it is on and the node operational."""
        if self.nmt is NmtState.OPERATIONAL and self.tpdo.on:
            self.before_sending()
            frame = self._tpdo_frame
            if frame is None:
                self._tpdo_frame = frame = Frame(self.tpdo.cob_id, self.tpdo.pack())
            self.outbox.append(frame)

    def changed(self) -> None:
        """Note that the content of a TPDO may have changed."""
        self._tpdo_frame = None

    def take_rpdo(self, now: float, data: bytes) -> None:
        """Keep the data of an RPDO until SYNC, or obey at once if it is not synchronous."""
        if self.nmt is not NmtState.OPERATIONAL:
            return
        if len(data) < self.rpdo.layout.size:
            self.report(0x8210, 0x11)  # PDO not processed: too short
            return
        self._latched = data
        if not self.rpdo.synchronous:
            self._apply_rpdo(now)

    def _apply_rpdo(self, now: float) -> None:
        data = self._latched
        if data is None:
            return
        self._latched = None
        if data != self._applied:
            self._applied = data
            self.values.update(zip(self.rpdo.keys, self.rpdo.layout.unpack_from(data), strict=True))
        self.after_receiving(now)

    def sync(self, now: float) -> None:
        """Process SYNC."""
        if self.nmt is NmtState.OPERATIONAL:
            if self._latched is not None:
                self._apply_rpdo(now)
            self.on_sync(now)
            if self.tpdo.synchronous:
                self.send_tpdo()

    def _order(self, now: float, command: int) -> None:
        before = self.nmt
        if command in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION):
            self.boot(now)
            return
        states = {
            NmtCommand.START: NmtState.OPERATIONAL,
            NmtCommand.STOP: NmtState.STOPPED,
            NmtCommand.ENTER_PREOPERATIONAL: NmtState.PREOPERATIONAL,
        }
        after = next((state for order, state in states.items() if order == command), None)
        if after is not None and after is not before:
            self.nmt = after
            self.on_nmt(now, before)

    def _serve(self, now: float, frame: Frame) -> None:
        """Serve SDO requests, expedited transfers only."""
        if self.nmt is NmtState.STOPPED or len(frame.data) != 8:
            return
        index, sub = frame.data[1] | frame.data[2] << 8, frame.data[3]
        try:
            request = parse_sdo(frame)
            if request.command != 0x80:
                self.outbox.append(self._answer(now, request))
        except SdoAbortError as reason:
            self.outbox.append(sdo_abort(SDO_REPLY_BASE + self.node, index, sub, reason.code))

    def _answer(self, now: float, request: SdoMessage) -> Frame:
        index, sub, data = request.index, request.sub, request.data
        if request.command == 0x40:
            self.dictionary.entry(index, sub)
            self.before_reading()
            return sdo_read_reply(self.node, index, sub, self.dictionary.read(index, sub))
        if request.command != 0x20:
            raise SdoAbortError(AbortCode.COMMAND, index, sub)
        self._write(now, index, sub, data)
        return sdo_write_reply(self.node, index, sub)

    def _write(self, now: float, index: int, sub: int, data: bytes) -> None:
        value = self.dictionary.checked(index, sub, data)
        pdo = {
            RPDO: self.rpdo,
            RPDO_MAPPING: self.rpdo,
            TPDO: self.tpdo,
            TPDO_MAPPING: self.tpdo,
        }.get(index)
        if pdo is not None:
            pdo.check(index, sub, value)
        if (index, sub) in ((RPDO, 1), (TPDO, 1)) and not self._may_use(value & 0x7FF):
            raise SdoAbortError(AbortCode.VALUE, index, sub)
        self.check_write(index, sub, value)
        self.values[index, sub] = value
        self._applied = None
        self.changed()
        if pdo is not None and (sub == 0 or index == pdo.parameters):
            pdo.refresh()
        if (index, sub) == (0x1016, 1):
            self._master_due = None  # Watched from the next heartbeat on.
        self.after_configuring()
        self.after_receiving(now)

    @staticmethod
    def _may_use(cob_id: int) -> bool:
        """Return whether a PDO may have this identifier: not one of NMT, SYNC, EMCY, SDO and
        heartbeat (CiA 301, table 54)."""
        return TPDO1_BASE < cob_id < SDO_REPLY_BASE and cob_id not in _PREDEFINED
