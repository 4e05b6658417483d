"""Set points between guarded nodes: sealed by the shared key or by what crossed TLS; a stranger's set points move nothing."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Sequence
from pathlib import Path

import pytest

from coordinator.certificates import make_certificates
from services.comm.caller import Caller
from services.comm.client import Client
from services.comm.credentials import credentials
from services.comm.messages import Hello
from services.comm.security import new_key, write_key
from services.comm.stream import StreamReceiver, StreamSender
from services.comm.stream_line import Incoming
from tests.node.test_processes import CELL, Nodes, Operator

SHARED = '[keys]\nfile = "cell.key"\n'
CERTIFICATES = '[keys]\ncertificates = "keys"\n'


class GuardedOperator(Operator):
    """Connected with the coordinator's credentials."""

    async def connect(self, *nodes: str) -> None:
        """Connect to the nodes."""
        proves = credentials(self.directory, "coordinator")
        for node in nodes:
            hello = Hello(1, 1, "coordinator", "operator", f"{self.boot} {node}", 1, self.directory.hash)
            caller, (host, port) = Caller(node, hello, auto_ack=True), self.directory.address(node)
            client = Client(host, port, caller, on_notices=self._take, key=proves.key, tls=proves.client())
            self.clients[node] = client
            client.start()
            assert await client.connected(20.0)


@pytest.mark.processes
@pytest.mark.parametrize("how", ["shared key", "certificates"])
async def test_set_points_cross_guarded_nodes(tmp_path: Path, how: str) -> None:
    """An action of one node leads a device of another; a variable of a third call goes over the same doors."""
    if how == "certificates":
        make_certificates(tmp_path / "keys", ["coordinator", "left", "right"])
    else:
        write_key(tmp_path / "cell.key", new_key())
    keys = CERTIFICATES if how == "certificates" else SHARED
    nodes = Nodes(tmp_path, "left", "right", text=CELL.replace("[actions]\n", f"{keys}[actions]\n"))
    operator = GuardedOperator(nodes.directory)
    try:
        await operator.connect("left", "right")
        following = asyncio.create_task(operator.call("follow", seconds=1.5))
        leading = await operator.call("lead", seconds=1.2)
        end = await following
        assert leading.status == "success", leading
        assert end.values["count"] >= 3 and end.values["position"] > 0.0
        assert (await operator.call("relay", a=3)).values["sum"] == 5, "node to node"
    finally:
        await operator.close()
        nodes.stop()


class Taken:
    """A sink that keeps what it takes."""

    def __init__(self) -> None:
        self.values: list[tuple[float, ...]] = []

    def take(self, values: Sequence[float], held: float = 0.0) -> None:
        """Keep."""
        self.values.append(tuple(values))

    def withdraw(self) -> None:
        """Nothing to forget."""


@pytest.mark.parametrize(
    ("key", "ticket", "says"),
    [
        (None, "secret.1", "key_needed"),
        (b"x" * 32, "secret.1", "wrong_key"),
        (b"k" * 32, "secret.2", "ticket"),
    ],
)
def test_a_strangers_set_points_move_nothing(key: bytes | None, ticket: str, says: str) -> None:
    """Without the key, with another key, without the ticket."""
    sink = Taken()
    receiver = StreamReceiver("arm", {"points": Incoming(0.02, sink, "secret.1")}, key=b"k" * 32)
    sender = StreamSender("mallory", "points", 0.02, *receiver.address, ticket=ticket, key=key)
    for _ in range(10_000):
        sender.send([1.0])
        receiver.poll()
        if sender.refusal:
            break
    assert says in sender.refusal and receiver.faults >= 1
    assert sink.values == []
    sender.close()
    receiver.close()


def test_strangers_do_not_hold_up_the_loop_that_polls() -> None:
    """However many connect and send, one poll takes a few connections and a few bytes of each: the good stream goes on."""
    sink = Taken()
    receiver = StreamReceiver("arm", {"points": Incoming(0.02, sink, "t.1")})
    good = StreamSender("vision", "points", 0.02, *receiver.address, ticket="t.1")
    while not sink.values:
        good.send([1.0])
        receiver.poll()
    crowd = [socket.create_connection(receiver.address) for _ in range(60)]
    for one in crowd:
        one.setblocking(False)
        one.send(b"\x00" * 60_000)
    before = len(receiver._guests)
    receiver.poll()
    assert len(receiver._guests) <= before + 4
    for number in range(200):
        good.send([float(number)])
        receiver.poll()
        assert len(receiver._guests) <= 17
    assert sink.values[-1] == (199.0,)
    for one in crowd:
        one.close()
    good.close()
    receiver.close()
