"""The working copy of a state while one stimulus changes it, with the instructions so far and the
transitions to examine again."""

from __future__ import annotations

from petrobot.coordinator.engine.compiled import Compiled
from petrobot.coordinator.engine.instructions import Instruction, Report
from petrobot.coordinator.engine.state import LIVE, Mode, Phase, Run, State
from petrobot.coordinator.task import Value
from petrobot.coordinator.task.net import Marking
from petrobot.coordinator.task.wording import Severity


class Draft:
    """The working copy. `freeze` gives the next state; the old one does not change.

    The containers are copied, but not what they hold: runs and timers are immutable and replaced.
    So a state stays valid however many stimuli are tried from it, as the analysis does.
    """

    def __init__(self, compiled: Compiled, state: State) -> None:
        self.compiled = compiled
        self.instructions: list[Instruction] = []
        self.dirty: set[int] = set()
        """Transitions that may have become fireable."""
        self.retime: set[int] = set()
        """Timed transitions whose timer may have to be armed or disarmed."""
        self.mode = state.mode
        self.stimuli = state.stimuli + 1
        self.firings = state.firings
        self.timeless = state.timeless
        self.marking: list[int] = list(state.marking)
        self.variables: dict[str, Value] = dict(state.variables)
        self.tokens: dict[str, tuple[Run, ...]] = dict(state.tokens)
        self.stopping: dict[str, Run] = dict(state.stopping)
        self.started: dict[str, int] = dict(state.started)
        self.run_order = state.run_order
        self.end_order = state.end_order
        self.flags: set[str] = set(state.flags)
        self.seen = dict(state.seen)
        self.timers = dict(state.timers)
        self.timer_order = state.timer_order
        # `waits`, `deferred` and `early` may grow long and seldom change: replaced, never changed
        # in place, so that no stimulus has to copy them.
        self.waits = state.waits
        self.suspended = state.suspended
        self.backlog = list(state.backlog)
        self.breakpoints = state.breakpoints
        self.overrides = state.overrides
        self.deferred = state.deferred
        self.early = state.early
        self.told: set[str] = set(state.told)
        self.ending = state.ending
        self.closing = state.closing

    def freeze(self) -> State:
        """Return the next state."""
        return State(
            marking=tuple(self.marking),
            variables=self.variables,
            mode=self.mode,
            stimuli=self.stimuli,
            firings=self.firings,
            timeless=self.timeless,
            tokens=self.tokens,
            stopping=self.stopping,
            started=self.started,
            run_order=self.run_order,
            end_order=self.end_order,
            flags=frozenset(self.flags),
            seen=self.seen,
            timers=self.timers,
            timer_order=self.timer_order,
            waits=self.waits,
            suspended=self.suspended,
            backlog=tuple(self.backlog),
            breakpoints=self.breakpoints,
            overrides=self.overrides,
            deferred=self.deferred,
            early=self.early,
            told=frozenset(self.told),
            ending=self.ending,
            closing=self.closing,
        )

    def emit(self, instruction: Instruction) -> None:
        """Add an instruction."""
        self.instructions.append(instruction)

    def report(self, severity: Severity, key: str, text: str, of: str) -> None:
        """Add a message for people."""
        self.instructions.append(Report(severity, key, text, of))

    def report_once(self, severity: Severity, key: str, text: str, of: str) -> None:
        """Add a message for people, unless `of` was reported and has not changed since."""
        if of not in self.told:
            self.told.add(of)
            self.report(severity, key, text, of)

    def touch(self, place: int) -> None:
        """Note that tokens, runs or free capacity of the place have changed."""
        self.dirty.update(self.compiled.touching[place])
        if timed := self.compiled.timed[place]:
            self.retime.update(timed)

    def touch_all(self) -> None:
        """Note that anything may have changed."""
        self.dirty.update(range(len(self.compiled.transitions)))
        for timed in self.compiled.timed:
            self.retime.update(timed)

    def write(self, name: str, value: Value) -> None:
        """Give a variable a new value."""
        self.variables[name] = value
        self.dirty.update(self.compiled.reading.get(name, ()))

    def snapshot(self) -> Marking:
        """Return the marking as it is now."""
        return tuple(self.marking)

    def stopping_in(self, place: str) -> int:
        """Return how many cancelled runs of the place have not confirmed that they stopped."""
        return sum(r.place == place for r in self.stopping.values()) if self.stopping else 0

    def occupied(self, place: int) -> int:
        """Return the number of tokens and stopping runs of the place, which inhibitor arcs and
        capacities count."""
        if not self.stopping:
            return self.marking[place]
        return self.marking[place] + self.stopping_in(self.compiled.net.places[place])

    def find(self, run_id: str) -> Run | None:
        """Return a run that has a token or is stopping; None if it is unknown or finished."""
        for run in self.tokens.get(run_id.rpartition("#")[0], ()):
            if run.id == run_id:
                return run
        return self.stopping.get(run_id)

    def live(self) -> list[Run]:
        """Return the runs with a token that have not ended."""
        return [r for runs in self.tokens.values() for r in runs if r.phase in LIVE]

    def enter(self, place: str, index: int) -> None:
        """Let a token enter an action place: a new run."""
        number = self.started.get(place, 0) + 1
        self.started[place] = number
        self.run_order += 1
        cleared = self.mode in (Mode.RUNNING, Mode.STEPPING)
        run = Run(f"{place}#{number}", place, self.run_order, Phase.QUEUED, cleared)
        present = self.tokens.get(place, ())
        self.tokens[place] = (*present, run)
        if present and self.compiled.task.places[place].servers is None:
            text = f"a second token entered {place}, which is declared to hold one; its run waits"
            self.report(Severity.ERROR, "unsafe", text, place)
        self.touch(index)

    def leave(self, run: Run) -> None:
        """Take a run's token out of its place."""
        self.tokens[run.place] = tuple([r for r in self.tokens[run.place] if r.id != run.id])
        self.told.discard(run.id)

    def put(self, old: Run, **changes: object) -> Run:
        """Replace a run by a changed copy, and return that."""
        new = old.changed(**changes)
        self.replace_run(new)
        return new

    def replace_run(self, new: Run) -> None:
        """Replace the run that has the same id."""
        if new.id in self.stopping:
            self.stopping[new.id] = new
        else:
            present = self.tokens[new.place]
            self.tokens[new.place] = (
                (new,)
                if len(present) == 1
                else tuple(new if r.id == new.id else r for r in present)
            )
        self.touch(self.compiled.action_places[new.place])
