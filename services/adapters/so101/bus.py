"""The bus of Feetech's STS3215 servos, sans-I/O: packets to servos, and their answers.

A packet is FF FF, servo, length, instruction, content, checksum; an answer has the servo's error
bits instead of the instruction. Numbers are little endian; a sign is a bit above the magnitude (STS
memory table of Feetech).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

SYNC_READ, SYNC_WRITE = 0x82, 0x83
BROADCAST: Final = 0xFE
MODE, TORQUE, GOAL = 33, 40, 42
"""Registers: operating mode (0: position), torque enable (the first that `setup` writes), and goal
position."""
STEPS: Final = 4096
RAD: Final = 2 * math.pi / STEPS
"""One step of a servo (rad)."""
LONGEST: Final = 64
"""Largest length byte of an answer: a longer one is noise."""
ERRORS: Final = {1: "voltage", 2: "sensor", 4: "heat", 8: "current", 32: "overload"}
"""Error bits of an answer."""
_STATE: Final = struct.Struct("<B6x Bx H 4x H 6x HHH BBx BB")
"""Registers 33 to 66: mode, torque enable, goal, torque limit, position, speed, load, voltage,
temperature, status, moving."""


def number(word: int, bit: int = 15) -> int:
    """Return the number of a register whose sign is in `bit`."""
    magnitude = word & (1 << bit) - 1
    return -magnitude if word >> bit & 1 else magnitude


def word(value: int, bit: int = 15) -> bytes:
    """Return the register of a number whose sign is in `bit`. Raises ValueError if it does not
    fit."""
    if abs(value) >> bit:
        raise ValueError(f"{value} does not fit {bit} bits and a sign")
    return (abs(value) | (value < 0) << bit).to_bytes(2, "little")


def packet(servo: int, instruction: int, content: bytes = b"") -> bytes:
    """Return an instruction packet."""
    body = bytes((servo, len(content) + 2, instruction)) + content
    return b"\xff\xff" + body + bytes((~sum(body) & 0xFF,))


def sync_read(address: int, size: int, servos: Iterable[int]) -> bytes:
    """Ask servos for the same registers; they answer in this order."""
    return packet(BROADCAST, SYNC_READ, bytes((address, size, *servos)))


def sync_write(address: int, data: Mapping[int, bytes]) -> bytes:
    """Write the same registers of several servos; none answers. All data have the same size. No
    servos: no bytes."""
    if not data:
        return b""
    size = len(next(iter(data.values())))
    content = b"".join(bytes((servo,)) + part for servo, part in data.items())
    return packet(BROADCAST, SYNC_WRITE, bytes((address, size)) + content)


def setup(goal: int, speed: int, limit: int) -> bytes:
    """Return the registers 40 to 49 that switch torque on at a goal (steps): no acceleration ramp,
    greatest speed (steps/s), greatest torque (0.1 %)."""
    return b"\1\0" + word(goal) + word(0) + word(speed) + word(limit)


class ServoAnswer(NamedTuple):
    """A status packet."""

    servo: int
    error: int
    data: bytes


class Reading(NamedTuple):
    """The report of a servo, in its own units."""

    mode: int
    """0: it goes to positions; in the others the same registers mean something else."""
    torque: bool
    goal: int
    """steps"""
    position: int
    """steps"""
    speed: int
    """steps/s"""
    load: float
    """Duty cycle of its motor, -1 to 1."""
    voltage: float
    """V"""
    temperature: int
    """deg C"""


def read_state(servos: Iterable[int]) -> bytes:
    """Return the request for the registers that `reading` reads."""
    return sync_read(MODE, _STATE.size, servos)


def reading(data: bytes) -> Reading | None:
    """Read the data of an answer to `read_state`; None if it answers something else (an adapter
    may return what it sends)."""
    if len(data) != _STATE.size:
        return None
    mode, torque, goal, _, position, speed, load, voltage, temperature, _, _ = _STATE.unpack(data)
    wanted, at, rate = number(goal), number(position), number(speed)
    share, volts = number(load, 10) / 1000, voltage / 10
    return Reading(mode, torque == 1, wanted, at, rate, share, volts, temperature)


class PacketSplitter:
    """Cuts the bytes of a line into answers; skips noise and broken packets."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[ServoAnswer]:
        """Add bytes; return the answers that they complete."""
        buffer, answers = self._buffer, list[ServoAnswer]()
        buffer += data
        at = 0
        while (at := buffer.find(b"\xff\xff", at)) >= 0 and len(buffer) - at >= 4:
            servo, length = buffer[at + 2], buffer[at + 3]
            end = at + 4 + length
            if servo >= BROADCAST or not 2 <= length <= LONGEST:
                at += 1
            elif len(buffer) < end:
                break  # the rest may still come
            elif sum(buffer[at + 2 : end]) & 0xFF != 0xFF:
                at += 1  # broken: its bytes may contain the beginning of another
            else:
                answers.append(ServoAnswer(servo, buffer[at + 4], bytes(buffer[at + 5 : end - 1])))
                at = end
        del buffer[: at if at >= 0 else max(0, len(buffer) - 1)]
        return answers
