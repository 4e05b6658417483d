"""A node in the test's own event loop."""

from __future__ import annotations

import asyncio

from petrobot.services.comm.calls.server import Server
from petrobot.services.node.node import Node
from tests.waiting import beat


class NodeInLoop:
    """Serves a node: it listens, and does what is due every 4 ms, as a process of its own would."""

    def __init__(self, node: Node, address: tuple[str, int]) -> None:
        self.node = node
        self.server = Server(node.callee, on_orders=node.obey)
        self._address = address
        self._pump: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Listen, and go on."""
        await self.server.start(*self._address)
        self._pump = asyncio.create_task(self._advance())

    async def _advance(self) -> None:
        while True:
            self.node.advance(self.server.now())
            self.server.flush()
            await beat(0.004)

    async def close(self) -> None:
        """Leave."""
        if self._pump is not None:
            self._pump.cancel()
            await asyncio.gather(self._pump, return_exceptions=True)
        await self.server.close()
