"""Mission runs in the journal: what is written for each stimulus, and how a run is replayed from
it.

The constants below are the kinds of records after the header; docs/journal.md has their data. A
replay reads stimuli and boots of nodes alone, so a new kind needs no reader there.
"""

from __future__ import annotations

import heapq
import logging
import math
import time
import zlib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgpack
from msgspec import Struct

from petrobot.coordinator.engine import (
    Engine,
    EventOccurred,
    Instruction,
    RunRaised,
    State,
    Stimulus,
    stimulus_from_plain,
    to_plain,
)
from petrobot.coordinator.engine.step import RECORDED
from petrobot.coordinator.run.folder import SEMANTICS
from petrobot.coordinator.run.journal import Journal, JournalError, JournalWriter
from petrobot.services.host.toml_text import InputError

_log = logging.getLogger(__name__)

STIMULUS = "stimulus"
"""What the engine received, the marking after it, a digest of the instructions that followed."""
NODE = "node"
"""Which boot of a node is used from here on: after a resume, no call is repeated at another one."""
STAGE = "stage"
"""The mission run was prepared or scored, with the result: not repeated after a resume."""
PREPARED, SCORED = "prepared", "scored"
EPOCH = "epoch"
"""Another coordinator continues the run."""
REMARK = "remark"
"""What an operator remarked."""
_ASIDE = frozenset((EPOCH, REMARK))
"""Kinds that do not follow from the seed: a lock-step run that is derived again does not write
them, and they keep their place."""


LONGEST_REMARK = 1_000
"""Longest remark (characters)."""


class Remark(Struct, frozen=True):
    """What an operator remarked: number of the record, time since the journal's origin (s)."""

    number: int
    time: float
    author: str
    text: str

    @property
    def told(self) -> str:
        """The remark with its author."""
        return f"{self.author} remarked: {self.text}"


class TakeOver(Struct, frozen=True):
    """Another coordinator continues the run: number of the record, time since the journal's origin
    (s), epoch."""

    number: int
    time: float
    epoch: int

    @property
    def told(self) -> str:
        """What happened, for people."""
        return f"another coordinator continues the run (epoch {self.epoch})"


def digest(records: Sequence[Instruction | Stimulus]) -> int:
    """Return the CRC-32 of the instructions as plain data, which replay compares. Raises
    OverflowError and UnicodeEncodeError for what no journal can store."""
    packed: bytes = msgpack.packb([to_plain(record) for record in records], use_bin_type=True)
    return zlib.crc32(packed)


def mission_time(now: float, origin: float) -> float:
    """Return the time since the mission's clock was 0 (s), as the journal stores it. Whoever shows
    a time rounds this one further: otherwise journal and page may differ in the last digit."""
    return round(now - origin, 6)


class JournalStore:
    """The executor's store in a journal: each stimulus with the marking and a digest of the
    instructions that followed."""

    def __init__(self, writer: JournalWriter, origin: float, *, durable: bool = False) -> None:
        """`origin` is the time at which the journal's clock began, on the clock of `append`. With
        `durable`, no effect at all leaves before its cause is synced."""
        self.writer = writer
        self.durable = durable
        self.origin = origin

    def append(
        self, now: float, stimulus: Stimulus, instructions: Sequence[Instruction], state: State
    ) -> None:
        """Write a stimulus and its effects with the next sync; `t` is the time since the journal's
        origin (s). Raises JournalError for what no journal can store: the run cannot continue
        without it."""
        try:
            data = {
                "t": mission_time(now, self.origin),
                "stimulus": to_plain(stimulus),
                "marking": list(state.marking),
                "instructions": digest(instructions),
            }
            self.record(STIMULUS, data)
        except (OverflowError, UnicodeEncodeError) as fault:
            raise JournalError(f"{type(stimulus).__name__} cannot be stored: {fault}") from fault

    def record(self, kind: str, data: Mapping[str, Any]) -> None:
        """Write a record of any kind with the next sync."""
        self.writer.append(kind, data)

    def remark(self, now: float, author: str, text: str) -> Remark:
        """Write a remark with the next sync. Raises ValueError for a text that is not one line of 1
        to `LONGEST_REMARK` characters."""
        if not isinstance(text, str) or not text.strip().isprintable() or not text.strip():
            raise ValueError(f"text: expected one line of plain text, got {text!r:.80}")
        if len(text) > LONGEST_REMARK:
            found = f"found {len(text):,}"
            raise ValueError(f"text: expected at most {LONGEST_REMARK:,} characters, {found}")
        time = mission_time(now, self.origin)
        remark = Remark(self.writer.next_number, time, author, text.strip())
        self.record(REMARK, {"t": remark.time, "author": author, "text": remark.text})
        return remark

    def flush(self) -> bool:
        """Make all that was appended survive the end of this process; False: a sync is writing."""
        return self.writer.flush()

    def sync(self) -> None:
        """Make all durable that has been appended."""
        self.writer.sync()

    @property
    def stood(self) -> float:
        """Longest time that `flush` took (s)."""
        return self.writer.stood

    @property
    def safe(self) -> bool:
        """Whether all that was appended is durable."""
        return not self.writer.pending


class ReplayError(InputError):
    """The engine does something else than the journal says: number of the record, and both."""


class RetracingStore(JournalStore):
    """The store of a lock-step run that is derived again from its beginning: the same seed gives
    the same run, so what the journal holds is compared, and what comes after it is written.

    Another processor may compute other last digits (BLAS, OpenCV and the C library choose their
    code by the processor). From the first such record on, the records are then written again, as
    soon as all of them have been compared: a replay of the journal finds one run, not two halves.

    Raises ReplayError at the first difference.
    """

    def __init__(self, writer: JournalWriter, journal: Journal) -> None:
        super().__init__(writer, 0.0)
        self._path = journal.path
        self._expected = deque(journal.records)
        self._rewritten_from = 0
        """Number of the first record with other last digits; 0 if there is none."""
        self._rewritten: list[tuple[str, Mapping[str, Any]]] = []
        self._pass_over()

    def _pass_over(self) -> None:
        """Pass over the records that no derivation writes; they keep their place."""
        while self._expected and self._expected[0].kind in _ASIDE:
            then = self._expected.popleft()
            if self._rewritten_from:
                self._rewritten.append((then.kind, then.data))

    def record(self, kind: str, data: Mapping[str, Any]) -> None:
        """Compare a record with the next one of the journal, or write it behind the last. Raises
        ReplayError, and ValueError for a kind that is not compared, before all have been."""
        if not self._expected:
            super().record(kind, data)
            return
        if kind in _ASIDE:
            raise ValueError("the run is being derived again; try again when it has caught up")
        then = self._expected.popleft()
        was, now = unmeasured(then.data), unmeasured(data)
        if not self._rewritten_from and (then.kind, was) != (kind, now):
            self._rewritten_from = then.number
        if self._rewritten_from:
            was.pop("instructions", None)  # a checksum cannot tell a last digit from another run
            now.pop("instructions", None)
            if then.kind != kind or not alike(was, now):
                raise ReplayError(
                    f"{self._path}: record {then.number} was {then.kind} {then.data}, is {kind} "
                    f"{data} now: sources or files have changed since, or this processor computes "
                    "differently; run it again from the beginning"
                )
            self._rewritten.append((kind, data))
        self._pass_over()
        if self._rewritten_from and not self._expected:
            self._rewrite()

    def _rewrite(self) -> None:
        _log.warning(
            "%s: this processor computes other last digits than the one that recorded the run; "
            "the records from %d on are written again",
            self._path,
            self._rewritten_from,
        )
        self.writer.cut(self._rewritten_from)
        for kind, data in self._rewritten:
            super().record(kind, data)
        self._rewritten.clear()


LAST_DIGITS = 1e-5
"""Largest relative difference between two processors' results that counts as none. Measured over
six balls: 4e-14 at the first record that differs, 5e-6 where a ball meets the rim of a cup."""


def alike(was: Any, now: Any) -> bool:
    """Return whether plain data is equal except for the last digits of its floats."""
    if isinstance(was, float) and isinstance(now, float):
        return math.isclose(was, now, rel_tol=LAST_DIGITS, abs_tol=1e-9)
    if isinstance(was, dict) and isinstance(now, dict):
        return was.keys() == now.keys() and all(alike(was[key], now[key]) for key in was)
    if isinstance(was, list) and isinstance(now, list):
        return len(was) == len(now) and all(map(alike, was, now))
    return type(was) is type(now) and bool(was == now)


def unmeasured(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record without what differs between two equal runs: measured times, a score's own
    words, and the number of an event that a run raised, which older journals do not have."""
    plain: dict[str, Any] = msgpack.unpackb(
        msgpack.packb(dict(data), use_bin_type=True), raw=False, strict_map_key=False
    )
    plain.pop("values", None)
    if isinstance(plain.get("stimulus"), dict):
        plain["stimulus"].pop("cpu_seconds", None)
        if plain["stimulus"].get("kind") == RunRaised.__name__:
            plain["stimulus"].pop("number", None)
    return plain


class RecordedStep(Struct, frozen=True):
    """One replayed stimulus."""

    number: int
    time: float
    stimulus: Stimulus
    instructions: tuple[Instruction, ...]
    state: State
    boots: Mapping[str, str]
    """The boot of each node that was in use then."""
    repeated: bool = False
    """Whether it is an event that had been accepted before, and so is ignored."""


def as_recorded(engine: Engine, header: Mapping[str, Any]) -> Engine:
    """Return the engine with the rules under which a journal was recorded.

    Raises JournalError for a journal of a newer petrobot.
    """
    semantics = header.get("semantics", 1)
    if semantics > SEMANTICS:
        raise JournalError(
            f"semantics: expected at most {SEMANTICS}, found {semantics}: this run was recorded by "
            "a newer petrobot; use that one to replay or resume it"
        )
    if semantics in RECORDED:
        return Engine(engine.task, engine.compiled.devices, RECORDED[semantics])
    return engine


def replay(journal: Journal, engine: Engine) -> Iterator[RecordedStep]:
    """Replay a journal: compute every state and instruction again. Raises ReplayError at the first
    difference."""
    engine = as_recorded(engine, journal.header)
    state, boots = engine.initial(), dict[str, str]()
    for record in journal.records:
        if record.kind == NODE:
            boots = {**boots, record.data["node"]: record.data["boot"]}
        if record.kind != STIMULUS:
            continue
        try:
            stimulus = stimulus_from_plain(record.data["stimulus"])
        except (KeyError, ValueError) as fault:
            raise JournalError(
                f"{journal.path}: record {record.number} holds no stimulus: {fault}"
            ) from fault
        again = isinstance(stimulus, EventOccurred) and stimulus.is_repeated(state.seen)
        if isinstance(stimulus, RunRaised) and (run := state.run(stimulus.run)) is not None:
            again = stimulus.is_repeated(run)
        state, instructions = engine.handle(state, stimulus)
        _compare(journal.path, record.number, record.data, engine, state, instructions)
        t = record.data["t"]
        yield RecordedStep(record.number, t, stimulus, instructions, state, boots, again)


def _compare(
    path: Path,
    number: int,
    data: Mapping[str, Any],
    engine: Engine,
    state: State,
    instructions: Sequence[Instruction],
) -> None:
    written = tuple(data["marking"])
    where = f"{path}: record {number} ({data['stimulus'].get('kind')})"
    if written != state.marking:
        net = engine.compiled.net
        if len(written) != len(net.places):
            text = f"the net had {len(written)} places, and has {len(net.places)} now"
            raise ReplayError(f"{where}: {text}")
        raise ReplayError(
            f"{where}: marking was {net.describe(written)}, is now {net.describe(state.marking)}"
        )
    if data["instructions"] != digest(instructions):
        now = "; ".join(f"{type(i).__name__} {to_plain(i)}" for i in instructions) or "none"
        raise ReplayError(
            f"{where}: the instructions differ from those of then; now they are: {now}"
        )


def remarks(journal: Journal) -> list[Remark]:
    """Return the operators' remarks, in order."""
    return [
        Remark(r.number, r.data["t"], r.data["author"], r.data["text"])
        for r in journal.records
        if r.kind == REMARK
    ]


def take_overs(journal: Journal) -> Iterator[TakeOver]:
    """Yield where another coordinator continued the run. An older journal has no time of it: it is
    that of the record before."""
    time = 0.0
    for r in journal.records:
        time = r.data.get("t", time)
        if r.kind == EPOCH:
            yield TakeOver(r.number, time, int(r.data["epoch"]))


def with_asides(
    journal: Journal, steps: Iterable[RecordedStep]
) -> Iterator[RecordedStep | Remark | TakeOver]:
    """Return the steps of a replay with what else happened between them."""
    return heapq.merge(steps, remarks(journal), take_overs(journal), key=lambda one: one.number)


def stages(journal: Journal) -> dict[str, Mapping[str, Any]]:
    """Return the stages that the mission run has completed, with their values."""
    return {r.data["stage"]: r.data["values"] for r in journal.records if r.kind == STAGE}


def last_epoch(journal: Journal) -> int:
    """Return the newest epoch in which the run was coordinated."""
    return max([1, *(one.epoch for one in take_overs(journal))])


def clock_reading(now: float) -> dict[str, Any]:
    """Return the clock readings of a header, from which another process can continue the journal's
    clock. `monotonic` (s) holds within one boot of the host; `unix` (s) holds longer, but only as
    well as the host's clock is set."""
    return {"monotonic": now, "host_boot": _host_boot(), "unix": time.time()}


def origin_of(header: Mapping[str, Any], now: float, last: float) -> float:
    """Return when a journal's clock began (s), on this process's clock, which reads `now`; the time
    of its last record is `last`. In lock step each process has its own simulated clock. In real
    time the time without a coordinator counts, too, as far as it is known: the host's clock may
    have been set back meanwhile, or have lost its time with the power."""
    if header["mode"] == "lockstep":
        return 0.0
    clock = header.get("clock")
    if not clock:
        return now - last
    if clock["host_boot"] == _host_boot() and clock["monotonic"] <= now:
        return float(clock["monotonic"])
    return now - max(last, time.time() - float(clock["unix"]))


def _host_boot() -> str:
    path = Path("/proc/sys/kernel/random/boot_id")
    return path.read_text(encoding="ascii").strip() if path.exists() else ""
