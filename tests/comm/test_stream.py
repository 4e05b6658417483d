"""Set-point streams: the newest value wins; lateness, refusals, and ends."""

from __future__ import annotations

import math
import socket
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import count

import msgpack
import pytest
from hypothesis import given, strategies as st

from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.security import KeyNeededError
from petrobot.services.comm.streams.stream import (
    Incoming,
    Inlet,
    Lateness,
    StreamReceiver,
    StreamSender,
)
from tests.comm.ends import frame, framed
from tests.waiting import wait_for


class RecordingSink:
    """Records the values that it receives; None for a withdrawal."""

    def __init__(self) -> None:
        self.got: list[tuple[tuple[float, ...], float] | None] = []

    def take(self, values: Sequence[float], held: float = 0.0) -> None:
        self.got.append((tuple(values), held))

    def withdraw(self) -> None:
        self.got.append(None)


def _point(number: int, elapsed: float = 0.0, held: float = 0.0) -> m.SetPoint:
    return m.SetPoint(number, (float(number),), held, elapsed)


def test_only_the_newest_value_is_delivered() -> None:
    sink = RecordingSink()
    inlet = Inlet(0.1, sink)
    inlet.receive(1.0, [_point(1), _point(2), _point(3, held=0.04)])
    inlet.receive(1.1, [])
    inlet.receive(1.2, [_point(4), m.Withdraw()])
    inlet.receive(1.3, [m.Withdraw(), _point(5, elapsed=0.3)])
    assert sink.got == [((3.0,), 0.04), None, ((5.0,), 0.0)]


def test_after_an_emergency_stop_values_count_once_their_sender_tells_a_later_run() -> None:
    """Silence does not make an old run a new one."""
    sink = RecordingSink()
    inlet = Inlet(0.1, sink, before=2.0)
    for now in (1.1, 1.2, 9.0):
        inlet.receive(now, [_point(2, elapsed=now - 1.0)])
    inlet.receive(9.1, [m.Withdraw(2.1), _point(3, elapsed=8.1)])
    assert sink.got == []
    inlet.receive(9.1, [_point(3, elapsed=8.1), m.Withdraw(1.9), _point(4, elapsed=8.1)])
    inlet.receive(9.2, [m.Withdraw(2.1), _point(5, elapsed=8.2)])
    assert sink.got == [((4.0,), 0.0)]


def test_a_delay_in_transit_is_part_of_the_age() -> None:
    sink = RecordingSink()
    inlet = Inlet(0.04, sink)
    for n in range(5):
        inlet.receive(100.0 + n * 0.04, [_point(n, elapsed=n * 0.04)])
    assert [one and one[0] for one in sink.got] == [(float(n),) for n in range(5)]
    inlet.receive(100.279, [])
    assert sink.got[-1] is not None
    inlet.receive(100.281, [])
    inlet.receive(100.3, [])
    assert sink.got[5:] == [None], "after three periods it is withdrawn, once"
    inlet.receive(100.7, [_point(5, elapsed=0.20)])
    assert sink.got[5:] == [None], "half a second late: left out"
    inlet.receive(100.7, [_point(6, elapsed=0.60)])
    newest = sink.got[6]
    assert newest is not None and newest[0] == (6.0,)
    assert newest[1] == pytest.approx(0.1, abs=1e-3), "its delay is part of its age"
    inlet.receive(100.719, [])
    assert len(sink.got) == 7
    inlet.receive(100.721, [])
    assert sink.got[7:] == [None]


@given(
    st.lists(st.tuples(st.floats(0.001, 0.1), st.floats(0.0, 0.5)), min_size=1, max_size=50),
    st.floats(-1e3, 1e3),
)
def test_lateness_is_the_delay_relative_to_the_fastest_message(
    steps: list[tuple[float, float]], offset: float
) -> None:
    lateness, elapsed, quickest, arrived = Lateness(), 0.0, float("inf"), float("-inf")
    for step, delay in steps:
        elapsed += step
        arrived = max(arrived, elapsed + delay)
        quickest = min(quickest, arrived - elapsed)
        late = lateness.of(arrived + offset, elapsed)
        assert 0.0 <= late <= arrived - elapsed - quickest + 1e-9
        assert late >= arrived - elapsed - quickest - 1e-4 * 10.0


def test_a_drifting_clock_does_not_make_a_stream_late_after_an_hour() -> None:
    lateness = Lateness()
    assert max(lateness.of(t * 0.04 * (1.0 + 5e-5), t * 0.04) for t in range(90_000)) < 1e-5


# On sockets.


@pytest.fixture
def sink() -> RecordingSink:
    return RecordingSink()


@pytest.fixture
def receiver(sink: RecordingSink, key: bytes | None) -> Iterator[StreamReceiver]:
    one = StreamReceiver("motion", {"catch_point": Incoming(0.04, sink, "t1")}, key=key)
    yield one
    one.close()


@pytest.fixture
def sender(receiver: StreamReceiver, key: bytes | None) -> Iterator[StreamSender]:
    one = StreamSender(
        "vision", "catch_point", 0.04, *receiver.address, receiver="motion", ticket="t1", key=key
    )
    yield one
    one.close()


def test_a_stream_from_its_first_value_to_its_end(
    sink: RecordingSink, receiver: StreamReceiver, sender: StreamSender
) -> None:
    assert not sender.send((0.0,)), "not connected yet: dropped, a newer one follows"
    wait_for(lambda: sender.up, sender.advance, receiver.poll)
    assert sender.send((1.0, 2.0), held=0.08) and sender.send((3.0, 4.0))
    wait_for(lambda: bool(sink.got), receiver.poll)
    wait_for(lambda: sink.got[-1] is not None and sink.got[-1][0] == (3.0, 4.0), receiver.poll)
    assert sender.send((5.0,), run="another")
    wait_for(lambda: sink.got[-1] is not None and sink.got[-1][0] == (5.0,), receiver.poll)
    sender.close()
    wait_for(lambda: sink.got[-1] is None, receiver.poll)
    assert len(receiver.sockets()) == 1 and receiver.faults == 0


@pytest.mark.parametrize(("began", "counts"), [("before", False), ("after", True)])
def test_after_an_emergency_stop_a_new_connection_does_not_make_a_run_new(
    began: str, counts: bool, sink: RecordingSink, receiver: StreamReceiver, sender: StreamSender
) -> None:
    """Nor does a run that published nothing before, such as that of a frozen process. On a clock
    of the test: for a process that stands still here, a later run would be an older one."""
    now = [0.0]
    receiver._clock = sender._clock = lambda: now[0]

    def send(run: str, age: float) -> None:
        sender.send((1.0,), run=run, age=age)
        receiver.poll()
        now[0] += 0.002

    wait_for(lambda: bool(sink.got), lambda: send("old", 0.0))
    start = now[0]
    receiver.bar()
    if began == "after":
        start = now[0] = now[0] + 0.3  # more than the connection takes
    end = now[0] + 1.0
    wait_for(lambda: now[0] > end or sink.got[-1] is not None, lambda: send("new", now[0] - start))
    assert sender.up and (sink.got[-1] is not None) is counts


def test_values_of_a_sender_that_is_gone_are_withdrawn(
    sink: RecordingSink, receiver: StreamReceiver, sender: StreamSender
) -> None:
    wait_for(lambda: bool(sink.got), lambda: sender.send((1.0,)), receiver.poll)
    assert sender._line is not None
    sender._line.sock.close()
    wait_for(lambda: sink.got[-1] is None, receiver.poll)


def test_a_sender_connects_again_to_a_receiver_that_returns(
    sink: RecordingSink, receiver: StreamReceiver, sender: StreamSender, key: bytes | None
) -> None:
    wait_for(lambda: bool(sink.got), lambda: sender.send((1.0,)), receiver.poll)
    host, port = receiver.address
    receiver.close()
    wait_for(lambda: not sender.up, lambda: sender.send((2.0,)))
    again = StreamReceiver(
        "motion", {"catch_point": Incoming(0.04, sink, "t1")}, host=host, port=port, key=key
    )
    wait_for(lambda: sink.got[-1] is not None, lambda: sender.send((3.0,)), again.poll)
    again.close()


def test_a_sender_whose_receiver_is_never_heard_connects_again() -> None:
    """As when a tunnel loses one direction, the receiver's answer and the end of the connection."""
    times = count(0.0, 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        silent.settimeout(60.0)
        sender = StreamSender(
            *("vision", "catch_point", 0.04, *silent.getsockname()),
            receiver="motion",
            clock=lambda: next(times),
        )
        for _ in range(20):
            assert not sender.send((1.0,))
        for _ in range(2):
            silent.accept()[0].close()
        sender.close()


def test_the_newest_sender_of_a_stream_takes_it_over(
    sink: RecordingSink, receiver: StreamReceiver, sender: StreamSender, key: bytes | None
) -> None:
    wait_for(lambda: bool(sink.got), lambda: sender.send((1.0,)), receiver.poll)
    other = StreamSender(
        "vision2", "catch_point", 0.04, *receiver.address, receiver="motion", ticket="t1", key=key
    )
    wait_for(
        lambda: sink.got[-1] is not None and sink.got[-1][0] == (2.0,),
        lambda: other.send((2.0,)),
        receiver.poll,
    )
    assert len(receiver.sockets()) == 2
    other.close()


@pytest.mark.parametrize(
    ("stream", "period", "ticket", "code"),
    [
        ("other", 0.04, "t1", "unknown_stream"),
        ("catch_point", 0.1, "t1", "period"),
        ("catch_point", 0.04, "t2", "ticket"),
        ("catch_point", 0.04, "", "ticket"),
    ],
)
def test_a_stream_with_wrong_data_is_refused_with_the_reason(
    sink: RecordingSink,
    receiver: StreamReceiver,
    key: bytes | None,
    stream: str,
    period: float,
    ticket: str,
    code: str,
) -> None:
    sender = StreamSender(
        "vision", stream, period, *receiver.address, receiver="motion", ticket=ticket, key=key
    )
    wait_for(lambda: bool(sender.refusal), lambda: sender.send((1.0,)), receiver.poll)
    assert sender.refusal.startswith(code) and not sender.up
    assert receiver.faults >= 1 and sink.got == []
    sender.close()


@pytest.mark.parametrize("key", [b"k" * 32], indirect=True, ids=["sealed"])
def test_a_sender_without_the_key_is_refused(sink: RecordingSink, receiver: StreamReceiver) -> None:
    for wrong in (None, b"x" * 32):
        sender = StreamSender(
            "vision",
            "catch_point",
            0.04,
            *receiver.address,
            receiver="motion",
            ticket="t1",
            key=wrong,
        )
        wait_for(
            lambda one=sender: bool(one.refusal),  # type: ignore[misc]
            partial(sender.send, (1.0,)),
            receiver.poll,
        )
        assert "key" in sender.refusal
        sender.close()
    assert sink.got == []


OPENING = frame(m.Hello(2, 2, "stream", "vision", "b"))
MALFORMED = [
    pytest.param([b"\x00\x00\x00\x05hello"], id="random bytes"),
    pytest.param([OPENING, frame(m.SetPoint(1, (1.0,)))], id="no STREAM_OPEN"),
    pytest.param(
        [OPENING, frame(m.StreamOpen("catch_point", 0.04, "t1")), b"\xff" * 9], id="bad set point"
    ),
    pytest.param([OPENING, framed(msgpack.packb([m.SetPoint.KIND, 1, [math.nan]]))], id="nan"),
]


@pytest.mark.parametrize("key", [None], indirect=True, ids=["plain"])
@pytest.mark.parametrize("said", MALFORMED)
def test_malformed_set_points_end_only_their_own_connection(
    sink: RecordingSink, receiver: StreamReceiver, sender: StreamSender, said: list[bytes]
) -> None:
    with socket.create_connection(receiver.address) as sock:
        for data in said:
            sock.sendall(data)
            wait_for(lambda: receiver.faults > 0 or _is_served(receiver), receiver.poll)
        wait_for(lambda: receiver.faults == 1 and len(receiver.sockets()) == 1, receiver.poll)
    wait_for(
        lambda: bool(sink.got) and sink.got[-1] is not None,
        lambda: sender.send((1.0,)),
        receiver.poll,
    )


def _is_served(receiver: StreamReceiver) -> bool:
    return any(guest.line.connection.version for guest in receiver._guests.values())


@pytest.mark.parametrize("key", [None], indirect=True, ids=["plain"])
def test_many_idle_connections_do_not_block_a_sender(
    sink: RecordingSink, receiver: StreamReceiver, sender: StreamSender
) -> None:
    idle = [socket.create_connection(receiver.address) for _ in range(40)]
    wait_for(lambda: bool(sink.got), lambda: sender.send((1.0,)), receiver.poll)
    assert len(receiver.sockets()) <= 17
    for one in idle:
        one.close()


@pytest.mark.parametrize("key", [None], indirect=True, ids=["plain"])
def test_a_frozen_receiver_never_blocks_its_sender_and_then_gets_the_newest_value(
    sink: RecordingSink, receiver: StreamReceiver, sender: StreamSender
) -> None:
    wait_for(lambda: bool(sink.got), lambda: sender.send((1.0,)), receiver.poll)
    for n in range(20_000):
        sender.send((float(n),))
    assert sender.dropped > 0
    wait_for(
        lambda: sink.got[-1] is not None and sink.got[-1][0] == (-1.0,),
        receiver.poll,
        lambda: sender.send((-1.0,)),
    )
    assert len(sink.got) < 5_000


def test_other_hosts_cannot_send_without_a_key() -> None:
    with pytest.raises(KeyNeededError):
        StreamReceiver("motion", {}, host="0.0.0.0")
