"""Read JSON bodies and answer in JSON, for all handlers."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

from aiohttp import web

from petrobot.coordinator.background import RefusedError
from petrobot.coordinator.page.access import HEADERS
from petrobot.services.host.json_text import json_text

BODY_S = 10.0
LARGEST_BODY = 2 * 1024 * 1024
PIECE = 256 * 1024
"""Size of a piece of a long answer (bytes)."""


async def read_object(request: web.Request) -> dict[str, Any]:
    """Return the JSON object in the body. Raises the HTTP answer that explains its fault."""
    try:
        async with asyncio.timeout(BODY_S):
            text = await request.text()
    except TimeoutError:
        raise web.HTTPRequestTimeout(text="the body did not arrive") from None
    except UnicodeDecodeError:
        raise web.HTTPBadRequest(text="the body is not UTF-8 text") from None
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        raise web.HTTPBadRequest(text="the body is not JSON") from None
    if not isinstance(value, dict):
        raise web.HTTPBadRequest(text="send one JSON object")
    return value


async def send_json(request: web.Request, text: bytes) -> web.StreamResponse:
    """Answer with JSON text in pieces, so that a long answer does not delay other clients."""
    headers = {**HEADERS, "Content-Type": "application/json; charset=utf-8"}
    response = web.StreamResponse(headers=headers)
    response.content_length = len(text)
    with contextlib.suppress(ConnectionError):  # The client has left meanwhile.
        await response.prepare(request)
        for begin in range(0, len(text), PIECE):
            await response.write(text[begin : begin + PIECE])
        await response.write_eof()
    return response


def json_answer(value: Mapping[str, Any] | Sequence[Any], status: int = 200) -> web.Response:
    """Return a value as an answer in JSON."""
    # A lone surrogate is not valid text.
    body = json_text(value, ensure_ascii=False).encode("utf-8", "replace")
    return web.Response(
        body=body,
        status=status,
        content_type="application/json",
        charset="utf-8",
    )


def refused(refusal: RefusedError) -> web.HTTPException:
    """Return the HTTP answer to work that could not be done."""
    by_status: dict[int, type[web.HTTPException]] = {
        404: web.HTTPNotFound,
        409: web.HTTPConflict,
        413: web.HTTPForbidden,
        422: web.HTTPUnprocessableEntity,
        500: web.HTTPInternalServerError,
    }
    return by_status.get(refusal.status, web.HTTPBadRequest)(text=str(refusal))
