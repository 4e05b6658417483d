"""The driver of a robot behind rosbridge: goals, service calls, topics and set points."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from petrobot import Ports, key
from petrobot.services.adapters.ros2.link import RosbridgeLink, SimulatedLink, connect
from petrobot.services.adapters.ros2.protocol import (
    MOVING,
    ExchangePhase,
    Exchanges,
    Fragments,
    Message,
)
from petrobot.services.adapters.ros2.topics import TopicDriver


class Bridge(TopicDriver):
    """A robot behind a rosbridge server, or a simulated one."""

    url: str = key("ws://127.0.0.1:9090", "ws://, wss://, or module:Class of a simulation")
    heartbeat: float = key(
        10.0, "s without a message until the server must answer a ping; 0: never"
    )
    patience: float = key(5.0, "s without a word after a cancel until a goal is given up")

    def __init__(self, config: Mapping[str, Any], ports: Ports) -> None:
        super().__init__(config, ports)
        self.exchanges = Exchanges(self.patience)
        self.fragments = Fragments()
        self.advertised: dict[str, str] = {}
        self.now = 0.0
        """Time of the present step (s)."""
        self.link: RosbridgeLink = (
            connect(self.url, self.heartbeat)
            if "://" in self.url
            else SimulatedLink(self.url, lambda: self.now)
        )

    @property
    def connected(self) -> bool:
        return self.link.up

    def command(self, now: float, body: Mapping[str, Any]) -> None:
        """Obey `goal` or `call` (a request, with `run` and `keep`), `cancel`, `forget`, and the
        commands of topics."""
        if "cancel" in body:
            self._send(self.exchanges.cancel(now, body["cancel"]))
        elif "forget" in body:
            self.exchanges.forget(body["forget"])
        elif not self.link.up:
            raise ValueError(f"no connection to {self.url}: {self.link.why}")
        elif "goal" in body or "call" in body:
            verb, answer = ("goal", "Result") if "goal" in body else ("call", "Response")
            request, keep = dict(body[verb]), body.get("keep")
            interface = request.get("action_type") or body.get("type", "")
            self.check(request["args"], f"{interface}.{'Goal' if verb == 'goal' else 'Request'}")
            result = self.known.get(f"{interface}.{answer}")
            if result is not None and (absent := [n for n in keep or () if n not in result]):
                has = ", ".join(result) or "none"
                raise ValueError(f"the result of {interface} has no {absent}, but: {has}")
            if verb == "goal":
                request["args"] = self.limited(request["args"], interface)
            sent = self.exchanges.begin(now, body["run"], request, keep)
            if self.dry_run:
                self.exchanges.open[body["run"]].phase = ExchangePhase.SUCCEEDED
            else:
                self._send([sent])
        else:
            super().command(now, body)

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
                self.exchanges.link(now, False)
            elif kind == "refused":
                self.refuse(item)
            elif item["op"] != "fragment":
                self._receive(now, item)
            else:
                try:
                    whole = self.fragments.add(item)
                except ValueError as fault:
                    self.refuse(str(fault))
                    continue
                if whole is not None:
                    self._receive(now, whole)
        self._send(self.exchanges.advance(now))
        super().step(now)

    def _receive(self, now: float, message: Message) -> None:
        if message["op"] == "publish":
            self.arrive(now, message.get("topic"), message.get("msg"))
        elif fault := self.exchanges.receive(now, message):
            self.refuse(fault)

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
        for message in messages if self.link.up else ():
            self.link.send(message)

    def state(self) -> Mapping[str, Any]:
        """Return the state of topics, why the link is `down`, and goals and calls by run
        (`exchanges`)."""
        exchanges = {
            name: {
                "phase": str(one.phase),
                "feedback": one.feedback,
                "count": one.count,
                "values": one.values,
                "text": one.text,
                "fault": one.fault,
            }
            for name, one in self.exchanges.open.items()
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
        moves = self.exchanges.unknown or any(one.phase in MOVING for one in goals)
        return super().stopped() and not moves

    def close(self) -> None:
        self.link.close()
