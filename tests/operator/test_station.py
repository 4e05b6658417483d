"""A permanent coordinator: tasks are started again and again, and every impossible start is
refused with a reason."""

from __future__ import annotations

import asyncio
import json
import math
import os
import shutil
import threading
from collections import Counter
from pathlib import Path

import pytest

from petrobot.coordinator.operator.history import opened
from petrobot.coordinator.operator.prepare import resume
from petrobot.coordinator.operator.run_address import RunAddress, find_address
from petrobot.coordinator.operator.start_from import read_recorded
from petrobot.coordinator.run.folder import JOURNAL, RESULT, NoRunError
from petrobot.coordinator.run.journal import read_journal
from tests.operator.conftest import TASK, Cell
from tests.waiting import PATIENCE_S, Limit, until

pytestmark = pytest.mark.processes


async def test_a_task_runs_again_and_again_over_real_nodes(cell: Cell) -> None:
    """Each run has its own journal and result; what the page knows of its operator is kept."""
    names = []
    for _ in range(2):
        answer = await cell.say("start", task="moving")
        assert answer["ok"], answer
        result = await cell.ended()
        assert (result["status"], result["runs"]) == ("success", 2)
        assert cell.state["mission"]["state"] == "success"
        assert json.loads((cell.runs / answer["run"] / RESULT).read_text()) == result
        names.append(answer["run"])
    assert len(set(names)) == 2
    assert cell.state["controls"]["holder"] == "ana"
    history = opened(cell.runs / names[0] / JOURNAL, names[0])
    assert history["fault"] == ""
    assert [
        f["reason"]["code"] for r in history["records"] for f in r["firings"] if f["reason"]
    ] == ["slipped"]


async def test_the_run_can_be_controlled_while_it_is_active(cell: Cell) -> None:
    """Pause, step and tokens work; the command line finds the run until it has ended."""
    cell.station.address = lambda run: RunAddress(run, "http://127.0.0.1:1", "secret", os.getpid())
    started = await cell.say("start", task="moving")
    await until(lambda: cell.state["mission"]["state"] == "running")
    assert find_address(None, cell.runs).run == started["run"]
    assert (await cell.say("pause"))["ok"]
    fired = cell.state["mission"]["firings"]
    assert (await cell.say("step"))["ok"]
    await until(
        lambda: cell.state["mission"]["firings"] == fired + 1 and cell.state["paused"] is not None
    )
    assert (await cell.say("add_tokens", place="jobs"))["ok"]
    assert "not an external event" in (await cell.say("raise_event", event="x"))["text"]
    assert (await cell.say("resume"))["ok"]
    result = await cell.ended()
    assert sum(f["transition"] == "begin" for f in cell.state["firings"]) == 3
    assert result["status"] == "success"
    with pytest.raises(NoRunError):
        find_address(None, cell.runs)


async def test_times_on_the_page_are_those_of_the_journal(cell: Cell) -> None:
    """Of each firing; and a snapshot has the time now, although nothing has happened since."""
    started = await cell.say("start", task="moving")
    await until(lambda: cell.state["mission"]["state"] == "running")
    await cell.say("pause")
    before = cell.state["time"]
    await until(lambda: cell.station.snapshot()["time"] > before + 0.2)
    await cell.say("resume")
    await cell.ended()
    shown = [(f["transition"], f["at"]) for f in cell.state["firings"]]
    records = opened(cell.runs / started["run"] / JOURNAL, started["run"])["records"]
    assert shown == [(f["transition"], r["t"]) for r in records for f in r["firings"]]


async def test_a_resumed_run_is_shown_as_it_was(cell: Cell, tmp_path: Path) -> None:
    """Its coordinator was killed in a pause. What the journal tells is shown as before: firings,
    when each run started and since when it is held, why the net is paused."""
    run = (await cell.say("start", task="moving", runs=9))["run"]
    await until(lambda: len(cell.state["ended"]) > 2)
    assert (await cell.say("override_selector", primitive_task="pick", action="pick_part"))["ok"]
    run_session = cell.station._run
    assert run_session is not None
    limit = Limit("a run that is held")
    while limit.left():
        assert (await cell.say("pause"))["ok"]
        await until(lambda: run_session.mission.executor.store.safe)
        before = cell.station.snapshot()
        if before["runs"]:
            break  # else the run ended before the pause reached it, and no other begins
        assert (await cell.say("resume"))["ok"]
    shutil.copytree(cell.runs / run, tmp_path / "killed")
    session = resume(read_recorded(tmp_path / "killed" / JOURNAL), (), math.inf)
    after = session.operate().snapshot()
    await session.abandon()
    assert before["runs"] and before["reports"] and 0.0 < after["time"] <= before["time"]
    for shown in (before, after):
        for name in shown["runs"]:
            shown["runs"][name]["progress"] = None  # the journal has none
    said = ("marking", "runs", "ended", "firings", "events", "selectors", "reports", "breakpoints")
    assert {key: after[key] for key in said} == {key: before[key] for key in said}
    assert after["mission"]["state"] == "running"
    assert after["mission"]["firings"] == before["mission"]["firings"]
    assert after["paused"]["reason"] == before["paused"]["reason"]


async def test_a_start_that_is_impossible_is_refused_with_the_reason(cell: Cell) -> None:
    """Tried without a task, with an unknown or faulty task, with bad parameters, during a run, and
    by a client without the controls."""
    assert (await cell.say("start"))["text"] == "choose a task first"
    assert "no task file nothing.toml" in (await cell.say("start", task="nothing"))["text"]
    cell.tasks.save_text("strange", None, TASK.replace('["pick_part"]', '["pick_apart"]'))
    answer = await cell.say("start", task="strange")
    assert answer["code"] == "faults" and "pick_apart" in answer["text"]
    assert [finding["key"] for finding in answer["findings"]] == [
        "primitive_tasks.pick.alternatives"
    ]
    answer = await cell.say("start", task="moving", parameters={"sped": 1.0})
    assert answer["code"] == "bad_data" and "speed" in answer["text"]
    assert not cell.runs.exists()
    stranger = await cell.station.command("ben", "start", {"task": "moving"})
    assert stranger["code"] == "not_holder" and "ana" in stranger["text"]
    assert (await cell.say("start", task="moving", parameters={"speed": 1}))["ok"]
    again = await cell.say("start", task="moving")
    assert again["code"] == "running" and cell.state["mission"]["id"] in again["text"]
    await cell.ended()


async def test_a_node_that_is_not_connected_is_named_and_leaves_no_run(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The refusal has the node's name and address, the page shows the node as lost, and a later
    start succeeds."""
    await cell.nodes["arm"].close()

    def offered() -> dict[str, bool]:
        return {offer["node"]: offer["up"] for offer in cell.station.offers()}

    async with asyncio.timeout(60.0):
        while offered() != {"vision": True, "arm": False}:
            await cell.station.look()
    assert cell.state["nodes"]["arm"]["state"] == "lost"
    answer = await cell.say("start", task="moving")
    assert (
        answer["code"] == "unreachable"
        and answer["nodes"] == ["arm"]
        and "arm at 127.0.0.1:" in answer["text"]
    )
    assert list(cell.runs.iterdir()) == []
    await cell.nodes["arm"].start()
    assert (await cell.say("start", task="moving"))["ok"]
    assert (await cell.ended())["status"] == "success"


async def test_a_start_is_shown_while_its_nodes_are_reached(cell: Cell) -> None:
    """Every client sees that a run is being prepared; when it is refused, the state before is
    shown."""
    seen: list[str] = []
    cell.station.subscribe(lambda c: seen.append(c.get("mission", {}).get("state", "")))
    assert not (await cell.say("start", task="moving", parameters={"sped": 1.0}))["ok"]
    assert [state for state in seen if state] == ["preparing", "idle"]
    seen.clear()
    await cell.say("start", task="moving")
    await cell.ended()
    assert [state for state in seen if state][:3] == ["preparing", "preparing", "running"]
    assert not (await cell.say("start", task="nothing"))["ok"]
    assert cell.state["mission"]["state"] == "success"


async def test_breakpoints_and_choices_before_the_start(cell: Cell) -> None:
    """Settings of a loaded task hold for its next run; loading another task removes them."""
    assert (await cell.say("pause"))["code"] == "idle"
    assert (await cell.say("load", task="moving"))["ok"]
    assert cell.state["marking"] == {"jobs": 2, "arm_free": 1, "look": 0, "pick": 0}
    assert (await cell.say("breakpoint", element="transitions.nowhere"))["code"] == "refused"
    assert (await cell.say("breakpoint", element="transitions.seen", on=True))["ok"]
    assert (await cell.say("override_selector", primitive_task="look", action="look_thrice"))[
        "code"
    ] == "refused"
    assert (await cell.say("override_selector", primitive_task="look", action="look_twice"))["ok"]
    started = await cell.say("start")
    await until(lambda: cell.state["paused"] is not None)
    assert [f["transition"] for f in cell.state["firings"]] == ["begin"]
    assert cell.state["selectors"]["look"]["override"] == "look_twice"
    assert (await cell.say("breakpoint", element="transitions.seen", on=False))["ok"]
    assert (await cell.say("resume"))["ok"]
    await cell.ended()
    assert {run["action"] for run in cell.state["ended"]} == {"look_twice", "pick_part"}
    journal = read_journal(cell.runs / started["run"] / JOURNAL)
    assert journal.header["mission"] == started["run"]


async def test_closing_ends_the_active_run(cell: Cell) -> None:
    """The station aborts it, and its journal and result are complete."""
    cell.tasks.save_text("long", None, TASK.replace("tokens = 2", "tokens = 9"))
    started = await cell.say("start", task="long")
    await until(lambda: bool(cell.state["runs"]))
    await cell.station.close()
    result = json.loads((cell.runs / started["run"] / RESULT).read_text())
    assert result["status"] == "error" and cell.state["mission"]["state"] == "aborted"
    assert opened(cell.runs / started["run"] / JOURNAL, started["run"])["fault"] == ""


async def test_an_emergency_stop_needs_no_run(cell: Cell) -> None:
    """Every client may give it while no run is active; it is shown, and cleared by the client that
    holds the controls."""
    assert (await cell.station.command("ben", "estop", {}))["ok"]
    assert cell.state["mission"]["state"] == "stopped" and "ben" in cell.state["mission"]["reason"]
    assert (await cell.say("clear_estop"))["ok"]
    assert cell.state["mission"]["state"] == "idle"


@pytest.mark.parametrize("ends", [True, False])
async def test_no_disk_is_waited_for_in_the_event_loop(
    cell: Cell, monkeypatch: pytest.MonkeyPatch, ends: bool
) -> None:
    """The file with the run's address was synced there, when its nodes were already connected: a
    disk that needs two seconds for it cost every one of them its coordinator."""
    where = Counter[str]()
    for name in ("fsync", "fdatasync"):
        monkeypatch.setattr(os, name, lambda _: where.update([threading.current_thread().name]))
    cell.station.address = lambda run: RunAddress(run, "http://127.0.0.1:1", "token", os.getpid())
    assert (await cell.say("start", task="moving"))["ok"]
    await until(lambda: cell.state["mission"]["state"] == "running")
    if not ends:
        await cell.say("abort")
    await cell.ended()
    assert sum(where.values()) > 5 and threading.main_thread().name not in where, where


async def test_a_slow_disk_delays_a_start_and_neither_the_page_nor_a_stop(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sync of 12 s made the page report a lost connection, and an emergency stop that had reached
    all nodes seem to have failed. Nothing starts after it."""
    goes_on, syncs = threading.Event(), list[int]()

    def fdatasync(file: int) -> None:
        syncs.append(file)
        assert goes_on.wait(PATIENCE_S)

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    try:
        starting = asyncio.create_task(cell.say("start", task="moving"))
        await until(lambda: syncs)
        assert cell.state["mission"]["state"] == "preparing"
        assert (await cell.station.command("ben", "estop", {}))["ok"] and not starting.done()
    finally:
        goes_on.set()
    assert (await starting)["code"] == "stopped"
    assert not list(cell.runs.glob("*"))
    assert (await cell.say("clear_estop"))["ok"]

    assert (await cell.say("start", task="moving"))["ok"]
    await until(lambda: cell.state["mission"]["state"] == "running")
    assert (await cell.say("pause"))["ok"]
    goes_on.clear()
    try:
        assert (await cell.station.command("ben", "estop", {}))["ok"], "it waits for no disk"
    finally:
        goes_on.set()
    assert (await cell.ended())["status"] == "error"
