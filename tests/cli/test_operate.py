"""The operator's commands on an active mission run: their effects, their answers, and when they are
refused."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import stat
import subprocess
import threading
import time
from pathlib import Path

import pytest

from petrobot.coordinator.cli import COMMANDS, main
from petrobot.coordinator.cli.options import recorded
from petrobot.coordinator.cli.resume import later_run, located
from petrobot.coordinator.engine import Mode
from petrobot.coordinator.operator import commands
from petrobot.coordinator.operator.run_address import (
    ADDRESS_FILE,
    RunAddress,
    find_address,
    published,
    waiting,
)
from petrobot.coordinator.page import app_state
from petrobot.coordinator.run import realtime
from petrobot.coordinator.run.folder import JOURNAL, NoRunError
from petrobot.coordinator.run.journal import JournalError, JournalWriter, read_journal
from petrobot.coordinator.run.recording import JournalStore, remarks
from petrobot.services.comm.location_file import load
from petrobot.services.host.parent_death import state_of
from tests.cli.cell import TASK
from tests.cli.conftest import RUN, Terminal
from tests.waiting import PATIENCE_S, beat, until

STEERING = ["watch", *(one.name for one in COMMANDS if one.home.startswith("operate:"))]


async def test_pause_reaches_the_devices_and_continue_releases_them(petrobot: Terminal) -> None:
    """The arm really holds; the answer names its node."""
    await petrobot.working()
    said = await petrobot("pause", "--json", "-")
    assert (said.code, said.json["nodes"]) == (0, {"robot": "held"})
    assert petrobot.arm.held and petrobot.mission.executor.state.mode is Mode.PAUSED
    again = await petrobot("pause", "--json", "-")
    assert (again.code, again.json["nodes"]) == (0, {"robot": "held"})
    said = await petrobot("continue")
    assert said.code == 0 and "continues" in said.out
    await until(lambda: not petrobot.arm.held)
    said = await petrobot("continue")
    assert said.code == 1 and "nothing to continue: the mission run is running" in said.err


@pytest.mark.processes
async def test_a_second_run_is_refused_while_the_first_has_its_device(petrobot: Terminal) -> None:
    """It says which run has which device, and leaves no folder. It also names a run whose
    coordinator was killed."""
    await petrobot.working()
    gone = subprocess.Popen(["true"])
    gone.wait()
    (petrobot.runs / "old-1").mkdir()
    address = {"run": "old-1", "url": "", "token": "", "process": gone.pid}
    (petrobot.runs / "old-1" / ADDRESS_FILE).write_text(json.dumps(address), encoding="utf-8")
    task = petrobot.folder / "reaching.toml"
    task.write_text(TASK, encoding="utf-8")
    services = str(petrobot.mission.executor.directory.source)
    said = await petrobot("run", str(task), "--services", services, "--no-page", "--quiet")
    assert (
        said.code == 2
        and f"in use: arm accepts orders from {RUN} at the moment; wait until" in said.err
    ), said
    assert "old-1 was interrupted: this is a new run; `petrobot resume old-1` continues" in said.err
    assert {path.name for path in petrobot.runs.iterdir()} == {RUN, "old-1"}
    assert petrobot.arm.moving


NODE = '[nodes.a]\nhost = "127.0.0.1"\nport = 7301\n'


@pytest.mark.parametrize(
    ("mode", "services", "age", "told"),
    [
        ("realtime", NODE, 0.0, "other"),
        ("realtime", NODE, 9.0, ""),
        ("lockstep", NODE, 0.0, ""),
        ("realtime", f"# a note\n\n{NODE}[nodes.more]\nport = 2", 0.0, "other"),
        ("realtime", NODE.replace("7301", "7302"), 0.0, ""),
        ("realtime", "no TOML", 0.0, ""),
    ],
)
def test_a_resume_names_the_run_that_has_used_the_devices_since(
    mode: str, services: str, age: float, told: str, tmp_path: Path
) -> None:
    """`age`: how much older than the interrupted run the other one's last record is (s)."""
    own, other = (tmp_path / name / JOURNAL for name in ("own", "other"))
    JournalWriter(own, {"mode": "realtime", "services": NODE}).close()
    JournalWriter(other, {"mode": mode, "services": services}).close()
    os.utime(own, (1_000.0, 1_000.0))
    os.utime(other, (1_005.0 - age, 1_005.0 - age))
    assert later_run(read_journal(own)) == told


def test_a_resume_uses_new_keys_and_warns_of_another_changed_location_file(tmp_path: Path) -> None:
    file = tmp_path / "services.toml"
    file.write_text('schema = 1\n[nodes]\na = { host = "127.0.0.1", port = 7001 }\n')
    began = load(file)
    text = file.read_text()
    file.write_text(f'{text}[keys]\nfile = "new.key"\n')
    assert located(began) == (load(file), "")
    file.write_text(text + 'b = { host = "127.0.0.1", port = 7002 }\n')
    directory, warning = located(began)
    assert directory is began
    assert str(file) in warning
    file.unlink()
    assert located(began) == (began, "")


async def test_a_device_that_cannot_hold_says_so(petrobot: Terminal) -> None:
    """The message is in capital letters."""
    petrobot.arm.holdable = False
    await petrobot.working()
    said = await petrobot("pause")
    assert said.code == 0 and "robot" in said.out and "CANNOT HOLD" in said.out


async def test_a_node_that_is_frozen_counts_as_lost(petrobot: Terminal) -> None:
    """A pause is answered, though the node sends nothing."""
    await petrobot.working()
    assert petrobot.robot._pump is not None
    petrobot.robot._pump.cancel()
    for _ in range(2):  # also when it was paused already
        said = await petrobot("pause", "--json", "-")
        assert (said.code, said.json["nodes"]) == (3, {"robot": "lost"})


@pytest.mark.parametrize("hangs", ["write", "fdatasync"])
async def test_a_slow_disk_delays_the_robot_and_not_the_coordinator(
    petrobot: Terminal, monkeypatch: pytest.MonkeyPatch, hangs: str
) -> None:
    """A memory card may need seconds for a sync, and a frozen file system takes no byte. Nodes and
    operators are answered meanwhile."""
    goes_on, syncs = threading.Event(), list[int]()
    usual = getattr(os, hangs)

    def slow(file: int, *data: bytes) -> object:
        if Path(f"/proc/self/fd/{file}").readlink().suffix == ".journal":
            syncs.append(file)
            assert goes_on.wait(PATIENCE_S)
        return usual(file, *data)

    monkeypatch.setattr(os, hangs, slow)
    try:
        raising = asyncio.create_task(petrobot("raise", "part_there"))
        await until(lambda: syncs)
        assert (await petrobot("break")).code == 0
        pausing = asyncio.create_task(petrobot("pause"))
        await until(lambda: petrobot.mission.executor.state.mode is Mode.PAUSED)
        await asyncio.sleep(1.5)  # longer than a node is silent before it counts as lost
        assert not petrobot.mission.lost and not petrobot.arm.moving
        assert not raising.done() and not pausing.done(), "what is not on disk is not confirmed"
    finally:
        goes_on.set()
    assert ((await raising).code, (await pausing).code) == (0, 0)
    assert (await petrobot("continue")).code == 0
    await until(lambda: petrobot.arm.moving)
    await petrobot("abort")
    await petrobot.running
    assert "s for the disk of the journal; what failed" in petrobot.mission.remarks["disk"]


async def test_a_disk_that_holds_up_an_order_without_a_device_is_named_in_the_result(
    petrobot: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The coordinator stands still meanwhile, and its host was blamed."""
    await petrobot.working()
    store, write = petrobot.mission.executor.store, os.write
    await until(lambda: store.safe)

    def slow(file: int, data: bytes) -> int:
        threading.Event().wait(2 * realtime.SLOW_DISK)
        return write(file, data)

    store.record("note", {})
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", slow)
        assert store.flush()
    await petrobot("abort")
    await petrobot.running
    assert "the coordinator itself stood still for" in petrobot.mission.remarks["disk"]


async def test_a_command_is_answered_when_the_run_ends_before_its_disk_has_written(
    petrobot: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk fails in the middle of a sync."""

    def fdatasync(file: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    raising = asyncio.create_task(petrobot("raise", "part_there"))
    with pytest.raises(JournalError, match="Input/output error; nothing was sent"):
        await asyncio.wait_for(petrobot.running, PATIENCE_S)
    await petrobot.operation.close()
    said = await raising
    assert said.code == 1 and "ended before this was in its journal" in said.err, said
    assert not petrobot.arm.moving


async def test_an_emergency_stop_is_answered_before_a_slow_disk(
    petrobot: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The nodes are told first; the record of it waits."""
    goes_on = threading.Event()
    await petrobot.working()
    monkeypatch.setattr(os, "fdatasync", lambda _: goes_on.wait(PATIENCE_S))
    try:
        said = await petrobot.operation.command("ana", "estop", {})
        assert said["ok"]
        await until(lambda: not petrobot.arm.moving)
    finally:
        goes_on.set()
    await asyncio.wait_for(petrobot.running, PATIENCE_S)


async def test_a_command_that_a_hung_disk_delays_says_so(
    petrobot: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It said only that nobody answered. A second pause was confirmed, though no node had been
    asked to hold."""
    goes_on = threading.Event()
    await petrobot.working()
    monkeypatch.setattr(commands, "JOURNALED", 0.3)
    monkeypatch.setattr(os, "fdatasync", lambda _: goes_on.wait(PATIENCE_S))
    try:
        for _ in range(2):
            said = await petrobot("pause")
            assert said.code == 1 and "the disk of the journal has not answered" in said.err, said
        assert not petrobot.arm.held
    finally:
        goes_on.set()
    await until(lambda: petrobot.arm.held)
    assert (await petrobot("pause")).code == 0
    await petrobot("abort")
    await petrobot.running


async def test_a_disk_that_never_answers_ends_the_run_and_holds_nobody(
    petrobot: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the end of the run nor a later command waits for the disk."""
    goes_on = threading.Event()
    monkeypatch.setattr(os, "fdatasync", lambda _: goes_on.wait(PATIENCE_S))
    monkeypatch.setattr(realtime, "DISK_PATIENCE", 0.5)
    try:
        raising = asyncio.create_task(petrobot("raise", "part_there"))
        with pytest.raises(JournalError, match="disk of the journal has not answered for"):
            await asyncio.wait_for(petrobot.running, PATIENCE_S)
        await petrobot.operation.close()
        assert "ended before this was in its journal" in (await raising).err
        for command in (["pause"], ["remark", "too late"]):
            assert "the mission run has" in (await petrobot(*command)).err
        async with asyncio.timeout(PATIENCE_S / 2):
            await petrobot.shell.close()
        store = petrobot.mission.executor.store
        assert isinstance(store, JournalStore)
        store.writer.close()
        assert not petrobot.arm.moving and not goes_on.is_set()
    finally:
        goes_on.set()


async def test_a_node_without_active_runs_is_idle_in_a_pause(petrobot: Terminal) -> None:
    """No device had to hold, which does not say that none moves."""
    said = await petrobot("pause", "--json", "-")
    assert said.json["nodes"] == {"robot": "idle"}
    assert "robot        runs no action: nothing was asked to hold" in (await petrobot("pause")).out


async def test_an_abort_releases_held_devices(petrobot: Terminal) -> None:
    """At the next mission run, the arm must no longer hold."""
    await petrobot.working()
    await petrobot("pause")
    assert petrobot.arm.held
    assert (await petrobot("abort")).code == 0
    await until(lambda: petrobot.mission.executor.finished is not None)
    await until(lambda: not petrobot.arm.held)


async def test_step_fires_once(petrobot: Terminal) -> None:
    """Then the run pauses again."""
    await petrobot("pause")
    await petrobot("raise", "part_there")
    assert petrobot.tokens("jobs") == 2
    said = await petrobot("step", "--json", "-")
    assert said.json["firing"]["transition"] == "start"
    assert petrobot.tokens("work") == 1
    await until(lambda: petrobot.mission.executor.state.mode is Mode.PAUSED)


async def test_a_step_of_an_active_run_says_that_it_is_paused_now(petrobot: Terminal) -> None:
    """Who did not pause it would leave the robot standing."""
    stepping = asyncio.create_task(petrobot("step"))
    await until(lambda: petrobot.mission.executor.state.mode is Mode.STEPPING)
    raised = await petrobot("raise", "part_there")
    told = raised.out + (await stepping).out  # both write to one terminal
    assert "fired start" in told and "the run was not paused, and is now" in told
    await petrobot("raise", "part_there")
    assert "now" not in (await petrobot("step")).out


async def test_breakpoints(petrobot: Terminal) -> None:
    """They are set, listed, reached and removed."""
    assert "start" in (await petrobot("break", "start")).out
    await petrobot("raise", "part_there")
    await until(lambda: petrobot.mission.executor.state.mode is Mode.PAUSED)
    assert (await petrobot("break", "--json", "-")).json["breakpoints"] == ["transitions.start"]
    assert (await petrobot("break", "start", "--off", "--json", "-")).json["breakpoints"] == []
    await petrobot("continue")
    await until(lambda: petrobot.arm.moving)


async def test_tokens_can_be_changed_in_control_places_only(petrobot: Terminal) -> None:
    """Tokens stay within the capacity; a refused command changes nothing and has exit code 1."""
    assert (await petrobot("token", "jobs", "+2", "--json", "-")).json["tokens"] == 4
    assert (await petrobot("token", "jobs", "-1", "--json", "-")).json["tokens"] == 3
    full = await petrobot("token", "jobs", "+3")
    assert full.code == 1 and "at most 5" in full.err
    other = await petrobot("token", "arm_free", "+1")
    assert other.code == 1 and "no control place" in other.err
    assert petrobot.tokens("jobs") == 3


async def test_a_forced_transition_ends_a_hanging_action(petrobot: Terminal) -> None:
    """The run is cancelled, and counts neither as success nor as failure."""
    await petrobot.working()
    said = await petrobot("force", "work", "done")
    assert said.code == 0, said.err
    await until(lambda: petrobot.tokens("arm_free") == 1 and not petrobot.arm.moving)
    await until(lambda: bool(petrobot.mission.tally.runs))
    assert [record.status for record in petrobot.mission.tally.runs] == [None]


async def test_the_operator_chooses_the_alternative(petrobot: Terminal) -> None:
    """It stays chosen until the operator frees the choice."""
    assert (await petrobot("override", "work", "reach_slowly")).code == 0
    await petrobot.working()
    assert petrobot.acting == ["reach_slowly"]
    assert (await petrobot("override", "work", "--free")).code == 0
    petrobot.arm.arrive()
    await until(lambda: petrobot.tokens("arm_free") == 1)
    await petrobot.working()
    assert petrobot.acting == ["reach"]


async def test_a_remark_is_kept_and_changes_nothing(petrobot: Terminal) -> None:
    """Without the controls; with its author, in the journal's order."""
    await petrobot.working()
    assert (await petrobot("pause")).code == 0
    before = petrobot.mission.executor.state
    assert (await petrobot("remark", " the", "table was moved ", "--as", "ben")).code == 0
    assert petrobot.mission.executor.state is before
    [remark] = remarks(read_journal(petrobot.runs / RUN / JOURNAL))
    assert remark.author.startswith("ben ") and remark.text == "the table was moved"
    notices = petrobot.operation.feed.state["notices"]
    assert (notices[-1]["level"], notices[-1]["text"]) == ("info", remark.told)
    await petrobot("abort")
    later = read_journal(petrobot.runs / RUN / JOURNAL).records[remark.number]
    assert later.data["stimulus"]["kind"] == "Abort", "what comes later is written behind it"


@pytest.mark.parametrize("text", ["", "  ", "two\nlines", "\x1b[2J", "x" * 1_001])
async def test_a_remark_is_one_plain_line(petrobot: Terminal, text: str) -> None:
    said = await petrobot("remark", text)
    assert said.code == 2 and "text: expected" in said.err
    assert remarks(read_journal(petrobot.runs / RUN / JOURNAL)) == []


async def test_what_no_journal_can_store_is_refused_and_changes_nothing(petrobot: Terminal) -> None:
    """Without its record, the run could not store anything after it either."""
    await petrobot.working()
    operation = petrobot.operation
    who = operation.controls.holder or "ben"
    assert (await operation.command(who, "take_controls", {}))["ok"]
    for verb, data in (
        ("add_tokens", {"place": "stock", "count": 10**30}),
        ("remove_tokens", {"place": "stock", "count": 10**30}),
        ("force_exit", {"transition": "\ud800"}),
        ("breakpoint", {"element": "t.\ud800"}),
    ):
        answer = await operation.command(who, verb, data)
        assert (answer["ok"], answer["code"]) == (False, "bad_data"), (verb, answer)
        assert "; give " in answer["text"]
    assert (await operation.command(who, "remark", {"text": "still works"}))["ok"]
    assert (await operation.command(who, "pause", {}))["ok"]


async def test_watch_shows_tokens_and_events_of_the_operator(petrobot: Terminal) -> None:
    """A command that was refused is not shown."""
    watching = asyncio.create_task(petrobot("watch"))
    await until(lambda: petrobot.operation.feed.watched)
    commands = ["pause", "token jobs +3", "token jobs -1", "token jobs +5", "raise part_there"]
    # All write to one terminal.
    out = [(await petrobot(*command.split())).out for command in (*commands, "abort")]
    out.append((await watching).out)
    lines = [line for line in "".join(out).splitlines() if "command  " in line]
    assert [line.partition("command  ")[2] for line in lines] == [
        "operator put 3 into jobs",
        "operator took 1 out of jobs",
        "event part_there, raised by the operator",
    ]


async def test_watch_shows_variables(
    petrobot: Terminal, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those known at its beginning, and each new value."""
    petrobot.operation.feed.state["variables"]["bin"] = None
    watching = asyncio.create_task(petrobot("watch"))
    printed = list[str]()

    def shows(line: str) -> bool:
        printed.append(capsys.readouterr().out)
        return f"{line}\n" in "".join(printed)

    await until(lambda: shows("variables: bin = null"))
    petrobot.operation.feed.emit("variable", time=1.0, name="look.status", value="success")
    petrobot.operation.feed.emit("variable", time=1.0, name="bin", value="left")
    await until(lambda: shows('variable bin = "left"'))
    assert "look.status" not in "".join(printed)
    await petrobot("abort")
    await watching


async def test_abort_ends_the_run_in_error(petrobot: Terminal) -> None:
    """The reason names the operator."""
    watching = asyncio.create_task(petrobot("watch"))
    await until(lambda: petrobot.operation.feed.watched)
    await petrobot.working("--as", "ana")
    aborted = await petrobot("abort", "--as", "ana")
    assert aborted.code == 0
    await until(lambda: petrobot.mission.executor.finished is not None)
    finished = petrobot.mission.executor.finished
    assert finished is not None and "ana" in finished.reason
    lines = (aborted.out + (await watching).out).splitlines()  # all write to one terminal
    ends = [i for i, line in enumerate(lines) if line.endswith(f"mission  {finished.reason}")]
    assert ends and "continued" not in lines[ends[-1] - 1]
    assert not petrobot.arm.moving


async def test_emergency_stop_stops_latches_and_ends_the_run(petrobot: Terminal) -> None:
    """The arm stops at once and accepts no command until the stop is cleared, not even from the
    task's own recovery."""
    await petrobot.working()
    said = await petrobot("estop", "--json", "-")
    assert said.code == 0, said.err
    (node,) = said.json["nodes"]
    assert (node["node"], node["devices"], node["bus"]) == ("robot", {"arm": "stopped"}, "")
    assert said.json["coordinator"] == f"{RUN}: aborted"
    assert petrobot.arm.quick_stops and not petrobot.arm.moving
    await until(lambda: petrobot.mission.executor.finished is not None)
    reached = petrobot.shell.clients["robot"]
    refused = await reached.call("reach")
    assert (refused.cause, refused.executed) == ("emergency_stop", "no")
    assert (await petrobot("estop", "--clear")).code == 0
    call = asyncio.ensure_future(reached.call("reach"))
    await until(lambda: petrobot.arm.moving)
    petrobot.arm.arrive()
    assert (await call).status == "success"


def test_without_a_location_file_an_emergency_stop_says_which_cell_it_stops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whoever stands in the wrong folder must not believe that the robot was stopped."""
    monkeypatch.chdir(tmp_path)
    main(["estop", "--clear"])
    assert "For your robot give --services FILE" in capsys.readouterr().err


async def test_an_emergency_stop_needs_no_controls(petrobot: Terminal) -> None:
    """Any operator may give it, also one without the controls."""
    assert (await petrobot("pause", "--as", "ana")).code == 0
    assert (await petrobot("estop", "--json", "-")).code == 0


async def test_one_operator_holds_the_controls(petrobot: Terminal) -> None:
    """A second operator is refused with the name of the holder, and may give commands after a
    handover."""
    assert (await petrobot("pause", "--as", "ana")).code == 0
    refused = await petrobot("continue", "--as", "bob")
    assert refused.code == 1 and "ana" in refused.err and "holds the controls" in refused.err
    assert petrobot.mission.executor.state.mode is Mode.PAUSED
    late = await petrobot("continue", "--as", "bob", "--take", "0.2")
    assert late.code == 1 and "did not hand over" in late.err
    assert (await petrobot("continue", "--as", "ana")).code == 0


async def test_controls_are_requested_and_handed_over(petrobot: Terminal) -> None:
    """`--take` waits until the holder hands them over."""
    from petrobot.coordinator.cli.operate import connect

    async with connect(find_address(folder=petrobot.runs), "ana") as ana:
        assert (await ana.command("take_controls"))["ok"]
        asking = asyncio.create_task(petrobot("pause", "--as", "bob", "--take", "60"))
        assert await ana.until(lambda state: bool(state["controls"]["asking"]), 60)
        (bob,) = ana.state["controls"]["asking"]
        assert (await ana.command("release_controls", {"to": bob}))["ok"]
        assert (await asking).code == 0
        refused = await ana.command("resume")
        assert refused["code"] == "not_holder"


async def test_controls_of_a_silent_script_are_released(
    petrobot: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A script takes the controls over plain HTTP and sends nothing more."""
    import aiohttp

    monkeypatch.setattr(app_state, "ABSENT_S", 0.1)
    monkeypatch.setattr(app_state, "CLOCK_S", 0.01)
    headers = {"Authorization": f"Bearer {petrobot.page.token}"}
    async with aiohttp.ClientSession(headers=headers) as http:
        body = {"verb": "take_controls", "name": "script"}
        async with http.post(f"{petrobot.page.base}/api/command", json=body) as answer:
            assert (await answer.json())["ok"]
    async with asyncio.timeout(60):
        while (await petrobot("pause", "--as", "ana")).code != 0:
            await beat(0.01)


async def test_watch_follows_the_run_until_its_end(petrobot: Terminal) -> None:
    """It prints lines of text or JSON lines; its exit code is the run's."""
    path = petrobot.folder / "changes.jsonl"
    watching = asyncio.create_task(petrobot("watch", "--json", str(path)))
    await until(lambda: petrobot.operation.feed.watched)
    await petrobot.working()
    petrobot.arm.arrive()
    await until(lambda: petrobot.tokens("arm_free") == 1)
    assert path.read_text() == "", "the file is written in one piece, at the end"
    await petrobot("abort")
    assert (await watching).code == 1
    changes = [json.loads(line) for line in path.read_text().splitlines()]
    assert changes[0]["kind"] == "snapshot"
    fired = [change["firing"]["transition"] for change in changes if change["kind"] == "fired"]
    assert fired == ["start", "done"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("raise", "part_their"), "did you mean 'part_there'"),
        (("force", "work", "start"), "no outgoing transition of work is named 'start'"),
        (("force", "jobs", "done"), "no action place is named 'jobs'"),
        (("break", "nowhere"), "no place or transition is named 'nowhere'"),
        (("token", "jobs", "0"), "such as +1 or -1, got 0"),
        (("token", "job", "+1"), "did you mean 'jobs'"),
        (("override", "work"), "or give --free"),
        (("override", "work", "fly"), "no alternative is named 'fly'; known: "),
        (("pause", "--run", "nowhere"), "no run 'nowhere'"),
    ],
)
async def test_bad_input_is_exit_code_2_and_names_the_remedy(
    petrobot: Terminal, arguments: tuple[str, ...], says: str
) -> None:
    """Nothing is sent and nothing changes."""
    said = await petrobot(*arguments)
    assert said.code == 2 and says in said.err
    assert petrobot.mission.executor.state.mode is Mode.RUNNING


@pytest.mark.parametrize("name", STEERING)
def test_without_a_run_every_command_says_so(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One clear line and exit code 2."""
    arguments = {
        "break": ["x"],
        "token": ["p", "+1"],
        "raise": ["e"],
        "force": ["p", "t"],
        "override": ["t", "a"],
        "remark": ["seen"],
    }
    assert main([name, *arguments.get(name, []), "--journal", str(tmp_path)]) == 2
    assert "start one in real time with `petrobot run`" in capsys.readouterr().err


@pytest.mark.processes
@pytest.mark.parametrize("named", [[], ["--run", "tidy-1"]])
@pytest.mark.parametrize("asked", [True, False])
async def test_of_a_run_whose_coordinator_died_it_says_how_to_continue(
    asked: bool, named: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It was killed, so its address is still there; its parent may not have asked for its end, so
    that its process number is still there too."""
    gone = subprocess.Popen(["true"])
    await until(lambda: state_of(gone.pid) == "Z")
    if asked:
        gone.wait()
    folder = tmp_path / "tidy-1"
    folder.mkdir()
    address = {"run": "tidy-1", "url": "", "token": "", "process": gone.pid}
    (folder / ADDRESS_FILE).write_text(json.dumps(address))
    (folder / JOURNAL).write_text("")
    pause = ["pause", *named, "--journal", str(tmp_path)]
    assert await asyncio.to_thread(main, pause) == 2
    gone.wait()
    told = "tidy-1 was interrupted: `petrobot resume tidy-1` continues it"
    assert told in capsys.readouterr().err


async def test_an_unreachable_coordinator_is_exit_code_3(petrobot: Terminal) -> None:
    """Its process lives, but no server listens at its address any more."""
    await petrobot.page.close()
    said = await petrobot("pause")
    assert said.code == 3 and "cannot be reached" in said.err


def test_only_the_owner_can_read_the_runs_address_which_is_removed_at_its_end(
    tmp_path: Path,
) -> None:
    """The token in the file permits every command."""
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / JOURNAL).touch()
    address = RunAddress("r", "http://127.0.0.1:1", "secret", os.getpid())
    with published(tmp_path / "r", address) as path:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert find_address(folder=tmp_path) == find_address("r", tmp_path) == address
    assert not path.exists()
    with pytest.raises(NoRunError, match="is not active"):
        find_address("r", tmp_path)


def test_the_address_of_a_killed_coordinator_is_ignored(tmp_path: Path) -> None:
    """The address of a process that has ended does not count. The next coordinator of this run
    replaces it."""
    (tmp_path / "r").mkdir()
    dead = {"run": "r", "url": "http://127.0.0.1:1", "token": "t", "process": 2**22 + 1}
    (tmp_path / "r" / ADDRESS_FILE).write_text(json.dumps(dead))
    with pytest.raises(NoRunError):
        find_address(folder=tmp_path)


async def test_the_result_says_that_the_host_was_too_busy(petrobot: Terminal) -> None:
    """The event loop did not run for longer than any set point is valid, so failures may be due to
    that."""
    await petrobot.working()
    busy = time.monotonic() + 0.2
    while time.monotonic() < busy:
        pass
    assert (await petrobot("abort")).code == 0
    await until(lambda: bool(petrobot.mission.remarks))
    assert "ms late" in petrobot.mission.result("realtime", 1.0)["host"]


def test_the_run_of_another_user_is_not_said_to_be_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its address and its journal can only be read by its owner."""
    tmp_path.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    runs, me = Path("runs"), os.geteuid()
    with published(runs / "theirs", RunAddress("theirs", "http://x", "t", os.getpid())) as path:
        (runs / "theirs" / JOURNAL).touch(0)
        path.chmod(0)
        if me == 0:
            os.seteuid(65534)  # root may read it
        try:
            assert waiting(runs) == []
            for name in (None, "theirs"):
                with pytest.raises(NoRunError, match="theirs was started by another user"):
                    find_address(name, runs)
            with pytest.raises(JournalError, match="theirs was started by another user, who"):
                recorded("last")
        finally:
            os.seteuid(me)
