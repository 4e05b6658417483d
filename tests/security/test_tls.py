"""Mutual TLS between real sockets: only a party with a certificate of the cell is accepted, under
the certificate's name."""

from __future__ import annotations

import asyncio
import shutil
import ssl
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives import serialization

from petrobot.coordinator.cli import main
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.location_file import DirectoryError, parse
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.security import KeyFileError
from petrobot.services.comm.tls.certificates import CertificateError, make_certificates
from petrobot.services.comm.tls.credentials import Credentials, may_speak_as
from tests.security.conftest import HELLO, Victim
from tests.waiting import beat

pytestmark = pytest.mark.processes

ROOT = Path(__file__).parents[2]
Start = Callable[..., Victim]


async def outcome_of(client: Client) -> m.Outcome:
    """Return the outcome of one call."""
    client.start()
    try:
        async with asyncio.timeout(60.0):
            return await client.call("echo", {"n": 1})
    finally:
        await client.close()


def context(folder: Path, party: str) -> ssl.SSLContext:
    """Return the TLS context of a client with this party's certificate, whoever made that."""
    return Credentials(party, None, folder)._load(folder, listens=False)


async def test_a_client_with_a_certificate_of_the_cell_is_served(
    victim: Start, certificates: Path
) -> None:
    """TLS 1.3 with certificates at both ends; a large message arrives whole."""
    server = victim(folder=str(certificates))
    client = server.client()
    client.start()
    async with asyncio.timeout(60.0):
        assert (await client.call("echo", {"n": 1})).values == {"n": 1}
        big = (await client.call("echo", {"b": bytes(15 << 17)})).values
    assert big == {"b": bytes(15 << 17)}
    link = client._link
    assert link is not None and link._transport is not None
    assert link._transport.get_extra_info("ssl_object").version() == "TLSv1.3"
    await client.close()


async def test_a_certificate_of_another_authority_is_refused(
    victim: Start, certificates: Path, tmp_path: Path
) -> None:
    """A stranger made its own certificates with all the right names: neither end trusts the
    other."""
    make_certificates(tmp_path / "own", ["coordinator", "vision"])
    server = victim(folder=str(certificates))
    client = server.client(tls=context(tmp_path / "own", "coordinator"))
    assert (await outcome_of(client)).cause in ("unreachable", "lost")
    assert "certificate" in client.trouble
    trusting = tmp_path / "mixed"  # even a client that trusts the server is not trusted by it
    shutil.copytree(tmp_path / "own", trusting)
    shutil.copy(certificates / "ca.pem", trusting / "ca.pem")
    client = server.client(tls=context(trusting, "coordinator"))
    outcome = await outcome_of(client)
    assert outcome.status == "error" and outcome.executed is not m.Executed.YES
    async with server.good_client() as good:
        await good.still_served()


async def test_a_client_without_a_certificate_is_refused(victim: Start, certificates: Path) -> None:
    """Neither a plain connection nor TLS without a certificate is accepted."""
    server = victim(folder=str(certificates))
    bare = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    bare.load_verify_locations(certificates / "ca.pem")
    for tls in (None, bare):
        outcome = await outcome_of(
            Client(*server.address, Caller("vision", HELLO, auto_ack=True), tls=tls)
        )
        assert outcome.status == "error" and outcome.executed is not m.Executed.YES
    assert server.about()["connected"] == []


async def test_older_tls_is_refused(victim: Start, certificates: Path) -> None:
    """TLS 1.2 is not accepted."""
    server = victim(folder=str(certificates))
    old = context(certificates, "coordinator")
    old.minimum_version = ssl.TLSVersion.TLSv1_2
    old.maximum_version = ssl.TLSVersion.TLSv1_2
    client = server.client(tls=old)
    assert (await outcome_of(client)).status == "error"
    assert "only accepts TLS 1.3" in client.trouble


async def test_a_node_cannot_impersonate_another(
    victim: Start, certificates: Path, tmp_path: Path
) -> None:
    """A process with motion's key that listens at vision's address is not accepted as vision."""
    stolen = tmp_path / "stolen"
    shutil.copytree(certificates, stolen)
    for end in ("pem", "key"):
        shutil.copy(stolen / f"motion.{end}", stolen / f"vision.{end}")
    impostor = victim(folder=str(stolen))
    client = impostor.client(tls=context(certificates, "coordinator"))
    assert (await outcome_of(client)).cause == "unreachable"
    assert "expected the certificate of vision" in client.trouble


@pytest.mark.parametrize(
    ("party", "role", "name", "welcome"),
    [
        ("coordinator", "coordinator", "coord", True),
        ("coordinator", "client", "estop-1a2b", True),
        ("motion", "node", "motion", True),
        ("motion", "node", "vision", False),
        ("motion", "coordinator", "coord", False),
        ("motion", "client", "motion", False),
        ("coordinator", "node", "motion", False),
    ],
)
async def test_a_party_has_the_name_on_its_certificate(
    victim: Start, certificates: Path, party: str, role: str, name: str, welcome: bool
) -> None:
    """A stolen key of a node cannot command the devices of other nodes."""
    assert may_speak_as(party, role, name) is welcome
    server = victim(folder=str(certificates))
    client = server.client(m.Hello(2, 2, role, name, "b1"), tls=context(certificates, party))
    outcome = await outcome_of(client)
    assert (outcome.status == "success") is welcome
    if not welcome:
        assert "certificate" in outcome.text and server.about()["faults"] == {"certificate": 1}


def test_a_certificate_without_a_name_gives_no_role() -> None:
    """Without a common name there is no role."""
    assert not may_speak_as("", "coordinator", "coordinator") and not may_speak_as("", "node", "")


# --- the command ------------------------------------------------------------------------------


def services_in(folder: Path) -> Path:
    """Return a location file with two nodes on two hosts."""
    path = folder / "services.toml"
    nodes = "".join(
        f'[nodes.{name}]\nhost = "{host}"\nport = {port}\n'
        for name, host, port in (("vision", "192.168.7.2", 7301), ("motion", "192.168.7.3", 7302))
    )
    path.write_text("schema = 1\n" + nodes, encoding="utf-8")
    return path


def test_keys_makes_certificates_and_says_where_to_copy_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One command makes all; only the owner can read the keys; a second time it adds what is
    missing and overwrites nothing."""
    monkeypatch.chdir(tmp_path)
    services = str(services_in(tmp_path))
    assert main(["keys", "--tls", "--services", services]) == 0
    said = capsys.readouterr().out
    assert "192.168.7.2: ca.pem, vision.pem, vision.key" in said and 'certificates = "keys"' in said
    folder = tmp_path / "keys"
    assert {path.name for path in folder.iterdir()} == {
        f"{name}.{end}"
        for name in ("ca", "coordinator", "vision", "motion")
        for end in ("pem", "key")
    }
    for key in folder.glob("*.key"):
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
        assert key.read_text().splitlines()[1] not in said
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    (folder / "motion.pem").unlink()
    (folder / "motion.key").unlink()
    assert main(["keys", "--tls", "--services", services]) == 0
    for name, data in before.items():
        assert ((folder / name).read_bytes() == data) is not name.startswith("motion")
    context(folder, "motion")


def test_keys_without_the_authoritys_key_says_where_to_go(tmp_path: Path) -> None:
    """A host that has only copies cannot make more certificates."""
    make_certificates(tmp_path, ["coordinator"])
    (tmp_path / "ca.key").unlink()
    with pytest.raises(CertificateError, match="run this where the authority was made"):
        make_certificates(tmp_path, ["vision"])


def give_password(key: Path) -> None:
    """Protect a private key with a password."""
    plain = serialization.load_pem_private_key(key.read_bytes(), None)
    key.write_bytes(
        plain.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.BestAvailableEncryption(b"secret"),
        )
    )


def put(folder: Path, one: str, other: str) -> None:
    """Put the files of one party in the place of those of another."""
    for kind in ("pem", "key"):
        shutil.copy(folder / f"{one}.{kind}", folder / f"{other}.{kind}")


def of_another_authority(folder: Path) -> None:
    """Give a node the certificate that another authority made for it."""
    make_certificates(folder / "theirs", ["vision"])
    put(folder, "theirs/vision", "vision")


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda folder: (folder / "vision.key").unlink(), "petrobot keys --tls"),
        (lambda folder: (folder / "vision.key").chmod(0o644), "chmod 600"),
        (
            lambda folder: (folder / "vision.pem").write_text("no certificate"),
            "copy vision's files here",
        ),
        (
            lambda folder: shutil.copy(folder / "motion.key", folder / "vision.key"),
            "cannot use the certificate of vision",
        ),
        (lambda folder: (folder / "ca.pem").unlink(), "cannot use the certificate of vision"),
        (lambda folder: give_password(folder / "vision.key"), "has a password"),
        (lambda folder: put(folder, "motion", "vision"), "vision.pem: .*not valid for 'vision'"),
        (of_another_authority, "vision.pem: .*authority.*issuer certificate; copy vision's"),
    ],
)
def test_bad_files_give_one_clear_error(
    tmp_path: Path, spoil: Callable[[Path], Any], says: str
) -> None:
    """The message names the file and the remedy."""
    make_certificates(tmp_path, ["vision", "motion"])
    spoil(tmp_path)
    with pytest.raises(KeyFileError, match=says):
        Credentials("vision", None, tmp_path).server()


def test_stream_keys_are_of_the_ticket(tmp_path: Path) -> None:
    """With certificates a stream is sealed by a key sent over TLS; with a shared key by that key;
    on loopback it is not sealed."""
    certified, keyed = Credentials("vision", None, tmp_path), Credentials("vision", b"k" * 32)
    one, two = certified.stream_key("secret.1"), certified.stream_key("secret.2")
    assert one == two and one is not None and len(one) == 32
    assert certified.stream_key("other.1") != one and certified.stream_key("") is None
    assert (
        keyed.stream_key("secret.1") == b"k" * 32
        and Credentials("vision").stream_key("secret.1") is None
    )


async def test_a_client_reports_why_its_connection_was_refused(
    victim: Start, certificates: Path, tmp_path: Path
) -> None:
    """A coordinator whose certificate is refused gets this reason, not that of a broken link."""
    make_certificates(tmp_path, ["coordinator"])
    shutil.copy(certificates / "ca.pem", tmp_path / "ca.pem")
    server = victim(folder=str(certificates))
    client = server.client(tls=context(tmp_path, "coordinator"))
    client.start()
    async with asyncio.timeout(60.0):
        while "our certificate is not trusted" not in client.trouble:
            await beat(0.005)
    await client.close()


# --- the shared key ---------------------------------------------------------------------------


def test_keys_makes_one_shared_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Only its owner can read the file; it is never shown or overwritten; the output has the lines
    for services.toml."""
    services, file = str(services_in(tmp_path)), tmp_path / "cell.key"
    assert main(["keys", "--file", str(file), "--services", services]) == 0
    said = capsys.readouterr().out
    key = file.read_text().strip()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600 and len(key) == 64
    assert key not in said and 'file = "cell.key"' in said and "192.168.7.2, 192.168.7.3" in said
    assert main(["keys", "--file", str(file), "--services", services]) == 2
    assert "exists already" in capsys.readouterr().err and file.read_text().strip() == key


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ('flie = "cell.key"', "keys.flie: unknown; .*did you mean 'file'"),
        (
            'file = "cell.key"\ncertificates = "keys"',
            "keys: a shared key and certificates; name one of them",
        ),
        ("file = 3", "keys.file: is 3; write the path of a file or folder"),
    ],
)
def test_faults_of_the_keys_table_are_named(tmp_path: Path, keys: str, says: str) -> None:
    """File, line, key and remedy."""
    path = services_in(tmp_path)
    with pytest.raises(DirectoryError, match=says):
        parse(path.read_text() + f"[keys]\n{keys}\n", path)
