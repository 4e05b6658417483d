"""One connection of the node protocol as a machine: bytes in, messages out, and the other way round.

A frame is a u32 length (big endian), a body (`codec.py`) and, on a connection with a key, a seal of 16 bytes that the
length counts. No socket, clock or randomness of its own: the shell passes bytes and the nonce. Nothing but ProtocolError
leaves it.

    opening  client: HELLO ->                       server: <- WELCOME or REFUSE
    with a key:      HELLO ->  <- CHALLENGE  PROOF ->        <- WELCOME or REFUSE
    open     everything else, sealed if there is a key
    closing  BYE or REFUSE was sent: nothing more goes out, what comes in is dropped
    closed   BYE or REFUSE came, or the other side broke the protocol
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

from services.comm.codec import (
    LIMITS,
    UNCOUNTED,
    ProtocolError,
    decode,
    decode_by_table,
    encode,
    encode_all,
    kind_of,
    no_extension,
    unpack,
)
from services.comm.frequent import NAME_LENGTH, READERS
from services.comm.messages import Challenge, Hello, Message, Proof, Refuse, Welcome
from services.comm.security import NONCE_BYTES, PROOF_BYTES, SEAL_BYTES, Seal, proof, same
from services.comm.turns import LAST, MAY_COME, MAY_GO, NOTHING, OVER, STATES, Phase, Side, State

__all__ = ["NEWEST_VERSION", "OLDEST_VERSION", "Connection", "ProtocolError", "Side", "State", "negotiate"]

OLDEST_VERSION: Final = 1
NEWEST_VERSION: Final = 1
"""Versions of the protocol that this code speaks."""

_HEADER: Final = 4
_HEAD: Final = struct.Struct(">IBB")
"""Length, then the first two bytes of the body: its array and the kind."""
_head_at: Final = _HEAD.unpack_from
_LARGE: Final = 4096
_NO_QUICK: Mapping[int, int] = {}


def negotiate(oldest: int, newest: int) -> int | None:
    """The newest version that this code and a peer with the range [oldest, newest] both speak; None if there is none."""
    version = min(newest, NEWEST_VERSION)
    return version if version >= max(oldest, OLDEST_VERSION) and oldest <= newest else None


class Connection:
    """One end of a connection. `nonce` (32 fresh random bytes) is needed with a `key`.

    A server sees HELLO only after its sender has proved the key, and then sends WELCOME or REFUSE.
    """

    def __init__(self, side: Side, *, key: bytes | None = None, nonce: bytes = b"") -> None:
        if key is not None and len(nonce) != NONCE_BYTES:
            raise ValueError(f"a connection with a key needs a nonce of {NONCE_BYTES} bytes")
        self.side = side
        self.version = 0
        """Version agreed on; 0 before WELCOME."""
        self._key = key
        self._nonce = nonce
        self._phase = Phase.HELLO
        self._parts: list[bytes] = []
        self._have = 0
        self._need = 0
        self._out = bytearray()
        self._hello: Hello | None = None
        self._transcript = b""
        self._seal_in: Seal | None = None
        self._seal_out: Seal | None = None
        self._seal_bytes = 0
        self._may_come = MAY_COME.get((side, self._phase), NOTHING)
        self._may_go = MAY_GO.get((side, self._phase), NOTHING)
        self._quick_in: Mapping[int, int] = _NO_QUICK
        """While the connection is open: the kinds that may come and end nothing, with the longest frame of each (bytes),"""
        self._quick_out = NOTHING
        """and those that may go so."""

    @property
    def state(self) -> State:
        """opening, open, closing or closed."""
        return STATES.get(self._phase, State.OPENING)

    def _enter(self, phase: Phase) -> None:
        self._phase = phase
        self._may_come = MAY_COME.get((self.side, phase), NOTHING)
        self._may_go = MAY_GO.get((self.side, phase), NOTHING)
        if phase is Phase.OPEN:
            self._quick_in = {kind: LIMITS[kind] + self._seal_bytes for kind in self._may_come - LAST}
            self._quick_out = self._may_go - LAST
        else:
            self._quick_in, self._quick_out = _NO_QUICK, NOTHING

    def data_to_send(self) -> bytes:
        """Bytes that the handshake itself has to send; ask after each `receive_data`."""
        data = bytes(self._out)
        self._out.clear()
        return data

    def send(self, message: Message) -> bytes:
        """Bytes of a message. Raises ProtocolError if it is too large or may not be sent now; then nothing has changed."""
        if message.KIND not in self._quick_out:
            return self._send_unusual(message)
        body = encode(message)
        if self._seal_out is not None:
            return (len(body) + SEAL_BYTES).to_bytes(_HEADER, "big") + body + self._seal_out.next(body)
        return len(body).to_bytes(_HEADER, "big") + body

    def send_all(self, messages: Sequence[Message]) -> bytes:
        """Bytes of messages that may all go and end nothing. Raises as `send`; then nothing has changed."""
        if not self._quick_out.issuperset([message.KIND for message in messages]):
            raise ProtocolError("out_of_turn", "these messages have to be sent one by one")
        parts: list[bytes] = []
        seal, seal_bytes = self._seal_out, self._seal_bytes
        for body in encode_all(messages):
            parts += (len(body) + seal_bytes).to_bytes(_HEADER, "big"), body
            if seal is not None:
                parts.append(seal.next(body))
        return b"".join(parts)

    def _send_unusual(self, message: Message) -> bytes:
        if message.KIND not in self._may_go:
            raise ProtocolError("out_of_turn", f"{type(message).__name__} cannot be sent while {self._phase.value}")
        if self._phase is not Phase.OPEN:
            return self._send_opening(message)
        last_word = self._frame(encode(message))
        self._enter(Phase.CLOSING)
        return last_word

    def refusal(self, refuse: Refuse) -> bytes:
        """Bytes of the last word to a side that has broken the protocol, sealed if the connection was open."""
        return self._frame(encode(refuse))

    def _frame(self, body: bytes) -> bytes:
        if self._seal_out is None:
            return len(body).to_bytes(_HEADER, "big") + body
        return (len(body) + SEAL_BYTES).to_bytes(_HEADER, "big") + body + self._seal_out.next(body)

    def _send_opening(self, message: Message) -> bytes:
        if isinstance(message, Hello):
            message = replace(message, auth=self._nonce if self._key is not None else b"")
            body = encode(message)
            self._transcript = body
            self._enter(Phase.HELLO_SENT)
        elif isinstance(message, Welcome):
            body = self._welcome_body(message)
        else:
            body = encode(message)
            self._enter(Phase.CLOSING)
        data = self._frame(body)
        if isinstance(message, Welcome):
            self._open(message.version)
        return data

    def _welcome_body(self, welcome: Welcome) -> bytes:
        if self._key is None:
            return encode(welcome)
        # `auth` is the last field, so everything but its 32 bytes is covered without encoding twice on the other side.
        body = encode(replace(welcome, auth=bytes(PROOF_BYTES)))[:-PROOF_BYTES]
        return body + proof(self._key, "server", self._transcript + body)

    def _open(self, version: int) -> None:
        self.version = version
        if self._key is not None:
            labels = ("client to server", "server to client")
            mine, theirs = labels if self.side is Side.CLIENT else labels[::-1]
            self._seal_out = Seal(self._key, mine, self._transcript)
            self._seal_in = Seal(self._key, theirs, self._transcript)
            self._seal_bytes = SEAL_BYTES
        self._enter(Phase.OPEN)

    def receive_data(self, data: bytes) -> list[Message]:
        """Messages completed by these bytes, in order.

        Raises ProtocolError when the other side broke the protocol: the connection is closed then, and what came well
        before the fault is in the error's `before`.
        """
        if self._parts:
            self._parts.append(data)
            self._have += len(data)
            if self._have < self._need:
                return []
            data = b"".join(self._parts)
            self._parts.clear()
        elif self._phase in OVER:
            return []
        messages: list[Message] = []
        try:
            start = self._quick_frames(data, messages) if len(data) > _HEAD.size else 0
            if start < len(data):
                self._frames(data, start, messages)
        except ProtocolError as fault:
            self._enter(Phase.CLOSED)
            raise ProtocolError(fault.code, fault.text, messages) from None
        return messages

    def _quick_frames(self, data: bytes, messages: list[Message]) -> int:
        """Take whole frames of an open connection for as long as nothing is unusual about them; says how far it came."""
        size, start, longest, seal_bytes = len(data), 0, self._quick_in.get, self._seal_bytes
        last, least = size - _HEAD.size, seal_bytes + 2
        while start < last:
            length, array, kind = _head_at(data, start)
            body = start + _HEADER
            end = body + length
            if end > size or not least <= length <= longest(kind, 0) or array & 0xF0 != 0x90:
                break
            part = self._unsealed(data, body, end) if seal_bytes else data[body:end]
            message = None
            if kind in READERS and length <= UNCOUNTED:
                # As `decode_kind`, which would be one more call for each of a hundred thousand frames a second.
                try:
                    message = READERS[kind](unpack(part, ext_hook=no_extension), length <= NAME_LENGTH)
                except Exception:
                    message = None  # whatever it is, the table finds and names it
            messages.append(message or decode_by_table(part, kind, len(part)))
            start = end
        return start

    def _frames(self, data: bytes, start: int, messages: list[Message]) -> None:
        """Take whole frames, whatever they are; what is left waits for more, in parts, so that nothing is moved twice."""
        while self.state is not State.CLOSED and (end := self._frame_end(data, start)):
            message = self._take(data, start + _HEADER, end)
            start = end
            if message is not None:
                messages.append(message)
        if start < len(data):
            self._parts.append(data[start:] if start else data)
            self._have = len(data) - start

    def _unsealed(self, data: bytes, start: int, end: int) -> bytes | memoryview:
        """The body of a sealed frame, which lies with its seal at `start` to `end`."""
        assert self._seal_in is not None
        middle = end - SEAL_BYTES
        # A large body is not copied again to be taken apart.
        body = memoryview(data)[start:middle] if end - start > _LARGE else data[start:middle]
        if not same(data[middle:end], self._seal_in.next(body)):
            raise ProtocolError("bad_seal", "a frame was changed, repeated, lost or made without the key")
        return body

    def _frame_end(self, data: bytes, start: int) -> int:
        """Where the frame that begins at `start` ends; 0 if it is not all there. Refuses a bad one as early as it can."""
        body = start + _HEADER
        self._need = _HEADER + 2
        if len(data) < body + 2:
            if len(data) >= body and int.from_bytes(data[start:body], "big") < 2:
                raise ProtocolError("malformed", "a frame without a message")
            return 0
        length = int.from_bytes(data[start:body], "big")
        sealed = self._seal_bytes
        if length < 2 + sealed:
            raise ProtocolError("malformed", f"a frame of {length} bytes")
        kind = kind_of(data[body : body + 2])
        if kind not in self._may_come:
            raise ProtocolError("out_of_turn", f"kind {kind} cannot come while {self._phase.value}")
        if length > LIMITS[kind] + sealed:
            raise ProtocolError("too_large", f"kind {kind}: {length} bytes are above the limit of {LIMITS[kind]}")
        self._need = _HEADER + length
        return body + length if len(data) >= body + length else 0

    def _take(self, data: bytes, start: int, end: int) -> Message | None:
        body = data[start:end] if self._seal_in is None else self._unsealed(data, start, end)
        message = decode(body)
        if self._phase is not Phase.OPEN:
            return self._take_opening(message, bytes(body))
        if message.KIND in LAST:
            self._enter(Phase.CLOSED)
        return message

    def _take_opening(self, message: Message, body: bytes) -> Message | None:
        if isinstance(message, Hello):
            return self._take_hello(message, body)
        if isinstance(message, Challenge):
            self._take_challenge(message, body)
            return None
        if isinstance(message, Proof):
            return self._take_proof(message)
        if isinstance(message, Welcome):
            self._take_welcome(message, body)
            return message
        self._enter(Phase.CLOSED)
        return message

    def _take_hello(self, hello: Hello, body: bytes) -> Hello | None:
        if negotiate(hello.oldest_version, hello.newest_version) is None:
            spoken = f"{OLDEST_VERSION} to {NEWEST_VERSION}"
            asked = f"{hello.oldest_version} to {hello.newest_version}"
            raise ProtocolError(
                "version", f"versions {asked} are asked for, {spoken} are spoken here: update the older side"
            )
        self._transcript = body
        if self._key is None:
            if hello.auth:
                raise ProtocolError(
                    "no_key_here", "this side has no key: give it the same key file, or take yours away"
                )
            self._enter(Phase.DECIDING)
            return hello
        if len(hello.auth) != NONCE_BYTES:
            raise ProtocolError("key_needed", "this side asks for a key: give the other side the same key file")
        self._hello = hello
        challenge = encode(Challenge(self._nonce))
        self._transcript += challenge
        self._out += self._frame(challenge)
        self._enter(Phase.CHALLENGED)
        return None

    def _take_challenge(self, challenge: Challenge, body: bytes) -> None:
        if self._key is None:
            raise ProtocolError("key_needed", "the server asks for a key: give this side the same key file")
        if len(challenge.auth) != NONCE_BYTES:
            raise ProtocolError("malformed", f"a nonce of {len(challenge.auth)} bytes")
        self._transcript += body
        self._out += self._frame(encode(Proof(proof(self._key, "client", self._transcript))))
        self._enter(Phase.PROVED)

    def _take_proof(self, given: Proof) -> Hello | None:
        if self._key is None or not same(given.auth, proof(self._key, "client", self._transcript)):
            raise ProtocolError("wrong_key", "the client's key is not this side's key: use the same key file")
        self._enter(Phase.DECIDING)
        return self._hello

    def _take_welcome(self, welcome: Welcome, body: bytes) -> None:
        if self._key is not None:
            if self._phase is not Phase.PROVED:
                raise ProtocolError("no_key_there", "the server did not ask for the key: give it the same key file")
            expected = proof(self._key, "server", self._transcript + body[:-PROOF_BYTES])
            if not same(welcome.auth, expected):
                raise ProtocolError("wrong_key", "the server's key is not this side's key: use the same key file")
        if not OLDEST_VERSION <= welcome.version <= NEWEST_VERSION:
            raise ProtocolError("version", f"the server chose version {welcome.version}, which was not offered")
        self._open(welcome.version)
