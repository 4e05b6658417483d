"""Primitive actions of a robot behind rosbridge; their device is a `bridge.Bridge`.

Their request has two parts: the constant part (`goal`, `request` or `message`, written as in ROS),
and `fields`, the paths at which the task's arguments are inserted. `values` selects the values of
the result, by name and path (default: all fields). A goal that succeeds with other values than
those of `expect` is a FAILURE, cause `unexpected`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

from petrobot import CommandRefused, Context, Remote, Result, Status, error, success
from petrobot.services.adapters.ros2.protocol import RUNNING, ExchangePhase, filled, pick
from petrobot.services.adapters.ros2.topics import fits

Paths = Mapping[str, str]
CONNECT, CANCEL = 5.0, 2.0
"""Limit of the wait for the connection, and of the wait for the answer to a cancel (s)."""


async def goal(
    ctx: Context[Remote],
    *,
    action: str,
    action_type: str,
    goal: Mapping[str, Any] | None = None,
    fields: Paths | None = None,
    timeout: float | None = None,
    values: Paths | None = None,
    expect: Mapping[str, Any] | None = None,
    remaining: str = "",
    to_memory: Paths | None = None,
    to_streams: Mapping[str, Sequence[str]] | None = None,
    **arguments: Any,
) -> Result:
    """Send a goal to the action server `action` and wait for its result.

    Of the feedback, `remaining` is the path of a number that falls to 0 (progress); `to_memory`
    names variables of the global memory, `to_streams` streams of set points, with the paths of
    their values; what a message does not have is left out.

    Causes of ERROR: `link_down`, `bad_goal`, `rejected` (nothing was executed); `aborted`,
    `cancelled` (by another client), `timeout`, `bad_result`; `link_lost`, `unanswered` (it is
    unknown what was executed).
    """
    try:
        args = _request(goal, fields, arguments)
    except ValueError as fault:
        return _not_executed("bad_goal", str(fault))
    asked = {"op": "send_action_goal", "action": action, "action_type": action_type, "args": args}
    feedback = _Feedback(ctx, remaining, to_memory or {}, to_streams or {})
    body = {"goal": {**asked, "feedback": True}}
    return await _exchange(ctx, body, timeout, values, expect or {}, feedback)


async def call(
    ctx: Context[Remote],
    *,
    service: str,
    service_type: str = "",
    request: Mapping[str, Any] | None = None,
    fields: Paths | None = None,
    timeout: float = 10.0,
    values: Paths | None = None,
    expect: Mapping[str, Any] | None = None,
    **arguments: Any,
) -> Result:
    """Call a service and return its response. Causes of ERROR: those of `goal`, and `failed`.
    `service_type` is only used to check the request against its definition."""
    try:
        args = _request(request, fields, arguments)
    except ValueError as fault:
        return _not_executed("bad_goal", str(fault))
    body = {"call": {"op": "call_service", "service": service, "args": args}, "type": service_type}
    return await _exchange(ctx, body, timeout, values, expect or {}, None)


async def wait_for(
    ctx: Context[Remote],
    *,
    topic: str,
    when: Mapping[str, Any] | None = None,
    timeout: float | None = None,
    newest: float | None = None,
    values: Paths | None = None,
) -> Result:
    """Wait for a message on a subscribed topic (its name in the device's table) with these values;
    a list of two numbers is a range. `newest`: greatest age of the message (s). ERROR `timeout`."""

    def found() -> bool:
        told = ctx.device.state["topics"][topic]
        fresh = told is not None and (newest is None or told["age"] <= newest)
        return fresh and fits(told["msg"], when or {})

    await ctx.wait(lambda: "topics" in ctx.device.state, CONNECT)
    if topic not in (known := ctx.device.state.get("topics", {})):
        return _not_executed("bad_goal", f"no topic {topic!r}; `subscribe` names {sorted(known)}")
    if not await ctx.wait(found, timeout):
        return error("timeout", f"no such message on {topic} within {timeout:g} s")
    return _ended(ctx.device.state["topics"][topic]["msg"], values, {})


async def publish(
    ctx: Context[Remote],
    *,
    topic: str,
    message_type: str,
    message: Mapping[str, Any] | None = None,
    fields: Paths | None = None,
    **arguments: Any,
) -> Result:
    """Publish one message."""
    try:
        msg = _request(message, fields, arguments)
    except ValueError as fault:
        return _not_executed("bad_goal", str(fault))
    refused = await _command(ctx, {"publish": {"topic": topic, "type": message_type, "msg": msg}})
    return refused or success()


async def drive(
    ctx: Context[Remote], *, streams: Sequence[str], seconds: float | None = None
) -> Result:
    """Forward the set points of these streams to their topics, for so long or until cancelled; then
    send the set point of rest."""
    if refused := await _command(ctx, {"drive": list(streams)}):
        return refused
    try:
        await ctx.wait(lambda: not ctx.device.state["connected"], seconds)
    finally:
        ctx.device.send({"drive": []})
    if not ctx.device.state["connected"]:
        return replace(error("link_lost", str(ctx.device.state["down"])), executed="unknown")
    return success()


# --- shipped examples -------------------------------------------------------------------------


async def navigate_to_pose(
    ctx: Context[Remote],
    *,
    x: float,
    y: float,
    yaw: float = 0.0,
    frame: str = "map",
    action: str = "/navigate_to_pose",
    **options: Any,
) -> Result:
    """Nav2: drive to a pose (m, rad). Options are those of `goal`."""
    turn = {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    pose = {"position": {"x": float(x), "y": float(y)}, "orientation": turn}
    args = {"pose": {"header": {"frame_id": frame}, "pose": pose}}
    options = {"remaining": "distance_remaining", **options}
    return await goal(
        ctx, action=action, action_type="nav2_msgs/action/NavigateToPose", goal=args, **options
    )


async def move_group(
    ctx: Context[Remote],
    *,
    joints: Mapping[str, float],
    group: str,
    tolerance: float = 0.01,
    speed: float = 0.1,
    seconds: float = 5.0,
    action: str = "/move_action",
    **options: Any,
) -> Result:
    """MoveIt: plan and move the joints (rad or m) of a group to these positions, at this share of
    their largest speeds, planning for at most `seconds`. Options are those of `goal`."""
    near = {"tolerance_above": tolerance, "tolerance_below": tolerance, "weight": 1.0}
    wanted = [{"joint_name": n, "position": float(p), **near} for n, p in joints.items()]
    request = {
        "group_name": group,
        "goal_constraints": [{"joint_constraints": wanted}],
        "num_planning_attempts": 1,
        "allowed_planning_time": seconds,
        "max_velocity_scaling_factor": speed,
        "max_acceleration_scaling_factor": speed,
    }
    code = {"code": "error_code.val"}
    options = {"values": code, "expect": {"error_code.val": 1}, **options}
    args = {"request": request}
    return await goal(
        ctx, action=action, action_type="moveit_msgs/action/MoveGroup", goal=args, **options
    )


async def follow_joint_trajectory(
    ctx: Context[Remote],
    *,
    joints: Sequence[str],
    positions: Sequence[Sequence[float]],
    times: Sequence[float],
    action: str,
    **options: Any,
) -> Result:
    """A trajectory controller of ros2_control: go through `positions` (rad or m, one list for each
    point) at `times` (s after the start). Options are those of `goal`."""
    if len(positions) != len(times) or any(len(point) != len(joints) for point in positions):
        return _not_executed(
            "bad_goal", "expected a time and a position of each joint for each point"
        )
    points = [
        {
            "positions": [float(p) for p in point],
            "time_from_start": {"sec": int(t), "nanosec": round((t - int(t)) * 1e9) % 10**9},
        }
        for point, t in zip(positions, times, strict=True)
    ]
    args = {"trajectory": {"joint_names": list(joints), "points": points}}
    options = {"expect": {"error_code": 0}, **options}
    name = "control_msgs/action/FollowJointTrajectory"
    return await goal(ctx, action=action, action_type=name, goal=args, **options)


# --- shared by the actions ----------------------------------------------------------------------


class _Feedback:
    """Passes on a goal's feedback: as progress, variables and set points."""

    def __init__(
        self, ctx: Context, remaining: str, memory: Paths, streams: Mapping[str, Sequence[str]]
    ) -> None:
        self.ctx, self.remaining, self.memory, self.streams = ctx, remaining, memory, streams
        self.whole = self.fraction = 0.0

    async def take(self, feedback: Mapping[str, Any]) -> None:
        """Pass on one feedback message. What is not in it, or is not a number, is left out: a goal
        does not end because a server reports in another form."""
        with suppress(ValueError, TypeError):
            left = float(pick(feedback, self.remaining))
            self.whole = max(self.whole, left)
            self.fraction = min(1.0, max(0.0, 1.0 - left / self.whole)) if self.whole > 0 else 0.0
        self.ctx.progress(self.fraction, feedback=feedback)
        for stream, paths in self.streams.items():
            with suppress(ValueError, TypeError):
                self.ctx.publish(stream, [float(pick(feedback, path)) for path in paths])
        for name, path in self.memory.items():
            with suppress(ValueError):
                await self.ctx.put(name, pick(feedback, path))


def _request(base: Any, fields: Paths | None, arguments: Mapping[str, Any]) -> dict[str, Any]:
    if unknown := set(arguments) - set(fields or {}):
        raise ValueError(f"no arguments {sorted(unknown)}; `fields` names {sorted(fields or {})}")
    return filled(base or {}, {(fields or {})[name]: value for name, value in arguments.items()})


def _not_executed(cause: str, text: str) -> Result:
    return replace(error(cause, text), executed="no")


async def _command(ctx: Context[Remote], body: Mapping[str, Any]) -> Result | None:
    """Send a command as soon as there is a connection. Return why that failed; None if it was
    sent."""
    if not await ctx.wait(lambda: ctx.device.state.get("connected", False), CONNECT):
        return _not_executed("link_down", str(ctx.device.state.get("down", "no state yet")))
    try:
        await ctx.command(body)
    except CommandRefused as refusal:
        if not ctx.device.refused:
            raise  # not accepted in time
        return _not_executed("bad_goal", str(refusal))
    return None


async def _exchange(
    ctx: Context[Remote],
    body: Mapping[str, Any],
    timeout: float | None,
    values: Paths | None,
    expect: Mapping[str, Any],
    feedback: _Feedback | None,
) -> Result:
    paths = [*values.values(), *expect] if values is not None else None
    keep = None if paths is None else sorted({path.split(".")[0] for path in paths})
    if refused := await _command(ctx, {**body, "run": ctx.run, "keep": keep}):
        return refused

    def told() -> Mapping[str, Any]:
        found: Mapping[str, Any] = ctx.device.state["exchanges"].get(ctx.run, {"phase": "gone"})
        return found

    def ended() -> bool:
        return ExchangePhase(told()["phase"]) not in RUNNING

    begun, seen = ctx.now, 0

    def news() -> bool:
        return ended() or told()["count"] != seen

    try:
        while not ended():
            left = None if timeout is None else begun + timeout - ctx.now
            if left is not None and left <= 0:
                break
            await ctx.wait(news, left)
            if feedback is not None and told().get("count", seen) != seen:
                seen = told()["count"]
                await feedback.take(told()["feedback"])
        late = not ended()
        if late:
            await ctx.command({"cancel": ctx.run})
            await ctx.wait(ended, CANCEL)
    except BaseException:  # Cancelled, or feedback that cannot be passed on: nothing moves on alone
        ctx.device.send({"cancel": ctx.run})
        raise
    finally:
        end = {**told(), "dry_run": ctx.device.state["dry_run"]}
        ctx.device.send({"forget": ctx.run})
    return _result(ExchangePhase(end["phase"]), end, late, values, expect, "call" in body, timeout)


def _result(
    phase: ExchangePhase,
    end: Mapping[str, Any],
    late: bool,
    values: Paths | None,
    expect: Mapping[str, Any],
    service: bool,
    timeout: float | None,
) -> Result:
    """Return the result of a run whose goal or call ended in a phase, or is `late`."""
    text, given = end.get("text", ""), end.get("values", {})
    if end.get("dry_run"):  # it succeeds as expected
        return Result(Status.SUCCESS, {n: expect.get(p) for n, p in (values or {}).items()})
    if phase is ExchangePhase.SUCCEEDED:
        if end["fault"]:
            return error("bad_result", end["fault"])
        return _ended(given, values, expect)
    if phase is ExchangePhase.REJECTED and not service:
        return _not_executed("rejected", text)
    if phase in (ExchangePhase.LOST, ExchangePhase.RECALLED, ExchangePhase.GONE):
        said = "the connection to rosbridge broke; nobody knows whether it was executed"
        return replace(error("link_lost", said), executed="unknown")
    if phase is ExchangePhase.UNANSWERED or phase in RUNNING:
        said = f"no result within {timeout or 0.0:g} s" if late else "it was given up"
        cause = "timeout" if late else "unanswered"
        said += "; its cancel was not answered: look at the robot"
        return replace(error(cause, said), executed="unknown")
    if late and phase is ExchangePhase.CANCELLED:
        return Result(Status.ERROR, given, "timeout", f"cancelled after {timeout:g} s")
    cause = "failed" if service else str(phase)
    text = text or ("another client cancelled the goal" if phase is ExchangePhase.CANCELLED else "")
    return Result(Status.ERROR, given, cause, text)


def _ended(given: Mapping[str, Any], values: Paths | None, expect: Mapping[str, Any]) -> Result:
    try:
        named = {n: pick(given, p) for n, p in values.items()} if values is not None else given
    except ValueError as fault:
        return error("bad_result", str(fault))
    if not fits(dict(given), expect):
        wrong = f"expected {dict(expect)}, found {str(dict(given))[:200]}"
        return Result(Status.FAILURE, named, "unexpected", wrong)
    return Result(Status.SUCCESS, named)
