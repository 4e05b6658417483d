"""Base class of drivers with ROS 2 topics: topics as external events and as values that actions
wait for, and streams of set points that are sent to topics."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from petrobot import Driver, Ports, key
from petrobot.services.adapters.ros2 import definitions
from petrobot.services.adapters.ros2.protocol import Message, filled, pick, unfit, words

LARGEST_VALUE = 65_536
"""Largest topic message that is kept for actions (characters): all kept messages are published each
cycle."""


class TopicDriver(Driver):
    """Topics of a robot. A subclass connects them: it implements `transmit`, and calls `arrive` for
    each received message."""

    period = 0.02
    definitions: dict[str, str] = key({}, "file of each type's .msg, .srv or .action, by type")
    subscribe: dict[str, Any] = key({}, "by name: topic, type, optional event, when, throttle")
    setpoints: dict[str, Any] = key({}, "by stream: topic, type, fields, optional rest")

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        self.known: dict[str, Mapping[str, definitions.Field]] = {}
        for name, file in self.definitions.items():
            text = ports.file(file).decode("utf-8", "replace")
            self.known.update(definitions.read(name, text, file))
        for name, sub in self.subscribe.items():
            _table(sub, f"subscribe.{name}", {"topic", "type"}, {"event", "when", "throttle"})
        for name, out in self.setpoints.items():
            _table(out, f"setpoints.{name}", {"topic", "type", "fields"}, {"rest"})
            if len(out.get("rest", out["fields"])) != len(out["fields"]):
                raise ValueError(f"setpoints.{name}.rest: expected one value for each of `fields`")
            out["rest"] = [float(value) for value in out.get("rest", [0.0] * len(out["fields"]))]
            self.check(filled({}, dict(zip(out["fields"], out["rest"], strict=True))), out["type"])
        self.refused, self.fault = 0, ""
        """Number of messages that could not be used, and what was wrong with the last one."""
        self.topics: dict[str, Message] = {}
        self.arrived: dict[str, float] = {}
        self.held: dict[str, bool] = {}
        """Whether the condition of an event's topic held in its newest message."""
        self.open, self.paused = set[str](), False
        """Streams whose set points an action forwards, and whether the operator holds them."""
        self.streams = {name: ports.stream(name) for name in self.setpoints}
        self.sent: dict[str, tuple[int, bool]] = {}
        """By stream: number of the last set point sent, and whether it was that of rest."""

    @property
    def connected(self) -> bool:
        """Whether messages can be sent."""
        return True

    def transmit(self, now: float, topic: str, interface: str, message: Message) -> None:
        """Send a message to a topic."""
        raise NotImplementedError

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Obey `publish` (topic, type, msg) or `drive` (the streams to forward)."""
        if "drive" in body:
            if unknown := set(body["drive"]) - set(self.setpoints):
                raise ValueError(f"no setpoints {sorted(unknown)}; expected {list(self.setpoints)}")
            self.open = set(body["drive"])
        elif "publish" in body:
            message = body["publish"]
            self.check(message["msg"], message["type"])
            self.transmit(now, message["topic"], message["type"], message["msg"])
        else:
            raise ValueError(f"unknown command {sorted(body)}: publish or drive")

    def check(self, message: Message, interface: str) -> None:
        """Raise ValueError for a message that does not fit its definition, or cannot be sent."""
        faults = [*definitions.faults(message, interface, self.known), unfit(message)]
        if wrong := "; ".join(filter(None, faults)):
            raise ValueError(f"{interface}: {wrong}")

    def refuse(self, fault: str) -> None:
        """Count a message that cannot be used."""
        self.refused, self.fault = self.refused + 1, words(fault)[:300]

    def arrive(self, now: float, topic: Any, message: Any) -> None:
        """Process a message of a topic."""
        fault = unfit(message)
        if not fault and len(str(message)) > LARGEST_VALUE:
            fault = f"is longer than {LARGEST_VALUE} characters"
        if fault:
            self.refuse(f"{topic}: {fault}")
            return
        for name, sub in self.subscribe.items():
            if sub["topic"] != topic:
                continue
            count = self.topics.get(name, {}).get("count", 0) + 1
            self.topics[name], self.arrived[name] = {"msg": message, "count": count}, now
            if "event" in sub:
                holds, before = fits(message, sub.get("when", {})), self.held.get(name, False)
                self.held[name] = holds and "when" in sub
                if holds and not before:
                    self.ports.raise_event(sub["event"], msg=message)

    def step(self, now: float) -> None:
        """Send the set points that are due."""
        for name, out in self.setpoints.items():
            self._steer(now, name, out)

    def _steer(self, now: float, name: str, out: Message) -> None:
        """Send the newest set point of a stream; if there is none, once that of rest."""
        port = self.streams[name]
        count, resting = self.sent.get(name, (0, True))
        values = port.values if name in self.open and not self.paused else None
        moving = values is not None and len(values) == len(out["fields"])
        moving = moving and all(map(math.isfinite, values or ()))
        if not self.connected or (resting and not moving):
            return
        if moving and port.count == count and not resting:
            return
        self.sent[name] = (port.count, not moving)
        chosen = values if moving and values is not None else out["rest"]
        message = filled({}, dict(zip(out["fields"], chosen, strict=True)))
        self.transmit(now, out["topic"], out["type"], message)

    def state(self) -> Mapping[str, Any]:
        """Return `connected`, and the newest message of each topic with its `count` and `age` (s);
        None before the first message and after a lost link."""
        now = self.ports.now
        return {
            "connected": self.connected,
            "refused": self.refused,
            "fault": self.fault,
            "topics": {
                name: {**self.topics[name], "age": now - self.arrived[name]}
                if name in self.topics
                else None
                for name in self.subscribe
            },
        }

    def stop(self, now: float) -> None:
        """Send the set points of rest."""
        self.open.clear()
        TopicDriver.step(self, now)

    def stopped(self) -> bool:
        """Return whether the last set points sent are those of rest."""
        return all(rest for _, rest in self.sent.values())

    def hold(self, now: float) -> str:
        """Send the set points of rest; a goal of ROS 2 cannot be paused."""
        self.paused = True
        TopicDriver.step(self, now)
        return super().hold(now)

    def release(self, now: float) -> None:
        """Forward set points again."""
        self.paused = False


def _table(config: Mapping[str, Any], where: str, needed: set[str], other: set[str]) -> None:
    missing, unknown = needed - set(config), set(config) - needed - other
    if missing or unknown:
        wrong = f"is missing {sorted(missing)}" if missing else f"unknown keys {sorted(unknown)}"
        raise ValueError(f"{where}: {wrong}; expected {sorted(needed)}, optional {sorted(other)}")


def fits(message: Message, when: Mapping[str, Any]) -> bool:
    """Return whether a message has all these values at their paths. A list of two numbers is a
    range."""
    for path, wanted in when.items():
        try:
            found = pick(message, path)
        except ValueError:
            return False
        if isinstance(wanted, list) and isinstance(found, int | float):
            if not wanted[0] <= found <= wanted[1]:
                return False
        elif found != wanted:
            return False
    return True
