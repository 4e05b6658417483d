"""The libraries with which `wire.py` compares petrobot, each used as its own manual recommends for
speed.

Pyro5 with msgpack and one proxy per thread, RPyC with tuples (dicts travel by reference), pyzmq and
grpc on asyncio.
"""

from __future__ import annotations

import asyncio
import importlib
import threading
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import msgpack
from tools.bench.wire_contenders import (
    HOST,
    RECORD,
    AsyncContender,
    Bare,
    BareBuffered,
    Contender,
    Petrobot,
    PetrobotSealed,
    PetrobotWorker,
    payload,
)


class Pyro(Contender):
    """Pyro5 with msgpack, a proxy a thread."""

    name = "Pyro5"
    needs = "Pyro5"

    def serve(self) -> None:
        api = importlib.import_module("Pyro5.api")

        class PyroEcho:
            @api.expose  # type: ignore[untyped-decorator]
            def echo(self, value: Any) -> Any:
                return value

        daemon = api.Daemon(host=HOST, port=0)
        daemon.register(PyroEcho(), "echo")
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
        connected = threading.Barrier(in_flight + 1)

        def several() -> None:
            proxy = self.api.Proxy(self.uri)
            proxy.echo(RECORD)  # connects
            connected.wait()
            for _ in range(count // in_flight):
                proxy.echo(RECORD)

        with ThreadPoolExecutor(in_flight) as pool:
            futures = [pool.submit(several) for _ in range(in_flight)]
            connected.wait()
            began = time.perf_counter()
            for future in futures:
                future.result()
            return count // in_flight * in_flight / (time.perf_counter() - began)


class Rpyc(Contender):
    """RPyC with records as tuples, which it passes by value."""

    name = "RPyC"
    needs = "rpyc"

    def serve(self) -> None:
        rpyc = importlib.import_module("rpyc")
        server_module = importlib.import_module("rpyc.utils.server")

        class RpycEcho(rpyc.Service):  # type: ignore[misc,name-defined]
            def exposed_echo(self, value: Any) -> Any:
                return value

        server = server_module.ThreadedServer(RpycEcho(), hostname=HOST, port=0)
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
        self.server.add_generic_rpc_handlers(
            (grpc.method_handlers_generic_handler("bench", {"echo": handler}),)
        )
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


CONTENDERS: list[type[Contender]] = [
    Bare,
    BareBuffered,
    Petrobot,
    PetrobotSealed,
    PetrobotWorker,
    Pyro,
    Rpyc,
    Zmq,
    Grpc,
]
