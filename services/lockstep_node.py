"""A node as a party of a lock-step cell: drivers and actions inline, the outside world through
envelopes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from petrobot.services.callables import describe
from petrobot.services.comm.cell import CellError
from petrobot.services.comm.channels import set_point_body
from petrobot.services.comm.directory import Directory
from petrobot.services.comm.messages import (
    Accept,
    Answer,
    Call,
    Event,
    Feedback,
    Hello,
    Message,
    Outcome,
    Pong,
    Refuse,
    Welcome,
)
from petrobot.services.comm.party import Envelope
from petrobot.services.drivers import make_driver
from petrobot.services.execution import Hung
from petrobot.services.lockstep_ports import LockstepPorts
from petrobot.services.node import GENERAL, Node
from petrobot.services.place import InlinePlace, Place
from petrobot.services.watchdog import Watchdog

Substitutes = Mapping[str, Callable[..., Any]]
_ANSWERS = (Welcome, Refuse, Accept, Feedback, Outcome, Event, Answer, Pong)
"""Messages that a called end sends."""


class LockstepNode:
    """Implements `services.comm.party.Party` for one node of services.toml. Raises DirectoryError
    when a driver refuses.

    Endpoints send under their own names (action, device, service, timer), whatever node they live
    on, and a call to one's own node takes the same way as any other: so moving an action to another
    node changes nothing.
    """

    def __init__(
        self, directory: Directory, name: str, *, substitutes: Substitutes | None = None
    ) -> None:
        self.name = name
        self._directory = directory
        self._substitutes = substitutes
        self._watchdog = Watchdog(name)
        self._now = 0.0
        self._out: list[Envelope] = []
        self._ports: dict[str, LockstepPorts] = {}
        self._heard = True
        """Whether a message has come since the last tick."""
        self._parties: dict[str, str] = {}
        """By endpoint, as far as it was asked: the party that it lives in."""
        self._ends: dict[str, tuple[str, str]] = {}
        """By call id: the endpoint that calls, and the one that is called."""
        devices = [d for d in directory.devices.values() if d.node == name]
        places: dict[str, Place] = {d.name: self._place(d.name) for d in devices}
        places[GENERAL] = self._place(GENERAL)
        boot = f"{name} in lock step"
        self.node = Node(directory, name, boot=boot, clock=self._clock, places=places, virtual=True)
        for peer in sorted(directory.nodes):
            self.node.caller(peer).open(0.0)

    def _clock(self) -> float:
        return self._now

    def _place(self, device: str) -> Place:
        directory, driver = self._directory, None
        if device != GENERAL:
            entry = directory.devices[device]
            ports = self._ports[device] = LockstepPorts(
                directory, entry, self._clock, self._out.append
            )
            driver = make_driver(directory, entry, ports)
        return InlinePlace(
            {
                a.name: a
                for a in directory.actions.values()
                if a.node == self.name and a.device == device
            },
            clock=self._clock,
            driver=driver,
            streams={s.name: s.period for s in directory.streams.values()},
            substitutes=self._substitutes,
            virtual=True,
        )

    # --- party --------------------------------------------------------------------------------

    def receive(self, now: float, envelope: Envelope) -> None:
        """Take an envelope that is due. Raises CellError when code that is called hangs."""
        self._guarded(lambda: self._receive(now, envelope))

    def _receive(self, now: float, envelope: Envelope) -> None:
        self._now = now
        if envelope.channel == "call":
            self._heard = True
            self._receive_message(now, envelope, envelope.body)
        elif envelope.target in self._ports:
            self._ports[envelope.target].receive(envelope)

    def advance(self, now: float) -> None:
        """Do all that is due. Raises CellError when code that is called hangs."""
        self._guarded(lambda: self._advance(now))

    def _guarded(self, step: Callable[[], None]) -> None:
        self._watchdog.begin()
        try:
            step()
        except Hung as fault:  # not in an action, or its run would have ended with it
            raise CellError(f"node {self.name}: {describe(fault)}") from fault
        finally:
            self._watchdog.end()

    def _advance(self, now: float) -> None:
        self._now = now
        news = self._advance_node(now)
        for device, ports in self._ports.items():
            ports.flush()
            for name, data in ports.raised():
                self.node.callee.raise_event(now, name, data, source=device, latched=True)
                news = True
        if news:
            self._send_set_points()
            self._send_messages(now)

    def _advance_node(self, now: float) -> bool:
        """Let the node do all that is due; says whether anything may have come of it. In most ticks
        no message has come, and the ends of calls need not be looked at."""
        node = self.node
        if self._heard or not node.ends_quiet(now):
            self._heard = False
            node.advance(now)
            return True
        news = node.advance_places(now)
        if news:
            node.settle(now)
        return news

    def _send_set_points(self) -> None:
        for action, sent in self.node.sent:
            stream = self._directory.streams[sent.stream]
            body = set_point_body(sent.stream, sent.values, sent.elapsed, stream.period)
            self._out.append(
                Envelope(self._directory.where(sent.stream), action, stream.to, "stream", body)
            )
        self.node.sent.clear()

    def drain(self) -> Sequence[Envelope]:
        """What was sent since the last call, in order."""
        if not self._out:
            return ()
        out = self._out[:]
        self._out.clear()
        return out

    def close(self) -> None:
        """Let the devices go."""
        self._watchdog.close()
        self.node.close(self._now)

    # --- messages -----------------------------------------------------------------------------

    def _receive_message(self, now: float, envelope: Envelope, message: Message) -> None:
        peer = self._parties.get(envelope.source)
        if peer is None:
            peer = self._parties[envelope.source] = self._directory.party(envelope.source)
        if isinstance(message, _ANSWERS):
            self.node.caller(peer).receive(now, message)
        elif isinstance(message, Hello):
            local = self._directory.same_host(self.name, peer)
            self._post(
                peer, self.name, peer, self.node.callee.link_up(now, peer, message, local=local)
            )
        else:
            if isinstance(message, Call):
                self._ends[message.id] = (envelope.source, message.service)
            self.node.callee.receive(now, peer, message)

    def _send_messages(self, now: float) -> None:
        for peer, message in self.node.callee.messages():
            source, target = self._answering_ends(peer, message)
            self._post(peer, source, target, message)
        for peer, caller in self.node.callers.items():
            for message in caller.messages(now):
                source, target = self._calling_ends(peer, message)
                self._post(peer, source, target, message)

    def _answering_ends(self, peer: str, message: Message) -> tuple[str, str]:
        if isinstance(message, Event):
            return message.source, peer
        if isinstance(message, Outcome) and message.id in self._ends:
            target, source = self._ends.pop(message.id)
            return source, target
        if isinstance(message, Accept | Feedback) and message.id in self._ends:
            target, source = self._ends[message.id]
            return source, target
        return self.name, peer

    def _calling_ends(self, peer: str, message: Message) -> tuple[str, str]:
        if isinstance(message, Call):
            return self.node.action_of(message.parent), message.service
        return self.name, peer

    def _post(self, party: str, source: str, target: str, message: Message) -> None:
        self._out.append(Envelope(party, source, target, "call", message))
