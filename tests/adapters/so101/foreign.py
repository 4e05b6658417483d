"""Bus servos on a pseudo terminal, from Feetech's published protocol and memory table alone, with
the ways in which real buses go wrong. Knows nothing of petrobot."""

from __future__ import annotations

import os
import tty
from collections.abc import Callable

STEPS_PER_SECOND = 3000.0


class Servo:
    """A position servo that reaches its goal at a constant speed; in mode 1 it is a wheel."""

    def __init__(self) -> None:
        self.table = bytearray(87)
        self.at = 2048.0
        self.error = 0
        """Error byte of its status packets."""
        self.put(42, 2048)
        self.put(48, 1000)
        self.table[62], self.table[63] = 74, 30  # 0.1 V, deg C

    def put(self, address: int, value: int) -> None:
        """Write a register of two bytes; the sign is bit 15."""
        raw = abs(value) | (value < 0) << 15
        self.table[address : address + 2] = raw.to_bytes(2, "little")

    def get(self, address: int) -> int:
        """Read a register of two bytes whose sign is bit 15."""
        raw = int.from_bytes(self.table[address : address + 2], "little")
        return -(raw & 0x7FFF) if raw & 0x8000 else raw

    def advance(self, dt: float) -> None:
        """Move for so long."""
        before = self.at
        if self.table[40] == 1 and self.table[33] == 1:  # wheel: it turns at its goal speed
            self.at += self.get(46) * dt
        elif self.table[40] == 1 and self.table[33] == 0:
            most = min(STEPS_PER_SECOND, self.get(46) or STEPS_PER_SECOND) * dt
            self.at += min(most, max(-most, self.get(42) - self.at))
        self.put(56, round(self.at) % 4096)
        self.put(58, round((self.at - before) / dt))
        self.table[66] = self.at != before


class Bus:
    """Six servos behind a pseudo terminal; `path` is its name. `step(now)` is called often."""

    def __init__(self) -> None:
        self.servos = {number: Servo() for number in range(1, 7)}
        self.missing: set[int] = set()
        self.echoes, self.delay = False, 0.0
        self.spoil: Callable[[bytes], bytes] = lambda packet: packet
        self._end, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._end, False)
        self.path, self._buffer = os.ttyname(self._far), b""
        self._waiting: list[tuple[float, bytes]] = []
        self.now = 0.0

    def close(self) -> None:
        """Release the terminal."""
        os.close(self._end)
        os.close(self._far)

    def step(self, now: float) -> None:
        """Let the servos move until `now`, and answer what has come."""
        if now > self.now:
            for servo in self.servos.values():
                servo.advance(now - self.now)
        self.now = now
        try:
            data = os.read(self._end, 65536)
        except BlockingIOError:
            data = b""
        if self.echoes and data:
            self._waiting.append((now, data))
        self._buffer += data
        while (packet := self._packet()) is not None:
            answer = self._obey(packet[0], packet[2], packet[3:-1])
            self._waiting.append((now + self.delay, answer))
        for due, answer in self._waiting:
            if due <= now:
                os.write(self._end, answer)
        self._waiting = [pair for pair in self._waiting if pair[0] > now]

    def _packet(self) -> bytes | None:
        """Remove the next good packet: id, length, instruction, parameters, checksum."""
        while (at := self._buffer.find(b"\xff\xff")) >= 0 and len(self._buffer) >= at + 4:
            end = at + 4 + self._buffer[at + 3]
            if len(self._buffer) < end:
                return None
            packet, self._buffer = self._buffer[at + 2 : end], self._buffer[end:]
            if sum(packet) & 0xFF == 0xFF:
                return packet
        return None

    def _obey(self, servo: int, instruction: int, given: bytes) -> bytes:
        if instruction == 0x83:
            address, size = given[0], given[1]
            rows = given[2:]
            for at in range(0, len(rows), size + 1):
                self._write(rows[at], address, rows[at + 1 : at + 1 + size])
            return b""
        if instruction == 0x82:
            return b"".join(self._read(number, *given[:2]) for number in given[2:])
        if instruction == 3:
            self._write(servo, given[0], given[1:])
            return self._answer(servo, b"")
        return self._read(servo, *given) if instruction == 2 else self._answer(servo, b"")

    def _write(self, number: int, address: int, data: bytes) -> None:
        if number not in self.missing:
            self.servos[number].table[address : address + len(data)] = data

    def _read(self, number: int, address: int, size: int) -> bytes:
        if number in self.missing:
            return b""
        return self._answer(number, bytes(self.servos[number].table[address : address + size]))

    def _answer(self, number: int, data: bytes) -> bytes:
        body = bytes((number, len(data) + 2, self.servos[number].error)) + data
        return self.spoil(b"\xff\xff" + body + bytes((~sum(body) & 0xFF,)))
