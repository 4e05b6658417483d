"""The python-can interface `petrobot_stream`: the conformance tests of python-can's own interfaces,
the hub, and bad input."""

from __future__ import annotations

import errno
import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import can
import pytest
from hypothesis import given, strategies as st

from petrobot.services.comm.canopen.bus import CanBus, Frame
from petrobot.services.comm.canopen.byte_stream import (
    EXTENDED,
    GREETING,
    REMOTE,
    CanHub,
    Splitter,
    StreamBus,
    StreamFormatError,
    encode,
    parse_channel,
)
from petrobot.services.comm.canopen.ports import PythonCanBus, StreamPort, open_can
from tests.motion.conftest import LiveHub
from tests.waiting import PATIENCE_S as PATIENCE, Limit


@pytest.fixture(params=["tcp", "unix"])
def channel(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    running = LiveHub(
        CanHub("tcp://127.0.0.1:0" if request.param == "tcp" else f"unix://{tmp_path}/can")
    )
    yield running.channel
    running.close()


def _open(channel: str, **settings: Any) -> can.BusABC:
    bus = can.Bus(interface="petrobot_stream", channel=channel, **settings)
    assert isinstance(bus, StreamBus)
    return bus


@pytest.fixture
def pair(channel: str) -> Iterator[tuple[can.BusABC, can.BusABC]]:
    """Two buses, both registered at the hub."""
    first, second = _open(channel), _open(channel)
    for sender, receiver in ((first, second), (second, first)):
        sender.send(can.Message(arbitration_id=0x7FF, is_extended_id=False))
        limit = Limit("the first message")
        while (
            receiver.recv(timeout=0.05) is None and limit.left()
        ):  # The hub had not registered the other bus yet.
            sender.send(can.Message(arbitration_id=0x7FF, is_extended_id=False))
    _flush(first, second)
    _flush(second, first)
    yield first, second
    first.shutdown()
    second.shutdown()


def _flush(sender: can.BusABC, receiver: can.BusABC) -> None:
    """Receive all that was sent before, however late the hub passes it on."""
    sender.send(can.Message(arbitration_id=0x7FE, is_extended_id=False))
    limit = Limit("the last message")
    while limit.left():
        got = receiver.recv(PATIENCE)
        if got is not None and got.arbitration_id == 0x7FE:
            return


MESSAGES = [
    can.Message(arbitration_id=0x123, is_extended_id=False, data=data)
    for data in (b"", b"\x00", bytes(range(8)))
] + [
    can.Message(arbitration_id=0x1FFFFFFF, is_extended_id=True, data=b"\x01\x02"),
    can.Message(arbitration_id=0x1, is_extended_id=True, data=b"\x01"),
    can.Message(arbitration_id=0x300, is_extended_id=False, is_remote_frame=True, dlc=4),
    can.Message(arbitration_id=0x20000000 >> 1, is_extended_id=True, is_remote_frame=True, dlc=0),
    can.Message(arbitration_id=0x0, is_extended_id=False, is_error_frame=True, data=b"\x00" * 8),
]


@pytest.mark.parametrize("message", MESSAGES, ids=str)
def test_back_to_back(pair: tuple[can.BusABC, can.BusABC], message: can.Message) -> None:
    for sender, receiver in (pair, pair[::-1]):
        sender.send(message)
        got = receiver.recv(PATIENCE)
        assert got is not None
        assert message.equals(got, timestamp_delta=None, check_channel=False, check_direction=False)
        assert got.is_rx
        assert got.channel is not None
        assert sender.recv(timeout=0.0) is None, "a port must not receive its own frames"


def test_many_frames_arrive_in_order_and_no_frame_is_lost(
    pair: tuple[can.BusABC, can.BusABC],
) -> None:
    sender, receiver = pair
    for number in range(2000):
        sender.send(
            can.Message(arbitration_id=0x100, is_extended_id=False, data=struct.pack("<I", number)),
            timeout=PATIENCE,
        )
    times = []
    for number in range(2000):
        got = receiver.recv(PATIENCE)
        assert got is not None
        assert struct.unpack("<I", got.data) == (number,)
        times.append(got.timestamp)
    assert times == sorted(times)


def test_receive_times_out_and_does_not_block(pair: tuple[can.BusABC, can.BusABC]) -> None:
    assert pair[0].recv(timeout=0.0) is None
    assert pair[0].recv(timeout=0.02) is None


def test_filters_are_applied(pair: tuple[can.BusABC, can.BusABC]) -> None:
    sender, receiver = pair
    receiver.set_filters([{"can_id": 0x200, "can_mask": 0x700, "extended": False}])
    for cob_id in (0x181, 0x201, 0x301, 0x2FF):
        sender.send(can.Message(arbitration_id=cob_id, is_extended_id=False))
    seen = [
        message.arbitration_id
        for message in (receiver.recv(PATIENCE), receiver.recv(PATIENCE))
        if message
    ]
    assert seen == [0x201, 0x2FF]
    assert receiver.recv(timeout=0.02) is None


def test_own_messages_are_received_on_request(channel: str) -> None:
    with _open(channel, receive_own_messages=True) as bus:
        bus.send(can.Message(arbitration_id=0x10, is_extended_id=False, data=b"\x05"))
        got = bus.recv(PATIENCE)
        assert got is not None
        assert not got.is_rx
        assert got.data == b"\x05"


def test_periodic_sending_works(pair: tuple[can.BusABC, can.BusABC]) -> None:
    sender, receiver = pair
    task = sender.send_periodic(can.Message(arbitration_id=0x33, is_extended_id=False), period=0.01)
    assert all(receiver.recv(PATIENCE) is not None for _ in range(3))
    task.stop()


def test_can_fd_is_refused(pair: tuple[can.BusABC, can.BusABC], channel: str) -> None:
    with pytest.raises(can.CanOperationError, match="classic CAN only"):
        pair[0].send(can.Message(arbitration_id=1, is_fd=True, data=b"\x00" * 12))
    with pytest.raises(can.CanInitializationError, match="classic CAN only"):
        _open(channel, fd=True)


@pytest.mark.parametrize(
    ("bad", "says"),
    [
        ("tcp://192.0.2.1:7303", "allow_remote=True"),
        ("tcp://0.0.0.0:7303", "allow_remote=True"),
        ("tcp://127.0.0.1", "expected tcp://127.0.0.1:7303"),
        ("can0", "expected tcp://127.0.0.1:7303"),
        ("unix://", "expected tcp://127.0.0.1:7303"),
    ],
)
def test_bad_channels_are_refused_with_a_remedy(bad: str, says: str) -> None:
    with pytest.raises(can.CanInitializationError, match=says):
        _open(bad)
    with pytest.raises(ValueError, match=says):
        CanHub(bad)


def test_another_host_can_be_allowed() -> None:
    assert parse_channel("tcp://192.0.2.1:7303", allow_remote=True)[1] == ("192.0.2.1", 7303)
    assert parse_channel("tcp://[::1]:7303") == (socket.AF_INET6, ("::1", 7303))
    assert parse_channel("tcp://localhost:7303")[1] == ("localhost", 7303)


def test_without_a_hub_there_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(can.CanInitializationError, match="no CAN hub at"):
        _open(f"unix://{tmp_path}/nobody")
    with pytest.raises(ConnectionError, match="Is the bus"):
        open_can({"interface": "petrobot_stream", "channel": f"unix://{tmp_path}/nobody"})


def test_a_closed_hub_is_noticed() -> None:
    running = LiveHub(CanHub())
    bus, port = _open(running.channel), StreamPort(running.channel)
    limit = Limit("the frame")
    while not port.receive() and limit.left():  # the hub may not have registered the port yet
        bus.send(can.Message(arbitration_id=1, is_extended_id=False))
        bus.recv(timeout=0.01)
    running.close()
    with pytest.raises(can.CanOperationError, match="closed by its other end"):
        bus.recv(PATIENCE)
    with pytest.raises(ConnectionError):
        port.receive()
    bus.shutdown()
    port.close()


def _poll_until(hub: CanHub, condition: Any) -> None:
    limit = Limit("the hub")
    while not condition() and limit.left():
        hub.poll(0.01)


def _collect(hub: CanHub, port: CanBus, got: list[Frame]) -> None:
    """Poll until a port has received frames."""

    def some() -> bool:
        got.extend(port.receive())
        return bool(got)

    _poll_until(hub, some)


@pytest.mark.parametrize(
    "rubbish",
    [b"GET / HTTP/1.1\r\n", GREETING + b"\x00\x00\x01\x23\x09", GREETING + b"\x00\x00\x08\x00\x00"],
)
def test_a_port_that_sends_malformed_bytes_is_dropped_and_the_others_continue(
    rubbish: bytes,
) -> None:
    hub = CanHub()
    good, other = StreamPort(hub.channel), StreamPort(hub.channel)
    host, port = parse_channel(hub.channel)[1]
    with socket.create_connection((host, port)) as bad:
        _poll_until(hub, lambda: hub.ports == 3)
        bad.sendall(rubbish)
        _poll_until(hub, lambda: hub.ports == 2)
    assert len(hub.dropped) == 1
    good.send(Frame(0x123, b"abc"))
    got: list[Frame] = []
    _collect(hub, other, got)
    assert got == [Frame(0x123, b"abc")]
    for each in (good, other, hub):
        each.close()


def test_a_port_that_does_not_read_is_dropped_and_does_not_stop_the_bus() -> None:
    hub = CanHub()
    lazy = socket.create_connection(parse_channel(hub.channel)[1])
    lazy.sendall(GREETING)
    reader, mine = StreamPort(hub.channel), hub.port()
    _poll_until(hub, lambda: hub.ports == 2)
    sent = seen = 0
    while hub.ports == 2:
        for _ in range(500):
            mine.send(Frame(0x1, bytes(8)))
        sent += 500
        hub.poll()
        seen += len(reader.receive())
        assert sent < 2_000_000
    limit = Limit("the frames that were sent")
    while seen < sent and limit.left():
        hub.poll(0.01)
        seen += len(reader.receive())
    assert "does not read" in hub.dropped[0]
    for each in (lazy, reader, hub):
        each.close()


def test_local_ports_python_can_and_stream_ports_receive_each_others_frames() -> None:
    hub = CanHub()
    local, stream = hub.port(), StreamPort(hub.channel)
    foreign = PythonCanBus(_open(hub.channel))
    _poll_until(hub, lambda: hub.ports == 2)
    frame = Frame(0x181, b"\x01\x02\x03")
    for sender, receivers in (
        (local, (stream, foreign)),
        (stream, (local, foreign)),
        (foreign, (local, stream)),
    ):
        sender.send(frame)
        for receiver in receivers:
            got: list[Frame] = []
            _collect(hub, receiver, got)
            assert got == [frame]
        assert list(sender.receive()) == []
    local.close()
    with pytest.raises(ConnectionError):
        local.send(frame)
    stream.close()
    foreign.close()
    hub.close()


def test_any_python_can_interface_is_a_can_bus() -> None:
    port = open_can({"interface": "virtual", "channel": "test_any_interface"})
    with can.Bus(interface="virtual", channel="test_any_interface") as other:
        port.send(Frame(0x80, b""))
        got = other.recv(PATIENCE)
        assert got is not None
        assert got.arbitration_id == 0x80
        other.send(can.Message(arbitration_id=0x1ABCDEF, is_extended_id=True))
        other.send(can.Message(arbitration_id=0x181, is_extended_id=False, data=b"\x07"))
        assert list(port.receive()) == [Frame(0x181, b"\x07")]
    port.close()


class Unplugged(can.BusABC):
    """A bus whose interface has been brought down."""

    def __init__(self) -> None:
        super().__init__("can0")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise can.CanOperationError("Failed to transmit: Network is down", errno.ENETDOWN)

    def _recv_internal(self, timeout: float | None) -> Any:
        raise can.CanOperationError("Error receiving: Network is down", errno.ENETDOWN)


def test_a_bus_that_is_not_there_or_not_up_says_what_helps(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(**settings: Any) -> can.BusABC:
        raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))

    table = {"interface": "socketcan", "channel": "can0"}
    monkeypatch.setattr(can, "Bus", absent)
    with pytest.raises(ConnectionError, match=r"^no CAN bus socketcan can0: .*; is its adapter"):
        open_can(table)
    monkeypatch.setattr(can, "Bus", lambda **settings: Unplugged())
    port = open_can(table)
    with pytest.raises(
        ConnectionError, match=r"is gone: .* is down .*; bring it up, as by `sudo ip"
    ):
        port.receive()
    with pytest.raises(
        ConnectionError, match=r"frames: .* is down .*; bring it up, as by `sudo ip"
    ):
        port.send(Frame(0x80, b""))
    port.close()


def test_a_can_bus_needs_interface_and_channel() -> None:
    with pytest.raises(ValueError, match="needs interface and channel"):
        open_can({"channel": "can0"})


def test_a_socket_file_left_behind_is_replaced_but_one_in_use_is_not(tmp_path: Path) -> None:
    path = tmp_path / "can"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    hub = CanHub(f"unix://{path}")
    with pytest.raises(OSError, match="listens on"):
        CanHub(f"unix://{path}")
    hub.close()
    assert not path.exists()


FRAMES = st.lists(
    st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)).map(
        lambda pair: (pair[0], len(pair[1]), pair[1])
    )
    | st.tuples(st.integers(0, 0x1FFFFFFF), st.binary(max_size=8)).map(
        lambda p: (p[0] | EXTENDED, len(p[1]), p[1])
    )
    | st.tuples(st.integers(0, 0x7FF), st.integers(0, 8)).map(
        lambda pair: (pair[0] | REMOTE, pair[1], b"")
    ),
    max_size=20,
)


@given(FRAMES, st.lists(st.integers(1, 40), max_size=60))
def test_frames_survive_any_division_of_the_bytes(
    frames: list[tuple[int, int, bytes]], cuts: list[int]
) -> None:
    raw = GREETING + b"".join(encode(word, data, dlc) for word, dlc, data in frames)
    splitter, got, at = Splitter(), [], 0
    for cut in [*cuts, len(raw)]:
        got += splitter.feed(raw[at : at + cut])
        at += cut
    assert got == frames


@given(st.binary(max_size=200))
def test_random_bytes_give_frames_or_a_format_error(data: bytes) -> None:
    splitter = Splitter()
    try:
        frames = splitter.feed(GREETING + data)
    except StreamFormatError:
        return
    assert all(dlc <= 8 for _, dlc, _ in frames)


def test_the_framing_byte_by_byte() -> None:
    assert encode(0x181, b"\x01\x02") == bytes.fromhex("00 00 01 81 02 01 02 01 78 a3 93")
    assert encode(0x1ABCDEF | EXTENDED, b"") == bytes.fromhex("81 ab cd ef 00 90 5f 1a 0b")
    assert encode(0x300 | REMOTE, b"", 4) == bytes.fromhex("40 00 03 00 04 9b fa d5 14")
    assert bytes.fromhex("50 42 43 41 4e 02") == GREETING


@given(st.integers(0, 10_000))
def test_one_changed_bit_is_noticed(bit: int) -> None:
    """It never gives another identifier or other data; with a changed length the receiver waits for
    more bytes, which are then checked."""
    frames = [
        (0x181, 2, b"\x01\x02"),
        (0x1ABCDEF | EXTENDED, 8, bytes(8)),
        (0x300 | REMOTE, 4, b""),
    ]
    raw = bytearray(b"".join(encode(word, data, dlc) for word, dlc, data in frames))
    raw[bit // 8 % len(raw)] ^= 1 << bit % 8
    splitter = Splitter()
    assert splitter.feed(GREETING) == []
    given: list[tuple[int, int, bytes]] = []
    with pytest.raises(StreamFormatError):
        for byte in raw + encode(0x80, b"") * 8:
            given += splitter.feed(bytes([byte]))
    assert given == frames[: len(given)]
