"""The action of most devices: send a command, wait until it is done, failed or late."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from petrobot import Context, Driver, Remote, Result, perform, rehearse


class Lift(Driver):
    """Rises for a second; jams if the test says so."""

    period = 0.01

    def __init__(self, jams: float = 9.0) -> None:
        self.height, self.moving, self.jams = 0.0, False, jams
        self.commands: list[Mapping[str, Any]] = []

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if body["do"] not in ("rise", "rest"):
            raise ValueError(f"unknown command {body['do']!r}")
        if self.height >= self.jams:
            raise ValueError("it is jammed")
        self.moving = body["do"] == "rise"
        self.commands.append(body)

    def step(self, now: float) -> None:
        if self.moving and self.height < min(1.0, self.jams):
            self.height += self.period

    def state(self) -> Mapping[str, Any]:
        jammed = self.height >= self.jams
        faults = {"jammed": "something is in the way"} if jammed else {}
        return {"height": self.height, "faults": faults, "reason": "it rises slowly"}


async def rise(ctx: Context[Remote], *, do: str = "rise", timeout: float = 2.0) -> Result:
    return await perform(ctx, {"do": do}, lambda state: state["height"] >= 0.995, timeout)


@pytest.mark.parametrize(
    ("jams", "arguments", "ended", "text", "sent"),
    [
        (9.0, {}, ("success", ""), "", ["rise"]),
        (0.5, {}, ("error", "jammed"), "something is in the way", ["rise"]),
        (0.0, {}, ("error", "jammed"), "something is in the way", []),
        (9.0, {"timeout": 0.5}, ("error", "late"), "0.5 s it rises slowly", ["rise", "rest"]),
        (9.0, {"do": "fly"}, ("error", "command_refused"), "unknown command 'fly'", []),
    ],
)
def test_each_end(
    jams: float, arguments: dict[str, Any], ended: tuple[str, str], text: str, sent: list[str]
) -> None:
    lift = Lift(jams)
    result = rehearse(rise, device=lift, **arguments).result
    assert (result.status, result.cause) == ended and text in result.text
    assert [body["do"] for body in lift.commands] == sent
