"""A party whose messages depend on all messages received so far, and a process that runs one as a
member of a cell.

Run as a script: `toy_party.py NAME TICKS ADDRESSES SCRIPTS DELAYS` (JSON), prints what it received.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from petrobot.services.comm.canopen.bus import Frame
from petrobot.services.comm.lockstep.mesh import Delays, Member
from petrobot.services.comm.lockstep.party import TICK, Envelope
from petrobot.services.comm.protocol.messages import Call

Script = Mapping[str, Sequence[tuple[str, str]]]
"""Messages to send, by tick: (party, channel)."""


class Toy:
    """Sends the messages of its script at each tick, with a digest of what it received; answers
    every third message."""

    def __init__(self, name: str, script: Script, endpoint: str = "") -> None:
        self.name = name
        self.endpoint = endpoint or f"{name}.toy"
        self.heard: list[str] = []
        self._script = script
        self._digest = hashlib.sha256(name.encode())
        self._out: list[Envelope] = []

    def receive(self, now: float, envelope: Envelope) -> None:
        line = f"{round(now / TICK)} {envelope.source} {envelope.channel} {_text(envelope.body)}"
        self.heard.append(line)
        self._digest.update(line.encode())
        if len(self.heard) % 3 == 0:
            self._say(envelope.source.split(".")[0], "call")

    def advance(self, now: float) -> None:
        for party, channel in self._script.get(str(round(now / TICK)), ()):
            self._say(party, channel)

    def drain(self) -> Sequence[Envelope]:
        out, self._out = self._out, []
        return out

    def _say(self, party: str, channel: str) -> None:
        self._out.append(
            Envelope(party, self.endpoint, f"{party}.toy", channel, self._body(channel))
        )

    def _body(self, channel: str) -> Any:
        digest = self._digest.digest()
        if channel == "can":
            return [Frame(digest[0], digest[:8]), Frame(1, b"")]
        if channel == "image":
            return {"pixels": np.frombuffer(digest, np.uint8).reshape(4, 8), "age": 0.02}
        if channel == "call":
            return Call(digest.hex()[:8], "track", {"point": (1.0, digest[1])})
        return (1.0, digest[2], [None, digest.hex()[:4]])


def _text(body: Any) -> str:
    if isinstance(body, Mapping):
        return ",".join(f"{key}={_text(value)}" for key, value in body.items())
    return f"{type(body).__name__}:{body.tolist() if isinstance(body, np.ndarray) else body!r}"


def main() -> None:
    name, ticks, addresses, scripts, delays = (
        sys.argv[1],
        *(json.loads(argument) for argument in sys.argv[2:]),
    )
    toy = Toy(name, scripts[name])
    member = Member(
        name, [toy], {peer: tuple(at) for peer, at in addresses.items()}, delays=Delays(delays)
    )
    member.open()
    why = member.run(max_ticks=ticks if name == min(addresses) else None)
    print(json.dumps({"why": why, "ticks": member.tick, "heard": toy.heard}))


if __name__ == "__main__":
    main()
