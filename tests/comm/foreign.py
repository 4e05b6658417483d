"""A client of the node protocol written from docs/protocol.md alone: sockets and the standard
library, without any code of petrobot.

It has its own msgpack, too, as far as needed
(https://github.com/msgpack/msgpack/blob/master/spec.md).
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import secrets
import socket
import struct
import time
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

from tests.waiting import Limit

(
    HELLO,
    WELCOME,
    REFUSE,
    CALL,
    ACCEPT,
    FEEDBACK,
    RESULT,
    RESULT_ACK,
    CANCEL,
    EVENT,
    EVENT_ACK,
    SUBSCRIBE,
) = range(1, 13)
COMMAND, ANSWER, PING, PONG, TICK, BYE, CHALLENGE, PROOF, STREAM_OPEN, SET_POINT, WITHDRAW = range(
    13, 24
)
LIMIT = 60.0
"""Longest wait for anything (s)."""


def pack(value: Any) -> bytes:
    """Encode plain data as msgpack."""
    if value is None or isinstance(value, bool):
        return {None: b"\xc0", False: b"\xc2", True: b"\xc3"}[value]
    if isinstance(value, float):
        return b"\xcb" + struct.pack(">d", value)
    if isinstance(value, int):
        return bytes([value]) if 0 <= value < 128 else b"\xcf" + struct.pack(">Q", value)
    if isinstance(value, str):
        text = value.encode()
        return (
            bytes([0xA0 | len(text)]) if len(text) < 32 else b"\xdb" + struct.pack(">I", len(text))
        ) + text
    if isinstance(value, bytes):
        return b"\xc6" + struct.pack(">I", len(value)) + value
    if isinstance(value, Mapping):
        pairs = b"".join(pack(key) + pack(item) for key, item in value.items())
        return (
            bytes([0x80 | len(value)])
            if len(value) < 16
            else b"\xdf" + struct.pack(">I", len(value))
        ) + pairs
    items = b"".join(pack(item) for item in value)
    return (
        bytes([0x90 | len(value)]) if len(value) < 16 else b"\xdd" + struct.pack(">I", len(value))
    ) + items


_NUMBERS = {
    0xCA: ">f", 0xCB: ">d", 0xCC: ">B", 0xCD: ">H", 0xCE: ">I", 0xCF: ">Q",
    0xD0: ">b", 0xD1: ">h", 0xD2: ">i", 0xD3: ">q",
}  # fmt: skip
_SIZED = {
    0xC4: (1, "bin"),
    0xC5: (2, "bin"),
    0xC6: (4, "bin"),
    0xD9: (1, "str"),
    0xDA: (2, "str"),
    0xDB: (4, "str"),
}
_SIZED |= {0xDC: (2, "array"), 0xDD: (4, "array"), 0xDE: (2, "map"), 0xDF: (4, "map")}


class Unpacking:
    """Decode msgpack."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def _bytes(self, size: int) -> bytes:
        self.at += size
        assert self.at <= len(self.data), "the body is cut off"
        return self.data[self.at - size : self.at]

    def value(self) -> Any:
        """Return the next value."""
        head = self._bytes(1)[0]
        if head < 0x80 or head >= 0xE0:
            return head if head < 0x80 else head - 256
        if head < 0xC0:
            kind, size = (
                ("map", head & 15)
                if head < 0x90
                else ("array", head & 15)
                if head < 0xA0
                else ("str", head & 31)
            )
            return self._sized(kind, size)
        if head in (0xC0, 0xC2, 0xC3):
            return {0xC0: None, 0xC2: False, 0xC3: True}[head]
        if head in _NUMBERS:
            return struct.unpack(_NUMBERS[head], self._bytes(struct.calcsize(_NUMBERS[head])))[0]
        width, kind = _SIZED[head]
        return self._sized(kind, int.from_bytes(self._bytes(width), "big"))

    def _sized(self, kind: str, size: int) -> Any:
        if kind == "str":
            return self._bytes(size).decode()
        if kind == "bin":
            return self._bytes(size)
        if kind == "array":
            return [self.value() for _ in range(size)]
        return {self.value(): self.value() for _ in range(size)}


def unpack(body: bytes) -> list[Any]:
    """Decode a whole body: a fixarray whose first element is a positive fixint."""
    assert 0x91 <= body[0] <= 0x9F and body[1] < 0x80, body[:2].hex()
    reading = Unpacking(body)
    found = reading.value()
    assert reading.at == len(body), "bytes follow the message"
    assert isinstance(found, list)
    return found


class Foreign:
    """One connection. `key` is the shared key of 32 bytes."""

    def __init__(self, address: tuple[str, int], key: bytes | None = None) -> None:
        self.socket = socket.create_connection(address, LIMIT)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.key = key
        self.seal_out = self.seal_in = b""
        self.sent = self.heard = 0
        """Number of frames sealed in each direction."""
        self.is_open = False
        self.proven = False
        """Whether the refusal of the handshake was sealed."""
        self.skipped: list[list[Any]] = []
        """Messages that arrived while it waited for another one."""

    # --- frames

    def frame(self, body: bytes) -> bytes:
        """Frame a body: its length, and on an open connection its seal or check."""
        if not self.is_open:
            return struct.pack(">I", len(body)) + body
        if self.seal_out:
            end = hmac.digest(self.seal_out, struct.pack(">Q", self.sent) + body, "sha256")[:16]
            self.sent += 1
        else:
            end = struct.pack(">I", zlib.crc32(body))
        return struct.pack(">I", len(body) + len(end)) + body + end

    def say(self, *message: Any) -> None:
        """Send a message: kind and fields."""
        self.raw(self.frame(pack(message)))

    def raw(self, data: bytes) -> None:
        """Send bytes as they are."""
        self.socket.sendall(data)

    def _exactly(self, size: int) -> bytes:
        data, limit = b"", Limit(f"{size} bytes of the node")
        while len(data) < size and limit.left():
            more = self.socket.recv(size - len(data))
            if not more:
                raise ConnectionError("the node hung up")
            data += more
        return data

    def body(self) -> bytes:
        """Return the next frame's body after checking its seal or check."""
        body = self._exactly(int.from_bytes(self._exactly(4), "big"))
        if not self.is_open:
            return body
        if not self.seal_in:
            body, end = body[:-4], body[-4:]
            assert end == struct.pack(">I", zlib.crc32(body))
        else:
            body, seal = body[:-16], body[-16:]
            assert (
                seal
                == hmac.digest(self.seal_in, struct.pack(">Q", self.heard) + body, "sha256")[:16]
            )
            self.heard += 1
        return body

    def hear(self) -> list[Any]:
        """Return the next message that is not a heartbeat; answer a PING as the page says.

        Raises TimeoutError."""
        until = time.monotonic() + LIMIT
        while time.monotonic() < until:
            message = unpack(self.body())
            if message[0] == PING:
                with contextlib.suppress(
                    ConnectionError
                ):  # The node may have closed the connection; its REFUSE follows.
                    self.say(PONG, message[1])
            elif message[0] != PONG:
                return message
        raise TimeoutError(f"nothing but heartbeats for {LIMIT} s; before came {self.skipped[-5:]}")

    def expect(self, kind: int, *start: Any) -> list[Any]:
        """Return the next message of a kind whose fields begin so. Raises TimeoutError."""
        until = time.monotonic() + LIMIT
        while True:
            for message in self.skipped:
                if message[0] == kind and message[1 : 1 + len(start)] == list(start):
                    self.skipped.remove(message)
                    return message
            if time.monotonic() > until:
                raise TimeoutError(f"no {kind} {start} came, but {self.skipped[-5:]}")
            self.skipped.append(self.hear())

    # --- the opening

    def open(
        self,
        role: str,
        name: str,
        boot: str = "f1",
        epoch: int = 0,
        directory: str = "",
        versions: Sequence[int] = (2, 2),
        node: str = "hub",
    ) -> list[Any]:
        """Shake hands from HELLO to WELCOME; return WELCOME, or the REFUSE that came in its
        place."""
        check = secrets.token_bytes(32) if self.key is not None else bytes(4)
        auth = bytes([len(check)]) + node.encode() + check
        hello = pack([HELLO, *versions, role, name, boot, epoch, directory, auth])
        if self.key is None:
            hello = hello[:-4] + struct.pack(">I", zlib.crc32(hello[:-4]))
        self.raw(self.frame(hello))
        body = self.body()
        if body[1] == REFUSE:
            return unpack(body)
        if self.key is None and body[1] == WELCOME:
            message = unpack(body)
            assert message[7] == struct.pack(">I", zlib.crc32(hello + body[:-4])), (
                "HELLO or WELCOME was changed"
            )
            assert message[2] == node
            self.is_open = True
            return message
        assert body[1] == CHALLENGE and len(unpack(body)[1]) == 32
        transcript = hello + body
        self.say(PROOF, self._hmac(b"client\0" + transcript))
        body = self.body()
        if body[1] == WELCOME:
            message = unpack(body)
            assert message[7] == self._hmac(b"server\0" + transcript + body[:-32]), (
                "the node does not know the key"
            )
            assert message[2] == node
            self.seal_out = self._hmac(b"client to server\0" + transcript)
            self.seal_in = self._hmac(b"server to client\0" + transcript)
            self.is_open = True
            return message
        seal = hmac.digest(
            self._hmac(b"server to client\0" + transcript), bytes(8) + body[:-16], "sha256"
        )[:16]
        self.proven = body.endswith(seal)
        return unpack(body[:-16] if self.proven else body)

    def _hmac(self, data: bytes) -> bytes:
        assert self.key is not None
        return hmac.new(self.key, data, hashlib.sha256).digest()

    def close(self) -> None:
        """Close the connection without a message."""
        self.socket.close()
