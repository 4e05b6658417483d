"""Packets of the servos' bus compared with the vendor's SDK, and the handling of noise."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, strategies as st

from petrobot.services.adapters.so101 import bus

data = st.binary(min_size=1, max_size=8)
servo = st.integers(0, 252)


class Recorder:
    """A port of the SDK that records what is written."""

    is_using = False

    def __init__(self) -> None:
        self.sent = b""

    def clearPort(self) -> None:  # noqa: N802 - the SDK's name
        """Nothing waits."""

    def setPacketTimeout(self, size: int) -> None:  # noqa: N802
        """It does not wait."""

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        self.sent += bytes(packet)
        return len(packet)


@given(servo, st.integers(0, 80), data)
def test_packets_are_those_of_the_vendors_sdk(number: int, address: int, content: bytes) -> None:
    sdk: Any = pytest.importorskip("scservo_sdk")
    packets, size = sdk.PacketHandler(0), len(content)

    def sent(call: str, *values: Any) -> bytes:
        port = Recorder()
        getattr(packets, call)(port, *values)
        return port.sent

    several = [number, (number + 1) % 253]
    asked = sent("syncReadTx", address, size, several, 2)
    assert bus.sync_read(address, size, several) == asked
    both = b"".join(bytes((one,)) + content for one in several)
    told = sent("syncWriteTxOnly", address, size, list(both), len(both))
    assert bus.sync_write(address, dict.fromkeys(several, content)) == told


@given(st.integers(-32767, 32767))
def test_a_sign_is_a_bit_as_in_the_vendors_sdk(value: int) -> None:
    sdk: Any = pytest.importorskip("scservo_sdk")
    register = int.from_bytes(bus.word(value), "little")
    assert register == sdk.SCS_TOSCS(value, 15) and bus.number(register) == value
    assert sdk.SCS_TOHOST(register, 15) == value


def test_a_number_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="40000 does not fit"):
        bus.word(40000)


answers = st.tuples(servo, st.integers(0, 127), st.binary(max_size=bus.LONGEST - 2))


def frame(servo: int, error: int, content: bytes) -> bytes:
    return bus.packet(servo, error, content)


@given(st.lists(answers, max_size=6), st.integers(1, 7))
def test_answers_are_found_however_they_are_cut(parts: list[Any], size: int) -> None:
    stream, splitter = b"".join(frame(*part) for part in parts), bus.PacketSplitter()
    pieces = [stream[at : at + size] for at in range(0, len(stream), size)]
    assert [answer for piece in pieces for answer in splitter.feed(piece)] == parts


@given(st.binary(max_size=40), answers)
def test_noise_does_not_lose_later_answers(noise: bytes, answer: Any) -> None:
    splitter = bus.PacketSplitter()
    splitter.feed(noise)
    # bytes that look like the beginning of an answer delay at most one answer of the greatest
    # length
    found = splitter.feed(frame(*answer) * (2 + (bus.LONGEST + 4) // len(frame(*answer))))
    assert bus.ServoAnswer(*answer) in found


@pytest.mark.parametrize(
    "spoilt",
    [
        frame(1, 0, b"abc")[:-2],  # truncated
        frame(1, 0, b"abc")[:-1] + b"\0",  # wrong checksum
        bus.read_state([1, 2, 3]),  # an echo of what was sent
        frame(0xFD, 0, b"")[1:],
        b"\xff" * 9,
    ],
)
def test_a_damaged_answer_does_not_hide_others(spoilt: bytes) -> None:
    found = bus.PacketSplitter().feed(spoilt + frame(2, 0, b"xy") + frame(3, 4, b""))
    assert found[-2:] == [(2, 0, b"xy"), (3, 4, b"")] and 1 not in {a.servo for a in found}


def test_an_answer_to_another_request_is_not_a_state() -> None:
    assert bus.reading(b"\0" * 33) is None and bus.reading(b"\0" * 34) is not None
