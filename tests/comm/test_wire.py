"""One connection: division of the bytes, handshake, states, and attacks."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import msgpack
import pytest
from hypothesis import given, strategies as st

from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.codec import LIMITS, decode, encode
from petrobot.services.comm.protocol.security import Keys
from petrobot.services.comm.protocol.wire import (
    Connection,
    ConnectionState,
    ProtocolError,
    Side,
    negotiate,
)
from tests.comm.conftest import KEY, KINDS, NONCES, SERVER, greet, messages_of, new_pair
from tests.comm.ends import framed, head
from tests.waiting import Limit

Pair = Callable[[bytes | None], tuple[Connection, Connection]]
HELLO = m.Hello(2, 2, "coordinator", "coord", "b0", 1)
WELCOME = m.Welcome(2, "vision", "b1", ("track",))

FROM_CLIENT = {
    m.Call,
    m.ResultAck,
    m.Cancel,
    m.EventAck,
    m.Subscribe,
    m.Command,
    m.Ping,
    m.Pong,
    m.Tick,
    m.Bye,
    m.Refuse,
    m.StreamOpen,
    m.SetPoint,
    m.Withdraw,
}
FROM_SERVER = {
    m.Accept,
    m.Feedback,
    m.Outcome,
    m.Event,
    m.Answer,
    m.Ping,
    m.Pong,
    m.Tick,
    m.Bye,
    m.Refuse,
}
SPOKEN = messages_of(
    sorted(FROM_CLIENT - {m.Bye, m.Refuse, m.Ping, m.Pong}, key=lambda kind: kind.__name__)
)


def _cut(data: bytes, cuts: list[int]) -> list[bytes]:
    places = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(places)]


@given(st.data(), st.booleans())
def test_any_division_of_the_bytes_gives_the_same_messages(
    data: st.DataObject, sealed: bool
) -> None:
    client, server = new_pair(KEY if sealed else None)
    greet(client, server)
    sent = data.draw(st.lists(SPOKEN, max_size=6))
    stream = b"".join(client.send(message) for message in sent)
    cuts = data.draw(st.lists(st.integers(0, 10_000), max_size=12))
    received = [message for piece in _cut(stream, cuts) for message in server.receive_data(piece)]
    assert received == sent


@given(st.lists(SPOKEN, max_size=6), st.booleans())
def test_several_messages_at_once_are_the_bytes_of_each(
    sent: list[m.Message], sealed: bool
) -> None:
    (one, server), (other, _) = [new_pair(KEY if sealed else None) for _ in range(2)]
    greet(one, server)
    greet(other, new_pair(KEY if sealed else None)[1])
    together = one.send_all(sent)
    assert together == b"".join(other.send(message) for message in sent)
    assert server.receive_data(together) == sent


def test_several_messages_of_which_one_is_invalid_change_nothing(
    open_pair: Pair, key: bytes | None
) -> None:
    client, server = open_pair(key)
    for bad in (m.Bye(), m.Welcome(2, "x", "y"), m.Cancel("1", "x" * LIMITS[m.Cancel.KIND])):
        with pytest.raises(ProtocolError):
            client.send_all([m.Ping(1), bad])
    assert server.receive_data(client.send_all([m.Ping(2)])) == [m.Ping(2)]


def _told(read: Callable[[], m.Message]) -> str:
    try:
        return repr(read())
    except ProtocolError as fault:
        return str(fault)


@given(st.data(), st.booleans())
def test_an_open_connection_reads_a_body_like_decode(data: st.DataObject, sealed: bool) -> None:
    """Whole frames of the most frequent kinds are read without `decode`."""
    kind = data.draw(st.sampled_from((m.Call, m.Outcome)))
    body = bytearray(encode(data.draw(messages_of([kind]))))
    for place, byte in data.draw(
        st.lists(st.tuples(st.integers(2, 10_000), st.integers(0, 255)), max_size=2)
    ):
        body[min(place, len(body) - 1)] = byte
    _assert_read_alike(kind, bytes(body), KEY if sealed else None)


@pytest.mark.parametrize("kind", [m.Call, m.Outcome])
@pytest.mark.parametrize("length", [200, 239, 240, 255, 256, 300])
def test_a_long_name_is_measured_on_an_open_connection(
    kind: type[Any], length: int, key: bytes | None
) -> None:
    body = encode(kind("x", "y"))
    assert body.count(b"\xa1x") == 1
    _assert_read_alike(
        kind, body.replace(b"\xa1x", msgpack.packb("x" * length)), key
    )  # Our senders never make the long ones.


@pytest.mark.parametrize("empty", [[], {}])
def test_many_containers_are_counted_on_an_open_connection(empty: Any, key: bytes | None) -> None:
    for count in (19_000, 20_001, 70_000):
        _assert_read_alike(m.Call, msgpack.packb([4, "1", "x", {"v": [empty] * count}]), key)


def _assert_read_alike(kind: type[Any], body: bytes, key: bytes | None) -> None:
    client, server = new_pair(key)
    greet(client, server)
    speaker, listener = (client, server) if kind is m.Call else (server, client)
    framed = speaker._frame(body)
    assert _told(lambda: listener.receive_data(framed)[0]) == _told(lambda: decode(body))


def test_byte_by_byte_handshake_and_call(key: bytes | None, pair: Pair) -> None:
    client, server = pair(key)
    towards_server, towards_client = client.send(HELLO), b""
    seen: list[m.Message] = []
    limit = Limit("silence on the line", steps=20)
    while (towards_server or towards_client) and limit.left():
        for byte in towards_server:
            for message in server.receive_data(bytes([byte])):
                seen.append(message)
                if isinstance(message, m.Hello):
                    towards_client += server.send(WELCOME)
        towards_server = b""
        towards_client += server.data_to_send()
        for byte in towards_client:
            for message in client.receive_data(bytes([byte])):
                seen.append(message)
                towards_server += client.send(m.Call("c1", "track"))
        towards_client = b""
        towards_server += client.data_to_send()
    assert [type(message) for message in seen] == [m.Hello, m.Welcome, m.Call]
    assert (
        client.state is ConnectionState.OPEN
        and server.state is ConnectionState.OPEN
        and client.version == server.version == 2
    )


@given(
    st.lists(st.binary(max_size=60), max_size=5),
    st.sampled_from([None, KEY]),
    st.sampled_from(Side),
    st.booleans(),
)
def test_random_bytes_raise_nothing_but_protocol_error(
    pieces: list[bytes], key: bytes | None, side: Side, opened: bool
) -> None:
    client, server = new_pair(key)
    if opened:
        greet(client, server)
    elif side is Side.CLIENT:
        client.send(HELLO)
    victim = client if side is Side.CLIENT else server
    for piece in pieces:
        try:
            victim.receive_data(piece)
        except ProtocolError:
            assert victim.state is ConnectionState.CLOSED
            assert victim.receive_data(b"anything more") == []
            return


@given(st.data())
def test_messages_before_a_fault_are_not_lost(data: st.DataObject) -> None:
    client, server = new_pair(None)
    greet(client, server)
    sent = data.draw(st.lists(SPOKEN, min_size=1, max_size=4))
    stream = b"".join(client.send(message) for message in sent) + framed(b"\x91\x7f")
    received: list[m.Message] = []
    with pytest.raises(ProtocolError, match="unknown_kind"):
        for piece in _cut(stream, data.draw(st.lists(st.integers(0, 10_000), max_size=6))):
            try:
                received += server.receive_data(piece)
            except ProtocolError as fault:
                received += fault.before
                raise
    assert received == sent


SAMPLES: dict[type[Any], Any] = {
    m.Hello: HELLO,
    m.Welcome: WELCOME,
    m.Refuse: m.Refuse("x", "y"),
    m.Call: m.Call("c1", "track"),
    m.Accept: m.Accept("c1"),
    m.Feedback: m.Feedback("c1", 0.5),
    m.Outcome: m.Outcome("c1", "success"),
    m.ResultAck: m.ResultAck("c1"),
    m.Cancel: m.Cancel("c1"),
    m.Event: m.Event("tick", "timer", 0),
    m.EventAck: m.EventAck("timer", 1),
    m.Subscribe: m.Subscribe(("tick",)),
    m.Command: m.Command("k1", "hold"),
    m.Answer: m.Answer("k1", True),
    m.Ping: m.Ping(1),
    m.Pong: m.Pong(1),
    m.Tick: m.Tick(1),
    m.Bye: m.Bye("done"),
    m.Challenge: m.Challenge(b"n" * 32),
    m.Proof: m.Proof(b"p" * 32),
    m.StreamOpen: m.StreamOpen("cp", 0.04),
    m.SetPoint: m.SetPoint(1, (1.0,)),
    m.Withdraw: m.Withdraw(),
}


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_each_side_of_an_open_connection_sends_only_its_own_kinds(
    kind: type[Any], open_pair: Pair
) -> None:
    for speaker, kinds in ((0, FROM_CLIENT), (1, FROM_SERVER)):
        ends = open_pair(None)
        if kind in kinds:
            assert ends[1 - speaker].receive_data(ends[speaker].send(SAMPLES[kind])) == [
                SAMPLES[kind]
            ]
            continue
        with pytest.raises(ProtocolError, match="out_of_turn"):
            ends[speaker].send(SAMPLES[kind])
        with pytest.raises(ProtocolError, match="out_of_turn"):
            ends[1 - speaker].receive_data(framed(encode(SAMPLES[kind])))


def _raw(message: m.Message) -> bytes:
    body = encode(message)
    return len(body).to_bytes(4, "big") + body


@pytest.mark.parametrize(
    "kind", [kind for kind in KINDS if kind is not m.Hello], ids=lambda kind: kind.__name__
)
def test_a_server_accepts_only_hello_as_the_first_message(
    kind: type[Any], key: bytes | None, pair: Pair
) -> None:
    _, server = pair(key)
    with pytest.raises(ProtocolError, match="out_of_turn"):
        server.receive_data(_raw(SAMPLES[kind]))


@pytest.mark.parametrize(
    "kind", [m.Call, m.Hello, m.Welcome, m.Ping], ids=lambda kind: kind.__name__
)
def test_a_server_with_a_key_accepts_only_the_proof_as_the_second_message(
    kind: type[Any], pair: Pair
) -> None:
    client, server = pair(KEY)
    assert server.receive_data(client.send(HELLO)) == []
    with pytest.raises(ProtocolError, match="out_of_turn"):
        server.receive_data(_raw(SAMPLES[kind]))


def test_nothing_follows_the_last_message(open_pair: Pair) -> None:
    for last in (m.Bye("done"), m.Refuse("x", "y")):
        client, server = open_pair(None)
        data = client.send(last)
        assert client.state is ConnectionState.CLOSING
        with pytest.raises(ProtocolError, match="out_of_turn"):
            client.send(m.Ping(1))
        assert server.receive_data(data + _raw(m.Ping(1))) == [last]
        assert server.state is ConnectionState.CLOSED
        assert server.receive_data(_raw(m.Ping(2))) == []
        assert client.receive_data(_raw(m.Pong(2))) == []


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_a_frame_above_its_kinds_limit_is_refused_from_its_first_bytes(
    kind: type[Any], open_pair: Pair
) -> None:
    client, server = open_pair(None)
    receiver = server if kind in FROM_CLIENT else client
    if kind not in FROM_CLIENT | FROM_SERVER:
        return
    first = head(LIMITS[kind.KIND] + 5) + bytes([0x92, kind.KIND])
    with pytest.raises(ProtocolError, match="too_large"):
        receiver.receive_data(first)


def test_a_large_hello_is_refused_from_its_first_bytes(key: bytes | None, pair: Pair) -> None:
    _, server = pair(key)
    with pytest.raises(ProtocolError, match="too_large"):
        server.receive_data(
            (LIMITS[m.Hello.KIND] + 1).to_bytes(4, "big") + bytes([0x99, m.Hello.KIND])
        )


def test_a_refusal_reaches_a_client_during_the_handshake(key: bytes | None, pair: Pair) -> None:
    client, server = pair(key)
    hello = server.receive_data(client.send(HELLO))
    if not hello:
        client.receive_data(server.data_to_send())
        server.receive_data(client.data_to_send())
    refusal = m.Refuse("directory", "copy the file")
    assert client.receive_data(server.send(refusal)) == [refusal]
    assert client.state is ConnectionState.CLOSED and server.state is ConnectionState.CLOSING


@pytest.mark.parametrize(
    ("oldest", "newest", "version"),
    [(2, 2, 2), (1, 9, 2), (0, 2, 2), (3, 9, None), (1, 1, None), (0, 0, None), (2, 1, None)],
)
def test_versions_are_negotiated(oldest: int, newest: int, version: int | None) -> None:
    assert negotiate(oldest, newest) == version


def test_a_client_without_a_common_version_is_refused(pair: Pair) -> None:
    _, server = pair(None)
    with pytest.raises(ProtocolError, match="version") as fault:
        server.receive_data(_raw(m.Hello(3, 4, "node", "n", "b")))
    assert "update the older side" in fault.value.text


def test_a_server_that_chooses_a_version_not_offered_is_refused(pair: Pair) -> None:
    client, server = pair(None)
    server.receive_data(client.send(HELLO))
    with pytest.raises(ProtocolError, match="version"):
        client.receive_data(server.send(m.Welcome(7, "vision", "b1")))


KEYS = [
    pytest.param(None, KEY, "key_needed", id="client without a key"),
    pytest.param(KEY, None, "no_key_here", id="server without a key"),
    pytest.param(KEY, KEY[::-1], "wrong_key", id="another key"),
]


@pytest.mark.parametrize(("client_key", "server_key", "code"), KEYS)
def test_a_server_refuses_a_client_with_another_key(
    client_key: bytes | None, server_key: bytes | None, code: str
) -> None:
    client = Connection(
        Side.CLIENT, SERVER, key=client_key, nonce=NONCES[Side.CLIENT] if client_key else b""
    )
    server = Connection(
        Side.SERVER, SERVER, key=server_key, nonce=NONCES[Side.SERVER] if server_key else b""
    )
    with pytest.raises(ProtocolError, match=code):
        server.receive_data(client.send(HELLO))
        client.receive_data(server.data_to_send())
        server.receive_data(client.data_to_send())


def test_a_server_that_does_not_know_the_key_is_refused_by_the_client(pair: Pair) -> None:
    for answer in (WELCOME, m.Challenge(b"short")):
        client, _ = pair(KEY)
        client.send(HELLO)
        with pytest.raises(ProtocolError, match=r"no_key_there|malformed"):
            client.receive_data(_raw(answer))
    client, _ = pair(KEY)
    client.send(HELLO)
    client.receive_data(_raw(m.Challenge(b"s" * 32)))
    for auth in (b"", b"x" * 32):
        forged = Connection(Side.CLIENT, SERVER, key=KEY, nonce=NONCES[Side.CLIENT])
        forged.send(HELLO)
        forged.receive_data(_raw(m.Challenge(b"s" * 32)))
        with pytest.raises(ProtocolError, match="wrong_key"):
            forged.receive_data(_raw(m.Welcome(2, "vision", "b1", auth=auth)))


def test_a_client_without_a_key_reports_that_one_is_needed(pair: Pair) -> None:
    client, _ = pair(None)
    client.send(HELLO)
    with pytest.raises(ProtocolError, match="key_needed"):
        client.receive_data(_raw(m.Challenge(b"s" * 32)))


def test_a_changed_version_range_invalidates_the_proof(pair: Pair) -> None:
    client, server = pair(KEY)
    hello = client.send(m.Hello(1, 3, "coordinator", "coord", "b0"))
    assert server.receive_data(hello.replace(b"\x01\x01\x03", b"\x01\x01\x02", 1)) == []
    client.receive_data(server.data_to_send())
    with pytest.raises(ProtocolError, match="wrong_key"):
        server.receive_data(client.data_to_send())


def test_a_changed_welcome_invalidates_its_proof(pair: Pair) -> None:
    client, server = pair(KEY)
    server.receive_data(client.send(HELLO))
    client.receive_data(server.data_to_send())
    server.receive_data(client.data_to_send())
    welcome = server.send(WELCOME)
    with pytest.raises(ProtocolError, match="wrong_key"):
        client.receive_data(welcome.replace(b"track", b"trick"))


def test_a_recorded_session_cannot_be_replayed(
    pair: Pair, shake_hands: Callable[..., bytes]
) -> None:
    client, server = pair(KEY)
    recorded = shake_hands(client, server) + client.send(m.Call("c1", "move"))
    again = Connection(Side.SERVER, SERVER, key=KEY, nonce=b"t" * 32)
    with pytest.raises(ProtocolError, match="wrong_key"):
        again.receive_data(recorded)
        again.receive_data(recorded)


Tamper = Callable[[list[bytes]], list[bytes]]
TAMPERS: dict[str, Tamper] = {
    "repeated": lambda frames: [frames[0], frames[0]],
    "left out": lambda frames: frames[1:],
    "swapped": lambda frames: [frames[1], frames[0]],
    "one bit": lambda frames: [frames[0][:-20] + bytes([frames[0][-20] ^ 1]) + frames[0][-19:]],
    "seal cut": lambda frames: [head(len(frames[0]) - 5) + frames[0][4:-1]],
    "no seal": lambda frames: [framed(encode(m.Call("c1", "move", {"to": "somewhere else"})))],
}


@pytest.mark.parametrize("tamper", TAMPERS.values(), ids=TAMPERS.keys())
def test_a_sealed_frame_moved_or_changed_is_refused(tamper: Tamper, open_pair: Pair) -> None:
    client, server = open_pair(KEY)
    frames = [client.send(m.Call(f"c{n}", "move", {"to": n})) for n in range(2)]
    with pytest.raises(ProtocolError, match=r"bad_seal|malformed"):
        for frame in tamper(frames):
            server.receive_data(frame)
    assert server.state is ConnectionState.CLOSED


def test_a_frame_cannot_be_sent_back_to_its_sender(open_pair: Pair) -> None:
    client, server = open_pair(KEY)
    ping = client.send(m.Ping(1))
    with pytest.raises(ProtocolError, match="bad_seal"):
        client.receive_data(ping)
    assert server.receive_data(ping) == [m.Ping(1)]


def test_a_connection_with_a_key_needs_a_nonce() -> None:
    with pytest.raises(ValueError, match="nonce of 32 bytes"):
        Connection(Side.CLIENT, SERVER, key=KEY)


def test_a_message_that_is_too_large_does_not_change_the_connection(
    key: bytes | None, open_pair: Pair
) -> None:
    client, server = open_pair(key)
    with pytest.raises(ProtocolError, match="too_large"):
        client.send(m.Cancel("c1", "x" * 5000))
    assert server.receive_data(client.send(m.Ping(1))) == [m.Ping(1)]


# --- the wanted node --------------------------------------------------------------------------


def test_a_server_of_another_name_refuses_and_seals_its_refusal(key: bytes | None) -> None:
    client = Connection(Side.CLIENT, "motion", key=key, nonce=NONCES[Side.CLIENT] if key else b"")
    server = Connection(Side.SERVER, "vision", key=key, nonce=NONCES[Side.SERVER] if key else b"")
    with pytest.raises(
        ProtocolError, match="wrong_node: this is vision, but the client asked for motion"
    ) as fault:
        server.receive_data(client.send(HELLO))
        client.receive_data(server.data_to_send())
        server.receive_data(client.data_to_send())
    (refusal,) = client.receive_data(server.refusal(m.Refuse(fault.value.code, fault.value.text)))
    assert isinstance(refusal, m.Refuse) and refusal.code == "wrong_node" and client.proven


def test_a_welcome_of_another_name_is_refused_although_its_proof_is_valid(
    key: bytes | None, pair: Pair
) -> None:
    """A server with the key, or without keys, that ignores which node HELLO wants."""
    client, server = pair(key)
    if server.receive_data(client.send(HELLO)) == []:
        client.receive_data(server.data_to_send())
        server.receive_data(client.data_to_send())
    with pytest.raises(
        ProtocolError, match="wrong_node: this is motion, but the client asked for vision"
    ):
        client.receive_data(server.send(m.Welcome(2, "motion", "b1")))
    assert client.version == 0


def test_a_name_changed_in_transit_fails_the_handshake(key: bytes | None, pair: Pair) -> None:
    client, _ = pair(key)
    server = Connection(Side.SERVER, "motion", key=key, nonce=NONCES[Side.SERVER] if key else b"")
    with pytest.raises(ProtocolError, match=r"wrong_key|bad_check"):
        server.receive_data(client.send(HELLO).replace(b"vision", b"motion"))
        client.receive_data(server.data_to_send())
        server.receive_data(client.data_to_send())


@pytest.mark.parametrize("when", ["after HELLO", "after PROOF"])
@pytest.mark.parametrize("sealed", [False, True], ids=["unsealed", "sealed by another key"])
def test_a_refusal_without_the_seal_is_not_proven(when: str, sealed: bool, pair: Pair) -> None:
    client, server = pair(KEY)
    hello = client.send(HELLO)
    if when == "after PROOF":
        server.receive_data(hello)
        client.receive_data(server.data_to_send())
    body = encode(m.Refuse("old_epoch", "go away"))
    if sealed and when == "after PROOF":
        body += bytes(16)
        with pytest.raises(ProtocolError, match="malformed"):
            client.receive_data(len(body).to_bytes(4, "big") + body)
        return
    assert client.receive_data(len(body).to_bytes(4, "big") + body) == [
        m.Refuse("old_epoch", "go away")
    ]
    assert not client.proven and client.state is ConnectionState.CLOSED


def test_two_keys_are_accepted_while_one_replaces_the_other() -> None:
    old, new = KEY, KEY[::-1]
    sides: list[Keys] = [old, (new, old), (old, new), new]
    for mine in sides:
        for its in sides:
            client = Connection(Side.CLIENT, SERVER, key=mine, nonce=NONCES[Side.CLIENT])
            server = Connection(Side.SERVER, SERVER, key=its, nonce=NONCES[Side.SERVER])
            if {mine, its} == {old, new}:
                with pytest.raises(ProtocolError, match="wrong_key"):
                    greet(client, server)
                continue
            greet(client, server)
            assert server.receive_data(client.send(m.Ping(1))) == [m.Ping(1)]
            assert client.receive_data(server.send(m.Ping(2))) == [m.Ping(2)]


# --- bits changed in transit ------------------------------------------------------------------


def _conversation(key: bytes | None) -> list[tuple[Side, bytes]]:
    """Return the messages of each side, in order, from HELLO on."""
    client, server = new_pair(key)
    said = [(Side.CLIENT, client.send(HELLO))]
    if not server.receive_data(said[0][1]):
        said.append((Side.SERVER, server.data_to_send()))
        client.receive_data(said[-1][1])
        said.append((Side.CLIENT, client.data_to_send()))
        server.receive_data(said[-1][1])
    said.append((Side.SERVER, server.send(WELCOME)))
    client.receive_data(said[-1][1])
    said += [(Side.CLIENT, client.send(m.Call("c1", "move", {"to": [1.5, 2], "name": "cup"}, 2.0)))]
    said += [
        (Side.SERVER, server.send(m.Accept("c1"))),
        (Side.SERVER, server.send(m.Outcome("c1", "success", {"x": 1}))),
    ]
    said += [
        (Side.CLIENT, client.send(m.SetPoint(1, (0.5, 1.5)))),
        (Side.CLIENT, client.send(m.Ping(1))),
    ]
    said += [
        (Side.SERVER, server.send(m.Event("button", "desk", 1, {"down": True}))),
        (Side.SERVER, server.send(m.Pong(1))),
    ]
    return said


def _play(
    said: list[tuple[Side, bytes]], key: bytes | None
) -> tuple[dict[Side, list[m.Message]], bool]:
    """Return what two new ends deliver when they receive these bytes, and whether a fault was
    detected."""
    ends = dict(zip((Side.CLIENT, Side.SERVER), new_pair(key), strict=True))
    ends[Side.CLIENT].send(HELLO)
    got: dict[Side, list[m.Message]] = {Side.CLIENT: [], Side.SERVER: []}
    for side, data in said:
        other = Side.SERVER if side is Side.CLIENT else Side.CLIENT
        try:
            came = ends[other].receive_data(data)
        except ProtocolError as fault:
            got[other] += fault.before
            return got, True
        got[other] += came
        if any(isinstance(message, m.Hello) for message in came):
            ends[other].send(WELCOME)
        if any(isinstance(message, m.Refuse | m.Bye) for message in came):
            return got, True
    return got, False


def _assert_noticed(
    said: list[tuple[Side, bytes]], number: int, changed: bytes, key: bytes | None
) -> None:
    got, noticed = _play([*said[:number], (said[number][0], changed), *said[number + 1 :]], key)
    right, _ = _play(said, key)
    for side, messages in got.items():
        its = [message for message in messages if not isinstance(message, m.Refuse)]
        assert its == right[side][: len(its)], "a wrong value was delivered"
    waits = any(len(got[side]) < len(right[side]) for side in Side)
    assert noticed or waits, (
        "an incomplete frame does not count, so the limit on silence ends the connection"
    )


def test_any_single_changed_bit_of_a_conversation_is_detected(key: bytes | None) -> None:
    """This includes the lengths: a frame made longer delivers nothing."""
    said = _conversation(key)
    right, noticed = _play(said, key)
    assert not noticed and [len(right[side]) for side in Side] == [5, 4]
    injections = 0
    for number, (_, data) in enumerate(said):
        for bit in range(8 * len(data)):
            changed = bytearray(data)
            changed[bit // 8] ^= 128 >> bit % 8
            _assert_noticed(said, number, bytes(changed), key)
            injections += 1
    assert injections > 2_000


@given(st.data(), st.booleans())
def test_no_burst_of_changed_bits_delivers_a_wrong_value(data: st.DataObject, sealed: bool) -> None:
    key = KEY if sealed else None
    said = _conversation(key)
    number = data.draw(st.integers(2 + 2 * sealed, len(said) - 1))
    its = said[number][1]
    start = data.draw(st.integers(4, len(its) - 2))
    noise = data.draw(st.binary(min_size=1, max_size=min(8, len(its) - start)))
    changed = bytes(a ^ b for a, b in zip(its[start:], noise, strict=False))
    if any(noise):
        _assert_noticed(said, number, its[:start] + changed + its[start + len(noise) :], key)
