"""Certificates that expire: their end is read without an X.509 package, warned about once, renewed
by the command, and named as the reason of a refused connection."""

from __future__ import annotations

import asyncio
import json
import shutil
import ssl
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from hypothesis import given, strategies as st

from petrobot.coordinator.cli import main
from petrobot.coordinator.run.node_status import ask_all
from petrobot.services.comm.calls.callee import Callee, Offer, Order
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.calls.server import Server
from petrobot.services.comm.location_file import parse
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.tls import credentials
from petrobot.services.comm.tls.certificates import (
    CA_LIFE,
    LIFE,
    CertificateError,
    make_certificates,
)
from petrobot.services.comm.tls.credentials import SOON, Credentials, ending, ends_of

NOW = datetime.now(UTC).replace(microsecond=0)
DAY = timedelta(days=1)
HELLO = m.Hello(2, 2, "client", "asking", "a1")


@pytest.fixture(autouse=True)
def new_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Start with no warning given yet."""
    monkeypatch.setattr(credentials, "_said", set())
    monkeypatch.setattr(credentials, "_remedies", {})


def made(
    folder: Path, left: timedelta, parties: tuple[str, ...] = ("coordinator", "vision")
) -> Path:
    """Make a cell's certificates that expire after `left`; the authority's lasts longer."""
    make_certificates(folder, parties, NOW - LIFE + left)
    return folder


@pytest.mark.parametrize("left", [LIFE, timedelta(days=31), timedelta(0), -timedelta(days=400)])
def test_the_expiry_time_equals_what_the_package_cryptography_reads(
    tmp_path: Path, left: timedelta
) -> None:
    for file in made(tmp_path, left).glob("*.pem"):
        assert (
            ends_of(file.read_text())
            == x509.load_pem_x509_certificate(file.read_bytes()).not_valid_after_utc
        )


def test_a_certificate_beyond_2049_has_a_four_digit_year(tmp_path: Path) -> None:
    make_certificates(tmp_path, ["vision"], datetime(2048, 6, 1, tzinfo=UTC))
    assert ends_of((tmp_path / "vision.pem").read_text()) == datetime(2048, 6, 1, tzinfo=UTC) + LIFE
    assert ends_of((tmp_path / "ca.pem").read_text()).year == 2058


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return the DER bytes of a certificate."""
    folder = tmp_path_factory.mktemp("real")
    make_certificates(folder, ["vision"])
    return ssl.PEM_cert_to_DER_cert((folder / "vision.pem").read_text())


@given(
    body=st.binary(max_size=80),
    cut=st.integers(0, 200),
    at=st.integers(0, 200),
    byte=st.integers(0, 255),
)
def test_a_damaged_certificate_gives_a_value_error_or_a_time(
    real: bytes, body: bytes, cut: int, at: int, byte: int
) -> None:
    """A truncated certificate is always refused; a changed one may still be valid. No other
    exception is raised."""
    for spoilt in (body, real[:cut], b"\x30\x82" + body):
        with pytest.raises(ValueError, match="expected a PEM certificate"):
            ends_of(ssl.DER_cert_to_PEM_cert(spoilt))
    try:
        ends_of(ssl.DER_cert_to_PEM_cert(real[:at] + bytes([byte]) + real[at + 1 :]))
    except ValueError as fault:
        assert "expected a PEM certificate" in str(fault)


@pytest.mark.parametrize(
    "text",
    ["", "x" * 30, "-----BEGIN CERTIFICATE-----", "-----BEGIN CERTIFICATE-----\n!\n-----END"],
)
def test_bytes_that_are_not_a_certificate_are_a_value_error(text: str) -> None:
    with pytest.raises(ValueError, match="expected a PEM certificate"):
        ends_of(text)


@pytest.mark.parametrize(
    ("left", "says"),
    [
        (SOON + DAY, ""),
        (SOON + timedelta(seconds=1), ""),
        (SOON, "expires in 30 days, on "),
        (timedelta(days=7, hours=1), "expires in 7 days, on "),
        (timedelta(hours=3), "expires within two days, on "),
        (timedelta(0), "expired on "),
        (-timedelta(days=3), "expired on "),
    ],
)
def test_warnings_a_month_before_the_end_and_after_it(
    tmp_path: Path, left: timedelta, says: str
) -> None:
    file = made(tmp_path, left) / "vision.pem"
    text = ending(file, NOW, "do this")
    assert (
        (says in text and f"{NOW + left:%Y-%m-%d %H:%M} UTC" in text and text.endswith("do this"))
        if says
        else not text
    )
    assert not says or text.startswith(f"{file}: this certificate")


def test_each_expiry_is_warned_about_once_with_file_and_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = made(tmp_path / "keys", timedelta(days=9))
    proves = Credentials("vision", None, folder)
    proves.server()
    proves.client()
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and said[0].startswith(
        f"{folder / 'vision.pem'}: this certificate expires in "
    )
    assert (
        "`petrobot keys --tls keys`" in said[0] and "copy vision.pem and vision.key here" in said[0]
    )
    credentials.look_again(NOW + 8 * DAY)
    assert capsys.readouterr().err == "", "the warning was given before"
    credentials.look_again(NOW + 10 * DAY)
    credentials.look_again(NOW + 11 * DAY)
    assert capsys.readouterr().err.count("this certificate expired on") == 1
    credentials.look_again(NOW - LIFE + CA_LIFE)
    assert "ca.pem: this certificate expires in" in (said := [capsys.readouterr().err])[0]
    assert "make a new authority" in said[0] and "another folder" in said[0]


def test_no_warning_for_certificates_that_last_or_without_certificates(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Credentials("vision", None, made(tmp_path, LIFE)).server()
    Credentials("vision", b"k" * 32).tell_ends()
    assert capsys.readouterr().err == ""


def test_a_certificate_may_be_replaced_while_its_process_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Credentials("vision", None, made(tmp_path, 40 * DAY)).server()
    make_certificates(tmp_path, ["coordinator", "vision"], NOW + 20 * DAY)
    credentials.look_again(NOW + 30 * DAY)
    (tmp_path / "vision.pem").unlink()
    credentials.look_again(NOW + 30 * DAY)
    assert capsys.readouterr().err == ""


def test_the_command_renews_only_certificates_that_expire_soon(tmp_path: Path) -> None:
    folder = made(tmp_path, 20 * DAY, ("vision",))
    make_certificates(folder, ["motion"], NOW - 100 * DAY)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert sorted(make_certificates(folder, ["motion", "vision"], NOW)) == [
        "vision.key",
        "vision.pem",
    ]
    after = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {name for name in after if after[name] != before.get(name)} == {
        "vision.pem",
        "vision.key",
    }
    assert set(after) == set(before), "no temporary file is left"
    assert ends_of(after["vision.pem"].decode()) == NOW + LIFE
    assert (folder / "vision.key").stat().st_mode & 0o777 == 0o600
    assert Credentials("vision", None, folder).server() is not None, (
        "key and certificate belong together"
    )


def test_no_certificate_outlives_its_authority_and_an_expiring_authority_renews_all(
    tmp_path: Path,
) -> None:
    make_certificates(tmp_path, ["vision"], NOW)
    make_certificates(tmp_path, ["motion"], NOW + CA_LIFE - LIFE / 2)
    assert ends_of((tmp_path / "motion.pem").read_text()) == NOW + CA_LIFE
    with pytest.raises(
        CertificateError, match=r"ca\.pem: the authority expires soon.*name of another folder"
    ):
        make_certificates(tmp_path, ["arm"], NOW + CA_LIFE - SOON)
    assert not (tmp_path / "arm.pem").exists()


# --- over real connections --------------------------------------------------------------------


@asynccontextmanager
async def node(folder: Path) -> AsyncIterator[Server]:
    """A node named vision that shows its certificate."""
    server = Server(
        Callee("vision", "v1", {"echo": Offer()}), tls=Credentials("vision", None, folder).server()
    )
    await server.start("127.0.0.1", 0)
    try:
        yield server
    finally:
        await server.close()


async def test_a_long_running_node_checks_every_day(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("petrobot.services.comm.calls.server.DAY", 0.001)
    looked: list[datetime] = []
    again = asyncio.Event()

    def look(now: datetime) -> None:
        looked.append(now)
        if len(looked) == 3:
            again.set()

    monkeypatch.setattr("petrobot.services.comm.calls.server.look_again", look)
    async with asyncio.timeout(60.0), node(made(tmp_path, LIFE)):
        await again.wait()
    assert all(one.tzinfo is not None for one in looked)


@pytest.mark.parametrize(("node_left", "own_left"), [(-DAY, LIFE), (LIFE, -DAY), (2 * LIFE, LIFE)])
async def test_an_expired_or_future_certificate_is_named_as_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], node_left: timedelta, own_left: timedelta
) -> None:
    """The caller is told whichever end's certificate has expired; for its own, with the file."""
    folder = made(tmp_path / "keys", LIFE, ())
    make_certificates(folder, ["vision"], NOW - LIFE + node_left)
    make_certificates(folder, ["coordinator"], NOW - LIFE + own_left)
    async with asyncio.timeout(60.0), node(folder) as server:
        capsys.readouterr()
        proves = Credentials("coordinator", None, folder)
        client = Client(
            *server.address, Caller("vision", HELLO, auto_ack=True), tls=proves.client()
        )
        client.start()
        assert (await client.call("echo")).status == "error"
        await client.close()
    if node_left < own_left:
        assert (
            "the certificate of vision, or that of its authority, has expired; make a new one"
            in client.trouble
        )
    elif node_left > LIFE:
        assert "certificate is not yet valid; set the clock of this" in client.trouble
    else:
        assert "has expired" in client.trouble
        assert (
            f"{folder / 'coordinator.pem'}: this certificate expired on" in capsys.readouterr().err
        )


async def test_nodes_shows_the_expiry_of_the_certificate_in_use(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A certificate renewed on disk but not yet loaded by the running node is still shown as
    expiring."""
    folder = made(tmp_path / "keys", 12 * DAY)
    async with asyncio.timeout(60.0), node(folder) as server:
        make_certificates(folder, ["vision"], NOW)
        places = tmp_path / "services.toml"
        port = server.address[1]
        text = (
            'schema = 1\n[nodes.vision]\nhost = "127.0.0.1"\nport = '
            f'{port}\n[keys]\ncertificates = "keys"\n'
        )
        places.write_text(text, encoding="utf-8")
        server.callee.directory = ""
        answering = asyncio.create_task(_answer(server))
        answer = (await ask_all(parse(text, places), 60.0))["vision"]
        assert datetime.fromisoformat(answer["certificate_ends"]) == NOW + 12 * DAY
        capsys.readouterr()
        asked = ["nodes", "--services", str(places), "--timeout", "30"]
        assert await asyncio.to_thread(main, [*asked, "--json", "-"]) == 0
        shown = json.loads(capsys.readouterr().out)
        assert datetime.fromisoformat(shown["vision"]["certificate_ends"]) == NOW + 12 * DAY
        assert await asyncio.to_thread(main, asked) == 0
        words = capsys.readouterr().out
        assert "certificate" in words and "in 11" in words and "petrobot" in words
        answering.cancel()
        await asyncio.gather(answering, return_exceptions=True)
    shutil.rmtree(folder)


async def _answer(server: Server) -> None:
    """Answer every command like a node without devices."""
    commanded: asyncio.Queue[Any] = asyncio.Queue()

    def take(now: float, orders: list[Order]) -> None:
        for order in orders:
            commanded.put_nowait(order)

    server._on_orders = take
    while True:
        order = await commanded.get()
        server.callee.answer(server.now(), order.command.id, True, {"answers": {}, "devices": {}})
        server.flush()
