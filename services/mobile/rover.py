"""Driver of the rover: every 20 ms it reads wheels and sensor, takes the newest sight of the track,
and sets two wheel speeds.

It follows its map of the track, whether the points in it were seen or are only planned; it turns on
the spot; it rests. It never drives beyond the map, and it rests when the stream is stale or the
action that wanted the motion stops repeating its command.

Commands: {"do": "follow", "law", "speed"} (repeat it within `LEASE` s), {"do": "plan", "points"},
{"do": "turn", "to", "rate"} (also repeated), {"do": "stretch"} (a new stretch begins), {"do":
"forget"}, {"do": "rest"}, {"do": "reset"}, {"do": "disable"}.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from petrobot.services.device import LIMITS, Driver, Ports, Setpoint
from petrobot.services.mobile.following import LAWS, PurePursuit, SpeedProfile, capped
from petrobot.services.mobile.model import RoverModel as Numbers, nominal_rover, read_rover
from petrobot.services.mobile.odometry import Odometry, Pose as Pose, turned
from petrobot.services.mobile.reflectors import ReflectorMap, parse_echoes
from petrobot.services.mobile.sight import TrackAhead, TrackEnd as TrackEnd
from petrobot.services.mobile.track_map import Fit, TrackMap
from petrobot.services.mobile.wheel_drives import MasterPhase as MasterPhase, WheelMaster

LEASE: Final = 0.4
"""Seconds after which a motion ends unless its command is repeated."""
STANDING: Final = 0.004
"""Speed below which the rover counts as standing (m/s)."""
STREAM: Final = "track_ahead"
JOINING: Final = PurePursuit(0.6)
"""Law towards a line that is known ahead, but not yet at the axle."""
AT_END: Final = 0.04
"""Distance before the end of all that is known at which the line is finished (m)."""
TURN_GAIN: Final = 3.0
"""1/s: turning speed per radian that is left."""
TURNED: Final = 0.02
"""Angle within which a turn has arrived (rad)."""
END_REACH: Final = 0.45
"""Length of line from which its direction at its end is computed (m)."""
REGAINED_SIGHTS: Final = 4
"""Sights of a new stretch after which it can be followed."""
REGAINED_AHEAD: Final = (0.2, 0.62)
"""m ahead of the axle at which that stretch must begin; not behind, since the rover may have
turned."""
REGAINED_ASIDE: Final = 0.25
"""Greatest distance to the side (m)."""
REGAINED_TURN: Final = 0.6
"""Greatest angle to the line (rad)."""
EDGE: Final = 0.02
"""Distance from the edge of its workspace at which the rover stands (m)."""
DRIVES_SHARE: Final = 0.95
"""Share of the wheels' top speed that set points use; the rest is for the lead over their lag."""


class Rover(Driver):
    """Driver of the rover (see `services.device.Driver`). Its keys in services.toml, all optional
    except those of its bus:

    `rover`: file of numbers beside services.toml (default: the shipped one). Its workspace bounds
    the middle of its axle in the odometry frame: where that stood when the driver was made.
    """

    obeys = (*LIMITS, "pause")

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        self.limit(config)
        name = str(config.get("rover", ""))
        self.numbers: Numbers = (
            read_rover(ports.file(name).decode(), name) if name else nominal_rover()
        )
        wheels, bus = self.numbers.wheels, self.numbers.bus
        self.period = bus.period
        self._bus = ports.can()
        self._setpoint: Setpoint = ports.stream(STREAM)
        self._master = WheelMaster(
            round(bus.left),
            round(bus.right),
            round(bus.sensor),
            bus.period,
            wheels.quick_stop,
            self.dry_run,
        )
        self._odometry = Odometry(wheels.track_width)
        self._map = TrackMap()
        self._reflectors = ReflectorMap(self.numbers.sensor, self.numbers.track.reflector_height)
        self._profile = SpeedProfile()
        self._mode, self._reason = "off", ""
        self._leased_until = 0.0
        self._law, self._asked, self._heading, self._rate = "feed_forward", 0.0, 0.0, 1.0
        self._speed = self._turning = self._measured = 0.0
        self._set = (0.0, 0.0)
        self._taken = 0
        self._cycles = 0
        self._now = ports.now
        self._fits: dict[float, Fit | None] = {}
        self._commands: dict[str, Callable[[float, Mapping[str, Any]], None]] = {
            "follow": self._follow,
            "turn": self._turn,
            "plan": lambda now, body: self._plan(body),
            "stretch": lambda now, body: self._stretch(body),
            "forget": lambda now, body: self._forget(body),
            "rest": lambda now, body: self._rest("asked"),
            "reset": lambda now, body: self._master.reset(now),
            "disable": lambda now, body: self._disable(),
        }

    # Driver contract

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
        self._fits.clear()
        self._listen(now)
        self._measure(now)
        self._look(now)
        if self._found_again():
            self._map.settle()
        speeds = self._drive(now)
        try:
            for frame in self._master.advance(now, speeds):
                self._bus.send(frame)
        except ConnectionError as reason:
            self._master.bus_lost(now, str(reason))

    def state(self) -> Mapping[str, Any]:
        """Return what actions, operator and report see; docs/mobile.md explains the keys."""
        pose, end = self._odometry.pose, self._map.end
        fit = self._fit(0.0)
        return {
            "enabled": self._master.enabled,
            "phase": self._master.phase.value,
            "mode": self._mode,
            "reason": self._reason,
            "pose": tuple(pose),
            "way": self._odometry.way,
            "speed": self._measured,
            "standing": self._standing(),
            "ahead": self._map.ahead(pose),
            "end": None if end is None else int(end[0]),
            "line_end": self._line_end(),
            "regained": self._map.regained,
            "on_line": fit is not None,
            "offset": 0.0 if fit is None else fit.y,
            "heading": 0.0 if fit is None else fit.heading,
            "entry": None if self._map.entry is None else tuple(self._map.entry),
            "sights": self._map.sights,
            "refused": self._map.refused,
            "stream_age": self._setpoint.age,
            "reflectors": self._reflectors.believed(self._now),
            "element": (self.numbers.track.square, self.numbers.track.radius),
            "sensor": self._master.sensor_alive,
            "limited": self._master.limited,
            "faults": [
                (t.cause, self._master.wheel(t), t.code, t.text) for t in self._master.troubles
            ],
            "cycles": self._cycles,
        }

    def stop(self, now: float) -> None:
        """Brake, and stand."""
        self._rest("stopped")

    def stopped(self) -> bool:
        """Return whether the rover stands, held by its drives or by its brakes."""
        still = self._standing() and not self._master.blind
        return still and self._mode in ("off", "rest")

    def release(self, now: float) -> None:
        """End the operator's pause: the same motion continues."""
        super().release(now)
        self._leased_until = max(self._leased_until, now + LEASE)

    def close(self) -> None:
        """Leave the bus; the drives stop by themselves when SYNC and heartbeat cease."""
        self._bus.close()

    # Commands

    def _follow(self, now: float, body: Mapping[str, Any]) -> None:
        self._ready("follow")
        law = str(body.get("law", self._law))
        if law not in LAWS:
            raise ValueError(f"unknown law {law!r}: know {', '.join(LAWS)}")
        if outside := self._leaves():
            raise ValueError(f"follow: {outside}")
        self._law, self._asked = law, self.speed * _positive(body, "speed")
        self._lease(now, "follow")

    def _turn(self, now: float, body: Mapping[str, Any]) -> None:
        self._ready("turn")
        to = body.get("to")
        if not isinstance(to, int | float) or not math.isfinite(to):
            raise ValueError(
                f"turn: to: expected a finite heading (rad, odometry frame), got {to!r}"
            )
        self._heading, self._rate = float(to), self.speed * _positive(body, "rate", 1.0)
        self._lease(now, "turn")

    def _plan(self, body: Mapping[str, Any]) -> None:
        points = body.get("points", ())
        if any(len(p) != 2 or not all(math.isfinite(c) for c in p) for p in points):
            raise ValueError(
                "plan: points: expected pairs of finite numbers (m, odometry frame), got others"
            )
        self._refuse_outside("plan", points)
        self._map.plan(points)

    def _stretch(self, body: Mapping[str, Any]) -> None:
        gates = body.get("gates", ())
        if any(len(gate) != 3 or not all(math.isfinite(c) for c in gate) for gate in gates):
            raise ValueError(
                "stretch: gates: expected poses of three finite numbers (m, m, rad, odometry "
                "frame), got others"
            )
        self._refuse_outside("stretch", gates)
        self._map.begin(
            [Pose(*map(float, gate)) for gate in gates], look=bool(body.get("look", True))
        )

    def _forget(self, body: Mapping[str, Any]) -> None:
        if body.get("seen", True):
            self._map.drop_seen()
        if body.get("plan", True):
            self._map.drop_plan()

    def _disable(self) -> None:
        self._master.wanted = False
        self._rest("disabled")

    def _ready(self, what: str) -> None:
        if not self._master.enabled:
            troubles = (
                "; ".join(trouble.text for trouble in self._master.troubles)
                or self._master.phase.value
            )
            raise ValueError(f"cannot {what}: the drives are not enabled ({troubles})")

    def _refuse_outside(self, what: str, places: Sequence[Sequence[float]]) -> None:
        for x, y, *_ in places:
            if outside := self.workspace.outside((x, y, 0.0)):
                raise ValueError(f"{what}: {outside}")

    def _leaves(self) -> str:
        """Return in words that the rover would leave its workspace if it braked now; empty if it
        would not."""
        if not self.workspace.bounds:
            return ""
        pose, speed = self._odometry.pose, self._speed
        ahead = EDGE + speed * self.numbers.bus.period + self._profile.distance(speed)
        x = pose.x + ahead * math.cos(pose.heading)
        y = pose.y + ahead * math.sin(pose.heading)
        return self.workspace.outside((x, y, 0.0))

    def _lease(self, now: float, mode: str) -> None:
        self._leased_until = now + LEASE
        self._mode, self._reason = mode, ""

    def _rest(self, reason: str) -> None:
        if self._mode != "off":
            self._mode, self._reason = "rest", reason

    # The cycle

    def _listen(self, now: float) -> None:
        try:
            frames = self._bus.receive()
        except ConnectionError as reason:
            self._master.bus_lost(now, str(reason))
            return
        for frame in frames:
            self._master.receive(now, frame)

    def _measure(self, now: float) -> None:
        """Update odometry and reflectors."""
        radius = self.numbers.wheels.wheel_radius
        left, right = (wheel.turned() * radius for wheel in self._master.drives)
        if self.dry_run:
            left, right = (speed * radius * self.numbers.bus.period for speed in self._set)
        self._odometry.add(now, left, right)
        self._measured = 0.5 * (left + right) / self.numbers.bus.period
        self._turning = (right - left) / self.numbers.wheels.track_width / self.numbers.bus.period
        if self._master.echoes:
            for data in self._master.echoes:
                self._reflectors.take(now, self._odometry.pose, parse_echoes(data))
            self._master.echoes.clear()

    def _look(self, now: float) -> None:
        """Put the newest sight of the track into the map."""
        setpoint = self._setpoint
        if setpoint.count == self._taken or setpoint.values is None:
            return
        self._taken = setpoint.count
        try:
            view = TrackAhead.parse(setpoint.values, setpoint.held)
        except ValueError:
            return
        self._map.take(self._odometry.at(now - view.age), view)
        self._fits.clear()

    def _drive(self, now: float) -> tuple[float, float]:
        """Return the speeds of the wheels (rad/s) for this cycle."""
        enabled = self._master.enabled
        if not enabled:
            self._mode, self._speed = "off", 0.0
            return self._set_wheels(0.0, 0.0)
        if self._mode == "off":
            self._mode, self._reason = "rest", "enabled"
        if self._mode in ("follow", "turn") and now > self._leased_until and not self.paused:
            self._rest("silent_action")
        if self._mode == "follow" and (outside := self._leaves()):
            self._rest(outside)
        if self.paused or self._mode == "rest":
            return self._brake()
        return self._turn_on() if self._mode == "turn" else self._follow_on()

    def _follow_on(self) -> tuple[float, float]:
        if self._setpoint.values is None and not self._map.complete:
            self._reason = "stale"
            return self._brake()
        curvature = LAWS[self._law].curvature(self._fit, self._speed)
        if curvature is None:
            curvature = JOINING.curvature(self._fit, self._speed)
        ahead = self._map.ahead(self._odometry.pose)
        if curvature is None or ahead <= AT_END:
            self._reason = "no_line"
            return self._brake()
        self._reason = ""
        wanted = self._profile.speed(self._asked, curvature, ahead)
        self._speed = self._profile.towards(self._speed, wanted, self.numbers.bus.period)
        return self._set_wheels(self._speed, self._speed * curvature)

    def _turn_on(self) -> tuple[float, float]:
        if abs(self._speed) > 0.01:
            return self._brake()
        left = turned(self._heading - self._odometry.pose.heading)
        rate = capped(TURN_GAIN * left, self._rate)
        if abs(left) < TURNED:
            self._reason, rate = "arrived", 0.0
        return self._set_wheels(0.0, rate)

    def _brake(self) -> tuple[float, float]:
        """Come to rest along the line if one is known, else straight on."""
        self._speed = self._profile.towards(self._speed, 0.0, self.numbers.bus.period)
        if self._speed <= 1e-6:
            return self._set_wheels(0.0, 0.0)
        curvature = LAWS[self._law].curvature(self._fit, self._speed) or 0.0
        return self._set_wheels(self._speed, self._speed * capped(curvature, 1.5))

    def _set_wheels(self, speed: float, turning: float) -> tuple[float, float]:
        """Return wheel speeds (rad/s) with a lead over the wheels' lag; both are scaled down when
        one exceeds what it can do."""
        wheels, period = self.numbers.wheels, self.numbers.bus.period
        half = 0.5 * wheels.track_width
        left, right = (
            (speed - turning * half) / wheels.wheel_radius,
            (speed + turning * half) / wheels.wheel_radius,
        )
        most = max(abs(left), abs(right)) / (DRIVES_SHARE * wheels.top_speed * self.speed)
        if most > 1.0:
            left, right = left / most, right / most
        before, self._set = self._set, (left, right)
        steepest = wheels.acceleration
        leads = (
            capped((new - old) / period, steepest)
            for new, old in zip(self._set, before, strict=True)
        )
        # A first-order lag of time constant T is cancelled by adding T times the rate of change.
        lead_left, lead_right = (wheels.wheel_lag * lead for lead in leads)
        return left + lead_left, right + lead_right

    def _fit(self, x: float) -> Fit | None:
        """Return the map's line `x` m ahead of the axle, computed once per cycle."""
        if x not in self._fits:
            self._fits[x] = self._map.fit(self._odometry.pose, x)
        return self._fits[x]

    def _line_end(self) -> tuple[float, float, float] | None:
        """Return the pose of the line's known end; at rest, of the farthest point that is known."""
        place = self._map.end_place
        if place is None or not (self._map.complete or self._reason):
            return None
        pose = self._odometry.pose
        ahead, _ = pose.body(*place)
        fit = self._map.fit(pose, ahead, END_REACH)
        return None if fit is None else (*place, pose.heading + fit.heading)

    def _found_again(self) -> bool:
        """Return whether the stretch that was searched has been seen often enough and lies well in
        front of the rover."""
        near = self._map.entry
        if not self._map.gated or self._map.sights < REGAINED_SIGHTS or near is None:
            return False
        x, y = self._odometry.pose.body(near.x, near.y)
        nearest, farthest = REGAINED_AHEAD
        if not nearest < x < farthest or abs(y) > REGAINED_ASIDE:
            return False
        fit = self._map.fit(self._odometry.pose, x + 0.1)
        return fit is not None and abs(fit.heading) < REGAINED_TURN

    def _standing(self) -> bool:
        return abs(self._measured) < STANDING and abs(self._turning) < 0.02


def _positive(body: Mapping[str, Any], key: str, default: float | None = None) -> float:
    value = body.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < 10.0:
        raise ValueError(f"{key}: expected a number above 0 and below 10, got {value!r}")
    return float(value)
