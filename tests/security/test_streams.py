"""Set points between nodes with keys: sealed by the shared key, or by a key exchanged over TLS; a
stranger's set points move nothing."""

from __future__ import annotations

import socket
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.byte_stream import CanHub
from petrobot.services.comm.canopen.ports import StreamPort
from petrobot.services.comm.protocol.messages import Hello
from petrobot.services.comm.protocol.security import new_key, write_key
from petrobot.services.comm.streams.camera import ImageServer, StreamImages
from petrobot.services.comm.streams.stream import Incoming, StreamReceiver, StreamSender
from petrobot.services.comm.tls.certificates import make_certificates
from petrobot.services.comm.tls.credentials import credentials
from tests.node.test_processes import CELL, Nodes, Operator, follows
from tests.waiting import Limit

SHARED = '[keys]\nfile = "cell.key"\n'
CERTIFICATES = '[keys]\ncertificates = "keys"\n'


class GuardedOperator(Operator):
    """Connected with the coordinator's credentials."""

    async def connect(self, *nodes: str) -> None:
        """Connect to the nodes."""
        proves = credentials(self.directory, "coordinator")
        for node in nodes:
            hello = Hello(
                2, 2, "coordinator", "operator", f"{self.boot} {node}", 1, self.directory.hash
            )
            caller, (host, port) = Caller(node, hello, auto_ack=True), self.directory.address(node)
            client = Client(
                host,
                port,
                caller,
                on_notices=self._take,
                key=proves.key,
                tls=proves.client(),
                timing=self.timing,
            )
            self.clients[node] = client
            client.start()
            assert await client.connected(60.0)


@pytest.mark.processes
@pytest.mark.parametrize(
    "how", [pytest.param("shared key", marks=pytest.mark.proof), "certificates"]
)
async def test_set_points_between_nodes_with_keys(tmp_path: Path, how: str) -> None:
    """An action of one node leads a device of another; a variable crosses the same secured
    connections."""
    if how == "certificates":
        make_certificates(tmp_path / "keys", ["coordinator", "left", "right"])
    else:
        write_key(tmp_path / "cell.key", new_key())
    keys = CERTIFICATES if how == "certificates" else SHARED
    nodes = Nodes(tmp_path, "left", "right", text=CELL.replace("[actions]\n", f"{keys}[actions]\n"))
    operator = GuardedOperator(nodes.directory)
    try:
        await operator.connect("left", "right")
        await follows(operator)
        assert (await operator.call("relay", a=3)).values["sum"] == 5, "node to node"
    finally:
        await operator.close()
        nodes.stop()


class Taken:
    """A sink that records what it receives."""

    def __init__(self) -> None:
        self.values: list[tuple[float, ...]] = []

    def take(self, values: Sequence[float], held: float = 0.0) -> None:
        """Record the values."""
        self.values.append(tuple(values))

    def withdraw(self) -> None:
        """Do nothing."""


@pytest.mark.parametrize(
    ("key", "ticket", "says"),
    [
        (None, "secret.1", "key_needed"),
        (b"x" * 32, "secret.1", "wrong_key"),
        (b"k" * 32, "secret.2", "ticket"),
    ],
)
def test_a_strangers_set_points_move_nothing(key: bytes | None, ticket: str, says: str) -> None:
    """They come without the key, with another key, or without the ticket."""
    sink = Taken()
    receiver = StreamReceiver("arm", {"points": Incoming(0.02, sink, "secret.1")}, key=b"k" * 32)
    sender = StreamSender(
        "mallory", "points", 0.02, *receiver.address, receiver="arm", ticket=ticket, key=key
    )
    for _ in range(10_000):
        sender.send([1.0])
        receiver.poll()
        if sender.refusal:
            break
    assert says in sender.refusal and receiver.faults >= 1
    assert sink.values == []
    sender.close()
    receiver.close()


def test_strangers_do_not_delay_the_polling_loop() -> None:
    """However many connect and send, one poll accepts a few connections and reads a few bytes of
    each: the honest stream continues."""
    sink = Taken()
    receiver = StreamReceiver("arm", {"points": Incoming(0.02, sink, "t.1")})
    good = StreamSender("vision", "points", 0.02, *receiver.address, receiver="arm", ticket="t.1")
    limit = Limit("the first value")
    while not sink.values and limit.left():
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


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.7.2", "::"])
def test_unprotected_streams_stay_on_this_host(host: str) -> None:
    """Images and CAN frames between processes are neither encrypted nor authenticated: no other
    host may reach them."""
    with pytest.raises(ValueError, match="images are not protected"):
        ImageServer(host, 0)
    with pytest.raises(ValueError, match="the stream is not protected"):
        CanHub(f"tcp://[{host}]:0" if ":" in host else f"tcp://{host}:0")


def test_a_crowd_at_the_camera_does_not_displace_the_honest_receiver() -> None:
    """The number of receivers is limited; connected ones stay connected."""
    camera = ImageServer("127.0.0.1", 0)
    good = StreamImages("127.0.0.1", camera.port, time.monotonic)
    good.start(50.0)
    limit = Limit("the camera's rate")
    while camera.rate < 50.0 and limit.left():
        good.newest()
        camera.poll()
    crowd = [socket.create_connection(("127.0.0.1", camera.port)) for _ in range(60)]
    for _ in range(40):
        camera.poll()
        assert len(camera._receivers) <= 16
    pixels = np.zeros((4, 6), np.uint8)
    seen = None
    limit = Limit("an image")
    while seen is None and limit.left():
        camera.send(pixels, 0.0)
        camera.poll()
        seen = good.newest()
    assert seen is not None and seen.pixels.shape == (4, 6)
    for one in crowd:
        one.close()
    good.close()
    camera.close()


def test_a_crowd_at_the_simulated_bus_does_not_displace_honest_ports() -> None:
    """The number of ports is limited; connected ones continue."""
    hub = CanHub()
    near, far = hub.port(), StreamPort(hub.channel)
    hub.poll(1.0)
    address = ("127.0.0.1", int(hub.channel.rpartition(":")[2]))
    crowd = [socket.create_connection(address) for _ in range(100)]
    limit = Limit("64 ports and the refused rest")
    while (hub.ports < 64 or len(hub.dropped) < 20) and limit.left():
        hub.poll(0.1)
    assert hub.ports == 64
    far.send(Frame(0x123, b"ab"))
    got: list[Frame] = []
    limit = Limit("the frame")
    while not got and limit.left():
        hub.poll(0.1)
        got += near.receive()
    assert got == [Frame(0x123, b"ab")]
    for one in crowd:
        one.close()
    far.close()
    hub.close()
