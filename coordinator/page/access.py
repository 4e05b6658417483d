"""Access control: the checks of each request before anything else, and the headers of each answer.

They protect against other users of this host (token), a web page in the operator's browser that
posts or opens a WebSocket to this server (Origin, Sec-Fetch-Site, JSON only), DNS rebinding (Host),
and script in names and reasons (Content-Security-Policy; the page also never builds markup from
text).
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
from collections.abc import Awaitable, Callable
from functools import cached_property

from aiohttp import web
from aiohttp.typedefs import Middleware
from msgspec import Struct

from petrobot.services.comm.calls.link import allowed

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]

HEADERS = {
    # For all but the files of the page, whose address names their version
    "Cache-Control": "no-store",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: "
        "blob:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
READING = frozenset({"GET", "HEAD"})
HOST = "127.0.0.1"
"""The page is served on this computer only; from another one it is reached through a tunnel."""
NAMES = (HOST, "localhost", "[::1]")
"""Names under which browsers of this computer reach it."""


class AccessRules(Struct, frozen=True, dict=True):
    """Allow-lists and secret of one server."""

    token: str
    port: int

    @cached_property
    def cookie(self) -> str:
        """Name of the cookie."""
        return f"petrobot_{self.port}"

    @cached_property
    def pass_value(self) -> str:
        """Value of the cookie: derived from the token, so that a leaked cookie does not reveal the
        token."""
        return hmac.new(self.token.encode(), b"petrobot page cookie", hashlib.sha256).hexdigest()

    @property
    def hosts(self) -> frozenset[str]:
        """Accepted values of the Host header."""
        return frozenset(f"{name}:{self.port}" for name in NAMES)

    @property
    def origins(self) -> frozenset[str]:
        """Accepted values of the Origin header."""
        return frozenset(f"http://{host}" for host in self.hosts)

    def fault(self, request: web.Request) -> web.HTTPException | None:
        """Return why a request is refused, or None. The front page with `?token=` passes here; the
        server replaces the token by a cookie."""
        if request.headers.get("Host", "").lower() not in self.hosts:
            return web.HTTPMisdirectedRequest(text="this server does not answer to that name")
        origin = request.headers.get("Origin")
        if origin is not None and origin.lower() not in self.origins:
            return web.HTTPForbidden(text="requests from other pages are refused")
        if request.headers.get("Sec-Fetch-Site", "none") not in ("same-origin", "none"):
            return web.HTTPForbidden(text="requests from other sites are refused")
        if not self._known(request):
            return web.HTTPUnauthorized(
                text="open the address with its token, as printed when petrobot started"
            )
        changes = (
            request.method not in READING
            or request.headers.get("Upgrade", "").lower() == "websocket"
        )
        if changes and origin is None and not self._bearer(request):
            return web.HTTPForbidden(
                text="a browser must send its Origin, a script its token as Bearer"
            )
        if request.method not in READING and request.content_type != "application/json":
            return web.HTTPUnsupportedMediaType(text="send JSON as application/json")
        return None

    def _known(self, request: web.Request) -> bool:
        if self._bearer(request):
            return True
        if hmac.compare_digest(
            request.cookies.get(self.cookie, "").encode(), self.pass_value.encode()
        ):
            return True
        return self.is_first_visit(request)

    def _bearer(self, request: web.Request) -> bool:
        given = request.headers.get("Authorization", "")
        return hmac.compare_digest(
            given.encode("utf-8", "replace"), f"Bearer {self.token}".encode()
        )

    def is_first_visit(self, request: web.Request) -> bool:
        """Return whether this requests the front page with the right token in the address."""
        given = request.query.get("token", "").encode("utf-8", "replace")
        return (
            request.method == "GET"
            and request.path == "/"
            and hmac.compare_digest(given, self.token.encode())
        )

    def hand_out(self, response: web.StreamResponse) -> None:
        """Set the browser's cookie. It has no age: it is worthless when this server ends, and a
        page that is open for longer than any age must still connect, and stop, again."""
        response.set_cookie(
            self.cookie, self.pass_value, httponly=True, samesite="Strict", path="/"
        )


def middleware(access: AccessRules) -> Middleware:
    """Return the aiohttp middleware that refuses requests and adds the headers to every answer,
    including refusals and errors."""

    @web.middleware
    async def guard(request: web.Request, handler: Handler) -> web.StreamResponse:
        fault = access.fault(request)
        try:
            if fault is not None:
                raise fault
            response = await handler(request)
        except web.HTTPException as refusal:
            refusal.headers.update(HEADERS)
            raise
        if not response.prepared:
            for name, value in HEADERS.items():
                response.headers.setdefault(name, value)
        return response

    return guard


# --- connections ---

CONNECTIONS = 128
SILENT_S = 10.0
"""A connection without a complete request header in this time (s) is closed (slow-loris)."""


class _Refused(asyncio.Protocol):
    """Closes a connection above the limit at once."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()


class ConnectionLimit:
    """A protocol factory around aiohttp's that counts and times connections."""

    def __init__(
        self, server: web.Server, limit: int | None = None, silent: float = SILENT_S
    ) -> None:
        """`limit`: `CONNECTIONS`, or fewer if the process may open few files."""
        self._server = server
        self.limit = allowed(CONNECTIONS, 4) if limit is None else limit
        self.silent = silent
        self._waiting: dict[web.RequestHandler, None] = {}
        """Connections that have asked for nothing yet, the oldest first."""
        self._coming = 0

    def __call__(self) -> asyncio.Protocol:
        """Return the protocol of a new connection. Above the limit it takes the place of the oldest
        one that has asked for nothing yet."""
        if self.open_connections >= self.limit:
            if not self._waiting:
                return _Refused()
            self._end_if_silent(next(iter(self._waiting)))
        handler = self._server()
        self._waiting[handler] = None
        self._coming += 1  # aiohttp counts it one iteration of the event loop later.
        loop = asyncio.get_running_loop()
        loop.call_soon(self._came)
        loop.call_later(self.silent, self._end_if_silent, handler)
        return handler

    @property
    def open_connections(self) -> int:
        """Number of open connections."""
        return len(self._server.connections) + self._coming

    def transports(self) -> list[asyncio.Transport | None]:
        """Return the transports of the open connections; None where aiohttp has closed it."""
        return [handler.transport for handler in self._server.connections]

    def _came(self) -> None:
        self._coming -= 1

    def asked(self, request: web.Request) -> None:
        """Note that a connection has sent a complete request header."""
        self._waiting.pop(request.protocol, None)

    def _end_if_silent(self, handler: web.RequestHandler) -> None:
        if handler not in self._waiting:
            return
        del self._waiting[handler]
        if handler.transport is not None:
            handler.force_close()
