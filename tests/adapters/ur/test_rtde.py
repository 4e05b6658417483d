"""The RTDE client: bytes in any pieces, refused packages, and pauses."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given, strategies as st

from petrobot.services.adapters.ur.rtde import Recipe, Rtde, RtdeError, package
from petrobot.sim.bus.ur_controller import RTDE_PORT, UrController

OUT = {"timestamp": "DOUBLE", "actual_q": "VECTOR6D", "safety_mode": "INT32"}
IN = ({"input_int_register_24": "INT32", "input_double_register_24": "DOUBLE"},)


def recorded() -> bytes:
    """All bytes that a controller sends to a client from its first package on."""
    controller, client, heard = UrController(), Rtde(OUT, IN), b""
    session = controller.connect(RTDE_PORT)
    for tick in range(20):
        session.receive(client.drain())
        controller.advance(tick * 0.008)
        data = session.drain()
        heard += data
        client.receive(data)
    assert client.running and client.count > 10
    return heard


HEARD = recorded()


@given(st.lists(st.integers(0, len(HEARD)), max_size=30))
def test_it_reads_the_same_from_any_pieces(cuts: list[int]) -> None:
    whole, pieces = Rtde(OUT, IN), Rtde(OUT, IN)
    whole.receive(HEARD)
    for begin, end in zip([0, *sorted(cuts)], [*sorted(cuts), len(HEARD)], strict=True):
        pieces.receive(HEARD[begin:end])
    assert (pieces.data, pieces.count, pieces.drain()) == (whole.data, whole.count, whole.drain())


def test_it_reads_the_same_from_single_bytes() -> None:
    whole, single = Rtde(OUT, IN), Rtde(OUT, IN)
    whole.receive(HEARD)
    for value in HEARD:
        single.receive(bytes((value,)))
    assert (single.data, single.count) == (whole.data, whole.count)


ACCEPTED = package("V", b"\x01") + package("O", b"\x01DOUBLE,VECTOR6D,INT32,")


@pytest.mark.parametrize(
    ("heard", "says"),
    [
        (package("V", b"\x00"), "refuses RTDE protocol 2"),
        (
            package("V", b"\x01") + package("O", b"\x00DOUBLE,NOT_FOUND,INT32"),
            "does not give actual_q as VECTOR6D (NOT_FOUND)",
        ),
        (  # one number would be read where six are needed
            package("V", b"\x01") + package("O", b"\x01DOUBLE,DOUBLE,INT32"),
            "does not give actual_q as VECTOR6D (DOUBLE)",
        ),
        (
            ACCEPTED + package("I", b"\x01VECTOR3D,DOUBLE"),
            "does not give input_int_register_24 as INT32 (VECTOR3D)",
        ),
        (package("V", b"\x01") + package("O", b"\x01DOUBLE"), "does not give all fields"),
        (
            ACCEPTED + package("I", b"\x00IN_USE,DOUBLE"),
            "a fieldbus writes input_int_register_24",
        ),
        (ACCEPTED + package("I", b"\x01INT32,DOUBLE") + package("S", b"\x00"), "refuses to start"),
        (ACCEPTED + package("U", b"\x01abc"), "expected 60 bytes of data, got 3"),
        (
            ACCEPTED + package("U", b"\x01" + struct.pack(">7di", 1.0, *[float("nan")] * 6, 1)),
            "actual_q is (nan, nan",
        ),
        (package("V", b"\x01") + package("O", b""), "cannot be read"),
        (b"HTTP/1.1 400 Bad Request", "expected an RTDE package, got the bytes b'HTTP/1.1'"),
        (b"\x00\x02V", "expected an RTDE package"),
    ],
)
def test_what_it_refuses(heard: bytes, says: str) -> None:
    client = Rtde(OUT, IN)
    with pytest.raises(RtdeError) as fault:
        client.receive(heard)
    assert says in str(fault.value)


def test_nothing_is_sent_before_the_start_nor_while_it_is_paused() -> None:
    client = Rtde(OUT, IN)
    values = {"input_int_register_24": 7, "input_double_register_24": 0.5}
    client.receive(ACCEPTED + package("I", b"\x05INT32,DOUBLE,"))
    client.drain()
    client.send(0, values)
    assert client.drain() == b""
    client.receive(package("S", b"\x01"))
    client.send(0, values)
    assert client.drain() == package("U", b"\x05" + struct.pack(">id", 7, 0.5))
    client.receive(package("P", b"\x01"))
    client.send(0, values)
    assert client.drain() == b"" and not client.running


def test_data_of_another_recipe_and_texts_are_ignored() -> None:
    client = Rtde(OUT, IN)
    client.receive(ACCEPTED + package("U", b"\x02abc") + package("M", b"\x02hi\x00\x01"))
    assert client.count == 0 and client.data == {}


@given(st.binary(max_size=60))
def test_no_bytes_break_it_otherwise(data: bytes) -> None:
    client = Rtde(OUT, IN)
    try:
        client.receive(ACCEPTED + data)
    except RtdeError:
        return
    assert client.count == 0


@pytest.mark.parametrize("types", [["FLOAT"], [], ["DOUBLE", "DOUBLE"]])
def test_a_recipe_that_does_not_fit(types: list[str]) -> None:
    with pytest.raises(RtdeError):
        Recipe({"timestamp": "DOUBLE"}, types)
