"""Feetech STS3215 bus servos, sans-I/O: register map, protocol, motion, protection.

The protocol and the registers are those of the STS memory table (Feetech, magnetic encoder series).
A servo is a DC motor whose duty cycle is proportional to its position error: at a steady state the
duty is what the load needs, and a blocked servo pushes with its torque limit. Stiffness, friction
and stall torque were identified by others for this servo (Simulation/SO101/joints_properties.xml of
TheRobotStudio/SO-ARM100: 17.8 N m/rad, 0.052 N m, 3.35 N m).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from msgspec import Struct, field

STEPS: Final = 4096
"""Positions of one turn of the shaft."""
NO_LOAD_SPEED: Final = 3400.0
"""steps/s at full duty without load: 50 turns a minute at 7.4 V (data sheet)."""
STALL_TORQUE: Final = 3.35
"""Torque at full duty (N m)."""
FULL_DUTY_ERROR: Final = STALL_TORQUE / 17.8 / (2 * math.pi) * STEPS
"""Position error (steps) with full duty at the default coefficient P = 32."""
FRICTION: Final = 0.052 / STALL_TORQUE
"""Share of the stall torque that friction takes."""
AMBIENT, STALL_RISE, WARMING = 25.0, 55.0, 200.0
"""deg C, K of a servo that stalls for ever, time constant (s): chosen, not identified."""

# Registers (address; those of two bytes are little endian)
MODEL, ID, RETURN_LEVEL, MOST_HEAT, MOST_TORQUE, UNLOADING = 3, 5, 8, 13, 16, 19
P_GAIN, OFFSET, SAFE_TORQUE, SAFE_TIME, OVERLOAD_TORQUE = 21, 31, 34, 35, 36
TORQUE, ACCELERATION, GOAL, GOAL_SPEED, TORQUE_LIMIT, LOCK = 40, 41, 42, 46, 48, 55
POSITION, SPEED, LOAD, VOLTAGE, HEAT, STATUS, MOVING = 56, 58, 60, 62, 63, 65, 66
SIZE: Final = 87
READ_ONLY: Final = frozenset((*range(5), *range(POSITION, 80)))
CENTRE: Final = 128
"""Written to TORQUE: make the present position 2048 by the offset."""
DEFAULTS: Final = {
    0: (3, 9), MODEL: (9, 3), 8: (1,), 9: (0, 0, 255, 15), MOST_HEAT: (70, 80, 40),
    MOST_TORQUE: (232, 3), 18: (12, 44, 47, 32, 32, 0), 24: (16, 0), 26: (1, 1), 28: (244, 1, 1),
    SAFE_TORQUE: (20, 200, 80), TORQUE_LIMIT: (232, 3), LOCK: (1,),
}  # fmt: skip
VOLTAGE_BAD, HEAT_BAD, OVERLOAD = 1, 4, 32
"""Bits of a status packet's error byte."""

PING, READ, WRITE, REG_WRITE, ACTION, SYNC_READ, SYNC_WRITE = 1, 2, 3, 4, 5, 0x82, 0x83
BROADCAST: Final = 0xFE


def signed(value: int, bit: int) -> int:
    """Return a number whose sign is in `bit`, its magnitude below it."""
    return -(value & (1 << bit) - 1) if value >> bit & 1 else value


def unsigned(value: float, bit: int) -> int:
    """Return the register of a number whose sign is in `bit`."""
    whole = min(abs(round(value)), (1 << bit) - 1)
    return whole | (value < 0 and whole > 0) << bit


class Servo(Struct):
    """One servo. What the world does to it is `external`, `low`, `high`; what it does to the world
    is `angle` and `torque`."""

    id: int
    position: float = 2048.0
    """True angle of the shaft (steps), without the offset."""
    external: float = 0.0
    """Torque on the shaft (share of the stall torque), positive towards larger positions."""
    low: float = -math.inf
    high: float = math.inf
    """Stops: the shaft cannot leave them (steps). A gripper that holds a part has one there."""
    voltage: float = 7.4
    heat: float = AMBIENT
    """deg C."""
    connected: bool = True
    """False: its cable is off, it answers nothing and has no power."""
    duty: float = 0.0
    """Duty cycle of the motor, -1 to 1: also what the servo reports as its load."""
    speed: float = 0.0
    """steps/s."""
    fault: int = 0
    memory: bytearray = field(default_factory=lambda: bytearray(SIZE))
    _profile: float = 2048.0
    _profile_speed: float = 0.0
    _overload: float = 0.0
    _pending: tuple[int, bytes] | None = None

    def __post_init__(self) -> None:
        for address, values in DEFAULTS.items():
            self.memory[address : address + len(values)] = bytes(values)
        self.memory[ID] = self.id
        self._profile = self.position
        self._put(GOAL, unsigned(self.position, 15))
        self._report()

    @property
    def angle(self) -> float:
        """True angle of the shaft (rad), 0 at 2048 steps."""
        return (self.position - 2048.0) * 2 * math.pi / STEPS

    @angle.setter
    def angle(self, value: float) -> None:
        self.position = self._profile = 2048.0 + value / (2 * math.pi) * STEPS
        self._put(GOAL, unsigned(self.position - self.offset, 15))

    @property
    def torque(self) -> float:
        """Torque of the motor (N m): while it stalls, that on what blocks it."""
        return (self.duty - self.speed / NO_LOAD_SPEED) * STALL_TORQUE

    @property
    def offset(self) -> int:
        """Steps subtracted from the true position before it is reported."""
        return signed(self._word(OFFSET), 11)

    def read(self, address: int, size: int) -> bytes:
        """Return registers."""
        self._report()
        return bytes(self.memory[address : address + size]).ljust(size, b"\0")

    def write(self, address: int, data: bytes) -> None:
        """Write registers, as far as they may be written. EEPROM is kept while LOCK is set only
        until power is lost; that loss is not simulated."""
        torque = self.memory[TORQUE]
        for at, value in enumerate(data, address):
            if at not in READ_ONLY and at < SIZE:
                self.memory[at] = value
        end = address + len(data)
        if address <= TORQUE < end:
            if self.memory[TORQUE] == CENTRE:
                self.memory[TORQUE] = torque
                self._put(OFFSET, unsigned(self.position - 2048, 11))
                self._put(GOAL, 2048)
            elif self.memory[TORQUE] and not torque:
                self._profile, self._profile_speed = self.position, 0.0
            self.fault, self._overload = 0, 0.0
        if address < GOAL + 2 and end > GOAL and self.fault & OVERLOAD and self._opens():
            self.fault &= ~OVERLOAD

    def _opens(self) -> bool:
        """Whether the goal leads away from what overloaded it."""
        return (self._goal() - self.position) * self.duty < 0.0

    def advance(self, dt: float) -> None:
        """Let `dt` seconds pass."""
        if not self.connected:
            self.memory[TORQUE] = 0  # without power it forgets
        on = bool(self.memory[TORQUE])
        if on:
            self._move_profile(dt)
            limit = min(self._word(TORQUE_LIMIT), self._word(MOST_TORQUE)) / 1000
            if self.fault & OVERLOAD:
                limit = min(limit, self.memory[SAFE_TORQUE] / 100)
            stiffness = self.memory[P_GAIN] / 32 / FULL_DUTY_ERROR
            wish = stiffness * (self._profile - self.position)
            self.duty = min(limit, max(-limit, wish))
        else:
            self._profile, self._profile_speed, self.duty = self.position, 0.0, 0.0
        net = self.duty + self.external
        net = math.copysign(max(0.0, abs(net) - FRICTION), net)
        before = self.position
        self.position = min(self.high, max(self.low, before + net * NO_LOAD_SPEED * dt))
        self.speed = (self.position - before) / dt if dt else 0.0
        self._protect(dt)

    def _move_profile(self, dt: float) -> None:
        """Lead the set point to the goal by a trapezoid of speed."""
        left = self._goal() - self._profile
        fastest = min(abs(signed(self._word(GOAL_SPEED), 15)) or NO_LOAD_SPEED, NO_LOAD_SPEED)
        change = 100.0 * (self.memory[ACCELERATION] or 254)
        braking = math.sqrt(2 * change * abs(left))
        wish = math.copysign(min(fastest, braking, abs(left) / dt), left) if dt else 0.0
        step = change * dt
        self._profile_speed += min(step, max(-step, wish - self._profile_speed))
        if abs(wish) * dt >= abs(left) and abs(self._profile_speed) <= fastest:
            self._profile_speed = wish  # the last step ends on the goal
        self._profile += self._profile_speed * dt

    def _protect(self, dt: float) -> None:
        self.heat += dt / WARMING * (AMBIENT + STALL_RISE * self.duty**2 - self.heat)
        self.fault &= ~VOLTAGE_BAD
        if not self.memory[15] <= self.voltage * 10 <= self.memory[14]:
            self.fault |= VOLTAGE_BAD
        over = abs(self.duty) * 100 > self.memory[OVERLOAD_TORQUE]
        self._overload = self._overload + dt if over else 0.0
        if self._overload * 100 > self.memory[SAFE_TIME]:
            self.fault |= OVERLOAD
        if self.heat > self.memory[MOST_HEAT]:
            self.fault |= HEAT_BAD
            if self.memory[UNLOADING] & HEAT_BAD:
                self.memory[TORQUE] = 0

    def _goal(self) -> float:
        return signed(self._word(GOAL), 15) + self.offset

    def _report(self) -> None:
        """Bring the registers of what is measured up to date."""
        self._put(POSITION, unsigned(self.position - self.offset, 15))
        self._put(SPEED, unsigned(self.speed, 15))
        self._put(LOAD, unsigned(self.duty * 1000, 10))
        self.memory[VOLTAGE] = max(0, min(255, round(self.voltage * 10)))
        self.memory[HEAT] = max(0, min(255, round(self.heat)))
        self.memory[STATUS] = self.fault
        self.memory[MOVING] = abs(self._profile_speed) > 0.0 or abs(self.speed) > 20.0

    def _word(self, address: int) -> int:
        return int.from_bytes(self.memory[address : address + 2], "little")

    def _put(self, address: int, value: int) -> None:
        self.memory[address : address + 2] = value.to_bytes(2, "little")

    def answer(self, instruction: int, content: bytes) -> bytes | None:
        """Do an instruction; return what its status packet carries, None if it sends none."""
        if instruction == PING:
            return b""
        if instruction == READ and len(content) == 2:
            return self.read(*content)
        if instruction == WRITE and len(content) > 1:
            self.write(content[0], content[1:])
        elif instruction == REG_WRITE and len(content) > 1:
            self._pending = content[0], content[1:]
        elif instruction == ACTION and self._pending:
            self.write(*self._pending)
            self._pending = None
        return b"" if self.memory[RETURN_LEVEL] else None


class FeetechBus:
    """Servos on one half-duplex line: bytes of the master in, bytes of the servos out."""

    def __init__(
        self, servos: Iterable[Servo], *, chained: bool = False, echo: bool = False
    ) -> None:
        """`chained`: in a sync read a servo after a missing one does not answer. `echo`: the
        adapter returns what it sends, as the simplest ones do."""
        self.servos = {servo.id: servo for servo in servos}
        self.noise: Callable[[bytes], bytes] = lambda answer: answer
        """Changes each answer on its way to the master: a test can spoil answers with it."""
        self._chained, self._echo = chained, echo
        self._buffer = bytearray()

    def receive(self, data: bytes) -> bytes:
        """Take bytes of the master; return the answers."""
        self._buffer += data
        out = data if self._echo else b""
        while frame := self._next():
            out += self._handle(*frame)
        return self.noise(out) if out else b""

    def advance(self, dt: float) -> None:
        """Let `dt` seconds pass."""
        for servo in self.servos.values():
            servo.advance(dt)

    def _next(self) -> tuple[int, int, bytes] | None:
        """Cut the next valid instruction packet: servo, instruction, content."""
        buffer = self._buffer
        while True:
            start = buffer.find(b"\xff\xff")
            if start < 0:
                del buffer[: max(0, len(buffer) - 1)]
                return None
            del buffer[:start]
            if len(buffer) < 4:
                return None
            if buffer[2] == 0xFF or buffer[3] < 2:
                del buffer[0]
                continue
            end = buffer[3] + 4
            if len(buffer) < end:
                return None
            if sum(buffer[2:end]) & 0xFF != 0xFF:
                del buffer[0]
                continue
            found = buffer[2], buffer[4], bytes(buffer[5 : end - 1])
            del buffer[:end]
            return found

    def _handle(self, target: int, instruction: int, content: bytes) -> bytes:
        if instruction == SYNC_READ:
            return self._sync_read(content)
        if instruction == SYNC_WRITE:
            self._sync_write(content)
            return b""
        there = [s for s in self.servos.values() if s.connected and target in (s.memory[ID], 0xFE)]
        answers = [(s, s.answer(instruction, content)) for s in there]
        return b"".join(
            status(s, answer)
            for s, answer in answers
            if answer is not None and (target != BROADCAST or instruction == PING)
        )

    def _sync_read(self, content: bytes) -> bytes:
        out = b""
        if len(content) < 2:
            return out
        for number in content[2:]:
            servo = next((s for s in self.servos.values() if s.memory[ID] == number), None)
            if servo is not None and servo.connected:
                out += status(servo, servo.read(content[0], content[1]))
            elif self._chained:
                break
        return out

    def _sync_write(self, content: bytes) -> None:
        if len(content) < 2:
            return
        address, size = content[0], content[1]
        for at in range(2, len(content) - size, size + 1):
            for servo in self.servos.values():
                if servo.memory[ID] == content[at] and servo.connected:
                    servo.write(address, content[at + 1 : at + 1 + size])


def status(servo: Servo, content: bytes) -> bytes:
    """Return the status packet of a servo."""
    body = bytes((servo.memory[ID], len(content) + 2, servo.fault)) + content
    return b"\xff\xff" + body + bytes((~sum(body) & 0xFF,))


def so101(angles: Sequence[float] = (0.0,) * 6) -> FeetechBus:
    """Return the bus of a SO-101: six servos with the ids 1 to 6, at these angles (rad)."""
    bus = FeetechBus(Servo(number) for number in range(1, len(angles) + 1))
    for servo, angle in zip(bus.servos.values(), angles, strict=True):
        servo.angle = angle
    return bus
