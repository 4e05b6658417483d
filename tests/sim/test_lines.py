"""Lines to a laboratory: a pseudo terminal or Unix sockets in real time, envelopes in lock step."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import ClassVar

import pytest

from petrobot.services.comm.location_file import load
from petrobot.services.comm.lockstep.party import Envelope
from petrobot.services.comm.streams.line import ByteLine, SerialPort, TcpConnection
from petrobot.services.node.lockstep import LockstepPorts
from petrobot.services.node.ports import ProcessPorts
from petrobot.sim.bus.lines import PtyLine
from petrobot.sim.laboratory_party import LaboratoryParty
from petrobot.sim.realtime import Pacemaker, serial_lines, tcp_hosts
from tests.waiting import Limit

CELL = """
schema = 1
[nodes.world]
host = "127.0.0.1"
port = 7391
sim = "any:lab"
[nodes.pc]
host = "127.0.0.1"
port = 7392
[devices.arm]
node = "pc"
driver = "any:Arm"
port = "pty:run/arm"
[devices.real]
node = "pc"
driver = "any:Arm"
port = "/dev/ttyUSB0"
[devices.crane]
node = "pc"
driver = "any:Arm"
host = "unix:run/crane"
"""


class Session:
    """The robot's end of a connection: says hello, and answers in capitals."""

    def __init__(self) -> None:
        self.closed, self.out = False, b"hello "

    def receive(self, data: bytes) -> None:
        self.out += data.upper()

    def drain(self) -> bytes:
        out, self.out = self.out, b""
        return out


class Echo(LaboratoryParty):
    """A world whose devices answer in capitals."""

    tcp_ports = (7, 8)
    sessions: ClassVar[list[Session]] = []

    def connect(self, device: str, port: int) -> Session:
        self.sessions.append(Session())
        self.sessions[-1].out += f"{device} {port} ".encode()
        return self.sessions[-1]

    def tick(self, now: float) -> None:
        self.now = now + 0.004

    def take_on_serial(self, now: float, device: str, data: bytes) -> bytes:
        return device.encode() + b" " + data.upper()


def echo() -> Echo:
    return Echo(
        "world", lambda endpoint: "pc" if endpoint in ("arm", "crane") else endpoint, "b", "hash"
    )


def heard(line: ByteLine, size: int) -> bytes:
    got, limit = b"", Limit(f"{size} bytes")
    while len(got) < size and limit.left():
        got += line.receive()
    return got


def test_in_real_time_it_is_a_port_that_can_be_unplugged(tmp_path: Path) -> None:
    (tmp_path / "services.toml").write_text(CELL)
    paths = serial_lines(load(tmp_path / "services.toml"))
    assert paths == {"arm": tmp_path / "run/arm"}
    for _ in range(2):  # pulled, and put back
        pacemaker = Pacemaker(echo(), None, None, paths)
        thread = threading.Thread(target=pacemaker.run)
        thread.start()
        line = SerialPort(str(paths["arm"]), 1_000_000)
        try:
            with pytest.raises(ConnectionError, match="lock"):
                SerialPort(str(paths["arm"]), 1_000_000)  # one program at a time
            line.send(b"hello")
            assert heard(line, 9) == b"arm HELLO"
        finally:
            pacemaker.stop()
            thread.join()
            pacemaker.close()
        with pytest.raises(ConnectionError, match="gone"):
            line.receive()
        with pytest.raises(ConnectionError, match="gone"):
            line.send(b"hello")
        line.close()
        with pytest.raises(ConnectionError, match="run/arm"):
            SerialPort(str(paths["arm"]), 1_000_000)


def test_a_line_that_nobody_reads_does_not_block(tmp_path: Path) -> None:
    far = PtyLine(tmp_path / "line", bytes)
    line = SerialPort(str(tmp_path / "line"), 9600)
    with pytest.raises(ConnectionError, match="accepts no bytes"):
        for _ in range(100):
            line.send(bytes(4096))
    line.close()
    far.close()


def test_in_lock_step_it_is_envelopes(tmp_path: Path) -> None:
    (tmp_path / "services.toml").write_text(CELL)
    directory = load(tmp_path / "services.toml")
    sent: list[Envelope] = []
    ports = LockstepPorts(directory, directory.devices["arm"], lambda: 0.0, sent.append)
    line = ports.serial("pty:run/arm", 1_000_000)
    line.send(b"hel")
    line.send(b"lo")
    ports.flush()
    ports.flush()
    world = echo()
    for envelope in sent:
        world.receive(0.0, envelope)
    world.advance(0.0)
    (answer,) = world.drain()
    assert (answer.party, answer.target) == ("pc", "arm")
    ports.receive(answer)
    assert line.receive() == b"arm HELLO" and line.receive() == b""


def test_in_real_time_its_robots_accept_connections(tmp_path: Path) -> None:
    (tmp_path / "services.toml").write_text(CELL)
    directory = load(tmp_path / "services.toml")
    assert tcp_hosts(directory) == {"crane": tmp_path / "run/crane"}
    ports = ProcessPorts(directory, directory.devices["crane"], lambda: 0.0, {})
    for _ in range(2):  # ended, and started again
        pacemaker = Pacemaker(echo(), None, None, None, tcp_hosts(directory))
        thread = threading.Thread(target=pacemaker.run)
        thread.start()
        one, other = ports.tcp("unix:run/crane", 7), ports.tcp("unix:run/crane", 8)
        try:
            one.send(b"yes")
            assert heard(one, 17) == b"hello crane 7 YES"
            assert heard(other, 14) == b"hello crane 8 "
        finally:
            pacemaker.stop()
            thread.join()
            pacemaker.close()
        with pytest.raises(ConnectionError, match="closed the connection"):
            one.receive()
        one.close()
        other.close()
        again = TcpConnection(f"unix:{tmp_path}/run/crane", 7)
        with pytest.raises(ConnectionError, match="No such file"):
            again.receive()
        again.close()


def test_in_lock_step_a_connection_is_envelopes(tmp_path: Path) -> None:
    (tmp_path / "services.toml").write_text(CELL)
    directory = load(tmp_path / "services.toml")
    sent: list[Envelope] = []
    ports = LockstepPorts(directory, directory.devices["crane"], lambda: 0.0, sent.append)
    world = echo()

    def passes() -> None:
        ports.flush()
        for envelope in sent:
            world.receive(0.0, envelope)
        sent.clear()
        world.advance(0.0)
        for answer in world.drain():
            assert (answer.party, answer.target, answer.channel) == ("pc", "crane", "tcp")
            ports.receive(answer)

    first = ports.tcp("192.168.1.10", 7)
    passes()
    assert first.receive() == b"hello crane 7 "
    second, other = ports.tcp("192.168.1.10", 7), ports.tcp("192.168.1.10", 8)
    second.send(b"yes")
    passes()
    assert (second.receive(), other.receive()) == (b"hello crane 7 YES", b"hello crane 8 ")
    assert first.receive() == b"" and world.sessions[-3].closed and not world.sessions[-2].closed
