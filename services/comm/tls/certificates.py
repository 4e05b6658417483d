"""Make the cell's certificates: an authority of its own, and a certificate for the coordinator and
each node.

X.509 v3 (RFC 5280) with keys on the curve P-256. A node's certificate contains its name from
services.toml, as common name and as DNS name. The other end checks this name, so an address may
change without a new certificate. Existing files are kept, so the command can be run again when a
node is added; a certificate that expires within 30 days is replaced.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from petrobot.services.comm.tls.credentials import CA_FILE, RENEW_CA, SOON
from petrobot.services.host.toml_text import InputError
from petrobot.services.host.whole_file import make_folder, write_whole

CA_KEY = "ca.key"
CA_NAME = "petrobot cell authority"
CA_LIFE = timedelta(days=3650)
LIFE = timedelta(days=1095)
CLOCKS = timedelta(days=1)
"""Largest difference between the clocks of hosts: a certificate is valid from this time before
it was made."""


class CertificateError(InputError):
    """The certificates cannot be made; the text says why and what to do."""


def make_certificates(
    folder: Path, parties: Sequence[str], now: datetime | None = None
) -> list[str]:
    """Make the missing files of the authority and of each party's certificate and key; return the
    files written.

    A party's certificate that expires soon is replaced together with its key. Keys are readable by
    their owner only. `now` is the time from which the certificates are valid (default: the
    present). Raises CertificateError, also when the authority itself expires soon.
    """
    now = now or datetime.now(UTC)
    if clash := {"ca"} & set(parties):
        raise CertificateError(
            f"a node is named {clash.pop()!r}, like the files of the authority; rename the node"
        )
    written: list[str] = []
    try:
        make_folder(folder)
        authority, key = _authority(folder, now, written)
        for party in parties:
            if not _lasts(folder / f"{party}.pem", now):
                _issue(folder, party, authority, key, now, written)
    except OSError as fault:
        raise CertificateError(
            f"{fault.filename or folder}: {fault.strerror}; name another folder"
        ) from fault
    except ValueError as fault:
        raise CertificateError(
            f"{folder}: its files are not an authority that this command made ({fault}); "
            "remove them"
        ) from fault
    return written


def _lasts(file: Path, now: datetime) -> bool:
    """Return whether this certificate exists and does not expire soon."""
    return (
        file.exists()
        and x509.load_pem_x509_certificate(file.read_bytes()).not_valid_after_utc - now > SOON
    )


def _authority(
    folder: Path, now: datetime, written: list[str]
) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """Return the folder's authority; make it if there is none."""
    certificate, key = folder / CA_FILE, folder / CA_KEY
    if certificate.exists():
        if not key.exists():
            raise CertificateError(
                f"{key}: not found; run this where the authority was made, or name another folder"
            )
        loaded = serialization.load_pem_private_key(key.read_bytes(), None)
        if not isinstance(loaded, ec.EllipticCurvePrivateKey):
            raise ValueError("another kind of key")
        if not _lasts(certificate, now):
            raise CertificateError(
                f"{certificate}: the authority expires soon, or has expired; {RENEW_CA}"
            )
        return x509.load_pem_x509_certificate(certificate.read_bytes()), loaded
    private = ec.generate_private_key(ec.SECP256R1())
    name = _name(CA_NAME)
    made = (
        _builder(name, name, private.public_key(), now, now + CA_LIFE)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
        .sign(private, hashes.SHA256())
    )
    _write(folder, CA_KEY, _pem(private), 0o600, written)
    _write(folder, CA_FILE, made.public_bytes(serialization.Encoding.PEM), 0o644, written)
    return made, private


def _issue(
    folder: Path,
    party: str,
    authority: x509.Certificate,
    key: ec.EllipticCurvePrivateKey,
    now: datetime,
    written: list[str],
) -> None:
    private = ec.generate_private_key(ec.SECP256R1())
    # A certificate is of no use after its authority has expired.
    ends = min(now + LIFE, authority.not_valid_after_utc)
    made = (
        _builder(_name(party), authority.subject, private.public_key(), now, ends)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .add_extension(
            x509.ExtendedKeyUsage(
                [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
            ),
            critical=False,
        )
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(party)]), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(key.public_key()), critical=False
        )
        .sign(key, hashes.SHA256())
    )
    _write(folder, f"{party}.key", _pem(private), 0o600, written)
    _write(folder, f"{party}.pem", made.public_bytes(serialization.Encoding.PEM), 0o644, written)


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    public: ec.EllipticCurvePublicKey,
    now: datetime,
    ends: datetime,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCKS)
        .not_valid_after(ends)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
    )


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _write(folder: Path, name: str, data: bytes, mode: int, written: list[str]) -> None:
    """Write a file in one piece. The key is written before its certificate, so an interrupted pair
    is made again."""
    write_whole(folder / name, data, mode=mode)
    written.append(name)
