"""A clock that a test moves, a device that takes its time to stop, and a runner driven tick by
tick."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec import Struct, field

from petrobot.services.comm.location_file import ActionEntry
from petrobot.services.comm.lockstep.party import TICK
from petrobot.services.comm.protocol.messages import Call, Cancel, Outcome
from petrobot.services.worker.context import Report
from petrobot.services.worker.runner import Order, Runner

OUTSIDE = Path(__file__).parent / "outside"
"""Stands for the folder of a laboratory's own packages."""
sys.path.append(str(OUTSIDE))


class Clock(Struct):
    """Simulated time, read like a clock."""

    now: float = 0.0

    def __call__(self) -> float:
        return self.now


class Device(Struct):
    """A device under test: moves while told to, comes to rest `halting` seconds after its stop
    routine (None: never)."""

    clock: Clock
    halting: float | None = 0.1
    moving: bool = False
    stops: list[float] = field(default_factory=list)

    @property
    def handle(self) -> Device:
        return self

    def stop(self, now: float) -> None:
        self.stops.append(now)

    def stopped(self) -> bool:
        if (
            self.moving
            and self.stops
            and self.halting is not None
            and self.clock.now >= self.stops[0] + self.halting
        ):
            self.moving = False
        return not self.moving


class Bench(Struct):
    """A runner whose actions are given as callables, driven on a clock of its own."""

    clock: Clock
    device: Device | None
    runner: Runner
    seen: list[Report] = field(default_factory=list)
    begun: int = 0
    deadlines: dict[str, float] = field(default_factory=dict)
    """When each run is over its deadline, which its node watches and the bench stands for (s)."""

    def begin(
        self, action: str, deadline: float | None = None, seed: int = 1, **arguments: Any
    ) -> str:
        self.begun += 1
        identity = f"run{self.begun}"
        if deadline is not None:
            self.deadlines[identity] = self.clock.now + deadline
        self.runner.take(self.clock.now, Call(identity, action, arguments, deadline, seed=seed))
        return identity

    def take(self, order: Order) -> None:
        self.runner.take(self.clock.now, order)

    def answer(self, child: str, status: str = "success", **values: Any) -> None:
        self.take(Outcome(child, status, values))

    def tick(self, seconds: float = 0.0) -> list[Report]:
        """Advance now, then tick by tick for so many seconds; gives what was reported."""
        fresh: list[Report] = []
        until = self.clock.now + seconds
        while True:
            for run, due in list(self.deadlines.items()):
                if self.clock.now >= due - 1e-9:
                    del self.deadlines[run]
                    self.take(Cancel(run, "deadline: late"))
            self.runner.advance(self.clock.now)
            fresh += self.runner.reports()
            if self.clock.now >= until - 1e-9:
                break
            self.clock.now += TICK
        self.seen += fresh
        return fresh

    def ended(self, identity: str) -> Outcome:
        """How a run ended; it must have ended once."""
        (end,) = [r for r in self.seen if isinstance(r, Outcome) and r.id == identity]
        return end


@pytest.fixture
def bench() -> Callable[..., Bench]:
    """Makes a bench: `bench(name=function, ...)`, with a device if `device=True` or one is
    given."""

    def make(
        device: Any = None,
        virtual: bool = True,
        limits: dict[str, Any] | None = None,
        **actions: Any,
    ) -> Bench:
        clock = Clock()
        owner = Device(clock) if device is True else device
        if owner is not None:
            owner.clock = clock
        entries = {
            name: ActionEntry(
                name,
                "tests:none",
                "task",
                "here",
                "it" if owner else "",
                **(limits or {}).get(name, {}),
            )
            for name in actions
        }
        runner = Runner(
            entries,
            clock=clock,
            device=owner,
            streams={"points": 0.02},
            substitutes=actions,
            virtual=virtual,
        )
        return Bench(clock, owner, runner)

    return make
