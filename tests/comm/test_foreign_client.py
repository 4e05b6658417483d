"""docs/protocol.md suffices to write a client: one written from the page alone, against real node
processes.

The location file is a real one, read by `python -m petrobot.services`: a node with the global
memory, actions in worker processes, a device that takes a set-point stream, and a timer; once on
loopback without, once with a shared key.
"""

from __future__ import annotations

import itertools
import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec import Struct

from tests.comm import foreign as f
from tests.comm.foreign import Foreign, pack
from tests.ports import free_ports
from tests.waiting import Limit

pytestmark = pytest.mark.processes
ROOT = Path(__file__).parents[2]
ASKED = itertools.count()
PLACES = """\
schema = 1
[nodes.hub]
host = "127.0.0.1"
port = {port}
[devices.slide]
node = "hub"
driver = "toy_cell.drivers:Slide"
period = 0.02
speed = 4.0
[streams.points]
to = "slide"
period = 0.02
[timers.beat]
node = "hub"
period = 0.02
[services.memory]
node = "hub"
[actions]
go = {{ run = "toy_cell.actions:go", task = "move", device = "slide" }}
follow = {{ run = "toy_cell.actions:follow", task = "move", device = "slide" }}
add = {{ run = "toy_cell.actions:add", task = "sum", node = "hub" }}
nap = {{ run = "toy_cell.actions:nap", task = "sum", node = "hub" }}
"""


class Hub(Struct):
    """A node process."""

    address: tuple[str, int]
    key: bytes | None
    opened: list[Foreign]
    count: int = 0

    def knock(self) -> Foreign:
        """Open a connection and send nothing."""
        self.opened.append(Foreign(self.address, self.key))
        return self.opened[-1]

    def coordinator(self, name: str = "") -> Foreign:
        """Open a connection as a new coordinator, up to WELCOME."""
        self.count += 1
        client = self.knock()
        assert client.open("coordinator", name or f"foreign{self.count}", epoch=1)[0] == f.WELCOME
        return client


def launched(folder: Path, key: bytes | None) -> tuple[subprocess.Popen[str], tuple[str, int]]:
    """Launch the node and wait until it is ready."""
    [port] = free_ports(1)
    text = PLACES.format(port=port)
    if key is not None:
        file = folder / "cell.key"
        file.touch(0o600)
        file.write_text(key.hex() + "\n")
        text += '[keys]\nfile = "cell.key"\n'
    (folder / "services.toml").write_text(text, encoding="utf-8")
    path = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "node" / "outside")])
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "petrobot.services",
            "hub",
            "--services",
            str(folder / "services.toml"),
        ],
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": path},
    )
    assert process.stdout is not None
    assert "ready" in process.stdout.readline()
    return process, ("127.0.0.1", port)


@pytest.fixture(scope="module", params=[None, bytes(range(32))], ids=["no key", "shared key"])
def process(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Hub]:
    """A node that all tests of this file share."""
    node, address = launched(tmp_path_factory.mktemp("hub"), request.param)
    yield Hub(address, request.param, [])
    node.terminate()
    node.communicate(timeout=60.0)


@pytest.fixture
def hub(process: Hub) -> Iterator[Hub]:
    """The same node; its connections are closed after each test."""
    yield process
    for one in process.opened:
        one.close()
    process.opened.clear()


def result_of(
    client: Foreign, id_: str, service: str, arguments: dict[str, Any], *more: Any
) -> list[Any]:
    """Send CALL, receive RESULT and acknowledge it; return the result."""
    client.say(f.CALL, id_, service, arguments, *more)
    result = client.expect(f.RESULT, id_)
    client.say(f.RESULT_ACK, id_)
    return result


def slide_of(client: Foreign) -> dict[str, Any]:
    """Ask for the state of the slide. On a busy host its process may be late: the answer says so,
    and the slide is asked again."""
    limit = Limit("the state of the slide")
    while True:
        limit.left()
        id_ = f"status {next(ASKED)}"
        client.say(f.COMMAND, id_, "status")
        _, _, ok, data = client.expect(f.ANSWER, id_)
        if ok:
            state: dict[str, Any] = data["devices"]["slide"]["state"]
            return state


def test_the_example_bytes_of_the_page() -> None:
    """A client with its own msgpack makes both examples."""
    client = Foreign.__new__(Foreign)
    client.seal_out, client.is_open = b"", True
    assert client.frame(pack((f.PING, 1))) == bytes.fromhex("00000007 92 0f 01 f1 49 99 d5")
    call = client.frame(pack((f.CALL, "c1", "track", {"t": 1.5}, 2.0, 3, "b1", "p0", 7)))
    page = (
        (ROOT / "docs" / "protocol.md")
        .read_text(encoding="utf-8")
        .split("parent `p0`, seed 7:\n```\n")[1]
    )
    shown = [line.partition("  ")[0] for line in page.split("```")[0].splitlines()]
    assert call == bytes.fromhex(" ".join(shown))


def test_hello_and_welcome(hub: Hub) -> None:
    client = hub.knock()
    _, version, name, boot, offers, runs, directory, auth = client.open("client", "guest")
    assert (version, name, runs) == (2, "hub", []) and boot and len(directory) > 8
    assert {"go", "add", "nap", "memory.get", "memory.put", "stream:points"} <= set(offers)
    assert len(auth) == (4 if hub.key is None else 32)


def test_a_service_answered_at_once_sends_a_result_without_accept(hub: Hub) -> None:
    client = hub.coordinator()
    name = f"at {hub.count}"
    client.say(
        f.CALL,
        f"{name}/1",
        "memory.put",
        {"name": name, "value": [1, 2.5, b"b", None, {"x": True}]},
        1.0,
        1,
    )
    kind, id_, status, values, cause, text, executed, seconds, cpu = client.hear()
    assert (kind, id_, status, values, cause, text, executed) == (
        f.RESULT, f"{name}/1", "success", {"version": 1}, "", "", "yes",
    )  # fmt: skip
    assert seconds >= 0.0 and cpu >= 0.0
    found = result_of(client, f"{name}/2", "memory.get", {"name": name}, None, 1)
    assert found[3] == {"value": [1, 2.5, b"b", None, {"x": True}], "version": 1}
    client.say(f.BYE)


def test_an_action_accept_result_and_at_most_once(hub: Hub) -> None:
    """A CALL with a known id gets its stored result, or `forgotten` after that was acknowledged."""
    client = hub.coordinator()
    id_ = f"once {hub.count}"
    client.say(f.CALL, id_, "add", {"a": 2, "b": 3}, 60.0, 1)
    first = client.hear()
    if first == [f.ACCEPT, id_]:  # ACCEPT is left out if the result comes within 2 ms.
        first = client.hear()
    assert first[:4] == [f.RESULT, id_, "success", {"sum": 5}]
    client.say(f.CALL, id_, "add", {"a": 2, "b": 3}, 60.0, 1)
    assert client.hear() == first, "the same result, the seconds that it took included"
    client.say(f.RESULT_ACK, id_, ["another"])
    client.say(f.CALL, id_, "add", {"a": 2, "b": 3}, 60.0, 1)
    assert client.hear()[2:7:2] == ["error", "forgotten", "unknown"]


def test_results_lost_with_the_link_are_listed_and_sent_again(hub: Hub) -> None:
    """WELCOME names the runs that are active or not acknowledged; the same CALL gets ACCEPT or the
    result."""
    client = hub.coordinator()
    name = f"foreign{hub.count}"
    client.say(f.CALL, f"{name}/done", "add", {"a": 1}, 60.0, 1)
    client.expect(f.RESULT, f"{name}/done")
    client.say(f.CALL, f"{name}/on", "nap", {"seconds": 0.4}, 60.0, 1)
    client.expect(f.ACCEPT, f"{name}/on")
    client.close()
    again = hub.knock()
    runs = again.open("coordinator", name, epoch=1)[5]
    assert set(runs) == {f"{name}/done", f"{name}/on"}
    again.say(f.CALL, f"{name}/on", "nap", {"seconds": 0.4}, 60.0, 1)
    assert again.expect(f.RESULT, f"{name}/on")[3] == {"slept": 0.4}
    again.say(f.CALL, f"{name}/done", "add", {"a": 1}, 60.0, 1)
    assert again.expect(f.RESULT, f"{name}/done")[3] == {"sum": 2}


def test_cancel_and_deadline(hub: Hub) -> None:
    """CANCEL always leads to a RESULT; if it arrives before its CALL, the CALL is not started."""
    client = hub.coordinator()
    name = f"foreign{hub.count}"
    client.say(f.CALL, f"{name}/1", "nap", {"seconds": 30.0}, 60.0, 1)
    client.expect(f.ACCEPT, f"{name}/1")
    client.say(f.CANCEL, f"{name}/1", "no more")
    result = client.expect(f.RESULT, f"{name}/1")
    assert result[2:5:2] == ["error", "cancelled"] and result[6] in ("yes", "no"), (
        "it may not have begun in its worker yet"
    )
    client.say(f.CANCEL, f"{name}/2")
    assert client.expect(f.RESULT, f"{name}/2")[2:7:2] == ["error", "cancelled", "no"]
    client.say(f.CALL, f"{name}/2", "nap", {"seconds": 30.0}, 60.0, 1)
    assert client.expect(f.RESULT, f"{name}/2")[2:7:2] == ["error", "cancelled", "no"]
    client.say(f.CALL, f"{name}/3", "nap", {"seconds": 30.0}, 0.5, 1)
    result = client.expect(f.RESULT, f"{name}/3")
    assert result[2:5:2] == ["error", "deadline"] and result[6] in ("yes", "no"), "as above"


@pytest.mark.parametrize(
    ("service", "more", "cause", "executed"),
    [
        ("no_such", (None, 1), "unknown_service", "no"),
        ("add", (None, 0), "old_epoch", "no"),
        ("add", (1.0, 1, "another boot"), "rebooted", "unknown"),
    ],
)
def test_a_refusal_is_a_result(
    hub: Hub, service: str, more: tuple[Any, ...], cause: str, executed: str
) -> None:
    client = hub.coordinator()
    result = result_of(client, f"{cause} {hub.count}", service, {"a": 1}, *more)
    assert result[2:7:2] == ["error", cause, executed] and result[5]


def test_one_caller_at_a_time_holds_a_device(hub: Hub) -> None:
    """BYE releases the lease; until then the node accepts no orders of other callers."""
    first = hub.coordinator()
    assert result_of(first, f"lease {hub.count}", "go", {"to": 0.0}, 60.0, 1)[2] == "success"
    second = hub.coordinator()  # not before: it would be silent while the other one waits
    assert (
        result_of(second, f"lease {hub.count}b", "go", {"to": 0.0}, 60.0, 1)[4] == "device_leased"
    )
    first.say(f.BYE, "enough")
    assert first.socket.recv(1) == b"", "the node hangs up, too"
    assert result_of(second, f"lease {hub.count}c", "go", {"to": 0.0}, 60.0, 1)[2] == "success"
    second.say(f.BYE)


def test_heartbeats(hub: Hub) -> None:
    """PING is answered; the node sends PING to a silent client, and disconnects it if it stays
    silent."""
    client = hub.coordinator()
    client.say(f.PING, 2**63 - 1)
    message, limit = f.unpack(client.body()), Limit("the PONG")
    while message[0] == f.PING and limit.left():  # on a busy host we were silent before
        message = f.unpack(client.body())
    assert message == [f.PONG, 2**63 - 1]
    assert f.unpack(client.body())[0] == f.PING
    with pytest.raises(ConnectionError):
        while True:
            assert f.unpack(client.body())[0] == f.PING


def test_events_and_commands(hub: Hub) -> None:
    """Pulses of a timer, latched events of the memory, which are sent until acknowledged, and a
    command with its answer."""
    client = hub.coordinator()
    name = f"value {hub.count}"
    client.say(f.SUBSCRIBE, ["beat"])
    assert client.expect(f.EVENT, "beat")[3] == 0
    assert "position" in slide_of(client)
    client.say(f.COMMAND, "c2", "stop", "slide")
    assert client.expect(f.ANSWER, "c2")[3]["answers"]["slide"] in ("stopped", "stopping")
    client.say(f.SUBSCRIBE, [f"memory:{name}"])
    result_of(client, f"put {name}", "memory.put", {"name": name, "value": 1}, None, 1)
    event = client.expect(f.EVENT, f"memory:{name}")
    assert event[3] > 0 and event[4]["value"] == 1
    client.say(f.EVENT_ACK, event[2], event[3])


def test_set_points(hub: Hub) -> None:
    """The service of the stream returns address and ticket; the device follows the set points and
    stops at WITHDRAW."""
    client = hub.coordinator()
    there = result_of(client, f"stream {hub.count}", "stream:points", {}, None, 1)[3]
    stream = Foreign((there["host"], there["port"]), hub.key)
    hub.opened.append(stream)
    assert stream.open("stream", "hub", node="slide")[0] == f.WELCOME
    stream.say(f.STREAM_OPEN, "points", 0.02, there["ticket"])
    before = slide_of(client)
    client.say(f.CALL, f"follow {hub.count}", "follow", {"seconds": 2.0}, 60.0, 1)
    begun, number, slide = time.monotonic(), 0, before
    limit = Limit("the slide follows")
    while (slide["count"] <= 5 or slide["position"] == before["position"]) and limit.left():
        number += 1
        passed = time.monotonic() - begun
        stream.say(f.SET_POINT, number, [0.2 * min(number, 25) / 25], 0.0, passed)
        due = begun + 0.02 * number
        while (left := due - time.monotonic()) > 0:
            stream.socket.settimeout(max(left, 1e-4))
            try:
                stream.hear()
            except TimeoutError:
                continue
        slide = slide_of(client)
    stream.say(f.WITHDRAW)
    end = client.expect(f.RESULT, f"follow {hub.count}")
    assert end[2] == "success" and end[3]["count"] > 5
    assert end[3]["position"] not in (0.0, before["position"])
    client.say(f.BYE)


# --- violations of the protocol ---------------------------------------------------------------


OPENING: list[tuple[str, Callable[[Foreign], None]]] = [
    ("malformed", lambda one: one.raw(one.frame(pack((f.HELLO, 2, 2, "client", "bad"))))),
    ("malformed", lambda one: one.raw(bytes.fromhex("00000001 91"))),
    ("unknown_kind", lambda one: one.raw(one.frame(pack((77, 1))))),
    ("unknown_kind", lambda one: one.raw(bytes.fromhex("00000002 dc 00"))),
    ("out_of_turn", lambda one: one.raw(one.frame(pack((f.CALL, "1", "add"))))),
    ("too_large", lambda one: one.raw(bytes.fromhex("00001001 99 01"))),
]
OPEN: list[tuple[str, Callable[[Foreign], None]]] = [
    ("malformed", lambda one: one.say(f.CALL, 1, "add")),
    ("malformed", lambda one: one.say(f.CALL, "x" * 256, "add")),
    ("malformed", lambda one: one.say(f.CALL, "1", "add", {}, -1.0)),
    ("malformed", lambda one: one.say(f.CALL, "1", "add", {}, float("nan"))),
    ("malformed", lambda one: one.say(f.CALL, "1", "add", {}, None, 2**63)),
    ("malformed", lambda one: one.say(f.CALL, "1", "add", {}, None, 0, "", "", 0, 0)),
    ("malformed", lambda one: one.raw(one.frame(b"\x94\x04\xa11\xa3add\x81\x01\x01"))),
    ("malformed", lambda one: one.raw(one.frame(b"\x94\x04\xa11\xa3add\x81\xc4\x01a\x01"))),
    (
        "malformed",
        lambda one: one.raw(one.frame(b"\x94\x04\xa11\xa3add\x81\xa1t\xd6\xff\x00\x00\x00\x01")),
    ),
    (
        "malformed",
        lambda one: one.raw(one.frame(b"\x94\x04\xa11\xa3add\x81\xa1x" + b"\x91" * 33 + b"\xc0")),
    ),
    ("malformed", lambda one: one.raw(one.frame(pack((f.PING, 1)) + b"\xc0"))),
    (
        "too_large",
        lambda one: one.raw(struct.pack(">I", 33 + (16 if one.key else 4)) + b"\x92\x0f"),
    ),
    ("unknown_kind", lambda one: one.say(0)),
    ("out_of_turn", lambda one: one.say(f.RESULT, "1", "success")),
    ("out_of_turn", lambda one: one.say(f.HELLO, 2, 2, "client", "x", "y")),
]


@pytest.mark.parametrize(
    ("code", "do"), OPENING, ids=lambda value: value if isinstance(value, str) else ""
)
def test_a_bad_frame_during_the_handshake_is_refused_with_its_code(
    hub: Hub, code: str, do: Callable[[Foreign], None]
) -> None:
    client = hub.knock()
    do(client)
    assert f.unpack(client.body())[:2] == [f.REFUSE, code]
    assert client.socket.recv(1) == b""


@pytest.mark.parametrize(
    ("code", "do"), OPEN, ids=lambda value: value if isinstance(value, str) else ""
)
def test_a_bad_frame_on_an_open_connection_is_refused_with_its_code(
    hub: Hub, code: str, do: Callable[[Foreign], None]
) -> None:
    """The refusal is sealed like every frame of an open connection. Earlier calls were carried out,
    and a caller that connects again gets their results."""
    client, name = hub.coordinator(), f"foreign{hub.count}"
    call: tuple[Any, ...] = (f.CALL, f"{name}/before", "memory.list", {}, None, 1)
    client.raw(client.frame(pack(call)))
    do(client)
    refuse = client.expect(f.REFUSE)
    assert refuse[1] == code and refuse[2]
    assert client.socket.recv(1) == b""
    again = hub.knock()
    assert again.open("coordinator", name, epoch=1)[5] == [f"{name}/before"]
    again.say(*call)
    result = again.expect(f.RESULT, f"{name}/before")
    assert (result[2], list(result[3]), result[4]) == ("success", ["versions"], "")


@pytest.mark.parametrize("versions", [(3, 9), (3, 2), (1, 1)])
def test_no_common_version_is_refused(hub: Hub, versions: tuple[int, int]) -> None:
    assert hub.knock().open("client", "old", versions=versions)[:2] == [f.REFUSE, "version"]


def test_a_newer_client_with_an_older_version_in_its_range_is_welcomed(hub: Hub) -> None:
    assert hub.knock().open("client", f"newer {hub.count}", versions=(1, 9))[:2] == [f.WELCOME, 2]


def test_names_epochs_and_directories(hub: Hub) -> None:
    """One process per name; a replaced coordinator is notified; another location file is
    refused."""
    first = hub.knock()
    assert first.open("coordinator", "chief", "boot 1", epoch=5)[0] == f.WELCOME
    assert hub.knock().open("coordinator", "chief", "boot 2", epoch=5)[:2] == [
        f.REFUSE,
        "name_taken",
    ]
    assert hub.knock().open("coordinator", "chief", "boot 2", epoch=4)[:2] == [
        f.REFUSE,
        "old_epoch",
    ]
    assert hub.knock().open("coordinator", "chief", "boot 2", epoch=6)[0] == f.WELCOME
    assert hub.knock().open("client", "elsewhere", directory="0" * 64)[:2] == [
        f.REFUSE,
        "directory",
    ]


def test_keys_that_differ(hub: Hub) -> None:
    """Each combination of keys is refused with its code."""
    wrong = Foreign(hub.address, None if hub.key is not None else bytes(32))
    hub.opened.append(wrong)
    assert wrong.open("client", "w")[:2] == [
        f.REFUSE,
        "key_needed" if hub.key is not None else "no_key_here",
    ]
    if hub.key is not None:
        other = Foreign(hub.address, bytes(32))
        hub.opened.append(other)
        assert other.open("client", "w")[:2] == [f.REFUSE, "wrong_key"] and not other.proven


def test_a_node_refuses_a_client_that_wants_another_node(hub: Hub) -> None:
    """A refusal after the proof of the key is sealed, so no third party can have sent it."""
    client = hub.knock()
    refusal = client.open("client", "lost", node="motion")
    assert (
        refusal[:2] == [f.REFUSE, "wrong_node"]
        and "this is hub, but the client asked for motion" in refusal[2]
    )
    assert client.proven is (hub.key is not None)


@pytest.mark.parametrize("fault", ["changed", "repeated", "left out", "unsealed"])
def test_a_broken_seal_ends_the_connection(hub: Hub, fault: str) -> None:
    if hub.key is None and fault in ("repeated", "left out"):
        return  # TCP detects this: a check has no number.
    client = hub.coordinator()
    frame = client.frame(pack((f.PING, 1)))
    if fault == "changed":
        client.raw(frame[:-1] + bytes([frame[-1] ^ 1]))
    elif fault == "repeated":
        client.raw(frame + frame)
    elif fault == "left out":
        client.say(f.PING, 2)
    else:
        client.raw(
            struct.pack(">I", 19) + pack((f.PING, 1)) + bytes(16)
            if hub.key
            else struct.pack(">I", 7) + pack((f.PING, 1)) + bytes(4)
        )
    message = f.unpack(client.body())
    limit = Limit("the refusal")
    while message[0] in (f.PONG, f.PING) and limit.left():
        message = f.unpack(client.body())
    assert message[:2] == [f.REFUSE, "bad_check" if hub.key is None else "bad_seal"]
