"""A service that is a plain function: what its caller receives, also if the function is faulty."""

from __future__ import annotations

import time
from typing import Any

import pytest

from petrobot.services.comm.location_file import ActionEntry, ServiceEntry
from petrobot.services.comm.protocol.messages import Call, Event, Executed, Outcome
from petrobot.services.node import watchdog
from petrobot.services.node.inline_host import InlineHost
from petrobot.services.node.node import inline_service

EVENTS: list[Event] = []


def _call(function: str, **arguments: Any) -> Any:
    EVENTS.clear()
    entry = ServiceEntry("it", "here", f"toy_cell.actions:{function}")
    answer = inline_service(entry, EVENTS.append)
    return answer(1.5, Call("c1", "it", arguments))


def test_its_values_are_plain_and_its_events_are_delivered() -> None:
    outcome = _call("double", numbers=[1.0, 2.0])
    assert (outcome.status, outcome.values, outcome.executed) == (
        "success",
        {"numbers": [2.0, 4.0]},
        Executed.YES,
    )
    assert type(outcome.values["numbers"]) is list, "as its caller would see it over the wire"
    assert [Event("doubled", "it", 0, {"count": 2})] == EVENTS


def test_it_may_say_that_it_is_unknown_what_was_executed() -> None:
    outcome = _call("unsure")
    assert (outcome.status, outcome.cause, outcome.executed) == ("error", "lost", Executed.UNKNOWN)


def test_its_verdicts_are_delivered() -> None:
    """A service may send verdicts like an action: it uses no device, and can see what all devices
    did."""
    assert _call("judge", run="m/pick#1").status == "success"
    judged = {"run": "m/pick#1", "status": "failure", "cause": "crooked", "text": ""}
    assert [Event("verdict:m", "it", 0, judged)] == EVENTS
    assert _call("judge", run="pick").cause == "exception" and EVENTS == []


@pytest.mark.parametrize(
    ("function", "arguments", "cause", "executed", "says"),
    [
        ("twisted", {}, "bad_result", Executed.YES, "values.rows[0].key: the key 1 is not a str"),
        ("broken", {}, "exception", Executed.YES, "nothing is divided by nothing"),
        ("leaving", {"by": "exception"}, "exception", Executed.YES, "Leaving: (its message cannot"),
        ("leaving", {"by": "value"}, "bad_result", Executed.YES, "cannot be read: SystemExit"),
        ("double", {"figures": [1.0]}, "bad_arguments", Executed.NO, "it: "),
    ],
)
def test_a_fault_is_one_error_with_its_reason(
    function: str, arguments: dict[str, Any], cause: str, executed: Executed, says: str
) -> None:
    outcome = _call(function, **arguments)
    assert (outcome.status, outcome.cause, outcome.executed, outcome.values) == (
        "error",
        cause,
        executed,
        {},
    )
    assert says in outcome.text


@pytest.mark.parametrize("waits", [False, True], ids=["def", "async def"])
def test_one_that_hangs_is_named_and_interrupted(
    waits: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Else its node would answer no one, for ever."""
    monkeypatch.setattr(watchdog, "LIMIT", 0.4)
    monkeypatch.setattr(watchdog, "LOOK", 0.05)
    watch, call = watchdog.Watchdog("here", 0.1), Call("c1", "it", {})
    begun = time.monotonic()
    if waits:
        entry = {"it": ActionEntry("it", "toy_cell.actions:freeze", "it", "here", "")}
        host = InlineHost(entry, clock=lambda: 0.0, watch=watch)
        host.take(0.0, call)
        host.advance(0.0)
        (end,) = (said for said in host.reports() if isinstance(said, Outcome))
    else:
        function = ServiceEntry("it", "here", "toy_cell.actions:freeze_at_once")
        end = inline_service(function, EVENTS.append, watch)(0.0, call)
    watch.close()
    assert time.monotonic() - begun < 30.0, "it came back by itself"
    assert (end.status, end.cause) == ("error", "hung") and "(actions.py:" in end.text, end
    assert "has not come back for 0.1 s, and meanwhile the node answers no one" in caplog.text
