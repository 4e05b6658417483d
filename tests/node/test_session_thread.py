"""Sessions in a thread of their own: begun again, ended, and bounded."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import pytest

from petrobot import SessionThread, SimulatedSession
from petrobot.services.session_thread import WAITING
from tests.waiting import Limit

Serve = Callable[[SessionThread], Awaitable[None]]


class Taker:
    """A session that notes what it gets, until it gets "break"."""

    def __init__(self) -> None:
        self.got: list[Any] = []
        self.ready = asyncio.Event()
        self.ready.set()

    async def serve(self, session: SessionThread) -> None:
        session.opened("hello")
        while (item := await session.get()) is not None:
            self.got.append(item)
            session.tell("echo", item)
            if item == "break":
                raise ConnectionError("broken")
            await self.ready.wait()
        self.got.append("end")


@pytest.fixture
def begin() -> Iterator[Callable[[Serve], SessionThread]]:
    """Makes sessions, and closes them."""
    made: list[SessionThread] = []

    def make(serve: Serve) -> SessionThread:
        made.append(SessionThread(serve))
        return made[-1]

    yield make
    for session in made:
        session.close()
        assert not session._thread.is_alive()


def news(session: SessionThread, kind: str) -> list[tuple[str, Any]]:
    """Return the news up to one of this kind."""
    found: list[tuple[str, Any]] = []
    limit = Limit(f"{kind} after {found}", 20.0)
    while limit.left():
        for one in session.news():
            found.append(one)
            if one[0] == kind:
                return found
        time.sleep(0.005)
    raise AssertionError(found)


Begin = Callable[[Serve], SessionThread]


def test_a_device_that_cannot_be_reached_is_logged_once(
    begin: Begin, caplog: pytest.LogCaptureFixture
) -> None:
    async def refused(session: SessionThread) -> None:
        raise ConnectionError("connection refused")

    session = begin(refused)
    for _ in range(2):
        assert news(session, "down") == [("down", "connection refused")]
    assert caplog.messages == ["no connection to the device: connection refused"]


def test_a_session_that_breaks_is_begun_again(begin: Begin) -> None:
    taker = Taker()
    session = begin(taker.serve)
    assert (session.up, session.count) == (False, 0)
    assert news(session, "up") == [("up", "hello")] and (session.up, session.count) == (True, 1)
    session.send("break")
    assert news(session, "down") == [("echo", "break"), ("down", "broken")]
    assert (session.up, session.why) == (False, "broken")
    session.send("lost")  # there is no session
    assert news(session, "up") == [("up", "hello")] and session.count == 2
    session.send("later")
    assert news(session, "echo") == [("echo", "later")] and taker.got == ["break", "later"]


def test_what_is_sent_to_a_session_that_has_ended_does_not_reach_the_next(begin: Begin) -> None:
    taker = Taker()
    session = begin(taker.serve)
    news(session, "up")
    session.send("break")
    limit = Limit("the second session", 20.0)
    while session._opened < 2 and limit.left():
        time.sleep(0.005)
    session.send("for the first")  # the driver has not yet seen that it has ended
    assert session.count == 1
    news(session, "up")
    session.send("for the second")
    assert news(session, "echo") == [("echo", "for the second")]
    assert "for the first" not in taker.got


def test_a_session_gets_all_that_was_sent_before_it_is_closed(begin: Begin) -> None:
    taker = Taker()
    session = begin(taker.serve)
    news(session, "up")
    for number in range(100):
        session.send(number)
    session.close()
    assert taker.got == [*range(100), "end"] and not session._thread.is_alive()
    session.close()  # a second time
    session.send("too late")
    assert taker.got[-1] == "end"


def test_one_that_does_not_end_is_cancelled(begin: Begin) -> None:
    async def stuck(session: SessionThread) -> None:
        session.opened()
        await asyncio.Event().wait()

    session = begin(stuck)
    news(session, "up")
    session.close(0.05)
    session._thread.join(10.0)
    assert not session._thread.is_alive()


def test_close_does_not_wait_for_the_next_attempt(begin: Begin) -> None:
    async def absent(session: SessionThread) -> None:
        raise ConnectionError("nothing is there")

    session = begin(absent)
    assert news(session, "down") == [("down", "nothing is there")]
    session.close(10.0)
    assert not session._thread.is_alive()


def test_a_session_that_takes_nothing_is_ended_when_too_much_waits(begin: Begin) -> None:
    taker = Taker()
    session = begin(taker.serve)
    news(session, "up")
    taker.ready.clear()
    for number in range(WAITING + 10):
        session.send(number)
    assert news(session, "down")[-1] == ("down", "the other end does not take what it is sent")
    taker.ready.set()


def test_a_session_waits_until_its_driver_reads(begin: Begin) -> None:
    told = threading.Event()

    async def talk(session: SessionThread) -> None:
        session.opened()
        for number in range(WAITING + 10):
            await session.room()
            session.tell("said", number)
        told.set()
        await session.get()

    session = begin(talk)
    assert not told.wait(0.3) and len(session._news) == WAITING
    seen: list[Any] = []
    limit = Limit("all of it", 20.0)
    while len(seen) < WAITING + 11 and limit.left():
        seen += [item for _, item in session.news()]
        time.sleep(0.005)
    assert seen == [None, *range(WAITING + 10)] and told.is_set()


class Echo:
    """A simulated device that repeats what it gets, and tells the time."""

    def receive(self, now: float, item: Any) -> list[Any]:
        return [{"heard": item, "at": now}]

    def step(self, now: float) -> list[Any]:
        return [{"at": now}] if now else []


def test_a_simulated_device_answers_on_its_drivers_clock() -> None:
    """What it gets and tells is copied, as by a real session."""
    now, sent = 0.0, {"x": [1]}
    session = SimulatedSession(f"{__name__}:Echo", lambda: now)
    assert (session.count, list(session.news()), session.count) == (0, [("up", None)], 1)
    now = 2.0
    session.send(sent)
    sent["x"].append(2)
    told = [("message", {"heard": {"x": [1]}, "at": 2.0}), ("message", {"at": 2.0})]
    assert list(session.news()) == told
    session.close()
