"""A TCP proxy between coordinator and nodes that cuts, delays and repeats: `proxy.py PORT:NODE_PORT
...`, commands on standard input.

Commands, one per line: `cut N` breaks the connections of the N-th pair, `delay N SECONDS` delays
both directions, `repeat N` sends the next frame of each direction twice. Frames are separated by
their length (docs/protocol.md); the handshake is passed on as it is.
"""

from __future__ import annotations

import asyncio
import struct
import sys

HANDSHAKE = 1
"""Frames at the beginning of each direction that are never repeated."""
_LENGTH = struct.Struct(">I")


class Pair:
    """One listening port and the node behind it."""

    def __init__(self, node_port: int) -> None:
        self._node_port = node_port
        self._writers: set[asyncio.StreamWriter] = set()
        self._open = asyncio.Event()
        self._open.set()
        self._repeats = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Forward a connection until it ends."""
        try:
            there, back = await asyncio.open_connection("127.0.0.1", self._node_port)
        except OSError:
            writer.transport.abort()
            return
        self._writers |= {writer, back}
        await asyncio.gather(
            self._pass(reader, back), self._pass(there, writer), return_exceptions=True
        )
        for end in (writer, back):
            end.transport.abort()
            self._writers.discard(end)

    async def _pass(self, source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
        frames = 0
        try:
            while True:
                head = await source.readexactly(_LENGTH.size)
                frame = head + await source.readexactly(_LENGTH.unpack(head)[0])
                await self._open.wait()
                target.write(frame)
                frames += 1
                if self._repeats and frames > HANDSHAKE:
                    self._repeats -= 1
                    target.write(frame)
        except (asyncio.IncompleteReadError, OSError):
            target.transport.abort()

    def cut(self) -> None:
        """Break all connections, in both directions."""
        for writer in list(self._writers):
            writer.transport.abort()

    def delay(self, seconds: float) -> None:
        """Forward nothing for a while, then everything that arrived meanwhile."""
        self._open.clear()
        asyncio.get_running_loop().call_later(seconds, self._open.set)

    def repeat(self) -> None:
        """Send the next frame twice."""
        self._repeats += 1


async def main(pairs: list[str]) -> None:
    """Serve until standard input ends."""
    ports = [tuple(map(int, pair.split(":"))) for pair in pairs]
    served = [Pair(node) for _, node in ports]
    for (port, _), pair in zip(ports, served, strict=True):
        await asyncio.start_server(pair.serve, "127.0.0.1", port)
    loop, orders = asyncio.get_running_loop(), asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(orders), sys.stdin)
    print("ready", flush=True)
    while line := (await orders.readline()).decode():
        verb, which, *rest = line.split()
        getattr(served[int(which)], verb)(*map(float, rest))
    for pair in served:
        pair.cut()


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1:]))
