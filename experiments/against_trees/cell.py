"""The adapter for programs that are not nets: it runs primitive actions on nodes, with the same
callers and in the same two modes (lock step and real time) as petrobot's coordinator.

A program gets a `Cell`. `start` calls an action by name and returns a `Run` to poll, `cancel` asks
it to stop, `count` says how often an external event has come. A run waits until its device has
stopped a cancelled run, as an action client usually does for its user.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, Protocol
from unittest.mock import patch

from petrobot.coordinator.launch import Substitutes, lockstep_party, make_callers
from petrobot.coordinator.run.lockstep import NAME
from petrobot.services.comm.calls.caller import Notice
from petrobot.services.comm.calls.client import Client
from petrobot.services.comm.location_file import Directory
from petrobot.services.comm.lockstep.cell import Delays, LockStepCell
from petrobot.services.comm.lockstep.party import TICK, Envelope
from petrobot.services.comm.protocol.messages import Call, Event, Message, Outcome, Welcome

EVENTS = ("image_tick", "ball_caught")
SERVICE_DEADLINE = 20.0
"""Limit for preparing and scoring the laboratory (s), as in petrobot's own mission runs."""
PERIOD = 0.01
"""Time between two ticks of a program in real time (s)."""


class Run:
    """A run of an action. `outcome` is None while it is active."""

    def __init__(self, id_: str, action: str, device: str) -> None:
        self.id, self.action, self.device = id_, action, device
        self.outcome: Outcome | None = None
        self.cancelled = False

    @property
    def status(self) -> str:
        """success, failure or error; empty while it is active."""
        return self.outcome.status if self.outcome is not None else ""


class Cell:
    """The cell, as a program can use it. Sans-I/O, like the callers."""

    def __init__(self, directory: Directory, name: str, boot: str, seed: int) -> None:
        self.directory = directory
        self.callers = make_callers(directory, boot, 1, NAME)
        self.now = 0.0
        self._name, self._seed = name, seed
        self._runs: dict[str, Run] = {}
        self._last: dict[str, Run] = {}
        """The last run started, by device."""
        self._waiting: deque[tuple[Run, Call]] = deque()
        self._calls: Counter[str] = Counter()
        self._events: Counter[str] = Counter()

    def start(self, action: str, **arguments: Any) -> Run:
        """Call an action by its name. Raises KeyError for a name that services.toml does not
        have."""
        entry = self.directory.actions[action]
        self._calls[action] += 1
        run = Run(f"{self._name}/{action}#{self._calls[action]}", action, entry.device)
        call = Call(run.id, action, {**entry.args, **arguments}, None, seed=self._seed)
        self._runs[run.id] = run
        last = self._last.get(run.device) if run.device else None
        self._last[run.device] = run
        if last is not None and last.outcome is None and last.cancelled:
            self._waiting.append((run, call))
        else:
            self.callers[entry.node].call(self.now, call)
        return run

    def service(self, name: str, **arguments: Any) -> Run:
        """Call a service by its name."""
        run = self._runs[name] = Run(f"{self._name}/{name}", name, "")
        self._runs[run.id] = run
        caller = self.callers[self.directory.where(name)]
        caller.call(self.now, Call(run.id, name, arguments, SERVICE_DEADLINE, seed=self._seed))
        return run

    def cancel(self, run: Run) -> None:
        """Ask a run to stop."""
        if run.outcome is not None or run.cancelled:
            return
        run.cancelled = True
        for waiting in list(self._waiting):
            if waiting[0] is run:
                self._waiting.remove(waiting)
                run.outcome = Outcome(run.id, "error", {}, "cancelled", "")
                return
        self.callers[self.directory.actions[run.action].node].cancel(self.now, run.id)

    def count(self, event: str) -> int:
        """Return how often an external event has come so far."""
        return self._events[event]

    @property
    def active(self) -> bool:
        """Whether a run is active."""
        return any(run.outcome is None for run in self._runs.values())

    def take(self, now: float, node: str, notices: Sequence[Notice]) -> None:
        """Process the notices of a node's caller."""
        self.now, caller = now, self.callers[node]
        for notice in notices:
            if isinstance(notice, Outcome):
                if (run := self._runs.get(notice.id)) is not None:
                    run.outcome = notice
                caller.acknowledge(now, notice.id)
            elif isinstance(notice, Welcome):
                for id_ in notice.runs:  # of an earlier process that was killed
                    caller.disown(now, id_)
            elif isinstance(notice, Event) and notice.name in EVENTS:
                self._events[notice.name] += 1
                if notice.number:
                    caller.acknowledge_event(now, notice)
        for run, call in list(self._waiting):
            earlier = [r for r in self._runs.values() if r.device == run.device and r is not run]
            if all(r.outcome is not None for r in earlier):
                self._waiting.remove((run, call))
                self.callers[self.directory.actions[run.action].node].call(now, call)


class Program(Protocol):
    """A catching program: ticked until it has ended."""

    over: bool
    gave_up: bool
    """Whether it gave up, since the arm could not be recovered."""
    caught: int
    """Balls in the cup, as the program counts them."""

    def tick(self) -> None:
        """Do what can be done now."""


Make = Callable[[Cell, int], Program]
"""Makes a program for so many balls."""


class ProgramParty:
    """A program that replaces the coordinator of a lock-step cell, ticked every `every` ticks of
    the cell."""

    def __init__(
        self, cell: Cell, make: Make, balls: int, prepare: Mapping[str, Any], every: int = 1
    ) -> None:
        self.name, self.cell = NAME, cell
        self.program: Program | None = None
        self.score: Run | None = None
        self.ticks, self.tick_s = 0, 0.0
        """How often the program was ticked, and the processor time of the ticks (s)."""
        self._make, self._balls, self._every = make, balls, every
        self._prepare = prepare
        self._prepared: Run | None = None
        self._nodes: dict[str, str] = {}
        self._n = 0
        for caller in cell.callers.values():
            caller.open(0.0)
            caller.subscribe(0.0, EVENTS)

    @property
    def over(self) -> bool:
        """Return whether the program and its runs have ended, and the laboratory has scored."""
        return self.score is not None and self.score.outcome is not None

    def receive(self, now: float, envelope: Envelope) -> None:
        """Handle a node's message."""
        node = self._nodes.setdefault(envelope.source, self.cell.directory.party(envelope.source))
        caller = self.cell.callers[node]
        caller.receive(now, envelope.body)
        self.cell.take(now, node, caller.notices())

    def advance(self, now: float) -> None:
        """Do what is due, and tick the program."""
        cell, self.cell.now = self.cell, now
        for node, caller in cell.callers.items():
            if now >= caller.soonest:
                caller.advance(now)
                caller.due()
            if notices := caller.notices():
                cell.take(now, node, notices)
        if self.program is None:
            if all(caller.up for caller in cell.callers.values()):
                self._set_up()
        elif not self.program.over:
            self._n += 1
            if self._n % self._every == 0:
                begun = time.perf_counter()
                self.program.tick()
                self.tick_s += time.perf_counter() - begun
                self.ticks += 1
        elif self.score is None:
            self.score = self._ask("laboratory_score", cycles=[])

    def _set_up(self) -> None:
        if self._prepared is None:
            self._prepared = self._ask("laboratory_prepare", **self._prepare)
        if self._prepared.outcome is not None:
            self.program = self._make(self.cell, self._balls)

    def _ask(self, service: str, **arguments: Any) -> Run:
        if service in self.cell.directory.services:
            return self.cell.service(service, **arguments)
        nobody = Run(service, service, "")
        nobody.outcome = Outcome(service, "success", {})
        return nobody

    def drain(self) -> Sequence[Envelope]:
        """Return what was sent since the last call, in order."""
        return [
            Envelope(node, NAME, _target(node, message), "call", message)
            for node, caller in self.cell.callers.items()
            for message in caller.messages(self.cell.now)
        ]


def _target(node: str, message: Message) -> str:
    return message.service if isinstance(message, Call) else node


@contextmanager
def simulated_time(cell: Cell) -> Iterator[None]:
    """Let py_trees' Timeout decorator read the cell's clock instead of the computer's."""
    try:
        import py_trees.decorators
    except ImportError:
        yield
        return
    with patch.object(py_trees.decorators, "time", SimpleNamespace(monotonic=lambda: cell.now)):
        yield


class Played(Protocol):
    """The result of a mission in lock step."""

    program: Program | None


def play(
    directory: Directory,
    make: Make,
    *,
    balls: int,
    seed: int,
    limit: float,
    prepare: Mapping[str, Any] | None = None,
    substitutes: Substitutes | None = None,
    every: int = 1,
) -> tuple[ProgramParty, float]:
    """Run a program in lock step for at most `limit` s of simulated time. Return its party and the
    time of its end. Whatever the program raises passes."""
    cell = Cell(directory, f"program/{seed}", "lock step", seed)
    given = {"seed": seed, "runs": balls, **(prepare or {})}
    party = ProgramParty(cell, make, balls, given, every)
    parties = [lockstep_party(directory, node, substitutes) for node in directory.nodes.values()]
    try:
        steps = LockStepCell([party, *parties], Delays(directory.delays()))
        with simulated_time(cell):
            steps.run(lambda: party.over, round(limit / TICK))
        return party, steps.now
    finally:
        for one in parties:
            close = getattr(one, "close", None)
            if close is not None:
                close()


async def play_in_real_time(directory: Directory, make: Make, *, balls: int, boot: str) -> Program:
    """Run a program with nodes that are up, ticked every `PERIOD` seconds."""
    cell = Cell(directory, f"program-{boot}", boot, 0)
    clients = {}
    for node, caller in cell.callers.items():
        host, port = directory.address(node)
        clients[node] = Client(
            host,
            port,
            caller,
            on_notices=lambda now, notices, node=node: cell.take(now, node, notices),  # type: ignore[misc]
        )
        caller.subscribe(0.0, EVENTS)
        clients[node].start()
    try:
        for client in clients.values():
            if not await client.connected(10.0):
                raise ConnectionError(client.trouble)
        program: Program | None = None
        while program is None or not program.over or cell.active:
            cell.now = next(iter(clients.values())).now()
            program = program or make(cell, balls)
            if not program.over:
                program.tick()
            for client in clients.values():
                client.flush()
            await asyncio.sleep(PERIOD)
        return program
    finally:
        for client in clients.values():
            await client.close()
