"""Limit the number of open connections, and close those that never send a request."""

from __future__ import annotations

import asyncio

from aiohttp import web

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
        self, server: web.Server, limit: int = CONNECTIONS, silent: float = SILENT_S
    ) -> None:
        self._server = server
        self._limit = limit
        self.silent = silent
        self._waiting: set[asyncio.BaseProtocol] = set()
        self._coming = 0

    def __call__(self) -> asyncio.Protocol:
        """Return the protocol of a new connection."""
        if self.open_connections >= self._limit:
            return _Refused()
        handler = self._server()
        self._waiting.add(handler)
        self._coming += 1  # aiohttp counts it one iteration of the event loop later.
        loop = asyncio.get_running_loop()
        loop.call_soon(self._came)
        loop.call_later(self.silent, self._end_if_silent, handler)
        return handler

    @property
    def open_connections(self) -> int:
        """Number of open connections."""
        return len(self._server.connections) + self._coming

    def _came(self) -> None:
        self._coming -= 1

    def asked(self, request: web.Request) -> None:
        """Note that a connection has sent a complete request header."""
        self._waiting.discard(request.protocol)

    def _end_if_silent(self, handler: web.RequestHandler) -> None:
        if handler not in self._waiting:
            return
        self._waiting.discard(handler)
        if handler.transport is not None:
            handler.force_close()
