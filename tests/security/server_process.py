"""A server of the node protocol in a separate process, so that its memory can be measured: `python
server_process.py JSON`.

Prints its port; each line on standard input is answered by one line of JSON about it.
"""

from __future__ import annotations

import asyncio
import gc
import json
import resource
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from petrobot.services.comm.calls.callee import Callee, Offer, Retention
from petrobot.services.comm.calls.link import LinkLimits, LinkTiming
from petrobot.services.comm.calls.server import Server
from petrobot.services.comm.protocol.messages import Call, Outcome
from petrobot.services.comm.tls.credentials import Credentials


def echo(now: float, call: Call) -> Outcome:
    """Return the arguments (the offered action)."""
    return Outcome(call.id, "success", call.arguments)


def big(now: float, call: Call) -> Outcome:
    """Return a result of this many bytes."""
    return Outcome(call.id, "success", {"b": bytes(call.arguments["bytes"])})


def build(settings: dict[str, Any]) -> Server:
    """Return the server that the settings describe."""
    offers = {
        "echo": Offer(inline=echo),
        "big": Offer(inline=big),
        "tune": Offer(scope="local", inline=echo),
    }
    callee = Callee("vision", "v1", offers, keeping=Retention(**settings.get("keeping", {})))
    key = bytes.fromhex(settings["key"]) if "key" in settings else None
    folder = Path(settings["folder"]) if "folder" in settings else None
    # An impostor does not check that the rest of the cell will accept its certificate.
    tls = Credentials("vision", None, folder)._load(folder, listens=True) if folder else None
    timing, limits = (
        LinkTiming(**settings.get("timing", {})),
        LinkLimits(**settings.get("limits", {})),
    )
    return Server(callee, key=key, tls=tls, timing=timing, limits=limits)


def about(server: Server, deep: bool) -> dict[str, Any]:
    """Return the numbers that a test asks for; `deep` also counts links that only wait for the
    garbage collector."""
    gc.collect() if deep else None
    links = [one for one in gc.get_objects() if type(one).__name__ == "_ServerLink"] if deep else []
    fds = len(list(Path("/proc/self/fd").iterdir()))
    return {
        "faults": server.faults, "links": len(links), "all": len(server._all),
        "opening": len(server._opening),
        "tasks": len(asyncio.all_tasks()), "connected": server.connected, "fds": fds,
    }  # fmt: skip


async def main(settings: dict[str, Any]) -> None:
    """Serve until standard input ends."""
    if "files" in settings:
        resource.setrlimit(resource.RLIMIT_NOFILE, (settings["files"], settings["files"]))
    server = build(settings)
    await server.start(settings.get("host", "127.0.0.1"), 0)
    print(server.address[1], flush=True)
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), sys.stdin
    )
    while question := await reader.readline():
        print(json.dumps(about(server, b"deep" in question)), flush=True)
    await server.close()


if __name__ == "__main__":
    asyncio.run(main(json.loads(sys.argv[1])))
