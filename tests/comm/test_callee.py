"""Server side of the node protocol, without sockets: which clients it welcomes, which calls it
refuses, which results it keeps, and when it stops a run."""

from __future__ import annotations

import pytest
from hypothesis import given, strategies as st
from msgspec.structs import replace

from petrobot.services.comm.calls.callee import (
    Callee,
    FinishedIds,
    Offer,
    Retention,
)
from petrobot.services.comm.protocol import messages as m
from petrobot.services.comm.protocol.messages import Executed

COORD = m.Hello(2, 2, "coordinator", "coord", "c1", 3, "d1")


def _failing(now: float, call: m.Call) -> m.Outcome:
    raise RuntimeError("no luck")


OFFERS = {
    "move": Offer(device="arm", orphan_time=1.0),
    "track": Offer(),
    "limited": Offer(deadline=2.0),
    "tune": Offer(scope="local"),
    "get": Offer(inline=lambda now, call: m.Outcome(call.id, "success", {"at": now})),
    "broken": Offer(inline=_failing),
}


def _callee(*hellos: m.Hello, local: bool = True, keeping: Retention | None = None) -> Callee:
    callee = Callee("motion", "n1", OFFERS, directory="d1", keeping=keeping)
    for hello in hellos or (COORD,):
        assert isinstance(callee.link_up(0.0, hello.name, hello, local=local), m.Welcome)
    return callee


def _said(callee: Callee) -> list[m.Message]:
    return [message for _, message in callee.messages()]


def _outcome(callee: Callee) -> tuple[str, str, Executed]:
    [message] = [message for message in _said(callee) if isinstance(message, m.Outcome)]
    return message.status, message.cause, message.executed


def test_a_run_from_call_to_acknowledged_result() -> None:
    callee = _callee()
    call = m.Call("1", "move", {"to": 1}, 5.0, 3, "n1")
    callee.receive(0.0, "coord", call)
    assert callee.orders() == [call] and callee.orders() == []
    callee.feedback(0.1, "1", 1.5, {"n": (1,)})
    outcome = callee.finish(
        0.5, m.Outcome("1", "success", {"p": (1, 2)}, seconds=0.5, cpu_seconds=0.1)
    )
    assert outcome == m.Outcome("1", "success", {"p": [1, 2]}, "", "", Executed.YES, 0.5, 0.1)
    assert _said(callee) == [m.Accept("1"), m.Feedback("1", 1.0, {"n": [1]}), outcome]
    callee.receive(1.0, "coord", call)
    assert _said(callee) == [outcome] and callee.orders() == [], (
        "a call with a known id is answered, not run again"
    )
    callee.receive(1.1, "coord", m.ResultAck("1"))
    callee.receive(1.2, "coord", call)
    assert _outcome(callee) == ("error", "forgotten", Executed.UNKNOWN) and callee.orders() == []


def test_a_call_with_the_id_of_an_active_run_is_accepted_again() -> None:
    callee = _callee()
    for _ in range(2):
        callee.receive(0.0, "coord", m.Call("1", "move", epoch=3))
    assert _said(callee) == [m.Accept("1"), m.Accept("1")]
    assert len(callee.orders()) == 1 and callee.running() == {"1": "move"}


@pytest.mark.parametrize(
    ("call", "local", "cause", "executed"),
    [
        (m.Call("1", "nowhere"), True, "unknown_service", Executed.NO),
        (m.Call("1", "tune"), False, "local_only", Executed.NO),
        (m.Call("1", "move", epoch=2), True, "old_epoch", Executed.NO),
        (m.Call("1", "move", boot="n0", epoch=3), True, "rebooted", Executed.UNKNOWN),
        (m.Call("1", "broken", epoch=3), True, "crashed", Executed.UNKNOWN),
    ],
)
def test_refusals(call: m.Call, local: bool, cause: str, executed: Executed) -> None:
    callee = _callee(local=local)
    call = m.Call(call.id, call.service, call.arguments, call.deadline, call.epoch or 3, call.boot)
    callee.receive(0.0, "coord", call)
    assert _outcome(callee) == ("error", cause, executed)
    assert callee.orders() == []


def test_a_local_service_is_hidden_from_other_hosts() -> None:
    callee = Callee("motion", "n1", OFFERS)
    welcome = callee.link_up(0.0, "coord", COORD, local=False)
    assert isinstance(welcome, m.Welcome) and "tune" not in welcome.offers
    callee = _callee()
    callee.receive(0.0, "coord", m.Call("1", "tune", epoch=3))
    assert callee.orders()


def test_a_refused_call_stays_refused() -> None:
    callee = _callee(COORD, m.Hello(2, 2, "coordinator", "other", "o1"))
    callee.receive(0.0, "coord", m.Call("1", "move", epoch=3))
    callee.receive(0.1, "other", m.Call("2", "move"))
    callee.finish(1.0, m.Outcome("1", "success"))
    callee.link_down(1.0, "coord", leaves=True)
    _said(callee)
    callee.receive(2.0, "other", m.Call("2", "move"))
    assert _outcome(callee) == ("error", "device_leased", Executed.NO)
    callee.receive(2.0, "other", m.Call("3", "move"))
    assert [type(message) for message in _said(callee)] == [m.Accept]


def test_the_runner_reports_busy() -> None:
    callee = _callee()
    callee.receive(0.0, "coord", m.Call("1", "move", epoch=3))
    callee.finish(0.0, m.Outcome("1", "error", cause="busy", executed=Executed.NO))
    assert _outcome(callee) == ("error", "busy", Executed.NO)


def test_a_device_accepts_calls_only_from_the_holder_of_its_lease() -> None:
    other = m.Hello(2, 2, "coordinator", "other", "o1")
    callee = _callee(COORD, other, m.Hello(2, 2, "node", "vision", "v1"))
    callee.receive(0.0, "coord", m.Call("1", "move", epoch=3))
    _said(callee)
    callee.receive(0.1, "vision", m.Call("2", "move"))
    assert _outcome(callee) == ("error", "device_needs_coordinator", Executed.NO)
    callee.link_down(1.0, "coord")
    callee.receive(9.0, "other", m.Call("3", "move"))
    assert _outcome(callee)[1] == "device_leased", "its run is still active"
    callee.finish(9.1, m.Outcome("1", "error", cause="cancelled"))
    callee.receive(9.2, "other", m.Call("4", "move"))
    assert _said(callee) == [m.Accept("4")]


def test_a_lease_outlives_a_short_break_of_the_link() -> None:
    callee = _callee(COORD, m.Hello(2, 2, "coordinator", "other", "o1"))
    callee.receive(0.0, "coord", m.Call("1", "move", epoch=3))
    callee.finish(0.5, m.Outcome("1", "success"))
    callee.link_down(1.0, "coord")
    _said(callee)
    callee.receive(2.9, "other", m.Call("2", "move"))
    assert _outcome(callee)[1] == "device_leased"
    callee.receive(3.0, "other", m.Call("3", "move"))
    assert _said(callee) == [m.Accept("3")]


def test_a_coordinator_whose_device_another_one_has_used_has_it_no_more() -> None:
    """It was away too long; a new process of it, as after `resume`, may have the device."""
    callee = _callee(COORD, m.Hello(2, 2, "coordinator", "other", "o1"))
    callee.receive(0.0, "coord", m.Call("1", "move", epoch=3))
    callee.finish(0.5, m.Outcome("1", "success"))
    callee.link_down(1.0, "coord")
    callee.receive(3.0, "other", m.Call("2", "move"))
    callee.finish(3.5, m.Outcome("2", "success"))
    callee.link_down(3.6, "other", leaves=True)
    callee.link_up(4.0, "coord", COORD, local=True)
    _said(callee)
    callee.receive(4.1, "coord", m.Call("3", "move", epoch=3))
    assert _outcome(callee) == ("error", "device_overtaken", Executed.NO)
    callee.link_down(5.0, "coord")
    callee.link_up(6.0, "coord", replace(COORD, boot="new", epoch=4), local=True)
    callee.receive(6.1, "coord", m.Call("4", "move", epoch=4))
    assert _said(callee) == [m.Accept("4")]


def test_a_caller_never_receives_the_result_of_another_caller() -> None:
    callee = _callee(COORD, m.Hello(2, 2, "coordinator", "other", "o1"))
    callee.receive(0.0, "coord", m.Call("1", "get", epoch=3))
    _said(callee)
    callee.receive(0.1, "other", m.Call("1", "get"))
    callee.receive(0.2, "other", m.ResultAck("1"))
    assert _outcome(callee) == ("error", "id_taken", Executed.NO)
    welcome = callee.link_up(0.3, "coord", COORD)
    assert isinstance(welcome, m.Welcome) and welcome.runs == ("1",)


@pytest.mark.parametrize("limited_by", ["the call", "the offer"])
def test_the_deadline_is_enforced_whatever_the_action_says(limited_by: str) -> None:
    callee = _callee()
    by_call = limited_by == "the call"
    callee.receive(
        1.0,
        "coord",
        m.Call("1", "track" if by_call else "limited", {}, 2.0 if by_call else None, 3),
    )
    callee.orders()
    assert callee.due() == 3.0
    callee.advance(2.9)
    assert callee.orders() == []
    callee.advance(3.0)
    callee.advance(4.0)
    assert callee.orders() == [m.Cancel("1", "deadline")]
    assert callee.why_stopped("1", "deadline") == "took longer than its deadline of 2 s"
    callee.finish(4.1, m.Outcome("1", "success", {"p": 1}))
    assert _outcome(callee) == ("error", "deadline", Executed.YES)


def test_an_orphan_is_stopped_after_its_time_unless_its_caller_comes_back() -> None:
    callee = _callee()
    for id_, service in (("1", "move"), ("2", "track")):
        callee.receive(0.0, "coord", m.Call(id_, service, epoch=3))
    callee.orders()
    callee.link_down(1.0, "coord")
    assert callee.due() == 2.0
    callee.link_up(1.5, "coord", COORD)
    callee.advance(2.0)
    assert callee.orders() == []
    callee.link_down(3.0, "coord")
    callee.advance(3.9)
    assert callee.orders() == []
    callee.advance(4.0)
    assert callee.orders() == [m.Cancel("1", "orphan")], (
        "track has no orphan time and keeps running"
    )
    why = callee.why_stopped("1", "orphan")
    assert why.startswith("its coordinator was away for 1 s, so") and "`orphan_time`" in why
    callee.finish(4.1, m.Outcome("1", "error", cause="cancelled"))
    _said(callee)
    welcome = callee.link_up(5.0, "coord", COORD)
    assert isinstance(welcome, m.Welcome) and set(welcome.runs) == {"1", "2"}
    callee.receive(5.0, "coord", m.Call("1", "move", epoch=3))
    assert _outcome(callee) == ("error", "orphan", Executed.YES)


def test_a_cancel_races_with_the_end_of_its_run() -> None:
    callee = _callee()
    for id_ in "12":
        callee.receive(0.0, "coord", m.Call(id_, "track", epoch=3))
        callee.receive(0.1, "coord", m.Cancel(id_, "not wanted"))
        callee.receive(0.1, "coord", m.Cancel(id_, "again"))
    assert [order for order in callee.orders() if isinstance(order, m.Cancel)] == [
        m.Cancel("1", "not wanted"),
        m.Cancel("2", "not wanted"),
    ]
    _said(callee)
    callee.finish(0.2, m.Outcome("1", "success", {"p": 1}))
    assert _outcome(callee) == ("success", "", Executed.YES), (
        "the run had ended before the cancel arrived"
    )
    callee.finish(0.2, m.Outcome("2", "error", cause="cancelled"))
    assert _outcome(callee) == ("error", "cancelled", Executed.YES)
    callee.receive(0.3, "coord", m.Cancel("2", "again"))
    assert _outcome(callee) == ("error", "cancelled", Executed.YES), (
        "answered from the stored result"
    )


def test_a_call_whose_cancel_arrived_first_is_never_started() -> None:
    callee = _callee()
    callee.receive(0.0, "coord", m.Cancel("1", "not wanted"))
    callee.receive(0.1, "coord", m.Call("1", "track", epoch=3))
    outcomes = [message for message in _said(callee) if isinstance(message, m.Outcome)]
    assert {(one.cause, one.executed) for one in outcomes} == {("cancelled", Executed.NO)}
    assert callee.orders() == []


def test_another_caller_cannot_cancel_a_run() -> None:
    callee = _callee(COORD, m.Hello(2, 2, "client", "other", "o1"))
    callee.receive(0.0, "coord", m.Call("1", "track", epoch=3))
    callee.orders()
    callee.receive(0.1, "other", m.Cancel("1"))
    assert callee.orders() == []


@pytest.mark.parametrize(
    ("hello", "code"),
    [
        (m.Hello(3, 4, "coordinator", "coord", "c9", 9), "version"),
        (m.Hello(2, 2, "coordinator", "coord", "c0", 2), "old_epoch"),
        (m.Hello(2, 2, "coordinator", "coord", "c9", 3), "name_taken"),
        (m.Hello(2, 2, "coordinator", "new", "c9", 1, "d2"), "directory"),
        (m.Hello(2, 2, "coordinator", "coord", "c1", 3), ""),
        (m.Hello(2, 2, "coordinator", "coord", "c9", 4), ""),
        (m.Hello(2, 2, "coordinator", "new", "c9", 1, ""), ""),
    ],
)
def test_clients_that_are_welcomed_and_refused(hello: m.Hello, code: str) -> None:
    callee = _callee()
    answer = callee.link_up(1.0, hello.name, hello)
    assert (answer.code if isinstance(answer, m.Refuse) else "") == code
    if code == "directory":
        assert isinstance(answer, m.Refuse) and "copy the same file" in answer.text


def test_another_directory_may_be_allowed() -> None:
    callee = Callee("motion", "n1", OFFERS, directory="d1", any_directory=True)
    welcome = callee.link_up(0.0, "new", m.Hello(2, 2, "client", "new", "c", 0, "d2"))
    assert isinstance(welcome, m.Welcome) and welcome.directory == "d1", (
        "the welcome still names its own location file"
    )


def test_a_caller_that_was_not_welcomed_runs_nothing() -> None:
    callee = _callee()
    callee.receive(0.0, "stranger", m.Call("1", "get"))
    assert _outcome(callee) == ("error", "not_welcome", Executed.NO)


def test_results_are_forgotten_by_number_and_by_age_but_ids_are_not() -> None:
    callee = _callee(keeping=Retention(results=10.0, result_count=2))
    for n in range(3):
        callee.receive(float(n), "coord", m.Call(str(n), "get", epoch=3))
    welcome = callee.link_up(3.0, "coord", COORD)
    assert isinstance(welcome, m.Welcome) and welcome.runs == ("1", "2")
    assert callee.due() == 11.0
    callee.advance(11.0)
    _said(callee)
    for id_, cause in (("0", "forgotten"), ("1", "forgotten"), ("2", "")):
        callee.receive(11.0, "coord", m.Call(id_, "get", epoch=3))
        assert _outcome(callee)[1] == cause


def _called_and_acknowledged(callee: Callee, *ids: str) -> None:
    for id_ in ids:
        callee.receive(0.0, "coord", m.Call(id_, "get", epoch=3))
        callee.receive(0.0, "coord", m.ResultAck(id_))
    _said(callee)


@pytest.mark.once
def test_ids_that_count_up_are_never_forgotten() -> None:
    """Neither by number nor by age: tried with a day, and with almost as many calls as it may
    remember."""
    callee = _callee(keeping=Retention(id_groups=41))
    _called_and_acknowledged(callee, *(f"m/work#{n}" for n in range(1, 40_000)))
    callee.advance(86_400.0)
    for n in (1, 9, 10, 999, 1_000, 20_000, 39_999):
        callee.receive(86_400.0, "coord", m.Call(f"m/work#{n}", "get", epoch=3))
        assert _outcome(callee) == ("error", "forgotten", Executed.UNKNOWN)
    callee.receive(86_400.0, "coord", m.Call("m/work#40000", "get", epoch=3, again=True))
    assert _outcome(callee)[0] == "success", "the call never arrived, and the node knows that"


def test_a_node_that_has_forgotten_ids_runs_no_call_that_may_be_among_them() -> None:
    callee = _callee(keeping=Retention(id_groups=2))
    _called_and_acknowledged(callee, "work-1", "a", "b")
    for service in ("get", "move"):
        again = m.Call(f"{service}/work-2", service, epoch=3, again=True)
        assert callee.answer_inline(0.0, "coord", again) is None
        for _ in range(2):  # The node also remembers this answer.
            callee.receive(0.0, "coord", again)
            assert (
                _outcome(callee) == ("error", "forgotten", Executed.UNKNOWN)
                and callee.orders() == []
            )
    callee.receive(0.0, "coord", m.Call("work-3", "get", epoch=3))
    assert _outcome(callee)[0] == "success", "a first call is not among the forgotten ids"
    callee.receive(0.0, "coord", m.Cancel("work-1"))
    assert _outcome(callee) == ("error", "forgotten", Executed.UNKNOWN), (
        "the answer must not claim that the call did not run"
    )
    refused = m.Call("work-4", "move", epoch=2, again=True)
    callee.receive(0.0, "coord", refused)
    assert _outcome(callee) == ("error", "forgotten", Executed.UNKNOWN), (
        "it is not refused as not executed either"
    )


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["", "a", "a0", "a1", "#", "a/00", "a\u0663"]), st.integers(0, 5_000)
        ),
        max_size=60,
    )
)
def test_ids_in_groups_are_the_ids(ids: list[tuple[str, int]]) -> None:
    known, added = FinishedIds(1_000), set[str]()
    for text, number in ids:
        for id_ in (text, f"{text}{number}"):
            assert (id_ in known) == (id_ in added)
            known.add(id_)
            added.add(id_)
    for text, number in ids:
        for id_ in (
            f"{text}{number}",
            f"{text}{number + 1}",
            f"{text}0{number}",
            f"{text}{number}000",
            f"{text}{number + 1_000}",
        ):
            assert (id_ in known) == (id_ in added), id_
    assert known.complete


def test_a_result_that_cannot_be_sent_is_an_error_of_the_action() -> None:
    callee = _callee()
    callee.receive(0.0, "coord", m.Call("1", "track", epoch=3))
    outcome = callee.finish(1.0, m.Outcome("1", "success", {"image": object()}))
    assert (outcome.status, outcome.cause, outcome.executed) == (
        "error",
        "bad_result",
        Executed.YES,
    )
    assert "values.image" in outcome.text


def test_commands_reach_the_node_and_their_answers_return() -> None:
    callee = _callee()
    command = m.Command("k1", "hold", "arm")
    callee.receive(0.0, "coord", command)
    assert callee.orders() == [command]
    callee.answer(0.1, "k1", True, {"arm": "held"})
    assert callee.messages() == [("coord", m.Answer("k1", True, {"arm": "held"}))]


def test_a_restarted_caller_may_use_the_ids_of_its_commands_again() -> None:
    """The answer to its former process does not answer a new command with the same id."""
    callee = _callee()
    command = m.Command("k1", "hold", "arm")
    callee.receive(0.0, "coord", command)
    callee.orders()
    callee.answer(0.1, "k1", True, {"arm": "held"})
    callee.link_down(1.0, "coord")
    assert isinstance(
        callee.link_up(2.0, "coord", m.Hello(2, 2, "coordinator", "coord", "c2", 4)), m.Welcome
    )
    callee.messages()
    callee.receive(2.1, "coord", command)
    assert callee.orders() == [command] and callee.messages() == []


def test_a_report_about_an_inactive_run_is_an_error_of_the_node_itself() -> None:
    callee = _callee()
    with pytest.raises(ValueError, match="no active run"):
        callee.finish(0.0, m.Outcome("1", "success"))
    with pytest.raises(ValueError, match="no active run"):
        callee.feedback(0.0, "1", 0.5)
    with pytest.raises(ValueError, match="no active run"):
        callee.raise_event(0.0, "lost", run="1")
    with pytest.raises(ValueError, match="waits for an answer"):
        callee.answer(0.0, "k1", True)


def test_a_service_answered_at_once_is_answered_exactly_once() -> None:
    callee = _callee()
    outcome = callee.answer_inline(1.0, "coord", m.Call("1", "get", epoch=3))
    assert outcome == m.Outcome("1", "success", {"at": 1.0}) and not callee.messages()
    callee.keep(1.0, "coord", outcome)
    assert callee.soonest == 1.0 + Retention().results, "the result is not kept for ever"
    for call in (
        m.Call("1", "get", epoch=3),
        m.Call("2", "track", epoch=3),
        m.Call("3", "nowhere", epoch=3),
    ):
        assert callee.answer_inline(2.0, "coord", call) is None
    assert callee.answer_inline(2.0, "coord", m.Call("4", "get", epoch=3, boot="n0")) is None
    callee.receive(2.0, "coord", m.Call("1", "get", epoch=3))
    assert _said(callee) == [outcome]


@pytest.mark.parametrize("role", ["client", "coordinator"])
def test_former_callers_do_not_fill_the_memory(role: str) -> None:
    """This includes coordinators that died without BYE, whose subscriptions outlive their links."""
    callee = Callee("motion", "n1", OFFERS)
    for n in range(2_000):
        name = f"client{n}"
        assert isinstance(callee.link_up(0.0, name, m.Hello(2, 2, role, name, "b")), m.Welcome)
        callee.receive(0.0, name, m.Subscribe(("tick",)))
        callee.link_down(0.0, name)
    assert len(callee._peers._peers) <= 257 and len(callee.events._listeners) <= 257
    assert callee.events.raise_event(m.Event("tick", "timer", 0), False, "")[1] == []


@pytest.mark.parametrize("target", ["arm", ""])
def test_the_deadline_of_a_held_run_stands_still(target: str) -> None:
    """An operator's pause of 4 s moves a deadline of 2 s to 6 s."""
    callee = _callee(COORD)
    callee.receive(0.0, "coord", m.Call("1", "move", {}, 2.0, 3))
    callee.receive(0.5, "coord", m.Command("h", "hold", target))
    callee.answer(1.0, "h", True, {"answers": {"arm": "held"}})
    callee.orders()
    callee.advance(4.9)
    callee.receive(5.0, "coord", m.Command("r", "release", target))
    assert [type(order) for order in callee.orders()] == [m.Command]
    assert callee.due() == 6.0
    callee.advance(5.99)
    assert callee.orders() == []
    callee.advance(6.0)
    assert callee.orders() == [m.Cancel("1", "deadline")]


@pytest.mark.parametrize(
    "answers", [{"arm": "cannot hold"}, {"camera": "held"}, {"motion": "held"}, {}]
)
def test_the_deadline_of_a_run_that_is_not_held_still_counts_during_a_pause(
    answers: dict[str, str],
) -> None:
    """Either its device cannot hold, or another device answered the hold."""
    callee = _callee(COORD)
    callee.receive(0.0, "coord", m.Call("1", "move", {}, 2.0, 3))
    callee.receive(0.5, "coord", m.Command("h", "hold"))
    callee.answer(1.0, "h", False, {"answers": answers})
    callee.orders()
    callee.advance(2.0)
    assert callee.orders() == [m.Cancel("1", "deadline")]


def test_the_deadline_of_a_run_that_began_after_the_hold_counts() -> None:
    """The answer came late: the run that was to be held has ended, and nobody releases the next."""
    callee = _callee(COORD)
    callee.receive(0.0, "coord", m.Call("1", "move", {}, 2.0, 3))
    callee.receive(0.5, "coord", m.Command("h", "hold", "arm"))
    callee.finish(0.6, m.Outcome("1", "success"))
    callee.receive(0.7, "coord", m.Call("2", "move", {}, 2.0, 3))
    callee.answer(1.0, "h", True, {"answers": {"arm": "held"}})
    callee.orders()
    callee.advance(2.7)
    assert callee.orders() == [m.Cancel("2", "deadline")]


@pytest.mark.parametrize("again", [False, True])
def test_a_run_that_was_released_before_its_hold_was_answered_is_not_held(again: bool) -> None:
    """Pause, continue and, `again`, pause come together; the answers follow."""
    callee = _callee(COORD)
    callee.receive(0.0, "coord", m.Call("1", "move", {}, 2.0, 3))
    callee.receive(0.5, "coord", m.Command("h1", "hold", "arm"))
    callee.receive(0.5, "coord", m.Command("r", "release", "arm"))
    if again:
        callee.receive(0.5, "coord", m.Command("h2", "hold", "arm"))
    for hold in ("h1", "h2") if again else ("h1",):
        callee.answer(1.0, hold, True, {"answers": {"arm": "held"}})
    callee.orders()
    callee.advance(2.0)
    assert callee.orders() == ([] if again else [m.Cancel("1", "deadline")])


def test_a_held_run_is_still_an_orphan_without_its_caller() -> None:
    """A pause does not let a run continue without its caller."""
    callee = _callee(COORD)
    callee.receive(0.0, "coord", m.Call("1", "move", {}, 2.0, 3))
    callee.receive(0.5, "coord", m.Command("h", "hold"))
    callee.answer(1.0, "h", True, {"answers": {"arm": "held"}})
    callee.orders()
    callee.link_down(1.0, "coord")
    callee.advance(2.0)
    assert callee.orders() == [m.Cancel("1", "orphan")]


def test_a_repeated_command_is_carried_out_once() -> None:
    """While the command waits for its answer, a repetition does nothing. Afterwards it gets the
    same answer.

    Another caller may use the id again after the answer, but not before.
    """
    callee = _callee(COORD, m.Hello(2, 2, "client", "other", "o1"))
    callee.messages()
    stop = m.Command("k1", "stop", "arm")
    for _ in range(3):
        callee.receive(0.0, "coord", stop)
    assert callee.orders() == [stop] and callee.messages() == []
    callee.receive(0.1, "other", stop)
    [(peer, answer)] = callee.messages()
    assert peer == "other" and isinstance(answer, m.Answer) and answer.data["cause"] == "id_taken"
    callee.answer(0.1, "k1", True, {"answers": {"arm": "stopped"}})
    (said,) = callee.messages()
    callee.receive(0.2, "coord", stop)
    assert callee.orders() == [] and callee.messages() == [said]
    callee.receive(0.3, "other", stop)
    assert callee.orders() == [stop] and callee.messages() == []
    callee.answer(0.4, "k1", True)
    for number in range(1_000):
        callee.receive(1.0, "coord", m.Command(f"more {number}", "status"))
        callee.answer(1.0, f"more {number}", True)
    assert len(callee._answers) <= 64 and not callee._commands


def test_an_offer_for_some_roles_is_refused_to_others() -> None:
    """For example the ticket of a set-point stream: nodes and coordinators get it, clients that may
    only look do not."""
    offers = {
        "stream:points": Offer(
            inline=lambda _, call: m.Outcome(call.id, "success"), roles=frozenset(("node",))
        )
    }
    callee = Callee("motion", "n1", offers)
    for role, cause in (("client", "not_for_role"), ("stream", "not_for_role"), ("node", "")):
        callee.link_up(0.0, role, m.Hello(2, 2, role, role, "b"))
        callee.messages()
        assert (
            callee.answer_inline(0.0, role, m.Call(f"{role}/1", "stream:points")) is None
        ) is bool(cause)
        callee.receive(0.0, role, m.Call(f"{role}/2", "stream:points"))
        [(_, outcome)] = callee.messages()
        assert isinstance(outcome, m.Outcome)
        assert (outcome.cause, outcome.executed) == (
            cause,
            m.Executed.NO if cause else m.Executed.YES,
        )
