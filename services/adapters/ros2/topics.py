"""Base class of drivers with ROS 2 topics: topics as external events and as values that actions
wait for, and streams of set points that are sent to topics."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

from petrobot import Driver, Ports, key, table
from petrobot.services.adapters.ros2 import messages
from petrobot.services.adapters.ros2.messages import Message, filled, fits, pick, unfit

_TWIST = [f"{part}.{axis}" for part in ("linear", "angular") for axis in "xyz"]
SPEEDS = {
    "geometry_msgs/msg/Twist": _TWIST,
    "moveit_msgs/action/MoveGroup": ["request.max_velocity_scaling_factor"],
}
"""By type: paths of the values that `speed` scales."""
POINTS = {
    "geometry_msgs/msg/PoseStamped": "pose.position",
    "nav2_msgs/action/NavigateToPose": "pose.pose.position",
    "nav_msgs/msg/Odometry": "pose.pose.position",
}
"""By type: path of the point that `workspace` bounds."""
SHARE = "scaling_factor"
"""End of the path of a share: MoveIt moves at its own default speed for one that is not above 0 and
at most 1."""
TOPICS = 100_000
"""Characters of all kept topic messages together: they are published each cycle."""


class TopicDriver(Driver):
    """Topics of a robot. A subclass connects them: it implements `transmit`, and calls `arrive` for
    each received message."""

    period = 0.02
    obeys = ("speed", "workspace", "dry_run")
    definitions: dict[str, str] = key({}, "file of each type's .msg, .srv or .action, by type")
    subscribe: dict[str, Any] = key({}, "by name: topic, type, optional event, when, throttle")
    setpoints: dict[str, Any] = key({}, "by stream: topic, type, fields, optional rest")
    speeds: dict[str, list[str]] = key({}, "by type: paths of the values that `speed` scales")
    points: dict[str, str] = key({}, "by type: path of the point that `workspace` bounds")

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        self.known: dict[str, Mapping[str, messages.Field]] = {}
        for name, file in self.definitions.items():
            text = ports.file(file).decode("utf-8", "replace")
            self.known.update(messages.read(name, text, file))
        self.speeds, self.points = {**SPEEDS, **self.speeds}, {**POINTS, **self.points}
        self._check_tables()
        self.left = ""
        """How the robot has left its workspace, as far as its topics tell; "" if it is inside."""
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

    def _check_tables(self) -> None:
        for name, sub in self.subscribe.items():
            table(sub, f"subscribe.{name}", ("topic", "type"), ("event", "when", "throttle"))
        for name, out in self.setpoints.items():
            table(out, f"setpoints.{name}", ("topic", "type", "fields"), ("rest",))
            if len(out.get("rest", out["fields"])) != len(out["fields"]):
                raise ValueError(f"setpoints.{name}.rest: expected one value for each of `fields`")
            out["rest"] = [float(value) for value in out.get("rest", [0.0] * len(out["fields"]))]
            self.check(_row(out["fields"], out["rest"]), out["type"])
            if self.speed < 1.0 and out["type"] not in self.speeds:
                raise ValueError(f"speed: setpoints.{name}: {_unknown_speed(out['type'])}")
        types = {sub["type"] for sub in self.subscribe.values()}
        if self.workspace.bounds and types.isdisjoint(self.points):
            raise ValueError(
                "workspace: nothing tells where the robot is; subscribe to a topic whose type has "
                f"a point: {', '.join(self.points)}, or another one with points = {{ TYPE = PATH }}"
            )

    @property
    def connected(self) -> bool:
        """Whether messages can be sent."""
        return True

    def transmit(self, topic: str, interface: str, message: Message) -> None:
        """Send a message to a topic."""
        raise NotImplementedError

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Obey `publish` (topic, type, msg) or `drive` (the streams to forward)."""
        if "drive" in body:
            if unknown := set(body["drive"]) - set(self.setpoints):
                raise ValueError(f"no setpoints {sorted(unknown)}; expected {list(self.setpoints)}")
            self.open = set(body["drive"])
        elif "publish" in body:
            topic, interface = body["publish"]["topic"], body["publish"]["type"]
            message = self.limited(self.request(body["publish"]["msg"], body, interface), interface)
            if not self.dry_run:
                self.transmit(topic, interface, message)
        else:
            raise ValueError(f"unknown command {sorted(body)}: publish or drive")

    # --- checks and limits ----------------------------------------------------------------------

    def request(self, base: Message, body: Mapping[str, Any], interface: str) -> Message:
        """Return a message with the arguments `given` in a command at their `fields`. Raises
        ValueError if it does not fit its definition."""
        given, fields = body.get("given") or {}, body.get("fields") or {}
        if unknown := set(given) - set(fields):
            raise ValueError(f"no arguments {sorted(unknown)}; `fields` names {sorted(fields)}")
        message = filled(base, {fields[name]: value for name, value in given.items()})
        self.check(message, interface)
        return message

    def check(self, message: Message, interface: str) -> None:
        """Raise ValueError for a message that does not fit its definition, or cannot be sent."""
        faults = [*messages.faults(message, interface, self.known), unfit(message)]
        if wrong := "; ".join(filter(None, faults)):
            raise ValueError(f"{interface}: {wrong}")

    def limited(self, message: Message, interface: str) -> Message:
        """Return a message as slow as the device's `speed` says. Raises ValueError if nothing says
        what that means in this type, and for a point outside the workspace."""
        if self.speed < 1.0:
            if interface not in self.speeds:
                raise ValueError(f"speed = {self.speed:g}: {_unknown_speed(interface)}")
            slow = dict[str, float]()
            for path in self.speeds[interface]:
                with contextlib.suppress(ValueError):  # what is not given is 0
                    slow[path] = float(pick(message, path))
            if self.speeds[interface] and not slow:
                wanted = " or ".join(self.speeds[interface])
                raise ValueError(f"speed = {self.speed:g}: expected {wanted}")
            for path, value in slow.items():
                if path.endswith(SHARE) and not 0.0 < value <= 1.0:
                    wrong = f"expected a share above 0 and at most 1, found {value:g}"
                    raise ValueError(f"speed = {self.speed:g}: {path}: {wrong}")
            message = filled(message, {path: self.speed * value for path, value in slow.items()})
        if outside := self._outside(message, interface):
            raise ValueError(outside)
        return message

    def _outside(self, message: Message, interface: str) -> str:
        """Return in words that the point of a message lies outside the workspace, or is none."""
        short = _short(interface)
        path = next((path for name, path in self.points.items() if _short(name) == short), "")
        if not path or not self.workspace.bounds:
            return ""
        try:
            at = pick(message, path)
            return self.workspace.outside([float(at.get(axis, 0.0)) for axis in "xyz"])
        except (ValueError, TypeError, AttributeError) as fault:
            return f"{interface}: {fault}"

    # --- topics to petrobot ---------------------------------------------------------------------

    def refuse(self, fault: str) -> None:
        """Count a message that cannot be used."""
        self.refused, self.fault = self.refused + 1, messages.words(fault)[:300]

    def arrive(self, now: float, topic: Any, message: Any) -> None:
        """Process a message of a topic."""
        most = min(messages.LARGEST_VALUE, TOPICS // max(1, len(self.subscribe)))
        if fault := unfit(message, most, gaps=True):
            self.refuse(f"{topic}: {fault}")
            return
        for name, sub in self.subscribe.items():
            if sub["topic"] != topic:
                continue
            if sub["type"] in self.points:
                before, self.left = self.left, self._outside(message, sub["type"])
                if self.left and not before:
                    self.stop(now)
            count = self.topics.get(name, {}).get("count", 0) + 1
            self.topics[name], self.arrived[name] = {"msg": message, "count": count}, now
            if "event" in sub:
                holds, held = fits(message, sub.get("when", {})), self.held.get(name, False)
                self.held[name] = holds and "when" in sub
                if holds and not held:
                    self.ports.raise_event(sub["event"], msg=message)

    # --- set points to the robot ----------------------------------------------------------------

    def step(self, now: float) -> None:
        """Send the newest set point of each stream; if there is none, once that of rest."""
        for name, out in self.setpoints.items() if self.connected else ():
            count, resting = self.sent.get(name, (0, True))
            row, new = self._row_of(name, out), self.streams[name].count != count
            if (row is None and resting) or (row is not None and not resting and not new):
                continue
            self.sent[name] = (self.streams[name].count, row is None)
            if not self.dry_run:
                self.transmit(out["topic"], out["type"], row or _row(out["fields"], out["rest"]))

    def _row_of(self, name: str, out: Message) -> Message | None:
        """Return the message of a stream's newest set point; None if the robot must rest."""
        values = self.streams[name].values if name in self.open and not self.paused else None
        if not values or len(values) != len(out["fields"]) or not all(map(math.isfinite, values)):
            return None
        try:
            return self.limited(_row(out["fields"], values), out["type"])
        except ValueError as fault:  # outside the workspace
            self.refuse(str(fault))
            return None

    def state(self) -> Mapping[str, Any]:
        """`connected`, whether it is a `dry_run`, how the robot has `left` its workspace, messages
        `refused` and the last `fault`, and the newest message of each topic with its `count` and
        `age` (s), None before the first and after a lost link."""
        now, topics = self.ports.now, dict[str, Any].fromkeys(self.subscribe)
        for name, told in self.topics.items():
            topics[name] = {**told, "age": now - self.arrived[name]}
        shown = ("connected", "dry_run", "left", "refused", "fault")
        return {"topics": topics, **{name: getattr(self, name) for name in shown}}

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
        self.paused = False


def _row(fields: Sequence[str], values: Sequence[float]) -> Message:
    return filled({}, dict(zip(fields, values, strict=True)))


def _short(interface: str) -> str:
    """Return the name of a type without its kind: rosbridge also takes "nav_msgs/Odometry"."""
    return "/".join((interface.split("/")[0], interface.split("/")[-1]))


def _unknown_speed(interface: str) -> str:
    named = f'speeds = {{ "{interface}" = [PATHS] }}'
    return f"nothing says what is slower in {interface}; write {named}, [] if the robot limits it"
