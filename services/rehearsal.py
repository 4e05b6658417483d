"""Try out an action on a simulated clock, without node, device or network, or a whole task in lock
step: for the tests of people who write a robot."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from msgspec import Struct, field

from petrobot.services.action import Result, Status, error
from petrobot.services.comm.calls.events import VERDICT_EVENTS, RunVerdict
from petrobot.services.comm.location_file import MEMORY_CALLS, ActionEntry
from petrobot.services.comm.lockstep.party import TICK
from petrobot.services.comm.protocol.messages import Call, Cancel, Event, Feedback, Outcome
from petrobot.services.node.inline_host import InlineHost
from petrobot.services.node.memory import GlobalMemory
from petrobot.services.worker.context import Draws, Report, outcome_of, result_of
from petrobot.services.worker.setpoints import Sent, SetpointReceiver

NAME, RUN = "action", "rehearsal/action#1"


class StillRunningError(AssertionError):
    """The action had not ended after the rehearsal's limit."""


class Rehearsal(Struct):
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
    set_points: Mapping[str, Sequence[float]] | None = None,
    memory: Mapping[str, Any] | None = None,
    world: Callable[[float], None] | None = None,
    cancel_after: float | None = None,
    limit: float = 60.0,
    seed: int = 0,
    **arguments: Any,
) -> Rehearsal:
    """Run an action to its end in ticks of 4 ms of simulated time; takes milliseconds of real time.

    `device` is a driver (`Driver`; a cyclic one is stepped, and one that was made with ports None
    gets ports with a clock, `random`, `raise_event` and `stream`, which receives what the action
    publishes), or whatever the action uses as `ctx.device`. `services` answer its calls by name.
    The global memory is there without being named; `memory` are its variables at the beginning.
    `streams` gives the periods of streams (s; of others one tick), and `set_points` what the driver
    receives by streams of other actions, by stream, all the time. `world(now)` is called each tick
    before the action, to let something happen. With `cancel_after` it is cancelled then. Raises
    StillRunningError when it has not ended after `limit` seconds.
    """
    stage = _Stage(action, device, services or {}, defaultdict(lambda: TICK, streams or {}), seed)
    for name, value in (memory or {}).items():
        stage.played.memory.call("memory.put", {"name": name, "value": value})
    stage.place.take(0.0, Call(RUN, NAME, arguments, seed=seed))
    for tick in range(round(limit / TICK) + 1):
        stage.now = tick * TICK
        for name, values in (set_points or {}).items():
            stage.ports.stream(name).take(values)
        if world is not None:
            world(stage.now)
        if cancel_after is not None and stage.now >= cancel_after - 1e-9:
            stage.place.take(stage.now, Cancel(RUN))
            cancel_after = None
        if stage.step():
            return stage.played
    raise StillRunningError(
        f"the action has not ended after {limit:g} s; {_last_acts(stage.played)}"
    )


def rehearse_task(task: str | Path, /, *options: str) -> dict[str, Any]:
    """Check a task, run it in simulated time, and return the result of the run: what `petrobot
    check TASK` and `petrobot run TASK --mode lockstep --json -` do.

    `options` are those of `petrobot run`, such as "--seed", "3". Raises AssertionError with the
    messages if the task may not run, or could not be run. A run that ends in ERROR has a result.
    """
    _command("check", str(task), ends=(0,))
    told = _command("run", str(task), "--mode", "lockstep", "--json", "-", *options, ends=(0, 1))
    result: dict[str, Any] = json.loads(told)
    return result


def _command(*arguments: str, ends: Collection[int]) -> str:
    command = [sys.executable, "-m", "petrobot", *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode not in ends:
        raise AssertionError(f"petrobot {arguments[0]}:\n{done.stdout}{done.stderr}")
    return done.stdout


def _last_acts(played: Rehearsal) -> str:
    """Return how often the action called, published and raised events, and each time the last."""
    kinds: dict[str, Sequence[Any]] = {
        "calls": played.calls,
        "set points": played.published,
        "events": played.events,
    }
    acts = [f"{len(a):,} {kind}, the last: {a[-1]!s:.200}" for kind, a in kinds.items() if a]
    return "; ".join(acts) or "it called and published nothing"


class _StillDevice:
    """Makes any object the device of a rehearsal; it counts as standing still."""

    def __init__(self, handle: Any) -> None:
        self.handle = handle

    def stop(self, now: float) -> None:
        """Do nothing."""

    def stopped(self) -> bool:
        """Return True: it never moves."""
        return True


class TestPorts:
    """Ports of a driver in a test, if it was made with ports None: a clock, `random`, `raise_event`
    and streams. Until `begin`, they are those of `setup`: nothing arrives or can be drawn."""

    __test__ = False

    def __init__(self, clock: Callable[[], float] = lambda: 0.0) -> None:
        self._clock = clock
        self._events: list[tuple[float, str, Mapping[str, Any]]] = []
        self._periods: Mapping[str, float] = defaultdict(lambda: TICK)
        self._receivers = dict[str, SetpointReceiver]()
        self.random = Draws("device").random

    @classmethod
    def of(cls, driver: Any) -> TestPorts:
        """Return the ports of a driver that was made with ports None; of any other device, ports
        that it does not see."""
        if getattr(driver, "ports", cls) is None:  # its own constructor keeps what it is given
            driver.ports = cls()
        ports = getattr(driver, "ports", None)
        return ports if isinstance(ports, cls) else cls()

    def begin(
        self,
        clock: Callable[[], float],
        events: list[tuple[float, str, Mapping[str, Any]]],
        periods: Mapping[str, float],
        seed: int = 0,
    ) -> None:
        """Begin a test; the driver may have opened streams in its `setup`, and be used again."""
        self._clock, self._events, self._periods = clock, events, periods
        self.random = Draws("device", seed).random
        for name, receiver in self._receivers.items():
            receiver.begin(periods[name])

    @property
    def now(self) -> float:
        """The test's clock (s)."""
        return self._clock()

    def raise_event(self, name: str, **data: Any) -> None:
        """Record the event."""
        self._events.append((self.now, name, data))

    def stream(self, name: str) -> SetpointReceiver:
        """The receiving end of a stream."""
        if name not in self._receivers:
            self._receivers[name] = SetpointReceiver(self._periods[name], lambda: self.now)
        return self._receivers[name]

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"a test has no ports.{name}; make the driver with ports that do")


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
        self.ports = TestPorts.of(device)
        self.ports.begin(lambda: self.now, self.played.events, streams, seed)
        self._services = services
        driver = device if hasattr(device, "stopped") and hasattr(device, "period") else None
        self.place = InlineHost(
            {NAME: ActionEntry(NAME, "", "", "")},
            clock=lambda: self.now,
            driver=driver,
            remote=_StillDevice(device) if driver is None and device is not None else None,
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
            played.result = result_of(report)
            played.seconds = report.seconds
        elif isinstance(report, Sent):
            played.published.append((self.now, report.stream, report.values))
            self.ports.stream(report.stream).take(report.values, report.elapsed)
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
            self.place.take(self.now, outcome_of(report.id, result))

    def _answer(self, asked: Call) -> Result:
        if asked.service in self._services:
            return self._services[asked.service](**asked.arguments)
        if asked.service in MEMORY_CALLS:
            return self.played.memory.call(asked.service, asked.arguments)
        return error(
            "unknown_service",
            f"this rehearsal has no service {asked.service!r}; pass it in services",
        )
