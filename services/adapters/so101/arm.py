"""Driver of the SO-101: class `Arm`, which moves six servos within limits of speed, acceleration
and angle. Commands are plain data; the key `do` names them:

    {"do": "move", "joints": five angles (rad), "speed": share}   all joints arrive together
    {"do": "open", "angle": rad}        open the gripper
    {"do": "close", "squeeze": share}   close it until its motor's duty is this high, and keep it
    {"do": "calibrate", "pose": six angles (rad)}   the arm is in this pose now (default: all 0);
                                        the zero positions are written to the calibration file
    {"do": "free"}                      torque off: the arm falls unless it is held
    {"do": "reset"}                     clear faults, torque on at the present position
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeGuard

from petrobot import Driver, Ports, SerialLine, key
from petrobot.services.adapters.so101 import bus
from petrobot.services.adapters.so101.kinematics import JOINTS

LOST: Final = 0.3
"""Time without an answer after which a servo counts as missing (s)."""
STILL, CREEP = 5, 5
"""Number of equal readings after which a servo stands still, and the speed above which it does not
(steps/s)."""
RETRY: Final = (0.2, 3.2)
"""Shortest and longest time between two attempts to open the port (s)."""
TRIM_RATE, DEAD = 6.0, 0.004
"""The set point of a loaded joint is corrected until the joint is at its goal: share of the error
per second, and the error that is tolerated because of friction (rad)."""
NEAR: Final = 0.3
"""Largest distance between a servo and its set point that its load can explain (rad)."""
REACHED: Final = 0.015
"""Distance to its goal within which a joint has reached it (rad)."""
STRAIN_TIME: Final = 0.5
"""Time of overload after which a joint gives way (s)."""
GIVE: Final = 1.25
"""Speed with which the gripper, touching something, opens at a load above the wanted one, or closes
at a load below it (rad/s per share of the stall torque)."""
GRASP_TIME: Final = 0.1
"""Time for which the gripper must squeeze at a standstill (s)."""


UNREAD: Final = bus.Reading(False, 2048, 2048, 0, 0.0, 0.0, 0)


@dataclass
class Joint:
    """One servo: its last report, and its set point (rad)."""

    name: str
    servo: int
    low: float
    high: float
    sign: int = 1
    zero: int = 2048
    """Position of the servo at 0 rad (steps)."""
    heard: float = -math.inf
    read: bus.Reading = UNREAD
    rest: int = 0
    """Position at which it has been for `still` readings (steps)."""
    still: int = 0
    started: bool = False
    """Whether torque and limits have been written."""
    ready: bool = False
    """Whether they are in effect, so that the servo can be moved."""
    aim: float = 0.0
    velocity: float = 0.0
    goal: float = 0.0
    fastest: float = 0.0
    trim: float = 0.0
    strained: float = 0.0
    """Duration of the present overload (s)."""

    @property
    def stands(self) -> bool:
        """Return whether the servo has stood still for some readings."""
        return self.still >= STILL and abs(self.read.speed) <= CREEP

    @property
    def q(self) -> float:
        """Angle (rad)."""
        return self.angle(self.read.position)

    def angle(self, steps: int) -> float:
        """Angle at a position of the servo."""
        return self.sign * (steps - self.zero) * bus.RAD

    @property
    def load(self) -> float:
        """Duty cycle of the motor, positive towards larger angles."""
        return self.sign * self.read.load

    def steps(self, q: float) -> int:
        """Position of the servo at an angle."""
        return min(bus.STEPS - 1, max(0, self.zero + self.sign * round(q / bus.RAD)))

    def take(self, now: float, read: bus.Reading) -> None:
        """Store what the servo reports."""
        moved = abs(read.position - self.rest) > 1
        self.rest, self.still = (read.position, 0) if moved else (self.rest, self.still + 1)
        self.heard, self.read = now, read

    def settle(self) -> None:
        """Stay at the present position. With torque on, keep the servo's goal if it is near, so
        that it still carries its load, or squeezes."""
        servo = self.angle(self.read.goal)
        near = self.read.torque and abs(servo - self.q) < NEAR
        self.aim = self.goal = servo if near else self.q
        self.velocity = self.trim = self.strained = 0.0

    def brake(self, dt: float, acceleration: float) -> None:
        """Set as goal the nearest position at which it can stop."""
        step = acceleration * dt
        way = self.velocity * max(0.0, abs(self.velocity) - step) * dt / (2 * step)
        self.goal = min(self.high, max(self.low, self.aim + way))

    def lead(self, dt: float, acceleration: float, held: bool) -> None:
        """Move the set point by one period towards the goal."""
        left, step = self.goal - self.aim, acceleration * dt
        # The speed from which `periods` of braking, one step of speed each, end on the goal.
        periods = max(1, math.ceil(math.sqrt(0.25 + 2 * abs(left) / (step * dt)) - 0.5))
        braking = abs(left) / (periods * dt) + step * (periods - 1) / 2
        wish = 0.0 if held else math.copysign(min(self.fastest, braking), left)
        self.velocity += min(step, max(-step, wish - self.velocity))
        self.aim += self.velocity * dt
        if abs(self.goal - self.aim) < 1e-9:
            self.aim = self.goal


class Arm(Driver):
    """A SO-101 on a serial port."""

    port: str = key(text="serial port, as /dev/ttyACM0")
    baud: int = key(1_000_000, "bit/s")
    period: float = key(0.02, "s between two set points")
    ids: list[int] = key([1, 2, 3, 4, 5, 6], "servos, from shoulder_pan to gripper")
    calibration: str = key("", "file of the zero positions, written by the command calibrate")
    limits: dict[str, Any] = key({}, "joints with other limits, as { gripper = [0.0, 1.5] } (rad)")
    reverse: list[str] = key([], "joints whose servo turns the other way")
    speed: float = key(1.0, "share of `fastest`, for all movements")
    fastest: float = key(1.5, "rad/s")
    acceleration: float = key(6.0, "rad/s^2")
    overload: float = key(0.9, "load from which a joint gives way, share of the stall torque")
    squeeze: float = key(0.5, "greatest load of the gripper, share of the stall torque")
    hottest: float = key(60.0, "deg C")
    enable: bool = key(True, "torque on at the start")
    on_estop: str = key("hold", "hold or off: with torque off the arm falls")

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        """Open the port. Raises ValueError for a wrong key or calibration file, ConnectionError if
        the port is not there."""
        super().__init__(config, ports)
        self._check_keys()
        self.joints = [
            Joint(name, servo, low, high, -1 if name in self.reverse else 1)
            for servo, name in zip(self.ids, JOINTS, strict=True)
            for low, high in [self.limits.get(name, JOINTS[name])]
        ]
        self.arm, self.gripper = self.joints[:5], self.joints[5]
        self.faults: dict[str, str] = {}
        """By code: what is wrong, until `reset`."""
        self._calibrated = self._read_calibration()
        self._on, self._held = self.enable, False
        self._task = ""
        """"move" while the commanded goal is followed; else empty."""
        self._hand = ""
        """"open", "close", or "keep" (it was stopped while it held something)."""
        self._grip = self._gripped = 0.0
        """Load with which the gripper closes, and how long it has squeezed (s)."""
        self._order = list(self.joints)
        """Order in which the servos are asked. Those that do not answer come last, each in turn
        first among them, so that a missing servo does not hide another."""
        self._split = bus.PacketSplitter()
        self._lost, self._retry, self._pause = "", 0.0, RETRY[0]
        self._begun = ports.now
        self._line: SerialLine | None = ports.serial(self.port, self.baud)

    def _check_keys(self) -> None:
        if len(set(self.ids)) != 6 or not all(type(i) is int and 0 <= i < 254 for i in self.ids):
            raise ValueError(f"ids: expected six different numbers of 0 to 253, found {self.ids}")
        for name in (*self.limits, *self.reverse):
            if name not in JOINTS:
                raise ValueError(f"no joint {name!r}; there are {', '.join(JOINTS)}")
        for name, pair in self.limits.items():
            if not _numbers(pair, 2) or not -math.pi <= pair[0] < pair[1] <= math.pi:
                raise ValueError(f"limits.{name}: expected [low, high] in rad, found {pair}")
        for name in ("period", "speed", "fastest", "acceleration", "overload", "squeeze"):
            most = 1.0 if name in ("speed", "overload", "squeeze") else math.inf
            if not 0.0 < getattr(self, name) <= most:
                raise ValueError(f"{name}: expected a number above 0, at most {most:g}")
        busy = 10 * (6 * 33 + 80) / self.baud
        if self.period < busy:
            raise ValueError(f"period: expected at least {busy:.3f} s at {self.baud} baud")
        if self.on_estop not in ("hold", "off"):
            raise ValueError(f'on_estop: expected "hold" or "off", found {self.on_estop!r}')

    def _read_calibration(self) -> bool:
        """Read the zero positions from the file. Return False if there is none yet."""
        if not self.calibration:
            return True  # as LeRobot leaves the servos: 2048 in the middle
        try:
            text = self.ports.file(self.calibration).decode()
            found = tomllib.loads(text)
        except FileNotFoundError:
            return False
        except ValueError as fault:
            raise ValueError(f"calibration: {self.calibration}: {fault}") from fault
        zeros = found.get("zero")
        if found.get("ids") != self.ids or not _numbers(zeros, 6):
            raise ValueError(
                f"calibration: {self.calibration}: expected ids = {self.ids} and zero = six numbers"
                f" of steps, found ids = {found.get('ids')}, zero = {zeros!r:.60}; is it this arm's"
                " file? The command calibrate writes a new one"
            )
        for joint, zero in zip(self.joints, zeros, strict=True):
            joint.zero = round(zero)
        return True

    # --- commands -------------------------------------------------------------------------------

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Obey a command. Raises ValueError for one that the arm must not follow."""
        do = body.get("do")
        known = {
            "move": self._move, "open": self._open, "close": self._close, "free": self._free,
            "calibrate": self._calibrate, "reset": self._reset,
        }  # fmt: skip
        if do not in known:
            raise ValueError(f"unknown command {dict(body)!r:.80}; do: {', '.join(known)}")
        if missing := self._missing(now):
            raise ValueError(missing)
        if do in ("move", "open", "close"):
            if self.faults or not self._on:
                why = "; ".join(self.faults.values()) or "its torque is off"
                raise ValueError(f'{why}: send {{"do": "reset"}} when that is mended')
            if not self._calibrated:
                raise ValueError(f"{self.calibration} is not there yet: calibrate the arm first")
            if not all(joint.ready for joint in self.joints):
                raise ValueError("the servos are being switched on: try again")
        known[do](body)

    def _move(self, body: Mapping[str, Any]) -> None:
        goals, share = body.get("joints"), body.get("speed", 1.0)
        if not _numbers(goals, 5):
            raise ValueError(f"joints: expected five angles (rad), found {goals!r:.60}")
        if not _numbers([share], 1) or not 0.0 < share <= 1.0:
            raise ValueError(f"speed: expected a share above 0, at most 1, found {share!r:.40}")
        for joint, goal in zip(self.arm, goals, strict=True):
            _within(joint, goal)
        fastest, rate = self.fastest * self.speed * share, self.acceleration
        far = max(abs(goal - joint.aim) for joint, goal in zip(self.arm, goals, strict=True))
        peak = min(fastest, math.sqrt(far * rate))
        time = far / peak + peak / rate if peak > 0.0 else 0.0
        for joint, goal in zip(self.arm, goals, strict=True):
            # the speed with which this joint takes as long as the slowest one
            root = math.sqrt(max(0.0, (rate * time) ** 2 - 4 * rate * abs(goal - joint.aim)))
            joint.goal, joint.fastest = goal, max((rate * time - root) / 2, 1e-3)
        self._task = "move"

    def _open(self, body: Mapping[str, Any]) -> None:
        angle = body.get("angle", self.gripper.high)
        if not _numbers([angle], 1):
            raise ValueError(f"angle: expected rad, found {angle!r:.40}")
        _within(self.gripper, angle)
        self._hand = "open"
        self.gripper.goal, self.gripper.fastest = angle, self.fastest * self.speed

    def _close(self, body: Mapping[str, Any]) -> None:
        squeeze = body.get("squeeze", self.squeeze / 2)
        if not _numbers([squeeze], 1) or not 0.0 < squeeze <= self.squeeze:
            raise ValueError(f"squeeze: expected at most {self.squeeze}, found {squeeze!r:.40}")
        self._hand, self._grip, self._gripped = "close", squeeze, 0.0
        self.gripper.fastest = self.fastest * self.speed

    def _calibrate(self, body: Mapping[str, Any]) -> None:
        pose = body.get("pose", [0.0] * 6)
        if not _numbers(pose, 6):
            raise ValueError(f"pose: expected six angles (rad), found {pose!r:.60}")
        if not self.calibration:
            raise ValueError('write calibration = "FILE" in the table of this device first')
        if not all(joint.stands for joint in self.joints):
            raise ValueError("the arm moves")
        zeros = [
            joint.read.position - joint.sign * round(angle / bus.RAD)
            for joint, angle in zip(self.joints, pose, strict=True)
        ]
        text = f"# Zero positions of a SO-101 (steps)\nids = {self.ids}\nzero = {zeros}\n"
        self.ports.write_file(self.calibration, text.encode())
        for joint, zero in zip(self.joints, zeros, strict=True):
            joint.zero = zero
            joint.settle()
        self._calibrated, self._task, self._hand = True, "", ""

    def _free(self, body: Mapping[str, Any]) -> None:
        self._on, self._task, self._hand = False, "", ""

    def _reset(self, body: Mapping[str, Any]) -> None:
        self.faults.clear()
        self._freeze()
        self._on = True
        for joint in self.joints:  # written again: that also clears an overload of the servo
            joint.started = joint.ready = False

    # --- one period -----------------------------------------------------------------------------

    def step(self, now: float) -> None:
        """Read the answers, move the set points, send them and ask again. Never waits."""
        try:
            if self._line is None:
                if now < self._retry:
                    return
                self._line = self.ports.serial(self.port, self.baud)
            self._take(now, self._line.receive())
            self._plan(now)
            self._line.send(self._packets(now))
        except (ConnectionError, OSError) as fault:
            self._lost = str(fault)
            self._retry, self._pause = now + self._pause, min(2 * self._pause, RETRY[1])
            self._freeze()
            for joint in self.joints:
                joint.heard, joint.still = -math.inf, 0
                joint.started = joint.ready = False
            if self._line is not None:
                self._line.close()
            self._line, self._split = None, bus.PacketSplitter()

    def _take(self, now: float, data: bytes) -> None:
        by_servo, heard = {joint.servo: joint for joint in self.joints}, []
        for answer in self._split.feed(data):
            joint, read = by_servo.get(answer.servo), bus.reading(answer.data)
            if joint is None or read is None:
                continue
            heard.append(joint)
            if joint.heard == -math.inf:
                self._lost, self._pause = "", RETRY[0]
            joint.take(now, read)
            for bit, word in bus.ERRORS.items():
                if answer.error & bit:
                    self._fault(word, f"the servo of {joint.name} reports {word}")
            if read.temperature > self.hottest:
                self._fault("heat", f"{joint.name} has {read.temperature} deg C")
            if joint.ready and self._on and not read.torque:
                self._fault("power", f"{joint.name} lost its torque: is its supply too weak?")
                joint.started = False
            if not joint.ready:
                joint.settle()
            joint.ready = read.torque and self._on and joint.started
        silent = [joint for joint in self._order if joint not in heard]
        self._order = [*(j for j in self._order if j in heard), *silent[1:], *silent[:1]]

    def _fault(self, code: str, text: str) -> None:
        if code not in self.faults:
            self.faults[code] = text
            self.stop(self.ports.now)

    def _missing(self, now: float) -> str:
        late = now - LOST
        names = ", ".join(joint.name for joint in self.joints if joint.heard < late)
        return f"no answer from {names} {self._lost}".rstrip() if names else ""

    def _plan(self, now: float) -> None:
        if self._missing(now):
            self.stop(now)
        for joint in self.joints:
            if not joint.ready:
                continue
            if joint is self.gripper:
                self._squeeze()
            joint.lead(self.period, self.acceleration, self._held)
            over = abs(joint.load) >= self.overload
            joint.strained = joint.strained + self.period if over else 0.0
            if joint.strained > STRAIN_TIME:
                self._fault("overload", f"{joint.name} pushes against something")
                joint.settle()
        if not self._held:
            for joint in self.arm:
                if self._untrimmed(joint):
                    change = TRIM_RATE * self.period * (joint.aim - joint.q)
                    joint.trim = min(0.1, max(-0.1, joint.trim + change))

    def _untrimmed(self, joint: Joint) -> bool:
        """Return whether a joint's load keeps it from its goal, and its set point is still being
        corrected."""
        if joint is self.gripper or self._task != "move" or joint.aim != joint.goal:
            return False
        return abs(joint.aim - joint.q) > DEAD and abs(joint.trim) < 0.1

    def _squeeze(self) -> None:
        """Close the gripper while its load is below the wanted one, and find out whether it holds
        something."""
        joint = self.gripper
        if self._hand == "close" and not self._held:
            excess = -joint.load - self._grip
            joint.goal = joint.low
            if excess > 0.0 or joint.stands:  # it touches something
                way = GIVE * excess * self.period
                joint.goal = joint.aim = min(joint.high, max(joint.low, joint.aim + way))
                joint.velocity = 0.0
        holds = -joint.load >= 0.7 * self._grip and joint.stands
        self._gripped = self._gripped + self.period if holds else 0.0

    @property
    def _holding(self) -> bool:
        return self._hand in ("close", "keep") and self._gripped >= GRASP_TIME

    def _packets(self, now: float) -> bytes:
        """Return the packets to send: set points, torque where it must change, and the next
        request."""
        goals, start, free = {}, {}, {}
        for joint in self.joints:
            if joint.heard == -math.inf:
                continue
            if joint.ready:
                goals[joint.servo] = bus.word(joint.steps(joint.aim + joint.trim))
            elif self._on:
                limit = self.squeeze if joint is self.gripper else 1.0
                speed = min(round(1.5 * self.fastest / bus.RAD), 32767)
                start[joint.servo] = bus.setup(joint.steps(joint.aim), speed, round(1000 * limit))
                joint.started = True
            elif joint.read.torque:
                free[joint.servo] = b"\0"
        out = bus.sync_write(bus.GOAL, goals) if goals else b""
        out += bus.sync_write(bus.TORQUE, start) if start else b""
        out += bus.sync_write(bus.TORQUE, free) if free else b""
        return out + bus.read_state(joint.servo for joint in self._order)

    # --- called by the node ---------------------------------------------------------------------

    def stop(self, now: float) -> None:
        """Brake; the gripper keeps what it holds."""
        self._task, self._hand = "", "keep" if self._holding else ""
        for joint in self.joints:
            joint.brake(self.period, self.acceleration)

    def _freeze(self) -> None:
        """Stand still from this period on."""
        self.stop(self.ports.now)
        for joint in self.joints:
            joint.goal, joint.velocity = joint.aim, 0.0

    def quick_stop(self, now: float) -> None:
        """Stop at once: by torque (`on_estop = "hold"`), or torque off."""
        self._freeze()
        self._on = self._on and self.on_estop == "hold"

    def stopped(self) -> bool:
        """Return whether every servo answers and stands still, and no motion is left."""
        if self._missing(self.ports.now):
            return False
        going = not self._held and any(
            joint.aim != joint.goal or self._untrimmed(joint) for joint in self.joints
        )
        return not going and all(joint.velocity == 0.0 and joint.stands for joint in self.joints)

    def hold(self, now: float) -> str:
        """Brake, and keep the goal until `release`."""
        if self._missing(now):
            return "cannot hold"
        self._held = True
        return "held"

    def release(self, now: float) -> None:
        """Move on."""
        self._held = False

    def state(self) -> Mapping[str, Any]:
        """Return angles (rad), speeds (rad/s), loads (share of the stall torque), temperatures
        (deg C) and what is wrong."""
        arm, gripper = self.arm, self.gripper
        now = self.ports.now
        missing = self._missing(now)
        faults = dict(self.faults)
        if missing and now > self._begun + LOST:
            faults["missing"] = missing
        if not self._calibrated:
            faults["uncalibrated"] = f"{self.calibration} is not there yet"
        closed = self._hand == "close" and gripper.aim == gripper.low and gripper.stands
        return {
            "q": [joint.q for joint in arm],
            "qd": [0.0 if j.stands else j.sign * j.read.speed * bus.RAD for j in arm],
            "load": [joint.load for joint in self.joints],
            "temperature": [joint.read.temperature for joint in self.joints],
            "voltage": min(joint.read.voltage for joint in self.joints),
            "moving": not missing and not self.stopped(),
            "at_goal": self._task == "move"
            and all(j.aim == j.goal and abs(j.q - j.goal) <= REACHED for j in arm)
            and not any(map(self._untrimmed, arm)),
            "gripper": {
                "angle": gripper.q,
                "holding": self._holding,
                "closed": closed and not self._holding,
                "open": self._hand == "open" and abs(gripper.q - gripper.goal) <= 2 * REACHED,
            },
            "torque": self._on,
            "ready": not missing and all(joint.ready for joint in self.joints),
            "faults": faults,
        }

    def close(self) -> None:
        """Release the port. The servos keep their last goal."""
        if self._line is not None:
            self._line.close()


def _numbers(value: Any, count: int) -> TypeGuard[list[float]]:
    """Return whether the value is a list of so many finite numbers."""
    return (
        isinstance(value, list | tuple)
        and len(value) == count
        and all(type(v) in (int, float) and math.isfinite(v) for v in value)
    )


def _within(joint: Joint, angle: float) -> None:
    """Raise ValueError for an angle outside a joint's limits."""
    ends = sorted(joint.sign * (end - joint.zero) * bus.RAD for end in (0, bus.STEPS - 1))
    low, high = max(joint.low, ends[0]), min(joint.high, ends[1])
    if not low <= angle <= high:
        raise ValueError(f"{joint.name}: expected {low:.3f} to {high:.3f} rad, found {angle:.3f}")
