"""A simulated controller of a Universal Robots arm: RTDE, dashboard, and the adapter's program.

`UrController` is without sockets: `connect(port)` gives a `ControllerSession`, whose `receive`
takes bytes and whose `drain` gives the answers; `advance(now)` moves the joints. `UrServer` serves
it over TCP; `python -m petrobot.sim.bus.ur_controller HOST RTDE DASHBOARD PROGRAM` is that as a
process.

It does not interpret URScript. A program that reads set points with `servoj` from the registers of
the adapter is followed as the adapter's own program says; any other is accepted and does nothing.
Sources: "Real-Time Data Exchange (RTDE) Guide" and "Dashboard Server e-Series" of Universal Robots.
"""

from __future__ import annotations

import re
import struct
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

from petrobot.sim.bus.lines import TcpServer

RTDE_PORT: Final = 30004
DASHBOARD_PORT: Final = 29999
PROGRAM_PORT: Final = 30002
PORTS: Final = (RTDE_PORT, DASHBOARD_PORT, PROGRAM_PORT)
STEP: Final = 0.002
"""Time between two cycles of the joints (s)."""
TOP_SPEED: Final = 3.14
"""Greatest speed of each joint (rad/s)."""
TOP_ACCELERATION: Final = 25.0
"""rad/s^2 of each joint."""
SUDDEN: Final = 0.35
"""Distance of a joint from its set point that causes a protective stop (rad)."""
POWER_OFF, IDLE, RUNNING = 3, 5, 7
NORMAL, PROTECTIVE, EMERGENCY = 1, 3, 7
MODES = {POWER_OFF: "POWER_OFF", IDLE: "IDLE", RUNNING: "RUNNING"}
SAFETY = {NORMAL: "NORMAL", PROTECTIVE: "PROTECTIVE_STOP", EMERGENCY: "ROBOT_EMERGENCY_STOP"}

FORMS = {"DOUBLE": "d", "VECTOR6D": "6d", "INT32": "i", "UINT32": "I", "UINT64": "Q", "UINT8": "B"}
OUTPUTS = {
    "timestamp": "DOUBLE",
    "target_q": "VECTOR6D",
    "target_qd": "VECTOR6D",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "actual_TCP_pose": "VECTOR6D",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "runtime_state": "UINT32",
    "robot_status_bits": "UINT32",
    "safety_status_bits": "UINT32",
    "speed_scaling": "DOUBLE",
    "actual_digital_input_bits": "UINT64",
    "actual_digital_output_bits": "UINT64",
    **{f"output_int_register_{n}": "INT32" for n in range(48)},
    **{f"output_double_register_{n}": "DOUBLE" for n in range(48)},
}
INPUTS = {
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    **{f"input_int_register_{n}": "INT32" for n in range(48)},
    **{f"input_double_register_{n}": "DOUBLE" for n in range(48)},
}


class ControllerSession:
    """One connection to a port of the controller."""

    def __init__(self, take: Callable[[bytes], bytes], hello: bytes = b"") -> None:
        self._take, self._out = take, bytearray(hello)
        self.closed = False

    def receive(self, data: bytes) -> None:
        """Take bytes of the client."""
        self.send(self._take(data))

    def send(self, data: bytes) -> None:
        """Queue bytes for the client."""
        self._out += data

    def drain(self) -> bytes:
        """Return the bytes for the client."""
        out = bytes(self._out)
        self._out.clear()
        return out


class UrController:
    """The arm and its controller; its `actual_TCP_pose` is always zero."""

    def __init__(
        self,
        q: Sequence[float] = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0),
        robot_mode: int = POWER_OFF,
    ) -> None:
        self.q, self.qd = list(q), [0.0] * 6
        self.robot_mode, self.safety_mode = robot_mode, NORMAL
        self.digital_in = self.digital_out = 0
        self.program = ""
        """Text of the running program, empty if none runs."""
        self.programs = 0
        """How many programs were accepted."""
        self.inputs: dict[str, Any] = {}
        self.outputs: dict[str, Any] = {}
        """Registers that the program writes, by name."""
        self.now = 0.0
        self._target = list(q)
        self._text = ""
        self._silent, self._beat, self._patience = 0.0, -1, 0.1
        self._clients: list[_Rtde] = []
        self._due_mode: tuple[float, int] | None = None

    # What happens to it

    def protective_stop(self) -> None:
        """Stop as after a collision: program ended, until it is unlocked."""
        self._stop(PROTECTIVE)

    def emergency_stop(self) -> None:
        """Press the mushroom button: power off."""
        self._stop(EMERGENCY)
        self.robot_mode = POWER_OFF

    def _stop(self, safety: int) -> None:
        self.safety_mode, self.program, self.qd = safety, "", [0.0] * 6

    def connect(self, port: int) -> ControllerSession:
        """Return a new connection to the RTDE, dashboard or program port."""
        if port == RTDE_PORT:
            client = _Rtde(self)
            client.session = ControllerSession(client.take)
            self._clients.append(client)
            return client.session
        if port == DASHBOARD_PORT:
            hello = b"Connected: Universal Robots Dashboard Server\n"
            return ControllerSession(_Lines(self._dashboard).take, hello)
        return ControllerSession(self._load)

    def advance(self, now: float) -> None:
        """Let time pass until `now` (s)."""
        if now - self.now > 1.0:
            self.now = now - STEP  # it was not looked after: it does not catch up
        while self.now + STEP <= now + 1e-9:
            self.now += STEP
            if self._due_mode is not None and self.now >= self._due_mode[0]:
                self.robot_mode, self._due_mode = self._due_mode[1], None
            self._cycle()
            for client in [c for c in self._clients if c.session.closed]:
                self._clients.remove(client)
            for client in self._clients:
                client.advance(self.now)

    # The arm

    def _cycle(self) -> None:
        wanted = self._follow()
        for joint, goal in enumerate(self._target):
            speed = max(-TOP_SPEED, min(TOP_SPEED, (goal - self.q[joint]) / 0.016))
            speed = speed if wanted else 0.0
            most = TOP_ACCELERATION * STEP
            speed = self.qd[joint] + max(-most, min(most, speed - self.qd[joint]))
            if self.robot_mode != RUNNING:
                speed = 0.0
            self.qd[joint], self.q[joint] = speed, self.q[joint] + speed * STEP

    def _follow(self) -> bool:
        """One cycle of the program; whether the joints follow set points."""
        if not self.program or self.robot_mode != RUNNING or self.safety_mode != NORMAL:
            self._target = list(self.q)
            return False
        beat = self.inputs.get("input_int_register_24", 0)
        self._silent = 0.0 if beat != self._beat else self._silent + STEP
        self._beat = beat
        self.outputs["output_int_register_24"] = beat
        moves = self.inputs.get("input_int_register_25", 0) == 1 and self._silent < self._patience
        self.outputs["output_int_register_25"] = int(moves)
        if not moves:
            self._target = list(self.q)
            return False
        goal = [self.inputs.get(f"input_double_register_{24 + n}", 0.0) for n in range(6)]
        if max(abs(a - b) for a, b in zip(goal, self.q, strict=True)) > SUDDEN:
            self.protective_stop()
            return False
        self._target = goal
        return True

    def values(self) -> dict[str, Any]:
        """Return all output fields."""
        playing = bool(self.program)
        return {
            "timestamp": self.now,
            "target_q": self._target,
            "target_qd": self.qd,
            "actual_q": self.q,
            "actual_qd": self.qd,
            "actual_TCP_pose": [0.0] * 6,
            "robot_mode": self.robot_mode,
            "safety_mode": self.safety_mode,
            "runtime_state": 2 if playing else 1,
            "robot_status_bits": (self.robot_mode >= IDLE) | playing << 1,
            "safety_status_bits": 1 if self.safety_mode == NORMAL else 4,
            "speed_scaling": 1.0,
            "actual_digital_input_bits": self.digital_in,
            "actual_digital_output_bits": self.digital_out,
            **self.outputs,
        }

    def take(self, name: str, value: Any) -> None:
        """Set an input field."""
        self.inputs[name] = value
        if name == "standard_digital_output":
            mask = self.inputs.get("standard_digital_output_mask", 0)
            self.digital_out = (self.digital_out & ~mask) | (value & mask)

    # Program and dashboard

    def _load(self, data: bytes) -> bytes:
        text = self._text = self._text + data.decode("utf-8", "replace")
        if re.search(r"^end\s*$", text, re.MULTILINE):
            self._text = ""
            if self.robot_mode == RUNNING and self.safety_mode == NORMAL:
                self.program, self.programs = text, self.programs + 1
                found = re.search(r"patience = ([0-9.]+)", text)
                self._patience, self._silent = float(found[1]) if found else 0.1, 0.0
        return b""

    def _dashboard(self, line: str) -> str:
        normal = self.safety_mode == NORMAL
        if line == "power on":
            if normal and self.robot_mode == POWER_OFF:
                self._due_mode = (self.now + 0.5, IDLE)
            return "Powering on"
        if line == "brake release":
            if normal and self.robot_mode == IDLE:
                self._due_mode = (self.now + 0.3, RUNNING)
            return "Brake releasing"
        if line == "power off":
            self.robot_mode, self.program, self._due_mode = POWER_OFF, "", None
            return "Powering off"
        if line == "unlock protective stop":
            if self.safety_mode == PROTECTIVE:
                self.safety_mode = NORMAL
            return "Protective stop releasing"
        if line == "stop":
            self.program = ""
            return "Stopped"
        answers = {
            "close safety popup": "closing safety popup",
            "robotmode": f"Robotmode: {MODES[self.robot_mode]}",
            "safetystatus": f"Safetystatus: {SAFETY[self.safety_mode]}",
            "safetymode": f"Safetymode: {SAFETY[self.safety_mode]}",
            "running": f"Program running: {str(bool(self.program)).lower()}",
            "programState": ("PLAYING" if self.program else "STOPPED") + " petrobot.urp",
            "PolyscopeVersion": "URSoftware 5.11.0.108249 (Jan 01 2022)",
            "is in remote control": "true",
            "quit": "Disconnected",
        }
        if line.startswith("load "):
            return f"File not found: {line[5:]}"
        return answers.get(line, f"Could not understand: '{line}'")


class _Lines:
    """Answers each line of a text protocol."""

    def __init__(self, answer: Callable[[str], str]) -> None:
        self._answer, self._buffer = answer, b""

    def take(self, data: bytes) -> bytes:
        """Return the answers to the lines that are complete."""
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        told = (self._answer(line.decode("utf-8", "replace").strip()) for line in lines)
        return "".join(f"{each}\n" for each in told).encode()


class _Rtde:
    """The controller's end of one RTDE connection."""

    session: ControllerSession

    def __init__(self, controller: UrController) -> None:
        self._controller = controller
        self._buffer = bytearray()
        self._outputs: list[str] = []
        self._inputs: dict[int, list[str]] = {}
        self._period, self._due, self._runs = 0.008, 0.0, False

    def take(self, data: bytes) -> bytes:
        """Answer the packages that are complete."""
        self._buffer += data
        out = bytearray()
        while len(self._buffer) >= 3:
            size, letter = struct.unpack_from(">HB", self._buffer)
            if size < 3:
                self.session.closed = True
                break
            if len(self._buffer) < size:
                break
            payload = bytes(self._buffer[3:size])
            del self._buffer[:size]
            out += self._answer(chr(letter), payload)
        return bytes(out)

    def _answer(self, letter: str, payload: bytes) -> bytes:
        if letter == "V":
            (version,) = struct.unpack(">H", payload)
            return _package("V", bytes((version in (1, 2),)))
        if letter == "v":
            return _package("v", struct.pack(">4I", 5, 11, 0, 108249))
        if letter == "O":
            (rate,) = struct.unpack_from(">d", payload)
            self._period, self._outputs = 1.0 / max(1.0, min(500.0, rate)), _names(payload[8:])
            types = [OUTPUTS.get(name, "NOT_FOUND") for name in self._outputs]
            return _package("O", bytes(("NOT_FOUND" not in types,)) + ",".join(types).encode())
        if letter == "I":
            names = _names(payload)
            types = [INPUTS.get(name, "NOT_FOUND") for name in names]
            identity = 0 if "NOT_FOUND" in types else len(self._inputs) + 1
            if identity:
                self._inputs[identity] = names
            return _package("I", bytes((identity,)) + ",".join(types).encode())
        if letter in "SP":
            self._runs = letter == "S" and "NOT_FOUND" not in self._outputs
            return _package(letter, b"\x01")
        if letter == "U" and payload and payload[0] in self._inputs:
            self._set(self._inputs[payload[0]], payload[1:])
        return b""

    def _set(self, names: list[str], data: bytes) -> None:
        form = struct.Struct(">" + "".join(FORMS[INPUTS[name]] for name in names))
        if len(data) == form.size:
            for name, value in zip(names, form.unpack(data), strict=True):
                self._controller.take(name, value)

    def advance(self, now: float) -> None:
        """Send the data that is due."""
        if not self._runs or now < self._due:
            return
        self._due = now + self._period - STEP / 2
        values = self._controller.values()
        data = bytearray(b"\x01")
        for name in self._outputs:
            value = values.get(name, 0)
            form = ">" + FORMS[OUTPUTS[name]]
            data += struct.pack(form, *(value if isinstance(value, list | tuple) else (value,)))
        self.session.send(_package("U", bytes(data)))


def _names(payload: bytes) -> list[str]:
    """The names of a recipe, which may end with a comma."""
    return [name for name in payload.decode("ascii", "replace").split(",") if name]


def _package(letter: str, payload: bytes) -> bytes:
    return struct.pack(">HB", 3 + len(payload), ord(letter)) + payload


class UrServer(TcpServer):
    """Serves a controller over TCP, and lets its time pass."""

    def __init__(
        self,
        controller: UrController,
        host: str = "127.0.0.1",
        ports: Sequence[int] = PORTS,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`ports`: where RTDE, dashboard and program are served; 0 for a free one."""
        super().__init__()
        self._clock, self.controller = clock, controller
        self.ports = [
            self.listen((host, port), partial(controller.connect, role))
            for port, role in zip(ports, PORTS, strict=True)
        ]
        self._begin = clock() - controller.now

    def poll(self, timeout: float = STEP) -> None:
        """Serve for at most `timeout` s, then let the arm move."""
        super().poll(timeout)
        self.controller.advance(self._clock() - self._begin)
        self.flush()


def main(arguments: Sequence[str]) -> None:
    """Serve until killed."""
    server = UrServer(UrController(), arguments[0], [int(port) for port in arguments[1:4]])
    print("ready", *server.ports, flush=True)
    while True:
        server.poll()


if __name__ == "__main__":
    main(sys.argv[1:])
