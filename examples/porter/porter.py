"""A porter: a mobile base with a gripper, a barcode reader and a button, all simulated."""

from collections.abc import Mapping
from typing import Any

from petrobot import Axis, Context, Driver, Remote, Result, error, failure, key, success

STATIONS = {"dock": 0.0, "shelf": 1.0, "left": 2.5, "right": 3.0}  # m along the corridor
OPENINGS = {"closed": 0.0, "half": 0.04, "open": 0.08}  # m between the fingers


class Base(Axis):
    """Drives along a corridor, never faster than the stream `limit` allows."""

    period = 0.02
    obeys = (*Axis.obeys, "dry_run")
    stations = STATIONS
    top_speed = 1.0
    blind: float = key(0.4, "m/s while nobody watches the corridor", above=0)

    def step(self, now: float) -> None:
        limit = self.ports.stream("limit").values
        self.allowed = self.blind if limit is None else limit[0]
        super().step(now)


class Gripper(Axis):
    """Two fingers; some parts slip. In a dry run it moves, but grips nothing."""

    period = 0.02
    obeys = (*Axis.obeys, "dry_run")
    stations = OPENINGS
    slips: float = key(0.2, "share of the parts that slip out", least=0, most=1)

    def setup(self) -> None:
        self.holds = False

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        super().command(now, body)
        slipped = self.ports.random("slip").random() < self.slips
        self.holds = body["to"] == "closed" and not slipped and not self.dry_run

    def state(self) -> Mapping[str, Any]:
        return {**super().state(), "holds": self.holds}


class Reader(Driver):
    """Reads barcodes; this one makes them up."""

    unreadable: float = key(0.1, "share of the codes that cannot be read", least=0, most=1)

    def read(self) -> str | None:
        draws = self.ports.random("code")
        return None if draws.random() < self.unreadable else str(draws.choice(["left", "right"]))


class Button(Driver):
    """Somebody presses it now and then; a real one would read a pin in `step`."""

    period = 0.1
    every: float = key(6.0, "s, mean time between two presses", above=0)

    def step(self, now: float) -> None:
        if self.ports.random("press").random() < self.period / self.every:
            self.ports.raise_event("button")


async def drive_fast(ctx: Context[Remote], *, to: str) -> Result:
    """Drive to a station at full speed; the wheels slip now and then."""
    if ctx.random("wheels").random() < 0.1:
        await ctx.sleep(0.2)
        return error("wheel_slip", "the wheels slipped")
    await ctx.command({"to": to}, until="arrived")
    return success()


async def drive_careful(ctx: Context[Remote], *, to: str) -> Result:
    """Drive to a station at half speed."""
    await ctx.command({"to": to, "speed": 0.5}, until="arrived")
    return success()


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
    await ctx.command({"to": "open"}, until="arrived")
    state = await ctx.command({"to": "closed"}, until="arrived")
    return success() if state["holds"] else error("slipped", "the part slipped out")


async def let_go(ctx: Context[Remote]) -> Result:
    """Open the gripper."""
    await ctx.command({"to": "open"}, until="arrived")
    return success()


async def wave(ctx: Context[Remote]) -> Result:
    """Show that the button was seen."""
    for opening in ("half", "open"):
        await ctx.command({"to": opening}, until="arrived")
    return success()


async def count(ctx: Context, *, into: str) -> Result:
    """Count the parts of each bin in the global memory."""
    while True:
        parts, version = await ctx.get_versioned(f"parts_{into}", 0)
        if await ctx.compare_and_set(f"parts_{into}", version, parts + 1):
            return success(parts=parts + 1)


async def recover(ctx: Context[Remote]) -> Result:
    """Drive back to the dock."""
    await ctx.command({"to": "dock"}, until="arrived")
    return success()
