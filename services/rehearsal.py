"""Try out an action on a simulated clock, without node, device or network: for the tests of people
who write actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from petrobot.services.action import Result, Status, error
from petrobot.services.comm.calls.events import VERDICT_EVENTS, RunVerdict
from petrobot.services.comm.location_file import MEMORY_CALLS, ActionEntry
from petrobot.services.comm.lockstep.party import TICK
from petrobot.services.comm.protocol.messages import Call, Cancel, Event, Feedback, Outcome
from petrobot.services.device import Driver
from petrobot.services.node.inline_host import InlineHost
from petrobot.services.node.memory import GlobalMemory
from petrobot.services.worker.context import Draws, Report
from petrobot.services.worker.outlets import Sent

NAME, RUN = "action", "rehearsal"


class StillRunningError(AssertionError):
    """The action had not ended after the rehearsal's limit."""


@dataclass
class Rehearsal:
    """What an action did: its result, and everything that it sent, with the simulated time since
    its begin (s)."""

    result: Result
    seconds: float
    published: list[tuple[float, str, tuple[float, ...]]] = field(default_factory=list)
    """Set points as a receiver gets them: (time, stream, values)."""
    events: list[tuple[float, str, Mapping[str, Any]]] = field(default_factory=list)
    progress: list[tuple[float, float]] = field(default_factory=list)
    """(time, fraction)."""
    calls: list[tuple[float, str, Mapping[str, Any]]] = field(default_factory=list)
    """Calls of services: (time, service, arguments)."""
    verdicts: list[tuple[float, str, Status, str]] = field(default_factory=list)
    """Verdicts on earlier runs: (time, run, status, cause)."""
    memory: GlobalMemory = field(
        default_factory=lambda: GlobalMemory(lambda name, value, version: None)
    )


def rehearse(
    action: Callable[..., Any],
    /,
    *,
    device: Any = None,
    services: Mapping[str, Callable[..., Result]] | None = None,
    streams: Mapping[str, float] | None = None,
    world: Callable[[float], None] | None = None,
    cancel_after: float | None = None,
    limit: float = 60.0,
    seed: int = 0,
    **arguments: Any,
) -> Rehearsal:
    """Run an action to its end in ticks of 4 ms of simulated time; takes milliseconds of real time.

    `device` is a driver (`Driver`; a cyclic one is stepped, and one that was made with ports None
    gets ports with a clock, `random` and `raise_event`), or any object that the action uses as
    `ctx.device`. `services` answer its calls by name (the global memory is always there), `streams`
    has the periods of the streams that it publishes to (s). `world(now)` is called in each tick
    before the action, to change the world. The action is cancelled after `cancel_after` s. Raises
    StillRunningError when it has not ended after `limit` seconds.
    """
    stage = _Stage(action, device, services or {}, streams or {}, seed)
    stage.place.take(0.0, Call(RUN, NAME, arguments, seed=seed))
    for tick in range(round(limit / TICK) + 1):
        stage.now = tick * TICK
        if world is not None:
            world(stage.now)
        if cancel_after is not None and stage.now >= cancel_after - 1e-9:
            stage.place.take(stage.now, Cancel(RUN))
            cancel_after = None
        if stage.step():
            return stage.played
    raise StillRunningError(
        f"the action has not ended after {limit:g} s; it has told: {stage.played}"
    )


class _Prop:
    """Makes any object the device of a rehearsal; it counts as standing still."""

    def __init__(self, handle: Any) -> None:
        self.handle = handle

    def stop(self, now: float) -> None:
        """Do nothing."""

    def stopped(self) -> bool:
        """Return True: it never moves."""
        return True


class _StagePorts:
    """Ports of a driver in a rehearsal."""

    def __init__(self, stage: _Stage, seed: int) -> None:
        self._stage = stage
        self.random = Draws("device", seed).random

    @property
    def now(self) -> float:
        """The rehearsal's clock (s)."""
        return self._stage.now

    def raise_event(self, name: str, **data: Any) -> None:
        """Record the event in the rehearsal's `events`."""
        self._stage.played.events.append((self.now, name, data))

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"a rehearsal has no ports.{name}; make the driver with ports that do")


class _Stage:
    """Hosts one run, and answers its calls of services."""

    def __init__(
        self,
        action: Callable[..., Any],
        device: Any,
        services: Mapping[str, Callable[..., Result]],
        streams: Mapping[str, float],
        seed: int,
    ) -> None:
        self.now = 0.0
        self.played = Rehearsal(error("still_running"), 0.0)
        if isinstance(device, Driver) and getattr(device, "ports", self) is None:
            device.ports = _StagePorts(self, seed)
        self._services = services
        driver = device if hasattr(device, "stopped") and hasattr(device, "period") else None
        self.place = InlineHost(
            {NAME: ActionEntry(NAME, "", "", "")},
            clock=lambda: self.now,
            driver=driver,
            remote=_Prop(device) if driver is None and device is not None else None,
            streams=streams,
            substitutes={NAME: action},
            virtual=True,
        )

    def step(self) -> bool:
        """Advance by one tick; return whether the run has ended."""
        self.place.advance(self.now)
        reports = self.place.reports()
        for report in reports:
            self._note(report)
        return any(isinstance(report, Outcome) for report in reports)

    def _note(self, report: Report) -> None:
        played = self.played
        if isinstance(report, Outcome):
            played.result = Result(
                Status(report.status),
                report.values,
                report.cause,
                report.text,
                report.deferred,
                report.executed,
            )
            played.seconds = report.seconds
        elif isinstance(report, Sent):
            played.published.append((self.now, report.stream, report.values))
        elif isinstance(report, Event) and report.name.startswith(VERDICT_EVENTS):
            said = RunVerdict.of_data(report.data)
            played.verdicts.append((self.now, said.run, Status(said.status), said.cause))
        elif isinstance(report, Event):
            played.events.append((self.now, report.name, report.data))
        elif isinstance(report, Feedback):
            played.progress.append((self.now, report.fraction))
        elif isinstance(report, Call):
            played.calls.append((self.now, report.service, report.arguments))
            result = self._answer(report)
            answer = Outcome(report.id, result.status, result.values, result.cause, result.text)
            self.place.take(self.now, answer)

    def _answer(self, asked: Call) -> Result:
        if asked.service in self._services:
            return self._services[asked.service](**asked.arguments)
        if asked.service in MEMORY_CALLS:
            return self.played.memory.call(asked.service, asked.arguments)
        return error(
            "unknown_service",
            f"this rehearsal has no service {asked.service!r}; pass it in services",
        )
