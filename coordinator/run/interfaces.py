"""Who works with the executor: selectors, stores and observers, and the plainest of each."""

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
        """One alternative and why. `variables` are global memory and parameters as they are now."""


class Store(Protocol):
    """Where stimuli go before their effects leave."""

    def append(
        self, now: float, stimulus: Stimulus, instructions: Sequence[Instruction], state: State
    ) -> None:
        """Keep a stimulus, and what came of it, with the next sync."""

    def node(self, name: str, boot: str) -> None:
        """Keep which boot of a node this run speaks to."""

    def stage(self, name: str, values: Mapping[str, Any]) -> None:
        """Keep that the mission run has come to a stage of its own (prepared, scored)."""

    def flush(self) -> None:
        """What was appended survives the end of this process."""

    def sync(self) -> None:
        """Make all that was appended safe."""

    @property
    def safe(self) -> bool:
        """Whether nothing waits for a sync."""

    @property
    def durable(self) -> bool:
        """Whether every effect waits for a sync, also one that moves no hardware."""


@runtime_checkable
class Observer(Protocol):
    """Whoever follows the mission run: report, page, terminal."""

    def instruction(self, now: float, instruction: Instruction) -> None:
        """The engine gave an instruction or a record."""

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """The engine takes a stimulus in."""

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """A run says how far it is."""

    def settled(self, now: float, state: State) -> None:
        """The engine has handled a stimulus, with this state after it."""


class Forgetful:
    """The store of a run without a journal."""

    safe = True
    durable = False

    def append(
        self, now: float, stimulus: Stimulus, instructions: Sequence[Instruction], state: State
    ) -> None:
        """Keep nothing."""

    def node(self, name: str, boot: str) -> None:
        """Keep nothing."""

    def stage(self, name: str, values: Mapping[str, Any]) -> None:
        """Keep nothing."""

    def flush(self) -> None:
        """Nothing to flush."""

    def sync(self) -> None:
        """Nothing to make safe."""


class FirstAlternative:
    """The selector of a run that learns nothing: always the first alternative that some node
    offers."""

    def __init__(self, chosen: Mapping[str, str] | None = None) -> None:
        self._chosen = dict(chosen or {})

    def figures(self, task: str) -> Mapping[str, Mapping[str, float]]:
        """What people are shown of each alternative: nothing is known here."""
        return {}

    def choose(
        self,
        task: str,
        run: str,
        alternatives: tuple[str, ...],
        variables: Mapping[str, Any] | None = None,
    ) -> tuple[str, str]:
        """The user's choice for this primitive task, else the first."""
        if task in self._chosen:
            return self._chosen[task], "chosen by the user"
        return alternatives[0], "first of the task file"
