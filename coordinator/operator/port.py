"""What the page needs of a mission: a snapshot, its numbered changes, and commands; all plain data.

The shapes are written out in docs/operator-protocol.md, which is also what browsers and the command
line speak.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

PROTOCOL = 1
"""Version of docs/operator-protocol.md, in every snapshot."""

VERBS = frozenset(
    {
        "load",
        "start",
        "pause",
        "resume",
        "step",
        "breakpoint",
        "add_tokens",
        "remove_tokens",
        "raise_event",
        "force_exit",
        "abort",
        "estop",
        "clear_estop",
        "take_controls",
        "ask_controls",
        "release_controls",
        "override_selector",
    }
)
"""All commands. Anybody may say `estop`, `take_controls`, `ask_controls` and `release_controls` (a
no-op for one who does not hold them); the others are for the holder of the controls."""


class MissionPort(Protocol):
    """A mission as the page sees it. All methods are called in the coordinator's own loop and give
    plain JSON data."""

    def snapshot(self) -> dict[str, Any]:
        """The whole state now, with `sequence`, the number of the last change in it."""

    def subscribe(self, receive: Callable[[dict[str, Any]], None]) -> Callable[[], None]:
        """Give every later change to `receive`, numbered without gaps; call what is returned to
        stop.

        `receive` never blocks and never raises. A change must not be altered after it was given
        out.
        """

    async def command(self, who: str, verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Carry out a command; answers after it is journaled: {"ok": True, ...} or {"ok": False,
        "code", "text"}."""


class HistoryPort(Protocol):
    """Where the page finds finished and running journals."""

    @property
    def folder(self) -> Path:
        """Where each run has a folder of its own."""


class StartsPort(Protocol):
    """What may be asked for when a task is started."""

    def __call__(self, name: str, /) -> Awaitable[Mapping[str, Any]]:
        """{task, runs ({default, place} or None), seed, modes, parameters: [{name, type, default,
        text}], learn: {selectors, selector, contexts, estimates}} of a task file. Raises
        StoreError, TaskFileError."""


class OffersPort(Protocol):
    """What the nodes offer now, for the designer."""

    def __call__(self) -> Sequence[Mapping[str, Any]]:
        """One entry for each action: {action, primitive_task, node, device, args ({name: default}),
        up}."""
