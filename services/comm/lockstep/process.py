"""A process of its own for one party of a lock-step cell: what `python -m petrobot.services` and
`python -m petrobot.sim` share."""

from __future__ import annotations

import os
import signal
import sys
from typing import Protocol

from petrobot.services.comm.location_file import COORDINATOR, Directory
from petrobot.services.comm.lockstep.mesh import Delays, Member
from petrobot.services.comm.lockstep.party import Party
from petrobot.services.comm.protocol.security import KeyNeededError, Keys, is_loopback
from petrobot.services.comm.tls.credentials import shared_keys


def cell_key(directory: Directory) -> Keys | None:
    """What seals the ticks of a lock-step cell: the shared key, if there is one.

    Ticks cross no TLS (docs/decisions/lock-step-doors.md): with certificates all members must be on
    loopback. Raises KeyNeededError where they are not, KeyFileError for a key file that cannot be
    used.
    """
    if "file" in directory.keys:
        return shared_keys(directory)
    if "certificates" in directory.keys:
        for name, (host, _) in directory.members().items():
            if not is_loopback(host):
                raise KeyNeededError(
                    f"{directory.source}: lock step crosses no TLS, and {name} is at {host}: "
                    "for lock step over several hosts "
                    'write file = "cell.key" in place of certificates under [keys] '
                    "(`petrobot keys` makes it), or use one host"
                )
    return None


class Closable(Party, Protocol):
    """A party that holds something to be given back."""

    def close(self) -> None:
        """Give back what it holds."""


def run_member(directory: Directory, name: str, party: Closable, awaited: float) -> None:
    """Be the member `name` of a lock-step cell of one process a node, until one of them ends it or
    SIGTERM comes.

    `awaited`: seconds (wall time) that a coordinator which died may take to come back; 0: it is not
    waited for. Raises CellError when another member is lost, KeyFileError for a key file that
    cannot be used.
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
