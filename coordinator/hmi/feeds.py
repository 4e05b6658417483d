"""The live side over HTTP: the WebSocket, and the same commands and snapshot for scripts."""

from __future__ import annotations

from aiohttp import web

from petrobot.coordinator.analysing import RefusedError
from petrobot.coordinator.hmi.house import HOUSE
from petrobot.coordinator.hmi.port import PROTOCOL
from petrobot.coordinator.hmi.requests import json_answer, read_object, refused
from petrobot.coordinator.hmi.sessions import LARGEST_MESSAGE, Session, carry_out, who_is

CLIENTS = 64


def add_routes(app: web.Application) -> None:
    """The live routes."""
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
    """What may be asked for when this task is started, with types and defaults."""
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
        raise web.HTTPBadRequest(text="data is an object")
    who = who_is(str(body.get("name", "script")), house.doors.pass_value)
    answer = await carry_out(house.port, who, str(body.get("verb")), data)
    house.heard(who)
    return json_answer(answer, 200 if answer.get("ok") else 409)
