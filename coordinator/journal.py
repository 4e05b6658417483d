"""The journal of a mission run: an append-only file of checksummed records, synced before effects leave.

Format 1. The file starts with the eight bytes `MAGIC`. Each record is a little-endian u32 length, a u32 CRC-32 of the
payload, and the payload, a msgpack array `[number, kind, data]`. Record 0 is the header (kind "header"): texts of task
file and services.toml, versions, seed. Numbers count up by one. A file that ends inside a record, or whose last record
fails its checksum, was torn by a crash: the tail is dropped and reported. A record that fails its checksum with others
behind it is damage, not a crash, and is refused.

Kinds of a mission run's journal: coordinator/recording.py. Why not SQLite: docs/decisions/journal.md has the measurement.
"""

from __future__ import annotations

import fcntl
import os
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack

MAGIC = b"PETROJ1\n"
FORMAT = 1
PREFIX = struct.Struct("<II")
LARGEST_RECORD = 1 << 24


class JournalError(Exception):
    """The journal cannot be read or written: file, place and remedy."""


@dataclass(frozen=True, slots=True)
class Record:
    """One line of a journal."""

    number: int
    kind: str
    data: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Journal:
    """A journal read back: its header, its records in order, and how many bytes of a torn tail were dropped."""

    path: Path
    header: Mapping[str, Any]
    records: tuple[Record, ...]
    torn_bytes: int
    good_bytes: int


class JournalWriter:
    """Appends records; `sync` makes all that was appended durable with one fdatasync (group commit)."""

    def __init__(self, path: Path, header: Mapping[str, Any] | None = None) -> None:
        """Create a journal with a header, or, without one, go on with an existing file behind its last good record."""
        self.path = path
        self._buffer = bytearray()
        self._unsynced = False
        """Whether records were handed to the operating system since the last sync."""
        self.syncs = 0
        if header is not None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC, 0o600)
            except FileExistsError as fault:
                raise JournalError(f"{path}: exists already; a journal is never overwritten") from fault
            except OSError as fault:
                text = f"{path}: {fault.strerror}; give --journal a folder that can be written"
                raise JournalError(text) from fault
            self._take(path)
            self._buffer += MAGIC
            self.next_number = 0
            self.append("header", {"format": FORMAT, **header})
            self.sync()
            _sync_folder(path.parent)
        else:
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)
            self._take(path)
            journal = read_journal(path)
            os.ftruncate(self._file, journal.good_bytes)
            self.next_number = len(journal.records) + 1

    def _take(self, path: Path) -> None:
        """Be the only writer for as long as this process lives: a run that goes on cannot be resumed beside itself."""
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as fault:
            os.close(self._file)
            text = f"{path}: another process writes it: the run goes on; end that process first if it hangs"
            raise JournalError(text) from fault

    def append(self, kind: str, data: Mapping[str, Any]) -> int:
        """Add a record to the next sync; gives its number."""
        number = self.next_number
        payload = msgpack.packb([number, kind, data], use_bin_type=True)
        if len(payload) > LARGEST_RECORD:
            raise JournalError(f"{self.path}: a record of {len(payload)} bytes is larger than {LARGEST_RECORD}")
        self._buffer += PREFIX.pack(len(payload), zlib.crc32(payload)) + payload
        self.next_number += 1
        return number

    @property
    def pending(self) -> bool:
        """Whether records wait for the next sync."""
        return bool(self._buffer) or self._unsynced

    @property
    def unsaved(self) -> bool:
        """Whether records would be lost with this process."""
        return bool(self._buffer)

    def flush(self) -> None:
        """Hand what was appended to the operating system: it survives the death of this process, not of the machine."""
        if not self._buffer:
            return
        self._unsynced = True
        view = memoryview(self._buffer)
        try:
            while view:
                view = view[os.write(self._file, view) :]
        except OSError as fault:
            raise JournalError(f"{self.path}: {fault.strerror}; nothing was sent on the strength of it") from fault
        finally:
            view.release()
        self._buffer.clear()

    def sync(self) -> None:
        """Make all that was appended durable; costs nothing if it is already."""
        self.flush()
        if self._unsynced:
            try:
                os.fdatasync(self._file)
            except OSError as fault:
                raise JournalError(f"{self.path}: {fault.strerror}; nothing was sent on the strength of it") from fault
            self.syncs += 1
            self._unsynced = False

    def close(self) -> None:
        """Sync and close."""
        self.sync()
        os.close(self._file)


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def read_journal(path: Path) -> Journal:
    """Read a journal; a torn tail is dropped and counted. Raises JournalError for anything worse, OSError if unreadable."""
    raw = path.read_bytes()
    if not raw.startswith(MAGIC):
        raise JournalError(
            f"{path}: not a journal of format {FORMAT}; it was written by another version or is no journal"
        )
    records: list[Record] = []
    offset = len(MAGIC)
    while (end := _record_end(raw, offset)) is not None:
        payload = raw[offset + PREFIX.size : end]
        if zlib.crc32(payload) != PREFIX.unpack_from(raw, offset)[1]:
            if end < len(raw):
                raise JournalError(
                    f"{path}: record {len(records)} at byte {offset} is damaged; restore the file from a copy"
                )
            break
        records.append(_record(path, payload, len(records)))
        offset = end
    if not records:
        raise JournalError(f"{path}: ends inside its header; the run had not begun")
    return Journal(path, records[0].data, tuple(records[1:]), len(raw) - offset, offset)


def _record_end(raw: bytes, offset: int) -> int | None:
    if offset + PREFIX.size > len(raw):
        return None
    end = offset + PREFIX.size + PREFIX.unpack_from(raw, offset)[0]
    return int(end) if end <= len(raw) else None


def _record(path: Path, payload: bytes, expected: int) -> Record:
    try:
        number, kind, data = msgpack.unpackb(payload, raw=False, strict_map_key=False)
    except (ValueError, TypeError) as fault:
        raise JournalError(f"{path}: record {expected} is no [number, kind, data]") from fault
    if number != expected:
        raise JournalError(f"{path}: record {expected} is numbered {number}; a part is missing")
    return Record(number, kind, data)
