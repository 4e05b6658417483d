"""Seals, key files, and addresses that need a key."""

from __future__ import annotations

import errno
import hmac
import os
from functools import partial
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from petrobot.services.comm.protocol.security import (
    KeyFileError,
    KeyNeededError,
    Seal,
    new_key,
    proof,
    read_key,
    require_key,
    write_key,
)


@given(st.binary(min_size=1, max_size=64), st.lists(st.binary(max_size=200), max_size=5))
def test_a_seal_is_hmac_sha256_of_number_and_body(key: bytes, bodies: list[bytes]) -> None:
    seal = Seal(key, "client to server", b"transcript")
    own = hmac.digest(key, b"client to server\0transcript", "sha256")
    assert own == proof(key, "client to server", b"transcript")
    for number, body in enumerate(bodies):
        assert seal.next(body) == hmac.digest(own, number.to_bytes(8, "big") + body, "sha256")[:16]


def test_a_key_file_is_read_back_and_only_its_owner_can_read_it(tmp_path: Path) -> None:
    path, key = tmp_path / "cell.key", new_key()
    write_key(path, key)
    assert read_key(path) == key
    assert path.stat().st_mode & 0o777 == 0o600
    with pytest.raises(KeyFileError, match="exists already"):
        write_key(path, key)


@pytest.mark.parametrize("text", ["", "abc", "zz" * 32, "00" * 31, "00" * 33, "\xe9" * 64])
def test_an_invalid_key_is_refused_without_showing_it(tmp_path: Path, text: str) -> None:
    path = tmp_path / "cell.key"
    path.write_bytes(text.encode("latin-1"))
    path.chmod(0o600)
    with pytest.raises(KeyFileError, match="petrobot keys") as fault:
        read_key(path)
    assert not text or text not in str(fault.value)


def test_a_key_that_others_may_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "cell.key"
    write_key(path, new_key())
    path.chmod(0o640)
    with pytest.raises(KeyFileError, match="chmod 600"):
        read_key(path)


def test_a_missing_key_file_names_the_command_that_makes_one(tmp_path: Path) -> None:
    with pytest.raises(KeyFileError, match=r"missing\.key: .*petrobot keys"):
        read_key(tmp_path / "missing.key")


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.5", "::", "robot.example", ""])
def test_an_address_needs_a_key_unless_it_is_a_loopback(host: str) -> None:
    for loopback in ("127.0.0.1", "127.1.2.3", "::1", "localhost"):
        require_key("vision", loopback, None)
    require_key("vision", host, new_key())
    with pytest.raises(KeyNeededError, match="vision: refuses to listen"):
        require_key("vision", host, None)


def test_a_key_of_another_user_is_refused(tmp_path: Path) -> None:
    """That user could change it; a key of root is accepted, as root can change any file."""
    path = tmp_path / "cell.key"
    write_key(path, new_key())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.geteuid", lambda: path.stat().st_uid + 1000)
        if path.stat().st_uid == 0:
            assert read_key(path)
    if os.geteuid() != 0:
        pytest.skip("only root can give a file away")
    os.chown(path, 12345, 12345)
    with pytest.raises(KeyFileError, match="belongs to another user"):
        read_key(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.open", partial(_deny, path))
        with pytest.raises(KeyFileError, match=f"{path}: this user .* may not read it; run"):
            read_key(path)


def _deny(path: Path, *_: object) -> int:
    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))


def test_a_key_file_is_checked_and_read_through_one_descriptor(tmp_path: Path) -> None:
    """The checked file is the one that is read: replacing the name in between has no effect. A pipe
    does not block."""
    good, other = tmp_path / "cell.key", tmp_path / "other.key"
    key = new_key()
    write_key(good, key)
    other.write_text(new_key().hex())
    other.chmod(0o666)
    real = os.fstat

    def swap(number: int) -> os.stat_result:
        found = real(number)
        other.replace(good)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.fstat", swap)
        assert read_key(good) == key
    pipe = tmp_path / "pipe.key"
    os.mkfifo(pipe, 0o600)
    with pytest.raises(KeyFileError, match="not a regular file"):
        read_key(pipe)
