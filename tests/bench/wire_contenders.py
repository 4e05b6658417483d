"""The contenders of `wire.py`: one echo service each, served by a process of its own, asked by the benchmark's process.

All carry the same record there and back: a name, three numbers and a text, by value. Each is used as its own manual
says for speed: Pyro5 with msgpack and a proxy a thread, RPyC with tuples (dicts travel by reference), pyzmq and grpc on asyncio.
"""

from __future__ import annotations

import asyncio
import importlib
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar

import msgpack

from services.comm.callee import Callee, Offer
from services.comm.caller import Caller
from services.comm.client import Client
from services.comm.messages import Call, Hello, Outcome
from services.comm.server import Server

RECORD = {"name": "catch_point", "value": [1.0, 0.25, 0.6], "text": "a record of about one hundred bytes, by value"}
KEY = bytes(range(32))
HOST = "127.0.0.1"


class Contender:
    """One way to call an echo service. `needs` is the module that must be installed."""

    name: ClassVar[str]
    needs: ClassVar[str] = ""

    def serve(self) -> None:
        """Serve for ever; prints the port first."""
        raise NotImplementedError

    def connect(self, port: int) -> None:
        """Be ready to ask the service on this port."""
        raise NotImplementedError

    def latencies(self, count: int, size: int, gap: float = 0.0) -> list[float]:
        """Seconds of each of `count` calls, one after the other, with a record (size 0) or so many bytes.

        With a `gap` (s) each call finds the other end asleep, as a call now and then does; without, both stay awake.
        """
        raise NotImplementedError

    def rate(self, count: int, in_flight: int) -> float:
        """Calls per second with so many under way at once."""
        raise NotImplementedError

    def close(self) -> None:
        """Leave the service."""


def payload(size: int) -> Any:
    """What is sent there and back."""
    return bytes(size) if size else RECORD


class AsyncContender(Contender):
    """Base of those that live in an asyncio loop."""

    def __init__(self) -> None:
        self.runner = asyncio.Runner()

    async def start(self) -> int:
        """Serve in this loop; gives the port."""
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
    """Counts the bytes that come back; knows no more of the protocol."""

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
    """asyncio alone: the bytes of our own frame are sent back as they came. The measure of all others."""

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
    """The same with `asyncio.BufferedProtocol`, which spares a fresh buffer of 256 KiB for each read."""

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

        self.server = Server(Callee("node", "b", {"echo": Offer(inline=echo)}), key=self.key)
        await self.server.start(HOST, 0)
        return self.server.address[1]

    async def open(self, port: int) -> None:
        caller = Caller("node", Hello(1, 1, "client", "bench", "b"))
        self.client = Client(HOST, port, caller, key=self.key)
        self.client.start()
        if not await self.client.connected(5.0):
            raise ConnectionError("the node does not answer")

    def ask(self, value: Any) -> Awaitable[Any]:
        return self.client.call("echo", {"v": value} if isinstance(value, bytes) else value, deadline=10.0)

    def leave(self) -> Coroutine[Any, Any, None]:
        return self.client.close()


class PetrobotSealed(Petrobot):
    """The same with a MAC on each frame."""

    name = "petrobot, sealed"
    key = KEY


class Pyro(Contender):
    """Pyro5 with msgpack, a proxy a thread."""

    name = "Pyro5"
    needs = "Pyro5"

    def serve(self) -> None:
        api = importlib.import_module("Pyro5.api")

        class Echo:
            @api.expose  # type: ignore[untyped-decorator]
            def echo(self, value: Any) -> Any:
                return value

        daemon = api.Daemon(host=HOST, port=0)
        daemon.register(Echo(), "echo")
        print(daemon.locationStr.rpartition(":")[2], flush=True)
        daemon.requestLoop()

    def connect(self, port: int) -> None:
        self.api = importlib.import_module("Pyro5.api")
        self.api.config.SERIALIZER = "msgpack"
        self.uri = f"PYRO:echo@{HOST}:{port}"
        self.own = threading.local()

    def _proxy(self) -> Any:
        if not hasattr(self.own, "proxy"):
            self.own.proxy = self.api.Proxy(self.uri)
        return self.own.proxy

    def latencies(self, count: int, size: int, gap: float = 0.0) -> list[float]:
        value, proxy, taken = payload(size), self._proxy(), []
        for _ in range(count):
            time.sleep(gap)
            began = time.perf_counter()
            proxy.echo(value)
            taken.append(time.perf_counter() - began)
        return taken

    def rate(self, count: int, in_flight: int) -> float:
        def several() -> None:
            proxy = self.api.Proxy(self.uri)
            for _ in range(count // in_flight):
                proxy.echo(RECORD)

        began = time.perf_counter()
        with ThreadPoolExecutor(in_flight) as pool:
            for future in [pool.submit(several) for _ in range(in_flight)]:
                future.result()
        return count // in_flight * in_flight / (time.perf_counter() - began)


class Rpyc(Contender):
    """RPyC with records as tuples, which it passes by value."""

    name = "RPyC"
    needs = "rpyc"

    def serve(self) -> None:
        rpyc = importlib.import_module("rpyc")
        server_module = importlib.import_module("rpyc.utils.server")

        class Echo(rpyc.Service):  # type: ignore[misc,name-defined]
            def exposed_echo(self, value: Any) -> Any:
                return value

        server = server_module.ThreadedServer(Echo(), hostname=HOST, port=0)
        print(server.port, flush=True)
        server.start()

    def connect(self, port: int) -> None:
        self.rpyc = importlib.import_module("rpyc")
        self.link = self.rpyc.connect(HOST, port)
        self.record = (RECORD["name"], tuple(RECORD["value"]), RECORD["text"])

    def latencies(self, count: int, size: int, gap: float = 0.0) -> list[float]:
        value, echo, taken = bytes(size) if size else self.record, self.link.root.echo, []
        for _ in range(count):
            time.sleep(gap)
            began = time.perf_counter()
            echo(value)
            taken.append(time.perf_counter() - began)
        return taken

    def rate(self, count: int, in_flight: int) -> float:
        echo = self.rpyc.async_(self.link.root.echo)
        began = time.perf_counter()
        under_way = [echo(self.record) for _ in range(in_flight)]
        for number in range(count):
            under_way[number % in_flight].wait()
            if number < count - in_flight:
                under_way[number % in_flight] = echo(self.record)
        return count / (time.perf_counter() - began)

    def close(self) -> None:
        self.link.close()


class Zmq(AsyncContender):
    """pyzmq on asyncio, DEALER to ROUTER, msgpack."""

    name = "pyzmq"
    needs = "zmq"

    def _socket(self, kind: str) -> Any:
        zmq, zmq_asyncio = importlib.import_module("zmq"), importlib.import_module("zmq.asyncio")
        made = zmq_asyncio.Context.instance().socket(getattr(zmq, kind))
        made.linger = 0
        return made

    async def start(self) -> int:
        router = self._socket("ROUTER")
        port = router.bind_to_random_port(f"tcp://{HOST}")

        async def echo() -> None:
            while True:
                who, body = await router.recv_multipart()
                number, value = msgpack.unpackb(body)
                await router.send_multipart([who, msgpack.packb([number, value])])

        self.task = asyncio.ensure_future(echo())
        return int(port)

    async def open(self, port: int) -> None:
        self.dealer = self._socket("DEALER")
        self.dealer.connect(f"tcp://{HOST}:{port}")
        self.waiting: dict[int, asyncio.Future[Any]] = {}
        self.number = 0

        async def listen() -> None:
            while True:
                number, value = msgpack.unpackb(await self.dealer.recv())
                self.waiting.pop(number).set_result(value)

        self.task = asyncio.ensure_future(listen())

    async def _ask(self, value: Any) -> Any:
        self.number += 1
        future = self.waiting[self.number] = asyncio.get_running_loop().create_future()
        await self.dealer.send(msgpack.packb([self.number, value]))
        return await future

    def ask(self, value: Any) -> Awaitable[Any]:
        return self._ask(value)

    async def leave(self) -> None:
        self.task.cancel()
        await asyncio.gather(self.task, return_exceptions=True)
        self.dealer.close()


class Grpc(AsyncContender):
    """grpc.aio, msgpack as its serializer."""

    name = "grpc.aio"
    needs = "grpc"

    async def start(self) -> int:
        grpc = importlib.import_module("grpc")

        async def echo(value: Any, context: Any) -> Any:
            return value

        handler = grpc.unary_unary_rpc_method_handler(echo, msgpack.unpackb, msgpack.packb)
        self.server = grpc.aio.server()
        self.server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler("bench", {"echo": handler}),))
        port = self.server.add_insecure_port(f"{HOST}:0")
        await self.server.start()
        return int(port)

    async def open(self, port: int) -> None:
        grpc = importlib.import_module("grpc")
        self.channel = grpc.aio.insecure_channel(f"{HOST}:{port}")
        self.call: Callable[[Any], Awaitable[Any]] = self.channel.unary_unary(
            "/bench/echo", msgpack.packb, msgpack.unpackb
        )

    def ask(self, value: Any) -> Awaitable[Any]:
        return self.call(value)

    async def leave(self) -> None:
        await self.channel.close()


CONTENDERS: list[type[Contender]] = [Bare, BareBuffered, Petrobot, PetrobotSealed, Pyro, Rpyc, Zmq, Grpc]
