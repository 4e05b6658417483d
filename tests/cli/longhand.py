"""The robot `arm_bot`, with all methods of its driver written out."""

from collections.abc import Mapping
from typing import Any

from petrobot import Context, Driver, Remote, Result, error, key, success


class Axis(Driver):
    """Moves along one axis; this one is simulated. A real one would open its port in `setup` and
    write to its motor in `step`."""

    period = 0.01  # s between two steps; without it the driver has no `step`, and nothing moves
    obeys = ("speed", "workspace", "dry_run", "pause")  # see self.speed, self.paused ... below
    top_speed: float = key(0.5, "m/s", above=0)
    length: float = key(1.0, "m, from end to end")

    def setup(self) -> None:
        self.at = self.goal = 0.0  # m along x

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """`{"to": metres}`."""
        to = body.get("to")
        if not isinstance(to, int | float) or not 0.0 <= to <= self.length:
            raise ValueError(f"to: expected 0 to {self.length} m, found {to!r}")
        if outside := self.workspace.outside((to, 0.0, 0.0)):
            raise ValueError(f"to: {outside}")
        self.goal = float(to)

    def step(self, now: float) -> None:
        if not self.paused:
            most = self.speed * self.top_speed * self.period
            self.at += max(-most, min(most, self.goal - self.at))
            # A real one would write to its motor here, unless `self.dry_run`, and call `stop` where
            # its axis leaves the workspace.

    def state(self) -> Mapping[str, Any]:
        return {"at": self.at, "arrived": self.stopped()}

    def stop(self, now: float) -> None:
        self.goal = self.at

    def stopped(self) -> bool:
        return self.at == self.goal


async def move(ctx: Context[Remote], *, to: float) -> Result:
    """Move to a position (m)."""
    await ctx.command({"to": to})
    if not await ctx.wait(lambda: ctx.device.state["arrived"], 5.0):
        return error("blocked", f"did not reach {to} m within 5 s")
    return success(at=ctx.device.state["at"])


async def grip(ctx: Context[Remote], *, slips: float = 0.2) -> Result:
    """Close the gripper on a part; some slip out."""
    await ctx.sleep(0.3)
    if ctx.random("grip").random() < slips:
        return error("slipped", "the part slipped out")
    return success()
