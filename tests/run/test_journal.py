"""The journal's file: records that were synced are read back, a torn tail is dropped and counted,
damage is refused."""

from __future__ import annotations

import os
import signal
import stat
import struct
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path

import msgpack
import pytest
from hypothesis import given, strategies as st

from petrobot.coordinator.run.journal import MAGIC, JournalError, JournalWriter, read_journal
from petrobot.services.comm.protocol.codec import LIMITS, encode
from petrobot.services.comm.protocol.messages import Outcome

PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**60), 2**60)
    | st.floats(allow_nan=False)
    | st.text(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=8,
)
RECORDS = st.lists(
    st.tuples(
        st.text(min_size=1, max_size=8), st.dictionaries(st.text(max_size=5), PLAIN, max_size=3)
    ),
    max_size=6,
)


def written(folder: Path, records: list[tuple[str, dict[str, object]]]) -> Path:
    """Write a journal with these records and close it."""
    path = folder / "run.journal"
    writer = JournalWriter(path, {"task": "t"})
    for kind, data in records:
        writer.append(kind, data)
    writer.close()
    return path


@given(RECORDS)
def test_records_are_read_back(records: list[tuple[str, dict[str, object]]]) -> None:
    """Records come back in order, with their numbers."""
    with tempfile.TemporaryDirectory() as folder:
        journal = read_journal(written(Path(folder), records))
        assert [(r.kind, r.data) for r in journal.records] == records
        assert [r.number for r in journal.records] == list(range(1, len(records) + 1))
        assert journal.header["task"] == "t" and journal.torn_bytes == 0


@given(RECORDS, st.data())
def test_a_torn_tail_is_dropped_and_writing_continues(
    records: list[tuple[str, dict[str, object]]], data: st.DataObject
) -> None:
    """Wherever the file is cut, the whole records before the cut remain, and a writer appends after
    them."""
    with tempfile.TemporaryDirectory() as folder:
        path = written(Path(folder), records)
        raw = path.read_bytes()
        header = len(written(Path(folder) / "empty", []).read_bytes())
        cut = data.draw(st.integers(header, len(raw)))
        path.write_bytes(raw[:cut])
        journal = read_journal(path)
        assert journal.torn_bytes == cut - journal.good_bytes
        assert [(r.kind, r.data) for r in journal.records] == records[: len(journal.records)]
        writer = JournalWriter(path)
        writer.append("more", {"n": 1})
        writer.close()
        again = read_journal(path)
        assert again.torn_bytes == 0 and len(again.records) == len(journal.records) + 1
        assert again.records[-1].kind == "more"


def test_bytes_of_a_record(tmp_path: Path) -> None:
    """The format, byte by byte."""
    path = written(tmp_path, [("k", {"a": 1})])
    raw = path.read_bytes()
    assert raw.startswith(b"PETROJ1\n")
    payload = b"\x93\x01\xa1k\x81\xa1a\x01"
    assert raw.endswith(struct.pack("<II", len(payload), zlib.crc32(payload)) + payload)
    assert msgpack.unpackb(payload) == [1, "k", {"a": 1}]


def test_damage_in_the_middle_is_refused(tmp_path: Path) -> None:
    """A flipped bit followed by records is not a torn tail."""
    path = written(tmp_path, [("a", {"x": "yyyy"}), ("b", {})])
    raw = bytearray(path.read_bytes())
    raw[raw.index(b"yyyy")] ^= 1
    path.write_bytes(raw)
    with pytest.raises(JournalError, match="damaged"):
        read_journal(path)


def test_a_flipped_last_record_counts_as_torn(tmp_path: Path) -> None:
    """After a crash the last record may have its length but not its content."""
    path = written(tmp_path, [("a", {}), ("b", {"x": "yyyy"})])
    raw = bytearray(path.read_bytes())
    raw[raw.index(b"yyyy")] ^= 1
    path.write_bytes(raw)
    journal = read_journal(path)
    assert [r.kind for r in journal.records] == ["a"] and journal.torn_bytes > 0


@pytest.mark.parametrize(
    "content", [b"", b"hello world, no journal", MAGIC, MAGIC + b"\x10\x00\x00\x00"]
)
def test_a_file_that_is_not_a_journal_is_refused(tmp_path: Path, content: bytes) -> None:
    """A file of another kind, an empty one, and one whose beginning is missing."""
    path = tmp_path / "x.journal"
    path.write_bytes(content)
    with pytest.raises(JournalError, match=r"x\.journal"):
        read_journal(path)


def test_never_overwritten(tmp_path: Path) -> None:
    """A second run under the same id is refused."""
    path = written(tmp_path, [])
    with pytest.raises(JournalError, match="exists already"):
        JournalWriter(path, {})


def test_a_journal_has_one_writer_at_a_time(tmp_path: Path) -> None:
    """A run that is still active is not resumed; after its process has closed the journal, it
    is."""
    path = tmp_path / "run.journal"
    first = JournalWriter(path, {})
    with pytest.raises(JournalError, match="another process writes it: the run is still active"):
        JournalWriter(path)
    assert len(read_journal(path).records) == 0, "it may be read all the time"
    first.close()
    JournalWriter(path).close()


def _removed(path: Path) -> None:
    path.unlink()


def _moved(path: Path) -> None:
    path.parent.rename(path.parent.with_name("elsewhere"))


def _replaced(path: Path) -> None:
    path.with_name("copy").write_bytes(path.read_bytes())
    path.with_name("copy").replace(path)


@pytest.mark.parametrize("lost", [_removed, _moved, _replaced])
def test_a_journal_that_is_lost_while_it_is_written_is_an_error(
    tmp_path: Path, lost: Callable[[Path], None]
) -> None:
    """The open file can still be written and synced, but no resume would ever find it."""
    path = tmp_path / "run" / "run.journal"
    writer = JournalWriter(path, {})
    writer.append("node", {})
    writer.sync()
    lost(path)
    writer.append("node", {})
    with pytest.raises(
        JournalError, match=r"run\.journal: removed, moved or replaced.*put it back"
    ):
        writer.flush()


def test_the_journal_of_a_process_that_changes_its_folder_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In lock step, actions run in the coordinator's process."""
    monkeypatch.chdir(tmp_path)
    writer = JournalWriter(Path("run.journal"), {})
    monkeypatch.chdir("/")
    writer.append("node", {})
    writer.close()
    assert len(read_journal(tmp_path / "run.journal").records) == 1


def test_a_missing_record_is_refused(tmp_path: Path) -> None:
    """Every record is whole, but one is missing: later markings would be computed from a marking
    that never existed."""
    path = written(tmp_path, [("one", {}), ("two", {}), ("three", {})])
    raw, header = path.read_bytes(), len(written(tmp_path / "empty", []).read_bytes())
    first = header + 8 + struct.unpack_from("<I", raw, header)[0]
    path.write_bytes(raw[:header] + raw[first:])
    with pytest.raises(JournalError, match="record 1 is numbered 2; a part is missing"):
        read_journal(path)


def test_a_sync_makes_the_file_and_its_name_durable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file is synced each time, and its folder once, so that the file's name survives too."""
    asked: list[tuple[bool, int]] = []

    def noted(real: Callable[[int], None]) -> Callable[[int], None]:
        def sync(handle: int) -> None:
            asked.append((stat.S_ISDIR(os.fstat(handle).st_mode), os.fstat(handle).st_size))
            real(handle)

        return sync

    for name in ("fsync", "fdatasync"):
        monkeypatch.setattr(os, name, noted(getattr(os, name)))
    writer = JournalWriter(tmp_path / "run.journal", {"task": "t"})
    sizes = [(tmp_path / "run.journal").stat().st_size]
    for number in range(2):
        writer.append("k", {"n": number})
        writer.sync()
        writer.sync()  # nothing new was written, so nothing is synced
        sizes.append((tmp_path / "run.journal").stat().st_size)
    writer.close()
    assert [size for folder, size in asked if not folder] == sizes and len(set(sizes)) == 3
    assert [folder for folder, _ in asked].count(True) == 1


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    """There is a file where the folder should be."""
    (tmp_path / "runs").write_text("")
    with pytest.raises(
        JournalError, match=r"runs/a/run\.journal: Not a directory; give --journal a folder"
    ):
        JournalWriter(tmp_path / "runs" / "a" / "run.journal", {})


KILLED = """
import sys
from pathlib import Path
from petrobot.coordinator.run.journal import JournalWriter
writer = JournalWriter(Path(sys.argv[1]), {})
number = 0
while True:
    number = writer.append("n", {"n": number})
    writer.sync()
    print(number, flush=True)
"""


@pytest.mark.processes
def test_kill_9_loses_nothing_that_was_synced(tmp_path: Path) -> None:
    """Everything that the process reported as synced is there after kill -9."""
    path = tmp_path / "run.journal"
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    last = 0
    for line in process.stdout:
        last = int(line)
        if last == 40:
            os.kill(process.pid, signal.SIGKILL)
            break
    said = [int(line) for line in process.stdout.read().split()]
    process.stdout.close()
    assert process.wait() == -signal.SIGKILL
    assert len(read_journal(path).records) >= max([last, *said])


def test_the_largest_result_that_a_node_can_send_fits(tmp_path: Path) -> None:
    """A journal that could not store an accepted message would end the coordinator."""
    largest = LIMITS[Outcome.KIND]
    values = {"x": bytes(largest - 200)}
    assert largest - 200 < len(encode(Outcome("mission/work#1", "success", values))) <= largest
    ended = {
        "type": "RunEnded",
        "run": "work#1",
        "status": "success",
        "values": values,
        "text": "t" * 2_000,
    }
    journal = read_journal(
        written(tmp_path, [("stimulus", {"time": 1.0, "stimulus": ended, "check": 7})])
    )
    assert journal.records[0].data["stimulus"] == ended
