"""Driver of the SO-101: class `Arm`, which moves six servos within limits of speed, acceleration
and angle. Commands are plain data; the key `do` names them:

    {"do": "move", "joints": five angles (rad), "speed": share}   all joints arrive together
    {"do": "open", "angle": rad}        open the gripper
    {"do": "close", "squeeze": share}   close it until its motor's duty is this high, and keep it
    {"do": "calibrate", "pose": six angles (rad)}   the arm is in this pose now (default: all 0);
                                        the zero positions are written to the calibration file
    {"do": "free"}                      torque off: the arm falls unless it is held
    {"do": "enable"}                    clear faults, torque on where the arm is; a servo that has
                                        torque keeps a near goal, so that it carries its load
    {"do": "rest"}                      stop and stay there
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from functools import partial
from typing import Any, Final

from msgspec import Struct

from petrobot import Driver, JointChain, JointMotion, Link, Ports, key, numbers
from petrobot.services.adapters.so101 import bus

# --- kinematics ---
# The joints of the SO-101, and how its gripper is brought to a point.
#
# All lengths are those of Simulation/SO101/so101_new_calib.urdf in TheRobotStudio/SO-ARM100 (m).
# The frame here has its origin on the pan axis at the level of the base's origin, x forward, y left
# and z up at zero angles, where the gripper points forward.


def _joint(
    name: str, low: float, high: float, axis: tuple[int, int, int], *point: float
) -> dict[str, Any]:
    return {"name": name, "limits": (low, high), "axis": axis, "point": point}


CHAIN: Final = JointChain(
    [
        _joint("shoulder_pan", -1.91986, 1.91986, (0, 0, -1), 0.0, 0.0, 0.0),
        _joint("shoulder_lift", -1.74533, 1.74533, (0, 1, 0), 0.0303992, 0.0, 0.1490817),
        _joint("elbow_flex", -1.69, 1.69, (0, 1, 0), 0.0583992, 0.0, 0.2616517),
        _joint("wrist_flex", -1.65806, 1.65806, (0, 1, 0), 0.1932992, 0.0, 0.2668517),
        _joint("wrist_roll", -2.79253, 2.79253, (-1, 0, 0), 0.1932992, -0.0001778, 0.2668517),
    ],
    (0.3525266, -0.000395921, 0.2589517, 0.0, 0.0, 0.0),
)
"""The five joints of the arm, and the gripper's tip."""
JOINTS: Final = {**CHAIN.limits, "gripper": (-0.174533, 1.74533)}
"""All joints with their limits (rad), of the same file."""
STARTS: Final = 50
"""Poses from which the angles of a point are sought."""


def inverse(x: float, y: float, z: float, pitch: float, roll: float) -> list[float]:
    """Return five angles that bring the tip there, found from a pose with the elbow up and the arm
    facing the point if that leads there. `pitch` is the gripper's angle above the horizontal,
    `roll` the angle of the joint wrist_roll (rad).

    Raises ValueError if it is out of reach, or only with angles outside `JOINTS`.
    """
    rotation = CHAIN.tool((0.0, 0.0, 0.0, -pitch, roll))[3:]
    near = (-math.atan2(y, x), 0.0, 0.0, -pitch, roll)
    low, high = CHAIN.limits["wrist_roll"]
    if not low <= roll <= high:
        raise ValueError(f"roll: expected {low:.3f} to {high:.3f} rad, found {roll:.3f}")
    return CHAIN.joints(
        (x, y, z, *rotation), near, any_heading=True, keep=("wrist_roll",), starts=STARTS
    )


# --- driver ---

BAUD: Final = 1_000_000
"""bit/s, as the servos are delivered."""
LOST: Final = 0.3
"""Time without an answer after which a servo counts as missing (s)."""
STILL, CREEP = 5, 5
"""Readings without a change after which a servo stands, unless it is faster (steps/s)."""
TRIM_RATE, DEAD = 6.0, 0.004
"""The set point of a loaded joint is corrected until the joint is at its goal: share of the error
per second, and the error that is tolerated because of friction (rad)."""
NEAR: Final = 0.3
"""Largest distance between a servo and its set point that its load can explain, and between two
answers of one servo that come together (rad)."""
SLACK: Final = 20
"""How far beyond the positions to which it can be sent a servo may be (steps)."""
REACHED: Final = 0.015
"""Distance to its goal within which a joint has reached it (rad)."""
STRAIN_TIME: Final = 0.5
"""Time of overload after which a joint gives way (s)."""
GIVE: Final = 1.25
"""Speed with which the gripper, touching something, opens at a load above the wanted one, or closes
at a load below it (rad/s per share of the stall torque)."""
GRASP_TIME: Final = 0.1
"""Time for which the gripper must squeeze at a standstill (s)."""


COMMANDS: Final = ("move", "open", "close", "free", "calibrate", "enable", "rest")
UNREAD: Final = bus.Reading(0, False, 2048, 2048, 0, 0.0, 0.0, 0)


class Joint(Struct):
    """One joint: the last report of its servo, and its set point (rad)."""

    name: str
    servo: int
    """1 to 6 from shoulder_pan to gripper, as LeRobot numbers them."""
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
    """Where it shall be now."""
    trim: float = 0.0
    strained: float = 0.0
    """Duration of the present overload (s)."""

    @property
    def stands(self) -> bool:
        """Return whether the servo has stood still for some readings."""
        return self.still >= STILL and abs(self.read.speed) <= CREEP

    @property
    def usable(self) -> bool:
        """Return whether it can be sent to where it is: else it would jump when torque comes on."""
        beyond = abs(self.steps(self.q) - self.read.position)
        return not self.read.mode and beyond <= SLACK

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

    def within(self) -> tuple[float, float]:
        """Return the limits that the servo can reach, too: it does not turn beyond its ends."""
        ends = sorted(self.angle(end) for end in (0, bus.STEPS - 1))
        return max(self.low, ends[0]), min(self.high, ends[1])

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
        self.aim = servo if near else self.q
        self.trim = self.strained = 0.0


class Arm(Driver):
    """A SO-101 on a serial port. Its workspace bounds the gripper's tip, in the frame of
    `CHAIN`."""

    period = 0.02
    obeys = ("speed", "workspace", "dry_run", "pause")
    port: str = key(text="serial port, as /dev/ttyACM0")
    calibration: str = key("", "file of the zero positions, written by the command calibrate")
    limits: dict[str, Any] = key({}, "joints with other limits, as { gripper = [0.0, 1.5] } (rad)")
    reverse: list[str] = key([], "joints whose servo turns the other way")
    top_speed: float = key(1.5, "rad/s", above=0)
    acceleration: float = key(6.0, "rad/s^2", above=0)
    overload: float = key(0.9, "of the stall torque: a joint gives way", above=0, most=1)
    squeeze: float = key(0.5, "of the stall torque: the gripper's greatest load", above=0, most=1)
    hottest: float = key(60.0, "deg C")
    enable: bool = key(True, "torque on at the start")
    on_estop: str = key("hold", "with torque off the arm falls", choices=("hold", "off"))

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        """Open the port. Raises ValueError for a wrong key or calibration file, ConnectionError if
        the port is missing."""
        super().__init__(config, ports)
        self._check_keys()
        self.joints = [
            Joint(name, servo, low, high, -1 if name in self.reverse else 1)
            for servo, name in enumerate(JOINTS, 1)
            for low, high in [self.limits.get(name, JOINTS[name])]
        ]
        self.arm, self.gripper = self.joints[:5], self.joints[5]
        self.faults: dict[str, str] = {}
        """By code: what is wrong, until `enable`."""
        self._calibrated = self._read_calibration()
        self._on = self.enable
        speeds = self.top_speed, self.acceleration
        self.motion = JointMotion(self, _limits(self.arm), *speeds, CHAIN.point)
        self.jaw = JointMotion(self, _limits([self.gripper]), *speeds)
        self._hand = ""
        """"open", "close", or "keep" (it was stopped while it held something)."""
        self._grip = self._gripped = 0.0
        """Load with which the gripper closes, and how long it has squeezed (s)."""
        self._order = list(self.joints)
        """Order in which the servos are asked. Those that do not answer come last, each in turn
        first among them, so that a missing servo does not hide another."""
        self._split = bus.PacketSplitter()
        self._begun = ports.now
        self._link = Link(ports.now, partial(ports.serial, self.port, BAUD))

    def _check_keys(self) -> None:
        for name in (*self.limits, *self.reverse):
            if name not in JOINTS:
                raise ValueError(f"no joint {name!r}; there are {', '.join(JOINTS)}")
        for name, pair in self.limits.items():
            low, high = numbers(pair, 2, f"limits.{name}")
            if not -math.pi <= low < high <= math.pi:
                raise ValueError(f"limits.{name}: expected [low, high] in rad, found {pair}")

    def _read_calibration(self) -> bool:
        """Read the zero positions from the file. Return False if there is none yet."""
        if not self.calibration:
            return True  # as LeRobot leaves the servos: 2048 in the middle
        try:
            found = tomllib.loads(self.ports.file(self.calibration).decode())
            zeros = numbers(found.get("zero"), 6, "zero")
        except FileNotFoundError:
            return False
        except ValueError as fault:
            text = "is it an arm's file? The command calibrate writes a new one"
            raise ValueError(f"calibration: {self.calibration}: {fault}; {text}") from fault
        for joint, zero in zip(self.joints, zeros, strict=True):
            joint.zero = round(zero)
        return True

    # --- commands -------------------------------------------------------------------------------

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        do = body.get("do")
        if do not in COMMANDS:
            raise ValueError(f"unknown command {dict(body)!r:.80}; do: {', '.join(COMMANDS)}")
        if do != "rest" and (missing := self._missing(now)):
            raise ValueError(missing)
        if do in ("move", "open", "close"):
            if self.faults or not self._on:
                why = "; ".join(self.faults.values()) or "its torque is off"
                raise ValueError(f'{why}: send {{"do": "enable"}} when that is mended')
            if not self._calibrated:
                raise ValueError(f"{self.calibration} is not there yet: calibrate the arm first")
            if not all(joint.ready for joint in self.joints):
                raise ValueError("the servos are being switched on: try again")
        getattr(self, f"_do_{do}")(body)

    def _do_move(self, body: Mapping[str, Any]) -> None:
        self.motion.begin([numbers(body.get("joints"), 5, "joints")], body.get("speed", 1.0))

    def _do_open(self, body: Mapping[str, Any]) -> None:
        self.jaw.halt(self.jaw.q)
        self.jaw.begin([[body.get("angle", self.gripper.high)]])
        self._hand = "open"

    def _do_close(self, body: Mapping[str, Any]) -> None:
        (squeeze,) = numbers([body.get("squeeze", self.squeeze / 2)], 1, "squeeze")
        if not 0.0 < squeeze <= self.squeeze:
            raise ValueError(f"squeeze: expected at most {self.squeeze}, found {squeeze:g}")
        self.jaw.stop()
        self._hand, self._grip, self._gripped = "close", squeeze, 0.0

    def _do_calibrate(self, body: Mapping[str, Any]) -> None:
        pose = numbers(body.get("pose", [0.0] * 6), 6, "pose")
        if self.dry_run:
            raise ValueError("a dry run does not know where the arm is: calibrate without it")
        if not self.calibration:
            raise ValueError('write calibration = "FILE" in the table of this device first')
        if not all(joint.stands for joint in self.joints):
            raise ValueError("the arm moves")
        zeros = [
            joint.read.position - joint.sign * round(angle / bus.RAD)
            for joint, angle in zip(self.joints, pose, strict=True)
        ]
        text = f"# Zero positions of a SO-101 (steps)\nzero = {zeros}\n"
        self.ports.write_file(self.calibration, text.encode())
        for joint, zero in zip(self.joints, zeros, strict=True):
            joint.zero = zero
            joint.settle()
        self.motion.limits, self.jaw.limits = _limits(self.arm), _limits([self.gripper])
        self._calibrated, self._hand = True, ""
        self._freeze()

    def _do_free(self, body: Mapping[str, Any]) -> None:
        self._on, self._hand = False, ""
        self._freeze()

    def _do_rest(self, body: Mapping[str, Any]) -> None:
        self.stop(self.ports.now)

    def _do_enable(self, body: Mapping[str, Any]) -> None:
        self.faults.clear()
        self._freeze()
        self._on = True
        for joint in self.joints:  # written again: that also clears an overload of the servo
            joint.started = joint.ready = False

    # --- one period -----------------------------------------------------------------------------

    def step(self, now: float) -> None:
        """Read the answers, move the set points, send them and ask again. Never waits."""
        data = self._link.receive(now)
        if self._link.up:
            self._take(now, data)
            self._plan(now)
            self._link.send(now, self._packets(now))
        if not self._link.up:
            self._freeze()
            self._split = bus.PacketSplitter()
            for joint in self.joints:
                joint.heard, joint.still = -math.inf, 0
                joint.started = joint.ready = False

    def _take(self, now: float, data: bytes) -> None:
        by_servo, heard = {joint.servo: joint for joint in self.joints}, []
        for answer in self._split.feed(data):
            joint, read = by_servo.get(answer.servo), bus.reading(answer.data)
            if joint is None or read is None:
                continue
            if joint in heard and abs(read.position - joint.read.position) * bus.RAD > NEAR:
                self._fault("twice", f"two servos answer as {joint.name}: change the id of one")
            heard.append(joint)
            if self.dry_run and self._on and joint.started:  # as if it had followed
                at = joint.steps(joint.aim)
                read = read._replace(torque=True, goal=at, position=at, speed=0, load=0.0)
            joint.take(now, read)
            # Errors from before `enable` are cleared when torque is written, in this period.
            starts = self._on and joint.usable and not joint.started
            for bit, word in bus.ERRORS.items():
                if answer.error & bit and not starts:
                    self._fault(word, f"the servo of {joint.name} reports {word}")
            if read.mode:
                text = f"the servo of {joint.name} is in mode {read.mode}: it must be 0 (position)"
                self._fault("mode", text)
            elif not joint.usable:
                text = (
                    f"the servo of {joint.name} is at {read.position}, and only goes to 0 to 4095"
                )
                self._fault("range", f"{text}: turn it back, or change its offset")
            if read.temperature > self.hottest:
                text = f"{joint.name} has {read.temperature} deg C, more than {self.hottest:g}"
                self._fault("heat", f"{text}: let it cool down")
            if joint.ready and self._on and not read.torque:
                self._fault("power", f"{joint.name} lost its torque: is its supply too weak?")
                joint.started = False
            if not (joint.ready and read.torque):
                joint.settle()
            joint.ready = read.torque and self._on and joint.started and joint.usable
        if not self.motion.moving and not all(joint.ready for joint in self.arm):
            self.motion.halt([joint.aim for joint in self.arm])
        if not self.gripper.ready:
            self.jaw.halt([self.gripper.aim])
        silent = [joint for joint in self._order if joint not in heard]
        self._order = [*(j for j in self._order if j in heard), *silent[1:], *silent[:1]]

    def _fault(self, code: str, text: str) -> None:
        if code not in self.faults:
            self.faults[code] = text
            self.stop(self.ports.now)

    def _missing(self, now: float) -> str:
        late = now - LOST
        silent = [joint.name for joint in self.joints if joint.heard < late]
        if silent == [joint.name for joint in self.joints] and not self._link.why:
            return "no servo answers: is their supply on, and is this their port?"
        return f"no answer from {', '.join(silent)} {self._link.why}".rstrip() if silent else ""

    def _plan(self, now: float) -> None:
        if self._missing(now):
            self.stop(now)
        if left := self.motion.watch([joint.q for joint in self.arm]):
            self._fault("workspace", left)
        if self.gripper.ready:
            self._squeeze()
        self.motion.step()
        self.jaw.step()
        for joint, aim in zip(self.joints, (*self.motion.q, *self.jaw.q), strict=True):
            if not joint.ready:
                continue
            joint.aim = aim
            over = abs(joint.load) >= self.overload
            joint.strained = joint.strained + self.period if over else 0.0
            if joint.strained > STRAIN_TIME:
                self._fault("overload", f"{joint.name} pushes against something")
                joint.settle()
                self._freeze()
            if self._untrimmed(joint) and not self.paused:
                change = TRIM_RATE * self.period * (joint.aim - joint.q)
                joint.trim = min(0.1, max(-0.1, joint.trim + change))

    def _untrimmed(self, joint: Joint) -> bool:
        """Whether its load keeps a joint from its goal, and its set point is still being moved."""
        if joint is self.gripper or not self.motion.arrived:
            return False
        error = joint.aim - joint.q
        return abs(error) > DEAD and math.copysign(joint.trim, joint.trim * error) < 0.1

    def _squeeze(self) -> None:
        """Close the gripper as long as its load is below the wish; see whether it holds."""
        joint, jaw = self.gripper, self.jaw
        low, high = joint.within()
        if self._hand == "close" and not self.paused:
            excess = -joint.load - self._grip
            if excess > 0.0 or joint.stands:  # it touches something
                way = GIVE * excess * self.period * (1.0 if excess > 0.0 else self.speed)
                jaw.halt([min(high, max(low, joint.aim + way))])
            elif not jaw.moving and jaw.q != [low]:
                jaw.begin([[low]])
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
            elif self._on and joint.usable and "twice" not in self.faults:
                limit = self.squeeze if joint is self.gripper else 1.0
                speed = min(round(1.5 * self.top_speed / bus.RAD), 32767)
                start[joint.servo] = bus.setup(joint.steps(joint.aim), speed, round(1000 * limit))
                joint.started = True
            elif joint.read.torque:
                free[joint.servo] = b"\0"
        question = bus.read_state(joint.servo for joint in self._order)
        if self.dry_run:
            return question
        torque = bus.sync_write(bus.TORQUE, start) + bus.sync_write(bus.TORQUE, free)
        return bus.sync_write(bus.GOAL, goals) + torque + question

    # --- called by the node ---------------------------------------------------------------------

    def stop(self, now: float) -> None:
        """Brake; the gripper keeps what it holds."""
        self._hand = "keep" if self._holding else ""
        self.motion.stop()
        self.jaw.stop()

    def _freeze(self) -> None:
        """Stand still from this period on."""
        self.motion.halt([joint.aim for joint in self.arm])
        self.jaw.halt([self.gripper.aim])

    def quick_stop(self, now: float) -> None:
        """Stop at once: by torque (`on_estop = "hold"`), or torque off."""
        self._freeze()
        self._on = self._on and self.on_estop == "hold"

    def stopped(self) -> bool:
        """Return whether every servo answers and stands still, and no motion is left."""
        if self._missing(self.ports.now):
            return False
        trims = not self.paused and any(map(self._untrimmed, self.joints))
        going = self.motion.moving or self.jaw.moving or trims
        return not going and all(joint.stands for joint in self.joints)

    def hold(self, now: float) -> str:
        """Brake, and keep the goal until `release`."""
        return "cannot hold" if self._missing(now) else super().hold(now)

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
        closed = self._hand == "close" and gripper.aim == gripper.within()[0] and gripper.stands
        return {
            "q": [joint.q for joint in arm],
            "qd": [0.0 if j.stands else j.sign * j.read.speed * bus.RAD for j in arm],
            "load": [joint.load for joint in self.joints],
            "temperature": [joint.read.temperature for joint in self.joints],
            "voltage": min(joint.read.voltage for joint in self.joints),
            "moving": not missing and not self.stopped(),
            "at_goal": self.motion.reached([joint.q for joint in arm], REACHED)
            and not any(map(self._untrimmed, arm)),
            "gripper": {
                "angle": gripper.q,
                "holding": self._holding,
                "closed": closed and not self._holding,
                "open": self._hand == "open"
                and self.jaw.arrived
                and abs(gripper.q - gripper.aim) <= 2 * REACHED,
            },
            "torque": self._on,
            "ready": not missing and all(joint.ready for joint in self.joints),
            "faults": faults,
        }

    def close(self) -> None:
        """Release the port. The servos keep their last goal."""
        self._link.close()


def _limits(joints: list[Joint]) -> dict[str, tuple[float, float]]:
    return {joint.name: joint.within() for joint in joints}
