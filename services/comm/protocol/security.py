"""Proof of a shared key, and the seal (MAC) of each frame: HMAC-SHA256 (RFC 2104, FIPS 180-4).

Each end draws a nonce. The transcript is all bytes of HELLO and CHALLENGE, which include the name
of the wanted server. The client proves the key over the transcript, the server over transcript and
WELCOME, and each direction gets a sealing key of its own. So a recorded or mirrored frame is never
accepted, and neither the version range nor the wanted name can be changed on the way. The key
itself is never sent. Without a key each frame carries a CRC-32 in place of the seal: it finds
accidents, not attacks.
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

from petrobot.services.host.toml_text import InputError
from petrobot.services.host.whole_file import write_whole

NONCE_BYTES = 32
PROOF_BYTES = 32
SEAL_BYTES = 16
"""HMAC-SHA256 truncated to its first 128 bits (RFC 2104, section 5)."""
KEY_BYTES = 32
LARGEST_SECRET = 1 << 16
"""Most bytes that are read of a key file."""
CHECK_BYTES = 4
"""Size of the CRC-32 (IEEE 802.3, the same as zlib's; big endian), which stands in place of proof
and seal when there is no key."""

UNPROVEN = "unauthenticated refusal"
"""Prefix for a refusal that does not prove the key. Anybody on the network could have sent it, so
it only counts as a broken link."""

Keys = bytes | tuple[bytes, ...]
"""The shared key; or, while the key is being replaced, all accepted keys, the newest first."""

_BLOCK = 64  # block size of SHA-256 (bytes)


class _Hash(Protocol):
    def copy(self) -> _Hash: ...

    def update(self, data: bytes | memoryview, /) -> None: ...

    def digest(self) -> bytes: ...


class KeyNeededError(InputError):
    """A socket that other hosts can reach must not be opened without a key."""


LOOPBACK_NAMES = ("localhost", "ip6-localhost")


def is_loopback(host: str) -> bool:
    """Return whether only processes of this host can reach a socket bound to `host`."""
    if host in LOOPBACK_NAMES:
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def require_key(name: str, host: str, key: Keys | bool | None) -> None:
    """Raise KeyNeededError if other hosts can connect to `host` and there is neither key nor
    certificate."""
    if not key and not is_loopback(host):
        raise KeyNeededError(
            f"{name}: refuses to listen on {host}, which other hosts can reach, without a "
            "key; make a key file (or "
            "certificates) with `petrobot keys`, copy it to each host and name it under "
            "[keys] in services.toml, or "
            "listen on 127.0.0.1"
        )


class KeyFileError(InputError):
    """A key file cannot be used; the text says why and what to do."""


def proof(key: bytes, label: str, transcript: bytes) -> bytes:
    """Return the proof of the key for one side of one connection (32 bytes)."""
    return hmac.digest(key, label.encode() + b"\0" + transcript, "sha256")


def same(a: bytes, b: bytes) -> bool:
    """Compare two secrets in constant time, so that the duration does not tell where they
    differ."""
    return hmac.compare_digest(a, b)


class Seal:
    """MAC of one direction of one connection, over each frame's number and body.

    The key is derived for this connection and direction alone. Both ends count the frames; the
    number is not sent. So a lost, repeated or moved frame breaks the seal.
    """

    __slots__ = ("_inner", "_number", "_outer")

    def __init__(self, key: bytes, direction: str, transcript: bytes) -> None:
        own = proof(key, direction, transcript).ljust(_BLOCK, b"\0")
        # HMAC is H(key ^ opad | H(key ^ ipad | message)), with ipad 0x36 and opad 0x5c repeated
        # (RFC 2104). The two hashes that have already consumed the padded key are kept and copied
        # for each frame. On a short frame this takes a third of the time of hmac.digest.
        self._inner: _Hash = hashlib.sha256(bytes(byte ^ 0x36 for byte in own))
        self._outer: _Hash = hashlib.sha256(bytes(byte ^ 0x5C for byte in own))
        self._number = 0

    def next(self, body: bytes | memoryview) -> bytes:
        """Return the seal of the next frame (16 bytes)."""
        inner = self._inner.copy()
        inner.update(self._number.to_bytes(8, "big"))
        inner.update(body)
        outer = self._outer.copy()
        outer.update(inner.digest())
        self._number += 1
        return outer.digest()[:SEAL_BYTES]


class Check:
    """Checksum in place of a seal on a connection without a key: CRC-32 of the body.

    TCP keeps order and number of frames, but its own checksum has only 16 bits and misses some
    changes (Stone and Partridge, "When the CRC and TCP checksum disagree", SIGCOMM 2000).
    """

    __slots__ = ()

    def next(self, body: bytes | memoryview) -> bytes:
        """Return the checksum of a frame (4 bytes)."""
        return crc32(body).to_bytes(CHECK_BYTES, "big")


def check(body: bytes | memoryview, before: bytes = b"") -> bytes:
    """Return the CRC-32 of `before` and `body` together (4 bytes)."""
    return crc32(body, crc32(before)).to_bytes(CHECK_BYTES, "big")


def all_keys(keys: Keys | None) -> tuple[bytes, ...]:
    """Return the accepted keys, the newest first; empty if there is no key."""
    return () if keys is None else (keys,) if isinstance(keys, bytes) else keys


def new_key() -> bytes:
    """Draw a new shared key."""
    return secrets.token_bytes(KEY_BYTES)


def write_key(path: Path, key: bytes) -> None:
    """Write a key file: one line of hexadecimal digits, readable by its owner only.

    Raises KeyFileError if the file exists or cannot be written.
    """
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
    """Read a file that only its owner may read. Raises KeyFileError if others may, or if this user
    may not, OSError if it cannot be read.

    The file is opened once, and the opened file is checked, not its name: a name could lead to
    another file a moment later. A symbolic link is followed, because a user who can write
    services.toml could name any file anyway; the owner of the final file decides.
    """
    # O_NONBLOCK: opening a named pipe must not block.
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except PermissionError:
        raise KeyFileError(
            f"{path}: this user (uid {os.geteuid()}) may not read it; run this as the user who "
            f"owns it, or `chown {os.geteuid()} {path}` as root"
        ) from None
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
    """Read the shared key from a key file.

    Raises KeyFileError if the file is missing, belongs to another user, is readable by others, or
    is not a key.
    """
    try:
        key = bytes.fromhex(read_secret(path).decode("ascii").strip())
    except OSError as fault:
        raise KeyFileError(
            f"{path}: {fault.strerror}; copy it from a host that has it; if none has, make one "
            "with `petrobot keys` and copy it to each host"
        ) from None
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise KeyFileError(
            f"{path}: not {2 * KEY_BYTES} hexadecimal digits; make a key file with `petrobot keys`"
        )
    return key
