"""Driver of the PUMA: class `Arm`, which controls the arm over its CAN bus in cycles of 4 ms.

In each cycle it reads the bus, advances the commanded trajectory within the joint limits and the
limits of the collision guard, and sends set points to the drives. Commands are plain data; the key
`do` names them:

    {"do": "move", "pose": NAME or six angles (rad), "speed": 0 to 1}   all joints arrive together
    {"do": "follow", "strategy": NAME, ...}    go to where the newest prediction of the stream can
                                               be caught; must be repeated within `LEASE`
                                               seconds, else the arm holds
    {"do": "hold"}      come to rest and stay there
    {"do": "reset"}     clear faults, configure and enable the drives again, then hold
    {"do": "disable"}   come to rest, then switch the power off: the brakes hold the arm

The driver never executes a set point that is older than three periods of its stream: the arm then
brakes at its limits and holds.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from operator import sub
from typing import Any, Final

import numpy as np
from msgspec.structs import replace

from petrobot.services.comm.canopen.master import MasterPhase
from petrobot.services.device import LIMITS, Driver, Ports, Setpoint, key
from petrobot.services.motion.drive_master import DriveMaster, DriveSettings
from petrobot.services.motion.interception import STRATEGIES, Follower, Interceptor, Strategy
from petrobot.services.motion.kinematics import Puma, branch_of
from petrobot.services.motion.limits import CollisionGuard
from petrobot.services.motion.model import (
    JOINTS,
    nominal_arm,
    nominal_cell,
    read_arm,
    read_cell,
)
from petrobot.services.motion.steering import Steering

# --- The light barrier in the cup ----------------------------------------------------------------

BALL_SETTLE: Final = 0.06
"""Seconds for which the beam must stay interrupted. A ball that only bounces through does not
count."""


class CupBarrier:
    """Decide from the light barrier whether a ball has been caught.

    A ball counts once the beam has been interrupted for `BALL_SETTLE`. It is reported once, and
    only if `arm` was called and the cup has been empty since.
    """

    def __init__(self) -> None:
        self.interrupted = False
        self.present = False
        self._since = 0.0
        self._wanted = False
        self._armed = False

    def arm(self) -> None:
        """Report the next ball that comes into the empty cup."""
        self._wanted, self._armed = True, False

    def look(self, now: float, interrupted: bool) -> bool:
        """Process the state of the beam; return True in the one cycle in which an awaited ball
        counts."""
        if not interrupted:
            self.interrupted = self.present = False
            self._armed = self._armed or self._wanted
            self._wanted = False
            return False
        if not self.interrupted:
            self.interrupted, self._since = True, now
        self.present = now - self._since >= BALL_SETTLE - 1e-9
        told = self.present and self._armed
        self._armed = self._armed and not told
        return told


# --- The driver ----------------------------------------------------------------------------------

PERIOD: Final = 0.004
"""Seconds per cycle of driver and bus."""
LEASE: Final = 0.5
"""Seconds after which following ends in a hold unless the action has repeated its command."""
SPEED_SHARE: Final = 0.97
"""Share of the drives' greatest speed that is commanded. The drives need the rest to catch up."""
LEAST_SHARE: Final = 1e-3
"""Smallest share of its speed at which the arm accepts a move."""
IN_PLACE: Final = 0.003
"""Rad by which the measured joints may differ from the goal of a move that counts as reached."""
NEAR_PLACE: Final = 0.02
"""The same while following, where small corrections never end (rad); 5 mm at the cup."""
LAG_CYCLES: Final = 8
"""Cycles by which the measured joints may lag behind the commanded ones: bus, links, interpolation
and sampling each add some."""
LAG_PERIOD: Final = 5
"""Cycles between two computations of the following error: 20 ms."""
LOST: Final = 0.15
"""Rad of following error at which the driver stops the arm, in addition to each drive's own
check."""
BALL: Final = 0x01
POWER: Final = 0x02


class Arm(Driver):
    """Driver of the PUMA (see `services.device.Driver`). Its workspace bounds the centre of the
    cup's mouth in the arm's base frame."""

    period: float | None = PERIOD
    obeys = (*LIMITS, "pause")
    stream: str = key("catch_point", "stream of catch points")
    stream_period: float = key(0.02, "s", above=0)
    enable: bool = key(True, "enable the drives at the start")
    model: str = key("", "file of the arm, instead of the shipped one")
    cell: str = key("", "file of the cell, instead of the shipped one")

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        model = read_arm(ports.file(self.model).decode()) if self.model else nominal_arm()
        cell = read_cell(ports.file(self.cell).decode()) if self.cell else nominal_cell()
        self._poses = model.poses
        self._puma = Puma.of(model)
        self._guard = CollisionGuard(self._puma, model, cell, workspace=self.workspace)
        home = model.poses["home"]
        self._interceptor = Interceptor(
            self._puma, cell, self._guard, home, branch_of(self._puma, np.asarray(home))
        )
        self._full_speed = (model.speed * (self.speed * SPEED_SHARE)).tolist()
        self._full_acceleration = model.acceleration.tolist()
        self._steering = Steering(
            self._guard, self._interceptor.retreat, home, PERIOD, model.acceleration
        )
        self._trajectory = self._steering.trajectory
        limits = model.lower.tolist(), model.upper.tolist(), self._full_acceleration
        drives = [DriveSettings(*each) for each in zip(*limits, strict=True)]
        self._master = DriveMaster(drives, PERIOD, enable=self.enable, dry_run=self.dry_run)
        self._setpoint: Setpoint = ports.stream(self.stream)
        self._bus = ports.can()
        self._follower = Follower(self.stream_period)
        self._ball = CupBarrier()
        self._mode = "off"
        self._reason = ""
        self._leased_until = 0.0
        self._after_stop = ""
        self._commanded: deque[tuple[float, ...]] = deque(maxlen=LAG_CYCLES + 1)
        self._off_path = 0.0
        self._measured = [0.0] * JOINTS
        self._measured_speed = [0.0] * JOINTS
        self._stands = True
        """Whether all joints count as standing."""
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

    # What the node calls (`services.device.Driver`).
    def command(self, now: float, body: Mapping[str, Any]) -> None:
        act = self._commands.get(str(body.get("do")))
        if act is None:
            raise ValueError(
                f"unknown command {body.get('do')!r}: know {', '.join(self._commands)}"
            )
        act(now, body)

    def step(self, now: float) -> None:
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
        """Return what actions, operator and report see; docs/motion.md explains the keys."""
        master, trajectory, follower = self._master, self._trajectory, self._follower
        return {
            "enabled": self._mode != "off",
            "phase": master.phase.value,
            "mode": self._mode,
            "reason": self._reason,
            "paused": self.paused,
            "q": tuple(self._measured),
            "qd": tuple(self._measured_speed),
            "target": self._steering.goal,
            "commanded": tuple(trajectory.q),
            "in_place": self._in_place(),
            "still": self._stands,
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
        """Stop in an emergency: the drives quick-stop in the next cycle, then lose their power, and
        the brakes hold."""
        self._master.give_up("emergency stop", "emergency_stop", 0)

    def stopped(self) -> bool:
        """Return whether the arm stands still, held by its drives or its brakes."""
        if self._master.blind:
            return False
        if self._mode == "off":
            return self._master.phase is not MasterPhase.RUNNING or self._stands
        return self._stands and self._trajectory.still

    def release(self, now: float) -> None:
        """End the operator's pause: the same motion continues."""
        super().release(now)
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
            if pose not in self._poses:
                raise ValueError(f"unknown pose {pose!r}: know {', '.join(self._poses)}")
            return list(self._poses[pose])
        if (
            not isinstance(pose, Sequence)
            or len(pose) != JOINTS
            or not all(math.isfinite(angle) for angle in pose)
        ):
            raise ValueError(
                f"move: pose: expected a name or {JOINTS} finite angles in rad, got {pose!r}"
            )
        return [float(angle) for angle in pose]

    # The cycle.
    def _speeds(self) -> list[float]:
        """Return the joint speeds to command: those of the settings or of the drives, whichever are
        less (rad/s)."""
        drives = [SPEED_SHARE * speed or math.inf for speed in self._master.speeds]
        return [min(mine, theirs) for mine, theirs in zip(self._full_speed, drives, strict=True)]

    def _measure(self) -> None:
        pretends = self.dry_run and self._mode != "off"
        commanded = list(self._trajectory.q) if pretends else self._master.positions
        before, self._measured = self._measured, commanded
        self._measured_speed = [
            (new - old) / PERIOD for new, old in zip(self._measured, before, strict=True)
        ]
        self._stands = max(map(abs, self._measured_speed)) < _STANDING

    def _sense(self, now: float) -> None:
        """Read the light barrier."""
        inputs = self._master.inputs
        if inputs is not None and self._ball.look(now, bool(inputs & BALL)):
            self.ports.raise_event("ball_caught")

    def _drive(self, now: float) -> None:
        """Advance the commanded trajectory by one cycle."""
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
        if (speeds := self._master.speeds) != self._drive_speeds:
            self._drive_speeds = speeds
            self._steering.limit(self._speeds())
        moves = not (self._stands and self._trajectory.still)
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
        # Receiving and planning took time. A set point must be fresh at the moment at which it is
        # executed, so read the clock again.
        late = self.ports.now
        if self._follows() and not self._follower.fresh(late):
            self._let_go()
        self._steering.cycle(self.paused)
        if self._follows():
            self._follower.executed(late)

    def _follows(self) -> bool:
        """Return whether this cycle moves towards a set point."""
        return self._mode == "follow" and self._steering.goal is not None and not self.paused

    def _let_go(self) -> None:
        """Come to rest because the last set point is stale; count its values as new if they arrive
        again."""
        self._steering.rest()
        self._follower.drop()
        self._reason = "no_setpoint"

    def _follow_on(self, now: float) -> None:
        """Aim at the newest prediction; hold if it is stale or the action has stopped repeating its
        command."""
        follower, trajectory = self._follower, self._trajectory
        if now > self._leased_until and not self.paused:
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
        """Return how far the measured joints are from the recently commanded path (rad).

        Lateness on the path does not count: the distance to the nearest commanded pose of the last
        `LAG_CYCLES` cycles is taken.
        """
        if self._mode == "off" or not self._commanded:
            return 0.0
        # A set, since an arm that stands is commanded to the same pose again and again.
        return min(map(self._off_by, set(self._commanded)))

    def _lost(self) -> bool:
        """Return whether the measured joints are too far from every pose of that path; usually the
        first comparison decides."""
        return bool(self._commanded) and all(self._off_by(q) > LOST for q in self._commanded)

    def _in_place(self) -> bool:
        """Return whether the measured joints are at the end of a move, or at the pose of the newest
        plan."""
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


_STANDING: Final = 0.01
"""Speed below which a joint counts as standing (rad/s)."""


def _share(value: Any) -> float:
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not LEAST_SHARE <= value <= 1.0
    ):
        raise ValueError(f"move: speed: expected a number from {LEAST_SHARE:g} to 1, got {value!r}")
    return float(value)


def _strategy(body: Mapping[str, Any], present: Strategy) -> Strategy:
    """Return the strategy that a command names, changed by the values that it gives; the present
    strategy if it names none."""
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
