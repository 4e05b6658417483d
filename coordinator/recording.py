"""Mission runs in the journal: what is written of each stimulus, and how a run is derived from it again."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack

from coordinator.engine import Engine, Instruction, State, Stimulus, stimulus_from_plain, to_plain
from coordinator.journal import Journal, JournalError, JournalWriter

STIMULUS = "stimulus"
NODE = "node"
EPOCH = "epoch"


def digest(instructions: Sequence[Instruction]) -> int:
    """CRC-32 of the instructions as plain data: replay compares it."""
    packed: bytes = msgpack.packb([to_plain(instruction) for instruction in instructions], use_bin_type=True)
    return zlib.crc32(packed)


class JournalStore:
    """The executor's store over a journal: each stimulus with the marking and a digest of the instructions that followed."""

    def __init__(self, writer: JournalWriter, origin: float) -> None:
        self.writer = writer
        self._origin = origin

    def append(self, now: float, stimulus: Stimulus, instructions: Sequence[Instruction], state: State) -> None:
        """Keep a stimulus and what came of it with the next sync; `t` is seconds since the journal's origin."""
        data = {
            "t": round(now - self._origin, 6),
            "stimulus": to_plain(stimulus),
            "marking": list(state.marking),
            "instructions": digest(instructions),
        }
        self.writer.append(STIMULUS, data)

    def node(self, name: str, boot: str) -> None:
        """Keep which boot of a node was spoken to: after a resume another boot is never asked to run a call again."""
        self.writer.append(NODE, {"node": name, "boot": boot})

    def sync(self) -> None:
        """Make all that was appended durable."""
        self.writer.sync()

    @property
    def safe(self) -> bool:
        """Whether nothing waits for a sync."""
        return not self.writer.pending


class ReplayError(Exception):
    """What the engine does now differs from what the journal says it did: number of the record, and both."""


@dataclass(frozen=True, slots=True)
class Step:
    """One stimulus derived again."""

    number: int
    time: float
    stimulus: Stimulus
    instructions: tuple[Instruction, ...]
    state: State


def replay(journal: Journal, engine: Engine) -> Iterator[Step]:
    """Derive every state and instruction of a journal again. Raises ReplayError at the first difference."""
    state = engine.initial()
    for record in journal.records:
        if record.kind != STIMULUS:
            continue
        try:
            stimulus = stimulus_from_plain(record.data["stimulus"])
        except (KeyError, ValueError) as fault:
            raise JournalError(f"{journal.path}: record {record.number} holds no stimulus: {fault}") from fault
        state, instructions = engine.handle(state, stimulus)
        _compare(journal.path, record.number, record.data, engine, state, instructions)
        yield Step(record.number, record.data["t"], stimulus, instructions, state)


def _compare(
    path: Path, number: int, data: Mapping[str, Any], engine: Engine, state: State, instructions: Sequence[Instruction]
) -> None:
    written = tuple(data["marking"])
    where = f"{path}: record {number} ({data['stimulus'].get('kind')})"
    if written != state.marking:
        net = engine.compiled.net
        raise ReplayError(f"{where}: marking was {net.describe(written)}, is now {net.describe(state.marking)}")
    if data["instructions"] != digest(instructions):
        now = "; ".join(f"{type(i).__name__} {to_plain(i)}" for i in instructions) or "none"
        raise ReplayError(f"{where}: the instructions differ from those of then; now they are: {now}")


def boots(journal: Journal) -> dict[str, str]:
    """The boot of each node that the run spoke to last."""
    return {r.data["node"]: r.data["boot"] for r in journal.records if r.kind == NODE}


def last_epoch(journal: Journal) -> int:
    """The newest epoch in which the run was coordinated."""
    return max([1, *(int(r.data["epoch"]) for r in journal.records if r.kind == EPOCH)])
