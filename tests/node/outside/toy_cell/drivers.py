"""Two devices: a slide that moves along a line each cycle, and an eye that takes images."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.device import Ports

_HOLDING_THE_INTERPRETER = ctypes.PyDLL(None)


def never_return() -> NoReturn:
    """Hang in C, and let no other thread run."""
    while True:
        _HOLDING_THE_INTERPRETER.pause()


class Slide:
    """A cyclic driver: moves to a position at a speed, follows the stream `points`, or stands
    still."""

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
        self._loops = False
        self._heard = 0
        self._stops = 0
        self._halted_by_age = 0

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """`{"to": x}`, `{"follow": true}`, `{"halt": true}`, or `{"loop": true}`: never return from
        `step` again."""
        self._loops = bool(body.get("loop"))
        if "to" in body:
            if abs(body["to"]) > 100:
                raise ValueError(f"{body['to']} is beyond the rail; stay within 100 m")
            self._goal, self._following = float(body["to"]), False
        elif body.get("halt") or self._loops:
            self._goal, self._following = self.position, False
        else:
            self._following = bool(body["follow"])

    def step(self, now: float) -> None:
        """Move by one cycle."""
        if self._loops:
            never_return()
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
        """Return the position."""
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
        """Return whether it stands still."""
        return self._goal == self.position and not self._following

    def hold(self, now: float) -> str:
        """Freeze."""
        self._held = self._holdable
        return "held" if self._holdable else "cannot hold"

    def release(self, now: float) -> None:
        """Go on."""
        self._held = False

    def close(self) -> None:
        """Release nothing."""


class Eye:
    """A driver without cyclic work: returns images of its source."""

    period: float | None = None

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        self.images = ports.images() if config.get("source") else None
        self.ports = ports
        self.stops = 0

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Refuse every command."""
        raise ValueError("an eye takes no commands")

    def step(self, now: float) -> None:
        """Do nothing: it has no cycle."""

    def state(self) -> Mapping[str, Any]:
        """Return how often it was stopped."""
        return {"stops": self.stops}

    def stop(self, now: float) -> None:
        """Return no more images."""
        self.stops += 1
        if self.images is not None:
            self.images.stop()

    def stopped(self) -> bool:
        """Return True: it never moves."""
        return True

    def hold(self, now: float) -> str:
        """Continue to return images."""
        return "cannot hold"

    def release(self, now: float) -> None:
        """Do nothing: it was not held."""

    def close(self) -> None:
        """Close the source."""
        if self.images is not None:
            self.images.close()


class Broken:
    """A cyclic device whose driver raises where its key `breaks` says, once an action has sent it
    `{"break": true}`.

    `sees` is what its `state` and `picture` return; it counts as moving from `{"go": true}` until
    it is stopped.
    """

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        self.period: float | None = float(config["period"]) if config.get("period") else None
        self._breaks = str(config.get("breaks", ""))
        self._armed = bool(config.get("at_once"))
        self._ports = ports
        self._moving = False
        self._file = config.get("file")
        self._written = ""
        if self._breaks == "hangs":
            Path(str(self._file)).touch()
            never_return()
        self._fail("constructor")

    def _fail(self, where: str) -> None:
        if self._armed and self._breaks == where:
            raise LookupError(f"nothing is right in {where}")

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """`{"break": true}`, `{"go": true}`, `{"raise": events}`, or one of those that are
        refused."""
        if body.get("break"):
            self._armed = True
        for _ in range(int(body.get("raise", 0))):
            self._ports.raise_event("noise")
        if "odd" in body:
            raise ValueError(f"the base takes no odd numbers: {body['odd']}")
        if body.get("need") is True:
            body["what is not there"]
        if body.get("block"):
            time.sleep(float(body["block"]))
        self._fail("command")
        self._moving = bool(body.get("go")) or self._moving
        self._note()

    def step(self, now: float) -> None:
        """Record whether it moves."""
        self._fail("step")
        if self._armed and self._breaks == "leaves":
            raise SystemExit("the vendor's library gave up")
        if self._armed and self._breaks == "event":
            self._ports.raise_event("e" * 300)
        self._note()

    def _note(self) -> None:
        said = "moving" if self._moving else "stopped"
        if self._file and said != self._written:
            self._written = said
            with Path(self._file).open("a", encoding="utf-8") as log:
                log.write(f"{time.monotonic()} {said}\n")

    def state(self) -> Mapping[str, Any]:
        """Return plain data, unless it is broken."""
        self._fail("state")
        if self._armed and self._breaks == "not_plain":
            return {"arm": {"pose": object()}}
        if self._armed and self._breaks == "surrogate":
            return {"arm": "\ud800"}
        if self._armed and self._breaks == "huge":
            return {"arm": bytes(10_000_000)}
        return {"moving": self._moving}

    def stop(self, now: float) -> None:
        """Stand still."""
        self._moving = False
        self._note()
        self._fail("stop")

    def stopped(self) -> bool:
        """Return whether it stands still."""
        self._fail("stopped")
        return not self._moving

    def hold(self, now: float) -> str:
        """Freeze."""
        self._fail("hold")
        return "held"

    def release(self, now: float) -> None:
        """Go on."""
        self._fail("release")

    def picture(self) -> Mapping[str, Any]:
        """Return what it sees."""
        self._fail("picture")
        return {"mime": "image/png", "data": b"", "width": 0, "height": 0, "age": 0.0}

    def close(self) -> None:
        """Close the device."""
        self._fail("close")
