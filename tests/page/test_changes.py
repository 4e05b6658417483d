"""Changes applied one by one or merged give the same state; a client that is far behind needs
little memory."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, strategies as st

from petrobot.coordinator.operator import port
from petrobot.coordinator.operator.changes import (
    KINDS,
    PENDING_LIMIT,
    Pending,
    apply,
    copy_state,
    empty_state,
)
from petrobot.coordinator.operator.port import Feed

NAMES = st.sampled_from(["a", "b", "c"])
SMALL = st.integers(0, 5)
NAMED = {
    "node": "node",
    "event": "event",
    "variable": "value",
    "device": "device",
    "image": "image",
    "report": "report",
}


@st.composite
def changes(draw: st.DrawFn) -> list[dict[str, Any]]:
    """Return numbered changes as a mission would emit them: a run starts, is active, and ends."""
    made: list[dict[str, Any]] = []
    going: list[str] = []
    for number in range(1, draw(st.integers(1, 40)) + 1):
        kind = draw(st.sampled_from(sorted(KINDS - {"reset"})))
        if kind in ("run_progress", "run_ended") and not going:
            kind = "run_started"
        change: dict[str, Any] = {"kind": kind, "sequence": number, "time": number / 10}
        change |= draw(_fields(kind, number, going))
        made.append(change)
    return made


@st.composite
def _fields(draw: st.DrawFn, kind: str, number: int, going: list[str]) -> dict[str, Any]:
    if kind == "run_started":
        going.append(f"r{number}")
        return {"run": {"id": f"r{number}", "place": draw(NAMES), "progress": 0.0}}
    if kind == "run_progress":
        return {
            "id": draw(st.sampled_from(going)),
            draw(st.sampled_from(["progress", "state", "held_since", "held_for"])): draw(SMALL),
        }
    if kind == "run_ended":
        return {"id": going.pop(), "status": "success", "ended": number}
    if kind == "run_judged":
        return {
            "id": f"r{draw(st.integers(1, number))}",
            "status": draw(st.sampled_from(["success", "failure"])),
        }
    if kind == "marking":
        return {"marking": draw(st.dictionaries(NAMES, SMALL))}
    if kind == "mission":
        return {
            "mission": draw(st.dictionaries(st.sampled_from(["state", "reason", "firings"]), SMALL))
        }
    if kind == "fired":
        return {"firing": {"number": number, "transition": draw(NAMES)}}
    if kind == "notice":
        return {"notice": {"level": "info", "text": draw(NAMES)}}
    if kind == "setpoint":
        return {
            "stream": draw(NAMES),
            "samples": [[number, draw(SMALL)]],
            "setpoint": {"period": draw(SMALL)},
        }
    if kind == "selector":
        return {"name": draw(NAMES), "selector": {"override": draw(NAMES)}}
    if kind in NAMED:
        return {"name": draw(NAMES), NAMED[kind]: draw(SMALL)}
    return {kind: draw(SMALL)}


@given(changes(), st.lists(st.integers(1, 40), max_size=6))
def test_merged_deltas_lead_to_the_same_state(made: list[dict[str, Any]], cuts: list[int]) -> None:
    """However the changes are divided into deltas, a client reaches the server's state, and numbers
    have no gap."""
    server, client = empty_state(), empty_state()
    pending = Pending()
    seen = 0
    for change in made:
        apply(server, change)
        pending.add(change)
        if change["sequence"] in cuts or change is made[-1]:
            delta = pending.take()
            assert delta["first"] == seen + 1
            seen = delta["last"]
            for merged in delta["changes"]:
                apply(client, merged)
            client["sequence"], client["time"] = delta["last"], max(client["time"], delta["time"])
    assert client == server


@given(changes())
def test_a_snapshot_is_not_affected_by_later_changes(made: list[dict[str, Any]]) -> None:
    """A snapshot handed out does not change while it is read."""
    feed = Feed()
    half = len(made) // 2
    for change in made[:half]:
        feed.emit(**{k: v for k, v in change.items() if k != "sequence"})
    snapshot = feed.snapshot()
    kept = copy_state(snapshot)
    for change in made[half:]:
        feed.emit(**{k: v for k, v in change.items() if k != "sequence"})
    assert snapshot == kept
    assert feed.state["sequence"] == len(made)


def test_a_verdict_changes_only_its_own_run() -> None:
    """The page then shows the final result of the provisional run; a run that has left the list
    does not return."""
    state = empty_state()
    for change in (
        {"kind": "run_started", "run": {"id": "a#1", "place": "a"}},
        {"kind": "run_started", "run": {"id": "a#2", "place": "a"}},
        {"kind": "run_ended", "id": "a#1", "status": "success", "ended": 1.0, "reason": {}},
        {"kind": "run_ended", "id": "a#2", "status": "success", "ended": 2.0, "reason": {}},
        {"kind": "run_judged", "id": "a#1", "status": "failure", "reason": {"code": "crooked"}},
        {"kind": "run_judged", "id": "a#9", "status": "failure", "reason": {}},
    ):
        apply(state, change)
    assert [(run["id"], run["status"], run["ended"]) for run in state["ended"]] == [
        ("a#1", "failure", 1.0),
        ("a#2", "success", 2.0),
    ]
    assert state["ended"][0]["reason"] == {"code": "crooked"} and not state["runs"]


def test_the_backlog_of_a_slow_client_is_bounded() -> None:
    """Ten thousand firings that the client does not fetch are not queued: it gets a snapshot
    instead."""
    pending = Pending()
    for number in range(1, 10_001):
        pending.add({"kind": "fired", "sequence": number, "firing": {"number": number}})
    assert pending.stale
    delta = pending.take()
    assert delta["changes"] == []
    assert not pending


def test_only_the_newest_image_and_progress_are_kept() -> None:
    """At any rate of updates they take one entry each."""
    pending = Pending()
    for number in range(1, 50 * PENDING_LIMIT):
        kind = ("image", "run_progress", "variable", "marking")[number % 4]
        pending.add(
            {
                "kind": kind,
                "sequence": number,
                "name": "x",
                "id": "r",
                "image": number,
                "value": 1,
                "marking": {},
            }
        )
    assert not pending.stale
    assert len(pending.take()["changes"]) == 4


def test_a_reset_sends_every_client_a_snapshot() -> None:
    """Another mission is sent as a snapshot, not as a delta."""
    feed = Feed()
    pending = Pending()
    feed.subscribe(pending.add)
    feed.emit("variable", name="a", value=1)
    feed.replace(mission={"id": "two", "state": "idle", "mode": "realtime"})
    assert pending.stale
    assert feed.snapshot()["mission"]["id"] == "two"
    assert feed.snapshot()["sequence"] == 2


def test_a_change_and_a_snapshot_have_the_time_of_the_clock() -> None:
    """Also when they report nothing of the net: a client computes the time of its runs from it."""
    feed, seen = Feed(), list[dict[str, Any]]()
    feed.subscribe(seen.append)
    feed.emit("variable", time=1.0, name="a", value=1)
    feed.clock = lambda: 7.5
    feed.emit("device", name="arm", device={"state": "up"})
    assert seen[-1]["time"] == feed.state["time"] == 7.5
    feed.clock = lambda: 9.0
    assert feed.snapshot()["time"] == 9.0
    feed.clock = None
    feed.emit("device", name="arm", device={"state": "up"})
    assert feed.snapshot()["time"] == 7.5


def test_a_script_that_reads_snapshots_counts_as_watching(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes are asked for their devices only while somebody watches."""
    now = 100.0
    monkeypatch.setattr(port, "monotonic", lambda: now)
    feed = Feed()
    watched = [feed.watched]
    feed.snapshot()
    for later in (4.9, 0.2):
        now += later
        watched.append(feed.watched)
    assert watched == [False, True, False]
