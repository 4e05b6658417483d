"""Run one party of a lock-step cell in a process of its own; shared by `python -m
petrobot.services` and `python -m petrobot.sim`."""

from __future__ import annotations

import os
import signal
import sys
from typing import Protocol

from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.mesh import Delays, Member
from petrobot.services.comm.lockstep.party import Party
from petrobot.services.comm.protocol.messages import COORDINATOR
from petrobot.services.comm.protocol.security import KeyNeededError, Keys, is_loopback
from petrobot.services.comm.tls.credentials import shared_keys


def cell_key(directory: Directory) -> Keys | None:
    """Return the key that seals the ticks of a lock-step cell: the shared key, if there is one.

    Ticks are not sent through TLS (docs/decisions/lock-step-keys.md): with certificates all
    members must be on loopback. Raises KeyNeededError if they are not, KeyFileError for a key file
    that cannot be used.
    """
    if "file" in directory.keys:
        return shared_keys(directory)
    if "certificates" in directory.keys:
        for name, (host, _) in directory.members().items():
            if not is_loopback(host):
                raise KeyNeededError(
                    f"{directory.source}: lock step does not use TLS, and {name} is at {host}: "
                    "for lock step over several hosts "
                    'write file = "cell.key" in place of certificates under [keys] '
                    "(`petrobot keys` makes it), or use one host"
                )
    return None


class Closable(Party, Protocol):
    """A party that holds resources."""

    def close(self) -> None:
        """Release them."""


def run_member(directory: Directory, name: str, party: Closable, awaited: float) -> None:
    """Run the member `name` of a lock-step cell with one process per node, until a member ends the
    cell or SIGTERM arrives.

    `awaited`: how long (s of wall time) to wait for a coordinator that died to come back; 0: not at
    all. Raises CellError when another member is lost, KeyFileError for a key file that cannot be
    used.
    """
    key = cell_key(directory)
    member = Member(
        name,
        [party],
        directory.members(),
        delays=Delays(directory.delays()),
        directory=directory.hash,
        key=key,
        returning={COORDINATOR} if awaited else (),
        absence=awaited,
    )
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    print(f"node {name} ready for lock step, process {os.getpid()}", flush=True)
    try:
        member.open()
        member.run()
    finally:
        party.close()
