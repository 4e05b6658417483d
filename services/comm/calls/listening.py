"""Why a node cannot listen at the address that services.toml gives it: file, key and remedy instead
of the system's words."""

from __future__ import annotations

import errno
import socket
from collections.abc import Iterator
from contextlib import contextmanager

from petrobot.services.comm.location_file import Directory, DirectoryError

WORDS = {
    errno.EADDRINUSE: (
        "port",
        "{port} is in use on {host}; end the process that listens there, or give another port",
    ),
    errno.EACCES: ("port", "{port} may not be used by this user; give one above 1023"),
    errno.EADDRNOTAVAIL: (
        "host",
        "{host} is no address of this host; start the node on its own host, or correct it",
    ),
}
"""By errno: the key that is at fault, and what to do about it."""


def cannot_listen(key: str, host: str, port: int, fault: OSError) -> str:
    """Why nobody can listen there; `key` is the table that holds host and port."""
    at, words = WORDS.get(
        fault.errno or 0, ("host", "cannot listen on {host}:{port}: {why}; correct host and port")
    )
    if isinstance(fault, socket.gaierror):
        at, words = "host", "{host} is no address and no known name ({why}); correct it"
    return f"{key}.{at}: " + words.format(host=host, port=port, why=fault.strerror or fault)


@contextmanager
def listening(directory: Directory, node: str) -> Iterator[None]:
    """What fails to listen in here is the address's fault. Raises DirectoryError in place of
    OSError."""
    try:
        yield
    except OSError as fault:
        host, port = directory.address(node)
        text = cannot_listen(f"nodes.{node}", host, port, fault)
        raise DirectoryError((f"{directory.source}: {text}",)) from fault


def refuse_unusable(directory: Directory, node: str) -> None:
    """Refuse an address that cannot be had, before devices are touched: a second process of a node
    must leave those of the first alone. Raises DirectoryError."""
    host, port = directory.address(node)
    with listening(directory, node):
        family, kind, number, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[
            0
        ]
        with socket.socket(family, kind, number) as probe:
            probe.setsockopt(
                socket.SOL_SOCKET, socket.SO_REUSEADDR, 1
            )  # as the listener: what has ended is not in the way
            probe.bind(address)
