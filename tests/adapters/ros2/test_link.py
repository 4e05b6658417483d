"""The connection to a rosbridge in another process: lost, cut, restarted, and with invalid
messages."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest.mock import AsyncMock, Mock

import aiohttp
import pytest

from petrobot.services.adapters.ros2 import bridge as bridge_module
from petrobot.services.adapters.ros2.bridge import Bridge, ExchangePhase
from petrobot.services.comm.protocol.plain import plain
from tests.adapters.conftest import SmallRelay
from tests.adapters.ros2.conftest import FakeProcess
from tests.adapters.ros2.test_actions import Ports
from tests.ports import free_ports
from tests.waiting import PATIENCE_S, Limit

pytestmark = pytest.mark.processes


class Stepped(Bridge):
    """A driver that the test steps, on the clock of the process."""

    def until(self, condition: Callable[[], object], awaited: str) -> None:
        limit = Limit(awaited)
        try:
            while not condition() and limit.left():
                self.ports.now = time.monotonic()  # type: ignore[misc]
                self.step(time.monotonic())
                time.sleep(0.005)
        except AssertionError as fault:
            raise AssertionError(f"{fault}: {self.state()}") from None

    def goal(self, name: str, run: str = "run") -> None:
        request = {"op": "send_action_goal", "action": name, "action_type": "a/action/B"}
        self.command(
            time.monotonic(), {"goal": {**request, "args": {}, "feedback": True}, "run": run}
        )

    def phase(self, run: str = "run") -> ExchangePhase:
        return self.exchanges.open[run].phase

    def until_phase(self, phase: ExchangePhase, run: str = "run") -> None:
        self.until(lambda: self.phase(run) is phase, phase)


def bridge_to(url: str, **config: Any) -> Stepped:
    """A driver that waits long for answers which a busy host delays."""
    config = {"patience": PATIENCE_S, **config}
    return Stepped({"url": url, **config}, Ports())  # type: ignore[arg-type]


@pytest.fixture
def bridge(fake: FakeProcess) -> Iterator[Stepped]:
    made = bridge_to(fake.url)
    made.until(lambda: made.connected, "the first connection")
    yield made
    made.close()


def test_goals_through_a_socket(bridge: Stepped, fake: FakeProcess) -> None:
    for name, phase in (
        ("/ok", ExchangePhase.SUCCEEDED),
        ("/aborts", ExchangePhase.ABORTED),
        ("/rejects", ExchangePhase.REJECTED),
        ("/nested", ExchangePhase.SUCCEEDED),
    ):
        bridge.goal(name, name)
        bridge.until_phase(phase, name)
    bridge.goal("/slow")
    bridge.until_phase(ExchangePhase.ACTIVE)
    assert not bridge.stopped()
    bridge.stop(time.monotonic())
    bridge.until_phase(ExchangePhase.CANCELLED)
    assert bridge.stopped()


def test_no_server_at_first() -> None:
    (port,) = free_ports(1)
    bridge = bridge_to(f"ws://127.0.0.1:{port}")
    bridge.until(lambda: "not connected" not in bridge.link.why, "a refused connection")
    with pytest.raises(ValueError, match="no connection to"):
        bridge.goal("/ok")
    later = FakeProcess(port)
    bridge.until(lambda: bridge.connected, "the server")
    bridge.goal("/ok")
    bridge.until_phase(ExchangePhase.SUCCEEDED)
    bridge.close()
    later.end()


def test_after_a_cut_link_the_goal_is_cancelled(bridge: Stepped, fake: FakeProcess) -> None:
    bridge.goal("/slow")
    bridge.until_phase(ExchangePhase.ACTIVE)
    fake.post("drop")
    bridge.until_phase(ExchangePhase.LOST)
    assert not bridge.stopped()
    bridge.until(bridge.stopped, "the recall")
    goal, *cancels = fake.log("send_action_goal", "cancel_action_goal")
    assert cancels and {m["id"] for m in cancels} == {goal["id"]}


def test_a_killed_server_and_its_successor() -> None:
    """The new server does not know the goal: the cancel is ignored, and the goal is given up after
    `patience`. Whether the robot stands is unknown until a later goal has ended."""
    fake = FakeProcess(*free_ports(1))
    bridge = bridge_to(fake.url, patience=1.2)
    bridge.until(lambda: bridge.connected, "the connection")
    bridge.goal("/slow")
    bridge.until_phase(ExchangePhase.ACTIVE)
    fake.end()
    bridge.until_phase(ExchangePhase.LOST)
    successor = FakeProcess(fake.port)
    bridge.until(lambda: bridge.link.count == 2, "the successor")
    recalled = bridge.now
    for tenths in range(26):  # a busy host would leave out steps of the process's clock
        bridge.step(recalled + tenths / 10)
    assert not bridge.stopped() and bridge.phase() is ExchangePhase.LOST
    bridge.goal("/slow")
    bridge.until_phase(ExchangePhase.ACTIVE)
    told = [message["op"] for message in successor.log()]
    assert told == [*2 * ["cancel_action_goal"], "send_action_goal"]
    bridge.stop(bridge.now)
    bridge.until(bridge.stopped, "the end of the later goal")
    bridge.close()
    successor.end()


def test_a_frozen_server_is_a_lost_link(fake: FakeProcess) -> None:
    bridge = bridge_to(fake.url, heartbeat=2.0)
    bridge.until(lambda: bridge.connected, "the connection")
    bridge.goal("/slow")
    bridge.until_phase(ExchangePhase.ACTIVE)
    os.kill(fake.process.pid, signal.SIGSTOP)
    bridge.until_phase(ExchangePhase.LOST)
    os.kill(fake.process.pid, signal.SIGCONT)
    bridge.until(bridge.stopped, "the recall")
    bridge.close()


RUBBISH = [
    "",
    "{",
    "[]",
    "[" * 50_000,
    '{"op": 3}',
    '{"op": "publish"}',
    '{"op": "publish", "topic": "/b", "msg": {"x": 1208925819614629174706176}}',
    '{"op": "publish", "topic": "/c", "msg": {"x": NaN}}',
    '{"op": "publish", "topic": "/b", "msg": "text"}',
    '{"op": "publish", "topic": ["/b"], "msg": {}}',
    '{"op": "action_result"}',
    '{"op": "action_result", "id": ["run"], "result": true}',
    '{"op": "action_feedback", "id": 7, "values": null}',
    '{"op": "unheard_of", "id": "run"}',
    '{"op": "publish", "topic": "/b", "msg": {"\\ud800": 1}}',
    '{"op": "publish", "topic": "/\\ud800", "msg": {"x": null}}',
    '{"op": "fragment", "id": "0", "data": "x", "num": 0, "total": 2}',
    '{"op": "png", "data": "iVBO"}',
]


def test_a_goal_over_a_lost_link_never_comes_late(fake: FakeProcess, relay: SmallRelay) -> None:
    """Else the server would begin it after the next link has cancelled it."""
    relay.begin(fake.port)
    bridge = bridge_to(f"ws://127.0.0.1:{relay.port}", heartbeat=2.0)
    bridge.until(lambda: bridge.connected, "the connection")
    relay.stall()
    message = {"text": 30_000 * "x"}
    bridge.command(time.monotonic(), {"publish": {"topic": "/t", "type": "a/B", "msg": message}})
    bridge.until(lambda: not bridge.connected, "the loss")
    bridge.close()
    received = relay.read()
    assert 1000 < len(received) < 30_000  # masked: its words cannot be read


def test_invalid_messages_change_nothing(bridge: Stepped, fake: FakeProcess) -> None:
    """Frames that are not messages, or messages that were not requested."""
    bridge.subscribe = {"b": {"topic": "/b", "type": "a/msg/B"}}
    bridge.goal("/slow")
    bridge.until_phase(ExchangePhase.ACTIVE)
    for text in RUBBISH:
        fake.post("send", text)
    fake.post("send", json.dumps({"op": "publish", "topic": "/b", "msg": {"x": 1}}))
    bridge.until(lambda: "b" in bridge.topics, "the message after it")
    assert bridge.topics["b"] == {"msg": {"x": 1}, "count": 1} and bridge.link.count == 1
    assert bridge.phase() is ExchangePhase.ACTIVE and bridge.refused == 11
    plain(bridge.state(), "state")  # or the driver would die of it


@pytest.mark.parametrize("values", [None, [], 7, "text", {"x": 2**70}])
def test_odd_values_of_an_active_goal(bridge: Stepped, fake: FakeProcess, values: Any) -> None:
    bridge.goal("/slow")
    bridge.until_phase(ExchangePhase.ACTIVE)
    one = bridge.exchanges.open["run"]
    said = {"id": one.request["id"], "action": "/slow", "values": values}
    fake.post("send", json.dumps({"op": "action_feedback", **said}))
    bridge.until(lambda: bridge.refused, "the refused feedback")
    assert one.feedback["state"] == "moving"
    fake.post("send", json.dumps({"op": "action_result", **said, "status": 4, "result": True}))
    bridge.until_phase(ExchangePhase.SUCCEEDED)
    assert bool(one.fault) is bool(values and values != "text") and one.values == {}


def test_a_message_that_is_too_long_ends_only_the_link(bridge: Stepped, fake: FakeProcess) -> None:
    fake.post("send", "x" * (5 << 20))
    bridge.until(lambda: bridge.link.count == 2, "the next connection")
    bridge.goal("/ok")
    bridge.until_phase(ExchangePhase.SUCCEEDED)


async def test_large_messages_are_read_slowly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading a large one takes the interpreter from the driver's steps: without pauses a server
    that sends nothing else kept a step for 11 s."""
    pauses, told = list[float](), list[Any]()

    async def sleep(seconds: float) -> None:
        pauses.append(seconds)

    async def frames() -> Any:
        for size in (10, 70_000, 4_000_000):
            text = json.dumps({"op": "publish", "topic": "/b", "msg": {"x": "y" * size}})
            yield aiohttp.WSMessage(aiohttp.WSMsgType.TEXT, text, None)

    session = Mock(tell=lambda kind, item: told.append(kind), room=AsyncMock())
    monkeypatch.setattr("asyncio.sleep", sleep)
    await bridge_module._receive(session, frames())
    assert told == 3 * ["message"] and len(pauses) == 2 and pauses[1] > 50 * pauses[0]


def test_a_full_send_buffer_ends_the_connection(bridge: Stepped, fake: FakeProcess) -> None:
    """The server does not read: memory is bounded, and no step waits."""
    os.kill(fake.process.pid, signal.SIGSTOP)
    message = {"text": "x" * 60_000}
    limit = Limit("a full queue")
    while bridge.connected and limit.left():
        body = {"topic": "/t", "type": "a/msg/B", "msg": message}
        bridge.command(time.monotonic(), {"publish": body})
        bridge.step(time.monotonic())
    assert "does not take what it is sent" in bridge.link.why
    os.kill(fake.process.pid, signal.SIGCONT)
    bridge.until(lambda: bridge.link.count == 2, "the next connection")
