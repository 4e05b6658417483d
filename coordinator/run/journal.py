"""The journal of a mission run: an append-only file of checksummed records, synced before effects
leave.

Format 1. The file starts with the eight bytes `MAGIC`. Each record is a little-endian u32 length, a
u32 CRC-32 of the payload, and the payload, a msgpack array `[number, kind, data]`. Record 0 is the
header (kind "header"): texts of task file and services.toml, versions, seed. Numbers count up by
one. A file that ends inside a record, or whose last record fails its checksum, was torn by a crash:
the tail is dropped and reported (also one of zeros, which a file system may leave after a power
cut). A record that cannot be read and is followed by whole records means damage: the file is
refused.

Kinds of a mission run's journal: coordinator/run/recording.py. Why not SQLite:
docs/decisions/journal.md has the measurement.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import struct
import time
import zlib
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from threading import Lock
from typing import Any

import msgpack
from msgspec import Struct

from petrobot.coordinator.run.folder import date_back
from petrobot.services.host.toml_text import InputError
from petrobot.services.host.whole_file import make_folder, sync_folder

FORMAT = 1
MAGIC = b"PETROJ%d\n" % FORMAT
_FAMILY = re.compile(rb"PETROJ(\d+)\n")
PREFIX = struct.Struct("<II")
SMALLEST_RECORD, LARGEST_RECORD = 4, 1 << 25
"""Sizes of a record's payload (bytes). The largest message of a node must fit into a record."""
_ARRAY_OF_THREE = 0x93


class JournalError(InputError):
    """The journal cannot be read or written: file, place and remedy."""


class Record(Struct, frozen=True):
    """One line of a journal."""

    number: int
    kind: str
    data: Mapping[str, Any]


class Journal(Struct, frozen=True):
    """A journal read back: its header, its records in order, and how many bytes of a torn tail were
    dropped."""

    path: Path
    header: Mapping[str, Any]
    records: tuple[Record, ...]
    torn_bytes: int
    good_bytes: int


class JournalWriter:
    """Appends records; `sync` makes all that was appended durable with one fdatasync (group
    commit). A disk may need seconds for that, so `sync` may run in another thread meanwhile."""

    def __init__(self, path: Path, header: Mapping[str, Any] | None = None) -> None:
        """Create a journal with a header or, without one, continue an existing file after its last
        good record."""
        self.path = path
        self._at = path.absolute()  # an action in this process may change the working directory
        self._appended = deque[bytes]()
        """Records that no thread has begun to write."""
        self._buffer = bytearray()
        """What `_write` has to write; `_writing` is its lock."""
        self._written = self._durable = 0
        """How many times records were written to the file, and how many of these are durable."""
        self._torn: int | None = None
        """Where to cut the file before anything is appended; None: nowhere."""
        self._writing, self._syncing = Lock(), Lock()
        self.syncs = 0
        self.stood = 0.0
        """Longest time that `flush` took (s)."""
        if header is not None:
            try:
                make_folder(path.parent)
                self._file = os.open(
                    path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o600
                )
            except FileExistsError as fault:
                raise JournalError(
                    f"{path}: exists already; a journal is never overwritten"
                ) from fault
            except OSError as fault:
                _remove_empty(path.parent)
                text = f"{path}: {fault.strerror}; give --journal a folder that can be written"
                raise JournalError(text) from fault
            self._take(path)
            date_back(path.parent.parent)
            self._appended.append(MAGIC)
            self.next_number = 0
            self.append("header", {"format": FORMAT, **header})
            try:
                self.sync()
            except JournalError as fault:
                os.close(self._file)
                path.unlink(missing_ok=True)  # the run has not begun: leave nothing behind
                _remove_empty(path.parent)
                raise JournalError(
                    f"{fault}; give --journal a folder that can be written"
                ) from fault
            sync_folder(path.parent)
        else:
            self.found = self._go_on(path)
            self.next_number = len(self.found.records) + 1
            self._torn = self.found.good_bytes if self.found.torn_bytes else None

    def _go_on(self, path: Path) -> Journal:
        """Become the writer of an existing journal, and read it. It does not change until something
        is appended."""
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)
        except OSError as fault:
            raise JournalError(
                f"{path}: {fault.strerror}; a run can be continued only if its journal is writable"
            ) from fault
        self._take(path)
        try:
            return read_journal(path)
        except BaseException:
            os.close(self._file)
            raise

    def _take(self, path: Path) -> None:
        """Lock the file for this process: an active run cannot be resumed a second time."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as fault:
            os.close(self._file)
            text = (
                f"{path}: another process writes it: the run is still active; end that process "
                "first if it hangs"
            )
            raise JournalError(text) from fault

    def append(self, kind: str, data: Mapping[str, Any]) -> int:
        """Add a record to the next sync, and return its number."""
        number = self.next_number
        payload = msgpack.packb([number, kind, data], use_bin_type=True)
        if len(payload) > LARGEST_RECORD:
            raise JournalError(
                f"{self.path}: a record of {len(payload)} bytes is larger than {LARGEST_RECORD}"
            )
        self._appended.append(PREFIX.pack(len(payload), zlib.crc32(payload)) + payload)
        self.next_number += 1
        return number

    def cut(self, number: int) -> None:
        """Drop a record and all after it when the next ones are written. Nothing may wait to be
        written."""
        assert not self.unsaved
        raw, offset = self.path.read_bytes(), len(MAGIC)
        for _ in range(number):
            payload = _payload(raw, offset)
            assert payload is not None
            offset += PREFIX.size + len(payload)
        self._torn, self.next_number = offset, number

    @property
    def pending(self) -> bool:
        """Whether records wait for the next sync."""
        return self.unsaved or self._durable < self._written

    @property
    def unsaved(self) -> bool:
        """Whether records would be lost with this process."""
        return bool(self._appended or self._buffer)

    def flush(self) -> bool:
        """Write what was appended to the file: it survives the end of this process, but not a power
        cut. Returns False, without waiting, while another thread writes. Raises JournalError, also
        if the file is no longer where a resume would look for it."""
        if not self._writing.acquire(blocking=False):
            return False
        began = time.monotonic()
        try:
            self._write()
        finally:
            self._writing.release()
            self.stood = max(self.stood, time.monotonic() - began)
        return True

    def sync(self) -> None:
        """Make all that was appended durable; does nothing if it already is. Raises as `flush`."""
        with self._syncing:
            with self._writing:
                self._write()
                written = self._written
            if self._durable == written:
                return
            try:
                os.fdatasync(self._file)
            except OSError as fault:
                raise self._refused(fault) from fault
            self.syncs += 1
            self._durable = written

    def _write(self) -> None:
        if not self.unsaved:
            return
        self._written += 1  # before the records are taken: `pending` holds in every thread
        while self._appended:
            self._buffer += self._appended.popleft()
        try:
            if self._torn is not None:
                os.ftruncate(self._file, self._torn)
                self._torn = None
            # A full disk may take a part: another try continues after it.
            while self._buffer:
                del self._buffer[: os.write(self._file, self._buffer)]
            kept = os.path.samestat(os.fstat(self._file), self._at.stat())
        except FileNotFoundError:
            kept = False
        except OSError as fault:
            raise self._refused(fault) from fault
        if not kept:
            # The open file has lost its name, so no resume would ever find what is written to it.
            raise JournalError(
                f"{self.path}: removed, moved or replaced while its run was active; nothing was "
                "sent on the strength of its last records; put it back"
            )

    def _refused(self, fault: OSError) -> JournalError:
        return JournalError(
            f"{self.path}: {fault.strerror}; nothing was sent on the strength of it"
        )

    def close(self) -> None:
        """Sync and close; the file is closed even if the sync fails. If the disk does not answer
        another thread's sync, it would not answer this one: the file stays open, and locked."""
        if self._syncing.locked():
            return
        try:
            self.sync()
        finally:
            os.close(self._file)
            date_back(self.path.parent.parent)


def _remove_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):  # there is something else in it
        folder.rmdir()


def read_journal(path: Path) -> Journal:
    """Read a journal; a torn tail is dropped and counted. Raises JournalError for any other damage,
    and OSError."""
    try:
        raw = path.read_bytes()
    except PermissionError as fault:
        text = f"{path.parent.name} was started by another user, who alone can read its journal"
        raise JournalError(text) from fault
    if not raw.startswith(MAGIC):
        raise JournalError(f"{path}: {_foreign(raw)}")
    records: list[Record] = []
    offset = len(MAGIC)
    while (payload := _payload(raw, offset)) is not None:
        records.append(_record(path, payload, len(records)))
        offset += PREFIX.size + len(payload)
    if (behind := _next_record(raw, offset + 1, len(records))) is not None:
        text = (
            f"record {len(records)} at byte {offset} is damaged: record {behind} behind it is whole"
        )
        raise JournalError(f"{path}: {text}; restore the file from a copy")
    if not records:
        raise JournalError(f"{path}: ends inside its header; the run had not begun")
    written = records[0].data.get("format", FORMAT)
    if written != FORMAT:
        raise JournalError(f"{path}: {_other_format(written)}")
    return Journal(path, records[0].data, tuple(records[1:]), len(raw) - offset, offset)


def read_header(path: Path) -> Mapping[str, Any]:
    """Return the header of a journal without reading the rest. Raises JournalError, OSError."""
    start = len(MAGIC) + PREFIX.size
    with path.open("rb") as file:
        raw = file.read(start)
        if raw.startswith(MAGIC) and len(raw) == start:
            raw += file.read(PREFIX.unpack_from(raw, len(MAGIC))[0])
    payload = _payload(raw, len(MAGIC)) if raw.startswith(MAGIC) else None
    if payload is None:
        raise JournalError(f"{path}: has no whole header; the run had not begun")
    return _record(path, payload, 0).data


def _foreign(raw: bytes) -> str:
    """Return what a file is that does not begin like a journal of this format."""
    known = _FAMILY.match(raw)
    if known is None:
        return "not a journal of a mission run"
    return _other_format(int(known[1]))


def _other_format(written: object) -> str:
    remedy = (
        "a newer petrobot"
        if isinstance(written, int) and written > FORMAT
        else "the petrobot that wrote it"
    )
    return f"a journal of format {written}, and this petrobot reads format {FORMAT}; use {remedy}"


def _payload(raw: bytes, offset: int) -> bytes | None:
    """Return the payload of the whole record that begins there; None if there is none."""
    if offset + PREFIX.size > len(raw):
        return None
    length, checksum = PREFIX.unpack_from(raw, offset)
    begin = offset + PREFIX.size
    if not SMALLEST_RECORD <= length <= min(LARGEST_RECORD, len(raw) - begin):
        return None
    payload = raw[begin : begin + length]
    return payload if zlib.crc32(payload) == checksum else None


def _next_record(raw: bytes, offset: int, after: int) -> int | None:
    """Return the number of the first whole record from there on that comes after record `after`;
    None if there is none."""
    for begin in range(offset, len(raw) - PREFIX.size):
        payload = _payload(raw, begin)
        if payload is not None and payload[0] == _ARRAY_OF_THREE:
            number = msgpack.unpackb(payload, raw=False, strict_map_key=False)[0]
            if number > after:
                return int(number)
    return None


def _record(path: Path, payload: bytes, expected: int) -> Record:
    try:
        number, kind, data = msgpack.unpackb(payload, raw=False, strict_map_key=False)
    except (ValueError, TypeError) as fault:
        raise JournalError(f"{path}: record {expected} is no [number, kind, data]") from fault
    if number != expected:
        raise JournalError(f"{path}: record {expected} is numbered {number}; a part is missing")
    return Record(number, kind, data)
