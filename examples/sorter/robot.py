"""A robot that sorts parts: an arm on a rail and a barcode scanner, both simulated."""

from collections.abc import Mapping
from typing import Any

from petrobot import Context, Driver, Remote, Result, error, failure, key, success

STATIONS = {"home": 0.0, "belt": 0.2, "left": 0.5, "right": 0.8}  # m along the rail


class Arm(Driver):
    """Moves along a rail. A real one would send its speed to a motor in `step`, but not in a
    `dry_run`."""

    period = 0.01  # s between two steps
    obeys = ("speed", "workspace", "dry_run", "pause")  # first motions, and pause
    top_speed: float = key(0.5, "m/s")

    def setup(self) -> None:
        self.at = self.goal = 0.0  # m

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if body.get("to") not in STATIONS:
            raise ValueError(f"to: {body.get('to')!r} is none of {', '.join(STATIONS)}")
        if outside := self.workspace.outside((STATIONS[body["to"]], 0.0, 0.0)):
            raise ValueError(outside)
        self.goal = STATIONS[body["to"]]

    def step(self, now: float) -> None:
        if not self.paused:
            most = self.speed * self.top_speed * self.period
            self.at += max(-most, min(most, self.goal - self.at))

    def state(self) -> Mapping[str, Any]:
        return {"at": self.at, "arrived": self.stopped()}

    def stop(self, now: float) -> None:
        self.goal = self.at

    def stopped(self) -> bool:
        return self.at == self.goal


class Scanner(Driver):
    """Reads barcodes; this one makes them up."""

    unreadable: float = key(0.1, "share of the codes that cannot be read")

    def read(self) -> str | None:
        draws = self.ports.random("code")
        return None if draws.random() < self.unreadable else str(draws.choice(["left", "right"]))


async def move(ctx: Context[Remote], *, to: str) -> Result:
    """Move the arm to a station."""
    await ctx.command({"to": to})
    if not await ctx.wait(lambda: ctx.device.state["arrived"], 5.0):
        return error("blocked", f"the arm did not reach {to} within 5 s")
    return success()


async def grip(ctx: Context[Remote], *, slips: float = 0.2) -> Result:
    """Close the gripper on a part; some slip out."""
    await ctx.sleep(0.3)
    slipped = ctx.random("grip").random() < slips
    return error("slipped", "the part slipped out") if slipped else success()


async def scan(ctx: Context[Scanner]) -> Result:
    """Read the part's barcode: it names the bin."""
    await ctx.sleep(0.1)
    code = ctx.device.read()
    return success(code=code) if code else failure("unreadable", "put it aside", code="left")
