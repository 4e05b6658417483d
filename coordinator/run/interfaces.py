"""Interfaces of the executor (selectors, stores and observers), with the simplest implementation of
each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from petrobot.coordinator.engine import Instruction, State, Stimulus
from petrobot.services.comm.protocol.messages import Feedback


class Selector(Protocol):
    """Chooses among the alternatives of a primitive task."""

    def choose(
        self,
        task: str,
        run: str,
        alternatives: tuple[str, ...],
        variables: Mapping[str, Any] | None = None,
    ) -> tuple[str, str]:
        """Return one alternative and the reason. `variables` are the current global memory and
        parameters."""


class Store(Protocol):
    """Stores stimuli before their effects leave."""

    def append(
        self, now: float, stimulus: Stimulus, instructions: Sequence[Instruction], state: State
    ) -> None:
        """Store a stimulus and its instructions with the next sync."""

    def record(self, kind: str, data: Mapping[str, Any]) -> None:
        """Store a record that is no stimulus, with the next sync
        (`coordinator/run/recording.py` has the kinds)."""

    def flush(self) -> bool:
        """Make all that was appended survive the end of this process. Return False, without
        waiting, while a sync in another thread is writing."""

    def sync(self) -> None:
        """Make all durable that has been appended: it may take seconds, and may be done in another
        thread."""

    @property
    def stood(self) -> float:
        """Longest time that `flush` took (s): the coordinator stands still meanwhile."""

    @property
    def safe(self) -> bool:
        """Whether all that was appended is durable."""

    @property
    def durable(self) -> bool:
        """Whether every effect waits for a sync, also one that moves no hardware."""


@runtime_checkable
class Observer(Protocol):
    """Follows a mission run: report, page, terminal."""

    def instruction(self, now: float, instruction: Instruction) -> None:
        """Receive an instruction or a record of the engine."""

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Receive a stimulus before the engine handles it."""

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Receive the progress of a run."""

    def settled(self, now: float, state: State) -> None:
        """Receive a stimulus that the engine has handled, and the state after it."""


class Forgetful:
    """The store of a run without a journal."""

    stood = 0.0
    safe = True
    durable = False

    def append(
        self, now: float, stimulus: Stimulus, instructions: Sequence[Instruction], state: State
    ) -> None:
        """Keep nothing."""

    def record(self, kind: str, data: Mapping[str, Any]) -> None:
        """Keep nothing."""

    def flush(self) -> bool:
        """Nothing to flush."""
        return True

    def sync(self) -> None:
        """Nothing to make safe."""


class FirstAlternative:
    """The selector of a run without learning: always the first alternative that a node offers."""

    def __init__(self, chosen: Mapping[str, str] | None = None) -> None:
        self._chosen = dict(chosen or {})

    def figures(self, task: str) -> Mapping[str, Mapping[str, float]]:
        """Return what is known of each alternative: here nothing."""
        return {}

    def choose(
        self,
        task: str,
        run: str,
        alternatives: tuple[str, ...],
        variables: Mapping[str, Any] | None = None,
    ) -> tuple[str, str]:
        """Return the user's choice for this primitive task, otherwise the first alternative."""
        if task in self._chosen:
            return self._chosen[task], "chosen by the user"
        return alternatives[0], "first of the task file"
