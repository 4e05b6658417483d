"""A porter: a mobile base with a gripper, a barcode reader and a button, all simulated."""

from collections.abc import Mapping
from typing import Any

from petrobot import Context, Driver, Remote, Result, error, failure, key, success

STATIONS = {"dock": 0.0, "shelf": 1.0, "left": 2.5, "right": 3.0}  # m along the corridor


class Base(Driver):
    """Drives along a corridor, never faster than the stream `limit` allows."""

    period = 0.02
    obeys = ("speed", "workspace", "dry_run", "pause")
    top_speed: float = key(1.0, "m/s")
    blind: float = key(0.4, "m/s while nobody watches the corridor")

    def setup(self) -> None:
        self.allowed = self.ports.stream("limit")
        self.at = self.goal = 0.0
        self.share = 1.0

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if body.get("to") not in STATIONS:
            raise ValueError(f"to: {body.get('to')!r} is none of {', '.join(STATIONS)}")
        if outside := self.workspace.outside((STATIONS[body["to"]], 0.0, 0.0)):
            raise ValueError(outside)
        self.goal, self.share = STATIONS[body["to"]], body.get("share", 1.0)

    def step(self, now: float) -> None:
        limit = self.blind if self.allowed.values is None else self.allowed.values[0]
        if not self.paused:
            most = self.speed * min(self.top_speed * self.share, limit) * self.period
            self.at += max(-most, min(most, self.goal - self.at))

    def state(self) -> Mapping[str, Any]:
        return {"at": self.at, "arrived": self.at == self.goal}

    def stop(self, now: float) -> None:
        self.goal = self.at

    def stopped(self) -> bool:
        return self.at == self.goal


class Gripper(Driver):
    """Opens and closes; some parts slip. In a dry run it moves, but grips nothing."""

    period = 0.02
    obeys = ("speed", "dry_run")
    slips: float = key(0.2, "share of the parts that slip out")

    def setup(self) -> None:
        self.left, self.holds = 0.0, False

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        if body.get("do") not in ("close", "open", "wave"):
            raise ValueError(f"do: {body.get('do')!r} is none of close, open, wave")
        self.left = 0.3 / self.speed
        if body["do"] != "wave":
            slipped = self.ports.random("slip").random() < self.slips
            self.holds = body["do"] == "close" and not slipped and not self.dry_run

    def step(self, now: float) -> None:
        self.left = max(0.0, self.left - self.period)

    def state(self) -> Mapping[str, Any]:
        return {"done": self.stopped(), "holds": self.holds}

    def stop(self, now: float) -> None:
        self.left = 0.0

    def stopped(self) -> bool:
        return self.left == 0.0


class Reader(Driver):
    """Reads barcodes; this one makes them up."""

    unreadable: float = key(0.1, "share of the codes that cannot be read")

    def read(self) -> str | None:
        draws = self.ports.random("code")
        return None if draws.random() < self.unreadable else str(draws.choice(["left", "right"]))


class Button(Driver):
    """Somebody presses it now and then; a real one would read a pin in `step`."""

    period = 0.1
    every: float = key(6.0, "s, mean time between two presses")

    def step(self, now: float) -> None:
        if self.ports.random("press").random() < self.period / self.every:
            self.ports.raise_event("button")


async def _drive(ctx: Context[Remote], to: str, share: float) -> Result:
    await ctx.command({"to": to, "share": share})
    if not await ctx.wait(lambda: ctx.device.state["arrived"], 9.0):
        return error("blocked", f"did not reach {to} within 9 s")
    return success()


async def drive_fast(ctx: Context[Remote], *, to: str) -> Result:
    """Drive to a station at full speed; the wheels slip now and then."""
    if ctx.random("wheels").random() < 0.1:
        await ctx.sleep(0.2)
        return error("wheel_slip", "the wheels slipped")
    return await _drive(ctx, to, 1.0)


async def drive_careful(ctx: Context[Remote], *, to: str) -> Result:
    """Drive to a station at half speed."""
    return await _drive(ctx, to, 0.5)


async def watch(ctx: Context) -> Result:
    """Watch the corridor and send the base its speed limit, until cancelled."""
    while True:
        people = ctx.random("people").random() < 0.2
        ctx.publish("limit", [0.3 if people else 1.0])
        await ctx.sleep(0.5)


async def scan(ctx: Context[Reader]) -> Result:
    """Read the part's barcode: it names the bin."""
    await ctx.sleep(0.2)
    code = ctx.device.read()
    return success(code=code) if code else failure("unreadable", "goes left", code="left")


async def grasp(ctx: Context[Remote]) -> Result:
    """Close the gripper on a part."""
    await ctx.command({"do": "close"})
    await ctx.wait(lambda: ctx.device.state["done"])
    return success() if ctx.device.state["holds"] else error("slipped", "the part slipped out")


async def let_go(ctx: Context[Remote]) -> Result:
    """Open the gripper."""
    await ctx.command({"do": "open"})
    await ctx.wait(lambda: ctx.device.state["done"])
    return success()


async def wave(ctx: Context[Remote]) -> Result:
    """Show that the button was seen."""
    await ctx.command({"do": "wave"})
    await ctx.wait(lambda: ctx.device.state["done"])
    return success()


async def count(ctx: Context, *, into: str) -> Result:
    """Count the parts of each bin in the global memory."""
    while True:
        parts, version = await ctx.get_versioned(f"parts_{into}", 0)
        if await ctx.compare_and_set(f"parts_{into}", version, parts + 1):
            return success(parts=parts + 1)


async def recover(ctx: Context[Remote]) -> Result:
    """Drive back to the dock."""
    return await _drive(ctx, "dock", 1.0)
