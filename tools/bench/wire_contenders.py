"""The contenders of `wire.py`: one echo service each, in a process of its own, called by another
process.

All of them carry the same record there and back: a name, three numbers and a text, by value.
"""

from __future__ import annotations

import asyncio
import os
import socket
import time
from collections.abc import Awaitable, Coroutine
from pathlib import Path
from typing import Any, ClassVar

from msgspec.structs import replace

from petrobot.services.comm.calls.callee import Callee, Offer
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.calls.server import Server
from petrobot.services.comm.location_file import parse
from petrobot.services.comm.protocol.messages import Call, Hello, Outcome
from petrobot.services.node.realtime import NodeShell
from tests.ports import free_ports

ROOT = Path(__file__).resolve().parents[2]
RECORD = {
    "name": "catch_point",
    "value": [1.0, 0.25, 0.6],
    "text": "a record of about one hundred bytes, by value",
}
KEY = bytes(range(32))
HOST = "127.0.0.1"


class Contender:
    """One way to call an echo service. `needs` is the module that must be installed."""

    name: ClassVar[str]
    needs: ClassVar[str] = ""

    def serve(self) -> None:
        """Print the port, then serve until the process is ended."""
        raise NotImplementedError

    def connect(self, port: int) -> None:
        """Be ready to ask the service on this port."""
        raise NotImplementedError

    def latencies(self, count: int, size: int, gap: float = 0.0) -> list[float]:
        """Seconds of each of `count` calls, one after the other, with a record (size 0) or so many
        bytes.

        With a `gap` (s) the other end sleeps before each call, as before an occasional call;
        without one, both stay awake.
        """
        raise NotImplementedError

    def rate(self, count: int, in_flight: int) -> float:
        """Return the calls per second with so many in progress at once."""
        raise NotImplementedError

    def close(self) -> None:
        """Disconnect from the service."""


def payload(size: int) -> Any:
    """Return what is sent there and back."""
    return bytes(size) if size else RECORD


class AsyncContender(Contender):
    """Base of contenders that use an asyncio loop."""

    def __init__(self) -> None:
        self.runner = asyncio.Runner()

    async def start(self) -> int:
        """Serve in this loop. Return the port."""
        raise NotImplementedError

    async def open(self, port: int) -> None:
        """Connect in this loop."""
        raise NotImplementedError

    def ask(self, value: Any) -> Awaitable[Any]:
        """One call."""
        raise NotImplementedError

    def serve(self) -> None:
        async def run() -> None:
            print(await self.start(), flush=True)
            await asyncio.Event().wait()

        self.runner.run(run())

    def connect(self, port: int) -> None:
        self.runner.run(self.open(port))

    def latencies(self, count: int, size: int, gap: float = 0.0) -> list[float]:
        async def run() -> list[float]:
            value, taken, clock = payload(size), [], time.perf_counter
            for _ in range(count):
                time.sleep(gap)
                began = clock()
                await self.ask(value)
                taken.append(clock() - began)
            return taken

        return self.runner.run(run())

    def rate(self, count: int, in_flight: int) -> float:
        async def one_after_the_other() -> None:
            for _ in range(count // in_flight):
                await self.ask(RECORD)

        async def run() -> float:
            began = time.perf_counter()
            await asyncio.gather(*(one_after_the_other() for _ in range(in_flight)))
            return count // in_flight * in_flight / (time.perf_counter() - began)

        return self.runner.run(run())

    def close(self) -> None:
        self.runner.run(self.leave())
        self.runner.close()

    def leave(self) -> Coroutine[Any, Any, None]:
        """Disconnect in this loop."""
        return asyncio.sleep(0)


class _Echo:
    """Sends back what comes."""

    transport: asyncio.Transport

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self.transport = transport
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def take(self, data: bytes) -> None:
        self.transport.write(data)


class _Asker(_Echo):
    """Counts the bytes that come back, and ignores their content."""

    def __init__(self) -> None:
        super().__init__()
        self.loop = asyncio.get_running_loop()
        self.have = 0
        self.waiting: list[tuple[int, asyncio.Future[None]]] = []

    def take(self, data: bytes) -> None:
        self.have += len(data)
        while self.waiting and self.have >= self.waiting[0][0]:
            size, future = self.waiting.pop(0)
            self.have -= size
            future.set_result(None)

    def ask(self, data: bytes) -> asyncio.Future[None]:
        future: asyncio.Future[None] = self.loop.create_future()
        self.waiting.append((len(data), future))
        self.transport.write(data)
        return future


class _Streamed(_Echo, asyncio.Protocol):
    def data_received(self, data: bytes) -> None:
        self.take(data)


class _StreamedAsker(_Asker, asyncio.Protocol):
    def data_received(self, data: bytes) -> None:
        self.take(data)


class _Buffered(_Echo, asyncio.BufferedProtocol):
    BUFFER = bytearray(1 << 18)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self.BUFFER

    def buffer_updated(self, nbytes: int) -> None:
        self.take(bytes(memoryview(self.BUFFER)[:nbytes]))


class _BufferedAsker(_Asker, asyncio.BufferedProtocol):
    BUFFER = bytearray(1 << 18)

    def get_buffer(self, sizehint: int) -> bytearray:
        return self.BUFFER

    def buffer_updated(self, nbytes: int) -> None:
        self.take(bytes(memoryview(self.BUFFER)[:nbytes]))


class Bare(AsyncContender):
    """asyncio alone: the bytes of one of our frames are sent back unchanged. All others are
    compared with it."""

    name = "bare asyncio echo"
    FRAME = bytes(170)
    echo: ClassVar[Any] = _Streamed
    asker: ClassVar[Any] = _StreamedAsker

    async def start(self) -> int:
        self.server = await asyncio.get_running_loop().create_server(self.echo, HOST, 0)
        return int(self.server.sockets[0].getsockname()[1])

    async def open(self, port: int) -> None:
        _, self.link = await asyncio.get_running_loop().create_connection(self.asker, HOST, port)

    def ask(self, value: Any) -> Awaitable[Any]:
        answer: Awaitable[Any] = self.link.ask(value if isinstance(value, bytes) else self.FRAME)
        return answer

    async def leave(self) -> None:
        self.link.transport.close()


class BareBuffered(Bare):
    """The same with `asyncio.BufferedProtocol`, which spares a fresh buffer of 256 KiB for each
    read."""

    name = "bare, buffered protocol"
    echo = _Buffered
    asker = _BufferedAsker


class Petrobot(AsyncContender):
    """A service in the node's loop."""

    name = "petrobot"
    key: ClassVar[bytes | None] = None

    async def start(self) -> int:
        def echo(now: float, call: Call) -> Outcome:
            return Outcome(call.id, "success", call.arguments)

        big = {kind: Outcome("", "success", {"v": value}) for kind, value in BIG.items()}

        def give(now: float, call: Call) -> Outcome:
            return replace(big[call.arguments["kind"]], id=call.id)

        def tell(now: float, call: Call) -> Outcome:
            callee.raise_event(now, "big", {"v": BIG["bytes"][: len(BIG["bytes"]) // 2]})
            return Outcome(call.id, "success")

        offers = {"echo": echo, "give": give, "tell": tell}
        callee = Callee("node", "b", {name: Offer(inline=one) for name, one in offers.items()})
        self.server = Server(callee, key=self.key)
        await self.server.start(HOST, 0)
        return self.server.address[1]

    async def open(self, port: int) -> None:
        caller = Caller("node", Hello(2, 2, "client", "bench", "b"))
        self.client = Client(HOST, port, caller, key=self.key)
        self.client.start()
        if not await self.client.connected(5.0):
            raise ConnectionError("the node does not answer")

    def ask(self, value: Any) -> Awaitable[Any]:
        return self.client.call(
            "echo", {"v": value} if isinstance(value, bytes) else value, deadline=10.0
        )

    def leave(self) -> Coroutine[Any, Any, None]:
        return self.client.close()


class PetrobotSealed(Petrobot):
    """The same with a MAC on each frame."""

    name = "petrobot, sealed"
    key = KEY


BIG: dict[str, Any] = {"bytes": bytes(4_000_000), "texts": ["x" * 28] * 130_000}
"""The large values: bytes, and as many texts as one message may have."""
BIG_KINDS = (
    "CALL of 4 MB, bytes",
    "CALL of 4 MB, texts",
    "RESULT of 4 MB, bytes",
    "RESULT of 4 MB, texts",
    "EVENT of 2 MB, bytes",
)


def load_with(kind: str, port: int) -> None:
    """Be the process that sends or receives large messages, one after the other, until it is
    killed."""
    name, value = kind.partition(" ")[0], kind.rpartition(" ")[2]

    async def run() -> None:
        caller = Caller("node", Hello(2, 2, "client", "loader", os.urandom(4).hex()))
        client = Client(HOST, port, caller, key=KEY)
        client.start()
        if not await client.connected(30.0):
            raise ConnectionError("the node does not answer")
        caller.subscribe(client.now(), ["big"])
        client.flush()
        service = {"CALL": "echo", "RESULT": "give", "EVENT": "tell"}[name]
        arguments = {"v": BIG[value]} if name == "CALL" else {"kind": value}
        while True:
            end = await client.call(service, arguments, deadline=30.0)
            if end.status != "success":
                raise RuntimeError(f"{end.cause}: {end.text}")
            print(end.status, flush=True)

    asyncio.run(run())


class PetrobotWorker(Petrobot):
    """An action in the warm worker process of its node, where every action of a robot runs."""

    name = "petrobot, in its worker"
    PLACES = """\
schema = 1
[nodes.node]
host = "127.0.0.1"
port = {port}
[actions]
echo = {{ run = "tools.bench.wire_action:echo", task = "echo", node = "node" }}
"""

    async def start(self) -> int:
        # where the worker finds the module of its action
        os.environ["PYTHONPATH"] = str(ROOT)
        port = free_ports(1)[0]
        text = self.PLACES.format(port=port)
        self.shell = NodeShell(parse(text, ROOT / "services.toml"), "node", text)
        await self.shell.start()
        return port
