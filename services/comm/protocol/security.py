"""Proof of a shared key and the seal of each frame: HMAC-SHA256 (RFC 2104, FIPS 180-4) from the
standard library.

Both ends draw a nonce; the transcript is all bytes of HELLO and CHALLENGE, the name of the wanted
server among them. The client proves the key over the transcript, the server over transcript and
WELCOME, and each direction gets a sealing key of its own, so neither a recorded nor a mirrored
frame is ever accepted, and neither the version range nor the wanted name can be changed on the way.
The key itself never crosses the wire. Without a key each frame carries a CRC-32 in the seal's
place: it finds accidents, not attacks.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import os
import secrets
import stat
from pathlib import Path
from typing import Protocol
from zlib import crc32

from petrobot.services.host.whole_file import write_whole

NONCE_BYTES = 32
PROOF_BYTES = 32
SEAL_BYTES = 16
"""HMAC-SHA256 cut to its first 128 bits."""
KEY_BYTES = 32
LARGEST_SECRET = 1 << 16
"""Bytes of a key file that are read at most."""
CHECK_BYTES = 4
"""CRC-32 (IEEE 802.3, as zlib's), big endian: in the place of proof and seal where there is no
key."""

UNPROVEN = "unauthenticated refusal"
"""A refusal that does not prove the key: a man in the middle can say it, too, so it counts as a
broken link, no more."""

Keys = bytes | tuple[bytes, ...]
"""The shared key, or all keys that are accepted while the key is being replaced, the newest
first."""

_BLOCK = 64


class _Hash(Protocol):
    def copy(self) -> _Hash: ...

    def update(self, data: bytes | memoryview, /) -> None: ...

    def digest(self) -> bytes: ...


class KeyNeededError(Exception):
    """A socket that other hosts can reach was to be opened without a key."""


def is_loopback(host: str) -> bool:
    """Whether only processes of this host can reach a socket bound to `host`."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def require_key(name: str, host: str, key: Keys | bool | None) -> None:
    """Refuse to listen where other hosts can connect unless there is a key, or certificates. Raises
    KeyNeededError."""
    if not key and not is_loopback(host):
        raise KeyNeededError(
            f"{name}: refuses to listen on {host}, which other hosts can reach, without a "
            "key; make a key file (or "
            "certificates) with `petrobot keys`, copy it to each host and name it under "
            "[keys] in services.toml, or "
            "listen on 127.0.0.1"
        )


class KeyFileError(Exception):
    """A key file cannot be used; the text says why and what to do."""


def proof(key: bytes, label: str, transcript: bytes) -> bytes:
    """Proof of the key for one side of one connection (32 bytes)."""
    return hmac.digest(key, label.encode() + b"\0" + transcript, "sha256")


def same(a: bytes, b: bytes) -> bool:
    """Compare in a time that does not depend on where they differ."""
    return hmac.compare_digest(a, b)


class Seal:
    """MAC of one direction of one connection: each frame's number and body under a key of this
    connection alone.

    The number is counted by both ends and not sent, so a frame lost, repeated or moved breaks the
    seal.
    """

    __slots__ = ("_inner", "_number", "_outer")

    def __init__(self, key: bytes, direction: str, transcript: bytes) -> None:
        own = proof(key, direction, transcript).ljust(_BLOCK, b"\0")
        # The two half-way states of HMAC are kept: a third of the time of hmac.digest on a short
        # frame.
        self._inner: _Hash = hashlib.sha256(bytes(byte ^ 0x36 for byte in own))
        self._outer: _Hash = hashlib.sha256(bytes(byte ^ 0x5C for byte in own))
        self._number = 0

    def next(self, body: bytes | memoryview) -> bytes:
        """Seal of the next frame (16 bytes)."""
        inner = self._inner.copy()
        inner.update(self._number.to_bytes(8, "big"))
        inner.update(body)
        outer = self._outer.copy()
        outer.update(inner.digest())
        self._number += 1
        return outer.digest()[:SEAL_BYTES]


class Check:
    """What stands in the place of a seal on a connection without a key: CRC-32 of the body alone.

    TCP keeps the order and the number of frames, but its own sum has 16 bits and misses some of the
    changed ones (Stone and Partridge, "When the CRC and TCP checksum disagree", SIGCOMM 2000).
    """

    __slots__ = ()

    def next(self, body: bytes | memoryview) -> bytes:
        """Check of a frame (4 bytes)."""
        return check(body)


def check(body: bytes | memoryview, before: bytes = b"") -> bytes:
    """CRC-32 of `before` and `body` together (4 bytes)."""
    return crc32(body, crc32(before)).to_bytes(CHECK_BYTES, "big")


def all_keys(keys: Keys | None) -> tuple[bytes, ...]:
    """The accepted keys, the newest first; none without a key."""
    return () if keys is None else (keys,) if isinstance(keys, bytes) else keys


def new_key() -> bytes:
    """A fresh shared key."""
    return secrets.token_bytes(KEY_BYTES)


def write_key(path: Path, key: bytes) -> None:
    """Write a key file, one line of hexadecimal digits that its owner alone may read. Raises
    KeyFileError if it exists."""
    try:
        write_whole(path, key.hex() + "\n", mode=0o600, fresh=True)
    except FileExistsError:
        raise KeyFileError(
            f"{path}: exists already; remove it first if no host uses it any more"
        ) from None
    except OSError as fault:
        raise KeyFileError(
            f"{path}: {fault.strerror}; give --file a place that can be written"
        ) from None


def read_secret(path: Path) -> bytes:
    """What is in a file that its owner alone may read. Raises KeyFileError if others may, OSError
    if it cannot be read.

    The file is opened once, and what is looked at is what was opened: a name could lead to another
    file a moment later. A link to it is followed, as whoever may write services.toml could name any
    file; whose file it is in the end decides.
    """
    handle = os.open(
        path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC
    )  # a pipe of that name must not hold us up
    with os.fdopen(handle, "rb") as file:
        about = os.fstat(file.fileno())
        if not stat.S_ISREG(about.st_mode):
            raise KeyFileError(
                f"{path}: not a regular file; name a key file that `petrobot keys` made"
            )
        if about.st_uid not in (os.geteuid(), 0):
            text = f"{path}: belongs to another user (uid {about.st_uid}), who could change it"
            raise KeyFileError(
                f"{text}; run `chown {os.geteuid()} {path}`, or make another with `petrobot keys`"
            )
        if stat.S_IMODE(about.st_mode) & 0o077:
            raise KeyFileError(f"{path}: other users may read it; run `chmod 600 {path}`")
        return file.read(LARGEST_SECRET)


def read_key(path: Path) -> bytes:
    """The shared key in a key file. Raises KeyFileError if it is missing, of another user, readable
    by others, or no key."""
    try:
        key = bytes.fromhex(read_secret(path).decode("ascii").strip())
    except OSError as fault:
        raise KeyFileError(
            f"{path}: {fault.strerror}; make one with `petrobot keys` and copy it to each host"
        ) from None
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise KeyFileError(
            f"{path}: not {2 * KEY_BYTES} hexadecimal digits; make a key file with `petrobot keys`"
        )
    return key
