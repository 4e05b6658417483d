"""Proof of a shared key and the seal of each frame: HMAC-SHA256 (RFC 2104, FIPS 180-4) from the standard library.

Both ends draw a nonce; the transcript is all bytes of HELLO and CHALLENGE. The client proves the key over the transcript,
the server over transcript and WELCOME, and each direction gets a sealing key of its own, so neither a recorded nor a
mirrored frame is ever accepted, and the version range cannot be changed on the way. The key itself never crosses the wire.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import secrets
import stat
from pathlib import Path
from typing import Protocol

from services.comm.whole_file import write_whole

NONCE_BYTES = 32
PROOF_BYTES = 32
SEAL_BYTES = 16
"""HMAC-SHA256 cut to its first 128 bits."""
KEY_BYTES = 32

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


def require_key(name: str, host: str, key: bytes | bool | None) -> None:
    """Refuse to listen where other hosts can connect unless there is a key, or certificates. Raises KeyNeededError."""
    if not key and not is_loopback(host):
        raise KeyNeededError(
            f"{name}: refuses to listen on {host}, which other hosts can reach, without a key; make a key file (or "
            "certificates) with `petrobot keys`, copy it to each host and name it under [keys] in services.toml, or "
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
    """MAC of one direction of one connection: each frame's number and body under a key of this connection alone.

    The number is counted by both ends and not sent, so a frame lost, repeated or moved breaks the seal.
    """

    __slots__ = ("_inner", "_number", "_outer")

    def __init__(self, key: bytes, direction: str, transcript: bytes) -> None:
        own = proof(key, direction, transcript).ljust(_BLOCK, b"\0")
        # The two half-way states of HMAC are kept: a third of the time of hmac.digest on a short frame.
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


def new_key() -> bytes:
    """A fresh shared key."""
    return secrets.token_bytes(KEY_BYTES)


def write_key(path: Path, key: bytes) -> None:
    """Write a key file, one line of hexadecimal digits that its owner alone may read. Raises KeyFileError if it exists."""
    try:
        write_whole(path, key.hex() + "\n", mode=0o600, fresh=True)
    except FileExistsError:
        raise KeyFileError(f"{path}: exists already; remove it first if no host uses it any more") from None
    except OSError as fault:
        raise KeyFileError(f"{path}: {fault.strerror}; give --file a place that can be written") from None


def read_key(path: Path) -> bytes:
    """The shared key in a key file. Raises KeyFileError if it is missing, readable by others, or no key."""
    try:
        mode = path.stat().st_mode
        text = path.read_text(encoding="ascii").strip()
    except UnicodeDecodeError:
        raise KeyFileError(f"{path}: not a key file; make one with `petrobot keys`") from None
    except OSError as fault:
        raise KeyFileError(
            f"{path}: {fault.strerror}; make one with `petrobot keys` and copy it to each host"
        ) from None
    if stat.S_IMODE(mode) & 0o077:
        raise KeyFileError(f"{path}: other users may read it; run `chmod 600 {path}`")
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise KeyFileError(f"{path}: not {2 * KEY_BYTES} hexadecimal digits; make a key file with `petrobot keys`")
    return key
