"""Attacks on the journal: cut at every byte, damaged, of another version, on a disk that is full or
read-only."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.cli.options import recorded
from petrobot.coordinator.engine import Begin, Engine
from petrobot.coordinator.launch import resumed_mission
from petrobot.coordinator.run.journal import (
    MAGIC,
    PREFIX,
    JournalError,
    JournalWriter,
    read_journal,
)
from petrobot.coordinator.run.recording import JournalStore, ReplayError
from petrobot.services.comm.protocol import messages as m
from petrobot.services.host.toml_text import InputError
from tests.run.toy_arm import WORK, Bench
from tests.waiting import Limit

GOLDEN = Path(__file__).parent / "golden" / "catch_ball-missed-and-recovered.journal"


def copy(folder: Path, content: bytes) -> Path:
    """Make a run's folder with this journal."""
    path = folder / "run.journal"
    path.write_bytes(content)
    return path


def bounds(raw: bytes) -> list[int]:
    """Return the offset at which each record of a whole journal ends."""
    ends, offset, limit = [], len(MAGIC), Limit("the end of the journal", steps=len(raw))
    while offset < len(raw) and limit.left():
        offset += PREFIX.size + PREFIX.unpack_from(raw, offset)[0]
        ends.append(offset)
    return ends


def test_cut_at_any_byte_whole_records_are_read_and_the_torn_one_is_reported(
    tmp_path: Path,
) -> None:
    """Cut at each byte of the last ten records, and inside the header: nothing is guessed, and only
    the torn record is lost."""
    raw = GOLDEN.read_bytes()
    ends = bounds(raw)
    header, first = ends[0], ends[-11]
    for cut in [*range(0, header, 97), *range(first, len(raw) + 1)]:
        path = copy(tmp_path, raw[:cut])
        if cut < header:
            with pytest.raises(JournalError, match=r"ends inside its header|not a journal"):
                read_journal(path)
            continue
        journal = read_journal(path)
        whole = [end for end in ends if end <= cut]
        assert (journal.good_bytes, journal.torn_bytes) == (whole[-1], cut - whole[-1])
        assert len(journal.records) == len(whole) - 1


def test_a_journal_cut_between_records_replays(tmp_path: Path) -> None:
    """Replay of the part that is left gives the same markings as replay of the whole journal."""
    raw = GOLDEN.read_bytes()
    everything = list(recorded(str(copy(tmp_path, raw))).steps())
    for end in bounds(raw)[:: max(1, len(bounds(raw)) // 8)]:
        steps = list(recorded(str(copy(tmp_path, raw[: end + 3]))).steps())
        assert steps == everything[: len(steps)]


@pytest.mark.parametrize("bit", [0, 7, 31])
def test_a_bit_of_a_length_is_damage_and_not_a_torn_tail(tmp_path: Path, bit: int) -> None:
    """A length that points beyond the end must not be taken for a crash: all records after it would
    be cut off with the next append."""
    raw = bytearray(GOLDEN.read_bytes())
    begin = bounds(bytes(raw))[4]
    raw[begin + bit // 8] ^= 1 << bit % 8
    path = copy(tmp_path, bytes(raw))
    with pytest.raises(
        JournalError, match=r"record 5 at byte \d+ is damaged: record \d+ behind it is whole"
    ):
        JournalWriter(path)
    assert path.read_bytes() == raw, "nothing is mended by guess"


def test_a_tail_of_zeros_is_torn(tmp_path: Path) -> None:
    """The file system may have made the file longer, but not written the data before the power
    failed."""
    raw = GOLDEN.read_bytes()
    journal = read_journal(copy(tmp_path, raw + bytes(5000)))
    assert journal.torn_bytes == 5000 and len(journal.records) == len(bounds(raw)) - 1


@pytest.mark.parametrize(
    ("magic", "says"),
    [
        (
            b"PETROJ2\n",
            "a journal of format 2, and this petrobot reads format 1; use a newer petrobot",
        ),
        (b"PETROJ0\n", "format 0, .*use the petrobot that wrote it"),
        (b"SQLite f", "not a journal of a mission run"),
    ],
)
def test_another_format_is_named_with_its_remedy(tmp_path: Path, magic: bytes, says: str) -> None:
    """Replay, log and resume end with one line, and leave the file unchanged."""
    path = copy(tmp_path, magic + GOLDEN.read_bytes()[8:])
    before = path.read_bytes()
    with pytest.raises(InputError, match=says):
        recorded(str(path))
    with pytest.raises(JournalError, match=says):
        JournalWriter(path)
    assert path.read_bytes() == before


def test_a_header_of_another_format_is_refused(tmp_path: Path) -> None:
    """The header names the format, too."""
    JournalWriter(tmp_path / "run.journal", {"format": 7}).close()
    with pytest.raises(JournalError, match="format 7"):
        read_journal(tmp_path / "run.journal")


def test_an_incomplete_header_is_refused(tmp_path: Path) -> None:
    """The journal was written by another tool."""
    JournalWriter(tmp_path / "run.journal", {"mission": "m"}).close()
    with pytest.raises(InputError, match="its header has no 'mode'"):
        recorded(str(tmp_path))


def test_an_impossible_resume_leaves_the_journal_unchanged(tmp_path: Path) -> None:
    """A stimulus that only a newer petrobot knows, or another task, is refused before anything is
    written or cut."""
    raw = GOLDEN.read_bytes()
    path = copy(tmp_path, raw[: bounds(raw)[-1] - 3])
    found = recorded(str(path))
    writer = JournalWriter(path)
    writer.append(
        "stimulus", {"t": 1.0, "stimulus": {"kind": "Teleport"}, "marking": [], "instructions": 0}
    )
    writer.close()
    before = path.read_bytes()
    with pytest.raises(JournalError, match="holds no stimulus: 'Teleport' is none of"):
        resumed_mission(found.directory, found.task, found.engine, found.journal, [], 0.0)
    assert path.read_bytes() == before
    path = copy(tmp_path, raw)
    other = Engine(found.task, dict.fromkeys(found.directory.actions, "elsewhere"))
    with pytest.raises(ReplayError):
        resumed_mission(found.directory, found.task, other, found.journal, [], 0.0)
    assert path.read_bytes() == raw


def test_a_read_only_journal_is_one_error_with_its_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Read-only file system: one error with the path, no traceback."""
    path = copy(tmp_path, GOLDEN.read_bytes())

    def refused(*given: Any, **more: Any) -> int:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("petrobot.coordinator.run.journal.os.open", refused)
    with pytest.raises(
        JournalError,
        match=r"run\.journal: Read-only file system; a run can be continued only if",
    ):
        JournalWriter(path)


class SmallDisk:
    """`os.write` on a disk with room for so many bytes."""

    def __init__(self, room: int) -> None:
        self.room = room
        self._write = os.write

    def __call__(self, file: int, data: Any) -> int:
        taken = min(self.room, len(data))
        if not taken:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.room -= taken
        return self._write(file, bytes(data[:taken]))


@pytest.mark.parametrize("room", [0, 1, 7, 8, 30, 45])
def test_a_partly_written_record_is_completed_once_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    """Wherever a write stops: once there is room again, each record is in the file once and
    whole."""
    writer = JournalWriter(tmp_path / "run.journal", {})
    disk = SmallDisk(room)
    monkeypatch.setattr("petrobot.coordinator.run.journal.os.write", disk)
    for number in range(3):
        writer.append("n", {"n": number})
    with pytest.raises(
        JournalError, match=r"No space left on device; nothing was sent on the strength of it"
    ):
        writer.sync()
    assert writer.pending
    disk.room = 10_000
    writer.close()
    journal = read_journal(tmp_path / "run.journal")
    assert [record.data["n"] for record in journal.records] == [0, 1, 2] and not journal.torn_bytes


def full(folder: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Bench, Callable[[], None]]:
    """Return an arm at work, a coordinator whose disk is full from now on, and a function that
    makes room again."""
    writer = JournalWriter(folder / "run.journal", {"mission": "m"})
    bench = Bench(store=JournalStore(writer, 0.0)).begin()
    disk = SmallDisk(5)
    monkeypatch.setattr("petrobot.coordinator.run.journal.os.write", disk)

    def room() -> None:
        disk.room = 10_000

    return bench, room


def test_with_a_full_disk_nothing_is_sent_that_is_not_recorded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run's end cannot be journaled: tidy is not called, and the end is not acknowledged, so
    its node keeps it."""
    bench, _ = full(tmp_path, monkeypatch)
    with pytest.raises(JournalError, match="No space left"):
        bench.say(1.0, m.Outcome(WORK, "success"))
    assert bench.sent(m.Call, m.ResultAck) == []
    bench.executor.stimulate(1.1, Begin())  # leads to no order, so it is written later
    with pytest.raises(JournalError):
        bench.go(1.7)
    assert bench.sent(m.Call, m.ResultAck) == []
    journal = read_journal(tmp_path / "run.journal")
    stimuli = [r.data["stimulus"]["kind"] for r in journal.records if r.kind == "stimulus"]
    assert stimuli == ["Begin"], "the run's start led to no order"
