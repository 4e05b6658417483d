"""A rosbridge written from the text of its protocol alone (version 2), with its odd sides: messages
in fragments, feedback after the result, rejections, answers in another order, a death in mid-goal
after which the successor knows nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from petrobot import Context, Remote, Result, rehearse
from petrobot.services.adapters.ros2 import actions
from petrobot.services.adapters.ros2.bridge import LARGEST, Bridge, Fragments, parse
from petrobot.services.adapters.ros2.messages import Message
from tests.adapters.ros2.test_actions import Ports

Sent = list[Message]


def fragments(message: Message, size: int) -> Sent:
    """What the protocol says of `fragment`: id, data, num and total."""
    text = json.dumps(message)
    cut = [text[at : at + size] for at in range(0, len(text), size)]
    return [
        {"op": "fragment", "id": f"f{message['id']}", "data": part, "num": number,
         "total": len(cut)}
        for number, part in enumerate(cut)
    ]  # fmt: skip


class Foreign:
    """A server with one manner, which its action's name says."""

    def __init__(self) -> None:
        self.later: list[tuple[float, Message]] = []
        self.cancelled: list[str] = []
        self.held: Sent = []

    def receive(self, now: float, message: Message) -> Sent:
        if message["op"] == "cancel_action_goal":
            self.cancelled.append(message["id"])
            return [self.result(message, 5, {})] if message["action"] != "/deaf" else []
        if message["op"] != "send_action_goal":
            return []
        name, ended = message["action"], self.result(message, 4, {"text": "x" * 300, "n": 7})
        feedback = {"op": "action_feedback", "action": name, "id": message["id"],
                    "values": {"left": 0.5}}  # fmt: skip
        if name == "/fragments":
            return [*fragments(feedback, 30), *fragments(ended, 50)]
        if name == "/shuffled":
            return [*fragments(feedback, 30), *reversed(fragments(ended, 50))]
        if name == "/broken":  # one fragment is missing, one has no number
            return [*fragments(ended, 50)[1:], {"op": "fragment", "id": "f", "data": "x"}]
        if name == "/afterwards":
            return [ended, feedback, {**ended, "status": 6, "result": False}]
        if name == "/rejects":
            return [{**ended, "values": "rejected by the planner", "status": 0, "result": False}]
        if name == "/status":
            return [{"op": "status", "level": "error", "id": message["id"],
                     "msg": "no such action server"}]  # fmt: skip
        if name == "/swapped":  # the second goal is answered before the first
            self.held.append({**ended, "values": {"n": len(self.held)}})
            return self.held[::-1] if len(self.held) == 2 else []
        return [feedback]

    def step(self, now: float) -> Sent:
        return []

    @staticmethod
    def result(goal: Message, status: int, values: Any) -> Message:
        return {"op": "action_result", "action": goal["action"], "id": goal["id"],
                "values": values, "status": status, "result": True}  # fmt: skip


def bridge() -> Bridge:
    return Bridge({"url": f"{__name__}:Foreign", "patience": 1.0}, None)  # type: ignore[arg-type]


def goal(name: str, **more: Any) -> Callable[[Context[Remote]], Any]:
    async def act(ctx: Context[Remote]) -> Result:
        options: dict[str, Any] = {"timeout": 1.0, **more}
        return await actions.goal(ctx, action=name, action_type="a/action/B", **options)

    return act


@pytest.mark.parametrize(
    ("name", "cause", "executed", "text"),
    [
        ("/fragments", "", "yes", ""),
        ("/shuffled", "", "yes", ""),
        ("/afterwards", "", "yes", ""),
        ("/rejects", "rejected", "no", "rejected by the planner"),
        ("/status", "rejected", "no", "no such action server"),
        ("/broken", "timeout", "yes", "cancelled after 1 s"),
        ("/slow", "timeout", "yes", "cancelled after 1 s"),
        ("/deaf", "timeout", "unknown", "its cancel was not answered"),
    ],
)
def test_one_cause_and_the_next_goal_works(name: str, cause: str, executed: str, text: str) -> None:
    device = bridge()
    found = rehearse(goal(name), device=device).result
    assert (found.cause, found.executed) == (cause, executed), found
    assert text in found.text and (cause or found.values["n"] == 7)
    again = rehearse(goal("/afterwards"), device=device).result
    assert again.status == "success"
    assert device.stopped() is (name != "/deaf"), "nobody knows whether that goal has ended"
    assert ("not a fragment" in device.fault) == (name == "/broken")


def test_answers_in_another_order_belong_to_their_goals() -> None:
    device = Bridge({"url": f"{__name__}:Foreign"}, Ports())  # type: ignore[arg-type]
    device.step(0.0)
    for run in ("one", "two"):
        request = {"op": "send_action_goal", "action": "/swapped", "action_type": "a/action/B"}
        device.command(0.0, {"goal": {**request, "args": {}, "feedback": True}, "run": run})
    device.step(0.02)
    told = device.state()["exchanges"]
    assert {run: told[run]["values"] for run in told} == {"one": {"n": 0}, "two": {"n": 1}}


def test_a_cancelled_run_cancels_its_goal_at_the_server() -> None:
    device = bridge()
    rehearse(goal("/slow", timeout=None), device=device, cancel_after=0.5)
    assert len(device.link._device.cancelled) == 1 and device.stopped()  # type: ignore[union-attr]


def test_fragments_do_not_fill_the_memory() -> None:
    waiting = Fragments()
    long = {"op": "fragment", "id": "a", "data": "x" * (LARGEST // 2 + 1), "total": 9}
    assert waiting.add({**long, "num": 0}) is None
    with pytest.raises(ValueError, match="too many or too long"):
        waiting.add({**long, "num": 1})
    with pytest.raises(ValueError, match="too many or too long"):
        for name in range(20):
            waiting.add({"op": "fragment", "id": str(name), "data": "x", "num": 0, "total": 2})
    with pytest.raises(ValueError, match="not a fragment"):  # empty ones fill it, too
        waiting.add({"op": "fragment", "id": "b", "data": "", "num": 5000, "total": 9999})
    whole = fragments({"op": "publish", "id": "z", "msg": {"data": "\u00e4"}}, 5)
    fresh = Fragments()
    told = [fresh.add(parse(json.dumps(part))) for part in whole]
    assert told[-1] == {"op": "publish", "id": "z", "msg": {"data": "\u00e4"}}
