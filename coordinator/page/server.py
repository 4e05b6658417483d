"""Serve the operator's page in the coordinator's event loop: files, task documents, history, and
one WebSocket per client."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import socket as sockets
import ssl
from collections.abc import Sequence
from pathlib import Path

from aiohttp import web

from petrobot.coordinator.background import RefusedError
from petrobot.coordinator.operator.port import (
    PROTOCOL,
    HistoryPort,
    MissionPort,
    OffersPort,
    StartsPort,
)
from petrobot.coordinator.page import documents
from petrobot.coordinator.page import server as feeds
from petrobot.coordinator.page.access import Doors, Handler, middleware, names_for
from petrobot.coordinator.page.app_state import HOUSE, House
from petrobot.coordinator.page.connection_limits import Gate
from petrobot.coordinator.page.requests import LARGEST_BODY, json_answer, read_object, refused
from petrobot.coordinator.page.sessions import LARGEST_MESSAGE, Session, carry_out, who_is
from petrobot.coordinator.page.task_store import TaskStore

PAGE_FILES = Path(__file__).parent / "static"
LAST_COMMANDS_S = 1.0
"""Time for commands to complete at the end (s), among them the one that ended the run (`abort`)."""


class Page:
    """A served page: `url` holds the token; `await close()` ends it."""

    def __init__(
        self, runner: web.AppRunner, listening: asyncio.Server, house: House, url: str
    ) -> None:
        self._runner = runner
        self._listening = listening
        self._house = house
        self.url = url
        self.base = url.partition("/?")[0]
        """The address without the token."""
        self.token = house.doors.token

    @property
    def sessions(self) -> frozenset[Session]:
        """The connected clients."""
        return frozenset(self._house.sessions)

    @property
    def gate(self) -> Gate:
        """The factory of connections."""
        assert self._house.gate is not None
        return self._house.gate

    async def idle(self) -> None:
        """Wait until no command is being carried out."""
        while self._house.commands:
            await asyncio.wait(set(self._house.commands))

    async def close(self) -> None:
        """Close all connections and the port. The last commands are still answered, unless they
        take too long."""
        self._listening.close()
        self._house.closing = True
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LAST_COMMANDS_S):
                await self.idle()
        await asyncio.gather(*(session.leave() for session in self._house.sessions))
        await asyncio.gather(self._house.apart.close(), self._house.analyses.close())
        await self._runner.cleanup()
        for task in list(self._house.commands):
            task.cancel()
        await asyncio.gather(*self._house.commands, return_exceptions=True)


async def start_page(
    port_object: MissionPort,
    *,
    tasks_folder: Path,
    shipped: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 0,
    token: str | None = None,
    offers: OffersPort | None = None,
    history: HistoryPort | None = None,
    starts: StartsPort | None = None,
    names: Sequence[str] = (),
    tls: ssl.SSLContext | None = None,
    page: bool = True,
) -> Page:
    """Serve the page of a mission; without `page`, only the operator protocol: WebSocket, snapshot
    and commands.

    Tasks are saved in `tasks_folder`; those of `shipped` are offered, too, and saving one makes a
    copy there. `port` 0 selects a free one. `names` are further names of this server in browsers
    (needed if `host` is not loopback). `token` is random unless given. Raises OSError if the
    address cannot be bound."""
    listener = _listen(host, port)
    number = listener.getsockname()[1]
    doors = Doors(
        token or secrets.token_urlsafe(24), number, names_for(host, names), tls is not None
    )
    house = House(port_object, TaskStore(tasks_folder, shipped), doors, offers, history, starts)
    runner = web.AppRunner(
        _application(house, page), access_log=None, keepalive_timeout=30.0, shutdown_timeout=1.0
    )
    await runner.setup()
    assert runner.server is not None
    house.gate = Gate(runner.server)
    listening = await asyncio.get_running_loop().create_server(
        house.gate, sock=listener, ssl=tls, backlog=128
    )
    shown = (
        "127.0.0.1"
        if host in ("0.0.0.0", "::", "localhost")
        else f"[{host}]"
        if ":" in host
        else host
    )
    return Page(
        runner,
        listening,
        house,
        f"{'https' if tls else 'http'}://{shown}:{number}/?token={doors.token}",
    )


def _listen(host: str, port: int) -> sockets.socket:
    family, kind, protocol, _, address = sockets.getaddrinfo(
        host, port, type=sockets.SOCK_STREAM, flags=sockets.AI_PASSIVE
    )[0]
    listener = sockets.socket(family, kind, protocol)
    try:
        listener.setsockopt(sockets.SOL_SOCKET, sockets.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.setblocking(False)
    except OSError:
        listener.close()
        raise
    return listener


def _application(house: House, page: bool) -> web.Application:
    @web.middleware
    async def count(request: web.Request, handler: Handler) -> web.StreamResponse:
        if house.gate is not None:
            house.gate.asked(request)
        return await handler(request)

    app = web.Application(
        middlewares=[count, middleware(house.doors)], client_max_size=LARGEST_BODY
    )
    app[HOUSE] = house
    feeds.add_routes(app)
    if page:
        app.router.add_get("/", _index)
        app.router.add_static("/page", PAGE_FILES, follow_symlinks=False)
        documents.add_routes(app)
    return app


async def _index(request: web.Request) -> web.StreamResponse:
    doors = request.app[HOUSE].doors
    if "token" in request.query:
        away = web.HTTPSeeOther(
            "/"
        )  # The token disappears from the address bar and the history of the browser.
        doors.hand_out(away)
        raise away
    return web.FileResponse(PAGE_FILES / "index.html", headers={"Cache-Control": "no-store"})


# The live protocol over HTTP: the WebSocket, and the same commands and snapshot for scripts.

CLIENTS = 64


def add_routes(app: web.Application) -> None:
    """Add the routes of the live protocol."""
    app.router.add_get("/api/live", _live)
    app.router.add_get("/api/snapshot", _snapshot)
    app.router.add_post("/api/command", _command)
    app.router.add_get("/api/start/{name}", _start)


async def _live(request: web.Request) -> web.StreamResponse:
    house = request.app[HOUSE]
    if len(house.sessions) >= CLIENTS:
        raise web.HTTPServiceUnavailable(text=f"{CLIENTS} clients are connected already")
    socket = web.WebSocketResponse(
        heartbeat=15.0, max_msg_size=LARGEST_MESSAGE, compress=False, timeout=0.5
    )
    if not socket.can_prepare(request).ok:
        raise web.HTTPUpgradeRequired(text="this address speaks WebSocket")
    await socket.prepare(request)
    session = Session(socket, house.port, house.encode_once, house.commands)
    house.sessions.add(session)
    try:
        await session.run()
    finally:
        house.left(session)
    return socket


async def _snapshot(request: web.Request) -> web.Response:
    snapshot = request.app[HOUSE].port.snapshot()
    return json_answer({**snapshot, "type": "snapshot", "protocol": PROTOCOL})


async def _start(request: web.Request) -> web.Response:
    """The options for starting this task, with types and defaults."""
    starts = request.app[HOUSE].starts
    if starts is None:
        raise web.HTTPNotFound(text="no run can be started here")
    try:
        return json_answer(await starts(request.match_info["name"]))
    except RefusedError as refusal:
        raise refused(refusal) from refusal


async def _command(request: web.Request) -> web.Response:
    """{name, verb, data}: for scripts. Their `who` is their name and digits of the token, the same
    at each call."""
    house = request.app[HOUSE]
    body = await read_object(request)
    data = body.get("data", {})
    if not isinstance(data, dict):
        raise web.HTTPBadRequest(text="data must be an object")
    who = who_is(str(body.get("name", "script")), house.doors.pass_value)
    answer = await carry_out(house.port, who, str(body.get("verb")), data)
    house.heard(who)
    return json_answer(answer, 200 if answer.get("ok") else 409)
