"""Messages as bytes: the exact bytes, decoding, and what is refused."""

from __future__ import annotations

import math
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import example, given, strategies as st
from msgspec.structs import replace

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.lockstep.party import Envelope, Posted
from petrobot.services.comm.protocol import codec, messages as m
from petrobot.services.comm.protocol.codec import (
    LIMITS,
    MAX_CONTAINERS,
    MIB,
    NAME_LENGTH,
    ProtocolError,
    decode,
    encode,
)
from petrobot.services.comm.protocol.messages import Executed
from petrobot.services.comm.protocol.plain import (
    DEPTH,
    MOST_VALUES,
    NotPlainError,
    pack_array,
    plain,
    unpack_array,
)
from tests.comm.conftest import KINDS, messages_of

ENVELOPE = Envelope("arm", "bus", "arm", "can", Frame(0x181, b"\x01\x02"))
FRAMES = [
    (
        m.Hello(1, 2, "coordinator", "coord", "b0", 3, "d1", b"\x01\x02"),
        "00 00 00 21 99 01 01 02 ab 63 6f 6f 72 64 69 6e 61 74 6f 72 a5 63 6f 6f 72 64 a2 62 "
        "30 03 a2 64 31 c4 02 01 02",
    ),
    (
        m.Welcome(1, "vision", "b1", ("track",), ("c1",), "d1", b"\x07"),
        "00 00 00 1e 98 02 01 a6 76 69 73 69 6f 6e a2 62 31 91 a5 74 72 61 63 6b 91 a2 63 31 "
        "a2 64 31 c4 01 07",
    ),
    (
        m.Refuse("version", "too old"),
        "00 00 00 12 93 03 a7 76 65 72 73 69 6f 6e a7 74 6f 6f 20 6f 6c 64",
    ),
    (
        m.Call("c1", "track", {"t": 1.5}, 2.0, 3, "b1", "p0", 7),
        "00 00 00 28 99 04 a2 63 31 a5 74 72 61 63 6b 81 a1 74 cb 3f f8 00 00 00 00 00 00 cb "
        "40 00 00 00 00 00 00 00 "
        "03 a2 62 31 a2 70 30 07",
    ),
    (m.Accept("c1"), "00 00 00 05 92 05 a2 63 31"),
    (
        m.Feedback("c1", 0.5, {"n": 1}),
        "00 00 00 12 94 06 a2 63 31 cb 3f e0 00 00 00 00 00 00 81 a1 6e 01",
    ),
    (
        m.Outcome("c1", "success", {"x": [1.0]}, "", "", Executed.YES, 0.25, 0.125),
        "00 00 00 32 99 07 a2 63 31 a7 73 75 63 63 65 73 73 81 a1 78 91 cb 3f f0 00 00 00 00 "
        "00 00 a0 a0 "
        "a3 79 65 73 cb 3f d0 00 00 00 00 00 00 cb 3f c0 00 00 00 00 00 00",
    ),
    (m.ResultAck("c1", ("c2",)), "00 00 00 09 93 08 a2 63 31 91 a2 63 32"),
    (m.Cancel("c1", "stop"), "00 00 00 0a 93 09 a2 63 31 a4 73 74 6f 70"),
    (
        m.Event("tick", "timer", 5, {"k": True}, ""),
        "00 00 00 13 96 0a a4 74 69 63 6b a5 74 69 6d 65 72 05 81 a1 6b c3 a0",
    ),
    (m.EventAck("timer", 5), "00 00 00 09 93 0b a5 74 69 6d 65 72 05"),
    (m.Subscribe(("tick", "caught")), "00 00 00 0f 92 0c 92 a4 74 69 63 6b a6 63 61 75 67 68 74"),
    (
        m.Command("k1", "hold", "arm", {}),
        "00 00 00 0f 95 0d a2 6b 31 a4 68 6f 6c 64 a3 61 72 6d 80",
    ),
    (m.Answer("k1", True, {"s": "held"}), "00 00 00 0e 94 0e a2 6b 31 c3 81 a1 73 a4 68 65 6c 64"),
    (m.Ping(1), "00 00 00 03 92 0f 01"),
    (m.Pong(1), "00 00 00 03 92 10 01"),
    (
        m.Tick(9, (Posted(10, 0, ENVELOPE),)),
        "00 00 00 1f 93 11 09 91 97 0a 00 a3 61 72 6d a3 62 75 73 a3 61 72 6d a3 63 61 6e 92 "
        "cd 01 81 c4 02 01 02",
    ),
    (m.Bye("done"), "00 00 00 07 92 12 a4 64 6f 6e 65"),
    (m.Challenge(b"\x01\x02"), "00 00 00 06 92 13 c4 02 01 02"),
    (m.Proof(b"\x03"), "00 00 00 05 92 14 c4 01 03"),
    (m.StreamOpen("cp", 0.04, "t"), "00 00 00 10 94 15 a2 63 70 cb 3f a4 7a e1 47 ae 14 7b a1 74"),
    (
        m.SetPoint(1, (1.0, -2.0), 0.0, 0.5),
        "00 00 00 28 95 16 01 92 cb 3f f0 00 00 00 00 00 00 cb c0 00 00 00 00 00 00 00 cb 00 "
        "00 00 00 00 00 00 00 "
        "cb 3f e0 00 00 00 00 00 00",
    ),
    (m.Withdraw(), "00 00 00 0b 92 17 cb 00 00 00 00 00 00 00 00"),
]


def test_the_table_of_frames_holds_every_kind() -> None:
    assert [type(message) for message, _ in FRAMES] == KINDS


@pytest.mark.parametrize(("message", "frame"), FRAMES, ids=lambda one: type(one).__name__)
def test_frame_byte_by_byte(message: m.Message, frame: str) -> None:
    expected = bytes.fromhex(frame)
    body = encode(message)
    assert len(body).to_bytes(4, "big") + body == expected
    assert decode(expected[4:]) == message


@given(st.data())
def test_every_message_is_decoded_as_it_was_encoded(
    messages: st.SearchStrategy[Any], data: st.DataObject
) -> None:
    message = data.draw(messages)
    assert decode(encode(message)) == message


@given(st.binary(max_size=200))
@example(b"\x81\x01\x02")
@example(b"\x92\x0f")
@example(b"\x9f\x04" + b"\x81" * 14)
@example(b"\x92\x0f\xd4\xff\x00")
@example(b"\x93\x12\xa1x\xa1y")
def test_random_bytes_raise_nothing_but_protocol_error(body: bytes) -> None:
    try:
        decode(body)
    except ProtocolError as fault:
        assert fault.code in ("malformed", "unknown_kind", "too_large")


@given(st.data())
def test_changed_bytes_raise_nothing_but_protocol_error(
    messages: st.SearchStrategy[Any], data: st.DataObject
) -> None:
    body = bytearray(encode(data.draw(messages)))
    for _ in range(data.draw(st.integers(1, 3))):
        body[data.draw(st.integers(2, max(2, len(body) - 1))) % len(body)] = data.draw(
            st.integers(0, 255)
        )
    try:
        message = decode(bytes(body))
    except ProtocolError:
        return
    assert decode(encode(message)) == message or _has_nan(message)


def _has_nan(message: m.Message) -> bool:
    return "nan" in repr(message)


def _nested(depth: int) -> dict[str, Any]:
    inner: dict[str, Any] = {}
    for _ in range(depth - 1):
        inner = {"a": inner}
    return inner


CALL = [4, "c1", "track", {}, None, 0, "", "", 0]


def _call(**changes: Any) -> list[Any]:
    names = ["id", "service", "arguments", "deadline", "epoch", "boot", "parent", "seed"]
    return [4, *(changes.get(name, value) for name, value in zip(names, CALL[1:], strict=True))]


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        pytest.param([4, "c1"], "fields", id="too few fields"),
        pytest.param([*CALL, True, 1], "fields", id="too many fields"),
        pytest.param(_call(id=7), "id: expected a str, found a int", id="number for text"),
        pytest.param(_call(id=None), "found a NoneType", id="nil for text"),
        pytest.param(
            _call(epoch=True), "epoch: expected a int, found a bool", id="bool for number"
        ),
        pytest.param(_call(epoch=1.0), "found a float", id="float for int"),
        pytest.param(_call(epoch=-1), "2^63", id="negative count"),
        pytest.param(_call(epoch=2**63), "2^63", id="count too large"),
        pytest.param(_call(deadline="1"), "found a str", id="text for duration"),
        pytest.param(_call(deadline=-0.1), "finite", id="negative duration"),
        pytest.param(_call(deadline=math.nan), "finite", id="nan duration"),
        pytest.param(_call(deadline=math.inf), "finite", id="endless duration"),
        pytest.param(_call(arguments=[]), "found a list", id="array for map"),
        pytest.param(_call(arguments={1: 2}), "not msgpack", id="number as key"),
        pytest.param(_call(arguments={b"k": 2}), "key", id="bytes as key"),
        pytest.param(_call(arguments=_nested(DEPTH + 2)), "deeper", id="too deep"),
        pytest.param(
            _call(arguments={"a": msgpack.ExtType(1, b"\x01\x00")}), "extension", id="extension"
        ),
        pytest.param(_call(arguments={"a": msgpack.Timestamp(1)}), "Timestamp", id="time stamp"),
        pytest.param(_call(id="x" * (NAME_LENGTH + 1)), "too long", id="long name"),
        pytest.param(
            [7, "c1", "success", {}, "", "", "perhaps", 0.0, 0.0], "yes, no", id="executed perhaps"
        ),
        pytest.param([12, ["tick", 1]], "array of str", id="number among names"),
        pytest.param([22, 1, [1.0, math.nan], 0.0, 0.0], "finite numbers", id="nan set point"),
        pytest.param([22, 1, [1.0, "2"], 0.0, 0.0], "finite numbers", id="text set point"),
        pytest.param([17, 3, [[4, 0, "a", "b", "c", "d"]]], "envelope", id="short envelope"),
        pytest.param(
            [17, 3, [[4, 0, 1, "b", "c", "d", None]]], "envelope", id="envelope to a number"
        ),
        pytest.param(
            [17, 3, [[-4, 0, "a", "b", "c", "d", None]]], "2^63", id="envelope due before"
        ),
        pytest.param(
            [17, 3, [[4, 0, "a", "b", "c", "d", msgpack.ExtType(9, b"")]]],
            "extension",
            id="extension 9",
        ),
        pytest.param(
            [17, 3, [[4, 0, "a", "b", "c", "d", msgpack.ExtType(1, b"\x03\x00")]]],
            "array",
            id="dtype 3",
        ),
        pytest.param(
            [17, 3, [[4, 0, "a", "b", "c", "d", msgpack.ExtType(2, encode(m.Tick(1)))]]],
            "extension",
            id="tick in tick",
        ),
    ],
)
def test_wrong_fields_are_refused(fields: list[Any], says: str) -> None:
    with pytest.raises(ProtocolError, match="malformed") as fault:
        decode(msgpack.packb(fields, strict_types=True))
    assert says in fault.value.text


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (CALL[:3], m.Call("c1", "track")),
        ([*CALL[:4], 2], m.Call("c1", "track", {}, 2.0)),
        ([22, 1, [1, 2]], m.SetPoint(1, (1.0, 2.0))),
        (
            [7, "c1", "error", {}, "x", "", "unknown", 1],
            m.Outcome("c1", "error", {}, "x", "", Executed.UNKNOWN, 1.0),
        ),
    ],
)
def test_trailing_fields_may_be_left_out_and_a_duration_may_be_an_integer(
    fields: list[Any], message: m.Message
) -> None:
    found = decode(msgpack.packb(fields))
    assert found == message
    assert decode(encode(found)) == message


_SCALARS = [
    None,
    True,
    0,
    1,
    -1,
    2**63,
    1.0,
    -1.0,
    math.nan,
    math.inf,
    "",
    "x",
    "no",
    "x" * 256,
    b"",
]
_odd: st.SearchStrategy[Any] = st.sampled_from(
    [*_SCALARS, [], {}, {"a": [1]}, {1: 2}, {b"k": 1}, {"a": [{3: 4}]}],
)


@given(
    st.sampled_from([4, 7]),
    st.lists(_odd, min_size=8, max_size=8),
    st.lists(st.booleans(), min_size=8, max_size=8),
    st.integers(1, 9),
    st.sampled_from([0, 300]),
)
def test_the_fast_decoder_agrees_with_the_table(
    kind: int, odd: list[Any], use: list[bool], length: int, padding: int
) -> None:
    usual = CALL if kind == 4 else [7, "c1", "success", {}, "", "", "yes", 0.0, 0.0]
    fields = [
        kind,
        *(new if used else old for new, used, old in zip(odd, use, usual[1:], strict=True)),
    ]
    if type(fields[3]) is dict:
        fields[3] = {**fields[3], "padding": "." * padding}
    body = msgpack.packb(fields[:length])
    assert _told(body) == _told(body, quick=False)


@given(st.one_of(messages_of([m.Call]), messages_of([m.Outcome])))
def test_the_fast_encoder_agrees_with_the_table(message: m.Message) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(codec, "WRITERS", {})
        by_table = encode(message)
    assert encode(message) == by_table
    assert decode(by_table) == message


def test_only_a_repeated_call_has_the_additional_field() -> None:
    first, again = (m.Call("c1", "track", again=again) for again in (False, True))
    assert encode(again) == b"\x9a" + encode(first)[1:] + b"\xc3" and encode(first)[0] == 0x99
    assert (decode(encode(first)), decode(encode(again))) == (first, again)


def test_only_a_provisional_result_has_the_additional_field() -> None:
    """A peer that does not know the field still reads every final result, byte for byte as
    before."""
    sure, open_ = (
        m.Outcome("c1", "success", seconds=1.0, deferred=deferred) for deferred in (False, True)
    )
    assert encode(open_) == b"\x9a" + encode(sure)[1:] + b"\xc3" and encode(sure)[0] == 0x99
    assert (decode(encode(sure)), decode(encode(open_))) == (sure, open_)
    assert decode(b"\x9a" + encode(sure)[1:] + b"\xc2") == sure, (
        "another implementation may write the field out"
    )
    with pytest.raises(ProtocolError, match="deferred: expected a bool, found a int"):
        decode(b"\x9a" + encode(sure)[1:] + b"\x01")


def _told(body: bytes, quick: bool = True) -> str:
    with pytest.MonkeyPatch.context() as patch:
        if not quick:
            patch.setattr(codec, "READERS", {})
        try:
            return repr(decode(body))
        except ProtocolError as fault:
            return str(fault)


@pytest.mark.parametrize("depth", [1, DEPTH - 1, DEPTH])
def test_nesting_up_to_the_limit_passes(depth: int) -> None:
    call = m.Call("c1", "track", _nested(depth))
    assert decode(encode(call)) == call
    assert plain(call.arguments) == call.arguments


@pytest.mark.parametrize(
    "kind", [m.Accept, m.Cancel, m.Refuse, m.Bye], ids=lambda kind: kind.__name__
)
def test_a_body_above_its_kinds_limit_is_refused_both_ways(kind: type[Any]) -> None:
    long = "x" * LIMITS[kind.KIND]
    message = kind(*(long for _ in range(1 if kind in (m.Accept, m.Bye) else 2)))
    with pytest.raises(ProtocolError, match="too_large"):
        encode(message)
    with pytest.raises(ProtocolError, match="too_large"):
        decode(msgpack.packb([kind.KIND, long]))


@pytest.mark.parametrize("container", [b"\x90", b"\x80"], ids=["arrays", "maps"])
def test_many_empty_containers_do_not_fill_the_memory(container: bytes) -> None:
    count = MAX_CONTAINERS + 1
    head = b"\x94\x04\xa1c\xa1s\x81\xa1a\xdd" + count.to_bytes(4, "big")
    with pytest.raises(ProtocolError, match="arrays and maps"):
        decode(head + container * count)


@pytest.mark.parametrize(
    "value",
    [
        [[]] * 20_000,
        [None] * 140_000,
        [[None] * 70_000, [1] * 70_000],
        {str(n): n for n in range(22_000)},
    ],
    ids=["arrays", "values", "values in two", "a map"],
)
def test_a_value_that_takes_long_to_read_is_neither_sent_nor_accepted(value: Any) -> None:
    """Its sender gets an error, so that only its own call ends; a peer that sends it nevertheless
    loses the connection."""
    with pytest.raises(ProtocolError, match=r"too_large: Call: more than"):
        encode(m.Call("c", "s", {"v": value}))
    with pytest.raises(ProtocolError, match=r"malformed: .*more than"):
        decode(msgpack.packb([4, "c", "s", {"v": value}]))


def test_a_result_may_have_more_values_than_a_call() -> None:
    """The score of a long mission run is one."""
    long = m.Outcome("c", "success", {"v": [1] * 500_000}, "", "", Executed.YES, 0.0, 0.0)
    assert decode(encode(long)) == long
    with pytest.raises(ProtocolError, match=r"too_large: Outcome: more than 524288 values"):
        encode(replace(long, values={"v": [1] * 600_000}))


def test_a_value_of_the_global_memory_fits() -> None:
    """1 MiB of bytes, of text or of floats."""
    for value in (bytes(MIB), "x" * MIB, [1.5] * (MIB // 9)):
        call = m.Call("c", "memory.put", {"name": "a", "value": value})
        assert decode(encode(call)).arguments["value"] == value  # type: ignore[union-attr]


def test_only_plain_data_is_encoded() -> None:
    for value in (object(), {1, 2}, 2**64, np.zeros(2)):
        with pytest.raises(ProtocolError, match="unencodable"):
            encode(m.Call("c1", "track", {"a": value}))


@given(st.data())
def test_plain_data_stays_as_it_is(plain_data: st.SearchStrategy[Any], data: st.DataObject) -> None:
    value = data.draw(plain_data)
    assert plain(value) == value
    body = encode(m.Call("c1", "s", {"v": value}))
    assert decode(body) == m.Call("c1", "s", {"v": plain(value)})


def test_plain_copies_and_simplifies() -> None:
    inner = [1, 2]
    value = {
        "t": (1, (2.0, "x")),
        "e": Executed.NO,
        "f": np.float64(0.5),
        "i": np.int32(3),
        "b": np.bool_(True),
        "l": inner,
    }
    found = plain(value)
    assert found == {"t": [1, [2.0, "x"]], "e": "no", "f": 0.5, "i": 3, "b": True, "l": [1, 2]}
    assert [type(found[name]) for name in "efib"] == [str, float, int, bool]
    inner.append(3)
    assert found["l"] == [1, 2]


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ({"p": np.zeros(3)}, "arguments.p: a ndarray is not plain data; use .tolist()"),
        ({"p": [1, {"q": object()}]}, "arguments.p[1].q: a object is not plain data"),
        ({"p": {1: 2}}, "arguments.p: the key 1 is not a str"),
        (
            {"p": 2**64},
            "arguments.p: the integer 18446744073709551616 does not fit in 64 bits; use a",
        ),
        ({"p": [1, 2.0, -(2**63) - 1]}, "arguments.p[2]: the integer -9223372036854775809 does"),
        ({"p": [[1, 2**64, None]]}, "arguments.p[0][1]: the integer 18446744073709551616 does"),
        ({"p": _nested(DEPTH + 1)}, f"nested deeper than {DEPTH} levels"),
        ({"p": [0.0] * (MOST_VALUES + 1)}, "arguments.p: more than 524,288 items; store them"),
        ({"p": [[1] * (MOST_VALUES + 1)]}, "arguments.p[0]: more than 524,288 items; store them"),
    ],
    ids=lambda value: "" if isinstance(value, dict) else value[:40],
)
def test_plain_names_the_fault_and_its_position(value: Any, says: str) -> None:
    with pytest.raises(NotPlainError) as fault:
        plain(value, "arguments")
    assert says in str(fault.value)


@given(
    st.sampled_from(["u1", "<f8"]),
    st.lists(st.integers(0, 4), max_size=4),
)
def test_decoded_arrays_are_read_only(dtype: str, shape: list[int]) -> None:
    array = np.arange(math.prod(shape), dtype=dtype).reshape(shape)
    found = unpack_array(pack_array(array))
    assert found.dtype == array.dtype and found.shape == array.shape and (found == array).all()
    assert not found.flags.writeable


@given(st.binary(max_size=40))
def test_random_bytes_are_an_array_or_refused(data: bytes) -> None:
    try:
        array = unpack_array(data)
    except NotPlainError:
        return
    assert pack_array(array) == data


@pytest.mark.parametrize(
    "array", [np.zeros(2, np.float32), np.zeros((1, 1, 1, 1, 1)), np.zeros(2, ">f8")]
)
def test_other_arrays_are_refused(array: np.ndarray[Any, Any]) -> None:
    with pytest.raises(NotPlainError):
        pack_array(array)


def test_an_envelope_may_carry_an_image_a_frame_or_a_message() -> None:
    image = np.arange(6, dtype=np.uint8).reshape(2, 3)
    frames = (Frame(1, b"a"), Frame(2, b""))
    call = m.Call("c1", "track", {"a": 1})
    sent = [("image", (image, 0.02)), ("can", frames), ("call", call), ("control", {"rate": 25.0})]
    tick = m.Tick(
        3, tuple(Posted(4, n, Envelope("a", "b", "c", *one)) for n, one in enumerate(sent))
    )
    back = decode(encode(tick))
    assert isinstance(back, m.Tick)
    bodies = [posted.envelope.body for posted in back.envelopes]
    assert (bodies[0][0] == image).all() and bodies[0][1] == 0.02
    assert bodies[1:] == [frames, call, {"rate": 25.0}]
    assert all(type(frame) is Frame for frame in bodies[1])
