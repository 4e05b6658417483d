"""Lines that are made, lost and made again: a TCP connection of this host, and the link that keeps
one open."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from petrobot import ByteLine, Link
from petrobot.services.comm.streams import line as lines
from petrobot.services.comm.streams.line import (
    BACKLOG,
    PAUSES,
    SerialPort,
    TcpConnection,
    unix_socket,
)
from tests.waiting import Limit


@pytest.fixture(params=["tcp", "unix"])
def near(
    request: pytest.FixtureRequest, tmp_path: Path
) -> Iterator[tuple[str, int, socket.socket]]:
    """Host and port of a server, and its listener."""
    if request.param == "tcp":
        listener = socket.create_server(("127.0.0.1", 0))
        found = "127.0.0.1", int(listener.getsockname()[1])
    else:
        listener = socket.socket(socket.AF_UNIX)
        found = f"unix:{tmp_path}/robot", 30004
        listener.bind(unix_socket(f"{tmp_path}/robot", 30004))
        listener.listen()
    with listener:
        yield *found, listener


def got(line: ByteLine, size: int) -> bytes:
    received, limit = b"", Limit(f"{size} bytes")
    while len(received) < size and limit.left():
        received += line.receive()
    return received


def lost(line: ByteLine) -> str:
    """Why a line is lost."""
    limit = Limit("the line is lost")
    while limit.left():
        try:
            line.receive()
        except ConnectionError as fault:
            return str(fault)
    raise AssertionError


def test_what_is_sent_while_it_connects_arrives(near: tuple[str, int, socket.socket]) -> None:
    host, port, listener = near
    line = TcpConnection(host, port)
    with contextlib.closing(line):
        line.send(b"hello")
        far, _ = listener.accept()
        with far:
            line.receive()
            assert far.recv(5) == b"hello"
            far.sendall(b"answer")
            assert got(line, 6) == b"answer" and line.receive() == b""
            far.sendall(b"last")
        assert got(line, 4) == b"last"
        assert lost(line) == f"{host}:{port} has closed the connection"


def test_a_peer_that_does_not_read_is_given_up(near: tuple[str, int, socket.socket]) -> None:
    host, port, listener = near
    line = TcpConnection(host, port)
    with contextlib.closing(line), pytest.raises(ConnectionError, match="does not read"):
        far, _ = listener.accept()
        with far:
            for _ in range(1000):
                line.send(bytes(BACKLOG))


def test_what_a_peer_does_not_take_in_time_never_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The line is lost, and its commands cannot come after those of the next one."""
    monkeypatch.setattr(lines, "CONNECTING", 0.5)
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        line = TcpConnection("127.0.0.1", listener.getsockname()[1])
        far, _ = listener.accept()
        with far, contextlib.closing(line):
            line.send(bytes(60_000))
            assert "timed out" in lost(line)
            received = 0
            far.settimeout(10.0)
            with contextlib.suppress(ConnectionResetError):
                while data := far.recv(65536):
                    received += len(data)
            assert 0 < received < 60_000


def test_a_port_where_nothing_listens_is_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    line = TcpConnection("127.0.0.1", port)
    assert lost(line) == f"127.0.0.1:{port}: Connection refused"
    line.close()


def test_an_address_that_never_answers_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lines, "CONNECTING", 0.05)
    full = socket.socket()
    full.bind(("127.0.0.1", 0))
    full.listen(0)
    port = full.getsockname()[1]
    waiting = [TcpConnection("127.0.0.1", port) for _ in range(4)]  # its queue is full
    try:
        assert lost(waiting[-1]) == f"127.0.0.1:{port}: nothing answers there"
    finally:
        for line in waiting:
            line.close()
        full.close()


@pytest.mark.parametrize("host", ["robot.lan", "", "unix:" + 120 * "x"])
def test_a_host_that_is_no_address_is_refused(host: str) -> None:
    with pytest.raises(ValueError, match="host: expected"):
        TcpConnection(host, 30004)


class Fickle(ByteLine):
    """A line that is lost when it is told."""

    def __init__(self) -> None:
        self.gone, self.closed, self.data = False, False, b""

    def send(self, data: bytes) -> None:
        self.receive()

    def receive(self) -> bytes:
        if self.gone:
            raise ConnectionError("gone")
        data, self.data = self.data, b""
        return data

    def close(self) -> None:
        self.closed = True


class Opening:
    """Opens lines, and counts."""

    def __init__(self) -> None:
        self.lines, self.there = list[Fickle](), True

    def __call__(self) -> ByteLine:
        if not self.there:
            raise ConnectionError("not there")
        self.lines.append(Fickle())
        return self.lines[-1]


def states(link: Link) -> tuple[bool, int]:
    """Whether it has a line, and how many it had."""
    return link.up, link.count


def times(link: Link, begin: float, seconds: float, seen: Callable[[], int]) -> list[float]:
    """When `seen` counted one more, from `begin` on."""
    found, before = list[float](), seen()
    for step in range(round(seconds / 0.01)):
        link.receive(begin + step * 0.01)
        if seen() != before:
            found, before = [*found, step * 0.01], seen()
    return found


def test_a_link_opens_its_line_again_with_growing_pauses() -> None:
    opening = Opening()
    link = Link(0.0, opening)
    assert states(link) == (True, 1)
    opening.lines[0].gone, opening.there = True, False
    tries = 0

    def trying() -> ByteLine:
        nonlocal tries
        tries += 1
        return opening()

    link._open = trying
    at = times(link, 10.0, 20.0, lambda: tries)
    assert at == pytest.approx([0.2, 0.6, 1.4, 3.0, 6.2, 9.4, 12.6, 15.8, 19.0], abs=0.05)
    assert opening.lines[0].closed and link.why == "not there"
    assert states(link) == (False, 1)
    link.send(30.0, b"lost")
    opening.there = True
    link.receive(40.0)
    assert states(link) == (True, 2)
    opening.lines[1].data = b"x"
    assert link.receive(40.1) == b"x" and link.why == ""


def test_a_line_that_served_for_long_is_opened_again_soon() -> None:
    opening = Opening()
    link = Link(0.0, opening)
    for begin in (0.0, 100.0):
        for _ in range(8):  # lines that are lost at once: the pauses grow
            opening.lines[-1].gone = True
            times(link, begin, 2 * PAUSES[1], lambda: link.count)
            begin += 2 * PAUSES[1]
    opening.lines[-1].gone = False
    link.receive(200.0)
    link.drop(200.0 + 2 * PAUSES[1], "rubbish")
    for _ in range(9):  # a driver that still finds rubbish in its buffer
        link.drop(200.1 + 2 * PAUSES[1], "rubbish again")
    assert link.why == "rubbish" and not link.up
    assert times(link, 206.4, 1.0, lambda: link.count) == pytest.approx([0.2], abs=0.02)


def test_a_silent_line_is_given_up() -> None:
    opening = Opening()
    link = Link(0.0, opening, patience=1.0)
    assert link.receive(0.9) == b"" and states(link) == (True, 1)
    opening.lines[0].data = b"x"
    link.receive(1.0)
    assert link.receive(1.9) == b"" and states(link) == (True, 1)
    link.receive(2.1)
    assert (
        states(link) == (False, 1)
        and link.why == "nothing came for 1 s"
        and opening.lines[0].closed
    )
    link.close()


@pytest.mark.parametrize(
    ("there", "others"),
    [
        ({"serial/by-id/*": ["usb-1a86"], "tty[AU][CS][BM]*": ["ttyUSB0"]}, "usb-1a86"),
        ({"tty[AU][CS][BM]*": ["ttyUSB1", "ttyACM0"]}, "ttyACM0, ttyUSB1"),
        ({}, "no serial adapter"),
    ],
)
def test_a_serial_port_that_is_not_there(
    there: dict[str, list[str]], others: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "glob", lambda path, pattern: there.get(pattern, []))
    with pytest.raises(ConnectionError, match=rf"no such file: is it .* This host has {others}$"):
        SerialPort(str(tmp_path / "ttyUSB0"), 9600)


def test_a_serial_port_that_this_user_may_not_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = tmp_path / "ttyUSB0"
    port.touch()
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(
        ConnectionError, match=f"may not open it; `sudo usermod -aG {port.group()} "
    ):
        SerialPort(str(port), 9600)
