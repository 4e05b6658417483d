"""Who calls a node: whom it welcomes, whose link is up, and who holds the lease of which device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from petrobot.services.comm.protocol.messages import Call, Hello, Outcome, Refuse
from petrobot.services.comm.protocol.wire import NEWEST_VERSION, OLDEST_VERSION, negotiate

# What a node offers to its callers, and what its callee orders it to do.

Inline = Callable[[float, Call], Outcome]
"""A service answered on the spot, in the node's loop: (now, call) to outcome. It must neither wait
nor compute for long."""


@dataclass(frozen=True, slots=True)
class Offer:
    """An action or service of this node."""

    scope: str = "network"
    """"network", or "local": for callers on this host alone."""
    device: str = ""
    orphan_time: float | None = None
    """Seconds that a run goes on without its caller; None: for ever."""
    deadline: float | None = None
    """Seconds for a call that names none."""
    inline: Inline | None = None
    roles: frozenset[str] = frozenset()
    """Roles of the callers that may call it; none: all."""


COORDINATOR: Final = "coordinator"
NODE: Final = "node"
KNOWN: Final = 256
"""Callers that are remembered after their link went down."""


@dataclass(slots=True)
class Peer:
    """What is known of a caller."""

    role: str
    boot: str
    epoch: int
    local: bool
    up: bool = True
    down_at: float = 0.0


class Peers:
    """The callers of one node, by name; one process a name. `lease` is how long (s) one that is
    away keeps its devices."""

    def __init__(self, node: str, directory: str, any_directory: bool, lease: float) -> None:
        self._node = node
        self._directory = directory
        self._any_directory = any_directory
        self._lease_time = lease
        self._peers: dict[str, Peer] = {}
        self._leases: dict[str, str] = {}

    def get(self, name: str) -> Peer | None:
        """What is known of this caller."""
        return self._peers.get(name)

    def is_up(self, name: str) -> bool:
        """Whether this caller's link is up."""
        peer = self._peers.get(name)
        return peer is not None and peer.up

    def refusal(self, name: str, hello: Hello) -> Refuse | None:
        """Why this process is not welcome under this name; None if it is."""
        if negotiate(hello.oldest_version, hello.newest_version) is None:
            spoken = f"{OLDEST_VERSION} to {NEWEST_VERSION}"
            asked = f"{hello.oldest_version} to {hello.newest_version}"
            return Refuse(
                "version",
                f"{self._node} speaks versions {spoken}, you {asked}: update the older side",
            )
        known = self._peers.get(name)
        if known is not None and hello.epoch < known.epoch:
            text = (
                f"{name} has been here with epoch {known.epoch}, you come with "
                f"{hello.epoch}: a newer one has taken over"
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
                f"another process is connected as {name}: stop it, or take another name",
            )
        mine, its = self._directory, hello.directory
        if mine and its and mine != its and not self._any_directory:
            text = f"your services.toml ({its[:12]}) is not {self._node}'s ({mine[:12]})"
            return Refuse(
                "directory", f"{text}: copy the same file to each host and start its node again"
            )
        return None

    def come(self, name: str, hello: Hello, local: bool) -> str:
        """A caller is welcome. Gives the name of the oldest of too many that are away, which is
        forgotten; else empty."""
        self._peers.pop(name, None)
        self._peers[name] = Peer(hello.role, hello.boot, hello.epoch, local)
        if len(self._peers) > KNOWN:
            away = next((other for other, peer in self._peers.items() if not peer.up), None)
            if away is not None:
                del self._peers[away]
                return away
        return ""

    def go(self, now: float, name: str, leaves: bool) -> bool:
        """A caller's link is down; with `leaves` it gives up its leases. Says whether it was up."""
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
        """Why this call is not begun: cause and text; None if it is, and then the caller holds the
        lease of its device.

        `in_use(device)` says whether a run goes on that needs it.
        """
        peer = self._peers.get(name)
        if peer is None or not peer.up:
            return "not_welcome", f"{name} has not been welcomed by {self._node}"
        if offer is None:
            return (
                "unknown_service",
                f"{self._node} offers no {call.service}: services.toml places it elsewhere "
                "or nowhere",
            )
        if call.epoch < peer.epoch and peer.role == COORDINATOR:
            return (
                "old_epoch",
                f"{name} is at epoch {peer.epoch}, the call is of epoch {call.epoch}",
            )
        if offer.scope == "local" and not peer.local:
            return "local_only", f"{call.service} serves callers on the host of {self._node} alone"
        if offer.roles and peer.role not in offer.roles:
            return (
                "not_for_role",
                f"{call.service} serves {' and '.join(sorted(offer.roles))}, not a {peer.role}",
            )
        return self._lease(now, name, peer, offer.device, in_use) if offer.device else None

    def _lease(
        self, now: float, name: str, peer: Peer, device: str, in_use: Callable[[str], bool]
    ) -> tuple[str, str] | None:
        if peer.role == NODE:
            return (
                "device_needs_coordinator",
                f"{device} takes orders from a coordinator alone, not from node {name}",
            )
        holder = self._leases.get(device, name)
        if holder != name and (self._is_near(now, holder) or in_use(device)):
            return "device_leased", f"{device} takes orders from {holder}"
        self._leases[device] = name
        return None

    def _is_near(self, now: float, name: str) -> bool:
        peer = self._peers.get(name)
        return peer is not None and (peer.up or now < peer.down_at + self._lease_time)

    def is_away(self, now: float, name: str, seconds: float) -> bool:
        """Whether this caller has been away for so long."""
        peer = self._peers.get(name)
        return peer is None or (not peer.up and now >= peer.down_at + seconds)
