"""A UR controller behind three TCP ports, from the vendor's RTDE and dashboard guides alone, with
the ways in which it goes wrong. Knows nothing of petrobot."""

from __future__ import annotations

import contextlib
import socket
import struct

FORMS = {"DOUBLE": "d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I", "UINT64": "Q", "UINT8": "B"}
TYPES = {
    "actual_q": "VECTOR6D", "actual_qd": "VECTOR6D", "robot_mode": "INT32",
    "safety_mode": "INT32", "actual_digital_input_bits": "UINT64",
    "actual_digital_output_bits": "UINT64", "output_int_register_24": "INT32",
    "standard_digital_output_mask": "UINT8", "standard_digital_output": "UINT8",
    "input_int_register_24": "INT32", "input_int_register_25": "INT32",
    **{f"input_double_register_{n}": "DOUBLE" for n in range(24, 30)},
}  # fmt: skip


class Controller:
    """Its arm follows the set points in the input registers, as long as their counter changes."""

    def __init__(self) -> None:
        self.listeners = [socket.create_server(("127.0.0.1", 0)) for _ in range(3)]
        for each in self.listeners:
            each.setblocking(False)
        self.ports = [int(each.getsockname()[1]) for each in self.listeners]
        self.lines: list[tuple[int, socket.socket]] = []
        self.version_accepted, self.period, self.deaf = True, 0.008, False
        self.mode, self.safety, self.program = 3, 1, False
        self.q, self.qd = [0.0, -1.57, 1.57, -1.57, -1.57, 0.0], [0.0] * 6
        self.inputs: dict[str, float] = dict.fromkeys(TYPES, 0)
        self.recipes: list[list[str]] = []
        self.outputs: list[str] = []
        self.running = False
        self.buffer, self.now, self.sent, self.seen = b"", 0.0, 0.0, (0.0, 0.0)

    def close(self) -> None:
        """End everything."""
        self.cut()
        for each in self.listeners:
            each.close()

    def cut(self) -> None:
        """Drop all connections."""
        for _, line in self.lines:
            line.close()
        self.lines, self.running, self.buffer = [], False, b""

    def step(self, now: float) -> None:
        """Accept, receive, move and send."""
        dt, self.now = now - self.now, now
        for number, listener in enumerate(self.listeners):
            with contextlib.suppress(BlockingIOError):
                line, _ = listener.accept()
                line.setblocking(False)
                if self.deaf:
                    line.close()
                    continue
                for old in [pair for pair in self.lines if pair[0] == number]:
                    self._drop(*old)
                self.lines.append((number, line))
                if number == 0:
                    self.recipes, self.outputs, self.running, self.buffer = [], [], False, b""
        for number, line in list(self.lines):
            try:
                data = line.recv(65536)
            except BlockingIOError:
                continue
            except OSError:
                data = b""
            if not data:
                self._drop(number, line)
            elif number == 0:
                self.buffer += data
            elif number == 1:
                self._dashboard(data)
            else:
                self.program = self.mode == 7 and self.safety in (1, 2)
        while (package := self._package()) is not None:
            self._rtde(chr(package[2]), package[3:])
        self._move(dt)
        if self.running and now - self.sent >= self.period - 1e-9:
            self.sent = now
            self._send("U", b"\x01" + b"".join(map(self._value, self.outputs)))

    def _package(self) -> bytes | None:
        """Remove the next whole package: its size (uint16), its type, its payload."""
        size = int.from_bytes(self.buffer[:2], "big")
        if len(self.buffer) < max(3, size):
            return None
        package, self.buffer = self.buffer[:size], self.buffer[size:]
        return package

    def _drop(self, number: int, line: socket.socket) -> None:
        line.close()
        self.lines.remove((number, line))

    def _dashboard(self, text: bytes) -> None:
        if b"unlock protective stop" in text and self.safety == 3:
            self.safety = 1
        if b"power on" in text:
            self.mode = 5
        if b"brake release" in text:
            self.mode = 7

    def _move(self, dt: float) -> None:
        """Follow as the program does: stop if the counter has not changed for 0.1 s."""
        if self.inputs["input_int_register_24"] != self.seen[0]:
            self.seen = self.inputs["input_int_register_24"], self.now
        may = self.program and self.mode == 7 and self.safety in (1, 2)
        self.program = may
        before = list(self.q)
        if may and self.inputs["input_int_register_25"] == 1 and self.now - self.seen[1] < 0.1:
            self.q = [self.inputs[f"input_double_register_{n}"] for n in range(24, 30)]
        self.qd = [(a - b) / dt if dt else 0.0 for a, b in zip(self.q, before, strict=True)]
        if self.program:
            self.inputs["output_int_register_24"] = self.inputs["input_int_register_24"]

    def _rtde(self, kind: str, payload: bytes) -> None:
        if kind == "V":
            self._send("V", bytes((self.version_accepted,)))
        elif kind == "O":
            self.outputs = payload[8:].decode().split(",")
            self._send("O", b"\x01" + ",".join(TYPES[n] for n in self.outputs).encode())
        elif kind == "I":
            self.recipes.append(payload.decode().split(","))
            types = ",".join(TYPES[name] for name in self.recipes[-1])
            self._send("I", bytes((len(self.recipes),)) + types.encode())
        elif kind in "SP":
            self.running = kind == "S"
            self._send(kind, b"\x01")
        elif kind == "U":
            names = self.recipes[payload[0] - 1]
            form = ">" + "".join(FORMS[TYPES[name]] for name in names)
            self.inputs.update(zip(names, struct.unpack(form, payload[1:]), strict=True))

    def _value(self, name: str) -> bytes:
        known: dict[str, list[float]] = {"actual_q": self.q, "actual_qd": self.qd}
        known |= {"robot_mode": [self.mode], "safety_mode": [self.safety]}
        values = known.get(name) or [int(self.inputs[name])]
        return struct.pack(">" + FORMS[TYPES[name]], *values)

    def _send(self, kind: str, payload: bytes) -> None:
        for number, line in self.lines:
            if number == 0:
                with contextlib.suppress(OSError):
                    line.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)

    def say(self, text: bytes) -> None:
        """Send a text message (version 2 of the protocol)."""
        self._send("M", bytes((len(text),)) + text + b"\x04RTDE\x01")
