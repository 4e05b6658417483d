"""The driver `Arm`: the PUMA's servo on its bus, in cycles of 4 ms.

Each cycle it reads the bus, moves the commanded trajectory on within the joint limits and the
guard's, and sends the drives their set points. Commands (plain data, key `do`):

    {"do": "move", "pose": NAME or six angles (rad), "speed": 0 to 1}   all joints arrive together
    {"do": "follow", "strategy": NAME, ...}    go where the stream's newest prediction can be
                                               caught; must be repeated within
                                               `LEASE` seconds, else the arm holds
    {"do": "hold"}      come to rest and stay there
    {"do": "reset"}     forget faults, configure and enable the drives again, hold
    {"do": "disable"}   come to rest, then take the power away: the brakes hold

No set point older than three of its periods is ever executed: the arm then brakes at its limits and
holds.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from operator import sub
from typing import Any, Final

import numpy as np

from petrobot.services.device import Ports, Setpoint
from petrobot.services.motion.arm_settings import Settings, drive_settings, numbers
from petrobot.services.motion.barrier import Barrier
from petrobot.services.motion.drive_master import DriveMaster, MasterPhase
from petrobot.services.motion.following import Follower
from petrobot.services.motion.interception import STRATEGIES, Interceptor, Strategy
from petrobot.services.motion.kinematics import Puma, branch_of
from petrobot.services.motion.limits import Guard
from petrobot.services.motion.model import JOINTS
from petrobot.services.motion.steering import Steering

PERIOD: Final = 0.004
"""s, the servo's and the bus's cycle."""
LEASE: Final = 0.5
"""s after which following ends in a hold if the action that asked for it has gone silent."""
SPEED_SHARE: Final = 0.97
"""Share of the drives' greatest speed that is commanded: the rest is theirs to catch up with."""
LEAST_SHARE: Final = 1e-3
"""Slower than this share of its speed no arm moves on purpose."""
IN_PLACE: Final = 0.003
"""rad by which the measured joints may differ from the pose that a move is said to have reached."""
NEAR_PLACE: Final = 0.02
"""rad, the same while following, where small corrections never end: 5 mm at the cup."""
LAG_CYCLES: Final = 8
"""Cycles by which the measured joints may follow the commanded ones: bus, links, interpolation,
sampling."""
LAG_PERIOD: Final = 5
"""Cycles after which the following error is worked out anew: 20 ms."""
LOST: Final = 0.15
"""rad of following error at which the servo itself gives up, besides the drives' own watch."""
BALL: Final = 0x01
POWER: Final = 0x02


class Arm:
    """Driver of the PUMA (see `services.device.Driver`)."""

    period: float | None = PERIOD

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        settings = Settings.parse(config)
        self._ports = ports
        self.model, cell = numbers(settings, ports)
        self._puma = Puma.of(self.model)
        self._guard = Guard(self._puma, self.model, cell)
        home = self.model.poses["home"]
        self._interceptor = Interceptor(
            self._puma, cell, self._guard, home, branch_of(self._puma, np.asarray(home))
        )
        self._full_speed = (self.model.speed * (settings.speed * SPEED_SHARE)).tolist()
        self._full_acceleration = self.model.acceleration.tolist()
        self._steering = Steering(
            self._guard, self._interceptor.retreat, home, PERIOD, self.model.acceleration
        )
        self._trajectory = self._steering.trajectory
        self._master = DriveMaster(drive_settings(self.model), PERIOD, enable=settings.enable)
        self._setpoint: Setpoint = ports.stream(settings.stream)
        self._bus = ports.can()
        self._follower = Follower(settings.stream_period)
        self._ball = Barrier()
        self._mode = "off"
        self._reason = ""
        self._paused = False
        self._leased_until = 0.0
        self._after_stop = ""
        self._commanded: deque[Sequence[float]] = deque(maxlen=LAG_CYCLES + 1)
        self._off_path = 0.0
        self._measured = [0.0] * JOINTS
        self._measured_speed = [0.0] * JOINTS
        self._cycles = 0
        self._now = ports.now
        self._drive_speeds = self._master.speeds
        self._commands: dict[str, Callable[[float, Mapping[str, Any]], None]] = {
            "move": self._move,
            "follow": self._follow,
            "hold": lambda now, body: self._rest("held"),
            "reset": self._reset,
            "disable": self._disable,
        }

    # Driver contract.
    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Take a command; raises ValueError for one that is unknown, malformed, or cannot be obeyed
        now."""
        act = self._commands.get(str(body.get("do")))
        if act is None:
            raise ValueError(
                f"unknown command {body.get('do')!r}: know {', '.join(self._commands)}"
            )
        act(now, body)

    def step(self, now: float) -> None:
        """One cycle."""
        self._cycles += 1
        self._now = now
        try:
            frames = self._bus.receive()
        except ConnectionError as reason:
            self._master.bus_lost(now, str(reason))
            frames = ()
        receive = self._master.receive
        for frame in frames:
            receive(now, frame)
        self._measure()
        self._sense(now)
        self._drive(now)
        targets = self._trajectory.q if self._mode != "off" else self._master.positions
        try:
            for frame in self._master.advance(now, targets):
                self._bus.send(frame)
        except ConnectionError as reason:
            self._master.bus_lost(now, str(reason))

    def state(self) -> Mapping[str, Any]:
        """What actions, operator and report see; see `docs/motion.md` for the keys."""
        master, trajectory, follower = self._master, self._trajectory, self._follower
        return {
            "enabled": self._mode != "off",
            "phase": master.phase.value,
            "mode": self._mode,
            "reason": self._reason,
            "paused": self._paused,
            "q": tuple(self._measured),
            "qd": tuple(self._measured_speed),
            "target": self._steering.goal,
            "commanded": tuple(trajectory.q),
            "in_place": self._in_place(),
            "still": self._standing(),
            "following_error": self._off_path if self._mode != "off" else 0.0,
            "guard": self._steering.refused,
            "limited": master.limited,
            "faults": [
                (trouble.cause, trouble.axis, trouble.code, trouble.text)
                for trouble in master.troubles
            ],
            "power": None if master.inputs is None else bool(master.inputs & POWER),
            "ball_in_cup": self._ball.present,
            "barrier": self._ball.interrupted,
            "setpoint_age": follower.age,
            "setpoint_count": follower.count,
            "setpoints_refused": follower.refused,
            "oldest_executed": follower.oldest,
            "stale_executed": follower.stale,
            "plan": follower.published(self._now),
            "cycles": self._cycles,
        }

    def stop(self, now: float) -> None:
        """Decelerate at the limits, then hold."""
        self._rest("stopped")

    def quick_stop(self, now: float) -> None:
        """Emergency stop: the drives stop quickly with the next cycle; then their power goes and
        the brakes hold."""
        self._master.give_up("emergency stop", "emergency_stop", 0)

    def stopped(self) -> bool:
        """Whether the arm stands still, held by its drives or its brakes."""
        if self._mode == "off":
            return (
                self._master.phase is not MasterPhase.RUNNING
                or max(map(abs, self._measured_speed)) < _STANDING
            )
        return self._trajectory.still and self._standing()

    def hold(self, now: float) -> str:
        """Operator's pause: brake, and go on with the same after `release`."""
        self._paused = True
        return "held"

    def release(self, now: float) -> None:
        """End of the pause."""
        self._paused = False
        self._leased_until = max(self._leased_until, now + LEASE)

    def close(self) -> None:
        """Leave the bus; the drives stop by themselves when SYNC and heartbeat cease."""
        self._bus.close()

    # Commands.
    def _move(self, now: float, body: Mapping[str, Any]) -> None:
        self._ready("move")
        target, share = self._pose(body.get("pose")), _share(body.get("speed", 1.0))
        self._steering.move(target, share)
        self._mode, self._reason = "move", ""

    def _follow(self, now: float, body: Mapping[str, Any]) -> None:
        self._ready("follow")
        strategy = _strategy(body, self._follower.strategy)
        if self._mode != "follow":
            self._steering.rest()
            self._follower.begin(self._setpoint.count)
            self._ball.arm()
        self._follower.strategy = strategy
        self._leased_until = now + LEASE
        self._mode, self._reason = "follow", self._reason if self._mode == "follow" else ""

    def _reset(self, now: float, body: Mapping[str, Any]) -> None:
        self._master.reset(now)
        self._off("resetting")

    def _disable(self, now: float, body: Mapping[str, Any]) -> None:
        self._rest("disabling")
        self._after_stop = "disable"

    def _ready(self, what: str) -> None:
        if self._mode == "off":
            troubles = (
                "; ".join(trouble.text for trouble in self._master.troubles)
                or self._master.phase.value
            )
            raise ValueError(f"cannot {what}: the drives are not enabled ({troubles})")

    def _pose(self, pose: Any) -> list[float]:
        if isinstance(pose, str):
            if pose not in self.model.poses:
                raise ValueError(f"unknown pose {pose!r}: know {', '.join(self.model.poses)}")
            return list(self.model.poses[pose])
        if (
            not isinstance(pose, Sequence)
            or len(pose) != JOINTS
            or not all(math.isfinite(angle) for angle in pose)
        ):
            raise ValueError(f"a pose is a name or {JOINTS} angles in rad, not {pose!r}")
        return [float(angle) for angle in pose]

    # The cycle.
    def _speeds(self) -> list[float]:
        """Joint speeds to command: the settings' or the drives' own, whichever is less (rad/s)."""
        drives = [SPEED_SHARE * speed or math.inf for speed in self._master.speeds]
        return [min(mine, theirs) for mine, theirs in zip(self._full_speed, drives, strict=True)]

    def _measure(self) -> None:
        before, self._measured = self._measured, self._master.positions
        self._measured_speed = [
            (new - old) / PERIOD for new, old in zip(self._measured, before, strict=True)
        ]

    def _sense(self, now: float) -> None:
        """The light barrier."""
        inputs = self._master.inputs
        if inputs is not None and self._ball.look(now, bool(inputs & BALL)):
            self._ports.raise_event("ball_caught")

    def _drive(self, now: float) -> None:
        """Move the commanded trajectory on by one cycle."""
        enabled = self._master.enabled
        if self._mode == "off":
            if enabled:
                self._steering.reset(self._measured)
                self._steering.limit(self._speeds())
                self._commanded.clear()
                self._mode, self._reason = "hold", "enabled"
            return
        if not enabled:
            self._off("fault" if self._master.troubles else "disabled")
            return
        if self._master.speeds != self._drive_speeds:
            self._drive_speeds = self._master.speeds
            self._steering.limit(self._speeds())
        moves = not (self._trajectory.still and self._standing())
        if moves and not self._master.limited and self._lost():
            self._master.give_up(f"the joints are more than {LOST} rad off the commanded path")
            return
        if self._mode == "follow":
            self._follow_on(now)
        self._advance()
        if self._cycles % LAG_PERIOD == 0:
            self._off_path = self._lag()
        if self._after_stop and self._trajectory.still:
            self._after_stop, self._master.wanted = "", False

    def _advance(self) -> None:
        self._commanded.append(self._trajectory.q)
        late = (
            self._ports.now
        )  # receiving and planning took time: what counts is the clock at the last moment
        if self._follows() and not self._follower.fresh(late):
            self._let_go()
        self._steering.cycle(self._paused)
        if self._follows():
            self._follower.executed(late)

    def _follows(self) -> bool:
        """Whether this cycle goes towards a set point."""
        return self._mode == "follow" and self._steering.goal is not None and not self._paused

    def _let_go(self) -> None:
        """The last set point is stale: come to rest, and take its values for new ones if they come
        again."""
        self._steering.rest()
        self._follower.drop()
        self._reason = "no_setpoint"

    def _follow_on(self, now: float) -> None:
        """Aim at the newest prediction, or hold where it is stale or the action silent."""
        follower, trajectory = self._follower, self._trajectory
        if now > self._leased_until and not self._paused:
            self._rest("silent_action")
            return
        if not follower.take(self._setpoint, now):
            if not follower.fresh(now):
                self._let_go()
            return
        plan = follower.plan_with(
            self._interceptor, trajectory, self._speeds(), self._full_acceleration, now
        )
        self._reason = "" if plan is not None else "unreachable"
        if plan is None:
            self._steering.rest()
        else:
            self._steering.chase(plan.q)

    def _rest(self, reason: str) -> None:
        """Come to rest and stay there."""
        if self._mode == "off":
            return
        self._steering.rest()
        self._mode, self._reason, self._after_stop = "hold", reason, ""

    def _off(self, reason: str) -> None:
        self._steering.reset(self._measured)
        self._mode, self._reason, self._after_stop = "off", reason, ""

    def _lag(self) -> float:
        """How far (rad) the measured joints are off the path commanded of late; how late they are
        on it does not count."""
        if self._mode == "off" or not self._commanded:
            return 0.0
        least, before, measured = math.inf, None, self._measured
        for q in self._commanded:
            if q is before:  # the same one cycle after cycle while the arm stands
                continue
            before, farthest = q, 0.0
            for a, b in zip(q, measured, strict=True):
                off = a - b if a > b else b - a
                if off > farthest:
                    farthest = off
                    if off >= least:  # most often by the first joint
                        break
            else:
                least = farthest
        return least

    def _lost(self) -> bool:
        """Whether the measured joints are too far off all of that path; most often the first look
        settles it."""
        return bool(self._commanded) and all(self._off_by(q) > LOST for q in self._commanded)

    def _in_place(self) -> bool:
        """Whether the measured joints are where they are wanted: at the end of a move, or at the
        newest plan's pose."""
        if self._mode == "follow":
            plan = self._follower.plan
            return plan is not None and self._off_by(plan.q) < NEAR_PLACE
        goal = self._steering.goal
        return (
            self._mode == "move"
            and goal is not None
            and self._steering.arrived
            and self._off_by(goal) < IN_PLACE
        )

    def _off_by(self, q: Sequence[float]) -> float:
        farthest: float = max(map(abs, map(sub, q, self._measured)))
        return farthest

    def _standing(self) -> bool:
        return max(map(abs, self._measured_speed)) < _STANDING


_STANDING: Final = 0.01
"""rad/s below which a joint counts as standing."""


def _share(value: Any) -> float:
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not LEAST_SHARE <= value <= 1.0
    ):
        raise ValueError(f"speed = {value!r}: must be at least {LEAST_SHARE:g} and at most 1")
    return float(value)


def _strategy(body: Mapping[str, Any], present: Strategy) -> Strategy:
    """The strategy that a command names, with its own values where it gives any; without a name the
    present one."""
    name = body.get("strategy")
    if name is not None and name not in STRATEGIES:
        raise ValueError(f"unknown strategy {name!r}: know {', '.join(STRATEGIES)}")
    strategy = present if name is None else STRATEGIES[name]
    changes: dict[str, Any] = {
        key: float(body[key]) for key in ("tilt", "preferred", "margin") if key in body
    }
    if "depths" in body:
        changes["depths"] = tuple(float(depth) for depth in body["depths"])
    return replace(strategy, **changes) if changes else strategy
