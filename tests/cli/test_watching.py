"""What the page shows beside the net: pictures, devices and set points of nodes, requested only
while an operator watches."""

from __future__ import annotations

from base64 import b64decode
from typing import Any

from petrobot.coordinator.cli.watch import _snapshot
from petrobot.services.comm.protocol.messages import Command
from tests.cli.conftest import Terminal
from tests.waiting import until


def verbs(terminal: Terminal) -> list[str]:
    """Return the requests to the node other than calls, in order."""
    asked: list[str] = []
    place: Any = terminal.robot.node.places["arm"]
    carry_out = place.command

    def command(now: float, command: Command) -> None:
        asked.append(command.verb)
        carry_out(now, command)

    place.command = command
    return asked


async def test_pictures_and_states_come_while_an_operator_watches(petrobot: Terminal) -> None:
    """The page gets the newest picture as text, joints and values of the device, and the age of its
    set points."""
    petrobot.arm.sees, petrobot.arm.setpoint_age = b"not really a picture", 0.012
    feed = petrobot.operation.feed
    changes: list[dict[str, Any]] = []
    stop = petrobot.operation.subscribe(changes.append)
    await until(
        lambda: bool(feed.state["images"] and feed.state["setpoints"] and feed.state["devices"])
    )
    stop()
    image = feed.state["images"]["arm"]
    assert b64decode(image["data"]) == petrobot.arm.sees
    assert (image["mime"], image["width"], image["height"], image["age"]) == (
        "image/png",
        2,
        1,
        0.5,
    )
    assert feed.state["devices"]["arm"]["joints"] == [0.0, 1.5]
    (time, age), *_ = feed.state["setpoints"]["way"]["samples"]
    assert age == 0.012 and time > 0.0


async def test_without_an_operator_nothing_is_requested(petrobot: Terminal) -> None:
    """Without operators a node gets no request; it gets requests again as soon as one watches."""
    asked = verbs(petrobot)
    feed = petrobot.operation.feed
    polled: list[dict[str, Any]] = []
    petrobot.operation.watching._health = lambda node, up: polled.append({node: up})  # type: ignore[method-assign]
    await until(lambda: len(polled) > 3)
    assert asked == [] and feed.state["images"] == {}
    stop = petrobot.operation.subscribe(lambda change: None)
    await until(lambda: {"status", "picture"} <= set(asked))
    stop()


async def test_old_set_points_are_not_shown(petrobot: Terminal) -> None:
    """A stream without a sender does not show an old set point for ever. A device without a picture
    shows none."""
    petrobot.arm.setpoint_age = 3.0
    stop = petrobot.operation.subscribe(lambda change: None)
    feed = petrobot.operation.feed
    await until(
        lambda: feed.state["devices"].get("arm", {}).get("values", {}).get("setpoint_age") == 3.0
    )
    asked = verbs(petrobot)
    await until(lambda: asked.count("picture") >= 2)
    stop()
    assert feed.state["setpoints"] == {} and feed.state["images"] == {}


async def test_a_paused_run_is_shown_as_paused(petrobot: Terminal) -> None:
    """Its state in the protocol stays `running`; people read the pause beside it."""
    await petrobot("pause")
    assert ": paused (by " in _snapshot(petrobot.operation.feed.state)
    await petrobot("continue")
    assert ": running; " in _snapshot(petrobot.operation.feed.state)
