"""Ports for servers that tests start: free, and nobody else's until they are listened on."""

from __future__ import annotations

import atexit
import socket
from collections import deque

KEPT = 256
"""Ports that one test process keeps: more than any test uses, and far from the limit of open
files."""

_kept: deque[socket.socket] = deque()


@atexit.register
def _close() -> None:
    for probe in _kept:
        probe.close()


def free_ports(count: int) -> list[int]:
    """Ports of this host that nobody listens on now.

    They stay bound here, without being listened on, so that the system gives them to no other test
    that runs beside this one, and to no client as its own end. Servers set SO_REUSEADDR and may
    listen there all the same, as often as they like.
    """
    ports = []
    for _ in range(count):
        probe = socket.socket()
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        probe.bind(("127.0.0.1", 0))
        _kept.append(probe)
        ports.append(int(probe.getsockname()[1]))
    while len(_kept) > KEPT:
        _kept.popleft().close()
    return ports
