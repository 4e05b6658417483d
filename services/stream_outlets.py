"""All streams that a worker sends: finds the receivers through its node, keeps the connections,
drops what cannot go now."""

from __future__ import annotations

import math

from petrobot.services.comm.credentials import credentials
from petrobot.services.comm.directory import Directory
from petrobot.services.comm.stream import StreamSender
from petrobot.services.runs import Sent

ASK_AGAIN = 0.25
"""Seconds between questions for the address of a receiver that is not there."""


class StreamOutlets:
    """Sending ends by stream, made when first needed. A receiver that does not take a stream is
    asked for anew."""

    def __init__(self, directory: Directory, sender: str) -> None:
        self._sender = sender
        self._streams = directory.streams
        self._credentials = credentials(directory, sender)
        self._outlets: dict[str, StreamSender] = {}
        self._asked: dict[str, float] = {}

    def send(self, now: float, sent: Sent) -> bool:
        """Send a set point. True when the stream's address is wanted (again)."""
        outlet = self._outlets.get(sent.stream)
        if outlet is not None and outlet.send(sent.values, sent.elapsed):
            return False
        if now < self._asked.get(sent.stream, -math.inf) + ASK_AGAIN:
            return False
        self._asked[sent.stream] = now
        return outlet is None or not outlet.up

    def found(self, stream: str, host: str, port: int, ticket: str) -> None:
        """A stream's address is known: connect, unless it is connected there."""
        older = self._outlets.get(stream)
        if older is not None and older.up:
            return
        if older is not None:
            older.close()
        key, entry = self._credentials.stream_key(ticket), self._streams[stream]
        outlet = StreamSender(
            self._sender,
            stream,
            entry.period,
            host,
            port,
            receiver=entry.to,
            ticket=ticket,
            key=key,
        )
        outlet.advance()
        self._outlets[stream] = outlet

    def advance(self) -> bool:
        """Look after the connections; True while one is being opened."""
        lines = [outlet.advance() for outlet in self._outlets.values()]
        return None in lines

    def close(self) -> None:
        """End all streams."""
        for outlet in self._outlets.values():
            outlet.close()
