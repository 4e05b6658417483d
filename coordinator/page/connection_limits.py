"""Keeps the number of open connections bounded, and closes those that never ask for anything."""

from __future__ import annotations

import asyncio

from aiohttp import web

CONNECTIONS = 128
SILENT_S = 10.0
"""A connection that has not sent one whole request head in this time is closed (slow-loris)."""


class _Turned(asyncio.Protocol):
    """Answers a connection too many by closing it."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()


class Gate:
    """A protocol factory around aiohttp's that counts and times connections."""

    def __init__(
        self, server: web.Server, limit: int = CONNECTIONS, silent: float = SILENT_S
    ) -> None:
        self._server = server
        self._limit = limit
        self.silent = silent
        self._waiting: set[asyncio.BaseProtocol] = set()
        self._coming = 0
        self.turned_away = 0

    def __call__(self) -> asyncio.Protocol:
        """The protocol of a new connection."""
        if self.open_connections >= self._limit:
            self.turned_away += 1
            return _Turned()
        handler = self._server()
        self._waiting.add(handler)
        self._coming += 1  # aiohttp counts it one turn of the loop later
        loop = asyncio.get_running_loop()
        loop.call_soon(self._came)
        loop.call_later(self.silent, self._end_if_silent, handler)
        return handler

    @property
    def open_connections(self) -> int:
        """Connections that are open now."""
        return len(self._server.connections) + self._coming

    def _came(self) -> None:
        self._coming -= 1

    def asked(self, request: web.Request) -> None:
        """Note that a connection has sent a whole request head."""
        self._waiting.discard(request.protocol)

    def _end_if_silent(self, handler: web.RequestHandler) -> None:
        if handler not in self._waiting:
            return
        self._waiting.discard(handler)
        if handler.transport is not None:
            handler.force_close()
