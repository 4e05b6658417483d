"""The driver of a robot behind rosbridge: goals, service calls, topics and set points."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from petrobot import Driver, Ports, key
from petrobot.services.adapters.ros2 import definitions
from petrobot.services.adapters.ros2.link import SimulatedLink, WebSocketLink
from petrobot.services.adapters.ros2.protocol import MOVING, Exchanges, Message, filled, pick, unfit

LARGEST_VALUE = 65_536
"""Characters of the largest topic message that is kept for actions: all of them are published each
cycle."""


def table(config: Mapping[str, Any], where: str, needed: set[str], other: set[str]) -> None:
    """Raise ValueError if a table of the configuration lacks a key or has an unknown one."""
    missing, unknown = needed - set(config), set(config) - needed - other
    if missing or unknown:
        wrong = f"is missing {sorted(missing)}" if missing else f"unknown keys {sorted(unknown)}"
        raise ValueError(f"{where}: {wrong}; expected {sorted(needed)}, optional {sorted(other)}")


class Bridge(Driver):
    """A robot behind a rosbridge server, or a simulated one."""

    period = 0.02
    url: str = key("ws://127.0.0.1:9090", "ws://, wss://, or module:Class of a simulation")
    heartbeat: float = key(
        10.0, "s without a message until the server must answer a ping; 0: never"
    )
    patience: float = key(5.0, "s without a word after a cancel until a goal is given up")
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
            table(sub, f"subscribe.{name}", {"topic", "type"}, {"event", "when", "throttle"})
        for name, out in self.setpoints.items():
            table(out, f"setpoints.{name}", {"topic", "type", "fields"}, {"rest"})
            if len(out.get("rest", out["fields"])) != len(out["fields"]):
                raise ValueError(f"setpoints.{name}.rest: expected one value for each of `fields`")
            out["rest"] = [float(value) for value in out.get("rest", [0.0] * len(out["fields"]))]
            self._check(filled({}, dict(zip(out["fields"], out["rest"], strict=True))), out["type"])
        self.exchanges = Exchanges(self.patience)
        self.topics: dict[str, Message] = {}
        self.arrived: dict[str, float] = {}
        self.held: dict[str, bool] = {}
        """Whether the condition of an event's topic held in its newest message."""
        self.epoch, self.down = 0, "not connected yet"
        self.advertised: dict[str, str] = {}
        self.open, self.paused = set[str](), False
        """Streams whose set points an action lets through; whether the operator holds them."""
        self.sent: dict[str, tuple[int, bool]] = {}
        """By stream: number of the last set point sent, and whether it was that of rest."""
        simulated = "://" not in self.url
        self.link = (
            SimulatedLink(self.url) if simulated else WebSocketLink(self.url, self.heartbeat)
        )

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """`goal` or `call` (a request, with `run` and `keep`), `publish`, `cancel`, `forget`, or
        `drive` (the streams to let through)."""
        verb = next((v for v in ("goal", "call", "publish") if v in body), "")
        if "cancel" in body:
            self._send(now, self.exchanges.cancel(now, body["cancel"]))
        elif "forget" in body:
            self.exchanges.forget(body["forget"])
        elif "drive" in body:
            if unknown := set(body["drive"]) - set(self.setpoints):
                raise ValueError(
                    f"no setpoints {sorted(unknown)}; there are {list(self.setpoints)}"
                )
            self.open = set(body["drive"])
        elif not verb:
            raise ValueError(f"unknown command {sorted(body)}: goal, call, publish, drive, cancel")
        elif not self.epoch:
            raise ValueError(f"no connection to {self.url}: {self.down}")
        elif verb == "publish":
            message = body["publish"]
            self._check(message["msg"], message["type"])
            self._publish(now, message["topic"], message["type"], message["msg"])
        else:
            request, part = dict(body[verb]), "Goal" if verb == "goal" else "Request"
            interface, keep = request.get("action_type") or body.get("type", ""), body.get("keep")
            self._check(request["args"], f"{interface}.{part}")
            result = self.known.get(f"{interface}.{'Result' if verb == 'goal' else 'Response'}")
            if result is not None and (absent := [n for n in keep or () if n not in result]):
                has = ", ".join(result) or "none"
                raise ValueError(f"the result of {interface} has no {absent}, but: {has}")
            self._send(now, [self.exchanges.begin(now, body["run"], request, keep)])

    def _check(self, message: Message, interface: str) -> None:
        faults = [*definitions.faults(message, interface, self.known), unfit(message)]
        if wrong := "; ".join(filter(None, faults)):
            raise ValueError(f"{interface}: {wrong}")

    def step(self, now: float) -> None:
        """Take what has come in, send what is due."""
        for kind, item in self.link.poll(now):
            if kind == "up":
                self.epoch = item
                self._send(now, [*self._subscriptions(), *self.exchanges.link(now, True)])
            elif kind == "down":
                self.epoch, self.down = 0, str(item)
                self.advertised.clear()
                self.topics.clear()  # what was true then
                self.exchanges.link(now, False)
            elif kind == "refused":
                self.exchanges.refuse(item)
            elif item["op"] == "publish":
                self._arrived(now, item)
            else:
                self.exchanges.receive(now, item)
        self._send(now, self.exchanges.advance(now))
        for name, out in self.setpoints.items():
            self._steer(now, name, out)

    def _subscriptions(self) -> list[Message]:
        return [
            {
                "op": "subscribe",
                "id": f"petrobot:{name}",
                "topic": sub["topic"],
                "type": sub["type"],
            }
            | ({"throttle_rate": round(1e3 * sub["throttle"])} if "throttle" in sub else {})
            for name, sub in self.subscribe.items()
        ]

    def _arrived(self, now: float, item: Message) -> None:
        message = item.get("msg")
        fault = unfit(message)
        if not fault and len(str(message)) > LARGEST_VALUE:
            fault = f"is longer than {LARGEST_VALUE} characters"
        if fault or not isinstance(message, dict):
            self.exchanges.refuse(f"{item.get('topic')}: {fault}")
            return
        for name, sub in self.subscribe.items():
            if sub["topic"] != item.get("topic"):
                continue
            count = self.topics.get(name, {}).get("count", 0) + 1
            self.topics[name], self.arrived[name] = {"msg": message, "count": count}, now
            if "event" in sub:
                holds, before = fits(message, sub.get("when", {})), self.held.get(name, False)
                self.held[name] = holds and "when" in sub
                if holds and not before:
                    self.ports.raise_event(sub["event"], msg=message)

    def _steer(self, now: float, name: str, out: Message) -> None:
        """Send the newest set point of a stream; once that of rest when there is none."""
        port = self.ports.stream(name)
        count, resting = self.sent.get(name, (0, True))
        values, lets = port.values, name in self.open and not self.paused
        usable = values is not None and len(values) == len(out["fields"])
        if not self.epoch:
            return
        if lets and usable and values is not None and all(map(math.isfinite, values)):
            if port.count == count and not resting:
                return
            resting = False
        elif resting:
            return
        else:
            values, resting = out["rest"], True
        self.sent[name] = (port.count, resting)
        message = filled({}, dict(zip(out["fields"], values or (), strict=True)))
        self._publish(now, out["topic"], out["type"], message)

    def _publish(self, now: float, topic: str, interface: str, message: Message) -> None:
        first = self.advertised.get(topic) != interface
        self.advertised[topic] = interface
        self._send(now, [{"op": "advertise", "topic": topic, "type": interface}] * first)
        self._send(now, [{"op": "publish", "topic": topic, "msg": message}])

    def _send(self, now: float, messages: list[Message]) -> None:
        if messages and self.epoch:
            self.link.send(now, self.epoch, messages)

    def state(self) -> Mapping[str, Any]:
        """Link, exchanges by run, newest message of each topic with its `age` (s)."""
        now = self.ports.now
        return {
            "connected": bool(self.epoch),
            "down": "" if self.epoch else self.down,
            "refused": self.exchanges.refused,
            "fault": self.exchanges.fault,
            "exchanges": {
                name: {
                    "phase": str(one.phase),
                    "feedback": one.feedback,
                    "count": one.count,
                    "values": one.values,
                    "text": one.text,
                    "fault": one.fault,
                }
                for name, one in self.exchanges.open.items()
            },
            "topics": {n: {**t, "age": now - self.arrived[n]} for n, t in self.topics.items()},
        }

    def stop(self, now: float) -> None:
        """Cancel all goals, and send the set points of rest."""
        self.open.clear()
        for name in list(self.exchanges.open):
            self._send(now, self.exchanges.cancel(now, name))
        for name, out in self.setpoints.items():
            self._steer(now, name, out)

    def stopped(self) -> bool:
        """Whether no goal is known to be active, as far as rosbridge tells, and no set point but
        that of rest was sent."""
        goals = (one for one in self.exchanges.open.values() if "action" in one.request)
        return all(rest for _, rest in self.sent.values()) and not any(
            one.phase in MOVING for one in goals
        )

    def hold(self, now: float) -> str:
        """Send the set points of rest; a goal of ROS 2 cannot be paused."""
        self.paused = True
        for name, out in self.setpoints.items():
            self._steer(now, name, out)
        return "held" if self.stopped() else "cannot hold"

    def release(self, now: float) -> None:
        """Let set points through again."""
        self.paused = False

    def close(self) -> None:
        """Close the connection."""
        self.link.close()


def fits(message: Message, when: Mapping[str, Any]) -> bool:
    """Whether a message has all these values at their paths. A list of two numbers is a range."""
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
