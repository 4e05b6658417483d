"""Interface between the page and a mission: a snapshot, its numbered changes, and commands, all as
plain data.

docs/operator-protocol.md defines the format, which browsers and the command line use, too.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any, Protocol

PROTOCOL = 1
"""Version of docs/operator-protocol.md, in every snapshot."""

FREE = frozenset({"estop", "remark", "take_controls", "ask_controls", "release_controls"})
"""Commands for every client. `release_controls` does nothing without the controls."""
VERBS = FREE | {
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
    "clear_estop",
    "override_selector",
}
"""All commands; those that are not in `FREE` need the controls. `Operation._do_VERB`
(commands.py) carries one out; the station those about the next run."""


class MissionPort(Protocol):
    """A mission as the page sees it. All methods are called in the coordinator's event loop and
    return plain JSON data."""

    def snapshot(self) -> dict[str, Any]:
        """Return the whole state with `sequence`, the number of the last change in it."""

    def subscribe(self, receive: Callable[[dict[str, Any]], None]) -> Callable[[], None]:
        """Call `receive` with every later change, numbered without gaps, until the returned
        function is called.

        `receive` never blocks and never raises. A change must not be modified after it was passed
        on.
        """

    async def command(self, who: str, verb: str, data: Mapping[str, Any]) -> dict[str, Any]:
        """Carry out a command; return after it is journaled: {"ok": True, ...} or {"ok": False,
        "code", "text"}."""


StartForm = Callable[[str], Awaitable[Mapping[str, Any]]]
"""Returns the options of a task file's start: {task, runs ({default, place} or None), seed, modes,
parameters: [{name, type, default, text}], learn: {selectors, selector, credits, contexts,
estimates}}. Raises RefusedError."""
Offers = Callable[[], Sequence[Mapping[str, Any]]]
"""Returns the current offers of the nodes, for the designer, one entry for each action: {action,
primitive_task, node, device, args ({name: default}), up}."""
