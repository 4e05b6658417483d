"""Latched events sent to several callers over links that break."""

from __future__ import annotations

import pytest
from hypothesis import given, strategies as st

from petrobot.services.comm.calls.callee import Callee, Offer
from petrobot.services.comm.calls.caller import Caller
from petrobot.services.comm.calls.events import KEPT, EventBoard
from petrobot.services.comm.protocol import messages as m


def _node(*names: str, role: str = "coordinator") -> Callee:
    callee = Callee("motion", "n1", {"move": Offer()})
    for name in names:
        callee.link_up(0.0, name, m.Hello(2, 2, role, name, "b"))
    return callee


def _heard(callee: Callee, peer: str) -> list[tuple[str, int]]:
    return [
        (message.name, message.number)
        for to, message in callee.messages()
        if to == peer and isinstance(message, m.Event)
    ]


def test_a_latched_event_waits_for_a_coordinator_that_is_away() -> None:
    callee = _node("coord")
    callee.receive(0.0, "coord", m.Subscribe(("caught",)))
    callee.link_down(1.0, "coord")
    callee.raise_event(1.1, "caught", source="barrier", latched=True)
    callee.raise_event(1.1, "tick", source="timer")
    assert callee.messages() == []
    callee.link_up(2.0, "coord", m.Hello(2, 2, "coordinator", "coord", "b"))
    assert _heard(callee, "coord") == [("caught", 1)]


def test_a_latched_event_raised_before_any_subscription_is_kept() -> None:
    callee = _node("coord")
    callee.raise_event(0.0, "caught", latched=True)
    callee.receive(0.1, "coord", m.Subscribe(("caught",)))
    assert _heard(callee, "coord") == [("caught", 1)]
    callee.receive(0.2, "coord", m.EventAck("motion", 1))
    callee.receive(0.3, "coord", m.Subscribe(("caught",)))
    assert _heard(callee, "coord") == []


def test_a_fresh_subscription_gets_no_event_of_the_time_before() -> None:
    callee = _node("coord", "next")
    callee.receive(0.0, "coord", m.Subscribe(("pressed",)))
    callee.raise_event(0.0, "pressed", source="button", latched=True)
    callee.receive(0.1, "next", m.Subscribe(("pressed",), fresh=True))
    callee.raise_event(0.2, "pressed", source="button", latched=True)
    callee.receive(0.3, "next", m.Subscribe(("pressed",)))  # as after a reconnection
    sent = [
        (to, message.number) for to, message in callee.messages() if isinstance(message, m.Event)
    ]
    assert sent == [("coord", 1), ("coord", 2), ("next", 2), ("next", 2)]


def test_an_acknowledgement_covers_only_the_subscriptions_of_its_sender() -> None:
    callee = _node("coord")
    callee.receive(0.0, "coord", m.Subscribe(("a",)))
    for name in ("a", "b", "a"):
        callee.raise_event(0.0, name, source="s", latched=True)
    assert _heard(callee, "coord") == [("a", 1), ("a", 3)]
    callee.receive(0.1, "coord", m.EventAck("s", 3))
    callee.receive(0.2, "coord", m.Subscribe(("a", "b")))
    assert _heard(callee, "coord") == [("b", 2)]


def test_an_event_is_forgotten_when_the_last_coordinator_has_it() -> None:
    callee = _node("one", "two")
    for name in ("one", "two"):
        callee.receive(0.0, name, m.Subscribe(("caught",)))
    callee.raise_event(0.0, "caught", latched=True)
    assert {to for to, _ in callee.messages()} == {"one", "two"}
    callee.receive(0.1, "one", m.EventAck("motion", 1))
    assert [event.number for event in callee.events.waiting("two")] == [1]
    callee.receive(0.1, "two", m.EventAck("motion", 1))
    callee.receive(0.2, "two", m.Subscribe(("caught",)))
    assert _heard(callee, "two") == []


def test_an_event_of_a_run_goes_to_its_caller_and_is_gone_with_the_run() -> None:
    callee = _node("coord", "other")
    callee.receive(0.0, "other", m.Subscribe(("ball_lost",)))
    callee.receive(0.0, "coord", m.Call("1", "move"))
    event = callee.raise_event(0.1, "ball_lost", {"at": 1}, run="1", latched=True)
    assert event == m.Event("ball_lost", "motion", 1, {"at": 1}, "1")
    assert [to for to, message in callee.messages() if message == event] == ["coord"]
    callee.link_down(0.2, "coord")
    callee.finish(0.3, m.Outcome("1", "success"))
    callee.link_up(0.4, "coord", m.Hello(2, 2, "coordinator", "coord", "b"))
    assert _heard(callee, "coord") == [("ball_lost", 1)]
    callee.receive(0.5, "coord", m.ResultAck("1"))
    callee.link_up(0.6, "coord", m.Hello(2, 2, "coordinator", "coord", "b"))
    assert _heard(callee, "coord") == []


def test_a_run_that_raises_more_events_than_are_kept_is_stopped() -> None:
    """It does not lose some of them silently, and what is acknowledged does not count."""
    callee = _node("coord")
    callee.receive(0.0, "coord", m.Call("1", "move"))
    for _ in range(KEPT):
        assert callee.raise_event(0.1, "noise", run="1", latched=True)
    callee.receive(0.2, "coord", m.EventAck("motion", 1))
    assert callee.raise_event(0.3, "noise", run="1", latched=True)
    assert not any(isinstance(order, m.Cancel) for order in callee.orders())
    assert callee.raise_event(0.4, "noise", run="1", latched=True) is None
    assert [order.id for order in callee.orders() if isinstance(order, m.Cancel)] == ["1"]
    callee.receive(0.5, "coord", m.EventAck("motion", KEPT))
    assert callee.raise_event(0.6, "noise", run="1", latched=True) is None  # it has lost one
    end = callee.finish(0.7, m.Outcome("1", "success", {"n": KEPT}))
    assert (end.status, end.cause, end.values) == ("error", "too_many_events", {})
    assert len(_heard(callee, "coord")) == KEPT + 1


def test_a_caller_that_left_with_bye_receives_no_old_events_when_it_is_back() -> None:
    callee = _node("coord")
    callee.receive(0.0, "coord", m.Subscribe(("caught",)))
    callee.receive(0.1, "coord", m.Bye("done"))
    callee.raise_event(0.2, "caught", latched=True)
    callee.link_up(0.3, "coord", m.Hello(2, 2, "coordinator", "coord", "b2"))
    assert _heard(callee, "coord") == []
    callee.receive(0.4, "coord", m.Subscribe(("caught",)))
    assert _heard(callee, "coord") == [("caught", 1)]


@pytest.mark.parametrize(
    ("names", "stored", "dropped"),
    [(("caught",), 0, 3), (("caught",), 2, 1), (("other",), 0, 0), ((), 0, 0)],
)
def test_the_oldest_events_are_dropped_and_counted_if_a_subscriber_has_not_stored_them(
    names: tuple[str, ...], stored: int, dropped: int
) -> None:
    board = EventBoard()
    board.subscribe("coord", names, durable=True)
    board.subscribe("page", ("caught",) if stored else (), durable=False)
    for number in range(1, KEPT + 1):
        board.raise_event(m.Event("caught", "barrier", 0), True, "")
        if number == stored:
            board.acknowledge("page", "barrier", number)
            board.acknowledge("coord", "barrier", number)
    for _ in range(3):
        board.raise_event(m.Event("caught", "barrier", 0), True, "")
    waiting = board.subscribe("coord", ("caught",), True)
    assert board.dropped == ({"barrier": dropped} if dropped else {})
    assert (len(waiting), waiting[0].number) == (KEPT, 4)


_steps = st.lists(
    st.sampled_from(["raise a", "raise b", "cut", "connect", "carry", "ack"]), max_size=40
)


@given(_steps, st.integers(0, 3))
def test_every_latched_event_arrives_once_and_in_order_of_its_source(
    steps: list[str], lost: int
) -> None:
    callee = Callee("motion", "n1", {})
    caller = Caller("motion", m.Hello(2, 2, "coordinator", "coord", "b"))
    caller.subscribe(0.0, ("a", "b"))
    raised: list[m.Event | None] = []
    arrived: list[m.Event] = []
    towards: list[m.Message] = []

    def connect() -> None:
        if not caller.up:
            answer = callee.link_up(0.0, "coord", caller.hello)
            assert isinstance(answer, m.Welcome)
            caller.link_up(0.0, answer)
            carry()

    def carry() -> None:
        for message in caller.messages(0.0):
            callee.receive(0.0, "coord", message)
        towards.extend(message for _, message in callee.messages())
        while towards and caller.up:
            caller.receive(0.0, towards.pop(0))

    def cut() -> None:
        if caller.up:
            towards.extend(message for _, message in callee.messages())
            while len(towards) > lost:
                caller.receive(0.0, towards.pop(0))
            towards.clear()
            callee.link_down(0.0, "coord")
            caller.link_down(0.0, "cut")

    def take() -> None:
        arrived.extend(notice for notice in caller.notices() if isinstance(notice, m.Event))

    for step in [*steps, "connect", "carry", "ack"]:
        if step.startswith("raise"):
            raised.append(callee.raise_event(0.0, step[-1], source="s", latched=True))
        elif step == "ack":
            take()
            for event in arrived:
                caller.acknowledge_event(0.0, event)
            carry()
        else:
            {"cut": cut, "connect": connect, "carry": carry}[step]()
        take()
    assert arrived == raised
    assert callee.events.waiting("coord") == []
