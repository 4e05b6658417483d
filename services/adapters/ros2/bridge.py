"""A robot behind rosbridge: its protocol (version 2), the phases of goals and service calls, and
the driver `Bridge`."""

from __future__ import annotations

import asyncio
import json
import math
import uuid
from collections.abc import Mapping
from enum import StrEnum
from functools import partial
from typing import Any

import aiohttp
from msgspec import Struct, field

from petrobot import Ports, SessionThread, SimulatedSession, key
from petrobot.services.adapters.ros2.messages import LARGEST_VALUE, Message, unfit, words
from petrobot.services.adapters.ros2.topics import TopicDriver

LARGEST = 4 << 20
"""Bytes of the largest message that is received."""
RATE = 5e6
"""Bytes a second that are read of a server which sends large messages without a pause."""
CONNECTING = 5.0
"""Limit of an attempt to connect (s)."""
WAITING, MOST_FRAGMENTS = 8, 1000
"""Messages of which fragments may be missing at the same time, and most fragments of one."""
ENDED_KEPT = 5
"""Ended goals and calls that are kept for actions which have not read them."""
REPEAT = 1.0
"""Seconds after which a cancel is sent again: rosbridge ignores one that comes before it has begun
the goal."""
ANSWERS = frozenset(("action_feedback", "action_result", "service_response", "status"))
"""Operations of a server that concern a goal or a call."""

# --- messages -----------------------------------------------------------------------------------


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


def _finite(text: str) -> float | None:
    number = float(text)
    return number if math.isfinite(number) else None


class Fragments:
    """Puts messages together that a server sends in parts (operation `fragment`)."""

    def __init__(self) -> None:
        self._parts: dict[str, dict[float, str]] = {}

    def add(self, part: Message) -> Message | None:
        """Return the message that a part completes, None if parts are missing. Raises
        ValueError."""
        match part:
            case {"num": int() | float() as number, "total": total, "data": str(data)} if (
                isinstance(total, int | float) and 0 <= number < total <= MOST_FRAGMENTS
            ):
                name = str(part.get("id"))
            case _:
                raise ValueError(f"not a fragment: {str(part)[:60]}")
        parts = self._parts.setdefault(name, {})
        parts[number] = data
        if len(parts) == total:
            return parse("".join(text for _, text in sorted(self._parts.pop(name).items())))
        if sum(map(len, parts.values())) > LARGEST or len(self._parts) > WAITING:
            del self._parts[next(iter(self._parts)) if len(self._parts) > WAITING else name]
            raise ValueError(f"fragments of {name:.40}: too many or too long")
        return None


async def serve(url: str, heartbeat: float | None, session: SessionThread) -> None:
    """Connect to a rosbridge server, and pass messages on in both directions until that ends."""
    async with aiohttp.ClientSession(trust_env=False) as http:
        async with asyncio.timeout(CONNECTING):
            socket = await http.ws_connect(url, heartbeat=heartbeat, max_msg_size=LARGEST)
        async with socket:
            session.opened(sock=socket.get_extra_info("socket"))
            sending = asyncio.create_task(_send(session, socket))
            try:
                await _receive(session, socket)
            finally:
                sending.cancel()


async def _receive(session: SessionThread, socket: aiohttp.ClientWebSocketResponse) -> None:
    async for frame in socket:
        if frame.type is aiohttp.WSMsgType.ERROR:
            raise ConnectionError(f"broken: {socket.exception()}")
        try:
            if frame.type is not aiohttp.WSMsgType.TEXT:
                raise ValueError("a binary message")
            session.tell("message", parse(frame.data))
        except ValueError as fault:
            session.tell("refused", str(fault))
        if len(frame.data) > LARGEST_VALUE:  # reading it has kept the driver from its work
            await asyncio.sleep(len(frame.data) / RATE)
        await session.room()  # the driver is busy: let the server wait


async def _send(session: SessionThread, socket: aiohttp.ClientWebSocketResponse) -> None:
    try:
        while (message := await session.get()) is not None:
            await socket.send_str(json.dumps(message, allow_nan=False))
    finally:
        await socket.close()  # that ends `_receive`, too


# --- goals and service calls --------------------------------------------------------------------


class ExchangePhase(StrEnum):
    """Phase of a goal or a service call."""

    PENDING = "pending"
    ACTIVE = "active"
    """The server has sent feedback: it has accepted the goal."""
    CANCELLING = "cancelling"
    SUCCEEDED = "succeeded"
    CANCELLED = "cancelled"
    ABORTED = "aborted"
    REJECTED = "rejected"
    """Refused before anything began."""
    LOST = "lost"
    """The link broke: it is unknown what was executed."""
    UNANSWERED = "unanswered"
    """Cancelled, but the server has been silent for too long, or is not asked any more."""


RUNNING = frozenset({ExchangePhase.PENDING, ExchangePhase.ACTIVE, ExchangePhase.CANCELLING})
_STATUS: Mapping[Any, ExchangePhase] = {
    None: ExchangePhase.SUCCEEDED,
    4: ExchangePhase.SUCCEEDED,
    5: ExchangePhase.CANCELLED,
    6: ExchangePhase.ABORTED,
}
"""action_msgs/msg/GoalStatus; None: the server gives none."""


class Exchange(Struct):
    """A goal or a service call: the request, and the answers so far."""

    request: Message
    """The operation that began it; its `id` names it."""
    keep: frozenset[str] | None
    """Fields of its result that are kept; None: all."""
    heard: float
    """Time of the server's last message about it, or of the last decision to cancel it (s)."""
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

    def cancel(self, now: float) -> Message:
        """Return the message that cancels it."""
        self.asked = now
        request = self.request
        return {"op": "cancel_action_goal", "id": request["id"], "action": request["action"]}

    def take_feedback(self, values: Any) -> str:
        """Store feedback; return why it cannot be used."""
        if self.phase is ExchangePhase.PENDING:
            self.phase = ExchangePhase.ACTIVE
        if fault := unfit(values, gaps=True):
            return f"feedback: {fault}"
        self.feedback, self.count = values, self.count + 1
        return ""

    def take_refusal(self, why: Any) -> None:
        """End it because rosbridge answers `result: false`, or reports an error: rejected, no such
        server, wrong fields."""
        self.text = words(why or "rosbridge gives no reason")[:500]
        begun = self.phase is not ExchangePhase.PENDING
        self.phase = ExchangePhase.ABORTED if begun else ExchangePhase.REJECTED

    def take_result(self, values: Any, status: Any) -> None:
        """End it with the values and the status of a result."""
        known = status if isinstance(status, int | float | None) else 0
        self.phase = _STATUS.get(known, ExchangePhase.ABORTED)
        if self.phase is ExchangePhase.ABORTED:
            self.text = f"the goal ended with status {words(status):.40}"
        if isinstance(values, str):
            self.text, values = words(values)[:500], {}
        values = values or {}
        if self.keep is not None and isinstance(values, dict):
            values = {name: value for name, value in values.items() if name in self.keep}
        self.fault = unfit(values)
        self.values = {} if self.fault else values


class Exchanges:
    """The goals and calls of one client, by a name that the client chooses. Ids in messages are
    globally unique, since all clients of a rosbridge server share one table of ids."""

    def __init__(self, patience: float) -> None:
        self.open: dict[str, Exchange] = {}
        self.orphans: dict[str, Exchange] = {}
        """Goals by id that nothing waits for, because the link broke or their cancel was not
        answered. They may still move the robot: they are cancelled for `patience` s after each
        beginning of a link, and stay here until the server reports their end."""
        self._patience = patience

    def begin(self, now: float, name: str, request: Message, keep: Any = None) -> Message:
        """Begin a goal or a call; return the message to send."""
        message = {**request, "id": f"petrobot:{name}:{uuid.uuid4().hex}"}
        self.forget(name)
        ended = [name for name, one in self.open.items() if one.phase not in RUNNING]
        for old in ended[:-ENDED_KEPT]:
            del self.open[old]
        self.open[name] = Exchange(message, None if keep is None else frozenset(keep), now)
        return message

    def cancel(self, now: float, name: str) -> list[Message]:
        """Cancel a goal, or give up a call, which cannot be cancelled; return the messages to
        send."""
        one = self.open.get(name)
        if one is None or one.phase not in (ExchangePhase.PENDING, ExchangePhase.ACTIVE):
            return []
        if "service" in one.request:
            one.phase = ExchangePhase.UNANSWERED
            return []
        one.phase, one.heard = ExchangePhase.CANCELLING, now
        return [one.cancel(now)]

    def forget(self, name: str) -> None:
        """Forget a goal or call that the client no longer needs."""
        if (one := self.open.pop(name, None)) is not None and one.phase in RUNNING:
            self._abandon(one, ExchangePhase.UNANSWERED)

    def _abandon(self, one: Exchange, phase: ExchangePhase) -> None:
        """Let nothing wait for it any more."""
        one.phase = phase
        if "action" in one.request:
            self.orphans[one.request["id"]] = one

    def link(self, now: float, up: bool, why: str = "") -> list[Message]:
        """Note that the link was made or lost (`why`); return the messages to send."""
        for one in self.open.values():
            if one.phase in RUNNING and not up:
                self._abandon(one, ExchangePhase.LOST)
                one.text = why
        for one in self.orphans.values():
            one.heard, one.asked = (now, -math.inf) if up else (-math.inf, math.inf)
        return self.advance(now)

    def advance(self, now: float) -> list[Message]:
        """Give up goals whose cancel was not answered for some time; return the other cancels, when
        they are due again."""
        cancelled = list(self.orphans.values())
        for one in self.open.values():
            if one.phase is ExchangePhase.CANCELLING:
                cancelled.append(one)
                if now - one.heard >= self._patience:
                    self._abandon(one, ExchangePhase.UNANSWERED)
        due = [one for one in cancelled if now - one.heard < self._patience]
        return [one.cancel(now) for one in due if now - one.asked >= REPEAT]

    def receive(self, now: float, message: Message) -> str:
        """Process feedback, a result, a response, or rosbridge's report that an operation failed;
        return why it cannot be used, "" if it can."""
        op, said, status = message["op"], message.get("values"), message.get("status")
        if status is None and "status" in message:
            status = "null"  # no older rosbridge, which gives none, and no success
        identity = given if isinstance(given := message.get("id"), str) else ""
        failed = op == "status" and message.get("level") == "error"
        if op not in ANSWERS:
            return f"operation {words(op):.40}: was not asked for"
        if failed and not identity:
            return f"rosbridge reports: {message.get('msg')}"
        if identity in self.orphans:
            self.orphans[identity].heard = now
            if op == "action_result" or failed:
                del self.orphans[identity]
        one = next((e for e in self.open.values() if e.request["id"] == identity), None)
        if one is None or one.phase not in RUNNING or (op == "status" and not failed):
            return ""
        call = "service" in one.request
        if not failed and call is not (op == "service_response"):
            return f"{op}: it answers another operation"
        one.heard = now
        if op == "action_feedback":
            return one.take_feedback(said)
        if call:
            status = None
        elif status is None and isinstance(said, dict) and set(said) == {"status", "result"}:
            status, said = said["status"], said["result"]  # an older rosbridge
        if failed or (not message.get("result", True) and status not in (5, 6)):
            one.take_refusal(message.get("msg") if failed else said)
        else:
            one.take_result(said, status)
            # Servers such as those of Nav2, MoveIt and ros2_control have one goal at a time.
            action = one.request.get("action")
            for other in [i for i, o in self.orphans.items() if o.request["action"] == action]:
                del self.orphans[other]
        return ""


# --- the driver ---------------------------------------------------------------------------------


class Bridge(TopicDriver):
    """A robot behind a rosbridge server, or a simulated one."""

    url: str = key("ws://127.0.0.1:9090", "ws://, wss://, or module:Class of a simulation")
    heartbeat: float = key(
        10.0, "s without a message until the server must answer a ping; 0: never", least=0
    )
    patience: float = key(5.0, "s without a word after a cancel until a goal is given up", above=0)

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        self.exchanges = Exchanges(self.patience)
        self.fragments = Fragments()
        self.advertised: dict[str, str] = {}
        self.now = 0.0
        """Time of the present step (s)."""
        self.link: SessionThread | SimulatedSession = (
            SessionThread(partial(serve, self.url, self.heartbeat or None))
            if "://" in self.url
            else SimulatedSession(self.url, lambda: self.now)
        )

    @property
    def connected(self) -> bool:
        return self.link.up

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Obey `goal` or `call` (a request, with `run`, `keep`, `given` and `fields`), `cancel`,
        `forget`, and the commands of topics."""
        if "cancel" in body:
            self._send(self.exchanges.cancel(now, body["cancel"]))
        elif "forget" in body:
            self.exchanges.forget(body["forget"])
        elif not self.link.up:
            raise ValueError(f"no connection to {self.url}: {self.link.why}")
        elif "goal" in body:
            asked, interface = body["goal"], body["goal"]["action_type"]
            args = self.limited(self.request(asked["args"], body, f"{interface}.Goal"), interface)
            self._begin(now, {**asked, "args": args}, f"{interface}.Result", body)
        elif "call" in body:
            asked, interface = body["call"], body.get("type", "")
            args = self.request(asked["args"], body, f"{interface}.Request")
            self._begin(now, {**asked, "args": args}, f"{interface}.Response", body)
        else:
            super().command(now, body)

    def _begin(self, now: float, request: Message, answer: str, body: Mapping[str, Any]) -> None:
        """Send a request, unless its action asks for fields that the answer does not have."""
        keep, known = body.get("keep"), self.known.get(answer)
        if known is not None and (absent := [name for name in keep or () if name not in known]):
            raise ValueError(f"{answer} has no {absent}, but: {', '.join(known) or 'none'}")
        if not self.dry_run:
            self._send([self.exchanges.begin(now, body["run"], request, keep)])

    def step(self, now: float) -> None:
        """Process received messages, and send those that are due."""
        self.now = now
        for kind, item in self.link.news():
            if kind == "up":
                self._send([*self._subscriptions(), *self.exchanges.link(now, True)])
            elif kind == "down":
                self.advertised.clear()
                self.topics.clear()  # values from before the link was lost
                self.fragments = Fragments()
                self.exchanges.link(now, False, words(item)[:500])
            elif fault := item if kind == "refused" else self._receive(now, item):
                self.refuse(fault)
        self._send(self.exchanges.advance(now))
        super().step(now)

    def _receive(self, now: float, message: Message) -> str:
        """Process a message; return why it cannot be used."""
        if message["op"] == "fragment":
            try:
                whole = self.fragments.add(message)
            except ValueError as fault:
                return str(fault)
            if whole is None:
                return ""
            message = whole
        if message["op"] == "publish":
            self.arrive(now, message.get("topic"), message.get("msg"))
            return ""
        return self.exchanges.receive(now, message)

    def _subscriptions(self) -> list[Message]:
        return [
            {"op": "subscribe", "id": name, "topic": sub["topic"], "type": sub["type"]}
            | ({"throttle_rate": round(1e3 * sub["throttle"])} if "throttle" in sub else {})
            for name, sub in self.subscribe.items()
        ]

    def transmit(self, topic: str, interface: str, message: Message) -> None:
        """Publish a message, after advertising its topic on this connection."""
        if self.advertised.get(topic) != interface:
            self.advertised[topic] = interface
            self._send([{"op": "advertise", "topic": topic, "type": interface}])
        self._send([{"op": "publish", "topic": topic, "msg": message}])

    def _send(self, messages: list[Message]) -> None:
        for message in messages:
            self.link.send(message)

    def state(self) -> Mapping[str, Any]:
        """Return the state of topics, why the link is `down`, and goals and calls by run
        (`exchanges`)."""
        shown = ("phase", "feedback", "count", "values", "text", "fault")
        exchanges = {
            run: {name: getattr(one, name) for name in shown}
            for run, one in self.exchanges.open.items()
        }
        down = "" if self.link.up else self.link.why
        return {**super().state(), "down": down, "exchanges": exchanges}

    def stop(self, now: float) -> None:
        """Cancel all goals, and send the set points of rest."""
        for name in list(self.exchanges.open):
            if cancelled := self.exchanges.cancel(now, name):
                self.exchanges.open[name].text = self.left
                self._send(cancelled)
        super().stop(now)

    def stopped(self) -> bool:
        """Return whether rosbridge has reported the end of each goal, or of a later one of the same
        action, and the last set points sent are those of rest."""
        goals = (one for one in self.exchanges.open.values() if "action" in one.request)
        moves = any(one.phase in RUNNING for one in goals)
        return super().stopped() and not moves and not self.exchanges.orphans

    def close(self) -> None:
        self.link.close()
