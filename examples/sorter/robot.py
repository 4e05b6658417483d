"""A robot that sorts parts: an arm on a rail and a barcode scanner, both simulated."""

from petrobot import Axis, Context, Driver, Remote, Result, error, failure, key, success

STATIONS = {"home": 0.0, "belt": 0.2, "left": 0.5, "right": 0.8}  # m along the rail


class Arm(Axis):
    """Moves along a rail."""

    obeys = (*Axis.obeys, "dry_run")
    stations = STATIONS

    def step(self, now: float) -> None:
        super().step(now)
        # A real one writes self.at to its motor here, unless self.dry_run.


class Scanner(Driver):
    """Reads barcodes; this one makes them up."""

    unreadable: float = key(0.1, "share of the codes that cannot be read", least=0, most=1)

    def read(self) -> str | None:
        draws = self.ports.random("code")
        return None if draws.random() < self.unreadable else str(draws.choice(["left", "right"]))


async def move(ctx: Context[Remote], *, to: str) -> Result:
    """Move the arm to a station."""
    await ctx.command({"to": to}, until="arrived")
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
