"""Driver of an arm whose controller plans its own motion and speaks lines of JSON on a serial line.

    {"q": [rad, ...]}     move there, all joints together      {"grip": m}   fingers to a gap
    {"stop": true}        stand still                          {}            only ask

Each line is answered by `{"q": [...], "moving": ..., "grip": m, "held": ..., "closing": ...}`. Its
commands are these tables, too; a row of joints is sent at once, a gap likewise.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, Final

from petrobot.services.comm.streams.serial_line import SerialLine
from petrobot.services.device import Driver, Ports, key
from petrobot.services.host.json_text import json_text

LOST: Final = 0.25
"""s without an answer after which the controller is missing."""
REACHED: Final = 0.002
"""rad between a joint and its goal that count as reached."""


class LineArm(Driver):
    """An arm of any number of joints with a gripper."""

    period = 0.02
    port: str = key(text="serial port, as /dev/ttyUSB0")
    baud: int = key(115200, "bit/s")
    joints: int = key(6, "number of joints")

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        """Open the port. Raises ValueError for a wrong key, ConnectionError without the port."""
        super().__init__(config, ports)
        self._line: SerialLine | None = ports.serial(self.port, self.baud)
        self._heard = -math.inf
        self._said: dict[str, Any] = {}
        self._goal: list[float] | None = None
        self._held = False
        self._fresh = 0
        """Answers that are still to come to what was sent before the newest command."""
        self._send: list[dict[str, Any]] = []
        self._rest = b""

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Take `{"q": [...]}`, `{"grip": m}` or `{"enable": true}`. Raises ValueError."""
        if now - self._heard > LOST:
            raise ValueError("no answer from the arm's controller")
        goal, grip = body.get("q"), body.get("grip")
        if goal is not None and not _numbers(goal, self.joints):
            raise ValueError(f"q: expected {self.joints} joint angles (rad), found {goal!r:.80}")
        if grip is not None and not _numbers([grip], 1):
            raise ValueError(f"grip: expected m, found {grip!r:.40}")
        if set(body) - {"q", "grip", "enable"} or not body:
            raise ValueError(f"unknown command {dict(body)!r:.80}; expected q, grip or enable")
        if goal is not None:
            self._goal = [float(q) for q in goal]
            if not self._held:
                self._send.append({"q": self._goal})
        if grip is not None:
            self._send.append({"grip": float(grip)})

    def step(self, now: float) -> None:
        """Read the answers and send what is to be sent, at least a question. Never waits."""
        try:
            if self._line is None:
                self._line = self.ports.serial(self.port, self.baud)
            self._take(now, self._line.receive())
            out, self._send = self._send or [{}], []
            for told in out:
                self._line.send(json_text(told).encode() + b"\n")
            self._fresh += len(out)
        except (ConnectionError, OSError):
            if self._line is not None:
                self._line.close()
            self._line, self._heard, self._rest, self._fresh = None, -math.inf, b"", 0

    def _take(self, now: float, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            try:
                said = json.loads(line)
            except ValueError:
                continue  # noise on the line
            if isinstance(said, dict) and _numbers(said.get("q"), self.joints):
                self._said, self._heard = said, now
                self._fresh = max(0, self._fresh - 1)

    def state(self) -> Mapping[str, Any]:
        """Return `q` (rad), `at_goal`, `grip` (m), `held`, `closing`, and what is wrong."""
        said, missing = self._said, self.ports.now - self._heard > LOST
        q, goal = said.get("q", [0.0] * self.joints), self._goal
        return {
            "q": list(q),
            "at_goal": not missing
            and goal is not None
            and not said.get("moving", True)
            and all(abs(a - b) <= REACHED for a, b in zip(q, goal, strict=True)),
            "grip": float(said.get("grip", 0.0)),
            "held": bool(said.get("held")),
            "closing": bool(said.get("closing")) or bool(self._send),
            "fault": "no answer from the arm's controller" if missing else "",
        }

    def stop(self, now: float) -> None:
        """Stand still; the fingers keep what they hold."""
        self._goal = None
        self._send = [{"stop": True}]

    def stopped(self) -> bool:
        """Return whether the controller answers and stands."""
        heard = self.ports.now - self._heard <= LOST
        return heard and not self._send and self._fresh <= 1 and not self._said.get("moving", True)

    def hold(self, now: float) -> str:
        """Stand still, and keep the goal for `release`."""
        if now - self._heard > LOST:
            return "cannot hold"
        if not self._held:
            self._send.append({"stop": True})
        self._held = True
        return "held"

    def release(self, now: float) -> None:
        """Move on."""
        if self._held and self._goal is not None:
            self._send.append({"q": self._goal})
        self._held = False

    def close(self) -> None:
        """Release the port."""
        if self._line is not None:
            self._line.close()


def _numbers(value: Any, count: int) -> bool:
    """Return whether it is a row of so many finite numbers."""
    return (
        isinstance(value, list | tuple)
        and len(value) == count
        and all(type(v) in (int, float) and math.isfinite(v) for v in value)
    )
