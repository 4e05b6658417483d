"""Six CiA 402 servo drives and the digital inputs on the arm's bus: frames in, torques on the arm,
frames out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Protocol

from msgspec import Struct

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.canopen.cia301 import NmtState
from petrobot.services.comm.canopen.cia402 import (
    RECEIVED,
    SENT,
    UNITS,
    DriveFault,
    DriveState,
    ObjectIndex,
    OperationMode,
    StatusBit,
    to_units,
)
from petrobot.sim.bus.canopen_node import CanopenNode
from petrobot.sim.bus.power_drive import ENABLE, ENABLE_MASK, POWERED, RUNNING, DriveBus, PowerDrive

# --- the position loop of one drive ---


class DriveRating(Struct, frozen=True):
    """What a drive was sized and commissioned for, at the joint: torque (N m), speed (rad/s),
    expected inertia (kg m^2)."""

    torque: float
    speed: float
    inertia: float


POSITION_GAIN = 45.0
"""1/s, of the position loop."""
VELOCITY_GAIN = 180.0
"""1/s, of the velocity loop; multiplied by the inertia it gives a torque."""
INTEGRAL_GAIN = 40.0
"""1/s, of the velocity loop's integrator: it carries gravity and friction, as in drives without a
model of the arm."""
CYCLE = 0.001
"""s, cycle of the loop inside the drive.

The loop compares the angle with where the joint is to be at the end of its cycle, whatever the step
size of the plant. So steps of 2 ms lead to the same path as steps of 1 ms, to 0.2 mm at the cup
(tests/sim/test_puma.py).
"""
DEAD_BAND = 1e-4
"""rad; while the set point is constant and the error is smaller, the integrator keeps its value, as
in commercial drives, so that integrator and dry friction do not oscillate.

This project's choice, small compared with the 0.5 degrees within which the arm counts as being at
home; no data sheet states it.
"""


class JointServo:
    """Torque for one joint from set points that arrive once per period.

    Between set points the reference is a uniform quadratic B-spline of the last three: continuous
    in velocity, exact at rest, one and a half periods behind. Torque = J (a + Kv (v + Kp e - qd)) +
    integral, at most the rated torque.
    """

    def __init__(self, rating: DriveRating, q: float) -> None:
        self.rating = rating
        self._most, self._inertia = rating.torque, rating.inertia
        self._stiffness = rating.inertia * VELOCITY_GAIN
        self._integration = self._stiffness * INTEGRAL_GAIN
        self.limit = rating.speed
        self.period = 0.004
        self.limited = False
        self.start(q)

    def start(self, q: float) -> None:
        """Begin to hold here, with an empty integrator."""
        self._pass(q, q, q)
        self._since = 0.0
        self._integral = 0.0
        self._ramp: float | None = None
        self.error = 0.0

    def aim(self, target: float) -> None:
        """Take the next set point (rad); one that requires more than the greatest speed is cut and
        sets `limited`."""
        if self._ramp is not None:
            return
        _, before, last = self._points
        if target == last and self.standing:
            self.limited = False
            return
        most = self.limit * self.period
        step = target - last
        self.limited = abs(step) > most * (1.0 + 1e-3)
        if self.limited:
            target = last + math.copysign(most, step)
        self._pass(before, last, target)
        self._since = 0.0

    def ramp_down(self, deceleration: float) -> None:
        """Bring the reference to rest at so many rad/s^2 and stay there."""
        self._ramp = deceleration

    @property
    def ramped_down(self) -> bool:
        """Whether a ramp has ended."""
        return self._ramp is not None and self.velocity == 0.0

    def follow(self, target: float) -> None:
        """Leave the ramp and take set points again from where the reference is."""
        self._ramp = None
        self._pass(self.reference, self.reference, self.reference)
        self.aim(target)

    def torque(self, q: float, qd: float, dt: float) -> float:
        """Return the torque (N m) for the next `dt` seconds from the measured angle and speed."""
        if self._ramp is not None:
            self._decelerate(dt)
        elif not self.standing:
            self._interpolate(dt)
        self.error = error = self.reference - q
        most, integral = self._most, self._integral
        wanted = self.velocity + POSITION_GAIN * error - qd
        tau = self._inertia * self._acceleration + self._stiffness * wanted + integral
        if not -most < tau < most:
            return math.copysign(most, tau)
        if not self.standing or not -DEAD_BAND < error < DEAD_BAND:
            self._integral = integral + self._integration * wanted * dt
        return tau

    @property
    def settled(self) -> bool:
        """Whether a joint that stands still gets the same torque from now on."""
        return self.standing and -DEAD_BAND < self.error < DEAD_BAND

    def _pass(self, a: float, b: float, c: float) -> None:
        """Interpolate between these set points from now on."""
        self._points = a, b, c
        self.standing = a == b == c
        self.reference = self._from = 0.5 * (a + b)
        self.velocity = self._rise = (b - a) / self.period
        self._acceleration = (a - 2.0 * b + c) / (self.period * self.period)

    def _interpolate(self, dt: float) -> None:
        since = self._since + dt
        # A SYNC is missing: as if the last set point had come again.
        if since > self.period + 1e-9:
            _, b, c = self._points
            self._pass(b, c, c)
            since -= self.period
        self._since = since
        since += CYCLE - dt
        self.velocity = speed = self._rise + self._acceleration * since
        self.reference = self._from + 0.5 * (self._rise + speed) * since

    def _decelerate(self, dt: float) -> None:
        assert self._ramp is not None
        before = self.velocity
        change = self._ramp * dt
        self.velocity = 0.0 if abs(before) <= change else before - math.copysign(change, before)
        self._acceleration = (self.velocity - before) / dt
        self.standing = before == 0.0
        self.reference += 0.5 * (before + self.velocity) * dt


# --- drives and inputs on the bus ---

# The digital-input node on the arm's bus (CiA 401): light barrier in the cup and arm-power chain.


class DigitalInputs(CanopenNode):
    """Eight inputs in object 6000h:1, sent on change and by the event timer (1800h:5, ms)."""

    BALL: Final = 0x01
    """Light barrier interrupted: something is in the cup."""
    POWER: Final = 0x02
    """Arm-power chain closed."""

    def __init__(self) -> None:
        super().__init__(INPUTS_NODE, "digital_inputs.eds")
        self.inputs = self.POWER
        self._sent = -1
        self._due = 0.0

    def put(self, mask: int, on: bool) -> None:
        """Set or clear inputs."""
        self.inputs = self.inputs | mask if on else self.inputs & ~mask

    def before_sending(self) -> None:
        """Update object 6000h:1."""
        if self.values[0x6000, 1] != self.inputs:
            self.values[0x6000, 1] = self.inputs
            self.changed()

    def due(self) -> float:
        """Return when to act next: at once while a change is not sent yet."""
        if self.tpdo.synchronous:
            return super().due()
        if self.inputs != self._sent:
            return -math.inf
        return min(super().due(), self._due) if self.values[0x1800, 5] else super().due()

    def advance(self, now: float) -> None:
        """Send on change, and again when the event timer is due."""
        super().advance(now)
        timer = self.values[0x1800, 5] * 1e-3
        if not self.tpdo.synchronous and (
            self.inputs != self._sent or (timer and now >= self._due)
        ):
            before = len(self.outbox)
            self.send_tpdo()
            if len(self.outbox) > before:
                self._sent, self._due = self.inputs, now + timer


INPUTS_NODE: Final = 7
"""Node id of the digital inputs; the drives have 1 to 6, base to flange."""

SYNC_PATIENCE: Final = 10
"""Periods of 1006h without SYNC after which an enabled drive stops by itself. 40 ms at 250 Hz:
shorter than three periods of the set-point stream, longer than the occasional delay of a master on
ordinary Linux."""

_STATUSWORD: Final = (int(ObjectIndex.STATUSWORD), 0)
_CONTROLWORD: Final = (int(ObjectIndex.CONTROLWORD), 0)
_POSITION, _VELOCITY, _TORQUE, _TARGET = (
    (int(ObjectIndex.POSITION), 0),
    (int(ObjectIndex.VELOCITY), 0),
    (int(ObjectIndex.TORQUE), 0),
    (int(ObjectIndex.TARGET_POSITION), 0),
)
_ENABLED: Final = DriveState.OPERATION_ENABLED
_OPERATIONAL: Final = NmtState.OPERATIONAL
_RPDO_KEYS, _TPDO_KEYS = (
    tuple((int(one.index), one.sub) for one in mapped) for mapped in (RECEIVED, SENT)
)
_LIMIT, _ERROR = int(StatusBit.INTERNAL_LIMIT), int(StatusBit.FOLLOWING_ERROR)


class Plant(Protocol):
    """The arm as its drives see it: angles (rad), speeds (rad/s) and torques (N m) per joint, and
    the joints' brakes."""

    @property
    def q(self) -> Sequence[float]:
        """Angles."""

    @property
    def qd(self) -> Sequence[float]:
        """Speeds."""

    def brake(self, joint: int) -> None:
        """Engage a joint's brake and switch its torque off."""

    def release(self, joint: int) -> None:
        """Release a joint's brake."""

    def slow_down(self, factor: float) -> None:
        """Limit the joints to this share of their greatest speeds from now on."""

    def step(self, dt: float, tau: Sequence[float]) -> None:
        """Advance by `dt` seconds under six torques."""


def ratings(table: Mapping[str, Any]) -> tuple[DriveRating, ...]:
    """Return the drives of an arm whose `[[joint]]` tables give torque (N m), speed (degrees/s) and
    inertia (kg m^2)."""
    return tuple(
        DriveRating(float(joint["torque"]), math.radians(joint["speed"]), float(joint["inertia"]))
        for joint in table["joint"]
    )


class ServoDrive(PowerDrive):
    """Drive of one joint: cyclic synchronous position mode around a `JointServo`."""

    mode = OperationMode.CYCLIC_SYNCHRONOUS_POSITION
    fixed = (ObjectIndex.MODE, ObjectIndex.INTERPOLATION_PERIOD, ObjectIndex.SOFTWARE_LIMITS)

    def __init__(
        self, joint: int, rating: DriveRating, plant: Plant, stir: Callable[[], None]
    ) -> None:
        """`stir` is called whenever something happens that may change the torque of a joint at
        rest."""
        super().__init__(joint + 1, "joint_drive.eds", SYNC_PATIENCE, stir)
        self.joint = joint
        self.plant = plant
        self._shown: tuple[int, float, float, float] | None = None
        self._said: tuple[int, float, float] | None = None
        """Status, angle and torque in the TPDO that `sync` made last, if no object has changed
        since."""
        self._usual = False
        """Whether both PDOs have the layout that masters of this profile use, and are
        synchronous."""
        self.servo = JointServo(rating, plant.q[joint])
        self._speed_factor = 1.0
        self._torque = 0.0
        self._error_since: float | None = None
        self.after_configuring()

    # Hooks of the CANopen node.
    def before_sending(self) -> None:
        """Update status, position, speed and torque."""
        plant, joint = self.plant, self.joint
        usual = (
            self.state is _ENABLED
            and self.powered
            and not self.servo.limited
            and self._error_since is None
        )
        word = RUNNING if usual else self.statusword()
        shown = _, q, qd, torque = word, plant.q[joint], plant.qd[joint], self._torque
        if shown == self._shown:
            return
        self._shown = shown
        values = self.values
        values[_STATUSWORD] = word
        values[_POSITION] = round(q * UNITS)
        values[_VELOCITY] = round(qd * UNITS)
        values[_TORQUE] = round(1000.0 * torque / self.servo.rating.torque)
        self.changed()

    def before_reading(self) -> None:
        super().before_reading()
        self.values[ObjectIndex.FOLLOWING_ERROR, 0] = to_units(self.servo.error)

    def changed(self) -> None:
        self._said = None
        super().changed()

    def sync(self, now: float) -> None:
        """Process SYNC.

        Fast path for a drive that follows its set points with the usual PDOs, since six drives run
        it in every cycle: it does at once what the base class does in steps, with the same bytes.
        Objects that are not read in between are updated when they are read.
        """
        if not (
            self._usual and self.state is _ENABLED and self.nmt is _OPERATIONAL and self._goes_on()
        ):
            super().sync(now)
            return
        self.on_sync(now)
        servo = self.servo
        usual = self.powered and not servo.limited and self._error_since is None
        word = RUNNING if usual else self.statusword()
        q, torque, frame = self.plant.q[self.joint], self._torque, self._tpdo_frame
        said = word, q, torque
        if frame is None or said != self._said:
            self._said, self._shown = said, None
            data = self.tpdo.layout.pack(
                word, round(q * UNITS), round(1000.0 * torque / servo.rating.torque)
            )
            self._tpdo_frame = frame = Frame(self.tpdo.cob_id, data)
        self.outbox.append(frame)

    def _goes_on(self) -> bool:
        """Take the RPDO's set point if its controlword only continues the motion; else leave
        everything unchanged."""
        data = self._latched
        if data is not None and data != self._applied:
            word, target = self.rpdo.layout.unpack_from(data)
            if word & ENABLE_MASK != ENABLE:
                return False
            self._applied, values = data, self.values
            self._controlword = values[_CONTROLWORD] = word
            values[_TARGET] = target
        elif data is not None and self._controlword & ENABLE_MASK != ENABLE:
            return False
        self._latched = None
        return True

    def on_sync(self, now: float) -> None:
        """Take a new set point."""
        self._synced = now
        if self.state is _ENABLED:
            servo = self.servo
            servo.aim(self._target())
            if not servo.standing:
                self.stir()

    def repeat(self, now: float, answer: Frame) -> None:
        """Answer SYNC with the same frame: the set point is the same and the joint is at rest."""
        self._synced = now
        self.outbox.append(answer)

    @property
    def tpdo_sent(self) -> Frame | None:
        """The TPDO sent last, if it was the last frame sent and is not fetched yet."""
        frame = self._tpdo_frame
        return frame if frame is not None and self.outbox and self.outbox[-1] is frame else None

    def after_configuring(self) -> None:
        super().after_configuring()
        values, rpdo, tpdo = self.values, self.rpdo, self.tpdo
        self._usual = rpdo.synchronous and tpdo.on and tpdo.synchronous
        self._usual = self._usual and (rpdo.keys, tpdo.keys) == (_RPDO_KEYS, _TPDO_KEYS)
        self._window = values[ObjectIndex.FOLLOWING_ERROR_WINDOW, 0] / UNITS
        self._patience = values[ObjectIndex.FOLLOWING_ERROR_TIMEOUT, 0] * 1e-3
        self._range = values[ObjectIndex.SOFTWARE_LIMITS, 1], values[ObjectIndex.SOFTWARE_LIMITS, 2]
        if values[ObjectIndex.INTERPOLATION_PERIOD, 1]:
            self.servo.period = (
                values[ObjectIndex.INTERPOLATION_PERIOD, 1]
                * 10.0 ** values[ObjectIndex.INTERPOLATION_PERIOD, 2]
            )
        self.stir()

    # Hooks of the state machine.
    def begin(self, resumed: bool) -> None:
        """Hold here, or take set points again from where the ramp has ended."""
        if resumed:
            self.servo.follow(self._target())
        else:
            self.servo.start(self.plant.q[self.joint])
        self._error_since = None
        self.plant.release(self.joint)

    def ramp_down(self, deceleration: float) -> None:
        self.servo.ramp_down(deceleration)

    def cut_power(self) -> None:
        self._torque = 0.0
        self.plant.brake(self.joint)

    def flags(self) -> int:
        """Return whether set points are cut, and whether the following error is too large."""
        limit = _LIMIT if self.servo.limited else 0
        return limit | _ERROR if self._error_since is not None else limit

    def refresh(self) -> None:
        """Update all objects, the greatest speed too."""
        self._shown = None
        self.servo.limit = self.servo.rating.speed * self._speed_factor
        self.values[ObjectIndex.MAX_SPEED, 0] = to_units(self.servo.limit)
        self.stir()

    # What the laboratory does to a drive.
    def slow_down(self, factor: float) -> None:
        """Supply only a share of the rated speed from now on; object 607Fh reports it."""
        self._speed_factor = factor
        self.refresh()

    def torque(self, now: float, dt: float, q: float, qd: float) -> float:
        """Return the torque of the next `dt` seconds (N m) from the joint's angle and speed; 0
        without power."""
        state = self.state
        if state is not _ENABLED and state not in POWERED:
            return 0.0
        servo = self.servo
        self._torque = tau = servo.torque(q, qd, dt)
        if state is _ENABLED:
            late, window = now - self._synced > self._sync_patience + 1e-9, self._window
            if late or self._error_since is not None or not -window <= servo.error <= window:
                self._watch(now, late)
        elif state is DriveState.FAULT_REACTION_ACTIVE and servo.ramped_down and abs(qd) < 0.02:
            self.ramp_ended()
        return tau

    @property
    def settled(self) -> bool:
        """Whether the torque of a joint at rest stays the same unless something happens."""
        if self.state not in POWERED:
            return True
        return (
            self.servo.settled
            and self._error_since is None
            and self.state is not DriveState.FAULT_REACTION_ACTIVE
        )

    def _watch(self, now: float, late: bool) -> None:
        """Watch following error (6065h, 6066h) and loss of SYNC (1006h)."""
        if late:
            self.trip(DriveFault.SYNC_LOST)
        elif -self._window <= self.servo.error <= self._window:
            self._error_since = None
        elif self._error_since is None:
            self._error_since = now
        elif now - self._error_since >= self._patience:
            self.trip(DriveFault.FOLLOWING_ERROR)

    def _target(self) -> float:
        """Return object 607Ah within the software limits 607Dh, in rad."""
        (low, high), target = self._range, self.values[_TARGET]
        return (low if target < low else high if target > high else target) / UNITS


class ArmBus(DriveBus[ServoDrive]):
    """Everything on the arm's bus except the master: six drives (nodes 1 to 6) and the digital
    inputs (node 7).

    In each step of the plant (1 kHz or faster): `receive` the frames, then `step(now, dt)`, which
    also moves the plant, then send what `drain` returns. Times are seconds on the caller's clock.
    An arm that stands still under constant torques is at rest: until something stirs it, a step
    would change nothing and is skipped.
    """

    def __init__(self, plant: Plant, drives: Sequence[DriveRating]) -> None:
        self.plant = plant
        self._resting, self._stirred = False, True
        self._rests_until = -math.inf
        self._tau: list[float] = []
        self._odd = False
        self._heard: Sequence[Frame] = ()
        self._echoes: Sequence[Frame] = ()
        """Set points of the newest cycle that found and left the arm at rest, and the answers, one
        per drive."""
        self.inputs = DigitalInputs()
        super().__init__(
            tuple(ServoDrive(joint, each, plant, self._stir) for joint, each in enumerate(drives)),
            self.inputs,
        )

    def receive_cycle(self, now: float, frames: Sequence[Frame]) -> None:
        """Process the frames of one cycle of the master. Drives at rest that receive the same
        frames again repeat their answers."""
        if self._echoes and frames == self._heard and self._resting:
            for drive, echo in zip(self.drives, self._echoes, strict=True):
                drive.repeat(now, echo)
            self._rests_until = self._awaited()
            return
        resting, self._odd, self._echoes = self._resting, False, ()
        for frame in frames:
            self.receive(now, frame)
        if resting and self._resting and not self._odd and not self.inputs.tpdo.synchronous:
            self._heard, self._echoes = frames, self._answers()

    def _answers(self) -> Sequence[Frame]:
        """Return what each drive has just sent, nothing if one of them sent nothing."""
        sent = [drive.tpdo_sent for drive in self.drives]
        return [frame for frame in sent if frame is not None] if None not in sent else ()

    def _sync(self, now: float) -> None:
        super()._sync(now)
        if self._resting:
            self._rests_until = self._awaited()

    def _awaited(self) -> float:
        """Return when the first drive misses SYNC (s)."""
        return min([drive.waits_until for drive in self.drives])

    def _spread(self, now: float, frame: Frame) -> None:
        self._odd = True
        super()._spread(now, frame)

    def step(self, now: float, dt: float) -> None:
        """Compute torques for `dt` seconds, move the plant, and run what the devices do on time."""
        if now >= self._due:
            for node in self._nodes:
                node.advance(now)
            self._due = min([node.due() for node in self._nodes])
        if self._resting and now <= self._rests_until:
            return
        plant, before, self._stirred = self.plant, self._tau, False
        moving = any(plant.qd)
        self._tau = tau = [
            drive.torque(now, dt, q, qd)
            for drive, q, qd in zip(self.drives, plant.q, plant.qd, strict=True)
        ]
        plant.step(dt, tau)
        if not (moving or self._stirred or tau != before or any(plant.qd)):
            self._resting = all(drive.settled for drive in self.drives)
            self._rests_until = self._awaited()

    def _stir(self) -> None:
        self._resting, self._stirred = False, True
        self._echoes = ()

    def ball(self, present: bool) -> None:
        """Set the light barrier in the cup: interrupted or free."""
        self._put(DigitalInputs.BALL, present)

    def power(self, closed: bool) -> None:
        self._put(DigitalInputs.POWER, closed)
        self._echoes = ()
        super().power(closed)

    def _put(self, mask: int, on: bool) -> None:
        if bool(self.inputs.inputs & mask) is not on:
            self.inputs.put(mask, on)
            self._due = -math.inf

    def slow_down(self, factor: float) -> None:
        """Limit drives and plant to this share (0 to 1] of their speeds."""
        self.plant.slow_down(factor)
        for drive in self.drives:
            drive.slow_down(factor)
