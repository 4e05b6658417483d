"""The coordinator as a party of a lock-step cell: a mission run whose callers use envelopes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from petrobot.coordinator.engine import Abort, Engine, Fired, Instruction, Report, State, Stimulus
from petrobot.coordinator.engine.firing import DEAD_END
from petrobot.coordinator.run.mission import Mission, Stage
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.party import Envelope
from petrobot.services.comm.protocol.messages import Call, Feedback, Message, Refuse, Welcome

NAME = "coordinator"
PATIENCE = 1800.0
"""Simulated time for which a mission run without an operator waits for an event (s). Nothing tells
whether the laboratory will raise it, so this must be longer than any button takes."""
LOOK = 60.0
"""Simulated time between two checks whether the task can still end (s)."""


class _Waiting:
    """An observer that notes since when the mission run has waited for events alone. What listening
    branches do meanwhile does not end the wait."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.since: float | None = None
        self.dead = False
        """Whether no event can end the wait."""

    def instruction(self, now: float, instruction: Instruction) -> None:
        """A firing of the task itself begins a new wait."""
        if (
            isinstance(instruction, Fired)
            and instruction.transition in self._engine.compiled.advancing
        ):
            self.since = None
        if isinstance(instruction, Fired):
            self.dead = False
        elif isinstance(instruction, Report) and instruction.key == DEAD_END:
            self.dead = True

    def settled(self, now: float, state: State) -> None:
        """Begin or end a wait."""
        if not self._engine.only_listens(state):
            self.since = None
        elif self.since is None:
            self.since = now

    def stimulus(self, now: float, stimulus: Stimulus) -> None:
        """Nothing to note."""

    def progress(self, now: float, run: str, notice: Feedback) -> None:
        """Nothing to note."""


class CoordinatorParty:
    """Implements `services.comm.lockstep.party.Party`. `watch(now)` is called at each tick, to show
    progress to people; `begin(now)` when every node is connected (it starts the mission, unless a
    recorded run is continued).

    A mission run that waits for an event longer than `PATIENCE`, and twice the period of each timer
    of the location file, that no event can continue, or that provably can neither end nor meet a
    goal any more, is aborted, unless it is `attended`: an operator may raise the event, or add
    tokens.
    """

    def __init__(
        self,
        directory: Directory,
        mission: Mission,
        begin: Callable[[float], None] | None = None,
    ) -> None:
        self.name = NAME
        self.mission = mission
        self.attended = False
        self._directory = directory
        periods = (timer.period for timer in directory.timers.values())
        self._patience = max(PATIENCE, 2.0 * max(periods, default=0.0))
        self._look = LOOK
        self._waiting = _Waiting(mission.executor.engine)
        mission.executor.observers.append(self._waiting)
        self.watch: Callable[[float], None] | None = None
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
            if caller.has_news:
                mission.take(now, node, caller.notices())
        self._abort_if_stuck(now)
        mission.advance(now)
        if mission.stage is Stage.CONNECTING and all(
            caller.up for caller in mission.callers.values()
        ):
            self._begin(now)
        if self.watch is not None:
            self.watch(now)

    def _abort_if_stuck(self, now: float) -> None:
        executor, waiting, why = self.mission.executor, self._waiting, ""
        engine, chances = executor.engine, True
        if waiting.since is not None and (waiting.dead or now >= waiting.since + self._patience):
            waited = f"waited {self._patience:.0f} s of simulated time"
            why, waiting.since = "nothing can happen any more" if waiting.dead else waited, None
        elif now >= self._look:
            self._look = now + LOOK
            if not self.attended and not engine.can_end(executor.state):
                why, chances = "the task can never end, whatever still happens", False
        if why and not self.attended:
            missing = engine.stuck_for(executor.state, chances)
            executor.stimulate(now, Abort(f"{why}, and no operator can act: {missing}", stuck=True))

    def drain(self) -> Sequence[Envelope]:
        """Return what was sent since the last call, in order."""
        out: list[Envelope] = []
        for node, caller in self.mission.callers.items():
            for message in caller.messages(self._now):
                out.append(Envelope(node, NAME, _target(node, message), "call", message))
        return out


def _target(node: str, message: Message) -> str:
    return message.service if isinstance(message, Call) else node
