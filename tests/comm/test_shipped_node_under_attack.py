"""The shipped cell's vision node, launched from the shipped location file, under attack by clients
without a key.

Thousands of malformed frames, handshakes byte by byte, lengths and nestings beyond all limits,
bodies that never end: a good caller on one connection is answered throughout, a new one is let in,
and the node keeps neither memory nor sockets.
"""

from __future__ import annotations

import contextlib
import itertools
import random
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from msgspec import Struct

from petrobot.services.comm.protocol import messages as m
from tests.comm import foreign as f
from tests.comm.ends import frame, framed, head
from tests.comm.foreign import Foreign, pack
from tests.integration.cell_files import ROOT, services_file
from tests.waiting import Limit

pytestmark = pytest.mark.processes
GROWTH = 24 << 20
"""By how much the node may grow in an attack (bytes)."""
MIB = 1 << 20
ASKED = itertools.count()
SILENT = 0.8
"""Silence (s) after which a caller may be cut off before the node has read its next message."""
BEAT = 0.1
"""Interval of the good caller's messages (s); after 1 s of silence it would be cut off, too."""


class Good(Foreign):
    """A caller that is welcomed."""

    def __init__(self, address: tuple[str, int], name: str) -> None:
        super().__init__(address)
        self._who = address, name
        assert self.open("client", name, node="vision")[0] == f.WELCOME

    def raw(self, data: bytes) -> None:
        """Send bytes as they are, and note when."""
        super().raw(data)
        self._spoke = time.monotonic()

    def stay(self) -> None:
        """Connect again if this process was silent for so long that the node may have cut it off:
        it may have waited for a core, or for the node's answer to another caller."""
        if time.monotonic() - self._spoke > SILENT:
            self.close()
            self.__init__(*self._who)  # type: ignore[misc]


class Vision(Struct):
    """The node process."""

    process: subprocess.Popen[str]
    address: tuple[str, int]

    def size(self) -> int:
        """Return the node's resident set (bytes)."""
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmRSS"))

    def sockets(self) -> int:
        """Return the number of sockets that the node holds."""
        count = 0
        for one in Path(f"/proc/{self.process.pid}/fd").iterdir():
            with contextlib.suppress(OSError):
                count += str(one.readlink()).startswith("socket:")
        return count

    def stranger(self) -> socket.socket:
        """Open a connection without a handshake."""
        return socket.create_connection(self.address, f.LIMIT)

    def good(self, name: str) -> Good:
        """Connect a caller that is welcomed."""
        return Good(self.address, name)


@pytest.fixture(scope="module")
def vision(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Vision]:
    """`python -m petrobot.services vision` on the shipped services.toml, with free ports."""
    file = services_file(tmp_path_factory.mktemp("cell"))
    command = [sys.executable, "-m", "petrobot.services", "vision", "--services", str(file)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout is not None
    said = process.stdout.readline()
    assert "ready on" in said
    host, _, port = said.partition("ready on ")[2].partition(",")[0].rpartition(":")
    yield Vision(process, (host, int(port)))
    process.terminate()
    process.communicate(timeout=60.0)


def ask(client: Good) -> None:
    """Send a status command as the good caller. On a busy host the camera's process may be late."""
    client.stay()
    for _ in range(3):
        id_ = f"ask {next(ASKED)}"  # The id of a command belongs to one caller.
        client.say(f.COMMAND, id_, "status")
        answer = client.expect(f.ANSWER, id_)
        if answer[2]:
            break
    assert answer[2] and "camera" in answer[3]["devices"], answer


def _hello(name: str) -> bytes:
    return frame(m.Hello(2, 2, "client", name, name), "vision")


def malformed(random_: random.Random) -> bytes:
    """Return one connection's malformed bytes."""
    name = f"bad{random_.randrange(500)}"
    hello = _hello(name)
    call = framed(pack((f.CALL, "1", "locate_background", {"x": [1, {"y": 2.0}]}, 1.0)))
    spoilt = bytearray(random_.choice([hello, call]))
    spoilt[random_.randrange(len(spoilt))] = random_.randrange(256)
    deep = b"\x94\x04\xa1c\xa1s" + b"\x81\xa1a" * random_.randrange(33, 300) + b"\xc0"
    wide = b"\x94\x04\xa1c\xa1s\x81\xa1a\xdd" + random_.randrange(1 << 32).to_bytes(4, "big")
    return random_.choice(
        [
            random_.randbytes(random_.randrange(1, 120)),
            bytes(spoilt),
            hello + bytes(spoilt),
            hello + random_.randbytes(random_.randrange(1, 300)),
            hello + framed(deep),
            hello + framed(wide),
            hello + head(random_.randrange(16 * MIB + 5, 1 << 25)) + b"\x99\x04",
            hello + call[: random_.randrange(len(call))],
            hello + framed(pack((random_.randrange(256), "x", 1))[:-1]),
        ]
    )


def attack(vision: Vision, connections: int) -> None:
    """Open this many malformed connections; the good caller asks ten times a second and is always
    answered."""
    random_ = random.Random(connections)
    good = vision.good("good")
    ask(good)
    before, open_before, asked = vision.size(), vision.sockets(), time.monotonic()
    for number in range(1, connections + 1):
        stranger = vision.stranger()
        with contextlib.suppress(ConnectionError):
            stranger.sendall(malformed(random_))
            if number % 20 == 0:
                stranger.shutdown(socket.SHUT_WR)
                limit = Limit("the node to hang up")
                while stranger.recv(4096) and limit.left():
                    pass
        stranger.close()
        if time.monotonic() > asked + BEAT:
            ask(good)
            asked = time.monotonic()
    good.say(f.BYE)
    good.close()
    ask(after := vision.good("after"))
    limit = Limit("the sockets to be closed")
    while vision.sockets() > open_before and limit.left():
        ask(after)
    after.close()
    assert vision.process.poll() is None
    assert vision.size() - before < GROWTH


def test_malformed_frames(vision: Vision) -> None:
    attack(vision, 1_000)


@pytest.mark.proof
def test_a_hundred_thousand_malformed_frames(vision: Vision) -> None:
    attack(vision, 100_000)


def test_slow_handshakes_block_no_other_client(vision: Vision) -> None:
    """Two hundred connections send HELLO byte by byte: each is cut off after 2 s, and a good caller
    gets in at once."""
    hello = _hello("drip")
    drips = [vision.stranger() for _ in range(200)]
    for at in range(4):
        for one in drips:
            with contextlib.suppress(ConnectionError):
                one.sendall(hello[at : at + 1])
        good = vision.good(f"between {at}")
        ask(good)
        good.say(f.BYE)
        good.close()
    for one in drips:
        with contextlib.suppress(ConnectionError):
            assert one.recv(1) == b"", "it was cut without a word"
        one.close()


@pytest.mark.parametrize(
    ("body", "code"),
    [
        (b"\xff\xff\xff\xff\x99\x04", "too_large"),
        (head(16 * MIB + 5) + b"\x99\x04", "too_large"),
        (framed(b"\x94\x04\xa11\xa1s" + b"\x81\xa1a" * 5_000 + b"\xc0"), "malformed"),
        (framed(b"\x94\x04\xa11\xa1s\x81\xa1a" + b"\x91" * 5_000 + b"\xc0"), "malformed"),
        (
            framed(b"\x94\x04\xa11\xa1s\x81\xa1a\xdd\x00\x0f\x42\x40" + b"\x90" * 1_000_000),
            "malformed",
        ),
        (framed(b"\x94\x04\xa11\xa1s\x81\xa1a\xdd\xff\xff\xff\xff\x01"), "malformed"),
        (framed(b"\x94\x04\xa11\xa1s\x81\xa1a\xc6\xff\xff\xff\xff\x01"), "malformed"),
    ],
    ids=[
        "4 GiB",
        "16 MiB and a byte",
        "maps",
        "arrays",
        "a million arrays",
        "2^32 items",
        "2^32 bytes",
    ],
)
def test_data_beyond_the_limits_is_refused_at_no_cost(
    vision: Vision, body: bytes, code: str
) -> None:
    good = vision.good("steady")
    before = vision.size()
    for number in range(10):
        bad = vision.good(f"huge {number}")
        bad.raw(body)
        assert bad.hear()[:2] == [f.REFUSE, code]
        bad.close()
        ask(good)
    good.say(f.BYE)
    good.close()
    assert vision.size() - before < GROWTH


def test_bodies_that_never_end_are_bounded(vision: Vision) -> None:
    """Twelve callers each send a call of 2 MiB without its last byte: the good caller is answered
    all the time."""
    good, open_ = vision.good("patient"), []
    for number in range(12):
        one = vision.good(f"endless {number}")
        one.raw(head(2 * MIB) + b"\x94\x04\xa11\xa1s" + bytes(MIB))
        open_.append(one)
        ask(good)
    number, limit = 0, Limit("the silent ones to be cut")
    while open_ and limit.left():  # They are silent: each is cut off after 1 s.
        number += 1
        ask(good)
        open_ = [one for one in open_ if not hung_up(one)]
    good.close()


def hung_up(one: Foreign) -> bool:
    """Return whether the node has closed this connection; its messages are ignored."""
    try:
        limit = Limit("the end of what the node sent")
        while one.socket.recv(4096, socket.MSG_DONTWAIT) and limit.left():
            pass
    except BlockingIOError:
        return False
    except ConnectionError:
        pass
    one.close()
    return True
