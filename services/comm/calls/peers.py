"""The callers of a node: which are welcome, which are connected, and which one holds the lease of
each device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from msgspec import Struct

from petrobot.services.comm.protocol.messages import COORDINATOR, Call, Hello, Outcome, Refuse
from petrobot.services.comm.protocol.wire import NEWEST_VERSION, OLDEST_VERSION, negotiate

Inline = Callable[[float, Call], Outcome]
"""A service answered at once, in the node's event loop: (now, call) to outcome. It must neither
wait nor compute for long."""


class Offer(Struct, frozen=True):
    """An action or service that this node offers."""

    scope: str = "network"
    """"network", or "local" for callers on this host only."""
    device: str = ""
    orphan_time: float | None = None
    """How long a run stays active without its caller (s); None: without limit."""
    deadline: float | None = None
    """Deadline of a call that names none (s)."""
    inline: Inline | None = None
    roles: frozenset[str] = frozenset()
    """Roles of the callers that may call it; empty: all."""


NODE: Final = "node"
LEASED: Final = "device_leased"
"""Cause of a refusal: another caller holds the lease of the device."""
OVERTAKEN: Final = "device_overtaken"
"""Cause of a refusal: this coordinator lost the device while it was away, and another one has used
it since, so its position is unknown."""
KNOWN: Final = 256
"""How many callers are remembered after their connection closed, and how many lost leases."""


class Peer(Struct):
    """What is known about one caller."""

    role: str
    boot: str
    epoch: int
    local: bool
    up: bool = True
    down_at: float = 0.0


class Peers:
    """The callers of one node by name, one process per name.

    `lease` is how long (s) an absent caller keeps its devices.
    """

    def __init__(self, node: str, directory: str, any_directory: bool, lease: float) -> None:
        self._node = node
        self._directory = directory
        self._any_directory = any_directory
        self._lease_time = lease
        self._peers: dict[str, Peer] = {}
        self._leases: dict[str, str] = {}
        self._overtaken: dict[tuple[str, str], str] = {}
        """Which caller took a device from an absent coordinator, by device and the coordinator's
        boot: a new process of it (`resume`) may have the device again."""

    def get(self, name: str) -> Peer | None:
        """Return what is known about this caller."""
        return self._peers.get(name)

    def is_up(self, name: str) -> bool:
        """Return whether this caller is connected."""
        peer = self._peers.get(name)
        return peer is not None and peer.up

    def coordinators(self) -> list[str]:
        """Return the names of the connected coordinators."""
        return [n for n, peer in self._peers.items() if peer.up and peer.role == COORDINATOR]

    def refusal(self, name: str, hello: Hello) -> Refuse | None:
        """Return why this process is not welcome under this name; None if it is welcome."""
        if negotiate(hello.oldest_version, hello.newest_version) is None:
            spoken = f"{OLDEST_VERSION} to {NEWEST_VERSION}"
            asked = f"{hello.oldest_version} to {hello.newest_version}"
            return Refuse(
                "version",
                f"{self._node} speaks versions {spoken}, the caller {asked}: update the older side",
            )
        known = self._peers.get(name)
        if known is not None and hello.epoch < known.epoch:
            text = (
                f"{name} was connected with epoch {known.epoch}, this process has epoch "
                f"{hello.epoch}: a newer process has taken over"
            )
            return Refuse("old_epoch", text)
        if (
            known is not None
            and known.up
            and known.boot != hello.boot
            and hello.epoch == known.epoch
        ):
            return Refuse(
                "name_taken",
                f"another process is connected as {name}: stop it, or use another name",
            )
        mine, its = self._directory, hello.directory
        if hello.role == "client" and its:  # who only asks may ask in a dry run, too
            its = mine if mine.split()[-1:] == its.split()[-1:] else its
        if mine and its and mine != its and not self._any_directory:
            text = (
                f"the caller's services.toml ({_short(its)}) differs from that of "
                f"{self._node} ({_short(mine)})"
            )
            remedy = "copy the same file to each host and start its node again"
            if mine.split()[-1] == its.split()[-1]:
                remedy = "one of them is in a dry run: give --dry-run to both, or to none"
            return Refuse("directory", f"{text}: {remedy}")
        return None

    def come(self, name: str, hello: Hello, local: bool) -> str:
        """Note that a caller is connected.

        Return the name of the caller that is forgotten for it (the longest absent one, if there are
        too many); else empty.
        """
        self._peers.pop(name, None)
        self._peers[name] = Peer(hello.role, hello.boot, hello.epoch, local)
        if len(self._peers) > KNOWN:
            away = next((other for other, peer in self._peers.items() if not peer.up), None)
            if away is not None:
                del self._peers[away]
                return away
        return ""

    def go(self, now: float, name: str, leaves: bool) -> bool:
        """Note that a caller's connection is closed; return whether it was connected. With `leaves`
        it gives up its leases."""
        peer = self._peers.get(name)
        if peer is None or not peer.up:
            return False
        peer.up, peer.down_at = False, now
        if leaves:
            self._leases = {
                device: holder for device, holder in self._leases.items() if holder != name
            }
        return True

    def refusal_of_call(
        self, now: float, name: str, call: Call, offer: Offer | None, in_use: Callable[[str], bool]
    ) -> tuple[str, str] | None:
        """Return why this call must not begin: cause and text; None if it may begin.

        In that case the caller then holds the lease of the call's device. `in_use(device)` tells
        whether an active run needs it.
        """
        peer = self._peers.get(name)
        if peer is None or not peer.up:
            return "not_welcome", f"{name} is not connected to {self._node}: send HELLO first"
        if offer is None:
            return (
                "unknown_service",
                f"{self._node} does not offer {call.service}: see services.toml for its node",
            )
        if call.epoch < peer.epoch and peer.role == COORDINATOR:
            return (
                "old_epoch",
                f"{name} is at epoch {peer.epoch}, but the call has the older epoch {call.epoch}",
            )
        if offer.scope == "local" and not peer.local:
            return "local_only", f"{call.service} only serves callers on the host of {self._node}"
        if offer.roles and peer.role not in offer.roles:
            return (
                "not_for_role",
                f"{call.service} only serves {' and '.join(sorted(offer.roles))}, "
                f"not a {peer.role}",
            )
        return self.lease(now, name, offer.device, in_use) if offer.device else None

    def lease(
        self, now: float, name: str, device: str, in_use: Callable[[str], bool]
    ) -> tuple[str, str] | None:
        """Let this caller hold the lease of a device. Return why not: cause and text; None if it
        holds it."""
        peer = self._peers.get(name)
        if peer is None or peer.role == NODE:
            return (
                "device_needs_coordinator",
                f"{device} only accepts orders from a coordinator, not from node {name}",
            )
        if (other := self._overtaken.get((device, peer.boot))) is not None:
            return (
                OVERTAKEN,
                f"{other} has used {device} while {name} was away for more than "
                f"{self._lease_time:g} s",
            )
        holder = self._leases.get(device, name)
        if holder != name:
            if self._is_near(now, holder) or in_use(device):
                return LEASED, f"{device} accepts orders from {holder} at the moment"
            absent = self._peers.get(holder)
            if absent is not None and absent.role == COORDINATOR:
                self._overtaken[device, absent.boot] = name
                if len(self._overtaken) > KNOWN:
                    del self._overtaken[next(iter(self._overtaken))]
        self._leases[device] = name
        return None

    def _is_near(self, now: float, name: str) -> bool:
        peer = self._peers.get(name)
        return peer is not None and (peer.up or now < peer.down_at + self._lease_time)

    def is_away(self, now: float, name: str, seconds: float) -> bool:
        """Return whether this caller has been away for this long (s)."""
        peer = self._peers.get(name)
        return peer is None or (not peer.up and now >= peer.down_at + seconds)


def _short(directory: str) -> str:
    """Return the hash of a location file in short, whole words before it."""
    *words, digest = directory.split()
    return " ".join((*words, digest[:12]))
