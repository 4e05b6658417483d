"""Driver of a UR3e, UR5e or UR10e over RTDE.

The driver plans each motion itself, checks its whole path, and streams joint set points at 125 Hz
to a short program on the controller. That program stops the arm if they stop coming. Commands:

    {"do": "enable"}     power on, release brakes, start the program; unlocks a protective stop
    {"do": "move", "joints": six angles (rad), "speed": 0 to 1}       all joints arrive together
    {"do": "linear", "pose": x, y, z (m), rotation vector (rad), "speed": 0 to 1}     straight line
    {"do": "output", "bit": 0 to 7, "value": true or false}           digital output
    {"do": "rest"}       stop and stay there

The workspace limits the tool point in the base frame. After a fault nothing moves again before
`enable` and a new command.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from petrobot import Driver, JointChain, JointMotion, Link, Ports, key, numbers
from petrobot.services.adapters.ur.rtde import Rtde, RtdeError

# --- kinematics ---
# The joints of UR arms.
#
# Denavit-Hartenberg parameters: Universal Robots, "DH Parameters for calculations of kinematics and
# dynamics" (support article 16538). A robot's own calibration differs by a few tenths of a
# millimetre.

# d1, a2, a3, d4, d5, d6 (m)
MODELS = {
    "ur3e": (0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "ur5e": (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10e": (0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
}
TURN = (-2 * math.pi, 2 * math.pi)


def chain(model: str, tool: Sequence[float] = (0.0, 0.0, 0.0)) -> JointChain:
    """Return the joints of a model with a tool point `tool` (m, in the flange's frame)."""
    d1, a2, a3, d4, d5, d6 = MODELS[model]
    rows = [
        {"name": "base", "d": d1, "alpha": math.pi / 2},
        {"name": "shoulder", "a": a2},
        {"name": "elbow", "a": a3},
        {"name": "wrist_1", "d": d4, "alpha": math.pi / 2},
        {"name": "wrist_2", "d": d5, "alpha": -math.pi / 2},
        {"name": "wrist_3", "d": d6},
    ]
    return JointChain(({**row, "limits": TURN} for row in rows), (*tool, 0.0, 0.0, 0.0))


# --- driver ---

OUTPUTS = {
    **dict.fromkeys(("actual_q", "actual_qd"), "VECTOR6D"),
    **dict.fromkeys(("robot_mode", "safety_mode", "output_int_register_24"), "INT32"),
    **dict.fromkeys(("actual_digital_input_bits", "actual_digital_output_bits"), "UINT64"),
}
SETPOINT = {
    **dict.fromkeys(("input_int_register_24", "input_int_register_25"), "INT32"),
    **dict.fromkeys((f"input_double_register_{n}" for n in range(24, 30)), "DOUBLE"),
}
DIGITAL = dict.fromkeys(("standard_digital_output_mask", "standard_digital_output"), "UINT8")
POWER_OFF, IDLE, RUNNING = 3, 5, 7
SAFETY = {1: "normal", 2: "reduced", 3: "protective_stop", 4: "recovery", 5: "safeguard_stop",
          6: "emergency_stop", 7: "emergency_stop", 8: "violation", 9: "fault", 10: "fault",
          11: "fault", 12: "safeguard_stop", 13: "safeguard_stop"}  # fmt: skip
MAY_MOVE = (1, 2)
STANDING = 0.01
"""Speed below which a joint stands still (rad/s)."""
IN_PLACE = 0.003
"""Tolerance of a joint at the end of a motion (rad)."""
STALE = 0.15
"""Seconds without data, or without an echo of the program, after which link or program is lost."""
SILENT = 2.0
"""Seconds without data after which the driver connects again."""
ASK_AGAIN = 1.0
"""Time between two requests while the drives are being enabled (s)."""
BY_ITSELF = 1.0
"""Seconds in which the program has stopped the arm after the set points ceased."""
PROGRAM = """\
def petrobot():
  patience = 0.1
  beat = -1
  silent = 0.0
  while True:
    read = read_input_integer_register(24)
    if read == beat:
      silent = silent + get_steptime()
    else:
      silent = 0.0
    end
    beat = read
    write_output_integer_register(24, beat)
    if read_input_integer_register(25) == 1 and silent < patience:
      q = [read_input_float_register(24), read_input_float_register(25), read_input_float_register(26), read_input_float_register(27), read_input_float_register(28), read_input_float_register(29)]
      servoj(q, 0, 0, get_steptime(), 0.05, 300)
    else:
      stopj(8.0)
      sync()
    end
  end
end
"""  # noqa: E501
"""The controller's program (URScript of e-Series)."""


class Arm(Driver):
    """Driver of the arm (see `petrobot.Driver`)."""

    period = 0.008
    obeys = ("speed", "workspace", "dry_run", "pause")
    host: str = key(text="IP address of the controller, or unix:PATH of a simulated one")
    model: str = key("ur5e", choices=MODELS)
    tool: list[float] = key([0.0, 0.0, 0.0], "tool point in the flange's frame, m")
    top_speed: float = key(1.05, "rad/s", above=0, most=3.14)
    acceleration: float = key(1.4, "rad/s^2", above=0, most=20)
    rtde_port: int = key(30004, least=1, most=65535)
    dashboard_port: int = key(29999, least=1, most=65535)
    program_port: int = key(30002, least=1, most=65535)

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        self._arm = chain(self.model, numbers(self.tool, 3, "tool"))
        addresses = self.rtde_port, self.dashboard_port, self.program_port
        self._link, self._dashboard, self._program = (
            Link(ports.now, partial(ports.tcp, self.host, port), patience)
            for port, patience in zip(addresses, (SILENT, math.inf, math.inf), strict=True)
        )
        self._rtde, self._connection = Rtde(OUTPUTS, (SETPOINT, DIGITAL)), 1
        self._motion = JointMotion(
            self, self._arm.limits, self.top_speed, self.acceleration, self._arm.point
        )
        self._seen = self._echoed = -math.inf
        self._count, self._beat, self._ask_at = 0, 0, 0.0
        self._echo: int | None = None
        """What the program has last echoed; None before the first data of a connection."""
        self._measured: Sequence[float] = (0.0,) * 6
        """Joint angles last received (rad), also without a connection."""
        self._wanted = self._enabled = self._quick = False
        self._fault = self._reason = ""
        self._unseen_until, self._now = -math.inf, 0.0
        self._pretended = 0
        """Digital outputs as they would be, in a dry run."""

    # Commands

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        what = body.get("do")
        if what == "enable":
            self._wanted, self._fault, self._reason, self._ask_at = True, "", "", now
        elif what == "move":
            self._go([numbers(body.get("joints"), 6, "joints")], body)
        elif what == "linear":
            pose = numbers(body.get("pose"), 6, "pose")
            self._go(self._arm.line(pose, self._motion.q), body)
        elif what == "output":
            self._output(body.get("bit"), body.get("value"))
        elif what == "rest":
            self.stop(now)
        else:
            raise ValueError(f"unknown command {what!r}: know enable, move, linear, output, rest")

    def _output(self, bit: Any, value: Any) -> None:
        if type(bit) is not int or not 0 <= bit < 8 or not isinstance(value, bool):
            raise ValueError(
                f"output: expected bit 0 to 7 and true or false, got {bit!r}, {value!r}"
            )
        if not self._rtde.running:
            raise ValueError(f"output: no connection to the controller ({self._link.why})")
        self._pretended = self._pretended & ~(1 << bit) | value << bit
        if not self.dry_run:
            self._rtde.send(1, dict(zip(DIGITAL, (1 << bit, value << bit), strict=True)))

    def _go(self, way: list[list[float]], body: Mapping[str, Any]) -> None:
        if not self._enabled:
            raise ValueError(f"the arm is not enabled ({self._reason or 'send enable'})")
        self._motion.begin(way, body.get("speed", 1.0))
        self._reason, self._quick = "", False

    # The cycle

    def step(self, now: float) -> None:
        """Receive, move the set point, send. Never waits."""
        self._now = now
        self._receive(now)
        self._look(now)
        if self._enabled:
            self._reason = self._motion.watch(self._q()) or self._reason
            self._motion.step()
        self._send(now)

    def _receive(self, now: float) -> None:
        data = self._link.receive(now)
        if self._link.count != self._connection:
            self._connection = self._link.count
            self._rtde, self._count, self._echo = Rtde(OUTPUTS, (SETPOINT, DIGITAL)), 0, None
        try:
            self._rtde.receive(data)
        except RtdeError as fault:
            self._link.drop(now, str(fault))
        if self._rtde.count != self._count and self._link.up:
            self._count, self._seen = self._rtde.count, now
            self._measured = self._rtde.data["actual_q"]
            echo = self._rtde.data["output_int_register_24"]
            if self._echo not in (None, echo) and 0 <= self._beat - echo < 100:
                self._echoed = now  # the program has read the set point sent just before
            self._echo = echo
        for other in (self._dashboard, self._program):
            other.receive(now)  # what they say is not needed: RTDE tells it all

    def _look(self, now: float) -> None:
        """Find out whether the drives are enabled, and if not, why."""
        data = self._rtde.data  # empty until the first package of a connection
        fresh = now - self._seen < STALE and self._link.up and bool(data)
        safety = data["safety_mode"] if fresh else 0
        powered = fresh and safety in MAY_MOVE and data["robot_mode"] == RUNNING
        if self.dry_run:
            ready = fresh and self._wanted
        else:
            ready = powered and self._wanted and now - self._echoed < STALE
        if self._enabled and not ready:
            text = "program_lost" if powered else "power_off"
            if safety not in MAY_MOVE:
                # a mode of a later controller is a fault; one beyond all modes is a torn frame
                text = SAFETY.get(safety, "fault") if 0 < safety < 100 else "link_lost"
            self._lose(text)
        elif ready and not self._enabled:
            self._enabled, self._reason = True, ""
            self._motion.halt(data["actual_q"])
        elif self._wanted and not ready:
            lacks = "its program does not run" if powered else "its drives are off"
            if safety not in MAY_MOVE:
                lacks = f"the controller reports {SAFETY.get(safety, 'a fault')}"
            lacks = self._dashboard.why or self._program.why or f"{lacks}; is it in remote control?"
            waits = "no connection: " + (self._link.why or "no data yet")
            self._reason = f"enabling: {lacks}" if fresh else waits
            if fresh and now >= self._ask_at and not self.dry_run:
                self._ask_at = now + ASK_AGAIN
                self._ask(now, safety, data["robot_mode"])

    def _ask(self, now: float, safety: int, mode: int) -> None:
        """Send the next request for enabling the drives."""
        if safety == 3:
            self._dashboard.send(now, b"close safety popup\nunlock protective stop\n")
        elif safety not in MAY_MOVE:
            self._lose(SAFETY.get(safety, "fault"))
        elif mode == RUNNING:
            self._program.send(now, PROGRAM.encode())
        else:
            self._dashboard.send(now, b"power on\n" if mode == POWER_OFF else b"brake release\n")

    def _lose(self, fault: str, said: str = "") -> None:
        """Note a fault: nothing moves until the arm is enabled again."""
        if self._enabled and fault in ("link_lost", "program_lost"):
            self._unseen_until = self._now + BY_ITSELF
        self._enabled = self._wanted = False
        self._fault = fault
        self._reason = said or {
            "link_lost": f"no data for {STALE:g} s {self._link.why}".rstrip(),
            "program_lost": f"no echo of the controller's program for {STALE:g} s",
            "power_off": "the drives have lost their power",
        }.get(fault, f"the controller reports {fault}")
        self._motion.halt(self._motion.q)

    def _send(self, now: float) -> None:
        if not self.dry_run:
            self._beat = (self._beat + 1) % (1 << 30)
            follows = int(self._enabled and not self._quick)
            values = (self._beat, follows, *self._motion.q)
            self._rtde.send(0, dict(zip(SETPOINT, values, strict=True)))
        self._link.send(now, self._rtde.drain())

    def _q(self) -> list[float]:
        pretends = self.dry_run and self._enabled
        return list(self._motion.q if pretends else self._measured)

    def state(self) -> Mapping[str, Any]:
        """Return what actions, operator and report see; docs/robots/ur.md explains the keys."""
        data, q = self._rtde.data, self._q()
        there = self._motion.reached(q, IN_PLACE)
        connected = self._link.up and self._now - self._seen < STALE
        mode = "hold" if there or self._motion.goal is None else "move"
        return {
            "ready": self._enabled,
            "mode": mode if self._enabled else "off",
            "reason": self._reason,
            "faults": {self._fault: self._reason} if self._fault else {},
            "connected": connected,
            "safety": SAFETY.get(data.get("safety_mode", 0) if connected else 0, "unknown"),
            "q": q,
            "tool": self._arm.tool(q),
            "at_goal": there,
            "inputs": data.get("actual_digital_input_bits", 0),
            "outputs": self._pretended
            if self.dry_run
            else data.get("actual_digital_output_bits", 0),
        }

    def stop(self, now: float) -> None:
        """Brake on the way, and stay there."""
        self._motion.stop()

    def quick_stop(self, now: float) -> None:
        """Let the controller stop the joints as hard as its program does."""
        self._quick = True
        self._lose("emergency_stop", "an emergency stop of petrobot")

    def stopped(self) -> bool:
        """Return whether the arm is known to stand still: by its measured speeds, or because its
        program has stopped it."""
        if not self._link.up or self._now - self._seen > STALE:
            return self._now >= self._unseen_until and not self._enabled
        still = all(abs(v) < STANDING for v in self._rtde.data["actual_qd"])
        return still and not self._motion.moving and self._now >= self._unseen_until

    def close(self) -> None:
        """Close the connections; the program on the controller then stops the arm."""
        for link in (self._link, self._dashboard, self._program):
            link.close()
