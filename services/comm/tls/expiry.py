"""When certificates end, and who is told: read from the files themselves, said once, a month before
it hurts.

Only the standard library: a host that runs a node needs no package for X.509. Of a certificate (RFC
5280, section 4.1) no more is read than its `notAfter`.
"""

from __future__ import annotations

import ssl
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

SOON: Final = timedelta(days=30)
"""Who is told of an end so long before has the time to do something."""
DAY: Final = 86_400.0
"""Seconds after which a process that lives long looks again."""

_SEQUENCE, _VERSION, _UTC_TIME, _TIME = 0x30, 0xA0, 0x17, 0x18
_BEFORE_VALIDITY = 3
"""Serial number, algorithm and issuer."""


def ends_of(pem: str) -> datetime:
    """When the first certificate of a PEM text ends. Raises ValueError if there is none that can be
    read."""
    first = pem[pem.find("-----BEGIN CERTIFICATE-----") :].partition("-----END CERTIFICATE-----")
    try:
        der = ssl.PEM_cert_to_DER_cert("".join(first[:2]))
        at, _ = _enter(der, _enter(der, 0)[0])
        if der[at] == _VERSION:
            at = _past(der, at)
        for _ in range(_BEFORE_VALIDITY):
            at = _past(der, at)
        at, _ = _enter(der, at)
        return _time(der, _past(der, at))
    except (ValueError, IndexError) as fault:
        raise ValueError(f"no certificate that can be read ({fault})") from None


def _element(der: bytes, at: int) -> tuple[int, int]:
    """Where the contents of the element at `at` begin and end."""
    length, at = der[at + 1], at + 2
    if length & 0x80:
        size = length & 0x7F
        length, at = int.from_bytes(der[at : at + size], "big"), at + size
    if at + length > len(der):
        raise ValueError("it is cut off")
    return at, at + length


def _enter(der: bytes, at: int) -> tuple[int, int]:
    if der[at] != _SEQUENCE:
        raise ValueError("it is not made as certificates are")
    return _element(der, at)


def _past(der: bytes, at: int) -> int:
    return _element(der, at)[1]


def _time(der: bytes, at: int) -> datetime:
    start, end = _element(der, at)
    text = der[start:end].decode("ascii")
    if der[at] == _UTC_TIME:
        text = ("20" if text < "50" else "19") + text  # RFC 5280, 4.1.2.5.1
    elif der[at] != _TIME:
        raise ValueError("its validity is no time")
    return datetime.strptime(text, "%Y%m%d%H%M%SZ").replace(tzinfo=UTC)


def ending(file: Path, now: datetime, remedy: str) -> str:
    """What to say of a certificate's file that ends soon or has ended; empty if neither, or if it
    cannot be read."""
    try:
        ends = ends_of(file.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return ""  # whoever uses it says so
    if ends - now > SOON:
        return ""
    day = f"{ends:%Y-%m-%d %H:%M} UTC"
    if ends <= now:
        return f"{file}: this certificate ended on {day}, nobody accepts it any more; {remedy}"
    days = (ends - now).days
    left = f"in {days} days" if days > 1 else "within two days"
    return f"{file}: this certificate ends {left}, on {day}; {remedy}"


_remedies: dict[Path, str] = {}
"""Of the certificates that this process uses, by their files."""
_said: set[tuple[Path, bool]] = set()


def watch(file: Path, now: datetime, remedy: str) -> None:
    """This process uses a certificate: say on standard error once that it ends soon, and once that
    it has ended."""
    file = file.absolute()
    _remedies[file] = remedy
    _tell(file, now)


def look_again(now: datetime) -> None:
    """What `watch` does, of all certificates that it was given: for a process that lives long, once
    a `DAY`."""
    for file in list(_remedies):
        _tell(file, now)


def _tell(file: Path, now: datetime) -> None:
    text = ending(file, now, _remedies[file])
    kind = file, text.startswith(f"{file}: this certificate ended")
    if text and kind not in _said:
        _said.add(kind)
        print(text, file=sys.stderr, flush=True)
