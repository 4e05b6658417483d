"""A client of the operator protocol (docs/operator-protocol.md): it keeps the snapshot up to date
and sends commands."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from typing import Any, Self

import aiohttp

from petrobot.coordinator.operator.changes import State, apply, empty_state
from petrobot.coordinator.operator.port import PROTOCOL
from petrobot.coordinator.page.sessions import LARGEST_SNAPSHOT

LOST_AFTER = 3.0
"""Silence after which the connection counts as lost (s); the server sends `alive` every second."""
ANSWER, START_ANSWER = 10.0, 60.0
"""Longest wait for the answer to a command (s). A start checks the task and connects to its nodes
first, and a caller that no longer waited would not know that the run has begun."""


class OperatorError(Exception):
    """The coordinator cannot be reached, does not answer, or closed the connection."""


class OperatorClient:
    """One operator at one mission run: `async with OperatorClient(url, token, name, secret) as
    hand: ...`.

    `name` is shown to all; a client with the same name and `secret` is the same operator.
    Raises OperatorError.
    """

    def __init__(self, url: str, token: str, name: str, secret: str) -> None:
        self.state: State = empty_state()
        """The snapshot, up to date."""
        self.who = ""
        """The name under which all others see this operator."""
        self.over = ""
        """Why the connection ended; empty while connected."""
        self._url = url
        self._headers = {"Authorization": f"Bearer {token}"}
        self._hello = {"type": "hello", "protocol": PROTOCOL, "name": name, "tab": secret}
        self._http: aiohttp.ClientSession | None = None
        self._socket: aiohttp.ClientWebSocketResponse | None = None
        self._reader: asyncio.Task[None] | None = None
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._numbers = 0
        self._changes: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()
        self._changed = asyncio.Event()
        self._watched = False
        self._behind = False
        """Whether changes are missing, and a snapshot has been asked for."""

    async def __aenter__(self) -> Self:
        """Connect, send hello, and wait for the snapshot."""
        self._http = aiohttp.ClientSession(headers=self._headers, trust_env=False)
        try:
            async with asyncio.timeout(LOST_AFTER):
                self._socket = await self._http.ws_connect(
                    f"{self._url}/api/live", max_msg_size=LARGEST_SNAPSHOT, autoping=True
                )
                await self._socket.send_json(self._hello)
                self._reader = asyncio.create_task(self._read())
                await self._until_open()
        except (aiohttp.ClientError, TimeoutError, OSError) as fault:
            await self.close()
            why = str(fault) or f"no answer within {LOST_AFTER:g} s: it may be frozen"
            raise OperatorError(
                f"the coordinator at {self._url} cannot be reached: {why}"
            ) from None
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the connection."""
        await self.close()

    async def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            await self._socket.close()
        if self._reader is not None:
            self._reader.cancel()
            await asyncio.gather(self._reader, return_exceptions=True)
        if self._http is not None:
            await self._http.close()

    async def command(self, verb: str, data: dict[str, Any] | None = None) -> dict[str, Any]:
        """Give a command; return its answer {ok, ...} after it was carried out and journaled."""
        if self._socket is None or self.over:
            raise OperatorError(self.over or "not connected")
        self._numbers += 1
        number = self._numbers
        within = START_ANSWER if verb == "start" else ANSWER
        answer = self._answers[number] = asyncio.get_running_loop().create_future()
        message = {"type": "command", "id": number, "verb": verb, "data": data or {}}
        try:
            with contextlib.suppress(ConnectionError):  # the reader ends `answer`, and says why
                await self._socket.send_json(message)
            async with asyncio.timeout(within):
                await answer
            given: dict[str, Any] = answer.result()
            return given
        except TimeoutError:
            raise OperatorError(f"no answer to {verb} within {within:g} s") from None
        finally:
            self._answers.pop(number, None)

    async def until(self, holds: Callable[[State], bool], timeout: float) -> bool:
        """Wait at most this long (s) until the condition holds; return whether it does."""
        try:
            async with asyncio.timeout(timeout):
                while not holds(self.state):
                    if self.over:
                        return False
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            return False
        return True

    async def changes(self) -> AsyncIterator[dict[str, Any]]:
        """Yield every change until the connection ends; `reset` when there is a new snapshot."""
        self._watched = True
        while not self.over and (change := await self._changes.get()) is not None:
            yield change

    async def _until_open(self) -> None:
        while not self.who:
            if self.over:
                raise OperatorError(self.over)
            self._changed.clear()
            await self._changed.wait()

    async def _read(self) -> None:
        assert self._socket is not None
        try:
            while True:
                message = await asyncio.wait_for(self._socket.receive(), LOST_AFTER)
                if message.type is not aiohttp.WSMsgType.TEXT:
                    self.over = str(message.extra or "") or "the coordinator closed the connection"
                    break
                await self._take(json.loads(message.data))
        except TimeoutError:
            self.over = f"the coordinator has been silent for {LOST_AFTER:g} s"
        except (aiohttp.ClientError, ConnectionError, ValueError) as fault:
            self.over = f"the connection broke: {fault}"
        finally:
            self._end()

    def _end(self) -> None:
        self.over = self.over or "left"
        for answer in self._answers.values():
            if not answer.done():
                answer.set_exception(OperatorError(self.over))
        self._changes.put_nowait(None)
        self._changed.set()

    async def _take(self, message: dict[str, Any]) -> None:
        kind = message.get("type")
        if kind == "answer":
            answer = self._answers.get(message["id"])
            if answer is not None and not answer.done():
                answer.set_result(
                    {key: value for key, value in message.items() if key not in ("type", "id")}
                )
        elif kind == "snapshot":
            self.who = message["you"]
            self.state = {key: message.get(key, value) for key, value in empty_state().items()}
            self._behind = False
            self._tell({"kind": "reset"})
        elif kind == "delta":
            await self._take_delta(message)
        self._changed.set()

    async def _take_delta(self, delta: dict[str, Any]) -> None:
        assert self._socket is not None
        if delta["first"] != self.state["sequence"] + 1:
            if not self._behind:
                await self._socket.send_json({"type": "resync"})
            self._behind = True
            return
        for change in delta["changes"]:
            apply(self.state, change)
            self._tell({**change, "time": delta["time"]})
        self.state["sequence"] = delta["last"]
        self.state["time"] = max(self.state["time"], delta["time"])

    def _tell(self, change: dict[str, Any]) -> None:
        if self._watched:
            self._changes.put_nowait(change)
