"""The OPC UA driver and its actions with a server in a separate process."""

from __future__ import annotations

import contextlib
import datetime
import gc
import ipaddress
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from petrobot import Ports, check_driver, rehearse
from petrobot.services.adapters.opcua.actions import handshake, write
from petrobot.services.adapters.opcua.session import OpcUaSession, _Notifications
from petrobot.services.comm.protocol.plain import plain
from tests.adapters.conftest import SmallRelay
from tests.ports import free_ports
from tests.waiting import PATIENCE_S, Limit

PLC = Path(__file__).with_name("plc.py")
NAMES = ("request", "done", "sensor", "count", "speed", "manner", "level")
NODES = {name: f"ns=2;s=Cell.{name}" for name in NAMES}
LATIN = {"errors": "surrogateescape"}
"""How asyncua decodes text that is not UTF-8."""
ASK: dict[str, Any] = {"request": "request", "acknowledge": "done"}


class Desk:
    """Ports of the driver: files of a folder, events in a list."""

    now = 0.0

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.events: list[tuple[str, Any]] = []

    def raise_event(self, name: str, **data: Any) -> None:
        self.events.append((name, data))

    def file(self, path: str) -> bytes:
        return (self.folder / path).read_bytes()


class Cell:
    """A PLC that can be killed and restarted, and drivers of it."""

    def __init__(self, folder: Path) -> None:
        pytest.importorskip("asyncua")
        self.folder, (self.port,) = folder, free_ports(1)
        self.desk = Desk(folder)
        self.security: tuple[str, ...] = ()
        self.plc: subprocess.Popen[str] | None = None
        self.drivers: list[OpcUaSession] = []

    def power(self, on: bool) -> None:
        if self.plc is not None:
            self.plc.kill()
            self.plc.communicate()
            self.plc = None
        if on:
            command = [sys.executable, "-W", "ignore", str(PLC), str(self.port), *self.security]
            self.plc = subprocess.Popen(
                command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            )
            assert self.plc.stdout is not None and self.plc.stdout.readline() == "ready\n"

    def driver(self, **keys: Any) -> OpcUaSession:
        """A driver that waits long for a server which a busy host keeps from answering; a test of a
        server that does not answer says how long."""
        table = {"url": f"opc.tcp://127.0.0.1:{self.port}", "nodes": NODES, **keys}
        table.setdefault("patience", PATIENCE_S)
        driver = OpcUaSession(table, cast(Ports, self.desk))
        self.drivers.append(driver)
        return driver

    def close(self) -> None:
        try:
            for driver in self.drivers:
                driver.close()
        finally:
            self.power(False)


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Cell]:
    cell = Cell(tmp_path)
    yield cell
    cell.close()


def await_(driver: OpcUaSession, ready: Callable[[Any], object], awaited: str) -> Any:
    limit = Limit(awaited)
    while not ready(driver.state()) and limit.left():
        driver.step(0.0)
        time.sleep(0.005)
    return driver.state()


def complete(state: Any) -> bool:
    return bool(state["up"]) and set(state["values"]) == set(NAMES)


def done(driver: OpcUaSession, values: dict[str, Any]) -> str:
    """Write values; return why that failed, empty if it did not."""
    driver.command(0.0, {"write": values})
    number = driver.state()["asked"]
    state = await_(driver, lambda state: state["done"] >= number, "the write")
    return str(state["write_fault"])


def pace(now: float) -> None:
    time.sleep(0.004)


@pytest.mark.processes
def test_values_writes_events_and_a_restart(cell: Cell, caplog: pytest.LogCaptureFixture) -> None:
    cell.power(True)
    driver = cell.driver(events={"part": {"node": "sensor", "becomes": True}})
    assert not driver.stopped()
    with pytest.raises(ValueError, match="no session yet"):
        driver.command(0.0, {"write": {"count": 1}})
    await_(driver, complete, "all values")
    assert driver.stopped() and driver.state()["faults"] == {}
    written = {"count": 7, "speed": 2, "sensor": True, "manner": "silent", "level": 3}
    assert done(driver, written) == ""
    await_(driver, lambda s: s["values"] | written == s["values"], "the values")
    # a value that does not fit its node is refused by name and type; the session continues
    assert "count: expected Int16" in done(driver, {"count": 70000})
    assert "count: expected Int16" in done(driver, {"count": "seven"})
    assert "count: expected Int16" in done(driver, {"count": None})
    assert "sensor: expected Boolean" in done(driver, {"sensor": "false"})  # not True
    assert "level: expected Double" in done(driver, {"level": "high"})  # declared as Number
    assert done(driver, {"sensor": False}) == "" and done(driver, {"sensor": True}) == ""
    limit = Limit("two events")
    while len(cell.desk.events) < 2 and limit.left():
        driver.step(0.0)
    assert cell.desk.events == [("part", {"value": True})] * 2
    cell.power(False)
    state = await_(driver, lambda state: not state["up"], "the lost link")
    assert not driver.stopped() and state["values"] == {} and "trying again" in str(state["faults"])
    with pytest.raises(ValueError, match="trying again"):
        driver.command(0.0, {"write": {"count": 1}})
    cell.power(True)
    await_(driver, complete, "the values after the restart")
    assert done(driver, {"count": 1}) == "" and len(cell.desk.events) == 2
    lines = [record.getMessage() for record in caplog.records if record.name != "asyncio"]
    assert lines and all(line.startswith("no connection to the device") for line in lines)


@pytest.mark.processes
def test_a_handshake_and_its_errors(cell: Cell) -> None:
    cell.power(True)
    driver = cell.driver(on_stop={"request": False})
    await_(driver, complete, "all values")

    def played(world: Callable[[float], None] = pace, **more: Any) -> tuple[str, str]:
        found = rehearse(handshake, device=driver, world=world, limit=20.0, **ASK, **more)
        return found.result.status, found.result.cause

    def played_to_the_end(**more: Any) -> tuple[str, str]:
        """The clock stands until the PLC has acknowledged: its answer is never late."""
        request = driver.state()["asked"] + 1

        def answered(now: float) -> None:
            pace(now)
            if driver.state()["asked"] == request:
                await_(driver, lambda s: s["values"].get("done") is True, "the acknowledgement")

        return played(answered, **more)

    def request_is(value: bool) -> None:
        await_(driver, lambda state: state["values"]["request"] is value, f"request = {value}")

    assert played() == ("success", "")
    assert done(driver, {"manner": "silent"}) == ""
    assert played(timeout=0.3) == ("error", "not_acknowledged")
    request_is(False)
    assert played(cancel_after=0.3) == ("error", "cancelled")
    request_is(False)
    assert done(driver, {"manner": "blind"}) == ""
    # nobody knows whether it has ended
    assert played_to_the_end(timeout=0.5) == ("error", "not_withdrawn")
    await_(driver, lambda state: "done" in state["faults"], "the bad status")
    number = driver.state()["asked"]
    assert played(timeout=0.5) == ("error", "not_acknowledged")  # nor whether it would be new
    assert driver.state()["asked"] == number
    assert done(driver, {"manner": "good"}) == ""
    await_(driver, complete, "all values")
    assert done(driver, {"manner": "stuck"}) == ""
    assert played_to_the_end(timeout=0.5) == ("error", "not_withdrawn")
    assert played() == ("error", "already_acknowledged")
    late = cell.driver(interval=0.5)  # the values come some time after the session
    await_(late, lambda state: state["up"], "a session")
    found = rehearse(handshake, device=late, world=pace, limit=20.0, **ASK)
    assert found.result.cause == "already_acknowledged" and late.state()["asked"] == 0
    assert done(driver, {"request": True}) == ""
    request_is(True)
    assert not driver.stopped()
    driver.stop(0.0)
    await_(driver, lambda _: driver.stopped(), "the standstill")
    assert driver.state()["values"]["request"] is False
    assert done(driver, {"manner": "silent", "done": False}) == ""
    await_(driver, lambda state: state["values"]["done"] is False, "done = False")

    def spoil(now: float) -> None:
        pace(now)
        if now == 0.4:
            driver.command(0.0, {"write": {"manner": "bad"}})
            await_(driver, lambda state: "speed" in state["faults"], "the bad status")

    table: dict[str, Any] = {
        "request": "count",
        "value": 1,
        "idle": 0,
        "acknowledge": "speed",
        "expect": 9.0,
    }
    found = rehearse(handshake, device=driver, world=spoil, limit=20.0, timeout=1.0, **table)
    assert found.result.cause == "not_acknowledged" and "BadSensor" in found.result.text
    assert done(driver, {"manner": "silent"}) == ""

    def pull(now: float) -> None:
        pace(now)
        if now == 0.4:
            cell.power(False)

    found = rehearse(handshake, device=driver, world=pull, limit=20.0, timeout=15.0, **ASK)
    assert (found.result.status, found.result.cause) == ("error", "link_lost")


@pytest.mark.processes
def test_a_stop_without_a_session_is_made_up_for(cell: Cell) -> None:
    driver = cell.driver(on_stop={"count": 7})
    driver.stop(0.0)
    cell.power(True)
    state = await_(driver, lambda _: driver.stopped(), "the standstill")
    assert state["values"]["count"] == 7 and state["done"] == 1


@pytest.mark.processes
def test_a_stop_that_a_frozen_server_has_not_taken_is_repeated(cell: Cell) -> None:
    cell.power(True)
    assert cell.plc is not None
    driver = cell.driver(on_stop={"request": False, "count": 7}, patience=3.0)
    await_(driver, complete, "all values")
    assert done(driver, {"count": 7}) == "" and await_(
        driver, lambda state: state["values"]["count"] == 7, "the value"
    )
    assert driver.stopped()
    cell.plc.send_signal(signal.SIGSTOP)
    driver.command(0.0, {"write": {"request": True}})
    driver.stop(0.0)
    assert not driver.stopped()  # the server still has to take both writes
    state = await_(driver, lambda state: not state["up"], "the loss")
    assert "it does not answer" in state["faults"]["session"]
    assert "unknown whether" in state["write_fault"] and not driver.stopped()
    cell.power(True)
    state = await_(driver, lambda _: driver.stopped(), "the standstill")
    assert state["values"]["count"] == 7


@pytest.mark.processes
def test_a_write_over_a_lost_link_never_comes_late(cell: Cell, relay: SmallRelay) -> None:
    """Else a server would get it after `on_stop`, which the next session writes."""
    cell.power(True)
    relay.begin(cell.port)
    driver = cell.driver(url=f"opc.tcp://127.0.0.1:{relay.port}", patience=3.0)
    await_(driver, complete, "all values")
    relay.stall()
    driver.command(0.0, {"write": {"manner": 30_000 * "x" + "last"}})
    await_(driver, lambda state: not state["up"], "the loss")
    driver.close()
    received = relay.read()
    assert b"xxx" in received and b"last" not in received


@pytest.mark.processes
def test_it_keeps_the_rules_of_drivers(cell: Cell) -> None:
    cell.power(True)
    found = check_driver(cell.driver, cable=cell.power, within=10.0, seconds=30.0)
    late = [fault for fault in found.faults if "took longer than the period" in fault]
    assert found.faults == late  # a busy host delays a step; none of its steps waits


def test_values_of_any_type_are_plain(cell: Cell) -> None:
    """A list of dates would make the state one that cannot be published, and break the driver."""
    driver = cell.driver()
    heard = _Notifications(driver._session, 1000)
    heard.names["node"] = ["count"]
    dates = [datetime.datetime(2026, 11, 23), [datetime.datetime(2026, 11, 24)], 3]
    item = SimpleNamespace(Value=SimpleNamespace(StatusCode=None))
    data = SimpleNamespace(monitored_item=item)
    heard.datachange_notification(SimpleNamespace(nodeid="node"), dates, data)
    driver.step(0.0)
    told = plain(driver.values)["count"]
    assert told == ["2026-11-23 00:00:00", ["2026-11-24 00:00:00"], 3]
    heard.datachange_notification(SimpleNamespace(nodeid="node"), b"F\xfcll".decode(**LATIN), data)
    driver.step(0.0)
    assert plain(driver.values)["count"] == "F?ll"
    heard.datachange_notification(SimpleNamespace(nodeid="node"), None, data)
    driver.step(0.0)
    assert "no value" in driver.state()["faults"]["count"] and not driver.values
    heard.datachange_notification(SimpleNamespace(nodeid="node"), "x" * 1001, data)
    driver.step(0.0)
    assert "longer than 1000" in driver.state()["faults"]["count"] and not driver.values
    heard.datachange_notification(SimpleNamespace(nodeid="node"), [1.0, float("nan")], data)
    driver.step(0.0)
    assert "NaN" in driver.state()["faults"]["count"] and not driver.values


@pytest.mark.processes
def test_a_node_without_a_value_or_a_known_type_at_first(cell: Cell) -> None:
    """As while a PLC starts, and on a server that does not show its own data types."""
    cell.power(True)
    nodes = {name: f"ns=2;s=Cell.{name}" for name in ("manner", "early", "foreign")}
    driver = cell.driver(nodes=nodes)
    state = await_(driver, lambda state: "foreign" in state["values"], "the first values")
    assert state["values"]["foreign"] == 7
    assert "WaitingForInitialData" in state["faults"]["early"]
    assert "early: its type is unknown" in done(driver, {"early": 4})
    assert done(driver, {"manner": "begun"}) == ""
    state = await_(driver, lambda state: state["values"].get("early") == 3, "the value")
    assert state["faults"] == {} and done(driver, {"early": 4}) == ""


@pytest.mark.processes
def test_two_names_of_one_node(cell: Cell) -> None:
    cell.power(True)
    nodes = {"part": NODES["sensor"], "stop": NODES["sensor"]}
    events = {name: {"node": name, "becomes": True} for name in nodes}
    driver = cell.driver(nodes=nodes, events=events)
    await_(driver, lambda state: len(state["values"]) == 2, "both values")
    assert done(driver, {"part": True}) == ""
    await_(driver, lambda state: [*state["values"].values()] == [True, True], "both changes")
    assert sorted(name for name, _ in cell.desk.events) == ["part", "stop"]


@pytest.mark.processes
def test_in_a_dry_run_nothing_is_written(cell: Cell) -> None:
    cell.power(True)
    driver = cell.driver(dry_run=True, on_stop={"count": 7})
    before = await_(driver, complete, "all values")["values"]["count"]
    assert done(driver, {"count": before + 1}) == ""
    driver.stop(0.0)
    assert driver.stopped()
    other = cell.driver()
    assert await_(other, complete, "all values")["values"]["count"] == before


@pytest.mark.processes
def test_a_wrong_node_is_named_and_the_others_work(cell: Cell) -> None:
    cell.power(True)
    wrong = {"lost": "ns=2;s=Cell.lost", "odd": "Cell.odd", "far": "nsu=urn:far;s=Cell.count"}
    driver = cell.driver(nodes={**NODES, "count": "nsu=urn:test;s=Cell.count", **wrong})
    state = await_(driver, complete, "all values")
    assert set(state["faults"]) == set(wrong) and "ns=2;s=Cell.lost" in state["faults"]["lost"]
    assert done(driver, {"count": 3}) == "" and "lost: " in done(driver, {"lost": 1})
    ask = {**ASK, "acknowledge": "lost"}
    result = rehearse(handshake, device=driver, world=pace, **ask).result
    assert result.cause == "not_acknowledged" and "nothing was requested" in result.text
    result = rehearse(write, device=driver, world=pace, values={"count": 1.5}).result
    assert (result.status, result.cause) == ("error", "write_failed")


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"url": "opc.tcp://192.0.2.7:4840"}, "another host, and .* insecure = true"),
        ({"url": "opc.tcp://plc.example:4840"}, "another host"),
        ({"url": "http://127.0.0.1"}, "expected opc.tcp"),
        ({"certificate": "me.der"}, "private_key and server_certificate"),
        ({"events": {"part": {"node": "sensor"}}}, r"events\.part: is missing \['becomes'\]"),
        ({"on_stop": {"nothing": 0}}, "no node 'nothing'"),
    ],
)
def test_wrong_keys_are_refused(tmp_path: Path, keys: dict[str, Any], words: str) -> None:
    table = {"url": "opc.tcp://127.0.0.1:1", "nodes": NODES, **keys}
    with pytest.raises(ValueError, match=words):
        OpcUaSession(table, cast(Ports, Desk(tmp_path)))


@pytest.mark.parametrize("body", [{"dance": 1}, {"write": {}}, {"write": {"nothing": 1}}])
def test_an_unknown_command_is_refused(cell: Cell, body: Any) -> None:
    with pytest.raises(ValueError, match=r"expected|no node"):
        cell.driver().command(0.0, body)


def certificate(folder: Path, name: str, uri: str, days: int = 9) -> None:
    """Write NAME.der, valid for so many days since yesterday, and NAME.pem (its key)."""
    x509 = pytest.importorskip("cryptography.x509")
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import rsa

    key = rsa.generate_private_key(65537, 2048)
    who = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    begin = datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=1)
    other = [
        x509.UniformResourceIdentifier(uri),
        x509.IPAddress(ipaddress.ip_address("127.0.0.1")),
    ]
    usage = x509.KeyUsage(True, True, True, True, False, True, False, False, False)
    ends = x509.ExtendedKeyUsage(
        [x509.ExtendedKeyUsageOID.CLIENT_AUTH, x509.ExtendedKeyUsageOID.SERVER_AUTH]
    )
    made = x509.CertificateBuilder(who, who, key.public_key(), x509.random_serial_number())
    made = made.not_valid_before(begin).not_valid_after(begin + datetime.timedelta(days))
    for extension in (x509.SubjectAlternativeName(other), usage, ends):
        made = made.add_extension(extension, critical=False)
    signed = made.sign(key, hashes.SHA256())
    (folder / f"{name}.der").write_bytes(signed.public_bytes(serialization.Encoding.DER))
    (folder / f"{name}.pem").write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )


@pytest.fixture
def keys(cell: Cell) -> dict[str, Any]:
    """A PLC that wants certificates and a login, and the keys of a driver that it accepts."""
    folder = cell.folder
    for name in ("plc", "me", "stranger", "old"):
        certificate(folder, name, "urn:mine", days=1 if name == "old" else 9)
    (folder / "trusted").mkdir()
    for name in ("me", "old"):
        (folder / "trusted" / f"{name}.der").write_bytes((folder / f"{name}.der").read_bytes())
    (folder / "password").write_text("geheim77\n")
    (folder / "wrong").write_text("falsch77\n")
    (folder / "empty").write_text("\n")
    plc = [str(folder / name) for name in ("plc.der", "plc.pem", "trusted")]
    cell.security = (*plc, "anna", "geheim77")
    own = {"certificate": "me.der", "private_key": "me.pem", "server_certificate": "plc.der"}
    return {**own, "user": "anna", "password_file": "password"}


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"user": "", "password_file": ""}, "user: .*write user and password_file"),
    ({"password_file": "wrong"}, "user: .*'anna' with the password in wrong"),
    ({"user": "otto"}, "user: .*'otto' with the password in password"),
    ({"certificate": "stranger.der", "private_key": "stranger.pem"}, "certificate: .*stranger.der"),
    ({"certificate": "old.der", "private_key": "old.pem"}, "certificate: old.der is valid from"),
    ({"server_certificate": "stranger.der"}, "server_certificate: stranger.der is not that of"),
    ({"certificate": ""}, "certificate: the server offers only Basic256Sha256 SignAndEncrypt, and"),
]


@pytest.mark.processes
def test_a_secured_server_says_what_it_does_not_accept(
    cell: Cell, keys: dict[str, Any], caplog: pytest.LogCaptureFixture
) -> None:
    """Each wrong certificate or login is one message with the key that is wrong, and no secret."""
    cell.power(True)
    trusted = cell.driver(**keys)
    await_(trusted, complete, "all values")
    assert done(trusted, {"count": 2}) == ""
    drivers = [(cell.driver(**{**keys, **wrong}), words) for wrong, words in REFUSED]
    for driver, words in drivers:
        state = await_(driver, lambda state: "trying again" in str(state["faults"]), words)
        assert not state["up"] and re.search(words, state["faults"]["session"]), state["faults"]
        assert "geheim77" not in str(state) and "falsch77" not in str(state)
    assert "geheim77" not in caplog.text and "falsch77" not in caplog.text
    lines = [record for record in caplog.records if record.name.startswith("asyncua")]
    assert [line for line in lines if "no longer valid" not in line.message] == []


@pytest.mark.processes
def test_an_open_server_that_should_be_secured(cell: Cell, keys: dict[str, Any]) -> None:
    cell.security = ()
    cell.power(True)
    driver = cell.driver(**keys)
    state = await_(driver, lambda state: "trying again" in str(state["faults"]), "the refusal")
    assert "offers only None None, and not Basic256Sha256" in state["faults"]["session"]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (
            {"certificate": "password"},
            "certificate: expected a certificate .*password is",
        ),
        ({"private_key": "me.der"}, "private_key: expected a key"),
        ({"private_key": "stranger.pem"}, "private_key: stranger.pem is not that of me.der"),
        ({"application_uri": "urn:other"}, r"expected that of me.der \(urn:mine\), found"),
        ({"password_file": ""}, "user: write user and password_file"),
        ({"user": ""}, "user: write user and password_file"),
        ({"password_file": "empty"}, "password_file: empty is empty"),
        ({"url": "opc.tcp://anna:geheim77@127.0.0.1:1"}, "url: expected no login"),
    ],
)
def test_keys_that_do_not_fit_are_refused_at_the_start(
    cell: Cell, keys: dict[str, Any], wrong: dict[str, str], words: str
) -> None:
    with pytest.raises(ValueError, match=words) as refused:
        cell.driver(**{**keys, **wrong})
    assert "geheim77" not in str(refused.value)


@pytest.mark.processes
def test_nodes_of_another_type_and_nodes_that_are_gone(cell: Cell) -> None:
    cell.power(True)
    driver = cell.driver()
    await_(driver, complete, "all values")
    assert done(driver, {"manner": "retyped"}) == ""
    limit, fault = Limit("the new node"), ""
    while "changed" not in fault and limit.left():
        fault = done(driver, {"count": 7})
    assert fault.startswith("count: ") and "nodes of the server have changed" in fault
    await_(driver, lambda state: not state["up"], "the end of the session")
    await_(driver, complete, "all values")
    assert driver.state()["values"]["count"] == "none"
    assert "count: expected String" in done(driver, {"count": 7})
    assert done(driver, {"count": "seven", "manner": "gone"}) == ""
    limit, fault = Limit("the loss"), ""
    while "changed" not in fault and limit.left():
        fault = done(driver, {"count": "eight"})
    await_(driver, lambda state: not state["up"], "the end of the session")
    state = await_(driver, lambda state: state["up"], "its successor")
    assert "Bad" in state["faults"].get("count", ""), (fault, state)
    assert done(driver, {"sensor": True}) == ""


@pytest.mark.processes
def test_what_comes_after_a_lost_subscription_is_new(cell: Cell) -> None:
    cell.power(True)
    driver = cell.driver()
    await_(driver, complete, "all values")
    driver.command(0.0, {"write": {"manner": "forgotten"}})
    driver.patience = 2.0  # of this subscription; for answers it is that of the session's begin

    def lost(state: Any) -> bool:
        if state["up"] and state["done"] == state["asked"]:  # writes do not hide the loss
            driver.command(0.0, {"write": {"sensor": True}})
        return not state["up"]

    state = await_(driver, lost, "the loss")
    assert "no longer serves the subscription" in state["faults"]["session"]
    assert state["values"] == {}
    driver.patience = PATIENCE_S
    await_(driver, complete, "all values")
    assert done(driver, {"count": 9}) == ""
    await_(driver, lambda state: state["values"]["count"] == 9, "the new value")


@pytest.mark.processes
def test_a_subscription_that_the_server_ends_is_lost_at_once(cell: Cell) -> None:
    cell.power(True)
    driver = cell.driver(patience=10 * PATIENCE_S)
    await_(driver, complete, "all values")
    driver.command(0.0, {"write": {"manner": "ended"}})
    state = await_(driver, lambda state: not state["up"], "the loss")
    assert "no longer serves the subscription" in state["faults"]["session"]
    await_(driver, complete, "all values")


@pytest.mark.processes
def test_a_node_without_a_good_value_is_a_fault_of_its_name(cell: Cell) -> None:
    cell.power(True)
    driver = cell.driver()
    await_(driver, complete, "all values")
    driver.command(0.0, {"write": {"manner": "bad"}})
    state = await_(driver, lambda state: "speed" in state["faults"], "the fault")
    assert "BadSensorFailure" in state["faults"]["speed"] and "speed" not in state["values"]
    assert state["up"] and done(driver, {"speed": 2.5}) == ""
    state = await_(driver, lambda state: "speed" in state["values"], "a good value again")
    assert state["faults"] == {}


@pytest.mark.processes
def test_a_driver_that_is_closed_while_it_connects_leaves_no_socket_open(cell: Cell) -> None:
    with socket.create_server(("127.0.0.1", cell.port)) as listener:
        listener.settimeout(PATIENCE_S)
        driver = cell.driver(patience=PATIENCE_S)
        other, _ = listener.accept()
        with other:
            other.settimeout(PATIENCE_S)
            assert other.recv(4) == b"HELF"
            gc.disable()  # it would close the socket, at some time
            try:
                driver.close()
                limit = Limit("the end of the connection")
                with contextlib.suppress(ConnectionResetError):
                    while limit.left() and other.recv(1 << 16):
                        pass
            finally:
                gc.enable()
