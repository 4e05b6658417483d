"""Primitive actions of the SO-101: move_joints, move_to, grasp, release, enable, calibrate.

Error causes: `unreachable`, `late`, `command_refused`, and the faults of the driver: `missing`,
`mode`, `range`, `twice`, `heat`, `overload`, `voltage`, `current`, `sensor`, `power`, `workspace`,
`uncalibrated`.
`grasp` fails with `empty`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from petrobot import Context, Remote, Result, error, failure, perform, success
from petrobot.services.adapters.so101.arm import CHAIN, inverse

State = Mapping[str, Any]
STARTING = 1.0
"""Time in which the driver must find the servos and switch them on (s)."""


async def move_joints(
    ctx: Context[Remote], *, joints: Sequence[float], speed: float = 1.0, timeout: float = 10.0
) -> Result:
    """Move the five joints to these angles (rad), with this share of the arm's speed."""
    command = {"do": "move", "joints": list(joints), "speed": speed}
    return await _do(ctx, command, lambda state: state["at_goal"], timeout)


async def move_to(
    ctx: Context[Remote],
    *,
    x: float,
    y: float,
    z: float,
    pitch: float = -math.pi / 2,
    roll: float = 0.0,
    speed: float = 1.0,
    timeout: float = 10.0,
) -> Result:
    """Move the gripper's tip to a point (m, frame of `CHAIN`). `pitch` is the gripper's angle
    above the horizontal, `roll` the angle of its last joint (rad). The joints arrive together; the
    tip does not move on a straight line."""
    try:
        joints = inverse(x, y, z, pitch, roll)
    except ValueError as fault:
        return error("unreachable", str(fault))
    result = await move_joints(ctx, joints=joints, speed=speed, timeout=timeout)
    tip = CHAIN.point(ctx.device.state["q"])
    return result if result.cause else success(off=math.dist(tip, (x, y, z)))


async def grasp(
    ctx: Context[Remote], *, squeeze: float = 0.25, thinnest: float = 0.02, timeout: float = 4.0
) -> Result:
    """Close the gripper until it holds something with this share of its stall torque; the result
    `angle` (rad) is its final opening. FAILURE `empty` if it closed to less than `thinnest` rad."""
    ends = ("holding", "closed")
    command = {"do": "close", "squeeze": squeeze}
    result = await _do(ctx, command, lambda state: any(state["gripper"][e] for e in ends), timeout)
    gripper = ctx.device.state["gripper"]
    if not result.cause and (gripper["angle"] < thinnest or not gripper["holding"]):
        return failure("empty", "the gripper closed on nothing", angle=gripper["angle"])
    return result if result.cause else success(angle=gripper["angle"])


async def release(ctx: Context[Remote], *, angle: float = 1.0, timeout: float = 4.0) -> Result:
    """Open the gripper to an angle (rad)."""
    command = {"do": "open", "angle": angle}
    return await _do(ctx, command, lambda state: state["gripper"]["open"], timeout)


async def enable(ctx: Context[Remote]) -> Result:
    """Clear faults and switch torque on where the arm is. A servo that has torque keeps its goal if
    that is at most 0.3 rad away, so that it still carries its load."""
    return await _do(ctx, {"do": "enable"}, lambda state: state["ready"], 2.0)


async def calibrate(ctx: Context[Remote], *, pose: Sequence[float] = (0.0,) * 6) -> Result:
    """Declare that the arm, held by hand, is in this pose (six angles, rad); its zero positions are
    written to the device's calibration file."""
    await ctx.command({"do": "calibrate", "pose": list(pose)}, timeout=5.0)
    return success()


async def _do(
    ctx: Context[Remote], command: State, done: Callable[[State], bool], timeout: float
) -> Result:
    device = ctx.device
    await ctx.wait(lambda: bool(device.state["ready"] or device.state["faults"]), STARTING)
    return await perform(ctx, command, done, timeout)
