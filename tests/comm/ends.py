"""A server and a client on real sockets that record what they receive."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import zlib
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from petrobot.services.comm.calls.callee import Callee, Offer, Order
from petrobot.services.comm.calls.caller import Caller, Notice
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.calls.link import AsyncLink, LinkTiming
from petrobot.services.comm.calls.server import Server
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.codec import encode
from petrobot.services.comm.protocol.wire import Connection, Side

QUICK = LinkTiming(heartbeat=0.05, silence=0.2, handshake=0.3, backoff=(0.01, 0.05))
HELLO = m.Hello(2, 2, "coordinator", "coord", "c1", 1)


def _echo(now: float, call: m.Call) -> m.Outcome:
    return m.Outcome(call.id, "success", call.arguments)


def _callee(name: str = "motion") -> Callee:
    offers = {
        "echo": Offer(inline=_echo),
        "big": Offer(
            inline=lambda now, call: m.Outcome(call.id, "success", {"b": bytes(17 << 20)})
        ),
        "move": Offer(device="arm", orphan_time=0.1),
    }
    return Callee(name, "n1", offers)


class Node:
    """A server that records the orders it receives."""

    def __init__(self, **options: Any) -> None:
        self.orders: list[Order] = []
        self.server = Server(_callee(), on_orders=self._take, **{"timing": QUICK, **options})
        self.ordered = asyncio.Event()

    def _take(self, now: float, orders: list[Order]) -> None:
        self.orders += orders
        self.ordered.set()

    async def order(self, kind: type[Any]) -> Any:
        """Wait for the next order of this kind."""
        async with asyncio.timeout(60.0):
            while not any(isinstance(order, kind) for order in self.orders):
                self.ordered.clear()
                await self.ordered.wait()
        return next(order for order in self.orders if isinstance(order, kind))

    def client(self, hello: m.Hello = HELLO, **options: Any) -> Coordinator:
        return Coordinator(*self.server.address, hello, **options)


class Coordinator:
    """A client that records the notices it receives."""

    def __init__(self, host: str, port: int, hello: m.Hello = HELLO, **options: Any) -> None:
        self.notices: list[Notice] = []
        self.told = asyncio.Event()
        self.caller = Caller("motion", hello)
        self.client = Client(
            host, port, self.caller, on_notices=self._take, **{"timing": QUICK, **options}
        )
        self.client.start()

    def _take(self, now: float, notices: list[Notice]) -> None:
        self.notices += notices
        self.told.set()

    async def notice(self, kind: type[Any], number: int = 1) -> Any:
        """Wait for the `number`-th notice of this kind and return it."""
        async with asyncio.timeout(60.0):
            while (
                len(found := [notice for notice in self.notices if isinstance(notice, kind)])
                < number
            ):
                self.told.clear()
                await self.told.wait()
        return found[number - 1]

    def call(self, id_: str, service: str, **arguments: Any) -> None:
        self.caller.call(self.client.now(), m.Call(id_, service, arguments))
        self.client.flush()


@contextlib.asynccontextmanager
async def slow_line(address: tuple[str, int], **rates: float) -> AsyncIterator[tuple[str, int]]:
    """Open a line to this address that carries `up` or `down` bytes per second; the other direction
    is fast. Yield the address of its near end."""
    ends: list[asyncio.StreamWriter] = []

    async def carry(source: asyncio.StreamReader, to: asyncio.StreamWriter, rate: float) -> None:
        with contextlib.suppress(ConnectionError):
            while data := await source.read(1 << 15):
                to.write(data)
                await to.drain()
                await asyncio.sleep(len(data) / rate)
        to.close()

    async def join(source: asyncio.StreamReader, to: asyncio.StreamWriter) -> None:
        far = socket.socket()
        far.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
        far.setblocking(False)
        await asyncio.get_running_loop().sock_connect(far, address)
        answers, calls = await asyncio.open_connection(sock=far)
        ends.extend((to, calls))
        up, down = rates.get("up", 1e9), rates.get("down", 1e9)
        await asyncio.gather(carry(source, calls, up), carry(answers, to, down))

    server = await asyncio.start_server(join, "127.0.0.1", 0)
    yield server.sockets[0].getsockname()
    for end in ends:
        end.close()
    server.close()
    await server.wait_closed()


async def until(condition: Callable[[], bool]) -> None:
    """Wait until the condition holds; check it after every step of a server, a client or a
    heartbeat."""
    stirred = asyncio.Event()
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in (
            (Server, "flush"),
            (Server, "gone"),
            (Client, "flush"),
            (AsyncLink, "_beat"),
        ):
            patch.setattr(owner, name, _and_then(getattr(owner, name), stirred.set))
        async with asyncio.timeout(60.0):
            while not condition():
                stirred.clear()
                await stirred.wait()


def _and_then(method: Callable[..., Any], do: Callable[[], None]) -> Callable[..., Any]:
    def both(*arguments: Any) -> Any:
        result = method(*arguments)
        do()
        return result

    return both


def frame(message: m.Message, server: str = "motion") -> bytes:
    """Return a message's bytes on the wire to `server`, without a key. HELLO is framed as in the
    handshake, any other message as on an open connection."""
    if isinstance(message, m.Hello):
        return Connection(Side.CLIENT, server).send(message)
    return framed(encode(message))


def framed(body: bytes) -> bytes:
    """Frame a body as on an open connection without a key."""
    return head(len(body) + 4) + body + zlib.crc32(body).to_bytes(4, "big")


def head(length: int) -> bytes:
    """Return the first four bytes of a frame."""
    return length.to_bytes(4, "big")


def welcome(hello: bytes, name: str = "motion") -> bytes:
    """Return the answer of a server of this name to these bytes of a HELLO."""
    server = Connection(Side.SERVER, name)
    server.receive_data(hello)
    return server.send(m.Welcome(2, name, "n1", ("echo",)))


async def read_all(reader: asyncio.StreamReader) -> bytes:
    """Read until the other end closes the connection."""
    with contextlib.suppress(ConnectionError):
        return await reader.read()
    return b""
