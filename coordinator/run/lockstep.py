"""The coordinator as a party of a lock-step cell: a mission run whose callers use envelopes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from petrobot.coordinator.run.mission import Mission, Stage
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.party import Envelope
from petrobot.services.comm.protocol.messages import Call, Message, Refuse, Welcome

NAME = "coordinator"


class CoordinatorParty:
    """Implements `services.comm.lockstep.party.Party`. `watch(now)` is called at each tick, to show
    progress to people; `begin(now)` when every node is connected (it starts the mission, unless a
    recorded run is continued)."""

    def __init__(
        self,
        directory: Directory,
        mission: Mission,
        watch: Callable[[float], None] | None = None,
        begin: Callable[[float], None] | None = None,
    ) -> None:
        self.name = NAME
        self.mission = mission
        self._directory = directory
        self.watch = watch
        self._begin = begin or mission.start
        self._now = 0.0
        self._nodes: dict[str, str] = {}
        """By endpoint that has sent something: its node."""
        for caller in mission.callers.values():
            caller.open(0.0)

    @property
    def over(self) -> bool:
        """Whether the mission run has finished and been scored."""
        return self.mission.stage is Stage.OVER

    def receive(self, now: float, envelope: Envelope) -> None:
        """Handle a node's message and its consequences at once, so that the order of arrival
        counts, not that of the nodes."""
        self._now = now
        node = self._nodes.get(envelope.source)
        if node is None:
            node = self._nodes[envelope.source] = self._directory.party(envelope.source)
        caller = self.mission.callers[node]
        if not caller.up and not isinstance(envelope.body, Welcome | Refuse):
            # meant for a predecessor of this process: its connection is gone, and what was on its
            # way with it
            return
        caller.receive(now, envelope.body)
        if notices := caller.notices():
            self.mission.take(now, node, notices)

    def advance(self, now: float) -> None:
        """Begin once every node has welcomed us; then do what is due."""
        mission, self._now = self.mission, now
        for node, caller in mission.callers.items():
            if now >= caller.soonest:
                caller.advance(now)
                caller.due()  # keeps `soonest` up to date
            if notices := caller.notices():
                mission.take(now, node, notices)
        mission.advance(now)
        if mission.stage is Stage.CONNECTING and all(
            caller.up for caller in mission.callers.values()
        ):
            self._begin(now)
        if self.watch is not None:
            self.watch(now)

    def drain(self) -> Sequence[Envelope]:
        """Return what was sent since the last call, in order."""
        return [
            Envelope(node, NAME, _target(node, message), "call", message)
            for node, caller in self.mission.callers.items()
            for message in caller.messages(self._now)
        ]


def _target(node: str, message: Message) -> str:
    return message.service if isinstance(message, Call) else node
