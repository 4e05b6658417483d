"""The coordinator on the wall clock: one client for each node, timers on the asyncio loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence

from coordinator.journal import JournalError
from coordinator.mission import Mission, MissionError, Stage
from services.comm.client import Client
from services.comm.credentials import COORDINATOR, Credentials, credentials
from services.comm.directory import Directory
from services.comm.notice import Notice

LINGER = 1.0
"""Seconds that nothing at the end of a run waits for."""


class UnreachableError(Exception):
    """Nodes that should be there are not; `nodes` names them."""

    def __init__(self, nodes: Sequence[str], text: str) -> None:
        super().__init__(text)
        self.nodes = tuple(nodes)


class RealtimeMission:
    """Drives a mission run: what clients notice goes in, what it calls goes out, timers wake it."""

    def __init__(self, mission: Mission, directory: Directory, proves: Credentials | None = None) -> None:
        self.mission = mission
        self._loop = asyncio.get_running_loop()
        self._over = asyncio.Event()
        self._closed = False
        self._fault: BaseException | None = None
        self._timer: asyncio.TimerHandle | None = None
        key, tls = (proves.key, proves.client()) if proves is not None else (None, None)
        self.clients: Mapping[str, Client] = {
            name: Client(node.host, node.port, mission.callers[name], on_notices=self._hear(name), key=key, tls=tls)
            for name, node in directory.nodes.items()
        }

    async def connect(self, timeout: float = 5.0) -> None:
        """Reach every node. Raises UnreachableError that names those that are not there."""
        for client in self.clients.values():
            client.start()
        reached = await asyncio.gather(*(client.connected(timeout) for client in self.clients.values()))
        missing = [name for name, up in zip(self.clients, reached, strict=True) if not up]
        if missing:
            addresses = ", ".join(self._missed(name) for name in missing)
            raise UnreachableError(missing, f"no answer from {addresses}; launch them with `petrobot up`")

    def _missed(self, node: str) -> str:
        client = self.clients[node]
        return f"{node} at {client.host}:{client.port}" + (f" ({client.trouble})" if client.trouble else "")

    async def run(self, begin: Callable[[float], None] | None = None) -> None:
        """Run the mission to its end, from its start or from whatever `begin(now)` makes of it.

        Raises MissionError, and JournalError when the journal cannot be written.
        """
        (begin or self.mission.start)(self._loop.time())
        self.settle()
        await self._over.wait()
        if self._fault is not None:
            raise self._fault

    async def close(self) -> None:
        """Leave the nodes in good order."""
        self._closed = True
        if self._timer is not None:
            self._timer.cancel()
        for client in self.clients.values():
            client.flush(self._loop.time() + LINGER)  # acknowledgements that wait for others go now
        await asyncio.gather(*(client.close() for client in self.clients.values()))

    def settle(self) -> None:
        """Send what was said, and wake up in time for what is due next; call it after each use of the mission."""
        if self._closed:
            return
        for client in self.clients.values():
            client.flush()
        if self.mission.stage is Stage.OVER:
            self._over.set()
            return
        due = self.mission.due()
        if self._timer is not None:
            self._timer.cancel()
        self._timer = None if due is None else self._loop.call_at(due, self._wake)

    def _wake(self) -> None:
        self._guarded(lambda now: self.mission.advance(now))

    def _hear(self, node: str) -> Callable[[float, list[Notice]], None]:
        return lambda _, notices: self._guarded(lambda now: self.mission.take(now, node, notices))

    def _guarded(self, step: Callable[[float], None]) -> None:
        try:
            step(self._loop.time())
        except (MissionError, JournalError) as fault:
            # What is not safe has not left: the nodes end its runs as orphans, and `resume` goes on from what is.
            self._fault = fault
            self._over.set()
            return
        self._loop.call_soon(self.settle)


def credentials_of(directory: Directory) -> Credentials:
    """What the coordinator proves itself with, as services.toml says. Raises KeyFileError."""
    return credentials(directory, COORDINATOR)
