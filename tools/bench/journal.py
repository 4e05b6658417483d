"""Time appends to the journal and to SQLite in WAL mode, alternating in one process; print medians
and 99 % quantiles.
"""

from __future__ import annotations

import argparse
import sqlite3
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import msgpack

from petrobot.coordinator.run.journal import JournalWriter

RECORD = {
    "stimulus": {
        "kind": "RunEnded",
        "run": "action#1",
        "values": {"point": [[0.1, 1.0, 0.2]] * 8},
        "seconds": 0.4,
    }
}


def timed(append: Callable[[], object]) -> float:
    """Return the seconds of one append."""
    begun = time.perf_counter()
    append()
    return time.perf_counter() - begun


def row(name: str, seconds: list[float]) -> str:
    """Return one line of the table, in microseconds."""
    return (
        f"{name:32} {statistics.median(seconds) * 1e6:9.0f} "
        f"{sorted(seconds)[int(0.99 * len(seconds))] * 1e6:9.0f}"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--folder", type=Path, default=Path(), help="on the disk to measure (default: here)"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as folder:
        writer = JournalWriter(Path(folder) / "a.journal", {})
        base = sqlite3.connect(Path(folder) / "a.sqlite", isolation_level=None)
        for statement in (
            "pragma journal_mode=wal",
            "create table records (number integer primary key, data blob)",
        ):
            base.execute(statement)

        def own(durable: bool) -> None:
            writer.append("stimulus", RECORD)
            (writer.sync if durable else writer.flush)()

        def sqlite() -> None:
            base.execute("insert into records (data) values (?)", (msgpack.packb(RECORD),))

        print(f"{'us':32} {'median':>9} {'99 %':>9}")
        for durable, count in ((True, 200), (False, 2000)):
            base.execute(f"pragma synchronous={'full' if durable else 'off'}")
            pairs = [(timed(lambda d=durable: own(d)), timed(sqlite)) for _ in range(count)]  # type: ignore[misc]
            word = "synced" if durable else "not synced"
            print(row(f"own file, {word}", [a for a, _ in pairs]))
            print(row(f"SQLite WAL, {word}", [b for _, b in pairs]))


if __name__ == "__main__":
    main()
