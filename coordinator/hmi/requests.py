"""Reading JSON bodies and answering in JSON, the same for all handlers."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping, Sequence
from typing import Any

from aiohttp import web

from services.comm.json_text import json_text

BODY_S = 10.0
LARGEST_BODY = 2 * 1024 * 1024


async def read_object(request: web.Request) -> dict[str, Any]:
    """The JSON object in the body. Raises the HTTP answer that says what is wrong with it."""
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


def json_answer(value: Mapping[str, Any] | Sequence[Any], status: int = 200) -> web.Response:
    """An answer that no cache keeps."""
    body = json_text(value, ensure_ascii=False).encode("utf-8", "replace")  # a lone surrogate is no text
    return web.Response(
        body=body,
        status=status,
        content_type="application/json",
        charset="utf-8",
        headers={"Cache-Control": "no-store"},
    )
