"""Primitive actions of the rover: enable the drives, follow the track, recover it across an
interruption, search, stop at the T.

All are coroutines that reach the driver only through `ctx.device`, a `Remote` of
`petrobot.services.mobile.rover:Rover`. Error causes: `drive_fault`, `power`, `bus` (reported by the
driver), `stale_set_point`, `no_line`, `refused`, `timeout`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from petrobot.services.action import (
    Cancelled,
    Context,
    Result,
    Status,
    error,
    failure,
    provisional,
    success,
)
from petrobot.services.mobile import paths
from petrobot.services.mobile.odometry import Pose, turned
from petrobot.services.mobile.sight import TrackEnd
from petrobot.services.perform import command_drives, drive_fault

RENEW: Final = 0.1
"""Seconds between repeated motion commands; the driver rests if it receives none for 0.4 s."""
TAKE_OVER: Final = 0.34
"""m before the end of the line at which following is finished: the next action begins on the
move."""
BEYOND: Final = 0.6
"""How far a plan continues straight on where the track should have been found (m)."""
ROLLED: Final = 0.3
"""Length that must have been followed for a line to count as one that has ceased (m)."""
SILENT: Final = 1.0
"""Seconds of standing without a set point after which the stream counts as ceased."""
STUCK: Final = 0.5
"""Seconds of standing without a line after which the line counts as lost."""
NEAR_GATE: Final = 0.40
"""Distance from where a track can resume within which a reflector marks it (m)."""
STALENESS: Final = 0.1
"""What a reflector's position loses in value per second since its last echo (m/s)."""
REFLECTOR_PATIENCE: Final = 1.2
"""Seconds to wait for a reflector at the line's end."""
LOOKS: Final = ((0.8, (0.0, 1.4, -1.4, 0.7, -0.7)), (0.2, (0.0, 0.8, -0.8)))
"""Where a search looks around: m beyond the line's end, and headings relative to it (rad)."""
LOOK: Final = 0.35
"""Seconds of looking after each turn of a search."""
STANDS_FOR: Final = 0.6
"""Seconds that the rover must have stood at the T: the rules require half a second."""
STOP_AT: Final = 0.10
"""Where the axle stops beyond the T's bar (m): the middle of what the rules allow."""

Judge = Callable[[Mapping[str, Any]], Result | None]


async def enable_drives(ctx: Context, *, timeout: float = 8.0, forget: bool = False) -> Result:
    """Reset faults and enable both drives; the rover stands. ERROR as the driver reports if they
    stay in fault.

    With `forget` the map of the track is emptied: the rover has been carried elsewhere.
    """
    until = ctx.now + timeout
    await ctx.command({"do": "reset"})
    if forget:
        await ctx.command({"do": "forget"})
        await ctx.command({"do": "stretch"})
    if not await ctx.wait(lambda: bool(ctx.device.state["enabled"]), max(0.0, until - ctx.now)):
        return drive_fault(ctx.device.state, "wheel") or error(
            "timeout", f"the drives were not enabled within {timeout} s"
        )
    return success()


async def follow_feed_forward(
    ctx: Context,
    *,
    speed: float = 0.5,
    timeout: float = 240.0,
    patience: float = 6.0,
    recovery: str = "",
) -> Result:
    """Follow the track to its end by its own curvature plus PD on the error at the axle. See
    `_follow`."""
    return await _follow(ctx, "feed_forward", speed, timeout, patience, recovery)


async def follow_pursuit(
    ctx: Context,
    *,
    speed: float = 0.5,
    timeout: float = 240.0,
    patience: float = 6.0,
    recovery: str = "",
) -> Result:
    """Follow the track to its end by pure pursuit of a point ahead on it. See `_follow`."""
    return await _follow(ctx, "pursuit", speed, timeout, patience, recovery)


async def home_on_reflector(
    ctx: Context,
    *,
    line_end: Sequence[float] | None = None,
    speed: float = 0.5,
    timeout: float = 25.0,
    judged: bool = False,
) -> Result:
    """Recover the track by the reflector above the point where it resumes: drive the circle through
    that point. See `_recovered` and `_found`.

    FAILURE `no_reflector` when none answers from where the track can resume.
    """
    return _found(ctx, await _home(ctx, line_end, speed, timeout), judged)


async def _home(
    ctx: Context, line_end: Sequence[float] | None, speed: float, timeout: float
) -> Result:
    end, gates = _geometry(ctx, line_end)
    where: tuple[float, float] | None = None

    def found() -> bool:
        nonlocal where
        where = _marked(ctx.device.state["reflectors"], gates)
        return where is not None

    drive = _Drive(ctx, "feed_forward", speed, timeout)
    await drive.start(gates)
    if not found():
        await drive.until(lambda state: success() if found() else None, REFLECTOR_PATIENCE)
    if where is None:
        await drive.rest()
        return failure(
            "no_reflector", "no reflector answers from where the track can resume", recovered=False
        )
    return await _along(drive, paths.arc_through(end, *where, BEYOND))


async def dead_reckon(
    ctx: Context,
    *,
    line_end: Sequence[float] | None = None,
    speed: float = 0.5,
    curvature: float = 0.0,
    timeout: float = 25.0,
    judged: bool = False,
) -> Result:
    """Recover the track by driving on along the curve that the missing element is expected to have.
    See `_recovered` and `_found`.

    `curvature` (1/m, positive to the left): 0 expects a straight, 1 or -1 a quarter arc.
    """
    end, gates = _geometry(ctx, line_end)
    drive = _Drive(ctx, "feed_forward", speed, timeout)
    await drive.start(gates)
    square, _ = ctx.device.state["element"]
    length = square if curvature == 0.0 else 0.5 * math.pi / abs(curvature)
    last = Pose(*paths.arc(end, curvature, length)[-1], end.heading + curvature * length)
    way = paths.arc(end, curvature, length) + paths.arc(last, 0.0, BEYOND - 0.2)
    return _found(ctx, await _along(drive, way), judged)


async def search_pattern(
    ctx: Context,
    *,
    line_end: Sequence[float] | None = None,
    speed: float = 0.4,
    rate: float = 1.2,
    timeout: float = 60.0,
    judged: bool = False,
) -> Result:
    """Recover the track by driving into the empty square and looking straight on, to the left and
    to the right.

    Needs no sensor and no guess, and finds the way back from a wrong guess; takes longest. A rover
    that stands looks around where it is first: the line may be in view. See `_recovered` and
    `_found`.
    """
    return _found(ctx, await _search(ctx, line_end, speed, rate, timeout), judged)


async def _search(
    ctx: Context, line_end: Sequence[float] | None, speed: float, rate: float, timeout: float
) -> Result:
    end, gates = _geometry(ctx, line_end)
    drive = _Drive(ctx, "feed_forward", speed, timeout)
    await drive.start(gates)
    ended = await _where_it_stands(drive)
    for ahead, turns in LOOKS:
        place = Pose(*end.floor(ahead, 0.0), end.heading)
        ended = ended or await _go(drive, place, rate)
        for turn in turns:
            ended = ended or await _look(drive, turned(place.heading + turn), rate)
    return ended or failure("no_track", "the track is not where it can resume", recovered=False)


async def stop_at_t(
    ctx: Context, *, line_end: Sequence[float], speed: float = 0.35, timeout: float = 12.0
) -> Result:
    """Stop with the axle just behind the T's bar. SUCCESS when the rover stands within 0.3 m of it;
    ERROR as the driver reports."""
    end = Pose(*map(float, line_end))
    drive = _Drive(ctx, "feed_forward", speed, timeout)
    await drive.start((), look=False)
    await ctx.command({"do": "plan", "points": paths.arc(end, 0.0, STOP_AT)})
    stuck = await drive.until(lambda state: success() if _stands(state) else None, timeout)
    await drive.rest()
    if stuck.cause:
        return stuck
    await ctx.wait(lambda: bool(ctx.device.state["standing"]), 2.0)
    await ctx.sleep(STANDS_FOR)
    x, y, _ = ctx.device.state["pose"]
    ahead, aside = end.body(x, y)
    if not (-0.1 < ahead < 0.3 and abs(aside) < 0.3):
        return failure(
            "off_the_t",
            f"stands {ahead:.2f} m beyond and {aside:.2f} m beside the T",
            ahead=ahead,
            aside=aside,
        )
    return success(ahead=ahead, aside=aside)


def _stands(state: Mapping[str, Any]) -> bool:
    return bool(state["standing"]) and (state["ahead"] < 0.05 or state["reason"] == "no_line")


async def _follow(
    ctx: Context, law: str, speed: float, timeout: float, patience: float, recovery: str
) -> Result:
    """Follow the streamed track until its end is near; the rover keeps rolling for the next action.

    SUCCESS: `at_t` says whether the T or an interruption ends it, `line_end` where (pose in the
    odometry frame). FAILURE `unannounced_end` (same values) when the line just ceased. ERROR:
    `no_line` when none was seen within `patience` s, `stale_set_point` when the stream ceased, or
    as the driver reports.

    `recovery` is the run that found the line, if it is to be judged: a line that is followed to an
    end that was announced belongs to the track, one that ceases does not.
    """
    drive = _Drive(ctx, law, speed, timeout)
    begun, way = ctx.now, ctx.device.state["way"]
    lost: dict[str, float] = {}

    def judge(state: Mapping[str, Any]) -> Result | None:
        if (
            state["end"] is not None
            and state["ahead"] < TAKE_OVER
            and state["line_end"] is not None
        ):
            return success(at_t=state["end"] == TrackEnd.T, line_end=list(state["line_end"]))
        why = state["reason"]
        if why not in ("no_line", "stale") or not state["standing"]:
            lost.clear()
            return None
        stuck = ctx.now - lost.setdefault(why, ctx.now)
        patient = stuck if state["way"] - way > ROLLED else min(stuck, ctx.now - begun - patience)
        if patient <= (STUCK if why == "no_line" else SILENT):
            return None
        if why == "stale":
            return error("stale_set_point", f"no new sight has arrived for {stuck:.1f} s")
        if state["way"] - way > ROLLED and state["line_end"] is not None:
            return failure(
                "unannounced_end", "the line ceased", at_t=False, line_end=list(state["line_end"])
            )
        return error("no_line", f"no line to follow for {stuck:.1f} s")

    try:
        result = await drive.until(judge, timeout)
    except Cancelled:
        ctx.device.send({"do": "rest"})
        raise
    if recovery and result.status is Status.SUCCESS:
        ctx.verdict(recovery, success())
    elif recovery and result.cause in ("unannounced_end", "no_line"):
        ctx.verdict(recovery, failure("not_the_track", result.text))
    if result.cause:
        await drive.rest()
    return result


def _found(ctx: Context, result: Result, judged: bool) -> Result:
    """Return the result of a recovery; if it is to be judged, a found line is provisional, and
    `run` is what following it judges."""
    if not judged or result.status is Status.ERROR:
        return result
    result = replace(result, values={**result.values, "run": ctx.run})
    return provisional(result) if result.status is Status.SUCCESS else result


async def _along(drive: _Drive, plan: paths.Points) -> Result:
    """Drive along a plan until the track is seen again and near, or the plan is finished."""
    await drive.ctx.command({"do": "plan", "points": plan})
    result = await drive.until(_recovered, drive.left())
    if not result.cause:
        return result
    await drive.rest()
    return result


def _recovered(state: Mapping[str, Any]) -> Result | None:
    """Return the result of recovering; None while it is in progress.

    SUCCESS when the driver has regained the track; FAILURE `no_track` when the plan is finished
    without it. Both set `recovered`.
    """
    if state["regained"]:
        return success(recovered=True)
    if state["standing"] and (state["ahead"] < 0.08 or state["reason"] == "no_line"):
        return failure(
            "no_track",
            "the expected path was driven to its end, and no track was seen",
            recovered=False,
        )
    return None


async def _go(drive: _Drive, to: Pose, rate: float) -> Result | None:
    """Go to a point by turning towards it and driving straight; return None on arrival, else the
    result of the run."""
    ctx = drive.ctx
    x, y, heading = ctx.device.state["pose"]
    away = math.hypot(to.x - x, to.y - y)
    if away < 0.08:
        return None
    towards = math.atan2(to.y - y, to.x - x)
    if abs(turned(towards - heading)) > 0.3:
        ended = await _turn(drive, towards, rate) or await _join(drive)
        if ended is not None:
            return ended
        x, y, _ = ctx.device.state["pose"]
        # The path leads off the line: what was seen of the line would pull the rover back.
        await ctx.command({"do": "forget"})
    await ctx.command({"do": "plan", "points": [(x, y), *paths.straight((x, y), (to.x, to.y))]})

    def judge(state: Mapping[str, Any]) -> Result | None:
        if state["regained"]:
            return success(recovered=True)
        if state["standing"] and (state["ahead"] < 0.08 or state["reason"] == "no_line"):
            return failure("arrived")
        return None

    ended = await drive.until(judge, min(20.0, drive.left()))
    return None if ended.cause == "arrived" else ended


async def _turn(drive: _Drive, heading: float, rate: float) -> Result | None:
    """Turn on the spot to a heading (rad, odometry frame), at most until the track is seen; return
    None when done."""
    ended = await drive.until(
        lambda state: success() if _turned(state) or state["sights"] > 1 else None,
        min(8.0, drive.left()),
        {"do": "turn", "to": heading, "rate": rate},
    )
    return ended if ended.cause else None


def _turned(state: Mapping[str, Any]) -> bool:
    return bool(state["reason"] == "arrived" and state["mode"] == "turn")


async def _look(drive: _Drive, heading: float, rate: float) -> Result | None:
    """Turn to a heading and look; drive to the track if it is there. Return None when it is not."""
    ctx = drive.ctx
    ended = await _turn(drive, heading, rate)
    if ended is not None:
        return ended
    await ctx.wait(lambda: ctx.device.state["sights"] > 0, LOOK)
    return await _join(drive)


async def _where_it_stands(drive: _Drive) -> Result | None:
    """Look without moving; drive to the track if it is there. Return None when it is not, or the
    rover still rolls."""
    ctx = drive.ctx
    if not ctx.device.state["standing"]:
        return None
    await ctx.wait(lambda: ctx.device.state["sights"] > 1, LOOK)
    return await _join(drive)


async def _join(drive: _Drive) -> Result | None:
    """Drive to where the track was seen to begin; return None if it was not seen, or is not there
    after all."""
    state = drive.ctx.device.state
    if not state["sights"]:
        return None
    way = paths.join(Pose(*state["pose"]), Pose(*state["entry"]), 0.0)
    await drive.ctx.command({"do": "plan", "points": way})
    result = await drive.until(_recovered, min(15.0, drive.left()))
    if result.cause != "no_track":
        return result
    await drive.again()
    return None


class _Drive:
    """Repeats the motion command as the driver requires, and judges each new state."""

    def __init__(self, ctx: Context, law: str, speed: float, timeout: float) -> None:
        self.ctx = ctx
        self._follow = {"do": "follow", "law": law, "speed": speed}
        self._until = ctx.now + timeout
        self._stretch: dict[str, Any] = {"do": "stretch"}

    def left(self) -> float:
        """Return the seconds that the run may still take."""
        return max(0.0, self._until - self.ctx.now)

    async def start(self, gates: Sequence[Pose], *, look: bool = True) -> None:
        """Begin a new stretch that leads through one of the gates."""
        self._stretch |= {"gates": [tuple(gate) for gate in gates], "look": look}
        await self.again()

    async def again(self) -> None:
        """Begin the stretch again: what was seen was not a part of it."""
        await self.ctx.command(self._stretch)

    async def rest(self) -> None:
        """Brake and stand."""
        await self.ctx.command({"do": "rest"})

    async def until(
        self, judge: Judge, timeout: float, body: Mapping[str, Any] | None = None
    ) -> Result:
        """Keep moving until `judge(state)` returns a result, the driver reports a fault, or
        `timeout` s have passed."""
        ctx, wanted = self.ctx, body or self._follow
        until, renewed = ctx.now + timeout, -math.inf
        while ctx.now <= until:
            if ctx.now - renewed >= RENEW:
                renewed = ctx.now
                if trouble := await command_drives(ctx, wanted, "wheel"):
                    return trouble
            state = ctx.device.state
            result = drive_fault(state, "wheel") or judge(state)
            if result is not None:
                return result
            seen = state["cycles"]
            await ctx.wait(
                lambda seen=seen: ctx.device.state["cycles"] != seen,  # type: ignore[misc]
                RENEW,
            )
        return error("timeout", f"not finished after {timeout:.1f} s")


def _geometry(
    ctx: Context, line_end: Sequence[float] | None
) -> tuple[Pose, tuple[Pose, Pose, Pose]]:
    """Return the line's end (where the rover is, if none was ever known) and where the track can
    resume."""
    state = ctx.device.state
    end = Pose(*map(float, state["pose"] if line_end is None else line_end))
    return end, paths.resume_poses(end, *state["element"])


def _marked(
    reflectors: Sequence[Sequence[float]], gates: Sequence[Pose]
) -> tuple[float, float] | None:
    """Return the reflector above one of the points where the track can resume: the one nearest to
    such a point that answered recently."""
    best: tuple[float, float, float] | None = None
    for x, y, _, age in reflectors:
        off = min(math.hypot(x - gate.x, y - gate.y) for gate in gates) + STALENESS * age
        if off < NEAR_GATE and (best is None or off < best[2]):
            best = (x, y, off)
    return None if best is None else (best[0], best[1])
