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
from petrobot.services.adapters.ros2.bridge import RUNNING, ExchangePhase
from petrobot.services.adapters.ros2.messages import Message, fits, pick

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
    asked = {"op": "send_action_goal", "action": action, "action_type": action_type}
    request = {**asked, "feedback": True, "args": goal or {}}
    feedback = _Feedback(ctx, remaining, to_memory or {}, to_streams or {})
    body = {"goal": request, "fields": fields, "given": arguments}
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
    asked = {"op": "call_service", "service": service, "args": request or {}}
    body = {"call": asked, "type": service_type, "fields": fields, "given": arguments}
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
    return _picked(ctx.device.state["topics"][topic]["msg"], values, {})


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
    body = {"topic": topic, "type": message_type, "msg": message or {}}
    return await _command(ctx, {"publish": body, "fields": fields, "given": arguments}) or success()


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
    **options: Any,
) -> Result:
    """Nav2: drive to a pose (m, rad). Options are those of `goal`."""
    turn = {"z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}
    pose = {"position": {"x": float(x), "y": float(y)}, "orientation": turn}
    defaults = {
        "action": "/navigate_to_pose",
        "action_type": "nav2_msgs/action/NavigateToPose",
        "goal": {"pose": {"header": {"frame_id": frame}, "pose": pose}},
        "remaining": "distance_remaining",
    }
    return await goal(ctx, **{**defaults, **options})


async def move_group(
    ctx: Context[Remote],
    *,
    joints: Mapping[str, float],
    group: str,
    tolerance: float = 0.01,
    speed: float = 0.1,
    seconds: float = 5.0,
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
    defaults = {
        "action": "/move_action",
        "action_type": "moveit_msgs/action/MoveGroup",
        "goal": {"request": request},
        "values": {"code": "error_code.val"},
        "expect": {"error_code.val": 1},
    }
    return await goal(ctx, **{**defaults, **options})


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
        wrong = "expected a time and a position of each joint for each point"
        return _not_executed("bad_goal", wrong)
    points = [
        {
            "positions": [float(p) for p in point],
            "time_from_start": {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9},
        }
        # thirty steps of 0.1 s are 2.9999999999999996 s
        for point, nanoseconds in zip(positions, (round(t * 1e9) for t in times), strict=True)
    ]
    defaults = {
        "action_type": "control_msgs/action/FollowJointTrajectory",
        "goal": {"trajectory": {"joint_names": list(joints), "points": points}},
        "expect": {"error_code": 0},
    }
    return await goal(ctx, action=action, **{**defaults, **options})


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
    """Send a goal or a call, pass on its feedback, cancel it after `timeout` and when the run is
    cancelled, and return its result."""
    paths = None if values is None else [*values.values(), *expect]
    keep = None if paths is None else sorted({path.split(".")[0] for path in paths})
    if refused := await _command(ctx, {**body, "run": ctx.run, "keep": keep}):
        return refused
    if ctx.device.state["dry_run"]:  # nothing was sent; it succeeds as expected
        return Result(Status.SUCCESS, {n: expect.get(p) for n, p in (values or {}).items()})
    begun, seen = ctx.now, 0

    def told() -> Message:
        none = {"phase": ExchangePhase.LOST, "count": 0}
        return dict(ctx.device.state["exchanges"].get(ctx.run, none))

    def ended() -> bool:
        return told()["phase"] not in RUNNING

    def news() -> bool:
        return ended() or told()["count"] != seen

    try:
        while not ended() and (timeout is None or ctx.now < begun + timeout):
            await ctx.wait(news, None if timeout is None else begun + timeout - ctx.now)
            if feedback is not None and told()["count"] != seen:
                seen = told()["count"]
                await feedback.take(told()["feedback"])
        late = not ended()
        if late:
            await ctx.command({"cancel": ctx.run})
            await ctx.wait(ended, CANCEL)
        end = told()
    except BaseException:  # Cancelled, or feedback that cannot be passed on: nothing moves on alone
        ctx.device.send({"cancel": ctx.run})
        raise
    finally:
        ctx.device.send({"forget": ctx.run})
    if end["phase"] == ExchangePhase.SUCCEEDED:
        fault = end["fault"]
        return error("bad_result", fault) if fault else _picked(end["values"], values, expect)
    return _failed(end, f"{timeout or 0.0:g} s" if late else "", "call" in body)


def _picked(given: Message, values: Paths | None, expect: Mapping[str, Any]) -> Result:
    """Return the result of a run whose goal or call has succeeded with these values."""
    try:
        named = given if values is None else {n: pick(given, p) for n, p in values.items()}
    except ValueError as fault:
        return error("bad_result", str(fault))
    if not fits(given, expect):
        wrong = f"expected {dict(expect)}, found {given!s:.200}"
        return Result(Status.FAILURE, named, "unexpected", wrong)
    return Result(Status.SUCCESS, named)


def _failed(end: Message, late: str, service: bool) -> Result:
    """Return the result of a run whose goal or call did not succeed; `late`: within which time."""
    phase, text = end["phase"], end.get("text", "")
    if phase == ExchangePhase.REJECTED and not service:
        return _not_executed("rejected", text)
    if phase == ExchangePhase.LOST:
        said = "the connection to rosbridge broke" + (f" ({text})" if text else "")
        said += "; nobody knows whether it was executed"
        return replace(error("link_lost", said), executed="unknown")
    if phase == ExchangePhase.UNANSWERED or phase in RUNNING:
        said = f"no result within {late}" if late else "it was given up"
        said += "; its cancel was not answered: look at the robot"
        return replace(error("timeout" if late else "unanswered", said), executed="unknown")
    cause = "failed" if service else str(phase)
    if phase == ExchangePhase.CANCELLED:
        text = text or "another client cancelled the goal"
        if late:
            cause, text = "timeout", f"cancelled after {late}"
    return Result(Status.ERROR, end["values"], cause, text)
