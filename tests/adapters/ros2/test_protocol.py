"""Checks of rosbridge messages, and the phases of a goal."""

from __future__ import annotations

import json
import math
from enum import StrEnum
from typing import Any

import pytest
from hypothesis import example, given, strategies as st

from petrobot.services.adapters.ros2.bridge import (
    RUNNING,
    ExchangePhase,
    Exchanges,
    Fragments,
    parse,
)
from petrobot.services.adapters.ros2.messages import filled, pick, unfit
from petrobot.services.comm.protocol.plain import plain

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "7",
        '"op"',
        "{}",
        '{"op": 7}',
        "[" * 100_000,
        '{"op": "x", "n": ' + "9" * 5000,
    ],
)
def test_data_that_is_not_a_message_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"not JSON|expected an object"):
        parse(text)


def test_numbers_that_are_not_finite_become_null() -> None:
    """As newer servers send them; older ones send JavaScript's words."""
    told = parse('{"op": "publish", "msg": {"a": NaN, "b": [-Infinity, 1e999, 1.5]}}')
    assert told["msg"] == {"a": None, "b": [None, None, 1.5]}
    assert unfit(told["msg"]) == "a: is not a finite number"
    assert unfit({"b": [1.0, {"c": None}]}) == "b.1.c: is not a finite number"


@given(st.dictionaries(st.text(), VALUES, max_size=5))
def test_accepted_values_can_be_sent(values: dict[str, Any]) -> None:
    """Accepted values are plain data with finite numbers, which petrobot can send."""
    fault = unfit(values)
    try:
        text = json.dumps(values, allow_nan=False)
        sound = "null" not in text or None not in _flat(values)
        plain(values)
    except (ValueError, TypeError):
        sound = False
    assert (fault == "") == sound, fault


def _flat(value: Any) -> list[Any]:
    if isinstance(value, dict | list):
        inner = value.values() if isinstance(value, dict) else value
        return [leaf for item in inner for leaf in _flat(item)]
    return [value]


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ([], "expected a message"),
        ({"a": 2**70}, "64 bits"),
        ({"a": "\ud800"}, "Unicode"),
        ({"a": "b", "\ud800": 1}, "Unicode"),
        ({"a": [0] * 30_000}, "more than 20000 items"),
        ({"a": [[]] * 2_000}, "1000 lists and tables"),
        ({"a": "x" * 70_000}, "longer than 65536 characters"),
        (json.loads('{"a": ' * 30 + "[1]" + "}" * 30), "deep"),
    ],
)
def test_values_that_cannot_be_sent_are_refused(values: Any, word: str) -> None:
    assert word in unfit(values)


def test_paths() -> None:
    message = filled({"pose": {"z": 1}}, {"pose.x": 2.0, "header.frame_id": "map"})
    assert message == {"pose": {"z": 1, "x": 2.0}, "header": {"frame_id": "map"}}
    assert pick({"points": [{"x": 3}]}, "points.0.x") == 3
    for path in ("points.1.x", "points.x", "lines", "points.0.x.y"):
        with pytest.raises(ValueError, match=path):
            pick({"points": [{"x": 3}]}, path)
    with pytest.raises(ValueError, match="not a table"):
        filled({"pose": 3}, {"pose.x": 1})


class Word(StrEnum):
    """Event in the life of a goal."""

    FEEDBACK = "feedback"
    SUCCEEDED = "succeeded"
    CANCELLED = "cancelled"
    ABORTED = "aborted"
    REFUSED = "refused"
    CANCEL = "cancel"
    DOWN = "down"
    UP = "up"
    SILENCE = "silence"


GOAL = {"op": "send_action_goal", "action": "/a", "action_type": "p/action/A", "args": {}}
RESULTS = {
    Word.SUCCEEDED: {"status": 4, "result": True, "values": {"n": 4}},
    Word.CANCELLED: {"status": 5, "result": True, "values": {"n": 5}},
    Word.ABORTED: {"status": 6, "result": True, "values": {"n": 6}},
    Word.REFUSED: {"status": 0, "result": False, "values": "Action goal was rejected"},
}
ENDED = set(ExchangePhase) - RUNNING


@given(st.lists(st.tuples(st.sampled_from(Word), st.floats(0.0, 3.0)), max_size=30))
@example([(Word.CANCEL, 0.0), (Word.CANCEL, 2.0), (Word.UP, 3.0)])
def test_a_goal_ends_once_by_the_first_end(words: list[tuple[Word, float]]) -> None:
    """For any events in any order: the first end counts and a run never sees another one, a lost
    goal is cancelled over the next link, and a cancel is sent only for a goal that may move the
    robot."""
    patience = 5.0
    exchanges = Exchanges(patience)
    identity = exchanges.begin(0.0, "run", GOAL)["id"]
    one, now, up = exchanges.open["run"], 0.0, True
    ended: ExchangePhase | None = None
    reported = False
    for word, pause in words:
        now += pause
        before = one.phase
        sent = []
        if word is Word.CANCEL:
            sent = exchanges.cancel(now, "run")
        elif word in (Word.DOWN, Word.UP):
            up, lost = word is Word.UP, list(exchanges.orphans)
            sent = exchanges.link(now, up)
            assert not sent or up
            # One that is given up at this moment was cancelled in vain for all its patience.
            assert not up or [m["id"] for m in sent if m["id"] in lost] == lost
        elif word is Word.SILENCE:
            waited = now - one.heard >= patience
            sent = exchanges.advance(now)
            given_up = {ExchangePhase.CANCELLING: ExchangePhase.UNANSWERED}
            assert one.phase is (given_up.get(before, before) if waited else before)
        elif word is Word.FEEDBACK:
            told = {"op": "action_feedback", "id": identity, "values": {"t": now}}
            exchanges.receive(now, told)
        else:
            exchanges.receive(now, {"op": "action_result", "id": identity, **RESULTS[word]})
            reported = True
        assert all(m["op"] == "cancel_action_goal" and m["id"] == identity for m in sent)
        assert not sent or not reported
        if ended is None and one.phase in ENDED:
            ended = one.phase
            if word in RESULTS and word is not Word.REFUSED:
                assert one.values == {"n": RESULTS[word]["status"]}
        assert ended is None or one.phase is ended  # the result that a run sees stays the same
        # Until the server reports its end, the goal is not forgotten.
        assert reported or one.phase in RUNNING or list(exchanges.orphans) == [identity]
        assert not (reported and exchanges.orphans)
    # from any phase it reaches a final one
    exchanges.cancel(now, "run")
    exchanges.advance(now + patience + 1e-6)
    assert one.phase in ENDED
    exchanges.forget("run")
    exchanges.receive(now, {"op": "action_result", "id": identity, **RESULTS[Word.SUCCEEDED]})
    assert not exchanges.open and not exchanges.orphans


def test_repeated_cancels_do_not_extend_the_wait() -> None:
    """If the server never answers, the cancel is repeated each second, and finally given up."""
    exchanges = Exchanges(5.0)
    exchanges.begin(0.0, "run", GOAL)
    sent = exchanges.cancel(0.0, "run")
    for tick in range(1, 100):
        sent += exchanges.advance(tick * 0.1)
    assert exchanges.open["run"].phase is ExchangePhase.UNANSWERED
    assert len(sent) == 5


@pytest.mark.parametrize("late", [True, False])
def test_an_unanswered_goal_is_unknown_until_the_server_reports_an_end(late: bool) -> None:
    """Its own, or that of a later goal of the same action."""
    exchanges = Exchanges(5.0)
    goal = exchanges.begin(0.0, "run", GOAL)["id"]
    exchanges.cancel(0.0, "run")
    exchanges.advance(6.0)
    exchanges.forget("run")
    for other in ({**GOAL, "action": "/other"}, {"op": "call_service", "service": "/s"}):
        answer = exchanges.begin(7.0, "another", other)
        op = "action_result" if "action" in other else "service_response"
        exchanges.receive(7.0, {"op": op, "id": answer["id"], "values": {}, "status": 4})
        exchanges.advance(7.0)
        assert list(exchanges.orphans) == [goal]
    ended = goal if late else exchanges.begin(8.0, "later", GOAL)["id"]
    exchanges.receive(8.0, {"op": "action_feedback", "id": ended, "values": {}})
    assert exchanges.orphans
    exchanges.receive(8.0, {"op": "action_result", "id": ended, "values": {}, "status": 4})
    assert not exchanges.orphans


def test_a_second_goal_of_a_run_does_not_prevent_the_cancel_of_the_first() -> None:
    exchanges = Exchanges(5.0)
    lost = exchanges.begin(0.0, "run", GOAL)["id"]
    exchanges.link(0.0, False)
    exchanges.forget("run")
    exchanges.begin(0.0, "run", GOAL)
    assert [m["id"] for m in exchanges.link(0.0, True)] == [lost]
    exchanges.advance(6.0)
    assert list(exchanges.open) == ["run"]


def test_unread_results_do_not_accumulate() -> None:
    exchanges = Exchanges(5.0)
    for number in range(100):
        identity = exchanges.begin(0.0, f"run {number}", GOAL)["id"]
        exchanges.receive(0.0, {"op": "action_result", "id": identity, **RESULTS[Word.SUCCEEDED]})
    assert len(exchanges.open) < 10


def test_fragments_of_a_server_that_writes_all_numbers_as_decimals() -> None:
    waiting = Fragments()
    parts = [{"num": n, "total": 2.0, "data": d} for n, d in ((1.0, '"x"}'), (0.0, '{"op":'))]
    assert [waiting.add({"op": "fragment", "id": "a", **part}) for part in parts] == [
        None,
        {"op": "x"},
    ]


def test_ids_are_globally_unique() -> None:
    """All clients of a rosbridge server share one table of goals by id."""
    ids = [e.begin(0.0, "run", GOAL)["id"] for e in (Exchanges(1.0), Exchanges(1.0)) for _ in "12"]
    assert len(set(ids)) == 4


@pytest.mark.parametrize(
    ("said", "phase", "text"),
    [
        (
            {"op": "status", "level": "error", "msg": "Unknown operation"},
            ExchangePhase.REJECTED,
            "Unknown",
        ),
        ({"op": "status", "level": "warning", "msg": "slow"}, ExchangePhase.PENDING, ""),
        ({"op": "action_result", "status": 6, "result": False}, ExchangePhase.ABORTED, "status 6"),
        ({"op": "action_result", "status": 2, "result": True}, ExchangePhase.ABORTED, "status 2"),
        ({"op": "action_result", "status": None, "result": True}, ExchangePhase.ABORTED, "null"),
        ({"op": "action_result", "result": True, "values": {}}, ExchangePhase.SUCCEEDED, ""),
        ({"op": "action_result", "result": False}, ExchangePhase.REJECTED, "no reason"),
        ({"op": "action_result", "status": [], "result": True}, ExchangePhase.ABORTED, "status"),
        ({"op": "action_result", "result": 0}, ExchangePhase.REJECTED, "no reason"),
        ({"op": "action_feedback", "values": {"x": 2**70}}, ExchangePhase.ACTIVE, ""),
    ],
)
def test_words_of_unusual_servers(said: dict[str, Any], phase: ExchangePhase, text: str) -> None:
    exchanges = Exchanges(1.0)
    identity = exchanges.begin(0.0, "run", GOAL)["id"]
    exchanges.receive(0.0, {"id": identity, **said})
    one = exchanges.open["run"]
    assert one.phase is phase and text in one.text and one.feedback == {}
    exchanges.receive(0.0, {"op": "action_result", "id": "another", "result": True})
    assert one.phase is phase


def test_an_answer_of_another_kind_ends_nothing() -> None:
    """Else a response with the id of a goal would be its success."""
    exchanges = Exchanges(1.0)
    goal = exchanges.begin(0.0, "goal", GOAL)["id"]
    call = exchanges.begin(0.0, "call", {"op": "call_service", "service": "/s"})["id"]
    for identity, op in ((goal, "service_response"), (call, "action_result")):
        said = {"op": op, "id": identity, "values": {}, "result": True, "status": 4}
        assert "another operation" in exchanges.receive(0.0, said)
    assert {one.phase for one in exchanges.open.values()} == {ExchangePhase.PENDING}


def test_a_response_may_have_the_fields_status_and_result() -> None:
    """Only old servers wrap a goal's result into these two."""
    exchanges = Exchanges(1.0)
    call = exchanges.begin(0.0, "run", {"op": "call_service", "service": "/s"})["id"]
    values = {"status": 6, "result": {"x": 1}}
    exchanges.receive(0.0, {"op": "service_response", "id": call, "values": values, "result": True})
    one = exchanges.open["run"]
    assert (one.phase, one.values) == (ExchangePhase.SUCCEEDED, values)


@pytest.mark.parametrize(
    ("said", "fault"),
    [
        ({"op": "status", "level": "error", "id": [1], "msg": "odd"}, "reports: odd"),
        ({"op": "png", "data": "iVBORw0KGgo="}, "operation png: was not asked for"),
        ({"op": "status", "level": "error", "msg": "no such type"}, "reports: no such type"),
        ({"op": "status", "level": "warning", "msg": "slow"}, ""),
        ({"op": "action_result", "id": "another", "result": True}, ""),
    ],
)
def test_what_no_goal_can_be_told_is_shown(said: dict[str, Any], fault: str) -> None:
    assert fault in Exchanges(1.0).receive(0.0, said)


def test_a_result_keeps_only_the_fields_that_are_asked_for() -> None:
    exchanges = Exchanges(1.0)
    identity = exchanges.begin(0.0, "run", GOAL, ["code"])["id"]
    values = {"code": {"val": 1}, "trajectory": [math.nan]}
    said = {"op": "action_result", "id": identity, "status": 4, "result": True, "values": values}
    exchanges.receive(0.0, said)
    assert exchanges.open["run"].values == {"code": {"val": 1}}
