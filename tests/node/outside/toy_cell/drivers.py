"""Two devices: a slide that moves along a line each cycle, and an eye that takes images."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from services.comm.canbus import Frame
from services.device import Ports


class Slide:
    """A cyclic driver: goes to a place at a speed, follows the stream `points`, or stands."""

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        self.period: float | None = float(config["period"])
        self._ports = ports
        self._stream = ports.stream("points") if config.get("follow", True) else None
        self._bus = ports.can() if config.get("bus") else None
        self._holdable = bool(config.get("holdable", True))
        self._speed = float(config.get("speed", 1.0))
        self.position = 0.0
        self._goal = 0.0
        self._following = False
        self._held = False
        self._cycles = 0
        self._heard = 0
        self._stops = 0
        self._halted_by_age = 0

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """`{"to": x}`, `{"follow": true}` or `{"halt": true}`."""
        if "to" in body:
            if abs(body["to"]) > 100:
                raise ValueError(f"{body['to']} is beyond the rail; stay within 100 m")
            self._goal, self._following = float(body["to"]), False
        elif body.get("halt"):
            self._goal, self._following = self.position, False
        else:
            self._following = bool(body["follow"])

    def step(self, now: float) -> None:
        """Move a bit."""
        self._cycles += 1
        if self._bus is not None:
            self._heard += len(self._bus.receive())
            self._bus.send(Frame(0x181, self._cycles.to_bytes(4, "little")))
        if self._following and self._stream is not None:
            values = self._stream.values
            if values is None:
                self._halted_by_age += self._goal != self.position
                self._goal = self.position
            else:
                self._goal = values[0]
        if not self._held and self.period:
            most = self._speed * self.period
            self.position += max(-most, min(most, self._goal - self.position))

    def state(self) -> Mapping[str, Any]:
        """Where it is."""
        age = self._stream.age if self._stream is not None else 0.0
        return {
            "position": self.position,
            "cycles": self._cycles,
            "heard": self._heard,
            "stops": self._stops,
            "age": min(age, 1e9),
            "count": self._stream.count if self._stream is not None else 0,
        }

    def stop(self, now: float) -> None:
        """Stand still here."""
        self._goal, self._following = self.position, False
        self._stops += 1

    def stopped(self) -> bool:
        """Whether it stands."""
        return self._goal == self.position and not self._following

    def hold(self, now: float) -> str:
        """Freeze."""
        self._held = self._holdable
        return "held" if self._holdable else "cannot hold"

    def release(self, now: float) -> None:
        """Go on."""
        self._held = False

    def close(self) -> None:
        """Nothing to let go."""


class Eye:
    """A driver without cyclic duty: hands out images of its source."""

    period: float | None = None

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        self.images = ports.images() if config.get("source") else None
        self.ports = ports
        self.stops = 0

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """It takes none."""
        raise ValueError("an eye takes no commands")

    def step(self, now: float) -> None:
        """It has no cycle."""

    def state(self) -> Mapping[str, Any]:
        """How often it was stopped."""
        return {"stops": self.stops}

    def stop(self, now: float) -> None:
        """No more images."""
        self.stops += 1
        if self.images is not None:
            self.images.stop()

    def stopped(self) -> bool:
        """It never moves."""
        return True

    def hold(self, now: float) -> str:
        """Images may go on."""
        return "cannot hold"

    def release(self, now: float) -> None:
        """It was not held."""

    def close(self) -> None:
        """Let the source go."""
        if self.images is not None:
            self.images.close()
