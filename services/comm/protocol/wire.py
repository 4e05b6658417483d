"""One connection of the node protocol as a sans-I/O state machine: bytes in, messages out, and the
reverse.

A frame is a u32 length (big endian), a body (`codec.py`) and, on an open connection, a seal of 16
bytes (with a key) or a checksum of 4 bytes (without). The length counts body and seal. The machine
has no socket, clock or random numbers of its own: the caller passes bytes and the nonce. It raises
only ProtocolError.

    opening  client: HELLO ->                       server: <- WELCOME or REFUSE
    with a key:      HELLO ->  <- CHALLENGE  PROOF ->        <- WELCOME or REFUSE
    open     all other messages, sealed or with a checksum
    closing  BYE or REFUSE was sent: nothing more is sent, what arrives is dropped
    closed   BYE or REFUSE arrived, or the other side broke the protocol
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Final
from zlib import crc32

from msgspec.structs import replace

from petrobot.services.comm.protocol.codec import (
    LIMITS,
    NAME_LENGTH,
    READERS,
    UNCOUNTED,
    ProtocolError as ProtocolError,
    decode,
    decode_by_table,
    encode,
    encode_all,
    kind_of,
    no_extension,
    unpack,
)
from petrobot.services.comm.protocol.messages import (
    Accept,
    Answer,
    Bye,
    Call,
    Cancel,
    Challenge,
    Command,
    Event,
    EventAck,
    Feedback,
    Hello,
    Message,
    Outcome,
    Ping,
    Pong,
    Proof,
    Refuse,
    ResultAck,
    SetPoint,
    StreamOpen,
    Subscribe,
    Tick,
    Welcome,
    Withdraw,
)
from petrobot.services.comm.protocol.security import (
    CHECK_BYTES,
    NONCE_BYTES,
    PROOF_BYTES,
    SEAL_BYTES,
    Check,
    Keys,
    Seal,
    all_keys,
    check,
    proof,
    same,
)

# States of a connection, and the tables of who may send what in which state.


class Side(Enum):
    """Which end of the connection this is."""

    CLIENT = "client"
    SERVER = "server"


class ConnectionState(Enum):
    """State of a connection as its owner sees it."""

    OPENING = "opening"
    OPEN = "open"
    CLOSING = "closing"
    CLOSED = "closed"


class ConnectionPhase(Enum):
    """State of a connection in full: it determines which message may come next."""

    HELLO = "hello"
    """Nothing was sent yet."""
    HELLO_SENT = "hello sent"
    CHALLENGED = "challenged"
    """Server: waits for PROOF."""
    PROVED = "proved"
    """Client: PROOF was sent."""
    DECIDING = "deciding"
    """Server: its owner must answer WELCOME or REFUSE."""
    OPEN = "open"
    CLOSING = "closing"
    CLOSED = "closed"


STATES: Mapping[ConnectionPhase, ConnectionState] = {
    ConnectionPhase.OPEN: ConnectionState.OPEN,
    ConnectionPhase.CLOSING: ConnectionState.CLOSING,
    ConnectionPhase.CLOSED: ConnectionState.CLOSED,
}

_BOTH = frozenset(cls.KIND for cls in (Ping, Pong, Tick, Bye, Refuse))
_FROM_CLIENT = _BOTH | {
    cls.KIND
    for cls in (
        Call,
        ResultAck,
        Cancel,
        EventAck,
        Subscribe,
        Command,
        StreamOpen,
        SetPoint,
        Withdraw,
    )
}
_FROM_SERVER = _BOTH | {cls.KIND for cls in (Accept, Feedback, Outcome, Event, Answer)}
NOTHING: frozenset[int] = frozenset()
_REFUSE = frozenset((Refuse.KIND,))

MAY_COME: Mapping[tuple[Side, ConnectionPhase], frozenset[int]] = {
    (Side.SERVER, ConnectionPhase.HELLO): frozenset((Hello.KIND,)),
    (Side.SERVER, ConnectionPhase.CHALLENGED): _REFUSE | {Proof.KIND},
    (Side.SERVER, ConnectionPhase.OPEN): _FROM_CLIENT,
    (Side.CLIENT, ConnectionPhase.HELLO_SENT): _REFUSE | {Challenge.KIND, Welcome.KIND},
    (Side.CLIENT, ConnectionPhase.PROVED): _REFUSE | {Welcome.KIND},
    (Side.CLIENT, ConnectionPhase.OPEN): _FROM_SERVER,
}
"""Kinds that may arrive, by side and phase."""
MAY_GO: Mapping[tuple[Side, ConnectionPhase], frozenset[int]] = {
    (Side.CLIENT, ConnectionPhase.HELLO): frozenset((Hello.KIND,)),
    (Side.CLIENT, ConnectionPhase.HELLO_SENT): _REFUSE,
    (Side.CLIENT, ConnectionPhase.PROVED): _REFUSE,
    (Side.CLIENT, ConnectionPhase.OPEN): _FROM_CLIENT,
    (Side.SERVER, ConnectionPhase.HELLO): _REFUSE,
    (Side.SERVER, ConnectionPhase.CHALLENGED): _REFUSE,
    (Side.SERVER, ConnectionPhase.DECIDING): _REFUSE | {Welcome.KIND},
    (Side.SERVER, ConnectionPhase.OPEN): _FROM_SERVER,
}
"""Kinds that may be sent, by side and phase."""
LAST = frozenset((Bye.KIND, Refuse.KIND))
"""Kinds that end the connection."""
OVER = (ConnectionPhase.CLOSING, ConnectionPhase.CLOSED)


OLDEST_VERSION: Final = 2
NEWEST_VERSION: Final = 2
"""Versions of the protocol that this code speaks: OLDEST_VERSION to NEWEST_VERSION."""

_HEADER: Final = 4
_HEAD: Final = struct.Struct(">IBB")
"""Length, and the first two bytes of the body: array marker and kind."""
_CHECK: Final = struct.Struct(">I")
_PACK_CHECK: Final = _CHECK.pack
_check_at: Final = _CHECK.unpack_from
_head_at: Final = _HEAD.unpack_from
_LARGE: Final = 4096
"""From this size on (bytes) a body is passed on as a memoryview instead of a copy."""
_NO_QUICK: Mapping[int, int] = {}


def negotiate(oldest: int, newest: int) -> int | None:
    """Return the newest version that this code and a peer with the range [oldest, newest] both
    speak; None if there is none."""
    version = min(newest, NEWEST_VERSION)
    return version if version >= max(oldest, OLDEST_VERSION) and oldest <= newest else None


class Connection:
    """One end of a connection. `nonce` (32 fresh random bytes) is needed with a `key`.

    `server` is the name of the server: its own name on the server's side, the wanted name on the
    client's side. HELLO carries it and WELCOME confirms it, both covered by the proof of the key;
    each side refuses another name. With a key, a server sees HELLO only after the sender has proved
    the key; it then answers WELCOME or REFUSE.
    """

    def __init__(
        self, side: Side, server: str, *, key: Keys | None = None, nonce: bytes = b""
    ) -> None:
        if key is not None and len(nonce) != NONCE_BYTES:
            raise ValueError(f"a connection with a key needs a nonce of {NONCE_BYTES} bytes")
        self.side = side
        self.state = ConnectionState.OPENING
        self.version = 0
        """Agreed version; 0 before WELCOME."""
        self.proven = True
        """Whether a received REFUSE is known to be from the server: with a key, only if it was
        sealed."""
        self._server = server
        self._keys = all_keys(key)
        self._nonce = nonce
        self._phase = ConnectionPhase.HELLO
        self._parts: list[bytes] = []
        self._have = 0
        self._need = 0
        self._out = bytearray()
        self._hello: Hello | None = None
        self._transcript = b""
        self._seal_in: Seal | Check | None = None
        self._seal_out: Seal | Check | None = None
        self._seal_bytes = 0
        self._may_come = MAY_COME.get((side, self._phase), NOTHING)
        self._may_go = MAY_GO.get((side, self._phase), NOTHING)
        self._quick_in: Mapping[int, int] = _NO_QUICK
        """Open connection only: kinds that may arrive on the fast path, with the longest frame of
        each (bytes). BYE and REFUSE are not among them, because they change the state."""
        self._quick_out = NOTHING
        """Open connection only: kinds that may be sent on the fast path."""

    def _enter(self, phase: ConnectionPhase) -> None:
        self._phase = phase
        self.state = STATES.get(phase, ConnectionState.OPENING)
        self._may_come = MAY_COME.get((self.side, phase), NOTHING)
        self._may_go = MAY_GO.get((self.side, phase), NOTHING)
        if phase is ConnectionPhase.OPEN:
            self._quick_in = {
                kind: LIMITS[kind] + self._seal_bytes for kind in self._may_come - LAST
            }
            self._quick_out = self._may_go - LAST
        else:
            self._quick_in, self._quick_out = _NO_QUICK, NOTHING

    def data_to_send(self) -> bytes:
        """Return bytes that the handshake itself must send. Call it after each `receive_data`."""
        data = bytes(self._out)
        self._out.clear()
        return data

    def send(self, message: Message) -> bytes:
        """Return the bytes of a message.

        Raises ProtocolError if the message is too large or not allowed now; the state is then
        unchanged.
        """
        if message.KIND not in self._quick_out:
            return self._send_unusual(message)
        return self._frame(encode(message))

    def send_all(self, messages: Sequence[Message]) -> bytes:
        """Return the bytes of several messages that are allowed now and do not end the connection.

        Raises as `send`; the state is then unchanged.
        """
        if not self._quick_out.issuperset([message.KIND for message in messages]):
            raise ProtocolError("out_of_turn", "these messages have to be sent one by one")
        assert self._seal_out is not None
        return b"".join(map(self._frame, encode_all(messages)))

    def _send_unusual(self, message: Message) -> bytes:
        if message.KIND not in self._may_go:
            raise ProtocolError(
                "out_of_turn", f"{type(message).__name__} cannot be sent while {self._phase.value}"
            )
        if self._phase is not ConnectionPhase.OPEN:
            return self._send_opening(message)
        last_word = self._frame(encode(message))
        self._enter(ConnectionPhase.CLOSING)
        return last_word

    def refusal(self, refuse: Refuse) -> bytes:
        """Return the bytes of a REFUSE to a side that broke the protocol, sealed if both are known
        to share a key."""
        body = encode(refuse)
        return self._frame(body) if self.version else self._opening_refusal(body)

    def _frame(self, body: bytes) -> bytes:
        assert self._seal_out is not None
        length = len(body) + self._seal_bytes
        end = self._seal_out.next(body) if self._keys else _PACK_CHECK(crc32(body))
        # Two sums would copy the body twice.
        return b"".join((length.to_bytes(_HEADER, "big"), body, end))

    def _opening_refusal(self, body: bytes) -> bytes:
        # Once the key is proved, the refusal carries the seal that the first frame of the open
        # connection would have had. Nothing follows it, so no frame number is used twice.
        return _opening_frame(body if self._seal_out is None else body + self._seal_out.next(body))

    def _send_opening(self, message: Message) -> bytes:
        if isinstance(message, Hello):
            self._transcript = self._hello_body(message)
            self._enter(ConnectionPhase.HELLO_SENT)
            return _opening_frame(self._transcript)
        if isinstance(message, Welcome):
            data = _opening_frame(self._welcome_body(message))
            self._open(message.version)
            return data
        data = self._opening_refusal(encode(message))
        self._enter(ConnectionPhase.CLOSING)
        return data

    def _hello_body(self, hello: Hello) -> bytes:
        """Return the body of HELLO with `auth`: size of the last part (u8), wanted server, last
        part.

        The last part is the nonce; without a key it is the CRC-32 of all bytes before it.
        """
        end = self._nonce if self._keys else bytes(CHECK_BYTES)
        body = encode(replace(hello, auth=bytes((len(end),)) + self._server.encode() + end))
        return body if self._keys else _checked(body)

    def _welcome_body(self, welcome: Welcome) -> bytes:
        # `auth` is the last field of WELCOME, so the proof can cover all bytes before it, and the
        # other side need not encode the message again to check it.
        if not self._keys:
            return _checked(encode(replace(welcome, auth=bytes(CHECK_BYTES))), self._transcript)
        body = encode(replace(welcome, auth=bytes(PROOF_BYTES)))[:-PROOF_BYTES]
        return body + proof(self._keys[0], "server", self._transcript + body)

    def _share(self, key: bytes) -> None:
        """Seal all that follows with this key, which both sides are known to have."""
        self._keys = (key,)
        labels = ("client to server", "server to client")
        mine, theirs = labels if self.side is Side.CLIENT else labels[::-1]
        self._seal_out = Seal(key, mine, self._transcript)
        self._seal_in = Seal(key, theirs, self._transcript)

    def _open(self, version: int) -> None:
        self.version = version
        self._seal_bytes = SEAL_BYTES if self._keys else CHECK_BYTES
        if not self._keys:
            self._seal_out = self._seal_in = Check()
        self._enter(ConnectionPhase.OPEN)

    def receive_data(self, data: bytes) -> list[Message]:
        """Return the messages completed by these bytes, in order.

        Raises ProtocolError if the other side broke the protocol. The connection is then closed,
        and the error's `before` holds the messages that arrived complete before the fault.
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
            self._enter(ConnectionPhase.CLOSED)
            raise ProtocolError(fault.code, fault.text, messages) from None
        return messages

    def _quick_frames(self, data: bytes, messages: list[Message]) -> int:
        """Fast path: take whole, ordinary frames of an open connection from `data`. Return the end
        of the last one."""
        size, start, longest, seal_bytes = len(data), 0, self._quick_in.get, self._seal_bytes
        last, least = size - _HEAD.size, seal_bytes + 2
        while start < last:
            length, array, kind = _head_at(data, start)
            body = start + _HEADER
            end = body + length
            if end > size or not least <= length <= longest(kind, 0) or array & 0xF0 != 0x90:
                break
            middle = end - CHECK_BYTES
            part: bytes | memoryview = data[body:middle] if length <= _LARGE else b""
            if not part or self._keys or crc32(part) != _check_at(data, middle)[0]:
                # With a key, for large bodies, and to word the error. What follows in this loop for
                # a short frame with a checksum is written out: at a hundred thousand frames a
                # second each function call per frame can be measured.
                part = self._unsealed(data, body, end)
            message = None
            if kind in READERS and length <= UNCOUNTED:
                # The same as `decode_kind`.
                try:
                    message = READERS[kind](
                        unpack(part, ext_hook=no_extension), length <= NAME_LENGTH
                    )
                except Exception:
                    message = None  # the table finds the fault and words it
            messages.append(message or decode_by_table(part, kind, len(part)))
            start = end
        return start

    def _frames(self, data: bytes, start: int, messages: list[Message]) -> None:
        """Take whole frames of any kind. An incomplete rest is kept as a list of parts, so that no
        byte is copied twice."""
        while self.state is not ConnectionState.CLOSED and (end := self._frame_end(data, start)):
            message = self._take(data, start + _HEADER, end)
            start = end
            if message is not None:
                messages.append(message)
        if start < len(data):
            self._parts.append(data[start:] if start else data)
            self._have = len(data) - start

    def _unsealed(self, data: bytes, start: int, end: int) -> bytes | memoryview:
        """Check the seal of a frame that lies, without its length, at `start` to `end`. Return its
        body."""
        assert self._seal_in is not None
        middle = end - self._seal_bytes
        body = memoryview(data)[start:middle] if end - start > _LARGE else data[start:middle]
        if not same(data[middle:end], self._seal_in.next(body)):
            if self._keys:
                raise ProtocolError(
                    "bad_seal", "a frame was changed, repeated, lost or made without the key"
                )
            raise ProtocolError(
                "bad_check", "a frame was changed on its way, or made without its check"
            )
        return body

    def _frame_end(self, data: bytes, start: int) -> int:
        """Return where the frame that begins at `start` ends; 0 if it is incomplete.

        A bad frame is refused as early as possible, from its first six bytes.
        """
        body = start + _HEADER
        self._need = _HEADER + 2
        if len(data) < body:
            return 0
        length = int.from_bytes(data[start:body], "big")
        sealed = self._seal_bytes
        if length < 2 + sealed:
            raise ProtocolError("malformed", f"a frame of {length} bytes is too short")
        if len(data) < body + 2:
            return 0
        kind = kind_of(data[body : body + 2])
        if kind not in self._may_come:
            raise ProtocolError(
                "out_of_turn", f"kind {kind} is not allowed while {self._phase.value}"
            )
        # A REFUSE in answer to PROOF may carry a seal.
        longest = LIMITS[kind] + (SEAL_BYTES if self._phase is ConnectionPhase.PROVED else sealed)
        if length > longest:
            raise ProtocolError(
                "too_large", f"kind {kind}: {length} bytes are above the limit of {LIMITS[kind]}"
            )
        self._need = _HEADER + length
        return body + length if len(data) >= body + length else 0

    def _take(self, data: bytes, start: int, end: int) -> Message | None:
        if self._phase is not ConnectionPhase.OPEN:
            return self._take_opening(data[start:end])
        message = decode(self._unsealed(data, start, end))
        if message.KIND in LAST:
            self._enter(ConnectionPhase.CLOSED)
        return message

    def _take_opening(self, body: bytes) -> Message | None:
        if self._phase is ConnectionPhase.PROVED and kind_of(body) == Refuse.KIND:
            body = self._refusal_body(body)
        message = decode(body)
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
        self.proven = not self._keys or (self.proven and self._phase is ConnectionPhase.PROVED)
        self._enter(ConnectionPhase.CLOSED)
        return message

    def _refusal_body(self, body: bytes) -> bytes:
        """Return the body of a REFUSE in answer to our PROOF; it is proven if the server has sealed
        it."""
        for key in self._keys:
            seal = Seal(key, "server to client", self._transcript)
            if same(body[-SEAL_BYTES:], seal.next(body[:-SEAL_BYTES])):
                return body[:-SEAL_BYTES]
        self.proven = False
        return body

    def _take_hello(self, hello: Hello, body: bytes) -> Hello | None:
        if negotiate(hello.oldest_version, hello.newest_version) is None:
            spoken = f"{OLDEST_VERSION} to {NEWEST_VERSION}"
            asked = f"{hello.oldest_version} to {hello.newest_version}"
            raise ProtocolError(
                "version",
                f"expected a version from {spoken}, got {asked}: update the older side",
            )
        self._transcript = body
        wanted, keyed = _wanted(hello, body)
        if not self._keys:
            if keyed:
                raise ProtocolError(
                    "no_key_here",
                    "this side has no key: give it the same key file, or remove yours",
                )
            self._enter(ConnectionPhase.DECIDING)
            self._refuse_another(wanted)
            return hello
        if not keyed:
            raise ProtocolError(
                "key_needed", "this side requires a key: give the other side the same key file"
            )
        self._hello = hello
        challenge = encode(Challenge(self._nonce))
        self._transcript += challenge
        self._out += _opening_frame(challenge)
        self._enter(ConnectionPhase.CHALLENGED)
        return None

    def _refuse_another(self, wanted: str) -> None:
        if wanted != self._server:
            raise _wrong_node(self._server, wanted)

    def _take_challenge(self, challenge: Challenge, body: bytes) -> None:
        if not self._keys:
            raise ProtocolError(
                "key_needed", "the server requires a key: give this side the same key file"
            )
        if len(challenge.auth) != NONCE_BYTES:
            raise ProtocolError(
                "malformed", f"expected a nonce of {NONCE_BYTES} bytes, got {len(challenge.auth)}"
            )
        self._transcript += body
        proofs = b"".join([proof(key, "client", self._transcript) for key in self._keys])
        self._out += _opening_frame(encode(Proof(proofs)))
        self._enter(ConnectionPhase.PROVED)

    def _take_proof(self, given: Proof) -> Hello | None:
        auth = given.auth
        proofs = [auth[n : n + PROOF_BYTES] for n in range(0, len(auth), PROOF_BYTES)]
        for key in self._keys:
            expected = proof(key, "client", self._transcript)
            if any(same(one, expected) for one in proofs):
                break
        else:
            raise ProtocolError(
                "wrong_key", "the client's key is not this side's key: use the same key file"
            )
        self._share(key)
        self._enter(ConnectionPhase.DECIDING)
        assert self._hello is not None
        self._refuse_another(_wanted(self._hello, b"")[0])
        return self._hello

    def _take_welcome(self, welcome: Welcome, body: bytes) -> None:
        if self._keys:
            if self._phase is not ConnectionPhase.PROVED:
                raise ProtocolError(
                    "no_key_there", "the server did not ask for the key: give it the same key file"
                )
            covered = self._transcript + body[:-PROOF_BYTES]
            for key in self._keys:
                if same(welcome.auth, proof(key, "server", covered)):
                    break
            else:
                raise ProtocolError(
                    "wrong_key", "the server's key is not this side's key: use the same key file"
                )
            self._share(key)
        elif welcome.auth != check(body[:-CHECK_BYTES], self._transcript):
            raise ProtocolError("bad_check", "HELLO or WELCOME was changed on its way")
        if not OLDEST_VERSION <= welcome.version <= NEWEST_VERSION:
            raise ProtocolError(
                "version", f"the server chose version {welcome.version}, which was not offered"
            )
        if welcome.name != self._server:
            raise _wrong_node(welcome.name, self._server)
        self._open(welcome.version)


def _opening_frame(body: bytes) -> bytes:
    """Return a frame of the opening: no seal, as in every version, so that an older side can read
    why it is refused."""
    return len(body).to_bytes(_HEADER, "big") + body


def _checked(body: bytes, before: bytes = b"") -> bytes:
    """Replace the last bytes of a body by the checksum of all before them."""
    body = body[:-CHECK_BYTES]
    return body + check(body, before)


def _wanted(hello: Hello, body: bytes) -> tuple[str, bool]:
    """Return the server that a HELLO asks for, and whether its sender has a key. Raises
    ProtocolError."""
    auth = hello.auth
    size = auth[0] if auth else 0
    if size not in (CHECK_BYTES, NONCE_BYTES) or len(auth) < 1 + size:
        raise ProtocolError(
            "malformed", "HELLO: auth is not the wanted name with a nonce or a check"
        )
    if size == CHECK_BYTES and body and auth[-size:] != check(body[:-size]):
        raise ProtocolError("bad_check", "HELLO was changed on its way")
    try:
        return auth[1:-size].decode(), size == NONCE_BYTES
    except UnicodeDecodeError:
        raise ProtocolError("malformed", "HELLO: the wanted name is not UTF-8") from None


def _wrong_node(here: str, wanted: str) -> ProtocolError:
    remedy = f"check host and port of {wanted} in services.toml"
    return ProtocolError(
        "wrong_node", f"this is {here}, but the client asked for {wanted or 'no name'}: {remedy}"
    )
