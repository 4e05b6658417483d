"""Client side of the node protocol, without sockets: how and when a fault ends a call."""

from __future__ import annotations

import math

import pytest
from msgspec.structs import replace

from petrobot.services.comm.calls.caller import Caller, LateResult, Notice, PeerLost
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.codec import LIMITS, encode
from petrobot.services.comm.protocol.messages import (
    Accept,
    Answer,
    Executed,
    Feedback,
    Outcome,
)
from petrobot.services.comm.protocol.plain import NotPlainError


class _Waiter:
    """A future that waits for the end of a call."""

    def __init__(self, enough: bool = False) -> None:
        self.enough = enough
        self.told: list[m.Outcome] = []

    def done(self) -> bool:
        return self.enough

    def set_result(self, outcome: m.Outcome, /) -> None:
        self.told.append(outcome)


HELLO = m.Hello(2, 2, "coordinator", "coord", "c1", 3)
CALL = m.Call("1", "move", {"to": (1, 2)}, 2.0)


def _welcome(boot: str = "n1", runs: tuple[str, ...] = ()) -> m.Welcome:
    return m.Welcome(2, "motion", boot, ("move",), runs)


def _caller(*, up: bool = True, auto_ack: bool = False) -> Caller:
    caller = Caller("motion", HELLO, auto_ack=auto_ack)
    if up:
        caller.link_up(0.0, _welcome())
        caller.notices()
    return caller


def _ends(notices: list[Notice]) -> list[tuple[str, str, Executed]]:
    return [
        (notice.id, notice.cause, notice.executed)
        for notice in notices
        if isinstance(notice, Outcome)
    ]


def test_a_call_carries_epoch_boot_and_its_arguments_as_plain_data() -> None:
    caller = _caller()
    caller.call(0.0, CALL)
    assert caller.messages(0.0) == [m.Call("1", "move", {"to": [1, 2]}, 2.0, 3, "n1")]
    assert caller.messages(0.0) == []


def test_a_call_names_the_stops_that_its_caller_knows_of() -> None:
    """Those before the first connection and those of which a result told, but none of which only a
    later WELCOME tells: the owner has to decide whether it goes on."""
    caller = Caller("motion", HELLO)

    def boot(n: int) -> str:
        caller.call(0.0, m.Call(str(n), "move"))
        (call,) = caller.messages(0.0)
        assert isinstance(call, m.Call)
        return call.boot

    caller.link_up(0.0, _welcome("n1+2"))
    assert (caller.boot, boot(1)) == ("n1", "n1+2")
    caller.link_down(1.0, "cut")
    caller.link_up(1.1, _welcome("n1+3"))
    caller.messages(1.1)
    assert boot(2) == "n1+2"
    caller.receive(1.2, m.Outcome("2", "error", {m.LATCHED: True, m.STOPS: 3}, m.EMERGENCY_STOP))
    assert boot(3) == "n1+3"
    caller.link_down(2.0, "cut")
    caller.link_up(2.1, _welcome("n2+4"))
    caller.messages(2.1)
    assert (caller.boot, boot(4)) == ("n2", "n2+3"), "another process keeps the count"


@pytest.mark.parametrize(
    ("boot", "parts"),
    [
        ("n1", ("n1", 0, math.inf)),
        ("n1+12", ("n1", 12, math.inf)),
        ("n1+12/0.250000", ("n1", 12, 0.25)),
        ("a+b in lock step", ("a+b in lock step", 0, math.inf)),
        ("n1+12/soon", ("n1+12/soon", 0, math.inf)),
        ("n1+1/1e400", ("n1+1/1e400", 0, math.inf)),
        ("", ("", 0, math.inf)),
    ],
)
def test_a_boot_is_a_process_and_a_number_of_stops(
    boot: str, parts: tuple[str, int, float]
) -> None:
    assert m.split_boot(boot) == parts and m.boot_text(*parts) == boot


def test_a_run_from_accept_to_acknowledged_result() -> None:
    caller = _caller()
    caller.call(0.0, CALL)
    result = m.Outcome("1", "success", {"x": 1})
    for message in (m.Accept("1"), m.Accept("1"), m.Feedback("1", 0.5, {"n": 1}), result, result):
        caller.receive(0.1, message)
    assert caller.notices() == [
        Accept("1"),
        Feedback("1", 0.5, {"n": 1}),
        result,
    ]
    caller.messages(0.1)
    assert caller.due() is None, "a result is acknowledged only once it is stored"
    caller.acknowledge(0.2, "1")
    assert caller.due() == pytest.approx(0.25)
    assert caller.messages(0.24) == []
    assert caller.messages(0.25) == [m.ResultAck("1")]
    assert caller.due() is None


def test_acknowledgements_are_sent_in_one_message() -> None:
    caller = _caller(auto_ack=True)
    for n in range(64):
        caller.call(0.0, m.Call(str(n), "move"))
        caller.receive(0.0, m.Outcome(str(n), "success"))
    sent = [message for message in caller.messages(0.0) if isinstance(message, m.ResultAck)]
    assert sent == [m.ResultAck("0", tuple(str(n) for n in range(1, 64)))]


def test_a_repeated_result_is_acknowledged_again_and_reported_once() -> None:
    caller = _caller(auto_ack=True)
    caller.call(0.0, CALL)
    caller.receive(0.0, m.Outcome("1", "success"))
    assert m.ResultAck("1") in caller.messages()
    caller.notices()
    caller.receive(0.1, m.Outcome("1", "success"))
    assert caller.messages() == [m.ResultAck("1")] and caller.notices() == []


@pytest.mark.parametrize("owns_boot", [False, True], ids=["any boot", "a boot of before"])
def test_a_call_that_was_never_sent_ends_as_not_executed_unless_an_earlier_process_may_have_sent_it(
    owns_boot: bool,
) -> None:
    call = m.Call("1", "move", boot="n0" if owns_boot else "")
    executed = Executed.UNKNOWN if owns_boot else Executed.NO
    away = _caller(up=False)
    away.call(0.0, call)
    assert _ends(away.notices()) == [("1", "unreachable", executed)]
    waiting = _caller(up=False)
    waiting.connecting(0.0)
    waiting.call(0.5, call)
    assert waiting.notices() == [] and waiting.due() == 2.0
    waiting.advance(2.0)
    assert _ends(waiting.notices()) == [("1", "unreachable", executed)]
    refused = _caller(up=False)
    refused.link_refused(0.0, m.Refuse("directory", "copy it"))
    refused.call(0.0, call)
    assert _ends(refused.notices()) == [("1", "refused", executed)]


@pytest.mark.parametrize("refused", [False, True], ids=["not there", "refuses"])
def test_a_call_retried_at_once_waits_for_the_peer(refused: bool) -> None:
    """A task that repeats a failed action must not loop as fast as the machine can, nor have no try
    left when its node is back: at most two calls end in each 2 s."""
    caller, cause = _caller(up=False), "refused" if refused else "unreachable"
    if refused:
        caller.link_refused(0.0, m.Refuse("keys", "copy the key"))
        caller.notices()
    ended: list[float] = []
    now, number = 1.0, 0
    while now < 21.0:
        caller.call(now, m.Call(str(number), "move"))
        if not caller.has_news:
            due = caller.due()
            assert due is not None and caller.soonest <= due
            now = due
            caller.advance(now)
        assert _ends(caller.notices()) == [(str(number), cause, Executed.NO)]
        ended.append(now)
        number += 1
        now += 0.001
    assert 18 <= len(ended) <= 22


def test_a_call_waiting_for_its_retry_is_sent_when_the_peer_is_connected() -> None:
    caller = _caller(up=False)
    caller.call(1.0, CALL)
    caller.call(1.01, m.Call("2", "move"))
    caller.notices()
    caller.link_up(1.05, _welcome())
    assert [message.id for message in caller.messages() if isinstance(message, m.Call)] == ["2"]
    caller.advance(1.2)
    assert _ends(caller.notices()) == []


def test_a_call_made_while_the_link_is_down_is_sent_when_it_is_back_even_to_another_boot() -> None:
    caller = _caller()
    caller.link_down(1.0, "cut")
    caller.call(1.5, CALL)
    assert caller.messages(1.5) == []
    caller.link_up(2.0, _welcome("n2"))
    assert caller.messages(2.0) == [m.Call("1", "move", {"to": [1, 2]}, 2.0, 3, "n2")]
    assert _ends(caller.notices()) == []


def test_a_lost_link_ends_its_calls_after_two_seconds_not_before() -> None:
    caller = _caller()
    caller.call(0.0, CALL)
    caller.messages(0.0)
    caller.link_down(1.0, "the other side hung up")
    assert caller.notices() == [PeerLost("the other side hung up")] and caller.due() == 1.0
    caller.advance(2.9)
    assert caller.notices() == [] and list(caller.pending) == ["1"]
    caller.advance(3.0)
    assert _ends(caller.notices()) == [("1", "lost", Executed.UNKNOWN)]


def test_a_peer_that_was_silent_for_long_ends_its_calls_at_once() -> None:
    caller = _caller()
    caller.call(0.0, CALL)
    caller.link_down(1.0, "silent", final=True)
    assert _ends(caller.notices()) == [("1", "lost", Executed.UNKNOWN)]
    caller.call(1.1, m.Call("2", "move"))
    assert _ends(caller.notices()) == [("2", "unreachable", Executed.NO)]


def test_the_same_boot_is_sent_the_call_again_under_its_id_with_its_cancel() -> None:
    caller = _caller()
    caller.call(0.0, CALL)
    caller.call(0.0, m.Call("2", "move"))
    sent = caller.messages(0.0)
    caller.cancel(0.1, "2", "not wanted")
    caller.link_down(1.0, "cut")
    caller.subscribe(1.0, ("tick",))
    caller.link_up(1.5, _welcome(runs=("1",)))
    again = [replace(call, again=True) for call in sent if isinstance(call, m.Call)]
    assert caller.messages(1.5) == [m.Subscribe(("tick",)), *again, m.Cancel("2", "not wanted")]
    assert caller.notices()[1:] == [_welcome(runs=("1",))]


def test_a_call_sent_to_one_boot_is_never_sent_to_another() -> None:
    caller = _caller()
    caller.call(0.0, CALL)
    caller.messages(0.0)
    caller.link_down(1.0, "cut")
    caller.link_up(1.5, _welcome("n2"))
    assert caller.messages(1.5) == []
    assert _ends(caller.notices()) == [("1", "rebooted", Executed.UNKNOWN)]


def test_a_call_without_accept_in_time_is_ended_and_cancelled() -> None:
    caller = _caller()
    caller.call(0.0, CALL)
    caller.messages(0.0)
    assert caller.due() == 1.0
    caller.advance(1.0)
    assert _ends(caller.notices()) == [("1", "not_accepted", Executed.UNKNOWN)]
    assert caller.messages(1.0) == [m.Cancel("1", "not_accepted")]


def test_after_a_standstill_the_peer_has_as_long_as_for_accept() -> None:
    caller = _caller()
    caller.call(0.0, CALL)
    caller.command(0.0, m.Command("k", "status"))
    caller.messages(0.0)
    caller.stood_still(3600.0)
    caller.advance(3600.9)
    assert caller.notices() == []
    assert caller.due() == 3601.0
    caller.advance(3601.0)
    assert [type(notice) for notice in caller.notices()] == [m.Outcome, m.Answer]
    assert caller.due() is None


def test_the_deadline_is_watched_with_a_margin_for_the_nodes_stop_routine() -> None:
    caller = _caller()
    caller.call(0.0, CALL)
    caller.receive(0.1, m.Accept("1"))
    caller.messages(0.1)
    caller.notices()
    assert caller.due() == 7.0
    caller.advance(6.9)
    assert caller.notices() == []
    caller.advance(7.0)
    assert _ends(caller.notices()) == [("1", "no_answer", Executed.UNKNOWN)]
    assert caller.messages(7.0) == [m.Cancel("1", "no_answer")]


def test_a_cancelled_call_that_never_ends_is_given_up() -> None:
    caller = _caller()
    caller.call(0.0, m.Call("1", "move"))
    caller.receive(0.1, m.Accept("1"))
    caller.cancel(1.0, "1", "not wanted")
    caller.cancel(1.1, "1", "again")
    assert [one for one in caller.messages(1.1) if isinstance(one, m.Cancel)] == [
        m.Cancel("1", "not wanted")
    ]
    caller.notices()
    caller.advance(6.0)
    assert _ends(caller.notices()) == [("1", "no_answer", Executed.UNKNOWN)]


def test_short_calls_leave_no_state_behind() -> None:
    caller = _caller()
    caller.begin(0.0, "first", "get", {}, waiter=_Waiter())
    caller.take_outcomes(0.0, [m.Outcome("first", "success")])
    for n in range(5_000):
        caller.begin(0.0, str(n), "get", {}, waiter=_Waiter())
        caller.take_outcomes(0.0, [m.Outcome(str(n), "success")])
    assert len(caller._pending) == 0 and len(caller._pending._accepts) < 500


@pytest.mark.parametrize("lost", [False, True])
def test_a_waiter_that_gave_up_is_not_notified_but_the_result_is_still_acknowledged(
    lost: bool,
) -> None:
    caller, waiter = _caller(), _Waiter(enough=True)
    caller.begin(0.0, "1", "get", {}, waiter=waiter)
    if lost:
        caller.link_refused(0.1, m.Refuse("directory", "other"))
    else:
        caller.messages(0.0)
        caller.take_outcomes(0.1, [m.Outcome("1", "success")])
        assert m.ResultAck("1") in caller.messages(1.0)
    assert waiter.told == [] and not caller.pending
    assert not any(isinstance(notice, Outcome) for notice in caller.notices())


def test_many_results_at_once_are_acknowledged_in_messages_within_the_size_limit() -> None:
    caller = _caller()
    ids = [f"{n:0255}" for n in range(1_000)]
    waiter = _Waiter()
    for id_ in ids:
        caller.begin(0.0, id_, "get", {}, waiter=waiter)
    caller.messages(0.0)
    caller.take_outcomes(0.1, [m.Outcome(id_, "success") for id_ in (*ids, ids[0])])
    acks = [message for message in caller.messages(0.1) if isinstance(message, m.ResultAck)]
    assert [outcome.id for outcome in waiter.told] == ids, (
        "each is acknowledged once, even one that came twice"
    )
    assert [id_ for ack in acks for id_ in (ack.id, *ack.more)] == ids
    assert all(len(encode(ack)) <= LIMITS[m.ResultAck.KIND] for ack in acks)


def test_the_owner_sets_how_long_stopping_may_take() -> None:
    caller = _caller()
    caller.call(0.0, m.Call("1", "move"))
    caller.receive(0.1, m.Accept("1"))
    caller.cancel(1.0, "1", "not wanted", within=0.5)
    caller.notices()
    caller.advance(1.4)
    assert caller.notices() == []
    caller.advance(1.5)
    assert _ends(caller.notices()) == [("1", "no_answer", Executed.UNKNOWN)]


@pytest.mark.parametrize("cancelled", [False, True])
def test_the_wait_for_a_held_run_starts_again_when_it_continues_or_is_cancelled(
    cancelled: bool,
) -> None:
    """A deadline of 2 s and 5 s of patience, held from 1 s to 11 s: given up at 17 s; cancelled at
    11 s: at 16 s."""
    caller = _caller()
    caller.call(0.0, CALL)
    caller.receive(0.1, m.Accept("1"))
    caller.hold(1.0, "1")
    caller.hold(2.0, "1")
    caller.advance(10.9)
    caller.notices()
    if cancelled:
        caller.cancel(11.0, "1", "not wanted")
    else:
        caller.release(11.0, "1")
    due = 16.0 if cancelled else 17.0
    assert caller.soonest <= due
    caller.advance(due - 0.1)
    assert caller.notices() == []
    caller.advance(due)
    assert _ends(caller.notices()) == [("1", "no_answer", Executed.UNKNOWN)]


def test_a_call_cancelled_before_it_is_sent_ends_at_once() -> None:
    caller = _caller(up=False)
    caller.connecting(0.0)
    caller.call(0.0, CALL)
    caller.cancel(0.1, "1", "not wanted")
    assert _ends(caller.notices()) == [("1", "cancelled", Executed.NO)]
    caller.link_up(0.2, _welcome())
    assert caller.messages(0.2) == []


def test_a_call_from_before_a_restart_is_cancelled_before_it_is_sent_again() -> None:
    caller = _caller(up=False)
    caller.connecting(0.0)
    caller.call(0.0, m.Call("1", "move", boot="n1"))
    caller.cancel(0.1, "1", "not wanted")
    caller.link_up(0.2, _welcome())
    assert [type(message) for message in caller.messages(0.2)] == [m.Call, m.Cancel]


def test_a_run_given_up_is_stopped_when_its_node_is_back_and_its_late_end_is_reported() -> None:
    caller = _caller()
    caller.call(0.0, CALL)
    caller.messages(0.0)
    caller.link_down(1.0, "silent", final=True)
    caller.link_up(5.0, _welcome(runs=("1",)))
    assert caller.messages(5.0) == [m.Cancel("1", "given up")]
    caller.notices()
    late = m.Outcome("1", "error", {}, "orphan")
    caller.receive(5.1, late)
    assert caller.notices() == [LateResult(late)]
    assert caller.messages() == [m.ResultAck("1")]


def test_after_a_restart_the_owner_acknowledges_results_that_the_node_still_keeps() -> None:
    caller = _caller()
    caller.acknowledge(0.0, "done before")
    caller.disown(0.0, "given up before")
    assert set(caller.messages()) == {
        m.ResultAck("done before"),
        m.Cancel("given up before", "disowned"),
    }


def test_the_children_of_a_call_are_cancelled_with_it() -> None:
    caller = _caller()
    for id_, parent in (("1", "p"), ("2", "q"), ("3", "p")):
        caller.call(0.0, m.Call(id_, "move", parent=parent))
    caller.messages(0.0)
    caller.cancel_children(0.1, "p", "its parent is over")
    assert caller.messages(0.1) == [
        m.Cancel("1", "its parent is over"),
        m.Cancel("3", "its parent is over"),
    ]


def test_every_command_is_answered_even_after_a_fault() -> None:
    caller = _caller()
    for id_ in "abc":
        caller.command(0.0, m.Command(id_, "hold"))
    caller.receive(0.1, m.Answer("a", True, {"arm": "held"}))
    caller.receive(0.1, m.Answer("a", True, {"arm": "held"}))
    assert caller.notices() == [m.Answer("a", True, {"arm": "held"})]
    assert caller.due() == 2.0
    caller.advance(2.0)
    assert caller.notices() == [m.Answer(id_, False, {"cause": "no_answer"}) for id_ in "bc"]
    caller.command(3.0, m.Command("d", "hold"))
    caller.link_down(3.1, "cut", final=True)
    caller.command(3.2, m.Command("e", "hold"))
    answers = [notice for notice in caller.notices() if isinstance(notice, Answer)]
    assert answers == [
        m.Answer("d", False, {"cause": "lost"}),
        m.Answer("e", False, {"cause": "unreachable"}),
    ]


def test_a_command_waits_for_a_lost_connection_and_is_sent_again() -> None:
    """It was given up with its connection: a paused robot moved on, or stayed held although its
    task continued."""
    caller = _caller()
    orders = [m.Command("1", "hold"), m.Command("2", "release"), m.Command("3", "status")]
    caller.command(0.0, orders[0])
    assert caller.messages() == orders[:1]
    caller.command(0.1, orders[1])
    caller.link_down(0.1, "cut")
    caller.command(0.2, orders[2])
    assert caller.messages() == []
    caller.link_up(0.5, _welcome("n1"))
    assert caller.messages() == orders
    caller.receive(0.6, m.Answer("1", True, {}))
    caller.receive(0.6, m.Answer("2", True, {}))
    caller.link_down(0.7, "cut")
    caller.link_up(0.8, _welcome("n2"))
    assert caller.messages() == orders[2:], "the new process has not had it"
    caller.link_down(0.9, "cut")
    caller.notices()
    caller.advance(3.0)
    assert caller.notices() == [m.Answer("3", False, {"cause": "lost"})]


@pytest.mark.parametrize("auto_ack", [True, False])
def test_each_event_of_a_source_arrives_once_and_is_acknowledged_when_it_is_stored(
    auto_ack: bool,
) -> None:
    caller = _caller(auto_ack=auto_ack)
    events = [m.Event("caught", "barrier", n) for n in (1, 2, 2, 1)]
    for event in events:
        caller.receive(0.0, event)
    assert caller.notices() == events[:2]
    if not auto_ack:
        assert caller.messages() == []
        caller.acknowledge_event(0.1, events[1])
        assert caller.messages() == [m.EventAck("barrier", 2)]
        caller.receive(0.2, events[0])
        assert caller.messages() == [m.EventAck("barrier", 1)], (
            "its acknowledgement was lost: again"
        )
    else:
        assert set(caller.messages()) == {m.EventAck("barrier", 1), m.EventAck("barrier", 2)}
    caller.link_up(1.0, _welcome("n2"))
    caller.notices()
    caller.receive(1.0, events[0])
    assert caller.notices() == [events[0]], "another boot counts from 0 again"


def test_every_pulse_is_reported() -> None:
    caller = _caller()
    pulse = m.Event("tick", "timer", 0)
    caller.receive(0.0, pulse)
    caller.receive(0.0, pulse)
    assert caller.notices() == [pulse] * 2 and caller.messages() == []


def test_in_lock_step_the_client_sends_hello_by_itself() -> None:
    caller = _caller(up=False)
    caller.open(0.0)
    caller.call(0.0, CALL)
    assert caller.messages(0.0) == [HELLO]
    caller.receive(0.004, _welcome())
    assert [type(message) for message in caller.messages(0.004)] == [m.Call]
    caller.receive(0.1, m.Bye("done"))
    assert caller.notices()[-1] == PeerLost("done")


def test_bad_calls_are_refused_by_the_caller_itself() -> None:
    caller = _caller()
    with pytest.raises(NotPlainError, match=r"arguments\.to"):
        caller.call(0.0, m.Call("1", "move", {"to": object()}))
    caller.call(0.0, CALL)
    with pytest.raises(ValueError, match="already pending"):
        caller.call(0.0, CALL)
    assert list(caller.pending) == ["1"]
