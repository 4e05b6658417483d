"""Serve the operator's page in the coordinator's event loop: files, task documents, history, and
one WebSocket per client."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import secrets
import socket as sockets
from pathlib import Path

from aiohttp import web

from petrobot.coordinator.background import RefusedError
from petrobot.coordinator.operator.port import PROTOCOL, MissionPort, Offers, StartForm
from petrobot.coordinator.page import documents
from petrobot.coordinator.page.access import HOST, AccessRules, ConnectionLimit, Handler, middleware
from petrobot.coordinator.page.app_state import PAGE_STATE, PageState
from petrobot.coordinator.page.requests import LARGEST_BODY, json_answer, read_object, refused
from petrobot.coordinator.page.sessions import (
    LARGEST_MESSAGE,
    Session,
    carry_out,
    hang_up,
    who_is,
)
from petrobot.coordinator.page.task_store import TaskStore
from petrobot.services.comm.calls.link import stop_accepting

PAGE_FILES = (Path(__file__).parent / "static").resolve()
KEPT = "private, max-age=31536000, immutable"
"""Lets a browser keep a file of the page: another version has other addresses."""
LAST_COMMANDS_S = 1.0
"""Time for commands to complete at the end (s), among them the one that ended the run (`abort`)."""


class Page:
    """A served page: `url` holds the token; `await close()` ends it."""

    def __init__(
        self, runner: web.AppRunner, listening: asyncio.Server, page_state: PageState, url: str
    ) -> None:
        self._runner = runner
        self._listening = listening
        self._page_state = page_state
        self.url = url
        self.base = url.partition("/?")[0]
        """The address without the token."""
        self.token = page_state.access.token

    @property
    def limit(self) -> ConnectionLimit:
        """The factory of connections."""
        assert self._page_state.limit is not None
        return self._page_state.limit

    async def idle(self) -> None:
        """Wait until no command is being carried out."""
        while self._page_state.commands:
            await asyncio.wait(set(self._page_state.commands))

    async def close(self) -> None:
        """Close all connections and the port. The last commands are still answered, unless they
        take too long."""
        await stop_accepting(self._listening)
        self._page_state.closing = True
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LAST_COMMANDS_S):
                await self.idle()
        state = self._page_state
        transports = self.limit.transports()
        await asyncio.gather(*(session.leave() for session in state.sessions))
        await asyncio.gather(
            *(process.close() for process in (state.apart, state.checks, state.analyses))
        )
        await self._runner.cleanup()
        for transport in transports:
            hang_up(transport)
        for task in list(state.commands):
            task.cancel()
        await asyncio.gather(*state.commands, return_exceptions=True)


async def start_page(
    port_object: MissionPort,
    *,
    tasks_folder: Path,
    shipped: Path | None = None,
    port: int = 0,
    token: str | None = None,
    offers: Offers | None = None,
    runs: Path | None = None,
    starts: StartForm | None = None,
    services: Path | None = None,
    estimates: Path | None = None,
    plant: str = "",
    page: bool = True,
) -> Page:
    """Serve the page of a mission; without `page`, only the operator protocol: WebSocket, snapshot
    and commands.

    Tasks are saved in `tasks_folder`; those of `shipped` are offered, too, and saving one makes a
    copy there. `services` is the location file of the cell, whose code the check reads. `runs` has
    a folder for each recorded run. Forecasts take the numbers of `estimates`, a folder of estimates
    files or one of them, first those of `plant`. `port` 0 selects a free one. `token` is random
    unless given. Raises OSError if the port is in use."""
    # It listens at once: until then, another process could still take the port.
    listener = sockets.create_server((HOST, port), backlog=128)
    number = listener.getsockname()[1]
    access = AccessRules(token or secrets.token_hex(24), number)
    page_state = PageState(
        port_object,
        TaskStore(tasks_folder, shipped),
        access,
        offers,
        runs,
        starts,
        str(services.resolve()) if services else "",
        {"estimates": str(estimates or ""), "plant": plant},
    )
    runner = web.AppRunner(
        _application(page_state, page),
        access_log=None,
        keepalive_timeout=30.0,
        shutdown_timeout=1.0,
    )
    await runner.setup()
    assert runner.server is not None
    page_state.limit = ConnectionLimit(runner.server)
    listening = await asyncio.get_running_loop().create_server(
        page_state.limit, sock=listener, backlog=max(1, page_state.limit.limit // 4)
    )
    listener.listen(128)  # asyncio accepts `backlog` connections at once: few, of a long queue
    url = f"http://{HOST}:{number}/?token={access.token}"
    return Page(runner, listening, page_state, url)


def _application(page_state: PageState, page: bool) -> web.Application:
    @web.middleware
    async def count(request: web.Request, handler: Handler) -> web.StreamResponse:
        if page_state.limit is not None:
            page_state.limit.asked(request)
        return await handler(request)

    app = web.Application(
        middlewares=[count, middleware(page_state.access)], client_max_size=LARGEST_BODY
    )
    app[PAGE_STATE] = page_state
    add_routes(app)
    if page:
        app.router.add_get("/", _index)
        app.router.add_get("/page/{version}/{path:.+}", _file)
        documents.add_routes(app)
    return app


async def _index(request: web.Request) -> web.StreamResponse:
    access = request.app[PAGE_STATE].access
    if "token" in request.query:
        # The token disappears from the address bar and the history of the browser.
        away = web.HTTPSeeOther("/")
        access.hand_out(away)
        raise away
    front = (PAGE_FILES / "index.html").read_text(encoding="utf-8")
    return web.Response(
        text=front.replace('="/page/', f'="/page/{_version()}/'), content_type="text/html"
    )


def _version() -> str:
    """Digest of when the files of the page were changed, also after an update of a running server.
    No version comes twice, so a window opened before an update keeps nothing that a later one
    gets."""
    found = [(str(path), path.stat()) for path in sorted(PAGE_FILES.rglob("*"))]
    changed = [(path, s.st_size, s.st_mtime_ns, s.st_ctime_ns) for path, s in found]
    return hashlib.sha256(repr(changed).encode()).hexdigest()[:16]


async def _file(request: web.Request) -> web.StreamResponse:
    """A file of the page. Modules import each other relatively, so all have one version."""
    with contextlib.suppress(ValueError):  # a zero byte in the path
        path = (PAGE_FILES / request.match_info["path"]).resolve()
        if path.is_relative_to(PAGE_FILES) and path.is_file():
            return web.FileResponse(path, headers={"Cache-Control": KEPT})
    raise web.HTTPNotFound


# The live protocol over HTTP: the WebSocket, and the same commands and snapshot for scripts.

CLIENTS = 64


def add_routes(app: web.Application) -> None:
    """Add the routes of the live protocol."""
    app.router.add_get("/api/live", _live)
    app.router.add_get("/api/snapshot", _snapshot)
    app.router.add_post("/api/command", _command)
    app.router.add_get("/api/start/{name}", _start)


async def _live(request: web.Request) -> web.StreamResponse:
    page_state = request.app[PAGE_STATE]
    if len(page_state.sessions) >= CLIENTS:
        raise web.HTTPServiceUnavailable(text=f"{CLIENTS} clients are connected already")
    socket = web.WebSocketResponse(
        heartbeat=15.0, max_msg_size=LARGEST_MESSAGE, compress=False, timeout=0.5
    )
    if not socket.can_prepare(request).ok:
        raise web.HTTPUpgradeRequired(text="this address speaks WebSocket")
    try:
        await socket.prepare(request)
    except ConnectionError:  # The client left before it was answered, as when we were frozen.
        return web.Response()
    session = Session(
        socket, request.transport, page_state.port, page_state.encode_once, page_state.commands
    )
    page_state.sessions.add(session)
    try:
        await session.run()
    finally:
        page_state.left(session)
    return socket


async def _snapshot(request: web.Request) -> web.Response:
    snapshot = request.app[PAGE_STATE].port.snapshot()
    return json_answer({**snapshot, "type": "snapshot", "protocol": PROTOCOL})


async def _start(request: web.Request) -> web.Response:
    """The options for starting this task, with types and defaults."""
    starts = request.app[PAGE_STATE].starts
    if starts is None:
        raise web.HTTPNotFound(text="no run can be started here")
    try:
        return json_answer(await starts(request.match_info["name"]))
    except RefusedError as refusal:
        raise refused(refusal) from refusal


async def _command(request: web.Request) -> web.Response:
    """{name, verb, data}: for scripts. Their `who` is their name and digits of the token, the same
    at each call."""
    page_state = request.app[PAGE_STATE]
    body = await read_object(request)
    data = body.get("data", {})
    if not isinstance(data, dict):
        raise web.HTTPBadRequest(text="data must be an object")
    who = who_is(str(body.get("name", "script")), page_state.access.pass_value)
    answer = await carry_out(page_state.port, who, str(body.get("verb")), data)
    page_state.heard(who)
    return json_answer(answer, 200 if answer.get("ok") else 409)
