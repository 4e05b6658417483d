"""How a party of the cell proves who it is: not at all on loopback, with the shared key, or with a
certificate (mutual TLS).

`[keys]` in services.toml selects it: `file = "cell.key"` names the shared key; `certificates =
"keys"` names a folder with the cell's `ca.pem` and, on each host, `NAME.pem` and `NAME.key` of the
parties that run there. Only TLS 1.3 (RFC 8446) is used, and both ends show a certificate. A client
asks for the node by name, so one node cannot stand in for another. A server accepts a party only
under the name on its certificate; the coordinator's certificate also serves all tools of the
operator.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct

from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.protocol.messages import COORDINATOR
from petrobot.services.comm.protocol.security import KeyFileError, Keys, read_key, read_secret

if TYPE_CHECKING:
    import ssl

CA_FILE: Final = "ca.pem"
EXPIRED: Final = 10
"""X509_V_ERR_CERT_HAS_EXPIRED (openssl-verification-options)."""
NOT_YET_VALID: Final = 9
"""X509_V_ERR_CERT_NOT_YET_VALID; many small computers have no clock that runs without power."""
MADE_BY: Final = "`petrobot keys --tls`"
RENEW: Final = "run {command} where the authority's key is, and copy {name}.pem and {name}.key here"
RENEW_CA: Final = (
    "make a new authority with `petrobot keys --tls` and the name of another folder, copy it "
    "to every host and name it under "
    "[keys] in services.toml"
)


class Credentials(Struct, frozen=True):
    """Credentials of one party.

    `key` is the shared key, or all accepted keys; `folder` holds the certificates, `party` names
    the one to use.
    """

    party: str = ""
    key: Keys | None = None
    folder: Path | None = None
    also: Path | None = None
    """Folder of another authority whose certificates are also accepted, while the authority is
    being replaced."""

    @property
    def guarded(self) -> bool:
        """Return whether strangers are kept out, so that a socket may be open to other hosts."""
        return self.key is not None or self.folder is not None

    def server(self) -> ssl.SSLContext | None:
        """Return the TLS context of a listening end; None without certificates. Raises
        KeyFileError."""
        return self._context(listens=True)

    def client(self) -> ssl.SSLContext | None:
        """Return the TLS context of a connecting end; None without certificates. Raises
        KeyFileError."""
        return self._context(listens=False)

    def stream_key(self, ticket: str) -> Keys | None:
        """Return the key that seals a set-point stream: the shared key; with certificates a key
        derived from the ticket.

        So the servo's cycle needs no TLS. A ticket is the receiving device's secret, a dot, and the
        stream's own part. Both are drawn at each start of the receiver, and sent only through an
        authenticated (TLS) connection.
        """
        if self.key is not None or self.folder is None:
            return self.key
        secret = ticket.partition(".")[0].encode()
        return hmac.digest(secret, b"petrobot set-point stream", hashlib.sha256) if secret else None

    def tell_ends(self) -> None:
        """Report on standard error, once per process, which certificates used here expire soon or
        have expired."""
        if self.folder is None:
            return
        now = datetime.now(UTC)
        command = f"`petrobot keys --tls {self.folder.name}`"
        watch(
            self.folder / f"{self.party}.pem", now, RENEW.format(command=command, name=self.party)
        )
        watch(self.folder / CA_FILE, now, RENEW_CA)

    def _context(self, listens: bool) -> ssl.SSLContext | None:
        if self.folder is None:
            return None
        server, client = self._load(self.folder, True), self._load(self.folder, False)
        if why := _not_accepted(server, client, self.party):
            raise KeyFileError(
                f"{self.folder / self.party}.pem: expected a certificate of {self.party} by the "
                f"authority in {CA_FILE}, as the rest of the cell does: {why}; copy "
                f"{self.party}'s files and {CA_FILE} here from where {MADE_BY} was run"
            )
        self.tell_ends()
        return server if listens else client

    def _load(self, folder: Path, listens: bool) -> ssl.SSLContext:
        # Here, because each worker imports this module, and few cells have certificates.
        import ssl

        certificate, key, ca = (
            folder / name for name in (f"{self.party}.pem", f"{self.party}.key", CA_FILE)
        )
        try:
            read_secret(key)
        except OSError as fault:
            raise KeyFileError(
                f"{key}: {fault.strerror}; make it with {MADE_BY} and copy it here from "
                "where that was run"
            ) from None
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if listens else ssl.PROTOCOL_TLS_CLIENT)
        context.minimum_version = ssl.TLSVersion.TLSv1_3
        context.verify_mode = ssl.CERT_REQUIRED
        try:
            context.load_verify_locations(ca)
            if self.also is not None:
                context.load_verify_locations(self.also / CA_FILE)
            context.load_cert_chain(certificate, key, _no_password)
        except (OSError, ssl.SSLError) as fault:
            reason = (
                getattr(fault, "strerror", "")
                or getattr(fault, "reason", "")
                or type(fault).__name__
            )
            text = f"{folder}: cannot use the certificate of {self.party} ({reason})"
            raise KeyFileError(
                f"{text}; make them with {MADE_BY} and copy {self.party}'s files here"
            ) from None
        return context


def _not_accepted(server: ssl.SSLContext, client: ssl.SSLContext, party: str) -> str:
    """Return why the rest of the cell will not accept the certificate of `party`, found by a
    handshake with itself in memory; empty if it will, once its time has come or it is renewed.
    Without this, `up` would call a node ready that refuses every connection."""
    import ssl

    asked, answered = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (
        client.wrap_bio(answered, asked, server_hostname=party),
        server.wrap_bio(asked, answered, server_side=True),
    )
    try:
        for end in ends + ends:
            with contextlib.suppress(ssl.SSLWantReadError):
                end.do_handshake()
    except ssl.SSLCertVerificationError as fault:
        return "" if fault.verify_code in (EXPIRED, NOT_YET_VALID) else str(fault.verify_message)
    return ""


def _no_password() -> str:
    """Refuse a key with a password: without this OpenSSL asks for it in the terminal, which a node
    does not have and an emergency stop must not wait for."""
    raise OSError(0, "its private key has a password: no node can type one")


def credentials(directory: Directory, party: str, key: Keys | None = None) -> Credentials:
    """Return the credentials of a node or the coordinator. `key` is the shared key, if this process
    was given it; otherwise it is read from its file.

    Raises KeyFileError when the files that services.toml names cannot be used.
    """
    keys = directory.keys
    if "certificates" not in keys:
        return Credentials(party, key or shared_keys(directory))
    also = directory.file(keys["also"]) if "also" in keys else None
    return Credentials(party, None, directory.file(keys["certificates"]), also)


def shared_keys(directory: Directory) -> Keys | None:
    """Return the shared key that services.toml names, with the second accepted key if there is one.
    Raises KeyFileError."""
    keys = directory.keys
    if "file" not in keys:
        return None
    key = read_key(directory.file(keys["file"]))
    return (key, read_key(directory.file(keys["also"]))) if "also" in keys else key


def name_on(certificate: dict[str, Any] | None) -> str:
    """Return the common name on a certificate (as `ssl.SSLSocket.getpeercert` returns it); empty if
    there is none."""
    for part in (certificate or {}).get("subject", ()):
        for field, value in part:
            if field == "commonName":
                return str(value)
    return ""


def may_speak_as(certified: str, role: str, name: str) -> bool:
    """Return whether the owner of a certificate may introduce itself with this role and name."""
    if certified == COORDINATOR:
        return role in ("coordinator", "client")
    return bool(certified) and role in ("node", "stream") and name == certified


# --- expiry ---
# Find out when certificates expire, and warn once, a month before.
#
# Only the standard library is used: a host that runs a node needs no package for X.509. Of a
# certificate (RFC 5280, section 4.1) only `notAfter` is read. The encoding is ASN.1 DER (ITU-T
# X.690): each element is a tag byte, a length, and the contents.

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
