"""Topics of ROS 2 directly over DDS, without rosbridge: needs the extra `ros2-dds`.

Types are made from the user's .msg files. It supports topics only: the Python binding of Cyclone
DDS cannot write the request ids of services and actions.
"""

from __future__ import annotations

import base64
import math
import time
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct, types as idl
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from petrobot import Ports, key
from petrobot.services.adapters.ros2.messages import BASIC, Definitions, Field, Message
from petrobot.services.adapters.ros2.topics import TopicDriver

_BASIC: Mapping[str, Any] = {
    name: getattr(idl, {"byte": "uint8", "char": "uint8"}.get(name, name), kinds[0])
    for name, kinds in BASIC.items()
    if name != "wstring"
}
EMPTY = "structure_needs_at_least_one_member"
"""The field that ROS 2 gives to a message without one."""
DEPTH = 10
"""Messages that are kept for a slow reader, as in ROS 2."""


class Types:
    """DDS types of ROS messages, made when they are first used."""

    def __init__(self, known: Definitions) -> None:
        self._known = known
        self._made: dict[str, type[IdlStruct]] = {}

    def of(self, interface: str) -> type[IdlStruct]:
        """Return the type of a message. Raises ValueError if its definition, or that of a message
        in it, is missing."""
        if interface not in self._made:
            if interface not in self._known:
                raise ValueError(f"definitions: expected the .msg file of {interface}")
            package, _, name = interface.split("/")
            if wide := [n for n, f in self._known[interface].items() if f.type == "wstring"]:
                raise ValueError(f"{interface}: {wide[0]} is a wstring, which DDS cannot send here")
            parts = {n: self._field(f) for n, f in self._known[interface].items()}
            self._made[interface] = make_idl_struct(
                name, f"{package}::msg::dds_::{name}_", parts or {EMPTY: idl.uint8}
            )
        return self._made[interface]

    def _field(self, field: Field) -> Any:
        one = _BASIC.get(field.type) or self.of(field.type)
        if not field.array:
            return one
        if field.size is None:
            return idl.sequence[one]
        return idl.sequence[one, field.size] if field.bounded else idl.array[one, field.size]

    def make(self, interface: str, message: Any) -> IdlStruct:
        """Return a message as DDS sends it; fields that are not given are 0, "" or empty. What
        rosbridge understands besides is understood here, too: a time "now", and base64."""
        if message == "now":
            message = dict(zip(("sec", "nanosec"), divmod(time.time_ns(), 10**9), strict=True))
        filled = {
            name: self._value(field, message.get(name))
            for name, field in self._known[interface].items()
        }
        return self.of(interface)(**(filled or {EMPTY: 0}))

    def _value(self, field: Field, value: Any) -> Any:
        if not field.array:
            if field.type in _BASIC:
                return BASIC[field.type][-1]() if value is None else value
            return self.make(field.type, value or {})
        one = Field(field.type)
        if isinstance(value, str):
            value = base64.b64decode(value, validate=True)
        absent = [None] * (0 if field.size is None or field.bounded else field.size)
        return [self._value(one, item) for item in (absent if value is None else value)]


def plain(sample: Any) -> Any:
    """Return a message of DDS as plain data, as rosbridge does: null for NaN and infinity."""
    if is_dataclass(sample):
        names = [each.name for each in fields(sample)]
        return {name: plain(getattr(sample, name)) for name in names if name != EMPTY}
    if isinstance(sample, list | tuple | bytes | bytearray):  # bytes: an array of fixed size
        return [plain(item) for item in sample]
    return None if isinstance(sample, float) and not math.isfinite(sample) else sample


class Topics(TopicDriver):
    """Topics of a ROS 2 robot over DDS. Its actions are `wait_for`, `publish` and `drive`."""

    domain: int = key(0, "ROS_DOMAIN_ID", least=0, most=232)
    reliable: bool = key(True, "False: also messages of publishers that are not reliable (sensors)")

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        self._types = Types(self.known)
        self._participant = DomainParticipant(self.domain)
        history = Policy.History.KeepLast(DEPTH)
        plain_cdr = Policy.DataRepresentation(use_cdrv0_representation=True)
        surely = Policy.Reliability.Reliable(duration(milliseconds=100))
        self._writing = Qos(surely, history, plain_cdr)
        self._reading = Qos(
            surely if self.reliable else Policy.Reliability.BestEffort, history, plain_cdr
        )
        self._writers: dict[tuple[str, str], DataWriter[Any]] = {}
        topics = {(sub["topic"], sub["type"]) for sub in self.subscribe.values()}
        self._readers = [
            (name, DataReader(self._participant, self._topic(name, interface), self._reading))
            for name, interface in sorted(topics)
        ]
        for out in self.setpoints.values():
            self._writer(out["topic"], out["type"])  # discovery takes a short time

    def _topic(self, name: str, interface: str) -> Topic[Any]:
        return Topic(self._participant, f"rt/{name.lstrip('/')}", self._types.of(interface))

    def _writer(self, name: str, interface: str) -> DataWriter[Any]:
        if (name, interface) not in self._writers:
            topic = self._topic(name, interface)
            self._writers[name, interface] = DataWriter(self._participant, topic, self._writing)
        return self._writers[name, interface]

    def transmit(self, topic: str, interface: str, message: Message) -> None:
        """Write a message. A subscriber that was not discovered before misses the first ones."""
        self._writer(topic, interface).write(self._types.make(interface, message))

    def step(self, now: float) -> None:
        """Process received messages, and send the set points that are due."""
        for topic, reader in self._readers:
            for sample in reader.take(DEPTH):
                if sample.sample_info.valid_data:
                    self.arrive(now, topic, plain(sample))
        super().step(now)

    def close(self) -> None:
        self._writers.clear()
        self._readers.clear()
        del self._participant
