"""The rosbridge protocol (version 2), sans-I/O: checks of messages, and the phases of a goal or
service call."""

from __future__ import annotations

import json
import math
import uuid
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

Message = dict[str, Any]
LARGEST = 4 << 20
"""Bytes of the largest message that is received."""
WAITING = 8
"""Messages of which fragments may be missing at the same time."""
DEPTH, ITEMS, TABLES = 16, 20_000, 1_000
"""Limits of a message: deepest nesting, most items, and most lists and tables. A driver's state can
contain several such messages."""
LARGEST_VALUE = 65_536
"""Characters of the largest message that is kept for actions: what is kept is published each
cycle."""
ENDED_KEPT = 5
"""Ended goals and calls that are kept for actions which have not read them."""
ANSWERS = frozenset(("action_feedback", "action_result", "service_response", "status"))
"""Operations of a server that concern a goal or a call."""
REPEAT = 1.0
"""Seconds after which a cancel is sent again: rosbridge ignores one that comes before it has begun
the goal."""


def parse(text: str) -> Message:
    """Return a message of rosbridge. Raises ValueError for anything else.

    A number that is not finite becomes None, as newer rosbridge servers send it themselves.
    """
    try:
        message = json.loads(text, parse_constant=lambda word: None, parse_float=_finite)
    except (ValueError, RecursionError) as fault:
        raise ValueError(f"not JSON: {fault}") from None
    if not isinstance(message, dict) or not isinstance(message.get("op"), str):
        raise ValueError(f"expected an object with a text `op`, found {text[:60]!r}")
    return message


class Fragments:
    """Puts messages together that a server sends in parts (operation `fragment`)."""

    def __init__(self) -> None:
        self._parts: dict[str, dict[int, str]] = {}

    def add(self, part: Message) -> Message | None:
        """Return the message that a part completes, None if parts are missing. Raises
        ValueError."""
        number, total, data = part.get("num"), part.get("total"), part.get("data")
        if not (
            isinstance(number, int)
            and isinstance(total, int)
            and isinstance(data, str)
            and 0 <= number < total
        ):
            raise ValueError(f"not a fragment: {str(part)[:60]}")
        name = str(part.get("id"))
        parts = self._parts.setdefault(name, {})
        parts[number] = data
        if len(parts) == total:
            return parse("".join(text for _, text in sorted(self._parts.pop(name).items())))
        if sum(map(len, parts.values())) > LARGEST or len(self._parts) > WAITING:
            self._parts.pop(next(iter(self._parts)) if len(self._parts) > WAITING else name)
            raise ValueError(f"fragments of {name:.40}: too many or too long")
        return None


def _finite(text: str) -> float | None:
    number = float(text)
    return number if math.isfinite(number) else None


def unfit(values: Any, most: int = LARGEST_VALUE) -> str:
    """Return what is wrong with the values of a message, "" if they are finite, not longer than
    `most` characters and can be sent on.

    ROS messages have no null: rosbridge writes it for NaN and infinity.
    """
    if not isinstance(values, dict):
        return f"expected a message, found {str(values)[:60]!r}"
    tables = 0
    for count, (path, value) in enumerate(_leaves(values, "", 0)):
        tables += isinstance(value, dict | list)
        if count > ITEMS or tables > TABLES:
            return f"has more than {ITEMS} items, or {TABLES} lists and tables"
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            return f"{path}: is not a finite number"
        if isinstance(value, int) and not -(2**63) <= value < 2**64:
            return f"{path}: {str(value)[:30]} does not fit into 64 bits"
        if path.count(".") > DEPTH and isinstance(value, dict | list):
            return f"{words(path)}: is nested more than {DEPTH} deep"
        if words(path) != path or (isinstance(value, str) and words(value) != value):
            return f"{words(path)}: is not Unicode text"
    return "" if len(str(values)) <= most else f"is longer than {most} characters"


def words(said: Any) -> str:
    """Return what a server says as a text that can be sent on."""
    return str(said).encode("utf-8", "backslashreplace").decode()


def _leaves(value: Any, path: str, depth: int) -> Iterator[tuple[str, Any]]:
    inner = value.items() if isinstance(value, dict) else enumerate(value)
    for name, item in inner:
        here = f"{path}.{name}" if path else str(name)
        yield here, item
        if isinstance(item, dict | list) and depth <= DEPTH:
            yield from _leaves(item, here, depth + 1)


def pick(values: Any, path: str) -> Any:
    """Return the value at a path such as "pose.position.x" or "points.0". Raises ValueError."""
    found = values
    for name in path.split("."):
        try:
            found = found[int(name)] if isinstance(found, list) else found[name]
        except (KeyError, IndexError, TypeError, ValueError):
            has = list(found)[:12] if isinstance(found, dict) else f"a {type(found).__name__}"
            raise ValueError(f"{path}: there is no {name!r}, but {has}") from None
    return found


def filled(base: Mapping[str, Any], values: Mapping[str, Any]) -> Message:
    """Return a copy of a message in which the values stand at their paths."""
    try:
        message: Message = json.loads(json.dumps(base, allow_nan=False))
    except TypeError as fault:
        raise ValueError(str(fault)) from None
    for path, value in values.items():
        *tables, last = path.split(".")
        table = message
        for name in tables:
            table = table.setdefault(name, {})
            if not isinstance(table, dict):
                raise ValueError(f"{path}: {name!r} is not a table")
        table[last] = value
    return message


class ExchangePhase(StrEnum):
    """Phase of a goal or a service call."""

    PENDING = "pending"
    ACTIVE = "active"
    """The server has sent feedback: it has accepted the goal."""
    CANCELLING = "cancelling"
    LOST = "lost"
    """The link broke: it is unknown what was executed."""
    RECALLED = "recalled"
    """After LOST: its cancel was sent over the next link."""
    SUCCEEDED = "succeeded"
    CANCELLED = "cancelled"
    ABORTED = "aborted"
    REJECTED = "rejected"
    """Refused before anything began."""
    UNANSWERED = "unanswered"
    """Cancelled, but the server has been silent for too long (see `Exchanges.unknown`)."""
    GONE = "gone"
    """After LOST: the server has ended it, or has not answered for too long."""


RUNNING = frozenset({ExchangePhase.PENDING, ExchangePhase.ACTIVE, ExchangePhase.CANCELLING})
MOVING = RUNNING | {ExchangePhase.LOST, ExchangePhase.RECALLED}
"""Phases in which the robot may move because of it."""
_STATUS: Mapping[float, ExchangePhase] = {
    4: ExchangePhase.SUCCEEDED,
    5: ExchangePhase.CANCELLED,
    6: ExchangePhase.ABORTED,
}
"""action_msgs/msg/GoalStatus."""


@dataclass
class Exchange:
    """A goal or a service call: the request, and the answers so far."""

    request: Message
    """The operation that began it; its `id` names it."""
    keep: frozenset[str] | None
    """Fields of its result that are kept; None: all."""
    heard: float
    """Time of the server's last message about it, or of the last cancel (s)."""
    asked: float = math.inf
    """When its cancel was last sent (s)."""
    phase: ExchangePhase = ExchangePhase.PENDING
    feedback: Message = field(default_factory=dict)
    count: int = 0
    """Number of feedback messages so far."""
    values: Message = field(default_factory=dict)
    text: str = ""
    fault: str = ""
    """Why the values of its result cannot be used."""
    read: bool = False
    """Whether its action no longer needs it."""

    def end(self, phase: ExchangePhase) -> None:
        """End it. The first end counts: one that was lost stays lost, whatever the server says."""
        if self.phase is ExchangePhase.RECALLED:
            self.phase = ExchangePhase.GONE
        elif self.phase in RUNNING:
            self.phase = phase

    def refuse(self, why: Any) -> None:
        """End it because rosbridge answers `result: false`, or reports an error: rejected, no such
        server, wrong fields."""
        self.text = words(why)[:500]
        begun = self.phase is not ExchangePhase.PENDING
        self.end(ExchangePhase.ABORTED if begun else ExchangePhase.REJECTED)

    def finish(self, said: Any, status: Any) -> None:
        """End it with the values and the status of a result; None is success."""
        phase = ExchangePhase.SUCCEEDED
        if status is not None:
            known = status if isinstance(status, int | float) else 0
            phase = _STATUS.get(known, ExchangePhase.ABORTED)
        if phase is ExchangePhase.ABORTED:
            self.text = f"the goal ended with status {status}"
        if isinstance(said, str):
            self.text, said = words(said)[:500], {}
        values = said or {}
        if self.keep is not None and isinstance(values, dict):
            values = {name: value for name, value in values.items() if name in self.keep}
        self.fault = unfit(values)
        self.values = {} if self.fault else values
        self.end(phase)


class Exchanges:
    """The goals and calls of one client, by a name that the client chooses. Ids in messages are
    globally unique, since all clients of a rosbridge server share one table of ids."""

    def __init__(self, patience: float) -> None:
        self.open: dict[str, Exchange] = {}
        self.unknown: dict[str, str] = {}
        """Goals that were given up without a word of their server, which may still move the robot:
        the name of their action by id."""
        self._patience = patience
        self._own = uuid.uuid4().hex

    def begin(self, now: float, name: str, request: Message, keep: Any = None) -> Message:
        """Begin a goal or a call; return the messages to send."""
        message = {**request, "id": f"petrobot:{self._own}:{name}:{uuid.uuid4().hex[:8]}"}
        kept = None if keep is None else frozenset(keep)
        if name in self.open:  # an earlier goal of the same run, which may still move the robot
            earlier = self.open.pop(name)
            self.open[earlier.request["id"]] = earlier
        ended = [name for name, one in self.open.items() if one.phase not in MOVING]
        for old in ended[:-ENDED_KEPT]:
            del self.open[old]
        self.open[name] = Exchange(message, kept, now)
        return message

    def cancel(self, now: float, name: str) -> list[Message]:
        """Cancel a goal, or give up a call, which cannot be cancelled; return the messages to
        send."""
        one = self.open.get(name)
        if one is None or one.phase not in RUNNING or one.phase is ExchangePhase.CANCELLING:
            return []
        if one.request["op"] == "call_service":
            one.phase = ExchangePhase.UNANSWERED
            return []
        one.phase, one.heard = ExchangePhase.CANCELLING, now
        return [_cancel(now, one)]

    def forget(self, name: str) -> None:
        """Forget a goal or call that the client no longer needs; it is kept while the robot may
        move."""
        if name in self.open:
            self.open[name].read = True

    def link(self, now: float, up: bool) -> list[Message]:
        """Note that the link was made or lost; return the messages to send: cancels of lost
        goals."""
        sent = []
        for one in self.open.values():
            if up and one.phase is ExchangePhase.LOST:
                one.phase, one.heard = ExchangePhase.RECALLED, now
                sent.append(_cancel(now, one))
            elif not up and one.phase in MOVING:
                call = one.request["op"] == "call_service"
                one.phase = ExchangePhase.GONE if call else ExchangePhase.LOST
        return sent

    def advance(self, now: float) -> list[Message]:
        """Repeat cancels that were not answered, and give up after some time."""
        sent = []
        for name in [n for n, one in self.open.items() if one.read and one.phase not in MOVING]:
            del self.open[name]
        for one in self.open.values():
            if one.phase not in (ExchangePhase.CANCELLING, ExchangePhase.RECALLED):
                continue
            if now - one.heard >= self._patience:
                one.end(ExchangePhase.UNANSWERED)
                self.unknown[one.request["id"]] = one.request["action"]
            elif now - one.asked >= REPEAT:
                sent.append(_cancel(now, one))
        return sent

    def receive(self, now: float, message: Message) -> str:
        """Process feedback, a result, a response, or rosbridge's report that an operation failed;
        return why it cannot be used, "" if it can."""
        identity = message.get("id")
        op, said = message["op"], message.get("values")
        failed = op == "status" and message.get("level") == "error"
        if op not in ANSWERS:
            return f"operation {words(op):.40}: was not asked for"
        if failed and identity is None:
            return f"rosbridge reports: {message.get('msg')}"
        if op == "action_result" or failed:
            self.unknown.pop(str(identity), None)
        one = next((e for e in self.open.values() if e.request["id"] == identity), None)
        if one is None or one.phase not in MOVING:
            return ""
        one.heard = now
        if op == "action_feedback":
            if one.phase is ExchangePhase.PENDING:
                one.phase = ExchangePhase.ACTIVE
            if fault := unfit(said):
                return f"feedback: {fault}"
            one.feedback, one.count = said or {}, one.count + 1
        elif failed:
            one.refuse(message.get("msg"))
        elif op != "status":
            status = message.get("status")
            if status is None and isinstance(said, dict) and set(said) == {"status", "result"}:
                status, said = said["status"], said["result"]  # an older rosbridge
            if message.get("result") is False and status not in (5, 6):
                one.refuse(said or "rosbridge gives no reason")
            else:
                one.finish(said, None if op == "service_response" else status)
                # Servers such as those of Nav2, MoveIt and ros2_control have one goal at a time.
                action = one.request.get("action")
                self.unknown = {i: name for i, name in self.unknown.items() if name != action}
        return ""


def _cancel(now: float, one: Exchange) -> Message:
    one.asked = now
    request = one.request
    return {"op": "cancel_action_goal", "id": request["id"], "action": request["action"]}
