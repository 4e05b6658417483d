"""The written side over HTTP: task files, what nodes offer, findings of the check, foreign formats, journals."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

from aiohttp import web

from coordinator.analysing import analyse_apart
from coordinator.hmi import verdicts
from coordinator.hmi.edits import EditError, Rename, parse, plain
from coordinator.hmi.house import HOUSE, House
from coordinator.hmi.requests import json_answer, read_object
from coordinator.hmi.store import Conflict, StoreError, TaskText

RENAMES_AT_MOST = 1000


def add_routes(app: web.Application) -> None:
    """The routes for documents."""
    app.router.add_get("/api/tasks", _list)
    app.router.add_get("/api/tasks/{name}", _open)
    app.router.add_put("/api/tasks/{name}", _save)
    app.router.add_post("/api/check", _check)
    app.router.add_post("/api/analyse", _analyse)
    app.router.add_get("/api/tasks/{name}/export/{form}", _export)
    app.router.add_post("/api/import", _import)
    app.router.add_get("/api/offers", _offers)
    app.router.add_get("/api/runs", _runs)
    app.router.add_get("/api/runs/{run}", _run)


async def _list(request: web.Request) -> web.Response:
    return json_answer(request.app[HOUSE].store.listed())


async def _open(request: web.Request) -> web.Response:
    house = request.app[HOUSE]
    try:
        return json_answer(await _described(house, house.store.read(request.match_info["name"])))
    except StoreError as fault:
        raise _refusal(fault) from fault


async def _save(request: web.Request) -> web.Response:
    """{base, document, renames} or, to settle a conflict, {base, text}; 409 gives both versions."""
    house, name = request.app[HOUSE], request.match_info["name"]
    body = await read_object(request)
    base = body.get("base")
    try:
        if isinstance(body.get("text"), str):
            saved = house.store.save_text(name, base, body["text"])
        else:
            saved = house.store.save(name, base, _document(body), _renames(body))
    except Conflict as conflict:
        theirs = await _described(house, conflict.theirs)
        return json_answer({"conflict": str(conflict), "yours": conflict.yours, "theirs": theirs}, 409)
    except StoreError as fault:
        raise _refusal(fault) from fault
    return json_answer(await _described(house, saved))


async def _check(request: web.Request) -> web.Response:
    """{name, document}: what the check says of a document that is being drawn, and the text that it would be saved as."""
    house = request.app[HOUSE]
    body = await read_object(request)
    name = str(body.get("name") or "new_task")
    try:
        current = house.store.read(name) if name in house.store.names() else None
        text = house.store.edited_text(current, _document(body), _renames(body))
    except StoreError as fault:
        raise _refusal(fault) from fault
    findings = await asyncio.to_thread(verdicts.findings, text, f"{name}.toml", _where(house))
    return json_answer({"findings": findings, "text": text})


async def _analyse(request: web.Request) -> web.Response:
    """{name, document}: verdicts on a document that is being drawn, and where its time goes; one analysis at a time."""
    house = request.app[HOUSE]
    body = await read_object(request)
    name = str(body.get("name") or "new_task")
    try:
        current = house.store.read(name) if name in house.store.names() else None
        text = house.store.edited_text(current, _document(body), _renames(body))
        async with house.analysing:
            return json_answer(await analyse_apart(text, f"{name}.toml"))
    except StoreError as fault:
        raise _refusal(fault) from fault
    except ValueError as fault:
        raise web.HTTPUnprocessableEntity(text=str(fault)) from fault


async def _export(request: web.Request) -> web.Response:
    house, form = request.app[HOUSE], request.match_info["form"]
    try:
        task = house.store.read(request.match_info["name"])
        made = await asyncio.to_thread(verdicts.export, task.text, f"{task.name}.toml", form)
    except StoreError as fault:
        raise _refusal(fault) from fault
    except verdicts.FormatError as fault:
        raise web.HTTPBadRequest(text=str(fault)) from fault
    return web.Response(
        text=made.text,
        content_type=made.content_type,
        headers={"Content-Disposition": f'attachment; filename="{task.name}.{form}"', "Cache-Control": "no-store"},
    )


async def _import(request: web.Request) -> web.Response:
    """{form, text}: a net in another format as a document to go on drawing."""
    body = await read_object(request)
    try:
        text = await asyncio.to_thread(verdicts.imported, str(body.get("form")), str(body.get("text")))
        return json_answer({"document": plain(parse(text))})
    except (verdicts.FormatError, EditError) as fault:
        raise web.HTTPBadRequest(text=str(fault)) from fault


async def _offers(request: web.Request) -> web.Response:
    offers = request.app[HOUSE].offers
    return json_answer(list(offers()) if offers is not None else [])


async def _runs(request: web.Request) -> web.Response:
    history = request.app[HOUSE].history
    return json_answer(list(await history.runs()) if history is not None else [])


async def _run(request: web.Request) -> web.Response:
    history = request.app[HOUSE].history
    try:
        if history is None:
            raise KeyError
        return json_answer(await history.open(request.match_info["run"]))
    except KeyError:
        raise web.HTTPNotFound(text="no such run") from None


async def _described(house: House, task: TaskText) -> dict[str, Any]:
    try:
        document = plain(parse(task.text))
    except EditError as fault:
        raise web.HTTPUnprocessableEntity(text=f"{task.name}.toml: {fault}") from fault
    findings = await asyncio.to_thread(verdicts.findings, task.text, f"{task.name}.toml", _where(house))
    return {
        "name": task.name,
        "revision": task.revision,
        "own": task.own,
        "text": task.text,
        "document": document,
        "findings": findings,
    }


def _where(house: House) -> dict[str, str] | None:
    if house.offers is None:
        return None
    return {str(offer["action"]): str(offer["node"]) for offer in house.offers()}


def _document(body: Mapping[str, Any]) -> dict[str, Any]:
    document = body.get("document")
    if not isinstance(document, dict):
        raise web.HTTPBadRequest(text="document is an object")
    return document


def _renames(body: Mapping[str, Any]) -> list[Rename]:
    given = body.get("renames", [])
    try:
        return [Rename(tuple(map(str, r["path"])), str(r["old"]), str(r["new"])) for r in given[:RENAMES_AT_MOST]]
    except (TypeError, KeyError):
        raise web.HTTPBadRequest(text="a rename is {path, old, new}") from None


def _refusal(fault: StoreError) -> web.HTTPException:
    by_status: dict[int, type[web.HTTPException]] = {404: web.HTTPNotFound, 413: web.HTTPForbidden}
    return by_status.get(fault.status, web.HTTPBadRequest)(text=str(fault))
