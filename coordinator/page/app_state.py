"""State shared by all handlers of one server: the mission, the task files, access control, and the
connected clients."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Coroutine, Mapping
from pathlib import Path
from typing import Any

from aiohttp import web
from msgspec import Struct, field

from petrobot.coordinator.background import BackgroundProcess
from petrobot.coordinator.operator.port import MissionPort, Offers, StartForm
from petrobot.coordinator.page.access import AccessRules, ConnectionLimit
from petrobot.coordinator.page.sessions import Session, carry_out, encode
from petrobot.coordinator.page.task_store import TaskStore

ABSENT_S = 10.0
"""Controls become free after their holder has had no open window for this long (s)."""
CLOCK_S = 0.05
"""How much too early a timer of the event loop may fire (s)."""
ENCODED_KEPT = 8


class PageState(Struct):
    """State of one page server."""

    port: MissionPort
    store: TaskStore
    access: AccessRules
    offers: Offers | None = None
    runs: Path | None = None
    """The folder that has a folder for each run."""
    starts: StartForm | None = None
    services: str = ""
    """The path of the location file; empty if only `offers` are known."""
    numbers: Mapping[str, str] = field(default_factory=dict)
    """What `newest_measured` needs: `estimates` and the `plant` of the page."""
    limit: ConnectionLimit | None = None
    sessions: set[Session] = field(default_factory=set)
    commands: set[asyncio.Task[None]] = field(default_factory=set)
    apart: BackgroundProcess = field(default_factory=BackgroundProcess)
    """Process for work on documents and journals."""
    checks: BackgroundProcess = field(default_factory=BackgroundProcess)
    """Process that checks drawings. It imports the code of the location file, which may hang."""
    analyses: BackgroundProcess = field(default_factory=BackgroundProcess)
    """Process that analyses drawings. This takes long, so no other work waits for it."""
    closing: bool = False
    _heard: dict[str, float] = field(default_factory=dict)
    _encoded: OrderedDict[tuple[int, int], str] = field(default_factory=OrderedDict)

    def encode_once(self, delta: dict[str, Any]) -> str:
        """Encode a merged delta; clients with the same position share the text."""
        key = (delta["first"], delta["last"])
        text = self._encoded.get(key)
        if text is None:
            text = self._encoded[key] = encode(delta)
            if len(self._encoded) > ENCODED_KEPT:
                self._encoded.popitem(last=False)
        return text

    def left(self, session: Session) -> None:
        """Note that a client left: if it holds the controls and does not return in time, they
        become free."""
        self.sessions.discard(session)
        if session.who and not self.closing:
            asyncio.get_running_loop().call_later(ABSENT_S, self._free_controls, session.who)

    def heard(self, who: str) -> None:
        """Note a command of a script: if it holds the controls and gives no more commands for a
        while, they become free."""
        loop = asyncio.get_running_loop()
        self._heard[who] = loop.time()
        loop.call_later(ABSENT_S, self._free_controls, who)

    def _free_controls(self, who: str) -> None:
        if asyncio.get_running_loop().time() < self._heard.get(who, -ABSENT_S) + ABSENT_S - CLOCK_S:
            return  # It has sent a command since.
        self._heard.pop(who, None)
        if self.closing or any(session.who == who for session in self.sessions):
            return
        if self.port.snapshot().get("controls", {}).get("holder") == who:
            self._in_background(self._release(who))

    async def _release(self, who: str) -> None:
        await carry_out(self.port, who, "release_controls", {"why": "its last window was closed"})

    def _in_background(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.ensure_future(work)
        self.commands.add(task)
        task.add_done_callback(self.commands.discard)


PAGE_STATE: web.AppKey[PageState] = web.AppKey("page_state", PageState)
