"""Processes for the fault tests to kill, freeze or cut off: a node, a sender of set points, and a
relay that stands for the cable between two processes.

python -m tests.comm.fault_parts node [PORT BOOT]      # prints its port
python -m tests.comm.fault_parts sender PORT PERIOD
"""

from __future__ import annotations

import asyncio
import contextlib
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from enum import Enum
from pathlib import Path

from petrobot.services.comm.calls.callee import Callee, Offer, Order
from petrobot.services.comm.calls.server import Server
from petrobot.services.comm.protocol.messages import Cancel, Outcome
from petrobot.services.comm.streams.stream import StreamSender

HOST = "127.0.0.1"
ROOT = Path(__file__).parents[2]
STREAM = "points"


class LinkFault(Enum):
    """A fault of the other side."""

    KILLED = "killed"
    FROZEN = "frozen"
    CUT = "cut off"
    """Its cable is cut: no byte arrives, and no message that the connection has ended."""
    DEAF = "deaf"
    """Only what is sent to it is lost; what it sends arrives."""


class Cable:
    """Relay bytes between a client of `port` and the other end, until the relay is cut."""

    def __init__(self, far: int) -> None:
        self.far = far
        self._listener = socket.create_server((HOST, 0))
        self.port = int(self._listener.getsockname()[1])
        self._wake, self._stop = socket.socketpair()
        self._cut = self._deaf = False
        self._thread = threading.Thread(target=self._carry)
        self._thread.start()

    def cut(self) -> None:
        """Stop relaying; both connections stay open."""
        self._cut = True
        self._wake.send(b"x")

    def deafen(self) -> None:
        """Drop what the client sends, and accept no further connection."""
        self._deaf = True
        self._wake.send(b"x")

    def close(self) -> None:
        """Close all connections."""
        self._wake.close()
        self._thread.join()

    def _carry(self) -> None:
        pairs: dict[socket.socket, socket.socket] = {}
        ready: list[socket.socket] = []
        while not self._over(ready):
            for one in [] if self._cut else [one for one in ready if one is not self._stop]:
                if one is self._listener:
                    self._join(pairs)
                elif one in pairs:
                    self._pass_on(one, pairs)
            waiting = [self._stop] if self._cut else [self._stop, self._listener, *pairs]
            if self._deaf:
                near = [one for one in pairs if one.getsockname()[1] == self.port]
                waiting = [one for one in waiting if one not in (self._listener, *near)]
            ready, _, _ = select.select(waiting, [], [])
        for one in (*pairs, self._listener, self._stop):
            one.close()

    def _over(self, ready: list[socket.socket]) -> bool:
        return self._stop in ready and not self._stop.recv(16)

    def _join(self, pairs: dict[socket.socket, socket.socket]) -> None:
        near, _ = self._listener.accept()
        try:
            far = socket.create_connection((HOST, self.far))
        except OSError:
            near.close()  # The other end has closed its connection.
        else:
            pairs |= {near: far, far: near}

    @staticmethod
    def _pass_on(one: socket.socket, pairs: dict[socket.socket, socket.socket]) -> None:
        data = b""
        with contextlib.suppress(OSError):
            data = one.recv(1 << 16)
        other = pairs[one]
        with contextlib.suppress(OSError):
            other.sendall(data)
        if not data:
            for end in (one, other):
                del pairs[end]
                end.close()


def inflict(fault: LinkFault, process: subprocess.Popen[str], cable: Cable) -> None:
    """Cause the fault in the process, or in the cable to it."""
    if fault is LinkFault.CUT:
        cable.cut()
    elif fault is LinkFault.DEAF:
        cable.deafen()
    else:
        process.send_signal(signal.SIGKILL if fault is LinkFault.KILLED else signal.SIGSTOP)


@contextmanager
def part(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Start one of the processes below; end it on exit, whatever its state."""
    command = [sys.executable, "-m", "tests.comm.fault_parts", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def first_line(process: subprocess.Popen[str]) -> str:
    """Return the first line of its output."""
    assert process.stdout is not None
    return process.stdout.readline().strip()


async def be_node(port: int, boot: str) -> None:
    """Run a node whose action `move` runs until it is cancelled."""

    def obey(now: float, orders: list[Order]) -> None:
        for order in orders:
            if isinstance(order, Cancel):
                callee.finish(
                    now, Outcome(order.id, "error", cause="cancelled", text="it was told to stop")
                )

    callee = Callee("motion", boot, {"move": Offer()})
    server = Server(callee, on_orders=obey)
    await server.start(HOST, port)
    print(server.address[1], flush=True)
    await asyncio.Event().wait()


def be_sender(port: int, period: float) -> None:
    """Send one set point per period (at absolute times): the number of periods since the start."""
    sender = StreamSender("vision", STREAM, period, HOST, port, receiver="motion")
    due, number = time.monotonic(), 0
    while True:
        number += 1
        due += period
        while (wait := due - time.monotonic()) > 0.0:
            select.select([], [], [], wait)
        sender.send((float(number),))


if __name__ == "__main__":
    if sys.argv[1] == "node":
        port, boot = sys.argv[2:] or ("0", "n1")
        asyncio.run(be_node(int(port), boot))
    else:
        be_sender(int(sys.argv[2]), float(sys.argv[3]))
