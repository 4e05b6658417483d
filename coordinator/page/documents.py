"""Documents over HTTP: task files, offers of the nodes, findings of the check, other formats,
journals.

Nothing here reads a document: all long work is done in a separate process, and its result is passed
on unchanged.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from aiohttp import web

from petrobot.coordinator.background import BackgroundProcess, RefusedError
from petrobot.coordinator.page.app_state import PAGE_STATE, PageState
from petrobot.coordinator.page.requests import json_answer, read_object, refused, send_json
from petrobot.coordinator.page.task_store import StoreError

RENAMES_AT_MOST = 1000
DESK_AT_MOST = 64


def add_routes(app: web.Application) -> None:
    """Add the routes for documents."""
    app.router.add_get("/api/tasks", _list)
    app.router.add_get("/api/tasks/{name}", _open)
    app.router.add_put("/api/tasks/{name}", _save)
    app.router.add_get("/api/revisions/{name}", _revision)
    app.router.add_post("/api/check", _check)
    app.router.add_post("/api/analyse", _analyse)
    app.router.add_get("/api/tasks/{name}/export/{form}", _export)
    app.router.add_post("/api/import", _import)
    app.router.add_get("/api/offers", _offers)
    app.router.add_get("/api/runs", _runs)
    app.router.add_get("/api/runs/{run}", _run)


async def _list(request: web.Request) -> web.Response:
    return json_answer(request.app[PAGE_STATE].store.listed())


async def _open(request: web.Request) -> web.StreamResponse:
    return await _done(request, "opening", _file(request))


async def _revision(request: web.Request) -> web.Response:
    """{revision}: shows whether a file is still the one that was opened; cheap enough for a request
    every few seconds."""
    try:
        return json_answer(
            {"revision": request.app[PAGE_STATE].store.read(request.match_info["name"]).revision}
        )
    except StoreError as fault:
        raise refused(fault) from fault


async def _save(request: web.Request) -> web.StreamResponse:
    """{base, document, renames} or, to resolve a conflict, {base, text}; 409 returns both
    versions."""
    body = await read_object(request)
    content = (
        {"text": body["text"]}
        if isinstance(body.get("text"), str)
        else {"document": _document(body)}
    )
    given = {**_file(request), "base": body.get("base"), "content": content, **_renames(body)}
    return await _done(request, "saving", given)


async def _check(request: web.Request) -> web.StreamResponse:
    """{name, document, desk}: the findings for an unsaved document, and the text that it would be
    saved as.

    Earlier requests from the same desk, including analyses, are cancelled: they were about an older
    drawing.
    """
    page_state = request.app[PAGE_STATE]
    body = await read_object(request)
    desk = _desk(body)
    page_state.analyses.give_up(desk)
    given = {**_drawing(page_state, body), **_known(page_state)}
    return await _answered(request, page_state.checks, "check", given, desk)


async def _analyse(request: web.Request) -> web.StreamResponse:
    """{name, document, desk}: verdicts on an unsaved document, and how its time is spent; one
    analysis at a time."""
    page_state = request.app[PAGE_STATE]
    body = await read_object(request)
    drawing = _drawing(page_state, body)
    try:
        text = json.loads(await page_state.apart.do("drawing", drawing))["text"]
        given = {"text": text, "filename": f"{drawing['name']}.toml", **_known(page_state)}
        given |= page_state.numbers
        said = await page_state.analyses.do("analysis", given, _desk(body))
    except RefusedError as refusal:
        return _refusal(refusal)
    return await send_json(request, said)


async def _export(request: web.Request) -> web.Response:
    name, form = request.match_info["name"], request.match_info["form"]
    page_state = request.app[PAGE_STATE]
    given = {**_file(request), "form": form, **page_state.numbers}
    try:
        made = json.loads(await page_state.apart.do("export", given))
    except RefusedError as refusal:
        raise refused(refusal) from refusal
    return web.Response(
        text=made["text"],
        content_type=made["content_type"],
        headers={"Content-Disposition": f'attachment; filename="{name}.{form}"'},
    )


async def _import(request: web.Request) -> web.StreamResponse:
    """{form, text}: a net in another format as a document that can be edited."""
    body = await read_object(request)
    return await _done(
        request, "import", {"form": str(body.get("form")), "text": str(body.get("text"))}
    )


async def _offers(request: web.Request) -> web.Response:
    offers = request.app[PAGE_STATE].offers
    return json_answer(list(offers()) if offers is not None else [])


async def _runs(request: web.Request) -> web.StreamResponse:
    runs = request.app[PAGE_STATE].runs
    return json_answer([]) if runs is None else await _done(request, "runs", {"folder": str(runs)})


async def _run(request: web.Request) -> web.StreamResponse:
    runs = request.app[PAGE_STATE].runs
    if runs is None:
        raise web.HTTPNotFound(text="no such run")
    return await _done(request, "run", {"folder": str(runs), "run": request.match_info["run"]})


async def _done(request: web.Request, work: str, given: Mapping[str, Any]) -> web.StreamResponse:
    """Have work on documents or journals done, and pass on its result."""
    return await _answered(request, request.app[PAGE_STATE].apart, work, given)


async def _answered(
    request: web.Request,
    process: BackgroundProcess,
    work: str,
    given: Mapping[str, Any],
    desk: str = "",
) -> web.StreamResponse:
    try:
        said = await process.do(work, given, desk)
    except RefusedError as refusal:
        return _refusal(refusal)
    return await send_json(request, said)


def _refusal(refusal: RefusedError) -> web.Response:
    """Return the answer to work that was not done. Raises it if it holds only a text."""
    if refusal.more:
        return json_answer(refusal.more, refusal.status)
    raise refused(refusal) from refusal


def _file(request: web.Request) -> dict[str, Any]:
    """Return the task file that a request names, and the cell."""
    page_state = request.app[PAGE_STATE]
    named = {"name": request.match_info["name"], "cell": _cell(page_state)}
    return {**page_state.store.folders, **named}


def _desk(body: Mapping[str, Any]) -> str:
    return str(body.get("desk") or "")[:DESK_AT_MOST]


def _cell(page_state: PageState) -> dict[str, Any] | None:
    """Return the fields of the `Cell` that the nodes are."""
    if page_state.offers is None:
        return None
    offers = list(page_state.offers())
    return {
        "offers": {str(offer["action"]): str(offer["node"]) for offer in offers},
        "devices": {str(o["action"]): str(o["device"]) for o in offers if o["device"]},
    }


def _known(page_state: PageState) -> dict[str, Any]:
    """Return what is known of the cell: the fields of its `Cell`, and its location file."""
    return {"cell": _cell(page_state), "services": page_state.services}


def _drawing(page_state: PageState, body: Mapping[str, Any]) -> dict[str, Any]:
    named = {"name": str(body.get("name") or "new_task"), "document": _document(body)}
    return {**page_state.store.folders, **named, **_renames(body)}


def _document(body: Mapping[str, Any]) -> dict[str, Any]:
    document = body.get("document")
    if not isinstance(document, dict):
        raise web.HTTPBadRequest(text="document must be an object")
    return document


def _renames(body: Mapping[str, Any]) -> dict[str, Any]:
    given = body.get("renames", [])
    if not isinstance(given, list):
        raise web.HTTPBadRequest(text="renames must be a list of {path, old, new}")
    return {"renames": given[:RENAMES_AT_MOST]}
