"""A node's server in a process of its own, a stranger's raw connection to it, and a good client
beside."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import subprocess
import sys
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from petrobot.coordinator.cli import main
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.codec import decode, encode
from petrobot.services.comm.protocol.wire import Connection, Side
from petrobot.services.comm.tls.certificates import make_certificates
from petrobot.services.comm.tls.credentials import Credentials
from tests.comm.ends import framed
from tests.waiting import Limit, beat

Command = Callable[..., Awaitable[tuple[int, str, str]]]
KEY = bytes(range(32))
HELLO = m.Hello(2, 2, "coordinator", "coord", "c1", 3)
SCRIPT = Path(__file__).with_name("server_process.py")
MIB = 1 << 20
KEPT = 1 << 16
"""Bytes that a stranger keeps of what it hears, to replay them."""


def frame(message: m.Message) -> bytes:
    """A message as a frame without a key; HELLO as of a client that has none, unless it has an
    `auth` of its own."""
    body = encode(message)
    if isinstance(message, m.Hello | m.Welcome | m.Challenge | m.Proof):
        if isinstance(message, m.Hello) and not message.auth:
            return Connection(Side.CLIENT, "vision").send(message)
        return len(body).to_bytes(4, "big") + body
    return framed(body)


class Victim:
    """The server's process."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self.settings = settings
        command = [sys.executable, str(SCRIPT), json.dumps(settings)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdout is not None
        self.port = int(self.process.stdout.readline())
        self.host = str(settings.get("host", "127.0.0.1"))
        self.rested = self.memory()

    @property
    def address(self) -> tuple[str, int]:
        """Where it listens."""
        return self.host, self.port

    def about(self, deep: bool = False) -> dict[str, Any]:
        """What it counts: faults, opening, connected, fds; with `deep` also its links that are in
        memory."""
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write("deep\n" if deep else "?\n")
        self.process.stdin.flush()
        answer: dict[str, Any] = json.loads(self.process.stdout.readline())
        return answer

    async def only_link(self) -> None:
        """Wait until one connection is left in its memory."""
        limit = Limit("the end of all connections but one")
        while (await asyncio.to_thread(self.about, True))["links"] != 1 and limit.left():
            await beat()

    def memory(self, what: str = "VmRSS") -> int:
        """Its resident set now (or VmHWM: the largest ever), in bytes."""
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith(what))

    def grown(self) -> int:
        """By how much its resident set has been larger at most than at its start (bytes)."""
        return self.memory("VmHWM") - self.rested

    def close(self) -> None:
        """End it."""
        self.process.kill()
        self.process.communicate()

    def client(self, hello: m.Hello = HELLO, **more: Any) -> Client:
        """A caller that knows what it must."""
        if "key" in self.settings:
            more.setdefault("key", bytes.fromhex(self.settings["key"]))
        if "folder" in self.settings:
            more.setdefault(
                "tls", Credentials("coordinator", None, Path(self.settings["folder"])).client()
            )
        return Client(*self.address, Caller("vision", hello, auto_ack=True), **more)

    @asynccontextmanager
    async def good_client(self) -> AsyncIterator[GoodClient]:
        """One that is served all the time, which the test asks for at its end."""
        good = GoodClient(self.client())
        await good.begin()
        try:
            yield good
        finally:
            await good.end()


class GoodClient:
    """Calls without pause; every call must come back as it went."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.served = 0
        self._task: asyncio.Task[None] | None = None

    async def begin(self) -> None:
        """Connect, and call from now on."""
        self.client.start()
        assert await self.client.connected(60.0)
        self._task = asyncio.create_task(self._call())

    async def _call(self) -> None:
        while True:
            outcome = await self.client.call("echo", {"n": self.served})
            assert (outcome.status, outcome.values) == ("success", {"n": self.served}), outcome
            self.served += 1
            await beat(0.001)

    async def still_served(self, more: int = 20) -> None:
        """Wait until it has been served some more; raises what it met with meanwhile."""
        assert self._task is not None
        wanted = self.served + more
        async with asyncio.timeout(60.0):
            while self.served < wanted:
                if self._task.done():
                    self._task.result()
                await beat(0.002)

    async def end(self) -> None:
        """Leave."""
        assert self._task is not None
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        await self.client.close()


class Stranger:
    """A raw connection that says what it likes."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader = reader
        self.writer = writer
        self.said = b""
        self.heard = b""
        self.refusal = ""
        """Code of the REFUSE that came while the connection was being opened."""

    @classmethod
    async def at(cls, victim: Victim, source: str | None = None) -> Stranger:
        """Connect, from another address of this host if asked to."""
        local = (source, 0) if source else None
        return cls(*await asyncio.open_connection(*victim.address, local_addr=local))

    async def say(self, data: bytes) -> None:
        """Send bytes."""
        self.said += data
        with contextlib.suppress(ConnectionError):
            self.writer.write(data)
            await self.writer.drain()

    async def hears(self) -> m.Message:
        """The next message of the server on an open connection without a key, its check not looked
        at."""
        body = await self._body()
        return decode(body[:-4])

    async def _body(self) -> bytes:
        async with asyncio.timeout(60.0):
            head = await self.reader.readexactly(4)
            body = await self.reader.readexactly(int.from_bytes(head, "big"))
        if len(self.heard) < KEPT:
            self.heard += head + body
        return body

    async def open(self, key: bytes | None, hello: m.Hello = HELLO) -> Connection:
        """Shake hands properly; gives the connection, to make sealed frames with."""
        connection = Connection(
            Side.CLIENT, "vision", key=key, nonce=os.urandom(32) if key else b""
        )
        await self.say(connection.send(hello))
        limit = Limit("the handshake")
        while connection.version == 0 and limit.left():
            body = await self._body()
            for message in connection.receive_data(len(body).to_bytes(4, "big") + body):
                if isinstance(message, m.Refuse):
                    self.refusal = message.code
                    raise ConnectionRefusedError(message.text)
            await self.say(connection.data_to_send())
        return connection

    async def refused(self) -> str:
        """The code of the REFUSE that comes, after which the server hangs up; empty if it hangs up
        without a word."""
        code = self.refusal
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while True:
                body = await self._body()
                for end in (
                    len(body),
                    len(body) - 4,
                    len(body) - 16,
                ):  # of the opening, checked or sealed
                    with contextlib.suppress(Exception):
                        message = decode(body[:end])
                        if isinstance(message, m.Refuse):
                            code = message.code
        return code

    def close(self) -> None:
        """Hang up."""
        self.writer.close()


@pytest.fixture
def victim() -> Iterator[Callable[..., Victim]]:
    """Starts server processes: `victim(key=..., limits=..., ...)`."""
    made: list[Victim] = []

    def start(**settings: Any) -> Victim:
        made.append(Victim(settings))
        return made[-1]

    yield start
    for one in made:
        one.close()


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cell's certificates: coordinator, vision and motion."""
    folder = tmp_path_factory.mktemp("keys")
    make_certificates(folder, ["coordinator", "vision", "motion"])
    return folder


@pytest.fixture
def many_files() -> Iterator[None]:
    """As many open files as the system lets us have."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(
        resource.RLIMIT_NOFILE, (hard if hard != resource.RLIM_INFINITY else 65_536, hard)
    )
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Command:
    """Give a command in this process, and return its exit code and output."""

    async def give(*arguments: str) -> tuple[int, str, str]:
        capsys.readouterr()
        code = await asyncio.to_thread(main, list(arguments))
        return code, *capsys.readouterr()

    return give
