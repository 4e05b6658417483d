"""Lock step: one order of messages in one process, in threads and in processes; and how a cell
ends."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from petrobot.services.comm.lockstep.cell import CellError, Delays, LockStepCell
from petrobot.services.comm.lockstep.mesh import Member, PartyLostError
from petrobot.services.comm.lockstep.party import TICK, Envelope, Party, Posted
from petrobot.services.comm.protocol import messages as m
from tests.comm.ends import frame
from tests.comm.toy_party import Toy
from tests.ports import free_ports
from tests.waiting import Limit

TOY = Path(__file__).parent / "toy_party.py"
NAMES = ["coordinator", "motion", "sim", "vision"]
TICKS = 14

_word = st.tuples(st.sampled_from(NAMES), st.sampled_from(["can", "call", "image", "control"]))
_script = st.dictionaries(st.integers(0, TICKS).map(str), st.lists(_word, max_size=3), max_size=6)
SCRIPTS = st.fixed_dictionaries(dict.fromkeys(NAMES, _script))
DELAYS = st.dictionaries(
    st.sampled_from(["can", "image", "motion.toy/sim.toy", "vision.toy/coordinator.toy"]),
    st.integers(1, 5),
    max_size=4,
)


_made: list[socket.socket] = []


@pytest.fixture(autouse=True)
def _close_listeners() -> Iterator[None]:
    yield
    while _made:
        _made.pop().close()


def _listeners(names: Sequence[str]) -> tuple[dict[str, socket.socket], dict[str, tuple[str, int]]]:
    while len(_made) > 100:
        _made.pop(0).close()
    listeners = {name: socket.create_server(("127.0.0.1", 0)) for name in names}
    _made.extend(listeners.values())
    return listeners, {name: one.getsockname() for name, one in listeners.items()}


def _in_threads(members: Sequence[Callable[[], Any]]) -> list[Any]:
    """Run each function in a thread; return what each returns or raises."""
    results: list[Any] = [None] * len(members)

    def run(index: int) -> None:
        try:
            results[index] = members[index]()
        except Exception as fault:
            results[index] = fault

    threads = [threading.Thread(target=run, args=(index,)) for index in range(len(members))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
        assert not thread.is_alive(), "a member hangs"
    return results


def _cell(scripts: Any, delays: Any) -> dict[str, list[str]]:
    toys = [Toy(name, scripts[name]) for name in NAMES]
    LockStepCell(toys, Delays(delays)).run(lambda: False, TICKS)
    return {toy.name: toy.heard for toy in toys}


@settings(max_examples=25)
@given(SCRIPTS, DELAYS, st.sampled_from([None, b"k" * 32]))
def test_one_process_and_a_mesh_receive_the_same_messages(
    scripts: Any, delays: Any, key: bytes | None
) -> None:
    listeners, addresses = _listeners(NAMES)
    toys = {name: Toy(name, scripts[name]) for name in NAMES}

    def member(name: str) -> Callable[[], tuple[str, int]]:
        def run() -> tuple[str, int]:
            one = Member(
                name,
                [toys[name]],
                addresses,
                delays=Delays(delays),
                key=key,
                listener=listeners[name],
            )
            one.open()
            return one.run(max_ticks=TICKS if name == NAMES[0] else None), one.tick

        return run

    ends = _in_threads([member(name) for name in NAMES])
    assert ends == [("max_ticks", TICKS)] + [("coordinator: max_ticks", TICKS)] * 3
    assert {name: toy.heard for name, toy in toys.items()} == _cell(scripts, delays)


@settings(max_examples=25)
@given(SCRIPTS, DELAYS)
def test_several_parties_in_a_member_receive_the_same_messages(scripts: Any, delays: Any) -> None:
    hosts = {"coordinator": "a", "vision": "a", "motion": "b", "sim": "b"}
    listeners, addresses = _listeners(["a", "b"])
    toys = {name: Toy(name, scripts[name]) for name in NAMES}

    def member(name: str) -> Callable[[], str]:
        def run() -> str:
            own = [toys[party] for party, host in hosts.items() if host == name]
            options = {"hosts": hosts, "delays": Delays(delays), "listener": listeners[name]}
            one = Member(name, own, addresses, **options)  # type: ignore[arg-type]
            one.open()
            return one.run(max_ticks=TICKS if name == "a" else None)

        return run

    assert _in_threads([member("a"), member("b")]) == ["max_ticks", "a: max_ticks"]
    assert {name: toy.heard for name, toy in toys.items()} == _cell(scripts, delays)


@pytest.mark.processes
@pytest.mark.parametrize("seed", range(2))
def test_one_process_and_four_processes_receive_the_same_messages(seed: int) -> None:
    ticks = 40
    scripts = {}
    for n, name in enumerate(NAMES):
        scripts[name] = {
            str(tick): [
                (
                    NAMES[(tick * 3 + n + k + seed) % 4],
                    ["can", "call", "image", "control"][(tick + k) % 4],
                )
                for k in range((tick + n) % 3)
            ]
            for tick in range(ticks)
        }
    delays = {"image": 3, "motion.toy/sim.toy": 2 + seed}
    addresses = {name: ("127.0.0.1", port) for name, port in zip(NAMES, free_ports(4), strict=True)}
    arguments = [json.dumps(one) for one in (ticks, addresses, scripts, delays)]
    processes = [
        subprocess.Popen(
            [sys.executable, str(TOY), name, *arguments], stdout=subprocess.PIPE, cwd=TOY.parents[2]
        )
        for name in NAMES
    ]
    heard = {}
    for name, process in zip(NAMES, processes, strict=True):
        said, _ = process.communicate(timeout=120)
        answer = json.loads(said)
        assert answer["ticks"] == ticks
        heard[name] = answer["heard"]
    toys = [Toy(name, scripts[name]) for name in NAMES]
    LockStepCell(toys, Delays(delays)).run(lambda: False, ticks)
    assert heard == {toy.name: toy.heard for toy in toys}
    assert sum(map(len, heard.values())) > 100


class Post:
    """Sends given messages at their ticks and records what it receives."""

    def __init__(self, name: str, sends: Sequence[tuple[int, Envelope]] = ()) -> None:
        self.name = name
        self.sends = sends
        self.got: list[tuple[int, str, Any]] = []
        self.ticks: list[float] = []
        self.now = 0.0

    def receive(self, now: float, envelope: Envelope) -> None:
        self.got.append((round(now / TICK), envelope.source, envelope.body))

    def advance(self, now: float) -> None:
        self.now = now
        self.ticks.append(now)

    def drain(self) -> Sequence[Envelope]:
        return [envelope for tick, envelope in self.sends if tick == round(self.now / TICK)]


def _envelope(source: str, body: Any, channel: str = "control", party: str = "b") -> Envelope:
    return Envelope(party, source, "there", channel, body)


def test_envelopes_arrive_in_the_order_of_tick_source_and_sequence() -> None:
    sends = [
        (0, _envelope("z", "slow", "image")),
        (1, _envelope("z", "first")),
        (1, _envelope("a", "x")),
        (1, _envelope("z", "second")),
        (2, _envelope("a", "y")),
    ]
    b = Post("b")
    cell = LockStepCell([Post("c", sends), b], Delays({"image": 2}))
    assert cell.run(lambda: cell.tick == 4, 100)
    assert b.got == [
        (2, "z", "slow"),
        (2, "a", "x"),
        (2, "z", "first"),
        (2, "z", "second"),
        (3, "a", "y"),
    ]
    assert b.ticks == [0.0, TICK, 2 * TICK, 3 * TICK]


@given(
    st.lists(
        st.tuples(st.integers(0, 5), st.sampled_from("pqrs"), st.integers(0, 99)), max_size=12
    ),
    st.data(),
)
def test_moving_an_endpoint_to_another_party_changes_nothing(
    words: Any, data: st.DataObject
) -> None:
    homes = {name: data.draw(st.sampled_from(["c", "d", "b"])) for name in "pqrs"}
    heard = []
    for placed in (dict.fromkeys("pqrs", "c"), homes):
        posts = {
            party: Post(
                party, [(t, _envelope(who, n)) for t, who, n in words if placed[who] == party]
            )
            for party in "bcd"
        }
        LockStepCell(list(posts.values())).run(lambda: False, 9)
        heard.append(posts["b"].got)
    assert heard[0] == heard[1]


@pytest.mark.parametrize(
    ("delays", "ticks"),
    [({}, 1), ({"control": 4}, 4), ({"src/there": 3, "control": 4}, 3), ({"other/there": 3}, 1)],
)
def test_delays_depend_on_both_ends_and_then_on_the_channel(
    delays: dict[str, int], ticks: int
) -> None:
    assert Delays(delays).ticks(_envelope("src", None)) == ticks


@pytest.mark.parametrize("ticks", [0, -1, 1.5, True])
def test_a_delay_below_a_tick_is_refused(ticks: Any) -> None:
    with pytest.raises(CellError, match=r"link image: .* at least 1"):
        Delays({"image": ticks})


def test_bodies_arrive_as_from_another_process_and_are_not_shared() -> None:
    body = {"list": [1, (2, 3)], "text": "x"}
    b = Post("b")
    LockStepCell([Post("c", [(0, _envelope("z", body))]), b]).run(lambda: False, 2)
    assert b.got == [(1, "z", {"list": (1, (2, 3)), "text": "x"})]
    assert b.got[0][2] is not body


@pytest.mark.parametrize(
    ("posts", "says"),
    [
        ([Post("b"), Post("b")], "two parties are named b"),
        (
            [Post("c", [(0, _envelope("z", object()))]), Post("b")],
            "z sends data to there on control that cannot be sent",
        ),
        ([Post("c", [(0, _envelope("z", {1: 2}))]), Post("b")], "a key of a map is not a str"),
        (
            [Post("c", [(0, _envelope("z", 1, party="nobody"))])],
            "party nobody, which is not in the cell",
        ),
        (
            [Post("c", [(0, _envelope("z", 1))]), Post("b", [(0, _envelope("z", 1))])],
            "both send as z",
        ),
    ],
)
def test_mistakes_of_parties_are_named(posts: list[Party], says: str) -> None:
    with pytest.raises(CellError, match=says):
        LockStepCell(posts).run(lambda: False, 2)


# Ends of a cell.


class Failing(Post):
    """Raises an exception at tick 5."""

    def advance(self, now: float) -> None:
        super().advance(now)
        if len(self.ticks) == 6:
            raise RuntimeError("out of luck")


def _two(a: Party, b: Party, **options: Any) -> list[Any]:
    listeners, addresses = _listeners(["a", "b"])

    def member(party: Party, until: Callable[[], bool] | None) -> Callable[[], str]:
        def run() -> str:
            one = Member(party.name, [party], addresses, listener=listeners[party.name], **options)
            one.open()
            return one.run(until)

        return run

    return _in_threads([member(a, lambda: len(getattr(a, "ticks", ())) == 30), member(b, None)])


def test_all_members_have_run_the_same_ticks_when_one_ends_the_cell() -> None:
    a, b = Post("a"), Post("b")
    assert _two(a, b) == ["until", "a: until"]
    assert len(a.ticks) == len(b.ticks) == 30


def test_large_images_in_both_directions_do_not_block_the_cell() -> None:
    image = np.arange(3_000_000, dtype=np.uint8).reshape(1500, 2000)
    posts = [
        Post(me, [(t, _envelope(f"{me}.cam", image, party=you)) for t in range(6)])
        for me, you in ("ab", "ba")
    ]
    assert _two(*posts) == ["until", "a: until"]
    for post in posts:
        assert [tick for tick, _, _ in post.got] == [1, 2, 3, 4, 5, 6]
        assert all((body == image).all() for _, _, body in post.got)


def test_the_other_members_are_told_which_party_failed() -> None:
    raised, told = _two(Failing("a"), Post("b"))
    assert isinstance(raised, RuntimeError)
    assert isinstance(told, PartyLostError) and told.member == "a"
    assert str(told) == "a: it failed: RuntimeError: out of luck"


def test_a_member_that_never_connects_is_named() -> None:
    listeners, addresses = _listeners(["a", "b"])
    with pytest.raises(PartyLostError, match=r"b: it did not join the cell within 0\.1 s"):
        Member("a", [Post("a")], addresses, listener=listeners["a"], joining=0.1).open()
    with pytest.raises(PartyLostError, match="a: no process answers at 127"):
        Member("b", [Post("b")], addresses, listener=listeners["b"], joining=0.1).open()


def _join(address: tuple[str, int], name: str = "b", directory: str = "") -> socket.socket:
    """Connect to a cell as a member written by hand."""
    sock = socket.create_connection(address, timeout=60.0)
    sock.sendall(frame(m.Hello(2, 2, "party", name, "x", 0, directory), "a"))
    return sock


@pytest.mark.parametrize(
    ("rest", "says"),
    [
        pytest.param(None, r"it did not finish tick 0 within 0\.3 s", id="silent"),
        pytest.param(b"", "its process ended without a BYE", id="gone"),
        pytest.param(frame(m.Tick(1)), "expected tick 0, got tick 1", id="tick left out"),
        pytest.param(
            b"\x00\x00\x00\x02\xff\xff", "it broke the protocol: malformed", id="random bytes"
        ),
        pytest.param(frame(m.Ping(1)), "a Ping is not allowed in lock step", id="another kind"),
        pytest.param(
            frame(m.Refuse("failed", "it failed: no luck")), "b: it failed: no luck", id="failed"
        ),
        pytest.param(
            frame(m.Tick(0, (Posted(0, 0, _envelope("z", 1, party="a")),))),
            "is late or misdirected",
            id="due at once",
        ),
        pytest.param(
            frame(m.Tick(0, (Posted(1, 0, _envelope("z", 1, party="q")),))),
            "is late or misdirected",
            id="not for a",
        ),
    ],
)
def test_a_member_that_does_not_keep_step_is_lost(rest: bytes | None, says: str) -> None:
    listeners, addresses = _listeners(["a", "b"])

    def other() -> None:
        with _join(addresses["a"]) as sock:
            sock.recv(1 << 16)
            if rest is not None:
                sock.sendall(rest)
                sock.shutdown(socket.SHUT_WR)
            limit = Limit("the other end to hang up")
            while sock.recv(1 << 16) and limit.left():
                pass

    def own() -> str:
        member = Member(
            "a",
            [Post("a")],
            addresses,
            listener=listeners["a"],
            patience=0.3 if rest is None else 60.0,
        )
        member.open()
        return member.run()

    _, lost = _in_threads([other, own])
    assert isinstance(lost, PartyLostError) and lost.member == "b"
    assert re.search(says, str(lost)), str(lost)


def test_foreign_connections_do_not_prevent_a_cell_from_forming() -> None:
    listeners, addresses = _listeners(["a", "b"])

    def strangers() -> list[str]:
        said = []
        for first in (
            b"GET / HTTP/1.1\r\n\r\n",
            frame(m.Hello(2, 2, "node", "b", "x"), "a"),
            frame(m.Hello(2, 2, "party", "q", "x"), "a"),
        ):
            with socket.create_connection(addresses["a"], timeout=60.0) as sock:
                sock.sendall(first)
                said.append(sock.recv(1 << 16)[5:8].hex())
        return said

    def own(name: str) -> Callable[[], str]:
        def run() -> str:
            member = Member(name, [Post(name)], addresses, listener=listeners[name])
            member.open()
            return member.run(max_ticks=3 if name == "a" else None)

        return run

    def late() -> str:
        done.wait(60.0)
        return own("b")()

    done = threading.Event()

    def first() -> list[str]:
        said = strangers()
        done.set()
        return said

    said, a, b = _in_threads([first, own("a"), late])
    assert (a, b) == ("max_ticks", "a: max_ticks")
    assert len(said) == 3 and all(one.startswith("03") for one in said), "each is told why"


def test_members_with_different_directories_do_not_form_a_cell() -> None:
    listeners, addresses = _listeners(["a", "b"])

    def member(name: str, directory: str) -> Callable[[], None]:
        return Member(
            name,
            [Post(name)],
            addresses,
            listener=listeners[name],
            directory=directory,
            joining=2.0,
        ).open

    a, b = _in_threads([member("a", "d1"), member("b", "d2")])
    assert isinstance(b, CellError) and "different services.toml" in str(b)
    assert isinstance(a, PartyLostError) and a.member == "b"
