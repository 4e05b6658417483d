"""Find out when certificates expire, and warn once, a month before.

Only the standard library is used: a host that runs a node needs no package for X.509. Of a
certificate (RFC 5280, section 4.1) only `notAfter` is read. The encoding is ASN.1 DER (ITU-T
X.690): each element is a tag byte, a length, and the contents.
"""

from __future__ import annotations

import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

SOON: Final = timedelta(days=30)
"""So long before the expiry the operator is warned, to have time to act."""
DAY: Final = 86_400.0
"""Seconds after which a long-lived process checks again."""

_SEQUENCE, _VERSION, _UTC_TIME, _TIME = 0x30, 0xA0, 0x17, 0x18
_BEFORE_VALIDITY = 3
"""Elements before the validity: serial number, algorithm, issuer."""


def ends_of(pem: str) -> datetime:
    """Return when the first certificate of a PEM text expires. Raises ValueError if it cannot be
    read."""
    import ssl  # here, because each worker imports this module, and few cells have certificates

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
        raise ValueError(f"expected a PEM certificate ({fault})") from None


def _element(der: bytes, at: int) -> tuple[int, int]:
    """Return where the contents of the DER element at `at` begin and end."""
    length, at = der[at + 1], at + 2
    if length & 0x80:  # long form: the low bits say how many bytes of length follow
        size = length & 0x7F
        length, at = int.from_bytes(der[at : at + size], "big"), at + size
    if at + length > len(der):
        raise ValueError("it is truncated")
    return at, at + length


def _enter(der: bytes, at: int) -> tuple[int, int]:
    """Return the contents of the SEQUENCE at `at`."""
    if der[at] != _SEQUENCE:
        raise ValueError("it does not have the structure of a certificate")
    return _element(der, at)


def _past(der: bytes, at: int) -> int:
    """Return where the element after the one at `at` begins."""
    return _element(der, at)[1]


def _time(der: bytes, at: int) -> datetime:
    start, end = _element(der, at)
    text = der[start:end].decode("ascii")
    if der[at] == _UTC_TIME:
        text = ("20" if text < "50" else "19") + text  # two-digit year: RFC 5280, 4.1.2.5.1
    elif der[at] != _TIME:
        raise ValueError("its validity is not a time")
    return datetime.strptime(text, "%Y%m%d%H%M%SZ").replace(tzinfo=UTC)


def ending(file: Path, now: datetime, remedy: str) -> str:
    """Return a warning about a certificate file that expires soon or has expired; empty if neither,
    or if it cannot be read."""
    try:
        ends = ends_of(file.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return ""  # the code that uses the certificate reports this
    if ends - now > SOON:
        return ""
    day = f"{ends:%Y-%m-%d %H:%M} UTC"
    if ends <= now:
        return f"{file}: this certificate expired on {day} and is not accepted any more; {remedy}"
    days = (ends - now).days
    left = f"in {days} days" if days > 1 else "within two days"
    return f"{file}: this certificate expires {left}, on {day}; {remedy}"


_remedies: dict[Path, str] = {}
"""Remedies of the certificates that this process uses, by file."""
_said: set[tuple[Path, bool]] = set()


def watch(file: Path, now: datetime, remedy: str) -> None:
    """This process uses a certificate: warn on standard error once when it expires soon, and once
    when it has expired."""
    file = file.absolute()
    _remedies[file] = remedy
    _tell(file, now)


def look_again(now: datetime) -> None:
    """Check all certificates that were passed to `watch`; a long-lived process calls it once a
    `DAY`."""
    for file in list(_remedies):
        _tell(file, now)


def _tell(file: Path, now: datetime) -> None:
    text = ending(file, now, _remedies[file])
    kind = file, text.startswith(f"{file}: this certificate expired")
    if text and kind not in _said:
        _said.add(kind)
        print(text, file=sys.stderr, flush=True)
