"""A task as an action of ROS 2: goals start runs, cancels abort them, and each has a result."""

from __future__ import annotations

import argparse
import asyncio
import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import pytest

from petrobot import OperatorError
from petrobot.services.adapters.ros2 import __main__ as offering
from petrobot.services.adapters.ros2.bridge import ExchangePhase
from tests.adapters.ros2.conftest import FakeProcess
from tests.adapters.ros2.test_link import bridge_to
from tests.ports import free_ports
from tests.waiting import PATIENCE_S, until

ROOT = Path(__file__).parents[3]
RUN_TASK = Path(offering.__file__).with_name("RunTask.action").read_text(encoding="utf-8")


class Page:
    """A scripted page of the coordinator: a run lasts until the test ends it."""

    def __init__(self) -> None:
        self.phase, self.run, self.marking = "idle", "", {"a": 1}
        self.commands: list[tuple[str, dict[str, Any]]] = []
        self.gone, self.held, self.obeys = False, False, True
        self.mute, self.late = False, 0.0
        self.kept = False
        """Whether an operator has the controls, and gives them to who asks for them."""
        self.asked = False

    async def __aenter__(self) -> Self:
        if self.gone:
            raise OperatorError(self.over)
        return self

    async def __aexit__(self, *_: object) -> None:
        """Do nothing."""

    @property
    def over(self) -> str:
        return "the page does not answer" if self.gone else ""

    @property
    def state(self) -> dict[str, Any]:
        mission = {"id": self.run, "state": self.phase, "reason": "because"}
        runs = {"1": {"action": "rest"}} if self.phase == "running" else {}
        return {"mission": mission, "marking": self.marking, "runs": runs, "result": {"n": 1}}

    async def until(self, holds: Callable[[dict[str, Any]], bool], timeout: float) -> bool:
        limit = time.monotonic() + timeout
        while not holds(self.state) and not self.over and time.monotonic() < limit:
            await asyncio.sleep(0.01)
        return holds(self.state)

    async def command(self, verb: str, data: dict[str, Any] | None = None) -> dict[str, Any]:
        if self.gone:
            raise OperatorError(self.over)
        self.commands.append((verb, data or {}))
        if verb == "ask_controls":
            self.asked = True
        if verb == "take_controls" and self.kept:
            return {"ok": False, "code": "held", "text": "ana holds the controls; ask for them"}
        if verb == "start" and self.held:
            return {"ok": False, "code": "not_holder", "text": "ana holds the controls"}
        if verb == "start":
            run = f"run-{len(self.commands)}"
            asyncio.get_running_loop().call_later(self.late, self.begin, run)
            if self.mute:
                raise OperatorError("no answer to start within 60 s")
            return {"ok": True, "run": run}
        if verb == "abort" and self.obeys:
            self.phase = "aborted"
        return {"ok": True, "run": self.run}

    def begin(self, run: str) -> None:
        self.run, self.phase = run, "running"


class Link:
    """A scripted rosbridge."""

    def __init__(self) -> None:
        self.inbox: list[tuple[str, Any]] = [("up", None)]
        self.up, self.count, self.why = False, 0, ""
        self.sent: list[dict[str, Any]] = []

    def news(self) -> Iterator[tuple[str, Any]]:
        items, self.inbox = self.inbox, []
        for kind, item in items:
            self.up = kind != "down"
            yield kind, item

    def send(self, item: dict[str, Any]) -> None:
        self.sent.append(json.loads(json.dumps(item)))

    def close(self) -> None:
        """Do nothing."""

    def say(self, op: str, goal: str, **more: Any) -> None:
        self.inbox.append(("message", {"op": op, "id": goal, "action": "/rest", **more}))

    def results(self) -> list[tuple[str, int, str]]:
        told = [m for m in self.sent if m["op"] == "action_result"]
        assert all(m["result"] is True for m in told)
        return [(m["id"], m["status"], m["values"].get("state", "")) for m in told]


Steps = Callable[[Page, Link], Any]


def played(steps: Steps, **more: Any) -> tuple[Page, Link]:
    """Serve while the test's steps run; then stop."""
    page, link = Page(), Link()
    given = {"task": "rest", "action": "/rest", "type": offering.TYPE, "mode": "realtime"}
    options = argparse.Namespace(**{**given, "definition": None, **more})

    async def play() -> None:
        stop = asyncio.Event()
        offer = offering.OfferedTask(link, lambda: page, options)  # type: ignore
        serving = asyncio.create_task(offer.serve(stop))
        await steps(page, link)
        stop.set()
        await asyncio.wait_for(serving, PATIENCE_S)

    asyncio.run(play())
    assert link.sent[0]["op"] == "advertise_action"
    assert link.sent[-1] == {"op": "unadvertise_action", "action": "/rest"}
    return page, link


@pytest.mark.parametrize(("state", "status"), [("success", 4), ("error", 6), ("stopped", 6)])
def test_a_goal_is_a_run(state: str, status: int) -> None:
    async def steps(page: Page, link: Link) -> None:
        args = {"seconds": 2.0, "parameters": '{"more": [1]}', "seed": 7, "runs": 0}
        link.say("send_action_goal", "g1", args=args)
        await until(lambda: page.phase == "running" and len(link.sent) > 1, "the feedback")
        page.marking = {"a": 0, "b": 2}
        await until(lambda: len(link.sent) > 2, "the next feedback")
        page.phase = state
        await until(link.results, "the result")

    page, link = played(steps)
    assert page.commands[:2] == [
        ("take_controls", {}),
        (
            "start",
            {
                "task": "rest",
                "mode": "realtime",
                "parameters": {"seconds": 2.0, "more": [1]},
                "seed": 7,
            },
        ),
    ]
    assert page.commands[2:] == [("release_controls", {})], "an operator may take the controls"
    told = [m["values"] for m in link.sent if m["op"] == "action_feedback"]
    assert told[-1] == {"places": ["b"], "tokens": [2], "active": ["rest"]}
    assert link.results() == [("g1", status, state)]


def test_a_cancel_aborts_the_run() -> None:
    async def steps(page: Page, link: Link) -> None:
        link.say("send_action_goal", "g1", args={})
        await until(lambda: page.phase == "running", "the run")
        link.say("cancel_action_goal", "another")
        link.say("cancel_action_goal", "g1")
        await until(link.results, "the result")

    page, link = played(steps)
    assert link.results() == [("g1", 5, "aborted")] and ("abort", {}) in page.commands


@pytest.mark.parametrize("ends", [True, False])
def test_an_operator_who_holds_the_controls_is_asked_for_them_by_a_cancel(
    ends: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nobody saw that a cancel waited for them, and the process could not be ended meanwhile."""

    async def steps(page: Page, link: Link) -> None:
        link.say("send_action_goal", "g1", args={})
        await until(lambda: page.phase == "running", "the run")
        page.kept = True
        link.say("cancel_action_goal", "g1")
        await until(lambda: page.asked, "the request for the controls")
        if not ends:
            page.kept = False
            await until(link.results, "the result")

    page, link = played(steps)
    assert link.results() == ([("g1", 6, "unknown")] if ends else [("g1", 5, "aborted")])
    assert page.phase == ("running" if ends else "aborted")
    assert [verb for verb, _ in page.commands].count("ask_controls") == 1
    said = "run-2 must be aborted (cancelled), but ana holds the controls; ask for them; asked for"
    assert capsys.readouterr().err.count(said) == 1


def test_a_cancel_that_comes_too_late_leaves_the_success() -> None:
    async def steps(page: Page, link: Link) -> None:
        page.obeys = False
        link.say("send_action_goal", "g1", args={})
        await until(lambda: page.phase == "running", "the run")
        link.say("cancel_action_goal", "g1")
        await until(lambda: ("abort", {}) in page.commands, "the abort")
        page.phase = "success"
        await until(link.results, "the result")

    assert played(steps)[1].results() == [("g1", 4, "success")]


def test_an_abort_by_the_operator_is_not_a_cancel() -> None:
    """rclpy refuses `cancelled` for a goal whose client did not cancel it."""

    async def steps(page: Page, link: Link) -> None:
        link.say("send_action_goal", "g1", args={})
        await until(lambda: page.phase == "running", "the run")
        page.phase = "aborted"
        await until(link.results, "the result")

    assert played(steps)[1].results() == [("g1", 6, "aborted")]


@pytest.mark.parametrize(
    ("args", "held", "word"),
    [
        ({}, True, "ana holds the controls"),
        ([], False, "expected a goal with fields"),
        ({"parameters": "{"}, False, "parameters: expected the text of a JSON object"),
        ({"parameters": "[]"}, False, "expected the text of a JSON object"),
        ({"parameters": "[" * 5000}, False, "expected the text of a JSON object"),
        ({"parameters": {"seconds": 1}}, False, "expected the text of a JSON object"),
    ],
)
def test_a_goal_that_cannot_be_started_is_aborted_with_the_reason(
    args: Any, held: bool, word: str
) -> None:
    async def steps(page: Page, link: Link) -> None:
        page.held = held
        link.say("send_action_goal", "g1", args=args)
        await until(link.results, "the result")
        page.held = False
        link.say("send_action_goal", "g2", args={})
        await until(lambda: page.phase == "running", "the next goal's run")

    _, link = played(steps)
    assert link.results()[0] == ("g1", 6, "refused")
    (reason, *_) = [m["values"]["reason"] for m in link.sent if m["op"] == "action_result"]
    assert word in reason


def test_a_start_without_an_answer_is_not_reported_as_refused() -> None:
    """A busy coordinator may have begun the run."""

    async def steps(page: Page, link: Link) -> None:
        page.mute = True
        link.say("send_action_goal", "g1", args={})
        await until(link.results, "the result")

    page, link = played(steps)
    assert link.results() == [("g1", 6, "unknown")] and page.phase == "running"


def test_a_goal_lasts_until_its_run_ends_although_that_begins_late() -> None:
    async def steps(page: Page, link: Link) -> None:
        page.late = 3.0
        link.say("send_action_goal", "g1", args={})
        await until(lambda: link.results() or page.phase == "running", "the run")
        assert not link.results()
        page.phase = "success"
        await until(link.results, "the result")

    assert played(steps)[1].results() == [("g1", 4, "success")]


def test_one_goal_at_a_time() -> None:
    async def steps(page: Page, link: Link) -> None:
        link.say("send_action_goal", "g1", args={})
        link.say("send_action_goal", "g2", args={})
        await until(link.results, "the refusal")

    assert played(steps)[1].results()[0] == ("g2", 6, "refused")


def test_a_goal_that_is_sent_twice_is_one_goal() -> None:
    async def steps(page: Page, link: Link) -> None:
        link.say("send_action_goal", "g1", args={})
        link.say("send_action_goal", "g1", args={})
        link.say("send_action_goal", "g2", args={})
        await until(link.results, "the refusal of the other one")

    assert played(steps)[1].results()[0] == ("g2", 6, "refused")


def test_a_goal_without_a_name_starts_nothing() -> None:
    """Beside it a second goal would be accepted."""

    async def steps(page: Page, link: Link) -> None:
        link.say("send_action_goal", "", args={})
        link.say("send_action_goal", "g2", args={})
        await until(lambda: page.phase == "running", "the run of the other goal")

    assert [verb for verb, _ in played(steps)[0].commands].count("start") == 1


@pytest.mark.parametrize("lost", ["link", "page", "stop"])
def test_a_run_is_aborted_when_its_client_or_link_is_lost(lost: str) -> None:
    """A link that breaks aborts the run: its client can no longer cancel it."""

    async def steps(page: Page, link: Link) -> None:
        link.say("send_action_goal", "g1", args={})
        await until(lambda: page.phase == "running", "the run")
        if lost == "page":
            page.gone = True
            await until(link.results, "the result")
        elif lost == "link":
            link.inbox += [("down", "pulled"), ("up", None)]
            await until(lambda: page.phase == "aborted", "the abort")
            await until(link.results, "a result")

    page, link = played(steps)
    if lost == "page":
        assert link.results() == [("g1", 6, "unknown")]  # it has begun
    else:
        assert page.phase == "aborted" and link.results() == [("g1", 6, "aborted")]
    offered = [m for m in link.sent if m["op"] == "advertise_action"]
    assert len(offered) == (2 if lost == "link" else 1)


def test_a_missing_rosbridge_is_told_once(capsys: pytest.CaptureFixture[str]) -> None:
    async def steps(page: Page, link: Link) -> None:
        link.inbox += 3 * [("down", "refused")] + [("up", None), ("down", "refused"), ("up", None)]
        await until(lambda: len(link.sent) == 3, "the action to be offered again")

    played(steps)
    assert capsys.readouterr().err.count("no connection to rosbridge: refused") == 2


def test_messages_fit_the_definition(tmp_path: Path) -> None:
    """rosbridge drops a message with an unknown field: its goal would never end."""
    (tmp_path / "Mine.action").write_text("---\nstring state\n---\nstring[] places\n")

    async def steps(page: Page, link: Link) -> None:
        link.say("send_action_goal", "g1", args={})
        await until(lambda: page.phase == "running" and len(link.sent) > 1, "the feedback")
        page.phase = "success"
        await until(link.results, "the result")

    definition = tmp_path / "Mine.action"
    _, link = played(steps, type="mine/action/Mine", definition=definition)
    shapes = {m["op"]: set(m["values"]) for m in link.sent if "values" in m}
    assert shapes == {"action_feedback": {"places"}, "action_result": {"state"}}


def test_the_shipped_definition_is_what_is_sent() -> None:
    from petrobot.services.adapters.ros2.messages import faults, read

    known = read(offering.TYPE, RUN_TASK, "RunTask.action")

    async def steps(page: Page, link: Link) -> None:
        link.say("send_action_goal", "g1", args={})
        await until(lambda: page.phase == "running" and len(link.sent) > 1, "the feedback")

    _, link = played(steps)
    for part, op in (("Feedback", "action_feedback"), ("Result", "action_result")):
        for values in [m["values"] for m in link.sent if m["op"] == op]:
            assert set(values) == set(known[f"{offering.TYPE}.{part}"])
            assert faults(values, f"{offering.TYPE}.{part}", known) == []


# --- with a coordinator ------------------------------------------------------------------------

TASK = """
schema = 1
[task]
name = "rest"
final = "rested == 1"
final_error = "tired == 1"
[task.parameters]
seconds = 0.2
[errors]
to = "tired"
[primitive_tasks.rest]
goal = "Time has passed"
alternatives = ["rest"]
deadline = 60.0
[places]
begin = { kind = "control", tokens = 1 }
rest = { kind = "action", task = "rest", args = { seconds = { var = "seconds" } } }
rested = { kind = "control" }
tired = { kind = "control" }
[transitions]
start = { in = ["begin"], out = ["rest"] }
done = { in = ["rest:normal"], out = ["rested"] }
"""
CELL = """
schema = 1
[nodes.pc]
host = "127.0.0.1"
port = {port}
[actions.rest]
run = "resting:rest"
node = "pc"
"""
ACTION = """
from petrobot import success

async def rest(ctx, *, seconds: float):
    await ctx.sleep(seconds)
    return success()
"""


@pytest.fixture(scope="module")
def offered(
    process: FakeProcess, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[FakeProcess]:
    """A fake rosbridge at which the task `rest` of a served coordinator is offered."""
    folder = tmp_path_factory.mktemp("offer")
    (folder / "tasks").mkdir()
    (folder / "tasks" / "rest.toml").write_text(TASK)
    (folder / "services.toml").write_text(CELL.format(port=free_ports(1)[0]))
    (folder / "resting.py").write_text(ACTION)
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}

    def begun(*arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", *arguments]
        pipe = subprocess.PIPE
        return subprocess.Popen(command, cwd=folder, env=environment, stdout=pipe, text=True)

    serving = begun("petrobot.coordinator", "serve", "--up")
    assert serving.stdout is not None
    page = serving.stdout.readline().partition("page: ")[2].strip()
    name = "petrobot.services.adapters.ros2"
    offer = begun(name, "rest", "--page", page, "--url", process.url)
    assert offer.stdout is not None
    assert "is offered" in offer.stdout.readline()
    yield process
    for started in (offer, serving):
        started.terminate()
        assert started.wait(PATIENCE_S) == 0
        assert started.stdout is not None
        started.stdout.close()


@pytest.mark.processes
def test_petrobot_starts_petrobot(offered: FakeProcess) -> None:
    """Our client starts our offered task through rosbridge: success, cancel and refusal of real
    runs."""
    bridge = bridge_to(offered.url)
    bridge.until(lambda: bridge.connected, "the connection")
    bridge.goal("/rest", "first")
    bridge.until_phase(ExchangePhase.SUCCEEDED, "first")
    one = bridge.exchanges.open["first"]
    assert one.values["state"] == "success" and json.loads(one.values["result"])["task"] == "rest"
    request = {"op": "send_action_goal", "action": "/rest", "action_type": offering.TYPE}
    bridge.command(
        time.monotonic(), {"goal": {**request, "args": {"seconds": 50.0}}, "run": "second"}
    )
    bridge.until_phase(ExchangePhase.ACTIVE, "second")
    assert bridge.exchanges.open["second"].feedback["places"]
    bridge.command(time.monotonic(), {"cancel": "second"})
    bridge.until_phase(ExchangePhase.CANCELLED, "second")
    bridge.command(time.monotonic(), {"goal": {**request, "args": {"hours": 50.0}}, "run": "third"})
    bridge.until_phase(ExchangePhase.ABORTED, "third")
    assert "hours" in bridge.exchanges.open["third"].values["reason"]
    bridge.close()


@pytest.mark.processes
@pytest.mark.parametrize(
    ("goal", "cancel", "status"), [({"seconds": 0.5}, [], 4), ({"seconds": 50.0}, ["cancel"], 5)]
)
def test_a_foreign_client_starts_petrobot(
    offered: FakeProcess, goal: dict[str, float], cancel: list[str], status: int
) -> None:
    told = foreign(offered, "/rest", json.dumps(goal), *cancel)
    assert told[-1]["status"] == status
    assert "feedback" in told[0] or not cancel  # on a busy host a short run may end before any
    assert set(told[-1]["result"]) == {"state", "reason", "result"}


@pytest.mark.processes
@pytest.mark.parametrize(
    ("action", "cancel", "status"),
    [("/ok", [], 4), ("/aborts", [], 6), ("/slow", ["cancel"], 5)],
)
def test_the_fake_is_a_rosbridge_for_a_foreign_client(
    fake: FakeProcess, action: str, cancel: list[str], status: int
) -> None:
    """roslibpy works with the fake as with a rosbridge; the other tests rely on that."""
    assert foreign(fake, action, "{}", *cancel)[-1]["status"] == status


def foreign(fake: FakeProcess, *arguments: str) -> list[dict[str, Any]]:
    """Return what roslibpy reports about a goal."""
    if importlib.util.find_spec("roslibpy") is None:
        pytest.skip("roslibpy is not installed")
    script = Path(__file__).parent / "foreign.py"
    ran = subprocess.run(
        [sys.executable, str(script), str(fake.port), *arguments],
        capture_output=True,
        text=True,
        timeout=4 * PATIENCE_S,
    )
    assert ran.returncode == 0, ran.stderr
    return [json.loads(line) for line in ran.stdout.splitlines() if line.startswith("{")]
